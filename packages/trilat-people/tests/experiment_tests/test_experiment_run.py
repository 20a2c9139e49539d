"""An experiment of synthetic participants: verified logs, tables, and going on after a kill."""

import csv
import hashlib
import random
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from trilat_people.experiment.experiment_run import (
    Experiment,
    begin_experiment,
    list_log_problems,
)
from trilat_people.experiment.tasks import place_slave

import trilat_net as tn
from tests.experiments import REACH, TRACK, write_protocol
from tests.json_outline import is_documented
from trilat_net.errors import UsageError


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    folder = tmp_path_factory.mktemp("experiment")
    return tn.run_experiment(write_protocol(folder), folder / "out", jobs=1)


def test_every_trial_has_a_log_that_verifies(done: Experiment) -> None:
    rows = done.to_rows()
    assert len(rows) == len(done.plan.trials) == 8
    assert len(list((done.folder / "logs").iterdir())) == 8
    for row in rows[::3]:
        path = done.folder / row["log"]
        log = tn.open_log(path)
        assert tn.verify(log).passed
        assert hashlib.sha256(path.read_bytes()).hexdigest() == row["log_sha256"]
        assert done.plan.digest in log.scenario.about
        assert (
            log.scenario.links["s->m1"].delay_ms
            == {"near": 0.0, "far": 200.0}[row["condition"]]
        )


def test_trial_ends_where_its_task_is_done(done: Experiment) -> None:
    """In the truth of the log the end effector was within the target for the dwell time, and not before."""
    row = done.to_rows()[0]
    log = tn.open_log(done.folder / row["log"])
    target_m = place_slave(log.scenario.arms["s"], log["s"].q[0])
    number = done.plan.trials[0].target
    angle = 0.5 * np.pi * ((number // 2 + 2 * (number % 2)) % 4)
    target_m += 0.1 * np.array([np.cos(angle), np.sin(angle)])
    off_m = np.array(
        [np.linalg.norm(log.scenario.arms["s"].end_effector(q) - target_m) for q in log["s"].q]
    )
    ended_s = log["s"].t_s[-1] - 0.1
    inside = off_m <= 0.025
    dwelt = (log["s"].t_s <= ended_s) & (log["s"].t_s >= ended_s - 0.2 + 1.0 / log["s"].rate_hz)
    assert row["succeeded"] == 1
    assert inside[dwelt].all()
    assert row["error_end_mm"] == pytest.approx(
        1e3 * off_m[log["s"].t_s <= ended_s][-1], abs=2.0
    )


def test_tables_are_tidy(done: Experiment) -> None:
    with (done.folder / "trials.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["participant"] for row in rows] == ["P1"] * 4 + ["P2"] * 4
    assert {row["condition"] for row in rows} == {"near", "far"}
    assert all(float(row["completion_s"]) > 0.2 for row in rows)
    assert done.to_frame().shape[0] == 8
    assert "8 of 8 trials" in done.summary()
    assert is_documented("experiment run", done.to_dict())
    assert is_documented("experiment check", done.plan.to_dict())


def test_delay_makes_reaching_slower(done: Experiment) -> None:
    """Ferrell, IEEE Trans. HFE 6, 1965: over a delay people move, and wait for what they see."""
    found = {
        name: np.mean([r["completion_s"] for r in done.to_rows() if r["condition"] == name])
        for name in ("near", "far")
    }
    assert found["far"] > found["near"] + 0.2


def test_same_protocol_gives_the_same_bytes(done: Experiment, tmp_path: Path) -> None:
    again = tn.run_experiment(write_protocol(tmp_path), tmp_path / "out", jobs=1)
    assert [row["log_sha256"] for row in again.to_rows()] == [
        row["log_sha256"] for row in done.to_rows()
    ]
    assert (again.folder / "trials.csv").read_bytes() == (
        done.folder / "trials.csv"
    ).read_bytes()


@pytest.mark.parametrize(("users", "task"), [('["m1", "m2"]', REACH), ('["m1"]', TRACK)])
def test_pairs_and_paths_run_as_well(users: str, task: str, tmp_path: Path) -> None:
    begun = begin_experiment(write_protocol(tmp_path, users, task), tmp_path / "out")
    rows = begun.run(jobs=1).to_rows()
    assert all(row["succeeded"] for row in rows)
    assert ("pair" in rows[0]) == ("m2" in users)
    if "m2" in users:
        assert rows[0]["pair"] == "P1-P2"
        assert rows[0]["force_peak_user1_n"] > 0.1 < rows[0]["force_peak_user2_n"]
        for row in rows:  # see `PairMeasures`
            mean_n = [row["force_mean_user1_n"], row["force_mean_user2_n"]]
            assert 0.0 < row["internal_share"] < 1.0
            assert 0.0 < row["first_effort_share"] < 1.0
            assert row["internal_rms_n"] < row["force_peak_user1_n"]
            assert row["useful_rms_n"] < 2.0 * sum(mean_n) + row["force_peak_user1_n"]
            assert row["first_work_j"] > -row["first_taken_j"]
    else:
        assert all(row["completion_s"] == pytest.approx(2.0, abs=0.03) for row in rows)


def test_log_that_was_changed_is_named(done: Experiment, tmp_path: Path) -> None:
    again = tn.open_experiment(shutil.copytree(done.folder, tmp_path / "out"))
    rows = again.to_rows()
    (again.folder / rows[0]["log"]).write_bytes(b"other")
    (again.folder / rows[1]["log"]).unlink()
    problems = list(list_log_problems(tn.open_experiment(again.folder)))
    assert len(problems) == 2
    assert "is not the log that the trial wrote" in problems[0]
    assert "is missing" in problems[1]


def test_folder_of_another_plan_is_refused(tmp_path: Path) -> None:
    begun = begin_experiment(write_protocol(tmp_path), tmp_path / "out")
    with pytest.raises(UsageError, match="is not empty"):
        begin_experiment(tmp_path / "short.toml", tmp_path / "out")
    file = begun.folder / "protocol.toml"
    file.write_text(
        file.read_text(encoding="utf-8").replace("trials = 2", "trials = 3"), encoding="utf-8"
    )
    with pytest.raises(UsageError, match="the protocol was changed after the experiment began"):
        tn.open_experiment(begun.folder)
    with pytest.raises(UsageError, match="contains no experiment"):
        tn.open_experiment(tmp_path)


@pytest.mark.parametrize("kills", [2, pytest.param(20, marks=pytest.mark.long)])
def test_killed_experiment_goes_on_whole(done: Experiment, kills: int, tmp_path: Path) -> None:
    """SIGKILL at random moments: nothing twice, nothing lost, the same bytes in the end."""
    folder, moment = tmp_path / "out", random.Random(1)
    begin_experiment(write_protocol(tmp_path), folder)
    code = "from trilat_net.app.cli import main; main()"
    words = [sys.executable, "-c", code, "experiment", "run", str(folder), "--jobs", "1"]
    ends = []
    for _ in range(kills):
        running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with suppress(subprocess.TimeoutExpired):
            running.wait(timeout=moment.uniform(0.6, 2.2))
        running.kill()
        ends.append(running.wait())
    assert set(ends) <= {-signal.SIGKILL, 0}
    assert -signal.SIGKILL in ends
    found = tn.open_experiment(folder).run(jobs=1)
    numbers = [row["trial_number"] for row in found.to_rows()]
    assert numbers == list(range(1, 9))
    journal = (folder / "trials.journal").read_bytes().split(b"\n")
    assert len([line for line in journal if b'"cell"' in line and b"\t" in line]) == 8
    assert [row["log_sha256"] for row in found.to_rows()] == [
        row["log_sha256"] for row in done.to_rows()
    ]

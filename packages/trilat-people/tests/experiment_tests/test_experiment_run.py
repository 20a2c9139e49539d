"""An experiment of synthetic participants: verified logs, tables, and going on after a kill."""

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
from people_builders import PAIR, read_table, run_protocol
from trilat_people.experiment.experiment_run import Experiment
from trilat_people.experiment.tasks import place_slave

import trilat_net as tn
from tests.experiments import REACH, TRACK, write_protocol
from tests.json_outline import is_documented
from trilat_net.errors import UsageError


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """An experiment of two participants and two conditions that has run."""
    return run_protocol(write_protocol(tmp_path_factory.mktemp("experiment")))


def test_every_trial_has_a_log_that_verifies(done: Experiment) -> None:
    rows = done.to_rows()
    assert len(rows) == len(done.plan.trials) == 8
    assert len(list((done.folder / "logs").iterdir())) == 8
    delays_ms = {"near": 0.0, "far": 200.0}
    for row in rows[::3]:
        path = done.folder / row["log"]
        log = tn.open_log(path)
        assert tn.verify(log).passed
        assert hashlib.sha256(path.read_bytes()).hexdigest() == row["log_sha256"]
        assert done.plan.digest in log.scenario.about
        assert log.scenario.links["s->m1"].delay_ms == delays_ms[row["condition"]]


def test_trial_ends_where_its_task_is_done(done: Experiment) -> None:
    """At the end of a trial the slave has been within the target for the dwell time of 0.2 s."""
    row = done.to_rows()[0]
    log = tn.open_log(done.folder / row["log"])
    slave = log["s"]
    arm = log.scenario.arms["s"]
    number = done.plan.trials[0].target
    angle = 0.5 * np.pi * ((number // 2 + 2 * (number % 2)) % 4)
    start_m = place_slave(arm, slave.q[0])
    target_m = start_m + 0.1 * np.array([np.cos(angle), np.sin(angle)])
    places_m = np.array([arm.end_effector(q) for q in slave.q])
    distance_m = np.linalg.norm(places_m - target_m, axis=1)

    ended_s = slave.t_s[-1] - 0.1
    until_end = slave.t_s <= ended_s
    dwell = until_end & (slave.t_s >= ended_s - 0.2 + 1.0 / slave.rate_hz)
    assert row["succeeded"] == 1
    assert (distance_m[dwell] <= 0.025).all()
    assert row["error_end_mm"] == pytest.approx(1e3 * distance_m[until_end][-1], abs=2.0)


def test_tables_are_tidy(done: Experiment) -> None:
    """The table has one row per trial, and the results have their documented form."""
    rows = read_table(done.folder)
    assert [row["participant"] for row in rows] == ["P1"] * 4 + ["P2"] * 4
    assert {row["condition"] for row in rows} == {"near", "far"}
    assert all(float(row["completion_s"]) > 0.2 for row in rows)
    assert done.to_frame().shape[0] == 8
    assert "8 of 8 trials" in done.summary()
    assert is_documented("experiment run", done.to_dict())
    assert is_documented("experiment check", done.plan.to_dict())


def test_delay_makes_reaching_slower(done: Experiment) -> None:
    """Ferrell, IEEE Trans. HFE 6, 1965: over a delay people move, and wait for what they see."""
    times_s: dict[str, list[float]] = {"near": [], "far": []}
    for row in done.to_rows():
        times_s[row["condition"]].append(row["completion_s"])
    assert np.mean(times_s["far"]) > np.mean(times_s["near"]) + 0.2


def test_same_protocol_gives_the_same_bytes(done: Experiment, tmp_path: Path) -> None:
    """The table, which has the digest of every log, has the same bytes in a second experiment."""
    again = run_protocol(write_protocol(tmp_path))
    table = (done.folder / "trials.csv").read_bytes()
    assert (again.folder / "trials.csv").read_bytes() == table


def test_trials_of_a_pair_have_its_measures(tmp_path: Path) -> None:
    """The measures of a pair, see `PairMeasures`, are consistent with the forces of its users."""
    rows = run_protocol(write_protocol(tmp_path, PAIR, REACH)).to_rows()
    for row in rows:
        assert row["succeeded"]
        assert row["pair"] == "P1-P2"
        assert 0.0 < row["internal_share"] < 1.0
        assert 0.0 < row["first_effort_share"] < 1.0
        assert row["internal_rms_n"] < row["force_peak_user1_n"]
        mean_sum_n = row["force_mean_user1_n"] + row["force_mean_user2_n"]
        assert row["useful_rms_n"] < 2.0 * mean_sum_n + row["force_peak_user1_n"]
        assert row["first_work_j"] > -row["first_taken_j"]
    assert rows[0]["force_peak_user1_n"] > 0.1
    assert rows[0]["force_peak_user2_n"] > 0.1


def test_a_path_takes_its_duration(tmp_path: Path) -> None:
    rows = run_protocol(write_protocol(tmp_path, '["m1"]', TRACK)).to_rows()
    for row in rows:
        assert row["succeeded"]
        assert "pair" not in row
        assert row["completion_s"] == pytest.approx(2.0, abs=0.03)


def test_log_that_was_changed_is_named(done: Experiment, tmp_path: Path) -> None:
    again = tn.open_experiment(shutil.copytree(done.folder, tmp_path / "out"))
    rows = again.to_rows()
    (again.folder / rows[0]["log"]).write_bytes(b"other")
    (again.folder / rows[1]["log"]).unlink()
    problems = list(tn.open_experiment(again.folder).list_log_problems())
    assert len(problems) == 2
    assert "is not the log that the trial wrote" in problems[0]
    assert "is missing" in problems[1]


def test_folder_of_another_plan_is_refused(tmp_path: Path) -> None:
    begun = Experiment.begin(write_protocol(tmp_path), tmp_path / "out")
    with pytest.raises(UsageError, match="is not empty"):
        Experiment.begin(tmp_path / "short.toml", tmp_path / "out")
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
    folder = tmp_path / "out"
    chance = random.Random(1)
    Experiment.begin(write_protocol(tmp_path), folder)
    code = "from trilat_net.app.cli import main; main()"
    command = [sys.executable, "-c", code, "experiment", "run", str(folder), "--jobs", "1"]
    exit_codes = []
    for _ in range(kills):
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=chance.uniform(0.6, 2.2))
        process.kill()
        exit_codes.append(process.wait())
    assert set(exit_codes) <= {-signal.SIGKILL, 0}
    assert -signal.SIGKILL in exit_codes

    resumed = tn.open_experiment(folder).run(jobs=1)
    assert [row["trial_number"] for row in resumed.to_rows()] == list(range(1, 9))
    journal = (folder / "trials.journal").read_bytes().split(b"\n")
    assert len([line for line in journal if b'"cell"' in line and b"\t" in line]) == 8
    assert [row["log_sha256"] for row in resumed.to_rows()] == [
        row["log_sha256"] for row in done.to_rows()
    ]

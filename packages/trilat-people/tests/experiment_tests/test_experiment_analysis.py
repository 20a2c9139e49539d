"""The statistics of an experiment: a function of its journal, with every number in a table."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from trilat_people.experiment.experiment_run import begin_experiment

import trilat_net as tn
from tests.experiments import REACH, answer_form, write_hurried_pair, write_protocol
from tests.json_outline import is_documented
from trilat_net.errors import UsageError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("analysis")
    return tn.run_experiment(write_protocol(where), where / "out", jobs=1).folder


def test_means_are_those_of_the_table(folder: Path) -> None:
    found = tn.analyse_experiment(folder)
    with (folder / "trials.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    for mean in found.means["completion_s"]:
        own = [
            np.mean(
                [
                    float(r["completion_s"])
                    for r in rows
                    if (r["participant"], r["condition"]) == (who, mean.condition)
                ]
            )
            for who in ("P1", "P2")
        ]
        assert mean.mean == pytest.approx(np.mean(own))
        assert mean.number == 2
    assert [one.condition for one in found.means["completion_s"]] == ["near", "far"]


def test_every_result_is_written_and_named(folder: Path, tmp_path: Path) -> None:
    found = tn.analyse_experiment(folder, tmp_path / "there")
    assert all(path.exists() for path in found.paths)
    assert (tmp_path / "there" / "completion_s.png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads((tmp_path / "there" / "analysis.json").read_text(encoding="utf-8"))
    assert is_documented("experiment analyse", {**facts, "mixed_models": {}})
    assert is_documented("experiment power", tn.compute_experiment_power(0.5).to_dict())
    assert facts["digest"] == tn.open_experiment(folder).plan.digest
    with (tmp_path / "there" / "comparisons.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["measure"] for row in rows} == set(found.means)
    first = next(row for row in rows if row["measure"] == "completion_s")
    assert (
        float(first["interval_low"])
        < float(first["difference"])
        < float(first["interval_high"])
    )


def test_study_states_measured_delays_and_tests(folder: Path) -> None:
    """The facts of the study are those of the journals and of the tables."""
    analysis = tn.analyse_experiment(folder)
    study = analysis.study
    assert study["participants"] == 2
    assert study["excluded"] == 0
    assert study["conditions"]["far"] == {"delay_ms": 200.0}
    assert study["digest"] == tn.open_experiment(folder).plan.digest
    assert study["measures"] == list(analysis.means)
    assert analysis.to_dict()["study"] == study
    near_ms = study["conditions"]["near"]["delay_ms"]
    assert f"conditions: near delay {near_ms:g} ms; far delay 200 ms" in analysis.summary()


def test_excluded_participants_are_named_with_reason(folder: Path, tmp_path: Path) -> None:
    """A participant who does not count is named in the facts, with the reason."""
    reasons = {"P2": "stopped in block 2"}
    analysis = tn.analyse_experiment(folder, tmp_path / "there", exclude=reasons)
    assert analysis.study["participants"] == 1
    assert analysis.study["excluded"] == 1
    assert analysis.study["exclusions"] == reasons
    assert {row["participant"] for row in analysis.rows} == {"P1"}
    with pytest.raises(
        UsageError, match="there is no participant P9; the participants are P1, P2"
    ):
        tn.analyse_experiment(folder, tmp_path / "other", exclude={"P9": ""})


def test_users_within_pairs_have_a_mixed_model(tmp_path: Path) -> None:
    pytest.importorskip("statsmodels", reason="is in the extra stats")
    file = write_protocol(tmp_path, '["m1", "m2"]', REACH.replace("6.0", "1.0"))
    file.write_text(
        file.read_text(encoding="utf-8").replace("participants = 2", "participants = 6"),
        encoding="utf-8",
    )
    found = tn.analyse_experiment(tn.run_experiment(file, tmp_path / "out", jobs=1).folder)
    assert {model.measure for model in found.fit_models()} == {"force_mean_n", "force_peak_n"}
    assert [one.condition for one in next(found.fit_models()).effects] == ["far"]
    assert (found.study["participants"], found.study["pairs"]) == (6, 3)
    assert "mixed models" in found.study["computed"]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pair of synthetic participants whose time is short for the second condition."""
    where = tmp_path_factory.mktemp("pair")
    file = write_hurried_pair(where)
    return tn.run_experiment(file, where / "out", jobs=1).folder


def test_trials_that_were_not_completed_are_counted(pair: Path, tmp_path: Path) -> None:
    experiment = tn.open_experiment(pair)
    found = tn.analyse_experiment(pair, tmp_path / "there")
    failed = [row for row in experiment.to_rows() if not row["succeeded"]]
    assert failed
    assert sum(time.censored for time in found.times) == len(failed)
    assert "completion_s" not in found.means  # no mean has the limit in it
    assert "timed out" in found.summary()
    assert (tmp_path / "there" / "completion_times.csv").exists()
    assert "not reached" in experiment.summary()
    assert is_documented("experiment analyse", {**found.to_dict(), "mixed_models": {}})


def test_one_pair_has_every_measure_and_no_test(pair: Path, tmp_path: Path) -> None:
    """What the lesson explains is there, whatever its value, and no analysis is claimed."""
    found = tn.analyse_experiment(pair, tmp_path / "there")
    text = found.summary()
    for measure in (
        "force_mean_user1_n",
        "internal_share",
        "first_effort_share",
        "first_work_j",
    ):
        assert measure in text
    assert "first_taken_j" in text
    assert "tlx: no number, because nobody has answered it" in text
    assert found.study["computed"] == []
    assert found.study["pairs"] == 1


def test_measure_of_one_value_is_shown(folder: Path) -> None:
    found = tn.analyse_experiment(folder)
    assert {one.mean for one in found.means["succeeded"]} == {1.0}
    assert "succeeded, mean over participants" in found.summary()


def test_missing_answers_are_counted_and_not_averaged(pair: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(pair, copy)
    experiment = tn.open_experiment(copy)
    full, lacking = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0], [10.0, None, 30.0, None, 50.0, 60.0]
    for n, (number, who, values) in enumerate(
        [(2, "P1", full), (2, "P2", lacking), (4, "P1", lacking), (4, "P2", lacking)]
    ):
        answer_form(experiment, f"q{n}", number, who, "tlx", values)
    answer_form(experiment, "after", 4, "P1", "agency", [None, 1.0, 2.0, 3.0])
    found = tn.analyse_experiment(copy, tmp_path / "there")
    (mean,) = found.means["tlx"]  # the other condition has no whole questionnaire
    assert (mean.condition, mean.mean, mean.missing) == ("near", 35.0, 1)
    counts = [(one.questionnaire, one.condition, *one[2:]) for one in found.missing_answers]
    assert counts == [
        ("tlx", "near", 12, 2, 2, 1),
        ("tlx", "far", 12, 4, 2, 2),
        ("agency", "", 4, 1, 1, 1),
    ]
    assert (
        "tlx, far: 4 of 12 answers are missing; 2 of 2 have no score for that reason"
        in found.summary()
    )
    with (experiment.write_tables().parent / "questionnaires.csv").open(
        encoding="utf-8"
    ) as stream:
        values = [row["value"] for row in csv.DictReader(stream)]
    assert values.count("") == 7


def test_an_empty_analysis_is_reported(tmp_path: Path) -> None:
    begun = begin_experiment(write_protocol(tmp_path), tmp_path / "out")
    with pytest.raises(UsageError, match="there are no trials to analyse yet"):
        tn.analyse_experiment(begun.folder)


def test_theoretical_power_matches_drawn_experiments() -> None:
    """G*Power 3.1: d_z = 0.8, two-sided, alpha 0.05 asks for 15 participants for a power of 0.8."""
    found = tn.compute_experiment_power(0.8, 16)
    assert found.least[0.8] == 15
    assert found.simulated is not None
    low, high = found.simulated.interval
    assert low <= found.power <= high
    assert "with 16 participants: power 0.8" in found.summary()

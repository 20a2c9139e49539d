"""The statistics of an experiment: a function of its journal, with every number in a table."""

import json
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from people_builders import PAIR, read_table, replace_text, run_protocol
from trilat_people.experiment.experiment_run import Experiment

import trilat_net as tn
from tests.experiments import REACH, answer_form, write_hurried_pair, write_protocol
from tests.json_outline import is_documented
from trilat_net.errors import UsageError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an experiment of two participants that has run."""
    return run_protocol(write_protocol(tmp_path_factory.mktemp("analysis"))).folder


def test_means_are_those_of_the_table(folder: Path) -> None:
    """The mean of a condition is the mean over the participants' means of their trials."""
    times_s = defaultdict(list)
    for row in read_table(folder):
        times_s[row["condition"], row["participant"]].append(float(row["completion_s"]))
    means = tn.analyse_experiment(folder).means["completion_s"]
    assert [mean.condition for mean in means] == ["near", "far"]
    for mean in means:
        of_participants_s = [np.mean(times_s[mean.condition, name]) for name in ("P1", "P2")]
        assert mean.mean == pytest.approx(np.mean(of_participants_s))
        assert mean.number == 2


def test_every_result_is_written_and_named(folder: Path, tmp_path: Path) -> None:
    analysis = tn.analyse_experiment(folder, tmp_path / "analysis")
    assert all(path.exists() for path in analysis.paths)
    assert (tmp_path / "analysis" / "completion_s.png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads((tmp_path / "analysis" / "analysis.json").read_text(encoding="utf-8"))
    assert is_documented("experiment analyse", {**facts, "mixed_models": {}})
    assert is_documented("experiment power", tn.compute_experiment_power(0.5).to_dict())
    assert facts["digest"] == tn.open_experiment(folder).plan.digest
    rows = read_table(tmp_path / "analysis", "comparisons.csv")
    assert {row["measure"] for row in rows} == set(analysis.means)
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
    analysis = tn.analyse_experiment(folder, tmp_path / "analysis", exclude=reasons)
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
    file = write_protocol(tmp_path, PAIR, REACH.replace("6.0", "1.0"))
    replace_text(file, "participants = 2", "participants = 6")
    analysis = tn.analyse_experiment(run_protocol(file).folder)
    assert {model.measure for model in analysis.fit_models()} == {
        "force_mean_n",
        "force_peak_n",
    }
    assert [effect.condition for effect in next(analysis.fit_models()).effects] == ["far"]
    assert (analysis.study["participants"], analysis.study["pairs"]) == (6, 3)
    assert "mixed models" in analysis.study["computed"]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pair of synthetic participants whose time is short for the second condition."""
    return run_protocol(write_hurried_pair(tmp_path_factory.mktemp("pair"))).folder


def test_trials_that_were_not_completed_are_counted(pair: Path, tmp_path: Path) -> None:
    experiment = tn.open_experiment(pair)
    analysis = tn.analyse_experiment(pair, tmp_path / "analysis")
    failed = [row for row in experiment.to_rows() if not row["succeeded"]]
    assert failed
    assert sum(time.censored for time in analysis.times) == len(failed)
    assert "completion_s" not in analysis.means  # no mean has the limit in it
    assert "timed out" in analysis.summary()
    assert (tmp_path / "analysis" / "completion_times.csv").exists()
    assert "not reached" in experiment.summary()
    assert is_documented("experiment analyse", {**analysis.to_dict(), "mixed_models": {}})


def test_one_pair_has_every_measure_and_no_test(pair: Path, tmp_path: Path) -> None:
    """What the lesson explains is there, whatever its value, and no analysis is claimed."""
    analysis = tn.analyse_experiment(pair, tmp_path / "analysis")
    text = analysis.summary()
    for measure in (
        "force_mean_user1_n",
        "internal_share",
        "first_effort_share",
        "first_work_j",
    ):
        assert measure in text
    assert "first_taken_j" in text
    assert "tlx: no number, because nobody has answered it" in text
    assert analysis.study["computed"] == []
    assert analysis.study["pairs"] == 1


def test_measure_of_one_value_is_shown(folder: Path) -> None:
    analysis = tn.analyse_experiment(folder)
    assert {mean.mean for mean in analysis.means["succeeded"]} == {1.0}
    assert "succeeded, mean over participants" in analysis.summary()


def test_missing_answers_are_counted_and_not_averaged(pair: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(pair, copy)
    experiment = tn.open_experiment(copy)
    full = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0]
    lacking = [10.0, None, 30.0, None, 50.0, 60.0]
    answer_form(experiment, "q0", 2, "P1", "tlx", full)
    answer_form(experiment, "q1", 2, "P2", "tlx", lacking)
    answer_form(experiment, "q2", 4, "P1", "tlx", lacking)
    answer_form(experiment, "q3", 4, "P2", "tlx", lacking)
    answer_form(experiment, "after", 4, "P1", "agency", [None, 1.0, 2.0, 3.0])
    analysis = tn.analyse_experiment(copy, tmp_path / "analysis")
    (mean,) = analysis.means["tlx"]  # the other condition has no whole questionnaire
    assert (mean.condition, mean.mean, mean.missing) == ("near", 35.0, 1)
    assert [tuple(missing) for missing in analysis.missing_answers] == [
        ("tlx", "near", 12, 2, 2, 1),
        ("tlx", "far", 12, 4, 2, 2),
        ("agency", "", 4, 1, 1, 1),
    ]
    assert (
        "tlx, far: 4 of 12 answers are missing; 2 of 2 have no score for that reason"
        in analysis.summary()
    )
    rows = read_table(experiment.write_tables().parent, "questionnaires.csv")
    assert [row["value"] for row in rows].count("") == 7


def test_an_empty_analysis_is_reported(tmp_path: Path) -> None:
    begun = Experiment.begin(write_protocol(tmp_path), tmp_path / "out")
    with pytest.raises(UsageError, match="there are no trials to analyse yet"):
        tn.analyse_experiment(begun.folder)


def test_theoretical_power_matches_drawn_experiments() -> None:
    """G*Power 3.1: d_z = 0.8, two-sided, alpha 0.05 asks for 15 participants for a power of 0.8."""
    study_power = tn.compute_experiment_power(0.8, 16)
    assert study_power.least[0.8] == 15
    assert study_power.simulated is not None
    low, high = study_power.simulated.interval
    assert low <= study_power.power <= high
    assert "with 16 participants: power 0.8" in study_power.summary()

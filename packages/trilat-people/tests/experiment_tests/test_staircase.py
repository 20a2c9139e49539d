"""Adaptive staircases: the rule, where it settles, and that trials have the values that it says."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page_tests.people import People
from scipy.stats import norm
from trilat_people.experiment.experiment_run import Experiment, begin_experiment
from trilat_people.experiment.staircase import Staircase

import trilat_net as tn
from tests.experiments import write_protocol

SHORT = 'kind = "track"\nduration_s = 0.2'
STAIRS = '\n[staircase]\nkey = "control.K"\nstandard = 100.0\nstart = 80.0\n'


def write_stairs(folder: Path, trials: int, more: str = "") -> Path:
    file = write_protocol(folder, task=SHORT, more=STAIRS + more)
    text = file.read_text(encoding="utf-8")
    file.write_text(
        text.replace("trials = 2", f"trials = {trials}\npractice = 1"), encoding="utf-8"
    )
    return file


def test_differences_follow_the_two_right_rule() -> None:
    stairs = Staircase("link.delay_ms", 80.0, factor=2.0)
    right = [True, True, True, False, True, True, True, True, False, False, True, True]
    found = stairs.list_differences(right)
    assert found == [
        80.0,
        80.0,
        40.0,
        40.0,
        80.0,
        80.0,
        40.0,
        40.0,
        20.0,
        40.0,
        80.0,
        80.0,
        40.0,
    ]
    # It turns at 40 (up), 80 (down), 20 (up) and 80 (down); the first two do not count.
    assert stairs.find_threshold(right) == pytest.approx(np.sqrt(20.0 * 80.0))
    assert stairs.find_threshold(right[:-1]) is None  # the odd one is left out with them
    assert stairs.measure == "threshold_delay_ms"


@pytest.mark.parametrize("down", [1, 2, 3])
def test_staircases_settle_at_levitts_point(down: int) -> None:
    """At the difference that a participant tells right with probability 0.5^(1 / down), by SciPy's normal."""
    stairs = Staircase("link.delay_ms", 100.0, factor=1.2, down=down, deviation=10.0)
    found = []
    for seed in range(60):
        right: list[bool] = []
        for pair in range(200):
            difference = stairs.list_differences(right)[-1]
            right.append(
                stairs.draw_choice(difference, 1 + pair % 2, 1000 * seed + pair) == 1 + pair % 2
            )
        found.append(np.log(stairs.find_threshold(right)))
    settles = np.sqrt(2.0) * 10.0 * norm.ppf(0.5 ** (1.0 / down)) if down > 1 else None
    if settles is None:  # an even chance is no difference at all
        assert np.exp(np.mean(found)) < 3.0
    else:
        assert np.exp(np.mean(found)) == pytest.approx(settles, rel=0.1)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    folder = tmp_path_factory.mktemp("stairs")
    return tn.run_experiment(
        write_stairs(folder, 10, "deviation = 30.0\n"), folder / "out", jobs=1
    )


def assert_values_are_those_of_the_rule(experiment: Experiment) -> None:
    """By the logs' scenarios and the answers in the tables, pair by pair."""
    stairs, rows = experiment.plan.protocol.staircase, experiment.to_rows()
    assert stairs is not None
    for _, block in itertools.groupby(rows, lambda row: (row["participant"], row["block"])):
        _, *pairs = block
        differences = stairs.list_differences(
            [bool(row["right"]) for row in pairs[::2] if row["right"] is not None]
        )
        for n, pair in enumerate(zip(pairs[::2], pairs[1::2], strict=True)):
            values = {row["phase"]: find_stiffness(experiment, row) for row in pair}
            assert values == {"standard": 100.0, "comparison": 100.0 + differences[n]}
            assert {row["difference"] for row in pair} == {differences[n]}
            assert (
                len({experiment.plan.trials[row["trial_number"] - 1].target for row in pair})
                == 1
            )


def find_stiffness(experiment: Experiment, row: dict[str, Any]) -> float:
    control: Any = tn.open_log(experiment.folder / row["log"]).scenario.sites["s"].control
    return float(control.K[0])


def test_trials_have_the_values_that_answers_lead_to(done: Experiment) -> None:
    assert_values_are_those_of_the_rule(done)


def test_choices_and_threshold_are_in_the_tables(done: Experiment) -> None:
    second = {row["trial"] % 2: row["phase"] for row in done.to_rows()[1:3]}
    first = done.list_answers()[0]
    assert first["questionnaire"] == "choice"
    assert (first["value"] == 1 + (second[1] == "comparison")) == bool(
        done.to_rows()[1]["right"]
    )
    analysis, stairs = tn.analyse_experiment(done.folder), done.plan.protocol.staircase
    assert stairs is not None
    found = {
        (row["participant"], row["condition"]): row["threshold_K"]
        for row in analysis.threshold_rows
    }
    for who, block in itertools.groupby(
        done.to_rows(), lambda row: (row["participant"], row["condition"])
    ):
        right = [bool(row["right"]) for row in list(block)[1::2]]
        assert found.get(who) == stairs.find_threshold(right)
    assert (
        "control.K was adapted in a two-interval forced choice against 100"
        in analysis.study["staircase"]
    )
    assert "70.7 % right" in analysis.study["staircase"]


def test_reruns_are_equal_and_ask_nothing_twice(done: Experiment) -> None:
    before = {path: path.read_bytes() for path in done.folder.rglob("*.*") if path.is_file()}
    tn.run_experiment(done.folder, jobs=1)
    assert {path: path.read_bytes() for path in before} == before


def test_people_choose_after_each_pair(tmp_path: Path) -> None:
    """They always say the second; the next pair follows from it, and they end before the last answer."""
    experiment = begin_experiment(write_stairs(tmp_path, 8), tmp_path / "out")
    people = People(experiment, answer=2.0)
    people.run(lambda watch, _: setattr(people, "ends", watch.trial.planned.number == 9))
    assert [key for _, key in people.steps if "choice" in key] == [
        f"questionnaire {number} choice" for number in (3, 5, 7)
    ]
    assert not people.stage.shows_ages
    assert_values_are_those_of_the_rule(experiment)

"""Adaptive staircases: the rule, where it settles, and that trials have the values that it says."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from people_builders import People, replace_text, run_protocol
from scipy.stats import norm
from trilat_people.experiment.experiment_run import Experiment
from trilat_people.experiment.staircase import Staircase

import trilat_net as tn
from tests.experiments import write_protocol

SHORT = 'kind = "track"\nduration_s = 0.2'
STAIRS = '\n[staircase]\nkey = "control.K"\nstandard = 100.0\nstart = 80.0\n'


def write_stairs(folder: Path, trials: int, more: str = "") -> Path:
    """Writes the protocol of a staircase over the stiffness K, with one trial of practice."""
    file = write_protocol(folder, task=SHORT, more=STAIRS + more)
    return replace_text(file, "trials = 2", f"trials = {trials}\npractice = 1")


def test_differences_follow_the_two_right_rule() -> None:
    stairs = Staircase("link.delay_ms", 80.0, factor=2.0)
    right = [True, True, True, False, True, True, True, True, False, False, True, True]
    assert stairs.list_differences(right) == [
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
    """A staircase settles where a participant is right with probability 0.5^(1 / down)."""
    stairs = Staircase("link.delay_ms", 100.0, factor=1.2, down=down, deviation=10.0)
    log_thresholds = []
    for seed in range(60):
        right: list[bool] = []
        for pair in range(200):
            difference = stairs.list_differences(right)[-1]
            comparison = 1 + pair % 2
            choice = stairs.draw_choice(difference, comparison, 1000 * seed + pair)
            right.append(choice == comparison)
        log_thresholds.append(np.log(stairs.find_threshold(right)))
    threshold = np.exp(np.mean(log_thresholds))
    expected = np.sqrt(2.0) * 10.0 * norm.ppf(0.5 ** (1.0 / down))
    if down == 1:  # an even chance is no difference at all
        assert threshold < 3.0
    else:
        assert threshold == pytest.approx(expected, rel=0.1)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """An experiment of ten trials in pairs that has run."""
    folder = tmp_path_factory.mktemp("stairs")
    return run_protocol(write_stairs(folder, 10, "deviation = 30.0\n"))


def assert_values_are_those_of_the_rule(experiment: Experiment) -> None:
    """Asserts that each pair of trials has the stiffness that follows from the answers before."""
    rows = experiment.to_rows()
    stairs = experiment.plan.protocol.staircase
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
            first, second = (experiment.plan.trials[row["trial_number"] - 1] for row in pair)
            assert first.target == second.target


def find_stiffness(experiment: Experiment, row: dict[str, Any]) -> float:
    """Returns the stiffness K of the slave's law in the log of a trial."""
    control: Any = tn.open_log(experiment.folder / row["log"]).scenario.sites["s"].control
    return float(control.K[0])


def test_trials_have_the_values_that_answers_lead_to(done: Experiment) -> None:
    assert_values_are_those_of_the_rule(done)


def test_choices_and_threshold_are_in_the_tables(done: Experiment) -> None:
    """The answers decide which trials are right, and the thresholds follow from these."""
    rows = done.to_rows()
    phases = {row["trial"] % 2: row["phase"] for row in rows[1:3]}
    answer = done.list_answers()[0]
    assert answer["questionnaire"] == "choice"
    right_choice = 2 if phases[1] == "comparison" else 1
    assert (answer["value"] == right_choice) == bool(rows[1]["right"])

    analysis = tn.analyse_experiment(done.folder)
    stairs = done.plan.protocol.staircase
    assert stairs is not None
    thresholds = {
        (row["participant"], row["condition"]): row["threshold_K"]
        for row in analysis.threshold_rows
    }
    for key, block in itertools.groupby(
        rows, lambda row: (row["participant"], row["condition"])
    ):
        right = [bool(row["right"]) for row in list(block)[1::2]]
        assert thresholds.get(key) == stairs.find_threshold(right)

    description = analysis.study["staircase"]
    assert "control.K was adapted in a two-interval forced choice against 100" in description
    assert "70.7 % right" in description


def test_reruns_are_equal_and_ask_nothing_twice(done: Experiment) -> None:
    before = {path: path.read_bytes() for path in done.folder.rglob("*.*") if path.is_file()}
    tn.run_experiment(done.folder, jobs=1)
    assert {path: path.read_bytes() for path in before} == before


def test_people_choose_after_each_pair(tmp_path: Path) -> None:
    """Participants who always choose the second trial are asked after each pair of trials."""
    experiment = Experiment.begin(write_stairs(tmp_path, 8), tmp_path / "out")
    people = People(experiment, answer=2.0)
    people.run(lambda watch, _: setattr(people, "ends", watch.trial.planned.number == 9))
    assert [key for _, key in people.steps if "choice" in key] == [
        f"questionnaire {number} choice" for number in (3, 5, 7)
    ]
    assert not people.stage.shows_ages
    assert_values_are_those_of_the_rule(experiment)

"""What the shipped scenarios say of themselves holds: the brief ones on a push, all in a longer run."""

import pytest

import trilat_net
from trilat_net.scenario import list_shipped, load_scenario
from trilat_net.studies.trials.trial_runner import run_trials

TICKS = {name: sum(map(load_scenario(name).ticks, load_scenario(name).names)) for name in list_shipped()}


@pytest.mark.parametrize("most", [60_000, pytest.param(10**9, marks=pytest.mark.long)])
def test_every_shipped_scenario_expects_something_and_it_holds(most: int) -> None:
    assert all(load_scenario(name).expect.asks for name in TICKS)
    batch = [trial for name, ticks in TICKS.items() if ticks <= most for trial in trilat_net.trials(name)]
    assert len(batch) >= 7
    report = run_trials(batch)
    assert report.held, report.text()

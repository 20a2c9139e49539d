"""What the shipped scenarios say of themselves holds."""

import trilat_net
from trilat_net.scenario import list_shipped, load_scenario
from trilat_net.studies.trials.trial_runner import run_trials


def test_every_shipped_scenario_expects_something_and_it_holds() -> None:
    assert all(load_scenario(name).expect.asks for name in list_shipped())
    batch = [trial for name in list_shipped() for trial in trilat_net.trials(name)]
    report = run_trials(batch)
    assert report.held, report.text()

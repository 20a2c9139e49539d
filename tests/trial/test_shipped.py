"""What the shipped scenarios say of themselves holds."""

import trilat_net
from trilat_net.scenario import load, shipped
from trilat_net.trial.running import run_trials


def test_every_shipped_scenario_expects_something_and_it_holds() -> None:
    assert all(load(name).expect.asks for name in shipped())
    batch = [trial for name in shipped() for trial in trilat_net.trials(name)]
    report = run_trials(batch)
    assert report.held, report.text()

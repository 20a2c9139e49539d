"""The laws that keep account of energy: what they observe under delays that vary; drivers agree; verify."""

import io

import numpy as np
import pytest

from tests.energy_runs import JITTER, LAWS, MOBILE, drawn, least_energy, pair, ticked
from tests.log_editing import opened
from tests.virtual_runs import sampled, trajectories
from trilat_net.execution import virtual
from trilat_net.execution.verify import verify
from trilat_net.scenario.describe import describe_law_conditions

SEEDS = [
    1,
    *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 51)),
]


@pytest.mark.parametrize(
    "law", ["tanks", *(pytest.param(law, marks=pytest.mark.long) for law in LAWS if law != "tanks")]
)
@pytest.mark.parametrize("seed", SEEDS)
def test_observed_energies_are_never_negative(law: str, seed: int) -> None:
    """Free and in contact, over a mobile network and over 0 to 400 ms with 10 % loss."""
    for link in (MOBILE, JITTER):
        for clamped in (False, True):
            scenario = pair(LAWS[law], clamped=clamped, duration_s=12.0, link=link, seed=seed)
            run = ticked(scenario, every=11)
            assert least_energy(run) >= -1e-9
            assert np.abs(run["s"].qd).max() < 5.0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "seeds",
    [range(2), pytest.param(range(2, 200), marks=pytest.mark.long)],
    ids=str,
)
def test_no_energy_is_negative_at_any_tick_of_drawn_runs(law: str, seeds: range) -> None:
    """Half lost, 4g, jitter; contact and pushes; ramps of dominance; drift compensation is on."""
    least = {seed: least_energy(ticked(drawn(law, seed))) for seed in seeds}
    assert {seed: one for seed, one in least.items() if one < -1e-9} == {}


@pytest.mark.parametrize("law", LAWS)
def test_compiled_and_per_tick_runs_agree_and_logs_verify(law: str) -> None:
    scenario = pair(LAWS[law], clamped=True, duration_s=1.6, link={**JITTER, "delay_ms": 200.0})
    run, last = trajectories(scenario), sampled(scenario, (1.6,))[:, -1]
    for n, name in enumerate(scenario.names):
        columns, site = scenario.layout(name).columns(), run.sites[name]
        assert np.abs(site.tau[-1]).max() > 0.0
        for field in ("q", "qd", "tau", "tau_x", "ch"):
            assert last[n, columns[field]].tolist() == getattr(site, field)[-1].tolist()
    stream = io.BytesIO()
    virtual.write_virtual_log(pair(LAWS[law], clamped=True, duration_s=0.3, link=MOBILE), stream)
    verdict = verify(opened(stream.getvalue()))
    assert verdict.passed
    assert verdict.identical == verdict.records == 600


@pytest.mark.parametrize("law", LAWS)
def test_a_scenario_says_what_its_law_rests_on(law: str) -> None:
    (line, *_) = describe_law_conditions(pair(LAWS[law], clamped=False, duration_s=1.0))
    assert line.startswith(f"condition of {law} at m")
    assert "holds: " in line
    assert "sufficient" in line

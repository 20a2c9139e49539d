"""Two layers on the unit arm: numbers of independent simulations. A tank there has the energy of both joints.

On the line q2 = q1 / 2 that is 1.25 times the energy of x: the level is 0.125 J for 0.1, filling 40 for 50.
"""

from typing import Any

import numpy as np
import pytest

from tests.energy_runs import JITTER, least_energy, pair, ticked
from tests.unit_arm import H50, hand, unit_scenario
from trilat_net.scenario.describe import describe_law_conditions

TANKS: dict[str, Any] = {"law": "tanks", "level_J": 0.125, "fill_nm_s_rad_J": 40.0}


@pytest.mark.long
def test_free_motion_of_a_layer_that_alone_diverges() -> None:
    run = ticked(pair(TANKS, clamped=False, duration_s=30.0), every=2)
    m, s = run["m"], run["s"]
    assert m.q[-1, 0] == pytest.approx(0.3, abs=5e-5)
    assert s.q[-1, 0] == pytest.approx(0.3, abs=5e-5)
    assert max(m.to_all.H.max(), s.to_all.H.max()) / 1.25 == pytest.approx(0.230, abs=5e-4)
    assert least_energy(run) >= -1e-15


def test_the_layer_alone_diverges() -> None:
    none, gains = (
        [0.0, 0.0],
        {"level_J": 0.1, "fill_nm_s_rad_J": 50.0, "packet_1_s": 10.0, "by_shares": False},
    )
    gains["acceleration_rad_s2"] = 100.0
    layer = {"K": [100.0, 100.0], "Kd": [2.0, 2.0], "d": none, "gravity": 1.0, "guarded": False}
    law = {"law": "trilat_net.laws.tanks:Tanks", **gains, **layer}
    scenario = unit_scenario({"m": {"hands": [H50]}, "s": {}}, law, duration_s=11.5)
    run = ticked(scenario, every=10)
    assert least_energy(run) < -1.0  # what it would have taken from a tank
    speed = np.maximum(*(np.abs(run[name].qd[:, 0]) for name in "ms"))
    assert 0.01 * (1 + np.argmax(speed > 999.0)) == pytest.approx(11.4, abs=0.05)


def test_contact_feels_as_the_layer_makes_it() -> None:
    m = ticked(pair(TANKS, clamped=True, duration_s=30.0), every=30000)["m"]
    assert abs(m.tau_x[-1, 0]) / m.q[-1, 0] == pytest.approx(90.909, abs=5e-4)


@pytest.mark.long
@pytest.mark.parametrize("by_shares", [False, True])
def test_any_shares_keep_tanks_from_being_overdrawn(by_shares: bool) -> None:
    """A ring in which each follows the next, as irreversible as can be."""
    ring = {"m1": {"m2": 1.0, "s": 0.0}, "m2": {"m1": 0.0, "s": 1.0}, "s": {"m1": 1.0, "m2": 0.0}}
    sites = {"m1": {"hands": [hand(0.3)]}, "m2": {}, "s": {}}
    law = {**TANKS, "by_shares": by_shares}
    for link in ({"preset": "4g"}, JITTER):
        scenario = unit_scenario(sites, law, duration_s=20.0, dominance=ring, link=link)
        run = ticked(scenario, every=7)
        assert least_energy(run) >= -1e-9
        assert np.abs(run["s"].q[-1, 0] - 0.3) < 0.02


def test_a_tank_sends_no_more_than_it_has() -> None:
    lines = describe_law_conditions(pair({**TANKS, "packet_1_s": 2000.0}, clamped=False, duration_s=1.0))
    assert "does not hold: a tank sends 2 of its energy a tick" in lines[0]

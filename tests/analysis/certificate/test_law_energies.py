"""Energies of the built-in laws that keep account of it, as the certificate books them from records alone."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.energy_runs import CONSTANT, FOLLOWER, JITTER, LAWS, pair
from tests.unit_arm import hand, unit_scenario
from trilat_net.analysis.certificate.observed_energy import ObservedFinding, observe_energies
from trilat_net.analysis.certificate.stability_certificate import certify
from trilat_net.execution.virtual import simulate_scenario
from trilat_net.log.log_reader import Log
from trilat_net.reporting.figures.registry import figure
from trilat_net.scenario import load_scenario


@cache
def run(law: str) -> Log:
    """A clamped slave, 200 ms each way."""
    return simulate_scenario(pair(LAWS[law], clamped=True, duration_s=3.0))


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_energy_of_lines_observers_and_tanks_is_never_below_zero(law: str) -> None:
    log = run(law)
    found = observe_energies(log)
    assert found.finding is ObservedFinding.PASSIVE
    assert all(premise.holds for premise in found.premises)
    assert found.residual_j <= 1e-12 * found.largest_j
    assert {one.name for one in found.least} >= {"line m->s", "line s->m", "store of s", "taken by s"}
    given = next(one for one in found.curves if one.name == "given by m")
    work = -(log["m"].tau[:-1] * np.diff(log["m"].q, axis=0)).sum()
    assert given.energy_j[-1] == pytest.approx(work, rel=1e-9)
    assert work > 0.05


@pytest.mark.long
def test_a_figure_shows_them_over_time() -> None:
    drawn = figure(run("wave"), "observed_energy")
    lines, known, stored, given = drawn.axes
    assert len(lines.lines) == len(known.lines) == len(stored.lines) == 2
    assert len(given.lines) == 4


@pytest.mark.long
def test_jolt_beyond_reserve_leaves_observer_negative_and_certificate_says_so() -> None:
    """Sites that start apart; the reserve of a scenario that names none covers that."""
    changes = {"control.law": "tdpa", "scheme": "digital", "duration_s": 1.0, "sites.s.q0_rad": [0.8, 0.5]}
    changes |= {"sites.m.control.K": 0.0, "sites.m.control.B": 0.0}
    covered = certify(simulate_scenario(load_scenario("two_sites", changes)))
    assert covered.observed.finding is ObservedFinding.PASSIVE
    found = certify(simulate_scenario(load_scenario("two_sites", {**changes, "control.reserve_J": 0.0})))
    assert found.observed.finding is ObservedFinding.NEGATIVE
    known = next(one for one in found.observed.least if one.name == "known at s of m")
    assert known.amount_j < -1e-7
    assert found.observed.text in found.reasons


@pytest.mark.long
def test_the_leaders_velocity_makes_energy_at_a_slower_follower() -> None:
    """As it is published: the follower's damper acts on a velocity at which it is not moved."""
    law = {**LAWS["tdpa"], "energy": "velocity", "reserve_J": 0.0, "acceleration_rad_s2": 0.0}
    log = simulate_scenario(pair(law, clamped=False, duration_s=4.0))
    found = observe_energies(log)
    taken = next(one for one in found.least if one.name == "taken by s")
    assert found.finding is ObservedFinding.NEGATIVE
    assert taken.amount_j < -1e-3


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_torque_that_the_limit_cuts_is_booked_as_cut(law: str) -> None:
    """The hand holds the master where its spring gives 1.5 N m."""
    limits = {"tau_limit_nm": 1.5, "qd_limit_rad_s": 1e3}
    log = simulate_scenario(pair(LAWS[law], clamped=True, duration_s=6.0, limits=limits))
    found = observe_energies(log)
    assert found.finding is ObservedFinding.PASSIVE
    assert next(one for one in found.premises if one.name == "torque").text.startswith("cut off at m")
    assert np.abs(log["m"].tau).max() == 1.5


@pytest.mark.long
@pytest.mark.parametrize("law", ["wave", pytest.param("tdpa", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "link", [pytest.param(CONSTANT, id="constant", marks=pytest.mark.long), pytest.param(JITTER, id="jitter")]
)
def test_torques_with_weights_keep_the_weighted_energy(law: str, link: dict[str, Any]) -> None:
    shares = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.4, "s": 0.6}, "s": {"m1": 0.8, "m2": 0.2}}
    control = {**LAWS[law], **FOLLOWER}
    sites = {"m1": {"hands": [hand(0.3)]}, "m2": {"hands": [hand(-0.3)]}, "s": {}}
    for name, beta in (("m2", 0.5), ("s", 1.5)):
        sites[name]["control"] = {**control, "beta": beta}
    scenario = unit_scenario(sites, control, duration_s=8.0, dominance=shares, link=link)
    found = observe_energies(simulate_scenario(scenario))
    assert found.finding is ObservedFinding.PASSIVE
    assert all(premise.holds for premise in found.premises)

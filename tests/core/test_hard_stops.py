"""Stops and faults of fast arms, against the equations of docs/theory/coming-to-rest.md."""

import numpy as np
import pytest

import trilat_net
from tests.core.hard_stops import (
    RATES_NM_S,
    RULE,
    SWINGS,
    Stop,
    draw_stops,
    measure_stop,
    run_stop,
)
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.scenario import load_scenario
from trilat_net.scenario.rest_bounds import find_rest_bounds

FAST = {"limits.qd_limit_rad_s": 200.0, "control.law": "pd_d", **SWINGS}


def assert_all_hold(stops: list[Stop]) -> None:
    beyond = [stop for stop in stops if not stop.holds]
    assert not beyond, "\n".join(map(str, beyond[:5]))


@pytest.mark.long
def test_drawn_stops_keep_their_bounds() -> None:
    """`python -m tests.core.hard_stops` measures 3000; the numbers are in docs/theory/coming-to-rest.md."""
    assert_all_hold(list(draw_stops(7, 300)))


@pytest.mark.long
def test_drawn_faults_keep_their_bounds() -> None:
    assert_all_hold(list(draw_stops(7, 60, faults=True)))


@pytest.mark.parametrize("rate_nm_s", RATES_NM_S[1:])
def test_no_stop_adds_energy_to_a_swinging_arm(rate_nm_s: float) -> None:
    """Eq.

    (5), at speeds to 50 rad/s: a law that swings up because of its delay was stopped at its
    fastest.
    """
    keys = {"duration_s": 1.6, **RULE, **FAST, "limits.tau_rate_limit_nm_s": rate_nm_s}
    log = trilat_net.simulate(load_scenario("free", keys))
    for site in log.scenario.names:
        part = log[site]
        speed = np.abs(part.qd).max(axis=1)
        for wanted in (4.0, 16.0, 40.0):
            if speed.max() < wanted:
                continue
            at = int(np.argmax(speed >= wanted))
            before, last = (part.states[row].to_tick_record(part.peers) for row in (at - 1, at))
            records = run_stop(log.scenario, site, before, last)
            stop = measure_stop(log.scenario, site, 8.0, f"{site} at {at}", last, records)
            assert stop.energy <= 1.05, stop
            assert stop.rest_s < 2.5, stop


@pytest.mark.parametrize("law", [("pd_d", 600.0, 1.0, 50.0), ("p_d", 200.0, 0.2, 200.0)])
def test_a_fault_at_sixty_rad_s_loses_energy(law: tuple[str, float, float, float]) -> None:
    """With 300 N m/s such arms sped up to 168 rad/s over 62 rad, and had twice the energy."""
    name, stiffness, damping, delay_ms = law
    keys = {
        "duration_s": 4.0,
        **RULE,
        "control.law": name,
        "control.K": stiffness,
        "control.d": damping,
        "link": {"delay_ms": delay_ms},
        "limits.qd_limit_rad_s": 60.0,
        "limits.tau_rate_limit_nm_s": 300.0,
    }
    log = trilat_net.simulate(load_scenario("free", keys))
    judged = 0
    for site, part in log.items():
        faults = np.flatnonzero(part.mode == "fault")
        if not len(faults):
            continue
        first = int(faults[0])
        rows = build_arm_rows(log.scenario, site)
        q = part.q[first:]
        qd = part.qd[first:]
        kinetic_j = 0.5 * (qd * rows.multiply_inertia(q, qd)).sum(axis=1)
        bounds = find_rest_bounds(log.scenario, site)
        assert kinetic_j.max() <= kinetic_j[0] + bounds.blend_j
        assert (np.abs(qd).max(axis=0) <= bounds.peak_rad_s).all()
        judged += 1
    assert judged


def test_stated_energies_are_those_of_the_equations() -> None:
    """Eq. (5) to (7) of the arms of `free`: point masses of 1 kg at the ends of links of 1 m."""
    bounds = find_rest_bounds(load_scenario("free", RULE), "s")
    rest = load_scenario("free", RULE).setup("s").rest
    assert bounds.blend_j == pytest.approx(sum(0.5e-3 * 200.0**2 / B for B in rest.damping))
    assert bounds.kinetic_j == pytest.approx(0.5 * (5.0 + 2.0 * 2.0 + 1.0) * 7.5**2)
    mobility = np.array([1.0, 5.0])  # of M^-1, stretched and folded
    peaks = np.sqrt(2.0 * mobility * (bounds.kinetic_j + bounds.blend_j))
    assert bounds.peak_rad_s == pytest.approx(peaks)
    gravity_nm = 9.81 * 3.0
    assert bounds.bearable_share == pytest.approx(np.sqrt((200.0 - gravity_nm) / 3.0) / 7.5)

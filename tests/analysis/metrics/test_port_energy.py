"""Energies: what the ports gave is in the arm, to the order of the scheme."""

import math

import numpy as np
import pytest

from tests.analysis.logs import rewritten
from tests.theory.delay_equations import inertia, theta_of
from trilat_net.analysis.metrics.log_metrics import compute_log_metrics
from trilat_net.analysis.metrics.port_energy import held_work, trapezoid_work

from .written import pair, simulated, under


def test_work_of_spring_is_exact_and_independent_of_way() -> None:
    """int -K q dq = K (q_0^2 - q_1^2) / 2."""
    q = np.cumsum(np.random.default_rng(1).normal(size=(50, 2)), axis=0)
    K = np.array([3.0, 7.0])
    assert trapezoid_work(-K * q, q).sum() == pytest.approx(0.5 * float((K * (q[0] ** 2 - q[-1] ** 2)).sum()))


def test_work_of_torque_that_is_held_is_torque_times_way() -> None:
    q = np.array([[0.0, 1.0], [0.5, 1.0], [0.25, 3.0]])
    assert held_work(np.array([[2.0, 9.0], [4.0, 1.0]]), q).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
def test_ports_make_up_the_mechanical_energy_to_second_order(scheme: str) -> None:
    """1/2 qd'M qd + U grows by what controller and hands give; the held torque's work is exact."""
    rests = []
    for rate_hz in (100, 200):
        log = simulated("paper", {"duration_s": 3.0, "rate_hz": rate_hz, "scheme": scheme})
        found = compute_log_metrics(log).sites
        for site in log.sites:
            change = _mechanical(log, site)
            assert found[site]["mechanical_j"].value == pytest.approx(change[-1] - change[0], abs=1e-9)
        rests.append(found["m1"]["unaccounted_j"].value)
    assert rests[0] < 1e-3
    assert math.log2(rests[0] / rests[1]) == pytest.approx(2.0, abs=0.3)


def _mechanical(log, site: str):
    spec, part = log.scenario.sites[site], log[site]
    theta = theta_of(spec.arm)
    kinetic = 0.5 * np.einsum("ki,kij,kj->k", part.qd, inertia(theta, part.q), part.qd)
    q1, q12 = part.q[:, 0], part.q.sum(axis=1)
    return kinetic + spec.arm.g_m_s2 * (theta[3] * np.sin(q1) + theta[4] * np.sin(q12))


def test_a_lossless_wall_gives_back_no_more_than_it_took() -> None:
    found = compute_log_metrics(
        simulated("contact", {"duration_s": 6.0, "link.delay_ms": 20.0, "rate_hz": 250})
    ).sites["s"]
    assert found["walls_j"].value <= 0.0
    assert found["walls_most_j"].value <= 1e-6
    # what is missing is in the spring: F^2 / 2 K at its last force of 3.3 N
    assert found["walls_j"].value == pytest.approx(-(3.3**2) / 4000.0, rel=0.1)


def test_a_damper_takes_what_the_formula_says() -> None:
    """int B (A w cos w t)^2 dt = B A^2 w^2 / 2 times the time, to second order of the period."""
    A, w, B = 0.2, 2.0 * math.pi, 4.0

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        qd = A * w * math.cos(w * t_s)
        push = B * qd if site == "s" else 0.0
        return {"q": [A * math.sin(w * t_s), 0.0], "qd": [qd, 0.0], "tau_x": [push, 0.0]}

    more = 'environment = [{ kind = "viscous", damping_nm_s_rad = 4.0 }]'
    log = pair(motion, more=more)
    spent = B * A**2 * w**2 / 2.0 * log["s"].t_s[-1]
    found = compute_log_metrics(log).sites["s"]
    assert found["walls_j"].value == pytest.approx(-spent, rel=2e-3)
    assert found["walls_most_j"].value == 0.0
    assert found["hands_j"].value == pytest.approx(0.0, abs=1e-9)


def test_periods_without_both_records_are_left_out() -> None:
    def motion(_: str, t_s: float) -> dict[str, list[float]]:
        return {"q": [t_s, 0.0], "qd": [1.0, 0.0], "tau": [2.0, 0.0], "tau_x": [0.0, 0.0]}

    whole = pair(motion)
    torn = rewritten(whole, lambda state: not (state.site == "m" and 100 <= state.tick < 200))
    assert compute_log_metrics(whole).sites["m"]["controller_j"].value == pytest.approx(2.0 * 799 / 200)
    assert compute_log_metrics(torn).sites["m"]["controller_j"].value == pytest.approx(
        2.0 * (799 - 101) / 200
    )


def test_an_unknown_arm_has_no_mechanical_energy() -> None:
    """What the ports gave is known all the same; an arm outside of the program was told tau."""
    log = simulated("free", {"duration_s": 1.0, "rate_hz": 100})
    outside = under(log, {"sites.s.plant": "external", "sites.s.arm.known": False})
    found, before = (compute_log_metrics(one).sites["s"] for one in (outside, log))
    assert found["mechanical_j"].value is None
    assert found["mechanical_j"].why == "theta of the arm is not known"
    part = log["s"]
    expected = float(np.trapezoid((part.tau * part.qd).sum(axis=1), part.t_s))
    assert found["controller_j"].value == pytest.approx(expected, rel=1e-2)
    assert before["mechanical_j"].value is not None

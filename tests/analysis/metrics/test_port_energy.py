"""Energies: the energy through the ports is in the arm, to the order of the scheme.

The energy that a delay gives.
"""

import math

import numpy as np
import pytest

from tests.analysis.builders import make_pair_log, make_run
from tests.log.builders import replace_scenario, rewrite_log
from tests.theory.delay_equations import inertia, regressor, theta_of
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.metrics.port_energy import held_work, trapezoid_work
from trilat_net.scenario.arms import build_arm


def test_work_of_springs_is_exact_path_independent() -> None:
    """int -K q dq = K (q_0^2 - q_1^2) / 2."""
    q = np.cumsum(np.random.default_rng(1).normal(size=(50, 2)), axis=0)
    K = np.array([3.0, 7.0])
    assert trapezoid_work(-K * q, q).sum() == pytest.approx(
        0.5 * float((K * (q[0] ** 2 - q[-1] ** 2)).sum())
    )


def test_held_torques_work_is_torque_times_path() -> None:
    q = np.array([[0.0, 1.0], [0.5, 1.0], [0.25, 3.0]])
    assert held_work(np.array([[2.0, 9.0], [4.0, 1.0]]), q).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
def test_ports_balance_mechanical_energy_to_second_order(scheme: str) -> None:
    """1/2 qd'M qd + U grows by the energy of controller and hands; the held torque's work is exact."""
    rests = []
    for rate_hz in (100, 200):
        log = make_run("paper", {"duration_s": 3.0, "rate_hz": rate_hz, "scheme": scheme}).log
        sites = LogMetrics.of_log(log).sites
        for site in log.sites:
            change = _mechanical(log, site)
            assert sites[site]["mechanical_j"].value == pytest.approx(
                change[-1] - change[0], abs=1e-9
            )
        rests.append(sites["m1"]["unaccounted_j"].value)
    assert rests[0] < 1e-3
    assert math.log2(rests[0] / rests[1]) == pytest.approx(2.0, abs=0.3)


def _mechanical(log, site: str):
    spec = log.scenario.sites[site]
    part = log[site]
    theta = theta_of(spec.arm)
    kinetic = 0.5 * np.einsum("ki,kij,kj->k", part.qd, inertia(theta, part.q), part.qd)
    q1 = part.q[:, 0]
    q12 = part.q.sum(axis=1)
    return kinetic + spec.arm.g_m_s2 * (theta[3] * np.sin(q1) + theta[4] * np.sin(q12))


def test_lossless_walls_return_at_most_their_energy() -> None:
    metrics = LogMetrics.of_log(
        make_run("contact", {"duration_s": 6.0, "link.delay_ms": 20.0, "rate_hz": 250}).log
    ).sites["s"]
    assert metrics["walls_j"].value <= 0.0
    assert metrics["walls_most_j"].value <= 1e-6
    # what is missing is in the spring: F^2 / 2 K at its last force of 3.3 N
    assert metrics["walls_j"].value == pytest.approx(-(3.3**2) / 4000.0, rel=0.1)


def test_a_damper_dissipates_by_the_formula() -> None:
    """int B (A w cos w t)^2 dt = B A^2 w^2 / 2 times the time, to second order of the period."""
    A = 0.2
    w = 2.0 * math.pi
    B = 4.0

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        qd = A * w * math.cos(w * t_s)
        push = B * qd if site == "s" else 0.0
        return {"q": [A * math.sin(w * t_s), 0.0], "qd": [qd, 0.0], "tau_x": [push, 0.0]}

    more = 'environment = [{ kind = "viscous", damping_nm_s_rad = 4.0 }]'
    log = make_pair_log(motion, more=more)
    spent = B * A**2 * w**2 / 2.0 * log["s"].t_s[-1]
    figures = LogMetrics.of_log(log).sites["s"]
    assert figures["walls_j"].value == pytest.approx(-spent, rel=2e-3)
    assert figures["walls_most_j"].value == 0.0
    assert figures["hands_j"].value == pytest.approx(0.0, abs=1e-9)


def test_periods_without_both_records_are_left_out() -> None:
    def motion(_: str, t_s: float) -> dict[str, list[float]]:
        return {"q": [t_s, 0.0], "qd": [1.0, 0.0], "tau": [2.0, 0.0], "tau_x": [0.0, 0.0]}

    whole = make_pair_log(motion)
    torn = rewrite_log(whole, lambda state: not (state.site == "m" and 100 <= state.tick < 200))
    assert LogMetrics.of_log(whole).sites["m"]["controller_j"].value == pytest.approx(
        2.0 * 799 / 200
    )
    assert LogMetrics.of_log(torn).sites["m"]["controller_j"].value == pytest.approx(
        2.0 * (799 - 101) / 200
    )


def test_an_unknown_arm_has_no_mechanical_energy() -> None:
    """The energy through the ports is known all the same; an external arm was given tau."""
    log = make_run("free", {"duration_s": 1.0, "rate_hz": 100}).log
    outside = replace_scenario(log, {"sites.s.plant": "external", "sites.s.arm.known": False})
    outside_figures, before = (
        LogMetrics.of_log(measured_log).sites["s"] for measured_log in (outside, log)
    )
    assert outside_figures["mechanical_j"].value is None
    assert outside_figures["mechanical_j"].why == "theta of the arm is not known"
    part = log["s"]
    expected = float(np.trapezoid((part.tau * part.qd).sum(axis=1), part.t_s))
    assert outside_figures["controller_j"].value == pytest.approx(expected, rel=1e-2)
    assert before["mechanical_j"].value is not None


@pytest.mark.parametrize("distance", [1.0, -1.0])
def test_the_energy_of_a_delay_between_sinusoids(distance: float) -> None:
    """int qd K (q_j(t - T) - q_j(t)) dt = -K A_i A_j pi sin(w T) a second at w = 2 pi.

    Arms that move against each other are given energy, arms that move together lose it.
    """
    A = 0.2
    w = 2.0 * math.pi
    K = 10.0
    delay_s = 0.05

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        sign = distance if site == "s" else 1.0
        wave = {
            "q": [sign * A * math.sin(w * t_s), 0.0],
            "qd": [sign * A * w * math.cos(w * t_s), 0.0],
        }
        return {**wave, "tau": [0.0, 0.0], "tau_x": [0.0, 0.0]}

    seconds = 10.0
    figures = LogMetrics.of_log(make_pair_log(motion, seconds=seconds)).links["m->s"]
    # until the first sample comes the peer is at its start pose
    begun = 0.5 * w * delay_s / math.pi
    expected = -distance * K * A**2 * math.pi * math.sin(w * delay_s) * (seconds - begun)
    assert figures["delay_j"].value == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("law", ["pd_d", "adaptive", "p_d"])
def test_delay_energy_is_the_ports_excess(law: str) -> None:
    """The controller's energy less that of all delays is that of the same law fed with present peers."""
    log = make_run("asymmetric", {"duration_s": 2.0, "rate_hz": 250, "control.law": law}).log
    metrics = LogMetrics.of_log(log)
    largest = 0.0
    for site in log.sites:
        part = log[site]
        spec = log.scenario.sites[site]
        shares = log.scenario.dominance[site]
        e, ed = (
            getattr(part, name)
            - sum(share * getattr(log[peer], name) for peer, share in shares.items())
            for name in ("q", "qd")
        )
        torque = LAWS[law](spec, part, e, ed)
        prompt = float(np.trapezoid((torque * part.qd).sum(axis=1), part.t_s))
        late = sum(
            metrics.links[f"{peer}->{site}"]["delay_j"].value for peer in shares if shares[peer]
        )
        controller_j = metrics.sites[site]["controller_j"].value
        scale = float(np.trapezoid(np.abs((torque * part.qd).sum(axis=1)), part.t_s))
        assert prompt + late == pytest.approx(controller_j, abs=2e-4 * scale)
        largest = max(largest, abs(late) / scale)
    assert largest > 5e-3  # and that is no small part


def _pd(spec, part, e, ed):
    theta = build_arm(spec.arm, spec.task, {}, chains=False).theta
    gravity = _regressed(spec, part, 0.0 * e, 0.0 * e, theta * spec.control.gravity)
    Kd = np.array(getattr(spec.control, "Kd", (0.0, 0.0)))
    return gravity - np.array(spec.control.K) * e - Kd * ed - np.array(spec.control.d) * part.qd


def _adaptive(spec, part, e, ed):
    Lambda, Kp, Kd = (np.array(getattr(spec.control, name)) for name in ("Lambda", "Kp", "Kd"))
    learnt = _regressed(spec, part, -Lambda * e, -Lambda * ed, part.theta_hat)
    return learnt - Kp * (part.qd + Lambda * e) - Kd * ed


def _regressed(spec, part, v, a, theta):
    Y = regressor(spec.arm.g_m_s2, part.q, part.qd, v, a)
    return np.einsum("kij,kj->ki", Y, np.broadcast_to(theta, (len(Y), 5)))


LAWS = {"pd_d": _pd, "p_d": _pd, "adaptive": _adaptive}


def test_force_reflection_counts_only_late_force() -> None:
    """If the slave meets no wall, no force is late, and the master's law sees nothing of its peer."""
    calm = make_run(
        "contact", {"duration_s": 3.0, "rate_hz": 200, "sites.s.environment": []}
    ).log
    assert LogMetrics.of_log(calm).links["s->m"]["delay_j"].value == 0.0
    pushed = make_run("contact", {"duration_s": 3.0, "rate_hz": 200}).log
    assert LogMetrics.of_log(pushed).links["s->m"]["delay_most_j"].value > 0.0


def test_a_users_own_law_is_not_judged() -> None:
    log = make_run(
        "free", {"duration_s": 0.2, "rate_hz": 100, "control.law": "tests.laws:Adaptive"}
    ).log
    said = LogMetrics.of_log(log).links["m1->s"]["delay_j"]
    assert said.value is None
    assert "tests.laws:Adaptive does not say which part" in said.why

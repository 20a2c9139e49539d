"""The energy that a delay gives."""

import math

import numpy as np
import pytest

from tests.theory.delay_equations import regressor
from trilat_net.analysis.metrics.log_metrics import compute_log_metrics

from .written import pair, simulated


@pytest.mark.parametrize("apart", [1.0, -1.0])
def test_the_energy_of_a_delay_between_sinusoids(apart: float) -> None:
    """int qd K (q_j(t - T) - q_j(t)) dt = -K A_i A_j pi sin(w T) a second at w = 2 pi.

    Arms that move against each other are given energy, arms that move together lose it.
    """
    A, w, K, delay_s = 0.2, 2.0 * math.pi, 10.0, 0.05

    def motion(site: str, t_s: float) -> dict[str, list[float]]:
        sign = apart if site == "s" else 1.0
        wave = {"q": [sign * A * math.sin(w * t_s), 0.0], "qd": [sign * A * w * math.cos(w * t_s), 0.0]}
        return {**wave, "tau": [0.0, 0.0], "tau_x": [0.0, 0.0]}

    seconds = 10.0
    found = compute_log_metrics(pair(motion, seconds=seconds)).links["m->s"]
    # until the first sample comes the peer is at its start pose
    begun = 0.5 * w * delay_s / math.pi
    expected = -apart * K * A**2 * math.pi * math.sin(w * delay_s) * (seconds - begun)
    assert found["delay_j"].value == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("law", ["pd_d", "adaptive", "p_d"])
def test_delays_are_what_port_has_beyond_law_without_them(law: str) -> None:
    """The controller's energy less that of all delays is that of the same law fed with present peers."""
    log = simulated("asymmetric", {"duration_s": 2.0, "rate_hz": 250, "control.law": law})
    found, largest = compute_log_metrics(log), 0.0
    for site in log.sites:
        part, spec = log[site], log.scenario.sites[site]
        shares = log.scenario.dominance[site]
        e, ed = (
            getattr(part, name) - sum(share * getattr(log[peer], name) for peer, share in shares.items())
            for name in ("q", "qd")
        )
        torque = LAWS[law](spec, part, e, ed)
        prompt = float(np.trapezoid((torque * part.qd).sum(axis=1), part.t_s))
        late = sum(found.links[f"{peer}->{site}"]["delay_j"].value for peer in shares if shares[peer])
        given = found.sites[site]["controller_j"].value
        scale = float(np.trapezoid(np.abs((torque * part.qd).sum(axis=1)), part.t_s))
        assert prompt + late == pytest.approx(given, abs=2e-4 * scale)
        largest = max(largest, abs(late) / scale)
    assert largest > 5e-3  # and that is no small part


def _pd(spec, part, e, ed):
    gravity = _regressed(spec, part, 0.0 * e, 0.0 * e, spec.arm.theta * spec.control.gravity)
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


def test_direct_force_reflection_counts_the_force_that_comes_late() -> None:
    """Where the slave meets no wall, no force is late, and the master's law sees nothing of its peer."""
    calm = simulated("contact", {"duration_s": 3.0, "rate_hz": 200, "sites.s.environment": []})
    assert compute_log_metrics(calm).links["s->m"]["delay_j"].value == 0.0
    pushed = simulated("contact", {"duration_s": 3.0, "rate_hz": 200})
    assert compute_log_metrics(pushed).links["s->m"]["delay_most_j"].value > 0.0


def test_a_law_of_somebodys_own_is_not_judged() -> None:
    log = simulated("free", {"duration_s": 0.2, "rate_hz": 100, "control.law": "tests.laws:Adaptive"})
    said = compute_log_metrics(log).links["m1->s"]["delay_j"]
    assert said.value is None
    assert "somebody's own" in said.why

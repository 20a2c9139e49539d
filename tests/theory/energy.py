"""The corrected Lyapunov functional along a virtual run, and the power that must balance it.

The paper's Eq. (17) is wrong in a sign and a factor; corrected, with Kd common to all sites,

    V_i' = -r'Kp r - 1/2 sum_j a_ij |qd_i - qd_j(t - T_ij)|^2 - 1/2 |qd_i|^2
             + 1/2 sum_j a_ij |qd_j|^2 + r'tau_h

with |x|^2 = x'Kd x. Weighted with the left null vector of Upsilon, Eq. (20), the last two norms cancel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.execution.builders import Trajectories, make_shipped_trajectories
from tests.theory.delay_equations import DURATION_S, inertia, theta_of

Array = NDArray[np.float64]


def integrate(values: Array, h: float) -> Array:
    """Returns the integral from the first tick on, by the trapezoid rule on the ticks."""
    return np.concatenate([[0.0], np.cumsum(0.5 * h * (values[1:] + values[:-1]))])


def delay_values(values: Array, ticks: int, before: float = 0.0) -> Array:
    """Returns the values `ticks` ago; before the start, those of the history."""
    past = np.full_like(values, before)
    past[ticks:] = values[: len(values) - ticks] if ticks else values
    return past


@dataclass(frozen=True)
class Balance:
    """V, the dissipation and the work of the hands, each over the ticks and weighted by beta."""

    V: Array
    taken: Array
    given: Array

    @property
    def residual(self) -> float:
        """Largest error of the balance, as a share of the largest V."""
        return float(np.abs(self.V - self.V[0] + self.taken - self.given).max() / self.V.max())


def left_null_vector(scenario) -> Array:
    """Returns beta of Eq. (20) from NumPy's singular vectors, sum 1."""
    names = list(scenario.sites)
    alpha = np.array([[scenario.dominance[i].get(j, 0.0) for j in names] for i in names])
    beta = np.linalg.svd((alpha - np.eye(len(names))).T)[2][-1]
    return beta / beta.sum()


def compute_balance(run: Trajectories, beta: Array) -> Balance:
    """Computes the balance of a run whose sites share one rate."""
    scenario = run.scenario
    names = list(scenario.sites)
    rate_hz = scenario.sites[names[0]].rate_hz
    h = 1.0 / rate_hz
    V = 0.0
    dissipated = 0.0
    supplied = 0.0
    for weight, name in zip(beta, names, strict=True):
        site = run.sites[name]
        spec = scenario.sites[name]
        theta = theta_of(spec.arm)
        control = spec.control
        Lambda, Kp, Kd = (np.array(getattr(control, gain)) for gain in ("Lambda", "Kp", "Kd"))
        e = site.q - site.q_des
        r = site.qd + Lambda * e
        off = site.theta_hat - theta
        v = np.einsum("ki,kij,kj->k", r, inertia(theta, site.q), r)
        v += (off**2 / np.array(control.Gamma)).sum(1) + (Lambda * Kd * e**2).sum(1)
        loss = (Kp * r**2).sum(1)
        for peer, share in scenario.dominance[name].items():
            qd = run.sites[peer].qd
            ticks = round(scenario.links[f"{peer}->{name}"].delay_ms * 1e-3 * rate_hz)
            norm = integrate((Kd * qd**2).sum(1), h)
            v += share * (norm - delay_values(norm, ticks))
            delayed_speeds = np.stack(
                [delay_values(qd[:, joint], ticks) for joint in (0, 1)], axis=1
            )
            loss += 0.5 * share * (Kd * (site.qd - delayed_speeds) ** 2).sum(1)
        V = V + weight * 0.5 * v
        dissipated = dissipated + weight * integrate(loss, h)
        supplied = supplied + weight * integrate((r * -site.tau_x).sum(1), h)
    return Balance(np.asarray(V), np.asarray(dissipated), np.asarray(supplied))


def compute_shipped_balance(
    name: str, scheme: str = "second_order", rate_hz: int = 1000
) -> Balance:
    """Returns the balance of a shipped scenario."""
    trajectory_of_run = make_shipped_trajectories(
        name, {"scheme": scheme, "rate_hz": rate_hz, "duration_s": DURATION_S}
    )
    return compute_balance(trajectory_of_run, left_null_vector(trajectory_of_run.scenario))


def measure_order(name: str, scheme: str, rate_hz: int) -> float:
    """Returns the order of the balance's error from half of a rate to that rate."""
    coarse = compute_shipped_balance(name, scheme, rate_hz // 2).residual
    fine = compute_shipped_balance(name, scheme, rate_hz).residual
    return float(np.log2(coarse / fine))

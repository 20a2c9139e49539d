"""The delay-differential equations of the paper, written from the paper and solved by another
method.

Nothing is imported from `trilat_net.core`: SciPy's DOP853 with dense output, by the method of
steps.
"""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.execution.builders import sample_records
from trilat_net.scenario import load_scenario

Array = NDArray[np.float64]
DURATION_S = 20.0
TIMES_S = np.arange(0.01, DURATION_S, 0.01)


def theta_of(arm) -> Array:
    """Eq. (24), with m2 lc2 for theta_5."""
    m1 = arm.m1_kg
    m2 = arm.m2_kg
    l1 = arm.l1_m
    lc1 = arm.lc1_m
    lc2 = arm.lc2_m
    outer = m2 * lc2**2 + arm.I2_kg_m2
    return np.array(
        [
            m1 * lc1**2 + m2 * l1**2 + arm.I1_kg_m2 + outer,
            m2 * l1 * lc2,
            outer,
            m1 * lc1 + m2 * l1,
            m2 * lc2,
        ]
    )


def inertia(theta: Array, q: Array) -> Array:
    """M(q) for q of shape (..., 2), as Section IV prints it."""
    c2 = np.cos(q[..., 1])
    m12 = theta[2] + theta[1] * c2
    rows = [theta[0] + 2 * theta[1] * c2, m12, m12, theta[2] + 0 * c2]
    return np.stack(rows, axis=-1).reshape(*q.shape[:-1], 2, 2)


def regressor(g: float, q: Array, qd: Array, v: Array, a: Array) -> Array:
    """Returns Y(q, qd, v, a) of Eq. (12), shape (..., 2, 5): C multiplies v."""
    c2 = np.cos(q[..., 1])
    s2 = np.sin(q[..., 1])
    g1 = g * np.cos(q[..., 0])
    g12 = g * np.cos(q[..., 0] + q[..., 1])
    v1 = v[..., 0]
    v2 = v[..., 1]
    a1 = a[..., 0]
    a2 = a[..., 1]
    d1 = qd[..., 0]
    d2 = qd[..., 1]
    zero = np.zeros_like(c2)
    y12 = c2 * (2 * a1 + a2) - s2 * (d2 * v1 + (d1 + d2) * v2)
    y22 = c2 * a1 + s2 * d1 * v1
    entries = [a1, y12, a2, g1, g12, zero, y22, a1 + a2, zero, g12]
    return np.stack(entries, axis=-1).reshape(*q.shape[:-1], 2, 5)


@dataclass
class DelayEquations:
    """Eq. (6), (8)-(10), (13), (15) for identical arms and gains, and one delay on every link."""

    theta: Array
    g: float
    alpha: Array
    delay_s: float
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    q0: Array
    hands: Callable[[float], Array]
    edges_s: list[float] = field(default_factory=list)
    tolerance: float = 1e-11
    starts: list[float] = field(default_factory=list)
    pieces: list[Callable[[float], Array]] = field(default_factory=list)

    @property
    def joints(self) -> int:
        return self.q0.shape[1]

    @property
    def width(self) -> int:
        """Length of a site's state: q, qd and theta_hat."""
        return 2 * self.joints + len(self.theta)

    def past(self, t: float) -> Array:
        """Returns the state at t, shape (N, width); before the start the start pose, at rest."""
        if t <= 0 or not self.pieces:
            return np.hstack([self.q0, np.zeros((len(self.q0), self.width - self.joints))])
        return self.pieces[bisect_right(self.starts, t) - 1](t).reshape(-1, self.width)

    def rate(self, t: float, flat: Array) -> Array:
        x = flat.reshape(-1, self.width)
        n = self.joints
        q = x[:, :n]
        qd = x[:, n : 2 * n]
        estimate = x[:, 2 * n :]
        before = x if self.delay_s == 0 else self.past(t - self.delay_s)
        e = q - self.alpha @ before[:, :n]
        ed = qd - self.alpha @ before[:, n : 2 * n]
        r = qd + self.Lambda * e
        qdd, gradient = self.accelerate(q, qd, e, ed, r, estimate, self.hands(t))
        return np.hstack([qd, qdd, -self.Gamma * gradient]).ravel()

    def accelerate(
        self, q: Array, qd: Array, e: Array, ed: Array, r: Array, estimate: Array, pushed: Array
    ) -> tuple[Array, Array]:
        """Returns the accelerations under the law's torque and the operators', and Y'r, of the
        planar arm.
        """
        Y = regressor(self.g, q, qd, -self.Lambda * e, -self.Lambda * ed)
        tau = (Y @ estimate[..., None])[..., 0] - self.Kp * r - self.Kd * ed
        # C qd + G, Eq. (5)
        forces = regressor(self.g, q, qd, qd, np.zeros_like(qd)) @ self.theta
        left = tau + pushed - forces
        qdd = np.linalg.solve(inertia(self.theta, q), left[..., None])[..., 0]
        return qdd, (Y.swapaxes(1, 2) @ r[..., None])[..., 0]

    def solve(self, end_s: float) -> "DelayEquations":
        """Solves by the method of steps: one piece per delay, and no piece across an edge of a pulse."""
        step = self.delay_s or 0.2
        steps = np.arange(1, round(end_s / step) + 1) * step
        cuts = sorted(
            {round(float(t), 9) for t in [*steps, *self.edges_s, end_s] if 0 < t <= end_s}
        )
        x = self.past(-1.0).ravel()
        t = 0.0
        for cut in cuts:
            accuracy = {"rtol": self.tolerance, "atol": 0.1 * self.tolerance}
            done = solve_ivp(self.rate, (t, cut), x, "DOP853", dense_output=True, **accuracy)
            assert done.success
            self.starts.append(t)
            self.pieces.append(done.sol)
            x = done.y[:, -1]
            t = cut
        return self

    def at(self, times: Array) -> Array:
        """Returns states at sorted times, shape (N, K, width)."""
        piece = np.searchsorted(self.starts, times, side="right") - 1
        parts = [self.pieces[p](times[piece == p]) for p in np.unique(piece)]
        return np.hstack(parts).reshape(len(self.q0), self.width, -1).swapaxes(1, 2)


def make_equations(scenario) -> DelayEquations:
    """Returns the equations of a scenario whose arms, gains and delays are all alike."""
    specs = list(scenario.sites.values())
    assert all((spec.arm, spec.control) == (specs[0].arm, specs[0].control) for spec in specs)
    arm = specs[0].arm
    return DelayEquations(theta=theta_of(arm), g=arm.g_m_s2, **common_terms(scenario))


def common_terms(scenario) -> dict[str, Any]:
    """Returns the terms of the equations that do not depend on the arms of a scenario."""
    specs = list(scenario.sites.values())
    (delay_ms,) = {link.delay_ms for link in scenario.links.values()}
    control = specs[0].control

    def hands(t: float) -> Array:
        total = np.zeros((len(specs), len(specs[0].q0_rad)))
        for i, spec in enumerate(specs):
            for p in spec.hands:
                if p.start_s < t < p.end_s:
                    height = np.sin(np.pi * (t - p.start_s) / (p.end_s - p.start_s)) ** 2
                    total[i] += np.array(p.peak_nm) * height
        return total

    return {
        "alpha": np.array(
            [
                [scenario.dominance[i].get(j, 0.0) for j in scenario.sites]
                for i in scenario.sites
            ]
        ),
        "delay_s": delay_ms * 1e-3,
        "Lambda": np.array(control.Lambda),
        "Kp": np.array(control.Kp),
        "Kd": np.array(control.Kd),
        "Gamma": np.array(control.Gamma),
        "q0": np.array([s.q0_rad for s in specs]),
        "hands": hands,
        "edges_s": [edge for s in specs for p in s.hands for edge in (p.start_s, p.end_s)],
    }


@cache
def solve_exactly(name: str) -> DelayEquations:
    """Returns the exact solution of a shipped scenario."""
    return make_equations(load_scenario(name)).solve(DURATION_S)


@cache
def measure_distance(name: str, scheme: str, rate_hz: int) -> float:
    """Returns max abs(dq) over 20 s, every site and joint, a tick every 10 ms."""
    trajectory_at_times = sample_records(
        load_scenario(name, {"scheme": scheme, "rate_hz": rate_hz}), TIMES_S
    )
    return float(
        np.abs(
            trajectory_at_times[..., :2]
            - solve_exactly(name).at(TIMES_S - 1.0 / rate_hz)[..., :2]
        ).max()
    )


def measure_orders(name: str, scheme: str) -> list[float]:
    """Returns the orders of the distance from 500 Hz to 1 kHz, and from there to 2 kHz."""
    errors = [measure_distance(name, scheme, rate_hz) for rate_hz in (500, 1000, 2000)]
    return [float(np.log2(coarse / fine)) for coarse, fine in pairwise(errors)]

"""Loops made by hand, and sites of every law, for tests of linear analysis."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilat_net.analysis.theory.linear_loop import DelayedTerm, LinearLoop
from trilat_net.core.arms.exogenous import TorqueKind, TorqueSource
from trilat_net.core.arms.two_link_arm import ArmLinks
from trilat_net.core.step.site_setup import Gains, Law, SiteSetup

Array = NDArray[np.float64]

RODS = {"arm.lc1_m": 0.5, "arm.lc2_m": 0.5, "arm.I1_kg_m2": 1 / 12, "arm.I2_kg_m2": 1 / 12}


def make_loop(A: Any, *delayed: tuple[float, Any]) -> LinearLoop:
    """Returns x' = A x + sum A_k x(t - T_k), without operators."""
    matrix = np.atleast_2d(np.asarray(A, dtype=float))
    n = len(matrix)
    entries = [
        DelayedTerm(T, np.atleast_2d(np.asarray(Ad, dtype=float)), np.zeros((n, 0)))
        for T, Ad in delayed
    ]
    names = tuple(f"x.q{i}" for i in range(n))
    return LinearLoop(names, (), (), matrix, np.zeros((n, 0)), np.zeros((0, n)), tuple(entries))


def compute_residual(system: LinearLoop, s: complex) -> float:
    """Returns the smallest singular value of Delta(s) over the size of its terms, from the definition."""
    delta = s * np.eye(len(system.A)) - system.A
    size = abs(s) + np.linalg.norm(system.A)
    for delayed in system.delayed:
        late = delayed.A * np.exp(-s * delayed.delay_s)
        delta = delta - late
        size = size + np.linalg.norm(late)
    return float(np.linalg.svd(delta, compute_uv=False)[-1] / size)


def roots_within(system: LinearLoop, low: complex, high: complex, points: int = 4000) -> int:
    """Counts the roots in a rectangle by the turns of det Delta about 0 along its sides."""
    corners = [low, complex(high.real, low.imag), high, complex(low.real, high.imag), low]
    path = np.concatenate(
        [
            a + (b - a) * np.linspace(0, 1, points, endpoint=False)
            for a, b in itertools.pairwise(corners)
        ]
    )
    delta = path[:, None, None] * np.eye(len(system.A)) - system.A
    for delayed in system.delayed:
        delta = delta - delayed.A * np.exp(-path * delayed.delay_s)[:, None, None]
    phase = np.unwrap(np.angle(np.linalg.det(delta)))
    return round((phase[-1] - phase[0]) / (2 * np.pi))


GAINS = {
    "adaptive": lambda rng: Gains(
        Law.ADAPTIVE,
        *rng.uniform(0.5, 5, (3, 2)),
        Gamma=rng.uniform(0.1, 2, 5),
        theta_hat0=np.zeros(5),
    ),
    "known": lambda rng: Gains(
        Law.KNOWN,
        Kd=rng.uniform(0.5, 5, 2),
        known=rng.uniform(0.5, 2, 5),
        K=rng.uniform(1, 20, 2),
        d=rng.uniform(1, 5, 2),
        k_f=rng.uniform(0, 1, 2),
    ),
}


def draw_site(
    rng: np.random.Generator, law: str, actors: Sequence[TorqueSource] = ()
) -> SiteSetup:
    """Draws a site with a random physical arm and random gains."""
    l1, m1, l2, m2 = rng.uniform(0.5, 2, 4)
    links = ArmLinks(l1, m1, 0.6 * l1, m1 * l1**2 / 12, l2, m2, 0.4 * l2, m2 * l2**2 / 12)
    return SiteSetup(
        name="x",
        rate_hz=1000,
        digital=False,
        gains=GAINS[law](rng),
        theta=links.theta(),
        g_m_s2=9.81,
        lengths_m=(l1, l2),
        tau_limit_nm=1e300,
        qd_limit_rad_s=1e300,
        q0=(0.0, 0.0),
        qd0=(0.0, 0.0),
        actors=tuple(actors),
        links=(),
    )


def draw_actors(rng: np.random.Generator) -> list[TorqueSource]:
    """Draws one of each kind that depends on the arm: hands, an environment, and a wall that is
    touched or not.
    """
    turn = rng.uniform(0, 2 * np.pi)
    pairs = [tuple(rng.uniform(0.5, 20, 2)) for _ in range(8)]
    wall = {
        "a": tuple(rng.uniform(-1, 1, 2)),
        "b": (np.cos(turn), np.sin(turn)),
        "K": (50.0, 0.0),
        "B": (2.0, 0.0),
    }
    return [
        TorqueSource(TorqueKind.HAND, b=tuple(rng.uniform(-1, 1, 2)), K=pairs[0], B=pairs[1]),
        TorqueSource(
            TorqueKind.TASK_HAND, b=tuple(rng.uniform(-1, 1, 2)), K=pairs[2], B=pairs[3]
        ),
        TorqueSource(TorqueKind.VISCOUS, B=pairs[4], sampled=True),
        TorqueSource(TorqueKind.WALL, **wall),
        TorqueSource(
            TorqueKind.WALL, **{**wall, "b": (-wall["b"][0], -wall["b"][1])}, sampled=True
        ),
    ]

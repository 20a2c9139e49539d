"""One period of the arm, Eq. (8), against energy and against SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.integrate import solve_ivp

from tests.core import physical_arms as physics
from tests.core.physical_arms import Array, angles, speeds
from trilat_net.core.arms.exogenous import TorqueKind, TorqueSource, torque_source_rows
from trilat_net.core.arms.two_link_arm import ArmLinks
from trilat_net.core.arms.two_link_stages import rk4_step

ARM = ArmLinks(1.0, 1.1, 0.5, 0.09, 0.9, 0.8, 0.4, 0.05)
LENGTHS = np.array([1.0, 0.9])
G = 9.81


def advance_arm(
    q0: Array,
    qd0: Array,
    h_s: float,
    periods: int,
    u: Array,
    actors: tuple[TorqueSource, ...] = (),
) -> tuple[Array, Array]:
    q = (q0[0], q0[1])
    qd = (qd0[0], qd0[1])
    who = torque_source_rows(actors)
    for k in range(periods):
        q, qd = rk4_step(k * h_s, h_s, q, qd, u, ARM.theta(), G, LENGTHS, *who)
    return np.array(q), np.array(qd)


def compute_energy(q: Array, qd: Array) -> float:
    return physics.kinetic(ARM, q, qd) + float(physics.potential(ARM, G, q))


@settings(max_examples=30)
@given(q=angles, qd=physics.vectors(physics.st.floats(-3, 3)))
def test_an_arm_without_torque_keeps_its_energy(q: Array, qd: Array) -> None:
    assert compute_energy(*advance_arm(q, qd, 1e-3, 500, np.zeros(2))) == pytest.approx(
        compute_energy(q, qd), abs=1e-5
    )


PULSES = np.array([[-0.1, 0.35, 12.0, -5.0], [0.0, 0.3, 1.0, 2.0]])
HANDS = tuple(
    TorqueSource(TorqueKind.PULSE, start, end, a=tuple(peak))
    for start, end, *peak in PULSES.tolist()
)
SPAN_S = 0.1


def measure_errors(q: Array, qd: Array, u: Array, *periods: int) -> list[float]:
    """Returns the distance from a solution of Eq.

    (8) by another method, for each number of periods in the span.
    """

    def rate(t: float, x: Array) -> Array:
        hands = sum(p[2:] * np.sin(np.pi * (t - p[0]) / (p[1] - p[0])) ** 2 for p in PULSES)
        rest = (
            u
            + hands
            - physics.coriolis(ARM, x[:2], x[2:]) @ x[2:]
            - physics.gravity(ARM, G, x[:2])
        )
        return np.concatenate([x[2:], np.linalg.solve(physics.inertia(ARM, x[:2]), rest)])

    start = np.concatenate([q, qd])
    exact = solve_ivp(rate, (0.0, SPAN_S), start, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    ends = [np.concatenate(advance_arm(q, qd, SPAN_S / n, n, u, HANDS)) for n in periods]
    return [
        float(np.abs(end_state - exact).max() / (1 + np.abs(exact).max())) for end_state in ends
    ]


@settings(max_examples=10)
@given(q=angles, qd=speeds, u=physics.vectors(physics.st.floats(-50, 50)))
def test_motion_solves_the_equation_of_motion(q: Array, qd: Array, u: Array) -> None:
    assert measure_errors(q, qd, u, 400)[0] < 1e-6


@pytest.mark.push
def test_the_integrators_order_is_four() -> None:
    """The order holds for the median of many states, since leading terms may cancel in a single state."""
    chance = np.random.default_rng(4)
    orders = []
    for _ in range(25):
        coarse, fine = measure_errors(
            chance.uniform(-3, 3, 2),
            chance.uniform(-6, 6, 2),
            chance.uniform(-50, 50, 2),
            50,
            100,
        )
        orders.append(np.log2(coarse / fine))
    assert 3.8 < np.median(orders) < 4.2

"""External torques on an arm, Eq. (8), against closed forms, potentials and NumPy."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from tests.core.physical_arms import Array, angles, speeds
from trilat_net.core.arms.exogenous import (
    OWN_KINDS,
    TorqueKind,
    TorqueSource,
    minimum_jerk,
    torque_on_arm,
    torque_source_rows,
)
from trilat_net.scenario.operators import OwnActor
from trilat_net.scenario.operators.kernel_operators import Multisine

LENGTHS = np.array([1.0, 0.9])
STEP = 1e-6
Pair = tuple[float, float]
number = st.floats(-3, 3)
pairs = st.tuples(number, number)
stiff = st.tuples(st.floats(0, 50), st.floats(0, 50))


def compute_torque(
    t_s: float,
    q: Array,
    qd: Array,
    *actors: TorqueSource,
    sampled: bool = False,
    lengths: Array = LENGTHS,
) -> Array:
    return np.array(
        torque_on_arm(t_s, q, qd, lengths, *torque_source_rows(actors), int(sampled))[:2]
    )


def compute_tip(q: Array) -> Array:
    """Returns the position of the tip, by complex numbers."""
    z = LENGTHS[0] * np.exp(1j * q[0]) + LENGTHS[1] * np.exp(1j * (q[0] + q[1]))
    return np.array([z.real, z.imag])


def differentiate_down(potential, q: Array) -> Array:
    """Returns minus the gradient of a potential, by central differences."""
    steps = np.eye(2) * STEP
    return np.array(
        [(potential(q - step) - potential(q + step)) / (2 * STEP) for step in steps]
    )


def zero_speed(q: Array) -> Array:
    return np.zeros_like(q)


def test_pulses_are_symmetric_and_zero_outside() -> None:
    pulse = TorqueSource(TorqueKind.PULSE, 1.0, 6.0, a=(10.0, -4.0))

    def at(t_s: float) -> list[float]:
        return compute_torque(t_s, np.zeros(2), np.zeros(2), pulse).tolist()

    assert at(0.5) == at(1.0) == at(6.0) == at(7.0) == [0.0, 0.0]
    assert at(3.5) == pytest.approx([10.0, -4.0])
    assert at(2.25) == pytest.approx([5.0, -2.0])
    assert at(1.7) == pytest.approx(at(5.3))


@given(q=angles, qd=speeds, t_s=st.floats(0, 4))
def test_external_torques_add_up(q: Array, qd: Array, t_s: float) -> None:
    actors = (
        TorqueSource(TorqueKind.PULSE, 1.0, 6.0, a=(10.0, -4.0)),
        TorqueSource(
            TorqueKind.HAND,
            K=(3.0, 4.0),
            B=(1.0, 0.5),
            a=(0.1, 0.2),
            b=(0.4, -0.2),
            move_end_s=2.0,
        ),
        TorqueSource(
            TorqueKind.TASK_HAND,
            K=(30.0, 4.0),
            B=(1.0, 5.0),
            a=(0.1, 0.2),
            b=(0.4, -0.2),
            move_end_s=2.0,
        ),
        TorqueSource(TorqueKind.VISCOUS, B=(2.0, 3.0)),
        TorqueSource(TorqueKind.WALL, K=(100.0, 0.0), a=(0.5, 0.0), b=(-1.0, 0.0)),
    )
    torque_sum = sum(compute_torque(t_s, q, qd, actor) for actor in actors)
    assert compute_torque(t_s, q, qd, *actors) == pytest.approx(torque_sum, abs=1e-9)


@given(q=angles, K=stiff, target=pairs)
def test_a_resting_hand_is_a_spring(q: Array, K: Pair, target: Pair) -> None:
    """Its torque is the negative gradient of its energy 1/2 K (q - target)^2."""
    hand = TorqueSource(TorqueKind.HAND, K=K, a=target, b=target)

    def potential(at: Array) -> float:
        return float(0.5 * np.array(K) @ (at - target) ** 2)

    assert compute_torque(1.0, q, zero_speed(q), hand) == pytest.approx(
        differentiate_down(potential, q), abs=1e-5
    )


@given(q=angles, K=stiff, target=pairs)
def test_hand_at_tip_is_spring_in_plane(q: Array, K: Pair, target: Pair) -> None:
    hand = TorqueSource(TorqueKind.TASK_HAND, K=K, a=target, b=target)

    def potential(at: Array) -> float:
        return float(0.5 * np.array(K) @ (compute_tip(at) - target) ** 2)

    assert compute_torque(1.0, q, zero_speed(q), hand) == pytest.approx(
        differentiate_down(potential, q), abs=1e-4
    )


@given(q=angles, K=st.floats(0, 1000), point=pairs, direction=st.floats(-4, 4))
def test_a_wall_is_a_spring_on_one_side(
    q: Array, K: float, point: Pair, direction: float
) -> None:
    normal = (math.cos(direction), math.sin(direction))
    wall = TorqueSource(TorqueKind.WALL, K=(K, 0.0), a=point, b=normal)

    def potential(at: Array) -> float:
        return float(0.5 * K * max(0.0, (np.array(point) - compute_tip(at)) @ normal) ** 2)

    expected = differentiate_down(potential, q)
    assert compute_torque(1.0, q, zero_speed(q), wall) == pytest.approx(
        expected, abs=1e-3 * (1 + np.abs(expected).max())
    )


@given(
    q=angles, qd=speeds, K=st.floats(0, 1000), B=st.floats(0, 1000), direction=st.floats(-4, 4)
)
def test_a_wall_never_pulls(q: Array, qd: Array, K: float, B: float, direction: float) -> None:
    """Whatever its damping, the wall's force points along its normal, or is zero."""
    normal = np.array([math.cos(direction), math.sin(direction)])
    pushed = compute_torque(
        1.0,
        q,
        qd,
        TorqueSource(TorqueKind.WALL, K=(K, 0.0), B=(B, 0.0), a=(0.3, 0.2), b=tuple(normal)),
    )
    # the torque of a force of 1 N along the normal
    unit = differentiate_down(lambda at: -float(compute_tip(at) @ normal), q)
    assert pushed @ unit >= -1e-6 * (1 + np.abs(pushed).max())


@given(q=angles, qd=speeds, B=stiff)
def test_viscous_elements_dissipate_in_any_motion(q: Array, qd: Array, B: Pair) -> None:
    assert compute_torque(1.0, q, qd, TorqueSource(TorqueKind.VISCOUS, B=B)) == pytest.approx(
        -np.array(B) * qd
    )


@given(start=st.floats(-5, 5), length=st.floats(0.01, 5), x=st.floats(0, 1))
def test_a_move_has_minimum_jerk(start: float, length: float, x: float) -> None:
    """The motion is the polynomial of fifth order that begins and ends at rest without acceleration."""
    way = minimum_jerk(start + x * length, start, start + length)
    conditions = np.zeros((6, 6))
    for row, (at, derivative) in enumerate((at, d) for at in (0.0, 1.0) for d in range(3)):
        for power in range(derivative, 6):
            factor = math.perm(power, derivative)
            conditions[row, power] = factor * at ** (power - derivative)
    polynomial = np.linalg.solve(conditions, [0, 0, 0, 1, 0, 0])
    assert way[0] == pytest.approx(np.polyval(polynomial[::-1], x), abs=1e-6)
    assert way[1] * length == pytest.approx(
        np.polyval(np.polyder(polynomial[::-1]), x), abs=1e-5
    )


def test_targets_stand_still_outside_their_move() -> None:
    hand = TorqueSource(
        TorqueKind.HAND,
        K=(1.0, 1.0),
        B=(7.0, 7.0),
        a=(1.0, 2.0),
        b=(3.0, 5.0),
        move_start_s=1,
        move_end_s=2,
    )
    rest = np.zeros(2)
    assert compute_torque(0.5, rest, rest, hand).tolist() == [1.0, 2.0]
    assert compute_torque(2.5, rest, rest, hand).tolist() == [3.0, 5.0]


@given(
    rows=st.lists(
        st.tuples(st.floats(0, 10), number, number),
        min_size=1,
        max_size=20,
        unique_by=lambda r: r[0],
    ),
    t_s=st.floats(-1, 11),
)
def test_recorded_torque_is_linear_between_its_points(
    rows: list[tuple[float, ...]], t_s: float
) -> None:
    table = np.array(sorted(rows))
    torques = compute_torque(
        t_s, np.zeros(2), np.zeros(2), TorqueSource(TorqueKind.RECORDED, table=table)
    )
    nothing = {"left": 0.0, "right": 0.0}
    expected = [np.interp(t_s, table[:, 0], table[:, 1 + i], **nothing) for i in (0, 1)]
    assert torques == pytest.approx(expected, abs=1e-9)


@given(t_s=st.floats(2.0, 20.0), ends=st.tuples(st.floats(0.1, 20.0), st.floats(0.1, 20.0)))
def test_chirps_sweep_their_frequencies_evenly_and_repeat(
    t_s: float, ends: tuple[float, float]
) -> None:
    """The torque equals SciPy's chirp, which repeats."""
    source = TorqueSource(TorqueKind.CHIRP, 2.0, 30.0, 2.0, 6.0, (3.0, -1.0), ends)
    sine = signal.chirp((t_s - 2.0) % 4.0, ends[0], 4.0, ends[1], phi=-90)
    torques = compute_torque(t_s, np.zeros(2), np.zeros(2), source)
    assert torques == pytest.approx([3.0 * sine, -sine], abs=1e-6)


def test_a_multisine_has_only_its_lines() -> None:
    """The spectrum over a period has only the given lines, and the peak is far below the sum of the amplitudes."""
    hz = (0.5, 0.75, 1.0, 2.5, 4.0, 7.0, 7.25, 9.0)
    source = Multisine(amplitude_nm=(2.0, 0.0), frequencies_hz=hz, start_s=1.0).actor
    t_s = 1.0 + np.arange(400) / 100.0
    torques = np.array([compute_torque(t, np.zeros(2), np.zeros(2), source)[0] for t in t_s])
    amplitude = 2.0 * np.abs(np.fft.rfft(torques)) / len(torques)
    expected = np.where(np.isin(np.arange(201) / 4.0, hz), 2.0, 0.0)
    assert amplitude == pytest.approx(expected, abs=1e-9)
    assert np.abs(torques).max() < 0.75 * 2.0 * len(hz)
    given_phases = Multisine(
        amplitude_nm=(1.0, 1.0), frequencies_hz=(2.0,), phases_rad=(0.5,)
    ).actor
    assert compute_torque(0.1, np.zeros(2), np.zeros(2), given_phases)[0] == pytest.approx(
        math.sin(0.4 * math.pi + 0.5)
    )


def test_sampled_and_continuous_torques_are_separate() -> None:
    rest = np.zeros(2)
    torque_source = TorqueSource(TorqueKind.PULSE, 0.0, 2.0, a=(1.0, 1.0), sampled=True)
    other = TorqueSource(TorqueKind.PULSE, 0.0, 2.0, a=(5.0, 5.0))
    assert compute_torque(1.0, rest, rest, torque_source, other).tolist() == [5.0, 5.0]
    assert compute_torque(1.0, rest, rest, torque_source, other, sampled=True).tolist() == [
        1.0,
        1.0,
    ]


class ConstantEffort(OwnActor, frozen=True, tag="constant_effort"):
    def act(self, now: Any) -> None:
        for i in range(now.coordinates):
            now.effort[i] = 1.0


@pytest.mark.parametrize("acts", list(TorqueKind))
def test_no_torque_acts_outside_its_time(acts: TorqueKind) -> None:
    table = np.array([[0.0, 1.2, 1.0], [9.0, 1.0, 1.0]])
    vectors = {"a": (1.0, 0.0), "b": (-1.0, 0.0), "K": (9.0, 9.0), "B": (1.0, 1.0)}
    model = ConstantEffort() if acts in OWN_KINDS else None
    actor = TorqueSource(
        acts, 2.0, 3.0, move_end_s=0.7, **vectors, table=table, grip=1.0, model=model
    )
    q = np.array([0.1, 0.2])
    qd = np.array([0.3, -0.2])
    for t_s in (1.9, 3.0, 4.0):
        assert compute_torque(t_s, q, qd, actor).tolist() == [0.0, 0.0]
    assert compute_torque(2.5, q, qd, actor).any()


@pytest.mark.parametrize(("acts", "like"), [("LIVE_TIP", "TASK_HAND"), ("LIVE_JOINT", "HAND")])
def test_live_hands_are_springs_with_limits(acts: str, like: str) -> None:
    """The force is scaled by the grip; beyond the limit its direction stays and its size is the limit."""
    q = np.array([0.1, 0.2])
    qd = np.zeros(2)
    vectors = {"a": (1.2, 0.3), "b": (1.2, 0.3), "K": (50.0, 50.0), "B": (4.0, 4.0)}
    spring = compute_torque(1.0, q, qd, TorqueSource(TorqueKind[like], **vectors))
    half = compute_torque(1.0, q, qd, TorqueSource(TorqueKind[acts], **vectors, grip=0.5))
    np.testing.assert_allclose(half, 0.5 * spring, rtol=1e-14)
    limited = compute_torque(
        1.0, q, qd, TorqueSource(TorqueKind[acts], **vectors, grip=1.0, limit=2.0)
    )
    at = compute_tip(q) if acts == "LIVE_TIP" else q
    np.testing.assert_allclose(
        limited, spring * 2.0 / (50.0 * np.hypot(*(vectors["a"] - at))), rtol=1e-12
    )

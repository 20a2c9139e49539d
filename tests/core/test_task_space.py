"""Following in task space: kinematics against SciPy and finite differences, and the identities of the law."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.core.builders import PLACE, POSE, make_task_arrays
from trilat_net.core.arms.chain import place_joints
from trilat_net.core.arms.rotation import (
    angular_velocity,
    arctan,
    relative_rotation,
    rotation_matrix,
    rotation_vector,
    rotation_vector_rate,
)
from trilat_net.core.arms.task_space import update_pose, update_task_errors, update_wrench
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.core.step.site_setup import TaskSetup
from trilat_net.core.step.vectors import Array, Row

vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
seeds = st.integers(0, 2**32 - 1)


tasks = pytest.mark.parametrize("task", [PLACE, POSE], ids=["place", "pose"])


def place_row(arrays: SiteArrays, q: Array, qd: Array) -> Row:
    """Returns the site's row with its end effector placed in a state."""
    s: Row = arrays.site[0]
    s.q = q
    s.qd = qd
    place_joints(arrays.chain, s.q)
    update_pose(s, arrays.chain)
    return s


def draw_state(seed: int) -> tuple[SiteArrays, Array, Array]:
    rng = np.random.default_rng(seed)
    arrays = make_task_arrays(POSE if seed % 2 else PLACE)
    q = arrays.site[0].q + rng.normal(0.0, 0.2, 7)
    return arrays, q, rng.normal(0.0, 0.5, 7)


@given(vector=vectors)
def test_rotations_are_those_of_scipy(vector: tuple[float, float, float]) -> None:
    wanted = Rotation.from_rotvec(vector)
    rows = rotation_matrix(vector)
    assert np.abs(np.array(rows) - wanted.as_matrix()).max() <= 1e-14
    turned_back = Rotation.from_rotvec(rotation_vector(rows)) * wanted.inv()
    assert turned_back.magnitude() <= 1e-14
    assert (
        np.abs(np.array(relative_rotation(rows, rotation_matrix((0.0, 0.0, 0.0))))).max()
        <= np.pi
    )


@given(vector=vectors, rate=vectors, shorter=st.sampled_from([1.0, 1e-2, 3e-3, 1e-3, 1e-6]))
@example(vector=(0.6, -0.5, 0.4), rate=(0.3, 0.9, -0.7), shorter=1e-2)
def test_turn_velocities_are_limits_of_differences(
    vector: tuple[float, float, float], rate: tuple[float, float, float], shorter: float
) -> None:
    turn = (shorter * vector[0], shorter * vector[1], shorter * vector[2])
    after, before = (
        Rotation.from_rotvec(np.array(turn) + h * np.array(rate)) for h in (1e-5, -1e-5)
    )
    velocity = angular_velocity(turn, rate)
    assert np.array(velocity) == pytest.approx(
        (after * before.inv()).as_rotvec() / 2e-5, abs=1e-8
    )
    assert rotation_vector_rate(turn, velocity) == pytest.approx(rate, abs=1e-11)


@given(x=st.floats(0.0, 1.0))
def test_the_arc_tangent_is_that_of_numpy(x: float) -> None:
    assert arctan(x) == pytest.approx(np.arctan(x), abs=3e-16)


@given(seed=seeds)
def test_velocities_and_jacobian_rates_are_limits(seed: int) -> None:
    arrays, q, qd = draw_state(seed)
    h = 1e-6
    m = arrays.site[0].shared
    before, after = (
        np.array(place_row(arrays, q + sign * h * qd, qd).J) for sign in (-1.0, 1.0)
    )
    row = place_row(arrays, q, qd)
    assert np.abs((after - before) / (2 * h) - row.Jd).max() <= 1e-7
    low, high = (np.array(place_row(arrays, q + sign * h * qd, qd).x) for sign in (-1.0, 1.0))
    xd = np.array(place_row(arrays, q, qd).xd)
    assert np.abs((high - low)[:3] / (2 * h) - xd[:3]).max() <= 1e-7
    if m == 6:
        turn = Rotation.from_rotvec(high[3:]) * Rotation.from_rotvec(low[3:]).inv()
        assert np.abs(turn.as_rotvec() / (2 * h) - xd[3:]).max() <= 1e-7


@given(seed=seeds)
def test_r_follows_the_task_in_any_posture(seed: int) -> None:
    """J r = x' + Lambda e wherever no axis is damped."""
    arrays, q, qd = draw_state(seed)
    s = place_row(arrays, q, qd)
    s.q_des = np.array(s.x) + 0.01
    s.qd_des = 0.02
    update_task_errors(s)
    assert np.abs(s.J @ s.r - (s.xd + s.Lambda * s.e)).max() <= 1e-9


@tasks
def test_reference_acceleration_differentiates_reference_velocity(
    task: TaskSetup,
) -> None:
    """Along a motion whose reference stands still: v shortly before and after, and a between them."""
    arrays = make_task_arrays(task)
    q = np.array(arrays.site[0].q)
    h = 1e-6
    qd = np.linspace(-0.3, 0.4, 7)
    x = np.array(place_row(arrays, q, qd).x)
    x[:3] += 0.05
    errors = []
    for sign in (-1.0, 0.0, 1.0):
        s = place_row(arrays, q + sign * h * qd, qd)
        s.q_des = x
        s.qd_des = 0.0
        update_task_errors(s)
        errors.append((np.array(s.v), np.array(s.a)))
    rate = (errors[2][0] - errors[0][0]) / (2 * h)
    if task is PLACE:
        assert np.abs(rate - errors[1][1]).max() <= 1e-6
    else:  # the orientation's error is linear in the turn only near 0, where it is here
        assert np.abs(rate - errors[1][1]).max() <= 1e-5


def test_damping_begins_below_its_singular_value() -> None:
    arrays = make_task_arrays(PLACE._replace(singular_value=1e-6))
    straight = make_task_arrays(PLACE._replace(singular_value=0.5))
    q = np.array(arrays.site[0].q)
    qd = np.zeros(7)
    for posed, damped in ((arrays, False), (straight, True)):
        s = place_row(posed, q, qd)
        s.q_des = np.array(s.x) - 0.1
        update_task_errors(s)
        left = np.abs(s.J @ s.v + s.Lambda * s.e).max()
        assert (left > 1e-3) == damped, left


@given(seed=seeds)
def test_the_wrench_is_the_end_effectors_force(seed: int) -> None:
    arrays, q, qd = draw_state(seed)
    s = place_row(arrays, q, qd)
    s.q_des = s.x
    update_task_errors(s)
    force = np.arange(1.0, 1.0 + s.shared)
    s.on_arm = -s.J.T @ force
    update_wrench(s)
    assert s.wrench == pytest.approx(force, rel=1e-6)


def test_free_axes_get_no_torque() -> None:
    arrays = make_task_arrays(PLACE._replace(axes=(1.0, 0.0, 1.0)))
    s = place_row(arrays, np.array(arrays.site[0].q), np.zeros(7))
    s.q_des = np.array(s.x) + np.array([0.0, 0.3, 0.0])
    update_task_errors(s)
    assert np.abs(s.v).max() == 0.0
    assert np.abs(s.e).max() == 0.0

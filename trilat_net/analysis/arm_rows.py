"""Inertia, torque, energy and end effector of an arm, over all rows of a log at once.

Invariant: of the planar arm written from Section IV and Eq. (12) of the paper, independently of
the core that ran the log; of a chain by the core's leaves, which the tests compare with
Pinocchio: a kinetic term or a gradient is one recursion. Both have the same functions, and
hardly anything else asks which arm it is.

Torques determine some linear combinations of a chain's ten parameters a link and nothing of the
rest, however it moves; adaptation moves estimates along the former alone. An error of estimates
is stated in those combinations. Which they are follows from the geometry: QR of regressors of
many states, stacked, column by column: a column that depends on those before it adds nothing,
and its parameter joins theirs.

Source: M. Gautier, "Numerical calculation of the base inertial parameters of robots", J.
Robotic Systems 8 (1991), for the QR; P. M. Wensing, S. Kim, J.-J. Slotine, "Linear matrix
inequalities for physically consistent inertial parameter identification", IEEE Robotics and
Automation Letters 3 (2018), for the pseudo-inertia.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.chain import (
    COULOMB_SPEED,
    LINK_PARAMETERS,
    MAX_JOINTS,
    build_chain,
    dot,
    inverse_dynamics,
    parameter_gradient,
    place_end_effector,
    place_joints,
    propagate_motion,
    rotate,
    three,
)
from ..core.jit import leaf
from ..core.site_setup import ChainSetup, TaskSetup
from ..core.two_link_arm import JOINTS, forward_kinematics
from ..core.vectors import Array, Row, RowArray
from ..scenario import Scenario
from ..scenario.arms import ArmModel

HANGING_RAD = 0.3
"""A link within this of straight down hangs."""
_NO_WEIGHT_J = 1e-6
"""An arm whose energy in the field of gravity varies by less cannot hang."""
_ENERGY_SWEEPS = 20

Numbers = NDArray[Any]
"""Real numbers, or complex ones for a derivative by complex step.

Vectors have their components on the first axis and any number of columns behind it: shape (n,)
or (n, B).
"""


def multiply_columns(matrix: Numbers, vector: Numbers) -> Numbers:
    """Returns the product of a matrix, shape (a, b, ...), and a vector, shape (b, ...)."""
    product: Numbers = np.einsum("ab...,b...->a...", matrix, vector)
    return product


def solve_columns(A: Numbers, b: Numbers) -> Numbers:
    """Returns the solutions of A y = b, shapes (m, m, ...) and (m, ...)."""
    solved = np.linalg.solve(
        np.moveaxis(A, (0, 1), (-2, -1)), np.moveaxis(b, 0, -1)[..., np.newaxis]
    )
    return np.moveaxis(solved[..., 0], -1, 0)


@dataclass(frozen=True)
class PlacedArm:
    """The planar arm in the poses q, analytic in every argument: a complex step gives exact
    derivatives.

    "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty", Eq.
    (1)-(5), (24). `theory.textbook_arm.PlacedChain` has the same methods.

    Attributes:
        g_m_s2: gravitational acceleration, m/s^2.
        lengths_m: of the two links.
        q: shape (2, ...), rad.
    """

    g_m_s2: float
    lengths_m: tuple[float, float]
    q: Numbers

    def inertia_matrix(self, theta: Numbers) -> Numbers:
        """Returns M(q), shape (2, 2, ...), kg m^2, for the parameters theta, shape (5, ...)."""
        bend = theta[1] * np.cos(self.q[1])
        coupling = theta[2] + bend
        return np.array(
            [[theta[0] + 2.0 * bend, coupling], [coupling, theta[2] + 0.0 * coupling]]
        )

    def coriolis_matrix(self, theta: Numbers, qd: Numbers) -> Numbers:
        """Returns C(q, qd) by Christoffel symbols, shape (2, 2, ...), kg m^2/s."""
        h = -theta[1] * np.sin(self.q[1])
        return np.array([[h * qd[1], h * (qd[0] + qd[1])], [-h * qd[0], 0.0 * h * qd[0]]])

    def gravity_torque(self, theta: Numbers) -> Numbers:
        """Returns G(q), shape (2, ...), N m."""
        outer = theta[4] * self.g_m_s2 * np.cos(self.q[0] + self.q[1])
        return np.array([theta[3] * self.g_m_s2 * np.cos(self.q[0]) + outer, outer])

    def required_torque(self, theta: Numbers, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns M(q) a + C(q, qd) v + G(q), shape (2, ...), N m: Y theta of Eq. (12)."""
        moving = multiply_columns(self.coriolis_matrix(theta, qd), v)
        return (
            multiply_columns(self.inertia_matrix(theta), a)
            + moving
            + self.gravity_torque(theta)
        )

    def regressor_matrix(self, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns Y(q, qd, v, a), shape (2, 5, ...), Eq. (12): column p is the torque of theta
        = e_p.
        """
        units = np.multiply.outer(np.eye(5), np.ones(self.q.shape[1:]))
        return np.stack([self.required_torque(unit, qd, v, a) for unit in units], axis=1)

    def friction_torque(self, v: Numbers) -> Numbers:
        """Returns zeros: this arm has no friction in its joints."""
        return 0.0 * v

    def joint_acceleration(self, theta: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
        """Returns qdd, shape (2, ...), rad/s^2: the solution of M qdd + C qd + G = torque, Eq.
        (8).
        """
        at_no_acceleration = self.required_torque(theta, qd, qd, np.zeros_like(qd))
        return solve_columns(self.inertia_matrix(theta), torque - at_no_acceleration)

    def end_effector_position(self) -> Numbers:
        """Returns the position of the end effector from the base, shape (2, ...), m."""
        (l1_m, l2_m) = self.lengths_m
        inner = self.q[0]
        outer = self.q[0] + self.q[1]
        x = l1_m * np.cos(inner) + l2_m * np.cos(outer)
        y = l1_m * np.sin(inner) + l2_m * np.sin(outer)
        return np.array([x, y])

    def position_jacobian(self) -> Numbers:
        """Returns the Jacobian of that position, shape (2, 2, ...), m/rad: rows x and y."""
        x, y = self.end_effector_position()
        outer = self.q[0] + self.q[1]
        return np.array(
            [[-y, -self.lengths_m[1] * np.sin(outer)], [x, self.lengths_m[1] * np.cos(outer)]]
        )


class EndEffectorRows(NamedTuple):
    """Position and velocity of the end effector, shape (K, 2), m and m/s; in space (K, 3).

    Attributes:
        J: its Jacobian, shape (K, 2, n), m/rad: rows x and y (and z), columns the joints.
    """

    position: Array
    speed: Array
    J: Array

    def find_force(self, torque: Array, least: float = 1e-15) -> Array:
        """Returns the least force that explains torques of shape (K, n), N m: shape (K, 2) or
        (K, 3), N.

        Directions in which the end effector moves less than `least` times the most are not told
        from none.
        """
        inverse = np.linalg.pinv(self.J.transpose(0, 2, 1), rcond=least)
        found: Array = np.einsum("kij,kj->ki", inverse, torque)
        return found


class PlanarArmRows(NamedTuple):
    """The planar two-link arm over rows; `ChainArmRows` has the same functions.

    Attributes:
        theta: its true parameters, Eq. (24), shape (5,).
        g: gravitational acceleration, m/s^2.
        lengths_m: of its two links.
    """

    theta: Array
    g: float
    lengths_m: tuple[float, float]

    @property
    def task(self) -> None:
        """None: it follows joint by joint."""
        return

    @property
    def gravity_parameters(self) -> NDArray[np.bool_]:
        """True for each parameter that the torque of gravity consists of: theta_4 and theta_5."""
        return np.arange(5) >= 3

    def place(self, q: Array) -> PlacedArm:
        """Returns the arm in the poses of all rows, which are the columns there."""
        return PlacedArm(self.g, self.lengths_m, q.T)

    def weightless(self) -> "PlanarArmRows":
        """Returns the same arm without gravity: its torque is linear in v and a."""
        return self._replace(g=0.0)

    def multiply_inertia(self, q: Array, x: Array) -> Array:
        """Returns M(q) x, shape (K, 2)."""
        return multiply_columns(self.place(q).inertia_matrix(self.theta), x.T).T

    def law_torque(self, theta_hat: Array, q: Array, qd: Array, v: Array, a: Array) -> Array:
        """Returns Y(q, qd, v, a) theta_hat of estimates of every row, shape (K, 5), as (K, 2),
        N m.
        """
        return self.place(q).required_torque(theta_hat.T, qd.T, v.T, a.T).T

    def gradient(self, q: Array, qd: Array, v: Array, a: Array, r: Array) -> Array:
        """Returns Y'r of r = qd - v, shape (K, 5)."""
        found: Array = np.einsum(
            "ijk,ki->kj", self.place(q).regressor_matrix(qd.T, v.T, a.T), r
        )
        return found

    def gravity_torque(self, q: Array) -> Array:
        """Returns G(q), shape (K, 2), N m."""
        return self.place(q).gravity_torque(self.theta).T

    def potential_energy(self, q: Array) -> Array:
        """Returns g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)), shape (K,), J."""
        height = self.theta[3] * np.sin(q[:, 0]) + self.theta[4] * np.sin(q[:, 0] + q[:, 1])
        energy: Array = self.g * height
        return energy

    def friction(self, speed: Array) -> Array:
        """Returns the torque that friction takes at joint speeds, shape (K, 2), N m: none."""
        return np.zeros_like(speed)

    def stop_torque(self, q: Array, qd: Array) -> Array:  # noqa: ARG002 - as of a chain
        """Returns the torque of its stops ON the joints, shape (K, 2), N m: it has none."""
        return np.zeros_like(q)

    def place_end_effector(self, q: Array, qd: Array) -> EndEffectorRows:
        """Returns the end effector in the plane."""
        arm = self.place(q)
        J = arm.position_jacobian()
        speed = multiply_columns(J, qd.T)
        return EndEffectorRows(arm.end_effector_position().T, speed.T, J.transpose(2, 0, 1))

    def hanging_angle(self, q: Array) -> float:
        """Returns how far from straight down the link is that hangs least, in one pose, shape
        (2,), rad.
        """
        return max(
            abs(math.remainder(angle + math.pi / 2.0, math.tau)) for angle in np.cumsum(q)
        )


@leaf
def _put_torques(
    chain: RowArray,
    theta: Array,
    gravity: Array,
    q: Array,
    qd: Array,
    v: Array,
    a: Array,
    torque: Array,
) -> None:
    """Writes M a + C(q, qd) v + G + armature a + friction(v) of every row, shape (K, n).

    Parameters theta of shape (K, 10 n), or (1, 10 n) for all rows.
    """
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        propagate_motion(chain=chain, gravity=gravity, qd=qd[k], v=v[k], a=a[k])
        inverse_dynamics(
            chain=chain,
            theta=theta[min(k, theta.shape[0] - 1)],
            v=v[k],
            a=a[k],
            torque=torque[k],
        )


@leaf
def _put_gradients(
    chain: RowArray, gravity: Array, q: Array, qd: Array, v: Array, a: Array, gradient: Array
) -> None:
    """Writes Y'r of every row, r = qd - v, shape (K, 10 n)."""
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        propagate_motion(chain=chain, gravity=gravity, qd=qd[k], v=v[k], a=a[k])
        parameter_gradient(chain, gradient[k])


@leaf
def _put_end_effectors(
    chain: RowArray,
    theta: Array,
    gravity: Array,
    tip: Array,
    q: Array,
    at: Array,
    J: Array,
    energy: Array,
) -> None:
    """Writes place, (K, 3), and Jacobian, (K, 6, n), of every row, and the links' potential
    energy, (K,), J.

    That energy is -g'(m p + R mc) of every link, p and R its place and orientation in the
    base's frame.
    """
    n = chain.shape[0]
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        at[k, 0], at[k, 1], at[k, 2] = place_end_effector(chain, tip)
        p_x = 0.0
        p_y = 0.0
        p_z = 0.0
        energy[k] = 0.0
        for i in range(n):
            row: Row = chain[i]
            step = three(row.p) if i == 0 else rotate(chain[i - 1].R_base, three(row.p))
            p_x = p_x + step[0]
            p_y = p_y + step[1]
            p_z = p_z + step[2]
            first = LINK_PARAMETERS * i
            mc = rotate(row.R_base, (theta[first + 1], theta[first + 2], theta[first + 3]))
            energy[k] -= theta[first] * dot(three(gravity), (p_x, p_y, p_z)) + dot(
                three(gravity), mc
            )
            for j in range(3):
                J[k, j, i] = row.J_lin[j]
                J[k, 3 + j, i] = row.J_ang[j]


class ChainArmRows(NamedTuple):
    """A chain of n joints over rows, by the core's recursions: what M, C and G are made of is
    theta.

    The inertia of its drives counts in M. The law knows friction and drives, so that its torque
    has them.

    Attributes:
        theta: its true parameters, shape (10 n,).
        chain: its joints, gravity and end effector.
    """

    theta: Array
    chain: ChainSetup

    @property
    def task(self) -> TaskSetup | None:
        """How it follows with its end effector; None: joint by joint."""
        return self.chain.task

    @property
    def gravity_parameters(self) -> NDArray[np.bool_]:
        """True for each parameter that the torque of gravity may consist of: m and m c of every
        link.
        """
        return np.arange(len(self.theta)) % LINK_PARAMETERS < 4

    @property
    def _rows(self) -> RowArray:
        return build_chain(self.chain.joints, MAX_JOINTS)

    def _column(self, name: str) -> Array:
        return np.array([getattr(joint, name) for joint in self.chain.joints])

    def _of_joints(self, **values: Any) -> "ChainArmRows":
        joints = tuple(joint._replace(**values) for joint in self.chain.joints)
        return self._replace(chain=self.chain._replace(joints=joints))

    def weightless(self) -> "ChainArmRows":
        """Returns the same chain without gravity and Coulomb friction: its torque is linear in
        v and a.
        """
        bare = self._of_joints(coulomb=0.0)
        return bare._replace(chain=bare.chain._replace(gravity_m_s2=(0.0, 0.0, 0.0)))

    def without_drives(self) -> "ChainArmRows":
        """Returns the same chain without armature and friction: its torque is linear in theta."""
        return self._of_joints(coulomb=0.0, viscous=0.0, armature_kg_m2=0.0)

    def multiply_inertia(self, q: Array, x: Array) -> Array:
        """Returns (M(q) + armature) x, shape (K, n): one recursion without speed and gravity."""
        still = np.zeros_like(q)
        return self.weightless().law_torque(self.theta[np.newaxis], q, still, still, x)

    def law_torque(self, theta_hat: Array, q: Array, qd: Array, v: Array, a: Array) -> Array:
        """Returns Y(q, qd, v, a) theta_hat + armature a + friction(v), shape (K, n), N m.

        Estimates of every row, shape (K, 10 n), or one for all, (1, 10 n).
        """
        torque = np.zeros_like(q)
        theta_hat, q, qd, v, a = map(np.ascontiguousarray, (theta_hat, q, qd, v, a))
        _put_torques(
            chain=self._rows,
            theta=theta_hat,
            gravity=np.array(self.chain.gravity_m_s2),
            q=q,
            qd=qd,
            v=v,
            a=a,
            torque=torque,
        )
        return torque

    def gradient(self, q: Array, qd: Array, v: Array, a: Array, r: Array) -> Array:  # noqa: ARG002
        """Returns Y'r of r = qd - v, shape (K, 10 n)."""
        found = np.zeros((len(q), len(self.theta)))
        q, qd, v, a = map(np.ascontiguousarray, (q, qd, v, a))
        _put_gradients(
            chain=self._rows,
            gravity=np.array(self.chain.gravity_m_s2),
            q=q,
            qd=qd,
            v=v,
            a=a,
            gradient=found,
        )
        return found

    def gravity_torque(self, q: Array) -> Array:
        """Returns G(q), shape (K, n), N m."""
        still = np.zeros_like(q)
        return self.law_torque(
            theta_hat=self.theta[np.newaxis], q=q, qd=still, v=still, a=still
        )

    def _place(self, q: Array) -> tuple[Array, Array, Array]:
        found = np.zeros((len(q), 3)), np.zeros((len(q), 6, q.shape[1])), np.zeros(len(q))
        gravity = np.array(self.chain.gravity_m_s2)
        tip = np.array(self.chain.tip_m)
        _put_end_effectors(
            self._rows, self.theta, gravity, tip, np.ascontiguousarray(q), *found
        )
        return found

    def potential_energy(self, q: Array) -> Array:
        """Returns the links' energy in the field of gravity, shape (K,), J; zero in the base's
        origin.
        """
        return self._place(q)[2]

    def friction(self, speed: Array) -> Array:
        """Returns the torque that friction takes at joint speeds, shape (K, n), N m."""
        x = speed / COULOMB_SPEED
        return self._column("viscous") * speed + self._column("coulomb") * x / np.sqrt(
            1.0 + x * x
        )

    def stop_torque(self, q: Array, qd: Array) -> Array:
        """Returns the torque of the joints' stops ON them, shape (K, n), N m: springs that
        never pull.
        """
        stiffness = self._column("stop_stiffness")
        damping = self._column("stop_damping")
        under = np.maximum(self._column("lower") - q, 0.0)
        over = np.maximum(q - self._column("upper"), 0.0)
        up = np.where(under > 0.0, np.maximum(stiffness * under - damping * qd, 0.0), 0.0)
        down = np.where(over > 0.0, np.maximum(stiffness * over + damping * qd, 0.0), 0.0)
        return up - down

    def place_end_effector(self, q: Array, qd: Array) -> EndEffectorRows:
        """Returns the end effector in space, in the base's frame."""
        at, J, _ = self._place(q)
        J = np.ascontiguousarray(J[:, :3])
        return EndEffectorRows(at, np.einsum("kij,kj->ki", J, qd), J)

    def jacobian_rate(self, q: Array, qd: Array) -> Array:
        """Returns the derivative of the end effector's Jacobian along qd, shape (K, 3, n).

        Column i turns with all joints up to i; of those after it the end effector moves about
        its axis.
        """
        J = self._place(q)[1].transpose(0, 2, 1)
        linear = J[:, :, :3]
        axis = J[:, :, 3:]
        speed, turn = (qd[:, :, np.newaxis] * x for x in (linear, axis))
        later = speed.sum(axis=1, keepdims=True) - np.cumsum(speed, axis=1)
        found: Array = np.cross(np.cumsum(turn, axis=1), linear) + np.cross(axis, later)
        return found.transpose(0, 2, 1)

    def hanging_angle(self, q: Array) -> float:
        """Returns at which angle a pendulum stores as much of its energy as the chain in a
        pose, (n,), rad.

        The least and the largest energy are looked for from this pose on, joint by joint; stops
        do not count. What has no weight never hangs: infinity.
        """
        low = self._find_extreme_energy(q, 1.0)
        high = self._find_extreme_energy(q, -1.0)
        if high - low <= _NO_WEIGHT_J:
            return math.inf
        share = (float(self.potential_energy(q[np.newaxis])[0]) - low) / (high - low)
        return math.acos(min(max(1.0 - 2.0 * share, -1.0), 1.0))

    def _find_extreme_energy(self, q: Array, sign: float) -> float:
        """Returns the least energy (sign 1) or the largest (-1), by turns of one revolute joint
        at a time.

        As a function of one joint's angle it is a + b cos q + c sin q, which three angles give.
        """
        q = q.copy()
        revolute = np.flatnonzero(~self._column("prismatic").astype(bool))
        for joint in np.tile(revolute, _ENERGY_SWEEPS):
            poses = np.tile(q, (3, 1))
            poses[:, joint] = (0.0, 0.5 * np.pi, np.pi)
            at_0, at_90, at_180 = self.potential_energy(poses).tolist()
            middle = 0.5 * (at_0 + at_180)
            q[joint] = math.atan2(-sign * (at_90 - middle), -sign * (at_0 - middle))
        return float(self.potential_energy(q[np.newaxis])[0])


ArmRows = PlanarArmRows | ChainArmRows


def build_arm_rows(scenario: Scenario, site: str) -> ArmRows:
    """Returns the arm of a site, for computations over rows."""
    model = scenario.arms[site]
    if model.chain is None:
        return PlanarArmRows(model.theta, scenario.sites[site].arm.g_m_s2, model.lengths_m)
    chain = model.chain
    task = model.chain.task
    if task is not None and not task.posture:
        chain = chain._replace(task=task._replace(posture=scenario.sites[site].q0_rad))
    return ChainArmRows(model.theta, chain)


def joint_positions_m(arm: ArmModel, q: Array) -> Array:
    """Returns base, joints and end effector of angles (K, n), rad: (K, L, 2), m, of chains (K,
    L, 3).
    """
    if arm.chain is None:
        points = np.zeros((len(q), 1 + JOINTS, 2))
        for pose, angles in zip(points, q, strict=True):
            pose[1:] = forward_kinematics(arm.lengths_m, angles)
        return points
    rows = build_chain(arm.chain.joints)
    tip_m = np.array(arm.chain.tip_m)
    points = np.zeros((len(q), len(rows) + 2, 3))
    for pose, angles in zip(points, q, strict=True):
        place_joints(rows, np.ascontiguousarray(angles))
        pose[-1] = place_end_effector(rows, tip_m)
        at = np.zeros(3)
        turned = np.eye(3)
        for n, row in enumerate(rows, 1):
            at = at + turned @ row.p
            pose[n] = at
            turned = row.R_base.copy()
    return points


def upright_axes(chain: ChainSetup) -> Array:
    """Returns two directions of the floor and the one up, as rows in the base's frame, shape
    (3, 3).
    """
    down = np.array(chain.gravity_m_s2)
    size = float(np.linalg.norm(down))
    up = -down / size if size else np.array([0.0, 0.0, 1.0])
    ahead = np.eye(3)[int(np.argmin(np.abs(up) > 0.9))]  # x, unless gravity acts along it
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.array([ahead, np.cross(up, ahead), up])


DEPENDENT_SHARE = 1e-9
"""A column of which a smaller share is independent of those before it depends on them."""


class BaseParameters(NamedTuple):
    """Combinations of parameters that torques determine.

    Attributes:
        kept: per combination the parameter that it is named after, in ascending order, shape
            (B,).
        combination: its factors of all parameters, 1 of its own, shape (B, P): base =
            combination theta.
    """

    kept: NDArray[np.int64]
    combination: Array


def stack_regressors(arm: ChainArmRows, states: int) -> Array:
    """Returns regressors of so many random states, one below the other, shape (states n, 10 n)."""
    random = np.random.default_rng(1)
    (n, count) = (len(arm.chain.joints), len(arm.theta))
    q = random.uniform(-np.pi, np.pi, (states, n))
    qd, a = random.normal(size=(2, states, n))
    each = np.repeat(np.arange(states), count)
    columns = np.tile(np.eye(count), (states, 1))
    torque = arm.without_drives().law_torque(columns, q[each], qd[each], qd[each], a[each])
    return torque.reshape(states, count, n).transpose(0, 2, 1).reshape(-1, count)


@lru_cache(maxsize=64)
def _find_base_parameters(chain: ChainSetup, learnt: tuple[bool, ...]) -> BaseParameters:
    arm = ChainArmRows(np.zeros(len(learnt)), chain)
    W = stack_regressors(arm, 4 * LINK_PARAMETERS)[:, list(learnt)]
    places = np.flatnonzero(learnt)
    Q = np.zeros((len(W), 0))
    kept = []
    for p, column in enumerate(W.T):
        rest = column - Q @ (Q.T @ column)
        # once more: the first leaves rounding of the size of the column
        rest -= Q @ (Q.T @ rest)
        size = float(np.linalg.norm(rest))
        if size > DEPENDENT_SHARE * float(np.linalg.norm(W)) / np.sqrt(W.shape[1]):
            Q = np.column_stack([Q, rest / size])
            kept.append(p)
    factors = np.linalg.lstsq(W[:, kept], W, rcond=None)[0]
    combination = np.zeros((len(kept), len(learnt)))
    combination[:, places] = np.where(np.abs(factors) > DEPENDENT_SHARE, factors, 0.0)
    combination[:, places[kept]] = np.eye(len(kept))
    return BaseParameters(places[kept], combination)


def find_base_parameters(arm: ArmRows, learnt: NDArray[np.bool_]) -> BaseParameters:
    """Returns the combinations of the parameters that are learnt, shape (P,).

    The five parameters of the planar arm are base parameters already, each by itself.
    """
    if isinstance(arm, ChainArmRows):
        return _find_base_parameters(arm.chain, tuple(learnt.tolist()))
    kept = np.flatnonzero(learnt)
    return BaseParameters(kept, np.eye(len(learnt))[kept])


def find_pseudo_inertias(theta: Array) -> Array:
    """Returns the pseudo-inertia of every link, shape (n, 4, 4): [[S, m c], [m c', m]], S =
    tr(I) 1/2 - I.
    """
    links = theta.reshape(-1, LINK_PARAMETERS)
    found = np.zeros((len(links), 4, 4))
    found[:, 3, 3] = links[:, 0]
    found[:, :3, 3] = found[:, 3, :3] = links[:, 1:4]
    xx, xy, yy, xz, yz, zz = links[:, 4:].T
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    half = 0.5 * (xx + yy + zz)
    found[:, :3, :3] = half[:, np.newaxis, np.newaxis] * np.eye(3) - inertia
    return found


def find_consistent_links(theta: Array) -> list[bool]:
    """Returns for each link if some body has these parameters: its pseudo-inertia is positive
    definite.
    """
    return [
        bool(values.min() > 0.0) for values in np.linalg.eigvalsh(find_pseudo_inertias(theta))
    ]

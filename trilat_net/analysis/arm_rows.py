"""Inertia, torque, energy and end effector of an arm, over all rows of a log at once.

Invariant: of the planar arm written from Section IV and Eq. (12) of the paper, independently of the core that
ran the log; of a chain by the core's leaves, which the tests compare with Pinocchio: a kinetic term or a
gradient is one recursion. Both have the same functions, and hardly anything else asks which arm it is.
"""

import math
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


def inertia_product_rows(theta: Array, q: Array, x: Array) -> Array:
    """Returns M(q) x of rows of q, rad, and of x, shape (K, 2) each; theta of the arm has shape (5,)."""
    bend = theta[1] * np.cos(q[:, 1])
    cross = theta[2] + bend
    first = (theta[0] + 2.0 * bend) * x[:, 0] + cross * x[:, 1]
    return np.stack([first, cross * x[:, 0] + theta[2] * x[:, 1]], axis=1)


def regressor_rows(g: float, q: Array, qd: Array, v: Array, a: Array) -> Array:
    """Returns Y(q, qd, v, a) with Y theta = M(q) a + C(q, qd) v + G(q), Eq. (12), shape (K, 2, 5).

    Gravitational acceleration g in m/s^2; q, qd, reference velocity v and acceleration a of shape (K, 2), in
    rad, rad/s and rad/s^2.
    """
    Y = np.zeros((len(q), 2, 5))
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    Y[:, 0, 0] = a[:, 0]
    Y[:, 0, 1] = c2 * (2.0 * a[:, 0] + a[:, 1])
    Y[:, 0, 1] -= s2 * (qd[:, 1] * v[:, 0] + (qd[:, 0] + qd[:, 1]) * v[:, 1])
    Y[:, 0, 2] = a[:, 1]
    Y[:, 0, 3] = g * np.cos(q[:, 0])
    Y[:, 1, 1] = c2 * a[:, 0] + s2 * qd[:, 0] * v[:, 0]
    Y[:, 1, 2] = a[:, 0] + a[:, 1]
    Y[:, 0, 4] = Y[:, 1, 4] = g * np.cos(q[:, 0] + q[:, 1])
    return Y


class EndEffectorRows(NamedTuple):
    """Position and velocity of the end effector, shape (K, 2), m and m/s; in space (K, 3).

    Attributes:
        J: its Jacobian, shape (K, 2, n), m/rad: rows x and y (and z), columns the joints.
    """

    at: Array
    speed: Array
    J: Array


def compute_end_effector(lengths: tuple[float, float], q: Array, qd: Array) -> EndEffectorRows:
    """Returns the end effector of an arm: lengths of its links, m; q and qd, shape (K, 2), rad and rad/s."""
    inner, outer = q[:, 0], q[:, 0] + q[:, 1]
    elbow = lengths[0] * np.stack([np.cos(inner), np.sin(inner)], axis=1)
    reach = lengths[1] * np.stack([np.cos(outer), np.sin(outer)], axis=1)
    at = elbow + reach
    J = np.empty((len(q), 2, JOINTS))
    J[:, 0, 0], J[:, 1, 0] = -at[:, 1], at[:, 0]
    J[:, 0, 1], J[:, 1, 1] = -reach[:, 1], reach[:, 0]
    return EndEffectorRows(at, np.einsum("kij,kj->ki", J, qd), J)


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

    def weightless(self) -> "PlanarArmRows":
        """Returns the same arm without gravity: its torque is linear in v and a."""
        return self._replace(g=0.0)

    def multiply_inertia(self, q: Array, x: Array) -> Array:
        """Returns M(q) x, shape (K, 2)."""
        return inertia_product_rows(self.theta, q, x)

    def law_torque(self, theta_hat: Array, q: Array, qd: Array, v: Array, a: Array) -> Array:
        """Returns Y(q, qd, v, a) theta_hat of estimates of every row, shape (K, 5), as (K, 2), N m."""
        found: Array = np.einsum("kij,kj->ki", regressor_rows(self.g, q, qd, v, a), theta_hat)
        return found

    def gradient(self, q: Array, qd: Array, v: Array, a: Array, r: Array) -> Array:
        """Returns Y'r of r = qd - v, shape (K, 5)."""
        found: Array = np.einsum("kij,ki->kj", regressor_rows(self.g, q, qd, v, a), r)
        return found

    def gravity_torque(self, q: Array) -> Array:
        """Returns G(q), shape (K, 2), N m."""
        inner, outer = self.g * self.theta[3:, np.newaxis] * np.cos(np.cumsum(q, axis=1).T)
        return np.array([inner + outer, outer]).T

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
        return compute_end_effector(self.lengths_m, q, qd)

    def hanging_angle(self, q: Array) -> float:
        """Returns how far from straight down the link is that hangs least, in one pose, shape (2,), rad."""
        return max(abs(math.remainder(angle + math.pi / 2.0, math.tau)) for angle in np.cumsum(q))


@leaf
def _put_torques(
    chain: RowArray, theta: Array, gravity: Array, q: Array, qd: Array, v: Array, a: Array, torque: Array
) -> None:
    """Writes M a + C(q, qd) v + G + armature a + friction(v) of every row, shape (K, n).

    Parameters theta of shape (K, 10 n), or (1, 10 n) for all rows.
    """
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        propagate_motion(chain, gravity, qd[k], v[k], a[k])
        inverse_dynamics(chain, theta[min(k, theta.shape[0] - 1)], v[k], a[k], torque[k])


@leaf
def _put_gradients(
    chain: RowArray, gravity: Array, q: Array, qd: Array, v: Array, a: Array, gradient: Array
) -> None:
    """Writes Y'r of every row, r = qd - v, shape (K, 10 n)."""
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        propagate_motion(chain, gravity, qd[k], v[k], a[k])
        parameter_gradient(chain, gradient[k])


@leaf
def _put_end_effectors(
    chain: RowArray, theta: Array, gravity: Array, tip: Array, q: Array, at: Array, J: Array, energy: Array
) -> None:
    """Writes place, (K, 3), and Jacobian, (K, 6, n), of every row, and the links' potential energy, (K,), J.

    That energy is -g'(m p + R mc) of every link, p and R its place and orientation in the base's frame.
    """
    n = chain.shape[0]
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        at[k, 0], at[k, 1], at[k, 2] = place_end_effector(chain, tip)
        p_x, p_y, p_z = 0.0, 0.0, 0.0
        energy[k] = 0.0
        for i in range(n):
            row: Row = chain[i]
            step = three(row.p) if i == 0 else rotate(chain[i - 1].R_base, three(row.p))
            p_x, p_y, p_z = p_x + step[0], p_y + step[1], p_z + step[2]
            first = LINK_PARAMETERS * i
            mc = rotate(row.R_base, (theta[first + 1], theta[first + 2], theta[first + 3]))
            energy[k] -= theta[first] * dot(three(gravity), (p_x, p_y, p_z)) + dot(three(gravity), mc)
            for j in range(3):
                J[k, j, i], J[k, 3 + j, i] = row.J_lin[j], row.J_ang[j]


class ChainArmRows(NamedTuple):
    """A chain of n joints over rows, by the core's recursions: what M, C and G are made of is theta.

    The inertia of its drives counts in M. The law knows friction and drives, so that its torque has them.

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
        """True for each parameter that the torque of gravity may consist of: m and m c of every link."""
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
        """Returns the same chain without gravity and Coulomb friction: its torque is linear in v and a."""
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
        _put_torques(self._rows, theta_hat, np.array(self.chain.gravity_m_s2), q, qd, v, a, torque)
        return torque

    def gradient(self, q: Array, qd: Array, v: Array, a: Array, r: Array) -> Array:  # noqa: ARG002
        """Returns Y'r of r = qd - v, shape (K, 10 n)."""
        found = np.zeros((len(q), len(self.theta)))
        q, qd, v, a = map(np.ascontiguousarray, (q, qd, v, a))
        _put_gradients(self._rows, np.array(self.chain.gravity_m_s2), q, qd, v, a, found)
        return found

    def gravity_torque(self, q: Array) -> Array:
        """Returns G(q), shape (K, n), N m."""
        still = np.zeros_like(q)
        return self.law_torque(self.theta[np.newaxis], q, still, still, still)

    def _place(self, q: Array) -> tuple[Array, Array, Array]:
        found = np.zeros((len(q), 3)), np.zeros((len(q), 6, q.shape[1])), np.zeros(len(q))
        gravity, tip = np.array(self.chain.gravity_m_s2), np.array(self.chain.tip_m)
        _put_end_effectors(self._rows, self.theta, gravity, tip, np.ascontiguousarray(q), *found)
        return found

    def potential_energy(self, q: Array) -> Array:
        """Returns the links' energy in the field of gravity, shape (K,), J; zero in the base's origin."""
        return self._place(q)[2]

    def friction(self, speed: Array) -> Array:
        """Returns the torque that friction takes at joint speeds, shape (K, n), N m."""
        x = speed / COULOMB_SPEED
        torque: Array = self._column("viscous") * speed + self._column("coulomb") * x / np.sqrt(1.0 + x * x)
        return torque

    def stop_torque(self, q: Array, qd: Array) -> Array:
        """Returns the torque of the joints' stops ON them, shape (K, n), N m: springs that never pull."""
        stiffness, damping = self._column("stop_stiffness"), self._column("stop_damping")
        under = np.maximum(self._column("lower") - q, 0.0)
        over = np.maximum(q - self._column("upper"), 0.0)
        up = np.where(under > 0.0, np.maximum(stiffness * under - damping * qd, 0.0), 0.0)
        down = np.where(over > 0.0, np.maximum(stiffness * over + damping * qd, 0.0), 0.0)
        torque: Array = up - down
        return torque

    def place_end_effector(self, q: Array, qd: Array) -> EndEffectorRows:
        """Returns the end effector in space, in the base's frame."""
        at, J, _ = self._place(q)
        J = np.ascontiguousarray(J[:, :3])
        return EndEffectorRows(at, np.einsum("kij,kj->ki", J, qd), J)

    def jacobian_rate(self, q: Array, qd: Array) -> Array:
        """Returns the derivative of the end effector's Jacobian along qd, shape (K, 3, n).

        Column i turns with all joints up to i; of those after it the end effector moves about its axis.
        """
        J = self._place(q)[1].transpose(0, 2, 1)
        linear, axis = J[:, :, :3], J[:, :, 3:]
        speed, turn = (qd[:, :, np.newaxis] * x for x in (linear, axis))
        later = speed.sum(axis=1, keepdims=True) - np.cumsum(speed, axis=1)
        found: Array = np.cross(np.cumsum(turn, axis=1), linear) + np.cross(axis, later)
        return found.transpose(0, 2, 1)

    def hanging_angle(self, q: Array) -> float:
        """Returns at which angle a pendulum stores as much of its energy as the chain in a pose, (n,), rad.

        The least and the largest energy are looked for from this pose on, joint by joint; stops do not count.
        What has no weight never hangs: infinity.
        """
        low, high = self._find_extreme_energy(q, 1.0), self._find_extreme_energy(q, -1.0)
        if high - low <= _NO_WEIGHT_J:
            return math.inf
        share = (float(self.potential_energy(q[np.newaxis])[0]) - low) / (high - low)
        return math.acos(min(max(1.0 - 2.0 * share, -1.0), 1.0))

    def _find_extreme_energy(self, q: Array, sign: float) -> float:
        """Returns the least energy (sign 1) or the largest (-1), by turns of one revolute joint at a time.

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
    chain, task = model.chain, model.chain.task
    if task is not None and not task.posture:
        chain = chain._replace(task=task._replace(posture=scenario.sites[site].q0_rad))
    return ChainArmRows(model.theta, chain)


def joint_positions_m(arm: ArmModel, q: Array) -> Array:
    """Returns base, joints and end effector of angles (K, n), rad: (K, L, 2), m, of chains (K, L, 3)."""
    if arm.chain is None:
        points = np.zeros((len(q), 1 + JOINTS, 2))
        for pose, angles in zip(points, q, strict=True):
            pose[1:] = forward_kinematics(arm.lengths_m, angles)
        return points
    rows, tip_m = build_chain(arm.chain.joints), np.array(arm.chain.tip_m)
    points = np.zeros((len(q), len(rows) + 2, 3))
    for pose, angles in zip(points, q, strict=True):
        place_joints(rows, np.ascontiguousarray(angles))
        pose[-1] = place_end_effector(rows, tip_m)
        at, turned = np.zeros(3), np.eye(3)
        for n, row in enumerate(rows, 1):
            at = at + turned @ row.p
            pose[n], turned = at, row.R_base.copy()
    return points


def upright_axes(chain: ChainSetup) -> Array:
    """Returns two directions of the floor and the one up, as rows in the base's frame, shape (3, 3)."""
    down = np.array(chain.gravity_m_s2)
    size = float(np.linalg.norm(down))
    up = -down / size if size else np.array([0.0, 0.0, 1.0])
    ahead = np.eye(3)[int(np.argmin(np.abs(up) > 0.9))]  # x, unless gravity acts along it
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.array([ahead, np.cross(up, ahead), up])

"""Computes inertia, torque, energy and end-effector motion of an arm for many records at once.

`PlanarArmRows` models the planar arm with two joints, and `ChainArmRows` a chain with any
number of joints. Both classes have the same methods. Row k of their arguments and results
belongs to record k.

Invariant:
    - The planar arm is computed independently of the simulation that executed the run.
    - A chain is computed with the simulation's own functions, which the tests compare with
      Pinocchio.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import (
    COULOMB_SPEED,
    LINK_PARAMETERS,
    Array,
    ChainDynamics,
    ChainSetup,
    TaskSetup,
    forward_kinematics,
)
from ..records import JOINTS
from ..scenario import Scenario

HANGING_RAD = 0.3
"""Largest angle between a hanging link and the downward vertical, in rad."""
_NO_WEIGHT_J = 1e-6
"""Largest variation of the potential energy of an arm that cannot hang, in J."""
_ENERGY_SWEEPS = 20
"""Number of sweeps over all joints in the search for the extreme potential energies."""

Numbers = NDArray[Any]
"""Real numbers, or complex numbers for a derivative by complex step.

Vectors have their components on the first axis, and any number of columns: shape (n,) or (n,
B).
"""


def multiply_columns(matrix: Numbers, vector: Numbers) -> Numbers:
    """Multiplies many matrices by many vectors in one call, one product per log record.

    The trailing axes enumerate the records. NumPy computes all of them at once, which avoids a
    slow Python loop.

    Args:
        matrix: Entries of the matrices, shape (a, b, ...). The axes "..." enumerate the
            records.
        vector: Components of the vectors, shape (b, ...), with the same records.

    Returns:
        The products, shape (a, ...).
    """
    product: Numbers = np.einsum("ab...,b...->a...", matrix, vector)
    return product


def solve_columns(A: Numbers, b: Numbers) -> Numbers:
    """Solves many small linear systems A y = b in one call, one system per log record.

    An example is the acceleration of an arm, where A is the inertia matrix and b the torque.

    Args:
        A: Square matrices, shape (m, m, ...). The axes "..." enumerate the records.
        b: Right-hand sides, shape (m, ...).

    Returns:
        The solutions y, shape (m, ...).
    """
    # numpy's solver expects the matrices on the last two axes, and counts records by the first
    matrices = np.moveaxis(A, (0, 1), (-2, -1))
    vectors = np.moveaxis(b, 0, -1)
    right_sides = vectors[..., np.newaxis]
    solutions = np.linalg.solve(matrices, right_sides)
    y = solutions[..., 0]
    return np.moveaxis(y, -1, 0)


@dataclass(frozen=True)
class PlacedArm:
    """Dynamics of the planar arm with two joints, evaluated at given poses.

    The methods compute inertia, gravity and the other terms of the equation of motion. In all
    shapes, "..." stands for the axes that enumerate the poses. All methods are analytic in
    every argument, so a complex step (a tiny imaginary change of an argument) yields exact
    derivatives.

    The formulas are Eq. (1)-(5) and (24) of "Adaptive Control of Dual User Teleoperation with
    Time Delay and Dynamic Uncertainty". `theory.textbook_arm.PlacedChain` has the same methods
    for arms with more joints.

    Attributes:
        g_m_s2: Gravitational acceleration, in m/s^2.
        lengths_m: Lengths of the two links, in m.
        q: Joint angles, shape (2, ...), in rad.
    """

    g_m_s2: float
    lengths_m: tuple[float, float]
    q: Numbers

    def inertia_matrix(self, theta: Numbers) -> Numbers:
        """Returns the inertia matrix M(q), shape (2, 2, ...), in kg m^2.

        M(q) maps joint accelerations to torques. There is one matrix per pose.

        Args:
            theta: The five dynamic parameters of the arm, which combine masses, lengths and
                inertias as in Eq. (24), shape (5, ...).
        """
        q_2 = self.q[1]
        bend = theta[1] * np.cos(q_2)
        M_11 = theta[0] + 2.0 * bend
        M_12 = theta[2] + bend
        # 0 M_12 gives this entry as many columns as the others have
        M_22 = theta[2] + 0.0 * M_12
        row_1 = [M_11, M_12]
        row_2 = [M_12, M_22]
        return np.array([row_1, row_2])

    def coriolis_matrix(self, theta: Numbers, qd: Numbers) -> Numbers:
        """Returns the Coriolis matrix C(q, qd), shape (2, 2, ...), in kg m^2/s.

        C(q, qd) qd is the torque of the Coriolis and centrifugal forces. C is built from
        Christoffel symbols, which makes M' - 2 C skew-symmetric, where M' is the time
        derivative of the inertia matrix.

        Args:
            theta: Dynamic parameters of the arm, shape (5, ...).
            qd: Joint velocities, shape (2, ...), in rad/s.
        """
        q_2 = self.q[1]
        h = -theta[1] * np.sin(q_2)
        qd_1, qd_2 = qd
        C_11 = h * qd_2
        C_12 = h * (qd_1 + qd_2)
        C_21 = -h * qd_1
        # zero, with as many columns as the other entries have
        C_22 = 0.0 * h * qd_1
        row_1 = [C_11, C_12]
        row_2 = [C_21, C_22]
        return np.array([row_1, row_2])

    def gravity_torque(self, theta: Numbers) -> Numbers:
        """Returns the torque G(q) that holds the arm against gravity, shape (2, ...), in N m.

        G(q) is the gradient of the potential energy with respect to the joint angles.

        Args:
            theta: Dynamic parameters of the arm, shape (5, ...).
        """
        q_1, q_2 = self.q
        weight_1 = theta[3] * self.g_m_s2
        weight_2 = theta[4] * self.g_m_s2
        G_2 = weight_2 * np.cos(q_1 + q_2)
        G_1 = weight_1 * np.cos(q_1) + G_2
        return np.array([G_1, G_2])

    def required_torque(
        self,
        theta: Numbers,
        qd: Numbers,
        v: Numbers,
        a: Numbers,
    ) -> Numbers:
        """Returns the torque required for a reference motion, shape (2, ...), in N m.

        This torque is M(q) a + C(q, qd) v + G(q), which equals Y theta in Eq. (12). M is the
        inertia matrix, C the Coriolis matrix, G the gravity torque, and Y the regressor.

        Args:
            theta: Dynamic parameters of the arm, shape (5, ...).
            qd: Joint velocities, shape (2, ...), in rad/s.
            v: Reference velocities of the joints, shape (2, ...), in rad/s.
            a: Reference accelerations of the joints, shape (2, ...), in rad/s^2.
        """
        M = self.inertia_matrix(theta)
        C = self.coriolis_matrix(theta, qd)
        inertial = multiply_columns(M, a)
        coriolis = multiply_columns(C, v)
        return inertial + coriolis + self.gravity_torque(theta)

    def regressor_matrix(self, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns the regressor Y(q, qd, v, a) of Eq. (12), shape (2, 5, ...).

        The required torque is linear in the parameters theta and equals Y theta. Column p of Y
        is therefore the torque of an arm whose parameter p is 1 while all others are 0.

        Args:
            qd: Joint velocities, shape (2, ...), in rad/s.
            v: Reference velocities of the joints, shape (2, ...), in rad/s.
            a: Reference accelerations of the joints, shape (2, ...), in rad/s^2.
        """
        columns = self.q.shape[1:]
        # one further axis, for the arms that have one parameter 1 and all others 0
        unit_parameters = np.multiply.outer(np.eye(5), np.ones(columns))
        return self.required_torque(unit_parameters, qd, v, a)

    def friction_torque(self, v: Numbers) -> Numbers:
        """Returns zeros, shape (2, ...), because this arm has no joint friction.

        This method lets callers treat this arm like a chain, whose joints may have friction.

        Args:
            v: Joint velocities, shape (2, ...), in rad/s. Only the shape is used.
        """
        return 0.0 * v

    def joint_acceleration(self, theta: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
        """Returns the joint accelerations of the arm under a torque, in rad/s^2.

        The accelerations qdd solve the equation of motion M qdd + C qd + G = torque, Eq. (8).
        The shape is (2, ...).

        Args:
            theta: Dynamic parameters of the arm, shape (5, ...).
            qd: Joint velocities, shape (2, ...), in rad/s.
            torque: Total torque on the joints, shape (2, ...), in N m.
        """
        at_rest = np.zeros_like(qd)
        bias_torque = self.required_torque(theta, qd, qd, at_rest)
        M = self.inertia_matrix(theta)
        return solve_columns(M, torque - bias_torque)

    def end_effector_position(self) -> Numbers:
        """Returns the position (x, y) of the end effector, shape (2, ...), in m.

        With link lengths l_1 and l_2, x = l_1 cos q_1 + l_2 cos(q_1 + q_2), and y has sines in
        place of the cosines. The origin is the first joint.
        """
        l1_m, l2_m = self.lengths_m
        inner, q_2 = self.q
        outer = inner + q_2
        x = l1_m * np.cos(inner) + l2_m * np.cos(outer)
        y = l1_m * np.sin(inner) + l2_m * np.sin(outer)
        return np.array([x, y])

    def position_jacobian(self) -> Numbers:
        """Returns the Jacobian J of the end effector's position, shape (2, 2, ...), in m/rad.

        J maps joint velocities to the velocity of the end effector. The rows are x and y, the
        columns the two joints.
        """
        x, y = self.end_effector_position()
        l2_m = self.lengths_m[1]
        q_1, q_2 = self.q
        outer = q_1 + q_2
        row_x = [-y, -l2_m * np.sin(outer)]
        row_y = [x, l2_m * np.cos(outer)]
        return np.array([row_x, row_y])


class EndEffectorRows(NamedTuple):
    """Position and velocity of an end effector (the tip of an arm) in K poses.

    The planar arm moves in two coordinates, a chain in three.

    Attributes:
        position: Position in the frame of the base, shape (K, 2) or (K, 3), in m.
        speed: Velocity, shape (K, 2) or (K, 3), in m/s.
        J: Jacobian of the position, shape (K, 2, n) or (K, 3, n), in m/rad. There is one row
            per coordinate and one column per joint.
    """

    position: Array
    speed: Array
    J: Array

    @property
    def last(self) -> "EndEffectorRows":
        """The end effector in the last pose only, as arrays with K = 1."""
        return EndEffectorRows(self.position[-1:], self.speed[-1:], self.J[-1:])

    def find_force(self, torque: Array, least: float = 1e-15) -> Array:
        """Finds the end-effector force that best explains a joint torque.

        The force F minimises the difference between the torque and J'F, where J is the
        Jacobian. If several forces do so, the smallest is returned.

        Args:
            torque: Joint torque, shape (K, n), in N m.
            least: Threshold for singular poses, relative to the largest singular value of J.
                The end effector counts as immobile along directions with smaller singular
                values.

        Returns:
            Force, shape (K, 2) or (K, 3), in N.
        """
        J_transposed = self.J.transpose(0, 2, 1)
        inverse = np.linalg.pinv(J_transposed, rcond=least)
        force: Array = np.einsum("kij,kj->ki", inverse, torque)
        return force


class PlanarArmRows(NamedTuple):
    """Model of the planar arm with two joints, evaluated at K poses at once.

    Unlike `PlacedArm`, all arrays have one row per pose. `ChainArmRows` has the same methods
    for arms with more joints.

    Attributes:
        theta: True dynamic parameters of the arm, Eq. (24), shape (5,).
        g: Gravitational acceleration, in m/s^2.
        lengths_m: Lengths of the two links, in m.
    """

    theta: Array
    g: float
    lengths_m: tuple[float, float]

    @property
    def task(self) -> None:
        """Always `None`, because the planar arm follows its peers joint by joint.

        `ChainArmRows.task` describes how an arm follows with its end effector. Since both
        classes have the property, callers need not distinguish the two kinds of arms.
        """
        return

    @property
    def gravity_parameters(self) -> NDArray[np.bool_]:
        """Marks the parameters on which the gravity torque depends, shape (5,).

        True for theta_4 and theta_5, the products of masses and lever arms. The other three
        parameters describe inertia only.
        """
        return np.arange(5) >= 3

    def place(self, q: Array) -> PlacedArm:
        """Returns the dynamics of the arm, such as its inertia matrix, at K poses.

        Terms that depend only on the poses, such as sines of the angles, are computed only
        once. The arrays of the returned object have the poses on their last axis.

        Args:
            q: Joint angles of the K poses, shape (K, 2), in rad.
        """
        return PlacedArm(self.g, self.lengths_m, q.T)

    def weightless(self) -> "PlanarArmRows":
        """Returns a model of the same arm without gravity.

        The torque of this model is linear in the reference velocity v and acceleration a, so
        the contributions of parts of a motion can be computed separately and added.
        """
        return self._replace(g=0.0)

    def multiply_inertia(self, q: Array, x: Array) -> Array:
        """Multiplies the inertia matrix M(q) by a vector x at each of K poses.

        If x is a velocity, the product is a momentum, and if x is an acceleration, the product
        is a torque.

        Args:
            q: Joint angles, shape (K, 2), in rad.
            x: The vectors, such as velocities or accelerations, shape (K, 2).

        Returns:
            The products, shape (K, 2).
        """
        M = self.place(q).inertia_matrix(self.theta)
        product = multiply_columns(M, x.T)
        return product.T

    def law_torque(
        self,
        theta_hat: Array,
        q: Array,
        qd: Array,
        v: Array,
        a: Array,
    ) -> Array:
        """Returns the torque with which an adaptive law compensates for the estimated dynamics.

        The torque is Y theta_hat, where Y is the regressor: multiplied by the dynamic
        parameters, Y gives the torque that a motion requires.

        Args:
            theta_hat: Estimates of the arm's five dynamic parameters in K poses, shape (K, 5).
            q: Joint angles, shape (K, 2), in rad.
            qd: Joint velocities, shape (K, 2), in rad/s.
            v: Reference velocities of the joints, shape (K, 2), in rad/s.
            a: Reference accelerations of the joints, shape (K, 2), in rad/s^2.

        Returns:
            Torque, shape (K, 2), in N m.
        """
        arm = self.place(q)
        torque = arm.required_torque(theta_hat.T, qd.T, v.T, a.T)
        return torque.T

    def gradient(
        self,
        q: Array,
        qd: Array,
        v: Array,
        a: Array,
        r: Array,
    ) -> Array:
        """Returns Y'r, the direction in which the adaptive law changes the parameter estimates.

        Y is the regressor (the torque required for a motion is Y times the dynamic parameters),
        Y' its transpose, and r = qd - v the velocity error.

        Args:
            q: Joint angles in K poses, shape (K, 2), in rad.
            qd: Joint velocities, shape (K, 2), in rad/s.
            v: Reference velocities of the joints, shape (K, 2), in rad/s.
            a: Reference accelerations of the joints, shape (K, 2), in rad/s^2.
            r: Velocity errors qd - v, shape (K, 2), in rad/s.

        Returns:
            Gradient Y'r with respect to the five parameters, shape (K, 5).
        """
        arm = self.place(q)
        Y = arm.regressor_matrix(qd.T, v.T, a.T)
        gradient: Array = np.einsum("ijk,ki->kj", Y, r)
        return gradient

    def gravity_torque(self, q: Array) -> Array:
        """Returns the torque G(q) that holds the arm still against gravity, in N m.

        Args:
            q: Joint angles, shape (K, 2), in rad.

        Returns:
            Torque, shape (K, 2).
        """
        arm = self.place(q)
        torque = arm.gravity_torque(self.theta)
        return torque.T

    def potential_energy(self, q: Array) -> Array:
        """Returns the potential energy of the arm in each of K poses, in J.

        The energy is g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)), where g is the gravitational
        acceleration. It is zero when both links are horizontal.

        Args:
            q: Joint angles, shape (K, 2), in rad.

        Returns:
            Energy, shape (K,).
        """
        q_1, q_2 = q.T
        theta_4 = self.theta[3]
        theta_5 = self.theta[4]
        inner = theta_4 * np.sin(q_1)
        outer = theta_5 * np.sin(q_1 + q_2)
        energy: Array = self.g * (inner + outer)
        return energy

    def friction(self, speed: Array) -> Array:
        """Returns the friction torques of the joints, which are zero here, shape (K, 2).

        This method exists because the joints of a `ChainArmRows` may have friction.
        """
        return np.zeros_like(speed)

    def stop_torque(self, q: Array, qd: Array) -> Array:  # noqa: ARG002 - chains need it
        """Returns zeros, because the joints of this arm have no mechanical stops.

        This method exists because the joints of a `ChainArmRows` may have stops.

        Args:
            q: Joint angles in K poses, shape (K, 2), in rad.
            qd: Joint velocities, shape (K, 2), in rad/s.

        Returns:
            Torque of the stops, shape (K, 2), in N m.
        """
        return np.zeros_like(q)

    def place_end_effector(self, q: Array, qd: Array) -> EndEffectorRows:
        """Returns position, velocity and Jacobian of the end effector at K poses.

        The Jacobian maps joint velocities to the velocity of the end effector.

        Args:
            q: Joint angles, shape (K, 2), in rad.
            qd: Joint velocities, shape (K, 2), in rad/s.
        """
        arm = self.place(q)
        position = arm.end_effector_position()
        J = arm.position_jacobian()
        speed = multiply_columns(J, qd.T)
        return EndEffectorRows(
            position=position.T,
            speed=speed.T,
            J=J.transpose(2, 0, 1),
        )

    def joint_positions_m(self, q: Array) -> Array:
        """Returns the positions of the base, the elbow joint and the end effector, for drawing.

        Lines between successive points represent the links of the arm.

        Args:
            q: Joint angles in K poses, shape (K, 2), in rad.

        Returns:
            The three positions in every pose, shape (K, 3, 2), in m.
        """
        points_per_pose = 1 + JOINTS
        points = np.zeros((len(q), points_per_pose, 2))
        for pose, angles in zip(points, q, strict=True):
            pose[1:] = forward_kinematics(self.lengths_m, angles)
        return points

    @property
    def upright_axes(self) -> None:
        """Always `None`, because the planar arm is drawn in its own plane.

        For a chain, `ChainArmRows.upright_axes` returns the axes of an upright frame.
        """
        return

    @property
    def least_inertia_kg_m2(self) -> float:
        """A lower bound on the eigenvalues of the inertia matrix M(q) for all poses q.

        The smallest eigenvalue occurs at cos q2 = 1 or -1.
        """
        poses = np.array([[0.0, 0.0], [0.0, np.pi]])
        extreme_poses = PlacedArm(0.0, self.lengths_m, poses)
        inertia_matrices = extreme_poses.inertia_matrix(self.theta).T
        eigenvalues = np.linalg.eigvalsh(inertia_matrices)
        return float(eigenvalues.min())

    def hanging_angle(self, q: Array) -> float:
        """Returns the largest angle between a link and the direction straight down, in rad.

        A small angle means that the arm hangs down, which happens when its motors do not hold
        it up.

        Args:
            q: Joint angles of one pose, shape (2,), in rad.
        """
        angles_to_down = []
        for link_angle in np.cumsum(q):
            turned_angle = link_angle + math.pi / 2.0
            angle = math.remainder(turned_angle, math.tau)
            angles_to_down.append(abs(angle))
        return max(angles_to_down)


class ChainArmRows(NamedTuple):
    """Model of a serial arm with n joints, evaluated at K poses at once.

    The arm is a chain of rigid links. Torques are computed with the same recursions from link
    to link as in the simulation. The parameters theta determine the inertia matrix M, the
    Coriolis matrix C and the gravity torque G of the links. The control laws know the inertia
    of the drives (armature) and the joint friction, so their torques include both.

    Attributes:
        theta: True dynamic parameters, shape (10 n,): mass, first moment and inertia of each
            link.
        chain: Description of joints, gravity and end effector.
    """

    theta: Array
    chain: ChainSetup

    @property
    def task(self) -> TaskSetup | None:
        """Settings for following peers with the end effector, such as its axes.

        `None` if the arm follows its peers joint by joint.
        """
        return self.chain.task

    @property
    def gravity_parameters(self) -> NDArray[np.bool_]:
        """Marks the parameters on which the gravity torque depends, shape (10 n,).

        True for the mass m and the first moment m c of every link, where c is the centre of
        mass.
        """
        indices = np.arange(len(self.theta))
        index_in_link = indices % LINK_PARAMETERS
        return index_in_link < 4

    @property
    def _dynamics(self) -> ChainDynamics:
        """Dynamics of the chain, by the functions of the simulation kernel."""
        return ChainDynamics(self.chain, self.theta)

    def _column(self, name: str) -> Array:
        """Returns one attribute of every joint, such as "viscous", as an array (n,)."""
        values = [getattr(joint, name) for joint in self.chain.joints]
        return np.array(values)

    def _replace_in_joints(self, **values: Any) -> "ChainArmRows":
        """Returns a copy of the chain with some attributes of every joint replaced."""
        joints = [joint._replace(**values) for joint in self.chain.joints]
        chain = self.chain._replace(joints=tuple(joints))
        return self._replace(chain=chain)

    def weightless(self) -> "ChainArmRows":
        """Returns a model of the same arm without gravity or dry (Coulomb) friction.

        The torque of this model is linear in the reference velocity v and acceleration a, so
        the contributions of parts of a motion can be computed separately and added.
        """
        bare = self._replace_in_joints(coulomb=0.0)
        no_gravity = (0.0, 0.0, 0.0)
        weightless_chain = bare.chain._replace(gravity_m_s2=no_gravity)
        return bare._replace(chain=weightless_chain)

    def without_drives(self) -> "ChainArmRows":
        """Returns a model of the same arm without friction or motor inertia.

        The torque of this model is linear in the parameters theta (masses and inertias), as
        required to estimate them.
        """
        return self._replace_in_joints(coulomb=0.0, viscous=0.0, armature_kg_m2=0.0)

    def multiply_inertia(self, q: Array, x: Array) -> Array:
        """Multiplies the inertia matrix, including the drives, by a vector at each of K poses.

        The product (M(q) + armature) x is computed with one recursion along the chain without
        gravity. The matrix itself is never formed.

        Args:
            q: Joint angles, shape (K, n), in rad.
            x: The vectors, such as velocities or accelerations, shape (K, n).

        Returns:
            The products, shape (K, n).
        """
        still = np.zeros_like(q)
        arm = self.weightless()
        return arm.law_torque(
            theta_hat=self.theta[np.newaxis],
            q=q,
            qd=still,
            v=still,
            a=x,
        )

    def law_torque(
        self,
        theta_hat: Array,
        q: Array,
        qd: Array,
        v: Array,
        a: Array,
    ) -> Array:
        """Returns the torque with which a law compensates for the dynamics that it estimates.

        This torque is Y(q, qd, v, a) theta_hat + armature a + friction(v), where Y is the
        regressor of the links. The law knows the inertia of the drives (armature) and the
        friction.

        Args:
            theta_hat: Estimates of the dynamic parameters, shape (K, 10 n), or (1, 10 n) if
                they are the same in all rows.
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
            v: Reference velocities, shape (K, n), in rad/s.
            a: Reference accelerations, shape (K, n), in rad/s^2.

        Returns:
            Torque, shape (K, n), in N m.
        """
        return self._dynamics.compute_torque(q, qd, v, a, theta=theta_hat)

    def gradient(
        self,
        q: Array,
        qd: Array,
        v: Array,
        a: Array,
        r: Array,  # noqa: ARG002 - the planar arm needs it
    ) -> Array:
        """Returns Y'r, the direction in which the adaptive law changes the parameter estimates.

        Y is the regressor (the torque required for a motion is Y times the dynamic parameters),
        Y' its transpose, and r = qd - v the velocity error. The chain has n joints.

        Args:
            q: Joint angles in K poses, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
            v: Reference velocities of the joints, shape (K, n), in rad/s.
            a: Reference accelerations of the joints, shape (K, n), in rad/s^2.
            r: Velocity errors qd - v, shape (K, n), in rad/s.

        Returns:
            Gradient Y'r with respect to the 10 n parameters, shape (K, 10 n).
        """
        return self._dynamics.compute_gradient(q, qd, v, a)

    def gravity_torque(self, q: Array) -> Array:
        """Returns the torque G(q) that holds the arm still against gravity, in N m.

        Args:
            q: Joint angles, shape (K, n), in rad.

        Returns:
            Torque, shape (K, n).
        """
        still = np.zeros_like(q)
        return self.law_torque(
            theta_hat=self.theta[np.newaxis],
            q=q,
            qd=still,
            v=still,
            a=still,
        )

    def potential_energy(self, q: Array) -> Array:
        """Returns the potential energy of the links at joint angles `q`, in J.

        The energy is zero at the height of the base. `q` has shape (K, n), and the result shape
        (K,).
        """
        _, _, energy = self._dynamics.place(q)
        return energy

    def friction(self, speed: Array) -> Array:
        """Returns the torque needed to overcome the dry and viscous friction of the joints.

        Dry friction is constant in magnitude, and viscous friction grows with the velocity.

        Args:
            speed: Joint velocities at K instants, shape (K, n), in rad/s.

        Returns:
            Torque, shape (K, n), in N m. It has the sign of the velocity, while the friction
            itself acts with the opposite sign.
        """
        viscous = self._column("viscous") * speed
        # a smooth sign of the speed
        x = speed / COULOMB_SPEED
        root = np.sqrt(1.0 + x * x)
        coulomb = self._column("coulomb") * x / root
        return viscous + coulomb

    def stop_torque(self, q: Array, qd: Array) -> Array:
        """Returns the torque that the mechanical stops exert on the joints, in N m.

        A stop limits the angle of a joint. It acts like a spring and damper that push the joint
        back and never pull it.

        Args:
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.

        Returns:
            Torque, shape (K, n). Zero for joints that do not touch a stop.
        """
        stiffness = self._column("stop_stiffness")
        damping = self._column("stop_damping")
        lower = self._column("lower")
        upper = self._column("upper")
        below = np.maximum(lower - q, 0.0)
        above = np.maximum(q - upper, 0.0)

        damping_torque = damping * qd
        push_up = np.maximum(stiffness * below - damping_torque, 0.0)
        push_down = np.maximum(stiffness * above + damping_torque, 0.0)
        lower_stop = np.where(below > 0.0, push_up, 0.0)
        upper_stop = np.where(above > 0.0, push_down, 0.0)
        return lower_stop - upper_stop

    def place_end_effector(self, q: Array, qd: Array) -> EndEffectorRows:
        """Returns position, velocity and Jacobian of the end effector at K poses.

        The Jacobian maps joint velocities to the velocity of the end effector. All results are
        in the base frame of the arm.

        Args:
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
        """
        position, full_J, _ = self._dynamics.place(q)
        J = np.ascontiguousarray(full_J[:, :3])
        speed = np.einsum("kij,kj->ki", J, qd)
        return EndEffectorRows(position, speed, J)

    def jacobian_rate(self, q: Array, qd: Array) -> Array:
        """Returns the time derivative of the Jacobian of the end effector's position.

        Column i of the Jacobian is the velocity of the end effector when joint i moves at unit
        speed. This vector changes for two reasons: the joints up to i rotate it, and the joints
        after i move the end effector relative to the axis of joint i.

        Args:
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.

        Returns:
            Derivative, shape (K, 3, n).
        """
        _, J, _ = self._dynamics.place(q)
        columns = J.transpose(0, 2, 1)
        linear = columns[:, :, :3]
        axis = columns[:, :, 3:]
        joint_speed = qd[:, :, np.newaxis]
        velocity = joint_speed * linear
        angular_velocity = joint_speed * axis
        rotation_up_to = np.cumsum(angular_velocity, axis=1)
        # motion that joint i shares with all joints before it, and that of the joints after it
        velocity_up_to = np.cumsum(velocity, axis=1)
        velocity_after = velocity.sum(axis=1, keepdims=True) - velocity_up_to
        turning = np.cross(rotation_up_to, linear)
        moving = np.cross(axis, velocity_after)
        rate: Array = turning + moving
        return rate.transpose(0, 2, 1)

    def joint_positions_m(self, q: Array) -> Array:
        """Returns the positions of the base, the joints and the end effector, for drawing.

        Lines between successive points represent the links of the arm.

        Args:
            q: Joint angles in K poses, shape (K, n), in rad.

        Returns:
            The L positions in every pose, shape (K, L, 3), in m.
        """
        return self._dynamics.place_points(q)

    @property
    def upright_axes(self) -> Array:
        """The axes of an upright frame for drawings of the arm.

        A URDF file may mount the base of a chain in any orientation, so the upward direction is
        taken from gravity. Without gravity, the z axis of the base is assumed to point up.

        The rows are the unit vectors forward, sideways and up, in the base frame, shape (3, 3).
        Multiply points of shape (..., 3) by the transpose to obtain upright coordinates.
        """
        gravity = np.array(self.chain.gravity_m_s2)
        size = float(np.linalg.norm(gravity))
        up = np.array([0.0, 0.0, 1.0])
        if size:
            up = -gravity / size
        # the first axis that is not nearly vertical: x, unless gravity acts along x
        is_vertical = np.abs(up) > 0.9
        axis_index = int(np.argmin(is_vertical))
        axis = np.eye(3)[axis_index]
        vertical_part = (axis @ up) * up
        forward = axis - vertical_part
        forward /= np.linalg.norm(forward)
        sideways = np.cross(up, forward)
        return np.array([forward, sideways, up])

    @property
    def least_inertia_kg_m2(self) -> float:
        """A lower bound on the eigenvalues of the inertia matrix M(q) for all poses q.

        The bound is the smallest drive inertia, since each drive moves with its joint.
        """
        return min(joint.armature_kg_m2 for joint in self.chain.joints)

    def hanging_angle(self, q: Array) -> float:
        """Returns an angle, in rad, that tells how far the chain is from hanging straight down.

        The angle compares the potential energy E of the chain with the lowest and highest
        energy that it can reach: cos(angle) = 1 - 2 (E - lowest) / (highest - lowest). An angle
        of 0 means hanging down, and pi means upright. The search for the extremes starts from
        this pose and varies one joint at a time. Mechanical stops are ignored.

        Args:
            q: Joint angles of one pose, shape (n,) for n joints, in rad.

        Returns:
            The angle, or infinity if gravity has no effect on the chain.
        """
        lowest_j = self._find_extreme_energy(q, 1.0)
        highest_j = self._find_extreme_energy(q, -1.0)
        range_j = highest_j - lowest_j
        if range_j <= _NO_WEIGHT_J:
            return math.inf
        energy_j = self._find_pose_energy(q)
        energy_fraction = (energy_j - lowest_j) / range_j
        # for a pendulum this fraction is (1 - cos(angle)) / 2
        cosine = 1.0 - 2.0 * energy_fraction
        # rounding errors may exceed the range of a cosine
        valid_cosine = min(max(cosine, -1.0), 1.0)
        return math.acos(valid_cosine)

    def _find_pose_energy(self, q: Array) -> float:
        """Returns the potential energy in one pose, in J."""
        energy = self.potential_energy(q[np.newaxis])
        return float(energy[0])

    def _find_extreme_energy(self, q: Array, sign: float) -> float:
        """Returns the least (sign 1) or largest (sign -1) potential energy of the arm, in J.

        The search is a coordinate descent over the revolute joints. As a function of one
        joint's angle q, the energy is mean + b cos q + c sin q. Therefore its values at three
        angles determine the extreme.
        """
        q = q.copy()
        is_prismatic = self._column("prismatic").astype(bool)
        revolute = np.flatnonzero(~is_prismatic)
        for joint in np.tile(revolute, _ENERGY_SWEEPS):
            poses = np.tile(q, (3, 1))
            poses[:, joint] = (0.0, 0.5 * np.pi, np.pi)
            energies = self.potential_energy(poses)
            at_0, at_90, at_180 = energies.tolist()

            # The energy is a sinusoid of each joint's angle, so three angles determine it.
            mean = 0.5 * (at_0 + at_180)
            cosine_part = at_0 - mean
            sine_part = at_90 - mean
            q[joint] = math.atan2(-sign * sine_part, -sign * cosine_part)
        return self._find_pose_energy(q)


ArmRows = PlanarArmRows | ChainArmRows


def build_arm_rows(scenario: Scenario, site: str) -> ArmRows:
    """Returns the model of a site's arm for computations over many poses at once.

    The certificate and the metrics evaluate inertia and energy at every record of a log. One
    call per record would be too slow.

    Args:
        scenario: The scenario, which defines the arm.
        site: Name of the site.
    """
    model = scenario.arms[site]
    spec = scenario.sites[site]
    if model.chain is None:
        return PlanarArmRows(model.theta, spec.arm.g_m_s2, model.lengths_m)
    chain = model.chain
    if chain.task is not None and not chain.task.posture:
        # if the task has no preferred posture, the start pose is preferred
        task = chain.task._replace(posture=spec.q0_rad)
        chain = chain._replace(task=task)
    return ChainArmRows(model.theta, chain)

"""Torques, poses and energies of a chain of joints, for use from plain Python.

The functions of `chain` share one joint data array and depend on each other's results.
`ChainDynamics` calls them in the right order, for one pose or for many.
"""

import numpy as np

from ...records import MAX_JOINTS
from ..step.jit import leaf
from ..step.site_setup import ChainSetup
from ..step.vectors import Array, Row, RowArray, Vector
from .chain import (
    LINK_PARAMETERS,
    Three,
    build_chain,
    dot_product,
    find_acceleration,
    inverse_dynamics,
    mass_matrix,
    parameter_gradient,
    place_end_effector,
    place_joints,
    propagate_motion,
    read_three,
    rotate_by_matrix,
)
from .rotation import relative_rotation


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
    """Writes the joint torques required for a motion in each of K poses into `torque`.

    The torque is M a + C(q, qd) v + G + armature a + friction(v), where M is the inertia
    matrix, C the Coriolis matrix, G the gravity torque and `armature` the inertia of the
    drives. Joint arrays have the shape (K, n). theta has the shape (K, 10 n), or (1, 10 n) if
    all poses share the same parameters.
    """
    last = theta.shape[0] - 1
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        propagate_motion(
            chain=chain,
            gravity=gravity,
            qd=qd[k],
            v=v[k],
            a=a[k],
        )
        parameters = theta[min(k, last)]
        inverse_dynamics(
            chain=chain,
            theta=parameters,
            v=v[k],
            a=a[k],
            torque=torque[k],
        )


@leaf
def _put_gradients(
    chain: RowArray,
    gravity: Array,
    q: Array,
    qd: Array,
    v: Array,
    a: Array,
    gradient: Array,
) -> None:
    """Writes Y'r for each of K poses into `gradient`, shape (K, 10 n).

    Y'r, where Y is the regressor and r = qd - v the velocity error, is the direction in which
    the adaptive law changes the parameter estimates. The motion arrays have the shape (K, n).
    """
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        propagate_motion(
            chain=chain,
            gravity=gravity,
            qd=qd[k],
            v=v[k],
            a=a[k],
        )
        parameter_gradient(chain, gradient[k])


@leaf
def _put_end_effectors(
    chain: RowArray,
    theta: Array,
    gravity: Array,
    tip: Array,
    q: Array,
    position: Array,
    J: Array,
    energy: Array,
) -> None:
    """Writes the end effector's position and Jacobian, and the potential energy, in K poses.

    The results are written into `position`, shape (K, 3), `J`, shape (K, 6, n), and `energy`,
    shape (K,). The potential energy of a link is -g'(m p + R mc), where m is its mass, mc its
    first moment, and p and R are its position and orientation in the base frame.
    """
    n = chain.shape[0]
    g = read_three(gravity)
    for k in range(q.shape[0]):
        place_joints(chain, q[k])
        x, y, z = place_end_effector(chain, tip)
        position[k, 0] = x
        position[k, 1] = y
        position[k, 2] = z
        link_x = 0.0
        link_y = 0.0
        link_z = 0.0
        energy[k] = 0.0
        for i in range(n):
            row: Row = chain[i]
            step = read_three(row.p)
            if i > 0:
                step = rotate_by_matrix(chain[i - 1].R_base, step)
            link_x = link_x + step[0]
            link_y = link_y + step[1]
            link_z = link_z + step[2]
            first = LINK_PARAMETERS * i
            mass = theta[first]
            moment = (theta[first + 1], theta[first + 2], theta[first + 3])
            moment_in_base = rotate_by_matrix(row.R_base, moment)
            mass_term = mass * dot_product(g, (link_x, link_y, link_z))
            moment_term = dot_product(g, moment_in_base)
            energy[k] -= mass_term + moment_term
            for j in range(3):
                J[k, j, i] = row.J_lin[j]
                J[k, 3 + j, i] = row.J_ang[j]


class ChainDynamics:
    """Dynamics and kinematics of a chain of n joints with known inertial parameters.

    The parameters theta determine the inertia matrix M, the Coriolis matrix C and the gravity
    torque G of the links. The inertia of the drives (armature) and the friction are taken from
    the joints.

    Args:
        chain: Joints, gravity and end effector.
        theta: Parameters of the links, shape (10 n,). See the module `chain`.
    """

    def __init__(self, chain: ChainSetup, theta: Array) -> None:
        self._theta = theta
        self._rows = build_chain(chain.joints, MAX_JOINTS)
        self._gravity = np.array(chain.gravity_m_s2)
        self._tip = np.array(chain.tip_m)
        self._tip_rotation = np.array(chain.tip_rotation)

    def compute_torque(
        self, q: Array, qd: Array, v: Array, a: Array, theta: Array | None = None
    ) -> Array:
        """Returns the joint torques required for a motion, in each of K poses.

        The torque is M a + C(q, qd) v + G + armature a + friction(v).

        Args:
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
            v: Reference velocities, shape (K, n), in rad/s.
            a: Reference accelerations, shape (K, n), in rad/s^2.
            theta: Parameters to use instead of those of the chain, for example estimates. Shape
                (K, 10 n), or (1, 10 n) if all poses share them.

        Returns:
            Joint torques, shape (K, n), in N m.
        """
        if theta is None:
            theta = self._theta[np.newaxis]
        torque = np.zeros_like(q)
        _put_torques(
            chain=self._rows,
            theta=np.ascontiguousarray(theta),
            gravity=self._gravity,
            q=np.ascontiguousarray(q),
            qd=np.ascontiguousarray(qd),
            v=np.ascontiguousarray(v),
            a=np.ascontiguousarray(a),
            torque=torque,
        )
        return torque

    def compute_gradient(self, q: Array, qd: Array, v: Array, a: Array) -> Array:
        """Returns Y'r, the gradient with which the adaptive law updates parameter estimates.

        Y is the regressor: Y theta is the torque required for a motion, where theta is the
        parameter vector. Y' is the transpose of Y, and r = qd - v the velocity error.

        Args:
            q: Joint angles in K poses, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
            v: Reference velocities, shape (K, n), in rad/s.
            a: Reference accelerations, shape (K, n), in rad/s^2.

        Returns:
            Gradient with respect to the 10 n parameters, shape (K, 10 n).
        """
        gradient = np.zeros((len(q), LINK_PARAMETERS * len(self._rows)))
        _put_gradients(
            chain=self._rows,
            gravity=self._gravity,
            q=np.ascontiguousarray(q),
            qd=np.ascontiguousarray(qd),
            v=np.ascontiguousarray(v),
            a=np.ascontiguousarray(a),
            gradient=gradient,
        )
        return gradient

    def place(self, q: Array) -> tuple[Array, Array, Array]:
        """Computes the end effector's position and Jacobian, and the potential energy.

        All positions are given in the base frame. K poses are evaluated in one call.

        Args:
            q: Joint angles, shape (K, n), in rad.

        Returns:
            Position of the end effector, shape (K, 3), in m.
            Jacobian of the end effector: three rows for the linear and three for the angular
                velocity, shape (K, 6, n).
            Potential energy due to gravity, shape (K,), in J.
        """
        poses, joints = q.shape
        position = np.zeros((poses, 3))
        J = np.zeros((poses, 6, joints))
        energy = np.zeros(poses)
        _put_end_effectors(
            chain=self._rows,
            theta=self._theta,
            gravity=self._gravity,
            tip=self._tip,
            q=np.ascontiguousarray(q),
            position=position,
            J=J,
            energy=energy,
        )
        return position, J, energy

    def place_points(self, q: Array) -> Array:
        """Returns the positions of base, joints and end effector in each of K poses.

        Connecting successive points with lines draws the links of the arm.

        Args:
            q: Joint angles, shape (K, n), in rad.

        Returns:
            Positions, shape (K, n + 2, 3), in m.
        """
        points_per_pose = len(self._rows) + 2
        points = np.zeros((len(q), points_per_pose, 3))
        for pose, angles in zip(points, q, strict=True):
            place_joints(self._rows, np.ascontiguousarray(angles))
            pose[-1] = place_end_effector(self._rows, self._tip)
            position = np.zeros(3)
            orientation = np.eye(3)
            for point, joint in enumerate(self._rows, 1):
                position = position + orientation @ joint.p
                pose[point] = position
                orientation = joint.R_base.copy()
        return points

    def find_orientation(self, q: Vector) -> Three:
        """Returns the orientation of the end effector in one pose as a rotation vector.

        The direction of the vector is the rotation axis, and its length is the angle in rad.

        Args:
            q: Joint angles, shape (n,), in rad.
        """
        place_joints(self._rows, np.asarray(q, dtype=np.float64))
        # This call computes R_base, the rotation from the base to each link.
        place_end_effector(self._rows, self._tip)
        return relative_rotation(self._rows[-1]["R_base"], self._tip_rotation.T)

    def find_inertia(self, q: Vector) -> Array:
        """Returns the inertia matrix M(q) in one pose, including the inertia of the drives.

        Args:
            q: Joint positions, rad (m for a prismatic joint), shape (n,).

        Returns:
            The symmetric matrix, shape (n, n), in kg m^2 for revolute joints.
        """
        place_joints(self._rows, np.asarray(q, dtype=np.float64))
        mass_matrix(self._rows, self._theta)
        # Only the lower triangle of the symmetric matrix is computed.
        lower = np.tril(self._rows["M"][:, : len(self._rows)])
        M: Array = lower + np.tril(lower, -1).T
        return M

    def find_acceleration(self, q: Array, qd: Array, torque: Array) -> Array:
        """Returns the joint accelerations caused by a torque in one pose.

        Args:
            q: Joint angles, shape (n,), in rad.
            qd: Joint velocities, shape (n,), in rad/s.
            torque: Torque ON the joints, shape (n,), in N m.

        Returns:
            Joint accelerations, shape (n,), in rad/s^2.
        """
        acceleration = np.zeros_like(q)
        place_joints(self._rows, q)
        find_acceleration(
            chain=self._rows,
            theta=self._theta,
            gravity=self._gravity,
            q=q,
            qd=qd,
            torque=torque,
            qdd=acceleration,
        )
        return acceleration

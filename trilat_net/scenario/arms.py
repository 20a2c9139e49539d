"""Defines the arms of an experiment: the planar two-link arm, and chains from URDF files.

`Arm` and `Task` are the tables in which the author of an experiment describes an arm.
`build_arm` converts them to an `ArmModel` with the geometry and the dynamic parameters that
computations need. From the model, `compute_rest_gains` derives the damping with which an arm is
brought to rest, and `bound_estimates` the bounds for the parameters that an adaptive control
law estimates.

Invariant:
    - If one arm of a scenario is a chain, all arms are modelled as chains. The planar arm is
      then a chain of two joints in the x-y plane. Therefore the same functions compute all
      arms.
    - Results are the same on every machine. The computation of eigenvalues differs between
      machines in the last bits, so a time that follows from eigenvalues is rounded up to whole
      milliseconds.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from .. import fields
from ..core import (
    ArmLinks,
    Array,
    ChainDynamics,
    ChainJoint,
    ChainSetup,
    FramePose,
    Gains,
    HandReach,
    Law,
    MotionLimits,
    RestGains,
    TaskSetup,
    Three,
    Vector,
    rotation_matrix,
)
from ..errors import ScenarioError, count_nouns
from .key_checks import VectorCounts, field_names
from .link_inertia import LinkInertia, TensorEntries, ThreeReals
from .urdf import UrdfChain, UrdfJoint, UrdfPayload, read_urdf

TASK_AXES: tuple[str, ...] = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the axes of a task: three translations and three rotations."""
STOP_REACH_RAD = 0.05
"""Depth in a stop at which the stop pushes with the effort limit of the joint, in rad or m."""
START_MARGIN_RAD = 0.15
START_MARGIN_M = 0.02
"""Largest distance of a start pose beyond a stop or a position limit.

The margin is 8.6 degrees, or 2 cm for a sliding joint. It is needed because encoders are set to
zero by hand, and arms are parked on stops that lie beyond those in their URDF files.
"""
STOP_EFFORT_NM = 100.0
"""Effort limit from which the stiffness of a stop is computed if the file states none."""
STOP_DAMPING_S = 0.01
"""Ratio of the damping of a stop to its stiffness, in s."""
PLANAR_UNITS = ("kg m^2", "kg m^2", "kg m^2", "kg m", "kg m")
"""Units of the five parameters of Eq. (24)."""
BODY_UNITS = {
    "m": "kg",
    **dict.fromkeys(("mc_x", "mc_y", "mc_z"), "kg m"),
    **dict.fromkeys(("Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"), "kg m^2"),
}
"""Units of the ten inertial parameters of a link of a chain, by name.

m is the mass, mc the mass times the centre of mass, and I the inertia about the joint's frame.
"""
_SLIDING_UNITS = {"rad": "m", "rad/s": "m/s", "N m": "N"}
"""Units of a sliding joint, by the unit of the same quantity of a rotating joint."""
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Arm(fields.Frozen, frozen=True):
    """Arm of a site, as the author of an experiment describes it in a scenario.

    An arm is either the planar arm of two links, or a chain of joints from a URDF file. The
    defaults of the planar arm are those of the paper, with point masses at the ends of the
    links. Each key belongs to one of the two kinds of arm, or to both.

    Attributes:
        l1_m: This key and the following keys up to I2_kg_m2 are those of `ArmLinks`.
        g_m_s2: Gravitational acceleration, in m/s^2.
        known: False if the masses and inertias are unknown, as for a robot that has not been
            identified. They are then not used in any formula. Only for a real robot.
        dead_man: True if the arm moves only while somebody holds its dead-man switch
            (`docs/sessions/external-arm.md`). Only for a real robot.
        urdf: Name of the URDF file of the arm, in `Scenario.urdf`. Empty for the planar arm.
        base_xyz_m: Position of the base in the frame that all sites share, in m. Walls and
            operators are described in this frame as well.
        base_rpy_rad: Orientation of the base in that frame, in rad: rotations about the fixed
            axes x, y and z, in this order.
        base: Name of the link that does not move. By default, the root of the file.
        tip: Name of the link at the end of the arm. By default, the only link that carries no
            other link.
        down: Direction of gravity in the frame of the base. Its length does not matter.
        payload_kg: Mass that is fixed to the tip, in kg. If it is 0, the next two keys have no
            effect.
        payload_com_m: Centre of mass of the payload in the frame of the tip, in m.
        payload_inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz of the payload about its centre of
            mass.
        armature_kg_m2: Inertia of each drive, reflected to its joint, in kg m^2, or in kg for a
            prismatic joint.
        stops: True if the joint limits of the file are mechanical stops, modelled as springs.
        balance_inertia: True if an impossible inertia in the file is replaced by the nearest
            possible one. False if it is refused.
        links: Masses and inertias that replace those of the file, by the name of the link.
    """

    l1_m: fields.Positive = 1.0
    m1_kg: fields.Positive = 1.0
    lc1_m: fields.NotNegative = 1.0
    I1_kg_m2: fields.NotNegative = 0.0
    l2_m: fields.Positive = 1.0
    m2_kg: fields.Positive = 1.0
    lc2_m: fields.Positive = 1.0
    I2_kg_m2: fields.NotNegative = 0.0
    g_m_s2: fields.NotNegative = 9.81
    known: bool = True
    dead_man: bool = False
    urdf: Annotated[str, Meta(extra={"must_be": "a file's name"})] = ""
    base_xyz_m: ThreeReals = (0.0, 0.0, 0.0)
    base_rpy_rad: ThreeReals = (0.0, 0.0, 0.0)
    base: str = ""
    tip: str = ""
    down: ThreeReals = (0.0, 0.0, -1.0)
    payload_kg: fields.NotNegative = 0.0
    payload_com_m: ThreeReals = (0.0, 0.0, 0.0)
    payload_inertia_kg_m2: TensorEntries = (0.0,) * 6
    armature_kg_m2: fields.NotNegativeJoints = (0.0,)
    stops: bool = True
    balance_inertia: bool = False
    links: dict[str, LinkInertia] = msgspec.field(default_factory=dict)

    def planar_links(self) -> ArmLinks:
        """Returns the lengths, masses and inertias of the two links of a planar arm.

        They are meaningless if the arm is a chain from a URDF file.
        """
        values = {name: getattr(self, name) for name in ArmLinks._fields}
        return ArmLinks(**values)

    def read_chain(self, urdf_texts: Mapping[str, str]) -> UrdfChain:
        """Reads the joints between the base and the tip of the arm from its URDF file.

        URDF is the usual XML format for the links and joints of a robot. Nothing is read from
        disk here: the texts of the files are an argument.

        Args:
            urdf_texts: Texts of the URDF files of the scenario, by name.

        Raises:
            ScenarioError: There is no such file, or it cannot be used. The error contains the
                path of a key below that of the arm.
        """
        if self.urdf not in urdf_texts:
            raise ScenarioError(f"{self.urdf!r} is not a file of the scenario", path="urdf")
        for key in ("payload_com_m", "payload_inertia_kg_m2"):
            if any(getattr(self, key)) and not self.payload_kg:
                raise ScenarioError("needs the mass of the payload: set payload_kg", path=key)
        payload = UrdfPayload(self.payload_kg, self.payload_com_m, self.payload_inertia_kg_m2)
        try:
            return _read_cached(
                text=urdf_texts[self.urdf],
                base=self.base,
                tip=self.tip,
                payload=payload if self.payload_kg else None,
                links=tuple(self.links.items()),
                balance=self.balance_inertia,
            )
        except ScenarioError as error:
            if error.path:
                raise
            # The message of `read_urdf` begins with its subject, for example "tip: ...".
            subject, _, problem = error.problem.partition(": ")
            if subject in _KEYS_OF_SUBJECTS:
                raise ScenarioError(problem, path=_KEYS_OF_SUBJECTS[subject]) from None
            raise ScenarioError(f"{self.urdf}: {error.problem}", path="urdf") from None


def start_margin(joint: ChainJoint) -> float:
    """Returns how far beyond its stops and position limits a joint may start, in rad or m.

    A real arm at rest may stand slightly beyond the nominal position of a stop.

    Args:
        joint: A joint of a chain. A prismatic joint has a margin in m.
    """
    return START_MARGIN_M if joint.prismatic else START_MARGIN_RAD


BASE_KEYS = ("base_xyz_m", "base_rpy_rad")
"""Keys of an arm that place its base in space."""
CHAIN_KEYS = field_names(Arm)[field_names(Arm).index("base") :]
"""Keys of an arm that only a chain has."""


class Task(fields.Frozen, frozen=True, omit_defaults=True):
    """Coordinates in which the arms of a session follow each other.

    They are joint angles, positions of the end effectors, or whole poses. Arms with different
    numbers of joints can only follow each other's positions or poses.

    Attributes:
        space: "joints": The sites share joint angles. "position": They share the positions of
            their end effectors. "pose": They share positions and orientations.
        axes: Axes along which the site follows its peers, out of x, y, z, rx, ry and rz. By
            default, all axes.
        scale: Number of metres in the shared coordinates per metre of this arm.
        posture_rad: Joint angles that the arm tends to in the directions that the task leaves
            free. By default, its start pose.
        posture_rate_1_s: Rate at which the arm returns to that posture, in 1/s.
        singular_value: Singular value of the Jacobian below which its inverse is damped.
    """

    space: Literal["joints", "position", "pose"] = "joints"
    axes: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    scale: fields.Positive = 1.0
    posture_rad: fields.Joints = ()
    posture_rate_1_s: fields.NotNegative = 0.0
    singular_value: fields.Positive = 0.05

    @property
    def shared(self) -> int:
        """Number of coordinates of the end effector that arms send each other: 3 or 6.

        These are 3 for a position and 6 for a pose. The number is 0 if they send joint angles
        instead, because the number of joints depends on the arm.
        """
        return {"joints": 0, "position": 3, "pose": 6}[self.space]

    def find_idle_key(self, written: Mapping[str, object]) -> fields.KeyProblem | None:
        """Returns a key that the author of a scenario wrote although it has no effect.

        Such a key is refused, because its author probably expected an effect.

        Args:
            written: Table of the task as its author wrote it.

        Returns:
            The key and the reason. None if every written key has an effect.
        """
        if not self.shared:
            for key in written:
                if key != "space":
                    return fields.KeyProblem(
                        key,
                        "has no effect while sites share joint angles: set task.space to "
                        "'position' or 'pose'",
                    )
            return None
        for axis in self.axes:
            if axis not in TASK_AXES[: self.shared]:
                return fields.KeyProblem(
                    "axes",
                    f"has {axis}, which belongs to a pose, but task.space is 'position'",
                )
        if self.posture_rad and not self.posture_rate_1_s:
            return fields.KeyProblem("posture_rad", "has no effect while posture_rate_1_s is 0")
        return None

    @property
    def setup(self) -> TaskSetup | None:
        """Settings of the shared coordinates, for the compiled control loop.

        They state along which axes of the end effector the arms follow each other, and with
        which scale and posture. The value is None if the arms follow each other's joint angles,
        because no settings are needed then.
        """
        if not self.shared:
            return None
        shared_axes = TASK_AXES[: self.shared]
        followed_axes = self.axes or shared_axes
        axes = tuple(float(axis in followed_axes) for axis in shared_axes)
        return TaskSetup(
            axes=axes,
            scale=self.scale,
            posture=self.posture_rad,
            posture_rate=self.posture_rate_1_s,
            singular_value=self.singular_value,
        )


class ArmModel(NamedTuple):
    """Model of an arm with n joints, which computes positions, Jacobians and inertias.

    `build_arm` creates it from the table of the arm in a scenario.

    Attributes:
        theta: True inertial parameters: the five of Eq. (24) for the planar arm, ten per link
            for a chain.
        counts: Lengths of the arm's vectors.
        joint_names: Names of the joints, starting at the base.
        link_names: Names of the links that the joints move.
        efforts: Largest effort of each joint according to the file, in N m or N. inf if the
            file does not state it.
        speeds: Largest speed of each joint according to the file, in rad/s or m/s. inf if the
            file does not state it.
        lengths_m: Lengths of the two links of the planar arm. (0, 0) for a chain.
        chain: Chain as the record that the simulation kernel reads. None for the planar arm.
    """

    theta: Array
    counts: VectorCounts
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    efforts: tuple[float, ...]
    speeds: tuple[float, ...]
    lengths_m: tuple[float, float]
    chain: ChainSetup | None = None

    @property
    def parameters(self) -> list[tuple[str, str]]:
        """Label and unit of each inertial parameter, in the order of `theta`.

        The planar arm has "theta_1", "theta_2" and so on. A chain names the link and the
        quantity. Figures and messages use these labels.
        """
        if self.chain is None:
            return [(f"theta_{n + 1}", unit) for n, unit in enumerate(PLANAR_UNITS)]
        parameters = []
        for link in self.link_names:
            parameters += [(f"{link}.{name}", unit) for name, unit in BODY_UNITS.items()]
        return parameters

    def widen_stops(self, q0: Vector) -> "ArmModel":
        """Returns the arm with stops moved outward, so that the start pose touches none.

        A stop is moved to the start pose if the joint starts beyond it by at most the margin,
        see `start_margin`. An arm that stands at rest beyond the nominal position of a stop
        does not touch the real stop, so the spring of the stop must not push.

        Args:
            q0: Start pose, in rad or m, shape (n,).
        """
        if self.chain is None:
            return self
        joints = []
        for joint, start in zip(self.chain.joints, q0, strict=True):
            margin = start_margin(joint)
            if joint.lower - margin <= start <= joint.upper + margin:
                lower = min(joint.lower, start)
                upper = max(joint.upper, start)
                joint = joint._replace(lower=lower, upper=upper)
            joints.append(joint)
        return self._replace(chain=self.chain._replace(joints=tuple(joints)))

    def joint_units(self, unit: str) -> list[str]:
        """Returns the unit of a quantity for each joint, for example ["rad", "m"].

        A joint that slides (prismatic) has m in place of rad, and N in place of N m.

        Args:
            unit: Unit of the quantity for a rotating joint, for example "rad/s".
        """
        if self.chain is None:
            return [unit] * self.counts.joints
        return [
            _SLIDING_UNITS.get(unit, unit) if joint.prismatic else unit
            for joint in self.chain.joints
        ]

    def end_effector(self, q: Vector) -> list[float]:
        """Returns the position of the end effector at the joint angles `q`, m.

        Args:
            q: Joint angles in rad, or m for a prismatic joint, shape (n,).

        Returns:
            The coordinates: two for the planar arm, three for a chain.
        """
        if self.chain is None:
            l1, l2 = self.lengths_m
            upper_arm = q[0]
            forearm = q[0] + q[1]
            x = l1 * math.cos(upper_arm) + l2 * math.cos(forearm)
            y = l1 * math.sin(upper_arm) + l2 * math.sin(forearm)
            return [x, y]
        position, _ = self._place_end_effector(q)
        coordinates: list[float] = position.tolist()
        return coordinates

    @property
    def _dynamics(self) -> ChainDynamics:
        """Dynamics and kinematics of the chain."""
        assert self.chain is not None
        return ChainDynamics(self.chain, self.theta)

    def _place_end_effector(self, q: Vector) -> tuple[Array, Array]:
        """Returns the end effector's position, shape (3,), and its Jacobian, shape (6, n)."""
        position, J, _ = self._dynamics.place(np.array([q], dtype=np.float64))
        return position[0], J[0]

    def end_effector_orientation(self, q: Vector) -> tuple[float, float, float]:
        """Returns the orientation of the end effector at the joint angles `q`.

        Args:
            q: Joint angles in rad, or m for a prismatic joint, shape (n,).

        Returns:
            A rotation vector, whose direction is the axis and whose length is the angle in rad.
        """
        if self.chain is None:
            return 0.0, 0.0, q[0] + q[1]
        return self._dynamics.find_orientation(q)

    @property
    def reach(self) -> HandReach:
        """Range of the distance of the end effector from the first joint.

        It is exact for the planar arm, and a bound for a chain. Each joint, and the end
        effector, has a fixed distance from the previous joint, plus the travel of a sliding
        joint. The largest distance is the sum of all of these. Without sliding joints, the
        smallest distance is at least the longest link minus the sum of the other links.
        """
        if self.chain is None:
            l1, l2 = self.lengths_m
            return HandReach((0.0, 0.0), abs(l1 - l2), l1 + l2)
        joints = self.chain.joints
        offsets_m = [joint.origin_m for joint in joints[1:]]
        offsets_m.append(self.chain.tip_m)
        lengths_m = [math.sqrt(sum(x * x for x in offset)) for offset in offsets_m]
        sliding_joints = [joint for joint in joints if joint.prismatic]
        travels_m = [max(abs(joint.lower), abs(joint.upper)) for joint in sliding_joints]
        outer_m = sum(lengths_m) + sum(travels_m)
        inner_m = 0.0
        if not travels_m:
            inner_m = max(0.0, 2.0 * max(lengths_m) - sum(lengths_m))
        return HandReach(joints[0].origin_m, inner_m, outer_m)

    def find_joint_reach(self, limits: MotionLimits) -> HandReach:
        """Returns the range in which each joint of the arm may move.

        The range is bounded by the mechanical stops of the arm and by the position limits of
        the experiment. The narrower bound counts.

        Args:
            limits: Position limits of the site that runs the arm.
        """
        joints = self.counts.joints
        low = np.broadcast_to(np.array(limits.q_min, dtype=np.float64), joints)
        high = np.broadcast_to(np.array(limits.q_max, dtype=np.float64), joints)
        if self.chain is not None:
            low = np.maximum(low, [joint.lower for joint in self.chain.joints])
            high = np.minimum(high, [joint.upper for joint in self.chain.joints])
        return HandReach(low=tuple(low.tolist()), high=tuple(high.tolist()))

    @property
    def shares_pose(self) -> bool:
        """True if the arms follow each other's end effectors, and not each other's joints."""
        return self.chain is not None and self.chain.task is not None

    @property
    def axes(self) -> tuple[float, ...]:
        """Directions in which the end effector follows other arms: 1 for followed, 0 for free.

        For example (1, 1, 0) for an end effector that follows in x and y, and is free in z.
        Empty if the sites share joint angles.
        """
        task = None if self.chain is None else self.chain.task
        return () if task is None else task.axes

    def shared_pose(self, q: Vector) -> tuple[float, ...]:
        """Returns the coordinates that an arm sends to the others in the pose `q`.

        These are the joint angles, or the position of the end effector multiplied by a scale.
        If whole poses are sent, the orientation as a rotation vector in rad follows.

        Args:
            q: Joint angles in rad, or m for a prismatic joint, shape (n,).
        """
        if self.chain is None or self.chain.task is None:
            return tuple(q)
        position = np.array(self.end_effector(q)) * self.chain.task.scale
        if self.counts.shared == len(position):
            return tuple(position.tolist())
        return (*position.tolist(), *self.end_effector_orientation(q))

    def task_jacobian(self, q: Vector) -> Array:
        """Returns the Jacobian J that converts joint velocities to task velocities: xd = J qd.

        Task coordinates describe the end effector, if the arms follow each other's end
        effectors.

        Args:
            q: Joint angles in rad, or m for a prismatic joint, shape (n,).

        Returns:
            The Jacobian, shape (m, n), where m is the number of task coordinates.
        """
        assert self.chain is not None
        assert self.chain.task is not None
        _, J = self._place_end_effector(q)
        task_J = np.vstack([self.chain.task.scale * J[:3], J[3:]])
        return task_J[: self.counts.shared]

    def largest_gravity(self, g_m_s2: float) -> tuple[float, ...]:
        """Returns the largest torques that gravity can exert on the joints of the planar arm.

        The values are upper bounds over all poses.

        Args:
            g_m_s2: Gravitational acceleration, in m/s^2.

        Returns:
            One torque per joint, in N m. Empty for a chain.
        """
        if self.chain is not None:
            return ()
        upper_nm, lower_nm = (abs(float(moment)) * g_m_s2 for moment in self.theta[3:5])
        return upper_nm + lower_nm, lower_nm

    def inertia(self, q: Array) -> Array:
        """Returns the inertia matrix M(q) of a chain, including its drives.

        Multiplied by the joint accelerations, it gives the torques that accelerate the arm.

        Args:
            q: Joint angles in rad, or m for a prismatic joint, shape (n,).

        Returns:
            The symmetric matrix, shape (n, n), in kg m^2 for rotating joints.
        """
        return self._dynamics.find_inertia(q)

    def compute_rest_gains(
        self,
        q0: Vector,
        law_damping: Array,
        limit_nm: Vector,
        rate_hz: int,
        *,
        known: bool,
    ) -> RestGains:
        """Computes the gains with which an arm is brought to rest by damping.

        M is the inertia matrix of the arm. The joint i gets the damping B = M_ii / T, where T
        is a time constant. Because the joints are coupled, the fastest motion of the arm
        decays with the rate lambda / T, where lambda is the largest eigenvalue of diag(M) M^-1.
        T is chosen so that the time constant T / lambda of this motion is at least
        `BRAKE_TICKS` ticks. If the inertia of the arm is not known, B is the damping of the
        control law, for joints for which it is positive.

        Args:
            q0: Start pose, for which the inertia of a chain is computed. The inertia of the
                planar arm is that of the stretched pose.
            law_damping: Damping of the control law for each joint, in N m s/rad, shape (n,).
            limit_nm: Largest torque, in N m, as one number or one per joint.
            rate_hz: Tick rate of the site, in Hz.
            known: False if the parameters of the model are not those of the arm.
        """
        if self.chain is None:
            a, b, c = self.theta[:3].tolist()
            M = np.array([[a + 2.0 * b, c + b], [c + b, c]])
        else:
            M = self.inertia(np.array(q0))
        inertia = np.diag(M)

        # diag(M) M^-1 has the eigenvalues of the symmetric diag(M)^(1/2) M^-1 diag(M)^(1/2).
        root = np.sqrt(inertia)
        symmetric = root * np.linalg.inv(M) * root[:, None]
        fastest = np.linalg.eigvalsh(symmetric)[-1]
        # Eigenvalues differ in the last bit between machines; whole milliseconds do not.
        rounded_s = math.ceil(1e3 * BRAKE_TICKS * fastest / rate_hz) * 1e-3
        time_s = max(BRAKE_S, rounded_s)
        if not known:
            time_s = UNKNOWN_BRAKE_S
            inertia = np.where(law_damping > 0.0, law_damping * time_s, inertia)
        damping = inertia / time_s
        limits_nm = np.broadcast_to(limit_nm, inertia.shape)
        deceleration = BRAKE_TORQUE_SHARE * limits_nm / inertia
        return RestGains(tuple(damping.tolist()), time_s, tuple(deceleration.tolist()))

    def bound_estimates(self, gains: Gains, limit_nm: Vector, g_m_s2: float) -> Gains:
        """Adds bounds to the gains of an adaptive control law, for the parameters it estimates.

        The motors must be able to hold the arm against gravity, which bounds the parameters.
        Let T be the largest torque of a joint, g the gravitational acceleration, and l the
        length of a link (for a chain, the reach of the arm):

        - a first moment (mass times distance) is at most T / g;
        - a second moment (moment of inertia) is at most l T / g;
        - the mass of a link is at most T / g divided by the mean length of the links;
        - masses, and second moments about an axis, are not negative.

        The bounds are widened so that they include the first estimate. Gains that have bounds
        already, and gains of other laws, are returned unchanged.

        Args:
            gains: Gains of the control law, with the first estimate of the parameters.
            limit_nm: Largest torque, in N m, as one number or one per joint.
            g_m_s2: Gravitational acceleration, in m/s^2. Without gravity, no bounds are added.
        """
        has_box = np.isfinite(gains.low).any()
        if gains.law is not Law.ADAPTIVE or has_box or g_m_s2 == 0.0:
            return gains
        if self.chain is None:
            low, high = _bound_planar_parameters(self, limit_nm, g_m_s2)
        else:
            low, high = _bound_chain_parameters(self, self.chain, np.max(limit_nm), g_m_s2)
        first_estimate = np.broadcast_to(gains.theta_hat0, high.shape)
        return gains._replace(
            low=tuple(np.minimum(low, first_estimate).tolist()),
            high=tuple(np.maximum(high, first_estimate).tolist()),
        )


def _is_positive_definite(theta: Array) -> bool:
    """Returns True if the inertia matrix of the planar arm is positive definite in any pose.

    Otherwise the parameters describe no real arm. With the angle q2 of the second joint, the
    inertia matrix is

        M = | theta_1 + 2 theta_2 cos(q2)    theta_3 + theta_2 cos(q2) |
            | theta_3 + theta_2 cos(q2)      theta_3                   |

        det M = theta_1 theta_3 - theta_3^2 - theta_2^2 cos(q2)^2

    The determinant is smallest for the stretched arm, q2 = 0, so only this pose is checked. The
    check has a margin for rounding.

    Args:
        theta: Dynamic parameters of the arm, shape (5,), see `ArmLinks.theta`. The first
            three are inertias, kg m^2.
    """
    theta_1 = theta[0]
    theta_2 = theta[1]
    theta_3 = theta[2]
    least_determinant = theta_1 * theta_3 - theta_3**2 - theta_2**2
    margin = 1e-9 * theta_1 * theta_3
    return bool(theta_3 > 0.0 and least_determinant > margin)


def build_arm(arm: Arm, task: Task, urdf_texts: Mapping[str, str], chains: bool) -> ArmModel:
    """Builds the model of an arm from its table in a scenario, to compute its dynamics.

    Args:
        arm: Table of the arm, with its lengths and masses or the name of its URDF file.
        task: Coordinates that the site of the arm shares with other sites.
        urdf_texts: Texts of the URDF files of the scenario, by name.
        chains: True if all arms of the scenario are computed as chains of joints in space,
            including the planar arm.

    Raises:
        ScenarioError: The file of the arm cannot be used, or the planar arm has a singular
            inertia matrix. The error contains the path of a key below that of the arm.
    """
    if arm.urdf:
        return _build_chain_model(arm, task, arm.read_chain(urdf_texts))
    theta = arm.planar_links().theta()
    if not _is_positive_definite(theta):
        raise ScenarioError(
            "the inertia matrix is singular in some pose: give the links mass away from their "
            "joints"
        )
    counts = VectorCounts()
    lengths_m = (arm.l1_m, arm.l2_m)
    chain = None
    if chains:
        theta = _list_planar_bodies(arm)
        counts = VectorCounts.of_chain(2, task.shared)
        lengths_m = (0.0, 0.0)
        chain = _build_planar_chain(arm, task)
    return ArmModel(
        theta=theta,
        counts=counts,
        joint_names=("q1", "q2"),
        link_names=("link1", "link2"),
        efforts=(math.inf, math.inf),
        speeds=(math.inf, math.inf),
        lengths_m=lengths_m,
        chain=chain,
    )


def _list_planar_bodies(arm: Arm) -> Array:
    """Returns the planar arm's inertial parameters as those of a chain, shape (20,).

    A link has the mass m, its centre of mass at (c, 0, 0), and the moment of inertia I about
    the z axis through the centre of mass. About its joint, the first moment along x is m c, and
    Iyy = Izz = m c^2 + I.
    """
    links = (
        (arm.m1_kg, arm.lc1_m, arm.I1_kg_m2),
        (arm.m2_kg, arm.lc2_m, arm.I2_kg_m2),
    )
    bodies = []
    for m, c, inertia in links:
        about_joint = m * c * c + inertia
        bodies.append((m, m * c, 0.0, 0.0, 0.0, 0.0, about_joint, 0.0, 0.0, about_joint))
    return np.concatenate(bodies)


def _build_planar_chain(arm: Arm, task: Task) -> ChainSetup:
    """Returns the planar arm of two links as a general chain of joints.

    The planar arm can then be simulated together with arms from URDF files. Its joints rotate
    about z, and gravity acts along -y.
    """
    shoulder = ChainJoint(
        prismatic=False, axis=(0.0, 0.0, 1.0), rotation=_IDENTITY, origin_m=(0.0, 0.0, 0.0)
    )
    elbow = shoulder._replace(origin_m=(arm.l1_m, 0.0, 0.0))
    joints, gravity = _place_base(arm, (shoulder, elbow), (0.0, -arm.g_m_s2, 0.0))
    return ChainSetup(joints, gravity, (arm.l2_m, 0.0, 0.0), task=task.setup)


_KEYS_OF_SUBJECTS = {"base": "base", "tip": "tip", "payload": "payload_inertia_kg_m2"}
"""Key of the arm for each subject of an error message of `read_urdf`.

Errors with another subject concern the file.
"""


@lru_cache(maxsize=64)
def _read_cached(
    text: str,
    base: str,
    tip: str,
    payload: UrdfPayload | None,
    links: tuple[tuple[str, LinkInertia], ...],
    *,
    balance: bool,
) -> UrdfChain:
    """Reads the chain of joints in a URDF file, see `read_urdf`.

    The result is cached, so the same file is not read again.
    """
    return read_urdf(
        text=text,
        base=base,
        tip=tip,
        payload=payload,
        links=dict(links),
        balance=balance,
    )


def _place_base(
    arm: Arm, joints: tuple[ChainJoint, ...], gravity: Three
) -> tuple[tuple[ChainJoint, ...], Three]:
    """Expresses the joints of an arm, and gravity, in a frame that is common to all arms.

    The rotation of the base is R_z(yaw) R_y(pitch) R_x(roll). Only the first joint changes,
    because the other joints are expressed in the frame of the joint before them.

    Args:
        arm: Table of the arm.
        joints: Joints in the frame of the base.
        gravity: Gravitational acceleration in the frame of the base.
    """
    if not (any(arm.base_xyz_m) or any(arm.base_rpy_rad)):
        return joints, gravity
    roll, pitch, yaw = arm.base_rpy_rad
    R_x = rotation_matrix((roll, 0.0, 0.0))
    R_y = rotation_matrix((0.0, pitch, 0.0))
    R_z = rotation_matrix((0.0, 0.0, yaw))
    turn = FramePose(R_z) @ (FramePose(R_y) @ FramePose(R_x))
    x, y, z = arm.base_xyz_m
    base = FramePose(turn.rotation, (x, y, z))
    first = joints[0]
    pose = base @ FramePose(first.rotation, first.origin_m)
    placed = first._replace(rotation=pose.rotation, origin_m=pose.origin_m)
    return (placed, *joints[1:]), base.turn(gravity)


def _build_chain_model(arm: Arm, task: Task, urdf_chain: UrdfChain) -> ArmModel:
    """Builds the model of an arm from the joints that were read from its URDF file.

    Raises:
        ScenarioError: The number of drive inertias differs from the number of joints.
    """
    joint_count = len(urdf_chain.joints)
    if len(arm.armature_kg_m2) not in (1, joint_count):
        problem = (
            f"has {count_nouns(len(arm.armature_kg_m2), 'number')}, and the arm has "
            f"{count_nouns(joint_count, 'joint')}"
        )
        raise ScenarioError(problem, path="armature_kg_m2")
    armature_kg_m2 = np.broadcast_to(arm.armature_kg_m2, joint_count).tolist()
    joints = tuple(
        _build_joint(joint, drive_inertia, has_stops=arm.stops)
        for joint, drive_inertia in zip(urdf_chain.joints, armature_kg_m2, strict=True)
    )
    x, y, z = arm.down
    scale = arm.g_m_s2 / math.sqrt(x * x + y * y + z * z)
    joints, gravity = _place_base(arm, joints, (scale * x, scale * y, scale * z))
    return ArmModel(
        theta=np.concatenate([joint.inertia for joint in urdf_chain.joints]),
        counts=VectorCounts.of_chain(joint_count, task.shared),
        joint_names=tuple(joint.name for joint in urdf_chain.joints),
        link_names=tuple(joint.link for joint in urdf_chain.joints),
        efforts=tuple(joint.effort_limit for joint in urdf_chain.joints),
        speeds=tuple(joint.velocity_limit for joint in urdf_chain.joints),
        lengths_m=(0.0, 0.0),
        chain=ChainSetup(
            joints=joints,
            gravity_m_s2=gravity,
            tip_m=urdf_chain.tip_origin_m,
            tip_rotation=urdf_chain.tip_rotation,
            task=task.setup,
        ),
    )


def _build_joint(joint: UrdfJoint, armature_kg_m2: float, *, has_stops: bool) -> ChainJoint:
    """Converts a joint of a URDF file to the format that the compiled simulation reads.

    The ends of the joint's range become stops: a spring that pushes with the effort limit of
    the joint at the depth `STOP_REACH_RAD`, and a damper with `STOP_DAMPING_S` times the
    stiffness.

    Args:
        joint: Joint from the file.
        armature_kg_m2: Inertia of the drive.
        has_stops: Whether the joint limits of the file are stops.
    """
    chain_joint = ChainJoint(
        prismatic=joint.kind == "prismatic",
        axis=joint.axis,
        rotation=joint.rotation,
        origin_m=joint.origin_m,
        armature_kg_m2=armature_kg_m2,
        viscous=joint.viscous,
        coulomb=joint.coulomb,
    )
    if not has_stops:
        return chain_joint
    effort = joint.effort_limit if 0.0 < joint.effort_limit < math.inf else STOP_EFFORT_NM
    stiffness = effort / STOP_REACH_RAD
    return chain_joint._replace(
        lower=joint.lower,
        upper=joint.upper,
        stop_stiffness=stiffness,
        stop_damping=STOP_DAMPING_S * stiffness,
    )


BRAKE_S = 0.03
"""Smallest time constant with which damping brings a joint to rest, in s."""
BRAKE_TICKS = 4
"""Smallest time constant that the damping may give to any motion of the arm, in ticks."""
UNKNOWN_BRAKE_S = 0.1
"""Time constant for an arm whose inertia is not known, in s."""
BRAKE_TORQUE_SHARE = 0.5
"""Fraction of the largest torque that is used to decelerate the reference."""


def _bound_planar_parameters(
    arm: ArmModel, limit_nm: Vector, g_m_s2: float
) -> tuple[Array, Array]:
    """Returns lower and upper bounds of the planar arm's five parameters, shape (5,) each.

    They follow from the torque of the motors, which can hold the arm, see `bound_estimates`.
    Eq. (24) defines the parameters.
    """
    T_1, T_2 = np.broadcast_to(limit_nm, 2)
    outer = min(T_1, T_2) / g_m_s2
    inner = T_1 / g_m_s2
    l1, l2 = arm.lengths_m
    second_moments = [l1 * inner + l2 * outer, l1 * outer, l2 * outer]
    first_moments = [inner, outer]
    return np.zeros(5), np.array([*second_moments, *first_moments])


def _bound_chain_parameters(
    arm: ArmModel, chain: ChainSetup, limit_nm: float, g_m_s2: float
) -> tuple[Array, Array]:
    """Returns lower and upper bounds of the ten parameters of each link, shape (10 n,) each.

    They follow from the torque of the motors, which can hold the arm, see `bound_estimates`.
    """
    joints = arm.counts.joints
    reach_m = sum(float(np.linalg.norm(joint.origin_m)) for joint in chain.joints)
    reach_m += float(np.linalg.norm(chain.tip_m))
    link_m = reach_m / joints
    first = limit_nm / g_m_s2
    second = reach_m * limit_nm / g_m_s2
    # Order: m, m c_x, m c_y, m c_z, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
    link_high = [first / link_m, *[first] * 3, *[second] * 6]
    link_low = [0.0, *[-first] * 3, 0.0, -second, 0.0, -second, -second, 0.0]
    return np.tile(link_low, joints), np.tile(link_high, joints)

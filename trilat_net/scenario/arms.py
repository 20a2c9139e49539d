"""Arms of an experiment: the planar two-link arm, and serial chains read from URDF files.

`Arm` and `Task` are the scenario tables that describe an arm. `build_arm` converts them to an
`ArmModel`, which holds the geometry and the dynamic parameters. The model also computes the
damping used to bring the arm to rest (`compute_rest_gains`) and the bounds on the parameters
that an adaptive control law estimates (`bound_estimates`).

Invariant:
    - If one arm of a scenario is a chain, all of its arms are modelled as chains, so the same
      functions apply to each of them. The planar arm then becomes a chain of two joints in the
      x-y plane.
    - Results are identical on every machine. Eigenvalues differ between machines in the last
      bits, so any time derived from eigenvalues is rounded up to whole milliseconds.
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
    MotionLimits,
    RestGains,
    TaskSetup,
    Three,
    Vector,
)
from ..errors import ScenarioError, count_nouns
from .key_checks import VectorCounts, field_names
from .link_inertia import LinkInertia, TensorEntries, ThreeReals
from .urdf import UrdfChain, UrdfJoint, UrdfPayload, read_urdf

TASK_AXES: tuple[str, ...] = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the axes of a task: three translations and three rotations."""
STOP_REACH_RAD = 0.05
"""Depth of penetration at which a stop pushes with the joint's effort limit, in rad or m."""
START_MARGIN_RAD = 0.15
START_MARGIN_M = 0.02
"""Largest permitted distance of a start pose beyond a stop or a position limit.

The margin is 8.6 degrees, or 2 cm for a prismatic joint. It is needed because encoders are
zeroed by hand, and arms are parked on stops that lie beyond those in their URDF files.
"""
STOP_EFFORT_NM = 100.0
"""Effort limit for computing the stiffness of a stop if the file has none."""
STOP_DAMPING_S = 0.01
"""Ratio of the damping of a stop to its stiffness, in s."""
PLANAR_UNITS = ("kg m^2", "kg m^2", "kg m^2", "kg m", "kg m")
"""Units of the five parameters in Eq. (24)."""
BODY_UNITS = {
    "m": "kg",
    **dict.fromkeys(("mc_x", "mc_y", "mc_z"), "kg m"),
    **dict.fromkeys(("Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"), "kg m^2"),
}
"""Mapping from name to unit of the ten inertial parameters of a link in a chain.

m is the mass, mc is the mass times the centre of mass, and I is the inertia about the origin of
the joint frame.
"""
_SLIDING_UNITS = {"rad": "m", "rad/s": "m/s", "N m": "N"}
"""Mapping from the unit of a quantity at a revolute joint to that at a prismatic joint."""
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Arm(fields.Frozen, frozen=True):
    """Description of a site's arm in a scenario.

    An arm is either the planar two-link arm or a serial chain read from a URDF file. Some keys
    apply to only one of the two. The defaults for the planar arm are taken from the paper, with
    point masses at the ends of the links.

    Attributes:
        l1_m: See `ArmLinks` for this key and those that follow, up to I2_kg_m2.
        g_m_s2: Gravitational acceleration, in m/s^2.
        known: False if the masses and inertias are unknown, as for a robot that has not been
            identified. No formula uses them in that case. Real robots only.
        dead_man: True if the arm moves only while its dead-man switch is held
            (`docs/sessions/external-arm.md`). Real robots only.
        urdf: Name of the arm's URDF file in `Scenario.urdf`. Empty for the planar arm.
        base_xyz_m: Position of the base in the shared frame, in m. Walls and operators are also
            described in that frame.
        base_rpy_rad: Orientation of the base in the shared frame, in rad, as successive
            rotations about the fixed axes x, y and z.
        base: Name of the fixed link. By default, the root link of the file.
        tip: Name of the link at the end of the arm. By default, the only leaf link of the file.
        down: Direction of gravity in the base frame. Need not be normalised.
        payload_kg: Mass attached to the tip, in kg. If 0, the next two keys have no effect.
        payload_com_m: Centre of mass of the payload in the tip frame, in m.
        payload_inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz of the payload about its centre of
            mass.
        armature_kg_m2: Inertia of each drive reflected to its joint, in kg m^2 (kg for a
            prismatic joint).
        stops: True if the joint limits of the file are mechanical stops, which are modelled as
            springs.
        balance_inertia: If True, a physically impossible inertia in the file is replaced with
            the nearest possible one. If False, it is rejected.
        links: Mapping from link name to the mass and inertia that override those of the file.
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

        The values are meaningless for an arm read from a URDF file.
        """
        values = {name: getattr(self, name) for name in ArmLinks._fields}
        return ArmLinks(**values)

    def read_chain(self, urdf_texts: Mapping[str, str]) -> UrdfChain:
        """Parses the joints between the base and the tip of the arm from its URDF file.

        The file is taken from `urdf_texts`; nothing is read from disk.

        Args:
            urdf_texts: Mapping from name to content of the scenario's URDF files.

        Raises:
            ScenarioError: The file is missing or cannot be used. The error contains a key path
                relative to the arm.
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

    A real arm at rest can stand slightly beyond the nominal position of a stop.

    Args:
        joint: A joint of a chain. For a prismatic joint, the margin is in m.
    """
    return START_MARGIN_M if joint.prismatic else START_MARGIN_RAD


BASE_KEYS = ("base_xyz_m", "base_rpy_rad")
"""Keys of an arm that specify the pose of its base."""
CHAIN_KEYS = field_names(Arm)[field_names(Arm).index("base") :]
"""Keys of an arm that apply only to a chain."""


class Task(fields.Frozen, frozen=True, omit_defaults=True):
    """The coordinates in which the arms of a session follow each other.

    The arms share joint angles, end effector positions or full end effector poses. Arms that
    differ in their number of joints can only share positions or poses.

    Attributes:
        space: "joints" to share joint angles, "position" to share end effector positions, or
            "pose" to share positions and orientations.
        axes: Axes along which the site follows its peers, chosen from x, y, z, rx, ry and rz.
            By default, all axes.
        scale: Scale factor from this arm's coordinates to the shared coordinates, in m per m.
        posture_rad: Posture to which the arm returns in the directions that the task leaves
            free, in rad. By default, the start pose.
        posture_rate_1_s: Rate of the return to that posture, in 1/s.
        singular_value: Singular value of the Jacobian below which the inverse is damped.
    """

    space: Literal["joints", "position", "pose"] = "joints"
    axes: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    scale: fields.Positive = 1.0
    posture_rad: fields.Joints = ()
    posture_rate_1_s: fields.NotNegative = 0.0
    singular_value: fields.Positive = 0.05

    @property
    def shared(self) -> int:
        """Number of shared end effector coordinates: 3 or 6, or 0 for joint angles.

        A position has 3 coordinates and a pose has 6. For joint angles the value is 0, since
        the number of joints depends on the arm.
        """
        return {"joints": 0, "position": 3, "pose": 6}[self.space]

    def find_idle_key(self, written: Mapping[str, object]) -> fields.KeyProblem | None:
        """Looks for a key that the author set although it has no effect.

        Such a key is rejected, since its author probably expected it to do something.

        Args:
            written: The task table as written by its author.

        Returns:
            The key and the reason, or None if every key has an effect.
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
        """Settings of the shared coordinates for the compiled control loop.

        They specify the axes along which the end effectors follow each other, the scale and the
        posture. None if the arms follow each other's joint angles, which needs no settings.
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
    """Model of an arm with n joints, used to compute positions, Jacobians and inertias.

    Created by `build_arm` from the arm's table in a scenario.

    Attributes:
        theta: True inertial parameters: the five parameters of Eq. (24) for the planar arm, or
            ten per link for a chain.
        counts: Lengths of the arm's vectors.
        joint_names: Names of the joints, from the base to the tip.
        link_names: Names of the links moved by the joints.
        efforts: Effort limit of each joint from the URDF file, in N m or N; inf if the file has
            none.
        speeds: Speed limit of each joint from the URDF file, in rad/s or m/s; inf if the file
            has none.
        lengths_m: Lengths of the two links of the planar arm, in m; (0, 0) for a chain.
        chain: The chain in the record format read by the simulation kernel; None for the planar
            arm.
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

        Labels are "theta_1", "theta_2" and so on for the planar arm. For a chain, a label names
        the link and the quantity. Figures and messages use these labels.
        """
        if self.chain is None:
            return [(f"theta_{n + 1}", unit) for n, unit in enumerate(PLANAR_UNITS)]
        parameters = []
        for link in self.link_names:
            parameters += [(f"{link}.{name}", unit) for name, unit in BODY_UNITS.items()]
        return parameters

    def widen_stops(self, q0: Vector) -> "ArmModel":
        """Returns a copy of the arm with its stops moved outward, clear of the start pose.

        If a joint starts beyond a stop by no more than `start_margin`, the stop is moved to the
        start position. The real arm stands at rest there without touching its stop, so the
        spring of the stop must not push.

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

        For a prismatic joint, rad is replaced with m and N m with N.

        Args:
            unit: Unit of the quantity for a revolute joint, for example "rad/s".
        """
        if self.chain is None:
            return [unit] * self.counts.joints
        return [
            _SLIDING_UNITS.get(unit, unit) if joint.prismatic else unit
            for joint in self.chain.joints
        ]

    def end_effector(self, q: Vector) -> list[float]:
        """Returns the position of the end effector at the joint angles `q`, in m.

        Args:
            q: Joint positions in rad, or in m for a prismatic joint, shape (n,).

        Returns:
            Two coordinates for the planar arm, three for a chain.
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
            q: Joint positions in rad, or in m for a prismatic joint, shape (n,).

        Returns:
            Rotation vector, in rad: its direction is the rotation axis and its length the
                angle.
        """
        if self.chain is None:
            return 0.0, 0.0, q[0] + q[1]
        return self._dynamics.find_orientation(q)

    @property
    def reach(self) -> HandReach:
        """Range of distances between the end effector and the first joint, in m.

        Exact for the planar arm, a bound for a chain. The upper bound is the sum of the
        distances between consecutive joints (including the end effector) and the travel of all
        prismatic joints. Without prismatic joints, the lower bound is the length of the longest
        link minus the sum of the others, or 0 if this is negative.
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
        """Returns the range in which each joint of the arm may move, in rad or m.

        The range is the intersection of the mechanical stops of the arm and the position limits
        of the site.

        Args:
            limits: Motion limits of the site to which the arm belongs.
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
        """True if the arms follow each other's end effectors instead of each other's joints."""
        return self.chain is not None and self.chain.task is not None

    @property
    def axes(self) -> tuple[float, ...]:
        """Directions in which the end effector follows its peers: 1 for followed, 0 for free.

        For example, (1, 1, 0) for an end effector that follows in x and y but not in z. Empty
        if the sites share joint angles.
        """
        task = None if self.chain is None else self.chain.task
        return () if task is None else task.axes

    def shared_pose(self, q: Vector) -> tuple[float, ...]:
        """Returns the coordinates that the arm sends to its peers in the pose `q`.

        These are either the joint angles or the scaled position of the end effector, followed
        by its orientation as a rotation vector in rad if the arms share full poses.

        Args:
            q: Joint positions in rad, or in m for a prismatic joint, shape (n,).
        """
        if self.chain is None or self.chain.task is None:
            return tuple(q)
        position = np.array(self.end_effector(q)) * self.chain.task.scale
        if self.counts.shared == len(position):
            return tuple(position.tolist())
        return (*position.tolist(), *self.end_effector_orientation(q))

    def task_jacobian(self, q: Vector) -> Array:
        """Returns the Jacobian J that maps joint velocities to task velocities: xd = J qd.

        Call this method only if the arms follow each other's end effectors.

        Args:
            q: Joint positions in rad, or in m for a prismatic joint, shape (n,).

        Returns:
            The Jacobian, shape (m, n), where m is the number of task coordinates.
        """
        assert self.chain is not None
        assert self.chain.task is not None
        _, J = self._place_end_effector(q)
        task_J = np.vstack([self.chain.task.scale * J[:3], J[3:]])
        return task_J[: self.counts.shared]

    def largest_gravity(self, g_m_s2: float) -> tuple[float, ...]:
        """Returns upper bounds on the gravity torques of the planar arm, in N m.

        The bounds hold in every pose.

        Args:
            g_m_s2: Gravitational acceleration, in m/s^2.

        Returns:
            One torque per joint. Empty for a chain.
        """
        if self.chain is not None:
            return ()
        upper_nm, lower_nm = (abs(float(moment)) * g_m_s2 for moment in self.theta[3:5])
        return upper_nm + lower_nm, lower_nm

    def inertia(self, q: Array) -> Array:
        """Returns the joint-space inertia matrix M(q) of a chain, including its drives.

        Args:
            q: Joint positions in rad, or in m for a prismatic joint, shape (n,).

        Returns:
            Symmetric matrix of shape (n, n), in kg m^2 for revolute joints.
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
        """Computes the damping gains that bring the arm to rest.

        Joint i is damped with B = M_ii / T, where M is the inertia matrix of the arm and T is a
        time constant. Since the joints are coupled, the fastest motion decays at the rate
        lambda / T, where lambda is the largest eigenvalue of diag(M) M^-1. T is chosen so that
        the time constant T / lambda of this motion is at least `BRAKE_TICKS` ticks. If the
        inertia is unknown, B is instead the damping of the control law at each joint where that
        damping is positive.

        Args:
            q0: Start pose at which the inertia of a chain is evaluated. For the planar arm, the
                inertia in the stretched pose is used instead.
            law_damping: Damping of the control law at each joint, in N m s/rad, shape (n,).
            limit_nm: Torque limit, in N m: a scalar, or one value per joint.
            rate_hz: Tick rate of the site, in Hz.
            known: False if the inertial parameters of the arm are unknown.
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
        """Bounds the parameters that an adaptive control law estimates.

        The bounds follow from the assumption that the motors can hold the arm against gravity.
        Let T be the largest torque of a joint, g the gravitational acceleration, and l the
        length of a link (for a chain, the reach of the arm):

        - a first moment (mass times distance) is at most T / g;
        - a second moment (moment of inertia) is at most l T / g;
        - the mass of a link is at most T / g divided by the mean length of the links;
        - masses, and second moments about an axis, are not negative.

        The bounds are widened to include the initial estimate. Gains that already have bounds,
        and gains of other laws, are returned unchanged.

        Args:
            gains: Gains of the control law, including the initial parameter estimate.
            limit_nm: Torque limit, in N m: a scalar, or one value per joint.
            g_m_s2: Gravitational acceleration, in m/s^2. If 0, no bounds are added.
        """
        has_box = np.isfinite(gains.low).any()
        if not gains.is_adaptive or has_box or g_m_s2 == 0.0:
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
    """Returns True if the inertia matrix of the planar arm is positive definite in every pose.

    Otherwise, the parameters do not describe a real arm. With the angle q2 of the second joint,
    the inertia matrix is

        M = | theta_1 + 2 theta_2 cos(q2)    theta_3 + theta_2 cos(q2) |
            | theta_3 + theta_2 cos(q2)      theta_3                   |

        det M = theta_1 theta_3 - theta_3^2 - theta_2^2 cos(q2)^2

    The determinant is smallest for the stretched arm, q2 = 0, so only this pose is checked,
    with a margin for rounding errors.

    Args:
        theta: Dynamic parameters of the arm, shape (5,) (see `ArmLinks.theta`). The first three
            are inertias, in kg m^2.
    """
    theta_1 = theta[0]
    theta_2 = theta[1]
    theta_3 = theta[2]
    least_determinant = theta_1 * theta_3 - theta_3**2 - theta_2**2
    margin = 1e-9 * theta_1 * theta_3
    return bool(theta_3 > 0.0 and least_determinant > margin)


def build_arm(arm: Arm, task: Task, urdf_texts: Mapping[str, str], chains: bool) -> ArmModel:
    """Builds the dynamic model of an arm from its table in a scenario.

    Args:
        arm: Table that contains the lengths and masses of the arm, or the name of its URDF
            file.
        task: Coordinates that the arm shares with its peers.
        urdf_texts: Mapping from name to content of the scenario's URDF files.
        chains: If True, the arm is modelled as a spatial chain even if it is planar. Must be
            the same for all arms of a scenario.

    Raises:
        ScenarioError: The URDF file cannot be used, or the inertia matrix of the planar arm is
            singular. The error contains a key path relative to the arm.
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
    """Converts the planar arm's inertial parameters to those of a chain, shape (20,).

    A link has mass m, centre of mass (c, 0, 0), and moment of inertia I about the z axis
    through the centre of mass. About its joint, the first moment along x is m c, and Iyy = Izz
    = m c^2 + I.
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
    """Converts the planar two-link arm to a general chain of joints.

    This allows the planar arm to be simulated together with arms from URDF files. Its joints
    rotate about z, and gravity acts along -y.
    """
    shoulder = ChainJoint(
        prismatic=False, axis=(0.0, 0.0, 1.0), rotation=_IDENTITY, origin_m=(0.0, 0.0, 0.0)
    )
    elbow = shoulder._replace(origin_m=(arm.l1_m, 0.0, 0.0))
    joints, gravity = _place_base(arm, (shoulder, elbow), (0.0, -arm.g_m_s2, 0.0))
    return ChainSetup(joints, gravity, (arm.l2_m, 0.0, 0.0), task=task.setup)


_KEYS_OF_SUBJECTS = {"base": "base", "tip": "tip", "payload": "payload_inertia_kg_m2"}
"""Mapping from the subject of a `read_urdf` error to the corresponding key of the arm.

Errors about any other subject are errors of the file itself.
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
    """Parses the chain of joints in a URDF file (see `read_urdf`).

    The result is cached, so the same file is parsed only once.
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
    """Transforms the joints of an arm, and gravity, to the frame shared by all arms.

    The rotation of the base is R_z(yaw) R_y(pitch) R_x(roll). Only the first joint changes,
    since each of the others is expressed in the frame of the preceding joint.

    Args:
        arm: Table of the arm.
        joints: Joints in the base frame.
        gravity: Gravitational acceleration in the base frame.
    """
    if not (any(arm.base_xyz_m) or any(arm.base_rpy_rad)):
        return joints, gravity
    roll, pitch, yaw = arm.base_rpy_rad
    roll_turn = FramePose.from_rotation_vector((roll, 0.0, 0.0))
    pitch_turn = FramePose.from_rotation_vector((0.0, pitch, 0.0))
    yaw_turn = FramePose.from_rotation_vector((0.0, 0.0, yaw))
    turn = yaw_turn @ (pitch_turn @ roll_turn)
    x, y, z = arm.base_xyz_m
    base = FramePose(turn.rotation, (x, y, z))
    first = joints[0]
    pose = base @ FramePose(first.rotation, first.origin_m)
    placed = first._replace(rotation=pose.rotation, origin_m=pose.origin_m)
    return (placed, *joints[1:]), base.turn(gravity)


def _build_chain_model(arm: Arm, task: Task, urdf_chain: UrdfChain) -> ArmModel:
    """Builds the model of an arm from the joints in its URDF file.

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
    """Converts a joint from a URDF file to the format read by the compiled simulation.

    The ends of the joint's range become stops: a spring that pushes with the effort limit of
    the joint at the depth `STOP_REACH_RAD`, and a damper with `STOP_DAMPING_S` times the
    stiffness.

    Args:
        joint: Joint from the file.
        armature_kg_m2: Inertia of the drive.
        has_stops: True if the joint limits of the file are stops.
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
"""Smallest time constant for damping a joint to rest, in s."""
BRAKE_TICKS = 4
"""Smallest time constant of any motion of the arm under damping, in ticks."""
UNKNOWN_BRAKE_S = 0.1
"""Time constant used for an arm with unknown inertia, in s."""
BRAKE_TORQUE_SHARE = 0.5
"""Fraction of the torque limit used to decelerate the reference."""


def _bound_planar_parameters(
    arm: ArmModel, limit_nm: Vector, g_m_s2: float
) -> tuple[Array, Array]:
    """Returns lower and upper bounds on the planar arm's five parameters, shape (5,) each.

    They follow from the torque needed to hold the arm (see `bound_estimates`). The parameters
    are those of Eq. (24).
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
    """Returns lower and upper bounds on the ten parameters of each link, shape (10 n,) each.

    They follow from the torque needed to hold the arm (see `bound_estimates`).
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

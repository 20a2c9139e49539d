"""The arms of a scenario: the planar two-link arm, or a chain of joints from a URDF.

`Arm` and `Task` are the tables of a scenario, and `build_arm` turns them into an `ArmModel`,
which has the parameters and the geometry that computations need. `compute_rest_gains` and
`bound_estimates` derive from the model how an arm comes to rest, and a box for the estimates of
an adaptive law.

Invariant:
    - If one arm of a scenario is a chain, all arms are, so that live, virtual and swept runs
      compute with the same leaves. The planar arm is then a chain of two joints in the x-y
      plane.
    - Times that follow from linear algebra are rounded up to a millisecond, so that they are
      the same numbers on every machine.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from .. import fields
from ..core.chain import (
    ChainJoint,
    Three,
    apply,
    build_chain,
    mass_matrix,
    multiply,
    place_end_effector,
    place_joints,
)
from ..core.live_hand import HandReach
from ..core.rotation import relative_rotation, rotation_matrix
from ..core.site_setup import ChainSetup, Gains, Law, MotionLimits, RestGains, TaskSetup
from ..core.two_link_arm import ArmLinks, is_positive_definite, theta_from_links
from ..core.vectors import Array, RowArray, Vector
from ..errors import ScenarioError, count_nouns
from .link_inertia import LinkInertia, TensorEntries, ThreeReals
from .urdf import UrdfChain, UrdfJoint, UrdfPayload, read_urdf

TASK_AXES = ("x", "y", "z", "rx", "ry", "rz")
STOP_REACH_RAD = 0.05
"""Depth in a stop at which the stop pushes with the joint's effort limit, rad or m."""
START_MARGIN_RAD = 0.15
START_MARGIN_M = 0.02
"""Largest distance of a start pose beyond a stop or a limit of position.

That is 8.6 degrees, or 2 cm of a sliding joint. Encoders are set to zero by hand, and arms are
parked on stops that lie beyond those in their files.
"""
STOP_EFFORT_NM = 100.0
"""The effort limit for which stops are made if a file states none."""
STOP_DAMPING_S = 0.01
"""Damping of a stop over its stiffness, s."""
PLANAR_UNITS = ("kg m^2", "kg m^2", "kg m^2", "kg m", "kg m")
"""Units of the five parameters of Eq. (24)."""
BODY_UNITS = {
    "m": "kg",
    **dict.fromkeys(("mc_x", "mc_y", "mc_z"), "kg m"),
    **dict.fromkeys(("Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"), "kg m^2"),
}
"""The ten parameters of a link of a chain, about its joint's frame, with their units."""
_SLIDING_UNITS = {"rad": "m", "rad/s": "m/s", "N m": "N"}
"""Units of a joint that slides, by the unit of a joint that turns."""
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Arm(fields.Frozen, frozen=True):
    """An arm: a chain of joints from a URDF, or the planar arm of two links.

    The defaults of the planar arm are the paper's: point masses at the ends of the links. The
    keys of one kind of arm have no meaning for the other.

    Attributes:
        l1_m: this and the keys down to I2_kg_m2 are those of `ArmLinks`.
        g_m_s2: gravitational acceleration, m/s^2.
        known: false: the masses and inertias are unknown, as of a real arm that was not
            identified, and enter no formula. Only for an arm outside of the program.
        dead_man: true: the arm moves only while somebody holds its dead-man switch
            (`docs/external-arm.md`). Only for an arm outside of the program.
        urdf: name of the URDF that describes the arm, in `Scenario.urdf`; "": the arm is the
            planar arm.
        base_xyz_m: position of the base in the frame that the sites share, in which walls and
            operators are given as well.
        base_rpy_rad: orientation of the base in that frame: rotations about the fixed axes x, y
            and z, in this order.
        base: the base link; "": the root of the file.
        tip: the end link; "": the only link on which no other link hangs.
        down: direction of gravity in the base's frame; its length does not matter.
        payload_kg: mass fixed to the end link. If it is 0, the next two keys have no meaning.
        payload_com_m: centre of mass of the payload in the end link's frame.
        payload_inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz of the payload about its centre of
            mass.
        armature_kg_m2: inertia of each drive as seen at its joint; kg for a prismatic joint.
        stops: true: the joint limits of the file are springs that the arm may run into.
        balance_inertia: true: an inertia of the file that no body can have is replaced by the
            nearest inertia of a body.
        links: masses and inertias that replace those of the file, by the name of the link.
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
    urdf: str = ""
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
        """Returns the lengths and masses of the planar arm."""
        values = {name: getattr(self, name) for name in ArmLinks._fields}
        return ArmLinks(**values)


def start_margin(joint: ChainJoint) -> float:
    """Returns how far beyond its stops and limits a joint may start, rad or m."""
    return START_MARGIN_M if joint.prismatic else START_MARGIN_RAD


BASE_KEYS = ("base_xyz_m", "base_rpy_rad")
"""The keys of an arm that place its base in space."""
CHAIN_KEYS = fields.field_names(Arm)[fields.field_names(Arm).index("base") :]
"""The keys of an arm that only a chain has."""


class Task(fields.Frozen, frozen=True, omit_defaults=True):
    """The coordinates that the sites share: joint angles, or end effectors' poses.

    Attributes:
        space: "joints": the joint angles; "position": the positions of the end effectors;
            "pose": their positions and orientations.
        axes: the axes along which the site follows, of x, y, z, rx, ry, rz; left out: all axes.
        scale: metres in the shared coordinates per metre of this arm.
        posture_rad: joint angles near which the arm stays as far as the task leaves it free;
            left out: its start pose.
        posture_rate_1_s: rate at which the arm returns to that posture, 1/s: the share of the
            deviation per second.
        singular_value: singular value of the Jacobian below which its inverse is damped.
    """

    space: Literal["joints", "position", "pose"] = "joints"
    axes: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    scale: fields.Positive = 1.0
    posture_rad: fields.Joints = ()
    posture_rate_1_s: fields.NotNegative = 0.0
    singular_value: fields.Positive = 0.05

    @property
    def shared(self) -> int:
        """The number of coordinates that the sites share; 0: one per joint."""
        return {"joints": 0, "position": 3, "pose": 6}[self.space]

    def find_idle_key(self, written: Mapping[str, object]) -> fields.KeyProblem | None:
        """Returns a key of the written table that has no effect, or None."""
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
                    f"has {axis}, which belongs to a pose, and task.space is 'position'",
                )
        if self.posture_rad and not self.posture_rate_1_s:
            return fields.KeyProblem("posture_rad", "has no effect while posture_rate_1_s is 0")
        return None

    @property
    def setup(self) -> TaskSetup | None:
        """The task in the form of the core; None if the sites share joint angles."""
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
    """The parameters and the geometry of an arm.

    Attributes:
        theta: the true parameters: Eq. (24) for the planar arm, ten per link for a chain.
        counts: the lengths of the arm's vectors.
        joint_names: the names of the joints, from the base on.
        link_names: the names of the links that the joints move.
        efforts: the largest effort that the file states for each joint, N m or N; inf if it
            states none.
        speeds: the largest speed that the file states for each joint, rad/s or m/s; inf if it
            states none.
        lengths_m: the lengths of the two links of the planar arm; (0, 0) for a chain.
        chain: the chain in the form of the core; None for the planar arm.
    """

    theta: Array
    counts: fields.VectorCounts
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    efforts: tuple[float, ...]
    speeds: tuple[float, ...]
    lengths_m: tuple[float, float]
    chain: ChainSetup | None = None

    @property
    def parameters(self) -> list[tuple[str, str]]:
        """Name and unit of each parameter, in the order of `theta`."""
        if self.chain is None:
            return [(f"theta_{n + 1}", unit) for n, unit in enumerate(PLANAR_UNITS)]
        parameters = []
        for link in self.link_names:
            parameters += [(f"{link}.{name}", unit) for name, unit in BODY_UNITS.items()]
        return parameters

    def widen_stops(self, q0: Vector) -> "ArmModel":
        """Returns the arm with stops moved to its start pose, where it starts beyond them.

        A stop is moved if the start pose lies beyond it by at most the margin, see
        `start_margin`. An arm that stands at rest beyond a nominal stop does not touch its real
        stop, so that no spring may push there. The other stops stay.

        Args:
            q0: start pose, rad or m, shape (n,).
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
        """Returns the unit of a quantity at each joint; `unit`: at a joint that turns."""
        if self.chain is None:
            return [unit] * self.counts.joints
        return [
            _SLIDING_UNITS.get(unit, unit) if joint.prismatic else unit
            for joint in self.chain.joints
        ]

    def end_effector(self, q: Vector) -> list[float]:
        """Returns the position of the end effector in the pose `q`, m.

        The list has one number per axis of the arm's space: two for the planar arm, three for a
        chain.
        """
        if self.chain is None:
            l1, l2 = self.lengths_m
            upper_arm = q[0]
            forearm = q[0] + q[1]
            x = l1 * math.cos(upper_arm) + l2 * math.cos(forearm)
            y = l1 * math.sin(upper_arm) + l2 * math.sin(forearm)
            return [x, y]
        return list(place_end_effector(self._place_links(q), np.array(self.chain.tip_m)))

    def _place_links(self, q: Vector | Array) -> RowArray:
        """Returns the rows of the core's chain, with the links placed in the pose `q`."""
        assert self.chain is not None
        rows = build_chain(self.chain.joints)
        place_joints(rows, np.asarray(q, dtype=np.float64))
        return rows

    def end_effector_orientation(self, q: Vector) -> tuple[float, float, float]:
        """Returns the end effector's orientation in the pose `q`, a rotation vector, rad."""
        if self.chain is None:
            return 0.0, 0.0, q[0] + q[1]
        rows = self._place_links(q)
        # Fills R_base, which turns base axes into those of each link.
        place_end_effector(rows, np.array(self.chain.tip_m))
        return relative_rotation(rows[-1]["R_base"], np.array(self.chain.tip_rotation).T)

    @property
    def reach(self) -> HandReach:
        """A bound of the positions of the end effector; exact for the planar arm.

        Every joint, and the end effector, lies at a fixed distance from the joint before, and a
        sliding joint at most its travel farther. The end effector is therefore at most as far
        from the first joint as the sum of all distances. Without sliding joints it is at least
        as far as the longest distance minus the sum of the others.
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
        """Returns the range of each joint between its stops and its limits of position."""
        joints = self.counts.joints
        low = np.broadcast_to(np.array(limits.q_min, dtype=np.float64), joints)
        high = np.broadcast_to(np.array(limits.q_max, dtype=np.float64), joints)
        if self.chain is not None:
            low = np.maximum(low, [joint.lower for joint in self.chain.joints])
            high = np.minimum(high, [joint.upper for joint in self.chain.joints])
        return HandReach(low=tuple(low.tolist()), high=tuple(high.tolist()))

    @property
    def shares_pose(self) -> bool:
        """True if the site follows with its end effector, in task space."""
        return self.chain is not None and self.chain.task is not None

    @property
    def axes(self) -> tuple[float, ...]:
        """1 for each task coordinate that the site follows, else 0; () in joint space."""
        task = None if self.chain is None else self.chain.task
        return () if task is None else task.axes

    def shared_pose(self, q: Vector) -> tuple[float, ...]:
        """Returns the coordinates that a site shares in the pose `q`.

        These are the joint angles, or the position of the end effector times the task's scale,
        followed by its orientation if the sites share poses.
        """
        if self.chain is None or self.chain.task is None:
            return tuple(q)
        position = np.array(self.end_effector(q)) * self.chain.task.scale
        if self.counts.shared == len(position):
            return tuple(position.tolist())
        return (*position.tolist(), *self.end_effector_orientation(q))

    def task_jacobian(self, q: Vector) -> Array:
        """Returns the Jacobian of the shared task coordinates in the pose `q`, shape (m, n)."""
        assert self.chain is not None
        assert self.chain.task is not None
        rows = self._place_links(q)
        place_end_effector(rows, np.array(self.chain.tip_m))
        J = np.hstack([self.chain.task.scale * rows["J_lin"], rows["J_ang"]]).T
        return J[: self.counts.shared]

    def largest_gravity(self, g_m_s2: float) -> tuple[float, ...]:
        """Returns the largest gravity torques of the planar arm, N m; () for a chain."""
        if self.chain is not None:
            return ()
        upper_nm, lower_nm = (abs(float(moment)) * g_m_s2 for moment in self.theta[3:5])
        return upper_nm + lower_nm, lower_nm

    def inertia(self, q: Array) -> Array:
        """Returns the inertia matrix M(q) of a chain with its drives, shape (n, n)."""
        rows = self._place_links(q)
        mass_matrix(rows, self.theta)
        # The core computes the lower triangle only.
        lower = np.tril(rows["M"])
        M: Array = lower + np.tril(lower, -1).T
        return M


def build_arm(arm: Arm, task: Task, urdf_texts: Mapping[str, str], chains: bool) -> ArmModel:
    """Returns the model of an arm.

    Args:
        arm: the arm's table.
        task: the task of its site.
        urdf_texts: the texts of URDF files, by name.
        chains: True if all arms of the scenario are chains, the planar arm included.

    Raises:
        ScenarioError: the arm's file cannot be used, or the planar arm has a singular inertia
            matrix. The path is that of a key below the arm's.
    """
    if arm.urdf:
        return _build_chain_model(arm, task, read_arm(arm, urdf_texts))
    theta = theta_from_links(arm.planar_links())
    if not is_positive_definite(theta):
        raise ScenarioError(
            "the inertia matrix is singular in some pose: give the links mass away from their "
            "joints"
        )
    counts = fields.VectorCounts()
    lengths_m = (arm.l1_m, arm.l2_m)
    chain = None
    if chains:
        theta = _list_planar_bodies(arm)
        counts = fields.VectorCounts.of_chain(2, task.shared)
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
    """Returns the parameters of the planar arm's links as a chain has them, shape (20,).

    A link with its centre of mass at (c, 0, 0) and moment of inertia I about the axis z
    through it has m c as first moment along x, and Iyy = Izz = m c^2 + I about its joint.
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
    """Returns the planar arm as a chain: its joints turn about z, gravity acts along -y."""
    shoulder = ChainJoint(
        prismatic=False, axis=(0.0, 0.0, 1.0), rotation=_IDENTITY, origin_m=(0.0, 0.0, 0.0)
    )
    elbow = shoulder._replace(origin_m=(arm.l1_m, 0.0, 0.0))
    joints, gravity = _place_base(arm, (shoulder, elbow), (0.0, -arm.g_m_s2, 0.0))
    return ChainSetup(joints, gravity, (arm.l2_m, 0.0, 0.0), task=task.setup)


def read_arm(arm: Arm, urdf_texts: Mapping[str, str]) -> UrdfChain:
    """Returns the chain that an arm's file describes between its base and its end link.

    Raises:
        ScenarioError: there is no such file, or it cannot be used. The path is that of a key
            below the arm's.
    """
    if arm.urdf not in urdf_texts:
        raise ScenarioError(f"names no file of the scenario: {arm.urdf!r}", path="urdf")
    for key in ("payload_com_m", "payload_inertia_kg_m2"):
        if any(getattr(arm, key)) and not arm.payload_kg:
            raise ScenarioError("needs the mass of the payload: set payload_kg", path=key)
    payload = UrdfPayload(arm.payload_kg, arm.payload_com_m, arm.payload_inertia_kg_m2)
    try:
        return _read_cached(
            text=urdf_texts[arm.urdf],
            base=arm.base,
            tip=arm.tip,
            payload=payload if arm.payload_kg else None,
            links=tuple(arm.links.items()),
            balance=arm.balance_inertia,
        )
    except ScenarioError as error:
        if error.path:
            raise
        subject, _, problem = error.problem.partition(": ")
        if subject in _KEYS_OF_SUBJECTS:
            raise ScenarioError(problem, path=_KEYS_OF_SUBJECTS[subject]) from None
        raise ScenarioError(f"{arm.urdf}: {error.problem}", path="urdf") from None


_KEYS_OF_SUBJECTS = {"base": "base", "tip": "tip", "payload": "payload_inertia_kg_m2"}
"""Keys of the arm by the subject of a problem that `read_urdf` reports.

Problems with another subject are those of the file.
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
    """Returns the chain of a URDF, see `read_urdf`; equal arguments are read once."""
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
    """Returns the joints of a chain, and gravity, in the frame that the sites share.

    The rotation of the base is R_z(yaw) R_y(pitch) R_x(roll).
    """
    if not (any(arm.base_xyz_m) or any(arm.base_rpy_rad)):
        return joints, gravity
    roll, pitch, yaw = arm.base_rpy_rad
    R_x = rotation_matrix((roll, 0.0, 0.0))
    R_y = rotation_matrix((0.0, pitch, 0.0))
    R_z = rotation_matrix((0.0, 0.0, yaw))
    base = multiply(R_z, multiply(R_y, R_x))
    first = joints[0]
    x, y, z = arm.base_xyz_m
    turned = apply(base, first.origin_m)
    placed = first._replace(
        rotation=multiply(base, first.rotation),
        origin_m=(turned[0] + x, turned[1] + y, turned[2] + z),
    )
    return (placed, *joints[1:]), apply(base, gravity)


def _build_chain_model(arm: Arm, task: Task, urdf_chain: UrdfChain) -> ArmModel:
    """Returns the model of an arm from the chain that was read from its file."""
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
        counts=fields.VectorCounts.of_chain(joint_count, task.shared),
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
    """Returns a joint in the form of the core.

    Stops are springs that push with the joint's effort limit at the depth `STOP_REACH_RAD`, and
    dampers of `STOP_DAMPING_S` times the stiffness.
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
"""Least time constant with which damping alone brings a joint to rest."""
BRAKE_TICKS = 4
"""Least time constant, in ticks, that damping gives to any motion of the arm."""
UNKNOWN_BRAKE_S = 0.1
"""The time constant for an arm whose inertia is not known."""
BRAKE_TORQUE_SHARE = 0.5
"""The share of the largest torque that decelerates the reference."""


def compute_rest_gains(
    arm: ArmModel,
    q0: Vector,
    law_damping: Array,
    limit_nm: Vector,
    rate_hz: int,
    *,
    known: bool,
) -> RestGains:
    """Returns the gains with which an arm comes to rest.

    A joint of inertia M_ii gets the damping B = M_ii / T. The fastest motion of all joints
    together then decays with the largest eigenvalue of diag(M) M^-1 / T, and T is chosen so
    that the time constant of this motion is `BRAKE_TICKS` ticks or more. If the inertia of the
    arm is not known, B is the damping of its law wherever that is positive.

    Args:
        arm: the arm.
        q0: start pose, in which the inertia of a chain counts. For the planar arm the stretched
            pose counts.
        law_damping: the damping of the law per joint, N m s/rad, shape (n,).
        limit_nm: the largest torque, N m; one number or one per joint.
        rate_hz: the tick rate, Hz.
        known: False if the parameters of the model are not those of the arm.
    """
    if arm.chain is None:
        a, b, c = arm.theta[:3].tolist()
        M = np.array([[a + 2.0 * b, c + b], [c + b, c]])
    else:
        M = arm.inertia(np.array(q0))
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


def bound_estimates(gains: Gains, arm: ArmModel, limit_nm: Vector, g_m_s2: float) -> Gains:
    """Returns the gains of an adaptive law with a box for its estimates.

    The motors of an arm can hold it against gravity. With the largest torque T of the joints,
    the gravitational acceleration g and the length l of a link (of a chain: the reach of the
    arm), a first moment is therefore at most T / g, a second moment at most l T / g, and the
    mass of a link at most T / g over the mean length of the links. Masses, and second moments
    about an axis, are not negative. The first estimate is always in the box. Gains that have a
    box already, and those of other laws, are returned as they are.

    Args:
        gains: the gains of the law.
        arm: the arm.
        limit_nm: the largest torque, N m; one number or one per joint.
        g_m_s2: gravitational acceleration; 0: no box follows.
    """
    has_box = np.isfinite(gains.low).any()
    if gains.law is not Law.ADAPTIVE or has_box or g_m_s2 == 0.0:
        return gains
    if arm.chain is None:
        low, high = _bound_planar_parameters(arm, limit_nm, g_m_s2)
    else:
        low, high = _bound_chain_parameters(arm, arm.chain, np.max(limit_nm), g_m_s2)
    first_estimate = np.broadcast_to(gains.theta_hat0, high.shape)
    return gains._replace(
        low=tuple(np.minimum(low, first_estimate).tolist()),
        high=tuple(np.maximum(high, first_estimate).tolist()),
    )


def _bound_planar_parameters(
    arm: ArmModel, limit_nm: Vector, g_m_s2: float
) -> tuple[Array, Array]:
    """Returns lower and upper bounds of the five parameters of Eq. (24), shape (5,) each."""
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
    """Returns lower and upper bounds of ten parameters per link, shape (10 n,) each."""
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

"""The arms of a scenario: the planar two-link arm by lengths and masses, or a chain of joints
from a URDF.

Invariant: in a scenario in which one arm is a chain all of them are, so that live, virtual and
swept runs compute with the same leaves; the planar arm is then written as a chain of two joints
in the x-y plane. How fast an arm may come to rest follows from what is stated: what linear
algebra gives is rounded up to a millisecond, so that the numbers are the same on every machine.
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
from ..core.rotation import rotation_matrix, turn_between
from ..core.site_setup import ChainSetup, Gains, Law, MotionLimits, RestGains, TaskSetup
from ..core.two_link_arm import ArmLinks, is_positive_definite, theta_from_links
from ..core.vectors import Array, RowArray, Vector
from ..errors import ScenarioError, count_nouns
from .link_inertia import LinkInertia, TensorEntries, ThreeReals
from .urdf import UrdfChain, UrdfPayload, read_urdf

TASK_AXES = ("x", "y", "z", "rx", "ry", "rz")
STOP_REACH_RAD = 0.05
"""A stop answers with the joint's whole effort limit at this depth, rad or m."""
START_MARGIN_RAD = 0.15
START_MARGIN_M = 0.02
"""So far beyond a stop or a limit of position an arm may start: 8.6 degrees, or 2 cm of a
sliding joint. Encoders are set to zero by hand, and arms are parked on stops that lie beyond
those of their files.
"""
STOP_EFFORT_NM = 100.0
"""The effort that stops are made for where a file states none."""
PLANAR_UNITS = ("kg m^2", "kg m^2", "kg m^2", "kg m", "kg m")
"""Units of the five parameters of Eq. (24)."""
BODY_UNITS = {
    "m": "kg",
    **dict.fromkeys(("mc_x", "mc_y", "mc_z"), "kg m"),
    **dict.fromkeys(("Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"), "kg m^2"),
}
"""The ten parameters of a link of a chain, about its joint's frame, with their units."""
_SLIDING = {"rad": "m", "rad/s": "m/s", "N m": "N"}
"""Units of a joint that slides instead of those of one that turns."""


class Arm(fields.Frozen, frozen=True):
    """An arm: a chain of joints from a URDF, or the two links of a planar arm.

    The defaults of the planar arm are the paper's, as point masses at the link ends. The keys
    of one kind of arm have no meaning for the other.

    Attributes:
        l1_m: this and the others down to I2_kg_m2 are those of `ArmLinks`.
        g_m_s2: gravitational acceleration, m/s^2.
        known: false: masses and inertias are unknown, as of a real arm that was not identified,
            and enter no formula. Only for an arm outside of the program.
        dead_man: true: it moves only while somebody holds its dead-man switch
            (`docs/external-arm.md`). Only for an arm outside of the program.
        urdf: name of the URDF that describes the arm, in `Scenario.urdf`; "": it is the planar
            arm.
        base_xyz_m: place of the base in the frame that the sites share; walls and operators are
            there too.
        base_rpy_rad: its orientation there: about the fixed axes x, y, z, in this order.
        base: its base link; "": the root of the file.
        tip: its end link; "": the only one that nothing hangs on.
        down: direction of gravity in the base's frame; its length does not matter.
        payload_kg: mass fixed to the end link; without one the two keys that follow mean
            nothing.
        payload_com_m: its centre of mass in the end link's frame.
        payload_inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about its centre of mass.
        armature_kg_m2: inertia of each drive as its joint has it; kg of a prismatic joint.
        stops: true: joint limits of the file are springs that an arm may run into.
        balance_inertia: true: inertias of the file that no body has are replaced by the nearest
            that one has.
        links: masses and inertias of links in place of the file's, by the link's name.
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


def start_margin(joint: ChainJoint) -> float:
    """Returns how far beyond its stops and limits a joint may start, rad or m."""
    return START_MARGIN_M if joint.prismatic else START_MARGIN_RAD


BASE_KEYS = ("base_xyz_m", "base_rpy_rad")
"""The keys of an arm that place it in space."""
CHAIN_KEYS = fields.field_names(Arm)[fields.field_names(Arm).index("base") :]
"""The keys of an arm that only a chain has."""


class Task(fields.Frozen, frozen=True, omit_defaults=True):
    """What sites agree on: their joint angles, or their end effectors' places or poses.

    Attributes:
        space: "joints": angle by angle; "position": the end effectors' places; "pose": and
            orientations.
        axes: along which the site follows, of x, y, z, rx, ry, rz; left out: along all.
        scale: metres that the sites share per metre of this arm.
        posture_rad: joint angles that the arm keeps near as far as the task leaves it free;
            left out: its start pose.
        posture_rate_1_s: by how much of the way in a second.
        singular_value: least singular value of the Jacobian that is not damped.
    """

    space: Literal["joints", "position", "pose"] = "joints"
    axes: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    scale: fields.Positive = 1.0
    posture_rad: fields.Joints = ()
    posture_rate_1_s: fields.NotNegative = 0.0
    singular_value: fields.Positive = 0.05

    @property
    def shared(self) -> int:
        """How many coordinates the sites share; 0: as many as there are joints."""
        return {"joints": 0, "position": 3, "pose": 6}[self.space]

    def find_idle_key(self, written: Mapping[str, object]) -> fields.KeyProblem | None:
        """Returns a key of the written table that has no effect, or None."""
        if not self.shared:
            key = next((key for key in written if key != "space"), None)
            problem = "has no effect while sites share joint angles: set task.space to 'position' or 'pose'"
            return None if key is None else fields.KeyProblem(key, problem)
        foreign = [axis for axis in self.axes if axis not in TASK_AXES[: self.shared]]
        if foreign:
            return fields.KeyProblem(
                "axes",
                f"has {foreign[0]}, which belongs to a pose, and task.space is 'position'",
            )
        if self.posture_rad and not self.posture_rate_1_s:
            return fields.KeyProblem("posture_rad", "has no effect while posture_rate_1_s is 0")
        return None

    @property
    def setup(self) -> TaskSetup | None:
        """The task as the core has it; None of joints."""
        if not self.shared:
            return None
        axes = tuple(
            float(not self.axes or name in self.axes) for name in TASK_AXES[: self.shared]
        )
        posture = self.posture_rad
        return TaskSetup(
            axes=axes,
            scale=self.scale,
            posture=posture,
            posture_rate=self.posture_rate_1_s,
            singular_value=self.singular_value,
        )


class ArmModel(NamedTuple):
    """An arm as computations need it.

    Attributes:
        theta: its true parameters: Eq. (24) for the planar arm, ten a link for a chain.
        efforts: largest effort that its file states for each joint, N m or N; inf where it
            states none.
        speeds: largest speed so, rad/s or m/s.
        lengths_m: of the two links of the planar arm; (0, 0) of a chain.
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
        """Name and unit of each of its parameters, in the order of theta."""
        if self.chain is None:
            return [(f"theta_{n + 1}", unit) for n, unit in enumerate(PLANAR_UNITS)]
        return [
            (f"{link}.{name}", unit)
            for link in self.link_names
            for name, unit in BODY_UNITS.items()
        ]

    def widen_stops(self, q0: Vector) -> "ArmModel":
        """Returns the arm with each stop moved to the start pose that lies at most the margin
        beyond it.

        An arm that stands at rest beyond a nominal stop does not touch its real one, so that no
        spring pushes there. Stops farther away from the start pose than that stay where they
        are.

        Args:
            q0: start pose, shape (n,).
        """
        if self.chain is None:
            return self
        joints = tuple(
            joint._replace(lower=min(lower, start), upper=max(upper, start))
            if lower - margin <= start <= upper + margin
            else joint
            for joint, start in zip(self.chain.joints, q0, strict=True)
            for lower, upper, margin in [(joint.lower, joint.upper, start_margin(joint))]
        )
        return self._replace(chain=self.chain._replace(joints=joints))

    def joint_units(self, unit: str) -> list[str]:
        """Returns the unit of each joint's number, of what is in `unit` for a joint that turns."""
        if self.chain is None:
            return [unit] * self.counts.joints
        return [
            _SLIDING.get(unit, unit) if joint.prismatic else unit for joint in self.chain.joints
        ]

    def end_effector(self, q: Vector) -> list[float]:
        """Returns the end effector's place in a pose, m, one number per axis of the arm's
        space.
        """
        if self.chain is None:
            (l1, l2) = self.lengths_m
            turned = q[0] + q[1]
            return [
                l1 * math.cos(q[0]) + l2 * math.cos(turned),
                l1 * math.sin(q[0]) + l2 * math.sin(turned),
            ]
        return list(place_end_effector(self._place(q), np.array(self.chain.tip_m)))

    def _place(self, q: Vector | Array) -> RowArray:
        assert self.chain is not None
        rows = build_chain(self.chain.joints)
        place_joints(rows, np.asarray(q, dtype=np.float64))
        return rows

    def end_effector_orientation(self, q: Vector) -> tuple[float, float, float]:
        """Returns the end effector's orientation in a pose as a rotation vector, rad."""
        if self.chain is None:
            return 0.0, 0.0, q[0] + q[1]
        rows = self._place(q)
        # which turns the links into base axes
        place_end_effector(rows, np.array(self.chain.tip_m))
        return turn_between(rows[-1]["R_base"], np.array(self.chain.tip_rotation).T)

    @property
    def reach(self) -> HandReach:
        """A bound of the places of its end effector, which is exact for two links of a planar
        arm.

        Every joint, and the end effector, lies at a fixed distance from the joint before, and a
        sliding joint at most its travel farther. The end effector is therefore no farther from
        the first joint than the sum of all distances, and, without sliding joints, no nearer
        than the longest less all others.
        """
        if self.chain is None:
            l1, l2 = self.lengths_m
            return HandReach((0.0, 0.0), abs(l1 - l2), l1 + l2)
        first, *others = self.chain.joints
        lengths = [math.sqrt(sum(x * x for x in joint.origin_m)) for joint in others]
        lengths.append(math.sqrt(sum(x * x for x in self.chain.tip_m)))
        sliding = [joint for joint in self.chain.joints if joint.prismatic]
        outer = sum(lengths) + sum(max(abs(joint.lower), abs(joint.upper)) for joint in sliding)
        inner = 0.0 if sliding else max(0.0, 2.0 * max(lengths) - sum(lengths))
        return HandReach(first.origin_m, inner, outer)

    def find_joint_reach(self, limits: MotionLimits) -> HandReach:
        """Returns the joint angles between its stops and its limits of position."""
        joints = () if self.chain is None else self.chain.joints
        low, high = (
            np.broadcast_to(np.array(limit, dtype=np.float64), self.counts.joints)
            for limit in (limits.q_min, limits.q_max)
        )
        if joints:
            low = np.maximum(low, [joint.lower for joint in joints])
            high = np.minimum(high, [joint.upper for joint in joints])
        return HandReach(low=tuple(low.tolist()), high=tuple(high.tolist()))

    @property
    def shares_pose(self) -> bool:
        """True if its site follows with the end effector, in task space."""
        return self.chain is not None and self.chain.task is not None

    @property
    def axes(self) -> tuple[float, ...]:
        """Per coordinate of the task 1 if its site follows along it, else 0; () in joint space."""
        task = None if self.chain is None else self.chain.task
        return () if task is None else task.axes

    def shared_pose(self, q: Vector) -> tuple[float, ...]:
        """Returns what a site shares of a pose: its joint angles, or its end effector's place
        or pose.
        """
        if self.chain is None or self.chain.task is None:
            return tuple(q)
        place = np.array(self.end_effector(q)) * self.chain.task.scale
        if self.counts.shared == len(place):
            return tuple(place.tolist())
        return (*place.tolist(), *self.end_effector_orientation(q))

    def task_jacobian(self, q: Vector) -> Array:
        """Returns the Jacobian of what a site in task space shares, in a pose, shape (m, n),
        per joint.
        """
        assert self.chain is not None
        assert self.chain.task is not None
        rows = self._place(q)
        place_end_effector(rows, np.array(self.chain.tip_m))
        J = np.hstack([self.chain.task.scale * rows["J_lin"], rows["J_ang"]]).T
        return J[: self.counts.shared]

    def largest_gravity(self, g_m_s2: float) -> tuple[float, ...]:
        """Returns what gravity turns a joint of the planar arm by at most, N m; () of a chain."""
        if self.chain is not None:
            return ()
        upper, lower = (abs(float(share)) * g_m_s2 for share in self.theta[3:5])
        return upper + lower, lower

    def inertia(self, q: Array) -> Array:
        """Returns M(q) of a chain, shape (n, n), with the inertia of its drives."""
        rows = self._place(q)
        mass_matrix(rows, self.theta)
        lower = np.tril(rows["M"])
        M: Array = lower + np.tril(lower, -1).T
        return M


def build_arm(arm: Arm, task: Task, urdf: Mapping[str, str], chains: bool) -> ArmModel:
    """Returns the model of an arm that follows in a task; `chains`: some arm of the scenario is
    a chain.

    Raises:
        ScenarioError: its file cannot be used; the path is that of a key below the arm's.
    """
    if arm.urdf:
        return _chain_model(arm, task, read_arm(arm, urdf))
    theta = theta_from_links(ArmLinks(*(getattr(arm, name) for name in ArmLinks._fields)))
    if not is_positive_definite(theta):
        raise ScenarioError(
            "its inertia matrix is singular in some pose: give the links mass away from their joints"
        )
    names = ("q1", "q2")
    bodies_moved = ("link1", "link2")
    none = (math.inf, math.inf)
    if not chains:
        return ArmModel(
            theta=theta,
            counts=fields.VectorCounts(),
            joint_names=names,
            link_names=bodies_moved,
            efforts=none,
            speeds=none,
            lengths_m=(arm.l1_m, arm.l2_m),
        )
    links = ((arm.m1_kg, arm.lc1_m, arm.I1_kg_m2), (arm.m2_kg, arm.lc2_m, arm.I2_kg_m2))
    bodies = [
        (m, m * c, 0.0, 0.0, 0.0, 0.0, m * c * c + own, 0.0, 0.0, m * c * c + own)
        for m, c, own in links
    ]
    upright = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    axis = (0.0, 0.0, 1.0)
    joints = tuple(ChainJoint(False, axis, upright, (x, 0.0, 0.0)) for x in (0.0, arm.l1_m))
    joints, gravity = _place_base(arm, joints, (0.0, -arm.g_m_s2, 0.0))
    chain = ChainSetup(joints, gravity, (arm.l2_m, 0.0, 0.0), task=task.setup)
    counts = fields.VectorCounts.of_chain(2, task.shared)
    return ArmModel(
        theta=np.concatenate(bodies),
        counts=counts,
        joint_names=names,
        link_names=bodies_moved,
        efforts=none,
        speeds=none,
        lengths_m=(0.0, 0.0),
        chain=chain,
    )


def read_arm(arm: Arm, urdf: Mapping[str, str]) -> UrdfChain:
    """Returns the chain that an arm's file describes between its base and its end link.

    Raises:
        ScenarioError: there is no such file, or it cannot be used.
    """
    if arm.urdf not in urdf:
        raise ScenarioError(f"names no file of the scenario: {arm.urdf!r}", path="urdf")
    for key in ("payload_com_m", "payload_inertia_kg_m2"):
        if any(getattr(arm, key)) and not arm.payload_kg:
            raise ScenarioError("is of a payload without mass: give payload_kg", path=key)
    payload = UrdfPayload(arm.payload_kg, arm.payload_com_m, arm.payload_inertia_kg_m2)
    try:
        return _read_cached(
            text=urdf[arm.urdf],
            base=arm.base,
            tip=arm.tip,
            payload=payload if arm.payload_kg else None,
            links=tuple(arm.links.items()),
            balance=arm.balance_inertia,
        )
    except ScenarioError as error:
        if error.path:
            raise
        place, _, problem = error.problem.partition(": ")
        if place in _OWN_KEYS:
            raise ScenarioError(problem, path=_OWN_KEYS[place]) from None
        raise ScenarioError(f"{arm.urdf}: {error.problem}", path="urdf") from None


_OWN_KEYS = {"base": "base", "tip": "tip", "payload": "payload_inertia_kg_m2"}
"""Places of a problem that are keys of the arm and not of its file."""


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
    return read_urdf(
        text=text, base=base, tip=tip, payload=payload, links=dict(links), balance=balance
    )


def _place_base(
    arm: Arm, joints: tuple[ChainJoint, ...], gravity: Three
) -> tuple[tuple[ChainJoint, ...], Three]:
    """Returns the joints of a chain, and gravity, in the frame that the sites share."""
    if not (any(arm.base_xyz_m) or any(arm.base_rpy_rad)):
        return joints, gravity
    roll, pitch, yaw = arm.base_rpy_rad
    tilted = multiply(rotation_matrix((0.0, pitch, 0.0)), rotation_matrix((roll, 0.0, 0.0)))
    base = multiply(rotation_matrix((0.0, 0.0, yaw)), tilted)
    first = joints[0]
    (x, y, z) = arm.base_xyz_m
    turned = apply(base, first.origin_m)
    origin = (turned[0] + x, turned[1] + y, turned[2] + z)
    first = first._replace(rotation=multiply(base, first.rotation), origin_m=origin)
    return (first, *joints[1:]), apply(base, gravity)


def _chain_model(arm: Arm, task: Task, read: UrdfChain) -> ArmModel:
    if len(arm.armature_kg_m2) not in (1, len(read.joints)):
        problem = (
            f"has {count_nouns(len(arm.armature_kg_m2), 'number')}, "
            f"and the arm has {count_nouns(len(read.joints), 'joint')}"
        )
        raise ScenarioError(problem, path="armature_kg_m2")
    armature = np.broadcast_to(arm.armature_kg_m2, len(read.joints)).tolist()
    joints = tuple(
        ChainJoint(
            prismatic=joint.kind == "prismatic",
            axis=joint.axis,
            rotation=joint.rotation,
            origin_m=joint.origin_m,
            armature_kg_m2=inertia,
            viscous=joint.viscous,
            coulomb=joint.coulomb,
            **(_stops(joint.lower, joint.upper, joint.effort_limit) if arm.stops else {}),
        )
        for joint, inertia in zip(read.joints, armature, strict=True)
    )
    x, y, z = arm.down
    size = arm.g_m_s2 / math.sqrt(x * x + y * y + z * z)
    joints, gravity = _place_base(arm, joints, (size * x, size * y, size * z))
    return ArmModel(
        theta=np.concatenate([joint.inertia for joint in read.joints]),
        counts=fields.VectorCounts.of_chain(len(joints), task.shared),
        joint_names=tuple(joint.name for joint in read.joints),
        link_names=tuple(joint.link for joint in read.joints),
        efforts=tuple(joint.effort_limit for joint in read.joints),
        speeds=tuple(joint.velocity_limit for joint in read.joints),
        lengths_m=(0.0, 0.0),
        chain=ChainSetup(
            joints=joints,
            gravity_m_s2=gravity,
            tip_m=read.tip_origin_m,
            tip_rotation=read.tip_rotation,
            task=task.setup,
        ),
    )


def _stops(lower: float, upper: float, effort: float) -> dict[str, float]:
    """Returns the stops of a joint: springs, with a tenth of their stiffness in seconds as
    damping.
    """
    stiffness = (effort if 0.0 < effort < math.inf else STOP_EFFORT_NM) / STOP_REACH_RAD
    return {
        "lower": lower,
        "upper": upper,
        "stop_stiffness": stiffness,
        "stop_damping": 0.01 * stiffness,
    }


BRAKE_S = 0.03
"""Least time in which damping alone brings a joint to rest."""
BRAKE_TICKS = 4
"""So many ticks are the least time constant that damping gives any motion of the arm."""
UNKNOWN_BRAKE_S = 0.1
"""The time of an arm whose inertia is not known."""


def find_rest_gains(
    arm: ArmModel,
    q0: Vector,
    own_damping: Array,
    limit_nm: Vector,
    rate_hz: int,
    *,
    known: bool,
) -> RestGains:
    """Returns how an arm comes to rest.

    A joint of inertia M_ii gets B = M_ii / T. The fastest motion of all joints together then
    has the largest eigenvalue of diag(M) M^-1 / T, which T keeps to the tick rate. Of an arm
    whose inertia is not known B is the damping of its law, `own_damping`, N m s/rad, where that
    has any.

    Args:
        arm: the arm.
        q0: its start pose, in which the inertia of a chain counts; of a planar arm that of the
            stretched one.
        own_damping: of its law, per joint, shape (n,).
        limit_nm: its largest torque.
        rate_hz: its tick rate, Hz.
        known: false: its parameters are not those of the arm.
    """
    if arm.chain is None:
        a, b, c = arm.theta[:3].tolist()
        M = np.array([[a + 2.0 * b, c + b], [c + b, c]])
    else:
        M = arm.inertia(np.array(q0))
    inertia = np.diag(M)
    scaled = np.sqrt(inertia)
    fastest = np.linalg.eigvalsh(scaled * np.linalg.inv(M) * scaled[:, None])[-1]
    time_s = max(BRAKE_S, math.ceil(1e3 * BRAKE_TICKS * fastest / rate_hz) * 1e-3)
    if not known:
        time_s = UNKNOWN_BRAKE_S
        inertia = np.where(own_damping > 0.0, own_damping * time_s, inertia)
    deceleration = 0.5 * np.broadcast_to(limit_nm, inertia.shape) / inertia
    return RestGains(tuple((inertia / time_s).tolist()), time_s, tuple(deceleration.tolist()))


def add_credible_box(gains: Gains, arm: ArmModel, limit_nm: Vector, g_m_s2: float) -> Gains:
    """Returns the gains of an adaptive law with a box for its estimates, if it has none of its
    own.

    What moves an arm can hold it: with T the largest torque of its joints, g the gravitational
    acceleration and l the reach of a link, a first moment is at most T / g and a second one l T
    / g; masses and second moments about an axis are not negative. The first estimate is always
    in the box.
    """
    T = np.max(limit_nm)
    g = g_m_s2
    if gains.law is not Law.ADAPTIVE or np.isfinite(gains.low).any() or g == 0.0:
        return gains
    if arm.chain is None:
        T_1, T_2 = np.broadcast_to(limit_nm, 2)
        outer = min(T_1, T_2) / g
        inner = T_1 / g
        l1, l2 = arm.lengths_m
        high = np.array([l1 * inner + l2 * outer, l1 * outer, l2 * outer, inner, outer])
        low = np.zeros(5)
    else:
        reach = sum(float(np.linalg.norm(joint.origin_m)) for joint in arm.chain.joints)
        reach += float(np.linalg.norm(arm.chain.tip_m))
        link = reach / arm.counts.joints
        first = T / g
        second = reach * T / g
        high = np.tile([first / link, *[first] * 3, *[second] * 6], arm.counts.joints)
        low = np.tile(
            [0.0, *[-first] * 3, 0.0, -second, 0.0, -second, -second, 0.0], arm.counts.joints
        )
    first_estimate = np.broadcast_to(gains.theta_hat0, high.shape)
    return gains._replace(
        low=tuple(np.minimum(low, first_estimate).tolist()),
        high=tuple(np.maximum(high, first_estimate).tolist()),
    )

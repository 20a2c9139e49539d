"""The operators and environments that the kernel itself computes.

Invariant: each is a `TorqueKind`; the meaning of its vectors there is told by `TorqueSource`.
An operator without a start pose holds the arm at the arm's start pose.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ... import fields
from ...core.chain import MAX_JOINTS
from ...core.exogenous import TorqueKind, TorqueSource
from ...core.live_hand import HandReach, HandRules
from ...core.site_setup import MotionLimits
from ...errors import ScenarioError, count_nouns
from ..arms import ArmModel
from ..operators import ActorBase, HeldArm, SampledActor, TimedActor

Frequency = Annotated[float, Meta(gt=0.0, le=1000.0)]
RecordedPoint = Annotated[
    tuple[fields.Real, ...], Meta(min_length=2, max_length=1 + MAX_JOINTS)
]
FARTHEST = 100.0
"""Largest norm of a live hand's target, m or rad; what is further is no arm's."""
STRONGEST = 10.0
"""Largest force of one that is taken, in parts of its limit; up to that it is limited."""
DIRECTIONS = {
    "right": (1.0, 0.0, 0.0), "left": (-1.0, 0.0, 0.0), "ahead": (0.0, 1.0, 0.0),
    "back": (0.0, -1.0, 0.0), "up": (0.0, 0.0, 1.0), "down": (0.0, 0.0, -1.0),
}  # fmt: skip
"""Of whoever holds a device: x to the right, y ahead, z up."""
FRAMES = {2: ("right", "up"), 3: ("ahead", "left", "up")}
"""Where the axes of an arm point, by their number, if its scenario does not say it."""
_AXES_WORDS = {
    "stiffness_n_m": "one number for {all_axes}, at least 0, N/m",
    "damping_n_s_m": "one number for {all_axes}, at least 0, N s/m",
}


class Pulse(ActorBase, frozen=True, tag="pulse"):
    """A smooth push of an operator: peak * sin^2(pi (t - start) / (end - start)).

    Attributes:
        start_s: when it begins.
        end_s: when it ends.
        peak_nm: its peak on each joint, N m.
    """

    start_s: fields.NotNegative
    end_s: fields.Positive
    peak_nm: fields.Joints

    def _source(self) -> TorqueSource:
        return TorqueSource(TorqueKind.PULSE, self.start_s, self.end_s, a=self.peak_nm)


class MovingSpring(ActorBase, frozen=True, kw_only=True):
    """A spring and a damper of an operator, towards a target that moves (minimum jerk).

    Four fields come first: the target, that before, left out as the arm starts; stiffness and
    damping.

    Attributes:
        move_start_s: when the target begins to move.
        move_end_s: when it arrives.
        start_s: when the operator takes hold.
        end_s: when it lets go.
        sampled: true: evaluated once a tick and held.
    """

    at_tip: ClassVar[bool]

    # Not those of `SampledActor`: the order of keys is that of a scenario's text, whose hash logs hold.
    move_start_s: fields.NotNegative = 0.0
    move_end_s: fields.NotNegative = 0.0
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    @classmethod
    def complete(
        cls,
        table: fields.TomlTable,
        entry: fields.TomlTable,  # noqa: ARG003 - all kinds have the same arguments
        holding: HeldArm,
        path: str,
    ) -> None:
        """Holds the arm as it starts where no target is given."""
        to, before = fields.field_names(cls)[:2]
        start = holding.end_effector_m() if cls.at_tip else holding.q0_rad
        holding.draws.follow_start(table, before, start, path)
        holding.draws.follow_start(table, to, table[before], path)

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns times in a wrong order."""
        start_s = self.move_start_s
        end_s = self.move_end_s
        if (problem := super().find_problem()) or end_s >= start_s:
            return problem
        return fields.KeyProblem(
            "move_end_s", f"must not be before move_start_s = {start_s:g}, is {end_s:g}"
        )

    def _source(self) -> TorqueSource:
        end, start, stiffness, damping = msgspec.structs.astuple(self)[:4]
        held = self.start_s, self.end_s, self.move_start_s, self.move_end_s
        kind = TorqueKind.TASK_HAND if self.at_tip else TorqueKind.HAND
        return TorqueSource(kind, *held, start, end, stiffness, damping, self.sampled)


class JointSpring(MovingSpring, frozen=True, tag="spring"):
    """An operator as a spring and a damper on every joint, towards a pose that moves.

    Attributes:
        to_rad: the pose that it moves to, rad.
        from_rad: the pose before, rad; left out: the arm's start pose.
        stiffness_nm_rad: per joint, N m/rad.
        damping_nm_s_rad: per joint, N m s/rad.
    """

    at_tip: ClassVar[bool] = False

    to_rad: fields.Joints
    from_rad: fields.Joints
    stiffness_nm_rad: fields.NotNegativeJoints
    damping_nm_s_rad: fields.NotNegativeJoints = (0.0,)


class EndEffectorSpring(MovingSpring, frozen=True, tag="tip_spring"):
    """An operator at the end effector: a spring and a damper in the plane, towards a point that
    moves.

    Attributes:
        to_m: the point that it moves to, x and y, m.
        from_m: the point before, m; left out: the end effector's start position.
        stiffness_n_m: along x and y, N/m.
        damping_n_s_m: along x and y, N s/m.
    """

    at_tip: ClassVar[bool] = True
    value_texts: ClassVar[Mapping[str, str]] = _AXES_WORDS

    to_m: fields.Point
    from_m: fields.Point
    stiffness_n_m: fields.NotNegativeAxes
    damping_n_s_m: fields.NotNegativeAxes = (0.0,)


class RecordedTorque(ActorBase, frozen=True, tag="recorded"):
    """A torque that was recorded, linear between its points; nothing before the first and after
    the last.

    Attributes:
        points: rows of time, s, and the torque on each joint, N m, in order of time.
    """

    points: Annotated[tuple[RecordedPoint, ...], Meta(min_length=1, max_length=1_000_000)]

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns points in a wrong order."""
        if any(b[0] <= a[0] for a, b in pairwise(self.points)):
            return fields.KeyProblem("points", "must be in the order of their times")
        return None

    def _source(self) -> TorqueSource:
        return TorqueSource(TorqueKind.RECORDED, table=np.array(self.points, dtype=np.float64))


class Chirp(TimedActor, frozen=True, tag="chirp"):
    """A torque of an operator whose frequency runs from one to another, evenly, again and
    again.

    Attributes:
        peak_nm: its peak on each joint, N m.
        from_hz: frequency at the beginning of a sweep, Hz.
        to_hz: frequency at its end, Hz.
        sweep_s: duration of a sweep, s.
    """

    peak_nm: fields.Joints
    from_hz: Frequency
    to_hz: Frequency
    sweep_s: fields.Positive

    def _source(self) -> TorqueSource:
        sweep = (self.start_s, self.start_s + self.sweep_s)
        return TorqueSource(
            TorqueKind.CHIRP,
            self.start_s,
            self.end_s,
            *sweep,
            self.peak_nm,
            (self.from_hz, self.to_hz),
        )


class Multisine(TimedActor, frozen=True, tag="multisine"):
    """A torque of an operator that is a sum of sines of one amplitude.

    Attributes:
        amplitude_nm: amplitude of each sine on each joint, N m.
        frequencies_hz: their frequencies, Hz.
        phases_rad: their phases at the start, rad; left out: -pi k (k - 1) / n for the k-th of
            n, which keeps the peak of their sum low (Schroeder, "Synthesis of low-peak-factor
            signals and binary sequences with low autocorrelation", IEEE Trans. Information
            Theory 16 (1970)).
    """

    amplitude_nm: fields.Joints
    frequencies_hz: Annotated[tuple[Frequency, ...], Meta(min_length=1, max_length=64)]
    phases_rad: Annotated[tuple[fields.Real, ...], Meta(max_length=64)] = ()

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns too many or too few phases."""
        count = len(self.frequencies_hz)
        if len(self.phases_rad) not in (0, count):
            return fields.KeyProblem(
                "phases_rad", f"must be {count_nouns(count, 'angle')}, as many as frequencies"
            )
        return super().find_problem()

    def _source(self) -> TorqueSource:
        count = len(self.frequencies_hz)
        turns = [phase / (2.0 * math.pi) for phase in self.phases_rad]
        turns = turns or [-k * (k - 1) / (2.0 * count) for k in range(1, count + 1)]
        table = np.column_stack((self.frequencies_hz, turns, np.zeros(count)))
        return TorqueSource(
            TorqueKind.MULTISINE, self.start_s, self.end_s, a=self.amplitude_nm, table=table
        )


class DeviceSettings(fields.Frozen, frozen=True, omit_defaults=True):
    """How a device in somebody's hand leads an arm, and what it renders of the arm's reaction.

    Attributes:
        frame: where each axis of the arm points, for whoever holds the device: "right", "left",
            "ahead", "back", "up" or "down"; left out: right and up in the plane, ahead, left
            and up in space.
        scale: motion of the target over motion of the device.
        clutch: the button that leads the arm while it is pressed; pressed first, it takes hold.
        release: the button that lets go.
        force_scale: force on the device over the reaction of the arm.
        force_limit_n: the largest force on the device, N.
        jump_m_s: a device that is faster has jumped, m/s; a jump moves nothing.
    """

    frame: Annotated[tuple[str, ...], Meta(max_length=3)] = ()
    scale: fields.Positive = 1.0
    clutch: str = "a"
    release: str = "b"
    force_scale: fields.NotNegative = 1.0
    force_limit_n: fields.Positive = 2.0
    jump_m_s: fields.Positive = 5.0

    def rows(self, axes: int) -> list[tuple[float, ...]]:
        """Returns the axes of an arm, each as a direction of whoever holds the device."""
        return [DIRECTIONS[word] for word in self.frame or FRAMES[axes]]


class LiveHand(ActorBase, frozen=True, tag="live", omit_defaults=True):
    """An operator who takes hold while a live session runs, with a mouse, a device or a
    program.

    Nobody holds the arm before, and in virtual time nobody ever does, unless a log says so. Its
    force is computed once a tick and held. One that pushes ("force") sets a force itself: its
    work is of first order in the period, as nothing but the arm resists it.

    Attributes:
        mode: "tip": a spring at the end effector, "joint": a spring at every joint, both
            towards a target that somebody moves; "force": a force at the end effector that
            somebody sets.
        stiffness_n_m: of "tip", along each axis, N/m.
        damping_n_s_m: of "tip", along each axis, N s/m.
        force_limit_n: of "tip" and "force", the largest force, N.
        speed_limit_m_s: of "tip", the largest speed of the target, m/s.
        stiffness_nm_rad: of "joint", per joint, N m/rad.
        damping_nm_s_rad: of "joint", per joint, N m s/rad.
        torque_limit_nm: of "joint", the largest norm of its torques, N m.
        speed_limit_rad_s: of "joint", the largest speed of the target, rad/s.
        acceleration_limit_m_s2: of "tip", the largest acceleration of the target, m/s^2.
        acceleration_limit_rad_s2: of "joint", the largest acceleration of the target, rad/s^2.
        device: of "tip", how a device leads it (`trilat hand --device`, a controller in virtual
            reality).
    """

    value_texts: ClassVar[Mapping[str, str]] = {
        **_AXES_WORDS,
        "device": "a table of " + ", ".join(fields.field_names(DeviceSettings)),
    }
    is_open: ClassVar[bool] = True
    """True: whoever comes may take hold."""

    mode: Literal["tip", "joint", "force"] = "tip"
    stiffness_n_m: fields.NotNegativeAxes = (300.0,)
    damping_n_s_m: fields.NotNegativeAxes = (20.0,)
    force_limit_n: fields.Positive = 40.0
    speed_limit_m_s: fields.Positive = 1.5
    stiffness_nm_rad: fields.NotNegativeJoints = (40.0,)
    damping_nm_s_rad: fields.NotNegativeJoints = (3.0,)
    torque_limit_nm: fields.Positive = 20.0
    speed_limit_rad_s: fields.Positive = 4.0
    acceleration_limit_m_s2: fields.Positive = 20.0
    acceleration_limit_rad_s2: fields.Positive = 50.0
    device: DeviceSettings = DeviceSettings()

    @classmethod
    def complete(
        cls, table: fields.TomlTable, entry: fields.TomlTable, holding: HeldArm, path: str
    ) -> None:
        """Leaves out what another mode has; refuses what the author wrote of that."""
        mode = entry.get("mode", "tip")
        fields.check_choice(mode, list(LIVE_KEYS), f"{path}.mode")
        for key in [key for key in table if key not in ("kind", "mode", *LIVE_KEYS[mode])]:
            if key in entry:
                which = next(name for name, keys in LIVE_KEYS.items() if key in keys)
                raise ScenarioError(
                    f"belongs to a live hand of mode {which!r}; this one is of mode {mode!r}, "
                    f"which has {', '.join(LIVE_KEYS[mode])}",
                    path=f"{path}.{key}",
                )
            del table[key]
        device = table.get("device")
        axes = holding.counts.axes
        if isinstance(device, dict) and isinstance(frame := device.get("frame"), list):
            lines = {tuple(map(abs, DIRECTIONS.get(str(word), ()))) for word in frame}
            if not len(frame) == axes == len(lines - {()}):
                words = (
                    f"one of {', '.join(DIRECTIONS)} for each of "
                    f"{count_nouns(axes, 'axis')}, and no two of one line"
                )
                raise ScenarioError(f"must be {words}, is {frame}", path=f"{path}.device.frame")

    def make_rules(
        self, rate_hz: int, arm: ArmModel, limits: MotionLimits | None = None
    ) -> HandRules:
        """Returns what somebody who holds an arm may do; `limits`: of the motion of its site."""
        if self.mode == "force":
            strongest = STRONGEST * self.force_limit_n
            return HandRules(
                arm.counts.axes, rate_hz, math.inf, starts_at_arm=False, max_goal_norm=strongest
            )
        if self.mode == "joint":
            size = arm.counts.joints
            speed_limit = self.speed_limit_rad_s
            acceleration = self.acceleration_limit_rad_s2
            reach = arm.find_joint_reach(limits or MotionLimits())
        else:
            size = arm.counts.axes
            speed_limit = self.speed_limit_m_s
            acceleration = self.acceleration_limit_m_s2
            reach = arm.reach
        return HandRules(
            size,
            rate_hz,
            speed_limit,
            max_goal_norm=FARTHEST,
            acceleration_limit=acceleration if acceleration < fields.MAX_QUANTITY else math.inf,
            reach=reach if self.is_open else HandReach(),
        )

    def _source(self) -> TorqueSource:
        stiffness = self.stiffness_n_m
        damping = self.damping_n_s_m
        limit = self.force_limit_n
        if self.mode == "joint":
            stiffness = self.stiffness_nm_rad
            damping = self.damping_nm_s_rad
            limit = self.torque_limit_nm
        kind = TorqueKind[f"LIVE_{self.mode.upper()}"]
        return TorqueSource(kind, K=stiffness, B=damping, limit=limit, sampled=True)


LIVE_KEYS = {
    "tip": (
        "stiffness_n_m",
        "damping_n_s_m",
        "force_limit_n",
        "speed_limit_m_s",
        "acceleration_limit_m_s2",
        "device",
    ),
    "joint": (
        "stiffness_nm_rad",
        "damping_nm_s_rad",
        "torque_limit_nm",
        "speed_limit_rad_s",
        "acceleration_limit_rad_s2",
    ),
    "force": ("force_limit_n",),
}
"""The keys of a live hand by its mode."""


class ViscousEnvironment(SampledActor, frozen=True, tag="viscous"):
    """An environment that resists motion of the joints.

    Attributes:
        damping_nm_s_rad: per joint, N m s/rad.
    """

    group: ClassVar[str] = "environment"

    damping_nm_s_rad: fields.NotNegativeJoints

    def _source(self) -> TorqueSource:
        return TorqueSource(
            TorqueKind.VISCOUS,
            self.start_s,
            self.end_s,
            B=self.damping_nm_s_rad,
            sampled=self.sampled,
        )


class Wall(SampledActor, frozen=True, tag="wall"):
    """A unilateral wall for the end effector: it pushes out of itself, along its normal, and
    never pulls.

    Attributes:
        point_m: a point of its surface, x and y, m.
        normal: towards the free side; its length does not matter.
        stiffness_n_m: N/m.
        damping_n_s_m: N s/m.
    """

    group: ClassVar[str] = "environment"
    value_texts: ClassVar[Mapping[str, str]] = {
        "stiffness_n_m": "a number of at least 0, N/m",
        "damping_n_s_m": "a number of at least 0, N s/m",
    }

    point_m: fields.Point
    normal: fields.Point
    stiffness_n_m: fields.NotNegative
    damping_n_s_m: fields.NotNegative = 0.0

    def _source(self) -> TorqueSource:
        x, y, z = (*self.normal, 0.0)[:3]
        # `math.hypot` of three numbers rounds otherwise on other machines
        length = math.hypot(x, y) if len(self.normal) == 2 else math.sqrt(x * x + y * y + z * z)
        unit = tuple(x / length for x in self.normal)
        stiffness = (self.stiffness_n_m, 0.0)
        damping = (self.damping_n_s_m, 0.0)
        vectors: dict[str, Any] = {"a": self.point_m, "b": unit, "K": stiffness, "B": damping}
        return TorqueSource(
            TorqueKind.WALL, self.start_s, self.end_s, **vectors, sampled=self.sampled
        )

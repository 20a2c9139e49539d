"""The operators and environments that the kernel itself computes.

Each is a `TorqueKind`; `TorqueSource` documents the meaning of its vectors there.

Invariant:
    - An operator without a start pose holds the arm at the arm's start pose.
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
"""Largest norm of a live hand's target, m or rad; no arm reaches farther."""
STRONGEST = 10.0
"""Largest force that a program may ask of a live hand, in parts of the hand's force limit.

A force between the limit and this is limited; a larger force is refused.
"""
DIRECTIONS = {
    "right": (1.0, 0.0, 0.0), "left": (-1.0, 0.0, 0.0), "ahead": (0.0, 1.0, 0.0),
    "back": (0.0, -1.0, 0.0), "up": (0.0, 0.0, 1.0), "down": (0.0, 0.0, -1.0),
}  # fmt: skip
"""Directions as seen by the person who holds a device: x to the right, y ahead, z up."""
FRAMES = {2: ("right", "up"), 3: ("ahead", "left", "up")}
"""Default directions of an arm's axes, by the number of axes."""
_AXES_TEXTS = {
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
    """A spring and a damper of an operator, towards a target that moves with minimum jerk.

    A subclass begins with four fields: the target at the end of the motion; the target before
    the motion, by default where the arm starts; the stiffness; the damping.

    Attributes:
        move_start_s: when the target begins to move.
        move_end_s: when it arrives.
        start_s: when the operator takes hold.
        end_s: when the operator lets go.
        sampled: true: evaluated once per tick and held.
    """

    at_tip: ClassVar[bool]

    # Not inherited from `SampledActor`: the order of the fields is the order of keys in a
    # scenario's text, whose hash is in logs.
    move_start_s: fields.NotNegative = 0.0
    move_end_s: fields.NotNegative = 0.0
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    @classmethod
    def complete_table(
        cls,
        table: fields.TomlTable,
        entry: fields.TomlTable,  # noqa: ARG003 - all kinds have the same arguments
        held_arm: HeldArm,
        path: str,
    ) -> None:
        """Writes the start pose as the target where the author gave none."""
        end_key, start_key = fields.field_names(cls)[:2]
        start_pose = held_arm.end_effector_m() if cls.at_tip else held_arm.q0_rad
        held_arm.draws.follow_start(table, start_key, start_pose, path)
        held_arm.draws.follow_start(table, end_key, table[start_key], path)

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns a problem of the times, or None."""
        problem = super().find_problem()
        if problem is not None or self.move_end_s >= self.move_start_s:
            return problem
        return fields.KeyProblem(
            "move_end_s",
            f"must not be before move_start_s = {self.move_start_s:g}, is {self.move_end_s:g}",
        )

    def _source(self) -> TorqueSource:
        end_target, start_target, stiffness, damping = msgspec.structs.astuple(self)[:4]
        return TorqueSource(
            TorqueKind.TASK_HAND if self.at_tip else TorqueKind.HAND,
            start_s=self.start_s,
            end_s=self.end_s,
            move_start_s=self.move_start_s,
            move_end_s=self.move_end_s,
            a=start_target,
            b=end_target,
            K=stiffness,
            B=damping,
            sampled=self.sampled,
        )


class JointSpring(MovingSpring, frozen=True, tag="spring"):
    """An operator as a spring and a damper on every joint, towards a pose that moves.

    Attributes:
        to_rad: the pose to which the target moves, rad.
        from_rad: the pose before the motion, rad; left out: the arm's start pose.
        stiffness_nm_rad: per joint, N m/rad.
        damping_nm_s_rad: per joint, N m s/rad.
    """

    at_tip: ClassVar[bool] = False

    to_rad: fields.Joints
    from_rad: fields.Joints
    stiffness_nm_rad: fields.NotNegativeJoints
    damping_nm_s_rad: fields.NotNegativeJoints = (0.0,)


class EndEffectorSpring(MovingSpring, frozen=True, tag="tip_spring"):
    """An operator at the end effector: a spring and a damper towards a point that moves.

    Attributes:
        to_m: the point to which the target moves, m, one number per axis of the arm's space.
        from_m: the point before the motion, m; left out: the end effector's start position.
        stiffness_n_m: along each axis, N/m.
        damping_n_s_m: along each axis, N s/m.
    """

    at_tip: ClassVar[bool] = True
    value_texts: ClassVar[Mapping[str, str]] = _AXES_TEXTS

    to_m: fields.Point
    from_m: fields.Point
    stiffness_n_m: fields.NotNegativeAxes
    damping_n_s_m: fields.NotNegativeAxes = (0.0,)


class RecordedTorque(ActorBase, frozen=True, tag="recorded"):
    """A recorded torque: linear between its points, and zero before and after them.

    Attributes:
        points: rows of the time, s, and the torque on each joint, N m, in the order of time.
    """

    points: Annotated[tuple[RecordedPoint, ...], Meta(min_length=1, max_length=1_000_000)]

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns a problem of the order of the points, or None."""
        if any(later[0] <= earlier[0] for earlier, later in pairwise(self.points)):
            return fields.KeyProblem("points", "must be in the order of their times")
        return None

    def _source(self) -> TorqueSource:
        return TorqueSource(TorqueKind.RECORDED, table=np.array(self.points, dtype=np.float64))


class Chirp(TimedActor, frozen=True, tag="chirp"):
    """A torque of an operator whose frequency rises or falls linearly, sweep after sweep.

    Attributes:
        peak_nm: its peak on each joint, N m.
        from_hz: frequency at the beginning of a sweep, Hz.
        to_hz: frequency at the end of a sweep, Hz.
        sweep_s: duration of a sweep, s.
    """

    peak_nm: fields.Joints
    from_hz: Frequency
    to_hz: Frequency
    sweep_s: fields.Positive

    def _source(self) -> TorqueSource:
        return TorqueSource(
            TorqueKind.CHIRP,
            start_s=self.start_s,
            end_s=self.end_s,
            move_start_s=self.start_s,
            move_end_s=self.start_s + self.sweep_s,
            a=self.peak_nm,
            b=(self.from_hz, self.to_hz),
        )


class Multisine(TimedActor, frozen=True, tag="multisine"):
    """A torque of an operator that is a sum of sines of equal amplitude.

    Attributes:
        amplitude_nm: amplitude of each sine on each joint, N m.
        frequencies_hz: the frequencies of the sines, Hz.
        phases_rad: the phases of the sines at the start, rad; left out: -pi k (k - 1) / n for
            the k-th of n sines, which keeps the peak of the sum low (Schroeder, "Synthesis of
            low-peak-factor signals and binary sequences with low autocorrelation", IEEE Trans.
            Information Theory 16 (1970)).
    """

    amplitude_nm: fields.Joints
    frequencies_hz: Annotated[tuple[Frequency, ...], Meta(min_length=1, max_length=64)]
    phases_rad: Annotated[tuple[fields.Real, ...], Meta(max_length=64)] = ()

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns a problem of the number of phases, or of the times, or None."""
        count = len(self.frequencies_hz)
        if len(self.phases_rad) not in (0, count):
            return fields.KeyProblem(
                "phases_rad", f"must be {count_nouns(count, 'angle')}, as many as frequencies"
            )
        return super().find_problem()

    def _source(self) -> TorqueSource:
        count = len(self.frequencies_hz)
        turns = [phase / (2.0 * math.pi) for phase in self.phases_rad]
        if not turns:
            turns = [-k * (k - 1) / (2.0 * count) for k in range(1, count + 1)]
        table = np.column_stack((self.frequencies_hz, turns, np.zeros(count)))
        return TorqueSource(
            TorqueKind.MULTISINE, self.start_s, self.end_s, a=self.amplitude_nm, table=table
        )


class DeviceSettings(fields.Frozen, frozen=True, omit_defaults=True):
    """How a device in a person's hand leads an arm and renders the arm's reaction.

    Attributes:
        frame: the direction of each axis of the arm as seen by the person who holds the device:
            "right", "left", "ahead", "back", "up" or "down"; left out: right and up in the
            plane; ahead, left and up in space.
        scale: motion of the target over motion of the device.
        clutch: the button that leads the arm while it is pressed; the first press takes hold.
        release: the button that lets go.
        force_scale: force on the device over the reaction of the arm.
        force_limit_n: the largest force on the device, N.
        jump_m_s: speed of the device above which its motion is a jump, m/s; a jump does not
            move the target.
    """

    frame: Annotated[tuple[str, ...], Meta(max_length=3)] = ()
    scale: fields.Positive = 1.0
    clutch: str = "a"
    release: str = "b"
    force_scale: fields.NotNegative = 1.0
    force_limit_n: fields.Positive = 2.0
    jump_m_s: fields.Positive = 5.0

    def rows(self, axes: int) -> list[tuple[float, ...]]:
        """Returns the directions of the arm's axes as seen by the holder of the device."""
        return [DIRECTIONS[name] for name in self.frame or FRAMES[axes]]


class LiveHand(ActorBase, frozen=True, tag="live", omit_defaults=True):
    """An operator who takes hold during a live session: with a mouse, a device or a program.

    Nobody holds the arm before. In virtual time nobody ever holds the arm, unless the run
    executes a log in which somebody did. The force is computed once per tick and held. In the
    mode "force" the operator sets the force itself; its work then has an error of first order
    in the period, because nothing but the arm resists the force.

    Attributes:
        mode: "tip": a spring at the end effector; "joint": a spring at every joint; both
            towards a target that somebody moves. "force": a force at the end effector that
            somebody sets.
        stiffness_n_m: for "tip", along each axis, N/m.
        damping_n_s_m: for "tip", along each axis, N s/m.
        force_limit_n: for "tip" and "force", the largest force, N.
        speed_limit_m_s: for "tip", the largest speed of the target, m/s.
        stiffness_nm_rad: for "joint", per joint, N m/rad.
        damping_nm_s_rad: for "joint", per joint, N m s/rad.
        torque_limit_nm: for "joint", the largest norm of its torques, N m.
        speed_limit_rad_s: for "joint", the largest speed of the target, rad/s.
        acceleration_limit_m_s2: for "tip", the largest acceleration of the target, m/s^2.
        acceleration_limit_rad_s2: for "joint", the largest acceleration of the target, rad/s^2.
        device: for "tip", how a device leads the arm (`trilat hand --device`, a controller in
            virtual reality).
    """

    value_texts: ClassVar[Mapping[str, str]] = {
        **_AXES_TEXTS,
        "device": "a table of " + ", ".join(fields.field_names(DeviceSettings)),
    }
    is_open: ClassVar[bool] = True
    """True: anybody in the session may take hold."""

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
    def complete_table(
        cls, table: fields.TomlTable, entry: fields.TomlTable, held_arm: HeldArm, path: str
    ) -> None:
        """Removes the keys of the other modes, and refuses those that the author wrote."""
        mode = entry.get("mode", "tip")
        fields.check_choice(mode, list(LIVE_KEYS), f"{path}.mode")
        mode_keys = LIVE_KEYS[mode]
        for key in list(table):
            if key in ("kind", "mode", *mode_keys):
                continue
            if key in entry:
                other_mode = next(name for name, keys in LIVE_KEYS.items() if key in keys)
                raise ScenarioError(
                    f"belongs to a live hand of mode {other_mode!r}; this one is of mode "
                    f"{mode!r}, which has {', '.join(mode_keys)}",
                    path=f"{path}.{key}",
                )
            del table[key]
        device = table.get("device")
        if isinstance(device, dict) and isinstance(device.get("frame"), list):
            _check_frame(device["frame"], held_arm.counts.axes, f"{path}.device.frame")

    def make_rules(
        self, rate_hz: int, arm: ArmModel, limits: MotionLimits | None = None
    ) -> HandRules:
        """Returns the rules that the holder of an arm must keep to.

        Args:
            rate_hz: the tick rate of the site, Hz.
            arm: the arm.
            limits: the limits of the motion of its site; None: no limits.
        """
        if self.mode == "force":
            return HandRules(
                arm.counts.axes,
                rate_hz,
                speed_limit=math.inf,
                starts_at_arm=False,
                max_goal_norm=STRONGEST * self.force_limit_n,
            )
        if self.mode == "joint":
            size = arm.counts.joints
            speed_limit = self.speed_limit_rad_s
            acceleration_limit = self.acceleration_limit_rad_s2
            reach = arm.find_joint_reach(limits or MotionLimits())
        else:
            size = arm.counts.axes
            speed_limit = self.speed_limit_m_s
            acceleration_limit = self.acceleration_limit_m_s2
            reach = arm.reach
        is_limited = acceleration_limit < fields.MAX_QUANTITY
        return HandRules(
            size,
            rate_hz,
            speed_limit,
            max_goal_norm=FARTHEST,
            acceleration_limit=acceleration_limit if is_limited else math.inf,
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


def _check_frame(frame: list[Any], axes: int, path: str) -> None:
    """Refuses directions of axes that are unknown, too few or too many, or on the same line."""
    lines = {tuple(map(abs, DIRECTIONS.get(str(name), ()))) for name in frame}
    lines.discard(())
    if not len(frame) == axes == len(lines):
        expected = (
            f"one of {', '.join(DIRECTIONS)} for each of {count_nouns(axes, 'axis')}, and no "
            "two of one line"
        )
        raise ScenarioError(f"must be {expected}, is {frame}", path=path)


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
    """A unilateral wall for the end effector: it pushes along its normal and never pulls.

    Attributes:
        point_m: a point of its surface, m, one number per axis of the arm's space.
        normal: direction of the free side; its length does not matter.
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
        # Unlike that of two numbers, `math.hypot` of three rounds differently between machines.
        length = math.hypot(x, y) if len(self.normal) == 2 else math.sqrt(x * x + y * y + z * z)
        return TorqueSource(
            TorqueKind.WALL,
            self.start_s,
            self.end_s,
            a=self.point_m,
            b=tuple(component / length for component in self.normal),
            K=(self.stiffness_n_m, 0.0),
            B=(self.damping_n_s_m, 0.0),
            sampled=self.sampled,
        )

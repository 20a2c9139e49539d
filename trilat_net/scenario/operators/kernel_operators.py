"""Operators and environments that are built into the compiled simulation.

Each class holds the settings of one kind, such as a spring towards a moving target, a recorded
torque or a wall. It converts them to a `TorqueSource`, the record from which the compiled
simulation computes the torque on the arm. The `TorqueKind` in this record selects the formula;
see `TorqueSource` for the meaning of its parameters for each kind.

Invariant:
    - By default, an operator holds the arm at its start pose, so the run starts without a jump.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, get_args

import msgspec
import numpy as np
from msgspec import Meta

from ... import fields
from ...core import HandReach, HandRules, MotionLimits, TorqueKind, TorqueSource
from ...errors import ScenarioError, count_nouns
from ...records import MAX_JOINTS
from ..arms import ArmModel
from ..key_checks import check_choice, field_names
from . import ActorBase, HeldArm, SampledActor, TimedActor

Frequency = Annotated[float, Meta(gt=0.0, le=1000.0)]
RecordedPoint = Annotated[
    tuple[fields.Real, ...], Meta(min_length=2, max_length=1 + MAX_JOINTS)
]
FARTHEST = 100.0
"""Largest norm of a live operator's target, in m or rad, beyond the reach of any arm."""
STRONGEST = 10.0
"""Largest force that a program may request, as a multiple of the operator's force limit.

A force above the limit is clipped to the limit. A force above this multiple is rejected as a
mistake.
"""
DIRECTIONS = {
    "right": (1.0, 0.0, 0.0), "left": (-1.0, 0.0, 0.0), "ahead": (0.0, 1.0, 0.0),
    "back": (0.0, -1.0, 0.0), "up": (0.0, 0.0, 1.0), "down": (0.0, 0.0, -1.0),
}  # fmt: skip
"""Directions as seen by the person who holds a device: x right, y ahead, z up."""
FRAMES = {2: ("right", "up"), 3: ("ahead", "left", "up")}
"""Mapping from the number of an arm's axes to their default directions."""
_AXES_TEXTS = {
    "stiffness_n_m": "one number for {all_axes}, at least 0, N/m",
    "damping_n_s_m": "one number for {all_axes}, at least 0, N s/m",
}


class Pulse(ActorBase, frozen=True, tag="pulse"):
    """Operator who pushes the arm once with a smooth torque pulse.

        torque = peak sin^2(pi (t - start) / (end - start))

    t is the time since the start of the run. The torque is zero outside the pulse.

    Attributes:
        start_s: Start of the pulse, in s.
        end_s: End of the pulse, in s.
        peak_nm: Peak torque on each joint, in N m.
    """

    start_s: fields.NotNegative
    end_s: fields.Positive
    peak_nm: fields.Joints

    def _source(self) -> TorqueSource:
        """Returns the torque pulse in the format read by the compiled simulation."""
        return TorqueSource(TorqueKind.PULSE, self.start_s, self.end_s, a=self.peak_nm)


class MovingSpring(ActorBase, frozen=True, kw_only=True):
    """Base class of operators who pull the arm towards a moving target.

    The operator acts through a spring and a damper. The target moves along a minimum-jerk path.
    The first four fields of a subclass must be the end of the path, the start of the path (by
    default, where the arm starts), the stiffness and the damping, in this order.

    Attributes:
        move_start_s: Time at which the target starts to move, in s.
        move_end_s: Time at which the target reaches the end of the path, in s.
        start_s: Time at which the operator takes hold of the arm, in s.
        end_s: Time at which the operator lets go of the arm, in s.
        sampled: If True, the torque is computed once per tick and held.
    """

    at_tip: ClassVar[bool]

    # The field is not inherited from `SampledActor`, because the order of the fields is the
    # order of keys in a scenario's text, whose hash is stored in logs.
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
        """Adds the default start and end of the target's path.

        By default, the target starts at the start pose of the arm and does not move.

        Args:
            table: Settings of the operator including all other defaults, modified in place.
            entry: The same settings as written by their author. Not used.
            held_arm: The arm that the operator moves.
            path: Path of the settings in the scenario, for error messages.
        """
        end_key, start_key = field_names(cls)[:2]
        start_pose = held_arm.end_effector_m() if cls.at_tip else held_arm.q0_rad
        held_arm.draws.follow_start(table, start_key, start_pose, path)
        held_arm.draws.follow_start(table, end_key, table[start_key], path)

    def find_problem(self) -> fields.KeyProblem | None:
        """Checks that the target does not arrive before it starts to move.

        Also performs the checks of the base class.

        Returns:
            The key and the reason, or None if there is no problem.
        """
        problem = super().find_problem()
        if problem is not None or self.move_end_s >= self.move_start_s:
            return problem
        return fields.KeyProblem(
            "move_end_s",
            f"must not be before move_start_s = {self.move_start_s:g}, but is "
            f"{self.move_end_s:g}",
        )

    def _source(self) -> TorqueSource:
        """Returns the spring and its moving target in the format read by the simulation."""
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
    """Operator who pulls every joint with a spring and a damper towards a moving pose.

    Models a person who moves an arm to a pose and feels its resistance.

    Attributes:
        to_rad: Final pose of the target, in rad.
        from_rad: Initial pose of the target, in rad. By default, the start pose of the arm.
        stiffness_nm_rad: Stiffness at each joint, in N m/rad.
        damping_nm_s_rad: Damping at each joint, in N m s/rad.
    """

    at_tip: ClassVar[bool] = False

    to_rad: fields.Joints
    from_rad: fields.Joints
    stiffness_nm_rad: fields.NotNegativeJoints
    damping_nm_s_rad: fields.NotNegativeJoints = (0.0,)


class EndEffectorSpring(MovingSpring, frozen=True, tag="tip_spring"):
    """Operator who pulls the end effector with a spring and damper towards a moving point.

    Models a person who holds the end of an arm and leaves its joints free.

    Attributes:
        to_m: Final position of the target, in m, one coordinate per axis.
        from_m: Initial position of the target, in m. By default, the start position of the end
            effector.
        stiffness_n_m: Stiffness along each axis, in N/m.
        damping_n_s_m: Damping along each axis, in N s/m.
    """

    at_tip: ClassVar[bool] = True
    value_texts: ClassVar[Mapping[str, str]] = _AXES_TEXTS

    to_m: fields.Point
    from_m: fields.Point
    stiffness_n_m: fields.NotNegativeAxes
    damping_n_s_m: fields.NotNegativeAxes = (0.0,)


class RecordedTorque(ActorBase, frozen=True, tag="recorded"):
    """Operator who replays a torque that was recorded over time.

    The torque is interpolated linearly between the recorded points. It is zero before the first
    point and after the last.

    Attributes:
        points: Rows in ascending order of time, each with the time in s and the torque on each
            joint in N m.
    """

    points: Annotated[tuple[RecordedPoint, ...], Meta(min_length=1, max_length=1_000_000)]

    def find_problem(self) -> fields.KeyProblem | None:
        """Checks that the times of the recorded torque are in ascending order.

        The simulation looks up the torque by bisection, which requires sorted times.

        Returns:
            The key `points` and the reason, or None if the times are strictly increasing.
        """
        if any(later[0] <= earlier[0] for earlier, later in pairwise(self.points)):
            return fields.KeyProblem("points", "must be in the order of their times")
        return None

    def _source(self) -> TorqueSource:
        """Returns the recorded torques in the format read by the compiled simulation."""
        return TorqueSource(TorqueKind.RECORDED, table=np.array(self.points, dtype=np.float64))


class Chirp(TimedActor, frozen=True, tag="chirp"):
    """Operator whose torque is a sine of varying frequency, for measuring frequency responses.

    The frequency sweeps linearly from its first to its last value, for example from 0.1 to 10
    Hz, and the sweep is repeated.

    Attributes:
        peak_nm: Torque amplitude on each joint, in N m.
        from_hz: Frequency at the beginning of a sweep, in Hz.
        to_hz: Frequency at the end of a sweep, in Hz.
        sweep_s: Duration of a sweep, in s.
    """

    oscillates: ClassVar[bool] = True

    peak_nm: fields.Joints
    from_hz: Frequency
    to_hz: Frequency
    sweep_s: fields.Positive

    def _source(self) -> TorqueSource:
        """Returns the frequency sweep in the format read by the compiled simulation."""
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
    """Operator whose torque is a sum of sines of equal amplitude.

    Excites several frequencies at once, so the frequency response of the arm can be measured in
    a single run.

    Attributes:
        amplitude_nm: Amplitude of each sine on each joint, in N m.
        frequencies_hz: Frequencies of the sines, in Hz.
        phases_rad: Initial phases of the sines, in rad. By default, -pi k (k - 1) / n for the
            k-th of n sines, which keeps the peak of the sum low (Schroeder, "Synthesis of
            low-peak-factor signals and binary sequences with low autocorrelation", IEEE Trans.
            Information Theory 16 (1970)).
    """

    oscillates: ClassVar[bool] = True

    amplitude_nm: fields.Joints
    frequencies_hz: Annotated[tuple[Frequency, ...], Meta(min_length=1, max_length=64)]
    phases_rad: Annotated[tuple[fields.Real, ...], Meta(max_length=64)] = ()

    def find_problem(self) -> fields.KeyProblem | None:
        """Checks that there is one phase per sine, and that the end is not before the start.

        Returns:
            The key and the reason, or None if there is no problem.
        """
        count = len(self.frequencies_hz)
        if len(self.phases_rad) not in (0, count):
            return fields.KeyProblem(
                "phases_rad", f"must be {count_nouns(count, 'angle')}, one for each frequency"
            )
        return super().find_problem()

    def _source(self) -> TorqueSource:
        """Returns the sines in the format read by the compiled simulation.

        Each sine is a row with its frequency in Hz and its phase in turns.
        """
        count = len(self.frequencies_hz)
        turns = [phase / (2.0 * math.pi) for phase in self.phases_rad]
        if not turns:
            # Schroeder's phases, see the class
            turns = [-k * (k - 1) / (2.0 * count) for k in range(1, count + 1)]
        table = np.column_stack((self.frequencies_hz, turns, np.zeros(count)))
        return TorqueSource(
            TorqueKind.MULTISINE, self.start_s, self.end_s, a=self.amplitude_nm, table=table
        )


class DeviceSettings(fields.Frozen, frozen=True, omit_defaults=True):
    """Settings of a haptic device or virtual-reality controller that is used to move an arm.

    The device moves a target, to which a spring pulls the end effector of the arm.

    Attributes:
        frame: Direction of each axis of the arm as seen by the person: "right", "left",
            "ahead", "back", "up" or "down". By default, right and up for a planar arm, and
            ahead, left and up for a chain.
        scale: Ratio of the motion of the target to the motion of the device.
        clutch: Button that couples the device to the arm while pressed. The first press takes
            hold of the arm.
        release: Button that lets go of the arm.
        force_scale: Ratio of the force on the device to the force of the arm on its operator.
        force_limit_n: Largest force on the device, in N.
        jump_m_s: Speed of the device above which its motion is treated as a measurement error
            and does not move the target, in m/s.
    """

    frame: Annotated[tuple[str, ...], Meta(max_length=3)] = ()
    scale: fields.Positive = 1.0
    clutch: str = "a"
    release: str = "b"
    force_scale: fields.NotNegative = 1.0
    force_limit_n: fields.Positive = 2.0
    jump_m_s: fields.Positive = 5.0

    def rows(self, axes: int) -> list[tuple[float, ...]]:
        """Returns the direction of each axis of the arm as seen by the user of the device.

        Args:
            axes: Number of axes of the arm: 2 for a planar arm, 3 for a chain. Selects the
                default directions if the settings specify none.

        Returns:
            One unit vector per axis of the arm, in the coordinates of the user.
        """
        return [DIRECTIONS[name] for name in self.frame or FRAMES[axes]]


HandMode = Literal["tip", "joint", "force"]
HAND_MODES = get_args(HandMode)
"""Modes of a live hand: what it prescribes, see `LiveHand.mode`."""


class LiveHand(ActorBase, frozen=True, tag="live", omit_defaults=True):
    """Operator who takes hold of the arm during a live session.

    The operator is a person with a mouse or a haptic device, or a program. Nobody holds the arm
    until the operator takes hold of it. In virtual time, nobody ever does, except in a rerun of
    a log in which somebody held the arm.

    The force is computed once per tick and held until the next one. In the mode "force", the
    operator commands the force directly. The work done by such a force has a first-order error
    in the tick period, since nothing but the arm resists the force.

    Attributes:
        mode: "tip" if a spring pulls the end effector towards a target that the operator moves,
            "joint" if a spring at every joint pulls towards a target pose, or "force" if the
            operator commands a force at the end effector.
        stiffness_n_m: For "tip": stiffness along each axis, in N/m.
        damping_n_s_m: For "tip": damping along each axis, in N s/m.
        force_limit_n: For "tip" and "force": largest force, in N.
        speed_limit_m_s: For "tip": largest speed of the target, in m/s.
        stiffness_nm_rad: For "joint": stiffness for each joint, in N m/rad.
        damping_nm_s_rad: For "joint": damping for each joint, in N m s/rad.
        torque_limit_nm: For "joint": largest norm of the torques, in N m.
        speed_limit_rad_s: For "joint": largest speed of the target, in rad/s.
        acceleration_limit_m_s2: For "tip": largest acceleration of the target, in m/s^2.
        acceleration_limit_rad_s2: For "joint": largest acceleration of the target, in rad/s^2.
        device: For "tip": settings of the device (`trilat hand --device`, or a controller in
            virtual reality).
    """

    value_texts: ClassVar[Mapping[str, str]] = {
        **_AXES_TEXTS,
        "device": "a table of " + ", ".join(field_names(DeviceSettings)),
    }
    is_open: ClassVar[bool] = True
    """True if any member of the session may take hold of the arm."""

    mode: HandMode = "tip"
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
        """Validates the settings of a live operator and removes defaults of unused modes.

        Each of the modes "tip", "joint" and "force" has settings of its own. Defaults of the
        other modes are removed, since they have no effect.

        Args:
            table: Settings of the operator including defaults, modified in place.
            entry: The same settings as written by their author.
            held_arm: The arm that the operator moves.
            path: Path of the settings in the scenario, for error messages.

        Raises:
            ScenarioError: The author specified a setting of another mode, or an invalid axis
                direction.
        """
        mode = entry.get("mode", "tip")
        check_choice(mode, list(LIVE_KEYS), f"{path}.mode")
        mode_keys = LIVE_KEYS[mode]
        for key in list(table):
            if key in ("kind", "mode", *mode_keys):
                continue
            if key in entry:
                other_mode = next(name for name, keys in LIVE_KEYS.items() if key in keys)
                raise ScenarioError(
                    f"applies only to a live hand with mode {other_mode!r}; this hand has mode "
                    f"{mode!r}, which uses {', '.join(mode_keys)}",
                    path=f"{path}.{key}",
                )
            del table[key]
        device = table.get("device")
        if isinstance(device, dict) and isinstance(device.get("frame"), list):
            _check_frame(device["frame"], held_arm.counts.axes, f"{path}.device.frame")

    def make_rules(
        self, rate_hz: int, arm: ArmModel, limits: MotionLimits | None = None
    ) -> HandRules:
        """Returns the limits on what an operator may command while moving the arm.

        They bound the speed and range of the target to which the arm is pulled, and the forces.

        Args:
            rate_hz: Tick rate of the site, in Hz.
            arm: Model of the arm that the operator moves.
            limits: Motion limits of the site. None if there are no limits.
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
        """Returns the spring and limits of a live operator, for the compiled simulation.

        The target to which the arm is pulled is not included, since it changes during the run.
        """
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
    """Raises ScenarioError if the axis directions of a device are not a valid choice.

    Unknown, missing, superfluous or parallel directions are rejected.

    Args:
        frame: Names of the directions, one per axis.
        axes: Number of axes.
        path: Path of the key, for error messages.
    """
    # The absolute values are equal for opposite directions. An unknown name gives ().
    lines = {tuple(map(abs, DIRECTIONS.get(str(name), ()))) for name in frame}
    lines.discard(())
    if not len(frame) == axes == len(lines):
        expected = (
            f"one of {', '.join(DIRECTIONS)} for each of {count_nouns(axes, 'axis')}, and no "
            "two directions on the same line"
        )
        raise ScenarioError(f"must be {expected}, but is {frame}", path=path)


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
"""Mapping from mode to the keys of a live operator."""


class ViscousEnvironment(SampledActor, frozen=True, tag="viscous"):
    """Environment that resists joint motion like a viscous liquid.

    The torque on a joint is minus its damping times its speed.

    Attributes:
        damping_nm_s_rad: Damping at each joint, in N m s/rad.
    """

    group: ClassVar[str] = "environment"

    damping_nm_s_rad: fields.NotNegativeJoints

    def _source(self) -> TorqueSource:
        """Returns the joint damping in the format read by the compiled simulation."""
        return TorqueSource(
            TorqueKind.VISCOUS,
            self.start_s,
            self.end_s,
            B=self.damping_nm_s_rad,
            sampled=self.sampled,
        )


class Wall(SampledActor, frozen=True, tag="wall"):
    """Flat wall that pushes the end effector out along the wall normal and never pulls.

    The force is that of a spring and a damper, and is zero without contact.

    Attributes:
        point_m: A point on the surface, in m, one coordinate per axis.
        normal: Surface normal, pointing to the free side. Need not be normalised.
        stiffness_n_m: Stiffness, in N/m.
        damping_n_s_m: Damping, in N s/m.
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
        """Returns the wall, with a unit normal, in the format read by the simulation."""
        x, y, z = (*self.normal, 0.0)[:3]
        # `math.hypot` of three numbers, unlike that of two, is rounded differently on different
        # machines.
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

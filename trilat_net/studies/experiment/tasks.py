"""The tasks of a trial: reach, hand over, press a wall, track a path.

Invariant:
    - A task is a function of its numbers, the trial's seed, and the start of the slave's arm.
    - A task is judged by the position of the slave's end effector and the force on it, not by
      what anybody sees.
    - A trial ends by dwelling at the goal, by its time, or by a violation of the task's rules.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta

from ...core.vectors import Array
from ...fields import Frozen

Metres = Annotated[float, Meta(gt=0.0, le=10.0)]
Seconds = Annotated[float, Meta(gt=0.0, le=600.0)]


class TrialTask(Frozen, frozen=True, tag_field="kind"):
    """A task, as a protocol defines it; `make_goal` draws the goal of one trial.

    Attributes:
        description: the task in a phrase, for texts and plans.
        instructions: the template of the text for participants.
        learning_measure: the measure that decreases with practice.
        needs_wall: whether the task is judged by the force on the slave, which needs a wall.
    """

    description: ClassVar[str] = ""
    instructions: ClassVar[str] = ""
    learning_measure: ClassVar[str] = "completion_s"
    needs_wall: ClassVar[bool] = False

    def render_instructions(self, slave: str) -> str:
        """Returns the instructions for participants, for the name of the slave."""
        return self.instructions.format(slave=slave, task=self)

    @property
    def longest_s(self) -> float:
        """The longest duration of a trial after its target appears, s."""
        raise NotImplementedError

    @property
    def has_limit(self) -> bool:
        """Whether a trial fails after `longest_s`; otherwise every trial lasts that long."""
        return True

    @property
    def needs_pair(self) -> bool:
        """Whether the task needs two users."""
        return False

    def make_goal(self, start_m: Array, number: int, seed: int) -> "TrialGoal":
        """Returns the goal of a trial.

        Args:
            start_m: the position of the slave's end effector at the start, shape (2,) or (3,),
                m.
            number: the number of the target, from 0.
            seed: the seed of the trial.
        """
        raise NotImplementedError


class TrialGoal:
    """The goal of one trial.

    Attributes:
        start_m: the position of the target before it appears: the start of the slave, m.
        width_m: the diameter of the target, m.
        appears_s: when the target appears, s: the end of the fore-period.
        is_moving: whether the target moves from then on.
        force_n: the force to press with, N; 0 if the task has none.
        lead: the first user's part of the authority that two users share over the slave until a
            handover; None for the scenario's.
        handover: when the authority goes to the second user, s after the target's appearance,
            and the duration of the change, s; None without a handover.
    """

    is_moving = False
    force_n = 0.0
    lead: float | None = None
    handover: tuple[float, float] | None = None

    def __init__(self, start_m: Array, width_m: float) -> None:
        self.start_m = start_m
        self.width_m = width_m
        self.appears_s = 0.0

    def find_target_m(self, t_s: float, user: int | None = None) -> Array:
        """Returns the target position of the end effector, shape (2,) or (3,), m.

        Args:
            t_s: time since the epoch, s.
            user: the user, from 0, who is shown the target; None for the middle of all users.
        """
        if t_s < self.appears_s:
            return self.start_m
        return self._find_target_m(t_s - self.appears_s, user)

    def judge(self, t_s: float, position_m: Array, force_n: float = 0.0) -> "Outcome | None":
        """Returns how the trial has ended; None while it goes on.

        Args:
            t_s: time since the epoch, s.
            position_m: the position of the end effector, shape (2,) or (3,), m.
            force_n: the magnitude of the force on the end effector, N.
        """
        if t_s < self.appears_s:
            return None
        return self._judge(t_s, position_m, force_n)

    def has_authority(self, t_s: float, user: int) -> bool:
        """Returns whether a user, from 0, has any authority over the slave."""
        if self.lead is None:
            return True
        begins_s, ramp_s = self.handover or (math.inf, 0.0)
        # In the middle of the ramp, both users have the same authority.
        is_handed_over = t_s >= self.appears_s + begins_s + ramp_s / 2.0
        return abs(self.lead - (user != is_handed_over)) > 0.05

    def find_corridor(self, t_s: float) -> tuple[Array, float] | None:  # noqa: ARG002 - there is none
        """Returns the corridor to the target, which nobody may leave; None without a corridor.

        Args:
            t_s: time since the epoch, s.

        Returns:
            The start of the corridor, m, and its width, m.
        """
        return None

    def measure(self, after_s: Array, position_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns the measures that only this task has.

        Args:
            after_s: times since the target's appearance, shape (K,), s.
            position_m: positions of the slave's end effector, shape (K, 2) or (K, 3), m.
            force_n: magnitudes of the force on the end effector, shape (K,), N.
        """
        return {}

    def _find_target_m(self, after_s: float, user: int | None) -> Array:
        raise NotImplementedError

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> "Outcome | None":
        raise NotImplementedError


class Outcome(NamedTuple):
    """How a trial has ended.

    Attributes:
        succeeded: whether the task was done.
        ended_s: the time of the end, s since the epoch.
    """

    succeeded: bool
    ended_s: float


class ReachTrial(TrialTask, frozen=True, tag="reach"):
    """Targets on a ring about the start, each opposite the previous one (ISO 9241-411).

    Attributes:
        targets: the number of targets.
        distance_m: radius of the ring, m.
        width_m: diameter of a target, m.
        dwell_s: how long the end effector has to stay in the target, s.
        timeout_s: time after which the trial has failed, s.
        corridor_m: width of the straight corridor to the target, m, which nobody may leave, as
            with a load; None for any path.
        handover_s: time after which the second user receives the first user's authority, s;
            None without a handover.
        ramp_s: duration of the handover, s, during which the end effector stays; then the next
            target appears.
    """

    description: ClassVar[str] = "reaching to a ring of targets"
    instructions: ClassVar[str] = (
        "Bring the end effector of {slave} into the circle, "
        "and keep it there for {task.dwell_s:g} s."
    )

    targets: Annotated[int, Meta(ge=2, le=36)] = 8
    distance_m: Metres = 0.2
    width_m: Metres = 0.04
    dwell_s: Seconds = 0.3
    timeout_s: Seconds = 10.0
    corridor_m: Metres | None = None
    handover_s: Seconds | None = None
    ramp_s: Seconds = 1.0

    @property
    def needs_pair(self) -> bool:
        """Whether one user hands the slave over to the other."""
        return self.handover_s is not None

    def render_instructions(self, slave: str) -> str:
        """Returns the instructions, with the limits of the corridor and the handover."""
        text = super().render_instructions(slave)
        if self.corridor_m is not None:
            limit_mm = 500.0 * self.corridor_m
            text += f" Leave the straight way by no more than {limit_mm:g} mm."
        if self.handover_s:
            text += f" After {self.handover_s:g} s the other user takes over."
        return text

    @property
    def longest_s(self) -> float:
        """The time-out, which begins anew with the second target of a handover, s."""
        if self.handover_s is None:
            return self.timeout_s
        return self.timeout_s + (self.handover_s + self.ramp_s)

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the order is fixed
        """Returns the goal of a trial: a target of the ring, and the next target as well."""
        targets_m = [self._ring_target_m(start_m, number + n) for n in (0, 1)]
        return _ReachGoal(self, start_m, targets_m)

    def _ring_target_m(self, start_m: Array, number: int) -> Array:
        """Returns the position of a target, m; consecutive targets are opposite each other."""
        index = (number // 2 + (number % 2) * (self.targets // 2)) % self.targets
        angle = 2.0 * math.pi * index / self.targets
        direction = np.zeros(len(start_m))
        direction[:2] = math.cos(angle), math.sin(angle)
        return start_m + self.distance_m * direction


class _DwellGoal(TrialGoal):
    """A goal that is met by staying for some time where `_is_inside` returns True."""

    def __init__(self, task: "ReachTrial | ContactTrial", start_m: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._dwell_s = task.dwell_s
        self._longest_s = task.longest_s
        self._inside_since_s = math.inf

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:
        raise NotImplementedError

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:
        is_inside = self._is_inside(t_s - self.appears_s, position_m, force_n)
        self._inside_since_s = min(self._inside_since_s, t_s) if is_inside else math.inf
        if t_s - self._inside_since_s >= self._dwell_s:
            return Outcome(True, t_s)
        return Outcome(False, t_s) if t_s >= self.appears_s + self._longest_s else None


class _ReachGoal(_DwellGoal):
    """A target of the ring, and after a handover the next one.

    Without a handover, `_handover_s` and `_second_appears_s` are -1.
    """

    def __init__(self, task: ReachTrial, start_m: Array, targets_m: Sequence[Array]) -> None:
        super().__init__(task, start_m)
        self._corridor_m = task.corridor_m
        self._waypoints_m = (start_m, *targets_m)
        if task.handover_s is not None:
            self.lead = 1.0
            self.handover = (task.handover_s, task.ramp_s)
        self._handover_s, ramp_s = self.handover or (-1.0, 0.0)
        self._second_appears_s = self._handover_s + ramp_s

    def measure(self, after_s: Array, position_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns the largest distance from the target during the handover, mm."""
        is_handover = (after_s >= self._handover_s) & (after_s < self._second_appears_s)
        errors_m = np.linalg.norm(position_m - self._waypoints_m[1], axis=1)[is_handover]
        return {"error_handover_mm": 1e3 * float(errors_m.max())} if len(errors_m) else {}

    def find_corridor(self, t_s: float) -> tuple[Array, float] | None:
        """Returns the corridor from the target's appearance on, if the task has one."""
        if self._corridor_m is None or t_s < self.appears_s:
            return None
        start_m, _ = self._find_segment(t_s - self.appears_s)
        return start_m, self._corridor_m

    def _find_segment(self, after_s: float) -> Sequence[Array]:
        """Returns the start and the end of the present movement, m."""
        first = int(0.0 <= self._second_appears_s <= after_s)
        return self._waypoints_m[first : first + 2]

    def _find_target_m(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - all users are shown the same
        return self._find_segment(after_s)[1]

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:  # noqa: ARG002 - no force
        error_m = float(np.linalg.norm(position_m - self._find_target_m(after_s, None)))
        return error_m <= self.width_m / 2.0 and after_s >= self._second_appears_s

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:
        if self._corridor_m is not None:
            start_m, end_m = self._find_segment(t_s - self.appears_s)
            path_m = end_m - start_m
            # Distance from the straight segment between start and end.
            along = np.clip((position_m - start_m) @ path_m / (path_m @ path_m), 0.0, 1.0)
            distance_m = float(np.linalg.norm(position_m - start_m - along * path_m))
            if distance_m > self._corridor_m / 2.0:
                return Outcome(False, t_s)
        return super()._judge(t_s, position_m, force_n)


class ContactTrial(TrialTask, frozen=True, tag="contact"):
    """A wall that must be pressed with a force.

    Attributes:
        axis: the axis of the arm's base frame along which the target is drawn, from 0.
        distance_m: distance from the start to the target, m; negative in the other direction.
        width_m: diameter of the target, m.
        force_n: the force to press with, N.
        tolerance_n: largest error of the force, N.
        dwell_s: how long the force must be held, s.
        timeout_s: time after which the trial has failed, s.
    """

    description: ClassVar[str] = "holding a force at a wall"
    instructions: ClassVar[str] = (
        "Press {slave} against the wall with {task.force_n:g} N, "
        "and hold that for {task.dwell_s:g} s."
    )
    needs_wall: ClassVar[bool] = True

    axis: Annotated[int, Meta(ge=0, le=2)] = 0
    distance_m: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.1
    width_m: Metres = 0.04
    force_n: Annotated[float, Meta(gt=0.0, le=1000.0)] = 5.0
    tolerance_n: Annotated[float, Meta(gt=0.0, le=1000.0)] = 1.0
    dwell_s: Seconds = 1.0
    timeout_s: Seconds = 10.0

    @property
    def longest_s(self) -> float:
        """The time-out, s."""
        return self.timeout_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - there is one wall
        """Returns the goal of a trial: the position of the wall, and the force."""
        return _ContactGoal(self, start_m)


class _ContactGoal(_DwellGoal):
    def __init__(self, task: ContactTrial, start_m: Array) -> None:
        super().__init__(task, start_m)
        self.force_n = task.force_n
        self._tolerance_n = task.tolerance_n
        self._ring_target_m: Array = start_m + task.distance_m * (
            np.arange(len(start_m)) == task.axis
        )

    def _find_target_m(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - it does not move
        return self._ring_target_m

    def measure(self, after_s: Array, position_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns the mean force while it had to be held, N, and the RMS of its error, N."""
        held_n = force_n[after_s >= after_s[-1] - self._dwell_s]
        error_n = float(np.sqrt(np.mean((held_n - self.force_n) ** 2)))
        return {"wall_force_n": float(held_n.mean()), "error_force_n": error_n}

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:  # noqa: ARG002 - a force
        return abs(force_n - self.force_n) <= self._tolerance_n


class TrackTrial(TrialTask, frozen=True, tag="track"):
    """A path of sines of incommensurate frequencies along one axis, which nobody can foresee.

    Attributes:
        axis: the axis of the arm's base frame, from 0.
        amplitude_m: largest distance of the path from the start, m.
        frequencies_hz: frequencies of the sines, Hz; their phases are drawn for every trial.
        duration_s: duration of a trial, s.
        width_m: diameter of the drawn target, m.
        apart_m: distance along the axis between the targets that two users are shown, m: they
            have to agree on one.
    """

    description: ClassVar[str] = "tracking a path of sines"
    instructions: ClassVar[str] = (
        "Keep the end effector of {slave} in the circle for {task.duration_s:g} s."
    )
    learning_measure: ClassVar[str] = "error_rms_mm"

    axis: Annotated[int, Meta(ge=0, le=2)] = 0
    amplitude_m: Metres = 0.1
    frequencies_hz: tuple[float, ...] = (0.1, 0.23, 0.37)
    duration_s: Seconds = 10.0
    width_m: Metres = 0.04
    apart_m: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0

    @property
    def has_limit(self) -> bool:
        """False: every trial lasts `duration_s`."""
        return False

    @property
    def needs_pair(self) -> bool:
        """Whether the users are shown different targets."""
        return self.apart_m > 0.0

    @property
    def longest_s(self) -> float:
        """The duration of a trial, s."""
        return self.duration_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the seed draws the path
        """Returns the goal of a trial: a path that begins at the start."""
        random = np.random.default_rng(seed)
        phases = random.uniform(0.0, 2.0 * math.pi, len(self.frequencies_hz))
        return _TrackGoal(self, start_m, phases)


class _TrackGoal(TrialGoal):
    is_moving = True

    def __init__(self, task: TrackTrial, start_m: Array, phases: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._task = task
        self._phases = phases

    def measure(self, after_s: Array, position_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns whose target the slave followed: 1 the first user's, 0 the second user's."""
        if not self._task.needs_pair:
            return {}
        middle_m = np.array([self._find_target_m(after, None) for after in after_s.tolist()])
        aside_m = float((position_m - middle_m)[:, self._task.axis].mean())
        return {"first_settled": 0.5 + aside_m / self._task.apart_m}

    def _find_target_m(self, after_s: float, user: int | None) -> Array:
        angular_hz = 2.0 * math.pi * np.array(self._task.frequencies_hz)
        sines = np.sin(angular_hz * after_s + self._phases) - np.sin(self._phases)
        offset_m = 0.0 if user is None else self._task.apart_m * (0.5 - user)
        target_m = self.start_m.copy()
        target_m[self._task.axis] += offset_m + self._task.amplitude_m * float(sines.sum()) / (
            2.0 * len(sines)
        )
        return target_m

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:  # noqa: ARG002 - by its time
        return Outcome(True, t_s) if t_s >= self.appears_s + self._task.duration_s else None


AnyTask = ReachTrial | ContactTrial | TrackTrial


def place_slave(arm: Any, shared: Sequence[float]) -> Array:
    """Returns the position of an end effector, m, from the coordinates that its site shares.

    Args:
        arm: the arm of the site.
        shared: joint angles, rad, or the pose of the end effector.
    """
    position = shared[:3] if arm.shares_pose else arm.end_effector(shared)
    return np.array(position, dtype=np.float64)

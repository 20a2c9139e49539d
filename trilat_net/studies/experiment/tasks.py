"""What participants do in a trial: reach, carry, hand over, follow a path, agree on one, press
a wall.

Invariant: a task is a function of its numbers, the trial's seed and where the slave's arm
began. It is judged by where the slave's end effector is and what presses on it, not by what
anybody sees; a trial ends by dwelling, by its time, or when something went wrong that the task
forbids.
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
    """A task, as a protocol has it; `begin` draws what is asked of one trial."""

    words: ClassVar[str] = ""
    asks: ClassVar[str] = ""
    learnt: ClassVar[str] = "completion_s"
    """The measure that becomes less with practice."""
    presses: ClassVar[bool] = False
    """Whether it is judged by the force at the slave, which needs a wall there."""

    def ask(self, slave: str) -> str:
        """Returns what users are asked for, as their pages say it."""
        return self.asks.format(slave=slave, task=self)

    @property
    def longest_s(self) -> float:
        """When a trial ends at the latest, s after its target appears."""
        raise NotImplementedError

    @property
    def has_limit(self) -> bool:
        """Whether a trial that is not completed by `longest_s` has failed; else each lasts as
        long.
        """
        return True

    @property
    def needs_pair(self) -> bool:
        """Whether it is of two users."""
        return False

    def begin(self, start_m: Array, number: int, seed: int) -> "TrialGoal":
        """Returns what is asked in a trial, by the number of its target from 0.

        Args:
            start_m: where the slave's end effector is.
            number: of the target.
            seed: of the trial.
        """
        raise NotImplementedError


class TrialGoal:
    """What is asked of one trial.

    Attributes:
        start_m: where the target is before it appears elsewhere: at the slave's start.
        width_m: how wide it is, across.
        appears_s: when it appears, s: the end of the fore-period.
        moves: whether it moves from then on.
        force_n: the force to press with, N; 0: none.
        lead: the first user's part of what two users share at the slave until a handover; None:
            as written.
        handover: when it goes to the second, s after the target, and how long that takes; None:
            never.
    """

    moves = False
    force_n = 0.0
    lead: float | None = None
    handover: tuple[float, float] | None = None

    def __init__(self, start_m: Array, width_m: float) -> None:
        self.start_m = start_m
        self.width_m = width_m
        self.appears_s = 0.0

    def place(self, t_s: float, user: int | None = None) -> Array:
        """Returns where the end effector is to be, m, shape (2,) or (3,), as a user, from 0, is
        shown it.
        """
        return self.start_m if t_s < self.appears_s else self._place(t_s - self.appears_s, user)

    def judge(self, t_s: float, at_m: Array, force_n: float = 0.0) -> "Outcome | None":
        """Returns how the trial ended, with the end effector at a place, under a force; None:
        it goes on.
        """
        return None if t_s < self.appears_s else self._judge(t_s, at_m, force_n)

    def leads(self, t_s: float, user: int) -> bool:
        """Returns whether a user, from 0, has any authority over the slave."""
        begins_s, ramp_s = self.handover or (math.inf, 0.0)
        handed = t_s >= self.appears_s + begins_s + ramp_s / 2.0
        return self.lead is None or abs(self.lead - (user != handed)) > 0.05

    def find_corridor(self, t_s: float) -> tuple[Array, float] | None:  # noqa: ARG002 - there is none
        """Returns from where the way to the target leads that nobody may leave, m, and its
        width, m.
        """
        return None

    def measure(self, after_s: Array, at_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns what is measured of this task alone, of K rows from when the target appears
        to the end.

        `at_m`, shape (K, 2) or (K, 3), is where the slave's end effector is, `force_n` what
        presses on it.
        """
        return {}

    def _place(self, after_s: float, user: int | None) -> Array:
        raise NotImplementedError

    def _judge(self, t_s: float, at_m: Array, force_n: float) -> "Outcome | None":
        raise NotImplementedError


class Outcome(NamedTuple):
    """How a trial ended.

    Attributes:
        succeeded: whether the task was done.
        ended_s: when, s.
    """

    succeeded: bool
    ended_s: float


class ReachTrial(TrialTask, frozen=True, tag="reach"):
    """Targets on a ring about the start, in the order of ISO 9241-411: each across from the one
    before.

    Attributes:
        targets: how many.
        distance_m: radius of the ring, m.
        width_m: diameter of a target, m.
        dwell_s: how long the end effector has to stay in it, s.
        timeout_s: after which the trial has failed, s.
        corridor_m: width of the straight way to it, m, which nobody may leave, as with a load;
            None: any way.
        handover_s: after which the second user gets the first one's authority, s; None: it
            stays as it is.
        ramp_s: how long that takes, s, in which the end effector stays; then the next target
            appears.
    """

    words: ClassVar[str] = "reaching to a ring of targets"
    asks: ClassVar[str] = (
        "Bring the end effector of {slave} into the circle, and keep it there for {task.dwell_s:g} s."
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
        """Whether one hands over to the other."""
        return self.handover_s is not None

    def ask(self, slave: str) -> str:
        """Returns what users are asked for, with what is forbidden and what comes next."""
        aside_mm = 0.0 if self.corridor_m is None else 500.0 * self.corridor_m
        way = f" Leave the straight way by no more than {aside_mm:g} mm." if aside_mm else ""
        then = (
            f" After {self.handover_s:g} s the other user takes over."
            if self.handover_s
            else ""
        )
        return super().ask(slave) + way + then

    @property
    def longest_s(self) -> float:
        """The time-out, from the last target on, s."""
        return self.timeout_s + (
            0.0 if self.handover_s is None else self.handover_s + self.ramp_s
        )

    def begin(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the order is fixed
        """Returns the next target around the ring, and after a handover the one after it."""
        return _ReachGoal(self, start_m, [self._target_m(start_m, number + n) for n in (0, 1)])

    def _target_m(self, start_m: Array, number: int) -> Array:
        place = (number // 2 + (number % 2) * (self.targets // 2)) % self.targets
        angle = 2.0 * math.pi * place / self.targets
        way = np.zeros(len(start_m))
        way[:2] = math.cos(angle), math.sin(angle)
        return start_m + self.distance_m * way


class _DwellGoal(TrialGoal):
    """A goal that is met by staying where `_is_met` says."""

    def __init__(self, task: "ReachTrial | ContactTrial", start_m: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._dwell_s = task.dwell_s
        self._longest_s = task.longest_s
        self._met_s = math.inf

    def _is_met(self, after_s: float, at_m: Array, force_n: float) -> bool:
        raise NotImplementedError

    def _judge(self, t_s: float, at_m: Array, force_n: float) -> Outcome | None:
        met = self._is_met(t_s - self.appears_s, at_m, force_n)
        self._met_s = min(self._met_s, t_s) if met else math.inf
        if t_s - self._met_s >= self._dwell_s:
            return Outcome(True, t_s)
        return Outcome(False, t_s) if t_s >= self.appears_s + self._longest_s else None


class _ReachGoal(_DwellGoal):
    def __init__(self, task: ReachTrial, start_m: Array, targets_m: Sequence[Array]) -> None:
        super().__init__(task, start_m)
        self._corridor_m = task.corridor_m
        self._places = (start_m, *targets_m)
        if task.handover_s is not None:
            self.lead = 1.0
            self.handover = (task.handover_s, task.ramp_s)
        self._ramp_s, ramp_s = self.handover or (-1.0, 0.0)
        self._next_s = self._ramp_s + ramp_s

    def measure(self, after_s: Array, at_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns how far the end effector was from the target at the most during the handover."""
        off_m = np.linalg.norm(at_m - self._places[1], axis=1)[
            (after_s >= self._ramp_s) & (after_s < self._next_s)
        ]
        return {"error_handover_mm": 1e3 * float(off_m.max())} if len(off_m) else {}

    def find_corridor(self, t_s: float) -> tuple[Array, float] | None:
        """Returns the corridor from when the target appears on, if there is one."""
        if self._corridor_m is None or t_s < self.appears_s:
            return None
        return self._leg(t_s - self.appears_s)[0], self._corridor_m

    def _leg(self, after_s: float) -> Sequence[Array]:
        """Returns from where to where the way leads."""
        first = int(0.0 <= self._next_s <= after_s)
        return self._places[first : first + 2]

    def _place(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - all are shown the same
        return self._leg(after_s)[1]

    def _is_met(self, after_s: float, at_m: Array, force_n: float) -> bool:  # noqa: ARG002 - a place
        inside = float(np.linalg.norm(at_m - self._place(after_s, None))) <= self.width_m / 2.0
        return inside and after_s >= self._next_s

    def _judge(self, t_s: float, at_m: Array, force_n: float) -> Outcome | None:
        if self._corridor_m is not None:
            left, to = self._leg(t_s - self.appears_s)
            along = np.clip((at_m - left) @ (to - left) / ((to - left) @ (to - left)), 0.0, 1.0)
            if (
                float(np.linalg.norm(at_m - left - along * (to - left)))
                > self._corridor_m / 2.0
            ):
                return Outcome(False, t_s)
        return super()._judge(t_s, at_m, force_n)


class ContactTrial(TrialTask, frozen=True, tag="contact"):
    """A wall, to be pressed with a force.

    Attributes:
        axis: along which axis of the arm's base frame it is, from 0.
        distance_m: from the start to where the target is drawn, m; below 0: the other way.
        width_m: diameter of the target, m.
        force_n: what to press with, N.
        tolerance_n: by how much the force may be missed, N.
        dwell_s: how long it is to be held, s.
        timeout_s: after which the trial has failed, s.
    """

    words: ClassVar[str] = "holding a force at a wall"
    asks: ClassVar[str] = (
        "Press {slave} against the wall with {task.force_n:g} N, and hold that for {task.dwell_s:g} s."
    )
    presses: ClassVar[bool] = True

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

    def begin(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - there is one wall
        """Returns the wall's place and the force."""
        return _ContactGoal(self, start_m)


class _ContactGoal(_DwellGoal):
    def __init__(self, task: ContactTrial, start_m: Array) -> None:
        super().__init__(task, start_m)
        self.force_n = task.force_n
        self._tolerance_n = task.tolerance_n
        self._target_m: Array = start_m + task.distance_m * (
            np.arange(len(start_m)) == task.axis
        )

    def _place(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - it does not move
        return self._target_m

    def measure(self, after_s: Array, at_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns the force while it was to be held, and how far it was from what was asked, by
        its RMS.
        """
        held_n = force_n[after_s >= after_s[-1] - self._dwell_s]
        off_n = float(np.sqrt(np.mean((held_n - self.force_n) ** 2)))
        return {"wall_force_n": float(held_n.mean()), "error_force_n": off_n}

    def _is_met(self, after_s: float, at_m: Array, force_n: float) -> bool:  # noqa: ARG002 - a force
        return abs(force_n - self.force_n) <= self._tolerance_n


class TrackTrial(TrialTask, frozen=True, tag="track"):
    """A path of sines of unlike frequencies along one axis, which nobody can foresee.

    Attributes:
        axis: along which axis of the arm's base frame, from 0.
        amplitude_m: how far it gets from the start at the most, m.
        frequencies_hz: of the sines, Hz; their phases are drawn for every trial.
        duration_s: how long it lasts, s.
        width_m: how wide the target is drawn, m.
        apart_m: how far apart two users are shown it, along that axis, m: they have to settle
            on one.
    """

    words: ClassVar[str] = "tracking a path of sines"
    asks: ClassVar[str] = (
        "Keep the end effector of {slave} in the circle for {task.duration_s:g} s."
    )
    learnt: ClassVar[str] = "error_rms_mm"

    axis: Annotated[int, Meta(ge=0, le=2)] = 0
    amplitude_m: Metres = 0.1
    frequencies_hz: tuple[float, ...] = (0.1, 0.23, 0.37)
    duration_s: Seconds = 10.0
    width_m: Metres = 0.04
    apart_m: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0

    @property
    def has_limit(self) -> bool:
        """False: tracking has no end but its own."""
        return False

    @property
    def needs_pair(self) -> bool:
        """Whether users are shown different targets."""
        return self.apart_m > 0.0

    @property
    def longest_s(self) -> float:
        """Its duration, s."""
        return self.duration_s

    def begin(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - phases are of the seed
        """Returns the path, which begins at the start."""
        phases = np.random.default_rng(seed).uniform(
            0.0, 2.0 * math.pi, len(self.frequencies_hz)
        )
        return _TrackGoal(self, start_m, phases)


class _TrackGoal(TrialGoal):
    moves = True

    def __init__(self, task: TrackTrial, start_m: Array, phases: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._task = task
        self._phases = phases

    def measure(self, after_s: Array, at_m: Array, force_n: Array) -> dict[str, float]:  # noqa: ARG002
        """Returns whose target the slave was at where two are shown: 1 the first user's, 0 the
        other's.
        """
        if not self._task.needs_pair:
            return {}
        middle_m = np.array([self._place(after, None) for after in after_s.tolist()])
        aside_m = float((at_m - middle_m)[:, self._task.axis].mean())
        return {"first_settled": 0.5 + aside_m / self._task.apart_m}

    def _place(self, after_s: float, user: int | None) -> Array:
        turns = 2.0 * math.pi * np.array(self._task.frequencies_hz)
        off = np.sin(turns * after_s + self._phases) - np.sin(self._phases)
        at = self.start_m.copy()
        aside_m = 0.0 if user is None else self._task.apart_m * (0.5 - user)
        at[self._task.axis] += aside_m + self._task.amplitude_m * float(off.sum()) / (
            2.0 * len(off)
        )
        return at

    def _judge(self, t_s: float, at_m: Array, force_n: float) -> Outcome | None:  # noqa: ARG002 - by its time
        return Outcome(True, t_s) if t_s >= self.appears_s + self._task.duration_s else None


AnyTask = ReachTrial | ContactTrial | TrackTrial


def place_slave(arm: Any, shared: Sequence[float]) -> Array:
    """Returns where an end effector is, m, by what its site shares: joint angles, rad, or its
    pose.
    """
    place = shared[:3] if arm.shares_pose else arm.end_effector(shared)
    return np.array(place, dtype=np.float64)

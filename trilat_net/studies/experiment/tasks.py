"""What a participant does in a trial: reach a place, or follow a path that nobody can foresee.

Invariant: a task is a function of its numbers, the trial's seed and where the slave's arm began. It is judged
by where the slave's end effector is, not by where anybody sees it; a trial ends by dwelling, or by its time.
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

    @property
    def longest_s(self) -> float:
        """When a trial ends at the latest, s."""
        raise NotImplementedError

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
    """

    moves = False

    def __init__(self, start_m: Array, width_m: float) -> None:
        self.start_m, self.width_m, self.appears_s = start_m, width_m, 0.0

    def place(self, t_s: float) -> Array:
        """Returns where the slave's end effector is to be, m, shape (2,) or (3,)."""
        return self.start_m if t_s < self.appears_s else self._place(t_s - self.appears_s)

    def judge(self, t_s: float, at_m: Array) -> "Outcome | None":
        """Returns how the trial ended, with the end effector at a place; None: it goes on."""
        return None if t_s < self.appears_s else self._judge(t_s, at_m)

    def _place(self, after_s: float) -> Array:
        raise NotImplementedError

    def _judge(self, t_s: float, at_m: Array) -> "Outcome | None":
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
    """Targets on a ring about the start, in the order of ISO 9241-411: each across from the one before.

    Attributes:
        targets: how many.
        distance_m: radius of the ring, m.
        width_m: diameter of a target, m.
        dwell_s: how long the end effector has to stay in it, s.
        timeout_s: after which the trial has failed, s.
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

    @property
    def longest_s(self) -> float:
        """The time-out, s."""
        return self.timeout_s

    def begin(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the order is fixed
        """Returns the next target around the ring."""
        place = (number // 2 + (number % 2) * (self.targets // 2)) % self.targets
        angle = 2.0 * math.pi * place / self.targets
        way = np.zeros(len(start_m))
        way[:2] = math.cos(angle), math.sin(angle)
        return _ReachGoal(self, start_m, start_m + self.distance_m * way)


class _ReachGoal(TrialGoal):
    def __init__(self, task: ReachTrial, start_m: Array, target_m: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._task, self._target_m, self._inside_s = task, target_m, math.inf

    def _place(self, after_s: float) -> Array:  # noqa: ARG002 - it does not move
        return self._target_m

    def _judge(self, t_s: float, at_m: Array) -> Outcome | None:
        inside = float(np.linalg.norm(at_m - self._target_m)) <= self._task.width_m / 2.0
        self._inside_s = min(self._inside_s, t_s) if inside else math.inf
        if t_s - self._inside_s >= self._task.dwell_s:
            return Outcome(True, t_s)
        return Outcome(False, t_s) if t_s >= self.appears_s + self._task.timeout_s else None


class TrackTrial(TrialTask, frozen=True, tag="track"):
    """A path of sines of unlike frequencies along one axis, which nobody can foresee.

    Attributes:
        axis: along which axis of the arm's base frame, from 0.
        amplitude_m: how far it gets from the start at the most, m.
        frequencies_hz: of the sines, Hz; their phases are drawn for every trial.
        duration_s: how long it lasts, s.
        width_m: how wide the target is drawn, m.
    """

    words: ClassVar[str] = "tracking a path of sines"
    asks: ClassVar[str] = "Keep the end effector of {slave} in the circle for {task.duration_s:g} s."

    axis: Annotated[int, Meta(ge=0, le=2)] = 0
    amplitude_m: Metres = 0.1
    frequencies_hz: tuple[float, ...] = (0.1, 0.23, 0.37)
    duration_s: Seconds = 10.0
    width_m: Metres = 0.04

    @property
    def longest_s(self) -> float:
        """Its duration, s."""
        return self.duration_s

    def begin(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - phases are of the seed
        """Returns the path, which begins at the start."""
        phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, len(self.frequencies_hz))
        return _TrackGoal(self, start_m, phases)


class _TrackGoal(TrialGoal):
    moves = True

    def __init__(self, task: TrackTrial, start_m: Array, phases: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._task, self._phases = task, phases

    def _place(self, after_s: float) -> Array:
        turns = 2.0 * math.pi * np.array(self._task.frequencies_hz)
        off = np.sin(turns * after_s + self._phases) - np.sin(self._phases)
        at = self.start_m.copy()
        at[self._task.axis] += self._task.amplitude_m * float(off.sum()) / (2.0 * len(off))
        return at

    def _judge(self, t_s: float, at_m: Array) -> Outcome | None:  # noqa: ARG002 - it ends by its time
        return Outcome(True, t_s) if t_s >= self.appears_s + self._task.duration_s else None


AnyTask = ReachTrial | TrackTrial


def place_slave(arm: Any, shared: Sequence[float]) -> Array:
    """Returns where an end effector is, m, by what its site shares: joint angles, rad, or its pose."""
    place = shared[:3] if arm.shares_pose else arm.end_effector(shared)
    return np.array(place, dtype=np.float64)

"""Tasks of an experiment: reach a target, hand over, press a wall, follow a moving target.

A protocol defines a `_TrialTask` with its parameters, such as the distance of the targets. For
each trial, the task creates a `TrialGoal`, which computes the position of the target at any
time and judges the result of the trial. The participants move the slave arm over the network
with their master arms.

Invariant:
    - The goal of a trial depends only on the parameters of the task, the seed of the trial and
      the start position of the slave arm.
    - A trial is judged by the position of the slave's end effector and the force on it, not by
      the delayed pictures that the users see.
    - A trial ends when the end effector has stayed at the goal, when the time is up, or when a
      rule of the task is broken.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta

from trilat_net.core import Array
from trilat_net.fields import Frozen

Metres = Annotated[float, Meta(gt=0.0, le=10.0)]
Seconds = Annotated[float, Meta(gt=0.0, le=600.0)]


class _TrialTask(Frozen, frozen=True, tag_field="kind"):
    """A task for the participants, as defined in a protocol: reach, press or follow.

    The task is the same for all trials. `make_goal` creates the goal of a single trial.

    Attributes:
        description: Short phrase for the task, used in reports and plans.
        instructions: Template of the instructions for participants.
        learning_measure: Name of the measure that decreases with practice.
        needs_wall: True if the task is judged by the force on the slave, which requires a wall.
    """

    description: ClassVar[str] = ""
    instructions: ClassVar[str] = ""
    learning_measure: ClassVar[str] = "completion_s"
    needs_wall: ClassVar[bool] = False

    def render_instructions(self, slave: str) -> str:
        """Returns the instructions shown to participants for this task.

        Args:
            slave: Name of the slave arm to use in the instructions.
        """
        return self.instructions.format(slave=slave, task=self)

    @property
    def longest_s(self) -> float:
        """Longest duration of a trial after its target has appeared, in s.

        If the task has a time limit (`has_limit`), a trial that has not succeeded within this
        time fails. Otherwise, every trial lasts exactly this long.
        """
        raise NotImplementedError

    @property
    def has_limit(self) -> bool:
        """True if a trial fails unless it is completed within `longest_s` seconds.

        False if every trial lasts exactly `longest_s` seconds, as when following a moving
        target.
        """
        return True

    @property
    def needs_pair(self) -> bool:
        """True if two participants perform the task together.

        The protocol of the experiment must then name two master arms.
        """
        return False

    def make_goal(self, start_m: Array, number: int, seed: int) -> "TrialGoal":
        """Creates the goal of one trial: its target, and the rule for ending the trial.

        Args:
            start_m: Start position of the slave's end effector, in m, shape (2,) or (3,).
            number: Index of the target, starting at 0.
            seed: Random seed of the trial.
        """
        raise NotImplementedError


class TrialGoal:
    """Target of one trial, and the rule that determines when the trial ends.

    Args:
        start_m: Start position of the slave's end effector, in m.
        width_m: Diameter of the target, in m.

    Attributes:
        start_m: Start position of the slave's end effector, in m, which is used as the target
            position until the target appears.
        width_m: Diameter of the target, in m.
        appears_s: Time at which the target appears, in s. Users must wait for it.
        is_moving: True if the target moves after appearing.
        force_n: Force to apply, in N, or 0 if the task does not require a force.
        lead: First user's share of the two users' combined authority over the slave, until a
            handover. If `None`, the scenario's dominance factors apply.
        handover: Time from the appearance of the target until authority passes to the second
            user, and duration of the transition, both in s. `None` if there is no handover.
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
        """Returns the target position of the end effector at a given time, in m.

        Args:
            t_s: Time since the start of the session, in s.
            user: Index of the user whose target is returned, starting at 0. If `None`, the
                midpoint of all users' targets is returned.

        Returns:
            The position, shape (2,) or (3,).
        """
        if t_s < self.appears_s:
            return self.start_m
        return self._find_target_m(t_s - self.appears_s, user)

    def judge(self, t_s: float, position_m: Array, force_n: float = 0.0) -> "Outcome | None":
        """Decides whether the trial ends now.

        Before the target appears, the trial always continues.

        Args:
            t_s: Time since the start of the session, in s.
            position_m: Position of the end effector, in m, shape (2,) or (3,).
            force_n: Magnitude of the force on the end effector, in N.

        Returns:
            The outcome of the trial, or `None` while the trial continues.
        """
        if t_s < self.appears_s:
            return None
        return self._judge(t_s, position_m, force_n)

    def has_authority(self, t_s: float, user: int) -> bool:
        """Returns True if the slave follows the given user at the given time.

        In a handover, authority over the slave passes from the first user to the second.

        Args:
            t_s: Time since the start of the session, in s.
            user: Index of the user, starting at 0.
        """
        if self.lead is None:
            return True
        begins_s, ramp_s = self.handover or (math.inf, 0.0)
        # In the middle of the ramp, both users have the same authority.
        handed_over_s = self.appears_s + begins_s + ramp_s / 2.0
        leading_user = 1 if t_s >= handed_over_s else 0
        user_lead = self.lead if user == leading_user else 1.0 - self.lead
        return abs(user_lead) > 0.05

    def find_corridor(self, t_s: float) -> tuple[Array, float] | None:  # noqa: ARG002 - there is none
        """Returns the corridor that the end effector must not leave.

        The corridor is straight and ends at the target.

        Args:
            t_s: Time since the start of the session, in s.

        Returns:
            The start and width of the corridor, both in m, or `None` if there is no corridor.
        """
        return None

    def compute_measures(
        self,
        after_s: Array,  # noqa: ARG002
        position_m: Array,  # noqa: ARG002
        force_n: Array,  # noqa: ARG002
    ) -> dict[str, float]:
        """Computes the measures specific to this task, such as the mean force against a wall.

        Args:
            after_s: Times since the appearance of the target, in s, shape (K,).
            position_m: Positions of the slave's end effector, in m, shape (K, 2) or (K, 3).
            force_n: Magnitudes of the force on the end effector, in N, shape (K,).

        Returns:
            Mapping from the name of each measure to its value. Empty if the task has no
            measures of its own.
        """
        return {}

    def _find_target_m(self, after_s: float, user: int | None) -> Array:
        """Returns the target position after the target has appeared. Implemented by each task.

        Args:
            after_s: Time since the appearance of the target, in s.
            user: Index of the user, or `None` (see `find_target_m`).

        Returns:
            The position, in m, shape (2,) or (3,).
        """
        raise NotImplementedError

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> "Outcome | None":
        """Decides in each control period whether the trial succeeds, fails or continues.

        Implemented by each task, and called after the target has appeared. See `judge` for the
        arguments and the result.
        """
        raise NotImplementedError


class Outcome(NamedTuple):
    """Result of a trial that has ended.

    Attributes:
        succeeded: True if the task was completed. False if the time limit was reached or a rule
            was broken.
        ended_s: Time at which the trial ended, in s since the start of the session.
    """

    succeeded: bool
    ended_s: float


class ReachTrial(_TrialTask, frozen=True, tag="reach"):
    """Task: move the arm to targets on a ring, as in ISO 9241-411.

    Each target is nearly opposite the previous one.

    Attributes:
        targets: Number of targets.
        distance_m: Radius of the ring around the start, in m.
        width_m: Diameter of a target, in m.
        dwell_s: Time that the end effector must stay in the target, in s.
        timeout_s: Time limit of a trial, in s.
        corridor_m: Width of the straight corridor to the target, which the users must not
            leave, in m. `None` if the users may take any path.
        handover_s: Time after which authority passes from the first user to the second, in s.
            `None` if there is no handover.
        ramp_s: Duration of the handover, in s. The end effector must stay in the target during
            the handover, after which the next target appears.
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
        """True if the task includes a handover, which requires two participants.

        The first participant hands control of the slave arm over to the second during the
        trial.
        """
        return self.handover_s is not None

    def render_instructions(self, slave: str) -> str:
        """Returns the instructions shown to participants for a reaching trial.

        If the task has a corridor, the instructions state how far the arm may deviate from the
        straight path to the target. If it has a handover, they state when the other user takes
        over.

        Args:
            slave: Name of the slave arm to use in the instructions.
        """
        text = super().render_instructions(slave)
        if self.corridor_m is not None:
            limit_mm = 500.0 * self.corridor_m
            text += f" Leave the straight way by no more than {limit_mm:g} mm."
        if self.handover_s:
            text += f" After {self.handover_s:g} s the other user takes over."
        return text

    @property
    def longest_s(self) -> float:
        """Longest possible duration of a reaching trial after its target has appeared, in s.

        Usually `timeout_s`. With a handover, a second target appears afterwards and the time
        limit starts again.
        """
        if self.handover_s is None:
            return self.timeout_s
        second_appears_s = self.handover_s + self.ramp_s
        return self.timeout_s + second_appears_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the order is fixed
        """Creates the goal of a reaching trial: a target on a ring around the start position.

        Includes the next target on the ring, which appears after a handover.

        Args:
            start_m: Start position of the slave's end effector, the centre of the ring, in m.
            number: Index of the target, starting at 0.
            seed: Not used, since the order of the targets is fixed.
        """
        target_m = self._place_target_m(start_m, number)
        next_target_m = self._place_target_m(start_m, number + 1)
        return _ReachGoal(self, start_m, [target_m, next_target_m])

    def _place_target_m(self, start_m: Array, number: int) -> Array:
        """Returns the position of a target on the ring around the start, in m.

        Consecutive targets are nearly opposite, so that each movement crosses the ring (ISO
        9241-411). The ring lies in the plane of the first two axes. With 8 targets, the order
        around the ring is 0, 4, 1, 5, 2, 6, 3, 7.

        Args:
            start_m: Centre of the ring, in m.
            number: Index of the target, starting at 0. Indices beyond the last target wrap
                around to the first.
        """
        # Targets with even numbers advance around the ring. Those with odd numbers are half a
        # ring further.
        half_ring = self.targets // 2
        step = number // 2
        if number % 2:
            step += half_ring
        index = step % self.targets

        angle = 2.0 * math.pi * index / self.targets
        direction = np.zeros(len(start_m))
        direction[0] = math.cos(angle)
        direction[1] = math.sin(angle)
        return start_m + self.distance_m * direction


class _DwellGoal(TrialGoal):
    """A goal that is reached once a condition has held for some time without interruption.

    Merely passing through the target is not enough. Subclasses define the condition in
    `_is_inside`, for example that the end effector is in the target.
    """

    def __init__(self, task: "ReachTrial | ContactTrial", start_m: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._dwell_s = task.dwell_s
        self._longest_s = task.longest_s
        # Time since which the condition has been met; infinite while it is not met.
        self._inside_since_s = math.inf

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:
        """Returns True if the condition that must be held is currently satisfied.

        Args:
            after_s: Time since the appearance of the target, in s.
            position_m: Position of the slave's end effector, in m.
            force_n: Magnitude of the force on the end effector, in N.
        """
        raise NotImplementedError

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:
        """Ends the trial as succeeded after the dwell time, or as failed after the time limit.

        The dwell time is how long the condition must be held without interruption. It restarts
        whenever the condition is violated, for example when the end effector leaves the target.
        """
        after_s = t_s - self.appears_s
        if self._is_inside(after_s, position_m, force_n):
            self._inside_since_s = min(self._inside_since_s, t_s)
        else:
            self._inside_since_s = math.inf

        inside_s = t_s - self._inside_since_s
        if inside_s >= self._dwell_s:
            return Outcome(True, t_s)

        latest_end_s = self.appears_s + self._longest_s
        if t_s >= latest_end_s:
            return Outcome(False, t_s)
        return None


class _ReachGoal(_DwellGoal):
    """Goal of a `ReachTrial`: to bring the end effector to a target and stay there.

    In a handover, there is a second target for the user who receives the slave. If there is no
    handover, `_handover_s` and `_second_appears_s` are -1.
    """

    def __init__(self, task: ReachTrial, start_m: Array, targets_m: Sequence[Array]) -> None:
        super().__init__(task, start_m)
        self._corridor_m = task.corridor_m
        self._waypoints_m = (start_m, *targets_m)
        if task.handover_s is not None:
            self.lead = 1.0
            self.handover = (task.handover_s, task.ramp_s)
        handover_s, ramp_s = self.handover or (-1.0, 0.0)
        self._handover_s = handover_s
        self._second_appears_s = handover_s + ramp_s

    def compute_measures(
        self,
        after_s: Array,
        position_m: Array,
        force_n: Array,  # noqa: ARG002
    ) -> dict[str, float]:
        """Computes how steadily the end effector stayed at the target during the handover.

        The measure is the largest distance from the target during the handover, in mm.

        Returns:
            Mapping from the name of the measure to its value. Empty if there was no handover.
        """
        has_begun = after_s >= self._handover_s
        has_not_ended = after_s < self._second_appears_s
        is_handover = has_begun & has_not_ended

        target_m = self._waypoints_m[1]
        distances_m = np.linalg.norm(position_m - target_m, axis=1)
        errors_m = distances_m[is_handover]
        if not len(errors_m):
            return {}

        largest_error_m = float(errors_m.max())
        return {"error_handover_mm": 1e3 * largest_error_m}

    def find_corridor(self, t_s: float) -> tuple[Array, float] | None:
        """Returns the straight corridor to the target, which participants must not leave.

        The corridor is drawn on the page once the target has appeared.

        Returns:
            The start and width of the corridor, both in m. `None` before the target appears,
            and for tasks with no corridor.
        """
        if self._corridor_m is None or t_s < self.appears_s:
            return None
        after_s = t_s - self.appears_s
        start_m, _ = self._find_segment(after_s)
        return start_m, self._corridor_m

    def _find_segment(self, after_s: float) -> Sequence[Array]:
        """Returns the start and end of the current movement, in m.

        Usually, the movement goes from the start position to the target. After a handover
        between two users, it goes from the first to the second target.

        Args:
            after_s: Time since the appearance of the first target, in s.
        """
        has_second_appeared = 0.0 <= self._second_appears_s <= after_s
        if has_second_appeared:
            return self._waypoints_m[1:]
        return self._waypoints_m[:2]

    def _find_target_m(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - all users see the same
        """Returns the end of the current movement, which is the same for all users, in m."""
        _, end_m = self._find_segment(after_s)
        return end_m

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:  # noqa: ARG002 - no force
        """Returns True if the end effector is in the target at which the trial can succeed.

        In a handover, this is the second target: until it has appeared, the result is False
        even in the first target.
        """
        target_m = self._find_target_m(after_s, None)
        error_m = float(np.linalg.norm(position_m - target_m))
        is_in_target = error_m <= self.width_m / 2.0
        # Before the second target appears, the trial cannot succeed.
        return is_in_target and after_s >= self._second_appears_s

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:
        """Ends the trial as failed if the end effector has left the corridor to the target.

        Otherwise, and in tasks with no corridor, the rule of `_DwellGoal` applies: the end
        effector must stay in the target for some time.
        """
        if self._corridor_m is not None:
            after_s = t_s - self.appears_s
            start_m, end_m = self._find_segment(after_s)
            path_m = end_m - start_m
            offset_m = position_m - start_m
            squared_length = path_m @ path_m
            # The nearest point of the straight segment is at this fraction of its length.
            progress = np.clip(offset_m @ path_m / squared_length, 0.0, 1.0)
            nearest_m = progress * path_m
            distance_m = float(np.linalg.norm(offset_m - nearest_m))
            if distance_m > self._corridor_m / 2.0:
                return Outcome(False, t_s)
        return super()._judge(t_s, position_m, force_n)


class ContactTrial(_TrialTask, frozen=True, tag="contact"):
    """Task: press against a wall with a given force, and hold this force for some time.

    Attributes:
        axis: Index of the axis of the arm's base frame along which the target is placed,
            starting at 0.
        distance_m: Distance from the start to the target, in m. Negative for the opposite
            direction.
        width_m: Diameter of the target, in m.
        force_n: Force to apply, in N.
        tolerance_n: Largest permitted force error, in N.
        dwell_s: Time that the force must be held, in s.
        timeout_s: Time limit of a trial, in s.
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
        """Time limit of a trial, in s.

        A trial fails if the force has not been held for `dwell_s` within this time.
        """
        return self.timeout_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - there is one wall
        """Creates the goal of a trial: where to touch the wall, and how hard to press.

        Args:
            start_m: Start position of the slave's end effector, in m.
            number: Not used, since there is only one wall.
            seed: Not used.
        """
        return _ContactGoal(self, start_m)


class _ContactGoal(_DwellGoal):
    """Goal of a `ContactTrial`: to press against a wall with a given force.

    Only the force is judged, not the position.
    """

    def __init__(self, task: ContactTrial, start_m: Array) -> None:
        super().__init__(task, start_m)
        self.force_n = task.force_n
        self._tolerance_n = task.tolerance_n
        direction = np.arange(len(start_m)) == task.axis
        self._target_m: Array = start_m + task.distance_m * direction

    def _find_target_m(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - it does not move
        """Returns the fixed point on the wall that participants see as the target, in m."""
        return self._target_m

    def compute_measures(
        self,
        after_s: Array,
        position_m: Array,  # noqa: ARG002
        force_n: Array,
    ) -> dict[str, float]:
        """Computes how accurately the force was held at the end of the trial.

        The measures are the mean force and the RMS force error, both in N, over the period in
        which the force had to be held.

        Returns:
            Mapping from the name of each measure to its value.
        """
        dwell_start_s = after_s[-1] - self._dwell_s
        is_dwell = after_s >= dwell_start_s
        dwell_forces_n = force_n[is_dwell]
        errors_n = dwell_forces_n - self.force_n
        mean_square = np.mean(errors_n**2)
        return {
            "wall_force_n": float(dwell_forces_n.mean()),
            "error_force_n": float(np.sqrt(mean_square)),
        }

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:  # noqa: ARG002 - only the force counts
        """Returns True if the force is within the tolerance of the required force."""
        error_n = abs(force_n - self.force_n)
        return error_n <= self._tolerance_n


class TrackTrial(_TrialTask, frozen=True, tag="track"):
    """Task: follow a target that moves unpredictably along one axis.

    The path is a sum of sines with incommensurate frequencies.

    Attributes:
        axis: Index of the axis of the arm's base frame, starting at 0.
        amplitude_m: Largest distance from the start, in m.
        frequencies_hz: Frequencies of the sines, in Hz. The phases are drawn for every trial.
        duration_s: Duration of a trial, in s.
        width_m: Diameter of the target, in m.
        apart_m: Distance along the axis between the targets of the two users, in m. If nonzero,
            the users must agree on a position.
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
        """Always False: a tracking trial lasts exactly `duration_s` and cannot fail."""
        return False

    @property
    def needs_pair(self) -> bool:
        """True if two participants follow the target together.

        They see different targets and must agree on a position of the slave arm.
        """
        return self.apart_m > 0.0

    @property
    def longest_s(self) -> float:
        """Duration of every tracking trial, from the appearance of the target, in s."""
        return self.duration_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the seed draws the path
        """Creates the goal of a tracking trial: a path that begins at the slave's position.

        Args:
            start_m: Start position of the slave's end effector, in m.
            number: Not used.
            seed: Random seed from which the path is drawn.
        """
        random = np.random.default_rng(seed)
        sine_count = len(self.frequencies_hz)
        phases = random.uniform(0.0, 2.0 * math.pi, sine_count)
        return _TrackGoal(self, start_m, phases)


class _TrackGoal(TrialGoal):
    """Goal of a `TrackTrial`: to follow a moving target until the time is up."""

    is_moving = True

    def __init__(self, task: TrackTrial, start_m: Array, phases: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._task = task
        self._phases = phases

    def compute_measures(
        self,
        after_s: Array,
        position_m: Array,
        force_n: Array,  # noqa: ARG002
    ) -> dict[str, float]:
        """Computes which user's target the slave arm stayed closer to, if the targets differ.

        The measure `first_settled` is 1 at the first user's target, 0 at the second user's
        target, and 0.5 halfway between them, averaged over the trial.

        Args:
            after_s: Times since the appearance of the target, in s, shape (K,) for K records.
            position_m: Positions of the slave's end effector, in m, shape (K, 2) or (K, 3).
            force_n: Not used.

        Returns:
            Mapping from the name of the measure to its value. Empty if both users have the same
            target.
        """
        task = self._task
        if not task.needs_pair:
            return {}

        # The error from the middle between both targets, along the axis of the path.
        targets = [self._find_target_m(after, None) for after in after_s.tolist()]
        middle_m = np.array(targets)
        errors_m = position_m - middle_m
        axis_errors_m = errors_m[:, task.axis]
        mean_error_m = float(axis_errors_m.mean())
        first_settled = 0.5 + mean_error_m / task.apart_m
        return {"first_settled": first_settled}

    def _find_target_m(self, after_s: float, user: int | None) -> Array:
        """Returns the target on its moving path, in m.

        Args:
            after_s: Time since the appearance of the target, in s.
            user: Index of a user. The user's target is offset from the path by half of
                `apart_m`, in the positive direction for the first user. If `None`, the path
                itself is returned.
        """
        task = self._task
        rates_rad_s = 2.0 * math.pi * np.array(task.frequencies_hz)
        # The path begins at the start: each sine is 0 when the target appears.
        angles = rates_rad_s * after_s + self._phases
        sines = np.sin(angles) - np.sin(self._phases)
        sum_of_sines = float(sines.sum())
        largest_sum = 2.0 * len(sines)
        path_m = task.amplitude_m * sum_of_sines / largest_sum

        # The users' targets are on opposite sides of the path.
        offset_m = 0.0
        if user is not None:
            offset_m = task.apart_m * (0.5 - user)

        target_m = self.start_m.copy()
        target_m[task.axis] += offset_m + path_m
        return target_m

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:  # noqa: ARG002 - by its time
        """Ends the trial as succeeded when its duration is over. It cannot fail."""
        ends_s = self.appears_s + self._task.duration_s
        if t_s >= ends_s:
            return Outcome(True, t_s)
        return None


AnyTask = ReachTrial | ContactTrial | TrackTrial


def place_slave(arm: Any, shared: Sequence[float]) -> Array:
    """Computes the position of the slave's end effector, in m.

    Args:
        arm: Arm of the site.
        shared: Coordinates that the site sends to its peers: joint angles in rad, or the pose
            of the end effector.
    """
    position = shared[:3] if arm.shares_pose else arm.end_effector(shared)
    return np.array(position, dtype=np.float64)

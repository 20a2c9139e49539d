"""Defines the tasks of an experiment: reach a target, hand over, press a wall, track a path.

A protocol defines a `_TrialTask` with its parameters, such as the distance of the targets. For
each trial, the task creates a `TrialGoal`. The goal computes the position of the target at any
time, and judges the result of the trial. The participants move the slave arm over the network
with their master arms.

Invariant:
    - The goal of a trial depends only on the task's parameters, the trial's seed, and the start
      position of the slave's arm.
    - A trial is judged by the position of the slave's end effector and by the force on it. The
      delayed pictures that the users see play no role.
    - A trial ends when the end effector has stayed at the goal, when its time is over, or when
      a rule of the task is broken.
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
    """A task for the participants, as a protocol defines it: reach, press or follow.

    The task is the same for all trials. `make_goal` creates the goal of a single trial.

    Attributes:
        description: The task in a phrase, for texts and plans.
        instructions: Template of the text for participants.
        learning_measure: Name of the measure that decreases with practice.
        needs_wall: True if the task is judged by the force on the slave, which needs a wall.
    """

    description: ClassVar[str] = ""
    instructions: ClassVar[str] = ""
    learning_measure: ClassVar[str] = "completion_s"
    needs_wall: ClassVar[bool] = False

    def render_instructions(self, slave: str) -> str:
        """Returns the text that tells participants of the experiment what to do in this task.

        Args:
            slave: Name of the slave arm, which the participants move, as it appears in the
                text.
        """
        return self.instructions.format(slave=slave, task=self)

    @property
    def longest_s(self) -> float:
        """Longest duration of a trial after the appearance of its target, in s.

        With a time limit (`has_limit`), a trial that has not succeeded by then has failed.
        Without a limit, every trial lasts exactly this long.
        """
        raise NotImplementedError

    @property
    def has_limit(self) -> bool:
        """True if a trial fails when the participant has not finished in `longest_s` seconds.

        False if every trial lasts exactly `longest_s` seconds, as for following a moving
        target.
        """
        return True

    @property
    def needs_pair(self) -> bool:
        """True if two participants perform the task together.

        If so, the protocol of the experiment must name two master arms.
        """
        return False

    def make_goal(self, start_m: Array, number: int, seed: int) -> "TrialGoal":
        """Creates the goal of one trial, which states its target and decides when it ends.

        Args:
            start_m: Position of the slave's end effector at the start, shape (2,) or (3,), in
                m.
            number: Number of the target, from 0.
            seed: Seed of the trial.
        """
        raise NotImplementedError


class TrialGoal:
    """Target of one trial of an experiment, and the rule that decides when the trial ends.

    Args:
        start_m: Position of the slave's end effector at the start, in m.
        width_m: Diameter of the target, in m.

    Attributes:
        start_m: Position of the target before it appears, in m, which is the slave's start
            position.
        width_m: Diameter of the target, in m.
        appears_s: Time at which the target appears, in s. Users must wait until then.
        is_moving: True if the target moves after it has appeared.
        force_n: Force with which to press, in N. 0 if the task does not require a force.
        lead: The first user's share of the authority that two users have over the slave, until
            a handover. If `None`, the scenario's dominance factors apply.
        handover: Time from the target's appearance until the second user receives the
            authority, and duration of the change, both in s. `None` if there is no handover.
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
        """Returns the target position of the end effector at a time, shape (2,) or (3,), in m.

        Args:
            t_s: Time since the start of the session, in s.
            user: Index of the user whose target is returned, from 0. If `None`, the middle of
                all users' targets is returned.
        """
        if t_s < self.appears_s:
            return self.start_m
        return self._find_target_m(t_s - self.appears_s, user)

    def judge(self, t_s: float, position_m: Array, force_n: float = 0.0) -> "Outcome | None":
        """Judges whether the trial ends now.

        A trial is one execution of the task. The judgement begins when the target appears.

        Args:
            t_s: Time since the start of the session, in s.
            position_m: Position of the end effector, shape (2,) or (3,), in m.
            force_n: Magnitude of the force on the end effector, in N.

        Returns:
            The outcome of the trial. `None` while the trial continues.
        """
        if t_s < self.appears_s:
            return None
        return self._judge(t_s, position_m, force_n)

    def has_authority(self, t_s: float, user: int) -> bool:
        """Returns True if the slave follows a user at a given time of the trial.

        With a handover, the authority over the slave moves from the first user to the second.

        Args:
            t_s: Time since the start of the session, in s.
            user: Index of the user, from 0.
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
        """Returns the corridor to the target, which the end effector may not leave.

        The corridor is straight, and its other end is the target.

        Args:
            t_s: Time since the start of the session, in s.

        Returns:
            The start of the corridor and its width, both in m. `None` if there is no corridor.
        """
        return None

    def compute_measures(
        self,
        after_s: Array,  # noqa: ARG002
        position_m: Array,  # noqa: ARG002
        force_n: Array,  # noqa: ARG002
    ) -> dict[str, float]:
        """Computes measures of this task alone, such as the mean force against a wall.

        Args:
            after_s: Times since the target's appearance, shape (K,), in s.
            position_m: Positions of the slave's end effector, shape (K, 2) or (K, 3), in m.
            force_n: Magnitudes of the force on the end effector, shape (K,), in N.

        Returns:
            The measures by name. Empty if the task has no measures of its own.
        """
        return {}

    def _find_target_m(self, after_s: float, user: int | None) -> Array:
        """Returns the target position after the target has appeared. Each task implements it.

        Args:
            after_s: Time since the target's appearance, in s.
            user: Index of the user, or `None`, see `find_target_m`.

        Returns:
            The position, shape (2,) or (3,), in m.
        """
        raise NotImplementedError

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> "Outcome | None":
        """Decides in each control period whether the trial succeeds, fails or continues.

        Each task implements this method, which is called after the target has appeared. For the
        arguments and the result see `judge`.
        """
        raise NotImplementedError


class Outcome(NamedTuple):
    """Result of a trial: whether the task was done, and the time of the end.

    A trial without an outcome is still running.

    Attributes:
        succeeded: True if the task was done. False after the time limit or a broken rule.
        ended_s: Time of the end, in s since the start of the session.
    """

    succeeded: bool
    ended_s: float


class ReachTrial(_TrialTask, frozen=True, tag="reach"):
    """Task of an experiment: move the arm to targets on a ring, as in ISO 9241-411.

    Each target is opposite the previous target.

    Attributes:
        targets: Number of targets.
        distance_m: Radius of the ring around the start, in m.
        width_m: Diameter of a target, in m.
        dwell_s: Time for which the end effector must stay in the target, in s.
        timeout_s: Time after which the trial has failed, in s.
        corridor_m: Width of the straight corridor to the target, in m, which the users may not
            leave. `None` if the users may choose the path.
        handover_s: Time after which the second user receives the first user's authority, in s.
            `None` if there is no handover.
        ramp_s: Duration of the handover, in s. The end effector must stay in the target during
            the handover. Then the next target appears.
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
        """True if two participants reach the target together.

        The first participant then hands over the control of the slave arm to the second
        participant during the trial.
        """
        return self.handover_s is not None

    def render_instructions(self, slave: str) -> str:
        """Returns the text that tells the participants what to do in a reaching trial.

        The text says how far they may leave the straight path to the target, and when the other
        user takes over, if the task has these rules.

        Args:
            slave: Name of the slave arm as it appears in the text.
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

        It is `timeout_s`. If the first user hands the slave over to the second user, a second
        target appears after the handover, and the time-out starts again.
        """
        if self.handover_s is None:
            return self.timeout_s
        second_appears_s = self.handover_s + self.ramp_s
        return self.timeout_s + second_appears_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the order is fixed
        """Creates the goal of a reaching trial: its target on a ring around the start.

        The goal also contains the next target on the ring, which appears after a handover.

        Args:
            start_m: Position of the slave's end effector at the start of the trial, in m. It is
                the centre of the ring.
            number: Number of the target, from 0.
            seed: Not used, because the order of the targets is fixed.
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
            number: Number of the target, from 0. Numbers beyond the last target start again
                with the first target.
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

    A user who only passes through the target has not reached it. Subclasses define the
    condition by `_is_inside`, for example that the end effector is in the target.
    """

    def __init__(self, task: "ReachTrial | ContactTrial", start_m: Array) -> None:
        super().__init__(start_m, task.width_m)
        self._dwell_s = task.dwell_s
        self._longest_s = task.longest_s
        # Time since which the condition has been met; infinite while it is not met.
        self._inside_since_s = math.inf

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:
        """Returns True if the condition that must hold for some time holds now.

        Args:
            after_s: Time since the target's appearance, in s.
            position_m: Position of the slave's end effector, in m.
            force_n: Magnitude of the force on the end effector, in N.
        """
        raise NotImplementedError

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:
        """Ends the trial with success after the dwell time, or as failed after the time limit.

        The dwell time is the time for which the end effector must stay in the target. It starts
        again whenever the end effector leaves the target.
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
    """Goal of a trial of `ReachTrial`: to bring the end effector to a target and stay there.

    With a handover, there is a second target for the user who receives the slave. Without a
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
        """Computes how steady the end effector stayed at the target during the handover.

        The measure is the largest distance from the target, in mm, while one user hands the
        slave over to the other.

        Returns:
            The measure by its name. Empty without a handover.
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
        """Returns the corridor to the target, once the target has appeared.

        The corridor is the straight path to the target, which participants must not leave. The
        page draws it.

        Returns:
            The start of the corridor and its width, both in m. `None` before the target
            appears, and for a task without a corridor.
        """
        if self._corridor_m is None or t_s < self.appears_s:
            return None
        after_s = t_s - self.appears_s
        start_m, _ = self._find_segment(after_s)
        return start_m, self._corridor_m

    def _find_segment(self, after_s: float) -> Sequence[Array]:
        """Returns the start and the end of the present movement, in m.

        Usually this is the movement from the start to the target. After a handover between two
        users, a second target follows, and the movement goes from the first to the second
        target.

        Args:
            after_s: Time since the first target's appearance, in s.
        """
        has_second_appeared = 0.0 <= self._second_appears_s <= after_s
        if has_second_appeared:
            return self._waypoints_m[1:]
        return self._waypoints_m[:2]

    def _find_target_m(self, after_s: float, user: int | None) -> Array:  # noqa: ARG002 - all users see the same
        """Returns the end of the present movement, which is the same for all users, in m."""
        _, end_m = self._find_segment(after_s)
        return end_m

    def _is_inside(self, after_s: float, position_m: Array, force_n: float) -> bool:  # noqa: ARG002 - no force
        """Returns True if the end effector is in the target at which the trial can succeed.

        In a task with a handover, this is the second target: until it has appeared, the result
        is False even in the first target.
        """
        target_m = self._find_target_m(after_s, None)
        error_m = float(np.linalg.norm(position_m - target_m))
        is_in_target = error_m <= self.width_m / 2.0
        # Before the second target appears, the trial cannot succeed.
        return is_in_target and after_s >= self._second_appears_s

    def _judge(self, t_s: float, position_m: Array, force_n: float) -> Outcome | None:
        """Ends the trial as failed if the end effector has left the corridor to the target.

        Otherwise, and in a task without a corridor, the rule of `_DwellGoal` decides: the end
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
    """Task of an experiment: press a wall with a given force, and hold it for some time.

    Attributes:
        axis: Axis of the arm's base frame along which the target is drawn, from 0.
        distance_m: Distance from the start to the target, in m. Negative for the other side.
        width_m: Diameter of the target, in m.
        force_n: Force with which to press, in N.
        tolerance_n: Largest error of the force, in N.
        dwell_s: Time for which the force must be held, in s.
        timeout_s: Time after which the trial has failed, in s.
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
        """Time limit of a trial in s, within which the force at the wall must be held.

        The trial has failed after this time.
        """
        return self.timeout_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - there is one wall
        """Creates the goal of a trial: where to touch the wall, and how strongly to press it.

        Args:
            start_m: Position of the slave's end effector at the start, in m.
            number: Not used, because there is one wall.
            seed: Not used.
        """
        return _ContactGoal(self, start_m)


class _ContactGoal(_DwellGoal):
    """Decides when a trial has succeeded whose task is to press a wall with a given force.

    Only the force is judged, not the position. See `ContactTrial`.
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
        """Computes the accuracy with which the force was held at the end of the trial.

        The measures are the mean of the force and the RMS of its error, both in N, over the
        time for which the force had to be held.

        Returns:
            The measures by their names.
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
        """Returns True if the force differs from the required one by at most the tolerance."""
        error_n = abs(force_n - self.force_n)
        return error_n <= self._tolerance_n


class TrackTrial(_TrialTask, frozen=True, tag="track"):
    """The task to follow a target that moves unpredictably along one axis.

    The path is a sum of sines whose frequencies have no common multiple.

    Attributes:
        axis: Axis of the arm's base frame, from 0.
        amplitude_m: Largest distance of the path from the start, in m.
        frequencies_hz: Frequencies of the sines, in Hz. Their phases are drawn for every trial.
        duration_s: Duration of a trial, in s.
        width_m: Diameter of the target, in m.
        apart_m: Distance along the axis between the targets of the two users, in m. If it is
            not 0, the users must agree on a position.
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
        """Always False: following a target takes exactly `duration_s`, and cannot fail."""
        return False

    @property
    def needs_pair(self) -> bool:
        """True if two participants follow a moving target together.

        They see different targets, and must agree on a position of the slave arm.
        """
        return self.apart_m > 0.0

    @property
    def longest_s(self) -> float:
        """Duration of every trial of following a moving target, in s.

        The duration starts when the target appears.
        """
        return self.duration_s

    def make_goal(self, start_m: Array, number: int, seed: int) -> TrialGoal:  # noqa: ARG002 - the seed draws the path
        """Creates the goal of a trial: a path that begins at the slave's position.

        Args:
            start_m: Position of the slave's end effector at the start, in m.
            number: Number of the target, which is not used.
            seed: Seed of the random numbers that determine the path.
        """
        random = np.random.default_rng(seed)
        sine_count = len(self.frequencies_hz)
        phases = random.uniform(0.0, 2.0 * math.pi, sine_count)
        return _TrackGoal(self, start_m, phases)


class _TrackGoal(TrialGoal):
    """Goal of a trial of `TrackTrial`: to follow a moving target until the time is over."""

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

        The measure `first_settled` is 1 for the position of the first user's target, 0 for the
        position of the second user's target, and 0.5 for the middle between them. It is
        averaged over the trial.

        Args:
            after_s: Times since the target's appearance, shape (K,), in s, for K records.
            position_m: Positions of the slave's end effector, shape (K, 2) or (K, 3), in m.
            force_n: Not used.

        Returns:
            The measure by its name. Empty if both users have the same target.
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
            after_s: Time since the target's appearance, in s.
            user: Index of a user, whose target is half of `apart_m` away from the path: the
                first user's on the positive side. If `None`, the path itself is returned.
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
        """Ends the trial as completed when its duration is over. It cannot fail."""
        ends_s = self.appears_s + self._task.duration_s
        if t_s >= ends_s:
            return Outcome(True, t_s)
        return None


AnyTask = ReachTrial | ContactTrial | TrackTrial


def place_slave(arm: Any, shared: Sequence[float]) -> Array:
    """Computes the position of the slave's end effector from a state of its arm, in m.

    The state is the one that the site (arm controller) sends to other sites.

    Args:
        arm: Arm of the site.
        shared: Coordinates that the sites exchange: joint angles in rad, or the pose of the end
            effector.
    """
    position = shared[:3] if arm.shares_pose else arm.end_effector(shared)
    return np.array(position, dtype=np.float64)

"""Models a person who moves a master arm, for experiments without people.

The synthetic participant sees the slave arm over the network, and moves the hand at its master
so that the slave reaches the target:
    - Movements have minimum jerk (Flash and Hogan, 1985), end points that scatter in proportion
      to their length (Harris and Wolpert, 1998), and durations that follow Fitts' law.
    - Before a correction, the participant waits until the slave is at rest, as people do under
      delay (Ferrell, 1965).
    - A moving target is followed with a correction rate that decreases with the known delay
      (McRuer and Jex, 1967).
    - Practice shortens movements according to an exponential law.

Invariant:
    - The motion depends only on the participant's view, parameters and seed.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from msgspec.structs import replace

from trilat_net.core import Array, HandContext, HandView, PeerView
from trilat_net.fields import Frozen

from .tasks import TrialGoal, place_slave

Share = Annotated[float, Meta(ge=0.0, le=1.0)]

MOVED_SHARE = 0.02
"""Fraction of the target width by which the slave must move to count as moving."""
OFF_TARGET_SHARE = 0.35
"""Fraction of the target width by which the slave must be off to be corrected."""
DELAY_MARGIN = 0.7
"""Maximum product of the target following rate and the loop delay."""


class ParticipantModel(Frozen, frozen=True):
    """Mean parameters of synthetic participants.

    `draw` varies these means to create different participants. The duration of a movement
    follows Fitts's law: it increases with the index of difficulty, log2(distance / width + 1).

    Attributes:
        reaction_s: Time from a visible event to the participant's reaction, in s.
        fitts_a_s: Duration of a movement with zero difficulty, in s.
        fitts_b_s: Additional duration per bit of the index of difficulty, in s.
        noise: Standard deviation of a movement's end point, as a fraction of the movement's
            length.
        crossover_rad_s: Crossover frequency at which the participant follows a moving target in
            the absence of delay, in rad/s.
        learning: Fraction by which the first trial is slower than a practised one.
        practised: Number of trials after which the fraction `learning` has halved.
        spread: Standard deviation of the logarithms of a participant's parameters.
    """

    reaction_s: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.25
    fitts_a_s: Annotated[float, Meta(ge=0.05, le=5.0)] = 0.3
    fitts_b_s: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.2
    noise: Share = 0.08
    crossover_rad_s: Annotated[float, Meta(gt=0.0, le=20.0)] = 3.0
    learning: Share = 0.3
    practised: Annotated[float, Meta(gt=0.0, le=1000.0)] = 5.0
    spread: Share = 0.15

    def draw(self, seed: int) -> "ParticipantModel":
        """Draws the parameters of an individual participant around these mean parameters.

        Multiplies five parameters by log-normal factors with the deviation `spread`: the
        reaction time, both constants of Fitts's law, the noise and the crossover frequency.

        Args:
            seed: Random seed. Equal seeds give the same participant.
        """
        random = np.random.default_rng(seed)
        logarithms = self.spread * random.standard_normal(5)
        factors = np.exp(logarithms).tolist()
        reaction, fitts_a, fitts_b, noise_factor, crossover = factors
        noise = self.noise * noise_factor
        return replace(
            self,
            reaction_s=self.reaction_s * reaction,
            fitts_a_s=self.fitts_a_s * fitts_a,
            fitts_b_s=self.fitts_b_s * fitts_b,
            noise=min(noise, 1.0),
            crossover_rad_s=self.crossover_rad_s * crossover,
        )


class SyntheticParticipant:
    """A model of a person at one master arm during one trial.

    Implements the interface of a user's operator program: the site of the arm calls `act` at a
    fixed rate and moves the arm towards the returned position.

    Args:
        facts: Information about the participant's site.
        model: Parameters of the participant.
        goal: Goal of the trial.
        slave: Name of the slave's site, the slave's arm, and a function that computes the force
            on the end effector, in N, from joint angles and torques.
        before: Number of trials that the participant has done before.
        seed: Random seed of the trial.
        user: Index of the participant among the users, starting at 0.
    """

    def __init__(
        self,
        facts: HandContext,
        model: ParticipantModel,
        goal: TrialGoal,
        slave: tuple[str, Any, Callable[[Sequence[float], Sequence[float]], float]],
        before: int,
        seed: int,
        user: int,
    ) -> None:
        self._model = model
        self._goal = goal
        self._before = before
        self._axes = facts.size
        slave_name, self._arm, self._find_force_n = slave
        self._slave_index = facts.peers.index(slave_name)
        self._user = user
        self._random = np.random.default_rng([seed, facts.seed])
        # The present movement of the hand, from `_start_m` to `_end_m`.
        self._start_m = np.zeros(self._axes)
        self._end_m = self._start_m
        self._begins_s = -math.inf
        self._duration_s = 0.0
        # The newest position of the slave that the participant has seen, and the time at which
        # the participant last saw the slave move.
        self._slave_m: Array | None = None
        self._moved_s = 0.0

    def act(self, now: HandView) -> Array:
        """Decides where the participant moves the arm next.

        The participant sees the slave arm and the target with a delay, and starts a new
        movement when the slave is at rest outside the target.

        Args:
            now: What the participant sees and feels at its site.

        Returns:
            Target position of the hand, in m, shape (2,) or (3,).
        """
        slave = now.peers[self._slave_index]
        slave_m = self._see_slave(now, slave)
        if not self._goal.has_authority(now.t_s, self._user):
            # Without authority, the hand yields to the arm.
            self._start_m = now.pose
            self._end_m = now.pose
            return now.pose

        goal = self._goal
        seen_s = now.t_s - self._model.reaction_s
        target_m = goal.find_target_m(seen_s, self._user)
        error_m = target_m[: self._axes] - slave_m

        if goal.is_moving:
            return self._follow(now, error_m, slave.age_s)

        if goal.force_n and now.t_s > goal.appears_s:
            press_step_m = self._find_press_step(slave, now.t_s)
            if press_step_m.any():
                return self._follow(now, press_step_m, slave.age_s)

        distance_m = float(np.linalg.norm(error_m))
        is_off_target = distance_m > OFF_TARGET_SHARE * goal.width_m
        if is_off_target and now.t_s >= self._find_next_start_s(slave):
            self._start_movement(now.t_s, error_m)
        return self._interpolate_movement(now.t_s)

    def _see_slave(self, now: HandView, slave: PeerView) -> Array:
        """Observes the slave arm, and stores its position and the time of its last motion.

        A step of the slave counts as motion if it is longer than the fraction `MOVED_SHARE` of
        the target diameter. On the first observation, the participant's hand is initialised at
        rest at its current position.

        Args:
            now: What the participant sees and feels at its site, including the pose of the
                hand.
            slave: The participant's view of the slave arm, delayed by the network.

        Returns:
            Position of the slave's end effector, in m, shape (axes,), with two or three axes.
        """
        position_m = place_slave(self._arm, slave.q)
        slave_m = position_m[: self._axes]
        if self._slave_m is None:  # the first observation
            self._start_m = now.pose
            self._end_m = now.pose
            self._slave_m = slave_m

        step_m = slave_m - self._slave_m
        distance_m = float(np.linalg.norm(step_m))
        self._slave_m = slave_m
        has_moved = distance_m > MOVED_SHARE * self._goal.width_m
        if has_moved:
            self._moved_s = now.t_s
        return slave_m

    def _find_next_start_s(self, slave: PeerView) -> float:
        """Returns the earliest time at which the participant starts the next movement, in s.

        The participant reacts after the hand and the slave have come to rest. For a correction
        of an earlier movement, the participant also waits until the delayed view shows the end
        of the slave's motion.

        Args:
            slave: The participant's view of the slave arm, including its age.

        Returns:
            Time since the start of the trial.
        """
        hand_rests_from_s = self._begins_s + self._duration_s  # -infinity before any movement
        slave_moved_last_s = self._moved_s
        rest_s = max(hand_rests_from_s, slave_moved_last_s)

        view_delay_s = 0.0
        is_correction = not math.isinf(self._begins_s)  # the hand has moved before
        if is_correction:
            view_delay_s = slave.age_s
        wait_s = self._model.reaction_s + view_delay_s
        return max(rest_s, 0.0) + wait_s  # a rest starts at the beginning of the trial

    def _find_press_step(self, slave: PeerView, t_s: float) -> Array:
        """Determines how far the hand moves to press the slave arm against a wall.

        The step points from the slave's start position to the target in the wall. Its length is
        proportional to the missing fraction of the required force: the target width at zero
        force, and 0 at the required force. If the force is too large, the hand moves back.

        Args:
            slave: The participant's view of the slave arm.
            t_s: Current time in the trial, in s.

        Returns:
            Step of the hand, in m, shape (axes,). 0 if there is no force, since the slave has
            not reached the wall yet.
        """
        goal = self._goal
        force_n = self._find_force_n(slave.q, slave.tau_x)
        start_to_target_m = goal.find_target_m(t_s) - goal.start_m
        towards_target_m = start_to_target_m[: self._axes]
        distance_m = np.linalg.norm(towards_target_m)
        full_step_m: Array = towards_target_m * (goal.width_m / distance_m)
        touches_wall = bool(force_n)
        if not touches_wall:
            return 0.0 * full_step_m

        missing_share = 1.0 - force_n / goal.force_n
        return full_step_m * missing_share

    def _start_movement(self, t_s: float, step_m: Array) -> None:
        """Starts a minimum-jerk movement to the target, as a person would.

        The end point scatters in proportion to the length of the step. The duration depends on
        Fitts' law and on practice so far.

        Args:
            t_s: Current time, in s.
            step_m: Intended step of the slave, in m.
        """
        model = self._model
        length_m = float(np.linalg.norm(step_m))
        deviation_m = model.noise * length_m
        scatter_m = deviation_m * self._random.standard_normal(self._axes)

        # Index of difficulty by Shannon's formulation of Fitts' law, in bit.
        relative_length = length_m / self._goal.width_m
        difficulty_bits = math.log2(relative_length + 1.0)
        practised_duration_s = model.fitts_a_s + model.fitts_b_s * difficulty_bits

        # After `practised` trials, the initial slowness has halved.
        halvings = self._before / model.practised
        remaining_slowness = 0.5**halvings
        slowness = 1.0 + model.learning * remaining_slowness

        start_m = self._interpolate_movement(t_s)
        self._start_m = start_m
        self._end_m = start_m + step_m + scatter_m
        self._begins_s = t_s
        self._duration_s = slowness * practised_duration_s

    def _interpolate_movement(self, t_s: float) -> Array:
        """Returns the position along the current minimum-jerk movement, in m.

        With s from 0 to 1 over the movement, the position is start + (end - start) (10 s^3 - 15
        s^4 + 6 s^5).
        """
        s = 1.0  # before the first movement, start and end are equal
        if self._duration_s:
            elapsed_s = t_s - self._begins_s
            s = min(max(elapsed_s / self._duration_s, 0.0), 1.0)
        progress = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
        movement_m = self._end_m - self._start_m
        position_m: Array = self._start_m + movement_m * progress
        return position_m

    def _follow(self, now: HandView, error_m: Array, age_s: float) -> Array:
        """Moves the hand so that the slave follows a moving target, despite the delay.

        Implements the crossover model of a person (McRuer and Jex): the velocity of the hand is
        proportional to the error,

            velocity = rate * error.

        The rate is `crossover_rad_s`, but at most `DELAY_MARGIN` / (reaction time + 2 age of
        the slave's sample), since a person corrects more slowly under delay. In each call, the
        hand corrects the fraction rate * (time since the last call) of the error, up to the
        entire error. The perceived error has noise in proportion to its size.

        The time of the call and the position of the hand are stored for the next call.

        Args:
            now: What the participant sees and feels at its site, including the current time.
            error_m: Vector from the slave to the target, in m, shape (axes,).
            age_s: Age of the slave's sample, in s.

        Returns:
            Target position of the hand, in m, shape (axes,).
        """
        model = self._model
        # The age is the delay of one direction; a correction is seen after both directions.
        loop_delay_s = model.reaction_s + 2.0 * age_s
        rate_per_s = min(model.crossover_rad_s, DELAY_MARGIN / loop_delay_s)
        error_size_m = float(np.linalg.norm(error_m))
        deviation_m = model.noise * error_size_m
        scatter_m = deviation_m * self._random.standard_normal(self._axes)

        share = 0.0
        has_moved_before = not math.isinf(self._begins_s)
        if has_moved_before:
            elapsed_s = now.t_s - max(self._begins_s, 0.0)  # since the last call
            share = rate_per_s * elapsed_s
        self._begins_s = now.t_s
        correction_m = min(share, 1.0) * (error_m + scatter_m)
        self._end_m = self._end_m + correction_m
        return self._end_m

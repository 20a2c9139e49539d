"""A synthetic participant: a model of a person at a master, for experiments without people.

The participant moves towards a target by what it sees of the slave over the network:
    - It makes movements of minimum jerk (Flash and Hogan, 1985), whose ends scatter with their
      length (Harris and Wolpert, 1998) and whose durations follow Fitts' law.
    - Before a correction it waits until the slave is at rest, as people do with a delay
      (Ferrell, 1965).
    - It follows a moving target at a rate of correction that it lowers with the known delay
      (McRuer and Jex, 1967).
    - With practice it becomes faster by an exponential law.

Invariant:
    - Its motion is a function of what its site knows, of its parameters and of its seed.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from msgspec.structs import replace

from ...core.own_hand import HandContext, HandView
from ...core.user_law import PeerView
from ...core.vectors import Array
from ...fields import Frozen
from .tasks import TrialGoal, place_slave

Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class ParticipantModel(Frozen, frozen=True):
    """The mean parameters of synthetic participants; each draws its own about these.

    Attributes:
        reaction_s: time from a view to the reaction, s.
        fitts_a_s: duration of a movement of no difficulty, s.
        fitts_b_s: additional duration for each bit of its index of difficulty, s.
        noise: standard deviation of a movement's end, as a share of its length.
        crossover_rad_s: rate at which a moving target is followed without a delay, rad/s.
        learning: by which share a first trial is slower than practised ones.
        practised: number of trials after which half of that share is gone.
        spread: standard deviation of the logarithm of a participant's parameters.
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
        """Returns the parameters of one participant."""
        random = np.random.default_rng(seed)
        drawn = ("reaction_s", "fitts_a_s", "fitts_b_s", "noise", "crossover_rad_s")
        factors = np.exp(self.spread * random.standard_normal(len(drawn)))
        parameters = {
            name: getattr(self, name) * float(x) for name, x in zip(drawn, factors, strict=True)
        }
        return replace(self, **{**parameters, "noise": min(parameters["noise"], 1.0)})


class SyntheticParticipant:
    """A synthetic participant at one master in one trial: a hand of the user's own.

    Args:
        facts: the description of its site.
        model: its parameters.
        goal: the goal of the trial, with the target that it sees.
        slave: the site of the slave, its arm, and a function that returns the force on its end
            effector, N, from joint angles and torques.
        before: the number of trials that it has made before.
        seed: the seed of the trial.
        user: its index among the users, from 0.
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
        self._size = facts.size
        name, self._arm, self._find_force_n = slave
        self._user = user
        self._peer = facts.peers.index(name)
        self._random = np.random.default_rng([seed, facts.seed])
        self._start_m = np.zeros(facts.size)
        self._end_m = self._start_m
        self._begins_s = -math.inf
        self._duration_s = 0.0
        self._seen_m = np.zeros(facts.size)
        self._has_seen = False
        self._moved_s = 0.0

    def act(self, now: HandView) -> Array:
        """Returns the target position of the hand, m."""
        slave = now.peers[self._peer]
        seen = place_slave(self._arm, slave.q)[: self._size]
        if not self._has_seen:
            self._has_seen = True
            self._start_m = now.pose
            self._end_m = now.pose
            self._seen_m = seen
        moved = float(np.linalg.norm(seen - self._seen_m))
        self._seen_m = seen
        if moved > 0.02 * self._goal.width_m:
            self._moved_s = now.t_s
        if not self._goal.has_authority(now.t_s, self._user):
            # Without authority, the hand yields to the arm.
            self._start_m = now.pose
            self._end_m = now.pose
            return now.pose
        target = self._goal.find_target_m(now.t_s - self._model.reaction_s, self._user)[
            : self._size
        ]
        if self._goal.is_moving:
            return self._follow(now, target - seen, slave.age_s)
        if (
            self._goal.force_n
            and now.t_s > self._goal.appears_s
            and (step := self._find_press_step(slave, now.t_s)).any()
        ):
            return self._follow(now, step, slave.age_s)
        ended_s = max(self._begins_s + self._duration_s, self._moved_s)
        waits_s = self._model.reaction_s + (0.0 if math.isinf(self._begins_s) else slave.age_s)
        is_off = float(np.linalg.norm(target - seen)) > 0.35 * self._goal.width_m
        if now.t_s >= max(ended_s, 0.0) + waits_s and is_off:
            self._start_movement(now.t_s, target - seen)
        return self._interpolate_movement(now.t_s)

    def _find_press_step(self, slave: PeerView, t_s: float) -> Array:
        """Returns the step towards the required force, m; 0 away from the wall."""
        felt_n = self._find_force_n(slave.q, slave.tau_x)
        towards = (self._goal.find_target_m(t_s) - self._goal.start_m)[: self._size]
        step: Array = towards * (self._goal.width_m / np.linalg.norm(towards))
        return step * (1.0 - felt_n / self._goal.force_n) if felt_n else 0.0 * step

    def _start_movement(self, t_s: float, step: Array) -> None:
        """Starts a movement by a step, with noise in proportion to the step's length."""
        length = float(np.linalg.norm(step))
        scatter = self._model.noise * length * self._random.standard_normal(self._size)
        difficulty = math.log2(length / self._goal.width_m + 1.0)
        slower = 1.0 + self._model.learning * 0.5 ** (self._before / self._model.practised)
        start = self._interpolate_movement(t_s)
        self._start_m = start
        self._end_m = start + step + scatter
        self._begins_s = t_s
        self._duration_s = slower * (self._model.fitts_a_s + self._model.fitts_b_s * difficulty)

    def _interpolate_movement(self, t_s: float) -> Array:
        """Returns the position of the present movement of minimum jerk, m.

        With s from 0 to 1 over the movement, the position is start + (end - start) (10 s^3 - 15
        s^4 + 6 s^5).
        """
        s = (
            min(max((t_s - self._begins_s) / self._duration_s, 0.0), 1.0)
            if self._duration_s
            else 1.0
        )
        found: Array = self._start_m + (self._end_m - self._start_m) * (
            10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
        )
        return found

    def _follow(self, now: HandView, distance: Array, age_s: float) -> Array:
        """Moves towards a moving target, at a rate that falls with the delay.

        The rate is at most 0.7 / (reaction time + 2 age of the slave's sample), in 1/s.
        """
        limit = 0.7 / (self._model.reaction_s + 2.0 * age_s)
        rate = min(self._model.crossover_rad_s, limit)
        scatter = (
            self._model.noise
            * float(np.linalg.norm(distance))
            * self._random.standard_normal(self._size)
        )
        share = 0.0
        if not math.isinf(self._begins_s):
            share = rate * (now.t_s - max(self._begins_s, 0.0))
        self._begins_s = now.t_s
        self._end_m = self._end_m + min(share, 1.0) * (distance + scatter)
        return self._end_m

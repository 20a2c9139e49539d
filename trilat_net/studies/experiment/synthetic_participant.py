"""A synthetic participant: a model of somebody at a master, for experiments without people, and
named so.

It moves towards a target by what it sees of the slave, over the network, in movements of
minimum jerk (Flash and Hogan, 1985) whose ends scatter with their length (Harris and Wolpert,
1998) and whose durations follow Fitts' law; it waits until the slave has come to rest before it
corrects, as people do over a delay (Ferrell, 1965). A moving target it follows by a rate of
correction that it lowers with the delay it knows (McRuer and Jex, 1967). With practice it is
faster by a power law.

Invariant: what it does is a function of what its site knows, of its numbers and of its seed.
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
    """The numbers of synthetic participants; each draws its own about these.

    Attributes:
        reaction_s: time from what is seen to what is done, s.
        fitts_a_s: time of a movement of no difficulty, s.
        fitts_b_s: time for each bit of its index of difficulty, s.
        noise: deviation of a movement's end, as a part of its length.
        crossover_rad_s: rate at which a moving target is followed without a delay, rad/s.
        learning: by what part a first trial is slower than practised ones.
        practised: trials after which half of that is gone.
        spread: deviation of a participant's numbers about these, as a part of them.
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
        """Returns the numbers of one participant."""
        random = np.random.default_rng(seed)
        drawn = ("reaction_s", "fitts_a_s", "fitts_b_s", "noise", "crossover_rad_s")
        factors = np.exp(self.spread * random.standard_normal(len(drawn)))
        own = {
            name: getattr(self, name) * float(x) for name, x in zip(drawn, factors, strict=True)
        }
        return replace(self, **{**own, "noise": min(own["noise"], 1.0)})


class SyntheticParticipant:
    """A synthetic participant at one master in one trial, as a hand of one's own.

    Args:
        facts: of its site.
        model: its numbers.
        goal: the target that it sees.
        slave: the site of the slave, its arm, and the force at its end effector by angles and
            torques, N.
        before: how many trials it has made before.
        seed: of the trial, for what it draws.
        user: which of the users it is, from 0.
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
        self._from = self._to = np.zeros(facts.size)
        self._begins_s = -math.inf
        self._takes_s = 0.0
        self._seen = np.zeros(facts.size)
        self._begun = False
        self._still_s = 0.0

    def act(self, now: HandView) -> Array:
        """Returns where the hand goes, m."""
        slave = now.peers[self._peer]
        seen = place_slave(self._arm, slave.q)[: self._size]
        if not self._begun:
            self._begun = True
            self._from = now.pose
            self._to = now.pose
            self._seen = seen
        moved = float(np.linalg.norm(seen - self._seen))
        self._seen = seen
        if moved > 0.02 * self._goal.width_m:
            self._still_s = now.t_s
        if not self._goal.has_authority(now.t_s, self._user):  # goes along
            self._from = self._to = now.pose
            return now.pose
        target = self._goal.find_target_m(now.t_s - self._model.reaction_s, self._user)[
            : self._size
        ]
        if self._goal.is_moving:
            return self._follow(now, target - seen, slave.age_s)
        if (
            self._goal.force_n
            and now.t_s > self._goal.appears_s
            and (way := self._press(slave, now.t_s)).any()
        ):
            return self._follow(now, way, slave.age_s)
        ended_s = max(self._begins_s + self._takes_s, self._still_s)
        waits_s = self._model.reaction_s + (0.0 if math.isinf(self._begins_s) else slave.age_s)
        is_off = float(np.linalg.norm(target - seen)) > 0.35 * self._goal.width_m
        if now.t_s >= max(ended_s, 0.0) + waits_s and is_off:
            self._start(now.t_s, target - seen)
        return self._reach(now.t_s)

    def _press(self, slave: PeerView, t_s: float) -> Array:
        """Returns the way to the force that is asked, by the force seen over the network; 0 off
        a wall.
        """
        felt_n = self._find_force_n(slave.q, slave.tau_x)
        towards = (self._goal.find_target_m(t_s) - self._goal.start_m)[: self._size]
        way: Array = towards * (self._goal.width_m / np.linalg.norm(towards))
        return way * (1.0 - felt_n / self._goal.force_n) if felt_n else 0.0 * way

    def _start(self, t_s: float, way: Array) -> None:
        """Begins a movement by what is missing, with the noise of its length."""
        length = float(np.linalg.norm(way))
        scatter = self._model.noise * length * self._random.standard_normal(self._size)
        difficulty = math.log2(length / self._goal.width_m + 1.0)
        slower = 1.0 + self._model.learning * 0.5 ** (self._before / self._model.practised)
        start = self._reach(t_s)
        self._from = start
        self._to = start + way + scatter
        self._begins_s = t_s
        self._takes_s = slower * (self._model.fitts_a_s + self._model.fitts_b_s * difficulty)

    def _reach(self, t_s: float) -> Array:
        s = min(max((t_s - self._begins_s) / self._takes_s, 0.0), 1.0) if self._takes_s else 1.0
        found: Array = self._from + (self._to - self._from) * (
            10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
        )
        return found

    def _follow(self, now: HandView, way: Array, age_s: float) -> Array:
        """Moves on towards a target that moves, the slower the longer the way of what it does
        is.
        """
        most = 0.7 / (self._model.reaction_s + 2.0 * age_s)
        rate = min(self._model.crossover_rad_s, most)
        scatter = (
            self._model.noise
            * float(np.linalg.norm(way))
            * self._random.standard_normal(self._size)
        )
        step = (
            rate * (now.t_s - max(self._begins_s, 0.0))
            if not math.isinf(self._begins_s)
            else 0.0
        )
        self._begins_s = now.t_s
        self._to = self._to + min(step, 1.0) * (way + scatter)
        return self._to

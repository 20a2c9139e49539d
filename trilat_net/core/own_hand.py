"""A hand of one's own: a program that sees what its site knows, and moves, turns or pushes the
arm.

Invariant: what is decided at a tick by what was seen at that tick acts a fixed time later,
whoever decides and wherever, as a sample is in use a fixed time after its stamp (L2). A
decision that comes later than that acts at once. What acts is an input of the tick, as of any
live hand, so a log repeats it without the program.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from ..errors import count_nouns
from .live_hand import (
    SILENCE_NS,
    HandCommand,
    HandMemory,
    HandRules,
    HandStep,
    advance_hand,
    glide,
)
from .site_arrays import SiteArrays
from .site_setup import Layout
from .ticks import tick_ns
from .user_law import PeerView
from .vectors import Array

PROGRAM = 1
"""The source of every action of a hand of one's own, in a record."""


class HandContext(NamedTuple):
    """What a hand of one's own knows before it begins.

    >>> class Still:
    ...     def __init__(self, facts: tn.HandContext) -> None:
    ...         self.size = facts.size
    ...     def act(self, now: tn.HandView) -> list[float]:
    ...         return [0.0] * self.size

    Attributes:
        site: the site whose arm it holds.
        peers: names of the peers, in scenario order.
        mode: "tip": it moves the end effector; "joint": it turns the joints; "force": it
            pushes.
        size: how many numbers it acts with: an axis each, m or N; or a joint each, rad.
        rate_hz: how often it is asked, Hz.
        delay_s: time from what it sees to what it does, s.
        speed_limit: largest speed of the target, m/s or rad/s; inf for one that pushes.
        limit: the largest force, N, or the largest norm of its torques, N m.
        seed: for what it draws: of the scenario and the site.
    """

    site: str
    peers: tuple[str, ...]
    mode: str
    size: int
    rate_hz: int
    delay_s: float
    speed_limit: float
    limit: float
    seed: int


class HandView(NamedTuple):
    """What a hand of one's own sees at a tick, by what its site knows then.

    >>> def act(self, now: tn.HandView) -> list[float]:
    ...     return now.pose + 0.3 * (self.goal_m - now.pose)

    Attributes:
        k: the tick.
        t_s: its nominal time since the epoch, s.
        q: joint angles of the arm, rad, shape (n,).
        qd: joint velocities, rad/s.
        pose: where the arm is in the coordinates of the hand: its end effector, m, or its
            joints, rad.
        q_des: the reference of the tick before, rad or m, shape (m,).
        tau_x: exogenous torque of the tick before, N m; the torque ON the arm is its negative.
        target: where the hand's own target is, m or rad, or its force, N; zeros while it does
            not hold.
        grip: how firm it holds, 0 to 1.
        peers: the peers in scenario order, by the samples that were in use at the tick before:
            q and qd have m numbers, and an age is that at this tick.
    """

    k: int
    t_s: float
    q: Array
    qd: Array
    pose: Array
    q_des: Array
    tau_x: Array
    target: Array
    grip: float
    peers: tuple[PeerView, ...]


class HandProgram(Protocol):
    """A hand of one's own; its class is called with `HandContext` and its settings, by name."""

    def act(self, now: HandView) -> Sequence[float] | None:
        """Returns the target of the end effector, m, or of the joints, rad, or a force, N;
        None: lets go.
        """


class OwnHand:
    """The hand of one's own at one site: when it is asked, and when what it decides acts.

    Args:
        rules: what it may do.
        every: ticks from one question to the next.
        delay: ticks from what it sees to what it does.
        place: returns where the arm is by its joint angles, in the coordinates of the target.
    """

    def __init__(
        self,
        rules: HandRules,
        every: int,
        delay: int,
        place: Callable[[Sequence[float]], Sequence[float]],
    ) -> None:
        self._rules = rules
        self.period_ticks = every
        self.delay_ticks = delay
        self._place = place
        self._due: deque[tuple[int, HandCommand]] = deque()
        self._memory = HandMemory()
        self._newest = -1

    def is_decision_tick(self, k: int) -> bool:
        """True if it decides at this tick."""
        return k % self.period_ticks == 0

    def find_next_event(self, k: int) -> int:
        """Returns the first tick after this one at which it is asked, or what it decided begins
        to act.
        """
        asked = (k // self.period_ticks + 1) * self.period_ticks
        return min([asked, *(due for due, _ in self._due if due > k)])

    def build_view(self, k: int, arrays: SiteArrays, layout: Layout) -> HandView:
        """Returns what it sees at tick k, which its site is about to make."""
        own = np.asarray(arrays.site)
        links = np.asarray(arrays.links)  # records are slow to read
        n = layout.joints
        m = layout.shared
        rate_hz = self._rules.rate_hz
        q = own["q"][0, :n].copy()
        now_ns = tick_ns(k, rate_hz)
        numbers = [links[name].tolist() for name in ("alpha", "used", "rate_hz", "new")]
        shared = [links[name][:, :m].copy() for name in ("q", "qd", "tau_x")]
        peers = tuple(
            PeerView(
                alpha, used, (now_ns - tick_ns(max(used, 0), its_rate_hz)) * 1e-9, new, *states
            )
            for alpha, used, its_rate_hz, new, *states in zip(*numbers, *shared, strict=True)
        )
        return HandView(
            k=k,
            t_s=k / rate_hz,
            q=q,
            qd=own["qd"][0, :n].copy(),
            pose=np.asarray(self._place(q.tolist()), dtype=np.float64),
            q_des=own["q_des"][0, :m].copy(),
            tau_x=0.0 - own["on_arm"][0, :n],
            target=np.array(self._memory.target or (0.0,) * self._rules.size),
            grip=self._memory.grip,
            peers=peers,
        )

    def accept_decision(self, k: int, goal: Sequence[float] | None) -> None:
        """Takes in what it decided by what it saw at tick k.

        One that is older than the newest is passed over.

        Raises:
            ValueError: it is no target or force that such a hand may have.
        """
        numbers = () if goal is None else tuple(float(one) for one in goal)
        if goal is not None and len(numbers) != self._rules.size:
            raise ValueError(
                f"it acts with {count_nouns(len(numbers), 'number')}, not {self._rules.size}"
            )
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"it acts with {list(numbers)}, which is not finite")
        if (size := math.hypot(*numbers)) > self._rules.max_goal_norm:
            raise ValueError(
                f"it acts with a norm of {size:g}, at most {self._rules.max_goal_norm:g} is taken"
            )
        if k <= self._newest:
            return
        self._newest = k
        due = k + self.delay_ticks
        command = HandCommand(
            source=PROGRAM,
            number=k // self.period_ticks,
            grip=goal is not None,
            target=numbers,
            sent_ns=tick_ns(due, self._rules.rate_hz),
        )
        self._due.append((due, command))

    def release(self, k: int) -> None:
        """Lets go at tick k, whatever was decided before."""
        self._due.clear()
        command = HandCommand(
            source=PROGRAM,
            number=k // self.period_ticks,
            grip=False,
            target=(),
            sent_ns=tick_ns(k, self._rules.rate_hz),
        )
        self._due.append((k, command))

    def advance_to(self, k: int, angles: Callable[[], Sequence[float]]) -> HandStep:
        """Returns what it does in tick k, see `advance_hand`; `angles` returns those of the
        joints, rad.
        """
        commands = []
        while self._due and self._due[0][0] <= k:
            commands.append(self._due.popleft()[1])
        t_ns = tick_ns(k, self._rules.rate_hz)
        step = advance_hand(
            rules=self._rules,
            memory=self._memory,
            t_ns=t_ns,
            commands=commands,
            place=lambda: self._place(angles()),
        )
        self._memory = step.memory
        return step

    def advance_span(self, k: int, end: int, angles: Callable[[], Sequence[float]]) -> Array:
        """Returns what it does from tick k until it needs the arm again, before tick `end`.

        Of each tick there is a row, as `HandInForce`. The same as `advance_to` tick by tick, bit
        for bit.
        """
        size = self._rules.size
        rate_hz = self._rules.rate_hz
        first = self.advance_to(k, angles).vector
        rows = np.zeros((max(min(self.find_next_event(k), end), k + 1) - k, 3 + 2 * size))
        rows[0] = first
        held = self._memory
        if held.source and tick_ns(k + len(rows) - 1, rate_hz) - held.received_ns <= SILENCE_NS:
            goal, target, rate = (np.array(one) for one in (held.goal, held.target, held.rate))
            grip = glide(
                first=k + 1,
                rate_hz=rate_hz,
                grip=held.grip,
                arrives_ns=held.arrives_ns,
                speed_limit=self._rules.speed_limit,
                acceleration=self._rules.acceleration_limit,
                goal=goal,
                target=target,
                rate=rate,
                rows=rows[1:],
            )
            rows[1:, 1] = held.number
            rows[1:, 2] = held.source
            ends = tuple(target.tolist()), tuple(rate.tolist())
            self._memory = held._replace(grip=grip, target=ends[0], rate=ends[1])
        else:
            for n in range(1, len(rows)):
                rows[n] = self.advance_to(k + n, angles).vector
        return rows

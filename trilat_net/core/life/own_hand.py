"""Lets a user's program move an arm in place of a human operator.

The program is a class with a method `act`. At a fixed rate, `act` receives a `HandView` with
the data available at the site, such as joint angles and forces, and returns a target towards
which the arm is pulled, or a force on the arm. This allows a learned policy or a model of a
human to operate a master arm.

Invariant:
    - A decision based on tick k takes effect a fixed time after tick k, wherever the program
      runs. A decision that arrives later takes effect at once.
    - The action is an input of the tick and is stored with it, so a run can be repeated from
      its log without the program.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...errors import count_nouns
from ..plug.user_law import PeerView
from ..step.site_arrays import SiteArrays
from ..step.site_setup import Layout
from ..step.ticks import tick_ns
from ..step.vectors import Array
from .live_hand import SILENCE_NS, HandCommand, HandMemory, HandRules, HandStep, glide

PROGRAM = 1
"""Source recorded for each action of a hand program."""


class HandContext(NamedTuple):
    """Facts about the arm that a user's program receives before it moves the arm.

    >>> class Still:
    ...     def __init__(self, facts: tn.HandContext) -> None:
    ...         self.size = facts.size
    ...     def act(self, now: tn.HandView) -> list[float]:
    ...         return [0.0] * self.size

    Attributes:
        site: Name of the site whose arm the program moves.
        peers: Names of the peers, in scenario order.
        mode: "tip" if the program moves the end effector, "joint" if it moves the joints,
            "force" if it applies a force.
        size: Number of components of an action: one per axis, m or N, or one per joint, rad.
        rate_hz: Rate of decisions, Hz.
        delay_s: Time from a `HandView` until the action based on it takes effect, s.
        speed_limit: Largest speed of the target, m/s or rad/s; inf in force mode.
        limit: Largest force, N, or largest norm of the torques, N m.
        seed: Seed for random numbers, derived from the scenario and the site.
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
    """Data that a user's program receives for each decision about an arm.

    >>> def act(self, now: tn.HandView) -> list[float]:
    ...     return now.pose + 0.3 * (self.goal_m - now.pose)

    Attributes:
        k: Number of the tick (control period).
        t_s: Nominal time of the tick since the start of the session, s.
        q: Joint angles of the arm, rad, shape (n,).
        qd: Joint velocities, rad/s.
        pose: Pose of the arm in the coordinates in which the program acts: end effector
            position, m, or joint angles, rad.
        q_des: Reference of the previous tick, rad or m, shape (m,).
        tau_x: External torque of the previous tick, N m; the torque ON the arm is its negative.
        target: Current target towards which the arm is pulled, m or rad, or the force, N; zeros
            while nothing pulls the arm.
        grip: Firmness of the program's grip on the arm, 0 to 1.
        peers: Data of the peers in scenario order, from the samples in use at the previous
            tick. The vectors q and qd of a peer have shape (m,). The ages refer to tick k.
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
    """Interface of a user's program that moves an arm in place of a human operator.

    The class is instantiated with a `HandContext` and with the program's settings as keyword
    arguments.
    """

    def act(self, now: HandView) -> Sequence[float] | None:
        """Decides where to pull the arm, given the data available at this moment.

        Called at regular intervals, for example 50 times per second.

        Args:
            now: State of the arm, of the target towards which it is pulled, and of the other
                arms.

        Returns:
            Depending on the mode, the target of the end effector, m, the target of the joints,
            rad, or a force, N. `None` releases the arm.
        """


class OwnHand:
    """Runs a user's program that moves an arm in a simulation or a live session.

    At regular intervals, the program receives a view of the site's data and decides where to
    pull the arm. The decision takes effect after a delay, similar to the reaction time of a
    person.

    Args:
        rules: Limits on the program's actions.
        period_ticks: Time between decisions, in ticks.
        delay_ticks: Time from a view until the action based on it takes effect, in ticks.
        locate: Function that computes the pose of the arm from its joint angles, in the
            coordinates in which the program acts.
    """

    def __init__(
        self,
        rules: HandRules,
        period_ticks: int,
        delay_ticks: int,
        locate: Callable[[Sequence[float]], Sequence[float]],
    ) -> None:
        self._rules = rules
        self.period_ticks = period_ticks
        self.delay_ticks = delay_ticks
        self._locate = locate
        self._due: deque[tuple[int, HandCommand]] = deque()
        self._memory = HandMemory()
        self._newest = -1

    def is_decision_tick(self, k: int) -> bool:
        """Returns True if the user's program makes a decision in tick k.

        This is every `period_ticks`-th tick: 0, 20, 40 and so on for a program that decides 50
        times per second at a tick rate of 1 kHz.
        """
        return k % self.period_ticks == 0

    def find_next_event(self, k: int) -> int:
        """Returns the next tick after `k` in which a decision is made or takes effect.

        The ticks before that tick can be computed by one compiled call of `advance_span`.
        """
        next_decision = (k // self.period_ticks + 1) * self.period_ticks
        next_actions = [due for due, _ in self._due if due > k]
        return min([next_decision, *next_actions])

    def build_view(self, k: int, arrays: SiteArrays, layout: Layout) -> HandView:
        """Collects the data that the user's program may use for its decision.

        The data are the state of the program's own arm and the newest states received from
        other arms.

        Args:
            k: Tick of the decision, whose results have not been computed yet.
            arrays: State of the site after the previous tick.
            layout: Lengths of the site's vectors.
        """
        # NumPy reads fields of plain arrays faster than those of records.
        site = np.asarray(arrays.site)
        links = np.asarray(arrays.links)
        joints = layout.joints
        shared = layout.shared
        # Copies, because the program may keep the view while the arrays change.
        q = site["q"][0, :joints].copy()
        pose = self._locate(q.tolist())
        no_target = (0.0,) * self._rules.size
        return HandView(
            k=k,
            t_s=k / self._rules.rate_hz,
            q=q,
            qd=site["qd"][0, :joints].copy(),
            pose=np.asarray(pose, dtype=np.float64),
            q_des=site["q_des"][0, :shared].copy(),
            # The program gets the negative of the torque ON the arm, as in the records.
            tau_x=0.0 - site["on_arm"][0, :joints],
            target=np.array(self._memory.target or no_target),
            grip=self._memory.grip,
            peers=self._view_peers(k, links, shared),
        )

    def _view_peers(self, k: int, links: Any, coordinates: int) -> tuple[PeerView, ...]:
        """Returns the data about the other arms that the user's program may use.

        These are the delayed states of the other arms that this arm used in the previous tick.

        Args:
            k: Number of the tick of the decision.
            links: State of each link, one row per peer.
            coordinates: Number of coordinates of a sample.
        """
        now_ns = tick_ns(k, self._rules.rate_hz)
        q = links["q"][:, :coordinates].copy()
        qd = links["qd"][:, :coordinates].copy()
        tau_x = links["tau_x"][:, :coordinates].copy()
        # Lists are faster to read number by number than arrays.
        alpha = links["alpha"].tolist()
        used_ticks = links["used"].tolist()
        rates_hz = links["rate_hz"].tolist()
        new = links["new"].tolist()
        peers = []
        for j in range(len(links)):
            # Before the first sample (tick -1), the age counts from the start of the session.
            sent_ns = tick_ns(max(used_ticks[j], 0), rates_hz[j])
            peers.append(
                PeerView(
                    alpha=alpha[j],
                    tick=used_ticks[j],
                    age_s=(now_ns - sent_ns) * 1e-9,
                    new=new[j],
                    q=q[j],
                    qd=qd[j],
                    tau_x=tau_x[j],
                )
            )
        return tuple(peers)

    def accept_decision(self, k: int, goal: Sequence[float] | None) -> None:
        """Checks a decision of the user's program, and schedules it to take effect later.

        The delay corresponds to a reaction time. The decision is ignored if a decision based on
        a newer view has already been accepted.

        Args:
            k: Tick of the view on which the decision is based.
            goal: Position towards which the program pulls the arm, m or rad, or the force, N.
                None releases the arm.

        Raises:
            ValueError: The goal has the wrong number of coordinates, is not finite, or is too
                large.
        """
        holds_arm = goal is not None
        numbers: tuple[float, ...] = ()
        if goal is not None:
            numbers = tuple(float(number) for number in goal)
        if holds_arm and len(numbers) != self._rules.size:
            count = count_nouns(len(numbers), "number")
            raise ValueError(f"the action has {count}, not {self._rules.size}")
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"the action {list(numbers)} is not finite")
        norm = math.hypot(*numbers)
        largest_norm = self._rules.max_goal_norm
        if norm > largest_norm:
            raise ValueError(
                f"the action has a norm of {norm:g}, but at most {largest_norm:g} is accepted"
            )
        is_outdated = k <= self._newest
        if is_outdated:
            return

        self._newest = k
        self._schedule(k, k + self.delay_ticks, numbers, grip=holds_arm)

    def release(self, k: int) -> None:
        """Makes the program release the arm in tick k.

        Decisions that have not yet taken effect are cancelled.
        """
        self._due.clear()
        self._schedule(k, k, (), grip=False)

    def _schedule(self, k: int, due: int, target: tuple[float, ...], *, grip: bool) -> None:
        """Stores a decision of the user's program until the tick in which it takes effect.

        The delay imitates the reaction time of a person.

        Args:
            k: Tick of the view on which the decision is based.
            due: Tick in which the decision takes effect.
            target: Target or force; empty if the arm is released.
            grip: True if the program holds the arm.
        """
        command = HandCommand(
            source=PROGRAM,
            number=k // self.period_ticks,
            grip=grip,
            target=target,
            sent_ns=tick_ns(due, self._rules.rate_hz),
        )
        self._due.append((due, command))

    def advance_to(self, k: int, read_angles: Callable[[], Sequence[float]]) -> HandStep:
        """Computes how the user's program pulls the arm in tick k.

        Decisions whose reaction time has passed take effect. Then the target towards which the
        arm is pulled advances by one tick.

        Args:
            k: Number of the tick, which must directly follow the tick of the previous call.
            read_angles: Function that returns the joint angles, rad.

        Returns:
            The action in this tick and the state for the next tick. See `HandRules.advance`.
        """
        # The commands whose delay has passed, in order.
        commands = []
        while self._due:
            due, command = self._due[0]
            if due > k:
                break
            self._due.popleft()
            commands.append(command)
        step = self._rules.advance(
            memory=self._memory,
            t_ns=tick_ns(k, self._rules.rate_hz),
            commands=commands,
            locate=lambda: self._locate(read_angles()),
        )
        self._memory = step.memory
        return step

    def advance_span(
        self, k: int, end: int, read_angles: Callable[[], Sequence[float]]
    ) -> Array:
        """Computes how the program pulls the arm over several ticks in one compiled call.

        The span ends before the next tick in which the program decides or a decision takes
        effect. The results are identical to those of repeated calls of `advance_to`.

        Args:
            k: The first tick.
            end: Upper bound of the span, exclusive.
            read_angles: Function that returns the joint angles in tick k, rad.

        Returns:
            One row per tick, in the form of `HandInForce`.
        """
        size = self._rules.size
        rate_hz = self._rules.rate_hz
        first_row = self.advance_to(k, read_angles).vector
        span_end = min(self.find_next_event(k), end)
        span_end = max(span_end, k + 1)
        rows = np.zeros((span_end - k, 3 + 2 * size))
        rows[0] = first_row
        memory = self._memory
        is_held = memory.source != 0
        silence_ns = tick_ns(span_end - 1, rate_hz) - memory.received_ns
        if not is_held or silence_ns > SILENCE_NS:
            # The program does not hold the arm, or its silence may end its grip.
            for n in range(1, len(rows)):
                rows[n] = self.advance_to(k + n, read_angles).vector
            return rows

        target = np.array(memory.target)
        rate = np.array(memory.rate)
        grip = glide(
            first=k + 1,
            rate_hz=rate_hz,
            grip=memory.grip,
            arrives_ns=memory.arrives_ns,
            speed_limit=self._rules.speed_limit,
            acceleration=self._rules.acceleration_limit,
            goal=np.array(memory.goal),
            target=target,
            rate=rate,
            rows=rows[1:],
        )
        rows[1:, 1] = memory.number
        rows[1:, 2] = memory.source
        self._memory = memory._replace(
            grip=grip, target=tuple(target.tolist()), rate=tuple(rate.tolist())
        )
        return rows

"""Receives the commands of the operator who moves an arm, in the process of the arm's site.

An operator is a person or a program that sends messages with a target position or a force over
the network. `HandServer` receives the commands of people and programs that connect to the
session. `RemoteHand` receives those of a user's Python class that runs in its own process, and
sends the state of the arm to that process.

Invariant:
    - A message cannot raise an error in the control loop. Each tick reads a limited number of
      messages, so a flood of messages does not delay it. Rejected messages are counted per
      reason.
    - Only one operator at a time moves the arm, and the site limits the motion of the target as
      specified in the scenario. The sender of a message cannot circumvent these rules.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from trilat_net.core import HandCommand, MotionLimits, Site, SiteArrays, tick_ns
from trilat_net.errors import SessionError, WireError, count_nouns
from trilat_net.net import Clock, HandMessage, HandViewMessage, Inbox, PeerSeen, decode, encode
from trilat_net.scenario import ArmModel, HandPlayer, HandSite, LiveHand

MESSAGES_KEPT = 32
"""Number of messages that the queue can hold, and maximum number read in one tick.

If the queue is full, the oldest message is dropped.
"""
POLL_NS = 5_000_000
"""Interval between polls while the site waits for the operator's process, in ns."""


def _read_messages(
    inbox: Inbox,
    site: str,
    dropped: Counter[str],
    source: str | None = None,
) -> Iterator[HandMessage]:
    """Yields an operator's messages that have arrived, and counts those that are dropped.

    Only a limited number is read in each tick, so that a flood of messages does not delay the
    control loop.

    Args:
        inbox: Queue of the messages.
        site: Name of the site to which the messages must be addressed.
        dropped: Mapping from reason to number of dropped messages. The counts are increased in
            place.
        source: Only accepted sender. If None, all senders are accepted.
    """
    for _ in range(MESSAGES_KEPT):
        timed_payload = inbox.poll()
        if timed_payload is None:
            return
        _, payload = timed_payload

        try:
            message = decode(payload, HandMessage)
        except WireError as error:
            dropped[f"hand: {error.reason}"] += 1
            continue

        if message.site == site and source in (None, message.source):
            yield message
        else:
            dropped["hand: stranger"] += 1


class HandServer:
    """Moves the arm of a site as requested by people and programs that connect to the session.

    Only one of these operators can move the arm at a time.

    Args:
        site: Object that computes the ticks of the site.
        hand: Settings in the scenario for operators that connect during the session.
        arm: Arm of the site.
        inbox: Queue of the operators' messages.
        dropped: Mapping from reason to number of dropped messages. The counts are increased in
            place.
        limits: Limits of the motion of the site. None if there are none.

    Attributes:
        news: Pairs of a tick number and a sentence. A pair is added when an operator takes hold
            of the arm or releases it. The site publishes them as events and empties the list.
    """

    def __init__(
        self,
        site: Site,
        hand: LiveHand,
        arm: ArmModel,
        inbox: Inbox,
        dropped: Counter[str],
        limits: MotionLimits | None = None,
    ) -> None:
        self._site = site.name
        self._hand = hand
        self._inbox = inbox
        self._dropped = dropped
        self._rules = hand.make_rules(site.rate_hz, arm, limits)
        # Pose of the arm in the coordinates of the operator's target.
        self._compute_pose = lambda: (
            site.q if hand.mode == "joint" else arm.end_effector(site.q)
        )
        start = self._rules.start()
        self._memory = start.memory
        self._free_state = start.vector  # used if nobody moves the arm
        self._names: dict[int, str] = {}  # names of the senders, by their boots
        self.news: list[tuple[int, str]] = []

    def track(self, _site: Site, tick: int) -> list[float]:
        """Processes the pending messages of operators, and returns how to move the arm.

        The control loop calls this method in every tick.

        Args:
            tick: Number of the tick.

        Returns:
            The operator who moves the arm, and the target or force, as a list of floats for the
            computation of the tick. The format is described in `HandInForce.read`.
        """
        messages = _read_messages(self._inbox, self._site, self._dropped)
        parsed = [self._parse_command(message) for message in messages]
        commands = [command for command in parsed if command is not None]
        if not commands and not self._memory.target:
            return self._free_state

        t_ns = tick_ns(tick, self._rules.rate_hz)
        step = self._rules.advance(
            memory=self._memory,
            t_ns=t_ns,
            commands=commands,
            locate=self._compute_pose,
        )
        self._memory = step.memory

        for reason in step.refused:
            self._dropped[reason] += 1
        for source, change in step.changes:
            name = self._names.get(source, f"hand {source:08x}")
            self.news.append(
                (tick, f"{self._site}: {name} {change} at t = {t_ns * 1e-9:.3f} s")
            )
        return step.vector

    def _parse_command(self, message: HandMessage) -> HandCommand | None:
        """Checks a message from an operator who moves the arm, and converts it to a command.

        The operator's goal is either a target position or a force, depending on the scenario. A
        message without a grip releases the arm.

        Args:
            message: The message.

        Returns:
            The command, or None if the message is rejected: because it contains a force instead
            of a target or vice versa, has the wrong number of coordinates, or is out of range.
        """
        if self._hand.mode == "force":
            noun = "force"
            goal = message.force
            other_goal = message.target
        else:
            noun = "target"
            goal = message.target
            other_goal = message.force

        is_wrong_goal = bool(other_goal) or len(goal) != self._rules.size
        if message.grip and is_wrong_goal:
            size = count_nouns(self._rules.size, "number")
            self._dropped[f"hand: no {noun} of {size}"] += 1
            return None
        if message.grip and math.hypot(*goal) > self._rules.max_goal_norm:
            self._dropped["hand: out of range"] += 1
            return None

        if len(self._names) > MESSAGES_KEPT and message.boot not in self._names:
            # Only the holder's name is kept, so that many senders cannot fill the memory.
            holder = self._memory.source
            self._names = {holder: self._names[holder]} if holder else {}
        self._names[message.boot] = message.source or f"hand {message.boot:08x}"
        return HandCommand(
            source=message.boot,
            number=message.n,
            grip=message.grip,
            target=tuple(goal),
            sent_ns=message.sent_ns,
        )


class RemoteHand(HandPlayer):
    """Moves the arm of a site as decided by a user's Python class in another process.

    At regular intervals, the site sends a view (its current state) to that process. The process
    replies with its decision: a target, a force, or to release the arm. The decision takes
    effect a fixed time after the tick of the view. If it arrives too late, it takes effect at
    once and is counted. Only decisions of the class named in the scenario are accepted.

    Args:
        hand_site: Site whose arm the operator moves, and settings of the user's class.
        boot: Random number that identifies this start of the site.
        inbox: Queue of the decisions.
        publish: Function that publishes a view.
        dropped: Mapping from reason to number of dropped and late messages. The counts are
            increased in place.
        clock: Clock of this process.
    """

    def __init__(
        self,
        hand_site: HandSite,
        boot: int,
        inbox: Inbox,
        publish: Callable[[bytes], None],
        dropped: Counter[str],
        clock: Clock,
    ) -> None:
        super().__init__(hand_site, None)
        self._boot = boot
        self._inbox = inbox
        self._publish = publish
        self._dropped = dropped
        self._clock = clock
        self._asked_tick = -1  # tick of the newest view that was sent
        self._source = hand_site.source

    def track(self, site: Site, tick: int) -> list[float]:
        """Reads the newest decision of the user's operator class on how to move the arm.

        The control loop calls this method in every tick.

        Args:
            site: Object that computes the ticks of the site.
            tick: Number of the tick.

        Returns:
            The target or force on the arm, as a list of floats for the computation of the tick.
            The format is described in `HandInForce.read`.
        """
        for message in self._read_decisions():
            self._decide(tick, message)
        return super().track(site, tick)

    def request_action(self, tick: int, arrays: SiteArrays) -> None:
        """Sends the state of the arm to the user's operator class, to request a new decision.

        The control loop does not wait for the reply, which `track` reads in a later tick.

        Args:
            tick: Number of the current tick.
            arrays: State of the site in this tick, from which the message is composed.
        """
        view = self.view(tick, arrays)
        fields = _list_numbers(view)
        fields["peers"] = [PeerSeen(**_list_numbers(peer)) for peer in view.peers]
        message = HandViewMessage(site=self._site, boot=self._boot, **fields)
        self._publish(encode(message))
        self._asked_tick = tick

    def wait_for_first(
        self, stopped: Callable[[], bool], give_up_ns: int, say: Callable[[str], None]
    ) -> bool:
        """Waits until the process of the user's operator class announces itself.

        The session must not start earlier, because nobody could move the arm.

        Args:
            stopped: Function that returns True to end the wait.
            give_up_ns: Time at which the site gives up, on the local clock, in ns.
            say: Function that prints a line for the user.

        Returns:
            True if the process has announced itself, or False if `stopped` returned True.

        Raises:
            SessionError: The process did not announce itself in time.
        """
        say(f"waits for its hand {self._code}: trilat hand {self._site} --scenario FILE")
        while not stopped():
            if any(self._read_decisions()):
                return True
            if self._clock.monotonic_ns() > give_up_ns:
                raise SessionError(
                    f"{self._site} received no message from its hand {self._code}"
                )
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
        return False

    def _read_decisions(self) -> Iterator[HandMessage]:
        """Yields the received decisions of a user's operator class on how to move the arm.

        Invalid messages, and messages from other processes, are dropped and counted.
        """
        return _read_messages(self._inbox, self._site, self._dropped, self._source)

    def _decide(self, present_tick: int, message: HandMessage) -> None:
        """Schedules a decision of the user's class to take effect at its planned tick.

        A decision that arrives after this tick is counted as late, and takes effect at once.
        Decisions about views that were never sent are ignored, as are all decisions after a
        failure.

        Args:
            present_tick: Current tick.
            message: The decision. Its number n refers to the view of tick n * `period_ticks`.
                Without a grip, it releases the arm.
        """
        view_tick = message.n * self.hand.period_ticks
        # The process announces itself with a message that contains no decision. It may arrive
        # after the first view was sent.
        is_announcement = message.n == 0 and not message.grip
        refers_to_future = view_tick > self._asked_tick
        if self.failure or is_announcement or refers_to_future:
            return

        is_late = view_tick + self.hand.delay_ticks < present_tick
        if is_late:
            self._dropped["hand: late"] += 1

        target_or_force = None  # releases the arm
        if message.grip:
            target_or_force = message.target or message.force  # one of them is empty
        try:
            self.hand.accept_decision(view_tick, target_or_force)
        except ValueError as error:
            self.fail(present_tick, str(error))


def _list_numbers(view: Any) -> dict[str, Any]:
    """Converts the state of an arm to fields of types that a network message can contain.

    Arrays become lists. The message is sent to a user's operator class.
    """
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in view._asdict().items()
    }

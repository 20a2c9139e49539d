"""The messages of whoever holds a site's arm, as the site receives them.

Invariant:
    - No message can raise out of the loop, and a tick reads few of them.
    - The site limits the motion of the hand, whatever the sender requests: `HandRules` and the
      limits of the operator hold, and only one hand holds the arm at a time.
    - Refused messages are counted by reason.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from trilat_net.core.live_hand import HandCommand, HandMemory, advance_hand, empty_hand_vector
from trilat_net.core.site_arrays import SiteArrays
from trilat_net.core.site_setup import MotionLimits
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import tick_ns
from trilat_net.errors import SessionError, WireError, count_nouns
from trilat_net.net.bus import Inbox
from trilat_net.net.clock import Clock
from trilat_net.net.requests import HandMessage, HandViewMessage, PeerSeen
from trilat_net.net.wire import decode, encode
from trilat_net.scenario.arms import ArmModel
from trilat_net.scenario.operators.kernel_operators import LiveHand
from trilat_net.scenario.operators.program_hand import HandPlayer, HandSite

MESSAGES_KEPT = 32
"""Capacity of the inbox, and largest number of messages that a tick reads.

Newer messages push older ones out.
"""
POLL_NS = 5_000_000


def _read_messages(
    inbox: Inbox, site: str, dropped: Counter[str], source: str | None = None
) -> Iterator[HandMessage]:
    """Yields the hand messages to a site, and counts those that are dropped.

    Args:
        inbox: the inbox of the hand messages.
        site: the name of the site.
        dropped: counts dropped messages by reason.
        source: the only accepted sender; None accepts all.
    """
    for _ in range(MESSAGES_KEPT):
        if (waiting := inbox.poll()) is None:
            return
        try:
            message = decode(waiting[1], HandMessage)
        except WireError as error:
            dropped[f"hand: {error.reason}"] += 1
            continue
        if message.site == site and source in (None, message.source):
            yield message
        else:
            dropped["hand: stranger"] += 1


class HandServer:
    """The live hand of one site.

    Args:
        site: the kernel's site.
        hand: the live hand of the scenario.
        arm: the arm of the site.
        inbox: the inbox of the hand messages.
        dropped: counts dropped messages by reason.
        limits: the limits of the site's motion.

    Attributes:
        news: who has taken hold of the arm or released it: ticks, and sentences that no event
            holds yet.
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
        self._compute_pose = lambda: (
            site.q if hand.mode == "joint" else arm.end_effector(site.q)
        )
        self._memory = HandMemory()
        self._free_state = empty_hand_vector(self._rules.size)
        self._names: dict[int, str] = {}
        self.news: list[tuple[int, str]] = []

    def track(self, _site: Site, k: int) -> list[float]:
        """Returns the state of the hand at tick `k`, by the received messages.

        `HandInForce` describes the numbers of that state.
        """
        messages = _read_messages(self._inbox, self._site, self._dropped)
        parsed = [self._parse_command(message) for message in messages]
        commands = [command for command in parsed if command is not None]
        if not commands and not self._memory.target:
            return self._free_state
        t_ns = tick_ns(k, self._rules.rate_hz)
        step = advance_hand(
            rules=self._rules,
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
            self.news.append((k, f"{self._site}: {name} {change} at t = {t_ns * 1e-9:.3f} s"))
        return step.vector

    def _parse_command(self, message: HandMessage) -> HandCommand | None:
        """Returns the command of a message; None if it is refused."""
        if self._hand.mode == "force":
            noun = "force"
            goal = message.force
            other_goal = message.target
        else:
            noun = "target"
            goal = message.target
            other_goal = message.force
        if message.grip and (other_goal or len(goal) != self._rules.size):
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
    """A hand of the user's own that runs in a process of its own.

    The site sends it views, and receives its decisions. Only messages of the program that the
    scenario names are accepted. A decision that arrives too late acts at once, and is counted.

    Args:
        hand_site: the site of the hand, and the settings of its class.
        boot: the boot of this process.
        inbox: the inbox of the hand's decisions.
        publish: publishes a view.
        dropped: counts dropped and late messages by reason.
        clock: the clock of this process.
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
        self._asked_tick = -1
        self._source = hand_site.source

    def track(self, site: Site, k: int) -> list[float]:
        """Returns the state of the hand at tick `k`, by the received decisions."""
        for message in self._read_decisions():
            self._decide(k, message)
        return super().track(site, k)

    def request_action(self, k: int, arrays: SiteArrays) -> None:
        """Sends the hand the view of tick `k`."""
        view = self.view(k, arrays)
        fields = _list_numbers(view)
        fields["peers"] = [PeerSeen(**_list_numbers(peer)) for peer in view.peers]
        self._publish(encode(HandViewMessage(site=self._site, boot=self._boot, **fields)))
        self._asked_tick = k

    def wait_for_first(
        self, stopped: Callable[[], bool], give_up_ns: int, say: Callable[[str], None]
    ) -> bool:
        """Waits for the hand's program; returns False if `stopped` returns True first.

        Raises:
            SessionError: the program did not announce itself before `give_up_ns`.
        """
        say(f"waits for its hand {self._code}: trilat hand {self._site} --scenario FILE")
        while not stopped():
            if any(self._read_decisions()):
                return True
            if self._clock.monotonic_ns() > give_up_ns:
                raise SessionError(f"{self._site} waited in vain for its hand {self._code}")
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
        return False

    def _read_decisions(self) -> Iterator[HandMessage]:
        return _read_messages(self._inbox, self._site, self._dropped, self._source)

    def _decide(self, k: int, message: HandMessage) -> None:
        """Applies a decision at tick `k`; the message names the tick whose view it answers."""
        asked_tick = message.n * self.hand.period_ticks
        # The announcement of the program may arrive after the first view; it decides nothing.
        is_announcement = message.n == 0 and not message.grip
        if self.failure or is_announcement or asked_tick > self._asked_tick:
            return
        if asked_tick + self.hand.delay_ticks < k:
            self._dropped["hand: late"] += 1
        goal = (message.target or message.force) if message.grip else None
        try:
            self.hand.accept_decision(asked_tick, goal)
        except ValueError as error:
            self.fail(k, str(error))


def _list_numbers(view: Any) -> dict[str, Any]:
    """Returns the fields of a view by name, with arrays as lists."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in view._asdict().items()
    }

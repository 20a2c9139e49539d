"""The messages of whoever holds a site's arm, as the site receives them.

Invariant: no message can raise out of the loop, and few are read in one tick. What somebody
wants is limited here, whatever the sender says: `HandRules` and the operator's limits hold, and
one of them holds the arm at a time. What is refused is counted by reason.
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
"""Capacity of the inbox, and most messages that a tick reads: newer ones push older ones out.
"""
POLL_NS = 5_000_000


def _read_messages(
    inbox: Inbox, site: str, dropped: Counter[str], source: str | None = None
) -> Iterator[HandMessage]:
    """Yields the messages to a site of hands, or of one source; counts those that it drops."""
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

    `news` are ticks, and sentences on who has taken hold and let go that no event names yet.
    `limits` are those of the site's motion.
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
        self._place = lambda: site.q if hand.mode == "joint" else arm.end_effector(site.q)
        self._memory = HandMemory()
        self._free = empty_hand_vector(self._rules.size)
        self._names: dict[int, str] = {}
        self.news: list[tuple[int, str]] = []

    def track(self, _site: Site, k: int) -> list[float]:
        """Returns what the hand does in tick k, by the messages that have come; see
        `HandInForce`.
        """
        came = _read_messages(self._inbox, self._site, self._dropped)
        commands = [command for message in came if (command := self._read(message)) is not None]
        if not commands and not self._memory.target:
            return self._free
        t_ns = tick_ns(k, self._rules.rate_hz)
        step = advance_hand(
            rules=self._rules,
            memory=self._memory,
            t_ns=t_ns,
            commands=commands,
            locate=self._place,
        )
        self._memory = step.memory
        for reason in step.refused:
            self._dropped[reason] += 1
        for source, change in step.changes:
            name = self._names.get(source, f"hand {source:08x}")
            self.news.append((k, f"{self._site}: {name} {change} at t = {t_ns * 1e-9:.3f} s"))
        return step.vector

    def _read(self, message: HandMessage) -> HandCommand | None:
        pushes = self._hand.mode == "force"
        target, other = (message.force, message.target)[:: 1 if pushes else -1]
        if message.grip and (other or len(target) != self._rules.size):
            self._dropped[
                f"hand: no {'force' if pushes else 'target'} of {count_nouns(self._rules.size, 'number')}"
            ] += 1
        elif message.grip and math.hypot(*target) > self._rules.max_goal_norm:
            self._dropped["hand: out of range"] += 1
        else:
            if len(self._names) > MESSAGES_KEPT and message.boot not in self._names:
                kept = self._memory.source
                self._names = {kept: self._names[kept]} if kept else {}
            self._names[message.boot] = message.source or f"hand {message.boot:08x}"
            return HandCommand(
                source=message.boot,
                number=message.n,
                grip=message.grip,
                target=tuple(target),
                sent_ns=message.sent_ns,
            )
        return None


class RemoteHand(HandPlayer):
    """A hand of one's own in a process of its own, which is sent what it sees and sends what it
    decides.

    Of what comes only the program of its class is taken; what is decided too late acts at once,
    and counts.
    """

    def __init__(
        self,
        at: HandSite,
        boot: int,
        inbox: Inbox,
        publish: Callable[[bytes], None],
        dropped: Counter[str],
        clock: Clock,
    ) -> None:
        super().__init__(at, None)
        self._boot = boot
        self._inbox = inbox
        self._publish = publish
        self._dropped = dropped
        self._clock = clock
        self._asked = -1
        self._source = at.source

    def track(self, site: Site, k: int) -> list[float]:
        """Returns what it does in tick k, by the decisions that have come."""
        for message in self._read():
            self._decide(k, message)
        return super().track(site, k)

    def request_action(self, k: int, arrays: SiteArrays) -> None:
        """Sends it what it sees."""
        view = self.view(k, arrays)
        seen = _list_numbers(view) | {
            "peers": [PeerSeen(**_list_numbers(one)) for one in view.peers]
        }
        self._publish(encode(HandViewMessage(site=self._site, boot=self._boot, **seen)))
        self._asked = k

    def wait_for_first(
        self, stopped: Callable[[], bool], give_up_ns: int, say: Callable[[str], None]
    ) -> bool:
        """Waits until its program is there; False if `stopped` comes first.

        Raises:
            SessionError: it did not come in time.
        """
        say(f"waits for its hand {self._code}: trilat hand {self._site} --scenario FILE")
        while not stopped():
            if any(self._read()):
                return True
            if self._clock.monotonic_ns() > give_up_ns:
                raise SessionError(f"{self._site} waited in vain for its hand {self._code}")
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
        return False

    def _read(self) -> Iterator[HandMessage]:
        return _read_messages(self._inbox, self._site, self._dropped, self._source)

    def _decide(self, k: int, message: HandMessage) -> None:
        asked = message.n * self.hand.period_ticks
        # that it is here may come after the first question, and decides nothing
        is_here = message.n == 0 and not message.grip
        if self.failure or is_here or asked > self._asked:
            return
        self._dropped.update(["hand: late"] * (asked + self.hand.delay_ticks < k))
        try:
            self.hand.accept_decision(
                asked, (message.target or message.force) if message.grip else None
            )
        except ValueError as error:
            self.fail(k, str(error))


def _list_numbers(view: Any) -> dict[str, Any]:
    return {
        k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in view._asdict().items()
    }

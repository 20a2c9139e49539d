"""The messages of whoever holds a site's arm, as the site receives them.

Invariant: no message can raise out of the loop, and few are read in one tick. What somebody wants is limited
here, whatever the sender says: `HandRules` and the operator's limits hold, and one of them holds the arm at a
time. What is refused is counted by reason.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence

from trilat_net.core.live_hand import HandCommand, HandMemory, advance_hand, free_hand
from trilat_net.core.ticks import tick_ns
from trilat_net.errors import WireError
from trilat_net.net.bus import Inbox
from trilat_net.net.requests import HandMessage
from trilat_net.net.wire import decode
from trilat_net.scenario.arms import ArmModel
from trilat_net.scenario.operators.kernel_operators import LiveHand

MESSAGES_KEPT = 32
"""Capacity of the inbox, and most messages that a tick reads: newer ones push older ones out."""


class HandServer:
    """The live hand of one site.

    `angles` returns the joint angles at the tick that is about to be made, rad; `news` are ticks, and
    sentences on who has taken hold and let go that no event names yet.
    """

    def __init__(
        self,
        site: str,
        rate_hz: int,
        hand: LiveHand,
        arm: ArmModel,
        inbox: Inbox,
        dropped: Counter[str],
        angles: Callable[[], Sequence[float]],
    ) -> None:
        self._site, self._hand, self._inbox, self._dropped = site, hand, inbox, dropped
        self._rules = hand.rules(rate_hz, arm.counts)
        self._place = angles if hand.mode == "joint" else lambda: arm.end_effector(angles())
        self._memory = HandMemory()
        self._free = free_hand(self._rules.size)
        self._names: dict[int, str] = {}
        self.news: list[tuple[int, str]] = []

    def take(self, k: int) -> list[float]:
        """Returns what the hand does in tick k, by the messages that have come; see `HandInForce`."""
        commands = []
        for _ in range(MESSAGES_KEPT):
            if (message := self._inbox.poll()) is None:
                break
            if (command := self._read(message[1])) is not None:
                commands.append(command)
        if not commands and not self._memory.target:
            return self._free
        t_ns = tick_ns(k, self._rules.rate_hz)
        step = advance_hand(self._rules, self._memory, t_ns, commands, self._place)
        self._memory = step.memory
        for reason in step.refused:
            self._dropped[reason] += 1
        for source, change in step.changes:
            name = self._names.get(source, f"hand {source:08x}")
            self.news.append((k, f"{self._site}: {name} {change} at t = {t_ns * 1e-9:.3f} s"))
        return step.vector

    def _read(self, payload: bytes) -> HandCommand | None:
        try:
            message = decode(payload, HandMessage)
        except WireError as error:
            self._dropped[f"hand: {error.reason}"] += 1
            return None
        pushes = self._hand.mode == "force"
        target, other = (message.force, message.target)[:: 1 if pushes else -1]
        if message.site != self._site:
            self._dropped["hand: stranger"] += 1
        elif message.grip and (other or len(target) != self._rules.size):
            self._dropped[f"hand: no {'force' if pushes else 'target'} of {self._rules.size} numbers"] += 1
        elif message.grip and math.hypot(*target) > self._rules.farthest:
            self._dropped["hand: out of range"] += 1
        else:
            if len(self._names) > MESSAGES_KEPT and message.boot not in self._names:
                kept = self._memory.source
                self._names = {kept: self._names[kept]} if kept else {}
            self._names[message.boot] = message.source or f"hand {message.boot:08x}"
            return HandCommand(message.boot, message.n, message.grip, tuple(target), message.sent_ns)
        return None

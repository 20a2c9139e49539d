"""The end of a site: it reports how its run ended and waits for the recorders.

Invariant: the wait ends when every recorder present has all messages that it can have, and it is bounded.
"""

import signal
from collections.abc import Sequence

from trilat_net.core.ticks import NS_PER_S, Mode, TickRecord, describe_divergence
from trilat_net.errors import PeerLeft, RunFailed
from trilat_net.net import topics
from trilat_net.net.membership import EventPublisher

from .site_parts import SiteParts

LINGER_NS = 5 * NS_PER_S
"""Longest wait after the last query of a recorder."""
POLL_NS = 5_000_000
LAST_EVENT_NS = 100_000_000
"""Wait for the last event of a recorder that is gone."""
LEAVE_TIMEOUT_NS = 2 * NS_PER_S
"""Wait after a recorder that has everything is gone: its process ends."""
QUERIED_NS = NS_PER_S
"""A recorder that has sent a query within this time is present, whatever its token says."""


class LeavingSite:
    """A site after its last tick, with its last record if any, and the reason for which it ended the run.

    `unheard` names the peers that it heard and that did not hear it.
    """

    def __init__(
        self,
        parts: SiteParts,
        publisher: EventPublisher,
        output: TickRecord | None,
        failure: RunFailed | None,
        unheard: Sequence[str] = (),
    ) -> None:
        self._parts, self._publisher, self._unheard = parts, publisher, unheard
        self._ticks = 0 if output is None else output.tick + 1
        self._t_ns = -1 if output is None else output.t_ns
        self._end_kind, self._failure = "failed", failure
        if output is not None and output.mode is Mode.DIVERGED:
            self._end_kind, self._failure = "diverged", RunFailed(describe_divergence(parts.name, output))

    def leave(self) -> int:
        """Publishes the end, waits for the recorders, and returns the exit code.

        Raises:
            RunFailed: the run ended badly, here or at a peer; as `PeerLeft`, without a peer.
        """
        parts, interrupt = self._parts, self._parts.interrupt
        if self._failure is not None:
            self._publish(self._end_kind, str(self._failure))
        if parts.watchdog is not None and (hiccups := parts.watchdog.describe_hiccups()):
            self._publish("law", hiccups)
            parts.say(hiccups)
        about, why = self._find_cause()
        if self._unheard:
            why += f"; {', '.join(self._unheard)} did not hear it at the end"
        self._publish("end", f"{parts.name} made {self._ticks} ticks{why}", about=about)
        code = interrupt.exit_code if interrupt.requested() else 0  # later signals end the wait
        parts.monitor.watch(self._publisher, self._t_ns)
        if topics.RECORDER in parts.monitor.boots or parts.monitor.recorders:
            self._await_recorders()
        dropped = ", ".join(f"{count} {reason}" for reason, count in parts.stats.dropped.items())
        parts.say(
            f"{self._ticks} ticks, {parts.stats.overruns} of them late by a period or more"
            + (f"; dropped: {dropped}" if dropped else "")
        )
        if self._failure is not None:
            raise self._failure
        if parts.monitor.ended_by:
            raise RunFailed(f"{parts.name} ended because {parts.monitor.ended_by}")
        if not code and self._away:
            raise PeerLeft(f"{parts.name} made {self._ticks} ticks; {self._away}, and did not come back")
        return code

    @property
    def _away(self) -> str:
        """What sites that have left said of it, "" if all are there."""
        return "; ".join(text for _, text in self._parts.monitor.away.values())

    def _find_cause(self) -> tuple[str, str]:
        """Returns whose end it was if the run ends before its time, and why, to be put behind a sentence."""
        parts, monitor = self._parts, self._parts.monitor
        if self._failure is not None:
            return parts.name, f": {self._failure}"
        if monitor.ended_by:
            return monitor.ended_member, f": {monitor.ended_by}"
        if parts.changes.stopped:
            return "", ", as many as it was asked for"
        if self._ticks == parts.scenario.ticks(parts.name):
            return "", ""
        if parts.interrupt.requested():
            return parts.name, f", ended by {signal.Signals(parts.interrupt.number).name}"
        return next(iter(monitor.away), ""), f": {self._away}"

    def _publish(self, kind: str, text: str, about: str = "") -> None:
        self._publisher.publish(kind, text, t_ns=self._t_ns, ticks=self._ticks, about=about)

    def _await_recorders(self) -> None:
        """Waits until every recorder present has stored all, then for `stay_s` until they are gone."""
        parts, clock, monitor = self._parts, self._parts.clock, self._parts.monitor
        interrupted = parts.interrupt.requested
        give_up_ns, queried_ns = clock.monotonic_ns() + LINGER_NS, 0
        while clock.monotonic_ns() < give_up_ns and not (monitor.all_stored and interrupted()):
            while parts.buffer.answer_query():
                queried_ns = clock.monotonic_ns()
                give_up_ns = max(give_up_ns, queried_ns + LINGER_NS)
            self._publisher.answer_queries()
            monitor.watch(self._publisher, self._t_ns)
            gone = not monitor.recorders and clock.monotonic_ns() - queried_ns > QUERIED_NS
            if gone and (monitor.stored or interrupted()):  # else one may come back whose connection broke
                patience_ns = LEAVE_TIMEOUT_NS if monitor.stored else LAST_EVENT_NS
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + patience_ns)
            if monitor.read_stored(self._ticks) and monitor.all_stored:
                give_up_ns = clock.monotonic_ns() + int(parts.options.stay_s * 1e9)
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

"""Leaves a session: publishes how the run ended, and waits until recorders have stored it.

The last messages explain why a run ended, for example because an arm left its limits. They
would be lost if the site ended while a recorder is still missing messages.

Invariant:
    - After its last tick, the process continues until every recorder that is present has stored
      all its messages, or until a time limit is reached.
    - The exit code of the process is determined by the run. A signal received while waiting for
      the recorders only ends the wait.
"""

import signal
from collections.abc import Sequence

from trilat_net.core import describe_mode
from trilat_net.errors import PeerLeft, RunFailed, count_nouns
from trilat_net.net import EventPublisher, LinkTimingMonitor, topics
from trilat_net.records import NS_PER_S, Mode, TickRecord

from .site_parts import SiteParts

LINGER_NS = 10 * NS_PER_S
"""Maximum time that a site waits at its end after the last query from a recorder, in ns.

A recorder whose process was suspended, or whose connection broke, needs several seconds to
reconnect: Zenoh's lease of 5 s, plus one attempt after that.
"""
_ANNOUNCE_AFTER_NS = NS_PER_S
"""Time after which a site tells the user that it is waiting for a recorder, in ns."""
LEAVE_TIMEOUT_NS = 2 * NS_PER_S
"""Time that a site waits after the last recorder has stored everything and left, in ns."""
_QUERIED_NS = NS_PER_S
"""Time after its last query for which a recorder counts as present even without a token, in ns.
"""
_POLL_NS = 5_000_000
"""Longest pause between polls while the site waits for the recorders, in ns."""


def _summarise_loop(ticks: int, parts: SiteParts) -> str:
    """Summarises the executed ticks and the dropped messages of a site in one sentence.

    It shows the user whether the control loop was punctual and whether the network lost
    messages.

    Args:
        ticks: Number of the last tick plus 1.
        parts: Parts of the site.
    """
    stats = parts.stats
    text = f"{count_nouns(ticks, 'tick')}, {stats.late_ticks} of them late by a period or more"
    if stats.skipped:
        text += f", {stats.skipped} of them skipped"
    if not stats.dropped:
        return text

    scenario = parts.scenario
    skipping = [peer for peer in scenario.peers(parts.name) if peer in scenario.external]
    counts = []
    for reason, count in stats.dropped.items():
        counts.append(f"{count} {reason}")
        # Samples do not mention skipped ticks, so a receiver only sees a gap.
        if reason == "missing" and skipping:
            counts[-1] += f" (lost, or ticks that {' or '.join(skipping)} skipped)"

    return f"{text}; dropped: {', '.join(counts)}"


class SiteEnd:
    """Ends a site: publishes the result, waits for the recorders, and informs the user.

    Args:
        parts: Parts of the site.
        publisher: Publishes the events of the site.
        link_monitors: Timing monitors of the links, which show whether the peers have received
            the last samples of this site.
        output: Record of the last tick. None if no tick was executed.
        failure: Error that ended the run. None if there was none.
    """

    def __init__(
        self,
        parts: SiteParts,
        publisher: EventPublisher,
        link_monitors: Sequence[LinkTimingMonitor],
        output: TickRecord | None,
        failure: RunFailed | None,
    ) -> None:
        self._parts = parts
        self._publisher = publisher
        self._link_monitors = link_monitors
        self._output = output
        self._failure = failure
        # Number of ticks up to the last executed one, and its nominal time since the epoch.
        self._ticks = 0 if output is None else output.tick + 1
        self._t_ns = -1 if output is None else output.t_ns

    def leave_session(self) -> int:
        """Publishes how the run ended, waits for the recorders, and tells the user the result.

        The process must not end before the recorders are done, because they may still request
        messages that were lost on the network.

        Returns:
            Exit code of the process: 0, or 128 plus the number of the signal that ended the
            run.

        Raises:
            PeerLeft: A peer left early and did not return.
            RunFailed: The run failed, at this site or at a peer.
        """
        parts = self._parts
        interrupt = parts.interrupt
        monitor = parts.monitor
        self._publish_end()

        # The exit code is read before the wait: a later signal only ends the wait.
        code = interrupt.exit_code if interrupt.is_requested() else 0
        monitor.watch(self._publisher, self._t_ns)
        if topics.RECORDER in monitor.boots or monitor.recorders:
            self._await_recorders()

        ticks = count_nouns(self._ticks, "tick")
        parts.say(_summarise_loop(self._ticks, parts))

        if self._failure is not None:
            raise self._failure
        if monitor.ended_by:
            raise RunFailed(f"{parts.name} ended because {monitor.ended_by}")
        if not code and self._departures:
            names = " and ".join(monitor.departed)
            raise PeerLeft(
                f"{parts.name} executed {ticks}; {self._departures}; {names} did not rejoin "
                "the session"
            )
        return code

    def _publish_end(self) -> None:
        """Publishes why and when the run of this arm ended.

        A failure is published as a separate event, and so are delays of the user's code. The
        last event, `end`, states how many ticks were executed and, if the run ended early, why.
        """
        parts = self._parts
        output = self._output
        failure_kind = "failed"
        if output is not None and output.mode is Mode.DIVERGED:
            failure_kind = "diverged"
            self._failure = RunFailed(describe_mode(parts.name, output, glides=False))
        if self._failure is not None:
            self._publish_end_event(failure_kind, str(self._failure))

        for code in parts.watchdog.codes:
            hiccups = code.describe_hiccups()
            if hiccups:
                self._publish_end_event("law", hiccups)
                parts.say(hiccups)

        about, cause = self._find_cause()
        unreached_peers = [
            monitor.peer.name for monitor in self._link_monitors if monitor.is_unacknowledged
        ]
        if unreached_peers:
            cause += f"; {', '.join(unreached_peers)} did not confirm its last samples"
        text = f"{parts.name} made {count_nouns(self._ticks, 'tick')}{cause}"
        self._publish_end_event("end", text, about=about)

    @property
    def _departures(self) -> str:
        """Sentences about the sites that left the session and did not come back.

        Empty if no site has left.
        """
        return "; ".join(text for _, text in self._parts.monitor.departed.values())

    def _find_cause(self) -> tuple[str, str]:
        """Determines why the run ended before the last tick of the scenario.

        The cause becomes part of the last event in the log.

        Returns:
            member: Name of the member that ended the run. Empty if the run was completed, or
                was ended by a request to all sites.
            cause: Phrase that names the cause, to be appended to the sentence "m1 made 500
                ticks". Empty if the run was completed.
        """
        parts = self._parts
        monitor = parts.monitor

        if self._failure is not None:  # of this site
            return parts.name, f": {self._failure}"
        if monitor.ended_by:  # another member ended it, or has replaced this site
            return monitor.ended_member, f": {monitor.ended_by}"
        if parts.changes.stopped:  # users requested that all sites end at the same tick
            return "", ", up to the requested end"

        scenario_ticks = parts.scenario.ticks(parts.name)
        if self._ticks == scenario_ticks:
            return "", ""

        if parts.interrupt.is_requested():
            signal_name = signal.Signals(parts.interrupt.number).name
            return parts.name, f", ended by {signal_name}"

        # The site has waited too long for peers that left.
        first_departed = next(iter(monitor.departed), "")
        return first_departed, f": {self._departures}"

    def _publish_end_event(self, kind: str, text: str, about: str = "") -> None:
        """Publishes why and when the control loop of this arm ended.

        The event contains the number of executed ticks. The recorder compares this number with
        the received records to find missing ones.

        Args:
            kind: Kind of the event, for example "end" or "law".
            text: Sentence for people.
            about: Name of the site that the event is about. Empty for this site.
        """
        self._publisher.publish(kind, text, t_ns=self._t_ns, ticks=self._ticks, about=about)

    def _await_recorders(self) -> None:
        """Waits until every recorder has stored the messages of this site and has left.

        Recorders query the site for messages that were lost on the way, and the site must
        reply. Once everything is stored, the site stays until the recorders have left, for at
        most the time set by the user's options.

        A first signal does not shorten the wait for the recorders, because records that are not
        stored would be lost with this process. A second signal ends it.
        """
        parts = self._parts
        clock = parts.clock
        monitor = parts.monitor
        begun_ns = clock.monotonic_ns()
        give_up_ns = begun_ns + LINGER_NS
        queried_ns = 0
        is_announced = False
        while clock.monotonic_ns() < give_up_ns and not self._may_leave():
            while not parts.interrupt.is_repeated() and parts.buffer.answer_query():
                queried_ns = clock.monotonic_ns()
                give_up_ns = max(give_up_ns, queried_ns + LINGER_NS)
            self._publisher.answer_queries()
            monitor.watch(self._publisher, self._t_ns)

            since_query_ns = clock.monotonic_ns() - queried_ns
            is_gone = not monitor.recorders and since_query_ns > _QUERIED_NS
            # A recorder that has gone but still lacks messages may come back. The limit then
            # stays unchanged.
            if is_gone and monitor.stored:
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + LEAVE_TIMEOUT_NS)
            if monitor.read_stored(self._ticks) and monitor.all_stored:
                give_up_ns = clock.monotonic_ns() + int(parts.options.stay_s * 1e9)

            waited_ns = clock.monotonic_ns() - begun_ns
            is_long = not monitor.all_stored and waited_ns > _ANNOUNCE_AFTER_NS
            if is_long and not is_announced:
                is_announced = True
                parts.say(
                    "keeps its last records until the recorder has them, or has asked for none "
                    f"for {LINGER_NS // NS_PER_S} s; Ctrl-C a second time ends it at once"
                )
            clock.sleep_until(clock.monotonic_ns() + _POLL_NS)

    def _may_leave(self) -> bool:
        """Returns True if the site no longer has to wait for the recorders.

        After a first signal such as Ctrl-C, the site waits until the recorders have stored
        everything. A second signal ends the wait at once.
        """
        interrupt = self._parts.interrupt
        is_complete = self._parts.monitor.all_stored and interrupt.is_requested()
        return interrupt.is_repeated() or is_complete

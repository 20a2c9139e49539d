"""Admits arms that join or rejoin a running session, and notices arms that stay away.

If a site has crashed and is restarted, the other sites must know the first tick from which to
use its messages. `peer_monitor` and `peer_admission` share this work: the former detects
processes, the latter changes whose samples the control loop uses.

Invariant:
    - From the tick announced by an admitted peer, samples from its new process are accepted,
      and samples from its previous process are rejected.
    - A peer whose samples arrive counts as present, even if its liveliness token was lost.
"""

from msgspec.structs import asdict

from trilat_net.core import tick_ns
from trilat_net.net import Epoch, Event, EventPublisher, SiteTiming
from trilat_net.records import NS_PER_S

from .site_loop import PeerInbox
from .site_parts import SiteParts


class PeerAdmission:
    """Decides from which tick onwards the samples of a restarted peer are used.

    Samples of the old process that are still in transit must not be mixed with those of the new
    one.

    Args:
        parts: Parts of the site.
        publisher: Publishes the events of the site.
        epoch: Common start time of the session and, if this site joined late, its request to
            join.
        timing: Clocks of the peers.
        inbox: Samples from the peers.

    Attributes:
        has_given_up: True if a peer has been away for longer than the user allows.
    """

    def __init__(
        self,
        parts: SiteParts,
        publisher: EventPublisher,
        epoch: Epoch,
        timing: SiteTiming,
        inbox: PeerInbox,
    ) -> None:
        self.has_given_up = False
        self._parts = parts
        self._publisher = publisher
        self._timing = timing
        self._inbox = inbox
        self._coming = epoch.coming  # None if this site was present from the start
        self._rejoined_ns = tick_ns(epoch.first, parts.site.rate_hz)

    def watch_members(self, t_ns: int) -> None:
        """Updates who takes part in the session, and checks if a peer has been away too long.

        A member is present while its liveliness token exists, which is observed by the monitor.
        The monitor also collects the events with which peers announce that they join, and this
        method admits these peers.

        Args:
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        parts = self._parts
        monitor = parts.monitor
        monitor.watch(self._publisher, t_ns)
        if monitor.changed:
            # If all links have long delays, the samples of a few ticks are held and published
            # together. A peer has published a change, which may shorten a delay. Therefore
            # every sample is published in its own tick from now on. This is early enough: a
            # change takes effect at least 100 ms after its request, when all samples that are
            # held at present have been published.
            parts.states.holds_samples = False

        # A peer whose samples arrive is present, even if its token was lost.
        if monitor.departed:
            for link_monitor in self._timing.monitors:
                if link_monitor.is_receiving(parts.clock.monotonic_ns()):
                    monitor.mark_present(link_monitor.peer.name, t_ns)

        for join_event in monitor.admitted:
            self._admit_peer(join_event, t_ns)
        monitor.admitted.clear()
        self.has_given_up = self._is_peer_away_too_long(t_ns)  # ends the loop

    def _is_peer_away_too_long(self, t_ns: int) -> bool:
        """Returns True if a peer left longer ago than the user allows, which ends the run.

        The limit is the option `leave_timeout_s`. Without this option, a peer may stay away
        forever.

        Args:
            t_ns: Present time, ns since the epoch.
        """
        patience_s = self._parts.options.leave_timeout_s
        departures = self._parts.monitor.departed.values()
        if patience_s is None or not departures:
            return False
        first_left_ns = min(left_ns for left_ns, _ in departures)
        return t_ns - first_left_ns > patience_s * NS_PER_S

    def _admit_peer(self, event: Event, t_ns: int) -> None:
        """Prepares this site for a peer that joins the session, or rejoins it after a restart.

        From the tick named in the event, samples from the new process are accepted, and samples
        from its previous process are rejected.

        Args:
            event: Event with which the peer announced that it joins.
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        parts = self._parts
        index = parts.site.peers.index(event.member)
        join_ns = tick_ns(event.ticks, parts.scenario.sites[event.member].rate_hz)

        has_same_clock = event.clock == parts.clock.identity()
        bound_ns = None if has_same_clock else event.bound_ns

        self._publish_last_heard(index, event, t_ns)
        notices = self._timing.admit(index, join_ns, event.epoch_mono_ns, bound_ns)
        self._publisher.publish_clocks(notices, t_ns)
        self._inbox.admit(index, event.boot, event.ticks)
        parts.say(f"{event.member} joins at t = {join_ns * 1e-9:.3f} s")

    def _publish_last_heard(self, index: int, coming: Event, t_ns: int) -> None:
        """Publishes the last tick that was received from a peer before the peer was restarted.

        The previous process of the peer may have been killed before it could publish its end.
        Its last tick tells the recorder how many records to expect.

        Args:
            index: Index of the peer.
            coming: Event with which the new process of the peer announced that it joins.
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        tick = self._inbox.find_last_tick_of(index, coming.boot)
        if tick is None:
            return

        self._publisher.publish(
            "last",
            f"the previous start of {coming.member} was heard up to tick {tick}",
            t_ns=t_ns,
            about=coming.member,
            boots={coming.member: coming.boot},
            ticks=tick + 1,
        )

    def rejoin(self, t_ns: int) -> None:
        """Repeats the request to join the session until no peer ignores this site any more.

        A peer whose connection was interrupted has not received the request, and drops the
        samples of this site as those of an unknown process. The request is repeated at most
        once per second, until every peer whose samples arrive has acknowledged samples of this
        site.

        Args:
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        coming = self._coming
        now_ns = self._parts.clock.monotonic_ns()
        if coming is None or t_ns < self._rejoined_ns + NS_PER_S:
            return

        is_ignored = False
        for link_monitor in self._timing.monitors:
            # None means that the peer has never acknowledged a sample of this site.
            has_never_acknowledged = link_monitor.is_acknowledged(now_ns) is None
            if link_monitor.is_receiving(now_ns) and has_never_acknowledged:
                is_ignored = True
        if is_ignored:
            self._rejoined_ns = t_ns
            fields = {**asdict(coming), "t_ns": t_ns, "n": self._publisher.published}
            self._publisher.publish(**fields)

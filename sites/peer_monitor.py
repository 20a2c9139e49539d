"""Presence of the other members during a run: joins, leaves, and the end events of sites and recorders.

Invariant: of sites, only the boots that the session began with count; a recorder may join at any time.
"""

from collections.abc import Mapping, Sequence

from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.membership import EventPublisher, read_events


class PeerMonitor:
    """The other members, as one site sees them.

    Args:
        bus: the site's connection.
        session: the session's name.
        site: the site's name.
        peers: its peers, in scenario order.

    Attributes:
        recorders: boots of the recorders that are there.
        stored: boots of those that have said that they have all of this site.
        ended_by: why a peer has ended the run for all; "" while none has.
    """

    def __init__(self, bus: Bus, session: str, site: str, peers: Sequence[str]) -> None:
        self.recorders: set[str] = set()
        self.stored: set[str] = set()
        self.ended_by = ""
        self._site = site
        self._events = {peer: bus.inbox(topics.key(session, peer, topics.EVENT), 256) for peer in peers}
        self._recorder_events = bus.inbox(topics.key(session, topics.RECORDER, topics.EVENT), 256)
        self._presence = bus.presence(topics.key(session, "*", topics.ALIVE) + "/*")
        self._boots: Mapping[str, int] = {}
        self._ended: set[str] = set()

    def admit(self, boots: Mapping[str, int]) -> None:
        """Says which start of each member belongs to the session."""
        self._boots = boots

    def watch(self, publisher: EventPublisher, t_ns: int) -> None:
        """Takes what has come, and says who has come or is gone without having said its end.

        Args:
            publisher: the site's own events.
            t_ns: nominal time, ns since the epoch.
        """
        self._hear()
        while (change := self._presence.poll()) is not None:
            where = topics.parse_key(change[0])
            if where is None:
                continue
            known = str(self._boots.get(where.member)) == where.boot
            if where.member == topics.RECORDER:
                (self.recorders.add if change[1] else self.recorders.discard)(where.boot)
                if change[1] and not known:  # in the middle, or once more after another one died
                    publisher.publish("back", "a recorder has come", about=where.member, t_ns=t_ns)
            elif not known:
                continue
            if not change[1] and where.member not in self._ended:
                publisher.publish("lost", f"{where.member} is gone", about=where.member, t_ns=t_ns)

    def _hear(self) -> None:
        """Takes what the peers say of their own end."""
        for peer, inbox in self._events.items():
            for event in read_events(inbox):
                if event.boot != self._boots.get(peer):
                    continue
                if event.kind in ("diverged", "failed"):
                    self.ended_by = event.text
                elif event.kind == "end":
                    self._ended.add(peer)

    def hear_recorders(self, ticks: int) -> bool:
        """Takes what the recorders say; True where one of them just said that it has all of this site.

        Args:
            ticks: how many ticks the site has made.
        """
        before = len(self.stored)
        for event in read_events(self._recorder_events):
            if event.kind == "stored" and event.about == self._site and event.ticks >= ticks:
                self.stored.add(str(event.boot))
        return len(self.stored) > before

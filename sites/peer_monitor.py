"""Presence of the other members during a run: joins, leaves, and the end events of sites and recorders.

Invariant: of sites, only the boots that the session began with count; a recorder may join at any time.
"""

from collections.abc import Mapping, Sequence

from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.membership import EventPublisher, read_events


class PeerMonitor:
    """The other members, as one site sees them.

    Attributes:
        recorders: boots of the recorders that are present.
        stored: boots of the recorders that have stored all messages of this site.
        ended_by: text of the event with which a peer ended the run for all; "" while none has.
    """

    def __init__(self, bus: Bus, session: str, site: str, peers: Sequence[str]) -> None:
        self.recorders: set[str] = set()
        self.stored: set[str] = set()
        self.ended_by = ""
        self._site = site
        self._events = {peer: bus.inbox(topics.key(session, peer, topics.EVENT), 256) for peer in peers}
        self._recorder_events = bus.inbox(topics.key(session, topics.RECORDER, topics.EVENT), 256)
        self._presence = bus.presence(topics.presence_key(session, "*"))
        self._boots: Mapping[str, int] = {}
        self._ended: set[str] = set()

    @property
    def all_stored(self) -> bool:
        """True if there is a recorder that has stored all, and none is present that has not."""
        return bool(self.stored) and self.recorders <= self.stored

    def admit(self, boots: Mapping[str, int]) -> None:
        """Sets the boots that belong to the session."""
        self._boots = boots

    def watch(self, publisher: EventPublisher, t_ns: int) -> None:
        """Takes events and presence; publishes who is back, and who is lost without an end event."""
        for peer, inbox in self._events.items():
            for event in read_events(inbox):
                if event.boot != self._boots.get(peer):
                    continue
                if event.kind in ("diverged", "failed"):
                    self.ended_by = event.text
                elif event.kind == "end":
                    self._ended.add(peer)
        for parts, alive in topics.read_presence(self._presence):
            known = str(self._boots.get(parts.member)) == parts.boot
            if parts.member == topics.RECORDER:
                (self.recorders.add if alive else self.recorders.discard)(parts.boot)
                if alive and not known:  # in the middle, or again after another one died
                    publisher.publish("back", "a recorder has come", about=parts.member, t_ns=t_ns)
            elif not known:
                continue
            if not alive and parts.member not in self._ended:
                publisher.publish("lost", f"{parts.member} is gone", about=parts.member, t_ns=t_ns)

    def read_stored(self, ticks: int) -> bool:
        """Takes the recorders' events; True if one has just stored all `ticks` of this site."""
        before = len(self.stored)
        for event in read_events(self._recorder_events):
            if event.kind == "stored" and event.about == self._site and event.ticks >= ticks:
                self.stored.add(str(event.boot))
        return len(self.stored) > before

"""Presence of the other members during a run: joins, departures, and the end events of members.

Invariant:
    - Of each site, only the boot counts with which the session began. Under the rule `glide`,
      boots that were admitted since then count as well.
    - Another boot of a site is admitted once the token of the previous one is gone, or its end
      event was received.
    - A recorder may join at any time.
"""

from collections.abc import Iterator, Mapping, Sequence

from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.membership import EventPublisher, read_messages
from trilat_net.net.messages import Event

RETURN_NS = 1_000_000_000
"""A site that is heard for longer than this after its token was lost counts as present.

After a reconnection its new token may be reported late.
"""


class PeerMonitor:
    """The other members of a session, as one site sees them.

    Args:
        bus: the bus of the site.
        session: the session's name.
        site: the name of this site.
        peers: the names of its peers.
        admits: whether sites may leave and rejoin.

    Attributes:
        boots: the boots of the session's members, by name.
        recorders: boots of the recorders that are present.
        stored: boots of the recorders that have stored all messages of this site.
        ended_by: text of the event with which a member ended the run for all, else "".
        ended_member: the name of that member.
        departed: the sites that have left, by name: the time, ns since the epoch, and a
            sentence.
        admitted: join events of admitted sites that the loop has not applied yet.
        changed: True once a peer has published a change.
    """

    def __init__(
        self, bus: Bus, session: str, site: str, peers: Sequence[str], *, admits: bool = False
    ) -> None:
        self.boots: Mapping[str, int] = {}
        self.recorders: set[str] = set()
        self.stored: set[str] = set()
        self.ended_by = ""
        self.ended_member = ""
        self.departed: dict[str, tuple[int, str]] = {}
        self.admitted: list[Event] = []
        self.changed = False
        self._site = site
        self._admits = admits
        self._events = {
            peer: bus.inbox(topics.key(session, peer, topics.EVENT), 256) for peer in peers
        }
        self._recorder_events = bus.inbox(
            topics.key(session, topics.RECORDER, topics.EVENT), 256
        )
        self._presence = bus.presence(topics.presence_key(session, "*"))
        self._alive: set[tuple[str, str]] = set()
        self._ended: set[int] = set()
        self._refused: set[int] = set()
        self._first_ticks: dict[int, int] = {}  # the first ticks of the admitted boots

    @property
    def all_stored(self) -> bool:
        """True if a recorder has stored everything, and no present recorder lacks anything."""
        return bool(self.stored) and self.recorders <= self.stored

    def watch(self, publisher: EventPublisher, t_ns: int) -> None:
        """Reads events and presence; publishes who joins, and who is lost without an end event.

        Args:
            publisher: publishes this site's events.
            t_ns: the present time, ns since the epoch.
        """
        joining: list[Event] = []
        for inbox in self._events.values():
            joining += self._read_peer_events(inbox, publisher, t_ns)
        for parts, alive in topics.read_presence(self._presence):
            self._update_presence(parts.member, parts.boot, publisher, t_ns, alive=alive)
        for event in joining:
            self._decide_on_join(publisher, event, t_ns)

    def _update_presence(
        self, member: str, boot: str, publisher: EventPublisher, t_ns: int, *, alive: bool
    ) -> None:
        is_member = str(self.boots.get(member)) == boot
        is_recorder = member == topics.RECORDER
        is_site = member in self._events
        if is_recorder:
            (self.recorders.add if alive else self.recorders.discard)(boot)
            if alive and not is_member:  # a recorder joins late, or replaces one that died
                publisher.publish("back", "a recorder has come", about=member, t_ns=t_ns)
        elif is_site:
            (self._alive.add if alive else self._alive.discard)((member, boot))
        if self.boots.get(member) in self._ended:
            return
        if is_member and alive:
            self.departed.pop(member, None)
        elif not alive and (is_member or is_recorder):
            publisher.publish("lost", f"{member} is gone", about=member, t_ns=t_ns)
            if self._admits and is_site:
                sentence = f"{member} is gone since t = {t_ns * 1e-9:.1f} s"
                self.departed[member] = (t_ns, sentence)

    def mark_present(self, member: str, t_ns: int) -> None:
        """Marks a site that is heard as present, if its token was lost some time ago.

        A site whose end event was received stays departed.
        """
        since_ns, _ = self.departed.get(member, (t_ns, ""))
        if t_ns - since_ns > RETURN_NS and self.boots.get(member) not in self._ended:
            del self.departed[member]

    def _read_peer_events(
        self, inbox: Inbox, publisher: EventPublisher, t_ns: int
    ) -> Iterator[Event]:
        """Reads a peer's events, and yields the join events of new boots.

        If the peer has admitted several boots of this site, the last one counts: the earlier
        ones died while they joined.
        """
        own_boot = publisher.info.boot
        admitted_boot = own_boot
        for event in read_messages(inbox, Event):
            if event.kind == "coming" and self._admits:
                yield event
            elif event.boot != self.boots.get(event.member):
                continue
            elif event.kind == "change":
                self.changed = True
            elif event.kind in ("diverged", "failed"):
                self.ended_by = event.text
                self.ended_member = event.member
            elif event.kind == "end":
                self._ended.add(event.boot)
                if event.about and self._admits:
                    self.departed[event.member] = t_ns, event.text
                    publisher.publish(
                        "left", event.text, about=event.member, t_ns=t_ns, ticks=event.ticks
                    )
            elif event.kind == "admit" and event.about == self._site:
                admitted_boot = event.boots.get(self._site, own_boot)
        if admitted_boot != own_boot and self.boots.get(self._site) == own_boot:
            self.ended_by = f"another start of {self._site} has taken its place"
            self.ended_member = self._site

    def _decide_on_join(self, publisher: EventPublisher, event: Event, t_ns: int) -> None:
        """Admits a new boot of a site, or refuses it while the previous one is alive."""
        member = event.member
        previous_boot = self.boots.get(member)
        is_repeated = self._first_ticks.get(event.boot) == event.ticks
        if event.boots.get(member) != event.boot or is_repeated:
            return
        is_replaced = previous_boot not in (event.boot, *self._ended)
        if is_replaced and (member, str(previous_boot)) in self._alive:
            if event.boot not in self._refused:
                self._refused.add(event.boot)
                text = (
                    f"{member} is there already; "
                    "another start of it must wait until that is gone"
                )
                self._publish_decision("refused", text, publisher, event=event, t_ns=t_ns)
            return
        self.boots = {**self.boots, member: event.boot}
        self.departed.pop(member, None)
        self.admitted.append(event)
        self._first_ticks[event.boot] = event.ticks
        publisher.update(boots=self.boots)
        text = f"{member} may join from its tick {event.ticks} on"
        self._publish_decision("admit", text, publisher, event=event, t_ns=t_ns)

    def _publish_decision(
        self, kind: str, text: str, publisher: EventPublisher, event: Event, t_ns: int
    ) -> None:
        publisher.publish(
            kind,
            text,
            t_ns=t_ns,
            about=event.member,
            boots={**self.boots, event.member: event.boot},
            attempt=event.attempt,
            ticks=event.ticks,
        )

    def read_stored(self, ticks: int) -> bool:
        """Reads the recorders' events; returns True if a recorder has just stored all messages.

        Args:
            ticks: the number of ticks of this site.
        """
        before = len(self.stored)
        for event in read_messages(self._recorder_events, Event):
            if event.kind == "stored" and event.about == self._site and event.ticks >= ticks:
                self.stored.add(str(event.boot))
        return len(self.stored) > before

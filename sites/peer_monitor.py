"""Presence of the other members during a run: joins, leaves, and the end events of sites and
recorders.

Invariant: of sites, only the boots that the session began with count, and under the rule
`glide` those that were admitted since: another start of a site is admitted once the token of
the one before is gone, or its end was heard. A recorder may join at any time.
"""

from collections.abc import Iterator, Mapping, Sequence

from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.membership import EventPublisher, read_messages
from trilat_net.net.messages import Event

MEET_AGAIN_NS = 1_000_000_000
"""A site that is heard longer after its token went is there: a reconnection may report that
late.
"""


class PeerMonitor:
    """The other members, as one site sees them; with `admits` it lets sites come back.

    Attributes:
        boots: the members of the session and their boots.
        stored: boots of the recorders that have stored all messages of this site.
        ended_by: text of the event with which a member ended the run for all; "" while none
            has.
        ended_member: that member.
        away: the sites that have left, by name: when, ns since the epoch, and a sentence.
        admitted: what sites said that were admitted and that the loop has still to take in.
    """

    def __init__(
        self, bus: Bus, session: str, site: str, peers: Sequence[str], *, admits: bool = False
    ) -> None:
        self.boots: Mapping[str, int] = {}
        self.recorders: set[str] = set()
        self.stored: set[str] = set()
        self.ended_by = self.ended_member = ""
        self.away: dict[str, tuple[int, str]] = {}
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
        self._firsts: dict[int, int] = {}  # of the starts that it admitted, by boot

    @property
    def all_stored(self) -> bool:
        """True if there is a recorder that has stored all, and none is present that has not."""
        return bool(self.stored) and self.recorders <= self.stored

    def watch(self, publisher: EventPublisher, t_ns: int) -> None:
        """Takes events and presence; publishes who comes, and who is lost without an end event."""
        coming = [
            event
            for inbox in self._events.values()
            for event in self._read(inbox, publisher, t_ns)
        ]
        for parts, alive in topics.read_presence(self._presence):
            known = str(self.boots.get(parts.member)) == parts.boot
            if parts.member == topics.RECORDER:
                (self.recorders.add if alive else self.recorders.discard)(parts.boot)
                if alive and not known:  # in the middle, or again after another one died
                    publisher.publish(
                        "back", "a recorder has come", about=parts.member, t_ns=t_ns
                    )
            elif parts.member in self._events:
                (self._alive.add if alive else self._alive.discard)((parts.member, parts.boot))
            if self.boots.get(parts.member) in self._ended:
                continue
            if known and alive:
                self.away.pop(parts.member, None)
            elif not alive and (known or parts.member == topics.RECORDER):
                publisher.publish(
                    "lost", f"{parts.member} is gone", about=parts.member, t_ns=t_ns
                )
                if self._admits and parts.member in self._events:
                    self.away[parts.member] = (
                        t_ns,
                        f"{parts.member} is gone since t = {t_ns * 1e-9:.1f} s",
                    )
        for event in coming:
            self._consider(publisher, event, t_ns)

    def meet_again(self, member: str, t_ns: int) -> None:
        """Takes a site that is heard for present, if its token went some time ago and it has
        not ended.
        """
        since_ns, _ = self.away.get(member, (t_ns, ""))
        if t_ns - since_ns > MEET_AGAIN_NS and self.boots.get(member) not in self._ended:
            del self.away[member]

    def _read(self, inbox: Inbox, publisher: EventPublisher, t_ns: int) -> Iterator[Event]:
        """Takes a peer's events; yields those of starts that come.

        Of what it admitted in the place of this site the last counts: before came starts that
        died joining.
        """
        own = publisher.info.boot
        in_place = own
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
                    self.away[event.member] = t_ns, event.text
                    publisher.publish(
                        "left", event.text, about=event.member, t_ns=t_ns, ticks=event.ticks
                    )
            elif event.kind == "admit" and event.about == self._site:
                in_place = event.boots.get(self._site, own)
        if in_place != own and self.boots.get(self._site) == own:
            self.ended_by = f"another start of {self._site} has taken its place"
            self.ended_member = self._site

    def _consider(self, publisher: EventPublisher, event: Event, t_ns: int) -> None:
        member = event.member
        before = self.boots.get(event.member)
        if event.boots.get(member) != event.boot or self._firsts.get(event.boot) == event.ticks:
            return
        if before not in (event.boot, *self._ended) and (member, str(before)) in self._alive:
            if event.boot not in self._refused:
                self._refused.add(event.boot)
                text = f"{member} is there already; another start of it must wait until that is gone"
                self._answer(
                    kind="refused", text=text, publisher=publisher, event=event, t_ns=t_ns
                )
            return
        self.boots = {**self.boots, member: event.boot}
        self.away.pop(member, None)
        self.admitted.append(event)
        self._firsts[event.boot] = event.ticks
        publisher.update(boots=self.boots)
        self._answer(
            kind="admit",
            text=f"{member} may join from its tick {event.ticks} on",
            publisher=publisher,
            event=event,
            t_ns=t_ns,
        )

    def _answer(
        self, kind: str, text: str, publisher: EventPublisher, event: Event, t_ns: int
    ) -> None:
        boots = {**self.boots, event.member: event.boot}
        about = {
            "about": event.member,
            "boots": boots,
            "attempt": event.attempt,
            "ticks": event.ticks,
        }
        publisher.publish(kind, text, t_ns=t_ns, **about)

    def read_stored(self, ticks: int) -> bool:
        """Takes the recorders' events; True if one has just stored all `ticks` of this site."""
        before = len(self.stored)
        for event in read_messages(self._recorder_events, Event):
            if event.kind == "stored" and event.about == self._site and event.ticks >= ticks:
                self.stored.add(str(event.boot))
        return len(self.stored) > before

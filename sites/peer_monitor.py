"""Presence of the other members during a run: joins, departures and ends.

Invariant:
    - Messages of a site count only if they come from the boot with which the session began.
      Under the rule `glide`, boots that were admitted later count as well.
    - A new boot of a site is admitted once the token of the previous boot is gone, or the end
      event of the previous boot was received.
    - A recorder may join at any time.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.membership import EventPublisher, read_messages
from trilat_net.net.messages import Event

T = TypeVar("T")

RETURN_NS = 1_000_000_000
"""Time after the loss of a site's token from which a message of the site proves its presence.

After a reconnection the new token of the site may be reported late.
"""
_INBOX_CAPACITY = 256
"""Number of events of a member that wait at most."""


class PeerMonitor:
    """The other members of a session, as one site sees them.

    Args:
        bus: the bus of the site.
        session: the session's name.
        site: the name of this site.
        peers: the names of its peers.
        admits: True if sites may leave and rejoin.

    Attributes:
        boots: the boots of the session's members, by name.
        recorders: boots of the recorders that are present.
        stored: boots of the recorders that have stored all messages of this site.
        ended_by: text of the event with which a member ended the run for all; "" before such
            an event.
        ended_member: the name of that member.
        departed: time of departure, ns since the epoch, and a sentence, by the name of a site
            that has left.
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
        self._events: dict[str, Inbox] = {}
        for peer in peers:
            event_key = topics.key(session, peer, topics.EVENT)
            self._events[peer] = bus.inbox(event_key, _INBOX_CAPACITY)
        recorder_key = topics.key(session, topics.RECORDER, topics.EVENT)
        self._recorder_events = bus.inbox(recorder_key, _INBOX_CAPACITY)
        self._presence = bus.presence(topics.presence_key(session, "*"))
        # Members and boots whose tokens are alive.
        self._alive: set[tuple[str, str]] = set()
        # Boots whose end event was received.
        self._ended: set[int] = set()
        # Boots that were refused, each of which is announced once.
        self._refused: set[int] = set()
        # First ticks of the admitted boots.
        self._first_ticks: dict[int, int] = {}

    @property
    def all_stored(self) -> bool:
        """True if a recorder has stored everything, and no present recorder lacks anything."""
        return bool(self.stored) and self.recorders <= self.stored

    def watch(self, publisher: EventPublisher, t_ns: int) -> None:
        """Reads events and presence, and publishes the joins and losses of members.

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
        """Applies the appearance or disappearance of a member's token.

        Args:
            member: name of the member.
            boot: its boot, as in the token.
            publisher: publishes this site's events.
            t_ns: the present time, ns since the epoch.
            alive: True if the token has appeared.
        """
        is_member = str(self.boots.get(member)) == boot
        is_recorder = member == topics.RECORDER
        is_site = member in self._events
        if is_recorder:
            _set_membership(self.recorders, boot, alive)
            # a recorder joins late, or replaces a recorder that died
            if alive and not is_member:
                publisher.publish("back", "a recorder has joined", about=member, t_ns=t_ns)
        elif is_site:
            _set_membership(self._alive, (member, boot), alive)
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
        """Marks a site as present whose messages arrive, if its token was lost some time ago.

        A site whose end event was received stays departed.

        Args:
            member: name of the site.
            t_ns: the present time, ns since the epoch.
        """
        if member not in self.departed or self.boots.get(member) in self._ended:
            return
        since_ns, _ = self.departed[member]
        if t_ns - since_ns > RETURN_NS:
            del self.departed[member]

    def _read_peer_events(
        self, inbox: Inbox, publisher: EventPublisher, t_ns: int
    ) -> Iterator[Event]:
        """Reads a peer's events, and yields the join events of new boots.

        If the peer has admitted several boots of this site, the last boot counts: the earlier
        boots died while they joined.
        """
        local_boot = publisher.info.boot
        admitted_boot = local_boot
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
                        "left",
                        event.text,
                        about=event.member,
                        t_ns=t_ns,
                        ticks=event.ticks,
                    )
            elif event.kind == "admit" and event.about == self._site:
                admitted_boot = event.boots.get(self._site, local_boot)
        if admitted_boot != local_boot and self.boots.get(self._site) == local_boot:
            self.ended_by = f"another start of {self._site} has replaced this site"
            self.ended_member = self._site

    def _decide_on_join(self, publisher: EventPublisher, event: Event, t_ns: int) -> None:
        """Admits a new boot of a site, or refuses the boot while the previous boot is alive."""
        member = event.member
        previous_boot = self.boots.get(member)
        is_repeated = self._first_ticks.get(event.boot) == event.ticks
        if event.boots.get(member) != event.boot or is_repeated:
            return
        is_replaced = previous_boot not in (event.boot, *self._ended)
        if is_replaced and (member, str(previous_boot)) in self._alive:
            if event.boot not in self._refused:
                self._refused.add(event.boot)
                text = f"{member} is present already; a new start must wait until it is gone"
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
        """Publishes the decision on a join event.

        Args:
            kind: "admit" or "refused".
            text: the decision as a sentence.
            publisher: publishes this site's events.
            event: the join event.
            t_ns: the present time, ns since the epoch.
        """
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


def _set_membership(members: set[T], member: T, is_present: bool) -> None:
    """Adds a member to a set, or removes the member from the set."""
    if is_present:
        members.add(member)
    else:
        members.discard(member)

"""Keeps track of which processes join, leave and end a session while an arm is running.

The members of a session are sites and recorders. Each process draws a random number at its
start, which distinguishes it from earlier and later processes with the same name.

A site learns about the other members in two ways: through the events that they publish, and
through their liveliness tokens in the network (Zenoh). A token disappears when its process ends
or loses its connection.

Invariant:
    - Two processes never act as the same site. A new process of a site is admitted only after
      the previous one has disappeared or has published its end, and only if the scenario allows
      sites to come back (value `glide` of its rule for missing samples).
    - A recorder may join at any time.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

from trilat_net.net import Bus, Event, EventPublisher, Inbox, read_messages, topics

T = TypeVar("T")

RETURN_NS = 1_000_000_000
"""Time after the loss of a site's token after which samples alone show its return, in ns.

After a reconnection, samples may arrive before the new liveliness token.
"""
_INBOX_CAPACITY = 256
"""Maximum number of unread events from one member."""


class PeerMonitor:
    """Keeps track of the other members of a session for one site.

    Processes may crash, join late or be restarted while the arm is running. The site calls
    `watch` ten times per second, and reads the attributes.

    Args:
        bus: Network connection of the site.
        session: Name of the session.
        site: Name of the site.
        peers: Names of its peers.
        admits: True if the scenario lets sites leave a running session and come back.

    Attributes:
        boots: Mapping from the name of each member of the session to its boot (the random
            number that identifies one start of its process).
        recorders: Boots of the recorders that are present.
        stored: Boots of the recorders that have stored all messages from this site.
        ended_by: Sentence of the event with which a member ended the run for everyone. Empty if
            there is none.
        ended_member: Name of that member.
        departed: For each site that has left, the time in ns since the epoch (the common start
            of the session) and a sentence for the user, keyed by name.
        admitted: Events with which sites announced that they join, and which this site must
            still apply.
        changed: True once a peer has published a change of its settings.
    """

    def __init__(
        self,
        bus: Bus,
        session: str,
        site: str,
        peers: Sequence[str],
        *,
        admits: bool = False,
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
        """True if every recorder that is present has stored all messages from this site.

        False if no recorder is present. Data may be lost if the site ends while this is False.
        """
        return bool(self.stored) and self.recorders <= self.stored

    def watch(self, publisher: EventPublisher, t_ns: int) -> None:
        """Updates the list of members, and publishes an event when a member joins or leaves.

        The control loop calls this method ten times per second, so that crashed processes are
        noticed quickly.

        Args:
            publisher: Publishes the events of this site.
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        joining: list[Event] = []
        for inbox in self._events.values():
            joining += self._read_peer_events(inbox, publisher, t_ns)
        for parts, alive in topics.read_presence(self._presence):
            self._update_presence(parts.member, parts.boot, publisher, t_ns, alive=alive)
        for event in joining:
            self._decide_on_join(publisher, event, t_ns)

    def _update_presence(
        self,
        member: str,
        boot: str,
        publisher: EventPublisher,
        t_ns: int,
        *,
        alive: bool,
    ) -> None:
        """Updates which processes are present after a token has appeared or disappeared.

        A token shows that one process of a recorder or a site is connected. This is not
        necessarily the process that is a member of the session, because a process that is
        waiting to join, or that was replaced, also has a token.

        The method updates `recorders` and the sites whose tokens exist. If the process is a
        member, or any recorder, its appearance or loss is also published, and `departed` is
        updated.

        Args:
            member: Name of the member.
            boot: Number that identifies the start of the member's process, as a string.
            publisher: Publishes the events of this site.
            t_ns: Present time, in ns since the epoch (the common start of the session).
            alive: True if the token has appeared.
        """
        member_boot = self.boots.get(member)
        is_member_process = str(member_boot) == boot
        is_recorder = member == topics.RECORDER
        is_site = member in self._events
        if is_recorder:
            _set_membership(self.recorders, boot, alive)
            # A recorder that is not a member joins late, or replaces a recorder that died.
            if alive and not is_member_process:
                publisher.publish("back", "a recorder has joined", about=member, t_ns=t_ns)
        elif is_site:
            _set_membership(self._alive, (member, boot), alive)

        # The departure of a member that has published its end was reported already.
        if member_boot in self._ended:
            return

        if is_member_process and alive:
            self.departed.pop(member, None)
        elif not alive and (is_member_process or is_recorder):
            publisher.publish("lost", f"{member} is gone", about=member, t_ns=t_ns)
            # The session continues without this site only if the scenario lets sites come back.
            if self._admits and is_site:
                sentence = f"{member} has been gone since t = {t_ns * 1e-9:.1f} s"
                self.departed[member] = (t_ns, sentence)

    def mark_present(self, member: str, t_ns: int) -> None:
        """Marks a site that seemed to be lost as present, because its samples are arriving.

        A site that has published its end is not marked. Neither is a site that has just left,
        because its last samples may still arrive.

        Args:
            member: Name of the site.
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        if member not in self.departed or self.boots.get(member) in self._ended:
            return
        since_ns, _ = self.departed[member]
        if t_ns - since_ns > RETURN_NS:
            del self.departed[member]

    def _read_peer_events(
        self, inbox: Inbox, publisher: EventPublisher, t_ns: int
    ) -> Iterator[Event]:
        """Processes the events of a peer, and applies those that are about this process.

        If the peer has admitted another start of this site, this process has been replaced and
        must end. If the peer has admitted several starts, the last one counts: the earlier ones
        died while joining.

        Args:
            inbox: Queue of the events from the peer.
            publisher: Publishes the events of this site.
            t_ns: Present time, in ns since the epoch (the common start of the session).

        Yields:
            The events with which new starts of the peer request to join.
        """
        local_boot = publisher.info.boot
        admitted_boot = local_boot
        for event in read_messages(inbox, Event):
            if event.kind == "coming" and self._admits:
                yield event
            elif event.boot != self.boots.get(event.member):
                continue  # of a process that is not a member
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

        # A peer has admitted another process in place of this one.
        if admitted_boot != local_boot and self.boots.get(self._site) == local_boot:
            self.ended_by = f"another start of {self._site} has replaced this site"
            self.ended_member = self._site

    def _decide_on_join(self, publisher: EventPublisher, event: Event, t_ns: int) -> None:
        """Admits a new process of a site, or rejects it while the previous one still runs.

        The previous process is still running if its liveliness token exists and it has not
        published its end.

        Args:
            publisher: Publishes the events of this site.
            event: Event with which the new process requests to join. It names the boot of the
                process (the number that identifies its start) and its first tick (`ticks`).
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        member = event.member
        previous_boot = self.boots.get(member)  # None if the site was not a member before
        admitted_first_tick = self._first_ticks.get(event.boot)
        was_admitted_already = admitted_first_tick == event.ticks
        is_consistent = event.boots.get(member) == event.boot
        if not is_consistent or was_admitted_already:
            return

        is_other_process = previous_boot != event.boot
        has_published_end = previous_boot in self._ended
        has_token = (member, str(previous_boot)) in self._alive
        if is_other_process and not has_published_end and has_token:
            # A refusal is published only once, although the request is repeated.
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
        self,
        kind: str,
        text: str,
        publisher: EventPublisher,
        event: Event,
        t_ns: int,
    ) -> None:
        """Announces whether the restarted process of a peer may rejoin the session.

        This event informs the new process, the other sites and the recorder of the decision.

        Args:
            kind: Kind of the event: "admit" or "refused".
            text: Sentence of the event.
            publisher: Publishes the events of this site.
            event: Event with which the new process requested to join.
            t_ns: Present time, in ns since the epoch (the common start of the session).
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
        """Processes the messages in which recorders confirm that they have stored all data.

        After the run, the site waits for these confirmations, because until then recorders may
        still request lost messages.

        Args:
            ticks: Number of ticks that this site has executed.

        Returns:
            True if at least one more recorder has confirmed since the last call.
        """
        confirmed_before = len(self.stored)
        for event in read_messages(self._recorder_events, Event):
            is_about_this_site = event.kind == "stored" and event.about == self._site
            if is_about_this_site and event.ticks >= ticks:
                self.stored.add(str(event.boot))
        return len(self.stored) > confirmed_before


def _set_membership(members: set[T], member: T, is_present: bool) -> None:
    """Adds a member to a set if it is present on the network, and removes it otherwise.

    The network may report the same presence twice. The second report has no effect.
    """
    if is_present:
        members.add(member)
    else:
        members.discard(member)

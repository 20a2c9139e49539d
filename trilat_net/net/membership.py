"""Membership of a session: who takes part, and who is present.

A member is a site or a recorder. Each start of a member has its own boot, a random number; a
liveliness token under that boot shows others that the member is present. Members learn one
another's identities (`Info`) by queries.

Invariant:
    - A different scenario, a running session, and a second start of a present member are
      refused at the first exchange. Replies of strangers are ignored, and kept for the error
      message.
    - A recorder may join a running session, and several recorders may be present. A recorder
      that joins late reads identities, epoch and boots from the running members. It waits for
      the members that are present and answer pings, and not for those that left.
    - A site joins a running session only if `LateSites.may_join_late` is True, which requires
      that every site of the scenario waits for its peers and aligns with them.
"""

import hashlib
import platform
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import msgspec

from ..core.fingerprint import compute_fingerprint
from ..core.site_setup import Layout
from ..errors import SessionError, WireError
from . import topics
from .bus import Bus, Inbox
from .clock import Clock
from .messages import Event, Info, State
from .pinging import RepeatedQuery
from .wire import M, decode, encode, split_states


def new_boot() -> int:
    """Returns a random 64-bit number that identifies one start of one process."""
    return secrets.randbits(64)


def describe_member(
    member: str, boot: int, clock: Clock, scenario: str = "", **fields: object
) -> Info:
    """Returns the identity of a member on this machine.

    Args:
        member: name of the member.
        boot: random number of the process start.
        clock: clock of the member.
        scenario: text of the member's scenario; "" if the member has none.
        **fields: further fields of `Info`.
    """
    digest = hashlib.sha256(scenario.encode()).hexdigest() if scenario else ""
    facts = {
        "member": member,
        "boot": boot,
        "scenario_sha256": digest,
        "scenario": scenario,
        "host": platform.node(),
        "clock": clock.identity(),
        "fingerprint": compute_fingerprint(),
    }
    return msgspec.convert({**facts, **fields}, Info)


def liveliness_token(session: str, member: str, boot: int) -> str:
    """Returns the key of the liveliness token of one start of a member."""
    return topics.key(session, member, topics.ALIVE) + f"/{boot}"


def read_messages(inbox: Inbox, kind: type[M]) -> Iterator[M]:
    """Yields the messages of one kind that wait in a ring, and skips other payloads."""
    while (message := inbox.poll()) is not None:
        # Payloads of strangers are skipped here; sites and recorder count them.
        with suppress(WireError):
            yield decode(message[1], kind)


def read_records(inbox: Inbox, layout: Layout | None = None) -> Iterator[State]:
    """Yields the records that wait in a ring.

    Other payloads are skipped, and so is the rest of a block after an unreadable record.
    """
    while (message := inbox.poll()) is not None:
        with suppress(WireError):
            for payload in split_states(message[1]):
                yield decode(payload, State, layout=layout)


class EventPublisher:
    """Publishes a member's events, and replies to queries for the member's identity.

    Args:
        bus: connection of the member.
        session: name of the session.
        info: identity of the member.
        keep: receives the payload of every published event.

    Attributes:
        info: identity with which queries are replied to.
        published: number of events published so far.
    """

    def __init__(
        self, bus: Bus, session: str, info: Info, keep: Callable[[bytes], None] = lambda _: None
    ) -> None:
        self.info = info
        self.published = 0
        self._keep = keep
        self._publish = bus.publisher(topics.key(session, info.member, topics.EVENT))
        self._queries = bus.query_inbox(topics.key(session, info.member, topics.INFO))

    def publish(self, kind: str, text: str, **fields: object) -> Event:
        """Publishes an event with the next number, and returns the event."""
        facts = {
            "member": self.info.member,
            "boot": self.info.boot,
            "n": self.published,
            "kind": kind,
            "text": text,
        }
        event = msgspec.convert({**facts, **fields}, Event)
        self.published += 1
        payload = encode(event)
        self._keep(payload)
        self._publish(payload)
        return event

    def update(self, **fields: object) -> None:
        """Changes fields of the identity."""
        self.info = msgspec.structs.replace(self.info, **fields)

    def answer_queries(self) -> None:
        """Replies to all waiting queries for the identity."""
        while (query := self._queries.poll()) is not None:
            query.reply(encode(self.info))


class MemberQuery:
    """Repeated query for the identities of a session's members.

    Args:
        bus: connection of the member that queries.
        clock: clock of that member.
        session: name of the session.
        member: name of the member to query; "*" for all members.

    Attributes:
        unreadable: why a reply cannot be read, by member.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, member: str = "*") -> None:
        self.unreadable: dict[str, str] = {}
        self._query = RepeatedQuery(bus, clock, topics.key(session, member, topics.INFO))

    def poll(self) -> Iterator[Info]:
        """Yields the identities that have arrived, and repeats the query when it is due."""
        while (reply := self._query.poll()) is not None:
            _, key, payload = reply
            parts = topics.parse_key(key)
            if parts is None:
                continue
            try:
                info = decode(payload, Info)
            except WireError as error:  # another version of this program, or a stranger
                self.unreadable[parts.member] = str(error)
                continue
            if parts.member == info.member:
                yield info
        self._query.repeat()


class LateSites(NamedTuple):
    """Rules for sites that join late, as one site of a session knows them.

    Attributes:
        may_join_late: True if this site may join a running session. Then every site of the
            scenario waits for its peers and aligns with them.
        not_awaited: sites without which the session starts, if this site is the leader.
        rate_hz: tick rate of this site.
    """

    may_join_late: bool = False
    not_awaited: tuple[str, ...] = ()
    rate_hz: int = 1


class Membership:
    """The other members of a session, as one member knows them.

    Args:
        bus: connection of this member.
        clock: clock of this member.
        session: name of the session.
        publisher: publishes the events of this member.
        sites: sites of the scenario, the leader first. Empty for a recorder, which learns the
            sites from the members.
        late: rules for sites that join late.

    Attributes:
        others: identities of the other members that are known and present, by name.
        alive: boots of the members that are present, as text.
        gone: boots of the members that have disappeared, as text.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        publisher: EventPublisher,
        sites: Sequence[str],
        late: LateSites,
    ) -> None:
        self.others: dict[str, Info] = {}
        self.alive: set[str] = set()
        self.gone: set[str] = set()
        self._session = session
        self._publisher = publisher
        self._sites = tuple(sites)
        self._late = late
        self._presence = bus.presence(topics.presence_key(session, "*"))
        self._query = MemberQuery(bus, clock, session)
        self._refused_boots: set[int] = set()
        self._recorder_boots: set[str] = set()

    @property
    def local_info(self) -> Info:
        """Identity of this member."""
        return self._publisher.info

    @property
    def is_leader(self) -> bool:
        """True if this member is the first site of the scenario."""
        return self._sites[:1] == (self.local_info.member,)

    @property
    def unreadable(self) -> dict[str, str]:
        """Why the replies of members of the session cannot be read, by member."""
        members = (*self._sites, topics.RECORDER)
        return {
            name: reason for name, reason in self._query.unreadable.items() if name in members
        }

    def boots(self) -> dict[str, int]:
        """Returns the boots of all members present, including this member."""
        boots = {name: info.boot for name, info in self.others.items()}
        return boots | {self.local_info.member: self.local_info.boot}

    def clocks(self) -> dict[str, str]:
        """Returns the clock identities of all members present, including this member."""
        clocks = {name: info.clock for name, info in self.others.items()}
        return clocks | {self.local_info.member: self.local_info.clock}

    def list_missing(self) -> list[str]:
        """Returns the members that the session waits for and that are not known yet."""
        needs_recorder = any(
            info.needs_recorder for info in (self.local_info, *self.others.values())
        )
        recorder = [topics.RECORDER] if needs_recorder or self._recorder_boots else []
        not_missing = {self.local_info.member, *self.others, *self._late.not_awaited}
        return [name for name in (*self._sites, *recorder) if name not in not_missing]

    def has_restarted(self, name: str, boot: int) -> bool:
        """True if a member is present with another boot, and not with this boot."""
        info = self.others.get(name)
        return info is not None and info.boot != boot and str(boot) not in self.alive

    def list_running(self) -> list[Info]:
        """Returns the running sites that agree on the members of the session, by name."""
        infos = [
            info
            for _, info in sorted(self.others.items())
            if info.running and info.scenario and info.boots.get(info.member) == info.boot
        ]
        # Some of the sites may have admitted this member already: its boot is left out.
        local_boot = {self.local_info.member: self.local_info.boot}
        return [
            info for info in infos if info.boots | local_boot == infos[0].boots | local_boot
        ]

    def poll(self, *, may_have_started: bool) -> None:
        """Receives identities, repeats the query, and forgets members that are gone.

        Args:
            may_have_started: True if this member has sent `ready`: then other members may run
                before this member knows that the session has started.

        Raises:
            SessionError: this member cannot be part of the session.
        """
        for info in self._query.poll():
            self.receive_identity(info, may_have_started=may_have_started)
        for parts, is_alive in topics.read_presence(self._presence):
            self._update_presence(parts.member, parts.boot, is_alive=is_alive)

    def _update_presence(self, member: str, boot: str, *, is_alive: bool) -> None:
        if is_alive:
            self.alive.add(boot)
            self.gone.discard(boot)
        else:
            self.alive.discard(boot)
            self.gone.add(boot)
        if member == topics.RECORDER and is_alive:
            self._recorder_boots.add(boot)
        elif member == topics.RECORDER:
            self._recorder_boots.discard(boot)
        info = self.others.get(member)
        if not is_alive and info is not None and str(info.boot) == boot:
            del self.others[member]

    def receive_identity(self, info: Info, *, may_have_started: bool) -> None:
        """Receives the identity of a member; see `poll` for `may_have_started`.

        Raises:
            SessionError: this member cannot be part of the session.
        """
        local = self.local_info
        is_second_recorder = not self._sites and info.member == topics.RECORDER
        if info.boot == local.boot or is_second_recorder:
            return
        if info.running and not may_have_started and not self._may_join(info):
            raise SessionError(
                f"session {self._session!r} is running; {info.member} is at tick {info.ticks}"
            )
        if info.member == local.member:
            # Of two starts of one member the one with the lower boot stays.
            if info.boot < local.boot:
                raise SessionError(
                    f"there is already a {local.member} in session {self._session!r}"
                )
            return
        has_other_scenario = info.scenario_sha256 not in ("", local.scenario_sha256)
        if self._sites and has_other_scenario:
            if info.running and not may_have_started:
                raise SessionError(
                    f"session {self._session!r} runs another scenario, "
                    f"according to {info.member}"
                )
            self._refuse(info)
            return
        known = self.others.get(info.member, info)
        if info.member == topics.RECORDER and known.boot != info.boot:
            return  # of several recorders, the first one counts as the member
        if not self._sites or info.member in self._sites or info.member == topics.RECORDER:
            self.others[info.member] = info

    def _may_join(self, info: Info) -> bool:
        """True if this member may join the running session that a member is part of."""
        if not self._sites:
            return bool(info.boots)
        return self._late.may_join_late and info.member != self.local_info.member

    def _refuse(self, info: Info) -> None:
        """Refuses a member with another scenario; leaves the session if the leader has one.

        Raises:
            SessionError: the member is the leader, whose scenario counts.
        """
        local = self.local_info
        text = (
            f"another scenario: {info.member} has {info.scenario_sha256[:16]}, "
            f"{local.member} has {local.scenario_sha256[:16]}"
        )
        if not self.is_leader and info.member == self._sites[0]:
            raise SessionError(f"{text}; that of the leader {info.member} counts")
        if self.is_leader and info.boot not in self._refused_boots:
            self._refused_boots.add(info.boot)
            self._publisher.publish("refused", text, about=info.member)


class Epoch(NamedTuple):
    """Tick 0 of a session, and the first tick of a site that joins late.

    Attributes:
        mono_ns: the epoch on this process's monotonic clock.
        unix_ns: the epoch in Unix time, as the leader read it.
        boots: boots of the members, by name.
        epochs: the epoch on every member's own clock; empty for a recorder that joins late.
        first: the first tick of this site.
        coming: the event with which a site that joins late announces itself. The site repeats
            the event until all peers acknowledge its samples.
    """

    mono_ns: int
    unix_ns: int
    boots: Mapping[str, int]
    epochs: Mapping[str, int] = {}
    first: int = 0
    coming: Event | None = None

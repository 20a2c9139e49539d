"""Session membership: boots, liveliness tokens, events, and who is present.

Invariant: a different scenario, a running session and a second start of the same member are
refused at the first exchange; replies of strangers are ignored and kept for the error message.
A recorder may join a running session, and several recorders may be present. It then takes
identities, epoch and boots from the running members, waits for those that are present and can
be pinged, and not for those that left. A site joins late only if it `returns`: if every site of
the scenario waits for its peers and aligns with them.
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
    """Returns a random 64-bit number that names one start of one process."""
    return secrets.randbits(64)


def describe_member(
    member: str, boot: int, clock: Clock, scenario: str = "", **fields: object
) -> Info:
    """Returns the identity of a member on this machine, with the text of its scenario, "" for
    none.
    """
    digest = hashlib.sha256(scenario.encode()).hexdigest() if scenario else ""
    about = {"member": member, "boot": boot, "scenario_sha256": digest, "scenario": scenario}
    machine = {
        "host": platform.node(),
        "clock": clock.identity(),
        "fingerprint": compute_fingerprint(),
    }
    return msgspec.convert({**about, **machine, **fields}, Info)


def liveliness_token(session: str, member: str, boot: int) -> str:
    """Returns the key of the liveliness token of one start of a member."""
    return topics.key(session, member, topics.ALIVE) + f"/{boot}"


def read_messages(inbox: Inbox, kind: type[M]) -> Iterator[M]:
    """Yields the messages of a kind that wait in a ring; skips other payloads."""
    while (message := inbox.poll()) is not None:
        with suppress(WireError):  # a stranger's; the sites and the recorder count them
            yield decode(message[1], kind)


def read_records(inbox: Inbox, layout: Layout | None = None) -> Iterator[State]:
    """Yields the records that wait in a ring; skips other payloads, and of a block what follows
    one.
    """
    while (message := inbox.poll()) is not None:
        with suppress(WireError):
            for payload in split_states(message[1]):
                yield decode(payload, State, layout=layout)


class EventPublisher:
    """Publishes a member's events and answers queries for its identity.

    It answers with `info`; `keep` takes the payload of every event.
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
        """Publishes a numbered event and returns it."""
        own = {"member": self.info.member, "boot": self.info.boot, "n": self.published}
        event = msgspec.convert({**own, "kind": kind, "text": text, **fields}, Event)
        self.published += 1
        payload = encode(event)
        self._keep(payload)
        self._publish(payload)
        return event

    def update(self, **fields: object) -> None:
        """Changes fields of the identity."""
        self.info = msgspec.structs.replace(self.info, **fields)

    def answer_queries(self) -> None:
        """Answers every query for the identity that waits."""
        while (query := self._queries.poll()) is not None:
            query.reply(encode(self.info))


class MemberQuery:
    """Asks the members of a session for their identities, again and again; notes why one is
    unreadable.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, member: str = "*") -> None:
        self.unreadable: dict[str, str] = {}
        self._query = RepeatedQuery(bus, clock, topics.key(session, member, topics.INFO))

    def poll(self) -> Iterator[Info]:
        """Yields the answers that have arrived; repeats the query when it is due."""
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
    """Which sites may join a session that runs, as one of its sites knows it.

    Attributes:
        returns: True if this site may: every one of the scenario waits for its peers and aligns
            with them.
        without: sites without which the session begins, if this one leads.
    """

    returns: bool = False
    without: tuple[str, ...] = ()
    rate_hz: int = 1


class Membership:
    """The other members of a session, as one member knows them; a recorder, without sites,
    learns these.

    Attributes:
        met: identities of the others, by name.
        alive, gone: boots of the members that are present, and of those that have disappeared.
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
        self._refused: set[int] = set()
        self._recorders: set[str] = set()

    @property
    def local_info(self) -> Info:
        """The member's own identity."""
        return self._publisher.info

    @property
    def is_leader(self) -> bool:
        """True if this member is the first site of the scenario."""
        return self._sites[:1] == (self.local_info.member,)

    @property
    def unreadable(self) -> dict[str, str]:
        """By name of a member of the session, why its answer cannot be read."""
        members = (*self._sites, topics.RECORDER)
        return {
            name: reason for name, reason in self._query.unreadable.items() if name in members
        }

    def boots(self) -> dict[str, int]:
        """Returns the boots of all members present, including its own."""
        return {name: info.boot for name, info in self.others.items()} | {
            self.local_info.member: self.local_info.boot
        }

    def clocks(self) -> dict[str, str]:
        """Returns the identities of their clocks."""
        return {name: info.clock for name, info in self.others.items()} | {
            self.local_info.member: self.local_info.clock
        }

    def list_missing(self) -> list[str]:
        """Returns the members that have not been met."""
        needed = any(info.needs_recorder for info in (self.local_info, *self.others.values()))
        recorder = [topics.RECORDER] if needed or self._recorders else []
        return [
            name
            for name in (*self._sites, *recorder)
            if name != self.local_info.member
            and name not in self.others
            and name not in self._late.without
        ]

    def has_restarted(self, name: str, boot: int) -> bool:
        """True if another start of a member is here, and the one of this boot is not."""
        met = self.others.get(name)
        return met is not None and met.boot != boot and str(boot) not in self.alive

    def list_running(self) -> list[Info]:
        """Returns the sites of a running session that were met, of those that agree on its
        other members.
        """
        infos = [
            info
            for _, info in sorted(self.others.items())
            if info.running and info.scenario and info.boots.get(info.member) == info.boot
        ]
        own = {self.local_info.member: self.local_info.boot}  # some may have admitted it
        return [info for info in infos if info.boots | own == infos[0].boots | own]

    def poll(self, *, invited: bool) -> None:
        """Takes answers, repeats the query, and forgets members that are gone.

        Once this member is invited, has sent `ready`, others may begin before it knows.

        Raises:
            SessionError: this member cannot be part of the session.
        """
        for info in self._query.poll():
            self.receive_identity(info, invited=invited)
        for parts, alive in topics.read_presence(self._presence):
            if parts.member == topics.RECORDER:
                (self._recorders.add if alive else self._recorders.discard)(parts.boot)
            (self.gone.discard if alive else self.gone.add)(parts.boot)
            (self.alive.add if alive else self.alive.discard)(parts.boot)
            met = self.others.get(parts.member)
            if not alive and met is not None and str(met.boot) == parts.boot:
                del self.others[parts.member]

    def receive_identity(self, info: Info, *, invited: bool) -> None:
        """Takes the identity of a member.

        Raises:
            SessionError: this member cannot be part of the session.
        """
        own = self.local_info
        if info.boot == own.boot or (not self._sites and info.member == topics.RECORDER):
            return
        comes_late = self._late.returns and info.member != own.member
        if info.running and not invited and (not comes_late if self._sites else not info.boots):
            raise SessionError(
                f"session {self._session!r} is running; {info.member} is at tick {info.ticks}"
            )
        if info.member == own.member:
            if info.boot < own.boot:
                raise SessionError(
                    f"there is a {own.member} in session {self._session!r} already"
                )
            return
        if self._sites and info.scenario_sha256 and info.scenario_sha256 != own.scenario_sha256:
            if info.running and not invited:
                raise SessionError(
                    f"session {self._session!r} runs another scenario, {info.member} says"
                )
            self._refuse(info)
            return
        if (
            info.member == topics.RECORDER
            and self.others.get(info.member, info).boot != info.boot
        ):
            return  # of several recorders the first one met is the member
        if not self._sites or info.member in self._sites or info.member == topics.RECORDER:
            self.others[info.member] = info

    def _refuse(self, info: Info) -> None:
        """Leaves the session of a leader with another scenario; as the leader, publishes a
        refusal.
        """
        own = self.local_info
        text = (
            f"another scenario: {info.member} has {info.scenario_sha256[:16]}, "
            f"{own.member} has {own.scenario_sha256[:16]}"
        )
        if not self.is_leader and info.member == self._sites[0]:
            raise SessionError(f"{text}; the one of {info.member}, who leads, counts")
        if self.is_leader and info.boot not in self._refused:
            self._refused.add(info.boot)
            self._publisher.publish("refused", text, about=info.member)


class Epoch(NamedTuple):
    """Tick 0 of a session, and the first tick of a site that joins late.

    Attributes:
        mono_ns: on this process's monotonic clock.
        unix_ns: in Unix time, as the leader read it.
        epochs: the same instant on every member's own clock; empty for a recorder that joins
            late.
        first: the first tick of this site.
        coming: what it says who joins late, until all acknowledge its samples.
    """

    mono_ns: int
    unix_ns: int
    boots: Mapping[str, int]
    epochs: Mapping[str, int] = {}
    first: int = 0
    coming: Event | None = None

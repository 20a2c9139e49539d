"""Keeps track of which processes take part in a session, and which of them are present.

These processes are called members: a site runs one arm and its control loop, and a recorder
writes the log. Members find each other in two ways. Each member declares a Zenoh liveliness
token, which lets the network itself report when the member appears and disappears. Each member
also replies to queries with its identity (`Info`): the scenario, the clock, the state of the
session, and the boot. The boot is a random number that distinguishes one start of a process
from all others.

Invariant:
    - A site gives up if the session is already running, if another member has a different
      scenario, or if the same site was started twice. This is decided when the first identity
      arrives, before any arm has moved.
    - A site may join a running session only if `LateSites.may_join_late` is True. This requires
      every site of the scenario to wait for its peers and align with them before moving;
      otherwise the arms would jump.
    - A recorder may join a running session, and several recorders may be present. A recorder
      that joins late obtains the sites, the start time and the boots from the identities of the
      running sites.
    - Replies from programs that are not members of the session are ignored. The reason why they
      cannot be decoded is kept for the error message.
"""

import hashlib
import platform
import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from ..errors import SessionError
from . import topics
from .bus import Bus
from .clock import Clock
from .messages import Event, Info
from .scenario_difference import describe_scenario_difference
from .session_members import SessionMembers
from .wire import encode


def new_boot() -> int:
    """Returns a random 64-bit number that identifies one start of a process.

    If a process is restarted under the same name, other processes recognise the new instance by
    its new number.
    """
    return secrets.randbits(64)


def describe_member(
    member: str,
    boot: int,
    clock: Clock,
    fingerprint: str,
    scenario: str = "",
    **fields: object,
) -> Info:
    """Returns the identity with which a member introduces itself to the rest of the session.

    In addition to the given fields, the identity contains the hash of the scenario, the name of
    the machine and the identity of the clock.

    Args:
        member: Name of the member.
        boot: Random number that identifies this start of the process.
        clock: Clock of the member.
        fingerprint: Fingerprint of the floating-point arithmetic on the member's platform.
        scenario: Text of the scenario file. Empty if the member does not know the scenario.
        **fields: Other fields of `Info`.
    """
    digest = hashlib.sha256(scenario.encode()).hexdigest() if scenario else ""
    basic_fields = {
        "member": member,
        "boot": boot,
        "scenario_sha256": digest,
        "scenario": scenario,
        "host": platform.node(),
        "clock": clock.identity(),
        "fingerprint": fingerprint,
    }
    return msgspec.convert({**basic_fields, **fields}, Info)


class EventPublisher:
    """Publishes the events of one member, and replies to queries for its identity.

    Events are numbered messages such as "start", "mode" or "end". The recorder stores them, and
    the other members react to them.

    Args:
        bus: Network connection of the member.
        session: Name of the session.
        info: Identity of the member.
        keep: Function that receives the payload of every published event, for example to keep
            it until the recorder has received it.

    Attributes:
        info: Current identity of the member.
        published: Number of events published so far, which is also the number of the next
            event.
    """

    def __init__(
        self,
        bus: Bus,
        session: str,
        info: Info,
        keep: Callable[[bytes], None] = lambda _: None,
    ) -> None:
        """Opens the channel for this process's events, and answers queries for its identity."""
        self.info = info
        self.published = 0
        self._keep = keep
        self._publish = bus.publisher(topics.key(session, info.member, topics.EVENT))
        self._queries = bus.query_inbox(topics.key(session, info.member, topics.INFO))

    def publish(self, kind: str, text: str, **fields: object) -> Event:
        """Publishes an event to all other processes and gives it the next number.

        Args:
            kind: Kind of the event, for programs.
            text: Description of the event in one sentence, for people.
            **fields: Other fields of `Event`. They may also override the basic fields, for
                example when an event is published again.

        Returns:
            The event.
        """
        default_fields = {
            "member": self.info.member,
            "boot": self.info.boot,
            "n": self.published,
            "kind": kind,
            "text": text,
        }
        event = msgspec.convert({**default_fields, **fields}, Event)
        self.published += 1
        payload = encode(event)
        self._keep(payload)
        self._publish(payload)
        return event

    def publish_clocks(self, notices: Iterable[Mapping[str, Any]], t_ns: int) -> None:
        """Publishes events about the offsets and faults of the peers' clocks.

        Recorders store these events, which show readers of the log how closely the clocks
        agreed.

        Args:
            notices: One mapping per event, from field name to value.
            t_ns: Time of the events, in ns since the epoch (the common start of the session).
        """
        for notice in notices:
            self.publish(**notice, t_ns=t_ns)

    def update(self, **fields: object) -> None:
        """Changes fields of this process's identity, which other processes can query.

        Args:
            **fields: New values for fields of `Info`. All other fields stay the same.
        """
        self.info = msgspec.structs.replace(self.info, **fields)

    def answer_queries(self) -> None:
        """Answers all pending queries from other processes with the identity of this process.

        Never waits, so a control loop can call it.
        """
        while (query := self._queries.poll()) is not None:
            query.reply(encode(self.info))


class LateSites(NamedTuple):
    """Says whether a site may join a running session, and which sites may miss the start.

    Attributes:
        may_join_late: True if this site may join a running session. Set it only if every site
            of the scenario waits for the other sites and aligns its arm with them before
            moving; otherwise the arms would jump.
        not_awaited: Names of the sites that the session does not wait for at its start. Only
            used by the leader, which is the first site of the scenario.
        rate_hz: Tick rate of this site, in Hz.
    """

    may_join_late: bool = False
    not_awaited: tuple[str, ...] = ()
    rate_hz: int = 1


class Membership:
    """A member's up-to-date list of the other members of the session.

    A site uses this list to decide when the session can start. A recorder uses it to find out
    which sites exist, and to join a running session.

    Args:
        bus: Network connection of this member.
        clock: Clock of this member.
        session: Name of the session.
        publisher: Publishes the events of this member.
        sites: Names of the scenario's sites. The first one is the leader. Empty for a recorder,
            which obtains the sites from the members.
        late: Rules for sites that join while the session is running.

    Attributes:
        others: Mapping from name to identity for each other member that is present and has
            introduced itself.
        alive: Boots of the members that are present, as strings. A boot is the random number
            that identifies the start of a member's process.
        gone: Boots of the members that have disappeared, as strings.
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
        """Subscribes to the presence of a session's members. None of them is known yet."""
        self.others: dict[str, Info] = {}
        self.alive: set[str] = set()
        self.gone: set[str] = set()

        self._session = session
        self._publisher = publisher
        self._sites = tuple(sites)
        self._late = late

        # Liveliness tokens show which processes are present, and replies to queries identify
        # them.
        self._presence = bus.presence(topics.presence_key(session, "*"))
        self._members = SessionMembers(bus, clock, session)
        self._refused_boots: set[int] = set()  # members whose refusal was published
        self._recorder_boots: set[str] = set()  # recorders that are present

    @property
    def local_info(self) -> Info:
        """Identity of this process, which other processes of the session can query."""
        return self._publisher.info

    @property
    def is_leader(self) -> bool:
        """True if this process is the leader (the first site of the scenario).

        The leader decides when the session starts, and all other sites follow its schedule.
        """
        return self._sites[:1] == (self.local_info.member,)

    @property
    def unreadable(self) -> dict[str, str]:
        """Reasons why replies could not be decoded, keyed by the name of the member.

        This happens, for example, if a member runs another version of the program. Empty if all
        replies could be decoded.
        """
        expected_members = (*self._sites, topics.RECORDER)
        return {
            name: reason
            for name, reason in self._members.unreadable.items()
            if name in expected_members
        }

    def boots(self) -> dict[str, int]:
        """Maps the name of each member present, including this one, to its boot.

        The boot is the random number that identifies the start of a member's process.
        """
        boots = {name: info.boot for name, info in self.others.items()}
        return boots | {self.local_info.member: self.local_info.boot}

    def clocks(self) -> dict[str, str]:
        """Maps the name of each member present, including this one, to its clock identity.

        Members with the same clock identity run on the same machine, so their times can be
        compared directly.
        """
        clocks = {name: info.clock for name, info in self.others.items()}
        return clocks | {self.local_info.member: self.local_info.clock}

    def list_missing(self) -> list[str]:
        """Lists the members that must still appear before the session can start.

        These are the sites of the scenario that are not known yet, except those that need not
        be awaited. The recorder is included if it is not known yet and either a member requires
        it or its liveliness token shows that it is about to join.

        Returns:
            The names. Empty if the session can start.
        """
        members = [self.local_info, *self.others.values()]
        needs_recorder = any(info.needs_recorder for info in members)
        awaited_members = [*self._sites]
        if needs_recorder or self._recorder_boots:
            awaited_members.append(topics.RECORDER)

        known_members = {self.local_info.member, *self.others, *self._late.not_awaited}
        return [name for name in awaited_members if name not in known_members]

    def has_restarted(self, name: str, boot: int) -> bool:
        """Returns True if a process has disappeared and another one has taken its name.

        Args:
            name: Name of the member.
            boot: Random number that identifies the start of the former process.
        """
        info = self.others.get(name)
        return info is not None and info.boot != boot and str(boot) not in self.alive

    def list_running(self) -> list[Info]:
        """Lists the running sites that agree on who takes part in the session.

        Every running site states which members it has admitted, and the boot of each of them
        (the random number that identifies the start of its process). Two sites agree if they
        state the same boots. The boot of this member is ignored in the comparison, because some
        sites may have admitted this member already while others have not.

        Returns:
            The identities of the sites that agree with the first running site, sorted by name.
            Empty if no site is running.
        """
        running = []
        for _, info in sorted(self.others.items()):
            is_admitted = info.boots.get(info.member) == info.boot
            if info.running and info.scenario and is_admitted:
                running.append(info)
        if not running:
            return []

        local_boot = {self.local_info.member: self.local_info.boot}
        expected_boots = running[0].boots | local_boot
        return [info for info in running if info.boots | local_boot == expected_boots]

    def poll(self, *, may_have_started: bool) -> None:
        """Updates the list of members: adds those that reply, and removes those that have left.

        The query for the identities of the members is repeated when it is due. Never waits.

        Args:
            may_have_started: True if this member has announced that it is ready. The session
                may then start before this member is informed, so the member does not give up if
                a site is already running.

        Raises:
            SessionError: This member cannot be part of the session.
        """
        for info in self._members.poll():
            self.receive_identity(info, may_have_started=may_have_started)
        for parts, is_alive in topics.read_presence(self._presence):
            self._update_presence(parts.member, parts.boot, is_alive=is_alive)

    def _update_presence(self, member: str, boot: str, *, is_alive: bool) -> None:
        """Updates the lists after the token of a member has appeared or disappeared.

        Args:
            member: Name of the member.
            boot: Boot of the member, as the string contained in the key of the token.
            is_alive: True if the token has appeared.
        """
        is_recorder = member == topics.RECORDER
        if is_alive:
            self.alive.add(boot)
            self.gone.discard(boot)
            if is_recorder:
                self._recorder_boots.add(boot)
            return

        self.alive.discard(boot)
        self.gone.add(boot)
        if is_recorder:
            self._recorder_boots.discard(boot)
        info = self.others.get(member)
        if info is not None and str(info.boot) == boot:
            del self.others[member]

    def receive_identity(self, info: Info, *, may_have_started: bool) -> None:
        """Adds a member to the list when its identity arrives, or rejects it.

        Args:
            info: Identity of the member.
            may_have_started: True if the session may already have started, see `poll`.

        Raises:
            SessionError: This member cannot be part of the session because the session is
                already running, has a different scenario, or contains another process with the
                name of this member.
        """
        local = self.local_info
        is_recorder = info.member == topics.RECORDER
        is_second_recorder = not self._sites and is_recorder
        if info.boot == local.boot or is_second_recorder:
            return

        is_running = info.running and not may_have_started
        if is_running and not self._may_join(info):
            raise SessionError(
                f"session {self._session!r} is running; {info.member} is at tick {info.ticks}"
            )
        if info.member == local.member:
            # If a member was started twice, the start with the lower boot stays.
            if info.boot < local.boot:
                raise SessionError(
                    f"session {self._session!r} already has a member named {local.member}"
                )
            return

        has_other_scenario = info.scenario_sha256 not in ("", local.scenario_sha256)
        if self._sites and has_other_scenario:
            if is_running:
                raise SessionError(
                    f"session {self._session!r} runs another scenario, "
                    f"according to {info.member}{self._describe_difference(info)}"
                )
            self._refuse(info)
            return

        known = self.others.get(info.member, info)
        if is_recorder and known.boot != info.boot:
            return  # of several recorders, only the first is a member
        is_in_scenario = not self._sites or info.member in self._sites
        if is_in_scenario or is_recorder:
            self.others[info.member] = info

    def _may_join(self, info: Info) -> bool:
        """Returns True if this member may join the running session described by `info`.

        A recorder only needs to know the boots of the session's members. A site must be allowed
        to join late, and must not already be running in the session.
        """
        is_local_recorder = not self._sites
        if is_local_recorder:
            return bool(info.boots)
        return self._late.may_join_late and info.member != self.local_info.member

    def _describe_difference(self, info: Info) -> str:
        """Returns a phrase about the settings in which the scenario of another member differs.

        The phrase begins with a semicolon, and is empty if no settings can be named.

        Args:
            info: Identity of the other member, with its scenario.
        """
        local = self.local_info
        phrase = describe_scenario_difference(
            info.scenario, local.scenario, info.member, local.member
        )
        return f"; {phrase}" if phrase else ""

    def _refuse(self, info: Info) -> None:
        """Rejects a member whose scenario differs, or gives up if that member is the leader.

        The scenario of the leader (the first site) is that of the session. If this member is
        the leader, it publishes once that the other member is rejected. If the other member is
        the leader, this member gives up. If neither is the leader, nothing happens.

        Args:
            info: Identity of the other member.

        Raises:
            SessionError: The other member is the leader.
        """
        local = self.local_info
        must_leave = not self.is_leader and info.member == self._sites[0]
        must_report = self.is_leader and info.boot not in self._refused_boots
        if not must_leave and not must_report:
            return

        text = (
            f"the scenarios differ: {info.member} has scenario {info.scenario_sha256[:16]}, "
            f"{local.member} has scenario {local.scenario_sha256[:16]}"
            f"{self._describe_difference(info)}"
        )
        if must_leave:
            raise SessionError(
                f"{text}; the leader {info.member} decides: start this site with the same "
                "--scenario and the same --set"
            )
        self._refused_boots.add(info.boot)
        self._publisher.publish("refused", text, about=info.member)


class Epoch(NamedTuple):
    """Common start time of a session (the time of tick 0), as known to one member.

    `SessionJoin.poll` returns this object when the members have agreed on the epoch, or when
    this member has been admitted to a running session.

    Attributes:
        mono_ns: The epoch on the monotonic clock of this process.
        unix_ns: The epoch in Unix time, as read from the leader's clock.
        boots: Mapping from the name of each member to its boot, the random number that
            identifies the start of its process.
        epochs: Mapping from the name of each member to the epoch on its own monotonic clock.
            Empty for a recorder that joins late, which needs only its own clock.
        first: First tick that this site executes. 0 unless the site joins late.
        coming: Event with which this site asked to join the running session. The site keeps
            publishing it until all peers confirm that they receive its samples. None if the
            site was present from the start.
    """

    mono_ns: int
    unix_ns: int
    boots: Mapping[str, int]
    epochs: Mapping[str, int] = {}
    first: int = 0
    coming: Event | None = None

"""Members that join a session, in one process, on a clock that a test moves."""

from collections.abc import Sequence
from contextlib import suppress

import msgspec

from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.membership import Epoch, EventPublisher
from trilat_net.net.messages import Event, Info
from trilat_net.net.session import SessionJoin
from trilat_net.net.wire import decode

from .local_bus import LocalNetwork

SESSION = "t"
STEP_NS = 20_000_000
HASH = "5c" * 32
CLOCK = ManualClock().identity()


def answer_info(name: str, boot: int, **facts: object) -> Info:
    """Returns a member's answer about its identity; `facts` override."""
    recorder = name == topics.RECORDER
    info_facts = {
        "scenario_sha256": "" if recorder else HASH,
        "scenario": "" if recorder else "the scenario",
    }
    info_facts |= {"host": "h", "clock": CLOCK, "fingerprint": "f"}
    return Info(**{"member": name, "boot": boot, **info_facts, **facts})


class Elsewhere(ManualClock):
    """The clock of another machine, which differs in both of its readings."""

    def __init__(self, start_ns: int, unix_ns: int, name: str) -> None:
        super().__init__(start_ns, unix_ns)
        self._name = name

    def identity(self) -> str:
        return self._name


class Member:
    def __init__(self, bus: Bus, clock: Clock, sites: Sequence[str], info: Info) -> None:
        self.info = info
        self.bus = bus
        self.epoch: Epoch | None = None
        self.publisher = EventPublisher(bus, SESSION, info)
        self.joining = SessionJoin(bus, clock, SESSION, self.publisher, sites)

    def poll(self) -> None:
        """Polls once as a process does: joins, and answers once it has the epoch."""
        if self.epoch is None:
            self.epoch = self.joining.poll()
            if self.epoch is not None:
                self.publisher.info = msgspec.structs.replace(
                    self.info,
                    running=True,
                    epoch_mono_ns=self.epoch.mono_ns,
                    epoch_unix_ns=self.epoch.unix_ns,
                    boots=self.epoch.boots,
                )
        else:
            self.publisher.answer_queries()


class Party:
    """A session's network, its clock, its present members, and all events so far."""

    def __init__(self, sites: Sequence[str]) -> None:
        self.sites = tuple(sites)
        self.clock = ManualClock(10**9, 1_700_000_000_000_000_000)
        self._clocks = [self.clock]
        self.network = LocalNetwork()
        self.members: dict[str, Member] = {}
        self.stranger = self.network.join()
        self._ear = self.network.join().inbox(topics.key(SESSION, "*", topics.EVENT))
        self.said: list[Event] = []
        self._boot = 100

    def elsewhere(self, ahead_ns: int, unix_ns: int = 0, name: str = "elsewhere") -> Elsewhere:
        """Returns the clock of another machine, which advances like the one here."""
        clock = Elsewhere(self.clock.monotonic_ns() + ahead_ns, unix_ns, name)
        self._clocks.append(clock)
        return clock

    def member(self, name: str, **facts: object) -> Member:
        self._boot += 1
        clock = facts.pop("on_clock", self.clock)
        sites = () if name == topics.RECORDER else self.sites
        facts = {"boot": self._boot, "clock": clock.identity(), **facts}
        return Member(self.network.join(), clock, sites, answer_info(name, **facts))

    def start(self, *names: str, **facts: object) -> None:
        for name in names:
            self.members[name] = self.member(name, **facts)

    def kill(self, name: str) -> None:
        self.members.pop(name).bus.close()

    def say(self, key_member: str, payload: bytes, channel: str = topics.EVENT) -> None:
        self.stranger.publisher(topics.key(SESSION, key_member, channel))(payload)

    def listen(self) -> list[Event]:
        while (message := self._ear.poll()) is not None:
            with suppress(WireError):  # what strangers say
                self.said.append(decode(message[1], Event))
        return self.said

    def kinds(self) -> list[str]:
        return [event.kind for event in self.listen()]

    def round(self, *names: str) -> None:
        for name in names or tuple(self.members):
            self.members[name].poll()
        for clock in self._clocks:
            sleep_for_ns(clock, STEP_NS)

    def rounds(self, count: int) -> None:
        for _ in range(count):
            self.round()

    def agreed(self, within_s: float = 5.0) -> Epoch:
        """Lets all members poll until each has its epoch; returns the epoch on which all agree."""
        for _ in range(int(within_s * 1e9) // STEP_NS):
            if all(member.epoch for member in self.members.values()):
                break
            self.round()
        epochs = {name: member.epoch for name, member in self.members.items()}
        first = next(iter(epochs.values()))
        assert first is not None
        assert all(epoch == first for epoch in epochs.values()), epochs
        assert first.boots == {name: member.info.boot for name, member in self.members.items()}
        return first

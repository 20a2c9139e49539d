"""A session of three sites and a recorder with faults, in one process, and its published
messages.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from itertools import chain
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import msgpack

from tests.log.disks import SmallDisk, open_file_on
from tests.sites.relay import RelayClock
from tests.sites.sessions import SESSION, Session
from trilat_net.errors import WireError
from trilat_net.log.log_file import LogFile
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.requests import ChangeRequest
from trilat_net.net.wire import decode, encode, split_states
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.signals import Interrupt

from .fault_schedule import (
    MEMBERS,
    SITES,
    WHOLE,
    ArmSettings,
    Fault,
    Timetable,
    order_of,
    storm_of,
)
from .faulty_network import FaultyNetwork

NEVER_NS = 2_000 * 10**9
"""The time of a start that is set only once the session begins."""
LINK_S = 0.03
"""Delay of the links."""
RECONNECT_S = 0.1
"""The least time from the end of a connection to the next one."""
LOOKS_AGAIN_S = 0.25
"""The time after which an operator repeats an order."""
DEFAULT_ARMS = ArmSettings()
KEYS: dict[str, Any] = {
    "rate_hz": 1000,
    "link": {"delay_ms": 1e3 * LINK_S},
    "on_stale.action": "glide",
    "on_stale.align_limit_rad": 3.0,
    "on_stale.align_speed_rad_s": 2.0,
    "limits": {
        "tau_limit_nm": 80.0,
        "qd_des_limit_rad_s": 5.0,
        "q_min_rad": -6.0,
        "q_max_rad": 6.0,
    },
}


@cache
def make_fault_scenario(
    timetable: Timetable = WHOLE, arms: ArmSettings = DEFAULT_ARMS
) -> Scenario:
    """Returns the paper's arms and law without hands, under the rule that waits, aligns, holds
    and returns.
    """
    keys: dict[str, Any] = {"limits.qd_limit_rad_s": arms.qd_limit_rad_s}
    if arms.tau_rate_limit_nm_s is not None:
        keys["limits.tau_rate_limit_nm_s"] = arms.tau_rate_limit_nm_s
    if any(arms.start_rad_s):
        keys |= {f"sites.{name}.qd0_rad_s": list(arms.start_rad_s) for name in SITES}
    if arms.learnt:
        keys["control.theta_hat0"] = (
            arms.learnt * load_scenario("free").arms["s"].theta
        ).tolist()
    return load_scenario("free", {"duration_s": timetable.length_s, **KEYS, **keys})


@dataclass
class Published:
    """The published messages of the sites of a session.

    Attributes:
        states: Every record, by site, in the order of sending.
        events: Every event.
    """

    states: dict[str, list[State]] = field(default_factory=lambda: {name: [] for name in SITES})
    events: list[Event] = field(default_factory=list)


INSISTS_NS = 300_000_000
"""The time from the first signal to the second one, which ends a site that waits for a lost recorder."""


@dataclass
class FaultSession(Session):
    """A session on a faulty network, with all messages of its sites."""

    faults: Sequence[Fault] = ()
    seed: int = 0
    timetable: Timetable = WHOLE
    epoch_ns: int = 0
    plans: list[tuple[Fault, RelayClock, Interrupt, RelayClock]] = field(default_factory=list)
    """Sites that end before their time: the fault, clock and signals, and the clock of the next start."""

    def __post_init__(self) -> None:
        self.network: FaultyNetwork = FaultyNetwork(self.relay, self.seed)
        self._boots = Random(self.seed)
        self._payloads: dict[str, list[bytes]] = {name: [] for name in SITES}
        self._events: list[bytes] = []
        self._recent: dict[str, list[bytes]] = {name: [] for name in SITES}
        self._stats: dict[str, bytes] = {}

    def join(self, name: str) -> Bus:
        return self.network.join_as(name)

    def live(self, name: str, clock: RelayClock, *parts: Any, **options: Any) -> int:
        try:
            return super().live(name, clock, *parts, **options)
        finally:
            for fault, ending, _, after in self.plans:
                if ending is clock:
                    planned_ns = self._at(fault.at_s + max(0.05, fault.for_s))
                    after.begins(max(planned_ns, clock.monotonic_ns()))

    def prepare(self) -> None:
        """Adds the members; the faults begin to count when the session does."""
        watcher = self.network.join_as("watcher")
        for name in SITES:
            records = self._payloads[name]
            watcher.tap(
                topics.key(SESSION, name, topics.STATE),
                lambda _, load, to=records: to.append(load),
            )
            recent = self._recent[name]
            watcher.tap(
                topics.key(SESSION, name, topics.SAMPLE),
                lambda _, load, to=recent: to.append(load),
            )
            link = topics.key(SESSION, name, topics.LINK)
            watcher.tap(link, lambda _, load, name=name: self._stats.update({name: load}))
        watcher.tap(topics.key(SESSION, "*", topics.EVENT), self._take_event)
        self.ends = {}
        self.recorder()
        for name in SITES:
            self.site(name, needs_recorder=False)
        for fault in self.faults:
            if fault.kind in ("kill", "end"):
                self._returns(fault)

    def _returns(self, fault: Fault) -> None:
        (name,) = fault.of
        clock = self.clocks[name]
        interrupt = self.interrupts[name]
        self.site(name, needs_recorder=False, at_ns=NEVER_NS)
        self.plans.append((fault, clock, interrupt, self.clocks[name]))

    def _take_event(self, _key: str, payload: bytes) -> None:
        self._events.append(payload)
        if not self.epoch_ns and b"start" in payload:
            event = decode(payload, Event)
            if event.kind == "start":
                self.epoch_ns = event.epochs[event.member]
                self._begin()

    def _begin(self) -> None:
        """Schedules every fault after tick 0 is known."""
        for fault, clock, interrupt, _ in self.plans:
            at_ns = self._at(fault.at_s)
            if fault.kind == "kill":
                clock.dies_ns = at_ns
            else:
                clock.at(at_ns, lambda interrupt=interrupt: setattr(interrupt, "number", 15))
                clock.at(
                    at_ns + INSISTS_NS,
                    lambda interrupt=interrupt: setattr(interrupt, "_is_repeated", True),
                )
        for late_s in (0.0, LOOKS_AGAIN_S):
            self.relay.happens(self._at(self.timetable.healed_s + late_s), self._let_go)
        for fault in self.faults:
            act = getattr(self, "_" + fault.kind.replace(" ", "_"), None)
            if act is not None:
                self.relay.happens(
                    self._at(fault.at_s), lambda act=act, fault=fault: act(fault)
                )

    def _at(self, t_s: float) -> int:
        return self.epoch_ns + round(t_s * 1e9)

    def _later(self, fault: Fault, act: Callable[[], None]) -> None:
        self.relay.happens(self._at(fault.at_s + fault.for_s), act)

    def _freeze(self, fault: Fault) -> None:
        self.clocks[fault.of[0]].stall(self._at(fault.at_s), round(fault.for_s * 1e9))

    def _cut_ways(self, fault: Fault, ways: Sequence[tuple[str, ...]]) -> None:
        for way in ways:
            self.network.cut(*way)
        self._later(fault, lambda: self._mend_ways(ways))

    def _mend_ways(self, ways: Sequence[tuple[str, ...]]) -> None:
        for way in ways:
            self.network.mend(*way)

    def _cut_one_way(self, fault: Fault) -> None:
        self._cut_ways(fault, [fault.of])

    def _cut(self, fault: Fault) -> None:
        self._cut_ways(fault, [fault.of, fault.of[::-1]])

    def _cut_all(self, fault: Fault) -> None:
        self._cut_ways(fault, [(a, b) for a in MEMBERS for b in MEMBERS if a != b])

    def _set_way(self, fault: Fault, name: str, value: float) -> None:
        way = self.network.way(*fault.of)
        setattr(way, name, value)
        self._later(fault, lambda: setattr(way, name, 0))

    def _delay(self, fault: Fault) -> None:
        self._set_way(fault, "delay_ns", round(fault.size * 1e9))

    def _jitter(self, fault: Fault) -> None:
        self._set_way(fault, "jitter_ns", round(fault.size * 1e9))

    def _loss(self, fault: Fault) -> None:
        self._set_way(fault, "loss", fault.size)

    def _duplicate(self, fault: Fault) -> None:
        self._set_way(fault, "doubled", fault.size)

    def _corrupt(self, fault: Fault) -> None:
        self.network.disconnect(*fault.of)
        again_s = fault.at_s + max(RECONNECT_S, fault.for_s)
        self.relay.happens(
            self._at(again_s), lambda: self._mend_ways([fault.of, fault.of[::-1]])
        )

    def _nonsense(self, fault: Fault) -> None:
        self._set_way(fault, "wrong", fault.size)

    def _publish(self, key: str, payloads: Sequence[bytes]) -> None:
        bus = self.network.join_as("stranger")
        publish = bus.publisher(key)
        for payload in payloads:
            publish(payload)
        bus.close()

    def _replay(self, fault: Fault) -> None:
        name = next(site for site in fault.of if site in SITES)
        self._publish(topics.key(SESSION, name, topics.SAMPLE), self._recent[name][-600:-100:5])

    def _stranger(self, fault: Fault) -> None:
        """Publishes the newest samples of a site as if of another start, and far ahead, and
        invalid samples.
        """
        (name,) = fault.of
        loads = []
        junk = (b"", b"\xff" * 2000)
        for load in [load for load in self._recent[name] if load not in junk][-50:]:
            sample = msgpack.unpackb(load)
            loads.append(msgpack.packb({**sample, "boot": sample["boot"] ^ 1, "q": [9.0, 9.0]}))
            loads.append(
                msgpack.packb(
                    {**sample, "boot": sample["boot"] ^ 1, "tick": sample["tick"] + 9700}
                )
            )
        self._publish(topics.key(SESSION, name, topics.SAMPLE), [*loads, *junk])

    def _wall_clock(self, fault: Fault) -> None:
        self.clocks[fault.of[0]].wall_ahead_ns = round(fault.size * 1e9)

    def _order(self, fault: Fault) -> None:
        self._ask(*order_of(fault))

    def _ask(self, site: str, change_request: ChangeRequest) -> None:
        bus = self.network.join_as("operator")
        bus.query(topics.key(SESSION, site, topics.SET), encode(change_request))
        bus.close()

    def _stop(self, fault: Fault) -> None:
        (site,) = fault.of
        self._ask(site, ChangeRequest(order="stop"))

    def _storm(self, fault: Fault) -> None:
        for after_s, site, order in storm_of(fault):
            at_ns = self._at(fault.at_s + after_s)
            self.relay.happens(at_ns, lambda site=site, order=order: self._ask(site, order))

    def _let_go(self) -> None:
        for site in SITES:
            for order in ("reset", "enable"):
                self._ask(site, ChangeRequest(order=order))

    def payloads(self) -> Iterator[bytes]:
        return chain(*self._payloads.values(), self._events)

    def dropped(self) -> Iterator[str]:
        for payload in self._stats.values():
            yield from decode(payload, LinkStats).dropped

    def play(self) -> None:
        """See `Session`; starts are numbered by the seed.

        Rehearsals, which leave no trace, are short, and memories have just enough room for
        these sessions.
        """
        boots = iter(lambda: self._boots.getrandbits(63) | 1 << 40, 0)
        patches = [
            mock.patch("sites.site_parts.new_boot", side_effect=boots),
            mock.patch("sites.site_parts.WARM_UP_TICKS", 2),
            mock.patch("sites.retransmit_buffer.KEPT_S", math.ceil(self.timetable.length_s)),
        ]
        for disk in (
            SmallDisk(int(fault.size)) for fault in self.faults if fault.kind == "full disk"
        ):
            opened = partial(_file_on, disk)
            patches.append(mock.patch("trilat_net.log.log_writer.LogFile", opened))
        with ExitStack() as stack:
            for patch in patches:
                stack.enter_context(patch)
            super().play()

    @cached_property
    def published(self) -> Published:
        published = Published()
        for name, payloads in self._payloads.items():
            for payload in payloads:
                published.states[name] += [
                    decode(state, State) for state in split_states(payload)
                ]
        for payload in self._events:
            try:
                published.events.append(decode(payload, Event))
            except WireError:
                continue
        return published


def _file_on(disk: SmallDisk, path: Path, **_: Any) -> LogFile:
    return open_file_on(disk, path)


def run_faults(
    faults: Sequence[Fault],
    folder: Path,
    seed: int = 0,
    timetable: Timetable = WHOLE,
    arms: ArmSettings = DEFAULT_ARMS,
) -> FaultSession:
    """Returns a session with these faults, run to its end."""
    scenario = make_fault_scenario(timetable, arms)
    session = FaultSession(
        scenario, folder / "run.mcap", faults=faults, seed=seed, timetable=timetable
    )
    session.prepare()
    session.play()
    return session

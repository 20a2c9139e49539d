"""Whole sessions in one process: every member's real code on a local bus and a relayed clock."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import msgpack

from recorder.record_process import Recorder
from sites import realtime
from sites.site_parts import SiteOptions, SiteParts
from sites.site_process import join_and_run
from tests.net.local_bus import LocalNetwork
from tests.net.waiting import sleep_for_ns
from trilat_net.app.recorded_session import make_scenario_reader
from trilat_net.app.running_session import RunningSession
from trilat_net.errors import LogRefused, RunFailed, SessionError
from trilat_net.execution import virtual
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogStorage
from trilat_net.log.provenance import collect_provenance
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SkewedClock
from trilat_net.net.connection import Connection
from trilat_net.net.messages import State
from trilat_net.net.wire import decode, encode_state
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.signals import Interrupt

from .relay import Killed, Relay, RelayClock

SESSION = "t"
RECORDER_BOOT = 77
GLIDE = {
    "on_stale.action": "glide",
    "on_stale.align_limit_rad": 3.0,
    "link.delay_ms": 50,
    "rate_hz": 200,
}
Sink = Callable[[str, bytes], None]
Stranger = Callable[[Bus, RelayClock], None]


@dataclass
class Session:
    scenario: Scenario
    path: Path
    relay: Relay = field(default_factory=Relay)
    network: LocalNetwork = field(default_factory=LocalNetwork)
    interrupts: dict[str, Interrupt] = field(default_factory=dict)
    clocks: dict[str, RelayClock] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    skews: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Offset (ns) and drift (ns/s) of the clocks of members on other machines."""
    storage: LogStorage | None = None
    """Storage of the log, if the log is not simply written to `path`."""
    stay_s: float = 0.0
    """The time for which the sites wait for the recorder to leave."""
    works_ns: int = 0
    """The time for which the recorder works on once it has every record."""
    left_ns: dict[str, int] = field(default_factory=dict)
    """The times at which each member left, and at which the log was complete ("log")."""
    options: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Further options of sites, by name."""
    start_ends: list[tuple[str, object]] = field(default_factory=list)
    """The end of each start of a site, in order: an exit code, an error, or "killed"."""
    ends: dict[str, object] | None = None
    """The end of each site, as an exit code or an error; if None, an error fails the test."""

    @classmethod
    def whole(cls, scenario: Scenario, folder: Path, **fields: Any) -> "Session":
        session = cls(scenario, folder / "run.mcap", **fields)
        session.recorder()
        for name in scenario.names:
            session.site(name)
        return session

    def site(self, name: str, *, needs_recorder: bool = True, at_ns: int = 0) -> None:
        interrupt = self.interrupts[name] = Interrupt()

        def run(clock: RelayClock) -> object:
            try:
                end: object = self.live(name, clock, interrupt, needs_recorder=needs_recorder)
            except Killed:
                end = "killed"
            except (RunFailed, SessionError) as failed:
                if self.ends is None:
                    raise
                end = failed
            self.start_ends.append((name, end))
            if self.ends is not None:
                self.ends[name] = end
            return end

        self.clocks[name] = self.relay.add(name, run, at_ns)

    def live(
        self,
        name: str,
        clock: RelayClock,
        interrupt: Interrupt | None = None,
        *,
        needs_recorder: bool = False,
        timeout_s: float = 10.0,
    ) -> int:
        options = SiteOptions(
            SESSION,
            Connection(),
            timeout_s,
            needs_recorder,
            stay_s=self.stay_s,
            **self.options.get(name, {}),
        )
        interrupt = interrupt or self.interrupts.get(name, Interrupt())
        site_clock = self._own(name, clock)
        bus = self.join(name)
        try:
            return join_and_run(
                SiteParts(
                    self.scenario, name, options, bus, site_clock, interrupt, self.said.append
                )
            )
        finally:
            bus.close()
            self.left_ns[name] = clock.monotonic_ns()

    def join(self, name: str) -> Bus:  # noqa: ARG002 - for networks that know their members
        return self.network.join()

    def _own(self, name: str, clock: RelayClock) -> Clock:
        return SkewedClock(clock, *self.skews[name]) if name in self.skews else clock

    def recorder(
        self,
        stopped: Callable[[], bool] = lambda: False,
        at_ns: int = 0,
        boot: int = RECORDER_BOOT,
    ) -> None:
        def run(clock: RelayClock) -> Sequence[str]:
            bus = self.join("recorder")
            try:
                recorder_clock = self._own("recorder", clock)
                recorder = Recorder(
                    bus,
                    recorder_clock,
                    SESSION,
                    boot,
                    self.storage or LogStorage(self.path),
                    make_scenario_reader(),
                    collect_provenance(),
                    stopped,
                    self.said.append,
                )
                epoch = recorder.join(30.0)
                assert epoch is not None
                recording = recorder.record(epoch)
                self.left_ns["log"] = clock.monotonic_ns()
                sleep_for_ns(clock, self.works_ns)
                self.left_ns["recorder"] = clock.monotonic_ns()
                problem = recording.describe_problem()
                return [*recording.render_summary(), *([problem] if problem else [])]
            except LogRefused as refused:
                if self.ends is None:
                    raise
                self.ends["recorder"] = refused
                return [str(refused)]
            finally:
                bus.close()

        self.relay.add("recorder", run, at_ns)

    def interrupt(self, name: str, at_ns: int, number: int = 2) -> None:
        interrupt = self.interrupts[name]
        self.clocks[name].at(at_ns, lambda: setattr(interrupt, "number", number))

    def lose(self, by: str, lost: str, from_ns: int, to_ns: int) -> None:
        """Loses messages under a key between two times; `by` is a site that lives then."""

        def begin() -> None:
            for member in self.network.members:
                member._sinks = [
                    (expression, self._filter(sink, lost, to_ns))
                    for expression, sink in member._sinks
                ]

        self.clocks[by].at(from_ns, begin)

    def lose_token(self, name: str) -> None:
        for member in self.network.members:
            for token in [
                live_token for live_token in member._tokens if f"/{name}/alive/" in live_token
            ]:
                member._tokens.remove(token)
                member._notify(token, False)

    def _filter(self, sink: Sink, lost: str, to_ns: int) -> Sink:
        def take(key: str, payload: bytes) -> None:
            if key != lost or self.relay.now_ns >= to_ns:
                sink(key, payload)

        return take

    def stranger(self, act: Stranger, at_ns: int = 0) -> None:
        self.relay.add(
            f"stranger {len(self.clocks)}",
            lambda clock: act(self.join("stranger"), clock),
            at_ns,
        )

    def play(self) -> None:
        """Runs the session in this process, which keeps its settings: no real-time priority, no
        locked memory.
        """
        obtained = dict.fromkeys(("scheduling", "memory"), "as it was")
        with mock.patch.object(realtime, "prepare", return_value=obtained):
            self.relay.run()

    def run(self) -> Log:
        self.play()
        return open_log(self.path)


COMPUTED = (
    "site",
    "tick",
    "t_ns",
    "mode",
    "q",
    "qd",
    "q_des",
    "qd_des",
    "tau",
    "tau_x",
    "theta_hat",
    "used",
    "ch",
)
"""Fields of a record that a site computes."""


def run_session(
    scenario: Scenario, folder: Path, orders: Sequence[tuple[float, str]] = ()
) -> tuple[Log, dict[str, object]]:
    """Returns the log of a session of all sites and a recorder, and how each site ended.

    Args:
        scenario: The scenario of the session.
        folder: Folder of the log.
        orders: Times, in s after the start, and orders that the site `s` gets then.
    """
    ends: dict[str, object] = {}
    session = Session.whole(scenario, folder, ends=ends)

    def give_orders(bus: Bus, clock: Clock) -> None:
        start_ns = clock.monotonic_ns()
        for at_s, order in orders:
            clock.sleep_until(start_ns + int(at_s * 1e9))
            reach_session(bus, clock).send_order(["s"], order)

    if orders:
        session.stranger(give_orders)
    return session.run(), ends


def pack_computed(state: State) -> bytes:
    """Returns the computed fields of a record as bytes, which are equal if all bits are."""
    return msgpack.packb([getattr(state, field) for field in COMPUTED])


def execute_packed(scenario: Scenario) -> dict[str, list[bytes]]:
    """Returns the packed records of each site of a run in virtual time."""
    ticks: dict[str, list[bytes]] = {name: [] for name in scenario.names}
    for site, arrivals, output in virtual.execute_virtual(scenario):
        payload = encode_state(site.name, 0, site.peers, output, arrivals, 0, 0)
        ticks[site.name].append(pack_computed(decode(payload, State)))
    return ticks


def pack_log(log: Log) -> dict[str, list[bytes]]:
    """Returns the packed records of each site of a log."""
    return {name: [pack_computed(state) for state in log[name].states] for name in log.sites}


def make_gliding_scenario(
    duration_s: float, scenario: str = "two_sites", **keys: Any
) -> Scenario:
    """Returns a shipped scenario at 200 Hz under the rule `glide`."""
    return load_scenario(scenario, {"duration_s": duration_s, **GLIDE, **keys})


def reach_session(bus: Bus, clock: Clock) -> RunningSession:
    """Returns the running session as a member of its network sees it."""
    return RunningSession(SESSION, Connection(), bus, clock)

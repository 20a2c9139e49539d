"""What stands in the way of a session on this machine: keys, links, clock, rights, rate and
room.

Invariant: nothing is changed and nothing is sent but what a member sends that connects; a
finding says what was found, and, unless it is well, what to do. Rights and rate are those that
a process of its own got.
"""

import json
import os
import platform
import re
import shutil
import socket
import ssl
import subprocess
import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

from trilat_net import process
from trilat_net.core.jit import is_core_cached
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import NS_PER_S, Arrival, TickInput, TickRecord
from trilat_net.errors import RunFailed, SessionError, UsageError, count_nouns
from trilat_net.files import read_foreign_permissions
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import (
    ENCRYPTED,
    ENDS_SOON,
    Connection,
    find_endpoint_addresses,
    is_loopback,
    resolve_member_connection,
    secure_connection,
)
from trilat_net.net.member_keys import (
    AUTHORITY,
    CERTIFICATE,
    PRIVATE_KEY,
    MemberKeys,
    read_member_keys,
)
from trilat_net.net.timing import LoopStats, SiteTiming
from trilat_net.net.zenoh_bus import RouterSilent, ZenohBus
from trilat_net.results import Result
from trilat_net.scenario import Scenario, load_scenario

from .machine_load import describe_load, measure_busy_share
from .session_ping import ping_session
from .site_loop import PeerInbox, StateBlock, run_loop
from .site_parts import warm_up

FindingState = Literal["ok", "warn", "fail"]
CONNECT_S = 2.0
LEAST_BYTES = 100 << 20
FEW_BYTES = 2 << 30
"""Free room with which a recording is likely to end early, and room for an hour and a half of
three sites.
"""
STEADY_NS = 100_000_000
STEP_NS = 1_000_000
BOUND_US = 1_000
"""How long the clocks are compared, by how much they may part meanwhile, and an offset's
largest bound.
"""
PINGS = 20
RATES_HZ = (1000, 500, 200, 100)
REHEARSAL_S = 1.0
HELD_PERIODS = 0.5
HELD_SHARE = 0.99
"""A rate is held if this share of its ticks begins in this part of a period, from when each is
due.
"""


class DoctorFinding(NamedTuple):
    """One finding: what was looked at, how it is, and a sentence."""

    check: str
    state: FindingState
    text: str


def examine_machine(
    connection: Connection,
    keys: Path | None,
    folder: Path,
    session: str | None,
    clock: Clock,
    *,
    insecure: bool,
) -> Iterator[DoctorFinding]:
    """Yields all findings, one after the other, by the arguments of `doctor`."""
    owned = yield from examine_keys(keys)
    yield from examine_links(connection, keys, owned, insecure=insecure)
    yield from examine_clock(clock)
    if session is not None:
        safe = secure_connection(connection, owned, insecure=insecure)
        yield from examine_offsets(safe, clock, session)
    yield examine_system()
    yield from examine_rights()
    yield examine_rate()
    yield from examine_room(folder)


def examine_keys(folder: Path | None) -> Generator[DoctorFinding, None, MemberKeys | None]:
    """Yields whose keys they are, until when they hold, and if others can get at them; returns
    good ones.
    """
    if folder is None:
        yield DoctorFinding(
            "keys", "ok", "none given: without --keys a member listens on this machine alone"
        )
        return None
    try:
        owned = read_member_keys(folder)
    except UsageError as error:
        yield DoctorFinding("keys", "fail", str(error))
        return None
    left = owned.ends - datetime.now(UTC)
    text = (
        f"{owned.member} of {', '.join(owned.members)}, until {owned.ends:%Y-%m-%d %H:%M} UTC"
    )
    if left < ENDS_SOON:
        yield DoctorFinding("keys", "warn", f"{text}: soon; renew them with trilat keys renew")
    else:
        yield DoctorFinding("keys", "ok", text)
    if read_foreign_permissions(folder):
        yield DoctorFinding(
            "keys", "warn", f"others can look into {folder}: chmod 700 {folder}"
        )
    authority = folder.resolve().parent / "authority" / PRIVATE_KEY
    if authority.exists():
        text = f"{authority} lies here too: with it anybody makes keys; keep it elsewhere"
        yield DoctorFinding("keys", "warn", text)
    return owned


def examine_links(
    connection: Connection, folder: Path | None, owned: MemberKeys | None, *, insecure: bool
) -> Iterator[DoctorFinding]:
    """Yields whether endpoints can be listened at and reached, and whether links are encrypted."""
    try:
        safe = secure_connection(connection, owned, insecure=insecure)
    except UsageError as error:
        yield DoctorFinding("links", "fail", str(error))
        return
    sides = [(place, True) for place in find_endpoint_addresses(safe.reach(safe.listen))]
    sides += [
        (place, False) for place in find_endpoint_addresses(safe.reach(safe.connect or ()))
    ]
    for place, listens in sides:
        if not listens and place.startswith("quic/"):
            yield _examine_quic(place, owned)
        elif (address := _split_address(place)) is None:
            yield DoctorFinding(
                "links", "warn", f"{place} was not tried: not an address of TCP or QUIC"
            )
        elif listens:
            yield _examine_listening(place, address)
        else:
            yield _examine_reaching(place, address, folder if owned else None)
    if not safe.listen and not safe.connect:
        yield DoctorFinding(
            "links", "ok", "no endpoints given: --listen and --connect are tried if given"
        )


def _examine_listening(place: str, address: tuple[str, int]) -> DoctorFinding:
    try:
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        quic = place.startswith("quic/")
        with socket.socket(family, socket.SOCK_DGRAM if quic else socket.SOCK_STREAM) as probe:
            if not quic:  # two sockets of UDP at one port would both be let
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            if not quic:
                probe.listen(1)
    except OSError as error:
        return DoctorFinding(
            "links", "fail", f"cannot listen at {place}: {error.strerror or error}"
        )
    if place.startswith(ENCRYPTED) or is_loopback(place):
        return DoctorFinding("links", "ok", f"can listen at {place}")
    return DoctorFinding(
        "links", "warn", f"{place} would listen unencrypted, to anybody who reaches it"
    )


def _examine_reaching(
    place: str, address: tuple[str, int], folder: Path | None
) -> DoctorFinding:
    try:
        with socket.create_connection(address, CONNECT_S) as link:
            if not place.startswith("tls/"):
                state: FindingState = "ok" if is_loopback(place) else "warn"
                return DoctorFinding("links", state, f"{place} answers, unencrypted")
            with _tls_context(folder).wrap_socket(link, server_hostname=address[0]) as safe:
                proved = (
                    "with a certificate of the same authority"
                    if folder
                    else "whose authority is unknown"
                )
                return DoctorFinding(
                    "links", "ok", f"{place} answers over {safe.version()}, {proved}"
                )
    except ssl.SSLError as error:
        why = getattr(error, "verify_message", "") or error.reason or str(error)
        return DoctorFinding(
            "links", "fail", f"{place} answers, but not as a member with these keys: {why}"
        )
    except OSError as error:
        return DoctorFinding(
            "links", "fail", f"{place} cannot be reached: {error.strerror or error}"
        )


def _examine_quic(place: str, owned: MemberKeys | None) -> DoctorFinding:
    """Returns whether a member answers over QUIC: there is no way to try that but to connect as
    a member.
    """
    if owned is None:
        return DoctorFinding(
            "links", "warn", f"{place} was not tried: QUIC asks for the keys of a member"
        )
    try:
        with closing(ZenohBus([], [place], "client", owned.settings)):
            text = f"{place} answers over QUIC, with a certificate of the same authority"
            return DoctorFinding("links", "ok", text)
    except (RouterSilent, UsageError) as error:
        return DoctorFinding(
            "links", "fail", f"{place} does not answer a member with these keys: {error}"
        )


def _tls_context(folder: Path | None) -> ssl.SSLContext:
    if folder is None:
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        return context
    context = ssl.create_default_context(cafile=str(folder / AUTHORITY))
    context.load_cert_chain(folder / CERTIFICATE, folder / PRIVATE_KEY)
    return context


def _split_address(place: str) -> tuple[str, int] | None:
    found = re.fullmatch(r"(?:tcp|tls|quic)/(\[[^\]]+\]|[^:/]+):(\d{1,5})(?:[?#].*)?", place)
    return (found[1].strip("[]"), int(found[2])) if found and int(found[2]) < 1 << 16 else None


def examine_clock(clock: Clock) -> Iterator[DoctorFinding]:
    """Yields whether this machine's clocks are steady."""
    begun = clock.monotonic_ns()
    wall = clock.unix_ns()
    before = begun
    backwards = 0
    coarsest_ns = 0
    while before - begun < STEADY_NS:
        now = clock.monotonic_ns()
        backwards += now < before
        coarsest_ns = max(coarsest_ns, now - before)
        before = now
    apart_ns = abs(clock.unix_ns() - wall - (clock.monotonic_ns() - begun))
    if backwards:
        yield DoctorFinding(
            "clock",
            "fail",
            f"the monotonic clock went back {count_nouns(backwards, 'time')} in 0.1 s",
        )
    elif apart_ns > STEP_NS:
        text = f"the wall clock stepped by {apart_ns / 1e6:.1f} ms in 0.1 s; that distorts no record"
        yield DoctorFinding("clock", "warn", text)
    else:
        longest = f"largest pause of a loop that never sleeps {coarsest_ns / 1e6:.1f} ms"
        yield DoctorFinding("clock", "ok", f"steady; {longest}")


def examine_offsets(
    connection: Connection, clock: Clock, session: str
) -> Iterator[DoctorFinding]:
    """Yields how far the clocks of a session's members are ahead, and how well that is known."""
    try:
        ping = ping_session(
            connection=connection,
            clock=clock,
            session=session,
            count=PINGS,
            timeout_s=CONNECT_S,
            stopped=lambda: False,
        )
    except (RunFailed, SessionError, UsageError) as error:
        yield DoctorFinding("clock", "fail", str(error))
        return
    for facts in ping.members if ping else ():
        if facts["same_clock"]:
            yield DoctorFinding("clock", "ok", f"{facts['member']} has the same clock")
        elif "offset_ns" not in facts:
            yield DoctorFinding("clock", "warn", f"{facts['member']} answered too few pings")
        else:
            offset_s = facts["offset_ns"] / 1e9
            bound_us = facts["bound_us"]
            text = f"{facts['member']} is {offset_s:+.6f} s, known to {bound_us:.0f} us"
            yield DoctorFinding("clock", "ok" if bound_us <= BOUND_US else "warn", text)


def _ask_process(code: str) -> Any:
    """Returns what a process of its own prints last, as JSON; None if it fails."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False
    )
    return None if done.returncode else json.loads(done.stdout.splitlines()[-1])


_RIGHTS = "import json; from sites.realtime import prepare; print(json.dumps(prepare(None)))"


def examine_rights() -> Iterator[DoctorFinding]:
    """Yields which real-time settings a site would get."""
    obtained: dict[str, str] | None = _ask_process(_RIGHTS)
    if obtained is None:
        yield DoctorFinding("rights", "warn", "could not be tried")
        return
    good = {"scheduling": "SCHED_FIFO", "memory": "locked", "timer_slack": "1 ns"}
    for name, start in good.items():
        got = obtained[name].startswith(start)
        help_ = (
            ""
            if got
            else "; ticks will be late by milliseconds under load: see compose.realtime.yaml"
        )
        text = f"{name.replace('_', ' ')}: {obtained[name]}{help_}"
        yield DoctorFinding("rights", "ok" if got else "warn", text)


def examine_system() -> DoctorFinding:
    """Returns which half of the program is promised on this system."""
    name = {"Darwin": "macOS"}.get(platform.system(), platform.system())
    if name == "Linux":
        return DoctorFinding(
            "system", "ok", "Linux: live sessions and studies are both promised"
        )
    text = (
        f"live sessions are promised on Linux alone; on {name} simulation, logs and studies are"
    )
    return DoctorFinding("system", "warn", text)


class Rehearsal(LoopStats):
    """The live loop of a site alone: all that it does in a tick but for the network."""

    def __init__(self, scenario: Scenario, name: str) -> None:
        self._stepped = Site(scenario.setup(name))
        self._ticks = scenario.ticks(name)
        super().__init__(self._stepped, 1)
        self._late_us: list[int] = []

    def run(self, clock: Clock) -> list[int]:
        """Makes its ticks in real time; returns how late each began, us."""
        inbox = PeerInbox(links=(), rings=(), boots=(), monitors=(), dropped=self.dropped)
        timing = SiteTiming(
            clock.monotonic_ns() + NS_PER_S // 10, self._stepped.rate_hz, (), ""
        )
        timed: Any = (
            clock,
            inbox,
            timing,
            self,
            StateBlock(self._stepped, 1, lambda _: None),
            self,
        )
        run_loop(self._stepped, 1, self._ticks, *timed)
        return self._late_us

    def count_tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Counts one tick, and keeps its lateness."""
        super().count_tick(late_us, busy_us, skipped)
        self._late_us.append(late_us)

    def step(self, k: int, arrivals: Sequence[Arrival]) -> TickRecord:
        """Steps the site."""
        return self._stepped.step(TickInput(k, arrivals))

    def run_housekeeping(self, *_: object) -> bool:
        """Drops what a site would send and tell; nobody asks anything, or ends it."""
        return False

    publish_sample = run_housekeeping
    publish_link = run_housekeeping
    report_tick = run_housekeeping
    should_stop = run_housekeeping
    use_slack = run_housekeeping


def rehearse_rates(clock: Clock) -> list[tuple[int, int, int]]:
    """Runs a site at one rate after the other until one is held, or none.

    Returns for each its rate, Hz, the lateness within which `HELD_SHARE` of its ticks began,
    and the largest.
    """
    found: list[tuple[int, int, int]] = []
    for rate_hz in RATES_HZ:
        if not found or not is_held(*found[-1][:2]):
            scenario = load_scenario("free", {"rate_hz": rate_hz, "duration_s": REHEARSAL_S})
            warm_up(scenario, "s", clock)
            late_us = sorted(Rehearsal(scenario, "s").run(clock))
            found.append((rate_hz, late_us[int(HELD_SHARE * len(late_us))], late_us[-1]))
    return found


def is_held(rate_hz: int, late_us: int) -> bool:
    """True if a lateness is within `HELD_PERIODS` of a rate."""
    return late_us <= HELD_PERIODS * 1e6 / rate_hz


_RATES = (
    "import json; from sites import doctor, realtime; realtime.prepare(None); "
    "print(json.dumps(doctor.rehearse_rates(doctor.SystemClock())))"
)


def examine_rate() -> DoctorFinding:
    """Returns the highest tick rate that a site alone holds here and now, measured for a second
    each.
    """
    if not is_core_cached():
        return DoctorFinding(
            "rate", "warn", "not measured: the core is not yet compiled, see below"
        )
    found: list[tuple[int, int, int]] | None = _ask_process(_RATES)
    if found is None:
        return DoctorFinding("rate", "warn", "could not be measured")
    *missed, (rate_hz, late_us, largest_us) = found
    within = f"{HELD_SHARE:.0%} of the ticks began within {late_us / 1e3:.2f} ms of their time"
    text = f"{within}, all within {largest_us / 1e3:.1f} ms"
    if not is_held(rate_hz, late_us):
        text = f"a site alone holds not even {rate_hz} Hz: {text}; end other programs"
        return DoctorFinding("rate", "fail", text)
    text = (
        f"a site alone holds {rate_hz} Hz: {text} ({HELD_SHARE:.0%} must within half a period)"
    )
    if missed:
        text += f"; at {missed[-1][0]} Hz within {missed[-1][1] / 1e3:.2f} ms: lower rate_hz"
    return DoctorFinding("rate", "warn" if missed else "ok", text)


def examine_room(folder: Path) -> Iterator[DoctorFinding]:
    """Yields free disk, processors and their load, and whether the core is compiled."""
    place = next(
        path for path in (folder.absolute(), *folder.absolute().parents) if path.is_dir()
    )
    free = shutil.disk_usage(place).free
    state: FindingState = "fail" if free < LEAST_BYTES else "warn" if free < FEW_BYTES else "ok"
    if not os.access(place, os.W_OK):
        yield DoctorFinding("disk", "fail", f"{place} cannot be written to")
    yield DoctorFinding("disk", state, f"{free / 1e9:.1f} GB are free in {place}")
    cores = process.count_cores()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    text = f"{count_nouns(cores, 'processor')}, of which {load:.1f} are busy"
    warning = describe_load(measure_busy_share(SystemClock()))
    is_short = cores < 2 or load >= cores or bool(warning)
    yield DoctorFinding(
        "processors", "warn" if is_short else "ok", f"{text}; {warning}" if warning else text
    )
    cached = is_core_cached()
    late = "not yet compiled: the first session here begins half a minute later"
    yield DoctorFinding("core", "ok" if cached else "warn", "compiled" if cached else late)


@dataclass(frozen=True, repr=False)
class DoctorReport(Result):
    """What stands in the way of a session on this machine, and what does not."""

    findings: list[DoctorFinding]

    def headline(self) -> str:
        """Returns how many findings warn or fail."""
        states = [finding.state for finding in self.findings]
        return (
            f"{states.count('fail')} fail, {states.count('warn')} warn, {states.count('ok')} ok"
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the findings as of `trilat doctor --json`."""
        return {"findings": self.to_rows()}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per finding."""
        return [finding._asdict() for finding in self.findings]


def doctor(
    *,
    listen: Sequence[str] | None = None,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
    session: str | None = None,
    folder: str | Path = "runs",
    insecure: bool = False,
) -> DoctorReport:
    """Examines keys, links, clocks, rights, disk and processors; the command is `trilat
    doctor`.

    >>> "clock" in {finding.check for finding in tn.doctor().findings}
    True

    Args:
        listen: endpoints to listen at.
        connect: endpoints to connect to.
        router: endpoints of routers.
        keys: folder of a member's keys.
        session: a session whose members are asked for their clocks.
        folder: where results would go.
        insecure: whether everybody on the network is trusted.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    connection = resolve_member_connection(listen, connect, router)
    place = None if keys is None else Path(keys)
    found = examine_machine(
        connection=connection,
        keys=place,
        folder=Path(folder),
        session=session,
        clock=SystemClock(),
        insecure=insecure,
    )
    return DoctorReport(list(found))

"""Checks what stands in the way of a session on this machine.

The checks are of keys, links, clocks, rights, tick rate, disk and processors.

Invariant:
    - Nothing is changed, and nothing is sent except the messages of a member that connects.
    - A finding says what was found and, if there is a problem, what to do.
    - Rights and rates are measured in a process of their own.
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
MIN_FREE_BYTES = 100 << 20
"""Free space below which a recording is likely to end early."""
LOW_FREE_BYTES = 2 << 30
"""Free space below which there is a warning: 90 minutes of three sites."""
CLOCK_TEST_NS = 100_000_000
"""Duration of the comparison of the clocks."""
MAX_CLOCK_STEP_NS = 1_000_000
"""Largest change of the difference of the clocks in that time."""
MAX_BOUND_US = 1_000
"""Largest error bound of a clock offset without a warning."""
PINGS = 20
RATES_HZ = (1000, 500, 200, 100)
REHEARSAL_S = 1.0
MAX_LATE_PERIODS = 0.5
MIN_PUNCTUAL_SHARE = 0.99
"""A rate is held if this share of ticks begins at most `MAX_LATE_PERIODS` after it is due."""


class DoctorFinding(NamedTuple):
    """The result of one check.

    Attributes:
        check: the subject of the check.
        state: "ok", "warn" or "fail".
        text: a sentence about the result.
    """

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
    """Yields all findings, one after the other; `doctor` explains the arguments."""
    member_keys = yield from examine_keys(keys)
    yield from examine_links(connection, keys, member_keys, insecure=insecure)
    yield from examine_clock(clock)
    if session is not None:
        safe = secure_connection(connection, member_keys, insecure=insecure)
        yield from examine_offsets(safe, clock, session)
    yield examine_system()
    yield from examine_rights()
    yield examine_rate()
    yield from examine_room(folder)


def examine_keys(folder: Path | None) -> Generator[DoctorFinding, None, MemberKeys | None]:
    """Yields whether the keys are valid, until when, and whether others can read them.

    Returns:
        The keys; None if there are none, or if they cannot be used.
    """
    if folder is None:
        yield DoctorFinding(
            "keys", "ok", "none given: without --keys a member listens on this machine alone"
        )
        return None
    try:
        member_keys = read_member_keys(folder)
    except UsageError as error:
        yield DoctorFinding("keys", "fail", str(error))
        return None
    names = ", ".join(member_keys.members)
    text = f"{member_keys.member} of {names}, until {member_keys.ends:%Y-%m-%d %H:%M} UTC"
    if member_keys.ends - datetime.now(UTC) < ENDS_SOON:
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
    return member_keys


def examine_links(
    connection: Connection,
    folder: Path | None,
    member_keys: MemberKeys | None,
    *,
    insecure: bool,
) -> Iterator[DoctorFinding]:
    """Yields whether each endpoint can be listened at or reached, and is encrypted."""
    try:
        safe = secure_connection(connection, member_keys, insecure=insecure)
    except UsageError as error:
        yield DoctorFinding("links", "fail", str(error))
        return
    for endpoint in find_endpoint_addresses(safe.reach(safe.listen)):
        if (address := _split_address(endpoint)) is None:
            yield _describe_untried(endpoint)
        else:
            yield _examine_listening(endpoint, address)
    for endpoint in find_endpoint_addresses(safe.reach(safe.connect or ())):
        if endpoint.startswith("quic/"):
            yield _examine_quic(endpoint, member_keys)
        elif (address := _split_address(endpoint)) is None:
            yield _describe_untried(endpoint)
        else:
            yield _examine_reaching(endpoint, address, folder if member_keys else None)
    if not safe.listen and not safe.connect:
        yield DoctorFinding(
            "links", "ok", "no endpoints given: --listen and --connect are tried if given"
        )


def _describe_untried(endpoint: str) -> DoctorFinding:
    text = f"{endpoint} was not tried: not an address of TCP or QUIC"
    return DoctorFinding("links", "warn", text)


def _examine_listening(endpoint: str, address: tuple[str, int]) -> DoctorFinding:
    """Returns whether this machine can listen at an endpoint."""
    is_quic = endpoint.startswith("quic/")
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    kind = socket.SOCK_DGRAM if is_quic else socket.SOCK_STREAM
    try:
        with socket.socket(family, kind) as probe:
            if not is_quic:  # with this option, two sockets of UDP could share the port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            if not is_quic:
                probe.listen(1)
    except OSError as error:
        text = f"cannot listen at {endpoint}: {error.strerror or error}"
        return DoctorFinding("links", "fail", text)
    if endpoint.startswith(ENCRYPTED) or is_loopback(endpoint):
        return DoctorFinding("links", "ok", f"can listen at {endpoint}")
    text = f"{endpoint} would listen unencrypted, to anybody who reaches it"
    return DoctorFinding("links", "warn", text)


def _examine_reaching(
    endpoint: str, address: tuple[str, int], folder: Path | None
) -> DoctorFinding:
    """Returns whether a member answers at an endpoint of TCP or TLS."""
    try:
        with socket.create_connection(address, CONNECT_S) as link:
            if not endpoint.startswith("tls/"):
                state: FindingState = "ok" if is_loopback(endpoint) else "warn"
                return DoctorFinding("links", state, f"{endpoint} answers, unencrypted")
            context = _tls_context(folder)
            with context.wrap_socket(link, server_hostname=address[0]) as safe:
                authority = "whose authority is unknown"
                if folder:
                    authority = "with a certificate of the same authority"
                text = f"{endpoint} answers over {safe.version()}, {authority}"
                return DoctorFinding("links", "ok", text)
    except ssl.SSLError as error:
        reason = getattr(error, "verify_message", "") or error.reason or str(error)
        text = f"{endpoint} answers, but not as a member with these keys: {reason}"
        return DoctorFinding("links", "fail", text)
    except OSError as error:
        text = f"{endpoint} cannot be reached: {error.strerror or error}"
        return DoctorFinding("links", "fail", text)


def _examine_quic(endpoint: str, member_keys: MemberKeys | None) -> DoctorFinding:
    """Returns whether a member answers over QUIC.

    The only way to find out is to connect as a member.
    """
    if member_keys is None:
        return DoctorFinding(
            "links", "warn", f"{endpoint} was not tried: QUIC asks for the keys of a member"
        )
    try:
        with closing(ZenohBus([], [endpoint], "client", member_keys.settings)):
            text = f"{endpoint} answers over QUIC, with a certificate of the same authority"
            return DoctorFinding("links", "ok", text)
    except (RouterSilent, UsageError) as error:
        return DoctorFinding(
            "links", "fail", f"{endpoint} does not answer a member with these keys: {error}"
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


def _split_address(endpoint: str) -> tuple[str, int] | None:
    """Returns host and port of an endpoint; None if it has no such address."""
    pattern = r"(?:tcp|tls|quic)/(\[[^\]]+\]|[^:/]+):(\d{1,5})(?:[?#].*)?"
    match = re.fullmatch(pattern, endpoint)
    if match is None or int(match[2]) >= 1 << 16:
        return None
    return match[1].strip("[]"), int(match[2])


def examine_clock(clock: Clock) -> Iterator[DoctorFinding]:
    """Yields whether the clocks of this machine are steady."""
    begun_ns = clock.monotonic_ns()
    wall_ns = clock.unix_ns()
    previous_ns = begun_ns
    backward_steps = 0
    longest_gap_ns = 0
    while previous_ns - begun_ns < CLOCK_TEST_NS:
        now_ns = clock.monotonic_ns()
        backward_steps += now_ns < previous_ns
        longest_gap_ns = max(longest_gap_ns, now_ns - previous_ns)
        previous_ns = now_ns
    step_ns = abs(clock.unix_ns() - wall_ns - (clock.monotonic_ns() - begun_ns))
    if backward_steps:
        times = count_nouns(backward_steps, "time")
        text = f"the monotonic clock went back {times} in 0.1 s"
        yield DoctorFinding("clock", "fail", text)
    elif step_ns > MAX_CLOCK_STEP_NS:
        step = f"the wall clock stepped by {step_ns / 1e6:.1f} ms in 0.1 s"
        yield DoctorFinding("clock", "warn", f"{step}; that distorts no record")
    else:
        longest_ms = longest_gap_ns / 1e6
        text = f"steady; largest pause of a loop that never sleeps {longest_ms:.1f} ms"
        yield DoctorFinding("clock", "ok", text)


def examine_offsets(
    connection: Connection, clock: Clock, session: str
) -> Iterator[DoctorFinding]:
    """Yields the clock offset of each member of a session, and its error bound."""
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
    for row in ping.members if ping else ():
        member = row["member"]
        if row["same_clock"]:
            yield DoctorFinding("clock", "ok", f"{member} has the same clock")
        elif "offset_ns" not in row:
            yield DoctorFinding("clock", "warn", f"{member} answered too few pings")
        else:
            offset_s = row["offset_ns"] / 1e9
            bound_us = row["bound_us"]
            text = f"{member} is {offset_s:+.6f} s, known to {bound_us:.0f} us"
            yield DoctorFinding("clock", "ok" if bound_us <= MAX_BOUND_US else "warn", text)


def _run_in_process(code: str) -> Any:
    """Runs Python code in a new process.

    Returns:
        The JSON value of the last printed line; None if the process fails.
    """
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False
    )
    if completed.returncode:
        return None
    return json.loads(completed.stdout.splitlines()[-1])


_RIGHTS_CODE = (
    "import json; from sites.realtime import prepare; print(json.dumps(prepare(None)))"
)


def examine_rights() -> Iterator[DoctorFinding]:
    """Yields which real-time settings a site obtains."""
    obtained: dict[str, str] | None = _run_in_process(_RIGHTS_CODE)
    if obtained is None:
        yield DoctorFinding("rights", "warn", "could not be tried")
        return
    wanted = {"scheduling": "SCHED_FIFO", "memory": "locked", "timer_slack": "1 ns"}
    remedy = "ticks will be late by milliseconds under load: see compose.realtime.yaml"
    for name, prefix in wanted.items():
        text = f"{name.replace('_', ' ')}: {obtained[name]}"
        if obtained[name].startswith(prefix):
            yield DoctorFinding("rights", "ok", text)
        else:
            yield DoctorFinding("rights", "warn", f"{text}; {remedy}")


def examine_system() -> DoctorFinding:
    """Returns which parts of the program are supported on this operating system."""
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
    """The live loop of a single site, with everything that a tick does except the network.

    Args:
        scenario: the scenario.
        name: the name of the site.
    """

    def __init__(self, scenario: Scenario, name: str) -> None:
        self._site = Site(scenario.setup(name))
        self._ticks = scenario.ticks(name)
        super().__init__(self._site, 1)
        self._late_us: list[int] = []

    def run(self, clock: Clock) -> list[int]:
        """Runs all ticks in real time; returns the lateness of each, us."""
        inbox = PeerInbox(links=(), rings=(), boots=(), monitors=(), dropped=self.dropped)
        epoch_ns = clock.monotonic_ns() + NS_PER_S // 10
        timing = SiteTiming(epoch_ns, self._site.rate_hz, (), "")
        site_io: Any = self
        run_loop(
            site=self._site,
            boot=1,
            ticks=self._ticks,
            clock=clock,
            inbox=inbox,
            timing=timing,
            stats=self,
            states=StateBlock(self._site, 1, lambda _: None),
            io=site_io,
        )
        return self._late_us

    def count_tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Counts a tick, and keeps its lateness."""
        super().count_tick(late_us, busy_us, skipped)
        self._late_us.append(late_us)

    def step(self, k: int, arrivals: Sequence[Arrival]) -> TickRecord:
        """Steps the site."""
        return self._site.step(TickInput(k, arrivals))

    def run_housekeeping(self, *_: object) -> bool:
        """Does nothing; False means that the run goes on."""
        return False

    publish_sample = run_housekeeping
    publish_link = run_housekeeping
    report_tick = run_housekeeping
    should_stop = run_housekeeping
    use_slack = run_housekeeping


def rehearse_rates(clock: Clock) -> list[tuple[int, int, int]]:
    """Runs a site at decreasing rates until a rate is held.

    Returns:
        For each rate: the rate, Hz; the lateness that `MIN_PUNCTUAL_SHARE` of its ticks did
        not exceed, us; and the largest lateness, us.
    """
    results: list[tuple[int, int, int]] = []
    for rate_hz in RATES_HZ:
        if results and is_held(results[-1][0], results[-1][1]):
            break
        scenario = load_scenario("free", {"rate_hz": rate_hz, "duration_s": REHEARSAL_S})
        warm_up(scenario, "s", clock)
        late_us = sorted(Rehearsal(scenario, "s").run(clock))
        quantile_us = late_us[int(MIN_PUNCTUAL_SHARE * len(late_us))]
        results.append((rate_hz, quantile_us, late_us[-1]))
    return results


def is_held(rate_hz: int, late_us: int) -> bool:
    """True if a lateness is at most `MAX_LATE_PERIODS` of the period of a rate."""
    return late_us <= MAX_LATE_PERIODS * 1e6 / rate_hz


_RATES_CODE = (
    "import json; from sites import doctor, realtime; realtime.prepare(None); "
    "print(json.dumps(doctor.rehearse_rates(doctor.SystemClock())))"
)


def examine_rate() -> DoctorFinding:
    """Returns the highest tick rate that a single site holds now, measured for 1 s each."""
    if not is_core_cached():
        return DoctorFinding(
            "rate", "warn", "not measured: the core is not yet compiled, see below"
        )
    results: list[tuple[int, int, int]] | None = _run_in_process(_RATES_CODE)
    if results is None:
        return DoctorFinding("rate", "warn", "could not be measured")
    *missed, (rate_hz, late_us, largest_us) = results
    share = f"{MIN_PUNCTUAL_SHARE:.0%}"
    text = (
        f"{share} of the ticks began within {late_us / 1e3:.2f} ms of their time, "
        f"all within {largest_us / 1e3:.1f} ms"
    )
    if not is_held(rate_hz, late_us):
        text = f"a site alone holds not even {rate_hz} Hz: {text}; end other programs"
        return DoctorFinding("rate", "fail", text)
    text = f"a site alone holds {rate_hz} Hz: {text} ({share} must within half a period)"
    if missed:
        missed_hz, missed_us, _ = missed[-1]
        text += f"; at {missed_hz} Hz within {missed_us / 1e3:.2f} ms: lower rate_hz"
    return DoctorFinding("rate", "warn" if missed else "ok", text)


def examine_room(folder: Path) -> Iterator[DoctorFinding]:
    """Yields the free disk space, the load, and whether the kernel is compiled."""
    candidates = (folder.absolute(), *folder.absolute().parents)
    existing = next(path for path in candidates if path.is_dir())
    free = shutil.disk_usage(existing).free
    state: FindingState = "ok"
    if free < MIN_FREE_BYTES:
        state = "fail"
    elif free < LOW_FREE_BYTES:
        state = "warn"
    if not os.access(existing, os.W_OK):
        yield DoctorFinding("disk", "fail", f"{existing} cannot be written to")
    yield DoctorFinding("disk", state, f"{free / 1e9:.1f} GB are free in {existing}")
    cores = process.count_cores()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    text = f"{count_nouns(cores, 'processor')}, of which {load:.1f} are busy"
    warning = describe_load(measure_busy_share(SystemClock()))
    if warning:
        text = f"{text}; {warning}"
    is_short = cores < 2 or load >= cores or bool(warning)
    yield DoctorFinding("processors", "warn" if is_short else "ok", text)
    if is_core_cached():
        yield DoctorFinding("core", "ok", "compiled")
    else:
        text = "not yet compiled: the first session here begins half a minute later"
        yield DoctorFinding("core", "warn", text)


@dataclass(frozen=True, repr=False)
class DoctorReport(Result):
    """All findings about this machine."""

    findings: list[DoctorFinding]

    def headline(self) -> str:
        """Returns the numbers of findings that fail, warn and are ok."""
        states = [finding.state for finding in self.findings]
        return (
            f"{states.count('fail')} fail, {states.count('warn')} warn, {states.count('ok')} ok"
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, as `trilat doctor --json` prints them."""
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
    """Examines keys, links, clocks, rights, disk and processors; as `trilat doctor`.

    >>> "clock" in {finding.check for finding in tn.doctor().findings}
    True

    Args:
        listen: endpoints to listen at.
        connect: endpoints to connect to.
        router: endpoints of routers.
        keys: the folder of a member's keys.
        session: a session whose members' clocks are compared.
        folder: where results would be stored.
        insecure: whether everybody on the network is trusted.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    findings = examine_machine(
        connection=resolve_member_connection(listen, connect, router),
        keys=None if keys is None else Path(keys),
        folder=Path(folder),
        session=session,
        clock=SystemClock(),
        insecure=insecure,
    )
    return DoctorReport(list(findings))

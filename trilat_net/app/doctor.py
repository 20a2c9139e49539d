"""Checks whether this machine is ready for a session, and suggests a fix for each problem.

A session consists of processes (sites) that control arms at 1000 ticks per second and exchange
their states over the network. The checks cover the keys, the network endpoints, the clocks, the
operating system's real-time privileges, the tick rate that this machine achieves, the disk and
the processors. The command `trilat doctor` runs the checks.

Each check yields a finding, which states the result and, if there is a problem, a remedy. The
checks do not modify this machine. The real-time privileges and the tick rate are measured in a
separate process, because the measuring process must change its own settings.
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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

from sites import rehearse_loop, warm_up
from trilat_net import workers
from trilat_net.errors import RunFailed, SessionError, UsageError, count_nouns
from trilat_net.results import Result
from trilat_net.scenario import load_scenario

from ..core import is_core_cached
from ..net import (
    AUTHORITY,
    CERTIFICATE,
    ENDS_SOON,
    PRIVATE_KEY,
    Clock,
    Connection,
    SystemClock,
    check_hosts,
    read_member_keys,
)
from .machine_load import check_machine_load
from .session_ping import ping_session

FindingState = Literal["ok", "warn", "fail"]
CONNECT_S = 2.0
"""Longest wait for a connection or for replies to pings, in s."""
MIN_FREE_BYTES = 100 << 20
"""Free space below which a recording is likely to end early."""
LOW_FREE_BYTES = 2 << 30
"""Free space below which there is a warning. It is enough for 90 minutes of three sites."""
CLOCK_TEST_NS = 100_000_000
"""Time for which the monotonic clock and the time of day are compared, in ns."""
MAX_CLOCK_STEP_NS = 1_000_000
"""Largest permitted change of the difference between the clocks in `CLOCK_TEST_NS`, in ns."""
MAX_BOUND_US = 1_000
"""Largest error bound of a clock offset without a warning, in us."""
PINGS = 20
"""Number of pings to each member of a session."""
RATES_HZ = (1000, 500, 200, 100)
"""Tick rates in Hz, which are tried in this order until one of them is achieved."""
REHEARSAL_S = 1.0
"""Duration of the trial of each rate, in s."""
MAX_LATE_PERIODS = 0.5
"""Largest lateness of a punctual tick, in periods of the tick rate."""
MIN_PUNCTUAL_SHARE = 0.99
"""A rate counts as achieved if at least this share of its ticks is punctual."""


class DoctorFinding(NamedTuple):
    """Result of one check of this machine, for example of the free disk space.

    `trilat doctor` prints each finding on its own line.

    Attributes:
        check: Subject of the check, such as "keys" or "disk".
        state: "ok", "warn" for a possible problem, or "fail" for a definite problem.
        text: Description of the result and, if there is a problem, its remedy.
    """

    check: str
    state: FindingState
    text: str


def _describe_untried(endpoint: str) -> DoctorFinding:
    """Returns the finding about an endpoint of a kind that this module cannot check."""
    text = f"{endpoint} was not tried, because it is not an address of TCP or QUIC"
    return DoctorFinding("links", "warn", text)


def _examine_listening(
    endpoint: str, address: tuple[str, int], *, is_protected: bool
) -> DoctorFinding:
    """Checks whether this machine can listen at a network endpoint, by listening for a moment.

    The check fails if, for example, another program uses the port. An unprotected endpoint
    causes a warning.

    Args:
        endpoint: The endpoint, such as "tls/0.0.0.0:7447".
        address: Host and port of the endpoint.
        is_protected: True if the endpoint is encrypted or can only be reached from this
            machine.
    """
    is_quic = endpoint.startswith("quic/")
    host, _ = address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    socket_type = socket.SOCK_DGRAM if is_quic else socket.SOCK_STREAM

    try:
        with socket.socket(family, socket_type) as probe:
            if not is_quic:  # with this option, two UDP sockets could share the port
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            if not is_quic:
                probe.listen(1)
    except OSError as error:
        text = f"cannot listen at {endpoint}: {error.strerror or error}"
        return DoctorFinding("links", "fail", text)

    if is_protected:
        return DoctorFinding("links", "ok", f"can listen at {endpoint}")

    text = f"{endpoint} would listen unencrypted, to anybody who reaches it"
    return DoctorFinding("links", "warn", text)


def _examine_reaching(
    endpoint: str, address: tuple[str, int], folder: Path | None, *, is_protected: bool
) -> DoctorFinding:
    """Checks whether another process of a session answers at a TCP or TLS endpoint.

    The user learns before a session whether its processes can reach each other, and whether the
    connection is encrypted.

    Args:
        endpoint: The endpoint.
        address: Its host and port.
        folder: Folder of this member's keys. `None` if they cannot be used. Only the connection
            is then tried, and not the certificate.
        is_protected: True if the endpoint is encrypted or can only be reached from this
            machine.
    """
    try:
        with socket.create_connection(address, CONNECT_S) as tcp_link:
            is_encrypted = endpoint.startswith("tls/")
            if not is_encrypted:
                state: FindingState = "ok" if is_protected else "warn"
                return DoctorFinding("links", state, f"{endpoint} answers, unencrypted")

            context = _tls_context(folder)
            with context.wrap_socket(tcp_link, server_hostname=address[0]) as tls_link:
                authority = "whose authority is unknown"
                if folder:
                    authority = "with a certificate of the same authority"
                text = f"{endpoint} answers over {tls_link.version()}, {authority}"
                return DoctorFinding("links", "ok", text)
    except ssl.SSLError as error:
        reason = getattr(error, "verify_message", "") or error.reason or str(error)
        text = f"{endpoint} answers, but not as a member with these keys: {reason}"
        return DoctorFinding("links", "fail", text)
    except OSError as error:
        text = f"{endpoint} cannot be reached: {error.strerror or error}"
        return DoctorFinding("links", "fail", text)


def _examine_quic(endpoint: str, settings: Mapping[str, Any] | None) -> DoctorFinding:
    """Checks whether another member of the session answers over QUIC, by connecting to it.

    Python has no QUIC client in its standard library. Therefore the connection uses Zenoh, the
    network library of the sessions.

    Args:
        endpoint: The endpoint.
        settings: Zenoh settings that use the keys of this member. `None` if there are no keys,
            or if they cannot be used.
    """
    if settings is None:
        return DoctorFinding(
            "links",
            "warn",
            f"{endpoint} was not tried, because QUIC needs the keys of a member",
        )

    try:
        with closing(Connection((), [endpoint], "client", settings).open()):
            text = f"{endpoint} answers over QUIC, with a certificate of the same authority"
            return DoctorFinding("links", "ok", text)
    except (SessionError, UsageError) as error:
        return DoctorFinding(
            "links", "fail", f"{endpoint} does not answer a member with these keys: {error}"
        )


def _tls_context(folder: Path | None) -> ssl.SSLContext:
    """Returns the settings of an encrypted (TLS) test connection to another machine.

    Args:
        folder: Folder of this member's keys. If `None`, any certificate is accepted.
    """
    if folder is None:
        # Only the connection is tried. No data is sent.
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        return context

    context = ssl.create_default_context(cafile=str(folder / AUTHORITY))
    context.load_cert_chain(folder / CERTIFICATE, folder / PRIVATE_KEY)
    return context


def _split_address(endpoint: str) -> tuple[str, int] | None:
    """Splits a network endpoint such as "tls/[::1]:7447" into its host and its port.

    Args:
        endpoint: The endpoint, such as "tls/[::1]:7447".

    Returns:
        The host and the port. `None` for other endpoints, such as socket files.
    """
    # protocol / host or [IPv6 address] : port, with optional Zenoh settings after ? or #
    pattern = r"(?:tcp|tls|quic)/(\[[^\]]+\]|[^:/]+):(\d{1,5})(?:[?#].*)?"
    match = re.fullmatch(pattern, endpoint)
    if match is None:
        return None
    host, port_text = match.groups()
    port = int(port_text)
    if port >= 1 << 16:
        return None
    return host.strip("[]"), port


def _run_in_process(code: str) -> Any:
    """Runs Python code in a new process, and returns the value that the code prints.

    Some checks change the settings of their process, and must therefore not run in this
    process.

    Args:
        code: The code.

    Returns:
        The JSON value in the last line that the process prints.

    Raises:
        ChildProcessError: The process failed. The message gives the reason.
    """
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False
    )
    if completed.returncode:
        error_lines = completed.stderr.strip().splitlines() or ["it printed no reason"]
        ending = f"exit code {completed.returncode}"
        if completed.returncode < 0:
            ending = f"ended by signal {-completed.returncode}"
        raise ChildProcessError(f"{ending}: {error_lines[-1]}")

    last_line = completed.stdout.splitlines()[-1]
    return json.loads(last_line)


_RIGHTS_CODE = (
    "import json; from sites.realtime import prepare; print(json.dumps(prepare(None)))"
)
"""Program that requests the real-time settings of a site, and prints the granted settings."""


def rehearse_rates(clock: Clock) -> list[tuple[int, int, int]]:
    """Measures how punctual the control loop is on this machine, at decreasing rates in Hz.

    Stops at the first rate that the machine achieves, for example 1 kHz.

    Args:
        clock: Clock of this process.

    Returns:
        For each rate tried: the rate in Hz, the lateness in us that a fraction
            `MIN_PUNCTUAL_SHARE` of the ticks did not exceed, and the maximum lateness in us.
    """
    results: list[tuple[int, int, int]] = []
    for rate_hz in RATES_HZ:
        if results:
            tried_rate_hz, tried_quantile_us, _ = results[-1]
            if _is_held(tried_rate_hz, tried_quantile_us):
                break
        scenario = load_scenario("free", {"rate_hz": rate_hz, "duration_s": REHEARSAL_S})
        warm_up(scenario, "s", clock)
        late_us = sorted(rehearse_loop(scenario, "s", clock))
        quantile_index = int(MIN_PUNCTUAL_SHARE * len(late_us))
        quantile_us = late_us[quantile_index]
        results.append((rate_hz, quantile_us, late_us[-1]))
    return results


def _is_held(rate_hz: int, late_us: int) -> bool:
    """Returns True if a machine achieves a tick rate, judged by how late its ticks begin.

    The rate is achieved if the lateness is at most `MAX_LATE_PERIODS` periods of the rate.

    Args:
        rate_hz: The tick rate, in ticks (periods of the control loop) per second.
        late_us: The lateness, in us.
    """
    return late_us <= MAX_LATE_PERIODS * 1e6 / rate_hz


_RATES_CODE = (
    f"import json; from {__name__} import SystemClock, rehearse_rates; "
    "from sites.realtime import prepare; prepare(None); "
    "print(json.dumps(rehearse_rates(SystemClock())))"
)
"""Program that requests the real-time settings of a site, and prints the result of the trials.
"""


class MachineExamination:
    """Checks whether this machine can run a session, with one method per check.

    Args:
        connection: Endpoints that this machine would listen on or connect to.
        keys: Folder of a member's keys. `None` if there are no keys.
        folder: Folder in which results would be stored.
        session: Name of a running session; this machine's clock is compared with the clocks of
            its members. `None` to skip this comparison.
        clock: Clock of this process.
        insecure: True to allow connections without keys, because everybody on the network is
            trusted.
    """

    def __init__(
        self,
        connection: Connection,
        keys: Path | None,
        folder: Path,
        session: str | None,
        clock: Clock,
        *,
        insecure: bool,
    ) -> None:
        self._connection = connection
        self._keys_folder = keys
        self._folder = folder
        self._session = session
        self._clock = clock
        self._insecure = insecure
        self._keys_error = ""
        try:
            self._member_keys = None if keys is None else read_member_keys(keys)
        except UsageError as error:
            self._member_keys = None
            self._keys_error = str(error)

    def run(self) -> Iterator[DoctorFinding]:
        """Performs all checks, and yields each finding as soon as it is known.

        Some checks take seconds.

        Yields:
            The findings, in the order of the checks.
        """
        yield from self.check_keys()
        yield from self.check_links()
        yield from self.check_clock()
        if self._session is not None:
            yield from self._check_offsets(self._session)
        yield self.check_system()
        yield from self.check_rights()
        yield self.check_rate()
        yield from self.check_room()

    def check_keys(self) -> Iterator[DoctorFinding]:
        """Checks whether a member's keys are valid, when they expire, and who can read them.

        Keys encrypt the connections of a session and prove which process sent a message.

        Yields:
            The findings about the keys.
        """
        if self._keys_folder is None:
            yield DoctorFinding(
                "keys",
                "ok",
                "no keys given: without --keys a member listens only on this machine",
            )
            return

        member_keys = self._member_keys
        if member_keys is None:
            yield DoctorFinding("keys", "fail", self._keys_error)
            return

        names = ", ".join(member_keys.members)
        description = (
            f"keys of {member_keys.member} for {names}, "
            f"valid until {member_keys.ends:%Y-%m-%d %H:%M} UTC"
        )
        if member_keys.ends - datetime.now(UTC) < ENDS_SOON:
            yield DoctorFinding(
                "keys",
                "warn",
                f"{description}: they expire soon; renew them with trilat keys renew",
            )
        else:
            yield DoctorFinding("keys", "ok", description)

        for risk in member_keys.list_risks():
            yield DoctorFinding("keys", "warn", risk)

    def check_links(self) -> Iterator[DoctorFinding]:
        """Checks whether each network endpoint can be opened or reached, and is encrypted.

        An endpoint is an address with a protocol, such as "tls/[::1]:7447".

        Yields:
            The findings about the endpoints, or a single finding if no endpoint can be used at
            all.
        """
        try:
            secured = self._secure_connection()
        except UsageError as error:
            yield DoctorFinding("links", "fail", str(error))
            return

        unprotected = secured.unprotected_addresses
        for endpoint in secured.listen_addresses:
            address = _split_address(endpoint)
            if address is None:
                yield _describe_untried(endpoint)
            else:
                is_protected = endpoint not in unprotected
                yield _examine_listening(endpoint, address, is_protected=is_protected)

        for endpoint in secured.connect_addresses:
            try:
                check_hosts([endpoint])
            except UsageError as error:
                yield DoctorFinding("links", "fail", str(error))
                continue
            address = _split_address(endpoint)
            if endpoint.startswith("quic/"):
                keys = self._member_keys
                yield _examine_quic(endpoint, None if keys is None else keys.settings)
            elif address is None:
                yield _describe_untried(endpoint)
            else:
                folder = self._keys_folder if self._member_keys else None
                yield _examine_reaching(
                    endpoint, address, folder, is_protected=endpoint not in unprotected
                )

        if not secured.listen and not secured.connect:
            yield DoctorFinding(
                "links",
                "ok",
                "no endpoints given; --listen and --connect are tried if they are given",
            )

    def check_clock(self) -> Iterator[DoctorFinding]:
        """Checks whether the clocks of this machine run steadily.

        During a test of `CLOCK_TEST_NS`, the monotonic clock must not go backwards, and the
        time of day must not jump relative to it. The finding also states the longest gap
        between two readings, which shows for how long the operating system interrupts a
        process.

        Yields:
            One finding about the clocks.
        """
        clock = self._clock
        started_ns = clock.monotonic_ns()
        wall_start_ns = clock.unix_ns()
        previous_ns = started_ns
        backward_steps = 0
        longest_gap_ns = 0
        while previous_ns - started_ns < CLOCK_TEST_NS:
            now_ns = clock.monotonic_ns()
            backward_steps += now_ns < previous_ns
            longest_gap_ns = max(longest_gap_ns, now_ns - previous_ns)
            previous_ns = now_ns

        # If both clocks run steadily, they have advanced by the same time.
        wall_elapsed_ns = clock.unix_ns() - wall_start_ns
        elapsed_ns = clock.monotonic_ns() - started_ns
        step_ns = abs(wall_elapsed_ns - elapsed_ns)

        if backward_steps:
            times_text = count_nouns(backward_steps, "time")
            text = f"the monotonic clock went back {times_text} in 0.1 s"
            yield DoctorFinding("clock", "fail", text)
        elif step_ns > MAX_CLOCK_STEP_NS:
            step_text = f"the wall clock stepped by {step_ns / 1e6:.1f} ms in 0.1 s"
            yield DoctorFinding("clock", "warn", f"{step_text}; that distorts no record")
        else:
            longest_ms = longest_gap_ns / 1e6
            text = f"steady; largest pause of a loop that never sleeps {longest_ms:.1f} ms"
            yield DoctorFinding("clock", "ok", text)

    def _check_offsets(self, session: str) -> Iterator[DoctorFinding]:
        """Compares the clock of this machine with the clocks of a session's other processes.

        Measured delays of messages are only as accurate as the known offset between the clocks.

        Args:
            session: Name of the session.

        Yields:
            For each member, the offset of its clock and the error bound of the offset.
        """
        connection = self._secure_connection()
        try:
            measurement = ping_session(
                connection=connection,
                clock=self._clock,
                session=session,
                count=PINGS,
                timeout_s=CONNECT_S,
                stopped=lambda: False,
            )
        except (RunFailed, SessionError, UsageError) as error:
            yield DoctorFinding("clock", "fail", str(error))
            return

        for member_row in measurement.members if measurement else ():
            member = member_row["member"]
            if member_row["same_clock"]:
                yield DoctorFinding("clock", "ok", f"{member} has the same clock")
            elif "offset_ns" not in member_row:
                yield DoctorFinding("clock", "warn", f"{member} answered too few pings")
            else:
                offset_s = member_row["offset_ns"] / 1e9
                bound_us = member_row["bound_us"]
                ahead_text = f"the clock of {member} is {offset_s:+.6f} s ahead"
                text = f"{ahead_text}, known to {bound_us:.0f} us"
                state: FindingState = "ok" if bound_us <= MAX_BOUND_US else "warn"
                yield DoctorFinding("clock", state, text)

    @staticmethod
    def check_system() -> DoctorFinding:
        """Reports which parts of the program work on this operating system.

        Returns:
            A single finding: "ok" on Linux; on other systems, it names the missing parts.
        """
        name = {"Darwin": "macOS"}.get(platform.system(), platform.system())
        if name == "Linux":
            return DoctorFinding(
                "system", "ok", "on Linux, live sessions and studies are both supported"
            )
        text = (
            f"live sessions are supported only on Linux; on {name}, only simulation, logs and "
            "studies are supported"
        )
        return DoctorFinding("system", "warn", text)

    @staticmethod
    def check_rights() -> Iterator[DoctorFinding]:
        """Checks which real-time settings the operating system grants to a site.

        For example, a site needs a high priority to keep other programs from interrupting its
        control loop.

        Yields:
            One finding per setting, or a single warning if the settings could not be tried.
        """
        try:
            obtained_settings: dict[str, str] = _run_in_process(_RIGHTS_CODE)
        except ChildProcessError as error:
            text = (
                f"the settings could not be tried: the process that tries them failed ({error})"
            )
            yield DoctorFinding("rights", "warn", text)
            return

        wanted_settings = {
            "scheduling": "SCHED_FIFO",
            "memory": "locked",
            "timer_slack": "1 ns",
        }
        remedy = "ticks will be late by milliseconds under load: see compose.realtime.yaml"
        for name, prefix in wanted_settings.items():
            text = f"{name.replace('_', ' ')}: {obtained_settings[name]}"
            if obtained_settings[name].startswith(prefix):
                yield DoctorFinding("rights", "ok", text)
            else:
                yield DoctorFinding("rights", "warn", f"{text}; {remedy}")

    @staticmethod
    def check_rate() -> DoctorFinding:
        """Measures the highest rate, in Hz, at which this machine runs a control loop on time.

        The rates in `RATES_HZ`, such as 1000 Hz, are tried in turn, for `REHEARSAL_S` each,
        until the loop starts its periods on time.
        """
        if not is_core_cached():
            return DoctorFinding(
                "rate",
                "warn",
                "the rate was not measured, because the core is not compiled yet; see below",
            )

        try:
            results: list[tuple[int, int, int]] = _run_in_process(_RATES_CODE)
        except ChildProcessError as error:
            text = (
                f"the rate could not be measured: the process that measures it failed ({error})"
            )
            return DoctorFinding("rate", "warn", text)

        # All rates before the last one were not achieved.
        rate_hz, late_us, largest_us = results[-1]
        missed_rates = results[:-1]
        share_text = f"{MIN_PUNCTUAL_SHARE:.0%}"
        text = (
            f"{share_text} of the ticks began within {late_us / 1e3:.2f} ms of their time, "
            f"all within {largest_us / 1e3:.1f} ms"
        )

        if not _is_held(rate_hz, late_us):
            text = (
                f"a single site does not even achieve {rate_hz} Hz: {text}; end other programs"
            )
            return DoctorFinding("rate", "fail", text)

        text = (
            f"a single site achieves {rate_hz} Hz: {text} ({share_text} must begin within "
            "half a period)"
        )
        if missed_rates:
            missed_hz, missed_us, _ = missed_rates[-1]
            text += f"; at {missed_hz} Hz, within {missed_us / 1e3:.2f} ms: lower rate_hz"
        return DoctorFinding("rate", "warn" if missed_rates else "ok", text)

    def check_room(self) -> Iterator[DoctorFinding]:
        """Checks disk space, processors, and whether the control loop is already compiled.

        If the control loop has not been compiled and cached yet, the first run takes longer to
        start. The results folder does not have to exist.
        """
        # The folder may be created later. Its nearest existing parent has the same disk.
        folder = self._folder.absolute()
        candidates = (folder, *folder.parents)
        existing_folder = next(path for path in candidates if path.is_dir())
        free_bytes = shutil.disk_usage(existing_folder).free

        state: FindingState = "ok"
        if free_bytes < MIN_FREE_BYTES:
            state = "fail"
        elif free_bytes < LOW_FREE_BYTES:
            state = "warn"
        if not os.access(existing_folder, os.W_OK):
            yield DoctorFinding("disk", "fail", f"{existing_folder} cannot be written to")
        yield DoctorFinding(
            "disk", state, f"{free_bytes / 1e9:.1f} GB are free in {existing_folder}"
        )

        cores = workers.count_cores()
        waiting_programs = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
        cores_text = count_nouns(cores, "processor")
        text = f"{cores_text}, on which {waiting_programs:.1f} programs want to run"
        warning = check_machine_load(SystemClock())
        if warning:
            text = f"{text}; {warning}"
        is_overloaded = cores < 2 or waiting_programs >= cores or bool(warning)
        yield DoctorFinding("processors", "warn" if is_overloaded else "ok", text)

        if is_core_cached():
            yield DoctorFinding("core", "ok", "compiled")
        else:
            text = "not yet compiled: the first session here begins half a minute later"
            yield DoctorFinding("core", "warn", text)

    def _secure_connection(self) -> Connection:
        """Returns the connection of this member with the member's keys.

        Raises:
            UsageError: The endpoints are open to other machines without keys.
        """
        return self._connection.secure(self._member_keys, insecure=self._insecure)


@dataclass(frozen=True, repr=False)
class DoctorReport(Result):
    """Result of `trilat doctor`: whether this machine is ready for a live session.

    Attributes:
        findings: Findings in the order of the checks.
    """

    findings: list[DoctorFinding]

    def headline(self) -> str:
        """Returns the number of findings in each state, for example "0 fail, 2 warn, 9 ok"."""
        states = [finding.state for finding in self.findings]
        return (
            f"{states.count('fail')} fail, {states.count('warn')} warn, {states.count('ok')} ok"
        )

    def to_dict(self) -> dict[str, Any]:
        """Converts all findings to plain values, with the keys of `trilat doctor --json`.

        The only key, "findings", contains the rows returned by `to_rows`.
        """
        return {"findings": self.to_rows()}

    def to_rows(self) -> list[dict[str, Any]]:
        """Converts the findings to a table with one row per check, for example for pandas.

        The columns are the fields of `DoctorFinding`.
        """
        return [finding._asdict() for finding in self.findings]

    def blocks(self) -> Iterator[Any]:
        """Returns the lines that `trilat doctor` prints, one per finding, marked by state.

        The formatting module is imported inside this method, because a program that only reads
        the findings does not need it.
        """
        from ..presentation import compose_doctor

        return compose_doctor(self)


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
    """Checks whether this machine is ready for a session, as `trilat doctor` does.

    >>> "clock" in {finding.check for finding in tn.doctor().findings}
    True

    Args:
        listen: Endpoints that this machine would listen on.
        connect: Endpoints that this machine would connect to.
        router: Endpoints of routers that this machine would connect to.
        keys: Folder of a member's keys. `None` if there are no keys.
        session: Name of a running session; this machine's clock is compared with the clocks of
            its members.
        folder: Folder in which results would be stored.
        insecure: True to allow connections without keys, because everybody on the network is
            trusted.

    Returns:
        A report with the finding of each check.

    Raises:
        UsageError: An endpoint or the keys cannot be used.
    """
    examination = MachineExamination(
        connection=Connection.of_member(listen, connect, router),
        keys=None if keys is None else Path(keys),
        folder=Path(folder),
        session=session,
        clock=SystemClock(),
        insecure=insecure,
    )
    return DoctorReport(list(examination.run()))

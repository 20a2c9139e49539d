"""Measures a network before a session, and reports whether it is good enough for a scenario.

This process (the near end) sends messages to a process on another machine (the far end, started
with `trilat ping --answer`), which returns each of them immediately. Round-trip times and
message losses are measured for several message sizes, message rates and protocols, and compared
with the delay and loss that the scenario tolerates. The command `trilat ping --benchmark` runs
the benchmark.

Invariant:
    - The benchmark uses the network as a session would. Its messages have the size, rate,
      priority and network settings of samples, the states that the arms send to each other.
    - The benchmark disturbs no session, because it uses a separate session name.
"""

import math
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.errors import RunFailed, ScenarioError, UsageError
from trilat_net.net import topics
from trilat_net.package_names import require_libraries
from trilat_net.results import Result
from trilat_net.scenario import Scenario, load_scenario

from ..core import Array
from ..net import (
    ENCRYPTED,
    ROLES,
    ROUTER,
    VERSION,
    Bus,
    Clock,
    Connection,
    DefaultEndpoints,
    MemberKeys,
    PeerSample,
    StampedInbox,
    SystemClock,
    create_keys,
    read_member_keys,
)

SESSION = "benchmark"
"""Name of the session in whose key space the messages of the benchmark are published."""
NEAR = "near"
FAR = "far"
"""Names of the near end and the far end if they have no keys with a member's name."""
PROTOCOLS = ("tcp", "tls", "quic")
"""Transports that are measured if the far end runs on this machine."""
SIZE_FACTORS = (1, 4, 16)
"""Sizes of the messages, as multiples of the size of a sample of the scenario."""
RATE_SHARES = (0.1, 1.0)
"""Rates of the messages, as fractions of the tick rate of the scenario."""
DEFAULT_S = 24.0
"""Default duration of all measurements together, in s.

With three transports, 18 measurements take 1.33 s each.
"""
CONNECT_NS = 20_000_000_000
"""Longest wait for the far end, in ns."""
MAX_LOST = 1e-3
"""Largest tolerable fraction of lost samples."""
_RETRY_NS = 50_000_000
"""Time between two attempts to reach the far end, in ns."""
_LAST_REPLY_NS = 500_000_000
"""Longest wait for replies after the last message, in ns."""
_HEADER = struct.Struct("<QQqB")
"""Start of each message: identity of the near end, number of the message, time of sending in
ns, and a byte that is 1 in a reply.
"""


def _parse_header(payload: bytes) -> tuple[int, ...] | None:
    """Returns the fields of a message's header, or `None` if the message is too short."""
    return _HEADER.unpack_from(payload) if len(payload) >= _HEADER.size else None


def answer_benchmarks(bus: Bus, member: str) -> None:
    """Returns each test message of a network benchmark to its sender, until the bus is closed.

    This function runs at the far end. The near end sends the messages and measures their
    round-trip times.

    Args:
        bus: Network connection of the far end.
        member: Name under which the far end publishes its messages.
    """
    publish = bus.publisher(topics.key(SESSION, member, topics.SAMPLE))

    def answer(_: str, payload: bytes) -> None:
        """Returns a benchmark message to its sender, marked as a reply.

        Replies are not returned again, as they would circulate forever. Messages without the
        benchmark header are ignored.
        """
        header = _parse_header(payload)
        if header is None:
            return
        *sender_fields, is_reply = header
        if not is_reply:
            publish(_HEADER.pack(*sender_fields, 1) + payload[_HEADER.size :])

    bus.tap(topics.key(SESSION, "*", topics.SAMPLE), answer)


class NearEnd:
    """Sends test messages to another process, the far end, and measures their round-trip times.

    The far end returns each message immediately, so round-trip times can be measured with the
    near end's clock alone.

    Args:
        bus: Network connection of the near end.
        clock: Clock of this process.
        member: Name of the near end.
    """

    def __init__(self, bus: Bus, clock: Clock, member: str) -> None:
        self._clock = clock
        self._owner = int.from_bytes(os.urandom(8), "little")
        self._number = 0
        self._put = bus.publisher(topics.key(SESSION, member, topics.SAMPLE))
        key = topics.key(SESSION, "*", topics.SAMPLE)
        self._inbox: StampedInbox[tuple[int, ...] | None] = bus.stamped_inbox(
            key, clock.monotonic_ns, _parse_header
        )

    def _send(self, size_bytes: int) -> None:
        """Sends the next message, padded with zeros to a given size in bytes."""
        sample = _HEADER.pack(self._owner, self._number, self._clock.monotonic_ns(), 0)
        self._number += 1
        self._put(sample.ljust(size_bytes, b"\0"))

    def _read_replies(self) -> Iterator[tuple[int, int]]:
        """Yields the number and the round-trip time in ns of each returned test message.

        Replies to other measuring processes are ignored.
        """
        while (entry := self._inbox.poll()) is not None:
            header, arrived_ns = entry
            if header is not None:
                owner, number, sent_ns, is_reply = header
                if is_reply and owner == self._owner:
                    yield number, arrived_ns - sent_ns

    def wait_for_far_end(self) -> bool:
        """Waits until the far end can be reached.

        Messages are sent repeatedly, because the connection may not be established yet.

        Returns:
            True once the far end has replied. False if it does not reply within `CONNECT_NS`.
        """
        clock = self._clock
        until_ns = clock.monotonic_ns() + CONNECT_NS
        while clock.monotonic_ns() < until_ns:
            self._send(_HEADER.size)
            clock.sleep_until(clock.monotonic_ns() + _RETRY_NS)
            if any(self._read_replies()):
                return True
        return False

    def measure(self, size_bytes: int, rate_hz: float, duration_s: float) -> Array:
        """Sends messages at a constant rate, and measures their round-trip times in s.

        The message rate does not depend on the replies, so the load is the same as in a real
        session.

        Args:
            size_bytes: Size of a message, in bytes.
            rate_hz: Rate of the messages, in 1/s.
            duration_s: Time for which messages are sent, in s. At least 10 messages are sent.

        Returns:
            Round-trip time of each message, in s. NaN for messages without a reply.
        """
        count = max(10, round(rate_hz * duration_s))
        clock = self._clock
        round_trips_s = np.full(count, np.nan)
        first_number = self._number

        def count_missing() -> int:
            """Stores round-trip times of newly returned messages, and counts missing messages.

            Replies to messages of earlier measurements are ignored.

            Returns:
                Number of messages of this measurement that have not come back yet.
            """
            for number, round_trip_ns in self._read_replies():
                if number >= first_number:
                    round_trips_s[number - first_number] = round_trip_ns / 1e9
            return int(np.isnan(round_trips_s).sum())

        started_ns = clock.monotonic_ns()
        for sent_count in range(count):
            clock.sleep_until(started_ns + round(sent_count * 1e9 / rate_hz))
            self._send(size_bytes)
            if sent_count % 1000 == 0:
                count_missing()  # empties the inbox, which would overflow otherwise

        # The last replies are still on their way.
        until_ns = clock.monotonic_ns() + _LAST_REPLY_NS
        while count_missing() and clock.monotonic_ns() < until_ns:
            clock.sleep_until(clock.monotonic_ns() + 5_000_000)
        return round_trips_s


def _open(
    endpoint: str,
    keys: MemberKeys | None,
    *,
    listens: bool,
    insecure: bool,
) -> tuple[Bus, str]:
    """Opens the network connection of one end of a benchmark.

    The near end sends test messages, and the far end sends them back.

    Args:
        endpoint: Endpoint to listen at or to connect to.
        keys: Keys of a site. They are used only if the endpoint is encrypted.
        listens: True for the far end.
        insecure: True to permit connections without keys, because everybody on the network is
            trusted.

    Returns:
        The connection, and the name of the end: that of its keys, otherwise "near" or "far".

    Raises:
        UsageError: The endpoint is encrypted, but there are no keys, or the keys do not belong
            to a site.
    """
    is_encrypted = endpoint.startswith(ENCRYPTED)
    if is_encrypted and keys is None:
        raise UsageError(
            f"{endpoint}: an encrypted endpoint needs keys: give --keys DIR with the keys of a "
            "site"
        )
    if listens:
        connection = Connection(listen=[endpoint])
        name = FAR
    else:
        connection = Connection(connect=[endpoint])
        name = NEAR

    secured = connection.secure(keys if is_encrypted else None, insecure=insecure)
    if secured.keys_of in (*ROLES, ROUTER):
        raise UsageError(
            "--keys: a benchmark sends messages as sites send samples, and so needs the keys "
            f"of a site, not those of {secured.keys_of}"
        )
    return secured.open(), secured.keys_of or name


def run_far_end(
    endpoints: Sequence[str],
    keys: str | Path | None,
    stopped: Callable[[], bool],
    duration_s: float = math.inf,
    *,
    insecure: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Runs the far end of a network benchmark, which returns every test message.

    The user starts it on the other machine with `trilat ping --answer`.

    Args:
        endpoints: Endpoints to listen on.
        keys: Folder with a site's keys, for encrypted endpoints.
        stopped: Function that returns True when the far end must stop.
        duration_s: Maximum duration, in s.
        insecure: True to allow connections without keys, because everybody on the network is
            trusted.
        say: Function that prints a line for the user.

    Raises:
        UsageError: An endpoint or the keys cannot be used.
    """
    member_keys = None if keys is None else read_member_keys(keys)
    clock = SystemClock()
    started_ns = clock.monotonic_ns()
    with ExitStack() as stack:
        for endpoint in endpoints:
            bus, member = _open(endpoint, member_keys, listens=True, insecure=insecure)
            answer_benchmarks(stack.enter_context(closing(bus)), member)
        say(f"answers benchmarks at {', '.join(endpoints)}; Ctrl-C ends it")
        while not stopped() and clock.monotonic_ns() - started_ns < duration_s * 1e9:
            clock.sleep_until(clock.monotonic_ns() + _RETRY_NS)


@contextmanager
def _run_local_far_end(duration_s: float) -> Iterator[tuple[list[str], Path]]:
    """Runs the far end of a benchmark in a process on this machine, as a context manager.

    The far end sends back the test messages. Without another machine, only this machine itself
    is measured.

    Args:
        duration_s: Duration of the benchmark, in s. The process ends some time later by itself.

    Yields:
        The endpoints of the far end, and the folder with the keys of the near end.
    """
    reserved = DefaultEndpoints(SESSION).reserve(len(PROTOCOLS))
    with tempfile.TemporaryDirectory() as folder, reserved as free_endpoints:
        near_keys, far_keys = create_keys(Path(folder) / "keys", [NEAR, FAR], days=1)
        endpoints = []
        for protocol, endpoint in zip(PROTOCOLS, free_endpoints, strict=True):
            endpoints.append(endpoint.replace("tcp", protocol))

        seconds = math.ceil(duration_s + 2 * CONNECT_NS / 1e9)
        arguments = ["ping", "--keys", str(far_keys), "--seconds", str(seconds)]
        for endpoint in endpoints:
            arguments += ["--answer", endpoint]

        child = subprocess.Popen(
            [sys.executable, "-m", "trilat_net", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield endpoints, near_keys
        finally:
            child.terminate()
            child.wait()


class NetworkNeeds(NamedTuple):
    """Network requirements of a scenario: message size, message rate and maximum delay.

    They are computed from the rate of the control loops and from the delays for which the loops
    are stable.

    Attributes:
        sample_bytes: Size of a sample of the largest arm, in bytes.
        rate_hz: Highest tick rate of any site, in 1/s.
        playout_ms: Smallest play-out delay of the links. A play-out delay holds each sample
            until it reaches a fixed age, which turns varying network delays into a constant
            one.
        held_ms: Shortest time for which any link holds its samples, due to a play-out delay or
            to a constant delay set in the scenario.
        in_use_ms: Largest age of the samples in use that results from the delays set in the
            scenario. `None` if the linear theory does not cover the scenario, or if a link is
            delayed only by the real network.
        stable_ms: Intervals of the delay, equal on all links, in which the control loop is
            stable. `None` if the linear theory does not cover the scenario.
        words: Explanation of `stable_ms` for the user, or the reason why the theory does not
            cover the scenario.
    """

    sample_bytes: int
    rate_hz: int
    playout_ms: float
    held_ms: float
    in_use_ms: float | None
    stable_ms: list[list[float]] | None
    words: str

    @classmethod
    def of_scenario(cls, scenario: Scenario) -> "NetworkNeeds":
        """Computes the delay, message size and message rate that a scenario requires.

        The stable delays are computed by a linear analysis of the control loop, which takes as
        long as the command `trilat linear`.

        Args:
            scenario: The scenario to analyse.
        """
        links = list(scenario.links.values())
        held_ms = [max(link.playout_ms, link.constant_delay_ms or 0.0) for link in links]
        rates_hz = [site.rate_hz for site in scenario.sites.values()]
        # Links whose delay the benchmark measures are analysed with a delay of 1 ms: their
        # actual delay is the result of the benchmark.
        overrides = ["link.model=constant", "link.delay_ms=1"] if scenario.measured else []

        in_use_ms: float | None = None
        stable_ms: list[list[float]] | None = None
        try:
            require_libraries("scipy")
            # Imported here because the far end does not need SciPy.
            from ..analysis import LinearAnalysis

            loop = LinearAnalysis.compute(load_scenario(scenario, overrides))
        except (ScenarioError, RunFailed, UsageError) as error:
            description = f"the linear theory does not cover its delay margin: {error}"
        else:
            description = loop.margin.description
            stable_ms = [
                [1e3 * interval.low_s, 1e3 * interval.high_s]
                for interval in loop.margin.intervals
            ]
            if not overrides:
                in_use_ms = 1e3 * float(loop.conditions.age_s.max())

        return cls(
            sample_bytes=_measure_sample(scenario),
            rate_hz=max(rates_hz),
            playout_ms=min((link.playout_ms for link in links), default=0.0),
            held_ms=min(held_ms, default=0.0),
            in_use_ms=in_use_ms,
            stable_ms=stable_ms,
            words=description,
        )

    def judge(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Decides whether a network is good enough for the scenario.

        A sample is the state that a site publishes in each tick (a period of its control loop).
        The receiver starts to use a sample at its first tick after the arrival, so the age of
        the sample in use is an integer number of ticks. The age is computed from the 99th
        percentile of the network delay, or from the time for which the links of the scenario
        hold their samples, if that time is longer. The network is good enough if the loop is
        stable at that age, and if at most a fraction `MAX_LOST` of the samples is lost.

        Args:
            row: Measurement at the scenario's own message size and rate.

        Returns:
            The fields of a verdict, as printed by `trilat ping --benchmark --json`. Times are
            `None` if no message came back.
        """
        fields = {
            "transport": row["transport"],
            "good": False,
            "lost_share": row["lost"] / row["sent"],
        }

        one_way_us = row["one_way_us"]
        if one_way_us is None:
            unknown = dict.fromkeys(("p99_ms", "age_ms", "spare_ms", "playout_ms"))

            return {**fields, "hidden": False, **unknown}

        period_ms = 1e3 / self.rate_hz
        p99_ms = one_way_us["p99"] / 1e3
        # 1e-9 absorbs the rounding error of a delay of exactly a whole number of ticks.
        arrival_ms = max(p99_ms, self.held_ms)
        age_ticks = max(1, math.ceil(arrival_ms / period_ms - 1e-9))
        age_ms = max(period_ms * age_ticks, self.in_use_ms or 0.0)
        is_hidden = p99_ms <= self.held_ms
        # Upper end of the stable interval that contains the age, if there is one.
        limits_ms = [high for low, high in self.stable_ms or [] if low <= age_ms <= high]
        is_tolerated = is_hidden if self.stable_ms is None else bool(limits_ms)
        return {
            **fields,
            "good": is_tolerated and fields["lost_share"] <= MAX_LOST,
            "hidden": is_hidden,
            "p99_ms": p99_ms,
            "age_ms": age_ms,
            "spare_ms": limits_ms[0] - age_ms if limits_ms else None,
            "playout_ms": math.ceil(one_way_us["max"] / 1e3),
        }


def _measure_sample(scenario: Scenario) -> int:
    """Returns the size in bytes of an encoded sample of the scenario's largest arm.

    Larger integers take more bytes. The encoded sample therefore contains values as large as
    those late in a long session.

    Args:
        scenario: The scenario.
    """
    coordinate_count = max(arm.counts.shared for arm in scenario.arms.values())
    vectors = {name: [0.5] * coordinate_count for name in ("q", "qd", "tau_x")}
    sample = PeerSample(
        v=VERSION,
        site=max(scenario.names, key=len),
        boot=2**63,
        tick=100_000,
        sent_ns=2**60,
        echo=[[n, 100_000, 2**60] for n in range(len(scenario.names) - 1)],
        **vectors,
    )
    return len(msgspec.msgpack.encode(sample))


@dataclass(frozen=True, repr=False)
class NetworkBenchmark(Result):
    """Result of a benchmark that tests whether the network is good enough for a scenario.

    There is one verdict per transport (TCP, TLS or QUIC).

    Attributes:
        scenario: Name of the scenario.
        duration_s: Total duration of all measurements, in s.
        needs: Requirements of the scenario.
        rows: Measurements, one row per message size, message rate and transport.
        judged: Verdict for each transport on whether the network is good enough; see
            `NetworkNeeds.judge`.
        connect: Endpoints of the far end on another machine. Empty if both ends ran on this
            machine, in which case no network was measured.
    """

    scenario: str
    duration_s: float
    needs: NetworkNeeds
    rows: list[dict[str, Any]]
    judged: list[dict[str, Any]]
    connect: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """True if the network is good enough for the scenario with every measured transport.

        This determines the exit code of `trilat ping --benchmark`.
        """
        return all(verdict["good"] for verdict in self.judged)

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to the plain values that `trilat ping --benchmark --json` prints.

        "needs" contains the requirements of the scenario, "transports" the verdict on each
        transport, and "rows" the measurements.
        """
        return {
            "scenario": self.scenario,
            "duration_s": self.duration_s,
            "good": self.good,
            "connect": list(self.connect),
            "needs": self.needs._asdict(),
            "transports": self.judged,
            "rows": self.rows,
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one table row per message size, message rate and transport, with times in us.

        The columns "p50_us", "p99_us" and "max_us" contain one-way times. They are `None` if no
        message came back.
        """
        flat_rows = []
        for row in self.rows:
            one_way_us = row["one_way_us"] or dict.fromkeys(("p50", "p99", "max"))
            flat_row = {key: value for key, value in row.items() if key != "one_way_us"}
            flat_row |= {f"{name}_us": value for name, value in one_way_us.items()}
            flat_rows.append(flat_row)
        return flat_rows

    def blocks(self) -> Iterator[Any]:
        """Returns the table and the verdicts that `trilat ping --benchmark` prints.

        The formatting module is imported inside this method, because a program that only reads
        the results does not need it.
        """
        from ..presentation import compose_benchmark

        return compose_benchmark(self)


def ping_benchmark(
    scenario: str | Path | Mapping[str, Any] | Scenario,
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    duration_s: float = DEFAULT_S,
    connect: Sequence[str] | None = None,
    keys: str | Path | None = None,
) -> NetworkBenchmark:
    """Tests whether a network suits a scenario, as `trilat ping --benchmark` does.

    >>> found = tn.ping_benchmark("p_d_margin", duration_s=2)
    >>> [row["transport"] for row in found.to_dict()["transports"]]
    ['tcp', 'tls', 'quic']

    Args:
        scenario: Name of a shipped scenario, path of a TOML file, TOML string, mapping of its
            tables, or `Scenario`.
        set: Overrides of scenario settings, for example `{"link.model": "measured"}`.
        duration_s: Total duration of all measurements, in s.
        connect: Endpoints on which `trilat ping --answer` listens. If `None`, a far end is
            started on this machine, for TCP, TLS and QUIC.
        keys: Folder with a site's keys, for encrypted endpoints.

    Returns:
        The measurements and the verdicts.

    Raises:
        ScenarioError: The scenario is invalid.
        UsageError: An endpoint or the keys cannot be used.
        RunFailed: No far end replies at an endpoint.
    """
    loaded_scenario = load_scenario(scenario, set)
    needs = NetworkNeeds.of_scenario(loaded_scenario)
    far_endpoints = tuple(connect or ())
    with ExitStack() as stack:
        if not connect:
            connect, keys = stack.enter_context(_run_local_far_end(duration_s))
        member_keys = None if keys is None else read_member_keys(keys)
        case_s = duration_s / (len(connect) * len(SIZE_FACTORS) * len(RATE_SHARES))
        rows: list[dict[str, Any]] = []
        for endpoint in connect:
            rows += _measure_endpoint(endpoint, member_keys, needs, case_s)

    # Only the case with the scenario's own message size and rate is judged.
    scenario_case = (needs.sample_bytes, needs.rate_hz)
    verdicts = []
    for row in rows:
        row_case = (row["bytes"], row["rate_hz"])
        if row_case == scenario_case:
            verdicts.append(needs.judge(row))
    return NetworkBenchmark(
        loaded_scenario.name, duration_s, needs, rows, verdicts, far_endpoints
    )


def _measure_endpoint(
    endpoint: str,
    keys: MemberKeys | None,
    needs: NetworkNeeds,
    case_s: float,
) -> Iterator[dict[str, Any]]:
    """Measures round trips to another machine, with all message sizes and rates.

    A program on that machine, the far end, returns each message.

    Args:
        endpoint: Endpoint of the far end.
        keys: Keys of this end. `None` if the endpoint is not encrypted.
        needs: Requirements of the scenario, which determine the sizes and rates.
        case_s: Duration of each measurement, in s.

    Yields:
        One row per size and rate.

    Raises:
        RunFailed: No far end replies.
    """
    protocol = endpoint.partition("/")[0]
    bus, member = _open(endpoint, keys, listens=False, insecure=False)
    with closing(bus):
        near_end = NearEnd(bus, SystemClock(), member)
        if not near_end.wait_for_far_end():
            port = endpoint.rpartition(":")[2]
            raise RunFailed(
                f"no program answered at {endpoint} within {CONNECT_NS // 10**9} s: on that "
                f"machine, start trilat ping --answer {protocol}/0.0.0.0:{port}; over tls or "
                "quic, also give --keys of another site"
            )

        for size_factor, rate_share in product(SIZE_FACTORS, RATE_SHARES):
            size_bytes = size_factor * needs.sample_bytes
            rate_hz = rate_share * needs.rate_hz
            round_trips_s = near_end.measure(size_bytes, rate_hz, case_s)
            yield {
                "transport": protocol,
                "bytes": size_bytes,
                "rate_hz": rate_hz,
                "sent": len(round_trips_s),
                "lost": int(np.isnan(round_trips_s).sum()),
                "one_way_us": _summarise_trips(round_trips_s),
            }


def _summarise_trips(trips_s: Array) -> dict[str, float] | None:
    """Returns the median, the 99th percentile and the maximum of the one-way times, in us.

    A one-way time is half of a round trip, because the clocks of two machines differ.

    Args:
        trips_s: Round trip times in s, NaN for lost messages.

    Returns:
        The three values. `None` if all messages were lost.
    """
    arrived_s = trips_s[np.isfinite(trips_s)]
    one_way_us = arrived_s / 2 * 1e6
    if not len(one_way_us):
        return None
    p50, p99 = np.percentile(one_way_us, (50, 99))
    return {"p50": float(p50), "p99": float(p99), "max": float(one_way_us.max(initial=0.0))}

"""The benchmark of a network: round trips by size, rate and transport, against what a scenario
bears.

Invariant: it is no part of any session. Its payloads go as samples go, by the same keys' roles,
priority and settings, in a session of its own name; the far end sends each back at once. It
lasts as long as it was told.
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

from trilat_net.core.vectors import Array
from trilat_net.errors import RunFailed, ScenarioError, UsageError
from trilat_net.files import require_libraries
from trilat_net.net import topics
from trilat_net.net.bus import Bus, StampedInbox
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import (
    ENCRYPTED,
    Connection,
    find_free_endpoints,
    secure_connection,
)
from trilat_net.net.member_keys import MemberKeys, create_keys, read_member_keys
from trilat_net.net.messages import VERSION, PeerSample
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.net.zenoh_config import ROLES, ROUTER
from trilat_net.results import Result
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.delay_models.kernel_delays import ConstantDelay

SESSION = "benchmark"
NEAR = "near"
FAR = "far"
"""Names of the ends that have no keys."""
PROTOCOLS = ("tcp", "tls", "quic")
SIZES = (1, 4, 16)
"""Of a payload, in samples of the scenario."""
RATES = (0.1, 1.0)
"""In the scenario's rate."""
DEFAULT_S = 24.0
"""All cases together, s: with three transports 18 of 1.33 s each."""
CONNECT_NS = 20_000_000_000
"""Longest wait for the far end."""
MAX_LOST = 1e-3
"""The largest share of samples lost that is good enough."""
_RETRY_NS = 50_000_000
_STRAGGLE_NS = 500_000_000
_HEADER = struct.Struct("<QQqB")
"""Who measures, number of the sample, time of its departure, ns; 1 in an answer."""


def _read(payload: bytes) -> tuple[int, ...] | None:
    return _HEADER.unpack_from(payload) if len(payload) >= _HEADER.size else None


def answer_benchmarks(bus: Bus, member: str) -> None:
    """Sends back what benchmarks send, until the bus is closed."""
    put = bus.publisher(topics.key(SESSION, member, topics.SAMPLE))

    def answer(_: str, payload: bytes) -> None:
        if (header := _read(payload)) is not None and not header[-1]:
            put(_HEADER.pack(*header[:-1], 1) + payload[_HEADER.size :])

    bus.tap(topics.key(SESSION, "*", topics.SAMPLE), answer)


class NearEnd:
    """The end that measures."""

    def __init__(self, bus: Bus, clock: Clock, member: str) -> None:
        self._clock = clock
        self._owner = int.from_bytes(os.urandom(8), "little")
        self._number = 0
        self._put = bus.publisher(topics.key(SESSION, member, topics.SAMPLE))
        key = topics.key(SESSION, "*", topics.SAMPLE)
        self._inbox: StampedInbox[tuple[int, ...] | None] = bus.stamped_inbox(
            key, clock.monotonic_ns, _read
        )

    def _send(self, size_bytes: int) -> None:
        sample = _HEADER.pack(self._owner, self._number, self._clock.monotonic_ns(), 0)
        self._number += 1
        self._put(sample.ljust(size_bytes, b"\0"))

    def _answers(self) -> Iterator[tuple[int, int]]:
        while (entry := self._inbox.poll()) is not None:
            header, arrived_ns = entry
            if header is not None:
                owner, number, sent_ns, answer = header
                if answer and owner == self._owner:
                    yield number, arrived_ns - sent_ns

    def meet(self) -> bool:
        """Returns True if the far end answers in time."""
        clock = self._clock
        until_ns = clock.monotonic_ns() + CONNECT_NS
        while clock.monotonic_ns() < until_ns:
            self._send(_HEADER.size)
            clock.sleep_until(clock.monotonic_ns() + _RETRY_NS)
            if any(self._answers()):
                return True
        return False

    def measure(self, size_bytes: int, rate_hz: float, duration_s: float) -> Array:
        """Returns the round trips of samples sent at a rate, s; NaN for those that did not come
        back.
        """
        count = max(10, round(rate_hz * duration_s))
        clock = self._clock
        trips_s = np.full(count, np.nan)
        first = self._number

        def take() -> int:
            for number, trip_ns in self._answers():
                if number >= first:
                    trips_s[number - first] = trip_ns / 1e9
            return int(np.isnan(trips_s).sum())

        begun_ns = clock.monotonic_ns()
        for n in range(count):
            clock.sleep_until(begun_ns + round(n * 1e9 / rate_hz))
            self._send(size_bytes)
            if n % 1000 == 0:
                take()
        until_ns = clock.monotonic_ns() + _STRAGGLE_NS
        while take() and clock.monotonic_ns() < until_ns:
            clock.sleep_until(clock.monotonic_ns() + 5_000_000)
        return trips_s


def _open(
    endpoint: str, keys: MemberKeys | None, *, listens: bool, insecure: bool
) -> tuple[ZenohBus, str]:
    encrypted = endpoint.startswith(ENCRYPTED)
    if encrypted and keys is None:
        raise UsageError(
            f"{endpoint}: an encrypted endpoint takes keys: give --keys DIR of a site"
        )
    if encrypted and keys is not None and keys.member in (*ROLES, ROUTER):
        raise UsageError(
            f"--keys: a benchmark goes as samples go, so it takes a site's, not {keys.member}'s"
        )
    used = keys if encrypted else None
    at_end = Connection(listen=[endpoint]) if listens else Connection(connect=[endpoint])
    bus = secure_connection(at_end, used, insecure=insecure).open()
    return bus, used.member if used else FAR if listens else NEAR


def run_far_end(
    endpoints: Sequence[str],
    keys: str | Path | None,
    stopped: Callable[[], bool],
    duration_s: float = math.inf,
    *,
    insecure: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Answers benchmarks at endpoints until `stopped`, or for some time; says when it begins.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    known = None if keys is None else read_member_keys(keys)
    clock = SystemClock()
    begun_ns = clock.monotonic_ns()
    with ExitStack() as stack:
        for endpoint in endpoints:
            bus, member = _open(endpoint, known, listens=True, insecure=insecure)
            answer_benchmarks(stack.enter_context(closing(bus)), member)
        say(f"answers benchmarks at {', '.join(endpoints)}; Ctrl-C ends it")
        while not stopped() and clock.monotonic_ns() - begun_ns < duration_s * 1e9:
            clock.sleep_until(clock.monotonic_ns() + _RETRY_NS)


@contextmanager
def _own_far_end(duration_s: float) -> Iterator[tuple[list[str], Path]]:
    """Yields endpoints of a far end on this machine, of all transports, and the keys of the
    near one.
    """
    with tempfile.TemporaryDirectory() as folder:
        near, far = create_keys(Path(folder) / "keys", [NEAR, FAR], days=1)
        free = find_free_endpoints(len(PROTOCOLS))
        endpoints = [
            place.replace("tcp", kind) for kind, place in zip(PROTOCOLS, free, strict=True)
        ]
        words = [
            "ping",
            "--keys",
            str(far),
            "--seconds",
            str(math.ceil(duration_s + 2 * CONNECT_NS / 1e9)),
        ]
        words += [word for place in endpoints for word in ("--answer", place)]
        child = subprocess.Popen(
            [sys.executable, "-m", "trilat_net", *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield endpoints, near
        finally:
            child.terminate()
            child.wait()


class ScenarioNeeds(NamedTuple):
    """What a scenario asks of a network.

    Attributes:
        sample_bytes: of a sample of its largest arm.
        playout_ms: the least play-out of its links.
        held_ms: for how long every link holds its samples at least, by play-out or a constant
            delay.
        in_use_ms: the age of samples in use that its own links make; None if theory does not
            know.
        stable_ms: the common delays for which its loop is stable; None if theory does not know.
        words: that in words, or why theory does not know.
    """

    sample_bytes: int
    rate_hz: int
    playout_ms: float
    held_ms: float
    in_use_ms: float | None
    stable_ms: list[list[float]] | None
    words: str


def find_needs(scenario: Scenario) -> ScenarioNeeds:
    """Returns what a scenario asks of a network; takes as long as `trilat linear`."""
    links = list(scenario.links.values())
    shared = max(arm.counts.shared for arm in scenario.arms.values())
    vectors = {name: [0.5] * shared for name in ("q", "qd", "tau_x")}
    sample = PeerSample(
        v=VERSION,
        site=max(scenario.names, key=len),
        boot=2**63,
        tick=100_000,
        sent_ns=2**60,
        echo=[[n, 100_000, 2**60] for n in range(len(scenario.names) - 1)],
        **vectors,
    )
    held = [
        max(one.playout_ms, one.delay_ms if isinstance(one, ConstantDelay) else 0.0)
        for one in links
    ]
    rates = [site.rate_hz for site in scenario.sites.values()]
    instead = ["link.model=constant", "link.delay_ms=1"] if scenario.measured else []
    try:
        require_libraries("scipy")
        # SciPy: no need of a far end
        from trilat_net.theory.linear_analysis import (
            analyse_linear_loop,
        )

        found = analyse_linear_loop(load_scenario(scenario, instead))
    except (ScenarioError, RunFailed, UsageError) as error:
        theory: tuple[Any, ...] = (
            None,
            None,
            f"theory does not know its delay margin: {error}",
        )
    else:
        stable = [[1e3 * one.low_s, 1e3 * one.high_s] for one in found.margin.intervals]
        own = None if instead else 1e3 * float(found.conditions.age_s.max())
        theory = (own, stable, found.margin.description)
    playout_ms = min((one.playout_ms for one in links), default=0.0)
    return ScenarioNeeds(
        len(msgspec.msgpack.encode(sample)),
        max(rates),
        playout_ms,
        min(held, default=0.0),
        *theory,
    )


def judge_network(needs: ScenarioNeeds, row: Mapping[str, Any]) -> dict[str, Any]:
    """Judges if a network is good enough, by its row at the scenario's own size and rate.

    A sample is in use from its receiver's first tick after it came and was due (L2): the
    network counts with its p99, a play-out and the scenario's own delay hide what is shorter.
    """
    facts = {
        "transport": row["transport"],
        "good": False,
        "lost_share": row["lost"] / row["sent"],
    }
    times = row["one_way_us"]
    if times is None:
        nothing = dict.fromkeys(("p99_ms", "age_ms", "spare_ms", "playout_ms"))
        return {**facts, "hidden": False, **nothing}
    period_ms = 1e3 / needs.rate_hz
    p99_ms = times["p99"] / 1e3
    ticks = max(1, math.ceil(max(p99_ms, needs.held_ms) / period_ms - 1e-9))
    age_ms = max(period_ms * ticks, needs.in_use_ms or 0.0)
    hidden = p99_ms <= needs.held_ms
    within = [high for low, high in needs.stable_ms or [] if low <= age_ms <= high]
    bears = hidden if needs.stable_ms is None else bool(within)
    return {
        **facts,
        "good": bears and facts["lost_share"] <= MAX_LOST,
        "hidden": hidden,
        "p99_ms": p99_ms,
        "age_ms": age_ms,
        "spare_ms": within[0] - age_ms if within else None,
        "playout_ms": math.ceil(times["max"] / 1e3),
    }


@dataclass(frozen=True, repr=False)
class NetworkBenchmark(Result):
    """A network as it was measured, and whether it is good enough for a scenario, per
    transport.
    """

    scenario: str
    duration_s: float
    needs: ScenarioNeeds
    rows: list[dict[str, Any]]
    judged: list[dict[str, Any]]

    @property
    def good(self) -> bool:
        """True if it is good enough over every transport."""
        return all(one["good"] for one in self.judged)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat ping --benchmark --json`."""
        facts = {"scenario": self.scenario, "duration_s": self.duration_s, "good": self.good}
        return {
            **facts,
            "needs": self.needs._asdict(),
            "transports": self.judged,
            "rows": self.rows,
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per size, rate and transport; times in us."""
        flat = []
        for row in self.rows:
            times = row["one_way_us"] or dict.fromkeys(("p50", "p99", "max"))
            rest = {key: one for key, one in row.items() if key != "one_way_us"}
            flat.append({**rest, **{f"{name}_us": one for name, one in times.items()}})
        return flat


def ping_benchmark(
    scenario: str | Path | Mapping[str, Any] | Scenario,
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    duration_s: float = DEFAULT_S,
    connect: Sequence[str] | None = None,
    keys: str | Path | None = None,
) -> NetworkBenchmark:
    """Measures a network by size, rate and transport against a scenario; as `trilat ping
    --benchmark`.

    >>> found = tn.ping_benchmark("p_d_margin", duration_s=2)
    >>> [row["transport"] for row in found.to_dict()["transports"]]
    ['tcp', 'tls', 'quic']

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        set: overrides, as in `{"link.model": "measured"}`.
        duration_s: how long all cases take together, s.
        connect: endpoints at which `trilat ping --answer` runs; by default one on this machine,
            over TCP, TLS and QUIC.
        keys: folder of a site's keys, for encrypted endpoints.

    Raises:
        ScenarioError: the scenario is not valid.
        UsageError: an endpoint or the keys cannot be used.
        RunFailed: nobody answers at an endpoint.
    """
    chosen = load_scenario(scenario, set)
    needs = find_needs(chosen)
    with ExitStack() as stack:
        if not connect:
            connect, keys = stack.enter_context(_own_far_end(duration_s))
        known = None if keys is None else read_member_keys(keys)
        share_s = duration_s / (len(connect) * len(SIZES) * len(RATES))
        rows = [
            row for place in connect for row in _measure_endpoint(place, known, needs, share_s)
        ]
    own = [
        row
        for row in rows
        if (row["bytes"], row["rate_hz"]) == (needs.sample_bytes, needs.rate_hz)
    ]
    judged = [judge_network(needs, row) for row in own]
    return NetworkBenchmark(chosen.name, duration_s, needs, rows, judged)


def _measure_endpoint(
    endpoint: str, keys: MemberKeys | None, needs: ScenarioNeeds, share_s: float
) -> Iterator[dict[str, Any]]:
    bus, member = _open(endpoint, keys, listens=False, insecure=False)
    with closing(bus):
        near = NearEnd(bus, SystemClock(), member)
        if not near.meet():
            raise RunFailed(
                f"nobody answers at {endpoint} within {CONNECT_NS // 10**9} s: start there "
                f"trilat ping --answer {endpoint.partition('/')[0]}/0.0.0.0:{endpoint.rpartition(':')[2]}, "
                "over tls or quic with --keys of another site"
            )
        for times, part in product(SIZES, RATES):
            size_bytes = times * needs.sample_bytes
            rate_hz = part * needs.rate_hz
            trips_s = near.measure(size_bytes, rate_hz, share_s)
            came_us = trips_s[np.isfinite(trips_s)] / 2 * 1e6  # half a round trip
            p50, p99 = np.percentile(came_us, (50, 99)) if len(came_us) else (0.0, 0.0)
            most = {
                "p50": float(p50),
                "p99": float(p99),
                "max": float(came_us.max(initial=0.0)),
            }
            yield {
                "transport": endpoint.partition("/")[0],
                "bytes": size_bytes,
                "rate_hz": rate_hz,
                "sent": len(trips_s),
                "lost": int(np.isnan(trips_s).sum()),
                "one_way_us": most if len(came_us) else None,
            }

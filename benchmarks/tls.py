"""Measures the cost of TLS with keys for a sample between two processes on loopback, compared with plain TCP.

Both links are open all the time, and carry samples alternately for a tenth of a second, so that
other work on the machine affects both. The delay is measured from the stamp in the sample to
its arrival in the receiver's bus thread.
"""

import struct
import subprocess
import sys
import tempfile
import threading
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.net import topics
from trilat_net.net.clock import SystemClock
from trilat_net.net.member_keys import create_keys, read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus

RATE_HZ, ROUNDS, SAMPLES, SKIPPED, SAMPLE_BYTES = 1000, 200, 100, 10, 500
RATIO = 1.15
_STAMP = struct.Struct("<qq")
_KEY = topics.key("x", "m1", topics.SAMPLE)


def send(folder: str, *places: str) -> None:
    """Sends samples alternately over both links. This is the program of the other process."""
    clock = SystemClock()
    settings = [None, read_member_keys(Path(folder) / "m1").settings]
    with ExitStack() as stack:
        buses = [
            stack.enter_context(closing(ZenohBus([], [place], settings=own)))
            for place, own in zip(places, settings, strict=True)
        ]
        publish = [bus.publisher(_KEY) for bus in buses]
        # links and subscriptions exist by then
        clock.sleep_until(clock.monotonic_ns() + 2 * 10**9)
        due_ns = clock.monotonic_ns()
        for n in range(2 * ROUNDS * SAMPLES):
            due_ns += 10**9 // RATE_HZ
            clock.sleep_until(due_ns)
            put = publish[n // SAMPLES % 2]
            put(_STAMP.pack(n, clock.monotonic_ns()).ljust(SAMPLE_BYTES, b"\0"))
        clock.sleep_until(clock.monotonic_ns() + 10**9)


def measure_us() -> "list[np.ndarray[tuple[int, int], np.dtype[np.float64]]]":
    """Returns the delays of all samples over plain TCP and over TLS, in us, shape (ROUNDS, SAMPLES - SKIPPED)."""
    clock = SystemClock()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name) / "keys"
        create_keys(folder, ("m1", "s"), [], 1)
        plain, tls = find_free_endpoints(2)
        places = plain, tls.replace("tcp", "tls")
        arrivals: list[tuple[int, int]] = []
        taking = threading.Lock()

        def take(_: str, payload: bytes) -> None:
            now_ns = clock.monotonic_ns()
            number, sent_ns = _STAMP.unpack_from(payload)
            with taking:
                arrivals.append((number, now_ns - sent_ns))

        for place, own in zip(
            places, (None, read_member_keys(folder / "s").settings), strict=True
        ):
            stack.enter_context(closing(ZenohBus([place], settings=own))).tap(_KEY, take)
        program = "import sys; from benchmarks.tls import send; send(*sys.argv[1:])"
        subprocess.run([sys.executable, "-c", program, str(folder), *places], check=True)
    ways_us = np.full(2 * ROUNDS * SAMPLES, np.nan)
    for number, way_ns in arrivals:
        ways_us[number] = way_ns / 1e3
    turns = ways_us.reshape(ROUNDS, 2, SAMPLES)[:, :, SKIPPED:]
    return [turns[:, 0], turns[:, 1]]


def run() -> list[str]:
    plain, tls = measure_us()
    lost = int(np.isnan(plain).sum() + np.isnan(tls).sum())
    p50, p99 = ([float(np.nanpercentile(ways, q)) for ways in (plain, tls)] for q in (50, 99))
    ratios = np.nanmedian(tls, axis=1) / np.nanmedian(plain, axis=1)
    return [
        f"one way, {SAMPLE_BYTES} B at {RATE_HZ} Hz, {ROUNDS} turns of a tenth of a second each:",
        f"  plain p50 {p50[0]:.0f} us, p99 {p99[0]:.0f} us; with keys {p50[1]:.0f} us, {p99[1]:.0f} us",
        f"  TLS against plain, p50: {p50[1] / p50[0]:.3f} (bar: at most {RATIO}); by turns "
        f"{np.percentile(ratios, 10):.2f} to {np.percentile(ratios, 90):.2f}; {lost} lost",
    ]

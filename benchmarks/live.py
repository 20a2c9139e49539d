"""Measures how long the ticks of a live session of `paper` are busy, and how late they are, compared with cyclictest.

Five sessions run. Meanwhile, cyclictest (Debian: rt-tests) wakes up once a millisecond at the priority of the sites.
If it is not installed, a thread of this process does so, with the additional delay of Python.

A tick is busy from the wake-up of the loop until the loop sleeps again. The stamps of the
samples show whether the sites keep one grid: they tell how long after its tick, and the site's
turn in it, each sample was sent.
"""

import os
import re
import shutil
import subprocess
import threading
import time

import numpy as np

from trilat_net.log.log_reader import Log, open_log
from trilat_net.net.timing import find_turn_ns
from trilat_net.process import FIFO_PRIORITY

from .sessions import SITES, paper

RUNS = 5
DURATION_S = 20
PERIOD_NS = 1_000_000
BUSY_BAR_US, LATENESS_BAR, GRID_BAR_US = 45.0, 4.5, 200.0


def run() -> list[str]:
    waker = "cyclictest" if shutil.which("cyclictest") else "a sleeping thread of Python's"
    print(f"{RUNS} sessions of {DURATION_S} s, {waker} beside them")
    rows = []
    for _ in range(RUNS):
        log, beside_us = _run(waker)
        busy_us = np.concatenate([log[name].busy_us for name in SITES])
        late_us = np.concatenate([log[name].late_us for name in SITES])
        sent_us = [np.median(_sent_after_us(log, name)) for name in SITES]
        p50, (late_p50, late) = np.percentile(busy_us, 50), np.percentile(late_us, (50, 99))
        rows.append((p50, late_p50, late, beside_us, late / beside_us, np.ptp(sent_us)))
        by_site = ", ".join(
            f"{name} {at_us:.0f}" for name, at_us in zip(SITES, sent_us, strict=True)
        )
        print(
            f"  busy p50 {p50:.0f} us; late p50 {late_p50:.0f}, p99 {late:.0f}, beside {beside_us:.0f} us: "
            f"ratio {late / beside_us:.1f}; sent after their turns, p50: {by_site} us",
            flush=True,
        )
    busy, late_p50, late, beside_us, ratio, apart = np.median(rows, axis=0)
    return [
        f"  medians: busy p50 {busy:.0f} us (bar: <= {BUSY_BAR_US:g}); late p50 {late_p50:.0f}, "
        f"p99 {late:.0f} us, beside {beside_us:.0f}, ratio {ratio:.1f} (bar: <= {LATENESS_BAR:g}); "
        f"sites {apart:.0f} us apart on one grid (bar: <= {GRID_BAR_US:g})"
    ]


def _run(waker: str) -> tuple[Log, float]:
    """Runs one session; returns its complete log, and the p99 lateness of the program that woke up beside it, in us."""
    with paper(DURATION_S) as session:
        session.all()
        session.begun()
        priority = FIFO_PRIORITY * all(
            "SCHED_FIFO" in session.processes[name].text() for name in SITES
        )
        measure = cyclictest_us if waker == "cyclictest" else thread_us
        beside_us = measure(priority, DURATION_S - 2)
        session.codes()
        log = open_log(session.log)
        assert sum(len(log[name]) for name in SITES) == DURATION_S * 1000 * len(SITES)
    return log, beside_us


def _sent_after_us(log: Log, site: str) -> np.ndarray:
    """Returns the times from a site's turn in its ticks to the sending of its samples, by its clock, in us."""
    turn_ns = find_turn_ns(SITES.index(site), len(SITES), log[site].rate_hz)
    return np.array(
        [(state.sent_ns - state.t_ns - turn_ns) / 1000 for state in log[site].states]
    )


def cyclictest_us(priority: int, duration_s: int) -> float:
    """Returns the 99th percentile of cyclictest's latencies, in us."""
    every_ms = ["cyclictest", "-q", "-m", "-i", "1000", "-h", "10000", "-D", str(duration_s)]
    policy = ["-p", str(priority)] if priority else ["--policy=other"]
    text = subprocess.run(
        [*every_ms, *policy], capture_output=True, text=True, check=True
    ).stdout
    rows = np.array(
        [line.split()[:2] for line in text.splitlines() if re.match(r"\d{6} \d{6}", line)], int
    )
    counts = np.cumsum(rows[:, 1])
    return float(rows[np.searchsorted(counts, 0.99 * counts[-1]), 0])


def thread_us(priority: int, duration_s: int) -> float:
    """Returns the 99th percentile of the latencies of a thread that sleeps until each millisecond, in us."""
    late_ns: list[int] = []

    def wake() -> None:
        if priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        due_ns = time.monotonic_ns()
        for _ in range(duration_s * 1000):
            due_ns += PERIOD_NS
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            late_ns.append(time.monotonic_ns() - due_ns)

    thread = threading.Thread(target=wake)
    thread.start()
    thread.join()
    return float(np.percentile(late_ns, 99)) / 1000

"""Runs three sites and a recorder for ten minutes, and measures missing records, memory and processor time."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from trilat_net.log.log_reader import open_log

from .sessions import SITES, paper
from .stopwatch import cpu_s

DURATION_S = 600
WARM_S = 30.0


def run() -> list[str]:
    with paper(DURATION_S) as session:
        session.all()
        session.begun()
        samples = np.array(
            list(_samples({name: p.pid for name, p in session.processes.items()}))
        )
        for process in session.processes.values():
            process.code()
        log = open_log(session.log)
        have = sum(len(log[name]) for name in SITES)
        told = [f"  {name}: {log.account(name)}" for name in SITES]
        size_mb = session.log.stat().st_size / 1e6
    want = DURATION_S * 1000 * len(SITES)
    return [
        f"{DURATION_S} s of three sites at 1 kHz: {have}/{want} records, {size_mb:.0f} MB",
        *told,
        *(
            _line(name, samples[:, 0], samples[:, 1 + 2 * n :])
            for n, name in enumerate(session.processes)
        ),
    ]


def _samples(pids: dict[str, int]) -> Iterator[list[float]]:
    """Yields, once a second, the time in s, and for every process its memory in MiB and its processor time so far in s."""
    begun = time.monotonic()
    while (t_s := time.monotonic() - begun) < DURATION_S - 2.0:
        yield [
            t_s,
            *(figure for pid in pids.values() for figure in (_held_mib(pid), cpu_s(pid))),
        ]
        time.sleep(1.0)


def _held_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _line(name: str, t_s: np.ndarray, columns: np.ndarray) -> str:
    warm = t_s >= WARM_S
    held_mib, taken_s = columns[warm, 0], columns[warm, 1]
    slope = np.polyfit(t_s[warm], held_mib, 1)[0] * 60.0
    share = (taken_s[-1] - taken_s[0]) / (t_s[warm][-1] - t_s[warm][0])
    return (
        f"  {name}: holds {held_mib[0]:.0f} MiB after {WARM_S:g} s, {held_mib[-1]:.0f} MiB at the end, "
        f"line fit {slope:+.3f} MiB/min (bar: < 1); takes {100 * share:.1f} % of a core"
        + (" (bar: <= 35)" if name == "recorder" else "")
    )

"""Measures the durations of single calls, and the processor time of a process."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

CALLS = 20_000


def each_us(call: Callable[[], object], calls: int = CALLS) -> np.ndarray:
    """Returns the duration of each call without the cost of the clock, in us, shape (calls,)."""
    clock = time.perf_counter_ns
    times = np.empty(calls)
    for n in range(calls):
        begun = clock()
        call()
        times[n] = clock() - begun
    empty = np.empty(calls)
    for n in range(calls):
        begun = clock()
        empty[n] = clock() - begun
    return np.maximum(times - np.median(empty), 0.0) / 1000.0


def best_s(call: Callable[[], object], rounds: int = 5) -> float:
    """Returns the shortest duration of a call in several rounds, in s."""
    clock = time.perf_counter
    times = []
    for _ in range(rounds):
        begun = clock()
        call()
        times.append(clock() - begun)
    return min(times)


def cpu_s(pid: int) -> float:
    """Returns the processor time of one process without its children, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

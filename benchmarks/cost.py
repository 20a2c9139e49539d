"""Measures the processor time of a live session up to its first tick, and then by process and thread.

The second session has a page and a bridge to ROS 2. Processor time is user and system time,
which other programs on the machine influence less than latencies. If the environment variable
`TRILAT_BEFORE` names the folder of another version of the program, sessions of `trilat demo`
alternate between the two versions. Their processor times of sites and recorder are compared,
and the lateness of their loops relative to cyclictest.
"""

import os
import re
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from unittest import mock

import numpy as np

from tests.live.processes import PLAIN, Process, Stage, list_descendants
from tests.net.free_endpoints import find_free_endpoints
from tests.net.waiting import until
from trilat_net.log.log_reader import open_log
from trilat_net.process import FIFO_PRIORITY

from .live import cyclictest_us, thread_us
from .page import SocketClient, live_session
from .sessions import SITES
from .stopwatch import cpu_s

DURATION_S, WINDOW_S, PAIRS, STARTS = 20, 14, 7, 5
AHEAD_S = 0.5
"""Time between the announcement of a session and its first tick."""
COST_RATIO, LATENESS_RATIO, START_S = 0.6, 3.0, 3.0
PROCESSES = "run/processes"
"""Folder of the output of a session's processes, relative to the folder in which the session runs."""
MS_PER_TICK = 1000.0 / os.sysconf("SC_CLK_TCK")

Usage = Counter[str]
"""Processor time by thread without its number, in ms; and voluntary context switches, by `<thread> switches`."""


def run() -> list[str]:
    starts = np.array([_measure_start() for _ in range(STARTS)])
    begun = (
        f"`trilat demo` to its first tick, medians of {STARTS}: {np.median(starts[:, 0]):.2f} s of processor "
        f"time (bar: <= {START_S:g}), {np.median(starts[:, 1]):.2f} s of the clock"
    )
    print("a session of play with a page and a bridge, ms of processor time a second:")
    with tempfile.TemporaryDirectory() as folder, _with_bridge(Path(folder)) as pids:
        _show(_watch(pids, lambda: time.sleep(WINDOW_S)))
    here, before = str(Path(__file__).parents[1]), os.environ.get("TRILAT_BEFORE", "")
    if not before:
        return [begun, "name another version in TRILAT_BEFORE to compare with it"]
    pairs = np.array([[_measure_paper(root) for root in (before, here)] for _ in range(PAIRS)])
    ratios = pairs[:, 1] / pairs[:, 0]
    (then_ms, then_late), (now_ms, now_late) = np.median(pairs, axis=0)
    return [
        begun,
        f"a site and its share of the recorder, medians of {PAIRS} pairs: {then_ms:.0f} ms a second before, "
        f"{now_ms:.0f} now: {np.median(ratios[:, 0]):.2f} of it (bar: <= {COST_RATIO:g})",
        f"lateness p99 over that beside it: {then_late:.1f} before, {now_late:.1f} now "
        f"(bar: <= {LATENESS_RATIO:g}); better in {np.sum(ratios[:, 1] < 1.0)} of {PAIRS} pairs",
    ]


def _measure_start() -> tuple[float, float]:
    """Returns the processor time and the wall-clock time until the first tick of `trilat demo paper`, in s."""
    since = time.perf_counter()
    with _demo() as demo:
        time.sleep(AHEAD_S)
        wall_s = time.perf_counter() - since
        spent_s = sum(map(cpu_s, (demo.pid, *demo.children())))
    return spent_s, wall_s


def _measure_paper(root: str) -> tuple[float, float]:
    """Runs `trilat demo paper` with the program in a folder.

    Returns the processor time of a site and of its share of the recorder, ms per second; and
    the worst site's p99 of lateness, divided by that of the program that woke up beside it at
    the same priority.
    """
    with mock.patch.dict(PLAIN, PYTHONPATH=root), _demo() as demo:
        time.sleep(AHEAD_S)
        printed = "".join(
            (demo.folder / PROCESSES / f"{name}.txt").read_text() for name in SITES
        )
        priority = FIFO_PRIORITY * (printed.count("SCHED_FIFO") == len(SITES))
        measure = cyclictest_us if shutil.which("cyclictest") else thread_us
        beside_us: list[float] = []
        usage = _watch(
            _find_members(demo.pid), lambda: beside_us.append(measure(priority, WINDOW_S))
        )
        demo.signal(signal.SIGINT)
        assert demo.code() == 128 + signal.SIGINT
        log = open_log(demo.folder / "run" / "run.mcap")
        assert log.complete
        assert all(len(log[name]) == log[name].last_tick + 1 for name in SITES)
        late_us = max(float(np.percentile(log[name].late_us, 99)) for name in SITES)
    cost_ms = sum(map(_total, usage.values())) / len(SITES)
    print(
        f"  {root}: {cost_ms:.0f} ms; late p99 {late_us:.0f} us, beside {beside_us[0]:.0f} us",
        flush=True,
    )
    return cost_ms, late_us / beside_us[0]


@contextmanager
def _demo() -> Iterator[Process]:
    """Yields a session of `paper` on this machine that has just been announced, and ends it afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        demo = Stage(Path(folder)).start(
            "demo", "demo", "paper", "--duration", str(DURATION_S), "--out", "run"
        )
        printed = [demo.folder / PROCESSES / f"{name}.txt" for name in SITES]
        try:
            until(
                lambda: all(
                    file.exists() and "the session begins" in file.read_text()
                    for file in printed
                )
            )
            yield demo
        finally:
            demo.end()


@contextmanager
def _with_bridge(folder: Path) -> Iterator[dict[str, int]]:
    """Runs a session of `play` with a watched page and a bridge to ROS 2, and yields the ids of its processes."""
    (router,) = find_free_endpoints(1)
    stage = Stage(folder)
    with live_session(folder / "run") as (address, page), closing(SocketClient(address).socket):
        try:
            stage.start("router", "router", "--listen", router)
            bridge = stage.start("bridge", "ros2", "--ros", router, "--session", "play")
            bridge.prints("is in the graph of ROS 2")
            yield {**_find_members(page), "page": page, "bridge": bridge.pid}
        finally:
            stage.clear()


def _find_members(pid: int) -> dict[str, int]:
    """Returns the sites and the recorder among the descendants of a process, by name."""
    members = {}
    for child, line in list_descendants(pid):
        words = line.split()
        if named := {"site", "record"} & set(words):
            members[words[words.index("site") + 1] if "site" in named else "recorder"] = child
    return members


def _total(usage: Usage) -> float:
    return sum(spent for thread, spent in usage.items() if not thread.endswith("switches"))


def _show(usage: Mapping[str, Usage]) -> None:
    for name, threads in usage.items():
        parts = ", ".join(
            f"{thread} {spent:.0f} ({threads[f'{thread} switches']:.0f} switches)"
            for thread, spent in threads.most_common()
            if not thread.endswith("switches") and spent >= 1.0
        )
        print(f"  {name}: {_total(threads):.0f}: {parts}", flush=True)


def _watch(pids: Mapping[str, int], meanwhile: Callable[[], object]) -> dict[str, Usage]:
    """Returns the use of processors by the threads of processes during a call, per second."""
    begun, before = time.monotonic(), {name: _read_threads(pid) for name, pid in pids.items()}
    meanwhile()
    passed_s = time.monotonic() - begun
    usage = {name: Usage() for name in pids}
    for name, pid in pids.items():
        for task, (thread, *spent) in _read_threads(pid).items():
            earlier = before[name].get(task, (thread, 0.0, 0.0))[1:]
            for key, now, then in zip(
                (thread, f"{thread} switches"), spent, earlier, strict=True
            ):
                usage[name][key] += (now - then) / passed_s  # type: ignore[assignment]
    return usage


def _read_threads(pid: int) -> dict[int, tuple[str, float, float]]:
    """Returns a process's threads: name, processor time so far in ms, and number of voluntary context switches."""
    threads = {}
    for folder in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # the thread has just ended
            fields = (folder / "stat").read_text("ascii").rpartition(")")[2].split()
            comm = re.sub(r"-?\d+$", "", (folder / "comm").read_text("utf-8").strip())
            status = (folder / "status").read_text("utf-8")
            switches = float(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])
            name = "main" if int(folder.name) == pid else comm
            threads[int(folder.name)] = (
                name,
                (int(fields[11]) + int(fields[12])) * MS_PER_TICK,
                switches,
            )
    return threads

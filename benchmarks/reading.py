"""Measures the time and memory to open a minute of three sites at 1 kHz, compared with the `mcap` package."""

import subprocess
import sys
import tempfile
from pathlib import Path

from mcap.reader import make_reader

from trilat_net.execution import virtual
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import load_scenario

from .stopwatch import best_s

SECONDS = 60
_ALONE = """
import sys
from trilat_net.log.log_reader import open_log
def resident_kib():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
before = resident_kib()
log = open_log(sys.argv[1])
log["m1"].q
print(resident_kib() - before)
"""


def run() -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with path.open("wb") as stream:
            virtual.write_virtual_log(load_scenario("paper", {"duration_s": SECONDS}), stream)
        return measured(path)


def measured(path: Path) -> list[str]:
    """Returns the results for a log of three sites m1, m2 and s.

    Args:
        path: Path of the log.
    """
    log = open_log(path)
    records = sum(len(log[name]) for name in log.sites)
    one = best_s(lambda: open_log(path)["m1"].q, 3)
    opening = best_s(lambda: open_log(path), 3)
    plain = best_s(lambda: iterated(path), 1)
    table = best_s(lambda: open_log(path).table("m1"), 1)
    arrays = best_s(lambda: every_array(open_log(path)), 1)
    whole = best_s(lambda: [open_log(path)[name].states for name in log.sites], 1)
    process = best_s(lambda: alone(path), 3)
    kib = alone(path)
    return [
        f"open_log and one joint, {records} records: {one:.2f} s, best of 3 (bar: <= 1.5)",
        f"  of it opening: {opening:.2f} s; {1e6 * opening / records:.1f} us a record",
        f"  the mcap package iterates over the same file in {plain:.2f} s: {plain / one:.1f} times as long",
        f"  as a process of its own, Python and all: {process:.2f} s",
        f"  memory: {kib / 1024:.0f} MiB, {1024 * kib / records:.0f} bytes a record",
        f"every column of one site as a table: {table:.2f} s with opening",
        f"every array of every site: {arrays:.2f} s with opening",
        f"every record decoded, which verify needs: {whole:.2f} s with opening",
    ]


def every_array(log: Log) -> None:
    for name in log.sites:
        part = log[name]
        _ = (
            part.t_s,
            part.q,
            part.qd,
            part.q_des,
            part.qd_des,
            part.tau,
            part.tau_x,
            part.theta_hat,
            part.used,
        )


def iterated(path: Path) -> None:
    """Reads every message with the `mcap` package, in file order, without decoding."""
    with path.open("rb") as stream:
        for _ in make_reader(stream).iter_messages(log_time_order=False):
            pass


def alone(path: Path) -> int:
    """Returns the largest growth, in KiB, of a process that opens a log and reads one joint."""
    done = subprocess.run(
        [sys.executable, "-c", _ALONE, path], capture_output=True, text=True, check=True
    )
    return int(done.stdout)

"""Measures the cost of analysing a minute of three sites at 1 kHz: metrics, certificate and report, on one core.

A separate process, pinned to one core, executes all parts one after the other, without any
preparation. Times are processor times. The report consists of figures, page and summary. The
simulations that `trilat report` executes on a second core, and the twin without hands, are
reported separately.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from trilat_net.execution import virtual
from trilat_net.scenario import load_scenario

from .sessions import paper

SECONDS = 60
VIRTUAL = ("windup", "jitter")
"""Scenarios that are analysed in addition to `paper`, which is recorded live."""
BAR_S = 10.0
_ALONE = """
import os, sys, time
from pathlib import Path
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
last = 0.0
def lap(what):
    global last
    now = time.process_time()
    print(f"{what}={now - last:.3f}")
    last = now
from trilat_net.analysis import LogMetrics
from trilat_net.presentation.page import write_report
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net import open_log, verify
from trilat_net.execution.virtual import SimulatedLog
lap("start")
log = open_log(sys.argv[1])
lap("opening")
LogMetrics.of_log(log).to_dict()
lap("metrics")
Certificate.of_log(log)
lap("certificate")
write_report(log, Path(sys.argv[2]), certificate=Certificate.of_log(log))
lap("report")
SimulatedLog.without_operators(log)
lap("twin")
verify(log)
lap("verify")
"""


def run() -> list[str]:
    with paper(SECONDS) as session:
        session.all()
        for process in session.processes.values():
            process.code(SECONDS + 60.0)
        lines = measured("paper, live", session.log, session.log.parent / "report")
    for name in VIRTUAL:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.mcap"
            with path.open("wb") as stream:
                virtual.write_virtual_log(load_scenario(name, {"duration_s": SECONDS}), stream)
            lines += measured(name, path, Path(folder))
    return lines


def measured(name: str, path: Path, folder: Path) -> list[str]:
    """Returns lines with the cost of each part of a log's analysis.

    Args:
        name: Name of the log in the lines.
        path: Path of the log.
        folder: Folder of the report.
    """
    command = [sys.executable, "-c", _ALONE, path, folder]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
    cost = {
        what: float(value) for what, value in (line.split("=") for line in done.stdout.split())
    }
    apart = {what: cost.pop(what) for what in ("twin", "verify")}
    shares = ", ".join(f"{what} {value:.1f}" for what, value in cost.items())
    executed = ", ".join(f"{what} {value:.1f}" for what, value in apart.items())
    return [
        f"{name}, {SECONDS} s: {sum(cost.values()):.1f} s on one core (bar: <= {BAR_S:g}): {shares}",
        f"  executed beside it: {executed} s",
    ]

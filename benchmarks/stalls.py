"""Stops a recorder for three seconds, and checks that the log is complete and that the sites are not affected.

Runs with and without the stall alternate, so that changes of the machine affect both.
"""

import signal
import time

import numpy as np

from trilat_net.log.log_reader import Log, open_log

from .sessions import SITES, paper

PAIRS = 5
DURATION_S = 15
STALL_S = 3.0


def run() -> list[str]:
    print(
        f"{PAIRS} pairs of runs of {DURATION_S} s, in one of each the recorder stands still for {STALL_S:g} s"
    )
    ratios = []
    for pair in range(PAIRS):
        orders = (True, False) if pair % 2 else (False, True)
        busy = {stalled: _busy_p99_us(_run(stalled)) for stalled in orders}
        ratios.append(busy[True] / busy[False])
        shown = ", ".join(
            f"{a:.0f}/{b:.0f}" for a, b in zip(busy[True], busy[False], strict=True)
        )
        print(f"  p99 of the sites' computing times with/without, us: {shown}", flush=True)
    return [f"  median ratio {np.median(ratios):.3f} (bar: <= 1.2)"]


def _run(stalled: bool) -> Log:
    """Returns the log of one run, in which no record may be missing."""
    with paper(DURATION_S) as session:
        session.all()
        session.begun()
        if stalled:
            time.sleep(3.0)
            session.processes["recorder"].signal(signal.SIGSTOP)
            time.sleep(STALL_S)
            session.processes["recorder"].signal(signal.SIGCONT)
        session.codes()
        log = open_log(session.log)
        have = sum(len(log[name]) for name in SITES)
        refilled = [log.account(name) for name in SITES] if stalled else []
    assert have == DURATION_S * 1000 * len(SITES), [log.account(name) for name in SITES]
    for text in refilled:
        print(f"    {text}")
    return log


def _busy_p99_us(log: Log) -> np.ndarray:
    return np.array([np.percentile(log[name].busy_us, 99) for name in SITES])

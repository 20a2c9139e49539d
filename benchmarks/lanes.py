"""Runs side by side in lanes against the same runs one after the other: ratio of processor times, interleaved."""

import statistics
import time
from collections.abc import Callable

import numpy as np

from trilat_net.execution.fused import FusedRun
from trilat_net.execution.lanes import LANES
from trilat_net.execution.lanes.lane_run import LaneRun
from trilat_net.scenario import Scenario, load_scenario

CASES = (
    ("free", "control.Kd", 2.0, 3.0),
    ("paper", "control.Kd", 2.0, 3.0),
    ("jitter", "link.half_width_ms", 10.0, 40.0),
)
ROUNDS = 5


def run() -> list[str]:
    lines = [f"{LANES} runs of 20 s side by side, on one core, compared with one run alone:"]
    for name, key, low, high in CASES:
        cells = [
            load_scenario(name, {"duration_s": 20.0, key: float(number)})
            for number in np.linspace(low, high, LANES)
        ]
        lines.append(_compare(name, cells))
    return lines


def _compare(name: str, cells: list[Scenario]) -> str:
    """Times the runs of one scenario both ways, in turn."""
    LaneRun([FusedRun(cell) for cell in cells]).advance_to(0.1)  # compiles
    site_ticks = sum(spec.rate_hz for spec in cells[0].sites.values()) * cells[0].duration_s
    pairs = []
    for n in range(ROUNDS):
        runs = [FusedRun(cell) for cell in cells]
        lanes_s = _processor_s(lambda runs=runs: LaneRun(runs).advance_to(20.0))
        alone = FusedRun(cells[n])
        alone_s = _processor_s(lambda alone=alone: alone.advance_to(20.0))
        pairs.append((lanes_s / LANES, alone_s))
    ratio = statistics.median(alone_s / lane_s for lane_s, alone_s in pairs)
    lane_ns, alone_ns = (1e9 * min(times) / site_ticks for times in zip(*pairs, strict=True))
    return (
        f"  {name}: {lane_ns:.0f} ns a site tick, alone {alone_ns:.0f} ns; "
        f"{ratio:.1f} times as fast (median of {ROUNDS})"
    )


def _processor_s(call: Callable[[], object]) -> float:
    """Returns the processor time of a call, s."""
    begun = time.process_time()
    call()
    return time.process_time() - begun

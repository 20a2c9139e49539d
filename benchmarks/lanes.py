"""Compares the processor times of runs side by side in lanes and of the same runs one after the other, in turn."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

import trilat_net as tn
from trilat_net.analysis.twins import twin_runs as twins
from trilat_net.core.lanes import twin_lanes
from trilat_net.core.lanes.lane_rows import LANES
from trilat_net.core.lanes.lane_run import LaneRun
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario


class Case(NamedTuple):
    """Runs of one structure: a scenario with settings, and a key that differs from run to run."""

    label: str
    name: str
    settings: Mapping[str, Any]
    key: str
    least: float
    largest: float


WALL = [{"kind": "wall", "point_m": [1.8, 0.0], "normal": [-1.0, 0.0], "stiffness_n_m": 500.0}]
LOSSY = {"link.loss": 0.1, "sites.s.environment": WALL}
TDPA = {"control.law": "tdpa", "scheme": "digital", "control.B": 5.0}
WAVE = {"control.law": "wave", "scheme": "digital"}
GLIDE = {f"sites.{site}.on_stale": {"action": "glide"} for site in ("m1", "m2", "s")}
SHORT = {"duration_s": 4.0}
POSES = {**SHORT, "task.space": "pose"}
CASES = (
    Case("free", "free", {}, "control.Kd", 2.0, 3.0),
    Case("paper", "paper", {}, "control.Kd", 2.0, 3.0),
    Case("jitter", "jitter", {}, "link.half_width_ms", 10.0, 40.0),
    Case("P+d, jitter, loss and a wall", "jitter", LOSSY, "link.half_width_ms", 10.0, 40.0),
    Case("4g", "4g", {}, "control.Kd", 2.0, 3.0),
    Case("tdpa", "free", TDPA, "control.K", 15.0, 22.0),
    Case("six_joints", "six_joints", SHORT, "control.Kd", 2.0, 3.0),
    Case("wave", "free", WAVE, "control.b", 9.0, 11.0),
    Case("a site at 500 Hz", "free", {"sites.s.rate_hz": 500}, "control.Kd", 2.0, 3.0),
    Case("glide", "free", GLIDE, "control.Kd", 2.0, 3.0),
    Case("play", "play", {}, "control.Kd", 2.0, 3.0),
    Case("unlike_arms, positions", "unlike_arms", SHORT, "control.Kd", 9.0, 11.0),
    Case("unlike_arms, poses", "unlike_arms", POSES, "control.Kd", 9.0, 11.0),
    Case("six_joints, wave", "six_joints", {**SHORT, **WAVE}, "control.b", 9.0, 11.0),
)
WIDTHS = (8, 16, LANES)
ROUNDS = 5


def run() -> list[str]:
    lines = [f"{LANES} runs side by side, on one core, compared with one run alone:"]
    lines += [_compare(case, LANES) for case in CASES]
    lines.append("free, by the number of runs:")
    lines += [_compare(CASES[0]._replace(label=f"{width} runs"), width) for width in WIDTHS]
    lines.append(
        "a log of 20 s of paper, and its twins with one push for each joint and two more:"
    )
    lines += [*_compare_twins()]
    return lines


def _compare(case: Case, width: int) -> str:
    """Measures the runs of one scenario alternately with both methods."""
    cells = [
        load_scenario(case.name, {"duration_s": 20.0, **case.settings, case.key: float(number)})
        for number in np.linspace(case.least, case.largest, width)
    ]
    LaneRun([FusedRun(cell) for cell in cells]).advance_to(0.1)  # compiles
    duration_s = cells[0].duration_s
    site_ticks = sum(spec.rate_hz for spec in cells[0].sites.values()) * duration_s
    pairs = []
    for n in range(ROUNDS):
        runs = [FusedRun(cell) for cell in cells]
        lanes_s = _processor_s(lambda runs=runs: LaneRun(runs).advance_to(duration_s))
        alone = FusedRun(cells[n])
        alone_s = _processor_s(lambda alone=alone: alone.advance_to(duration_s))
        pairs.append((lanes_s / width, alone_s))
    ratio = statistics.median(alone_s / lane_s for lane_s, alone_s in pairs)
    lane_ns, alone_ns = (1e9 * min(times) / site_ticks for times in zip(*pairs, strict=True))
    return (
        f"  {case.label}: {lane_ns:.0f} ns a site tick, alone {alone_ns:.0f} ns; "
        f"{ratio:.1f} times as fast (median of {ROUNDS})"
    )


def _compare_twins() -> list[str]:
    """Measures the twins of a certificate, and the certificate, alternately with both methods."""
    log = tn.simulate("paper", duration_s=20)
    pushes = twins.Push.choose(log.scenario)
    least_runs = twin_lanes.LEAST_RUNS
    least_site_ticks = twins.LANE_SITE_TICKS
    works: dict[str, Callable[[], object]] = {
        "the twins": lambda: twins.Twins.of_log(log, pushes),
        "certify": lambda: tn.certify(log),
    }
    times_s: dict[tuple[str, bool], list[float]] = {}
    try:
        twins.LANE_SITE_TICKS = 0
        for _ in range(ROUNDS + 1):
            for in_lanes in (True, False):
                twin_lanes.LEAST_RUNS = least_runs if in_lanes else LANES + 1
                for label, work in works.items():
                    times_s.setdefault((label, in_lanes), []).append(_processor_s(work))
    finally:
        twin_lanes.LEAST_RUNS = least_runs
        twins.LANE_SITE_TICKS = least_site_ticks
    lines = []
    for label in works:
        # The first round compiles.
        lanes_s, alone_s = (
            statistics.median(times_s[label, in_lanes][1:]) for in_lanes in (True, False)
        )
        lines.append(
            f"  {label}: {lanes_s:.3f} s of processor time, one by one {alone_s:.3f} s; "
            f"{lanes_s / alone_s:.2f} of it (median of {ROUNDS})"
        )
    return lines


def _processor_s(call: Callable[[], object]) -> float:
    """Returns the processor time of a call, in s."""
    begun = time.process_time()
    call()
    return time.process_time() - begun

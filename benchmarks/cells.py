"""Measures the processor time of complete cells of a sweep, and of their parts: simulation and judgement."""

import statistics
import time

from trilat_studies.sweep.sweep_cell import classify_cell, classify_cells
from trilat_studies.sweep.sweep_plan import plan_sweep

import trilat_net as tn
from trilat_net.analysis import SETTLED_ERROR_RAD, VirtualRun
from trilat_net.core.lanes.run_groups import RunGroup
from trilat_net.execution.fused import FusedRun

CELLS = 64
DURATION_S = 20.0
LONGEST_S = 160.0
OVER = ("control.Kd=1:4:0.2", "control.Lambda=1.5:4.5:1")
ROUNDS = 3


def run() -> list[str]:
    plan = plan_sweep("free", [f"duration_s={DURATION_S:g}"], over=OVER)
    scenarios = [plan.scenario(*plan.cell(number).overrides) for number in range(plan.cells)]
    texts = [scenario.text for scenario in scenarios]
    assert len(texts) == CELLS
    list(classify_cells(scenarios, DURATION_S))  # compiles
    times_s: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        begun = time.process_time()
        together = [cell.result for cell in classify_cells(scenarios, LONGEST_S)]
        times_s.setdefault("together", []).append(time.process_time() - begun)
        begun = time.process_time()
        alone = [classify_cell(text, LONGEST_S) for text in texts]
        times_s.setdefault("alone", []).append(time.process_time() - begun)
        assert together == alone

        begun = time.process_time()
        runs = [FusedRun(scenario, SETTLED_ERROR_RAD) for scenario in scenarios]
        for group in RunGroup.divide(runs):
            group.advance_to(DURATION_S)
        times_s.setdefault("simulation", []).append(time.process_time() - begun)
        begun = time.process_time()
        decisions = [
            VirtualRun(scenario, finished).decision
            for scenario, finished in zip(scenarios, runs, strict=True)
        ]
        times_s.setdefault("judgement", []).append(time.process_time() - begun)
        assert len(decisions) == CELLS
    ms = {name: 1e3 * statistics.median(values) / CELLS for name, values in times_s.items()}
    return [
        f"{CELLS} cells of {DURATION_S:g} s of free, simulated and judged, processor time per cell:",
        f"  side by side {ms['together']:.1f} ms, one by one {ms['alone']:.1f} ms",
        f"  of it {ms['simulation']:.1f} ms simulation side by side, and {ms['judgement']:.1f} ms judgement",
        f"  (median of {ROUNDS}, trilat-net {tn.__version__})",
    ]

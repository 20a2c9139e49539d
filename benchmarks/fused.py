"""Compares the speed of the fused kernel, the per-tick driver and SciPy in one scenario; then runs many on all cores.

SciPy solves the same delay-differential equations with DOP853 and the method of steps. This
code was written for the tests from the paper alone. Its right-hand side computes all sites at
once with NumPy.
"""

import dataclasses
import time

import numpy as np
from trilat_studies.gym_environment import make_env
from trilat_studies.sweep.sweep_cell import classify_cell

from tests.theory.delay_equations import make_equations
from trilat_net.errors import ScenarioError
from trilat_net.execution import virtual
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.laws import LAWS
from trilat_net.workers import count_cores, worker_pool

from .stopwatch import best_s

CELLS = 400
"""Number of cells, enough for some seconds on every core."""
ASKED = 10_000


def run() -> list[str]:
    scenario = load_scenario("free", {"duration_s": 20.0})
    real_s = scenario.duration_s
    lines, whole, fused_s = _both_drivers(scenario, 40)
    for tolerance in (1e-5, 1e-11):
        problem = dataclasses.replace(
            make_equations(scenario), tolerance=tolerance, starts=[], pieces=[]
        )
        begun = time.perf_counter()
        states = problem.solve(real_s).at(np.array([real_s - 1e-3]))
        scipy_s = time.perf_counter() - begun
        apart = np.abs(states[:, 0, :2] - whole.records[:, :2]).max()
        lines.append(
            f"  SciPy DOP853, rtol {tolerance:g}: {real_s / scipy_s:.1f} x real time; fused is "
            f"{scipy_s / fused_s:.0f} times as fast; last poses {apart:.1e} rad apart"
        )
    for name in ("six_joints", "seven_joints"):
        lines += _both_drivers(load_scenario(name, {"duration_s": 2.0}), 5)[0]
    return [
        *lines,
        *_in_environment(),
        *_with_plugged_laws(real_s, fused_s),
        *_on_all_cores(real_s),
    ]


def _in_environment() -> list[str]:
    """Measures `paper` with users in Python, as in a training environment, and with its compiled users."""
    env = make_env("paper", user="m2", duration_s=1e3)
    env.reset(seed=1)
    steps, action = 500, 0.2 * env.action_space.high

    def act() -> None:
        for _ in range(steps):
            env.step(action)

    act()
    python = steps / 50 / best_s(act, 10)
    scenario = load_scenario("paper", {"duration_s": 20.0})
    compiled = 20.0 / best_s(lambda: FusedRun(scenario).advance_to(20.0), 10)
    return [
        f"an environment of paper, 50 steps/s, its user in Python: {python:.0f} x real time (bar: >= 25)",
        f"  the same experiment, its users compiled: {compiled:.0f} x real time (bar: >= 150)",
    ]


def _with_plugged_laws(real_s: float, adaptive_s: float) -> list[str]:
    """Measures plugged-in laws: a law that reads every available input, an example, and the built-in laws."""
    built_in = [name for name, kind in LAWS.items() if hasattr(kind.kind, "torque")]
    lines = ["laws that are plugged in, by their names, in one run:"]
    for law in ("tests.plugged_laws:CompiledLine", "examples.reaction_law:Reaction", *built_in):
        scenario = load_scenario(
            "free", {"duration_s": real_s, "scheme": "digital", "control.law": law}
        )

        def run_it(scenario: Scenario = scenario) -> None:
            FusedRun(scenario).advance_to(real_s)

        try:
            run_it()
        except ScenarioError as error:  # it is not for three sites, or not for joints
            lines.append(f"  {law}: {error.problem}")
            continue
        lines.append(
            f"  {law}: {adaptive_s / best_s(run_it, 10):.2f} of the speed of adaptive (bar: >= 0.4)"
        )
    return lines


def _both_drivers(scenario: Scenario, runs: int) -> tuple[list[str], FusedRun, float]:
    """Returns lines about both drivers, the fused run of a scenario, and the shortest time of several runs."""
    real_s = scenario.duration_s

    def fused() -> FusedRun:
        whole = FusedRun(scenario)
        whole.advance_to(real_s)
        return whole

    def per_tick() -> np.ndarray:
        last = {s.site.name: s.output.q for s in virtual.execute_virtual(scenario)}
        return np.array([last[name] for name in scenario.names])

    fused_s = best_s(fused, runs)
    per_tick_s = best_s(per_tick, 3)
    whole, poses = fused(), per_tick()
    same = np.array_equal(whole.records[:, : poses.shape[1]], poses)
    lines = [
        f"{scenario.name}, {real_s:g} s, three sites at 1 kHz, on one core; best of some runs:",
        f"  fused kernel: {real_s / fused_s:.0f} x real time, "
        f"{1e9 * fused_s / (3e3 * real_s):.0f} ns a site tick",
        f"  per-tick driver, no log: {real_s / per_tick_s:.1f} x real time; "
        f"fused is {per_tick_s / fused_s:.0f} times as fast; "
        f"last poses equal bit for bit: {'yes' if same else 'NO'}",
    ]
    return lines, whole, fused_s


def _on_all_cores(real_s: float) -> list[str]:
    """Judges many cells with different gains, with one process per core."""
    texts = [
        load_scenario("free", {"duration_s": real_s, "control.Kd": 2.0 + 2.0 * n / CELLS}).text
        for n in range(CELLS)
    ]
    count = count_cores()
    with worker_pool(count) as pool:
        list(pool.map(classify_cell, texts[:count], [0.0] * count))  # begins the processes
        begun = time.perf_counter()
        outcomes = list(pool.map(classify_cell, texts, [0.0] * CELLS, chunksize=8))
        wall_s = time.perf_counter() - begun
    words = sorted({str(outcome.verdict) for outcome in outcomes})
    speed = CELLS * real_s / wall_s / count
    return [
        f"{CELLS} cells of it, each with another Kd, judged on {count} cores: {wall_s:.1f} s, "
        f"{speed:.0f} x real time per core ({', '.join(words)})",
        f"  {ASKED} cells would take {wall_s * ASKED / CELLS / 60.0:.1f} min (bar: <= 4 min on 2 cores)",
    ]

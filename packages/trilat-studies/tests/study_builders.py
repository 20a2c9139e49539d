"""Scenarios, plans, results and stand-ins for the tests of studies.

- `make_*` returns an object without running anything.
- `plan_*` returns the plan of a study.
- `run_*` runs a study.
- `replace_judge`, `use_single_runs` and `use_lanes` change how a study runs during a test.
"""

import hashlib
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from trilat_studies.bench import BenchPlan, plan_bench
from trilat_studies.bench.bench_plan import BenchCell
from trilat_studies.bench.bench_results import BenchRun
from trilat_studies.expectations import ExpectationResult
from trilat_studies.measure_run import RunMetrics
from trilat_studies.run_statistics import LinkAge
from trilat_studies.sweep import prepare_sweep_folder, run_sweep, sweep_cell
from trilat_studies.sweep.map_plane import MapPlane
from trilat_studies.sweep.sweep_cell import CellClass, CellResult
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep
from trilat_studies.sweep.sweep_run import FinishedSweep
from trilat_studies.trials import Trial, TrialResult
from trilat_studies.tuning import TuningPlan, plan_tuning
from trilat_studies.tuning.candidate import CandidateClass, CandidateScore
from trilat_studies.tuning.tuning_plan import ObjectivePoint

from trilat_net.analysis.run_end import EndBehaviour, RunEnd, Stability
from trilat_net.analysis.twins.envelope_trend import EnvelopeFit, EnvelopeTrend
from trilat_net.core.lanes.lane_run import LaneRun
from trilat_net.own_code.code_consent import allow_own_code
from trilat_net.scenario import Scenario, load_scenario, parse_scenario

TRIO = """
name = "trio"
rate_hz = 100
duration_s = 2.0
[limits]
tau_limit_nm = 60.0
[link]
delay_ms = 50.0
[sites.m1]
role = "master"
q0_rad = [0.3, -0.2]
[sites.m2]
role = "master"
q0_rad = [-0.2, 0.4]
[sites.s]
role = "slave"
q0_rad = [0.1, 0.1]
[dominance]
m1 = { m2 = 0.2, s = 0.8 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.6, m2 = 0.4 }
"""
"""Three sites, two seconds, 100 Hz: a run takes milliseconds."""

SHORT = TRIO.replace("duration_s = 2.0", "duration_s = 0.5")
"""The same scenario over half a second."""

FIRM_GAINS = ("control.law=pd_d", "control.K=20.0", "control.d=9.0", "control.Kd=0.5")
"""Overrides with which the arms of the three sites stand and agree."""

QUICK = """
name = "quick"
rate_hz = 100
duration_s = 0.5
[link]
model = "uniform"
delay_ms = 60.0
half_width_ms = 60.0
[sites.m]
role = "master"
q0_rad = [0.3, 0.0]
[sites.s]
role = "slave"
[dominance]
m = { s = 1.0 }
s = { m = 1.0 }
[expect]
peak_error_max_rad = 2.0
mean_age_max_ms = 100.0
"""
"""Two sites, half a second, a link on which every seed gives another run."""

UNMET_LIMIT = {"expect.mean_age_max_ms": 1.0}
"""An override of the quick scenario that no run meets."""


def make_trio_scenario(*overrides: str) -> Scenario:
    """Returns the scenario of three sites and two seconds."""
    return parse_scenario(TRIO, overrides=overrides)


def make_quick_scenario(**overrides: Any) -> Scenario:
    """Returns the scenario of two sites and a random link."""
    return allow_own_code(parse_scenario(QUICK, "quick", overrides))


DELAYS = "link.delay_ms=0:40:20"
DAMPING = "control.Kd=1:4:1"


def plan_quick_sweep(folder: Path, *overrides: str, **settings: object) -> SweepPlan:
    """Returns the plan of a sweep of the short scenario, which is written as a file.

    Without axes among the settings the plan has twelve cells: three delays and four dampings.
    """
    path = folder / "trio.toml"
    if not path.exists():
        path.write_text(SHORT)
    return plan_sweep(path, overrides, **{"over": (DELAYS, DAMPING), **settings})  # type: ignore[arg-type]


def run_plan(plan: SweepPlan, folder: Path) -> FinishedSweep:
    """Runs a sweep in this process, with its files in a folder."""
    return run_sweep(prepare_sweep_folder(plan, folder), jobs=1)


def plan_quick_tuning(
    folder: Path, *overrides: str, text: str = TRIO, **settings: object
) -> TuningPlan:
    """Returns the plan of a tuning in the scenario of three sites, which is written as a file."""
    path = folder / "trio.toml"
    path.write_text(text)
    return plan_tuning(path, overrides, **settings)  # type: ignore[arg-type]


def plan_small_suite(**changes: Any) -> BenchPlan:
    """Returns the plan of two cells of two sites, one cell with two seeds."""
    settings: dict[str, Any] = {
        "laws": ["p_d"],
        "study": "round-trips",
        "tasks": ["free"],
        "links": ["rtt8", "rtt68-loss25"],
        "seeds": 2,
    }
    return plan_bench(**{**settings, **changes})


class Judge:
    """Stands for the judge of a sweep: a text decides its result, and all texts are kept."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def __call__(self, text: str, longest_s: float) -> CellResult:
        self.texts.append(text)
        return make_cell_result(text, longest_s)


def make_cell_result(text: str, longest_s: float = 4.0) -> CellResult:
    """Returns a result that differs for nearly every text."""
    digest = hashlib.sha256(text.encode()).digest()
    number = int.from_bytes(digest[:6], "big") / 2**48
    verdict = list(CellClass)[digest[7] % 4]
    diverged_s = 0.25 if verdict is CellClass.DIVERGED else None
    return CellResult(
        verdict=verdict,
        motion=list(EndBehaviour)[digest[8] % 6],
        ran_s=diverged_s or longest_s,
        extended=digest[9] % 4,
        end_error_rad=number,
        end_speed_rad_s=number / 3.0,
        error_rate_per_s=None if digest[10] % 2 else -number,
        speed_rate_per_s=number * 1e-300,
        peak_error_rad=1.0 / 3.0 + number,
        settled_s=None if digest[11] % 2 else number,
        diverged_s=diverged_s,
    )


def use_single_runs(patch: pytest.MonkeyPatch) -> None:
    """Lets small studies compute their runs one by one, as if no code for lanes were stored."""
    patch.setattr(LaneRun, "has_stored_code", lambda _: False)


def use_lanes(patch: pytest.MonkeyPatch) -> None:
    """Lets studies compute their runs side by side, as if the code for lanes were stored."""
    patch.setattr(LaneRun, "has_stored_code", lambda _: True)


def record_lane_times(patch: pytest.MonkeyPatch) -> list[float]:
    """Returns a list that gets the end of each simulated interval of runs in lanes, in s."""
    lane_times_s: list[float] = []
    advance_to = LaneRun.advance_to

    def advance_and_record(lanes: LaneRun, until_s: float) -> None:
        lane_times_s.append(until_s)
        advance_to(lanes, until_s)

    patch.setattr(LaneRun, "advance_to", advance_and_record)
    return lane_times_s


def replace_judge(patch: pytest.MonkeyPatch, judge: Callable[[str, float], CellResult]) -> None:
    """Lets a function judge the cells of sweeps; runs in lanes would not ask this function."""
    patch.setattr(sweep_cell, "classify_cell", judge)
    use_single_runs(patch)


def dominates(a: ObjectivePoint, b: ObjectivePoint) -> bool:
    """Returns True if `a` is no worse than `b` in both objectives, and better in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


class StopError(Exception):
    """Ends a study from its report of progress."""


def stop_after(count: int) -> Callable[[int, int], None]:
    """Returns a report of progress that ends a study after some runs."""

    def report_progress(done: int, _total: int) -> None:
        if done >= count:
            raise StopError

    return report_progress


P_D = load_scenario("p_d_margin")
DELAYS_MS = (0, 100, 200, 300, 400)
DAMPINGS = (0.2, 0.7, 1.2, 1.7, 2.2)
MAP_KEYS = ("link.delay_ms", "control.d")
SPARE_DAMPING = np.array(DAMPINGS)[:, np.newaxis] - 5e-3 * np.array(DELAYS_MS)
"""The damping beyond P+d's condition in each cell of the map, for K = 10 and three sites."""

PlaceJudge = Callable[..., CellClass]


def judge_by_condition(delay_ms: float, d: float, *_: Any) -> CellClass:
    """Returns the verdict of P+d's condition for K = 10 and three sites."""
    return CellClass.CONVERGED if d > 5e-3 * delay_ms else CellClass.BOUNDED


def make_map_rows(
    verdict: PlaceJudge = judge_by_condition, seeds: int = 1, **axes: Any
) -> Iterator[dict[str, Any]]:
    """Yields a row for each cell and seed of a map, judged by its values and its seed.

    Further axes are named by their keys with two underscores for each dot.
    """
    values_by_key = {MAP_KEYS[0]: DELAYS_MS, MAP_KEYS[1]: DAMPINGS}
    for name, axis_values in axes.items():
        values_by_key[name.replace("__", ".")] = axis_values
    for number, values in enumerate(product(*values_by_key.values())):
        for seed in range(1, seeds + 1):
            yield {
                "cell": number,
                **dict(zip(values_by_key, values, strict=True)),
                "law": "p_d",
                "seed": seed,
                "verdict": verdict(*values, seed).value,
                "ran_s": 20.0,
                "diverged_s": None,
                "scenario": P_D.text,
            }


def make_map_plane(
    verdict: PlaceJudge = judge_by_condition, seeds: int = 1, **axes: Any
) -> MapPlane:
    """Returns the plane of a map with these rows."""
    map_rows = list(make_map_rows(verdict, seeds, **axes))
    further_keys = [name.replace("__", ".") for name in axes]
    return MapPlane.arrange_rows(map_rows, [*MAP_KEYS, *further_keys], P_D)


def make_gapped_plane() -> MapPlane:
    """Returns the plane of a map in which one cell has not run."""
    map_rows = [row for row in make_map_rows() if row["cell"] != 12]
    return MapPlane.arrange_rows(map_rows, MAP_KEYS, P_D)


def make_exponent_plane() -> MapPlane:
    """Returns the plane of a map whose exponents are the damping minus 1.2, in 1/s."""
    map_rows = [{**row, "exponent_per_s": row["control.d"] - 1.2} for row in make_map_rows()]
    return MapPlane.arrange_rows(map_rows, MAP_KEYS, P_D)


_DECAY = EnvelopeFit(EnvelopeTrend.DECAYS, -0.2)


def read_tables(page: str) -> list[list[tuple[str, ...]]]:
    """Returns the tables of a Markdown page as rows of cells. The first row has the heads."""
    tables = []
    for block in page.split("\n\n"):
        if block.startswith("|"):
            heads, _, *rows = block.splitlines()
            tables.append([tuple(row[2:-2].split(" | ")) for row in (heads, *rows)])
    return tables


def make_run_end(behaviour: EndBehaviour = EndBehaviour.CONVERGED, **fields: Any) -> RunEnd:
    """Returns the end of a run that decays to rest, with another behaviour or other fields."""
    return RunEnd(behaviour, _DECAY, _DECAY, 0.0, 0.0)._replace(**fields)


CALM = RunMetrics(
    simulated_s=20.0,
    end=make_run_end(EndBehaviour.DECAYS, end_error_rad=0.003, end_speed_rad_s=0.02),
    synchronised_at_s=11.0,
    peak_error_rad=0.9,
    rms_error_rad=0.1,
    end_error_rad=0.003,
    end_spread_rad=0.002,
    end_pose_rad={"m1": (0.1, 0.2), "m2": (0.1, 0.2), "s": (0.1, 0.2)},
    peak_torque_nm=50.0,
    peak_speed_rad_s=1.5,
    ages={"m1->s": LinkAge(200.0, 210.0), "m2->s": LinkAge(100.0, 110.0)},
    late_samples=3,
    missing=2,
)
"""The metrics of a run that decays."""


def make_run_metrics(**changes: Any) -> RunMetrics:
    """Returns the metrics of a run that decays, with some fields replaced."""
    return msgspec.structs.replace(CALM, **changes)


def make_trial_result(
    seed: int, *outcomes: ExpectationResult, error: str = "", source: str = "quick.toml"
) -> TrialResult:
    """Returns the result of a trial of 20 s that took 0.5 s."""
    trial = Trial(make_quick_scenario(seed=seed), source)
    return TrialResult(trial, list(outcomes), 20.0, 0.5, error)


def make_candidate_score(
    outcome: CandidateClass = CandidateClass.SETTLED,
    error_rad: float | None = 0.1,
    effort_nm: float | None = 2.0,
    **fields: Any,
) -> CandidateScore:
    """Returns the score of a candidate whose arms keep together, away from the goal."""
    score = CandidateScore(
        outcome=outcome,
        error_rad=error_rad,
        spread_rad=error_rad,
        pose_rad=0.0,
        effort_nm=effort_nm,
        settled_s=error_rad,
        saturated=0.0,
    )
    return msgspec.structs.replace(score, **fields)


def make_bench_run(cell: BenchCell, seed: int = 1, **changes: Any) -> BenchRun:
    """Returns a stable run of a cell of a benchmark, with some fields replaced."""
    run = BenchRun(
        name=cell.name,
        inputs=cell.inputs,
        seed=seed,
        random=True,
        sha256="",
        stability=Stability.STABLE,
        behaviour=EndBehaviour.CONVERGED,
        text="",
    )
    return msgspec.structs.replace(run, **changes)


def assert_same_bits(value: Any, expected: Any, path: str = "") -> None:
    """Asserts that two values have the same types and bits, also inside of containers."""
    assert type(value) is type(expected), path
    if isinstance(value, dict):
        assert value.keys() == expected.keys(), path
        for key, item in value.items():
            assert_same_bits(item, expected[key], f"{path} {key}")
    elif isinstance(value, list | tuple):
        assert len(value) == len(expected), path
        for n, item in enumerate(value):
            assert_same_bits(item, expected[n], f"{path} {n}")
    elif isinstance(value, np.ndarray):
        assert (value.dtype, value.shape) == (expected.dtype, expected.shape), path
        if value.dtype == object:
            assert_same_bits(tuple(value), tuple(expected), path)
        else:
            assert value.tobytes() == expected.tobytes(), path
    else:
        assert value == expected, path

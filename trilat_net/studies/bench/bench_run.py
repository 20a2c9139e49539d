"""Runs the suite: a run's judgement by its end and by its twins, its numbers, the folder and
its journal.

Invariant: a run's numbers are a function of its scenario. Errors, efforts and forces are those
of the log that its command makes, over the time of its task; what is judged lasts as long as
the judgement needs. The number of processes, their order and the number of interruptions do not
enter. A run that is in the journal is never made again; one with other gains is another run. A
folder belongs to one version of the program on one arithmetic.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...analysis.dominance_history import evaluate_ramps, list_scripted_ramps
from ...analysis.run_end import THROWN_RAD, RunEnd, Stability
from ...analysis.site_signals import SETTLED_ERROR_RAD
from ...analysis.torque_sources import list_walls, wall_force
from ...analysis.twin_growth import TwinGrowth, judge_end_by_twins, measure_virtual_twins
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...errors import UsageError
from ...files import make_results_folder, refuse_link, write_whole
from ...scenario import Scenario
from ...scenario.operators.kernel_operators import ViscousEnvironment
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from ..measure_run import RecordBatch, run_whole
from ..study_folder import RunJournal, StudyFolder, build_resume_hint, describe_program
from ..tuning.candidate import load_tuning_scenario
from .bench_plan import SHORTER_REACH, TASKS, BenchCell, BenchPlan, name_settings
from .bench_results import LONGEST_S, BenchResults, BenchRun, name_run

SLAVE = "s"
USER = "m1"
BOUND_RAD_S = 5.0
"""No joint of a bounded run is faster, rad/s, and none further from its start than
`THROWN_RAD`.
"""
REST_S = 2.0
"""A run has converged if its arms stay within `SETTLED_ERROR_RAD` of their last pose for so
long, s.
"""
TWINS = 3
"""Twins of a run of the first seed, pushed at all joints, at single ones, and in estimates;
else one.
"""
TIME_CONSTANTS = 6.0
"""A run lasts for so many of its slowest time constants, but for no longer than `LONGEST_S`."""


class BenchRunItem(NamedTuple):
    """One run to be made: picklable, with all that a worker needs; `to_s` as that of a run."""

    cell: BenchCell
    seed: int
    to_s: float = 0.0

    def __str__(self) -> str:
        return f"{self.cell.name}, seed {self.seed}"


class _JudgedRun(NamedTuple):
    """A run with all of its records, and its judgement."""

    scenario: Scenario
    records: dict[str, RecordBatch]
    end: RunEnd
    twins: TwinGrowth
    stability: Stability
    text: str


def run_bench_task(task: BenchRunItem) -> BenchRun:
    """Makes one run, in whatever process."""
    cell = task.cell
    scenario = task.cell.build(task.seed).scenario
    twins = TWINS if task.seed == cell.seeds[0] else 1
    judged = _run(scenario, task.to_s or scenario.duration_s, twins)
    if not task.to_s:
        judged = _lengthen(judged, twins)
    found = (
        judged.stability,
        judged.end.behaviour,
        judged.text,
        judged.scenario.duration_s,
        task.to_s,
    )
    made = BenchRun(cell.name, cell.inputs, task.seed, scenario.random, scenario.sha256, *found)
    if judged.end.diverged_at_s is None:
        made = _measure(made, judged, TASKS[cell.task].duration_s)
        if cell.task == "contact" and not made.masked:
            made = msgspec.structs.replace(made, stiffness_n_m=_find_stiffness(task, judged))
    return made


def _run(scenario: Scenario, length_s: float, twins: int) -> _JudgedRun:
    scenario = msgspec.structs.replace(scenario, duration_s=length_s)
    (records, end) = run_whole(scenario)
    growth = TwinGrowth("none were asked for")
    if end.diverged_at_s is None and twins:
        growth = measure_virtual_twins(scenario, end, length_s, twins)
    found = judge_end_by_twins(end, growth, settles=None, rises=False)
    return _JudgedRun(
        scenario=scenario,
        records=records,
        end=end,
        twins=growth,
        stability=found.stability,
        text=found.reason or end.text,
    )


def _lengthen(judged: _JudgedRun, twins: int) -> _JudgedRun:
    """Returns a run that lasts for its slowest time constants; not stable is what twice as long
    is, too.
    """
    length_s = judged.scenario.duration_s
    rates = [judged.end.error.rate_per_s, judged.end.speed.rate_per_s]
    rates += [one.rate_per_s for one in judged.twins.pushes if one.factor > 0.0]
    wanted_s = TIME_CONSTANTS * max((-1.0 / rate for rate in rates if rate < 0.0), default=0.0)
    if judged.stability is Stability.OPEN or wanted_s < LONGEST_S:
        wanted_s = min(wanted_s, LONGEST_S)
        if length_s < wanted_s and judged.end.diverged_at_s is None:
            length_s = float(math.ceil(wanted_s))
            judged = _run(judged.scenario, length_s, twins)
    if judged.stability is Stability.NOT_STABLE and judged.end.diverged_at_s is None:
        return _run(judged.scenario, 2.0 * length_s, twins)
    return judged


def _measure(made: BenchRun, judged: _JudgedRun, duration_s: float) -> BenchRun:
    scenario = judged.scenario
    whole = judged.records
    records = {
        name: one.between(0, round(duration_s * NS_PER_S)) for name, one in whole.items()
    }
    efforts = []
    hands = []
    walls = []
    for name, record in records.items():
        spec = scenario.sites[name]
        arm = build_arm_rows(scenario, name)
        efforts.append(np.mean((record.tau - arm.gravity_torque(record.q)) ** 2))
        if spec.hands:
            hands.append(np.mean(_find_hand_torque(scenario, name, record) ** 2))
        tip = arm.place_end_effector(record.q, record.qd)
        t_s = record.t_ns / NS_PER_S
        walls += [wall_force(wall, t_s, tip) for wall in list_walls(spec)]
    starts = [np.abs(one.q - scenario.sites[name].q0_rad).max() for name, one in whole.items()]
    fastest = max(np.abs(one.qd).max() for one in whole.values())
    return msgspec.structs.replace(
        made,
        bounded=bool(fastest <= BOUND_RAD_S and max(starts) <= THROWN_RAD),
        energy_j=find_least_energy(whole),
        settled_s=_find_settled_s(whole),
        error_rad=_follow_error_rad(scenario, records),
        effort_nm=float(np.sqrt(np.mean(efforts))),
        hand_nm=float(np.sqrt(np.mean(hands))),
        wall_n=max((float(one[3 * len(one) // 4 :].mean()) for one in walls), default=None),
        force_peak_n=max((float(one.max()) for one in walls), default=None),
    )


def _find_hand_torque(scenario: Scenario, name: str, record: RecordBatch) -> Array:
    """Returns the torque of the operators ON an arm, without the friction of its joints, shape
    (K, n).
    """
    dampers = (
        one for one in scenario.sites[name].environment if isinstance(one, ViscousEnvironment)
    )
    return sum((np.array(one.damping_nm_s_rad) * record.qd for one in dampers), -record.tau_x)


def find_least_energy(records: dict[str, RecordBatch]) -> float:
    """Returns the least over time of sum_i int -tau_x' qd dt: what came from outside until
    then, J.

    All arms begin at rest, so that of a passive network with passive controllers none is below
    zero.
    """
    power = sum(-np.sum(one.tau_x * one.qd, axis=1) for one in records.values())
    h_s = 1e-9 * np.diff(records[SLAVE].t_ns[:2])[0]
    return float(np.cumsum(np.concatenate([[0.0], 0.5 * h_s * (power[1:] + power[:-1])])).min())


def _find_settled_s(records: dict[str, RecordBatch]) -> float | None:
    """Returns since when every joint stays where it ends, s; None if that is too short a time
    ago.
    """
    last_s = 0.0
    for record in records.values():
        away = np.flatnonzero(np.abs(record.q - record.q[-1]).max(axis=1) > SETTLED_ERROR_RAD)
        last_s = max(last_s, record.t_ns[away[-1]] / NS_PER_S if len(away) else 0.0)
    return float(last_s) if last_s <= records[SLAVE].t_ns[-1] / NS_PER_S - REST_S else None


def _find_stiffness(task: BenchRunItem, far: _JudgedRun) -> float | None:
    """Returns by how much more the user has to push to get so much further, along the wall's
    normal, N/m.
    """
    built = task.cell.build(task.seed)
    short = load_tuning_scenario(
        built.source, (*built.overrides, *name_settings(SHORTER_REACH))
    )
    near = _run(short.scenario, far.scenario.duration_s, twins=0)
    if None in (_find_settled_s(near.records), _find_settled_s(far.records)):
        return None
    (near_m, near_n) = _find_push(near)
    (far_m, far_n) = _find_push(far)
    return float((far_n - near_n) / (far_m - near_m))


def _find_push(judged: _JudgedRun) -> tuple[float, float]:
    """Returns of the last second where the user's end effector is along x, m, and how it is
    pushed, N.
    """
    scenario = judged.scenario
    record = judged.records[USER].since(judged.records[USER].t_ns[-1] - NS_PER_S)
    tip = build_arm_rows(scenario, USER).place_end_effector(record.q, record.qd)
    torque = _find_hand_torque(scenario, USER, record)
    force = np.linalg.solve(np.swapaxes(tip.J, 1, 2), torque[:, :, np.newaxis])[:, 0, 0]
    return float(tip.position[:, 0].mean()), float(force.mean())


def _follow_error_rad(scenario: Scenario, records: dict[str, RecordBatch]) -> float:
    peers = scenario.peers(SLAVE)
    own = records[SLAVE]
    t_s = own.t_ns / NS_PER_S
    period_s = 1.0 / scenario.sites[SLAVE].rate_hz
    alpha = evaluate_ramps(*list_scripted_ramps(scenario, SLAVE), t_s, period_s).alpha
    led: Array = sum(
        (alpha[:, n, None] * records[peer].q for n, peer in enumerate(peers)),
        np.zeros_like(own.q),
    )
    return float(np.sqrt(np.mean((own.q - led) ** 2)))


ORIGIN_NAME = "origin.json"
JOURNAL_NAME = "runs.journal"


BenchFolder = StudyFolder[BenchPlan, BenchRun]


def prepare_bench_folder(plan: BenchPlan, path: Path | None = None) -> BenchFolder:
    """Returns the folder of a suite, made, or as it was left; by default `runs/bench-STUDY`.

    Raises:
        UsageError: it holds something else, or runs from elsewhere, or cannot be made.
    """
    chosen = path or Path("runs") / f"bench-{plan.study}"
    if path is None:
        refuse_link(chosen)
    arithmetic, versions = describe_program()
    facts = {"arithmetic": arithmetic, **versions}
    file = chosen / ORIGIN_NAME
    origin = json.dumps(facts, indent=2) + "\n"
    if not file.exists():
        make_results_folder(chosen, "", force=None)
        write_whole(file, origin)
    elif (before := file.read_text(encoding="utf-8")) != origin:
        there, here = (" ".join(text.split()) for text in (before, origin))
        raise UsageError(
            f"{chosen}: holds runs of {there}, and this is {here}; results are not mixed: choose another "
            "folder with --out"
        )
    remedy = build_resume_hint("bench", "--study", plan.study, "--out", str(chosen))
    return BenchFolder(
        chosen,
        plan,
        facts,
        remedy,
        lambda: RunJournal(chosen / JOURNAL_NAME, origin, BenchRun, remedy),
    )


def run_bench(
    folder: BenchFolder,
    jobs: int | None = None,
    on: Workers = None,
    progress: Progress = ignore_progress,
    *,
    confirm: bool = False,
) -> BenchResults:
    """Runs what is left of a suite, and returns all of it; other arguments are those of
    `trilat_net.bench`.

    What the journal of the folder has is not run again; `progress` gets the runs that are done,
    and all.

    Raises:
        RunFailed: a run ended its workers, or the cluster is gone. What is done is kept.
    """
    plan = folder.plan
    with folder.journal() as journal:
        asked = [BenchRunItem(cell, seed) for cell in plan.cells for seed in cell.seeds]
        for again in (False, True)[: 1 + confirm]:
            if again:
                found = [(one, journal.done[one.cell.key, one.seed]) for one in asked]
                asked = [one._replace(to_s=LONGEST_S) for one, run in found if run.doubtful]
            keys = [(name_run(one.cell.key, one.to_s), one.seed) for one in asked]
            tasks = [
                one for key, one in zip(keys, asked, strict=True) if key not in journal.done
            ]
            if tasks:
                hint = "; what is done is kept: the same command goes on"
                with open_worker_pool(jobs, on, most=len(tasks), hint=hint) as pool:
                    done = len(asked) - len(tasks)
                    journal.run_pending(pool, run_bench_task, tasks, done, len(asked), progress)
        return BenchResults(plan, journal.done)

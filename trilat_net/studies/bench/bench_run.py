"""Executes the runs of the benchmark suite: judges and measures each run, and stores it.

A run is judged by its end (`analysis.run_end`) and by its twins (`analysis.twin_growth`). A
twin is a repetition of the run with a small disturbance, which shows whether disturbances grow.
A run is made longer if its judgement needs more time. Its errors, efforts and forces are
measured over the time of the task only, from the same records that `trilat sim` writes.

Invariant:
    - The numbers of a run depend on its scenario alone. The number of processes, their order
      and interruptions have no influence.
    - A run that is in the journal of the folder is not executed again. A run with other gains
      counts as another run.
    - A folder contains only runs of one version of the program on one kind of arithmetic, see
      `describe_program`.
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
from ...analysis.twin_growth import TwinGrowth, measure_virtual_twins
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...errors import UsageError
from ...files import make_results_folder, refuse_link, write_whole
from ...scenario import Scenario
from ...scenario.operators.kernel_operators import ViscousEnvironment
from ...theory.loop_roots import find_run_roots
from ...theory.run_certificate import decide_virtual_run
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from ..measure_run import RecordBatch, run_whole
from ..study_folder import RunJournal, StudyFolder, build_resume_hint, describe_program
from ..tuning.candidate import load_tuning_scenario
from .bench_plan import SHORTER_REACH, TASKS, BenchCell, BenchPlan, format_settings
from .bench_results import LONGEST_S, BenchResults, BenchRun, name_run

SLAVE = "s"
USER = "m1"
BOUND_RAD_S = 5.0
"""Largest joint velocity of a bounded run, in rad/s.

In addition, no joint of such a run moves more than `THROWN_RAD` away from its start.
"""
REST_S = 2.0
"""Shortest time, in s, for which the arms of a converged run stay at their final poses.

All joints stay within `SETTLED_ERROR_RAD` of their final angles.
"""
TWINS = 3
"""Number of twins of the run with the first seed. Runs with other seeds have one twin.

The disturbances of the three twins are at all joints, at single joints, and in the estimates of
the adaptive laws.
"""
TIME_CONSTANTS = 6.0
"""Shortest duration of a run in units of its slowest time constant, up to `LONGEST_S`."""


class BenchRunItem(NamedTuple):
    """One run of the benchmark, as it is sent to a worker process. It can be pickled.

    Attributes:
        cell: The task, control law and link of the run, with the tuned gains.
        seed: Seed of the run.
        to_s: Duration in s, if the run repeats a first run over a longer time to check that it
            is not stable. 0 for a first run.
    """

    cell: BenchCell
    seed: int
    to_s: float = 0.0

    def __str__(self) -> str:
        return f"{self.cell.name}, seed {self.seed}"


class _JudgedRun(NamedTuple):
    """A run of the suite with all of its records, and the judgement whether it is stable.

    The judgement takes twins into account: repeated runs with a small disturbance, which show
    whether disturbances grow.

    Attributes:
        scenario: Scenario of the run. Its duration is that of the run.
        records: All records of the run, by site.
        end: Analysis of the end of the run.
        twins: Growth of the small disturbances of the twins.
        stability: The judgement.
        text: Explanation of the judgement.
    """

    scenario: Scenario
    records: dict[str, RecordBatch]
    end: RunEnd
    twins: TwinGrowth
    stability: Stability
    text: str

    @property
    def diverged(self) -> bool:
        """True if a site exceeded its limits, which ended the run."""
        return self.end.diverged_at_s is not None


def run_bench_task(item: BenchRunItem) -> BenchRun:
    """Simulates a run of the benchmark, judges its stability, and measures its performance.

    The function needs nothing but its argument. Therefore any worker process can call it.

    Args:
        item: The run to execute.

    Returns:
        The finished run, ready for the journal. It has the judgement of its stability and
        measured numbers such as error and effort. A run that diverged has no such numbers.
    """
    cell = item.cell
    scenario = cell.build(item.seed).scenario
    twins = TWINS if item.seed == cell.seeds[0] else 1
    is_repeated = item.to_s > 0.0
    if is_repeated:
        judged = _judge(scenario, item.to_s, twins)
    else:
        judged = _judge(scenario, scenario.duration_s, twins)
        judged = _lengthen(judged, twins)

    run = BenchRun(
        name=cell.name,
        inputs=cell.inputs,
        seed=item.seed,
        random=scenario.random,
        sha256=scenario.sha256,
        stability=judged.stability,
        behaviour=judged.end.behaviour,
        text=judged.text,
        length_s=judged.scenario.duration_s,
        to_s=item.to_s,
    )
    if judged.diverged:
        # Errors and efforts of a run that ended early cannot be compared with those of others.
        return run

    task = TASKS[cell.task]
    run = _measure(run, judged, task.duration_s)
    if cell.task == "contact" and not run.masked:
        stiffness_n_m = _estimate_stiffness(item, judged)
        run = msgspec.structs.replace(run, stiffness_n_m=stiffness_n_m)
    return run


def _judge(scenario: Scenario, length_s: float, twins: int) -> _JudgedRun:
    """Executes a scenario and its twins, and judges the run.

    Args:
        scenario: The scenario. Its own duration is ignored.
        length_s: Duration of the run, in s.
        twins: Number of twins.
    """
    scenario = msgspec.structs.replace(scenario, duration_s=length_s)
    records, end, run = run_whole(scenario)
    growth = TwinGrowth("no twins were requested")
    if end.diverged_at_s is None and twins:
        growth = measure_virtual_twins(scenario, end, length_s, twins)
    decision = decide_virtual_run(scenario, end, find_run_roots(scenario, run), growth)
    return _JudgedRun(
        scenario=scenario,
        records=records,
        end=end,
        twins=growth,
        stability=decision.stability,
        text="; ".join(decision.reasons) or decision.rests_on or end.text,
    )


def _lengthen(judged: _JudgedRun, twins: int) -> _JudgedRun:
    """Repeats a run over a longer time if its judgement needs more time.

    A run must last for `TIME_CONSTANTS` of its slowest time constants, which follow from the
    rates at which its errors and the disturbances of its twins decay. After that, a run that is
    not stable is repeated over twice its duration, and the longer run is judged.

    Args:
        judged: The run.
        twins: Number of twins of a repeated run.

    Returns:
        The longer run, or the same run if it is long enough.
    """
    if judged.diverged:
        return judged
    end = judged.end
    rates = [end.error.rate_per_s, end.speed.rate_per_s]
    rates += [push.rate_per_s for push in judged.twins.pushes if push.factor > 0.0]
    # A rate below 0 means decay. Its time constant is the inverse.
    time_constants_s = [-1.0 / rate for rate in rates if rate < 0.0]
    slowest_s = max(time_constants_s, default=0.0)

    length_s = judged.scenario.duration_s
    required_s = TIME_CONSTANTS * slowest_s
    # If LONGEST_S is too short, repeating the run can only help if its judgement is open.
    if judged.stability is Stability.OPEN or required_s < LONGEST_S:
        required_s = min(required_s, LONGEST_S)
        if length_s < required_s:
            length_s = float(math.ceil(required_s))
            judged = _judge(judged.scenario, length_s, twins)

    if judged.stability is Stability.NOT_STABLE and not judged.diverged:
        return _judge(judged.scenario, 2.0 * length_s, twins)
    return judged


def _measure(run: BenchRun, judged: _JudgedRun, duration_s: float) -> BenchRun:
    """Measures the errors, efforts, forces and energies of a run.

    Args:
        run: The run without these numbers.
        judged: The same run with its records.
        duration_s: Time over which errors, efforts and forces are measured, in s.

    Returns:
        The run with the numbers, see `BenchRun`.
    """
    scenario = judged.scenario
    whole = judged.records
    task_end_ns = round(duration_s * NS_PER_S)
    records = {name: batch.between(0, task_end_ns) for name, batch in whole.items()}

    squared_efforts = []
    squared_hand_torques = []
    wall_forces = []
    for name, record in records.items():
        spec = scenario.sites[name]
        arm = build_arm_rows(scenario, name)

        effort = record.tau - arm.gravity_torque(record.q)
        squared_efforts.append(np.mean(effort**2))
        if spec.hands:
            hand_torque = _compute_hand_torque(scenario, name, record)
            squared_hand_torques.append(np.mean(hand_torque**2))

        tip = arm.place_end_effector(record.q, record.qd)
        t_s = record.t_ns / NS_PER_S
        wall_forces += [wall_force(wall, t_s, tip) for wall in list_walls(spec)]

    # There are no maxima if the task has no wall.
    peaks_n = [float(force.max()) for force in wall_forces]
    final_means_n = []
    for force in wall_forces:
        start = 3 * len(force) // 4
        last_quarter = force[start:]
        final_means_n.append(float(last_quarter.mean()))
    effort_nm = np.sqrt(np.mean(squared_efforts))
    hand_nm = np.sqrt(np.mean(squared_hand_torques))
    return msgspec.structs.replace(
        run,
        bounded=_is_bounded(scenario, whole),
        energy_j=find_least_energy(whole),
        settled_s=_find_settled_s(whole),
        error_rad=_measure_error_rad(scenario, records),
        effort_nm=float(effort_nm),
        hand_nm=float(hand_nm),
        wall_n=max(final_means_n, default=None),
        force_peak_n=max(peaks_n, default=None),
    )


def _is_bounded(scenario: Scenario, records: dict[str, RecordBatch]) -> bool:
    """Returns True if all joints stayed slower than `BOUND_RAD_S` and near their start.

    Args:
        scenario: The scenario, which has the start angles.
        records: All records of the run, by site.
    """
    for name, record in records.items():
        start_rad = scenario.sites[name].q0_rad
        distance_rad = np.abs(record.q - start_rad)
        speed_rad_s = np.abs(record.qd)
        is_thrown = distance_rad.max() > THROWN_RAD
        is_too_fast = speed_rad_s.max() > BOUND_RAD_S
        if is_thrown or is_too_fast:
            return False
    return True


def _compute_hand_torque(scenario: Scenario, name: str, record: RecordBatch) -> Array:
    """Computes the torque of the operators on the joints of an arm.

    The records have -tau_x, the sum of all torques from outside. It also contains the viscous
    friction -D qd of the joints, which is removed by adding D qd. Walls are not removed: the
    function is meant for arms that touch none.

    Args:
        scenario: The scenario.
        name: Name of the arm's site.
        record: The records of the site.

    Returns:
        The torque in N m, shape (records, joints).
    """
    torque: Array = -record.tau_x
    for source in scenario.sites[name].environment:
        if isinstance(source, ViscousEnvironment):
            damping = np.array(source.damping_nm_s_rad)
            torque = torque + damping * record.qd
    return torque


def find_least_energy(records: dict[str, RecordBatch]) -> float:
    """Computes the minimum over time of the net energy that the arms received from outside.

    The net energy that the arms received until time t is the integral of -sum_i tau_x_i' qd_i
    from the start to t, computed with the trapezoidal rule. Here -tau_x_i is the torque from
    outside on arm i, in N m, which the records contain with the opposite sign. qd_i is the
    joint velocity of the arm, in rad/s.

    All arms start at rest. If network and controllers are passive, the arms cannot return more
    energy than they received, so the net energy never falls below 0, apart from numerical
    errors. A negative result shows that energy was generated.

    Args:
        records: All records of the run, by the name of the arm.

    Returns:
        The minimum, in J. It is at most 0, because the net energy is 0 at the start.
    """
    arm_powers = []
    for record in records.values():
        joint_power = record.tau_x * record.qd
        arm_powers.append(-np.sum(joint_power, axis=1))
    power = sum(arm_powers)
    first_times_ns = records[SLAVE].t_ns[:2]
    h_s = 1e-9 * np.diff(first_times_ns)[0]
    power_sums = power[1:] + power[:-1]
    work = 0.5 * h_s * power_sums
    energy = np.cumsum(np.concatenate([[0.0], work]))
    return float(energy.min())


def _find_settled_s(records: dict[str, RecordBatch]) -> float | None:
    """Finds the time from which every joint stays at its final angle.

    Args:
        records: All records of the run, by site.

    Returns:
        The time in s. None if it is less than `REST_S` before the end of the run, because the
        arms may then still be moving.
    """
    settled_s = 0.0
    for record in records.values():
        from_end_rad = np.abs(record.q - record.q[-1])
        distance_rad = from_end_rad.max(axis=1)
        moving = np.flatnonzero(distance_rad > SETTLED_ERROR_RAD)
        if len(moving):
            last_moving_s = record.t_ns[moving[-1]] / NS_PER_S
            settled_s = max(settled_s, last_moving_s)
    end_s = records[SLAVE].t_ns[-1] / NS_PER_S
    return float(settled_s) if settled_s <= end_s - REST_S else None


def _estimate_stiffness(item: BenchRunItem, far: _JudgedRun) -> float | None:
    """Estimates the stiffness that the user feels along the normal of the wall.

    The same run is executed with a shorter reach of the user. The stiffness is the difference
    of the forces, divided by the difference of the positions of the user's arm, when both runs
    are at rest.

    Args:
        item: The run with the longer reach.
        far: The same run with its records.

    Returns:
        The stiffness in N/m. None if one of the runs does not come to rest.
    """
    built = item.cell.build(item.seed)
    overrides = (*built.overrides, *format_settings(SHORTER_REACH))
    shorter = load_tuning_scenario(built.source, overrides)
    near = _judge(shorter.scenario, far.scenario.duration_s, twins=0)
    near_settled_s = _find_settled_s(near.records)
    far_settled_s = _find_settled_s(far.records)
    if near_settled_s is None or far_settled_s is None:
        return None
    near_m, near_n = _measure_push(near)
    far_m, far_n = _measure_push(far)
    force_n = far_n - near_n
    distance_m = far_m - near_m
    return float(force_n / distance_m)


def _measure_push(judged: _JudgedRun) -> tuple[float, float]:
    """Measures how far and how hard the user pushes at the end of a run.

    The force F of the operator on the end effector follows from the torque tau of the operator
    on the joints: J' F = tau, where J is the Jacobian of the end effector.

    Args:
        judged: The run.

    Returns:
        Position of the end effector in m and force in N, both along x and averaged over the
        last second.
    """
    scenario = judged.scenario
    record = judged.records[USER]
    last_second_ns = record.t_ns[-1] - NS_PER_S
    record = record.since(last_second_ns)
    arm = build_arm_rows(scenario, USER)
    tip = arm.place_end_effector(record.q, record.qd)
    torque = _compute_hand_torque(scenario, USER, record)
    J_transposed = np.swapaxes(tip.J, 1, 2)
    torque_columns = torque[:, :, np.newaxis]
    force = np.linalg.solve(J_transposed, torque_columns)
    force_x = force[:, 0, 0]
    position_x = tip.position[:, 0]
    return float(position_x.mean()), float(force_x.mean())


def _measure_error_rad(scenario: Scenario, records: dict[str, RecordBatch]) -> float:
    """Computes the RMS difference between the slave and the average of its users, in rad.

    The average is weighted with the dominance factors of the slave, which may change during the
    run. It uses the joint angles of the users at the same time, without the delay of the links.

    Args:
        scenario: The scenario.
        records: Records by site, all over the same times.
    """
    slave = records[SLAVE]
    t_s = slave.t_ns / NS_PER_S
    period_s = 1.0 / scenario.sites[SLAVE].rate_hz
    start, ramps = list_scripted_ramps(scenario, SLAVE)
    alpha = evaluate_ramps(start, ramps, t_s, period_s).alpha  # dominance factors
    reference: Array = np.zeros_like(slave.q)
    for index, peer in enumerate(scenario.peers(SLAVE)):
        weight = alpha[:, index, None]
        reference = reference + weight * records[peer].q
    error_rad = slave.q - reference
    return float(np.sqrt(np.mean(error_rad**2)))


ORIGIN_NAME = "origin.json"
JOURNAL_NAME = "runs.journal"


BenchFolder = StudyFolder[BenchPlan, BenchRun]


def prepare_bench_folder(plan: BenchPlan, path: Path | None = None) -> BenchFolder:
    """Creates the folder of a benchmark, or opens an existing folder with finished runs.

    Args:
        plan: Plan of the benchmark.
        path: The folder. None uses a folder that is named after the study, as in
            runs/bench-full.

    Raises:
        UsageError: The folder cannot be made, or has other content. The same error is raised
            if its runs come from another version of the program, or from a machine that
            computes with other rounding, because these results must not be mixed.
    """
    if path is None:
        path = Path("runs") / f"bench-{plan.study}"
        refuse_link(path)
    arithmetic, versions = describe_program()
    facts = {"arithmetic": arithmetic, **versions}
    origin = json.dumps(facts, indent=2) + "\n"
    origin_file = path / ORIGIN_NAME
    if origin_file.exists():
        _check_origin(path, origin_file.read_text(encoding="utf-8"), origin)
    else:
        make_results_folder(path, "", force=None)
        write_whole(origin_file, origin)
    remedy = build_resume_hint("bench", "--study", plan.study, "--out", str(path))
    journal_file = path / JOURNAL_NAME
    return StudyFolder(
        path=path,
        plan=plan,
        facts=facts,
        remedy=remedy,
        journal=lambda: RunJournal(journal_file, origin, BenchRun, remedy),
    )


def _check_origin(path: Path, folder_origin: str, origin: str) -> None:
    """Refuses a folder whose runs come from another version or arithmetic.

    Args:
        path: The folder.
        folder_origin: JSON text that describes the program that made the folder.
        origin: JSON text that describes this program.

    Raises:
        UsageError: The texts differ.
    """
    if folder_origin == origin:
        return
    folder_text = " ".join(folder_origin.split())
    local_text = " ".join(origin.split())
    raise UsageError(
        f"{path}: the runs in this folder were made with {folder_text}, but this program is "
        f"{local_text}; results from both cannot be mixed: choose another folder with --out"
    )


def run_bench(
    folder: BenchFolder,
    jobs: int | None = None,
    on: Workers = None,
    progress: Progress = ignore_progress,
    *,
    confirm: bool = False,
) -> BenchResults:
    """Executes the runs of a benchmark that are not finished yet.

    Args:
        folder: Folder of the benchmark. Its journal contains the finished runs.
        jobs: Number of processes, as for `trilat_net.bench`.
        on: Cluster that executes the runs, as for `trilat_net.bench`.
        progress: Function that is called with the number of finished runs and of all runs.
        confirm: True to repeat runs that were judged not stable, with the longer duration
            `LONGEST_S`, because a longer run may show that they are stable.

    Returns:
        The results of all runs.

    Raises:
        RunFailed: A run ended its worker process, or the connection to the cluster is lost.
            Finished runs are kept in the journal.
    """
    plan = folder.plan
    items = [BenchRunItem(cell, seed) for cell in plan.cells for seed in cell.seeds]
    with folder.journal() as journal:
        _run_pending(journal, items, jobs, on, progress)

        if confirm:
            repeated = []
            for item in items:
                run = journal.done[item.cell.key, item.seed]
                if run.needs_confirmation:
                    longer_item = item._replace(to_s=LONGEST_S)
                    repeated.append(longer_item)
            _run_pending(journal, repeated, jobs, on, progress)
        return BenchResults(plan, journal.done)


def _run_pending(
    journal: RunJournal[BenchRun],
    items: list[BenchRunItem],
    jobs: int | None,
    on: Workers,
    progress: Progress,
) -> None:
    """Executes the runs that the journal lacks, and adds each to the journal when it ends.

    Args:
        journal: The finished runs.
        items: All runs that are needed.
        jobs: Number of processes.
        on: Cluster that executes the runs.
        progress: Function that is called with the number of finished runs and of all runs.
    """
    pending = []
    for item in items:
        key = name_run(item.cell.key, item.to_s)
        if (key, item.seed) not in journal.done:
            pending.append(item)
    if not pending:
        return
    hint = "; finished runs are kept: the same command continues"
    with open_worker_pool(jobs, on, most=len(pending), hint=hint) as pool:
        journal.run_pending(
            pool,
            run_bench_task,
            pending,
            done=len(items) - len(pending),
            total=len(items),
            show=progress,
        )

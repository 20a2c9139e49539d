"""Executes benchmark runs, judges their stability and measures their performance.

`run_bench` takes a plan and a folder that stores finished runs. Stability is judged as in
`trilat certify`: from the end of the run and from the characteristic roots of its control loop.
If that is inconclusive, the run is repeated with a small push, to see whether disturbances
grow.

Runs that are too short for a verdict are repeated with a duration of `TIME_CONSTANTS` of their
slowest time constants. A run that is not stable is repeated over twice its length. Errors,
efforts and forces are computed over the time of the task only, from the same records that
`trilat sim` writes.

Invariant:
    - The results of a run depend only on its scenario. The number of processes, their order and
      interruptions have no influence.
    - A run in the folder's journal is not executed again. A run with other gains counts as a
      different run, and so does the repetition of a run over twice its length.
    - The duration of a run has no limit except `MAX_RUN_TICKS`. If a run reaches this limit,
      the explanation of its verdict says so.
    - All runs in a folder come from the same program version and floating-point arithmetic, see
      `describe_program`.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.analysis import (
    SETTLED_ERROR_RAD,
    THROWN_RAD,
    DominanceHistory,
    EndBehaviour,
    RunEnd,
    Stability,
    TwinGrowth,
    VirtualRun,
    VirtualWall,
    build_arm_rows,
    stability_decision,
)
from trilat_net.core import Array, TorqueKind
from trilat_net.errors import CodeFailed, UsageError
from trilat_net.files import make_results_folder, refuse_link, write_whole
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Scenario
from trilat_net.work import Progress, RunJournal, WorkerPool, Workers

from ..measure_run import describe_program
from ..record_batches import RecordBatch, WholeRun
from ..side_by_side import RunKind, prepare_kinds
from ..study_folder import StudyFolder
from ..tuning.candidate import TuningScenario
from .bench_plan import SHORTER_REACH, TASKS, BenchCell, BenchPlan, Settings, format_settings
from .bench_results import BenchResults, BenchRun, name_run

SLAVE = "s"
USER = "m1"
BOUND_RAD_S = 5.0
"""Largest joint velocity of a bounded run, in rad/s.

In addition, no joint of such a run moves more than `THROWN_RAD` away from its start.
"""
REST_S = 2.0
"""Shortest time for which the arms of a converged run stay at their final poses, in s.

All joints stay within `SETTLED_ERROR_RAD` of their final angles.
"""
TIME_CONSTANTS = 6.0
"""Duration of a run that needs more time for a verdict, in units of its slowest time constant.
"""
MAX_RUN_TICKS = 3_000_000
"""Largest number of ticks, over all sites, to which a run is extended.

This limits the memory use: three sites at 1 kHz reach it after 1000 s, when their records take
up a quarter of a gigabyte. A repetition over twice the length may take twice as many ticks.
"""
STIFFNESS_S = 2.0
"""Time after the first contact at which the stiffness is measured, in s.

Laws that integrate an error in contact become stiffer with time, so the time of the measurement
must be fixed.
"""
STIFFNESS_WINDOW_S = 0.2
"""Duration over which positions and forces are averaged for the stiffness, in s."""
IMPEDANCE_HZ = 1.0
"""Frequency at which the impedance is measured, in Hz."""
IMPEDANCE_PERIODS = 4
"""Number of periods over which the impedance is measured."""
SHAKING_N = 0.5
"""Amplitude of the force that shakes the user's arm to measure the impedance, in N.

At half of the smallest wall force that counts as contact, it does not make the slave lose
contact.
"""


class BenchRunItem(NamedTuple):
    """Everything that a worker process needs to execute one benchmark run.

    The object is pickled and sent to the process.

    Attributes:
        cell: The task, control law and link of the run, with the tuned gains.
        seed: Random seed of the run.
        to_s: Duration in s, if this run repeats an earlier run for twice as long to confirm
            that it is not stable. 0 for a run that is not a repetition.
        is_side_by_side: True to compute the run together with others, if possible.
    """

    cell: BenchCell
    seed: int
    to_s: float = 0.0
    is_side_by_side: bool = False

    def __str__(self) -> str:
        return f"{self.cell.name}, seed {self.seed}"

    def run(self) -> BenchRun:
        """Simulates one benchmark run, judges its stability and measures its performance.

        The result depends only on this object, so any worker process can compute it.

        Returns:
            The finished run, ready for the journal. A run that diverged has a verdict, but no
            measured quantities such as error and effort.
        """
        scenario = _build_scenario(self)
        return _measure_item(self, scenario, WholeRun.simulate(scenario))


class JudgedRun(NamedTuple):
    """A benchmark run with all of its records and the verdict on its stability.

    If the characteristic roots are inconclusive, the verdict is based on twins: repetitions
    with a small push, which show whether disturbances grow.

    Attributes:
        scenario: Scenario of the run, with the duration that was simulated.
        records: All records of the run, by site.
        end: Analysis of the end of the run.
        twins: Growth of the disturbances in the twins. `None` if the roots were conclusive.
        roots: Characteristic roots of the loop at the end of the run.
        stability: The verdict.
        text: Explanation of the verdict.
        at_limit: True if a reliable verdict would have taken more than `MAX_RUN_TICKS` ticks.
        rests_on: Evidence for the verdict, as in the stability certificate.
    """

    scenario: Scenario
    records: dict[str, RecordBatch]
    end: RunEnd
    twins: TwinGrowth | None
    roots: stability_decision.LoopRoots
    stability: Stability
    text: str
    at_limit: bool = False
    rests_on: str = ""

    @property
    def diverged(self) -> bool:
        """True if the simulation ended early because an arm exceeded its safety limits."""
        return self.end.diverged_at_s is not None

    @classmethod
    def simulate(cls, scenario: Scenario, length_s: float) -> "JudgedRun":
        """Simulates a scenario and judges its stability as `trilat certify` would.

        Args:
            scenario: The scenario. Its own duration is ignored.
            length_s: Duration of the run, in s.
        """
        scenario = msgspec.structs.replace(scenario, duration_s=length_s)
        return _judge_records(scenario, WholeRun.simulate(scenario))

    def lengthen(self) -> "JudgedRun":
        """Repeats the run over a longer time if it was too short for a reliable verdict.

        A run is long enough if it is stable or settled and its arms are at rest at the end. Any
        other run must last at least `TIME_CONSTANTS` times its slowest time constant.

        Returns:
            The longer run, or this run if it is long enough.
        """
        if self.diverged:
            return self
        is_decided = self.stability in (Stability.STABLE, Stability.SETTLED)
        if is_decided and self.end.behaviour is EndBehaviour.CONVERGED:
            return self

        length_s = self.scenario.duration_s
        required_s = TIME_CONSTANTS * _find_slowest_s(self)
        limit_s = _compute_longest_s(self.scenario)
        longer_s = float(math.ceil(min(required_s, limit_s)))
        longer_run = self
        if longer_s > length_s:
            longer_run = JudgedRun.simulate(self.scenario, longer_s)
        if required_s <= limit_s or longer_run.diverged:
            return longer_run

        limit_text = (
            f"ended after {longer_run.scenario.duration_s:.4g} s by the safety limit of "
            f"{MAX_RUN_TICKS} ticks, but {TIME_CONSTANTS:g} of its slowest time constants are "
            f"{required_s:.4g} s"
        )
        return longer_run._replace(text=f"{longer_run.text}; {limit_text}", at_limit=True)


LANE_RUNS = 16
"""Number of runs that a worker computes side by side, with all of their records in memory."""


def _run_bench_tasks(items: Sequence[BenchRunItem]) -> Iterator[BenchRun]:
    """Executes several benchmark runs, side by side where possible.

    Args:
        items: The runs to execute.

    Yields:
        The finished runs in the order of the items, equal to those of `BenchRunItem.run`.
    """
    for first in range(0, len(items), LANE_RUNS):
        part = items[first : first + LANE_RUNS]
        chosen = [n for n, item in enumerate(part) if item.is_side_by_side]
        scenarios = {n: _build_scenario(part[n]) for n in chosen}
        finished: dict[int, BenchRun] = {}
        try:
            for index, whole, _ in WholeRun.simulate_together(list(scenarios.values())):
                n = chosen[index]
                finished[n] = _measure_item(part[n], scenarios[n], whole)
        except CodeFailed:
            # One by one, so that runs before a run whose code fails are kept.
            finished.clear()
        for n, item in enumerate(part):
            yield finished[n] if n in finished else item.run()


def _build_scenario(item: BenchRunItem) -> Scenario:
    """Returns the scenario of a benchmark run, with the duration of the run.

    Args:
        item: The run to execute.
    """
    scenario = item.cell.build(item.seed).scenario
    if item.to_s > 0.0:
        scenario = msgspec.structs.replace(scenario, duration_s=item.to_s)
    return scenario


def _measure_item(item: BenchRunItem, scenario: Scenario, whole: WholeRun) -> BenchRun:
    """Judges a benchmark run and measures its performance, see `BenchRunItem.run`.

    Args:
        item: The run.
        scenario: Its scenario, with the duration of the run.
        whole: The simulated run, with its records.
    """
    cell = item.cell
    judged = _judge_records(scenario, whole)
    original = scenario
    if item.to_s == 0.0:
        judged = judged.lengthen()
    else:
        original = cell.build(item.seed).scenario

    run = BenchRun(
        name=cell.name,
        inputs=cell.inputs,
        seed=item.seed,
        random=scenario.random,
        sha256=original.sha256,
        stability=judged.stability,
        behaviour=judged.end.behaviour,
        text=judged.text,
        length_s=judged.scenario.duration_s,
        to_s=item.to_s,
        at_limit=judged.at_limit,
    )
    if judged.diverged:
        # Errors and efforts of a run that ended early cannot be compared with those of other
        # runs.
        return run

    task = TASKS[cell.task]
    run = _measure(run, judged, task.duration_s)
    if cell.task == "contact" and not run.masked:
        run = _measure_contact(run, item, judged)
    return run


def _judge_records(scenario: Scenario, whole: WholeRun) -> JudgedRun:
    """Judges the stability of a simulated run, see `JudgedRun.simulate`.

    Args:
        scenario: Its scenario, with the duration of the run.
        whole: The run with its records.
    """
    records, end, run = whole
    judged = VirtualRun(scenario, run, end)
    decision = judged.decision
    return JudgedRun(
        scenario=scenario,
        records=records,
        end=end,
        twins=judged.twins,
        roots=judged.roots,
        stability=decision.stability,
        text="; ".join(decision.reasons) or decision.rests_on or end.text,
        rests_on=decision.rests_on,
    )


def _compute_longest_s(scenario: Scenario) -> float:
    """Returns the longest duration to which a run may be extended for its verdict, in s.

    After this time, all sites together have computed `MAX_RUN_TICKS` ticks.

    Args:
        scenario: The scenario, which defines the tick rates of its sites.
    """
    ticks_per_s = sum(site.rate_hz for site in scenario.sites.values())
    return MAX_RUN_TICKS / ticks_per_s


def _find_slowest_s(judged: JudgedRun) -> float:
    """Returns the slowest time constant of a run, in s, or 0 if nothing decays.

    This is the time constant of the slowest root of the loop. If the loop has no roots, it is
    that of the slowest decay of an envelope of the motion, or of a push in a twin.
    """
    root_per_s = judged.roots.rate_per_s
    if root_per_s is not None:
        return -1.0 / root_per_s if root_per_s < 0.0 else 0.0
    end = judged.end
    rates_per_s = [end.error.rate_per_s, end.speed.rate_per_s]
    pushes = () if judged.twins is None else judged.twins.pushes
    rates_per_s += [push.rate_per_s for push in pushes if push.factor > 0.0]
    # A rate below 0 means decay. Its time constant is the inverse.
    time_constants_s = [-1.0 / rate for rate in rates_per_s if rate < 0.0]
    return max(time_constants_s, default=0.0)


def _measure(run: BenchRun, judged: JudgedRun, duration_s: float) -> BenchRun:
    """Measures the errors, efforts, forces and energies of a run.

    Args:
        run: The run before these quantities are filled in.
        judged: The same run with its records.
        duration_s: Time over which errors, efforts and forces are measured, in s.

    Returns:
        The run with the measured quantities, see `BenchRun`.
    """
    scenario = judged.scenario
    all_records = judged.records
    task_end_ns = round(duration_s * NS_PER_S)
    records = {name: batch.between(0, task_end_ns) for name, batch in all_records.items()}

    squared_efforts = []
    squared_hand_torques = []
    wall_forces = []
    for name, record in records.items():
        spec = scenario.sites[name]
        arm = build_arm_rows(scenario, name)

        # The torque that holds the arm against gravity does not count as effort of the law.
        effort = record.tau - arm.gravity_torque(record.q)
        squared_efforts.append(np.mean(effort**2))
        if spec.hands:
            hand_torque = _compute_hand_torque(scenario, name, record)
            squared_hand_torques.append(np.mean(hand_torque**2))

        tip = arm.place_end_effector(record.q, record.qd)
        t_s = record.t_ns / NS_PER_S
        walls = VirtualWall.list_of_site(scenario, name)
        wall_forces += [wall.find_force(t_s, tip) for wall in walls]

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
        bounded=_is_bounded(scenario, all_records),
        energy_j=find_least_energy(all_records),
        settled_s=_find_settled_s(all_records),
        error_rad=_measure_error_rad(scenario, records),
        effort_nm=float(effort_nm),
        hand_nm=float(hand_nm),
        wall_n=max(final_means_n, default=None),
        force_peak_n=max(peaks_n, default=None),
    )


def _is_bounded(scenario: Scenario, records: dict[str, RecordBatch]) -> bool:
    """Returns True if no joint was thrown far away or became too fast in a run.

    Even a run judged as settled can be unusable, because an arm has swung round.

    Args:
        scenario: The scenario, which defines the start angles.
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
    """Computes the joint torque that the operators exert on an arm, in N m.

    The records contain -tau_x, the sum of all external torques. It includes the viscous
    friction -D qd of the joints, which this function removes by adding D qd. Wall forces are
    not removed, so the arm must not touch a wall.

    Args:
        scenario: The scenario.
        name: Name of the arm's site.
        record: The records of the site.

    Returns:
        The torque, shape (records, joints).
    """
    operator_torque: Array = -record.tau_x
    for part in scenario.sites[name].environment:
        source = part.actor
        if source.kind is TorqueKind.VISCOUS:
            operator_torque = operator_torque + np.array(source.B) * record.qd
    return operator_torque


def find_least_energy(records: dict[str, RecordBatch]) -> float:
    """Computes the minimum over time of the net energy that the arms received, in J.

    The net energy up to time t is the integral of -sum_i tau_x_i' qd_i from the start to t,
    computed with the trapezoidal rule. Here -tau_x_i is the external torque on arm i, in N m
    (the records contain it with the opposite sign), and qd_i is the joint velocity of the arm,
    in rad/s.

    All arms start at rest. If the network and the controllers are passive, the arms cannot
    return more energy than they received, so the net energy never falls below 0 except for
    numerical errors. A negative result shows that energy was generated.

    Args:
        records: All records of the run, by the name of the arm.

    Returns:
        The minimum, in J. At most 0, because the net energy is 0 at the start.
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
    """Finds the time from which every joint stays at its final angle, in s.

    Args:
        records: All records of the run, by site.

    Returns:
        The time, or `None` if it is less than `REST_S` before the end of the run, because the
        arms may then still be moving.
    """
    settled_s = 0.0
    for record in records.values():
        from_end_rad = np.abs(record.q - record.q[-1])
        distance_rad = from_end_rad.max(axis=1)
        rows_away = np.flatnonzero(distance_rad > SETTLED_ERROR_RAD)
        if len(rows_away):
            last_moving_s = record.t_ns[rows_away[-1]] / NS_PER_S
            settled_s = max(settled_s, last_moving_s)
    end_s = records[SLAVE].t_ns[-1] / NS_PER_S
    rests_long_enough = settled_s <= end_s - REST_S
    return float(settled_s) if rests_long_enough else None


def _measure_contact(run: BenchRun, item: BenchRunItem, judged: JudgedRun) -> BenchRun:
    """Measures the stiffness and the impedance that the user feels at the wall.

    Args:
        run: The run before these quantities are filled in.
        item: The run of the task `contact`, as it was executed.
        judged: The same run with its records.

    Returns:
        The run with those quantities that could be measured.
    """
    contact_s = _find_contact_s(judged.scenario, judged.records)
    if contact_s is None:
        return run
    stiffness_n_m = _estimate_stiffness(item, judged, contact_s)
    impedances = _estimate_impedance(item, judged, contact_s)
    if impedances is None:
        return msgspec.structs.replace(run, stiffness_n_m=stiffness_n_m)
    in_contact, in_free_motion = impedances
    return msgspec.structs.replace(
        run,
        stiffness_n_m=stiffness_n_m,
        impedance_n_s_m=in_contact - in_free_motion,
        free_impedance_n_s_m=in_free_motion,
    )


def _find_contact_s(scenario: Scenario, records: dict[str, RecordBatch]) -> float | None:
    """Returns the time at which the slave first touches a wall, in s, or `None` if it does not.

    The rendered stiffness is measured at a fixed time after this contact.

    Args:
        scenario: Scenario of the run, which defines the walls.
        records: Records of each site.
    """
    record = records[SLAVE]
    tip = build_arm_rows(scenario, SLAVE).place_end_effector(record.q, record.qd)
    t_s = record.t_ns / NS_PER_S
    contact_times_s = []
    for wall in VirtualWall.list_of_site(scenario, SLAVE):
        touching = np.flatnonzero(wall.find_force(t_s, tip) > 0.0)
        if len(touching):
            contact_times_s.append(float(t_s[touching[0]]))
    return min(contact_times_s, default=None)


def _run_variant(
    item: BenchRunItem, settings: Settings, duration_s: float
) -> tuple[Scenario, dict[str, RecordBatch]] | None:
    """Executes a benchmark run with other settings, without judging it.

    The difference between two variants, for example with and without a sine, shows a response.

    Args:
        item: The run.
        settings: Overrides of its scenario.
        duration_s: Duration, in s.

    Returns:
        The scenario and its records, or `None` if the run diverged.
    """
    built = item.cell.build(item.seed)
    overrides = (*built.overrides, *format_settings(settings))
    scenario = TuningScenario.load(built.source, overrides).scenario
    scenario = msgspec.structs.replace(scenario, duration_s=duration_s)
    records, end, _ = WholeRun.simulate(scenario)
    return None if end.diverged_at_s is not None else (scenario, records)


def _estimate_stiffness(
    item: BenchRunItem, judged: JudgedRun, contact_s: float
) -> float | None:
    """Estimates the stiffness that the user feels along the normal of the wall, in N/m.

    The run is repeated with a shorter reach of the user. The stiffness is the difference
    between the two forces divided by the difference between the two positions of the user's
    arm. In each run, force and position are measured `STIFFNESS_S` after the first contact.

    Args:
        item: The run with the longer reach.
        judged: The same run with its records.
        contact_s: Time of the first contact in this run, in s.

    Returns:
        The stiffness, or `None` if one of the runs has no contact or ends earlier than
        `STIFFNESS_S` after it.
    """
    shorter_run = _run_variant(item, SHORTER_REACH, TASKS[item.cell.task].duration_s)
    if shorter_run is None:
        return None
    shorter_scenario, shorter_records = shorter_run
    shorter_contact_s = _find_contact_s(shorter_scenario, shorter_records)
    if shorter_contact_s is None:
        return None
    shorter = _measure_push(shorter_scenario, shorter_records, shorter_contact_s + STIFFNESS_S)
    longer = _measure_push(judged.scenario, judged.records, contact_s + STIFFNESS_S)
    if shorter is None or longer is None:
        return None
    distance_m = longer.position_m - shorter.position_m
    force_n = longer.force_n - shorter.force_n
    return float(force_n / distance_m) if distance_m else None


class _Push(NamedTuple):
    """Position and force of the user's push along the normal of the wall.

    Attributes:
        position_m: Position of the user's end effector along x, in m.
        force_n: Force of the user on the end effector along x, in N.
    """

    position_m: float
    force_n: float


def _measure_push(
    scenario: Scenario, records: dict[str, RecordBatch], time_s: float
) -> _Push | None:
    """Measures the position of the user's end effector and the user's force at a given time.

    Args:
        scenario: The scenario.
        records: All records of the run, by site.
        time_s: The time, in s. Position and force are averaged over `STIFFNESS_WINDOW_S` around
            it.

    Returns:
        The position and the force, or `None` if the run ends earlier.
    """
    window_s = (time_s - 0.5 * STIFFNESS_WINDOW_S, time_s + 0.5 * STIFFNESS_WINDOW_S)
    tip_motion = _measure_tip(scenario, records, window_s)
    if tip_motion is None:
        return None
    return _Push(float(tip_motion.position_m.mean()), float(tip_motion.force_n.mean()))


class _TipMotion(NamedTuple):
    """Motion of the user's end effector along the normal of the wall, over K records.

    Attributes:
        q: Joint angles, shape (K, n), in rad.
        position_m: Position, shape (K,), in m.
        speed_m_s: Velocity, shape (K,), in m/s.
        force_n: Force of the user, shape (K,), in N.
    """

    q: Array
    position_m: Array
    speed_m_s: Array
    force_n: Array


def _measure_tip(
    scenario: Scenario, records: dict[str, RecordBatch], window_s: tuple[float, float]
) -> _TipMotion | None:
    """Computes the motion of the user's end effector, and the force on it, within a window.

    The force F of the operator on the end effector is obtained from the operator's joint torque
    tau by solving J' F = tau, where J is the Jacobian of the end effector.

    Args:
        scenario: The scenario.
        records: All records of the run, by site.
        window_s: Start and end of the window, in s.

    Returns:
        The motion along x, or `None` if the run ends within the window.
    """
    start_ns, end_ns = (round(time_s * NS_PER_S) for time_s in window_s)
    if records[USER].t_ns[-1] < end_ns - NS_PER_S // scenario.sites[USER].rate_hz:
        return None
    record = records[USER].between(start_ns, end_ns)

    arm = build_arm_rows(scenario, USER)
    tip = arm.place_end_effector(record.q, record.qd)

    torque = _compute_hand_torque(scenario, USER, record)
    J_transposed = np.swapaxes(tip.J, 1, 2)
    torque_columns = torque[:, :, np.newaxis]
    force = np.linalg.solve(J_transposed, torque_columns).astype(np.float64)
    return _TipMotion(
        q=record.q,
        position_m=tip.position[:, 0],
        speed_m_s=tip.speed[:, 0],
        force_n=force[:, 0, 0],
    )


def _estimate_impedance(
    item: BenchRunItem, judged: JudgedRun, contact_s: float
) -> tuple[float, float] | None:
    """Estimates the impedance |Z| at `IMPEDANCE_HZ` that the user feels, with and without wall.

    The user's arm is excited by a small sinusoidal force along the normal of the wall. Z is the
    ratio of the phasors of the user's force and velocity along the normal. To exclude slow
    changes of the motion, each phasor is computed from the difference between the run with the
    sine and the same run without it. In the run in free motion there is no wall, and the user
    moves to the pose reached in contact, so the inertia of the arm is the same.

    Args:
        item: The run of the task `contact`.
        judged: The same run with its records.
        contact_s: Time of the first contact, in s.

    Returns:
        Both values of |Z|, in contact and in free motion, in N s/m. `None` if a run is too
        short or diverges.
    """
    start_s = contact_s + STIFFNESS_S
    end_s = start_s + IMPEDANCE_PERIODS / IMPEDANCE_HZ
    window_s = (start_s, end_s)
    without_sine = _measure_tip(judged.scenario, judged.records, window_s)
    if without_sine is None:
        return None

    # a sine of force along the normal of the wall, as torques of the joints
    pose_rad = without_sine.q.mean(axis=0)
    no_motion = np.zeros_like(pose_rad)
    arm = build_arm_rows(judged.scenario, USER)
    J = arm.place_end_effector(pose_rad[np.newaxis], no_motion[np.newaxis]).J[0]
    shaking = {
        "kind": "multisine",
        "amplitude_nm": (SHAKING_N * J[0]).tolist(),
        "frequencies_hz": [IMPEDANCE_HZ],
    }
    (hand,) = TASKS[item.cell.task].settings[f"sites.{USER}.hands"]
    hand_to_pose = {**hand, "to_rad": pose_rad.tolist()}
    no_wall: dict[str, Any] = {f"sites.{SLAVE}.environment": []}
    contact_with_sine = _run_window(item, {f"sites.{USER}.hands": [hand, shaking]}, window_s)
    free_hands = {f"sites.{USER}.hands": [hand_to_pose]}
    free_shaken_hands = {f"sites.{USER}.hands": [hand_to_pose, shaking]}
    free_without_sine = _run_window(item, no_wall | free_hands, window_s)
    free_with_sine = _run_window(item, no_wall | free_shaken_hands, window_s)
    if contact_with_sine is None or free_without_sine is None or free_with_sine is None:
        return None
    in_contact = _compute_impedance(contact_with_sine, without_sine)
    in_free_motion = _compute_impedance(free_with_sine, free_without_sine)
    return in_contact, in_free_motion


def _run_window(
    item: BenchRunItem, settings: Settings, window_s: tuple[float, float]
) -> _TipMotion | None:
    """Repeats a run with other settings, and returns the motion of the user's arm in a window.

    Args:
        item: The run.
        settings: Overrides of its scenario.
        window_s: Start and end of the window, in s. The run ends just after the window.

    Returns:
        The motion, or `None` if an arm left its limits.
    """
    variant = _run_variant(item, settings, window_s[1] + STIFFNESS_WINDOW_S)
    return None if variant is None else _measure_tip(*variant, window_s)


def _compute_impedance(shaken: _TipMotion, still: _TipMotion) -> float:
    """Computes the impedance |Z| that the user feels at one frequency, in N s/m.

    In one of two otherwise identical runs, the user's arm is excited by a sine. The difference
    between the runs is the response to the sine, and Z is the ratio of its force to its
    velocity.

    Args:
        shaken: Motion of and force on the user's end effector in the run with the sine.
        still: Motion and force in the run without the sine.
    """
    records = len(shaken.force_n)
    turns = IMPEDANCE_PERIODS * np.arange(records) / records
    # the product with this wave extracts the phasor at the frequency of the sine
    conjugate_wave = np.exp(-2j * np.pi * turns)
    force = np.dot(conjugate_wave, shaken.force_n - still.force_n)
    speed = np.dot(conjugate_wave, shaken.speed_m_s - still.speed_m_s)
    return float(np.abs(force) / np.abs(speed))


def _measure_error_rad(scenario: Scenario, records: dict[str, RecordBatch]) -> float:
    """Computes the RMS difference between the slave and the average of its users, in rad.

    The average is weighted with the dominance factors of the slave, which may change during the
    run. It uses the joint angles of the users at the same time, without the delay of the links.

    Args:
        scenario: The scenario.
        records: Records by site, which must cover the same times.
    """
    slave = records[SLAVE]
    t_s = slave.t_ns / NS_PER_S
    alpha = DominanceHistory.of_scenario(scenario, SLAVE, t_s).alpha
    reference: Array = np.zeros_like(slave.q)
    for index, peer in enumerate(scenario.peers(SLAVE)):
        weight = alpha[:, index, None]
        reference = reference + weight * records[peer].q
    error_rad = slave.q - reference
    return float(np.sqrt(np.mean(error_rad**2)))


ORIGIN_NAME = "origin.json"
JOURNAL_NAME = "runs.journal"


BenchFolder = StudyFolder[BenchPlan, RunJournal[BenchRun]]


def prepare_bench_folder(plan: BenchPlan, path: Path | None = None) -> BenchFolder:
    """Creates the folder of a benchmark, or reopens one that already has finished runs.

    Args:
        plan: Plan of the benchmark.
        path: The folder. If `None`, it is named after the study, as in runs/bench-full.

    Raises:
        UsageError: The folder cannot be created, has other content, or has runs that must not
            be mixed with new ones because they come from another program version or a machine
            with different rounding.
    """
    if path is None:
        path = Path("runs") / f"bench-{plan.study}"
        refuse_link(path)

    # A later call continues in the folder only with the same program and the same rounding.
    arithmetic, versions = describe_program()
    facts = {"arithmetic": arithmetic, **versions}
    origin = json.dumps(facts, indent=2) + "\n"
    origin_file = path / ORIGIN_NAME
    if origin_file.exists():
        _check_origin(path, origin_file.read_text(encoding="utf-8"), origin)
    else:
        make_results_folder(path, "", force=None)
        write_whole(origin_file, origin)

    remedy = RunJournal.build_resume_hint("bench", "--study", plan.study, "--out", str(path))
    journal_file = path / JOURNAL_NAME
    return StudyFolder(
        path=path,
        plan=plan,
        facts=facts,
        remedy=remedy,
        journal=lambda: RunJournal(journal_file, origin, BenchRun, remedy),
    )


def _check_origin(path: Path, folder_origin: str, origin: str) -> None:
    """Raises UsageError if a folder's runs come from another program version or arithmetic.

    Results of both would not be comparable, because the same scenario might give different
    results.

    Args:
        path: The folder.
        folder_origin: JSON text that describes the program that created the folder.
        origin: JSON text that describes this program.

    Raises:
        UsageError: The two texts differ.
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
    progress: Progress | None = None,
    *,
    confirm: bool = False,  # noqa: ARG001
) -> BenchResults:
    """Executes all benchmark runs that are not finished yet.

    Args:
        folder: Folder of the benchmark. Its journal contains the finished runs.
        jobs: Number of processes, as for `trilat_net.bench`.
        on: Cluster that executes the runs, as for `trilat_net.bench`.
        progress: Called with the number of finished runs and the total number of runs.
        confirm: Has no effect; accepted for compatibility with older programs. Every run that
            is not stable is repeated over twice its duration, because it may turn out to be
            stable.

    Returns:
        The results of all runs.

    Raises:
        RunFailed: A worker process died during a run, or the connection to the cluster is lost.
            Finished runs are kept in the journal.
    """
    plan = folder.plan
    items = [BenchRunItem(cell, seed) for cell in plan.cells for seed in cell.seeds]
    with folder.journal() as journal:
        done = journal.done
        pending = [item for item in items if (item.cell.key, item.seed) not in done]
        side_by_side = _choose_lanes(pending)
        obstacles = (side_by_side.get(_find_kind(item), "") for item in pending)
        alone = Counter(filter(None, obstacles))
        items = [
            item._replace(is_side_by_side=_find_kind(item) in side_by_side) for item in items
        ]
        _run_pending(journal, items, jobs, on, progress)

        repeated = []
        for item in items:
            run = journal.done[item.cell.key, item.seed]
            if run.needs_confirmation:
                # The records of several long runs would need too much memory.
                to_s = run.confirmation_s
                repeated.append(item._replace(to_s=to_s, is_side_by_side=False))
        _run_pending(journal, repeated, jobs, on, progress)
        return BenchResults(plan, dict(journal.done), alone)


def _find_kind(item: BenchRunItem) -> tuple[str, str, str]:
    """Returns a key that is equal for runs that differ only in numerical parameters."""
    return item.cell.form, item.cell.law, item.cell.task


RUNS_OF_A_JUDGEMENT = 8
"""Approximate number of simulations needed to judge a run: the run itself and its twins."""


def _choose_lanes(items: Sequence[BenchRunItem]) -> dict[tuple[str, str, str], str]:
    """Chooses the runs to compute side by side with other runs or with their own twins.

    Args:
        items: The runs to execute.

    Returns:
        The kinds of these runs, see `prepare_kinds`.
    """
    counts = Counter(map(_find_kind, items))
    kinds = {}
    for item in items:
        kind = _find_kind(item)
        if kind not in kinds:
            scenario = _build_scenario(item)
            kinds[kind] = RunKind(scenario, RUNS_OF_A_JUDGEMENT * counts[kind])
    return prepare_kinds(kinds)


def _run_pending(
    journal: RunJournal[BenchRun],
    items: list[BenchRunItem],
    jobs: int | None,
    on: Workers,
    progress: Progress | None,
) -> None:
    """Executes the runs that are not yet in the journal, and stores each one when it ends.

    An interrupted benchmark therefore continues where it stopped. Does nothing if the journal
    contains all runs.

    Args:
        journal: The finished runs.
        items: All runs that are needed.
        jobs: Number of processes.
        on: Cluster that executes the runs.
        progress: Called with the number of finished runs and the total number of runs.
    """
    pending = []
    for item in items:
        key = name_run(item.cell.key, item.to_s)
        if (key, item.seed) not in journal.done:
            pending.append(item)
    if not pending:
        return
    in_lanes = any(item.is_side_by_side for item in pending)
    hint = "; finished runs are kept: the same command continues"
    with WorkerPool.open(jobs, on, most=len(pending), hint=hint) as pool:
        journal.run_pending(
            pool,
            BenchRunItem.run,
            pending,
            done=len(items) - len(pending),
            total=len(items),
            show=progress,
            together=_run_bench_tasks if in_lanes else None,
            together_count=LANE_RUNS if in_lanes else 1,
        )

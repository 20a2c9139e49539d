"""One run of the suite: its judgement by its end and by its twins, and its numbers.

Invariant: a run's numbers are a function of its scenario. Errors, efforts and forces are those of the log
that its command makes, over the time of its task; what is judged lasts as long as the judgement needs.
"""

import math
from typing import NamedTuple

import msgspec
import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...analysis.dominance_history import evaluate_ramps
from ...analysis.run_end import (
    THROWN_RAD,
    EndBehaviour,
    RunEnd,
    RunTrace,
    Stability,
    classify_run_end,
)
from ...analysis.site_signals import SETTLED_ERROR_RAD
from ...analysis.torque_sources import list_walls, wall_force
from ...analysis.twin_growth import TwinGrowth, judge_end_by_twins, measure_virtual_twins
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...scenario import Scenario
from ...scenario.operators import ViscousEnvironment
from ..record_batches import RecordBatch, join_batches, run_compiled_in_batches
from ..tuning.candidate import load_tuning_scenario
from .bench_gains import name_settings
from .bench_plan import BenchCell
from .bench_tasks import SHORTER_REACH, TASKS

SLAVE, USER = "s", "m1"
LEAST_CONTACT_N = 1.0
"""A mean force of the wall below this, at the end, is no contact, N."""
BOUND_RAD_S = 5.0
"""No joint of a bounded run is faster, rad/s, and none further from its start than `THROWN_RAD`."""
PASSIVE_J = -1e-3
"""What hands, friction and wall have put into a passive run is never less, J."""
REST_S = 2.0
"""A run has converged if its arms stay within `SETTLED_ERROR_RAD` of their last pose for so long, s."""
TWINS = 3
"""Twins of a run of the first seed, pushed at all joints, at single ones, and in estimates; else one."""
TIME_CONSTANTS = 6.0
"""A run lasts for so many of its slowest time constants, but for no longer than"""
LONGEST_S = 100.0
"""this; so long, too, is the run that refutes or confirms one that is not stable, s."""


def name_run(key: str, to_s: float) -> str:
    """Returns what the runs of a cell are called in the journal; those that were made again, of their own."""
    return f"{key} to {to_s:g} s" if to_s else key


class BenchRun(msgspec.Struct, frozen=True):
    """One finished run of the suite.

    Attributes:
        name: of its cell, task/law/link.
        inputs: a digest of what the cell is made of.
        random: whether another seed would be another run.
        sha256: of its scenario.
        stability, behaviour: its judgement (docs/definitions.md), by its end and its twins.
        text: the judgement in words.
        length_s: how long the run was that is judged, s.
        to_s: it was made again for so long because it was not stable, s; 0: it was not.
        confirmed: whether that run was not stable either; None: there was none.
        bounded: no joint passed `BOUND_RAD_S`, or left its start by more than `THROWN_RAD`.
        energy_j: the least that hands, friction and wall had put in until any instant, J.
        settled_s: since when all arms stay where they end, s; None: not within the run.
        error_rad: RMS distance of the slave from its users, undelayed, weighted by dominance, over the time
            of the task; None where the run diverged, as the numbers below.
        effort_nm: RMS of tau - G(q) over sites and joints.
        hand_nm: RMS torque of the operators over joints, of the sites that have one.
        wall_n: mean force of the wall in the last quarter, N; None without a wall.
        force_peak_n: largest force of the wall, N.
        stiffness_n_m: what the user feels of the wall, by two reaches, N/m; None unless both come to rest.
    """

    name: str
    inputs: str
    seed: int
    random: bool
    sha256: str
    stability: Stability
    behaviour: EndBehaviour
    text: str
    length_s: float = 0.0
    to_s: float = 0.0
    confirmed: bool | None = None
    bounded: bool = False
    energy_j: float | None = None
    settled_s: float | None = None
    error_rad: float | None = None
    effort_nm: float | None = None
    hand_nm: float | None = None
    wall_n: float | None = None
    force_peak_n: float | None = None
    stiffness_n_m: float | None = None

    @property
    def cell(self) -> str:
        """Its cell, told apart from one of the same name with other gains, and from a longer run of it."""
        return name_run(f"{self.name} {self.inputs}", self.to_s)

    @property
    def doubtful(self) -> bool:
        """True if it is not stable, did not diverge, and is not as long as one that would confirm it."""
        diverged = self.behaviour is EndBehaviour.DIVERGED
        return self.stability is Stability.NOT_STABLE and not diverged and self.length_s < LONGEST_S

    @property
    def masked(self) -> bool:
        """True if it was to touch a wall, and did not: its numbers are those of free motion."""
        return self.wall_n is not None and self.wall_n < LEAST_CONTACT_N


class BenchRunTask(NamedTuple):
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


def run_bench_task(task: BenchRunTask) -> BenchRun:
    """Makes one run, in whatever process."""
    cell, scenario = task.cell, task.cell.build(task.seed).scenario
    twins = TWINS if task.seed == cell.seeds[0] else 1
    judged = _run(scenario, task.to_s or scenario.duration_s, twins)
    if not task.to_s:
        judged = _lengthen(judged, twins)
    made = BenchRun(
        cell.name,
        cell.inputs,
        task.seed,
        scenario.random,
        scenario.sha256,
        judged.stability,
        judged.end.behaviour,
        judged.text,
    )
    made = msgspec.structs.replace(made, length_s=judged.scenario.duration_s, to_s=task.to_s)
    if judged.end.diverged_at_s is None:
        made = _measure(made, judged, TASKS[cell.task].duration_s)
        if cell.task == "contact" and not made.masked:
            made = msgspec.structs.replace(made, stiffness_n_m=_find_stiffness(task, judged))
    return made


def _run(scenario: Scenario, length_s: float, twins: int) -> _JudgedRun:
    """Makes a run of so many seconds and its twins, and judges both."""
    scenario = msgspec.structs.replace(scenario, duration_s=length_s)
    kept: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    diverged_s = run_compiled_in_batches(scenario, {name: kept[name].append for name in kept})
    records = {name: join_batches(blocks) for name, blocks in kept.items()}
    trace = RunTrace(
        [one.reduce() for one in records.values()], [one.tau_x[-1] for one in records.values()], diverged_s
    )
    end, growth = classify_run_end(scenario, trace), TwinGrowth("none were asked for")
    if diverged_s is None and twins:
        growth = measure_virtual_twins(scenario, end, length_s, twins)
    found = judge_end_by_twins(end, growth, settles=None, rises=False)
    return _JudgedRun(scenario, records, end, growth, found.stability, found.reason or end.text)


def _lengthen(judged: _JudgedRun, twins: int) -> _JudgedRun:
    """Returns a run that lasts for its slowest time constants; not stable is what twice as long is, too."""
    length_s = judged.scenario.duration_s
    wanted_s = TIME_CONSTANTS * _find_time_constant_s(judged)
    if judged.stability is Stability.OPEN or wanted_s < LONGEST_S:
        wanted_s = min(wanted_s, LONGEST_S)
        if length_s < wanted_s and judged.end.diverged_at_s is None:
            length_s = float(math.ceil(wanted_s))
            judged = _run(judged.scenario, length_s, twins)
    if judged.stability is Stability.NOT_STABLE and judged.end.diverged_at_s is None:
        return _run(judged.scenario, 2.0 * length_s, twins)
    return judged


def _find_time_constant_s(judged: _JudgedRun) -> float:
    """Returns the slowest time constant that a run and its twins show, s; 0 where nothing falls."""
    rates = [judged.end.error.rate_per_s, judged.end.speed.rate_per_s]
    rates += [one.rate_per_s for one in judged.twins.pushes if one.factor > 0.0]
    return max((-1.0 / rate for rate in rates if rate < 0.0), default=0.0)


def _measure(made: BenchRun, judged: _JudgedRun, duration_s: float) -> BenchRun:
    scenario, whole = judged.scenario, judged.records
    records = {name: one.between(0, round(duration_s * NS_PER_S)) for name, one in whole.items()}
    efforts, hands, walls = [], [], []
    for name, record in records.items():
        spec, arm = scenario.sites[name], build_arm_rows(scenario, name)
        efforts.append(np.mean((record.tau - arm.gravity_torque(record.q)) ** 2))
        if spec.hands:
            hands.append(np.mean(_find_hand_torque(scenario, name, record) ** 2))
        tip, t_s = arm.place_end_effector(record.q, record.qd), record.t_ns / NS_PER_S
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
    """Returns the torque of the operators ON an arm, without the friction of its joints, shape (K, n)."""
    dampers = (one for one in scenario.sites[name].environment if isinstance(one, ViscousEnvironment))
    torque: Array = sum((np.array(one.damping_nm_s_rad) * record.qd for one in dampers), -record.tau_x)
    return torque


def find_least_energy(records: dict[str, RecordBatch]) -> float:
    """Returns the least over time of sum_i int -tau_x' qd dt: what came from outside until then, J.

    All arms begin at rest, so that of a passive network with passive controllers none is below zero.
    """
    power = sum(-np.sum(one.tau_x * one.qd, axis=1) for one in records.values())
    h_s = 1e-9 * np.diff(records[SLAVE].t_ns[:2])[0]
    return float(np.cumsum(np.concatenate([[0.0], 0.5 * h_s * (power[1:] + power[:-1])])).min())


def _find_settled_s(records: dict[str, RecordBatch]) -> float | None:
    """Returns since when every joint stays where it ends, s; None if that is too short a time ago."""
    last_s = 0.0
    for record in records.values():
        away = np.flatnonzero(np.abs(record.q - record.q[-1]).max(axis=1) > SETTLED_ERROR_RAD)
        last_s = max(last_s, record.t_ns[away[-1]] / NS_PER_S if len(away) else 0.0)
    return float(last_s) if last_s <= records[SLAVE].t_ns[-1] / NS_PER_S - REST_S else None


def _find_stiffness(task: BenchRunTask, far: _JudgedRun) -> float | None:
    """Returns by how much more the user has to push to get so much further, along the wall's normal, N/m."""
    built = task.cell.build(task.seed)
    short = load_tuning_scenario(built.source, (*built.overrides, *name_settings(SHORTER_REACH)))
    near = _run(short.scenario, far.scenario.duration_s, twins=0)
    if None in (_find_settled_s(near.records), _find_settled_s(far.records)):
        return None
    (near_m, near_n), (far_m, far_n) = _find_push(near), _find_push(far)
    return float((far_n - near_n) / (far_m - near_m))


def _find_push(judged: _JudgedRun) -> tuple[float, float]:
    """Returns of the last second where the user's end effector is along x, m, and how it is pushed, N."""
    scenario, record = judged.scenario, judged.records[USER].since(judged.records[USER].t_ns[-1] - NS_PER_S)
    tip = build_arm_rows(scenario, USER).place_end_effector(record.q, record.qd)
    torque = _find_hand_torque(scenario, USER, record)
    force = np.linalg.solve(np.swapaxes(tip.J, 1, 2), torque[:, :, np.newaxis])[:, 0, 0]
    return float(tip.at[:, 0].mean()), float(force.mean())


def _follow_error_rad(scenario: Scenario, records: dict[str, RecordBatch]) -> float:
    """Returns the RMS over ticks and joints of q_s - sum_j alpha_sj q_j."""
    peers, own = scenario.peers(SLAVE), records[SLAVE]
    start = np.array([scenario.dominance[SLAVE].get(peer, 0.0) for peer in peers])
    changes = [change for change in scenario.timeline if change.dominance == SLAVE]
    ramps = [scenario.ramp(SLAVE, change.shares, change.start_ns, change.ramp_s) for change in changes]
    t_s = own.t_ns / NS_PER_S
    alpha = evaluate_ramps(start, ramps, t_s, 1.0 / scenario.sites[SLAVE].rate_hz).alpha
    led: Array = sum(
        (alpha[:, n, None] * records[peer].q for n, peer in enumerate(peers)), np.zeros_like(own.q)
    )
    return float(np.sqrt(np.mean((own.q - led) ** 2)))

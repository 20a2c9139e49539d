"""One run of the suite: its judgement, errors, efforts, transparency, and the energies that a law declares.

Invariant: a run's numbers are a function of its scenario; they are those of the log that its command makes.
"""

from typing import NamedTuple

import msgspec
import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...analysis.certificate.observed_energy import observe_energies
from ...analysis.dominance_history import evaluate_ramps
from ...analysis.run_end import EndBehaviour, RunEnd, RunTrace, Stability, classify_run_end
from ...analysis.torque_sources import list_walls, wall_force
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...execution.virtual import simulate_scenario
from ...scenario import Scenario
from ...scenario.laws import LAWS
from ..record_batches import RecordBatch, join_batches, run_compiled_in_batches
from .bench_plan import BenchCell
from .bench_tasks import OBSERVED_LINKS

LEAST_CONTACT_NM = 0.05
"""A mean torque of the wall below this is no contact, N m."""
SLAVE = "s"


class BenchRun(msgspec.Struct, frozen=True):
    """One finished run of the suite.

    Attributes:
        name: of its cell, task/law/link.
        inputs: a digest of what the cell is made of.
        random: whether another seed would be another run.
        sha256: of its scenario.
        stability, behaviour: its judgement (docs/definitions.md).
        text: the judgement in words.
        error_rad: RMS distance of the slave from its users, undelayed, weighted by dominance; None
            where the run diverged, as the numbers below.
        effort_nm: RMS of tau - G(q) over sites and joints.
        hand_nm: RMS torque of the operators over joints, of the sites that have one.
        reflected: of the wall's mean torque in the last quarter the share that the user holds against; None
            without contact.
        force_peak_n: largest force of the wall; None without one.
        observed: what the energies that the law declares show, in the word of `certify`; "" where they were
            not looked at.
        least_j: the least of them, J.
    """

    name: str
    inputs: str
    seed: int
    random: bool
    sha256: str
    stability: Stability
    behaviour: EndBehaviour
    text: str
    error_rad: float | None = None
    effort_nm: float | None = None
    hand_nm: float | None = None
    reflected: float | None = None
    force_peak_n: float | None = None
    observed: str = ""
    least_j: float | None = None

    @property
    def cell(self) -> str:
        """Its cell, told apart from one of the same name with other gains."""
        return f"{self.name} {self.inputs}"


class BenchRunTask(NamedTuple):
    """One run to be made: picklable, with all that a worker needs."""

    cell: BenchCell
    seed: int

    def __str__(self) -> str:
        return f"{self.cell.name}, seed {self.seed}"


def run_bench_task(task: BenchRunTask) -> BenchRun:
    """Makes one run, in whatever process."""
    scenario = task.cell.build(task.seed).scenario
    kept: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    diverged_s = run_compiled_in_batches(scenario, {name: kept[name].append for name in kept})
    records = {name: join_batches(blocks) for name, blocks in kept.items()}
    trace = RunTrace(
        [one.reduce() for one in records.values()], [one.tau_x[-1] for one in records.values()], diverged_s
    )
    made = _judge(task, scenario, classify_run_end(scenario, trace))
    if diverged_s is None:
        made = _measure(made, scenario, records)
    cell = task.cell
    if task.seed == cell.seeds[0] and cell.link in OBSERVED_LINKS and declares_energies(cell.law):
        made = _observe(made, scenario)
    return made


def _judge(task: BenchRunTask, scenario: Scenario, end: RunEnd) -> BenchRun:
    cell, found = task.cell, (end.stability, end.behaviour, end.text)
    return BenchRun(cell.name, cell.inputs, task.seed, scenario.random, scenario.sha256, *found)


def _measure(made: BenchRun, scenario: Scenario, records: dict[str, RecordBatch]) -> BenchRun:
    efforts, hands, forces = [], [], []
    for name, record in records.items():
        spec, arm = scenario.sites[name], build_arm_rows(scenario, name)
        efforts.append(np.mean((record.tau - arm.gravity_torque(record.q)) ** 2))
        if spec.hands:
            hands.append(np.mean(record.tau_x**2))
        if walls := list_walls(spec):
            tip, t_s = arm.place_end_effector(record.q, record.qd), record.t_ns / NS_PER_S
            forces.append(float(np.max([wall_force(wall, t_s, tip).max() for wall in walls])))
    return msgspec.structs.replace(
        made,
        error_rad=_follow_error_rad(scenario, records),
        effort_nm=float(np.sqrt(np.mean(efforts))),
        hand_nm=float(np.sqrt(np.mean(hands))),
        reflected=_reflected_share(scenario, records),
        force_peak_n=max(forces, default=None),
    )


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


def _reflected_share(scenario: Scenario, records: dict[str, RecordBatch]) -> float | None:
    """Returns the share of the wall's torque that the users hold against, along that torque."""
    if not scenario.sites[SLAVE].environment:
        return None
    held = sum(_last_torque(records[name]) for name, spec in scenario.sites.items() if spec.hands)
    wall = _last_torque(records[SLAVE])
    size = float(np.linalg.norm(wall))
    return None if size < LEAST_CONTACT_NM else float(-np.dot(held, wall) / size**2)


def _last_torque(record: RecordBatch) -> Array:
    """Returns the mean torque ON an arm in the last quarter of a run, N m."""
    mean: Array = -record.tau_x[3 * len(record.tau_x) // 4 :].mean(axis=0)
    return mean


def declares_energies(law: str) -> bool:
    """Returns whether a law declares the energies by which it is proved passive."""
    return callable(getattr(getattr(LAWS.get(law), "core_class", None), "energies", None))


def _observe(made: BenchRun, scenario: Scenario) -> BenchRun:
    found = observe_energies(simulate_scenario(scenario))
    if found is None:
        return made
    least = min((one.amount_j for one in found.least), default=None)
    return msgspec.structs.replace(made, observed=found.finding.value, least_j=least)

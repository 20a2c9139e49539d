"""One candidate of a tuning: its scenario and command, its run in virtual time, its score, and
where it ends.

Where the arms of a comparison ought to end is the consensus of weightless arms: before any
operator acts q* = sum_i beta_i q_i(0), beta the left Perron vector of the dominance matrix: the
limit of x_i' = sum_j alpha_ij x_j - x_i. Spring operators move it to q* = sum_i beta_i K_i x_i
/ sum_i beta_i K_i, per joint, with target x_i and stiffness K_i of the operator at site i,
since sum_i beta_i tau_i = 0 in statics. After they let go it stays. Torques without a target
and walls ask for no pose: such a scenario is judged on its twin, the same without them.

Invariant: a candidate's scenario is loaded through the same settings that its command names,
and its score is a function of the scenario alone: None for the errors of a run that does not
reach its end. No gain and no control law enters the pose. A run has exactly one class, and only
a settled one may stand on a front: one that is stable by the judgement of every run
(`analysis.run_end`), at the pose. Arms that hang, however well together, have strayed. An arm
hangs if both links point down at the end and did not at the start; arms fell if their mean ends
more than 0.2 rad from the pose in a log without a push that could explain it.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...analysis.dominance_history import find_closed_groups, left_perron_vector
from ...analysis.run_end import EndBehaviour, RunEnd, Stability, find_hanging_sites
from ...analysis.site_signals import SETTLED_ERROR_RAD
from ...analysis.torque_sources import compute_target_motion
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...errors import ScenarioError
from ...log.log_reader import Log
from ...scenario import Scenario, parse_scenario
from ...scenario.expect import END_WINDOW_S
from ...scenario.operators.kernel_operators import JointSpring, Wall
from ...scenario.scenario_reader import ExperimentText, read_experiment
from ...scenario.validate import refuse_live_only
from ..intervals import mean_interval
from ..measure_run import RecordBatch, run_whole
from ..study_folder import format_command, format_toml_value, set_options
from .search_space import GainValues, ModelInformation, SearchSpace, SiteControls

CONFLICT_RAD = 0.02
"""Operators whose targets are further from the consensus than this hold the arms apart."""
_LOOK_HZ = 100.0


def check_comparable(scenario: Scenario) -> None:
    """Refuses a scenario in which laws cannot be compared fairly.

    Raises:
        ScenarioError: says why, and what would be right.
    """
    refuse_live_only(scenario)
    if any(spec.task.shared for spec in scenario.sites.values()):
        raise ScenarioError(
            "laws are compared by the distance of joint angles, and here end effectors agree: take a "
            "scenario in joint space",
            path="task.space",
            source=scenario.name,
        )
    groups = find_closed_groups(scenario.alpha)
    if len(groups) > 1:
        words = " and ".join(
            ", ".join(scenario.names[site] for site in group) for group in groups
        )
        raise ScenarioError(
            f"these groups follow no other site: {words}; there is no pose that all would reach",
            path="dominance",
            source=scenario.name,
        )
    t_s = np.arange(0.0, scenario.duration_s, 1.0 / _LOOK_HZ)
    pose = compute_consensus_pose(scenario, t_s)
    for name, stiffness, on, target in _follow_springs(scenario, t_s):
        apart = np.abs(target - pose) * on * (stiffness > 0.0)
        if apart.max(initial=0.0) > CONFLICT_RAD:
            at_s = t_s[apart.max(axis=1).argmax()]
            raise ScenarioError(
                f"at {at_s:g} s this hand wants another pose than others do: no law can bring the arms "
                "together, and their distance says nothing of the law; keep one of the operators",
                path=f"sites.{name}.hands",
                source=scenario.name,
            )


def build_twin(scenario: Scenario) -> Scenario | None:
    """Returns the same without torques that have no target, and without walls; None where it
    has neither.
    """
    sites = {}
    for name, spec in scenario.sites.items():
        hands = tuple(hand for hand in spec.hands if isinstance(hand, JointSpring))
        environment = tuple(one for one in spec.environment if not isinstance(one, Wall))
        sites[name] = msgspec.structs.replace(spec, hands=hands, environment=environment)
    return None if sites == scenario.sites else msgspec.structs.replace(scenario, sites=sites)


def compute_consensus_pose(scenario: Scenario, t_s: Array) -> Array:
    """Returns q*, the pose of a weightless consensus, shape (K, n), rad, at times of shape
    (K,), s.
    """
    beta = left_perron_vector(scenario.alpha)
    weights = dict(zip(scenario.names, beta, strict=True))
    start = np.sum(
        [weights[name] * np.array(spec.q0_rad) for name, spec in scenario.sites.items()], axis=0
    )
    stiffness = np.zeros((len(t_s), len(start)))
    torque = np.zeros((len(t_s), len(start)))
    for name, spring, on, target in _follow_springs(scenario, t_s):
        pull = weights[name] * spring * on
        stiffness += pull
        torque += pull * target
    held = stiffness > 0.0
    rows = np.vstack(
        [start, np.divide(torque, stiffness, where=held, out=np.zeros_like(torque))]
    )
    last = np.maximum.accumulate(
        np.where(held, np.arange(1, len(t_s) + 1)[:, np.newaxis], 0), axis=0
    )
    return np.take_along_axis(rows, last, axis=0)


def _follow_springs(
    scenario: Scenario, t_s: Array
) -> Iterator[tuple[str, Array, Array, Array]]:
    """Yields each spring's site, stiffness, where it is at work, 0 or 1, shape (K, 1), and
    target, rad.
    """
    for name, spec in scenario.sites.items():
        for hand in (hand for hand in spec.hands if isinstance(hand, JointSpring)):
            on = ((t_s >= hand.start_s) & (t_s < hand.end_s))[:, np.newaxis].astype(np.float64)
            yield (
                name,
                np.array(hand.stiffness_nm_rad),
                on,
                compute_target_motion(hand.actor, t_s)[0],
            )


STRAYED_RAD = 0.2
"""Arms whose mean is further than this from where they ought to be fell, hang, or were thrown
there.
"""
TOGETHER_RAD = 0.02
"""Arms no further than this from their mean are together."""


class CandidateClass(StrEnum):
    """Class of a candidate, from the worst to the best, in the order in which it is asked; as
    in JSON.
    """

    DIVERGED = "diverged"
    OSCILLATED = "oscillated"
    STRAYED = "strayed"
    APART = "apart"
    OPEN = "open"
    SETTLED = "settled"

    @property
    def word(self) -> str:
        """The word for people: that of the judgement, where the judgement decides."""
        words = {
            CandidateClass.OSCILLATED: Stability.NOT_STABLE,
            CandidateClass.SETTLED: Stability.STABLE,
        }
        return words.get(self, self).value


CLASS_MEANINGS = {
    CandidateClass.DIVERGED: "not stable: a joint left the speed limit",
    CandidateClass.OSCILLATED: "it swings on, drifts or grows",
    CandidateClass.STRAYED: f"the mean pose ends more than {STRAYED_RAD} rad from where a weightless "
    "consensus stands, or would after as long again: the arms fell, hang, sink, or were thrown there",
    CandidateClass.APART: f"an arm ends more than {TOGETHER_RAD} rad from the mean of all",
    CandidateClass.OPEN: "it hardly decays, or is undecided: a longer run may tell",
    CandidateClass.SETTLED: "it converged or decays, and none of these holds",
}
"""What the classes mean, as far as the judgement of a run (docs/definitions.md) does not say
it.
"""


def classify_candidate(
    ends: Sequence[RunEnd], fall_rad: float, apart_rad: float
) -> CandidateClass:
    """Returns the class of a candidate.

    Args:
        ends: the judgements of its run and of its twin; where it has none, the same twice.
        fall_rad: largest distance, over joints, of the twin's mean pose from q*, after as long
            again at the pace at which it grew in the second half.
        apart_rad: largest distance of a joint from the mean of the sites in that second.
    """
    found = {end.stability for end in ends}
    if any(end.behaviour is EndBehaviour.DIVERGED for end in ends):
        return CandidateClass.DIVERGED
    if Stability.NOT_STABLE in found:
        return CandidateClass.OSCILLATED
    if fall_rad > STRAYED_RAD:
        return CandidateClass.STRAYED
    if apart_rad > TOGETHER_RAD:
        return CandidateClass.APART
    return CandidateClass.OPEN if Stability.OPEN in found else CandidateClass.SETTLED


_SHORT_S = 0.5
_LOOKS = 2000


def check_final_posture(log: Log) -> list[str]:
    """Returns what to say of how a log ended, a sentence each; nothing where its arms stand at
    its end.

    Raises:
        LogError: a record cannot be read.
    """
    diverged = [s for s in log.sites if len(log[s]) and log[s].record(-1).mode == "diverged"]
    if diverged:
        return [f"{', '.join(diverged)} diverged: its figures end there"]
    parts = {site: log[site] for site in log.sites if len(log[site])}
    ends = {
        site: part.q[part.t_s > part.t_s[-1] - END_WINDOW_S].mean(axis=0)
        for site, part in parts.items()
    }
    warnings = []
    last_s = min((float(part.t_s[-1]) for part in parts.values()), default=0.0)
    wanted_s = log.scenario.duration_s
    if last_s <= wanted_s - _SHORT_S:
        warnings.append(
            f"ends at {last_s:.4g} s of {wanted_s:g} s: its figures are of a shorter run"
        )
    hanging = find_hanging_sites(log.scenario, ends)
    if not hanging:
        return [*warnings, *_warn_fallen(log, ends)]
    verb = "hangs" if len(hanging) == 1 else "hang"
    why = "small errors and torques of arms that hang say nothing of a law"
    return [*warnings, f"{', '.join(hanging)} {verb} at the end: {why}"]


def _warn_fallen(log: Log, ends: dict[str, Array]) -> list[str]:
    """Warns if the mean pose left the consensus, and no operator or environment can be the
    cause.
    """
    scenario = log.scenario
    try:
        check_comparable(scenario)
    except ScenarioError:  # there is no one pose to speak of
        return []
    if build_twin(scenario) is not None or len(ends) < len(scenario.names):
        return []
    t_s = np.linspace(0.0, min(float(log[site].t_s[-1]) for site in ends), _LOOKS)
    away = np.mean(list(ends.values()), axis=0) - compute_consensus_pose(scenario, t_s)[-1]
    joint = int(np.abs(away).argmax())
    if abs(away[joint]) <= STRAYED_RAD:
        return []
    return [
        f"the arms end {abs(away[joint]):.2g} rad (joint {joint + 1}) from where a weightless consensus "
        "would stand: they sank, or drifted"
    ]


class CandidateScore(msgspec.Struct, frozen=True):
    """One candidate, measured; the formulas stand in docs/fair-comparison.md.

    Attributes:
        outcome: its class.
        error_rad: RMS distance of the arms from where they ought to be; None where the run
            diverged.
        spread_rad: the part of it that is the arms' distance from each other, at one instant,
            undelayed.
        pose_rad: the part of it that is the distance of their mean from the pose.
        effort_nm: RMS torque beyond what gravity asks at the pose where the arm is.
        settled_s: since when the largest |e| is below 0.01 rad; None where it is not at the
            end.
        saturated: share of all joint torques that were at the clamp.
        diverged_s: when the first site left its limits, or None.
        seeds: how many runs it is the mean of; its outcome is the worst of theirs.
        error_half_rad, effort_half_nm: half the width of the 95 % interval of that mean; None
        of one run.
    """

    outcome: CandidateClass
    error_rad: float | None
    spread_rad: float | None
    pose_rad: float | None
    effort_nm: float | None
    settled_s: float | None
    saturated: float
    diverged_s: float | None = None
    seeds: int = 1
    error_half_rad: float | None = None
    effort_half_nm: float | None = None


def average_scores(scores: Sequence[CandidateScore]) -> CandidateScore:
    """Returns the score of a candidate from those of its seeds; a number that one of them lacks
    is None.
    """
    if len(scores) == 1:
        return scores[0]
    rank = list(CandidateClass)
    worst = min(scores, key=lambda score: rank.index(score.outcome))
    named = ("error_rad", "spread_rad", "pose_rad", "effort_nm", "settled_s", "saturated")
    means = {name: mean_interval([getattr(score, name) for score in scores]) for name in named}
    error = means["error_rad"]
    effort = means["effort_nm"]
    return msgspec.structs.replace(
        worst,
        **{name: mean and mean.mean for name, mean in means.items()},
        seeds=len(scores),
        error_half_rad=error and error.half,
        effort_half_nm=effort and effort.half,
    )


def measure_candidate(text: str, twin_text: str | None) -> CandidateScore:
    """Runs a candidate and its twin, and returns its score."""
    run = _run(parse_scenario(text))
    alone = run if twin_text is None else _run(parse_scenario(twin_text))
    outcome = classify_candidate((run.end, alone.end), alone.fall_rad, alone.apart_rad)
    diverged_s = [
        end.diverged_at_s for end in (run.end, alone.end) if end.diverged_at_s is not None
    ]
    if diverged_s:
        return CandidateScore(
            outcome, None, None, None, None, None, run.saturated, diverged_s[0]
        )
    error_rad = float(np.hypot(run.spread_rad, alone.pose_rad))
    return CandidateScore(
        outcome,
        error_rad,
        run.spread_rad,
        alone.pose_rad,
        run.effort_nm,
        run.settled_s,
        run.saturated,
    )


class _Run(NamedTuple):
    """What is measured of one run; `fall_rad` and `apart_rad` as `classify_candidate` takes
    them.
    """

    end: RunEnd
    fall_rad: float
    apart_rad: float
    spread_rad: float
    pose_rad: float
    effort_nm: float
    settled_s: float | None
    saturated: float


def _run(scenario: Scenario) -> _Run:
    of_site, end = run_whole(scenario)
    records = list(of_site.values())
    t_s, q, e = _aligned(records)
    mean = q.mean(axis=0)
    apart = q - mean
    off = mean - compute_consensus_pose(scenario, t_s)
    last = t_s > t_s[-1] - END_WINDOW_S
    half_s = 0.5 * t_s[-1]
    middle = (t_s > half_s - END_WINDOW_S) & (t_s <= half_s + 1e-9)
    end_rad, before_rad = (np.abs(off[part].mean(axis=0)) for part in (last, middle))
    largest = np.abs(e).max(axis=(0, 2))
    apart_at_s = t_s[largest >= SETTLED_ERROR_RAD].max(initial=0.0)
    efforts = []
    saturated = []
    for record, site in zip(records, scenario.names, strict=True):
        beyond_nm = record.tau - build_arm_rows(scenario, site).gravity_torque(record.q)
        efforts.append(np.mean(beyond_nm**2))
        saturated.append(
            np.mean(np.abs(record.tau) >= scenario.sites[site].limits.tau_limit_nm)
        )
    return _Run(
        end=end,
        fall_rad=float((end_rad + 2.0 * np.maximum(end_rad - before_rad, 0.0)).max()),
        apart_rad=float(np.abs(apart[:, last]).max()),
        spread_rad=_rms(apart),
        pose_rad=_rms(off),
        effort_nm=float(np.sqrt(np.mean(efforts))),
        settled_s=float(apart_at_s) if largest[-1] < SETTLED_ERROR_RAD else None,
        saturated=float(np.mean(saturated)),
    )


def _aligned(records: list[RecordBatch]) -> tuple[Array, Array, Array]:
    """Returns the ticks of the slowest site, s, and every site's latest q and e at them, shape
    (N, K, n).
    """
    end_ns = min(record.t_ns[-1] for record in records)
    slowest = min((record.t_ns for record in records), key=len)
    at_ns = slowest[slowest <= end_ns]
    latest = [np.searchsorted(record.t_ns, at_ns, side="right") - 1 for record in records]
    q = np.array([record.q[rows] for record, rows in zip(records, latest, strict=True)])
    e = np.array([record.e[rows] for record, rows in zip(records, latest, strict=True)])
    return at_ns / NS_PER_S, q, e


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


class TuningScenario(NamedTuple):
    """The experiment in which laws are compared; a command calls it by source and overrides
    KEY=VALUE.
    """

    written: ExperimentText
    overrides: tuple[str, ...]
    scenario: Scenario

    @property
    def source(self) -> str:
        """What a command calls it."""
        return self.written.label

    def with_controls(self, controls: SiteControls) -> "TuningScenario":
        """Returns the same with the control of every site replaced, in as few settings as say
        it.
        """
        single = [
            f"sites.{name}.control={format_toml_value(table)}"
            for name, table in controls.items()
        ]
        wanted = self.written.load([*self.overrides, *single])
        first = next(iter(controls.values()))
        if all(table == first for table in controls.values()):
            texts = (*self.overrides, f"control={format_toml_value(first)}")
            # a site has gains of its own, which are none of this law
            with suppress(ScenarioError):
                scenario = self.written.load(texts)
                if scenario.sites == wanted.sites:
                    return TuningScenario(self.written, texts, scenario)
        return TuningScenario(self.written, (*self.overrides, *single), wanted)

    def with_gains(
        self, space: SearchSpace, knowledge: ModelInformation, gains: GainValues
    ) -> "TuningScenario":
        """Returns the same under a law with a choice of gains."""
        return self.with_controls(space.controls(self.scenario, knowledge, gains))

    @property
    def texts(self) -> tuple[str, str | None]:
        """The canonical texts of its scenario and of its twin."""
        alone = build_twin(self.scenario)
        return self.scenario.text, None if alone is None else alone.text

    @property
    def command(self) -> str:
        """The command that makes a log of it."""
        return format_command("sim", self.source, *set_options(self.overrides))


class CandidateItem(NamedTuple):
    """One candidate to be run.

    Attributes:
        runs: of each seed the canonical texts of its scenario and of its twin.
        name: what it is called.
    """

    runs: tuple[tuple[str, str | None], ...]
    name: str

    def __str__(self) -> str:
        return self.name


def build_candidate_item(seeds: Sequence[TuningScenario]) -> CandidateItem:
    """Returns what has to be run to measure one candidate, given with every seed."""
    name = ", ".join(seeds[0].overrides) or seeds[0].source
    return CandidateItem(tuple(one.texts for one in seeds), name)


def measure_candidate_task(task: CandidateItem) -> CandidateScore:
    """Runs one task, in whatever process."""
    return average_scores([measure_candidate(*run) for run in task.runs])


def load_tuning_scenario(
    source: str | Path | Mapping[str, Any] | Scenario, overrides: Sequence[str] = ()
) -> TuningScenario:
    """Returns the experiment that a name, a path, a text, tables or a scenario mean with
    overrides.

    Raises:
        ScenarioError: there is none.
    """
    written = read_experiment(source)
    return TuningScenario(written, tuple(overrides), written.load(overrides))

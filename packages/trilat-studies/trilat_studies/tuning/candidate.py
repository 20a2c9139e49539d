"""Runs and scores one candidate of a tuning: a control law with chosen gains.

The score contains the error, the motor effort, and a class that states how well the arms
behaved. The error is the distance of the arms from the consensus pose q*, on which the arms
would agree in the absence of gravity:

- Before any operator acts, q* = sum_i beta_i q_i(0), where q_i(0) are the joint angles of arm i
  at the start, in rad.
- While operators pull at arms like springs, q* = sum_i beta_i K_i x_i / sum_i beta_i K_i for
  each joint. The operator at arm i has the target x_i, in rad, and the stiffness K_i, in N
  m/rad.
- After the operators have released the arms, q* keeps its value.

Here beta_i is the influence of arm i. It is determined from the dominance factors alpha_ij, the
weights with which arm i follows arm j, by beta' alpha = beta' with sum_i beta_i = 1.

A law may have a target motion other than agreement at q*, see `LawSettings.target_motion`. The
distance of each arm from the target motion then replaces the distance between the arms in the
error, and a run is classified by how far the arms end from this motion. The distance of the
mean from q* remains part of the error, so that arms that do not move at all have a large error.

Walls, and operators who push without a target, do not determine a final pose. A scenario that
contains them is also run without them, to find the pose at which the arms would come to rest.
This second scenario is called the twin of the first.

Invariant:
    - A score depends only on the scenario. The errors of a run that does not reach its end are
      `None`.
    - Neither gains nor control laws influence q*.
    - Only settled runs, which are stable and end at q* or at the end of the target motion of
      their law, may be part of a Pareto front.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.analysis import (
    SETTLED_ERROR_RAD,
    DominanceHistory,
    EndBehaviour,
    RunEnd,
    SourceRows,
    Stability,
    build_arm_rows,
)
from trilat_net.core import Array, DominanceMatrix, TorqueKind
from trilat_net.errors import CodeFailed, ScenarioError
from trilat_net.laws import LawSettings, TuningRun
from trilat_net.log import Log
from trilat_net.records import NS_PER_S
from trilat_net.scenario import END_WINDOW_S, ExperimentText, Scenario, parse_embedded
from trilat_net.work import MeanInterval

from ..record_batches import RecordBatch, WholeRun
from ..run_commands import format_command, format_toml_value, set_options
from .search_space import GainValues, ModelInformation, SearchSpace, SiteControls

CONFLICT_RAD = 0.02
"""Distance from q*, in rad, beyond which the target of an operator keeps the arms apart."""
_POSE_SAMPLES_HZ = 100.0
"""Sampling rate at which the targets of operators are compared with q*."""


def check_comparable(scenario: Scenario) -> None:
    """Raises ScenarioError if control laws cannot be compared fairly in a scenario.

    The error of a law is measured from the pose on which the arms should agree, so the scenario
    must determine a pose that all arms can reach.

    Args:
        scenario: The scenario in which laws are to be compared.

    Raises:
        ScenarioError: The scenario is rejected. The message states the reason and a remedy.
    """
    scenario.refuse_live_only()
    if any(spec.task.shared for spec in scenario.sites.values()):
        raise ScenarioError(
            "laws are compared by the distance between joint angles, but in this scenario the "
            "end effectors are synchronised: choose a scenario in joint space",
            path="task.space",
            source=scenario.name,
        )

    # Sites that follow only each other never move towards the other sites.
    groups = DominanceMatrix(scenario.alpha).closed_groups
    if len(groups) > 1:
        group_names = [", ".join(scenario.names[site] for site in group) for group in groups]
        raise ScenarioError(
            f"these groups of sites do not follow each other: {' and '.join(group_names)}; "
            "the sites therefore have no common pose",
            path="dominance",
            source=scenario.name,
        )

    # An operator that pulls away from the common pose keeps the arms separate.
    t_s = np.arange(0.0, scenario.duration_s, 1.0 / _POSE_SAMPLES_HZ)
    pose_rad = compute_consensus_pose(scenario, t_s)
    for spring in _list_springs(scenario, t_s):
        has_stiffness = spring.stiffness_nm_rad > 0.0
        pulls = spring.acts * has_stiffness
        conflict_rad = np.abs(spring.target_rad - pose_rad) * pulls
        if conflict_rad.max(initial=0.0) > CONFLICT_RAD:
            largest_rad = conflict_rad.max(axis=1)
            worst_s = t_s[largest_rad.argmax()]
            raise ScenarioError(
                f"at {worst_s:g} s this hand pulls towards a different pose from the other "
                "hands: no law can bring the arms together, so their distance says nothing "
                "about the law; keep only one of the operators",
                path=f"sites.{spring.site}.hands",
                source=scenario.name,
            )


def build_twin(scenario: Scenario) -> Scenario | None:
    """Derives the scenario that shows at which pose the arms would come to rest undisturbed.

    Walls, and operators who push without a target pose, keep the arms away from that pose. The
    derived scenario, called the twin, excludes them. The pose at the end of its run depends
    only on the dominance factors and on the targets.

    Args:
        scenario: Scenario of the candidate.

    Returns:
        The twin, or `None` if the scenario has neither walls nor operators who push without a
        target pose, and therefore needs no twin.
    """
    sites = {}
    for name, spec in scenario.sites.items():
        hands = tuple(hand for hand in spec.hands if hand.actor.kind is TorqueKind.HAND)
        environment = tuple(
            part for part in spec.environment if part.actor.kind is not TorqueKind.WALL
        )
        sites[name] = msgspec.structs.replace(spec, hands=hands, environment=environment)
    if sites == scenario.sites:
        return None
    return msgspec.structs.replace(scenario, sites=sites)


def compute_consensus_pose(scenario: Scenario, t_s: Array) -> Array:
    """Computes q*, the pose on which the arms would agree in the absence of gravity.

    While operators pull the arms like springs towards target poses, each joint of q* is an
    average of the targets, weighted by the stiffness of the operators and the influence of
    their arms. Before any operator pulls, q* is the weighted average of the start poses. After
    the last operator has released its arm, q* keeps its value.

    Args:
        scenario: Scenario with the arms, their operators and the dominance factors.
        t_s: Times, shape (K,), in s.

    Returns:
        The pose at the K times, shape (K, n), in rad, for n joints.
    """
    beta = DominanceMatrix(scenario.alpha).find_pi()
    weights = dict(zip(scenario.names, beta, strict=True))
    weighted_starts = []
    for name, spec in scenario.sites.items():
        q0_rad = np.array(spec.q0_rad)
        weighted_starts.append(weights[name] * q0_rad)
    start_rad = np.sum(weighted_starts, axis=0)

    shape = (len(t_s), len(start_rad))
    stiffness = np.zeros(shape)
    weighted_target = np.zeros(shape)
    for spring in _list_springs(scenario, t_s):
        weight = weights[spring.site]
        weighted_stiffness = weight * spring.stiffness_nm_rad * spring.acts
        stiffness += weighted_stiffness
        weighted_target += weighted_stiffness * spring.target_rad
    is_held = stiffness > 0.0
    zeros = np.zeros_like(weighted_target)
    held_pose_rad = np.divide(weighted_target, stiffness, where=is_held, out=zeros)

    # A joint keeps the pose of the last time at which a spring held it. Row 0 is the start
    # pose, for joints that no spring has held yet.
    poses_rad = np.vstack([start_rad, held_pose_rad])
    row_numbers = np.arange(1, len(t_s) + 1)[:, np.newaxis]
    held_rows = np.where(is_held, row_numbers, 0)
    last_held = np.maximum.accumulate(held_rows, axis=0)
    return np.take_along_axis(poses_rad, last_held, axis=0)


class _SpringHistory(NamedTuple):
    """An operator's spring-like pull towards a target pose, sampled at K times.

    The consensus pose q* is computed from the springs of all operators.

    Attributes:
        site: Site of the operator.
        stiffness_nm_rad: Stiffness per joint, shape (n,), in N m/rad.
        acts: 1 while the spring acts and 0 otherwise, shape (K, 1).
        target_rad: Target pose, shape (K, n), in rad.
    """

    site: str
    stiffness_nm_rad: Array
    acts: Array
    target_rad: Array


def _list_springs(scenario: Scenario, t_s: Array) -> Iterator[_SpringHistory]:
    """Yields the operators that pull an arm like a spring, for the consensus pose.

    Args:
        scenario: Scenario in which the laws are compared.
        t_s: Times, shape (K,), in s.

    Yields:
        Stiffness and target of each spring at these times, and whether it acts.
    """
    for name, spec in scenario.sites.items():
        for hand in spec.hands:
            source = hand.actor
            if source.kind is not TorqueKind.HAND:
                continue
            acts = (t_s >= source.start_s) & (t_s < source.end_s)
            target_rad, _ = SourceRows(source).find_target_motion(t_s)
            yield _SpringHistory(
                site=name,
                stiffness_nm_rad=np.array(source.K),
                acts=acts[:, np.newaxis].astype(np.float64),
                target_rad=target_rad,
            )


STRAYED_RAD = 0.2
"""Distance of the arms' mean pose from q*, in rad, beyond which the arms have strayed because
they fell, hang down or were thrown.
"""
TOGETHER_RAD = 0.02
"""Largest distance of a joint from the arms' mean, in rad, at which the arms still agree."""


class CandidateClass(StrEnum):
    """How the arms behave with a control law and chosen gains, from worst to best.

    If several classes apply to a run, the first one counts. `CLASS_MEANINGS` explains each
    class. The values are the words that appear in JSON files.
    """

    DIVERGED = "diverged"
    OSCILLATED = "oscillated"
    STRAYED = "strayed"
    APART = "apart"
    OPEN = "open"
    SETTLED = "settled"

    @property
    def word(self) -> str:
        """Word for the class in printed text, such as "stable".

        Where possible, this is the word used in the verdict on a single run.
        """
        if self is CandidateClass.OSCILLATED:
            return Stability.NOT_STABLE.value
        if self is CandidateClass.SETTLED:
            return Stability.STABLE.value
        return self.value

    @classmethod
    def classify(
        cls, ends: Sequence[RunEnd], fall_rad: float, apart_rad: float
    ) -> "CandidateClass":
        """Classifies how the arms behave with a control law and chosen gains.

        If the scenario has walls or operators who push without a target pose, a second run
        without them shows at which pose the arms would come to rest undisturbed. The arms
        should rest near the consensus pose q*, which is computed from the targets of the other
        operators.

        Args:
            ends: Analysis of the end of the run and of the second run. If there is no second
                run, the first one is passed twice.
            fall_rad: Predicted distance of the arms' mean pose from q* at the end of a run
                twice as long, in rad, for the joint with the largest distance. If the law has a
                target motion of its own (`LawSettings.target_motion`), the distance from the
                mean of that motion.
            apart_rad: Largest distance of a joint from the mean of all arms in the last second,
                in rad. If the law has a target motion of its own, the distance from that
                motion.

        Returns:
            The worst class that applies to one of the runs.
        """
        stabilities = {end.stability for end in ends}
        if any(end.behaviour is EndBehaviour.DIVERGED for end in ends):
            return CandidateClass.DIVERGED
        if Stability.NOT_STABLE in stabilities:
            return CandidateClass.OSCILLATED
        if fall_rad > STRAYED_RAD:
            return CandidateClass.STRAYED
        if apart_rad > TOGETHER_RAD:
            return CandidateClass.APART
        return CandidateClass.OPEN if Stability.OPEN in stabilities else CandidateClass.SETTLED


CLASS_MEANINGS = {
    CandidateClass.DIVERGED: "not stable: a joint exceeded the speed limit",
    CandidateClass.OSCILLATED: "it keeps oscillating, drifts or grows",
    CandidateClass.STRAYED: (
        f"the mean pose ends more than {STRAYED_RAD} rad from the pose of a weightless "
        "consensus, or would after twice the time: the arms fell, hang, sink, or were thrown"
    ),
    CandidateClass.APART: f"an arm ends more than {TOGETHER_RAD} rad from the mean of all arms",
    CandidateClass.OPEN: "it hardly decays, or is undecided: a longer run may decide",
    CandidateClass.SETTLED: "it converged or decays, and no other class applies",
}
"""Meaning of each class. docs/reference/stability.md defines the verdict on a run."""


_SHORT_S = 0.5
"""How much earlier than planned a log may end, in s, before it is reported as short."""
_POSE_SAMPLES = 2000
"""Number of times at which q* of a log is computed."""


def check_final_posture(log: Log) -> list[str]:
    """Warns if the end of a run reveals little about its control law.

    There are four warnings:

    - A site diverged. The other warnings are then left out.
    - The run is shorter than planned.
    - An arm hangs down (both of its links point down) and did not hang at the start. Its errors
      and torques are small, but not because of the control law.
    - The mean pose of the arms is more than 0.2 rad from the consensus pose q*, although no
      operator or wall can explain the distance.

    Args:
        log: Log of the run.

    Returns:
        The warnings that apply, one sentence each. May be empty.

    Raises:
        LogError: A record cannot be read.
    """
    site_logs = {site: log[site] for site in log.sites if len(log[site])}
    diverged_sites = [
        site for site, site_log in site_logs.items() if site_log.record(-1).mode == "diverged"
    ]
    if diverged_sites:
        return [f"{', '.join(diverged_sites)} diverged: its figures end there"]

    warnings = []
    end_times_s = [float(site_log.t_s[-1]) for site_log in site_logs.values()]
    end_s = min(end_times_s, default=0.0)
    planned_s = log.scenario.duration_s
    if end_s <= planned_s - _SHORT_S:
        warnings.append(
            f"ends at {end_s:.4g} s of {planned_s:g} s: its figures are of a shorter run"
        )

    end_poses_rad = {}
    for site, site_log in site_logs.items():
        in_last_second = site_log.t_s > site_log.t_s[-1] - END_WINDOW_S
        end_poses_rad[site] = site_log.q[in_last_second].mean(axis=0)
    hanging = RunEnd.find_hanging_sites(log.scenario, end_poses_rad)
    if hanging:
        verb = "hangs" if len(hanging) == 1 else "hang"
        warnings.append(
            f"{', '.join(hanging)} {verb} at the end: small errors and torques of arms that "
            "hang say nothing about a law"
        )
        return warnings
    return [*warnings, *_warn_fallen(log, end_poses_rad)]


def _warn_fallen(log: Log, end_poses_rad: dict[str, Array]) -> list[str]:
    """Returns a warning if the mean pose of a log ends far from q*.

    There is no warning if the scenario has no pose q*, or if an operator or a wall could be the
    reason.

    Args:
        log: The log.
        end_poses_rad: Mean pose of each site in the last second, shape (n,), in rad.

    Returns:
        At most one sentence.
    """
    scenario = log.scenario
    try:
        check_comparable(scenario)
    except ScenarioError:
        return []
    has_other_forces = build_twin(scenario) is not None
    if has_other_forces or len(end_poses_rad) < len(scenario.names):
        return []

    end_s = min(float(log[site].t_s[-1]) for site in end_poses_rad)
    t_s = np.linspace(0.0, end_s, _POSE_SAMPLES)
    mean_rad = np.mean(list(end_poses_rad.values()), axis=0)
    consensus_rad = compute_consensus_pose(scenario, t_s)
    distance_rad = np.abs(mean_rad - consensus_rad[-1])
    joint = int(distance_rad.argmax())
    if distance_rad[joint] <= STRAYED_RAD:
        return []
    return [
        f"the arms end {distance_rad[joint]:.2g} rad (joint {joint + 1}) from where a "
        "weightless consensus would stand: they sank, or drifted"
    ]


class CandidateScore(msgspec.Struct, frozen=True):
    """Score of a control law with chosen gains: error, effort and class.

    docs/reference/tuning-procedure.md contains the formulas.

    Attributes:
        outcome: Class of the candidate.
        error_rad: RMS distance of the arms from the pose q*, in rad. `None` if the run
            diverged.
        spread_rad: Part of the error that is the distance between the arms at the same time,
            with no delay. For a law with a target motion of its own
            (`LawSettings.target_motion`), it is the distance of the arms from this motion.
        pose_rad: Part of the error that is the distance of the arms' mean from q*.
        effort_nm: RMS of the torque minus the gravity torque at the arm's own pose, in N m.
        settled_s: Time from which the largest |e| stays below 0.01 rad, in s, where e is the
            error of a site against its peers. `None` if |e| is larger at the end.
        saturated: Fraction of all joint torques that were at the torque limit.
        diverged_s: Time at which the first site left its limits, in s. `None` if no site did.
        seeds: Number of runs over which the score is averaged. The class is the worst class
            among these runs.
        error_half_rad: Half the width of the 95 % interval of the mean error. `None` for a
            single run.
        effort_half_nm: Half the width of the 95 % interval of the mean effort. `None` for a
            single run.
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

    @classmethod
    def average(cls, scores: "Sequence[CandidateScore]") -> "CandidateScore":
        """Combines the scores of a candidate over runs that differ only in their seeds.

        The class is the worst class of all runs, and every other field is the mean over the
        runs, or `None` if it is missing for one of them.

        Args:
            scores: Score of each run, at least one.
        """
        if len(scores) == 1:
            return scores[0]
        rank = list(CandidateClass)
        worst = min(scores, key=lambda score: rank.index(score.outcome))

        intervals = {}
        means = {}
        for field in _AVERAGED:
            values = [getattr(score, field) for score in scores]
            interval = MeanInterval.of_values(values)
            intervals[field] = interval
            means[field] = None if interval is None else interval.mean

        error = intervals["error_rad"]
        effort = intervals["effort_nm"]
        return msgspec.structs.replace(
            worst,
            **means,
            seeds=len(scores),
            error_half_rad=None if error is None else error.half,
            effort_half_nm=None if effort is None else effort.half,
        )

    @classmethod
    def measure(cls, text: str, twin_text: str | None) -> "CandidateScore":
        """Runs a candidate and its twin, and scores the candidate.

        The twin is the same run without walls and without operators that have no target pose,
        see `build_twin`. It shows at which pose the arms would come to rest.

        Args:
            text: Canonical text of the candidate's scenario.
            twin_text: Canonical text of the twin's scenario. If `None`, there is no twin, and
                the final pose is taken from the candidate's own run.

        Returns:
            The score of the candidate.
        """
        run = _measure_run(parse_embedded(text))
        twin = run if twin_text is None else _measure_run(parse_embedded(twin_text))
        return _score_candidate(run, twin)


_AVERAGED = ("error_rad", "spread_rad", "pose_rad", "effort_nm", "settled_s", "saturated")
"""Fields of a score that are averaged over the seeds."""


def _score_candidate(run: "_RunMeasures", twin: "_RunMeasures") -> CandidateScore:
    """Combines the measurements from a candidate's run and its twin into a score.

    Args:
        run: Measurements from the run.
        twin: Measurements from the twin, which is the same run without walls and pushes. If
            there is no twin, those from the run itself.
    """
    ends = (run.end, twin.end)
    outcome = CandidateClass.classify(ends, twin.fall_rad, twin.apart_rad)

    # The measurements of a run that ended early cannot be compared with those of other runs.
    divergence_times_s = [end.diverged_at_s for end in ends if end.diverged_at_s is not None]
    if divergence_times_s:
        return CandidateScore(
            outcome=outcome,
            error_rad=None,
            spread_rad=None,
            pose_rad=None,
            effort_nm=None,
            settled_s=None,
            saturated=run.saturated,
            diverged_s=divergence_times_s[0],
        )

    # The distance between the arms is measured in the run, and the pose in its twin.
    return CandidateScore(
        outcome=outcome,
        error_rad=float(np.hypot(run.spread_rad, twin.pose_rad)),
        spread_rad=run.spread_rad,
        pose_rad=twin.pose_rad,
        effort_nm=run.effort_nm,
        settled_s=run.settled_s,
        saturated=run.saturated,
    )


class _RunMeasures(NamedTuple):
    """Quantities measured in one run of a candidate or of its twin.

    `CandidateScore` is computed from them.

    Attributes:
        end: Analysis of the end of the run.
        fall_rad: Predicted distance from q*, see `CandidateClass.classify`.
        apart_rad: Distance between the arms at the end, see `CandidateClass.classify`.
        spread_rad: RMS distance of the arms from their mean, or from the target motion of their
            law, in rad.
        pose_rad: RMS distance of the arms' mean from q*, in rad.
        effort_nm: See `CandidateScore`.
        settled_s: See `CandidateScore`.
        saturated: See `CandidateScore`.
    """

    end: RunEnd
    fall_rad: float
    apart_rad: float
    spread_rad: float
    pose_rad: float
    effort_nm: float
    settled_s: float | None
    saturated: float


def _measure_run(scenario: Scenario) -> _RunMeasures:
    """Runs a scenario in virtual time and measures the quantities for its score.

    Args:
        scenario: Scenario of the candidate, with its gains.
    """
    return _measure_records(scenario, WholeRun.simulate(scenario))


def _measure_records(scenario: Scenario, whole_run: WholeRun) -> _RunMeasures:
    """Measures effort, torque saturation and distances of the arms in a finished run.

    The arms are compared with the consensus pose q*, or with the target motion of their law, at
    times that all sites have in common.

    Args:
        scenario: Scenario of the candidate, with its gains.
        whole_run: Its run.
    """
    records_by_site, end, _ = whole_run
    records = list(records_by_site.values())
    t_s, q, e, tau_x = _sample_at_common_times(records)
    mean_rad = q.mean(axis=0)
    from_pose_rad = mean_rad - compute_consensus_pose(scenario, t_s)

    promised_rad = _compute_promised_motion(scenario, t_s, q, tau_x)
    if promised_rad is None:
        from_target_rad = q - mean_rad
        from_end_rad = from_pose_rad
    else:
        from_target_rad = q - promised_rad
        from_end_rad = mean_rad - promised_rad.mean(axis=0)

    in_last_second = t_s > t_s[-1] - END_WINDOW_S
    final_distance_rad = np.abs(from_target_rad[:, in_last_second])

    effort_nm, saturated = _measure_torques(scenario, records)
    return _RunMeasures(
        end=end,
        fall_rad=_predict_fall_rad(t_s, from_end_rad),
        apart_rad=float(final_distance_rad.max()),
        spread_rad=_rms(from_target_rad),
        pose_rad=_rms(from_pose_rad),
        effort_nm=effort_nm,
        settled_s=_find_settling_time(t_s, e),
        saturated=saturated,
    )


def _compute_promised_motion(
    scenario: Scenario, t_s: Array, q: Array, tau_x: Array
) -> Array | None:
    """Computes the target motion of all arms under the law of the first site.

    Args:
        scenario: Scenario of the run.
        t_s: Times, shape (K,), in s.
        q: Joint angles, shape (N, K, n), in rad.
        tau_x: Recorded exogenous torques, shape (N, K, n), in N m. They are the negative
            external torques.

    Returns:
        The joint angles of the target motion, shape (N, K, n), in rad, or `None` if the target
        of the law is that the arms move together.
    """
    laws = [scenario.sites[name].control for name in scenario.names]
    if not isinstance(laws[0], LawSettings):
        return None
    alpha = np.zeros((len(t_s), len(laws), len(laws)))
    for site, name in enumerate(scenario.names):
        peers = [scenario.names.index(peer) for peer in scenario.peers(name)]
        alpha[:, site, peers] = DominanceHistory.of_scenario(scenario, name, t_s).alpha
    run = TuningRun(laws=laws, t_s=t_s, q=q, outside_nm=-tau_x, alpha=alpha)
    return laws[0].target_motion(run)


def _predict_fall_rad(t_s: Array, from_pose_rad: Array) -> float:
    """Predicts the distance from the target pose at the end of a run twice as long, in rad.

    The distance is averaged over the second before the middle of the run and over the last
    second. If it grew between the two, it is assumed to continue growing at the same rate.

    Args:
        t_s: Times, shape (K,), in s.
        from_pose_rad: Distance of the mean pose from q* or from the mean of the target motion,
            shape (K, n), in rad.

    Returns:
        The distance of the joint that is furthest away.
    """
    end_s = t_s[-1]
    half_s = 0.5 * end_s
    at_end = t_s > end_s - END_WINDOW_S
    at_half = (t_s > half_s - END_WINDOW_S) & (t_s <= half_s + 1e-9)
    mean_at_end_rad = from_pose_rad[at_end].mean(axis=0)
    mean_at_half_rad = from_pose_rad[at_half].mean(axis=0)
    end_rad = np.abs(mean_at_end_rad)
    half_rad = np.abs(mean_at_half_rad)
    growth_rad = np.maximum(end_rad - half_rad, 0.0)
    predicted_rad = end_rad + 2.0 * growth_rad
    return float(predicted_rad.max())


def _find_settling_time(t_s: Array, e: Array) -> float | None:
    """Returns the last time at which |e| is not below 0.01 rad, in s.

    Args:
        t_s: Times, shape (K,), in s.
        e: Errors, shape (N, K, n), in rad.

    Returns:
        The time. 0 if |e| is always below 0.01 rad, `None` if it is not below 0.01 rad at the
        end.
    """
    largest_rad = np.abs(e).max(axis=(0, 2))
    is_settled = largest_rad[-1] < SETTLED_ERROR_RAD
    if not is_settled:
        return None
    unsettled_times_s = t_s[largest_rad >= SETTLED_ERROR_RAD]
    return float(unsettled_times_s.max(initial=0.0))


def _measure_torques(scenario: Scenario, records: Sequence[RecordBatch]) -> tuple[float, float]:
    """Returns the effort, in N m, and the fraction of joint torques that were at their limit.

    The effort is the RMS of the torque minus the gravity torque.

    Args:
        scenario: Scenario in which the laws are compared.
        records: Records of each site.
    """
    mean_squares = []
    saturated_shares = []
    for record, site in zip(records, scenario.names, strict=True):
        arm = build_arm_rows(scenario, site)

        effort_nm = record.tau - arm.gravity_torque(record.q)
        mean_squares.append(np.mean(effort_nm**2))

        limits = scenario.sites[site].limits
        is_saturated = np.abs(record.tau) >= limits.tau_limit_nm
        saturated_shares.append(np.mean(is_saturated))

    rms_effort_nm = np.sqrt(np.mean(mean_squares))
    saturated_share = np.mean(saturated_shares)
    return float(rms_effort_nm), float(saturated_share)


def _sample_at_common_times(
    records: Sequence[RecordBatch],
) -> tuple[Array, Array, Array, Array]:
    """Returns the joint angles, errors and exogenous torques of all sites at common times.

    If tick rates differ, the times are the ticks of the slowest site. For every other site, the
    latest record at each time is used.

    Args:
        records: Records of each site.

    Returns:
        The times, shape (K,), in s; the joint angles, shape (N, K, n), in rad; the errors,
        shape (N, K, n), in rad; and the exogenous torques, shape (N, K, n), in N m.
    """
    end_ns = min(record.t_ns[-1] for record in records)
    slowest_ns = min((record.t_ns for record in records), key=len)
    times_ns = slowest_ns[slowest_ns <= end_ns]

    q = []
    e = []
    tau_x = []
    for record in records:
        next_indices = np.searchsorted(record.t_ns, times_ns, side="right")
        latest = next_indices - 1
        q.append(record.q[latest])
        e.append(record.e[latest])
        tau_x.append(record.tau_x[latest])
    return times_ns / NS_PER_S, np.array(q), np.array(e), np.array(tau_x)


def _rms(values: Array) -> float:
    """Returns the root mean square over all entries of an array, in their unit."""
    return float(np.sqrt(np.mean(values**2)))


class TuningScenario(NamedTuple):
    """The scenario in which control laws are compared, and the overrides applied to it.

    The overrides are kept so that commands can name the scenario as the user did.

    Attributes:
        experiment: Scenario as its author wrote it.
        overrides: Overrides KEY=VALUE of the scenario, as on the command line.
        scenario: Scenario with the overrides.
    """

    experiment: ExperimentText
    overrides: tuple[str, ...]
    scenario: Scenario

    @property
    def source(self) -> str:
        """Name or path of the scenario for use in commands, such as "paper" or "mine.toml"."""
        return self.experiment.label

    def with_controls(self, controls: SiteControls) -> "TuningScenario":
        """Returns this scenario with other control laws or gains, for example to compare them.

        If all arms get the same law and gains, they are set by a single override, which keeps
        commands short. Otherwise there is one override per arm.

        Args:
            controls: Table [control] of each site.
        """
        site_overrides = [
            f"sites.{name}.control={format_toml_value(table)}"
            for name, table in controls.items()
        ]
        overrides = (*self.overrides, *site_overrides)
        scenario = self.experiment.load(overrides)

        first = next(iter(controls.values()))
        if all(table == first for table in controls.values()):
            common_overrides = (*self.overrides, f"control={format_toml_value(first)}")
            # Loading fails if a site of the scenario sets a gain that this law does not have.
            with suppress(ScenarioError):
                common_scenario = self.experiment.load(common_overrides)
                if common_scenario.sites == scenario.sites:
                    return self._replace(overrides=common_overrides, scenario=common_scenario)
        return self._replace(overrides=overrides, scenario=scenario)

    def with_gains(
        self, space: SearchSpace, knowledge: ModelInformation, gains: GainValues
    ) -> "TuningScenario":
        """Returns this scenario with another control law and other gains.

        Args:
            space: The control law.
            knowledge: Information about the arm available to the law, such as its gravity
                parameters.
            gains: Mapping from gain name to value.
        """
        controls = space.controls(self.scenario, knowledge, gains)
        return self.with_controls(controls)

    @property
    def texts(self) -> tuple[str, str | None]:
        """Texts of the scenario and of its twin, to be read by a worker process.

        The twin excludes walls, and operators who push the arms without a target pose. Its text
        is `None` if the scenario has none of these.
        """
        twin = build_twin(self.scenario)
        twin_text = None if twin is None else twin.text
        return self.scenario.text, twin_text

    @property
    def command(self) -> str:
        """Shell command with which a user can simulate the scenario and record a log.

        Example: "trilat sim paper --set link.delay_ms=200".
        """
        options = set_options(self.overrides)
        return format_command("sim", self.source, *options)

    @classmethod
    def load(
        cls, source: str | Path | Mapping[str, Any] | Scenario, overrides: Sequence[str] = ()
    ) -> "TuningScenario":
        """Loads a scenario in which control laws are to be compared.

        Args:
            source: Name of a shipped scenario, a path, a TOML string, its tables, or a
                `Scenario`.
            overrides: Overrides KEY=VALUE of the scenario, as on the command line.

        Raises:
            ScenarioError: The scenario does not exist, or is not valid with the overrides.
        """
        experiment = ExperimentText.read(source)
        scenario = experiment.load(overrides)
        return cls(experiment, tuple(overrides), scenario)


class CandidateItem(NamedTuple):
    """Everything that a worker process needs to run one candidate.

    Attributes:
        runs: For each random seed, the text of the scenario and the text of its twin, which
            excludes walls and operators who push the arms without a target pose. The second
            text is `None` if the scenario has none of these.
        name: Text that identifies the law and its gains in error messages.
        is_side_by_side: True to compute the runs together with others, if possible.
    """

    runs: tuple[tuple[str, str | None], ...]
    name: str
    is_side_by_side: bool = False

    def __str__(self) -> str:
        return self.name

    @classmethod
    def of_seeds(cls, seeds: Sequence[TuningScenario]) -> "CandidateItem":
        """Bundles the runs of one candidate, so that another process can execute them.

        Args:
            seeds: The scenario with the law and its gains for each random seed, at least one.
        """
        first = seeds[0]
        name = ", ".join(first.overrides) or first.source
        runs = tuple(seed.texts for seed in seeds)
        return cls(runs, name)

    def measure(self) -> "_MeasuredCandidate":
        """Runs the candidate with all of its seeds and scores it.

        The result depends only on this object, so any worker process can compute it.
        """
        scores = [CandidateScore.measure(text, twin_text) for text, twin_text in self.runs]
        return _MeasuredCandidate(CandidateScore.average(scores))

    @classmethod
    def measure_together(
        cls, tasks: "Sequence[CandidateItem]"
    ) -> "Iterator[_MeasuredCandidate]":
        """Runs several candidates with all of their seeds, side by side where possible.

        Args:
            tasks: The runs of each candidate.

        Yields:
            The scores in the order of the candidates, equal to those of
            `CandidateItem.measure`.
        """
        texts = [
            text
            for task in tasks
            if task.is_side_by_side
            for texts in task.runs
            for text in texts
            if text
        ]
        scenarios = {text: parse_embedded(text) for text in dict.fromkeys(texts)}
        measured = {}
        obstacles = {}
        chosen = list(scenarios)
        try:
            for first in range(0, len(chosen), LANE_RUNS):
                part = chosen[first : first + LANE_RUNS]
                runs = WholeRun.simulate_together([scenarios[text] for text in part])
                for index, run, obstacle in runs:
                    text = part[index]
                    measured[text] = _measure_records(scenarios[text], run)
                    obstacles[text] = obstacle
        except CodeFailed:
            # One by one, so that candidates before a candidate whose code fails are kept.
            for task in tasks:
                yield task.measure()
            return

        for task in tasks:
            if not task.is_side_by_side:
                yield task.measure()
                continue
            scores = [
                _score_candidate(measured[text], measured[twin_text or text])
                for text, twin_text in task.runs
            ]
            reasons = [obstacles[text] for texts in task.runs for text in texts if text]
            yield _MeasuredCandidate(
                CandidateScore.average(scores), tuple(filter(None, reasons))
            )


class _MeasuredCandidate(NamedTuple):
    """Score of a candidate, with the reasons why some of its runs were computed one by one.

    Attributes:
        score: Average score over the seeds.
        alone: The reason for each run that could not be computed side by side with others.
    """

    score: CandidateScore
    alone: tuple[str, ...] = ()


LANE_RUNS = 16
"""Number of runs that a worker computes side by side, with all of their records in memory."""

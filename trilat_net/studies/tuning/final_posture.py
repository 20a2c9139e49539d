"""Where the arms of a comparison ought to end, and the end of a run by its posture.

The pose is the consensus of weightless arms: before any operator acts q* = sum_i beta_i q_i(0), beta the left
Perron vector of the dominance matrix: the limit of x_i' = sum_j alpha_ij x_j - x_i. Spring operators move it
to q* = sum_i beta_i K_i x_i / sum_i beta_i K_i, per joint, with target x_i and stiffness K_i of the operator
at site i, since sum_i beta_i tau_i = 0 in statics. After they let go it stays. Torques without a target and
walls ask for no pose: such a scenario is judged on its twin, the same without them.

Invariant: no gain and no control law enters the pose. A run has exactly one class, and only a settled one may
stand on a front: one that is stable by the judgement of every run (`analysis.run_end`), at the pose. Arms
that hang, however well together, have strayed. An arm hangs if both links point down
at the end and did not at the start; arms fell if their mean ends more than 0.2 rad from the pose in a log
without a push that could explain it.
"""

from collections.abc import Sequence
from enum import StrEnum

import msgspec
import numpy as np

from ...analysis.lyapunov_weights import find_closed_groups, left_perron_vector
from ...analysis.run_end import EndBehaviour, RunEnd, Stability, find_hanging_sites
from ...core.vectors import Array
from ...errors import ScenarioError
from ...log.log_reader import Log
from ...scenario import Scenario
from ...scenario.expect import END_WINDOW_S
from ...scenario.operators import JointSpring, Wall
from ...scenario.validate import refuse_live_only

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
        words = " and ".join(", ".join(scenario.names[site] for site in group) for group in groups)
        raise ScenarioError(
            f"these groups follow no other site: {words}; there is no pose that all would reach",
            path="dominance",
            source=scenario.name,
        )
    t_s = np.arange(0.0, scenario.duration_s, 1.0 / _LOOK_HZ)
    pose = compute_consensus_pose(scenario, t_s)
    for name, hand in _springs(scenario):
        on, target = _target(hand, t_s)
        apart = np.abs(target - pose) * on * (np.array(hand.stiffness_nm_rad) > 0.0)
        if apart.max(initial=0.0) > CONFLICT_RAD:
            at_s = t_s[apart.max(axis=1).argmax()]
            raise ScenarioError(
                f"at {at_s:g} s this hand wants another pose than others do: no law can bring the arms "
                "together, and their distance says nothing of the law; keep one of the operators",
                path=f"sites.{name}.hands",
                source=scenario.name,
            )


def build_twin(scenario: Scenario) -> Scenario | None:
    """Returns the same without torques that have no target, and without walls; None where it has neither."""
    sites = {}
    for name, spec in scenario.sites.items():
        hands = tuple(hand for hand in spec.hands if isinstance(hand, JointSpring))
        environment = tuple(one for one in spec.environment if not isinstance(one, Wall))
        sites[name] = msgspec.structs.replace(spec, hands=hands, environment=environment)
    return None if sites == scenario.sites else msgspec.structs.replace(scenario, sites=sites)


def compute_consensus_pose(scenario: Scenario, t_s: Array) -> Array:
    """Returns q*, the pose of a weightless consensus, shape (K, n), rad, at times of shape (K,), s."""
    beta = left_perron_vector(scenario.alpha)
    weights = dict(zip(scenario.names, beta, strict=True))
    start = np.sum([weights[name] * np.array(spec.q0_rad) for name, spec in scenario.sites.items()], axis=0)
    stiffness = np.zeros((len(t_s), len(start)))
    torque = np.zeros((len(t_s), len(start)))
    for name, hand in _springs(scenario):
        on, target = _target(hand, t_s)
        pull = weights[name] * np.array(hand.stiffness_nm_rad) * on
        stiffness += pull
        torque += pull * target
    held = stiffness > 0.0
    rows = np.vstack([start, np.divide(torque, stiffness, where=held, out=np.zeros_like(torque))])
    last = np.maximum.accumulate(np.where(held, np.arange(1, len(t_s) + 1)[:, np.newaxis], 0), axis=0)
    pose: Array = np.take_along_axis(rows, last, axis=0)
    return pose


def _springs(scenario: Scenario) -> list[tuple[str, JointSpring]]:
    hands = ((name, hand) for name, spec in scenario.sites.items() for hand in spec.hands)
    return [(name, hand) for name, hand in hands if isinstance(hand, JointSpring)]


def _target(hand: JointSpring, t_s: Array) -> tuple[Array, Array]:
    """Returns where a hand is at work, shape (K, 1), 0 or 1, and its target, shape (K, n), rad."""
    on = ((t_s >= hand.start_s) & (t_s < hand.end_s))[:, np.newaxis].astype(np.float64)
    span_s = hand.move_end_s - hand.move_start_s
    x = np.clip((t_s - hand.move_start_s) / span_s, 0.0, 1.0) if span_s > 0.0 else t_s >= hand.move_end_s
    way = (x**3 * (10.0 + x * (6.0 * x - 15.0)))[:, np.newaxis]  # minimum jerk, as core.exogenous
    before, after = np.array(hand.from_rad), np.array(hand.to_rad)
    target: Array = before + way * (after - before)
    return on, target


STRAYED_RAD = 0.2
"""Arms whose mean is further than this from where they ought to be fell, hang, or were thrown there."""
TOGETHER_RAD = 0.02
"""Arms no further than this from their mean are together."""


class CandidateClass(StrEnum):
    """Class of a candidate, from the worst to the best, in the order in which it is asked; as in JSON."""

    DIVERGED = "diverged"
    OSCILLATED = "oscillated"
    STRAYED = "strayed"
    APART = "apart"
    OPEN = "open"
    SETTLED = "settled"

    @property
    def word(self) -> str:
        """The word for people: that of the judgement, where the judgement decides."""
        words = {CandidateClass.OSCILLATED: Stability.NOT_STABLE, CandidateClass.SETTLED: Stability.STABLE}
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
"""What the classes mean, as far as the judgement of a run (docs/definitions.md) does not say it."""


def classify_candidate(ends: Sequence[RunEnd], fall_rad: float, apart_rad: float) -> CandidateClass:
    """Returns the class of a candidate.

    Args:
        ends: the judgements of its run and of its twin; where it has none, the same twice.
        fall_rad: largest distance, over joints, of the twin's mean pose from q*, after as long again at the
            pace at which it grew in the second half.
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
    """Returns what to say of how a log ended, a sentence each; nothing where its arms stand at its end.

    Raises:
        LogError: a record cannot be read.
    """
    diverged = [s for s in log.sites if len(log[s]) and log[s].record(-1).mode == "diverged"]
    if diverged:
        return [f"{', '.join(diverged)} diverged: its figures end there"]
    parts = {site: log[site] for site in log.sites if len(log[site])}
    ends = {site: part.q[part.t_s > part.t_s[-1] - END_WINDOW_S].mean(axis=0) for site, part in parts.items()}
    warnings = []
    last_s = min((float(part.t_s[-1]) for part in parts.values()), default=0.0)
    wanted_s = log.scenario.duration_s
    if last_s <= wanted_s - _SHORT_S:
        warnings.append(f"ends at {last_s:.4g} s of {wanted_s:g} s: its figures are of a shorter run")
    hanging = find_hanging_sites(log.scenario, ends)
    if not hanging:
        return [*warnings, *_warn_fallen(log, ends)]
    verb = "hangs" if len(hanging) == 1 else "hang"
    why = "small errors and torques of arms that hang say nothing of a law"
    return [*warnings, f"{', '.join(hanging)} {verb} at the end: {why}"]


def _warn_fallen(log: Log, ends: dict[str, Array]) -> list[str]:
    """Warns if the mean pose left the consensus, and no operator or environment can be the cause."""
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

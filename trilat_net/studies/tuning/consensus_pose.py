"""The target pose of a comparison: the consensus of weightless arms, a function of the scenario alone.

Invariant: no gain and no control law enters it; arms that hang together are as far from it as they fell.

Before any operator acts the consensus is q* = sum_i beta_i q_i(0), beta the left Perron vector of the
dominance matrix: the limit of x_i' = sum_j alpha_ij x_j - x_i. Spring operators move it to q* = sum_i
beta_i K_i x_i / sum_i beta_i K_i, per joint, with target x_i and stiffness K_i of the operator at site i,
since sum_i beta_i tau_i = 0 in statics. After they let go it stays.

Torques without a target and walls ask for no pose: such a scenario is judged on its twin, the same
without them.
"""

import msgspec
import numpy as np

from ...analysis.lyapunov_weights import find_closed_groups, left_perron_vector
from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...errors import ScenarioError
from ...scenario import Scenario
from ...scenario.operators import JointSpring, Wall
from ...scenario.scenario_types import SiteSpec

CONFLICT_RAD = 0.02
"""Operators whose targets are further from the consensus than this hold the arms apart."""
_LOOK_HZ = 100.0


def check_comparable(scenario: Scenario) -> None:
    """Refuses a scenario in which laws cannot be compared fairly.

    Raises:
        ScenarioError: says why, and what would be right.
    """
    for name, site in scenario.sites.items():
        if site.plant == "external":
            raise ScenarioError(
                "is an arm outside of the program: it is there live only, and tuning runs in virtual time; "
                'take plant = "simulated"',
                path=f"sites.{name}.plant",
                source=scenario.name,
            )
    if scenario.measured:
        links = (f"links.{name}" for name, link in scenario.links.items() if link.measured)
        raise ScenarioError(
            "is measured: the network would decide, differently for every law; give it a model, as in "
            "--set link.model=constant --set link.delay_ms=200",
            path=next(links, "timeline"),
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
    _refuse_conflict(scenario)


def _refuse_conflict(scenario: Scenario) -> None:
    """Refuses operators that hold different poses at one time: no law can bring such arms together."""
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
    sites = {name: _without_untargeted(spec) for name, spec in scenario.sites.items()}
    return None if sites == scenario.sites else msgspec.structs.replace(scenario, sites=sites)


def _without_untargeted(spec: SiteSpec) -> SiteSpec:
    return msgspec.structs.replace(
        spec,
        hands=tuple(hand for hand in spec.hands if isinstance(hand, JointSpring)),
        environment=tuple(one for one in spec.environment if not isinstance(one, Wall)),
    )


def compute_consensus_pose(scenario: Scenario, t_s: Array) -> Array:
    """Returns q*, the pose of a weightless consensus, shape (K, n), rad, at times of shape (K,), s."""
    beta = left_perron_vector(scenario.alpha)
    weights = dict(zip(scenario.names, beta, strict=True))
    start = sum(weights[name] * np.array(spec.q0_rad) for name, spec in scenario.sites.items())
    stiffness = np.zeros((len(t_s), JOINTS))
    torque = np.zeros((len(t_s), JOINTS))
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
    return [
        (name, hand)
        for name, spec in scenario.sites.items()
        for hand in spec.hands
        if isinstance(hand, JointSpring)
    ]


def _target(hand: JointSpring, t_s: Array) -> tuple[Array, Array]:
    """Returns where a hand is at work, shape (K, 1), 0 or 1, and its target, shape (K, n), rad."""
    on = ((t_s >= hand.start_s) & (t_s < hand.end_s))[:, np.newaxis].astype(np.float64)
    span_s = hand.move_end_s - hand.move_start_s
    x = np.clip((t_s - hand.move_start_s) / span_s, 0.0, 1.0) if span_s > 0.0 else t_s >= hand.move_end_s
    way = (x**3 * (10.0 + x * (6.0 * x - 15.0)))[:, np.newaxis]  # minimum jerk, as core.exogenous
    before, after = np.array(hand.from_rad), np.array(hand.to_rad)
    target: Array = before + way * (after - before)
    return on, target

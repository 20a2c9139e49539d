"""Writes sentences for users about V, the energy function in the stability proof.

`analysis` determines whether and when V rose, and whether each premise of the theorem, such as
constant delays, holds. It returns names and numbers. This module writes, for example, that V
rose by 0.2 J at 3.1 s, or which premise failed.

Invariant:
    - Each class of `VerdictFacts` has exactly one function in `FACT_DESCRIBERS`, and each class
      of `premise_quantities` one in `PREMISE_DESCRIBERS`.
    - A sentence about a premise lists at most `_MAX_LISTED_NAMES` arms, links or joints, and
      states how many more there are.
    - A sentence about a failed premise explains in plain words what the premise requires.
    - The name of the theorem mentions its premise of continuous time, which no log can show.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from ..analysis import RunningEnergy, premise_quantities
from ..analysis import verdict_facts as facts
from ..errors import count_nouns
from ..scenario import Scenario

THEOREM = "the theorem (continuous time; every premise checked here holds)"
"""Basis of a verdict if the stability theorem proves that the run is stable."""
FALSE_RECORDS_TEXT = "these records do not follow from the equations in the log"
_PERIOD_OR_FALSE = (
    f"the period is too long for these gains, or {FALSE_RECORDS_TEXT}; "
    "`trilat verify` tells which"
)
_COVERED = "covered by the theorem"
_PREFIXES = {
    facts.StabilityFinding.BROKEN: "the energy balance is broken: ",
    facts.StabilityFinding.NOT_JUDGED: "V cannot be judged: ",
}
"""Start of the sentence if V is inconclusive."""
RECORD_GAPS = {
    facts.RecordGap.NO_COMMON_TIME: "there is no time at which every site has records",
    facts.RecordGap.NO_PERIOD: "there is no period whose records are complete",
}
REQUIREMENTS = {
    "law": "must be adaptive at every site",
    "parameters": "must be learnt or known",
    "Kd": "must be one for all sites, up to a factor",
    "walls": "must create no energy",
    "shares": "must be constant and connect all sites",
    "delays": "must be constant",
    "following": "must never pause",
    "torque": "must stay below its limit",
    "stops": "must not be touched",
    "axes": "must be the same at all sites",
    "singular poses": "must be avoided",
    "hands": "must add no energy",
    "presence": "must not be interrupted",
}
"""Requirements of the theorem as ends of clauses, keyed by the name of the premise."""


def name_theorem() -> str:
    """Returns the phrase with which verdicts refer to the paper's stability theorem."""
    return THEOREM


def _describe_verdict(verdict: facts.StabilityVerdict) -> str:
    """Returns a sentence on whether the energy function V of a run rose.

    V is the energy function in the stability proof, which must not rise.
    """
    sentence = FACT_DESCRIBERS[type(verdict.facts)](verdict.facts)
    return f"{_PREFIXES.get(verdict.finding, '')}{sentence}"


def _describe_no_functional(lack: facts.NoFunctional) -> str:
    return _describe_missing_functionals(lack.missing)


def _describe_gap(gap: facts.RecordGap) -> str:
    return RECORD_GAPS[gap]


def _describe_unclosed_balance(balance: facts.UnclosedBalance) -> str:
    amount = f"{balance.error_j:.3g} J of {balance.scale_j:.4g} J"
    span = f"from {balance.from_s:.4g} s on"
    text = f"the energy of {balance.site} does not add up {span}, by {amount}"
    if balance.external:
        arms = f"the external arm of {', '.join(balance.external)}"
        cause = "does not move according to its theta, or an unrecorded torque pushes it"
        return f"{text}: {arms} {cause}"
    return f"{text}: {FALSE_RECORDS_TEXT if balance.is_certain else _PERIOD_OR_FALSE}"


def _describe_wrong_torque(torque: facts.WrongTorque) -> str:
    return (
        f"the torque of {torque.site} differs from Eq. (13) by up to "
        f"{torque.error_nm:.3g} N m, from {torque.from_s:.4g} s on: {FALSE_RECORDS_TEXT}"
    )


def _describe_ambiguous_weights(weights: facts.AmbiguousWeights) -> str:
    return _describe_closed_groups(weights.groups)


def _describe_coarse_energies(energies: facts.CoarseEnergies) -> str:
    return (
        "the period is too long for these gains, so its energies are known only to within "
        f"{energies.tolerance_j:.3g} J of {energies.scale_j:.4g} J"
    )


def _describe_course(course: facts.FunctionalCourse) -> str:
    """Returns a sentence on whether the energy V of the stability proof rose during a run.

    The sentence also says whether the premises of the theorem, under which V must not rise,
    hold.
    """
    if course.rise is not None:
        context = "although the premises of the theorem, which is about continuous time, hold"
        if course.failed:
            context = _describe_failed(course.failed)
        return f"{context}: {_describe_rise(course.rise, course.largest_j)}"

    text = "V did not rise"
    if course.external:
        text = f"V rose by no more than the {' and '.join(course.external)} supplied"
    first_text = f"{course.first_j:.4g} J at {course.from_s:.4g} s"
    text += f": {first_text}, {course.last_j:.4g} J at {course.to_s:.4g} s"
    undecided_texts = [describe_quantities(quantities) for quantities in course.undecided]
    text = "; ".join([text, *undecided_texts])
    if course.failed:
        return f"{_describe_failed(course.failed)}; {text}"

    reservation = ", as far as the log tells" if undecided_texts else ""
    return f"{_COVERED}{reservation}: {text}"


def _describe_failed(names: Sequence[str]) -> str:
    """Returns a sentence stating why the theorem does not apply: its failed requirements."""
    premises = [f"{name} {REQUIREMENTS[name]}" for name in names]
    return f"the theorem does not apply (premises that fail: {'; '.join(premises)})"


def _describe_rise(rise: facts.FunctionalRise, largest_j: float) -> str:
    largest_causes = list(rise.causes.items())[:4]
    causes = ", ".join(f"{name} {amount:.3g} J" for name, amount in largest_causes)
    percent = 100.0 * rise.amount / largest_j
    text = (
        f"V rose by {rise.amount:.3g} J ({percent:.3g} % of its largest value) "
        f"from {rise.from_s:.4g} to {rise.at_s:.4g} s"
    )
    return text + (f"; supplied by {causes}" if causes else "; no source supplied it")


FACT_DESCRIBERS: dict[type, Callable[[Any], str]] = {
    facts.NoFunctional: _describe_no_functional,
    facts.RecordGap: _describe_gap,
    facts.UnclosedBalance: _describe_unclosed_balance,
    facts.WrongTorque: _describe_wrong_torque,
    facts.AmbiguousWeights: _describe_ambiguous_weights,
    facts.CoarseEnergies: _describe_coarse_energies,
    facts.FunctionalCourse: _describe_course,
}
"""For each class of facts, the function that describes it in a sentence."""


def _describe_growth(growth: facts.UnsuppliedGrowth) -> str:
    """Returns a sentence on a rise of the energy V that no operator or wall explains.

    Such a rise makes the verdict doubtful, even if the run looks stable.
    """
    energy = f"{growth.energy_j:.3g} J"
    if growth.from_s is None:
        return f"V ends {energy} above its beginning, and no source supplied that energy"
    span = f"from {growth.from_s:.4g} s on"
    return f"V rises at the end: by {energy} {span}, and no source supplied that energy"


def _describe_evidence(evidence: facts.Evidence) -> str:
    """Returns a sentence on how many records a run has, and whether its log is unchanged."""
    coverage = evidence.log.coverage.describe(evidence.min_coverage)
    return f"{coverage}; {evidence.log.integrity.text}"


def _list_lacks(evidence: facts.Evidence) -> list[str]:
    """Returns sentences on why the records are insufficient to judge the stability of a run."""
    return [_describe_lack(doubt) for doubt in evidence.doubts]


def _describe_lack(doubt: facts.EvidenceDoubt) -> str:
    """Returns a sentence on why the records are insufficient to judge a run."""
    evidence = doubt.evidence
    if doubt.name == "changed log":
        return f"the log was changed after the run: {evidence.log.integrity.text}"
    if doubt.name == "missing records":
        coverage = evidence.log.coverage.describe(evidence.min_coverage)
        return f"records are missing: {coverage}"
    if doubt.name == "missing periods":
        judged_share = evidence.functional_share or 0.0
        return f"V is judged over {100.0 * judged_share:.4g} % of its periods"
    return (
        f"{' and '.join(evidence.log.copied_sites)} replayed recorded motion, without reacting "
        "to this run"
    )


DESCRIBERS: dict[type, Callable[[Any], str]] = {
    facts.StabilityVerdict: _describe_verdict,
    facts.UnsuppliedGrowth: _describe_growth,
    facts.Evidence: _describe_evidence,
    facts.EvidenceDoubt: _describe_lack,
}
"""Functions that describe findings, keyed by the class of the finding."""
SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {facts.Evidence: _list_lacks}
"""Functions that list the sentences of a finding, keyed by the class of the finding."""


_MAX_LISTED_NAMES = 4
"""Maximum number of links or sites listed in a sentence."""
_OBSTACLES = {
    premise_quantities.FunctionalObstacle.UNKNOWN_PARAMETERS: (
        "theta of the arm is unknown, and V depends on it"
    ),
    premise_quantities.FunctionalObstacle.LAW: "law {law} has no functional V",
    premise_quantities.FunctionalObstacle.ORIENTATIONS: (
        "the arm follows orientations, for which ed is not the derivative of e, "
        "so dV/dt has terms of either sign"
    ),
}
_PARAMETER_FAULTS = {
    premise_quantities.ParameterFault.OUTSIDE_BOX: (
        "theta is outside the box in which the law keeps its estimates"
    ),
    premise_quantities.ParameterFault.NEVER_LEARNT: "a parameter is neither learnt nor known",
    premise_quantities.ParameterFault.FRICTION: (
        "the law does not compensate all friction of the joints"
    ),
}


def describe_quantities(quantities: premise_quantities.PremiseQuantities) -> str:
    """Returns a sentence on what a run shows about a premise of the stability theorem.

    For example, one premise is that all network delays are constant.

    Args:
        quantities: The data on the premise.
    """
    return PREMISE_DESCRIBERS[type(quantities)](quantities)


def explain_no_functional(scenario: Scenario) -> str:
    """Names the arms for which the stability proof has no energy function V, and says why.

    If there is such an arm, the stability of a run is judged without V.

    Args:
        scenario: Scenario of the run.

    Returns:
        The names of the sites of these arms with the reasons, separated by semicolons. Empty if
        V exists for every arm.
    """
    return _describe_missing_functionals(
        premise_quantities.MissingFunctional.list_of_scenario(scenario)
    )


def describe_energy_obstacle(energy: RunningEnergy) -> str:
    """Explains why the energy function V of a running session cannot be computed.

    Args:
        energy: The energy of the session.

    Returns:
        The reason, for a live display. Empty if V can be computed.
    """
    if energy.missing:
        return _describe_missing_functionals(energy.missing)
    if energy.degrades:
        return "shares change when a peer is lost: `trilat certify` computes V"
    if energy.closed_groups:
        return _describe_closed_groups(energy.closed_groups)
    return ""


def _describe_missing_functionals(
    missing: Sequence[premise_quantities.MissingFunctional],
) -> str:
    """Returns a text on the arms for which the stability proof has no energy function.

    The text states the reasons. A run with such an arm is judged without the energy function.

    Args:
        missing: Sites of these arms, grouped by reason.

    Returns:
        The names of the sites with the reasons, separated by semicolons. Empty if the energy
        exists for every arm.
    """
    clauses = []
    for group in missing:
        reason = _OBSTACLES[group.obstacle].format(law=group.law)
        clauses.append(f"{', '.join(group.sites)}: {reason}")
    return "; ".join(clauses)


def _describe_closed_groups(groups: Sequence[Sequence[str]]) -> str:
    """Returns a sentence on why the total energy of all arms is not uniquely defined.

    The total energy is a weighted sum over the sites. If groups of sites do not follow each
    other, the relative weights of the groups are arbitrary.

    Args:
        groups: Names of the sites in each group. They follow each other but no site outside the
            group.
    """
    group_texts = " and ".join("{" + ", ".join(group) + "}" for group in groups)
    return (
        f"{group_texts} follow no site outside their group: beta is not unique, certify each "
        "group by itself"
    )


def _describe_law(quantities: premise_quantities.LawQuantities) -> str:
    if quantities.missing:
        return _describe_missing_functionals(quantities.missing)
    return "adaptive at every site, of arms whose theta is known"


def _describe_parameters(quantities: premise_quantities.ParameterQuantities) -> str:
    if not quantities.faults:
        return "every parameter is learnt or known, and no box excludes it"
    return _join_limited(
        [f"{site}: {_PARAMETER_FAULTS[fault]}" for site, fault in quantities.faults]
    )


def _describe_gains(quantities: premise_quantities.GainQuantities) -> str:
    if quantities.scales is None:
        gain_texts = []
        for site, gains in quantities.Kd.items():
            numbers = ", ".join(f"{gain:g}" for gain in gains)
            gain_texts.append(f"{site} ({numbers})")
        gains_text = ", ".join(gain_texts)
        return f"Kd differs in shape between sites, so no beta exists: {gains_text}"

    if not quantities.is_positive:
        return "some Kd is zero, but the theorem requires positive Kd"
    if len(set(quantities.scales.values())) == 1:
        return "one Kd for all sites"
    return f"one Kd up to a scalar: {_format_by_site(quantities.scales)}"


def _describe_walls(quantities: premise_quantities.WallQuantities) -> str:
    if not quantities.walls:
        return "no sampled wall was touched"

    summary = "every sampled wall is passive"
    if quantities.active:
        summary = "a sampled wall generates energy in contact"

    # A sampled wall of stiffness K and damping B is passive if the damping of the arm is at
    # least K h / 2 + B, where h is the period of the control loop.
    listed_walls = quantities.active or quantities.walls
    wall_texts = [
        f"{wall.site}: K h / 2 + B is {wall.required_damping_n_s_m:.3g} N s/m, the arm's own "
        f"damping {wall.arm_damping_n_s_m:.3g}; generated {wall.generated_j:.3g} J "
        "with respect to qd"
        for wall in listed_walls
    ]
    return f"{summary}: {'; '.join(wall_texts)}"


def _describe_dominance(quantities: premise_quantities.DominanceQuantities) -> str:
    if quantities.changing:
        text = f"the shares of {_join_limited(quantities.changing)} change"
        loss_texts = [
            f"{loss.site} without {loss.peer} {loss.from_s:.4g} to {loss.to_s:.4g} s"
            for loss in quantities.losses
        ]
        if loss_texts:
            text += f": {_join_limited(loss_texts)}; the remaining sites follow each other"
        return text

    if len(quantities.groups) > 1:
        return _describe_closed_groups(quantities.groups)

    if quantities.weightless:
        leaders = ", ".join(quantities.groups[0])
        followers = ", ".join(quantities.weightless)
        return (
            f"alpha is reducible: none of {leaders} follows {followers}, whose beta is 0, so V "
            f"says nothing about {followers}, which follow as in a cascade"
        )

    text = "constant, alpha irreducible"
    if quantities.beta is not None:
        text += f"; beta: {_format_by_site(quantities.beta)}"
    return text


def _describe_delays(quantities: premise_quantities.DelayQuantities) -> str:
    if quantities.varying:
        age_texts = [
            f"{link.peer}->{link.site} "
            f"({1e3 * link.shortest_s:.4g} to {1e3 * link.longest_s:.4g} ms)"
            for link in quantities.varying
        ]
        return f"the age of the sample in use varies: {_join_limited(age_texts)}"

    if not quantities.constant_s:
        return "no sample came into use"

    delay_texts = {f"{1e3 * delay_s:.4g} ms" for delay_s in quantities.constant_s}
    return f"constant on every link: {', '.join(sorted(delay_texts))}"


def _describe_following(quantities: premise_quantities.FollowingQuantities) -> str:
    interruption_texts = [
        f"{site} {from_s:.4g} to {to_s:.4g} s"
        for site, from_s, to_s in quantities.interruptions
    ]
    for site, count in quantities.limited_ticks.items():
        ticks_text = count_nouns(count, "tick")
        interruption_texts.append(
            f"{site} with a reference at its speed limit for {ticks_text}"
        )

    if not interruption_texts:
        return "every site follows its peers all the time"

    modes_text = (
        "hold, brake, return or stop" if quantities.is_halted else "hold, brake or return"
    )
    return f"{modes_text}: {_join_limited(interruption_texts)}"


def _describe_torques(quantities: premise_quantities.TorqueQuantities) -> str:
    if not quantities.cut:
        return "never cut off"
    texts = [
        f"{cut.site}{_name_joints(cut.joints)} at {count_nouns(cut.ticks, 'tick')}"
        for cut in quantities.cut
    ]
    return f"cut off: {_join_limited(texts)}"


def _describe_stops(quantities: premise_quantities.StopQuantities) -> str:
    if not quantities.touched:
        return "no stop is touched"
    texts = [
        f"{stop.site}{_name_joints(stop.joints)} from {stop.from_s:.4g} s on"
        for stop in quantities.touched
    ]
    return f"the arm runs into the stops of its joints: {_join_limited(texts)}"


def _name_joints(joints: Sequence[str]) -> str:
    """Returns the names of joints in parentheses, with a leading space."""
    return f" ({_join_limited(joints)})" if joints else ""


def _describe_axes(quantities: premise_quantities.AxisQuantities) -> str:
    if not quantities.faults:
        return "every site follows along each axis along which it moves and is followed"
    return _join_limited(
        [
            f"{follower} follows {site} along an axis that {site} does not follow"
            for follower, site in quantities.faults
        ]
    )


def _describe_singular_poses(quantities: premise_quantities.SingularPoseQuantities) -> str:
    if quantities.near_s:
        texts = [f"{site} from {from_s:.4g} s on" for site, from_s in quantities.near_s.items()]
        return f"a pose is so nearly singular that it is damped: {_join_limited(texts)}"
    bounds = _format_by_site(quantities.least_values)
    return f"no pose is near one; least singular value at least: {bounds}"


def _describe_operators(quantities: premise_quantities.OperatorQuantities) -> str:
    if quantities.unmeasured:
        return f"no record says who pushes the arm of {_join_limited(quantities.unmeasured)}"
    if quantities.weightless:
        sites = _join_limited(quantities.weightless)
        return f"{sites}, of beta 0, is pushed: V does not show that"

    supply = quantities.supply
    if supply is None:
        return "no operator or wall pushes"

    sources = " and ".join(supply.sources)
    if supply.is_passive:
        return f"the {sources} only absorbed energy: passive with respect to r"

    r = "qd - v" if supply.in_task_space else "qd + Lambda e"
    text = f"the {sources} supplied up to {supply.energy_j:.3g} J with respect to r = {r}"
    if supply.free_s >= supply.least_free_s:
        return f"{text}; no pushes after {supply.released_s:.3f} s"
    if supply.free_s > 1e-9:
        return (
            f"{text}, and push until {supply.released_s:.3f} s: {supply.free_s:.3g} s of free "
            f"motion at the end are less than {supply.least_free_s:.3g} s"
        )
    return f"{text}, and push to the end: not passive with respect to r"


def _describe_records(quantities: premise_quantities.RecordQuantities) -> str:
    if quantities.unjudged_s:
        spans = [f"{from_s:.4g} to {to_s:.4g} s" for from_s, to_s in quantities.unjudged_s]
        return f"not judged: {_join_limited(spans)}: records are missing there"
    text = "every period of every site rests on records"
    return text if quantities.is_whole else f"{text} while all sites were present"


def _describe_presence(quantities: premise_quantities.PresenceQuantities) -> str:
    spans = [f"{site} {from_s:.4g} to {to_s:.4g} s" for site, from_s, to_s in quantities.absent]
    stretches = "; ".join(map(_describe_stretch, quantities.stretches))
    return (
        f"absent: {_join_limited(spans)}, times to which the theorem does not apply; "
        f"the times between: {stretches}"
    )


def _describe_stretch(stretch: premise_quantities.PresentStretch) -> str:
    span = f"{stretch.from_s:.4g} to {stretch.to_s:.4g} s"
    if stretch.follow_from_s is None:
        return f"{span} not all follow"
    delays = "delays are constant"
    if stretch.varying:
        links = [f"{peer}->{site}" for peer, site in stretch.varying]
        delays = f"ages vary ({_join_limited(links)})"
    return f"{span} all follow from {stretch.follow_from_s:.4g} s on, {delays}"


def _describe_books(quantities: premise_quantities.BooksQuantities) -> str:
    sizes = f"{quantities.residual_j:.1e} J of {quantities.scale_j:.4g} J"
    text = f"the energies of {quantities.site}'s law add up to within {sizes}"
    return f"{text}, those of the other laws better"


def _describe_booked_torques(quantities: premise_quantities.BookedTorqueQuantities) -> str:
    if quantities.unbooked:
        sites = ", ".join(quantities.unbooked)
        return f"cut off at {sites}: the law uses a different torque than the arm received"
    if quantities.cut:
        return (
            f"cut off at {', '.join(quantities.cut)}, and the law uses the torque after the cut"
        )
    return "never cut off"


def _describe_sampling(quantities: premise_quantities.SamplingQuantities) -> str:
    energy = f"up to {quantities.leak_j:.3g} J more than its law accounts for"
    return f"the arm of {quantities.site} received {energy}, between ticks"


PREMISE_DESCRIBERS: dict[type, Callable[[Any], str]] = {
    premise_quantities.LawQuantities: _describe_law,
    premise_quantities.ParameterQuantities: _describe_parameters,
    premise_quantities.GainQuantities: _describe_gains,
    premise_quantities.WallQuantities: _describe_walls,
    premise_quantities.DominanceQuantities: _describe_dominance,
    premise_quantities.DelayQuantities: _describe_delays,
    premise_quantities.FollowingQuantities: _describe_following,
    premise_quantities.TorqueQuantities: _describe_torques,
    premise_quantities.StopQuantities: _describe_stops,
    premise_quantities.AxisQuantities: _describe_axes,
    premise_quantities.SingularPoseQuantities: _describe_singular_poses,
    premise_quantities.OperatorQuantities: _describe_operators,
    premise_quantities.RecordQuantities: _describe_records,
    premise_quantities.PresenceQuantities: _describe_presence,
    premise_quantities.BooksQuantities: _describe_books,
    premise_quantities.BookedTorqueQuantities: _describe_booked_torques,
    premise_quantities.SamplingQuantities: _describe_sampling,
}
"""For each class of quantities, the function that describes it in a sentence."""


def _join_limited(items: Sequence[str]) -> str:
    """Joins strings with commas. Strings beyond `_MAX_LISTED_NAMES` are only counted."""
    text = ", ".join(items[:_MAX_LISTED_NAMES])
    hidden = len(items) - _MAX_LISTED_NAMES
    return f"{text} and {hidden} more" if hidden > 0 else text


def _format_by_site(values: Mapping[str, float]) -> str:
    """Formats one value per site, for example as "m1 0.5, s 2"."""
    return ", ".join(f"{site} {value:.4g}" for site, value in values.items())

"""Turns the basis of a stability decision, and the obstacles to it, into sentences.

`analysis.stability_decision` makes the decision and returns names with numerical evidence. This
module describes, for example, the basis "roots" as "exact roots, slowest -0.832 /s".

Invariant:
    - Each basis has exactly one function in `BASES`, and each obstacle exactly one function in
      `OBSTACLES`.
"""

from collections.abc import Callable, Iterable
from typing import Any

from ..analysis import EndBehaviour, stability_decision
from ..errors import count_nouns, join_words
from .verdict_text import THEOREM


def _state_basis(decision: stability_decision.StabilityDecision) -> str:
    """Returns a phrase that names the basis of a decision. Empty if there is none."""
    return BASES[decision.basis](decision.findings)


def _list_reasons(decision: stability_decision.StabilityDecision) -> list[str]:
    """Returns one or more sentences for each reason that prevents a better decision.

    Empty if the run is stable.
    """
    if decision.is_too_short:
        return [_describe_short_record(decision.advised_s)]
    reasons = []
    for obstacle in decision.obstacles:
        reasons += OBSTACLES[obstacle](decision.findings)
    return reasons


def _describe_roots(roots: stability_decision.LoopRoots) -> str:
    """Returns a sentence on the roots at the end of a run, or on why they are missing."""
    if not roots.verdict:
        return f"this rest: no roots: {roots.reason}"
    if roots.rate_per_s is None:
        return f"this rest: {roots.verdict}, without roots"

    omega = f" at {roots.omega_rad_s:.4g} rad/s" if roots.omega_rad_s else ""
    drift = ""
    if roots.drifting:
        drift = f"{roots.drifting} of its motions keep their speed, the others "
    rate = f"{drift}{roots.rate_per_s:+.3g} /s"
    return f"this rest: {roots.verdict}, {rate}{omega}{_describe_span(roots)}"


def _describe_span(roots: stability_decision.LoopRoots) -> str:
    """Returns a clause on the ticks and delays for which the roots were computed."""
    if roots.is_continuous:
        ages = ", of the mean ages" if roots.has_mean_ages else ""
        return f", in continuous time{ages}"
    return describe_tick_span(roots.span_s, roots.deviation_per_s, repeats=roots.repeats)


def describe_tick_span(
    span_s: float | None, deviation_per_s: float | None, *, repeats: bool
) -> str:
    """Returns a clause that states the time span over which the roots of a loop were computed.

    The loop is executed in ticks. If the ticks are not all alike, the roots describe how the
    motion changes over a span of several ticks.

    Args:
        span_s: The time span, in s. None if all ticks are alike.
        deviation_per_s: Uncertainty of the rate caused by delays that do not repeat, in 1/s.
            None if the delays repeat exactly or nearly.
        repeats: True if the delays repeat after this span.

    Returns:
        The clause, with a leading comma. Empty if all ticks are alike.
    """
    if span_s is None:
        return ""
    if repeats:
        return f", over the period of {span_s:.6g} s"
    if deviation_per_s is None:
        return f", over {span_s:.6g} s, after which the delays nearly repeat"
    return f", over {span_s:.4g} s of the delays in use, +- {deviation_per_s:.1g} /s"


def describe_left_out(roots: stability_decision.LoopRoots) -> str:
    """Returns a phrase about programs whose reaction to the arms is not part of the analysis.

    A program that moves an arm can run arbitrary code, which cannot be linearised. The phrase
    is empty if there is no such program.

    Args:
        roots: The roots of the loop.
    """
    if not roots.programs:
        return ""
    if len(roots.programs) == 1:
        return f"how the program at {roots.programs[0]} reacts to the arms"
    return f"how the programs at {join_words(roots.programs)} react to the arms"


def _describe_root_basis(roots: stability_decision.LoopRoots) -> str:
    """Returns the phrase after "rests on:" for decisions based on the roots of the loop.

    For example, "exact roots, slowest -0.832 /s" means that the slowest mode decays at a rate
    of 0.832 per second. If the roots refute stability, the fastest growing mode is named
    instead. If all roots are zero, the phrase contains no rate.
    """
    name = "roots by numerical derivatives" if roots.is_numerical else "exact roots"
    if roots.rate_per_s is None:
        return name
    decisive = "fastest growing" if roots.is_refutation else "slowest"
    return f"{name}, {decisive} {roots.rate_per_s:+.3g} /s"


def _state_end(run: stability_decision.RunFindings) -> str:
    # The frequency of an oscillation is known only if all records are known.
    return f"the end of the run: {run.end._replace(frequency_hz=None).text}"


def _state_roots(run: stability_decision.RunFindings) -> str:
    assert run.roots is not None
    return _describe_root_basis(run.roots)


def _state_proofs(run: stability_decision.RunFindings) -> str:
    """Returns phrases that name every proof of stability, with exact roots last."""
    proofs = [THEOREM] if run.is_covered else []
    proofs += run.law_proofs
    if run.roots is not None and run.roots.is_proof:
        proofs.append(_describe_root_basis(run.roots))
    return "; ".join(proofs)


def _state_pushes(run: stability_decision.RunFindings) -> str:
    """Returns the basis for a settled run: the number of pushes, and why there is no proof.

    For example: "8 pushes over 12 s, all of which died away; its roots are not exact".
    """
    assert run.twins is not None
    pushes = len({growth.push.name for growth in run.twins.pushes})
    duration_s = run.twins.to_s
    ending = "all of which died away" if pushes > 1 else "which died away"
    text = f"{count_nouns(pushes, 'push', 'pushes')} over {duration_s:.4g} s, {ending}"
    roots = run.roots
    if roots is None:
        return text
    if not roots.verdict:
        return f"{text}; {roots.text}"
    if roots.leaves_out:
        return f"{text}; pushes and roots leave out {roots.leaves_out}"
    if not roots.exact:
        return f"{text}; its roots are not exact"
    return text


def _describe_twins(run: stability_decision.RunFindings) -> str:
    assert run.twins is not None
    return run.twins.text


BASES: dict[stability_decision.Basis, Callable[[stability_decision.RunFindings], str]] = {
    "nothing": lambda _: "",
    "divergence": lambda run: run.end.text,
    "end": _state_end,
    "roots": _state_roots,
    "proofs": _state_proofs,
    "growing pushes": _describe_twins,
    "dying pushes": _state_pushes,
}
"""For each basis of a decision, the function that describes it in a phrase."""


def _list_missing_records(run: stability_decision.RunFindings) -> list[str]:
    return [f"no record of {site}" for site in run.end.missing_sites]


def _describe_period(run: stability_decision.RunFindings) -> list[str]:
    """Returns a sentence about repetitions that were shorter than the period of the delays.

    Pushes that died away then prove little, because the delays in the rest of the period were
    never tested.
    """
    twins = run.twins
    assert twins is not None
    judged_s = twins.to_s - twins.from_s
    sentence = (
        f"the delays repeat after {twins.delay_period_s:.6g} s, but the twins were judged "
        f"over {judged_s:.4g} s"
    )
    return [sentence]


def _describe_growing_roots(run: stability_decision.RunFindings) -> list[str]:
    assert run.roots is not None
    return [run.roots.text]


def _describe_short_record(advised_s: float | None) -> str:
    if advised_s is None:
        return "the run is too short to tell; try a run of twice its length"
    return f"the run is too short to tell; a run of {advised_s:.3g} s would be long enough"


def _describe_slow_decay(run: stability_decision.RunFindings) -> list[str]:
    assert run.roots is not None
    lasting = "drift" if run.end.behaviour is EndBehaviour.DRIFTS else "oscillation"
    sentence = (
        f"too slow to be distinguished from a lasting {lasting} in the judged part; its "
        f"numerical roots decay at {run.roots.rate_per_s:.3g} /s"
    )
    return [sentence]


def _explain_no_pushes(run: stability_decision.RunFindings) -> list[str]:
    assert run.twins is not None
    return [f"no proof exists, and no pushes were judged: {run.twins.why}"]


def _describe_few_bursts(run: stability_decision.RunFindings) -> list[str]:
    assert run.twins is not None
    bursts = f"{run.twins.judged_bursts:.2g} bursts of lost samples"
    return [f"{run.end.text}; the judged part has {bursts}, too few for an average"]


_ReasonLister = Callable[[stability_decision.RunFindings], list[str]]
OBSTACLES: dict[stability_decision.Obstacle, _ReasonLister] = {
    "divergence": lambda run: [run.end.text],
    "end": lambda run: list(run.end.reasons),
    "missing records": _list_missing_records,
    "hidden period": _describe_period,
    "doubts": lambda run: [doubt.text for doubt in run.doubts],
    "growing roots": _describe_growing_roots,
    "disputed proof": lambda _: ["the end of the run does not agree with its proof"],
    "slow decay": _describe_slow_decay,
    "missing pushes": lambda _: ["no proof exists, and no run with small pushes was made"],
    "unjudged pushes": _explain_no_pushes,
    "unclear pushes": lambda run: [_describe_twins(run)],
    "few bursts": _describe_few_bursts,
    "unclear end": lambda run: [run.end.text],
}
"""For each obstacle, the function that describes it in sentences. The sentence about a short
record is written by `_list_reasons` itself.
"""

DESCRIBERS: dict[type, Callable[[Any], str]] = {
    stability_decision.StabilityDecision: _state_basis,
    stability_decision.LoopRoots: _describe_roots,
}
"""Functions that describe findings, keyed by the class of the finding."""
SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {
    stability_decision.StabilityDecision: _list_reasons
}
"""Function that lists the reasons for a decision, keyed by the class of the decision."""

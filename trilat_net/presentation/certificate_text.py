"""Composes the explanation of whether a run was stable, for the terminal and for reports.

`analysis.certificate` judges the run from its log, and `describe_certificate` turns the result
into the sentences shown in the terminal and in the report. The terminal output also includes
tables of the premises of the stability theorem, and of the energies that changed V, the energy
function in the stability proof.

Invariant:
    - The terminal and the report contain the same sentences.
    - The verdict comes first.
    - The listed energies add up: V at the end is V at the start plus all other entries, except
      for entries too small to be listed.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..analysis import (
    SETTLED_ERROR_RAD,
    ZERO_ENERGY_J,
    Certificate,
    EndBehaviour,
    EnergyBalance,
    EnvelopeTrend,
    PushedTwins,
    Stability,
    TwinGrowth,
    premise_quantities,
    stability_decision,
    verdict_facts,
)
from ..core import Array
from ..errors import count_nouns
from .end_text import name_behaviour
from .observed_text import NEGATIVE_ENERGY_MEANING
from .result_text import MARKS, Block, MarkedText, TextTable

MIN_ENERGY_SHARE = 1e-6
"""Smallest energy to list, as a fraction of the largest energy."""
MAX_LISTED_LINKS = 6
"""Maximum number of links to list. If there are more, their energies are summed."""
_SOURCE_NAMES = {
    "rule": "rule for stale peers",
    "shares": "change of shares",
    "estimates": "box, or wrong estimates",
}
"""Display names of energy sources other than links, keyed by their names in a balance."""

_OTHER_ENDS = {
    EndBehaviour.CONVERGED: "the record ends with slow arms",
    EndBehaviour.DECAYS: "the motion decays at the end of the record",
    EndBehaviour.HARDLY: "the motion hardly decays at the end of the record",
    EndBehaviour.UNDECIDED: "the record alone does not decide",
    EndBehaviour.COASTS: "an arm coasts at the end of the record",
    EndBehaviour.BOUNDED: "the arms still swing at the end of the record",
    EndBehaviour.DRIFTS: "an arm still drifts at the end of the record",
    EndBehaviour.GROWS: "the motion still grows at the end of the record",
}
"""Clauses about the end of a record, for runs whose verdict differs from what the end alone
suggests.
"""

_HOLDS = {True: "holds", False: "fails", None: "undecided"}


def compose_certificate(certificate: Certificate) -> Iterator[Block]:
    """Yields the text of a stability certificate: verdict, reasons, and tables.

    The tables list the premises of the stability theorem and the energies.

    Args:
        certificate: Stability certificate of the run.
    """
    judgement, *reasons = describe_certificate(certificate)
    for line in (judgement, *describe_in_words(certificate), *reasons):
        yield line.print_form

    observed = certificate.observed
    premises = select_premises(certificate)
    if premises:
        yield ""
        yield _tabulate_premises(premises)

    if observed is not None and observed.least:
        rows = [
            (least.name, f"{least.amount_j:.4g}", f"{least.at_s:.4g}")
            for least in observed.least
        ]
        headers = ("energy of the laws", "least J", "at s")
        yield ""
        yield TextTable(headers, rows, align="lrr")

    if certificate.balance is not None:
        energies = list_energies(certificate.balance)
        cells = [(name, f"{energy_j:.4g}") for name, energy_j in energies]
        yield ""
        yield TextTable(("energy", "J"), cells, align="lr")


def select_premises(certificate: Certificate) -> list[premise_quantities.Premise]:
    """Returns the stability premises that apply to the control laws of a run.

    Most premises belong to the stability theorem of the paper, which is based on an energy
    function V. For control laws without such a function, only the premise about walls and the
    premises declared by the law itself apply.

    Args:
        certificate: Stability certificate of the run.
    """
    premises = list(certificate.premises)
    if not certificate.has_functional:
        premises = [premise for premise in premises if premise.name == "walls"]
    if certificate.observed is not None:
        premises += certificate.observed.premises
    return premises


def _tabulate_premises(premises: Sequence[premise_quantities.Premise]) -> TextTable:
    """Returns a table with one row per premise, stating whether it holds and why."""
    rows = [(premise.name, _HOLDS[premise.holds], premise.text) for premise in premises]
    styles = {"holds": "green", "fails": "yellow"}
    return TextTable(("premise", "", "finding"), rows, styles=styles)


def compose_twins(twins: PushedTwins) -> Iterator[Block]:
    """Yields a description of the twins of a run: its repetitions with small pushes.

    Twins show whether small disturbances grow. The text states the size up to which the effect
    of a push is proportional to the push, followed by one line per push.

    Args:
        twins: The run and its twins.
    """
    if twins.linear is not None or not twins.growth.pushes:
        yield twins.headline()
    yield from map(twins.describe, twins.growth.pushes)
    if not twins.growth.same_platform:
        cause = "another platform, or version"
        yield f"note: executed again, its last bits are not those of the records: {cause}"


class CertificateLine(NamedTuple):
    """One line of a stability certificate: a sentence marked with, for example, "ok" or "FAIL".

    Attributes:
        mark: "ok" for evidence that the run was stable, "FAIL" for evidence that it was not,
            "open" for evidence that leaves the question open, and "note" for anything else.
        text: The sentence.
    """

    mark: str
    text: str

    @property
    def print_form(self) -> MarkedText:
        """The sentence with its coloured mark, as shown in the terminal and on the page.

        If the sentence itself starts with the mark and a colon, as in "note: ...", that prefix
        is removed so that the mark does not appear twice.
        """
        return MarkedText(MARKS[self.mark], self.text.removeprefix(f"{self.mark}: "))


def describe_certificate(certificate: Certificate) -> list[CertificateLine]:
    """Returns the verdict of a certificate and the reasons for it, one marked sentence each.

    Each sentence has a mark such as "ok" or "FAIL", see `CertificateLine`. The reasons can
    concern the energy function V of the stability proof, the end of the run, the energy
    balance, energies declared by control laws, the characteristic roots, the twins (repeated
    runs with a small push), and the log itself. Reasons that are not available for the run are
    omitted.

    Args:
        certificate: Stability certificate of the run.
    """
    lines = _describe_verdict(certificate)
    if certificate.balance is not None:
        mark = _BALANCE_MARKS.get(certificate.verdict.finding, "ok")
        balance = _describe_balance(certificate.balance)
        lines.append(CertificateLine(mark, f"energy balance: {balance}"))

    # Energies that the control laws record themselves, for example in an energy tank.
    observed = certificate.observed
    if observed is not None:
        lines.append(CertificateLine(_OBSERVED_MARKS[observed.finding], observed.text))
        if observed.finding == "negative":
            lines.append(CertificateLine("note", NEGATIVE_ENERGY_MEANING))

    roots = certificate.roots
    if roots is not None:
        # Roots of an approximation cannot show stability.
        is_doubtful = roots.verdict == "stable" and not roots.exact
        mark = "note" if is_doubtful else _ROOT_MARKS.get(roots.verdict, "note")
        if roots.is_refutation and certificate.stability is Stability.NOT_STABLE:
            mark = "FAIL"
        lines.append(CertificateLine(mark, roots.text))

    twins = certificate.twins
    if twins is not None:
        lines.append(CertificateLine(_mark_twins(twins), twins.text))
        lines += _compare_rates(roots, twins)

    # Last come the lines that concern the log and the weights in V.
    lines.append(_describe_evidence(certificate))
    paper_note = _describe_paper_weights(certificate)
    if paper_note:
        lines.append(CertificateLine("note", paper_note))
    return lines


def describe_in_words(certificate: Certificate) -> list[CertificateLine]:
    """Explains in full sentences what the verdict on a run means, with remarks about the run.

    Args:
        certificate: Stability certificate of the run.
    """
    sentences = [_explain_judgement(certificate), *certificate.remarks]
    return [CertificateLine("note", sentence) for sentence in sentences if sentence]


def _explain_judgement(certificate: Certificate) -> str:
    """Returns a sentence in plain words on what a verdict means for small disturbances.

    For example: "a small disturbance halves every 0.83 s".

    Returns:
        The sentence. Empty for a run that diverged or whose verdict is open, because the
        verdict itself gives the reason.
    """
    stability = certificate.stability
    if certificate.end.behaviour is EndBehaviour.DIVERGED or stability is Stability.OPEN:
        return ""

    if stability is Stability.SETTLED:
        return (
            f"{describe_settling(certificate)}; "
            "`trilat certify --accept settled` counts this as success"
        )

    decay_rate = describe_pace(certificate)
    if stability is Stability.NOT_STABLE:
        return decay_rate or "the motion of this run does not come to rest"

    # The run is stable. Users would ask why if the theorem does not apply to it.
    explanation = decay_rate or "small disturbances die away"
    if not certificate.has_functional:
        return f"{explanation}; the theorem of the paper is about another control law"
    if certificate.verdict.finding is verdict_facts.StabilityFinding.DID_NOT_RISE:
        return f"{explanation}; the theorem of the paper does not apply here and is not needed"
    return explanation


def describe_settling(certificate: Certificate) -> str:
    """Returns a clause on the motion of a run that settled without a stability proof.

    In a settled run, the motion is slow or decaying, but the arms are not necessarily at rest.

    Args:
        certificate: Stability certificate of a run that settled.
    """
    speed = f"{certificate.end.end_speed_rad_s:.2g} rad/s"
    return (
        f"every small push died away and no joint was faster than {speed} at the end, but no "
        "proof exists"
    )


def describe_pace(certificate: Certificate) -> str:
    """Returns a sentence on how fast a small disturbance of the final pose decays or grows.

    For example: "a small disturbance halves every 0.83 s". The rate is that of the slowest
    characteristic root of the linearised control loop or, if any root is unstable, of the
    fastest growing one.

    Args:
        certificate: Stability certificate of the run.

    Returns:
        The sentence, or an empty string if the roots are inconclusive or their rate is unknown.
    """
    roots = certificate.roots
    if roots is None or not roots.rate_per_s:
        return ""
    if not (roots.is_proof or roots.is_refutation):
        return ""
    # A disturbance proportional to exp(rate t) changes by a factor of 2 within ln(2) / |rate|.
    verb = "halves" if roots.rate_per_s < 0.0 else "doubles"
    factor_two_s = math.log(2.0) / abs(roots.rate_per_s)
    return f"a small disturbance {verb} every {factor_two_s:.2g} s"


def _describe_verdict(certificate: Certificate) -> list[CertificateLine]:
    """Returns the first lines of a certificate: verdict, stability theorem, end of the run.

    Each line has a mark such as "ok" or "FAIL". V is the energy function of the theorem, which
    must not rise on its own in a stable run.
    """
    stability_mark = _JUDGEMENT_MARKS[certificate.stability]
    verdict_mark = "ok" if certificate.bounded_by_v else "open"
    if certificate.verdict.finding is verdict_facts.StabilityFinding.DID_NOT_RISE:
        verdict_mark = "note"  # a theorem that does not apply has neither held nor failed
    if certificate.verdict.finding is verdict_facts.StabilityFinding.BROKEN:
        stability_mark = "FAIL"
        verdict_mark = "FAIL"

    lines = [CertificateLine(stability_mark, describe_judgement(certificate))]
    if certificate.has_functional:
        lines.append(CertificateLine(verdict_mark, certificate.verdict.text))
    lines += [CertificateLine("note", text) for text in certificate.law_conditions]

    if certificate.end.behaviour is EndBehaviour.DIVERGED:
        return lines  # the judgement says already which joint exceeded its limit

    end_mark = _JUDGEMENT_MARKS[certificate.end.stability]
    lines.append(CertificateLine(end_mark, f"e and qd: {certificate.end.text}"))
    return lines


def describe_theorem(certificate: Certificate) -> list[str]:
    """Returns a line that says whether the paper's stability theorem applies to a run.

    The theorem guarantees stability if the controller and the network satisfy its premises. The
    line states whether they were satisfied in this run.

    Args:
        certificate: Stability certificate of the run.

    Returns:
        A list with the line. Empty if the theorem does not cover the control law of the run.
    """
    if not certificate.has_functional:
        return []
    text = certificate.verdict.text
    return [f"stability theorem of the paper (V: its energy function): {text}"]


def _compare_rates(
    roots: stability_decision.LoopRoots | None, twins: TwinGrowth
) -> list[CertificateLine]:
    """Returns a remark on why two decay rates differ, if they are printed differently.

    A certificate states the rate of the characteristic roots, and the rate at which small
    pushes died away in repetitions of the run (twins). Both are amplitude rates. The roots
    describe small motions near one pose, whereas a push develops along the motion of the run
    for a limited time.

    Args:
        roots: Characteristic roots of the loop at its final pose. `None` if they were not
            computed.
        twins: Growth of the pushes.

    Returns:
        A list with the remark. Empty if the rates agree, or if one of them is unknown.
    """
    worst_push = twins.worst
    if roots is None or roots.rate_per_s is None or worst_push is None:
        return []
    if (
        twins.departure is not None
        or worst_push.factor == 0.0
        or math.isnan(worst_push.rate_per_s)
    ):
        return []  # the text about the pushes states no rate of a push

    if f"{roots.rate_per_s:+.3g}" == f"{worst_push.rate_per_s:+.3g}":
        return []

    is_exact = roots.exact and not roots.is_numerical
    accuracy = "exact" if is_exact else "an approximation"
    text = (
        f"of the two rates, exp(rate t), that of the roots is {accuracy}, for small motions "
        "near the final pose; that of the pushes is measured along this run, from "
        f"{twins.from_s:.4g} to {twins.to_s:.4g} s"
    )
    return [CertificateLine("note", text)]


def _describe_evidence(certificate: Certificate) -> CertificateLine:
    """Returns a line that says whether the log is complete and intact."""
    evidence = certificate.evidence
    mark = "open" if evidence.reasons else "ok"
    if not evidence.log.integrity.passed:
        mark = "FAIL"
    return CertificateLine(mark, f"log: {evidence.text}")


def _describe_paper_weights(certificate: Certificate) -> str:
    """Returns a sentence on how much V would have risen with the weights used in the paper.

    V is the energy function in the stability proof, a weighted sum over the sites. The paper
    sets all weights to 1, which is correct only for some networks.

    Returns:
        A sentence. Empty if the paper's weights are correct for this run.
    """
    balance = certificate.paper_balance
    rise = certificate.paper_weights_rise
    if balance is None or rise is None:
        return ""
    largest_j = balance.V.max()
    sentence = f"V would have risen by {rise.amount:.3g} J of {largest_j:.4g} J"
    return f"with the paper's weights, ones, {sentence} (docs/theory/errata-proof.md, 6)"


def compose_headline(certificate: Certificate) -> str:
    """Returns the verdict on a run and the basis for it, on one line.

    For example: "stable: converged; rests on: exact roots, slowest -0.832 /s". If an arm
    exceeded its limits, the line says which joint did so, and when.

    Args:
        certificate: Stability certificate of the run.
    """
    end = certificate.end
    if end.behaviour is EndBehaviour.DIVERGED:
        return f"{certificate.stability}: {end.text}"

    stability = certificate.stability
    recorded_stability = end.behaviour.stability
    headline = f"{stability}: {_describe_end(certificate)}"
    # A proof, or the growth of small pushes, may contradict the impression from the recorded
    # motion. The line must then name both.
    if stability is Stability.STABLE and recorded_stability is not Stability.SETTLED:
        headline = f"stable by proof, although {_OTHER_ENDS[end.behaviour]}"
    elif stability is Stability.NOT_STABLE and recorded_stability is not Stability.NOT_STABLE:
        headline = f"not stable, although {_OTHER_ENDS[end.behaviour]}"
    rests_on = certificate.decision.rests_on
    return f"{headline}; rests on: {rests_on}" if rests_on else headline


def _describe_end(certificate: Certificate) -> str:
    """Returns a phrase on the end of a run's motion that claims no more than the verdict.

    Values (the error e and the joint speed |qd|) are included only if the run is judged to have
    settled.
    """
    end = certificate.end
    if certificate.stability is not Stability.SETTLED:
        return name_behaviour(end)
    if end.behaviour is EndBehaviour.DECAYS:
        error = f"|e| {end.end_error_rad:.2g} {end.error_unit}"
        speed = f"|qd| {end.end_speed_rad_s:.2g} rad/s"
        return f"{name_behaviour(end)}, with {error} and {speed} at the end"
    if end.stability is Stability.SETTLED:
        return name_behaviour(end)

    # The speed of the arms, times the length of the judged part, is below this limit.
    return (
        f"too slow to move by {SETTLED_ERROR_RAD:g} rad in the judged part, |qd| "
        f"{end.end_speed_rad_s:.2g} rad/s"
    )


def describe_judgement(certificate: Certificate) -> str:
    """Returns the stability verdict on a run, on one line.

    If the verdict is open, the line states why. Reasons that concern the end of the run are
    omitted because another line of the certificate covers them.

    Args:
        certificate: Stability certificate of the run.
    """
    if certificate.decision.is_too_short:
        return f"{certificate.stability}: {'; '.join(certificate.reasons)}"

    reasons = []
    roots = certificate.roots
    is_based_on_roots = certificate.decision.rests_on_roots_alone
    for reason in certificate.reasons:
        if is_based_on_roots and roots is not None and reason == roots.text:
            continue  # the headline names these roots already
        additional_reason = reason.removeprefix(certificate.end.text).removeprefix("; ")
        if additional_reason:
            reasons.append(additional_reason)

    return "; ".join([compose_headline(certificate), *reasons])


_JUDGEMENT_MARKS = {
    Stability.STABLE: "ok",
    Stability.SETTLED: "ok",
    Stability.NOT_STABLE: "FAIL",
    Stability.OPEN: "open",
}
_BALANCE_MARKS = {
    verdict_facts.StabilityFinding.BROKEN: "FAIL",
    verdict_facts.StabilityFinding.NOT_JUDGED: "open",
}
_OBSERVED_MARKS = {
    "passive": "ok",
    "negative": "open",
    "broken": "FAIL",
    "not_judged": "open",
}
_ROOT_MARKS = {"stable": "ok", "unstable": "open"}


def _mark_twins(twins: TwinGrowth) -> str:
    """Returns the mark of the sentence about twins: "ok" if all pushes die away.

    The mark is "FAIL" if a push grows or a repetition deviates from the run, "note" if there
    are no pushes, and "open" otherwise.
    """
    if not twins.pushes:
        return "note"
    if twins.grows or twins.departure is not None:
        return "FAIL"
    decays = twins.trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
    return "ok" if decays else "open"


def _describe_balance(balance: EnergyBalance) -> str:
    """Returns a sentence about how well the energy balance of a run closes.

    V is the energy function in the stability proof, in J. Its change should equal the work done
    on the arms minus the dissipated energy. The difference is the residual. One cause of a
    residual is sampling: the controller acts only once per tick, while the proof assumes
    continuous time. Since the work caused by sampling is known, the sentence also states how
    small the residual is without it.

    Args:
        balance: The energy balance of the run.
    """
    scale_j = balance.scale
    if scale_j <= ZERO_ENERGY_J:
        return "there is no energy in this run"

    residual_j = float(np.abs(balance.residual).max())
    unexplained_j = float(np.abs(balance.unexplained).max())
    text = f"closes to {residual_j / scale_j:.1e} of the largest energy, {scale_j:.4g} J"
    if unexplained_j >= residual_j:
        return text

    unexplained_fraction = unexplained_j / scale_j
    return f"{text}; to {unexplained_fraction:.1e} once the controller's sampling is included"


def list_energies(balance: EnergyBalance) -> list[tuple[str, float]]:
    """Lists the entries of the energy balance of V, the energy function in the stability proof.

    The entries are V at the start, the energies that changed V, and V at the end, in J.
    Energies below `MIN_ENERGY_SHARE` of the largest one are omitted. If there are more than
    `MAX_LISTED_LINKS` links, their energies are combined into one entry.

    Args:
        balance: The energy balance.

    Returns:
        One (name, energy in J) pair per entry.
    """
    link_energies: dict[str, Array] = {}
    source_energies: dict[str, Array] = {}
    for name, work in balance.work.items():
        is_link = "->" in name  # such as "m1->s"
        if is_link:
            link_energies[name] = work
        else:
            source_energies[name] = work
    if len(link_energies) > MAX_LISTED_LINKS:
        total_j = np.sum(list(link_energies.values()), axis=0)
        link_energies = {count_nouns(len(link_energies), "link"): total_j}

    entries = {}
    for name, energy in balance.dissipation.items():
        entries[f"dissipated: {name}"] = -energy
    for name, energy in (source_energies | link_energies).items():
        entries[f"supplied: {_SOURCE_NAMES.get(name, name)}"] = energy
    entries["supplied: sampling of the controller"] = balance.sampling
    entries["transferred, not cancelled by beta"] = -balance.transfer
    has_no_gaps = balance.judged.all()
    unexplained_name = "unexplained" if has_no_gaps else "in gaps, or unexplained"
    entries[unexplained_name] = _compute_rest(balance)

    smallest_listed_j = MIN_ENERGY_SHARE * balance.scale + ZERO_ENERGY_J
    listed = [_describe_v(balance, 0)]
    for name, energy in entries.items():
        if np.abs(energy).max() > smallest_listed_j:
            listed.append((name, float(energy[-1])))
    return [*listed, _describe_v(balance, -1)]


def _compute_rest(balance: EnergyBalance) -> Array:
    """Returns the change of the energy V that no known cause explains, in J, shape (T,).

    The table of energies lists this change as "unexplained". It should be close to 0, except in
    gaps of the records.
    """
    gained = sum(balance.work.values())
    lost = sum(balance.dissipation.values())
    explained = gained - lost + balance.sampling - balance.transfer
    rest: Array = balance.V - balance.V[0] - explained
    return rest


def _describe_v(balance: EnergyBalance, index: int) -> tuple[str, float]:
    """Returns the name and the value in J of the energy function V at one tick.

    The name is, for example, "V at 2.5 s". If V is smaller than the rounding errors, 0 is
    returned.
    """
    energy_j = float(balance.V[index])
    shown_j = energy_j if energy_j > ZERO_ENERGY_J else 0.0
    return f"V at {balance.t_s[index]:.4g} s", shown_j

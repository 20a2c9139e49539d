"""Text of a stability certificate, for the terminal and the report page.

Invariant:
    - The terminal and the page show the same sentences.
    - The verdict comes first.
    - The listed energies add up: V at the end is V at the start plus all other entries, up to
      the entries too small to be listed.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..analysis.certificate.energy_balance import ZERO_ENERGY_J, EnergyBalance
from ..analysis.certificate.observed_energy import ObservedFinding
from ..analysis.certificate.stability_certificate import Certificate, StabilityFinding
from ..analysis.envelope_trend import EnvelopeTrend
from ..analysis.run_end import Stability
from ..analysis.twin_growth import PushedTwins, TwinGrowth
from ..errors import count_nouns
from .result_text import MARKS, Block, MarkedText, TextTable

MIN_ENERGY_SHARE = 1e-6
"""Smallest listed energy, as a share of the largest energy."""
MAX_LISTED_LINKS = 6
"""Largest number of links listed one by one; the energies of more links are summed."""
_SOURCE_NAMES = {
    "rule": "rule for stale peers",
    "shares": "change of shares",
    "estimates": "box, or wrong estimates",
}
"""Texts of the sources of energy other than links, by their names in a balance."""

_HOLDS = {True: "holds", False: "fails", None: "undecided"}


def compose_certificate(certificate: Certificate) -> Iterator[Block]:
    """Yields the judgement and its grounds, then tables of the premises and the energies."""
    for line in describe_certificate(certificate):
        yield MarkedText(MARKS[line.mark], line.text)
    observed = certificate.observed
    premises = list(certificate.premises)
    if observed is not None:
        premises += observed.premises
    rows = [(premise.name, _HOLDS[premise.holds], premise.text) for premise in premises]
    yield ""
    styles = {"holds": "green", "fails": "yellow"}
    yield TextTable(("premise", "", "found"), rows, styles=styles)
    if observed is not None and observed.least:
        least = [
            (name, f"{amount_j:.4g}", f"{at_s:.4g}") for name, amount_j, at_s in observed.least
        ]
        yield ""
        yield TextTable(("energy of the laws", "least J", "at s"), least, align="lrr")
    if certificate.balance is None:
        return
    energies = [(name, f"{amount:.4g}") for name, amount in list_energies(certificate.balance)]
    yield ""
    yield TextTable(("energy", "J"), energies, align="lr")


def compose_twins(twins: PushedTwins) -> Iterator[Block]:
    """Yields the sizes for which a push acts linearly, and a line on each push."""
    if twins.linear is not None or not twins.growth.pushes:
        yield twins.headline()
    yield from map(twins.describe, twins.growth.pushes)
    if not twins.growth.same_platform:
        cause = "another platform, or version"
        yield f"note: executed again, its last bits are not those of the records: {cause}"


class CertificateLine(NamedTuple):
    """One sentence of a certificate.

    Attributes:
        mark: "ok" for a sentence that supports the stability of the run, "FAIL" for one against
            stability, "open" for one that leaves the question open, or "note".
        text: the sentence.
    """

    mark: str
    text: str


def describe_certificate(certificate: Certificate) -> list[CertificateLine]:
    """Returns the judgement and then its grounds, each as a marked sentence.

    The grounds are V, the end of the run, the energy balance, the energy of the laws, the
    roots, the twins that were pushed, and the log.
    """
    finding = certificate.verdict.finding
    if finding is StabilityFinding.BROKEN:
        stability_mark = "FAIL"
        verdict_mark = "FAIL"
    else:
        stability_mark = _JUDGEMENT[certificate.stability]
        verdict_mark = "ok" if certificate.bounded_by_v else "open"
    lines = [(stability_mark, describe_judgement(certificate))]
    lines.append((verdict_mark, certificate.verdict.text))
    lines.append((_JUDGEMENT[certificate.end.stability], f"e and qd: {certificate.end.text}"))
    if certificate.balance is not None:
        mark = _BALANCE.get(finding, "ok")
        lines.append((mark, f"energy balance: {describe_balance(certificate.balance)}"))
    if certificate.observed is not None:
        lines.append((_OBSERVED[certificate.observed.finding], certificate.observed.text))
    if certificate.roots is not None:
        verdict = certificate.roots.verdict
        # roots that are not exact cannot show stability
        doubtful = not certificate.roots.exact and verdict == "stable"
        mark = "note" if doubtful else _ROOTS.get(verdict, "note")
        lines.append((mark, certificate.roots.text))
    if certificate.twins is not None:
        lines.append((_mark_twins(certificate.twins), certificate.twins.text))
    intact = "open" if certificate.evidence.reasons else "ok"
    mark = intact if certificate.evidence.integrity.passed else "FAIL"
    lines.append((mark, f"log: {certificate.evidence.text}"))
    if certificate.paper_balance is not None and certificate.paper_weights_rise is not None:
        rise_j = certificate.paper_weights_rise.amount
        largest_j = certificate.paper_balance.V.max()
        rise = f"V would have risen by {rise_j:.3g} J of {largest_j:.4g} J"
        lines.append(("note", f"with the paper's weights, ones, {rise} (docs/errata.md, 6)"))
    return [CertificateLine(mark, text) for mark, text in lines]


def describe_judgement(certificate: Certificate) -> str:
    """Returns the judgement in one line: its headline, and the reasons that leave it open."""
    return "; ".join([certificate.headline(), *certificate.reasons])


_JUDGEMENT = {Stability.STABLE: "ok", Stability.NOT_STABLE: "FAIL", Stability.OPEN: "open"}
_BALANCE = {StabilityFinding.BROKEN: "FAIL", StabilityFinding.NOT_JUDGED: "open"}
_OBSERVED = {
    ObservedFinding.PASSIVE: "ok",
    ObservedFinding.NEGATIVE: "open",
    ObservedFinding.BROKEN: "FAIL",
    ObservedFinding.NOT_JUDGED: "open",
}
_ROOTS = {"stable": "ok", "unstable": "open"}


def _mark_twins(twins: TwinGrowth) -> str:
    if not twins.pushes:
        return "note"
    if twins.grows or twins.departure is not None:
        return "FAIL"
    return "ok" if twins.trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY) else "open"


def describe_balance(balance: EnergyBalance) -> str:
    """Returns a sentence on how closely the energy balance closes."""
    residual_j = float(np.abs(balance.residual).max())
    unexplained_j = float(np.abs(balance.unexplained).max())
    scale = balance.scale
    if scale <= ZERO_ENERGY_J:
        return "there is no energy in this run"
    text = f"closes to {residual_j / scale:.1e} of the largest energy, {scale:.4g} J"
    if unexplained_j >= residual_j:
        return text
    return f"{text}; to {unexplained_j / scale:.1e} once the controller's sampling is booked"


def list_energies(balance: EnergyBalance) -> list[tuple[str, float]]:
    """Returns V at the start, the energies that changed V, and V at the end, in J.

    Energies below `MIN_ENERGY_SHARE` of the largest energy are left out.
    """
    links = {name: work for name, work in balance.work.items() if "->" in name}
    sources = {name: work for name, work in balance.work.items() if "->" not in name}
    if len(links) > MAX_LISTED_LINKS:
        links = {count_nouns(len(links), "link"): np.sum(list(links.values()), axis=0)}
    gained = sum(balance.work.values())
    lost = sum(balance.dissipation.values())
    rest = balance.V - balance.V[0] - (gained - lost + balance.sampling - balance.transfer)
    entries = {f"taken: {name}": -energy for name, energy in balance.dissipation.items()}
    for name, energy in (sources | links).items():
        entries[f"given: {_SOURCE_NAMES.get(name, name)}"] = energy
    entries["given: sampling of the controller"] = balance.sampling
    entries["left by beta"] = -balance.transfer
    entries["unexplained" if balance.judged.all() else "in gaps, or unexplained"] = rest
    least_j = MIN_ENERGY_SHARE * balance.scale + ZERO_ENERGY_J
    listed = [_describe_v(balance, 0)]
    for name, energy in entries.items():
        if np.abs(energy).max() > least_j:
            listed.append((name, float(energy[-1])))
    return [*listed, _describe_v(balance, -1)]


def _describe_v(balance: EnergyBalance, index: int) -> tuple[str, float]:
    energy_j = balance.V[index]
    shown_j = float(energy_j) if energy_j > ZERO_ENERGY_J else 0.0
    return f"V at {balance.t_s[index]:.4g} s", shown_j

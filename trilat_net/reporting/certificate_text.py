"""Text of a stability certificate, for the terminal and the report page.

Invariant: both show the same sentences; the verdict comes first, and the listed energies add
up.
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
"""Smaller shares of the largest energy are not listed."""
MAX_LISTED_LINKS = 6
"""Links that are listed one by one."""
_SOURCE_NAMES = {
    "rule": "rule for stale peers",
    "shares": "change of shares",
    "estimates": "box, or wrong estimates",
}


_HOLDS = {True: "holds", False: "fails", None: "not told"}


def compose_certificate(found: Certificate) -> Iterator[Block]:
    """Yields the judgement with what it rests on, the premises, and the energies."""
    for line in describe_certificate(found):
        yield MarkedText(MARKS[line.mark], line.text)
    observed = found.observed
    premises = [*found.premises, *(() if observed is None else observed.premises)]
    rows = [(premise.name, _HOLDS[premise.holds], premise.text) for premise in premises]
    yield ""
    yield TextTable(
        ("premise", "", "found"), rows, styles={"holds": "green", "fails": "yellow"}
    )
    if observed is not None and observed.least:
        least = [
            (name, f"{amount_j:.4g}", f"{at_s:.4g}") for name, amount_j, at_s in observed.least
        ]
        yield ""
        yield TextTable(("energy of the laws", "least J", "at s"), least, align="lrr")
    if found.balance is None:
        return
    energies = [(name, f"{amount:.4g}") for name, amount in list_energies(found.balance)]
    yield ""
    yield TextTable(("energy", "J"), energies, align="lr")


def compose_twins(found: PushedTwins) -> Iterator[Block]:
    """Yields for which sizes a push is linear, and what became of each push."""
    if found.linear is not None or not found.growth.pushes:
        yield found.headline()
    yield from map(found.describe, found.growth.pushes)
    if not found.growth.same_platform:
        yield "note: executed again, its last bits are not those of the records: another platform, or version"


class CertificateLine(NamedTuple):
    """One sentence of a certificate.

    Attributes:
        mark: "ok": it supports the run; "FAIL": it speaks against it; "open": it decides
            nothing; or "note".
    """

    mark: str
    text: str


def describe_certificate(found: Certificate) -> list[CertificateLine]:
    """Returns the judgement, and then what it rests on: V, the end of the run, the balance, the
    roots.
    """
    finding = found.verdict.finding
    broken = finding is StabilityFinding.BROKEN
    stable = "FAIL" if broken else _JUDGEMENT[found.stability]
    verdict = "FAIL" if broken else "ok" if found.bounded_by_v else "open"
    lines = [(stable, describe_judgement(found)), (verdict, found.verdict.text)]
    lines.append((_JUDGEMENT[found.end.stability], f"e and qd: {found.end.text}"))
    if found.balance is not None:
        mark = _BALANCE.get(finding, "ok")
        lines.append((mark, f"energy balance: {describe_balance(found.balance)}"))
    if found.observed is not None:
        lines.append((_OBSERVED[found.observed.finding], found.observed.text))
    if found.roots is not None:
        doubtful = not found.roots.exact and found.roots.verdict == "stable"
        lines.append(
            ("note" if doubtful else _ROOTS.get(found.roots.verdict, "note"), found.roots.text)
        )
    if found.twins is not None:
        lines.append((_mark_twins(found.twins), found.twins.text))
    intact = "open" if found.evidence.reasons else "ok"
    mark = intact if found.evidence.integrity.passed else "FAIL"
    lines.append((mark, f"log: {found.evidence.text}"))
    if found.paper_balance is not None and found.paper_weights_rise is not None:
        rise_j = found.paper_weights_rise.amount
        largest_j = found.paper_balance.V.max()
        risen = f"V would have risen by {rise_j:.3g} J of {largest_j:.4g} J"
        lines.append(("note", f"with the paper's weights, ones, {risen} (docs/errata.md, 6)"))
    return [CertificateLine(*line) for line in lines]


def describe_judgement(found: Certificate) -> str:
    """Returns the judgement in one line: the word, how the run ended, and what leaves it open."""
    return "; ".join([found.headline(), *found.reasons])


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
    """Returns the residual of the balance, in words."""
    residual, rest = (float(np.abs(x).max()) for x in (balance.residual, balance.unexplained))
    scale = balance.scale
    if scale <= ZERO_ENERGY_J:
        return "there is no energy in this run"
    text = f"closes to {residual / scale:.1e} of the largest energy, {scale:.4g} J"
    if rest >= residual:
        return text
    return f"{text}; to {rest / scale:.1e} once the controller's sampling is booked"


def list_energies(balance: EnergyBalance) -> list[tuple[str, float]]:
    """Returns V at the start, the energies that changed it, and V at the end, J; tiny ones are
    left out.
    """
    links = {name: x for name, x in balance.work.items() if "->" in name}
    given = {name: x for name, x in balance.work.items() if name not in links}
    if len(links) > MAX_LISTED_LINKS:
        links = {f"{count_nouns(len(links), 'link')}": np.sum(list(links.values()), axis=0)}
    gained = sum(balance.work.values())
    lost = sum(balance.dissipation.values())
    rest = balance.V - balance.V[0] - (gained - lost + balance.sampling - balance.transfer)
    entries = {
        **{f"taken: {name}": -values for name, values in balance.dissipation.items()},
        **{
            f"given: {_SOURCE_NAMES.get(name, name)}": values
            for name, values in (given | links).items()
        },
        "given: sampling of the controller": balance.sampling,
        "left by beta": -balance.transfer,
        "unexplained" if balance.judged.all() else "in gaps, or unexplained": rest,
    }
    least = MIN_ENERGY_SHARE * balance.scale + ZERO_ENERGY_J
    shown = [(name, float(x[-1])) for name, x in entries.items() if np.abs(x).max() > least]
    ends = (float(x) if x > ZERO_ENERGY_J else 0.0 for x in (balance.V[0], balance.V[-1]))
    first, last = (
        (f"V at {t_s:.4g} s", x)
        for t_s, x in zip((balance.t_s[0], balance.t_s[-1]), ends, strict=True)
    )
    return [first, *shown, last]

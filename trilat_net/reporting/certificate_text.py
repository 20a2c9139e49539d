"""Text of a stability certificate, for the terminal and the report page.

Invariant: both show the same sentences; the verdict comes first, and the listed energies add up.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..analysis.certificate.energy_balance import ZERO_ENERGY_J, EnergyBalance
from ..analysis.certificate.stability_certificate import Certificate, StabilityFinding

MIN_ENERGY_SHARE = 1e-6
"""Smaller shares of the largest energy are not listed."""
MAX_LISTED_LINKS = 6
"""Links that are listed one by one."""
_SOURCE_NAMES = {
    "rule": "rule for stale peers",
    "shares": "change of shares",
    "estimates": "box, or wrong estimates",
}


class CertificateMark(StrEnum):
    """Effect of a line on the exit code."""

    OK = "ok"
    FAIL = "FAIL"
    OPEN = "open"
    NOTE = "note"


class CertificateLine(NamedTuple):
    """One sentence, and what it does: ok supports the run, FAIL alone fails it, open decides nothing."""

    mark: CertificateMark
    text: str


def describe_certificate(found: Certificate) -> list[CertificateLine]:
    """Returns the verdict, the growth, and the balance."""
    finding = found.verdict.finding
    broken = finding is StabilityFinding.BROKEN
    verdict = (
        CertificateMark.FAIL if broken else CertificateMark.OK if found.bounded_by_v else CertificateMark.OPEN
    )
    lines = [(verdict, found.verdict.text)]
    lines.append((_GROWTH[found.end.behaviour.grows], f"e and qd: {found.end.text}"))
    if found.balance is not None:
        mark = _BALANCE.get(finding, CertificateMark.OK)
        lines.append((mark, f"energy balance: {describe_balance(found.balance)}"))
    if found.ones is not None and found.ones_rise is not None:
        risen = f"V would have risen by {found.ones_rise.amount:.3g} J of {found.ones.V.max():.4g} J"
        text = f"with the paper's weights, ones, {risen} (docs/errata.md, 6)"
        lines.append((CertificateMark.NOTE, text))
    return [CertificateLine(*line) for line in lines]


_GROWTH = {True: CertificateMark.FAIL, False: CertificateMark.OK, None: CertificateMark.OPEN}
_BALANCE = {StabilityFinding.BROKEN: CertificateMark.FAIL, StabilityFinding.NOT_JUDGED: CertificateMark.OPEN}


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
    """Returns V at the start, the energies that changed it, and V at the end, J; tiny ones are left out."""
    links = {name: x for name, x in balance.work.items() if "->" in name}
    given = {name: x for name, x in balance.work.items() if name not in links}
    if len(links) > MAX_LISTED_LINKS:
        links = {f"{len(links)} links": np.sum(list(links.values()), axis=0)}
    gained, lost = sum(balance.work.values()), sum(balance.dissipation.values())
    rest = balance.V - balance.V[0] - (gained - lost + balance.sampling - balance.transfer)
    entries = {
        **{f"taken: {name}": -values for name, values in balance.dissipation.items()},
        **{f"given: {_SOURCE_NAMES.get(name, name)}": values for name, values in (given | links).items()},
        "given: sampling of the controller": balance.sampling,
        "left by beta": -balance.transfer,
        "unexplained" if balance.judged.all() else "in gaps, or unexplained": rest,
    }
    least = MIN_ENERGY_SHARE * balance.scale + ZERO_ENERGY_J
    shown = [(name, float(x[-1])) for name, x in entries.items() if np.abs(x).max() > least]
    ends = (float(x) if x > ZERO_ENERGY_J else 0.0 for x in (balance.V[0], balance.V[-1]))
    first, last = (
        (f"V at {t_s:.4g} s", x) for t_s, x in zip((balance.t_s[0], balance.t_s[-1]), ends, strict=True)
    )
    return [first, *shown, last]

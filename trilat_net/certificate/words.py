"""A certificate in words, for a terminal and for the page.

Law: the same words in both; the verdict comes first, and the energies below it add up.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .balance import NOTHING_J, Balance
from .certificate import Certificate
from .verdict import Finding

LEAST = 1e-6
"""A share of the largest energy below which nobody is listed."""
LINKS = 6
"""Links that are listed one by one."""
_PEOPLE = {
    "rule": "rule for stale peers",
    "shares": "change of shares",
    "estimates": "box, or wrong estimates",
}


class Mark(StrEnum):
    """What a line does to the exit code."""

    OK = "ok"
    FAIL = "FAIL"
    OPEN = "open"
    NOTE = "note"


class Line(NamedTuple):
    """One sentence.

    Attributes:
        mark: ok: it vouches for the run; FAIL: it alone fails it; open: it decides nothing; note: beside it.
        text: the sentence.
    """

    mark: Mark
    text: str


def lines(found: Certificate) -> list[Line]:
    """Returns the verdict, the growth, and the balance."""
    finding = found.verdict.finding
    broken = finding is Finding.BROKEN
    verdict = Mark.FAIL if broken else Mark.OK if found.bounded_by_v else Mark.OPEN
    said = [
        Line(verdict, found.verdict.text),
        Line(_GROWTH[found.growth.grows], f"e and qd: {found.growth.text}"),
    ]
    if found.balance is not None:
        said.append(Line(_BALANCE.get(finding, Mark.OK), f"energy balance: {balance_text(found.balance)}"))
    if found.ones is not None and found.ones_rise is not None:
        risen = f"V would have risen by {found.ones_rise.amount:.3g} J of {found.ones.V.max():.4g} J"
        said.append(Line(Mark.NOTE, f"with the paper's weights, ones, {risen} (docs/errata.md, 6)"))
    return said


_GROWTH = {True: Mark.FAIL, False: Mark.OK, None: Mark.OPEN}
_BALANCE = {Finding.BROKEN: Mark.FAIL, Finding.NOT_JUDGED: Mark.OPEN}


def balance_text(balance: Balance) -> str:
    """Returns how well the balance closes."""
    residual, rest = (float(np.abs(x).max()) for x in (balance.residual, balance.unexplained))
    scale = balance.scale
    if scale <= NOTHING_J:
        return "there is no energy in this run"
    text = f"closes to {residual / scale:.1e} of the largest energy, {scale:.4g} J"
    if rest >= residual:
        return text
    return f"{text}; to {rest / scale:.1e} once the controller's sampling is booked"


def energies(balance: Balance) -> list[tuple[str, float]]:
    """Returns V at the start and what made V at the end of it, in J; what is next to nothing is left out."""
    links = {name: x for name, x in balance.given.items() if "->" in name}
    given = {name: x for name, x in balance.given.items() if name not in links}
    if len(links) > LINKS:
        links = {f"{len(links)} links": np.sum(list(links.values()), axis=0)}
    entries = {
        **{f"taken: {name}": -values for name, values in balance.taken.items()},
        **{f"given: {_PEOPLE.get(name, name)}": values for name, values in (given | links).items()},
        "given: sampling of the controller": balance.sampling,
        "left by beta": -balance.passed,
        "unexplained" if balance.judged.all() else "in gaps, or unexplained": _rest(balance),
    }
    least = LEAST * balance.scale + NOTHING_J
    shown = [(name, float(x[-1])) for name, x in entries.items() if np.abs(x).max() > least]
    ends = (float(x) if x > NOTHING_J else 0.0 for x in (balance.V[0], balance.V[-1]))
    first, last = (
        (f"V at {t_s:.4g} s", x) for t_s, x in zip((balance.t_s[0], balance.t_s[-1]), ends, strict=True)
    )
    return [first, *shown, last]


def _rest(balance: Balance) -> Array:
    """Returns what nobody gave or took, in the gaps too, shape (T,), J."""
    known = sum(balance.given.values()) - sum(balance.taken.values()) + balance.sampling - balance.passed
    rest: Array = balance.V - balance.V[0] - known
    return rest

"""What V did, and what that means.

Law: V falls but for what somebody gave. What rises beyond hands and walls is named with its time, its amount,
and who gave it; what nobody gave is a log that its equations did not make.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .balance import NOTHING_J, Balance
from .book import Book
from .premises import Premise

BROKEN = 2e-4
"""What may be unexplained at most, as a share of the scale, beyond what the trapezoid rule may be off."""
SAMPLED = 1e-4
"""Rises up to this share of the scale are put down to sampling where the residual is as large."""


class Finding(StrEnum):
    """How a certificate came out; the text is the word for people."""

    COVERED = "covered by the theorem"
    DID_NOT_RISE = "outside the theorem, yet V did not rise"
    ROSE = "V rose"
    BROKEN = "the energy balance is broken"
    NOT_JUDGED = "V cannot be judged"


class Rise(NamedTuple):
    """The largest rise of V that neither hands nor walls gave.

    Attributes:
        from_s: when V was lowest before it, s.
        at_s: when it was highest, s.
        amount: by how much, J.
        causes: who gave how much in between, J, largest first.
    """

    from_s: float
    at_s: float
    amount: float
    causes: dict[str, float]


class Verdict(NamedTuple):
    """What V did.

    Attributes:
        finding: the word.
        text: the sentence.
        rise: the largest rise beyond the tolerance; None where V did not rise.
        tolerance: what a rise must exceed, J.
    """

    finding: Finding
    text: str
    rise: Rise | None = None
    tolerance: float = 0.0


def verdict(premises: list[Premise], books: Mapping[str, Book], balance: Balance) -> Verdict:
    """Returns the verdict on a log whose sites have functionals.

    Args:
        premises: the theorem's, as they were found.
        books: of every site.
        balance: of all sites.
    """
    sampled = min(_spread(balance.residual), SAMPLED * balance.scale)
    tolerance = _spread(balance.unexplained) + sampled + NOTHING_J
    broken = broken_text(books, balance)
    if broken:
        return Verdict(Finding.BROKEN, broken, None, tolerance)
    rise = largest(balance, tolerance)
    failed = [premise.name for premise in premises if premise.holds is False]
    if rise is not None:
        where = f"outside the theorem ({', '.join(failed)})" if failed else "its premises hold, but"
        return Verdict(Finding.ROSE, f"{where}: {_rise_text(rise)}", rise, tolerance)
    text = _fell(balance) + "".join(f"; {p.text}" for p in premises if p.holds is None)
    if failed:
        return Verdict(
            Finding.DID_NOT_RISE, f"outside the theorem ({', '.join(failed)}), yet {text}", None, tolerance
        )
    return Verdict(Finding.COVERED, f"covered by the theorem: {text}", None, tolerance)


def largest(balance: Balance, tolerance: float) -> Rise | None:
    """Returns the largest rise of V that neither hands nor walls gave, where it exceeds a tolerance."""
    V = balance.own
    above = V - np.minimum.accumulate(V)
    last = int(above.argmax())
    if above[last] <= tolerance:
        return None
    first = int(V[: last + 1].argmin())
    sources = {
        **{("" if "->" in name else "the ") + name: x for name, x in balance.given.items()},
        "sampling": balance.sampling,
        "what beta does not cancel": -balance.passed,
    }
    for name in ("the hands", "the walls"):
        del sources[name]
    causes = {name: float(x[last] - x[first]) for name, x in sources.items()}
    ordered = sorted(causes.items(), key=lambda cause: -cause[1])
    notable = {name: amount for name, amount in ordered if amount > 0.05 * above[last]}
    return Rise(float(balance.t_s[first]), float(balance.t_s[last]), float(above[last]), notable)


def limit(books: Mapping[str, Book], balance: Balance) -> float:
    """Returns how much may be unexplained before a balance counts as broken, J."""
    weights = np.abs(balance.beta).max(axis=0)
    doubt = sum(float(w) * book.doubt for w, book in zip(weights, books.values(), strict=True))
    return BROKEN * balance.scale + 2.0 * doubt + NOTHING_J


def broken_text(books: Mapping[str, Book], balance: Balance) -> str:
    """Says where a balance does not close; "" where it does. Each site counts by itself."""
    allowed = limit(books, balance)
    worst = {site: float(np.abs(book.unexplained).max()) for site, book in books.items()}
    site = max(worst, key=lambda name: worst[name])
    if worst[site] <= allowed or not np.isfinite(allowed):
        return ""
    off = np.abs(books[site].unexplained)
    at_s = books[site].track.t_s[int(np.argmax(off > allowed))]
    return (
        f"the energy of {site} does not add up from {at_s:.4g} s on, by {worst[site]:.3g} J of "
        f"{balance.scale:.4g}: these records were not made by the equations that the log claims"
    )


def _rise_text(rise: Rise) -> str:
    causes = ", ".join(f"{name} {amount:.3g} J" for name, amount in list(rise.causes.items())[:4])
    who = f"; given by {causes}" if causes else "; nobody gave it"
    return f"V rose by {rise.amount:.3g} J from {rise.from_s:.4g} to {rise.at_s:.4g} s{who}"


def _fell(balance: Balance) -> str:
    went = f"it went from {balance.V[0]:.4g} to {balance.V[-1]:.4g} J"
    if balance.pushed.any():
        return f"V rose by no more than hands and walls gave; {went}"
    return f"V did not rise; {went}"


def _spread(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0

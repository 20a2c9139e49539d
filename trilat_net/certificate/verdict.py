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
FIRM = 1e-3
"""With more than this, and no doubt of that size, the period is not to blame."""
SAMPLED = 1e-4
"""Rises up to this share of the scale are put down to sampling where the residual is as large."""


COARSE = 1e-2
"""A tolerance of more than this share of the scale says nothing of a rise."""


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
    tolerance = _tolerance(balance)
    unsound = unsound_verdict(books, balance)
    if unsound is not None:
        return unsound._replace(tolerance=tolerance)
    if tolerance > COARSE * balance.scale + 2.0 * NOTHING_J:
        return not_judged(f"{_TOO_COARSE} {tolerance:.3g} J of {balance.scale:.4g} J")._replace(
            tolerance=tolerance
        )
    rise = largest(balance, tolerance)
    failed = [premise.name for premise in premises if premise.holds is False]
    where = f"outside the theorem ({', '.join(failed)})"
    if rise is not None:
        held = "though the premises of the theorem hold, which is one of continuous time"
        text = f"{where if failed else held}: {_rise_text(rise, balance)}"
        return Verdict(Finding.ROSE, text, rise, tolerance)
    untold = [premise.text for premise in premises if premise.holds is None]
    text = "; ".join([_fell(balance), *untold])
    if failed:
        return Verdict(Finding.DID_NOT_RISE, f"{where}, yet {text}", None, tolerance)
    covered = f"{Finding.COVERED}, as far as the log tells" if untold else Finding.COVERED
    return Verdict(Finding.COVERED, f"{covered}: {text}", None, tolerance)


_TOO_COARSE = "the period is too long for these gains, so that its energies are known only to"


def not_judged(why: str) -> Verdict:
    """Returns the verdict on a log that has no V."""
    return Verdict(Finding.NOT_JUDGED, f"{Finding.NOT_JUDGED}: {why}")


def unsound_verdict(books: Mapping[str, Book], balance: Balance) -> Verdict | None:
    """Returns the verdict where a balance does not close; None where all do. Each site counts by itself.

    An arm outside of the program need not be what its theta says, nor are its angles and velocities measured
    at once; any other's records are not what they claim, unless the period may be to blame.
    """
    off = {site: np.abs(book.unexplained) for site, book in books.items()}
    wrong = [site for site, book in books.items() if float(off[site].max()) > allowed(book, balance)]
    outside = [site for site, book in books.items() if book.eq.outside]
    ours = [site for site in wrong if site not in outside and not books[site].followed.intersection(outside)]
    site = max(ours or wrong, key=lambda name: float(off[name].max()), default=None)
    if site is None:
        return None
    book, worst = books[site], float(off[site].max())
    at_s = book.track.t_s[int(np.argmax(off[site] > allowed(book, balance)))]
    amount = f"{worst:.3g} J of {balance.scale:.4g} J"
    text = f"the energy of {site} does not add up from {at_s:.4g} s on, by {amount}"
    if not ours:
        arms = ", ".join(outside)
        return not_judged(f"{text}: the arm of {arms}, outside of the program, {_OUTSIDE}")
    why = FALSE if worst > allowed(book, balance, FIRM) and book.doubt < FIRM * balance.scale else _OPEN
    return Verdict(Finding.BROKEN, f"{Finding.BROKEN}: {text}: {why}")


_OUTSIDE = "does not move as its theta says, or somebody pushes it"
FALSE = "these records were not made by the equations that the log claims"
_OPEN = f"the period is too long for these gains, or {FALSE}; `trilat verify` tells which"


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


def allowed(book: Book, balance: Balance, share: float = BROKEN) -> float:
    """Returns how much of a site's energy may be unexplained before its balance counts as broken, J."""
    return share * balance.scale + 2.0 * book.doubt + NOTHING_J


def _tolerance(balance: Balance) -> float:
    sampled = min(_spread(balance.residual), SAMPLED * balance.scale)
    return _spread(balance.unexplained) + sampled + NOTHING_J


def _rise_text(rise: Rise, balance: Balance) -> str:
    causes = ", ".join(f"{name} {amount:.3g} J" for name, amount in list(rise.causes.items())[:4])
    who = f"; given by {causes}" if causes else "; nobody gave it"
    share = f"{100.0 * rise.amount / balance.V.max():.2g} % of its largest value"
    return f"V rose by {rise.amount:.3g} J ({share}) from {rise.from_s:.4g} to {rise.at_s:.4g} s{who}"


def _fell(balance: Balance) -> str:
    first, last = (x if x > NOTHING_J else 0.0 for x in (balance.V[0], balance.V[-1]))
    from_s, to_s = balance.t_s[0], balance.t_s[-1]
    went = f"{first:.4g} J at {from_s:.4g} s, {last:.4g} J at {to_s:.4g} s"
    if balance.pushers:
        return f"V rose by no more than the {' and '.join(balance.pushers)} gave: {went}"
    return f"V did not rise: {went}"


def _spread(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0

"""The certificate of a log: premises, functional, balance, growth, and the verdict of them all.

Law: what a log cannot tell is said, and it is judged by what it can: without a functional by growth alone.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..log.reader import Log
from .balance import Balance, alpha_at, balance
from .book import Book, books
from .growth import Growth, Motion, growth
from .premises import Premise, groups_text, of_run, of_scenario
from .verdict import Finding, Verdict, broken_text, verdict
from .weights import weights

NO_COMMON_TIME = "there is no time of which every site has records"


class Certificate(NamedTuple):
    """All that is certified of a log.

    Attributes:
        premises: the theorem's, as they were found.
        verdict: what V did.
        growth: what e and qd do at the end.
        books: of every site; {} where there is no functional.
        balance: of all sites; None where there is no functional.
    """

    premises: list[Premise]
    verdict: Verdict
    growth: Growth
    books: dict[str, Book]
    balance: Balance | None

    @property
    def bounded_by_v(self) -> bool:
        """True where V bounds every site: it did not rise, and no site's weight in it is zero."""
        if self.balance is None or self.verdict.finding not in (Finding.COVERED, Finding.DID_NOT_RISE):
            return False
        return bool((self.balance.beta > 0.0).all())

    @property
    def passed(self) -> bool:
        """What decides the exit code: the balance holds, and V or the growth says that the run is bounded.

        Undecided growth is no pass, as for `stable` of `trilat test`.
        """
        if self.verdict.finding is Finding.BROKEN or self.growth.motion is Motion.DIVERGED:
            return False
        return self.bounded_by_v or self.growth.grows is False


def certify(log: Log) -> Certificate:
    """Returns the certificate of a log; torn, short and empty ones too.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    premises, grown = of_scenario(log.scenario), growth(log)
    if not premises[0].holds:
        return _without(premises, grown, premises[0].text)
    found = books(log)
    if not found:
        return _without(premises, grown, NO_COMMON_TIME)
    refused = _groups(log, found)
    booked = balance(found)
    premises += of_run(log, found, booked)
    if refused:
        broken = broken_text(found, booked)
        said = Verdict(Finding.BROKEN, broken) if broken else Verdict(Finding.NOT_JUDGED, refused)
        return Certificate(premises, said, grown, found, None)
    return Certificate(premises, verdict(premises, found, booked), grown, found, booked)


def _without(premises: list[Premise], grown: Growth, why: str) -> Certificate:
    return Certificate(premises, Verdict(Finding.NOT_JUDGED, why), grown, {}, None)


def _groups(log: Log, found: dict[str, Book]) -> str:
    """Says why there is no unique beta; "" where there is one all the time."""
    Kd = np.array([book.eq.Kd for book in found.values()])
    for alpha in _matrices(found):
        weighed = weights(alpha, Kd)
        if not weighed.unique:
            return groups_text(log.scenario.names, weighed)
    return ""


def _matrices(found: dict[str, Book]) -> Array:
    """Returns every dominance matrix that was in force, of a ramp its ends, shape (M, N, N)."""
    tracks = [book.track for book in found.values()]
    times = [tracks[0].t_s[:1]]
    for book in found.values():
        moving = np.flatnonzero(np.diff(book.shares.rate, axis=0, prepend=0.0).any(axis=1))
        stepping = np.flatnonzero((book.shares.alpha[1:] != book.shares.before).any(axis=1)) + 1
        times += [book.track.t_s[moving], book.track.t_s[stepping]]
    return alpha_at(found, np.concatenate(times))

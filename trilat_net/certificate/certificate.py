"""The certificate of a log: premises, functional, balance, growth, and the verdict of them all.

Law: what a log cannot tell is said, and it is judged by what it can: without a functional by growth alone.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..log.reader import Log
from .balance import Balance, alpha_at, balance
from .book import Book, books
from .growth import Growth, growth
from .premises import Premise, groups_text, of_run, of_scenario
from .verdict import Finding, Rise, Verdict, largest, not_judged, unsound_verdict, verdict
from .weights import closed_groups

NO_COMMON_TIME = "there is no time of which every site has records"
NO_PERIOD = "there is no period of which all records are there"


class Certificate(NamedTuple):
    """All that is certified of a log.

    Attributes:
        premises: the theorem's, as they were found.
        verdict: what V did.
        growth: what e and qd do at the end.
        books: of every site; {} where there is no functional.
        balance: of all sites; None where there is no functional.
        ones: the same with the paper's weights; None where those are right, or nothing is weighed.
        groups: two or more groups of sites that follow nobody outside, so that nothing is weighed; or none.
    """

    premises: list[Premise]
    verdict: Verdict
    growth: Growth
    books: dict[str, Book]
    balance: Balance | None
    ones: Balance | None = None
    groups: tuple[tuple[str, ...], ...] = ()

    @property
    def ones_rise(self) -> Rise | None:
        """The largest rise of V with the paper's weights; None where it did not rise, or is the right one."""
        return None if self.ones is None else largest(self.ones, self.verdict.tolerance)

    @property
    def bounded_by_v(self) -> bool:
        """True where V bounds every site: it did not rise, and no site's weight in it is zero.

        A site of no weight is bounded as well where the shares are all that fails: it converges after those
        that it follows (docs/errata.md, 11).
        """
        if self.balance is None or self.verdict.finding not in (Finding.COVERED, Finding.DID_NOT_RISE):
            return False
        failed = [premise.name for premise in self.premises if premise.holds is not True]
        return bool((self.balance.beta > 0.0).all()) or (failed == ["shares"] and self._constant)

    @property
    def _constant(self) -> bool:
        return all(book.shares.constant for book in self.books.values())

    @property
    def passed(self) -> bool:
        """What decides the exit code: the balance holds, and V or the growth says that the run is bounded.

        Undecided growth is no pass, as for `stable` of `trilat test`.
        """
        if self.verdict.finding is Finding.BROKEN or self.growth.grows:
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
    if not booked.judged.any():
        return _without(premises, grown, NO_PERIOD)
    premises += of_run(log, found, booked)
    if refused:
        said = unsound_verdict(found, booked) or not_judged(groups_text(refused))
        return Certificate(premises, said, grown, found, None, groups=refused)
    ones = None if np.allclose(booked.beta, 1.0) else balance(found, ones=True)
    return Certificate(premises, verdict(premises, found, booked), grown, found, booked, ones)


def _without(premises: list[Premise], grown: Growth, why: str) -> Certificate:
    return Certificate(premises, not_judged(why), grown, {}, None)


def _groups(log: Log, found: dict[str, Book]) -> tuple[tuple[str, ...], ...]:
    """Returns the closed groups for which there is no unique beta; () where there is one all the time."""
    for alpha in _matrices(found):
        groups = closed_groups(alpha)
        if len(groups) > 1:
            return tuple(tuple(log.scenario.names[n] for n in group) for group in groups)
    return ()


def _matrices(found: dict[str, Book]) -> Array:
    """Returns every dominance matrix that was in force, of a ramp its ends, shape (M, N, N)."""
    tracks = [book.track for book in found.values()]
    times = [tracks[0].t_s[:1]]
    for book in found.values():
        moving = np.flatnonzero(np.diff(book.shares.rate, axis=0, prepend=0.0).any(axis=1))
        stepping = np.flatnonzero((book.shares.alpha[1:] != book.shares.before).any(axis=1)) + 1
        times += [book.track.t_s[moving], book.track.t_s[stepping]]
    return alpha_at(found, np.concatenate(times))

"""What can be relied on in a log: how much of the run was judged, and that nothing was changed since.

Invariant: absence passes nothing. Coverage counts ticks of every site against those of the run, and the site
with the least decides. Missing records must be ones that the recorder missed: a gap of which neither the
accounts nor the recorder's statistics tell is the seam of a splice, or a stretch that was cut out.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .digest_chain import ChainState
from .log_reader import Log

MIN_COVERAGE = 0.999
"""Least share of every site's ticks that must be judged, by default."""


class Coverage(NamedTuple):
    """How much of a run was judged: ticks by site, the judged ones and all."""

    judged: Mapping[str, int]
    expected: Mapping[str, int]

    @property
    def share(self) -> float:
        """Share of judged ticks of the site with the least; 0 if there are no ticks at all."""
        return min(map(self._share, self.expected), default=0.0) if any(self.expected.values()) else 0.0

    def _share(self, site: str) -> float:
        expected = self.expected[site]
        return min(1.0, self.judged.get(site, 0) / expected) if expected else 1.0

    def __str__(self) -> str:
        lacking = {site: n for site in self.expected if (n := self._share(site)) < 1.0}
        if not lacking:
            return f"all {sum(self.expected.values())} ticks"
        return ", ".join(
            f"{site} {self.judged.get(site, 0)} of {self.expected[site]} ticks ({_percent(share)})"
            for site, share in lacking.items()
        )

    def describe(self, least: float) -> str:
        """Returns the coverage in words, and the share that was asked for if that is more."""
        short = f", less than {_percent(least)}" if self.share < least else ""
        return f"judged {self}{short}"


def _percent(share: float) -> str:
    """Returns a share in percent; no less than all is 100 %."""
    return f"{np.floor(1e5 * share) / 1e3:g} %"


def count_expected_ticks(log: Log) -> dict[str, int]:
    """Returns how many ticks of every site belong to the run."""
    return {site: log.expected_ticks(site) for site in log.sites}


def measure_record_coverage(log: Log) -> Coverage:
    """Returns how many ticks of every site have a record."""
    return Coverage({site: len(np.unique(log[site].tick)) for site in log.sites}, count_expected_ticks(log))


class Integrity(NamedTuple):
    """Whether a log is as it was made, and a sentence for it."""

    state: ChainState
    text: str

    @property
    def passed(self) -> bool:
        """False if something was changed, or if records are missing that were there."""
        return self.state is not ChainState.CHANGED


NOT_JUDGED = Integrity(ChainState.ABSENT, "not judged")


def judge_integrity(log: Log) -> Integrity:
    """Returns whether a log is as it was made: by its digest chain, its accounts and its statistics.

    Raises:
        LogError: a message cannot be read.
    """
    state, text = log.chain
    if state is ChainState.CHANGED:
        return Integrity(state, text)
    for site in log.sites:
        if seam := _find_unexplained(log, site):
            return Integrity(ChainState.CHANGED, seam)
    return Integrity(state, text)


def _find_unexplained(log: Log, site: str) -> str:
    """Describes a gap of a site that is none of the run's own; "" if there is none."""
    ticks = np.unique(log[site].tick)
    inner = int(ticks[-1] - ticks[0]) + 1 - len(ticks) if len(ticks) else 0
    written = log.account(site) if len(log.sources) == 1 else ""  # of several files it is counted anew
    stated = {word: int(n) for word, n in re.findall(r"(received|missing) (\d{1,15})\b", written)}
    if not log.part and stated and not log.damaged:
        there = {"received": len(ticks), "missing": log.missing(site)}
        if stated != there:
            told = " and ".join(f"{stated.get(word, 0)} {word}" for word in there)
            found = " and ".join(f"{n} {word}" for word, n in there.items())
            return (
                f"records of {site} were taken out or put in: its account says {told}, the file has {found}"
            )
    if not inner or log.damaged or log.chain[0] is ChainState.INTACT:
        return ""
    counts = [stats.missing.get(f"{site}/state", 0) for stats in log.recorder_stats()]
    if inner <= max([stated.get("missing", 0), *counts]):
        return ""
    return f"{inner} records of {site} are missing in between, and nothing in the log explains it"

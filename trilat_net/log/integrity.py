"""What can be relied on in a log: nothing was changed since it was made, and no records were taken out.

Invariant: missing records must be ones that the recorder missed: a gap of which neither the accounts nor the
recorder's statistics tell is the seam of a splice, or a stretch that was cut out.
"""

import numpy as np

from .accounting import parse_counts
from .digest_chain import ChainState, Integrity
from .log_reader import Log

MIN_COVERAGE = 0.999
"""Least share of every site's ticks that must be judged, by default."""


def judge_integrity(log: Log) -> Integrity:
    """Returns whether a log is as it was made: by its digest chain, its accounts and its statistics.

    Raises:
        LogError: a message cannot be read.
    """
    if log.chain.passed:
        for site in log.sites:
            if seam := _find_unexplained(log, site):
                return Integrity(ChainState.CHANGED, seam)
    return log.chain


def _find_unexplained(log: Log, site: str) -> str:
    """Describes a gap of a site that is none of the run's own; "" if there is none."""
    if log.damaged:
        return ""
    ticks = np.unique(log[site].tick)
    stated = parse_counts(log.account(site)) if len(log.sources) == 1 else {}  # of several it is counted anew
    there = {"received": len(ticks), "missing": log.missing(site)}
    if not log.part and stated not in ({}, there):
        told = " and ".join(f"{stated.get(word, 0)} {word}" for word in there)
        found = " and ".join(f"{n} {word}" for word, n in there.items())
        return f"records of {site} were taken out or put in: its account says {told}, the file has {found}"
    inner = int(ticks[-1] - ticks[0]) + 1 - len(ticks) if len(ticks) else 0
    inner -= min(inner, log.absent_ticks(site))
    if not inner or log.chain.state is ChainState.INTACT:
        return ""
    counts = [stats.missing.get(f"{site}/state", 0) for stats in log.recorder_stats()]
    if inner <= max([stated.get("missing", 0), *counts]):
        return ""
    return f"{inner} records of {site} are missing in between, and nothing in the log explains it"

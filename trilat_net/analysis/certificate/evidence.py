"""What a certificate rests on: how much of the run the log has, and that nothing was changed in it.

Invariant: what is missing never counts as stable. Too little of the run or of the periods of V, and sites
that a rerun took over as recorded, leave a run open; a log that was changed passes nothing.
"""

from typing import Any, NamedTuple

import numpy as np

from ...log.accounting import Coverage
from ...log.digest_chain import Integrity
from ...log.log_reader import Log, judge_integrity
from .energy_balance import EnergyBalance
from .premises import find_unjudged_spans, was_away


class Evidence(NamedTuple):
    """The records that a certificate rests on.

    Attributes:
        coverage: ticks of every site that have a record, and those of the run.
        functional_share: share of the periods of V that rest on records, while no site was away; None
            without V.
        min_coverage: the least share of either that passes.
        integrity: whether the log is as it was made.
        unmet: sites of an open-loop rerun that met samples which are not in the file.
    """

    coverage: Coverage
    functional_share: float | None
    min_coverage: float
    integrity: Integrity
    unmet: tuple[str, ...] = ()

    @property
    def reasons(self) -> list[str]:
        """What leaves the run open, in words."""
        found = [] if self.integrity.passed else [f"the log is not as it was made: {self.integrity.text}"]
        if self.coverage.share < self.min_coverage:
            found.append(f"records are missing: {self.coverage.describe(self.min_coverage)}")
        if self.functional_share is not None and self.functional_share < self.min_coverage:
            found.append(f"V is judged over {100.0 * self.functional_share:.4g} % of its periods")
        if self.unmet:
            found.append(f"{' and '.join(self.unmet)}, as recorded, did not react to this run")
        return found

    @property
    def text(self) -> str:
        """The evidence in one sentence."""
        return f"{self.coverage.describe(self.min_coverage)}; {self.integrity.text}"

    def to_json(self) -> dict[str, Any]:
        """Returns the evidence, ready for JSON."""
        return {
            "coverage": self.coverage.share,
            "functional_coverage": self.functional_share,
            "min_coverage": self.min_coverage,
            "judged": self.coverage.to_json(),
            "integrity": self.integrity.state.name.lower(),
            "open_loop_sites": list(self.unmet),
        }


def collect_evidence(log: Log, balance: EnergyBalance | None, min_coverage: float) -> Evidence:
    """Returns what a certificate of a log rests on, with the energy balance that it found."""
    share = None if balance is None else _share_judged(log, balance)
    unmet = tuple(site for site in log.sites if site not in log.executed_sites)
    there = {site: len(np.unique(log[site].tick)) for site in log.sites}
    coverage = Coverage(there, {site: log.expected_ticks(site) for site in log.sites})
    return Evidence(coverage, share, min_coverage, judge_integrity(log), unmet)


def _share_judged(log: Log, balance: EnergyBalance) -> float:
    """Returns the share of periods of V that rest on records, of those in which no site was away."""
    asked = np.ones(len(balance.judged), dtype=np.bool_)
    for from_s, to_s in find_unjudged_spans(balance):
        if was_away(log, (from_s, to_s)):
            asked &= (balance.t_s[:-1] < from_s) | (balance.t_s[:-1] >= to_s)
    return float(balance.judged[asked].mean()) if asked.any() else 0.0

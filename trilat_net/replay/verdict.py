"""What an execution from a log showed."""

from dataclasses import dataclass, field

from .difference import Difference


@dataclass(slots=True)
class Verdict:
    """What an execution from a log showed.

    Attributes:
        whole_run: True where runs were executed whole and bits compared; False where tick by tick, to 1e-9.
        records: records in the log.
        identical: records of which every computed field agreed.
        unjudged: records that nothing could be said of, behind gaps.
        differing: records that differ.
        first: the first difference, by tick and then by site.
        gaps: missing ticks: (site, first, last).
    """

    whole_run: bool
    records: int = 0
    identical: int = 0
    unjudged: int = 0
    differing: int = 0
    first: Difference | None = None
    gaps: list[tuple[str, int, int]] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """True where no record differs."""
        return self.first is None

    def differ(self, difference: Difference) -> None:
        """Books a record that differs."""
        self.differing += 1
        if self.first is None or difference.tick < self.first.tick:
            self.first = difference

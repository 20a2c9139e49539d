"""What the runs of one place of a sweep show together.

Law: every run counts once; a share is of the runs that decided, and comes with its interval.
"""

import io
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from .interval import Interval, wilson
from .outcome import Verdict
from .plan import Plan
from .table import Results, polars

PLACES = "places.parquet"


class Place(NamedTuple):
    """One cell with all its seeds.

    Attributes:
        cell: its number.
        law: the laws of its sites.
        values: along every axis.
        counts: how many runs came to each verdict, in the order of `Verdict`.
    """

    cell: int
    law: str
    values: tuple[float | str, ...]
    counts: tuple[int, ...]

    @property
    def decided(self) -> int:
        """How many runs showed whether they are stable."""
        return sum(n for n, verdict in zip(self.counts, Verdict, strict=True) if verdict.stable is not None)

    @property
    def stable(self) -> int:
        """How many runs are stable."""
        return sum(n for n, verdict in zip(self.counts, Verdict, strict=True) if verdict.stable)

    @property
    def doubtful(self) -> bool:
        """True where some runs are stable and some are not."""
        return 0 < self.stable < self.decided

    @property
    def interval(self) -> Interval:
        """The 95 % interval of the share of stable runs, among those that decide."""
        return wilson(self.stable, self.decided)


def places(results: Results) -> list[Place]:
    """Returns every place of a sweep, in the order of the cells."""
    counted: dict[int, Counter[str]] = {}
    laws: dict[int, str] = {}
    for row in results.rows:
        counted.setdefault(row["cell"], Counter())[row["verdict"]] += 1
        laws[row["cell"]] = row["law"]
    return [
        Place(
            number,
            laws[number],
            results.plan.cell(number).values,
            tuple(counts[verdict.value] for verdict in Verdict),
        )
        for number, counts in counted.items()
    ]


def places_parquet(asked: Plan, found: Sequence[Place]) -> bytes:
    """Returns places as a Parquet file: a row each, its counts, and the share of stable runs with its ends.

    Raises:
        UsageError: polars is not installed.
    """
    pl = polars()
    intervals = [one.interval for one in found]
    columns = {
        "cell": ([one.cell for one in found], pl.Int64),
        **{
            axis.key: ([one.values[n] for one in found], pl.Float64 if axis.numeric else pl.String)
            for n, axis in enumerate(asked.axes)
        },
        "law": ([one.law for one in found], pl.String),
        "runs": ([sum(one.counts) for one in found], pl.Int64),
        **{verdict.value: ([one.counts[n] for one in found], pl.Int64) for n, verdict in enumerate(Verdict)},
        "stable_share": ([one.stable / one.decided if one.decided else None for one in found], pl.Float64),
        "stable_share_low": ([one.low for one in intervals], pl.Float64),
        "stable_share_high": ([one.high for one in intervals], pl.Float64),
    }
    made = io.BytesIO()
    pl.DataFrame(
        {name: pl.Series(name, values, dtype=kind) for name, (values, kind) in columns.items()}
    ).write_parquet(made, compression="zstd")
    return made.getvalue()

"""The results of a sweep: one row per run, as Parquet that explains itself.

Law: the file is a function of what was run alone: the same runs make the same bytes, in whatever order and by
however many processes they were made. Each row's scenario, run again, is that row.
"""

import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ..errors import UsageError
from ..extra import extra
from .cell import Entry, command
from .delta import whole
from .journal import not_written
from .outcome import Outcome
from .plan import Plan, plan_of

RESULTS = "results.parquet"
_PLAN = "trilat_net.sweep"
"""The key of the file's metadata under which the plan stands, as JSON."""
_ROWS_OF_A_GROUP = 16_384

Row = Mapping[str, Any]
"""A run: `cell`, a value per axis under its key, `law`, `seed`, `random`, every field of `Outcome`,
`scenario_sha256`, `command` and `scenario`, its canonical text. Verdict and motion are their words."""


def polars() -> Any:
    """Returns polars, which reads and writes results.

    Raises:
        UsageError: it is not installed, or too old to keep a file's metadata.
    """
    pl = extra("polars", "frames", "sweeps")
    if not hasattr(pl, "read_parquet_metadata"):
        raise UsageError(
            "sweeps need polars 1.30 or newer: pip install --upgrade 'trilat-net[frames]' polars"
        )
    return pl


class Results(NamedTuple):
    """A sweep that was run.

    Attributes:
        plan: what was asked.
        rows: its runs, by cell and then in the order of the seeds.
    """

    plan: Plan
    rows: Sequence[Row]

    def of_cell(self, number: int) -> list[Row]:
        """Returns the runs of a cell, one per seed.

        Raises:
            UsageError: there is no such cell.
        """
        self.plan.cell(number)
        return [row for row in self.rows if row["cell"] == number]

    def outcome(self, row: Row) -> Outcome:
        """Returns what became of a run."""
        return msgspec.convert({field: row[field] for field in Outcome.__struct_fields__}, Outcome)


def rows_of(asked: Plan, entries: Sequence[Entry]) -> list[Row]:
    """Returns the rows that runs make, in their order.

    Args:
        asked: the sweep.
        entries: its runs, in any order.
    """
    order = {seed: n for n, seed in enumerate(asked.seeds)}
    seeds_of: dict[int, int] = {}
    for entry in entries:
        seeds_of[entry.cell] = seeds_of.get(entry.cell, 0) + 1
    return [
        _row(asked, entry, alone=seeds_of[entry.cell] == 1)
        for entry in sorted(entries, key=lambda one: (one.cell, order[one.seed]))
    ]


def _row(asked: Plan, entry: Entry, *, alone: bool) -> Row:
    cell = asked.cell(entry.cell)
    text = whole(entry.scenario, asked.base.text)
    log = f"cell-{cell.number}.mcap" if alone else f"cell-{cell.number}-seed-{entry.seed}.mcap"
    lasts_s = duration_s(asked, entry.outcome)
    return {
        "cell": cell.number,
        **{one.key: value for one, value in zip(asked.axes, cell.values, strict=True)},
        "law": entry.law,
        "seed": entry.seed,
        "random": entry.random,
        **msgspec.to_builtins(entry.outcome),
        "scenario_sha256": entry.sha256,
        "command": command(asked.written, cell.overrides, entry.seed, lasts_s, log),
        "scenario": text,
    }


def duration_s(asked: Plan, outcome: Outcome) -> float:
    """Returns a duration that makes a run again: as long as it ran, or until it diverges by itself, s."""
    if outcome.diverged_s is None:
        return outcome.ran_s
    return max(outcome.ran_s, min(asked.longest_s, asked.base.duration_s * 2.0**outcome.extended))


def parquet(asked: Plan, rows: Sequence[Row], facts: Mapping[str, Any]) -> bytes:
    """Returns results as a Parquet file.

    Args:
        asked: the sweep.
        rows: its runs, in their order.
        facts: what names the sweep, for the file's metadata.

    Raises:
        UsageError: polars is not installed.
    """
    pl = polars()
    schema = {
        "cell": pl.Int64,
        **{one.key: pl.Float64 if one.numeric else pl.String for one in asked.axes},
        "law": pl.String,
        "seed": pl.Int64,
        "random": pl.Boolean,
        **_outcome_schema(pl),
        "scenario_sha256": pl.String,
        "command": pl.String,
        "scenario": pl.String,
    }
    made = io.BytesIO()
    pl.DataFrame(
        {name: pl.Series(name, [row[name] for row in rows], dtype=kind) for name, kind in schema.items()}
    ).write_parquet(
        made,
        compression="zstd",
        row_group_size=_ROWS_OF_A_GROUP,
        metadata={_PLAN: json.dumps(facts, ensure_ascii=False, sort_keys=True)},
    )
    return made.getvalue()


def _outcome_schema(pl: Any) -> dict[str, Any]:
    kinds = {"verdict": pl.String, "motion": pl.String, "extended": pl.Int64}
    return {name: kinds.get(name, pl.Float64) for name in Outcome.__struct_fields__}


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file that is there whole or not at all.

    Raises:
        LogRefused: the disk refused it.
    """
    unfinished = path.with_name(f"{path.name}.unfinished")
    try:
        with unfinished.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        unfinished.replace(path)
    except OSError as error:
        raise not_written(path, error) from None


def read_results(path: Path) -> Results:
    """Returns the results of a sweep.

    Args:
        path: its folder, or the Parquet file.

    Raises:
        UsageError: there are none, or the sweep has not come to its end; or polars is not installed.
    """
    pl = polars()
    file = path / RESULTS if path.is_dir() else path
    if not file.is_file():
        more = f"; go on with it: trilat sweep --resume {path}" if path.is_dir() else ""
        raise UsageError(f"{file}: there are no results of a sweep{more}")
    try:
        facts = json.loads(pl.read_parquet_metadata(file)[_PLAN])
        frame = pl.read_parquet(file)
    except KeyError:
        raise UsageError(f"{file}: holds no results of a sweep: its metadata name none") from None
    except (pl.exceptions.PolarsError, OSError) as error:
        raise UsageError(f"{file}: cannot be read as Parquet: {str(error).splitlines()[0]}") from None
    return Results(plan_of(facts), frame.to_dicts())

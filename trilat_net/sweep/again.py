"""A row of results as a command that runs it again, into a log.

Law: the command makes the very run of the row; where the scenario that was swept has changed since, the row's
own is written out and named instead.
"""

import shlex
from pathlib import Path
from typing import NamedTuple

from ..errors import ScenarioError
from ..scenario.reader import written_text
from .cell import Written
from .table import Results, Row, duration_s


class Again(NamedTuple):
    """How to run a row again.

    Attributes:
        command: the command.
        note: what is to be known of it, or "".
    """

    command: str
    note: str = ""


def again(results: Results, row: Row, folder: Path) -> Again:
    """Returns how to run a row again.

    Args:
        results: of the sweep.
        row: one of its rows.
        folder: where the row's scenario is written if it is needed.
    """
    if _still_there(results.plan.written, results.plan.cell(row["cell"]).overrides, row):
        return Again(row["command"])
    name = f"cell-{row['cell']}-seed-{row['seed']}"
    file = folder / f"{name}.toml"
    file.write_text(row["scenario"], encoding="utf-8")
    lasts_s = duration_s(results.plan, results.outcome(row))
    words = ["trilat", "sim", str(file), "--duration", f"{lasts_s:.12g}", "-o", f"{name}.mcap"]
    source = results.plan.written.source
    return Again(
        shlex.join(words), f"{source} is not what was swept any more, or not here; as it ran: {file}"
    )


def _still_there(written: Written, overrides: tuple[str, ...], row: Row) -> bool:
    """Returns whether the name that the row's command has still means what was swept."""
    try:
        text, folder = written_text(written.source)
        now = written._replace(text=text, folder=str(folder))
        return bool(now.scenario(*overrides, f"seed={row['seed']}").sha256 == row["scenario_sha256"])
    except ScenarioError:
        return False

"""Prints logs side by side: what differs in their experiments on top, a row per quantity below.

Law: numbers are shown, and none is called better.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .options import out
from .show import shown

if TYPE_CHECKING:
    from ..log.reader import Log
    from ..metrics.comparison import Comparison
    from ..scenario.differences import Difference

_WIDE = 160
"""Columns that a pipe has at least."""
_MOST_REASONS = 6


def show_logs(
    logs: Sequence["Log"],
    different: Sequence["Difference"],
    found: "Comparison",
    remarks: Mapping[str, Sequence[str]],
) -> None:
    """Prints a comparison of logs.

    Args:
        logs: the logs.
        different: in what their experiments differ.
        found: their quantities.
        remarks: per log what its figures do not tell.
    """
    names = {log.scenario.name for log in logs}
    if len(names) > 1:
        out.print(escape(f"logs of different scenarios: {', '.join(sorted(map(shown, names)))}"))
    if different:
        print_table(_differences(different, found.columns))
    else:
        out.print("one and the same experiment")
    print_table(_quantities(found))
    out.print()
    for name, lines in remarks.items():
        for line in lines:
            out.print(f"[bold]note[/bold] {escape(shown(f'{name}: {line}'))}", soft_wrap=True)
    _show_reasons(found)


def print_table(table: Table) -> None:
    """Prints a table with a line before it; where nobody looks at a terminal, as wide as it wants to be."""
    out.print()
    console = out if out.is_terminal else Console(file=out.file, width=max(out.width, _WIDE), highlight=False)
    console.print(table)


def _differences(different: Sequence["Difference"], columns: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("differs", overflow="fold")
    for name in columns:
        table.add_column(escape(shown(name)), overflow="fold")
    for one in different:
        table.add_row(escape(shown(str(one))), *(escape(shown(value)) for value in one.values))
    return table


def _quantities(found: "Comparison") -> Table:
    """Returns a row per quantity, with its unit, under the heads of its group."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    table.add_column("unit")
    for name in found.columns:
        table.add_column(escape(shown(name)), justify="right")
    group = ""
    for row in found.rows:
        if row.quantity.group != group:
            group = row.quantity.group
            table.add_row(f"[bold]{escape(group)}[/bold]")
        values = ["-" if value is None else f"{value:.4g}" for value in row.values]
        table.add_row(f"  {escape(row.quantity.name)}", escape(row.quantity.unit or "-"), *values)
    return table


def _show_reasons(found: "Comparison") -> None:
    """Says why numbers are missing, of very many the first."""
    reasons = [
        f"{name}: no {row.quantity.name}: {entry.why}"
        for row in found.rows
        for name, entry in zip(found.columns, row.entries, strict=True)
        if entry.value is None and entry.applies
    ]
    for line in reasons[:_MOST_REASONS]:
        out.print(escape(shown(line)), soft_wrap=True)
    if len(reasons) > _MOST_REASONS:
        out.print(f"and {len(reasons) - _MOST_REASONS} more, which --json names")

"""Prints a conclusion: the table, what links did, what was checked, the files."""

from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from .options import out

if TYPE_CHECKING:
    from ..conclusion import Conclusion


def shown(text: object, most: int = 300) -> str:
    """Returns a text of strangers as a terminal may have it: no control characters, and no endless one."""
    plain = "".join(letter if letter.isprintable() else "\ufffd" for letter in str(text)[: most + 1])
    return plain if len(plain) <= most else plain[:most] + "..."


def show_conclusion(conclusion: "Conclusion") -> None:
    """Prints what there is to say of a log."""
    table = Table(box=None, pad_edge=False)
    for column in conclusion.columns:
        table.add_column(column, justify="left" if column == "site" else "right")
    for row in conclusion.rows:
        table.add_row(*row)
    out.print(table)
    for note in conclusion.notes:
        out.print(escape(note), soft_wrap=True)
    for line in conclusion.lines:
        mark = "[green]ok[/green]  " if line.passed else "[red]FAIL[/red]"
        out.print(f"{mark} {escape(line.label)}: {escape(line.text)}", soft_wrap=True)
    for path in conclusion.paths:
        out.print(f"  {escape(str(path))}", soft_wrap=True)

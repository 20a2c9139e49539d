"""A table of texts, for a page or for the command line.

Law: a cell is printed as it stands, whoever prints it.
"""

from typing import NamedTuple


class Grid(NamedTuple):
    """A table.

    Attributes:
        heads: of its columns.
        rows: texts, as many as there are heads each.
    """

    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def markdown(self) -> str:
        """Returns it in Markdown."""
        lines = (self.heads, ["---"] * len(self.heads), *self.rows)
        return "\n".join(f"| {' | '.join(cell or ' ' for cell in line)} |" for line in lines)

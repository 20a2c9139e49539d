"""Width, type size and resolution of a figure, for the report or for one or two columns of a paper.

Invariant: type in print is 8 pt throughout.
"""

from typing import NamedTuple

from ..errors import UsageError

COLUMN_IN, PAGE_IN = 3.5, 7.0
"""Widths of one column and of two, in."""


class FigureSize(NamedTuple):
    """The measures of a figure: width, in; type of numbers at its axes and of footnotes, pt; its dpi."""

    width_in: float
    tick_pt: float
    small_pt: float
    dpi: int

    @property
    def narrow(self) -> bool:
        """True if two panels in a row have no room for many words."""
        return self.width_in < 5.0


REPORT_SIZE = FigureSize(PAGE_IN, 7.0, 6.0, 200)
"""The figures beside the report."""


def make_print_size(width_in: float) -> FigureSize:
    """Returns the size of a figure in a paper, 3.5 in wide for one column or 7 in for two.

    Raises:
        UsageError: it is neither.
    """
    if width_in not in (COLUMN_IN, PAGE_IN):
        raise UsageError(f"a figure is {COLUMN_IN:g} or {PAGE_IN:g} in wide, not {width_in}")
    return FigureSize(width_in, 8.0, 8.0, 600)

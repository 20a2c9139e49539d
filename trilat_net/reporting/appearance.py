"""Colours of sites, the same in every figure and on every page; widths, type and resolution of
figures.

Invariant: type in print is 8 pt throughout. The first three colours are the "high contrast" set
of Paul Tol's notes on colour: safe for the colour blind and apart in lightness, also in grey
print. The third is the slave's, however many masters there are.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..errors import UsageError
from ..scenario import Scenario

SITE_COLOURS = ("#004488", "#bb5566", "#ddaa33", "#000000", "#66a3d2", "#7a7a7a")
DARK_SITE_COLOURS = ("#79b0f2", "#f08a9b", "#e9bd4c", "#f2f2f2", "#9bd3f5", "#a3a3a3")
"""The same sites on a dark page."""


def list_site_colours(scenario: Scenario, colours: Sequence[str] = SITE_COLOURS) -> list[str]:
    """Returns the colours of a palette in the order of a scenario's sites."""
    return [colours[place] for place in scenario.assign_colours(len(SITE_COLOURS))]


COLUMN_IN = 3.5
PAGE_IN = 7.0
"""Widths of one column and of two, in."""


class FigureSize(NamedTuple):
    """The measures of a figure: width, in; type of numbers at its axes and of footnotes, pt;
    its dpi.
    """

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

"""Colours of the sites, and widths, type sizes and resolutions of figures.

A site has the same colour in every figure and on every page. The first three colours are the
"high contrast" set of Paul Tol's notes on colour: the colour blind can tell them apart, and
they differ in lightness, also in grey print.

Invariant:
    - Type in print is 8 pt throughout.
    - The third colour is the slave's, for any number of masters.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..errors import UsageError
from ..scenario import Scenario

SITE_COLOURS = ("#004488", "#bb5566", "#ddaa33", "#000000", "#66a3d2", "#7a7a7a")
DARK_SITE_COLOURS = ("#79b0f2", "#f08a9b", "#e9bd4c", "#f2f2f2", "#9bd3f5", "#a3a3a3")
"""Colours of the same sites on a dark page."""


def list_site_colours(scenario: Scenario, colours: Sequence[str] = SITE_COLOURS) -> list[str]:
    """Returns the colours of a palette in the order of a scenario's sites."""
    indices = scenario.assign_colours(len(SITE_COLOURS))
    return [colours[index] for index in indices]


COLUMN_IN = 3.5
"""Width of a column of a paper, in inches."""
PAGE_IN = 7.0
"""Width of two columns of a paper, in inches."""


class FigureSize(NamedTuple):
    """The measures of a figure.

    Attributes:
        width_in: width of the figure, in inches.
        tick_pt: type size of the numbers at the axes, in pt.
        small_pt: type size of footnotes, in pt.
        dpi: resolution of the figure as a picture.
    """

    width_in: float
    tick_pt: float
    small_pt: float
    dpi: int

    @property
    def narrow(self) -> bool:
        """True if two panels beside each other have no room for long texts."""
        return self.width_in < 5.0


REPORT_SIZE = FigureSize(width_in=PAGE_IN, tick_pt=7.0, small_pt=6.0, dpi=200)
"""Size of the figures beside the report."""


def make_print_size(width_in: float) -> FigureSize:
    """Returns the size of a figure in a paper.

    Args:
        width_in: width in inches: 3.5 for one column, or 7 for two columns.

    Raises:
        UsageError: the width is neither of them.
    """
    if width_in not in (COLUMN_IN, PAGE_IN):
        raise UsageError(f"a figure is {COLUMN_IN:g} or {PAGE_IN:g} in wide, not {width_in}")
    return FigureSize(width_in=width_in, tick_pt=8.0, small_pt=8.0, dpi=600)

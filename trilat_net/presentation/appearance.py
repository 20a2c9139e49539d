"""Defines the colours of the arms, and the widths, font sizes and resolutions of figures.

The first three colours are the "high contrast" set from Paul Tol's notes on colour. They can be
told apart by people with colour blindness, and because they differ in lightness they also
remain distinct when printed in grey.

Invariant:
    - An arm has the same colour in every figure and on every page.
    - All text in printed figures is 8 pt high.
    - The slave always has the third colour, regardless of the number of masters.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..errors import UsageError
from ..scenario import Scenario

SITE_COLOURS = ("#004488", "#bb5566", "#ddaa33", "#000000", "#66a3d2", "#7a7a7a")
"""Site colours for white paper or a light page."""
DARK_SITE_COLOURS = ("#79b0f2", "#f08a9b", "#e9bd4c", "#f2f2f2", "#9bd3f5", "#a3a3a3")
"""Colours of the same sites for a dark page, in the same order."""


def list_site_colours(scenario: Scenario, colours: Sequence[str] = SITE_COLOURS) -> list[str]:
    """Returns the colour of each arm of a scenario, in scenario order.

    An arm keeps its colour in all figures and on all pages.

    Args:
        scenario: Scenario with the sites.
        colours: Palette, such as `SITE_COLOURS` or `DARK_SITE_COLOURS`.
    """
    indices = scenario.assign_colours(len(SITE_COLOURS))
    return [colours[index] for index in indices]


COLUMN_IN = 3.5
"""Width of one column of a paper, in inches."""
PAGE_IN = 7.0
"""Width of two columns of a paper, in inches."""


class FigureSize(NamedTuple):
    """Width, font sizes and resolution of a figure.

    Reports on a screen and printed papers use different sizes.

    Attributes:
        width_in: Width of the figure, in inches.
        tick_pt: Font size of the axis tick labels, in pt.
        small_pt: Font size of footnotes, in pt.
        dpi: Resolution of raster output, in dots per inch.
    """

    width_in: float
    tick_pt: float
    small_pt: float
    dpi: int

    @property
    def narrow(self) -> bool:
        """True if the figure is too narrow (less than 5 in) for two panels side by side.

        Narrow figures stack their panels vertically or show fewer labels.
        """
        return self.width_in < 5.0

    @classmethod
    def for_print(cls, width_in: float) -> "FigureSize":
        """Returns the size of a figure that fills a column or page of a paper, with 8 pt text.

        Args:
            width_in: Width in inches: 3.5 for one column, 7 for two columns.

        Raises:
            UsageError: The width is neither 3.5 nor 7.
        """
        if width_in not in (COLUMN_IN, PAGE_IN):
            raise UsageError(
                f"the width of a figure must be {COLUMN_IN:g} or {PAGE_IN:g} inches, "
                f"not {width_in}"
            )
        return FigureSize(width_in=width_in, tick_pt=8.0, small_pt=8.0, dpi=600)


REPORT_SIZE = FigureSize(width_in=PAGE_IN, tick_pt=7.0, small_pt=6.0, dpi=200)
"""Size of the figures that accompany the report."""

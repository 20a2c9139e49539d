"""Defines the colours of the arms, and the widths, type sizes and resolutions of figures.

An arm has the same colour in every figure and on every page. The first three colours are the
"high contrast" set of Paul Tol's notes on colour: people with colour blindness can distinguish
them, and they differ in lightness, so they remain distinct in grey print.

Invariant:
    - Text in printed figures is 8 pt high throughout.
    - The slave, the arm that follows the others, always has the third colour, for any number of
      masters (the arms that people move).
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..errors import UsageError
from ..scenario import Scenario

SITE_COLOURS = ("#004488", "#bb5566", "#ddaa33", "#000000", "#66a3d2", "#7a7a7a")
"""Colours of sites on white paper or a light page."""
DARK_SITE_COLOURS = ("#79b0f2", "#f08a9b", "#e9bd4c", "#f2f2f2", "#9bd3f5", "#a3a3a3")
"""Colours of the same sites on a dark page, in the same order."""


def list_site_colours(scenario: Scenario, colours: Sequence[str] = SITE_COLOURS) -> list[str]:
    """Returns the colours of a scenario's arms, in the order of the scenario.

    An arm has the same colour in all figures and on all pages.

    Args:
        scenario: Scenario with the sites.
        colours: Palette, such as `SITE_COLOURS` or `DARK_SITE_COLOURS`.
    """
    indices = scenario.assign_colours(len(SITE_COLOURS))
    return [colours[index] for index in indices]


COLUMN_IN = 3.5
"""Width of a column of a paper, in inches."""
PAGE_IN = 7.0
"""Width of two columns of a paper, in inches."""


class FigureSize(NamedTuple):
    """Width, type sizes and resolution of figures.

    These sizes differ between a report on a screen and a printed paper.

    Attributes:
        width_in: Width of the figure, in inches.
        tick_pt: Type size of the numbers at the axes, in pt.
        small_pt: Type size of footnotes, in pt.
        dpi: Resolution of the figure as a picture, in dots per inch.
    """

    width_in: float
    tick_pt: float
    small_pt: float
    dpi: int

    @property
    def narrow(self) -> bool:
        """True if the figure is narrower than 5 in: too narrow for two panels side by side.

        Such figures place their panels (parts with their own axes) below each other, or show
        fewer labels.
        """
        return self.width_in < 5.0

    @classmethod
    def for_print(cls, width_in: float) -> "FigureSize":
        """Returns the size of a figure that fits a column or page of a paper, with 8 pt type.

        Args:
            width_in: Width in inches: 3.5 for one column, or 7 for two columns.

        Raises:
            UsageError: The width is neither of these values.
        """
        if width_in not in (COLUMN_IN, PAGE_IN):
            raise UsageError(
                f"the width of a figure must be {COLUMN_IN:g} or {PAGE_IN:g} inches, "
                f"not {width_in}"
            )
        return FigureSize(width_in=width_in, tick_pt=8.0, small_pt=8.0, dpi=600)


REPORT_SIZE = FigureSize(width_in=PAGE_IN, tick_pt=7.0, small_pt=6.0, dpi=200)
"""Size of the figures beside the report."""

"""The root map: the rightmost continuous and sampled roots in the complex plane, one column wide.

Invariant: every root of the analysis is drawn, conjugate ones too, and the square of the zeros goes around
the one next to them; the imaginary axis is the edge of stability.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...theory.characteristic_roots import Spectrum
from ...theory.linear_analysis import LinearAnalysis
from .. import style
from ..figure_size import COLUMN_IN, REPORT_SIZE
from ..palette import SITE_COLOURS

_SIZE = REPORT_SIZE._replace(width_in=COLUMN_IN)
_HEIGHT_IN = 3.0
_UNSTABLE: Any = {"color": "#cc3311", "alpha": 0.08, "linewidth": 0.0, "zorder": 0.3}


def draw_root_map(analysis: LinearAnalysis) -> Figure:
    """Returns the map of continuous and sampled roots."""
    with style.styled_figure(_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        _plot_roots(axes, analysis.continuous, "o", SITE_COLOURS[0], "continuous")
        if analysis.sampled is not None:
            _plot_roots(axes, analysis.sampled, "x", SITE_COLOURS[1], "as computed")
        if zeros := analysis.decisive.zeros:
            label = f"zero by structure ({zeros})"
            axes.plot([0.0], [0.0], "s", markersize=9.0, fillstyle="none", color=style.FAINT, label=label)
        low, high = axes.get_xlim()
        high = max(high, 0.06 * (high - low), 0.0)
        axes.axvline(0.0, **style.LIMIT_LINE)
        axes.axvspan(0.0, high, **_UNSTABLE)
        axes.set(xlim=(low, high), xlabel="real part (1/s)", ylabel="imaginary part (rad/s)")
        figure.legend(loc="outside upper center", ncols=3, handlelength=1.0, columnspacing=1.0)
    return figure


def _plot_roots(axes: Axes, spectrum: Spectrum, mark: str, colour: str, label: str) -> None:
    roots = [root.s for root in spectrum.roots]
    both = np.array([*roots, *(s.conjugate() for s in roots if s.imag)])
    axes.plot(both.real, both.imag, mark, markersize=4.5, fillstyle="none", color=colour, label=label)

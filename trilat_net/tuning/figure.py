"""The figure of a comparison: error against effort, a front per law, one column wide.

Law: every run that settled is drawn, also those that are on no front; the legend counts how many did, of how
many; gains as printed are stars and stand on no front.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ..analysis import style
from .front import Objective, Point
from .measurement import Score
from .outcome import Outcome
from .space import SPACES
from .tuning import Found, Tuned

WIDTH_IN = 3.5
"""One column of a page of two."""
_HEIGHT_IN = 3.1
_SIZE_PT = 8.0
_MARKS = ("o", "s", "^", "D", "v", "P")
_LABELS = {
    Objective.ERROR: "error (rad)",
    Objective.SETTLING: "settling time (s)",
}


def front_figure(tuned: Tuned) -> Figure:
    """Returns the fronts of all laws in one panel, both axes logarithmic."""
    with style.paper():
        figure = style.new_figure(_HEIGHT_IN, WIDTH_IN)
        axes = figure.add_subplot()
        drawn = [_draw_law(axes, tuned, found) for found in tuned.found]
        stars = _draw_printed(axes, tuned)
        axes.set_xlabel("effort (N m)", fontsize=_SIZE_PT)
        axes.set_ylabel(_LABELS[tuned.plan.objective], fontsize=_SIZE_PT)
        axes.tick_params(labelsize=_SIZE_PT)
        shown = [number for line in axes.lines for number in np.ravel(line.get_xydata())]
        if not shown:
            style.note(axes, "no candidate settled")
        elif min(shown) > 0.0:
            _logarithmic(axes)
        figure.legend(
            handles=[*drawn, *stars],
            loc="outside upper center",
            ncols=2,
            fontsize=_SIZE_PT,
            labelspacing=0.3,
            columnspacing=0.8,
            handlelength=1.2,
        )
    return figure


def _logarithmic(axes: Axes) -> None:
    """Makes both axes logarithmic, with plain numbers at 1, 2 and 5."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def _draw_law(axes: Axes, tuned: Tuned, found: Found) -> Line2D:
    """Draws a law's settled runs faintly and its front on top; returns its entry of the legend."""
    place = list(SPACES).index(found.space.law)
    colour, mark = style.COLOURS[place % len(style.COLOURS)], _MARKS[place % len(_MARKS)]
    settled = _points(tuned, found, range(len(found.scores)))
    front = _points(tuned, found, found.front)
    axes.plot(
        [x for _, x in settled],
        [y for y, _ in settled],
        linestyle="",
        marker=mark,
        markersize=2.0,
        color=colour,
        alpha=0.3,
        markeredgewidth=0.0,
    )
    axes.step(
        [x for _, x in front],
        [y for y, _ in front],
        where="post",
        marker=mark,
        markersize=3.5,
        linewidth=1.1,
        color=colour,
    )
    count = found.outcomes[Outcome.SETTLED]
    label = f"{found.space.law} ({count}/{len(found.scores)})"
    return Line2D([], [], color=colour, marker=mark, markersize=3.5, linewidth=1.1, label=label)


def _points(tuned: Tuned, found: Found, places: Sequence[int]) -> list[Point]:
    points = [tuned.plan.objective.point(found.scores[place]) for place in places]
    return [point for point in points if point is not None]


def _draw_printed(axes: Axes, tuned: Tuned) -> list[Line2D]:
    """Draws the gains of the paper as stars; returns their entries of the legend."""
    entries = []
    for one, fill in zip(tuned.printed, ("full", "none"), strict=True):
        point = tuned.plan.objective.point(one.score)
        look: dict[str, Any] = {"linestyle": "", "marker": "*", "markersize": 7.0, "fillstyle": fill}
        look["color"] = style.REFERENCE
        if point is not None:
            axes.plot([point[1]], [point[0]], **look)
        label = one.name + ("" if point is not None else f" ({_lacking(one.score)})")
        entries.append(Line2D([], [], label=label, **look))
    return entries


def _lacking(score: Score) -> str:
    """Returns why a run is not drawn, in a word."""
    return "never" if score.outcome is Outcome.SETTLED else score.outcome.value

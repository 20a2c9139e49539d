"""The figure of a comparison, error against effort with a front per control law, and its files.

Front.json, front.md, front.png, front.pdf.

Invariant: the JSON is the result, the other files are views of it. Every settled run is drawn, on a front
or not, and the legend counts them out of all; the gains that the paper prints are stars and stand on no
front.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ...files import write_whole
from ...reporting import style
from .candidate import CandidateScore
from .final_posture import CandidateClass
from .pareto_search import Objective, ObjectivePoint
from .search_space import SEARCH_SPACES
from .tuning_plan import SearchResult, TuningResult
from .tuning_tables import build_tuning_page, tuning_to_json

FRONT_WIDTH_IN = 3.5
"""One column of a page of two."""
_HEIGHT_IN = 3.1
_SIZE_PT = 8.0
_MARKS = ("o", "s", "^", "D", "v", "P")
_LABELS = {
    Objective.ERROR: "error (rad)",
    Objective.SETTLING: "settling time (s)",
}


def draw_front(tuned: TuningResult) -> Figure:
    """Returns the fronts of all laws in one panel, both axes logarithmic."""
    with style.figure_style():
        figure = style.new_figure(_HEIGHT_IN, FRONT_WIDTH_IN)
        axes = figure.add_subplot()
        drawn = [_draw_law(axes, tuned, found) for found in tuned.found]
        stars = _draw_printed(axes, tuned)
        axes.set_xlabel("effort (N m)", fontsize=_SIZE_PT)
        axes.set_ylabel(_LABELS[tuned.plan.objective], fontsize=_SIZE_PT)
        axes.tick_params(labelsize=_SIZE_PT)
        shown = [number for line in axes.lines for number in np.ravel(line.get_xydata())]
        if not shown:
            style.annotate_empty_panel(axes, "no candidate settled")
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


def _draw_law(axes: Axes, tuned: TuningResult, found: SearchResult) -> Line2D:
    """Draws a law's settled runs faintly and its front on top; returns its entry of the legend."""
    place = list(SEARCH_SPACES).index(found.space.law)
    colour, mark = style.SITE_COLOURS[place % len(style.SITE_COLOURS)], _MARKS[place % len(_MARKS)]
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
    count = found.outcomes[CandidateClass.SETTLED]
    label = f"{found.space.law} ({count}/{len(found.scores)})"
    return Line2D([], [], color=colour, marker=mark, markersize=3.5, linewidth=1.1, label=label)


def _points(tuned: TuningResult, found: SearchResult, places: Sequence[int]) -> list[ObjectivePoint]:
    points = [tuned.plan.objective.point(found.scores[place]) for place in places]
    return [point for point in points if point is not None]


def _draw_printed(axes: Axes, tuned: TuningResult) -> list[Line2D]:
    """Draws the gains of the paper as stars; returns their entries of the legend."""
    entries = []
    for one, fill in zip(tuned.printed, ("full", "none"), strict=True):
        point = tuned.plan.objective.point(one.score)
        look: dict[str, Any] = {"linestyle": "", "marker": "*", "markersize": 7.0, "fillstyle": fill}
        look["color"] = style.REFERENCE
        if point is not None:
            axes.plot([point[1]], [point[0]], **look)
        label = one.name + ("" if point is not None else f" ({_undrawn_reason(one.score)})")
        entries.append(Line2D([], [], label=label, **look))
    return entries


def _undrawn_reason(score: CandidateScore) -> str:
    """Returns why a run is not drawn, in a word."""
    return "never" if score.outcome is CandidateClass.SETTLED else score.outcome.value


def write_tuning(tuned: TuningResult, folder: Path) -> list[Path]:
    """Writes a comparison into a folder that exists, and returns the paths."""
    data, text = folder / "front.json", folder / "front.md"
    write_whole(data, json.dumps(tuning_to_json(tuned), indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    write_whole(text, build_tuning_page(tuned))
    figure = draw_front(tuned)
    pictures = [folder / "front.png", folder / "front.pdf"]
    for path in pictures:
        figure.savefig(path, dpi=style.REPORT_DPI)
    return [data, text, *pictures]

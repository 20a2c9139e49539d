"""A board as a blueprint of Rerun.

Law: the viewer decides nothing: every view, every name and every color is said here, so that two logs look
alike.
"""

from itertools import cycle
from pathlib import Path
from typing import Any

from ..extra import extra
from .board import Board, Curves, Page, Plot

_COLORS = [(31, 119, 180), (214, 96, 20), (44, 160, 44), (148, 103, 189), (150, 120, 30)]
_PALE = [(150, 190, 225), (245, 175, 120)]
"""Of references, beside the joints that follow them."""
_TIMELINE = "message_publish_time"


def save_layout(board: Board, application: str, path: Path) -> None:
    """Writes a board as a blueprint file.

    Args:
        board: what to show.
        application: what Rerun calls the recordings that it is for.
        path: the file.

    Raises:
        UsageError: Rerun is not installed.
    """
    rrb = extra("rerun.blueprint", "view", "viewers")
    pages = rrb.Tabs(*(_page(rrb, name, page) for name, page in board.pages.items()))
    views = [pages]
    if board.lines:
        views.append(rrb.TextLogView(origin=board.lines, name="what happened"))
    blueprint = rrb.Blueprint(
        rrb.Vertical(*views, row_shares=[6, 1][: len(views)]),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
    blueprint.save(application, path)


def _page(rrb: Any, name: str, page: Page) -> Any:
    rows = [rrb.Horizontal(*(_view(rrb, plot) for plot in plots)) for plots in page]
    return rrb.Vertical(*rows, name=name)


def _view(rrb: Any, plot: Plot) -> Any:
    """Returns a plot; of several channels in it each has colors of its own."""
    overrides: dict[str, Any] = {}
    for curves in plot.curves:
        overrides[curves.entity] = _lines(curves, 2 * len(overrides))
    return rrb.TimeSeriesView(
        name=plot.title,
        origin="/",
        contents=[curves.entity for curves in plot.curves],
        overrides=overrides,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )


def _lines(curves: Curves, first: int) -> Any:
    """Returns how curves are drawn, from a color on; references paler than what follows them."""
    rr = extra("rerun", "view", "viewers")
    pale, strong = cycle(_PALE), cycle(_COLORS[first:] + _COLORS[:first])
    colors = [next(pale) if name.endswith("_ref") else next(strong) for name in curves.names]
    return rr.SeriesLines(names=list(curves.names), colors=colors, visible_series=list(curves.shown))

"""Figures over the time of a run: panels, a line per site, event markers, time axis and legend.

Invariant: a run without events has figures without markers. Markers show hold, brake and return of sites
and applied changes.
"""

import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from matplotlib.axes import Axes

from ...analysis.timeline import find_mode_intervals, list_changes
from ...core.vectors import Array
from ...log.log_reader import Log
from ...log.record_columns import Ints
from ...log.site_log import SiteLog
from .. import style
from ..figure_size import FigureSize

MOST_EXPLAINED_CHANGES = 12
"""Changes that a figure explains; the page lists all of them."""

SiteSignal = Callable[[str], tuple[Ints, Array, Array]]
"""Ticks, shape (K,), times, shape (K,), s, and values, shape (K, J), of a site."""

_AWAY, _BACK = 0.22, 0.09
_LETTERS_PER_IN = 120.0
"""Of 1 pt type, on the average."""
_MODE_VERBS = {
    "hold": "holds",
    "brake": "brakes",
    "return": "returns (lighter)",
    "waiting": "waits",
    "fault": "is in fault",
    "stopped": "is stopped",
}
_CHANGE: dict[str, Any] = {"color": style.REFERENCE, "linestyle": (0, (1, 1.5)), "linewidth": 0.7}
_NUMBER: dict[str, Any] = {
    "xytext": (1.5, -0.5),
    "textcoords": "offset points",
    "va": "top",
    "color": style.REFERENCE,
    "bbox": {"boxstyle": "square,pad=0.05", "facecolor": "white", "edgecolor": "none", "alpha": 0.7},
}


def site_records(log: Log, values: Callable[[SiteLog], Array]) -> SiteSignal:
    """Returns the signal of all sites whose values follow from their records."""
    return lambda site: (log[site].tick, log[site].t_s, values(log[site]))


@contextmanager
def time_figure(log: Log, form: FigureSize, height_in: float) -> Iterator["TimeFigure"]:
    """Yields an empty figure in the style of all figures."""
    with style.figure_style(form):
        yield TimeFigure(log, form, height_in)


class TimeFigure:
    """A figure of a log over time."""

    def __init__(self, log: Log, form: FigureSize, height_in: float) -> None:
        self.log = log
        self.figure = style.new_figure(height_in, form.width_in)
        self._small_pt = form.small_pt
        self._changes = list(enumerate(list_changes(log), 1))
        self._modes = {site: find_mode_intervals(log[site]) for site in log.sites}

    def trace(self, axes: Axes, site: str, values: Array, width: float | None = None, **options: Any) -> None:
        """Draws values over the records of a site, shape (K,); `options` replace those of the site's line."""
        part = self.log[site]
        line = {**style.site_line(self.log, site, width), **options}
        style.plot_decimated(axes, part.tick, part.t_s, values, **line)

    def joint_row(self, row: Sequence[Axes], sites: Sequence[str], signal: SiteSignal) -> None:
        """Draws a signal of sites: a panel per joint, a line per site, markers."""
        for site in sites:
            tick, t_s, values = signal(site)
            for axes, one in zip(row, values.T, strict=False):
                style.plot_decimated(axes, tick, t_s, one, **style.site_line(self.log, site))
        for axes in row:
            self.mark(axes, sites)
            if len(row) > 2:
                style.flatten_rounding(axes)

    def mark(self, axes: Axes, sites: Sequence[str], link: str = "", *, numbered: bool = True) -> None:
        """Marks a panel: shaded in the color of a site while it does not follow its peers, lines at changes.

        Changes are those that the sites carried out, or of these those of one link.
        """
        for site in sites:
            colour = style.site_colour(self.log, site)
            for mode, from_s, to_s in self._modes[site]:
                depth = _BACK if mode == "return" else _AWAY
                axes.axvspan(from_s, to_s, color=colour, alpha=depth, linewidth=0.0, zorder=0.5)
        for n, changed in self._changes:
            if changed.site not in sites or (link and changed.change.link != link):
                continue
            at_s, place = changed.change.at_s, axes.get_xaxis_transform()
            axes.axvline(at_s, zorder=0.6, **_CHANGE)
            if numbered:
                axes.annotate(str(n), (at_s, 1.0), xycoords=place, fontsize=self._small_pt, **_NUMBER)

    def finish(
        self, lowest: Sequence[Axes], entries: style.LegendEntries, *, links: bool = False, title: str = ""
    ) -> None:
        """Gives the lowest panels their time axis, the figure its legend, and explains its markers.

        With `links`, only changes of links are marked; the title stands above the legend.
        """
        style.set_time_axis(self.log, lowest)
        style.add_legend(self.figure, entries, **({"title": title, "title_fontsize": 8.0} if title else {}))
        marked = [(n, c) for n, c in self._changes if c.change.link or not links]
        words = [f"{n}: {c.about} {c.text}" for n, c in marked[:MOST_EXPLAINED_CHANGES]]
        if len(marked) > MOST_EXPLAINED_CHANGES:
            words.append(f"and {len(marked) - MOST_EXPLAINED_CHANGES} more")
        letters = int(_LETTERS_PER_IN * self.figure.get_figwidth() / self._small_pt)
        lines = textwrap.wrap(f"Changes: {'; '.join(words)}", letters) if words else []
        modes = {interval.mode for intervals in self._modes.values() for interval in intervals}
        if modes:
            doing = ", ".join(text for mode, text in _MODE_VERBS.items() if mode in modes)
            lines += textwrap.wrap(f"Shaded in the color of a site: it {doing}", letters)
        if lines:
            text = style.typeset("\n".join(lines))
            self.figure.supxlabel(text, x=0.01, ha="left", fontsize=self._small_pt, color=style.REFERENCE)

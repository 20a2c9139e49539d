"""Markers of events in figures over time: hold, brake and return of sites, and applied changes.

Invariant: a run without events has figures without markers.
"""

import textwrap
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..analysis.timeline import AppliedChange, find_mode_intervals, list_changes
from ..log.log_reader import Log
from . import style
from .figure_size import REPORT_SIZE, FigureSize

MOST_EXPLAINED_CHANGES = 12
"""Changes that a figure explains; all of them stand on the page."""

_AWAY, _BACK = 0.22, 0.09
_LETTERS_PER_IN = 120.0
"""Of 1 pt type, on the average."""
_SAYS = {"hold": "holds", "brake": "brakes", "return": "returns (lighter)"}
_CHANGE: dict[str, Any] = {"color": style.REFERENCE, "linestyle": (0, (1, 1.5)), "linewidth": 0.7}
_NUMBER: dict[str, Any] = {
    "xytext": (1.5, -0.5),
    "textcoords": "offset points",
    "va": "top",
    "color": style.REFERENCE,
    "bbox": {"boxstyle": "square,pad=0.05", "facecolor": "white", "edgecolor": "none", "alpha": 0.7},
}


class EventMarkers:
    """What figures of a log have to mark.

    Args:
        log: the log.
        form: what they are drawn for.
    """

    def __init__(self, log: Log, form: FigureSize = REPORT_SIZE) -> None:
        self._log = log
        self._small_pt = form.small_pt
        self._changes = list(enumerate(list_changes(log), 1))
        self._spans = {site: find_mode_intervals(log[site]) for site in log.sites}

    def draw(self, axes: Axes, sites: Sequence[str], link: str = "", *, numbered: bool = True) -> None:
        """Marks a panel over time: shaded in the colour of a site while it does not follow its peers.

        Args:
            axes: the panel.
            sites: whose marks.
            link: the only link whose changes it shows, or "": all that these sites carried out.
            numbered: whether changes have their numbers there.
        """
        for site in sites:
            for mode, from_s, to_s in self._spans[site]:
                depth = _BACK if mode == "return" else _AWAY
                axes.axvspan(
                    from_s,
                    to_s,
                    color=style.site_colour(self._log, site),
                    alpha=depth,
                    linewidth=0.0,
                    zorder=0.5,
                )
        for n, changed in self._of(sites, link):
            at_s, place = changed.change.at_s, axes.get_xaxis_transform()
            axes.axvline(at_s, zorder=0.6, **_CHANGE)
            if numbered:
                axes.annotate(str(n), (at_s, 1.0), xycoords=place, fontsize=self._small_pt, **_NUMBER)

    def explain(self, figure: Figure, links: bool = False) -> None:
        """Says below a figure what is marked in it, where anything is.

        Args:
            figure: the figure.
            links: whether it shows changes of links only.
        """
        told = [(n, c) for n, c in self._changes if c.change.link or not links]
        words = [f"{n}: {c.about} {c.text}" for n, c in told[:MOST_EXPLAINED_CHANGES]]
        if len(told) > MOST_EXPLAINED_CHANGES:
            words.append(f"and {len(told) - MOST_EXPLAINED_CHANGES} more")
        letters = int(_LETTERS_PER_IN * figure.get_figwidth() / self._small_pt)
        lines = textwrap.wrap(f"Changes: {'; '.join(words)}", letters) if words else []
        modes = {span.mode for found in self._spans.values() for span in found}
        if modes:
            doing = ", ".join(text for mode, text in _SAYS.items() if mode in modes)
            lines += textwrap.wrap(f"Shaded in the colour of a site: it {doing}", letters)
        if lines:
            text = "\n".join(lines).replace("+-", "±").replace("->", " → ")
            figure.supxlabel(text, x=0.01, ha="left", fontsize=self._small_pt, color=style.REFERENCE)

    def _of(self, sites: Sequence[str], link: str) -> list[tuple[int, AppliedChange]]:
        found = [(n, c) for n, c in self._changes if c.site in sites]
        return [(n, c) for n, c in found if c.change.link == link] if link else found

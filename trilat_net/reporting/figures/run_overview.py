"""A run in four panels, errors, speeds, torques and ages; and several runs over one another in
the same.

Invariant: a line of one run is a site's, a line of several is a run's: the largest of its sites
at any time.
"""

import textwrap
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import site_signals
from ...analysis.site_signals import largest_magnitude, settling_time_of_all_s
from ...analysis.timeline import recorded_end_s
from ...core.vectors import Array
from ...errors import UsageError
from ...log.log_reader import Log
from ...theory.linear_analysis import certify_run
from .. import style
from ..appearance import REPORT_SIZE, SITE_COLOURS, FigureSize
from .figure_entry import draws

_HEIGHT_IN = 3.9
_NARROW_HEIGHT_IN = 5.6
_DECADES = 6.0
"""Of an axis of errors, at most: what is smaller has settled long ago."""
_LETTERS_PER_IN = 15.0
_SPANS = 1_000
"""Of time, at most, in a line of several sites."""


class _Panel(NamedTuple):
    """What a panel shows: its name, its unit in a log, and the column of a site, shape (K,)."""

    name: str
    unit: Callable[[Log], str]
    column: Callable[[Log, str], Array]
    log_scale: bool = False


def _oldest_sample_ms(log: Log, site: str) -> Array:
    ages_ms = site_signals.sample_ages_ms(log, site)
    found: Array = np.where(np.isnan(ages_ms), -np.inf, ages_ms).max(axis=1, initial=-np.inf)
    return np.where(np.isfinite(found), found, np.nan)


_PANELS = (
    _Panel(
        "largest error",
        site_signals.shared_unit,
        lambda log, site: largest_magnitude(log[site].e),
        log_scale=True,
    ),
    _Panel(
        "largest speed", lambda _: "rad/s", lambda log, site: largest_magnitude(log[site].qd)
    ),
    _Panel(
        "largest torque", lambda _: "N m", lambda log, site: largest_magnitude(log[site].tau)
    ),
    _Panel("oldest sample", lambda _: "ms", _oldest_sample_ms),
)


@draws("overview", "errors, speeds, torques and ages of a run at a glance")
def draw_overview(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns a run in four panels, a line per site, with what the certificate says of it."""
    height_in = _NARROW_HEIGHT_IN if form.narrow else _HEIGHT_IN
    with style.time_figure(log, form, height_in) as plot:
        panels = _add_panels(plot.figure, log, form)
        for panel, axes in zip(_PANELS, panels, strict=True):
            columns = {site: panel.column(log, site) for site in log.sites}
            _scale(axes, panel, [*columns.values()])
            for site, values in columns.items():
                plot.trace(axes, site, style.positive(values) if panel.log_scale else values)
            plot.mark(axes, log.sites)
        last = settling_time_of_all_s(
            [site_signals.settling_time_s(log[site]) for site in log.sites]
        )
        when = "not settled" if last is None else f"settled at {last:.1f} s"
        words = (
            f"{log.scenario.title or log.scenario.name}: {certify_run(log).stability}, {when}"
        )
        title = "\n".join(textwrap.wrap(words, round(_LETTERS_PER_IN * form.width_in)))
        entries = style.site_legend_entries(log, log.sites)
        plot.finish(panels[3:] if form.narrow else panels[2:], entries, title=title)
    return plot.figure


def draw_overlay(logs: Mapping[str, Log], form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns several runs, by their names in the legend, over one another in the panels of an
    overview.

    Raises:
        UsageError: there is no log, or their sites follow each other in different units.
    """
    units = {site_signals.shared_unit(log) for log in logs.values()}
    if len(units) != 1:
        found = f"errors in {' and '.join(sorted(units))}" if units else "no log"
        raise UsageError(
            f"only runs of one kind are drawn over one another, and these have {found}"
        )
    first = next(iter(logs.values()))
    end_s = max(map(recorded_end_s, logs.values()))
    with style.styled_figure(form, _NARROW_HEIGHT_IN if form.narrow else _HEIGHT_IN) as figure:
        panels = _add_panels(figure, first, form)
        lines = {name: _line(n) for n, name in enumerate(logs)}
        for panel, axes in zip(_PANELS, panels, strict=True):
            envelopes = {name: _find_envelope(panel, log) for name, log in logs.items()}
            _scale(axes, panel, [values for _, values in envelopes.values()])
            for name, (t_s, values) in envelopes.items():
                axes.plot(
                    t_s, style.positive(values) if panel.log_scale else values, **lines[name]
                )
            axes.set_xlim(0.0, end_s)
        for axes in panels[3:] if form.narrow else panels[2:]:
            axes.set_xlabel("time (s)")
        style.add_legend(figure, [*lines.items()])
    return figure


def _add_panels(figure: Figure, log: Log, form: FigureSize) -> list[Axes]:
    grid = style.add_panels(figure, *((4, 1) if form.narrow else (2, 2)), sharex=True)
    panels = [*grid.flat]
    for panel, axes in zip(_PANELS, panels, strict=True):
        name = panel.name.replace(" ", "\n") if form.narrow else panel.name
        axes.set_ylabel(f"{name} ({panel.unit(log)})")
    return panels


def _line(n: int) -> dict[str, Any]:
    dashes = style.DASHES[n // len(SITE_COLOURS) % len(style.DASHES)]
    return {"color": SITE_COLOURS[n % len(SITE_COLOURS)], "linestyle": dashes, "linewidth": 1.2}


def _find_envelope(panel: _Panel, log: Log) -> tuple[Array, Array]:
    """Returns the largest of all sites in even spans of time, NaN without any, after their
    middles, s.
    """
    count = max(1, min(_SPANS, *(len(log[site]) // 2 for site in log.sites)))
    edges = np.linspace(0.0, recorded_end_s(log), count + 1)
    found = np.full(count, np.nan)
    for site in log.sites:
        spans = np.clip(np.searchsorted(edges, log[site].t_s, side="right") - 1, 0, count - 1)
        np.fmax.at(found, spans, panel.column(log, site))
    return 0.5 * (edges[1:] + edges[:-1]), found


def _scale(axes: Axes, panel: _Panel, columns: list[Array]) -> None:
    known = np.concatenate([values[np.isfinite(values)] for values in columns])
    most = float(known.max(initial=0.0))
    if not panel.log_scale:
        axes.set_ylim(0.0, 1.08 * most if most > 0.0 else 1.0)
    elif most > 0.0:
        least = max(float(known[known > 0.0].min()), most * 10.0**-_DECADES)
        axes.set(yscale="log", ylim=(0.7 * least, 1.5 * most))

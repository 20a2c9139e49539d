"""Histograms of the loops' lateness and computing time.

Invariant: virtual time reads no clock, so its figure gives that reason in place of zeros.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.vectors import Array
from ...log.log_reader import Log
from ...log.record_columns import Ints
from .. import style
from ..figure_size import REPORT_SIZE, FigureSize

NO_LOOP_CLOCK = "virtual time: no clock was read, so no loop was late and no tick was timed"
NO_LOOP_TIMES = "no lateness and no computing time in this log"
_BINS_PER_DECADE = 20


def explain_missing_loop_times(log: Log) -> str:
    """Returns why there are no times to draw; "" if a lateness or a computing time is not zero."""
    if any(np.any(log[name].late_us) or np.any(log[name].busy_us) for name in log.sites):
        return ""
    return NO_LOOP_CLOCK if log.driver == "virtual" else NO_LOOP_TIMES


def loop_time_bin_edges(log: Log) -> Array:
    """Returns the edges of the histograms of a log, shape (B + 1,), us, equal steps of the logarithm.

    The last edge lies above every time in the log; times below the first, 1 us, count in the first bin.
    """
    largest = max(
        (int(times.max()) for s in log.sites for times in (log[s].late_us, log[s].busy_us) if len(times)),
        default=1,
    )
    decades = np.log10(max(largest, 10) * 1.1)
    count = int(np.ceil(decades * _BINS_PER_DECADE))
    edges: Array = np.power(10.0, np.arange(count + 1) / _BINS_PER_DECADE)
    return edges


def bin_loop_times(times_us: Ints, edges: Array) -> Ints:
    """Returns how many times, shape (K,), us, lie in each bin between `edges`, shape (B + 1,), us."""
    return np.histogram(np.maximum(times_us, 1), edges)[0].astype(np.int64)


def draw_loop_timing(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns histograms of each site's lateness and computing time, us."""
    edges = loop_time_bin_edges(log)
    labels = ("lateness", "computing time")
    if not form.narrow:
        labels = ("wake-up after the deadline", "computing time of a tick")
    with style.styled_figure(form, 0.6 + (1.3 if form.narrow else 1.05) * len(log.sites)) as figure:
        grid = style.add_panels(figure, len(log.sites), 2, sharex=True, sharey=True)
        for site, (late, busy) in zip(log.sites, grid, strict=True):
            _bars(log, site, late, log[site].late_us, edges, form)
            _bars(log, site, busy, log[site].busy_us, edges, form)
            late.set_ylabel("ticks (count)")
        grid[0, 0].set_ylim(bottom=0.7)
        for axes, text in zip(grid[-1], labels, strict=True):
            axes.set_xlabel(f"{text} (µs)")
        style.add_legend(figure, [("one period", style.LIMIT_LINE)])
    return figure


def _bars(log: Log, site: str, axes: Axes, times_us: Ints, edges: Array, form: FigureSize) -> None:
    axes.set(xscale="log", yscale="log")
    counts, colour = bin_loop_times(times_us, edges), style.site_colour(log, site)
    axes.stairs(counts, edges, baseline=0.5, fill=True, color=colour)
    axes.axvline(1e6 / log.scenario.sites[site].rate_hz, **style.LIMIT_LINE)
    if not len(times_us):
        style.annotate_empty_panel(axes, f"no times of {site}")
        return
    p50, p99, largest = (f"{value:.0f}" for value in np.percentile(times_us, (50.0, 99.0, 100.0)))
    between = "\n" if form.narrow else " "
    axes.set_title(f"{site}: p50 {p50}, p99 {p99},{between}max {largest} µs", loc="left", pad=2.0)

"""Figures of links and loops: age of the samples in use, delays, lateness and computing time.

Invariant: a measured link has no line of stated delay; a log of constant links has no
distributions. Virtual time reads no clock, so its figure of the loops gives that reason in
place of zeros.
"""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis.link_summary import (
    count_sent,
    has_one_constant_delay,
    predict_delivery,
    read_arrivals,
    sample_ages_ns,
)
from ...analysis.site_signals import sample_ages_ms
from ...analysis.timeline import StatedModel, list_changes, list_stated_models, recorded_end_s
from ...core.vectors import Array
from ...log.log_reader import Log
from ...log.record_columns import Ints
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws, unless

_POINTS = 400
_TALL = 6.0
_STEP_MS = 1.5
"""A fall of an age by more is no sample more at a tick."""
NO_LOOP_CLOCK = "virtual time: no clock was read, so no loop was late and no tick was timed"
NO_LOOP_TIMES = "no lateness and no computing time in this log"
_BINS_PER_DECADE = 20


class DelayDistribution(NamedTuple):
    """Delays of a link's samples, by its model or else measured, and ages in use at the
    receiver's ticks.
    """

    peer: str
    site: str
    delay_ms: Array
    age_ms: Array


@draws("sample_age", "age of the samples in use, per link", in_report=True)
def draw_sample_age(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the age of the sample in use on every link over time, ms: a row per receiver."""
    lines = {
        link: trace_stated_delay(log, states) for link, states in _stated_models(log).items()
    }
    with style.time_figure(log, form, 0.6 + 1.05 * len(log.sites)) as plot:
        grid = style.add_panels(
            plot.figure, len(log.sites), len(log.sites) - 1, sharex=True, sharey=True
        )
        drawn: list[Array] = []
        spread = False
        for site, row in zip(log.sites, grid, strict=True):
            for peer, age_ms, axes in zip(
                log[site].peers, sample_ages_ms(log, site).T, row, strict=True
            ):
                line = lines[f"{peer}->{site}"]
                plot.mark(axes, [site], f"{peer}->{site}")
                line_of = style.site_line(log, peer, 1.4)
                if is_unsteady(age_ms):
                    spread = True
                    style.plot_spread(axes, log[site].t_s, age_ms, **line_of)
                else:
                    plot.trace(axes, site, age_ms, **line_of)
                axes.plot(*line, **style.LIMIT_LINE)
                _title_link(axes, peer, site)
                if not np.any(np.isfinite(age_ms)):
                    style.annotate_empty_panel(axes, "no sample in use")
                drawn += [age_ms, line[1]]
        for axes in grid[:, 0]:
            axes.set_ylabel("age (ms)")
        _age_axis(grid[0, 0], np.concatenate(drawn))
        known = any(np.any(np.isfinite(values)) for _, values in lines.values())
        stated = [("mean delay as stated", style.LIMIT_LINE)] if known else []
        bands = [("least to largest, with median", style.SPREAD)] if spread else []
        plot.finish(grid[-1], [*_senders(log), *stated, *bands], links=True)
    return plot.figure


def has_varying_delay(log: Log) -> bool:
    """True if some link is stated as more than one constant delay."""
    return not all(map(has_one_constant_delay, _stated_models(log).values()))


@draws(
    "delay_distributions",
    "distributions of delays and ages",
    unless(has_varying_delay, "every link is stated as one constant delay"),
    in_report=True,
)
def draw_delay_distributions(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the distributions of delay and age on every link: a row per receiver.

    A curve is the percentage of samples, or of ticks, with at most that delay or age.
    """
    found = {(d.peer, d.site): d for d in measure_delay_distributions(log)}
    with style.styled_figure(form, 0.6 + 1.05 * len(log.sites)) as figure:
        grid = style.add_panels(
            figure, len(log.sites), len(log.sites) - 1, sharex=True, sharey=True
        )
        x_ms = choose_delay_axis_ms(list(found.values()))
        for site, row in zip(log.sites, grid, strict=True):
            for peer, axes in zip(log[site].peers, row, strict=True):
                link = found[peer, site]
                axes.plot(
                    x_ms,
                    compute_cumulative_percent(link.age_ms, x_ms),
                    **style.site_line(log, peer, 1.8),
                )
                axes.plot(
                    x_ms, compute_cumulative_percent(link.delay_ms, x_ms), **style.LIMIT_LINE
                )
                _title_link(axes, peer, site)
        for axes in grid[:, 0]:
            axes.set_ylabel("cumulative (%)")
        for axes in grid[-1]:
            axes.set_xlabel("delay or age (ms)")
        grid[0, 0].set(ylim=(0.0, 104.0), xlim=(x_ms[0], x_ms[-1]))
        if x_ms[0] > 0.0:
            grid[0, 0].set_xscale("log")
            style.set_plain_log_axis(
                grid[0, 0].xaxis, (1.0,) if form.narrow else (1.0, 2.0, 5.0)
            )
        entries = [(f"age, {text}", options) for text, options in _senders(log)]
        style.add_legend(figure, [*entries, ("delay of the samples", style.LIMIT_LINE)])
    return figure


def _stated_models(log: Log) -> dict[str, list[StatedModel]]:
    changed = list_changes(log)
    return {link: list_stated_models(log, link, changed) for link in log.scenario.links}


def measure_delay_distributions(log: Log) -> list[DelayDistribution]:
    """Returns delays and ages of every link, by receiver and then by peer."""
    found = []
    for site in log.sites:
        for peer, came in read_arrivals(log, site).items():
            count = count_sent(log, peer, int(came.sample.max(initial=-1)))
            delay_ms = predict_delivery(log, peer, site, count).drawn_ms
            if not len(delay_ms) and log.driver == "live":
                delay_ms = came.delay_us / 1e3
            found.append(
                DelayDistribution(peer, site, delay_ms, sample_ages_ns(log, peer, site) / 1e6)
            )
    return found


def choose_delay_axis_ms(found: list[DelayDistribution]) -> Array:
    """Returns the delays at which distributions are drawn, ms, to the longest; by logarithm if
    it is rare.
    """
    values = np.concatenate(
        [part for d in found for part in (d.delay_ms, d.age_ms)] or [np.zeros(0)]
    )
    known = values[np.isfinite(values)]
    end_ms = 1.05 * max(float(known.max(initial=0.0)), 1.0)
    if not needs_log_axis(known):
        return np.linspace(0.0, end_ms, _POINTS)
    return np.geomspace(max(0.5 * float(np.percentile(known, 1.0)), 0.1), end_ms, _POINTS)


def compute_cumulative_percent(values: Array, limits: Array) -> Array:
    """Returns the percentage of values that are at most as large as each limit; NaN without
    values.
    """
    if not len(values):
        return np.full(len(limits), np.nan)
    return 100.0 * np.searchsorted(np.sort(values), limits, side="right") / len(values)


def trace_stated_delay(log: Log, states: list[StatedModel]) -> tuple[Array, Array]:
    """Returns the stated mean delay over time as a line: times, s, and delays, ms; NaN between
    states.
    """
    starts = [state.from_s for state in states]
    ends = [*starts[1:], max(recorded_end_s(log), starts[-1])]
    times = [t for start, end in zip(starts, ends, strict=True) for t in (start, end, end)]
    means = [
        mean for state in states for mean in (*(state.link.moments().mean_ms,) * 2, np.nan)
    ]
    return np.array(times), np.array(means)


def needs_log_axis(ages_ms: Array) -> bool:
    """True if a few ages, as after an outage, would press all others into a line at the bottom."""
    known = ages_ms[np.isfinite(ages_ms)]
    return len(known) > 0 and bool(known.max() > _TALL * np.percentile(known, 95.0))


def is_unsteady(ages_ms: Array) -> bool:
    """True if ages go up and down within what a pixel shows, so that a line would fill all
    between.
    """
    falls = np.flatnonzero(np.diff(ages_ms) < -_STEP_MS)
    return len(falls) > style.SPREAD_BUCKETS


def _age_axis(axes: Axes, values: Array) -> None:
    known = values[np.isfinite(values)]
    if needs_log_axis(known):
        axes.set(
            yscale="log", ylim=(0.7 * float(known[known > 0.0].min()), 2.0 * float(known.max()))
        )
        style.set_plain_log_axis(axes.yaxis, (1.0, 3.0))
    else:
        axes.set_ylim(0.0, 1.25 * max(float(known.max(initial=0.0)), 1.0))


def _title_link(axes: Axes, peer: str, site: str) -> None:
    axes.set_title(f"{peer} → {site}", loc="left", pad=2.0)


def _senders(log: Log) -> list[tuple[str, dict[str, Any]]]:
    return [
        (f"from {style.site_title(log, site)}", style.site_line(log, site, 1.8))
        for site in log.sites
    ]


def explain_missing_loop_times(log: Log) -> str:
    """Returns why there are no times to draw; "" if a lateness or a computing time is not zero."""
    if any(np.any(log[name].late_us) or np.any(log[name].busy_us) for name in log.sites):
        return ""
    return NO_LOOP_CLOCK if log.driver == "virtual" else NO_LOOP_TIMES


def choose_bin_edges_us(log: Log) -> Array:
    """Returns the edges of the histograms of a log, shape (B + 1,), us, equal steps of the
    logarithm.

    The last edge lies above every time in the log; times below the first, 1 us, count in the
    first bin.
    """
    largest = max(
        (
            int(times.max())
            for s in log.sites
            for times in (log[s].late_us, log[s].busy_us)
            if len(times)
        ),
        default=1,
    )
    decades = np.log10(max(largest, 10) * 1.1)
    count = int(np.ceil(decades * _BINS_PER_DECADE))
    return np.power(10.0, np.arange(count + 1) / _BINS_PER_DECADE)


def bin_loop_times(times_us: Ints, edges: Array) -> Ints:
    """Returns how many times, shape (K,), us, lie in each bin between `edges`, shape (B + 1,),
    us.
    """
    return np.histogram(np.maximum(times_us, 1), edges)[0].astype(np.int64)


@draws(
    "loop_timing",
    "lateness and computing time of the loops",
    explain_missing_loop_times,
    in_report=True,
)
def draw_loop_timing(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns histograms of each site's lateness and computing time, us."""
    edges = choose_bin_edges_us(log)
    labels = ("lateness", "computing time")
    if not form.narrow:
        labels = ("wake-up after the deadline", "computing time of a tick")
    with style.styled_figure(
        form, 0.6 + (1.3 if form.narrow else 1.05) * len(log.sites)
    ) as figure:
        grid = style.add_panels(figure, len(log.sites), 2, sharex=True, sharey=True)
        for site, (late, busy) in zip(log.sites, grid, strict=True):
            _bars(
                log=log,
                site=site,
                axes=late,
                times_us=log[site].late_us,
                edges=edges,
                form=form,
            )
            _bars(
                log=log,
                site=site,
                axes=busy,
                times_us=log[site].busy_us,
                edges=edges,
                form=form,
            )
            late.set_ylabel("ticks (count)")
        grid[0, 0].set_ylim(bottom=0.7)
        for axes, text in zip(grid[-1], labels, strict=True):
            axes.set_xlabel(f"{text} (µs)")
        style.add_legend(figure, [("one period", style.LIMIT_LINE)])
    return figure


def _bars(
    log: Log, site: str, axes: Axes, times_us: Ints, edges: Array, form: FigureSize
) -> None:
    axes.set(xscale="log", yscale="log")
    counts = bin_loop_times(times_us, edges)
    colour = style.site_colour(log, site)
    axes.stairs(counts, edges, baseline=0.5, fill=True, color=colour)
    axes.axvline(1e6 / log.scenario.sites[site].rate_hz, **style.LIMIT_LINE)
    if not len(times_us):
        style.annotate_empty_panel(axes, f"no times of {site}")
        return
    p50, p99, largest = (
        f"{value:.0f}" for value in np.percentile(times_us, (50.0, 99.0, 100.0))
    )
    between = "\n" if form.narrow else " "
    axes.set_title(
        f"{site}: p50 {p50}, p99 {p99},{between}max {largest} µs", loc="left", pad=2.0
    )

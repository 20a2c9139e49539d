"""Draws figures of network delays and of the timing of control loops.

Each tick, an arm publishes a sample of its state. These figures show whether the network and
the computers were fast enough, using three durations:

- The delay of a sample is the time it takes to travel from sender to receiver.
- The age of a sample is the time since it was sent. At the receiver, the age grows until a
  newer sample arrives.
- The lateness of a tick is how long after its due time it started.

Invariant:
    - If the delays of a link follow a measured series, the figure has no line for the delay
      specified in the scenario.
    - A run whose links all have one constant delay has no figure of delay distributions, which
      would be vertical lines.
    - A run in virtual time does not read a clock. The figure of its loop timing states this
      reason instead of showing zeros.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import DelayDistribution, Timeline
from ...core import Array
from ...log import Ints, Log
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from ..plot_signals import sample_ages_ms
from .figure_entry import draws, unless

_POINTS = 400
"""Number of points on a distribution curve."""
_RARE_RATIO = 6.0
"""The axis is logarithmic if the largest value exceeds the 95th percentile by this factor."""
_STEP_MS = 1.5
"""A drop in age from one tick to the next counts as a fluctuation if it exceeds this value.

A drop of about 1 ms is normal: it occurs whenever two samples arrive in the same tick of 1 ms.
"""
NO_LOOP_CLOCK = "virtual time: no clock was read, so no loop was late and no tick was timed"
NO_LOOP_TIMES = "no lateness and no computing time in this log"
_SPREAD_BUCKETS = 120
"""Number of time intervals for which `_plot_spread` draws a median and a band."""
_SPREAD: style.LineOptions = {"color": style.FAINT, "alpha": 0.35, "linewidth": 6.0}
"""Options of the legend line that represents the band of a spread."""
_BINS_PER_DECADE = 20
"""Number of histogram bins per decade, for example between 1 us and 10 us."""


@draws("sample_age", "age of the samples in use, per link", in_report=True)
def _draw_sample_age(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the age of the sample in use on every link over time, in ms.

    The age is the time since the sample was sent. The figure has one row per receiver. An age
    that fluctuates is drawn as a band with its median, because a line would fill the area
    between its extremes.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    ages_ms = _read_ages_ms(log)
    timeline = Timeline(log)
    stated_delays = {link: trace_stated_delay(timeline, link) for link in log.scenario.links}

    has_bands = False
    with style.time_figure(log, form, 0.6 + 1.05 * len(log.sites)) as plot:
        grid, panels = _add_link_panels(plot.figure, log)
        for (peer, site), axes in panels.items():
            age_ms = ages_ms[peer, site]
            line_style = style.site_line(log, peer, 1.4)
            plot.mark(axes, [site], f"{peer}->{site}")

            if _is_unsteady(age_ms):
                has_bands = True
                _plot_spread(axes, log[site].t_s, age_ms, **line_style)
            else:
                plot.trace(axes, site, age_ms, **line_style)

            axes.plot(*stated_delays[f"{peer}->{site}"], **style.LIMIT_LINE)
            if not np.any(np.isfinite(age_ms)):
                style.annotate_empty_panel(axes, "no sample in use")
        for axes in grid[:, 0]:
            axes.set_ylabel("age (ms)")

        stated_ms = np.concatenate([delay_ms for _, delay_ms in stated_delays.values()])
        _scale_age_axis(grid[0, 0], np.concatenate([*ages_ms.values(), stated_ms]))
        entries = _list_sender_entries(log)
        if np.any(np.isfinite(stated_ms)):
            entries.append(("mean delay as stated", style.LIMIT_LINE))
        if has_bands:
            entries.append(("least to largest, with median", _SPREAD))
        plot.finish(grid[-1], entries, links=True)
    return plot.figure


def _read_ages_ms(log: Log) -> dict[tuple[str, str], Array]:
    """Returns the ages of the samples in use, in ms, shape (K,), by (sender, receiver)."""
    ages_ms = {}
    for site in log.sites:
        columns = sample_ages_ms(log, site).T
        for peer, age_ms in zip(log[site].peers, columns, strict=True):
            ages_ms[peer, site] = age_ms
    return ages_ms


def _add_link_panels(
    figure: Figure, log: Log
) -> tuple[style.AxesGrid, dict[tuple[str, str], Axes]]:
    """Adds a grid of panels to a figure: one row per receiving site, one panel per sender.

    All panels share their axes, so that the delays of links can be compared.

    Returns:
        The grid of panels, and a mapping from (sender, receiver) to panel.
    """
    site_count = len(log.sites)
    sender_count = site_count - 1  # a site does not send to itself
    grid = style.add_panels(figure, site_count, sender_count, sharex=True, sharey=True)
    panels = {}
    for site, row in zip(log.sites, grid, strict=True):
        for peer, axes in zip(log[site].peers, row, strict=True):
            axes.set_title(f"{peer} → {site}", loc="left", pad=2.0)
            panels[peer, site] = axes
    return grid, panels


def has_varying_delay(log: Log) -> bool:
    """Returns True if the delays of a run vary, so that their distribution is worth showing.

    Figures and pages omit the distribution if the delays do not vary.

    Args:
        log: Log of the run.

    Returns:
        False if every link delays all its samples by the same constant time and loses none, and
        True otherwise.
    """
    links = Timeline(log).stated_links.values()
    return not all(link.has_one_constant_delay for link in links)


class DelayAxis(NamedTuple):
    """Delay axis shared by the distributions of all links of a run.

    Attributes:
        x_ms: Delays at which the curves are evaluated, in ms, shape (P,). They extend to the
            longest delay or age, and are equally spaced on a linear or a logarithmic axis. A
            linear axis begins at 0.
    """

    x_ms: Array

    @property
    def is_logarithmic(self) -> bool:
        """True if the axis is logarithmic.

        An axis is logarithmic if a few values are far above the rest.
        """
        return bool(self.x_ms[0] > 0.0)

    @classmethod
    def of_links(cls, links: Sequence[DelayDistribution]) -> "DelayAxis":
        """Chooses an axis that covers the delays and ages of links.

        Args:
            links: Delays and ages of all links that share the axis.
        """
        value_arrays: list[Array] = [np.zeros(0)]
        for link in links:
            value_arrays += [link.delay_ms, link.age_ms]
        values_ms = np.concatenate(value_arrays)
        known_ms = values_ms[np.isfinite(values_ms)]

        longest_ms = float(known_ms.max(initial=0.0))
        end_ms = 1.05 * max(longest_ms, 1.0)
        if not needs_log_axis(known_ms):
            return cls(np.linspace(0.0, end_ms, _POINTS))

        # A logarithmic axis has no 0. It begins below nearly all values.
        short_ms = float(np.percentile(known_ms, 1.0))
        start_ms = max(0.5 * short_ms, 0.1)
        return cls(np.geomspace(start_ms, end_ms, _POINTS))

    def compute_percent(self, values_ms: Array) -> Array:
        """Returns the percentage of values that do not exceed each delay on the axis.

        This is the cumulative distribution of the values, such as ages.

        Args:
            values_ms: The values to count, in ms, shape (K,).

        Returns:
            Percentages, shape (P,). All are NaN if there are no values.
        """
        if not len(values_ms):
            return np.full(len(self.x_ms), np.nan)
        counts = np.searchsorted(np.sort(values_ms), self.x_ms, side="right")
        return 100.0 * counts / len(values_ms)


@draws(
    "delay_distributions",
    "distributions of delays and ages",
    unless(has_varying_delay, "every link is stated as one constant delay"),
    in_report=True,
)
def _draw_delay_distributions(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the distributions of the delay and of the age of samples on every link.

    The delay of a sample is the time from sending to arrival, and its age the time from sending
    to use. A curve at x shows the percentage of samples with a delay of at most x ms, or of
    ticks with an age of at most x ms. The figure has one row per receiver.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    links = DelayDistribution.list_of_log(log)
    axis = DelayAxis.of_links(links)
    with style.styled_figure(form, 0.6 + 1.05 * len(log.sites)) as figure:
        grid, panels = _add_link_panels(figure, log)
        for link in links:
            axes = panels[link.peer, link.site]
            age_percent = axis.compute_percent(link.age_ms)
            delay_percent = axis.compute_percent(link.delay_ms)
            axes.plot(axis.x_ms, age_percent, **style.site_line(log, link.peer, 1.8))
            axes.plot(axis.x_ms, delay_percent, **style.LIMIT_LINE)
        for axes in grid[:, 0]:
            axes.set_ylabel("cumulative (%)")
        for axes in grid[-1]:
            axes.set_xlabel("delay or age (ms)")

        first_panel = grid[0, 0]
        first_panel.set(ylim=(0.0, 104.0), xlim=(axis.x_ms[0], axis.x_ms[-1]))
        if axis.is_logarithmic:
            first_panel.set_xscale("log")
            labelled_digits = (1.0,) if form.narrow else (1.0, 2.0, 5.0)
            style.set_plain_log_axis(first_panel.xaxis, labelled_digits)

        entries = [(f"age, {text}", line) for text, line in _list_sender_entries(log)]
        style.add_legend(figure, [*entries, ("delay of the samples", style.LIMIT_LINE)])
    return figure


def trace_stated_delay(timeline: Timeline, link: str) -> tuple[Array, Array]:
    """Returns the mean delay that the scenario specifies for a link, as a line to plot.

    Figures draw this line dashed next to the measured delays, which should agree with it.

    Args:
        timeline: Timeline of the run, with the delay models of the link. Each model applies
            until the next one replaces it.
        link: Name of the link, "j->i".

    Returns:
        Times in s and mean delays in ms, each of shape (3 M,) for M models. Each model
        contributes a point at its start, a point at its end, and a NaN that breaks the line.
    """
    models = timeline.stated_links[link].models
    starts_s = [model.from_s for model in models]
    last_s = max(timeline.end_s, starts_s[-1])
    ends_s = [*starts_s[1:], last_s]

    times_s: list[float] = []
    means_ms: list[float] = []
    for model, end_s in zip(models, ends_s, strict=True):
        mean_ms = model.link.moments().mean_ms
        times_s += [model.from_s, end_s, end_s]
        means_ms += [mean_ms, mean_ms, np.nan]
    return np.array(times_s), np.array(means_ms)


def needs_log_axis(ages_ms: Array) -> bool:
    """Returns True if a few large ages would hide the others on a linear axis.

    This happens after a link outage, for example.

    Args:
        ages_ms: Ages in ms, shape (K,). NaN values are ignored.
    """
    known_ms = ages_ms[np.isfinite(ages_ms)]
    if not len(known_ms):
        return False
    usual_ms = np.percentile(known_ms, 95.0)
    return bool(known_ms.max() > _RARE_RATIO * usual_ms)


def _is_unsteady(ages_ms: Array) -> bool:
    """Returns True if ages fluctuate so often that a line would look like a filled area.

    In that case, the figure shows the spread of the ages as a band.

    Args:
        ages_ms: Age of the sample in use over time, in ms, shape (K,).
    """
    # The age falls whenever a newer message comes into use.
    falls = np.flatnonzero(np.diff(ages_ms) < -_STEP_MS)
    return len(falls) > _SPREAD_BUCKETS


def _plot_spread(axes: Axes, t_s: Array, values: Array, **options: Any) -> None:
    """Plots a fluctuating signal as its median within a band from minimum to maximum.

    The time axis is divided into `_SPREAD_BUCKETS` intervals with equal numbers of values. Each
    interval contributes one point of the median and of the band edges.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        t_s: Times of the values, in s, shape (K,).
        values: The values, shape (K,). NaN values are ignored.
        **options: Options of the median line. They must include a "color", which also applies
            to the band.
    """
    buckets = np.array_split(np.arange(len(values)), _SPREAD_BUCKETS)
    points = []
    for bucket in buckets:
        if len(bucket):
            middle_s = t_s[bucket].mean()
            points.append((middle_s, *_compute_spread(values[bucket])))

    middles_s, smallest, median, largest = np.array(points).reshape(-1, 4).T
    axes.fill_between(
        middles_s,
        smallest,
        largest,
        color=options["color"],
        alpha=_SPREAD["alpha"],
        linewidth=0.0,
    )
    axes.plot(middles_s, median, **options)


def _compute_spread(values: Array) -> tuple[float, float, float]:
    """Returns the minimum, median and maximum of the finite values. NaN if there are none."""
    # NumPy prints a warning if all values are NaN.
    if not np.isfinite(values).any():
        return np.nan, np.nan, np.nan
    return np.nanmin(values), np.nanmedian(values), np.nanmax(values)


def _scale_age_axis(axes: Axes, values_ms: Array) -> None:
    """Scales the age axis to fit all values, shape (K,). NaN values are ignored."""
    known = values_ms[np.isfinite(values_ms)]
    if needs_log_axis(known):
        least_ms = float(known[known > 0.0].min())
        axes.set(yscale="log", ylim=(0.7 * least_ms, 2.0 * float(known.max())))
        style.set_plain_log_axis(axes.yaxis, (1.0, 3.0))
    else:
        axes.set_ylim(0.0, 1.25 * max(float(known.max(initial=0.0)), 1.0))


def _list_sender_entries(log: Log) -> list[tuple[str, dict[str, Any]]]:
    """Returns the legend entries for the senders of samples."""
    return [
        (f"from {style.site_title(log, site)}", style.site_line(log, site, 1.8))
        for site in log.sites
    ]


def explain_missing_loop_times(log: Log) -> str:
    """Returns the reason why a log has no figures of control loop timing.

    Control loop timing consists of how late each tick started and how long it took. These times
    are only measured in runs that are executed in real time.

    Args:
        log: Log of the run.

    Returns:
        The reason. Empty if at least one site has timing data.
    """
    for site in log.sites:
        records = log[site]
        has_times = np.any(records.late_us) or np.any(records.busy_us)
        if has_times:
            return ""
    return NO_LOOP_CLOCK if log.driver == "virtual" else NO_LOOP_TIMES


class LoopTimeBins(NamedTuple):
    """Histogram bins for the lateness and the computing time of control loops.

    The bins have equal widths on a logarithmic axis.

    Attributes:
        edges_us: Bin edges in us, shape (B + 1,).
    """

    edges_us: Array

    @classmethod
    def of_log(cls, log: Log) -> "LoopTimeBins":
        """Chooses bins from 1 us to just above the longest time in a log.

        Args:
            log: Log of the run.
        """
        largest_us = 0
        for site in log.sites:
            for times_us in (log[site].late_us, log[site].busy_us):
                largest_us = max(largest_us, int(times_us.max(initial=0)))

        decades = np.log10(max(largest_us, 10) * 1.1)
        bin_count = int(np.ceil(decades * _BINS_PER_DECADE))
        exponents = np.arange(bin_count + 1) / _BINS_PER_DECADE
        return cls(np.power(10.0, exponents))

    def count_times(self, times_us: Ints) -> Ints:
        """Counts the times in each bin. Times below 1 us are counted in the first bin.

        Args:
            times_us: Times in us, shape (K,).

        Returns:
            Number of times in each bin, shape (B,).
        """
        counts, _ = np.histogram(np.maximum(times_us, 1), self.edges_us)
        return counts.astype(np.int64)


@draws(
    "loop_timing",
    "lateness and computing time of the loops",
    explain_missing_loop_times,
    in_report=True,
)
def _draw_loop_timing(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws histograms of how late the control loops started their ticks, in us.

    Further histograms show how long the computation of a tick took.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    bins = LoopTimeBins.of_log(log)
    labels = ("wake-up after the deadline", "computing time of a tick")
    if form.narrow:
        labels = ("lateness", "computing time")
    row_in = 1.3 if form.narrow else 1.05
    with style.styled_figure(form, 0.6 + row_in * len(log.sites)) as figure:
        grid = style.add_panels(figure, len(log.sites), 2, sharex=True, sharey=True)
        for site, (late_axes, busy_axes) in zip(log.sites, grid, strict=True):
            records = log[site]
            colour = style.site_colour(log, site)
            period_us = 1e6 / log.scenario.sites[site].rate_hz

            for axes, times_us in ((late_axes, records.late_us), (busy_axes, records.busy_us)):
                _draw_histogram(axes, times_us, bins, colour)
                axes.axvline(period_us, **style.LIMIT_LINE)
                _title_histogram(axes, site, times_us, form)
            late_axes.set_ylabel("ticks (count)")

        # Counts are drawn on a logarithmic axis. It begins just below a single tick.
        grid[0, 0].set_ylim(bottom=0.7)
        for axes, label in zip(grid[-1], labels, strict=True):
            axes.set_xlabel(f"{label} (µs)")
        style.add_legend(figure, [("one period", style.LIMIT_LINE)])
    return figure


def _draw_histogram(axes: Axes, times_us: Ints, bins: LoopTimeBins, colour: str) -> None:
    """Draws the histogram of times on logarithmic axes."""
    axes.set(xscale="log", yscale="log")
    counts = bins.count_times(times_us)
    axes.stairs(counts, bins.edges_us, baseline=0.5, fill=True, color=colour)


def _title_histogram(axes: Axes, site: str, times_us: Ints, form: FigureSize) -> None:
    """Adds a title with the site and percentiles of its times, shape (K,), to a histogram."""
    if not len(times_us):
        style.annotate_empty_panel(axes, f"no times of {site}")
        return
    percentiles = np.percentile(times_us, (50.0, 99.0, 100.0))
    p50, p99, largest = (f"{value_us:.0f}" for value_us in percentiles)
    separator = "\n" if form.narrow else " "
    title = f"{site}: p50 {p50}, p99 {p99},{separator}max {largest} µs"
    axes.set_title(title, loc="left", pad=2.0)

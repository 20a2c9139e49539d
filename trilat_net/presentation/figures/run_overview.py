"""Draws an overview of one run, or compares several runs, in four panels over time.

The panels show the largest tracking error, the largest joint speed, the largest torque, and the
age of the oldest sample in use.

Invariant:
    - In the figure of a single run, each line is an arm.
    - In the figure of several runs, each line is a run and shows the largest value across all
      arms at each time.
"""

import textwrap
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import Timeline, certify_run, settling_time_of_all_s, site_signals
from ...core import Array
from ...errors import UsageError
from ...log import Log
from .. import plot_signals, style
from ..appearance import REPORT_SIZE, SITE_COLOURS, FigureSize
from .compared_runs import label_runs
from .figure_entry import draws

_HEIGHT_IN = 3.9
_NARROW_HEIGHT_IN = 5.6
_DECADES = 6.0
"""Number of decades on the error axis. Errors below this range are far below the limit for
settled sites.
"""
_LETTERS_PER_IN = 15.0
"""Average number of title letters per inch."""
_MAX_SPANS = 1_000
"""Maximum number of time spans for which the largest value of all sites is computed."""


class _Panel(NamedTuple):
    """One panel of the overview of a run, which shows one quantity of every arm.

    Attributes:
        name: Name of the quantity.
        find_unit: Function that returns the unit of the quantity in a log. The unit of errors
            depends on the scenario.
        compute: Function that returns the quantity at the K records of a site, shape (K,).
        log_scale: True for a logarithmic value axis.
    """

    name: str
    find_unit: Callable[[Log], str]
    compute: Callable[[Log, str], Array]
    log_scale: bool = False


def _compute_largest_error(log: Log, site: str) -> Array:
    """Returns the largest error of any joint or task axis in each record, shape (K,)."""
    return site_signals.largest_magnitude(log[site].e)


def _compute_largest_speed(log: Log, site: str) -> Array:
    """Returns the largest speed of any joint in each record, shape (K,), in rad/s."""
    return site_signals.largest_magnitude(log[site].qd)


def _compute_largest_torque(log: Log, site: str) -> Array:
    """Returns the controller's largest torque at any joint, shape (K,), in N m."""
    return site_signals.largest_magnitude(log[site].tau)


def _compute_oldest_sample_ms(log: Log, site: str) -> Array:
    """Returns the age of the oldest peer sample in use at each record of a site, in ms.

    The result has shape (K,). It is NaN while no sample was in use.
    """
    ages_ms = plot_signals.sample_ages_ms(log, site)
    # NumPy prints a warning for a row of NaN only. Therefore -inf stands for unknown ages.
    known_ms = np.where(np.isnan(ages_ms), -np.inf, ages_ms)
    oldest_ms: Array = known_ms.max(axis=1, initial=-np.inf)
    return np.where(np.isfinite(oldest_ms), oldest_ms, np.nan)


_PANELS = (
    _Panel("largest error", plot_signals.shared_unit, _compute_largest_error, log_scale=True),
    _Panel("largest speed", lambda _: "rad/s", _compute_largest_speed),
    _Panel("largest torque", lambda _: "N m", _compute_largest_torque),
    _Panel("oldest sample", lambda _: "ms", _compute_oldest_sample_ms),
)


@draws("overview", "errors, speeds, torques and ages of a run at a glance")
def draw_overview(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the most important quantities of a run in four panels, with one line per arm.

    The title contains the stability verdict and the settling time.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    height_in = _NARROW_HEIGHT_IN if form.narrow else _HEIGHT_IN
    with style.time_figure(log, form, height_in) as plot:
        panels = _add_panels(plot.figure, log, form)
        for panel, axes in zip(_PANELS, panels, strict=True):
            values_by_site = {site: panel.compute(log, site) for site in log.sites}
            _scale_axis(axes, panel, list(values_by_site.values()))
            for site, values in values_by_site.items():
                plot.trace(axes, site, _select_drawable(panel, values))
            plot.mark(axes, log.sites)

        plot.finish(
            _list_lowest(panels, form),
            style.site_legend_entries(log, log.sites),
            title=_compose_title(log, form),
        )
    return plot.figure


def _compose_title(log: Log, form: FigureSize) -> str:
    """Returns the title of a run: its name, stability and settling time."""
    settling_times_s = [site_signals.settling_time_s(log[site]) for site in log.sites]
    settled_s = settling_time_of_all_s(settling_times_s)
    settling = "no settling time" if settled_s is None else f"settling time {settled_s:.1f} s"
    name = log.scenario.title or log.scenario.name
    certificate = certify_run(log, own_laws=log.may_run_user_laws)
    title = f"{name}: {certificate.stability}, {settling}"
    letters = round(_LETTERS_PER_IN * form.width_in)
    return "\n".join(textwrap.wrap(title, letters))


def draw_overlay(logs: Mapping[str, Log], form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws several runs in one figure for comparison.

    The figure has the same four panels as the overview of a run, with one line per run. The
    legend lists the settings in which the runs differ.

    Args:
        logs: Mapping from the legend name of each run to its log.
        form: Width, font sizes and resolution of the figure.

    Raises:
        UsageError: No log is given, or the errors of the runs have different units.
    """
    units = {plot_signals.shared_unit(log) for log in logs.values()}
    if not units:
        raise UsageError("there is no run to draw")
    if len(units) > 1:
        raise UsageError(
            "only runs with errors in the same unit can be drawn over one another; "
            f"these have errors in {' and '.join(sorted(units))}"
        )

    height_in = _NARROW_HEIGHT_IN if form.narrow else _HEIGHT_IN
    with style.styled_figure(form, height_in) as figure:
        first_log = next(iter(logs.values()))
        panels = _add_panels(figure, first_log, form)
        line_styles = {name: _style_run(number) for number, name in enumerate(logs)}
        end_s = max(Timeline(log).end_s for log in logs.values())
        for panel, axes in zip(_PANELS, panels, strict=True):
            envelopes = {name: _compute_envelope(panel, log) for name, log in logs.items()}
            _scale_axis(axes, panel, [values for _, values in envelopes.values()])
            for name, (t_s, values) in envelopes.items():
                axes.plot(t_s, _select_drawable(panel, values), **line_styles[name])
            axes.set_xlim(0.0, end_s)

        for axes in _list_lowest(panels, form):
            axes.set_xlabel("time (s)")
        labels = label_runs(logs, form)
        entries = [(labels[name], line_style) for name, line_style in line_styles.items()]
        style.add_legend(figure, entries)
    return figure


def _add_panels(figure: Figure, log: Log, form: FigureSize) -> list[Axes]:
    """Adds the four labelled panels to a figure, two side by side unless it is narrow."""
    rows = 4 if form.narrow else 2
    columns = len(_PANELS) // rows
    grid = style.add_panels(figure, rows, columns, sharex=True)
    panels: list[Axes] = [*grid.flat]
    for panel, axes in zip(_PANELS, panels, strict=True):
        name = panel.name.replace(" ", "\n") if form.narrow else panel.name
        axes.set_ylabel(f"{name} ({panel.find_unit(log)})")
    return panels


def _list_lowest(panels: list[Axes], form: FigureSize) -> list[Axes]:
    """Returns the bottom panel of each column, which gets the time axis."""
    return panels[3:] if form.narrow else panels[2:]


def _style_run(number: int) -> dict[str, Any]:
    """Returns the colour and dash pattern of the line for one of several runs.

    Lines are solid until every colour has been used. Further runs reuse the colours with
    dashes.
    """
    repetition = number // len(SITE_COLOURS)
    return {
        "color": SITE_COLOURS[number % len(SITE_COLOURS)],
        "linestyle": style.DASHES[repetition % len(style.DASHES)],
        "linewidth": 1.2,
    }


def _compute_envelope(panel: _Panel, log: Log) -> tuple[Array, Array]:
    """Returns the largest value across all arms of a run over time, as a single curve.

    The time axis is divided into equal spans with one point each. With one curve per run,
    several runs can be compared in one panel.

    Returns:
        Centres of the spans in s, and largest values, each of shape (S,). The value of a span
        without records is NaN.
    """
    # Spans are so long that each has at least two records of every site on average.
    record_counts = [len(log[site]) for site in log.sites]
    span_count = max(1, min(_MAX_SPANS, min(record_counts) // 2))
    edges_s = np.linspace(0.0, Timeline(log).end_s, span_count + 1)
    largest = np.full(span_count, np.nan)
    for site in log.sites:
        last_edges = np.searchsorted(edges_s, log[site].t_s, side="right") - 1
        span_indices = np.clip(last_edges, 0, span_count - 1)
        np.fmax.at(largest, span_indices, panel.compute(log, site))
    middles_s = 0.5 * (edges_s[1:] + edges_s[:-1])
    return middles_s, largest


def _select_drawable(panel: _Panel, values: Array) -> Array:
    """Returns the values that a panel can show. On a logarithmic axis, zeros become NaN."""
    return style.positive(values) if panel.log_scale else values


def _scale_axis(axes: Axes, panel: _Panel, columns: list[Array]) -> None:
    """Scales the value axis of a panel to fit all of its lines.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        panel: Quantity of the panel.
        columns: Values of each line. NaN values are ignored.
    """
    known_values = np.concatenate([values[np.isfinite(values)] for values in columns])
    largest = float(known_values.max(initial=0.0))
    if not panel.log_scale:
        top = 1.08 * largest if largest > 0.0 else 1.0
        axes.set_ylim(0.0, top)
    elif largest > 0.0:
        smallest = float(known_values[known_values > 0.0].min())
        lowest = max(smallest, largest * 10.0**-_DECADES)
        axes.set(yscale="log", ylim=(0.7 * lowest, 1.5 * largest))

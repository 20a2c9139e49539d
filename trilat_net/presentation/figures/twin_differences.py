"""Draws how a small disturbance of a run grows or decays over time.

Twins are repetitions of the run with a small push at some time. The upper panel shows the
differences in joint velocity between each twin and the run on a logarithmic axis, on which
exponential growth is a straight line. The slope of the dashed line next to them is the growth
rate given in the headline. The lower panel shows the joint speeds of the run itself.

Invariant:
    - The differences are drawn as measured.
    - The dashed line covers the time interval over which its rate was fitted.
    - The line of a twin is interrupted where the twin was pushed again because its difference
      had decayed to rounding errors.
"""

import textwrap
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ...analysis import SMALLEST, EnvelopeTrend, PushedTwins, PushGrowth, RunEnd, TwinGrowth
from ...core import BUCKETS_PER_S, Array
from ...execution import FusedRun
from ...log import Log
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws

_POINTS = 150
"""Approximate number of points on a line. Each is the largest value around its time."""
_SEVERAL_JOINTS_COLOUR = "#7a7a7a"
"""Colour of pushes that move several joints."""
_ESTIMATES_COLOUR = "#999933"
"""Colour of pushes that change parameter estimates instead of velocities."""
_MOST_LOG = 700.0
"""Logarithm at which a line is cut off. The exponential of a larger number might overflow."""
_ROUNDING: dict[str, Any] = {
    "color": style.FAINT,
    "alpha": 0.18,
    "linewidth": 0.0,
    "zorder": 0.3,
}
_PAPER = {
    "boxstyle": "square,pad=0.1",
    "facecolor": "white",
    "edgecolor": "none",
    "alpha": 0.75,
}
_NOTE: dict[str, Any] = {
    "textcoords": "offset points",
    "color": style.REFERENCE,
    "bbox": _PAPER,
}


class _DifferenceLine(NamedTuple):
    """A line that shows the difference between a run and its repetition with a small push.

    If the line rises, small pushes grow, and the run is not stable.

    Attributes:
        label: Label of the line in the legend.
        t_s: Times of the plotted values, in s, shape (K,).
        leg_starts: Indices of the values at which the repetition (twin) was pushed.
        is_rated: True if the growth rate of the twin is drawn.
        log_amplitude: Logarithm of the plotted amplitude in rad/s over time, for one joint or
            for all joints, shape (K,).
        options: Colour, width and dash pattern of the line.
    """

    label: str
    t_s: Array
    leg_starts: tuple[int, ...]
    is_rated: bool
    log_amplitude: Array
    options: dict[str, Any]


def draw_twins(pushed: PushedTwins, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws how the effects of small pushes grow or decay in repetitions of a run.

    Each repetition (twin) is identical to the run except for a small push. The upper panel
    shows the differences in joint velocity between the twins and the run, in rad/s, with one
    line per push, or one line per joint if there was only one push. The lower panel shows the
    joint speeds of the run. If there are no twins, the figure shows the reason. The title is a
    sentence about the effects of the pushes, see `PushedTwins.headline`.

    Args:
        pushed: The run and its twins.
        form: Width, font sizes and resolution of the figure.
    """
    growth = pushed.growth
    if growth.twins is None or growth.worst is None:
        return style.empty_figure(growth.text, form)

    height_in = 5.4 if form.narrow else 4.4
    title_width = 62 if form.narrow else 110  # characters per line
    with style.time_figure(pushed.log, form, height_in) as plot:
        panels = style.add_panels(plot.figure, 2, 1, sharex=True, height_ratios=(4.0, 1.0))
        upper_panel, lower_panel = panels[:, 0]
        # The growth rate is drawn for the push that the title is about. If pushes of several
        # sizes were tried, the title is about all of them, and the first push is chosen.
        has_several_sizes = pushed.linear is not None
        rated_push = growth.pushes[0] if has_several_sizes else growth.worst
        lines = list(_list_lines(pushed, rated_push))
        _draw_differences(upper_panel, pushed, lines, rated_push)
        _limit_differences(upper_panel, form)
        _mark_push(upper_panel, pushed.at_s, form)

        # The time axis begins a little before the push, so that its line is visible.
        margin_s = 0.08 * (growth.to_s - pushed.at_s)
        from_s = max(0.0, pushed.at_s - margin_s)
        _draw_speeds(lower_panel, pushed, from_s)

        plot.mark(upper_panel, pushed.log.sites)
        legend_entries = [(line.label, line.options) for line in lines]
        title = textwrap.fill(pushed.headline(), title_width)
        plot.finish([lower_panel], legend_entries, title=style.typeset(title))
        lower_panel.set_xlim(from_s, growth.to_s)
    return plot.figure


def _explain_absent_twins(log: Log) -> str:
    """Returns the reason why a log has no twins. Empty if it has twins."""
    return FusedRun.explain_not_repeatable(log, own_laws=log.may_run_user_laws)


@draws("twins", "growth or decay of small pushes", _explain_absent_twins, in_report=True)
def _draw_log_twins(log: Log, form: FigureSize) -> Figure:
    """Draws the differences of twins that are pushed at the start of a log's run."""
    own_laws = log.may_run_user_laws
    growth = TwinGrowth.of_log(log, RunEnd.of_log(log), own_laws=own_laws)
    return draw_twins(PushedTwins(log, 0.0, growth), form)


def _list_lines(pushed: PushedTwins, rated: PushGrowth) -> Iterator[_DifferenceLine]:
    """Yields the lines of the panel that shows the differences between twins and their run.

    - If pushes of several sizes were tried in order to find those that act linearly, each size
      has one line, from light to dark.
    - Several pushes have one line each. The push of a single joint has the style of that joint.
    - A single push has one line per joint that it moved.

    Args:
        pushed: The run and its pushed twins. There is at least one twin.
        rated: Growth of the push whose rate is drawn.
    """
    twins = pushed.growth.twins
    assert twins is not None
    joint_styles = _style_joints(pushed.log, twins.joints)
    shades = colormaps["viridis"](np.linspace(0.9, 0.0, len(twins.paths)))
    has_several_sizes = pushed.linear is not None
    log_amplitudes = []
    if has_several_sizes or len(twins.paths) > 1:
        log_amplitudes = pushed.measure_amplitudes(range(len(twins.joints)))
    for number, path in enumerate(twins.paths):
        # The name of a push is for example "1e-06 rad at m1 joint 1", "1e-06 rad at all joints"
        # or "1e-06 of all estimates". Only a push of joints has a target after "at".
        size, _, pushed_joints = path.push.name.partition(" at ")
        make_line = partial(
            _DifferenceLine,
            t_s=path.t_s,
            leg_starts=path.pushed,
            is_rated=path.push is rated.push,
        )
        if has_several_sizes:
            shade = {"color": tuple(shades[number]), "linewidth": 1.3}
            yield make_line(label=size, log_amplitude=log_amplitudes[number], options=shade)
        elif len(twins.paths) > 1:
            style_without_joint = {
                "color": _SEVERAL_JOINTS_COLOUR if pushed_joints else _ESTIMATES_COLOUR,
                "linewidth": 1.0,
                "linestyle": style.DASHES[number % len(style.DASHES)],
            }
            options = joint_styles.get(pushed_joints, style_without_joint)
            yield make_line(
                label=path.push.name, log_amplitude=log_amplitudes[number], options=options
            )
        else:
            for joint, name in enumerate(twins.joints):
                # The logarithm of the difference is -inf while the joint has not moved.
                has_moved = np.isfinite(path.largest[:, joint]).any()
                if has_moved:
                    (log_amplitude,) = pushed.measure_amplitudes([joint])
                    yield make_line(
                        label=name, log_amplitude=log_amplitude, options=joint_styles[name]
                    )


def _style_joints(log: Log, joints: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Returns the line style of each joint: the colour of its arm, and dashes for its number.

    Args:
        log: Log with the arms.
        joints: Names of joints such as "m1 joint 2".
    """
    styles = {}
    for name in joints:
        site, _, joint_number = name.partition(" joint ")
        pattern = (int(joint_number) - 1) % len(style.DASHES)
        dashes = style.DASHES[pattern]
        styles[name] = {**style.site_line(log, site), "linestyle": dashes}
    return styles


def _draw_differences(
    axes: Axes, pushed: PushedTwins, lines: Sequence[_DifferenceLine], rated: PushGrowth
) -> None:
    """Draws the differences between a run and its slightly pushed repetitions over time.

    The growth rate of one push is drawn next to its lines.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        pushed: A run and its pushed twins.
        lines: Lines of the differences.
        rated: Growth of the push whose rate is drawn. At least one line belongs to this push.
    """
    growth = pushed.growth
    drawn_s = growth.to_s - pushed.at_s
    # A twin has `BUCKETS_PER_S` values per second. They are grouped so that a line has about
    # `_POINTS` points.
    intervals_per_point = max(1, int(drawn_s * BUCKETS_PER_S / _POINTS))
    axes.set_yscale("log")
    rated_traces = []  # times and values of the lines of the rated push
    for line in lines:
        t_s, values = _trace_amplitude(line, growth.to_s, intervals_per_point)
        axes.plot(t_s, values, **line.options)
        if line.is_rated:
            rated_traces.append((t_s, values))

    # A push has one line, or one per joint. All of them belong to one twin, and therefore have
    # the same times.
    rated_t_s, _ = rated_traces[0]
    envelope = np.fmax.reduce([values for _, values in rated_traces])
    _draw_rate(axes, pushed, rated, rated_t_s, envelope)


def _trace_amplitude(line: _DifferenceLine, to_s: float, step: int) -> tuple[Array, Array]:
    """Computes the points of a line that shows the difference between a run and its twin.

    The difference is known in intervals of 50 ms, and each point shows the largest difference
    of several intervals. After a difference has decayed to rounding errors, the twin is pushed
    again. The line is interrupted between the legs from one push to the next.

    The computation uses logarithms, because exponentially growing differences may exceed the
    range of floating-point numbers.

    Args:
        line: The line.
        to_s: End of the line, in s.
        step: Number of intervals per point.

    Returns:
        Times in s and amplitudes in rad/s, each of shape (K,). An amplitude is NaN, which
        interrupts the line, at the end of each leg and where the difference is 0.
    """
    log_amplitude = line.log_amplitude
    end = int(np.searchsorted(line.t_s, to_s))
    end = max(end, line.leg_starts[-1] + 1)  # the last leg has at least one interval
    t_s = np.zeros(0)
    log_peaks = np.zeros(0)
    for leg_start, leg_end in pairwise([*line.leg_starts, end]):
        # Each point of the line covers `step` intervals, and is drawn in the middle of them.
        starts = np.arange(leg_start, leg_end, step)
        middles = np.minimum(starts + step // 2, leg_end - 1)
        group_peaks = np.maximum.reduceat(log_amplitude[:leg_end], starts)
        t_s = np.r_[t_s, line.t_s[middles], np.nan]
        log_peaks = np.r_[log_peaks, group_peaks, -np.inf]
    # Larger logarithms would overflow.
    amplitudes = np.exp(np.minimum(log_peaks, _MOST_LOG))
    return t_s, np.where(np.isfinite(log_peaks), amplitudes, np.nan)


def _draw_rate(
    axes: Axes, pushed: PushedTwins, rated: PushGrowth, t_s: Array, values: Array
) -> None:
    """Draws a dashed line with the growth rate of a push, just above the differences.

    The rate is written next to the line. Nothing is drawn if the push has no rate or no clear
    trend.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        pushed: A run and its pushed twins.
        rated: Growth of the push.
        t_s: Times of the differences, in s, shape (K,).
        values: Largest differences of all joints, in rad/s, shape (K,).
    """
    if not np.isfinite(rated.rate_per_s) or rated.trend is EnvelopeTrend.UNDECIDED:
        return

    from_s = pushed.growth.from_s
    to_s = pushed.growth.to_s
    if rated.ended_s is not None:
        # The rate of a twin that ended early was fitted to the second half of its time.
        from_s = 0.5 * (pushed.at_s + rated.ended_s)
        to_s = rated.ended_s
    is_drawn = (t_s >= from_s) & (t_s <= to_s) & (values > 0.0)
    if not is_drawn.any():
        return

    line_t_s = t_s[is_drawn]
    # The lowest line with this slope that stays 15 % above all values.
    log_offsets = np.log(1.15 * values[is_drawn]) - rated.rate_per_s * line_t_s
    log_offset = float(np.max(log_offsets))
    line = np.exp(np.minimum(log_offset + rated.rate_per_s * line_t_s, _MOST_LOG))
    options = {**style.LIMIT_LINE, "linewidth": 1.0, "zorder": 4.0}
    axes.plot(line_t_s, line, **options)

    label = f"{rated.rate_per_s:+.3g} /s".replace("-", "\N{MINUS SIGN}")
    middle = len(line_t_s) // 2
    falls = rated.rate_per_s < 0.0
    axes.annotate(
        label,
        xy=(line_t_s[middle], line[middle]),
        xytext=(0.0, 3.0),
        ha="left" if falls else "right",
        **_NOTE,
    )


def _limit_differences(axes: Axes, form: FigureSize) -> None:
    """Labels the logarithmic axis of the differences and sets its limits.

    Differences below `SMALLEST` consist of rounding errors. If any difference comes close to
    this value, the axis starts one decade below it, and this decade is shaded. The axis spans
    at least a factor of 30, so that slow growth does not look fast.

    Args:
        axes: Panel of the figure, as Matplotlib axes, with the lines already drawn.
        form: Width, font sizes and resolution of the figure.
    """
    axes.set_ylabel("difference of velocities (rad/s)")
    low, high = axes.get_ylim()
    is_near_rounding = low < 10.0 * SMALLEST
    if is_near_rounding:
        low = SMALLEST / 10.0
        axes.axhspan(low, SMALLEST, **_ROUNDING)
        axes.annotate(
            "rounding",
            xy=(0.0, SMALLEST),
            xycoords=axes.get_yaxis_transform(),
            xytext=(3.0, -9.0),  # in points: inside the shaded decade, at its left end
            fontsize=form.small_pt,
            **_NOTE,
        )
    axes.set_ylim(min(low, high / 30.0), high)
    axes.yaxis.set_minor_formatter(NullFormatter())


def _mark_push(axes: Axes, at_s: float, form: FigureSize) -> None:
    """Marks the time of the pushes with a vertical line."""
    axes.axvline(at_s, color=style.REFERENCE, linewidth=0.8)
    axes.annotate(
        "push",
        xy=(at_s, 1.0),
        xycoords=axes.get_xaxis_transform(),
        xytext=(3.0, -8.0),
        fontsize=form.small_pt,
        **_NOTE,
    )


def _draw_speeds(axes: Axes, pushed: PushedTwins, from_s: float) -> None:
    """Draws the speed of the fastest joint of every arm, in rad/s.

    The time axis is the same as that of the differences in the panel above.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        pushed: A run and its pushed twins, which also contain the speeds of the run.
        from_s: Start of the time axis, in s.
    """
    log = pushed.log
    twins = pushed.growth.twins
    assert twins is not None
    t_s = twins.paths[0].t_s
    first = 0
    for site in log.sites:
        # The columns of the speeds are the joints of all sites, one site after the other.
        end = first + log.scenario.layout(site).joints
        speed = twins.speed[:, first:end].max(axis=1)
        axes.plot(t_s, speed, **{**style.site_line(log, site, 0.9), "alpha": 0.6})
        first = end
    largest = float(twins.speed[t_s >= from_s].max(initial=0.0))
    axes.set_ylim(0.0, 1.1 * largest or 1.0)
    axes.set_ylabel("run (rad/s)")

"""The difference between a run and its pushed twins over time, above the speed of the run
itself.

Invariant: what is drawn is measured; the dashed line is the rate that the words state, over the
part that it was fitted to. A twin that was pushed anew begins a new line.
"""

import textwrap
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ...analysis.envelope_trend import EnvelopeTrend
from ...analysis.run_end import classify_log_end
from ...analysis.twin_growth import (
    MOST_LOG,
    PushedTwins,
    PushGrowth,
    measure_amplitude,
    measure_twins,
)
from ...core.ticks import BUCKETS_PER_S
from ...core.vectors import Array
from ...execution.fused import explain_not_repeatable
from ...execution.twins import SMALLEST, TwinPath
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws

_POINTS = 150
"""Of a line, about: each is the largest of the time around it."""
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
_WORDS: dict[str, Any] = {
    "textcoords": "offset points",
    "color": style.REFERENCE,
    "bbox": _PAPER,
}
_Line = tuple[str, TwinPath, list[int], dict[str, Any]]
"""Name, twin, joints, and how it is drawn."""


def draw_twins(found: PushedTwins, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the differences of velocities, rad/s, a line per push, or per joint of a single
    push.

    Twins of which there are none give a figure with the reason.
    """
    log = found.log
    growth = found.growth
    twins = found.growth.twins
    worst = found.growth.worst
    if twins is None or worst is None:
        return style.empty_figure(growth.text, form)
    with style.time_figure(log, form, 5.4 if form.narrow else 4.4) as plot:
        above, below = style.add_panels(
            plot.figure, 2, 1, sharex=True, height_ratios=(4.0, 1.0)
        )[:, 0]
        lines = list(_list_lines(found))
        step = max(1, int((growth.to_s - found.at_s) * BUCKETS_PER_S / _POINTS))
        drawn = [_trace(path, joints, growth.to_s, step) for _, path, joints, _ in lines]
        above.set_yscale("log")
        for (_, _, _, line), (t_s, values) in zip(lines, drawn, strict=True):
            above.plot(t_s, values, **line)
        shown = worst if found.linear is None else growth.pushes[0]
        own = [
            one
            for (_, path, _, _), one in zip(lines, drawn, strict=True)
            if path.push is shown.push
        ]
        _draw_rate(
            axes=above,
            found=found,
            one=shown,
            t_s=own[0][0],
            values=np.fmax.reduce([values for _, values in own]),
        )
        _mark(above, found, form)
        place = 0
        from_s = max(0.0, found.at_s - 0.08 * (growth.to_s - found.at_s))
        t_s = twins.paths[0].t_s
        for site in log.sites:
            speed = twins.speed[
                :, place : (place := place + log.scenario.layout(site).joints)
            ].max(axis=1)
            below.plot(t_s, speed, **{**style.site_line(log, site, 0.9), "alpha": 0.6})
        below.set_ylim(0.0, 1.1 * float(twins.speed[t_s >= from_s].max(initial=0.0)) or 1.0)
        below.set_ylabel("run (rad/s)")
        plot.mark(above, log.sites)
        words = textwrap.fill(found.headline(), 62 if form.narrow else 110)
        plot.finish(
            [below], [(name, line) for name, _, _, line in lines], title=style.typeset(words)
        )
        below.set_xlim(from_s, growth.to_s)
    return plot.figure


draws(
    "twins", "what became of small pushes of the run", explain_not_repeatable, in_report=True
)(
    lambda log, form: draw_twins(
        PushedTwins(log, 0.0, measure_twins(log, classify_log_end(log))), form
    )
)


def _list_lines(found: PushedTwins) -> Iterator[_Line]:
    twins = found.growth.twins
    assert twins is not None
    paths = twins.paths
    every = list(range(len(twins.joints)))
    styles = {}  # of each joint: the colour of its site, and dashes
    for name in twins.joints:
        site, _, number = name.partition(" joint ")
        dashes = style.DASHES[(int(number) - 1) % len(style.DASHES)]
        styles[name] = {**style.site_line(found.log, site), "linestyle": dashes}
    shades = colormaps["viridis"](np.linspace(0.9, 0.0, len(paths)))
    for n, path in enumerate(paths):
        what, _, where = path.push.name.partition(" at ")
        dashes = style.DASHES[n % len(style.DASHES)]
        if found.linear is not None:
            yield what, path, every, {"color": tuple(shades[n]), "linewidth": 1.3}
        elif len(paths) > 1:
            other = {
                "color": "#7a7a7a" if where else "#999933",
                "linewidth": 1.0,
                "linestyle": dashes,
            }
            yield path.push.name, path, every, styles.get(where, other)
        else:
            moved = [joint for joint in every if np.isfinite(path.largest[:, joint]).any()]
            yield from ((twins.joints[j], path, [j], styles[twins.joints[j]]) for j in moved)


def _trace(path: TwinPath, joints: list[int], to_s: float, step: int) -> tuple[Array, Array]:
    amplitude = measure_amplitude(path, joints)
    end = int(np.searchsorted(path.t_s, to_s))
    t_s = np.zeros(0)
    values = np.zeros(0)
    for first, last in pairwise([*path.pushed, max(end, path.pushed[-1] + 1)]):
        starts = np.arange(first, last, step)
        t_s = np.r_[t_s, path.t_s[np.minimum(starts + step // 2, last - 1)], np.nan]
        values = np.r_[values, np.maximum.reduceat(amplitude[:last], starts), -np.inf]
    return t_s, np.where(np.isfinite(values), np.exp(np.minimum(values, MOST_LOG)), np.nan)


def _draw_rate(
    axes: Axes, found: PushedTwins, one: PushGrowth, t_s: Array, values: Array
) -> None:
    end_s = found.growth.to_s if one.ended_s is None else one.ended_s
    from_s = found.growth.from_s if one.ended_s is None else 0.5 * (found.at_s + end_s)
    rows = (t_s >= from_s) & (t_s <= end_s) & (values > 0.0)
    if (
        not rows.any()
        or not np.isfinite(one.rate_per_s)
        or one.trend is EnvelopeTrend.UNDECIDED
    ):
        return
    t_s = t_s[rows]
    falls = one.rate_per_s < 0.0
    level = float(np.max(np.log(1.15 * values[rows]) - one.rate_per_s * t_s))
    line = np.exp(np.minimum(level + one.rate_per_s * t_s, MOST_LOG))
    axes.plot(t_s, line, **{**style.LIMIT_LINE, "linewidth": 1.0, "zorder": 4.0})
    words = f"{one.rate_per_s:+.3g} /s".replace("-", "\u2212")
    at = len(t_s) // 2
    axes.annotate(
        words, (t_s[at], line[at]), (0.0, 3.0), ha="left" if falls else "right", **_WORDS
    )


def _mark(axes: Axes, found: PushedTwins, form: FigureSize) -> None:
    """Names the axis, marks the push, and shades what is rounding, if a line comes near it."""
    axes.set_ylabel("difference of velocities (rad/s)")
    low, high = axes.get_ylim()
    if low < 10.0 * SMALLEST:
        low = SMALLEST / 10.0
        top = (0.0, SMALLEST)
        axes.axhspan(low, SMALLEST, **_ROUNDING)
        axes.annotate(
            "rounding",
            top,
            (3.0, -9.0),
            axes.get_yaxis_transform(),
            fontsize=form.small_pt,
            **_WORDS,
        )
    axes.set_ylim(min(low, high / 30.0), high)
    axes.yaxis.set_minor_formatter(NullFormatter())
    top = (found.at_s, 1.0)
    axes.axvline(found.at_s, color=style.REFERENCE, linewidth=0.8)
    axes.annotate(
        "push", top, (3.0, -8.0), axes.get_xaxis_transform(), fontsize=form.small_pt, **_WORDS
    )

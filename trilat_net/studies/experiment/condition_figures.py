"""Figures of a measure under the conditions of an experiment with people.

Invariant:
    - Each participant is drawn: a point for each condition with data, joined by a thin line.
    - Means with their intervals are drawn on top.
    - Equal rows give equal bytes.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...fields import split_unit
from ...reporting import style
from ...reporting.appearance import COLUMN_IN, SITE_COLOURS, make_print_size
from .completion_times import COMPLETION, find_median, find_unit_medians, summarise_times
from .statistics import ConditionMean, Row, average_trials, summarise_conditions

_FORM = make_print_size(COLUMN_IN)
_HEIGHT_IN = 2.6
_USER: dict[str, Any] = {
    "color": style.FAINT,
    "linewidth": 0.5,
    "marker": "o",
    "markersize": 2.5,
}
_COURSE: dict[str, Any] = {"linewidth": 1.2, "marker": "o", "markersize": 3.0}
_MEAN: dict[str, Any] = {
    "color": SITE_COLOURS[0],
    "linewidth": 1.6,
    "marker": "D",
    "markersize": 5.0,
}
_LIMIT: dict[str, Any] = {"color": style.FAINT, "linewidth": 1.0, "linestyle": "--"}


def draw_conditions(rows: Sequence[Row], measure: str, *, unit: str = "participant") -> Figure:
    """Returns the figure of a measure by condition.

    The figure shows the mean of each unit, and the mean over units with its 95 % interval.

    Args:
        rows: tidy rows, as for `statistics`.
        measure: name of the measure in the rows.
        unit: "participant" or "pair".
    """
    means = {
        condition: means_by_unit
        for condition, means_by_unit in average_trials(rows, measure, unit).items()
        if means_by_unit
    }
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, measure)
        for columns, values in _list_unit_lines(means):
            axes.plot(columns, values, **_USER)
        for column, mean in enumerate(summarise_conditions(rows, measure, unit=unit)):
            _plot_interval(axes, column, mean, {**_MEAN, "marker": "_", "zorder": 3})
            axes.plot([column], [mean.mean], zorder=3, **_MEAN)
        _label_conditions(axes, means)
        style.add_legend(figure, [(f"a {unit}", _USER), ("mean, 95 % interval", _MEAN)])
    return figure


def draw_times(rows: Sequence[Row], limit_s: float, *, unit: str = "participant") -> Figure:
    """Returns the figure of completion times by condition, if some exceed the time limit.

    The points are the medians of each unit. An open marker on the line of the limit is a median
    that was not reached.

    Args:
        rows: tidy rows, as for `completion_times`.
        limit_s: time limit of a trial, s.
        unit: "participant" or "pair".
    """
    medians = find_unit_medians(rows, unit)
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, COMPLETION)
        axes.axhline(limit_s, **_LIMIT)
        for columns, times_s in _list_unit_lines(medians):
            axes.plot(columns, [min(time_s, limit_s) for time_s in times_s], **_USER)
            _plot_censored(
                axes=axes, positions=columns, times_s=times_s, limit_s=limit_s, look=_USER
            )
        for column, time in enumerate(summarise_times(rows, limit_s, unit=unit)):
            low, high = time.interval or (None, None)
            if low is not None:
                ends = [low, limit_s if high is None else high]
                axes.plot([column, column], ends, **{**_MEAN, "marker": "_"})
            median_s = math.inf if time.median is None else time.median
            drawn_s = limit_s if time.median is None else time.median
            axes.plot([column], [drawn_s], zorder=3, **_MEAN)
            _plot_censored(
                axes=axes, positions=[column], times_s=[median_s], limit_s=limit_s, look=_MEAN
            )
        _label_conditions(axes, medians)
        legend = [
            (f"a {unit}'s median", _USER),
            ("median, 95 % interval", _MEAN),
            ("time limit; open: not reached", _LIMIT),
        ]
        style.add_legend(figure, legend)
    return figure


def _list_unit_lines(
    values: Mapping[str, Mapping[str, float]],
) -> Iterator[tuple[list[int], list[float]]]:
    """Yields for each unit the columns of its conditions and its values there.

    Args:
        values: a value for each condition and unit.
    """
    values_by_column = list(values.values())
    units = dict.fromkeys(chain.from_iterable(values_by_column))
    for unit in units:
        columns = [column for column, by_unit in enumerate(values_by_column) if unit in by_unit]
        yield columns, [values_by_column[column][unit] for column in columns]


def _label_conditions(axes: Axes, values: Mapping[str, Mapping[str, float]]) -> None:
    """Labels the horizontal axis with the conditions and their numbers of units."""
    labels = [f"{condition}\nn = {len(by_unit)}" for condition, by_unit in values.items()]
    axes.set_xticks(range(len(values)), labels)
    axes.set_xlim(-0.4, len(values) - 0.6)


def _plot_censored(
    axes: Axes,
    positions: Sequence[float],
    times_s: Sequence[float],
    limit_s: float,
    look: dict[str, Any],
) -> None:
    """Draws an open marker on the line of the limit for each time that is infinite."""
    longer = [
        position
        for position, time_s in zip(positions, times_s, strict=True)
        if math.isinf(time_s)
    ]
    marker = {
        "marker": look["marker"],
        "markersize": look["markersize"] + 1.0,
        "linestyle": "none",
    }
    colours = {"markerfacecolor": "white", "markeredgecolor": look["color"]}
    axes.plot(longer, [limit_s] * len(longer), zorder=4, **marker, **colours)


def draw_learning(
    rows: Sequence[Row],
    measure: str,
    *,
    unit: str = "participant",
    limit_s: float | None = None,
) -> Figure:
    """Returns the figure of a measure over the trials of a block, with a line per condition.

    Args:
        rows: tidy rows, as for `statistics`, with the number of each `trial` in its block.
        measure: name of the measure in the rows.
        unit: "participant" or "pair".
        limit_s: time limit of a trial, s, if some completion times exceed it. The figure then
            shows medians, and open markers on the line of the limit for medians that were not
            reached.
    """
    if limit_s is not None:
        return _draw_learning_times(rows, limit_s, unit)
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, measure)
        legend = []
        for index, condition in enumerate(dict.fromkeys(row["condition"] for row in rows)):
            look = {**_COURSE, "color": SITE_COLOURS[index % len(SITE_COLOURS)]}
            means = {}
            for trial, trial_rows in _group_by_trial(rows, condition).items():
                for mean in summarise_conditions(trial_rows, measure, unit=unit):
                    means[trial] = mean
            for trial, mean in means.items():
                _plot_interval(axes, trial, mean, {**look, "marker": "", "alpha": 0.5})
            axes.plot(list(means), [mean.mean for mean in means.values()], **look)
            legend.append((condition, look))
        axes.set_xlabel("trial of the block")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        style.add_legend(figure, legend)
    return figure


def _group_by_trial(rows: Sequence[Row], condition: str) -> dict[Any, list[Row]]:
    """Returns the rows of a condition by the number of the trial, in ascending order."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        if row["condition"] == condition:
            groups.setdefault(row["trial"], []).append(row)
    return dict(sorted(groups.items()))


def _draw_learning_times(rows: Sequence[Row], limit_s: float, unit: str) -> Figure:
    """Returns the figure of completion times over the trials, if some exceed the time limit."""
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, COMPLETION)
        legend = []
        axes.axhline(limit_s, **_LIMIT)
        for index, condition in enumerate(dict.fromkeys(row["condition"] for row in rows)):
            look = {**_COURSE, "color": SITE_COLOURS[index % len(SITE_COLOURS)]}
            rows_by_trial = _group_by_trial(rows, condition)
            trials = list(rows_by_trial)
            times_s = []
            for trial_rows in rows_by_trial.values():
                medians = find_unit_medians(trial_rows, unit)[condition]
                times_s.append(find_median(list(medians.values())))
            axes.plot(trials, [min(time_s, limit_s) for time_s in times_s], **look)
            _plot_censored(
                axes=axes, positions=trials, times_s=times_s, limit_s=limit_s, look=look
            )
            legend.append((condition, look))
        axes.set_xlabel("trial of the block")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        style.add_legend(figure, [*legend, ("time limit; open: not reached", _LIMIT)])
    return figure


def _add_panel(figure: Figure, measure: str) -> Axes:
    """Adds the only panel of a figure, labelled with a measure and its unit."""
    axes: Axes = style.add_panels(figure, 1, 1)[0, 0]
    axes.set_ylabel(", ".join(filter(None, split_unit(measure))))
    return axes


def _plot_interval(
    axes: Axes, position: float, mean: ConditionMean, look: dict[str, Any]
) -> None:
    """Draws the vertical line of an interval; without an interval, a point at the mean."""
    axes.plot([position, position], mean.interval or (mean.mean, mean.mean), **look)

"""Figures that compare a measure between the conditions of an experiment with people.

`draw_conditions` shows a measure by condition, and `draw_learning` shows it over the trials of
a block. If some trials were not completed in time, their completion time is only known to
exceed the limit, so there is no mean, and `draw_times` shows medians instead.

Invariant:
    - Each participant is drawn as one point per condition with data, joined by a thin line.
    - Means and their intervals are drawn on top.
    - Equal rows give byte-identical figures.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from trilat_net.fields import split_unit
from trilat_net.presentation import COLUMN_IN, SITE_COLOURS, FigureSize, style

from .completion_times import COMPLETION, find_median, find_unit_medians, summarise_times
from .statistics import ConditionMean, Row, average_trials, summarise_conditions

Look = dict[str, Any]
"""Matplotlib options for a line and its markers."""

_FORM = FigureSize.for_print(COLUMN_IN)
_HEIGHT_IN = 2.6
_USER: Look = {
    "color": style.FAINT,
    "linewidth": 0.5,
    "marker": "o",
    "markersize": 2.5,
}
_COURSE: Look = {"linewidth": 1.2, "marker": "o", "markersize": 3.0}
_MEAN: Look = {
    "color": SITE_COLOURS[0],
    "linewidth": 1.6,
    "marker": "D",
    "markersize": 5.0,
}
_LIMIT: Look = {"color": style.FAINT, "linewidth": 1.0, "linestyle": "--"}


def draw_conditions(rows: Sequence[Row], measure: str, *, unit: str = "participant") -> Figure:
    """Plots one measure of an experiment, such as the completion time, by condition.

    Shows the mean of each participant (or pair of participants), and the overall mean with its
    95 % confidence interval.

    Args:
        rows: One row per trial, as for `statistics`.
        measure: Name of the measure in the rows.
        unit: Unit over which trials are averaged first, "participant" or "pair".
    """
    all_means = average_trials(rows, measure, unit)
    means = {condition: by_unit for condition, by_unit in all_means.items() if by_unit}
    interval_style = {**_MEAN, "marker": "_", "zorder": 3}
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, measure)

        for columns, values in _list_unit_lines(means):
            axes.plot(columns, values, **_USER)

        summaries = summarise_conditions(rows, measure, unit=unit)
        for column, summary in enumerate(summaries):
            _plot_interval(axes, column, summary, interval_style)
            axes.plot([column], [summary.mean], zorder=3, **_MEAN)
        _label_conditions(axes, means)

        legend = [
            (f"a {unit}", _USER),
            ("mean, 95 % interval", _MEAN),
        ]
        style.add_legend(figure, legend)
    return figure


def draw_times(rows: Sequence[Row], limit_s: float, *, unit: str = "participant") -> Figure:
    """Plots the completion times under each condition, for trials with a time limit.

    Points are the medians of each participant or pair. An open marker on the line of the time
    limit represents a median beyond the limit.

    Args:
        rows: One row per trial, as for `completion_times`.
        limit_s: Time limit of a trial, in s.
        unit: Unit over which medians are taken first, "participant" or "pair".
    """
    medians = find_unit_medians(rows, unit)
    interval_style = {**_MEAN, "marker": "_"}
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, COMPLETION)
        axes.axhline(limit_s, **_LIMIT)
        for columns, times_s in _list_unit_lines(medians):
            _plot_times(axes, columns, times_s, limit_s, _USER)
        summaries = summarise_times(rows, limit_s, unit=unit)
        for column, summary in enumerate(summaries):
            low_s, high_s = summary.interval or (None, None)
            if low_s is not None:
                # An interval without an upper end is drawn up to the limit.
                end_s = limit_s if high_s is None else high_s
                axes.plot([column, column], [low_s, end_s], **interval_style)

            median_s = summary.median
            beyond_limit: list[float] = []
            if median_s is None:
                median_s = limit_s
                beyond_limit.append(column)
            axes.plot([column], [median_s], zorder=3, **_MEAN)
            _mark_beyond_limit(axes, beyond_limit, limit_s, _MEAN)

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
    """Yields the points of each participant or pair, which the figure joins with a thin line.

    Args:
        values: Value by condition and unit. Each condition is a column of the figure.

    Yields:
        Indices of the columns, and their values. Conditions with no value are skipped.
    """
    all_units = chain.from_iterable(values.values())
    for unit in dict.fromkeys(all_units):
        columns: list[int] = []
        values_of_unit: list[float] = []
        for column, values_by_unit in enumerate(values.values()):
            if unit in values_by_unit:
                columns.append(column)
                values_of_unit.append(values_by_unit[unit])
        yield columns, values_of_unit


def _label_conditions(axes: Axes, values: Mapping[str, Mapping[str, float]]) -> None:
    """Labels the x axis with each condition and its number of participants or pairs.

    Args:
        axes: The panel.
        values: Values by condition and then by participant or pair.
    """
    labels: list[str] = []
    for condition, values_by_unit in values.items():
        unit_count = len(values_by_unit)
        labels.append(f"{condition}\nn = {unit_count}")
    condition_count = len(values)
    axes.set_xticks(range(condition_count), labels)
    axes.set_xlim(-0.4, condition_count - 0.6)


def _plot_times(
    axes: Axes,
    positions: Sequence[float],
    times_s: Sequence[float],
    limit_s: float,
    look: Look,
) -> None:
    """Plots completion times as a line, with an open marker for each time beyond the limit.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        positions: Positions along the x axis.
        times_s: The times, in s; infinite if beyond the limit.
        limit_s: Time limit of a trial, in s.
        look: Options of the line and its markers.
    """
    limited_s = [min(time_s, limit_s) for time_s in times_s]
    axes.plot(positions, limited_s, **look)

    beyond_limit: list[float] = []
    for position, time_s in zip(positions, times_s, strict=True):
        is_beyond_limit = math.isinf(time_s)
        if is_beyond_limit:
            beyond_limit.append(position)
    _mark_beyond_limit(axes, beyond_limit, limit_s, look)


def _mark_beyond_limit(
    axes: Axes, positions: Sequence[float], limit_s: float, look: Look
) -> None:
    """Draws open markers on the line of the time limit, for medians that were not reached.

    Args:
        axes: The panel.
        positions: Positions of the markers along the x axis.
        limit_s: Time limit of a trial, in s.
        look: Plot options of the condition, which determine the shape and colour of the
            markers.
    """
    open_marker: Look = {
        "marker": look["marker"],
        "markersize": look["markersize"] + 1.0,
        "linestyle": "none",
        "markerfacecolor": "white",
        "markeredgecolor": look["color"],
    }
    heights_s = [limit_s] * len(positions)
    axes.plot(positions, heights_s, zorder=4, **open_marker)


def draw_learning(
    rows: Sequence[Row],
    measure: str,
    *,
    unit: str = "participant",
    limit_s: float | None = None,
) -> Figure:
    """Plots how a measure changes over the trials of a block, with one line per condition.

    Args:
        rows: One row per trial, as for `statistics`, including `trial`, the position of the
            trial in its block.
        measure: Name of the measure in the rows.
        unit: Unit over which trials are averaged first, "participant" or "pair".
        limit_s: Time limit of a trial, in s, if some trials were not completed. Medians are
            then plotted, and medians above the limit appear as open markers on the limit line.
            `None` to plot means.
    """
    if limit_s is not None:
        return _draw_learning_times(rows, limit_s, unit)

    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, measure)
        styles_by_condition = _assign_looks(rows)
        for condition, look in styles_by_condition.items():
            summaries: dict[Any, ConditionMean] = {}
            for trial, trial_rows in _group_by_trial(rows, condition).items():
                # The rows of one condition have one mean, or no mean without data.
                for summary in summarise_conditions(trial_rows, measure, unit=unit):
                    summaries[trial] = summary
            interval_style = {**look, "marker": "", "alpha": 0.5}
            for trial, summary in summaries.items():
                _plot_interval(axes, trial, summary, interval_style)
            trials = list(summaries)
            means = [summary.mean for summary in summaries.values()]
            axes.plot(trials, means, **look)
        _label_trials(axes)
        style.add_legend(figure, list(styles_by_condition.items()))
    return figure


def _assign_looks(rows: Sequence[Row]) -> dict[str, Look]:
    """Returns a mapping from condition to the plot options of its line, such as the colour.

    Colours are assigned in the order in which conditions appear in the rows, and are reused
    once exhausted.
    """
    conditions = dict.fromkeys(row["condition"] for row in rows)
    looks: dict[str, Look] = {}
    for index, condition in enumerate(conditions):
        colour = SITE_COLOURS[index % len(SITE_COLOURS)]
        looks[condition] = {**_COURSE, "color": colour}
    return looks


def _label_trials(axes: Axes) -> None:
    """Labels the x axis with trial numbers."""
    axes.set_xlabel("trial of the block")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _group_by_trial(rows: Sequence[Row], condition: str) -> dict[Any, list[Row]]:
    """Groups the rows of a condition by trial number in the block, in ascending order."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        if row["condition"] == condition:
            group = groups.setdefault(row["trial"], [])
            group.append(row)
    return dict(sorted(groups.items()))


def _draw_learning_times(rows: Sequence[Row], limit_s: float, unit: str) -> Figure:
    """Plots how the median completion time changes over the trials of a block.

    Used when some trials were not completed within the time limit, so that means do not exist.
    A median beyond the limit is drawn as an open marker on the line of the limit.

    Args:
        rows: Rows of the trials.
        limit_s: Time limit of a trial, in s.
        unit: "participant" or "pair".
    """
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, COMPLETION)
        axes.axhline(limit_s, **_LIMIT)

        styles_by_condition = _assign_looks(rows)
        for condition, look in styles_by_condition.items():
            trials: list[Any] = []
            medians_s: list[float] = []
            for trial, trial_rows in _group_by_trial(rows, condition).items():
                medians_by_condition = find_unit_medians(trial_rows, unit)
                unit_medians_s = list(medians_by_condition[condition].values())
                median_s = find_median(unit_medians_s)
                trials.append(trial)
                medians_s.append(median_s)

            _plot_times(axes, trials, medians_s, limit_s, look)
        _label_trials(axes)
        legend = [*styles_by_condition.items(), ("time limit; open: not reached", _LIMIT)]
        style.add_legend(figure, legend)
    return figure


def _add_panel(figure: Figure, measure: str) -> Axes:
    """Adds the only panel of a figure, with a y axis for one measure.

    The unit is taken from the end of the measure's name: "path_m" is labelled "path, m".
    """
    panels = style.add_panels(figure, 1, 1)
    axes: Axes = panels[0, 0]
    name, unit = split_unit(measure)
    label = f"{name}, {unit}" if unit else name
    axes.set_ylabel(label)
    return axes


def _plot_interval(axes: Axes, position: float, mean: ConditionMean, look: Look) -> None:
    """Draws a confidence interval as a vertical line, or a point if there is no interval.

    Args:
        axes: The panel.
        position: Position of the condition along the x axis.
        mean: Mean of the condition. With a single participant, there is no interval.
        look: Plot options.
    """
    ends = mean.interval or (mean.mean, mean.mean)
    axes.plot([position, position], ends, **look)

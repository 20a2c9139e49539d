"""The figure of a measure under the conditions of an experiment with people.

Invariant: every participant is shown, a point per condition that they have, joined by a thin
line; means with their intervals stand on top. Equal rows give equal bytes.
"""

import math
from collections.abc import Sequence
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
    """Returns the figure of a measure: the mean of every unit and condition, and means with 95
    % intervals.

    Args:
        rows: tidy rows, as of `statistics`.
        measure: its name in the rows.
        unit: "participant" or "pair".
    """
    means = {name: each for name, each in average_trials(rows, measure, unit).items() if each}
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, measure)
        for one in dict.fromkeys(u for each in means.values() for u in each):
            places = [n for n, each in enumerate(means.values()) if one in each]
            axes.plot(places, [list(means.values())[n][one] for n in places], **_USER)
        for n, mean in enumerate(summarise_conditions(rows, measure, unit=unit)):
            _plot_interval(axes, n, mean, {**_MEAN, "marker": "_", "zorder": 3})
            axes.plot([n], [mean.mean], zorder=3, **_MEAN)
        axes.set_xticks(
            range(len(means)), [f"{name}\nn = {len(each)}" for name, each in means.items()]
        )
        axes.set_xlim(-0.4, len(means) - 0.6)
        style.add_legend(figure, [(f"a {unit}", _USER), ("mean, 95 % interval", _MEAN)])
    return figure


def draw_times(rows: Sequence[Row], limit_s: float, *, unit: str = "participant") -> Figure:
    """Returns the figure of completion times of which some are longer than the limit.

    Points are the medians of every unit and condition; open ones on the line of the limit were
    not reached.

    Args:
        rows: as of `completion_times`.
        limit_s: after which a trial was ended.
        unit: "participant" or "pair".
    """
    medians = find_unit_medians(rows, unit)
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, COMPLETION)
        axes.axhline(limit_s, **_LIMIT)
        for one in dict.fromkeys(who for each in medians.values() for who in each):
            places = [n for n, each in enumerate(medians.values()) if one in each]
            times_s = [list(medians.values())[n][one] for n in places]
            axes.plot(places, [min(time_s, limit_s) for time_s in times_s], **_USER)
            _plot_censored(
                axes=axes, places=places, times_s=times_s, limit_s=limit_s, look=_USER
            )
        for n, time in enumerate(summarise_times(rows, limit_s, unit=unit)):
            low, high = time.interval or (None, None)
            if low is not None:
                axes.plot(
                    [n, n], [low, limit_s if high is None else high], **{**_MEAN, "marker": "_"}
                )
            axes.plot([n], [limit_s if time.median is None else time.median], zorder=3, **_MEAN)
            _plot_censored(
                axes=axes,
                places=[n],
                times_s=[math.inf if time.median is None else time.median],
                limit_s=limit_s,
                look=_MEAN,
            )
        labels = [f"{name}\nn = {len(each)}" for name, each in medians.items()]
        axes.set_xticks(range(len(medians)), labels)
        axes.set_xlim(-0.4, len(medians) - 0.6)
        shown = [
            (f"a {unit}'s median", _USER),
            ("median, 95 % interval", _MEAN),
            ("time limit; open: not reached", _LIMIT),
        ]
        style.add_legend(figure, shown)
    return figure


def _plot_censored(
    axes: Axes,
    places: Sequence[float],
    times_s: Sequence[float],
    limit_s: float,
    look: dict[str, Any],
) -> None:
    """Draws an open marker on the limit for every time that is longer."""
    longer = [
        place for place, time_s in zip(places, times_s, strict=True) if math.isinf(time_s)
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
    """Returns the course of a measure over the trials of a block, a line for each condition.

    Args:
        rows: tidy rows, as of `statistics`, with the number of each `trial` in its block.
        measure: its name in the rows.
        unit: "participant" or "pair".
        limit_s: given of completion times of which some are longer: then medians are drawn, and
            open markers on the line of the limit were not reached.
    """
    if limit_s is not None:
        return _draw_learning_times(rows, limit_s, unit)
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, measure)
        shown = []
        for n, condition in enumerate(dict.fromkeys(row["condition"] for row in rows)):
            look = {**_COURSE, "color": SITE_COLOURS[n % len(SITE_COLOURS)]}
            by_trial: dict[Any, list[Row]] = {}
            for row in rows:
                if row["condition"] == condition:
                    by_trial.setdefault(row["trial"], []).append(row)
            found = {
                trial: mean
                for trial, own in sorted(by_trial.items())
                for mean in summarise_conditions(own, measure, unit=unit)
            }
            for trial, mean in found.items():
                _plot_interval(axes, trial, mean, {**look, "marker": "", "alpha": 0.5})
            axes.plot(list(found), [mean.mean for mean in found.values()], **look)
            shown.append((condition, look))
        axes.set_xlabel("trial of the block")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        style.add_legend(figure, shown)
    return figure


def _draw_learning_times(rows: Sequence[Row], limit_s: float, unit: str) -> Figure:
    """Returns the course of completion times of which some are longer than the limit."""
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes = _add_panel(figure, COMPLETION)
        shown = []
        axes.axhline(limit_s, **_LIMIT)
        for n, condition in enumerate(dict.fromkeys(row["condition"] for row in rows)):
            look = {**_COURSE, "color": SITE_COLOURS[n % len(SITE_COLOURS)]}
            by_trial: dict[Any, list[Row]] = {}
            for row in rows:
                if row["condition"] == condition:
                    by_trial.setdefault(row["trial"], []).append(row)
            trials = sorted(by_trial)
            units = [find_unit_medians(by_trial[trial], unit)[condition] for trial in trials]
            times_s = [find_median(list(each.values())) for each in units]
            axes.plot(trials, [min(time_s, limit_s) for time_s in times_s], **look)
            _plot_censored(
                axes=axes, places=trials, times_s=times_s, limit_s=limit_s, look=look
            )
            shown.append((condition, look))
        axes.set_xlabel("trial of the block")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        style.add_legend(figure, [*shown, ("time limit; open: not reached", _LIMIT)])
    return figure


def _add_panel(figure: Figure, measure: str) -> Axes:
    axes: Axes = style.add_panels(figure, 1, 1)[0, 0]
    axes.set_ylabel(", ".join(filter(None, split_unit(measure))))
    return axes


def _plot_interval(axes: Axes, at: float, mean: ConditionMean, look: dict[str, Any]) -> None:
    axes.plot([at, at], mean.interval or (mean.mean, mean.mean), **look)

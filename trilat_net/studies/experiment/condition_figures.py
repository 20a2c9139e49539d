"""The figure of a measure under the conditions of an experiment with people.

Invariant: every participant is shown, a point per condition that they have, joined by a thin line; means with
their intervals stand on top. Equal rows give equal bytes.
"""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...fields import split_unit
from ...reporting import style
from ...reporting.appearance import COLUMN_IN, SITE_COLOURS, make_print_size
from .statistics import ConditionMean, Row, average_trials, summarise_conditions

_FORM, _HEIGHT_IN = make_print_size(COLUMN_IN), 2.6
_USER: dict[str, Any] = {"color": style.FAINT, "linewidth": 0.5, "marker": "o", "markersize": 2.5}
_COURSE: dict[str, Any] = {"linewidth": 1.2, "marker": "o", "markersize": 3.0}
_MEAN: dict[str, Any] = {"color": SITE_COLOURS[0], "linewidth": 1.6, "marker": "D", "markersize": 5.0}


def draw_conditions(rows: Sequence[Row], measure: str, *, unit: str = "participant") -> Figure:
    """Returns the figure of a measure: the mean of every unit and condition, and means with 95 % intervals.

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
        axes.set_xticks(range(len(means)), [f"{name}\nn = {len(each)}" for name, each in means.items()])
        axes.set_xlim(-0.4, len(means) - 0.6)
        style.add_legend(figure, [(f"a {unit}", _USER), ("mean, 95 % interval", _MEAN)])
    return figure


def draw_learning(rows: Sequence[Row], measure: str, *, unit: str = "participant") -> Figure:
    """Returns the course of a measure over the trials of a block, a line for each condition.

    Args:
        rows: tidy rows, as of `statistics`, with the number of each `trial` in its block.
        measure: its name in the rows.
        unit: "participant" or "pair".
    """
    with style.styled_figure(_FORM, _HEIGHT_IN) as figure:
        axes, shown = _add_panel(figure, measure), []
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
        style.add_legend(figure, shown)
    return figure


def _add_panel(figure: Figure, measure: str) -> Axes:
    axes: Axes = style.add_panels(figure, 1, 1)[0, 0]
    axes.set_ylabel(", ".join(filter(None, split_unit(measure))))
    return axes


def _plot_interval(axes: Axes, at: float, mean: ConditionMean, look: dict[str, Any]) -> None:
    axes.plot([at, at], mean.interval or (mean.mean, mean.mean), **look)

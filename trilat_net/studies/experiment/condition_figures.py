"""The figure of a measure under the conditions of an experiment with people.

Invariant: every participant is shown, a point per condition that they have, joined by a thin line; means with
their intervals stand on top. Equal rows give equal bytes.
"""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from ...reporting import style
from ...reporting.appearance import SITE_COLOURS, FigureSize, make_print_size
from .statistics import Row, average_trials, summarise_conditions

_HEIGHT_IN = 2.6
_USER: dict[str, Any] = {"color": style.FAINT, "linewidth": 0.5, "marker": "o", "markersize": 2.5}
_MEAN: dict[str, Any] = {"color": SITE_COLOURS[0], "linewidth": 1.6, "marker": "D", "markersize": 5.0}


def draw_conditions(
    rows: Sequence[Row],
    measure: str,
    *,
    unit: str = "participant",
    label: str = "",
    size: FigureSize | None = None,
) -> Figure:
    """Returns the figure of a measure: the mean of every unit and condition, and means with 95 % intervals.

    Args:
        rows: tidy rows, as of `statistics`.
        measure: its name in the rows.
        unit: "participant" or "pair".
        label: of the axis, with the unit of the numbers; "" for the name of the measure.
        size: of the figure; None for one column of a paper.
    """
    means = {name: each for name, each in average_trials(rows, measure, unit).items() if each}
    form = make_print_size(3.5) if size is None else size
    with style.styled_figure(form, _HEIGHT_IN) as figure:
        axes = style.add_panels(figure, 1, 1)[0, 0]
        for one in dict.fromkeys(u for each in means.values() for u in each):
            places = [n for n, each in enumerate(means.values()) if one in each]
            axes.plot(places, [list(means.values())[n][one] for n in places], **_USER)
        for n, mean in enumerate(summarise_conditions(rows, measure, unit=unit)):
            low, high = mean.interval or (mean.mean, mean.mean)
            axes.plot([n, n], [low, high], zorder=3, **{**_MEAN, "marker": "_"})
            axes.plot([n], [mean.mean], zorder=3, **_MEAN)
        axes.set_xticks(range(len(means)), [f"{name}\nn = {len(each)}" for name, each in means.items()])
        axes.set_xlim(-0.4, len(means) - 0.6)
        axes.set_ylabel(label or measure)
        style.add_legend(figure, [(f"a {unit}", _USER), ("mean, 95 % interval", _MEAN)])
    return figure


def draw_learning(
    rows: Sequence[Row], measure: str, *, unit: str = "participant", size: FigureSize | None = None
) -> Figure:
    """Returns the course of a measure over the trials of a block, a line for each condition.

    Args:
        rows: tidy rows, as of `statistics`, with the number of each `trial` in its block.
        measure: its name in the rows.
        unit: "participant" or "pair".
        size: of the figure; None for one column of a paper.
    """
    form = make_print_size(3.5) if size is None else size
    with style.styled_figure(form, _HEIGHT_IN) as figure:
        axes, shown = style.add_panels(figure, 1, 1)[0, 0], []
        for n, condition in enumerate(dict.fromkeys(row["condition"] for row in rows)):
            own = [row for row in rows if row["condition"] == condition]
            found = [
                (trial, mean)
                for trial in sorted({row["trial"] for row in own})
                for mean in summarise_conditions(
                    [row for row in own if row["trial"] == trial], measure, unit=unit
                )
            ]
            look = {
                "color": SITE_COLOURS[n % len(SITE_COLOURS)],
                "linewidth": 1.2,
                "marker": "o",
                "markersize": 3.0,
            }
            for trial, mean in found:
                low, high = mean.interval or (mean.mean, mean.mean)
                axes.plot([trial, trial], [low, high], **{**look, "marker": "", "alpha": 0.5})
            axes.plot([trial for trial, _ in found], [mean.mean for _, mean in found], **look)
            shown.append((condition, look))
        axes.set_xlabel("trial of the block")
        axes.set_ylabel(measure)
        style.add_legend(figure, shown)
    return figure

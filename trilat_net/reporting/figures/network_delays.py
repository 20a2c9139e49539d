"""The benchmark of a network as a figure: one-way delays by size, rate and transport, and what bounds them.

Invariant: every case that was measured is in it, from its median to its largest value; a case that lost
samples is marked.
"""

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...theory.delay_margin import MAX_COMMON_DELAY_S
from .. import style
from ..figure_size import REPORT_SIZE
from ..palette import SITE_COLOURS

_HEIGHT_IN = 3.2
_MARKS = ("o", "s", "^", "v")
_LOST: Any = {"marker": "x", "color": "#cc3311", "linestyle": "none", "markersize": 5.0}


def draw_network_delays(facts: Mapping[str, Any]) -> Figure:
    """Returns the figure of a benchmark's values, see `NetworkBenchmark.to_dict`."""
    rows, needs = facts["rows"], facts["needs"]
    cases = list(dict.fromkeys((row["bytes"], row["rate_hz"]) for row in rows))
    transports = list(dict.fromkeys(row["transport"] for row in rows))
    with style.styled_figure(REPORT_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        for row in rows:
            number = transports.index(row["transport"])
            at = cases.index((row["bytes"], row["rate_hz"])) + 0.22 * (number - (len(transports) - 1) / 2)
            _plot_case(axes, at, row, number)
        _plot_bounds(axes, facts)
        axes.set_yscale("log")
        labels = [f"{size} B\n{rate:g} Hz" for size, rate in cases]
        own = cases.index((needs["sample_bytes"], needs["rate_hz"]))
        axes.axvspan(own - 0.45, own + 0.45, color=style.FAINT, alpha=0.15, linewidth=0.0, zorder=0.3)
        labels[own] += f"\n{facts['scenario']}"
        axes.set_xticks(range(len(cases)), labels)
        axes.set(xlim=(-0.5, len(cases) - 0.5), ylabel="one way: p50, p99, largest (ms)")
        axes.grid(visible=False, axis="x")
        handles = [
            Line2D([], [], label=name, color=SITE_COLOURS[n], marker=_MARKS[n % 4], linewidth=1.1)
            for n, name in enumerate(transports)
        ]
        lost = [Line2D([], [], label="lost some", **_LOST)] if any(row["lost"] for row in rows) else []
        style.place_legend(figure, [*handles, *lost])
    return figure


def _plot_case(axes: Axes, at: float, row: Mapping[str, Any], number: int) -> None:
    times = row["one_way_us"]
    if times is not None:
        p50, p99, most = (times[key] / 1e3 for key in ("p50", "p99", "max"))
        colour = SITE_COLOURS[number % len(SITE_COLOURS)]
        axes.plot([at, at], [p50, most], color=colour, linewidth=0.8)
        axes.plot([at, at], [p50, p99], color=colour, linewidth=2.6, solid_capstyle="butt")
        axes.plot([at], [p50], marker=_MARKS[number % 4], color=colour, markersize=4.5)
        axes.plot([at], [most], marker="_", color=colour, markersize=6.0)
    if row["lost"]:
        axes.plot([at], [0.04], transform=axes.get_xaxis_transform(), **_LOST)


def _plot_bounds(axes: Axes, facts: Mapping[str, Any]) -> None:
    """Draws the period, for how long samples are held, and the ends of stability, with words beside them."""
    needs = facts["needs"]
    bounds = [("one period", 1e3 / needs["rate_hz"], "center"), ("held by links", needs["held_ms"], "top")]
    ages = [one["age_ms"] for one in facts["transports"] if one["age_ms"] is not None]
    for low, high in needs["stable_ms"] or []:
        if any(low <= age <= high for age in ages) or [low, high] == needs["stable_ms"][0]:
            bounds.append((f"stable from {low:.4g} ms", low, "top"))
            shown = high if high < 1e3 * MAX_COMMON_DELAY_S else 0.0
            bounds.append((f"stable up to {high:.4g} ms", shown, "bottom"))
    for label, at, where in bounds:
        if at:
            axes.axhline(at, **style.LIMIT_LINE)
            axes.annotate(
                label, (1.01, at), xycoords=("axes fraction", "data"), va=where, fontsize=REPORT_SIZE.tick_pt
            )

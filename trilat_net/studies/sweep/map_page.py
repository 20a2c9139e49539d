"""The figure and the page of a stability map: map.png, map.svg, map.pdf and map.md.

Invariant: the page holds only results, lines and commands, and equal results give equal bytes.
A cell of the figure is coloured by its classes alone: with several seeds by the stable share of
the decided runs, hatched where half or more are undecided; or, judged by twins, by its growth
exponent, white at zero. Cells stay pixels in vector output, since viewers show seams between
touching shapes; the classes differ in lightness for grey print and colour-blind readers.
"""

import math
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FixedFormatter, FixedLocator, MaxNLocator

from ...core.vectors import Array
from ...files import write_whole
from ...reporting import style
from ...reporting.appearance import COLUMN_IN, FigureSize, make_print_size
from ...reporting.result_text import TextTable
from .fixed_gains import FAIR_COMPARISON
from .stability_map import (
    CELL_CLASSES,
    MapLine,
    MapPanel,
    MapPlane,
    PlaneAxis,
    StabilityMap,
    StableInterval,
    find_map_edges,
)
from .sweep_cell import CellClass

CLASS_COLOURS = {
    CellClass.CONVERGED: "#d3e4f3",
    CellClass.BOUNDED: "#e6b84c",
    CellClass.DIVERGED: "#a23b53",
    CellClass.UNDECIDED: "#ffffff",
}
"""Light, middle, dark; undecided is white and hatched."""
_HATCH = "/////"
_HATCHED: Any = {"facecolor": "none", "edgecolor": "#8a8a8a", "linewidth": 0.0, "hatch": _HATCH}
_LINE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#000000", "linestyle": "-", "linewidth": 1.2},
    {"color": "#000000", "linestyle": (0, (4, 1.6)), "linewidth": 1.2},
    {"color": "#ddaa33", "linestyle": "-", "linewidth": 2.6},  # measured, below the others
)
_VERDICT_EDGE: dict[str, Any] = {"color": "#6b6b6b", "linewidth": 1.6, "alpha": 0.6}
_EXPONENTS = LinearSegmentedColormap.from_list(
    "exponents", ["#004488", "#ffffff", "#a23b53"], 257
)
_CLASSES_OF_SHARES = (CellClass.DIVERGED, CellClass.BOUNDED, CellClass.CONVERGED)
_SHARES = LinearSegmentedColormap.from_list(
    "share", [CLASS_COLOURS[one] for one in _CLASSES_OF_SHARES]
)
"""Colours of shares: those of the classes, dark where nothing is stable, and ever lighter."""
_HALO_PT = 2.6
_COUNT_PT = 5.0
_LETTERS_PER_IN = 13
"""Of titles: those of neighbouring panels stay apart."""
_LETTER = 0.62
"""Width of a digit over its size."""
_FULL_IN = 2.3
"""Height of a panel that has a row to itself."""
_BESIDE_IN = 1.75
_STRIP_IN = 0.7
_CAPTION_PT = 5.5
_CAPTION_LINE_IN = 0.1
_CAPTION_LETTERS_PER_IN = 25
_SHARED_LABEL_IN = 0.14


def draw_stability_map(
    plane: MapPlane,
    lines: Sequence[Sequence[MapLine]],
    form: FigureSize,
    fixed: Sequence[str] = (),
) -> Figure:
    """Returns the figure of a plane; `fixed` are the gains that were not swept, a text per law."""
    columns = _columns(len(plane.panels), form)
    rows = -(-len(plane.panels) // columns)
    each_in = _STRIP_IN if not plane.y.key else _FULL_IN if columns == 1 else _BESIDE_IN
    barred = plane.judged_by_twins or plane.seeds > 1
    caption = _wrap_caption(fixed, form)
    height_in = 0.95 + rows * each_in + _CAPTION_LINE_IN * len(caption)
    with style.styled_figure(form, height_in) as figure:
        shared = columns * rows > 1
        low = (
            _write_caption(figure, caption, height_in, shared_label=shared) if caption else None
        )
        grid: list[Any] = list(
            style.add_panels(figure, rows, columns, sharex=True, sharey=True).flat
        )
        for axes in grid[len(plane.panels) :]:
            axes.set_axis_off()
        for axes, panel, drawn in zip(grid, plane.panels, lines, strict=False):
            _draw_panel(axes, plane, panel, drawn)
            letters = round((form.width_in - 0.6 * barred) * _LETTERS_PER_IN / columns)
            broken = len(panel.title) > letters
            axes.set_title(panel.title.replace(", ", ",\n") if broken else panel.title)
        for n, axes in enumerate(grid[: len(plane.panels)]):
            _scale(axes, plane)
            axes.tick_params(labelleft=n % columns == 0 and bool(plane.y.key))
            axes.tick_params(labelbottom=n + columns >= len(plane.panels))
        if not shared:
            grid[0].set_xlabel(plane.x.label)
            grid[0].set_ylabel(plane.y.label)
        else:
            below: Any = {} if low is None else {"y": low, "va": "bottom"}
            figure.supxlabel(plane.x.label, fontsize=8.0, **below)
            figure.supylabel(plane.y.label, fontsize=8.0)
        if barred:
            _draw_scale(figure, grid, plane)
        _draw_legend(figure, plane, lines)
        figure.draw(FigureCanvasAgg(figure).get_renderer())  # type: ignore[no-untyped-call]
        # only now it is known how much room there is
        if plane.seeds > 1 and not plane.judged_by_twins:
            for axes, panel in zip(grid, plane.panels, strict=False):
                _draw_counts(axes, plane, panel)
    return figure


def _wrap_caption(fixed: Sequence[str], form: FigureSize) -> list[str]:
    """Returns the lines of the caption: the gains that were not swept."""
    if not fixed:
        return []
    width = round(_CAPTION_LETTERS_PER_IN * form.width_in)
    texts = [f"not swept: {'; '.join(fixed)}", FAIR_COMPARISON]
    return [line for text in texts for line in textwrap.wrap(text, width)]


def _write_caption(
    figure: Figure, caption: Sequence[str], height_in: float, *, shared_label: bool
) -> float:
    """Writes the caption below the panels, which give way to it; returns where it ends, from 0
    to 1.

    The layout engine moves panels, but no label that they share: with `shared_label` they make
    room for that.
    """
    end = (_CAPTION_LINE_IN * len(caption) + 0.04) / height_in
    share = end + _SHARED_LABEL_IN / height_in * shared_label
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, share, 1.0, 1.0 - share))
    figure.text(
        0.01,
        0.02 / height_in,
        "\n".join(caption),
        va="bottom",
        fontsize=_CAPTION_PT,
        color=style.REFERENCE,
    )
    return end


def _columns(panels: int, form: FigureSize) -> int:
    if panels == 1:
        return 1
    if form.narrow:
        return 2
    return panels if panels <= 3 else 4 if panels in (4, 7, 8) else 3


def _draw_panel(axes: Axes, plane: MapPlane, panel: MapPanel, lines: Sequence[MapLine]) -> None:
    x = _bounds(plane.x)
    y = _bounds(plane.y)
    axes.grid(visible=False)
    axes.set_facecolor("#f4f4f4")  # where nothing has run
    if plane.judged_by_twins:
        limit = _find_exponent_limit(plane)
        shown = np.ma.masked_invalid(panel.exponents_per_s)
        axes.pcolormesh(x, y, shown, cmap=_EXPONENTS, vmin=-limit, vmax=limit, rasterized=True)
        for at, edge in find_map_edges(plane, panel):
            ends = np.interp([edge.low, edge.high], plane.y.values, plane.y.places)
            axes.vlines(np.interp(at, plane.x.values, plane.x.places), *ends, **_VERDICT_EDGE)
    elif plane.seeds > 1:
        shown = np.ma.masked_invalid(panel.share)
        axes.pcolormesh(x, y, shown, cmap=_SHARES, vmin=0.0, vmax=1.0, rasterized=True)
    else:
        classes = np.ma.masked_where(panel.runs == 0, panel.counts.argmax(axis=2))
        norm = BoundaryNorm(np.arange(len(CELL_CLASSES) + 1) - 0.5, len(CELL_CLASSES))
        palette = ListedColormap([CLASS_COLOURS[verdict] for verdict in CELL_CLASSES])
        axes.pcolormesh(x, y, classes, cmap=palette, norm=norm, rasterized=True)
    for i, row in enumerate(_undecided(plane, panel)):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            axes.fill_between([x[start], x[end]], y[i], y[i + 1], zorder=1.5, **_HATCHED)
    for line in lines:
        _draw_line(axes, plane, line)


def _draw_line(axes: Axes, plane: MapPlane, line: MapLine) -> None:
    x, y = (
        np.concatenate([_bounds(one)[:1], one.places, _bounds(one)[-1:]])
        for one in (plane.x, plane.y)
    )
    spare = _extended(_extended(line.spare, y).T, x).T
    # a border at zero is a place itself
    inside = [np.diff(one, append=np.inf) > 0.0 for one in (y, x)]
    shown = np.ma.masked_invalid(spare[np.ix_(*inside)])
    look = _LINE_STYLES[line.rank % len(_LINE_STYLES)]
    drawn = axes.contour(
        x[inside[1]],
        y[inside[0]],
        shown,
        [0.0],
        colors=look["color"],
        linewidths=look["linewidth"],
    )
    halo = [Stroke(linewidth=_HALO_PT, foreground="#ffffff"), Normal()]
    drawn.set(linestyle=look["linestyle"], path_effects=halo)


def _extended(rows: Array, places: Array) -> Array:
    """Returns a field with a row more at either end, of which the places are the first and the
    last.
    """
    before, after = (
        rows[i]
        + (rows[j] - rows[i]) * (places[at] - places[near]) / (places[far] - places[near])
        for i, j, at, near, far in ((0, 1, 0, 1, 2), (-1, -2, -1, -2, -3))
    )
    return np.concatenate([before[np.newaxis], rows, after[np.newaxis]])


def _undecided(plane: MapPlane, panel: MapPanel) -> Any:
    """Returns where half of the runs or more are undecided, or have no exponent, shape (y, x)."""
    if plane.judged_by_twins:
        return (panel.runs > 0) & np.isnan(panel.exponents_per_s)
    return (panel.runs > 0) & (
        2 * panel.counts[:, :, CELL_CLASSES.index(CellClass.UNDECIDED)] >= panel.runs
    )


def _bounds(side: PlaneAxis) -> Array:
    """Returns the borders of the cells of an axis: half way between its values, shape (n + 1,).

    None is below zero unless a value is: there is no delay of -100 ms.
    """
    places = side.places
    if len(places) == 1:
        return np.array([places[0] - 0.5, places[0] + 0.5])
    ends = 1.5 * places[[0, -1]] - 0.5 * places[[1, -2]]
    bounds: Array = np.concatenate([ends[:1], 0.5 * (places[1:] + places[:-1]), ends[1:]])
    return np.maximum(bounds, 0.0) if side.even and places[0] >= 0.0 else bounds


def _scale(axes: Axes, plane: MapPlane) -> None:
    """Gives a panel its ticks: round numbers on an even axis, else every value that there is
    room for.
    """
    x = _bounds(plane.x)
    y = _bounds(plane.y)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    for axis, side in ((axes.xaxis, plane.x), (axes.yaxis, plane.y)):
        if side.even:
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 4, 5, 10]))
        else:
            axis.set_major_locator(FixedLocator(list(side.places)))
            axis.set_major_formatter(FixedFormatter([f"{value:g}" for value in side.values]))
    if not plane.y.key:
        axes.set_yticks([])
    for spine in ("top", "right"):
        axes.spines[spine].set_visible(True)


def _find_exponent_limit(plane: MapPlane) -> float:
    """Returns the exponent of the darkest colours, 1/s, a round number that four fifths are
    below.
    """
    found = np.abs(np.concatenate([panel.exponents_per_s.ravel() for panel in plane.panels]))
    least = max(float(np.nanquantile(found, 0.8)), 1e-6)
    decade = 10.0 ** math.floor(math.log10(least))
    return next(
        step * decade for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= least * (1.0 - 1e-9)
    )


def _draw_scale(figure: Figure, grid: Sequence[Axes], plane: MapPlane) -> None:
    """Draws what the colours of shares or of exponents mean; a pointed end has all beyond it."""
    twins = plane.judged_by_twins
    limit = _find_exponent_limit(plane) if twins else 1.0
    colours = ScalarMappable(cmap=_EXPONENTS if twins else _SHARES)
    colours.set_clim(-limit if twins else 0.0, limit)
    ends = "both" if twins else "neither"
    bar = figure.colorbar(
        colours, ax=list(grid), fraction=0.05, pad=0.02, aspect=30, extend=ends
    )
    if twins:
        bar.set_ticks([-limit, -0.5 * limit, 0.0, 0.5 * limit, limit])
    bar.set_label("growth exponent of a push (1/s)" if twins else "share of stable runs")
    bar.outline.set_linewidth(0.6)


def _draw_counts(axes: Axes, plane: MapPlane, panel: MapPanel) -> None:
    """Writes how many runs were stable, of the decided ones, into places where not all agree:
    if they fit.
    """
    extent = axes.get_window_extent()
    width_pt = 72.0 * extent.width / axes.figure.dpi / len(plane.x.values)
    height_pt = 72.0 * extent.height / axes.figure.dpi / len(plane.y.values)
    stable = panel.stable
    decided = panel.decided
    letters = 2 * len(str(plane.seeds)) + 1
    if width_pt < letters * _LETTER * _COUNT_PT or height_pt < 1.2 * _COUNT_PT:
        return
    for i, j in np.argwhere((stable > 0) & (stable < decided)):
        text = f"{stable[i, j]}/{decided[i, j]}"
        where = plane.x.places[j], plane.y.places[i]
        axes.text(*where, text, ha="center", va="center", fontsize=_COUNT_PT, color="#000000")


def _draw_legend(figure: Figure, plane: MapPlane, lines: Sequence[Sequence[MapLine]]) -> None:
    counts = sum(panel.counts.sum(axis=(0, 1)) for panel in plane.panels)
    handles: list[Any] = []
    if plane.judged_by_twins:
        if any(find_map_edges(plane, panel) for panel in plane.panels):
            handles.append(Line2D([], [], label="edge of the verdicts", **_VERDICT_EDGE))
    elif plane.seeds == 1:
        handles += [
            Patch(
                label=one.value,
                facecolor=CLASS_COLOURS[one],
                edgecolor="#6b6b6b",
                linewidth=0.5,
            )
            for one, count in zip(CELL_CLASSES, counts, strict=True)
            if count and one is not CellClass.UNDECIDED
        ]
    if any(_undecided(plane, panel).any() for panel in plane.panels):
        many = "half or more undecided" if plane.seeds > 1 else CellClass.UNDECIDED.value
        word = "no exponent" if plane.judged_by_twins else many
        handles.append(Patch(label=word, **{**_HATCHED, "linewidth": 0.5}))
    named = {line.label: line for some in lines for line in some}
    handles += [
        Line2D([], [], label=text, **_LINE_STYLES[line.rank % len(_LINE_STYLES)])
        for text, line in named.items()
    ]
    style.place_legend(figure, handles, handlelength=1.6)


_DPI = 300


def write_map(chart: StabilityMap, folder: Path, width_in: float = COLUMN_IN) -> list[Path]:
    """Writes a map into a folder that exists, and returns the paths.

    Raises:
        UsageError: there is no such width.
    """
    form = make_print_size(width_in)
    figure = draw_stability_map(chart.plane, chart.lines, form, chart.fixed)
    paths = [folder / f"map.{suffix}" for suffix in ("png", "svg", "pdf", "md")]
    for path in paths[:-1]:
        style.write_figure(figure, path, _DPI)
    write_whole(paths[-1], build_map_page(chart, paths[0].name))
    return paths


def build_map_page(chart: StabilityMap, picture: str) -> str:
    """Returns the page of a map, as Markdown."""
    parts = [
        f"# {chart.title}",
        "```sh\n" + "\n".join(chart.commands) + "\n```",
        f"![map]({picture})",
    ]
    parts.append(tabulate_classes(chart.plane).markdown())
    meanings = dict.fromkeys(
        f"{line.text}: {line.about}" for lines in chart.lines for line in lines
    )
    fixed = [f"gains that were not swept: {text}" for text in chart.fixed]
    advice = (
        [FAIR_COMPARISON.replace("trilat compare --tune", "`trilat compare --tune`")]
        if fixed
        else []
    )
    if notes := [*meanings, *chart.remarks, *fixed, *advice]:
        parts.append("\n".join(f"- {one}" for one in notes))
    for panel, lines in zip(chart.plane.panels, chart.lines, strict=True):
        table = tabulate_edges(chart.plane, panel, lines)
        if table.rows:
            parts += [f"## {panel.title}"] if panel.title else []
            parts.append(table.markdown())
    return "\n\n".join(parts) + "\n"


def tabulate_classes(plane: MapPlane) -> TextTable:
    """Returns how many runs had which verdict, a row per panel."""
    rows = [
        (panel.title or "all", *(str(int(count)) for count in panel.counts.sum(axis=(0, 1))))
        for panel in plane.panels
    ]
    return TextTable(("runs", *CELL_CLASSES), rows)


def tabulate_edges(plane: MapPlane, panel: MapPanel, lines: Sequence[MapLine]) -> TextTable:
    """Returns the measured edges next to the lines, a row each; none if only one axis was
    swept.

    Judged by twins an edge is where the exponent is zero, next to that of the verdicts. The
    difference is that of a line from the middle of the measured edge; "within" where the line
    lies in the measured edge, as well as its grid can tell.
    """
    measured, theory = (
        [line for line in lines if (line.rank < 0) is own] for own in (True, False)
    )
    heads = [plane.x.label, f"edge of {plane.y.label}", "stable is"]
    heads += ["edge of the verdicts"] * plane.judged_by_twins
    for line in theory:
        heads += [line.text, "difference"]
    rows = []
    verdicts = find_map_edges(plane, panel)
    zeros = [(x, edge) for line in measured for x, edge in _list_crossings(line, plane)]
    for x, edge in zeros if plane.judged_by_twins else verdicts:
        row = [f"{x:g}", _format_edge(edge), "below" if edge.stable_below else "above"]
        if plane.judged_by_twins:
            near = [one for at, one in verdicts if at == x]
            near.sort(key=lambda one, zero=edge.low: abs(one.middle - zero))  # type: ignore[misc]
            row.append(_format_edge(near[0]) if near else "-")
        for line in theory:
            row += _compare_with_line(edge, line.crossings(plane.x.values.index(x), plane.y))
        rows.append(tuple(row))
    return TextTable(tuple(heads), rows)


def _list_crossings(line: MapLine, plane: MapPlane) -> Iterator[tuple[float, StableInterval]]:
    for n, x in enumerate(plane.x.values):
        for value in line.crossings(n, plane.y):
            below = max(int(np.searchsorted(plane.y.values, value)) - 1, 0)
            yield x, StableInterval(value, value, bool(line.spare[below, n] > 0.0))


def _format_edge(edge: StableInterval) -> str:
    return f"{edge.low:.4g}" if edge.low == edge.high else f"{edge.low:g} to {edge.high:g}"


def _compare_with_line(edge: StableInterval, values: Sequence[float]) -> list[str]:
    if not values:
        return ["-", "-"]
    value = min(values, key=lambda one: abs(one - edge.middle))
    if edge.low <= value <= edge.high:
        return [f"{value:.4g}", "within"]
    return [f"{value:.4g}", f"{100.0 * (value / edge.middle - 1.0):+.1f} %"]

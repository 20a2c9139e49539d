"""Draws a stability map and writes its page: map.png, map.svg, map.pdf and map.md.

A stability map shows for which parameters a scenario is stable. The figure has one coloured
cell per combination of two parameters, and theoretical stability limits are drawn as lines. The
colour of a cell depends on the sweep:

- With one run per cell, the colour shows how the run ended, for example converged or diverged.
- With several random seeds per cell, it shows the fraction of runs that are stable, excluding
  undecided runs.
- If growth exponents (the rates at which small disturbances grow) were measured, it shows the
  exponent. White means zero.

Vector files embed the cells as an image, because viewers show seams between adjacent shapes.
The colours differ in lightness, for greyscale printing and colour-blind readers.

Invariant:
    - The page contains only results, lines and commands. Equal results give identical bytes.
    - The colour of a cell depends on its own results alone.
    - A cell is hatched if half or more of its runs are undecided, or if its exponent is
      missing.
"""

import math
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FixedFormatter, FixedLocator, MaxNLocator

from trilat_net.core import Array
from trilat_net.errors import count_nouns
from trilat_net.files import write_whole
from trilat_net.presentation import COLUMN_IN, FigureSize, TextTable, style

from .fixed_gains import FAIR_COMPARISON
from .map_plane import CELL_CLASSES, MapPanel, MapPlane, PlaneAxis, StabilityEdge
from .stability_map import MapLine, StabilityMap
from .sweep_cell import CellClass

CLASS_COLOURS = {
    CellClass.CONVERGED: "#d3e4f3",
    CellClass.BOUNDED: "#e6b84c",
    CellClass.DIVERGED: "#a23b53",
    CellClass.UNDECIDED: "#ffffff",
}
"""Colours of the classes: light, medium and dark. Undecided cells are white and hatched."""
_EMPTY_COLOUR = "#f4f4f4"
"""Colour of cells without runs."""
# Look of the hatching of undecided cells.
_HATCHED: Any = {
    "facecolor": "none",
    "edgecolor": "#8a8a8a",
    "linewidth": 0.0,
    "hatch": "/////",
}
# Styles of the lines, by `MapLine.rank`.
_LINE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#000000", "linestyle": "-", "linewidth": 1.2},
    {"color": "#000000", "linestyle": (0, (4, 1.6)), "linewidth": 1.2},
    # The last style is used for measured lines, which lie below the others.
    {"color": "#ddaa33", "linestyle": "-", "linewidth": 2.6},
)
# Look of the measured edges of the classes on a map of growth exponents.
_VERDICT_EDGE: dict[str, Any] = {"color": "#6b6b6b", "linewidth": 1.6, "alpha": 0.6}
_EXPONENTS = LinearSegmentedColormap.from_list(
    "exponents", ["#004488", "#ffffff", "#a23b53"], 257
)
_SHARES = LinearSegmentedColormap.from_list(
    "share",
    [
        CLASS_COLOURS[CellClass.DIVERGED],
        CLASS_COLOURS[CellClass.BOUNDED],
        CLASS_COLOURS[CellClass.CONVERGED],
    ],
)
"""Colours of stable fractions: dark if nothing is stable, lighter for larger fractions."""
_VERDICTS_EDGE = "edge of the verdicts"
"""Name of the measured edges between classes, in the legend and in the table."""
_SIMULATED_EDGE = "edge of the simulation"
"""Name of the measured edges of another sweep."""
_HALO_PT = 2.6
"""Width of the white halo around a line."""
_COUNT_PT = 5.0
"""Font size of the counts in cells."""
_DIGIT_WIDTH = 0.62
"""Width of a digit, relative to the font size."""
_TITLE_LETTERS_PER_IN = 13
"""Letters per inch of a panel title. Longer titles are wrapped, to keep clear of the next
panel.
"""
_FULL_HEIGHT_IN = 2.3
"""Height of a panel that has a row to itself, in inches."""
_SHARED_HEIGHT_IN = 1.75
"""Height of a panel that shares its row, in inches."""
_STRIP_HEIGHT_IN = 0.7
"""Height of a panel in a map with a single axis, in inches."""
_CAPTION_PT = 5.5
"""Font size of the caption."""
_CAPTION_LINE_IN = 0.1
"""Height of a line of the caption, in inches."""
_CAPTION_LETTERS_PER_IN = 25
"""Letters per inch of the caption."""
_SHARED_LABEL_IN = 0.14
"""Height of the label that all panels share, in inches."""
_COLOUR_BAR_IN = 0.6
"""Width of the colour bar with its labels, in inches."""


class MapReport:
    """Figure and page of a stability map.

    Args:
        chart: The results of the runs, the theoretical lines, and the texts of the map.
    """

    def __init__(self, chart: StabilityMap) -> None:
        self._chart = chart

    def draw(self, form: FigureSize) -> Figure:
        """Draws the stability map as a grid of coloured cells.

        A sweep with more than two parameters has several panels with the same two axes.

        Args:
            form: Width, font sizes and resolution of the figure.
        """
        plane = self._chart.plane
        lines = self._chart.lines
        count = len(plane.panels)
        columns = _count_columns(count, form)
        rows = math.ceil(count / columns)
        caption = _wrap_caption(self._chart.fixed, form)
        panel_height_in = _choose_panel_height_in(plane, columns)
        caption_height_in = _CAPTION_LINE_IN * len(caption)
        height_in = 0.95 + rows * panel_height_in + caption_height_in
        shares_labels = columns * rows > 1
        has_colour_bar = plane.has_exponents or plane.seeds > 1

        with style.styled_figure(form, height_in) as figure:
            x_label_options: dict[str, Any] = {}
            if caption:
                caption_top = _write_caption(figure, caption, height_in, shares_labels)
                x_label_options = {"y": caption_top, "va": "bottom"}
            panel_grid = style.add_panels(figure, rows, columns, sharex=True, sharey=True)
            grid: list[Any] = list(panel_grid.flat)
            for axes in grid[count:]:
                axes.set_axis_off()  # positions of the grid without a panel

            titles_in = form.width_in - _COLOUR_BAR_IN * has_colour_bar
            title_letters = round(titles_in * _TITLE_LETTERS_PER_IN / columns)
            for axes, panel, panel_lines in zip(grid, plane.panels, lines, strict=False):
                _draw_panel(axes, plane, panel, panel_lines)
                title = panel.title
                if len(title) > title_letters:
                    title = title.replace(", ", ",\n")
                axes.set_title(title)
            has_y_axis = bool(plane.y.key)
            for n, axes in enumerate(grid[:count]):
                _set_scale(axes, plane)
                is_left = n % columns == 0
                is_bottom = n + columns >= count
                axes.tick_params(labelleft=is_left and has_y_axis)
                axes.tick_params(labelbottom=is_bottom)

            if shares_labels:
                figure.supxlabel(plane.x.label, fontsize=8.0, **x_label_options)
                figure.supylabel(plane.y.label, fontsize=8.0)
            else:
                first_axes = grid[0]
                first_axes.set_xlabel(plane.x.label)
                first_axes.set_ylabel(plane.y.label)
            if has_colour_bar:
                _draw_colour_bar(figure, grid, plane)
            _draw_legend(figure, plane, lines)

            # Drawing computes the layout. The resulting size of a cell decides whether the
            # counts fit into it.
            canvas = FigureCanvasAgg(figure)
            figure.draw(canvas.get_renderer())  # type: ignore[no-untyped-call]
            shows_shares = plane.seeds > 1 and not plane.has_exponents
            if shows_shares:
                for axes, panel in zip(grid, plane.panels, strict=False):
                    _draw_counts(axes, plane, panel)
        return figure

    def write(self, folder: Path, width_in: float = COLUMN_IN) -> list[Path]:
        """Writes the figure and the Markdown page of the stability map into an existing folder.

        Args:
            folder: The folder.
            width_in: Width of the figure, in inches.

        Returns:
            The paths of the three image files and of the page.

        Raises:
            UsageError: The width is neither that of one column nor that of two columns of a
                printed page.
        """
        form = FigureSize.for_print(width_in)
        figure = self.draw(form)
        picture_names = ("map.png", "map.svg", "map.pdf")
        picture_paths = [folder / name for name in picture_names]
        page_path = folder / "map.md"
        for path in picture_paths:
            style.write_figure(figure, path, _DPI)
        page = self.build_page(picture_names[0])
        write_whole(page_path, page)
        return [*picture_paths, page_path]

    def build_page(self, picture: str) -> str:
        """Composes the Markdown page of the stability map.

        The page contains the commands that create the map, the figure, the number of runs in
        each class, notes, and one table of measured stability edges per panel.

        Args:
            picture: File name of the figure.
        """
        chart = self._chart
        commands = "\n".join(chart.commands)
        class_table = _tabulate_classes(chart.plane)
        parts = [
            f"# {chart.title}",
            f"```sh\n{commands}\n```",
            f"![map]({picture})",
            class_table.markdown(),
        ]

        notes = _list_notes(chart)
        if notes:
            note_lines = [f"- {note}" for note in notes]
            parts.append("\n".join(note_lines))

        for panel, lines in zip(chart.plane.panels, chart.lines, strict=True):
            table = _tabulate_edges(chart.plane, panel, lines)
            if table.rows:
                if panel.title:
                    parts.append(f"## {panel.title}")
                parts.append(table.markdown())
        return "\n\n".join(parts) + "\n"


def _count_columns(panels: int, form: FigureSize) -> int:
    """Returns the number of columns in which the panels of a figure are arranged.

    Narrow figures have two columns. In others, the number is chosen to leave few gaps in the
    last row.

    Args:
        panels: Number of panels.
        form: Width, font sizes and resolution of the figure.
    """
    if panels == 1:
        return 1
    if form.narrow:
        return 2
    if panels <= 3:
        return panels
    return 4 if panels in (4, 7, 8) else 3


def _choose_panel_height_in(plane: MapPlane, columns: int) -> float:
    """Returns the height of a panel, in inches.

    Args:
        plane: The map. If only one axis is drawn, its panels are low strips.
        columns: Number of columns. A panel that has a row to itself is higher.
    """
    if not plane.y.key:
        return _STRIP_HEIGHT_IN
    return _FULL_HEIGHT_IN if columns == 1 else _SHARED_HEIGHT_IN


def _wrap_caption(fixed: Sequence[str], form: FigureSize) -> list[str]:
    """Returns the lines of the figure caption, which lists the gains that were not swept.

    Args:
        fixed: Gains that were not swept, one string per control law.
        form: Size of the figure, which determines the length of a line.
    """
    if not fixed:
        return []
    width = round(_CAPTION_LETTERS_PER_IN * form.width_in)
    gains = "; ".join(fixed)
    gain_lines = textwrap.wrap(f"not swept: {gains}", width)
    comparison_lines = textwrap.wrap(FAIR_COMPARISON, width)
    return [*gain_lines, *comparison_lines]


def _write_caption(
    figure: Figure, caption: Sequence[str], height_in: float, shares_labels: bool
) -> float:
    """Writes the caption at the bottom of a figure, and reserves the space for it.

    Args:
        figure: The Matplotlib figure.
        caption: Lines of the caption.
        height_in: Height of the figure, in inches.
        shares_labels: True if the panels share a label. The layout engine moves panels but not
            this label, so the space for the label is reserved here.

    Returns:
        The position of the top of the caption, as a fraction of the height.
    """
    caption_height_in = _CAPTION_LINE_IN * len(caption) + 0.04
    top = caption_height_in / height_in
    reserved = top
    if shares_labels:
        reserved += _SHARED_LABEL_IN / height_in

    panel_rectangle = (0.0, reserved, 1.0, 1.0 - reserved)
    engine: Any = figure.get_layout_engine()
    engine.set(rect=panel_rectangle)

    figure.text(
        x=0.01,
        y=0.02 / height_in,
        s="\n".join(caption),
        va="bottom",
        fontsize=_CAPTION_PT,
        color=style.REFERENCE,
    )
    return top


def _draw_panel(axes: Axes, plane: MapPlane, panel: MapPanel, lines: Sequence[MapLine]) -> None:
    """Draws one panel of the map: its coloured cells, with theoretical lines on top.

    Cells whose result is undecided are hatched.

    Args:
        axes: The axes to draw on.
        plane: The measured part of the map.
        panel: Panel of the map, a grid of runs over x and y.
        lines: Lines of the panel.
    """
    axes.grid(visible=False)
    axes.set_facecolor(_EMPTY_COLOUR)
    filled = panel.fill_gaps() if plane.halvings else panel
    _draw_cells(axes, plane, filled)
    _draw_edges(axes, plane, panel.simulated)
    if plane.has_exponents and not plane.is_linear:
        _draw_edges(axes, plane, plane.find_edges(panel))
    _hatch_undecided(axes, plane, filled)
    for line in lines:
        _draw_line(axes, plane, line)


def _draw_cells(axes: Axes, plane: MapPlane, panel: MapPanel) -> None:
    """Draws the coloured cells of a panel, one for each combination of two parameters.

    The colour shows the growth exponent if the sweep measured it, otherwise the fraction of
    stable runs if there are several seeds, and otherwise the class of the single run. Cells
    without runs stay empty.

    Args:
        axes: The panel of the figure.
        plane: Axes of the map.
        panel: Results of the panel.
    """
    colours: dict[str, Any]
    values: Any
    if plane.has_exponents:
        limit = _find_exponent_limit(plane)
        values = np.ma.masked_invalid(panel.exponents_per_s)
        colours = {"cmap": _EXPONENTS, "vmin": -limit, "vmax": limit}
    elif plane.seeds > 1:
        values = np.ma.masked_invalid(panel.share)
        colours = {"cmap": _SHARES, "vmin": 0.0, "vmax": 1.0}
    else:
        most_frequent = panel.counts.argmax(axis=2)
        values = np.ma.masked_where(panel.runs == 0, most_frequent)
        count = len(CELL_CLASSES)
        class_colours = [CLASS_COLOURS[verdict] for verdict in CELL_CLASSES]
        palette = ListedColormap(class_colours)
        class_borders = np.arange(count + 1) - 0.5
        norm = BoundaryNorm(class_borders, count)
        colours = {"cmap": palette, "norm": norm}

    x = plane.x.compute_borders()
    y = plane.y.compute_borders()
    axes.pcolormesh(x, y, values, rasterized=True, **colours)


def _hatch_undecided(axes: Axes, plane: MapPlane, panel: MapPanel) -> None:
    """Hatches the cells in which half or more of the runs are undecided.

    Neighbouring cells of a row are hatched as one rectangle, because separate ones would show
    seams.

    Args:
        axes: The panel of the figure.
        plane: Axes of the map.
        panel: Results of the panel.
    """
    x = plane.x.compute_borders()
    y = plane.y.compute_borders()
    undecided_rows = _find_undecided(plane, panel)
    for row, undecided in enumerate(undecided_rows):
        bottom = y[row]
        top = y[row + 1]
        for first, stop in _list_stretches(undecided):
            sides = [x[first], x[stop]]
            axes.fill_between(sides, bottom, top, zorder=1.5, **_HATCHED)


def _draw_edges(
    axes: Axes, plane: MapPlane, edges: Sequence[tuple[float, StabilityEdge]]
) -> None:
    """Draws the edges between stable runs and runs that are not stable, in each column.

    An edge is drawn as a vertical line between the two grid points that enclose it. On a map of
    growth exponents, these lines show whether the exponents agree with the verdicts.

    Args:
        axes: The panel of the figure.
        plane: Axes of the map.
        edges: The edges, each with the x value of its column.
    """
    for x_value, edge in edges:
        x = _find_position(plane.x, x_value)
        low = _find_position(plane.y, edge.low)
        high = _find_position(plane.y, edge.high)
        axes.vlines(x, low, high, **_VERDICT_EDGE)


def _find_position(axis: PlaneAxis, value: float) -> float:
    """Returns the position at which a value is drawn on an axis.

    The position is interpolated between the values of the axis, which need not be equally
    spaced.
    """
    position = np.interp(value, axis.values, axis.positions)
    return float(position)


def _list_stretches(flags: Array) -> list[tuple[int, int]]:
    """Returns the ranges of consecutive True entries, as pairs (first, last + 1).

    Example: [True, True, False, True] has the ranges (0, 2) and (3, 4).

    Args:
        flags: Boolean array, shape (K,).
    """
    padded = np.concatenate([[False], flags, [False]])
    is_change = padded[1:] != padded[:-1]
    changes = np.flatnonzero(is_change).tolist()
    firsts = changes[::2]
    stops = changes[1::2]
    return list(zip(firsts, stops, strict=True))


def _draw_line(axes: Axes, plane: MapPlane, line: MapLine) -> None:
    """Draws a line of the map as the zero contour of its quantity.

    The quantity is known at the grid points, which are the centres of the cells. It is
    extrapolated linearly, so that the line extends to the borders of the panel.

    Args:
        axes: The axes to draw on.
        plane: The measured part of the map.
        line: The line.
    """
    y = _extend_positions(plane.y)
    excess = _extrapolate_rows(line.drawn_excess, y)
    x = _extend_positions(plane.x)
    if line.fine_positions:
        x = np.concatenate([x[:1], line.fine_positions, x[-1:]])
    excess = _extrapolate_rows(excess.T, x).T
    # A border at zero may coincide with the first position. Only one of the two is kept.
    keep_x = np.diff(x, append=np.inf) > 0.0
    keep_y = np.diff(y, append=np.inf) > 0.0
    kept_cells = np.ix_(keep_y, keep_x)
    kept_excess = np.ma.masked_invalid(excess[kept_cells])

    look = _find_line_style(line)
    contour = axes.contour(
        x[keep_x],
        y[keep_y],
        kept_excess,
        levels=[0.0],
        colors=look["color"],
        linewidths=look["linewidth"],
    )
    halo = [Stroke(linewidth=_HALO_PT, foreground="#ffffff"), Normal()]
    contour.set(linestyle=look["linestyle"], path_effects=halo)


def _find_line_style(line: MapLine) -> dict[str, Any]:
    """Returns the plot options of a line, such as colour and dashes.

    Lines of the same kind have the same style in all panels.
    """
    style_index = line.rank % len(_LINE_STYLES)
    return _LINE_STYLES[style_index]


def _extend_positions(axis: PlaneAxis) -> Array:
    """Returns the positions of an axis's values, with the borders of the panel at both ends.

    This allows a line to be extended to the border of the panel.
    """
    borders = axis.compute_borders()
    first_border = borders[:1]
    last_border = borders[-1:]
    return np.concatenate([first_border, axis.positions, last_border])


def _extrapolate_rows(rows: Array, positions: Array) -> Array:
    """Returns a field with an extrapolated row before the first and after the last row.

    This extends the lines of a map to its border, half a cell beyond the grid points.

    Args:
        rows: The field, shape (n, m).
        positions: Positions of the rows of the result, shape (n + 2,).
    """
    reversed_rows = rows[::-1]
    reversed_positions = positions[::-1]
    before = _extrapolate_row(rows[:2], positions[:3])
    after = _extrapolate_row(reversed_rows[:2], reversed_positions[:3])
    row_before = before[np.newaxis]
    row_after = after[np.newaxis]
    return np.concatenate([row_before, rows, row_after])


def _extrapolate_row(rows: Array, positions: Array) -> Array:
    """Computes an additional row of a field by linear extrapolation from the two nearest rows.

    Args:
        rows: The nearest row and the one behind it, shape (2, m).
        positions: Positions of the new row and of these two rows, shape (3,).
    """
    outside, near, far = positions
    near_row, far_row = rows
    difference = far_row - near_row
    offset = outside - near
    spacing = far - near
    extrapolated: Array = near_row + difference * offset / spacing
    return extrapolated


def _find_undecided(plane: MapPlane, panel: MapPanel) -> Any:
    """Determines which cells of a map are hatched, because their runs have no clear result.

    In such a cell, half or more of the runs are undecided. On a map of growth exponents, it is
    a cell without an exponent.

    Returns:
        Boolean array, shape (y, x).
    """
    has_runs = panel.runs > 0
    if plane.has_exponents:
        return has_runs & np.isnan(panel.exponents_per_s)
    class_index = CELL_CLASSES.index(CellClass.UNDECIDED)
    undecided = panel.counts[:, :, class_index]
    half_or_more = 2 * undecided >= panel.runs
    return has_runs & half_or_more


def _set_scale(axes: Axes, plane: MapPlane) -> None:
    """Sets the limits and ticks of both axes of a panel.

    The limits are the outer borders of the first and the last cells.

    Args:
        axes: The panel of the figure.
        plane: The measured part of the map. With a single axis, the vertical one has no ticks.
    """
    x = plane.x.compute_borders()
    y = plane.y.compute_borders()
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    _set_ticks(axes.xaxis, plane.x)
    _set_ticks(axes.yaxis, plane.y)
    if not plane.y.key:
        axes.set_yticks([])
    for spine in ("top", "right"):
        axes.spines[spine].set_visible(True)


def _set_ticks(axis: Axis, plane_axis: PlaneAxis) -> None:
    """Sets the ticks of one axis of a panel.

    For equally spaced values, the ticks are round numbers. Otherwise they are the values
    themselves.
    """
    if plane_axis.is_evenly_spaced:
        round_steps = [1, 2, 2.5, 4, 5, 10]
        axis.set_major_locator(MaxNLocator(5, steps=round_steps))
        return
    positions = list(plane_axis.positions)
    texts = [f"{value:g}" for value in plane_axis.values]
    axis.set_major_locator(FixedLocator(positions))
    axis.set_major_formatter(FixedFormatter(texts))


def _find_exponent_limit(plane: MapPlane) -> float:
    """Returns the growth exponent at which the colour scale of a map ends, in 1/s.

    The limit is 1, 2 or 5 times a power of ten. Up to a fifth of the exponents may exceed it,
    because otherwise a few large exponents would make all others look pale.
    """
    # The cells that ran in a refined sweep lie along the edge, where exponents are small.
    panels = plane.panels
    if plane.halvings:
        panels = tuple(panel.fill_gaps() for panel in panels)
    exponents = [panel.exponents_per_s.ravel() for panel in panels]
    magnitudes = np.abs(np.concatenate(exponents))
    quantile = float(np.nanquantile(magnitudes, 0.8))
    least = max(quantile, 1e-6)
    power = math.floor(math.log10(least))
    decade = 10.0**power
    for step in (1.0, 2.0, 5.0):
        limit = step * decade
        if limit >= least * (1.0 - 1e-9):  # also true if both are equal up to rounding
            return limit
    return 10.0 * decade


def _draw_colour_bar(figure: Figure, grid: Sequence[Axes], plane: MapPlane) -> None:
    """Draws the colour bar for growth exponents or for the fraction of stable runs.

    On a bar of exponents, the pointed ends represent all exponents beyond its limits.

    Args:
        figure: The Matplotlib figure.
        grid: All panels, next to which the bar is drawn.
        plane: The measured part of the map.
    """
    if plane.has_exponents:
        limit = _find_exponent_limit(plane)
        colours = ScalarMappable(cmap=_EXPONENTS)
        colours.set_clim(-limit, limit)
        label = "growth exponent of a push (1/s)"
        if plane.is_linear:
            label = "growth rate of small motions (1/s)"
        pointed = "both"
    else:
        colours = ScalarMappable(cmap=_SHARES)
        colours.set_clim(0.0, 1.0)
        label = "share of stable runs"
        pointed = "neither"

    bar = figure.colorbar(
        colours,
        ax=list(grid),
        fraction=0.05,
        pad=0.02,
        aspect=30,
        extend=pointed,
    )
    if plane.has_exponents:
        half = 0.5 * limit
        bar.set_ticks([-limit, -half, 0.0, half, limit])
    bar.set_label(label)
    bar.outline.set_linewidth(0.6)


def _draw_counts(axes: Axes, plane: MapPlane, panel: MapPanel) -> None:
    """Writes the number of stable and of decided runs into cells whose runs disagree.

    The runs of a cell differ in their random seeds. Nothing is written if the text does not fit
    into a cell.
    """
    extent = axes.get_window_extent()
    dpi = axes.figure.dpi
    panel_width_pt = 72.0 * extent.width / dpi
    panel_height_pt = 72.0 * extent.height / dpi
    cell_width_pt = panel_width_pt / len(plane.x.values)
    cell_height_pt = panel_height_pt / len(plane.y.values)

    digits = len(str(plane.seeds))
    letters = 2 * digits + 1
    text_width_pt = letters * _DIGIT_WIDTH * _COUNT_PT
    text_height_pt = 1.2 * _COUNT_PT
    if cell_width_pt < text_width_pt or cell_height_pt < text_height_pt:
        return

    stable = panel.stable
    decided = panel.decided
    disagree = (stable > 0) & (stable < decided)
    for i, j in np.argwhere(disagree):
        axes.text(
            x=plane.x.positions[j],
            y=plane.y.positions[i],
            s=f"{stable[i, j]}/{decided[i, j]}",
            ha="center",
            va="center",
            fontsize=_COUNT_PT,
            color="#000000",
        )


def _draw_legend(figure: Figure, plane: MapPlane, lines: Sequence[Sequence[MapLine]]) -> None:
    """Draws the legend of the map, which explains its colours, its hatching and its lines.

    Args:
        figure: The Matplotlib figure.
        plane: The measured part of the map.
        lines: Lines of each panel.
    """
    handles: list[Any] = []
    if any(panel.simulated for panel in plane.panels):
        handles.append(Line2D([], [], label=_SIMULATED_EDGE, **_VERDICT_EDGE))
    if plane.has_exponents:
        has_edges = any(plane.find_edges(panel) for panel in plane.panels)
        if has_edges and not plane.is_linear:
            handles.append(Line2D([], [], label=_VERDICTS_EDGE, **_VERDICT_EDGE))
    elif plane.seeds == 1:
        handles += _list_class_handles(plane)

    undecided_by_panel = [_find_undecided(plane, panel) for panel in plane.panels]
    if any(undecided.any() for undecided in undecided_by_panel):
        if plane.has_exponents:
            label = "no exponent"
        elif plane.seeds > 1:
            label = "half or more undecided"
        else:
            label = CellClass.UNDECIDED.value
        look = {**_HATCHED, "linewidth": 0.5}
        handles.append(Patch(label=label, **look))

    if plane.refused:
        handles.append(Patch(label=CellClass.REFUSED.value, facecolor=_EMPTY_COLOUR))
    if plane.halvings:
        handles.append(Patch(label=_describe_refined_cells(plane), visible=False))

    # Panels may share a line, which has one entry.
    line_of_label = {}
    for panel_lines in lines:
        for line in panel_lines:
            line_of_label[line.label] = line
    for label, line in line_of_label.items():
        look = _find_line_style(line)
        handles.append(Line2D([], [], label=label, **look))
    style.place_legend(figure, handles, handlelength=1.6)


def _list_class_handles(plane: MapPlane) -> list[Patch]:
    """Returns the legend entries for the classes that occur in a map, with their colours.

    The class "undecided" has no colour of its own, because its cells are hatched.
    """
    counts_of_panels = [panel.counts.sum(axis=(0, 1)) for panel in plane.panels]
    counts = sum(counts_of_panels)
    handles = []
    for verdict, count in zip(CELL_CLASSES, counts, strict=True):
        is_decided = verdict is not CellClass.UNDECIDED
        if count and is_decided:
            patch = Patch(
                label=verdict.value,
                facecolor=CLASS_COLOURS[verdict],
                edgecolor="#6b6b6b",
                linewidth=0.5,
            )
            handles.append(patch)
    return handles


_DPI = 300
"""Resolution of map.png, and of the cells in the other files, in pixels per inch."""


def _list_notes(chart: StabilityMap) -> list[str]:
    """Returns the notes below a map: the origin of its lines and the gains that were not swept.

    A line that several panels share is explained once.
    """
    origins = []
    for lines in chart.lines:
        for line in lines:
            origin = f"{line.text}: {line.about}"
            origins.append(origin)
    notes = [*dict.fromkeys(origins), *chart.remarks]

    plane = chart.plane
    if plane.halvings:
        notes.append(
            f"{_describe_refined_cells(plane)}, along the edge; the others are drawn "
            "like their neighbours, and the table has the columns of the coarse grid"
        )
    if plane.refused:
        refused = count_nouns(plane.refused, "cell")
        notes.append(f"no runs, because the scenario is not valid: {refused}")

    notes += [f"gains that were not swept: {text}" for text in chart.fixed]
    if chart.fixed:
        command = "trilat compare --tune"
        comparison = FAIR_COMPARISON.replace(command, f"`{command}`")
        notes.append(comparison)
    return notes


def _describe_refined_cells(plane: MapPlane) -> str:
    """Returns a phrase on how many cells were run, such as "1243 of 40401 cells ran".

    A refined sweep simulates only the cells near an edge of stability.
    """
    ran = sum(int((panel.runs > 0).sum()) for panel in plane.panels)
    cells = sum(panel.runs.size for panel in plane.panels)
    return f"{ran} of {count_nouns(cells, 'cell')} ran"


def _tabulate_classes(plane: MapPlane) -> TextTable:
    """Returns a table of the number of runs in each class, with one row per panel.

    Args:
        plane: Axes of the map, and the results of the runs in each panel.
    """
    rows = []
    for panel in plane.panels:
        title = panel.title or "all"
        counts = panel.counts.sum(axis=(0, 1)).tolist()
        count_texts = map(str, counts)
        rows.append((title, *count_texts))
    return TextTable(("runs", *CELL_CLASSES), rows)


def _tabulate_edges(plane: MapPlane, panel: MapPanel, lines: Sequence[MapLine]) -> TextTable:
    """Returns a table that compares the measured edges of stability with theory.

    The table has one row per measured edge of the panel. For each theoretical line, it shows
    the crossing nearest to the edge, and the difference of this crossing from the middle of the
    edge, or "within" if the crossing lies within the edge.

    On a map of growth exponents, the measured edges are the zeros of the exponent, and another
    column shows the nearest edge between stable and not stable runs. If only one axis is drawn,
    the table is empty.

    Args:
        plane: The measured part of the map.
        panel: Panel of the map, a grid of runs over x and y.
        lines: Lines of the panel.
    """
    theory = [line for line in lines if line.rank >= 0]
    heads = [plane.x.label, f"edge of {plane.y.label}", "stable is"]
    has_simulation = any(panel.simulated for panel in plane.panels)
    has_verdicts = plane.has_exponents and not plane.is_linear
    if has_verdicts:
        heads.append(_VERDICTS_EDGE)
    if has_simulation:
        heads.append(_SIMULATED_EDGE)
    for line in theory:
        heads += [line.text, "difference"]

    verdict_edges = plane.find_edges(panel)
    edges = verdict_edges
    if plane.has_exponents:
        edges = []
        for line in lines:
            is_measured = line.rank < 0
            if is_measured:
                edges += _list_crossings(line, plane)

    rows = []
    columns = plane.x.thin_out(plane.halvings).values
    for x, edge in edges:
        if x not in columns:
            continue
        stable_side = "below" if edge.stable_below else "above"
        row = [f"{x:g}", _format_edge(edge), stable_side]
        if has_verdicts:
            column_edges = [other for other_x, other in verdict_edges if other_x == x]
            row.append(_format_nearest_edge(edge.low, column_edges))
        if has_simulation:
            column_edges = [other for other_x, other in panel.simulated if other_x == x]
            row.append(_format_nearest_edge(edge.low, column_edges))
        column = plane.x.values.index(x)
        for line in theory:
            crossings = line.crossings(column, plane.y)
            row += _compare_with_line(edge, crossings)
        rows.append(tuple(row))
    return TextTable(tuple(heads), rows)


def _list_crossings(line: MapLine, plane: MapPlane) -> Iterator[tuple[float, StabilityEdge]]:
    """Yields the crossings of a theoretical line with the columns of a map.

    They are compared with the measured edges in the table of edges.

    Args:
        line: The line.
        plane: Axes of the map.

    Yields:
        The x value of a column, and the crossing as an edge of zero width.
    """
    for column, x in enumerate(plane.x.values):
        crossings = line.crossings(column, plane.y)
        for value in crossings:
            above = int(np.searchsorted(plane.y.values, value))
            below = max(above - 1, 0)
            excess_below = line.excess[below, column]
            stable_below = bool(excess_below > 0.0)
            yield x, StabilityEdge(value, value, stable_below)


def _format_edge(edge: StabilityEdge) -> str:
    """Formats an edge of stability, such as "40 to 60" for an edge between 40 and 60.

    A theoretical edge is a single value, such as "52.3".
    """
    if edge.low == edge.high:
        return f"{edge.low:.4g}"
    return f"{edge.low:g} to {edge.high:g}"


def _format_nearest_edge(value: float, edges: Sequence[StabilityEdge]) -> str:
    """Formats the measured edge that is nearest to a predicted value, or "-" if there is none.

    Args:
        value: Value on the vertical axis, usually that of a theoretical line.
        edges: Edges of the column.
    """
    if not edges:
        return "-"
    nearest = min(edges, key=lambda edge: abs(edge.middle - value))
    return _format_edge(nearest)


def _compare_with_line(edge: StabilityEdge, values: Sequence[float]) -> list[str]:
    """Compares a measured edge of stability with a theoretical line.

    Args:
        edge: The measured edge.
        values: Values at which the line crosses the column of the edge.

    Returns:
        Two table cells. The first is the crossing nearest to the edge, the second its relative
        difference from the middle of the edge, or "within" if the crossing lies within the
        edge. Both are "-" if there is no crossing.
    """
    if not values:
        return ["-", "-"]
    nearest = min(values, key=lambda value: abs(value - edge.middle))
    if edge.low <= nearest <= edge.high:
        return [f"{nearest:.4g}", "within"]
    difference = 100.0 * (nearest / edge.middle - 1.0)
    return [f"{nearest:.4g}", f"{difference:+.1f} %"]

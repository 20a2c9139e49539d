"""Provides the common style of all figures, and draws the elements that they share.

A figure looks the same wherever it appears: each arm has its own colour, and if there are more
arms than colours, dash patterns distinguish them. This module provides lines, axes, panels and
legends in this style, and writes figures to files.

Most figures show signals over the time of a run. `TimeFigure` draws these, with one line per
arm in each panel, a time axis and a legend. Markers show when an arm did not follow the others
(because it held, braked or returned), and when a change such as a new network delay was
applied.

Invariant:
    - Matplotlib's global state is left unchanged, so that users' own figures keep their style.
    - Equal figures produce byte-identical files: files contain no date, and fonts are embedded
      as TrueType.
    - Figures of a run without events have no markers.
"""

import base64
import io
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from ..analysis import Timeline
from ..core import Array
from ..files import write_whole
from ..log import Ints, Log, SiteLog
from ..records import Mode
from ..scenario import TASK_AXES
from .appearance import REPORT_SIZE, SITE_COLOURS, FigureSize, list_site_colours
from .plot_signals import decimate

AxesGrid = NDArray[np.object_]
"""Grid of panels in a figure: an array of `Axes` with shape (rows, columns)."""
LineOptions = dict[str, Any]
"""Options of a line: keyword arguments of `Axes.plot`."""
LegendEntry = tuple[str, LineOptions]
"""Legend label of a line, and the options of the line."""
LegendEntries = Sequence[LegendEntry]

DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (1, 1)),
    (0, (5, 1.5, 1, 1.5)),
)
"""Line styles: solid, and three dash patterns."""
REFERENCE = "#333333"
"""Dark grey, the colour of references, limits and markers."""
FAINT = "#8c8c8c"
"""Light grey, the colour of text in empty panels and of bands."""

LIMIT_LINE: LineOptions = {
    "color": REFERENCE,
    "linestyle": (0, (4, 2)),
    "linewidth": 0.8,
}
"""Options of a line at a desired, true, specified or permitted value."""

REPORT_DPI = REPORT_SIZE.dpi
_NOTEBOOK_DPI = 200
_LEAST_RANGE = 1e-9
"""If the range of values is smaller than this, they differ only by rounding errors."""
BUCKETS_PER_PANEL = 700
"""Number of time intervals to which the signals of a panel are decimated.

Half a page is 700 pixels wide, so more points would not be visible.
"""

_STYLE_SHEET = resources.files("trilat_net.presentation") / "assets" / "figures.mplstyle"
_RC: Any = {
    **mpl.rc_params_from_file(str(_STYLE_SHEET), use_default_template=False),
    "figure.dpi": REPORT_DPI,
    "savefig.dpi": REPORT_DPI,
}
_NARROW_RC: Any = {
    "legend.handlelength": 1.5,
    "legend.columnspacing": 1.0,
    "legend.borderaxespad": 0.2,
}


@contextmanager
def styled_figure(form: FigureSize, height_in: float) -> Iterator[Figure]:
    """Context manager that provides an empty figure in the common style.

    The style applies only to what is drawn within the `with` block.

    Args:
        form: Width and font sizes of the figure.
        height_in: Height of the figure, in inches.
    """
    settings: Any = dict(_RC)
    settings["xtick.labelsize"] = form.tick_pt
    settings["ytick.labelsize"] = form.tick_pt
    if form.narrow:
        settings.update(_NARROW_RC)
    with mpl.rc_context(settings):
        yield _NotebookFigure(figsize=(form.width_in, height_in), layout="constrained")


class _NotebookFigure(Figure):
    """A Matplotlib figure that Jupyter notebooks display as a picture.

    A notebook would otherwise display only a line of text with the size of the figure, because
    figures are created without pyplot.
    """

    def _repr_png_(self) -> bytes:
        """Returns the picture as PNG. Jupyter calls this method by its name."""
        return _render_figure(self, "png", _NOTEBOOK_DPI)

    def _repr_html_(self) -> str:
        """Returns the picture as HTML. Jupyter calls this method by its name."""
        from .html_templates import render_macro

        # Two pixels of the picture per pixel of the page look sharp on screens of high density.
        width = round(self.get_figwidth() * _NOTEBOOK_DPI / 2)
        picture = base64.b64encode(self._repr_png_()).decode()
        source = f"data:image/png;base64,{picture}"
        return render_macro("result.html", "figure", width=width, source=source)


def add_panels(figure: Figure, rows: int, columns: int, **options: Any) -> AxesGrid:
    """Adds a grid of panels (subplots) to a figure.

    Args:
        figure: The Matplotlib figure.
        rows: Number of rows.
        columns: Number of columns.
        **options: Options of `Figure.subplots`.

    Returns:
        The panels, shape (rows, columns), even if there is only one row or column.
    """
    grid: AxesGrid = figure.subplots(rows, columns, squeeze=False, **options)
    return grid


def site_colour(log: Log, site: str) -> str:
    """Returns the colour of an arm, which is the same in every figure of the log.

    Args:
        log: Log with the site.
        site: Name of the site.
    """
    colours = list_site_colours(log.scenario)
    return colours[log.sites.index(site) % len(SITE_COLOURS)]


_WIDEST_PT = 2.0
"""Line width of the first site in a panel that shows all sites, in pt."""
_THINNER_PT = 1.2
"""Difference in line width between the first and the last site in such a panel, in pt."""


def site_line(log: Log, site: str, width: float | None = None) -> LineOptions:
    """Returns the colour, dash pattern and width of an arm's lines, for all figures.

    If there are more arms than colours, colours are reused with dashes.

    Args:
        log: Log with the site.
        site: Name of the site.
        width: Width of the line, in pt. `None` if the lines of all sites share one panel. In
            that case each successive site has a thinner line, so that lines on top of one
            another remain visible.
    """
    site_index = log.sites.index(site)
    last_index = len(log.sites) - 1
    if width is None:
        width = _WIDEST_PT
        if last_index > 0:  # not for a single site, which would divide by zero
            width = _WIDEST_PT - _THINNER_PT * site_index / last_index

    palette_repetitions = site_index // len(SITE_COLOURS)
    return {
        "color": site_colour(log, site),
        "linestyle": DASHES[palette_repetitions % len(DASHES)],
        "linewidth": width,
    }


def site_title(log: Log, site: str) -> str:
    """Returns the name of an arm with its role, such as master or slave, for legends.

    Args:
        log: Log with the site.
        site: Name of the site.
    """
    return f"{site} ({log.scenario.sites[site].role})"


def plot_decimated(axes: Axes, tick: Ints, t_s: Array, values: Array, **options: Any) -> None:
    """Plots a signal over time with fewer points, while keeping all extremes visible.

    A run can have millions of values, far more than a figure has pixels.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        tick: Ticks of the values, shape (K,).
        t_s: Times of the values, in s, shape (K,).
        values: Values of the signal, shape (K,).
        **options: Options of the line.
    """
    trace = decimate(tick, t_s, values[:, np.newaxis], BUCKETS_PER_PANEL)
    axes.plot(trace.t_s, trace.values[:, 0], **options)


def positive(values: Array) -> Array:
    """Replaces zero and negative values with NaN, since a logarithmic axis cannot show them.

    A line has a gap at NaN, whereas at zero it would extend to the edge of the panel.

    Args:
        values: The values.
    """
    return np.where(values > 0.0, values, np.nan)


def set_plain_log_axis(axis: Axis, steps: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Labels a logarithmic axis with plain numbers, such as 20, instead of powers of 10.

    Args:
        axis: The axis.
        steps: Multiples of each power of 10 to label.
    """
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(LogLocator(subs=range(1, 10)))
    axis.set_minor_formatter(NullFormatter())


def name_joints(log: Log) -> list[str]:
    """Returns titles for panels that show one joint each, such as "joint 1".

    Joint names are added if the arms are chains that all use the same joint names. There are as
    many titles as joints in the arm with the most joints.

    Args:
        log: Log with the arms.
    """
    arms = [log.scenario.arms[site] for site in log.sites]
    longest_arm = max(arms, key=lambda arm: arm.counts.joints)
    numbers = range(1, longest_arm.counts.joints + 1)
    names_differ = len({arm.joint_names for arm in arms}) > 1
    if longest_arm.chain is None or names_differ:
        return [f"joint {number}" for number in numbers]

    units = longest_arm.joint_units("rad")
    titles = []
    for number, name, unit in zip(numbers, longest_arm.joint_names, units, strict=True):
        # The axes of the figure have the units of revolute joints. Prismatic joints have other
        # units.
        quantity = " (m, N)" if unit == "m" else ""
        titles.append(f"{number}: {name}{quantity}")
    return titles


def name_shared(log: Log) -> list[str]:
    """Returns titles for the joints or axes in which the arms follow each other.

    These are task-space axes if the arms follow each other's end effectors.

    Args:
        log: Log with the arms.
    """
    arm = log.scenario.arms[log.sites[0]]
    if arm.shares_pose:
        return list(TASK_AXES[: arm.counts.shared])
    return name_joints(log)


def flatten_rounding(axes: Axes) -> None:
    """Widens the value axis of a panel whose values differ only by rounding errors.

    Otherwise Matplotlib would scale the axis to the rounding errors, and a constant would look
    like noise.

    Args:
        axes: The panel. Its axis is modified in place.
    """
    low, high = axes.get_ylim()
    if high - low < _LEAST_RANGE:
        axes.set_ylim(low - 0.05, high + 0.05)


class _JointPanels(NamedTuple):
    """Panels of a figure in which each joint of the arms has its own panel.

    Created by `TimeFigure.add_joint_panels`.

    Attributes:
        joints: One panel per joint.
        columns: Number of panels in a row.
        lowest: Bottom panel of each column, which has the time axis.
        below: Panel below the others, spanning the whole width. `None` if there is no such
            panel.
    """

    joints: list[Axes]
    columns: int
    lowest: list[Axes]
    below: Axes | None


def arrange_joints(joints: int, narrow: bool) -> list[list[str]]:
    """Arranges one panel per joint in a grid with few rows and few empty cells.

    Arms typically have two to seven joints.

    Args:
        joints: Number of joints.
        narrow: True if only two panels fit side by side. Otherwise three or four fit.

    Returns:
        The rows of the grid. A cell is the index of a joint as a string, or "." if it is empty.
    """

    def count_cells(columns: int) -> tuple[int, int]:
        """Returns the size of the panel grid for a given number of columns.

        Args:
            columns: Number of columns.

        Returns:
            The number of rows, and the number of empty cells in the last row.
        """
        rows = math.ceil(joints / columns)
        return rows, rows * columns - joints

    choices = (2,) if narrow or joints == 2 else (3, 4)
    # The fewest rows win. Among arrangements with equally many rows, the fewest empty cells
    # win.
    columns = min(choices, key=count_cells)
    _, empty_cells = count_cells(columns)

    cells = [str(joint) for joint in range(joints)]
    cells += ["."] * empty_cells
    return [cells[first : first + columns] for first in range(0, len(cells), columns)]


def typeset(text: str) -> str:
    """Replaces "+-" and "->", as used on the terminal, with the symbols ± and →.

    For example, "m1->s: 3 +- 1" becomes "m1 → s: 3 ± 1".

    Args:
        text: Text intended for the terminal.
    """
    return text.replace("+-", "±").replace("->", " → ")


def typeset_unit(unit: str) -> str:
    """Replaces "^2" in a unit with the superscript ²: "rad/s^2" becomes "rad/s²".

    Args:
        unit: The unit, such as "rad/s^2".
    """
    return unit.replace("^2", "²")


_MAX_LEGEND_COLUMNS = 6


def add_legend(figure: Figure, entries: LegendEntries, **options: Any) -> None:
    """Adds a legend for the lines above the panels of a figure.

    Args:
        figure: The Matplotlib figure.
        entries: Text and line of each entry.
        **options: Options of `Figure.legend`.
    """
    handles = []
    for text, line in entries:
        handles.append(Line2D([], [], label=text, **line))
    place_legend(figure, handles, **options)


def place_legend(figure: Figure, handles: Sequence[Any], **options: Any) -> None:
    """Adds a legend above the panels, with as many columns as fit the width of the figure.

    Args:
        figure: The Matplotlib figure.
        handles: Matplotlib artists of the entries, each with a label.
        **options: Options of `Figure.legend`.
    """
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    most_columns = min(len(handles), _MAX_LEGEND_COLUMNS)
    for columns in range(most_columns, 0, -1):
        legend = figure.legend(
            handles=handles, loc="outside upper center", ncols=columns, **options
        )
        width = legend.get_window_extent(renderer).width
        fits = width <= figure.bbox.width
        if fits or columns == 1:
            return
        legend.remove()  # try again with fewer columns


def site_legend_entries(log: Log, sites: Sequence[str]) -> list[LegendEntry]:
    """Returns legend entries that explain the lines of several sites.

    An entry consists of a text, such as "m1 (master)", and the colour, dash pattern and width
    of the site's line.

    Args:
        log: Log with the sites.
        sites: Names of the sites.
    """
    return [(site_title(log, site), site_line(log, site)) for site in sites]


_CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}
_EMPTY_FIGURE_CHARACTERS_PER_IN = 17


def empty_figure(text: str, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns a figure that contains only text: the reason why there is nothing to draw.

    This ensures that a command that writes a figure always writes a file.

    Args:
        text: The reason.
        form: Width, font sizes and resolution of the figure.
    """
    characters = round(_EMPTY_FIGURE_CHARACTERS_PER_IN * form.width_in)
    lines = textwrap.wrap(text, characters)
    with styled_figure(form, 1.0) as figure:
        figure.text(0.5, 0.5, "\n".join(lines), color=REFERENCE, **_CENTRED)
    return figure


def annotate_empty_panel(axes: Axes, text: str) -> None:
    """Writes the reason why there is nothing to show into an empty panel.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        text: The reason.
    """
    axes.text(0.5, 0.5, text, color=FAINT, transform=axes.transAxes, **_CENTRED)


FIGURE_FORMATS = ("pdf", "png", "svg")
"""Suffixes of the file formats in which figures can be written."""

_FILE_RC: Any = {
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "trilat-net",
}
_UNDATED: dict[str, dict[str, Any]] = {
    "pdf": {"CreationDate": None},
    "png": {},
    "svg": {"Date": None},
}


def write_figure(figure: Figure, path: Path, dpi: int) -> None:
    """Writes a figure to a file, in the format given by the suffix of the file, such as .pdf.

    Args:
        figure: The Matplotlib figure.
        path: The file. Its suffix determines the format, which must be one of `FIGURE_FORMATS`.
        dpi: Resolution of a .png file.

    Raises:
        UsageError: The file cannot be created.
        LogRefused: The data could not be written to disk.
    """
    kind = path.suffix.removeprefix(".").lower()
    write_whole(path, _render_figure(figure, kind, dpi))


def _render_figure(figure: Figure, kind: str, dpi: int) -> bytes:
    """Renders a figure to the bytes of a file that contains no date.

    Without a date, the same figure always results in the same bytes, so that files can be
    compared.

    Args:
        figure: The Matplotlib figure.
        kind: Format of the file, one of `FIGURE_FORMATS`.
        dpi: Resolution of a PNG file.
    """
    drawing = io.BytesIO()
    with mpl.rc_context(_FILE_RC):
        figure.savefig(drawing, format=kind, dpi=dpi, metadata=_UNDATED[kind])
    return drawing.getvalue()


MOST_EXPLAINED_CHANGES = 12
"""Maximum number of changes explained in a figure; the page lists all changes."""

SiteSignal = Callable[[str], tuple[Ints, Array, Array]]
"""Function that takes the name of a site and returns ticks (K,), times in s (K,), and values
(K, J).
"""

_HOLD_ALPHA = 0.22
"""Opacity of the shading while a site holds or brakes."""
_RETURN_ALPHA = 0.09
"""Opacity of the shading while a site returns."""
_LETTERS_PER_IN = 120.0
"""Average number of letters per inch of a font with a size of 1 pt."""
_CHANGE_LINE: LineOptions = {
    "color": REFERENCE,
    "linestyle": (0, (1, 1.5)),
    "linewidth": 0.7,
}
"""Options of the vertical line that marks a change."""
_CHANGE_NUMBER: dict[str, Any] = {
    "xytext": (1.5, -0.5),
    "textcoords": "offset points",
    "va": "top",
    "color": REFERENCE,
    "bbox": {
        "boxstyle": "square,pad=0.05",
        "facecolor": "white",
        "edgecolor": "none",
        "alpha": 0.7,
    },
}


def site_records(log: Log, values: Callable[[SiteLog], Array]) -> SiteSignal:
    """Returns a function that reads the values to plot from any site of a log.

    Figures pass it to `TimeFigure.joint_row`, which calls it for each site.

    Args:
        log: Log with the records of the sites.
        values: Function that computes the values, shape (K, J), from the K records of a site. J
            is the number of values per record.

    Returns:
        A function that takes the name of a site and returns the ticks, times and values of its
        records.
    """

    def read_signal(site: str) -> tuple[Ints, Array, Array]:
        """Returns the ticks and times of an arm's K records, and the values to plot.

        Args:
            site: Name of the site.

        Returns:
            Ticks, shape (K,); their times in s, shape (K,); and values, shape (K, J).
        """
        records = log[site]
        return records.tick, records.t_s, values(records)

    return read_signal


@contextmanager
def time_figure(
    log: Log,
    form: FigureSize,
    height_in: float,
    interval_s: tuple[float, float] | None = None,
) -> Iterator["TimeFigure"]:
    """Context manager that provides an empty figure for panels that show a run over time.

    Args:
        log: Log of the run.
        form: Width and font sizes of the figure.
        height_in: Height of the figure, in inches.
        interval_s: Start and end of the time axis, in s. `None` for the whole run.
    """
    with styled_figure(form, height_in) as figure:
        yield TimeFigure(log, form, figure, interval_s)


class TimeFigure:
    """A figure that shows signals of a log over the time of the run, with markers.

    Create it with `time_figure`. Then add panels to `figure`, draw into them with `trace` or
    `joint_row`, and call `finish` at the end.

    Args:
        log: Log of the run.
        form: Width and font sizes of the figure.
        figure: Empty Matplotlib figure.
        interval_s: Start and end of the time axis, in s. `None` for the whole run.

    Attributes:
        log: Log of the run.
        figure: The Matplotlib figure.
    """

    def __init__(
        self,
        log: Log,
        form: FigureSize,
        figure: Figure,
        interval_s: tuple[float, float] | None = None,
    ) -> None:
        self.log = log
        self.figure = figure
        self._form = form
        timeline = Timeline(log)
        self._interval_s = interval_s or (0.0, timeline.end_s)

        shown_changes = timeline.changes
        if interval_s is not None:
            # Numbers of other changes would be drawn beside the panels.
            first_s, last_s = interval_s
            shown_changes = [
                applied for applied in shown_changes if first_s <= applied.change.at_s <= last_s
            ]
        self._changes = list(enumerate(shown_changes, 1))
        self._modes = {site: timeline.find_mode_intervals(site) for site in log.sites}

    def add_joint_panels(self, joints: int, below: str = "") -> _JointPanels:
        """Adds one panel per joint to the figure, and optionally a wide panel below them.

        If there are two joints, their panels share a value axis. If there are more, each panel
        has its own, because wrist torques are much smaller than shoulder torques.

        Args:
            joints: Number of joints.
            below: Name of the wide panel. Empty for no wide panel.
        """
        grid = arrange_joints(joints, self._form.narrow)
        columns = len(grid[0])
        rows = list(grid)
        if below:
            rows.append([below] * columns)
        panels: dict[str, Axes] = self.figure.subplot_mosaic([[*row] for row in rows])
        joint_panels = [panels[str(joint)] for joint in range(joints)]

        # Only the lowest panel of a column has a labelled time axis.
        for upper, lower in zip(joint_panels, joint_panels[columns:], strict=False):
            upper.sharex(lower)
            upper.tick_params(labelbottom=False)
        if joints == 2:
            joint_panels[1].sharey(joint_panels[0])
            joint_panels[1].tick_params(labelleft=False)
        return _JointPanels(
            joints=joint_panels,
            columns=columns,
            lowest=joint_panels[-columns:],
            below=panels.get(below),
        )

    def trace(
        self, axes: Axes, site: str, values: Array, width: float | None = None, **options: Any
    ) -> None:
        """Plots one value per record of a site over time, in the colour of the site.

        If a run has more records than the figure has pixels, only the extremes are drawn.

        Args:
            axes: Panel of the figure, as Matplotlib axes.
            site: Name of the site.
            values: One value per record, shape (K,).
            width: Width of the line, see `site_line`.
            **options: Options of the line, which take precedence over those of the site.
        """
        records = self.log[site]
        line_options = {**site_line(self.log, site, width), **options}
        plot_decimated(axes, records.tick, records.t_s, values, **line_options)

    def joint_row(self, row: Sequence[Axes], sites: Sequence[str], signal: SiteSignal) -> None:
        """Plots a signal over time, with one panel per joint and one line per arm.

        Intervals in which an arm does not follow the others are shaded, and setting changes are
        marked.

        Args:
            row: One panel per joint, as Matplotlib axes.
            sites: Names of the sites.
            signal: Function that takes the name of a site and returns its ticks, times and
                values.
        """
        for site in sites:
            tick, t_s, values = signal(site)
            line_options = site_line(self.log, site)
            for axes, joint_values in zip(row, values.T, strict=False):
                plot_decimated(axes, tick, t_s, joint_values, **line_options)

        for axes in row:
            self.mark(axes, sites)
            if len(row) > 2:
                flatten_rounding(axes)

    def mark(
        self, axes: Axes, sites: Sequence[str], link: str = "", *, numbered: bool = True
    ) -> None:
        """Marks interruptions and setting changes during the run in a panel.

        The panel is shaded in the colour of a site while that site does not follow its peers. A
        vertical line marks each change that the sites applied.

        Args:
            axes: Panel of the figure, as Matplotlib axes.
            sites: Names of the sites whose events are marked.
            link: Name of a link, such as "m1->s", to mark only the changes of this link. Empty
                to mark all changes.
            numbered: True to add the number of each change, which the text below the panels
                explains.
        """
        for site in sites:
            self._shade_modes(axes, site)
        for number, applied in self._changes:
            is_other_link = bool(link) and applied.change.link != link
            if applied.site in sites and not is_other_link:
                number_text = str(number) if numbered else ""
                self._mark_change(axes, applied.change.at_s, number_text)

    def _shade_modes(self, axes: Axes, site: str) -> None:
        """Shades a panel in the colour of a site while the site does not follow its peers.

        The shading shows when an arm held its position, braked or returned, for example after a
        network interruption.
        """
        colour = site_colour(self.log, site)
        for mode, from_s, to_s in self._modes[site]:
            axes.axvspan(
                from_s,
                to_s,
                color=colour,
                alpha=_RETURN_ALPHA if mode == "return" else _HOLD_ALPHA,
                linewidth=0.0,
                zorder=0.5,
            )

    def _mark_change(self, axes: Axes, at_s: float, number: str) -> None:
        """Draws a vertical line at the time of a change.

        The changes of a run, such as a new link delay, are numbered and explained below the
        figure.

        Args:
            axes: Panel of the figure, as Matplotlib axes.
            at_s: Time of the change, in s.
            number: Number of the change, as a string. Empty to omit the number.
        """
        axes.axvline(at_s, zorder=0.6, **_CHANGE_LINE)
        if number:
            axes.annotate(
                text=number,
                xy=(at_s, 1.0),
                # x in s, y from 0 to 1 over the height of the panel
                xycoords=axes.get_xaxis_transform(),
                fontsize=self._form.small_pt,
                **_CHANGE_NUMBER,
            )

    def finish(
        self,
        lowest: Sequence[Axes],
        entries: LegendEntries,
        *,
        links: bool = False,
        title: str = "",
    ) -> None:
        """Completes a figure with time axes, a legend, and a note that explains marked changes.

        Functions that draw a figure call this last.

        Args:
            lowest: Bottom panel of each column, which gets a time axis.
            entries: Entries of the legend.
            links: False to explain all setting changes below the panels. True to explain only
                link changes, if the panels mark no others.
            title: Title of the legend. Empty for no title.
        """
        for axes in lowest:
            axes.set_xlabel("time (s)")
            axes.set_xlim(*self._interval_s)
        if title:
            add_legend(self.figure, entries, title=title, title_fontsize=8.0)
        else:
            add_legend(self.figure, entries)
        self._add_footnote(self._explain_changes(links=links), self._explain_shading())

    def _add_footnote(self, *sentences: str) -> None:
        """Writes sentences below the panels, each on a new line. Empty sentences are skipped.

        These can explain, for example, the marked changes and the shaded intervals.
        """
        letters_per_line = int(
            _LETTERS_PER_IN * self.figure.get_figwidth() / self._form.small_pt
        )
        lines: list[str] = []
        for sentence in sentences:
            lines += textwrap.wrap(sentence, letters_per_line)
        if lines:
            self.figure.supxlabel(
                typeset("\n".join(lines)),
                x=0.01,
                ha="left",
                fontsize=self._form.small_pt,
                color=REFERENCE,
            )

    def _explain_changes(self, *, links: bool) -> str:
        """Returns a sentence that explains the numbered change marks in a figure.

        An example of a change is a network delay that differs from a certain time on.

        Args:
            links: True to explain only link changes.

        Returns:
            The sentence. Empty if there are no changes.
        """
        change_texts = []
        for number, applied in self._changes:
            if applied.change.link or not links:
                change_texts.append(f"{number}: {applied.subject} {applied.text}")
        if not change_texts:
            return ""

        listed_texts = change_texts[:MOST_EXPLAINED_CHANGES]
        unlisted_count = len(change_texts) - len(listed_texts)
        if unlisted_count:
            listed_texts.append(f"and {unlisted_count} more")
        return f"Changes: {'; '.join(listed_texts)}"

    def _explain_shading(self) -> str:
        """Returns a sentence that explains the shaded intervals. Empty if nothing is shaded."""
        meanings = set()
        for intervals in self._modes.values():
            meanings |= {interval.meaning for interval in intervals}
        if not meanings:
            return ""

        phrases = []
        for meaning in sorted(meanings):
            shade = " (lighter)" if meaning.mode is Mode.RETURN else ""
            phrases.append(f"{meaning.does}{shade}")
        return f"Shaded in the color of a site: it {', '.join(phrases)}"

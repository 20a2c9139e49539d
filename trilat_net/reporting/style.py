"""Style of all figures: colours per site, line styles, axes, legends, and files that are equal
byte for byte.

Sites beyond the palette differ by dashes. A figure over the time of a run has panels, a line
per site, event markers, time axis and legend.

Invariant: matplotlib's global state stays unchanged. Equal figures give equal bytes: files hold
no date, and fonts are embedded as TrueType. A run without events has figures without markers;
these show hold, brake and return of sites and applied changes.
"""

import base64
import io
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

from ..analysis.site_signals import decimate
from ..analysis.timeline import find_mode_intervals, list_changes, recorded_end_s
from ..core.ticks import Mode
from ..core.vectors import Array
from ..files import write_whole
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from ..scenario.arms import TASK_AXES
from .appearance import REPORT_SIZE, SITE_COLOURS, FigureSize, list_site_colours

AxesGrid = NDArray[np.object_]
LegendEntries = Sequence[tuple[str, dict[str, Any]]]
"""Texts, each with the options of its line."""

DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)))
REFERENCE = "#333333"
FAINT = "#8c8c8c"

LIMIT_LINE: dict[str, Any] = {"color": REFERENCE, "linestyle": (0, (4, 2)), "linewidth": 0.8}
"""The line of what is desired, true, stated or allowed."""

REPORT_DPI = REPORT_SIZE.dpi
_NOTEBOOK_DPI = 200
_LEAST_RANGE = 1e-9
"""Of values; less is rounding."""
BUCKETS_PER_PANEL = 700
"""Per panel: half a page is 700 pixels wide."""

_STYLE_SHEET = resources.files("trilat_net.reporting") / "assets" / "figures.mplstyle"
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
    """Yields an empty figure of a size, to be drawn in the style of all figures; outside,
    nothing changes.
    """
    sizes: Any = {f"{axis}tick.labelsize": form.tick_pt for axis in "xy"}
    with mpl.rc_context({**_RC, **sizes, **(_NARROW_RC if form.narrow else {})}):
        yield NotebookFigure(figsize=(form.width_in, height_in), layout="constrained")


class NotebookFigure(Figure):
    """A figure that shows itself in a notebook, where matplotlib alone prints how large it is."""

    def _repr_png_(self) -> bytes:
        drawing = io.BytesIO()
        with mpl.rc_context(_FILE_RC):
            self.savefig(drawing, format="png", dpi=_NOTEBOOK_DPI, metadata=_UNDATED["png"])
        return drawing.getvalue()

    def _repr_html_(self) -> str:
        # two pixels of the picture for one of the page
        width = round(self.get_figwidth() * _NOTEBOOK_DPI / 2)
        picture = base64.b64encode(self._repr_png_()).decode()
        return f'<img alt="figure" width="{width}" src="data:image/png;base64,{picture}">'


def add_panels(figure: Figure, rows: int, columns: int, **options: Any) -> AxesGrid:
    """Returns the panels of a figure as an array, shape (rows, columns), of `Axes`."""
    grid: AxesGrid = figure.subplots(rows, columns, squeeze=False, **options)
    return grid


def site_colour(log: Log, site: str) -> str:
    """Returns the colour of a site, the same in every figure."""
    return list_site_colours(log.scenario)[log.sites.index(site) % len(SITE_COLOURS)]


def site_line(log: Log, site: str, width: float | None = None) -> dict[str, Any]:
    """Returns the options of a site's line, `width` pt wide, solid until the colours are used
    up.

    Without a width sites share a panel: later ones are thinner, so that lines on top of each
    other all show.
    """
    index = log.sites.index(site)
    width = 2.0 - 1.2 * index / (len(log.sites) - 1) if width is None else width
    dashes = DASHES[index // len(SITE_COLOURS) % len(DASHES)]
    return {"color": site_colour(log, site), "linestyle": dashes, "linewidth": width}


def site_title(log: Log, site: str) -> str:
    """Returns the name of a site in legends: with its role."""
    return f"{site} ({log.scenario.sites[site].role})"


def plot_decimated(axes: Axes, tick: Ints, t_s: Array, values: Array, **options: Any) -> None:
    """Draws values over ticks and their times, s, each of shape (K,), decimated with all
    extremes.
    """
    trace = decimate(tick, t_s, values[:, np.newaxis], BUCKETS_PER_PANEL)
    axes.plot(trace.t_s, trace.values[:, 0], **options)


def positive(values: Array) -> Array:
    """Returns what a logarithmic axis can show of values; NaN for the others."""
    return np.where(values > 0.0, values, np.nan)


SPREAD_BUCKETS = 120
SPREAD: dict[str, Any] = {"color": FAINT, "alpha": 0.35, "linewidth": 6.0}
"""The line that stands for a spread in a legend."""


def plot_spread(axes: Axes, t_s: Array, values: Array, **options: Any) -> None:
    """Draws what is up and down all the time as a median within a band from the least to the
    largest.
    """
    parts = [
        part for part in np.array_split(np.arange(len(values)), SPREAD_BUCKETS) if len(part)
    ]
    at_s = np.array([t_s[part].mean() for part in parts])
    low, middle, high = (
        np.array(
            [
                found(values[part]) if np.isfinite(values[part]).any() else np.nan
                for part in parts
            ]
        )
        for found in (np.nanmin, np.nanmedian, np.nanmax)
    )
    axes.fill_between(
        at_s, low, high, color=options["color"], alpha=SPREAD["alpha"], linewidth=0.0
    )
    axes.plot(at_s, middle, **options)


def set_plain_log_axis(axis: Axis, steps: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Labels a logarithmic axis with plain numbers: these steps of every decade, and no others."""
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(LogLocator(subs=range(1, 10)))
    axis.set_minor_formatter(NullFormatter())


def name_joints(log: Log) -> list[str]:
    """Returns the titles of the joints: numbers, and names if all arms are chains with the same
    ones.
    """
    arms = [log.scenario.arms[site] for site in log.sites]
    most = max(arms, key=lambda arm: arm.counts.joints)
    if most.chain is None or len({arm.joint_names for arm in arms}) > 1:
        return [f"joint {n + 1}" for n in range(most.counts.joints)]
    units = most.joint_units("rad")
    titles = [f"{n}: {name}" for n, name in enumerate(most.joint_names, 1)]
    return [
        title + " (m, N)" * (unit == "m") for title, unit in zip(titles, units, strict=True)
    ]


def name_shared(log: Log) -> list[str]:
    """Returns the titles of what sites share: joints, or axes of the task."""
    arm = log.scenario.arms[log.sites[0]]
    return [*TASK_AXES[: arm.counts.shared]] if arm.shares_pose else name_joints(log)


def title_joints(log: Log, row: Sequence[Axes], titles: Sequence[str] = ()) -> None:
    """Titles panels, one per joint, or with other titles."""
    for title, axes in zip(titles or name_joints(log), row, strict=True):
        axes.set_title(title)


def label_row(axes: Axes, text: str, form: FigureSize) -> None:
    """Writes beside the first panel of a low row what the row shows."""
    axes.set_ylabel("\n".join(textwrap.wrap(text, 12)), fontsize=form.tick_pt)


def flatten_rounding(axes: Axes) -> None:
    """Widens the axis of values that differ by rounding alone."""
    low, high = axes.get_ylim()
    if high - low < _LEAST_RANGE:
        axes.set_ylim(low - 0.05, high + 0.05)


class JointPanels(NamedTuple):
    """Panels of a figure, one per joint in rows of `columns`, the lowest of every column, and a
    wide one.
    """

    joints: list[Axes]
    columns: int
    lowest: list[Axes]
    below: Axes | None


def arrange_joints(joints: int, narrow: bool) -> list[list[str]]:
    """Returns rows of places for a panel per joint: their numbers, and "." for a place that
    stays empty.
    """
    choices = (2,) if narrow or joints == 2 else (3, 4)
    columns = min(choices, key=lambda count: (-(-joints // count), -joints % count))
    places = [str(n) if n < joints else "." for n in range(-(-joints // columns) * columns)]
    return [places[first : first + columns] for first in range(0, len(places), columns)]


def add_joint_panels(
    figure: Figure, joints: int, form: FigureSize, below: str = ""
) -> JointPanels:
    """Returns a panel per joint, and below them a wide one if it has a name.

    Two joints share their axis of values; of more, each has its own, since wrists bear less
    than shoulders.
    """
    grid = arrange_joints(joints, form.narrow)
    columns = len(grid[0])
    rows = [*grid, *([[below] * columns] if below else [])]
    panels: dict[str, Axes] = figure.subplot_mosaic([[*row] for row in rows])
    made = [panels[str(n)] for n in range(joints)]
    for upper, lower in zip(made, made[columns:], strict=False):
        upper.sharex(lower)
        upper.tick_params(labelbottom=False)
    if joints == 2:
        made[1].sharey(made[0])
        made[1].tick_params(labelleft=False)
    return JointPanels(made, columns, made[-columns:], panels.get(below))


def typeset(text: str) -> str:
    """Returns a text of the terminal with the signs that type has."""
    return text.replace("+-", "±").replace("->", " → ")


def typeset_unit(unit: str) -> str:
    """Returns a unit with the signs that type has."""
    return unit.replace("^2", "²")


def typeset_symbol(parameter: str) -> str:
    """Returns the name of a link's parameter with its index below: "mc_x", "Ixx"."""
    stem, index = (
        (parameter[:1], parameter[1:])
        if parameter[0] == "I"
        else (parameter[:2], parameter[3:])
    )
    return f"${stem.strip()}_{{{index}}}$" if index else f"${stem}$"


def add_legend(figure: Figure, entries: LegendEntries, **options: Any) -> None:
    """Puts a legend of lines above the panels, see `place_legend`."""
    place_legend(
        figure, [Line2D([], [], label=text, **line) for text, line in entries], **options
    )


def place_legend(figure: Figure, handles: Sequence[Any], **options: Any) -> None:
    """Puts handles above the panels, where they hide nothing, in as many columns as there is
    room for.
    """
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    for columns in range(min(len(handles), 6), 0, -1):
        made = figure.legend(
            handles=handles, loc="outside upper center", ncols=columns, **options
        )
        if columns == 1 or made.get_window_extent(renderer).width <= figure.bbox.width:
            return
        made.remove()


def site_legend_entries(log: Log, sites: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Returns the entries of a legend of sites."""
    return [(site_title(log, s), site_line(log, s)) for s in sites]


def empty_figure(text: str, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns a figure that consists of a text: why there is nothing to draw."""
    with styled_figure(form, 1.0) as figure:
        lines = "\n".join(textwrap.wrap(text, round(17 * form.width_in)))
        figure.text(0.5, 0.5, lines, ha="center", va="center", color=REFERENCE)
    return figure


def annotate_empty_panel(axes: Axes, text: str) -> None:
    """Writes into an empty panel why it is empty."""
    axes.text(0.5, 0.5, text, ha="center", va="center", color=FAINT, transform=axes.transAxes)


FIGURE_FORMATS = ("pdf", "png", "svg")

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


def write_figure(drawn: Figure, path: Path, dpi: int) -> None:
    """Writes a figure in the format of the path's suffix, of `FIGURE_FORMATS`; `dpi` is that of
    a .png.

    Raises:
        UsageError: it cannot be made.
        LogRefused: the disk refused it.
    """
    drawing = io.BytesIO()
    kind = path.suffix.removeprefix(".").lower()
    with mpl.rc_context(_FILE_RC):
        drawn.savefig(drawing, format=kind, dpi=dpi, metadata=_UNDATED[kind])
    write_whole(path, drawing.getvalue())


MOST_EXPLAINED_CHANGES = 12
"""Changes that a figure explains; the page lists all of them."""

SiteSignal = Callable[[str], tuple[Ints, Array, Array]]
"""Ticks, shape (K,), times, shape (K,), s, and values, shape (K, J), of a site."""

_AWAY = 0.22
_BACK = 0.09
_LETTERS_PER_IN = 120.0
"""Of 1 pt type, on the average."""
_CHANGE: dict[str, Any] = {"color": REFERENCE, "linestyle": (0, (1, 1.5)), "linewidth": 0.7}
_NUMBER: dict[str, Any] = {
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
    """Returns the signal of all sites whose values follow from their records."""
    return lambda site: (log[site].tick, log[site].t_s, values(log[site]))


@contextmanager
def time_figure(log: Log, form: FigureSize, height_in: float) -> Iterator["TimeFigure"]:
    """Yields an empty figure in the style of all figures."""
    with styled_figure(form, height_in) as figure:
        yield TimeFigure(log, form, figure)


class TimeFigure:
    """A figure of a log over time."""

    def __init__(self, log: Log, form: FigureSize, figure: Figure) -> None:
        self.log = log
        self.figure = figure
        self._small_pt = form.small_pt
        self._changes = list(enumerate(list_changes(log), 1))
        self._modes = {site: find_mode_intervals(log[site]) for site in log.sites}

    def trace(
        self, axes: Axes, site: str, values: Array, width: float | None = None, **options: Any
    ) -> None:
        """Draws values over the records of a site, shape (K,); `options` replace those of the
        site's line.
        """
        part = self.log[site]
        line = {**site_line(self.log, site, width), **options}
        plot_decimated(axes, part.tick, part.t_s, values, **line)

    def joint_row(self, row: Sequence[Axes], sites: Sequence[str], signal: SiteSignal) -> None:
        """Draws a signal of sites: a panel per joint, a line per site, markers."""
        for site in sites:
            tick, t_s, values = signal(site)
            for axes, one in zip(row, values.T, strict=False):
                plot_decimated(axes, tick, t_s, one, **site_line(self.log, site))
        for axes in row:
            self.mark(axes, sites)
            if len(row) > 2:
                flatten_rounding(axes)

    def mark(
        self, axes: Axes, sites: Sequence[str], link: str = "", *, numbered: bool = True
    ) -> None:
        """Marks a panel: shaded in the color of a site while it does not follow its peers,
        lines at changes.

        Changes are those that the sites carried out, or of these those of one link.
        """
        for site in sites:
            colour = site_colour(self.log, site)
            for mode, from_s, to_s in self._modes[site]:
                depth = _BACK if mode == "return" else _AWAY
                axes.axvspan(from_s, to_s, color=colour, alpha=depth, linewidth=0.0, zorder=0.5)
        for n, changed in self._changes:
            if changed.site not in sites or (link and changed.change.link != link):
                continue
            at_s = changed.change.at_s
            place = axes.get_xaxis_transform()
            axes.axvline(at_s, zorder=0.6, **_CHANGE)
            if numbered:
                axes.annotate(
                    str(n), (at_s, 1.0), xycoords=place, fontsize=self._small_pt, **_NUMBER
                )

    def finish(
        self,
        lowest: Sequence[Axes],
        entries: LegendEntries,
        *,
        links: bool = False,
        title: str = "",
    ) -> None:
        """Gives the lowest panels their time axis, the figure its legend, and explains its
        markers.

        With `links`, only changes of links are marked; the title stands above the legend.
        """
        for axes in lowest:
            axes.set_xlabel("time (s)")
            axes.set_xlim(0.0, recorded_end_s(self.log))
        add_legend(
            self.figure, entries, **({"title": title, "title_fontsize": 8.0} if title else {})
        )
        marked = [(n, c) for n, c in self._changes if c.change.link or not links]
        words = [f"{n}: {c.subject} {c.text}" for n, c in marked[:MOST_EXPLAINED_CHANGES]]
        if len(marked) > MOST_EXPLAINED_CHANGES:
            words.append(f"and {len(marked) - MOST_EXPLAINED_CHANGES} more")
        letters = int(_LETTERS_PER_IN * self.figure.get_figwidth() / self._small_pt)
        lines = textwrap.wrap(f"Changes: {'; '.join(words)}", letters) if words else []
        modes = {
            interval.meaning for intervals in self._modes.values() for interval in intervals
        }
        if modes:
            told = {
                one: " (lighter)" if one.mode is Mode.RETURN else "" for one in sorted(modes)
            }
            doing = ", ".join(one.does + how for one, how in told.items())
            lines += textwrap.wrap(f"Shaded in the color of a site: it {doing}", letters)
        if lines:
            text = typeset("\n".join(lines))
            self.figure.supxlabel(
                text, x=0.01, ha="left", fontsize=self._small_pt, color=REFERENCE
            )

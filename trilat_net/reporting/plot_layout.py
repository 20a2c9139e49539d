"""Layout of a log's plots in Rerun: pages, a column per site, a row per quantity; saved as a blueprint.

Invariant: a plot has one unit, and every curve a name. Quantities that a log lacks take no space. All
views, names and colors are set here, none by the viewer, so that two logs look alike.
"""

from collections.abc import Iterator, Mapping
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

from ..files import import_extra
from ..log.ros2.cdr import JOINT_STATE, TRANSFORMS
from ..log.ros2.robot_model import WORLD
from ..log.ros2.ros2_messages import EVENTS, FRAMES, LINES, SENT_PREFIX, Ros2Channel

Ros2Channels = Mapping[str, Ros2Channel]


class PlotCurves(NamedTuple):
    """Curves of one channel: where Rerun puts its numbers, their names in order, and which of them show."""

    entity: str
    names: tuple[str, ...]
    shown: tuple[bool, ...]


class CurvePlot(NamedTuple):
    """One plot: its title, with the unit, and its curves."""

    title: str
    curves: tuple[PlotCurves, ...]


PlotPage = list[list[CurvePlot]]
"""Rows of plots."""

_PAGES = {
    "Motion": (
        ("joint angles and reference", "rad", (("joint_states", "position"), ("reference", "position"))),
        ("error", "rad", (("error", ""),)),
        ("torque, and exogenous torque", "N m", (("joint_states", "effort"), ("tau_x", ""))),
    ),
    "Speeds, estimates": (
        ("joint velocities", "rad/s", (("joint_states", "velocity"), ("reference", "velocity"))),
        ("estimate", "kg m^2, kg m", (("theta_hat", ""),)),
        ("estimated masses", "kg", (("theta_hat", "m"),)),
        ("estimated first moments", "kg m", (("theta_hat", "mc"),)),
        ("estimated moments of inertia", "kg m^2", (("theta_hat", "I"),)),
        ("mode: run 1, diverged 2, hold 3, brake 4, return 5", "", (("mode", ""),)),
    ),
    "Links, timing": (
        ("age of samples in use, by peer", "ms", (("link_age", ""),)),
        ("one-way delay, by peer", "ms", (("link_delay", ""),)),
        ("clock offset, by peer", "ms", (("link_offset", ""),)),
        ("largest in 100 ms", "us", (("timing", ""),)),
    ),
}
"""Per page its rows: quantity, unit, and parts: channel, and of joint states one of their lists, of the ten
parameters of each link of a chain one kind."""
_MOST_NAMES = 20
"""Curves that a legend names; of more, the pointer does."""


class PlotLayout(NamedTuple):
    """All pages by name, the topic of the event lines, "" without any, and whether arms are to be seen."""

    pages: dict[str, PlotPage]
    lines: str
    arms: bool = False


def build_plot_layout(channels: Ros2Channels) -> PlotLayout:
    """Returns the plots of standard channels: `<root>/<site>/<name>`, and of the session `<root>/log`."""
    session = [topic for topic in channels if topic.rpartition("/")[2] in (EVENTS, LINES, FRAMES)]
    roots = list(dict.fromkeys(topic.rpartition("/")[0] for topic in channels if topic not in session))
    pages = {
        name: [plots for what in rows if (plots := [*_row(channels, roots, *what)])]
        for name, rows in _PAGES.items()
    }
    sent = {  # in the order in which a law declares it
        name: (channel.about["content"], channel.about["unit"].strip("-"))
        for topic, channel in channels.items()
        if (name := topic.rpartition("/")[2]).startswith(SENT_PREFIX)
    }
    rows = [[*_row(channels, roots, what, unit, ((name, ""),))] for name, (what, unit) in sent.items()]
    pages["Sent by laws"] = rows
    lines = next((topic for topic in session if topic.endswith(f"/{LINES}")), "")
    arms = any(channel.kind == TRANSFORMS for channel in channels.values())
    return PlotLayout({name: page for name, page in pages.items() if page}, lines, arms)


def _row(
    channels: Ros2Channels, roots: list[str], what: str, unit: str, parts: tuple[tuple[str, str], ...]
) -> Iterator[CurvePlot]:
    for root in roots:
        found = [_curves(f"{root}/{name}", field, channels.get(f"{root}/{name}")) for name, field in parts]
        if curves := tuple(one for one in found if one is not None):
            site = root.rpartition("/")[2]
            yield CurvePlot(f"{site}: {what}" + (f" ({unit})" if unit else ""), curves)


def _curves(topic: str, field: str, channel: Ros2Channel | None) -> PlotCurves | None:
    if channel is None:
        return None
    names = _names(channel.about.get("names", ""))
    if topic.endswith("/theta_hat"):
        kinds = [name.rpartition(".")[2].rstrip("xyz_") if "." in name else "" for name in names]
        return PlotCurves(topic, names, tuple(kind == field for kind in kinds)) if field in kinds else None
    if channel.kind != JOINT_STATE:
        prefix = f"{topic.rpartition('/')[2]} " if topic.endswith("/tau_x") else ""
        return PlotCurves(topic, tuple(f"{prefix}{name}" for name in names), (True,) * len(names))
    reference = all(name.endswith("_ref") for name in names) or topic.endswith("/reference")
    if field == "effort" and reference:
        return None
    if reference:
        names = tuple(name.removesuffix("_ref") + "_ref" for name in names)
    shown = tuple(reference or field == "position" or not name.endswith("_ref") for name in names)
    return PlotCurves(f"{topic}/{field}", names, shown)


def _names(text: str) -> tuple[str, ...]:
    """Returns the names of the numbers of an array: all combinations of the names along its dimensions."""
    names = [""]
    for axis in text.split("; "):
        names = [f"{before} {name}".strip() for before in names for name in axis.split(" ")]
    return tuple(names)


_COLORS = [(31, 119, 180), (214, 96, 20), (44, 160, 44), (148, 103, 189), (150, 120, 30)]
_COLORS += [(215, 95, 175), (110, 110, 110)]
_PALE = [(150, 190, 225), (245, 175, 120)]
"""Of references, beside the joints that follow them."""
_TIMELINE = "message_publish_time"


def save_blueprint(board: PlotLayout, application: str, path: Path) -> None:
    """Writes a layout as a blueprint file; `application` is Rerun's name of the recordings that it is for.

    Raises:
        UsageError: Rerun is not installed.
    """
    rrb = import_extra("rerun.blueprint", "view", "viewers")
    pages = [
        rrb.Vertical(*(rrb.Horizontal(*(_view(rrb, plot) for plot in plots)) for plots in page), name=name)
        for name, page in board.pages.items()
    ]
    if board.arms:
        frame = rrb.SpatialInformation(target_frame=WORLD)
        pages.append(rrb.Spatial3DView(name="Arms", origin="/", spatial_information=frame))
    events = [rrb.TextLogView(origin=board.lines, name="events")] if board.lines else []
    blueprint = rrb.Blueprint(
        rrb.Vertical(rrb.Tabs(*pages), *events, row_shares=[6, 1][: 1 + len(events)]),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
    blueprint.save(application, path)


def _view(rrb: Any, plot: CurvePlot) -> Any:
    """Returns a plot; each of its channels has colors of its own."""
    many = max(len(curves.names) for curves in plot.curves) > _MOST_NAMES
    overrides = {curves.entity: _lines(curves, 2 * n) for n, curves in enumerate(plot.curves)}
    return rrb.TimeSeriesView(
        name=plot.title,
        origin="/",
        contents=[curves.entity for curves in plot.curves],
        overrides=overrides,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=False if many else None),
    )


def _lines(curves: PlotCurves, first: int) -> Any:
    """Returns the style of curves, from a color on; references are paler than the joints."""
    rr = import_extra("rerun", "view", "viewers")
    pale, strong = cycle(_PALE), cycle(_COLORS[first:] + _COLORS[:first])
    colors = [next(pale) if name.endswith("_ref") else next(strong) for name in curves.names]
    return rr.SeriesLines(names=list(curves.names), colors=colors, visible_series=list(curves.shown))

"""Display of a log in the Rerun viewer, which the extra `view` installs, in a layout of its
own.

The layout: pages, a column per site, a row per quantity; saved as a blueprint.

Invariant: a finished file with standard channels is opened itself. Any other log is exported as
a ROS 2 bag into a temporary folder first. A plot has one unit, and every curve a name.
Quantities that a log lacks take no space. All views, names and colors are set here, none by the
viewer, so that two logs look alike.
"""

import os
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import cycle, product
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import RunFailed, UsageError
from ..files import import_extra
from ..log.log_layout import ACTIVE_SUFFIX
from ..log.log_reader import Log
from ..log.ros2.cdr import JOINT_STATE, STRING, TRANSFORMS
from ..log.ros2.robot_model import WORLD
from ..log.ros2.ros2_messages import (
    EVENTS,
    FRAMES,
    LINES,
    SENT_PREFIX,
    Ros2Channel,
    read_ros2_channels,
)
from ..log.ros2.topic_names import DIAGNOSTICS
from .exports.ros2 import export_ros2

RunCommand = Callable[[list[str], Mapping[str, str]], int]
"""Runs a command with an environment, and returns its exit code."""

_PROGRAM = (sys.executable, "-m", "rerun")
_OWN = "127.0.0.1"
_QUIET = {"RERUN_ANALYTICS_ENABLED": "false", "RUST_LOG": "warn"}
"""No telemetry, unless the user's own settings ask for it."""


class ViewerOptions(NamedTuple):
    """How to show a log: every record instead of decimated channels, in a browser, or into a
    file, `.rrd`.
    """

    full: bool = False
    web: bool = False
    save: Path | None = None


def open_rerun(
    paths: Sequence[Path],
    opened: Callable[[], Log],
    show: ViewerOptions,
    say: Callable[[str], None],
    run: RunCommand = lambda command, environment: (
        subprocess.run(command, env=environment).returncode
    ),
) -> None:
    """Shows a log in its file or parts, until its viewer is closed.

    The log is opened by `opened` if it has to be read; `say` prints a line, and `run` runs
    Rerun.

    Raises:
        UsageError: Rerun is not installed, or there is no display.
        LogError: the log cannot be read.
        RunFailed: Rerun ended badly.
    """
    import_extra("rerun", "view", "viewers")
    displays = {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}
    if show.save is None and not show.web and sys.platform == "linux" and not displays:
        raise UsageError(
            "there is no display here; show it in a browser with --web, or keep it with --save"
        )
    with tempfile.TemporaryDirectory(prefix="trilat-view-") as folder:
        path = paths[0]
        named = Path(folder) / f"{make_application_id(paths[0])}.mcap"
        if show.full or len(paths) > 1 or not read_ros2_channels(path):
            say("making standard channels of every record ...")
            export_ros2(opened(), named)
            path = named
        elif path.name != named.name:
            named.symlink_to(path.resolve())
            path = named
        layout = Path(folder) / "layout.rbl"
        save_blueprint(build_plot_layout(read_ros2_channels(path)), path.stem, layout)
        for command in _commands(show, path, layout, say):
            if code := run([*_PROGRAM, *command], {**_QUIET, **os.environ}):
                raise RunFailed(f"Rerun ended with exit code {code}")


def make_application_id(path: Path) -> str:
    """Returns the name of a log in the letters that Rerun allows for an application."""
    stem = path.name.removesuffix(ACTIVE_SUFFIX).removesuffix(".mcap")
    return re.sub(r"[^A-Za-z0-9_-]", "-", stem).lstrip("-") or "log"


def _commands(
    show: ViewerOptions, log: Path, layout: Path, say: Callable[[str], None]
) -> list[list[str]]:
    """Returns the arguments of one call of Rerun after the other; it listens on this machine
    alone.
    """
    if show.save is not None:
        # Rerun's own `--save` of several files ends with the first that was read; the rest of the others is
        # missing (measured with 0.41: up to all of a log)
        recording = layout.with_name("log.rrd")
        return [
            [
                "mcap",
                "convert",
                str(log),
                "--application-id",
                log.stem,
                "--output",
                str(recording),
            ],
            ["rrd", "merge", str(recording), str(layout), "--output", str(show.save)],
        ]
    port = _free_port()
    command = [str(log), str(layout), "--bind", _OWN, "--port", str(port)]
    if show.web:
        page = _free_port()
        say(
            f"open http://{_OWN}:{page}/?url=rerun%2Bhttp%3A%2F%2F{_OWN}%3A{port}%2Fproxy; Ctrl-C ends it"
        )
        return [[*command, "--serve-web", "--web-viewer-port", str(page)]]
    return [command]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_OWN, 0))
        port: int = probe.getsockname()[1]
        return port


Ros2Channels = Mapping[str, Ros2Channel]
_SESSION_TOPICS = (EVENTS, LINES, FRAMES, DIAGNOSTICS)
"""Last parts of the names of topics that are of no site."""


class PlotCurves(NamedTuple):
    """Curves of one channel: where Rerun puts its numbers, their names in order, and which of
    them show.
    """

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
        (
            "joint angles and reference",
            "rad",
            (("joint_states", "position"), ("reference", "position")),
        ),
        ("error", "rad", (("error", ""),)),
        ("torque, and exogenous torque", "N m", (("joint_states", "effort"), ("tau_x", ""))),
    ),
    "Speeds, estimates": (
        (
            "joint velocities",
            "rad/s",
            (("joint_states", "velocity"), ("reference", "velocity")),
        ),
        ("estimate", "kg m^2, kg m", (("theta_hat", ""),)),
        ("estimated masses", "kg", (("theta_hat", "m"),)),
        ("estimated first moments", "kg m", (("theta_hat", "mc"),)),
        ("estimated moments of inertia", "kg m^2", (("theta_hat", "I"),)),
        (
            "mode: run 1, diverged 2, hold 3, brake 4, return 5",
            "",
            (("mode", ""), ("mode_number", "")),
        ),
    ),
    "Links, timing": (
        ("age of samples in use, by peer", "ms", (("link_age", ""),)),
        ("one-way delay, by peer", "ms", (("link_delay", ""),)),
        ("clock offset, by peer", "ms", (("link_offset", ""),)),
        ("largest in 100 ms", "us", (("timing", ""),)),
    ),
}
"""Per page its rows: quantity, unit, and parts: channel, and of joint states one of their
lists, of the ten parameters of each link of a chain one kind.
"""
_MOST_NAMES = 20
"""Curves that a legend names; of more, the pointer does."""


class PlotLayout(NamedTuple):
    """All pages by name, the topic of the event lines, "" without any, and whether arms are to
    be seen.
    """

    pages: dict[str, PlotPage]
    lines: str
    arms: bool = False


def build_plot_layout(channels: Ros2Channels) -> PlotLayout:
    """Returns the plots of standard channels: `<root>/<site>/<name>`, and of the session
    `<root>/log`.
    """
    session = [topic for topic in channels if topic.rpartition("/")[2] in _SESSION_TOPICS]
    roots = list(
        dict.fromkeys(topic.rpartition("/")[0] for topic in channels if topic not in session)
    )
    pages = {
        name: [plots for what in rows if (plots := [*_row(channels, roots, *what)])]
        for name, rows in _PAGES.items()
    }
    sent = {  # in the order in which a law declares it
        name: (channel.about["content"], channel.about["unit"].strip("-"))
        for topic, channel in channels.items()
        if (name := topic.rpartition("/")[2]).startswith(SENT_PREFIX)
    }
    rows = [
        [*_row(channels=channels, roots=roots, what=what, unit=unit, parts=((name, ""),))]
        for name, (what, unit) in sent.items()
    ]
    pages["Sent by laws"] = rows
    lines = next((topic for topic in session if topic.endswith(f"/{LINES}")), "")
    arms = any(channel.kind == TRANSFORMS for channel in channels.values())
    return PlotLayout({name: page for name, page in pages.items() if page}, lines, arms)


def _row(
    channels: Ros2Channels,
    roots: list[str],
    what: str,
    unit: str,
    parts: tuple[tuple[str, str], ...],
) -> Iterator[CurvePlot]:
    for root in roots:
        found = [
            _curves(f"{root}/{name}", field, channels.get(f"{root}/{name}"))
            for name, field in parts
        ]
        if curves := tuple(one for one in found if one is not None):
            site = root.rpartition("/")[2]
            yield CurvePlot(f"{site}: {what}" + (f" ({unit})" if unit else ""), curves)


def _curves(topic: str, field: str, channel: Ros2Channel | None) -> PlotCurves | None:
    if channel is None or channel.kind == STRING:
        return None
    axes = (axis.split(" ") for axis in channel.about.get("names", "").split("; "))
    names = tuple(" ".join(filter(None, one)) for one in product(*axes))
    if topic.endswith("/theta_hat"):
        kinds = [
            name.rpartition(".")[2].rstrip("xyz_") if "." in name else "" for name in names
        ]
        return (
            PlotCurves(topic, names, tuple(kind == field for kind in kinds))
            if field in kinds
            else None
        )
    if channel.kind != JOINT_STATE:
        prefix = f"{topic.rpartition('/')[2]} " if topic.endswith("/tau_x") else ""
        return PlotCurves(
            topic, tuple(f"{prefix}{name}" for name in names), (True,) * len(names)
        )
    reference = all(name.endswith("_ref") for name in names) or topic.endswith("/reference")
    if field == "effort" and reference:
        return None
    if reference:
        names = tuple(name.removesuffix("_ref") + "_ref" for name in names)
    shown = tuple(
        reference or field == "position" or not name.endswith("_ref") for name in names
    )
    return PlotCurves(f"{topic}/{field}", names, shown)


_COLORS = [(31, 119, 180), (214, 96, 20), (44, 160, 44), (148, 103, 189), (150, 120, 30)]
_COLORS += [(215, 95, 175), (110, 110, 110)]
_PALE = [(150, 190, 225), (245, 175, 120)]
"""Of references, beside the joints that follow them."""
_TIMELINE = "message_publish_time"


def save_blueprint(board: PlotLayout, application: str, path: Path) -> None:
    """Writes a layout as a blueprint file; `application` is Rerun's name of the recordings that
    it is for.

    Raises:
        UsageError: Rerun is not installed.
    """
    rrb = import_extra("rerun.blueprint", "view", "viewers")
    pages = [
        rrb.Vertical(
            *(rrb.Horizontal(*(_view(rrb, plot) for plot in plots)) for plots in page),
            name=name,
        )
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
        plot_legend=rrb.PlotLegend(
            corner=rrb.Corner2D.RightTop, visible=False if many else None
        ),
    )


def _lines(curves: PlotCurves, first: int) -> Any:
    """Returns the style of curves, from a color on; references are paler than the joints."""
    rr = import_extra("rerun", "view", "viewers")
    pale = cycle(_PALE)
    strong = cycle(_COLORS[first:] + _COLORS[:first])
    colors = [next(pale) if name.endswith("_ref") else next(strong) for name in curves.names]
    return rr.SeriesLines(
        names=list(curves.names), colors=colors, visible_series=list(curves.shown)
    )

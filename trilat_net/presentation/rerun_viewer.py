"""Shows a log in Rerun, an interactive viewer for plots and 3D scenes.

Rerun reads the data of a log from its MCAP file, from channels with standard ROS 2 messages,
and the layout of its views from another file, the "blueprint". `open_rerun` prepares both files
and starts Rerun. The layout consists of pages of plots, with one column per arm and one row per
quantity. Rerun is installed by the extra `view` of this package.

Invariant:
    - A finished log with standard channels is opened as is. Any other log is first exported as
      a ROS 2 bag to a temporary folder.
    - All curves of a plot have the same unit, and every curve has a name.
    - Quantities that are not in the log take up no space.
    - All views, names and colours are set here rather than by the viewer, so that all logs look
      alike.
"""

import os
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import RunFailed, UsageError
from ..files import Extra
from ..log import ACTIVE_SUFFIX, Log
from ..log.ros2 import (
    DIAGNOSTICS,
    EVENTS,
    FRAMES,
    JOINT_STATE,
    LINES,
    SENT_PREFIX,
    STRING,
    TRANSFORMS,
    WORLD,
    Ros2Channels,
    Ros2Topics,
)
from .export import Exporter

RunCommand = Callable[[list[str], Mapping[str, str]], int]
"""Function that runs a command with the given environment and returns the exit code."""

_EXTRA = Extra("view", "viewers")
_PROGRAM = (sys.executable, "-m", "rerun")
_LOOPBACK = "127.0.0.1"
_QUIET_ENVIRONMENT = {"RERUN_ANALYTICS_ENABLED": "false", "RUST_LOG": "warn"}
"""Environment variables that turn off telemetry, unless the user has set them."""


class ViewerOptions(NamedTuple):
    """Options of the command that shows a log in Rerun.

    Attributes:
        full: True to show every record instead of the decimated standard channels.
        web: True to serve the viewer to a browser.
        save: Path of an .rrd file to write instead of opening the viewer. `None` to open the
            viewer.
    """

    full: bool = False
    web: bool = False
    save: Path | None = None


def _run_process(command: list[str], environment: Mapping[str, str]) -> int:
    """Runs a command and returns its exit code."""
    return subprocess.run(command, env=environment).returncode


def open_rerun(
    paths: Sequence[Path],
    read_log: Callable[[], Log],
    options: ViewerOptions,
    print_line: Callable[[str], None],
    run_command: RunCommand = _run_process,
) -> None:
    """Shows a log in Rerun, and returns when the user closes the viewer.

    Args:
        paths: File of the log, or its parts.
        read_log: Function that reads the log. It is called only if the log must be exported.
        options: Options for showing the log.
        print_line: Function that prints a line for the user.
        run_command: Function that runs Rerun.

    Raises:
        UsageError: Rerun is not installed, or there is no display.
        LogError: The log cannot be read.
        RunFailed: Rerun exited with an error.
    """
    _EXTRA.import_module("rerun")
    _require_display(options)
    with tempfile.TemporaryDirectory(prefix="trilat-view-") as folder:
        path = paths[0]
        # Rerun names a recording after its file, and the layout must name the same recording.
        # Therefore the file has a name that Rerun does not change.
        named_path = Path(folder) / f"{make_application_id(path)}.mcap"
        has_several_parts = len(paths) > 1
        must_export = options.full or has_several_parts or not Ros2Topics.of_file(path)
        if must_export:
            print_line("making standard channels of every record ...")
            Exporter("ros2", named_path).export(read_log())
            path = named_path
        elif path.name != named_path.name:
            named_path.symlink_to(path.resolve())
            path = named_path

        layout = PlotLayout.of_channels(Ros2Topics.of_file(path))
        layout_path = Path(folder) / "layout.rbl"
        _save_blueprint(layout, path.stem, layout_path)
        environment = {**_QUIET_ENVIRONMENT, **os.environ}
        for arguments in _list_commands(options, path, layout_path, print_line):
            exit_code = run_command([*_PROGRAM, *arguments], environment)
            if exit_code:
                raise RunFailed(f"Rerun ended with exit code {exit_code}")


def _require_display(options: ViewerOptions) -> None:
    """Raises UsageError if Rerun would open a window but the machine has no display.

    Without a display, Rerun itself fails with an obscure message.

    Raises:
        UsageError: There is no display.
    """
    opens_window = options.save is None and not options.web
    has_display = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if opens_window and sys.platform == "linux" and not has_display:
        raise UsageError(
            "there is no display here; show the log in a browser with --web, or write a file "
            "for another machine with --save"
        )


def make_application_id(path: Path) -> str:
    """Returns the name under which Rerun stores the layout of a log.

    This is the name of the log, restricted to the characters that Rerun allows.

    Args:
        path: Path of the log.
    """
    stem = path.name.removesuffix(ACTIVE_SUFFIX).removesuffix(".mcap")
    return re.sub(r"[^A-Za-z0-9_-]", "-", stem).lstrip("-") or "log"


def _list_commands(
    options: ViewerOptions, log: Path, layout: Path, print_line: Callable[[str], None]
) -> list[list[str]]:
    """Returns the argument lists of the Rerun calls that show or save a log, in order.

    The viewer accepts connections from this machine only. If the log is shown in a browser, the
    address of the page is printed.

    Args:
        options: Options for showing the log.
        log: File of the log.
        layout: File of the layout.
        print_line: Function that prints a line for the user.
    """
    if options.save is not None:
        return _list_save_commands(log, layout, options.save)

    port = str(_find_free_port())
    command = [str(log), str(layout), "--bind", _LOOPBACK, "--port", port]
    if not options.web:
        return [command]

    page_port = str(_find_free_port())
    # The URL of the page contains the source of the data, percent-encoded.
    data_address = f"rerun%2Bhttp%3A%2F%2F{_LOOPBACK}%3A{port}%2Fproxy"
    page_address = f"http://{_LOOPBACK}:{page_port}/?url={data_address}"
    print_line(f"open {page_address}; Ctrl-C ends it")
    return [[*command, "--serve-web", "--web-viewer-port", page_port]]


def _list_save_commands(log: Path, layout: Path, output: Path) -> list[list[str]]:
    """Returns the argument lists of two Rerun calls that write log and layout to one file."""
    # Rerun's own `--save` of several files stops when the end of one file is reached, and drops
    # the rest of the others (measured with Rerun 0.41: up to the whole log).
    recording = str(layout.with_name("log.rrd"))
    convert = ["mcap", "convert", str(log), "--application-id", log.stem]
    merge = ["rrd", "merge", recording, str(layout)]
    return [[*convert, "--output", recording], [*merge, "--output", str(output)]]


def _find_free_port() -> int:
    """Returns a TCP port of this machine that is currently free."""
    with socket.socket() as probe:
        probe.bind((_LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port


_SESSION_CHANNELS = (EVENTS, LINES, FRAMES, DIAGNOSTICS)
"""Names (last parts of the topics) of session channels, which do not belong to a site."""


class _PlotCurves(NamedTuple):
    """Curves of a Rerun plot, which show the values of one channel.

    A channel is a series of messages with a topic.

    Attributes:
        entity: Path under which Rerun stores the values of the channel.
        names: Names of all values in a message, in order.
        visible: For each value, True if the plot shows its curve.
    """

    entity: str
    names: tuple[str, ...]
    visible: tuple[bool, ...]


class CurvePlot(NamedTuple):
    """A plot of one quantity of one site over time, on a page of the viewer.

    An example is the plot of the joint angles of m1, with the actual and the desired curves.

    Attributes:
        title: Title of the plot, with its unit.
        curves: Curves of each channel in the plot.
    """

    title: str
    curves: tuple[_PlotCurves, ...]


PlotPage = list[list[CurvePlot]]
"""Rows of plots."""


class PlotLayout(NamedTuple):
    """Layout in which a viewer shows a log: pages with plots, and a 3D view of the arms.

    Attributes:
        pages: Mapping from the name of each page to its rows of plots.
        lines: Topic of the event messages. Empty if the log has no such topic.
        arms: True to include the 3D view of the arms.
    """

    pages: dict[str, PlotPage]
    lines: str
    arms: bool = False

    @classmethod
    def of_channels(cls, channels: Ros2Channels) -> "PlotLayout":
        """Arranges the channels (series of messages) of a log as plots on pages of the viewer.

        A page has one row of plots per quantity, with one plot per arm. Pages and rows without
        any curves are omitted.

        Args:
            channels: Mapping from topic to standard channel. Topics of sites are
                `<root>/<site>/<name>`; `<root>/log` is an example of a session topic.
        """
        session_topics = [
            topic for topic in channels if _get_channel_name(topic) in _SESSION_CHANNELS
        ]
        # A dictionary instead of a set keeps the order of the sites.
        site_roots: dict[str, None] = {}
        for topic in channels:
            if topic not in session_topics:
                site_roots[topic.rpartition("/")[0]] = None

        rows_by_page = {**_PAGES, "Sent by laws": _list_sent_rows(channels)}
        pages = {}
        for name, rows in rows_by_page.items():
            plots_by_row = [_build_row(channels, list(site_roots), row) for row in rows]
            page = [row_plots for row_plots in plots_by_row if row_plots]
            if page:
                pages[name] = page

        line_topics = [topic for topic in session_topics if topic.endswith(f"/{LINES}")]
        lines = line_topics[0] if line_topics else ""
        has_arms = any(channel.kind == TRANSFORMS for channel in channels.values())
        return cls(pages, lines, has_arms)


class _PlotRow(NamedTuple):
    """A row of plots on a page of the viewer: one quantity, with one plot per arm.

    Attributes:
        quantity: Name of the quantity.
        unit: Unit of the quantity. Empty for a dimensionless number.
        sources: Channels of the quantity, each given as a channel name (the last part of its
            topic) and a field. For joint states, the field is the name of one of their lists.
            For estimates, it is a kind of inertial parameter, such as "m", or empty for planar
            arms. For other channels it is empty.
    """

    quantity: str
    unit: str
    sources: tuple[tuple[str, str], ...]


_PAGES: dict[str, tuple[_PlotRow, ...]] = {
    "Motion": (
        _PlotRow(
            quantity="joint angles and reference",
            unit="rad",
            sources=(("joint_states", "position"), ("reference", "position")),
        ),
        _PlotRow("error", "rad", (("error", ""),)),
        _PlotRow(
            quantity="torque, and exogenous torque",
            unit="N m",
            sources=(("joint_states", "effort"), ("tau_x", "")),
        ),
    ),
    "Speeds, estimates": (
        _PlotRow(
            quantity="joint velocities",
            unit="rad/s",
            sources=(("joint_states", "velocity"), ("reference", "velocity")),
        ),
        _PlotRow("estimate", "kg m^2, kg m", (("theta_hat", ""),)),
        _PlotRow("estimated masses", "kg", (("theta_hat", "m"),)),
        _PlotRow("estimated first moments", "kg m", (("theta_hat", "mc"),)),
        _PlotRow("estimated moments of inertia", "kg m^2", (("theta_hat", "I"),)),
        _PlotRow(
            quantity="mode: run 1, diverged 2, hold 3, brake 4, return 5",
            unit="",
            sources=(("mode", ""), ("mode_number", "")),
        ),
    ),
    "Links, timing": (
        _PlotRow("age of samples in use, by peer", "ms", (("link_age", ""),)),
        _PlotRow("one-way delay, by peer", "ms", (("link_delay", ""),)),
        _PlotRow("clock offset, by peer", "ms", (("link_offset", ""),)),
        _PlotRow("largest in 100 ms", "us", (("timing", ""),)),
    ),
}
"""The rows of each page."""
_MAX_LEGEND_NAMES = 20
"""Maximum number of curves in a legend. If there are more, names are shown only under the
pointer.
"""


def _get_channel_name(topic: str) -> str:
    """Returns the last part of a topic, which is the name of its channel."""
    return topic.rpartition("/")[2]


def _list_sent_rows(channels: Ros2Channels) -> tuple[_PlotRow, ...]:
    """Returns a row of plots for each quantity that control laws send to other arms.

    The rows are in the order in which the laws declare the quantities. The channel metadata
    contain the name and unit of the quantity.
    """
    rows = {}
    for topic, channel in channels.items():
        name = _get_channel_name(topic)
        if name.startswith(SENT_PREFIX):
            quantity = channel.about["content"]
            unit = channel.about["unit"].strip("-")
            rows[name] = _PlotRow(quantity, unit, ((name, ""),))
    return tuple(rows.values())


def _build_row(channels: Ros2Channels, roots: Sequence[str], row: _PlotRow) -> list[CurvePlot]:
    """Returns the plots of one quantity, such as the joint angles, one per arm.

    Args:
        channels: Mapping from topic to standard channel.
        roots: Prefixes of the sites' topics, up to the channel name.
        row: The quantity, and the channels that contain it.
    """
    plots = []
    for root in roots:
        curves = []
        for name, field in row.sources:
            topic = f"{root}/{name}"
            selected_curves = _select_curves(channels, topic, field)
            if selected_curves is not None:
                curves.append(selected_curves)

        if curves:
            title = f"{_get_channel_name(root)}: {row.quantity}"
            if row.unit:
                title += f" ({row.unit})"
            plots.append(CurvePlot(title, tuple(curves)))
    return plots


def _select_curves(channels: Ros2Channels, topic: str, field: str) -> _PlotCurves | None:
    """Returns the curves of a channel that belong to a quantity.

    Messages of a channel contain a list of numbers, such as the angles of all joints, of which
    a plot may need only some.

    Args:
        channels: Mapping from topic to standard channel.
        topic: Topic of the channel.
        field: Field of the channel, see `_PlotRow`.

    Returns:
        The curves. `None` if there is no such channel, or if it has no such curves.
    """
    channel = channels.get(topic)
    if channel is None or channel.kind == STRING:
        return None

    names = channel.name_numbers()
    channel_name = _get_channel_name(topic)
    if channel_name == "theta_hat":
        return _select_estimates(topic, field, names)
    if channel.kind == JOINT_STATE:
        return _select_joint_states(topic, field, names)

    if channel_name == "tau_x":
        # This quantity shares a plot with the torque of the same joints.
        names = [f"tau_x {name}" for name in names]
    all_visible = (True,) * len(names)
    return _PlotCurves(topic, tuple(names), all_visible)


def _select_estimates(topic: str, kind: str, names: Sequence[str]) -> _PlotCurves | None:
    """Returns the curves of the estimates of one kind of inertial parameter.

    Adaptive control laws estimate the inertial parameters of the arm, such as masses and
    inertias. A plot shows a single kind, because units differ between kinds.

    Args:
        topic: Topic of the channel.
        kind: Kind of parameter, such as "m" for the masses. Empty for planar arms.
        names: Names of all estimates, such as "upper.m" for the mass of the link "upper".

    Returns:
        The curves. `None` if the channel has no estimates of this kind.
    """
    visible = []
    for name in names:
        _, dot, parameter = name.rpartition(".")
        # The parameters of planar arms have neither a link nor a kind in their names.
        parameter_kind = parameter.rstrip("xyz_") if dot else ""
        visible.append(parameter_kind == kind)
    if not any(visible):
        return None
    return _PlotCurves(topic, tuple(names), tuple(visible))


def _select_joint_states(topic: str, field: str, names: Sequence[str]) -> _PlotCurves | None:
    """Returns the curves of the positions, velocities or torques of joints.

    The messages of a channel contain the states of the joints, those of the reference that the
    joints follow, or both. References are recognised by the suffix "_ref" of their names, or by
    the topic ".../reference". In the viewer, their curves always have the suffix, which gives
    them a paler colour. If a channel contains both, the reference is shown only for positions.

    Args:
        topic: Topic of the channel.
        field: Name of the list: "position", "velocity" or "effort".
        names: Names of all joints. If there are no names, the channel is treated as a
            reference.

    Returns:
        The curves. `None` for the torques of a reference, which do not exist.
    """
    suffix = "_ref"
    has_only_reference_names = all(name.endswith(suffix) for name in names)
    is_only_reference = has_only_reference_names or topic.endswith("/reference")
    if is_only_reference and field == "effort":
        return None

    if is_only_reference:
        # The names in a channel ".../reference" may lack the suffix.
        names = [name.removesuffix(suffix) + suffix for name in names]
    shows_references = is_only_reference or field == "position"
    visible = [shows_references or not name.endswith(suffix) for name in names]
    return _PlotCurves(f"{topic}/{field}", tuple(names), tuple(visible))


_COLORS = [
    (31, 119, 180),
    (214, 96, 20),
    (44, 160, 44),
    (148, 103, 189),
    (150, 120, 30),
    (215, 95, 175),
    (110, 110, 110),
]
_PALE_COLORS = [(150, 190, 225), (245, 175, 120)]
"""Colours of references, which are paler than those of the joints that follow them."""
_TIMELINE = "message_publish_time"


def _save_blueprint(layout: PlotLayout, application: str, path: Path) -> None:
    """Writes the layout of a log to a Rerun blueprint file.

    The blueprint tells the viewer which plots and views to arrange on the screen.

    Args:
        layout: The plots on each page, and the other views.
        application: Rerun's name for the recordings to which the layout applies.
        path: The file to write.

    Raises:
        UsageError: Rerun is not installed.
    """
    rrb = _EXTRA.import_module("rerun.blueprint")
    views = []
    for name, page in layout.pages.items():
        rows = []
        for plots in page:
            plot_views = [_make_plot_view(rrb, plot) for plot in plots]
            rows.append(rrb.Horizontal(*plot_views))
        views.append(rrb.Vertical(*rows, name=name))
    if layout.arms:
        frame = rrb.SpatialInformation(target_frame=WORLD)
        arms_view = rrb.Spatial3DView(name="Arms", origin="/", spatial_information=frame)
        views.append(arms_view)

    parts = [rrb.Tabs(*views)]
    if layout.lines:
        parts.append(rrb.TextLogView(origin=layout.lines, name="events"))
    relative_heights = [6, 1]  # the events need far less space than the plots
    blueprint = rrb.Blueprint(
        rrb.Vertical(*parts, row_shares=relative_heights[: len(parts)]),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
    blueprint.save(application, path)


def _make_plot_view(rrb: Any, plot: CurvePlot) -> Any:
    """Returns a Rerun view of a plot, in which each channel has its own colours.

    A legend with too many names would cover the curves, and is hidden.
    """
    styles_by_channel = {}
    for index, curves in enumerate(plot.curves):
        styles_by_channel[curves.entity] = _style_curves(curves, first_color=2 * index)
    longest_legend = max(len(curves.names) for curves in plot.curves)
    legend = rrb.PlotLegend(
        corner=rrb.Corner2D.RightTop,
        visible=False if longest_legend > _MAX_LEGEND_NAMES else None,
    )
    return rrb.TimeSeriesView(
        name=plot.title,
        origin="/",
        contents=[curves.entity for curves in plot.curves],
        overrides=styles_by_channel,
        plot_legend=legend,
    )


def _style_curves(curves: _PlotCurves, first_color: int) -> Any:
    """Returns the names and colours of the curves in a plot. References have pale colours.

    Args:
        curves: The curves.
        first_color: Colour index of the first curve. Further curves use the next colours.
    """
    rr = _EXTRA.import_module("rerun")
    pale_palette = cycle(_PALE_COLORS)
    strong_palette = cycle(_COLORS[first_color:] + _COLORS[:first_color])
    colors = []
    for name in curves.names:
        palette = pale_palette if name.endswith("_ref") else strong_palette
        colors.append(next(palette))
    return rr.SeriesLines(
        names=list(curves.names), colors=colors, visible_series=list(curves.visible)
    )

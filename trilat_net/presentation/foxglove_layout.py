"""Writes the layout in which Foxglove and Lichtblick, two viewers for robot data, show a log.

The layout is a JSON file next to the log, which the user imports into the viewer. It also works
for a ROS 2 bag exported from the log. It defines which panels are shown, and which fields of
which topics they plot: the plots of the Rerun layout (`rerun_viewer.PlotLayout`), the modes of
the arms' controllers, the events, and the arms in space.

The live ROS 2 bridge and exported bags use different topics than logs do. The layout of a log
therefore has two tabs: one for the log itself, and one for a running session of the same
scenario, which the viewer accesses over ROS 2.

Invariant:
    - Each message path in the layout refers to a field that exists in the file or in the topics
      of the live bridge.
    - Panels without data take up no space.
    - Equal channels produce byte-identical layouts.
    - An existing file is replaced only with `force`.

The file has the format that the viewers themselves export: `configById` maps panel identifiers
to settings, and `layout` is a binary tree of identifiers. Viewers ignore settings that they do
not know.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import UsageError
from ..files import refuse_existing, write_whole
from ..log import open_log
from ..log.ros2 import (
    FLOAT64_ARRAY,
    NUMBERS_BY_MODE_WORD,
    POSE,
    SPACING_M,
    STRING,
    WORLD,
    Ros2Channels,
    Ros2Topics,
)
from .rerun_viewer import CurvePlot, PlotLayout

_LAYOUT_SUFFIX = ".foxglove.json"
"""Suffix of a layout file, which replaces the suffix of the log."""
_MODE = "mode"
"""Name of the topic that contains the mode of a site."""
_MODE_NUMBERS = (_MODE, "mode_number")
"""Names of the topics that contain mode numbers, which are shown in a special kind of panel."""
_PLOTS_PERCENT = 75.0
"""Height of the plots, which are above modes and events, as a percentage of the total height.
"""
_MODES_PERCENT = 60.0
"""Width of the modes, which are beside the events, as a percentage of the total width."""
_TITLE_KEYS = ("foxglovePanelTitle", "lichtblickPanelTitle")
"""Settings that contain the title of a panel, one per viewer."""

JsonObject = dict[str, Any]
Tree = str | JsonObject
"""Identifier of a panel, or a node that splits an area in two."""


def write_foxglove_layout(log: Path, *, force: bool = False) -> Path:
    """Writes a layout with which the viewers Foxglove and Lichtblick show a log or a ROS bag.

    With this layout, the viewer shows plots of all sites without any manual arrangement.

    Args:
        log: File of the log or ROS bag.
        force: True to replace an existing file.

    Returns:
        The path of the layout file, which is in the same folder as the log.

    Raises:
        UsageError: The file contains no channels for viewers, or the layout already exists.
        LogError: The log cannot be read.
    """
    path = log.with_suffix(_LAYOUT_SUFFIX)
    refuse_existing(path, force=force)
    channels = Ros2Topics.of_file(log)
    if not PlotLayout.of_channels(channels).pages:
        raise UsageError(
            f"{log}: there is nothing to plot, because the file is not finished or was written "
            f"with --views off; write a file for viewers with `trilat log export {log} --to "
            "ros2`, and name that file instead"
        )

    sources = {"ROS 2": channels}
    if channels.are_of_log:
        sources = {"Log": channels, "ROS 2": Ros2Topics.of_log(open_log(log))}
    layout = _build_layout(sources)
    write_whole(path, json.dumps(layout, indent=1) + "\n", force=force)
    return path


def _build_layout(sources: Mapping[str, Ros2Channels]) -> JsonObject:
    """Returns a Foxglove layout that shows the channels of a log or of a running session.

    Foxglove opens the layout from a file.

    Args:
        sources: For each data source, its standard channels by topic. If there are several
            sources, each has a tab titled with the name of the source.

    Returns:
        The layout as plain JSON values.
    """
    panels = _Panels()
    trees = {name: _arrange_source(panels, channels) for name, channels in sources.items()}
    tree = panels.add_tabs(trees) if len(trees) > 1 else next(iter(trees.values()))
    return {
        "configById": panels.settings,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": tree,
    }


class _Panels:
    """Collects the panels of a Foxglove layout and assigns an identifier to each.

    The layout file refers to panels through these identifiers.

    Attributes:
        settings: Mapping from panel identifier to the settings of the panel.
    """

    def __init__(self) -> None:
        self.settings: dict[str, JsonObject] = {}

    def add(self, kind: str, settings: JsonObject, title: str = "") -> str:
        """Adds a panel, such as a plot, to the Foxglove layout.

        Args:
            kind: Type of the panel, such as "Plot".
            settings: Settings of the panel.
            title: Title of the panel. Empty for the default title.

        Returns:
            The identifier of the panel.
        """
        identifier = f"{kind}!{len(self.settings) + 1}"
        title_settings = dict.fromkeys(_TITLE_KEYS, title) if title else {}
        self.settings[identifier] = {**title_settings, **settings}
        return identifier

    def add_tabs(self, trees: Mapping[str, Tree]) -> str:
        """Adds a panel with tabs, each of which contains other panels, to the layout.

        Args:
            trees: Mapping from the title of each tab to its contents.

        Returns:
            The identifier of the panel.
        """
        tabs = [{"title": title, "layout": tree} for title, tree in trees.items()]
        return self.add("Tab", {"activeTabIdx": 0, "tabs": tabs})


def _arrange_source(panels: _Panels, channels: Ros2Channels) -> Tree:
    """Arranges the data of one log or session: tabs of plots and arms, above modes and events.

    A mode, for example "resting", is what the controller of an arm is doing. Areas without data
    are omitted.
    """
    layout = PlotLayout.of_channels(channels)
    tabs: dict[str, Tree] = {}
    for name, page in layout.pages.items():
        rows = []
        for plots in page:
            plots_in_row = [
                _add_plot(panels, channels, plot) for plot in plots if not _is_mode(plot)
            ]
            if plots_in_row:
                rows.append(_divide("row", plots_in_row))
        if rows:
            tabs[name] = _divide("column", rows)
    if layout.arms:
        tabs["Arms"] = _add_arms(panels, channels)

    # Panels without data have an empty identifier.
    candidates = (_add_modes(panels, channels), _add_events(panels, layout))
    lower_panels = [tree for tree in candidates if tree]
    upper_area = panels.add_tabs(tabs)
    if not lower_panels:
        return upper_area

    lower_area = _divide("row", lower_panels, _MODES_PERCENT)
    return _divide("column", [upper_area, lower_area], _PLOTS_PERCENT)


def _is_mode(plot: CurvePlot) -> bool:
    """Returns True for the plot of a mode. Modes have their own panel, see `_add_modes`."""
    names = [curves.entity.rpartition("/")[2] for curves in plot.curves]
    return all(name in _MODE_NUMBERS for name in names)


def _divide(direction: str, trees: Sequence[Tree], first_percent: float | None = None) -> Tree:
    """Divides an area of the viewer among several panels or groups of panels (trees).

    The viewer can only split an area in two, so the first tree receives its share and the
    remaining area is split again.

    Args:
        direction: "row" to place the trees side by side, "column" to stack them.
        trees: The trees, at least one.
        first_percent: Share of the first tree, in %. `None` to give all trees the same size.
    """
    first, *others = trees
    if not others:
        return first
    return {
        "direction": direction,
        "first": first,
        "second": _divide(direction, others),
        "splitPercentage": first_percent or round(100.0 / len(trees), 2),
    }


def _add_plot(panels: _Panels, channels: Ros2Channels, plot: CurvePlot) -> str:
    """Adds a plot with the curves of a quantity, such as joint angles. Returns its identifier.

    Curves that are hidden by default are omitted. References, which an arm should follow, are
    dashed.
    """
    curve_settings = []
    for curves in plot.curves:
        topic_path = _get_list_path(channels, curves.entity)
        for index, name in enumerate(curves.names):
            if not curves.visible[index]:
                continue
            is_reference = name.endswith("_ref")
            dashes = {"lineStyle": "dashed"} if is_reference else {}
            curve_settings.append(
                {
                    "value": f"{topic_path}[{index}]",
                    "label": name,
                    "enabled": True,
                    "timestampMethod": "receiveTime",
                    **dashes,
                }
            )

    settings = {
        "paths": curve_settings,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }
    return panels.add("Plot", settings, plot.title)


def _get_list_path(channels: Ros2Channels, entity: str) -> str:
    """Returns the path of a list of numbers, to be plotted, within a Foxglove message.

    Args:
        channels: Mapping from topic to standard channel.
        entity: Topic of an array, or the topic of joint states followed by the name of one of
            their lists, as in `rerun_viewer._PlotCurves`.
    """
    if entity in channels:
        return f"{entity}.data"
    topic, _, field = entity.rpartition("/")
    return f"{topic}.{field}"


def _add_modes(panels: _Panels, channels: Ros2Channels) -> str:
    """Adds a panel that shows the mode of every arm over time, such as "resting".

    An arm that rests or holds its position does not follow the other arms.

    Args:
        panels: Panels of the layout, to which the panel is added.
        channels: Mapping from topic to standard channel.

    Returns:
        The identifier of the panel. Empty if there are no modes.
    """
    entries = []
    for topic, channel in channels.items():
        root, _, name = topic.rpartition("/")
        is_mode = name == _MODE and channel.kind in (STRING, FLOAT64_ARRAY)
        if not is_mode:
            continue

        site = root.rpartition("/")[2]
        entry: JsonObject = {
            "value": f"{topic}.data",
            "label": site,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        if channel.kind == FLOAT64_ARRAY:  # the mode is a number, which the viewer names
            entry["value"] = f"{topic}.data[0]"
            entry["customStates"] = _name_mode_numbers()
        entries.append(entry)

    if not entries:
        return ""
    return panels.add("StateTransitions", {"paths": entries, "isSynced": True}, "modes")


def _name_mode_numbers() -> JsonObject:
    """Returns the setting that makes a viewer show mode names instead of mode numbers."""
    states = []
    for word, number in NUMBERS_BY_MODE_WORD.items():
        states.append({"value": number, "operator": "=", "label": word})
    return {"type": "range", "states": states, "otherwise": {"label": "other"}}


def _add_events(panels: _Panels, layout: PlotLayout) -> str:
    """Adds a panel that lists the events as text. Returns "" if there are no events."""
    if not layout.lines:
        return ""
    # Viewers call the type of this panel "RosOut" in files.
    settings = {"topicToRender": layout.lines, "minLogLevel": 1, "searchTerms": []}
    return panels.add("RosOut", settings, "events")


def _add_arms(panels: _Panels, channels: Ros2Channels) -> str:
    """Adds a panel with the arms in space, and returns its identifier."""
    layers: JsonObject = {
        "grid": {
            "instanceId": "grid",
            "layerId": "foxglove.Grid",
            "label": "Grid",
            "visible": True,
            "frameId": WORLD,
            "size": 10,
            "divisions": 10,
            "lineWidth": 1,
            "color": "#7f7f7fff",
            "position": [0, 0, 0],
            "rotation": [0, 0, 0],
            "order": 1,
        }
    }
    topics: JsonObject = {}
    arm_count = 0
    for topic, channel in channels.items():
        if channel.is_robot_description():
            arm_count += 1
            root, _, _ = topic.rpartition("/")
            site = root.rpartition("/")[2]
            layers[f"arm-{site}"] = {
                "instanceId": f"arm-{site}",
                "layerId": "foxglove.Urdf",
                "label": site,
                "visible": True,
                "sourceType": "topic",
                "topic": topic,
                "framePrefix": "",
                "displayMode": "auto",
                "order": arm_count + 1,
            }
        elif channel.kind == POSE:
            topics[topic] = {"visible": True, "type": "axis", "axisScale": 0.2}
    middle_y = SPACING_M * max(arm_count - 1, 0) / 2.0
    camera = {
        "perspective": True,
        "distance": 3.0 + 2.0 * arm_count,
        "phi": 65.0,
        "thetaOffset": 45.0,
        "targetOffset": [0.0, middle_y, 0.5],
        "target": [0, 0, 0],
        "targetOrientation": [0, 0, 0, 1],
        "fovy": 45,
        "near": 0.05,
        "far": 1000,
    }
    settings = {
        "followTf": WORLD,
        "followMode": "follow-none",
        "cameraState": camera,
        "scene": {"transforms": {"visible": False, "showLabel": False}},
        "transforms": {},
        "topics": topics,
        "layers": layers,
    }
    return panels.add("3D", settings, "arms")

"""Writes configuration files with which Foxglove, Lichtblick and RViz show the arms of a log.

The files are written next to the log. Some of them are for a bag, a file of standard messages
of ROS 2 (Robot Operating System), into which a log can be exported. A bag has the topics that
the live bridge to ROS 2 publishes during a session.

Invariant:
    - A file names only topics of the log, and topics of the bag and of the live bridge.
    - An existing file is replaced only with `force`.
"""

import json
from pathlib import Path

from ..errors import UsageError
from ..files import refuse_existing, write_whole
from ..log import VIZ_ROOT, open_log
from ..log.ros2 import (
    NAMINGS,
    Ros2Channel,
    TopicTable,
    build_rviz_config,
    list_full_topics,
    make_session_name,
    read_ros2_channels,
)
from .foxglove_layout import build_foxglove_layout
from .rerun_viewer import build_plot_layout

LAYOUT_SUFFIX = ".foxglove.json"
"""Suffix of the file of a layout, which replaces the suffix of the log's name."""
CONFIG_SUFFIX = ".rviz"
"""Suffix of a configuration of RViz, which replaces the suffix of the log's name."""


def write_foxglove_layout(log: Path, *, force: bool = False) -> Path:
    """Writes the layout of a log or a bag for the viewers Foxglove and Lichtblick.

    With the layout, the viewer shows plots of all sites without any arrangement by hand.

    Args:
        log: File of the log or bag.
        force: True to replace an existing file.

    Returns:
        The path of the layout, which is next to the log.

    Raises:
        UsageError: The file contains no channels for viewers, or the layout exists.
        LogError: The log cannot be read.
    """
    path = log.with_suffix(LAYOUT_SUFFIX)
    refuse_existing(path, force=force)
    channels = read_ros2_channels(log)
    if not build_plot_layout(channels).pages:
        raise UsageError(
            f"{log}: there is nothing to plot, because the file is not finished or was written "
            f"with --views off; write a file for viewers with `trilat log export {log} --to "
            "ros2`, and name that file instead"
        )

    sources = {"ROS 2": channels}
    if _is_log(channels):
        sources = {"Log": channels, "ROS 2": _list_session_topics(log)}
    layout = build_foxglove_layout(sources)
    write_whole(path, json.dumps(layout, indent=1) + "\n", force=force)
    return path


def write_rviz_config(log: Path, *, force: bool = False) -> Path:
    """Writes a configuration of RViz, the 3D viewer of ROS, that shows the arms of a log.

    A log is shown while its session is running over ROS, and a bag while it is played.

    Args:
        log: File of the log or bag.
        force: True to replace an existing file.

    Returns:
        The path of the configuration, which is next to the log.

    Raises:
        UsageError: The bag contains no description of an arm, or the configuration exists.
        LogError: The log cannot be read.
    """
    path = log.with_suffix(CONFIG_SUFFIX)
    refuse_existing(path, force=force)
    channels = read_ros2_channels(log)
    is_bag = bool(channels) and not _is_log(channels)
    topics = channels if is_bag else _list_session_topics(log)
    write_whole(path, build_rviz_config(topics), force=force)
    return path


def _is_log(channels: dict[str, Ros2Channel]) -> bool:
    """Returns True for the channels of a log, and False for those of a bag."""
    return any(topic.startswith(VIZ_ROOT) for topic in channels)


def _list_session_topics(log: Path) -> dict[str, Ros2Channel]:
    """Lists the ROS 2 topics under which a bridge would publish the session of a log live.

    Layouts of viewers then work for the log and for the live session.

    Args:
        log: File of the log.

    Returns:
        The descriptions of the topics by their full names, which begin with /.

    Raises:
        LogError: The log cannot be read.
    """
    opened_log = open_log(log)
    session = make_session_name(opened_log.session["session"])
    topic_names = TopicTable.read(NAMINGS[0])
    return list_full_topics(opened_log.scenario, session, topic_names)

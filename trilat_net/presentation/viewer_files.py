"""Writes the layout with which Foxglove and Lichtblick show the arms of a log.

The file is written next to the log. It also serves a bag, a file of standard messages of ROS 2
(Robot Operating System), into which a log can be exported. A bag has the topics that the live
bridge to ROS 2 publishes during a session.

Invariant:
    - The layout names only topics of the log, and topics of the bag and of the live bridge.
    - An existing file is replaced only with `force`.
"""

import json
from pathlib import Path

from ..errors import UsageError
from ..files import refuse_existing, write_whole
from ..log import open_log
from ..log.ros2 import Ros2Topics
from .foxglove_layout import build_foxglove_layout
from .rerun_viewer import build_plot_layout

LAYOUT_SUFFIX = ".foxglove.json"
"""Suffix of the file of a layout, which replaces the suffix of the log's name."""


def write_foxglove_layout(log: Path, *, force: bool = False) -> Path:
    """Writes the layout of a log or a bag for the viewers Foxglove and Lichtblick.

    With the layout, the viewer shows plots of all sites without manual arrangement.

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
    channels = Ros2Topics.of_file(log)
    if not build_plot_layout(channels).pages:
        raise UsageError(
            f"{log}: there is nothing to plot, because the file is not finished or was written "
            f"with --views off; write a file for viewers with `trilat log export {log} --to "
            "ros2`, and name that file instead"
        )

    sources = {"ROS 2": channels}
    if channels.are_of_log:
        sources = {"Log": channels, "ROS 2": Ros2Topics.of_log(open_log(log))}
    layout = build_foxglove_layout(sources)
    write_whole(path, json.dumps(layout, indent=1) + "\n", force=force)
    return path

"""Writes a configuration for RViz, the 3D viewer of ROS 2, that shows the arms of a session.

The configuration is a YAML file that lists the displays and their topics. There is one display
for the model of each arm and for each pose, and others for the frames of all links and a grid.
The same file works for a running session published by the live bridge and for an exported bag
of this session, because both have the same topics.

Invariant:
    - An existing file is replaced only with `force`.
    - Each topic of the configuration is a topic of the session with the same quality of
      service. RViz therefore also receives a description that was published before RViz was
      started.
    - The names of links in the descriptions are the names of their frames, so that no display
      needs a prefix.
"""

from collections.abc import Mapping
from pathlib import Path
from string import Template

from ...errors import UsageError
from ...files import refuse_existing, write_whole
from ...log import open_log
from .cdr import DEFINITIONS, POSE
from .published import Ros2Topics
from .robot_model import SPACING_M, WORLD
from .ros2_messages import Ros2Channel

_SUFFIX = ".rviz"
"""Suffix of the file names of templates and configurations."""


def write_rviz_config(log: Path, *, force: bool = False) -> Path:
    """Writes a file that configures RViz, the 3D viewer of ROS 2, to show the arms of a log.

    RViz shows the arms while the live bridge publishes the session, or while the bag is played
    back.

    Args:
        log: Path of the log or bag.
        force: True to replace an existing file.

    Returns:
        The path of the file, which is next to the log.

    Raises:
        UsageError: No topic contains the description of an arm, or the file already exists and
            `force` is False.
        LogError: The log cannot be read.
    """
    path = log.with_suffix(_SUFFIX)
    refuse_existing(path, force=force)
    topics = Ros2Topics.of_file(log)
    is_bag = bool(topics) and not topics.are_of_log
    if not is_bag:
        topics = Ros2Topics.of_log(open_log(log))
    write_whole(path, build_rviz_config(topics), force=force)
    return path


def build_rviz_config(topics: Mapping[str, Ros2Channel]) -> str:
    """Returns a configuration for the 3D viewer RViz to show the arms of a session or a bag.

    Args:
        topics: Maps the full name of each topic, which begins with "/", to its description.

    Raises:
        UsageError: No topic contains the description of an arm.
    """
    displays = ""
    arm_count = 0
    for topic, channel in topics.items():
        site_and_name = "/".join(topic.split("/")[-2:])
        if channel.is_robot_description():
            arm_count += 1
            site, _, _ = site_and_name.rpartition("/")
            displays += _fill_template("robot_model", name=site, topic=topic)
        elif channel.kind == POSE:
            displays += _fill_template("pose", name=site_and_name, topic=topic)
    if not arm_count:
        raise UsageError(
            "there is no arm that RViz could show: no topic has the description of a robot"
        )

    # The camera looks at the middle of the row of arms, from a distance that shows all of them.
    middle_y = SPACING_M * (arm_count - 1) / 2.0
    distance = 3.0 + 2.0 * arm_count
    return _fill_template(
        "session",
        displays=displays.rstrip("\n"),
        frame=WORLD,
        distance=f"{distance:g}",
        middle_y=f"{middle_y:g}",
    )


def _fill_template(template: str, **values: str) -> str:
    """Returns the text of a template with its placeholders replaced.

    Args:
        template: Name of the template file, without its suffix.
        **values: Value of each placeholder.
    """
    text = (DEFINITIONS / f"{template}{_SUFFIX}").read_text(encoding="utf-8")
    return Template(text).substitute(values)

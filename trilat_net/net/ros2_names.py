"""Checks the names of ROS 2 topics, services and nodes."""

import re

from ..errors import UsageError

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""Parts separated by slashes.

Each part consists of letters, digits and _, and does not start with a digit.
"""


def check_ros_name(name: str, kind: str) -> str:
    """Returns a name of ROS 2 without its leading slash.

    Args:
        name: The name.
        kind: What the name denotes, such as "topic", for the error message.

    Raises:
        UsageError: The name is not valid.
    """
    relative_name = name.removeprefix("/")
    if not _NAME.fullmatch(relative_name):
        raise UsageError(
            f"{kind} {name!r} is no name of ROS 2: letters, digits and _ in parts between /"
        )
    return relative_name

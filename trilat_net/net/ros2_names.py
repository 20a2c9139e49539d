"""Names of topics, services and nodes of ROS 2."""

import re

from ..errors import UsageError

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def check_ros_name(name: str, what: str) -> str:
    """Returns a ROS name without its leading slash.

    Args:
        name: the name.
        what: subject of the error message, as in "topic".

    Raises:
        UsageError: the name is not valid.
    """
    relative_name = name.removeprefix("/")
    if not _NAME.fullmatch(relative_name):
        raise UsageError(
            f"{what} {name!r} is no name of ROS 2: letters, digits and _ in parts between /"
        )
    return relative_name

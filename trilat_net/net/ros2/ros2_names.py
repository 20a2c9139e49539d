"""Checks the names of ROS 2 topics, services and nodes before they are used.

A name that ROS 2 does not accept is rejected with an explanation, because other ROS programs
could neither subscribe to such a topic nor call such a service.
"""

import re

from ...errors import UsageError

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""Parts separated by slashes.

Each part consists of letters, digits and _, and does not start with a digit.
"""


def check_ros_name(name: str, kind: str) -> str:
    """Returns a ROS 2 name without its leading slash, or raises UsageError if it is invalid.

    Args:
        name: The name, which may begin with a slash.
        kind: What the name refers to, such as "topic", for the error message.

    Raises:
        UsageError: The name is invalid.
    """
    relative_name = name.removeprefix("/")
    if not _NAME.fullmatch(relative_name):
        raise UsageError(
            f"{kind} {name!r} is not a valid ROS 2 name: a name consists of letters, digits "
            "and _, in parts that are separated by / and do not begin with a digit"
        )
    return relative_name

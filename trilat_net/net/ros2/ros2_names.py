"""Checks the names of ROS 2 topics, services and nodes before they are used.

Other ROS programs could not subscribe to a topic, or call a service, with a name that ROS 2
does not accept. Such a name is therefore refused with an explanation.
"""

import re

from ...errors import UsageError

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
"""Parts separated by slashes.

Each part consists of letters, digits and _, and does not start with a digit.
"""


def check_ros_name(name: str, kind: str) -> str:
    """Checks that a string is a valid name of ROS 2.

    Args:
        name: The name, which may begin with a slash.
        kind: What the name denotes, such as "topic", for the error message.

    Returns:
        The name without the leading slash.

    Raises:
        UsageError: The name is not valid.
    """
    relative_name = name.removeprefix("/")
    if not _NAME.fullmatch(relative_name):
        raise UsageError(
            f"{kind} {name!r} is not a valid ROS 2 name: a name consists of letters, digits "
            "and _, in parts that are separated by / and do not begin with a digit"
        )
    return relative_name

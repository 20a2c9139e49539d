"""Names of ROS 2, as topics, services and nodes may have them."""

import re

from ..errors import UsageError

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def check_ros_name(name: str, what: str) -> str:
    """Returns a name of ROS without the slash before it.

    Raises:
        UsageError: it is none.
    """
    if not _NAME.fullmatch(bare := name.removeprefix("/")):
        raise UsageError(
            f"{what} {name!r} is no name of ROS 2: letters, digits and _ in parts between /"
        )
    return bare

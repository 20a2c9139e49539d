"""Connects this program to ROS 2 (Robot Operating System) programs over their Zenoh network.

`ros2_graph` publishes and subscribes to topics of ROS programs without a ROS installation, and
`ros2_names` checks the names of topics.
"""

from typing import TYPE_CHECKING

from ...hooks import import_on_use

__all__ = [
    "DISTROS",
    "ROUTER_ADVICE",
    "Attachment",
    "QualityOfService",
    "Refusals",
    "Ros2Graph",
    "TopicPublisher",
    "check_ros_name",
]

if TYPE_CHECKING:
    from .ros2_graph import (
        DISTROS,
        ROUTER_ADVICE,
        Attachment,
        QualityOfService,
        Refusals,
        Ros2Graph,
        TopicPublisher,
    )
    from .ros2_names import check_ros_name
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "ros2_graph": (
                "Attachment DISTROS QualityOfService ROUTER_ADVICE Refusals Ros2Graph "
                "TopicPublisher"
            ),
            "ros2_names": "check_ros_name",
        },
    )

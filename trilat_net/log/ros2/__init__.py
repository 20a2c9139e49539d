"""Converts the messages of a session to standard ROS 2 messages, for viewers and ROS programs.

ROS 2 is the Robot Operating System. Encoding the standard messages does not require a ROS
installation. They can be stored in a log next to the session's own messages, exported as a ROS
2 bag, or published while a session runs.
"""

from typing import TYPE_CHECKING

from ...hooks import import_on_use

__all__ = [
    # Encoding
    "FLOAT64_ARRAY",
    "JOINT_STATE",
    "POSE",
    "STRING",
    "TRANSFORMS",
    "cdr",
    # Messages and their channels
    "COMMON_TOPICS",
    "EVENTS",
    "FRAMES",
    "LINES",
    "NUMBERS_BY_MODE_WORD",
    "SENT_PREFIX",
    "SESSION_CHANNELS",
    "Ros2Channels",
    "Ros2SiteChannels",
    "Ros2Topics",
    "SiteMessages",
    "pack_event",
    "pack_session_diagnostics",
    "ros2_messages",
    # Names of topics
    "DIAGNOSTICS",
    "FRAMES_TOPIC",
    "NAMINGS",
    "RobotTable",
    "TopicTable",
    "make_session_name",
    # Robots and views
    "SPACING_M",
    "WORLD",
    "build_rviz_config",
    "write_rviz_config",
]

if TYPE_CHECKING:
    from . import cdr, ros2_messages
    from .cdr import FLOAT64_ARRAY, JOINT_STATE, POSE, STRING, TRANSFORMS
    from .published import COMMON_TOPICS, Ros2Topics, SiteMessages, pack_session_diagnostics
    from .robot_model import SPACING_M, WORLD
    from .ros2_messages import (
        EVENTS,
        FRAMES,
        LINES,
        NUMBERS_BY_MODE_WORD,
        SENT_PREFIX,
        SESSION_CHANNELS,
        Ros2Channels,
        Ros2SiteChannels,
        pack_event,
    )
    from .rviz_config import build_rviz_config, write_rviz_config
    from .topic_names import (
        DIAGNOSTICS,
        FRAMES_TOPIC,
        NAMINGS,
        RobotTable,
        TopicTable,
        make_session_name,
    )
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "cdr": "FLOAT64_ARRAY JOINT_STATE POSE STRING TRANSFORMS cdr",
            "published": "COMMON_TOPICS Ros2Topics SiteMessages pack_session_diagnostics",
            "robot_model": "SPACING_M WORLD",
            "ros2_messages": (
                "EVENTS FRAMES LINES NUMBERS_BY_MODE_WORD Ros2Channels Ros2SiteChannels "
                "SENT_PREFIX SESSION_CHANNELS pack_event ros2_messages"
            ),
            "rviz_config": "build_rviz_config write_rviz_config",
            "topic_names": (
                "DIAGNOSTICS FRAMES_TOPIC NAMINGS RobotTable TopicTable make_session_name"
            ),
        },
    )

"""Defines how often a log stores messages for general viewers, such as Foxglove.

Viewers cannot decode the messages of a session. A log may therefore contain standard messages
next to them (`ros2.viz_channels`), at a lower rate to keep the file small.
"""

import math

VIZ_HZ = 100.0
"""Default rate of the messages with the joints and their error, in Hz."""
FULL_RATE_HZ = math.inf
"""Special rate with which one message is written for every record."""

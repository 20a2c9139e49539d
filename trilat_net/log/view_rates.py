"""Rates of the messages for viewers, which a log may contain beside those of a session."""

import math

VIZ_HZ = 100.0
"""Default rate of the messages with the joints and their error, in Hz."""
FULL_RATE_HZ = math.inf
"""Rate that means a message for every record."""

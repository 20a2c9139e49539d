"""Rates of the messages for viewers, which a log may contain beside those of a session."""

import math

from ..errors import UsageError

VIZ_HZ = 100.0
"""Default rate of the messages with the joints and their error, in Hz."""
FULL_RATE_HZ = math.inf
"""Rate that means a message for every record."""


def parse_viz_rate(text: str) -> float:
    """Parses the option `--views`, the rate of the messages for viewers such as Foxglove.

    Args:
        text: A number from 1 to 1e6, "off" or "full".

    Returns:
        The rate in Hz. It is 0 for "off" and `FULL_RATE_HZ` for "full".

    Raises:
        UsageError: The text is neither a number in range nor one of these words.
    """
    keywords = {"off": 0.0, "full": FULL_RATE_HZ}
    if text in keywords:
        return keywords[text]
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = math.nan
    if not 1.0 <= rate_hz <= 1e6:
        raise UsageError(
            "--views must be off, full, or a number of messages per second from 1 to 1000000, "
            f"not {text!r}"
        )
    return rate_hz

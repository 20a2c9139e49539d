"""What the messages of a session look like as standard messages of ROS 2: channels, units, names.

Law: nothing is converted but units that stand in the channel's metadata, and what was not measured is no
number. A curve's name stands where viewers look for one: with joints in the message, else in the label of
its dimension.
"""

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.reader import make_reader

from ..core.arm import JOINTS, PARAMETERS
from ..core.tick import Mode
from ..errors import LogError
from ..net.messages import Event, LinkStats
from .cdr import (
    ENCODING,
    FLOAT64_ARRAY,
    JOINT_STATE,
    LOG,
    STRING,
    Dimension,
    Level,
    float_arrays,
    log_message,
    string_message,
)

EVENTS, LINES = "events", "log"
"""Channels of a whole session: what happened, as plain text, and as lines with a time and a level."""


SLOW = {"tau_x": JOINTS, "theta_hat": PARAMETERS, "mode": 1}
"""What a record has besides its joints and their error: arrays, in order, and how many numbers each has."""


class Standard(NamedTuple):
    """A standard channel: the type of its messages, and what to say of it in the file."""

    kind: str
    about: dict[str, str]


SESSION_CHANNELS = {
    EVENTS: Standard(STRING, {"content": "what happened, member first"}),
    LINES: Standard(LOG, {"content": "the same as lines of a log"}),
}
_LEVELS = {
    "diverged": Level.ERROR,
    "failed": Level.ERROR,
    "lost": Level.WARN,
    "refused": Level.WARN,
    "clock fault": Level.WARN,
}
_MODES = {mode.name.lower(): float(mode) for mode in Mode}


def mode_number(mode: str | Mode) -> float:
    """Returns the number of a mode, see `core.tick.Mode`; 0 for none of them."""
    return float(mode) if isinstance(mode, Mode) else _MODES.get(mode, 0.0)


def event_messages(event: Event, stamp_ns: int) -> Iterator[tuple[str, bytes]]:
    """Yields what an event is in the channels of the session.

    Args:
        event: the event.
        stamp_ns: when it happened, Unix ns, not below 0.
    """
    yield EVENTS, string_message(f"{event.member}: {event.text}")
    yield LINES, log_message(stamp_ns, _LEVELS.get(event.kind, Level.INFO), event.member, event.text)


class Arrays:
    """A channel of `std_msgs/msg/Float64MultiArray`.

    Args:
        content: what the numbers are.
        unit: their unit.
        axes: names along each dimension.
    """

    def __init__(self, content: str, unit: str, *axes: Sequence[str]) -> None:
        self.channel = Standard(
            FLOAT64_ARRAY,
            {"content": content, "unit": unit, "names": "; ".join(" ".join(axis) for axis in axes)},
        )
        labels = [f"{content}: {' '.join(axis)}" if not n else " ".join(axis) for n, axis in enumerate(axes)]
        labels[-1] += f" ({unit})"
        self.size = math.prod(map(len, axes))
        self.pack = float_arrays(*(Dimension(*one) for one in zip(labels, map(len, axes), strict=True)))


class SiteChannels:
    """The standard channels of one site.

    Args:
        site: its name.
        peers: its peers in scenario order.

    Attributes:
        joints: names of its joints.
        arrays: the channels that are arrays, by the last part of their topic.
    """

    def __init__(self, site: str, peers: Sequence[str]) -> None:
        self._peers = peers
        self.joints = [f"{site}_q{n + 1}" for n in range(JOINTS)]
        parameters = [f"theta_{n + 1}" for n in range(PARAMETERS)]
        spread = ("median", "max")
        self.arrays = {
            "error": Arrays("q - q_des", "rad", self.joints),
            "tau_x": Arrays("exogenous torque, as Eq. (8) subtracts it", "N m", self.joints),
            "theta_hat": Arrays("estimate of Eq. (24)", "kg m^2, kg m^2, kg m^2, kg m, kg m", parameters),
            "mode": Arrays("run 1, diverged 2, hold 3, brake 4, return 5", "-", ["mode"]),
            "link_age": Arrays("age of the sample in use", "ms", peers),
            "link_delay": Arrays("one-way delay, last 100 ms", "ms", peers, spread),
            "link_offset": Arrays("the peer's clock minus the own one", "ms", peers, ("offset", "bound")),
            "timing": Arrays("largest in the last 100 ms", "us", ("lateness", "computing_time")),
        }

    def joint_states(self, names: Sequence[str], *, effort: bool = True) -> Standard:
        """Returns a channel of joint states with these names."""
        return Standard(JOINT_STATE, {"unit": "rad, rad/s" + ", N m" * effort, "names": " ".join(names)})

    def slow(self, row: Sequence[float]) -> Iterator[tuple[str, bytes]]:
        """Yields the arrays of one record, from all their numbers in the order of `SLOW`."""
        start = 0
        for name, size in SLOW.items():
            yield name, self.arrays[name].pack(*row[start : start + size])
            start += size

    def statistics(self, stats: LinkStats) -> Iterator[tuple[str, bytes]]:
        """Yields the arrays of one statistics; clocks and networks only where there are any."""
        arrays, peers = self.arrays, self._peers
        if not peers:
            return
        yield "link_age", arrays["link_age"].pack(*(_ms(stats.age_us.get(peer, -1)) for peer in peers))
        if not stats.delay_us:  # virtual time has neither
            return
        delays = [_ms(by.get(peer, -1)) for peer in peers for by in (stats.delay_us, stats.delay_max_us)]
        yield "link_delay", arrays["link_delay"].pack(*delays)
        offsets = [by.get(peer, math.nan) / 1e3 for peer in peers for by in (stats.offset_us, stats.bound_us)]
        yield "link_offset", arrays["link_offset"].pack(*offsets)
        yield "timing", arrays["timing"].pack(stats.late_max_us, stats.busy_max_us)


def _ms(us: int) -> float:
    """Returns milliseconds; NaN where nothing was measured."""
    return us / 1e3 if us != -1 else math.nan


def channels_of(path: Path) -> dict[str, Standard]:
    """Returns the standard channels of a finished file, by topic; none of one that cannot be read so.

    Raises:
        LogError: the file cannot be opened.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    with stream:
        try:
            summary = make_reader(stream).get_summary()
        except (McapError, EOFError, OSError, struct.error, ValueError, OverflowError):
            summary = None
    if summary is None:
        return {}
    return {
        channel.topic: Standard(summary.schemas[channel.schema_id].name, dict(channel.metadata))
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id)
        if channel.message_encoding == ENCODING and channel.schema_id in summary.schemas
    }

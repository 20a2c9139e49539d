"""Mapping of a session's messages to standard ROS 2 messages: channels, units, names.

Invariant: only units are converted, as the channel's metadata states; an unmeasured value is NaN. A
curve's name stands where viewers look for it: with the joints in the message, else in the label of its
dimension.
"""

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.reader import make_reader

from ...core.ticks import Mode, TickRecord
from ...core.two_link_arm import JOINTS, PARAMETERS
from ...errors import LogError
from ...net.messages import Event, LinkStats, State
from .cdr import (
    ENCODING,
    FLOAT64_ARRAY,
    JOINT_STATE,
    LOG,
    STRING,
    ArrayDimension,
    RosLogLevel,
    make_float_array_packer,
    pack_log,
    pack_string,
)

EVENTS, LINES = "events", "log"
"""Channels of a whole session: events as plain text, and as lines with a time and a level."""
SLOW_ARRAYS = {"tau_x": JOINTS, "theta_hat": PARAMETERS, "mode": 1}
"""Arrays of a record besides its joints and their error, in order, and how many numbers each has."""


class Ros2Channel(NamedTuple):
    """A standard channel: the type of its messages, and its metadata."""

    kind: str
    about: dict[str, str]


SESSION_CHANNELS = {
    EVENTS: Ros2Channel(STRING, {"content": "what happened, member first"}),
    LINES: Ros2Channel(LOG, {"content": "the same as lines of a log"}),
}
_LEVELS = {
    "diverged": RosLogLevel.ERROR,
    "failed": RosLogLevel.ERROR,
    "lost": RosLogLevel.WARN,
    "refused": RosLogLevel.WARN,
    "clock fault": RosLogLevel.WARN,
}
_MODES = {mode.name.lower(): float(mode) for mode in Mode}


def mode_number(mode: str | Mode) -> float:
    """Returns the number of a mode of `core.ticks.Mode`; 0 for none of them."""
    return float(mode) if isinstance(mode, Mode) else _MODES.get(mode, 0.0)


def pack_event(event: Event, stamp_ns: int) -> Iterator[tuple[str, bytes]]:
    """Yields an event for the channels of the session; `stamp_ns` is its Unix time, not below 0."""
    yield EVENTS, pack_string(f"{event.member}: {event.text}")
    yield LINES, pack_log(stamp_ns, _LEVELS.get(event.kind, RosLogLevel.INFO), event.member, event.text)


class ArrayChannel:
    """A channel of `std_msgs/msg/Float64MultiArray`: content and unit of its numbers, names on its axes."""

    def __init__(self, content: str, unit: str, *axes: Sequence[str]) -> None:
        self.channel = Ros2Channel(
            FLOAT64_ARRAY,
            {"content": content, "unit": unit, "names": "; ".join(" ".join(axis) for axis in axes)},
        )
        labels = [f"{content}: {' '.join(axis)}" if not n else " ".join(axis) for n, axis in enumerate(axes)]
        labels[-1] += f" ({unit})"
        self.size = math.prod(map(len, axes))
        self.pack = make_float_array_packer(
            *(ArrayDimension(*one) for one in zip(labels, map(len, axes), strict=True))
        )


class Ros2SiteChannels:
    """The standard channels of one site with its peers in scenario order.

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
            "error": ArrayChannel("q - q_des", "rad", self.joints),
            "tau_x": ArrayChannel("exogenous torque, as Eq. (8) subtracts it", "N m", self.joints),
            "theta_hat": ArrayChannel(
                "estimate of Eq. (24)", "kg m^2, kg m^2, kg m^2, kg m, kg m", parameters
            ),
            "mode": ArrayChannel("run 1, diverged 2, hold 3, brake 4, return 5", "-", ["mode"]),
            "link_age": ArrayChannel("age of the sample in use", "ms", peers),
            "link_delay": ArrayChannel("one-way delay, last 100 ms", "ms", peers, spread),
            "link_offset": ArrayChannel(
                "the peer's clock minus the own one", "ms", peers, ("offset", "bound")
            ),
            "timing": ArrayChannel("largest in the last 100 ms", "us", ("lateness", "computing_time")),
        }

    def joint_states(self, names: Sequence[str], *, effort: bool = True) -> Ros2Channel:
        """Returns a channel of joint states with these names."""
        return Ros2Channel(JOINT_STATE, {"unit": "rad, rad/s" + ", N m" * effort, "names": " ".join(names)})

    def slow(self, row: Sequence[float]) -> Iterator[tuple[str, bytes]]:
        """Yields the arrays of one record, from all their numbers in the order of `SLOW_ARRAYS`."""
        start = 0
        for name, size in SLOW_ARRAYS.items():
            yield name, self.arrays[name].pack(*row[start : start + size])
            start += size

    def statistics(self, stats: LinkStats) -> Iterator[tuple[str, bytes]]:
        """Yields the arrays of one statistics; those of clocks and networks only in a live session."""
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
    """Returns milliseconds; NaN if nothing was measured."""
    return us / 1e3 if us != -1 else math.nan


def read_ros2_channels(path: Path) -> dict[str, Ros2Channel]:
    """Returns the standard channels of a finished file by topic, {} if it has no readable index.

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
        channel.topic: Ros2Channel(summary.schemas[channel.schema_id].name, dict(channel.metadata))
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id)
        if channel.message_encoding == ENCODING and channel.schema_id in summary.schemas
    }


Record = State | TickRecord
SignalRow = Sequence[float]

JOINT_ROW = slice(0, 4 * JOINTS)
"""Of a row the joints: q, q_des, qd, tau."""
ERROR_ROW = slice(4 * JOINTS, 5 * JOINTS)
"""The error e = q - q_des, Eq. (9)."""
SLOW_ROW = slice(5 * JOINTS, None)
"""The rest: tau_x, theta_hat, mode."""


def stack_signals(records: Sequence[Record]) -> list[SignalRow]:
    """Returns the numbers of records, a column per curve, in the order of the rows above.

    A column may be shorter where all of its numbers are the same.
    """
    rows = [(*m.q, *m.q_des, *m.qd, *m.tau, *m.tau_x, *m.theta_hat) for m in records]
    columns: list[SignalRow] = [*zip(*rows, strict=True)]
    q, q_des = columns[:JOINTS], columns[JOINTS : 2 * JOINTS]
    error = [[a - b for a, b in zip(*pair, strict=True)] for pair in zip(q, q_des, strict=True)]
    modes = [m.mode for m in records]
    if modes.count(modes[0]) == len(modes):
        del modes[1:]
    rest = columns[JOINT_ROW.stop :]
    return [*columns[JOINT_ROW], *error, *rest, [mode_number(mode) for mode in modes]]

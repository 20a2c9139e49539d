"""Decimated ROS 2 channels of a log, for general viewers, with every extreme kept.

Invariant: the file holds the exact minimum and maximum of every curve in every bucket of a site's
records, in the order in which they came. Buckets have equal length on the tick grid. A bucket's first
message bears the time of its first record and is written at the bucket's end; the second bears that of
its middle record and is written half a bucket later. Records that arrive after their bucket was closed
form a bucket of their own.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

from ...core.ticks import NS_PER_S
from ...errors import UsageError
from ...net import topics
from ...net.messages import Event, LinkStats
from ...scenario import Scenario
from ..log_layout import VIZ_ROOT
from .cdr import JointStatePacker
from .ros2_messages import (
    ERROR_ROW,
    FAST_ROW,
    JOINT_ROW,
    SESSION_CHANNELS,
    SLOW_ROW,
    Record,
    Ros2Channel,
    Ros2SiteChannels,
    SignalRow,
    pack_event,
    stack_signals,
)

VIZ_HZ = 100.0
"""Messages a second by default, of the joints and their error."""
SLOW_VIZ_HZ = 10.0
"""Of exogenous torque, estimate and mode; but all of them where the joints are full."""
FULL_RATE_HZ = math.inf
"""A message per record."""

MAX_PENDING_BYTES = 1 << 13
"""What the views of a site have still to write, at most."""

PutMessage = Callable[[str, bytes, int, int], None]
"""Writes one message: topic, bytes, publish time and log time, Unix ns."""
TakeMessage = Callable[[Any, int], None]
"""Takes one message of the log's own, and its log time, Unix ns."""
StampedRow = tuple[int, SignalRow]
"""A stamp, Unix ns, and what bears it."""

_tick = attrgetter("tick")


class _BucketOutput:
    """Lets a bucket out: its first moment at once, its second when it is asked for, or another comes.

    Args:
        write: writes what bears a stamp: stamp and log time, Unix ns.
    """

    def __init__(self, write: Callable[[int, SignalRow, int], None]) -> None:
        self._write = write
        self._waiting: Sequence[StampedRow] = ()

    def add(self, moments: Sequence[StampedRow], log_ns: int) -> None:
        """Takes a bucket that is over: two moments, or one."""
        self.rest(log_ns)
        self._write(*moments[0], log_ns)
        self._waiting = moments[1:]

    def rest(self, log_ns: int) -> None:
        """Lets out what waits."""
        for moment in self._waiting:
            self._write(*moment, log_ns)
        self._waiting = ()

    def beside(self, moments: Sequence[StampedRow], log_ns: int) -> None:
        """Lets out a bucket at once."""
        for moment in moments:
            self._write(*moment, log_ns)


class _SiteVizWriter:
    """Writes the messages of one site.

    Args:
        site: its name.
        peers: its peers in scenario order.
        put: writes a message.

    Attributes:
        channels: its channels, by topic.
    """

    def __init__(self, site: str, peers: Sequence[str], put: PutMessage) -> None:
        self._put = put
        self._shapes = shapes = Ros2SiteChannels(site, peers)
        root = f"{VIZ_ROOT}{site}/"
        names = [*shapes.joints, *(f"{name}_ref" for name in shapes.joints)]
        self._states_topic, self._states = f"{root}joint_states", JointStatePacker(names)
        self._error_topic, self._error = f"{root}error", shapes.arrays["error"].pack
        self._none = [math.nan] * len(shapes.joints)  # what is not shown of a reference: size is dear
        self._topics = {name: f"{root}{name}" for name in shapes.arrays}
        self.channels: dict[str, Ros2Channel] = {
            self._states_topic: shapes.joint_states(names),
            **{self._topics[name]: array.channel for name, array in shapes.arrays.items()},
        }

    def fast(self, stamp_ns: int, row: SignalRow, log_ns: int) -> None:
        """Writes the joint states, the angles of the reference as joints of their own; and the error."""
        none, n = self._none, len(self._none)
        velocity, effort = [*row[2 * n : 3 * n], *none], [*row[3 * n : JOINT_ROW.stop], *none]
        data = self._states.pack(stamp_ns, row[: 2 * n], velocity, effort)
        self._put(self._states_topic, data, stamp_ns, log_ns)
        self._put(self._error_topic, self._error(*row[ERROR_ROW]), stamp_ns, log_ns)

    def slow(self, stamp_ns: int, row: SignalRow, log_ns: int) -> None:
        """Writes an array for each of the others."""
        for name, data in self._shapes.slow(row):
            self._put(self._topics[name], data, stamp_ns, log_ns)

    def statistics(self, stamp_ns: int, stats: LinkStats, log_ns: int) -> None:
        """Writes the arrays of one statistics."""
        for name, data in self._shapes.statistics(stats):
            self._put(self._topics[name], data, stamp_ns, log_ns)


class _SiteBuckets:
    """The buckets of one site.

    Args:
        writing: writes its messages.
        rate_hz: its tick rate.
        views_hz: messages a second of the joints.
        epoch_unix_ns: Unix time of tick 0.
    """

    def __init__(self, writing: _SiteVizWriter, rate_hz: int, views_hz: float, epoch_unix_ns: int) -> None:
        self._writing, self._rate_hz, self._epoch_unix_ns = writing, rate_hz, epoch_unix_ns
        self._half = max(1, int(rate_hz // views_hz))  # ticks of half a bucket
        self._ratio = 1 if views_hz == FULL_RATE_HZ else max(1, round(rate_hz / self._half / SLOW_VIZ_HZ))
        self._fast, self._slow = _BucketOutput(writing.fast), _BucketOutput(writing.slow)
        self._bucket = self._first = self._turn = 0  # the open bucket, its first tick, the end of a half
        self._open: list[Record] = []
        self._slow_open: list[StampedRow] = []
        self._late: list[Record] = []

    def record(self, message: Record, log_ns: int) -> None:
        """Takes the record of one tick."""
        tick = message.tick
        if tick < self._first:
            self._take_late(message, log_ns)
            return
        if tick >= self._turn:
            self._advance(tick // self._half, log_ns)
        self._open.append(message)

    def statistics(self, stats: LinkStats, log_ns: int) -> None:
        """Takes the statistics of the site's loop."""
        self._writing.statistics(max(0, self._epoch_unix_ns + stats.t_ns), stats, log_ns)

    def finish(self, log_ns: int) -> None:
        """Lets out what there is."""
        self._close(self._bucket + 2 * self._ratio, log_ns)
        self._fast.rest(log_ns)
        self._slow.rest(log_ns)

    def _advance(self, half: int, log_ns: int) -> None:
        """Goes on to another half of a bucket."""
        self._fast.rest(log_ns)
        if half // 2 != self._bucket:
            self._close(half // 2, log_ns)
        self._turn = (half + 1) * self._half

    def _close(self, bucket: int, log_ns: int) -> None:
        """Closes the open bucket, and begins another."""
        self._flush_late(log_ns)
        if self._open:
            moments = self._moments(self._open)
            self._fast.add([(stamp_ns, row[FAST_ROW]) for stamp_ns, row in moments], log_ns)
            self._slow_open += [(stamp_ns, row[SLOW_ROW]) for stamp_ns, row in moments]
            self._open = []
        half, was = 2 * bucket // self._ratio, 2 * self._bucket // self._ratio
        if half != was:
            self._slow.rest(log_ns)
        if half // 2 != was // 2 and self._slow_open:
            stamps_ns, rows = zip(*self._slow_open, strict=True)
            self._slow.add(_two(stamps_ns, zip(*rows, strict=True)), log_ns)
            self._slow_open = []
        self._bucket, self._first = bucket, 2 * self._half * bucket

    def _take_late(self, message: Record, log_ns: int) -> None:
        """Takes a record whose bucket is closed; with others of that bucket it waits for the next close."""
        length = 2 * self._half
        if self._late and self._late[0].tick // length != message.tick // length:
            self._flush_late(log_ns)
        self._late.append(message)

    def _flush_late(self, log_ns: int) -> None:
        if self._late:
            moments = self._moments(self._late)
            self._fast.beside([(stamp_ns, row[FAST_ROW]) for stamp_ns, row in moments], log_ns)
            self._slow.beside([(stamp_ns, row[SLOW_ROW]) for stamp_ns, row in moments], log_ns)
            self._late = []

    def _moments(self, records: list[Record]) -> list[StampedRow]:
        """Returns a bucket's envelope: two moments, or one of a single record."""
        records.sort(key=_tick)  # they nearly always are
        stamps_ns = [
            max(0, self._epoch_unix_ns + record.tick * NS_PER_S // self._rate_hz)
            for record in (records[0], records[len(records) // 2])
        ]
        return _two(stamps_ns[: len(records)], stack_signals(records))


def parse_viz_rate(text: str) -> float:
    """Returns the messages a second that a person asks for: a number from 1 on, or "off" or "full".

    Raises:
        UsageError: it is none of them.
    """
    words = {"off": 0.0, "full": FULL_RATE_HZ}
    try:
        rate_hz = words[text] if text in words else float(text)
    except ValueError:
        rate_hz = math.nan
    if text not in words and not 1.0 <= rate_hz <= 1e6:
        raise UsageError(f"--views is off, full, or messages a second from 1 on, not {text!r}")
    return rate_hz


def _two(stamps_ns: Sequence[int], columns: Iterable[SignalRow]) -> list[StampedRow]:
    """Returns the envelope of columns at the first and the middle of their stamps; of one row only that."""
    chosen = (stamps_ns[0], stamps_ns[len(stamps_ns) // 2])[: len(stamps_ns)]
    return list(zip(chosen, decimate_min_max(columns)))  # noqa: B905 - of a single row both are the same


class VizChannels:
    """The standard channels of a log while it is written.

    Args:
        scenario: what runs.
        session: the session's name.
        epoch_unix_ns: Unix time of tick 0; 0 in virtual time.
        views_hz: messages a second of the joints; `FULL` for one per record.
        put: writes a message.

    Attributes:
        channels: every channel there may be, by topic.
        takers: what takes the log's own messages, by their key.
        lanes: the buckets of every site.
    """

    def __init__(
        self, scenario: Scenario, session: str, epoch_unix_ns: int, views_hz: float, put: PutMessage
    ) -> None:
        self._epoch_unix_ns, self._put = epoch_unix_ns, put
        self.channels: dict[str, Ros2Channel] = {
            f"{VIZ_ROOT}{name}": channel for name, channel in SESSION_CHANNELS.items()
        }
        self.takers: dict[str, TakeMessage] = {
            topics.key(session, topics.RECORDER, topics.EVENT): self._event
        }
        self.lanes = []
        for site in scenario.names:
            rate_hz = scenario.sites[site].rate_hz
            writing = _SiteVizWriter(site, scenario.peers(site), put)
            lane = _SiteBuckets(writing, rate_hz, views_hz, epoch_unix_ns)
            self.lanes.append(lane)
            self.channels |= writing.channels
            self.takers[topics.key(session, site, topics.STATE)] = lane.record
            self.takers[topics.key(session, site, topics.LINK)] = lane.statistics
            self.takers[topics.key(session, site, topics.EVENT)] = self._event

    def _event(self, event: Event, log_ns: int) -> None:
        """Writes an event as of when it came: members that send at once need not arrive in that order."""
        stamp_ns = max(0, self._epoch_unix_ns + event.t_ns) if event.t_ns >= 0 else log_ns
        for name, data in pack_event(event, stamp_ns):
            self._put(f"{VIZ_ROOT}{name}", data, log_ns, log_ns)

    def finish(self, log_ns: int) -> None:
        """Lets out what has not been written yet.

        Args:
            log_ns: log time of the last message, Unix ns.
        """
        for lane in self.lanes:
            lane.finish(log_ns)


def decimate_min_max(columns: Iterable[SignalRow]) -> tuple[list[float], list[float]]:
    """Returns the smallest and the largest number of each column, the one that came first in the first list.

    Args:
        columns: finite numbers in the order in which they came; one at least in each.
    """
    first, second = [], []
    for column in columns:
        ordered = sorted(column)  # smooth curves are nearly in order: a third of what min and max take
        low, high = ordered[0], ordered[-1]
        start = column[0]
        if start == low or (start != high and column.index(low) < column.index(high)):
            first.append(low)
            second.append(high)
        else:
            first.append(high)
            second.append(low)
    return first, second

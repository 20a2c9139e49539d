"""Decimated ROS 2 channels of a log, for general viewers, with every extreme kept.

Invariant: the file holds the exact minimum and maximum of every curve in every bucket of a
site's records, in the order in which they came. Buckets have equal length on the tick grid. A
bucket's first message bears the time of its first record and is written at the bucket's end;
the second bears that of its middle record and is written half a bucket later. Records that
arrive after their bucket was closed form a bucket of their own.
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
from . import ros2_messages
from .cdr import JointStatePacker, pack_string

VIZ_HZ = 100.0
"""Messages a second by default, of the joints and their error."""
SLOW_VIZ_HZ = 10.0
"""Of exogenous torque, estimate and mode; but all of them if the joints are at full rate."""
FULL_RATE_HZ = math.inf
"""A message per record."""

MAX_PENDING_BYTES = 1 << 13
"""Most bytes that the channels of a site have still to write, per two joints of its arm."""
SENT_PENDING_BYTES = 512
"""And per number that its law sends, which may be an array of its own."""

PutMessage = Callable[[str, bytes, int, int], None]
"""Writes one message: topic, bytes, publish time and log time, Unix ns."""
TakeMessage = Callable[[Any, int], None]
"""Takes one message of the log's own, and its log time, Unix ns."""
StampedRow = tuple[int, ros2_messages.SignalRow]
"""A stamp, Unix ns, and its signals."""

_tick = attrgetter("tick")


class _BucketOutput:
    """Output of buckets: the first row at once, the second by `flush` or before the next
    bucket.

    `write` takes stamp, signals and log time.
    """

    def __init__(self, write: Callable[[int, ros2_messages.SignalRow, int], None]) -> None:
        self._write = write
        self._waiting: Sequence[StampedRow] = ()

    def add(self, rows: Sequence[StampedRow], log_ns: int) -> None:
        self.flush(log_ns)
        self._write(*rows[0], log_ns)
        self._waiting = rows[1:]

    def flush(self, log_ns: int) -> None:
        self.add_late(self._waiting, log_ns)
        self._waiting = ()

    def add_late(self, rows: Sequence[StampedRow], log_ns: int) -> None:
        for row in rows:
            self._write(*row, log_ns)


class _SiteBuckets:
    """Buckets of one site of a scenario, at `views_hz` messages a second of the joints.

    `channels` are those of the site, by topic.
    """

    def __init__(
        self, scenario: Scenario, site: str, views_hz: float, epoch_ns: int, put: PutMessage
    ) -> None:
        self._rate_hz = rate_hz = scenario.sites[site].rate_hz
        self._put = put
        self._epoch_unix_ns = epoch_ns
        self._shapes = shapes = ros2_messages.Ros2SiteChannels(scenario, site)
        names = [*shapes.joints, *(f"{name}_ref" for name in shapes.joints)]
        self._states = JointStatePacker(names)
        joints = len(shapes.joints)
        sent = scenario.channel(site).record_size
        self.most_pending_bytes = (
            MAX_PENDING_BYTES * -(-joints // 2) + SENT_PENDING_BYTES * sent
        )
        self._none = [math.nan] * joints  # velocity, effort of a reference: size is dear
        own = {"joint_states": shapes.joint_states(names), **shapes.channels}
        self._topics = {name: f"{VIZ_ROOT}{site}/{name}" for name in own}
        self.channels = {topic: own[name] for name, topic in self._topics.items()}
        self._described = shapes.robot is None
        self._half = max(1, int(rate_hz // views_hz))  # ticks of half a bucket
        self._ratio = (
            1 if views_hz == FULL_RATE_HZ else max(1, round(rate_hz / self._half / SLOW_VIZ_HZ))
        )
        self._fast = _BucketOutput(self._write_fast)
        self._slow = _BucketOutput(self._write_slow)
        self._bucket = self._first = self._half_end = (
            0  # the open bucket, its first tick, the end of a half
        )
        self._open: list[ros2_messages.Record] = []
        self._slow_open: list[StampedRow] = []
        self._late: list[ros2_messages.Record] = []

    def _write_fast(self, stamp_ns: int, row: ros2_messages.SignalRow, log_ns: int) -> None:
        """Writes the joint states, the angles of the reference as joints of their own; and the
        error.
        """
        none = self._none
        n = len(self._none)
        velocity = [*row[2 * n : 3 * n], *none]
        effort = [*row[3 * n : 4 * n], *none]
        data = self._states.pack(stamp_ns, row[: 2 * n], velocity, effort)
        self._put(self._topics["joint_states"], data, stamp_ns, log_ns)
        error = self._shapes.arrays["error"].pack(*row[self._shapes.error_row])
        self._put(self._topics["error"], error, stamp_ns, log_ns)
        robot = self._shapes.robot
        if robot is not None:
            if not self._described:
                self._described = True
                self._put(
                    self._topics[ros2_messages.ROBOT],
                    pack_string(robot.description),
                    stamp_ns,
                    log_ns,
                )
            self._put(
                self._topics[ros2_messages.FRAMES],
                robot.pack(stamp_ns, row[:n]),
                stamp_ns,
                log_ns,
            )

    def _write_slow(self, stamp_ns: int, row: ros2_messages.SignalRow, log_ns: int) -> None:
        for name, data in self._shapes.slow(row):
            self._put(self._topics[name], data, stamp_ns, log_ns)

    def record(self, message: ros2_messages.Record, log_ns: int) -> None:
        tick = message.tick
        # its bucket is closed: with others of that bucket it waits for the next close
        if tick < self._first:
            length = 2 * self._half
            if self._late and self._late[0].tick // length != tick // length:
                self._flush_late(log_ns)
            self._late.append(message)
            return
        if tick >= self._half_end:
            half = tick // self._half
            self._fast.flush(log_ns)
            if half // 2 != self._bucket:
                self._close(half // 2, log_ns)
            self._half_end = (half + 1) * self._half
        self._open.append(message)

    def statistics(self, stats: LinkStats, log_ns: int) -> None:
        stamp_ns = max(0, self._epoch_unix_ns + stats.t_ns)
        for name, data in self._shapes.statistics(stats):
            self._put(self._topics[name], data, stamp_ns, log_ns)

    def finish(self, log_ns: int) -> None:
        self._close(self._bucket + 2 * self._ratio, log_ns)
        self._fast.flush(log_ns)
        self._slow.flush(log_ns)

    def _close(self, bucket: int, log_ns: int) -> None:
        self._flush_late(log_ns)
        if self._open:
            rows = self._decimate(self._open)
            self._fast.add(rows, log_ns)
            self._slow_open += [
                (stamp_ns, row[self._shapes.slow_row]) for stamp_ns, row in rows
            ]
            self._open = []
        half = 2 * bucket // self._ratio
        was = 2 * self._bucket // self._ratio
        if half != was:
            self._slow.flush(log_ns)
        if half // 2 != was // 2 and self._slow_open:
            stamps_ns, signals = zip(*self._slow_open, strict=True)
            self._slow.add(_stamp_extremes(stamps_ns, zip(*signals, strict=True)), log_ns)
            self._slow_open = []
        self._bucket = bucket
        self._first = 2 * self._half * bucket

    def _flush_late(self, log_ns: int) -> None:
        if self._late:
            rows = self._decimate(self._late)
            self._fast.add_late(rows, log_ns)
            self._slow.add_late(
                [(stamp_ns, row[self._shapes.slow_row]) for stamp_ns, row in rows], log_ns
            )
            self._late = []

    def _decimate(self, records: list[ros2_messages.Record]) -> list[StampedRow]:
        records.sort(key=_tick)  # they nearly always are
        stamps_ns = [
            max(0, self._epoch_unix_ns + record.tick * NS_PER_S // self._rate_hz)
            for record in (records[0], records[len(records) // 2])
        ]
        return _stamp_extremes(stamps_ns[: len(records)], ros2_messages.stack_signals(records))


def parse_viz_rate(text: str) -> float:
    """Returns the messages a second of the option `--views`: a number from 1 on, or "off" or
    "full".

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


def _stamp_extremes(
    stamps_ns: Sequence[int], columns: Iterable[ros2_messages.SignalRow]
) -> list[StampedRow]:
    """Returns the extremes of columns at the first and the middle of their stamps; a single row
    as it is.
    """
    chosen = (stamps_ns[0], stamps_ns[len(stamps_ns) // 2])[: len(stamps_ns)]
    return list(zip(chosen, decimate_min_max(columns)))  # noqa: B905 - of a single row both are the same


class VizChannels:
    """The standard channels of a log while it is written.

    Args:
        scenario: the scenario that runs.
        session: the session's name.
        epoch_unix_ns: Unix time of tick 0; 0 in virtual time.
        views_hz: messages a second of the joints; `FULL_RATE_HZ` for one per record.
        put: writes a message.

    Attributes:
        channels: all channels that may occur, by topic.
        takers: functions that take the log's own messages, by their key.
    """

    def __init__(
        self,
        scenario: Scenario,
        session: str,
        epoch_unix_ns: int,
        views_hz: float,
        put: PutMessage,
    ) -> None:
        self._epoch_unix_ns = epoch_unix_ns
        self._put = put
        self.channels = {
            f"{VIZ_ROOT}{name}": channel
            for name, channel in ros2_messages.SESSION_CHANNELS.items()
        }
        self.takers: dict[str, TakeMessage] = {
            topics.key(session, member, topics.EVENT): self._event
            for member in (*scenario.names, topics.RECORDER)
        }
        self._buckets: list[_SiteBuckets] = []
        for site in scenario.names:
            buckets = _SiteBuckets(
                scenario=scenario, site=site, views_hz=views_hz, epoch_ns=epoch_unix_ns, put=put
            )
            self._buckets.append(buckets)
            self.channels |= buckets.channels
            self.takers[topics.key(session, site, topics.STATE)] = buckets.record
            self.takers[topics.key(session, site, topics.LINK)] = buckets.statistics

    def _event(self, event: Event, log_ns: int) -> None:
        stamp_ns = max(0, self._epoch_unix_ns + event.t_ns) if event.t_ns >= 0 else log_ns
        for name, data in ros2_messages.pack_event(event, stamp_ns):
            self._put(f"{VIZ_ROOT}{name}", data, log_ns, log_ns)

    def finish(self, log_ns: int) -> None:
        """Writes all that is open; `log_ns` is the log time of the last message, Unix ns."""
        for buckets in self._buckets:
            buckets.finish(log_ns)

    @property
    def most_bytes(self) -> int:
        """Most bytes that are still to be written."""
        return sum(buckets.most_pending_bytes for buckets in self._buckets)


def decimate_min_max(
    columns: Iterable[ros2_messages.SignalRow],
) -> tuple[list[float], list[float]]:
    """Returns the smallest and the largest number of each column, the one that came first in
    the first list.

    Each column has one finite number at least, in the order in which they came.
    """
    first = []
    second = []
    for column in columns:
        # smooth curves are nearly in order: a third of what min and max take
        ordered = sorted(column)
        low = ordered[0]
        high = ordered[-1]
        start = column[0]
        rises = start == low or (start != high and column.index(low) < column.index(high))
        first.append(low if rises else high)
        second.append(high if rises else low)
    return first, second

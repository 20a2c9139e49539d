"""Writes the curves of a run for general-purpose viewers, with fewer points than the log.

An arm typically publishes its state 1000 times a second, more than a viewer such as Foxglove
can draw smoothly. The states are therefore collected in buckets, intervals of equal length. A
bucket becomes two ROS 2 messages, which contain the minimum and the maximum of each curve in
the bucket, in the order in which the two occurred. No peak is lost.

The joints and their error appear in `views_hz` messages per second. The external torque, the
estimated parameters and the mode appear in only `SLOW_VIZ_HZ` messages per second.

Invariant:
    - The file contains the exact minimum and maximum of every curve in every bucket.
    - The first message of a bucket has the time of the bucket's first record, and is written at
      the end of the bucket.
    - The second message has the time of the bucket's middle record, and is written half a
      bucket later.
    - Records that arrive after their bucket was written form a separate bucket.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter

from ...log import FULL_RATE_HZ, VIZ_ROOT, MakeViews, McapWriter, PutMessage, ReceiveMessage
from ...net import Event, LinkStats, topics
from ...records import NS_PER_S
from ...scenario import Scenario
from . import ros2_messages
from .cdr import JointStatePacker, pack_string
from .ros2_messages import Record, Ros2Channel, SignalRow

SLOW_VIZ_HZ = 10.0
"""Rate of the messages with exogenous torque, estimate and mode, in Hz.

If every record results in a message about the joints, the same applies to these channels.
"""
MAX_PENDING_BYTES = 1 << 13
"""Maximum size of a site's messages that are still to be written, in bytes, for two joints."""
SENT_PENDING_BYTES = 512
"""Additional size for each number that the site's control law sends, in bytes. Each number may
be a separate array.
"""

StampedRow = tuple[int, SignalRow]
"""Time in Unix time, in ns, and the values of all curves at this time."""
WriteRow = Callable[[int, SignalRow, int], None]
"""Function that writes the values of all curves at one time, given the time, the values and the
arrival time.
"""

_get_tick = attrgetter("tick")


class _BucketOutput:
    """Writes two messages per time interval: at its end, and half an interval later.

    A message contains the values of all curves of a viewer at one time (a row). An interval is
    called a bucket. The second row is written by `flush`, or before the first row of the next
    bucket.

    Args:
        write: Function that writes a row, given its time, its values, and the arrival time in
            Unix time, in ns.
    """

    def __init__(self, write: WriteRow) -> None:
        self._write = write
        self._waiting_rows: Sequence[StampedRow] = ()

    def add(self, rows: Sequence[StampedRow], log_ns: int) -> None:
        """Writes the first row of a time interval immediately, and keeps the second for later.

        A row contains one value per curve. The two rows of an interval contain the minimum and
        the maximum of each curve. If the second row of the previous interval is still pending,
        it is written first.

        Args:
            rows: One or two rows with their times.
            log_ns: Arrival time to store in the log with the messages, in Unix time, in ns.
        """
        self.flush(log_ns)
        stamp_ns, row = rows[0]
        self._write(stamp_ns, row, log_ns)
        self._waiting_rows = rows[1:]

    def flush(self, log_ns: int) -> None:
        """Writes the second message of a time interval, if it is still pending.

        `add` held this message back, so that messages are evenly spaced in time.

        Args:
            log_ns: Arrival time to store in the log with the message, in Unix time, in ns.
        """
        self.write_all(self._waiting_rows, log_ns)
        self._waiting_rows = ()

    def write_all(self, rows: Sequence[StampedRow], log_ns: int) -> None:
        """Writes all rows of a time interval at once.

        Used for an interval whose records arrived late. For all other intervals, `add` spreads
        the rows over time.

        Args:
            rows: The rows with their times.
            log_ns: Arrival time to store in the log with the messages, in Unix time, in ns.
        """
        for stamp_ns, row in rows:
            self._write(stamp_ns, row, log_ns)


class _SiteBuckets:
    """The buckets of one site.

    A fast bucket contains records, and becomes two messages about the joints. A slow bucket
    contains the rows of several fast buckets, and becomes two messages with the other curves.

    Args:
        scenario: Scenario of the session.
        site: Name of the site.
        views_hz: Rate of the messages with the joints, in Hz.
        epoch_unix_ns: Unix time of tick 0, in ns; 0 in virtual time.
        put: Function that writes a message.

    Attributes:
        channels: Maps the topic of each channel of the site to its description.
        max_pending_bytes: Maximum size of the messages that are still to be written, in bytes.
    """

    def __init__(
        self,
        scenario: Scenario,
        site: str,
        views_hz: float,
        epoch_unix_ns: int,
        put: PutMessage,
    ) -> None:
        self._put = put
        self._epoch_unix_ns = epoch_unix_ns
        rate_hz = scenario.sites[site].rate_hz
        self._rate_hz = rate_hz
        site_channels = ros2_messages.Ros2SiteChannels(scenario, site)
        self._site_channels = site_channels
        joint_count = len(site_channels.joints)
        joint_pairs = (joint_count + 1) // 2
        sent_numbers = scenario.channel(site).record_size
        self.max_pending_bytes = (
            MAX_PENDING_BYTES * joint_pairs + SENT_PENDING_BYTES * sent_numbers
        )

        # The reference of each joint is written as an additional joint, named after the joint.
        # Only its angle is written, because the messages would be twice as large with velocity
        # and effort.
        references = [f"{name}_ref" for name in site_channels.joints]
        joint_names = [*site_channels.joints, *references]
        self._joint_state_packer = JointStatePacker(joint_names)
        self._joint_count = joint_count
        # Placeholders for the velocities and efforts of the references, which have neither.
        self._not_measured = [math.nan] * joint_count
        joint_channel = site_channels.joint_states(joint_names)
        channels = {"joint_states": joint_channel, **site_channels.channels}
        self._topics: dict[str, str] = {}
        self.channels: dict[str, Ros2Channel] = {}
        for name, channel in channels.items():
            topic = f"{VIZ_ROOT}{site}/{name}"
            self._topics[name] = topic
            self.channels[topic] = channel
        self._is_robot_described = site_channels.robot is None

        ticks_per_message = int(rate_hz // views_hz)
        self._half_ticks = max(1, ticks_per_message)
        self._bucket_ticks = 2 * self._half_ticks
        # Number of fast buckets in a slow bucket.
        self._slow_ratio = 1
        if views_hz != FULL_RATE_HZ:
            messages_hz = rate_hz / self._half_ticks
            slow_ratio = round(messages_hz / SLOW_VIZ_HZ)
            self._slow_ratio = max(1, slow_ratio)
        self._fast_output = _BucketOutput(self._write_fast)
        self._slow_output = _BucketOutput(self._write_slow)
        # The open bucket: its number, its first tick, and the end of the half that is being
        # filled.
        self._bucket = 0
        self._first_tick = 0
        self._half_end_tick = 0
        self._records: list[Record] = []
        self._slow_rows: list[StampedRow] = []
        # Records of one closed bucket, which arrived late.
        self._late_records: list[Record] = []

    def _write_fast(self, stamp_ns: int, row: SignalRow, log_ns: int) -> None:
        """Writes the fast messages at one time: the joints, their error, and the arm's frames.

        Each joint appears twice in the message `joint_states`: as itself, and as a second joint
        "NAME_ref" with the angle of its reference, which has neither velocity nor effort.
        Frames, the poses of the links, are written only for an arm that is described by a URDF
        file. The file itself is written before the first frames.

        Args:
            stamp_ns: Time of the values in Unix time, in ns.
            row: Values of all curves at this time, see `ros2_messages.stack_signals`. For n
                joints it begins with the positions, the references, the velocities and the
                efforts (torques), each with n entries.
            log_ns: Arrival time to store in the log with the messages, in Unix time, in ns.
        """
        n = self._joint_count
        positions_and_references = row[: 2 * n]
        velocity = row[2 * n : 3 * n]
        effort = row[3 * n : 4 * n]
        # The joints that stand for the references have neither velocity nor effort.
        joint_states = self._joint_state_packer.pack(
            stamp_ns,
            position=positions_and_references,
            velocity=[*velocity, *self._not_measured],
            effort=[*effort, *self._not_measured],
        )
        self._write_message("joint_states", joint_states, stamp_ns, log_ns)

        site_channels = self._site_channels
        errors = row[site_channels.error_row]
        error_array = site_channels.arrays["error"]
        self._write_message("error", error_array.pack(*errors), stamp_ns, log_ns)

        robot = site_channels.robot
        if robot is None:
            return
        if not self._is_robot_described:
            self._is_robot_described = True
            description = pack_string(robot.description)
            self._write_message(ros2_messages.ROBOT, description, stamp_ns, log_ns)
        frames = robot.pack(stamp_ns, row[:n])
        self._write_message(ros2_messages.FRAMES, frames, stamp_ns, log_ns)

    def _write_slow(self, stamp_ns: int, row: SignalRow, log_ns: int) -> None:
        """Writes the quantities that viewers need less often than the joints.

        These are the external torque, the estimate of the arm, the vectors that the law sends,
        and the mode.
        """
        for name, data in self._site_channels.pack_slow_arrays(row):
            self._write_message(name, data, stamp_ns, log_ns)

    def _write_message(self, name: str, data: bytes, stamp_ns: int, log_ns: int) -> None:
        """Writes a message to the channel whose topic ends in a given name."""
        topic = self._topics[name]
        self._put(topic, data, stamp_ns, log_ns)

    def add_record(self, record: Record, log_ns: int) -> None:
        """Adds a record of the site, and writes the messages that the record completes.

        Records are collected in buckets, intervals of equal length. A bucket becomes two
        messages with the minimum and the maximum of each curve. To space the messages evenly,
        the first message of a bucket is written when the first record of another bucket
        arrives, and the second one when a record in the second half of that other bucket
        arrives.

        Args:
            record: The record.
            log_ns: Arrival time in Unix time, in ns.
        """
        tick = record.tick
        is_bucket_written = tick < self._first_tick
        if is_bucket_written:
            self._add_late_record(record, log_ns)
            return

        begins_another_half = tick >= self._half_end_tick
        if begins_another_half:
            half = tick // self._half_ticks  # counted from tick 0
            bucket = half // 2
            # Write the second message of the previous bucket, if it is still waiting.
            self._fast_output.flush(log_ns)
            if bucket != self._bucket:
                self._close_bucket(bucket, log_ns)
            self._half_end_tick = (half + 1) * self._half_ticks
        self._records.append(record)

    def _add_late_record(self, record: Record, log_ns: int) -> None:
        """Stores a record that arrived after its bucket was written.

        Late records of one bucket are collected, and written as soon as a late record of
        another bucket arrives.
        """
        bucket = record.tick // self._bucket_ticks
        if self._late_records:
            late_bucket = self._late_records[0].tick // self._bucket_ticks
            if late_bucket != bucket:
                self._flush_late_records(log_ns)
        self._late_records.append(record)

    def add_statistics(self, stats: LinkStats, log_ns: int) -> None:
        """Writes statistics about the connections of the site as messages for viewers.

        The statistics are not thinned out, because a site publishes them only ten times a
        second.

        Args:
            stats: The statistics.
            log_ns: Arrival time in Unix time, in ns.
        """
        stamp_ns = max(0, self._epoch_unix_ns + stats.t_ns)
        for name, data in self._site_channels.pack_statistics(stats):
            self._write_message(name, data, stamp_ns, log_ns)

    def finish(self, log_ns: int) -> None:
        """Writes the messages for all records that were added but not yet written.

        Called at the end of the log.

        The records of a site are collected in time intervals of equal length, the fast buckets.
        The extremes of `_slow_ratio` successive fast buckets are collected in a slow bucket.
        Each bucket becomes two messages: the first is written when the bucket is closed, and
        the second half a bucket later. Until then, the second message is kept by one of two
        objects, one for fast and one for slow buckets.

        Args:
            log_ns: Arrival time to store in the log with the messages, in Unix time, in ns.
        """
        # A bucket is closed when a later one is opened. A fast bucket that belongs to a later
        # slow bucket closes both kinds. The next slow bucket would suffice, but one more
        # provides a margin.
        bucket_after_log = self._bucket + 2 * self._slow_ratio
        self._close_bucket(bucket_after_log, log_ns)
        # Write the second messages of these buckets at once.
        self._fast_output.flush(log_ns)
        self._slow_output.flush(log_ns)

    def _close_bucket(self, next_bucket: int, log_ns: int) -> None:
        """Reduces the records of the open bucket to two messages, and opens another bucket.

        The first message is written now, and the second half a bucket later (`_BucketOutput`).
        Late records of older buckets are written first.

        The slow curves, such as the estimate, are reduced a second time: a slow bucket consists
        of `_slow_ratio` fast buckets, and contains their extremes. It also becomes two
        messages, the first written at its end and the second half a slow bucket later.

        Args:
            next_bucket: Number of the bucket to open, counted from tick 0.
            log_ns: Arrival time to store in the log with the messages, in Unix time, in ns.
        """
        self._flush_late_records(log_ns)
        if self._records:
            extremes = self._decimate(self._records)
            self._fast_output.add(extremes, log_ns)
            self._slow_rows += self._select_slow_columns(extremes)
            self._records = []

        # Number of the half of a slow bucket in which a fast bucket begins. Two successive
        # halves, beginning with an even one, form a slow bucket.
        slow_half = 2 * self._bucket // self._slow_ratio
        next_slow_half = 2 * next_bucket // self._slow_ratio
        if next_slow_half != slow_half:
            # Half a slow bucket has passed: write the second message of the previous slow
            # bucket.
            self._slow_output.flush(log_ns)
        is_slow_bucket_over = next_slow_half // 2 != slow_half // 2
        if is_slow_bucket_over and self._slow_rows:
            # Transpose the values from a row per time to a curve per quantity.
            stamps_ns, value_rows = zip(*self._slow_rows, strict=True)
            curves = zip(*value_rows, strict=True)
            slow_extremes = _stamp_extremes(stamps_ns, curves)
            self._slow_output.add(slow_extremes, log_ns)
            self._slow_rows = []
        self._bucket = next_bucket
        self._first_tick = self._bucket_ticks * next_bucket

    def _flush_late_records(self, log_ns: int) -> None:
        """Writes the records that arrived after their bucket was written.

        As for other buckets, the minimum and the maximum of each curve are written, here to the
        fast and slow channels at once.
        """
        if self._late_records:
            rows = self._decimate(self._late_records)
            slow_rows = self._select_slow_columns(rows)
            self._fast_output.write_all(rows, log_ns)
            self._slow_output.write_all(slow_rows, log_ns)
            self._late_records = []

    def _select_slow_columns(self, rows: Iterable[StampedRow]) -> list[StampedRow]:
        """Selects the values of curves that need fewer points per second than the joint angles.

        Args:
            rows: Values of all curves, one row per time.
        """
        slow_row = self._site_channels.slow_row
        return [(stamp_ns, row[slow_row]) for stamp_ns, row in rows]

    def _decimate(self, records: list[Record]) -> list[StampedRow]:
        """Reduces the records of a bucket to the minimum and the maximum of each curve.

        A bucket is a time interval. The extremes of different curves occur at different times,
        so the two rows have no exact time. They are stamped with the beginning and the middle
        of the interval, which spaces the rows of successive buckets evenly.

        Args:
            records: The records of the bucket, at least one. Sorted by time in place.

        Returns:
            Two rows with their times, or one row for a single record.
        """
        # Records nearly always arrive in order, so sorting takes little time.
        records.sort(key=_get_tick)
        stamps_ns: list[int] = []
        first_record = records[0]
        middle_record = records[len(records) // 2]
        for record in (first_record, middle_record):
            t_ns = record.tick * NS_PER_S // self._rate_hz
            stamp_ns = max(0, self._epoch_unix_ns + t_ns)
            stamps_ns.append(stamp_ns)
        # A single record is both the first and the middle one, and needs only one time.
        row_count = min(2, len(records))
        curves = ros2_messages.stack_signals(records)
        return _stamp_extremes(stamps_ns[:row_count], curves)


def _stamp_extremes(stamps_ns: Sequence[int], curves: Iterable[SignalRow]) -> list[StampedRow]:
    """Reduces the curves of a time interval to two rows: the extremes of each curve.

    A row contains one value per curve. The first row contains the extreme of each curve
    (minimum or maximum) that occurs first, and the second row the other extreme.

    The extremes of different curves occur at different times, so the rows have no exact time.
    They are stamped with the beginning and the middle of the interval, which spaces the rows of
    successive intervals evenly.

    Args:
        stamps_ns: Times of the values in the interval in Unix time, in ns, at least one.
        curves: For each curve its values in the interval, in chronological order.

    Returns:
        The two rows, each with its time. Only one row if there is a single time.
    """
    middle_index = len(stamps_ns) // 2
    row_stamps_ns = (stamps_ns[0], stamps_ns[middle_index])
    rows = decimate_min_max(curves)
    # For a single time, the minimum and the maximum are equal, and one row is enough.
    row_count = min(2, len(stamps_ns))
    stamped_rows = zip(row_stamps_ns[:row_count], rows[:row_count], strict=True)
    return list(stamped_rows)


class VizChannels:
    """Adds messages for general-purpose viewers to the log of a session.

    Viewers such as Foxglove cannot decode or draw all messages of a session. For these viewers,
    the log contains additional standard ROS 2 messages with fewer points, which preserve the
    minimum and maximum of each curve in each interval.

    Args:
        scenario: Scenario of the session.
        session: Name of the session.
        epoch_unix_ns: Unix time of tick 0, in ns; 0 in virtual time.
        views_hz: Rate of the joint messages, in Hz. With `FULL_RATE_HZ`, one message is written
            per record.
        put: Function that writes a message to the log.

    Attributes:
        channels: Maps the topic of each channel that may occur to its description.
        receivers: Maps each key under which messages of the session are published to the
            function that receives these messages.
    """

    def __init__(
        self,
        scenario: Scenario,
        session: str,
        epoch_unix_ns: int,
        views_hz: float,
        put: PutMessage,
    ) -> None:
        """Prepares the channels for viewers such as Foxglove. No message is written yet."""
        self._epoch_unix_ns = epoch_unix_ns
        self._put = put

        # Channels and receivers of the whole session, for the events.
        self.channels: dict[str, Ros2Channel] = {}
        for name, channel in ros2_messages.SESSION_CHANNELS.items():
            self.channels[f"{VIZ_ROOT}{name}"] = channel
        self.receivers: dict[str, ReceiveMessage] = {}
        for member in (*scenario.names, topics.RECORDER):
            event_key = topics.key(session, member, topics.EVENT)
            self.receivers[event_key] = self._add_event

        # Channels and receivers of each site, for its records and statistics.
        self._buckets: list[_SiteBuckets] = []
        for site in scenario.names:
            buckets = _SiteBuckets(
                scenario=scenario,
                site=site,
                views_hz=views_hz,
                epoch_unix_ns=epoch_unix_ns,
                put=put,
            )
            self._buckets.append(buckets)
            self.channels |= buckets.channels
            state_key = topics.key(session, site, topics.STATE)
            self.receivers[state_key] = buckets.add_record
            link_key = topics.key(session, site, topics.LINK)
            self.receivers[link_key] = buckets.add_statistics

    def _add_event(self, event: Event, log_ns: int) -> None:
        """Writes an event of the session for viewers, as text and as a line for the ROS log.

        An event from before the start of the session states no time, so its arrival time is
        used.
        """
        stamp_ns = log_ns
        if event.t_ns >= 0:
            stamp_ns = max(0, self._epoch_unix_ns + event.t_ns)
        for name, data in ros2_messages.pack_event(event, stamp_ns):
            self._put(f"{VIZ_ROOT}{name}", data, log_ns, log_ns)

    def finish(self, log_ns: int) -> None:
        """Writes the remaining messages for viewers at the end of the log.

        The messages about a time interval are normally written after a later interval has
        begun, so the messages about the last interval are still waiting to be written.

        Args:
            log_ns: Arrival time of the last message of the session in Unix time, in ns.
        """
        for buckets in self._buckets:
            buckets.finish(log_ns)

    def open_channels(self, file: McapWriter) -> ros2_messages.StandardChannels:
        """Returns the channels that a file of a log has for viewers such as Foxglove.

        A channel is registered in the file only when its first message is written.

        Args:
            file: Writer of the MCAP file.
        """
        return ros2_messages.StandardChannels(file, self.channels)

    @property
    def most_bytes(self) -> int:
        """Upper bound on the size of the messages that are still to be written, in bytes.

        Messages are collected over a fixed interval of time (a bucket), and are written at its
        end.
        """
        return sum(buckets.max_pending_bytes for buckets in self._buckets)


def offer_views(scenario: Scenario, views_hz: float) -> MakeViews | None:
    """Returns the function with which a `LogWriter` creates its messages for viewers.

    The writer itself does not depend on ROS. It calls this function for each file of a log.

    Args:
        scenario: Scenario of the session.
        views_hz: Rate of the joint messages, in Hz, see `VizChannels`. If 0, the log contains
            no messages for viewers.

    Returns:
        The function, or None if `views_hz` is 0.
    """
    if not views_hz:
        return None

    def make_views(session: str, epoch_unix_ns: int, put: PutMessage) -> VizChannels:
        """Creates the object that writes one log file's messages for viewers such as Foxglove.

        Args:
            session: Name of the session.
            epoch_unix_ns: Start of the session, in ns since 1970.
            put: Function that writes a message.
        """
        return VizChannels(scenario, session, epoch_unix_ns, views_hz, put)

    return make_views


def decimate_min_max(curves: Iterable[SignalRow]) -> tuple[list[float], list[float]]:
    """Reduces each curve to two values, its minimum and its maximum.

    The two values keep the order in which they occur, so that a plotted curve keeps its peaks.

    Args:
        curves: Values of each curve in chronological order, at least one. All are finite.

    Returns:
        The earlier extreme of each curve, and the later extreme of each curve.
    """
    earlier: list[float] = []
    later: list[float] = []
    for values in curves:
        # Smooth curves are nearly sorted, so sorting takes a third of the time of min and max.
        ordered = sorted(values)
        minimum = ordered[0]
        maximum = ordered[-1]
        is_minimum_first = values[0] == minimum
        if not is_minimum_first and values[0] != maximum:
            minimum_index = values.index(minimum)
            maximum_index = values.index(maximum)
            is_minimum_first = minimum_index < maximum_index
        earlier.append(minimum if is_minimum_first else maximum)
        later.append(maximum if is_minimum_first else minimum)
    return earlier, later

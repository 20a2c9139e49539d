"""Provides the recorded states of one arm, as arrays over time or as single records.

An arm publishes a record of its state in every tick, and a log stores the records as encoded
bytes. This module decodes fields of all records into arrays (`SiteLog.q` contains the joint
angles), or complete records into objects (`SiteLog.states`).

Invariant:
    - Only the requested fields and records are decoded.
    - An invalid record raises an error that names the arm.
    - Memory for complete records is bounded, however long the log is: long sequences of records
      are decoded in blocks when they are accessed.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, Generic, NamedTuple, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from .. import process
from ..core import MAX_DELAY_US, POSE, POSITION, Array, LawChannel
from ..errors import LogError, WireError, count_nouns
from ..hooks import find_hook
from ..net import READABLE, State, decode
from ..records import NS_PER_S, Layout
from ..scenario import TracePoint
from .accounting import count_skipped_ticks
from .orientations import RotationVectors, align_signs
from .packed.indexed_records import IndexedRecords
from .packed.packed_messages import PackedMessages
from .record_columns import Ints, RecordColumns

M = TypeVar("M")
T = TypeVar("T")

MAX_DECODED_RECORDS = 1 << 16
"""Maximum number of decoded records of a site: one minute at 1 kHz, about 150 MB."""
BLOCK_RECORDS = 1 << 11
"""Number of records decoded together."""
HEAVY_BYTES = 12 << 20
_HEAVY_RATIO = 10
"""The records of a site are heavy if their decoded form is larger than `HEAVY_BYTES`, and also
larger than `_HEAVY_RATIO` times their encoded form. Only a few heavy records are cached in
decoded form, because a malicious file could otherwise fill the memory.
"""
_HEAVY_BLOCK = 128
"""Number of heavy records decoded together."""
_HEAVY_BLOCKS = 8
"""Number of blocks of heavy records cached in decoded form."""

DecodeStates = Callable[[Sequence[bytes]], list[State]]
"""Function that decodes several records, and raises an error if a payload is not a valid
record.
"""


def freeze(value: T) -> T:
    """Makes arrays read-only, so that users of a log cannot change its values by accident.

    Args:
        value: An array, or a tuple or dictionary of arrays, all of which are made read-only.

    Returns:
        The same object.
    """
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, dict):
        for item in value.values():
            freeze(item)
    elif isinstance(value, tuple):
        for item in value:
            freeze(item)
    return value


def compute_task_errors(x: Array, x_des: Array, axes: Sequence[float]) -> Array:
    """Computes the differences between the poses of an end effector and their references.

    The position error is x - x_des. The orientation error is the rotation vector (axis times
    angle) of the shortest rotation from the reference to the orientation.

    Args:
        x: Positions x, y, z in m, or poses, which are positions and rotation vectors in rad,
            shape (K, m), for K records.
        x_des: Their references, in the same format, shape (K, m).
        axes: One entry per coordinate: 1 if the site follows its reference along that axis, or
            0 if not, in which case the error is set to 0.

    Returns:
        The errors, shape (K, m), in m and rad.
    """
    e: Array = x - x_des
    if e.shape[1] > POSITION:
        orientations = RotationVectors(x[:, POSITION:])
        e[:, POSITION:] = orientations.turns_from(x_des[:, POSITION:])
    e *= np.array(axes)
    return e


class LazyRecords(Sequence[State]):
    """Sequence of the records of a site, decoded only when they are accessed.

    The records are decoded in blocks, and the most recently used blocks are cached. A log of
    any length can therefore be read with little memory.

    Args:
        payloads: The encoded records.
        decode_block: Function that decodes several encoded records.
        heavy: True if the decoded records are so large that only a few of them are cached, see
            `HEAVY_BYTES`.
    """

    def __init__(
        self, payloads: Sequence[bytes], decode_block: DecodeStates, *, heavy: bool = False
    ) -> None:
        """Stores encoded records, which are decoded in blocks when they are accessed."""
        block_size = _HEAVY_BLOCK if heavy else BLOCK_RECORDS
        block_count = _HEAVY_BLOCKS if heavy else MAX_DECODED_RECORDS // block_size
        self._payloads = payloads
        self._size = block_size

        @lru_cache(maxsize=block_count)
        def get_block(number: int) -> list[State]:
            """Returns a block of consecutive records, decoding it if it is not cached.

            Args:
                number: Number of the block, counted from 0.
            """
            first = number * block_size
            return decode_block(payloads[first : first + block_size])

        self._get_block = get_block

    @classmethod
    def decode_short(
        cls, payloads: Sequence[bytes], decode_block: DecodeStates
    ) -> Sequence[State]:
        """Decodes the records of a site at once if they need little memory.

        A list is faster to use, but keeps all decoded records in memory. Records are therefore
        decoded immediately only if there are at most `MAX_DECODED_RECORDS` of them, and if they
        are not heavy (see `HEAVY_BYTES`).

        Args:
            payloads: The encoded records.
            decode_block: Function that decodes a block of them.

        Returns:
            The records in the order of `payloads`: a list, or a sequence that decodes on
            access.
        """
        if len(payloads) > MAX_DECODED_RECORDS:
            return cls(payloads, decode_block)

        remaining_bytes = max(HEAVY_BYTES, _HEAVY_RATIO * sum(map(len, payloads)))
        states: list[State] = []
        with process.pause_gc():
            for first in range(0, len(payloads), BLOCK_RECORDS):
                block = decode_block(payloads[first : first + BLOCK_RECORDS])
                remaining_bytes -= sum(map(_estimate_bytes, block))
                if remaining_bytes < 0:
                    return cls(payloads, decode_block, heavy=True)
                states += block
        return states

    def __len__(self) -> int:
        return len(self._payloads)

    def __iter__(self) -> Iterator[State]:
        for first in range(0, len(self._payloads), self._size):
            yield from self._get_block(first // self._size)

    @overload
    def __getitem__(self, index: int) -> State: ...
    @overload
    def __getitem__(self, index: slice) -> list[State]: ...
    def __getitem__(self, index: int | slice) -> State | list[State]:
        if isinstance(index, slice):
            return [self[n] for n in range(*index.indices(len(self)))]
        row = index + len(self) if index < 0 else index
        if not 0 <= row < len(self):
            raise IndexError(
                f"there is no record {index}: the log of this site has "
                f"{count_nouns(len(self), 'record')}"
            )
        block = self._get_block(row // self._size)
        return block[row % self._size]


def _estimate_bytes(state: State) -> int:
    """Estimates the memory that a decoded record needs, in bytes.

    Each entry of `rx`, `echo` and `cmd` is a separate Python object, and needs much memory.
    """
    entries = len(state.rx) + len(state.echo) + len(state.cmd)
    return 2_000 + 130 * entries + 100 * len(state.used) + 32 * len(state.mem)


class RecordsByTick(Mapping[int, State]):
    """Read-only mapping from ticks to the records of a site.

    Used for long logs, because a record is decoded only when it is accessed. If several records
    have the same tick, the mapping contains the last of them.

    Args:
        states: The K records, in tick order.
        ticks: The tick of each record, shape (K,).
    """

    def __init__(self, states: Sequence[State], ticks: Ints) -> None:
        self._states = states
        self._array = ticks

    @cached_property
    def _ticks(self) -> list[int]:
        """The ticks as a list, which is faster to search than an array."""
        ticks: list[int] = self._array.tolist()
        return ticks

    def __getitem__(self, tick: int) -> State:
        row = bisect_right(self._ticks, tick) - 1
        if row < 0 or self._ticks[row] != tick:
            raise KeyError(tick)
        return self._states[row]

    def __iter__(self) -> Iterator[int]:
        return iter(dict.fromkeys(self._ticks))

    def __len__(self) -> int:
        return len(set(self._ticks))


class TimedMessages(NamedTuple, Generic[M]):
    """Messages of a log with their sending and arrival times.

    Attributes:
        messages: The K messages.
        log_ns: Arrival times at the recorder in Unix time, shape (K,), in ns.
        publish_ns: Sending times in Unix time, shape (K,), in ns.
    """

    messages: list[M]
    log_ns: Ints
    publish_ns: Ints


class _RecordField(cached_property[T]):
    """Property of `SiteLog` that provides one field of all records as an array.

    The field is decoded when the property is first accessed. The name of the property is the
    name of the field.

    Args:
        read_column: Function that takes a `SiteLog` and the name of the field, and returns its
            values in all records.
        meaning: Docstring of the property.
    """

    def __init__(self, read_column: Callable[["SiteLog", str], T], meaning: str) -> None:
        super().__init__(lambda site: read_column(site, str(self.attrname)))
        self.__doc__ = meaning


class _RecordVector(cached_property[Array]):
    """Property of `SiteLog` that provides one vector of all records as an array.

    See `_RecordField`.

    Args:
        meaning: Docstring of the property.
    """

    def __init__(self, meaning: str) -> None:
        super().__init__(lambda site: site._read_vectors(self.attrname)[self.attrname])
        self.__doc__ = meaning


def _read_ints(site: "SiteLog", field: str) -> Ints:
    """Returns an integer field of all records of a site, shape (K,)."""
    if site.indexed is not None and site.indexed.has_ints(field):
        return freeze(site.indexed.ints(field))
    return site._read(RecordColumns.ints, field)


def _read_objects(site: "SiteLog", field: str) -> NDArray[np.object_]:
    """Returns the field `mode` or `mem` of all records of a site, shape (K,)."""
    if site.indexed is None:
        return site._read(RecordColumns.objects, field)
    return freeze(site.indexed.modes if field == "mode" else site.indexed.memories)


class SiteLog:
    """Records of one site, in tick order.

    `Log` creates one such object per site. In the following, K is the number of records, n the
    number of joints, m the number of coordinates that the sites share (the joints, or the
    coordinates of the end effector in task space), and P the number of parameters.

    Args:
        name: Name of the site.
        peers: Names of the peers from which the site receives samples, in scenario order.
        rate_hz: Tick rate of the site, in Hz.
        payloads: The encoded records, as published, in any order.
        source: Name of the file for error messages.
        times: Arrival and sending times of the records in Unix time, each of shape (K,), in ns.
            If None, all times are 0.
        layout: Lengths of the vectors of a record: n, m and P.
        channel: Names and lengths of the vectors that the site's control law sends to its
            peers.
        axes: In task space, 1 for each coordinate that the site follows, and 0 for the others.

    Attributes:
        payloads: The encoded records, in tick order.
        indexed: The records in a form whose fields compiled code can read, if all of them have
            the exact layout that this program writes.
        tick: Tick of each record, shape (K,).
        log_time_ns: Arrival time of each record at the recorder in Unix time, shape (K,), in
            ns.
        publish_time_ns: Sending time stated by each record in Unix time, shape (K,), in ns.

    Raises:
        LogError: A record cannot be read. Also raised by the properties, for the fields that
            they decode.
    """

    def __init__(
        self,
        name: str,
        peers: tuple[str, ...],
        rate_hz: int,
        payloads: Sequence[bytes],
        source: str,
        times: tuple[Ints, Ints] | None = None,
        layout: Layout = Layout(),  # noqa: B008
        channel: LawChannel = LawChannel(),  # noqa: B008
        axes: tuple[float, ...] = (),
    ) -> None:
        """Finds the tick of each encoded record, and sorts the records."""
        self.channel = channel
        self.name = name
        self.peers = peers
        self.rate_hz = rate_hz
        self.layout = layout
        self.axes = axes
        self._source = source

        # If all records have the usual layout, their fields are read without decoding them.
        self.payloads = PackedMessages.pack(payloads)
        self.indexed = IndexedRecords.of_payloads(self.payloads, name, peers, layout)
        if self.indexed is None:
            self.tick = self._read(RecordColumns.ticks)
        else:
            self.tick = self.indexed.ticks
        zeros = np.zeros(len(payloads), dtype=np.int64)
        self.log_time_ns, self.publish_time_ns = times or (zeros, zeros)

        is_unordered = (self.tick[1:] < self.tick[:-1]).any()
        if is_unordered:  # records that arrived late are stored after later ones
            order = np.argsort(self.tick, kind="stable")
            self.tick = self.tick[order]
            self.payloads = self.payloads.select(order)
            if self.indexed is not None:
                self.indexed = self.indexed.select(order)
            self.log_time_ns = self.log_time_ns[order]
            self.publish_time_ns = self.publish_time_ns[order]
        freeze((self.tick, self.log_time_ns, self.publish_time_ns))

    def __len__(self) -> int:
        return len(self.payloads)

    def __dir__(self) -> list[str]:
        return sorted(name for name in super().__dir__() if not name.startswith("_"))

    def __repr__(self) -> str:
        if not len(self):
            return f"<{self.name}: no records>"
        first_s = self.tick[0] / self.rate_hz
        last_s = self.tick[-1] / self.rate_hz
        records = f"{count_nouns(len(self), 'record')} of {self.rate_hz} Hz"
        span = f"{first_s:.3f} s to {last_s:.3f} s"
        return f"<{self.name}: {records}, {span}, {self.missing or 'none'} missing>"

    def _repr_html_(self) -> str:
        return str(find_hook("render a site's records as HTML")(self))

    def _read(self, decode_column: Callable[..., T], *arguments: Any) -> T:
        """Decodes quantities of all records into read-only arrays.

        Args:
            decode_column: Method of `RecordColumns`, or a function that takes such an object.
            *arguments: Further arguments of that method.

        Raises:
            LogError: A record cannot be decoded.
        """
        return self._read_from(self.payloads, decode_column, *arguments)

    def _read_from(
        self, payloads: Sequence[bytes], decode_column: Callable[..., T], *arguments: Any
    ) -> T:
        """Decodes a field of the given records into a read-only array.

        Args:
            payloads: The encoded records.
            decode_column: Method of `RecordColumns`, or a function that takes such an object.
            *arguments: Further arguments of that method, such as the name of the field.

        Raises:
            LogError: A record cannot be decoded.
        """
        try:
            return freeze(decode_column(RecordColumns(payloads), *arguments))
        except WireError as error:
            raise LogError(
                f"{self._source}: a record of {self.name} cannot be read: {error}"
            ) from None

    def prepare(self, *fields: str) -> None:
        """Decodes several fields of all records together, before they are accessed.

        The fields are vectors such as joint angles. Decoding them together is three times as
        fast as decoding them one by one.

        Args:
            fields: Names of the vectors, such as "q" and "tau".
        """
        missing = [field for field in fields if field not in self.__dict__]
        if missing:
            self.__dict__.update(self._read_vectors(*missing))

    def _read_vectors(self, *fields: str) -> dict[str, Array]:
        """Maps the name of each vector to its values in all records, shape (K, length)."""
        if self.indexed is not None:
            return freeze(self.indexed.vectors(fields))
        return self._read(RecordColumns.vectors, self.layout, *fields)

    def numbers(self, field: str) -> Ints:
        """Returns an integer field of all records as an array, for example "busy_us".

        Args:
            field: Name of the field in a record, see `State`.

        Returns:
            The value in each record, shape (K,), in tick order.
        """
        return _read_ints(self, field)

    def memory(self, first: int, count: int) -> Array:
        """Returns a part of the control law's internal state in all records.

        The field `mem` of a record contains all numbers that the site and its control law need
        to continue from this tick and that are in no other field. The numbers have no names.

        Args:
            first: Index in `mem` of the first number to return.
            count: Number of entries to return.

        Returns:
            The selected entries, shape (K, count).

        Raises:
            LogError: `mem` has too few entries in a record.
        """
        wanted_numbers = [row[first : first + count] for row in self.mem]
        try:
            return np.array(wanted_numbers, dtype=np.float64).reshape(len(self), count)
        except ValueError:
            # The lists have different lengths, or all of them are too short.
            needed = f"{count_nouns(first + count, 'number')} in `mem`"
            raise LogError(
                f"{self._source}: a record of {self.name} does not have {needed}"
            ) from None

    def record(self, n: int) -> State:
        """Decodes a single record without decoding the others, which is fast for a long log.

        Args:
            n: Index of the record in tick order. -1 is the last record.

        Returns:
            The record.
        """
        return self.decode([self.payloads[n]])[0]

    def decode(self, payloads: Sequence[bytes]) -> list[State]:
        """Decodes complete records, and checks that the vector lengths match those of this arm.

        Args:
            payloads: Encoded records of the site.

        Raises:
            LogError: A record cannot be decoded.
        """

        def decode_states(_: RecordColumns) -> list[State]:
            return [decode(payload, State, READABLE, self.layout) for payload in payloads]

        return self._read(decode_states)

    @cached_property
    def states(self) -> Sequence[State]:
        """The complete records in tick order, decoded and checked.

        If there are many records, a record is decoded only when it is accessed. For
        computations on a single quantity, arrays such as `q` are much faster.
        """
        return LazyRecords.decode_short(self.payloads, self.decode)

    @cached_property
    def lazy_states(self) -> Sequence[State]:
        """The records of `states`, decoded on access, for callers that need only a few."""
        return LazyRecords(self.payloads, self.decode, heavy=True)

    @cached_property
    def by_tick(self) -> "dict[int, State] | RecordsByTick":
        """Mapping from ticks to records.

        Used to compare two logs tick by tick, because either log may lack records. If several
        records have the same tick, the last one is used.
        """
        if isinstance(self.states, LazyRecords):
            return RecordsByTick(self.states, self.tick)
        return {state.tick: state for state in self.states}

    @cached_property
    def lazy_by_tick(self) -> Mapping[int, State]:
        """The mapping `by_tick`, whose records are decoded on access."""
        return RecordsByTick(self.lazy_states, self.tick)

    @property
    def last_tick(self) -> int:
        """Tick of the last record, or -1 if there are no records.

        Ticks are counted from 0 at the start of the run.
        """
        return int(self.tick[-1]) if len(self) else -1

    @property
    def diverged_s(self) -> float | None:
        """Time at which the arm exceeded a safety limit, which ended the run, in s.

        This is the time of the last record if its mode is "diverged". None if the arm stayed
        within its limits, or if there are no records.
        """
        if not len(self):
            return None
        last = self.record(-1)
        return last.t_ns / NS_PER_S if last.mode == "diverged" else None

    @property
    def missing(self) -> int:
        """Number of ticks before the last record that have no record.

        These records were lost in the network or because a queue was full, or the site skipped
        the ticks. Records missing after the last one cannot be counted here.
        """
        if not len(self):
            return 0
        # There are `last_tick` ticks before the last record. The number of different recorded
        # ticks before it equals the number of changes of the tick from record to record.
        recorded_ticks = int(np.count_nonzero(np.diff(self.tick)))
        return self.last_tick - recorded_ticks

    @property
    def skipped(self) -> int:
        """Number of ticks that the site skipped because it was late, according to its records.

        Only a site with an external arm skips ticks, because a real arm cannot catch up.
        """
        return sum(last - first + 1 for first, last in self.skipped_ranges)

    @property
    def skipped_ranges(self) -> list[tuple[int, int]]:
        """Ranges (first tick, last tick) of skipped ticks, in ascending order.

        The record after a range states how many ticks the site skipped before it.
        """
        ranges = []
        for next_tick, texts in sorted(self._changes.items()):
            skipped = min(count_skipped_ticks(texts), next_tick)
            if skipped:
                ranges.append((next_tick - skipped, next_tick - 1))
        return ranges

    mode = _RecordField(
        _read_objects,
        'Mode, shape (K,): "run", "hold", "brake", "return", "waiting", "fault", "stopped" '
        'or "diverged".',
    )
    q = _RecordVector("Joint angles, shape (K, n), rad.")
    qd = _RecordVector("Joint velocities, shape (K, n), rad/s.")
    q_des = _RecordVector(
        "Reference of Eq. (6), a weighted mean of the peers' positions, shape (K, m), rad."
    )
    qd_des = _RecordVector("Derivative of the reference, shape (K, m), rad/s.")
    tau = _RecordVector("Control torque of Eq. (13), shape (K, n), N m.")
    tau_x = _RecordVector(
        "Exogenous torque with the sign of Eq. (8), shape (K, n), N m. The torque on the arm "
        "is its negative.",
    )
    theta_hat = _RecordVector(
        "Estimate of the arm's dynamic parameters, Eq. (15), shape (K, P). Those of a two-link "
        "arm are defined in Eq. (24)."
    )
    x = _RecordVector(
        "In task space, the recorded position and rotation vector of the end effector, shape "
        "(K, m), m and rad. The vector jumps where it passes half a turn. `orientation` does "
        "not jump."
    )
    xd = _RecordVector("Derivative of x, shape (K, m), m/s and rad/s.")
    wrench = _RecordVector(
        "Wrench in task space that is equivalent to tau_x, shape (K, m), N and N m."
    )
    ch = _RecordVector(
        "All entries of the vectors that the site's control law sends to its peers, shape "
        "(K, C). `sent` maps the name of each vector to its entries."
    )
    hand = _RecordVector(
        "Action of the person or program that holds the arm, shape (K, h), see `HandInForce`."
    )
    bodies = _RecordVector(
        "Recorded poses of the b bodies in the site's plant, a simulated environment of the "
        "arm, shape (K, 7 b), m and quaternions."
    )
    mem = _RecordField(
        _read_objects,
        "State of the site and its control law that is in no other field, shape (K,), as a "
        "list of numbers per record.",
    )
    t_ns = _RecordField(
        _read_ints,
        "Nominal time since the epoch, the common start time of the session, shape (K,), ns.",
    )
    late_us = _RecordField(
        _read_ints,
        "Time from the nominal to the actual start of the tick, shape (K,), us; 0 in virtual "
        "time.",
    )
    sent_ns = _RecordField(
        _read_ints,
        "Time since the epoch at which each record was sent, on the site's own clock, shape "
        "(K,), ns.",
    )

    @cached_property
    def t_s(self) -> Array:
        """Nominal time since the epoch, the common start of the session, shape (K,), in s.

        This is the ideal time of each tick, not the time at which the tick was computed.
        """
        return freeze(self.t_ns / NS_PER_S)

    @cached_property
    def orientation(self) -> Array:
        """Orientation of the end effector as unit quaternions (w, x, y, z), shape (K, 4).

        A quaternion and its negative represent the same orientation. Signs are chosen to bring
        each quaternion closest to the previous one. The shape is (K, 0) for sites that do not
        follow orientations.
        """
        return self._compute_orientation(self.x)

    @cached_property
    def orientation_des(self) -> Array:
        """Orientation of the reference as unit quaternions (w, x, y, z), shape (K, 4).

        The reference is the motion that the end effector follows, and K is the number of
        records. The shape is (K, 0) for sites that do not follow orientations. Signs are chosen
        to bring each quaternion closest to the previous one.
        """
        return self._compute_orientation(self.q_des)

    def _compute_orientation(self, poses: Array) -> Array:
        """Converts poses of shape (K, m) to unit quaternions.

        Returns:
            The quaternions, shape (K, 4), or (K, 0) if the site does not follow orientations.
        """
        if not self.layout.task or self.layout.shared != POSE:
            return freeze(np.zeros((len(self), 0)))
        return freeze(RotationVectors(poses[:, POSITION:]).as_quaternions())

    @cached_property
    def body_poses(self) -> Array:
        """Poses of the b bodies in the simulated environment of the arm, shape (K, b, 7).

        A pose consists of the position x, y, z in m and the orientation as a unit quaternion w,
        x, y, z. A quaternion and its negative represent the same orientation. The sign is
        chosen to bring the quaternion closest to the previous one.
        """
        poses = self.bodies.reshape(len(self), -1, POSITION + 4).copy()
        for body in range(poses.shape[1]):
            poses[:, body, POSITION:] = align_signs(poses[:, body, POSITION:])
        return freeze(poses)

    @property
    def e(self) -> Array:
        """Synchronisation error q - q_des, Eq. (9), shape (K, n), in rad.

        In task space, the error is x - x_des, shape (K, m), in m. For orientations, the error
        is the rotation vector from the reference to the end effector, in rad, with an angle of
        at most half a turn. The control law uses the same vector, which jumps where the angle
        passes half a turn.
        """
        if self.layout.task:
            return compute_task_errors(self.x, self.q_des, self.axes)
        return self.q - self.q_des

    @cached_property
    def sent(self) -> dict[str, Array]:
        """Quantities that the site's control law sends to the other sites in each tick.

        Each key is the name of a quantity in the control law, such as "E", if all other sites
        receive the same values. If the values are meant for one site, the key also contains its
        name, such as "u[m2]". Each value is an array of shape (K, w), for K records and w
        entries of the quantity. Empty if the control law sends nothing.
        """
        columns: dict[str, list[int]] = {}
        for column, entry in enumerate(self.channel.entries(self.peers)):
            columns.setdefault(entry.key, []).append(column)
        return freeze({key: self.ch[:, indices] for key, indices in columns.items()})

    @cached_property
    def busy_us(self) -> Ints:
        """Computing time of each tick except the last one, shape (K - 1,), in us.

        A record contains the computing time of the previous tick, because that of its own tick
        is not yet known when the record is published. The values are shifted by one row
        accordingly.
        """
        return self.numbers("busy_us")[1:]

    @cached_property
    def used(self) -> dict[str, Ints]:
        """Tick of the sample of each peer that the control law used in the tick of each record.

        Maps the name of each peer to an array of shape (K,). The tick is -1 before the first
        sample of the peer.
        """
        if self.indexed is not None:
            ticks = self.indexed.used
            return freeze({peer: ticks[:, n].copy() for n, peer in enumerate(self.peers)})
        return self._read(RecordColumns.per_peer, "used", self.peers, -1)

    @cached_property
    def arrivals(self) -> tuple[Ints, Ints]:
        """Samples from other arms that arrived at this arm, with their delays.

        The first array contains the number of samples in each record, shape (K,). The second
        lists all N arrivals in order, shape (N, 3), with the columns of `rx`: index of the
        peer, tick of the sample, and delay in us.
        """
        if self.indexed is not None:
            return freeze(self.indexed.arrivals)
        return self._read(RecordColumns.arrivals)

    @cached_property
    def _changes(self) -> dict[int, list[str]]:
        """Maps each tick whose record has a nonempty field `cmd` to the strings in it."""
        ticks = self.tick
        payloads = self.payloads
        if self.indexed is not None:
            rows = np.flatnonzero(self.indexed.change_counts)
            ticks = ticks[rows]
            payloads = payloads.select(rows)
        texts = self._read_from(payloads, RecordColumns.objects, "cmd").tolist()
        pairs = zip(ticks.tolist(), texts, strict=True)
        return {tick: tick_texts for tick, tick_texts in pairs if tick_texts}

    def changes(self) -> dict[int, list[str]]:
        """Lists the parameter changes that the site applied during the run.

        Returns:
            Maps each tick with changes to the changes as JSON strings, in order of application.
        """
        return {tick: list(texts) for tick, texts in self._changes.items()}

    def age_ns(self, peer: str, rate_hz: int) -> Ints:
        """Computes the age of the peer's sample that the control law used in each tick, in ns.

        The age is the time of the record minus the stamp of the sample. The stamp is the
        nominal time of the tick in which the peer computed the sample.

        Args:
            peer: Name of the peer.
            rate_hz: Tick rate of the peer, in Hz.

        Returns:
            The ages, shape (K,), in ns. They have no meaning before the first sample, where the
            tick in `used` is -1.
        """
        stamps_ns = self.used[peer] * NS_PER_S // rate_hz
        return self.t_ns - stamps_ns

    def age_s(self, peer: str, rate_hz: int) -> Array:
        """Computes the age of the peer's sample that the control law used in each tick, in s.

        See `age_ns` for the definition of the age.

        Args:
            peer: Name of the peer.
            rate_hz: Tick rate of the peer, in Hz.

        Returns:
            The ages, shape (K,), in s. NaN before the first sample.
        """
        has_sample = self.used[peer] >= 0
        return np.where(has_sample, self.age_ns(peer, rate_hz) / NS_PER_S, np.nan)

    def iterate_delays(
        self, peer: str, rate_hz: int, sent_ticks: Sequence[int]
    ) -> Iterator[TracePoint]:
        """Yields the stamp and the delay of every sample of a peer, in order of their stamps.

        A sample that was sent but did not arrive has an infinite delay. It is left out if it
        may have arrived in a tick whose record is missing. See `Log.link_delays` for the
        definition of the delay.

        Args:
            peer: Name of the sender.
            rate_hz: Tick rate of the sender, in Hz.
            sent_ticks: Ticks of the samples that the sender is known to have sent. If empty,
                samples of all ticks up to the last arrival count as sent.

        Yields:
            The stamp in s after the start of the session, and the delay in ms.
        """
        _, arrivals = self.arrivals
        is_from_peer = (arrivals[:, 0] == self.peers.index(peer)) & (arrivals[:, 1] >= 0)
        arrived_ticks, sample_of_arrival = np.unique(
            arrivals[is_from_peer, 1], return_inverse=True
        )
        # A sample may arrive several times, and its shortest delay counts.
        shortest_us = np.full(len(arrived_ticks), MAX_DELAY_US)
        arrival_delays_us = np.maximum(arrivals[is_from_peer, 2], 0)
        np.minimum.at(shortest_us, sample_of_arrival, arrival_delays_us)
        pairs = zip(arrived_ticks.tolist(), shortest_us.tolist(), strict=True)
        delays_us: dict[int, int] = dict(pairs)
        if not delays_us:
            return

        longest_ns = 1000 * max(delays_us.values())
        gaps = self._find_gaps_ns()
        # Samples that were sent before the first or after the last arrival were lost as well.
        ticks = {*sent_ticks, *delays_us} if sent_ticks else range(max(delays_us) + 1)
        for tick in sorted(ticks):
            stamp_ns = tick * NS_PER_S // rate_hz
            # The simulation kernel counts in whole microseconds.
            stamp_s = stamp_ns // 1000 / 1e6
            if tick in delays_us:
                yield stamp_s, delays_us[tick] / 1e3
                continue

            latest_arrival_ns = stamp_ns + longest_ns
            may_have_arrived_unseen = any(
                stamp_ns <= gap_end and latest_arrival_ns >= gap_start
                for gap_start, gap_end in gaps
            )
            if not may_have_arrived_unseen:
                yield stamp_s, math.inf

    def _find_gaps_ns(self) -> list[tuple[int, float]]:
        """Returns the intervals in which a sample may have arrived although no record shows it.

        Records are missing before the first record, between records whose ticks are not
        consecutive, and after the last record.

        Returns:
            The intervals (start, end), in ns after the start of the session.
        """
        if not len(self):
            return [(0, math.inf)]
        rows = np.flatnonzero(np.diff(self.tick) != 1)
        gap_starts = self.t_ns[rows].tolist()
        gap_ends = self.t_ns[rows + 1].tolist()
        gaps: list[tuple[int, float]] = list(zip(gap_starts, gap_ends, strict=True))
        if self.tick[0] > 0:
            gaps.append((0, int(self.t_ns[0])))
        gaps.append((int(self.t_ns[-1]), math.inf))
        return gaps

"""The records of one site of a log: as arrays over time, or one by one.

Invariant:
    - Only requested fields and records are decoded.
    - An invalid record is an error that names the site.
    - Memory is bounded for a log of any length: long sequences of records are decoded in blocks
      when they are accessed.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Any, Generic, NamedTuple, TypeVar, overload

import numpy as np

from .. import process
from ..core.law_channel import LawChannel
from ..core.site_setup import Layout
from ..core.task_space import POSE, POSITION
from ..core.ticks import NS_PER_S
from ..core.vectors import Array
from ..errors import LogError, WireError, count_nouns
from ..net.messages import READABLE, State
from ..net.wire import decode
from ..scenario.run_changes import count_skipped_ticks
from . import record_columns
from .orientations import align_signs, compute_quaternion_parts, compute_quaternions
from .record_columns import Ints

M = TypeVar("M")
T = TypeVar("T")

MAX_DECODED_RECORDS = 1 << 16
"""Largest number of decoded records of a site: a minute at 1 kHz, some 150 MB."""
BLOCK_RECORDS = 1 << 11
"""Number of records that are decoded together."""
HEAVY_BYTES = 12 << 20
HEAVY_RATIO = 10
"""Records are heavy if their decoded form is larger than `HEAVY_BYTES`, and also larger than
`HEAVY_RATIO` times their payloads. Only few heavy records are kept decoded, because a hostile
file could otherwise fill the memory.
"""
HEAVY_BLOCK = 128
"""Number of heavy records that are decoded together."""
HEAVY_BLOCKS = 8
"""Number of blocks of heavy records that are kept decoded."""

DecodeStates = Callable[[Sequence[bytes]], list[State]]
"""Decodes some records; raises an error if a payload is not a valid record."""


def freeze(value: T) -> T:
    """Makes arrays read-only, also arrays in a tuple or a dict, and returns the value.

    A user cannot change a log by accident.
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
    """Returns the errors of a pose from its reference, shape (K, m).

    The error of a position is x - x_des. The error of an orientation is the rotation vector
    from the reference to the orientation, rad.

    Args:
        x: positions, or positions and rotation vectors, shape (K, m), m and rad.
        x_des: their references, shape (K, m).
        axes: per coordinate 1 if the site follows along that axis; else 0, and the error is 0.
    """
    e: Array = x - x_des
    if e.shape[1] > POSITION:
        rotation = x[:, POSITION:]
        reference = x_des[:, POSITION:]
        e[:, POSITION:] = _compute_rotation_errors(rotation, reference)
    e *= np.array(axes)
    return e


def _compute_rotation_errors(rotation: Array, reference: Array) -> Array:
    """Returns the rotation vectors from references to orientations, shape (K, 3), rad.

    The orientation (a, u) times the conjugate (b, -v) of the reference is the quaternion (w,
    p):

        w = a b + u . v
        p = b u - a v - u x v

    It turns by 2 atan2(|p|, w) about p.
    """
    a, u = compute_quaternion_parts(rotation)
    b, v = compute_quaternion_parts(reference)
    w = a * b + np.sum(u * v, axis=1, keepdims=True)
    p = b * u - a * v - np.cross(u, v)
    # two quaternions stand for the same rotation: choose the shorter turn
    p *= np.where(w < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(p, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, abs(w))
    # the limit of angle / sine for small angles is 2
    limit = np.full_like(w, 2.0)
    angle_by_sine = np.divide(angle, sine, out=limit, where=sine > 0.0)
    return np.asarray(angle_by_sine * p)


class LazyRecords(Sequence[State]):
    """Records that are decoded in blocks; the blocks accessed last are kept.

    Args:
        payloads: the records.
        decode_block: decodes some of them.
        heavy: whether only few records are kept decoded.
    """

    def __init__(
        self, payloads: Sequence[bytes], decode_block: DecodeStates, *, heavy: bool = False
    ) -> None:
        size = HEAVY_BLOCK if heavy else BLOCK_RECORDS
        blocks = HEAVY_BLOCKS if heavy else MAX_DECODED_RECORDS // size
        self._payloads = payloads
        self._size = size

        @lru_cache(maxsize=blocks)
        def get_block(number: int) -> list[State]:
            """Returns the records of the block with a number."""
            first = number * size
            return decode_block(payloads[first : first + size])

        self._get_block = get_block

    def __len__(self) -> int:
        return len(self._payloads)

    def __iter__(self) -> Iterator[State]:
        blocks = -(-len(self._payloads) // self._size)
        for number in range(blocks):
            yield from self._get_block(number)

    @overload
    def __getitem__(self, index: int) -> State: ...
    @overload
    def __getitem__(self, index: slice) -> list[State]: ...
    def __getitem__(self, index: int | slice) -> State | list[State]:
        if isinstance(index, slice):
            return [self[n] for n in range(*index.indices(len(self)))]
        row = index + len(self) if index < 0 else index
        if not 0 <= row < len(self):
            raise IndexError(f"record {index} of {len(self)}")
        block = self._get_block(row // self._size)
        return block[row % self._size]


def decode_records(payloads: Sequence[bytes], decode_block: DecodeStates) -> Sequence[State]:
    """Returns the records of a site, in the order of their payloads.

    Few records are decoded at once into a list; many or heavy records are decoded when they are
    accessed.

    Args:
        payloads: the records.
        decode_block: decodes some of them.
    """
    if len(payloads) > MAX_DECODED_RECORDS:
        return LazyRecords(payloads, decode_block)
    remaining_bytes = max(HEAVY_BYTES, HEAVY_RATIO * sum(map(len, payloads)))
    states: list[State] = []
    with process.pause_gc():
        for first in range(0, len(payloads), BLOCK_RECORDS):
            block = decode_block(payloads[first : first + BLOCK_RECORDS])
            remaining_bytes -= sum(map(_estimate_bytes, block))
            if remaining_bytes < 0:
                return LazyRecords(payloads, decode_block, heavy=True)
            states += block
    return states


def _estimate_bytes(state: State) -> int:
    """Returns the approximate memory of a decoded record, bytes."""
    entries = len(state.rx) + len(state.echo) + len(state.cmd)
    return 2_000 + 130 * entries + 100 * len(state.used) + 32 * len(state.mem)


class RecordsByTick(Mapping[int, State]):
    """Records by tick; of several records with one tick, the last.

    Args:
        states: the records, in order of their ticks.
        ticks: the ticks, shape (K,).
    """

    def __init__(self, states: Sequence[State], ticks: Ints) -> None:
        self._states = states
        self._ticks = ticks.tolist()

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
    """Messages with their times.

    Attributes:
        messages: K messages.
        log_ns: times of arrival at the recorder, Unix ns, shape (K,).
        publish_ns: times of sending, Unix ns, shape (K,).
    """

    messages: list[M]
    log_ns: Ints
    publish_ns: Ints


class _RecordField(cached_property[T]):
    """A field of every record as an array, decoded on first access.

    The name of the attribute is the name of the field.

    Args:
        decode_column: decodes the field of all records, by its name.
        meaning: the docstring of the attribute.
    """

    def __init__(
        self, decode_column: Callable[[Sequence[bytes], str], T], meaning: str
    ) -> None:
        super().__init__(lambda site: site._read(decode_column, self.attrname))
        self.__doc__ = meaning


class _RecordVector(cached_property[Array]):
    """A vector of every record as an array, decoded on first access; see `_RecordField`."""

    def __init__(self, meaning: str) -> None:
        super().__init__(lambda site: site._read_vectors(self.attrname)[self.attrname])
        self.__doc__ = meaning


_HTML = "trilat_net.reporting.site_html"
"""Module that renders the records of a site, imported only when a notebook needs it."""


class SiteLog:
    """The records of one site, in tick order.

    Args:
        name: name of the site.
        peers: names of its peers, in scenario order.
        rate_hz: tick rate of the site, Hz.
        payloads: the records as published.
        source: name of the file in errors.
        times: times of arrival and of sending of each record, Unix ns, shape (K,) each; by
            default 0.
        layout: lengths of the vectors of a record: n joints, m shared coordinates, P
            parameters.
        channel: the numbers that the site's law sends to its peers.
        axes: in task space per coordinate 1 if the site follows along that axis, else 0.

    Attributes:
        payloads: the records as published, in tick order.
        tick: tick of each record, shape (K,).
        log_time_ns: time of arrival of each record, Unix ns, shape (K,).
        publish_time_ns: time of sending of each record by its own stamp, Unix ns, shape (K,).

    Raises:
        LogError: a record cannot be read; every property raises it too, for the fields that it
            decodes.
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
        self.channel = channel
        self.name = name
        self.peers = peers
        self.rate_hz = rate_hz
        self.layout = layout
        self.axes = axes
        self._source = source
        self.payloads = payloads
        self.tick = self._read(record_columns.decode_ticks)
        zeros = np.zeros(len(payloads), dtype=np.int64)
        self.log_time_ns, self.publish_time_ns = times or (zeros, zeros)
        if (self.tick[1:] < self.tick[:-1]).any():
            order = np.argsort(self.tick, kind="stable")
            self.tick = self.tick[order]
            self.payloads = [payloads[n] for n in order.tolist()]
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
        html: str = import_module(_HTML).render_site_html(self)
        return html

    def _read(self, decode_column: Callable[..., T], *arguments: Any) -> T:
        """Returns decoded columns, read-only; raises LogError if a record cannot be read."""
        try:
            return freeze(decode_column(self.payloads, *arguments))
        except WireError as error:
            raise LogError(
                f"{self._source}: a record of {self.name} cannot be read: {error}"
            ) from None

    def prepare(self, *fields: str) -> None:
        """Decodes several vectors in one pass, which is three times as fast.

        Args:
            fields: names of the vectors.
        """
        missing = [field for field in fields if field not in self.__dict__]
        if missing:
            self.__dict__.update(self._read_vectors(*missing))

    def _read_vectors(self, *fields: str) -> dict[str, Array]:
        """Returns vectors of every record, by field."""
        return self._read(record_columns.decode_vectors, self.layout, *fields)

    def numbers(self, field: str) -> Ints:
        """Returns an integer field of every record, shape (K,), by its name in `State`."""
        return self._read(record_columns.decode_ints, field)

    def memory(self, first: int, count: int) -> Array:
        """Returns `count` numbers of `mem` of every record, shape (K, count).

        Args:
            first: index of the first number in `mem`.
            count: number of numbers.

        Raises:
            LogError: the `mem` of a record is shorter.
        """
        parts = [row[first : first + count] for row in self.mem]
        try:
            return np.array(parts, dtype=np.float64).reshape(len(self), count)
        except ValueError:
            # parts of different lengths, or too short parts
            needed = f"{count_nouns(first + count, 'number')} in `mem`"
            raise LogError(
                f"{self._source}: a record of {self.name} does not have {needed}"
            ) from None

    def record(self, n: int) -> State:
        """Returns the record at index `n`, decoded alone; -1 is the last record."""
        return self._decode([self.payloads[n]])[0]

    def _decode(self, payloads: Sequence[bytes]) -> list[State]:
        """Returns some records, decoded and checked as a whole."""

        def decode_states(_: Sequence[bytes]) -> list[State]:
            return [decode(payload, State, READABLE, self.layout) for payload in payloads]

        return self._read(decode_states)

    @cached_property
    def states(self) -> Sequence[State]:
        """The records, decoded and checked as a whole."""
        return decode_records(self.payloads, self._decode)

    @cached_property
    def by_tick(self) -> "dict[int, State] | RecordsByTick":
        """The records by tick; of several records with one tick, the last."""
        if isinstance(self.states, LazyRecords):
            return RecordsByTick(self.states, self.tick)
        return {state.tick: state for state in self.states}

    @property
    def last_tick(self) -> int:
        """Tick of the last record; -1 without records."""
        return int(self.tick[-1]) if len(self) else -1

    @property
    def diverged_s(self) -> float | None:
        """Time at which the site left its limits, s; None if it did not."""
        if not len(self):
            return None
        last = self.record(-1)
        return last.t_ns / NS_PER_S if last.mode == "diverged" else None

    @property
    def missing(self) -> int:
        """Number of ticks before the last record that have no record."""
        if not len(self):
            return 0
        # each record with a new tick fills one tick after the first record
        later_ticks = int(np.count_nonzero(np.diff(self.tick)))
        return self.last_tick - later_ticks

    @property
    def skipped(self) -> int:
        """Number of ticks that the site skipped, as its records state."""
        return sum(count_skipped_ticks(texts) for texts in self._changes.values())

    mode = _RecordField(
        record_columns.decode_strings,
        'Mode, shape (K,): "run", "hold", "brake", "return", "waiting", "fault", "stopped" '
        'or "diverged".',
    )
    q = _RecordVector("Joint angles, shape (K, n), rad.")
    qd = _RecordVector("Joint velocities, shape (K, n), rad/s.")
    q_des = _RecordVector("Reference of Eq. (6), shape (K, m), rad.")
    qd_des = _RecordVector("Its derivative, shape (K, m), rad/s.")
    tau = _RecordVector("Control torque of Eq. (13), shape (K, n), N m.")
    tau_x = _RecordVector(
        "Exogenous torque in the sign of Eq. (8), shape (K, n), N m; the torque ON the arm is "
        "its negative.",
    )
    theta_hat = _RecordVector(
        "Estimate of the parameters, Eq. (15), shape (K, P), of two links as in Eq. (24)."
    )
    x = _RecordVector(
        "In task space the position and rotation vector of the end effector as recorded, "
        "shape (K, m), m and rad. "
        "The vector jumps where it passes half a turn; `orientation` does not."
    )
    xd = _RecordVector("Derivative of x, shape (K, m), m/s and rad/s.")
    wrench = _RecordVector("Wrench equal to tau_x in task space, shape (K, m), N and N m.")
    ch = _RecordVector(
        "All numbers that the site's law sends, shape (K, C); `sent` has them by name."
    )
    hand = _RecordVector(
        "Action of the person or program that holds the arm, shape (K, h), see `HandInForce`."
    )
    bodies = _RecordVector(
        "Poses of the bodies of its plant as recorded, shape (K, 7 b), m and quaternions."
    )
    mem = _RecordField(
        record_columns.decode_strings, "Further memory of the site, shape (K,), a list each."
    )
    t_ns = _RecordField(
        record_columns.decode_ints, "Nominal time since the epoch, shape (K,), ns."
    )
    late_us = _RecordField(
        record_columns.decode_ints, "Wake-up minus deadline, shape (K,), us; 0 in virtual time."
    )
    sent_ns = _RecordField(
        record_columns.decode_ints,
        "Time at which each record was sent, by the site's own clock since the epoch on that "
        "clock, shape (K,), ns.",
    )

    @cached_property
    def t_s(self) -> Array:
        """Nominal time since the epoch, shape (K,), s."""
        return freeze(self.t_ns / NS_PER_S)

    @cached_property
    def orientation(self) -> Array:
        """Orientation of the end effector as unit quaternions w, x, y, z, shape (K, 4).

        Each quaternion is nearest to the quaternion before. Sites that do not follow
        orientations have shape (K, 0).
        """
        return self._compute_orientation(self.x)

    @cached_property
    def orientation_des(self) -> Array:
        """Orientation of the reference as unit quaternions, as in `orientation`."""
        return self._compute_orientation(self.q_des)

    def _compute_orientation(self, poses: Array) -> Array:
        """Returns the orientations of poses as unit quaternions, shape (K, 4) or (K, 0)."""
        if not self.layout.task or self.layout.shared != POSE:
            return freeze(np.zeros((len(self), 0)))
        return freeze(compute_quaternions(poses[:, POSITION:]))

    @cached_property
    def body_poses(self) -> Array:
        """Poses of the bodies of the plant, shape (K, b, 7).

        A pose is x, y, z, m, and a unit quaternion w, x, y, z. Each quaternion is nearest to
        the quaternion before, whichever sign the plant gave it.
        """
        poses = self.bodies.reshape(len(self), -1, POSITION + 4).copy()
        for body in range(poses.shape[1]):
            poses[:, body, POSITION:] = align_signs(poses[:, body, POSITION:])
        return freeze(poses)

    @property
    def e(self) -> Array:
        """Position error q - q_des, Eq. (9), shape (K, n), rad.

        In task space the error is x - x_des, shape (K, m), m. The error of an orientation is
        the rotation vector from the reference to the end effector, rad, at most half a turn
        long. The control law uses this vector, which jumps where it passes half a turn.
        """
        if self.layout.task:
            return compute_task_errors(self.x, self.q_des, self.axes)
        return self.q - self.q_des

    @cached_property
    def sent(self) -> dict[str, Array]:
        """The numbers that the law sends, shape (K, length) each.

        The keys are a name, as "E", or a name and a peer, as "u[m2]".
        """
        columns: dict[str, list[int]] = {}
        for column, entry in enumerate(self.channel.entries(self.peers)):
            columns.setdefault(entry.key, []).append(column)
        return freeze({key: self.ch[:, indices] for key, indices in columns.items()})

    @cached_property
    def busy_us(self) -> Ints:
        """Computing time of ticks, shape (K - 1,), us; record k + 1 has that of tick k."""
        return self.numbers("busy_us")[1:]

    @cached_property
    def used(self) -> dict[str, Ints]:
        """Per peer the tick of the sample in use, shape (K,); -1 before the first sample."""
        return self._read(record_columns.decode_per_peer, "used", self.peers, -1)

    @cached_property
    def arrivals(self) -> tuple[Ints, Ints]:
        """The samples that arrived.

        The first array has the number of arrivals of each record, shape (K,); the second array
        has all arrivals as in `rx`, shape (N, 3).
        """
        return self._read(record_columns.decode_arrivals)

    @cached_property
    def _changes(self) -> dict[int, list[str]]:
        """The texts of `cmd`, by tick, of the records that have any."""
        texts = self._read(record_columns.decode_strings, "cmd").tolist()
        pairs = zip(self.tick.tolist(), texts, strict=True)
        return {tick: tick_texts for tick, tick_texts in pairs if tick_texts}

    def changes(self) -> dict[int, list[str]]:
        """Returns the changes that the site applied, by tick, as texts of `cmd`."""
        return {tick: list(texts) for tick, texts in self._changes.items()}

    def age_s(self, peer: str, rate_hz: int) -> Array:
        """Returns the age of the sample in use of a peer, shape (K,), s.

        The age is the time of the record minus the stamp of the sample; NaN before the first
        sample.

        Args:
            peer: name of the peer.
            rate_hz: tick rate of the peer, Hz.
        """
        used = self.used[peer]
        stamp_ns = used * NS_PER_S // rate_hz
        age_ns = self.t_ns - stamp_ns
        return np.where(used >= 0, age_ns / NS_PER_S, np.nan)

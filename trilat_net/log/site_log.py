"""One site's part of a log: its records as arrays over time, or one by one.

Invariant: only what is requested is decoded; an invalid record is an error that names the site.
Memory stays bounded for a log of any length: long sequences of records are decoded in blocks on
access.
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
"""Records of a site that are held decoded, at most: a minute at 1 kHz, some 150 MB."""
BLOCK_RECORDS = 1 << 11
"""Records that are decoded together."""
HEAVY_BYTES = 12 << 20
HEAVY_RATIO = 10
"""Records whose decoded form takes more than this, and than so many times their payloads, are
held few at a
time: they were made to take much.
"""
HEAVY_BLOCK = 128
HEAVY_BLOCKS = 8
"""Heavy records that are decoded together, and how many times that many are held."""

DecodeStates = Callable[[Sequence[bytes]], list[State]]
"""Decodes some records, or raises an error for one that is none."""


def freeze(value: T) -> T:
    """Makes arrays read-only, also those in a tuple or by name: nobody changes a log by
    accident.
    """
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, dict | tuple):
        for one in value.values() if isinstance(value, dict) else value:
            freeze(one)
    return value


def compute_task_errors(x: Array, x_des: Array, axes: Sequence[float]) -> Array:
    """Returns x - x_des of places, and of orientations the turn from one to the other, shape
    (K, m).

    It is 0 along an axis that the site does not follow: `axes` has 0 there and 1 elsewhere.
    """
    e: Array = x - x_des
    if e.shape[1] > POSITION:
        e[:, POSITION:] = _find_turns(x[:, POSITION:], x_des[:, POSITION:])
    e *= np.array(axes)
    return e


def _find_turns(turn: Array, reference: Array) -> Array:
    (a, u), (b, v) = map(compute_quaternion_parts, (turn, reference))
    w = a * b + np.sum(u * v, axis=1, keepdims=True)
    p = b * u - a * v - np.cross(u, v)
    # of two quaternions that turn alike that of the shorter turn
    p *= np.where(w < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(p, axis=1, keepdims=True)
    by_sine = np.divide(
        2.0 * np.arctan2(sine, abs(w)), sine, out=np.full_like(w, 2.0), where=sine > 0.0
    )
    return np.asarray(by_sine * p)


class LazyRecords(Sequence[State]):
    """Records decoded a block at a time; the blocks used last are held, fewer of heavy records."""

    def __init__(
        self, payloads: Sequence[bytes], decode_block: DecodeStates, *, heavy: bool = False
    ) -> None:
        self._size, held = (
            (HEAVY_BLOCK, HEAVY_BLOCKS) if heavy else (BLOCK_RECORDS, MAX_DECODED_RECORDS)
        )
        self._payloads = payloads
        size = self._size
        self._block = lru_cache(maxsize=held if heavy else held // size)(
            lambda number: decode_block(payloads[number * size : (number + 1) * size])
        )

    def __len__(self) -> int:
        return len(self._payloads)

    def __iter__(self) -> Iterator[State]:
        for number in range(-(-len(self._payloads) // self._size)):
            yield from self._block(number)

    @overload
    def __getitem__(self, place: int) -> State: ...
    @overload
    def __getitem__(self, place: slice) -> list[State]: ...
    def __getitem__(self, place: int | slice) -> State | list[State]:
        if isinstance(place, slice):
            return [self[n] for n in range(*place.indices(len(self)))]
        index = place + len(self) if place < 0 else place
        if not 0 <= index < len(self):
            raise IndexError(f"record {place} of {len(self)}")
        return self._block(index // self._size)[index % self._size]


def decode_records(payloads: Sequence[bytes], decode_block: DecodeStates) -> Sequence[State]:
    """Returns the records of a site, in the order of their payloads: a list if they are not too
    many.
    """
    if len(payloads) > MAX_DECODED_RECORDS:
        return LazyRecords(payloads, decode_block)
    room = max(HEAVY_BYTES, HEAVY_RATIO * sum(map(len, payloads)))
    held: list[State] = []
    with process.pause_gc():
        for first in range(0, len(payloads), BLOCK_RECORDS):
            block = decode_block(payloads[first : first + BLOCK_RECORDS])
            room -= sum(map(_estimate_bytes, block))
            if room < 0:
                return LazyRecords(payloads, decode_block, heavy=True)
            held += block
    return held


def _estimate_bytes(state: State) -> int:
    lists = len(state.rx) + len(state.echo) + len(state.cmd)
    return 2_000 + 130 * lists + 100 * len(state.used) + 32 * len(state.mem)


class RecordsByTick(Mapping[int, State]):
    """Records, in order of their ticks (K,), by tick; of several with one tick, the last."""

    def __init__(self, states: Sequence[State], ticks: Ints) -> None:
        self._states = states
        self._ticks = ticks.tolist()

    def __getitem__(self, tick: int) -> State:
        place = bisect_right(self._ticks, tick) - 1
        if place < 0 or self._ticks[place] != tick:
            raise KeyError(tick)
        return self._states[place]

    def __iter__(self) -> Iterator[int]:
        return iter(dict.fromkeys(self._ticks))

    def __len__(self) -> int:
        return len(set(self._ticks))


class TimedMessages(NamedTuple, Generic[M]):
    """Messages with the times at which they came and were sent, Unix ns, shape (K,) each."""

    messages: list[M]
    log_ns: Ints
    publish_ns: Ints


class _RecordField(cached_property[T]):
    """A field of every record as an array, by the attribute's name; it is decoded on first
    access.
    """

    def __init__(
        self, decode_column: Callable[[Sequence[bytes], str], T], meaning: str
    ) -> None:
        super().__init__(lambda site: site._read(decode_column, self.attrname))
        self.__doc__ = meaning


class _RecordVector(cached_property[Array]):
    """A vector of every record; as `_RecordField`."""

    def __init__(self, meaning: str) -> None:
        super().__init__(lambda site: site._read_vectors(self.attrname)[self.attrname])
        self.__doc__ = meaning


_HTML = "trilat_net.reporting.site_html"
"""What shows the records of a site in a notebook; it is imported when a notebook asks."""


class SiteLog:
    """The records of one site, in tick order.

    Args:
        name: the site.
        peers: its peers, in scenario order.
        rate_hz: its tick rate, Hz.
        payloads: the records as published.
        source: the file's name in errors.
        times: when they came and when they were sent, Unix ns, shape (K,) each; by default 0.
        layout: how many numbers the vectors of its records have; n joints, m shared, P
            parameters.
        channel: what the site's law sends to its peers.
        axes: in task space per coordinate 1 if the site follows along it, else 0.

    Attributes:
        payloads: the records as published, in tick order.
        tick: their ticks, shape (K,). log_time_ns, publish_time_ns: when each came, and was
        sent by its own stamp, shape (K,), Unix ns.

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
        first_s, last_s = (self.tick[n] / self.rate_hz for n in (0, -1))
        records = f"{count_nouns(len(self), 'record')} of {self.rate_hz} Hz, {first_s:.3f} s to {last_s:.3f} s"
        return f"<{self.name}: {records}, {self.missing or 'none'} missing>"

    def _repr_html_(self) -> str:
        html: str = import_module(_HTML).render_site_html(self)
        return html

    def _read(self, decode_column: Callable[..., T], *arguments: Any) -> T:
        try:
            return freeze(decode_column(self.payloads, *arguments))
        except WireError as error:
            raise LogError(
                f"{self._source}: a record of {self.name} cannot be read: {error}"
            ) from None

    def prepare(self, *fields: str) -> None:
        """Decodes several vectors by their names in one pass, three times as fast as one by
        one.
        """
        if absent := [field for field in fields if field not in self.__dict__]:
            self.__dict__.update(self._read_vectors(*absent))

    def _read_vectors(self, *fields: str) -> dict[str, Array]:
        return self._read(record_columns.decode_vectors, self.layout, *fields)

    def numbers(self, field: str) -> Ints:
        """Returns a whole number of every record, shape (K,), by the name of its field in
        `State`.
        """
        return self._read(record_columns.decode_ints, field)

    def memory(self, first: int, count: int) -> Array:
        """Returns so many numbers of `mem` from a place on, of every record, shape (K, count).

        Raises:
            LogError: a record does not have them.
        """
        try:
            rows = np.array([row[first : first + count] for row in self.mem], dtype=np.float64)
            return rows.reshape(len(self), count)
        except ValueError:  # they are of several lengths, or too short
            needed = f"{count_nouns(first + count, 'number')} in `mem`"
            raise LogError(
                f"{self._source}: a record of {self.name} does not have {needed}"
            ) from None

    def record(self, n: int) -> State:
        """Returns the record at a place, decoded and checked alone; -1 is the last one."""
        return self._decode([self.payloads[n]])[0]

    def _decode(self, payloads: Sequence[bytes]) -> list[State]:
        return self._read(
            lambda _: [decode(payload, State, READABLE, self.layout) for payload in payloads]
        )

    @cached_property
    def states(self) -> Sequence[State]:
        """The records, decoded and checked as a whole."""
        return decode_records(self.payloads, self._decode)

    @cached_property
    def by_tick(self) -> "dict[int, State] | RecordsByTick":
        """The same, by their ticks; of several with one tick the last."""
        if isinstance(self.states, LazyRecords):
            return RecordsByTick(self.states, self.tick)
        return {state.tick: state for state in self.states}

    @property
    def last_tick(self) -> int:
        """Tick of the last record, -1 if there is none."""
        return int(self.tick[-1]) if len(self) else -1

    @property
    def diverged_s(self) -> float | None:
        """When the site left its limits, s; None if it did not."""
        last = self.record(-1) if len(self) else None
        return last.t_ns / NS_PER_S if last is not None and last.mode == "diverged" else None

    @property
    def missing(self) -> int:
        """How many ticks before the last record have none."""
        return self.last_tick - int(np.count_nonzero(np.diff(self.tick))) if len(self) else 0

    @property
    def skipped(self) -> int:
        """How many ticks the site did not make, as its records say."""
        return sum(count_skipped_ticks(texts) for texts in self._changes.values())

    mode = _RecordField(
        record_columns.decode_strings,
        'Mode, shape (K,): "run", "hold", "brake", "return", "waiting", "fault", "stopped" or "diverged".',
    )
    q = _RecordVector("Joint angles, shape (K, n), rad.")
    qd = _RecordVector("Joint velocities, shape (K, n), rad/s.")
    q_des = _RecordVector("Reference of Eq. (6), shape (K, m), rad.")
    qd_des = _RecordVector("Its derivative, shape (K, m), rad/s.")
    tau = _RecordVector("Control torque of Eq. (13), shape (K, n), N m.")
    tau_x = _RecordVector(
        "Exogenous torque in the sign of Eq. (8), shape (K, n), N m; ON the arm acts its negative.",
    )
    theta_hat = _RecordVector(
        "Estimate of the parameters, Eq. (15), shape (K, P), of two links as in Eq. (24)."
    )
    x = _RecordVector(
        "In task space the end effector's place and rotation vector as recorded, shape (K, m), m and rad. "
        "The vector jumps where it passes half a turn; `orientation` does not."
    )
    xd = _RecordVector("Its derivative, shape (K, m).")
    wrench = _RecordVector("What tau_x amounts to there, shape (K, m), N and N m.")
    ch = _RecordVector("All that the site's law sends, shape (K, C); `sent` has it by name.")
    hand = _RecordVector(
        "What somebody who holds the arm does, shape (K, h), see `HandInForce`."
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
        "When each record was sent, by the site's own clock since the epoch on it, shape (K,), ns.",
    )

    @cached_property
    def t_s(self) -> Array:
        """Nominal time since the epoch, shape (K,), s."""
        return freeze(self.t_ns / NS_PER_S)

    @cached_property
    def orientation(self) -> Array:
        """Of sites that follow orientations that of the end effector, shape (K, 4); else shape
        (K, 0).

        Unit quaternions w, x, y, z, each nearest to the one before.
        """
        return self._make_orientation(self.x)

    @cached_property
    def orientation_des(self) -> Array:
        """The same of the reference, shape (K, 4)."""
        return self._make_orientation(self.q_des)

    def _make_orientation(self, poses: Array) -> Array:
        if not self.layout.task or self.layout.shared != POSE:
            return freeze(np.zeros((len(self), 0)))
        return freeze(compute_quaternions(poses[:, POSITION:]))

    @cached_property
    def body_poses(self) -> Array:
        """Poses of the bodies of its plant, shape (K, b, 7): x, y, z, m, and the unit
        quaternion w, x, y, z.

        Each quaternion is nearest to the one before, whichever sign the plant gave it.
        """
        poses = self.bodies.reshape(len(self), -1, POSITION + 4).copy()
        for body in range(poses.shape[1]):
            poses[:, body, POSITION:] = align_signs(poses[:, body, POSITION:])
        return freeze(poses)

    @property
    def e(self) -> Array:
        """Position error q - q_des, Eq. (9), shape (K, n), rad; in task space x - x_des, shape
        (K, m), m.

        The error of an orientation is the turn from the reference to the end effector, rad, at
        most half a turn long: that of the control law, which jumps where it passes half a turn.
        """
        return (
            compute_task_errors(self.x, self.q_des, self.axes)
            if self.layout.task
            else self.q - self.q_des
        )

    @cached_property
    def sent(self) -> dict[str, Array]:
        """What the law sends, shape (K, length) each: by name, as in "E", or name and peer, as
        in "u[m2]".
        """
        places: dict[str, list[int]] = {}
        for n, entry in enumerate(self.channel.entries(self.peers)):
            places.setdefault(entry.key, []).append(n)
        return freeze({key: self.ch[:, columns] for key, columns in places.items()})

    @cached_property
    def busy_us(self) -> Ints:
        """Computing time of each tick, shape (K - 1,), us: record k + 1 carries that of tick k."""
        return self.numbers("busy_us")[1:]

    @cached_property
    def used(self) -> dict[str, Ints]:
        """Per peer the tick of the sample in use, shape (K,); -1 before the first."""
        return self._read(record_columns.decode_per_peer, "used", self.peers, -1)

    @cached_property
    def arrivals(self) -> tuple[Ints, Ints]:
        """How many samples each record took in, shape (K,), and all of them as in `rx`, shape
        (N, 3).
        """
        return self._read(record_columns.decode_arrivals)

    @cached_property
    def _changes(self) -> dict[int, list[str]]:
        lists = self._read(record_columns.decode_strings, "cmd").tolist()
        return {
            tick: texts for tick, texts in zip(self.tick.tolist(), lists, strict=True) if texts
        }

    def changes(self) -> dict[int, list[str]]:
        """Returns the changes that the site took in, by tick, as `cmd` names them."""
        return {tick: list(texts) for tick, texts in self._changes.items()}

    def age_s(self, peer: str, rate_hz: int) -> Array:
        """Returns now minus the stamp of the sample in use of a peer with that tick rate, shape
        (K,), s.

        NaN stands for none, before the first sample.
        """
        used = self.used[peer]
        age_ns = self.t_ns - used * NS_PER_S // rate_hz
        return np.where(used >= 0, age_ns / NS_PER_S, np.nan)

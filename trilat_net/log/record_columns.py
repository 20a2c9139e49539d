"""Fields of many encoded records as arrays.

Invariant: only the requested fields are decoded, and each is checked as in a complete record: type,
length, finite values.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.ticks import Mode
from ..core.vectors import Array
from ..errors import WireError
from ..net.messages import READABLE, STATE_VECTORS, Stamp, State, TickNumber
from ..net.wire import MAX_BYTES, decode

Ints = NDArray[np.int64]
Strings = NDArray[np.object_]

_MODE: Any = Literal.__getitem__(tuple(mode.name.lower() for mode in Mode))
_TYPES: dict[str, Any] = {
    "v": int,
    "tick": TickNumber,
    "mode": _MODE,
    "rx": list[Stamp],
    **{field: tuple.__class_getitem__((float,) * count) for field, count in STATE_VECTORS.items()},
}
"""What a field is, where that is narrower than in `State`: of a fixed length, of a few words."""
_LATER = {"sent_ns": 0}
"""Fields that records of older versions lack, and what stands for them."""


def decode_ticks(payloads: Sequence[bytes]) -> Ints:
    """Returns the tick of every record, shape (K,).

    Raises:
        WireError: a payload is too long, or no record, or one of a version that nobody reads.
    """
    if any(len(payload) > MAX_BYTES for payload in payloads):
        raise _reason(payloads)
    pairs = _gathered(payloads, "v", "tick").reshape(-1, 2)
    if not np.isin(pairs[:, 0], READABLE).all():
        raise _reason(payloads)
    return pairs[:, 1].copy()


def decode_ints(payloads: Sequence[bytes], field: str) -> Ints:
    """Returns a whole number of every record, shape (K,).

    Raises:
        WireError: a payload has none there, or one that 64 bits do not hold.
    """
    return _gathered(payloads, field)


def decode_vectors(payloads: Sequence[bytes], field: str) -> Array:
    """Returns a vector of every record, shape (K, how many numbers it has).

    Raises:
        WireError: a payload has no such vector there, or one that is not finite.
    """
    count = STATE_VECTORS[field]
    values = chain.from_iterable(_each(payloads, field))
    rows: Array = _array(payloads, values, np.float64, count * len(payloads)).reshape(-1, count)
    if not np.isfinite(rows).all():
        raise _reason(payloads)
    return rows


def decode_many_vectors(payloads: Sequence[bytes], fields: Sequence[str]) -> dict[str, Array]:
    """Returns several vectors of every record by their fields, shape (K, how many numbers it has) each.

    One pass over the records, where `vectors` takes one per field.

    Raises:
        WireError: as `vectors`.
    """
    counts = [STATE_VECTORS[field] for field in fields]
    found = _each(payloads, *fields)
    values = chain.from_iterable(found if len(fields) == 1 else chain.from_iterable(found))
    rows: Array = _array(payloads, values, np.float64, sum(counts) * len(payloads))
    rows = rows.reshape(-1, sum(counts))
    if not np.isfinite(rows).all():
        raise _reason(payloads)
    parts = np.split(rows, np.cumsum(counts)[:-1], axis=1)
    return {field: part.copy() for field, part in zip(fields, parts, strict=True)}


def decode_strings(payloads: Sequence[bytes], field: str) -> Strings:
    """Returns a word of every record, shape (K,).

    Raises:
        WireError: a payload has none there.
    """
    return _array(payloads, _each(payloads, field), np.object_, len(payloads))


def decode_per_peer(
    payloads: Sequence[bytes], field: str, peers: Sequence[str], absent: int
) -> dict[str, Ints]:
    """Returns a whole number of every record for every peer, shape (K,) each.

    Args:
        payloads: the records.
        field: a field that holds a number per peer.
        peers: which peers.
        absent: what stands for a peer that a record does not name.

    Raises:
        WireError: a payload holds something else there.
    """
    places = [f"peer{n}" for n in range(len(peers))]
    entry = msgspec.defstruct(
        "Peers",
        [(place, int, absent) for place in places],
        rename=dict(zip(places, peers, strict=True)),
        gc=False,
    )
    take = attrgetter(*(f"{field}.{place}" for place in places))
    found = _each(payloads, field, kind=entry, take=take)
    values = found if len(peers) == 1 else chain.from_iterable(found)
    rows = _array(payloads, values, np.int64, len(peers) * len(payloads)).reshape(-1, len(peers))
    return {peer: rows[:, n].copy() for n, peer in enumerate(peers)}


def decode_arrivals(payloads: Sequence[bytes]) -> tuple[Ints, Ints]:
    """Returns what came in: how many per record, shape (K,), and all in order as in `rx`, shape (N, 3).

    Raises:
        WireError: a payload lists something else there.
    """
    counts = np.zeros(len(payloads), dtype=np.int64)

    def entries() -> Iterator[int]:
        for n, listed in enumerate(_each(payloads, "rx")):
            counts[n] = len(listed)
            for entry in listed:
                yield from entry

    rows = _array(payloads, entries(), np.int64, -1).reshape(-1, 3)
    return counts, rows


def _gathered(payloads: Sequence[bytes], *fields: str) -> Ints:
    """Returns some whole numbers of every record, one record after the other."""
    found = _each(payloads, *fields)
    values = found if len(fields) == 1 else chain.from_iterable(found)
    return _array(payloads, values, np.int64, len(fields) * len(payloads))


def _each(
    payloads: Sequence[bytes],
    *fields: str,
    kind: Any = None,
    take: Callable[[Any], Any] | None = None,
) -> Iterator[Any]:
    """Yields some fields of every record, decoding them on the way."""
    decoder = _decoder(fields) if kind is None else _made({fields[0]: kind})
    return map(take or attrgetter(*fields), map(decoder.decode, payloads))


@cache
def _decoder(fields: tuple[str, ...]) -> msgspec.msgpack.Decoder[Any]:
    types = {field.name: field.type for field in msgspec.structs.fields(State)} | _TYPES
    return _made({field: types[field] for field in fields})


def _made(types: dict[str, Any]) -> msgspec.msgpack.Decoder[Any]:
    """Returns a decoder of these fields alone; it passes over all others."""
    fields = [(name, kind, _LATER[name]) if name in _LATER else (name, kind) for name, kind in types.items()]
    return msgspec.msgpack.Decoder(msgspec.defstruct("Fields", fields, frozen=True, gc=False))


def _array(payloads: Sequence[bytes], values: Iterable[Any], kind: Any, count: int) -> NDArray[Any]:
    try:
        return np.fromiter(values, kind, count)
    except (ValueError, OverflowError, RecursionError) as error:
        raise _reason(payloads, str(error)) from None


def _reason(payloads: Sequence[bytes], else_text: str = "a number is out of range") -> WireError:
    """Returns what is wrong with the first payload that is no record, told as for a record of its own."""
    for payload in payloads:
        try:
            decode(payload, State, READABLE)
        except WireError as error:
            return error
    return WireError("malformed", else_text)

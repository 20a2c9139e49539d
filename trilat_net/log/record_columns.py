"""Fields of many records, decoded into arrays.

Every function raises `WireError` for the first payload that is not a valid record.

Invariant:
    - Only the requested fields are decoded.
    - Each field is checked as in a complete record: its type, its length, and that its numbers
      are finite.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.site_setup import Layout
from ..core.vectors import Array
from ..errors import WireError
from ..net.messages import MODES, READABLE, Stamp, State, TickNumber
from ..net.wire import MAX_BYTES, decode

Ints = NDArray[np.int64]

_MODE: Any = Literal.__getitem__(tuple(MODES))
_TYPES: dict[str, Any] = {
    "v": int,
    "tick": TickNumber,
    "mode": _MODE,
    "rx": list[Stamp],
}
"""Types of fields that `State` declares more widely, for the check of their values."""
_DEFAULTS = {"sent_ns": 0}
"""Values of fields that records of older versions do not have."""


def decode_ticks(payloads: Sequence[bytes]) -> Ints:
    """Returns the tick of every record, shape (K,).

    Records of every readable version are accepted.
    """
    if any(len(payload) > MAX_BYTES for payload in payloads):
        raise _find_error(payloads)
    rows = decode_ints(payloads, "v", "tick").reshape(-1, 2)
    versions = rows[:, 0]
    if not np.isin(versions, READABLE).all():
        raise _find_error(payloads)
    return rows[:, 1].copy()


def decode_ints(payloads: Sequence[bytes], *fields: str) -> Ints:
    """Returns integer fields of every record, shape (K times number of fields,).

    The values of one record follow each other, in the order of `fields`.
    """
    values = _decode_fields(payloads, *fields)
    if len(fields) > 1:
        # each value is a tuple with one number per field
        values = chain.from_iterable(values)
    return _to_array(payloads, values, np.int64, len(fields) * len(payloads))


def decode_vectors(payloads: Sequence[bytes], layout: Layout, *fields: str) -> dict[str, Array]:
    """Returns vectors of every record, by field.

    Args:
        payloads: K records.
        layout: the lengths of the vectors.
        fields: names of the fields.

    Returns:
        Per field an array of shape (K, length of the vector). A field that the layout does not
        have gets an array of shape (K, 0).
    """
    lengths = layout.lengths()
    present = [field for field in fields if field in lengths]
    absent = [field for field in fields if field not in lengths]
    vectors = {field: np.zeros((len(payloads), 0)) for field in absent}
    if not present:
        return vectors
    row_length = sum(lengths[field] for field in present)
    values = chain.from_iterable(_decode_fields(payloads, *present, layout=layout))
    if len(present) > 1:
        # each value is a vector of one field
        values = chain.from_iterable(values)
    numbers: Array = _to_array(
        payloads=payloads,
        values=values,
        kind=np.float64,
        count=row_length * len(payloads),
        layout=layout,
    )
    if not np.isfinite(numbers).all():
        raise _find_error(payloads, layout=layout)
    rows = numbers.reshape(-1, row_length)
    if len(present) == 1:
        vectors[present[0]] = rows
        return vectors
    start = 0
    for field in present:
        stop = start + lengths[field]
        vectors[field] = rows[:, start:stop].copy()
        start = stop
    return vectors


def decode_strings(payloads: Sequence[bytes], field: str) -> NDArray[np.object_]:
    """Returns a field of every record as an array of objects, such as strings, shape (K,)."""
    values = _decode_fields(payloads, field)
    return _to_array(payloads, values, np.object_, len(payloads))


def decode_per_peer(
    payloads: Sequence[bytes], field: str, peers: Sequence[str], absent: int
) -> dict[str, Ints]:
    """Returns a field that has an integer for each peer, as the field `used`.

    Args:
        payloads: K records.
        field: name of the field, a map from peers to integers.
        peers: names of the peers.
        absent: the number for a peer that the map of a record does not have.

    Returns:
        Per peer the integers of all records, shape (K,).
    """
    # A struct with an attribute per peer decodes faster than a dict. The name of a peer may be
    # no identifier, so the attributes have names of their own.
    attributes = [f"peer{n}" for n in range(len(peers))]
    peer_struct = msgspec.defstruct(
        "Peers",
        [(attribute, int, absent) for attribute in attributes],
        rename=dict(zip(attributes, peers, strict=True)),
        gc=False,
    )
    decoder = _make_decoder({field: peer_struct})
    paths = [f"{field}.{attribute}" for attribute in attributes]
    get_numbers = attrgetter(*paths)
    records = map(decoder.decode, payloads)
    values: Iterator[Any] = map(get_numbers, records)
    if len(peers) > 1:
        # each value is a tuple with one number per peer
        values = chain.from_iterable(values)
    numbers = _to_array(payloads, values, np.int64, len(peers) * len(payloads))
    rows = numbers.reshape(-1, len(peers))
    return {peer: rows[:, n].copy() for n, peer in enumerate(peers)}


def decode_arrivals(payloads: Sequence[bytes]) -> tuple[Ints, Ints]:
    """Returns the arrivals of all records.

    Returns:
        The number of arrivals of each record, shape (K,), and all arrivals in order, as in
        `rx`, shape (N, 3).
    """
    counts = np.zeros(len(payloads), dtype=np.int64)

    def iterate_numbers() -> Iterator[int]:
        for row, arrivals in enumerate(_decode_fields(payloads, "rx")):
            counts[row] = len(arrivals)
            for entry in arrivals:
                yield from entry

    numbers = _to_array(payloads, iterate_numbers(), np.int64, -1)
    return counts, numbers.reshape(-1, 3)


def _decode_fields(
    payloads: Sequence[bytes], *fields: str, layout: Layout | None = None
) -> Iterator[Any]:
    """Yields the value of a field of every record; of several fields a tuple of values."""
    get_values: Callable[[Any], Any] = attrgetter(*fields)
    decoder = _find_decoder(fields, layout)
    records = map(decoder.decode, payloads)
    return map(get_values, records)


@cache
def _find_decoder(
    fields: tuple[str, ...], layout: Layout | None
) -> msgspec.msgpack.Decoder[Any]:
    """Returns a decoder of some fields; with a layout, vectors must have its lengths."""
    types = {field.name: field.type for field in msgspec.structs.fields(State)}
    types.update(_TYPES)
    if layout is not None:
        for field, length in layout.lengths().items():
            types[field] = tuple.__class_getitem__((float,) * length)
    return _make_decoder({field: types[field] for field in fields})


def _make_decoder(types: dict[str, Any]) -> msgspec.msgpack.Decoder[Any]:
    """Returns a decoder of fields with these types, by name."""
    fields: list[Any] = []
    for name, kind in types.items():
        if name in _DEFAULTS:
            fields.append((name, kind, _DEFAULTS[name]))
        else:
            fields.append((name, kind))
    struct = msgspec.defstruct("Fields", fields, frozen=True, gc=False)
    return msgspec.msgpack.Decoder(struct)


def _to_array(
    payloads: Sequence[bytes],
    values: Iterable[Any],
    kind: Any,
    count: int,
    layout: Layout | None = None,
) -> NDArray[Any]:
    """Returns decoded values as an array.

    Args:
        payloads: the records, for the error.
        values: the values; they are decoded while they are iterated.
        kind: data type of the array.
        count: number of values; -1: unknown.
        layout: the lengths of the vectors, for the error.

    Raises:
        WireError: a record is not valid.
    """
    try:
        return np.fromiter(values, kind, count)
    except (ValueError, OverflowError, RecursionError) as error:
        raise _find_error(payloads, str(error), layout) from None


def _find_error(
    payloads: Sequence[bytes],
    default: str = "a number is out of range",
    layout: Layout | None = None,
) -> WireError:
    """Returns the error of the first payload that is not a valid record.

    The error is the same as if that record were decoded alone. `default` is its text if every
    record is valid.
    """
    for payload in payloads:
        try:
            decode(payload, State, READABLE, layout)
        except WireError as error:
            return error
    return WireError("malformed", default)

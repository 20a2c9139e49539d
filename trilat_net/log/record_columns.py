"""Decodes single fields of many records into arrays, without decoding whole records.

This is much faster if only some fields are needed. A record is the encoded state of an arm in
one period of its control loop. For example, `decode_ticks` returns the number of the period of
each record. Every function raises `WireError` for the first message that is not a valid record.

Invariant:
    - Only the requested fields are decoded.
    - Each field is checked as in a whole record: its type, its length, and that its numbers are
      finite.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core import Array
from ..errors import WireError
from ..net import MAX_BYTES, MODES, READABLE, Stamp, State, TickNumber, decode
from ..records import Layout

Ints = NDArray[np.int64]

_MODE: Any = Literal.__getitem__(tuple(MODES))
_TYPES: dict[str, Any] = {
    "v": int,
    "tick": TickNumber,
    "mode": _MODE,
    "rx": list[Stamp],
}
"""Types of fields for which `State` declares a wider type. They restrict the values."""
_DEFAULTS = {"sent_ns": 0}
"""Values of fields that records of older versions do not contain."""


def decode_ticks(payloads: Sequence[bytes]) -> Ints:
    """Decodes from every record the number of its control period (tick).

    Records of every version of the format that can be read are accepted.

    Args:
        payloads: K encoded records.

    Returns:
        The ticks, shape (K,).
    """
    if any(len(payload) > MAX_BYTES for payload in payloads):
        raise _find_error(payloads)
    rows = decode_ints(payloads, "v", "tick").reshape(-1, 2)
    versions = rows[:, 0]
    if not np.isin(versions, READABLE).all():
        raise _find_error(payloads)
    return rows[:, 1].copy()


def decode_ints(payloads: Sequence[bytes], *fields: str) -> Ints:
    """Decodes some integer fields of every record, and skips all other fields.

    Args:
        payloads: K encoded records (results of control periods).
        fields: Names of F integer fields of `State`.

    Returns:
        The values, shape (K F,): the F values of the first record in the order of `fields`,
        then the values of the second record, and so on.
    """
    values = _decode_fields(payloads, *fields)
    if len(fields) > 1:
        # Each value is a tuple with one number per field.
        values = chain.from_iterable(values)
    value_count = len(fields) * len(payloads)
    return _to_array(payloads, values, np.int64, value_count)


def decode_vectors(payloads: Sequence[bytes], layout: Layout, *fields: str) -> dict[str, Array]:
    """Decodes some vectors, such as joint angles, of every record, and skips other fields.

    Args:
        payloads: K encoded records.
        layout: Lengths of the vectors in these records.
        fields: Names of the fields, such as "q".

    Returns:
        For each field an array of shape (K, length of the vector). The shape is (K, 0) for a
        field that these records do not have.
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
        # Each value is a whole vector of one field, instead of a number.
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
        vectors[present[0]] = rows  # no copy is needed
        return vectors
    start = 0
    for field in present:
        stop = start + lengths[field]
        vectors[field] = rows[:, start:stop].copy()
        start = stop
    return vectors


def decode_strings(payloads: Sequence[bytes], field: str) -> NDArray[np.object_]:
    """Decodes a field of every record as Python objects, such as strings or lists.

    Args:
        payloads: K encoded records (results of control periods).
        field: Name of the field.

    Returns:
        The values, shape (K,).
    """
    values = _decode_fields(payloads, field)
    return _to_array(payloads, values, np.object_, len(payloads))


def decode_per_peer(
    payloads: Sequence[bytes], field: str, peers: Sequence[str], absent: int
) -> dict[str, Ints]:
    """Decodes a field that contains an integer for each peer, such as `used`.

    A peer is another site (arm controller) whose samples (sent states) the site receives. The
    field of a record is a map from names of peers to integers.

    Args:
        payloads: K encoded records.
        field: Name of the field.
        peers: Names of the peers.
        absent: Number to return for a peer that the map of a record does not contain.

    Returns:
        For each peer the integers of all records, shape (K,).
    """
    # A struct with an attribute per peer is decoded faster than a dict. The name of a peer need
    # not be a valid identifier, so the attributes have other names.
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
    # Nothing is decoded yet, because the iterators are consumed in `_to_array`.
    records = map(decoder.decode, payloads)
    values: Iterator[Any] = map(get_numbers, records)
    if len(peers) > 1:
        # Each value is a tuple with one number per peer.
        values = chain.from_iterable(values)
    numbers = _to_array(payloads, values, np.int64, len(peers) * len(payloads))
    rows = numbers.reshape(-1, len(peers))
    return {peer: rows[:, n].copy() for n, peer in enumerate(peers)}


def decode_arrivals(payloads: Sequence[bytes]) -> tuple[Ints, Ints]:
    """Decodes from records which states of other arms arrived in each control period.

    Args:
        payloads: K encoded records of the site.

    Returns:
        The number of arrivals of each record, shape (K,), and all N arrivals in order, shape
        (N, 3). The columns are those of the field `rx` of a record: index of the peer, tick
        (control period) of the sample, and delay in us.
    """
    counts = np.zeros(len(payloads), dtype=np.int64)

    def iterate_numbers() -> Iterator[int]:
        """Yields the three numbers of every arrival, and stores the arrivals per record."""
        for row, arrivals in enumerate(_decode_fields(payloads, "rx")):
            counts[row] = len(arrivals)
            for entry in arrivals:
                yield from entry

    numbers = _to_array(payloads, iterate_numbers(), np.int64, -1)
    return counts, numbers.reshape(-1, 3)


def _decode_fields(
    payloads: Sequence[bytes], *fields: str, layout: Layout | None = None
) -> Iterator[Any]:
    """Yields the value of a field for every record, or a tuple of values for several fields.

    Args:
        payloads: The encoded records (results of control periods).
        fields: Names of the fields.
        layout: Lengths of the vectors. None accepts all lengths.
    """
    get_values: Callable[[Any], Any] = attrgetter(*fields)
    decoder = _find_decoder(fields, layout)
    records = map(decoder.decode, payloads)
    return map(get_values, records)


@cache
def _find_decoder(
    fields: tuple[str, ...], layout: Layout | None
) -> msgspec.msgpack.Decoder[Any]:
    """Returns a decoder for some fields of an encoded record, which skips all other fields.

    This is faster than decoding the whole record.

    Args:
        fields: Names of the fields.
        layout: Lengths that vectors must have. If None, all lengths are accepted.
    """
    types = {field.name: field.type for field in msgspec.structs.fields(State)}
    types.update(_TYPES)
    if layout is not None:
        for field, length in layout.lengths().items():
            # The type of a tuple with that number of floats.
            types[field] = tuple.__class_getitem__((float,) * length)
    return _make_decoder({field: types[field] for field in fields})


def _make_decoder(types: dict[str, Any]) -> msgspec.msgpack.Decoder[Any]:
    """Creates a decoder for some fields of encoded records. Other fields are skipped.

    Args:
        types: Types of the fields, by name.
    """
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
    """Decodes values while they are put into an array, and reports the first invalid record.

    Args:
        payloads: The encoded records, from which the error is found.
        values: The values. They are decoded while they are iterated.
        kind: Data type of the array.
        count: Number of values. It is -1 if the number is unknown.
        layout: Lengths of the vectors, with which the error is found.

    Raises:
        WireError: A record is not valid.
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
    """Finds the first payload that is not a valid record, to name the reason in an error.

    The fast decoding of single fields does not show which record was wrong. Therefore the
    records are decoded again as a whole.

    Args:
        payloads: The encoded records.
        default: Text of the error if every record is valid.
        layout: Lengths of the vectors. None accepts all lengths.

    Returns:
        The error that occurs if that record is decoded alone.
    """
    for payload in payloads:
        try:
            decode(payload, State, READABLE, layout)
        except WireError as error:
            return error
    return WireError("malformed", default)

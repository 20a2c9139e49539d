"""Decodes single fields of many records into arrays, without decoding complete records.

This is much faster if only a few fields are needed. For example, `RecordColumns.ticks` returns
the tick of each record. Every method raises `WireError` at the first message that is not a
valid record.

Invariant:
    - Only the requested fields are decoded.
    - Each field is checked in the same way as in a complete record: its type, its length, and
      that its values are finite.
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
"""More restrictive types for fields whose type in `State` is too wide."""
_DEFAULTS = {"sent_ns": 0}
"""Values of fields that are missing from records of older versions."""


class RecordColumns:
    """Fields of encoded records, each decoded into an array when it is requested.

    Accepts records of every readable version of the format. For records with an exactly known
    layout, `IndexedRecords` provides the same arrays.

    Args:
        payloads: K encoded records of one site.
    """

    def __init__(self, payloads: Sequence[bytes]) -> None:
        self._payloads = payloads

    def ticks(self) -> Ints:
        """Decodes the tick of every record, shape (K,)."""
        if any(len(payload) > MAX_BYTES for payload in self._payloads):
            raise self._find_error()
        pairs = chain.from_iterable(self._decode_fields("v", "tick"))
        numbers: Ints = self._to_array(pairs, np.int64, 2 * len(self._payloads))
        rows = numbers.reshape(-1, 2)
        versions = rows[:, 0]
        if not np.isin(versions, READABLE).all():
            raise self._find_error()
        return rows[:, 1].copy()

    def ints(self, field: str) -> Ints:
        """Decodes an integer field of every record, skipping all other fields.

        Args:
            field: Name of an integer field of `State`.

        Returns:
            The values, shape (K,).
        """
        return self._to_array(self._decode_fields(field), np.int64, len(self._payloads))

    def vectors(self, layout: Layout, *fields: str) -> dict[str, Array]:
        """Decodes vectors of every record, such as joint angles, skipping all other fields.

        Args:
            layout: Lengths of the vectors in these records.
            fields: Names of the fields, such as "q".

        Returns:
            Maps each field to an array of shape (K, length of the vector). The shape is (K, 0)
            for a field that these records do not have.
        """
        record_count = len(self._payloads)
        lengths = layout.lengths()
        present = [field for field in fields if field in lengths]
        absent = [field for field in fields if field not in lengths]
        vectors = {field: np.zeros((record_count, 0)) for field in absent}
        if not present:
            return vectors

        row_length = sum(lengths[field] for field in present)
        values = chain.from_iterable(self._decode_fields(*present, layout=layout))
        if len(present) > 1:
            # Each value is a whole vector of one field, instead of a number.
            values = chain.from_iterable(values)
        numbers: Array = self._to_array(values, np.float64, row_length * record_count, layout)
        if not np.isfinite(numbers).all():
            raise self._find_error(layout=layout)

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

    def objects(self, field: str) -> NDArray[np.object_]:
        """Decodes a field of every record as Python objects, such as strings or lists.

        Args:
            field: Name of the field.

        Returns:
            The values, shape (K,).
        """
        return self._to_array(self._decode_fields(field), np.object_, len(self._payloads))

    def per_peer(self, field: str, peers: Sequence[str], absent: int) -> dict[str, Ints]:
        """Decodes a field that contains one integer per peer, such as `used`.

        In a record, such a field maps the names of peers to integers.

        Args:
            field: Name of the field.
            peers: Names of the peers.
            absent: Value to return for a peer that the field of a record does not contain.

        Returns:
            Maps each peer to the integers of all records, shape (K,).
        """
        # A struct with an attribute per peer is decoded faster than a dict. The name of a peer
        # need not be a valid identifier, so the attributes have other names.
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
        records = map(decoder.decode, self._payloads)
        values: Iterator[Any] = map(get_numbers, records)
        if len(peers) > 1:
            # Each value is a tuple with one number per peer.
            values = chain.from_iterable(values)
        numbers = self._to_array(values, np.int64, len(peers) * len(self._payloads))
        rows = numbers.reshape(-1, len(peers))
        return {peer: rows[:, n].copy() for n, peer in enumerate(peers)}

    def arrivals(self) -> tuple[Ints, Ints]:
        """Decodes which samples of other arms arrived in each tick.

        Returns:
            The number of arrivals in each record, shape (K,), and all N arrivals in order,
            shape (N, 3). The columns are those of the field `rx`: index of the peer, tick of
            the sample, and delay in us.
        """
        counts = np.zeros(len(self._payloads), dtype=np.int64)

        def iterate_numbers() -> Iterator[int]:
            """Yields three integers per arrival, and counts the arrivals of each record."""
            for row, arrivals in enumerate(self._decode_fields("rx")):
                counts[row] = len(arrivals)
                for entry in arrivals:
                    yield from entry

        numbers = self._to_array(iterate_numbers(), np.int64, -1)
        return counts, numbers.reshape(-1, 3)

    def _decode_fields(self, *fields: str, layout: Layout | None = None) -> Iterator[Any]:
        """Yields the value of a field, or a tuple of several fields, for every record.

        Args:
            fields: Names of the fields.
            layout: Lengths of the vectors. If None, all lengths are accepted.
        """
        get_values: Callable[[Any], Any] = attrgetter(*fields)
        decoder = _find_decoder(fields, layout)
        records = map(decoder.decode, self._payloads)
        return map(get_values, records)

    def _to_array(
        self, values: Iterable[Any], kind: Any, count: int, layout: Layout | None = None
    ) -> NDArray[Any]:
        """Collects lazily decoded values in an array, and reports an invalid record.

        Args:
            values: Iterator that decodes the values.
            kind: Data type of the array.
            count: Number of values, or -1 if unknown.
            layout: Lengths of the vectors, used to find the error.

        Raises:
            WireError: A record is invalid.
        """
        try:
            return np.fromiter(values, kind, count)
        except (ValueError, OverflowError, RecursionError) as error:
            raise self._find_error(str(error), layout) from None

    def _find_error(
        self, default: str = "a number is out of range", layout: Layout | None = None
    ) -> WireError:
        """Finds the first payload that is not a valid record, and returns its error.

        The fast decoding of single fields does not show which record was invalid, so the
        records are decoded again completely.

        Args:
            default: Message of the error if every record is valid.
            layout: Lengths of the vectors. If None, all lengths are accepted.

        Returns:
            The error that occurs when that record is decoded alone.
        """
        for payload in self._payloads:
            try:
                decode(payload, State, READABLE, layout)
            except WireError as error:
                return error
        return WireError("malformed", default)


@cache
def _find_decoder(
    fields: tuple[str, ...], layout: Layout | None
) -> msgspec.msgpack.Decoder[Any]:
    """Returns a decoder for selected fields of an encoded record, which skips all others.

    This is faster than decoding the complete record.

    Args:
        fields: Names of the fields.
        layout: Required lengths of the vectors. If None, all lengths are accepted.
    """
    types = {field.name: field.type for field in msgspec.structs.fields(State)}
    types.update(_TYPES)
    if layout is not None:
        for field, length in layout.lengths().items():
            # The type of a tuple with that number of floats.
            types[field] = tuple.__class_getitem__((float,) * length)
    return _make_decoder({field: types[field] for field in fields})


def _make_decoder(types: dict[str, Any]) -> msgspec.msgpack.Decoder[Any]:
    """Creates a decoder for selected fields of encoded records, which skips all others.

    Args:
        types: Maps the name of each field to its type.
    """
    fields: list[Any] = []
    for name, kind in types.items():
        if name in _DEFAULTS:
            fields.append((name, kind, _DEFAULTS[name]))
        else:
            fields.append((name, kind))
    struct = msgspec.defstruct("Fields", fields, frozen=True, gc=False)
    return msgspec.msgpack.Decoder(struct)

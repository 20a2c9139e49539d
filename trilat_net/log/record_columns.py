"""Fields of many encoded records as arrays.

Invariant: only the requested fields are decoded, and each is checked as in a complete record:
type, length, finite values. Every function raises `WireError` for the first payload that is no
such record.
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
"""Types of fields that are narrower here than in `State`, as vectors are: of a fixed length."""
_DEFAULTS = {"sent_ns": 0}
"""Values of fields that records of older versions lack."""


def decode_ticks(payloads: Sequence[bytes]) -> Ints:
    """Returns the tick of every record, shape (K,); records of every readable version are
    accepted.
    """
    if any(len(payload) > MAX_BYTES for payload in payloads):
        raise _explain(payloads)
    pairs = decode_ints(payloads, "v", "tick").reshape(-1, 2)
    if not np.isin(pairs[:, 0], READABLE).all():
        raise _explain(payloads)
    return pairs[:, 1].copy()


def decode_ints(payloads: Sequence[bytes], *fields: str) -> Ints:
    """Returns whole numbers of 64 bits of every record, one record after the other."""
    found = _decode_fields(payloads, *fields)
    values = found if len(fields) == 1 else chain.from_iterable(found)
    return _to_array(payloads, values, np.int64, len(fields) * len(payloads))


def decode_vectors(payloads: Sequence[bytes], layout: Layout, *fields: str) -> dict[str, Array]:
    """Returns vectors of every record by their fields, shape (K, length of the vector) each, in
    one pass.

    Of what records of this layout leave out the length is 0.
    """
    lengths = layout.lengths()
    if absent := {
        field: np.zeros((len(payloads), 0)) for field in fields if field not in lengths
    }:
        there = [field for field in fields if field in lengths]
        return absent | (decode_vectors(payloads, layout, *there) if there else {})
    counts = [lengths[field] for field in fields]
    values = chain.from_iterable(_decode_fields(payloads, *fields, layout=layout))
    if len(fields) > 1:
        values = chain.from_iterable(values)
    rows: Array = _to_array(
        payloads=payloads,
        values=values,
        kind=np.float64,
        count=sum(counts) * len(payloads),
        layout=layout,
    )
    rows = rows.reshape(-1, sum(counts))
    if not np.isfinite(rows).all():
        raise _explain(payloads, layout=layout)
    if len(fields) == 1:
        return {fields[0]: rows}
    parts = np.split(rows, np.cumsum(counts)[:-1], axis=1)
    return {field: part.copy() for field, part in zip(fields, parts, strict=True)}


def decode_strings(payloads: Sequence[bytes], field: str) -> NDArray[np.object_]:
    """Returns a word, or another object, of every record, shape (K,)."""
    return _to_array(payloads, _decode_fields(payloads, field), np.object_, len(payloads))


def decode_per_peer(
    payloads: Sequence[bytes], field: str, peers: Sequence[str], absent: int
) -> dict[str, Ints]:
    """Returns a field with a whole number per peer, shape (K,) each; `absent` where a record
    names none.
    """
    places = [f"peer{n}" for n in range(len(peers))]
    entry = msgspec.defstruct(
        "Peers",
        [(place, int, absent) for place in places],
        rename=dict(zip(places, peers, strict=True)),
        gc=False,
    )
    decoder = _make_decoder({field: entry})
    take = attrgetter(*(f"{field}.{place}" for place in places))
    found = map(take, map(decoder.decode, payloads))
    values = found if len(peers) == 1 else chain.from_iterable(found)
    rows = _to_array(payloads, values, np.int64, len(peers) * len(payloads)).reshape(
        -1, len(peers)
    )
    return {peer: rows[:, n].copy() for n, peer in enumerate(peers)}


def decode_arrivals(payloads: Sequence[bytes]) -> tuple[Ints, Ints]:
    """Returns the arrivals: how many per record, shape (K,), and all in order as in `rx`, shape
    (N, 3).
    """
    counts = np.zeros(len(payloads), dtype=np.int64)

    def iterate_entries() -> Iterator[int]:
        for n, arrivals in enumerate(_decode_fields(payloads, "rx")):
            counts[n] = len(arrivals)
            for entry in arrivals:
                yield from entry

    return counts, _to_array(payloads, iterate_entries(), np.int64, -1).reshape(-1, 3)


def _decode_fields(
    payloads: Sequence[bytes], *fields: str, layout: Layout | None = None
) -> Iterator[Any]:
    take: Callable[[Any], Any] = attrgetter(*fields)
    return map(take, map(_find_decoder(fields, layout).decode, payloads))


@cache
def _find_decoder(
    fields: tuple[str, ...], layout: Layout | None
) -> msgspec.msgpack.Decoder[Any]:
    types = {field.name: field.type for field in msgspec.structs.fields(State)} | _TYPES
    for field, count in layout.lengths().items() if layout else ():
        types[field] = tuple.__class_getitem__((float,) * count)
    return _make_decoder({field: types[field] for field in fields})


def _make_decoder(types: dict[str, Any]) -> msgspec.msgpack.Decoder[Any]:
    fields = [
        (name, kind, _DEFAULTS[name]) if name in _DEFAULTS else (name, kind)
        for name, kind in types.items()
    ]
    return msgspec.msgpack.Decoder(msgspec.defstruct("Fields", fields, frozen=True, gc=False))


def _to_array(
    payloads: Sequence[bytes],
    values: Iterable[Any],
    kind: Any,
    count: int,
    layout: Layout | None = None,
) -> NDArray[Any]:
    try:
        return np.fromiter(values, kind, count)
    except (ValueError, OverflowError, RecursionError) as error:
        raise _explain(payloads, str(error), layout) from None


def _explain(
    payloads: Sequence[bytes],
    else_text: str = "a number is out of range",
    layout: Layout | None = None,
) -> WireError:
    """Returns the error of the first payload that is no record, as that record alone would
    raise it.
    """
    for payload in payloads:
        try:
            decode(payload, State, READABLE, layout)
        except WireError as error:
            return error
    return WireError("malformed", else_text)

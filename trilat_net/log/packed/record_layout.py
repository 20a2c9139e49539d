"""Describes, for compiled code, the exact bytes of a record as this program writes it.

A record is encoded by `net.wire.encode_state`. Its fields have a fixed order, and the bytes
between two values (such as the name of the next field) are always the same. These constant
bytes are called literals. By comparing them, `record_scan` recognises a record without a
general decoder.
"""

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from ...net import MODE_WORDS, VERSION
from ...records import Layout
from .packed_messages import Ints

_encode = msgspec.msgpack.Encoder().encode
_WORD_BYTES = 8
_FIRST_FIELDS = 22
"""Number of fields of a record, excluding the optional vectors."""
_OPTIONAL_VECTORS = ("x", "xd", "wrench", "ch", "hand", "bodies")
NUMBER_BYTES = 9
"""Length of an encoded floating-point number, in bytes."""

# Indices of the literals before single values. Those of vectors and peers follow.
BEFORE_BOOT, BEFORE_TICK, BEFORE_TIME, BEFORE_MODE, BEFORE_USED, BEFORE_ARRIVALS = range(6)
BEFORE_CRC, BEFORE_CHANGES, BEFORE_MEMORY, BEFORE_LATE = range(6, 10)
BEFORE_BUSY, BEFORE_SENT, BEFORE_ECHO, FIRST_VECTOR = range(10, 14)


class RecordLayout(NamedTuple):
    """The constant bytes (literals) between the values of a record, and its vector lengths.

    Compiled code compares records with the literals. Each literal is stored as words of eight
    bytes. Only the bytes selected by the mask of a word belong to the literal.

    Attributes:
        bits: Words of all literals, shape (W,).
        masks: Masks of the words, shape (W,).
        first_words: Index of the first word of each of the L literals, followed by W, shape (L
            + 1,).
        lengths: Length of each literal in bytes, shape (L,).
        vectors: Length of each vector before the field `used`, shape (V,). Vector n follows
            literal `FIRST_VECTOR` + n.
        optional_vectors: Length of each vector after the field `echo`, shape (O,). Their
            literals follow those of the other vectors.
        peers: Number of peers. Their literals come last.
        modes: Words of the names of the modes, shape (M, 2): the name, and its mask.
        mode_codes: Code of each mode, shape (M,).
    """

    bits: Ints
    masks: Ints
    first_words: Ints
    lengths: Ints
    vectors: Ints
    optional_vectors: Ints
    peers: int
    modes: Ints
    mode_codes: Ints

    @classmethod
    def of_site(cls, site: str, peers: Sequence[str], layout: Layout) -> "RecordLayout":
        """Describes byte by byte how this program encodes the records of one arm.

        Records with this layout can be read without a general decoder, which is faster.

        Args:
            site: Name of the site.
            peers: Names of its peers, in scenario order.
            layout: Lengths of the vectors of a record.
        """
        lengths = layout.lengths()
        optional = {name: lengths[name] for name in _OPTIONAL_VECTORS if name in lengths}
        vectors = {name: count for name, count in lengths.items() if name not in optional}
        fields = _FIRST_FIELDS + len(optional)
        literals = [
            _map_head(fields) + b"".join(map(_encode, ("v", VERSION, "site", site, "boot"))),
            *map(_encode, ("tick", "t_ns", "mode")),
            _encode("used") + _map_head(len(peers)),
            *map(
                _encode, ("rx", "rx_crc", "cmd", "mem", "late_us", "busy_us", "sent_ns", "echo")
            ),
        ]
        assert len(literals) == FIRST_VECTOR
        for name, count in [*vectors.items(), *optional.items()]:
            literals.append(_encode(name) + _array_head(count))
        literals += map(_encode, peers)

        bits = []
        masks = []
        first_words = [0]
        for literal in literals:
            padded = -len(literal) % _WORD_BYTES
            bits.append(literal + bytes(padded))
            masks.append(b"\xff" * len(literal) + bytes(padded))
            first_words.append(first_words[-1] + len(bits[-1]) // _WORD_BYTES)
        modes = []
        for word in MODE_WORDS.values():
            padded = _WORD_BYTES - len(word)
            modes.append(word.encode() + bytes(padded) + b"\xff" * len(word) + bytes(padded))
        return cls(
            bits=np.frombuffer(b"".join(bits), "<i8").astype(np.int64),
            masks=np.frombuffer(b"".join(masks), "<i8").astype(np.int64),
            first_words=np.array(first_words, np.int64),
            lengths=np.array(list(map(len, literals)), np.int64),
            vectors=np.array(list(vectors.values()), np.int64),
            optional_vectors=np.array(list(optional.values()), np.int64),
            peers=len(peers),
            modes=np.frombuffer(b"".join(modes), "<i8").astype(np.int64).reshape(-1, 2),
            mode_codes=np.array(list(map(int, MODE_WORDS)), np.int64),
        )


def _array_head(length: int) -> bytes:
    """Returns the first bytes of an encoded list (MessagePack) of a given length."""
    return _encode([None] * length)[:-length] if length else _encode([])


def _map_head(length: int) -> bytes:
    """Returns the first bytes of an encoded map (MessagePack) of a given length."""
    pair_bytes = len(_encode("00")) + len(_encode(None))
    encoded = _encode({f"{n:02}": None for n in range(length)})
    return encoded[: len(encoded) - length * pair_bytes]

"""Checks whether encoded records have the exact layout, and finds where their values lie.

Once the offsets of the values are known, a field of all records can be read directly from the
bytes (`indexed_records`).

Invariant:
    - A record is accepted only if the decoder for complete records accepts it too, with the
      same values.
    - A record with another order of fields, another version, or an unusual value is not
      accepted, even if it is valid.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import leaf, loop_leaf
from ...net import MAX_BYTES
from ...records import MAX_JOINTS, MAX_LAW_MEMORY
from .byte_words import load_big, load_little
from .packed_messages import Bytes, Ints
from .record_layout import (
    BEFORE_ARRIVALS,
    BEFORE_BOOT,
    BEFORE_BUSY,
    BEFORE_CHANGES,
    BEFORE_CRC,
    BEFORE_ECHO,
    BEFORE_LATE,
    BEFORE_MEMORY,
    BEFORE_MODE,
    BEFORE_SENT,
    BEFORE_TICK,
    BEFORE_TIME,
    BEFORE_USED,
    FIRST_VECTOR,
    NUMBER_BYTES,
)

# Columns of the marks of a record: the offset of a value from the first byte of the record.
TIME, VECTORS, USED, ARRIVALS, CRC, MEMORY, LATE, OPTIONAL = range(8)
MARKS = 8
"""Number of marks per record."""
# Columns of the counts of a record.
ARRIVAL_COUNT, CHANGE_COUNT, MEMORY_COUNT = range(3)
COUNTS = 3
"""Number of counts per record."""

_NOT_ACCEPTED = -1
_MOST_TICKS = 1 << 40
_MOST_INSTANT = 1 << 59
_MOST_MEMORY = MAX_JOINTS + 1 + MAX_LAW_MEMORY
_EXPONENT = 0x7FF << 52
"""Bits of a floating-point number that are all set if it is infinite or NaN."""
_FLOAT = 0xCB
_SHORT_MAP, _SHORT_LIST, _SHORT_TEXT, _FIRST_WORD = 0x80, 0x90, 0xA0, 0xC0
_TEXT_8, _TEXT_16, _LIST_16, _LIST_32 = 0xD9, 0xDA, 0xDC, 0xDD
_UNSIGNED, _SIGNED, _NEGATIVE = 0xCC, 0xD0, 0xE0


def _list_sizes() -> NDArray[np.int64]:
    """Returns the length of an encoded integer for each value of its first byte.

    0 for values with which no integer begins.
    """
    sizes = np.zeros(256, np.int64)
    sizes[:_SHORT_MAP] = 1
    sizes[_NEGATIVE:] = 1
    for n, size in enumerate((2, 3, 5, 9)):
        sizes[_UNSIGNED + n] = size
        sizes[_SIGNED + n] = size
    return sizes


_SIZES = _list_sizes()


@leaf
def _read_int(data: Bytes, offset: int) -> int:
    """Decodes the integer that begins at an offset, in the binary format MessagePack.

    The result is a signed 64-bit integer. An unsigned integer of 2^63 or more becomes the
    negative integer with the same bits.
    """
    first = int(data[offset])
    if first < _SHORT_MAP:  # a small number, which is its own code
        return first
    if first >= _NEGATIVE:  # a small negative number, from -32 on
        return first - 256
    # The number follows the first byte, with the most significant byte first. Eight bytes are
    # loaded, of which the last ones may belong to the next value.
    unused_bits = 72 - 8 * _SIZES[first]
    word = load_big(data, offset + 1)
    value: int = word >> unused_bits
    if first < _SIGNED and unused_bits > 0:
        value &= (1 << (64 - unused_bits)) - 1
    return value


@leaf
def _after_literal(data: Bytes, offset: int, end: int, literal: int, layout: Any) -> int:
    """Returns the offset after constant bytes that every encoded record has at this point.

    Returns -1 if the record has other bytes there. The record must then be decoded in another
    way.
    """
    after: int = offset + layout.lengths[literal]
    if after > end:
        return _NOT_ACCEPTED
    difference = 0
    first = layout.first_words[literal]
    for n in range(first, layout.first_words[literal + 1]):
        word = load_little(data, offset + 8 * (n - first))
        difference |= (word ^ layout.bits[n]) & layout.masks[n]
    return _NOT_ACCEPTED if difference != 0 else after


@leaf
def _int_after(data: Bytes, offset: int, end: int, literal: int, layout: Any) -> int:
    """Returns the offset of an integer that follows constant bytes in an encoded record.

    Args:
        data: The records.
        offset: Offset at which the literal must begin.
        end: Offset after the record.
        literal: Index of the literal in `layout`.
        layout: The exact layout of the records, a `RecordLayout`.

    Returns:
        The offset, or -1 if the record has other bytes there, or no complete integer.
    """
    offset = _after_literal(data, offset, end, literal, layout)
    if offset < 0 or offset >= end:
        return _NOT_ACCEPTED
    size = _SIZES[data[offset]]
    if size == 0 or offset + size > end:
        return _NOT_ACCEPTED
    # An unsigned number of 2^63 or more does not fit into a column.
    if size == NUMBER_BYTES and data[offset] < _SIGNED and data[offset + 1] >= _SHORT_MAP:
        return _NOT_ACCEPTED
    return offset


@leaf
def _list_count(data: Bytes, offset: int, end: int) -> int:
    """Returns the length of the list that begins at an offset, or -1 if there is none."""
    if offset < 0 or offset >= end:
        return _NOT_ACCEPTED
    first = int(data[offset])
    if _SHORT_LIST <= first < _SHORT_TEXT:
        return first - _SHORT_LIST
    if first == _LIST_16 and offset + 3 <= end:
        return 256 * int(data[offset + 1]) + int(data[offset + 2])
    return _NOT_ACCEPTED


@leaf
def _list_head_bytes(data: Bytes, offset: int) -> int:
    """Returns the size in bytes of the header of the list that begins at an offset."""
    return 3 if data[offset] == _LIST_16 else 1


@leaf
def _after_floats(data: Bytes, offset: int, end: int, count: int) -> int:
    """Returns the offset after floating-point numbers, or -1 if one of them is not finite."""
    after = offset + NUMBER_BYTES * count
    if after > end:
        return _NOT_ACCEPTED
    wrong = 0
    for n in range(count):
        number = offset + NUMBER_BYTES * n
        word = load_big(data, number + 1)
        wrong |= (data[number] != _FLOAT) | ((word & _EXPONENT) == _EXPONENT)
    return _NOT_ACCEPTED if wrong else after


@leaf
def _after_vectors(
    data: Bytes, offset: int, end: int, first: int, vectors: Ints, layout: Any
) -> int:
    """Returns the offset after vectors with their names, or -1 if any is missing."""
    for n in range(vectors.shape[0]):
        offset = _after_literal(data, offset, end, first + n, layout)
        if offset >= 0:
            offset = _after_floats(data, offset, end, vectors[n])
        if offset < 0:
            return _NOT_ACCEPTED
    return offset


@leaf
def _after_stamps(data: Bytes, offset: int, end: int) -> int:
    """Returns the offset after a list of arrivals, each an entry of three integers.

    An entry states which sample of another arm arrived, and when. Returns -1 if there is no
    such list, or if an integer is too large to be a time.
    """
    count = _list_count(data, offset, end)
    if count < 0:
        return _NOT_ACCEPTED
    offset += _list_head_bytes(data, offset)
    for _ in range(count):
        # An entry is a list of three items.
        if offset >= end or data[offset] != _SHORT_LIST + 3:
            return _NOT_ACCEPTED
        offset += 1
        for _ in range(3):
            if offset >= end:
                return _NOT_ACCEPTED
            size = _SIZES[data[offset]]
            if size == 0 or offset + size > end:
                return _NOT_ACCEPTED
            value = _read_int(data, offset)
            is_huge = size == NUMBER_BYTES and data[offset] < _SIGNED and value < 0
            if is_huge or value < -_MOST_INSTANT or value >= _MOST_INSTANT:
                return _NOT_ACCEPTED
            offset += size
    return offset


@leaf
def _after_texts(data: Bytes, offset: int, end: int) -> int:
    """Returns the offset after a list of ASCII strings, such as the changes in a record.

    Returns -1 if there is no such list. Non-ASCII characters are left to the general decoder,
    which checks their encoding.
    """
    count = _list_count(data, offset, end)
    if count < 0:
        return _NOT_ACCEPTED
    offset += _list_head_bytes(data, offset)
    for _ in range(count):
        if offset >= end:
            return _NOT_ACCEPTED
        # The head of a text contains its length, in 1, 2 or 3 bytes.
        first = int(data[offset])
        if _SHORT_TEXT <= first < _FIRST_WORD:
            length = first - _SHORT_TEXT
            offset += 1
        elif first == _TEXT_8 and offset + 2 <= end:
            length = int(data[offset + 1])
            offset += 2
        elif first == _TEXT_16 and offset + 3 <= end:
            length = 256 * int(data[offset + 1]) + int(data[offset + 2])
            offset += 3
        else:
            return _NOT_ACCEPTED
        if offset + length > end:
            return _NOT_ACCEPTED
        for n in range(length):
            if data[offset + n] >= _SHORT_MAP:  # not ASCII
                return _NOT_ACCEPTED
        offset += length
    return offset


@leaf
def _find_mode(data: Bytes, offset: int, end: int, layout: Any) -> int:
    """Returns the index of the mode whose name begins at an offset.

    Returns -1 if no mode has this name. Names have at most eight letters, so they are compared
    as one integer.
    """
    if offset < 0 or offset >= end:
        return _NOT_ACCEPTED
    length = int(data[offset]) - _SHORT_TEXT
    if length < 1 or length > 8 or offset + 1 + length > end:
        return _NOT_ACCEPTED
    word = load_little(data, offset + 1)
    for n in range(layout.modes.shape[0]):
        mask = layout.modes[n, 1]
        # The mask of a shorter name would accept a longer name.
        if (word & mask) == layout.modes[n, 0] and _mask_bytes(mask) == length:
            return n
    return _NOT_ACCEPTED


@leaf
def _mask_bytes(mask: int) -> int:
    """Returns the number of bytes that a mask selects, from the least significant one up."""
    count = 0
    while count < 8 and (mask >> (8 * count)) & 1:
        count += 1
    return count


@leaf
def _scan_record(
    data: Bytes, start: int, end: int, layout: Any, heads: Ints, marks: Any, counts: Any
) -> bool:
    """Checks that one encoded record has the expected bytes, and locates its values.

    The arguments are those of `scan_records`, for one record from `start` up to, but excluding,
    `end`.

    Returns:
        True if the record is accepted.
    """
    offset = _after_literal(data, start, end, BEFORE_BOOT, layout)
    if offset < 0 or offset >= end:
        return False
    size = _SIZES[data[offset]]
    # The boot is the only number that may be 2^63 or more.
    if size == 0 or offset + size > end:
        return False
    boot = _read_int(data, offset)
    is_unsigned = data[offset] < _SIGNED
    if boot < 0 and not is_unsigned:
        return False
    heads[1] = boot
    offset = _int_after(data, offset + size, end, BEFORE_TICK, layout)
    if offset < 0:
        return False
    heads[0] = _read_int(data, offset)
    if heads[0] < 0 or heads[0] >= _MOST_TICKS:
        return False
    offset = _int_after(data, offset + _SIZES[data[offset]], end, BEFORE_TIME, layout)
    if offset < 0:
        return False
    marks[TIME] = offset - start
    offset = _after_literal(data, offset + _SIZES[data[offset]], end, BEFORE_MODE, layout)
    mode = _find_mode(data, offset, end, layout)
    if mode < 0:
        return False
    heads[2] = layout.mode_codes[mode]
    offset += 1 + int(data[offset]) - _SHORT_TEXT
    marks[VECTORS] = offset - start
    offset = _after_vectors(data, offset, end, FIRST_VECTOR, layout.vectors, layout)
    if offset < 0:
        return False

    offset = _after_literal(data, offset, end, BEFORE_USED, layout)
    if offset < 0:
        return False
    marks[USED] = offset - start
    first_peer = FIRST_VECTOR + layout.vectors.shape[0] + layout.optional_vectors.shape[0]
    for n in range(layout.peers):
        offset = _int_after(data, offset, end, first_peer + n, layout)
        if offset < 0:
            return False
        offset += _SIZES[data[offset]]

    offset = _after_literal(data, offset, end, BEFORE_ARRIVALS, layout)
    marks[ARRIVALS] = offset - start
    counts[ARRIVAL_COUNT] = _list_count(data, offset, end)
    offset = _after_stamps(data, offset, end)
    if offset < 0:
        return False
    offset = _int_after(data, offset, end, BEFORE_CRC, layout)
    if offset < 0 or _read_int(data, offset) < 0:
        return False
    marks[CRC] = offset - start
    offset = _after_literal(data, offset + _SIZES[data[offset]], end, BEFORE_CHANGES, layout)
    counts[CHANGE_COUNT] = _list_count(data, offset, end)
    offset = _after_texts(data, offset, end)
    if offset < 0:
        return False
    offset = _after_literal(data, offset, end, BEFORE_MEMORY, layout)
    memory = _list_count(data, offset, end)
    if memory < 0 or memory > _MOST_MEMORY:
        return False
    counts[MEMORY_COUNT] = memory
    offset += _list_head_bytes(data, offset)
    marks[MEMORY] = offset - start
    offset = _after_floats(data, offset, end, memory)
    if offset < 0:
        return False

    offset = _int_after(data, offset, end, BEFORE_LATE, layout)
    if offset < 0:
        return False
    marks[LATE] = offset - start
    offset = _int_after(data, offset + _SIZES[data[offset]], end, BEFORE_BUSY, layout)
    if offset < 0:
        return False
    offset = _int_after(data, offset + _SIZES[data[offset]], end, BEFORE_SENT, layout)
    if offset < 0:
        return False
    sent_ns = _read_int(data, offset)
    if sent_ns < -_MOST_INSTANT or sent_ns >= _MOST_INSTANT:
        return False
    offset = _after_literal(data, offset + _SIZES[data[offset]], end, BEFORE_ECHO, layout)
    offset = _after_stamps(data, offset, end)
    if offset < 0:
        return False
    marks[OPTIONAL] = offset - start
    first_optional = FIRST_VECTOR + layout.vectors.shape[0]
    offset = _after_vectors(data, offset, end, first_optional, layout.optional_vectors, layout)
    return offset == end


@loop_leaf
def scan_records(
    data: Bytes, starts: Ints, ends: Ints, layout: Any, heads: Ints, marks: Any, counts: Any
) -> int:
    """Checks that each record has the exact layout, and finds where its values lie.

    With the offsets found here, a field of all records can be read without decoding.

    Args:
        data: The records, followed by padding.
        starts: Offset of the first byte of each of the K records, shape (K,).
        ends: Offset after the last byte of each record, shape (K,).
        layout: The exact layout of the records, a `RecordLayout`.
        heads: Output array for the tick, the boot (identifier of the process) and the mode code
            of each record, shape (K, 3). A boot of 2^63 or more is stored as the signed integer
            with the same bits.
        marks: Output array for the offsets of values (TIME, ...) from the start of each record,
            shape (K, MARKS).
        counts: Output array for the lengths of lists (ARRIVAL_COUNT, ...), shape (K, COUNTS).

    Returns:
        The number of records before the first one that is not accepted.
    """
    records: int = starts.shape[0]
    for k in range(records):
        start = starts[k]
        end = ends[k]
        if end - start > MAX_BYTES:
            return k
        if not _scan_record(data, start, end, layout, heads[k], marks[k], counts[k]):
            return k
    return records


@loop_leaf
def gather_ints(data: Bytes, starts: Ints, marks: Any, gaps: Ints, numbers: Ints) -> None:
    """Reads consecutive integers at known positions in each encoded record.

    Args:
        data: The encoded records, followed by padding.
        starts: Offset of the first byte of each of the K records, shape (K,).
        marks: Offset at which the first gap begins, from the start of each record, shape (K,).
        gaps: Number of other bytes just before each of the N integers, shape (N,).
        numbers: Output array for the integers, shape (K, N).
    """
    for k in range(starts.shape[0]):
        offset = starts[k] + marks[k]
        for n in range(gaps.shape[0]):
            offset += gaps[n]
            numbers[k, n] = _read_int(data, offset)
            offset += _SIZES[data[offset]]


@loop_leaf
def gather_floats(data: Bytes, starts: Ints, marks: Any, places: Ints, bits: Ints) -> None:
    """Reads floating-point values from each encoded record as bit patterns.

    Vectors have fixed lengths, so their entries lie at fixed offsets from a known position (the
    mark) in each record.

    Args:
        data: The encoded records, followed by padding.
        starts: Offset of the first byte of each of the K records, shape (K,).
        marks: Offset of the mark from the start of each record, shape (K,).
        places: Offset of each of the N values from the mark, shape (N,).
        bits: Output array for the bit patterns, shape (K, N).
    """
    for k in range(starts.shape[0]):
        offset = starts[k] + marks[k] + 1  # the first byte of a number states its type
        for n in range(places.shape[0]):
            bits[k, n] = load_big(data, offset + places[n])


@loop_leaf
def gather_stamps(data: Bytes, starts: Ints, marks: Any, counts: Any, numbers: Ints) -> None:
    """Reads the arrivals of samples from every encoded record.

    Args:
        data: The encoded records, followed by padding.
        starts: Offset of the first byte of each of the K records, shape (K,).
        marks: Offset of the list of arrivals from the start of each record, shape (K,).
        counts: Number of arrivals in each record, shape (K,).
        numbers: Output array for the N arrivals of all records in order, with three integers
            per arrival, shape (N, 3).
    """
    row = 0
    for k in range(starts.shape[0]):
        offset = starts[k] + marks[k]
        offset += _list_head_bytes(data, offset)
        for _ in range(counts[k]):
            offset += 1  # the head of the entry, a list of three numbers
            for n in range(3):
                numbers[row, n] = _read_int(data, offset)
                offset += _SIZES[data[offset]]
            row += 1


@loop_leaf
def gather_memories(data: Bytes, starts: Ints, marks: Any, counts: Any, bits: Ints) -> None:
    """Reads the internal state of the control law from every record as bit patterns.

    The state is stored in the field `mem`.

    Args:
        data: The encoded records, followed by padding.
        starts: Offset of the first byte of each of the K records, shape (K,).
        marks: Offset of the first entry of the state from the start of each record, shape (K,).
        counts: Length of the state vector in each record, shape (K,).
        bits: Output array for the bit patterns of the N entries of all records, shape (N,).
    """
    row = 0
    for k in range(starts.shape[0]):
        offset = starts[k] + marks[k] + 1  # the first byte of a number states its type
        for n in range(counts[k]):
            bits[row] = load_big(data, offset + NUMBER_BYTES * n)
            row += 1

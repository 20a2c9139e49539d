"""Reads fields of many records of an arm as arrays, without decoding the records one by one.

Compiled code locates each field in the encoded records once. The ticks of all records, for
example, can then be read directly from the bytes.

Invariant:
    - All records have the exact layout that this program writes. Otherwise there is no
      `IndexedRecords`, and `record_columns` decodes the records instead.
    - The arrays equal those of `record_columns`, bit for bit.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...core import Array
from ...net import MODE_WORDS
from ...records import Layout
from . import record_scan
from .packed_messages import Ints, PackedMessages
from .record_layout import BEFORE_BUSY, BEFORE_SENT, FIRST_VECTOR, NUMBER_BYTES, RecordLayout

_INTS = {
    "t_ns": (record_scan.TIME, ()),
    "rx_crc": (record_scan.CRC, ()),
    "late_us": (record_scan.LATE, ()),
    "busy_us": (record_scan.LATE, (BEFORE_BUSY,)),
    "sent_ns": (record_scan.LATE, (BEFORE_BUSY, BEFORE_SENT)),
}
"""For each integer field, the mark before the field, and the literals between the mark and the
field.
"""
_TICK, _BOOT, _MODE = range(3)
"""Columns of the array `heads`, see `record_scan.scan_records`."""


class IndexedRecords:
    """Fields of K records of an arm, read directly from the encoded bytes by compiled code.

    All records have the layout that this program writes. Created by
    `IndexedRecords.of_payloads`.

    Args:
        messages: The encoded records.
        peers: Names of the site's peers.
        layout: Lengths of the vectors of a record.
        exact: The constant bytes between the values of a record.
        heads: Tick, boot and mode of each record, shape (K, 3).
        marks: Offsets of values in each record, see `record_scan.MARKS`, shape (K, MARKS).
        counts: Lengths of lists in each record, see `record_scan.COUNTS`, shape (K, COUNTS).

    Attributes:
        messages: The encoded records.
    """

    def __init__(
        self,
        messages: PackedMessages,
        peers: Sequence[str],
        layout: Layout,
        exact: RecordLayout,
        heads: Ints,
        marks: NDArray[np.int32],
        counts: NDArray[np.int32],
    ) -> None:
        """Stores encoded records, with the positions of their values found by `of_payloads`."""
        self.messages = messages
        self._peers = peers
        self._layout = layout
        self._exact = exact
        self._heads = heads
        self._marks = marks
        self._counts = counts

    def __len__(self) -> int:
        return len(self.messages)

    def select(self, rows: Ints | slice) -> "IndexedRecords":
        """Returns a selection of the records, in any order, without decoding them.

        Args:
            rows: Indices of the records, or a slice.
        """
        return IndexedRecords(
            messages=self.messages.select(rows),
            peers=self._peers,
            layout=self._layout,
            exact=self._exact,
            heads=self._heads[rows],
            marks=self._marks[rows],
            counts=self._counts[rows],
        )

    @property
    def ticks(self) -> Ints:
        """Tick number of each of the K records, shape (K,)."""
        return np.ascontiguousarray(self._heads[:, _TICK])

    @property
    def boots(self) -> Ints:
        """Random number in each record that identifies the start of the process, shape (K,).

        A restarted process has a different number. It is an unsigned 64-bit integer, returned
        as the signed integer with the same bits.
        """
        return self._heads[:, _BOOT]

    @property
    def mode_codes(self) -> Ints:
        """Code of the site's mode in each record, shape (K,), see `Mode`."""
        return self._heads[:, _MODE]

    @property
    def modes(self) -> NDArray[np.object_]:
        """Name of the site's mode in each record, such as "run", shape (K,)."""
        bits = np.empty(max(map(int, MODE_WORDS)) + 1, np.object_)
        for mode, word in MODE_WORDS.items():
            bits[int(mode)] = word
        return bits[self.mode_codes]

    def ints(self, field: str) -> Ints:
        """Returns an integer field of all K records as an array of shape (K,).

        Args:
            field: Name of the field, one of `_INTS`.
        """
        mark, literals = _INTS[field]
        gaps = [0, *self._exact.lengths[list(literals)].tolist()]
        return np.ascontiguousarray(self._gather_ints(mark, gaps)[:, -1])

    def has_ints(self, field: str) -> bool:
        """Returns True if `ints` can read an integer field of this name from the records."""
        return field in _INTS

    def _gather_ints(self, mark: int, gaps: Sequence[int]) -> Ints:
        """Reads integers at known distances after a position in each encoded record.

        The result has the shape (K, number of gaps). A gap is the number of bytes before an
        integer.
        """
        numbers = np.zeros((len(self), len(gaps)), np.int64)
        record_scan.gather_ints(
            self.messages.data,
            self.messages.starts,
            self._marks[:, mark],
            np.array(gaps, np.int64),
            numbers,
        )
        return numbers

    @property
    def used(self) -> Ints:
        """Ticks of the peers' samples that the control law used, for each of the K records.

        Shape (K, P) for P peers. The tick is -1 before the first sample of a peer.
        """
        peers = self._exact.peers
        lengths = self._exact.lengths
        return self._gather_ints(record_scan.USED, lengths[len(lengths) - peers :].tolist())

    def vector_words(self, fields: Sequence[str]) -> Ints:
        """Returns vectors of all K records as bit patterns, for exact comparison of records.

        The shape is (K, total number of entries). Equal bits mean equal values, even for NaN
        and signed zeros. Compiled code reads the entries at fixed offsets from a known position
        (mark) in each encoded record. A record has two such positions, so the entries are read
        in up to two groups.

        Args:
            fields: Names of the vectors. The records must have all of them.
        """
        offsets: dict[int, list[int]] = {record_scan.VECTORS: [], record_scan.OPTIONAL: []}
        columns: dict[int, list[int]] = {record_scan.VECTORS: [], record_scan.OPTIONAL: []}
        places = self._vector_places()
        column_count = 0
        for field in fields:
            mark, first_offset, count = places[field]
            end_offset = first_offset + count * NUMBER_BYTES
            offsets[mark] += range(first_offset, end_offset, NUMBER_BYTES)
            columns[mark] += range(column_count, column_count + count)
            column_count += count

        bits_by_mark = {
            mark: self._gather_floats(mark, mark_offsets)
            for mark, mark_offsets in offsets.items()
            if mark_offsets
        }
        if len(bits_by_mark) == 1:
            [all_bits] = bits_by_mark.values()
            return all_bits  # spares a copy
        bits = np.zeros((len(self), column_count), np.int64)
        for mark, mark_bits in bits_by_mark.items():
            bits[:, columns[mark]] = mark_bits
        return bits

    def _gather_floats(self, mark: int, places: Sequence[int]) -> Ints:
        """Reads the bits of floats at fixed distances after a position in each encoded record.

        The result has the shape (K, number of distances).
        """
        bits = np.zeros((len(self), len(places)), np.int64)
        record_scan.gather_floats(
            self.messages.data,
            self.messages.starts,
            self._marks[:, mark],
            np.array(places, np.int64),
            bits,
        )
        return bits

    def _vector_places(self) -> dict[str, tuple[int, int, int]]:
        """Locates the vectors, such as joint angles, in an encoded record.

        Returns:
            Maps each vector to the column of `marks` with the position from which its offset is
            counted, the offset of its first entry in bytes, and its number of entries.
        """
        exact = self._exact
        names = list(self._layout.lengths())
        first_optional = len(exact.vectors)
        counts = [*exact.vectors.tolist(), *exact.optional_vectors.tolist()]
        places = {}
        offset = 0
        for n, (name, count) in enumerate(zip(names, counts, strict=True)):
            if n == first_optional:
                offset = 0  # the optional vectors have their own mark
            mark = record_scan.VECTORS if n < first_optional else record_scan.OPTIONAL
            name_bytes = int(exact.lengths[FIRST_VECTOR + n])  # the name and the list's head
            offset += name_bytes
            places[name] = (mark, offset, count)
            offset += count * NUMBER_BYTES
        return places

    def vectors(self, fields: Sequence[str]) -> dict[str, Array]:
        """Reads vectors, such as joint angles, from all encoded records.

        Args:
            fields: Names of the vectors.

        Returns:
            Maps each field to an array of shape (K, length). The length is 0 for a field that
            these records do not have.
        """
        lengths = self._layout.lengths()
        vectors = {}
        for field in fields:
            if field in lengths:
                vectors[field] = self.vector_words([field]).view(np.float64)
            else:
                vectors[field] = np.zeros((len(self), 0))
        return vectors

    @property
    def arrivals(self) -> tuple[Ints, Ints]:
        """Samples that arrived from the peers in each tick.

        The first array contains the number of arrivals in each record, shape (K,). The second
        lists all N arrivals in order: sender, tick of the sample and delay in us, shape (N, 3).
        """
        counts = self._counts[:, record_scan.ARRIVAL_COUNT].astype(np.int64)
        numbers = np.zeros((int(counts.sum()), 3), np.int64)
        record_scan.gather_stamps(
            self.messages.data,
            self.messages.starts,
            self._marks[:, record_scan.ARRIVALS],
            counts,
            numbers,
        )
        return counts, numbers

    @property
    def change_counts(self) -> NDArray[np.int32]:
        """Number of parameter changes that each record contains, shape (K,).

        The changes are the strings in the field `cmd`. Most records contain none.
        """
        return self._counts[:, record_scan.CHANGE_COUNT]

    @property
    def memory_words(self) -> tuple[Ints, Ints]:
        """Internal state of the control law (field `mem`) in each record, as bit patterns.

        The first array contains the length of the state vector in each record, shape (K,). The
        second contains the bits of the entries of all records, one after another.
        """
        counts = self._counts[:, record_scan.MEMORY_COUNT].astype(np.int64)
        bits = np.zeros(int(counts.sum()), np.int64)
        record_scan.gather_memories(
            self.messages.data,
            self.messages.starts,
            self._marks[:, record_scan.MEMORY],
            counts,
            bits,
        )
        return counts, bits

    @property
    def memories(self) -> NDArray[np.object_]:
        """Internal state of the control law in each record, as a list of numbers, shape (K,).

        This is the field `mem` of a record. A simulation needs it to continue from the record.
        """
        counts, bits = self.memory_words
        numbers = bits.view(np.float64).tolist()
        lists = np.empty(len(self), np.object_)
        first = 0
        for k, count in enumerate(counts.tolist()):
            lists[k] = numbers[first : first + count]
            first += count
        return lists

    @classmethod
    def of_payloads(
        cls, payloads: PackedMessages, site: str, peers: Sequence[str], layout: Layout
    ) -> "IndexedRecords | None":
        """Locates the fields in records, so that they can be read without decoding the records.

        Works only if all records have the exact layout that this program writes.

        Args:
            payloads: The encoded records.
            site: Name of the site that sent them.
            peers: Names of its peers, in scenario order.
            layout: Lengths of the vectors of a record.

        Returns:
            The records, or None if a record has another layout or is invalid.
        """
        exact = RecordLayout.of_site(site, peers, layout)
        count = len(payloads)
        heads = np.zeros((count, 3), np.int64)
        marks = np.zeros((count, record_scan.MARKS), np.int32)
        counts = np.zeros((count, record_scan.COUNTS), np.int32)
        accepted = record_scan.scan_records(
            payloads.data, payloads.starts, payloads.ends, exact, heads, marks, counts
        )
        if accepted < count:
            return None
        return cls(
            messages=payloads,
            peers=peers,
            layout=layout,
            exact=exact,
            heads=heads,
            marks=marks,
            counts=counts,
        )

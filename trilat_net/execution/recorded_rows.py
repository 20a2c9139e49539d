"""Converts the records of a log to arrays, so that compiled code can verify them quickly.

A record is the stored result of one control period (tick) of an arm. To verify a log, each tick
is computed again. The compiled loop `TickRepeater` does so for many consecutive ticks in one
call, if all inputs of these ticks are in the log. `verify` executes the other ticks one by one.

Invariant:
    - Only records in the exact layout that this program writes are converted.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import MAX_ARRIVALS, Array, IntArray, RecordedRows, Site, TickRepeater, leaf
from ..log import IndexedRecords, Log, SiteLog
from ..records import NS_PER_S

BLOCK_ROWS = 1 << 14
"""Largest number of records that are executed again together."""
LEAST_ROWS = 8
"""Smallest number of records for which the compiled loop is faster than single ticks."""
_FIRST_TARGET = 3
"""First column of the target in the field `hand`, after grip, number and source."""
_MASK_64 = (1 << 64) - 1


class SampleTable(NamedTuple):
    """The states (samples) that all sites of a log sent, for a fast look-up by site and tick.

    Attributes:
        bits: Position, velocity and external torque of each sample in the coordinates that
            the sites share, as the bits of the numbers, shape (N, 3 m).
        rows: Row in `bits` of the sample of each site and tick, shape (sites, ticks). -1 if
            the log has no record of the tick.
        sites: Index of each site in `rows`.
    """

    bits: IntArray
    rows: IntArray
    sites: Mapping[str, int]


def make_sample_table(log: Log) -> SampleTable | None:
    """Collects the states (samples) that all sites of a log sent, for the compiled loop.

    Args:
        log: The log.

    Returns:
        The samples. None if a record of the log does not have the exact layout.
    """
    bits = []
    rows = np.full((len(log), 1 + max(part.last_tick for part in log.values())), -1, np.int64)
    count = 0
    for site, part in enumerate(log.values()):
        if part.indexed is None:
            return None
        # A sender in task space sends the motion of its end effector.
        fields = ("x", "xd", "wrench") if part.layout.task else ("q", "qd", "tau_x")
        bits.append(part.indexed.vector_words(fields))
        # Of several records of one tick, the last one counts.
        rows[site, part.tick] = np.arange(count, count + len(part))
        count += len(part)
    widths = {part_words.shape[1] for part_words in bits}
    if len(widths) > 1:
        return None
    sites = {name: site for site, name in enumerate(log)}
    return SampleTable(np.concatenate(bits), rows, sites)


@leaf
def _find_samples(
    counts: IntArray, entries: IntArray, peers: IntArray, rows: IntArray, arrivals: IntArray,
    is_complete: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Looks up the samples that arrived in each tick.

    Args:
        counts: Number of arrivals of each of K records, shape (K,).
        entries: Peer, tick and latency of all N arrivals, shape (N, 3).
        peers: Index of each peer in `rows`.
        rows: Rows of samples, see `SampleTable`.
        arrivals: Receives peer, tick and row of each arrival, shape (N, 3). The row is -1 if
            the log does not contain the sample.
        is_complete: Set to False for records with such arrivals, or with too many of them.
    """
    n = 0
    for k in range(counts.shape[0]):
        if counts[k] > MAX_ARRIVALS:
            is_complete[k] = False
        for _ in range(counts[k]):
            peer = entries[n, 0]
            tick = entries[n, 1]
            row = -1
            if 0 <= peer < peers.shape[0] and 0 <= tick < rows.shape[1]:
                row = rows[peers[peer], tick]
            if row < 0:
                is_complete[k] = False
            arrivals[n, 0] = peer
            arrivals[n, 1] = tick
            arrivals[n, 2] = row
            n += 1


class PlainRows:
    """Reads records of one site in blocks that compiled code can execute again.

    A record is plain if all inputs of its tick are in the log.

    Args:
        part: Records of the site.
        indexed: The same records with the places of their values.
        samples: Samples of all sites.
        resume_every: Records of ticks that are divisible by this number are not plain. 0: none.
    """

    def __init__(
        self,
        part: SiteLog,
        indexed: IndexedRecords,
        samples: SampleTable,
        resume_every: int = 0,
    ) -> None:
        self._part = part
        self._indexed = indexed
        self._samples = samples
        self._resume_every = resume_every
        self._boots = indexed.boots
        # Filled by `_is_complete`: index of the first arrival of each record, shape (K + 1,),
        # and peer, tick, and row in the table of samples of every arrival, shape (N, 3).
        self._first_arrival = np.zeros(0, np.int64)
        self._arrivals = np.zeros((0, 3), np.int64)

    def read_boot(self, row: int) -> int:
        """Returns the number in a record that identifies a start of the site."""
        return int(self._boots[row]) & _MASK_64

    def count_plain(self, row: int, before_tick: int | None) -> int:
        """Counts the records from a row on that one block can execute, at most `BLOCK_ROWS`.

        The first of these records must belong to the present start of the site, and to the
        next tick.

        Args:
            row: Row of the first record.
            before_tick: Tick before which the records end. None for no such tick.
        """
        stops = self._stops
        index = int(np.searchsorted(stops, row))
        is_plain = index == len(stops) or stops[index] > row
        if not is_plain and not self._is_first_of_run(row):
            return 0
        if not is_plain:
            index += 1
        stop = int(stops[index]) if index < len(stops) else len(self._part)
        stop = min(stop, row + BLOCK_ROWS)
        if before_tick is not None:
            stop = min(stop, int(np.searchsorted(self._part.tick, before_tick)))
        return max(0, stop - row)

    def _is_first_of_run(self, row: int) -> bool:
        """True if a record is plain except that it does not follow the record before it."""
        return bool(self._is_complete[row])

    @cached_property
    def _stops(self) -> IntArray:
        """Rows of all records that are not plain, in ascending order."""
        follows = np.zeros(len(self._part), np.bool_)
        ticks = self._part.tick
        follows[1:] = (ticks[1:] == ticks[:-1] + 1) & (self._boots[1:] == self._boots[:-1])
        return np.flatnonzero(~(follows & self._is_complete))

    @cached_property
    def _is_complete(self) -> NDArray[np.bool_]:
        """For each record, whether all inputs of its tick are in the log, shape (K,)."""
        ticks = self._part.tick
        is_complete: NDArray[np.bool_] = self._indexed.change_counts == 0
        is_complete &= self._indexed.ints("t_ns") == ticks * NS_PER_S // self._part.rate_hz
        if self._resume_every:
            is_complete &= ticks % self._resume_every != 0
        counts, entries = self._indexed.arrivals
        self._first_arrival = _sum_before(counts)
        self._arrivals = np.zeros(entries.shape, np.int64)
        peers = [self._samples.sites[peer] for peer in self._part.peers]
        _find_samples(
            counts,
            entries,
            np.array(peers, np.int64),
            self._samples.rows,
            self._arrivals,
            is_complete,
        )
        return is_complete

    @cached_property
    def _memory(self) -> tuple[IntArray, IntArray]:
        """Index of the first number of `mem` of each record, shape (K + 1,), and their bits."""
        counts, bits = self._indexed.memory_words
        return _sum_before(counts), bits

    def read_rows(self, first: int, count: int) -> RecordedRows:
        """Reads plain records in the form that the compiled loop needs.

        Args:
            first: Row of the first record.
            count: Number of records.
        """
        last = first + count
        block = self._indexed.select(slice(first, last))
        layout = self._part.layout
        first_memory, memory = self._memory
        return RecordedRows(
            bits=block.vector_words(list(layout.columns())),
            used=block.used,
            modes=np.ascontiguousarray(block.mode_codes),
            checksums=block.ints("rx_crc"),
            first_memory=first_memory[first : last + 1],
            memory=memory.view(np.float64),
            memory_words=memory,
            first_arrival=self._first_arrival[first : last + 1],
            arrivals=self._arrivals,
            hands=_read_hands(block) if layout.hand else np.zeros((0, 0)),
            plants=np.zeros((0, 0)),
        )

    def repeat(self, repeater: TickRepeater, first: int, count: int, *, external: bool) -> int:
        """Executes the ticks of plain records again.

        Args:
            repeater: Executes the ticks of the site.
            first: Row of the first record.
            count: Number of records.
            external: True if the motion of the arm was measured.

        Returns:
            The number of records before the first one that differs from its execution.
        """
        rows = self.read_rows(first, count)
        if external:
            block = self._indexed.select(slice(first, first + count))
            rows = rows._replace(plants=_read_plants(block))
        return repeater.repeat(int(self._part.tick[first]), rows, self._samples.bits)


def _sum_before(counts: IntArray) -> IntArray:
    """Returns the sum of the entries before each of K entries, and of all, shape (K + 1,)."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])


def _read_hands(block: IndexedRecords) -> Array:
    """Returns grip, target, and target one second later of a live hand, shape (K, 1 + 2 m)."""
    action = block.vectors(["hand"])["hand"]
    coordinates = (action.shape[1] - _FIRST_TARGET) // 2
    target = action[:, _FIRST_TARGET : _FIRST_TARGET + coordinates]
    velocity = action[:, _FIRST_TARGET + coordinates :]
    return np.concatenate([action[:, :1], target, target + velocity], axis=1)


def _read_plants(block: IndexedRecords) -> Array:
    """Returns q, qd and the torque ON the arm as they were measured, shape (K, 3 n)."""
    vectors = block.vectors(["q", "qd", "tau_x"])
    return np.concatenate([vectors["q"], vectors["qd"], -vectors["tau_x"]], axis=1)


def can_repeat(site: Site) -> bool:
    """True if compiled code can execute recorded ticks of a site again."""
    return not site.parts.has_user_law

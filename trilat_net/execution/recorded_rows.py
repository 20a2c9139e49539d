"""Converts the records of a log to arrays, so that compiled code can verify them quickly.

A log is verified by computing each tick again. The compiled loop `TickRepeater` does so for
many consecutive ticks in one call, provided all inputs of these ticks are in the log. `verify`
executes the other ticks one by one.

Invariant:
    - Only records in the exact layout that this program writes are converted.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import MAX_ARRIVALS, Array, IntArray, RecordedRows, TickRepeater, leaf
from ..log import IndexedRecords, Log, SiteLog
from ..records import NS_PER_S

BLOCK_ROWS = 1 << 14
"""Maximum number of records whose ticks are re-executed together."""
LEAST_ROWS = 8
"""Minimum number of records for which the compiled loop is faster than single ticks."""
_FIRST_TARGET = 3
"""First column of the target in the field `hand`, after grip, number and source."""
_MASK_64 = (1 << 64) - 1


class SampleTable(NamedTuple):
    """Samples sent by all sites of a log, for fast look-up by site and tick.

    Attributes:
        bits: Position, velocity and external torque of each sample in the coordinates that the
            sites share, stored as the bit patterns of the floats, shape (N, 3 m).
        rows: Row in `bits` of the sample of each site and tick, shape (sites, ticks). -1 if the
            log has no record of the tick.
        sites: Mapping from site to its index in `rows`.
    """

    bits: IntArray
    rows: IntArray
    sites: Mapping[str, int]

    @classmethod
    def of_log(cls, log: Log) -> "SampleTable | None":
        """Collects the samples that all sites of a log sent, for use by the compiled loop.

        When the loop re-executes a tick, it looks up the content of each sample that arrived.

        Args:
            log: The log.

        Returns:
            The samples. None if a record of the log does not have exactly the layout that this
            program writes, or if the samples of the sites have different lengths.
        """
        bits = []
        last_tick = max(site_log.last_tick for site_log in log.values())
        rows = np.full((len(log), last_tick + 1), -1, np.int64)
        sample_count = 0
        for site, site_log in enumerate(log.values()):
            if site_log.indexed is None:
                return None
            # A sender in task space sends the motion of its end effector.
            fields = ("x", "xd", "wrench") if site_log.layout.task else ("q", "qd", "tau_x")
            bits.append(site_log.indexed.vector_words(fields))
            # Of several records of one tick, the last one counts.
            rows[site, site_log.tick] = np.arange(sample_count, sample_count + len(site_log))
            sample_count += len(site_log)
        widths = {part_words.shape[1] for part_words in bits}
        if len(widths) > 1:
            return None
        sites = {name: site for site, name in enumerate(log)}
        return cls(np.concatenate(bits), rows, sites)


@leaf
def _find_samples(
    counts: IntArray, entries: IntArray, peers: IntArray, rows: IntArray, arrivals: IntArray,
    is_complete: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Determines the ticks for which the log contains the content of all samples received.

    The record of a tick only lists the senders of the samples and the ticks in which they were
    sent.

    Args:
        counts: Number of arrivals of each of K records, shape (K,).
        entries: Peer, tick and latency of all N arrivals, shape (N, 3).
        peers: Index of each peer in `rows`.
        rows: Rows of samples, see `SampleTable`.
        arrivals: Output array for peer, tick and row of each arrival, shape (N, 3). The row is
            -1 if the log does not contain the sample.
        is_complete: Output array. Set to False for records with such arrivals, or with too many
            arrivals.
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
    """Reads the records of one site in blocks whose ticks compiled code can re-execute.

    Only plain records are read. A record is plain if all inputs of its tick are in the log.

    Args:
        site_log: Records of the site.
        indexed: The same records with the positions of their values.
        samples: Samples of all sites.
        resume_every: Interval, in ticks, at which the site is restored from its records. The
            record at such a tick does not count as plain. 0 means never.
    """

    def __init__(
        self,
        site_log: SiteLog,
        indexed: IndexedRecords,
        samples: SampleTable,
        resume_every: int = 0,
    ) -> None:
        """Stores the records of a site. Received samples are looked up on first use."""
        self._site_log = site_log
        self._indexed = indexed
        self._samples = samples
        self._resume_every = resume_every
        self._boots = indexed.boots
        # Filled by `_is_complete`: index of the first arrival of each record, shape (K + 1,),
        # and peer, tick, and row in the table of samples of every arrival, shape (N, 3).
        self._first_arrival = np.zeros(0, np.int64)
        self._arrivals = np.zeros((0, 3), np.int64)

    def read_boot(self, row: int) -> int:
        """Returns the boot number of a record, which identifies a start of the process."""
        return int(self._boots[row]) & _MASK_64

    def count_plain(self, row: int, before_tick: int | None) -> int:
        """Counts the records whose ticks compiled code can execute next in a single block.

        The caller ensures that the first record belongs to the next tick, and was produced
        since the current start of the site's process. A block has at most `BLOCK_ROWS` records.

        Args:
            row: Index of the first record.
            before_tick: Tick before which the records end. If None, there is no such limit.
        """
        # `_stops` has the indices of the records that are not plain. The block ends before the
        # next of these records.
        stops = self._stops
        index = int(np.searchsorted(stops, row))
        is_plain = index == len(stops) or stops[index] > row
        if not is_plain and not self._is_first_of_run(row):
            return 0
        if not is_plain:
            index += 1
        stop = int(stops[index]) if index < len(stops) else len(self._site_log)
        stop = min(stop, row + BLOCK_ROWS)
        if before_tick is not None:
            stop = min(stop, int(np.searchsorted(self._site_log.tick, before_tick)))
        return max(0, stop - row)

    def _is_first_of_run(self, row: int) -> bool:
        """Returns True if a record is complete but does not follow the previous record.

        Compiled code can execute a series of recorded ticks that begins with such a record.
        """
        return bool(self._is_complete[row])

    @cached_property
    def _stops(self) -> IntArray:
        """Indices of all records before which compiled code must stop, in ascending order.

        Such a record lacks an input of its tick, or does not follow the previous record. Slower
        code then takes over.
        """
        follows = np.zeros(len(self._site_log), np.bool_)
        ticks = self._site_log.tick
        follows[1:] = (ticks[1:] == ticks[:-1] + 1) & (self._boots[1:] == self._boots[:-1])
        return np.flatnonzero(~(follows & self._is_complete))

    @cached_property
    def _is_complete(self) -> NDArray[np.bool_]:
        """For each record, True if all inputs of its tick are in the log, shape (K,)."""
        ticks = self._site_log.tick
        nominal_times_ns = ticks * NS_PER_S // self._site_log.rate_hz
        # The compiled loop applies no changes of settings, and computes the nominal times.
        is_complete: NDArray[np.bool_] = self._indexed.change_counts == 0
        is_complete &= self._indexed.ints("t_ns") == nominal_times_ns
        if self._resume_every:
            is_complete &= ticks % self._resume_every != 0

        counts, entries = self._indexed.arrivals
        self._first_arrival = _sum_before(counts)
        self._arrivals = np.zeros(entries.shape, np.int64)
        peers = [self._samples.sites[peer] for peer in self._site_log.peers]
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
        """Internal states of the control law and its site in all records (their field `mem`).

        The first array contains the index of each record's first element in the second array,
        followed by the total length, shape (K + 1,). The second array contains the bit patterns
        of the elements.
        """
        counts, bits = self._indexed.memory_words
        return _sum_before(counts), bits

    def read_rows(self, first: int, count: int) -> RecordedRows:
        """Reads consecutive records as arrays, so that compiled code can execute their ticks.

        Args:
            first: Index of the first record.
            count: Number of records, all of which must be plain (see `PlainRows`).
        """
        last = first + count
        block = self._indexed.select(slice(first, last))
        layout = self._site_log.layout
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
        """Re-executes the ticks of records in compiled code, to verify them.

        Args:
            repeater: Executes the ticks of the site.
            first: Index of the first record.
            count: Number of records, all of which must be plain (see `PlainRows`).
            external: True if the motion of the arm was measured, as with a real robot.

        Returns:
            The number of records before the first one that differs from its re-execution.
        """
        rows = self.read_rows(first, count)
        if external:
            block = self._indexed.select(slice(first, first + count))
            rows = rows._replace(plants=_read_plants(block))
        return repeater.repeat(int(self._site_log.tick[first]), rows, self._samples.bits)


def _sum_before(counts: IntArray) -> IntArray:
    """Returns where each of K lists begins if all lists are concatenated.

    For the lengths [2, 0, 3], the result is [0, 2, 2, 5]. The last entry is the total length.
    """
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])


def _read_hands(block: IndexedRecords) -> Array:
    """Returns the actions of a live operator (a person or program that moved the arm).

    For m target coordinates, the shape is (K, 1 + 2 m): firmness of the grip, target, and the
    position that the target would reach after one second.
    """
    action = block.vectors(["hand"])["hand"]
    coordinates = (action.shape[1] - _FIRST_TARGET) // 2
    target = action[:, _FIRST_TARGET : _FIRST_TARGET + coordinates]
    velocity = action[:, _FIRST_TARGET + coordinates :]
    return np.concatenate([action[:, :1], target, target + velocity], axis=1)


def _read_plants(block: IndexedRecords) -> Array:
    """Returns the measurements of an external arm, such as a real robot, shape (K, 3 n).

    For n joints, they are the joint angles q in rad, the velocities qd in rad/s, and the
    external torque ON the arm in N m.
    """
    vectors = block.vectors(["q", "qd", "tau_x"])
    return np.concatenate([vectors["q"], vectors["qd"], -vectors["tau_x"]], axis=1)

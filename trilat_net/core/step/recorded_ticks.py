"""Verifies many recorded control periods of an arm in one compiled loop.

A log contains a record of each tick, with its inputs (such as the states received from other
arms) and its results. The loop recomputes the ticks from their inputs and compares the results.
It is equivalent to repeated calls of `Site.step`, but faster.

Invariant:
    - The loop calls the stages of the kernel, as `Site.step` does. It contains no equations of
      its own.
    - A record counts as reproduced only if every computed value is bit-identical.
    - The loop stops before the first tick that it cannot execute or does not reproduce. The
      site is then in the state before that tick, and `Site.step` can execute it.
"""

import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..links.link import AHEAD_LIMIT_NS, span_ticks
from .jit import leaf, loop_leaf
from .kernel import act_stages, sense_stages, torque_stage
from .row_fields import SiteRow
from .site_arrays import SiteArrays, TickBuffers
from .site_step import Site
from .ticks import Mode, tick_ns
from .vectors import Array, IntArray

_RUN = int(Mode.RUN)
_DIVERGED = int(Mode.DIVERGED)
_WORD_BYTES = 8
_BYTE_VALUES = 256
_ALL_BITS = 0xFFFFFFFF


def _list_checksums() -> NDArray[np.uint32]:
    """Returns lookup tables for updating a CRC-32 checksum eight bytes at a time.

    CRC-32 is linear in the bits of the message, except for a constant. The effect of a byte
    therefore depends only on its value and on the number of bytes that follow. The tables
    assume that the following bytes are zero.

    Returns:
        The effect of a byte, indexed by the number of following bytes and the value of the
        byte, shape (8, 256).
    """
    table = np.zeros((_WORD_BYTES, _BYTE_VALUES), np.uint32)
    for following in range(_WORD_BYTES):
        zeros = bytes(following)
        constant = zlib.crc32(b"\0" + zeros)
        for value in range(_BYTE_VALUES):
            message = bytes([value]) + zeros
            table[following, value] = zlib.crc32(message) ^ constant
    return table


_CHECKSUMS = _list_checksums()


@leaf
def _update_checksum(crc: int, word: int) -> int:
    """Returns a CRC-32 checksum after eight more bytes of data.

    The final bit inversion of CRC-32 is left to the caller.

    Args:
        crc: Checksum of the preceding data.
        word: The eight bytes as a little-endian integer.
    """
    bits = crc ^ word
    result = 0
    for n in range(_WORD_BYTES):
        byte = (bits >> (8 * n)) & 0xFF
        following_bytes = _WORD_BYTES - 1 - n
        result ^= int(_CHECKSUMS[following_bytes, byte])
    return result


class RecordedRows(NamedTuple):
    """Results of consecutive control periods of an arm from a log, as arrays for compiled code.

    There are K ticks, P peers, m coordinates shared between arms, and n joints. A word is a
    64-bit integer with the same bits as a floating-point value.

    Attributes:
        bits: Values of the records as words, see `Layout.columns`, shape (K, floats).
        used: Tick of the sample in use from each peer, shape (K, P).
        modes: Mode, shape (K,), see `Mode`.
        checksums: CRC-32 of the arrivals, shape (K,).
        first_memory: Index of the first entry in `memory` of each record, shape (K + 1,).
        memory: Contents of the field `mem` of all records.
        memory_words: The same contents as words.
        first_arrival: Index of the first arrival of each record, shape (K + 1,).
        arrivals: Peer, tick, and row in the table of samples for each of N arrivals, shape (N,
            3).
        hands: Grip and target of a live operator, and the target extrapolated by one second,
            shape (K, 1 + 2 m). Shape (0, 0) if the site has no live operator.
        plants: q, qd and the torque ON an external arm, shape (K, 3 n). Shape (0, 0) if the arm
            is not external.
    """

    bits: IntArray
    used: IntArray
    modes: IntArray
    checksums: IntArray
    first_memory: IntArray
    memory: Array
    memory_words: IntArray
    first_arrival: IntArray
    arrivals: IntArray
    hands: Array
    plants: Array


class _SiteViews(NamedTuple):
    """State of a site viewed as 64-bit integers, to compare it bit by bit with a log.

    Comparing floating-point values would not work: 0.0 equals -0.0 although their bits differ,
    and NaN is not equal to itself. A word is a 64-bit integer with the same bits as a value.

    Attributes:
        site: State of the site, as words.
        links: State of each link, one row per peer, concatenated, as words.
        arrivals: Arrivals of a tick, shape (MAX_ARRIVALS, 2 + 2 m): peer, tick, q and qd.
        forces: External torques of the arrivals, shape (MAX_ARRIVALS, m), as words.
        record: Results of a tick, shape (floats,), as words.
        memory: Where each entry of the field `mem` comes from, shape (M, 3): 1 for the links or
            0 for the site, index in the row, and 1 for an integer that is converted to a float.
        rooms: For each peer, the newest sample known to fit into the calendar, and the largest
            number of ticks that a sample waits, shape (P, 2).
    """

    site: IntArray
    links: IntArray
    arrivals: IntArray
    forces: IntArray
    record: IntArray
    memory: IntArray
    rooms: IntArray


class _TickRules(NamedTuple):
    """Properties of a site that stay the same during a run, for the compiled replay.

    Attributes:
        rate_hz: Tick rate, Hz.
        shared: Number m of coordinates shared between sites.
        reflects: True if the checksum of the arrivals covers the external torques.
        keeps_forces: True if the site stores the external torques of its peers.
        remembers: True if the field `mem` of every record is non-empty.
        hand: Index of the live hand among the operators and environments, or -1.
        most_pages: Largest number of entries per calendar.
        most_ahead: Largest number of ticks by which a sample may be ahead of the current tick.
    """

    rate_hz: int
    shared: int
    reflects: bool
    keeps_forces: bool
    remembers: bool
    hand: int
    most_pages: int
    most_ahead: int


@leaf
def _has_room(
    k: int,
    first: int,
    last: int,
    arrivals: IntArray,
    links: Any,
    pages: int,
    rules: Any,
    rooms: IntArray,
) -> bool:
    """Returns True if the messages that arrived in a control period fit into their buffers.

    Each link has a ring buffer in which messages wait for their simulated delay to pass, with
    one entry (page) per control period. Compiled code cannot enlarge these buffers. If a
    message does not fit, the compiled loop stops, and `Site.step` computes the tick. The
    criterion is the same as in `CalendarSizer.make_room`.

    Args:
        k: Current tick.
        first: Index of the first arrival of the tick.
        last: Index after its last arrival.
        arrivals: Peer and tick of each arrival, see `RecordedRows.arrivals`.
        links: State of each link, one row per peer.
        pages: Number of pages per calendar.
        rules: Properties of the site, a `_TickRules`.
        rooms: See `_SiteViews.rooms`; updated in place.
    """
    for n in range(first, last):
        peer = arrivals[n, 0]
        tick = arrivals[n, 1]
        if tick <= rooms[peer, 0]:
            continue
        peer_hz = links[peer].rate_hz
        ahead = tick * rules.rate_hz // peer_hz - k
        if ahead > rules.most_ahead:
            continue  # the sample will be rejected
        if ahead + rooms[peer, 1] > pages and pages < rules.most_pages:
            return False
        rooms[peer, 0] = (k + pages - rooms[peer, 1]) * peer_hz // rules.rate_hz
    return True


@leaf
def _put_arrivals(
    first: int, last: int, arrivals: IntArray, samples: IntArray, rules: Any, views: Any
) -> int:
    """Writes the messages that arrived in a control period to the input buffers.

    Their checksum is computed at the same time, to be compared with the log.

    Args:
        first: Index of the first arrival of the tick.
        last: Index after its last arrival.
        arrivals: Peer, tick and sample of each arrival, see `RecordedRows.arrivals`.
        samples: Table of the samples, as words.
        rules: Properties of the site, a `_TickRules`.
        views: Memory of the site, a `_SiteViews`, whose arrivals are written.

    Returns:
        The CRC-32 of the arrivals, which must equal the checksum in the record.
    """
    # A row of `samples` contains positions, velocities and forces, with `shared` values each.
    shared = rules.shared
    first_force = 2 * shared
    crc = _ALL_BITS
    for n in range(first, last):
        buffer_row = n - first
        sample_row = arrivals[n, 2]
        views.arrivals[buffer_row, 0] = arrivals[n, 0]
        views.arrivals[buffer_row, 1] = arrivals[n, 1]
        for i in range(2 * shared):
            views.arrivals[buffer_row, 2 + i] = samples[sample_row, i]
        for i in range(2 + 2 * shared):
            crc = _update_checksum(crc, views.arrivals[buffer_row, i])
        if rules.keeps_forces:
            for i in range(shared):
                views.forces[buffer_row, i] = samples[sample_row, first_force + i]

    # `Site.step` computes the checksum of all forces after that of all motions.
    if rules.reflects:
        for n in range(first, last):
            sample_row = arrivals[n, 2]
            for i in range(shared):
                crc = _update_checksum(crc, samples[sample_row, first_force + i])
    return crc ^ _ALL_BITS


@leaf
def _put_inputs(row: int, arrays: SiteArrays, rows: Any, rules: Any) -> None:
    """Writes the recorded inputs of a control period that did not come from other arms.

    These are the action of a person or program that moved the arm (live hand), and the measured
    motion of a real arm. Most arms have neither.

    Args:
        row: Index of the record.
        arrays: Arrays of the site; updated in place.
        rows: The records, a `RecordedRows`.
        rules: Properties of the site, a `_TickRules`.
    """
    if rules.hand >= 0:
        hand = arrays.actors[rules.hand]
        coordinates = (rows.hands.shape[1] - 1) // 2
        hand.grip = rows.hands[row, 0]
        for i in range(coordinates):
            hand.a[i] = rows.hands[row, 1 + i]
            hand.b[i] = rows.hands[row, 1 + coordinates + i]
    if rows.plants.shape[0] > 0:
        s: SiteRow = arrays.site[0]
        n = s.joints
        for i in range(n):
            s.q[i] = rows.plants[row, i]
            s.qd[i] = rows.plants[row, n + i]
            s.sensed[i] = rows.plants[row, 2 * n + i]


@leaf
def _equals_record(
    row: int, crc: int, arrays: SiteArrays, rows: Any, rules: Any, views: Any
) -> bool:
    """Returns True if the results of a tick are bit-identical to its record.

    The comparison covers the mode, the checksum of the samples that arrived, the tick of the
    sample in use from each peer, all computed values, and the values kept for the next tick.

    Args:
        row: Index of the record.
        crc: CRC-32 of the arrivals of the tick.
        arrays: Arrays of the site after the tick.
        rows: The records, a `RecordedRows`.
        rules: Properties of the site, a `_TickRules`.
        views: The same memory of the site as words, a `_SiteViews`.
    """
    s: SiteRow = arrays.site[0]
    # Any different bit makes `difference` nonzero; a single test at the end is fast.
    difference = rows.modes[row] ^ s.mode
    difference |= rows.checksums[row] ^ crc
    for p in range(arrays.links.shape[0]):
        difference |= rows.used[row, p] ^ arrays.links[p].used
    for i in range(views.record.shape[0]):
        difference |= rows.bits[row, i] ^ views.record[i]
    if difference != 0:
        return False

    first = rows.first_memory[row]
    count = rows.first_memory[row + 1] - first
    if not rules.remembers and (s.mode == _RUN or s.mode == _DIVERGED):
        return bool(count == 0)
    if count != views.memory.shape[0]:
        return False
    for i in range(count):
        is_of_link = views.memory[i, 0]
        index = views.memory[i, 1]
        is_integer = views.memory[i, 2]
        computed_bits = views.links[index] if is_of_link else views.site[index]
        if is_integer:
            # The record stores the integer as a float, which is never -0.0.
            logged = rows.memory[first + i]
            is_negative_zero = computed_bits == 0 and 1.0 / logged < 0.0
            if logged != float(computed_bits) or is_negative_zero:
                return False
        elif rows.memory_words[first + i] != computed_bits:
            return False
    return True


def _run_recorded_ticks(
    first_tick: int,
    rows: RecordedRows,
    samples: IntArray,
    rules: _TickRules,
    views: _SiteViews,
    arrays: SiteArrays,
    buffers: TickBuffers,
) -> tuple[int, bool]:
    """Recomputes recorded ticks until a result differs from the log.

    Computing all of them in one compiled call is far faster than one call per tick.

    Args:
        first_tick: First tick to compute.
        rows: Records of the ticks.
        samples: Table of the samples that arrived, shape (N, 3 m). The columns are q, qd and
            tau_x, each as the bits of a floating-point value.
        rules: Properties of the site.
        views: State of the site as integers.
        arrays: Arrays of the site; updated in place.
        buffers: Input and output of a tick; updated in place.

    Returns:
        The number of ticks that were reproduced exactly, and whether the next tick was computed
        but differs. The latter is False if the next tick was not computed, because its samples
        do not fit into the buffers or because there are no more ticks.
    """
    for row in range(rows.modes.shape[0]):
        k = first_tick + row
        t_ns = tick_ns(k, rules.rate_hz)
        first = rows.first_arrival[row]
        last = rows.first_arrival[row + 1]
        pages = arrays.calendars.shape[1]
        has_room = _has_room(
            k, first, last, rows.arrivals, arrays.links, pages, rules, views.rooms
        )
        if not has_room:
            return row, False
        crc = _put_arrivals(first, last, rows.arrivals, samples, rules, views)
        _put_inputs(row, arrays, rows, rules)
        sense_stages(k=k, t_ns=t_ns, count=last - first, arrays=arrays, buffers=buffers)
        torque_stage(arrays.site, arrays.chain)
        act_stages(
            k=k,
            t_ns=t_ns,
            site=arrays.site,
            actors=arrays.actors,
            table=arrays.table,
            chain=arrays.chain,
            record=buffers.record,
        )
        if not _equals_record(row, crc, arrays, rows, rules, views):
            return row, True
    return rows.modes.shape[0], False


_run_planar_ticks = loop_leaf(_run_recorded_ticks)
# The dynamics of a chain are long, and inlining them at every call takes long to compile.
_run_chain_ticks = leaf(_run_recorded_ticks)


class TickRepeater:
    """Recomputes recorded control periods of an arm, many per compiled call.

    Each result is compared with the log, to verify that the run can be reproduced.

    Args:
        site: The site, which must use a built-in control law.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._parts = parts = site.parts  # the parts that a compiled loop can use
        arrays = site.arrays
        buffers = parts.buffers
        self._rules = _TickRules(
            rate_hz=site.rate_hz,
            shared=site.layout.shared,
            reflects=parts.reflects,
            keeps_forces=parts.keeps_forces,
            remembers=parts.glides,
            hand=parts.hand_index,
            most_pages=parts.calendar_sizer.most_pages,
            most_ahead=span_ticks(AHEAD_LIMIT_NS, site.rate_hz),
        )
        self._views = _SiteViews(
            site=_view_words(arrays.site).reshape(-1),
            links=_view_words(arrays.links).reshape(-1),
            arrivals=_view_words(buffers.arrivals),
            forces=_view_words(buffers.forces),
            record=_view_words(buffers.record),
            memory=_list_memory_sources(site),
            rooms=np.zeros((len(site.peers), 2), np.int64),
        )
        self._saved = [np.empty_like(array) for array in self._list_arrays()]

    def repeat(self, first_tick: int, rows: RecordedRows, samples: IntArray) -> int:
        """Recomputes recorded ticks until a result differs from the log.

        Args:
            first_tick: First tick, which must be the next tick of the site.
            rows: Records of consecutive ticks.
            samples: Table of the samples that arrived, shape (N, 3 m). The columns are q, qd
                and tau_x, each as the bits of a floating-point value.

        Returns:
            The number of ticks that were reproduced exactly. The site is left in the state that
            follows the last of these ticks.
        """
        # Save the state, because a tick that differs has changed it.
        arrays = self._list_arrays()
        newest = list(self._parts.calendar_sizer.newest)
        shapes = [array.shape for array in arrays]
        saved_shapes = [saved.shape for saved in self._saved]
        if shapes != saved_shapes:
            self._saved = [np.empty_like(array) for array in arrays]
        for saved, array in zip(self._saved, arrays, strict=True):
            saved[...] = array

        repeated, has_differed = self._run(first_tick, rows, samples)
        if has_differed:
            # Restore the state, and compute only the ticks before the tick that differs.
            for saved, array in zip(self._saved, arrays, strict=True):
                array[...] = saved
            self._parts.calendar_sizer.newest[:] = newest
            equal_rows = rows._replace(modes=rows.modes[:repeated])
            repeated_again, _ = self._run(first_tick, equal_rows, samples)
            assert repeated_again == repeated
        return repeated

    def _list_arrays(self) -> list[NDArray[Any]]:
        """Returns the arrays of the site that a control period modifies.

        They are saved before a period, and restored if it has to be computed again.
        """
        a = self._site.arrays
        changed = [a.site, a.links, a.dues, a.calendars, a.ramps, a.actors, a.chain]
        return [array for array in changed if array is not None]

    def _run(self, first_tick: int, rows: RecordedRows, samples: IntArray) -> tuple[int, bool]:
        """Calls the version of the compiled loop over recorded ticks for this type of arm.

        The loop and `CalendarSizer`, which enlarges the buffers of waiting messages, share
        their knowledge of which messages fit.
        """
        site = self._site
        self._views.rooms[:] = self._parts.calendar_sizer.list_rooms()
        run_recorded_ticks = _run_planar_ticks
        if site.arrays.chain is not None:
            run_recorded_ticks = _run_chain_ticks
        result = run_recorded_ticks(
            first_tick=first_tick,
            rows=rows,
            samples=samples,
            rules=self._rules,
            views=self._views,
            arrays=site.arrays,
            buffers=self._parts.buffers,
        )
        self._parts.calendar_sizer.newest[:] = self._views.rooms[:, 0].tolist()
        return result


def _view_words(array: NDArray[Any]) -> IntArray:
    """Views an array as 64-bit integers, to compare floats bit by bit.

    As floats, 0.0 and -0.0 would compare equal. Nothing is copied, so changing the array
    changes the result.

    Args:
        array: Array with 8-byte elements, or a structured array with 8-byte fields.

    Returns:
        The integers. A structured array becomes a matrix with one row per element.
    """
    if not array.size:
        return np.zeros(array.shape[:2], np.int64)
    bits = array.view(np.int64)
    assert np.shares_memory(bits, array)
    is_structured = array.dtype.fields is not None
    return bits.reshape(len(array), -1) if is_structured else bits


def _list_memory_sources(site: Site) -> IntArray:
    """Finds where a site stores the values that the next control period needs.

    A record contains them in its field `mem`, unless another field has them. They are listed in
    the order of `Site.restore_state`. The three columns of the result are described in
    `_SiteViews.memory`.
    """
    sources: list[tuple[int, int, int]] = []
    parts = site.parts
    site_type = site.arrays.site.dtype
    link_type = site.arrays.links.dtype

    def add(dtype: np.dtype[Any], field: str, row: int = 0) -> None:
        """Appends the positions of all elements of one field, counted in 8-byte words.

        Args:
            dtype: Type of the row (of the site or of a link).
            field: Name of the field.
            row: Index of the row.
        """
        assert dtype.fields is not None
        field_type, offset_bytes = dtype.fields[field][:2]
        first_word = (row * dtype.itemsize + offset_bytes) // _WORD_BYTES
        word_count = field_type.itemsize // _WORD_BYTES
        is_of_link = int(dtype is link_type)
        is_integer = int(field_type.base.kind == "i")
        words = range(first_word, first_word + word_count)
        sources.extend((is_of_link, word, is_integer) for word in words)

    add(site_type, "q_held")
    add(site_type, "return_from_ns")
    if parts.glides:
        add(site_type, "qd_held")
        add(site_type, "reason")
        for p in range(len(site.peers)):
            add(link_type, "used_ns", p)
        add(site_type, "tau_held")
        if site.layout.task:
            add(site_type, "q_rest")
            add(site_type, "qd_rest")
        if parts.degrades:
            for p in range(len(site.peers)):
                add(link_type, "gone", p)
    return np.array(sources, np.int64).reshape(-1, 3)

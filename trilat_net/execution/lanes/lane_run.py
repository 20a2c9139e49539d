"""Simulates up to `LANES` runs together, each in one lane of the vector registers.

`LaneRun` takes runs with equal structure, for example the points of a sweep over a gain, and
advances them to a time. It is the counterpart of `FusedRun`, which simulates one run.

Invariant:
    - After `advance_to`, each run has the numbers that `FusedRun.advance_to` would give it, bit
      for bit. Only intermediate results of a tick ("scratch" in `row_fields`), and entries of
      ring buffers that are not used any more, may differ.
    - The arrays of the lanes do not overlap in memory, as `advance_site` requires.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numba.core import types
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from ...core import (
    BUCKETS_PER_S,
    NEVER_NS,
    Array,
    IntArray,
    SiteArrays,
    find_lane_address,
    is_lane_code_stored,
    leaf,
    read_lane_assembly,
    tick_ns,
)
from ...records import NS_PER_S, Mode
from ..fused import FusedRun, RunMemory
from .chain_lane_stages import advance_chain_site
from .lane_deliveries import (
    BLOCK_TICKS,
    copy_link_states,
    find_draw_addresses,
    keep_link_states,
    repeat_deliveries,
    use_samples,
)
from .lane_laws import LawCode
from .lane_rows import LANES, LaneTable, Words, allocate_words, read_words
from .lane_stages import STAGES_DTYPE, EndedRuns, advance_site, run_block
from .lane_structure import RunStructure, SiteStructure, find_structure

_FIRST_PAGES = 256
"""Number of ticks whose states are kept at first, a power of two."""
_REFERENCE_FIELDS = ("alpha", "alpha_rate", "gone")
"""Fields of a link's row that stage 3 of a tick writes."""
_STATE_FIELDS = ("q", "qd", "tau_x")
"""Fields of a link's row that contain the sample in use."""


class SiteTables(NamedTuple):
    """Arrays with the state of one site in all lanes, as `advance_site` takes them.

    Attributes:
        site: Row of the site.
        links: Rows of its links.
        actors: Rows of its operators and environments.
        environments: The rows of its environments.
        ramps: Row with the changes of its dominance factors.
        record: Row with the floats of its record.
        peaks: Peaks, one row per bucket.
        sums: Row of its sums.
        progress: Row of its progress.
        scratch: Row with room for the stages of the integrator.
        law: Row with the numbers of its compiled law.
        received: Rows with the numbers that the peers' laws sent.
        sent: Row with the numbers that its law sends.
        code: Stands for the code of the law. The table itself is not used.
        chain: Rows of the joints, if the arm is a chain.
    """

    site: Any
    links: Any
    actors: Any
    environments: Any
    ramps: Any
    record: Any
    peaks: Any
    sums: Any
    progress: Any
    scratch: Any
    law: Any
    received: Any
    sent: Any
    code: Any
    chain: Any


class LaneLayout(NamedTuple):
    """Data types and lengths of the arrays of a run, on which its code depends.

    Attributes:
        site: Of the row of a site.
        link: Of the row of a link.
        actor: Of the row of an operator or environment.
        sums: Of the sums of a site.
        progress: Of the progress of a site.
        floats: Number of floats in a record.
        columns: Number of columns of the peaks.
        ramps: Shape of the table of dominance factors.
        chain: Of the row of a joint. None for planar arms.
        joints: Number of joints that sites share.
        law: Largest count of numbers of a compiled law.
        received: Largest count of numbers that a law receives from a peer.
        sent: Largest count of numbers that a law sends.
    """

    site: np.dtype[Any]
    link: np.dtype[Any]
    actor: np.dtype[Any]
    sums: np.dtype[Any]
    progress: np.dtype[Any]
    floats: int
    columns: int
    ramps: tuple[int, ...]
    chain: np.dtype[Any] | None
    joints: int
    law: int
    received: int
    sent: int


def find_layout(run: FusedRun) -> LaneLayout:
    """Returns the data types and lengths of all arrays of a run, on which its code depends."""
    memory = run.memory
    tables = memory.tables
    return LaneLayout(
        site=tables.site.dtype,
        link=tables.links.dtype,
        actor=tables.actors.dtype,
        sums=memory.sums.dtype,
        progress=memory.progress.dtype,
        floats=memory.sent.rows.shape[2],
        columns=memory.peaks.shape[2],
        ramps=tables.ramps.shape[1:],
        chain=None if tables.chain is None else tables.chain.dtype,
        joints=tables.links["q"].shape[2],
        law=0 if memory.laws is None else memory.laws.rows.shape[1],
        received=0 if tables.channel is None else tables.channel.received.shape[2],
        sent=0 if memory.laws is None else memory.laws.sent.shape[1],
    )


def list_argument_types(
    layout: LaneLayout,
    structure: RunStructure,
    site: SiteStructure,
    clock: types.Type = types.int64,
) -> tuple[Any, ...]:
    """Returns Numba's types of the arguments with which the tick of a site is compiled.

    Args:
        layout: Layouts of the tables.
        structure: Structure of the run.
        site: Structure of the site.
        clock: Type of the tick and of its nominal time: an integer if they are equal in all
            lanes, else `LaneNumbers`.
    """
    first = site.first_environment
    actors = site.actors
    chain = _type_numbers(0, 1)
    if layout.chain is not None:
        # The actors of a chain are selected by the variable of a loop.
        actors = ((),) * len(actors)
        chain = LaneTable(layout.chain, ((("prismatic", 0),),) * layout.joints)
    environments = actors[first:] if first >= 0 else ()
    tables = SiteTables(
        site=LaneTable(layout.site, (site.constants,)),
        links=LaneTable(layout.link, ((),) * structure.peers),
        actors=LaneTable(layout.actor, actors),
        environments=LaneTable(layout.actor, environments),
        ramps=LaneTable(np.dtype([("rows", "f8", layout.ramps)])),
        record=LaneTable(np.dtype([("floats", "f8", (layout.floats,))])),
        peaks=LaneTable(np.dtype([("joints", "f8", (layout.columns,))])),
        sums=LaneTable(layout.sums, ((("first_environment", first),),)),
        progress=LaneTable(layout.progress),
        scratch=LaneTable(STAGES_DTYPE),
        law=_type_numbers(layout.law, 1),
        received=_type_numbers(layout.received, structure.peers),
        sent=_type_numbers(layout.sent, 1),
        code=LawCode(site.law),
        chain=chain,
    )
    integer = types.int64
    numbers = (clock, clock, integer, types.float64, *(integer,) * 5)
    states = types.Array(types.float64, 4, "C")
    used = types.Array(types.int64, 3, "C")
    columns = types.Array(types.int64, 2, "C")
    table = types.Array(types.float64, 2, "C")
    return (*numbers, *tables, states, used, columns, table)


def _type_numbers(count: int, rows: int) -> LaneTable:
    """Returns Numba's type of a table whose rows contain one vector, `numbers`.

    Args:
        count: Count of numbers.
        rows: Number of rows.
    """
    return LaneTable(np.dtype([("numbers", "f8", (count,))]), ((),) * rows)


def choose_code(layout: LaneLayout) -> Callable[..., None]:
    """Returns the function that computes a tick in lanes, for planar arms or for chains."""
    return advance_site if layout.chain is None else advance_chain_site


def _find_addresses(run: FusedRun, structure: RunStructure, clock: types.Type) -> IntArray:
    """Returns the addresses of the code for a tick of each site, and compiles it if needed.

    Args:
        run: The run.
        structure: Its structure.
        clock: Type of the ticks, see `list_argument_types`.

    Raises:
        NumbaError: A law of a user cannot be compiled in lanes.
    """
    layout = find_layout(run)
    addresses = []
    for site in structure.sites:
        arguments = list_argument_types(layout, structure, site, clock)
        addresses.append(find_lane_address(choose_code(layout), arguments))
    return np.array(addresses)


def explain_uncompilable(run: FusedRun, clock: types.Type = types.int64) -> str:
    """Returns why a control law cannot be compiled for several runs at once, for a message.

    Such a law may still be compiled for a single run. To find out, this function compiles the
    code.

    The code is compiled for this answer.

    Args:
        run: The run before its first tick. There must be no obstacle, see `find_obstacle`.
        clock: Type of the ticks, see `list_argument_types`.

    Returns:
        The reason. Empty if there is none.
    """
    try:
        _find_addresses(run, find_structure(run), clock)
    except NumbaError:
        return "control laws that cannot be compiled side by side"
    return ""


def read_assembly(run: FusedRun, i: int) -> str:
    """Returns the machine code of the ticks of a site as text, in which tests look for vectors.

    Args:
        run: The run.
        i: Index of the site.
    """
    structure = find_structure(run)
    layout = find_layout(run)
    arguments = list_argument_types(layout, structure, structure.sites[i])
    return read_lane_assembly(choose_code(layout), arguments)


@leaf
def _copy_records(first: int, kept: Array, records: Array) -> None:
    """Copies records from the lanes to arrays of each run.

    Args:
        first: First tick.
        kept: Latest records of all sites, shape (N, rows, floats, LANES). The record of tick k
            is in row k modulo the number of rows.
        records: Written, shape (runs, N, ticks, floats).
    """
    # The numbers of all lanes in a record lie in few cache lines.
    for i in range(records.shape[1]):
        for tick in range(records.shape[2]):
            row = (first + tick) & (kept.shape[1] - 1)
            for lane in range(records.shape[0]):
                for column in range(records.shape[3]):
                    records[lane, i, tick, column] = kept[i, row, column, lane]


def has_lane_code(run: FusedRun) -> bool:
    """Returns True if the code for these runs has been compiled and stored before.

    The runs can then start at once.

    Args:
        run: The run. There must be no obstacle, see `find_obstacle`.
    """
    structure = find_structure(run)
    layout = find_layout(run)
    return all(
        is_lane_code_stored(choose_code(layout), list_argument_types(layout, structure, site))
        for site in structure.sites
    )


class _LinksOfRun:
    """Brings the network links of a run up to date, but only if the run needs them.

    Args:
        run: The run before its first tick.
    """

    def __init__(self, run: FusedRun) -> None:
        self._run = run
        self._ticks = 0

    def set_pending(
        self, ticks: int, links: NDArray[Any], states: Array, received: Array
    ) -> None:
        """Notes that the run has advanced, and with which results.

        Args:
            ticks: Number of ticks that the run has made.
            links: Rows of its links after these ticks. Only fields of the sample in use, and
                fields that stage 3 of a tick writes, are up to date.
            states: The latest states of its sites, see `repeat_deliveries`.
            received: Numbers of laws that came with the samples in use, shape (N P, C).
        """
        self._run.pending_deliveries = partial(self._update, ticks, links, states, received)

    def _update(self, ticks: int, links: NDArray[Any], states: Array, received: Array) -> None:
        """Computes the state of the links up to the tick that `set_pending` noted."""
        memory = self._run.memory
        tables = memory.tables
        repeat_deliveries(
            first=self._ticks,
            end=ticks,
            rate_hz=int(tables.site["rate_hz"][0, 0]),
            links=tables.links,
            models=tables.models,
            dues=tables.dues,
            calendars=tables.calendars,
            points=tables.points,
            channel=tables.channel,
            joints=tables.links["q"].shape[2],
            states=states,
        )
        self._ticks = ticks
        memory.next_samples[:] = max(ticks - 1, 0)
        for name in (*_REFERENCE_FIELDS, *_STATE_FIELDS):
            tables.links[name] = links.reshape(tables.links.shape)[name]
        if tables.channel is not None:
            tables.channel.received[:] = received.reshape(tables.channel.received.shape)


class LaneRun:
    """Simulates several runs of equal structure together with vector instructions.

    Args:
        runs: The runs before their first tick, at most `LANES`. They must have the same
            structure, see `find_structure`, and no obstacle, see `find_obstacle`.
        record_rows: Number of latest records of each site that are kept, a power of two.

    Attributes:
        runs: The runs that are in the lanes. `advance_to` writes the results into them.
        clock: Type of the ticks, see `list_argument_types`.
    """

    clock: types.Type = types.int64

    def __init__(self, runs: Sequence[FusedRun], record_rows: int = 1) -> None:
        assert 0 < len(runs) <= LANES
        structure = find_structure(runs[0])
        assert all(find_structure(run) == structure for run in runs)
        assert all(run.ran_s == 0.0 for run in runs)
        self.runs = list(runs)
        self._structure = structure
        self._layout = layout = find_layout(runs[0])
        memories = [run.memory for run in runs]
        tables = [memory.tables for memory in memories]
        first = tables[0]
        self._sites = len(structure.sites)
        self._rate_hz = int(first.site["rate_hz"][0, 0])
        self._table = first.table
        self._ticks = 0
        self._deliveries = copy_link_states(tables)
        self._draws = find_draw_addresses()
        self._links_of_runs = [_LinksOfRun(run) for run in runs]

        self._pages = _FIRST_PAGES
        # A state occupies whole cache lines, because each lane needs that of another tick.
        width = -(-(3 * layout.joints + layout.sent) // 8) * 8
        self._states = np.zeros((self._sites, self._pages + 1, LANES, width))
        self._scratch = allocate_words(1, STAGES_DTYPE.itemsize // 8)
        self._used = np.zeros((self._sites, structure.peers, LANES, BLOCK_TICKS), np.int64)
        # The samples in use of the kept records, a ring buffer: shape (N, P, LANES, rows).
        self._used_records = np.zeros((*self._used.shape[:3], 0), np.int64)
        self._peaks = np.zeros((self._sites, 0, layout.columns, LANES), np.int64)

        def pack(tables_of_runs: Sequence[NDArray[Any]]) -> Words:
            """Returns the tables of all runs side by side, shape (rows, words, LANES)."""
            tables_of_lanes = [read_words(table.reshape(-1)) for table in tables_of_runs]
            rows, row_length = tables_of_lanes[0].shape
            packed = allocate_words(rows, row_length)
            # Lanes without a run repeat the first run.
            packed[:] = tables_of_lanes[0][:, :, None]
            for lane, numbers in enumerate(tables_of_lanes):
                packed[:, :, lane] = numbers
            return packed

        self._site = pack([arrays.site for arrays in tables])
        self._links = pack([arrays.links for arrays in tables])
        self._actors = pack([arrays.actors for arrays in tables])
        # The environments have a table of their own, because arguments must not overlap.
        self._environments = self._actors.copy()
        self._sums = pack([memory.sums for memory in memories])
        self._progress = pack([memory.progress for memory in memories])
        self._ramps = pack([view_rows(arrays.ramps) for arrays in tables])
        records = allocate_words(self._sites * record_rows, layout.floats)
        self._records = records.reshape(self._sites, record_rows, layout.floats, LANES)
        self._laws = allocate_words(self._sites, layout.law)
        self._sent = allocate_words(self._sites, layout.sent)
        self._received = allocate_words(self._sites * structure.peers, layout.received)
        self._columns = np.zeros((self._sites, structure.peers, layout.received), np.int64)
        self._code = allocate_words(1, 1)
        self._chain = allocate_words(self._sites, 0)
        if first.chain is not None:
            self._chain = pack([np.asarray(arrays.chain) for arrays in tables])
        self._put_laws(memories)
        self._ended = EndedRuns(
            ticks=np.full(LANES, -1),
            site_rows=np.zeros_like(self._site),
            links=np.zeros_like(self._links),
            records=np.zeros_like(self._records[:, 0]),
            sums=np.zeros_like(self._sums),
            progress=np.zeros_like(self._progress),
            laws=np.zeros_like(self._laws),
            sent=np.zeros_like(self._sent),
            peaks=np.zeros((self._sites, layout.columns, LANES), np.int64),
        )
        for lane, arrays in enumerate(tables):
            self._put_first_states(lane, arrays)
        self._addresses = _find_addresses(runs[0], structure, self.clock)

    def _put_first_states(self, lane: int, arrays: SiteArrays) -> None:
        """Writes the states of all sites before the first tick, which their peers start with.

        Args:
            lane: The lane.
            arrays: Arrays of the sites of its run.
        """
        for j in range(self._sites):
            # The peers of a site are all other sites: site 0 is a peer of site 1.
            receiver = 1 if j == 0 else 0
            link = arrays.links[receiver, j if j < receiver else j - 1]
            for n, name in enumerate(_STATE_FIELDS):
                joints = self._layout.joints
                columns = slice(n * joints, (n + 1) * joints)
                self._states[j, self._pages, lane, columns] = link[name]

    def _put_laws(self, memories: Sequence[RunMemory]) -> None:
        """Copies the numbers of compiled laws into the lanes.

        Args:
            memories: Arrays of each run.
        """
        for lane in range(LANES):
            # Lanes without a run repeat the first run.
            memory = memories[lane if lane < len(memories) else 0]
            if memory.laws is not None:
                self._laws[:, :, lane] = memory.laws.rows.view(np.int64)
                self._sent[:, :, lane] = memory.laws.sent.view(np.int64)
        channel = memories[0].tables.channel
        if channel is not None:
            self._columns[:] = channel.columns

    def _find_tables(self) -> IntArray:
        """Returns the address of each table of each site, shape (N, 15)."""
        structure = self._structure
        addresses = []
        for i in range(self._sites):
            rows = SiteTables(
                site=_share(self._site, i, self._sites),
                links=_share(self._links, i, self._sites),
                actors=_share(self._actors, i, self._sites),
                environments=_share(self._environments, i, self._sites)[
                    max(structure.sites[i].first_environment, 0) :
                ],
                ramps=_share(self._ramps, i, self._sites),
                record=self._records[i],
                peaks=self._peaks[i],
                sums=_share(self._sums, i, self._sites),
                progress=_share(self._progress, i, self._sites),
                scratch=self._scratch,
                law=_share(self._laws, i, self._sites),
                received=_share(self._received, i, self._sites),
                sent=_share(self._sent, i, self._sites),
                code=self._code,
                chain=_share(self._chain, i, self._sites),
            )
            _check_distinct(rows)
            addresses.append([table.ctypes.data for table in rows])
        return np.array(addresses, dtype=np.int64)

    def advance_to(self, until_s: float) -> None:
        """Continues all runs until they are as long as a run with a duration of `until_s` s.

        A run ends earlier if an arm leaves its limits. The results are written into the runs.

        Args:
            until_s: The time, s, later than that of the previous call.
        """
        lanes = [lane for lane in range(len(self.runs)) if self._ended.ticks[lane] < 0]
        if not lanes:
            return
        ticks = max(1, round(until_s * self._rate_hz))
        for lane in lanes:
            self.runs[lane].plan([ticks] * self._sites)
        self._widen_peaks(self.runs[lanes[0]].memory.peaks.shape[1])
        first = self._ticks
        record_rows = self._records.shape[1]
        if record_rows > 1 and not self._used_records.size:
            self._used_records = np.zeros((*self._used.shape[:3], record_rows), np.int64)
        self._step_to(ticks)
        records = None
        if record_rows > 1:
            count = min(self._ticks - first, record_rows)
            shape = (len(self.runs), self._sites, count, self._layout.floats)
            records = np.empty(shape)
            _copy_records(self._ticks - count, self._records.view(np.float64), records)
        for lane in lanes:
            if records is not None:
                self._write_records(lane, self.runs[lane], records[lane])
            self._write_back(lane, self.runs[lane], until_s)

    def _use_samples(self, first: int, count: int) -> int:
        """Finds the samples that are used in a block of ticks, see `use_samples`.

        Args:
            first: First tick of the block.
            count: Number of ticks.

        Returns:
            The largest age of a sample in use, ticks.
        """
        return use_samples(
            first,
            count,
            self._rate_hz,
            self._ended.ticks,
            self._deliveries,
            self._draws,
            self._used,
        )

    def _step_to(self, ticks: int) -> None:
        """Simulates all runs until they have made a number of ticks, or have ended.

        Args:
            ticks: Number of ticks since the start of the runs.
        """
        present = self._list_present()
        site_fields: Any = self._layout.site.fields
        _, mode_offset = site_fields["mode"]
        tables = self._find_tables()
        running = 1
        while self._ticks < ticks and running:
            count = min(BLOCK_TICKS, ticks - self._ticks)
            self._keep_states(self._use_samples(self._ticks, count))
            self._keep_samples_in_use(self._ticks, count)
            running = run_block(
                first=self._ticks,
                count=count,
                rate_hz=self._rate_hz,
                runs=len(self.runs),
                settled_rad=self._structure.settled_rad,
                pages=self._pages,
                mode_word=mode_offset // 8,
                record_rows=self._records.shape[1],
                addresses=self._addresses,
                tables=tables,
                states=self._states,
                used=self._used,
                columns=self._columns,
                table=self._table,
                peaks=self._peaks,
                present=present,
                ended=self._ended,
            )
            self._ticks += count

    def _keep_samples_in_use(self, first: int, count: int) -> None:
        """Copies the samples in use of a block of ticks to those of the kept records, if any.

        Args:
            first: First tick of the block.
            count: Number of ticks.
        """
        rows = self._used_records.shape[3]
        if not rows:
            return
        kept = np.arange(max(count - rows, 0), count)
        lanes = slice(len(self.runs))
        self._used_records[:, :, lanes, (first + kept) % rows] = self._used[:, :, lanes, kept]

    def _list_present(self) -> EndedRuns:
        """Returns the present state of all runs, as `keep_ended_runs` reads it."""
        return EndedRuns(
            ticks=self._ended.ticks,
            site_rows=self._site,
            links=self._links,
            records=self._records,
            sums=self._sums,
            progress=self._progress,
            laws=self._laws,
            sent=self._sent,
            peaks=self._ended.peaks,
        )

    def _keep_states(self, ticks: int) -> None:
        """Makes room for the states of more ticks, if necessary.

        A sample that is older than the sample in use is never used any more. Therefore far
        fewer states are needed than a link could delay.

        Args:
            ticks: Number of ticks before the present one whose states are needed.
        """
        while self._pages <= ticks:
            old_pages = self._pages
            self._pages *= 2
            states = np.zeros((self._sites, self._pages + 1, *self._states.shape[2:]))
            kept = np.arange(max(self._ticks - old_pages, 0), self._ticks)
            states[:, kept % self._pages] = self._states[:, kept % old_pages]
            states[:, -1] = self._states[:, -1]
            self._states = states

    def keep(self, chosen: Sequence[int]) -> None:
        """Continues with some of the runs only, so that no time is spent on the others.

        Args:
            chosen: Indices of the runs to keep in `runs`, in rising order. None of them may
                have ended.
        """
        assert all(self._ended.ticks[lane] < 0 for lane in chosen)
        lanes = list(chosen)
        for lane_table in (
            *(self._site, self._links, self._actors, self._environments, self._sums),
            *(self._progress, self._ramps, self._records, self._peaks),
            *(self._laws, self._sent, self._received, self._chain),
        ):
            lane_table[..., : len(lanes)] = lane_table[..., lanes]
        self._states[:, :, : len(lanes)] = self._states[:, :, lanes]
        self._used_records[:, :, : len(lanes)] = self._used_records[:, :, lanes]
        self._ended.ticks[:] = -1
        self._deliveries = keep_link_states(self._deliveries, lanes)
        self._links_of_runs = [self._links_of_runs[lane] for lane in lanes]
        self.runs = [self.runs[lane] for lane in lanes]

    def _widen_peaks(self, buckets: int) -> None:
        """Makes room for the peaks of more intervals of time. -1 marks an empty interval."""
        wider = allocate_words(self._sites * buckets, self._layout.columns)
        peaks = wider.reshape(self._sites, buckets, self._layout.columns, LANES)
        peaks.view(np.float64)[:] = -1.0
        peaks[:, : self._peaks.shape[1]] = self._peaks
        self._peaks = peaks

    def _write_records(self, lane: int, run: FusedRun, records: Array) -> None:
        """Writes the latest records of a lane into its run.

        Args:
            lane: The lane.
            run: The run.
            records: Records of all sites in the latest ticks of the lanes, shape (N, ticks,
                floats).
        """
        sent = run.memory.sent
        ended_ticks = int(self._ended.ticks[lane])
        end = self._ticks if ended_ticks < 0 else ended_ticks
        first = self._ticks - records.shape[1]
        ticks = np.arange(max(first, end - sent.t_ns.shape[1]), end)
        pages = ticks % sent.t_ns.shape[1]
        # The equation of `tick_ns`.
        sent.t_ns[:, pages] = ticks * NS_PER_S // self._rate_hz
        sent.rows[:, pages] = records[:, ticks - first]
        rows = ticks % self._used_records.shape[3]
        sent.used[:, pages] = self._used_records[:, :, lane, rows].transpose(0, 2, 1)

    def _write_back(self, lane: int, run: FusedRun, until_s: float) -> None:
        """Writes the numbers of a lane into its run.

        Args:
            lane: The lane.
            run: The run.
            until_s: Planned end of the run, s.
        """
        memory = run.memory
        tables = memory.tables
        ended_ticks = int(self._ended.ticks[lane])
        has_ended = ended_ticks >= 0
        ticks = ended_ticks if has_ended else self._ticks
        site_rows = self._ended.site_rows if has_ended else self._site
        record_row = (ticks - 1) & (self._records.shape[1] - 1)
        records = self._ended.records if has_ended else self._records[:, record_row]
        sums = self._ended.sums if has_ended else self._sums
        progress = self._ended.progress if has_ended else self._progress

        last_bucket = (ticks - 1) * BUCKETS_PER_S // self._rate_hz
        peaks = memory.peaks
        new_peaks = self._peaks[:, : last_bucket + 1, :, lane].view(np.float64)
        peaks[:, : last_bucket + 1] = new_peaks
        if has_ended:
            peaks[:, last_bucket] = self._ended.peaks[:, :, lane].view(np.float64)

        put_rows(tables.site, site_rows[:, :, lane])
        put_rows(memory.sums, sums[:, :, lane])
        unsettled_ns = progress[:, :, lane].copy()
        rows = unsettled_ns.view(memory.progress.dtype).reshape(-1)
        memory.progress["unsettled_ns"] = rows["unsettled_ns"]
        _write_progress(memory.progress, ticks, self._rate_hz)
        if has_ended:
            last_ns = tick_ns(ticks - 1, self._rate_hz)
            diverged = tables.site["mode"][:, 0] == Mode.DIVERGED
            memory.progress["diverged_ns"][diverged] = last_ns

        page = (ticks - 1) & (memory.sent.t_ns.shape[1] - 1)
        memory.sent.t_ns[:, page] = tick_ns(ticks - 1, self._rate_hz)
        memory.sent.rows[:, page] = records[:, :, lane].view(np.float64)
        if memory.laws is not None:
            laws = self._ended.laws if has_ended else self._laws
            sent = self._ended.sent if has_ended else self._sent
            memory.laws.rows[:] = laws[:, :, lane].view(np.float64)
            memory.laws.sent[:] = sent[:, :, lane].view(np.float64)
        run.ran_s = until_s
        if run.diverged_s is not None:
            run.ran_s = run.diverged_s
        elif not has_ended:
            self._links_of_runs[lane].set_pending(
                ticks=ticks,
                links=np.ascontiguousarray(self._links[:, :, lane]).view(self._layout.link),
                states=self._states[:, :, lane].copy(),
                received=self._received[:, :, lane].view(np.float64),
            )


def view_rows(table: NDArray[np.float64]) -> NDArray[Any]:
    """Returns an array of shape (N, rows, columns) as N structured rows, without copying it."""
    return table.reshape(len(table), -1).view([("row", "f8", (table[0].size,))])


def _share(table: Words, i: int, sites: int) -> Words:
    """Returns the rows that belong to site i. Each site has the same number of rows."""
    rows = len(table) // sites
    return table[i * rows : (i + 1) * rows]


def _check_distinct(tables: SiteTables) -> None:
    """Asserts that no two tables overlap: the compiled code of `advance_site` relies on it."""
    filled = [table for table in tables if table.size]
    ranges = sorted((table.ctypes.data, table.ctypes.data + table.nbytes) for table in filled)
    for (_, end), (start, _) in pairwise(ranges):
        assert end <= start


def put_rows(rows: NDArray[Any], numbers: Words) -> None:
    """Overwrites structured rows by numbers given as integers with the same bits ("words").

    Args:
        rows: The rows; written.
        numbers: The numbers, shape (rows, numbers of a row).
    """
    new_rows = np.ascontiguousarray(numbers).view(rows.dtype)
    rows[...] = new_rows.reshape(rows.shape)


def _write_progress(progress: Any, ticks: int, rate_hz: int) -> None:
    """Writes how far the sites of a run are, after a number of ticks.

    Args:
        progress: Rows of all sites, see `ProgressRow`; written.
        ticks: Number of ticks of each site.
        rate_hz: Tick rate, Hz.
    """
    parts = ticks * BUCKETS_PER_S
    progress["tick"] = ticks
    progress["bucket"] = parts // rate_hz
    progress["part"] = parts % rate_hz
    has_finished = ticks >= progress["ticks"][0]
    progress["t_ns"] = NEVER_NS if has_finished else tick_ns(ticks, rate_hz)

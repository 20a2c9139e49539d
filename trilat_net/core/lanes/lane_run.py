"""Simulates up to `LANES` runs together, each in one lane of the vector registers.

`LaneRun` takes runs with equal structure, for example the points of a sweep over a gain, and
advances them to a given time. It is the counterpart of `CompiledRun`, which simulates a single
run.

Invariant:
    - After `advance_to`, each run is bit-identical to what `CompiledRun.advance_to` would have
      produced. Only intermediate results of a tick ("scratch" in `row_fields`) and obsolete
      entries of ring buffers may differ.
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

from ...records import NS_PER_S, Mode
from ..step.compiled_run import CompiledRun
from ..step.fused_run import NEVER_NS, ReplayedInputs
from ..step.jit import LaneCode, leaf
from ..step.run_state import RunMemory
from ..step.site_arrays import SiteArrays
from ..step.ticks import BUCKETS_PER_S, first_tick_at, tick_ns
from ..step.vectors import Array, IntArray
from .chain_lane_stages import advance_chain_site
from .lane_deliveries import (
    BLOCK_TICKS,
    DrawAddresses,
    LinkStates,
    repeat_deliveries,
    use_samples,
    use_samples_of_rates,
)
from .lane_laws import LawCode
from .lane_rows import LANES, LaneTable, Words, allocate_words, read_words
from .lane_stages import STAGES_DTYPE, EndedRuns, RecordedHands, advance_site, run_block
from .lane_structure import RunStructure, SiteStructure

_FIRST_PAGES = 256
"""Initial number of ticks whose states are kept, a power of two."""
_REFERENCE_FIELDS = ("alpha", "alpha_rate", "gone")
"""Fields of a link's row that are written in stage 3 of a tick."""
_STATE_FIELDS = ("q", "qd", "tau_x")
"""Fields of a link's row that contain the sample in use."""


class _SiteTables(NamedTuple):
    """The state of one site in several runs side by side.

    Each run has a lane (an element of the vector registers). In each array, the values of all
    lanes are adjacent. The arrays are passed to the compiled function `advance_site`. A row is
    a record with named fields, see `row_fields`.

    Attributes:
        site: Row with the state of the site.
        links: Rows of the links from other sites.
        actors: Rows of the operators and environments that act on the arm.
        environments: Rows of the environments only.
        ramps: Row of planned changes of the dominance factors.
        record: Row with the results of a tick, as they would be logged.
        peaks: Largest values, one row per 50 ms interval (bucket).
        sums: Row with sums over the run.
        progress: Row with the progress of the run.
        scratch: Row with intermediate results of the integrator.
        law: Row with the gains and memory of a compiled control law.
        received: Rows with the values sent by the laws of other sites.
        sent: Row with the values sent by this law.
        code: Tells the compiler which law to call. The array itself is not used.
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


class _LaneLayout(NamedTuple):
    """Data types and lengths of a run's arrays, on which its compiled code depends.

    Runs with equal layouts can use the same code.

    Attributes:
        site: Data type of the state of a site.
        link: Data type of the state of a link.
        actor: Data type of an operator or environment.
        sums: Data type of the sums over a site's run.
        progress: Data type of the progress of a site.
        floats: Number of floats in a record.
        columns: Number of columns in the array of largest values (peaks).
        ramps: Shape of the table of dominance factors.
        chain: Data type of a joint. None for planar arms.
        joints: Number of joints whose angles the sites exchange.
        law: Largest number of gains and memory values of a compiled control law.
        received: Largest number of values that a law receives from a peer.
        sent: Largest number of values that a law sends.
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


def _find_layout(run: CompiledRun) -> _LaneLayout:
    """Returns the data types and lengths of all arrays of a run, on which its code depends.

    Without compiled control laws, the arrays for laws have length 0.
    """
    memory = run.memory
    tables = memory.tables
    return _LaneLayout(
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


def _list_argument_types(
    layout: _LaneLayout,
    structure: RunStructure,
    site: SiteStructure,
    clock: types.Type = types.int64,
) -> tuple[Any, ...]:
    """Returns the Numba types for which the code of one control period is compiled.

    The types contain everything that the compiled code depends on: the layouts of the arrays,
    and properties that are equal in all runs, such as the types of the operators.

    Args:
        layout: Data types and lengths of the arrays.
        structure: Structure of the run.
        site: Structure of the site.
        clock: Type of the tick and of its nominal time: an integer if they are equal in all
            lanes, otherwise `LaneNumbers`.
    """
    first = site.first_environment
    actors = site.actors
    chain = _type_numbers(0, 1)
    if layout.chain is not None:
        # The actors and joints of a chain are selected by a loop variable.
        actors = ((),) * len(actors)
        constants = () if any(site.prismatic) else (("prismatic", 0),)
        chain = LaneTable(layout.chain, (constants,) * len(site.prismatic))
    environments = actors[first:] if first >= 0 else ()
    tables = _SiteTables(
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
    """Returns the Numba type of a table in which every row is a vector of floats.

    Compiled code accesses this vector as the field `numbers` of a row.

    Args:
        count: Number of values in each row.
        rows: Number of rows.
    """
    return LaneTable(np.dtype([("numbers", "f8", (count,))]), ((),) * rows)


def _choose_code(layout: _LaneLayout) -> Callable[..., None]:
    """Returns the compiled function that advances several runs by one control period.

    Depending on the layout of the arrays, this is the function for planar arms with two joints,
    or the one for chains of joints from a URDF file.
    """
    return advance_site if layout.chain is None else advance_chain_site


def _find_code(
    layout: _LaneLayout,
    structure: RunStructure,
    site: SiteStructure,
    clock: types.Type,
) -> LaneCode:
    """Returns the code of one control period of a site. The arguments determine the types.

    Args:
        layout: Data types and lengths of the arrays.
        structure: Structure of the run.
        site: Structure of the site.
        clock: Type of the tick and of its nominal time, see `_list_argument_types`.
    """
    return LaneCode(_choose_code(layout), _list_argument_types(layout, structure, site, clock))


@leaf
def _copy_records(first: IntArray, kept: Array, records: Array) -> None:
    """Copies the results of several simulations from shared arrays to one array per run.

    Args:
        first: First tick of each site, shape (N,).
        kept: Latest records of all sites, shape (N, rows, floats, LANES). The record of tick k
            is in row k modulo the number of rows.
        records: Output array for the results, shape (runs, N, ticks, floats).
    """
    # The values of all lanes in a record occupy only a few cache lines.
    for i in range(records.shape[1]):
        for tick in range(records.shape[2]):
            row = (first[i] + tick) & (kept.shape[1] - 1)
            for lane in range(records.shape[0]):
                for column in range(records.shape[3]):
                    records[lane, i, tick, column] = kept[i, row, column, lane]


class _LinksOfRun:
    """Brings the simulated network links of a run up to date, but only when necessary.

    While several runs are simulated together, their deliveries are computed in another way,
    which does not update the link state. This state is only needed by a run that then continues
    on its own.

    Args:
        run: The run before its first tick.
    """

    def __init__(self, run: CompiledRun) -> None:
        self._run = run
        self._ticks: IntArray = np.zeros_like(run.memory.progress["tick"])
        # If a tick was planned late, its sample arrives at a later tick of the receiver.
        self._ends: list[IntArray] = []

    def set_pending(
        self, ticks: IntArray, links: NDArray[Any], states: Array, received: Array
    ) -> None:
        """Stores the latest results of a simulation, to update its network links later.

        Args:
            ticks: Number of ticks that each site has executed.
            links: Rows of the run's links after these ticks. Only the fields of the sample in
                use, and those written in stage 3 of a tick, are up to date.
            states: The latest states of the run's sites, see `repeat_deliveries`.
            received: Values sent by control laws, which arrived with the samples in use, shape
                (N P, C).
        """
        self._ends.append(ticks.copy())
        self._run.pending_deliveries = partial(self._update, links, states, received)

    def _update(self, links: NDArray[Any], states: Array, received: Array) -> None:
        """Computes the link state up to the ticks stored by `set_pending`."""
        memory = self._run.memory
        tables = memory.tables
        for ticks in self._ends:
            repeat_deliveries(
                first=self._ticks,
                end=ticks,
                rates_hz=np.ascontiguousarray(tables.site["rate_hz"][:, 0]),
                next_samples=memory.next_samples,
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
        self._ends.clear()
        for name in (*_REFERENCE_FIELDS, *_STATE_FIELDS):
            tables.links[name] = links.reshape(tables.links.shape)[name]
        if tables.channel is not None:
            tables.channel.received[:] = received.reshape(tables.channel.received.shape)


def _pack_tables(tables_of_runs: Sequence[NDArray[Any]]) -> Words:
    """Interleaves the arrays of several runs, as vector instructions require.

    Args:
        tables_of_runs: The same array from each run.

    Returns:
        The values of all runs, shape (rows, values per row, LANES).
    """
    tables_of_lanes = [read_words(table.reshape(-1)) for table in tables_of_runs]
    rows, row_length = tables_of_lanes[0].shape
    packed = allocate_words(rows, row_length)
    # Lanes without a run repeat the first run.
    packed[:] = tables_of_lanes[0][:, :, None]
    for lane, numbers in enumerate(tables_of_lanes):
        packed[:, :, lane] = numbers
    return packed


class LaneRun:
    """Simulates several runs of equal structure together with vector instructions.

    Each run occupies a lane (an element of the vector registers), so that one instruction
    computes the same quantity for several runs.

    Args:
        runs: The runs before their first tick, at most `LANES`. They must have the same
            structure, see `RunStructure`, and nothing may prevent them from being simulated
            together, see `RunStructure.find_obstacle`.
        record_rows: Number of latest records kept per site, a power of two.

    Attributes:
        runs: The runs in the lanes. `advance_to` writes the results to them.
        clock: Numba type of a tick and of its nominal time, see `_list_argument_types`.
    """

    clock: types.Type = types.int64

    @classmethod
    def list_code(cls, run: CompiledRun) -> list[LaneCode]:
        """Returns the code with which a run is simulated in a lane, one object per site.

        Args:
            run: The run, for which `RunStructure.find_obstacle` must return an empty string.
        """
        structure = RunStructure.find(run)
        layout = _find_layout(run)
        return [_find_code(layout, structure, site, cls.clock) for site in structure.sites]

    @classmethod
    def has_stored_code(cls, run: CompiledRun) -> bool:
        """Returns True if the code that simulates a run in lanes is already stored on disk.

        Without stored code, the runs can only start after a compilation that takes some time.

        Args:
            run: The run, see `list_code`.
        """
        return all(code.is_stored() for code in cls.list_code(run))

    @classmethod
    def explain_uncompilable(cls, run: CompiledRun) -> str:
        """Explains to the user why a control law cannot be compiled for several runs at once.

        The method tries to compile the code. A law for which this fails may still be compilable
        for a single run.

        Args:
            run: The run before its first tick, see `list_code`.

        Returns:
            The reason, or an empty string if all laws can be compiled.
        """
        try:
            for code in cls.list_code(run):
                code.find_address()
        except NumbaError:
            return "control laws that cannot be compiled side by side"
        return ""

    def __init__(self, runs: Sequence[CompiledRun], record_rows: int = 1) -> None:
        assert 0 < len(runs) <= LANES
        structure = RunStructure.find(runs[0])
        assert all(RunStructure.find(run) == structure for run in runs)
        assert all(run.ran_s == 0.0 for run in runs)
        self.runs = list(runs)
        self._structure = structure
        self._layout = layout = _find_layout(runs[0])
        memories = [run.memory for run in runs]
        tables = [memory.tables for memory in memories]
        first = tables[0]
        self._sites = len(structure.sites)
        self._rates_hz: IntArray = np.ascontiguousarray(first.site["rate_hz"][:, 0])
        self._has_equal_rates = len(set(self._rates_hz.tolist())) == 1
        self._table = first.table
        self._ticks: IntArray = np.zeros(self._sites, np.int64)
        self._next_ns = np.zeros(self._sites, np.int64)
        self._latest = np.zeros((3, self._sites), np.int64)
        self._next_samples = np.zeros((self._sites, structure.peers), np.int64)
        self._deliveries = LinkStates.copy_from(tables)
        self._draws = DrawAddresses.find()
        self._links_of_runs = [_LinksOfRun(run) for run in runs]

        self._pages = _FIRST_PAGES
        # A state occupies whole cache lines, because each lane needs the state of another tick.
        width = -(-(3 * layout.joints + layout.sent) // 8) * 8
        self._states = np.zeros((self._sites, self._pages + 1, LANES, width))
        self._scratch = allocate_words(1, STAGES_DTYPE.itemsize // 8)
        self._used = np.zeros((self._sites, structure.peers, LANES, BLOCK_TICKS), np.int64)
        self._peaks = np.zeros((self._sites, 0, layout.columns, LANES), np.int64)

        self._site = _pack_tables([arrays.site for arrays in tables])
        self._links = _pack_tables([arrays.links for arrays in tables])
        self._actors = _pack_tables([arrays.actors for arrays in tables])
        # The environments have their own table, because arguments must not overlap.
        self._environments = self._actors.copy()
        self._sums = _pack_tables([memory.sums for memory in memories])
        self._progress = _pack_tables([memory.progress for memory in memories])
        self._ramps = _pack_tables([view_rows(arrays.ramps) for arrays in tables])
        records = allocate_words(self._sites * record_rows, layout.floats)
        self._records = records.reshape(self._sites, record_rows, layout.floats, LANES)
        self._laws = allocate_words(self._sites, layout.law)
        self._sent = allocate_words(self._sites, layout.sent)
        self._received = allocate_words(self._sites * structure.peers, layout.received)
        self._columns = np.zeros((self._sites, structure.peers, layout.received), np.int64)
        self._code = allocate_words(1, 1)
        self._chain = allocate_words(self._sites, 0)
        if first.chain is not None:
            self._chain = _pack_tables([np.asarray(arrays.chain) for arrays in tables])
        self._put_laws(memories)
        self._ended = self._allocate_ended()
        for lane, arrays in enumerate(tables):
            self._put_first_states(lane, arrays)
        # The code is compiled if it is not yet stored on disk.
        codes = [_find_code(layout, structure, site, self.clock) for site in structure.sites]
        self._addresses: IntArray = np.array([code.find_address() for code in codes])
        most_sources = len(self._actors) // self._sites
        self._hands = _find_recorded_hands(memories[0].feed, layout.actor, most_sources)

    def _allocate_ended(self) -> EndedRuns:
        """Allocates memory for the final states of the runs, none of which has ended yet."""
        return EndedRuns(
            ticks=np.full(LANES, -1),
            site_ticks=np.zeros((self._sites, LANES), np.int64),
            site_rows=np.zeros_like(self._site),
            links=np.zeros_like(self._links),
            records=np.zeros_like(self._records[:, 0]),
            sums=np.zeros_like(self._sums),
            progress=np.zeros_like(self._progress),
            laws=np.zeros_like(self._laws),
            sent=np.zeros_like(self._sent),
            peaks=np.zeros((self._sites, self._layout.columns, LANES), np.int64),
        )

    def _put_first_states(self, lane: int, arrays: SiteArrays) -> None:
        """Copies the initial state of each site, as known to the other sites, into a lane.

        A site uses these initial states of its peers until the first sample has arrived.

        Args:
            lane: Index of the lane.
            arrays: Arrays of the sites of the run.
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
        """Copies the gains and memory of compiled control laws into the arrays of all lanes.

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
        """Returns the memory address of each array of each of the N sites, shape (N, 15).

        The compiled code of a tick receives the addresses of these 15 arrays (`_SiteTables`).
        """
        structure = self._structure
        addresses = []
        for i in range(self._sites):
            rows = _SiteTables(
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
        """Continues all runs until each has lasted `until_s` seconds.

        A run ends earlier if an arm leaves its limits. The results are written to the
        `CompiledRun` objects, together with the latest records if these are kept.

        Args:
            until_s: The time, s, later than in the previous call.
        """
        lanes = [lane for lane in range(len(self.runs)) if self._ended.ticks[lane] < 0]
        if not lanes:
            return
        ticks = [max(1, round(until_s * rate_hz)) for rate_hz in self._rates_hz.tolist()]
        for lane in lanes:
            self.runs[lane].plan(ticks)
        self._widen_peaks(self.runs[lanes[0]].memory.peaks.shape[1])
        first = self._ticks.copy()
        record_rows = self._records.shape[1]
        self._step_to(np.array(ticks))
        records = None
        if record_rows > 1:
            most_ticks = int((self._ticks - first).max())
            count = min(most_ticks, record_rows)
            shape = (len(self.runs), self._sites, count, self._layout.floats)
            records = np.empty(shape)
            _copy_records(self._ticks - count, self._records.view(np.float64), records)
        for lane in lanes:
            if records is not None:
                self._write_records(lane, self.runs[lane], records[lane])
            self._write_back(lane, self.runs[lane], until_s)

    def _use_samples(self, end: IntArray) -> int:
        """Finds which samples from its peers each site uses in a block of control periods.

        This depends on the network delays; see `use_samples`.

        Args:
            end: Tick of each site after the block, shape (N,).

        Returns:
            The largest age of a sample in use, in ticks.
        """
        if not self._has_equal_rates:
            return use_samples_of_rates(
                self._ticks,
                end,
                self._rates_hz,
                self._next_samples,
                self._ended.ticks,
                self._deliveries,
                self._draws,
                self._used,
            )
        first = int(self._ticks[0])
        return use_samples(
            first,
            int(end[0]) - first,
            int(self._rates_hz[0]),
            self._ended.ticks,
            self._deliveries,
            self._draws,
            self._used,
        )

    def _find_block_end(self, ticks: IntArray) -> IntArray:
        """Returns the tick of each site at the end of the next block.

        Sites may have different rates. A block is a time interval that all sites simulate
        before samples are exchanged.

        Args:
            ticks: Number of ticks of each site after all blocks.
        """
        ends_ns = [
            tick_ns(first + BLOCK_TICKS, rate_hz)
            for first, last, rate_hz in zip(
                self._ticks.tolist(), ticks.tolist(), self._rates_hz.tolist(), strict=True
            )
            if first < last
        ]
        end_ns = min(ends_ns)
        end = [first_tick_at(end_ns, rate_hz) for rate_hz in self._rates_hz.tolist()]
        return np.clip(end, self._ticks, ticks)

    def _step_to(self, ticks: IntArray) -> None:
        """Continues all runs up to a given number of ticks, or until all have ended.

        Args:
            ticks: Number of ticks of each site since the start of the runs, shape (N,).
        """
        present = self._list_present()
        site_fields: Any = self._layout.site.fields
        _, mode_offset = site_fields["mode"]
        tables = self._find_tables()
        running = 1
        while (self._ticks < ticks).any() and running:
            end = self._find_block_end(ticks)
            self._keep_states(self._use_samples(end))
            running = run_block(
                first=self._ticks.copy(),
                ticks=self._ticks,
                end=end,
                rates_hz=self._rates_hz,
                next_ns=self._next_ns,
                latest=self._latest,
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
                hands=self._hands,
                actors=self._actors.view(np.float64),
                peaks=self._peaks,
                present=present,
                ended=self._ended,
            )

    def _list_present(self) -> EndedRuns:
        """Returns the current state of all runs, as views that share their memory.

        When a run ends early, `keep_ended_runs` copies its state from these views, because the
        arrays are overwritten while the other runs continue.
        """
        return EndedRuns(
            ticks=self._ended.ticks,
            site_ticks=self._ended.site_ticks,
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
        """Enlarges the memory for past states of the sites, if necessary.

        A site uses past states (samples) of other sites, because the network delays them.
        Samples older than the one in use are never used again, so far fewer states are needed
        than the longest delay of a link would suggest.

        Args:
            ticks: Number of ticks before the current tick for which the states are needed.
        """
        while self._pages <= ticks:
            old_pages = self._pages
            self._pages *= 2
            states = np.zeros((self._sites, self._pages + 1, *self._states.shape[2:]))
            for i, end in enumerate(self._ticks.tolist()):
                kept = np.arange(max(end - old_pages, 0), end)
                states[i, kept % self._pages] = self._states[i, kept % old_pages]
            states[:, -1] = self._states[:, -1]
            self._states = states

    def keep(self, chosen: Sequence[int]) -> None:
        """Drops all runs except the given ones.

        A search, for example, saves time by dropping runs that can no longer be the best.

        Args:
            chosen: Indices in `runs` of the runs that continue, in ascending order. None of
                them may have ended.
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
        self._ended.ticks[:] = -1
        self._deliveries = self._deliveries.keep(lanes)
        self._links_of_runs = [self._links_of_runs[lane] for lane in lanes]
        self.runs = [self.runs[lane] for lane in lanes]

    def _widen_peaks(self, buckets: int) -> None:
        """Enlarges the arrays that hold the largest values of each 50 ms interval.

        They must cover all intervals up to the end of the simulation. New entries are -1, which
        marks an interval in which no control period has been executed.
        """
        wider = allocate_words(self._sites * buckets, self._layout.columns)
        peaks = wider.reshape(self._sites, buckets, self._layout.columns, LANES)
        peaks.view(np.float64)[:] = -1.0
        peaks[:, : self._peaks.shape[1]] = self._peaks
        self._peaks = peaks

    def _write_records(self, lane: int, run: CompiledRun, records: Array) -> None:
        """Copies the latest records of one lane into the object of its run.

        The caller reads them from there with `CompiledRun.pop_records`.

        Args:
            lane: Index of the lane.
            run: The run.
            records: Records of all N sites in the latest ticks, shape (N, ticks, floats).
        """
        sent = run.memory.sent
        has_ended = self._ended.ticks[lane] >= 0
        ends = self._ended.site_ticks[:, lane] if has_ended else self._ticks
        for i, end in enumerate(ends.tolist()):
            first = int(self._ticks[i]) - records.shape[1]
            ticks = np.arange(max(first, end - sent.t_ns.shape[1], 0), end)
            pages = ticks % sent.t_ns.shape[1]
            # Same equation as in `tick_ns`.
            sent.t_ns[i, pages] = ticks * NS_PER_S // self._rates_hz[i]
            sent.rows[i, pages] = records[i, ticks - first]

    def _write_back(self, lane: int, run: CompiledRun, until_s: float) -> None:
        """Copies the state of a run that was simulated with others into its `CompiledRun`.

        Args:
            lane: Index of the lane.
            run: The object of the run.
            until_s: Planned end of the run, s.
        """
        memory = run.memory
        tables = memory.tables
        has_ended = bool(self._ended.ticks[lane] >= 0)
        ticks = self._ended.site_ticks[:, lane] if has_ended else self._ticks
        site_rows = self._ended.site_rows if has_ended else self._site
        sites = np.arange(self._sites)
        record_rows = (ticks - 1) & (self._records.shape[1] - 1)
        records = self._ended.records if has_ended else self._records[sites, record_rows]
        sums = self._ended.sums if has_ended else self._sums
        progress = self._ended.progress if has_ended else self._progress

        peaks = memory.peaks
        last_buckets = (ticks - 1) * BUCKETS_PER_S // self._rates_hz
        for i, last_bucket in enumerate(last_buckets.tolist()):
            new_peaks = self._peaks[i, : last_bucket + 1, :, lane].view(np.float64)
            peaks[i, : last_bucket + 1] = new_peaks
        if has_ended:
            peaks[sites, last_buckets] = self._ended.peaks[:, :, lane].view(np.float64)

        put_rows(tables.site, site_rows[:, :, lane])
        put_rows(memory.sums, sums[:, :, lane])
        unsettled_ns = progress[:, :, lane].copy()
        rows = unsettled_ns.view(memory.progress.dtype).reshape(-1)
        memory.progress["unsettled_ns"] = rows["unsettled_ns"]
        _write_progress(memory.progress, ticks, self._rates_hz)
        # Same equation as in `tick_ns`.
        last_ns = (ticks - 1) * NS_PER_S // self._rates_hz
        if has_ended:
            diverged = tables.site["mode"][:, 0] == Mode.DIVERGED
            memory.progress["diverged_ns"][diverged] = last_ns[diverged]

        pages = (ticks - 1) & (memory.sent.t_ns.shape[1] - 1)
        memory.sent.t_ns[sites, pages] = last_ns
        if not self._has_equal_rates and not has_ended:
            self._write_sent(lane, run)
        memory.sent.rows[sites, pages] = records[:, :, lane].view(np.float64)
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

    def _write_sent(self, lane: int, run: CompiledRun) -> None:
        """Copies the samples that one run sent last from shared arrays into its records.

        A slow site accepts several samples from a faster peer at once. If the run continues on
        its own, it reads from its records those samples that no site has accepted yet.

        Args:
            lane: Index of the lane.
            run: The run.
        """
        sent = run.memory.sent
        kept = min(sent.t_ns.shape[1], self._pages)
        joints = self._layout.joints
        for i, layout in enumerate(run.layouts):
            end = int(self._ticks[i])
            ticks = np.arange(max(end - kept, 0), end)
            pages = ticks % sent.t_ns.shape[1]
            # Same equation as in `tick_ns`.
            sent.t_ns[i, pages] = ticks * NS_PER_S // self._rates_hz[i]
            states = self._states[i, ticks % self._pages, lane]
            names = ("x", "xd", "wrench") if layout.task else ("q", "qd", "tau_x")
            columns = layout.columns()
            for n, vector in enumerate(names):
                vectors = states[:, n * joints : n * joints + layout.shared]
                sent.rows[i, pages, columns[vector]] = vectors
            if layout.sent:
                numbers = states[:, 3 * joints : 3 * joints + layout.sent]
                sent.rows[i, pages, columns["ch"]] = numbers


def _find_recorded_hands(
    feed: ReplayedInputs, actor: np.dtype[Any], most_sources: int
) -> RecordedHands:
    """Returns the torques or targets with which live operators moved arms in a recorded run.

    They are applied again at the same control periods when the run is repeated.

    Args:
        feed: Inputs of the recorded run.
        actor: Data type of an operator's row.
        most_sources: Number of rows of operators and environments per site.
    """
    coordinates = (feed.hands.shape[2] - 1) // 2
    hand_words = [*find_words(actor, "grip")]
    columns = [0]
    for name, first in (("a", 1), ("b", 1 + coordinates)):
        words_of_vector = [*find_words(actor, name)][:coordinates]
        hand_words += words_of_vector
        columns += range(first, first + len(words_of_vector))
    first_rows = np.arange(len(feed.hand_indices)) * most_sources
    rows = np.where(feed.hand_indices < 0, -1, first_rows + feed.hand_indices)
    return RecordedHands(feed.hands, rows, np.array(hand_words), np.array(columns))


def view_rows(table: NDArray[np.float64]) -> NDArray[Any]:
    """Returns an array of floats as structured records with named fields.

    The array has shape (N, rows, columns) for N sites. The records share its memory, so
    assigning to a field changes the array.
    """
    return table.reshape(len(table), -1).view([("row", "f8", (table[0].size,))])


def _share(table: Words, i: int, sites: int) -> Words:
    """Returns the rows of an array that belong to one site.

    The array contains the rows of all sites one after another, with the same number of rows per
    site. For example, site 1 of 3 owns rows 2 and 3 of 6.
    """
    rows = len(table) // sites
    return table[i * rows : (i + 1) * rows]


def _check_distinct(tables: _SiteTables) -> None:
    """Asserts that no two tables overlap, as the compiled `advance_site` requires."""
    filled = [table for table in tables if table.size]
    ranges = sorted((table.ctypes.data, table.ctypes.data + table.nbytes) for table in filled)
    for (_, end), (start, _) in pairwise(ranges):
        assert end <= start


def put_rows(rows: NDArray[Any], numbers: Words) -> None:
    """Overwrites structured records with values given as 64-bit words, see `read_words`.

    Args:
        rows: Rows to overwrite.
        numbers: The values, shape (rows, words per row).
    """
    new_rows = np.ascontiguousarray(numbers).view(rows.dtype)
    rows[...] = new_rows.reshape(rows.shape)


def _write_progress(progress: Any, ticks: IntArray, rates_hz: IntArray) -> None:
    """Sets the number and time of the next tick of each site of a run.

    The time is "never" for a site that has executed all its ticks, see `ProgressRow`.

    Args:
        progress: Rows of all sites, see `ProgressRow`; updated in place.
        ticks: Number of ticks of each site, shape (N,).
        rates_hz: Tick rates, Hz, shape (N,).
    """
    parts = ticks * BUCKETS_PER_S
    progress["tick"] = ticks
    progress["bucket"] = parts // rates_hz
    progress["part"] = parts % rates_hz
    has_finished = ticks >= progress["ticks"]
    # Same equation as in `tick_ns`.
    progress["t_ns"] = np.where(has_finished, NEVER_NS, ticks * NS_PER_S // rates_hz)


def find_words(layout: np.dtype[Any], name: str) -> range:
    """Returns the positions of a field's values in a record, for example those of "q".

    The positions are indices among all values of the record (row).

    Args:
        layout: Data type of the row.
        name: Name of the field.
    """
    fields: Any = layout.fields
    dtype, offset, *_ = fields[name]
    return range(offset // 8, (offset + dtype.itemsize) // 8)

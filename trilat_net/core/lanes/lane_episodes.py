"""Simulates several episodes at once that start and end at different times.

This module is used by a training environment with many copies. When the episode of one copy
ends, a new episode takes over its lane (position in the vector registers), while the others
continue. Each lane therefore has its own clock. In each run, a program may move one arm. The
caller passes the actions of all programs as one array.

Invariant:
    - After each call of `advance`, the state of a run is bit-identical to the one that
      `CompiledRun.step_to` produces from the same actions.
    - Lanes do not affect each other.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..life.live_hand import HandRules
from ..life.several_hands import SeveralHands
from ..links.delay import LINK_MODEL_DTYPE
from ..step.compiled_run import CompiledRun
from ..step.jit import leaf
from ..step.ticks import tick_ns
from ..step.vectors import Array, IntArray
from .lane_deliveries import BLOCK_TICKS, DrawAddresses, LinkStates, use_samples
from .lane_rows import LANES, LaneNumbers, Words, allocate_words, pointer_to, read_words
from .lane_run import LaneRun, find_words, put_rows, view_rows
from .lane_stages import EndedRuns, call_site, copy_lane, keep_ended_runs
from .lane_structure import RunStructure
from .run_groups import LEAST_RUNS

_CLOCK = LaneNumbers()


@leaf
def _use_samples_of_lanes(
    runs: int,
    first: IntArray,
    count: int,
    rate_hz: int,
    skipped: IntArray,
    states: LinkStates,
    draws: DrawAddresses,
    used: IntArray,
) -> int:
    """Finds which received samples the arms of all runs use in their next control periods.

    The runs are simulated side by side (in lanes), each at its own tick.

    Args:
        runs: Number of runs.
        first: First tick of each lane, shape (LANES,).
        count: Number of ticks.
        rate_hz: Tick rate of all sites, Hz.
        skipped: -1 for lanes that are advanced, shape (LANES,).
        states: State of the links of the runs; updated in place.
        draws: Functions that draw random numbers.
        used: Output array, see `use_samples`.

    Returns:
        The largest age of a sample in use, ticks.
    """
    largest_age = 0
    for lane in range(runs):
        lane_slice = slice(lane, lane + 1)
        of_lane = LinkStates(
            states.links[lane_slice],
            states.models[lane_slice],
            states.points[lane_slice],
            states.releases[lane_slice],
            states.newest[lane_slice],
            states.uniforms,
            states.delays_us,
            states.stamps_ns,
            states.times_ns,
            states.sample_counts,
        )
        age = use_samples(
            first=first[lane],
            count=count,
            rate_hz=rate_hz,
            ended=skipped[lane_slice],
            states=of_lane,
            draws=draws,
            used=used[:, :, lane_slice],
        )
        largest_age = max(largest_age, age)
    return largest_age


@leaf
def _put_actions(
    actions: Array, hand_row: int, columns: IntArray, actors: Array, runs: int
) -> None:
    """Copies the actions of all programs in a tick to the simulated operators of the arms.

    In each of several runs, one program moves an arm in place of an operator. The runs are
    stored side by side, one per lane.

    Args:
        actions: Five values per action (grip and target), shape (5, LANES).
        hand_row: Index of the operator's row in `actors`.
        columns: Index of each value of an action within this row, shape (5,).
        actors: Rows of operators and environments, viewed as floats, shape (rows, values per
            row, LANES).
        runs: Number of runs.
    """
    for n in range(columns.shape[0]):
        for lane in range(runs):
            actors[hand_row, columns[n], lane] = actions[n, lane]


@leaf
def _run_span(
    first: IntArray,
    count: int,
    rate_hz: int,
    runs: int,
    settled_rad: float,
    pages: int,
    mode_word: int,
    addresses: IntArray,
    tables: IntArray,
    clock: Words,
    clock_addresses: IntArray,
    actions: Array,
    hand_row: int,
    columns: IntArray,
    actors: Array,
    states: Array,
    used: IntArray,
    received_columns: IntArray,
    table: Array,
    latest: IntArray,
    peaks: Words,
    present: EndedRuns,
    ended: EndedRuns,
) -> int:
    """Simulates several runs side by side for several ticks, each run at its own time.

    `run_block` does the same for runs that are all at the same time.

    Args:
        first: First tick of each run, shape (LANES,).
        count: Number of ticks.
        rate_hz: Tick rate of all sites, Hz.
        runs: Number of runs.
        settled_rad: Position error below which an arm counts as settled, rad.
        pages: Number of latest states stored per site, a power of two.
        mode_word: Index of the mode among the words of a site's row.
        addresses: Addresses of the code, see `run_block`.
        tables: Addresses of the tables, see `run_block`.
        clock: Buffer for the tick of each lane and its nominal time, shape (2, 1, LANES).
        clock_addresses: Addresses of both rows of `clock`.
        actions: Actions of the programs, shape (ticks, 5, LANES).
        hand_row: Row of the operator that the programs replace.
        columns: Words of an action in this row.
        actors: Rows of operators and environments; updated in place.
        states: The latest states of all sites, see `advance_site`.
        used: Samples in use, see `use_samples`.
        received_columns: Indices of the values that laws receive, shape (N, P, C).
        table: Tables of the operators and environments.
        latest: Zeros, shape (3, N), see `keep_ended_runs`: there is one bucket and one record.
        peaks: Buffer for the peaks of all sites in one bucket, which are not used.
        present: Current values of all runs.
        ended: Values of the runs in which an arm left its limits; updated in place.

    Returns:
        The number of runs in which no arm has left its limits.
    """
    running = runs
    lanes = (runs + 7) // 8 * 8
    for block_row in range(count):
        for lane in range(LANES):
            k = first[lane] + block_row
            clock[0, 0, lane] = k
            clock[1, 0, lane] = tick_ns(k, rate_hz)
        _put_actions(actions[block_row], hand_row, columns, actors, runs)
        for i in range(addresses.shape[0]):
            call_site(
                address=addresses[i],
                k=pointer_to(clock_addresses[0]),
                t_ns=pointer_to(clock_addresses[1]),
                lanes=lanes,
                settled_rad=settled_rad,
                i=i,
                block_row=block_row,
                pages=pages,
                bucket=0,
                record_row=0,
                tables=tables[i],
                states=states,
                used=used[i],
                columns=received_columns[i],
                table=table,
            )
        # The next tick.
        for lane in range(LANES):
            clock[0, 0, lane] += 1
        running = keep_ended_runs(
            ticks=clock[0, 0],
            runs=runs,
            mode_word=mode_word,
            latest=latest,
            peaks=peaks,
            present=present,
            ended=ended,
        )
        for lane in range(runs):
            if ended.ticks[lane] == clock[0, 0, lane]:
                copy_lane(lane, present.links, ended.links)
    return running


class LaneEpisodes(LaneRun):
    """Simulates the episodes of several training environments together.

    Each environment occupies a lane (an element of the vector registers), so that one
    instruction computes the same quantity for several environments. When an episode has ended,
    `load` puts a new run into its lane while the other lanes continue.

    Args:
        run: Any run before its first tick, see `explain_run`. All runs must have the same
            structure.
        count: Number of lanes that hold a run, at most `LANES`.
        hand_site: Index of the site whose arm is moved by a program.
        hand_row: Index of the live operator of that site among the operators of the site.
        period_ticks: Time between decisions of the program, ticks.

    Attributes:
        ticks: Number of ticks that each run has executed, shape (LANES,).
        hands: State of the program's hold on the arm, in each lane.
        structure: The common structure of the runs, see `RunStructure`.
        most_runs: Largest number of runs that can be simulated together.
        least_runs: Smallest number of runs that are simulated faster in lanes than one by one.
    """

    clock = _CLOCK
    most_runs = LANES
    least_runs = LEAST_RUNS

    def __init__(
        self, run: CompiledRun, count: int, *, hand_site: int, hand_row: int, period_ticks: int
    ) -> None:
        """Allocates the arrays for several episodes that are simulated side by side.

        An episode is one simulated run in which a program, for example a learning policy, moves
        an arm. All lanes initially hold copies of the same run, until `load` replaces them.
        """
        super().__init__([run] * count)
        self.structure = self.find_structure(run)
        self.ticks = np.zeros(LANES, np.int64)
        self._rate_hz = int(self._rates_hz[0])
        self.hands = SeveralHands(LANES, BLOCK_TICKS, self._rate_hz, period_ticks)
        self._hand_site = hand_site
        self._clock_words = allocate_words(2, 1)
        self._clock_addresses = np.array([row.ctypes.data for row in self._clock_words])
        most_sources = len(self._actors) // self._sites
        self._hand_row = hand_site * most_sources + hand_row
        action_words = [*find_words(self._layout.actor, "grip")]
        for name in ("a", "b"):
            action_words += [*find_words(self._layout.actor, name)][: SeveralHands.axes]
        self._action_words = np.array(action_words)
        self._used_before = np.full(self._used.shape[:3], -1)
        self._span_first = self.ticks.copy()
        self._widen_peaks(1)
        self._table_addresses = self._find_tables()

    @staticmethod
    def find_structure(run: CompiledRun) -> RunStructure:
        """Returns the properties that runs must share to be simulated side by side.

        Examples are the number of joints and the control laws. Durations may differ, because an
        episode that ends is replaced with a new one.
        """
        return RunStructure.find(run)._replace(duration_s=0.0)

    @staticmethod
    def explain_hand(rules: HandRules, period_ticks: int, largest_action: float) -> str:
        """Explains why a program's actions prevent several episodes from being run together.

        The program moves an arm. Simulating several episodes side by side is faster, but only
        possible for some kinds of actions. Returns an empty string if it is possible.

        Args:
            rules: Limits on the program's actions.
            period_ticks: Number of ticks per step.
            largest_action: Largest absolute value of any component of an action.
        """
        if period_ticks > BLOCK_TICKS:
            return f"steps of more than {BLOCK_TICKS} ticks"
        return SeveralHands.explain(rules, period_ticks, largest_action)

    @classmethod
    def explain_run(cls, run: CompiledRun, hand_site: int) -> str:
        """Explains why a run cannot be simulated side by side with others.

        Returns an empty string if it can. To find out, the method compiles the simulation code,
        which can take seconds.

        Args:
            run: The run before its first tick.
            hand_site: Index of the site whose arm is moved by a program.
        """
        obstacle = RunStructure.find_obstacle(run, hand_site=hand_site)
        if len(set(run.memory.tables.site["rate_hz"].ravel().tolist())) > 1:
            obstacle = obstacle or "tick rates that differ between sites"
        return obstacle or cls.explain_uncompilable(run)

    def load(self, lane: int, run: CompiledRun, rules: HandRules) -> None:
        """Starts a new reinforcement learning episode in the lane of one that has ended.

        The initial state of the new run is copied into the lane.

        Args:
            lane: Index of the lane.
            run: The run before its first tick, with the same structure as the others.
            rules: Limits on the program's actions, see `HandRules`.
        """
        memory = run.memory
        tables = memory.tables
        pairs: list[tuple[Words, NDArray[Any]]] = [
            (self._site, tables.site),
            (self._links, tables.links),
            (self._actors, tables.actors),
            (self._environments, tables.actors),
            (self._sums, memory.sums),
            (self._progress, memory.progress),
            (self._ramps, view_rows(tables.ramps)),
        ]
        for lane_words, rows in pairs:
            lane_words[:, :, lane] = read_words(rows.reshape(-1))
        if memory.laws is not None:
            self._laws[:, :, lane] = memory.laws.rows.view(np.int64)
            self._sent[:, :, lane] = memory.laws.sent.view(np.int64)
        self._received[:, :, lane] = 0

        self.ticks[lane] = 0
        self._ended.ticks[lane] = -1
        self._put_first_states(lane, tables)
        self._load_links(lane, run)
        self.hands.begin(lane, rules)
        self.runs[lane] = run

    def _load_links(self, lane: int, run: CompiledRun) -> None:
        """Copies the state of a run's simulated network links into a lane.

        The arrays shared by all lanes are enlarged if they are too small for the delay models
        of this run.

        Args:
            lane: Index of the lane.
            run: The run before its first tick.
        """
        tables = run.memory.tables
        links = self._deliveries
        pages = tables.calendars.shape[2]
        # `releases` is a ring buffer over the ticks. A sample sent in a block of ticks waits
        # for at most as many ticks as the calendar has pages.
        needed = 1 << (pages + BLOCK_TICKS).bit_length()
        old_room = links.releases.shape[3]
        if needed > old_room:
            releases = np.full((*links.releases.shape[:3], needed), -1)
            for other in range(len(self.runs)):
                due = np.arange(self.ticks[other], self.ticks[other] + old_room)
                releases[other, ..., due % needed] = links.releases[other, ..., due % old_room]
            links = links._replace(releases=releases)

        # The run may have more delay models, or more points of recorded delays, than any
        # previous run.
        models = tables.models.shape[2]
        if models > links.models.shape[3]:
            wider = np.zeros((*links.models.shape[:3], models), LINK_MODEL_DTYPE)
            wider[..., : links.models.shape[3]] = links.models
            links = links._replace(models=wider)
        points = len(tables.points)
        if points > links.points.shape[1]:
            more = np.zeros((len(links.points), points, 2), np.int64)
            more[:, : links.points.shape[1]] = links.points
            links = links._replace(points=more)

        links.links[lane] = tables.links
        links.models[lane, ..., :models] = tables.models
        links.points[lane, :points] = tables.points
        links.releases[lane] = -1
        links.newest[lane] = -1
        self._deliveries = links

    def advance(
        self,
        count: int,
        *,
        is_idle: NDArray[np.bool_],
        acts: NDArray[np.bool_],
        goals: Array,
        locate: Callable[[Array], Array],
    ) -> None:
        """Simulates all episodes for a number of ticks, applying their programs' decisions.

        A run ends if one of its arms leaves its limits.

        Args:
            count: Number of ticks, at most `BLOCK_TICKS`.
            is_idle: True for runs that are not advanced, shape (runs,). The state of such a run
                is meaningless afterwards, unless the run has ended.
            acts: True for runs in which a decision of the program takes effect at the first
                tick, shape (runs,).
            goals: The decisions that take effect, shape (runs, 2).
            locate: Function that maps joint angles, shape (runs, 2), to poses of the arm, shape
                (runs, 2), in the coordinates used by the program.
        """
        runs = len(self.runs)
        idle = np.ones(LANES, np.int64)
        idle[:runs] = is_idle | self.has_ended
        acting = np.zeros(LANES, np.int64)
        acting[:runs] = acts
        all_goals = np.zeros((LANES, SeveralHands.axes))
        all_goals[:runs] = goals
        poses = np.zeros_like(all_goals)
        begins = (acting != 0) & (self.hands.arrays.holds == 0) & (idle == 0)
        if begins.any():
            poses[:runs] = locate(self.read_site("q")[self._hand_site])
        self.hands.advance(
            runs,
            self.ticks,
            count,
            is_idle=idle,
            acts=acting,
            goals=all_goals,
            poses=poses,
        )
        self._step_span(count, idle)

    def _step_span(self, count: int, idle: IntArray) -> None:
        """Simulates all runs for several control periods, applying their programs' actions.

        Args:
            count: Number of ticks.
            idle: 1 for lanes that are not advanced.
        """
        span = np.maximum(self.ticks - 1 - self._span_first, 0)
        lanes = np.arange(LANES)
        self._used_before[:] = self._used[:, :, lanes, span]
        self._used_before[:, :, self.ticks == 0] = -1
        self._span_first[:] = self.ticks
        age = _use_samples_of_lanes(
            runs=len(self.runs),
            first=self.ticks,
            count=count,
            rate_hz=self._rate_hz,
            skipped=np.where(idle, 0, -1),
            states=self._deliveries,
            draws=self._draws,
            used=self._used,
        )
        self._keep_states(age)
        site_fields: Any = self._layout.site.fields
        _, mode_offset = site_fields["mode"]
        _run_span(
            first=self.ticks,
            count=count,
            rate_hz=self._rate_hz,
            runs=len(self.runs),
            settled_rad=self._structure.settled_rad,
            pages=self._pages,
            mode_word=mode_offset // 8,
            addresses=self._addresses,
            tables=self._table_addresses,
            clock=self._clock_words,
            clock_addresses=self._clock_addresses,
            actions=self.hands.actions,
            hand_row=self._hand_row,
            columns=self._action_words,
            actors=self._actors.view(np.float64),
            states=self._states,
            used=self._used,
            received_columns=self._columns,
            table=self._table,
            latest=np.zeros_like(self._latest),
            peaks=self._peaks,
            present=self._list_present(),
            ended=self._ended,
        )
        self.ticks[idle == 0] += count

    def _keep_states(self, ticks: int) -> None:
        """Enlarges the memory for past states of the sites, if necessary.

        Each lane has its own current tick.
        """
        while self._pages <= ticks:
            old_pages = self._pages
            self._pages *= 2
            states = np.zeros((self._sites, self._pages + 1, *self._states.shape[2:]))
            for lane in range(len(self.runs)):
                kept = np.arange(max(self.ticks[lane] - old_pages, 0), self.ticks[lane])
                states[:, kept % self._pages, lane] = self._states[:, kept % old_pages, lane]
            states[:, -1] = self._states[:, -1]
            self._states = states

    @property
    def has_ended(self) -> NDArray[np.bool_]:
        """True for each run that has ended because an arm left its safety limits.

        The array has shape (runs,).
        """
        return self._ended.ticks[: len(self.runs)] >= 0

    def read_site(self, name: str) -> NDArray[Any]:
        """Returns one quantity of all N sites in all runs.

        The array has shape (N, runs, elements). For "q", for example, the elements are the
        joint angles.

        Args:
            name: Name of the quantity, a field of `SiteRow`, for example "q".
        """
        dtype: Any = self._layout.site.fields[name][0]  # type: ignore[index]
        return self._read(self._site, self._ended.site_rows, self._layout.site, name, dtype)

    def read_links(self, name: str, i: int) -> NDArray[Any]:
        """Returns one quantity of the links on which site `i` receives, for all runs.

        The array has shape (P, runs, elements), for links from P peers.
        """
        dtype: Any = self._layout.link.fields[name][0]  # type: ignore[index]
        rows = slice(i * self._structure.peers, (i + 1) * self._structure.peers)
        return self._read(
            self._links[rows], self._ended.links[rows], self._layout.link, name, dtype
        )

    def _read(
        self,
        present: Words,
        ended: Words,
        layout: np.dtype[Any],
        name: str,
        dtype: np.dtype[Any],
    ) -> NDArray[Any]:
        """Returns one field of the state of all sites or links, for each run.

        For a run that has ended, the field is read from `ended`, because its lane no longer
        contains valid values.

        Args:
            present: Current rows of all lanes, shape (rows, values per row, LANES).
            ended: The same rows at the end of each run that has ended.
            layout: Data type of a row.
            name: Name of the field.
            dtype: Data type of the field.
        """
        word_range = find_words(layout, name)
        columns = slice(word_range.start, word_range.stop)
        runs = len(self.runs)
        numbers = present[:, columns, :runs]
        has_ended = self.has_ended
        if has_ended.any():
            numbers = np.where(has_ended, ended[:, columns, :runs], numbers)
        in_order = np.ascontiguousarray(numbers.transpose(0, 2, 1))
        return in_order.view(dtype.base)

    def read_new(self, i: int) -> NDArray[np.bool_]:
        """Returns True for each peer from which site `i` used a new sample in its latest tick.

        The array has shape (P, runs), for P peers.
        """
        runs = len(self.runs)
        lanes = np.arange(runs)
        ticks = np.where(self.has_ended, self._ended.ticks[:runs], self.ticks[:runs])
        row = np.maximum(ticks - 1 - self._span_first[:runs], 0)
        used = self._used[i][:, lanes, row]
        earlier = self._used[i][:, lanes, np.maximum(row - 1, 0)]
        before = np.where(row > 0, earlier, self._used_before[i][:, :runs])
        is_new: NDArray[np.bool_] = used > before
        return is_new

    def write_back(self, lane: int) -> None:
        """Copies the current state of a run into its `CompiledRun`, where callers read it.

        The run cannot continue alone from this state, because its simulated network links are
        still in their initial state.

        Args:
            lane: Index of the run among the runs that are simulated together.
        """
        memory = self.runs[lane].memory
        has_ended = bool(self.has_ended[lane])
        sites = self._ended.site_rows if has_ended else self._site
        links = self._ended.links if has_ended else self._links
        put_rows(memory.tables.site, sites[:, :, lane])
        put_rows(memory.tables.links, links[:, :, lane])
        if has_ended:
            last_ns = tick_ns(int(self._ended.ticks[lane]) - 1, self._rate_hz)
            memory.progress["diverged_ns"][0] = last_ns

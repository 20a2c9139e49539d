"""Simulates several sites in one compiled loop, given the setup of each site.

Ticks are not stored individually. The loop keeps the largest values in each 50 ms interval, and
sums over the whole run.

Invariant:
    - Two runs with the same setups may differ by a small perturbation.
      `CompiledRun.scale_difference` scales that difference in all floating-point values of the
      state. Values that are equal in both runs stay equal.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from ...errors import LawFailed
from ...records import NS_PER_S, Mode
from ..arms.exogenous import TorqueKind
from ..links.link_schedule import LinkSchedule
from ..plug.compiled_law import CompiledLaw, plug_law
from ..plug.law_view import PlainLaw
from .fused_run import (
    NEVER_NS,
    PROGRESS_DTYPE,
    LawArrays,
    RecentRecords,
    finish_site,
    run_until,
    sense_site,
    sums_dtype,
)
from .run_inputs import RunInputs
from .run_state import RunMemory, RunState
from .site_arrays import SiteArrays
from .site_setup import SiteSetup
from .ticks import BUCKETS_PER_S, PlantState, tick_ns
from .vectors import Array, IntArray, Row, RowArray


class _HandActor(Protocol):
    """Interface of a live operator in a compiled run.

    A live operator is a person or program that moves an arm while the run is in progress. The
    compiled loop requests the operator's actions for as many ticks in advance as possible,
    because leaving compiled code is slow.
    """

    def compute_actions(self, k: int, end: int, arrays: SiteArrays) -> Array:
        """Returns the operator's next actions: how firmly and where the operator pulls the arm.

        The actions start at tick `k`. They end before the first tick whose action depends on
        an arm state that has not been computed yet.

        Args:
            k: First tick.
            end: Tick before which the actions must end.
            arrays: State of the site before tick `k`.

        Returns:
            An array with one row per tick. The columns are the fields of `HandInForce`.
        """


class _Plant(Protocol):
    """Interface of a user's own program that computes the motion of an arm.

    Attributes:
        state: State of the arm in the next tick.
    """

    state: PlantState

    def move(self, tick: int, tau: Sequence[float]) -> None:
        """Moves the arm by one control period.

        Args:
            tick: Tick to compute.
            tau: Control torque ON the joints during this tick, in N m, shape (n,).
        """


class RunTotals(NamedTuple):
    """Summary statistics of a simulated run, as returned by `CompiledRun.totals`.

    Attributes:
        rms_error_rad: Root mean square over the run of the synchronisation error e, which is
            the difference between a joint angle and its reference, in rad. The value is that of
            the joint with the largest root mean square, among all joints of all sites.
        effort_nm: Root mean square of tau - G(q) over sites and joints, in N m, where tau is
            the control torque and G(q) the torque that compensates for gravity in pose q.
        force_peak_n: Largest force exerted by a wall on an arm, in N. None if there is no wall.
        walls_j: Work done on the arms by their environments (such as walls), in J. None if
            there is no environment.
    """

    rms_error_rad: float
    effort_nm: float
    force_peak_n: float | None
    walls_j: float | None


class CompiledRun:
    """A simulation that runs several arms and their control laws in one compiled loop.

    Control laws that can be compiled run inside the loop, and laws written in plain Python are
    called between the stages of a tick. The loop also pauses before each tick for which an
    operator's program needs the state of the arm, and after each tick of a site whose arm is
    moved by a user's program.

    Args:
        setups: Setups of all sites, in scenario order.
        first_environments: For each site, the index of its first environment among its torque
            sources, or -1 if it has none.
        duration_s: Duration of the whole run, in s.
        settled_rad: A site counts as settled while |e| is below this limit at every joint, in
            rad.
        keep: Number of recent records kept per site for `pop_records`.
        inputs: Inputs of a recorded run to repeat. If omitted, every sample arrives promptly.
        hands: Live operators, keyed by site index. Must be empty if `inputs` is given, because
            the inputs already contain the actions.
        plants: Users' programs that move external arms, keyed by site index.

    Attributes:
        layouts: Record layout of each site.
        rates_hz: Tick rate of each site, in Hz.
        duration_s: Duration of the whole run, in s.
        ran_s: Time up to which `advance_to` has simulated the run, in s.
        pending_deliveries: Function that brings the link state up to date if the run was
            advanced together with other runs. It is called before the run continues on its own.
    """

    def __init__(
        self,
        setups: Sequence[SiteSetup],
        *,
        first_environments: Sequence[int],
        duration_s: float,
        settled_rad: float = 0.01,
        keep: int = 0,
        inputs: RunInputs | None = None,
        hands: Mapping[int, _HandActor] = {},
        plants: Mapping[int, _Plant] = {},
    ) -> None:
        count = len(setups)
        self.duration_s = duration_s
        self.ran_s = 0.0
        self.pending_deliveries: Callable[[], None] | None = None
        self._settled_rad = settled_rad
        self._keep = keep
        self._hands = dict(hands)
        self._inputs = inputs or RunInputs.prompt(count).with_hands(setups, hands, ticks=0)
        self._changes = deque(self._inputs.changes)
        changes = [change for _, _, change in self._inputs.changes]
        self._tables = SiteArrays.stack(setups, changes, self._inputs.late_ns)
        self.layouts = [setup.layout for setup in setups]
        self.rates_hz = [setup.rate_hz for setup in setups]
        self._links = [setup.links for setup in setups]
        # The samples that each site uses in all ticks. They are computed on demand.
        self._used: dict[int, IntArray] = {}
        self._plug_laws(setups)
        self._progress: RowArray = np.zeros(count, PROGRESS_DTYPE)
        self._progress["rate_hz"] = self.rates_hz
        self._progress["unsettled_ns"] = -1
        self._progress["diverged_ns"] = -1
        self._next_samples = np.zeros((count, count - 1), dtype=np.int64)
        self._sent = self._allocate_records(keep)
        joints = max(max(layout.joints, layout.shared) for layout in self.layouts)
        self._peaks = np.full((count, 0, 3 * joints), -1.0)
        self._sums: RowArray = np.zeros(count, sums_dtype(joints))
        self._sums["first_environment"] = first_environments
        sources = [source for setup in setups for source in setup.actors]
        self._has_wall = any(source.kind == TorqueKind.WALL for source in sources)
        self._plants = dict(plants)
        self._torque_columns = {i: self.layouts[i].columns()["tau"] for i in plants}
        # For each site: the first tick that `pop_records` has not returned yet, the tick after
        # the last action of the operator, and the tick up to which the plant has moved.
        self._popped_ticks = [0] * count
        self._action_ends: dict[int, int] = {}
        self._plant_ticks = dict.fromkeys(plants, 0)
        self._selected: dict[int, SiteArrays] = {}

    def _allocate_records(self, keep: int) -> RecentRecords:
        """Allocates memory for the recent records of every site.

        A record must be kept until `pop_records` returns it, until the slowest peer has
        received it, and, in a repeated run, until the latest sample has arrived.

        Args:
            keep: Number of recent records per site that `pop_records` must be able to return.

        Returns:
            Ring buffers for at least the required number of records per site. Their length is a
            power of two, so that the compiled loop can find the position of a tick with a bit
            mask.
        """
        site_count = len(self.layouts)
        fastest_hz = max(self.rates_hz)
        # Ticks of the fastest site until the latest sample arrives, with a margin for rounding.
        late_ticks = self._inputs.late_ns * fastest_hz // NS_PER_S + 2
        slowest_hz = min(self.rates_hz)
        ticks_per_slow_tick = math.ceil(fastest_hz / slowest_hz)
        # The last tick of a slow site may be planned half of its period late, see `advance_to`.
        needed = max(2 * ticks_per_slow_tick + 1, keep, late_ticks)
        pages = 1 << needed.bit_length()  # the least power of two above `needed`
        floats = max(layout.floats for layout in self.layouts)
        return RecentRecords(
            t_ns=np.zeros((site_count, pages), dtype=np.int64),
            rows=np.zeros((site_count, pages, floats)),
        )

    def _plug_laws(self, setups: Sequence[SiteSetup]) -> None:
        """Creates the users' control laws, and connects them to the arrays of the run.

        A law that can be compiled is called inside the compiled loop. A law in plain Python is
        called between the stages of a tick. The laws are stored in `self._laws`, and the arrays
        needed by the compiled loop in `self._law_arrays`, which stays None if there are no user
        laws.

        Args:
            setups: Setups of the sites, in scenario order.
        """
        self._laws: dict[int, PlainLaw | CompiledLaw] = {}
        self._law_arrays: LawArrays | None = None
        # The arrays for values sent by laws exist only if a site has a user's law.
        has_user_laws = self._tables.channel is not None
        if not has_user_laws:
            return

        site_count = len(setups)
        most_sent_numbers = max(setup.channel.record_size for setup in setups)
        sent = np.zeros((site_count, most_sent_numbers))
        for i, setup in enumerate(setups):
            if setup.law_factory is not None:
                arrays = self._tables.select(i, setup.layout)
                law = setup.law_factory(setup.law_context())
                sent_by_law = sent[i, : setup.channel.record_size]
                self._laws[i] = plug_law(law, setup, arrays, sent_by_law)

        # The loop calls a compiled law by its address, with its gains and memory as a row of
        # one array.
        compiled = {i: law for i, law in self._laws.items() if isinstance(law, CompiledLaw)}
        addresses = np.zeros(site_count, dtype=np.int64)
        longest_row = max((len(law.row) for law in compiled.values()), default=0)
        rows = np.zeros((site_count, longest_row))
        for i, compiled_law in compiled.items():
            rows[i, : len(compiled_law.row)] = compiled_law.row
            # The law and the loop share the row, so that both see the same memory of the law.
            compiled_law.row = rows[i]
            addresses[i] = compiled_law.address
        self._law_arrays = LawArrays(addresses, rows, sent)

    @property
    def memory(self) -> RunMemory:
        """All arrays of the simulated run, as views that change while the run advances."""
        return RunMemory(
            tables=self._tables,
            progress=self._progress,
            next_samples=self._next_samples,
            sent=self._sent,
            peaks=self._peaks,
            sums=self._sums,
            settled_rad=self._settled_rad,
            laws=self._law_arrays,
            compiled_laws={
                i: law for i, law in self._laws.items() if isinstance(law, CompiledLaw)
            },
            has_plain_law=any(isinstance(law, PlainLaw) for law in self._laws.values()),
            feed=self._inputs.feed,
        )

    def _update_links(self) -> None:
        """Brings the link state up to date if the run was advanced together with other runs."""
        deliver = self.pending_deliveries
        self.pending_deliveries = None
        if deliver is not None:
            deliver()

    def step_to(self, last_ns: int) -> None:
        """Executes all planned ticks up to a given time, and applies the changes due by then.

        Does nothing if a site has diverged, meaning that its arm has left its limits.

        Args:
            last_ns: Time of the last tick to execute, in ns since the epoch (the common start
                time of the sites).

        Raises:
            LawFailed: A user's control law failed.
        """
        self._update_links()
        while self._changes and self.diverged_s is None:
            tick, i, change = self._changes[0]
            t_ns = tick_ns(tick, self.rates_hz[i])
            if t_ns > last_ns:
                break
            self._step_until(t_ns - 1)
            self.arrays(i).apply_change(change, t_ns)
            self._changes.popleft()
        if self.diverged_s is None:
            self._step_until(last_ns)

    def _step_until(self, last_ns: int) -> None:
        """Executes the planned ticks up to a given time, calling users' programs in between.

        The programs act as operators, or compute the motion of an arm (plants). A program needs
        the state of the arm at a certain time, so the compiled loop pauses before the tick at
        that time. Between pauses, it executes many ticks at once.

        Args:
            last_ns: Time of the last tick to execute, in ns since the epoch (the common start
                time of the sites).
        """
        while self.has_programs and self.diverged_s is None:
            # Both methods call a program if it is due, and return when it is due again.
            pauses_ns = [self._request_actions(i) for i in self._hands]
            pauses_ns += [self._move_plant(i) for i in self._plants]
            next_pause_ns = min(pauses_ns)
            if next_pause_ns > last_ns:
                break
            self._step_piece(next_pause_ns - 1)  # up to the last tick before the pause
        if self.diverged_s is None:
            self._step_piece(last_ns)
        # Plants advance their arms by the last tick, as all other arms did within the loop.
        for i in self._plants:
            self._move_plant(i)

    def _move_plant(self, i: int) -> int:
        """Calls a user's program to compute the motion of an arm in one control period.

        The program, called a plant, moves the arm once per tick, driven by the control torque
        of the last executed tick. The new state of the arm is copied to the arrays of the run,
        from which the next tick reads it.

        Args:
            i: Index of the site.

        Returns:
            Time before which the plant must move again, in ns since the epoch. `NEVER_NS` after
            the last tick.
        """
        next_tick = int(self._progress[i]["tick"])
        plant = self._plants[i]
        # If no tick was executed since the last call, the arm has already moved this far.
        has_new_torque = next_tick > self._plant_ticks[i]
        if has_new_torque:
            last_record = self._last_row(i)
            control_torque = last_record[self._torque_columns[i]]
            plant.move(next_tick - 1, control_torque.tolist())
        self._plant_ticks[i] = next_tick

        joints = self.layouts[i].joints
        site = self.arrays(i).site[0]
        site["q"][:joints] = plant.state.q
        site["qd"][:joints] = plant.state.qd
        # `tau_x` is subtracted in the equation of motion, whereas `sensed` is the torque ON the
        # arm. A plant that does not know the torque of contacts returns an empty tau_x.
        site["sensed"][:joints] = [-torque for torque in plant.state.tau_x] or 0.0

        has_finished = self._progress[i]["t_ns"] == NEVER_NS
        if has_finished:
            return NEVER_NS
        return tick_ns(next_tick + 1, self.rates_hz[i])

    def _request_actions(self, i: int) -> int:
        """Requests the next actions of an operator once the previous ones have been executed.

        The operator is a program that returns its actions for several ticks in advance. They
        are written to the inputs of the compiled loop.

        Args:
            i: Index of the site.

        Returns:
            Time at which the operator needs the state of the arm again, in ns since the epoch.
            `NEVER_NS` after the last tick.
        """
        progress = self._progress[i]
        if progress["t_ns"] == NEVER_NS:
            return NEVER_NS
        k = int(progress["tick"])
        if k >= self._action_ends.get(i, 0):
            end = int(progress["ticks"])
            actions = self._hands[i].compute_actions(k, end, self.arrays(i))
            self._inputs.write_actions(i, k, actions)
            self._action_ends[i] = k + len(actions)
        return tick_ns(self._action_ends[i], self.rates_hz[i])

    def _step_piece(self, last_ns: int) -> None:
        """Executes the planned ticks up to a time until which no operator or plant is needed.

        Control laws are still called. If a user's law is in plain Python, the loop over the
        ticks also runs in Python. Otherwise, the entire loop is compiled.

        Args:
            last_ns: Time of the last tick to execute, in ns since the epoch (the common start
                time of the sites).

        Raises:
            LawFailed: A user's control law failed.
        """
        compiled = [law for law in self._laws.values() if isinstance(law, CompiledLaw)]
        has_plain_law = len(compiled) < len(self._laws)
        try:
            if has_plain_law:
                self._run_plain_until(last_ns)
            else:
                run_until(
                    last_ns=last_ns,
                    settled_rad=self._settled_rad,
                    progress=self._progress,
                    next_samples=self._next_samples,
                    sent=self._sent,
                    feed=self._inputs.feed,
                    peaks=self._peaks,
                    sums=self._sums,
                    arrays=self._tables,
                    chains=self._tables.chain,
                    laws=self._law_arrays,
                )
        except LawFailed:
            raise
        except Exception as error:
            # A compiled law may raise any error. Each law knows whether it raised the error.
            failures = [law.find_failure(error) for law in compiled]
            law_failures = filter(None, failures)
            # An error that no law caused is raised unchanged.
            raise next(law_failures, error) from None

    def _run_plain_until(self, last_ns: int) -> None:
        """Executes ticks in a Python loop, because a control law is not compiled.

        The loop is equivalent to the compiled function `run_until`. Within each tick, the law
        is called after the measurements (`sense_site`) and before the motion (`finish_site`).

        Args:
            last_ns: Time of the last tick, in ns since the epoch.
        """
        progress = self._progress
        tables = self._tables
        while True:
            t_ns = int(progress["t_ns"].min())
            if t_ns > last_ns or t_ns == NEVER_NS:
                return
            for i in np.flatnonzero(progress["t_ns"] == t_ns).tolist():
                chain = self.arrays(i).chain
                sense_site(
                    i=i,
                    progress=progress,
                    next_samples=self._next_samples,
                    sent=self._sent,
                    feed=self._inputs.feed,
                    arrays=tables,
                    chain=chain,
                )
                law = self._laws.get(i)
                if isinstance(law, PlainLaw):
                    law.compute(int(progress[i]["tick"]), t_ns)
                mode = finish_site(
                    i=i,
                    settled_rad=self._settled_rad,
                    progress=progress,
                    sent=self._sent,
                    peaks=self._peaks,
                    sums=self._sums,
                    arrays=tables,
                    chain=chain,
                    laws=self._law_arrays,
                )
                if mode == Mode.DIVERGED:
                    # The other ticks at this time are still executed.
                    progress[i]["diverged_ns"] = t_ns
                    last_ns = t_ns

    def advance_to(self, until_s: float) -> None:
        """Continues the run up to the last tick of a run that lasts `until_s` seconds.

        Does nothing if the run is already past that tick, or if a site has diverged (its arm
        has left its limits).
        """
        if until_s <= self.ran_s or self.diverged_s is not None:
            return
        self.plan([max(1, round(until_s * rate_hz)) for rate_hz in self.rates_hz])
        self.step_to(round(until_s * NS_PER_S))
        self.ran_s = until_s if self.diverged_s is None else self.diverged_s

    def plan(self, ticks: Sequence[int]) -> None:
        """Sets the total number of ticks of each site, and allocates memory for them.

        Two arrays are enlarged without losing their contents: one with the largest values per
        50 ms interval (bucket), and one with the actions of live operators.

        Args:
            ticks: Total number of ticks per site, in scenario order, including ticks that have
                already been executed.
        """
        progress: Row
        for progress, planned_ticks in zip(self._progress, ticks, strict=True):
            progress.ticks = planned_ticks
            has_more_ticks = progress.tick < planned_ticks
            if has_more_ticks:
                # After its last planned tick, a site has the next time `NEVER_NS`.
                progress.t_ns = tick_ns(progress.tick, progress.rate_hz)

        pairs = zip(ticks, self.rates_hz, strict=True)
        longest_s = max(planned_ticks / rate_hz for planned_ticks, rate_hz in pairs)
        bucket_count = math.ceil(longest_s * BUCKETS_PER_S) + 1
        column_count = self._peaks.shape[2]
        # -1 marks a bucket in which no tick has been executed.
        peaks = np.full((len(ticks), bucket_count, column_count), -1.0)
        old_bucket_count = self._peaks.shape[1]
        peaks[:, :old_bucket_count] = self._peaks
        self._peaks = peaks

        if self._hands:
            self._inputs = self._inputs.with_ticks(max(ticks))

    @cached_property
    def _state(self) -> RunState:
        """State of the run, in a form that can be copied to another run."""
        tables = self._tables
        arrays = [self._progress, self._next_samples, *self._sent, self._sums]
        arrays += [array for array in tables if isinstance(array, np.ndarray)]
        if tables.channel is not None:
            arrays += tables.channel
        if self._law_arrays is not None:
            arrays += [self._law_arrays.rows, self._law_arrays.sent]
        return RunState(arrays)

    @property
    def has_programs(self) -> bool:
        """True if a user's own program acts as an operator or computes the motion of an arm.

        Such a run cannot be copied, because the state of the program is not part of the run's
        state.
        """
        return bool(self._hands or self._plants)

    @property
    def programmed_sites(self) -> set[int]:
        """Indices of the sites whose operator or arm is a user's own program.

        These programs are called from Python in every control period, which slows the run down.
        """
        return {*self._hands, *self._plants}

    def copy_state(self, other: "CompiledRun") -> None:
        """Overwrites the state of this run with an exact copy of the state of another run.

        Both runs must have the same scenario and the same planned control periods. The other
        run is not changed.
        """
        self.scale_difference(other, 0.0)

    def scale_difference(self, other: "CompiledRun", factor: float) -> None:
        """Multiplies the difference between the states of this run and another run by a factor.

        Every floating-point value x of the state becomes x_other + factor (x - x_other); see
        `RunState.scale_difference`. This is not possible if an operator or an arm is a user's
        program, because the state of the program is unknown.

        Args:
            other: The other run, which must have the same scenario and have reached the same
                time.
            factor: Scale factor applied to the difference.
        """
        assert not self.has_programs
        self._update_links()
        other._update_links()
        self._state.scale_difference(other._state, factor)
        self._changes = deque(other._changes)
        self._popped_ticks = list(other._popped_ticks)
        for i, law in self._laws.items():
            if isinstance(law, PlainLaw):
                memory = np.array(law.memory)
                other_memory = np.array(other._laws[i].memory)
                mixed = other_memory + factor * (memory - other_memory)
                law.restore(mixed.tolist())

    def arrays(self, i: int) -> SiteArrays:
        """Returns the state of one site before its next tick, as NumPy arrays.

        The arrays belong to the simulation and must not be modified.

        Args:
            i: Index of the site in scenario order.

        Returns:
            Views of the arrays, not copies.
        """
        self._update_links()
        if i not in self._selected:
            self._selected[i] = self._tables.select(i, self.layouts[i])
        return self._selected[i]

    def displace(self, field: str, offsets: Array) -> None:
        """Adds offsets to one field of the state of all sites, for example to the joint angles.

        This method applies the small perturbation to a twin (a repeat of the run).

        Args:
            field: Field name, for example "q" for the joint angles or "qd" for the velocities.
            offsets: Offsets to add, one row per site, shape (N, n), in the unit of the field.
        """
        self._tables.site[field][:, 0, : offsets.shape[1]] += offsets

    def measure_distance(self, other: "CompiledRun", field: str) -> float:
        """Returns the distance between this simulation and another in one field of their state.

        Args:
            other: Another run of the same scenario.
            field: Field name, for example "qd" for the joint velocities.

        Returns:
            The largest absolute difference over all sites and joints, in the unit of the field.
        """
        difference = self._tables.site[field] - other._tables.site[field]
        return float(np.abs(difference).max())

    def run_and_sample(self, until_s: float) -> tuple[Array, Array]:
        """Continues the simulation, and samples its state 100 times during the last quarter.

        Args:
            until_s: Time at which the run ends, in s.

        Returns:
            The joint angles q in rad, shape (100, N, n), and the estimated parameters
            theta_hat, shape (100, N, P), for N sites, n joints and P parameters.
        """
        q = []
        theta_hat = []
        for t_s in np.linspace(0.75 * until_s, until_s, 100):
            self.advance_to(float(t_s))
            q.append(self.q)
            theta_hat.append(self.theta_hat)
        return np.array(q), np.array(theta_hat)

    @property
    def diverged_s(self) -> float | None:
        """Time at which an arm first exceeded its safety limits, in s. None if no arm did."""
        ends_ns = [int(end_ns) for end_ns in self._progress["diverged_ns"] if end_ns >= 0]
        return min(ends_ns) / NS_PER_S if ends_ns else None

    @property
    def settled_s(self) -> float | None:
        """Time from which the synchronisation errors of all sites stay small, in s.

        The error e is the difference between the joint angles and their reference. It counts as
        small if |e| is below `settled_rad` at every joint. None if the limit is exceeded in the
        last tick.
        """
        last_site = int(np.argmax(self._progress["unsettled_ns"]))
        progress: Row = self._progress[last_site]
        if progress.unsettled_ns < 0:
            return 0.0
        if progress.unsettled_ns == tick_ns(progress.tick - 1, progress.rate_hz):
            return None
        return float(progress.unsettled_ns) / NS_PER_S

    @property
    def buckets(self) -> tuple[Array, ...]:
        """Largest errors and speeds in each 50 ms interval, as one array per site.

        Each array has shape (intervals, 3 n) for n joints. A row contains the largest
        synchronisation error |e| of each joint in rad, then the largest speed |qd| of each
        joint in rad/s, then the last angle q of each joint in rad. Intervals that contain no
        tick of the site are filled with -1. The last interval may be incomplete.
        """
        buckets = []
        for peaks, progress in zip(self._peaks, self._progress, strict=True):
            last_tick = int(progress["tick"]) - 1
            count = last_tick * BUCKETS_PER_S // int(progress["rate_hz"]) + 1
            buckets.append(peaks[:count])
        return tuple(buckets)

    @property
    def maxima(self) -> tuple[Array, ...]:
        """Largest error and speed of each arm in every 50 ms interval.

        There is one array per arm, of shape (intervals, 2). The columns are the largest
        synchronisation error |e| of any joint in rad, and the largest joint speed |qd| in
        rad/s.
        """
        return tuple(map(_max_over_joints, self.buckets))

    @property
    def totals(self) -> RunTotals:
        """Statistics of the run so far, such as the largest RMS error and the control effort.

        They also include the forces and work of walls and dampers. See `RunTotals` for
        definitions.
        """
        sums = self._sums
        ticks = self._progress["tick"].astype(np.float64)
        joints = self._tables.site["joints"][:, 0]
        mean_effort = np.mean(sums["effort"] / (joints * ticks))
        mean_errors = sums["errors"] / ticks[:, None]

        force_peak_n = None
        if self._has_wall:
            force_peak_n = float(sums["force_peak_n"].max())
        walls_j = None
        if (sums["first_environment"] >= 0).any():
            walls_j = float(sums["environment_j"].sum())
        return RunTotals(
            rms_error_rad=float(np.sqrt(mean_errors).max()),
            effort_nm=float(np.sqrt(mean_effort)),
            force_peak_n=force_peak_n,
            walls_j=walls_j,
        )

    @property
    def q(self) -> Array:
        """Joint angles of all arms after the last control period, in rad, shape (N, n).

        N is the number of sites, and n the number of joints per arm.
        """
        return np.array(self._tables.site["q"][:, 0])

    @property
    def theta_hat(self) -> Array:
        """Current arm parameter estimates of the adaptive control laws, shape (N, P).

        N is the number of sites, and P the number of parameters.
        """
        return np.array(self._tables.site["theta_hat"][:, 0])

    @property
    def memories(self) -> list[Array]:
        """Internal state of each user-written control law after the last tick.

        There is one array per site; the array of a site with a built-in law is empty.
        """
        memories = []
        for i in range(len(self._progress)):
            law = self._laws.get(i)
            memories.append(np.array([] if law is None else law.memory, dtype=np.float64))
        return memories

    @property
    def tau_x(self) -> list[Array]:
        """External torque on each arm in the last control period, in N m, excluding the motors.

        The torque comes from operators and environments. The list contains one array of shape
        (n,) per site, for n joints.
        """
        pairs = zip(self.records, self.layouts, strict=True)
        return [row[layout.columns()["tau_x"]] for row, layout in pairs]

    def pop_records(self) -> list[tuple[IntArray, Array]]:
        """Returns the records that each site has produced since the last call.

        Only the most recent records are kept (see `keep` in the constructor). Older ones are
        lost.

        Returns:
            For each site, the nominal times of the records in ns, shape (K,), and the records,
            shape (K, floats), with columns as in `Layout.columns`. K is 0 if there are no new
            records.
        """
        records = []
        pages = self._sent.t_ns.shape[1]
        for i, progress in enumerate(self._progress):
            stop = int(progress["tick"])
            first = max(self._popped_ticks[i], stop - pages)
            positions = np.arange(first, stop) % pages
            t_ns = self._sent.t_ns[i, positions]
            rows = self._sent.rows[i, positions, : self.layouts[i].floats]
            records.append((t_ns, rows))
            self._popped_ticks[i] = stop
        return records

    @property
    def is_finished(self) -> bool:
        """True if the run has reached the end of its scenario, or if an arm has diverged."""
        return self.ran_s >= self.duration_s or self.diverged_s is not None

    def find_batch_end(self) -> float:
        """Returns the time, in s, up to which the run may continue before its records are read.

        Until this time, no site produces more records than the run keeps (see `keep` in the
        constructor). The result never exceeds the duration of the scenario.
        """
        fastest_hz = max(self.rates_hz)
        return min(self.ran_s + (self._keep - 1) / fastest_hz, self.duration_s)

    def iterate_batches(self) -> Iterator[list[tuple[IntArray, Array]]]:
        """Simulates the scenario to its end, and yields all records batch by batch.

        Even a long run needs memory only for the latest `keep` records of each site. `keep`, an
        argument of the constructor, must be at least 2.

        Yields:
            The records since the previous batch, in the same form as `pop_records`.
        """
        while not self.is_finished:
            self.advance_to(self.find_batch_end())
            yield self.pop_records()

    def read_samples_in_use(self, i: int, count: int) -> IntArray:
        """Returns which samples a site used in its latest ticks, shape (count, peers).

        Which samples are used depends only on the link delays, so the result is recomputed
        instead of stored. The result is not valid for a run that repeats a log, in which
        samples arrive as recorded.

        Args:
            i: Index of the site.
            count: Number of ticks, at most the number of ticks executed.

        Returns:
            For each tick of the site, the ticks in which the peers sent the samples, or -1
            before the first sample of a peer.
        """
        stop = int(self._progress[i]["tick"])
        if i not in self._used or len(self._used[i]) < stop:
            duration_s = max(self.duration_s, self.ran_s)
            used = [
                LinkSchedule(link).draw_run(self.rates_hz[i], duration_s)
                for link in self._links[i]
            ]
            self._used[i] = np.stack(used, axis=1)
        return self._used[i][stop - count : stop]

    @property
    def records(self) -> Array:
        """Latest record of each site, one row per site, with columns as in `Layout.columns`."""
        return np.array([self._last_row(i) for i in range(len(self._progress))])

    def _last_row(self, i: int) -> Array:
        """Returns the last record of a site."""
        pages = self._sent.t_ns.shape[1]
        last_tick = int(self._progress[i]["tick"]) - 1
        row: Array = self._sent.rows[i, last_tick % pages]
        return row


def _max_over_joints(buckets: Array) -> Array:
    """Returns the largest position error and joint speed of an arm in each time interval.

    During the simulation, the largest values are kept per joint. They are combined here for a
    figure or table.

    Args:
        buckets: Statistics of an arm with n joints in K time intervals (buckets), as written by
            `run_until`, shape (K, 3 n). Each row consists of three groups of n columns, one
            column per joint: the largest position error |e| in rad, the largest joint speed
            |qd| in rad/s, and the last joint angle q in rad.

    Returns:
        The largest |e| in rad and the largest |qd| in rad/s over all joints, shape (K, 2).
    """
    joints = buckets.shape[1] // 3
    errors_and_speeds = buckets[:, : 2 * joints]
    by_quantity_and_joint = errors_and_speeds.reshape(-1, 2, joints)
    peaks: Array = by_quantity_and_joint.max(axis=2)
    return peaks

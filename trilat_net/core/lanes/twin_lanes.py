"""Simulates a run together with its twins, which are copies that start slightly displaced.

The distance between a run and its twins shows whether small perturbations grow (`twins`). The
run and its twins are computed at once, each in one lane of the vector registers. They all
receive the same samples at the same times, so the deliveries of the simulated network are
computed only once.

Invariant:
    - As long as no arm leaves its limits, states and records are bit-identical to those of
      `CompiledRun`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...records import NS_PER_S
from ..step.compiled_run import CompiledRun
from ..step.fused_run import ReplayedInputs
from ..step.run_state import RunState
from ..step.ticks import first_tick_at
from ..step.vectors import Array, IntArray
from .lane_deliveries import use_recorded_samples
from .lane_rows import LANES, Words
from .lane_run import LaneRun
from .lane_structure import RunStructure
from .run_groups import LEAST_RUNS


class TwinLanes(LaneRun):
    """A run and slightly displaced copies of it (twins), simulated side by side.

    The run itself is in lane 0.

    Args:
        run: The run before its first tick, see `suits`. Its state is copied, and this object
            itself is not advanced.
        count: Number of runs, including the twins.
        ticks: Number of ticks of each site in the whole run.
        feed: Inputs of the recorded run to repeat.
        kept: Number of records per site that are kept between two calls of `step_to`.
    """

    class EndedError(Exception):
        """Raised when a run and its displaced copies can no longer be simulated together.

        This happens when an arm has left its limits or a control law has failed. The caller
        then simulates the runs again, one by one.
        """

    @classmethod
    def suits(
        cls, run: CompiledRun, runs: int, ticks: Sequence[int], least_site_ticks: int
    ) -> bool:
        """Returns True if a run and its twins are computed faster together than one by one.

        Computing them together, with vector instructions, requires that all features of the
        scenario are supported. In addition, either the compiled code must already exist, or the
        runs must be long enough for compiling it to pay off.

        Args:
            run: The run before its first tick.
            runs: Number of runs, including the twins.
            ticks: Number of ticks of each site.
            least_site_ticks: Smallest number of simulated ticks, summed over all sites and
                runs, for which compiling the code pays off.
        """
        if not LEAST_RUNS <= runs <= LANES or RunStructure.find_obstacle(run):
            return False
        site_ticks = runs * sum(ticks)
        return site_ticks >= least_site_ticks or cls.has_stored_code(run)

    def __init__(
        self,
        run: CompiledRun,
        count: int,
        ticks: Sequence[int],
        feed: ReplayedInputs,
        kept: int,
    ) -> None:
        """Copies the initial state of a run into the arrays of the run and its twins.

        The twins will later be displaced slightly. If the system is unstable, their difference
        from the run grows.
        """
        super().__init__([run], 1 << kept.bit_length())
        self._count = count
        self._feed = feed
        # The run and its twins have the same initial state, which all lanes already contain.
        self.runs = [run] * count
        self._states[:] = self._states[:, :, :1]
        run.plan(ticks)
        self._widen_peaks(run.memory.peaks.shape[1])
        self._planned_ticks = np.array(ticks)
        self._last_ticks = self._ticks.copy()
        floats: list[tuple[Words, NDArray[np.bool_]]] = [
            (self._site, RunState.mark_floats(self._layout.site)),
            (self._links, RunState.mark_floats(self._layout.link)),
        ]
        of_laws = (self._laws, self._sent, self._received)
        floats += [(table, np.full(table.shape[1], True)) for table in of_laws]
        self._changing = floats

    def step_to(self, last_ns: int) -> None:
        """Continues a run and its displaced copies (twins) up to a given time, tick by tick.

        Args:
            last_ns: Time of the last tick to execute, ns since the epoch.

        Raises:
            EndedError: An arm left its limits, or a law failed.
        """
        self._last_ticks = self._ticks.copy()
        ticks = [first_tick_at(last_ns + 1, rate_hz) for rate_hz in self._rates_hz.tolist()]
        try:
            self._step_to(np.minimum(ticks, self._planned_ticks))
        except Exception as error:  # a law may raise any exception
            raise TwinLanes.EndedError from error
        if (self._ended.ticks[: self._count] >= 0).any():
            raise TwinLanes.EndedError

    def list_runs(self) -> "list[_LaneTwin]":
        """Returns the run, followed by its twins."""
        return [_LaneTwin(self, lane) for lane in range(self._count)]

    def _use_samples(self, end: IntArray) -> int:
        """Computes the samples in use in a block of ticks, which are the same for all runs."""
        if self._feed.first.shape[2] == 0:
            age = super()._use_samples(end)
        else:
            tables = self.runs[0].memory.tables
            age = use_recorded_samples(
                first=self._ticks,
                end=end,
                rates_hz=self._rates_hz,
                feed=self._feed,
                links=tables.links,
                models=tables.models,
                dues=tables.dues,
                calendars=tables.calendars,
                points=tables.points,
                channel=tables.channel,
                state=self._states[0, 0, 0],
                used=self._used,
            )
        # The number of runs is rounded up to complete vector registers of eight values.
        lanes = -(-self._count // 8) * 8
        self._used[:, :, 1:lanes] = self._used[:, :, :1]
        return age

    def read_times(self, i: int) -> IntArray:
        """Returns the times of site `i`'s ticks in the last call of `step_to`.

        The times are in ns since the common start of the sites.
        """
        # Same equation as in `tick_ns`.
        ticks = np.arange(self._last_ticks[i], self._ticks[i])
        times_ns: IntArray = ticks * NS_PER_S // self._rates_hz[i]
        return times_ns

    def read_records(self, i: int, columns: slice, runs: slice) -> Array:
        """Returns results of the control periods executed in the last call of `step_to`.

        Args:
            i: Index of the site.
            columns: Columns of the tick's record to return, see `Layout.columns`.
            runs: Runs to return. Run 0 is the run itself, and the others are its twins.

        Returns:
            The values, shape (ticks, columns, runs).
        """
        pages = np.arange(self._last_ticks[i], self._ticks[i]) % self._records.shape[1]
        records: Array = self._records[i, :, columns, runs].view(np.float64)[pages]
        return records


class _LaneTwin:
    """A run or a slightly displaced copy of it (twin), simulated side by side with others.

    It provides the methods of `CompiledRun` that are needed to measure how the displacement
    grows. Callers therefore do not need to know how the runs are simulated.

    Args:
        lanes: The run and its twins.
        lane: Lane of this run.
    """

    has_programs = False
    diverged_s = None

    def __init__(self, lanes: TwinLanes, lane: int) -> None:
        self._lanes = lanes
        self._lane = lane

    def copy_state(self, other: "_LaneTwin") -> None:
        """Overwrites the state of this run with an exact copy of the state of another run.

        The other run must belong to the same simulation. Both runs then produce the same
        results until one of them is displaced.
        """
        self.scale_difference(other, 0.0)

    def scale_difference(self, other: "_LaneTwin", factor: float) -> None:
        """Multiplies the difference between the states of this run and another run by a factor.

        Every floating-point value x of the state becomes x_other + factor (x - x_other), as in
        `CompiledRun.scale_difference`. This includes states in transit on the network.

        Args:
            other: The other run, simulated together with this one.
            factor: Scale factor.
        """
        lanes = self._lanes
        for table, is_float in lanes._changing:
            floats = np.broadcast_to(is_float, table.shape[:2])
            _scale(table[:, :, self._lane], table[:, :, other._lane], floats, factor)
        states = lanes._states.view(np.int64)
        mine = states[:, :, self._lane]
        _scale(mine, states[:, :, other._lane], np.full(mine.shape, True), factor)

    def displace(self, field: str, offsets: Array) -> None:
        """Adds small offsets to one field of the state of all sites, such as the angles "q".

        Stability is judged by how the resulting difference grows. For the shape of the offsets,
        see `CompiledRun.displace`.
        """
        columns = self._find_columns(field)
        field_words = slice(columns.start, columns.start + offsets.shape[1])
        self._lanes._site.view(np.float64)[:, field_words, self._lane] += offsets

    def measure_distance(self, other: "_LaneTwin", field: str) -> float:
        """Returns the largest absolute difference of one field, such as "q", between two runs.

        For the fields and their units, see `CompiledRun.measure_distance`.
        """
        numbers = self._lanes._site.view(np.float64)[:, self._find_columns(field)]
        difference = numbers[:, :, self._lane] - numbers[:, :, other._lane]
        return float(np.abs(difference).max())

    def _find_columns(self, field: str) -> slice:
        """Returns the indices of a field's values among all values of a site's row."""
        fields: Any = self._lanes._layout.site.fields
        dtype, offset, *_ = fields[field]
        return slice(offset // 8, (offset + dtype.itemsize) // 8)


def _scale(mine: Words, others: Words, is_float: NDArray[np.bool_], factor: float) -> None:
    """Moves the state of one run closer to that of another run, or away from it.

    Every floating-point value x becomes x_other + factor (x - x_other). All other values are
    copied from the other run.

    Args:
        mine: Values of the run to change, as integers with the same bits.
        others: The same values from the other run.
        is_float: True for the floating-point values.
        factor: Scale factor.
    """
    bits = mine.copy()
    mine[:] = others
    if factor == 0.0:
        return
    changed = (bits != others) & is_float
    x = bits[changed].view(np.float64)
    y = others[changed].view(np.float64)
    mine[changed] = RunState.scale_differences(x, y, factor).view(np.int64)

"""Simulates many runs as fast as possible: together with vector instructions, or one by one.

Parameter sweeps and tuning pass all their runs to `RunGroup.divide`. Runs with equal structure
form groups, which are computed in lanes of the vector registers. All other runs are computed
alone. Callers do not need to know which runs are computed together:

    for group in RunGroup.divide(runs):
        group.advance_to(10.0)

Invariant:
    - The results of a run do not depend on the other runs.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence

from ..step.compiled_run import CompiledRun
from .lane_rows import LANES
from .lane_run import LaneRun
from .lane_structure import RunStructure

LEAST_RUNS = 4
"""Smallest number of runs that are simulated faster in lanes than one by one."""


LANE_SITE_TICKS = 100_000_000
"""Least number of site ticks for which a study compiles the code for side-by-side runs.

Compilation takes about ten seconds per type of site. The code then saves about 0.4 us per site
tick.
"""


class RunGroup:
    """Several simulations that advance together, using vector instructions where possible.

    Where this is not possible, the simulations are computed one after another.

    Args:
        members: Indices of the runs in the sequence that was divided into groups.
        runs: The runs before their first tick.
        in_lanes: True to compute them together, each in a lane of the vector registers. They
            must have the same structure.
        obstacle: Property that prevents computing the runs together. Empty if there is none.
        record_rows: Number of latest records kept per site, a power of two.

    Attributes:
        members: Indices of the runs that remain in the group.
        obstacle: The obstacle passed to the constructor.
    """

    def __init__(
        self,
        members: Sequence[int],
        runs: Sequence[CompiledRun],
        *,
        in_lanes: bool,
        obstacle: str = "",
        record_rows: int = 1,
    ) -> None:
        self.members = list(members)
        self.obstacle = obstacle
        self._runs = list(runs)
        self._lanes = LaneRun(runs, record_rows) if in_lanes else None

    def advance_to(self, until_s: float) -> None:
        """Continues the runs of the group up to a given time. May be called repeatedly.

        Args:
            until_s: The time, s, later than in the previous call.
        """
        if self._lanes is not None:
            try:
                self._lanes.advance_to(until_s)
            except Exception:
                # The law of one run failed, which aborted the tick for all runs. Each run still
                # has its state from the previous call. When they are computed one by one, only
                # the run whose law fails ends.
                self._lanes = None
            else:
                return
        for run in self._runs:
            run.advance_to(until_s)

    def keep(self, chosen: Sequence[int]) -> None:
        """Drops all runs except the given ones.

        A search for the best gains, for example, saves time by dropping runs that are already
        worse than others.

        Args:
            chosen: Indices in `members` of the runs that continue, in ascending order. No arm
                of these runs may have left its limits.
        """
        if self._lanes is not None:
            self._lanes.keep(chosen)
        self.members = [self.members[position] for position in chosen]
        self._runs = [self._runs[position] for position in chosen]

    @staticmethod
    def divide(runs: Sequence[CompiledRun], record_rows: int = 1) -> "Iterator[RunGroup]":
        """Divides runs into groups of runs that can be simulated together.

        Runs that differ only in numerical values, such as gains, are in the same group. A run
        that must be computed alone forms its own group.

        Args:
            runs: The runs before their first tick.
            record_rows: Number of ticks whose records are kept for `CompiledRun.pop_records`
                after each call of `RunGroup.advance_to`, a power of two.

        Yields:
            The groups. Each group is created only when the caller is done with the previous
            one.
        """
        groups: dict[RunStructure, list[int]] = {}
        for index, run in enumerate(runs):
            obstacle = RunStructure.find_obstacle(run)
            if obstacle:
                yield RunGroup([index], [run], in_lanes=False, obstacle=obstacle)
            else:
                groups.setdefault(RunStructure.find(run), []).append(index)

        # A group contains at most as many runs as the vector code has lanes.
        for indices in groups.values():
            for first in range(0, len(indices), LANES):
                members = indices[first : first + LANES]
                chosen = [runs[index] for index in members]
                obstacle = ""
                if len(members) >= LEAST_RUNS:
                    obstacle = LaneRun.explain_uncompilable(chosen[0])
                    if not obstacle:
                        yield RunGroup(members, chosen, in_lanes=True, record_rows=record_rows)
                        continue
                for index, run in zip(members, chosen, strict=True):
                    yield RunGroup([index], [run], in_lanes=False, obstacle=obstacle)

    @staticmethod
    def prepare_lanes(
        make_run: Callable[[], CompiledRun],
        runs: int,
        least_site_ticks: float = LANE_SITE_TICKS,
    ) -> bool:
        """Decides whether a study computes its runs together, and compiles the code if so.

        Runs are computed together, with vector instructions, if the compiled code already
        exists, or if they are long enough for compiling it to pay off.

        Args:
            make_run: Function that returns one of the runs before its first tick.
            runs: Number of runs with this structure.
            least_site_ticks: Smallest number of simulated ticks, summed over all sites and
                runs, for which compiling the code pays off. Infinity to use existing code only.
        """
        probes = [make_run() for _ in range(LEAST_RUNS)]
        site_ticks = runs * probes[0].duration_s * sum(probes[0].rates_hz)
        if runs < LEAST_RUNS or RunStructure.find_obstacle(probes[0]):
            return False
        if site_ticks < least_site_ticks and not LaneRun.has_stored_code(probes[0]):
            return False
        for group in RunGroup.divide(probes):
            group.advance_to(1.0 / max(probes[0].rates_hz))
        return True

    @staticmethod
    def describe_structure(run: CompiledRun) -> Hashable:
        """Returns a key for sorting runs into groups that can be simulated side by side.

        The key is equal for runs that differ only in numerical values, such as gains.

        Args:
            run: The run before its first tick.

        Returns:
            The structure of the run, or, if the run must be computed alone, the reason for
            that.
        """
        return RunStructure.find_obstacle(run) or RunStructure.find(run)

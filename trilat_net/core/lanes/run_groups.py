"""Simulates many runs as fast as possible: together with vector instructions, or one by one.

Parameter sweeps and tuning call `RunGroup.divide` with all their runs. Runs with equal
structure form groups, which are computed in lanes of the vector registers. All other runs are
computed alone. The caller need not know which runs were computed together:

    for group in RunGroup.divide(runs):
        group.advance_to(10.0)

Invariant:
    - The numbers of a run do not depend on the other runs.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence

from ..step.compiled_run import CompiledRun
from .lane_rows import LANES
from .lane_run import LaneRun, explain_uncompilable, has_lane_code
from .lane_structure import RunStructure, find_obstacle

LEAST_RUNS = 4
"""Number of runs from which lanes are faster than one run after the other."""


LANE_SITE_TICKS = 100_000_000
"""Number of site ticks from which a study compiles the code for several runs side by side.

The compilation takes about ten seconds per kind of site. The code then saves about 0.4 us per
site tick.
"""


class RunGroup:
    """Several simulations that advance together, by vector instructions where possible.

    Otherwise they are computed one after the other.

    Args:
        members: Indices of the runs in the sequence that was divided into groups.
        runs: The runs before their first tick (control period).
        in_lanes: True to compute them together, each in a lane of the vector registers. They
            must have the same structure.
        obstacle: Property that prevents computing the runs together. Empty if nothing does.
        record_rows: Number of latest records of each site (arm controller) that are kept, a
            power of two.

    Attributes:
        members: Indices of the runs that are left in the group.
        obstacle: The value of the argument.
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
        """Continues the simulated runs of the group up to a time. Repeated calls are allowed.

        Args:
            until_s: The time, s, later than that of the previous call.
        """
        if self._lanes is not None:
            try:
                self._lanes.advance_to(until_s)
            except Exception:
                # The law of one run failed, which ended the tick of all runs. Each run still
                # has the state of the previous call. Computed one by one, only the run whose
                # law fails ends.
                self._lanes = None
            else:
                return
        for run in self._runs:
            run.advance_to(until_s)

    def keep(self, chosen: Sequence[int]) -> None:
        """Continues with some of the runs only, so that no time is spent on other runs.

        A search for the best gains, for example, drops runs that are already worse than others.

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
        """Divides runs into groups, each of which can be simulated together.

        Runs that differ in numbers only, such as gains, are in the same group. A run that must
        be computed alone gets a group of its own.

        Args:
            runs: The runs before their first tick (control period).
            record_rows: Number of ticks whose records (results of control periods) are kept for
                `CompiledRun.pop_records` after each call of `RunGroup.advance_to`, a power of
                two.

        Yields:
            The groups. Each group is created when the work on the previous group has ended.
        """
        groups: dict[RunStructure, list[int]] = {}
        for index, run in enumerate(runs):
            obstacle = find_obstacle(run)
            if obstacle:
                yield RunGroup([index], [run], in_lanes=False, obstacle=obstacle)
            else:
                groups.setdefault(RunStructure.find(run), []).append(index)

        # A group has at most as many runs as the vector code has lanes.
        for indices in groups.values():
            for first in range(0, len(indices), LANES):
                members = indices[first : first + LANES]
                chosen = [runs[index] for index in members]
                obstacle = ""
                if len(members) >= LEAST_RUNS:
                    obstacle = explain_uncompilable(chosen[0])
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
        """Decides whether a study computes its runs together, and then compiles the code.

        Runs are computed together, with vector instructions, if the code exists already, or if
        they are so long that compiling it pays off.

        Args:
            make_run: Function that returns one of the runs before its first tick.
            runs: Number of runs with this structure.
            least_site_ticks: Number of simulated ticks (control periods), summed over all sites
                (arm controllers) and runs, from which compiling the code pays off. Infinity
                uses existing code only.
        """
        probes = [make_run() for _ in range(LEAST_RUNS)]
        site_ticks = runs * probes[0].duration_s * sum(probes[0].rates_hz)
        if runs < LEAST_RUNS or find_obstacle(probes[0]):
            return False
        if site_ticks < least_site_ticks and not has_lane_code(probes[0]):
            return False
        for group in RunGroup.divide(probes):
            group.advance_to(1.0 / max(probes[0].rates_hz))
        return True

    @staticmethod
    def describe_structure(run: CompiledRun) -> Hashable:
        """Returns a key for sorting runs into groups that can be simulated side by side.

        The key is equal for runs that differ in numbers only, such as gains.

        Args:
            run: The run before its first tick.

        Returns:
            The structure of the run. If the run must be computed alone, the reason for this.
        """
        return find_obstacle(run) or RunStructure.find(run)

"""Decides which runs of a study are computed side by side, and reports the others.

Runs that differ only in numerical parameters are computed together with vector instructions,
see `trilat_net.core.RunGroup`. A study passes one scenario per kind of run to `prepare_kinds`,
which compiles the code if there are enough runs to make this worthwhile. After the runs,
`describe_runs_alone` reports those that were computed one by one.
"""

from collections.abc import Hashable, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

from trilat_net.errors import TrilatError, count_nouns
from trilat_net.scenario import Scenario

K = TypeVar("K", bound=Hashable)

LANE_SITE_TICKS = 100_000_000
"""Smallest number of site ticks for which a study compiles the code for side-by-side runs.

The compilation takes about ten seconds per kind of site, after which the code saves about 0.4
us per site tick.
"""


class RunKind(NamedTuple):
    """Runs of a study that should differ only in numerical parameters, such as the seed.

    Attributes:
        scenario: Scenario of one of the runs.
        runs: Number of runs of this kind.
    """

    scenario: Scenario
    runs: int

    @property
    def site_ticks(self) -> float:
        """Total number of ticks over all sites and runs."""
        rates_hz = [spec.rate_hz for spec in self.scenario.sites.values()]
        return self.runs * self.scenario.duration_s * sum(rates_hz)


def prepare_kinds(kinds: Mapping[K, RunKind]) -> dict[K, str]:
    """Chooses the kinds of runs to compute side by side, and compiles the code for them.

    If the code has not been compiled before, a kind is chosen only if its runs are long enough
    in total to make the compilation worthwhile.

    The result also contains kinds that cannot be computed side by side, so that the study can
    report the reason. They are included if their runs would have been long enough, or if
    another kind is computed side by side.

    Args:
        kinds: Kinds of runs, under arbitrary keys.

    Returns:
        An empty string for each chosen kind. For each kind that cannot be computed side by
        side, the reason why its runs are computed one by one.
    """
    several = {key: kind for key, kind in kinds.items() if kind.runs > 1}
    if not several:
        return {}
    # A study of single runs must not load the code of lanes.
    from trilat_net.core import RunGroup
    from trilat_net.execution import FusedRun

    prepared: dict[K, str] = {}
    obstacles: dict[K, str] = {}
    for key, kind in several.items():
        try:
            if RunGroup.prepare_lanes(
                partial(FusedRun, kind.scenario), kind.runs, LANE_SITE_TICKS
            ):
                prepared[key] = ""
                continue
            structure = RunGroup.describe_structure(FusedRun(kind.scenario))
        except TrilatError:
            continue  # the run itself reports the error
        if isinstance(structure, str):
            obstacles[key] = structure
    for key, obstacle in obstacles.items():
        if prepared or several[key].site_ticks >= LANE_SITE_TICKS:
            prepared[key] = obstacle
    return prepared


def describe_runs_alone(reasons: Mapping[str, int], run_count: int) -> str:
    """Returns a sentence that states how many runs were not computed side by side, and why.

    Args:
        reasons: Maps each reason why runs were computed alone to the number of these runs.
        run_count: Number of all runs of the study.

    Returns:
        The sentence, or an empty string if all runs were computed side by side.
    """
    if not reasons:
        return ""
    all_runs = count_nouns(run_count, "run")
    texts = ", ".join(f"{reason} ({count})" for reason, count in reasons.items())
    return f"{sum(reasons.values())} of {all_runs} were computed one by one: {texts}"

"""Decides which runs of a study are computed side by side, and reports those that were not.

Runs that differ in numbers only share the vector instructions of the processor, see
`trilat_net.core.group_runs`. A study passes a scenario of each kind of run to
`prepare_kinds`, which compiles the code where the number of runs is worth it. After the runs,
`describe_runs_alone` names those that were computed one by one.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

from trilat_net.errors import TrilatError, count_nouns
from trilat_net.scenario import Scenario

K = TypeVar("K", bound=Hashable)

LANE_SITE_TICKS = 100_000_000
"""Number of site ticks from which a study compiles the code for several runs side by side.

The compilation takes some ten seconds per kind of site. The code then saves about 0.4 us per
site tick.
"""


class RunKind(NamedTuple):
    """Runs of a study whose scenarios probably differ in numbers only, such as the seed.

    Attributes:
        scenario: Scenario of one of the runs.
        runs: Number of the runs.
    """

    scenario: Scenario
    runs: int

    @property
    def site_ticks(self) -> float:
        """Number of ticks of all sites in all runs."""
        rates_hz = [spec.rate_hz for spec in self.scenario.sites.values()]
        return self.runs * self.scenario.duration_s * sum(rates_hz)


def prepare_kinds(kinds: Mapping[K, RunKind]) -> dict[K, str]:
    """Chooses the kinds of runs to compute side by side, and compiles the code for them.

    The runs must be long enough for the compilation, unless the code exists. Runs that cannot
    be computed side by side are chosen too, so that the study reports the reason, if they are
    that long or if other runs of the study are computed side by side.

    Args:
        kinds: Kinds of runs, by any keys.

    Returns:
        For each chosen kind the property because of which its runs are computed one by one
        nevertheless, or an empty text.
    """
    several = {key: kind for key, kind in kinds.items() if kind.runs > 1}
    if not several:
        return {}
    # A study of single runs must not load the code of lanes.
    from trilat_net.core import describe_structure, prepare_lanes
    from trilat_net.execution import FusedRun

    prepared: dict[K, str] = {}
    obstacles: dict[K, str] = {}
    for key, kind in several.items():
        try:
            if prepare_lanes(partial(FusedRun, kind.scenario), kind.runs, LANE_SITE_TICKS):
                prepared[key] = ""
                continue
            structure = describe_structure(FusedRun(kind.scenario))
        except TrilatError:
            continue  # the run itself reports the error
        if isinstance(structure, str):
            obstacles[key] = structure
    for key, obstacle in obstacles.items():
        if prepared or several[key].site_ticks >= LANE_SITE_TICKS:
            prepared[key] = obstacle
    return prepared


def describe_runs_alone(reasons: Mapping[str, int], run_count: int) -> str:
    """Returns a sentence on runs that were not computed side by side, and why.

    Args:
        reasons: Reasons why runs were computed alone, with the number of these runs.
        run_count: Number of all runs of the study.

    Returns:
        The numbers of these runs and of all runs, and the reasons. Empty if there are none.
    """
    if not reasons:
        return ""
    all_runs = count_nouns(run_count, "run")
    texts = ", ".join(f"{reason} ({count})" for reason, count in reasons.items())
    return f"{sum(reasons.values())} of {all_runs} were computed one by one: {texts}"


def count_reasons(obstacles: Iterable[str]) -> Counter[str]:
    """Counts the reasons why runs were computed alone. An empty text is no reason."""
    return Counter(filter(None, obstacles))

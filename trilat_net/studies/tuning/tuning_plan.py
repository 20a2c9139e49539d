"""The tuning procedure: the plan, its cost, the search that every control law gets, and the
Pareto front.

Invariant: the result is a function of the plan alone; neither the number of processes nor their
speed enters. The gains tried are a function of the seed, the search space and the scores of
earlier rounds; their number is the budget. Half is a Latin hypercube in the logarithm of the
gains (McKay, Beckman and Conover, Technometrics 21, 1979), half refinement of its front. Both
objectives, error and effort, are minimised, only stable runs at the pose compete, and of equal
ones the first stays. The gains that the paper prints are measured, never searched, and stand on
no front.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ...core.jit import is_core_cached
from ...core.vectors import Array
from ...errors import ScenarioError, UsageError, count_nouns
from ...execution.fused import FusedRun
from ...net.clock import SystemClock
from ...process import count_cores
from ...results import Result
from ...scenario import Scenario
from ...scenario.imported_code import name_law_classes
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from . import search_space
from .candidate import (
    CLASS_MEANINGS,
    CandidateClass,
    CandidateScore,
    TuningScenario,
    build_candidate_item,
    build_twin,
    check_comparable,
    load_tuning_scenario,
    measure_candidate,
    measure_candidate_task,
)
from .search_space import SearchSpace

ObjectivePoint = tuple[float, float]


class Objective(StrEnum):
    """What is weighed against effort."""

    ERROR = "error"
    SETTLING = "settling"

    @property
    def unit(self) -> str:
        """Its unit."""
        return "rad" if self is Objective.ERROR else "s"

    def point(self, score: CandidateScore) -> ObjectivePoint | None:
        """Returns (objective, effort) of a run that may stand on a front, else None."""
        value = score.error_rad if self is Objective.ERROR else score.settled_s
        if (
            score.outcome is not CandidateClass.SETTLED
            or value is None
            or score.effort_nm is None
        ):
            return None
        return value, score.effort_nm


def find_pareto_front(points: Sequence[ObjectivePoint | None]) -> list[int]:
    """Returns the places of the points that none dominates, by rising effort; None does not
    compete.
    """
    order = sorted(
        (point[1], point[0], n) for n, point in enumerate(points) if point is not None
    )
    kept: list[int] = []
    least = float("inf")
    for _, value, n in order:
        if value < least:
            kept.append(n)
            least = value
    return kept


def compute_crowding(points: Sequence[ObjectivePoint]) -> list[float]:
    """Returns how alone each point of a front is: the side of the box between its neighbours;
    ends: inf.

    After Deb, Pratap, Agarwal and Meyarivan, "A fast and elitist multiobjective genetic
    algorithm: NSGA-II", IEEE Trans. Evolutionary Computation 6 (2002).
    """
    if len(points) < 3:
        return [float("inf")] * len(points)
    spans = [abs(points[-1][axis] - points[0][axis]) or 1.0 for axis in (0, 1)]
    inner = [
        sum(abs(after[axis] - before[axis]) / spans[axis] for axis in (0, 1))
        for before, after in zip(points[:-2], points[2:], strict=True)
    ]
    return [float("inf"), *inner, float("inf")]


REFINEMENT_STEPS = (0.12, 0.08, 0.05, 0.03)
"""Deviation of the refinements, round by round, as a share of the logarithm of a gain's range.
"""
GAIN_DIGITS = 4
"""Gains are rounded to so many significant digits before they are tried, so that a command can
name them.
"""

CandidateGains = dict[str, float]


class CandidateSearch:
    """One law's search, and what it found.

    Attributes:
        tried: the gains that were tried, in order.
        scores: what came of them, in the same order.
        rounds: how many candidates each round has; the budget in all.
    """

    def __init__(
        self, space: SearchSpace, budget: int, seed: int, objective: Objective
    ) -> None:
        self.space = space
        self.tried: list[CandidateGains] = []
        self.scores: list[CandidateScore] = []
        self._objective = objective
        self._rng = np.random.default_rng(seed)  # the same for every law
        self._logs = np.log([[knob.low, knob.high] for knob in space.knobs])
        first = (budget + 1) // 2
        count = len(REFINEMENT_STEPS)
        share, more = divmod(budget - first, count)
        self.rounds = [first, *(share + (n < more) for n in range(count))]

    @property
    def points(self) -> list[ObjectivePoint | None]:
        """(objective, effort) of every candidate; None of one that may stand on no front."""
        return [self._objective.point(score) for score in self.scores]

    @property
    def front(self) -> list[int]:
        """Places of the candidates that none of the same law dominates, by rising effort."""
        return find_pareto_front(self.points)

    @property
    def outcomes(self) -> dict[CandidateClass, int]:
        """How many candidates are of each class, all of them counted."""
        return {
            outcome: sum(score.outcome is outcome for score in self.scores)
            for outcome in CandidateClass
        }

    def ask(self, number: int) -> list[CandidateGains]:
        """Returns the candidates of a round; `tell` has taken all earlier ones."""
        shape = self.rounds[number], len(self.space.knobs)
        if number == 0:
            # takes half a second, which most commands can do without
            from scipy.stats import (
                qmc,
            )

            places = qmc.LatinHypercube(shape[1], rng=self._rng).random(shape[0])
        else:
            parents = self._parents(shape[0])
            moved = parents + REFINEMENT_STEPS[number - 1] * self._rng.standard_normal(shape)
            places = np.clip(moved, 0.0, 1.0)
        return [self._gains(place) for place in places]

    def tell(self, gains: Sequence[CandidateGains], scores: Sequence[CandidateScore]) -> None:
        """Takes what came of a round's candidates."""
        self.tried += gains
        self.scores += scores

    def _parents(self, count: int) -> Array:
        """Returns places to refine: every other time the best, else the loneliest points of the
        front.

        Where nothing settled yet, those that erred least without diverging; where all diverged,
        anything.
        """
        points = self.points
        places = self.front
        if places:
            lonely = compute_crowding([points[n] or (0.0, 0.0) for n in places])
            by_space = [
                n
                for _, n in sorted(zip(lonely, places, strict=True), key=lambda pair: -pair[0])
            ]
            best = places[-1]
        else:
            errors = [
                (s.outcome is CandidateClass.DIVERGED, s.error_rad or 0.0) for s in self.scores
            ]
            by_space = sorted(range(len(errors)), key=errors.__getitem__)
            best = by_space[0]
            by_space = by_space[: max(1, count // 4)]
        chosen = [
            best if k % 2 == 0 else by_space[k // 2 % len(by_space)] for k in range(count)
        ]
        tried = [[self.tried[n][knob.name] for knob in self.space.knobs] for n in chosen]
        logs = np.log(np.reshape(tried, (count, len(self.space.knobs))))
        parents: Array = (logs - self._logs[:, 0]) / (self._logs[:, 1] - self._logs[:, 0])
        return parents

    def _gains(self, place: Array) -> CandidateGains:
        logs = self._logs[:, 0] + place * (self._logs[:, 1] - self._logs[:, 0])
        return {
            knob.name: min(max(float(f"{np.exp(log):.{GAIN_DIGITS}g}"), knob.low), knob.high)
            for knob, log in zip(self.space.knobs, logs, strict=True)
        }


DEFAULT_BUDGET = 64
"""Candidates per law: four laws on `free` take some minutes on two cores."""
MAX_BUDGET = 100_000
MAX_TUNING_SEEDS = 1000
MAX_TICKS = 10_000_000
"""Ticks of all sites that one candidate may take; a run of a minute at 1 kHz with three sites
has 180 000.
"""


class PaperGainsResult(NamedTuple):
    """The gains that the paper prints, measured."""

    name: str
    candidate: TuningScenario
    score: CandidateScore


class TuningPlan(NamedTuple):
    """A comparison that can be run: `budget` candidates per law, `seed` of the search.

    `others` is the experiment with further seeds: of each candidate the mean over all seeds
    counts.
    """

    base: TuningScenario
    spaces: list[search_space.SearchSpace]
    budget: int
    seed: int
    objective: Objective
    knowledge: search_space.ModelInformation
    others: tuple[TuningScenario, ...] = ()

    @property
    def runs(self) -> int:
        """How many runs it takes, those with printed gains and twins counted."""
        candidates = len(self.spaces) * self.budget + len(self.printed(self.base))
        return candidates * (1 + self.twin) * (1 + len(self.others))

    @property
    def twin(self) -> bool:
        """True if the pose is measured on a twin: then every candidate is two runs."""
        return build_twin(self.base.scenario) is not None

    def printed(self, base: TuningScenario) -> dict[str, TuningScenario]:
        """Returns the gains that the paper prints, by name, with the common information and
        without.
        """
        told = search_space.SEARCH_SPACES["adaptive"].controls(
            base.scenario, self.knowledge, search_space.PAPER_GAINS
        )
        untold = {name: {**table, "theta_hat0": 0.0} for name, table in told.items()}
        controls = {"as printed": told, "as printed, told nothing": untold}
        return {name: base.with_controls(tables) for name, tables in controls.items()}

    def estimate_s(self, jobs: int | None = None) -> float:
        """Returns about how long the search will take, s: by a short run of the experiment."""
        scenario = self.base.scenario
        brief_s = min(scenario.duration_s, _PROBE_S)
        brief = msgspec.structs.replace(scenario, duration_s=brief_s).text
        measure_candidate(brief, None)  # loads the compiled core
        clock = SystemClock()
        began_ns = clock.monotonic_ns()
        measure_candidate(brief, None)
        run_s = (clock.monotonic_ns() - began_ns) * 1e-9 * scenario.duration_s / brief_s
        return run_s * self.runs / min(jobs or count_cores(), len(self.spaces) * self.budget)

    def run(
        self, jobs: int | None = None, progress: Progress = ignore_progress, on: Workers = None
    ) -> "TuningResult":
        """Searches every law and returns what was found.

        Raises:
            RunFailed: a candidate ended its workers, or the cluster is gone.
        """
        searches = [
            CandidateSearch(space, self.budget, self.seed, self.objective)
            for space in self.spaces
        ]
        bases = (self.base, *self.others)
        printed = list(map(self.printed, bases))
        measured: list[CandidateScore] = []
        total = len(searches) * self.budget + len(printed[0])
        done = 0

        def show(more: int, _: int) -> None:
            progress(done + more, total)

        if not is_core_cached():
            FusedRun(self.base.scenario).advance_to(
                _PROBE_S
            )  # compiles, once for all processes
        with open_worker_pool(jobs, on, most=total) as pool:
            for number in range(len(searches[0].rounds)):
                asked = [search.ask(number) for search in searches]
                tasks = [
                    build_candidate_item(
                        [base.with_gains(search.space, self.knowledge, one) for base in bases]
                    )
                    for search, batch in zip(searches, asked, strict=True)
                    for one in batch
                ]
                if number == 0:
                    tasks += [
                        build_candidate_item([of[name] for of in printed])
                        for name in printed[0]
                    ]
                scores = iter(pool.map(measure_candidate_task, tasks, show))
                done += len(tasks)
                for search, batch in zip(searches, asked, strict=True):
                    search.tell(batch, [next(scores) for _ in batch])
                measured += scores
        paper = [
            PaperGainsResult(*one, score)
            for one, score in zip(printed[0].items(), measured, strict=True)
        ]
        return TuningResult(self, searches, paper)


_EDGE = 1.02
"""A gain within 2 % of the end of its range is at its edge."""
_PROBE_S = 2.0
"""Duration of the run by which a search is estimated, s."""


@dataclass(frozen=True, repr=False)
class TuningResult(Result):
    """A comparison that was run; laws in the order in which they were asked for."""

    plan: TuningPlan
    found: list[CandidateSearch]
    printed: list[PaperGainsResult]

    def blocks(self) -> Iterator[Any]:
        """Yields its text."""
        from .tuning_report import compose_tuning

        return compose_tuning(self)

    def headline(self) -> str:
        """Returns which laws were compared in which scenario."""
        fronts = ", ".join(f"{one.space.law} {len(one.front)}" for one in self.found)
        return f"{self.plan.base.scenario.name}: points on the front: {fronts}"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat compare --tune --json`."""
        asked = self.plan
        base = self.plan.base
        scenario = base.scenario
        weights = search_space.weigh_joints(base.scenario)
        return {
            "scenario": {
                "source": base.source,
                "overrides": list(base.overrides),
                "name": scenario.name,
                "seed": scenario.seed,
                "sites": len(scenario.names),
                "duration_s": scenario.duration_s,
                "tau_limit_nm": {
                    name: spec.limits.tau_limit_nm for name, spec in scenario.sites.items()
                },
            },
            "procedure": {
                "candidates_per_law": asked.budget,
                "seed": asked.seed,
                "seeds": 1 + len(asked.others),
                "latin_hypercube": (asked.budget + 1) // 2,
                "refining_steps": list(REFINEMENT_STEPS),
                "runs": asked.runs,
                "twin": asked.twin,
                "objective": asked.objective.value,
                "objective_unit": asked.objective.unit,
                "gravity_told": asked.knowledge.gravity,
                "knowledge": asked.knowledge.text,
                "box": asked.knowledge.box,
                **({"joint_weights": weights} if weights else {}),
                "outcomes": {outcome.value: text for outcome, text in CLASS_MEANINGS.items()},
            },
            "laws": {found.space.law: self._describe_law(found) for found in self.found},
            "as_printed": [
                {
                    "name": one.name,
                    **msgspec.to_builtins(one.score),
                    "command": one.candidate.command,
                }
                for one in self.printed
            ],
        }

    def _describe_law(self, found: CandidateSearch) -> dict[str, Any]:
        tried = [
            {"gains": gains, **msgspec.to_builtins(score)}
            for gains, score in zip(found.tried, found.scores, strict=True)
        ]
        shared = self.shared(found)
        return {
            "told": found.space.told,
            "searched": [knob._asdict() for knob in found.space.knobs],
            "outcomes": {outcome.value: count for outcome, count in found.outcomes.items()},
            "front": [
                {
                    "candidate": place,
                    **tried[place],
                    "on_the_front_of_all": place in shared,
                    "command": self.candidate(found, place).command,
                }
                for place in found.front
            ],
            "candidates": tried,
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per candidate."""
        laws = self.to_dict()["laws"].items()
        return [
            {
                "law": law,
                **{key: value for key, value in one.items() if key != "gains"},
                **one["gains"],
            }
            for law, found in laws
            for one in found["candidates"]
        ]

    def candidate(self, found: CandidateSearch, place: int) -> TuningScenario:
        """Returns one candidate as an experiment."""
        return self.plan.base.with_gains(found.space, self.plan.knowledge, found.tried[place])

    def at_edge(self, found: CandidateSearch) -> list[str]:
        """Returns which gains of a law's best point stand at an edge of their range: it may lie
        beyond.
        """
        if not found.front:
            return []
        best = found.tried[found.front[-1]]
        return [
            knob.name
            for knob in found.space.knobs
            if not knob.low * _EDGE < best[knob.name] < knob.high / _EDGE
        ]

    def shared(self, found: CandidateSearch) -> list[int]:
        """Returns the places of a law's front that no candidate of any law dominates."""
        points = [
            (other.space.law, place, points[place])
            for other in self.found
            for points in [other.points]
            for place in other.front
        ]
        kept = [points[n] for n in find_pareto_front([point for _, _, point in points])]
        return [place for law, place, _ in kept if law == found.space.law]


def plan_tuning(
    source: str | Path | Mapping[str, Any] | Scenario,
    overrides: Sequence[str] = (),
    *,
    laws: Sequence[str | type] = (),
    budget: int = DEFAULT_BUDGET,
    seed: int = 1,
    objective: str = "error",
    gravity_percent: float = 100.0,
    seeds: int = 1,
) -> TuningPlan:
    """Returns a comparison, checked and ready to run; overrides are texts KEY=VALUE.

    The other arguments are those of `trilat_net.tune`: seeds of the scenario are those from its
    own on.

    Raises:
        ScenarioError: the scenario is none, or laws cannot be compared in it.
        UsageError: another argument cannot be right.
    """
    if not 1 <= budget <= MAX_BUDGET:
        raise UsageError(
            f"--budget is the number of candidates per law, 1 to {MAX_BUDGET}, not {budget}"
        )
    if not 0 <= seed < 2**63:
        raise UsageError(f"--seed is from 0 to 2^63 - 1, not {seed}")
    if objective not in list(Objective):
        raise UsageError(f"--objective is {' or '.join(Objective)}, not {objective!r}")
    if not 1 <= seeds <= MAX_TUNING_SEEDS:
        raise UsageError(
            f"--seeds is how many runs each candidate has, 1 to {MAX_TUNING_SEEDS}, not {seeds}"
        )
    knowledge = search_space.build_model_information(gravity_percent)
    found = load_tuning_scenario(source, overrides)
    scenario = found.scenario
    spaces = search_space.select_search_spaces(
        [name_law_classes(law) for law in laws], scenario
    )
    ticks = sum(map(scenario.ticks, scenario.names))
    if ticks > MAX_TICKS:
        problem = (
            f"a candidate would take {count_nouns(ticks, 'tick')}, at most "
            f"{MAX_TICKS} are given: shorten it with --duration"
        )
        raise ScenarioError(problem, path="duration_s", source=found.source)
    check_comparable(scenario)
    more = range(scenario.seed + 1, scenario.seed + seeds) if scenario.random else ()
    others = tuple(load_tuning_scenario(source, (*overrides, f"seed={one}")) for one in more)
    return TuningPlan(
        base=found,
        spaces=spaces,
        budget=budget,
        seed=seed,
        objective=Objective(objective),
        knowledge=knowledge,
        others=others,
    )

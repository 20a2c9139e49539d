"""Tunes the gains of several control laws and finds the best trade-offs of each.

Two objectives are minimised: the error, and the effort of the motors. The result for a law is
its Pareto front: the gains for which no other gains of the law are better in both. The laws can
then be compared fairly, because the same number of candidates was tried for each.

The first half of the candidates is a Latin hypercube, an evenly spread random sample, in the
logarithms of the gains (McKay, Beckman and Conover, Technometrics 21, 1979). The second half
refines the law's own front, in four rounds with decreasing step sizes.

Invariant:
    - The result depends only on the plan, not on the number of processes or on their speed.
    - The candidates depend only on the seed, the search space and the scores of earlier rounds.
    - Only stable runs that end at the common pose of the arms can be on a front. Of two runs
      with equal objectives, the first is kept.
    - The gains printed in the paper are measured, but do not take part in the search and belong
      to no front.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.core import Array, is_core_cached
from trilat_net.errors import ScenarioError, UsageError, count_nouns
from trilat_net.execution import FusedRun
from trilat_net.net import SystemClock
from trilat_net.own_code import name_law_classes
from trilat_net.results import Result
from trilat_net.scenario import Scenario, parse_embedded
from trilat_net.work import Progress, WorkerPool, Workers

from ..side_by_side import RunKind, prepare_kinds
from .candidate import (
    CLASS_MEANINGS,
    LANE_RUNS,
    CandidateClass,
    CandidateItem,
    CandidateScore,
    TuningScenario,
    build_twin,
    check_comparable,
)
from .search_space import (
    PAPER_GAINS,
    SEARCH_SPACES,
    ModelInformation,
    SearchSpace,
    weigh_joints,
)

ObjectivePoint = tuple[float, float]
"""Objective and effort of a run. The objective is the error or the settling time."""


class Objective(StrEnum):
    """Quantity to minimise in addition to the motor effort: error or settling time.

    Both usually conflict with the effort: a smaller error needs larger torques.
    """

    ERROR = "error"
    SETTLING = "settling"

    @property
    def unit(self) -> str:
        """Unit of the objective in tables and on axes: rad for an error, s for a time."""
        return "rad" if self is Objective.ERROR else "s"

    def point(self, score: CandidateScore) -> ObjectivePoint | None:
        """Returns the objective (error or time) and the motor effort of a candidate.

        The Pareto front consists of the candidates for which no other candidate is at least as
        good in both.

        Args:
            score: Score of the candidate.

        Returns:
            The objective and the effort. `None` if the candidate is excluded from the Pareto
            front because it is unstable, or because it does not end at the pose that all
            candidates must reach.
        """
        value = score.error_rad if self is Objective.ERROR else score.settled_s
        if score.outcome is not CandidateClass.SETTLED:
            return None
        if value is None or score.effort_nm is None:
            return None
        return value, score.effort_nm


def find_pareto_front(points: Sequence[ObjectivePoint | None]) -> list[int]:
    """Returns the indices of the points on the Pareto front, in order of increasing effort.

    A point is on the front if no other point is at least as good in both objectives.

    Args:
        points: The points. `None` represents a run that is excluded from the front.
    """
    competitors = []
    for index, point in enumerate(points):
        if point is not None:
            value, effort_nm = point
            competitors.append((effort_nm, value, index))
    # In the order of rising effort, only points with a smaller objective are not dominated.
    front = list[int]()
    least_value = float("inf")
    for _, value, index in sorted(competitors):
        if value < least_value:
            front.append(index)
            least_value = value
    return front


def compute_crowding(points: Sequence[ObjectivePoint]) -> list[float]:
    """Computes how isolated each point of a front is, to find gaps that should be filled.

    The crowding distance of a point is half the perimeter of the box between its two
    neighbours, with each side relative to the span of the front. It is infinite for the first
    and the last point. Source: Deb, Pratap, Agarwal and Meyarivan, "A fast and elitist
    multiobjective genetic algorithm: NSGA-II", IEEE Trans. Evolutionary Computation 6 (2002).

    Args:
        points: Points of the front, in order of increasing effort.

    Returns:
        The crowding distance of each point. Larger values mean more isolated points.
    """
    if len(points) < 3:
        return [float("inf")] * len(points)
    value_span = abs(points[-1][0] - points[0][0]) or 1.0
    effort_span = abs(points[-1][1] - points[0][1]) or 1.0
    distances = [float("inf")]
    for before, after in zip(points[:-2], points[2:], strict=True):
        value_side = abs(after[0] - before[0]) / value_span
        effort_side = abs(after[1] - before[1]) / effort_span
        distances.append(value_side + effort_side)
    distances.append(float("inf"))
    return distances


REFINEMENT_STEPS = (0.12, 0.08, 0.05, 0.03)
"""Standard deviation of the steps in each refinement round, as a fraction of a gain's range on
a logarithmic scale.
"""
GAIN_DIGITS = 4
"""Number of significant digits to which gains are rounded before a run, which keeps commands
short.
"""

CandidateGains = dict[str, float]
"""Mapping from gain name to value, for one candidate."""


class CandidateSearch:
    """Search for the best gains of one control law, in several rounds.

    A candidate is one choice of gains. In each round, the caller runs the candidates returned
    by `propose_candidates` and passes their scores to `record_scores`. The result is the law's
    Pareto front, which contains the best trade-offs between objective and effort.

    Args:
        space: The law and the ranges of its gains.
        budget: Number of candidates.
        seed: Random seed, which is the same for every law.
        objective: Objective besides the effort.

    Attributes:
        tried: Gains of all candidates that have run, in order.
        scores: Scores of these candidates, in the same order.
        rounds: Number of candidates in each round. They add up to the budget.
    """

    def __init__(
        self, space: SearchSpace, budget: int, seed: int, objective: Objective
    ) -> None:
        self.space = space
        self.tried: list[CandidateGains] = []
        self.scores: list[CandidateScore] = []
        self._objective = objective
        self._rng = np.random.default_rng(seed)

        log_bounds = np.log([[knob.low, knob.high] for knob in space.knobs])
        self._log_low = log_bounds[:, 0]
        self._log_range = log_bounds[:, 1] - log_bounds[:, 0]

        sampled = (budget + 1) // 2
        refinements = len(REFINEMENT_STEPS)
        per_round, remainder = divmod(budget - sampled, refinements)
        self.rounds = [sampled]
        for n in range(refinements):
            takes_one_more = n < remainder  # the first rounds take the remainder
            self.rounds.append(per_round + takes_one_more)

    @property
    def points(self) -> list[ObjectivePoint | None]:
        """Objective and effort of each candidate that was tried, in order of execution.

        The objective is the error, in rad, or the settling time, in s. The effort is the RMS
        motor torque excluding gravity, in N m. `None` stands for a candidate that is excluded
        from the front, because the arms were not stable or did not end at the common pose.
        """
        return [self._objective.point(score) for score in self.scores]

    @property
    def front(self) -> list[int]:
        """Indices in `tried` of the candidates on the law's Pareto front, by increasing effort.

        No other candidate of the law is at least as good in both the objective (error or
        settling time) and the effort (RMS motor torque excluding gravity).
        """
        return find_pareto_front(self.points)

    @property
    def front_points(self) -> list[ObjectivePoint]:
        """Objective and effort of the candidates on the Pareto front, by increasing effort.

        The objective is the error, in rad, or the settling time, in s. The effort is the RMS
        motor torque excluding gravity, in N m.
        """
        points = self.points
        front_points = []
        for index in self.front:
            point = points[index]
            if point is not None:
                front_points.append(point)
        return front_points

    @property
    def outcomes(self) -> dict[CandidateClass, int]:
        """Number of candidates in each class, such as settled or diverged.

        The class states how well the arms behaved, see `CandidateClass`.
        """
        counts = Counter(score.outcome for score in self.scores)
        return {outcome: counts[outcome] for outcome in CandidateClass}

    def propose_candidates(self, round_number: int) -> list[CandidateGains]:
        """Returns the candidates to try in a round.

        The first round is a Latin hypercube, which spreads its candidates evenly over the
        ranges of the gains. Later rounds refine the best candidates so far, and require that
        the scores of all earlier rounds have been recorded.

        Args:
            round_number: 0 for the Latin hypercube, and 1 to 4 for the refinement rounds.
        """
        shape = (self.rounds[round_number], len(self.space.knobs))
        if round_number == 0:
            # Imported here, because SciPy costs half a second and most commands do not need it.
            from scipy.stats import qmc

            count, dimensions = shape
            positions = qmc.LatinHypercube(dimensions, rng=self._rng).random(count)
        else:
            parents = self._select_parents(shape[0])
            deviation = REFINEMENT_STEPS[round_number - 1]
            steps = deviation * self._rng.standard_normal(shape)
            positions = np.clip(parents + steps, 0.0, 1.0)
        return [self._compute_gains(position) for position in positions]

    def record_scores(
        self, gains: Sequence[CandidateGains], scores: Sequence[CandidateScore]
    ) -> None:
        """Stores the scores of candidates, on which the next proposals are based.

        Args:
            gains: The candidates that were run.
            scores: Their scores, in the same order.
        """
        self.tried += gains
        self.scores += scores

    def _select_parents(self, count: int) -> Array:
        """Selects the candidates that a refinement round varies.

        Every other parent is the best candidate. The others are taken in turn from the ranking
        of `_rank_candidates`.

        Args:
            count: Number of parents.

        Returns:
            Their positions in the search space, shape (count, gains), with coordinates in [0,
            1].
        """
        best, ranked = self._rank_candidates(count)
        parents = []
        for parent_number in range(count):
            index = best
            if parent_number % 2 == 1:
                # the ranking starts again when it is used up
                rank = parent_number // 2 % len(ranked)
                index = ranked[rank]
            gains = self.tried[index]
            parents.append([gains[knob.name] for knob in self.space.knobs])

        # Position 0 is the least value of a gain, and position 1 the largest.
        logs = np.log(np.reshape(parents, (count, len(self.space.knobs))))
        positions: Array = (logs - self._log_low) / self._log_range
        return positions

    def _rank_candidates(self, count: int) -> tuple[int, list[int]]:
        """Ranks the candidates that are worth refining.

        If there is a front, the best candidate is the one with the smallest objective, and the
        most isolated points of the front come first. Otherwise, candidates are ordered by
        error, followed by those that diverged, and only some of them are kept.

        Args:
            count: Number of candidates in the round. If there is no front, a quarter of this
                number is kept.

        Returns:
            The index of the best candidate, and the indices of the ranked candidates.
        """
        front = self.front
        if front:
            distances = compute_crowding(self.front_points)
            crowding = dict(zip(front, distances, strict=True))
            ranked = sorted(front, key=lambda index: -crowding[index])
            return front[-1], ranked
        keys = []
        for score in self.scores:
            diverged = score.outcome is CandidateClass.DIVERGED
            keys.append((diverged, score.error_rad or 0.0))
        ranked = sorted(range(len(keys)), key=keys.__getitem__)
        return ranked[0], ranked[: max(1, count // 4)]

    def _compute_gains(self, position: Array) -> CandidateGains:
        """Returns the gains at a position in the search space, rounded and within their ranges.

        Args:
            position: Position on the logarithmic scale of each range, shape (gains,), with
                coordinates in [0, 1].
        """
        logs = self._log_low + position * self._log_range
        gains = {}
        for knob, log in zip(self.space.knobs, logs, strict=True):
            value = float(f"{np.exp(log):.{GAIN_DIGITS}g}")
            gains[knob.name] = min(max(value, knob.low), knob.high)
        return gains


DEFAULT_BUDGET = 64
"""Default number of candidates per law. Four laws on `free` take a few minutes on two cores."""
MAX_BUDGET = 100_000
"""Largest number of candidates per law."""
MAX_TUNING_SEEDS = 1000
"""Largest number of seeds per candidate."""
MAX_TICKS = 10_000_000
"""Largest number of ticks of a candidate, over all sites. A run of a minute with three sites at
1 kHz has 180 000 ticks.
"""
_PROBE_S = 2.0
"""Duration of the run from which the duration of a search is estimated, in s."""


class _PaperGainsResult(NamedTuple):
    """Score of the published gains of the adaptive law, in the scenario of a comparison.

    These gains are printed in the paper that introduced the law. The score shows how much
    tuning improves on them.

    Attributes:
        name: Name of the variant, such as "as printed".
        candidate: Scenario with these gains.
        score: Error, effort and class of the run.
    """

    name: str
    candidate: TuningScenario
    score: CandidateScore


class TuningPlan(NamedTuple):
    """A comparison of control laws with tuned gains, ready to run.

    `plan_tuning` creates and checks this object. `run` executes the searches.

    Attributes:
        base: Scenario in which the laws are compared.
        spaces: The laws with their search spaces.
        budget: Number of candidates per law.
        seed: Random seed of the search.
        objective: Objective besides the effort.
        knowledge: Information about the arm model that is available to all laws.
        others: The scenario with further seeds. The score of a candidate is the mean over all
            seeds.
    """

    base: TuningScenario
    spaces: list[SearchSpace]
    budget: int
    seed: int
    objective: Objective
    knowledge: ModelInformation
    others: tuple[TuningScenario, ...] = ()

    @property
    def runs(self) -> int:
        """Number of all simulated runs of the comparison.

        The number includes the runs with the published gains and the additional runs that find
        the final pose of the arms in some scenarios.
        """
        paper_candidates = len(self.build_paper_scenarios(self.base))
        candidates = len(self.spaces) * self.budget + paper_candidates
        seeds = 1 + len(self.others)
        runs_per_seed = 2 if self.twin else 1
        return candidates * seeds * runs_per_seed

    @property
    def twin(self) -> bool:
        """True if every candidate needs a second run to find the final pose.

        This is the case if the scenario has walls, or operators who push the arms without a
        target pose. They keep the arms away from the pose at which the arms would rest
        undisturbed, so the second run excludes them.
        """
        return build_twin(self.base.scenario) is not None

    def build_paper_scenarios(self, base: TuningScenario) -> dict[str, TuningScenario]:
        """Returns the scenario with the published gains of the adaptive law, in two variants.

        The gains are those printed in the paper that introduced the law. In the first variant,
        the law gets the same gravity parameters as all compared laws. In the second, it gets no
        information about the arm.

        Args:
            base: The scenario.

        Returns:
            The scenarios, by the name of the variant.
        """
        space = SEARCH_SPACES["adaptive"]
        informed = space.controls(base.scenario, self.knowledge, PAPER_GAINS)
        uninformed = {site: {**table, "theta_hat0": 0.0} for site, table in informed.items()}
        return {
            "as printed": base.with_controls(informed),
            "as printed, told nothing": base.with_controls(uninformed),
        }

    def estimate_s(self, jobs: int | None = None) -> float:
        """Estimates from a short simulation how long the tuning will take, in s of real time.

        Args:
            jobs: Number of worker processes. If `None`, one per core.
        """
        scenario = self.base.scenario
        probe_s = min(scenario.duration_s, _PROBE_S)
        probe = msgspec.structs.replace(scenario, duration_s=probe_s).text
        # The first run loads the compiled kernel, so that the loading is not timed.
        CandidateScore.measure(probe, None)
        clock = SystemClock()
        start_ns = clock.monotonic_ns()
        CandidateScore.measure(probe, None)
        elapsed_s = (clock.monotonic_ns() - start_ns) * 1e-9
        run_s = elapsed_s * scenario.duration_s / probe_s
        processes = min(WorkerPool.count_workers(jobs), len(self.spaces) * self.budget)
        return run_s * self.runs / processes

    def run(
        self, jobs: int | None = None, progress: Progress | None = None, on: Workers = None
    ) -> "TuningResult":
        """Searches for the best gains of all laws.

        In each round, the candidates of all laws are run together, so workers need not wait for
        the slowest candidate of each law.

        Args:
            jobs: Number of worker processes. If `None`, one per core.
            progress: Called with the number of finished candidates and the total number of
                candidates.
            on: Workers to use instead of processes on this machine.

        Raises:
            RunFailed: A candidate crashed the workers that ran it, or the cluster is no longer
                available.
        """
        searches = [
            CandidateSearch(space, self.budget, self.seed, self.objective)
            for space in self.spaces
        ]
        bases = (self.base, *self.others)
        paper_scenarios = [self.build_paper_scenarios(base) for base in bases]
        paper_names = list(paper_scenarios[0])
        paper_items = [
            CandidateItem.of_seeds([scenarios[name] for scenarios in paper_scenarios])
            for name in paper_names
        ]
        total = len(searches) * self.budget + len(paper_items)
        paper_scores: list[CandidateScore] = []
        alone: Counter[str] = Counter()
        finished = 0

        def report_progress(in_round: int, _: int) -> None:
            if progress is not None:
                progress(finished + in_round, total)

        if not is_core_cached():
            # A short run compiles the simulation kernel once, before the processes start.
            FusedRun(self.base.scenario).advance_to(_PROBE_S)
        with WorkerPool.open(jobs, on, most=total) as pool:
            for round_number in range(len(searches[0].rounds)):
                proposals = [search.propose_candidates(round_number) for search in searches]
                items_of_laws = [
                    self._build_items(bases, search.space, candidates)
                    for search, candidates in zip(searches, proposals, strict=True)
                ]
                if round_number == 0:
                    side_by_side = self._choose_lanes([items[0] for items in items_of_laws])
                items = [
                    item._replace(is_side_by_side=search.space.law in side_by_side)
                    for search, items_of_law in zip(searches, items_of_laws, strict=True)
                    for item in items_of_law
                ]
                if round_number == 0:
                    for item in paper_items:
                        in_lanes = "adaptive" in side_by_side
                        items.append(item._replace(is_side_by_side=in_lanes))
                # The scores come in the order of the items: first those of each law and then,
                # in the first round, those of the printed gains, which remain at the end.
                measured = pool.map(
                    CandidateItem.measure,
                    items,
                    report_progress,
                    together=CandidateItem.measure_together if side_by_side else None,
                    together_count=LANE_RUNS if side_by_side else 1,
                )
                scores = iter([candidate.score for candidate in measured])
                for candidate in measured:
                    alone.update(candidate.alone)
                finished += len(items)
                for search, candidates in zip(searches, proposals, strict=True):
                    search.record_scores(candidates, [next(scores) for _ in candidates])
                paper_scores += scores
        printed = []
        for name, score in zip(paper_names, paper_scores, strict=True):
            printed.append(_PaperGainsResult(name, paper_scenarios[0][name], score))
        return TuningResult(self, searches, printed, alone)

    def _choose_lanes(self, first_candidates: Sequence[CandidateItem]) -> dict[str, str]:
        """Returns the laws whose runs are to be computed side by side, see `prepare_kinds`.

        Args:
            first_candidates: One candidate of each law.
        """
        kinds = {}
        for space, first in zip(self.spaces, first_candidates, strict=True):
            scenario = parse_embedded(first.runs[0][0])
            kinds[space.law] = RunKind(scenario, self.budget * len(first.runs))
        return prepare_kinds(kinds)

    def _build_items(
        self,
        bases: Sequence[TuningScenario],
        space: SearchSpace,
        candidates: Sequence[CandidateGains],
    ) -> list[CandidateItem]:
        """Bundles the runs of each candidate of one law, so that workers can execute them.

        Args:
            bases: Scenario with each seed.
            space: The law and its gains.
            candidates: Gains of each candidate.
        """
        items = []
        for gains in candidates:
            seed_scenarios = [base.with_gains(space, self.knowledge, gains) for base in bases]
            items.append(CandidateItem.of_seeds(seed_scenarios))
        return items


_EDGE = 1.02
"""Largest ratio between a gain and an end of its range at which the gain counts as lying there.
"""


@dataclass(frozen=True, repr=False)
class TuningResult(Result):
    """Result of comparing control laws, each with the best gains that the search found.

    Attributes:
        plan: The comparison: its scenario, the laws and the ranges of their gains.
        found: For each law in the order of the plan, all gains that were tried and their
            scores.
        printed: Scores of the published gains of the adaptive law (those in the paper that
            introduced it), for comparison.
        alone: Number of runs that were not computed side by side with others, for each reason.
            Empty if the search computes all runs one at a time.
    """

    plan: TuningPlan
    found: list[CandidateSearch]
    printed: list[_PaperGainsResult]
    alone: Mapping[str, int] = field(default_factory=dict)

    def blocks(self) -> Iterator[Any]:
        """Yields the sections of the report that `trilat compare --tune` prints.

        See `TuningReport.compose`.
        """
        from .tuning_report import TuningReport

        return TuningReport(self).compose()

    def headline(self) -> str:
        """Returns a sentence with the number of points on the Pareto front of each law.

        Example: "paper: points on the front: p_d 4, adaptive 7".
        """
        fronts = ", ".join(f"{search.space.law} {len(search.front)}" for search in self.found)
        return f"{self.plan.base.scenario.name}: points on the front: {fronts}"

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to the plain values that `trilat compare --tune --json` prints.

        Returns:
            The scenario, the procedure, the results of each law, and the scores of the
            published gains. Each score comes with the command that repeats its run.
        """
        printed = []
        for result in self.printed:
            facts = msgspec.to_builtins(result.score)
            command = result.candidate.command
            printed.append({"name": result.name, **facts, "command": command})
        return {
            "scenario": self._describe_scenario(),
            "procedure": self._describe_procedure(),
            "laws": {search.space.law: self._describe_law(search) for search in self.found},
            "as_printed": printed,
        }

    def _describe_scenario(self) -> dict[str, Any]:
        """Returns the conditions under which the laws were tuned, for `to_dict`.

        They include the seed, the torque limits and the number of sites.
        """
        base = self.plan.base
        scenario = base.scenario
        limits_nm = {name: spec.limits.tau_limit_nm for name, spec in scenario.sites.items()}
        return {
            "source": base.source,
            "overrides": list(base.overrides),
            "name": scenario.name,
            "seed": scenario.seed,
            "sites": len(scenario.names),
            "duration_s": scenario.duration_s,
            "tau_limit_nm": limits_nm,
        }

    def _describe_procedure(self) -> dict[str, Any]:
        """Returns the parameters of the search for `to_dict`: budget, seeds, steps and others.

        They are needed to tune another law for comparison.
        """
        plan = self.plan
        procedure: dict[str, Any] = {
            "candidates_per_law": plan.budget,
            "seed": plan.seed,
            "seeds": 1 + len(plan.others),
            "latin_hypercube": (plan.budget + 1) // 2,
            "refining_steps": list(REFINEMENT_STEPS),
            "runs": plan.runs,
            "twin": plan.twin,
            "objective": plan.objective.value,
            "objective_unit": plan.objective.unit,
            "gravity_told": plan.knowledge.gravity,
            "knowledge": plan.knowledge.text,
            "box": plan.knowledge.box,
        }

        weights = weigh_joints(plan.base.scenario)
        if weights:
            procedure["joint_weights"] = weights
        procedure["outcomes"] = {
            outcome.value: text for outcome, text in CLASS_MEANINGS.items()
        }
        return procedure

    def _describe_law(self, search: CandidateSearch) -> dict[str, Any]:
        """Returns the search space, the front and all candidates of a law, for `to_dict`.

        Args:
            search: The finished search of the law.
        """
        candidates = []
        for gains, score in zip(search.tried, search.scores, strict=True):
            candidates.append({"gains": gains, **msgspec.to_builtins(score)})

        overall_front = self.list_overall_front(search)
        front = []
        for index in search.front:
            point = {
                "candidate": index,
                **candidates[index],
                "on_the_front_of_all": index in overall_front,
                "command": self.candidate(search, index).command,
            }
            front.append(point)

        return {
            "told": search.space.known_facts,
            "searched": [knob._asdict() for knob in search.space.knobs],
            "outcomes": {outcome.value: count for outcome, count in search.outcomes.items()},
            "front": front,
            "candidates": candidates,
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one row of plain values, ready for CSV, per candidate of each law."""
        rows = []
        for law, facts in self.to_dict()["laws"].items():
            for candidate in facts["candidates"]:
                gains = candidate.pop("gains")
                rows.append({"law": law, **candidate, **gains})
        return rows

    def candidate(self, search: CandidateSearch, index: int) -> TuningScenario:
        """Returns the scenario with the gains of one candidate, for simulating it again.

        Args:
            search: Search of the candidate's law.
            index: Index of the candidate in this search.
        """
        plan = self.plan
        return plan.base.with_gains(search.space, plan.knowledge, search.tried[index])

    def list_edge_gains(self, search: CandidateSearch) -> list[str]:
        """Lists the gains whose best value lies at an end of the searched range.

        The range of such a gain should be widened, because a better value may lie outside. The
        best candidate of a law is the one with the smallest objective.

        Args:
            search: Search of the law.

        Returns:
            The names of these gains. May be empty.
        """
        if not search.front:
            return []
        best = search.tried[search.front[-1]]
        names = []
        for knob in search.space.knobs:
            is_inside = knob.low * _EDGE < best[knob.name] < knob.high / _EDGE
            if not is_inside:
                names.append(knob.name)
        return names

    def list_overall_front(self, search: CandidateSearch) -> list[int]:
        """Lists the candidates of a law that are on the common Pareto front of all laws.

        A candidate is on this front if no other candidate of any law has both a smaller
        objective (error or settling time) and a smaller effort (motor torque).

        Args:
            search: Candidates of the law, with their scores.

        Returns:
            Indices of the candidates in `search.tried`. Empty if other laws are better
            everywhere.
        """
        points = []
        candidates = []
        for other in self.found:
            other_points = other.points
            for index in other.front:
                points.append(other_points[index])
                candidates.append((other.space.law, index))
        overall_front = [candidates[position] for position in find_pareto_front(points)]
        own_law = search.space.law
        return [index for law, index in overall_front if law == own_law]


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
    """Plans a comparison of control laws with tuned gains, and checks that it can run.

    The arguments are explained in `trilat_net.tune`. Overrides are strings KEY=VALUE. With
    several seeds, the first is the seed of the scenario, and each further seed is larger by 1.

    Returns:
        The checked plan.

    Raises:
        ScenarioError: The scenario is not valid, or laws cannot be compared in it.
        UsageError: Another argument is not valid.
    """
    if not 1 <= budget <= MAX_BUDGET:
        raise UsageError(
            f"--budget, the number of candidates per law, must be from 1 to {MAX_BUDGET}, "
            f"not {budget}"
        )
    if not 0 <= seed < 2**63:
        raise UsageError(f"--seed must be from 0 to 2^63 - 1, not {seed}")
    if objective not in list(Objective):
        raise UsageError(f"--objective must be {' or '.join(Objective)}, not {objective!r}")
    if not 1 <= seeds <= MAX_TUNING_SEEDS:
        raise UsageError(
            f"--seeds, the number of runs per candidate, must be from 1 to {MAX_TUNING_SEEDS}, "
            f"not {seeds}"
        )
    knowledge = ModelInformation.of_gravity(gravity_percent)
    base = TuningScenario.load(source, overrides)
    scenario = base.scenario
    spaces = SearchSpace.select([name_law_classes(law) for law in laws], scenario)
    ticks = sum(map(scenario.ticks, scenario.names))
    if ticks > MAX_TICKS:
        problem = (
            f"a candidate would take {count_nouns(ticks, 'tick')}, but at most {MAX_TICKS} are "
            "allowed: shorten the run with --duration"
        )
        raise ScenarioError(problem, path="duration_s", source=base.source)
    check_comparable(scenario)

    # If nothing is random, all seeds give the same run.
    others = []
    if scenario.random:
        for other_seed in range(scenario.seed + 1, scenario.seed + seeds):
            texts = (*overrides, f"seed={other_seed}")
            others.append(TuningScenario.load(source, texts))
    for space in spaces:
        # A law may reject the scenario, for example its scheme. This must happen before the
        # search.
        (gains,) = CandidateSearch(space, 1, seed, Objective(objective)).propose_candidates(0)
        base.with_gains(space, knowledge, gains)
    return TuningPlan(
        base=base,
        spaces=spaces,
        budget=budget,
        seed=seed,
        objective=Objective(objective),
        knowledge=knowledge,
        others=tuple(others),
    )

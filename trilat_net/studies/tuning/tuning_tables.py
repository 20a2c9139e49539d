"""A comparison as tables, as a Markdown page and as plain values for JSON.

Invariant: a function of the result alone, without a clock: equal plans give equal bytes. Heads carry the
unit, and every run is counted in some column.
"""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from ...reporting.text_table import TextTable
from .candidate import CandidateScore
from .final_posture import CLASS_MEANINGS, CandidateClass
from .pareto_search import REFINEMENT_STEPS, Objective
from .tuning_plan import MAX_BUDGET, SearchResult, TuningPlan, TuningResult


def tabulate_laws(tuned: TuningResult) -> TextTable:
    """Returns a row per law: what became of its candidates, and the two ends of its front."""
    value = _head(tuned.plan.objective)
    heads = ("law", "tried", *(outcome.value for outcome in reversed(CandidateClass)), "front", "of all")
    return TextTable(
        (*heads, f"least {value}", "at effort N m", "least effort N m", f"at {value}"),
        [_law_row(tuned, found) for found in tuned.found],
        align="lr",
    )


def _law_row(tuned: TuningResult, found: SearchResult) -> tuple[str, ...]:
    counts = found.outcomes
    ends = [tuned.plan.objective.point(found.scores[place]) for place in found.front[-1:] + found.front[:1]]
    best, cheapest = ends or (None, None)
    numbers = (*(best or (None, None)), *(cheapest or (None, None))[::-1])
    return (
        found.space.law,
        str(len(found.tried)),
        *(str(counts[outcome]) for outcome in reversed(CandidateClass)),
        str(len(found.front)),
        str(len(tuned.shared(found))),
        *map(_number, numbers),
    )


def tabulate_search(plan: TuningPlan) -> TextTable:
    """Returns a row per law and gain: its range, and the information the law gets."""
    return TextTable(
        ("law", "gain", "unit", "from", "to", "told"),
        [
            (
                space.law,
                f"{knob.name} ({knob.where})" if knob.where else knob.name,
                knob.unit or "-",
                f"{knob.low:g}",
                f"{knob.high:g}",
                space.told if n == 0 else "",
            )
            for space in plan.spaces
            for n, knob in enumerate(space.knobs)
        ],
        align="lllrrl",
    )


def tabulate_front(tuned: TuningResult, found: SearchResult, most: int = MAX_BUDGET) -> TextTable:
    """Returns a law's front by rising effort; * marks what no law's candidate dominates."""
    count = len(found.front)
    kept = {round(n) for n in np.linspace(0, count - 1, min(most, count))}
    shared = tuned.shared(found)
    gains = [f"{knob.name} {knob.unit}".strip() for knob in found.space.knobs]
    rows = [
        (
            f"{found.space.law} {n}{'*' if place in shared else ''}",
            *(f"{found.tried[place][knob.name]:g}" for knob in found.space.knobs),
            *_score_cells(found.scores[place]),
        )
        for n, place in enumerate(found.front, 1)
        if n - 1 in kept
    ]
    return TextTable(("law", *gains, *_SCORE_HEADS), rows, align="lr")


def tabulate_paper_gains(tuned: TuningResult) -> TextTable:
    """Returns a row for each way to take the gains that the paper prints."""
    rows = [(one.name, one.score.outcome.value, *_score_cells(one.score)) for one in tuned.printed]
    return TextTable(("law", "outcome", *_SCORE_HEADS), rows, align="llr")


_SCORE_HEADS = (
    "error rad",
    "spread rad",
    "pose rad",
    "effort N m",
    "settled s",
    "clamped %",
)


def _score_cells(score: CandidateScore) -> tuple[str, ...]:
    numbers = (score.error_rad, score.spread_rad, score.pose_rad, score.effort_nm, score.settled_s)
    return (*(_number(number) for number in numbers), f"{100.0 * score.saturated:.2g}")


def describe_procedure(plan: TuningPlan) -> list[str]:
    """Returns what was the same for all, a sentence each."""
    scenario = plan.base.scenario
    clamps = sorted({spec.limits.tau_limit_nm for spec in scenario.sites.values()})
    clamp = " to ".join(f"{value:g}" for value in dict.fromkeys((clamps[0], clamps[-1])))
    lines = [
        f"{plan.budget} candidates per law, {(plan.budget + 1) // 2} of a Latin hypercube, the others "
        f"refined; seed {plan.seed}",
        f"{scenario.duration_s:g} s of {scenario.name}, its seed {scenario.seed}, "
        f"torques clamped at {clamp} N m",
        plan.knowledge.text + ("; known gets inertia exactly as well" if plan.informed else ""),
        "error: RMS distance of the arms from the pose of a weightless consensus; effort: RMS of tau - G(q)",
    ]
    if plan.objective is Objective.SETTLING:
        lines.append("sought: the time from which the largest |e| stays below 0.01 rad, against effort")
    if plan.twin:
        lines.append("pose and outcome are judged on the twin without torques that have no target, and walls")
    return lines


def list_class_meanings() -> list[str]:
    """Returns what the outcomes mean, a line each, in the order in which they are asked."""
    return [f"{outcome.value}: {text}" for outcome, text in CLASS_MEANINGS.items()]


def build_tuning_page(tuned: TuningResult) -> str:
    """Returns the whole comparison in Markdown, with the command of every point of a front."""
    scenario = tuned.plan.base.scenario
    parts = [
        f"# {scenario.name}: laws compared fairly",
        "\n".join(f"- {line}" for line in describe_procedure(tuned.plan)),
        tabulate_laws(tuned).markdown(),
        "Outcomes, the first that holds:",
        "\n".join(f"- {line}" for line in list_class_meanings()),
        "## Searched",
        tabulate_search(tuned.plan).markdown(),
        "## Fronts",
        "A * marks what no candidate of any law dominates.",
    ]
    for found in tuned.found:
        parts += [f"### {found.space.law}", *_front_parts(tuned, found)]
    parts += ["## As printed", tabulate_paper_gains(tuned).markdown()]
    parts += [_block([one.candidate.command for one in tuned.printed])]
    return "\n\n".join(parts) + "\n"


def _front_parts(tuned: TuningResult, found: SearchResult) -> list[str]:
    if not found.front:
        return ["None of its candidates settled."]
    commands = [tuned.candidate(found, place).command for place in found.front]
    return [tabulate_front(tuned, found).markdown(), _block(commands)]


def _block(lines: Sequence[str]) -> str:
    return "\n".join(["```", *lines, "```"])


def _head(objective: Objective) -> str:
    return "error rad" if objective is Objective.ERROR else "settling s"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


TuningJson = dict[str, Any]


def tuning_to_json(tuned: TuningResult) -> TuningJson:
    """Returns all that there is to say, as plain values."""
    asked = tuned.plan
    scenario = asked.base.scenario
    return {
        "scenario": {
            "source": asked.base.source,
            "overrides": list(asked.base.overrides),
            "name": scenario.name,
            "seed": scenario.seed,
            "sites": len(scenario.names),
            "duration_s": scenario.duration_s,
            "tau_limit_nm": {name: spec.limits.tau_limit_nm for name, spec in scenario.sites.items()},
        },
        "procedure": {
            "candidates_per_law": asked.budget,
            "seed": asked.seed,
            "latin_hypercube": (asked.budget + 1) // 2,
            "refining_steps": list(REFINEMENT_STEPS),
            "runs": asked.runs,
            "twin": asked.twin,
            "objective": asked.objective.value,
            "objective_unit": asked.objective.unit,
            "gravity_told": asked.knowledge.gravity,
            "knowledge": asked.knowledge.text,
            "box": asked.knowledge.box,
            "outcomes": {outcome.value: text for outcome, text in CLASS_MEANINGS.items()},
        },
        "laws": {found.space.law: _law(tuned, found) for found in tuned.found},
        "as_printed": [
            {"name": one.name, **_score(one.score), "command": one.candidate.command} for one in tuned.printed
        ],
    }


def _law(tuned: TuningResult, found: SearchResult) -> TuningJson:
    shared = tuned.shared(found)
    return {
        "told": found.space.told,
        "searched": [knob._asdict() for knob in found.space.knobs],
        "outcomes": {outcome.value: found.outcomes[outcome] for outcome in CandidateClass},
        "front": [
            {
                "candidate": place,
                "gains": found.tried[place],
                **_score(found.scores[place]),
                "on_the_front_of_all": place in shared,
                "command": tuned.candidate(found, place).command,
            }
            for place in found.front
        ],
        "candidates": [
            {"gains": gains, **_score(score)} for gains, score in zip(found.tried, found.scores, strict=True)
        ],
    }


def _score(score: CandidateScore) -> TuningJson:
    return dict(msgspec.to_builtins(score))

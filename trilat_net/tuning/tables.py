"""A comparison as tables for people: of the laws, of what was searched, and of every front.

Law: numbers stand with their unit in the head, and every run that was made is counted in some column.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .front import Objective
from .measurement import Score
from .outcome import MEANINGS, Outcome
from .tuning import MOST_BUDGET, Found, Plan, Tuned

WORDS = ("law", "gain", "unit", "told")
"""Heads of columns that hold words; all others hold numbers."""


class Table(NamedTuple):
    """A table.

    Attributes:
        heads: of its columns.
        rows: texts.
    """

    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def markdown(self) -> str:
        """Returns it in Markdown."""
        rule = ["---" if head in WORDS else "--:" for head in self.heads]
        return "\n".join(f"| {' | '.join(cells)} |" for cells in (self.heads, rule, *self.rows))


def laws(tuned: Tuned) -> Table:
    """Returns a row per law: what became of its candidates, and the two ends of its front."""
    value = _head(tuned.plan.objective)
    heads = ("law", "tried", *(outcome.value for outcome in reversed(Outcome)), "front", "of all")
    return Table(
        (*heads, f"least {value}", "at effort N m", "least effort N m", f"at {value}"),
        [_law_row(tuned, found) for found in tuned.found],
    )


def _law_row(tuned: Tuned, found: Found) -> tuple[str, ...]:
    counts = found.outcomes
    ends = [tuned.plan.objective.point(found.scores[place]) for place in found.front[-1:] + found.front[:1]]
    best, cheapest = ends or (None, None)
    numbers = (*(best or (None, None)), *(cheapest or (None, None))[::-1])
    return (
        found.space.law,
        str(len(found.tried)),
        *(str(counts[outcome]) for outcome in reversed(Outcome)),
        str(len(found.front)),
        str(len(tuned.shared(found))),
        *map(_number, numbers),
    )


def searched(plan: Plan) -> Table:
    """Returns a row per law and gain: where it was searched, and what the law is told."""
    return Table(
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
    )


def front_of(tuned: Tuned, found: Found, most: int = MOST_BUDGET) -> Table:
    """Returns a law's front by rising effort; * marks what no law's candidate dominates.

    Args:
        tuned: the comparison.
        found: the law's part of it.
        most: so many points at most, both ends among them.
    """
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
    return Table(("law", *gains, *_SCORE_HEADS), rows)


def printed(tuned: Tuned) -> Table:
    """Returns a row for each way to take the gains that the paper prints."""
    rows = [(one.name, one.score.outcome.value, *_score_cells(one.score)) for one in tuned.printed]
    return Table(("law", "outcome", *_SCORE_HEADS), rows)


_SCORE_HEADS = (
    "error rad",
    "spread rad",
    "pose rad",
    "effort N m",
    "settled s",
    "clamped %",
)


def _score_cells(score: Score) -> tuple[str, ...]:
    numbers = (score.error_rad, score.spread_rad, score.pose_rad, score.effort_nm, score.settled_s)
    return (*(_number(number) for number in numbers), f"{100.0 * score.saturated:.2g}")


def procedure(plan: Plan) -> list[str]:
    """Returns what was the same for all, a sentence each."""
    scenario = plan.base.scenario
    clamps = sorted({spec.limits.tau_limit_nm for spec in scenario.sites.values()})
    clamp = " to ".join(f"{value:g}" for value in dict.fromkeys((clamps[0], clamps[-1])))
    lines = [
        f"{plan.budget} candidates per law, {(plan.budget + 1) // 2} of a Latin hypercube, the others "
        f"refined; seed {plan.seed}",
        f"{scenario.duration_s:g} s of {scenario.name}, its seed {scenario.seed}, "
        f"torques clamped at {clamp} N m",
        plan.knowledge.text + ("; known is told inertia exactly as well" if plan.informed else ""),
        "error: RMS distance of the arms from the pose of a weightless consensus; effort: RMS of tau - G(q)",
    ]
    if plan.objective is Objective.SETTLING:
        lines.append("sought: the time from which the largest |e| stays below 0.01 rad, against effort")
    if plan.twin:
        lines.append("pose and outcome are judged on the twin without torques that have no target, and walls")
    return lines


def meanings() -> list[str]:
    """Returns what the outcomes mean, a line each, in the order in which they are asked."""
    return [f"{outcome.value}: {text}" for outcome, text in MEANINGS.items()]


def page(tuned: Tuned) -> str:
    """Returns the whole comparison in Markdown, with the command of every point of a front."""
    scenario = tuned.plan.base.scenario
    parts = [
        f"# {scenario.name}: laws compared fairly",
        "\n".join(f"- {line}" for line in procedure(tuned.plan)),
        laws(tuned).markdown(),
        "Outcomes, the first that holds:",
        "\n".join(f"- {line}" for line in meanings()),
        "## Searched",
        searched(tuned.plan).markdown(),
        "## Fronts",
        "A * marks what no candidate of any law dominates.",
    ]
    for found in tuned.found:
        parts += [f"### {found.space.law}", *_front_parts(tuned, found)]
    parts += ["## As printed", printed(tuned).markdown()]
    parts += [_block([one.candidate.command for one in tuned.printed])]
    return "\n\n".join(parts) + "\n"


def _front_parts(tuned: Tuned, found: Found) -> list[str]:
    if not found.front:
        return ["None of its candidates settled."]
    commands = [tuned.candidate(found, place).command for place in found.front]
    return [front_of(tuned, found).markdown(), _block(commands)]


def _block(lines: Sequence[str]) -> str:
    return "\n".join(["```", *lines, "```"])


def _head(objective: Objective) -> str:
    return "error rad" if objective is Objective.ERROR else "settling s"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"

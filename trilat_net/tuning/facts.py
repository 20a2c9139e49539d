"""A comparison for a program: what was asked, by which procedure, and every run of it.

Law: a function of the result alone, without a clock, so that the same request makes the same bytes.
"""

from typing import Any

import msgspec

from .measurement import Score
from .outcome import MEANINGS, Outcome
from .search import STEPS
from .tuning import Found, Tuned

Facts = dict[str, Any]


def facts(tuned: Tuned) -> Facts:
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
            "refining_steps": list(STEPS),
            "runs": asked.runs,
            "twin": asked.twin,
            "objective": asked.objective.value,
            "objective_unit": asked.objective.unit,
            "gravity_told": asked.knowledge.gravity,
            "knowledge": asked.knowledge.text,
            "box": asked.knowledge.box,
            "outcomes": {outcome.value: text for outcome, text in MEANINGS.items()},
        },
        "laws": {found.space.law: _law(tuned, found) for found in tuned.found},
        "as_printed": [
            {"name": one.name, **_score(one.score), "command": one.candidate.command} for one in tuned.printed
        ],
    }


def _law(tuned: Tuned, found: Found) -> Facts:
    shared = tuned.shared(found)
    return {
        "told": found.space.told,
        "searched": [knob._asdict() for knob in found.space.knobs],
        "outcomes": {outcome.value: found.outcomes[outcome] for outcome in Outcome},
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


def _score(score: Score) -> Facts:
    return dict(msgspec.to_builtins(score))

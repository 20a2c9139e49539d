"""A comparison as tables, as a Markdown page, as JSON, and as a figure of error against effort.

Files: front.json, front.md, front.png, front.pdf.

Invariant: a function of the result alone, without a clock: equal plans give equal bytes; the
JSON is the result, the others are views of it. Heads carry the unit, and every run is counted
in some column. Every stable run at the pose is drawn, on a front or not; the gains that the
paper prints are stars, on no front.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...errors import count_nouns
from ...files import write_whole
from ...reporting import style
from ...reporting.appearance import REPORT_SIZE, SITE_COLOURS
from ...reporting.result_text import Block, TextTable, format_number
from ..intervals import MeanInterval
from .candidate import CLASS_MEANINGS, CandidateClass, CandidateScore
from .search_space import SEARCH_SPACES, weigh_joints
from .tuning_plan import MAX_BUDGET, CandidateSearch, Objective, TuningPlan, TuningResult

_MAX_FRONT_ROWS = 8
"""Points of a front that the text shows; the files hold all."""


def compose_tuning(tuned: TuningResult) -> Iterator[Block]:
    """Yields the laws, the classes, the fronts, the gains as printed, notes, and commands to
    run.
    """
    yield tabulate_laws(tuned)
    yield from (f"  {line}" for line in list_class_meanings())
    for law in tuned.found:
        if law.front:
            yield ""
            yield tabulate_front(tuned, law, _MAX_FRONT_ROWS)
    yield f"  * no candidate of any law is better in both; of long fronts {_MAX_FRONT_ROWS} points are shown"
    yield ""
    yield tabulate_paper_gains(tuned)
    for law in tuned.found:
        for gain in tuned.at_edge(law):
            yield f"note: {law.space.law} is best at the edge of the range of {gain}; widen the search"
    yield ""
    if not any(law.front for law in tuned.found):
        yield (
            "no candidate of any law is stable and at the pose: a longer --duration or a larger --budget "
            "may show more"
        )
        return
    yield "the last of each front, to run; front.md has the others:"
    for law in tuned.found:
        yield from (f"  {tuned.candidate(law, place).command}" for place in law.front[-1:])


def tabulate_laws(tuned: TuningResult) -> TextTable:
    """Returns a row per law: what became of its candidates, and the two ends of its front."""
    value = f"{tuned.plan.objective} {tuned.plan.objective.unit}"
    heads = ("law", "tried", *(one.word for one in reversed(CandidateClass)), "front", "of all")
    rows = []
    for found in tuned.found:
        counts = found.outcomes
        points = found.points
        front = found.front
        ends = [points[place] or (None, None) for place in front[-1:] + front[:1]]
        best, cheapest = ends or [(None, None)] * 2
        classes = (str(counts[outcome]) for outcome in reversed(CandidateClass))
        places = str(len(front)), str(len(tuned.shared(found)))
        numbers = map(format_number, (*best, *cheapest[::-1]))
        rows.append((found.space.law, str(len(found.tried)), *classes, *places, *numbers))
    heads = (*heads, f"least {value}", "at effort N m", "least effort N m", f"at {value}")
    return TextTable(heads, rows, align="lr")


def tabulate_search(plan: TuningPlan) -> TextTable:
    """Returns a row per law and gain: its range, and the information the law gets."""
    rows = []
    for space in plan.spaces:
        for n, knob in enumerate(space.knobs):
            name = f"{knob.name} ({knob.where})" if knob.where else knob.name
            told = space.told if n == 0 else ""
            rows.append(
                (space.law, name, knob.unit or "-", f"{knob.low:g}", f"{knob.high:g}", told)
            )
    return TextTable(("law", "gain", "unit", "from", "to", "told"), rows, align="lllrrl")


def tabulate_front(
    tuned: TuningResult, found: CandidateSearch, most: int = MAX_BUDGET
) -> TextTable:
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
    rows = [
        (one.name, one.score.outcome.word, *_score_cells(one.score)) for one in tuned.printed
    ]
    return TextTable(("law", "class", *_SCORE_HEADS), rows, align="llr")


_SCORE_HEADS = ("error rad", "spread rad", "pose rad", "effort N m", "settled s", "clamped %")


def _score_cells(score: CandidateScore) -> tuple[str, ...]:
    error = _with_interval(score.error_rad, score.error_half_rad)
    effort = _with_interval(score.effort_nm, score.effort_half_nm)
    spread, pose, settled = map(
        format_number, (score.spread_rad, score.pose_rad, score.settled_s)
    )
    return error, spread, pose, effort, settled, f"{100.0 * score.saturated:.3g}"


def _with_interval(mean: float | None, half: float | None) -> str:
    return (
        format_number(mean) if mean is None or half is None else str(MeanInterval(mean, half))
    )


def describe_procedure(plan: TuningPlan) -> list[str]:
    """Returns what was the same for all, a sentence each."""
    scenario = plan.base.scenario
    clamps = np.hstack([spec.limits.tau_limit_nm for spec in scenario.sites.values()])
    clamp = " to ".join(f"{value:g}" for value in dict.fromkeys((clamps.min(), clamps.max())))
    informed = any(space.law == "known" for space in plan.spaces)
    lines = [
        f"{count_nouns(plan.budget, 'candidate')} per law, {(plan.budget + 1) // 2} of a "
        "Latin hypercube, the others "
        f"refined; seed {plan.seed}",
        f"{scenario.duration_s:g} s of {scenario.name}, its seed {scenario.seed}, "
        f"torques clamped at {clamp} N m",
        plan.knowledge.text + ("; known gets inertia exactly as well" if informed else ""),
        "error: RMS distance of the arms from the pose of a weightless consensus; effort: RMS of tau - G(q)",
    ]
    if weights := weigh_joints(scenario):
        shares = ", ".join(f"{weight:g}" for weight in weights)
        lines.append(
            f"of Kp, Kd, K and d the joints have {shares} times the number, by their inertia"
        )
    if plan.others:
        lines.append(
            f"every candidate is the mean of {count_nouns(1 + len(plan.others), 'seed')}, "
            "with its 95 % interval"
        )
    if plan.objective is Objective.SETTLING:
        lines.append(
            "sought: the time from which the largest |e| stays below 0.01 rad, against effort"
        )
    if plan.twin:
        lines.append(
            "the pose is judged on the twin without torques that have no target, and walls"
        )
    return lines


def list_class_meanings() -> list[str]:
    """Returns what the classes mean, a line each, in the order in which they are asked."""
    return [f"{outcome.word}: {text}" for outcome, text in CLASS_MEANINGS.items()]


def build_tuning_page(tuned: TuningResult) -> str:
    """Returns the whole comparison in Markdown, with the command of every point of a front."""
    scenario = tuned.plan.base.scenario
    parts = [
        f"# {scenario.name}: laws compared fairly",
        "\n".join(f"- {line}" for line in describe_procedure(tuned.plan)),
        tabulate_laws(tuned).markdown(),
        "Classes, the first that holds:",
        "\n".join(f"- {line}" for line in list_class_meanings()),
        "## Searched",
        tabulate_search(tuned.plan).markdown(),
        "## Fronts",
        "A * marks what no candidate of any law dominates.",
    ]
    for found in tuned.found:
        commands = [tuned.candidate(found, place).command for place in found.front]
        front = [tabulate_front(tuned, found).markdown(), _block(commands)]
        parts += [
            f"### {found.space.law}",
            *(front if found.front else ["None of its candidates is stable and at the pose."]),
        ]
    parts += ["## As printed", tabulate_paper_gains(tuned).markdown()]
    parts += [_block([one.candidate.command for one in tuned.printed])]
    return "\n\n".join(parts) + "\n"


def _block(lines: Sequence[str]) -> str:
    return "\n".join(["```", *lines, "```"])


FRONT_WIDTH_IN = 3.5
"""One column of a page of two."""
_HEIGHT_IN = 3.1
_SIZE_PT = 8.0
_MARKS = ("o", "s", "^", "D", "v", "P")
_LABELS = {Objective.ERROR: "error (rad)", Objective.SETTLING: "settling time (s)"}


def draw_front(tuned: TuningResult) -> Figure:
    """Returns the fronts of all laws in one panel, both axes logarithmic."""
    with style.styled_figure(REPORT_SIZE, _HEIGHT_IN) as figure:
        figure.set_figwidth(FRONT_WIDTH_IN)
        axes = figure.add_subplot()
        drawn = [_draw_law(axes, found) for found in tuned.found]
        stars = _draw_printed(axes, tuned)
        axes.set_xlabel("effort (N m)", fontsize=_SIZE_PT)
        axes.set_ylabel(_LABELS[tuned.plan.objective], fontsize=_SIZE_PT)
        axes.tick_params(labelsize=_SIZE_PT)
        shown = [number for line in axes.lines for number in np.ravel(line.get_xydata())]
        if not shown:
            style.annotate_empty_panel(axes, "no stable candidate at the pose")
        elif min(shown) > 0.0:
            axes.set(xscale="log", yscale="log")
            for axis in (axes.xaxis, axes.yaxis):
                style.set_plain_log_axis(axis)
        look: dict[str, Any] = {"labelspacing": 0.3, "columnspacing": 0.8, "handlelength": 1.2}
        handles = [*drawn, *stars]
        figure.legend(
            handles=handles, loc="outside upper center", ncols=2, fontsize=_SIZE_PT, **look
        )
    return figure


def _draw_law(axes: Axes, found: CandidateSearch) -> Line2D:
    """Draws a law's stable runs faintly and its front on top; returns its entry of the legend."""
    names = list(dict.fromkeys([*SEARCH_SPACES, found.space.law]))
    place = names.index(found.space.law)
    colour = SITE_COLOURS[place % len(SITE_COLOURS)]
    mark = _MARKS[place % len(_MARKS)]
    points = found.points
    settled = [point for point in points if point is not None]
    front = [point for place in found.front if (point := points[place]) is not None]
    faint: dict[str, Any] = {
        "linestyle": "",
        "markersize": 2.0,
        "alpha": 0.3,
        "markeredgewidth": 0.0,
    }
    plain: dict[str, Any] = {
        "marker": mark,
        "markersize": 3.5,
        "linewidth": 1.1,
        "color": colour,
    }
    axes.plot(
        [x for _, x in settled], [y for y, _ in settled], marker=mark, color=colour, **faint
    )
    axes.step([x for _, x in front], [y for y, _ in front], where="post", **plain)
    count = found.outcomes[CandidateClass.SETTLED]
    return Line2D([], [], label=f"{found.space.law} ({count}/{len(found.scores)})", **plain)


def _draw_printed(axes: Axes, tuned: TuningResult) -> list[Line2D]:
    """Draws the gains of the paper as stars; returns their entries of the legend."""
    entries = []
    for one, fill in zip(tuned.printed, ("full", "none"), strict=True):
        point = tuned.plan.objective.point(one.score)
        look: dict[str, Any] = {
            "linestyle": "",
            "marker": "*",
            "markersize": 7.0,
            "fillstyle": fill,
        }
        look["color"] = style.REFERENCE
        if point is not None:
            axes.plot([point[1]], [point[0]], **look)
        outcome = one.score.outcome
        reason = "never" if outcome is CandidateClass.SETTLED else outcome.word
        label = one.name if point is not None else f"{one.name} ({reason})"
        entries.append(Line2D([], [], label=label, **look))
    return entries


def write_tuning(tuned: TuningResult, folder: Path) -> list[Path]:
    """Writes a comparison into a folder that exists, and returns the paths."""
    data = folder / "front.json"
    text = folder / "front.md"
    write_whole(
        data, json.dumps(tuned.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    )
    write_whole(text, build_tuning_page(tuned))
    figure = draw_front(tuned)
    pictures = [folder / "front.png", folder / "front.pdf"]
    for path in pictures:
        style.write_figure(figure, path, style.REPORT_DPI)
    return [data, text, *pictures]

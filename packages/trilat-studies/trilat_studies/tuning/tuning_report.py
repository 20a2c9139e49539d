"""Reports a comparison of tuned control laws as tables, a Markdown page, JSON and a figure.

The figure shows error against effort (the RMS motor torque) for the Pareto front of each law:
the gains for which no other gains of the law are better in both. `TuningReport.write` writes
the files front.json, front.md, front.png and front.pdf.

Invariant:
    - The files depend only on the result. Repeating the same comparison gives identical bytes.
    - The JSON contains the complete result. The other files are views of it.
    - Each run is counted in exactly one class, such as stable or diverged.
    - The figure shows every stable run in which the arms end at the operators' target pose,
      whether or not it is on a front. Stars mark the published gains of the adaptive law, which
      belong to no front.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from trilat_net.errors import count_nouns
from trilat_net.files import write_whole
from trilat_net.presentation import (
    NEGATIVE_ENERGY_MEANING,
    REPORT_SIZE,
    SITE_COLOURS,
    Block,
    TextTable,
    format_number,
    style,
)
from trilat_net.scenario import BUILT_IN
from trilat_net.work import MeanInterval

from ..side_by_side import describe_runs_alone
from .candidate import CLASS_MEANINGS, CandidateClass, CandidateScore
from .search_space import SEARCH_SPACES, weigh_joints

if TYPE_CHECKING:
    from .tuning_plan import CandidateSearch, TuningPlan, TuningResult

_MAX_FRONT_ROWS = 8
"""Largest number of points of a front that are printed. The files contain all points."""


class TuningReport:
    """Report on a comparison of tuned control laws: text, tables, page and figure.

    Args:
        tuned: Result of the comparison.
    """

    def __init__(self, tuned: "TuningResult") -> None:
        self._tuned = tuned

    def compose(self) -> Iterator[Block]:
        """Yields the sections of the report that is printed on the terminal.

        The report begins with a table of the laws, explanations of the behaviour classes, and
        each law's Pareto front, which contains its best trade-offs between error and effort.
        It ends with the scores of the published gains, notes, and the commands that repeat the
        best runs.
        """
        yield self._tabulate_laws()
        yield from (f"  {line}" for line in _list_class_meanings())
        yield from (f"note: {line}" for line in self.list_energy_notes())
        alone = describe_runs_alone(self._tuned.alone, self._tuned.plan.runs)
        if alone:
            yield f"note: {alone}"

        for search in self._tuned.found:
            if search.front:
                yield ""
                yield self.tabulate_front(search, _MAX_FRONT_ROWS)
        yield (
            "  * no candidate of any law is better in both objectives; of a long front "
            f"{_MAX_FRONT_ROWS} points are shown"
        )

        yield ""
        yield self._tabulate_paper_gains()
        for search in self._tuned.found:
            for gain in self._tuned.list_edge_gains(search):
                yield (
                    f"note: {search.space.law} is best at the edge of the range of {gain}; "
                    "widen the search"
                )

        yield ""
        if not any(search.front for search in self._tuned.found):
            yield (
                "no candidate of any law is stable and at the pose: a longer --duration or a "
                "larger --budget may show more"
            )
            return
        yield "commands for the last point of each front; front.md has the others:"
        for search in self._tuned.found:
            if search.front:
                last_point = search.front[-1]
                yield f"  {self._tuned.candidate(search, last_point).command}"

    def write(self, folder: Path) -> list[Path]:
        """Writes the results of the comparison into an existing folder.

        The files are the results as JSON, a Markdown page, and the figure of the fronts as PNG
        and PDF.

        Args:
            folder: The folder.

        Returns:
            The paths of the files.
        """
        json_path = folder / "front.json"
        page_path = folder / "front.md"
        picture_paths = [folder / "front.png", folder / "front.pdf"]
        text = json.dumps(self._tuned.to_dict(), indent=2, ensure_ascii=False, allow_nan=False)
        write_whole(json_path, text + "\n")
        write_whole(page_path, self._build_page())
        figure = self._draw_front()
        for path in picture_paths:
            style.write_figure(figure, path, style.REPORT_DPI)
        return [json_path, page_path, *picture_paths]

    def list_energy_notes(self) -> list[str]:
        """Returns notes on laws that declare energies, because the tuning does not check these.

        The tuning classifies runs by the motion of the arms only. A run in which a law's
        declared energy became negative can therefore count as stable here, although the verdict
        of its certificate is "open".
        """
        laws = []
        for search in self._tuned.found:
            law = BUILT_IN.get(search.space.law)
            if callable(getattr(law, "energies", None)):
                laws.append(search.space.law)
        if not laws:
            return []
        return [
            f"{', '.join(laws)} declare energies, which `trilat certify` checks and the "
            f"classes above do not: {NEGATIVE_ENERGY_MEANING}"
        ]

    def tabulate_front(self, search: "CandidateSearch", most: int | None = None) -> TextTable:
        """Returns a table of the candidates on a law's Pareto front, by increasing effort.

        A candidate is on the front if no other candidate has both a smaller error and a smaller
        effort. A * marks candidates that are also on the common front of all laws.

        Args:
            search: Search of the law.
            most: Largest number of rows. If the front is longer, evenly spread points are
                shown, including the first and the last one. If `None`, all points are shown.
        """
        count = len(search.front)
        row_count = count if most is None else min(most, count)
        # evenly spread, including the first and the last point
        row_indices = {round(index) for index in np.linspace(0, count - 1, row_count)}
        overall_front = self._tuned.list_overall_front(search)
        tuned_gains = search.space.knobs

        rows = []
        for row_index, index in enumerate(search.front):
            if row_index not in row_indices:
                continue
            mark = "*" if index in overall_front else ""
            gains = [f"{search.tried[index][knob.name]:g}" for knob in tuned_gains]
            score = _format_score(search.scores[index])
            rows.append((f"{search.space.law} {row_index + 1}{mark}", *gains, *score))

        heads = [f"{knob.name} {knob.unit}".strip() for knob in tuned_gains]
        return TextTable(("law", *heads, *_SCORE_HEADS), rows, align="lr")

    def _tabulate_laws(self) -> TextTable:
        """Returns a table that summarises the search, with one row per law.

        A row shows the number of candidates in total and in each class, such as stable or
        diverged, the number of points on the law's Pareto front and on the common front of all
        laws, and the two ends of the front.
        """
        classes = list(reversed(CandidateClass))
        objective = f"{self._tuned.plan.objective} {self._tuned.plan.objective.unit}"
        heads = ("law", "tried", *(outcome.word for outcome in classes), "front", "of all")
        heads += (f"least {objective}", "at effort N m", "least effort N m", f"at {objective}")

        rows = []
        for search in self._tuned.found:
            outcomes = search.outcomes
            row = [search.space.law, str(len(search.tried))]
            row += [str(outcomes[outcome]) for outcome in classes]
            row.append(str(len(search.front)))
            row.append(str(len(self._tuned.list_overall_front(search))))
            row += _format_front_ends(search)
            rows.append(tuple(row))
        return TextTable(heads, rows, align="lr")

    def _tabulate_paper_gains(self) -> TextTable:
        """Returns a table of the scores of the adaptive law with its published gains.

        These gains are printed in the paper that introduced the law. The scores are the error,
        the effort and the behaviour class. The table has one row per variant: with and without
        information about the arm.
        """
        rows = []
        for result in self._tuned.printed:
            score = result.score
            rows.append((result.name, score.outcome.word, *_format_score(score)))
        return TextTable(("law", "class", *_SCORE_HEADS), rows, align="llr")

    def _build_page(self) -> str:
        """Composes the Markdown page that reports the comparison of control laws.

        For each point of a front, the page contains the command that repeats its run.
        """
        scenario = self._tuned.plan.base.scenario
        parts = [
            f"# {scenario.name}: laws compared fairly",
            _format_list(describe_procedure(self._tuned.plan)),
            self._tabulate_laws().markdown(),
            "Classes, the first that applies:",
            _format_list([*_list_class_meanings(), *self.list_energy_notes()]),
            "## Search ranges",
            _tabulate_search(self._tuned.plan).markdown(),
            "## Fronts",
            "A * marks the points that no candidate of any law dominates.",
        ]

        for search in self._tuned.found:
            parts.append(f"### {search.space.law}")
            if search.front:
                commands = [
                    self._tuned.candidate(search, index).command for index in search.front
                ]
                parts.append(self.tabulate_front(search).markdown())
                parts.append(_format_code(commands))
            else:
                parts.append("No candidate of this law is stable and at the pose.")

        parts.append("## As printed")
        parts.append(self._tabulate_paper_gains().markdown())
        parts.append(_format_code([result.candidate.command for result in self._tuned.printed]))
        return "\n\n".join(parts) + "\n"

    def _draw_front(self) -> Figure:
        """Draws the Pareto fronts of all laws in one panel, with error against effort.

        The front of a law contains its best trade-offs between the two. The axes are
        logarithmic if all values are positive.
        """
        with style.styled_figure(REPORT_SIZE, _HEIGHT_IN) as figure:
            figure.set_figwidth(FRONT_WIDTH_IN)
            axes = figure.add_subplot()
            handles = [_draw_law(axes, search) for search in self._tuned.found]
            handles += _draw_paper_gains(axes, self._tuned)
            axes.set_xlabel("effort (N m)", fontsize=_SIZE_PT)
            axes.set_ylabel(_LABELS[self._tuned.plan.objective], fontsize=_SIZE_PT)
            axes.tick_params(labelsize=_SIZE_PT)

            drawn_numbers = [
                number for line in axes.lines for number in np.ravel(line.get_xydata())
            ]
            if not drawn_numbers:
                style.annotate_empty_panel(axes, "no stable candidate at the pose")
            elif min(drawn_numbers) > 0.0:
                axes.set(xscale="log", yscale="log")
                for axis in (axes.xaxis, axes.yaxis):
                    style.set_plain_log_axis(axis)

            figure.legend(
                handles=handles,
                loc="outside upper center",
                ncols=2,
                fontsize=_SIZE_PT,
                labelspacing=0.3,
                columnspacing=0.8,
                handlelength=1.2,
            )
        return figure


def _format_front_ends(search: "CandidateSearch") -> list[str]:
    """Returns the table cells for the two ends of a law's Pareto front.

    Returns:
        The smallest objective with its effort, and the smallest effort with its objective. All
        cells are "-" if the law has no front.
    """
    front = search.front_points
    if not front:
        return [format_number(None)] * 4
    least_value, effort_nm = front[-1]
    value, least_effort_nm = front[0]
    numbers = (least_value, effort_nm, least_effort_nm, value)
    return [format_number(number) for number in numbers]


def _tabulate_search(plan: "TuningPlan") -> TextTable:
    """Returns a table of the gains that are tuned and their search ranges, one row per gain.

    The first row of a law also names the information that it gets about the arm model.

    Args:
        plan: The comparison.
    """
    rows = []
    for space in plan.spaces:
        information = space.known_facts
        for knob in space.knobs:
            name = f"{knob.name} ({knob.where})" if knob.where else knob.name
            unit = knob.unit or "-"
            row = (space.law, name, unit, f"{knob.low:g}", f"{knob.high:g}", information)
            rows.append(row)
            information = ""
    heads = ("law", "gain", "unit", "from", "to", "information")
    return TextTable(heads, rows, align="lllrrl")


_SCORE_HEADS = ("error rad", "spread rad", "pose rad", "effort N m", "settling s", "clamped %")
"""Column headers of a score."""


def _format_score(score: CandidateScore) -> tuple[str, ...]:
    """Returns the table cells of a candidate's score, in the order of `_SCORE_HEADS`."""
    return (
        _format_mean(score.error_rad, score.error_half_rad),
        format_number(score.spread_rad),
        format_number(score.pose_rad),
        _format_mean(score.effort_nm, score.effort_half_nm),
        format_number(score.settled_s),
        f"{100.0 * score.saturated:.3g}",
    )


def _format_mean(mean: float | None, half: float | None) -> str:
    """Formats a mean, with the half-width of its confidence interval if known.

    Args:
        mean: The mean, or `None`.
        half: Half the width of the interval, or `None`.
    """
    if mean is None or half is None:
        return format_number(mean)
    return str(MeanInterval(mean, half))


def describe_procedure(plan: "TuningPlan") -> list[str]:
    """Describes the conditions that are the same for all compared laws, in one sentence each.

    The sentences cover the candidates, the scenario, the model information available to the
    laws, the objectives, and conditions that apply only to some comparisons.

    Args:
        plan: The comparison.
    """
    scenario = plan.base.scenario
    sampled = (plan.budget + 1) // 2
    limits_nm = np.hstack([spec.limits.tau_limit_nm for spec in scenario.sites.values()])
    limit_range = dict.fromkeys((limits_nm.min(), limits_nm.max()))  # one entry if both agree
    limits = " to ".join(f"{limit:g}" for limit in limit_range)
    knowledge = plan.knowledge.text
    if any(space.law == "known" for space in plan.spaces):
        knowledge += "; the law known also gets the exact inertia"
    lines = [
        f"{count_nouns(plan.budget, 'candidate')} per law, {sampled} of a Latin hypercube, the "
        f"others refined; seed {plan.seed}",
        f"{scenario.duration_s:g} s of {scenario.name} with its seed {scenario.seed}, torques "
        f"clamped at {limits} N m",
        knowledge,
        "class: judged from the motion in the second half of each run alone, without the twins "
        "and roots that trilat certify uses for a log",
        "error: RMS distance of the arms from the pose of a weightless consensus; effort: RMS "
        "of tau - G(q)",
    ]

    weights = weigh_joints(scenario)
    if weights:
        shares = ", ".join(f"{weight:g}" for weight in weights)
        lines.append(
            f"Kp, Kd, K and d of the joints are {shares} times the number, by their inertia"
        )
    if plan.others:
        seeds = count_nouns(1 + len(plan.others), "seed")
        lines.append(f"every candidate is the mean of {seeds}, with its 95 % interval")
    if plan.objective == "settling":
        lines.append(
            "minimised: the time from which the largest |e| stays below 0.01 rad, and effort"
        )
    if plan.twin:
        lines.append(
            "the pose is judged on the twin: the scenario without walls and without torques "
            "that have no target"
        )
    return lines


def _list_class_meanings() -> list[str]:
    """Returns one line per behaviour class, such as stable, with its meaning.

    The report prints these lines below the table of control laws. A run belongs to the first
    class that applies.
    """
    return [f"{outcome.word}: {text}" for outcome, text in CLASS_MEANINGS.items()]


def _format_list(lines: Sequence[str]) -> str:
    """Formats lines as a bulleted list in Markdown, one bullet per line."""
    return "\n".join(f"- {line}" for line in lines)


def _format_code(lines: Sequence[str]) -> str:
    """Formats lines as a fenced code block in Markdown."""
    return "\n".join(["```", *lines, "```"])


FRONT_WIDTH_IN = 3.5
"""Width of the figure, in inches, equal to one column of a two-column page."""
_HEIGHT_IN = 3.1
"""Height of the figure, in inches."""
_SIZE_PT = 8.0
"""Font size of the figure."""
_MARKS = ("o", "s", "^", "D", "v", "P")
"""Markers of the laws."""
# Labels of the vertical axis.
_LABELS = {"error": "error (rad)", "settling": "settling time (s)"}


def _draw_law(axes: Axes, search: "CandidateSearch") -> Line2D:
    """Draws the stable runs of a law as faint points, and its Pareto front as steps on top.

    Returns:
        The legend entry of the law, with the numbers of stable and of all candidates.
    """
    law = search.space.law
    # A built-in law has the same marker and colour in every figure.
    laws = list(dict.fromkeys([*SEARCH_SPACES, law]))
    rank = laws.index(law)
    marker = _MARKS[rank % len(_MARKS)]
    colour = SITE_COLOURS[rank % len(SITE_COLOURS)]

    settled = [point for point in search.points if point is not None]
    axes.plot(
        [effort_nm for _, effort_nm in settled],
        [value for value, _ in settled],
        marker=marker,
        color=colour,
        linestyle="",
        markersize=2.0,
        alpha=0.3,
        markeredgewidth=0.0,
    )

    look: dict[str, Any] = {
        "marker": marker,
        "markersize": 3.5,
        "linewidth": 1.1,
        "color": colour,
    }
    front = search.front_points
    efforts_nm = [effort_nm for _, effort_nm in front]
    values = [value for value, _ in front]
    axes.step(efforts_nm, values, where="post", **look)

    stable = search.outcomes[CandidateClass.SETTLED]
    return Line2D([], [], label=f"{law} ({stable}/{len(search.scores)})", **look)


def _draw_paper_gains(axes: Axes, tuned: "TuningResult") -> list[Line2D]:
    """Draws the scores of the published gains as stars, for comparison.

    Returns:
        Their legend entries. If a variant has no point in the figure, its entry states why.
    """
    entries = []
    for result, fill in zip(tuned.printed, ("full", "none"), strict=True):
        look: dict[str, Any] = {
            "linestyle": "",
            "marker": "*",
            "markersize": 7.0,
            "fillstyle": fill,
            "color": style.REFERENCE,
        }
        label = result.name
        outcome = result.score.outcome
        point = tuned.plan.objective.point(result.score)
        if point is not None:
            value, effort_nm = point
            axes.plot([effort_nm], [value], **look)
        elif outcome is CandidateClass.SETTLED:
            label += " (never)"  # a stable run whose |e| is still above the limit at its end
        else:
            label += f" ({outcome.word})"
        entries.append(Line2D([], [], label=label, **look))
    return entries

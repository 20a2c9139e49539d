"""Runs one cell of a sweep in virtual time and classifies how the run ends.

A cell is one combination of the swept parameters. Its run is classified as converged,
oscillating, diverged or undecided. If a run is still undecided at the end of its duration, it
is extended and classified again.

Invariant:
    - A result depends only on the cell's scenario and on the longest allowed duration.
    - A log of the same run gets the same verdict, because both use `judge.VirtualRun`
      and the roots of `loop_roots`.
    - To save space, a run stores only the difference between the text of its scenario and that
      of the sweep's scenario. The full text can be restored exactly.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import chain
from typing import Any, NamedTuple

import msgspec

from trilat_net.analysis import (
    SETTLED_ERROR_RAD,
    EndBehaviour,
    GrowthColumn,
    RunEnd,
    Stability,
    VirtualRun,
)
from trilat_net.execution import FusedRun
from trilat_net.results import finite_or_none
from trilat_net.scenario import Scenario, parse_embedded


class CellClass(StrEnum):
    """Class of a run of a sweep, according to how it ended, such as converged or undecided.

    The values are the words that appear in tables and on the page of a stability map.
    """

    CONVERGED = "converged"
    BOUNDED = "bounded oscillation"
    DIVERGED = "diverged"
    UNDECIDED = "undecided"
    REFUSED = "refused"

    @property
    def stable(self) -> bool | None:
        """True if a run of this class counts as stable, False if not, `None` if unknown.

        Only converged runs count as stable. The stability is unknown for undecided runs, and
        for cells that were rejected because their scenarios are not valid.
        """
        if self in (CellClass.UNDECIDED, CellClass.REFUSED):
            return None
        return self is CellClass.CONVERGED

    @classmethod
    def of_decision(cls, stability: Stability, behaviour: EndBehaviour) -> "CellClass":
        """Returns the class of a run, given the verdict on its stability.

        A run that is stable or settled counts as converged. A run that is not stable counts as
        diverged if an arm left its limits, if the arms drift or if their motion grows, and as
        bounded otherwise.

        Args:
            stability: The verdict.
            behaviour: How the run ends.
        """
        if stability in (Stability.STABLE, Stability.SETTLED):
            return CellClass.CONVERGED
        if stability is not Stability.NOT_STABLE:
            return CellClass.UNDECIDED
        return CellClass.DIVERGED if behaviour in _DIVERGING else CellClass.BOUNDED


RUN_CLASSES = tuple(verdict for verdict in CellClass if verdict is not CellClass.REFUSED)
"""Classes of a cell that was run. A rejected cell has no valid scenario and is not run."""
TOTAL_KEYS = ("rms_error_rad", "effort_nm", "force_peak_n", "walls_j")
"""Fields of a result that summarise the whole run, see `RunTotals`."""


_DIVERGING = (EndBehaviour.DIVERGED, EndBehaviour.DRIFTS, EndBehaviour.GROWS)


class CellResult(msgspec.Struct, frozen=True):
    """Result of one run of a sweep: how it ended, and its measured quantities.

    Below, e is the error of a site against its reference, and qd the velocity of a joint.

    Attributes:
        verdict: Class of the cell.
        motion: Behaviour at the end, as in the stability certificate. It distinguishes growth
            from divergence, and decay from convergence. If there was no run, because the
            scenario of the cell is not valid or because the cell was judged by its linearised
            loop, this and all measured quantities are `None`.
        ran_s: Duration of the run, in s, including extensions. Shorter than planned if an arm
            left its limits.
        extended: Number of times that the duration was doubled.
        end_error_rad: Largest |e| of the last second, in rad.
        end_speed_rad_s: Largest |qd| of the last second, in rad/s.
        error_rate_per_s: Rate of the trend exp(rate t) of |e| over the second half of the run,
            in 1/s. `None` if there is no trend.
        speed_rate_per_s: Rate of the trend of |qd|, in 1/s. `None` if there is no trend.
        peak_error_rad: Largest |e| of the run, in rad.
        settled_s: Time from which |e| stays below 0.01 rad, in s. `None` if |e| is not below
            0.01 rad at the end.
        diverged_s: Time at which the first site left its limits, in s. `None` if no site did.
        rms_error_rad: See `RunTotals`. The fields from this one to `walls_j` cover the
            scenario's duration, excluding extensions.
        effort_nm: See `RunTotals`.
        force_peak_n: See `RunTotals`.
        walls_j: See `RunTotals`.
        reasons: Reasons why the run is undecided, or why its cell was rejected, as a string.
        exponent_per_s: Growth exponent over the scenario's duration, from twins (repetitions
            with a small push), in 1/s, see `sweep_run`. `None` if there were no twins, or if no
            twin moved. In a sweep that is judged linearly, the real part of the rightmost root.
        stability: The verdict on the stability of the run, as in the stability certificate.
            Empty in results of older versions.
        rests_on: Evidence for the verdict, for example exact roots. Empty in results of older
            versions.
    """

    verdict: CellClass
    motion: EndBehaviour | None
    ran_s: float
    extended: int
    end_error_rad: float | None
    end_speed_rad_s: float | None
    error_rate_per_s: float | None
    speed_rate_per_s: float | None
    peak_error_rad: float | None
    settled_s: float | None
    diverged_s: float | None
    rms_error_rad: float | None = None
    effort_nm: float | None = None
    force_peak_n: float | None = None
    walls_j: float | None = None
    reasons: str = ""
    exponent_per_s: float | None = None
    stability: str = ""
    rests_on: str = ""

    @classmethod
    def unsimulated(cls, verdict: CellClass, reasons: str) -> "CellResult":
        """Creates the result of a cell whose class was determined without a simulation.

        Args:
            verdict: Class of the cell.
            reasons: Reasons why the cell was rejected or is undecided. Otherwise empty.
        """
        return cls(
            verdict=verdict,
            motion=None,
            ran_s=0.0,
            extended=0,
            end_error_rad=None,
            end_speed_rad_s=None,
            error_rate_per_s=None,
            speed_rate_per_s=None,
            peak_error_rad=None,
            settled_s=None,
            diverged_s=None,
            reasons=reasons,
        )

    @classmethod
    def judge_linearly(cls, scenario: Scenario) -> "CellResult":
        """Judges the stability of a cell from its linearised loop, without a simulation.

        The loop is stable if all its characteristic roots have negative real parts. The result
        is undecided if the scenario has no linearised loop, or if nothing moves.

        Args:
            scenario: Scenario of the cell.
        """
        column = GrowthColumn.compute([scenario], "", [0.0], at_mean_pose=True)
        (rate_per_s,) = column.growth_per_s
        remarks = "; ".join(column.remarks)
        if math.isnan(rate_per_s):
            return cls.unsimulated(CellClass.UNDECIDED, remarks)
        if math.isinf(rate_per_s):
            return cls.unsimulated(CellClass.UNDECIDED, "nothing moves in the linear loop")

        verdict = CellClass.DIVERGED if rate_per_s > 0.0 else CellClass.CONVERGED
        basis = "Floquet multipliers" if column.is_sampled else "characteristic roots"
        reasons = [f"{basis} of the linear loop", *column.remarks]
        return msgspec.structs.replace(
            cls.unsimulated(verdict, ""),
            exponent_per_s=rate_per_s,
            rests_on="; ".join(reasons),
        )

    @property
    def is_conclusive(self) -> bool:
        """True if a longer run would very probably end in the same way.

        This is the case if one of the following conditions is met:

        - An arm left its limits, or the arms came to rest or drift.
        - The motion clearly grows: over the second half of the run, the largest speed doubled.
        - The motion is bounded and steady: over the second half of the run, the logarithms of
          the largest error and of the largest speed changed by at most `FLAT_LOG_CHANGE`.

        Decay is not conclusive. Near the limit of stability, a slowly growing motion can be
        hidden by a decaying motion until the decaying motion has vanished.
        """
        if self.motion is EndBehaviour.BOUNDED:
            error_change, speed_change = _log_changes(self)
            return max(abs(error_change), abs(speed_change)) <= FLAT_LOG_CHANGE
        if self.motion is EndBehaviour.GROWS:
            return _has_pronounced_trend(self)
        return self.motion in (
            EndBehaviour.DIVERGED,
            EndBehaviour.CONVERGED,
            EndBehaviour.DRIFTS,
        )


FLAT_LOG_CHANGE = 0.02
"""Largest change of the logarithm of an amplitude over half a run that counts as constant."""


def check_sweepable(scenario: Scenario) -> None:
    """Raises ScenarioError if a scenario cannot be run in a sweep.

    Sweeps run in virtual time in the compiled loop. Scenarios that need a live network, or that
    the compiled loop cannot run, are rejected.

    Args:
        scenario: The scenario.

    Raises:
        ScenarioError: See `Scenario.refuse_live_only` and `FusedRun.check_scenario`.
    """
    scenario.refuse_live_only()
    FusedRun.check_scenario(scenario)


class _CellInProgress:
    """A run of a sweep in progress, which may still be extended.

    Args:
        scenario: Scenario of the cell. Its `duration_s` is the initial duration.
        longest_s: Longest duration of the run, in s.

    Attributes:
        duration_s: Initial duration of the run, in s.
        run: The run.
    """

    def __init__(self, scenario: Scenario, longest_s: float) -> None:
        self.duration_s = scenario.duration_s
        self._scenario = scenario
        self._longest_s = longest_s
        self._end_s = scenario.duration_s
        self._extended = 0
        self.run = FusedRun(scenario, SETTLED_ERROR_RAD)

    def note_first_end(self) -> None:
        """Evaluates the run at the end of its planned duration, before any extension.

        Totals, such as the RMS error, cover the run up to this point. A run that chatters at a
        wall is not extended, see `classify_cell`.
        """
        self._totals = self.run.totals._asdict()
        self._evaluate()
        if self._end_s < self._longest_s and _chatters(self._scenario, self.run):
            self._longest_s = self._end_s

    def find_next_end(self) -> float | None:
        """Returns the time to which the run must continue, in s, or `None` if it is finished.

        A run is finished if a longer run would end in the same way, or if it has reached the
        longest allowed duration. Otherwise, its duration is doubled, up to this limit.
        """
        if self._is_finished or self._end_s >= self._longest_s:
            return None
        return min(2.0 * self._end_s, self._longest_s)

    def note_extension(self, end_s: float) -> None:
        """Evaluates the run again after an extension.

        Args:
            end_s: New end of the run, in s.
        """
        self._end_s = end_s
        self._extended += 1
        self._evaluate()

    def judge(self) -> CellResult:
        """Classifies how the run ended, according to the stability certificate.

        Called once, after the last extension, because the certificate needs the roots of the
        control loop, which are slow to compute.
        """
        judged = VirtualRun(self._scenario, self.run)
        decision = judged.decision
        return msgspec.structs.replace(
            self._outcome,
            verdict=CellClass.of_decision(decision.stability, judged.end.behaviour),
            reasons="; ".join(decision.reasons),
            stability=decision.stability.value,
            rests_on=decision.rests_on,
        )

    def _evaluate(self) -> None:
        """Measures the run so far and decides whether a longer run would end in the same way.

        Under a user's law, a lasting motion may be a decay that is too slow to show. Only in
        this case are the roots of the loop computed, which takes longer than the measurement.
        """
        run_end = RunEnd.of_run(self.run, self._scenario)
        self._outcome = _build_result(self.run, run_end, self._totals, self._extended)
        self._is_finished = self._outcome.is_conclusive
        has_user_law = bool(self._scenario.user_laws)
        if self._is_finished and has_user_law and run_end.stability is Stability.NOT_STABLE:
            roots = VirtualRun(self._scenario, self.run, run_end).roots
            self._is_finished = roots.measure_decay_misfit(run_end) > 1.0


def classify_cell(text: str, longest_s: float) -> CellResult:
    """Runs a cell in virtual time and classifies how the run ends.

    While a longer run might belong to another class (see `CellResult.is_conclusive`), the
    duration is doubled and the same run continues, up to `longest_s`. The class then follows
    from the stability certificate's verdict on the complete run, see `CellClass.of_decision`.

    A run in which an arm chatters at a wall is not extended. An arm chatters if small motions
    grow in contact with a wall whose force is computed only once per tick. Chatter may end
    after minutes, once the parameter estimates of the law have drifted, but this does not make
    the cell stable.

    Args:
        text: Canonical text of the cell's scenario. Its `duration_s` is the initial duration.
        longest_s: Longest duration of the run, in s. The run is not extended if this is no
            longer than its initial duration.
    """
    cell = _CellInProgress(parse_embedded(text), longest_s)
    cell.run.advance_to(cell.duration_s)
    cell.note_first_end()
    while (end_s := cell.find_next_end()) is not None:
        cell.run.advance_to(end_s)
        cell.note_extension(end_s)
    return cell.judge()


class _JudgedCell(NamedTuple):
    """Result of a cell, which was simulated together with others if possible.

    Attributes:
        result: Result of the cell.
        obstacle: Reason why the cell was run alone. Empty if it ran side by side with others.
    """

    result: CellResult
    obstacle: str


def classify_cells(scenarios: Iterable[Scenario], longest_s: float) -> Iterator[_JudgedCell]:
    """Runs cells side by side where possible, and classifies how each run ends.

    The results equal those of `classify_cell`, which explains the method.

    Args:
        scenarios: Scenarios of the cells. Each `duration_s` is the initial duration.
        longest_s: Longest duration of each run, in s.

    Yields:
        The results in the order of the cells.
    """
    # A single run must not load the code of lanes.
    from trilat_net.core import RunGroup

    cells = [_CellInProgress(scenario, longest_s) for scenario in scenarios]
    runs = [cell.run for cell in cells]
    obstacles = [""] * len(cells)
    for group in RunGroup.divide(runs):
        for index in group.members:
            obstacles[index] = group.obstacle
        # Cells of a group have the same duration, and are extended to the same times.
        running_cells = [cells[index] for index in group.members]
        group.advance_to(running_cells[0].duration_s)
        for cell in running_cells:
            cell.note_first_end()
        while unfinished := _list_unfinished(running_cells):
            group.keep(unfinished)
            running_cells = [running_cells[position] for position in unfinished]
            end_s = running_cells[0].find_next_end()
            assert end_s is not None
            group.advance_to(end_s)
            for cell in running_cells:
                cell.note_extension(end_s)
    for cell, obstacle in zip(cells, obstacles, strict=True):
        yield _JudgedCell(cell.judge(), obstacle)


def _list_unfinished(cells: Sequence[_CellInProgress]) -> list[int]:
    """Returns the indices of the cells whose runs are not conclusive and must continue."""
    return [position for position, cell in enumerate(cells) if cell.find_next_end() is not None]


def _chatters(scenario: Scenario, run: FusedRun) -> bool:
    """Returns True if small motions of a run grow in contact with a sampled wall.

    The force of a sampled wall is computed once per tick and then held, so the wall can
    generate energy.

    Args:
        scenario: Scenario of the run.
        run: The run, up to the duration of the scenario.
    """
    environments = chain.from_iterable(spec.environment for spec in scenario.sites.values())
    if not any(environment.actor.sampled for environment in environments):
        return False
    return VirtualRun(scenario, run).roots.is_refutation


def _has_pronounced_trend(outcome: CellResult) -> bool:
    """Returns True if the trend of a motion is clear enough to end the run.

    This is the case if, over the second half of the run, the largest speed doubled or both the
    largest error and the largest speed halved.

    Args:
        outcome: Result of the run.
    """
    error_change, speed_change = _log_changes(outcome)
    doubled = speed_change >= math.log(2.0)
    halved = max(error_change, speed_change) <= -math.log(2.0)
    return doubled or halved


def _log_changes(outcome: CellResult) -> tuple[float, float]:
    """Returns the changes of log |e| and log |qd| over the second half of a run.

    A change of 0.69 is a doubling. An amplitude with no trend counts as unchanged.

    Args:
        outcome: Result of the run, with the rates of both amplitudes.
    """
    half_s = 0.5 * outcome.ran_s
    error_change = half_s * (outcome.error_rate_per_s or 0.0)
    speed_change = half_s * (outcome.speed_rate_per_s or 0.0)
    return error_change, speed_change


def _build_result(
    run: FusedRun, end: RunEnd, totals: Mapping[str, Any], extended: int
) -> CellResult:
    """Returns the result of a run of a sweep up to its current end.

    Args:
        run: The run.
        end: How the motion ends.
        totals: Totals over the scenario's duration, excluding extensions, see `RunTotals`.
        extended: Number of times that the duration was doubled.
    """
    return CellResult(
        verdict=CellClass.of_decision(end.stability, end.behaviour),
        motion=end.behaviour,
        ran_s=run.ran_s,
        extended=extended,
        end_error_rad=end.end_error_rad,
        end_speed_rad_s=end.end_speed_rad_s,
        error_rate_per_s=finite_or_none(end.error.rate_per_s),
        speed_rate_per_s=finite_or_none(end.speed.rate_per_s),
        peak_error_rad=max(float(values[:, 0].max()) for values in run.maxima),
        settled_s=run.settled_s,
        diverged_s=end.diverged_at_s,
        **totals,
        reasons="; ".join(end.reasons),
    )


LineDiff = tuple[str | tuple[int, int], ...]
"""A text as differences from a base text: in order, ranges (first, last) of line numbers of the
base, and lines that the base does not contain.
"""


def diff_lines(text: str, base: str) -> LineDiff:
    """Encodes a string as its differences from a similar string, to save space in a file.

    `apply_diff` restores the string. The differences need not be minimal: each line is looked
    up in the base text, first at the position after the previous match and then at its first
    occurrence.

    Args:
        text: The string to encode.
        base: The similar string.
    """
    base_lines = base.split("\n")
    # In reversed order the first occurrence of a line is entered last, and so it is kept.
    first_index = {line: index for index, line in reversed(list(enumerate(base_lines)))}
    parts: list[str | tuple[int, int]] = []
    next_index = 0  # index in the base after the previous line
    for line in text.split("\n"):
        # most lines follow the previous line in the base, too
        follows_base = next_index < len(base_lines) and base_lines[next_index] == line
        index = next_index if follows_base else first_index.get(line)
        if index is None:
            parts.append(line)
            next_index += 1
            continue

        previous = parts[-1] if parts else None
        if isinstance(previous, tuple) and previous[1] + 1 == index:
            parts[-1] = (previous[0], index)  # the line extends the previous range
        else:
            parts.append((index, index))
        next_index = index + 1
    return tuple(parts)


def apply_diff(parts: Iterable[str | Sequence[int]], base: str) -> str:
    """Restores a string from its differences from another string, see `diff_lines`.

    Args:
        parts: Differences, as returned by `diff_lines`.
        base: The base string.
    """
    base_lines = base.split("\n")
    lines = list[str]()
    for part in parts:
        if isinstance(part, str):
            lines.append(part)
        else:
            first, last = part
            lines.extend(base_lines[first : last + 1])
    return "\n".join(lines)


class CellRun(msgspec.Struct, frozen=True):
    """A finished run of a sweep with its result, as stored in the sweep's journal.

    Attributes:
        cell: Number of the cell.
        seed: Random seed of the run.
        random: True if the run draws random numbers, so that another seed gives another run.
        law: Control laws of the sites, without duplicates.
        sha256: Digest of the run's scenario.
        scenario: Canonical text of the run's scenario, as differences from the scenario of the
            sweep.
        outcome: Result of the run.
        metrics: Further metrics requested for the sweep, measured over the scenario's duration,
            by key. `None` for a metric that the run does not have.
        alone: Reason why the run was computed alone, in a sweep whose runs are computed side by
            side. Empty if it was not computed alone.
    """

    cell: int
    seed: int
    random: bool
    law: str
    sha256: str
    scenario: LineDiff
    outcome: CellResult
    metrics: dict[str, float | None] = {}
    alone: str = ""

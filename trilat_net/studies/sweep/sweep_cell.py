"""Runs one cell of a sweep in virtual time and classifies its end.

A run that is undecided at the end of its duration is extended and classified again.

Invariant:
    - A result is a function of the cell's scenario and of the longest allowed duration.
    - The class follows from the same numbers as the certificate: a log of the same run has the
      same class.
    - A run stores its scenario as a line diff against the experiment's text:
      `apply_diff(diff_lines(text, base), base) == text` holds for all texts.
"""

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from itertools import chain

import msgspec
import numpy as np

from ...analysis.envelope_trend import FLOOR_RAD, EnvelopeTrend
from ...analysis.run_end import EndBehaviour, RunEnd, RunTrace, Stability, classify_run_end
from ...analysis.site_signals import SETTLED_ERROR_RAD
from ...analysis.twin_growth import TwinGrowth, measure_virtual_twins
from ...execution.fused import FusedRun, RunTotals, check_fusable
from ...results import finite_or_none
from ...scenario import Scenario, parse_scenario
from ...scenario.validate import refuse_live_only


class CellClass(StrEnum):
    """Class of a cell; the values are the texts in results and on pages."""

    CONVERGED = "converged"
    BOUNDED = "bounded oscillation"
    DIVERGED = "diverged"
    UNDECIDED = "undecided"

    @property
    def stable(self) -> bool | None:
        """True if the run is stable, False if it is not stable, None if it is undecided."""
        return None if self is CellClass.UNDECIDED else self is CellClass.CONVERGED


def classify_end(end: RunEnd) -> CellClass:
    """Returns the class of a cell from the end of its run.

    A run that is not stable and not bounded counts as diverged: drift and growth included.
    """
    if end.stability is Stability.STABLE:
        return CellClass.CONVERGED
    if end.stability is not Stability.NOT_STABLE:
        return CellClass.UNDECIDED
    bounded = end.behaviour is EndBehaviour.BOUNDED
    return CellClass.BOUNDED if bounded else CellClass.DIVERGED


class CellResult(msgspec.Struct, frozen=True):
    """Result of one run of a cell.

    Attributes:
        verdict: the class of the cell.
        motion: the behaviour at the end, as in the certificate: it distinguishes growth from
            divergence, and decay from convergence.
        ran_s: duration of the run, in s, with extensions and an early stop.
        extended: number of times that the duration was doubled.
        end_error_rad: largest abs(e) of the last second, in rad.
        end_speed_rad_s: largest abs(qd) of the last second, in rad/s.
        error_rate_per_s: rate of the trend exp(rate t) of abs(e) over the second half of the
            run, in 1/s; None without a trend.
        speed_rate_per_s: the rate of abs(qd), likewise.
        peak_error_rad: largest abs(e) of the run, in rad.
        settled_s: time from which abs(e) stays below 0.01 rad, in s; None if abs(e) is not
            below 0.01 rad at the end.
        diverged_s: time at which the first site left its limits, in s, or None.
        rms_error_rad: see `RunTotals`; this field and those down to `walls_j` cover the
            scenario's duration without extensions.
        effort_nm: see `RunTotals`.
        force_peak_n: see `RunTotals`.
        walls_j: see `RunTotals`.
        reasons: the reasons for which the run is undecided, as a text.
        exponent_per_s: growth exponent of the run's twins over the scenario's duration, in 1/s
            (see `measure_exponent`); None without twins, or if no twin moved.
    """

    verdict: CellClass
    motion: EndBehaviour
    ran_s: float
    extended: int
    end_error_rad: float
    end_speed_rad_s: float
    error_rate_per_s: float | None
    speed_rate_per_s: float | None
    peak_error_rad: float
    settled_s: float | None
    diverged_s: float | None
    rms_error_rad: float | None = None
    effort_nm: float | None = None
    force_peak_n: float | None = None
    walls_j: float | None = None
    reasons: str = ""
    exponent_per_s: float | None = None


TWINS_OF_A_CELL = 4
"""Number of twins: pushes of all joints at once and of single joints, and, under the adaptive
law, of the estimates.
"""
FLAT_LOG_CHANGE = 0.02
"""Largest change of the logarithm of a limit cycle's envelope over half a run."""


def check_sweepable(scenario: Scenario) -> None:
    """Refuses a scenario that needs a live network or that the fused loop cannot run.

    Raises:
        ScenarioError: see `refuse_live_only` and `check_fusable`.
    """
    refuse_live_only(scenario)
    check_fusable(scenario)


def classify_cell(text: str, longest_s: float) -> CellResult:
    """Runs a cell in virtual time and returns its result.

    While the run is not conclusive at its end (see `is_conclusive`), its duration is doubled
    and the same run continues. If the run is still not conclusive at `longest_s`, the class of
    the certificate applies, with two exceptions:

    - A slow trend in a run that draws random numbers is undecided: the error of such a run
      wanders, and a slow trend is chance.
    - A run that looks stable although a joint still moves is undecided unless the pushes of its
      twins decay.

    A run whose small motions grow in contact with a sampled wall is not extended and is not
    stable: such chatter may end after minutes, once the estimates have drifted, but this does
    not make the cell stable.

    Args:
        text: the canonical text of the cell's scenario; its `duration_s` is the initial
            duration.
        longest_s: longest duration of the run, in s; a run is not extended if this does not
            exceed its `duration_s`.
    """
    scenario = parse_scenario(text)
    run = FusedRun(scenario, SETTLED_ERROR_RAD)
    ends_s = scenario.duration_s
    growth_per_s = _advance_in_contact(scenario, run)
    totals = run.totals
    extended = 0
    outcome = _build_result(run, scenario, totals, extended)
    if growth_per_s > 0.0:
        diverged = outcome.verdict is CellClass.DIVERGED
        verdict = CellClass.DIVERGED if diverged else CellClass.BOUNDED
        reason = f"in contact with a sampled wall small motions grow by {growth_per_s:+.3g} /s"
        return msgspec.structs.replace(outcome, verdict=verdict, reasons=reason)
    while not is_conclusive(outcome) and ends_s < longest_s:
        ends_s = min(2.0 * ends_s, longest_s)
        extended += 1
        run.advance_to(ends_s)
        outcome = _build_result(run, scenario, totals, extended)
    undecided = CellClass.UNDECIDED
    has_trend = outcome.motion in (EndBehaviour.GROWS, EndBehaviour.DECAYS)
    if scenario.links_random and has_trend and not _has_pronounced_trend(outcome):
        return msgspec.structs.replace(outcome, verdict=undecided)
    if outcome.verdict is CellClass.CONVERGED and _is_still_moving(run):
        twins = _measure_twins(scenario, run)
        if twins.trend not in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY):
            return msgspec.structs.replace(outcome, verdict=undecided, reasons=twins.text)
    return outcome


def measure_exponent(scenario: Scenario) -> float | None:
    """Returns the growth exponent of a run, in 1/s; None if no push moved anything.

    The exponent is the largest rate of the run's twins over the judged part, where a small push
    changes as exp(exponent t); see `analysis.twin_growth`.
    """
    run = FusedRun(scenario, SETTLED_ERROR_RAD)
    run.advance_to(scenario.duration_s)
    twins = _measure_twins(scenario, run)
    rates_per_s = [push.rate_per_s for push in twins.pushes]
    return max(filter(math.isfinite, rates_per_s), default=None)


def _measure_twins(scenario: Scenario, run: FusedRun) -> TwinGrowth:
    """Returns the growth of small pushes to a run, up to the time that the run has reached."""
    end = classify_run_end(scenario, RunTrace(run.buckets, run.tau_x, run.diverged_s))
    return measure_virtual_twins(scenario, end, run.ran_s, TWINS_OF_A_CELL)


def _is_still_moving(run: FusedRun) -> bool:
    """Returns True if the largest speed of a joint did not halve over the second half of a run.

    The first and the last quarter of this half are compared.
    """
    for maxima in run.buckets:
        joints = maxima.shape[1] // 3  # the second third of the columns has the speeds
        speeds = maxima[len(maxima) // 2 :, joints : 2 * joints]
        quarter = len(speeds) // 4
        first = speeds[:quarter].max(axis=0)
        last = speeds[-quarter:].max(axis=0)
        if (last > np.maximum(0.5 * first, FLOOR_RAD)).any():
            return True
    return False


def _advance_in_contact(scenario: Scenario, run: FusedRun) -> float:
    """Runs a scenario to its duration; returns the growth rate of contact chatter, in 1/s.

    The rate is that of small motions at a sampled wall. It is 0 if they do not grow, and if no
    sampled wall is touched in the last quarter; see `find_contact_growth`.
    """
    environments = chain.from_iterable(spec.environment for spec in scenario.sites.values())
    if not any(environment.actor.sampled for environment in environments):
        run.advance_to(scenario.duration_s)
        return 0.0
    states = run.run_and_sample(scenario.duration_s)
    if run.diverged_s is not None:
        return 0.0
    # imported late: SciPy costs a worker half a second, and only sampled walls need it
    from ...theory.characteristic_roots import STABILITY_EDGE_PER_S
    from ...theory.linear_edge import find_contact_growth

    growth_per_s = find_contact_growth(scenario, *states)
    return growth_per_s if growth_per_s > STABILITY_EDGE_PER_S else 0.0


def is_conclusive(outcome: CellResult) -> bool:
    """Returns True if a longer run would hardly have another class.

    A run is conclusive if
    - a site left its limits,
    - it came to rest,
    - it drifts,
    - it grows, and the trend over the second half is pronounced: the largest speed doubled, or
      error and speed both halved, or
    - it is bounded, and neither the largest error nor the largest speed changed its logarithm
      by more than `FLAT_LOG_CHANGE` over the second half.

    Decay is not conclusive: near the edge of stability a finite run looks steady whatever its
    later course, and a decaying motion may hide a slowly growing one until it has vanished.
    """
    if outcome.motion is EndBehaviour.BOUNDED:
        error_change, speed_change = _log_changes(outcome)
        return max(abs(error_change), abs(speed_change)) <= FLAT_LOG_CHANGE
    if outcome.motion is EndBehaviour.GROWS:
        return _has_pronounced_trend(outcome)
    return outcome.motion in (
        EndBehaviour.DIVERGED,
        EndBehaviour.CONVERGED,
        EndBehaviour.DRIFTS,
    )


def _has_pronounced_trend(outcome: CellResult) -> bool:
    """Returns True if the speed doubled, or error and speed halved, over the second half."""
    error_change, speed_change = _log_changes(outcome)
    doubled = speed_change >= math.log(2.0)
    halved = max(error_change, speed_change) <= -math.log(2.0)
    return doubled or halved


def _log_changes(outcome: CellResult) -> tuple[float, float]:
    """Returns the changes of log(abs(e)) and of log(abs(qd)) over the second half of a run."""
    half_s = 0.5 * outcome.ran_s
    error_change = half_s * (outcome.error_rate_per_s or 0.0)
    speed_change = half_s * (outcome.speed_rate_per_s or 0.0)
    return error_change, speed_change


def _build_result(
    run: FusedRun, scenario: Scenario, totals: RunTotals, extended: int
) -> CellResult:
    """Returns the result of a run up to the time that the run has reached."""
    end = classify_run_end(scenario, RunTrace(run.buckets, run.tau_x, run.diverged_s))
    return CellResult(
        verdict=classify_end(end),
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
        **totals._asdict(),
        reasons="; ".join(end.reasons),
    )


LineDiff = tuple[str | tuple[int, int], ...]
"""Parts of a text, in order: ranges (first, last) of lines of the base, and lines that the base
lacks.
"""


def diff_lines(text: str, base: str) -> LineDiff:
    """Returns the diff of a text against a base: `apply_diff` restores the text."""
    base_lines = base.split("\n")
    first_index = {line: index for index, line in reversed(list(enumerate(base_lines)))}
    parts: list[str | tuple[int, int]] = []
    expected = 0  # index of the line in the base if the text continues line by line
    for line in text.split("\n"):
        continues = expected < len(base_lines) and base_lines[expected] == line
        index = expected if continues else first_index.get(line)
        if index is None:
            parts.append(line)
            expected += 1
            continue
        previous = parts[-1] if parts else None
        if isinstance(previous, tuple) and previous[1] + 1 == index:
            parts[-1] = (previous[0], index)
        else:
            parts.append((index, index))
        expected = index + 1
    return tuple(parts)


def apply_diff(parts: Iterable[str | Sequence[int]], base: str) -> str:
    """Returns the text whose diff against a base is `parts`."""
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
    """One finished run of a cell.

    Attributes:
        cell: the number of the cell.
        seed: the seed of the run.
        random: True if the run draws random numbers, so that another seed is another run.
        law: the laws of the sites, without duplicates.
        sha256: the digest of the run's scenario.
        scenario: the canonical text of the scenario, as a diff against the experiment's text.
        outcome: the result of the run.
        metrics: the further metrics of the plan over the scenario's duration, by key; None for
            a metric that the run does not have.
    """

    cell: int
    seed: int
    random: bool
    law: str
    sha256: str
    scenario: LineDiff
    outcome: CellResult
    metrics: dict[str, float | None] = {}

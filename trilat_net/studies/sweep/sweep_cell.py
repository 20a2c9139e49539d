"""One run of a cell: its class and its numbers, and its scenario as what differs from the
experiment.

A run that is undecided when its time is over is extended, and classified by how it ends.

Invariant: a result is a function of the cell's scenario and its longest extension; the class
follows from the same numbers as the certificate, so a log of the same run gets the same one. A
run keeps its scenario as a line diff against the base text: `apply_diff(diff_lines(text, base),
base) == text` for every two texts.
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
    """Class of a cell; the text is the word for people and in results."""

    CONVERGED = "converged"
    BOUNDED = "bounded oscillation"
    DIVERGED = "diverged"
    UNDECIDED = "undecided"

    @property
    def stable(self) -> bool | None:
        """True if the run is stable, False if it is not; None if that is open."""
        return None if self is CellClass.UNDECIDED else self is CellClass.CONVERGED


def classify_end(end: RunEnd) -> CellClass:
    """Returns the class of a cell for the judgement of its run; what drifts or grows has left."""
    if end.stability is Stability.NOT_STABLE:
        return (
            CellClass.BOUNDED if end.behaviour is EndBehaviour.BOUNDED else CellClass.DIVERGED
        )
    return CellClass.CONVERGED if end.stability is Stability.STABLE else CellClass.UNDECIDED


class CellResult(msgspec.Struct, frozen=True):
    """Result of one cell.

    Attributes:
        verdict: its class.
        motion: the word of the certificate, which tells growing from diverged and decaying from
            converged.
        reasons: what leaves the run open, in words.
        ran_s: how long it ran in the end, extensions and an early stop included, s.
        extended: how often its time was doubled because it had not been decided.
        end_error_rad: the largest abs(e) of the last second, rad.
        end_speed_rad_s: the largest abs(qd) of the last second, rad/s.
        error_rate_per_s: the trend of abs(e) over the second half: it goes as exp(rate t), 1/s;
            None where it has none.
        speed_rate_per_s: the same of abs(qd).
        peak_error_rad: the largest abs(e) of the run, rad.
        settled_s: since when abs(e) is below 0.01 rad; None where it is not at the end.
        diverged_s: when the first site left its limits, or None.
        rms_error_rad: this and the others down to `walls_j` are those of `RunTotals`, over the
            duration of the scenario, extensions left out.
        exponent_per_s: the growth exponent of its twins over the duration of the scenario, 1/s,
            see `measure_exponent`; None where no twins were asked for, or none moved.
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
"""All joints at once, and some of them alone; of the adaptive law the estimates too."""
FLAT_LOG_CHANGE = 0.02
"""An envelope whose logarithm changes by no more over half a run is that of a limit cycle."""


def check_sweepable(scenario: Scenario) -> None:
    """Refuses what cannot be run without a network, or not fast.

    Raises:
        ScenarioError: see `refuse_live_only` and `check_fusable`.
    """
    refuse_live_only(scenario)
    check_fusable(scenario)


def classify_cell(text: str, longest_s: float) -> CellResult:
    """Runs a cell in virtual time and returns what became of it.

    A run that is not conclusive when its time is over (see `is_conclusive`) goes on for as long
    again, and so on; its numbers are those of one run. Where that never comes, the
    certificate's word stands, except for a trend of a run in which anything is drawn: such
    errors wander, and a slow trend is chance. A run that looks stable and of which a joint
    moves on is undecided unless the pushes of its twins die away. If small motions grow in
    contact with a sampled wall it is not extended: such chatter may die in minutes, when the
    estimates have drifted, and that makes no cell stable.

    Args:
        text: the canonical text of the cell's scenario, whose `duration_s` is the time it has.
        longest_s: how long it may run in the end, s; not more than its own time: it is never
            extended.
    """
    scenario = parse_scenario(text)
    run = FusedRun(scenario, SETTLED_ERROR_RAD)
    ends_s = scenario.duration_s
    growth_per_s = _advance_in_contact(scenario, run)
    totals = run.totals
    extended = 0
    if growth_per_s > 0.0:
        outcome = _cell_result(run, scenario, totals, extended)
        left = outcome.verdict is CellClass.DIVERGED
        verdict = CellClass.DIVERGED if left else CellClass.BOUNDED
        reason = f"in contact with a sampled wall small motions grow by {growth_per_s:+.3g} /s"
        return msgspec.structs.replace(outcome, verdict=verdict, reasons=reason)
    while (
        not is_conclusive(outcome := _cell_result(run, scenario, totals, extended))
        and ends_s < longest_s
    ):
        ends_s = min(2.0 * ends_s, longest_s)
        extended += 1
        run.advance_to(ends_s)
    trend = outcome.motion in (EndBehaviour.GROWS, EndBehaviour.DECAYS)
    if scenario.links_random and trend and not _pronounced(outcome):
        return msgspec.structs.replace(outcome, verdict=CellClass.UNDECIDED)
    if outcome.verdict is CellClass.CONVERGED and _moves_on(run):
        twins = _measure_twins(scenario, run)
        if twins.trend not in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY):
            return msgspec.structs.replace(
                outcome, verdict=CellClass.UNDECIDED, reasons=twins.text
            )
    return outcome


def measure_exponent(scenario: Scenario) -> float | None:
    """Returns the growth exponent of a run, 1/s: the largest rate of its twins over the judged
    part.

    A small push goes there as exp(exponent t); None if no push moved anything. See
    `analysis.twin_growth`.
    """
    run = FusedRun(scenario, SETTLED_ERROR_RAD)
    run.advance_to(scenario.duration_s)
    found = _measure_twins(scenario, run)
    return max(
        (one.rate_per_s for one in found.pushes if math.isfinite(one.rate_per_s)), default=None
    )


def _measure_twins(scenario: Scenario, run: FusedRun) -> TwinGrowth:
    end = classify_run_end(scenario, RunTrace(run.buckets, run.tau_x, run.diverged_s))
    return measure_virtual_twins(scenario, end, run.ran_s, TWINS_OF_A_CELL)


def _moves_on(run: FusedRun) -> bool:
    """True if the largest speed of a joint did not halve from the first to the last quarter of
    the half.
    """
    for site in run.buckets:
        joints = site.shape[1] // 3
        half = site[len(site) // 2 :, joints : 2 * joints]
        quarter = len(half) // 4
        first = half[:quarter].max(axis=0)
        last = half[-quarter:].max(axis=0)
        if (last > np.maximum(0.5 * first, FLOOR_RAD)).any():
            return True
    return False


def _advance_in_contact(scenario: Scenario, run: FusedRun) -> float:
    """Makes a run of a scenario's own time; returns how fast small motions grow at a sampled
    wall, 1/s.

    0 if they do not, and without one that is touched in the last quarter, see
    `find_contact_growth`.
    """
    if not any(
        one.actor.sampled for spec in scenario.sites.values() for one in spec.environment
    ):
        run.advance_to(scenario.duration_s)
        return 0.0
    states = run.run_and_sample(scenario.duration_s)
    if run.diverged_s is not None:
        return 0.0
    # SciPy takes a worker half a second, which only sampled walls need
    from ...theory.characteristic_roots import STABILITY_EDGE_PER_S
    from ...theory.linear_edge import find_contact_growth

    growth_per_s = find_contact_growth(scenario, *states)
    return growth_per_s if growth_per_s > STABILITY_EDGE_PER_S else 0.0


def is_conclusive(outcome: CellResult) -> bool:
    """True where a longer run would hardly be called something else.

    That is: it left its limits; or it came to rest; or it grows, and the largest speed at least
    doubled over the second half; or neither that nor the largest error changed by more than
    `FLAT_LOG_CHANGE`; or it drifts. Near the edge of stability a finite run looks steady
    whatever it does later, and what decays may hide what grows slowly until it is gone.
    """
    if outcome.motion is EndBehaviour.BOUNDED:
        return max(map(abs, _changes(outcome))) <= FLAT_LOG_CHANGE
    if outcome.motion is EndBehaviour.GROWS:
        return _pronounced(outcome)
    return outcome.motion in (
        EndBehaviour.DIVERGED,
        EndBehaviour.CONVERGED,
        EndBehaviour.DRIFTS,
    )


def _pronounced(outcome: CellResult) -> bool:
    error, speed = _changes(outcome)
    return speed >= math.log(2.0) or max(error, speed) <= -math.log(2.0)


def _changes(outcome: CellResult) -> tuple[float, float]:
    half_s = 0.5 * outcome.ran_s
    return half_s * (outcome.error_rate_per_s or 0.0), half_s * (
        outcome.speed_rate_per_s or 0.0
    )


def _cell_result(
    run: FusedRun, scenario: Scenario, totals: RunTotals, extended: int
) -> CellResult:
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
"""In order: lines of the base, as first and last number, and lines that it has not."""


def diff_lines(text: str, base: str) -> LineDiff:
    """Returns a text as lines of another one and lines of its own."""
    there = base.split("\n")
    first = {line: number for number, line in reversed(list(enumerate(there)))}
    parts: list[str | tuple[int, int]] = []
    expected = 0  # where the text goes on if it has as many lines as the base up to here
    for line in text.split("\n"):
        place = expected if there[expected : expected + 1] == [line] else first.get(line)
        before = parts[-1] if parts else None
        if place is None:
            parts.append(line)
        elif isinstance(before, tuple) and before[1] + 1 == place:
            parts[-1] = (before[0], place)
        else:
            parts.append((place, place))
        expected = (expected if place is None else place) + 1
    return tuple(parts)


def apply_diff(parts: Iterable[str | Sequence[int]], base: str) -> str:
    """Returns the text again."""
    there = base.split("\n")
    lines = (
        [part] if isinstance(part, str) else there[part[0] : part[1] + 1] for part in parts
    )
    return "\n".join(chain.from_iterable(lines))


class CellRun(msgspec.Struct, frozen=True):
    """One finished run.

    Attributes:
        random: whether another seed would be another run.
        law: the laws of its sites, each once.
        scenario: its canonical text, as what differs from that of the experiment.
        metrics: those that the plan asks for besides, over the duration of the scenario; None
            of what the run has no number for.
    """

    cell: int
    seed: int
    random: bool
    law: str
    sha256: str
    scenario: LineDiff
    outcome: CellResult
    metrics: dict[str, float | None] = {}

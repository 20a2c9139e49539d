"""One candidate of a tuning: its scenario, the command that runs it, its run in virtual time, and its score.

Invariant: a candidate's scenario is loaded through the same settings that its command names, and its
score is a function of the scenario alone: None for the errors of a run that does not reach its end.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...analysis.run_end import RunEnd, RunTrace, classify_run_end
from ...analysis.site_signals import SETTLED_ERROR_RAD
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...errors import ScenarioError
from ...scenario import Scenario, parse_scenario
from ...scenario.expect import END_WINDOW_S
from ...scenario.scenario_reader import ExperimentText, read_experiment
from ..commands import format_command, format_toml_value, set_options
from ..intervals import mean_interval
from ..record_batches import RecordBatch, join_batches, run_compiled_in_batches
from .final_posture import CandidateClass, build_twin, classify_candidate, compute_consensus_pose
from .search_space import GainValues, ModelInformation, SearchSpace, SiteControls


class CandidateScore(msgspec.Struct, frozen=True):
    """One candidate, measured; the formulas stand in docs/fair-comparison.md.

    Attributes:
        outcome: its class.
        error_rad: RMS distance of the arms from where they ought to be; None where the run diverged.
        spread_rad: the part of it that is the arms' distance from each other, at one instant, undelayed.
        pose_rad: the part of it that is the distance of their mean from the pose.
        effort_nm: RMS torque beyond what gravity asks at the pose where the arm is.
        settled_s: since when the largest |e| is below 0.01 rad; None where it is not at the end.
        saturated: share of all joint torques that were at the clamp.
        diverged_s: when the first site left its limits, or None.
        seeds: how many runs it is the mean of; its outcome is the worst of theirs.
        error_half_rad, effort_half_nm: half the width of the 95 % interval of that mean; None of one run.
    """

    outcome: CandidateClass
    error_rad: float | None
    spread_rad: float | None
    pose_rad: float | None
    effort_nm: float | None
    settled_s: float | None
    saturated: float
    diverged_s: float | None = None
    seeds: int = 1
    error_half_rad: float | None = None
    effort_half_nm: float | None = None


def average_scores(scores: Sequence[CandidateScore]) -> CandidateScore:
    """Returns the score of a candidate from those of its seeds; a number that one of them lacks is None."""
    if len(scores) == 1:
        return scores[0]
    rank = list(CandidateClass)
    worst = min(scores, key=lambda score: rank.index(score.outcome))
    named = ("error_rad", "spread_rad", "pose_rad", "effort_nm", "settled_s", "saturated")
    means = {name: mean_interval([getattr(score, name) for score in scores]) for name in named}
    error, effort = means["error_rad"], means["effort_nm"]
    return msgspec.structs.replace(
        worst,
        **{name: mean and mean.mean for name, mean in means.items()},
        seeds=len(scores),
        error_half_rad=error and error.half,
        effort_half_nm=effort and effort.half,
    )


def measure_candidate(text: str, twin_text: str | None) -> CandidateScore:
    """Runs a candidate and its twin, and returns its score."""
    run = _run(parse_scenario(text))
    alone = run if twin_text is None else _run(parse_scenario(twin_text))
    outcome = classify_candidate((run.end, alone.end), alone.fall_rad, alone.apart_rad)
    diverged_s = [end.diverged_at_s for end in (run.end, alone.end) if end.diverged_at_s is not None]
    if diverged_s:
        return CandidateScore(outcome, None, None, None, None, None, run.saturated, diverged_s[0])
    error_rad = float(np.hypot(run.spread_rad, alone.pose_rad))
    return CandidateScore(
        outcome, error_rad, run.spread_rad, alone.pose_rad, run.effort_nm, run.settled_s, run.saturated
    )


class _Run(NamedTuple):
    """What is measured of one run; `fall_rad` and `apart_rad` as `classify_candidate` takes them."""

    end: RunEnd
    fall_rad: float
    apart_rad: float
    spread_rad: float
    pose_rad: float
    effort_nm: float
    settled_s: float | None
    saturated: float


def _run(scenario: Scenario) -> _Run:
    kept: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    diverged_s = run_compiled_in_batches(scenario, {name: kept[name].append for name in kept})
    records = list(map(join_batches, kept.values()))
    trace = RunTrace([one.reduce() for one in records], [one.tau_x[-1] for one in records], diverged_s)
    t_s, q, e = _aligned(records)
    mean = q.mean(axis=0)
    apart, off = q - mean, mean - compute_consensus_pose(scenario, t_s)
    last, half_s = t_s > t_s[-1] - END_WINDOW_S, 0.5 * t_s[-1]
    middle = (t_s > half_s - END_WINDOW_S) & (t_s <= half_s + 1e-9)
    end_rad, before_rad = (np.abs(off[part].mean(axis=0)) for part in (last, middle))
    largest = np.abs(e).max(axis=(0, 2))
    apart_at_s = t_s[largest >= SETTLED_ERROR_RAD].max(initial=0.0)
    efforts, saturated = [], []
    for record, site in zip(records, scenario.names, strict=True):
        beyond_nm = record.tau - build_arm_rows(scenario, site).gravity_torque(record.q)
        efforts.append(np.mean(beyond_nm**2))
        saturated.append(np.mean(np.abs(record.tau) >= scenario.sites[site].limits.tau_limit_nm))
    return _Run(
        end=classify_run_end(scenario, trace),
        fall_rad=float((end_rad + 2.0 * np.maximum(end_rad - before_rad, 0.0)).max()),
        apart_rad=float(np.abs(apart[:, last]).max()),
        spread_rad=_rms(apart),
        pose_rad=_rms(off),
        effort_nm=float(np.sqrt(np.mean(efforts))),
        settled_s=float(apart_at_s) if largest[-1] < SETTLED_ERROR_RAD else None,
        saturated=float(np.mean(saturated)),
    )


def _aligned(records: list[RecordBatch]) -> tuple[Array, Array, Array]:
    """Returns the ticks of the slowest site, s, and every site's latest q and e at them, shape (N, K, n)."""
    end_ns = min(record.t_ns[-1] for record in records)
    slowest = min((record.t_ns for record in records), key=len)
    at_ns = slowest[slowest <= end_ns]
    latest = [np.searchsorted(record.t_ns, at_ns, side="right") - 1 for record in records]
    q = np.array([record.q[rows] for record, rows in zip(records, latest, strict=True)])
    e = np.array([record.e[rows] for record, rows in zip(records, latest, strict=True)])
    return at_ns / NS_PER_S, q, e


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


class TuningScenario(NamedTuple):
    """The experiment in which laws are compared; a command calls it by source and overrides KEY=VALUE."""

    written: ExperimentText
    overrides: tuple[str, ...]
    scenario: Scenario

    @property
    def source(self) -> str:
        """What a command calls it."""
        return self.written.called

    def with_controls(self, controls: SiteControls) -> "TuningScenario":
        """Returns the same with the control of every site replaced, in as few settings as say it."""
        single = [f"sites.{name}.control={format_toml_value(table)}" for name, table in controls.items()]
        wanted = self.written.load([*self.overrides, *single])
        first = next(iter(controls.values()))
        if all(table == first for table in controls.values()):
            texts = (*self.overrides, f"control={format_toml_value(first)}")
            with suppress(ScenarioError):  # a site has gains of its own, which are none of this law
                scenario = self.written.load(texts)
                if scenario.sites == wanted.sites:
                    return TuningScenario(self.written, texts, scenario)
        return TuningScenario(self.written, (*self.overrides, *single), wanted)

    def with_gains(
        self, space: SearchSpace, knowledge: ModelInformation, gains: GainValues
    ) -> "TuningScenario":
        """Returns the same under a law with a choice of gains."""
        return self.with_controls(space.controls(self.scenario, knowledge, gains))

    @property
    def texts(self) -> tuple[str, str | None]:
        """The canonical texts of its scenario and of its twin."""
        alone = build_twin(self.scenario)
        return self.scenario.text, None if alone is None else alone.text

    @property
    def command(self) -> str:
        """The command that makes a log of it."""
        return format_command("sim", self.source, *set_options(self.overrides))


class CandidateTask(NamedTuple):
    """One candidate to be run.

    Attributes:
        runs: of each seed the canonical texts of its scenario and of its twin.
        name: what it is called.
    """

    runs: tuple[tuple[str, str | None], ...]
    name: str

    def __str__(self) -> str:
        return self.name


def build_candidate_task(seeds: Sequence[TuningScenario]) -> CandidateTask:
    """Returns what has to be run to measure one candidate, given with every seed."""
    name = ", ".join(seeds[0].overrides) or seeds[0].source
    return CandidateTask(tuple(one.texts for one in seeds), name)


def measure_candidate_task(task: CandidateTask) -> CandidateScore:
    """Runs one task, in whatever process."""
    return average_scores([measure_candidate(*run) for run in task.runs])


def load_tuning_scenario(
    source: str | Path | Mapping[str, Any] | Scenario, overrides: Sequence[str] = ()
) -> TuningScenario:
    """Returns the experiment that a name, a path, a text, tables or a scenario mean with overrides.

    Raises:
        ScenarioError: there is none.
    """
    written = read_experiment(source)
    return TuningScenario(written, tuple(overrides), written.load(overrides))

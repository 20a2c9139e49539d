"""Means over seeds: random draws spread them, and their intervals have the stated coverage."""

import json
import shlex
from pathlib import Path

import msgspec
import numpy as np
import pytest
from trilat_studies.sweep import plan_sweep, prepare_sweep_folder, run_sweep
from trilat_studies.trials import run_trials, trials
from trilat_studies.tuning import plan_tuning
from trilat_studies.tuning.candidate import CandidateClass, CandidateScore

from tests.cli.running import trilat
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario
from trilat_net.work.intervals import MeanInterval

DRAWN = """
name = "drawn"
rate_hz = 100
duration_s = 2.0
[control]
law = "p_d"
K = 20.0
d = 15.0
[link]
delay_ms = 50.0
[sites.m]
role = "master"
q0_rad = { normal = [0.3, 0.05] }
[sites.s]
role = "slave"
environment = [{ kind = "viscous", damping_nm_s_rad = 1.0 }]
[dominance]
m = { s = 1.0 }
s = { m = 1.0 }
[expect]
rms_error_max_rad = 0.5
"""
SEEDS = range(1, 7)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "drawn.toml"
    path.write_text(DRAWN)
    return path


def test_intervals_hold_the_truth_in_95_of_100() -> None:
    draws = np.random.default_rng(1).normal(3.0, 1.0, (2000, 5))
    intervals = [MeanInterval.of_values(row.tolist()) for row in draws]
    holds = [
        abs(interval.mean - 3.0) <= interval.half
        for interval in intervals
        if interval is not None
    ]
    assert len(holds) == 2000
    assert 0.93 < np.mean(holds) < 0.97
    assert MeanInterval.of_values([1.0]) is MeanInterval.of_values([1.0, None]) is None


def test_trials_of_drawn_starts_report_their_spread(file: Path) -> None:
    report = run_trials(trials(file, SEEDS), jobs=1)
    (row,) = report.rows()
    values = [result.outcomes[0].value for result in report.results]
    assert len(set(values)) == len(SEEDS)
    assert row.mean == MeanInterval.of_values(values)
    assert row.mean.half > 0.01 * row.mean.mean
    assert str(row.mean) in report.summary()
    again = load_scenario(file, [f"seed={SEEDS[-1]}"])
    assert report.results[-1].trial.scenario == again


def test_trial_of_distribution_names_its_repeating_command(file: Path) -> None:
    """The printed command draws the same numbers again, because it states the seed."""
    trial = trials(file, [3], {"control.d": {"normal": [15.0, 1.0]}})[0]
    arguments = shlex.split(trial.look)
    settings = [arguments[n + 1] for n, word in enumerate(arguments) if word == "--set"]
    seed = arguments[arguments.index("--seed") + 1]
    assert load_scenario(arguments[2], [*settings, f"seed={seed}"]) == trial.scenario
    assert len(set(trial.scenario.sites["m"].control.d)) == 2


def test_swept_cells_have_the_means_of_seeds(file: Path) -> None:
    plan = plan_sweep(file, over=["link.delay_ms=20,50"], seeds=list(SEEDS), longest_s=2.0)
    results = run_sweep(prepare_sweep_folder(plan, file.parent / "o"), 1).results
    point = results.list_grid_points()[1]

    runs = [FusedRun(load_scenario(file, [f"seed={seed}"])) for seed in SEEDS]
    for run in runs:
        run.advance_to(2.0)

    totals = plan.list_totals()
    for key, mean in zip(totals, point.means, strict=True):
        assert mean == MeanInterval.of_values([getattr(run.totals, key) for run in runs])
    assert point.means[0].half > 0.0
    assert point.means[totals.index("force_peak_n")] is None
    assert point.means[totals.index("walls_j")].mean < 0.0


def test_a_candidate_is_the_mean_of_its_seeds(file: Path) -> None:
    """The score of a candidate averages its scores in the scenarios of all seeds."""
    plan = plan_tuning(file, laws=["p_d"], budget=4, seeds=3)
    (law,) = plan.run(jobs=1).found
    assert plan.runs == (4 + 2) * 3
    for gains, score in zip(law.tried, law.scores, strict=True):
        bases = (plan.base, *plan.others)
        texts = [
            base.with_gains(law.space, plan.knowledge, gains).scenario.text for base in bases
        ]
        alone = [CandidateScore.measure(text, None) for text in texts]
        assert score == CandidateScore.average(alone)
        assert score.error_rad == pytest.approx(np.mean([single.error_rad for single in alone]))
        assert score.error_half_rad > 0.0


def test_the_outcome_of_a_candidate_is_its_worst() -> None:
    settled = CandidateScore(CandidateClass.SETTLED, 0.1, 0.1, 0.0, 2.0, 1.0, 0.0)
    diverged = msgspec.structs.replace(
        settled, outcome=CandidateClass.DIVERGED, error_rad=None, diverged_s=1.0
    )
    score = CandidateScore.average([settled, diverged])
    assert (score.outcome, score.error_rad, score.diverged_s) == (
        CandidateClass.DIVERGED,
        None,
        1.0,
    )
    assert score.effort_nm == 2.0


def test_logs_that_differ_in_their_seeds_are_averaged(file: Path) -> None:
    """Means over logs are given only if the logs are repetitions of one experiment."""
    folder = file.parent
    for seed in (1, 2, 3):
        options = ("--seed", str(seed), "-o", f"{seed}.mcap")
        trilat("sim", file.name, *options, cwd=folder).succeeds()
    other_delay = ("--set", "link.delay_ms=60", "-o", "4.mcap")
    trilat("sim", file.name, *other_delay, cwd=folder).succeeds()

    repeats = trilat("compare", "1.mcap", "2.mcap", "3.mcap", "--json", cwd=folder).succeeds()
    facts = json.loads(repeats)
    row = next(row for row in facts["rows"] if row["key"] == "rms_error_rad")
    assert facts["means"]["rms_error_rad"] == MeanInterval.of_values(row["values"])._asdict()

    others = trilat("compare", "1.mcap", "4.mcap", "--json", cwd=folder).succeeds()
    assert "means" not in json.loads(others)

"""Trials that are computed side by side have the results of trials one by one."""

from typing import Any

import msgspec
import pytest
from study_builders import record_lane_times, use_lanes, use_single_runs
from trilat_studies.measure_run import RunMetrics
from trilat_studies.trials import Trial, run_trials, trials

from trilat_net.scenario import Scenario, load_scenario

RANDOM = {
    "duration_s": 1.2,
    "link": {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 15.0, "loss": 0.1},
    "expect": {"mean_age_max_ms": 20.5, "synchronised_by_s": 1.1},
}
PLAIN = {"duration_s": 0.6, "sites.s.control.law": "tests.own_laws:PD"}
PLAIN_REASON = "control laws in plain Python"


def list_runs() -> list[Scenario]:
    """Returns five seeds of a run, one that diverges, one with two tick rates, one with a law
    in plain Python, and one with a metric of its log.
    """
    runs = [load_scenario("free", RANDOM, seed=seed) for seed in range(1, 6)]
    changes: list[dict[str, Any]] = [
        {"limits.qd_limit_rad_s": 0.9},
        {"sites.s.rate_hz": 500},
        PLAIN,
        {"expect.metrics.rms_error_rad": [0.0, 9.0]},
    ]
    return [*runs, *(load_scenario("free", {**RANDOM, **change}) for change in changes)]


def test_metrics_do_not_depend_on_lanes() -> None:
    """The metrics of runs that are measured together are those of each run alone."""
    runs = list_runs()
    reasons = {}
    together = {}
    for index, metrics, obstacle in RunMetrics.of_virtual_runs(runs):
        together[index] = msgspec.json.encode(metrics)
        reasons[index] = obstacle
    alone = {
        n: msgspec.json.encode(RunMetrics.of_virtual_run(run)) for n, run in enumerate(runs)
    }
    assert together == alone
    assert [reasons[n] for n in range(6)] == [""] * 6
    assert [reasons[7], reasons[8]] == [PLAIN_REASON, "metrics that need a log"]


def list_facts(batch: list[Trial]) -> list[Any]:
    """Returns everything that a report says of each trial."""
    rows = run_trials(batch, jobs=1).to_dict()["runs"]
    assert len(rows) == len(batch)
    return list(rows)


def test_lanes_do_not_change_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch of trials has the same report whether or not the trials run in lanes."""
    batch = [
        *trials("free", range(1, 6), RANDOM),
        *trials("free", [7], {**RANDOM, "duration_s": 1.3}),
    ]
    lane_times_s = record_lane_times(monkeypatch)
    use_single_runs(monkeypatch)
    single = list_facts(batch)
    assert not lane_times_s

    use_lanes(monkeypatch)
    together = list_facts(batch)
    assert lane_times_s
    assert together == single
    assert len({str(row) for row in single}) == len(batch)


def test_report_names_trials_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials with a law in plain Python run one by one beside trials that run in lanes."""
    use_lanes(monkeypatch)
    plain = {**RANDOM, **PLAIN, "expect": {"mean_age_max_ms": 20.5}}
    batch = [*trials("free", range(1, 6), RANDOM), *trials("free", [3, 4], plain)]
    assert run_trials(batch, jobs=1).remarks()[-1] == (
        f"2 of 7 runs were computed one by one: {PLAIN_REASON} (2)"
    )

"""One definition of every figure: a virtual run is measured as its log is."""

from typing import Any

import numpy as np
import pytest

import trilat_net
from tests.log_editing import edited, opened, recorded, without
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.studies.record_batches import BATCH_RECORDS
from trilat_net.studies.trials.measure_run import RunMetrics, measure_log, measure_virtual_run

RANDOM = {"link": {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 10.0}}
SHORT = {"duration_s": 2.5, "rate_hz": 500, "link.delay_ms": 20.0}


def scenario(**changes: Any) -> Scenario:
    return load_scenario("free", {**SHORT, **changes})


def agree(one: RunMetrics, other: RunMetrics) -> None:
    """Equal but for the last bits of means."""
    for field in RunMetrics.__struct_fields__:
        a, b = getattr(one, field), getattr(other, field)
        if field == "rms_error_rad":
            assert a == pytest.approx(b, rel=1e-12)
        elif field == "ages":
            assert a.keys() == b.keys()
            for link in a:
                assert a[link].max_ms == b[link].max_ms
                assert (a[link].mean_ms is None) == (b[link].mean_ms is None)
                assert a[link].mean_ms is None or a[link].mean_ms == pytest.approx(b[link].mean_ms)
        else:
            assert a == b, field


@pytest.mark.parametrize(
    "changes",
    [
        {},
        RANDOM,
        {"sites.m2.rate_hz": 90, "sites.s.rate_hz": 333},
        {"limits.qd_limit_rad_s": 0.3},
        {"link.delay_ms": 9000.0},
    ],
    ids=["plain", "random", "rates", "diverged", "never heard of"],
)
def test_a_run_and_its_log_have_the_same_figures(changes: dict[str, Any]) -> None:
    assert scenario().ticks("m1") > BATCH_RECORDS
    chosen = scenario(**changes)
    agree(measure_virtual_run(chosen), measure_log(trilat_net.simulate(chosen)))


def test_the_figures_are_what_their_definitions_say() -> None:
    chosen = scenario(**{"expect.synchronised_rad": 0.3})
    found, log = measure_virtual_run(chosen), trilat_net.simulate(chosen)
    errors = {name: np.abs(log[name].e) for name in log.sites}
    end = log["m1"].t_s > log["m1"].t_s[-1] - 1.0
    poses = np.array([log[name].q[end] for name in log.sites])
    assert found.simulated_s == 2.5
    assert found.peak_error_rad == max(e.max() for e in errors.values())
    assert found.end_error_rad == max(e[end].max() for e in errors.values())
    assert found.end_spread_rad == (poses.max(axis=0) - poses.min(axis=0)).max()
    assert found.end_pose_rad == {name: tuple(log[name].q[-1]) for name in log.sites}
    apart = [t for name in log.sites for t in log[name].t_s[errors[name].max(axis=1) >= 0.3]]
    assert 0.0 < max(apart) < 2.4
    assert found.synchronised_at_s == max(apart)
    assert found.ages["m1->s"].mean_ms == found.ages["m1->s"].max_ms == 20.0
    assert (found.late_samples, found.missing, found.diverged_at_s) == (0, 0, None)


def test_what_never_came_together_has_no_time_of_it() -> None:
    assert measure_virtual_run(scenario(**{"expect.synchronised_rad": 1e-6})).synchronised_at_s is None


def test_a_link_without_samples_has_no_age() -> None:
    found = measure_virtual_run(scenario(links={"m1->s": {"delay_ms": 9000.0}}))
    assert found.ages["m1->s"].mean_ms is found.ages["m1->s"].max_ms is None
    assert found.ages["m2->s"].max_ms == 20.0


def test_a_run_that_diverged_says_when() -> None:
    found = measure_virtual_run(scenario(**{"limits.qd_limit_rad_s": 0.3}))
    assert found.diverged_at_s is not None
    assert found.simulated_s == pytest.approx(found.diverged_at_s, abs=0.01)
    assert found.missing == 0


def test_every_missing_record_of_a_log_is_counted() -> None:
    whole = recorded("free")
    assert measure_log(opened(whole)).missing == 0
    assert measure_log(opened(edited(whole, record=without("s", {3, 4, 100})))).missing == 3
    assert measure_log(opened(edited(whole, record=without("s", set(range(60, 120)))))).missing == 60
    assert measure_log(opened(edited(whole, record=lambda _: None))).missing == 360
    none = measure_log(opened(edited(whole, record=without("s", set(range(120))))))
    assert none.missing == 120
    assert none.synchronised_at_s is none.end_spread_rad is none.ages["m1->s"].mean_ms is None

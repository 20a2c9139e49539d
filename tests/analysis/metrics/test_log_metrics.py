"""Logs of every kind: what can be said is said, and what cannot has its reason."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

import trilat_net
from tests.analysis import logs
from trilat_net.analysis.metrics.log_metrics import compute_log_metrics, metrics_to_json
from trilat_net.analysis.metrics.measures import quantities
from trilat_net.log.log_reader import Log

from .written import simulated

GOLDEN = sorted((Path(__file__).parents[2] / "golden").glob("v*.mcap"))


def told(log: Log) -> dict[str, Any]:
    """The facts of a log, checked for what holds of all."""
    measured = compute_log_metrics(log)
    found: dict[str, Any] = json.loads(json.dumps(metrics_to_json(measured), allow_nan=False))
    assert set(found["sites"]) == set(log.sites)
    assert len(found["links"]) == len(log.sites) * (len(log.sites) - 1)
    unknown = found["unknown"]
    for quantity in quantities():
        kind = "run" if quantity.of == "run" else f"{quantity.of}s"
        places = {"run": found["run"]} if kind == "run" else found[kind]
        for name, values in places.items():
            path = f"run.{quantity.key}" if kind == "run" else f"{kind}.{name}.{quantity.key}"
            value = values[quantity.key]
            assert (value is None) == (path in unknown)
            assert value is None or math.isfinite(value)
            assert path not in unknown or unknown[path]
        whole = measured.whole(quantity)
        assert (whole.value is None) == bool(whole.why)
    return found


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_every_released_version_is_measured(path: Path) -> None:
    found = told(trilat_net.open_log(path))
    assert found["sites"]["s"]["rms_error_rad"] > 0.0
    assert found["sites"]["s"]["unaccounted_j"] < 1e-3
    assert found["links"]["m2->s"]["age_mean_ms"] > 0.0


def test_busy_and_uneven_sites_are_measured() -> None:
    found = told(logs.busy().log)
    assert found["links"]["b->a"]["burst"] > 1.0
    assert found["links"]["b->a"]["loss"] == pytest.approx(0.2, abs=0.1)
    told(logs.simulated("four"))


def test_gap_and_late_begin_leave_numbers_and_are_counted() -> None:
    log = simulated("free", {"duration_s": 3.0, "rate_hz": 200})
    torn = logs.rewritten(log, lambda s: not (s.site == "m1" and 200 <= s.tick < 240), finished=False)
    found = told(torn)
    assert found["sites"]["m1"]["missing"] == 40.0
    assert found["sites"]["m1"]["unaccounted_j"] < 1e-3
    assert not found["complete"]
    late = told(logs.rewritten(log, lambda state: 150 < state.tick < 400))
    assert late["sites"]["m1"]["unaccounted_j"] < 1e-3
    assert late["run"]["spread_max_rad"] > 0.0


def test_site_without_any_record_takes_only_its_own_figures_away() -> None:
    log = simulated("free", {"duration_s": 1.0, "rate_hz": 100})
    found = told(logs.rewritten(log, lambda state: state.site != "m1"))
    assert found["sites"]["m2"]["controller_j"] is not None
    assert found["links"]["m2->s"]["delay_j"] is not None
    assert found["unknown"]["sites.m1.controller_j"] == "no records of m1"
    assert found["unknown"]["links.m1->s.following_rms_rad"] == "no records of m1"
    assert found["unknown"]["run.spread_rms_rad"] == "no records of m1"
    assert found["unknown"]["windows_at_rest"] == "no records of m1"
    assert "m1" not in found["parameters"]


@pytest.mark.parametrize("ticks", [0, 1, 2, 3])
def test_next_to_nothing_is_no_error(ticks: int) -> None:
    log = simulated("contact", {"duration_s": 1.0, "rate_hz": 100})
    found = told(logs.rewritten(log, lambda state: state.tick < ticks))
    assert (found["sites"]["m"]["controller_j"] is None) == (ticks < 2)
    assert (found["walls"]["s/1"]["force_peak_n"] is None) == (ticks < 1)


def test_a_run_that_diverged_is_measured_up_to_there() -> None:
    found = told(logs.diverged())
    assert found["sites"]["m1"]["unaccounted_j"] < 1e-2


@pytest.mark.parametrize("size", [1e200, 1e308])
def test_numbers_beyond_all_physics_are_no_numbers_and_no_error(size: float) -> None:
    log = simulated("contact", {"duration_s": 5.0, "rate_hz": 100})
    grown = logs.rewritten(
        log,
        change=lambda s: logs.replaced(
            s, **{name: [size if s.tick % 3 else -size] * 2 for name in ("q", "qd", "tau", "tau_x")}
        ),
    )
    assert told(grown)["sites"]["m"]["mechanical_j"] is None


def test_loops_are_told_of_where_a_clock_was_read() -> None:
    """Every loop late by its tick in us, every tick 7 us of work."""
    log = logs.timed(simulated("free", {"duration_s": 1.0, "rate_hz": 200}))
    found = told(log)["sites"]["m1"]
    assert found["late_max_us"] == 199.0
    assert found["busy_p99_us"] == 7.0
    assert found["overruns"] == 0.0
    assert told(simulated("free", {"duration_s": 1.0, "rate_hz": 200}))["sites"]["m1"]["late_max_us"] is None


def test_the_docs_have_a_line_for_every_quantity() -> None:
    page = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    for quantity in quantities():
        assert f"`{quantity.key}`" in page, quantity.key

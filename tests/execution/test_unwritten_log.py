"""A log that was never written has the same columns, and the same certificate, as a written one."""

import json
from typing import Any

import numpy as np
import pytest

from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.errors import LogError
from trilat_net.execution import FusedRun, SimulatedLog
from trilat_net.log import UnwrittenLog
from trilat_net.scenario import load_scenario

COLUMNS = ("tick", "t_ns", "q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat", "x", "ch")
LOSSY = {"link": {"model": "uniform", "delay_ms": 30.0, "half_width_ms": 25.0, "loss": 0.2}}
UNLIKE_RATES = {"sites.s.rate_hz": 500}
WALL = {"kind": "wall", "point_m": [1.8, 0.0], "normal": [-1.0, 0.0], "stiffness_n_m": 500.0}
RUNS: list[tuple[str, dict[str, Any]]] = [
    ("paper", {}),
    ("free", {"control.law": "p_d", "scheme": "digital"}),
    ("jitter", {}),
    ("4g", {"seed": 7}),
    ("paper", LOSSY),
    ("paper", UNLIKE_RATES),
    ("free", {"sites.s.environment": [WALL]}),
    ("six_joints", {}),
    ("wall_in_space", {}),
]


@pytest.mark.parametrize(("name", "settings"), RUNS)
def test_columns_equal_those_of_a_written_log(name: str, settings: dict[str, Any]) -> None:
    scenario = load_scenario(name, {"duration_s": 1.0, **settings})
    written = SimulatedLog(scenario)
    unwritten = FusedRun.simulate_log(scenario)
    assert isinstance(unwritten, UnwrittenLog)
    for site in written.sites:
        for column in COLUMNS:
            expected = getattr(written[site], column)
            np.testing.assert_array_equal(getattr(unwritten[site], column), expected)
        assert list(unwritten[site].mode) == list(written[site].mode)
        for peer, used in written[site].used.items():
            np.testing.assert_array_equal(unwritten[site].used[peer], used)


@pytest.mark.parametrize(("name", "settings"), RUNS)
def test_its_certificate_is_that_of_a_written_log(name: str, settings: dict[str, Any]) -> None:
    scenario = load_scenario(name, {"duration_s": 1.0, **settings})
    written = Certificate.of_log(SimulatedLog(scenario)).to_dict()
    unwritten = Certificate.of_log(FusedRun.simulate_log(scenario)).to_dict()
    assert json.dumps(unwritten) == json.dumps(written)


@pytest.mark.parametrize(
    "settings",
    [
        {"link.outages_s": [[0.2, 0.3]]},
        {"sites.s.on_stale": {"action": "hold", "age_ms": 250.0}},
        {"timeline": [{"at_s": 0.5, "link": "m1->s", "to": {"delay_ms": 220.0}}]},
        {"limits.qd_limit_rad_s": 0.01},
    ],
)
def test_runs_with_more_than_columns_are_written(settings: dict[str, Any]) -> None:
    scenario = load_scenario("paper", {"duration_s": 1.0, **settings})
    assert isinstance(FusedRun.simulate_log(scenario), SimulatedLog)


@pytest.mark.parametrize("column", ["mem", "late_us", "sent_ns", "arrivals"])
def test_a_column_not_kept_is_an_error(column: str) -> None:
    log = FusedRun.simulate_log(load_scenario("paper", {"duration_s": 0.1}))
    with pytest.raises(LogError, match="s has no"):
        getattr(log["s"], column)


def test_an_unwritten_log_names_its_length() -> None:
    log = FusedRun.simulate_log(load_scenario("paper", {"duration_s": 0.1}))
    assert len(log["s"]) == 100
    assert log.missing("s") == 0
    assert log.complete

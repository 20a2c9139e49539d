"""Logs of sites that follow with their end effectors: compared, judged, or refused in a sentence."""

import numpy as np
import pytest

import trilat_net
from trilat_net.analysis.metrics.log_metrics import compute_log_metrics
from trilat_net.errors import LogError, ScenarioError
from trilat_net.execution.fused import FusedRun
from trilat_net.log.log_reader import Log
from trilat_net.reporting.figures.registry import list_drawable_figures
from trilat_net.scenario import load_scenario
from trilat_net.theory.operating_point import derive_operating_conditions

SHORT = {"duration_s": 1.0}


@pytest.fixture(scope="module")
def log() -> Log:
    return trilat_net.simulate("unlike_arms", SHORT)


def test_its_records_are_those_of_the_fused_run(log: Log) -> None:
    """Places, velocities and wrenches of arms of two and of seven joints."""
    run = FusedRun(load_scenario("unlike_arms", SHORT))
    run.advance(1.0)
    for record, name in zip(run.records, log.sites, strict=True):
        part = log[name]
        row = np.concatenate([getattr(part, field)[-1] for field in part.layout.lengths()])
        assert record[: len(row)].tolist() == row.tolist()


def test_its_error_is_that_of_the_place(log: Log) -> None:
    for part in (log[name] for name in log.sites):
        assert part.e.shape[1] == 3
        assert np.array_equal(part.e, part.x - part.q_des)
    assert np.abs(log["s"].e[-1]).max() < np.abs(log["s"].e[500]).max()


def test_what_compares_joint_by_joint_is_refused_in_a_sentence(log: Log) -> None:
    assert "tracking_errors" not in list_drawable_figures(log)
    with pytest.raises(LogError, match="joint by joint"):
        compute_log_metrics(log)
    with pytest.raises(ScenarioError, match="not in task space"):
        derive_operating_conditions(log.scenario)

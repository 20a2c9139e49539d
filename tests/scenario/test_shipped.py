"""The shipped scenarios show their contrasts, beyond their [expect] tables."""

from typing import Any

import numpy as np
import pytest

from tests.execution.builders import Trajectories, make_shipped_trajectories


def trace_shipped(name: str, overrides: dict[str, Any] | None = None) -> Trajectories:
    """Returns the records of a shipped scenario without its table `expect`."""
    return make_shipped_trajectories(name, {"expect": {}, **(overrides or {})})


def list_ages(run: Trajectories) -> np.ndarray:
    used = run.stack("used")
    ticks = np.arange(used.shape[1])[None, :, None]
    age_ticks: np.ndarray = (ticks - used)[used >= 0]
    return age_ticks


@pytest.mark.long
def test_newer_samples_overtake_on_4g() -> None:
    short = {"duration_s": 6.0}
    assert list_ages(trace_shipped("4g", short)).mean() == pytest.approx(21, abs=3)
    assert list_ages(trace_shipped("4g", {**short, "link.order": "in_order"})).mean() > 400


@pytest.mark.long
def test_handover_changes_sides_without_a_step() -> None:
    run = trace_shipped("handover", {"duration_s": 13.1})
    m1, m2, s = (run.sites[name].q[:, 0] for name in ("m1", "m2", "s"))
    beyond = s - (m1 + m2) / 2
    assert beyond[9900] > 0.14
    assert beyond[13_000] < -0.16
    steps = np.abs(np.diff(run.sites["s"].q_des, axis=0))
    assert steps.max() < 1e-3
    q_des = run.sites["s"].q_des
    qd_des = run.sites["s"].qd_des
    central = (q_des[2:] - q_des[:-2]) / 2e-3
    ramp = slice(10_010, 11_990)
    assert np.abs(central[ramp] - qd_des[1:-1][ramp]).max() < 1e-3

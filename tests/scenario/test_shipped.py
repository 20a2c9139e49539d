"""What the shipped scenarios say of themselves, beyond what their [expect] asks: the contrasts."""

from typing import Any

import numpy as np
import pytest

from tests.virtual_runs import Run, trajectories
from trilat_net.scenario import load_scenario


def ran(name: str, overrides: dict[str, Any] | None = None) -> Run:
    return trajectories(load_scenario(name, {"expect": {}, **(overrides or {})}))


def largest_errors(run: Run) -> np.ndarray:
    """Largest |e| of any site and joint, per tick."""
    errors: np.ndarray = np.abs(run.stack("q") - run.stack("q_des")).max(axis=(0, 2))
    return errors


def ages(run: Run) -> np.ndarray:
    """Age of the samples in use, ticks, from the first ones on."""
    used = run.stack("used")
    ticks = np.arange(used.shape[1])[None, :, None]
    made: np.ndarray = (ticks - used)[used >= 0]
    return made


def test_jitter_of_the_same_mean_delay_turns_the_verdict() -> None:
    """Uniform 0-400 ms decays with a mean age of 25 ms; constant 200 ms grows."""

    def then_and_later(run: Run) -> tuple[float, float]:
        errors = largest_errors(run)
        return float(errors[9000:10_000].max()), float(errors[-1000:].max())

    jitter = ran("jitter", {"duration_s": 20.0})
    assert then_and_later(jitter) == pytest.approx((0.237, 0.106), abs=0.01)
    assert ages(jitter).mean() == pytest.approx(24.7, abs=0.5)
    constant = ran("jitter", {"duration_s": 20.0, "link.half_width_ms": 0.0})
    assert then_and_later(constant) == pytest.approx((0.928, 1.688), abs=0.01)


def test_4g_looks_young_because_newer_samples_overtake() -> None:
    short = {"duration_s": 6.0}
    assert ages(ran("4g", short)).mean() == pytest.approx(21, abs=3)
    assert ages(ran("4g", {**short, "link.order": "in_order"})).mean() > 400


def test_handover_changes_sides_without_a_step() -> None:
    made = ran("handover")
    m1, m2, s = (made.sites[name].q[:, 0] for name in ("m1", "m2", "s"))
    beyond = s - (m1 + m2) / 2
    assert beyond[9900] > 0.14
    assert beyond[13_000] < -0.16
    steps = np.abs(np.diff(made.sites["s"].q_des, axis=0))
    assert steps.max() < 1e-3
    q_des, qd_des = made.sites["s"].q_des, made.sites["s"].qd_des
    central = (q_des[2:] - q_des[:-2]) / 2e-3
    ramp = slice(10_010, 11_990)
    assert np.abs(central[ramp] - qd_des[1:-1][ramp]).max() < 1e-3

"""A play-out buffer makes jitter below its budget a constant delay, bit for bit; whole runs."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from tests.execution.builders import Trajectories, make_shipped_trajectories, make_trajectories
from trilat_net.core.step.ticks import TickRecord
from trilat_net.execution import virtual
from trilat_net.scenario import load_scenario

BUDGET_MS = 200.0
BELOW: dict[str, dict[str, Any]] = {
    "uniform": {"model": "uniform", "delay_ms": 100.0, "half_width_ms": 99.9},
    "uniform in order": {
        "model": "uniform",
        "delay_ms": 100.0,
        "half_width_ms": 99.9,
        "order": "in_order",
    },
    "with copies": {
        "model": "uniform",
        "delay_ms": 100.0,
        "half_width_ms": 99.9,
        "duplicate": 0.3,
    },
    "normal": {"model": "normal", "delay_ms": 80.0, "deviation_ms": 15.0},
    "ar1": {"model": "ar1", "delay_ms": 100.0, "deviation_ms": 15.0, "correlation": 0.95},
    "sine": {"model": "sine", "delay_ms": 100.0, "amplitude_ms": 100.0, "period_s": 0.7},
    "none": {"model": "none"},
}
FIELDS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat", "used")


def same_bits(a: Trajectories, b: Trajectories) -> bool:
    return all(a.stack(field).tobytes() == b.stack(field).tobytes() for field in FIELDS)


@cache
def constant_records() -> list[TickRecord]:
    return records({"link.delay_ms": BUDGET_MS})


def records(overrides: dict[str, Any]) -> list[TickRecord]:
    scenario = load_scenario("free", {"duration_s": 1.0, **overrides})
    return [step.output for step in virtual.execute_virtual(scenario)]


@pytest.mark.parametrize("name", BELOW)
def test_jitter_below_budget_is_constant_bit_for_bit(name: str) -> None:
    """Every field of every record agrees, checksums of the arrivals included."""
    buffered = records({"link": {**BELOW[name], "playout_ms": BUDGET_MS}})
    assert buffered == constant_records()
    assert max(max(record.used) for record in buffered) == 1000 - 1 - 200


def trajectory(scenario: str, overrides: dict[str, Any]) -> Trajectories:
    return make_trajectories(load_scenario(scenario, overrides))


@pytest.mark.long
def test_play_out_holds_throughout_the_paper() -> None:
    link = {"model": "gamma", "delay_ms": 60.0, "deviation_ms": 10.0, "playout_ms": BUDGET_MS}
    assert same_bits(trajectory("paper", {"link": link}), make_shipped_trajectories("paper"))


def test_jitter_above_budget_varies() -> None:
    link = {
        "model": "uniform",
        "delay_ms": 150.0,
        "half_width_ms": 100.0,
        "playout_ms": BUDGET_MS,
    }
    buffered = trajectory("free", {"link": link, "duration_s": 2.0})
    constant = make_shipped_trajectories(
        "free", {"duration_s": 2.0, "link.delay_ms": BUDGET_MS}
    )
    assert not same_bits(buffered, constant)
    assert (np.diff(buffered.stack("used"), axis=1) >= 0).all()

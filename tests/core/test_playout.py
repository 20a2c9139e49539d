"""A play-out buffer makes jitter below its budget a constant delay, bit for bit; whole runs."""

from typing import Any

import numpy as np
import pytest

from tests.execution.builders import (
    Trajectories,
    execute_ticks,
    make_shipped_trajectories,
)
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


@pytest.mark.parametrize("name", BELOW)
def test_jitter_below_budget_is_constant_bit_for_bit(name: str) -> None:
    over = {"duration_s": 2.0}
    constant = make_shipped_trajectories("free", {**over, "link.delay_ms": BUDGET_MS})
    buffered = make_shipped_trajectories(
        "free", {**over, "link": {**BELOW[name], "playout_ms": BUDGET_MS}}
    )
    assert same_bits(buffered, constant)
    assert buffered.stack("used").max() == 2000 - 1 - 200


@pytest.mark.long
def test_play_out_holds_throughout_the_paper() -> None:
    link = {"model": "gamma", "delay_ms": 60.0, "deviation_ms": 10.0, "playout_ms": BUDGET_MS}
    assert same_bits(
        make_shipped_trajectories("paper", {"link": link}), make_shipped_trajectories("paper")
    )


def test_jitter_above_budget_varies() -> None:
    link = {
        "model": "uniform",
        "delay_ms": 150.0,
        "half_width_ms": 100.0,
        "playout_ms": BUDGET_MS,
    }
    buffered = make_shipped_trajectories("free", {"link": link, "duration_s": 2.0})
    constant = make_shipped_trajectories(
        "free", {"duration_s": 2.0, "link.delay_ms": BUDGET_MS}
    )
    assert not same_bits(buffered, constant)
    assert (np.diff(buffered.stack("used"), axis=1) >= 0).all()


def test_arrival_checksums_agree() -> None:
    """The whole records of virtual time agree, beyond the numbers of the trajectory."""
    link = {**BELOW["uniform"], "playout_ms": BUDGET_MS}
    buffered = load_scenario("free", {"duration_s": 1.0, "link": link})
    constant = load_scenario("free", {"duration_s": 1.0, "link.delay_ms": BUDGET_MS})
    assert execute_ticks(buffered) == execute_ticks(constant)

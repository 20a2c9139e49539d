"""What the shipped scenarios promise, with margins: figures of an independent implementation."""

import numpy as np
import pytest

from tests.theory.delay_equations import theta_of
from tests.virtual_runs import run, trajectories
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario

Q, QD, Q_DES, THETA_HAT = slice(0, 2), slice(2, 4), slice(4, 6), slice(12, 17)
"""Where they lie in a record's floats."""


def ended(name: str, duration_s: float, delay_ms: float = 200.0) -> FusedRun:
    made = FusedRun(load_scenario(name, {"link.delay_ms": delay_ms}))
    made.advance(duration_s)
    return made


def test_paper_ends_where_its_gravity_anchor_is() -> None:
    final = ended("paper", 20.0).records[:, Q]
    assert final == pytest.approx(np.tile([-0.1729, 0.0874], (3, 1)), abs=5e-4)


def test_hands_leave_next_to_nothing_behind_in_paper() -> None:
    made = run("paper", {"duration_s": 20.0})
    alone = trajectories(made.scenario.without_hands())
    moved = np.abs(made.stack("q") - alone.stack("q"))
    assert moved[:, -1].max() < 5e-4
    assert moved[..., 0].max() <= 0.0035
    assert np.abs((made.stack("q") - alone.stack("q")).sum(-1)).max() == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize(("delay_ms", "settles_s"), [(0.0, 22.2), (200.0, 11.9), (400.0, 5.5)])
def test_free_settles_and_some_delay_helps(delay_ms: float, settles_s: float) -> None:
    assert ended("free", 30.0, delay_ms).settled_s == pytest.approx(settles_s, abs=0.15)


def test_errors_and_speeds_of_paper_and_free_decay_as_the_theorem_says() -> None:
    for name, error, speed in (("paper", 6.0e-5, 3.0e-4), ("free", 1.3e-3, 1.1e-2)):
        last = ended(name, 20.0).records
        assert np.abs(last[:, Q] - last[:, Q_DES]).max() == pytest.approx(error, rel=0.15)
        assert np.abs(last[:, QD]).max() == pytest.approx(speed, rel=0.15)


@pytest.mark.parametrize(("delay_s", "margin"), [(0.0, 2e-3), (0.2, 4e-3)])
def test_the_anchor_is_a_function_of_the_first_estimate(delay_s: float, margin: float) -> None:
    """sin q1 ends at sin q1(0) - (th4 - th4_hat(0)) / (Gamma g (1 + Lambda T)); q1 + q2 alike with th5."""
    theta, g = theta_of(load_scenario("paper").sites["m1"].arm), 9.81
    first, both = np.arcsin(-theta[3:] / (g * (1 + delay_s)))
    assert ended("paper", 60.0, 1e3 * delay_s).records[:, Q] == pytest.approx(
        np.tile([first, both - first], (3, 1)), abs=margin
    )


def test_gravity_alone_is_learnt() -> None:
    theta_hat = ended("paper", 60.0).records[0, THETA_HAT]
    assert theta_hat[3:] == pytest.approx([2.0, 1.0], abs=0.02)
    assert theta_hat[2] < 0.0  # inertial estimates are free to be anything

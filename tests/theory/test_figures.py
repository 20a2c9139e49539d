"""What the shipped scenarios promise, with margins: figures of an independent implementation."""

import numpy as np
import pytest

from tests.theory.delay_equations import theta_of
from tests.virtual_runs import Run, run, trajectories


def settled_s(made: Run) -> float:
    """The last time at which an error is above 0.01 rad."""
    errors = np.abs(made.stack("q") - made.stack("q_des")).max(axis=(0, 2))
    (above,) = np.nonzero(errors > 1e-2)
    return float(made.stack("t_s")[0][above[-1]])


def test_paper_ends_where_its_gravity_anchor_is() -> None:
    final = run("paper", {"duration_s": 20.0}).stack("q")[:, -1]
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
    made = run("free", {"link.delay_ms": delay_ms, "duration_s": 30.0})
    assert settled_s(made) == pytest.approx(settles_s, abs=0.15)


def test_errors_and_speeds_of_paper_and_free_decay_as_the_theorem_says() -> None:
    for name, error, speed in (("paper", 6.0e-5, 3.0e-4), ("free", 1.3e-3, 1.1e-2)):
        made = run(name, {"duration_s": 20.0})
        e = np.abs(made.stack("q") - made.stack("q_des"))[:, -1]
        assert e.max() == pytest.approx(error, rel=0.15)
        assert np.abs(made.stack("qd"))[:, -1].max() == pytest.approx(speed, rel=0.15)


@pytest.mark.parametrize(("delay_s", "margin"), [(0.0, 2e-3), (0.2, 4e-3)])
def test_the_anchor_is_a_function_of_the_first_estimate(delay_s: float, margin: float) -> None:
    """sin q1 ends at sin q1(0) - (th4 - th4_hat(0)) / (Gamma g (1 + Lambda T)); q1 + q2 alike with th5."""
    made = run("paper", {"link.delay_ms": 1e3 * delay_s, "duration_s": 60.0})
    theta, g = theta_of(made.scenario.sites["m1"].arm), 9.81
    first, both = np.arcsin(-theta[3:] / (g * (1 + delay_s)))
    assert made.stack("q")[:, -1] == pytest.approx(np.tile([first, both - first], (3, 1)), abs=margin)


def test_gravity_alone_is_learnt() -> None:
    theta_hat = run("paper", {"duration_s": 60.0}).stack("theta_hat")[0, -1]
    assert theta_hat[3:] == pytest.approx([2.0, 1.0], abs=0.02)
    assert theta_hat[2] < 0.0  # inertial estimates are free to be anything

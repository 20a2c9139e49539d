"""Loops that hide their growth: the judgement of these loops, and their truth against the
program's own motion.
"""

import numpy as np
import pytest

import trilat_net
from tests.certificate.adversaries import HIDDEN, count_judgements, judge_hidden
from tests.certificate.hidden_loops import PUSH, draw_hidden, write_scenario

BLOCK = 100


@pytest.mark.parametrize(
    "seeds",
    [
        PUSH,
        *(
            pytest.param(HIDDEN[n : n + BLOCK], marks=pytest.mark.long)
            for n in range(0, len(HIDDEN), BLOCK)
        ),
    ],
    ids=str,
)
@pytest.mark.push
def test_hidden_growth_is_found(seeds: range) -> None:
    """No growing loop is called stable, and at most one in a hundred decaying loops is condemned."""
    counts = count_judgements(map(judge_hidden, seeds))
    assert counts.false_ok == 0
    assert counts.false_alarm <= max(1, 0.01 * counts.runs)
    assert counts.unstable >= 0.3 * counts.runs


@pytest.mark.parametrize("seed", [5, 12])
def test_a_law_without_permission_proves_nothing(seed: int) -> None:
    hidden, _ = draw_hidden(seed)
    assert hidden.own_law
    log = trilat_net.simulate(write_scenario(hidden))
    assert trilat_net.certify(log).stability in ("open", "not stable")


@pytest.mark.parametrize("seed", [4, 10])
def test_small_motions_grow_at_the_true_rate(seed: int) -> None:
    """A run from next to the rest has the rate of `linear_truth`, which uses no code of the program."""
    hidden, rate_per_s = draw_hidden(seed)
    offsets_rad = 1e-7 * np.random.default_rng(1).standard_normal(hidden.starts_rad.shape)
    near = hidden._replace(
        starts_rad=hidden.pose_rad + offsets_rad, duration_s=60.0, earlier=None
    )
    log = trilat_net.simulate(write_scenario(near))
    speeds = np.abs(np.hstack([log[name].qd for name in log.sites])).max(axis=1)
    windows = np.log(speeds[: len(speeds) // 400 * 400].reshape(-1, 400).max(axis=1))
    late = windows[len(windows) // 3 :]
    slope = np.polyfit(4.0 * np.arange(len(late)), late, 1)[0]
    assert slope == pytest.approx(rate_per_s, rel=0.1, abs=0.01)

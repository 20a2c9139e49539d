"""Virtual runs of chains against the delay-differential equations on Pinocchio's dynamics.

On a push against a stored motion of 2 s; the order over 10 s needs Pinocchio (`requirements/robots.lock`).
"""

from itertools import pairwise

import numpy as np
import pytest

from tests.core.chain_references import Array
from tests.execution.builders import sample_records
from tests.theory.chain_motion import TIMES_S, exact_motion, pushed_chains

LONG_TIMES_S = np.arange(0.05, 10.01, 0.05)


def sample_motion(rate_hz: int, times_s: Array) -> Array:
    """Returns q of the tick at each of these times, shape (3, K, 6)."""
    motion_at_times = sample_records(pushed_chains(rate_hz=rate_hz), times_s + 1.0 / rate_hz)
    return motion_at_times[..., :6]


@pytest.mark.long
def test_second_order_follows_the_stored_motion() -> None:
    errors = [
        float(np.abs(sample_motion(rate_hz, TIMES_S) - exact_motion()).max())
        for rate_hz in (500, 1000)
    ]
    assert errors[1] <= 5e-5
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.long
def test_chains_keep_order_two_over_ten_seconds() -> None:
    pytest.importorskip(
        "pinocchio", reason="requirements/robots.lock is not installed: make test-long"
    )
    from tests.theory.chain_delay_equations import chain_equations

    equations = chain_equations(pushed_chains()).solve(float(LONG_TIMES_S[-1]))
    exact = equations.at(LONG_TIMES_S)[..., :6]
    assert np.abs(equations.at(TIMES_S)[..., :6] - exact_motion()).max() < 1e-8
    errors = [
        float(np.abs(sample_motion(hz, LONG_TIMES_S) - exact).max()) for hz in (500, 1000, 2000)
    ]
    assert errors[1] <= 5e-5
    orders = [float(np.log2(coarse / fine)) for coarse, fine in pairwise(errors)]
    assert orders == pytest.approx([2.0, 2.0], abs=0.1)

"""Shares over time are what the core's own function of time gives at every tick."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.analysis.dominance_history import evaluate_ramps
from trilat_net.core.dominance import apply_ramps
from trilat_net.core.link import LINK_DTYPE
from trilat_net.core.ticks import DominanceRamp

RATE_HZ = 50
ramps = st.tuples(st.integers(0, 60), st.integers(0, 30), st.floats(0.0, 1.0))


@given(st.lists(ramps, max_size=4, unique_by=lambda ramp: ramp[0]))
def test_they_are_the_cores(drawn: list[tuple[int, int, float]]) -> None:
    tick_ns = 10**9 // RATE_HZ
    changes = [DominanceRamp(a * tick_ns, (a + n) * tick_ns, (x, 1.0 - x)) for a, n, x in drawn]
    found = evaluate_ramps(np.array([0.5, 0.5]), changes, np.arange(100) / RATE_HZ, 1.0 / RATE_HZ)
    rows = [[0.0, 0.0, 0.5, 0.5], *([r.start_ns, r.end_ns, *r.alpha] for r in sorted(changes))]
    links = np.zeros(2, LINK_DTYPE)
    for k in range(100):
        apply_ramps(k * tick_ns, len(rows), np.array(rows, dtype=float), links)
        assert found.alpha[k] == pytest.approx(links["alpha"], abs=1e-9)
        assert found.rate[k] == pytest.approx(links["alpha_rate"], abs=1e-6)


def test_before_a_sudden_change_they_are_as_they_were() -> None:
    step = DominanceRamp(10**9, 10**9, (1.0, 0.0))
    found = evaluate_ramps(np.array([0.5, 0.5]), [step], np.arange(100) / RATE_HZ, 1.0 / RATE_HZ)
    assert found.before[49].tolist() == [0.5, 0.5]
    assert found.alpha[50].tolist() == [1.0, 0.0]
    assert not found.constant
    assert evaluate_ramps(np.array([0.5, 0.5]), [], np.arange(9.0), 1.0).constant

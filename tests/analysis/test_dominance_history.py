"""Shares over time equal the core's own function of time at every tick. beta: the left null
vector, scaled by Kd; groups of sites that follow nobody outside.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import trilat_net
from tests.log.builders import edit_log_bytes, make_log_bytes, open_bytes
from trilat_net.analysis.dominance_history import (
    DominanceHistory,
    DominancePlan,
    PeerLoss,
    compute_lyapunov_weights,
    find_kd_scales,
)
from trilat_net.core.links.dominance import DominanceMatrix, apply_ramps
from trilat_net.core.links.link import link_dtype
from trilat_net.core.step.ticks import DominanceRamp
from trilat_net.errors import LogError

RATE_HZ = 50
ramps = st.tuples(st.integers(0, 60), st.integers(0, 30), st.floats(0.0, 1.0))


@settings(max_examples=40)
@given(st.lists(ramps, max_size=4, unique_by=lambda ramp: ramp[0]))
def test_shares_equal_the_cores(drawn: list[tuple[int, int, float]]) -> None:
    tick_ns = 10**9 // RATE_HZ
    changes = [DominanceRamp(a * tick_ns, (a + n) * tick_ns, (x, 1.0 - x)) for a, n, x in drawn]
    plan = DominancePlan(np.array([0.5, 0.5]), changes, 1.0 / RATE_HZ)
    shares = plan.evaluate(np.arange(100) / RATE_HZ)
    rows = [[0.0, 0.0, 0.5, 0.5], *([r.start_ns, r.end_ns, *r.alpha] for r in sorted(changes))]
    links = np.zeros(2, link_dtype(2))
    for k in range(100):
        apply_ramps(k * tick_ns, len(rows), np.array(rows, dtype=float), links)
        assert shares.alpha[k] == pytest.approx(links["alpha"], abs=1e-9)
        assert shares.rate[k] == pytest.approx(links["alpha_rate"], abs=1e-6)


def test_shares_before_a_sudden_change_are_kept() -> None:
    step = DominanceRamp(10**9, 10**9, (1.0, 0.0))
    plan = DominancePlan(np.array([0.5, 0.5]), [step], 1.0 / RATE_HZ)
    shares = plan.evaluate(np.arange(100) / RATE_HZ)
    assert shares.before[49].tolist() == [0.5, 0.5]
    assert shares.alpha[50].tolist() == [1.0, 0.0]
    assert not shares.constant
    assert plan._replace(ramps=[]).evaluate(np.arange(9.0)).constant


RAMPS = {
    "duration_s": 6.0,
    "rate_hz": 100,
    "timeline": [
        {"at_s": 1.0, "dominance": "s", "to": {"m1": 1.0, "m2": 0.0}, "ramp_s": 2.0},
        {"at_s": 2.0, "dominance": "s", "to": {"m1": 0.0, "m2": 1.0}, "ramp_s": 1.5},
        {"at_s": 5.0, "dominance": "s", "to": {"m1": 0.5, "m2": 0.5}},
    ],
}
"""The second ramp begins half-way through the first one, at 0.75."""


@pytest.fixture(scope="module")
def ramped():
    return trilat_net.simulate("paper", RAMPS)


def test_a_ramp_begins_where_the_previous_ends(ramped):
    part = ramped["s"]
    alpha = DominanceHistory.of_log(ramped, "s", part.t_s).alpha
    at = [0.5, 1.0, 1.5, 2.0, 2.75, 3.5, 4.9, 5.1]
    assert np.interp(at, part.t_s, alpha[:, 0]) == pytest.approx(
        [0.5, 0.5, 0.625, 0.75, 0.375, 0.0, 0.0, 0.5]
    )
    assert alpha.sum(axis=1) == pytest.approx(np.ones(len(part)))


def test_shares_give_the_recorded_references(ramped):
    """Eq. (6) with the shares and the samples in use gives the recorded reference."""
    part = ramped["s"]
    alpha = DominanceHistory.of_log(ramped, "s", part.t_s).alpha
    reference = np.zeros_like(part.q)
    for peer, factor in zip(part.peers, alpha.T, strict=True):
        used = part.used[peer]
        q = ramped[peer].q
        seen = np.where(
            used[:, None] >= 0, q[np.maximum(used, 0)], ramped.scenario.sites[peer].q0_rad
        )
        reference += factor[:, None] * seen
    assert reference == pytest.approx(part.q_des, abs=1e-9)


EXPERT = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 0.5], [1.0, 0.0, 0.0]])
"""Sites 0 and 2 are locked to each other, 1 follows them."""
PAIRS = np.array(
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]]
)
THREE = np.full((3, 3), 0.5) - 0.5 * np.eye(3)


@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_pi_is_the_eigenvector_that_numpy_finds(n: int, seed: int) -> None:
    alpha = np.random.default_rng(seed).random((n, n)) * (1.0 - np.eye(n))
    alpha /= alpha.sum(axis=1, keepdims=True)
    values, vectors = np.linalg.eig(alpha.T)
    expected = np.real(vectors[:, np.argmax(np.real(values))])
    assert DominanceMatrix(alpha).find_pi() == pytest.approx(
        expected / expected.sum(), abs=1e-9
    )


@given(st.lists(st.floats(0.01, 100.0), min_size=3, max_size=3))
def test_scaled_kd_cancels_forwarded_motion(scales: list[float]) -> None:
    """sum_i beta_i ( |x_i|^2_Kd_i - sum_j alpha_ij |x_j|^2_Kd_i ) = 0 for all x, Eq. (20)."""
    Kd = np.outer(scales, [3.0, 0.4])
    weights = compute_lyapunov_weights(THREE, Kd)
    norms = np.random.default_rng(1).random((3, 2))
    passed = [Kd[i] @ (norms[i] - THREE[i] @ norms) for i in range(3)]
    assert weights.beta @ passed == pytest.approx(
        0.0, abs=1e-9 * max(scales) * weights.beta.max()
    )
    assert weights.beta.sum() == pytest.approx(3.0)


def test_equal_shares_and_kd_give_the_papers_ones() -> None:
    assert compute_lyapunov_weights(THREE, np.full((3, 2), 3.0)).beta == pytest.approx(
        np.ones(3)
    )


def test_kd_of_different_shapes_have_no_scalar() -> None:
    assert find_kd_scales(np.array([[0.1, 30.0], [30.0, 0.1], [3.0, 3.0]])) is None
    assert find_kd_scales(np.array([[1.0, 1.0], [0.0, 0.0]])) is None
    assert find_kd_scales(np.zeros((3, 2))) == pytest.approx(np.ones(3))


def test_a_site_that_nobody_follows_has_no_weight() -> None:
    weights = compute_lyapunov_weights(EXPERT, np.ones((3, 2)))
    assert weights.groups == ((0, 2),)
    assert weights.beta == pytest.approx([1.5, 0.0, 1.5])


def test_two_groups_that_follow_nobody_outside_are_named() -> None:
    assert DominanceMatrix(PAIRS).closed_groups == ((0, 1), (2, 3))


@pytest.mark.parametrize("mem", [[], [0.5] * 11])
def test_a_record_without_lost_peers_is_reported(mem: list[float]) -> None:
    rule = {"on_stale.action": "glide", "on_stale.on_lost": "degrade", "duration_s": 0.1}
    data = make_log_bytes("paper", rule | {"on_stale.align_limit_rad": 2.0})
    broken = edit_log_bytes(
        data, record=lambda r: {**r, "mem": mem} if (r["site"], r["tick"]) == ("s", 40) else r
    )
    assert PeerLoss.list_of_log(open_bytes(data)) == []
    with pytest.raises(LogError, match="a record of s does not have 12 numbers in `mem`"):
        PeerLoss.list_of_log(open_bytes(broken))

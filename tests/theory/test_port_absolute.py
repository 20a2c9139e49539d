import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import brentq

from tests.theory.analysed_ports import find_failing_frequencies
from tests.theory.networks import Complex, Network, Wire, make_pair
from trilat_net.analysis.theory.frequency_search import build_frequency_grid
from trilat_net.analysis.theory.port_passivity import (
    MAX_LLEWELLYN,
    clamp_ports,
    find_best_weights,
    find_least_eigenvalue,
    llewellyn_parameter,
    weight_response,
)
from trilat_net.analysis.theory.port_response import build_admittance

POSITIVE = st.floats(0.1, 10.0)
SEEDS = st.integers(0, 2**32 - 1)


def draw_networks(seed: int, ports: int, count: int = 40) -> Complex:
    """Draws networks about the edge of absolute stability, off-diagonal entries of very different size."""
    rng = np.random.default_rng(seed)
    Y = rng.normal(size=(count, ports, ports)) + 1j * rng.normal(size=(count, ports, ports))
    Y *= 10.0 ** rng.uniform(-1.0, 1.0, size=(count, 1, ports)) * rng.uniform(0.1, 0.6)
    own_ports = np.arange(ports)
    Y[:, own_ports, own_ports] = rng.uniform(0.1, 1.0, (count, ports)) + 1j * rng.normal(
        size=(count, ports)
    )
    return np.asarray(Y, dtype=np.complex128)


@settings(max_examples=20, deadline=None)
@given(K=POSITIVE, B=POSITIVE, d=st.just(0.0) | POSITIVE)
def test_undelayed_springs_and_dampers_are_absolutely_stable(
    K: float, B: float, d: float
) -> None:
    assert not find_failing_frequencies(make_pair((K, K), (d, d), (0.0, 0.0), B)).below


@pytest.mark.parametrize("d", [0.4, 1.0, 1.6])
def test_delayed_p_d_fails_below_its_sine(d: float) -> None:
    """2 d^2 >= abs(z12 z21) + Re(z12 z21) = 2 K^2 sin^2(w T) / w^2."""
    edge_rad_s = brentq(lambda w: 10.0 * np.sin(0.2 * w) / w - d, 1e-6, np.pi / 0.2)
    (span,) = find_failing_frequencies(make_pair(d=(d, d))).below[:1]
    assert span.from_hz == pytest.approx(1e-3)
    assert span.to_hz == pytest.approx(edge_rad_s / (2.0 * np.pi), rel=1e-5)
    assert not find_failing_frequencies(make_pair(d=(2.02, 2.02))).below


@given(seed=SEEDS)
def test_the_criterion_equals_its_three_inequalities(seed: int) -> None:
    Y = draw_networks(seed, 2)
    Y[::3, 0, 0] -= 0.4
    for parameters in (Y, np.linalg.inv(Y)):
        a = parameters[:, 0, 0].real
        b = parameters[:, 1, 1].real
        through = parameters[:, 0, 1] * parameters[:, 1, 0]
        excess = 2.0 * a * b - np.abs(through) - through.real
        holds = (a >= 0.0) & (b >= 0.0) & (excess >= 0.0)
        clear = (np.abs(a) > 1e-6) & (np.abs(b) > 1e-6) & (np.abs(excess) > 1e-6)
        np.testing.assert_array_equal((llewellyn_parameter(Y) >= 1.0)[clear], holds[clear])


def test_llewellyns_parameter_is_at_most_minus_one() -> None:
    Y = np.array([[[1.0, 0.0], [5.0, 1.0]], [[-1.0, 0.1], [0.1, -1.0]]], dtype=np.complex128)
    np.testing.assert_array_equal(llewellyn_parameter(Y), [MAX_LLEWELLYN, -1.0])


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS)
def test_for_two_ports_weights_match_llewellyn(seed: int) -> None:
    Y = draw_networks(seed, 2)
    weights = find_best_weights(Y, np.array([0, 1]))
    parameter = llewellyn_parameter(Y)
    clear = np.abs(weights.margin) > 1e-4
    np.testing.assert_array_equal(weights.margin[clear] > 0.0, parameter[clear] > 1.0)
    # where both parts are alike: y12 beta_1 ~ y21 beta_2
    ratio = np.abs(Y[:, 0, 1]) / np.abs(Y[:, 1, 0])
    np.testing.assert_allclose(weights.weights[:, 0], 1.0)
    plain = find_least_eigenvalue(weight_response(Y, weights.weights))
    np.testing.assert_array_equal(plain[clear] > 0.0, weights.margin[clear] > 0.0)
    assert np.isfinite(ratio).all()


def find_destabilised(Y: Complex) -> NDArray[np.bool_]:
    """True if passive impedances at the ports make det(1 + Y diag(z)) zero: two lossless, one
    solved for.
    """
    x = np.tan(np.linspace(-0.499 * np.pi, 0.499 * np.pi, 301))
    z1, z2 = (1j * part for part in np.meshgrid(x, x))
    is_destabilised = np.zeros(len(Y), dtype=bool)
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for n, y in enumerate(Y[:, order][:, :, order]):
            a = 1.0 + y[0, 0] * z1
            b = 1.0 + y[1, 1] * z2
            without = a * b - y[0, 1] * y[1, 0] * z1 * z2
            with_third = (
                y[2, 2] * without
                - y[0, 2] * (y[2, 0] * z1 * b - y[2, 1] * z2 * y[1, 0] * z1)
                + y[1, 2] * (y[2, 0] * z1 * y[0, 1] * z2 - y[2, 1] * z2 * a)
            )
            is_destabilised[n] |= bool((-(without / with_third).real > 0.0).any())
    return is_destabilised


@settings(max_examples=4, deadline=None)
@given(seed=SEEDS)
def test_for_three_ports_weights_are_exact(seed: int) -> None:
    """Necessary and sufficient: a search among passive loads finds one where and only where no
    weights do.
    """
    Y = draw_networks(seed, 3)
    margin = find_best_weights(Y, np.array([0, 1, 2])).margin
    clear = np.abs(margin) > 0.05
    np.testing.assert_array_equal(find_destabilised(Y[clear]), margin[clear] < 0.0)


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS)
def test_no_weights_of_a_fine_grid_do_better(seed: int) -> None:
    Y = draw_networks(seed, 6, count=3)
    owner = np.array([0, 0, 1, 1, 2, 2])
    weights = find_best_weights(Y, owner)
    size = np.ones((3, 6))
    for site in range(3):
        part = Y[:, owner == site][:, :, owner == site]
        size[:, owner == site] = np.linalg.norm(part, axis=(1, 2))[:, np.newaxis]
    scaled = Y / np.sqrt(size[:, :, np.newaxis] * size[:, np.newaxis, :])
    logs = np.linspace(-8.0, 8.0, 41)
    best = np.max(
        [
            find_least_eigenvalue(
                weight_response(scaled, np.exp(np.array([0.0, first, second]))[owner])
            )
            for first in logs
            for second in logs
        ],
        axis=0,
    )
    assert (weights.margin >= best - 2e-3 * np.abs(weights.margin)).all()


def test_one_site_needs_no_weights() -> None:
    Y = np.array([[[1.0 + 0.5j]]])
    assert find_best_weights(Y, np.array([0])).margin == pytest.approx(2.0 / abs(1.0 + 0.5j))


@given(seed=SEEDS)
def test_remaining_ports_are_part_of_matrices(seed: int) -> None:
    """Free: rows and columns of Y fall away. Clamped: those of Z."""
    Y = draw_networks(seed, 3)
    np.testing.assert_array_equal(clamp_ports(Y, [0, 2], []), Y[:, [0, 2]][:, :, [0, 2]])
    Z = np.linalg.inv(Y)
    np.testing.assert_allclose(
        np.linalg.inv(clamp_ports(Y, [0, 2], [1])), Z[:, [0, 2]][:, :, [0, 2]], rtol=1e-6
    )


def test_three_p_d_sites_hold_once_stable_alone() -> None:
    """d = abs(lambda_min(alpha)) K T = 1/2 * 10 * 0.2: Z + Z^H is 2 d + 2 K alpha sin(w T) / w."""
    wires = tuple(Wire(i, j, 5.0, 0.0, 0.2) for i in range(3) for j in range(3) if i != j)
    for d, holds in ((0.98, False), (1.02, True)):
        Y = build_admittance(Network((1.0,) * 3, (d,) * 3, (0.0,) * 3, wires).loop)
        margin = find_best_weights(
            Y(build_frequency_grid(1e-3, 10.0, 0.2)), np.arange(3)
        ).margin
        assert bool((margin > -1e-8).all()) is holds

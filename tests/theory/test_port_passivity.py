import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.theory.networks import Network, Wire, hold_by_spring, make_pair
from trilat_net.analysis.theory.frequency_search import build_frequency_grid, refine_response
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.port_passivity import (
    HandMatrices,
    Passivity,
    check_against_hands,
    clamp_ports,
    find_least_eigenvalue,
    weight_response,
)
from trilat_net.analysis.theory.port_response import build_admittance
from trilat_net.errors import UsageError

POSITIVE = st.floats(0.1, 10.0)
OR_NONE = st.just(0.0) | POSITIVE


def judge_passivity(network: Network, weights: tuple[float, ...] | None = None) -> Passivity:
    Y = build_admittance(network.loop)
    w, _ = refine_response(Y, build_frequency_grid(1e-3, 10.0, network.loop.longest_delay_s))
    return Passivity.check(Y, w, None if weights is None else np.array(weights))


@settings(max_examples=30, deadline=None)
@given(
    m=st.tuples(POSITIVE, POSITIVE, POSITIVE),
    d=st.tuples(OR_NONE, OR_NONE, OR_NONE),
    k=st.tuples(OR_NONE, OR_NONE, OR_NONE),
    links=st.lists(st.tuples(OR_NONE, OR_NONE), min_size=2, max_size=2),
)
def test_masses_springs_and_dampers_are_passive(
    m: tuple[float, ...],
    d: tuple[float, ...],
    k: tuple[float, ...],
    links: list[tuple[float, float]],
) -> None:
    wires = [
        Wire(a, b, K, B) for n, (K, B) in enumerate(links) for a, b in ((n, n + 1), (n + 1, n))
    ]
    passivity = judge_passivity(Network(m, d, k, tuple(wires)))
    assert passivity.passive
    assert passivity.lacking_nm_s_rad == 0.0


@settings(max_examples=20, deadline=None)
@given(K=POSITIVE, delay_s=st.floats(0.05, 1.0))
def test_a_delay_without_damping_is_not_passive(K: float, delay_s: float) -> None:
    assert not judge_passivity(make_pair((K, K), (0.0, 0.0), (delay_s, delay_s))).passive


@pytest.mark.parametrize("T", [(0.2, 0.2), (0.1, 0.5), (0.0, 0.3)])
@pytest.mark.parametrize("K", [(10.0, 10.0), (20.0, 3.0)])
@pytest.mark.parametrize("share", [0.3, 1.0, 4.0])
def test_p_d_is_passive_from_the_published_damping(
    K: tuple[float, float], T: tuple[float, float], share: float
) -> None:
    """4 d1 d2 >= (T1 + T2)^2 K1 K2, the energies weighted by 1 / K: at 2 % on either side."""
    product = 0.25 * sum(T) ** 2 * K[0] * K[1]
    for factor, holds in ((0.98, False), (1.02, True)):
        first = np.sqrt(product * factor) * share
        network = make_pair(K, (first, product * factor / first), T)
        # dampers of different size pass the damping on: their share of the weight cancels
        assert judge_passivity(network, (1.0 / K[0], 1.0 / K[1])).passive is holds


@pytest.mark.parametrize("d", [0.0, 0.5, 1.5, 1.9])
def test_p_d_lacks_k_t_less_its_damping(d: float) -> None:
    """-1/2 lambda_min(Z + Z^H) = K abs(sin(w T)) / w - d, most at w = 0: K T - d."""
    assert judge_passivity(make_pair(d=(d, d))).lacking_nm_s_rad == pytest.approx(
        2.0 - d, rel=1e-4
    )


@settings(max_examples=15, deadline=None)
@given(K=POSITIVE, delay_s=st.floats(0.05, 0.5))
def test_the_lacking_damping_is_just_enough_for_passivity(K: float, delay_s: float) -> None:
    lacking = judge_passivity(
        make_pair((K, K), (0.1, 0.2), (delay_s, delay_s))
    ).lacking_nm_s_rad
    for factor, holds in ((0.98, False), (1.02, True)):
        d = (0.1 + factor * lacking, 0.2 + factor * lacking)
        if lacking > 0.0:
            assert judge_passivity(make_pair((K, K), d, (delay_s, delay_s))).passive is holds


def test_the_active_range_follows_its_sine() -> None:
    """d = K abs(sin(w T)) / w."""
    (span,) = judge_passivity(make_pair(d=(1.0, 1.0))).minima.below
    w = 2.0 * np.pi * span.to_hz
    assert np.sin(0.2 * w) / w == pytest.approx(0.1, rel=1e-6)
    assert span.from_hz == pytest.approx(1e-3)


def test_winding_laws_lack_more_than_any_damper() -> None:
    """Z = m s + d + c / s^2: at low frequency a negative damping c / w^2."""
    loop = Network((1.0, 1.0), (2.0, 1.0), (0.0, 0.0)).loop
    A = loop.A.copy()
    # b's angle is a filter of a's now: an integral that leaks slowly
    A[2] = [
        1.0,
        0.0,
        -1.0,
        0.0,
    ]
    A[2, 2] = 0.0
    A[1, 2] = -0.1
    wound = loop._replace(
        A=A, B=loop.B[:, :1], C=loop.C[:1], inputs=("a.tau1",), outputs=("a.qd1",)
    )
    Y = build_admittance(wound)
    passivity = Passivity.check(Y, build_frequency_grid(1e-3, 100.0, 0.0))
    assert not passivity.passive
    assert passivity.lacking_nm_s_rad == np.inf


@given(
    scale=st.floats(0.01, 100.0),
    numbers=st.lists(st.complex_numbers(max_magnitude=10.0), min_size=9, max_size=9),
    weights=st.tuples(POSITIVE, POSITIVE, POSITIVE),
)
def test_ratios_of_weights_decide_the_sign_of_power(
    scale: float, numbers: list[complex], weights: tuple[float, ...]
) -> None:
    Y = np.array(numbers).reshape(1, 3, 3)
    D = np.array(weights)
    least = find_least_eigenvalue(weight_response(Y, D))[0]
    assert find_least_eigenvalue(weight_response(Y, scale * D))[0] == pytest.approx(
        least, rel=1e-9, abs=1e-9
    )
    power = np.diag(D) @ Y[0]
    plain = np.linalg.eigvalsh(power + power.conj().T)[0]
    if abs(least) > 1e-6:
        assert np.sign(plain) == np.sign(least)
    assert least == pytest.approx(
        find_least_eigenvalue(weight_response(Y, np.tile(D, (1, 1))))[0]
    )


W = np.geomspace(1e-2, 1e2, 41)
REFLECTING = Network(
    (1.0, 2.0, 1.5),
    (1.0, 2.0, 3.0),
    (0.0, 0.5, 0.0),
    (
        Wire(0, 1, 0.0, 0.0, 0.2, 0.7),
        Wire(1, 0, 9.0, 1.0, 0.3),
        Wire(2, 1, 4.0, 0.0, 0.1),
        Wire(0, 2, 2.0, 0.0, 0.1),
    ),
)


def assert_same(a: LinearLoop, b: LinearLoop) -> None:
    np.testing.assert_allclose(build_admittance(a)(W), build_admittance(b)(W), rtol=1e-9)


@given(K=POSITIVE, B=POSITIVE)
def test_a_load_is_spring_and_damper(K: float, B: float) -> None:
    network = make_pair()
    tied = network._replace(k=(0.0, K), d=(network.d[0], network.d[1] + B))
    assert_same(hold_by_spring(network.loop, "b", K, B), tied.loop)


@given(K=POSITIVE, B=POSITIVE)
def test_a_loads_impedance_adds_at_its_port(K: float, B: float) -> None:
    Y = build_admittance(REFLECTING.loop)(W)
    load = np.diag([0.0, 1.0, 0.0]) * (B + K / (1j * W))[:, np.newaxis, np.newaxis]
    expected = np.linalg.inv(np.linalg.inv(Y) + load)
    np.testing.assert_allclose(
        build_admittance(hold_by_spring(REFLECTING.loop, "b", K, B))(W), expected, rtol=1e-8
    )


@pytest.mark.parametrize("site", ["a", "b", "c"])
def test_a_clamp_leaves_the_rest_of_the_impedance(site: str) -> None:
    """This holds also if the clamp's own torque is reflected, and comes back after two delays."""
    index = "abc".index(site)
    keep = [n for n in range(3) if n != index]
    clamped = REFLECTING.loop.clamp_site(site)
    assert clamped.inputs == tuple(f"{name}.tau1" for name in "abc" if name != site)
    assert not any(name.startswith(f"{site}.") for name in clamped.names)
    Y = build_admittance(REFLECTING.loop)(W)
    np.testing.assert_allclose(
        build_admittance(clamped)(W), clamp_ports(Y, keep, [index]), rtol=1e-8, atol=1e-12
    )


def test_a_very_stiff_spring_is_nearly_a_clamp() -> None:
    stiff = build_admittance(hold_by_spring(REFLECTING.loop, "b", 1e9))(W)[:, [0, 2]][
        :, :, [0, 2]
    ]
    np.testing.assert_allclose(
        stiff, build_admittance(REFLECTING.loop.clamp_site("b"))(W), rtol=1e-5, atol=1e-7
    )


def test_clamps_that_reflect_onto_each_other_are_refused() -> None:
    both = Network(
        (1.0, 1.0),
        (1.0, 1.0),
        (0.0, 0.0),
        (Wire(0, 1, 1.0, k_f=0.5, delay_s=0.1), Wire(1, 0, 1.0, k_f=0.5, delay_s=0.1)),
    )
    three = Network((1.0,) * 3, (1.0,) * 3, (0.0,) * 3, both.wires)
    once = three.loop.clamp_site("a")
    assert len(once.inputs) == 2
    with pytest.raises(UsageError, match="reflect force onto each other"):
        once.clamp_site("b")


def test_a_clamp_at_no_site_is_refused() -> None:
    with pytest.raises(UsageError, match="no site 'z' among the ports; the sites are a, b"):
        make_pair().loop.clamp_site("z")


HELD = (np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]))
"""By the velocities at both ports those of either hand."""


def scalar_hand(damping: float) -> HandMatrices:
    return HandMatrices(np.array([[0.7]]), np.array([[damping]]), np.array([[250.0]]))


@pytest.mark.parametrize(("damping", "shown"), [(0.03, False), (0.05, True)])
def test_hands_with_the_lacking_damping_are_stable(damping: float, shown: bool) -> None:
    """P+d of K = 10, T = 0.2 s and d = 1.96 lacks 0.04 N m s/rad at each port (Nuno et al.

    2009).
    """
    Y = build_admittance(make_pair(d=(1.96, 1.96)).loop)
    w, _ = refine_response(Y, build_frequency_grid(1e-3, 10.0, 0.2))
    hands = [[scalar_hand(damping), scalar_hand(2.0)]] * 2
    assert (not check_against_hands(Y, w, hands, HELD).below) is shown
    nobody = check_against_hands(Y, w, hands[:1], HELD[:1])
    assert nobody.below


def test_mass_and_stiffness_of_a_hand_dissipate_nothing() -> None:
    w = np.geomspace(0.1, 100.0, 20)
    assert np.allclose(scalar_hand(3.0).compute_resistance(w), 3.0)
    swirl = HandMatrices(np.zeros((2, 2)), np.eye(2), np.array([[0.0, 5.0], [-5.0, 0.0]]))
    least = np.linalg.eigvalsh(swirl.compute_resistance(w))[:, 0]
    # a field of force that turns gives energy, the slower the more
    assert np.allclose(least, 1.0 - 5.0 / w)

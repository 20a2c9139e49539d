import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.theory.networks import Network, Wire, hold_by_spring, make_pair
from trilat_net.analysis.theory.port_response import (
    LoopOutput,
    PoleAtZero,
    Transparency,
    build_admittance,
    evaluate_transfer,
    select_ports,
)
from trilat_net.errors import RuntimeFault, UsageError

W = np.geomspace(1e-3, 1e3, 61)
POSITIVE = st.floats(0.1, 10.0)
DELAYS = st.sampled_from([0.0, 0.05, 0.2, 1.0])


@given(m=POSITIVE)
def test_a_mass_answers_with_its_admittance(m: float) -> None:
    Y = build_admittance(Network((m,), (0.0,), (0.0,)).loop)(W)
    np.testing.assert_allclose(Y[:, 0, 0], 1.0 / (1j * W * m), rtol=1e-12)


@given(
    m=st.tuples(POSITIVE, POSITIVE, POSITIVE),
    d=st.tuples(POSITIVE, POSITIVE, POSITIVE),
    k=st.tuples(POSITIVE, POSITIVE, POSITIVE),
    wires=st.lists(
        st.builds(
            Wire,
            st.integers(0, 2),
            st.integers(0, 2),
            POSITIVE,
            POSITIVE,
            DELAYS,
            st.floats(0.0, 1.0),
        ).filter(lambda wire: wire.at < wire.of),
        max_size=4,
    ),
)
def test_answers_invert_the_impedance_on_paper(
    m: tuple[float, ...], d: tuple[float, ...], k: tuple[float, ...], wires: list[Wire]
) -> None:
    """Springs, dampers, delays and reflected torque of any size."""
    network = Network(m, d, k, tuple(wires))
    Y = build_admittance(network.loop)(W)
    np.testing.assert_allclose(
        Y @ network.impedance(W), np.zeros_like(Y) + np.eye(3), atol=1e-9
    )


@given(K=POSITIVE, B=POSITIVE)
def test_undelayed_springs_and_dampers_are_reciprocal(K: float, B: float) -> None:
    at_once = build_admittance(make_pair((K, K), B=B, T=(0.0, 0.0)).loop)(W)
    np.testing.assert_allclose(at_once[:, 0, 1], at_once[:, 1, 0], rtol=1e-9)
    late = build_admittance(make_pair((K, K), B=B, T=(0.1, 0.3)).loop)(W)
    ratio = late[:, 0, 1] / late[:, 1, 0]
    np.testing.assert_allclose(ratio, np.exp(1j * W * 0.2), rtol=1e-9)


def test_outputs_may_be_delayed() -> None:
    """Velocity minus the velocity 0.3 s before."""
    loop = Network((2.0,), (1.0,), (0.0,)).loop
    Y = evaluate_transfer(loop, 1j * W, LoopOutput(loop.C, ((0.3, -loop.C),)))
    np.testing.assert_allclose(
        Y[:, 0, 0], (1.0 - np.exp(-0.3j * W)) / (2j * W + 1.0), rtol=1e-12
    )


def test_no_frequencies_no_answers() -> None:
    assert build_admittance(make_pair().loop)(np.zeros(0)).shape == (0, 2, 2)


def test_floating_networks_have_passive_poles_at_zero() -> None:
    floating = Network((1.0, 3.0), (0.0, 0.0), (0.0, 0.0), (Wire(0, 1, 7.0), Wire(1, 0, 7.0)))
    pole = PoleAtZero.of_loop(floating.loop)
    assert pole.order == 1
    assert pole.passive
    np.testing.assert_allclose(pole.residue, np.full((2, 2), 1.0 / 4.0), rtol=1e-9)
    for tied in (floating._replace(k=(1.0, 0.0)), floating._replace(d=(1.0, 0.0)), make_pair()):
        none = PoleAtZero.of_loop(tied.loop)
        assert none.order == 0
        assert none.passive
        assert not none.residue.any()


def test_uneven_floating_masses_have_an_active_pole() -> None:
    """7 N m/rad one way and 3 the other: the residue is no longer symmetric."""
    pole = PoleAtZero.of_loop(
        Network((1.0, 3.0), (0.0, 0.0), (0.0, 0.0), (Wire(0, 1, 7.0), Wire(1, 0, 3.0))).loop
    )
    assert pole.order == 1
    np.testing.assert_allclose(
        pole.residue, [[1.0 / 8.0, 7.0 / 24.0], [1.0 / 8.0, 7.0 / 24.0]], rtol=1e-9
    )
    assert not pole.passive


def test_following_floating_angles_gives_third_order_poles() -> None:
    """qdd_a = u_a + 5 q_b and qdd_b = u_b: Y_ab = 5 / s^3."""
    loop = Network((1.0, 1.0), (0.0, 0.0), (0.0, 0.0)).loop
    A = loop.A.copy()
    A[1, 2] = 5.0
    pole = PoleAtZero.of_loop(loop._replace(A=A))
    assert pole.order == 3
    assert not pole.passive


def test_ports_by_site_and_by_joint() -> None:
    loop = make_pair().loop._replace(inputs=("a.tau1", "a.tau2"), outputs=("a.qd1", "a.qd2"))
    assert loop.sites == ("a",)
    assert loop.find_site_ports("a") == [0, 1]
    assert loop.ports_by_joint == {1: [0], 2: [1]}
    assert make_pair().loop.ports_by_joint == {1: [0, 1]}
    assert make_pair(T=(0.1, 0.4)).loop.longest_delay_s == 0.4
    assert Network((1.0,), (0.0,), (0.0,)).loop.longest_delay_s == 0.0
    Y = build_admittance(loop)
    np.testing.assert_array_equal(select_ports(Y, [1])(W), Y(W)[:, 1:, 1:])


def test_ports_need_a_velocity_for_each_torque() -> None:
    loop = make_pair().loop
    with pytest.raises(RuntimeFault, match=r"as many velocities as torques.* 1 and 2"):
        build_admittance(loop._replace(C=loop.C[:1]))


@given(
    K=POSITIVE,
    d=st.tuples(POSITIVE, POSITIVE),
    T=st.tuples(st.floats(0.0, 0.5), st.floats(0.0, 0.5)),
)
def test_felt_p_d_impedance_is_as_on_paper(
    K: float, d: tuple[float, float], T: tuple[float, float]
) -> None:
    """Clamped: m s + d + K / s.

    Free: that less K^2 e^{-s (T1 + T2)} / s^2 over the other's own impedance.
    """
    network = make_pair((K, K), d, T)
    (transparency,) = Transparency.measure(network.loop, "a", "b")
    S = 1j * transparency.w_rad_s
    own_impedance, other = (
        m * S + damping + K / S for m, damping in zip(network.m, d, strict=True)
    )
    through = (K / S) ** 2 * np.exp(-S * sum(T))
    np.testing.assert_allclose(transparency.clamped, own_impedance, rtol=1e-8)
    np.testing.assert_allclose(transparency.free, own_impedance - through / other, rtol=1e-8)
    # the Z-width -h12 h21 / h22
    inside = (transparency.w_rad_s >= 0.2 * np.pi) & (transparency.w_rad_s <= 20.0 * np.pi)
    sizes = np.abs(through / other)[inside]
    assert (
        sizes.min() * (1.0 - 1e-6)
        <= transparency.difference_nm_s_rad
        <= sizes.max() * (1.0 + 1e-6)
    )


def test_the_third_sites_holder_counts() -> None:
    wires = tuple(Wire(i, j, 5.0, 0.0, 0.1) for i in range(3) for j in range(3) if i != j)
    loop = Network((1.0,) * 3, (1.0,) * 3, (0.0,) * 3, wires).loop
    (alone,) = Transparency.measure(loop, "a", "c")
    (held,) = Transparency.measure(hold_by_spring(loop, "b", 1e3, 10.0), "a", "c")
    # a tenth of a hertz: springs count
    assert held.interpolate_magnitudes(0.1)[0] > 1.5 * alone.interpolate_magnitudes(0.1)[0]
    assert held.interpolate_magnitudes(0.1)[1] == pytest.approx(10.0 / (0.2 * np.pi), rel=0.05)


@given(
    free=POSITIVE, clamped=POSITIVE, band=st.tuples(st.floats(0.02, 1.0), st.floats(2.0, 50.0))
)
def test_the_width_is_a_ratio_in_db(
    free: float, clamped: float, band: tuple[float, float]
) -> None:
    w = 2.0 * np.pi * np.union1d(np.geomspace(0.01, 100.0, 401), band)
    transparency = Transparency("a", "b", 1, w, 1j * free * w, 1j * clamped * w, band)
    assert transparency.ratio_db == pytest.approx(20.0 * np.log10(clamped / free), abs=1e-9)
    middle_rad_s = 2.0 * np.pi * np.sqrt(band[0] * band[1])
    assert transparency.softest_nm_s_rad == pytest.approx(free * middle_rad_s, rel=1e-6)
    assert transparency.stiffest_nm_s_rad == pytest.approx(clamped * middle_rad_s, rel=1e-6)
    assert transparency.interpolate_magnitudes(1.0) == pytest.approx(
        (2.0 * np.pi * free, 2.0 * np.pi * clamped), rel=1e-6
    )


def test_the_width_grows_with_coupling_stiffness() -> None:
    widths = [
        Transparency.measure(make_pair((K, K), (0.5, 0.5), (0.0, 0.0)).loop, "a", "b")[
            0
        ].ratio_db
        for K in (1.0, 10.0, 100.0)
    ]
    assert widths == sorted(widths)
    assert widths[-1] > 5.0


def test_two_sites_that_do_not_couple_feel_nothing() -> None:
    (transparency,) = Transparency.measure(
        Network((1.0, 1.0), (1.0, 1.0), (0.0, 0.0)).loop, "a", "b"
    )
    assert transparency.ratio_db == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("at", "of", "said"),
    [
        ("z", "b", "no site 'z'"),
        ("a", "z", "no site 'z'"),
        ("a", "a", "the operator's own site"),
    ],
)
def test_unfelt_pairs_are_refused(at: str, of: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        Transparency.measure(make_pair().loop, at, of)

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.theory.networks import Network, Wire, pair
from trilat_net.errors import UsageError
from trilat_net.theory.port_response import PortLoad, Transparency, measure_transparency, to_imaginary_axis

POSITIVE = st.floats(0.1, 10.0)


@given(K=POSITIVE, d=st.tuples(POSITIVE, POSITIVE), T=st.tuples(st.floats(0.0, 0.5), st.floats(0.0, 0.5)))
def test_what_is_felt_of_p_d_is_as_on_paper(K: float, d: tuple[float, float], T: tuple[float, float]) -> None:
    """Clamped: m s + d + K / s. Free: that less K^2 e^{-s (T1 + T2)} / s^2 over the other's own impedance."""
    network = pair((K, K), d, T)
    (found,) = measure_transparency(network.loop, "a", "b")
    S = 1j * found.w_rad_s
    own, other = (m * S + damping + K / S for m, damping in zip(network.m, d, strict=True))
    through = (K / S) ** 2 * np.exp(-S * sum(T))
    np.testing.assert_allclose(found.clamped, own, rtol=1e-8)
    np.testing.assert_allclose(found.free, own - through / other, rtol=1e-8)
    inside = (found.w_rad_s >= 0.2 * np.pi) & (found.w_rad_s <= 20.0 * np.pi)  # the Z-width -h12 h21 / h22
    sizes = np.abs(through / other)[inside]
    assert sizes.min() * (1.0 - 1e-6) <= found.difference_nm_s_rad <= sizes.max() * (1.0 + 1e-6)


def test_who_holds_the_third_site_counts() -> None:
    wires = tuple(Wire(i, j, 5.0, 0.0, 0.1) for i in range(3) for j in range(3) if i != j)
    loop = Network((1.0,) * 3, (1.0,) * 3, (0.0,) * 3, wires).loop
    (alone,) = measure_transparency(loop, "a", "c")
    (held,) = measure_transparency(loop, "a", "c", {"b": PortLoad(1e3, 10.0)})
    assert held.size_at(0.1)[0] > 1.5 * alone.size_at(0.1)[0]  # a tenth of a hertz: springs count
    assert held.size_at(0.1)[1] == pytest.approx(10.0 / (0.2 * np.pi), rel=0.05)


@given(free=POSITIVE, clamped=POSITIVE, band=st.tuples(st.floats(0.02, 1.0), st.floats(2.0, 50.0)))
def test_the_width_is_the_ratio_in_db_whatever_the_band(
    free: float, clamped: float, band: tuple[float, float]
) -> None:
    w = 2.0 * np.pi * np.union1d(np.geomspace(0.01, 100.0, 401), band)
    one = Transparency("a", "b", 1, w, to_imaginary_axis(free * w), to_imaginary_axis(clamped * w), band)
    assert one.ratio_db == pytest.approx(20.0 * np.log10(clamped / free), abs=1e-9)
    middle_rad_s = 2.0 * np.pi * np.sqrt(band[0] * band[1])
    assert one.softest_nm_s_rad == pytest.approx(free * middle_rad_s, rel=1e-6)
    assert one.stiffest_nm_s_rad == pytest.approx(clamped * middle_rad_s, rel=1e-6)
    assert one.size_at(1.0) == pytest.approx((2.0 * np.pi * free, 2.0 * np.pi * clamped), rel=1e-6)


def test_the_width_grows_with_the_stiffness_of_the_coupling() -> None:
    widths = [
        measure_transparency(pair((K, K), (0.5, 0.5), (0.0, 0.0)).loop, "a", "b")[0].ratio_db
        for K in (1.0, 10.0, 100.0)
    ]
    assert widths == sorted(widths)
    assert widths[-1] > 5.0


def test_two_sites_that_do_not_couple_feel_nothing() -> None:
    (one,) = measure_transparency(Network((1.0, 1.0), (1.0, 1.0), (0.0, 0.0)).loop, "a", "b")
    assert one.ratio_db == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("at", "of", "band", "said"),
    [
        ("z", "b", (0.1, 1.0), "no site 'z'"),
        ("a", "z", (0.1, 1.0), "no site 'z'"),
        ("a", "a", (0.1, 1.0), "the operator's own site"),
        ("a", "b", (1.0, 0.1), "to a higher one"),
        ("a", "b", (0.0, 0.1), "to a higher one"),
    ],
)
def test_what_cannot_be_felt_is_refused(at: str, of: str, band: tuple[float, float], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        measure_transparency(pair().loop, at, of, band_hz=band)

"""The numbers of docs/linear.md, as its commands make them."""

import pytest

from tests.theory.loops import RODS
from trilat_net.scenario import load_scenario
from trilat_net.theory import analyse_linear_loop, find_linear_edge

LINE = {"p_d_margin": 0.5, "p_d_margin_two": 1.0}


@pytest.mark.parametrize(
    ("delay_ms", "points", "rods"),
    [
        (0, -0.1635 + 6.049j, -0.3734 + 7.909j),
        (200, -0.1958 + 6.289j, -0.6930 + 8.464j),
        (400, -0.2374 + 6.202j, -0.6424 + 7.979j),
    ],
)
def test_rightmost_roots_of_free(delay_ms: int, points: complex, rods: complex) -> None:
    for arm, printed in (({}, points), (RODS, rods)):
        found = analyse_linear_loop(load_scenario("free", {"link.delay_ms": delay_ms, **arm}), roots=1)
        assert found.continuous.rightmost is not None
        s = found.continuous.rightmost.s
        assert (s.real, abs(s.imag)) == (
            pytest.approx(printed.real, abs=6e-5),
            pytest.approx(printed.imag, abs=6e-4),
        )


@pytest.mark.parametrize(
    ("name", "delay_ms", "edge"),
    [
        ("p_d_margin", 20, 0.09997),
        ("p_d_margin", 400, 1.765),
        ("p_d_margin", 1600, 2.825),
        ("p_d_margin_two", 20, 0.1999),
        ("p_d_margin_two", 400, 3.444),
        ("p_d_margin_two", 1600, 6.629),
    ],
)
def test_edges_of_p_d(name: str, delay_ms: int, edge: float) -> None:
    line = LINE[name] * 10.0 * delay_ms / 1e3
    scenario = load_scenario(name, {"link.delay_ms": delay_ms})
    found = find_linear_edge(scenario, "control.d", 0.05 * line, 1.2 * line)
    assert found is not None
    assert found.value == pytest.approx(edge, rel=3e-4)


@pytest.mark.parametrize(
    ("name", "changes", "pose", "growth_per_s", "margin_ms"),
    [
        ("jitter", [], None, -0.081, 121.5),
        ("jitter", ["link.playout_ms=400"], None, 0.54, 121.5),
        ("paper", ["scheme=digital", "rate_hz=100", "link.delay_ms=0"], (-0.1729, 0.0874), 0.0091, None),
        ("contact", [], None, 0.925, 107.7),
        ("paper", ["link.delay_ms=0"], None, -0.0273, 39.25),
    ],
)
def test_growth_and_margins(
    name: str,
    changes: list[str],
    pose: tuple[float, float] | None,
    growth_per_s: float,
    margin_ms: float | None,
) -> None:
    found = analyse_linear_loop(name, changes, pose=pose, roots=1)
    assert found.decisive.rightmost is not None
    assert found.decisive.rightmost.s.real == pytest.approx(growth_per_s, rel=0.01)
    if margin_ms is not None:
        assert 1e3 * found.margin.intervals[0].high_s == pytest.approx(margin_ms, abs=0.06)

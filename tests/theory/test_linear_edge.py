"""Edges of stability over a key, against the lines of the theory and their omissions.

The linear analysis of the places of a map equals that of each place alone.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigvalsh
from scipy.optimize import brentq

from tests.theory.loops import Array
from trilat_net.analysis.theory import LinearAnalysis, find_equilibrium, iterate_linear_edges
from trilat_net.analysis.theory.equilibrium import predict_equilibrium
from trilat_net.analysis.theory.linear_edge import (
    ASSUMED_EQUILIBRIUM_REMARK,
    GrowthColumn,
    LinearEdge,
)
from trilat_net.core.arms.two_link_arm import inertia
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.scenario import Scenario, load_scenario


def least_damping(scenario: Scenario, K: float, T: float, share: float) -> float:
    """Returns d where M w^2 = K (1 + share cos w T) and d w = share K sin w T, the largest over
    M's eigenvalues.

    The equations of a mode v of M and of an eigenvalue -share of alpha on the imaginary axis.
    """
    rest = predict_equilibrium(scenario)
    theta = scenario.arms["s"].theta
    dampings = []
    for mass in eigvalsh(np.array(inertia(theta, rest.q[0]))):

        def balance(w: float, mass: float = mass) -> float:
            return mass * w * w - K * (1 + share * math.cos(w * T))

        w = brentq(balance, 1e-9, math.sqrt(K * (1 + share) / mass))
        dampings.append(share * K * math.sin(w * T) / w)
    return max(dampings)


@pytest.mark.parametrize(("name", "share"), [("p_d_margin", 0.5), ("p_d_margin_two", 1.0)])
@pytest.mark.parametrize(
    "delay_ms", [200.0, *(pytest.param(ms, marks=pytest.mark.long) for ms in (20.0, 400.0))]
)
def test_p_d_turns_stable_with_its_mode(name: str, share: float, delay_ms: float) -> None:
    scenario = load_scenario(name, {"link.delay_ms": delay_ms})
    T = delay_ms / 1e3
    line = share * 10.0 * T
    edge = next(
        iterate_linear_edges(scenario, "control.d", 0.3 * line, 1.5 * line, points=8), None
    )
    assert edge is not None
    assert edge.stable_above
    assert edge.value == pytest.approx(least_damping(scenario, 10.0, T, share), rel=1e-4)
    assert edge.value < line  # the line leaves the inertia out: it is on the safe side


def draw_heavy_pair(
    seed: int, ratio: Callable[[float, float, float, float], float]
) -> tuple[Scenario, Array]:
    """Draws two sites with random gains and delays whose arms are so heavy that K T^2 << M;
    also returns K1, K2, T1 + T2, d1, d2. d2 is that of the line 4 d1 d2 = (T1 + T2)^2 K1 K2;
    `ratio` says how much heavier the second arm is.
    """
    rng = np.random.default_rng(seed)
    K1, K2 = (float(K) for K in rng.uniform(2.0, 10.0, 2))
    T1_ms, T2_ms = (float(T) for T in rng.integers(2, 20, 2))
    T = 1e-3 * (T1_ms + T2_ms)
    d1 = float(rng.uniform(0.7, 1.4)) * T * math.sqrt(K1 * K2) / 2.0
    d2 = T * T * K1 * K2 / (4.0 * d1)
    arms = {}
    for site, kg in (("m", 300.0), ("s", 300.0 * ratio(K1, K2, d1, d2))):
        arms |= {f"sites.{site}.arm.{key}": kg for key in ("m1_kg", "m2_kg")}
        arms |= {f"sites.{site}.arm.{key}": kg / 12.0 for key in ("I1_kg_m2", "I2_kg_m2")}
    links = {"links.m->s.delay_ms": T1_ms, "links.s->m.delay_ms": T2_ms}
    gains = {"sites.m.control.K": K1, "sites.s.control.K": K2, "sites.m.control.d": d1}
    return load_scenario("p_d_margin_two", {**arms, **links, **gains}), np.array(
        [K1, K2, T, d1, d2]
    )


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.long) for n in (1, 2, 3))]
)
def test_two_sites_turn_stable_at_4_d_d(seed: int) -> None:
    """4 d1 d2 = (T1 + T2)^2 K1 K2, where M2/M1 is the ratio that needs the most damping."""

    def worst(K1: float, K2: float, d1: float, d2: float) -> float:
        both = math.sqrt(K1 * K2)
        return (K2 + both * math.sqrt(d2 / d1)) / (K1 + both * math.sqrt(d1 / d2))

    scenario, (*_, d2) = draw_heavy_pair(seed, worst)
    edge = next(
        iterate_linear_edges(scenario, "sites.s.control.d", 0.8 * d2, 1.3 * d2, points=3), None
    )
    assert edge is not None
    assert edge.value == pytest.approx(d2, rel=1e-3)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.long) for n in (1, 2, 3))]
)
def test_two_like_arms_need_their_round_trip(seed: int) -> None:
    """d1/K2 + d2/K1 = T1 + T2: no more than 4 d1 d2 asks for, by two means of the terms."""
    scenario, (K1, K2, T, d1, d2) = draw_heavy_pair(seed, lambda *_, **__: 1.0)
    exact = K1 * (T - d1 / K2)
    edge = next(
        iterate_linear_edges(scenario, "sites.s.control.d", 0.7 * exact, 1.4 * exact, points=3),
        None,
    )
    assert edge is not None
    assert edge.value == pytest.approx(exact, rel=1e-3)
    assert edge.value <= d2 * 1.001


@pytest.mark.long
def test_digital_controllers_have_a_least_rate() -> None:
    """No delay, gains of the paper: 100 Hz oscillates, 125 Hz does not."""
    scenario = load_scenario("paper", {"scheme": "digital", "link.delay_ms": 0.0})
    rest = find_equilibrium(scenario, (-0.1729, 0.0874))
    edge = next(iterate_linear_edges(scenario, "rate_hz", 60, 400, rest, points=6), None)
    assert edge is not None
    assert 100 < edge.value < 125
    assert edge.stable_above
    assert (
        next(
            iterate_linear_edges(scenario, "rate_hz", 60, 400, rest, points=6, sampled=False),
            None,
        )
        is None
    )


@pytest.mark.long
def test_every_existing_edge_is_found() -> None:
    scenario = load_scenario("p_d_margin")
    assert next(iterate_linear_edges(scenario, "control.d", 1.2, 3.0, points=4), None) is None
    edges = list(iterate_linear_edges(scenario, "link.delay_ms", 50, 3000, points=40))
    assert [edge.stable_above for edge in edges] == [False, True, False, True][: len(edges)]
    assert all(isinstance(edge, LinearEdge) for edge in edges)
    assert 200 < edges[0].value < 230


@pytest.mark.parametrize(
    ("low", "high"), [(2.0, 1.0), (1.0, 1.0), (float("nan"), 1.0), (0.0, float("inf"))]
)
def test_an_invalid_range_is_refused(low: float, high: float) -> None:
    with pytest.raises(
        UsageError, match=r"control\.d must be scanned from a lower to a higher value"
    ):
        next(iterate_linear_edges(load_scenario("p_d_margin"), "control.d", low, high), None)


def test_invalid_keys_are_refused_with_the_nearest() -> None:
    with pytest.raises(ScenarioError, match="did you mean 'Kd'"):
        next(iterate_linear_edges(load_scenario("p_d_margin"), "control.Kdd", 1, 2), None)


D = (0.8, 0.9, 1.0, 1.1)


def make_damped_scenario(d: float) -> Scenario:
    return load_scenario("p_d_margin", {"control.d": d})


def test_the_real_part_is_that_of_the_analysis() -> None:
    growth_rates, _, remarks, _ = GrowthColumn.compute(
        [make_damped_scenario(d) for d in D], "control.d", D
    )
    assert remarks == []
    for d, growth in zip(D, growth_rates, strict=True):
        root = LinearAnalysis.compute(
            make_damped_scenario(d), pose=(1.0 / 15.0, 7.0 / 30.0)
        ).continuous.rightmost
        assert root is not None
        assert growth == pytest.approx(root.s.real, abs=1e-9)


@pytest.mark.long
def test_an_edge_is_where_the_sign_changes() -> None:
    (crossing,), remark = GrowthColumn.find_crossings(
        make_damped_scenario(3.0), "control.d", 0.3, 3.0
    )
    assert remark == ""
    places = (crossing - 1e-4, crossing + 1e-4)
    (below, above), edges, *_ = GrowthColumn.compute(
        [*map(make_damped_scenario, places)], "control.d", places
    )
    assert below > 0.0 > above
    assert edges == {0: pytest.approx(crossing, rel=1e-6)}
    alone = next(iterate_linear_edges(make_damped_scenario(3.0), "control.d", 0.3, 3.0), None)
    assert alone is not None
    assert crossing == pytest.approx(alone.value, rel=1e-6)


def test_the_scheme_decides_the_loop() -> None:
    """Without delay the continuous loop of the paper's law is stable at any rate; as computed it is not."""
    slow: dict[str, Any] = {"link.delay_ms": 0.0, "rate_hz": 50}
    schemes = [
        load_scenario("free", {**slow, "scheme": scheme})
        for scheme in ("second_order", "digital")
    ]
    columns = [GrowthColumn.compute([scheme], "link.delay_ms", (0.0,)) for scheme in schemes]
    (continuous,), (digital,) = (column.growth_per_s for column in columns)
    assert continuous < 0.0 < digital
    assert columns[0].remarks == columns[1].remarks == [ASSUMED_EQUILIBRIUM_REMARK]


def test_nonlinear_loops_are_reported_as_unknown() -> None:
    unknown = load_scenario("p_d_margin", {"link.model": "measured"})
    growth_rates, edges, remarks, _ = GrowthColumn.compute(
        [unknown, make_damped_scenario(3.0)], "control.d", (2.9, 3.0)
    )
    assert edges == {}
    assert np.isnan(growth_rates[0])
    assert growth_rates[1] < 0.0
    assert len(remarks) == 1
    assert remarks[0].startswith("no linear analysis: ")
    crossings, remark = GrowthColumn.find_crossings(unknown, "control.d", 0.3, 3.0)
    assert crossings == ()
    assert remark.startswith("no linear analysis: ")

"""The energy balance closes, to the order of what made the log, and only with every term as it is."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.core.guarded_runs import adaptive_text, stopped_log
from tests.theory.delay_equations import DelayEquations, equations, inertia
from tests.theory.energy import balance as balance_by_hand
from tests.theory.energy import left_null_vector
from tests.virtual_runs import run
from trilat_net.analysis.certificate.energy_balance import (
    EnergyBalance,
    compute_energy_balance,
    compute_site_energies,
)
from trilat_net.scenario import load_scenario

from . import runs

CAUGHT = 1e-3
"""A residual, as a share of the largest energy, that no log of these has by itself."""


def of_largest_v(b: EnergyBalance) -> float:
    return float(np.abs(b.residual).max() / b.V.max())


def order(name: str, fine_hz: int = 1000, **overrides: object) -> float:
    rates = fine_hz // 2, fine_hz
    coarse, fine = (of_largest_v(runs.run(name, {**overrides, "rate_hz": hz}).balance) for hz in rates)
    return float(np.log2(coarse / fine))


@pytest.mark.parametrize("name", ["paper", pytest.param("free", marks=pytest.mark.long), "asymmetric"])
def test_the_balance_closes_to_2e_5_with_order_two(name: str) -> None:
    assert of_largest_v(runs.run(name, {"duration_s": 2.0, "rate_hz": 1000}).balance) <= 2e-5
    assert order(name, duration_s=2.0) == pytest.approx(2.0, abs=0.1)


def test_it_closes_until_both_hands_have_let_go() -> None:
    """At a tenth of the rate a hundred times the error is allowed."""
    assert of_largest_v(runs.run("paper", {"duration_s": 11.5, "rate_hz": 100}).balance) <= 2e-3


def test_digital_closes_to_some_percent_with_order_one() -> None:
    b = runs.run("paper", {"duration_s": 3.0, "scheme": "digital", "rate_hz": 500}).balance
    assert of_largest_v(b) == pytest.approx(3.2e-2, rel=0.2)
    assert order("paper", 500, duration_s=3.0, scheme="digital") == pytest.approx(1.0, abs=0.1)
    assert np.abs(b.unexplained).max() <= 4e-5 * b.scale


def test_jitter_closes_to_1e_4_with_its_jumps_booked() -> None:
    b = runs.run("free", runs.JITTER).balance
    links = np.sum([x for name, x in b.work.items() if "->" in name], axis=0)
    assert of_largest_v(b) <= 1e-4
    assert np.abs(b.residual + links).max() / b.V.max() >= 3e-3
    assert np.abs(b.unexplained).max() <= 5e-6 * b.scale


def test_jitter_is_of_order_one_at_least() -> None:
    """Of some seeds together: which jumps a run has is a matter of its draws; errors cancel to order 1.5."""
    seeds = [{**runs.JITTER, "duration_s": 1.5, "seed": seed} for seed in (1, 2)]
    orders = [order("free", 500, **overrides) for overrides in seeds]
    assert 1.0 <= np.mean(orders) <= 2.0


def test_what_sampling_leaves_is_of_order_two_across_a_jump() -> None:
    """Arms that brake: e and its derivative jump at once, and the torque that is held is that of before."""
    cut = {"link.loss": 1.0, "on_stale.action": "brake", "duration_s": 1.0}
    rest = [
        float(np.abs(runs.run("free", {**cut, "rate_hz": hz}).balance.unexplained).max()) for hz in (200, 400)
    ]
    assert np.log2(rest[0] / rest[1]) == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize(
    ("key", "limit", "term"),
    [("tau_rate_limit_nm_s", 100.0, "torque limit"), ("qd_des_limit_rad_s", 0.5, "rule")],
)
def test_what_limit_of_torque_rate_or_reference_takes_is_booked(key: str, limit: float, term: str) -> None:
    b = runs.run("paper", {"duration_s": 2.0, "rate_hz": 1000, f"limits.{key}": limit}).balance
    assert np.abs(b.work[term]).max() > 0.01 * b.V.max()
    assert np.abs(b.unexplained).max() <= 5e-6 * b.scale


def test_a_site_that_stops_and_goes_on_is_booked() -> None:
    """Its torque is not that of the law, and its estimates stand still."""
    b = compute_energy_balance(compute_site_energies(stopped_log(adaptive_text(), 3000)))
    assert np.abs(b.work["torque limit"]).max() > 0.01 * b.V.max()
    assert np.abs(b.work["estimates"]).max() > 1e-3 * b.V.max()
    assert np.abs(b.unexplained).max() <= 5e-4 * b.scale


def test_a_wall_that_gives_energy_closes_to_1e_4() -> None:
    b = runs.run("wall").balance
    assert b.work["walls"].max() > 1e-3
    assert of_largest_v(b) <= 1e-4


def test_everything_at_once_closes_to_1e_4_at_500_hz() -> None:
    b = runs.run("rich").balance
    assert of_largest_v(b) <= 1e-4
    assert all(np.abs(x).max() > 1e-4 * b.scale for name, x in b.work.items() if name not in _SILENT)


_SILENT = ("m2->m1", "m1->m2", "m2->s")
"""The links of `rich` that give one constant delay."""

TERMS = [
    *[("rich", "parts", name) for name in ("kinetic", "parameter", "position", "delay")],
    *[("rich", "dissipation", name) for name in ("damping", "disagreement")],
    *[("rich", "work", name) for name in ("hands", "walls", "shares", "rule", "torque limit", "estimates")],
    *[("rich", "work", name) for name in ("s->m1", "s->m2")],
    ("free", "work", "m1->m2"),
]


@pytest.mark.parametrize("factor", [-1.0, 0.0, 2.0])
@pytest.mark.parametrize(("name", "group", "term"), TERMS, ids=lambda value: str(value))
def test_any_one_term_with_another_sign_or_factor_is_caught(
    name: str, group: str, term: str, factor: float
) -> None:
    b = runs.run(name, runs.JITTER if name == "free" else None).balance
    terms = {**getattr(b, group), term: factor * getattr(b, group)[term]}
    assert runs.relative(replace(b, **{group: terms})) > CAUGHT > 5 * runs.relative(b)


def test_ones_for_beta_is_caught_and_named() -> None:
    """The paper sets beta = (1, 1, 1) after Eq. (20): the right null vector of Upsilon, not the left one."""
    ones = compute_energy_balance(
        runs.run("asymmetric", {"duration_s": 2.0, "rate_hz": 1000}).energies, ones=True
    )
    assert runs.relative(ones) > 10 * CAUGHT
    assert np.abs(ones.residual + ones.transfer).max() <= 2e-5 * ones.V.max()


def test_v_with_the_papers_weights_rises_the_corrected_one_never() -> None:
    books = runs.run("free", runs.LYAPUNOV).energies
    ones, right = compute_energy_balance(books, ones=True), compute_energy_balance(books)
    assert ones.V[0] == pytest.approx(32.8, abs=0.1)
    rise, kept = (float((b.V - np.minimum.accumulate(b.V)).max()) for b in (ones, right))
    assert rise == pytest.approx(12.3, abs=0.5)
    assert kept <= np.abs(right.residual).max()


@pytest.mark.parametrize("name", [pytest.param("paper", marks=pytest.mark.long), "asymmetric"])
def test_it_is_what_another_book_of_the_same_run_says(name: str) -> None:
    """`tests/theory/energy.py` knows one constant delay per link and nothing else; there both must agree."""
    overrides = {"duration_s": 2.5, "rate_hz": 500}
    made = run(name, overrides)
    theirs, ours = (
        balance_by_hand(made, left_null_vector(made.scenario) * 3),
        runs.run(name, overrides).balance,
    )
    close = {"abs": 1e-12 * float(theirs.V.max())}
    assert pytest.approx(theirs.V, **close) == ours.V
    assert sum(ours.dissipation.values()) == pytest.approx(theirs.taken, **close)
    assert sum(ours.work.values()) == pytest.approx(theirs.given, **close)


def test_it_converges_to_the_functional_along_the_exact_solution() -> None:
    """V, dissipation and work of the continuous equations: DOP853 and Gauss-Legendre, nothing of ours."""
    scenario = load_scenario("paper", {"duration_s": 2.0})
    exact = equations(scenario).solve(2.0)
    ours = runs.run("paper", {"duration_s": 2.0, "rate_hz": 1000}).balance
    for t in (0.5, 1.2, 1.9):
        k = round(t * 1000)
        assert float(ours.V[k]) == pytest.approx(_exact_v(exact, t), abs=3e-4)
        taken, given = _exact_integrals(exact, t)
        assert sum(float(x[k]) for x in ours.dissipation.values()) == pytest.approx(taken, abs=3e-4)
        assert float(ours.work["hands"][k]) == pytest.approx(given, abs=3e-4)
        assert _exact_v(exact, t) - _exact_v(exact, 0.0) + taken - given == pytest.approx(0.0, abs=1e-7)


def _gauss(f, a: float, b: float, edges: list[float]) -> float:
    """Integral of a function of times, with no panel across an edge."""
    x, w = np.polynomial.legendre.leggauss(12)
    cuts = sorted({a, b, *(float(e) for e in edges if a < e < b)})
    total = 0.0
    for low, high in pairwise(cuts):
        total += 0.5 * (high - low) * float(w @ f(0.5 * (high + low) + 0.5 * (high - low) * x))
    return total


PANELS = np.arange(0.0, 4.0, 0.05).tolist()


def _delayed(exact: DelayEquations, times: np.ndarray) -> np.ndarray:
    return np.stack([exact.past(t - exact.delay_s) for t in times], axis=1)


def _exact_v(exact: DelayEquations, t: float) -> float:
    at = np.array([t])
    now = exact.past(t) if t else exact.past(-1.0)
    q, qd, estimate = now[:, :2], now[:, 2:4], now[:, 4:]
    e = q - exact.alpha @ _delayed(exact, at)[:, 0, :2]
    r = qd + exact.Lambda * e
    v = np.einsum("ki,kij,kj->", r, inertia(exact.theta, q), r)
    v += ((estimate - exact.theta) ** 2 / exact.Gamma).sum() + (exact.Lambda * exact.Kd * e**2).sum()

    def moving(times: np.ndarray) -> np.ndarray:
        speeds = np.stack([exact.past(s)[:, 2:4] for s in times], axis=1)
        return np.einsum("ij,jt->t", exact.alpha, (exact.Kd * speeds**2).sum(-1))

    return 0.5 * (v + _gauss(moving, t - exact.delay_s, t, PANELS))


def _exact_integrals(exact: DelayEquations, t: float) -> tuple[float, float]:
    def powers(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        now, then = np.stack([exact.past(s) for s in times], axis=1), _delayed(exact, times)
        qd = now[..., 2:4]
        e = now[..., :2] - np.einsum("ij,jtn->itn", exact.alpha, then[..., :2])
        r = qd + exact.Lambda * e
        apart = (exact.Kd * (qd[:, np.newaxis] - then[np.newaxis, ..., 2:4]) ** 2).sum(-1)
        lost = (exact.Kp * r**2).sum((0, 2)) + 0.5 * np.einsum("ij,ijt->t", exact.alpha, apart)
        pushed = np.stack([exact.hands(s) for s in times], axis=1)
        return lost, (r * pushed).sum((0, 2))

    return tuple(_gauss(lambda s, n=n: powers(s)[n], 0.0, t, PANELS) for n in (0, 1))  # type: ignore[return-value]


def test_a_closed_group_is_balanced_by_itself() -> None:
    """m1 and m2 follow each other alone; s follows both and has no part in their balance."""
    pair = {"dominance.m1.m2": 1.0, "dominance.m1.s": 0.0, "dominance.m2.m1": 1.0, "dominance.m2.s": 0.0}
    energies = runs.run("free", {**pair, "duration_s": 1.5, "rate_hz": 500}).energies
    group = compute_energy_balance({site: energies[site] for site in ("m1", "m2")})
    assert group.beta == pytest.approx(np.ones((len(group.t_s), 2)))
    assert runs.relative(group) <= 1e-4
    assert group.transfer == pytest.approx(np.zeros(len(group.t_s)), abs=1e-9 * group.scale)

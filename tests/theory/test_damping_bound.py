"""Errata 13: the damping that P+d needs for N sites, against roots that are counted independently."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from trilat_studies.sweep.stability_criteria import StabilityCriterion

from tests.theory.networks import Network, Wire
from tests.theory.position_networks import compute_rod_inertia, count_growing, position_network
from trilat_net.analysis.judge import list_law_proofs
from trilat_net.analysis.theory import LinearAnalysis
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.core.links.dominance import DominanceMatrix
from trilat_net.laws.conditions import COMMON_MOTION_SHARE, LawSituation, StabilityCondition
from trilat_net.scenario import load_scenario

LAB = [[0.0, 0.1, 0.9], [0.8, 0.0, 0.2], [0.8, 0.2, 0.0]]
"""The lab sheet's first exercise: 0.1 0.2 0.8 = 0.016 along the circle, 0.9 0.2 0.8 = 0.144 back."""
RING = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
POSE = (-0.1, 0.4)
MANY_TICKS = 20
"""From so many ticks of delay on, the worst mass is that of continuous time."""


def make_equal_shares(count: int) -> Any:
    """Returns equal shares."""
    return (np.ones((count, count)) - np.eye(count)) / (count - 1)


def draw_shares(rng: np.random.Generator, count: int, *, reversible: bool) -> Any:
    """Returns random shares; reversible ones from weights that are the same both ways."""
    weights = rng.uniform(0.0, 1.0, (count, count)) ** 2 * (1.0 - np.eye(count))
    weights = weights + weights.T if reversible else weights
    return weights / weights.sum(axis=1, keepdims=True)


def test_balanced_shares_are_reversible() -> None:
    """Kolmogorov's criterion for three sites, and weights that make D alpha symmetric for any number."""
    rng = np.random.default_rng(1)
    for count in (2, 3, 5, 8):
        alpha = draw_shares(rng, count, reversible=True)
        D = DominanceMatrix(alpha).find_balancing_weights()
        assert D is not None
        np.testing.assert_allclose(D[:, None] * alpha, (D[:, None] * alpha).T, rtol=1e-12)
        assert np.abs(np.linalg.eigvals(alpha).imag).max() < 1e-9
        assert (
            count == 2
            or DominanceMatrix(
                draw_shares(rng, count, reversible=False)
            ).find_balancing_weights()
            is None
        )
    assert DominanceMatrix(np.array(LAB)).find_balancing_weights() is None
    assert DominanceMatrix(np.array(RING)).find_balancing_weights() is None
    # nobody follows the third
    follower = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.3, 0.7, 0.0]])
    assert DominanceMatrix(follower).find_balancing_weights() is not None


def test_common_motion_determines_the_worst_mass() -> None:
    """-min sin x / x is at tan x = x; there m w^2 = K (1 - cos x): m = 1.2172 K T^2 / 20.19."""
    x = float(sp.nsolve(sp.tan(sp.Symbol("x")) - sp.Symbol("x"), 4.5))
    assert pytest.approx(-np.sin(x) / x, abs=1e-10) == COMMON_MOTION_SHARE
    assert (1.0 - np.cos(x), x * x) == (
        pytest.approx(1.2172, abs=1e-4),
        pytest.approx(20.19, abs=0.005),
    )


@pytest.mark.parametrize(
    ("alpha", "masses", "delay_ms", "d", "growth_per_s"),
    [(LAB, (1.0, 0.5, 0.667), 20.0, 0.25, 0.127), (RING, (1.0, 1.0, 1.0), 200.0, 4.0, 0.134)],
    ids=["lab sheet", "one way"],
)
def test_irreversible_shares_have_no_bound(
    alpha: Any, masses: Any, delay_ms: float, d: float, growth_per_s: float
) -> None:
    """d is above abs(lambda_min) K T for the first; the second has lambda = exp(2 pi j / 3)."""
    scenario = position_network(alpha, d=d, delay_ms=delay_ms, masses=masses)
    assert d > 10.0 * delay_ms / 1e3 * abs(np.linalg.eigvals(alpha).real.min()) * (1.0 + 1e-9)
    assert StabilityCriterion.evaluate(scenario) is None
    rightmost = LinearAnalysis.compute(scenario, pose=POSE).decisive.rightmost
    assert rightmost is not None
    assert rightmost.s.real == pytest.approx(growth_per_s, abs=1e-3)
    assert (
        count_growing(
            alpha, [compute_rod_inertia(m, POSE[1]) for m in masses], 10.0, d, round(delay_ms)
        )
        > 0
    )


def test_seven_equal_shares_exceed_their_eigenvalue() -> None:
    """K T = 2, d = 0.36: 1/6 of it is 0.333, 0.2172 of it 0.434."""
    lacking, enough = (
        StabilityCriterion.evaluate(position_network(make_equal_shares(7), d=d))
        for d in (0.36, 0.44)
    )
    assert lacking is not None
    assert enough is not None
    assert lacking.excess < 0.0 < enough.excess
    worst = [np.eye(1) * 1.2172 * 10.0 * 0.2**2 / 20.19] * 7
    below, above = (
        count_growing(make_equal_shares(7), worst, 10.0, d, 200) for d in (0.36, 0.44)
    )
    assert below > 0 == above


def check_sharpness(alpha: Any, K: float, ticks: int) -> None:
    """Asserts that some mass grows with 2 % less than the criterion asks, and does not with 2 %
    more.

    Heavy arms where abs(lambda_min) is 0.2172 and more, m = 1.2172 K T^2 / 20.19 below.
    """
    criterion = StabilityCriterion.evaluate(
        position_network(alpha, K=K, d=0.0, delay_ms=float(ticks))
    )
    assert criterion is not None
    # of two sites 2 sqrt(d1 d2) - ...
    line = -criterion.excess / (2.0 if len(alpha) == 2 else 1.0)
    modes = np.linalg.eigvals(alpha).real  # of equal arms each is a loop of its own
    least = -modes.min()
    mass = 60.0 if least >= COMMON_MOTION_SHARE else 1.2172 / 20.19
    worst = [np.eye(1) * mass * K * (ticks * 1e-3) ** 2]
    assert line == pytest.approx(max(least, COMMON_MOTION_SHARE) * K * ticks * 1e-3, rel=1e-3)
    below, above = (
        sum(count_growing([[a]], worst, K, share * line, ticks) for a in modes)
        for share in (0.98, 1.02)
    )
    assert below > 0 == above


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("seed", range(8))
def test_the_bound_is_the_worst_masss_edge(count: int, seed: int) -> None:
    rng = np.random.default_rng(100 * count + seed)
    alpha = draw_shares(rng, count, reversible=True) if seed else make_equal_shares(count)
    check_sharpness(alpha, rng.uniform(2.0, 50.0), int(rng.integers(20, 800)))


@pytest.mark.parametrize("ticks", [1, 2, 3])
def test_few_ticks_give_the_computed_edge(ticks: int) -> None:
    """Errata 13: 0.667 K h for one tick, and any masses above d h."""
    criterion = StabilityCriterion.evaluate(
        position_network(make_equal_shares(3), d=0.0, delay_ms=float(ticks))
    )
    assert criterion is not None
    assert -criterion.excess == pytest.approx(10.0e-3 * max(0.6667, 0.5 * ticks), rel=1e-3)

    def growing(d: float) -> int:
        masses = np.geomspace(1.0001 * d * 1e-3, 3e-3 * ticks**2, 40)
        modes = [(m, a) for m in masses for a in (-0.5, 1.0)]
        return sum(
            count_growing([[a]], [np.eye(1) * m], 10.0, d, ticks, 1e-4) for m, a in modes
        )

    assert growing(-0.98 * criterion.excess) > 0 == growing(-1.02 * criterion.excess)


def pair_with_error_damping(d: Any, Kd: Any, masses: Any, K: Any = (10.0, 10.0)) -> Any:
    """Returns the rightmost root of two sites under PD+d, 200 ms apart."""
    wires = (Wire(0, 1, K[0], Kd[0], 0.2), Wire(1, 0, K[1], Kd[1], 0.2))
    spectrum = Spectrum.of_loop(Network(tuple(masses), tuple(d), (0.0, 0.0), wires).loop, 1)
    return spectrum.rightmost


def test_pd_d_of_one_ratio_keeps_the_bound() -> None:
    rng = np.random.default_rng(5)
    for _ in range(60):
        K = 10.0 ** rng.uniform(0.0, 2.0, 2)
        first = 10.0 ** rng.uniform(-1.0, 1.0)
        d = (first, 1.02 * 0.2**2 * K[0] * K[1] / first)
        root = pair_with_error_damping(
            d, K * 10.0 ** rng.uniform(-2.0, 1.5), 10.0 ** rng.uniform(-1.5, 2.5, 2), K
        )
        assert root is None or root.s.real < 1e-9


def test_pd_d_of_other_ratios_grows_above() -> None:
    assert 4.0 * 11.8 * 0.356 > (2.0 * 0.2 * 10.0) ** 2
    root = pair_with_error_damping((11.8, 0.356), (307.0, 0.0), (0.58, 0.17))
    assert root.s.real == pytest.approx(0.55, abs=0.01)


def check_network(rng: np.random.Generator, *, sharp: bool) -> bool | None:
    """Asserts that a random network with damping to spare has no growing root; returns whether
    it had some.

    None if the criterion does not apply. On request it also asserts that the criterion is
    sharp.
    """
    count = int(rng.integers(2, 9))
    alpha = draw_shares(rng, count, reversible=bool(rng.integers(2)))
    ticks = int(rng.integers(0, 1001))
    K = float(10.0 ** rng.uniform(0.0, 1.5))
    need = (
        K
        * max(ticks, 1)
        * 1e-3
        * max(-np.linalg.eigvals(alpha).real.min(), COMMON_MOTION_SHARE)
    )
    d: Any = need * rng.uniform(0.8, 1.3)
    K_all: Any = K
    if count == 2:  # of two sites gains may differ
        K_all = K * rng.uniform(0.5, 2.0, 2)
        d = d * rng.uniform(0.5, 2.0, 2)
    masses = 10.0 ** rng.uniform(-0.5, 0.5, count)
    criterion = StabilityCriterion.evaluate(
        position_network(alpha, K_all, d, float(ticks), masses)
    )
    if criterion is None:
        return None
    if sharp and ticks >= MANY_TICKS:
        check_sharpness(alpha, K, ticks)
    inertias = [
        compute_rod_inertia(mass, q2)
        for mass, q2 in zip(masses, rng.uniform(-3.1, 3.1, count), strict=True)
    ]
    if criterion.excess > 0.0:
        assert count_growing(alpha, inertias, K_all, d, max(ticks, 1)) == 0
    return criterion.excess > 0.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "sharp"),
    [(0, False), *(pytest.param(n, True, marks=pytest.mark.long) for n in range(8))],
)
def test_the_bound_never_accepts_growth(seed: int, *, sharp: bool) -> None:
    """250 networks a seed: 2 to 8 sites, any shares, masses over a decade, delays to 1 s."""
    rng = np.random.default_rng(seed)
    outcomes = [check_network(rng, sharp=sharp) for _ in range(250)]
    assert outcomes.count(True) > 40
    assert outcomes.count(False) > 40
    assert outcomes.count(None) > 40


K_PAIR = 50.0
TICK_S = 1.0 / 30.0


def judge_equal_sites(count: int, ticks: int, d: float) -> StabilityCondition:
    """Returns the condition of equal sites at 30 Hz whose torques are held."""
    laws = (SimpleNamespace(K=(K_PAIR,), d=(d,)),) * count
    names = tuple(map(str, range(count)))
    delay_s = ticks * TICK_S * (make_equal_shares(count) > 0.0)
    situation = LawSituation(
        0, names, laws, make_equal_shares(count), delay_s, (1e3,), 30, hold_s=TICK_S
    )
    condition = situation.judge_position_exchange("d")
    assert condition is not None
    return condition


@pytest.mark.parametrize("law", ["p_d", "pd_d", "lee_spong", "saturated_pd", "authority"])
def test_springs_need_exact_gravity_everywhere(law: str) -> None:
    """A site that compensates 0.9 of gravity has no condition, and its peer an undecided one."""
    control = {"law": law, "leads": True} if law == "authority" else {"law": law}
    settings = {"link.delay_ms": 5.0, "sites.s.control": control}
    alike = load_scenario("two_sites", {**settings, "sites.m.control": control})
    lighter = {**control, "gravity": 0.9}
    unlike = load_scenario("two_sites", {**settings, "sites.m.control": lighter})
    (line,) = alike.describe_law_conditions()
    assert line.startswith(f"condition of {law} at m, s holds")
    (line,) = unlike.describe_law_conditions()
    assert line.startswith(f"condition of {law} at s is undecided: known for gravity = 1")


def compute_growth(count: int, ticks: int, d: float, mass: float) -> float:
    """Returns the rate, 1/s, of the loop from tick to tick, mode by mode of equal shares: x,
    its speed, x before.
    """
    rates = []
    for share in (1.0, -1.0 / (count - 1)):
        row = np.zeros(2 + ticks)
        row[:2] = (-K_PAIR, -d)
        row[-1] += K_PAIR * share
        step = np.eye(2 + ticks, k=-1)
        step[:2] = 0.0
        step[0, :2] = (1.0, TICK_S)
        step[1, 1] = 1.0
        step[2, 0] = 1.0
        step[2, 1] = 0.0
        step[:2] += np.outer([0.5 * TICK_S**2 / mass, TICK_S / mass], row)
        z = np.linalg.eigvals(step)
        others = np.delete(z, np.abs(z - 1.0).argmin()) if share == 1.0 else z
        rates.append(np.log(np.abs(others).max()) / TICK_S)
    return float(max(rates))


def test_held_torques_need_more_than_continuous_time() -> None:
    """K 50, d 2 at 30 Hz over a tick: 1.667 would suffice in continuous time."""
    assert judge_equal_sites(2, 1, 3.33).holds is False
    assert judge_equal_sites(2, 1, 3.34).holds
    assert compute_growth(2, 1, 2.0, 1.0) == pytest.approx(0.595, abs=5e-3)
    assert judge_equal_sites(2, 1, 2.0).holds is False


@pytest.mark.parametrize("count", [2, 3, 5, 7])
@pytest.mark.parametrize("ticks", [1, 2, 3, 20])
def test_held_torques_bound_the_worst_mass(count: int, ticks: int) -> None:
    """Above it no arm heavier than d h / 2 grows; 3 % below it some arm does."""
    text = judge_equal_sites(count, ticks, 1e3).text
    sides = (
        K_PAIR * TICK_S * (ticks + 1) if count == 2 else float(text.split(" = ")[1].split()[0])
    )
    for d, grows in ((0.97 * sides, True), (1.01 * sides, False)):
        assert judge_equal_sites(count, ticks, d).holds is not grows
        masses = np.concatenate(
            [0.5 * d * TICK_S * (1.0 + np.logspace(-4, 1, 300)), np.logspace(-1, 4, 300)]
        )
        most = max(
            compute_growth(count, ticks, d, float(m)) for m in masses if m > 0.5 * d * TICK_S
        )
        assert (most > 0.0) is grows


def slopes_of_tanh(poses: Any, K: float, P: float) -> Any:
    """Returns the slopes of P tanh(K e / P) between sites that are held at some poses."""
    return K / np.cosh(K * (poses[:, None] - poses) / P) ** 2


def test_slopes_of_tanh_obey_p_d_bounds() -> None:
    """Errata 13: positive semidefinite, and by Schur's theorem lambda_min K <= S o kappa <= K."""
    rng = np.random.default_rng(13)
    for count in (2, 3, 4, 6):
        for _ in range(50):
            alpha = draw_shares(rng, count, reversible=True)
            D = DominanceMatrix(alpha).find_balancing_weights()
            assert D is not None
            S = np.sqrt(D)[:, None] * alpha / np.sqrt(D)
            poses = rng.normal(0.0, rng.uniform(0.01, 3.0), count)
            kappa = slopes_of_tanh(poses, 10.0, rng.uniform(0.5, 20.0))
            assert np.linalg.eigvalsh(kappa).min() > -1e-12
            product = np.linalg.eigvalsh(S * kappa)
            assert product.min() >= 10.0 * np.linalg.eigvalsh(S).min() - 1e-12
            assert product.max() <= 10.0 + 1e-12


def make_sloped_network(slopes: Any, d: float) -> Network:
    """Returns three heavy sites of equal shares, whose pulls have these slopes; T = 100 ms."""
    wires = tuple(
        Wire(i, j, 0.5 * slopes[i][j], 0.0, 0.1) for i in range(3) for j in range(3) if i != j
    )
    return Network((5.0,) * 3, (d,) * 3, (0.0,) * 3, wires)


def test_slopes_up_to_k_do_not_suffice() -> None:
    """Errata 13: d = 0.6 K T is above 0.5 K T; (K, K, 0) grows, and slopes that tanh can have do not."""
    K = 10.0
    chain = K * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
    least = np.linalg.eigvalsh(0.5 * (chain - K * np.eye(3))).min()
    assert least == pytest.approx(-0.7071 * K, abs=1e-3)
    assert np.linalg.eigvalsh(chain).min() < -0.4 * K  # so no tanh has these slopes
    assert (
        Spectrum.of_loop(make_sloped_network(chain, 0.6 * K * 0.1).loop, 1).verdict
        == "unstable"
    )
    for poses in ([0.0, 0.0, 0.0], [0.0, 0.3, 0.6], [0.0, 0.1, 1.0]):
        slopes = slopes_of_tanh(np.array(poses), K, 5.0)
        spectrum = Spectrum.of_loop(make_sloped_network(slopes, 0.6 * K * 0.1).loop, 2)
        assert spectrum.verdict != "unstable"


def test_springs_between_end_effectors_have_no_known_bound() -> None:
    """The stiffness belongs to x, y and z, but the damping to the joints."""
    scenario = load_scenario(
        "two_sites",
        {
            "control": {"law": "p_d", "K": 12.0, "d": 4.0},
            "task": {"space": "position", "axes": ["x", "y"]},
            "sites.m.q0_rad": [0.2, 1.4],
            "sites.s.q0_rad": [0.3, 1.3],
        },
    )
    (condition,) = scenario.describe_law_conditions()
    assert "is undecided: known only for joints that follow joints" in condition
    assert list_law_proofs(scenario) == []

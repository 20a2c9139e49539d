"""A sampled wall: the map from tick to tick in contact, the bound of passivity, and what runs do."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from trilat_studies.record_batches import WholeRun
from trilat_studies.sweep.sweep_cell import CellClass, classify_cell

from tests.core.chain_references import Array, ChainState, chain_references
from trilat_net.analysis.run_end import Stability
from trilat_net.analysis.theory import iterate_linear_edges
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.linear_edge import LinearEdge, find_contact_growth
from trilat_net.scenario import Scenario, load_scenario

ENVIRONMENT = "sites.s.environment"
STIFFNESS = f"{ENVIRONMENT}.0.stiffness_n_m"
WALL = {
    "kind": "wall",
    "point_m": [1.3376933693863516, 0.0],
    "normal": [-1.0, 0.0],
    "sampled": True,
}


def make_windup_scenario(K: float, B: float = 0.0, b: float = 0.0) -> Scenario:
    """Returns `windup` at a sampled wall, whose arm has a damper in every joint."""
    wall = {**WALL, "stiffness_n_m": K, "damping_n_s_m": B}
    damper = {"kind": "viscous", "damping_nm_s_rad": b}
    return load_scenario("windup", {ENVIRONMENT: [wall, damper]})


@cache
def find_edge(B: float = 0.0, b: float = 0.0) -> LinearEdge | None:
    scenario = make_windup_scenario(5000.0, B, b)
    rest = find_equilibrium(scenario)
    return next(iterate_linear_edges(scenario, STIFFNESS, 1e3, 2e5, rest, points=12), None)


@pytest.mark.long
def test_the_map_in_contact_has_its_edge() -> None:
    edge_found = find_edge()
    assert edge_found is not None
    assert edge_found.value == pytest.approx(15.5e3, rel=0.005)
    assert not edge_found.stable_above


@pytest.mark.long
@pytest.mark.parametrize(
    ("B", "b"),
    [
        (0.0, 5.0),
        (2.0, 10.0),
        (5.0, 10.0),
        (0.0, 20.0),
    ],
)
def test_the_bound_of_passivity_is_never_above_it(B: float, b: float) -> None:
    """b > K h / 2 + B with b = 1 / (n'J D^-1 J'n) where the arm rests."""
    q1, q2 = find_equilibrium(make_windup_scenario(5000.0, B, b)).q[2]
    J = np.array([-np.sin(q1) - np.sin(q1 + q2), -np.sin(q1 + q2)])
    damper_damping = b / float(J @ J)
    bound = 2.0 * 1000.0 * (damper_damping - B)
    edge_found = find_edge(B, b)
    assert edge_found is None or edge_found.value > bound > 0.0


def classify_stiffness(K: float) -> CellClass:
    """Returns the class of a sweep's cell, which counts growth in contact by the same map."""
    return classify_cell(make_windup_scenario(K).text, 480.0).verdict


def end_alone(K: float) -> Stability:
    """Returns the class by the motion of the run alone."""
    return WholeRun.simulate(make_windup_scenario(K)).end.stability


@pytest.mark.long
def test_runs_have_the_edge_of_the_map() -> None:
    """Stable 5 % below the edge, and not 5 % above, which shows without the map too."""
    edge_found = find_edge()
    assert edge_found is not None
    assert classify_stiffness(0.95 * edge_found.value) is CellClass.CONVERGED
    assert classify_stiffness(1.05 * edge_found.value) is not CellClass.CONVERGED
    assert end_alone(0.95 * edge_found.value) is Stability.SETTLED
    assert end_alone(1.05 * edge_found.value) is Stability.NOT_STABLE


@pytest.mark.long
def test_the_sweep_over_stiffness_is_monotone() -> None:
    """1 to 40 kN/m: stable up to 15, and from 16 on never."""
    for stable in (
        [classify_stiffness(1e3 * K) is CellClass.CONVERGED for K in range(1, 41)],
        [end_alone(1e3 * K) is Stability.SETTLED for K in range(1, 41)],
    ):
        assert stable == [K <= 15 for K in range(1, 41)]


H_S = 1e-3
DELAY_TICKS = 5
FORCE_N = 20.0
STIFF = np.array([60.0, 60.0, 60.0, 12.0, 12.0, 12.0])
DAMPING = np.array([6.0, 6.0, 6.0, 0.7, 0.7, 0.7])
HAND_NM_RAD = 40.0
DRIVES = np.array([0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
NORMAL = np.array([0.6, -0.3, 0.74])
NORMAL /= np.linalg.norm(NORMAL)


def make_pressed_scenario(state: ChainState, K: float) -> Scenario:
    """Returns two arms of six joints: the hand of s presses it against a sampled wall of any direction."""
    q = state.q.tolist()
    to = state.q - state.jacobian[:3].T @ NORMAL * (FORCE_N / HAND_NM_RAD)
    wall = {"kind": "wall", "sampled": True, "normal": NORMAL.tolist(), "stiffness_n_m": K}
    return load_scenario(
        "two_sites",
        {
            "scheme": "digital",
            "expect": {},
            "arm": {
                "urdf": "arm6.urdf",
                "g_m_s2": 0.0,
                "stops": False,
                "armature_kg_m2": DRIVES.tolist(),
            },
            "control": {
                "law": "p_d",
                "K": STIFF.tolist(),
                "d": DAMPING.tolist(),
                "gravity": 0.0,
            },
            "link": {"model": "constant", "delay_ms": 1e3 * H_S * DELAY_TICKS},
            "sites.m": {"role": "master", "q0_rad": q},
            "sites.s": {
                "role": "slave",
                "q0_rad": q,
                "hands": [
                    {"kind": "spring", "to_rad": to.tolist(), "stiffness_nm_rad": HAND_NM_RAD}
                ],
                "environment": [
                    {**wall, "point_m": (state.tip_position + FORCE_N / K * NORMAL).tolist()}
                ],
            },
        },
    )


def wall_stiffness(state: ChainState, K: float) -> Array:
    """Returns the fall of the wall's torque with the angles: J'n K n'J, and the turning of J
    under its force.

    The column of J of joint i turns with joint j: by w_j x J_i where j comes first, else by w_i
    x J_j.
    """
    linear = state.jacobian[:3]
    angular = state.jacobian[3:]
    turning = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            first = min(i, j)
            last = max(i, j)
            turning[i, j] = NORMAL @ np.cross(angular[:, first], linear[:, last])
    along = linear.T @ NORMAL
    return K * np.outer(along, along) - FORCE_N * turning


def growth_of_ticks(state: ChainState, K: float) -> float:
    """Returns the rate of the largest eigenvalue of a tick's map, of Pinocchio's M and J: its
    hand acts at any time, both laws and the wall are held, and each arm uses the other's pose
    of `DELAY_TICKS` ago.
    """
    none = np.zeros((6, 6))
    identity = np.eye(6)
    inverse = np.linalg.inv(state.inertia + np.diag(DRIVES))
    step: dict[str, tuple[Array, Array]] = {}
    for site, hand in (("m", 0.0), ("s", HAND_NM_RAD)):
        rates = np.block(
            [[none, identity, none], [-hand * inverse, none, inverse], [none, none, none]]
        )
        exponential = expm(H_S * rates)
        step[site] = exponential[:12, :12], exponential[:12, 12:]
    size = 24 + 12 * DELAY_TICKS  # m, s, then (q_m, q_s) of the ticks before, latest first
    A = np.zeros((size, size))
    law = np.hstack([-np.diag(STIFF), -np.diag(DAMPING)])
    oldest = size - 12
    for n, (site, wall) in enumerate((("m", none), ("s", wall_stiffness(state, K)))):
        free, pushed = step[site]
        own_rows = slice(12 * n, 12 * n + 12)
        A[own_rows, own_rows] = free + pushed @ (law - np.hstack([wall, none]))
        peer = oldest + 6 * (1 - n)
        A[own_rows, peer : peer + 6] = pushed @ np.diag(STIFF)
        A[24 + 6 * n : 30 + 6 * n, 12 * n : 12 * n + 6] = identity
    A[36:, 24:-12] = np.eye(12 * (DELAY_TICKS - 1))
    return float(np.log(np.abs(np.linalg.eigvals(A)).max()) / H_S)


@pytest.mark.parametrize("n", range(3))
def test_six_joints_in_contact_grow_like_pinocchios_arm(n: int) -> None:
    """The walls in space are soft or hard; the deepest of several states counts, and without contact none does."""
    state = chain_references()["arm6"].states[n]
    signs = set()
    for K in (1e4, 1e6):
        scenario = make_pressed_scenario(state, K)
        at = np.tile(state.q, (2, 1))
        theta = np.zeros((3, 2, 60))
        away_m = at + np.linalg.pinv(state.jacobian[:3]) @ (2.0 * FORCE_N / K * NORMAL)
        wanted = growth_of_ticks(state, K)
        assert find_contact_growth(
            scenario, np.stack([away_m, at, away_m]), theta
        ) == pytest.approx(wanted, rel=1e-5)
        assert np.isnan(find_contact_growth(scenario, away_m[None], theta[:1]))
        signs.add(wanted > 0.0)
    assert signs == {True, False}

"""A sampled wall: the map from tick to tick in contact, the bound of passivity, and what runs do."""

from functools import cache

import numpy as np
import pytest

from tests.certificate.adversaries import RunInMemory
from trilat_net.analysis.run_end import Stability
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.studies.sweep.cell_result import CellClass, classify_cell
from trilat_net.theory import find_linear_edge
from trilat_net.theory.equilibrium import find_equilibrium
from trilat_net.theory.linear_edge import LinearEdge

ENVIRONMENT = "sites.s.environment"
STIFFNESS = f"{ENVIRONMENT}.0.stiffness_n_m"
WALL = {"kind": "wall", "point_m": [1.3376933693863516, 0.0], "normal": [-1.0, 0.0], "sampled": True}


def windup(K: float, B: float = 0.0, b: float = 0.0) -> Scenario:
    """`windup` at a sampled wall, whose arm has a damper in every joint."""
    wall = {**WALL, "stiffness_n_m": K, "damping_n_s_m": B}
    damper = {"kind": "viscous", "damping_nm_s_rad": b}
    return load_scenario("windup", {ENVIRONMENT: [wall, damper]})


@cache
def edge(B: float = 0.0, b: float = 0.0) -> LinearEdge | None:
    scenario = windup(5000.0, B, b)
    rest = find_equilibrium(scenario)
    return find_linear_edge(scenario, STIFFNESS, 1e3, 2e5, rest, points=12)


def test_the_map_in_contact_has_its_edge() -> None:
    found = edge()
    assert found is not None
    assert found.value == pytest.approx(15.5e3, rel=0.005)
    assert not found.stable_above


@pytest.mark.parametrize(
    ("B", "b"),
    [
        (0.0, 5.0),
        (2.0, 10.0),
        pytest.param(5.0, 10.0, marks=pytest.mark.long),
        pytest.param(0.0, 20.0, marks=pytest.mark.long),
    ],
)
def test_the_bound_of_passivity_is_never_above_it(B: float, b: float) -> None:
    """b > K h / 2 + B with b = 1 / (n'J D^-1 J'n) where the arm rests."""
    q1, q2 = find_equilibrium(windup(5000.0, B, b)).q[2]
    J = np.array([-np.sin(q1) - np.sin(q1 + q2), -np.sin(q1 + q2)])
    own = b / float(J @ J)
    bound = 2.0 * 1000.0 * (own - B)
    found = edge(B, b)
    assert found is None or found.value > bound > 0.0


def say(K: float) -> CellClass:
    """The class of a sweep's cell: it counts growth in contact, by the same map."""
    return classify_cell(windup(K).text, 480.0).verdict


def end_alone(K: float) -> Stability:
    """What the motion of the run shows by itself."""
    return RunInMemory(windup(K)).find_end().stability


def test_runs_have_the_edge_of_the_map() -> None:
    """Stable 5 % below it, and not 5 % above, which shows without the map too."""
    found = edge()
    assert found is not None
    assert say(0.95 * found.value) is CellClass.CONVERGED
    assert say(1.05 * found.value) is not CellClass.CONVERGED
    assert end_alone(0.95 * found.value) is Stability.STABLE
    assert end_alone(1.05 * found.value) is Stability.NOT_STABLE


@pytest.mark.long
def test_the_sweep_over_stiffness_is_monotone() -> None:
    """1 to 40 kN/m: stable up to 15, and from 16 on never."""
    for stable in (
        [say(1e3 * K) is CellClass.CONVERGED for K in range(1, 41)],
        [end_alone(1e3 * K) is Stability.STABLE for K in range(1, 41)],
    ):
        assert stable == [K <= 15 for K in range(1, 41)]

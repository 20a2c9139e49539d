"""Ports against runs: a small sinusoidal torque in virtual time, and the resulting velocities."""

from typing import Any

import numpy as np
import pytest

from tests.execution.builders import make_trajectories
from tests.theory.networks import Array, Complex, hold_by_spring
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.analysis.theory.port_analysis import linearise_teleoperator
from trilat_net.analysis.theory.port_response import build_admittance
from trilat_net.scenario import load_scenario

POSE = (-0.6, 1.8)
AMPLITUDE_NM = 0.02
THETA = [5 / 3, 0.5, 1 / 3, 1.5, 0.5]
"""Of uniform rods."""
ROD = {"lc1_m": 0.5, "I1_kg_m2": 1 / 12, "lc2_m": 0.5, "I2_kg_m2": 1 / 12}


def fit_sine(t_s: Array, values: Array, w_rad_s: float) -> Complex:
    """Returns the complex amplitude of sin(w t) in columns, beside a straight line."""
    columns = np.column_stack(
        [np.sin(w_rad_s * t_s), np.cos(w_rad_s * t_s), np.ones_like(t_s), t_s]
    )
    solution = np.linalg.lstsq(columns, values, rcond=None)[0]
    return np.asarray(solution[0] + 1j * solution[1], dtype=np.complex128)


def measure_admittance(
    name: str,
    overrides: dict[str, Any],
    joint: int,
    hz: float,
    settled_s: float,
    duration_s: float,
) -> Complex:
    """Returns velocities of all joints per torque on one joint of m, by a run."""
    t_s = np.arange(0.0, duration_s + 1.0, 1e-3)
    push = np.zeros((len(t_s), 3))
    push[:, 0] = t_s
    push[:, joint] = AMPLITUDE_NM * np.sin(2.0 * np.pi * hz * t_s)
    torque = {"kind": "recorded", "points": push.tolist()}
    hands = [*overrides.get("sites.m.hands", []), torque]
    run = make_trajectories(
        load_scenario(name, {**overrides, "sites.m.hands": hands, "duration_s": duration_s})
    )
    late = run.sites["m"].t_s >= settled_s
    velocities = np.hstack([site.qd[late] for site in run.sites.values()])
    return fit_sine(run.sites["m"].t_s[late], velocities, 2.0 * np.pi * hz) / AMPLITUDE_NM


@pytest.mark.parametrize("joint", [1, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.parametrize("hz", [pytest.param(0.5, marks=pytest.mark.long), 2.0])
def test_p_d_answers_sinusoids_by_its_admittance(hz: float, joint: int) -> None:
    overrides = {"control.d": 4.0, "sites.m.q0_rad": POSE, "sites.s.q0_rad": POSE}
    scenario = load_scenario("p_d_margin_two", overrides)
    Y = build_admittance(
        linearise_teleoperator(
            OperatingConditions.derive(scenario), find_equilibrium(scenario, POSE)
        )
    )(np.array([2.0 * np.pi * hz]))[0]
    admittance = measure_admittance("p_d_margin_two", overrides, joint, hz, 12.0, 16.0)
    assert np.abs(admittance - Y[:, joint - 1]).max() < 0.01 * np.abs(Y[:, joint - 1]).max()
    assert (np.abs(admittance - Y[:, joint - 1]) < 0.01 * np.abs(Y[:, joint - 1])).all()


@pytest.mark.parametrize("hz", [pytest.param(0.5, marks=pytest.mark.long), 2.0])
def test_paper_law_answers_by_its_admittance(hz: float) -> None:
    """Rods with known parameters, a hand that holds m: learning, delay and the hand's spring
    are included.
    """
    hand = {
        "kind": "spring",
        "from_rad": POSE,
        "stiffness_nm_rad": 20.0,
        "damping_nm_s_rad": 3.0,
    }
    overrides: dict[str, Any] = {f"arm.{key}": value for key, value in ROD.items()}
    overrides |= {
        "control.theta_hat0": THETA,
        "control.Kp": 3.0,
        "sites.m.q0_rad": POSE,
        "sites.s.q0_rad": POSE,
    }
    scenario = load_scenario(
        "two_sites", {**overrides, "sites.m.hands": [], "sites.s.hands": []}
    )
    bare = linearise_teleoperator(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, POSE)
    )
    Y = build_admittance(hold_by_spring(bare, "m", 20.0, 3.0))(np.array([2.0 * np.pi * hz]))[0]
    admittance = measure_admittance(
        "two_sites", {**overrides, "sites.m.hands": [hand]}, 1, hz, 20.0, 26.0
    )
    assert (np.abs(admittance - Y[:, 0]) < 0.01 * np.abs(Y[:, 0])).all()

"""Adaptive synchronisation of qd + Lambda q: agreement without gravity, collapse to q = 0 or hanging with it."""

from typing import Any

import numpy as np
import pytest

from tests.unit_arm import make_unit_scenario, read_last_rows
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario

PENDULUM = {
    "l1_m": 1.0,
    "m1_kg": 1.0,
    "lc1_m": 1.0,
    "I1_kg_m2": 1e-9,
    "l2_m": 1.0,
    "m2_kg": 1e-12,
    "lc2_m": 1e-9,
    "I2_kg_m2": 1e-6,
}
"""Joint 1 is a pendulum of 1 kg m^2 and 1 kg m; joint 2 weighs nothing."""
GAINS: dict[str, dict[str, Any]] = {
    "sync": {"law": "sync", "K": [3.0, 3e-6]},
    "adaptive": {"law": "adaptive", "Kp": [1.0, 1e-6], "Kd": [3.0, 3e-6]},
}


HANGING_STARTS = ((-1.65, 0.0), (-1.8, 0.1), (-1.45, 0.0))


def make_pendulum_scenario(law: str, starts: tuple[float, ...], gravity: float) -> Scenario:
    names = "abc"[: len(starts)]
    share = 1.0 / (len(starts) - 1)
    return make_unit_scenario(
        {name: {"q0_rad": [start, 0.0]} for name, start in zip(names, starts, strict=True)},
        {**GAINS[law], "Lambda": 1.0, "Gamma": [1.0, 0.0, 0.0, 1.0, 0.0]},
        dominance={name: {peer: share for peer in names if peer != name} for name in names},
        arm={**PENDULUM, "g_m_s2": gravity},
        rate_hz=2000,
        duration_s=200.0,
    )


def find_final_angles(
    law: str, starts: tuple[float, ...], gravity: float, *times_s: float
) -> list[Any]:
    return [
        row["q"][:, 0]
        for row in read_last_rows(make_pendulum_scenario(law, starts, gravity), *times_s)
    ]


@pytest.mark.parametrize(
    "starts", [(0.6, -0.5), pytest.param((1.0, 0.4), marks=pytest.mark.long), (0.6, -0.5, 0.1)]
)
def test_under_gravity_any_start_ends_at_zero(starts: tuple[float, ...]) -> None:
    scenario = make_pendulum_scenario("sync", starts, 9.81)
    first, last = (row["q"][:, 0] for row in read_last_rows(scenario, 20.0, 200.0))
    assert abs(last).max() < 1e-13
    # a decaying rest, which the way of sampling moves by some per cent
    if starts == (
        0.6,
        -0.5,
    ):
        assert first == pytest.approx([-6.4e-5, 5.9e-5], rel=0.035)
    assert "at q = 0 or hanging" in scenario.describe_law_conditions()[0]


@pytest.mark.parametrize(
    "start",
    [
        (-1.5, 0.0),
        *(pytest.param(start, marks=pytest.mark.long) for start in HANGING_STARTS),
    ],
)
def test_under_gravity_low_starts_end_hanging(start: tuple[float, float]) -> None:
    """Y_G'r = 0 also holds where cos q1 = cos(q1 + q2) = 0, whatever r is: arms of two links, no users."""
    names = ("m", "s")
    scenario = make_unit_scenario(
        {name: {"q0_rad": list(start)} for name in names},
        {"law": "sync", "Lambda": 1.0, "K": 3.0, "Gamma": 1.0, "theta_hat0": 0.0},
        arm={},
        duration_s=100.0,
    )
    (last,) = read_last_rows(scenario, 100.0)
    assert last["q"][:, 0] == pytest.approx(-0.5 * np.pi, abs=5e-3)
    assert last["q"][:, 1] == pytest.approx(0.0, abs=5e-3)
    assert abs(last["qd"]).max() < 1e-3


OTHER_GAINS: dict[str, tuple[str, dict[str, float], float, tuple[float, float]]] = {
    "three sites": ("abc", {"Lambda": 2.0, "K": 5.0, "Gamma": 1.0}, 80.0, (-1.6, 0.05)),
    "a longer delay": ("ab", {"Lambda": 0.5, "K": 4.0, "Gamma": 2.0}, 300.0, (-1.7, 0.1)),
    "slow learning": ("abc", {"Lambda": 1.0, "K": 3.0, "Gamma": 0.5}, 200.0, (-1.55, 0.0)),
}


@pytest.mark.parametrize("height", ["low", "high"])
@pytest.mark.parametrize(
    "name",
    [
        "a longer delay",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in ("three sites", "slow learning")
        ),
    ],
)
def test_other_gains_make_the_start_decide_rest(name: str, height: str) -> None:
    sites, gains, delay_ms, low = OTHER_GAINS[name]
    start = low if height == "low" else (0.8, 0.3)
    share = 1.0 / (len(sites) - 1)
    scenario = make_unit_scenario(
        {site: {"q0_rad": list(start)} for site in sites},
        {"law": "sync", "theta_hat0": 0.0, **gains},
        arm={},
        link={"model": "constant", "delay_ms": delay_ms},
        dominance={site: {peer: share for peer in sites if peer != site} for site in sites},
        duration_s=100.0,
    )
    (last,) = read_last_rows(scenario, 100.0)
    first_joint_rad = -0.5 * np.pi if height == "low" else 0.0
    assert last["q"][:, 0] == pytest.approx(first_joint_rad, abs=5e-3)
    assert last["q"][:, 1] == pytest.approx(0.0, abs=5e-3)
    assert "at q = 0 or hanging" in scenario.describe_law_conditions()[0]


@pytest.mark.long
def test_the_papers_law_keeps_its_pose_under_gravity() -> None:
    assert find_final_angles("adaptive", (0.6, -0.5), 9.81, 200.0)[0] == pytest.approx(
        -0.047162, rel=1e-3
    )
    assert find_final_angles("adaptive", (0.6, -0.5), 0.0, 200.0)[0] == pytest.approx(
        0.05, abs=1e-6
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("starts", "pose"), [((0.6, -0.5), 0.038255), ((0.6, -0.5, 0.1), 0.055753)]
)
def test_without_gravity_all_agree(starts: tuple[float, ...], pose: float) -> None:
    assert find_final_angles("sync", starts, 0.0, 200.0)[0] == pytest.approx(pose, abs=6e-7)


@pytest.mark.parametrize("law", ["sync", "adaptive_kinematics"])
def test_planar_laws_refuse_a_chain(law: str) -> None:
    with pytest.raises(
        ScenarioError, match=f"control.law: {law} uses the regressor of the planar two-link arm"
    ):
        load_scenario("six_joints", [f"control={{law = '{law}'}}"])

"""Saturated P+d, Lee and Spong's law, shared authority, impedance control, the Smith predictor: at rest."""

import math
from typing import Any

import numpy as np
import pytest

from tests.unit_arm import CLAMP, H50, make_spring_hand, make_unit_scenario, read_last_rows
from trilat_net.analysis.arm_rows import PlacedArm
from trilat_net.core.arms.elementary import tanh
from trilat_net.core.links.dominance import DominanceMatrix
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario

SATURATED = {"law": "saturated_pd", "K": 100.0, "P": 5.0, "d": 20.0}
P_D = {"law": "p_d", "K": 100.0, "d": 20.0}
SMITH = {"law": "smith", "K": 100.0, "d": 5.0}
TRIO = ("m1", "m2", "s")


def make_pair_scenario(
    law: dict[str, Any], *, clamped: bool = False, **master: Any
) -> Scenario:
    sites = {"m": {"hands": [H50], **master}, "s": {"hands": [CLAMP] if clamped else []}}
    return make_unit_scenario(sites, law, duration_s=30.0)


def make_trio_scenario(
    law: dict[str, Any], slave: tuple[float, float], sites: dict[str, Any], **more: Any
) -> Scenario:
    """Two masters that follow the others by halves, and a slave that follows them by two shares."""
    halves = {"m1": {"m2": 0.5, "s": 0.5}, "m2": {"m1": 0.5, "s": 0.5}}
    shares = {**halves, "s": {"m1": slave[0], "m2": slave[1]}}
    return make_unit_scenario(
        {name: sites.get(name, {}) for name in TRIO},
        law,
        duration_s=40.0,
        **{"dominance": shares, **more},
    )


def test_the_tangent_is_that_of_the_mathematics_library() -> None:
    values = np.concatenate([np.linspace(-25.0, 25.0, 4001), np.logspace(-300.0, 1.0, 500)])
    tangents = np.array([tanh(value) for value in values])
    assert np.abs(tangents - np.tanh(values)).max() <= 3e-16
    assert (tangents == -np.array([tanh(-value) for value in values])).all()
    assert (tanh(0.0), tanh(math.inf), tanh(-math.inf)) == (0.0, 1.0, -1.0)
    assert math.isnan(tanh(math.nan))


@pytest.mark.long
def test_a_saturated_pull_ends_at_its_limit() -> None:
    free = read_last_rows(make_pair_scenario(SATURATED), 30.0)[0]
    assert free["q"][:, 0] == pytest.approx(0.3, abs=1e-6)
    clamped = read_last_rows(make_pair_scenario(SATURATED, clamped=True), 30.0)[0]
    assert clamped["q"][:, 0] == pytest.approx([0.20008, 0.0050], abs=5e-6)
    assert -clamped["tau_x"][0, 0] == pytest.approx(4.9959, abs=5e-5)
    linear = read_last_rows(make_pair_scenario(P_D, clamped=True), 30.0)[0]
    assert -linear["tau_x"][0, 0] == pytest.approx(9.677, abs=5e-4)


def test_saturation_makes_the_weighted_mean_a_vote() -> None:
    sites = {
        "m1": {"hands": [make_spring_hand(0.3)]},
        "m2": {"hands": [make_spring_hand(-0.3)]},
    }
    vote = read_last_rows(make_trio_scenario(SATURATED, (0.9, 0.1), sites), 40.0)[0]
    assert vote["q"][:, 0] == pytest.approx([0.2444, -0.2, 0.2389], abs=5e-5)
    mean = read_last_rows(make_trio_scenario(P_D, (0.9, 0.1), sites), 40.0)[0]
    assert mean["q"][:, 0] == pytest.approx([0.135, -0.015, 0.120], abs=5e-4)


def test_lee_and_spong_drag_common_motion() -> None:
    """The drag of both arms at one speed is 2 d + 2 K T = 4 K T at the bound."""
    law = {"law": "lee_spong", "K": 100.0, "Kd": 3.0, "T_max_ms": 200.0}
    clamped = read_last_rows(make_pair_scenario(law, clamped=True), 30.0)[0]
    assert -clamped["tau_x"][0, 0] / clamped["q"][0, 0] == pytest.approx(90.909, abs=5e-4)
    push = {"kind": "recorded", "points": [[0.0, 0.8, 0.4], [100.0, 0.8, 0.4]]}
    pushed = make_unit_scenario({"m": {"hands": [push]}, "s": {}}, law, duration_s=40.0)
    assert 0.8 / read_last_rows(pushed, 40.0)[0]["qd"][:, 0] == pytest.approx(80.0, abs=0.05)


@pytest.mark.parametrize(
    ("scheme", "more_ms", "P_e", "holds"),
    [
        ("second_order", 0.0, 0.0, True),
        ("second_order", 1.0, 0.0, False),
        ("digital", 0.0, 0.1, True),
        ("digital", 0.0, 0.09, False),
    ],
)
def test_lee_and_spong_bound_holds_at_edge(
    scheme: str, more_ms: float, P_e: float, holds: bool
) -> None:
    """The bound is the published one, and K h more for torques that are held."""
    link = {"model": "constant", "delay_ms": 200.0 + more_ms}
    law = {"law": "lee_spong", "K": 100.0, "T_max_ms": 200.0, "P_e": P_e}
    conditions = make_unit_scenario(
        {"m": {}, "s": {}}, law, link=link, scheme=scheme
    ).describe_law_conditions()
    text = "4 (d1 - K1 h / 2) (d2" if scheme == "digital" else "4 d1 d2 >= (T1 + T2)^2 K1 K2"
    assert f"lee_spong at m, s {'holds' if holds else 'does not hold'}: {text}" in conditions[0]


@pytest.mark.long
def test_users_share_authority_and_feel_no_environment() -> None:
    """Hands end at +-0.3 under the guidance that they feel, K (1 - a_i) 0.6."""
    stiff: dict[str, Any] = {
        "kind": "spring",
        "stiffness_nm_rad": 1e5,
        "damping_nm_s_rad": 100.0,
    }
    ends = (0.3 + 15.0 / 1e5, -0.3 - 45.0 / 1e5)
    sites = {
        name: {"hands": [{**stiff, "to_rad": [x, 0.5 * x]}], "q0_rad": [x, 0.5 * x]}
        for name, x in zip(TRIO, ends, strict=False)
    }
    shares = {
        i: {j: x for j, x in zip(TRIO, row, strict=True) if i != j}
        for i, row in zip(TRIO, DominanceMatrix.complementary(0.75).alpha.tolist(), strict=True)
    }
    law = {"law": "authority", "K": 100.0, "d": 20.0}
    for wall, slave in (([], 0.15), ([CLAMP], 15.0 / 1100.0)):
        sites["s"] = {"control": {"leads": False}, "hands": wall}
        scenario = make_trio_scenario(law, (0.75, 0.25), sites, dominance=shares)
        rest = read_last_rows(scenario, 40.0)[0]
        assert rest["q"][:, 0] == pytest.approx([0.3, -0.3, slave], abs=1e-9)
        assert rest["tau_x"][:2, 0] == pytest.approx([-15.0, 45.0], abs=1e-4)
    text = " ".join(scenario.describe_law_conditions())
    bound = "4 (d1 - K1 h / 2) (d2 - K2 h / 2) >= (T1 + T2 + h)^2 K1 K2, T1 + T2 + h = 401 ms"
    assert f"authority at m1, m2 holds: {bound}" in text
    assert "authority at s holds: it follows and closes no loop" in text


def test_a_single_user_closes_no_loop() -> None:
    law = {"law": "authority", "K": 100.0, "d": 20.0}
    followers = {name: {"control": {"leads": False}} for name in TRIO[1:]}
    scenario = make_trio_scenario(law, (0.75, 0.25), {TRIO[0]: {}, **followers})
    text = " ".join(scenario.describe_law_conditions())
    assert f"authority at {TRIO[0]} holds: no arm follows another" in text


@pytest.mark.long
def test_impedances_yield_as_configured() -> None:
    push = {"kind": "recorded", "points": [[0.0, 0.0, 0.0], [1.0, 3.0, 3.0], [100.0, 3.0, 3.0]]}
    law = {"law": "impedance", "K": 50.0}
    sites: dict[str, Any] = {"m1": {"hands": [push]}, "s": {"control": {"follows": True}}}
    free = make_trio_scenario(law, (0.75, 0.25), sites)
    rest = read_last_rows(free, 40.0)[0]
    assert rest["q"][:, 0] == pytest.approx([0.06, 0.0, 0.045], abs=1e-9)
    assert "holds: the slave touches nothing" in free.describe_law_conditions()[0]
    sites["s"]["hands"] = [CLAMP]
    held = read_last_rows(make_trio_scenario(law, (0.75, 0.25), sites), 40.0)[0]
    f = held["tau_x"][2, 0]  # the force on the environment
    assert 50.0 * held["q"][:2, 0] == pytest.approx([3.0 - 0.75 * f, -0.25 * f], abs=1e-9)


LOOP = {"M": 1.0, "B": 2.5, "K": 40.0, "slave": 120.0, "wall": 11.513, "hand": 84.0}
"""The wall is 0.95 of the stiffest one with free masters."""
SWINGING = {"M": 1.0, "B": 1.0, "K": 60.0, "slave": 160.0, "wall": 4.9427, "hand": 0.0}
PULSE = {"kind": "pulse", "start_s": 0.5, "end_s": 0.8, "peak_nm": [1.0, 0.5]}


def make_spring(stiffness: float) -> dict[str, Any]:
    """Returns a hand or a wall without damping at the start pose."""
    return {**CLAMP, "stiffness_nm_rad": stiffness}


def make_impedance_scenario(
    loop: dict[str, float],
    link: dict[str, Any],
    duration_s: float,
    *,
    hand: float = 0.0,
    wall: bool = True,
) -> Scenario:
    gains = {key: loop[key] for key in ("M", "B")}
    sites: dict[str, Any] = {
        "m": {"control": {**gains, "K": loop["K"]}, "hands": [PULSE]},
        "s": {"control": {**gains, "K": loop["slave"], "follows": True}, "hands": []},
    }
    if hand:
        sites["m"]["hands"] = [PULSE, make_spring(hand)]
    if wall:
        sites["s"]["hands"] = [make_spring(loop["wall"])]
    return make_unit_scenario(sites, {"law": "impedance"}, link=link, duration_s=duration_s)


def peak_motion(scenario: Scenario, first_s: float, last_s: float) -> float:
    """Returns the largest motion of the slave over a time, at steps of 20 ms."""
    rows = read_last_rows(scenario, *np.arange(first_s, last_s, 0.02))
    return max(float(np.abs(row["q"][1]).max()) for row in rows)


def make_constant_link(delay_ms: float) -> dict[str, Any]:
    return {"model": "constant", "delay_ms": delay_ms}


HELD_LOOPS = {
    "gain 1.77": (LOOP, 20.0, 0.411),
    "gain 1.65": (
        {"M": 1.0, "B": 3.0, "K": 60.0, "slave": 150.0, "wall": 15.47, "hand": 98.0},
        20.0,
        0.4218,
    ),
    "gain 1.68": (
        {"M": 2.0, "B": 4.0, "K": 50.0, "slave": 140.0, "wall": 14.03, "hand": 98.0},
        30.0,
        0.2931,
    ),
    "gain 1.62": (
        {"M": 1.5, "B": 3.0, "K": 30.0, "slave": 100.0, "wall": 10.1, "hand": 76.0},
        30.0,
        0.2680,
    ),
}
"""Impedances, delay in ms, and the rate in 1/s at which they grow with the hand at the master."""


def largest_loop_gain(loop: dict[str, float], hand: float) -> float:
    """Returns the largest gain over all frequencies, with a spring hand at the master."""
    M, B, K, K_s, K_e, _ = loop.values()
    s = 1j * np.geomspace(0.1, 100.0, 20001)
    slave = K_e * (K_s + B * s) / (M * s**2 + B * s + K_s + K_e)
    return float(np.abs(slave / (M * s**2 + B * s + K + hand)).max())


def rightmost_root(loop: dict[str, float], delay_ms: float, near: complex) -> complex:
    """Returns the root of (M s^2 + B s + K_s + K_e) (M s^2 + B s + K + k) + K_e (K_s + B s)
    e^(-s T) by Newton.

    T is the delay of both ways.
    """
    M, B, K, K_s, K_e, k = loop.values()
    T = 2e-3 * delay_ms
    root = near
    for _ in range(50):
        slave = M * root**2 + B * root + K_s
        master = M * root**2 + B * root + K + k
        back = K_e * (K_s + B * root) * np.exp(-T * root)
        slope = (2.0 * M * root + B) * (slave + K_e + master)
        slope += K_e * B * np.exp(-T * root) - T * back
        root -= ((slave + K_e) * master + back) / slope
    return root


@pytest.mark.parametrize(
    "name",
    [
        "gain 1.77",
        *(pytest.param(name, marks=pytest.mark.long) for name in [*HELD_LOOPS][1:]),
    ],
)
def test_a_masters_spring_hand_voids_small_gain(name: str) -> None:
    loop, delay_ms, growth_per_s = HELD_LOOPS[name]
    M, _, K, _, _, k = loop.values()
    root = rightmost_root(loop, delay_ms, 0.3 + 1j * np.sqrt((K + k) / M))
    assert root.real == pytest.approx(growth_per_s, abs=5e-3)

    free = make_impedance_scenario(loop, make_constant_link(delay_ms), 12.0)
    held = make_impedance_scenario(loop, make_constant_link(delay_ms), 12.0, hand=k)
    assert peak_motion(free, 10.0, 12.0) < 0.1 * peak_motion(free, 1.0, 3.0)
    growth = np.log(peak_motion(held, 10.0, 12.0) / peak_motion(held, 6.0, 8.0)) / 4.0
    # The law holds its answer to the springs for a tick, which adds up to 6 % to the growth.
    assert growth == pytest.approx(root.real, rel=0.08)


@pytest.mark.parametrize("name", HELD_LOOPS)
def test_the_condition_includes_the_masters_hands(name: str) -> None:
    """A weak hand leaves the gain below one, and the strongest hand does not."""
    loop, delay_ms, _ = HELD_LOOPS[name]
    for held, verdict in ((0.0, "holds"), (3.0, "holds"), (loop["hand"], "does not hold")):
        condition = make_impedance_scenario(
            loop, make_constant_link(delay_ms), 12.0, hand=held
        ).describe_law_conditions()[0]
        # the hand may let go
        gain = max(largest_loop_gain(loop, 0.0), largest_loop_gain(loop, held))
        assert f" {verdict}: the loop gain is at most " in condition
        stated = float(condition.partition("at most ")[2].partition(",")[0])
        assert stated == pytest.approx(gain, rel=5e-3)


def test_free_slave_condition_names_the_stiffest_wall() -> None:
    untouched = make_impedance_scenario(
        LOOP, make_constant_link(20.0), 12.0, hand=LOOP["hand"], wall=False
    )
    assert "up to 6.123 N m/rad at the slave" in untouched.describe_law_conditions()[0]


def test_other_hands_leave_small_gain_undecided() -> None:
    point = {"kind": "tip_spring", "to_m": [1.0, 0.5], "stiffness_n_m": [50.0, 50.0]}
    law = {"law": "impedance"}
    for hand_ in (point, {**make_spring(5.0), "sampled": True}):
        for master, slave in (([hand_], [make_spring(5.0)]), ([], [hand_])):
            follows = {"control": {"follows": True}, "hands": slave}
            scenario = make_unit_scenario({"m": {"hands": master}, "s": follows}, law)
            assert "is undecided: known for springs" in scenario.describe_law_conditions()[0]
        alone = {"control": {"follows": True}}
        scenario = make_unit_scenario({"m": {"hands": [hand_]}, "s": alone}, law)
        assert "no bound is known for walls" in scenario.describe_law_conditions()[0]


def test_more_than_four_hands_leave_small_gain_undecided() -> None:
    scenario = make_unit_scenario(
        {
            "m": {"hands": [make_spring(5.0)] * 5},
            "s": {"control": {"follows": True}, "hands": [make_spring(5.0)]},
        },
        {"law": "impedance"},
    )
    condition = scenario.describe_law_conditions()[0]
    assert "is undecided: evaluated for at most 4 hands at the masters" in condition


SWING = {"model": "sine", "delay_ms": 440.0, "amplitude_ms": 137.0, "period_s": 1.6243}


SWINGS = (
    (440.0, 137.0, 1.6243, 0.0442),
    (446.0, 188.0, 1.6308, 0.0372),
    (586.0, 219.0, 0.4026, 0.0382),
)
"""Mean, amplitude, in ms, and period, in s, of a delay, and the rate of the growth, in 1/s."""


def test_gains_below_one_need_constant_delays() -> None:
    condition = make_impedance_scenario(SWINGING, SWING, 10.0).describe_law_conditions()[0]
    assert "is undecided: known for constant delays" in condition
    condition = make_impedance_scenario(
        SWINGING, make_constant_link(440.0), 10.0
    ).describe_law_conditions()[0]
    assert " holds: the loop gain is at most 0.9" in condition
    condition = make_impedance_scenario(
        SWINGING, SWING, 10.0, wall=False
    ).describe_law_conditions()[0]
    assert " holds: the slave touches nothing" in condition


@pytest.mark.long
@pytest.mark.parametrize(
    ("delay_ms", "amplitude_ms", "period_s", "growth_per_s"),
    SWINGS,
)
def test_a_varying_delay_makes_small_gains_grow(
    delay_ms: float, amplitude_ms: float, period_s: float, growth_per_s: float
) -> None:
    """Constant delays within the range of the swinging delay decay."""
    swing = {
        "model": "sine",
        "delay_ms": delay_ms,
        "amplitude_ms": amplitude_ms,
        "period_s": period_s,
    }
    swinging = make_impedance_scenario(SWINGING, swing, 120.0)
    growth = (
        np.log(peak_motion(swinging, 100.0, 120.0) / peak_motion(swinging, 60.0, 80.0)) / 40.0
    )
    assert growth == pytest.approx(growth_per_s, abs=2e-3)
    for constant_ms in (delay_ms - amplitude_ms, delay_ms, delay_ms + amplitude_ms):
        still = make_impedance_scenario(SWINGING, make_constant_link(constant_ms), 60.0)
        assert peak_motion(still, 50.0, 60.0) < peak_motion(still, 10.0, 20.0)


@pytest.mark.long
def test_a_prediction_removes_the_delay_from_the_loop() -> None:
    """The damping is a quarter of what P+d needs: the master moves as if there were no delay."""
    predicting = make_pair_scenario(SMITH, control={"predicts": True})
    ends = read_last_rows(predicting, 2.0, 3.5, 30.0)
    assert ends[-1]["q"][:, 0] == pytest.approx(0.3, abs=1e-9)
    near = make_unit_scenario(
        {"m": {"hands": [H50]}, "s": {}},
        {**P_D, "d": 5.0},
        link={"model": "constant", "delay_ms": 0.0},
        duration_s=30.0,
    )
    for late, prompt in zip(ends, read_last_rows(near, 2.0, 3.5, 30.0), strict=True):
        assert late["q"][0, 0] == pytest.approx(prompt["q"][0, 0], abs=2e-3)
    plain = read_last_rows(make_pair_scenario({**P_D, "d": 5.0}), 30.0)[0]
    assert abs(plain["qd"]).max() > 1.0  # without the prediction it swings ever more


@pytest.mark.long
def test_predictions_that_lack_contact_are_unstable_there() -> None:
    rows = read_last_rows(
        make_pair_scenario(SMITH, clamped=True, control={"predicts": True}), 20.0
    )[0]
    assert abs(rows["qd"]).max() > 1.0


def test_joint_space_laws_are_refused_in_task_space() -> None:
    with pytest.raises(ScenarioError, match="saturated_pd compares arms joint by joint"):
        load_scenario("unlike_arms", {"control": SATURATED})


def test_saturated_pull_and_gravity_stay_below_limits() -> None:
    """The largest gravity over all poses of the textbook's arm."""
    changes = {"control.law": "saturated_pd", "control.P": 5.0, "control.d": 4.0}
    scenario = load_scenario("paper", changes)
    spec = scenario.sites["s"]
    theta = scenario.arms["s"].theta
    poses = np.stack(np.meshgrid(*[np.linspace(0.0, 2.0 * np.pi, 201)] * 2)).reshape(2, -1)
    arm = PlacedArm(spec.arm.g_m_s2, scenario.arms["s"].lengths_m, poses)
    gravity = np.abs(arm.gravity_torque(np.repeat(theta[:, None], poses.shape[1], axis=1))).max(
        axis=1
    )
    room = np.array(spec.limits.tau_limit_nm) - gravity - 5.0
    (line, *_) = scenario.describe_law_conditions()
    assert f"is within tau_limit_nm up to {room.min() / 4.0:.3g} rad/s" in line
    limit = {"limits.tau_limit_nm": float(gravity.max() + 4.0)}
    (line, *_) = load_scenario("paper", {**changes, **limit}).describe_law_conditions()
    assert "does not hold: tau_limit_nm of joint 1 is 1 N m below gravity + P" in line

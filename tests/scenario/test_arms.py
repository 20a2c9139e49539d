"""Arms in scenarios: valid tables of a chain, refusals with their place, and a complete text."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import trilat_net
from tests.core.chain_references import chain_references
from tests.scenario.builders import SIX_JOINTS, make_six_joint_scenario
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.core.step.site_setup import MotionLimits
from trilat_net.errors import ScenarioError
from trilat_net.execution.verification import verify_log
from trilat_net.scenario import load_scenario, parse_embedded
from trilat_net.scenario.named_files import SHIPPED_FOLDER
from trilat_net.scenario.simulated_arm import SimulatedArm
from trilat_net.scenario.urdf import MAX_CHARACTERS, read_urdf

ARM6, ARM7 = ((SHIPPED_FOLDER / f"arm{n}.urdf").read_text(encoding="utf-8") for n in (6, 7))
UNIFORM = {"uniform": [0.1, 0.2]}
WALL = {
    "kind": "wall",
    "point_m": [0.0, 0.0, 0.0],
    "normal": [0.0, 0.0, 1.0],
    "stiffness_n_m": 100.0,
}
PULSE = {"kind": "pulse", "start_s": 1.0, "end_s": 2.0, "peak_nm": 3.0}
TIP_SPRING = {"kind": "tip_spring", "stiffness_n_m": 100.0}
Overrides = dict[str, Any]


def two_joints(**master: Any) -> dict[str, Any]:
    """Returns the tables of two arms of the robot with a finger."""
    text = (Path(__file__).parent / "robots/finger_inertia.urdf").read_text()
    return {
        "name": "two_joints",
        "duration_s": 3.0,
        "rate_hz": 500,
        "arm": {"urdf": "robot.urdf", "tip": "lower", "armature_kg_m2": 0.1},
        "urdf": {"robot.urdf": text},
        "control": {"law": "p_d", "K": 2.0, "d": 2.0},
        "limits": {"qd_limit_rad_s": 50.0},
        "link": {"delay_ms": 20.0},
        "sites": {"m": master, "s": {"role": "slave"}},
        "dominance": {"m": {"s": 1.0}, "s": {"m": 1.0}},
    }


def refusal(changes: Overrides) -> ScenarioError:
    with pytest.raises(ScenarioError) as caught:
        make_six_joint_scenario(**changes)
    return caught.value


@pytest.mark.long
def test_shipped_arms_have_their_makers_data() -> None:
    """UR5: table C.3 of its manual, less than 18 kg with the base; Panda: 0.855 m and about 18 kg."""
    scenarios = [load_scenario(name) for name in ("six_joints", "seven_joints")]
    ur5, panda = (build_arm_rows(scenario, "s") for scenario in scenarios)
    assert ur5.theta[::10].sum() == pytest.approx(17.05, abs=0.005)
    assert panda.theta[::10].sum() == pytest.approx(16.06, abs=0.005)
    straight = ur5.joint_positions_m(np.zeros((1, 6)))[0]
    assert math.dist(straight[5], straight[2]) == pytest.approx(
        math.hypot(0.425 + 0.39225, 0.10915)
    )
    limits = [np.linspace(joint.lower, joint.upper, 40) for joint in panda.chain.joints[3:6]]
    poses = np.zeros((40**3, 7))
    # what the reach depends on
    poses[:, 3:6] = np.stack(np.meshgrid(*limits), axis=-1).reshape(-1, 3)
    points = panda.joint_positions_m(poses)
    assert np.linalg.norm(points[:, -1] - points[:, 1], axis=1).max() == pytest.approx(
        0.855, abs=0.004
    )


# What is refused


def test_links_of_meshes_alone_are_refused() -> None:
    start = ARM6.index("<inertial>")
    end = ARM6.index("</inertial>") + len("</inertial>")
    mesh = '<visual><geometry><mesh filename="shoulder.dae"/></geometry></visual>'
    error = refusal({"urdf": {"arm6.urdf": ARM6[:start] + mesh + ARM6[end:]}})
    assert "link 'shoulder'" in error.problem
    assert "has no <inertial>" in error.problem
    whole = make_six_joint_scenario(
        urdf={"arm6.urdf": ARM6.replace("<inertial>", f"{mesh}<inertial>", 1)}
    )
    # and no file is opened
    assert (
        whole.arms["m1"].theta.tolist() == make_six_joint_scenario().arms["m1"].theta.tolist()
    )


@pytest.mark.parametrize(("scheme", "most"), [("second_order", 1.0), ("digital", 2.0)])
def test_excessive_damping_of_a_joint_is_named(scheme: str, most: float) -> None:
    """The largest eigenvalue of h D M^-1 by NumPy, from Pinocchio's M of a stored pose."""
    chain, states = chain_references()["arm6"]
    pose = states[0].q
    armature = np.array([0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
    least = np.linalg.eigvalsh(states[0].inertia + np.diag(armature))[0]
    critical = float(most * 1000.0 * least)
    poses = {f"sites.{name}.q0_rad": pose.tolist() for name in ("m1", "m2", "s")}
    base = {**poses, "arm.stops": False, "scheme": scheme, "control.Kd": 0.0}
    make_six_joint_scenario(**base, **{"control.Kp": 0.999 * critical})
    error = refusal({**base, "control.Kp": 1.001 * critical})
    assert error.path == "sites.m1.control"
    assert "damps joint wrist_3" in error.problem
    assert chain.joints[5].name == "wrist_3"


# What is accepted


def test_one_number_applies_to_every_joint() -> None:
    same = make_six_joint_scenario(**{"arm.armature_kg_m2": 0.1, "limits.tau_limit_nm": 50.0})
    assert same.sites["s"].arm.armature_kg_m2 == (0.1,) * 6
    drawn = make_six_joint_scenario(
        **{"arm.armature_kg_m2": UNIFORM, "arm.payload_kg": UNIFORM}
    )
    inertias = {*drawn.sites["m1"].arm.armature_kg_m2, *drawn.sites["s"].arm.armature_kg_m2}
    assert len(inertias) == 12
    assert all(0.1 <= inertia <= 0.2 for inertia in inertias)
    assert drawn.arms["m1"].theta[50] != drawn.arms["s"].theta[50]  # mass of the last link
    again = load_scenario(drawn, seed=2)
    assert again.sites["s"].arm.payload_kg != drawn.sites["s"].arm.payload_kg
    assert not inertias & {*again.sites["s"].arm.armature_kg_m2}
    assert load_scenario(again, seed=1) == drawn


def test_drawn_start_poses_move_tip_operators() -> None:
    start = [0.3, {"uniform": [-1.2, -0.8]}, 1.2, -0.6, 0.5, 0.2]
    drawn = make_six_joint_scenario(
        **{"sites.m1.q0_rad": start, "sites.m1.hands": [TIP_SPRING]}
    )
    again = load_scenario(drawn, seed=2)
    for scenario_drawn in (drawn, again):
        spec = scenario_drawn.sites["m1"]
        assert list(spec.hands[0].from_m) == scenario_drawn.arms["m1"].end_effector(spec.q0_rad)
    assert drawn.sites["m1"].hands[0].from_m != again.sites["m1"].hands[0].from_m


def test_limits_come_from_file_or_author() -> None:
    limits = make_six_joint_scenario().sites["s"].limits
    assert limits.tau_limit_nm == (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
    assert limits.qd_limit_rad_s == (math.pi,) * 6
    changed = make_six_joint_scenario(**{"limits.qd_limit_rad_s": 5.0}).sites["s"].limits
    assert (changed.tau_limit_nm, changed.qd_limit_rad_s) == (limits.tau_limit_nm, 5.0)


def test_start_beyond_limits_needs_no_stops() -> None:
    make_six_joint_scenario(
        **{"sites.s.arm.stops": False, "sites.s.q0_rad": [7.0, 0, 0, 0, 0, 0]}
    )


def test_arms_may_start_slightly_beyond_stops() -> None:
    """No spring pushes at the start pose, the stop of other sites stays, and larger excess is refused."""
    start = [6.34, -0.3, 0.5, 0.0, 0.0, 0.0]
    scenario = make_six_joint_scenario(**{"sites.s.q0_rad": start})
    m1, s = (scenario.arms[name].chain.joints[0] for name in ("m1", "s"))
    assert (m1.upper, s.upper) == (2.0 * math.pi, 6.34)
    assert m1.lower == s.lower == -2.0 * math.pi
    assert any(
        "s starts 0.0568 rad beyond a stop of joint shoulder_pan" in x
        for x in scenario.list_arm_notes()
    )
    error = refusal({"sites.s.q0_rad": [-6.44, -0.3, 0.5, 0.0, 0.0, 0.0]})
    assert error.path == "sites.s.q0_rad[0]"
    assert "start at most 0.15 rad beyond" in error.problem


def test_an_arm_beyond_its_stop_moves_inside() -> None:
    """The arm begins at rest, and its peers, which stand within, lead it there; the run repeats
    bit for bit.
    """
    scenario = load_scenario(two_joints(q0_rad=[2.1, 0.0]))
    log = trilat_net.simulate(scenario)
    m = log["m"]
    q = m.q[:, 0]
    assert q[0] == 2.1
    assert np.abs(np.diff(q[:3])).max() < 1e-4  # a stop of 1000 N m/rad would throw it by 1e-3
    assert q.max() <= 2.1 + 1e-6
    assert q[-1] < 2.0
    assert verify_log(log).passed


def test_position_limits_yield_to_nearby_starts() -> None:
    limits = {"limits.q_max_rad": 2.0, "limits.q_min_rad": -2.0, "on_stale.action": "glide"}
    scenario = load_scenario("play", {**limits, "sites.m1.q0_rad": [2.1, 0.5]})
    assert scenario.setup("m1").limits.q_max == (2.15, 2.0)
    assert scenario.setup("s").limits.q_max == 2.0
    assert any(
        "q_max_rad of joint q1: the limit lies at 2.15 rad" in x
        for x in scenario.list_arm_notes()
    )
    with pytest.raises(ScenarioError, match=r"start at most 0\.15 rad"):
        load_scenario("play", {**limits, "sites.m1.q0_rad": [2.16, 0.5]})


def test_gravity_along_an_axis_is_a_direction() -> None:
    """down = -z at 9.81 is the default; its length does not matter, its bits do not depend on a library."""
    assert make_six_joint_scenario(**{"arm.down": [0, 0, -3.0]}).arms[
        "s"
    ].chain.gravity_m_s2 == (0.0, 0.0, -9.81)
    x, y, z = (
        make_six_joint_scenario(**{"arm.down": [1.0, 2.0, -2.0]}).arms["s"].chain.gravity_m_s2
    )
    assert (x, y, z) == pytest.approx((3.27, 6.54, -6.54), rel=1e-15)


def test_a_sites_own_file_replaces_groups() -> None:
    """No key of [arm] holds for a site that names a file: tip and drives belong to the arm of the group."""
    own_keys = {
        "arm": {"urdf": "arm7.urdf", "tip": "link6"},
        "control": {"Kp": 0.01, "Kd": 0.0},
    }
    start = [0, 0, 0, -1.5, 0, 1.5]
    tables = make_six_joint_scenario(
        **{f"sites.s.{key}": value for key, value in own_keys.items()},
        **{"sites.s.q0_rad": start},
    )
    assert tables.sites["s"].arm.armature_kg_m2 == (0.0,)
    assert tables.arms["s"].joint_names == tuple(f"joint{n}" for n in range(1, 7))
    assert set(tables.urdf) == {"arm6.urdf", "arm7.urdf"}
    back = load_scenario(
        tables, {"sites.s.arm.urdf": "arm6.urdf", "sites.s.arm.armature_kg_m2": 0.1}
    )
    assert (back.sites["s"].arm.tip, set(back.urdf)) == ("", {"arm6.urdf"})


def test_overrides_reach_every_arm_or_one() -> None:
    heavy = load_scenario(
        make_six_joint_scenario(),
        ["arm.payload_kg=1", "sites.s.arm.payload_kg=2", "control.Kp=[9,9,9,1,1,1]"],
    )
    assert [spec.arm.payload_kg for spec in heavy.sites.values()] == [1.0, 1.0, 2.0]
    assert heavy.sites["s"].control.Kp == (9.0, 9.0, 9.0, 1.0, 1.0, 1.0)
    wrist = load_scenario(
        make_six_joint_scenario(),
        {"sites.s.arm.tip": "wrist_3_link", "sites.s.arm.payload_kg": 0.5},
    )
    assert wrist.arms["s"].theta[50] == make_six_joint_scenario().arms["s"].theta[50] + 0.5


# Texts


def test_embedded_texts_are_whole_without_files() -> None:
    scenario = make_six_joint_scenario()
    assert parse_embedded(scenario.text) == scenario
    with pytest.raises(ScenarioError, match=r"arm.urdf: no file may be named here"):
        parse_embedded(SIX_JOINTS)
    long = {"urdf": {"arm6.urdf": ARM6 + " " * MAX_CHARACTERS}}
    with pytest.raises(ScenarioError, match=f"at most {MAX_CHARACTERS} can be read"):
        make_six_joint_scenario(**long)


def test_unnamed_texts_are_left_out() -> None:
    assert (
        make_six_joint_scenario(urdf={"arm6.urdf": ARM6, "other.urdf": "x"})
        == make_six_joint_scenario()
    )


def test_a_file_lies_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "mine.urdf").write_text(ARM6.replace("\n", "\r\n"), newline="")
    file = tmp_path / "six.toml"
    file.write_text(SIX_JOINTS.replace("arm6.urdf", "mine.urdf"))
    assert load_scenario(file).urdf == {"mine.urdf": ARM6}
    (tmp_path / "mine.urdf").write_bytes(b"\xff")
    with pytest.raises(ScenarioError, match=r"mine.urdf cannot be read: not UTF-8"):
        load_scenario(file)
    (tmp_path / "mine.urdf").write_text(ARM6 + " " * MAX_CHARACTERS)
    with pytest.raises(ScenarioError, match=f"at most {MAX_CHARACTERS} can be read"):
        load_scenario(file)


comments = (
    st.sampled_from(['"""', "a\r\nb", "\\", "'''", "[\n    1.0,\n]"]) | st.text(max_size=30)
).filter(
    lambda text: (
        "--" not in text
        and not text.endswith("-")
        and all(c in "\t\r\n" or c >= " " for c in text)
    )
)
pose = st.lists(st.floats(-3, 3), min_size=6, max_size=6)
overrides = st.fixed_dictionaries(
    {},
    optional={
        "arm.payload_kg": st.floats(0, 3) | st.just(UNIFORM),
        "arm.payload_com_m": st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3),
        "arm.armature_kg_m2": st.floats(0.3, 1)
        | st.lists(st.floats(0.3, 1), min_size=6, max_size=6),
        "arm.down": st.lists(st.integers(1, 3), min_size=3, max_size=3),
        "arm.g_m_s2": st.floats(0, 20),
        "sites.s.arm.stops": st.booleans(),
        "sites.s.arm.tip": st.sampled_from(["", "wrist_3_link"]),
        "sites.s.q0_rad": pose | st.floats(-1, 1),
        "sites.m2.hands": st.lists(st.sampled_from([PULSE, TIP_SPRING]), max_size=2),
        "sites.s.environment": st.sampled_from([[], [WALL]]),
        "limits.tau_limit_nm": st.floats(1, 100)
        | st.lists(st.floats(1, 100), min_size=6, max_size=6),
    },
)


@settings(max_examples=40)
@given(changed=overrides, comment=comments)
def test_the_canonical_text_loads_to_the_same_scenario(
    changed: Overrides, comment: str
) -> None:
    if not changed.get("arm.payload_kg"):
        changed.pop("arm.payload_com_m", None)  # what has no mass has no centre
    urdf = {"arm6.urdf": ARM6.replace("</robot>", f"<!--{comment}--></robot>")}
    scenario = make_six_joint_scenario(urdf=urdf, **changed)
    again = parse_embedded(scenario.text)
    assert again == scenario
    assert (again.text, again.sha256) == (scenario.text, scenario.sha256)
    for name in scenario.names:
        setup = scenario.setup(name)
        other = again.setup(name)
        assert setup.theta.tolist() == other.theta.tolist()
        assert (setup.chain, setup.gains, setup.q0) == (other.chain, other.gains, other.q0)


def test_tip_and_inertia_equal_the_references() -> None:
    """Pinocchio's, stored; the drives' inertia is added."""
    model = make_six_joint_scenario().arms["m1"]
    _, states = chain_references()["arm6"]
    for state in states:
        assert model.end_effector(state.q) == pytest.approx(state.tip_position, abs=1e-13)
        expected = state.inertia + np.diag([0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
        assert np.abs(model.inertia(state.q) - expected).max() < 1e-12


def test_planar_arms_equal_their_chain() -> None:
    """End effector of the chain of two joints against the cosines of the planar one."""
    two = read_urdf(ARM7, base="link2", tip="link4")
    assert len(two.joints) == 2
    mixed = make_six_joint_scenario(
        control={},
        **{f"sites.{name}.arm": {"urdf": ""} for name in ("m1", "m2")},
        **{
            "sites.s.arm": {
                "urdf": "arm7.urdf",
                "base": "link2",
                "tip": "link4",
                "armature_kg_m2": 1.0,
            }
        },
        **{f"sites.{name}.q0_rad": [0.3, -1.0] for name in ("m1", "m2", "s")},
    )
    assert parse_embedded(mixed.text) == mixed
    planar = load_scenario("free").arms["m1"]
    x, y, z = mixed.arms["m1"].end_effector([0.3, -1.0])
    assert [x, y] == pytest.approx(planar.end_effector([0.3, -1.0]), abs=1e-15)
    assert z == 0.0


# Reach

REACHES = {
    "planar": load_scenario("play", {"arm.l2_m": 0.6}).arms["m1"],
    "six joints": make_six_joint_scenario(**{"arm.base_xyz_m": [0.3, -0.2, 0.1]}).arms["s"],
    "seven joints": load_scenario("seven_joints").arms["s"],
    "sliding": load_scenario(
        "six_joints",
        {
            "urdf": {
                "arm6.urdf": ARM6.replace(
                    'name="elbow" type="revolute"', 'name="elbow" type="prismatic"'
                )
            },
            "expect": {},
        },
    ).arms["s"],
}


@pytest.mark.parametrize("name", REACHES)
@given(turns=st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7))
@settings(max_examples=40)
def test_no_pose_exceeds_the_reach(name: str, turns: list[float]) -> None:
    arm = REACHES[name]
    q = [math.pi * turn for turn in turns[: arm.counts.joints]]
    tip = arm.end_effector(q)
    assert arm.reach.find_nearest(tip) == pytest.approx(tip, abs=1e-9)


def test_the_reach_of_two_links_is_exact() -> None:
    reach = REACHES["planar"].reach
    assert (reach.inner_m, reach.outer_m) == (pytest.approx(0.4), pytest.approx(1.6))
    for elbow, radius in ((0.0, reach.outer_m), (math.pi, reach.inner_m)):
        assert math.hypot(*REACHES["planar"].end_effector([0.7, elbow])) == pytest.approx(
            radius
        )


def test_joint_hands_stay_between_stops_and_limits() -> None:
    arm = make_six_joint_scenario().arms["s"]
    reach = arm.find_joint_reach(MotionLimits(q_min=(-1.0,), q_max=(7.0,)))
    assert reach.find_nearest([9.0] * 6) == (2.0 * math.pi,) * 6
    assert reach.find_nearest([-9.0] * 6) == (-1.0,) * 6
    planar = REACHES["planar"].find_joint_reach(MotionLimits(q_max=(1.0, 2.0)))
    assert planar.find_nearest([5.0, -5.0]) == (1.0, -5.0)


@pytest.mark.parametrize("assign", [True, False])
def test_changed_parameters_of_simulated_arms_act(assign: bool) -> None:
    arm = SimulatedArm(load_scenario("two_sites"), "s")
    effect = arm.accelerate([1.0, -0.5]) - arm.accelerate([0.0, 0.0])
    if assign:
        arm.theta = 2.0 * arm.theta
    else:
        arm.theta[:] *= 2.0
    heavy_effect = arm.accelerate([1.0, -0.5]) - arm.accelerate([0.0, 0.0])
    np.testing.assert_allclose(heavy_effect, 0.5 * effect, rtol=1e-12)

"""Every robot of `example-robot-data` that has a chain, against Pinocchio's reading of the same file.

The packages come with `make test-long` (`requirements/robots.lock`, 0.9 GB); no mesh is opened.
"""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.core.chain_references import (
    Arm,
    Array,
    ChainState,
    chain_references,
    full_matrix,
    propagate_state,
    to_chain,
    torque_for,
)
from tests.scenario.builders import find_robot_files
from trilat_net.core.arms.chain import (
    LINK_PARAMETERS,
    MAX_JOINTS,
    ChainJoint,
    build_chain,
    find_acceleration,
    parameter_gradient,
    place_end_effector,
    place_joints,
)
from trilat_net.errors import ScenarioError
from trilat_net.scenario.link_inertia import LinkInertia
from trilat_net.scenario.urdf import UrdfChain, read_urdf

pin = pytest.importorskip(
    "pinocchio", reason="the dependency group 'robots' is not installed: make test-long"
)

from tests.core.make_chain_references import (  # noqa: E402 - needs Pinocchio
    build_model,
    compute_answer,
    random_chain,
    random_state,
)

pytestmark = pytest.mark.long

CHAINS = """
a1_description/urdf/a1.urdf FR_foot:3 FL_foot:3 RR_foot:3 RL_foot:3
alex_description/urdf/alex_nub_hands.urdf Head:5 leftNub:10 rightNub:10
alex_description/urdf/alex_psyonic_hands.urdf Torso>Head:2
alex_description/urdf/alex_sake_hands.urdf Head:5 LeftSakeFingerTip1:11 LeftSakeFingerTip2:11
    RightSakeFingerTip1:11 RightSakeFingerTip2:11
alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf LEFT_FOOT_IMU_LINK:6 RIGHT_FOOT_IMU_LINK:6
anymal_b_simple_description/robots/anymal-kinova.urdf LF_FOOT:3 RF_FOOT:3 LH_FOOT:3 RH_FOOT:3
    j2s6s200_end_effector:6
anymal_b_simple_description/robots/anymal.urdf LF_FOOT:3 RF_FOOT:3 LH_FOOT:3 RH_FOOT:3
anymal_c_simple_description/urdf/anymal.urdf LF_FOOT:3 RF_FOOT:3 LH_FOOT:3 RH_FOOT:3
asr_twodof_description/urdf/TwoDofs.urdf Tip:2
b1_description/urdf/b1-z1.urdf FR_foot:3 FL_foot:3 RR_foot:3 RL_foot:3 gripperMover:7
b1_description/urdf/b1.urdf FR_foot:3 FL_foot:3 RR_foot:3 RL_foot:3
baxter_description/urdf/baxter.urdf r_gripper_l_finger_tip:8 l_gripper_l_finger_tip:8 right_wrist:7
borinot_description/urdf/borinot_flying_arm_2.urdf flying_arm_2__ee:2
centauro_description/urdf/centauro.urdf ball1_tip:7 ball2_tip:7 velodyne_motor:2 D435_head_camera_link:2
    wheel_1:6 wheel_2:6
double_pendulum_description/urdf/double_pendulum.urdf link2:2
double_pendulum_description/urdf/double_pendulum_continuous.urdf link2:2
double_pendulum_description/urdf/double_pendulum_simple.urdf link3:2
finger_edu_description/robots/finger_edu.urdf finger_tip_link:3
g1_description/urdf/g1_29dof_rev_1_0.urdf left_ankle_roll_link:6 right_ankle_roll_link:6
    left_rubber_hand:10 right_rubber_hand:10
g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf left_ankle_roll_link:6 right_ankle_roll_link:6
    left_hand_middle_1_link:12 left_hand_index_1_link:12 right_hand_middle_1_link:12
    right_hand_index_1_link:12
go1_description/urdf/go1.urdf FR_foot:3 FL_foot:3 RR_foot:3 RL_foot:3
go2_description/urdf/go2.urdf FL_foot:3 FR_foot:3 RL_foot:3 RR_foot:3
hextilt_description/urdf/hextilt_flying_arm_5.urdf flying_arm_5__gripper:5
human_description/robots/human.urdf left_upperleg_virtual_2>left_foot_virtual:3
    middle_thorax_virtual_2>left_upperarm_virtual:3
icub_description/robots/icub.urdf codyco_balancing_world:6 l_forearm_dh_frame:8 r_forearm_dh_frame:8
    base_link>l_wrist_1:9 base_link>r_wrist_1:9
icub_description/robots/icub_reduced.urdf codyco_balancing_world:6 l_forearm_dh_frame:8
    r_forearm_dh_frame:8 base_link>l_wrist_1:9 base_link>r_wrist_1:9
kinova_description/robots/kinova.urdf j2s6s200_end_effector:6 j2s6s200_link_6:6
laikago_description/urdf/laikago.urdf FR_foot:3 FL_foot:3 RR_foot:3 RL_foot:3
panda_description/urdf/panda.urdf panda_leftfinger:8 panda_hand_tcp:7
panda_description/urdf/panda_collision.urdf panda_leftfinger:8 panda_link0>panda_hand_tcp:7
pr2_description/urdf/pr2.urdf torso_lift_link>r_wrist_roll_link:7
    torso_lift_link>l_gripper_l_finger_link:8
quadruped_description/urdf/quadruped.urdf FL_contact:2 FR_contact:2 BL_contact:2 BR_contact:2
romeo_description/urdf/romeo.urdf l_sole:6 r_sole:6 gaze:5 l_gripper:8 r_gripper:8
romeo_description/urdf/romeo_laas_small.urdf torso>r_wrist:7
romeo_description/urdf/romeo_small.urdf l_sole:6 r_sole:6 torso>l_gripper:7
simple_humanoid_description/urdf/simple_humanoid.urdf r_ankle:6 l_ankle:6 r_wrist:10 l_wrist:10
simple_humanoid_description/urdf/simple_humanoid_classical.urdf r_ankle:6 l_ankle:6 r_wrist:10 l_wrist:10
so_arm_description/urdf/so100.urdf jaw:6
so_arm_description/urdf/so101.urdf moving_jaw_so101_v1_link:6 gripper_frame_link:5
solo_description/robots/solo.urdf FL_FOOT:2 FR_FOOT:2 HL_FOOT:2 HR_FOOT:2
solo_description/robots/solo12.urdf FL_FOOT:3 FR_FOOT:3 HL_FOOT:3 HR_FOOT:3
talos_data/robots/talos_full_v2.urdf rgbd_optical_frame:4 gripper_left_motor_double_link:10
    gripper_right_motor_double_link:10 left_sole_link:6 right_sole_link:6
talos_data/robots/talos_full_v2_box.urdf rgbd_optical_frame:4 gripper_left_motor_double_link:10
    gripper_right_motor_double_link:10 left_sole_link:6 right_sole_link:6
talos_data/robots/talos_left_arm.urdf gripper_left_motor_double_link:7 gripper_left_base_link:6
talos_data/robots/talos_reduced.urdf rgbd_optical_frame:4 gripper_left_motor_double_link:10
    gripper_right_motor_double_link:10 left_sole_link:6 right_sole_link:6
talos_data/robots/talos_reduced_box.urdf rgbd_optical_frame:4 gripper_left_motor_double_link:10
    gripper_right_motor_double_link:10 left_sole_link:6 right_sole_link:6
talos_data/robots/talos_reduced_corrected.urdf rgbd_optical_frame:4 gripper_left_motor_double_link:10
    gripper_right_motor_double_link:10 left_sole_link:6 right_sole_link:6
tiago_description/robots/tiago.urdf xtion_optical_frame:3 hand_thumb_link:9 hand_index_link:9
    hand_mrl_link:9 torso_lift_link>hand_mrl_link:8 arm_2_link>hand_index_flex_3_link:12
tiago_description/robots/tiago_dual.urdf wheel_right_link:2 wheel_left_link:2 caster_front_right_2_link:2
    caster_front_left_2_link:2 caster_back_right_2_link:2 caster_back_left_2_link:2
tiago_description/robots/tiago_no_hand.urdf xtion_optical_frame:3 wrist_ft_tool_link:8
tiago_pro_description/robots/tiago_pro.urdf sellion_link:3 gripper_left_outer_finger_left_link:9
    gripper_right_outer_finger_left_link:9
ur_description/urdf/ur10_joint_limited_robot.urdf ee_link:6
ur_description/urdf/ur10_robot.urdf ee_link:6
ur_description/urdf/ur3_gripper.urdf ee_link:6
ur_description/urdf/ur3_joint_limited_robot.urdf ee_link:6
ur_description/urdf/ur3_robot.urdf ee_link:6
ur_description/urdf/ur5_gripper.urdf ee_link:6
ur_description/urdf/ur5_joint_limited_robot.urdf ee_link:6
ur_description/urdf/ur5_robot.urdf ee_link:6 tool0:6
xarm_description/urdf/xarm7.urdf link_eef:7
z1_description/urdf/z1.urdf gripperMover:7 gripperStator:6
"""
"""File by file its chains as base>end link:joints; without a base, from the root."""
REFUSED = {
    "allegro_hand_description/urdf/allegro_left_hand.urdf": ("link_3.0_tip", "'link_3.0'"),
    "allegro_hand_description/urdf/allegro_right_hand.urdf": ("link_3.0_tip", "'link_3.0'"),
    "bolt_description/robots/bolt.urdf": ("FL_FOOT", "no mass"),
    "hector_description/robots/quadrotor_base.urdf": ("", "no joint"),
    "hyq_description/robots/hyq_no_sensors.urdf": ("lf_foot", "sum of the other two"),
    "iris_description/robots/iris_simple.urdf": ("", "no joint"),
    "ur_description/urdf/ur3.urdf": ("", "no links"),
}
"""Files without a chain: an end link, and the reason."""
NO_CHAIN_OF_TWO = {"iris_description/robots/iris.urdf"}


ROBOTS = Path(__file__).parents[1] / "scenario/robots"


def parse_chains() -> list[tuple[str, str, str, int]]:
    chains = []
    file = ""
    for word in CHAINS.split():
        if word.endswith(".urdf"):
            file = word
        else:
            ends, _, n = word.rpartition(":")
            base, _, tip = ends.rpartition(">")
            chains.append((file, base, tip, int(n)))
    return chains


def read_robot(file: str) -> str:
    """Returns the text of a file; a joint with the name of a link is renamed, as Pinocchio has
    one list of frames.
    """
    root = ElementTree.parse(find_robot_files()[file]).getroot()
    links = {link.get("name") for link in root.findall("link")}
    for joint in root.findall("joint"):
        for element, key in (
            (joint, "name"),
            *((mimic, "joint") for mimic in joint.findall("mimic")),
        ):
            if element.get(key) in links:
                element.set(key, f"{element.get(key)} joint")
    return ElementTree.tostring(root, encoding="unicode")


def parsed_model(text: str, chain: UrdfChain) -> pin.Model:
    """Returns Pinocchio's model of the file, all joints but the chain's held at zero."""
    whole = pin.buildModelFromXML(text)
    kept = {joint.name for joint in chain.joints}
    held = [whole.getJointId(name) for name in whole.names[1:] if name not in kept]
    return pin.buildReducedModel(whole, held, pin.neutral(whole))


def test_every_file_is_in_the_list() -> None:
    listed = {file for file, *_ in parse_chains()} | REFUSED.keys() | NO_CHAIN_OF_TWO
    assert listed == find_robot_files().keys()


@pytest.mark.parametrize(
    ("file", "tip", "reason"), [(file, *why) for file, why in REFUSED.items()]
)
def test_files_without_chain_are_refused(file: str, tip: str, reason: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        read_urdf(find_robot_files()[file].read_text(), tip=tip)
    assert reason in str(caught.value)


@pytest.mark.parametrize(("file", "base", "tip", "n"), parse_chains())
def test_chains_equal_pinocchios(file: str, base: str, tip: str, n: int) -> None:
    """Bodies, frames, limits; M, torque, pose and Jacobian of the model rebuilt from the chain;
    then the core's.
    """
    text = read_robot(file)
    chain = read_urdf(text, base, tip)
    assert len(chain.joints) == n
    check_dynamics(text, chain)


def replace_inertia(text: str, link: str, link_inertia: LinkInertia) -> str:
    """Returns a file with a mass and an inertia of a link written into its XML."""
    root = ElementTree.fromstring(text)
    element = next(match for match in root.findall("link") if match.get("name") == link)
    inertial = element.find("inertial")
    if inertial is None:
        inertial = ElementTree.SubElement(element, "inertial")
    parts: dict[str, ElementTree.Element] = {}
    for tag in ("origin", "mass", "inertia"):
        part = inertial.find(tag)
        parts[tag] = ElementTree.SubElement(inertial, tag) if part is None else part
    if link_inertia.mass_kg is not None:
        parts["mass"].set("value", repr(link_inertia.mass_kg))
    if link_inertia.com_m is not None:
        parts["origin"].set("xyz", " ".join(map(repr, link_inertia.com_m)))
    if link_inertia.inertia_kg_m2 is not None:
        parts["origin"].set("rpy", "0 0 0")
        keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
        for key, value in zip(keys, link_inertia.inertia_kg_m2, strict=True):
            parts["inertia"].set(key, repr(value))
    return ElementTree.tostring(root, encoding="unicode")


HEAVY = LinkInertia(
    mass_kg=1.5, com_m=(0.02, -0.01, 0.1), inertia_kg_m2=(0.02, 1e-3, 0.03, -2e-3, 5e-4, 0.025)
)
PANDA = "panda_description/urdf/panda.urdf"
SO_ARM = "so_arm_description/urdf/so101.urdf"
GIVEN = [
    (PANDA, "panda_hand_tcp", {"panda_link4": HEAVY, "panda_hand": LinkInertia(mass_kg=0.4)}),
    (
        PANDA,
        "panda_hand_tcp",
        {"panda_leftfinger": HEAVY, "panda_link7": LinkInertia(com_m=(0.0, 0.1, 0.2))},
    ),
    (SO_ARM, "gripper_frame_link", {"moving_jaw_so101_v1_link": HEAVY}),
    (ROBOTS / "kinematics_only.urdf", "", {"yaw": HEAVY, "tool": LinkInertia(mass_kg=0.25)}),
    (
        ROBOTS / "finger_inertia.urdf",
        "lower",
        {"finger": HEAVY, "upper": LinkInertia(mass_kg=3.0)},
    ),
]


@pytest.mark.parametrize(("file", "tip", "links"), GIVEN)
def test_given_inertias_equal_the_mended_file(
    file: str | Path, tip: str, links: dict[str, LinkInertia]
) -> None:
    text = file.read_text() if isinstance(file, Path) else read_robot(file)
    mended = text
    for link, inertia in links.items():
        mended = replace_inertia(mended, link, inertia)
    check_dynamics(mended, read_urdf(text, tip=tip, links=links))


def test_balanced_fingers_equal_the_mended_file() -> None:
    text = (ROBOTS / "finger_inertia.urdf").read_text()
    nearest = LinkInertia(inertia_kg_m2=(1.35e-6, 0.0, 2.65e-6, 0.0, 0.0, 4e-6))
    check_dynamics(replace_inertia(text, "finger", nearest), read_urdf(text, balance=True))
    check_dynamics(
        replace_inertia(text, "finger", nearest), read_urdf(text, tip="lower", balance=True)
    )


def check_dynamics(text: str, chain: UrdfChain) -> None:
    """Compares a chain with Pinocchio: bodies, frames, limits, and the terms of the dynamics."""
    model = parsed_model(text, chain)
    n = len(chain.joints)
    assert [joint.name for joint in chain.joints] == list(model.names)[1:]
    assert model.nv == n
    check_joints(chain, model)
    rebuilt = build_model(chain)
    data = model.createData()
    frame = model.getFrameId(chain.tip)
    foot = model.getFrameId(chain.base)
    random = np.random.default_rng(n)
    for first in (True, False):
        state = random_state(random, n, first)
        q = pin.integrate(model, pin.neutral(model), state["q"])
        pin.framesForwardKinematics(model, data, q)
        base_pose = data.oMf[foot].copy()
        tip_pose = data.oMf[frame].copy()
        R = base_pose.rotation
        ours = compute_answer(rebuilt, chain, state | {"v": state["qd"]})
        relative = base_pose.inverse() * tip_pose
        assert is_near(ours["tip_position"], relative.translation, 1e-12)
        assert is_near(ours["tip_rotation"], relative.rotation, 1e-12)
        jacobian = pin.computeFrameJacobian(
            model, data, q, frame, pin.LOCAL_WORLD_ALIGNED
        ).reshape(6, n)
        assert is_near(
            ours["jacobian"], np.vstack([R.T @ jacobian[:3], R.T @ jacobian[3:]]), 1e-12
        )
        model.gravity.linear = R @ state["gravity"]
        torque = pin.rnea(model, data, q, state["qd"], state["a"])
        assert is_near(ours["inverse_dynamics"], torque, 1e-12)
        inertia = np.triu(pin.crba(model, data, q).reshape(n, n))
        inertia += np.triu(inertia, 1).T
        assert is_near(ours["inertia"], inertia, 1e-12)
        acceleration = pin.aba(model, data, q, state["qd"], state["tau"])
        bound = 100 * np.finfo(float).eps * np.linalg.cond(inertia)
        assert is_near(ours["forward_dynamics"], acceleration, max(bound, 1e-12))
        check_core(chain, ChainState(**state | compute_answer(rebuilt, chain, state)))


def check_joints(chain: UrdfChain, model: pin.Model) -> None:
    for i, joint in enumerate(chain.joints):
        body = model.inertias[i + 1].toDynamicParameters()
        assert is_near(joint.inertia, body, 1e-12), joint.name
        if "RUB" not in model.joints[i + 1].shortname():  # a continuous one has no limits
            at = model.joints[i + 1].idx_q
            limits = model.lowerPositionLimit[at], model.upperPositionLimit[at]
            if any(limits) and abs(limits[0]) < 1e9:
                assert (joint.lower, joint.upper) == limits
        stated = model.upperEffortLimit[i], model.upperVelocityLimit[i]
        for ours, theirs in zip(
            (joint.effort_limit, joint.velocity_limit), stated, strict=True
        ):
            assert ours == (theirs or np.inf)
        assert (joint.viscous, joint.coulomb) == (
            model.damping[i],
            model.upperDryFrictionLimit[i],
        )


def check_core(chain: UrdfChain, state: ChainState) -> None:
    """Compares the leaves of the core with Pinocchio's results."""
    n = len(chain.joints)
    joints = [
        ChainJoint(j.kind == "prismatic", j.axis, j.rotation, j.origin_m) for j in chain.joints
    ]
    arm = Arm(
        build_chain(joints, MAX_JOINTS),
        np.concatenate([joint.inertia for joint in chain.joints]),
    )
    propagate_state(arm, state, state.v)
    assert is_near(torque_for(arm, state.v, state.a), state.inverse_dynamics, 1e-12)
    gradient = np.zeros(LINK_PARAMETERS * n)
    qdd = np.zeros(n)
    parameter_gradient(arm.rows, gradient)
    assert is_near(gradient, state.regressor_transpose_r, 1e-12)
    place_joints(arm.rows, state.q)
    assert is_near(full_matrix(arm), state.inertia, 1e-12)
    find_acceleration(arm.rows, arm.theta, state.gravity, state.q, state.qd, state.tau, qdd)
    # where it cancels tau, qdd is their difference
    bias = state.tau - state.inertia @ state.forward_dynamics
    size = max(
        np.abs(np.linalg.solve(state.inertia, torque)).max() for torque in (state.tau, bias)
    )
    bound = 100 * np.finfo(float).eps * np.linalg.cond(state.inertia)
    assert np.abs(qdd - state.forward_dynamics).max() <= bound * size
    place_joints(arm.rows, state.q)
    assert is_near(place_end_effector(arm.rows, chain.tip_origin_m), state.tip_position, 1e-12)
    assert is_near(np.vstack([arm.rows["J_lin"].T, arm.rows["J_ang"].T]), state.jacobian, 1e-12)


@given(seed=st.integers(0, 2**32 - 1), sliders=st.lists(st.booleans(), min_size=1, max_size=12))
@settings(max_examples=300)
def test_the_core_agrees_on_random_chains(seed: int, sliders: list[bool]) -> None:
    """1 to 12 joints with axes in any direction, any of them prismatic."""
    random = np.random.default_rng(seed)
    n = len(sliders)
    entry = random_chain(random, n, tuple(i for i in range(n) if sliders[i]))
    chain = to_chain(entry)
    state = random_state(random, n, weight=False)
    check_core(chain, ChainState(**state | compute_answer(build_model(chain), chain, state)))


def is_near(a: object, b: object, tolerance: float) -> bool:
    """Asserts equality relative to the largest entry."""
    a = np.asarray(a)
    b = np.asarray(b)
    return bool(np.abs(a - b).max() <= tolerance * max(np.abs(b).max(), 1e-3))


def test_stored_references_are_pinocchios() -> None:
    """The file of references is the output of its script."""
    for chain, states in chain_references().values():
        model = build_model(chain)
        for state in states:
            for key, value in compute_answer(model, chain, state._asdict()).items():
                assert is_near(value, getattr(state, key), 1e-12), key


def test_two_velocity_torque_uses_christoffel_symbols() -> None:
    """Linear in v, equal to Pinocchio's where v is qd, and dM/dt = C + C'."""
    for chain, (state, *_) in chain_references().values():
        model = build_model(chain)
        n = len(chain.joints)
        resting = state._asdict() | {"a": np.zeros(n), "gravity": np.zeros(3)}

        def C(
            v: Array,
            model: pin.Model = model,
            chain: UrdfChain = chain,
            still: dict[str, Array] = resting,
        ) -> Array:
            return compute_answer(model, chain, still | {"v": v})["inverse_dynamics"]

        matrix = np.stack([C(axis) for axis in np.eye(n)], axis=1)
        assert is_near(matrix @ state.v, C(state.v), 1e-12)
        h = 1e-6
        ends = [
            compute_answer(model, chain, resting | {"q": state.q + s * h * state.qd})["inertia"]
            for s in (1, -1)
        ]
        assert is_near(matrix + matrix.T, (ends[0] - ends[1]) / (2 * h), 1e-7)

"""Frames of links for viewers: Pinocchio has the end of an arm there, and others read the messages."""

import math
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from tests.core.chain_references import ARMS, chain_references
from tests.scenario.builders import two_arm_text
from trilat_net.log.ros2 import cdr
from trilat_net.log.ros2.robot_model import (
    SPACING_M,
    RobotModel,
    _read_joint_frame,
    multiply_quaternions,
    rotate_vector,
)
from trilat_net.log.ros2.ros2_messages import ROBOT_CHANNELS, Ros2SiteChannels
from trilat_net.scenario import Scenario, load_scenario, parse_scenario

POSES = {"arm6": [0.3, -1.0, 1.2, -0.6, 0.5, 0.2], "arm7": [0.1, 0.2, 0.0, -1.5, 0.1, 1.6, 0.2]}


def make_robot_scenario(arm: str = "arm6", down: str = "[0.0, 0.0, -1.0]") -> Scenario:
    text = two_arm_text(f"{arm}.urdf", POSES[arm]).replace(
        "[control]", f"down = {down}\n[control]"
    )
    return parse_scenario(text, "two.toml")


def end_of(model: RobotModel, q) -> tuple:
    """The last frame in that of the base, by what is sent."""
    at = (0.0, 0.0, 0.0)
    turned = (0.0, 0.0, 0.0, 1.0)
    for origin, rotation in model.compute_transforms(q)[1:]:
        at = tuple(a + b for a, b in zip(at, rotate_vector(turned, origin), strict=True))
        turned = multiply_quaternions(turned, rotation)
    return at, turned


@pytest.mark.parametrize("arm", POSES)
def test_last_frames_equal_pinocchios_end(arm):
    model = RobotModel(make_robot_scenario(arm), "m")
    reference = chain_references()[arm]
    assert model.frames[-1][1] == f"m/{reference_tip(arm)}"
    for state in reference.states:
        at, turned = end_of(model, state.q)
        assert at == pytest.approx(state.tip_position, abs=1e-12)
        columns = [rotate_vector(turned, axis) for axis in np.eye(3)]
        assert np.transpose(columns) == pytest.approx(state.tip_rotation, abs=1e-12)


def reference_tip(arm: str) -> str:
    root = ElementTree.fromstring((ARMS / f"{arm}.urdf").read_text())
    parents = {joint.find("parent").get("link") for joint in root.findall("joint")}
    (tip,) = {link.get("name") for link in root.findall("link")} - parents
    return tip


@pytest.mark.parametrize(
    "down", [(0.0, 0.0, -1.0), (0.0, 0.0, 2.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.4)]
)
def test_bases_stand_apart_and_gravity_points_down(down):
    models = [RobotModel(make_robot_scenario(down=str([*down])), site) for site in ("m", "s")]
    (m, turned), (s, _) = (model.compute_transforms(POSES["arm6"])[0] for model in models)
    assert math.dist(m, s) == SPACING_M
    assert rotate_vector(turned, tuple(np.array(down) / math.hypot(*down))) == pytest.approx(
        (0, 0, -1)
    )


def test_ros_decoders_read_the_message():
    model = RobotModel(make_robot_scenario(), "m")
    schema = Schema(
        id=1, name=cdr.TRANSFORMS, encoding="ros2msg", data=cdr.ROS2_SCHEMAS[cdr.TRANSFORMS]
    )
    q = POSES["arm6"]
    message = DecoderFactory().decoder_for("cdr", schema)(model.pack(5_000_000_007, q))
    assert [(t.header.frame_id, t.child_frame_id) for t in message.transforms] == model.frames
    for stamped, (origin, turned) in zip(
        message.transforms, model.compute_transforms(q), strict=True
    ):
        t = stamped.transform.translation
        r = stamped.transform.rotation
        assert ((t.x, t.y, t.z), (r.x, r.y, r.z, r.w)) == (origin, turned)
        assert (stamped.header.stamp.sec, stamped.header.stamp.nanosec) == (5, 7)
    assert {channel.kind for channel in ROBOT_CHANNELS.values()} == {cdr.STRING, cdr.TRANSFORMS}


def test_the_robot_description_has_the_links_and_shapes():
    root = ElementTree.fromstring(RobotModel(make_robot_scenario(), "s").description)
    source = ElementTree.fromstring((ARMS / "arm6.urdf").read_text())
    names = [link.get("name") for link in root.findall("link")]
    assert names == [f"s/{link.get('name')}" for link in source.findall("link")]
    assert [j.get("name") for j in root.findall("joint")] == [
        j.get("name") for j in source.findall("joint")
    ]
    arm = next(link for link in root.findall("link") if link.get("name") == "s/upper_arm")
    assert float(arm.find("visual/geometry/cylinder").get("length")) == pytest.approx(0.425)


def test_unlike_arms_end_where_sites_say():
    """A planar arm among chains has a model too, and bases stand where the scenario places them."""
    unlike = load_scenario("unlike_arms")
    for n, (site, spec) in enumerate(unlike.sites.items()):
        model = RobotModel(unlike, site)
        at = (0.0, 0.0, 0.0)
        turned = (0.0, 0.0, 0.0, 1.0)
        for origin, rotation in model.compute_transforms(spec.q0_rad):
            at = np.add(at, rotate_vector(turned, origin))
            turned = multiply_quaternions(turned, rotation)
        wanted = unlike.arms[site].shared_pose(spec.q0_rad)
        assert spec.task.scale * (at - [0.0, n * SPACING_M, 0.0]) == pytest.approx(
            wanted, abs=1e-12
        )
    assert model.frames[-1][1] == "s/" + reference_tip("arm7")


@pytest.mark.parametrize("name", ["play", "six_joints", "unlike_arms"])
def test_joint_states_name_the_joints_of_urdfs(name):
    """The moving joints of the URDF for viewers have the names in joint states, in their order."""
    whole = load_scenario(name)
    for site in whole.names:
        joints = ElementTree.fromstring(RobotModel(whole, site).description).iter("joint")
        moving = [joint.get("name") for joint in joints if joint.get("type") != "fixed"]
        assert moving == Ros2SiteChannels(whole, site).joints


def test_planar_arms_alone_have_no_model():
    assert Ros2SiteChannels(load_scenario("two_sites"), "m").robot is None


@given(
    rpy=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    axis=st.tuples(*[st.sampled_from([-1.0, 0.5, 2.0])] * 3),
    position_m=st.floats(-0.5, 0.5),
)
def test_sliding_joints_move_links_along_their_axis(rpy, axis, position_m):
    """The axis is that of the turned frame of the joint, and the orientation of the link stays."""
    joint = ElementTree.fromstring(
        '<joint name="slide" type="prismatic">'
        f'<origin xyz="0.1 -0.2 0.3" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"/>'
        f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/></joint>'
    )
    frame = _read_joint_frame(joint, ["slide"])
    origin, rotation = frame.compute_transform(position_m)
    assert rotation == frame.compute_transform(0.0)[1]
    slide = Rotation.from_euler("xyz", rpy).apply(np.array(axis) / np.linalg.norm(axis))
    assert origin == pytest.approx([0.1, -0.2, 0.3] + position_m * slide, abs=1e-12)

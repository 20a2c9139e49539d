"""Arms from URDF: the parsed arm against NumPy; refusals and their words."""

import copy
import json
import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.core.chain_references import ARMS, PATH, Array, chain_references, to_chain
from trilat_net.errors import ScenarioError
from trilat_net.scenario.urdf import CONSISTENCY, UrdfChain, UrdfPayload, read_urdf

ARM6, ARM7 = ((ARMS / f"arm{n}.urdf").read_text() for n in (6, 7))
BODY = (
    '<inertial><origin xyz="0.1 0 0"/><mass value="2"/>'
    '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="2" effort="30" velocity="4"/>'


def link_text(name: str, body: str = BODY) -> str:
    return f'<link name="{name}">{body}</link>'


def joint_text(
    name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0 0 0.5"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/>{inside}</joint>'
    )


def robot_text(*elements: str) -> str:
    return f'<robot name="r">{"".join(elements)}</robot>'


TWO = robot_text(
    link_text("base", ""),
    joint_text("one", "base", "upper"),
    link_text("upper"),
    joint_text("two", "upper", "lower"),
    link_text("lower"),
)
GRIPPER = robot_text(
    link_text("base", ""),
    joint_text("one", "base", "upper"),
    link_text("upper"),
    joint_text("mount", "upper", "camera", "fixed"),
    link_text("camera"),
    joint_text("two", "upper", "palm"),
    link_text("palm"),
    joint_text("left", "palm", "finger", "prismatic"),
    link_text("finger"),
    joint_text("right", "palm", "thumb", "prismatic", f'{LIMIT}<mimic joint="left"/>'),
    link_text("thumb"),
    joint_text("hand", "palm", "tcp", "fixed"),
    link_text("tcp", ""),
)


def refusal(text: str, **ends: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        read_urdf(text, **ends)
    return str(caught.value)


# What is read


@pytest.mark.parametrize(("text", "name", "n"), [(ARM6, "arm6", 6), (ARM7, "arm7", 7)])
def test_shipped_arms_equal_the_references(text: str, name: str, n: int) -> None:
    """Bit for bit: the references were made from these files."""
    chain = read_urdf(text)
    stored = chain_references()[name].chain
    assert (chain.tip, len(chain.joints), chain.notes) == ("flange", n, ())
    geometry = [
        (j.name, j.link, j.kind, j.axis, j.rotation, j.origin_m, j.inertia)
        for j in chain.joints
    ]
    assert geometry == [
        (j.name, j.link, j.kind, j.axis, j.rotation, j.origin_m, j.inertia)
        for j in stored.joints
    ]
    assert (chain.tip_rotation, chain.tip_origin_m) == (
        stored.tip_rotation,
        stored.tip_origin_m,
    )
    assert all(math.isfinite(j.effort_limit) and j.lower < j.upper for j in chain.joints)


def test_references_balance_power_and_position() -> None:
    """r'tau = (Y'r)'pi; the Jacobian's columns are r = z x (x - p), by NumPy; the file is small."""
    assert PATH.stat().st_size <= 200_000
    assert json.loads(PATH.read_text())["source"].startswith("Pinocchio")
    for chain, states in chain_references().values():
        pi = np.concatenate([j.inertia for j in chain.joints])
        for s in states:
            assert s.r @ s.inverse_dynamics == pytest.approx(
                s.regressor_transpose_r @ pi, rel=1e-12, abs=1e-12
            )
            x, R, axes = compute_pose(chain, s.q)
            assert np.abs(x - s.tip_position).max() < 1e-13
            assert np.abs(R - s.tip_rotation).max() < 1e-13
            for (kind, z, p), column in zip(axes, s.jacobian.T, strict=True):
                expected = [*np.cross(z, x - p), *z] if kind == "revolute" else [*z, 0, 0, 0]
                assert np.abs(column - expected).max() < 1e-13


def compute_pose(chain: UrdfChain, q: Array) -> tuple[Array, Array, list]:
    R = np.eye(3)
    x = np.zeros(3)
    axes = []
    for j, qi in zip(chain.joints, q, strict=True):
        x = x + R @ j.origin_m
        R = R @ np.array(j.rotation)
        axes.append((j.kind, R @ j.axis, x))
        if j.kind == "revolute":
            R = R @ rotate_about(np.array(j.axis), qi)
        else:
            x = x + R @ j.axis * qi
            axes[-1] = (j.kind, R @ j.axis, x)
    return x + R @ chain.tip_origin_m, R @ np.array(chain.tip_rotation), axes


def rotate_about(axis: Array, angle: float) -> Array:
    """Returns the rotation matrix by Rodrigues' formula."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def rotate_by_angles(angles: Array) -> Array:
    roll, pitch, yaw = angles
    x, y, z = np.eye(3)
    return rotate_about(z, yaw) @ rotate_about(y, pitch) @ rotate_about(x, roll)


def draw_points(random: np.random.Generator) -> tuple[Array, Array]:
    return random.uniform(0.1, 1.0, 6), random.normal(0.0, 0.2, (6, 3))


def compute_tensor(masses: Array, places: Array) -> Array:
    return sum(
        m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, places, strict=True)
    )


def list_moments(I: Array) -> list[float]:  # noqa: E741 - the symbol of an inertia
    return [I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]]


def inertia_text(masses: Array, places: Array, angles: Array) -> str:
    c = masses @ places / masses.sum()
    R = rotate_by_angles(angles)
    moments = list_moments(R.T @ compute_tensor(masses, places - c) @ R)
    keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
    inertia = " ".join(
        f'{key}="{float(moment)!r}"' for key, moment in zip(keys, moments, strict=True)
    )
    origin = f'xyz="{format_vector(c)}" rpy="{format_vector(angles)}"'
    mass = float(masses.sum())
    return (
        f'<inertial><origin {origin}/><mass value="{mass!r}"/><inertia {inertia}/></inertial>'
    )


def format_vector(vector: Array) -> str:
    return " ".join(repr(float(x)) for x in vector)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_fixed_links_are_lumped_and_frames_composed(seed: int) -> None:
    """Every body is a cloud of masses: the parsed body must have the cloud's own sums in the
    joint's frame.
    """
    random = np.random.default_rng(seed)
    angles = random.uniform(-3, 3, (6, 3))
    offsets = random.uniform(-1, 1, (6, 3))
    origins = [
        f'<origin xyz="{format_vector(x)}" rpy="{format_vector(a)}"/>'
        for x, a in zip(offsets, angles, strict=True)
    ]

    def edge(n: int, kind: str, parent: str, child: str) -> str:
        inside = f'{origins[n]}<parent link="{parent}"/><child link="{child}"/><axis xyz="0 3 4"/>{LIMIT}'
        return f'<joint name="j{n}" type="{kind}">{inside}</joint>'

    clouds = [draw_points(random) for _ in range(4)]
    text = robot_text(
        *(
            link_text(f"l{n}", "" if n in (0, 1) else inertia_text(*clouds[n - 2], angles[n]))
            for n in range(5)
        ),
        edge(0, "fixed", "l0", "l1"),
        edge(1, "revolute", "l1", "l2"),
        edge(2, "fixed", "l2", "l3"),
        edge(3, "revolute", "l2", "l4"),
        link_text("tip", ""),
        edge(4, "fixed", "l4", "tip"),
    )
    masses, places = clouds[3]
    c = masses @ places / masses.sum()
    load = UrdfPayload(
        float(masses.sum()), tuple(c), list_moments(compute_tensor(masses, places - c))
    )
    chain = read_urdf(text, tip="tip", payload=load)
    R = [rotate_by_angles(a) for a in angles]
    first, second = chain.joints
    assert np.abs(first.rotation - R[0] @ R[1]).max() < 1e-14
    assert np.abs(first.origin_m - (offsets[0] + R[0] @ offsets[1])).max() < 1e-14
    assert np.abs(second.rotation - R[3]).max() < 1e-14
    assert np.abs(chain.tip_rotation - R[4]).max() < 1e-14
    assert chain.tip_origin_m == tuple(offsets[4])
    assert second.axis == (0.0, 0.6, 0.8)
    for body, own, carried, n in (
        (first, clouds[0], clouds[1], 2),
        (second, clouds[2], clouds[3], 4),
    ):
        m = np.concatenate([own[0], carried[0]])
        p = np.concatenate([own[1], offsets[n] + carried[1] @ R[n].T])
        expected = [m.sum(), *(m @ p), *list_moments(compute_tensor(m, p))]
        assert np.abs(np.array(body.inertia) - expected).max() < 1e-13


def test_limits_friction_and_kinds() -> None:
    inside = f'{LIMIT}<dynamics damping="0.5" friction="0.25"/>'
    text = robot_text(
        link_text("base", ""),
        joint_text("one", "base", "a", "prismatic", inside),
        link_text("a"),
        joint_text("two", "a", "b", "continuous"),
        link_text("b"),
        joint_text("three", "b", "c", inside='<limit effort="0" velocity="0"/>'),
        link_text("c"),
        joint_text(
            "four",
            "c",
            "d",
            inside='<limit lower="-1e16" upper="1e16" effort="1e16" velocity="2"/>',
        ),
        link_text("d"),
    ).replace('<axis xyz="0 0 1"/><limit lower="-1e16"', '<limit lower="-1e16"')
    one, two, three, four = read_urdf(text).joints
    inf = math.inf
    assert (one.kind, one.lower, one.upper, one.effort_limit, one.velocity_limit) == (
        "prismatic",
        -1,
        2,
        30,
        4,
    )
    assert (one.viscous, one.coulomb, two.viscous, two.coulomb) == (0.5, 0.25, 0, 0)
    assert (two.kind, two.lower, two.upper, two.effort_limit) == ("revolute", -inf, inf, 30)
    assert three[7:11] == (-inf, inf, inf, inf)
    assert four[7:11] == (-inf, inf, inf, 2)
    assert four.axis == (1.0, 0.0, 0.0)  # of a joint that states none
    assert read_urdf(text).notes == (
        "joint 'three' states no limit of position and effort and velocity, or 0: it has no such limit",
    )


def test_grippers_are_held_at_zero_with_note() -> None:
    chain = read_urdf(GRIPPER, tip="tcp")
    assert [j.inertia[0] for j in chain.joints] == [4.0, 6.0]
    assert [re.findall("'(.*?)'", note) for note in chain.notes] == [
        ["left", "finger", "palm"],
        ["right", "thumb", "palm"],
    ]
    shorter = read_urdf(GRIPPER, tip="upper")
    assert [j.inertia[0] for j in shorter.joints] == [10.0]
    assert len(shorter.notes) == 3


def test_base_and_tip_within_a_robot() -> None:
    whole = read_urdf(ARM7)
    part = read_urdf(ARM7, base="link2", tip="link5")
    assert [j.name for j in part.joints] == ["joint3", "joint4", "joint5"]
    assert part.joints[:2] == whole.joints[2:4]  # not the fifth: it carries the rest
    assert part.tip_origin_m == (0.0, 0.0, 0.0)


def test_files_named_in_the_text_stay_closed() -> None:
    mesh = '<visual><geometry><mesh filename="package://nowhere/a.dae"/></geometry></visual>'
    assert read_urdf(
        TWO.replace('<link name="upper">', f'<link name="upper">{mesh}')
    ) == read_urdf(TWO)


# What is refused


def test_thirteen_joints_are_one_too_many() -> None:
    def arm(n: int) -> str:
        edges = [joint_text(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(n)]
        return robot_text(*edges, *(link_text(f"l{i}") for i in range(n + 1)))

    assert len(read_urdf(arm(12)).joints) == 12
    assert "13 joints" in refusal(arm(13))


def test_hostile_texts_are_refused_at_once() -> None:
    bomb = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>\n<robot>&b;</robot>'
    assert "line 1" in refusal(bomb)
    deep = "<link>" * 60_000 + "</link>" * 60_000
    assert "link number 1" in refusal(f"<robot>{deep}</robot>")
    assert "1000000" in refusal(" " * 1_000_001)
    assert "line 1" in refusal("<robot>\x00</robot>")
    assert "XML" in refusal("<robot>\ud800</robot>")
    long = refusal(TWO.replace('"upper"', f'"{"u" * 5000}"', 1).replace('"lower"', '"x"'))
    assert len(long) < 400
    mass = refusal(TWO.replace('mass value="', f'mass value="{"1" * 50_000}x', 1))
    assert "must be a finite number" in mass  # which took a minute and a half, digit by digit
    assert len(mass) < 400
    links = "".join(link_text(f"l{n}") for n in range(2000))
    ring = "".join(joint_text(f"j{n}", f"l{n}", f"l{(n + 1) % 2000}") for n in range(2000))
    assert "loop" in refusal(f"<robot>{links}{ring}</robot>")


# Mutations of good files

_NASTY = st.sampled_from(
    [
        "",
        "x",
        "nan",
        "-inf",
        "1e309",
        "1e-320",
        "0",
        "-1",
        "-0.0",
        "1 2",
        "0 0 0",
        "1,5",
        "١",
        "base",
        "link3",
    ]
)


def mutate_element(root: ElementTree.Element, data: st.DataObject) -> None:
    """Drops, doubles, garbles or scales one element or attribute."""
    parents = [e for e in root.iter() if len(e)]
    parent = data.draw(st.sampled_from(parents))
    child = data.draw(st.sampled_from(list(parent)))
    kind = data.draw(
        st.sampled_from(["drop", "double", "tag", "attribute", "attribute", "number", "number"])
    )
    if kind == "drop":
        parent.remove(child)
    elif kind == "double":
        parent.append(copy.deepcopy(child))
    elif kind == "tag":
        child.tag = data.draw(
            st.sampled_from(["inertial", "joint", "link", "mass", "origin", "x"])
        )
    elif child.attrib:
        key = data.draw(st.sampled_from(sorted(child.attrib)))
        if kind == "number":
            numbers = child.attrib[key].split()
            n = data.draw(st.integers(0, len(numbers) - 1)) if numbers else 0
            factor = data.draw(st.sampled_from([-1.0, 0.0, 1e-9, 0.5, 1.5, 3.0, 1e3, 1e200]))
            if re.fullmatch(r"-?[\d.e-]+", "".join(numbers[n : n + 1])):
                numbers[n] = repr(float(numbers[n]) * factor)
            child.set(key, " ".join(numbers))
        elif data.draw(st.booleans()):
            del child.attrib[key]
        else:
            child.set(key, data.draw(_NASTY))


def garble_text(text: str, data: st.DataObject) -> str:
    """Cuts out a stretch of the text, or inserts characters."""
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 80)))
    return text[:start] + data.draw(st.text('<>/="& \n.0-eé\x00', max_size=4)) + text[end:]


def check_physical(chain: UrdfChain) -> None:
    """Asserts a physical chain: bodies with a positive pseudo-inertia, right-handed frames,
    limits in order.
    """
    assert 1 <= len(chain.joints) <= 12
    for j in chain.joints:
        assert all(map(math.isfinite, (*j.axis, *j.origin_m, *j.inertia, j.viscous, j.coulomb)))
        m, x, y, z, xx, xy, yy, xz, yz, zz = j.inertia
        c = np.array([x, y, z]) / m
        moments = np.linalg.eigvalsh(
            np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            - m * (c @ c * np.eye(3) - np.outer(c, c))
        )
        assert m > 0.0
        assert moments[0] > 0.0
        assert moments[0] + moments[1] >= moments[2] * (1 - 10 * CONSISTENCY)
        R = np.array(j.rotation)
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
        assert np.linalg.det(R) > 0.0
        assert np.linalg.norm(j.axis) == pytest.approx(1.0, abs=1e-15)
        assert j.lower < j.upper
        assert min(j.effort_limit, j.velocity_limit) > 0.0
        assert min(j.viscous, j.coulomb) >= 0.0


@given(data=st.data(), source=st.sampled_from([(ARM6, ""), (ARM7, ""), (GRIPPER, "tcp")]))
@settings(max_examples=200)
def test_mutated_files_are_refused_or_physical(data: st.DataObject, source: tuple) -> None:
    text, tip = source
    if data.draw(st.booleans()):
        text = garble_text(text, data)
    else:
        root = ElementTree.fromstring(text)
        mutate_element(root, data)
        text = ElementTree.tostring(root, encoding="unicode")
    try:
        chain = read_urdf(text, tip=tip)
    except ScenarioError as error:
        message = str(error)
    else:
        check_physical(chain)
        return
    assert re.search(r"\b(link|links|joint|line|tip)\b|<\w+>", message)


def test_the_chains_of_the_references_are_physical() -> None:
    for entry in json.loads(PATH.read_text())["chains"].values():
        check_physical(to_chain(entry))

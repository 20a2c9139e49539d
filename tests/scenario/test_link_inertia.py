"""Masses and inertias of a scenario in place of a URDF's, balanced ones, and links off the way
to the tip.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scenario.builders import make_six_joint_scenario
from trilat_net.core.arms.chain import Matrix
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario, parse_embedded
from trilat_net.scenario.describe import describe_scenario
from trilat_net.scenario.link_inertia import LinkInertia, balance_tensor, fill_tensor
from trilat_net.scenario.urdf import UrdfChain, read_urdf

ROBOTS = Path(__file__).with_name("robots")
FINGER, SHAPES = (
    (ROBOTS / f"{name}.urdf").read_text() for name in ("finger_inertia", "kinematics_only")
)
IMPOSSIBLE = '<inertia ixx="1e-7" ixy="0" ixz="0" iyy="1.4e-6" iyz="0" izz="4e-6"/>'
TWO_SITES = {
    "name": "arm",
    "duration_s": 0.5,
    "control": {"law": "p_d", "K": 10.0, "d": 2.0},
    "link": {"delay_ms": 50.0},
    "sites": {"m": {}, "s": {"role": "slave"}},
    "dominance": {"m": {"s": 1.0}, "s": {"m": 1.0}},
}
YAW = {"mass_kg": 0.5, "inertia_kg_m2": [1e-2, 0.0, 1e-2, 0.0, 0.0, 1e-2]}


def make_arm_scenario(text: str, arm: dict[str, Any], **sites: Any) -> Scenario:
    """Returns a scenario of two arms of the given kind."""
    tables = {
        **TWO_SITES,
        "arm": {"urdf": "robot.urdf", "armature_kg_m2": 0.1, **arm},
        "urdf": {"robot.urdf": text},
        "sites": {"m": sites.get("m", {}), "s": {"role": "slave", **sites.get("s", {})}},
    }
    return load_scenario(tables)


def finger_text(**inertial: Any) -> str:
    """Returns the arm whose finger has another <inertial>."""
    body = '<mass value="0.02"/>' + IMPOSSIBLE
    assert body in FINGER
    return FINGER.replace(body, inertial["body"]).replace(
        'name="grip" type="prismatic"',
        f'name="grip" type="{inertial.get("kind", "prismatic")}"',
    )


def compute_moments(tensor: Matrix) -> list[float]:
    return [float(x) for x in np.linalg.eigvalsh(np.array(tensor))]


def body_moments(chain: UrdfChain, joint: int) -> list[float]:
    """Returns the principal moments of the bodies that a joint moves, about their centre of mass."""
    m, *first = chain.joints[joint].inertia[:4]
    c = np.array(first) / m
    about = np.array(fill_tensor(chain.joints[joint].inertia[4:]))
    return [
        float(x) for x in np.linalg.eigvalsh(about - m * (c @ c * np.eye(3) - np.outer(c, c)))
    ]


# A link that does not lead to the end link


def test_impossible_finger_inertia_is_lumped_with_note() -> None:
    chain = read_urdf(FINGER, tip="lower")
    assert [joint.name for joint in chain.joints] == ["shoulder", "elbow"]
    assert chain.joints[1].inertia[0] == 1.02
    assert chain.joints[1].inertia[4] == pytest.approx(
        0.01 + 1.0 * 0.1**2 + 1e-7 + 0.02 * 0.3**2
    )
    lumped, counted = chain.notes
    assert "'grip' does not lead to the end link" in lumped
    assert "'finger' does not lead to the end link and counts as stated" in counted
    assert "arm.balance_inertia = true" in counted


@pytest.mark.parametrize(
    ("body", "kind", "mass_kg", "note"),
    [
        ('<mass value="0.02"/>' + IMPOSSIBLE, "revolute", 1.02, "counts as stated"),
        ('<mass value="0.02"/>' + IMPOSSIBLE, "floating", 1.02, "held at zero"),
        ('<mass value="0.02"/>' + IMPOSSIBLE, "planar", 1.02, "held at zero"),
        ('<mass value="0.02"/>' + IMPOSSIBLE, "fixed", 1.02, "counts as stated"),
        (
            '<mass value="0.02"/>' + IMPOSSIBLE.replace('"4e-6', '"-4e-6'),
            "revolute",
            1.02,
            "as stated",
        ),
        (
            '<mass value="0.02"/>' + IMPOSSIBLE.replace('"4e-6', '"4e-1'),
            "revolute",
            1.02,
            "a point of 0.02 kg",
        ),
        (
            '<mass value="0.02"/>' + IMPOSSIBLE.replace('"4e-6', '"-4e-1'),
            "revolute",
            1.02,
            "as a point",
        ),
        (
            '<mass value="0.02"/>',
            "revolute",
            1.02,
            "states a mass and no inertia: a point of 0.02 kg",
        ),
        (
            '<mass value="-0.02"/>' + IMPOSSIBLE,
            "revolute",
            1.0,
            "left out: its mass must not be negative, but is -0.02 kg",
        ),
        (
            '<mass value="0"/>' + IMPOSSIBLE,
            "revolute",
            1.0,
            "left out: has moments of inertia but no mass",
        ),
        (IMPOSSIBLE, "revolute", 1.0, "left out: its <inertial> has no <mass>"),
        ("", "revolute", 1.0, "left out"),
    ],
)
def test_side_links_never_make_arms_unusable(
    body: str, kind: str, mass_kg: float, note: str
) -> None:
    chain = read_urdf(finger_text(body=body, kind=kind), tip="lower")
    assert chain.joints[1].inertia[0] == mass_kg
    assert any(note in text for text in chain.notes)
    least, middle, most = body_moments(chain, 1)
    assert least > 0.0
    assert most <= (least + middle) * (1.0 + 1e-6)


def test_a_finger_as_end_link_is_refused() -> None:
    with pytest.raises(ScenarioError) as refused:
        make_arm_scenario(FINGER, {})
    assert refused.value.path == "arm.urdf"
    for word in (
        "'finger'",
        "arm.balance_inertia = true",
        "[arm.links.finger]",
        "arm.tip = 'lower'",
    ):
        assert word in str(refused.value)
    assert len(make_arm_scenario(FINGER, {"balance_inertia": True}).arms["m"].joint_names) == 3
    given = {"links": {"finger": {"inertia_kg_m2": [1e-6, 0, 1e-6, 0, 0, 1e-6]}}}
    assert len(make_arm_scenario(FINGER, given).arms["m"].joint_names) == 3
    assert len(make_arm_scenario(FINGER, {"tip": "lower"}).arms["m"].joint_names) == 2


# Balancing

ENTRY = st.floats(-1.0, 1.0)


@given(st.tuples(*[ENTRY] * 6))
def test_balanced_inertia_is_the_nearest_body(entries: tuple[float, ...]) -> None:
    """Against the projection of the second moments of mass by NumPy's eigenvectors."""
    tensor = fill_tensor(entries)
    balanced = balance_tensor(tensor)
    inertia = np.array(tensor)
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    values, axes = np.linalg.eigh(second)
    nearest = axes @ np.diag(np.maximum(values, 0.0)) @ axes.T
    expected = np.trace(nearest) * np.eye(3) - nearest
    assert np.abs(np.array(balanced) - expected).max() < 1e-12
    least, middle, most = compute_moments(balanced)
    assert least >= -1e-12
    assert most <= least + middle + 1e-12
    assert np.abs(np.array(balance_tensor(balanced)) - balanced).max() < 1e-12


def test_balancing_keeps_the_largest_moment() -> None:
    possible = fill_tensor((2.0, 0.1, 2.5, 0.2, -0.1, 3.0))
    assert balance_tensor(possible) is possible
    chain = read_urdf(FINGER, balance=True)
    assert body_moments(chain, 2) == pytest.approx([1.35e-6, 2.65e-6, 4e-6])
    assert "balanced to 1.35e-06, 2.65e-06 and 4e-06" in chain.notes[0]


# Masses and inertias of a scenario


def test_shapes_without_masses_become_arms() -> None:
    with pytest.raises(
        ScenarioError, match=r"'yaw'.*give mass_kg and inertia_kg_m2 in \[arm.links.yaw\]"
    ):
        make_arm_scenario(SHAPES, {})
    with pytest.raises(ScenarioError, match=r"'yaw'.*give inertia_kg_m2 in \[arm.links.yaw\]"):
        make_arm_scenario(SHAPES, {"links": {"yaw": {"mass_kg": 0.5}}})
    scenario = make_arm_scenario(SHAPES, {"links": {"yaw": YAW}})
    assert scenario.arms["m"].joint_names == ("outer_yaw", "insertion")
    assert scenario.arms["m"].theta[:10].tolist() == [0.5, 0, 0, 0, 1e-2, 0, 1e-2, 0, 0, 1e-2]
    assert scenario.arms["m"].theta[10] == 0.3


TURNED = FINGER.replace(
    '<origin xyz="0 0 0.1"/><mass', '<origin xyz="0 0 0.1" rpy="0 0 1.5707963"/><mass'
)
TURNED = TURNED.replace('ixx="0.01"', 'ixx="0.005"')


def test_omitted_keys_keep_the_files_value() -> None:
    """The axes of the file's tensor stay turned; a tensor of the scenario stands in the link's axes."""

    def upper(**given: Any) -> list[float]:
        return list(
            read_urdf(TURNED, tip="lower", links={"upper": LinkInertia(**given)})
            .joints[0]
            .inertia
        )

    m = 2.0
    c = (0.1, 0.0, 0.2)
    about = [0.01, 0, 0.005, 0, 0, 0.01]  # turned by a right angle about z

    def shifted(mass: float, com: tuple[float, ...], own: list[float]) -> list[float]:
        x, y, z = com
        steiner = [y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y]
        tensor = [a + mass * b for a, b in zip(own, steiner, strict=True)]
        return [mass, *(mass * k for k in com), *tensor]

    assert upper(mass_kg=m) == pytest.approx(shifted(m, (0, 0, 0.1), about), abs=1e-9)
    assert upper(com_m=c) == pytest.approx(shifted(1.0, c, about), abs=1e-9)
    own = (0.02, 0.0, 0.03, 0.0, 0.0, 0.04)
    assert upper(inertia_kg_m2=own) == pytest.approx(
        shifted(1.0, (0, 0, 0.1), list(own)), abs=1e-9
    )
    assert upper(mass_kg=m, com_m=c, inertia_kg_m2=own) == pytest.approx(
        shifted(m, c, list(own))
    )


def test_a_mass_of_zero_leaves_a_link_out() -> None:
    chain = read_urdf(FINGER, tip="lower", links={"finger": LinkInertia(mass_kg=0.0)})
    assert chain.joints[1].inertia[0] == 1.0
    assert "link 'finger': the scenario leaves its mass out" in chain.notes


def test_links_without_mass_in_files_need_one() -> None:
    with pytest.raises(ScenarioError) as refused:
        make_arm_scenario(SHAPES, {"links": {"yaw": {"com_m": [0.0, 0.0, 0.1]}}})
    assert refused.value.path == "sites.m.arm.links.yaw.mass_kg"


# The text of a scenario


def test_link_keys_enter_text_and_hash() -> None:
    scenario = make_arm_scenario(SHAPES, {"links": {"yaw": YAW}})
    assert parse_embedded(scenario.text) == scenario
    assert "[sites.m.arm.links.yaw]\nmass_kg = 0.5\n" in scenario.text
    heavier = load_scenario(scenario, {"arm.links.yaw.mass_kg": 0.6})
    assert heavier.arms["s"].theta[0] == 0.6
    assert heavier.sha256 != scenario.sha256
    assert load_scenario(heavier, {"arm.links.yaw.mass_kg": 0.5}).sha256 == scenario.sha256
    assert "arm.links" not in make_six_joint_scenario().text
    assert "balance" not in make_six_joint_scenario().text


def test_overrides_reach_links_of_arms() -> None:
    scenario = make_arm_scenario(FINGER, {"tip": "lower"})
    changed = load_scenario(
        scenario,
        [
            "arm.links.finger.mass_kg=0.03",
            "sites.s.arm.links.finger.mass_kg=0.04",
            "arm.balance_inertia=true",
        ],
    )
    assert [changed.arms[name].theta[10] for name in "ms"] == [1.03, 1.04]
    moved = load_scenario(changed, ["sites.m.arm.links.finger.com_m=[0.0,0.0,0.1]"])
    moved = load_scenario(moved, ["sites.m.arm.links.finger.com_m.2=0.2"])
    assert moved.sites["m"].arm.links["finger"].com_m == (0.0, 0.0, 0.2)
    with pytest.raises(ScenarioError, match=r"arm\.lnks"):
        load_scenario(scenario, ["arm.lnks.finger.mass_kg=1"])


def test_sites_mend_links_beyond_their_group() -> None:
    """Also for names that TOML quotes, and for drawn numbers."""
    text = SHAPES.replace('"tool"', '"tool.1"')
    shared = {"yaw": YAW, "tool.1": {"mass_kg": 0.4}}
    tables = {
        "arm": {
            "links": {
                "tool.1": {"com_m": [0.0, 0.0, 0.1]},
                "yaw": {"mass_kg": {"normal": [1, 0.1]}},
            }
        }
    }
    scenario = make_arm_scenario(text, {"links": shared}, s=tables)
    m, s = (scenario.sites[name].arm.links for name in "ms")
    assert m["tool.1"] == LinkInertia(mass_kg=0.4)
    assert s["tool.1"] == LinkInertia(mass_kg=0.4, com_m=(0.0, 0.0, 0.1))
    assert s["yaw"].mass_kg != 1.0
    assert s["yaw"].inertia_kg_m2 == m["yaw"].inertia_kg_m2
    assert "sites.s.arm.links.yaw.mass_kg" in scenario.drawn
    assert parse_embedded(scenario.text) == scenario


def test_differences_from_the_file_are_listed() -> None:
    scenario = make_arm_scenario(
        FINGER, {"tip": "lower", "links": {"upper": {"mass_kg": 2.0}}}, m={"q0_rad": [2.1, 0]}
    )
    notes = scenario.list_arm_notes()
    assert any("arm of m, s: link 'upper': mass_kg of the scenario" in note for note in notes)
    assert any("arm of m, s: link 'finger' does not lead" in note for note in notes)
    assert any("m starts 0.1 rad beyond a stop of joint shoulder" in note for note in notes)
    described = "\n".join(describe_scenario(scenario))
    assert all(note.partition(": ")[2] in described for note in notes[:-1])
    assert re.search(r"^note: m starts 0\.1 rad beyond", described, re.M)

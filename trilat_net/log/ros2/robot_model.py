"""The arm of a site for viewers: its URDF and the frames of its links at any joint angles.

Invariant:
    - The frame of a link is named "<site>/<link>" in the URDF and in the transforms, so that
      the arms of a session appear side by side below `WORLD`.
    - A URDF without shapes gets plain shapes; no file of shapes is opened.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ...scenario import Scenario
from ...scenario.arms import read_arm
from .cdr import DEFINITIONS, TransformPacker

WORLD = "world"
SPACING_M = 1.5
"""Distance between the bases of consecutive sites, in m."""
_RADIUS_M = 0.035
_SHAPE_COLOURS = ("0 0.27 0.53 1", "0.73 0.33 0.4 1", "0.87 0.67 0.2 1", "0.4 0.4 0.4 1")

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""Quaternion in the order x, y, z, w."""


class _JointFrame(NamedTuple):
    """Frame of a joint's link in its parent.

    Attributes:
        origin_m: origin at q = 0, in m.
        rotation: rotation at q = 0.
        axis: axis of the joint, a unit vector.
        slides: True for a prismatic joint.
        index: index of the joint in q; -1 for a joint that does not move, such as a finger.
    """

    origin_m: Vector
    rotation: Quaternion
    axis: Vector
    slides: bool
    index: int


def multiply_quaternions(a: Quaternion, b: Quaternion) -> Quaternion:
    """Returns the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate_vector(q: Quaternion, a: Vector) -> Vector:
    """Returns the vector `a` rotated by the quaternion `q`."""
    x, y, z, w = q
    conjugate = (-x, -y, -z, w)
    bx, by, bz, _ = multiply_quaternions(multiply_quaternions(q, (*a, 0.0)), conjugate)
    return bx, by, bz


def _rotate_about_axis(axis: Vector, angle: float) -> Quaternion:
    """Returns the rotation by an angle, in rad, about a unit vector."""
    s = math.sin(angle / 2.0)
    return axis[0] * s, axis[1] * s, axis[2] * s, math.cos(angle / 2.0)


def compute_quaternion(rotation_vector: Vector) -> Quaternion:
    """Returns the quaternion of a rotation vector, in rad."""
    angle = math.hypot(*rotation_vector)
    if not angle:
        return _rotate_about_axis((1.0, 0.0, 0.0), angle)
    x, y, z = rotation_vector
    return _rotate_about_axis((x / angle, y / angle, z / angle), angle)


def _rotate_upright(down: Sequence[float]) -> Quaternion:
    """Returns the shortest rotation that turns the direction `down` to (0, 0, -1)."""
    size = math.hypot(*down)
    x, y, z = (coordinate / size for coordinate in down)
    # `down` points upwards: the axis is not unique, and the arm is turned about x.
    if z > 1.0 - 1e-12:
        return 1.0, 0.0, 0.0, 0.0
    # The axis is the cross product of both directions, (-y, x, 0); w is 1 plus their cosine.
    length = math.sqrt(x * x + y * y + (1.0 - z) ** 2)
    return -y / length, x / length, 0.0, (1.0 - z) / length


_PLANAR = (DEFINITIONS / "planar.urdf").read_text(encoding="utf-8")
"""URDF of the planar arm, with the lengths of its links as placeholders."""


class RobotModel:
    """The arm of one site as a chain of links, from its URDF or from the planar arm.

    Args:
        scenario: the scenario.
        site: the site.

    Attributes:
        description: text of the URDF, whose links are named "<site>/<link>".
        frames: pairs of parent frame and child frame, beginning with `WORLD`.
        shared: origin, in m, and rotation in `WORLD` of the frame that the sites share.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        spec = scenario.sites[site].arm
        names = scenario.arms[site].joint_names
        base = "base"
        text = _PLANAR.format(l1_m=spec.l1_m, l2_m=spec.l2_m)
        if spec.urdf:
            base = read_arm(spec, scenario.urdf).base
            text = scenario.urdf[spec.urdf]
        x, y, z = spec.down if spec.urdf else (0.0, -1.0, 0.0)
        root = ElementTree.fromstring(text)
        child_joints: dict[str, list[Element]] = {}
        for joint in root.findall("joint"):
            child_joints.setdefault(_read_link_name(joint, "parent"), []).append(joint)
        self.frames = [(WORLD, f"{site}/{base}")]
        self._joints: list[_JointFrame] = []
        # Breadth-first search: the list of links grows during the iteration.
        links = [base]
        for link in links:
            for joint in child_joints.get(link, ()):
                child = _read_link_name(joint, "child")
                links.append(child)
                self.frames.append((f"{site}/{link}", f"{site}/{child}"))
                self._joints.append(_read_joint_frame(joint, names))
        base_rotation = _rotate_rpy(spec.base_rpy_rad)
        upright = _rotate_upright(rotate_vector(base_rotation, (x, y, z)))
        x, y, z = spec.base_xyz_m
        x, y, z = rotate_vector(upright, (x, y, z))
        site_index = scenario.names.index(site)
        offset_m = SPACING_M * site_index
        self.shared = ((0.0, offset_m, 0.0), upright)
        base_origin_m = (x, y + offset_m, z)
        self._base = (base_origin_m, multiply_quaternions(upright, base_rotation))
        self.description = _render_urdf(root, site, site_index)
        self._packer = TransformPacker(self.frames)

    def transforms(self, q: Sequence[float]) -> list[tuple[Vector, Quaternion]]:
        """Returns origin, in m, and rotation of each frame in its parent at the positions q."""
        frames = [self._base]
        for origin, rotation, axis, slides, index in self._joints:
            value = q[index] if index >= 0 else 0.0
            if slides:
                x, y, z = rotate_vector(rotation, axis)
                origin = (origin[0] + value * x, origin[1] + value * y, origin[2] + value * z)
            elif value:
                rotation = multiply_quaternions(rotation, _rotate_about_axis(axis, value))
            frames.append((origin, rotation))
        return frames

    def pack(self, stamp_ns: int, q: Sequence[float]) -> bytes:
        """Returns the transforms at the positions q as one message.

        Args:
            stamp_ns: Unix time of the message, in ns, 0 or more.
            q: joint positions, in rad or m.
        """
        return self.pack_transforms(stamp_ns, self.transforms(q))

    def pack_transforms(
        self, stamp_ns: int, transforms: Iterable[tuple[Sequence[float], Sequence[float]]]
    ) -> bytes:
        """Returns transforms as one message.

        Args:
            stamp_ns: Unix time of the message, in ns, 0 or more.
            transforms: for each frame, origin in m and quaternion x, y, z, w.
        """
        numbers = [x for origin, rotation in transforms for x in (*origin, *rotation)]
        return self._packer.pack(stamp_ns, numbers)


def _rotate_rpy(rpy: Sequence[float]) -> Quaternion:
    """Returns the rotation by roll, pitch and yaw, in rad, in the convention of URDF."""
    roll, pitch, yaw = rpy
    rotation = multiply_quaternions(
        _rotate_about_axis((0.0, 0.0, 1.0), yaw), _rotate_about_axis((0.0, 1.0, 0.0), pitch)
    )
    return multiply_quaternions(rotation, _rotate_about_axis((1.0, 0.0, 0.0), roll))


def _read_link_name(joint: Element, end: str) -> str:
    """Returns the name of a joint's link at its end `parent` or `child`; "" if missing."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _read_vector(element: Element | None, key: str, absent: Vector) -> Vector:
    """Returns an attribute with three numbers; `absent` if missing or not three finite numbers.

    Branches that are not part of the arm may have invalid numbers, because nothing checks them.
    """
    text = "" if element is None else element.get(key, "")
    try:
        x, y, z = map(float, text.split())
    except ValueError:
        return absent
    return (x, y, z) if math.isfinite(x + y + z) else absent


def _read_joint_frame(joint: Element, names: Sequence[str]) -> _JointFrame:
    """Returns the frame of a joint, consistent with `read_urdf`."""
    name = joint.get("name", "")
    origin = joint.find("origin")
    rotation = _rotate_rpy(_read_vector(origin, "rpy", (0.0, 0.0, 0.0)))
    axis = _read_vector(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
    size = math.hypot(*axis) or 1.0
    unit = (axis[0] / size, axis[1] / size, axis[2] / size)
    index = names.index(name) if name in names else -1
    return _JointFrame(
        origin_m=_read_vector(origin, "xyz", (0.0, 0.0, 0.0)),
        rotation=rotation,
        axis=unit,
        slides=joint.get("type") == "prismatic",
        index=index,
    )


def _render_urdf(root: Element, site: str, number: int) -> str:
    """Returns the URDF text with links named "<site>/<link>"; modifies `root`."""
    lacks_shapes = root.find("link/visual") is None
    colour = _SHAPE_COLOURS[number % len(_SHAPE_COLOURS)]
    links = {link.get("name", ""): link for link in root.findall("link")}
    for joint in root.findall("joint"):
        parent = links.get(_read_link_name(joint, "parent"))
        if lacks_shapes and parent is not None:
            joint_origin = _read_vector(joint.find("origin"), "xyz", (0.0, 0.0, 0.0))
            _add_shape(parent, joint_origin, colour, site)
        for end in ("parent", "child"):
            element = joint.find(end)
            if element is not None:
                element.set("link", f"{site}/{element.get('link', '')}")
    for name, link in links.items():
        link.set("name", f"{site}/{name}")
    return ElementTree.tostring(root, encoding="unicode")


def _add_shape(link: Element, end: Vector, colour: str, site: str) -> None:
    """Adds a cylinder from a link's origin to `end`, in m, or a sphere if both coincide."""
    visual = ElementTree.SubElement(link, "visual")
    length = math.hypot(*end)
    middle = " ".join(f"{coordinate / 2.0:.9g}" for coordinate in end)
    pitch = math.atan2(math.hypot(end[0], end[1]), end[2])
    yaw = math.atan2(end[1], end[0])
    ElementTree.SubElement(visual, "origin", xyz=middle, rpy=f"0 {pitch:.9g} {yaw:.9g}")
    geometry = ElementTree.SubElement(visual, "geometry")
    if length > 0.0:
        ElementTree.SubElement(
            geometry, "cylinder", radius=f"{_RADIUS_M:g}", length=f"{length:.9g}"
        )
    else:
        ElementTree.SubElement(geometry, "sphere", radius=f"{1.2 * _RADIUS_M:g}")
    material = ElementTree.SubElement(visual, "material", name=f"{site}_plain")
    ElementTree.SubElement(material, "color", rgba=colour)

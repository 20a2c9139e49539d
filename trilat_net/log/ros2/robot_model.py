"""An arm for viewers: its URDF with names of its own, and the frames of its links at every
time.

Invariant: the frame of a link is called "<site>/<link>", in the URDF as in the transforms, so
that arms of one file stand beside each other below `WORLD`. A file without shapes gets plain
ones; none is opened.
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
"""From the base of a site to that of the next."""
_RADIUS_M = 0.035
_SHAPE_COLOURS = ("0 0.27 0.53 1", "0.73 0.33 0.4 1", "0.87 0.67 0.2 1", "0.4 0.4 0.4 1")

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""


class _JointFrame(NamedTuple):
    """A joint: where its link is, and which number of q moves it; -1 for none, as of fingers."""

    origin_m: Vector
    turned: Quaternion
    axis: Vector
    slides: bool
    place: int


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
    """Returns a vector turned by a quaternion."""
    x, y, z, w = q
    conjugate = (-x, -y, -z, w)
    bx, by, bz, _ = multiply_quaternions(multiply_quaternions(q, (*a, 0.0)), conjugate)
    return bx, by, bz


def _about(axis: Vector, angle: float) -> Quaternion:
    s = math.sin(angle / 2.0)
    return axis[0] * s, axis[1] * s, axis[2] * s, math.cos(angle / 2.0)


def compute_quaternion(turn: Vector) -> Quaternion:
    """Returns the rotation by a rotation vector, rad."""
    angle = math.hypot(*turn)
    x, y, z = (one / angle for one in turn) if angle else (1.0, 0.0, 0.0)
    return _about((x, y, z), angle)


def _upright(down: Sequence[float]) -> Quaternion:
    size = math.hypot(*down)
    x, y, z = (each / size for each in down)
    if z > 1.0 - 1e-12:
        return 1.0, 0.0, 0.0, 0.0
    # the axis is the product of both directions, (-y, x, 0), and w is 1 plus their cosine
    length = math.sqrt(x * x + y * y + (1.0 - z) ** 2)
    return -y / length, x / length, 0.0, (1.0 - z) / length


_PLANAR = (DEFINITIONS / "planar.urdf").read_text(encoding="utf-8")
"""The planar arm as a chain."""


class RobotModel:
    """The arm of one site that is a chain: that of its URDF, or the planar one.

    Attributes:
        description: the URDF, with the names of its links after the site.
        frames: pairs of frames: parent and child, from `WORLD` on.
        shared: where in `WORLD` the frame is in which the base of the arm is placed.
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
        below: dict[str, list[Element]] = {}
        for joint in root.findall("joint"):
            below.setdefault(_link_of(joint, "parent"), []).append(joint)
        self.frames = [(WORLD, f"{site}/{base}")]
        self._joints: list[_JointFrame] = []
        reached = [base]
        for link in reached:  # it grows
            for joint in below.get(link, ()):
                child = _link_of(joint, "child")
                reached.append(child)
                self.frames.append((f"{site}/{link}", f"{site}/{child}"))
                self._joints.append(_read_frame(joint, names))
        own = _turned(spec.base_rpy_rad)
        upright = _upright(rotate_vector(own, (x, y, z)))
        x, y, z = spec.base_xyz_m
        x, y, z = rotate_vector(upright, (x, y, z))
        beside_m = SPACING_M * scenario.names.index(site)
        self.shared = ((0.0, beside_m, 0.0), upright)
        place = (x, y + beside_m, z)
        self._base = (place, multiply_quaternions(upright, own))
        self.description = _describe(root, site, scenario.names.index(site))
        self._packer = TransformPacker(self.frames)

    def transforms(self, q: Sequence[float]) -> list[tuple[Vector, Quaternion]]:
        """Returns where each frame is in its parent: its origin, m, and its rotation."""
        found = [self._base]
        for origin, turned, axis, slides, place in self._joints:
            moved = q[place] if place >= 0 else 0.0
            if slides:
                x, y, z = rotate_vector(turned, axis)
                origin = (origin[0] + moved * x, origin[1] + moved * y, origin[2] + moved * z)
            elif moved:
                turned = multiply_quaternions(turned, _about(axis, moved))
            found.append((origin, turned))
        return found

    def pack(self, stamp_ns: int, q: Sequence[float]) -> bytes:
        """Returns the transforms of a time (Unix ns, not below 0) at positions q as one
        message.
        """
        return self.pack_transforms(stamp_ns, self.transforms(q))

    def pack_transforms(
        self, stamp_ns: int, transforms: Iterable[tuple[Sequence[float], Sequence[float]]]
    ) -> bytes:
        """Returns the transforms of a time as one message: origins, m, and quaternions x, y, z,
        w.
        """
        numbers = [x for origin, turned in transforms for x in (*origin, *turned)]
        return self._packer.pack(stamp_ns, numbers)


def _turned(rpy: Sequence[float]) -> Quaternion:
    roll, pitch, yaw = rpy
    turned = multiply_quaternions(_about((0.0, 0.0, 1.0), yaw), _about((0.0, 1.0, 0.0), pitch))
    return multiply_quaternions(turned, _about((1.0, 0.0, 0.0), roll))


def _link_of(joint: Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else found.get("link", "")


def _vector(element: Element | None, key: str, absent: Vector) -> Vector:
    """Returns three numbers; what is none in a branch that is no part of the arm counts as
    absent.
    """
    try:
        x, y, z = map(float, ("" if element is None else element.get(key, "")).split())
    except ValueError:
        return absent
    return (x, y, z) if math.isfinite(x + y + z) else absent


def _read_frame(joint: Element, names: Sequence[str]) -> _JointFrame:
    """Returns a joint as `read_urdf` has taken it."""
    name = joint.get("name", "")
    origin = joint.find("origin")
    turned = _turned(_vector(origin, "rpy", (0.0, 0.0, 0.0)))
    axis = _vector(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
    size = math.hypot(*axis) or 1.0
    unit = (axis[0] / size, axis[1] / size, axis[2] / size)
    place = names.index(name) if name in names else -1
    return _JointFrame(
        origin_m=_vector(origin, "xyz", (0.0, 0.0, 0.0)),
        turned=turned,
        axis=unit,
        slides=joint.get("type") == "prismatic",
        place=place,
    )


def _describe(root: Element, site: str, number: int) -> str:
    """Returns a robot as text, with the names of its links after the site; it is changed to
    that.
    """
    plain = root.find("link/visual") is None
    colour = _SHAPE_COLOURS[number % len(_SHAPE_COLOURS)]
    links = {link.get("name", ""): link for link in root.findall("link")}
    for joint in root.findall("joint"):
        if plain and (parent := links.get(_link_of(joint, "parent"))) is not None:
            _add_shape(
                parent, _vector(joint.find("origin"), "xyz", (0.0, 0.0, 0.0)), colour, site
            )
        for end in ("parent", "child"):
            if (found := joint.find(end)) is not None:
                found.set("link", f"{site}/{found.get('link', '')}")
    for name, link in links.items():
        link.set("name", f"{site}/{name}")
    return ElementTree.tostring(root, encoding="unicode")


def _add_shape(link: Element, to: Vector, colour: str, site: str) -> None:
    visual = ElementTree.SubElement(link, "visual")
    length = math.hypot(*to)
    middle = " ".join(f"{x / 2.0:.9g}" for x in to)
    tilt = math.atan2(math.hypot(to[0], to[1]), to[2])
    turn = math.atan2(to[1], to[0])
    ElementTree.SubElement(visual, "origin", xyz=middle, rpy=f"0 {tilt:.9g} {turn:.9g}")
    geometry = ElementTree.SubElement(visual, "geometry")
    if length > 0.0:
        ElementTree.SubElement(
            geometry, "cylinder", radius=f"{_RADIUS_M:g}", length=f"{length:.9g}"
        )
    else:
        ElementTree.SubElement(geometry, "sphere", radius=f"{1.2 * _RADIUS_M:g}")
    material = ElementTree.SubElement(visual, "material", name=f"{site}_plain")
    ElementTree.SubElement(material, "color", rgba=colour)

"""Builds the model of an arm that a viewer draws: its URDF, and the poses of its links.

URDF is an XML format that describes a robot by its links (bodies) and joints. A viewer draws
the arms of all sites in one scene. They stand in a row, `SPACING_M` apart, in a common frame
`WORLD` whose z axis points up. If a URDF contains no shapes, plain shapes are added to make the
arm visible. Mesh files are never opened.

Invariant:
    - The frame of a link is named "<site>/<link>", both in the URDF and in the transforms, so
      that several arms with the same URDF can be shown together.
    - The joints have the same names in the URDF as in the joint state messages.
    - The transforms place the end effector at the position that the site computes.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from ...scenario import Scenario
from .cdr import DEFINITIONS, TransformPacker

WORLD = "world"
"""Name of the common frame of all arms of a session."""
SPACING_M = 1.5
"""Distance between the bases of neighbouring sites, in m."""
_RADIUS_M = 0.035
"""Radius of the plain shape of a link, in m."""
_SHAPE_COLOURS = ("0 0.27 0.53 1", "0.73 0.33 0.4 1", "0.87 0.67 0.2 1", "0.4 0.4 0.4 1")
"""Colours of the plain shapes, one per site: red, green, blue and opacity, from 0 to 1."""

Vector = tuple[float, float, float]
"""A vector x, y, z."""
Quaternion = tuple[float, float, float, float]
"""A unit quaternion x, y, z, w."""
Transform = tuple[Vector, Quaternion]
"""The pose of a frame relative to its parent: origin in m, and rotation."""
FramePose = tuple[Sequence[float], Sequence[float]]
"""The same pose as two sequences: origin in m, and quaternion x, y, z, w."""

_X_AXIS = (1.0, 0.0, 0.0)
_Y_AXIS = (0.0, 1.0, 0.0)
_Z_AXIS = (0.0, 0.0, 1.0)
_NO_VECTOR = (0.0, 0.0, 0.0)
_PLANAR_DOWN = (0.0, -1.0, 0.0)
"""Direction of gravity in the frame of a planar arm's base."""


class _JointFrame(NamedTuple):
    """A joint of an arm, which determines the pose of the link that it moves (child link).

    Attributes:
        origin_m: Origin of the link's frame in the parent link's frame, in m.
        rotation: Rotation of the link's frame at joint position 0.
        axis: Axis of the joint in the frame of the link, a unit vector.
        is_prismatic: True if the joint slides along its axis instead of rotating about it.
        q_index: Index of the joint's position in q, or -1 for a joint that does not move, such
            as a finger of a gripper.
    """

    origin_m: Vector
    rotation: Quaternion
    axis: Vector
    is_prismatic: bool
    q_index: int

    def compute_transform(self, position: float) -> Transform:
        """Computes the pose of a link relative to its parent, for a given joint position.

        Args:
            position: Position of the joint, in rad or m.
        """
        if self.is_prismatic:
            axis_x, axis_y, axis_z = rotate_vector(self.rotation, self.axis)
            x, y, z = self.origin_m
            origin_m = (
                x + position * axis_x,
                y + position * axis_y,
                z + position * axis_z,
            )
            return origin_m, self.rotation
        if not position:
            return self.origin_m, self.rotation
        joint_rotation = _rotate_about(self.axis, position)
        rotation = multiply_quaternions(self.rotation, joint_rotation)
        return self.origin_m, rotation


def multiply_quaternions(a: Quaternion, b: Quaternion) -> Quaternion:
    """Computes the product a b of two quaternions.

    For unit quaternions, the product represents rotation b followed by rotation a.

    Args:
        a: The left factor.
        b: The right factor.
    """
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate_vector(rotation: Quaternion, vector: Vector) -> Vector:
    """Rotates a vector by a unit quaternion.

    Computes q v q*, where v is taken as a quaternion without scalar part, and q* is the
    conjugate of q.

    Args:
        rotation: The unit quaternion q.
        vector: The vector v.
    """
    x, y, z, w = rotation
    conjugate = (-x, -y, -z, w)
    half_product = multiply_quaternions(rotation, (*vector, 0.0))
    rotated_x, rotated_y, rotated_z, _ = multiply_quaternions(half_product, conjugate)
    return rotated_x, rotated_y, rotated_z


def _rotate_about(axis: Vector, angle: float) -> Quaternion:
    """Returns the quaternion for a rotation about a unit vector by an angle in rad."""
    half_angle = angle / 2.0
    sine = math.sin(half_angle)
    cosine = math.cos(half_angle)
    x, y, z = axis
    return x * sine, y * sine, z * sine, cosine


def compute_quaternion(rotation_vector: Vector) -> Quaternion:
    """Converts a rotation vector in rad to a unit quaternion (x, y, z, w).

    Args:
        rotation_vector: Axis of the rotation times its angle, in rad.
    """
    angle = math.hypot(*rotation_vector)
    if not angle:
        return _rotate_about(_X_AXIS, angle)
    x, y, z = rotation_vector
    axis = (x / angle, y / angle, z / angle)
    return _rotate_about(axis, angle)


def _rotate_upright(down: Sequence[float]) -> Quaternion:
    """Returns the shortest rotation that takes a given direction to -z.

    Args:
        down: The direction of gravity. It need not be a unit vector.
    """
    length = math.hypot(*down)
    down_x, down_y, down_z = down
    x = down_x / length
    y = down_y / length
    z = down_z / length
    # If the direction is +z, any half turn about a horizontal axis is a shortest rotation.
    if z > 1.0 - 1e-12:
        return 1.0, 0.0, 0.0, 0.0
    # For unit vectors a and b, the shortest rotation is the quaternion (a x b, 1 + a . b),
    # normalised. With b = -z, the cross product is (-y, x, 0), and the scalar part is 1 - z.
    scalar = 1.0 - z
    squared_norm = x * x + y * y + scalar**2
    norm = math.sqrt(squared_norm)
    return -y / norm, x / norm, 0.0, scalar / norm


def _convert_rpy(rpy: Sequence[float]) -> Quaternion:
    """Returns the rotation for roll, pitch and yaw in rad, about the fixed x, y and z axes."""
    roll, pitch, yaw = rpy
    yaw_rotation = _rotate_about(_Z_AXIS, yaw)
    pitch_rotation = _rotate_about(_Y_AXIS, pitch)
    roll_rotation = _rotate_about(_X_AXIS, roll)
    yaw_pitch_rotation = multiply_quaternions(yaw_rotation, pitch_rotation)
    return multiply_quaternions(yaw_pitch_rotation, roll_rotation)


_PLANAR = (DEFINITIONS / "planar.urdf").read_text(encoding="utf-8")
"""URDF of the planar arm, with placeholders for the names of joints and the lengths of links.
"""


def name_ros_joints(scenario: Scenario, site: str) -> list[str]:
    """Lists the names of an arm's joints in ROS messages and in the URDF for viewers.

    Joints keep the names from their URDF. If no arm of the scenario has a URDF, the joints have
    the same names at all sites, so the name of the site is added as a prefix: "m1_q1".

    Args:
        scenario: Scenario of the session.
        site: Name of the site that runs the arm.

    Returns:
        The names, in the order of q.
    """
    arm = scenario.arms[site]
    if arm.chain is not None:
        return [*arm.joint_names]
    return [f"{site}_{name}" for name in arm.joint_names]


class RobotModel:
    """The arm of one site as a tree of rigid links, for viewers that draw it.

    The model is built from the URDF of the arm, or from the built-in planar arm.

    Args:
        scenario: Scenario of the session.
        site: Name of the site that runs the arm.

    Attributes:
        description: Text of the URDF, with the site's name in the names of the links.
        frames: For each link, the names of its parent frame and its own frame, from `WORLD` to
            the last link.
        shared: Pose in `WORLD` of the frame in which the scenario places the arm's base. All
            sites of the session exchange positions in this frame.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        settings = scenario.sites[site].arm
        site_number = scenario.names.index(site)
        joint_names = name_ros_joints(scenario, site)
        if settings.urdf:
            arm_model = settings.read_chain(scenario.urdf)
            base = arm_model.base
            urdf = scenario.urdf[settings.urdf]
        else:
            base = "base"
            q1, q2 = joint_names
            urdf = _PLANAR.format(q1=q1, q2=q2, l1_m=settings.l1_m, l2_m=settings.l2_m)

        # The frames of the links, from the base to the last link.
        root = ElementTree.fromstring(urdf)
        base_frame = f"{site}/{base}"
        self.frames = [(WORLD, base_frame)]
        self._joints: list[_JointFrame] = []
        for joint in _list_joints(root, base):
            parent = _get_link(joint, "parent")
            child = _get_link(joint, "child")
            parent_frame = f"{site}/{parent}"
            child_frame = f"{site}/{child}"
            self.frames.append((parent_frame, child_frame))
            joint_frame = _read_joint_frame(joint, joint_names)
            self._joints.append(joint_frame)
        self._packer = TransformPacker(self.frames)

        # The arm stands upright in `WORLD`: gravity, which may have any direction in the frame
        # of the base, points to -z. The arms of the sites stand side by side along y.
        base_rotation = _convert_rpy(settings.base_rpy_rad)
        down_x, down_y, down_z = settings.down if settings.urdf else _PLANAR_DOWN
        down_of_base = (down_x, down_y, down_z)
        down = rotate_vector(base_rotation, down_of_base)
        upright = _rotate_upright(down)
        site_y = SPACING_M * site_number
        shared_origin = (0.0, site_y, 0.0)
        self.shared = (shared_origin, upright)

        # The pose of the base in `WORLD`, from its pose in the shared frame.
        base_x, base_y, base_z = settings.base_xyz_m
        base_xyz_m = (base_x, base_y, base_z)
        x, y, z = rotate_vector(upright, base_xyz_m)
        base_origin = (x, y + site_y, z)
        world_rotation = multiply_quaternions(upright, base_rotation)
        self._base = (base_origin, world_rotation)
        # The description is created last, because the links of `root` are renamed for it.
        self.description = _describe_robot(root, site, site_number)

    def compute_transforms(self, q: Sequence[float]) -> list[Transform]:
        """Computes the poses of the arm's links for given joint positions.

        Viewers draw the arm from these poses.

        Args:
            q: Joint positions, in rad or m.

        Returns:
            The pose of each frame relative to its parent frame, in the order of `frames`.
        """
        transforms: list[Transform] = [self._base]
        for joint in self._joints:
            can_move = joint.q_index >= 0
            position = q[joint.q_index] if can_move else 0.0
            transform = joint.compute_transform(position)
            transforms.append(transform)
        return transforms

    def pack(self, stamp_ns: int, q: Sequence[float]) -> bytes:
        """Encodes the poses of all links of an arm as one ROS 2 message for the topic `/tf`.

        Args:
            stamp_ns: Unix time of the message, in ns, 0 or more.
            q: Joint positions, in rad or m.
        """
        transforms = self.compute_transforms(q)
        return self.pack_transforms(stamp_ns, transforms)

    def pack_transforms(self, stamp_ns: int, transforms: Iterable[FramePose]) -> bytes:
        """Encodes given poses of frames as one ROS 2 message for the topic `/tf`.

        Args:
            stamp_ns: Unix time of the message, in ns, 0 or more.
            transforms: The origin in m and the quaternion x, y, z, w of each frame in `frames`.
        """
        numbers: list[float] = []
        for origin, rotation in transforms:
            numbers += [*origin, *rotation]
        return self._packer.pack(stamp_ns, numbers)


def _list_joints(root: Element, base: str) -> list[Element]:
    """Lists the joints of a URDF below a link, parents before children.

    Args:
        root: Root element of the URDF.
        base: Name of the link.
    """
    joints_of_parent: dict[str, list[Element]] = {}
    for joint in root.findall("joint"):
        parent = _get_link(joint, "parent")
        siblings = joints_of_parent.setdefault(parent, [])
        siblings.append(joint)
    joints: list[Element] = []
    links = [base]
    # Breadth-first search: the list of links grows while the loop runs.
    for link in links:
        for joint in joints_of_parent.get(link, ()):
            child = _get_link(joint, "child")
            joints.append(joint)
            links.append(child)
    return joints


def _get_link(joint: Element, end: str) -> str:
    """Returns the name of the link at one end of a joint.

    Args:
        joint: The joint's element in the URDF.
        end: "parent" or "child".
    """
    element = joint.find(end)
    if element is None:
        return ""
    return element.get("link", "")


def _parse_vector(element: Element | None, key: str, default: Vector) -> Vector:
    """Parses an attribute that contains three numbers.

    The default is returned if the attribute does not contain three finite numbers. This can
    happen only in branches of the URDF that are not part of the arm, because `read_urdf` checks
    the arm.

    Args:
        element: Element of the URDF. None if it is absent.
        key: Name of the attribute.
        default: Value to return if the attribute is invalid.
    """
    if element is None:
        return default
    numbers_text = element.get(key, "")
    try:
        x, y, z = map(float, numbers_text.split())
    except ValueError:
        return default
    is_finite = math.isfinite(x + y + z)
    return (x, y, z) if is_finite else default


def _read_joint_frame(joint: Element, joint_names: Sequence[str]) -> _JointFrame:
    """Reads the frame of a joint from a URDF, with the same defaults as `read_urdf`.

    Args:
        joint: The joint's element in the URDF.
        joint_names: Names of the joints in the order of q.
    """
    name = joint.get("name", "")
    origin = joint.find("origin")
    rpy = _parse_vector(origin, "rpy", _NO_VECTOR)
    axis = joint.find("axis")
    x, y, z = _parse_vector(axis, "xyz", _X_AXIS)
    length = math.hypot(x, y, z) or 1.0
    q_index = -1
    if name in joint_names:
        q_index = joint_names.index(name)
    return _JointFrame(
        origin_m=_parse_vector(origin, "xyz", _NO_VECTOR),
        rotation=_convert_rpy(rpy),
        axis=(x / length, y / length, z / length),
        is_prismatic=joint.get("type") == "prismatic",
        q_index=q_index,
    )


def _describe_robot(root: Element, site: str, site_number: int) -> str:
    """Returns the URDF of a site's arm as a string for viewers.

    The names of the links are prefixed with the name of the site, so that several arms with the
    same URDF can be shown together. If the URDF contains no shapes, plain shapes are added to
    the links, because the arm would otherwise be invisible.

    Args:
        root: Root element of the URDF, which is modified.
        site: Name of the site.
        site_number: Index of the site, which determines the colour.
    """
    has_shapes = root.find("link/visual") is not None
    colour_index = site_number % len(_SHAPE_COLOURS)
    colour = _SHAPE_COLOURS[colour_index]
    links: dict[str, Element] = {}
    for link in root.findall("link"):
        name = link.get("name", "")
        links[name] = link

    for joint in root.findall("joint"):
        parent_name = _get_link(joint, "parent")
        parent = links.get(parent_name)
        if parent is not None and not has_shapes:
            origin = joint.find("origin")
            joint_origin_m = _parse_vector(origin, "xyz", _NO_VECTOR)
            _add_shape(
                parent, joint_origin_m, colour, site
            )  # from the joint before to this one
        for end in ("parent", "child"):
            element = joint.find(end)
            if element is None:
                continue
            link_name = element.get("link", "")
            element.set("link", f"{site}/{link_name}")

    for name, link in links.items():
        link.set("name", f"{site}/{name}")
    return ElementTree.tostring(root, encoding="unicode")


def _add_shape(link: Element, end_m: Vector, colour: str, site: str) -> None:
    """Adds a plain shape to a link: a cylinder from its origin to a point.

    If the point is the origin, the shape is a sphere.

    Args:
        link: The link's element in the URDF.
        end_m: The point in the frame of the link, in m.
        colour: Red, green, blue and opacity, from 0 to 1.
        site: Name of the site, which makes the name of the material unique.
    """
    x, y, z = end_m
    length_m = math.hypot(x, y, z)
    centre_text = f"{x / 2.0:.9g} {y / 2.0:.9g} {z / 2.0:.9g}"

    # The axis of a cylinder is z in a URDF. It is tilted from z, and then turned about z.
    horizontal_m = math.hypot(x, y)
    tilt = math.atan2(horizontal_m, z)
    azimuth = math.atan2(y, x)
    rpy_text = f"0 {tilt:.9g} {azimuth:.9g}"

    visual = SubElement(link, "visual")
    SubElement(visual, "origin", xyz=centre_text, rpy=rpy_text)
    geometry = SubElement(visual, "geometry")
    if length_m > 0.0:
        radius_text = f"{_RADIUS_M:g}"
        length_text = f"{length_m:.9g}"
        SubElement(geometry, "cylinder", radius=radius_text, length=length_text)
    else:
        sphere_radius_m = 1.2 * _RADIUS_M
        radius_text = f"{sphere_radius_m:g}"
        SubElement(geometry, "sphere", radius=radius_text)
    material = SubElement(visual, "material", name=f"{site}_plain")
    SubElement(material, "color", rgba=colour)

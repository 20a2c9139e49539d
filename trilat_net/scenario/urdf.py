"""Arms from URDF: the moving bodies between a base and an end link, with their joints.

Invariant: a chain that is read is physical (every moving body has mass, positive principal moments of inertia
and their triangle inequality), and nothing that a moving link carries is left out: what hangs on it is
lumped, or the file is refused with the link or joint named. The text is not trusted: no file that it names
is opened, no entity is expanded, and its angles are turned into matrices by `core.sincos` and sums in a
fixed order, so that the numbers of a chain have the same bits on every machine.

Units are those of URDF: kg, m, rad, N m; N along a prismatic joint. Frames: the frame of a link lies on the
joint that moves it.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ..core.chain import MAX_JOINTS, Matrix, Three, apply, multiply
from ..core.elementary import sincos
from ..errors import ScenarioError
from ..fields import MAX_QUANTITY, suggest_nearest

MAX_CHARACTERS = 1_000_000
MOST_DIGITS = 100
"""Letters of a number; the time to match one that is none grows by the square of its length."""
MAX_OFFSET_M = 100.0
"""Largest coordinate of an origin; beyond it a file is in millimetres, or wrong."""
CONSISTENCY = 1e-9
"""By so much of the largest principal moment of inertia the physical inequalities may fail, for rounding."""
LEAST_MASS_KG = 1e-9
LEAST_MOMENT_KG_M2 = 1e-12
"""Of a body that moves; of a single link less than it counts as none."""

BodyParameters = tuple[float, ...]
"""m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the origin of a frame, in its axes."""

_ZERO: Three = (0.0, 0.0, 0.0)
_UNIT: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MOVING = ("revolute", "continuous", "prismatic")
_KINDS = (*_MOVING, "fixed", "floating", "planar")
_plain_sincos = getattr(sincos, "py_func", sincos)
"""Without compilation, which would take longer than to read a file."""


class UrdfPayload(NamedTuple):
    """A body fixed to the end link.

    Attributes:
        mass_kg: its mass.
        com_m: its centre of mass in the frame of the end link.
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about its centre of mass in the axes of the end link.
    """

    mass_kg: float
    com_m: Sequence[float] = _ZERO
    inertia_kg_m2: Sequence[float] = (0.0,) * 6


class UrdfJoint(NamedTuple):
    """A joint that moves, and the body that it moves.

    Attributes:
        name: the joint.
        link: the link that it moves.
        kind: "revolute" (continuous ones too) or "prismatic".
        axis: unit vector in the joint's frame.
        rotation: orientation of the joint's frame in the frame of the moving link before (of the base for
            the first one) at q = 0, row by row.
        origin_m: its origin there.
        inertia: the body's `BodyParameters` in the joint's frame, with all that is fixed to the link.
        lower: least position, rad or m; -inf if the file states none.
        upper: largest position; inf if the file states none.
        effort_limit: N m or N; inf if the file states none.
        velocity_limit: rad/s or m/s; inf if the file states none.
        viscous: friction, N m s/rad or N s/m.
        coulomb: friction, N m or N.
    """

    name: str
    link: str
    kind: str
    axis: Three
    rotation: Matrix
    origin_m: Three
    inertia: BodyParameters
    lower: float
    upper: float
    effort_limit: float
    velocity_limit: float
    viscous: float
    coulomb: float


class UrdfChain(NamedTuple):
    """An arm: the joints that move between a base and an end link, and where that one is.

    Attributes:
        base: the link that does not move.
        tip: the end link.
        joints: 1 to `MAX_JOINTS` of them, from the base on.
        tip_rotation: orientation of the end link in the frame of the last moving link, row by row.
        tip_origin_m: its origin there.
        notes: what was taken otherwise than the file may have meant, a sentence each.
    """

    base: str
    tip: str
    joints: tuple[UrdfJoint, ...]
    tip_rotation: Matrix
    tip_origin_m: Three
    notes: tuple[str, ...]


class _Pose(NamedTuple):
    """A frame in another one."""

    rotation: Matrix = _UNIT
    origin_m: Three = _ZERO

    def __matmul__(self, inner: "_Pose") -> "_Pose":
        x, y, z = apply(self.rotation, inner.origin_m)
        ox, oy, oz = self.origin_m
        return _Pose(multiply(self.rotation, inner.rotation), (ox + x, oy + y, oz + z))


class _Edge(NamedTuple):
    """A joint as the file has it."""

    name: str
    kind: str
    parent: str
    child: str
    element: Element

    @property
    def moves(self) -> bool:
        return self.kind in _MOVING


class _Robot(NamedTuple):
    """A tree of links, without loops."""

    links: Mapping[str, Element]
    above: Mapping[str, _Edge]
    below: Mapping[str, Sequence[_Edge]]


def read_urdf(text: str, base: str = "", tip: str = "", payload: UrdfPayload | None = None) -> UrdfChain:
    """Returns the arm between two links of a robot.

    Links behind fixed joints are part of the moving link before. A branch that a moving link carries on
    joints of its own (fingers) is part of it as well, at their zero position; a note says so.

    Args:
        text: the URDF document.
        base: the link that does not move; "": the robot's root.
        tip: the end link; "": the only leaf that moves.
        payload: a body that the end link carries.

    Raises:
        ScenarioError: the problem, with the line, link or joint.
    """
    robot = _read_tree(_parse_xml(text))
    base = _check_end(robot, "base", base) or _find_base(robot)
    tip = _check_end(robot, "tip", tip) or _find_tip(robot, base)
    path = _find_path(robot, base, tip)
    joints: list[UrdfJoint] = []
    notes: list[str] = []
    pose = _Pose()
    last = max(n for n, edge in enumerate(path) if edge.moves)
    for n, edge in enumerate(path):
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
        if edge.moves:
            bodies = _gather_bodies(robot, edge, path, notes)
            if payload is not None and n == last:
                bodies.append(_read_payload(payload, path[n + 1 :]))
            joints.append(_read_joint(edge, pose, _lump_bodies(edge, bodies), notes))
            pose = _Pose()
    return UrdfChain(base, tip, tuple(joints), *pose, tuple(notes))


def _refuse(place: str, problem: str) -> NoReturn:
    raise ScenarioError(f"{place}: {problem}" if place else problem)


def _quote(word: str) -> str:
    return repr(word if len(word) <= 60 else f"{word[:57]}...")


def _link(name: str) -> str:
    return f"link {_quote(name)}"


def _joint(name: str) -> str:
    return f"joint {_quote(name)}"


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(map(_quote, names[:8])) + (f" and {len(names) - 8} more" if len(names) > 8 else "")


# The document


def _parse_xml(text: str) -> Element:
    if len(text) > MAX_CHARACTERS:
        _refuse("", f"has {len(text)} characters, at most {MAX_CHARACTERS} are read")
    for word in ("<!DOCTYPE", "<!ENTITY"):
        if word in text:
            line = text.count("\n", 0, text.index(word)) + 1
            _refuse(f"line {line}", f"{word} is not read: a robot needs no document type and no entities")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        _refuse(f"line {error.position[0]}", f"is not XML: {error.msg.partition(':')[0]}")
    except ValueError as error:  # a character that no encoding has
        _refuse("", f"is not XML: {error}")
    for element in root.iter():
        if "xacro" in element.tag.partition("}")[0] or any("${" in word for word in element.attrib.values()):
            _refuse(
                f"<{element.tag.rpartition('}')[2][:60]}>",
                "is xacro, a template of URDF: expand it with `xacro FILE.urdf.xacro > FILE.urdf`",
            )
    if root.tag != "robot":
        _refuse("", f"its root element is <{root.tag[:60]}>, that of URDF is <robot>")
    return root


def _name_elements(root: Element, tag: str) -> dict[str, Element]:
    named: dict[str, Element] = {}
    for n, element in enumerate(root.findall(tag), 1):
        name = element.get("name", "")
        if not name.strip():
            _refuse(f"{tag} number {n}", "has no name")
        if name in named:
            _refuse(f"{tag} {_quote(name)}", f"there are two of that name: give every {tag} its own")
        named[name] = element
    return named


def _read_tree(root: Element) -> _Robot:
    links = _name_elements(root, "link")
    above: dict[str, _Edge] = {}
    below: dict[str, list[_Edge]] = {name: [] for name in links}
    for name, element in _name_elements(root, "joint").items():
        place, kind = _joint(name), element.get("type", "")
        if kind not in _KINDS:
            hint = suggest_nearest(kind, _KINDS)
            _refuse(place, f"is of type {_quote(kind)}, must be one of {', '.join(_KINDS)}{hint}")
        ends = []
        for tag in ("parent", "child"):
            found = _child(element, tag, place)
            end = "" if found is None else found.get("link", "")
            if end not in links:
                hint = suggest_nearest(end, list(links))
                _refuse(place, f"its <{tag}> is {_link(end)}, and there is none of that name{hint}")
            ends.append(end)
        edge = _Edge(name, kind, ends[0], ends[1], element)
        if edge.child in above:
            _refuse(
                _link(edge.child),
                f"hangs on two joints, {_quote(above[edge.child].name)} and {_quote(name)}: "
                "a closed loop is no arm of this program; leave out one of them",
            )
        above[edge.child] = edge
        below[edge.parent].append(edge)
    robot = _Robot(links, above, below)
    rooted = {name for top in links if top not in above for name, _ in _walk(robot, top)}
    for name in links:
        if name not in rooted:
            _refuse(_link(name), f"hangs on itself by {_joint(above[name].name)}: joints may not form a loop")
    if not links:
        _refuse("", "has no links")
    return robot


def _walk(robot: _Robot, top: str) -> Iterator[tuple[str, bool]]:
    waiting = [(top, False)]
    while waiting:
        name, moved = waiting.pop()
        yield name, moved
        waiting += [(edge.child, moved or edge.kind != "fixed") for edge in reversed(robot.below[name])]


# The chain


def _check_end(robot: _Robot, end: str, link: str) -> str:
    if link and link not in robot.links:
        _refuse(end, f"there is no {_link(link)}{suggest_nearest(link, list(robot.links))}")
    return link


def _find_base(robot: _Robot) -> str:
    roots = [name for name in robot.links if name not in robot.above]
    if len(roots) > 1:
        _refuse(
            f"links {_list_names(roots)}",
            "hang on no joint: connect them, or name the one that the arm stands on as base",
        )
    return roots[0]


def _find_tip(robot: _Robot, base: str) -> str:
    leaves = [name for name, moved in _walk(robot, base) if moved and not robot.below[name]]
    if not leaves:
        _refuse(_link(base), "no joint below it moves")
    if len(leaves) > 1:
        _refuse(
            "", f"the arm may end at links {_list_names(leaves)}: name one of them, or a link before, as tip"
        )
    return leaves[0]


def _find_path(robot: _Robot, base: str, tip: str) -> list[_Edge]:
    path: list[_Edge] = []
    name = tip
    while name != base:
        if name not in robot.above:
            _refuse(_link(tip), f"is not below {_link(base)}: name a tip and a base that joints connect")
        path.append(robot.above[name])
        name = path[-1].parent
    for edge in path:
        if edge.kind in ("floating", "planar"):
            _refuse(
                _joint(edge.name),
                f"is {edge.kind}: joints of an arm are revolute, continuous, prismatic or fixed; "
                f"give a base behind it, such as {_quote(edge.child)}",
            )
        if edge.element.find("mimic") is not None:
            _refuse(
                _joint(edge.name),
                "follows another joint (<mimic>), which has no torque of its own: make it fixed, or give a "
                f"tip before it, such as {_quote(edge.parent)}",
            )
    moving = sum(edge.moves for edge in path)
    if not 1 <= moving <= MAX_JOINTS:
        _refuse(
            f"base {_link(base)}, tip {_link(tip)}",
            f"{moving} joints move between them, must be 1 to {MAX_JOINTS}: name others",
        )
    return path[::-1]


def _gather_bodies(
    robot: _Robot, moving: _Edge, path: Sequence[_Edge], notes: list[str]
) -> list[BodyParameters]:
    """Returns all that a joint of the path moves, up to the next one, in the frame of its link."""
    on_path = {edge.name for edge in path}
    bodies: list[BodyParameters] = []
    waiting = [(moving.child, _Pose())]
    while waiting:
        name, pose = waiting.pop()
        body = _read_inertial(robot.links[name], name)
        if body is not None:
            bodies.append(_move_body(*body, pose))
        for edge in robot.below[name]:
            if edge.moves and edge.name in on_path:
                continue
            if edge.kind in ("floating", "planar"):
                _refuse(
                    _joint(edge.name),
                    f"is {edge.kind} and hangs on {_link(name)}, which moves: make it fixed, or leave it out",
                )
            if edge.moves:
                notes.append(
                    f"{_joint(edge.name)} does not lead to the end link: held at zero, "
                    f"{_link(edge.child)} is part of {_link(moving.child)}"
                )
            waiting.append((edge.child, pose @ _read_origin(edge.element, _joint(edge.name))))
    return bodies


def _read_joint(edge: _Edge, pose: _Pose, inertia: BodyParameters, notes: list[str]) -> UrdfJoint:
    place = _joint(edge.name)
    axis = _child(edge.element, "axis", place)
    x, y, z = (1.0, 0.0, 0.0) if axis is None else _read_vector(axis, "xyz", place)
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-6:
        _refuse(place, "its <axis> has no length: give the direction of the joint, as in xyz='0 0 1'")
    lower, upper, effort, velocity = _read_limit(edge, place, notes)
    dynamics = _child(edge.element, "dynamics", place)
    friction = [0.0, 0.0]
    for n, key in enumerate(("damping", "friction")):
        if dynamics is not None and key in dynamics.attrib:
            friction[n] = _read_number(dynamics, key, place)
            if friction[n] < 0.0:
                _refuse(
                    place, f"its {key} is {friction[n]:g}, must not be negative: it would drive the joint"
                )
    kind = "prismatic" if edge.kind == "prismatic" else "revolute"
    axes = (x / length, y / length, z / length)
    return UrdfJoint(
        edge.name, edge.child, kind, axes, *pose, inertia, lower, upper, effort, velocity, *friction
    )


def _read_limit(edge: _Edge, place: str, notes: list[str]) -> tuple[float, float, float, float]:
    """Returns least and largest position, effort and velocity; exporters write 0 for what they lack."""
    limit = _child(edge.element, "limit", place)
    values = []
    for key in ("lower", "upper", "effort", "velocity"):
        stated = limit is not None and key in limit.attrib
        value = _read_number(limit, key, place, math.inf) if limit is not None and stated else 0.0
        values.append(math.copysign(math.inf, value) if abs(value) > MAX_QUANTITY else value)
    lower, upper, effort, velocity = values
    if min(effort, velocity) < 0.0:
        _refuse(place, f"its limits of effort and velocity are {effort:g} and {velocity:g}, must be positive")
    unknown = [key for key, value in (("effort", effort), ("velocity", velocity)) if value == 0.0]
    if edge.kind == "continuous":
        lower, upper = -math.inf, math.inf
    elif lower == upper == 0.0:
        unknown.insert(0, "position")
        lower, upper = -math.inf, math.inf
    if lower > upper:
        _refuse(place, f"its lower limit is {lower:g}, must be below the upper one, {upper:g}")
    if lower == upper:
        _refuse(place, f"its limits are both {lower:g}: a joint that does not move is of type 'fixed'")
    if unknown:
        notes.append(f"{place} states no limit, or 0, of {' and '.join(unknown)}: none is kept")
    return lower, upper, effort or math.inf, velocity or math.inf


# Elements and numbers


def _child(element: Element, tag: str, place: str) -> Element | None:
    found = element.findall(tag)
    if len(found) > 1:
        _refuse(place, f"has {len(found)} <{tag}>: keep one")
    return found[0] if found else None


def _read_number(element: Element, key: str, place: str, most: float = MAX_QUANTITY) -> float:
    word = element.get(key)
    if word is None:
        _refuse(place, f"its <{element.tag}> has no {key}")
    return _parse_number(word, f"{element.tag} {key}", place, most)


def _parse_number(word: str, what: str, place: str, most: float) -> float:
    number = word.strip() if len(word) <= MOST_DIGITS else ""
    value = float(number) if _NUMBER.fullmatch(number) else math.nan
    if not math.isfinite(value):
        _refuse(place, f"its <{what}> is {_quote(word)}, must be a finite number")
    if abs(value) > most:
        _refuse(place, f"its <{what}> is {value:g}, must be at most {most:g} (kg, m and rad)")
    return value


def _read_vector(element: Element, key: str, place: str, most: float = MAX_QUANTITY) -> Three:
    words = element.get(key, "").split()
    if len(words) != 3:
        _refuse(place, f"its <{element.tag} {key}> has {len(words)} numbers, must have three")
    x, y, z = (_parse_number(word, f"{element.tag} {key}", place, most) for word in words)
    return x, y, z


def _read_origin(parent: Element, place: str) -> _Pose:
    """Returns the frame that an <origin> states; without one, that of its parent."""
    origin = _child(parent, "origin", place)
    if origin is None:
        return _Pose()
    if unknown := origin.attrib.keys() - {"xyz", "rpy"}:
        _refuse(place, f"its <origin> has {_quote(min(unknown))}: a frame is given by xyz and rpy alone")
    offset = _read_vector(origin, "xyz", place, MAX_OFFSET_M) if "xyz" in origin.attrib else _ZERO
    angles = _read_vector(origin, "rpy", place) if "rpy" in origin.attrib else _ZERO
    (sr, cr), (sp, cp), (sy, cy) = map(_plain_sincos, angles)
    rotation = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return _Pose(rotation, offset)


# Inertia


def _read_inertial(link: Element, name: str) -> tuple[float, _Pose, Matrix] | None:
    """Returns the mass of a link, its frame of inertia and the tensor there; None if it states none."""
    place = _link(name)
    inertial = _child(link, "inertial", place)
    if inertial is None:
        return None
    mass_element, tensor_element = _child(inertial, "mass", place), _child(inertial, "inertia", place)
    if mass_element is None or tensor_element is None:
        _refuse(place, f"its <inertial> has no <{'mass' if mass_element is None else 'inertia'}>")
    mass = _read_number(mass_element, "value", place)
    keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
    tensor = _fill_tensor([_read_number(tensor_element, key, place) for key in keys])
    _check_stated(place, mass, tensor)
    return mass, _read_origin(inertial, place), tensor


def _read_payload(payload: UrdfPayload, fixed: Sequence[_Edge]) -> BodyParameters:
    """Returns the payload in the frame of the last moving link, from which fixed joints lead to the tip."""
    pose = _Pose()
    for edge in fixed:
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
    tensor = _fill_tensor(payload.inertia_kg_m2)
    _check_stated("payload", payload.mass_kg, tensor)
    x, y, z = payload.com_m
    return _move_body(payload.mass_kg, _Pose(_UNIT, (x, y, z)), tensor, pose)


def _fill_tensor(entries: Sequence[float]) -> Matrix:
    xx, xy, yy, xz, yz, zz = entries
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _principal_moments(tensor: Matrix) -> list[float]:
    return [float(moment) for moment in np.linalg.eigvalsh(np.array(tensor))]


def _check_stated(place: str, mass: float, tensor: Matrix) -> None:
    if mass < 0.0:
        _refuse(place, f"its mass is {mass:g} kg, must not be negative")
    if mass == 0.0 and any(map(any, tensor)):
        _refuse(place, "has moments of inertia and no mass: give both, or neither")
    moments = _principal_moments(tensor)
    slack = max(LEAST_MOMENT_KG_M2, CONSISTENCY * moments[2])
    _check_moments(place, moments, -slack, slack)


def _check_moments(place: str, moments: Sequence[float], bound: float, slack: float) -> None:
    least, middle, most = moments
    stated = f"its principal moments of inertia are {least:.4g}, {middle:.4g} and {most:.4g} kg m^2"
    if least < bound:
        _refuse(place, f"{stated}: all must be positive")
    if most - least - middle > slack:
        _refuse(place, f"{stated}: of a body, no one is more than the two others together")


def _move_body(mass: float, centre: _Pose, tensor: Matrix, pose: _Pose) -> BodyParameters:
    """Returns the parameters of a body about the frame in which a link has that pose.

    Its centre of mass and the axes of its tensor are given in the frame of the link.
    """
    (r0, r1, r2), (x, y, z) = pose @ centre
    columns = apply(tensor, r0), apply(tensor, r1), apply(tensor, r2)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = apply(columns, r0), apply(columns, r1), apply(columns, r2)
    return (
        mass,
        mass * x,
        mass * y,
        mass * z,
        xx + mass * (y * y + z * z),
        xy - mass * x * y,
        yy + mass * (x * x + z * z),
        xz - mass * x * z,
        yz - mass * y * z,
        zz + mass * (x * x + y * y),
    )


def _lump_bodies(edge: _Edge, bodies: Sequence[BodyParameters]) -> BodyParameters:
    """Returns the sum of bodies that one joint moves; refused unless it is a body with mass and extent."""
    place = f"{_link(edge.child)}, which {_joint(edge.name)} moves"
    if not bodies:
        _refuse(place, "has no <inertial>, and nothing fixed to it has one: give it a mass")
    total = bodies[0]
    for body in bodies[1:]:  # one by one: the built-in sum rounds otherwise from Python 3.12 on
        total = tuple(a + b for a, b in zip(total, body, strict=True))
    mass = total[0]
    if mass < LEAST_MASS_KG:
        _refuse(place, f"has {mass:g} kg with all that is fixed to it: a body that moves needs mass")
    x, y, z = (moment / mass for moment in total[1:4])
    back = _move_body(-mass, _Pose(_UNIT, (x, y, z)), _fill_tensor(total[4:]), _Pose())
    moments = _principal_moments(_fill_tensor(back[4:]))
    slack = CONSISTENCY * moments[2]
    _check_moments(place, moments, max(LEAST_MOMENT_KG_M2, slack), slack)
    return total

"""Arms from URDF: the moving bodies between a base and an end link, with their joints.

Invariant:
    - A chain that is read is physical: every moving body has mass, positive principal moments
      of inertia and their triangle inequality.
    - What hangs on a moving link is part of its body. A link that does not lead to the end link
      never makes an arm unusable: if its inertia is that of no body, a note says how it counts.
    - A link on the way to the end link whose inertia is that of no body is refused by name,
      unless the caller balances inertias or gives that link others.
    - The text is not trusted: no file that it names is opened, no entity is expanded, and its
      angles are turned into matrices by `core.sincos` and sums in a fixed order, so that the
      numbers of a chain have the same bits on every machine.

Units are those of URDF: kg, m, rad, N m; N along a prismatic joint. Frames: the frame of a link
lies on the joint that moves it.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ..core.chain import MAX_JOINTS, Matrix, Three, apply, multiply
from ..core.elementary import sincos
from ..errors import ScenarioError, count_nouns
from ..fields import MAX_QUANTITY, suggest_nearest
from .link_inertia import LinkInertia, balance_tensor, fill_tensor

MAX_CHARACTERS = 1_000_000
MOST_DIGITS = 100
"""Letters of a number; the time to match one that is none grows by the square of its length."""
MAX_OFFSET_M = 100.0
"""Largest coordinate of an origin; beyond it a file is in millimetres, or wrong."""
CONSISTENCY = 1e-9
"""By so much of the largest principal moment of inertia the physical inequalities may fail, for
rounding.
"""
LEAST_MASS_KG = 1e-9
LEAST_MOMENT_KG_M2 = 1e-12
"""Of a body that moves; of a single link less than it counts as none."""

BodyParameters = tuple[float, ...]
"""m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the origin of a frame, in its axes.
"""

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
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about its centre of mass in the axes of the
            end link.
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
        rotation: orientation of the joint's frame in the frame of the moving link before (of
            the base for the first one) at q = 0, row by row.
        origin_m: its origin there.
        inertia: the body's `BodyParameters` in the joint's frame, with all that is fixed to the
            link.
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
        tip_rotation: orientation of the end link in the frame of the last moving link, row by
            row.
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


class _Inertias(NamedTuple):
    """What a scenario says about the inertias of a file.

    Attributes:
        links: masses and inertias by the link's name, in place of the file's.
        balance: true: a tensor that no body has is balanced; false: it is refused, or noted.
    """

    links: Mapping[str, LinkInertia]
    balance: bool


class _LinkBody(NamedTuple):
    """The body of a link that a joint of the path moves, about the frame of the moving link.

    Attributes:
        link: the link that states it.
        body: its parameters as they are stated, or balanced.
        point: its parameters as a point of mass, where its moments are those of no body; else
            None.
        problem: why its moments are those of no body; "" if they are those of one.
    """

    link: str
    body: BodyParameters
    point: BodyParameters | None = None
    problem: str = ""


def read_urdf(
    text: str,
    base: str = "",
    tip: str = "",
    payload: UrdfPayload | None = None,
    links: Mapping[str, LinkInertia] | None = None,
    *,
    balance: bool = False,
) -> UrdfChain:
    """Returns the arm between two links of a robot.

    Links behind fixed joints are part of the moving link before. A branch that a moving link
    carries on joints of its own (fingers) is part of it as well, at their zero position; a note
    says so.

    Args:
        text: the URDF document.
        base: the link that does not move; "": the robot's root.
        tip: the end link; "": the only leaf that moves.
        payload: a body that the end link carries.
        links: masses and inertias in place of the file's, by the link's name.
        balance: true: a stated inertia that no body has is replaced by the nearest that a body
            has.

    Raises:
        ScenarioError: the problem, with the line, link or joint; of a key of `links` with its
            path, as in links.NAME.mass_kg.
    """
    robot = _read_tree(_parse_xml(text))
    base = _check_end(robot, "base", base) or _find_base(robot)
    tip = _check_end(robot, "tip", tip) or _find_tip(robot, base)
    path = _find_path(robot, base, tip)
    inertias = _Inertias(links or {}, balance)
    joints: list[UrdfJoint] = []
    notes: list[str] = []
    moved: set[str] = set()
    pose = _Pose()
    last = max(n for n, edge in enumerate(path) if edge.moves)
    for n, edge in enumerate(path):
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
        if edge.moves:
            carried = list(_walk_carried(robot, edge, path, notes))
            moved |= {name for name, _ in carried}
            bodies = list(
                _read_bodies(
                    robot=robot, carried=carried, path=path, inertias=inertias, notes=notes
                )
            )
            if payload is not None and n == last:
                bodies.append(_LinkBody("payload", _read_payload(payload, path[n + 1 :])))
            joints.append(_read_joint(edge, pose, _lump_bodies(edge, bodies, notes), notes))
            pose = _Pose()
    _check_mended(robot, inertias.links, moved)
    return UrdfChain(base, tip, tuple(joints), *pose, tuple(notes))


def _check_mended(
    robot: _Robot, links: Mapping[str, LinkInertia], moved: Collection[str]
) -> None:
    """Refuses inertias of links that the robot lacks, or that no joint of the arm moves."""
    for name in links:
        if name not in robot.links:
            problem = f"there is no {_link(name)}{suggest_nearest(name, list(robot.links))}"
        elif name not in moved:
            problem = f"{_link(name)} is moved by no joint between base and tip: its inertia has no effect"
        else:
            continue
        raise ScenarioError(problem, path=_key(name))


def _key(link: str) -> str:
    """Returns the key path of a link's inertia, as an author writes it."""
    return f"links.{link}" if re.fullmatch(r"[A-Za-z0-9_-]+", link) else f'links."{link}"'


def _refuse(place: str, problem: str) -> NoReturn:
    raise ScenarioError(f"{place}: {problem}" if place else problem)


def _quote(word: str) -> str:
    return repr(word if len(word) <= 60 else f"{word[:57]}...")


def _link(name: str) -> str:
    return f"link {_quote(name)}"


def _joint(name: str) -> str:
    return f"joint {_quote(name)}"


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(map(_quote, names[:8])) + (
        f" and {len(names) - 8} more" if len(names) > 8 else ""
    )


# The document


def _parse_xml(text: str) -> Element:
    if len(text) > MAX_CHARACTERS:
        _refuse(
            "", f"has {count_nouns(len(text), 'character')}, at most {MAX_CHARACTERS} are read"
        )
    for word in ("<!DOCTYPE", "<!ENTITY"):
        if word in text:
            line = text.count("\n", 0, text.index(word)) + 1
            _refuse(
                f"line {line}",
                f"{word} is not read: a robot needs no document type and no entities",
            )
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        _refuse(f"line {error.position[0]}", f"is not XML: {error.msg.partition(':')[0]}")
    except ValueError as error:  # a character that no encoding has
        _refuse("", f"is not XML: {error}")
    for element in root.iter():
        if "xacro" in element.tag.partition("}")[0] or any(
            "${" in word for word in element.attrib.values()
        ):
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
            _refuse(
                f"{tag} {_quote(name)}", f"there are two of that name: give every {tag} its own"
            )
        named[name] = element
    return named


def _read_tree(root: Element) -> _Robot:
    links = _name_elements(root, "link")
    above: dict[str, _Edge] = {}
    below: dict[str, list[_Edge]] = {name: [] for name in links}
    for name, element in _name_elements(root, "joint").items():
        place = _joint(name)
        kind = element.get("type", "")
        if kind not in _KINDS:
            hint = suggest_nearest(kind, _KINDS)
            _refuse(
                place, f"is of type {_quote(kind)}, must be one of {', '.join(_KINDS)}{hint}"
            )
        ends = []
        for tag in ("parent", "child"):
            found = _child(element, tag, place)
            end = "" if found is None else found.get("link", "")
            if end not in links:
                hint = suggest_nearest(end, list(links))
                _refuse(
                    place, f"its <{tag}> is {_link(end)}, and there is none of that name{hint}"
                )
            ends.append(end)
        edge = _Edge(name=name, kind=kind, parent=ends[0], child=ends[1], element=element)
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
            _refuse(
                _link(name),
                f"hangs on itself by {_joint(above[name].name)}: joints may not form a loop",
            )
    if not links:
        _refuse("", "has no links")
    return robot


def _walk(robot: _Robot, top: str) -> Iterator[tuple[str, bool]]:
    waiting = [(top, False)]
    while waiting:
        name, moved = waiting.pop()
        yield name, moved
        waiting += [
            (edge.child, moved or edge.kind != "fixed") for edge in reversed(robot.below[name])
        ]


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
            "",
            f"the arm may end at links {_list_names(leaves)}: name one of them, or a link before, as tip",
        )
    return leaves[0]


def _find_path(robot: _Robot, base: str, tip: str) -> list[_Edge]:
    path: list[_Edge] = []
    name = tip
    while name != base:
        if name not in robot.above:
            _refuse(
                _link(tip),
                f"is not below {_link(base)}: name a tip and a base that joints connect",
            )
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
            f"{count_nouns(moving, 'joint moves', 'joints move')} between them, must be 1 "
            f"to {MAX_JOINTS}: name others",
        )
    return path[::-1]


def _walk_carried(
    robot: _Robot, moving: _Edge, path: Sequence[_Edge], notes: list[str]
) -> Iterator[tuple[str, _Pose]]:
    """Yields every link that a joint of the path moves, up to the next one, with its frame in
    its link's.
    """
    on_path = {edge.name for edge in path}
    waiting = [(moving.child, _Pose())]
    while waiting:
        name, pose = waiting.pop()
        yield name, pose
        for edge in robot.below[name]:
            if edge.moves and edge.name in on_path:
                continue
            if edge.kind != "fixed":
                notes.append(
                    f"{_joint(edge.name)} does not lead to the end link: held at zero, "
                    f"{_link(edge.child)} is part of {_link(moving.child)}"
                )
            waiting.append((edge.child, pose @ _read_origin(edge.element, _joint(edge.name))))


def _read_bodies(
    robot: _Robot,
    carried: Sequence[tuple[str, _Pose]],
    path: Sequence[_Edge],
    inertias: _Inertias,
    notes: list[str],
) -> Iterator[_LinkBody]:
    """Yields the bodies of links, about the frame of the link that moves them."""
    leading = {edge.child for edge in path}
    for name, pose in carried:
        given = inertias.links.get(name)
        if given is not None:
            notes.append(_note_given(name, given))
        inertial = _read_inertial(robot.links[name], name, given)
        if inertial is None:
            continue
        problem = _find_mass_problem(inertial)
        if problem and given is not None:
            key = "mass_kg" if given.inertia_kg_m2 is None else "inertia_kg_m2"
            raise ScenarioError(problem, path=f"{_key(name)}.{key}")
        if name in leading and problem:
            _refuse(_link(name), f"{problem}; {_advise_key(name, 'mass_kg')}")
        if name in leading and inertial.lacks and given is None:
            advice = _advise_key(name, "inertia_kg_m2")
            _refuse(_link(name), f"its <inertial> has no <inertia>; {advice}")
        if problem:
            notes.append(
                f"{_link(name)} does not lead to the end link and is left out: {problem}"
            )
            continue
        if inertial.lacks:
            notes.append(
                f"{_link(name)} states a mass and no inertia: a point of {inertial.mass:g} kg"
            )
        yield _read_body(
            name=name, pose=pose, inertial=inertial, path=path, inertias=inertias, notes=notes
        )


def _read_body(
    name: str,
    pose: _Pose,
    inertial: "_Inertial",
    path: Sequence[_Edge],
    inertias: _Inertias,
    notes: list[str],
) -> _LinkBody:
    """Returns the body of a link, balanced where that is asked for; refused if it leads to the
    end link.
    """
    mass, centre, tensor, _ = inertial
    moments = _principal_moments(tensor)
    slack = max(LEAST_MOMENT_KG_M2, CONSISTENCY * moments[2])
    problem = _find_moments_problem(moments, -slack, slack)
    if not problem:
        return _LinkBody(name, _move_body(mass, centre, tensor, pose))
    if inertias.balance:
        tensor = balance_tensor(tensor)
        least, middle, most = _principal_moments(tensor)
        notes.append(
            f"{_link(name)}: {problem}; balanced to {least:.4g}, {middle:.4g} and {most:.4g}"
        )
        return _LinkBody(name, _move_body(mass, centre, tensor, pose))
    given = inertias.links.get(name)
    if given is not None and given.inertia_kg_m2 is not None:
        raise ScenarioError(problem, path=f"{_key(name)}.inertia_kg_m2")
    if any(edge.child == name for edge in path):
        _refuse(_link(name), f"{problem}; {_advise_balance(name, path)}")
    point = _move_body(mass, centre, fill_tensor((0.0,) * 6), pose)
    return _LinkBody(name, _move_body(mass, centre, tensor, pose), point, problem)


def _advise_key(name: str, key: str) -> str:
    return f"give {key} in [arm.{_key(name)}]"


def _advise_balance(name: str, path: Sequence[_Edge]) -> str:
    """Returns what an author can do about moments of a link on the path that no body has."""
    ways = ["set arm.balance_inertia = true", _advise_key(name, "inertia_kg_m2")]
    moving = [edge for edge in path if edge.moves]
    if len(moving) > 1 and moving[-1].child == name:
        ways.append(f"end the arm before it with arm.tip = {_quote(moving[-1].parent)}")
    return ", or ".join(ways)


def _note_given(name: str, given: LinkInertia) -> str:
    if given.mass_kg == 0.0:
        return f"{_link(name)}: the scenario leaves its mass out"
    return (
        f"{_link(name)}: {', '.join(given.list_given_keys())} of the scenario, in place of the file's"
    )


def _read_joint(
    edge: _Edge, pose: _Pose, inertia: BodyParameters, notes: list[str]
) -> UrdfJoint:
    place = _joint(edge.name)
    axis = _child(edge.element, "axis", place)
    x, y, z = (1.0, 0.0, 0.0) if axis is None else _read_vector(axis, "xyz", place)
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-6:
        _refuse(
            place,
            "its <axis> has no length: give the direction of the joint, as in xyz='0 0 1'",
        )
    lower, upper, effort, velocity = _read_limit(edge, place, notes)
    dynamics = _child(edge.element, "dynamics", place)
    friction = [0.0, 0.0]
    for n, key in enumerate(("damping", "friction")):
        if dynamics is not None and key in dynamics.attrib:
            friction[n] = _read_number(dynamics, key, place)
            if friction[n] < 0.0:
                _refuse(
                    place,
                    f"its {key} is {friction[n]:g}, must not be negative: it would drive the joint",
                )
    kind = "prismatic" if edge.kind == "prismatic" else "revolute"
    axes = (x / length, y / length, z / length)
    return UrdfJoint(
        edge.name,
        edge.child,
        kind,
        axes,
        *pose,
        inertia,
        lower,
        upper,
        effort,
        velocity,
        *friction,
    )


def _read_limit(edge: _Edge, place: str, notes: list[str]) -> tuple[float, float, float, float]:
    """Returns least and largest position, effort and velocity; exporters write 0 for what they
    lack.
    """
    limit = _child(edge.element, "limit", place)
    values = []
    for key in ("lower", "upper", "effort", "velocity"):
        stated = limit is not None and key in limit.attrib
        value = (
            _read_number(limit, key, place, math.inf) if limit is not None and stated else 0.0
        )
        values.append(math.copysign(math.inf, value) if abs(value) > MAX_QUANTITY else value)
    lower, upper, effort, velocity = values
    if min(effort, velocity) < 0.0:
        _refuse(
            place,
            f"its limits of effort and velocity are {effort:g} and {velocity:g}, must be positive",
        )
    unknown = [
        key for key, value in (("effort", effort), ("velocity", velocity)) if value == 0.0
    ]
    if edge.kind == "continuous":
        lower = -math.inf
        upper = math.inf
    elif lower == upper == 0.0:
        unknown.insert(0, "position")
        lower = -math.inf
        upper = math.inf
    if lower > upper:
        _refuse(place, f"its lower limit is {lower:g}, must be below the upper one, {upper:g}")
    if lower == upper:
        _refuse(
            place,
            f"its limits are both {lower:g}: a joint that does not move is of type 'fixed'",
        )
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
        _refuse(
            place,
            f"its <{element.tag} {key}> has {count_nouns(len(words), 'number')}, must have three",
        )
    x, y, z = (_parse_number(word, f"{element.tag} {key}", place, most) for word in words)
    return x, y, z


def _read_origin(parent: Element, place: str) -> _Pose:
    """Returns the frame that an <origin> states; without one, that of its parent."""
    origin = _child(parent, "origin", place)
    if origin is None:
        return _Pose()
    if unknown := origin.attrib.keys() - {"xyz", "rpy"}:
        _refuse(
            place,
            f"its <origin> has {_quote(min(unknown))}: a frame is given by xyz and rpy alone",
        )
    offset = (
        _read_vector(origin, "xyz", place, MAX_OFFSET_M) if "xyz" in origin.attrib else _ZERO
    )
    angles = _read_vector(origin, "rpy", place) if "rpy" in origin.attrib else _ZERO
    (sr, cr), (sp, cp), (sy, cy) = map(_plain_sincos, angles)
    rotation = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return _Pose(rotation, offset)


# Inertia


class _Inertial(NamedTuple):
    """The inertia of a link in the link's frame.

    Attributes:
        mass: kg; 0 if none is stated.
        centre: the centre of mass, with the axes of the tensor.
        tensor: about the centre of mass, kg m^2; zero if none is stated.
        lacks: what neither the file nor the scenario states: "mass", "inertia" or "".
    """

    mass: float
    centre: _Pose
    tensor: Matrix
    lacks: str


_TENSOR_KEYS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_POINT = fill_tensor((0.0,) * 6)


def _read_inertial(link: Element, name: str, given: LinkInertia | None) -> _Inertial | None:
    """Returns the inertia of a link by the scenario, and otherwise by the file; None if none is
    stated.
    """
    given = given or LinkInertia()
    inertial = _child(link, "inertial", _link(name))
    if given.mass_kg == 0.0:
        for key in given.list_given_keys()[1:]:
            raise ScenarioError(
                "is of a link without mass: leave it out", path=f"{_key(name)}.{key}"
            )
        return None
    if inertial is None and given.mass_kg is None:
        if given.list_given_keys():
            problem = f"is missing: the file states no mass of {_link(name)}"
            raise ScenarioError(problem, path=f"{_key(name)}.mass_kg")
        return None
    mass = given.mass_kg
    centre = _Pose()
    tensor = None
    if inertial is not None:
        mass, centre, tensor = _read_stated_inertial(inertial, name, given)
    # in the axes of the link, and not in those of the <origin>
    if given.inertia_kg_m2 is not None:
        centre = _Pose(_UNIT, centre.origin_m)
        tensor = fill_tensor(given.inertia_kg_m2)
    if given.com_m is not None:
        x, y, z = given.com_m
        centre = _Pose(centre.rotation, (x, y, z))
    lacks = "mass" if mass is None else "inertia" if tensor is None else ""
    return _Inertial(mass or 0.0, centre, _POINT if tensor is None else tensor, lacks)


def _read_stated_inertial(
    inertial: Element, name: str, given: LinkInertia
) -> tuple[float | None, _Pose, Matrix | None]:
    """Returns mass, frame and tensor of an <inertial>; what the scenario gives is not read."""
    place = _link(name)
    mass = given.mass_kg
    tensor = None
    mass_element = _child(inertial, "mass", place)
    tensor_element = _child(inertial, "inertia", place)
    if mass is None and mass_element is not None:
        mass = _read_number(mass_element, "value", place)
    if given.inertia_kg_m2 is None and tensor_element is not None:
        tensor = fill_tensor([_read_number(tensor_element, key, place) for key in _TENSOR_KEYS])
    replaced = given.com_m is not None and given.inertia_kg_m2 is not None
    centre = _Pose() if replaced else _read_origin(inertial, place)
    return mass, centre, tensor


def _find_mass_problem(inertial: _Inertial) -> str:
    """Returns why a mass cannot be, or ""."""
    if inertial.lacks == "mass":
        return "its <inertial> has no <mass>"
    if inertial.mass < 0.0:
        return f"its mass is {inertial.mass:g} kg, must not be negative"
    if inertial.mass == 0.0 and any(map(any, inertial.tensor)):
        return "has moments of inertia and no mass: give both, or neither"
    return ""


def _read_payload(payload: UrdfPayload, fixed: Sequence[_Edge]) -> BodyParameters:
    """Returns the payload in the frame of the last moving link, from which fixed joints lead to
    the tip.
    """
    pose = _Pose()
    for edge in fixed:
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
    tensor = fill_tensor(payload.inertia_kg_m2)
    moments = _principal_moments(tensor)
    slack = max(LEAST_MOMENT_KG_M2, CONSISTENCY * moments[2])
    if problem := _find_moments_problem(moments, -slack, slack):
        _refuse("payload", problem)
    x, y, z = payload.com_m
    return _move_body(payload.mass_kg, _Pose(_UNIT, (x, y, z)), tensor, pose)


def _principal_moments(tensor: Matrix) -> list[float]:
    return [float(moment) for moment in np.linalg.eigvalsh(np.array(tensor))]


def _find_moments_problem(moments: Sequence[float], bound: float, slack: float) -> str:
    """Returns why principal moments of inertia, in ascending order, are those of no body, or
    "".
    """
    least, middle, most = moments
    stated = (
        f"its principal moments of inertia are {least:.4g}, {middle:.4g} and {most:.4g} kg m^2"
    )
    if least < bound:
        return f"{stated}, and all must be positive"
    if most - least - middle > slack:
        return f"{stated}, and of a body, no one is more than the two others together"
    return ""


def _move_body(mass: float, centre: _Pose, tensor: Matrix, pose: _Pose) -> BodyParameters:
    """Returns the parameters of a body about the frame in which a link has that pose.

    Its centre of mass and the axes of its tensor are given in the frame of the link.
    """
    (r0, r1, r2), (x, y, z) = pose @ centre
    columns = apply(tensor, r0), apply(tensor, r1), apply(tensor, r2)
    (xx, xy, xz) = apply(columns, r0)
    (_, yy, yz) = apply(columns, r1)
    (_, _, zz) = apply(columns, r2)
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


def _lump_bodies(edge: _Edge, bodies: Sequence[_LinkBody], notes: list[str]) -> BodyParameters:
    """Returns the sum of bodies that one joint moves; refused unless it is a body with mass and
    extent.

    Links off the path whose moments no body has count as stated if the sum is a body, else as
    points.
    """
    place = f"{_link(edge.child)}, which {_joint(edge.name)} moves"
    if not bodies:
        advice = f"give mass_kg and inertia_kg_m2 in [arm.{_key(edge.child)}]"
        _refuse(place, f"has no <inertial>, and nothing fixed to it has one; {advice}")
    total = _add_bodies([one.body for one in bodies])
    problem = _find_sum_problem(total)
    doubtful = [one for one in bodies if one.point is not None]
    as_points = bool(problem and doubtful)
    if as_points:
        total = _add_bodies([one.point or one.body for one in bodies])
        problem = _find_sum_problem(total)
    if problem:
        key = "mass_kg" if total[0] < LEAST_MASS_KG else "inertia_kg_m2"
        _refuse(place, f"{problem}; {_advise_key(edge.child, key)}")
    for one in doubtful:
        counts = f"as a point of {one.body[0]:g} kg" if as_points else "as stated"
        notes.append(
            f"{_link(one.link)} does not lead to the end link and counts {counts}, although {one.problem}; "
            "arm.balance_inertia = true balances them"
        )
    return total


def _add_bodies(bodies: Sequence[BodyParameters]) -> BodyParameters:
    total = bodies[0]
    for body in bodies[1:]:  # one by one: the built-in sum rounds otherwise from Python 3.12 on
        total = tuple(a + b for a, b in zip(total, body, strict=True))
    return total


def _find_sum_problem(total: BodyParameters) -> str:
    """Returns why the parameters of all that a joint moves are those of no body with extent, or
    "".
    """
    mass = total[0]
    if mass < LEAST_MASS_KG:
        return f"has {mass:g} kg with all that is fixed to it, and a body that moves needs mass"
    x, y, z = (moment / mass for moment in total[1:4])
    back = _move_body(-mass, _Pose(_UNIT, (x, y, z)), fill_tensor(total[4:]), _Pose())
    moments = _principal_moments(fill_tensor(back[4:]))
    slack = CONSISTENCY * moments[2]
    return _find_moments_problem(moments, max(LEAST_MOMENT_KG_M2, slack), slack)

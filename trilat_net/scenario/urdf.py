"""Read arms from URDF: the bodies and joints between a base and an end link.

Units are those of URDF: kg, m, rad, N m; N along a prismatic joint. The frame of a link lies on
the joint that moves the link.

Invariant:
    - A chain that is read is physical: every moving body has mass, and its principal moments of
      inertia are positive and satisfy the triangle inequality.
    - Everything that hangs on a moving link is part of its body. A link that does not lead to
      the end link never makes an arm unusable: if no body can have its inertia, a note says how
      the link counts.
    - A link on the way to the end link whose inertia no body can have is refused by name,
      unless the caller balances inertias or gives that link another inertia.
    - The text is not trusted: no file that it names is opened, and no entity is expanded.
    - The numbers of a chain have the same bits on every machine: angles become matrices by
      `core.elementary.sincos` and sums in a fixed order.
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
MAX_NUMBER_LENGTH = 100
"""Largest length of a number. The time to match a text that is not a number grows with the
square of its length.
"""
MAX_OFFSET_M = 100.0
"""Largest coordinate of an origin. A file with larger ones is in millimetres, or wrong."""
CONSISTENCY = 1e-9
"""Share of the largest principal moment by which rounding may violate the inequalities."""
LEAST_MASS_KG = 1e-9
LEAST_MOMENT_KG_M2 = 1e-12
"""Least mass and least principal moment of a body that moves. The moments of a single link may
violate the inequalities by less than the latter.
"""
_MIN_AXIS_LENGTH = 1e-6
_MAX_LISTED_NAMES = 8
_MAX_QUOTED_LENGTH = 60

BodyParameters = tuple[float, ...]
"""m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz about a frame's origin, in its axes."""

_ORIGIN: Three = (0.0, 0.0, 0.0)
_IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MOVING_KINDS = ("revolute", "continuous", "prismatic")
_KINDS = (*_MOVING_KINDS, "fixed", "floating", "planar")
_plain_sincos = getattr(sincos, "py_func", sincos)
"""`sincos` without compilation, which would take longer than reading a file."""


class UrdfPayload(NamedTuple):
    """A body fixed to the end link.

    Attributes:
        mass_kg: its mass.
        com_m: its centre of mass in the frame of the end link.
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about its centre of mass in the axes of the
            end link.
    """

    mass_kg: float
    com_m: Sequence[float] = _ORIGIN
    inertia_kg_m2: Sequence[float] = (0.0,) * 6


class UrdfJoint(NamedTuple):
    """A joint that moves, and the body that it moves.

    Attributes:
        name: the name of the joint.
        link: the name of the link that the joint moves.
        kind: "revolute" (also for a continuous joint) or "prismatic".
        axis: unit vector in the joint's frame.
        rotation: orientation of the joint's frame at q = 0, three rows, in the frame of the
            previous moving link; for the first joint in the frame of the base.
        origin_m: origin of the joint's frame in the same frame.
        inertia: the body's `BodyParameters` in the joint's frame, with everything that is fixed
            to the link.
        lower: least position, rad or m; -inf if the file states no limit.
        upper: largest position, rad or m; inf if the file states no limit.
        effort_limit: largest effort, N m or N; inf if the file states no limit.
        velocity_limit: largest speed, rad/s or m/s; inf if the file states no limit.
        viscous: viscous friction, N m s/rad or N s/m.
        coulomb: Coulomb friction, N m or N.
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
    """An arm: the joints that move between a base and an end link.

    Attributes:
        base: the name of the link that does not move.
        tip: the name of the end link.
        joints: 1 to `MAX_JOINTS` joints, from the base on.
        tip_rotation: orientation of the end link in the frame of the last moving link, three
            rows.
        tip_origin_m: origin of the end link in the same frame.
        notes: sentences on what may differ from the intention of the file.
    """

    base: str
    tip: str
    joints: tuple[UrdfJoint, ...]
    tip_rotation: Matrix
    tip_origin_m: Three
    notes: tuple[str, ...]


class _Pose(NamedTuple):
    """The orientation and the origin of a frame in another frame."""

    rotation: Matrix = _IDENTITY
    origin_m: Three = _ORIGIN

    def __matmul__(self, inner: "_Pose") -> "_Pose":
        """Returns the pose of a frame that is given in this frame."""
        x, y, z = apply(self.rotation, inner.origin_m)
        ox, oy, oz = self.origin_m
        return _Pose(multiply(self.rotation, inner.rotation), (ox + x, oy + y, oz + z))


class _Edge(NamedTuple):
    """A joint of the file, which connects two links."""

    name: str
    kind: str
    parent: str
    child: str
    element: Element

    @property
    def moves(self) -> bool:
        return self.kind in _MOVING_KINDS


class _Robot(NamedTuple):
    """The links and joints of a file, a tree.

    Attributes:
        links: the elements of the links, by name.
        above: the joint that moves each link but the root, by the link's name.
        below: the joints that hang on each link, by the link's name.
    """

    links: Mapping[str, Element]
    above: Mapping[str, _Edge]
    below: Mapping[str, Sequence[_Edge]]


class _Inertias(NamedTuple):
    """The changes that a scenario makes to the inertias of a file.

    Attributes:
        links: masses and inertias in place of those in the file, by the link's name.
        balance: true: a tensor that no body can have is balanced; false: it is refused, or a
            note reports it.
    """

    links: Mapping[str, LinkInertia]
    balance: bool


class _LinkBody(NamedTuple):
    """The body of a link, in the frame of the moving link to which it belongs.

    Attributes:
        link: the name of the link.
        body: its parameters as they are stated, or balanced.
        point: its parameters as a point of mass, if no body can have its moments; else None.
        problem: why no body can have its moments; "" if a body can.
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

    A link behind a fixed joint is part of the moving link before it. So is a branch that a
    moving link carries on joints of its own, such as fingers, at the zero position of these
    joints; a note says so.

    Args:
        text: the URDF document.
        base: the link that does not move; "": the root of the robot.
        tip: the end link; "": the only leaf that moves.
        payload: a body that the end link carries.
        links: masses and inertias in place of those in the file, by the link's name.
        balance: true: a stated inertia that no body can have is replaced by the nearest inertia
            that a body can have.

    Raises:
        ScenarioError: the file cannot be used; with the line, link or joint. A problem of a key
            of `links` has its path, as in links.NAME.mass_kg.
    """
    robot = _read_tree(_parse_xml(text))
    base = _check_end(robot, "base", base) or _find_base(robot)
    tip = _check_end(robot, "tip", tip) or _find_tip(robot, base)
    path = _find_path(robot, base, tip)
    inertias = _Inertias(links or {}, balance)
    joints: list[UrdfJoint] = []
    notes: list[str] = []
    moved_links: set[str] = set()
    pose = _Pose()
    last_moving = max(n for n, edge in enumerate(path) if edge.moves)
    for n, edge in enumerate(path):
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
        if not edge.moves:
            continue
        carried = list(_walk_carried(robot, edge, path, notes))
        moved_links |= {name for name, _ in carried}
        bodies = list(
            _read_bodies(
                robot=robot, carried=carried, path=path, inertias=inertias, notes=notes
            )
        )
        if payload is not None and n == last_moving:
            bodies.append(_LinkBody("payload", _read_payload(payload, path[n + 1 :])))
        body = _lump_bodies(edge, bodies, notes)
        joints.append(_read_joint(edge, pose, body, notes))
        pose = _Pose()
    _check_supplied_inertias(robot, inertias.links, moved_links)
    return UrdfChain(
        base=base,
        tip=tip,
        joints=tuple(joints),
        tip_rotation=pose.rotation,
        tip_origin_m=pose.origin_m,
        notes=tuple(notes),
    )


def _check_supplied_inertias(
    robot: _Robot, links: Mapping[str, LinkInertia], moved_links: Collection[str]
) -> None:
    """Refuses inertias of links that the robot lacks, or that no joint of the arm moves."""
    for name in links:
        if name not in robot.links:
            hint = suggest_nearest(name, list(robot.links))
            raise ScenarioError(f"there is no {_link(name)}{hint}", path=_key(name))
        if name not in moved_links:
            raise ScenarioError(
                f"{_link(name)} is moved by no joint between base and tip: its inertia has no "
                "effect",
                path=_key(name),
            )


def _key(link: str) -> str:
    """Returns the key path of a link's inertia, as an author writes it."""
    return f"links.{link}" if re.fullmatch(r"[A-Za-z0-9_-]+", link) else f'links."{link}"'


def _refuse(subject: str, problem: str) -> NoReturn:
    """Raises the error of a problem; `subject`: the link, joint or line, "" for the file."""
    raise ScenarioError(f"{subject}: {problem}" if subject else problem)


def _quote(text: str) -> str:
    """Returns a text in quotation marks, cut off if it is long."""
    if len(text) > _MAX_QUOTED_LENGTH:
        text = f"{text[: _MAX_QUOTED_LENGTH - 3]}..."
    return repr(text)


def _link(name: str) -> str:
    return f"link {_quote(name)}"


def _joint(name: str) -> str:
    return f"joint {_quote(name)}"


def _list_names(names: Sequence[str]) -> str:
    text = ", ".join(map(_quote, names[:_MAX_LISTED_NAMES]))
    more = len(names) - _MAX_LISTED_NAMES
    return f"{text} and {more} more" if more > 0 else text


# The document


def _parse_xml(text: str) -> Element:
    """Returns the root element of a URDF document."""
    if len(text) > MAX_CHARACTERS:
        _refuse(
            "", f"has {count_nouns(len(text), 'character')}, at most {MAX_CHARACTERS} are read"
        )
    for declaration in ("<!DOCTYPE", "<!ENTITY"):
        if declaration in text:
            line = text.count("\n", 0, text.index(declaration)) + 1
            _refuse(
                f"line {line}",
                f"{declaration} is not read: a robot needs no document type and no entities",
            )
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        _refuse(f"line {error.position[0]}", f"is not XML: {error.msg.partition(':')[0]}")
    # A character that cannot be encoded.
    except ValueError as error:
        _refuse("", f"is not XML: {error}")
    for element in root.iter():
        if _is_xacro(element):
            tag = element.tag.rpartition("}")[2]
            _refuse(
                f"<{tag[:_MAX_QUOTED_LENGTH]}>",
                "is xacro, a template of URDF: expand it with `xacro FILE.urdf.xacro > "
                "FILE.urdf`",
            )
    if root.tag != "robot":
        tag = root.tag[:_MAX_QUOTED_LENGTH]
        _refuse("", f"its root element is <{tag}>, that of URDF is <robot>")
    return root


def _is_xacro(element: Element) -> bool:
    """True if an element belongs to xacro, or has an expression of xacro in an attribute."""
    namespace = element.tag.partition("}")[0]
    return "xacro" in namespace or any("${" in value for value in element.attrib.values())


def _name_elements(root: Element, tag: str) -> dict[str, Element]:
    """Returns the elements of a tag below the root, by their names, which must differ."""
    elements: dict[str, Element] = {}
    for n, element in enumerate(root.findall(tag), 1):
        name = element.get("name", "")
        if not name.strip():
            _refuse(f"{tag} number {n}", "has no name")
        if name in elements:
            _refuse(
                f"{tag} {_quote(name)}",
                f"there are two of that name: give every {tag} its own",
            )
        elements[name] = element
    return elements


def _read_tree(root: Element) -> _Robot:
    """Returns the tree of links and joints; refuses graphs that are not trees."""
    links = _name_elements(root, "link")
    above: dict[str, _Edge] = {}
    below: dict[str, list[_Edge]] = {name: [] for name in links}
    for name, element in _name_elements(root, "joint").items():
        edge = _read_edge(name, element, links)
        if edge.child in above:
            _refuse(
                _link(edge.child),
                f"hangs on two joints, {_quote(above[edge.child].name)} and {_quote(name)}: "
                "closed loops are not supported; leave out one of the two joints",
            )
        above[edge.child] = edge
        below[edge.parent].append(edge)
    robot = _Robot(links, above, below)
    roots = [name for name in links if name not in above]
    rooted_links = {name for root_name in roots for name, _ in _walk(robot, root_name)}
    for name in links:
        if name not in rooted_links:
            _refuse(
                _link(name),
                f"hangs on itself by {_joint(above[name].name)}: joints may not form a loop",
            )
    if not links:
        _refuse("", "has no links")
    return robot


def _read_edge(name: str, element: Element, links: Mapping[str, Element]) -> _Edge:
    """Returns a joint of the file with its type and the two links that it connects."""
    subject = _joint(name)
    kind = element.get("type", "")
    if kind not in _KINDS:
        hint = suggest_nearest(kind, _KINDS)
        _refuse(subject, f"is of type {_quote(kind)}, must be one of {', '.join(_KINDS)}{hint}")
    ends = []
    for tag in ("parent", "child"):
        end_element = _child(element, tag, subject)
        end = "" if end_element is None else end_element.get("link", "")
        if end not in links:
            hint = suggest_nearest(end, list(links))
            _refuse(
                subject,
                f"its <{tag}> is {_link(end)}, and there is no link of that name{hint}",
            )
        ends.append(end)
    return _Edge(name=name, kind=kind, parent=ends[0], child=ends[1], element=element)


def _walk(robot: _Robot, root: str) -> Iterator[tuple[str, bool]]:
    """Yields `root` and each link below it, and whether a joint below `root` moves the link."""
    waiting = [(root, False)]
    while waiting:
        name, is_moved = waiting.pop()
        yield name, is_moved
        waiting += [
            (edge.child, is_moved or edge.kind != "fixed")
            for edge in reversed(robot.below[name])
        ]


# The chain


def _check_end(robot: _Robot, end: str, link: str) -> str:
    """Returns a link's name; refuses a name that the robot lacks. `end`: "base" or "tip"."""
    if link and link not in robot.links:
        _refuse(end, f"there is no {_link(link)}{suggest_nearest(link, list(robot.links))}")
    return link


def _find_base(robot: _Robot) -> str:
    """Returns the only link that hangs on no joint."""
    roots = [name for name in robot.links if name not in robot.above]
    if len(roots) > 1:
        _refuse(
            f"links {_list_names(roots)}",
            "hang on no joint: connect them, or name the one that the arm stands on as base",
        )
    return roots[0]


def _find_tip(robot: _Robot, base: str) -> str:
    """Returns the only leaf that moves with respect to the base."""
    leaves = [
        name for name, is_moved in _walk(robot, base) if is_moved and not robot.below[name]
    ]
    if not leaves:
        _refuse(_link(base), "no joint below it moves")
    if len(leaves) > 1:
        _refuse(
            "",
            f"the arm may end at links {_list_names(leaves)}: name one of them, or a link "
            "before, as tip",
        )
    return leaves[0]


def _find_path(robot: _Robot, base: str, tip: str) -> list[_Edge]:
    """Returns the joints from the base to the tip; refuses joints that an arm cannot have."""
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
                f"is {edge.kind}: joints of an arm are revolute, continuous, prismatic or "
                f"fixed; give a base behind it, such as {_quote(edge.child)}",
            )
        if edge.element.find("mimic") is not None:
            _refuse(
                _joint(edge.name),
                "follows another joint (<mimic>), which has no torque of its own: make it "
                f"fixed, or give a tip before it, such as {_quote(edge.parent)}",
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
    """Yields every link between a joint of the path and the next joint of the path.

    Yields:
        The name of a link, and its frame in that of the link that the joint moves.
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
    """Yields the bodies of links, in the frame of the moving link that carries them.

    Args:
        robot: the robot.
        carried: the names of the links, and their frames in that of the moving link.
        path: the joints of the arm.
        inertias: the changes that the scenario makes.
        notes: receives a sentence on each doubtful link.
    """
    leading_links = {edge.child for edge in path}
    for name, pose in carried:
        supplied = inertias.links.get(name)
        if supplied is not None:
            notes.append(_note_supplied(name, supplied))
        inertial = _read_inertial(robot.links[name], name, supplied)
        if inertial is None:
            continue
        problem = _find_mass_problem(inertial)
        if problem and supplied is not None:
            key = "mass_kg" if supplied.inertia_kg_m2 is None else "inertia_kg_m2"
            raise ScenarioError(problem, path=f"{_key(name)}.{key}")
        if name in leading_links and problem:
            _refuse(_link(name), f"{problem}; {_advise_key(name, 'mass_kg')}")
        if name in leading_links and inertial.lacks and supplied is None:
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
    """Returns the body of a link, balanced if its inertia is impossible and may be balanced.

    Raises:
        ScenarioError: no body can have the inertia, and the scenario gave it, or the link leads
            to the end link.
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
    supplied = inertias.links.get(name)
    if supplied is not None and supplied.inertia_kg_m2 is not None:
        raise ScenarioError(problem, path=f"{_key(name)}.inertia_kg_m2")
    if any(edge.child == name for edge in path):
        _refuse(_link(name), f"{problem}; {_advise_balance(name, path)}")
    stated = _move_body(mass, centre, tensor, pose)
    point = _move_body(mass, centre, _POINT_TENSOR, pose)
    return _LinkBody(name, stated, point, problem)


def _advise_key(name: str, key: str) -> str:
    return f"give {key} in [arm.{_key(name)}]"


def _advise_balance(name: str, path: Sequence[_Edge]) -> str:
    """Returns the remedies for a link on the path whose moments no body can have."""
    remedies = ["set arm.balance_inertia = true", _advise_key(name, "inertia_kg_m2")]
    moving_edges = [edge for edge in path if edge.moves]
    if len(moving_edges) > 1 and moving_edges[-1].child == name:
        parent = _quote(moving_edges[-1].parent)
        remedies.append(f"end the arm before it with arm.tip = {parent}")
    return ", or ".join(remedies)


def _note_supplied(name: str, supplied: LinkInertia) -> str:
    """Returns the note on a link whose mass or inertia the scenario gives."""
    if supplied.mass_kg == 0.0:
        return f"{_link(name)}: the scenario leaves its mass out"
    keys = ", ".join(supplied.list_given_keys())
    return f"{_link(name)}: {keys} of the scenario, in place of the file's"


def _read_joint(
    edge: _Edge, pose: _Pose, inertia: BodyParameters, notes: list[str]
) -> UrdfJoint:
    """Returns a joint of the arm.

    Args:
        edge: the joint of the file.
        pose: its frame in that of the previous moving link.
        inertia: the body that it moves.
        notes: receives a sentence on limits that the file does not state.
    """
    subject = _joint(edge.name)
    axis = _child(edge.element, "axis", subject)
    x, y, z = (1.0, 0.0, 0.0) if axis is None else _read_vector(axis, "xyz", subject)
    length = math.sqrt(x * x + y * y + z * z)
    if length < _MIN_AXIS_LENGTH:
        _refuse(
            subject,
            "its <axis> has no length: give the direction of the joint, as in xyz='0 0 1'",
        )
    limits = _read_limits(edge, subject, notes)
    viscous, coulomb = _read_friction(edge, subject)
    return UrdfJoint(
        name=edge.name,
        link=edge.child,
        kind="prismatic" if edge.kind == "prismatic" else "revolute",
        axis=(x / length, y / length, z / length),
        rotation=pose.rotation,
        origin_m=pose.origin_m,
        inertia=inertia,
        lower=limits.lower,
        upper=limits.upper,
        effort_limit=limits.effort,
        velocity_limit=limits.velocity,
        viscous=viscous,
        coulomb=coulomb,
    )


def _read_friction(edge: _Edge, subject: str) -> tuple[float, float]:
    """Returns the viscous and the Coulomb friction of a joint; 0 if not stated."""
    dynamics = _child(edge.element, "dynamics", subject)
    friction = [0.0, 0.0]
    for n, key in enumerate(("damping", "friction")):
        if dynamics is not None and key in dynamics.attrib:
            friction[n] = _read_number(dynamics, key, subject)
            if friction[n] < 0.0:
                _refuse(
                    subject,
                    f"its {key} is {friction[n]:g}, must not be negative: it would drive the "
                    "joint",
                )
    return friction[0], friction[1]


class _JointLimits(NamedTuple):
    """Limits of a joint: of its position, rad or m, its effort and its velocity."""

    lower: float
    upper: float
    effort: float
    velocity: float


def _read_limits(edge: _Edge, subject: str, notes: list[str]) -> _JointLimits:
    """Returns the limits of a joint, infinite where the file does not state them.

    A limit of 0 counts as not stated, because exporters write 0 for limits that they lack.
    """
    limit = _child(edge.element, "limit", subject)
    values = []
    for key in ("lower", "upper", "effort", "velocity"):
        value = 0.0
        if limit is not None and key in limit.attrib:
            value = _read_number(limit, key, subject, math.inf)
        values.append(math.copysign(math.inf, value) if abs(value) > MAX_QUANTITY else value)
    lower, upper, effort, velocity = values
    if min(effort, velocity) < 0.0:
        _refuse(
            subject,
            f"its limits of effort and velocity are {effort:g} and {velocity:g}, must be "
            "positive",
        )
    unstated = [
        key for key, value in (("effort", effort), ("velocity", velocity)) if value == 0.0
    ]
    if edge.kind == "continuous":
        lower = -math.inf
        upper = math.inf
    elif lower == upper == 0.0:
        unstated.insert(0, "position")
        lower = -math.inf
        upper = math.inf
    if lower > upper:
        _refuse(
            subject, f"its lower limit is {lower:g}, must be below the upper one, {upper:g}"
        )
    if lower == upper:
        _refuse(
            subject,
            f"its limits are both {lower:g}: a joint that does not move is of type 'fixed'",
        )
    if unstated:
        limits = " and ".join(unstated)
        notes.append(f"{subject} states no limit of {limits}, or 0: it has no such limit")
    return _JointLimits(lower, upper, effort or math.inf, velocity or math.inf)


# Elements and numbers


def _child(element: Element, tag: str, subject: str) -> Element | None:
    """Returns the only child element of a tag, or None; refuses several children."""
    children = element.findall(tag)
    if len(children) > 1:
        _refuse(subject, f"has {len(children)} <{tag}>: keep one")
    return children[0] if children else None


def _read_number(
    element: Element, key: str, subject: str, limit: float = MAX_QUANTITY
) -> float:
    """Returns the number of an attribute, whose absolute value is at most `limit`."""
    text = element.get(key)
    if text is None:
        _refuse(subject, f"its <{element.tag}> has no {key}")
    return _parse_number(text, f"{element.tag} {key}", subject, limit)


def _parse_number(text: str, attribute: str, subject: str, limit: float) -> float:
    stripped = text.strip() if len(text) <= MAX_NUMBER_LENGTH else ""
    value = float(stripped) if _NUMBER.fullmatch(stripped) else math.nan
    if not math.isfinite(value):
        _refuse(subject, f"its <{attribute}> is {_quote(text)}, must be a finite number")
    if abs(value) > limit:
        _refuse(
            subject,
            f"its <{attribute}> is {value:g}, must be at most {limit:g} (kg, m and rad)",
        )
    return value


def _read_vector(
    element: Element, key: str, subject: str, limit: float = MAX_QUANTITY
) -> Three:
    """Returns the three numbers of an attribute, with absolute values of at most `limit`."""
    texts = element.get(key, "").split()
    attribute = f"{element.tag} {key}"
    if len(texts) != 3:
        _refuse(
            subject,
            f"its <{attribute}> has {count_nouns(len(texts), 'number')}, must have three",
        )
    x, y, z = (_parse_number(text, attribute, subject, limit) for text in texts)
    return x, y, z


def _read_origin(parent: Element, subject: str) -> _Pose:
    """Returns the frame that an <origin> states; without it, the frame of its parent."""
    origin = _child(parent, "origin", subject)
    if origin is None:
        return _Pose()
    unknown_keys = origin.attrib.keys() - {"xyz", "rpy"}
    if unknown_keys:
        _refuse(
            subject,
            f"its <origin> has {_quote(min(unknown_keys))}: a frame is given by xyz and rpy "
            "alone",
        )
    offset = _ORIGIN
    if "xyz" in origin.attrib:
        offset = _read_vector(origin, "xyz", subject, MAX_OFFSET_M)
    angles = _read_vector(origin, "rpy", subject) if "rpy" in origin.attrib else _ORIGIN
    # R_z(yaw) R_y(pitch) R_x(roll)
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
        mass: kg; 0 if it is not stated.
        centre: the centre of mass, with the axes of the tensor.
        tensor: about the centre of mass, kg m^2; zero if it is not stated.
        lacks: what neither the file nor the scenario states: "mass", "inertia" or "".
    """

    mass: float
    centre: _Pose
    tensor: Matrix
    lacks: str


_TENSOR_KEYS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_POINT_TENSOR = fill_tensor((0.0,) * 6)


def _read_inertial(link: Element, name: str, supplied: LinkInertia | None) -> _Inertial | None:
    """Returns the inertia of a link, or None if the link has no body.

    Args:
        link: the element of the link.
        name: the name of the link.
        supplied: the inertia that the scenario gives; None: the file alone counts.
    """
    supplied = supplied or LinkInertia()
    inertial = _child(link, "inertial", _link(name))
    if supplied.mass_kg == 0.0:
        other_keys = supplied.list_given_keys()[1:]
        if other_keys:
            raise ScenarioError(
                "is of a link without mass: leave it out", path=f"{_key(name)}.{other_keys[0]}"
            )
        return None
    if inertial is None and supplied.mass_kg is None:
        if supplied.list_given_keys():
            raise ScenarioError(
                f"is missing: the file states no mass of {_link(name)}",
                path=f"{_key(name)}.mass_kg",
            )
        return None
    mass = supplied.mass_kg
    centre = _Pose()
    tensor = None
    if inertial is not None:
        mass, centre, tensor = _read_stated_inertial(inertial, name, supplied)
    if supplied.inertia_kg_m2 is not None:
        # A supplied tensor has the axes of the link, and not those of the <origin>.
        centre = _Pose(_IDENTITY, centre.origin_m)
        tensor = fill_tensor(supplied.inertia_kg_m2)
    if supplied.com_m is not None:
        x, y, z = supplied.com_m
        centre = _Pose(centre.rotation, (x, y, z))
    lacks = ""
    if mass is None:
        lacks = "mass"
    elif tensor is None:
        lacks = "inertia"
    return _Inertial(mass or 0.0, centre, _POINT_TENSOR if tensor is None else tensor, lacks)


def _read_stated_inertial(
    inertial: Element, name: str, supplied: LinkInertia
) -> tuple[float | None, _Pose, Matrix | None]:
    """Returns mass, frame and tensor of an <inertial>.

    Elements that the scenario replaces are not read, so that their problems do not matter.
    """
    subject = _link(name)
    mass = supplied.mass_kg
    tensor = None
    mass_element = _child(inertial, "mass", subject)
    tensor_element = _child(inertial, "inertia", subject)
    if mass is None and mass_element is not None:
        mass = _read_number(mass_element, "value", subject)
    if supplied.inertia_kg_m2 is None and tensor_element is not None:
        entries = [_read_number(tensor_element, key, subject) for key in _TENSOR_KEYS]
        tensor = fill_tensor(entries)
    is_frame_replaced = supplied.com_m is not None and supplied.inertia_kg_m2 is not None
    centre = _Pose() if is_frame_replaced else _read_origin(inertial, subject)
    return mass, centre, tensor


def _find_mass_problem(inertial: _Inertial) -> str:
    """Returns why a mass is impossible, or ""."""
    if inertial.lacks == "mass":
        return "its <inertial> has no <mass>"
    if inertial.mass < 0.0:
        return f"its mass is {inertial.mass:g} kg, must not be negative"
    if inertial.mass == 0.0 and any(map(any, inertial.tensor)):
        return "has moments of inertia and no mass: give both, or neither"
    return ""


def _read_payload(payload: UrdfPayload, fixed: Sequence[_Edge]) -> BodyParameters:
    """Returns the parameters of the payload in the frame of the last moving link.

    Args:
        payload: the payload, in the frame of the tip.
        fixed: the fixed joints from the last moving link to the tip.
    """
    pose = _Pose()
    for edge in fixed:
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
    tensor = fill_tensor(payload.inertia_kg_m2)
    moments = _principal_moments(tensor)
    slack = max(LEAST_MOMENT_KG_M2, CONSISTENCY * moments[2])
    problem = _find_moments_problem(moments, -slack, slack)
    if problem:
        _refuse("payload", problem)
    x, y, z = payload.com_m
    return _move_body(payload.mass_kg, _Pose(_IDENTITY, (x, y, z)), tensor, pose)


def _principal_moments(tensor: Matrix) -> list[float]:
    """Returns the eigenvalues of a tensor in ascending order, for checks and notes only."""
    return [float(moment) for moment in np.linalg.eigvalsh(np.array(tensor))]


def _find_moments_problem(moments: Sequence[float], bound: float, slack: float) -> str:
    """Returns why no body can have three principal moments of inertia, or "".

    Args:
        moments: the moments in ascending order, kg m^2.
        bound: the least moment that is allowed, kg m^2.
        slack: how far the triangle inequality may be violated, kg m^2.
    """
    least, middle, most = moments
    stated = (
        f"its principal moments of inertia are {least:.4g}, {middle:.4g} and {most:.4g} kg m^2"
    )
    if least < bound:
        return f"{stated}, and all must be positive"
    if most - least - middle > slack:
        return f"{stated}, and none of a body's moments exceeds the sum of the other two"
    return ""


def _move_body(mass: float, centre: _Pose, tensor: Matrix, pose: _Pose) -> BodyParameters:
    """Returns the parameters of a body in another frame than that of its link.

    The tensor is turned, R I R^T, and moved by the parallel axis theorem.

    Args:
        mass: kg.
        centre: the centre of mass and the axes of the tensor, in the frame of the link.
        tensor: about the centre of mass, kg m^2.
        pose: the frame of the link in the other frame.
    """
    (r0, r1, r2), (x, y, z) = pose @ centre
    columns = (apply(tensor, r0), apply(tensor, r1), apply(tensor, r2))
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
    """Returns the sum of the bodies that one joint moves.

    The links off the path whose moments no body can have count as stated if the sum is a body,
    else as points of mass.

    Raises:
        ScenarioError: the sum is not a body with mass and extent.
    """
    subject = f"{_link(edge.child)}, which {_joint(edge.name)} moves"
    if not bodies:
        advice = f"give mass_kg and inertia_kg_m2 in [arm.{_key(edge.child)}]"
        _refuse(subject, f"has no <inertial>, and nothing fixed to it has one; {advice}")
    total = _add_bodies([body.body for body in bodies])
    problem = _find_sum_problem(total)
    doubtful_bodies = [body for body in bodies if body.point is not None]
    as_points = bool(problem and doubtful_bodies)
    if as_points:
        total = _add_bodies([body.point or body.body for body in bodies])
        problem = _find_sum_problem(total)
    if problem:
        key = "mass_kg" if total[0] < LEAST_MASS_KG else "inertia_kg_m2"
        _refuse(subject, f"{problem}; {_advise_key(edge.child, key)}")
    for body in doubtful_bodies:
        counts = f"as a point of {body.body[0]:g} kg" if as_points else "as stated"
        notes.append(
            f"{_link(body.link)} does not lead to the end link and counts {counts}, although "
            f"{body.problem}; arm.balance_inertia = true balances them"
        )
    return total


def _add_bodies(bodies: Sequence[BodyParameters]) -> BodyParameters:
    total = bodies[0]
    # Added one by one: the built-in sum rounds differently from Python 3.12 on.
    for body in bodies[1:]:
        total = tuple(a + b for a, b in zip(total, body, strict=True))
    return total


def _find_sum_problem(total: BodyParameters) -> str:
    """Returns why the sum of the bodies at a joint is not a body with extent, or ""."""
    mass = total[0]
    if mass < LEAST_MASS_KG:
        return f"has {mass:g} kg with all that is fixed to it, and a body that moves needs mass"
    x, y, z = (moment / mass for moment in total[1:4])
    # A body of negative mass moves the tensor back to the centre of mass.
    about_centre = _move_body(
        -mass, _Pose(_IDENTITY, (x, y, z)), fill_tensor(total[4:]), _Pose()
    )
    moments = _principal_moments(fill_tensor(about_centre[4:]))
    slack = CONSISTENCY * moments[2]
    return _find_moments_problem(moments, max(LEAST_MOMENT_KG_M2, slack), slack)

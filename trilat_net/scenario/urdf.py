"""Reads arms from URDF files: the joints between a base and an end link, and the moved bodies.

A robot is a tree of links (bodies) and joints; an arm is the path from one link, the base, to
another, the tip. Links fixed to a link of the arm, and branches such as fingers, become part of
the body of that link. Units are those of URDF: kg, m, rad, N m, and N along a prismatic joint.
Each link uses the coordinate frame of the joint that moves it.

Invariant:
    - An arm is physically possible: every moving body has mass, and its principal moments of
      inertia are positive and satisfy the triangle inequality.
    - Everything attached to a moving link is part of its body. A link that does not lead to the
      tip never makes an arm unusable. If its inertia is impossible, a note says how the link
      was treated.
    - If a link on the way to the tip has an impossible inertia, the arm is rejected and the
      error names the link, unless the caller allows inertias to be balanced or supplies another
      inertia for the link.
    - The file content is not trusted: no file named in it is opened, and no entity is expanded.
    - The numbers of an arm have the same bits on every machine. Sines and cosines are therefore
      computed with `core.elementary.sincos`, and sums have a fixed order.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ..core import FramePose, Matrix, Three
from ..errors import ScenarioError, count_nouns, suggest_nearest
from ..fields import MAX_QUANTITY
from ..records import MAX_JOINTS
from .link_inertia import LinkInertia, balance_tensor, fill_tensor

MAX_CHARACTERS = 1_000_000
"""Maximum length of a file, in characters."""
MAX_NUMBER_LENGTH = 100
"""Maximum number of characters in a number.

If the text is not a number, the time taken by the regular expression grows quadratically with
its length.
"""
MAX_OFFSET_M = 100.0
"""Largest coordinate of an origin, in m. Larger ones indicate an error, or millimetres."""
CONSISTENCY = 1e-9
"""Permitted violation of the inertia inequalities relative to the largest moment."""
LEAST_MASS_KG = 1e-9
"""Smallest mass of a moving body, in kg."""
LEAST_MOMENT_KG_M2 = 1e-12
"""Smallest principal moment of inertia of a moving body, in kg m^2.

The moments of a single link may violate the inequalities by less than this.
"""
_MIN_AXIS_LENGTH = 1e-6
"""Smallest length of an axis vector."""
_MAX_LISTED_NAMES = 8
"""Maximum number of names in an error message."""
_MAX_QUOTED_LENGTH = 60
"""Maximum length of a quotation from the file in an error message."""

BodyParameters = tuple[float, ...]
"""Inertial parameters m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz of a body.

m is the mass and c is the centre of mass. The inertia is about the origin of a frame, along its
axes.
"""

_ORIGIN: Three = (0.0, 0.0, 0.0)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MOVING_KINDS = ("revolute", "continuous", "prismatic")
_KINDS = (*_MOVING_KINDS, "fixed", "floating", "planar")


class UrdfPayload(NamedTuple):
    """Body fixed to the tip of an arm, such as a tool that is not in the URDF file.

    Attributes:
        mass_kg: Mass, in kg.
        com_m: Centre of mass in the tip frame, in m.
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the centre of mass, along the axes of
            the tip frame, in kg m^2.
    """

    mass_kg: float
    com_m: Sequence[float] = _ORIGIN
    inertia_kg_m2: Sequence[float] = (0.0,) * 6


class UrdfJoint(NamedTuple):
    """Moving joint of an arm in a URDF file, with the body that it moves.

    Attributes:
        name: Name of the joint.
        link: Name of the link moved by the joint.
        kind: "revolute" (also for a continuous joint) or "prismatic".
        axis: Unit vector of the joint axis in the joint frame.
        rotation: Orientation of the joint frame at q = 0, as three rows, relative to the frame
            of the previous moving link (the base frame for the first joint).
        origin_m: Origin of the joint frame, in m, in the frame of the previous moving link (the
            base frame for the first joint).
        inertia: Inertial parameters of the body in the joint frame, including everything fixed
            to the link.
        lower: Smallest position, in rad or m; -inf if the file has no limit.
        upper: Largest position, in rad or m; inf if the file has no limit.
        effort_limit: Largest torque or force, in N m or N; inf if the file has no limit.
        velocity_limit: Largest speed, in rad/s or m/s; inf if the file has no limit.
        viscous: Viscous friction, in N m s/rad or N s/m.
        coulomb: Coulomb friction, in N m or N.
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
    """Arm read from a URDF file: the moving joints from a base link to a tip link.

    Attributes:
        base: Name of the fixed link.
        tip: Name of the link at the end of the arm.
        joints: 1 to `MAX_JOINTS` joints, from the base to the tip.
        tip_rotation: Orientation of the tip in the frame of the last moving link, as three
            rows.
        tip_origin_m: Origin of the tip in the frame of the last moving link, in m.
        notes: Notes on details that the author of the file may not have intended, as sentences.
    """

    base: str
    tip: str
    joints: tuple[UrdfJoint, ...]
    tip_rotation: Matrix
    tip_origin_m: Three
    notes: tuple[str, ...]


class _Edge(NamedTuple):
    """Joint of a URDF file, which connects a parent link to a child link.

    The links and joints of a robot form a tree, whose edges are the joints.

    Attributes:
        name: Name of the joint.
        kind: Type of the joint in URDF, for example "revolute" or "fixed".
        parent: Name of the link that carries the joint.
        child: Name of the link attached through the joint.
        element: XML element of the joint.
    """

    name: str
    kind: str
    parent: str
    child: str
    element: Element

    @property
    def moves(self) -> bool:
        """True if the joint can move a link of an arm, that is, if it is not a fixed joint."""
        return self.kind in _MOVING_KINDS


class _Robot(NamedTuple):
    """The tree of links and joints described in a URDF file.

    Attributes:
        links: Mapping from link name to XML element.
        above: Mapping from each link except the root to its parent joint.
        below: Mapping from each link to its child joints.
    """

    links: Mapping[str, Element]
    above: Mapping[str, _Edge]
    below: Mapping[str, Sequence[_Edge]]


class _Inertias(NamedTuple):
    """Changes made by a scenario to the masses and inertias in a URDF file.

    Attributes:
        links: Mapping from link name to the mass and inertia that override those in the file.
        balance: If True, an impossible inertia is replaced with the nearest possible one. If
            False, it is rejected or noted.
    """

    links: Mapping[str, LinkInertia]
    balance: bool


class _LinkBody(NamedTuple):
    """Mass and inertia of one link, in the frame of the moving link that carries it.

    A link on a fixed joint moves together with its parent link.

    Attributes:
        link: Name of the link.
        body: Inertial parameters from the file, possibly balanced.
        point: If the moments in the file are impossible, the inertial parameters of a point of
            the same mass; otherwise None.
        problem: Reason why the moments are impossible. Empty if they are possible.
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
    """Parses the arm between two links of a robot from a URDF file.

    A link on a fixed joint becomes part of the moving link that carries it. So does a branch
    with joints of its own, such as fingers: these joints are held at zero, and a note says so.

    Args:
        text: Content of the URDF file.
        base: Name of the fixed link. By default, the root of the robot.
        tip: Name of the link at the end of the arm. By default, the only moving leaf link.
        payload: Body fixed to the tip, such as a tool.
        links: Mapping from link name to the mass and inertia that override those in the file.
        balance: If True, an impossible inertia is replaced with the nearest possible one.

    Raises:
        ScenarioError: The file cannot be used. The error names the line, link or joint. If a
            key of `links` is wrong, the error contains its path, for example
            links.NAME.mass_kg.
    """
    robot = _read_tree(_parse_xml(text))
    base = _check_end(robot, "base", base) or _find_base(robot)
    tip = _check_end(robot, "tip", tip) or _find_tip(robot, base)
    path = _find_path(robot, base, tip)
    inertias = _Inertias(links or {}, balance)

    joints: list[UrdfJoint] = []
    notes: list[str] = []
    moved_links: set[str] = set()
    # pose of the current joint in the frame of the previous moving link
    pose = FramePose()
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
        pose = FramePose()

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
    """Raises ScenarioError if a scenario gives inertias of links that the arm cannot move.

    Such inertias, or inertias of links that do not exist, would have no effect and are probably
    due to a misspelt name.
    """
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
    """Returns the key of a link's inertia in a scenario, quoted if TOML requires it."""
    return f"links.{link}" if re.fullmatch(r"[A-Za-z0-9_-]+", link) else f'links."{link}"'


def _refuse(subject: str, problem: str) -> NoReturn:
    """Raises ScenarioError for an unusable URDF file, naming the wrong part and the problem.

    Args:
        subject: Link, joint or line that is wrong. Empty for the file as a whole.
        problem: Rest of the sentence.
    """
    raise ScenarioError(f"{subject}: {problem}" if subject else problem)


def _quote(text: str) -> str:
    """Returns a string in quotation marks, shortened if it is long."""
    if len(text) > _MAX_QUOTED_LENGTH:
        text = f"{text[: _MAX_QUOTED_LENGTH - 3]}..."
    return repr(text)


def _link(name: str) -> str:
    """Formats the name of a link for error messages."""
    return f"link {_quote(name)}"


def _joint(name: str) -> str:
    """Formats the name of a joint for error messages."""
    return f"joint {_quote(name)}"


def _list_names(names: Sequence[str]) -> str:
    """Returns the first names of a list, and how many more there are, as a short string."""
    text = ", ".join(map(_quote, names[:_MAX_LISTED_NAMES]))
    more = len(names) - _MAX_LISTED_NAMES
    return f"{text} and {more} more" if more > 0 else text


# The document


def _parse_xml(text: str) -> Element:
    """Parses the XML of a URDF file, which may come from an untrusted source.

    Constructs that allow a short text to fill the memory are rejected.

    Args:
        text: The document.

    Returns:
        The root element.

    Raises:
        ScenarioError: The text is too long, is not XML, contains a document type or entities,
            or is not URDF.
    """
    if len(text) > MAX_CHARACTERS:
        _refuse(
            "",
            f"has {count_nouns(len(text), 'character')}, but at most {MAX_CHARACTERS} can be "
            "read",
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
    # raised for a character that cannot be encoded
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
        _refuse("", f"the root element must be <robot>, not <{tag}>")
    return root


def _is_xacro(element: Element) -> bool:
    """Returns True if an element belongs to xacro, a macro language that generates URDF."""
    namespace = element.tag.partition("}")[0]
    return "xacro" in namespace or any("${" in value for value in element.attrib.values())


def _name_elements(root: Element, tag: str) -> dict[str, Element]:
    """Returns a mapping from name to XML element for all elements with a given tag.

    Raises:
        ScenarioError: An element has no name, or two have the same name.
    """
    elements: dict[str, Element] = {}
    for n, element in enumerate(root.findall(tag), 1):
        name = element.get("name", "")
        if not name.strip():
            _refuse(f"{tag} number {n}", "has no name")
        if name in elements:
            _refuse(
                f"{tag} {_quote(name)}",
                f"there are two of this name: give every {tag} its own name",
            )
        elements[name] = element
    return elements


def _read_tree(root: Element) -> _Robot:
    """Parses the tree of links and joints from the root element of a URDF file.

    Args:
        root: Root element of the document.

    Raises:
        ScenarioError: The links and joints do not form trees, because a link has two parent
            joints or is its own ancestor.
    """
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

    # A link that cannot be reached from any root is part of a loop.
    robot = _Robot(links, above, below)
    roots = [name for name in links if name not in above]
    rooted_links = {name for root_name in roots for name, _ in _walk(robot, root_name)}
    for name in links:
        if name not in rooted_links:
            _refuse(
                _link(name),
                f"hangs on itself through {_joint(above[name].name)}: joints must not form a "
                "loop",
            )
    if not links:
        _refuse("", "has no links")
    return robot


def _read_edge(name: str, element: Element, links: Mapping[str, Element]) -> _Edge:
    """Parses one joint of a URDF file: its type, and the two links that it connects.

    Args:
        name: Name of the joint.
        element: XML element of the joint.
        links: Mapping from link name to XML element.
    """
    subject = _joint(name)
    kind = element.get("type", "")
    if kind not in _KINDS:
        hint = suggest_nearest(kind, _KINDS)
        _refuse(
            subject,
            f"is of type {_quote(kind)}, but must be one of {', '.join(_KINDS)}{hint}",
        )
    ends = []
    for tag in ("parent", "child"):
        end_element = _child(element, tag, subject)
        end = "" if end_element is None else end_element.get("link", "")
        if end not in links:
            hint = suggest_nearest(end, list(links))
            _refuse(
                subject,
                f"its <{tag}> is {_link(end)}, but there is no link of that name{hint}",
            )
        ends.append(end)
    return _Edge(name=name, kind=kind, parent=ends[0], child=ends[1], element=element)


def _walk(robot: _Robot, root: str) -> Iterator[tuple[str, bool]]:
    """Yields a link of a robot and all of its descendants, depth first.

    Yields:
        Name of a link, and whether any joint between `root` and the link can move.
    """
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
    """Raises ScenarioError if the link chosen as the base or tip of an arm does not exist.

    Args:
        robot: The robot.
        end: "base" or "tip", for error messages.
        link: Name of the link. Empty if none was chosen.

    Raises:
        ScenarioError: The robot has no such link.
    """
    if link and link not in robot.links:
        _refuse(end, f"there is no {_link(link)}{suggest_nearest(link, list(robot.links))}")
    return link


def _find_base(robot: _Robot) -> str:
    """Returns the base of a robot: the only link that has no parent joint.

    Raises:
        ScenarioError: There are several such links.
    """
    roots = [name for name in robot.links if name not in robot.above]
    if len(roots) > 1:
        _refuse(
            f"links {_list_names(roots)}",
            "do not hang on a joint: connect these links, or name the link on which the arm "
            "stands as base",
        )
    return roots[0]


def _find_tip(robot: _Robot, base: str) -> str:
    """Returns the tip of an arm: the only leaf link that moves relative to the base.

    Raises:
        ScenarioError: There is no such link, or there are several.
    """
    leaves = [
        name for name, is_moved in _walk(robot, base) if is_moved and not robot.below[name]
    ]
    if not leaves:
        _refuse(_link(base), "no joint below it moves")
    if len(leaves) > 1:
        _refuse(
            "",
            f"the arm may end at links {_list_names(leaves)}: name one of these links, or a "
            "link before them, as tip",
        )
    return leaves[0]


def _find_path(robot: _Robot, base: str, tip: str) -> list[_Edge]:
    """Returns the joints on the path from the base of an arm to its tip, in order.

    Args:
        robot: Tree of links and joints.
        base: Name of the fixed link.
        tip: Name of the link at the end of the arm.

    Raises:
        ScenarioError: The tip is not below the base, a joint has a type that is not allowed in
            an arm, or there are too few or too many moving joints.
    """
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
                f"is {edge.kind}: joints of an arm must be revolute, continuous, prismatic or "
                f"fixed; choose a base behind this joint, such as {_quote(edge.child)}",
            )
        if edge.element.find("mimic") is not None:
            _refuse(
                _joint(edge.name),
                "follows another joint (<mimic>) and has no torque of its own: make this joint "
                f"fixed, or choose a tip before the joint, such as {_quote(edge.parent)}",
            )

    moving = sum(edge.moves for edge in path)
    if not 1 <= moving <= MAX_JOINTS:
        _refuse(
            f"base {_link(base)}, tip {_link(tip)}",
            f"{count_nouns(moving, 'joint moves', 'joints move')} between these links, but 1 "
            f"to {MAX_JOINTS} joints must move: choose other links",
        )
    # The path was followed from the tip to the base.
    return path[::-1]


def _walk_carried(
    robot: _Robot, moving: _Edge, path: Sequence[_Edge], notes: list[str]
) -> Iterator[tuple[str, FramePose]]:
    """Yields all links that move together with one joint, with their poses.

    These are the links up to the next moving joint of the arm. Moving joints of a side branch,
    such as fingers, are held at zero.

    Args:
        robot: The robot.
        moving: The joint.
        path: Joints of the arm.
        notes: List to which a sentence about each joint held at zero is appended.

    Yields:
        Name of a link, and its frame relative to the link moved by the joint.
    """
    on_path = {edge.name for edge in path}
    waiting = [(moving.child, FramePose())]
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
    carried: Sequence[tuple[str, FramePose]],
    path: Sequence[_Edge],
    inertias: _Inertias,
    notes: list[str],
) -> Iterator[_LinkBody]:
    """Yields the inertias of links, in the frame of the moving link that carries them.

    Massless links are skipped. A link on the path to the tip with an impossible mass raises
    ScenarioError; other links with an impossible mass are omitted with a note.

    Args:
        robot: The robot.
        carried: Names of the links, and their frames relative to the moving link.
        path: Joints of the arm.
        inertias: Changes made by the scenario.
        notes: List to which a sentence about each doubtful link is appended.
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

        # The other links do not lead to the tip, or the scenario states their missing
        # quantities.
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
    pose: FramePose,
    inertial: "_Inertial",
    path: Sequence[_Edge],
    inertias: _Inertias,
    notes: list[str],
) -> _LinkBody:
    """Returns the mass and inertia of a link, balancing impossible inertias if permitted.

    If the inertia is physically impossible and the scenario permits balancing, it is replaced
    with the nearest possible one.

    Args:
        name: Name of the link.
        pose: Frame of the link, relative to the moving link that carries it.
        inertial: Inertia in the link frame.
        path: Joints of the arm.
        inertias: Changes made by the scenario.
        notes: List to which a sentence is appended if the inertia is balanced.

    Raises:
        ScenarioError: The inertia is impossible, and either comes from the scenario or belongs
            to a link on the path to the tip.
    """
    mass, centre, tensor, _ = inertial
    centre_pose = pose @ centre
    moments = _principal_moments(tensor)
    slack = max(LEAST_MOMENT_KG_M2, CONSISTENCY * moments[2])
    problem = _find_moments_problem(moments, -slack, slack)
    if not problem:
        return _LinkBody(name, centre_pose.place_body(mass, tensor))

    if inertias.balance:
        tensor = balance_tensor(tensor)
        least, middle, most = _principal_moments(tensor)
        notes.append(
            f"{_link(name)}: {problem}; balanced to {least:.4g}, {middle:.4g} and {most:.4g}"
        )
        return _LinkBody(name, centre_pose.place_body(mass, tensor))
    supplied = inertias.links.get(name)
    if supplied is not None and supplied.inertia_kg_m2 is not None:
        raise ScenarioError(problem, path=f"{_key(name)}.inertia_kg_m2")
    if any(edge.child == name for edge in path):
        _refuse(_link(name), f"{problem}; {_advise_balance(name, path)}")

    # `_lump_bodies` decides whether the link counts as stated or as a point.
    stated = centre_pose.place_body(mass, tensor)
    point = centre_pose.place_body(mass, _POINT_TENSOR)
    return _LinkBody(name, stated, point, problem)


def _advise_key(name: str, key: str) -> str:
    """Returns advice to specify a missing or wrong link inertia in the scenario."""
    return f"give {key} in [arm.{_key(name)}]"


def _advise_balance(name: str, path: Sequence[_Edge]) -> str:
    """Returns remedies for an impossible inertia on the path to the tip.

    The last link can also be cut off by ending the arm at the previous link.
    """
    remedies = ["set arm.balance_inertia = true", _advise_key(name, "inertia_kg_m2")]
    moving_edges = [edge for edge in path if edge.moves]
    if len(moving_edges) > 1 and moving_edges[-1].child == name:
        parent = _quote(moving_edges[-1].parent)
        remedies.append(f"end the arm before it with arm.tip = {parent}")
    return ", or ".join(remedies)


def _note_supplied(name: str, supplied: LinkInertia) -> str:
    """Returns a note that the scenario overrides the mass or inertia of a link."""
    if supplied.mass_kg == 0.0:
        return f"{_link(name)}: the scenario leaves its mass out"
    keys = ", ".join(supplied.list_given_keys())
    return f"{_link(name)}: {keys} of the scenario, in place of the file's"


def _read_joint(
    edge: _Edge, pose: FramePose, inertia: BodyParameters, notes: list[str]
) -> UrdfJoint:
    """Parses a moving joint of the arm: axis, range, friction and moved body.

    Args:
        edge: Joint of the file.
        pose: Frame of the joint, relative to the previous moving link.
        inertia: Inertial parameters of the body moved by the joint.
        notes: List to which a sentence about missing limits is appended.
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
    """Returns the viscous and Coulomb (dry) friction of a joint, 0 if missing.

    Raises:
        ScenarioError: A friction value is negative.
    """
    dynamics = _child(edge.element, "dynamics", subject)
    friction = [0.0, 0.0]
    for n, key in enumerate(("damping", "friction")):
        if dynamics is not None and key in dynamics.attrib:
            friction[n] = _read_number(dynamics, key, subject)
            if friction[n] < 0.0:
                _refuse(
                    subject,
                    f"its {key} must not be negative, but is {friction[n]:g}: a negative value "
                    "would drive the joint",
                )
    return friction[0], friction[1]


class _JointLimits(NamedTuple):
    """Limits of a joint in a URDF file: range, velocity limit and effort limit.

    Attributes:
        lower: Smallest position, in rad or m.
        upper: Largest position, in rad or m.
        effort: Largest torque or force, in N m or N.
        velocity: Largest speed, in rad/s or m/s.
    """

    lower: float
    upper: float
    effort: float
    velocity: float


def _read_limits(edge: _Edge, subject: str, notes: list[str]) -> _JointLimits:
    """Returns the limits of a joint, which are infinite if missing from the file.

    A limit of 0 is treated as missing, since programs that export URDF write 0 for unknown
    limits. A limit above `MAX_QUANTITY` is treated as infinite.

    Args:
        edge: Joint of the file.
        subject: Name of the joint for error messages.
        notes: List to which a sentence about missing limits is appended.

    Raises:
        ScenarioError: A limit is negative, or the positions contradict each other.
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
            "its limits of effort and velocity must not be negative, but are "
            f"{effort:g} and {velocity:g}",
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
            subject, f"its lower limit, {lower:g}, must be below the upper limit, {upper:g}"
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
    """Returns the only XML child element with a given tag, or None if there is none.

    Raises:
        ScenarioError: There are several such elements, of which only one could be used.
    """
    children = element.findall(tag)
    if len(children) > 1:
        _refuse(subject, f"has {len(children)} <{tag}>: keep only one of them")
    return children[0] if children else None


def _read_number(
    element: Element, key: str, subject: str, limit: float = MAX_QUANTITY
) -> float:
    """Parses a number from an attribute of an XML element and checks its range.

    Args:
        element: The element.
        key: Name of the attribute.
        subject: Link or joint of the element, for error messages.
        limit: Largest absolute value.

    Raises:
        ScenarioError: There is no such attribute, or its value is not a number within the
            limit.
    """
    text = element.get(key)
    if text is None:
        _refuse(subject, f"its <{element.tag}> has no {key}")
    return _parse_number(text, f"{element.tag} {key}", subject, limit)


def _parse_number(text: str, attribute: str, subject: str, limit: float) -> float:
    """Converts a string to a number, and rejects NaN, infinity and huge numbers.

    Args:
        text: The string.
        attribute: Element and attribute, for error messages.
        subject: Link or joint, for error messages.
        limit: Largest absolute value.
    """
    stripped = text.strip() if len(text) <= MAX_NUMBER_LENGTH else ""
    value = float(stripped) if _NUMBER.fullmatch(stripped) else math.nan
    if not math.isfinite(value):
        _refuse(subject, f"its <{attribute}> must be a finite number, not {_quote(text)}")
    if abs(value) > limit:
        _refuse(
            subject,
            f"its <{attribute}> must be at most {limit:g} (kg, m and rad), but is {value:g}",
        )
    return value


def _read_vector(
    element: Element, key: str, subject: str, limit: float = MAX_QUANTITY
) -> Three:
    """Parses three numbers from an attribute of an XML element (see `_read_number`)."""
    texts = element.get(key, "").split()
    attribute = f"{element.tag} {key}"
    if len(texts) != 3:
        _refuse(
            subject,
            f"its <{attribute}> must have three numbers, but has {len(texts)}",
        )
    x, y, z = (_parse_number(text, attribute, subject, limit) for text in texts)
    return x, y, z


def _read_origin(parent: Element, subject: str) -> FramePose:
    """Returns the pose given by the <origin> element of a joint or inertia.

    If the element is missing, the pose is that of the parent element's frame.

    Raises:
        ScenarioError: The element has an unknown attribute, or a number is wrong.
    """
    origin = _child(parent, "origin", subject)
    if origin is None:
        return FramePose()
    unknown_keys = origin.attrib.keys() - {"xyz", "rpy"}
    if unknown_keys:
        _refuse(
            subject,
            f"its <origin> has {_quote(min(unknown_keys))}, but a frame may have only xyz and "
            "rpy",
        )
    offset = _ORIGIN
    if "xyz" in origin.attrib:
        offset = _read_vector(origin, "xyz", subject, MAX_OFFSET_M)
    angles = _read_vector(origin, "rpy", subject) if "rpy" in origin.attrib else _ORIGIN
    return FramePose.from_angles(angles, offset)


# Inertia


class _Inertial(NamedTuple):
    """Mass, centre of mass and inertia tensor of a link, in the link frame.

    Attributes:
        mass: Mass, in kg; 0 if missing.
        centre: Frame whose origin is the centre of mass and whose axes are those of the tensor.
        tensor: Inertia about the centre of mass, in kg m^2; zero if missing.
        lacks: Quantity that is missing from both the file and the scenario: "mass" or
            "inertia". Empty if neither is missing.
    """

    mass: float
    centre: FramePose
    tensor: Matrix
    lacks: str


_TENSOR_KEYS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_POINT_TENSOR = fill_tensor((0.0,) * 6)
"""Inertia of a point mass about its own position."""


def _read_inertial(link: Element, name: str, supplied: LinkInertia | None) -> _Inertial | None:
    """Returns the mass and inertia of a link, or None if the link has no mass.

    Args:
        link: XML element of the link.
        name: Name of the link.
        supplied: Inertia from the scenario, whose keys override those of the file, or None.

    Raises:
        ScenarioError: The scenario gives an inertia but no mass, or a number is wrong.
    """
    supplied = supplied or LinkInertia()
    inertial = _child(link, "inertial", _link(name))
    if supplied.mass_kg == 0.0:
        other_keys = supplied.list_given_keys()[1:]
        if other_keys:
            raise ScenarioError(
                "belongs to a link without mass: leave this key out",
                path=f"{_key(name)}.{other_keys[0]}",
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
    centre = FramePose()
    tensor = None
    if inertial is not None:
        mass, centre, tensor = _read_stated_inertial(inertial, name, supplied)
    if supplied.inertia_kg_m2 is not None:
        # A supplied tensor has the axes of the link, and not those of the <origin>.
        centre = FramePose(origin_m=centre.origin_m)
        tensor = fill_tensor(supplied.inertia_kg_m2)
    if supplied.com_m is not None:
        x, y, z = supplied.com_m
        centre = FramePose(centre.rotation, (x, y, z))

    lacks = ""
    if mass is None:
        lacks = "mass"
    elif tensor is None:
        lacks = "inertia"
    return _Inertial(mass or 0.0, centre, _POINT_TENSOR if tensor is None else tensor, lacks)


def _read_stated_inertial(
    inertial: Element, name: str, supplied: LinkInertia
) -> tuple[float | None, FramePose, Matrix | None]:
    """Parses the mass, frame and inertia tensor in an <inertial> element.

    Parts that the scenario overrides are not read, so errors in them do not matter.

    Args:
        inertial: The element.
        name: Name of the link.
        supplied: Inertia from the scenario.

    Returns:
        Mass in kg, frame of the centre of mass, and tensor in kg m^2; None for a missing mass
        or tensor.
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
    centre = FramePose() if is_frame_replaced else _read_origin(inertial, subject)
    return mass, centre, tensor


def _find_mass_problem(inertial: _Inertial) -> str:
    """Returns why the mass of a link is physically impossible, or "" if it is possible."""
    if inertial.lacks == "mass":
        return "its <inertial> has no <mass>"
    if inertial.mass < 0.0:
        return f"its mass must not be negative, but is {inertial.mass:g} kg"
    if inertial.mass == 0.0 and any(map(any, inertial.tensor)):
        return "has moments of inertia but no mass: give both, or neither"
    return ""


def _read_payload(payload: UrdfPayload, fixed: Sequence[_Edge]) -> BodyParameters:
    """Returns the mass and inertia of a payload in the frame of the link that carries it.

    Args:
        payload: The payload, in the tip frame.
        fixed: Fixed joints from the last moving link to the tip.

    Raises:
        ScenarioError: The moments of inertia of the payload are impossible.
    """
    pose = FramePose()
    for edge in fixed:
        pose = pose @ _read_origin(edge.element, _joint(edge.name))
    tensor = fill_tensor(payload.inertia_kg_m2)
    moments = _principal_moments(tensor)
    slack = max(LEAST_MOMENT_KG_M2, CONSISTENCY * moments[2])
    problem = _find_moments_problem(moments, -slack, slack)
    if problem:
        _refuse("payload", problem)
    x, y, z = payload.com_m
    centre = pose @ FramePose(origin_m=(x, y, z))
    return centre.place_body(payload.mass_kg, tensor)


def _principal_moments(tensor: Matrix) -> list[float]:
    """Returns the eigenvalues of an inertia tensor in ascending order.

    Their last bits may differ between machines, so they are used only for checks and notes.
    """
    return [float(moment) for moment in np.linalg.eigvalsh(np.array(tensor))]


def _find_moments_problem(moments: Sequence[float], bound: float, slack: float) -> str:
    """Returns why three principal moments of inertia are physically impossible.

    The moments of a body are positive, and none of them exceeds the sum of the other two.

    Args:
        moments: Moments in ascending order, in kg m^2.
        bound: Smallest permitted moment, in kg m^2.
        slack: Permitted violation of the triangle inequality, in kg m^2.

    Returns:
        The reason as part of a sentence. Empty if the moments are possible.
    """
    smallest, middle, largest = moments
    stated = (
        f"its principal moments of inertia are {smallest:.4g}, {middle:.4g} and {largest:.4g} "
        "kg m^2"
    )
    if smallest < bound:
        return f"{stated}, but all must be positive"
    if largest - smallest - middle > slack:
        return f"{stated}, but no moment of a body exceeds the sum of the other two"
    return ""


def _lump_bodies(edge: _Edge, bodies: Sequence[_LinkBody], notes: list[str]) -> BodyParameters:
    """Combines the masses and inertias of all links moved by one joint.

    Links on side branches may have impossible moments of inertia. These are used if the
    combined body is nevertheless possible. Otherwise, such links are treated as point masses.

    Args:
        edge: The joint.
        bodies: Inertias of the links, in the joint frame.
        notes: List to which a sentence about each link with impossible moments is appended.

    Raises:
        ScenarioError: The combined body lacks mass or extent.
    """
    subject = f"{_link(edge.child)}, which {_joint(edge.name)} moves"
    if not bodies:
        advice = f"give mass_kg and inertia_kg_m2 in [arm.{_key(edge.child)}]"
        _refuse(
            subject, f"has no <inertial>, and no link fixed to it has an <inertial>; {advice}"
        )

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
    """Combines the masses and inertias of several bodies given in the same frame."""
    total = bodies[0]
    # The built-in `sum` rounds differently from Python 3.12 on.
    for body in bodies[1:]:
        total = tuple(a + b for a, b in zip(total, body, strict=True))
    return total


def _find_sum_problem(total: BodyParameters) -> str:
    """Returns why the combined body at a joint is physically impossible, or ""."""
    mass = total[0]
    if mass < LEAST_MASS_KG:
        return (
            f"has {mass:g} kg, including all links that are fixed to it, but a body that moves "
            "needs mass"
        )
    x, y, z = (moment / mass for moment in total[1:4])
    # Shifting the tensor with a negative mass expresses it about the centre of mass.
    about_centre = FramePose(origin_m=(x, y, z)).place_body(-mass, fill_tensor(total[4:]))
    moments = _principal_moments(fill_tensor(about_centre[4:]))
    slack = CONSISTENCY * moments[2]
    return _find_moments_problem(moments, max(LEAST_MOMENT_KG_M2, slack), slack)

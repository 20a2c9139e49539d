"""Operators and environments: their types, and the step from an author's tables to complete ones.

Invariant: torques and forces are those ON the arm; times are seconds after the epoch; keys end in their
unit. An operator without a start pose takes hold of the arm at the arm's start pose. Mistakes are refused
at their own key.
"""

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from ..core.exogenous import TorqueKind, TorqueSource
from ..errors import ScenarioError
from .fields import (
    MAX_QUANTITY,
    Frozen,
    Joints,
    NotNegative,
    NotNegativeJoints,
    Positive,
    Real,
    TomlTable,
    check_choice,
    check_keys,
    field_names,
    is_number,
)

PlaneVector = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=2)]
RecordedPoint = Annotated[tuple[Real, ...], Meta(min_length=3, max_length=3)]


class Pulse(Frozen, frozen=True, tag_field="kind", tag="pulse"):
    """A smooth push of an operator: peak * sin^2(pi (t - start) / (end - start)).

    Attributes:
        start_s: when it begins.
        end_s: when it ends.
        peak_nm: its peak on each joint, N m.
    """

    start_s: NotNegative
    end_s: Positive
    peak_nm: Joints

    @property
    def actor(self) -> TorqueSource:
        """The same, as the core has it."""
        return TorqueSource(TorqueKind.PULSE, self.start_s, self.end_s, a=self.peak_nm)


class JointSpring(Frozen, frozen=True, tag_field="kind", tag="spring"):
    """An operator's hand: a spring and a damper on every joint, towards a pose that moves (minimum jerk).

    Attributes:
        to_rad: the pose that it moves to, rad.
        from_rad: the pose before, rad; left out: the arm's start pose.
        move_start_s: when it begins to move.
        move_end_s: when it is there.
        stiffness_nm_rad: per joint, N m/rad.
        damping_nm_s_rad: per joint, N m s/rad.
        start_s: when the hand takes hold.
        end_s: when it lets go.
        sampled: whether it is computed once a tick and held.
    """

    to_rad: Joints
    from_rad: Joints
    stiffness_nm_rad: NotNegativeJoints
    damping_nm_s_rad: NotNegativeJoints = (0.0, 0.0)
    move_start_s: NotNegative = 0.0
    move_end_s: NotNegative = 0.0
    start_s: NotNegative = 0.0
    end_s: Positive = MAX_QUANTITY
    sampled: bool = False

    @property
    def actor(self) -> TorqueSource:
        """The same, as the core has it."""
        return TorqueSource(
            TorqueKind.HAND,
            self.start_s,
            self.end_s,
            self.move_start_s,
            self.move_end_s,
            self.from_rad,
            self.to_rad,
            self.stiffness_nm_rad,
            self.damping_nm_s_rad,
            self.sampled,
        )


class EndEffectorSpring(Frozen, frozen=True, tag_field="kind", tag="tip_spring"):
    """An operator's hand at the tip: a spring and a damper in the plane, towards a point that moves.

    Attributes:
        to_m: the point that it moves to, x and y, m.
        from_m: the point before, m; left out: where the tip is at the start.
        move_start_s: when it begins to move.
        move_end_s: when it is there.
        stiffness_n_m: along x and y, N/m.
        damping_n_s_m: along x and y, N s/m.
        start_s: when the hand takes hold.
        end_s: when it lets go.
        sampled: whether it is computed once a tick and held.
    """

    to_m: PlaneVector
    from_m: PlaneVector
    stiffness_n_m: NotNegativeJoints
    damping_n_s_m: NotNegativeJoints = (0.0, 0.0)
    move_start_s: NotNegative = 0.0
    move_end_s: NotNegative = 0.0
    start_s: NotNegative = 0.0
    end_s: Positive = MAX_QUANTITY
    sampled: bool = False

    @property
    def actor(self) -> TorqueSource:
        """The same, as the core has it."""
        return TorqueSource(
            TorqueKind.TASK_HAND,
            self.start_s,
            self.end_s,
            self.move_start_s,
            self.move_end_s,
            self.from_m,
            self.to_m,
            self.stiffness_n_m,
            self.damping_n_s_m,
            self.sampled,
        )


class RecordedTorque(Frozen, frozen=True, tag_field="kind", tag="recorded"):
    """A torque that was recorded, linear between its points; nothing before the first and after the last.

    Attributes:
        points: rows of time, s, and the torque on each joint, N m, in order of time.
    """

    points: Annotated[tuple[RecordedPoint, ...], Meta(min_length=1, max_length=1_000_000)]

    @property
    def actor(self) -> TorqueSource:
        """The same, as the core has it."""
        return TorqueSource(TorqueKind.RECORDED, table=np.array(self.points, dtype=np.float64))


class ViscousEnvironment(Frozen, frozen=True, tag_field="kind", tag="viscous"):
    """An environment that resists motion of the joints.

    Attributes:
        damping_nm_s_rad: per joint, N m s/rad.
        start_s: from when on.
        end_s: until when.
        sampled: whether it is computed once a tick and held.
    """

    damping_nm_s_rad: NotNegativeJoints
    start_s: NotNegative = 0.0
    end_s: Positive = MAX_QUANTITY
    sampled: bool = False

    @property
    def actor(self) -> TorqueSource:
        """The same, as the core has it."""
        return TorqueSource(
            TorqueKind.VISCOUS, self.start_s, self.end_s, B=self.damping_nm_s_rad, sampled=self.sampled
        )


class Wall(Frozen, frozen=True, tag_field="kind", tag="wall"):
    """A unilateral wall for the tip: it pushes out of itself, along its normal, and never pulls.

    Attributes:
        point_m: a point of its surface, x and y, m.
        normal: where the free side is; its length does not matter.
        stiffness_n_m: N/m.
        damping_n_s_m: N s/m.
        start_s: from when on.
        end_s: until when.
        sampled: whether it is computed once a tick and held, as a digital haptic wall is.
    """

    point_m: PlaneVector
    normal: PlaneVector
    stiffness_n_m: NotNegative
    damping_n_s_m: NotNegative = 0.0
    start_s: NotNegative = 0.0
    end_s: Positive = MAX_QUANTITY
    sampled: bool = False

    @property
    def actor(self) -> TorqueSource:
        """The same, as the core has it."""
        length = math.hypot(*self.normal)
        unit = tuple(x / length for x in self.normal)
        stiffness, damping = (self.stiffness_n_m, 0.0), (self.damping_n_s_m, 0.0)
        return TorqueSource(
            TorqueKind.WALL,
            self.start_s,
            self.end_s,
            a=self.point_m,
            b=unit,
            K=stiffness,
            B=damping,
            sampled=self.sampled,
        )


Operator = Pulse | JointSpring | EndEffectorSpring | RecordedTorque
OPERATORS: dict[str, type[Frozen]] = {
    "pulse": Pulse,
    "spring": JointSpring,
    "tip_spring": EndEffectorSpring,
    "recorded": RecordedTorque,
}
"""What an operator can be, by the name of its kind."""
Environment = ViscousEnvironment | Wall
ENVIRONMENTS: dict[str, type[Frozen]] = {"viscous": ViscousEnvironment, "wall": Wall}
"""What an environment can be, by the name of its kind."""

_PAIRS = ("from_rad", "to_rad", "stiffness_nm_rad", "damping_nm_s_rad", "peak_nm")
_PLANE = ("stiffness_n_m", "damping_n_s_m")
"""Where one number may stand for both joints, or for both axes."""

_TIME = "a time of at least 0 s"
_ANGLES = "one angle for both joints or two, rad"
_POINT = "two numbers, x and y, m"
_GAIN = "one number for both joints or two, at least 0"
_ROW = "[time in s, torque on joint 1, on joint 2 in N m]"
_WORDS = {
    **dict.fromkeys(("start_s", "end_s", "move_start_s", "move_end_s"), _TIME),
    **dict.fromkeys(("from_rad", "to_rad"), _ANGLES),
    **dict.fromkeys(("from_m", "to_m", "point_m"), _POINT),
    "peak_nm": "one torque for both joints or two, ON the arm, N m",
    "stiffness_nm_rad": f"{_GAIN}, N m/rad",
    "damping_nm_s_rad": f"{_GAIN}, N m s/rad",
    "normal": "two numbers, x and y: to which side the wall is free",
    "points": f"a list of rows {_ROW}",
    "sampled": "true or false",
}
_PLANE_GAINS = {
    "tip_spring": "one number for both axes or two, at least 0",
    "wall": "a number of at least 0",
}
"""What a key wants, for an author who gave it something else or nothing."""
_SHOWN = 60
"""A value that takes more letters is not repeated."""


def resolve_operators(
    written: Any, kinds: Mapping[str, type[msgspec.Struct]], site: TomlTable, path: str
) -> list[TomlTable]:
    """Returns what a site's operator is, or what it meets, complete.

    Args:
        written: a list of tables, each with its kind.
        kinds: what there can be.
        site: the site's own tables, complete but for this.
        path: what errors call it.
    """
    if not isinstance(written, list):
        raise ScenarioError(f"must be a list of tables [[{path}]]", path=path)
    return [_resolved(entry, kinds, site, f"{path}[{n}]") for n, entry in enumerate(written)]


def _resolved(entry: Any, kinds: Mapping[str, type[msgspec.Struct]], site: TomlTable, path: str) -> TomlTable:
    if not isinstance(entry, dict):
        raise ScenarioError("must be a table", path=path)
    kind = _kind(entry, kinds, path)
    both = (*_PAIRS, *(_PLANE if kind == "tip_spring" else ()))
    table = {
        key: [value] * 2 if key in both and is_number(value) else value
        for key, value in check_keys(entry, ("kind", *field_names(kinds[kind])), path).items()
    }
    if kind == "spring":
        table.setdefault("from_rad", site["q0_rad"])
        table.setdefault("to_rad", table["from_rad"])
    if kind == "tip_spring":
        table.setdefault("from_m", _tip(site))
        table.setdefault("to_m", table["from_m"])
    _check(table, kinds[kind], entry, path)
    return table


def _kind(entry: TomlTable, kinds: Mapping[str, type[msgspec.Struct]], path: str) -> str:
    """Returns what an actor is; one that stands in the wrong list is told where it belongs."""
    if "kind" not in entry:
        raise ScenarioError(f"is missing: {' or '.join(map(repr, kinds))}", path=f"{path}.kind")
    kind = entry["kind"]
    for group, others in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        if isinstance(kind, str) and kind in others and kind not in kinds:
            raise ScenarioError(f"is {kind!r}, which belongs in {group}", path=f"{path}.kind")
    check_choice(kind, list(kinds), f"{path}.kind")
    return str(kind)


def _check(table: TomlTable, kind: type[msgspec.Struct], entry: TomlTable, path: str) -> None:
    """Refuses a value that an actor cannot have, or one that it lacks, and says what its key wants."""
    try:
        msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        if lacking := re.search(r"missing required field `(\w+)`", problem):
            raise ScenarioError(
                f"is missing: {_wanted(lacking[1], table)}", path=f"{path}.{lacking[1]}"
            ) from None
        found = re.match(r"`\$\.(\w+)(.*)`", place)
        key, rest = (found[1], found[2]) if found else ("", place)
        if key not in entry:  # taken over from the arm, whose own key is refused with its own words
            return
        if key == "points":
            one = f"a row {_ROW}" if rest else _WORDS[key]
            raise ScenarioError(f"must be {one}", path=f"{path}.{key}{rest}") from None
        value = repr(entry[key])
        is_now = f", is {value}" if len(value) <= _SHOWN else ""
        raise ScenarioError(f"must be {_wanted(key, table)}{is_now}", path=f"{path}.{key}") from None


def _wanted(key: str, table: TomlTable) -> str:
    """Returns what a key wants, in words."""
    if key not in _PLANE:
        return _WORDS[key]
    return f"{_PLANE_GAINS[table['kind']]}, {('N/m', 'N s/m')[_PLANE.index(key)]}"


def _tip(site: TomlTable) -> list[float]:
    """Returns where the tip is at the start, m; what is no number is refused later, with its path."""
    lengths = [site["arm"].get("l1_m", 1.0), site["arm"].get("l2_m", 1.0)]
    q0 = site["q0_rad"]
    if not (isinstance(q0, list) and len(q0) == 2 and all(map(is_number, [*q0, *lengths]))):
        return [0.0, 0.0]
    turned = q0[0] + q0[1]
    return [
        lengths[0] * math.cos(q0[0]) + lengths[1] * math.cos(turned),
        lengths[0] * math.sin(q0[0]) + lengths[1] * math.sin(turned),
    ]

"""Common base of all models of operators and environments.

An environment is a wall or another body that acts on the arm. Each kind is a class in its own
file in this folder; adding a file adds a kind. The tag of the class is the name of the kind in
a scenario.

A kind that is built into the simulation kernel names its `TorqueKind`. Other kinds define two
functions of their own: `act`, which is compiled, and `effort`, which evaluates many rows at
once.

Invariant:
    - Torques and forces act ON the arm. Times are in seconds after the epoch, the common start
      time. The name of a key ends in its unit.
    - An invalid value is rejected with the path of its key.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Union

import msgspec

from ... import fields
from ...core import Array, TorqueKind, TorqueSource
from ...errors import ScenarioError
from ..distributions import Draws
from ..key_checks import (
    VectorCounts,
    check_choice,
    check_keys,
    field_names,
)
from ..refusals import MAX_QUOTED_LENGTH


class HeldArm(NamedTuple):
    """Properties of an arm that determine defaults of its operators and environments.

    For example, the target to which an operator pulls the arm is initially at the position of
    the arm.

    Attributes:
        counts: Number of joints, task coordinates and parameters of the arm.
        q0_rad: Start pose of the arm, in rad. Not validated yet.
        end_effector_m: Function that returns the position of the end effector in the start
            pose, in m.
        draws: Object that draws the numbers for random distributions in the settings.
    """

    counts: VectorCounts
    q0_rad: Any
    end_effector_m: Callable[[], list[float]]
    draws: Draws


class ActorBase(fields.Frozen, frozen=True, tag_field="kind"):
    """Base class of operators and environments, which apply torques or forces to an arm.

    A subclass defines the scenario keys of one kind and converts them to the parameters used by
    the compiled simulation. To add a kind, add a file with a subclass to this folder.
    """

    group: ClassVar[str] = "hands"
    """Site list to which the actor belongs: "hands" or "environment"."""
    oscillates: ClassVar[bool] = False
    """True if the torque oscillates in time, so that the arm never comes to rest."""
    value_texts: ClassVar[Mapping[str, str]] = {}
    """Permitted values of keys missing from `VALUE_TEXTS`, for error messages."""

    def _source(self) -> TorqueSource:
        """Returns the operator or environment in the format read by the compiled simulation."""
        raise NotImplementedError

    @property
    def actor(self) -> TorqueSource:
        """Numerical parameters from which the simulation computes the torque or force.

        Compiled code cannot use Python objects, so the parameters are stored as numbers.
        """
        return self._source()

    @classmethod
    def complete_table(
        cls, table: fields.TomlTable, entry: fields.TomlTable, held_arm: HeldArm, path: str
    ) -> None:
        """Adds defaults that depend on the arm to the settings of an operator or environment.

        For example, the default start position of an operator is the position of the arm.
        Subclasses with such defaults override this method, which otherwise adds nothing.

        Args:
            table: Settings including all other defaults, modified in place.
            entry: The same settings as written by their author.
            held_arm: The arm on which the operator or environment acts.
            path: Path of the settings in the scenario, for error messages.
        """

    def find_problem(self) -> fields.KeyProblem | None:
        """Checks the keys of the table for contradictions between them.

        Covers `normal`, `start_s` and `end_s` for every kind that has them, since these keys
        mean the same in all of them.

        Returns:
            The key and the reason, or None if the keys are consistent.
        """
        normal = getattr(self, "normal", (1.0,))
        if math.hypot(*normal) < 1e-6:
            return fields.KeyProblem("normal", "must be a vector other than zero")
        start_s = getattr(self, "start_s", 0.0)
        end_s = getattr(self, "end_s", fields.MAX_QUANTITY)
        if end_s <= start_s:
            return fields.KeyProblem(
                "end_s", f"must be later than start_s = {start_s:g}, but is {end_s:g}"
            )
        return None


class TimedActor(ActorBase, frozen=True, kw_only=True):
    """Base class of operators and environments that act only during an interval of the run.

    Attributes:
        start_s: Start of the interval, in s after the start of the run.
        end_s: End of the interval, in s after the start of the run. By default, the end of the
            run.
    """

    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY


class SampledActor(TimedActor, frozen=True, kw_only=True):
    """Base class of operators and environments whose force may be sampled once per tick.

    A sampled force is held constant during a control period, like that of a real device with a
    digital controller. Otherwise, the force acts continuously.

    Attributes:
        sampled: If True, the force is computed once per control period and held, as by a real
            haptic device that renders a wall. If False, the force is computed in every stage of
            the numerical integration.
    """

    sampled: bool = False


class OwnActor(SampledActor, frozen=True, kw_only=True):
    """Base class of operators and environments whose torque is computed in Python.

    To add a kind, add a file with a subclass to this folder. The keys of the kind are numbers,
    or vectors with one entry per joint or axis. By default, the torque acts on the joints. If
    `at_tip` is True, a force acts on the end effector instead: `act` and `effort` receive the
    position and velocity of the end effector in m and m/s, and return a force in N.
    """

    at_tip: ClassVar[bool] = False

    def act(self, now: Any) -> None:
        """Computes the torque or force at one time and stores it in `now.effort`.

        An implementation sets all entries of `now.effort` with an index below
        `now.coordinates`. It is compiled, and called in every stage of the integrator. It may
        use `now.t_s`, `now.at` (angles or position) and `now.speed`. The result must depend
        only on the keys and on `now`, and must have the same bits on every machine, so the only
        permitted functions are those of `core.elementary` and `sqrt`.

        Args:
            now: Time and motion at which the torque is needed, and the field that receives the
                result.
        """
        raise NotImplementedError

    def effort(self, t_s: Array, position: Array, speed: Array) -> Array:
        """Computes the same torques or forces as `act` for many times and motions at once.

        This implementation is independent of `act`, and a test compares the two. To linearise
        the control loop, `effort` is differentiated by complex steps. Implementations must
        therefore accept complex numbers and use real parts in conditions.

        Args:
            t_s: Times, in s.
            position: Angles in rad, or positions of the end effector in m, shape (..., n).
            speed: Time derivative of `position`, shape (..., n).

        Returns:
            Torques in N m or forces in N, shape (..., n).
        """
        raise NotImplementedError

    def _source(self) -> TorqueSource:
        """Returns the operator or environment in the format read by the compiled simulation.

        The simulation calls its compiled `act` method.
        """
        kind = TorqueKind.OWN_TIP if self.at_tip else TorqueKind.OWN_JOINTS
        return TorqueSource(kind, self.start_s, self.end_s, sampled=self.sampled, model=self)


_GAIN = "one number for {joints}, at least 0"
POINTS_ROW_TEXT = "[time in s, torque on {each} in N m]"
VALUE_TEXTS = {
    **dict.fromkeys(
        ("start_s", "end_s", "move_start_s", "move_end_s"), "a time of at least 0 s"
    ),
    **dict.fromkeys(("from_rad", "to_rad"), "one angle for {joints}, rad"),
    **dict.fromkeys(("from_m", "to_m", "point_m"), "{axes}, m"),
    **dict.fromkeys(("peak_nm", "amplitude_nm"), "one torque for {joints}, ON the arm, N m"),
    "stiffness_nm_rad": f"{_GAIN}, N m/rad",
    "damping_nm_s_rad": f"{_GAIN}, N m s/rad",
    **dict.fromkeys(("from_hz", "to_hz"), "a frequency above 0 and up to 1000 Hz"),
    "sweep_s": "a duration above 0 s",
    "frequencies_hz": "a list of 1 to 64 frequencies above 0 and up to 1000 Hz",
    "phases_rad": "a list of angles, rad, one for each frequency",
    "normal": "{axes}: to which side the wall is free",
    "points": f"a list of rows {POINTS_ROW_TEXT}",
    "sampled": "true or false",
    "mode": "'tip', 'joint' or 'force'",
    "force_limit_n": "a force above 0 N",
    "torque_limit_nm": "a torque above 0 N m",
    "speed_limit_m_s": "a speed above 0 m/s",
    "speed_limit_rad_s": "a speed above 0 rad/s",
    "acceleration_limit_m_s2": "an acceleration above 0 m/s^2",
    "acceleration_limit_rad_s2": "an acceleration above 0 rad/s^2",
}
"""Permitted values of each key, for error messages, with placeholders for `COUNT_TEXTS`."""
COUNT_TEXTS = {
    "joints": ("both joints or two", "all joints or one for each"),
    "axes": ("two numbers, x and y", "three numbers, x, y and z"),
    "all_axes": ("both axes or two", "all axes or three"),
    "each": ("joint 1, on joint 2", "each joint"),
}
"""Replacements for the placeholders in `VALUE_TEXTS`: for the planar arm, and for others."""


_KINDS = {str(kind.__struct_config__.tag): kind for kind in ActorBase.find_kinds(__name__)}
OPERATORS = {tag: kind for tag, kind in _KINDS.items() if kind.group == "hands"}
ENVIRONMENTS = {tag: kind for tag, kind in _KINDS.items() if kind.group == "environment"}
"""Mapping from kind to class, for operators and for environments."""
if TYPE_CHECKING:
    Operator = ActorBase
    Environment = ActorBase
else:
    # Built at run time from the classes in this folder.
    Operator = Union[tuple(OPERATORS.values())]  # noqa: UP007
    Environment = Union[tuple(ENVIRONMENTS.values())]  # noqa: UP007


def resolve_operators(
    written: list[fields.TomlTable],
    kinds: Mapping[str, type[ActorBase]],
    held_arm: HeldArm,
    path: str,
) -> list[fields.TomlTable]:
    """Completes the settings of all operators, or of all environments, of one arm.

    Missing settings are set to their defaults, and random distributions are replaced with drawn
    numbers.

    Args:
        written: One table per operator or environment, as written by the author.
        kinds: Mapping from the name of each permitted kind to its class.
        held_arm: The arm on which the operators or environments act.
        path: Path of the list in the scenario, for error messages.

    Returns:
        The completed tables, in the order of `written`.

    Raises:
        ScenarioError: A table is not valid.
    """
    tables = []
    for n, entry in enumerate(written):
        entry_path = f"{path}[{n}]"
        kind = _find_kind(entry, kinds, entry_path)
        check_keys(entry, ("kind", *field_names(kind)), entry_path)
        expanded = held_arm.counts.expand_vectors(entry, kind)
        table = held_arm.draws.draw_numbers(expanded, entry_path)
        kind.complete_table(table, entry, held_arm, entry_path)
        _check_values(
            table=table, kind=kind, entry=entry, path=entry_path, counts=held_arm.counts
        )
        tables.append(table)
    return tables


def _find_kind(
    entry: fields.TomlTable, kinds: Mapping[str, type[ActorBase]], path: str
) -> type[ActorBase]:
    """Returns the class for the kind of operator or environment named in a table.

    Raises:
        ScenarioError: The key is missing or wrong, or the kind belongs to the other list.
    """
    if "kind" not in entry:
        raise ScenarioError(
            f"is missing; the value must be {' or '.join(map(repr, kinds))}",
            path=f"{path}.kind",
        )
    kind = entry["kind"]
    for group, group_kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        is_of_group = isinstance(kind, str) and kind in group_kinds
        if is_of_group and kind not in kinds:
            raise ScenarioError(f"is {kind!r}, which belongs to {group}", path=f"{path}.kind")
    check_choice(kind, list(kinds), f"{path}.kind")
    return kinds[kind]


class _RefusedKey(NamedTuple):
    """Key of an operator or environment table whose value is missing or invalid.

    Attributes:
        key: The key.
        indices: Indices of the invalid list entry, such as "[3][1]". Empty if the value as a
            whole is invalid.
        is_missing: True if the key is missing.
    """

    key: str
    indices: str = ""
    is_missing: bool = False


def _check_values(
    table: fields.TomlTable,
    kind: type[ActorBase],
    entry: fields.TomlTable,
    path: str,
    counts: VectorCounts,
) -> None:
    """Raises ScenarioError if a value of an operator or environment table is invalid.

    The error states what its author may write instead.

    Args:
        table: Complete table.
        kind: Class of the table.
        entry: Table as written by its author.
        path: Path of the table, for error messages.
        counts: Lengths of the arm's vectors.
    """
    refused = _find_refused_key(table, kind, counts)
    if refused is None:
        return
    key_path = f"{path}.{refused.key}"
    if refused.is_missing:
        expected = _describe_values(refused, kind, counts)
        raise ScenarioError(f"is missing; the value must be {expected}", path=key_path)
    if refused.key not in entry:
        # The value was copied from the arm, and is refused later at the key of the arm.
        return

    expected = _describe_values(refused, kind, counts)
    if refused.key == "points":
        raise ScenarioError(f"must be {expected}", path=f"{key_path}{refused.indices}")
    value = repr(entry[refused.key])
    quoted = f", but is {value}" if len(value) <= MAX_QUOTED_LENGTH else ""
    raise ScenarioError(f"must be {expected}{quoted}", path=key_path)


def _describe_values(refused: _RefusedKey, kind: type[ActorBase], counts: VectorCounts) -> str:
    """Describes the permitted values of a rejected key to the author of the scenario.

    An example is "one torque for both joints or two, ON the arm, N m".

    Args:
        refused: The key.
        kind: Class of the table.
        counts: Lengths of the arm's vectors, which affect wording such as "both joints".
    """
    text = kind.value_texts.get(refused.key) or VALUE_TEXTS[refused.key]
    if refused.key == "points" and refused.indices:
        text = f"a row {POINTS_ROW_TEXT}"
    is_planar = counts == VectorCounts()
    placeholders = {
        name: planar_text if is_planar else chain_text
        for name, (planar_text, chain_text) in COUNT_TEXTS.items()
    }
    return text.format(**placeholders)


def _find_refused_key(
    table: fields.TomlTable, kind: type[ActorBase], counts: VectorCounts
) -> _RefusedKey | None:
    """Returns the first key of a complete operator table with a missing or invalid value.

    Returns None if the table is valid.
    """
    try:
        msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        problem, location = fields.split_refusal(error)
        missing = re.search(r"missing required field `(\w+)`", problem)
        if missing is not None:
            return _RefusedKey(missing[1], is_missing=True)
        # The location is, for example, ".points[3][1]".
        key, bracket, indices = location.removeprefix(".").partition("[")
        return _RefusedKey(key, bracket + indices)
    count_problem = counts.find_problem(table, kind)
    if count_problem is not None:
        return _RefusedKey(count_problem.key)
    for n, row in enumerate(table.get("points", ())):
        if len(row) != 1 + counts.joints:
            return _RefusedKey("points", f"[{n}]")
    return None

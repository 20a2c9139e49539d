"""Operators and environments of a scenario, and the completion of their tables.

An operator or environment is one class, found by its file in this folder; nothing else lists
the classes. Its name in a scenario is the tag of the class. The kinds that the kernel computes
name a `TorqueKind`. Any other kind has a file of its own with two functions: `act`, which is
compiled, and `effort`, which evaluates many rows.

Invariant:
    - Torques and forces are those ON the arm. Times are seconds after the epoch. Keys end in
      their unit.
    - A mistake is refused at the key in which it is.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Union

import msgspec

from ... import fields
from ...core.exogenous import TorqueKind, TorqueSource
from ...core.vectors import Array
from ...errors import ScenarioError
from ..distributions import Draws


class HeldArm(NamedTuple):
    """The arm that an operator takes hold of.

    Attributes:
        counts: the lengths of the arm's vectors.
        q0_rad: the start pose of the arm, if its table has a valid one.
        end_effector_m: returns the position of the end effector in the start pose, m.
        draws: draws the numbers that are given as distributions.
    """

    counts: fields.VectorCounts
    q0_rad: Any
    end_effector_m: Callable[[], list[float]]
    draws: Draws


class ActorBase(fields.Frozen, frozen=True, tag_field="kind"):
    """An operator or an environment."""

    group: ClassVar[str] = "hands"
    """The list of a site in which the actor stands: "hands" or "environment"."""
    value_texts: ClassVar[Mapping[str, str]] = {}
    """A description of the values of each key that `VALUE_TEXTS` does not describe."""

    def _source(self) -> TorqueSource:
        raise NotImplementedError

    @property
    def actor(self) -> TorqueSource:
        """The actor in the form of the core."""
        return self._source()

    @classmethod
    def complete_table(
        cls, table: fields.TomlTable, entry: fields.TomlTable, held_arm: HeldArm, path: str
    ) -> None:
        """Adds to `table` the keys that an author left out and that follow from the arm.

        Args:
            table: the table of the actor, changed in place.
            entry: the table as its author wrote it.
            held_arm: the arm on which the actor acts.
            path: the path of the table in errors.
        """

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns a problem that no range of a single key shows, or None."""
        normal = getattr(self, "normal", (1.0,))
        if math.hypot(*normal) < 1e-6:
            return fields.KeyProblem("normal", "must point somewhere, is zero")
        start_s = getattr(self, "start_s", 0.0)
        end_s = getattr(self, "end_s", fields.MAX_QUANTITY)
        if end_s <= start_s:
            return fields.KeyProblem(
                "end_s", f"must be later than start_s = {start_s:g}, is {end_s:g}"
            )
        return None


class TimedActor(ActorBase, frozen=True, kw_only=True):
    """An actor that acts from `start_s` to `end_s`."""

    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY


class SampledActor(TimedActor, frozen=True, kw_only=True):
    """An actor that may be sampled: evaluated once per tick and held, as a digital wall is."""

    sampled: bool = False


class OwnActor(SampledActor, frozen=True, kw_only=True):
    """An operator or an environment whose torque is a function in a file of this folder.

    Its keys are numbers, or vectors with a number per joint or axis. It acts on the joints.
    With `at_tip` it acts on the end effector: `act` and `effort` then see the position and
    velocity of the end effector, m and m/s, and give a force, N.
    """

    at_tip: ClassVar[bool] = False

    def act(self, now: Any) -> None:
        """Writes `now.effort[i]`, N m or N, for i below `now.coordinates`.

        The function is compiled and evaluated in every stage of the integrator. It may use
        `now.t_s`, `now.at` (angles or position) and `now.speed`. Its result depends on its keys
        and on `now` alone, and rounds alike on every machine (`core.elementary`, sqrt).
        """
        raise NotImplementedError

    def effort(self, t_s: Array, position: Array, speed: Array) -> Array:
        """Returns the efforts of `act` for many rows, shape (..., n).

        The function is written independently of `act`, and a test compares the two. The
        linearised loop differentiates it by complex steps: it accepts complex numbers, and
        branches on real parts.

        Args:
            t_s: times, s.
            position: angles, rad, or positions of the end effector, m, shape (..., n).
            speed: the derivative of `position`, shape (..., n).
        """
        raise NotImplementedError

    def _source(self) -> TorqueSource:
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
"""The values that a key takes, for errors about a key that is missing or has another value."""
COUNT_TEXTS = {
    "joints": ("both joints or two", "all joints or one for each"),
    "axes": ("two numbers, x and y", "three numbers, x, y and z"),
    "all_axes": ("both axes or two", "all axes or three"),
    "each": ("joint 1, on joint 2", "each joint"),
}
"""The placeholders of these texts, for the planar arm and for any other arm."""


_KINDS = {
    str(kind.__struct_config__.tag): kind for kind in fields.find_kinds(__name__, ActorBase)
}
OPERATORS = {tag: kind for tag, kind in _KINDS.items() if kind.group == "hands"}
ENVIRONMENTS = {tag: kind for tag, kind in _KINDS.items() if kind.group == "environment"}
"""The operators and the environments by the name of their kind."""
if TYPE_CHECKING:
    Operator = ActorBase
    Environment = ActorBase
else:
    # Built at run time from the classes in this folder.
    Operator = Union[tuple(OPERATORS.values())]  # noqa: UP007
    Environment = Union[tuple(ENVIRONMENTS.values())]  # noqa: UP007
_MAX_QUOTED_LENGTH = 60
"""Length up to which an error repeats a value."""


def resolve_operators(
    written: Any,
    kinds: Mapping[str, type[ActorBase]],
    held_arm: HeldArm,
    path: str,
) -> list[fields.TomlTable]:
    """Returns a site's operators or environments as complete tables.

    Args:
        written: the list as its author wrote it.
        kinds: the kinds that the list may hold, by name.
        held_arm: the arm of the site.
        path: the path of the list in errors.
    """
    if not isinstance(written, list):
        raise ScenarioError(f"must be a list of tables [[{path}]]", path=path)
    tables = []
    for n, entry in enumerate(written):
        entry_path = f"{path}[{n}]"
        if not isinstance(entry, dict):
            raise ScenarioError("must be a table", path=entry_path)
        kind = _find_kind(entry, kinds, entry_path)
        fields.check_keys(entry, ("kind", *fields.field_names(kind)), entry_path)
        expanded = fields.expand_vectors(entry, kind, held_arm.counts)
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
    """Returns the class of an entry by its key `kind`."""
    if "kind" not in entry:
        raise ScenarioError(f"is missing: {' or '.join(map(repr, kinds))}", path=f"{path}.kind")
    kind = entry["kind"]
    for group, group_kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        if isinstance(kind, str) and kind in group_kinds and kind not in kinds:
            raise ScenarioError(f"is {kind!r}, which belongs in {group}", path=f"{path}.kind")
    fields.check_choice(kind, list(kinds), f"{path}.kind")
    return kinds[kind]


def _check_values(
    table: fields.TomlTable,
    kind: type[ActorBase],
    entry: fields.TomlTable,
    path: str,
    counts: fields.VectorCounts,
) -> None:
    """Refuses values of a complete table that its kind does not take.

    A wrong value that was not written but taken over from the arm is refused later, at the
    arm's own key.
    """
    is_planar = counts == fields.VectorCounts()
    placeholders = {
        name: planar_text if is_planar else chain_text
        for name, (planar_text, chain_text) in COUNT_TEXTS.items()
    }

    def describe_values(key: str) -> str:
        text = kind.value_texts.get(key) or VALUE_TEXTS[key]
        return text.format(**placeholders)

    refusal = _find_refusal(table, kind, counts)
    if refusal is None:
        return
    problem, location = refusal
    missing = re.search(r"missing required field `(\w+)`", problem)
    if missing is not None:
        key = missing[1]
        raise ScenarioError(f"is missing: {describe_values(key)}", path=f"{path}.{key}")
    match = re.match(r"`\$\.(\w+)(.*)`", location)
    key, rest = (match[1], match[2]) if match else ("", location)
    if key not in entry:
        return
    if key == "points":
        expected = describe_values(key)
        if rest:
            expected = f"a row {POINTS_ROW_TEXT.format(**placeholders)}"
        raise ScenarioError(f"must be {expected}", path=f"{path}.{key}{rest}")
    value = repr(entry[key])
    quoted = f", is {value}" if len(value) <= _MAX_QUOTED_LENGTH else ""
    raise ScenarioError(f"must be {describe_values(key)}{quoted}", path=f"{path}.{key}")


def _find_refusal(
    table: fields.TomlTable, kind: type[ActorBase], counts: fields.VectorCounts
) -> tuple[str, str] | None:
    """Returns why a table is refused, and the location in msgspec's notation; None if valid."""
    try:
        msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        problem, _, location = str(error).partition(" - at ")
        return problem, location
    count_problem = fields.find_count_problem(table, kind, counts)
    if count_problem is not None:
        return count_problem.problem, f"`$.{count_problem.key}`"
    for n, row in enumerate(table.get("points", ())):
        if len(row) != 1 + counts.joints:
            return "of another arm", f"`$.points[{n}]`"
    return None

"""Operators and environments of a scenario: which there are, and how an author's tables become
complete ones.

Invariant: torques and forces are those ON the arm; times are seconds after the epoch; keys end
in their unit. An operator is one class, found by its file in this folder, and nothing else
lists them; its name in a scenario is its tag. The kernel's own kinds name a `TorqueKind`; any
other has a file of its own, with a function that is compiled and one for many rows. Mistakes
are refused at their own key.
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
    """What an operator who takes hold of an arm meets.

    Attributes:
        q0_rad: the arm's start pose, as far as it is one.
        end_effector_m: returns the end effector's place in that pose.
    """

    counts: fields.VectorCounts
    q0_rad: Any
    end_effector_m: Callable[[], list[float]]
    draws: Draws


class ActorBase(fields.Frozen, frozen=True, tag_field="kind"):
    """An operator or an environment."""

    group: ClassVar[str] = "hands"
    """The list of a site in which it stands: hands or environment."""
    value_texts: ClassVar[Mapping[str, str]] = {}
    """The values that its own keys take, in words; of those in `WORDS` nothing need be said."""

    def _source(self) -> TorqueSource:
        raise NotImplementedError

    @property
    def actor(self) -> TorqueSource:
        """The actor as the core has it."""
        return self._source()

    @classmethod
    def complete(
        cls, table: fields.TomlTable, entry: fields.TomlTable, holding: HeldArm, path: str
    ) -> None:
        """Fills in what an author's entry left to the arm; errors call the entry `path`."""

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns a problem that no range of a single key shows, or None."""
        if math.hypot(*getattr(self, "normal", (1.0,))) < 1e-6:
            return fields.KeyProblem("normal", "must point somewhere, is zero")
        start_s = getattr(self, "start_s", 0.0)
        end_s = getattr(self, "end_s", fields.MAX_QUANTITY)
        if end_s <= start_s:
            return fields.KeyProblem(
                "end_s", f"must be later than start_s = {start_s:g}, is {end_s:g}"
            )
        return None


class TimedActor(ActorBase, frozen=True, kw_only=True):
    """One that acts from `start_s` to `end_s`."""

    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY


class SampledActor(TimedActor, frozen=True, kw_only=True):
    """One that, with `sampled`, is evaluated once a tick and held, as a digital haptic wall is."""

    sampled: bool = False


class OwnActor(SampledActor, frozen=True, kw_only=True):
    """An operator or an environment with a function of its own, a file of this folder.

    Its keys are numbers, or a vector with a number per joint or axis. It acts on the joints; or
    with `at_tip` on the end effector: then `act` and `effort` see its place and velocity, m and
    m/s, and give a force, N.
    """

    at_tip: ClassVar[bool] = False

    def act(self, now: Any) -> None:
        """Writes `now.effort[i]`, N m or N, for i below `now.coordinates`, by now.t_s, now.at,
        now.speed.

        It is compiled, and asked in every stage of the integrator: what it computes depends on
        its keys and on `now` alone, and rounds alike everywhere (core.elementary, sqrt).
        """
        raise NotImplementedError

    def effort(self, t_s: Array, at: Array, speed: Array) -> Array:
        """Returns the same for many rows, shape (..., n), written apart from `act`; a test
        compares them.

        The linearised loop differentiates it by complex steps: it takes complex numbers, and
        branches on real parts.
        """
        raise NotImplementedError

    def _source(self) -> TorqueSource:
        kind = TorqueKind.OWN_TIP if self.at_tip else TorqueKind.OWN_JOINTS
        return TorqueSource(kind, self.start_s, self.end_s, sampled=self.sampled, model=self)


_GAIN = "one number for {joints}, at least 0"
ROW_WORDS = "[time in s, torque on {each} in N m]"
WORDS = {
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
    "points": f"a list of rows {ROW_WORDS}",
    "sampled": "true or false",
    "mode": "'tip', 'joint' or 'force'",
    "force_limit_n": "a force above 0 N",
    "torque_limit_nm": "a torque above 0 N m",
    "speed_limit_m_s": "a speed above 0 m/s",
    "speed_limit_rad_s": "a speed above 0 rad/s",
    "acceleration_limit_m_s2": "an acceleration above 0 m/s^2",
    "acceleration_limit_rad_s2": "an acceleration above 0 rad/s^2",
}
"""The values that a key takes, for an author who gave it another or none."""
IN_WORDS = {
    "joints": ("both joints or two", "all joints or one for each"),
    "axes": ("two numbers, x and y", "three numbers, x, y and z"),
    "all_axes": ("both axes or two", "all axes or three"),
    "each": ("joint 1, on joint 2", "each joint"),
}
"""Those of the planar arm, and of any other."""


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
    Operator = Union[tuple(OPERATORS.values())]  # noqa: UP007 - made of what was found
    Environment = Union[tuple(ENVIRONMENTS.values())]  # noqa: UP007
_SHOWN = 60
"""A longer value is not repeated in an error."""


def resolve_operators(
    written: Any,
    kinds: Mapping[str, type[ActorBase]],
    holding: HeldArm,
    path: str,
) -> list[fields.TomlTable]:
    """Returns a site's operators or environments, complete, of the kinds that it may hold.

    Errors call the list `path`.
    """
    if not isinstance(written, list):
        raise ScenarioError(f"must be a list of tables [[{path}]]", path=path)
    tables = []
    for n, entry in enumerate(written):
        place = f"{path}[{n}]"
        if not isinstance(entry, dict):
            raise ScenarioError("must be a table", path=place)
        kind = _find_kind(entry, kinds, place)
        fields.check_keys(entry, ("kind", *fields.field_names(kind)), place)
        table = holding.draws.draw_numbers(
            fields.expand_vectors(entry, kind, holding.counts), place
        )
        kind.complete(table, entry, holding, place)
        _check_values(table=table, kind=kind, entry=entry, path=place, counts=holding.counts)
        tables.append(table)
    return tables


def _find_kind(
    entry: fields.TomlTable, kinds: Mapping[str, type[ActorBase]], path: str
) -> type[ActorBase]:
    if "kind" not in entry:
        raise ScenarioError(f"is missing: {' or '.join(map(repr, kinds))}", path=f"{path}.kind")
    kind = entry["kind"]
    for group, others in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        if isinstance(kind, str) and kind in others and kind not in kinds:
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
    words = {name: both[counts != fields.VectorCounts()] for name, both in IN_WORDS.items()}

    def describe_values(key: str) -> str:
        return (kind.value_texts.get(key) or WORDS[key]).format(**words)

    try:
        msgspec.convert(table, kind)
        if found := fields.find_count_problem(table, kind, counts):
            raise msgspec.ValidationError(f"{found.problem} - at `$.{found.key}`")
        for n, row in enumerate(table.get("points", ())):
            if len(row) != 1 + counts.joints:
                raise msgspec.ValidationError(f"of another arm - at `$.points[{n}]`")
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        if missing := re.search(r"missing required field `(\w+)`", problem):
            key = missing[1]
            raise ScenarioError(
                f"is missing: {describe_values(key)}", path=f"{path}.{key}"
            ) from None
        at = re.match(r"`\$\.(\w+)(.*)`", place)
        key, rest = (at[1], at[2]) if at else ("", place)
        if key not in entry:  # taken over from the arm, which is refused at its own key
            return
        if key == "points":
            one = f"a row {ROW_WORDS.format(**words)}" if rest else describe_values(key)
            raise ScenarioError(f"must be {one}", path=f"{path}.{key}{rest}") from None
        value = repr(entry[key])
        is_now = f", is {value}" if len(value) <= _SHOWN else ""
        raise ScenarioError(
            f"must be {describe_values(key)}{is_now}", path=f"{path}.{key}"
        ) from None

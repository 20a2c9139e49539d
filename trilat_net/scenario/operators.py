"""Operators and environments: their types, and the step from an author's tables to complete ones.

Invariant: torques and forces are those ON the arm; times are seconds after the epoch; keys end in their
unit. An operator without a start pose holds the arm at the arm's start pose. Mistakes are refused at their
own key.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np
from msgspec import Meta

from .. import fields
from ..core.chain import MAX_JOINTS
from ..core.exogenous import TorqueKind, TorqueSource
from ..core.live_hand import HandRules
from ..errors import ScenarioError
from .distributions import Draws

Frequency = Annotated[float, Meta(gt=0.0, le=1000.0)]
RecordedPoint = Annotated[tuple[fields.Real, ...], Meta(min_length=2, max_length=1 + MAX_JOINTS)]


class ActorBase(fields.Frozen, frozen=True, tag_field="kind"):
    """An operator or an environment."""

    def _source(self) -> TorqueSource:
        raise NotImplementedError

    @property
    def actor(self) -> TorqueSource:
        """The actor as the core has it."""
        return self._source()


class Pulse(ActorBase, frozen=True, tag="pulse"):
    """A smooth push of an operator: peak * sin^2(pi (t - start) / (end - start)).

    Attributes:
        start_s: when it begins.
        end_s: when it ends.
        peak_nm: its peak on each joint, N m.
    """

    start_s: fields.NotNegative
    end_s: fields.Positive
    peak_nm: fields.Joints

    def _source(self) -> TorqueSource:
        return TorqueSource(TorqueKind.PULSE, self.start_s, self.end_s, a=self.peak_nm)


class JointSpring(ActorBase, frozen=True, tag="spring"):
    """An operator as a spring and a damper on every joint, towards a pose that moves (minimum jerk).

    Attributes:
        to_rad: the pose that it moves to, rad.
        from_rad: the pose before, rad; left out: the arm's start pose.
        stiffness_nm_rad: per joint, N m/rad.
        damping_nm_s_rad: per joint, N m s/rad.
        move_start_s: when the pose begins to move.
        move_end_s: when it arrives.
        start_s: when the operator takes hold.
        end_s: when it lets go.
        sampled: true: evaluated once a tick and held.
    """

    to_rad: fields.Joints
    from_rad: fields.Joints
    stiffness_nm_rad: fields.NotNegativeJoints
    damping_nm_s_rad: fields.NotNegativeJoints = (0.0,)
    move_start_s: fields.NotNegative = 0.0
    move_end_s: fields.NotNegative = 0.0
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    def _source(self) -> TorqueSource:
        return _spring_source(TorqueKind.HAND, self)


class EndEffectorSpring(ActorBase, frozen=True, tag="tip_spring"):
    """An operator at the end effector: a spring and a damper in the plane, towards a point that moves.

    Attributes:
        to_m: the point that it moves to, x and y, m.
        from_m: the point before, m; left out: the end effector's start position.
        stiffness_n_m: along x and y, N/m.
        damping_n_s_m: along x and y, N s/m.
        move_start_s: as of `JointSpring`, like those that follow.
    """

    to_m: fields.Point
    from_m: fields.Point
    stiffness_n_m: fields.NotNegativeAxes
    damping_n_s_m: fields.NotNegativeAxes = (0.0,)
    move_start_s: fields.NotNegative = 0.0
    move_end_s: fields.NotNegative = 0.0
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    def _source(self) -> TorqueSource:
        return _spring_source(TorqueKind.TASK_HAND, self)


def _spring_source(kind: TorqueKind, spring: JointSpring | EndEffectorSpring) -> TorqueSource:
    """Returns a spring as the core has it; both kinds begin with the same four fields."""
    end, start, stiffness, damping = msgspec.structs.astuple(spring)[:4]
    held = spring.start_s, spring.end_s, spring.move_start_s, spring.move_end_s
    return TorqueSource(kind, *held, start, end, stiffness, damping, spring.sampled)


class RecordedTorque(ActorBase, frozen=True, tag="recorded"):
    """A torque that was recorded, linear between its points; nothing before the first and after the last.

    Attributes:
        points: rows of time, s, and the torque on each joint, N m, in order of time.
    """

    points: Annotated[tuple[RecordedPoint, ...], Meta(min_length=1, max_length=1_000_000)]

    def _source(self) -> TorqueSource:
        return TorqueSource(TorqueKind.RECORDED, table=np.array(self.points, dtype=np.float64))


class Chirp(ActorBase, frozen=True, tag="chirp"):
    """A torque of an operator whose frequency runs from one to another, evenly, again and again.

    Attributes:
        peak_nm: its peak on each joint, N m.
        from_hz: frequency at the beginning of a sweep, Hz.
        to_hz: frequency at its end, Hz.
        sweep_s: duration of a sweep, s.
        start_s: when it begins.
        end_s: when it ends.
    """

    peak_nm: fields.Joints
    from_hz: Frequency
    to_hz: Frequency
    sweep_s: fields.Positive
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY

    def _source(self) -> TorqueSource:
        sweep = (self.start_s, self.start_s + self.sweep_s)
        return TorqueSource(
            TorqueKind.CHIRP, self.start_s, self.end_s, *sweep, self.peak_nm, (self.from_hz, self.to_hz)
        )


class Multisine(ActorBase, frozen=True, tag="multisine"):
    """A torque of an operator that is a sum of sines of one amplitude.

    Attributes:
        amplitude_nm: amplitude of each sine on each joint, N m.
        frequencies_hz: their frequencies, Hz.
        phases_rad: their phases at the start, rad; left out: -pi k (k - 1) / n for the k-th of n, which keeps
            the peak of their sum low (Schroeder, "Synthesis of low-peak-factor signals and binary sequences
            with low autocorrelation", IEEE Trans. Information Theory 16 (1970)).
        start_s: when it begins.
        end_s: when it ends.
    """

    amplitude_nm: fields.Joints
    frequencies_hz: Annotated[tuple[Frequency, ...], Meta(min_length=1, max_length=64)]
    phases_rad: Annotated[tuple[fields.Real, ...], Meta(max_length=64)] = ()
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY

    def _source(self) -> TorqueSource:
        count = len(self.frequencies_hz)
        turns = [phase / (2.0 * math.pi) for phase in self.phases_rad]
        turns = turns or [-k * (k - 1) / (2.0 * count) for k in range(1, count + 1)]
        table = np.column_stack((self.frequencies_hz, turns, np.zeros(count)))
        return TorqueSource(TorqueKind.MULTISINE, self.start_s, self.end_s, a=self.amplitude_nm, table=table)


class LiveHand(ActorBase, frozen=True, tag="live", omit_defaults=True):
    """An operator who takes hold while a live session runs, with a mouse, a device or a program.

    Nobody holds the arm before, and in virtual time nobody ever does, unless a log says so. Its force is
    computed once a tick and held. One that pushes ("force") sets a force itself: its work is of first order
    in the period, as nothing but the arm resists it.

    Attributes:
        mode: "tip": a spring at the end effector, "joint": a spring at every joint, both towards a target
            that somebody moves; "force": a force at the end effector that somebody sets.
        stiffness_n_m: of "tip", along each axis, N/m.
        damping_n_s_m: of "tip", along each axis, N s/m.
        force_limit_n: of "tip" and "force", the largest force, N.
        speed_limit_m_s: of "tip", the largest speed of the target, m/s.
        stiffness_nm_rad: of "joint", per joint, N m/rad.
        damping_nm_s_rad: of "joint", per joint, N m s/rad.
        torque_limit_nm: of "joint", the largest norm of its torques, N m.
        speed_limit_rad_s: of "joint", the largest speed of the target, rad/s.
    """

    mode: Literal["tip", "joint", "force"] = "tip"
    stiffness_n_m: fields.NotNegativeAxes = (300.0,)
    damping_n_s_m: fields.NotNegativeAxes = (20.0,)
    force_limit_n: fields.Positive = 40.0
    speed_limit_m_s: fields.Positive = 1.5
    stiffness_nm_rad: fields.NotNegativeJoints = (40.0,)
    damping_nm_s_rad: fields.NotNegativeJoints = (3.0,)
    torque_limit_nm: fields.Positive = 20.0
    speed_limit_rad_s: fields.Positive = 4.0

    def rules(self, rate_hz: int, counts: fields.VectorCounts) -> HandRules:
        """Returns what somebody who holds an arm of such vectors may do."""
        if self.mode == "joint":
            return HandRules(counts.joints, rate_hz, self.speed_limit_rad_s)
        pushes = self.mode == "force"
        return HandRules(counts.axes, rate_hz, math.inf if pushes else self.speed_limit_m_s, not pushes)

    def _source(self) -> TorqueSource:
        stiffness, damping, limit = self.stiffness_n_m, self.damping_n_s_m, self.force_limit_n
        if self.mode == "joint":
            stiffness, damping, limit = self.stiffness_nm_rad, self.damping_nm_s_rad, self.torque_limit_nm
        kind = TorqueKind[f"LIVE_{self.mode.upper()}"]
        return TorqueSource(kind, K=stiffness, B=damping, limit=limit, sampled=True)


LIVE_KEYS = {
    "tip": ("stiffness_n_m", "damping_n_s_m", "force_limit_n", "speed_limit_m_s"),
    "joint": ("stiffness_nm_rad", "damping_nm_s_rad", "torque_limit_nm", "speed_limit_rad_s"),
    "force": ("force_limit_n",),
}
"""The keys of a live hand by its mode."""


def find_live_hand(operators: Iterable[ActorBase]) -> LiveHand | None:
    """Returns the live hand among a site's operators, or None."""
    return next((one for one in operators if isinstance(one, LiveHand)), None)


class ViscousEnvironment(ActorBase, frozen=True, tag="viscous"):
    """An environment that resists motion of the joints.

    Attributes:
        damping_nm_s_rad: per joint, N m s/rad.
        start_s: when it begins.
        end_s: when it ends.
        sampled: true: evaluated once a tick and held.
    """

    damping_nm_s_rad: fields.NotNegativeJoints
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    def _source(self) -> TorqueSource:
        return TorqueSource(
            TorqueKind.VISCOUS, self.start_s, self.end_s, B=self.damping_nm_s_rad, sampled=self.sampled
        )


class Wall(ActorBase, frozen=True, tag="wall"):
    """A unilateral wall for the end effector: it pushes out of itself, along its normal, and never pulls.

    Attributes:
        point_m: a point of its surface, x and y, m.
        normal: towards the free side; its length does not matter.
        stiffness_n_m: N/m.
        damping_n_s_m: N s/m.
        start_s: when it begins.
        end_s: when it ends.
        sampled: true: evaluated once a tick and held, as a digital haptic wall is.
    """

    point_m: fields.Point
    normal: fields.Point
    stiffness_n_m: fields.NotNegative
    damping_n_s_m: fields.NotNegative = 0.0
    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    def _source(self) -> TorqueSource:
        length = math.hypot(*self.normal) if len(self.normal) == 2 else math.sqrt(_sum_squares(self.normal))
        unit = tuple(x / length for x in self.normal)
        stiffness, damping = (self.stiffness_n_m, 0.0), (self.damping_n_s_m, 0.0)
        vectors: dict[str, Any] = {"a": self.point_m, "b": unit, "K": stiffness, "B": damping}
        return TorqueSource(TorqueKind.WALL, self.start_s, self.end_s, **vectors, sampled=self.sampled)


def _sum_squares(vector: tuple[float, ...]) -> float:
    """Returns x^2 + y^2 + z^2, rounded alike on every machine; `math.hypot` need not be."""
    x, y, z = vector
    return x * x + y * y + z * z


Operator = Pulse | JointSpring | EndEffectorSpring | RecordedTorque | Chirp | Multisine | LiveHand
Environment = ViscousEnvironment | Wall
OPERATORS: dict[str, type[fields.Frozen]] = {
    str(one.__struct_config__.tag): one for one in get_args(Operator)
}
ENVIRONMENTS: dict[str, type[fields.Frozen]] = {
    str(one.__struct_config__.tag): one for one in get_args(Environment)
}
"""The operators and the environments by the name of their kind."""

_TIME = "a time of at least 0 s"
_ANGLES = "one angle for {joints}, rad"
_POINT = "{axes}, m"
_GAIN = "one number for {joints}, at least 0"
_ROW = "[time in s, torque on {each} in N m]"
_WORDS = {
    **dict.fromkeys(("start_s", "end_s", "move_start_s", "move_end_s"), _TIME),
    **dict.fromkeys(("from_rad", "to_rad"), _ANGLES),
    **dict.fromkeys(("from_m", "to_m", "point_m"), _POINT),
    **dict.fromkeys(("peak_nm", "amplitude_nm"), "one torque for {joints}, ON the arm, N m"),
    "stiffness_nm_rad": f"{_GAIN}, N m/rad",
    "damping_nm_s_rad": f"{_GAIN}, N m s/rad",
    **dict.fromkeys(("from_hz", "to_hz"), "a frequency above 0 and up to 1000 Hz"),
    "sweep_s": "a duration above 0 s",
    "frequencies_hz": "a list of 1 to 64 frequencies above 0 and up to 1000 Hz",
    "phases_rad": "a list of angles, rad, one for each frequency",
    "normal": "{axes}: to which side the wall is free",
    "points": f"a list of rows {_ROW}",
    "sampled": "true or false",
    "tip_spring.stiffness_n_m": "one number for {all_axes}, at least 0, N/m",
    "tip_spring.damping_n_s_m": "one number for {all_axes}, at least 0, N s/m",
    "mode": "'tip', 'joint' or 'force'",
    "force_limit_n": "a force above 0 N",
    "torque_limit_nm": "a torque above 0 N m",
    "speed_limit_m_s": "a speed above 0 m/s",
    "speed_limit_rad_s": "a speed above 0 rad/s",
    "live.stiffness_n_m": "one number for {all_axes}, at least 0, N/m",
    "live.damping_n_s_m": "one number for {all_axes}, at least 0, N s/m",
    "wall.stiffness_n_m": "a number of at least 0, N/m",
    "wall.damping_n_s_m": "a number of at least 0, N s/m",
}
"""The values that a key takes, for an author who gave it another or none."""
_IN_WORDS = {
    "joints": ("both joints or two", "all joints or one for each"),
    "axes": ("two numbers, x and y", "three numbers, x, y and z"),
    "all_axes": ("both axes or two", "all axes or three"),
    "each": ("joint 1, on joint 2", "each joint"),
}
"""Those of the planar arm, and of any other."""
_SHOWN = 60
"""A longer value is not repeated in an error."""


class Holding(NamedTuple):
    """What an operator who takes hold of an arm meets.

    Attributes:
        counts: how many numbers the vectors of the site have.
        q0_rad: the arm's start pose, as far as it is one.
        end_effector_m: returns the end effector's place in that pose.
    """

    counts: fields.VectorCounts
    q0_rad: Any
    end_effector_m: Callable[[], list[float]]


def resolve_operators(
    written: Any,
    kinds: Mapping[str, type[fields.Frozen]],
    holding: Holding,
    path: str,
    draws: Draws,
) -> list[fields.TomlTable]:
    """Returns a site's operators or environments, complete, of the kinds that it may hold.

    Errors call the list `path`; `draws` gives the numbers of distributions.
    """
    if not isinstance(written, list):
        raise ScenarioError(f"must be a list of tables [[{path}]]", path=path)
    return [_resolve_actor(entry, kinds, holding, f"{path}[{n}]", draws) for n, entry in enumerate(written)]


def _resolve_actor(
    entry: Any, kinds: Mapping[str, type[fields.Frozen]], holding: Holding, path: str, draws: Draws
) -> fields.TomlTable:
    if not isinstance(entry, dict):
        raise ScenarioError("must be a table", path=path)
    kind = _check_kind(entry, kinds, path)
    fields.check_keys(entry, ("kind", *fields.field_names(kinds[kind])), path)
    table = draws.draw_numbers(fields.expand_vectors(entry, kinds[kind], holding.counts), path)
    if kind == "live":
        _keep_live_keys(table, entry, path)
    if kind == "spring":
        draws.follow_start(table, "from_rad", holding.q0_rad, path)
        draws.follow_start(table, "to_rad", table["from_rad"], path)
    if kind == "tip_spring":
        draws.follow_start(table, "from_m", holding.end_effector_m(), path)
        draws.follow_start(table, "to_m", table["from_m"], path)
    _check_values(table, kinds[kind], entry, path, holding.counts)
    return table


def _keep_live_keys(table: fields.TomlTable, entry: fields.TomlTable, path: str) -> None:
    """Leaves out of a live hand what another mode has; refuses what the author wrote of that."""
    mode = entry.get("mode", "tip")
    fields.check_choice(mode, list(LIVE_KEYS), f"{path}.mode")
    for key in [key for key in table if key not in ("kind", "mode", *LIVE_KEYS[mode])]:
        if key in entry:
            which = next(name for name, keys in LIVE_KEYS.items() if key in keys)
            raise ScenarioError(
                f"belongs to a live hand of mode {which!r}; this one is of mode {mode!r}, "
                f"which has {', '.join(LIVE_KEYS[mode])}",
                path=f"{path}.{key}",
            )
        del table[key]


def _check_kind(entry: fields.TomlTable, kinds: Mapping[str, fields.StructType], path: str) -> str:
    """Returns the kind of an actor; refuses one in the wrong list with the name of the right one."""
    if "kind" not in entry:
        raise ScenarioError(f"is missing: {' or '.join(map(repr, kinds))}", path=f"{path}.kind")
    kind = entry["kind"]
    for group, others in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        if isinstance(kind, str) and kind in others and kind not in kinds:
            raise ScenarioError(f"is {kind!r}, which belongs in {group}", path=f"{path}.kind")
    fields.check_choice(kind, list(kinds), f"{path}.kind")
    return str(kind)


def _check_values(
    table: fields.TomlTable,
    kind: fields.StructType,
    entry: fields.TomlTable,
    path: str,
    counts: fields.VectorCounts,
) -> None:
    """Refuses a wrong or a missing value, with the values that its key takes."""
    words = {name: both[counts != fields.VectorCounts()] for name, both in _IN_WORDS.items()}

    def describe_values(key: str) -> str:
        return (_WORDS.get(key) or _WORDS[f"{table['kind']}.{key}"]).format(**words)

    try:
        msgspec.convert(table, kind)
        _check_lengths(table, kind, counts)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        if missing := re.search(r"missing required field `(\w+)`", problem):
            key = missing[1]
            raise ScenarioError(f"is missing: {describe_values(key)}", path=f"{path}.{key}") from None
        found = re.match(r"`\$\.(\w+)(.*)`", place)
        key, rest = (found[1], found[2]) if found else ("", place)
        if key not in entry:  # taken over from the arm, which is refused at its own key
            return
        if key == "points":
            one = f"a row {_ROW.format(**words)}" if rest else describe_values(key)
            raise ScenarioError(f"must be {one}", path=f"{path}.{key}{rest}") from None
        value = repr(entry[key])
        is_now = f", is {value}" if len(value) <= _SHOWN else ""
        raise ScenarioError(f"must be {describe_values(key)}{is_now}", path=f"{path}.{key}") from None


def _check_lengths(table: fields.TomlTable, kind: fields.StructType, counts: fields.VectorCounts) -> None:
    """Raises `msgspec.ValidationError` for a vector, or a row of a table, that does not fit the arm."""
    if found := fields.find_count_problem(table, kind, counts):
        raise msgspec.ValidationError(f"{found.problem} - at `$.{found.key}`")
    for n, row in enumerate(table.get("points", ())):
        if len(row) != 1 + counts.joints:
            raise msgspec.ValidationError(f"of another arm - at `$.points[{n}]`")

"""What an operator or an environment is made of, and the words for its keys.

Invariant: torques and forces are those ON the arm; times are seconds after the epoch; keys end in their unit.
An operator is one class, its name in a scenario is its tag. The kernel's own kinds name a `TorqueKind`; any
other has a file of its own here, with a function that is compiled and one for many rows.
"""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

from ... import fields
from ...core.exogenous import TorqueKind, TorqueSource
from ...core.vectors import Array
from ..distributions import Draws


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


class ActorBase(fields.Frozen, frozen=True, tag_field="kind"):
    """An operator or an environment."""

    group: ClassVar[str] = "hands"
    """The list of a site in which it stands: hands or environment."""
    words: ClassVar[Mapping[str, str]] = {}
    """The values that its own keys take, in words; of those in `WORDS` nothing need be said."""

    def _source(self) -> TorqueSource:
        raise NotImplementedError

    @property
    def actor(self) -> TorqueSource:
        """The actor as the core has it."""
        return self._source()

    @classmethod
    def is_kind(cls) -> bool:
        """True if a scenario can name it, and it is no base of others."""
        return str(cls.__struct_config__.tag) != cls.__name__

    @classmethod
    def complete(
        cls, table: fields.TomlTable, entry: fields.TomlTable, holding: Holding, draws: Draws, path: str
    ) -> None:
        """Fills in what an author's entry left to the arm; errors call the entry `path`."""

    def find_problem(self) -> fields.KeyProblem | None:
        """Returns a problem that no range of a single key shows, or None."""
        start_s, end_s = getattr(self, "start_s", 0.0), getattr(self, "end_s", fields.MAX_QUANTITY)
        if end_s <= start_s:
            return fields.KeyProblem("end_s", f"must be later than start_s = {start_s:g}, is {end_s:g}")
        return None


class OwnActor(ActorBase, frozen=True, kw_only=True):
    """An operator or an environment with a function of its own, a file of this folder.

    Its keys are numbers, or a vector with a number per joint or axis. It acts on the joints; or with `at_tip`
    on the end effector: then `act` and `effort` see its place and velocity, m and m/s, and give a force, N.

    Attributes:
        start_s: when it begins to act.
        end_s: when it ends.
        sampled: true: evaluated once a tick and held.
    """

    at_tip: ClassVar[bool] = False

    start_s: fields.NotNegative = 0.0
    end_s: fields.Positive = fields.MAX_QUANTITY
    sampled: bool = False

    def act(self, now: Any) -> None:
        """Writes `now.effort[i]`, N m or N, for i below `now.coordinates`, by now.t_s, now.at, now.speed.

        It is compiled, and asked in every stage of the integrator: what it computes depends on its keys and
        on `now` alone, and rounds alike everywhere (core.sincos, sqrt).
        """
        raise NotImplementedError

    def effort(self, t_s: Array, at: Array, speed: Array) -> Array:
        """Returns the same for many rows, shape (..., n), written apart from `act`; a test compares them.

        The linearised loop differentiates it by complex steps: it takes complex numbers, and branches on real
        parts.
        """
        raise NotImplementedError

    def _source(self) -> TorqueSource:
        kind = TorqueKind.OWN_TIP if self.at_tip else TorqueKind.OWN_JOINTS
        return TorqueSource(kind, self.start_s, self.end_s, sampled=self.sampled, model=self)


_TIME = "a time of at least 0 s"
_ANGLES = "one angle for {joints}, rad"
_POINT = "{axes}, m"
_GAIN = "one number for {joints}, at least 0"
ROW_WORDS = "[time in s, torque on {each} in N m]"
WORDS = {
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
    "points": f"a list of rows {ROW_WORDS}",
    "sampled": "true or false",
    "mode": "'tip', 'joint' or 'force'",
    "force_limit_n": "a force above 0 N",
    "torque_limit_nm": "a torque above 0 N m",
    "speed_limit_m_s": "a speed above 0 m/s",
    "speed_limit_rad_s": "a speed above 0 rad/s",
}
"""The values that a key takes, for an author who gave it another or none."""
IN_WORDS = {
    "joints": ("both joints or two", "all joints or one for each"),
    "axes": ("two numbers, x and y", "three numbers, x, y and z"),
    "all_axes": ("both axes or two", "all axes or three"),
    "each": ("joint 1, on joint 2", "each joint"),
}
"""Those of the planar arm, and of any other."""

"""Runs a user's plant: a class that computes the motion of an arm and of other bodies.

A plant takes the place of the built-in simulation of an arm. At each tick, a period of the
control loop, it receives the torque of the control law and returns the new state of the arm. In
a scenario, the description of an experiment, the plant of an arm is named by its class:

    plant = "my_plant:Scene"            # or a table: { class = "my_plant:Scene", mass_kg = 2 }

Invariant:
    - The state that a plant returns is treated as a measurement, like the state of a real
      robot. The log stores it as the joint positions q, the joint velocities qd and the
      external torques tau_x. Therefore the control can be executed again from a log without the
      plant, and no check of a log judges the motion of the plant.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
from msgspec import Meta, field

from ..core.step.ticks import PlantState
from ..core.step.vectors import Array
from ..errors import PlantFailed, ScenarioError, count_nouns, describe_exception
from ..fields import Frozen, is_number
from .class_arguments import make_own_instance
from .imported_code import CLASS_PATTERN, CodeKey, Watch, call_directly, import_class, read_code

if TYPE_CHECKING:
    from .scenario_types import Scenario


T = TypeVar("T")
_BODY_NAME = re.compile(r"[a-z][a-z0-9_]{0,29}")
_MAX_BODIES = 32
"""Largest number of bodies that a plant moves in addition to its arm."""
_MAX_SIZE_M = 100.0
"""Largest extent of a body, in m."""
_POSE_NUMBERS = 7
"""Number of values of a pose: three for the position, four for the quaternion."""


class PlantContext(NamedTuple):
    """Facts that a user's plant receives when it is created.

    >>> class Scene:
    ...     def __init__(self, facts: tn.PlantContext) -> None:
    ...         self.arm = tn.SimulatedArm(facts.scenario, facts.site)
    ...     def step(self, tau, h_s):
    ...         self.arm.move(tau, h_s)
    ...         return self.arm.q, self.arm.qd

    Attributes:
        site: Name of the site whose arm the plant moves.
        scenario: The experiment, with its arms, start poses and tick rates.
        q0_rad: Start pose of the arm, in rad, shape (n,).
        h_s: Duration of a tick, in s.
        seed: Seed for random numbers of the plant. It depends on the scenario's seed and the
            site.
        bodies_m: Extents of the bodies that the plant moves in addition to the arm, by name,
            along their own axes x, y and z, in m.
    """

    site: str
    scenario: "Scenario"
    q0_rad: tuple[float, ...]
    h_s: float
    seed: int
    bodies_m: Mapping[str, tuple[float, float, float]]


class PlantProgram(Protocol):
    """Interface of a user's plant: a program that computes the motion of an arm.

    The user's class is called with a `PlantContext` as its first argument, and with its
    settings by name.
    """

    def step(self, tau: Array, h_s: float) -> Sequence[Sequence[float]]:
        """Advances the plant by one period under a constant control torque.

        Args:
            tau: Control torque ON the joints, in N m, shape (n,).
            h_s: Duration of the period, in s.

        Returns:
            q in rad and qd in rad/s at the end of the period. A plant that knows the torque of
            contacts also returns tau_x in N m, with the sign of Eq. (8): the negative of the
            torque ON the arm.
        """

    def poses(self) -> Sequence[Sequence[float]]:
        """Returns the current poses of the bodies, in the order of `PlantContext.bodies_m`.

        This method is called only if the plant has bodies.

        Returns:
            Seven numbers per body: x, y and z of its centre in the frame of the arm's base, in
            m, and the quaternion w, x, y, z.
        """


class OwnPlant(Frozen, frozen=True, rename={"code": "class"}, omit_defaults=True):
    """Table of a user's plant in a scenario.

    A plant is a program that computes the motion of an arm.

    Attributes:
        code: Class of the plant, for example "my_plant:Scene".
        source_sha256: SHA-256 hash of the file of the class.
        bodies: Bodies that the plant moves in addition to the arm. For each name, the extents
            along the body's own axes x, y and z of a box around it, in m. Their poses are
            recorded and drawn.
        settings: Arguments of the class, by name.
    """

    method: ClassVar[str] = "step"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    bodies: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)


def resolve_plant(written: Any, path: str) -> Any:
    """Completes the settings of a user's plant in a scenario.

    A plant is a user's Python class that computes the motion of an arm, and of bodies such as a
    box that it moves. The result contains the SHA-256 hash of the file with the class, the
    arguments of the class, and the sizes of the bodies.

    Args:
        written: Value of the key `plant` as the author of the scenario wrote it: a class name,
            as in "my_plant:Scene", or a table.
        path: Path of the key, for error messages.

    Returns:
        The completed table. A text that is not a class name, such as "external", and a value of
        a wrong type are returned unchanged.

    Raises:
        ScenarioError: The class is missing, its file cannot be read, or the size of a body is
            not valid.
    """
    table = written
    if isinstance(written, str) and ":" in written:
        table = {"class": written}
    if not isinstance(table, Mapping):
        return written
    code = table.get("class")
    if not isinstance(code, str):
        raise ScenarioError("must be a class, as in 'my_plant:Scene'", path=f"{path}.class")
    bodies = {}
    if "bodies" in table:
        bodies["bodies"] = _check_bodies(table["bodies"], f"{path}.bodies")
    # A table with a hash has been resolved before.
    if "source_sha256" in table:
        return {**table, **bodies}

    settings = {key: value for key, value in table.items() if key not in ("class", "bodies")}
    return {
        "class": code,
        "source_sha256": read_code(code, path).sha256,
        "settings": settings,
        **bodies,
    }


def _check_bodies(written: Any, path: str) -> Any:
    """Returns the table of bodies unchanged if their names and extents are valid.

    Raises:
        ScenarioError: There are too many bodies, or a name or extent is not valid.
    """
    if not isinstance(written, Mapping) or len(written) > _MAX_BODIES:
        example = "{ box = [0.2, 0.2, 0.1] }"
        raise ScenarioError(
            f"must be the sizes of at most {_MAX_BODIES} bodies, as in {example}", path=path
        )
    for name, size in written.items():
        if not _BODY_NAME.fullmatch(name):
            raise ScenarioError(
                f"the name of a body may contain only a to z, 0 to 9 and _, not {name!r}",
                path=path,
            )
        if not _is_box_size(size):
            raise ScenarioError(
                f"must be three sizes in m, each above 0 and at most {_MAX_SIZE_M:g}, but is "
                f"{size!r}",
                path=f"{path}.{name}",
            )
    return written


def _is_box_size(size: Any) -> bool:
    """True for a list of three lengths in m that a body may have."""
    if not isinstance(size, list | tuple) or len(size) != 3:
        return False
    return all(is_number(length) and 0.0 < length <= _MAX_SIZE_M for length in size)


class PlantPlayer:
    """Runs a user's plant at its site, tick by tick.

    A plant is a program that computes the motion of an arm from the torques of its motors.

    Args:
        scenario: The scenario.
        site: Name of the site.
        plant: Table of the plant.
        watch: Function that calls the code of the plant, for example with a time limit.

    Attributes:
        state: State of the arm and the bodies in the next tick.
        rate_hz: Tick rate of the site, in Hz.

    Raises:
        ScenarioError: The class cannot be used, or lacks a method.
        PlantFailed: The first poses of the bodies are not valid.
    """

    def __init__(
        self, scenario: "Scenario", site: str, plant: OwnPlant, watch: Watch = call_directly
    ) -> None:
        spec = scenario.sites[site]
        path = f"sites.{site}.plant"
        self._site = site
        self._code = plant.code
        self._watch = watch
        self.rate_hz = spec.rate_hz
        kind = import_class(CodeKey.of(plant), path, plant.method)
        if plant.bodies and not hasattr(kind, "poses"):
            raise ScenarioError(
                f"{plant.code} has no method poses(), which must return the poses of the "
                "bodies",
                path=f"{path}.bodies",
            )
        context = PlantContext(
            site=site,
            scenario=scenario,
            q0_rad=spec.q0_rad,
            h_s=1.0 / spec.rate_hz,
            seed=scenario.draw_seed(site),
            bodies_m=plant.bodies,
        )
        self._program: PlantProgram = make_own_instance(
            kind, plant.code, context, plant.settings, path
        )
        self._body_count = len(plant.bodies)
        bodies = self._call(0, self._read_poses)
        self.state = PlantState(spec.q0_rad, spec.qd0_rad_s, (), bodies)

    def move(self, tick: int, tau: Sequence[float]) -> None:
        """Lets the plant compute the motion of the arm from a tick to the next one.

        The result is stored in `state`.

        Args:
            tick: Number of the tick that has been executed.
            tau: Control torque of this tick, in N m, shape (n,).

        Raises:
            PlantFailed: The plant raised an error, or returned a state with wrong lengths or
                numbers that are not finite.
        """
        vectors = self._call(tick, lambda: self._step(tau))
        for name, vector in zip(("q", "qd", "tau_x"), vectors, strict=False):
            if len(vector) != len(tau):
                raise self._make_error(
                    tick,
                    f"{name} has {count_nouns(len(vector), 'number')}, and the arm "
                    f"has {count_nouns(len(tau), 'joint')}",
                )
            if not all(map(math.isfinite, vector)):
                raise self._make_error(tick, f"{name} is {vector}, which is not finite")

        bodies = self._call(tick, self._read_poses)
        q, qd, *contact_torques = vectors
        tau_x = contact_torques[0] if contact_torques else ()
        self.state = PlantState(q, qd, tau_x, bodies)

    def _step(self, tau: Sequence[float]) -> list[list[float]]:
        """Returns q, qd and, if the plant returns it, tau_x after one period."""
        q, qd, *others = self._program.step(np.array(tau), 1.0 / self.rate_hz)
        vectors = [q, qd, *others[:1]]
        return [[float(number) for number in vector] for vector in vectors]

    def _read_poses(self) -> list[float]:
        """Returns the poses of all bodies as one list, with seven numbers per body.

        Raises:
            ValueError: The plant returned another number of poses, or numbers that are not
                finite.
        """
        if not self._body_count:
            return []
        poses = [[float(number) for number in pose] for pose in self._program.poses()]
        if [len(pose) for pose in poses] != [_POSE_NUMBERS] * self._body_count:
            raise ValueError(
                f"poses() returned {poses} instead of seven numbers for each of "
                f"{count_nouns(self._body_count, 'body')}"
            )
        numbers = [number for pose in poses for number in pose]
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"poses() returned {poses}, which is not finite")
        return numbers

    def _call(self, tick: int, function: Callable[[], T]) -> T:
        """Calls the code of the plant, and returns the result.

        Args:
            tick: Tick, for the error message.
            function: The call.

        Raises:
            PlantFailed: The code raised an error.
        """
        try:
            result: T = self._watch(tick, function)
            return result
        # The user's code may raise anything.
        except (Exception, SystemExit) as error:
            raise self._make_error(tick, describe_exception(error)) from error

    def _make_error(self, tick: int, problem: str) -> PlantFailed:
        """Returns the error that reports a problem of the plant in a tick."""
        return PlantFailed(problem, site=self._site, code=self._code, tick=tick)


def make_plant_players(scenario: "Scenario") -> dict[str, PlantPlayer]:
    """Creates the users' plants of all sites that have one.

    Args:
        scenario: Description of the experiment.

    Returns:
        An object that runs the plant, by the name of the site. Empty if no site has a plant.

    Raises:
        CodeWithheld: A class may not run.
        ScenarioError: A plant cannot be created.
    """
    return {
        name: PlantPlayer(scenario, name, spec.plant)
        for name, spec in scenario.sites.items()
        if isinstance(spec.plant, OwnPlant)
    }

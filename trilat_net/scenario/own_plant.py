"""A plant of one's own: a class that moves an arm, and what else is in its scene, from tick to
tick.

    plant = "my_plant:Scene"            # or a table: { class = "my_plant:Scene", mass_kg = 2.0
    }

Invariant: what it says of the arm is measured: it becomes q, qd and tau_x of the next tick's
record, as the motion of an arm outside of the program does. A log therefore executes the
control again exactly, without the plant, and judges the plant by nothing.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
from msgspec import Meta, field

from ..core.ticks import PlantState
from ..core.vectors import Array
from ..errors import PlantFailed, ScenarioError, count_nouns
from ..fields import Frozen, is_number
from ..laws.interface import make_instance
from .imported_code import CLASS_PATTERN, CodeKey, Watch, call_directly, import_class, read_code

if TYPE_CHECKING:
    from .scenario_types import Scenario


T = TypeVar("T")
_BODY_NAME = re.compile(r"[a-z][a-z0-9_]{0,29}")
_MAX_BODIES = 32
_MAX_SIZE_M = 100.0


class PlantContext(NamedTuple):
    """What a plant of one's own knows before it begins.

    >>> class Scene:
    ...     def __init__(self, facts: tn.PlantContext) -> None:
    ...         self.arm = tn.SimulatedArm(facts.scenario, facts.site)
    ...     def step(self, tau, h_s):
    ...         self.arm.move(tau, h_s)
    ...         return self.arm.q, self.arm.qd

    Attributes:
        site: the site whose arm it moves.
        scenario: the experiment: its arms, start poses and tick rates.
        q0_rad: the arm's start pose, rad, shape (n,).
        h_s: the period of a tick, s.
        seed: for what it draws: of the scenario and the site.
        bodies_m: the bodies that it moves besides the arm, by name: sizes along x, y and z of
            their own, m.
    """

    site: str
    scenario: "Scenario"
    q0_rad: tuple[float, ...]
    h_s: float
    seed: int
    bodies_m: Mapping[str, tuple[float, float, float]]


class PlantProgram(Protocol):
    """A plant of one's own; its class is called with `PlantContext` and its settings, by name."""

    def step(self, tau: Array, h_s: float) -> Sequence[Sequence[float]]:
        """Moves on by a period under the control torque ON the joints, N m, shape (n,).

        Returns q, rad, and qd, rad/s, at its end; and, if it knows it, tau_x, N m, of what
        touches the arm: in the sign of Eq. (8), the negative of the torque ON it.
        """

    def poses(self) -> Sequence[Sequence[float]]:
        """Returns where its bodies are now, in the order of `PlantContext.bodies_m`; asked only
        with any.

        Seven numbers each: x, y, z of its middle in the arm's base frame, m, and the quaternion
        w, x, y, z.
        """


class OwnPlant(Frozen, frozen=True, rename={"code": "class"}, omit_defaults=True):
    """The plant of a site in a scenario.

    Attributes:
        code: its class, as in "my_plant:Scene".
        source_sha256: hash of the file of its class.
        bodies: what else it moves, by name: sizes of a box around it, along its own x, y and z,
            m; where they are is recorded and drawn.
        settings: the arguments of its class, by name.
    """

    method: ClassVar[str] = "step"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    bodies: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)


def resolve_plant(written: Any, path: str) -> Any:
    """Returns a site's plant complete: a word as it is, a class with the hash of its file."""
    table = {"class": written} if isinstance(written, str) and ":" in written else written
    if not isinstance(table, Mapping):
        return written
    code = table.get("class")
    if not isinstance(code, str):
        raise ScenarioError("must be a class, as in 'my_plant:Scene'", path=f"{path}.class")
    bodies = (
        {"bodies": _check_bodies(table["bodies"], f"{path}.bodies")}
        if "bodies" in table
        else {}
    )
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
    if not isinstance(written, Mapping) or len(written) > _MAX_BODIES:
        example = "{ box = [0.2, 0.2, 0.1] }"
        raise ScenarioError(
            f"must be the sizes of at most {_MAX_BODIES} bodies, as in {example}", path=path
        )
    for name, size in written.items():
        if not _BODY_NAME.fullmatch(name):
            raise ScenarioError(
                f"a body is named by a to z, 0 to 9 and _, not {name!r}", path=path
            )
        given = isinstance(size, list | tuple) and all(
            is_number(one) and 0.0 < one <= _MAX_SIZE_M for one in size
        )
        if not given or len(size) != 3:
            problem = f"must be three sizes, m, above 0 and up to {_MAX_SIZE_M:g}, is {size!r}"
            raise ScenarioError(problem, path=f"{path}.{name}")
    return written


class PlantPlayer:
    """A plant of one's own, moved from tick to tick.

    Attributes:
        state: the arm's motion at the next tick.
        rate_hz: the tick rate of its site, Hz.
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
                f"{plant.code} has no poses(), which says where they are", path=f"{path}.bodies"
            )
        context = PlantContext(
            site=site,
            scenario=scenario,
            q0_rad=spec.q0_rad,
            h_s=1.0 / spec.rate_hz,
            seed=scenario.draw_seed(site),
            bodies_m=plant.bodies,
        )
        self._program: PlantProgram = make_instance(
            kind, plant.code, context, plant.settings, path=path
        )
        self._bodies = len(plant.bodies)
        self.state = PlantState(spec.q0_rad, spec.qd0_rad_s, (), self._ask(0, self._place))

    def move(self, tick: int, tau: Sequence[float]) -> None:
        """Moves on from a tick to the next under its control torque, N m, shape (n,).

        Raises:
            PlantFailed: it raised, or says no motion of such an arm.
        """
        found = self._ask(tick, lambda: self._step(tau))
        for name, vector in zip(("q", "qd", "tau_x"), found, strict=False):
            if len(vector) != len(tau):
                problem = (
                    f"{name} has {count_nouns(len(vector), 'number')}, and the arm "
                    f"has {count_nouns(len(tau), 'joint')}"
                )
                raise self._failed(tick, problem)
            if not all(map(math.isfinite, vector)):
                raise self._failed(tick, f"{name} is {vector}, which is not finite")
        bodies = self._ask(tick, self._place)
        self.state = PlantState(found[0], found[1], found[2] if len(found) > 2 else (), bodies)

    def _step(self, tau: Sequence[float]) -> list[list[float]]:
        q, qd, *rest = self._program.step(np.array(tau), 1.0 / self.rate_hz)
        return [[float(one) for one in vector] for vector in (q, qd, *rest[:1])]

    def _place(self) -> list[float]:
        if not self._bodies:
            return []
        poses = [[float(one) for one in pose] for pose in self._program.poses()]
        if [len(pose) for pose in poses] != [7] * self._bodies:
            raise ValueError(
                f"poses() is {poses}, not seven numbers for each of {count_nouns(self._bodies, 'body')}"
            )
        if not all(math.isfinite(one) for pose in poses for one in pose):
            raise ValueError(f"poses() is {poses}, which is not finite")
        return [one for pose in poses for one in pose]

    def _ask(self, tick: int, call: Callable[[], T]) -> T:
        try:
            found: T = self._watch(tick, call)
            return found
        except (Exception, SystemExit) as error:  # the user's code
            raise self._failed(tick, f"{type(error).__name__}: {error}") from error

    def _failed(self, tick: int, problem: str) -> PlantFailed:
        return PlantFailed(problem, site=self._site, code=self._code, tick=tick)


def make_plant_players(scenario: "Scenario") -> dict[str, PlantPlayer]:
    """Returns the players of all plants of one's own, by site.

    Raises:
        CodeWithheld: a class may not run.
        ScenarioError: one cannot be made.
    """
    plants = ((name, spec.plant) for name, spec in scenario.sites.items())
    return {
        name: PlantPlayer(scenario, name, one)
        for name, one in plants
        if isinstance(one, OwnPlant)
    }

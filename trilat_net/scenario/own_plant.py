"""A plant of one's own: a class that moves an arm, and what else is in its scene, from tick to tick.

    plant = "my_plant:Scene"            # or a table: { class = "my_plant:Scene", mass_kg = 2.0 }

Invariant: what it says of the arm is measured: it becomes q, qd and tau_x of the next tick's record, as the
motion of an arm outside of the program does. A log therefore executes the control again exactly, without the
plant, and judges the plant by nothing.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol

import numpy as np
from msgspec import Meta, field

from ..core.ticks import PlantState, TickRecord
from ..core.vectors import Array
from ..errors import PlantFailed, ScenarioError
from ..fields import Frozen
from ..laws.interface import make_instance
from .imported_code import CLASS_PATTERN, Watch, call_plainly, import_class, read_code

if TYPE_CHECKING:
    from .scenario_types import Scenario


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
    """

    site: str
    scenario: "Scenario"
    q0_rad: tuple[float, ...]
    h_s: float
    seed: int


class PlantProgram(Protocol):
    """A plant of one's own; its class is called with `PlantContext` and its settings, by name."""

    def step(self, tau: Array, h_s: float) -> Sequence[Sequence[float]]:
        """Moves on by a period under the control torque ON the joints, N m, shape (n,).

        Returns q, rad, and qd, rad/s, at its end; and, if it knows it, tau_x, N m, of what touches the arm:
        in the sign of Eq. (8), the negative of the torque ON it.
        """


class OwnPlant(Frozen, frozen=True, rename={"code": "class"}, omit_defaults=True):
    """The plant of a site in a scenario.

    Attributes:
        code: its class, as in "my_plant:Scene".
        source_sha256: hash of the file of its class.
        settings: the arguments of its class, by name.
    """

    method: ClassVar[str] = "step"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    settings: dict[str, Any] = field(default_factory=dict)


def resolve_plant(written: Any, path: str) -> Any:
    """Returns a site's plant complete: a word as it is, a class with the hash of its file."""
    table = {"class": written} if isinstance(written, str) and ":" in written else written
    if not isinstance(table, Mapping):
        return written
    code = table.get("class")
    if not isinstance(code, str):
        raise ScenarioError("must be a class, as in 'my_plant:Scene'", path=f"{path}.class")
    if "source_sha256" in table:
        return dict(table)
    settings = {key: value for key, value in table.items() if key != "class"}
    return {"class": code, "source_sha256": read_code(code, path).sha256, "settings": settings}


class PlantPlayer:
    """A plant of one's own, moved from tick to tick.

    Attributes:
        state: the arm's motion at the next tick.
    """

    def __init__(self, scenario: "Scenario", site: str, plant: OwnPlant, watch: Watch = call_plainly) -> None:
        spec, path = scenario.sites[site], f"sites.{site}.plant"
        self._site, self._code, self._h_s, self._watch = site, plant.code, 1.0 / spec.rate_hz, watch
        kind = import_class(plant.code, plant.source_sha256, path, plant.method)
        context = PlantContext(site, scenario, spec.q0_rad, self._h_s, scenario.draw_seed(site))
        self._program: PlantProgram = make_instance(kind, plant.code, context, plant.settings, path=path)
        self.state = PlantState(spec.q0_rad, spec.qd0_rad_s)

    def move(self, output: TickRecord) -> None:
        """Moves on to the next tick under the torque of a record.

        Raises:
            PlantFailed: it raised, or says no motion of such an arm.
        """
        try:
            given = np.array(output.tau), self._h_s
            q, qd, *rest = self._watch(output.tick, lambda: self._program.step(*given))
            found = [[float(one) for one in vector] for vector in (q, qd, *rest[:1])]
        except (Exception, SystemExit) as error:  # the user's code
            raise self._failed(output.tick, f"{type(error).__name__}: {error}") from error
        for name, vector in zip(("q", "qd", "tau_x"), found, strict=False):
            if len(vector) != len(output.q):
                problem = f"{name} has {len(vector)} numbers, and the arm has {len(output.q)} joints"
                raise self._failed(output.tick, problem)
            if not all(map(math.isfinite, vector)):
                raise self._failed(output.tick, f"{name} is {vector}, which is not finite")
        self.state = PlantState(*found)

    def _failed(self, tick: int, problem: str) -> PlantFailed:
        return PlantFailed(problem, site=self._site, code=self._code, tick=tick)


def make_plant_players(scenario: "Scenario") -> dict[str, PlantPlayer]:
    """Returns the players of all plants of one's own, by site.

    Raises:
        CodeWithheld: a class may not run.
        ScenarioError: one cannot be made.
    """
    plants = ((name, spec.plant) for name, spec in scenario.sites.items())
    return {name: PlantPlayer(scenario, name, one) for name, one in plants if isinstance(one, OwnPlant)}

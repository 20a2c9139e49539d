"""Runs plants: users' own simulations of an arm and of other bodies.

A plant, for example a physics engine with objects to grasp, replaces the built-in simulation.
In each control period, it receives the torque of the control law and returns the new state of
the arm.

Invariant:
    - The state returned by a plant is treated as a measurement, like the state of a real robot.
      The log stores it as joint positions q, joint velocities qd and external torques tau_x.
      The controller can therefore be rerun from a log without the plant, and the checks of a
      log do not judge the motion of the plant.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from ..core import Array, PlantState
from ..errors import PlantFailed, ScenarioError, count_nouns, describe_exception
from ..own_code import CodeKey, Watch, call_directly, make_own_instance
from .own_plant import OwnPlant
from .scenario_types import Scenario

T = TypeVar("T")
_POSE_NUMBERS = 7
"""Number of values of a pose: three for the position, four for the quaternion."""


class PlantContext(NamedTuple):
    """Information about the experiment that a plant receives when it is created.

    >>> class Scene:
    ...     def __init__(self, facts: tn.PlantContext) -> None:
    ...         self.arm = tn.SimulatedArm(facts.scenario, facts.site)
    ...     def step(self, tau, h_s):
    ...         self.arm.move(tau, h_s)
    ...         return self.arm.q, self.arm.qd

    Attributes:
        site: Name of the site whose arm the plant moves.
        scenario: The scenario, with its arms, start poses and tick rates.
        q0_rad: Start pose of the arm, in rad, shape (n,).
        h_s: Duration of a tick, in s.
        seed: Seed for random numbers of the plant, derived from the seed of the scenario and
            the name of the site.
        bodies_m: Mapping from name to size of the bodies that the plant moves in addition to
            the arm, along their own axes x, y and z, in m.
    """

    site: str
    scenario: Scenario
    q0_rad: tuple[float, ...]
    h_s: float
    seed: int
    bodies_m: Mapping[str, tuple[float, float, float]]


class _PlantProgram(Protocol):
    """Interface of a user's plant, which computes the motion of an arm.

    The user's class is called with a `PlantContext` as its first argument, followed by its
    settings as keyword arguments.
    """

    def step(self, tau: Array, h_s: float) -> Sequence[Sequence[float]]:
        """Simulates one control period with constant motor torque.

        Args:
            tau: Control torque ON the joints, in N m, shape (n,).
            h_s: Duration of the period, in s.

        Returns:
            q in rad and qd in rad/s at the end of the period. A plant that knows the contact
            torques also returns tau_x in N m, with the sign of Eq. (8): minus the torque ON the
            arm.
        """

    def poses(self) -> Sequence[Sequence[float]]:
        """Returns the current poses of the bodies that the plant moves in addition to the arm.

        Bodies are listed in the order of `PlantContext.bodies_m`. Called only if there are any.

        Returns:
            Seven numbers per body: x, y and z of its centre in the base frame of the arm, in m,
                and the quaternion w, x, y, z.
        """


class PlantPlayer:
    """Runs a user's plant, which computes the motion of one arm, one period at a time.

    Args:
        scenario: The scenario.
        site: Name of the site.
        plant: Table of the plant.
        watch: Function through which the code of the plant is called, for example with a time
            limit.

    Attributes:
        state: State of the arm and the bodies at the next tick.
        rate_hz: Tick rate of the site, in Hz.

    Raises:
        ScenarioError: The class cannot be used, or lacks a method.
        PlantFailed: The initial poses of the bodies are not valid.
    """

    def __init__(
        self, scenario: Scenario, site: str, plant: OwnPlant, watch: Watch = call_directly
    ) -> None:
        spec = scenario.sites[site]
        path = f"sites.{site}.plant"
        self._site = site
        self._code = plant.code
        self._watch = watch
        self.rate_hz = spec.rate_hz
        kind = CodeKey.of(plant).import_class(path, plant.method)
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
        self._program: _PlantProgram = make_own_instance(
            kind, plant.code, context, plant.settings, path
        )
        self._body_count = len(plant.bodies)
        bodies = self._call(0, self._read_poses)
        self.state = PlantState(spec.q0_rad, spec.qd0_rad_s, (), bodies)

    @classmethod
    def make_all(cls, scenario: Scenario) -> "dict[str, PlantPlayer]":
        """Creates the plants of all sites that have one.

        Args:
            scenario: The scenario.

        Returns:
            Mapping from site name to the object that runs the plant. Empty if no site has a
            plant.

        Raises:
            CodeWithheld: Nobody has permitted the code of a class to run.
            ScenarioError: A plant cannot be created.
        """
        return {
            name: cls(scenario, name, spec.plant)
            for name, spec in scenario.sites.items()
            if isinstance(spec.plant, OwnPlant)
        }

    def move(self, tick: int, tau: Sequence[float]) -> None:
        """Runs the plant for one control period and stores the result in `state`.

        Args:
            tick: Number of the tick that has been executed.
            tau: Control torque of this tick, in N m, shape (n,).

        Raises:
            PlantFailed: The plant raised an error, or returned a state with wrong lengths or
                non-finite values.
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
        """Calls the plant for one control period and returns the motion after it.

        Returns q, qd and, if the plant measures it, the external torque tau_x.
        """
        q, qd, *others = self._program.step(np.array(tau), 1.0 / self.rate_hz)
        vectors = [q, qd, *others[:1]]
        return [[float(number) for number in vector] for vector in vectors]

    def _read_poses(self) -> list[float]:
        """Returns the poses of all bodies as one list, with seven numbers per body.

        Raises:
            ValueError: The plant returned the wrong number of poses, or non-finite numbers.
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
        """Calls a function of the plant, and reports where any exception was raised.

        Args:
            tick: Number of the tick, for the error message.
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
        """Returns the error for a plant that failed in the given control period."""
        return PlantFailed(problem, site=self._site, code=self._code, tick=tick)

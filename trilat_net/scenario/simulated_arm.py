"""Simulates an arm step by step, for use in place of a robot.

For example, the test of a robot driver can use `SimulatedArm` instead of the robot. It computes
joint accelerations from torques and integrates them over time, using the masses and geometry of
a scenario.

Invariant:
    - The arm obeys the same equation of motion as the scenario's arm in a run, Eq. (8) of the
      project. A planar arm is simulated as a chain of two joints.
"""

import numpy as np
from numpy.typing import ArrayLike

from ..core import Array, ChainDynamics
from .arms import build_arm
from .scenario_types import Scenario


class SimulatedArm:
    """Simulation of one arm, for use in plants and tests.

    Starts in the start pose of its site and moves only when `move` is called.

    >>> arm = tn.SimulatedArm(tn.load_scenario("two_sites"), "s")
    >>> arm.move([0.0, 0.0], 0.001)
    >>> bool(arm.qd.any())
    True

    Args:
        scenario: The scenario.
        site: Name of the site whose arm is simulated.
        heavier: Scale factor for all masses and inertias.

    Attributes:
        q: Joint angles in rad, or positions in m for prismatic joints, shape (n,).
        qd: Joint velocities in rad/s or m/s, shape (n,).
        chain: Joints, gravity and end effector of the arm.
        theta: Inertial parameters of the links, ten per link (see `core.chain`).

    Raises:
        ScenarioError: There is no such site.
    """

    def __init__(self, scenario: Scenario, site: str, heavier: float = 1.0) -> None:
        spec = scenario.find_site(site)
        model = build_arm(spec.arm, spec.task, scenario.urdf, chains=True)
        model = model.widen_stops(spec.q0_rad)
        assert model.chain is not None
        self.q = np.array(spec.q0_rad)
        self.qd = np.array(spec.qd0_rad_s)
        self.chain = model.chain
        self.theta = heavier * model.theta

    @property
    def theta(self) -> Array:
        """Inertial parameters of the links, ten per link (see `core.chain`)."""
        return self._theta

    @theta.setter
    def theta(self, theta: Array) -> None:
        self._theta = theta
        self._dynamics = ChainDynamics(self.chain, theta)

    def accelerate(self, torque: ArrayLike) -> Array:
        """Computes the joint accelerations under a torque, without moving the arm.

        Args:
            torque: Torque ON the joints, in N m, shape (n,).

        Returns:
            Accelerations in rad/s^2 or m/s^2, shape (n,).
        """
        torque_on_joints = np.asarray(torque, dtype=np.float64)
        return self._dynamics.find_acceleration(self.q, self.qd, torque_on_joints)

    def move(self, torque: ArrayLike, period_s: float) -> None:
        """Advances the simulation by one period under constant torque.

        Uses the semi-implicit Euler method: the velocities are advanced first, and the new
        velocities then advance the angles.

        Args:
            torque: Torque ON the joints, in N m, shape (n,).
            period_s: Duration of the step, in s.
        """
        self.qd += period_s * self.accelerate(torque)
        self.q += period_s * self.qd

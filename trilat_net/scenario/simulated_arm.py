"""An arm of a scenario that a program moves: in place of a robot, or of a plant.

Invariant:
    - The arm has the dynamics of the arm in the scenario, Eq. (8). A planar arm is a chain of
      two joints.
"""

import numpy as np
from numpy.typing import ArrayLike

from ..core.chain import MAX_JOINTS, build_chain, find_acceleration, place_joints
from ..core.vectors import Array
from . import Scenario, find_site
from .arms import build_arm


class SimulatedArm:
    """An arm that starts in the start pose of its site and moves when its program says so.

    >>> arm = tn.SimulatedArm(tn.load_scenario("two_sites"), "s")
    >>> arm.move([0.0, 0.0], 0.001)
    >>> bool(arm.qd.any())
    True

    Args:
        scenario: the scenario of the arm.
        site: the site of the arm.
        heavier: factor by which all masses and inertias are multiplied.

    Attributes:
        q: joint angles, rad, or m of a prismatic joint, shape (n,).
        qd: joint velocities, rad/s or m/s, shape (n,).
        chain: the joints, gravity and the end effector.
        theta: the inertial parameters of the links, ten per link, see `core.chain`.

    Raises:
        ScenarioError: there is no such site.
    """

    def __init__(self, scenario: Scenario, site: str, heavier: float = 1.0) -> None:
        spec = find_site(scenario, site)
        model = build_arm(spec.arm, spec.task, scenario.urdf, chains=True)
        model = model.widen_stops(spec.q0_rad)
        assert model.chain is not None
        self.q = np.array(spec.q0_rad)
        self.qd = np.array(spec.qd0_rad_s)
        self.chain = model.chain
        self.theta = heavier * model.theta
        self._joints = build_chain(model.chain.joints, MAX_JOINTS)
        self._gravity = np.array(model.chain.gravity_m_s2)

    def accelerate(self, torque: ArrayLike) -> Array:
        """Returns the joint accelerations under a torque, rad/s^2, shape (n,).

        The arm does not move.

        Args:
            torque: the torque ON the joints, N m, shape (n,).
        """
        acceleration = np.zeros_like(self.q)
        place_joints(self._joints, self.q)
        find_acceleration(
            chain=self._joints,
            theta=self.theta,
            gravity=self._gravity,
            q=self.q,
            qd=self.qd,
            torque=np.asarray(torque, dtype=np.float64),
            qdd=acceleration,
        )
        return acceleration

    def move(self, torque: ArrayLike, period_s: float) -> None:
        """Moves the arm by a period under a torque ON the joints, N m.

        The velocities advance first, then the angles with the new velocities (symplectic
        Euler).
        """
        self.qd += period_s * self.accelerate(torque)
        self.q += period_s * self.qd

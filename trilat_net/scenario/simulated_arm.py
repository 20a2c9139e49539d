"""An arm of a scenario that a program moves: where a robot is missing, or in place of one.

Invariant: it has the dynamics of the arm in the scenario, Eq. (8), a planar one as a chain of
two.
"""

import numpy as np
from numpy.typing import ArrayLike

from ..core.chain import MAX_JOINTS, build_chain, find_acceleration, place_joints
from ..core.vectors import Array
from . import Scenario, find_site
from .arms import build_arm


class SimulatedArm:
    """An arm at the start pose of its site, which moves when its program says so.

    >>> arm = tn.SimulatedArm(tn.load_scenario("two_sites"), "s")
    >>> arm.move([0.0, 0.0], 0.001)
    >>> bool(arm.qd.any())
    True

    Args:
        scenario: whose arm it is.
        site: the site of the arm.
        heavier: all masses and inertias are those of the scenario times this.

    Attributes:
        q: joint angles, rad, or m of a prismatic joint, shape (n,).
        qd: their velocities.
        chain: its joints, gravity and end effector.
        theta: the inertial parameters of its links, ten each, see `core.chain`.

    Raises:
        ScenarioError: there is no such site.
    """

    def __init__(self, scenario: Scenario, site: str, heavier: float = 1.0) -> None:
        find_site(scenario, site)
        spec = scenario.sites[site]
        arm = build_arm(spec.arm, spec.task, scenario.urdf, chains=True).widen_stops(
            spec.q0_rad
        )
        assert arm.chain is not None
        self.q = np.array(spec.q0_rad)
        self.qd = np.array(spec.qd0_rad_s)
        self.chain = arm.chain
        self.theta = heavier * arm.theta
        self._joints = build_chain(arm.chain.joints, MAX_JOINTS)
        self._gravity = np.array(arm.chain.gravity_m_s2)

    def accelerate(self, torque: ArrayLike) -> Array:
        """Returns the accelerations under a torque ON the joints, N m, shape (n,), rad/s^2;
        nothing moves.
        """
        found = np.zeros_like(self.q)
        place_joints(self._joints, self.q)
        told = (
            self.theta,
            self._gravity,
            self.q,
            self.qd,
            np.asarray(torque, dtype=np.float64),
        )
        find_acceleration(self._joints, *told, found)
        return found

    def move(self, torque: ArrayLike, period_s: float) -> None:
        """Moves on by a period under a torque ON the joints, N m: first the velocities, then
        the angles.
        """
        self.qd += period_s * self.accelerate(torque)
        self.q += period_s * self.qd

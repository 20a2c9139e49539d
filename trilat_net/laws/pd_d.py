"""The control law PD+d: a spring and a damper to the peers, and a damper that brakes the arm.

The spring (P) acts on the position error, the first damper (D) on the derivative of this error,
and the second damper (d) on the arm's own velocity. The law also adds the arm's gravity torque,
computed from known masses.

The compiled control loop computes this law (`core.step.control.damped_torque`).
`PdD.compute_torque` implements the same law in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same torques.
"""

from typing import ClassVar

import numpy as np

from ..core import Array, Gains, Law
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints, PositiveCoordinates
from .conditions import LawSituation, StabilityCondition
from .interface import DAMPING, ERROR_DAMPING, STIFFNESS, ControlLaw


class PdD(ControlLaw):
    """Spring and damper coupling, known gravity: tau = G(q) - K e - d qd - Kd ed.

    G(q) is the gravity torque. The error e is the position minus the reference (the mean
    position of the peers, weighted by the dominance factors), and ed is its derivative. For
    constant delays and equal ratios Kd / K at all sites, the stability condition of the law
    `PD` on K and d is also sufficient for this law.

    Attributes:
        K: Stiffness per joint, N m/rad.
        Kd: Damping of the error, per joint, N m s/rad.
        d: Damping of the arm's motion, per joint, N m s/rad.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
    """

    K: PositiveCoordinates = (10.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    d: NotNegativeJoints = (5.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING, "d": DAMPING}

    def compute_torque(self, G: Array, e: Array, ed: Array, qd: Array) -> Array:
        """Computes the torque of each joint before limiting, N m.

            tau = G - K e - d qd - Kd ed

        K is the stiffness (N m/rad), d the damping of the arm and Kd the damping of the error
        (both N m s/rad).

        Args:
            G: Gravity compensation torque, shape (n,) for n joints, N m.
            e: Position error (position minus reference), shape (n,), rad.
            ed: Derivative of the error, shape (n,), rad/s.
            qd: Joint velocities, shape (n,), rad/s.
        """
        spring = np.array(self.K) * e
        damper = np.array(self.d) * qd
        error_damper = np.array(self.Kd) * ed
        # The order of the terms is the kernel's for the planar arm: the last bit depends on it.
        return G - spring - damper - error_damper

    def gains(self, theta: Array) -> Gains:
        """Converts the gains of this law to the record that the compiled control loop reads.

        The record contains the stiffness, both damping coefficients, and the parameters needed
        to compute the gravity torque.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque.
        known = (theta * self.gravity).tolist()
        return Gains(
            Law.KNOWN,
            K=self.K,
            Kd=self.Kd,
            d=self.d,
            known=known,
        )

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether this law is stable with the gains and delays of a scenario.

        Uses the known condition of the law P+d on the stiffness K and the damping d, which is
        sufficient for constant delays if the ratio Kd / K is the same at all arms.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The condition of P+d on K and d. None if gravity compensation is not exact, because
            no condition is known for that case.
        """
        return situation.judge_position_exchange("d")

    def exchanges_positions(self) -> bool:
        """Returns True if the law couples the arms like passive springs and dampers.

        This requires exact gravity compensation (`gravity` = 1). Stability conditions for laws
        of this kind require reversible dominance factors alpha_ij: there must be positive
        weights D_i with D_i alpha_ij = D_j alpha_ji.
        """
        return self.gravity == 1.0

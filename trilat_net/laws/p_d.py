"""The control law P+d: a spring pulls the arm towards its peers, and a damper brakes it.

The spring (P) acts on the position error, and the damper (d) on the arm's own velocity. The law
also adds the arm's gravity torque, computed from known masses.

The compiled control loop computes this law (`core.step.control.damped_torque`).
`PD.compute_torque` implements the same law in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same torques.
"""

from typing import ClassVar

import numpy as np

from ..core import Array, Gains, Law
from ..fields import NotNegative, NotNegativeJoints, PositiveCoordinates
from .conditions import LawSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, ControlLaw


class PD(ControlLaw):
    """Spring coupling, damper and known gravity: tau = G(q) - K e - d qd.

    The error e is the position minus the reference (the mean position of the peers, weighted by
    the dominance factors alpha). For reversible dominance factors, equal gains and one constant
    delay T, the linearised loop of N sites is stable for all masses if d >
    max(abs(lambda_min(alpha)), 0.2172) K T. For some masses, this bound is also necessary. For
    two sites, the condition is 4 d_1 d_2 > (T_1 + T_2)^2 K_1 K_2. For other dominance factors,
    some heavy arms are unstable at any d. These bounds hold in continuous time. If torques are
    held over a control period, more damping is required (docs/reference/laws-springs.md).

    Attributes:
        K: Stiffness per joint, N m/rad.
        d: Damping per joint, N m s/rad.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
    """

    K: PositiveCoordinates = (10.0,)
    d: NotNegativeJoints = (3.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING}

    def compute_torque(self, G: Array, e: Array, qd: Array) -> Array:
        """Computes the torque of each joint before limiting, N m.

            tau = G - K e - d qd

        K is the stiffness (N m/rad) and d the damping of the arm (N m s/rad).

        Args:
            G: Gravity compensation torque, shape (n,) for n joints, N m.
            e: Position error (position minus reference), shape (n,), rad.
            qd: Joint velocities, shape (n,), rad/s.
        """
        spring = np.array(self.K) * e
        damper = np.array(self.d) * qd
        return G - spring - damper

    def gains(self, theta: Array) -> Gains:
        """Converts the gains of this law to the record that the compiled control loop reads.

        The record contains the stiffness, the damping, and the parameters needed to compute the
        gravity torque.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque.
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, d=self.d, known=known)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the damping is sufficient for the network delays, for any masses.

        Args:
            situation: All sites, their laws, the delays and the dominance factors.

        Returns:
            The condition of `LawSituation.judge_position_exchange`. None if gravity
            compensation is not exact, because no condition is known for that case.
        """
        return situation.judge_position_exchange("d")

    def find_uniform_spring(self) -> tuple[float, float] | None:
        """Returns K in N m/rad and d in N m s/rad, if each is the same for all joints.

        None if the joints have different gains, or if gravity compensation is not exact.
        """
        is_uniform = len({*self.K}) == 1 and len({*self.d}) == 1
        if self.gravity != 1.0 or not is_uniform:
            return None
        return self.K[0], self.d[0]

    def exchanges_positions(self) -> bool:
        """Returns True if the law couples the arms like passive springs and dampers.

        This requires exact gravity compensation (`gravity` = 1), the only case for which the
        stability condition is proved (see `condition`). The condition also requires reversible
        dominance factors alpha_ij: there must be positive weights D_i with D_i alpha_ij = D_j
        alpha_ji.
        """
        return self.gravity == 1.0

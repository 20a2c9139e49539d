"""The control law of Lee and Spong, which computes its damping from the largest delay.

In the law PD+d, a spring (P) and a damper (D) couple an arm to the arms that it follows, and a
second damper (d) brakes the arm itself. Here the coefficient of the second damper is computed
from the spring stiffness and the largest delay, so the user specifies a delay instead of a
damping coefficient.

The compiled control loop computes this law (`core.step.control.damped_torque`).
`LeeSpong.compute_torque` implements the same law in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same torques.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints, PositiveCoordinates
from .conditions import LawSituation, StabilityCondition
from .interface import DAMPING, ERROR_DAMPING, STIFFNESS, ControlLaw, TuningSite


class LeeSpong(ControlLaw):
    """Spring coupling with enough damping for all delays up to a known maximum.

    The damping is d = K T_max + P_e, where K is the stiffness of the spring, T_max half of the
    longest round trip between the arms, and P_e additional damping.

    Source: Lee and Spong, "Passive bilateral teleoperation with constant time delay", IEEE T-RO
    22, 2006.

    Attributes:
        K: Stiffness per joint, N m/rad.
        Kd: Damping of the error, per joint, N m s/rad.
        T_max_ms: Half of the longest round trip, ms.
        P_e: Damping in addition to the damping required by the delay, per joint, N m s/rad.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
    """

    K: PositiveCoordinates = (10.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    T_max_ms: NotNegative = 200.0
    P_e: NotNegativeJoints = (0.0,)
    gravity: NotNegative = 1.0

    needs_joint_space: ClassVar = True
    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING, "d_extra": DAMPING}

    @property
    def damping(self) -> tuple[float, ...]:
        """Damping d = K T_max + P_e of the arm's motion per joint, N m s/rad.

        K is the stiffness, T_max half of the longest round trip, and P_e the additional
        damping.
        """
        damping = []
        for K, P_e in zip(self.K, self.P_e, strict=True):
            needed = K * 1e-3 * self.T_max_ms
            damping.append(needed + P_e)
        return tuple(damping)

    def compute_torque(self, G: Array, e: Array, ed: Array, qd: Array) -> Array:
        """Computes the torque of each joint before limiting, N m.

            tau = G - K e - (K T_max + P_e) qd - Kd ed

        K is the stiffness of the spring (N m/rad), T_max half of the longest round trip between
        the sites (s), P_e additional damping and Kd the damping of the error (both N m s/rad).

        Args:
            G: Gravity compensation torque, shape (n,) for n joints, N m.
            e: Position error (position minus reference), shape (n,), rad.
            ed: Derivative of the error, shape (n,), rad/s.
            qd: Joint velocities, shape (n,), rad/s.
        """
        spring = np.array(self.K) * e
        damper = np.array(self.damping) * qd
        error_damper = np.array(self.Kd) * ed
        # The order of the terms is the kernel's for the planar arm: the last bit depends on it.
        return G - spring - damper - error_damper

    def gains(self, theta: Array) -> Gains:
        """Converts the gains of this law to the record that the compiled control loop reads.

        The record contains the stiffness, both damping coefficients, and the parameters needed
        to compute the gravity torque. The damping of the arm is given by the property
        `damping`.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque.
        known = (theta * self.gravity).tolist()
        return Gains(
            Law.KNOWN,
            K=self.K,
            Kd=self.Kd,
            d=self.damping,
            known=known,
        )

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the coupling of this arm is stable with the scenario's delays.

        Uses the known condition for a spring with a damper, which requires the damping to
        exceed the stiffness times the delay.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The condition. None if gravity compensation is not exact, because no condition is
            known for that case.
        """
        return situation.judge_position_exchange("damping")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The largest delay T_max, from which the law computes its damping, is set to half of the
        longest mean round trip between two sites. If the delays vary, some of them exceed this
        value, and stability is not proved.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {
            "K": gains["K"],
            "Kd": gains["Kd"],
            "P_e": gains["d_extra"],
            "T_max_ms": site.longest_ms,
            "gravity": site.gravity,
        }

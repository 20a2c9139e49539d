"""Implements the law of Lee and Spong, which computes its damping from the largest delay.

The law PD+d couples an arm by a spring (P) and a damper (D) to the arms that it follows. A
second damper (d) brakes the arm itself. Its damping is computed from the stiffness of the
spring and the largest delay. Therefore the user states a delay instead of a damping.

The compiled control loop computes this law (`core.step.control.damped_torque`).
`LeeSpong.compute_torque` states the same law in plain Python, and
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
    """Spring to the other arms, with enough damping for all delays up to a known maximum.

    The damping is d = K T_max + P_e, where K is the stiffness of the spring, T_max half of the
    longest round trip between the arms, and P_e additional damping.

    Source: Lee and Spong, "Passive bilateral teleoperation with constant time delay", IEEE T-RO
    22, 2006.

    Attributes:
        K: Stiffness per joint, N m/rad.
        Kd: Damping of the error's velocity, per joint, N m s/rad.
        T_max_ms: Half of the longest round trip, ms.
        P_e: Damping beyond the amount that the delay needs, per joint, N m s/rad.
        gravity: Factor of the true gravity that the law compensates; 1 is exact.
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
        """Damping d = K T_max + P_e of the arm's velocity per joint, N m s/rad.

        K is the stiffness, T_max half of the longest round trip, P_e the additional damping.
        """
        damping = []
        for K, P_e in zip(self.K, self.P_e, strict=True):
            needed = K * 1e-3 * self.T_max_ms
            damping.append(needed + P_e)
        return tuple(damping)

    def compute_torque(self, G: Array, e: Array, ed: Array, qd: Array) -> Array:
        """Computes the torque of each joint before the torque limits, N m.

            tau = G - K e - (K T_max + P_e) qd - Kd ed

        K is the stiffness of the spring (N m/rad), T_max half of the longest round trip between
        the sites (s), P_e additional damping and Kd the damping of the error (both N m s/rad).

        Args:
            G: Torque that compensates gravity, shape (n,) for n joints, N m.
            e: Position error: position minus reference, shape (n,), rad.
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

        The record contains the stiffness, the two dampings, and the parameters from which the
        gravity torque is computed. The damping of the arm is the property `damping`.

        Args:
            theta: Parameters of the arm's dynamics, such as masses, shape (P,), where P is
                their number.
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
        """Evaluates for which gains and delays this law is stable at one arm of a scenario.

        The known condition for a spring with a damper is used. It bounds the damping from below
        by the stiffness times the delay.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The condition. None if the law does not compensate gravity exactly, because then no
            condition is known.
        """
        return situation.judge_position_exchange("damping")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the settings of this law for one arm, after its gains were tuned.

        The settings form the table [control] of a scenario, the description of an experiment.
        The largest delay T_max, from which the law computes its damping, is set to half of the
        longest mean round trip between two sites. If the delays vary, some of them exceed this
        value, and stability is not proved.

        Args:
            gains: Tuned gains by name.
            site: Facts about the arm for which the table is written.
        """
        return {
            "K": gains["K"],
            "Kd": gains["Kd"],
            "P_e": gains["d_extra"],
            "T_max_ms": site.longest_ms,
            "gravity": site.gravity,
        }

"""The adaptive control law, which learns the dynamic parameters of the arm.

The law is given by Eq. (13) and (15) of the paper "Adaptive Control of Dual User Teleoperation
with Time Delay and Dynamic Uncertainty", on which this project is based. No model of the arm is
required: the law estimates the dynamic parameters theta (combinations of masses, lengths and
inertias) while controlling the arm:

    torque = Y theta_hat - Kp r - Kd ed
    rate of theta_hat = -Gamma Y' r

where q and qd are the joint positions and velocities, e is the position minus its reference
(the weighted mean position of the other arms), ed its derivative, r = qd + Lambda e the
filtered error, theta_hat the estimate, and Y the regressor (Y theta is the torque of the arm's
dynamics). Lambda, Kp, Kd and Gamma are gains; a prime denotes the transpose.

The compiled control loop computes this law (`core.step.control.adaptive_torque` and
`update_estimate`). `Adaptive` implements the same law in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same results.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law
from ..fields import (
    NotNegativeCoordinates,
    NotNegativeParameters,
    Parameters,
    PositiveCoordinates,
    PositiveJoints,
)
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ERROR_DAMPING, ControlLaw, TuningSite

_GRAVITY = slice(3, 5)
"""Indices of the arm parameters of Eq. (24) that appear in the gravity torque."""


class Adaptive(ControlLaw):
    """Adaptive control law that learns the dynamics of its arm, Eq. (13) and (15).

    In the absence of external torques, the loop is stable for any constant delays if the
    dominance matrix is irreducible and the matrices Kd of all sites differ only by scalar
    factors (stability theorem of the paper cited in the module docstring, with the weights of
    docs/theory/errata-proof.md). The condition is sufficient, and does not cover varying
    delays.

    With Gamma = 0 and theta_hat0 = theta, this is the law with known parameters. Kd = 0 removes
    the damping of the error.

    Attributes:
        Lambda: Rate at which errors decay, per joint, 1/s.
        Kp: Damping gain of the filtered error r = qd + Lambda e, per joint, N m s/rad.
        Kd: Damping of the error, per joint, N m s/rad.
        Gamma: Adaptation gain per parameter.
        theta_hat0: Initial estimate of theta, Eq. (24).
    """

    Lambda: PositiveCoordinates = (1.0,)
    Kp: PositiveJoints = (1.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    Gamma: NotNegativeParameters = (1.0,)
    theta_hat0: Parameters = (0.0,)

    has_functional: ClassVar = True
    tune: ClassVar = {
        "Lambda": CONVERGENCE,
        "Kp": DAMPING,
        "Kd": ERROR_DAMPING,
        "Gamma": ADAPTATION,
    }
    known_facts: ClassVar = "gravity, as its first estimate"

    def compute_torque(self, Y: Array, theta_hat: Array, r: Array, ed: Array) -> Array:
        """Returns the torque of each joint before limiting, N m, Eq. (13).

            tau = Y(q, qd, -Lambda e, -Lambda ed) theta_hat - Kp r - Kd ed

        Here e = q - q_des is the position error, and Lambda, Kp and Kd are the gains of the
        law.

        Args:
            Y: Regressor of Eq. (12), shape (n, P).
            theta_hat: Estimate of the parameters, shape (P,).
            r: Filtered error qd + Lambda e, Eq. (10), shape (n,), rad/s.
            ed: Derivative of the error, shape (n,), rad/s.
        """
        Kp = np.array(self.Kp)
        Kd = np.array(self.Kd)
        model_torque = np.zeros(len(Y))
        # The kernel adds the parameters' terms in this order; `Y @ theta_hat` may use another.
        for p in range(len(theta_hat)):
            model_torque += Y[:, p] * theta_hat[p]
        return model_torque - (Kp * r + Kd * ed)

    def advance_estimate(self, theta_hat: Array, Yr: Array, gain_s: float) -> Array:
        """Returns the estimate of the arm's parameters after one time step, Eq. (15).

        The continuous law is theta_hat' = -Gamma Y' r, where Y is the regressor, r the filtered
        error and Gamma the adaptation gain. The discrete step is

            theta_hat - gain_s Gamma Y' r

        Args:
            theta_hat: Estimate before the step, shape (P,).
            Yr: Product Y' r, shape (P,). For the trapezoid rule, the sum over two ticks.
            gain_s: Duration of the step, s. For the trapezoid rule, half of the control
                period.
        """
        return theta_hat - gain_s * np.array(self.Gamma) * Yr

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - used by other laws
        """Converts the gains of this law to the form that the compiled control loop reads.

        Args:
            theta: True parameters of the arm, unused because this law learns them.
        """
        return Gains(
            law=Law.ADAPTIVE,
            Lambda=self.Lambda,
            Kp=self.Kp,
            Kd=self.Kd,
            Gamma=self.Gamma,
            theta_hat0=self.theta_hat0,
        )

    def find_sampling_excess(self, g_m_s2: float, tick_s: float) -> float | None:
        """Returns Kp - Gamma g^2 h, which must be positive for the arm to come to rest.

        If the estimate of the gravity torque adapts too fast for the tick period h, the arm
        keeps swinging. Kp is the smallest entry of the gain `Kp`, and Gamma the largest
        adaptation gain among the parameters of the gravity torque. This is a rule of thumb for
        arms about 1 m long: a factor of length squared, about 1 m^2, is omitted.

        Args:
            g_m_s2: Gravitational acceleration g, m/s^2.
            tick_s: Period h of a tick, s.
        """
        largest_gravity_gain = max(self.Gamma[_GRAVITY])
        required_kp = largest_gravity_gain * g_m_s2**2 * tick_s
        return min(self.Kp) - required_kp

    def exchanges_positions(self) -> bool:
        """Returns True if the law couples the arms like passive springs and dampers.

        This is the case if the adaptation gain Gamma is zero, so that nothing is learnt.
        Stability conditions for laws of this kind require reversible dominance factors
        alpha_ij: there must be positive weights D_i with D_i alpha_ij = D_j alpha_ji.
        """
        return not any(self.Gamma)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The table contains the tuned gains and the initial estimate of the arm's parameters.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "theta_hat0": site.estimate}

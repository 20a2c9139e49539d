"""The bounded adaptive law with an additional torque that opposes unknown disturbances.

The law estimates the dynamic parameters of its arm within a box, as `AdaptiveBox` does. The
additional torque counteracts disturbances that no choice of these parameters explains, such as
friction or the torque of an operator. It never exceeds a bound specified by the user.

The compiled control loop computes this law (`core.step.control.robust_torque`).
`AdaptiveRobust.compute_torque` implements the same law in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same torques.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import ROBUST_RESIDUE, Array, Gains
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .adaptive_box import AdaptiveBox
from .conditions import LawSituation, StabilityCondition
from .interface import TuningSite


class AdaptiveRobust(AdaptiveBox):
    """Adaptive law with bounded estimates and a robust term -rho r / sqrt(r^2 + width^2).

    Here r is the filtered tracking error. The stability result assumes constant delays, no
    operators, true parameters within their bounds, and a disturbance of at most rho at each
    joint. It bounds the power that is dissipated according to V, the energy function of the
    stability proof. Averaged over time, this power is at most 0.3003 times the sum of beta_i
    rho width over the joints of all sites i, where beta_i is the weight of site i in V. It is
    not proved that the errors converge to zero. The bound is derived in
    docs/reference/laws-adaptive.md.

    Source: Slotine and Li, "Applied Nonlinear Control" (1991), 7.1, for the smooth term.

    Attributes:
        Lambda, Kp, Kd, Gamma, theta_hat0, theta_low, theta_high: As in `AdaptiveBox`.
        rho_nm: Bound on the disturbance per joint, N m (N for a sliding joint).
        width_rad_s: Value of r at which the robust term is 0.71 rho, per joint, rad/s (m/s for
            a sliding joint).
        friction: Fraction of the joint friction that the law compensates for.
    """

    rho_nm: NotNegativeJoints = (1.0,)
    width_rad_s: PositiveJoints = (0.1,)
    friction: NotNegative = 0.0

    tune: ClassVar = {**AdaptiveBox.tune, "rho_nm": (0.05, 5.0, "N m")}

    def compute_torque(
        self,
        Y: Array,
        theta_hat: Array,
        r: Array,
        ed: Array,
        joint_friction: Array | float = 0.0,
    ) -> Array:
        """Computes the torque of each joint before limiting, N m.

            tau = Y theta_hat - Kp r - Kd ed - (1 - friction) f(v) - rho r / sqrt(r^2 + width^2)

        Kp and Kd are damping gains in N m s/rad, and `friction` is the fraction of the friction
        f(v) that the law compensates for. The last term, the robust term, counteracts
        disturbances of up to rho (N m). It changes sign smoothly, within about `width` (rad/s)
        on either side of r = 0.

        Args:
            Y: Regressor of the arm's dynamics, shape (n, P), for n joints and P parameters.
            theta_hat: Estimate of the parameters, shape (P,).
            r: Filtered error qd + Lambda e, shape (n,), rad/s. Here qd is the joint velocity, e
                the position error and Lambda a gain in 1/s.
            ed: Derivative of the position error, shape (n,), rad/s.
            joint_friction: Friction torque f(v) at the reference velocity v, shape (n,), N m.
                For an arm from a URDF file, Y theta_hat contains it in full. The planar arm has
                no friction.
        """
        rho = np.array(self.rho_nm)
        width = np.array(self.width_rad_s)
        adaptive: Array = AdaptiveBox.compute_torque(self, Y, theta_hat, r, ed)
        uncompensated = (1.0 - self.friction) * joint_friction
        magnitude = np.sqrt(r * r + width * width)
        robust = rho * (r / magnitude)
        torque: Array = adaptive - uncompensated - robust
        return torque

    def gains(self, theta: Array) -> Gains:
        """Converts the gains of this law to the record that the compiled control loop reads.

        The record contains the gains and bounds of `AdaptiveBox`, and the settings for the
        robust term and friction compensation.

        Args:
            theta: True parameters of the arm, unused because this law learns them.
        """
        box = AdaptiveBox.gains(self, theta)
        return box._replace(
            rho=self.rho_nm,
            width=self.width_rad_s,
            friction=(self.friction,),
        )

    def condition(self, situation: LawSituation) -> StabilityCondition:
        """Returns the bound on the mean dissipated power that is proved for this law.

        The errors do not converge to zero, because friction or an operator may disturb each
        joint with a torque of up to `rho_nm`. Only a bound on a time average is proved. In the
        stability proof with the energy function V, site i dissipates the power beta_i r' Kp r
        plus a term for the disagreement between the sites. r is the filtered error in rad/s, Kp
        a damping gain in N m s/rad, and beta_i the weight of the site in V. The mean of this
        power is at most

            beta_i ROBUST_RESIDUE sum rho width    in W, summed over the joints of the site.

        The factor `ROBUST_RESIDUE` (0.3003) bounds the power that the smooth robust term does
        not cancel. For each joint, rho is the largest disturbance in N m, and width the value
        of r in rad/s at which the robust term reaches 0.71 rho.

        The proof assumes that all delays are constant and that the true parameters theta of the
        arm lie within the bounds of the estimate.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The bound, as text. It holds if all delays are constant, and is undecided otherwise.
        """
        pairs = zip(self.rho_nm, self.width_rad_s, strict=True)
        bounds_per_joint = [rho * width for rho, width in pairs]
        bound_w = ROBUST_RESIDUE * sum(bounds_per_joint)
        # The longest delay is NaN if any delay varies.
        delays_vary = bool(np.isnan(situation.longest_s))
        delays = "assumed constant, but vary here" if delays_vary else "constant"
        text = (
            f"delays are {delays}, theta is in its box: with torque of at most rho_nm that no "
            "estimate explains, the mean of beta times r'Kp r and the disagreement is at most "
            f"beta times {bound_w:.3g} W here; sufficient, in continuous time"
        )
        return StabilityCondition(None if delays_vary else True, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        While the filtered error r is small, the robust term -rho r / sqrt(r^2 + width^2) acts
        like a damper with the coefficient rho / width, where rho (N m) is the largest
        disturbance. The width (rad/s) is chosen such that this coefficient is a tenth of the
        gain Kp.

        Args:
            gains: Mapping from gain name to tuned value, with rho as `rho_nm`.
            site: Facts about the arm for which the table is written.
        """
        width_rad_s = 10.0 * gains["rho_nm"] / gains["Kp"]
        control = AdaptiveBox.write_control(gains, site)
        return {**control, "width_rad_s": width_rad_s}

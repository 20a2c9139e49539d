"""Control law with spring coupling in which the pull towards each peer is limited.

In the law P+d, a spring (P) couples an arm to its peers, and a damper (d) brakes the arm. Such
a spring would pull strongly towards a distant peer, for example after a network failure. In
this law, the pull grows with the distance as a hyperbolic tangent and saturates.

Invariant:
    - At any distance, peer j pulls arm i with at most alpha_ij P. P, a gain of the law, is the
      largest pull of all peers together, and alpha_ij is the dominance factor.
"""

from typing import ClassVar

import numpy as np

from ..core import Array, Gains, Law, LawInput, compiled, tanh
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import LawSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, ControlLaw


@compiled
class SaturatedPd(ControlLaw):
    """Couples arms with springs that saturate, and brakes each arm with a damper.

        tau = G - sum_j alpha_ij P tanh(K (q - q_j) / P) - d qd

    Source: Zakerimanesh, Hashemzadeh and Ghiasi, "Dual-user nonlinear teleoperation subjected
    to varying time delay and bounded inputs", ISA Transactions 68, 2017.

    Attributes:
        K: Stiffness for small errors, per joint, N m/rad.
        P: Largest spring torque towards all peers together, per joint, N m.
        d: Damping of the arm's motion, per joint, N m s/rad.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
    """

    K: PositiveJoints = (10.0,)
    P: PositiveJoints = (5.0,)
    d: NotNegativeJoints = (3.0,)
    gravity: NotNegative = 1.0

    linear_note: ClassVar = (
        "saturated_pd is linearised with the slope K of small errors; "
        "the law pulls less where sites disagree at rest"
    )
    tune: ClassVar = {"K": STIFFNESS, "P": (0.5, 50.0, "N m"), "d": DAMPING}
    needs_theta: ClassVar = True

    def torque(self, now: LawInput) -> None:
        """Computes the torque of the arm in one tick.

            tau = G - sum_j alpha_j P tanh(K (q - q_j) / P) - d qd

        tau is the torque, q and qd are the position and velocity of a joint, and q_j the
        position of peer j. G is the gravity torque times the gain `gravity`, and d the damping
        in N m s/rad. At small distances, each peer pulls like a spring with the stiffness K (N
        m/rad). Because the hyperbolic tangent never exceeds 1, the total pull of all peers
        never exceeds P (N m). It is divided among the peers according to the dominance factors
        alpha_j.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`.
        """
        for i in range(now.joints):
            q = now.q[i]
            P = self.P[i]
            gravity = self.gravity * now.gravity[i]
            damper = self.d[i] * now.qd[i]
            tau = gravity - damper
            for j in range(len(now.peers)):
                peer = now.peers[j]
                error = q - peer.q[i]
                spring = self.K[i] * error
                saturated = tanh(spring / P)
                tau -= peer.alpha * P * saturated
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the gains of the unsaturated spring and the damper for the linear analysis.

        For small position errors e, the spring does not saturate, and the law becomes

            tau = G - K e - d qd

        The analysis supports this form (`Law.KNOWN`, the law with known parameters). G is the
        gravity compensation torque, K the stiffness in N m/rad, d the damping in N m s/rad and
        qd the joint velocity.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque
        # by `gravity`, the ratio of the compensated gravity torque to the true one.
        compensated_parameters = theta * self.gravity
        return Gains(law=Law.KNOWN, K=self.K, d=self.d, known=compensated_parameters.tolist())

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates the stability of this law, and whether its torques stay within limits.

        The stability condition for a linear spring of stiffness K with a damper also applies to
        this law, at any resting pose, even if the arms are held apart. That the spring is
        nowhere stiffer than K would not suffice to prove this. The proof uses the fact that the
        slopes of the hyperbolic tangents form a positive semidefinite matrix, and applies the
        Schur product theorem (docs/theory/damping-conditions.md, 13).

        If the gravity torque of the arm is known, the torque limit of each joint must exceed
        the sum of the gravity torque and the largest spring torque P. The text of the condition
        then states the joint speed up to which the remaining torque suffices for the damper.

        Args:
            situation: The site, its peers, its torque limits and the delays.

        Returns:
            The condition. None if gravity compensation is not exact, because no condition is
            known for that case.
        """
        # The condition of P+d, a spring K to the peers and a damper d.
        condition = situation.judge_position_exchange("d")
        if condition is None:
            return None
        if not situation.gravity_nm:
            text = f"{condition.text}; and tau_limit_nm above gravity + P + d |qd|"
            return condition._replace(text=text)
        gravity = np.array(situation.gravity_nm)
        tau_limit = np.array(situation.tau_limit_nm)
        margin = tau_limit - gravity - np.array(self.P)
        if margin.min() <= 0.0:
            n = int(margin.argmin())
            text = (
                f"tau_limit_nm of joint {n + 1} is {-margin[n]:.3g} N m below gravity + P: "
                "the limit would cut off the pull"
            )
            return StabilityCondition(False, text)
        # A joint without damping has no such speed: the quotient is infinite.
        with np.errstate(divide="ignore"):
            speeds = margin / np.array(self.d)
        speed = float(np.min(speeds))
        limit = f"gravity + P + d |qd| is within tau_limit_nm up to {speed:.3g} rad/s"
        return condition._replace(text=f"{condition.text}; {limit}")

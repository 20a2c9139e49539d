"""Adaptive output synchronisation, a control law with a flaw under gravity.

The law makes the outputs r = qd + Lambda q of all arms equal, where q and qd are the joint
positions and velocities, and Lambda is a gain. The dynamic parameters of the arm, such as
masses, are learnt during control.

The flaw: an arm can rest only if its parameter estimate is also constant. This requires Y_G' r
= 0, where Y_G is the matrix whose product with the parameters is the gravity torque, and Y_G'
its transpose. At rest, r equals Lambda q. Under gravity, each arm therefore ends at q = 0, or
hanging, where its links have no lever arm (cos q1 = 0 and cos(q1 + q2) = 0). Users cannot hold
it anywhere else. Laws that compare positions, such as `adaptive`, do not have this flaw,
because their r contains the position error instead of q.

Invariant:
    - The parameter estimate is integrated with the trapezoid rule, as in the law `adaptive`.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law, LawContext, LawInput, compiled, regressor
from ..fields import NotNegativeParameters, Parameters, PositiveJoints
from .conditions import LawSituation, StabilityCondition
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ControlLaw, TuningRun, TuningSite


@compiled
class Sync(ControlLaw):
    """Synchronises the outputs r = qd + Lambda q of all arms, and learns their parameters.

        tau = Y theta_hat + K (sum_j alpha_ij r_j - r)
        rate of theta_hat = -Gamma Y' r

    q and qd are the joint positions and velocities, r_j the output of arm j as received, and
    alpha_ij its dominance factor at arm i. theta_hat is the estimate of the arm's dynamic
    parameters. The matrix Y(q, qd, -Lambda q, -Lambda qd) is the regressor: its product with
    the parameters is the torque of the arm's dynamics. Y' is its transpose.

    Weakness: under gravity, all arms come to rest at q = 0 or hanging down. Only planar arms
    are supported.

    Source: Chopra, Spong and Lozano, "Synchronization of bilateral teleoperators with time
    delay", Automatica 44, 2008; the weakness is described by Nuno, Ortega and Basanez,
    Automatica 46, 2010.

    Attributes:
        Lambda: Weight of the position in r, per joint, 1/s.
        K: Coupling gain of the outputs, per joint, N m s/rad.
        Gamma: Adaptation gain per parameter.
        theta_hat0: Initial estimate of theta, Eq. (24).
    """

    Lambda: PositiveJoints = (1.0,)
    K: PositiveJoints = (3.0,)
    Gamma: NotNegativeParameters = (1.0,)
    theta_hat0: Parameters = (0.0,)

    planar: ClassVar = True
    remembers: ClassVar = ("theta_hat", "Yr")
    tune: ClassVar = {"Lambda": CONVERGENCE, "Kp": DAMPING, "Gamma": ADAPTATION}
    known_facts: ClassVar = "gravity, as its first estimate"

    def begin(self, facts: LawContext) -> None:
        """Prepares the law before a run by creating the parameter estimate.

        The initial estimate of the arm's dynamic parameters is the setting `theta_hat0`. Space
        is also reserved for the product Y' r of the previous tick, which determines the rate of
        the estimate and is required by the trapezoid rule.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        self.theta_hat = list(self.theta_hat0)
        self.Yr = [0.0] * len(self.theta_hat)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Computes the torque and the new parameter estimate in one tick.

        The law is

            r = qd + Lambda q
            tau = K (r_des - r) + Y theta_hat,    r_des = qd_des + Lambda q_des
            rate of theta_hat = -Gamma Y' r

        q and qd are the positions and velocities of the two joints. q_des and qd_des are those
        of the peers, averaged with the dominance factors. K (N m s/rad), Lambda (1/s) and Gamma
        are gains. theta_hat is the estimate of the arm's parameters, and Y is the regressor: Y
        times the parameters is the torque of the arm's dynamics for the reference velocity v =
        -Lambda q and acceleration a = -Lambda qd. Y' is its transpose. Note that r = qd - v.

        The regressor is evaluated once for both the torque and the estimate. The estimate is
        integrated with the trapezoid rule, which multiplies the mean of the old and the new
        rate by the control period.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`, and the estimate into `now.theta_hat`.
        """
        half_h = 0.5 * now.h_s
        Lambda_1 = self.Lambda[0]
        Lambda_2 = self.Lambda[1]
        q = (now.q[0], now.q[1])
        qd = (now.qd[0], now.qd[1])
        v = (-Lambda_1 * q[0], -Lambda_2 * q[1])
        a = (-Lambda_1 * qd[0], -Lambda_2 * qd[1])
        r = (qd[0] - v[0], qd[1] - v[1])
        # K (r_des - r)
        for i in range(2):
            position_part = self.Lambda[i] * now.q_des[i]
            peer_output = now.qd_des[i] + position_part
            disagreement = peer_output - r[i]
            now.tau[i] = self.K[i] * disagreement
        # The two rows of Y, one per joint.
        first, second = regressor(
            g=self.g_m_s2,
            q=q,
            qd=qd,
            v=v,
            a=a,
        )
        for p in range(len(self.Yr)):
            Yr = first[p] * r[0] + second[p] * r[1]  # entry p of Y' r
            # The trapezoid rule needs the entry of the previous tick, so it starts at tick 1.
            if now.k > 0:
                gain_s = half_h * self.Gamma[p]
                Yr_sum = self.Yr[p] + Yr
                self.theta_hat[p] -= gain_s * Yr_sum
            self.Yr[p] = Yr
            # Add Y theta_hat, one parameter after the other.
            estimate = self.theta_hat[p]
            now.theta_hat[p] = estimate
            now.tau[0] += first[p] * estimate
            now.tau[1] += second[p] * estimate

    def linear_gains(self, theta: Array) -> Gains | None:  # noqa: ARG002
        """Returns gains that represent this law as an adaptive law in the linear analysis.

        Both laws use the same formula, but with different outputs: r = qd + Lambda q in this
        law, and r = qd + Lambda e in the adaptive law. q and qd are the position and velocity
        of a joint, e is the position error, and Lambda a gain in 1/s. The flag `absolute`
        selects the first form.

        Args:
            theta: True parameters of the arm, unused because this law learns them.
        """
        return Gains(
            law=Law.ADAPTIVE,
            Lambda=self.Lambda,
            Kp=self.K,
            Gamma=self.Gamma,
            theta_hat0=self.theta_hat0,
            absolute=True,
        )

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether this law is known to be stable in a scenario.

        The stability proof requires constant delays. If a delay varies, the condition is
        undecided (`holds` is None). If all delays are constant, the text also warns that under
        gravity the arms come to rest only at poses with Y_G' r = 0, where r is the output of
        the arm, and the matrix Y_G times the parameters is the gravity torque.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.
        """
        if np.isnan(situation.longest_s):
            text = "proved for constant delays, and a delay here varies"
            return StabilityCondition(None, text)
        text = (
            "r of all sites agree for every constant delay, any Lambda, K and Gamma > 0 "
            "(sufficient, in continuous time); but under gravity the arms end where "
            "Y_G' r = 0, at q = 0 or hanging (cos q1 = 0 and cos(q1 + q2) = 0), wherever users "
            "move them"
        )
        return StabilityCondition(True, text)

    def target_motion(self, run: TuningRun) -> Array | None:
        """Computes the mean motion of the arms, which is the goal of the tuning for this law.

        The law only makes the outputs r = qd + Lambda q of all arms equal. Under gravity, the
        arms do not come to rest at the pose to which the operators pull them, so the gains are
        not tuned for that pose.

        Args:
            run: The motion of all arms in a tuning run.

        Returns:
            The mean over the arms, repeated for each arm, shape (N, K, n), in rad. None if a
            site uses another law.
        """
        if any(law.kind is not Sync for law in run.laws):
            return None
        mean = run.q.mean(axis=0)
        return np.broadcast_to(mean, run.q.shape)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The tuning uses the name `Kp` for the damping gains of all adaptive laws. In the table
        of this law, the gain is called `K`.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {
            "Lambda": gains["Lambda"],
            "K": gains["Kp"],
            "Gamma": gains["Gamma"],
            "theta_hat0": site.estimate,
        }

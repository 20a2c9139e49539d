"""Implements the four-channel law, which exchanges positions and forces in both directions.

Each arm is pulled towards the positions of its peers, and also gets the external torques that
act on their arms. The quantities q_des, qd_des, qdd_des and felt are the peers' position,
velocity, acceleration and external torque. They are weighted by the dominance factors, the
weights with which a site follows its peers. The torque by which an operator or environment acts
ON the site's own arm is tau_h.

Lawrence, who introduced the law for two sites, calls its force gains C2 and C6 at the master,
and C3 and C5 at the slave. A gain of zero removes a channel.

Invariant:
    - The acceleration that a site sends is computed, not measured: it follows from the model of
      the arm and the torques of the tick.
"""

from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.site_setup import Gains, Law
from ..core.user_law import LawContext, LawInput
from ..core.vectors import Array
from ..fields import Joints, NotNegative, NotNegativeJoints, PositiveJoints, Share
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, ControlLaw

_LLEWELLYN = (
    "transparent without delay only; with delay no bound is known that holds for every "
    "operator and environment: Llewellyn's condition decides, see trilat ports"
)

_NEUTRAL = (
    "acceleration = 1 and any delay, one tick included, leave high frequencies undamped (the "
    "neutral part of the loop has radius 1): take less than 1, which is necessary and not "
    "sufficient"
)


@compiled
def send_acceleration(law: Any, now: LawInput) -> None:
    """Sends the acceleration of the arm to the peers.

    It is the solution qdd of M qdd = tau - tau_x - bias, with tau within its limits, where M is
    the inertia matrix, tau_x the exogenous torque and bias the torque of gravity and of
    Coriolis forces. The method is Gaussian elimination.

    Args:
        law: The law, whose `rows` are the work space.
        now: Inputs and outputs of the law in this tick.
    """
    n = now.joints
    rows = law.rows
    qdd = now.to_all.qdd
    width = n + 1
    for i in range(n):
        first = i * width
        for j in range(n):
            rows[first + j] = now.inertia[i][j]
        limit = law.limit[i]
        applied = min(max(now.tau[i], -limit), limit)
        rows[first + n] = applied - now.tau_x[i] - now.bias[i]
    # Gaussian elimination; M is positive definite, so pivoting is not needed.
    for column in range(n):
        pivot_row = column * width
        pivot = rows[pivot_row + column]
        for i in range(column + 1, n):
            first = i * width
            factor = rows[first + column] / pivot
            for j in range(column, width):
                rows[first + j] -= factor * rows[pivot_row + j]
    for i in range(n - 1, -1, -1):
        first = i * width
        remainder = rows[first + n]
        for j in range(i + 1, n):
            remainder -= rows[first + j] * qdd[j]
        qdd[i] = remainder / rows[first + i]


@compiled
class FourChannel(ControlLaw):
    """Positions and forces in both directions, with known gravity.

        tau = G + K (q_des - q) + B (qd_des - qd) + acceleration M qdd_des
              + force_peer felt + force_own tau_h

    Without delay the coupling is ideally transparent if force_peer = 1 + force_own at both
    sites and acceleration = 1.

    Source: Lawrence, IEEE T-RA 9, 1993; local force feedback after Hashtrudi-Zaad and
    Salcudean, IEEE T-RA 18, 2002.

    Attributes:
        K: Stiffness per joint, N m/rad.
        B: Damping of the error, per joint, N m s/rad.
        force_peer: Gain of the peers' torque, C2 or C3, per joint, dimensionless.
        force_own: Gain of the torque on the arm itself, C6 or C5, per joint, dimensionless.
        acceleration: Factor of the peers' acceleration that is fed forward.
        gravity: Factor of the true gravity that the law compensates; 1 is exact.
    """

    K: PositiveJoints = (100.0,)
    B: NotNegativeJoints = (20.0,)
    force_peer: Joints = (1.0,)
    force_own: Joints = (0.0,)
    acceleration: Share = 0.0
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"qdd": {"unit": "rad/s^2", "length": "joints"}}
    tune: ClassVar = {"K": STIFFNESS, "B": DAMPING}
    needs_theta: ClassVar = True

    def begin(self, facts: LawContext) -> None:
        """Creates the work space with which the law solves the arm's equation of motion.

        The law needs it, and the torque limits, to predict the acceleration that it sends.
        """
        self.needs_model = self.acceleration > 0.0
        self.limit = (np.zeros(facts.joints) + facts.tau_limit_nm).tolist()
        # The equations M qdd = torque, row by row: n entries of M and the torque.
        self.rows = [0.0] * (facts.joints * (facts.joints + 1))

    def torque(self, now: LawInput) -> None:
        """Computes the torque of one tick, and sends the acceleration that it causes.

        The equation is that of the class. Nothing is sent if the factor `acceleration` is zero.

        Args:
            now: Inputs and outputs of the law in this tick.
        """
        n = now.joints
        for i in range(n):
            gravity = self.gravity * now.gravity[i]
            spring = self.K[i] * (now.q_des[i] - now.q[i])
            damper = self.B[i] * (now.qd_des[i] - now.qd[i])
            peer_force = self.force_peer[i] * now.felt[i]
            local_force = self.force_own[i] * now.tau_x[i]
            tau = gravity + spring
            tau += damper
            tau += peer_force - local_force
            if self.acceleration > 0.0:
                # acceleration M qdd_des
                for p in range(len(now.peers)):
                    share = self.acceleration * now.peers[p].alpha
                    peer_qdd = now.received[p].qdd
                    for j in range(n):
                        inertia = share * now.inertia[i][j]
                        tau += inertia * peer_qdd[j]
            now.tau[i] = tau
        if self.acceleration > 0.0:
            send_acceleration(self, now)

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the kernel's law of known gravity without the terms in qdd_des and tau_h.

        These terms are described by `linear_form`.

        Args:
            theta: Parameters of the arm, shape (P,).
        """
        known = (theta * self.gravity).tolist()
        return Gains(
            law=Law.KNOWN,
            K=self.K,
            Kd=self.B,
            d=(0.0,),
            k_f=self.force_peer,
            known=known,
        )

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the terms in qdd_des and tau_h for small motions, for the linear analysis.

        These are the acceleration of the peers and the torque on the arm itself, which
        `linear_gains` does not describe.

        Args:
            situation: The site and its arm.

        Returns:
            The linear form. None if both gains are zero.
        """
        if not self.acceleration and not any(self.force_own):
            return None
        form = LinearForm(len(situation.inertia), sends_acceleration=self.acceleration > 0.0)
        form.add("tau", "tau_h", self.force_own)
        for j in situation.peers:
            gain = self.acceleration * situation.alpha[situation.site, j]
            form.add("tau", ("from", j), gain * situation.inertia)
            form.add(("to", j), "q", 0.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns the stability condition of this law, as far as it is known without the arms.

        With acceleration = 1 the condition is not met. In all other cases it is undecided here:
        Llewellyn's condition, which the command `trilat ports` evaluates, decides them.
        """
        if self.acceleration >= 1.0:
            return StabilityCondition(False, _NEUTRAL)
        return StabilityCondition(None, _LLEWELLYN)

"""The four-channel control law: arms exchange positions and forces in both directions.

Each arm is pulled towards the positions of its peers, and feels the torques that operators and
environments exert on them. This lets a user feel what the remote arm touches.

The positions and torques of the peers are averaged, weighted by the dominance factors. The
averages are q_des (position), qd_des (velocity), qdd_des (acceleration) and `felt` (torque).
The external torque on the arm itself, exerted by an operator or environment, is tau_h.

Four gains weight the torques: `force_peer` and `force_own`, each at the master and at the
slave. A gain of zero removes a channel. Lawrence, who introduced the law for two sites, calls
these gains C2 and C6 at the master, and C3 and C5 at the slave.

Invariant:
    - The acceleration that a site sends is not measured. It is computed from the arm model and
      the torques of the current tick.
"""

from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law, LawContext, LawInput, compiled
from ..fields import Joints, NotNegative, NotNegativeJoints, PositiveJoints, Share
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, ControlLaw

_LLEWELLYN = (
    "transparent without delay only; with delay no bound is known that holds for every "
    "operator and environment: Llewellyn's condition decides, see trilat linear"
)

_NEUTRAL = (
    "acceleration = 1 and any delay, one tick included, leave high frequencies undamped (the "
    "neutral part of the loop has radius 1): take less than 1, which is necessary and not "
    "sufficient"
)


@compiled
def _send_acceleration(law: Any, now: LawInput) -> None:
    """Computes the acceleration of the arm from its torques, and sends it to the other arms.

    The acceleration is not measured. It is the solution qdd of M qdd = tau - tau_x - bias,
    computed by Gaussian elimination. M is the inertia matrix, tau the limited torque, tau_x the
    external torque, and bias the torque due to gravity and Coriolis forces.

    Args:
        law: The law, whose `rows` serve as work space.
        now: Inputs and outputs of the law in this tick.
    """
    n = now.joints
    rows = law.rows
    qdd = now.to_all.qdd
    # Row i of the equations: n entries of M, then the torque that accelerates joint i.
    width = n + 1
    for i in range(n):
        first = i * width
        for j in range(n):
            rows[first + j] = now.inertia[i][j]
        limit = law.limit[i]
        bounded_below = max(now.tau[i], -limit)
        applied = min(bounded_below, limit)
        tau_x = now.tau_x[i]
        rows[first + n] = applied - tau_x - now.bias[i]

    # Gaussian elimination; M is positive definite, so pivoting is not needed.
    for column in range(n):
        pivot_row = column * width
        pivot = rows[pivot_row + column]
        for i in range(column + 1, n):
            first = i * width
            factor = rows[first + column] / pivot
            for j in range(column, width):
                pivot_entry = rows[pivot_row + j]
                rows[first + j] -= factor * pivot_entry

    # Substitute back, from the last joint.
    for i in range(n - 1, -1, -1):
        first = i * width
        remainder = rows[first + n]
        for j in range(i + 1, n):
            entry = rows[first + j]
            remainder -= entry * qdd[j]
        qdd[i] = remainder / rows[first + i]


@compiled
class FourChannel(ControlLaw):
    """Couples arms by positions and forces in both directions, with known gravity.

        tau = G + K (q_des - q) + B (qd_des - qd) + acceleration M qdd_des
              + force_peer felt + force_own tau_h

    Without delay, the coupling is ideally transparent if force_peer = 1 + force_own at both
    sites and acceleration = 1.

    Source: Lawrence, IEEE T-RA 9, 1993; local force feedback after Hashtrudi-Zaad and
    Salcudean, IEEE T-RA 18, 2002.

    Attributes:
        K: Stiffness per joint, N m/rad.
        B: Damping of the error, per joint, N m s/rad.
        force_peer: Gain of the peers' torque (Lawrence's C2 or C3), per joint, dimensionless.
        force_own: Gain of the torque on the arm itself (Lawrence's C6 or C5), per joint,
            dimensionless.
        acceleration: Feedforward gain of the peers' acceleration, dimensionless.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
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
        """Prepares the law before a run: stores the torque limits and allocates buffers.

        Both are used to compute the acceleration of the arm from the equation of motion, if the
        law sends this acceleration to the peers.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        self.needs_model = self.acceleration > 0.0
        n = facts.joints
        limits = np.zeros(n) + facts.tau_limit_nm
        self.limit = limits.tolist()
        # The equations M qdd = torque, row by row: n entries of M and the torque.
        self.rows = [0.0] * (n * (n + 1))

    def torque(self, now: LawInput) -> None:
        """Computes the torque of the arm in one tick.

            tau = G + K (q_des - q) + B (qd_des - qd) + acceleration M qdd_des
                  + force_peer felt + force_own tau_h

        The gains are described in `FourChannel` and the other symbols in the module docstring.
        G is the gravity torque and M the inertia matrix. If the gain `acceleration` is not
        zero, the method also sends the peers the acceleration caused by the torque.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`.
        """
        n = now.joints
        for i in range(n):
            gravity = self.gravity * now.gravity[i]
            error = now.q_des[i] - now.q[i]
            error_rate = now.qd_des[i] - now.qd[i]
            spring = self.K[i] * error
            damper = self.B[i] * error_rate
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
            _send_acceleration(self, now)

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the gains of the spring, damper and felt torque for the linear analysis.

        The gains refer to the built-in law tau = G - K e - Kd ed + k_f felt, where G is the
        gravity torque, e the position error, ed its derivative and `felt` the torque on the
        arms of the peers. The values of K, Kd and k_f are the gains `K`, `B` and `force_peer`
        of this law. `linear_form` adds the remaining terms.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque.
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
        """Returns the two terms of the linearised law that `linear_gains` cannot express.

        `linear_gains` covers the gravity torque, the spring, the damper and the torque on the
        peers. The two remaining terms of the torque tau are

            force_own tau_h + acceleration M sum_j alpha_j qdd_j

        tau_h is the external torque on the arm itself, M the inertia matrix of the arm, qdd_j
        the acceleration sent by peer j, and alpha_j its dominance factor. `force_own` and
        `acceleration` are gains.

        The call `form.add(row, column, gain)` adds gain times the column to the row. The row
        "tau" is the torque, the column "tau_h" the torque on the arm, the column ("from", j)
        the vector sent by peer j, and the row ("to", j) the vector sent to peer j.

        Args:
            situation: The site, its arm and its dominance factors.

        Returns:
            Both terms. None if the gains `acceleration` and `force_own` are zero.
        """
        if not self.acceleration and not any(self.force_own):
            return None
        M = situation.inertia
        sends_acceleration = self.acceleration > 0.0
        form = LinearForm(len(M), sends_acceleration=sends_acceleration)
        form.add("tau", "tau_h", self.force_own)
        for j in situation.peers:
            alpha = situation.alpha[situation.site, j]
            gain = self.acceleration * alpha
            form.add("tau", ("from", j), gain * M)
            # This block only names peer j as a receiver. With `sends_acceleration`, the
            # analysis itself inserts the acceleration that is sent.
            form.add(("to", j), "q", 0.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Evaluates the stability of this law, as far as the gains alone determine it.

        If the feedforward gain `acceleration` is 1, high frequencies are undamped, and the
        condition is not satisfied. In all other cases, stability also depends on the arms, and
        the condition is undecided (`holds` is None). The command `trilat linear` then evaluates
        Llewellyn's criterion for absolute stability.
        """
        if self.acceleration >= 1.0:
            return StabilityCondition(False, _NEUTRAL)
        return StabilityCondition(None, _LLEWELLYN)

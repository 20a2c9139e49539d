"""Positions and forces both ways: the four-channel law, and its relatives of fewer channels.

q_des, qd_des, qdd_des and felt are weighted by dominance; tau_h is the torque ON an arm. With
two sites, in Lawrence's symbols, C2 and C6 are gains of the master, C3 and C5 of the slave.

Invariant: the acceleration that is sent is that of the arm's model under the torques of its
tick.
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
    "transparent without delay only; with delay no bound is known that holds for every operator and "
    "environment: Llewellyn's condition decides, see trilat ports"
)

_NEUTRAL = (
    "acceleration = 1 and any delay, one tick included, leave high frequencies undamped (the neutral part of "
    "the loop has radius 1): take less than 1, which is necessary and not sufficient"
)


@compiled
class FourChannel(ControlLaw):
    """Positions and forces both ways, with known gravity.

    tau = G + K (q_des - q) + B (qd_des - qd) + acceleration M qdd_des + force_peer felt +
    force_own tau_h. Ideal transparency without delay: force_peer = 1 + force_own at both sites,
    acceleration = 1. Lawrence, IEEE T-RA 9, 1993; local force feedback: Hashtrudi-Zaad and
    Salcudean, IEEE T-RA 18, 2002.

    Attributes:
        K: stiffness per joint, N m/rad.
        B: damping of the error, per joint, N m s/rad.
        force_peer: gain of the peers' torque, C2 or C3, per joint, dimensionless.
        force_own: gain of the torque on the arm itself, C6 or C5, per joint, dimensionless.
        acceleration: share of the peers' acceleration that is fed forward.
        gravity: share of gravity that it knows, 1: exactly.
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
        """Makes room for the arm's model."""
        self.needs_model = self.acceleration > 0.0
        self.limit = (np.zeros(facts.joints) + facts.tau_limit_nm).tolist()
        # M and the torque that accelerates it
        self.rows = [0.0] * (facts.joints * (facts.joints + 1))

    def torque(self, now: LawInput) -> None:
        """Writes the torque; sends the acceleration that it makes."""
        n = now.joints
        for i in range(n):
            tau = self.gravity * now.gravity[i] + self.K[i] * (now.q_des[i] - now.q[i])
            tau += self.B[i] * (now.qd_des[i] - now.qd[i])
            tau += self.force_peer[i] * now.felt[i] - self.force_own[i] * now.tau_x[i]
            if self.acceleration > 0.0:
                for p in range(len(now.peers)):
                    for j in range(n):
                        share = self.acceleration * now.peers[p].alpha * now.inertia[i][j]
                        tau += share * now.received[p].qdd[j]
            now.tau[i] = tau
        if self.acceleration == 0.0:
            return
        rows = self.rows
        width = n + 1
        for i in range(n):
            for j in range(n):
                rows[i * width + j] = now.inertia[i][j]
            held = min(max(now.tau[i], -self.limit[i]), self.limit[i])
            rows[i * width + n] = held - now.tau_x[i] - now.bias[i]
        for c in range(n):  # elimination; M is positive definite and needs no pivots
            for i in range(c + 1, n):
                share = rows[i * width + c] / rows[c * width + c]
                for j in range(c, width):
                    rows[i * width + j] -= share * rows[c * width + j]
        for i in range(n - 1, -1, -1):
            rest = rows[i * width + n]
            for j in range(i + 1, n):
                rest -= rows[i * width + j] * now.to_all.qdd[j]
            now.to_all.qdd[i] = rest / rows[i * width + i]

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the same law as one of known gravity, which has neither qdd nor the arm's own
        torque.
        """
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, Kd=self.B, d=(0.0,), k_f=self.force_peer, known=known)

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns what acceleration and the arm's own torque add."""
        if not self.acceleration and not any(self.force_own):
            return None
        form = LinearForm(len(at.inertia), sends_acceleration=self.acceleration > 0.0)
        form.add("tau", "tau_h", self.force_own)
        for j in at.peers:
            form.add("tau", ("from", j), self.acceleration * at.alpha[at.site, j] * at.inertia)
            form.add(("to", j), "q", 0.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns that acceleration = 1 is unstable with any delay; else Llewellyn's condition
        decides.
        """
        if self.acceleration >= 1.0:
            return StabilityCondition(False, _NEUTRAL)
        return StabilityCondition(None, _LLEWELLYN)

"""Impedance control of several users and a slave: each arm is made a mass, a damper and a spring.

    M (qdd - 0) + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j(t - T)
    tau = M(q) qdd + C qd + G - tau_h                                                (inner loop)

A master's reference is its start pose at rest; the slave's is the pose of the masters, weighted by its
dominance factors alpha_j, and it sends alpha_j tau_h to master j: the force of its environment in the shares
in which the masters lead it. Masters send nothing.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

from ..compiled_law import compiled
from ..user_law import LawContext, LawInput


@compiled
class ImpedanceControl:
    """The law of a site; M, B and K are those of the impedance, per joint.

    Args:
        facts: what is known of the site.
        M, B, K: inertia, damping and stiffness.
        follows: true: it follows its peers and sends them its torque; false: it stays at its start pose.
    """

    sends: ClassVar[dict[str, Any]] = {"force": {"unit": "N m", "length": "joints", "per_peer": True}}
    remembers: ClassVar[tuple[str, ...]] = ("start",)
    needs_theta = True
    needs_model = True

    def __init__(
        self, facts: LawContext, M: Sequence[float], B: Sequence[float], K: Sequence[float], follows: bool
    ) -> None:
        self.M, self.B, self.K, self.follows = M, B, K, 1.0 if follows else 0.0
        self.start = [0.0] * facts.joints
        self.qdd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque; sends the torque on the arm, if it follows."""
        for i in range(now.joints):
            if now.k == 0:
                self.start[i] = now.q[i]
            q_ref = self.start[i] + self.follows * (now.q_des[i] - self.start[i])
            force = 0.0 - now.tau_x[i]
            for j in range(len(now.peers)):
                force += now.received[j].force[i]
                now.sent[j].force[i] = (0.0 - now.tau_x[i]) * self.follows * now.peers[j].alpha
            force -= self.B[i] * (now.qd[i] - self.follows * now.qd_des[i]) + self.K[i] * (now.q[i] - q_ref)
            self.qdd[i] = force / self.M[i]
        for i in range(now.joints):
            tau = now.bias[i] + now.tau_x[i]
            for j in range(now.joints):
                tau += now.inertia[i][j] * self.qdd[j]
            now.tau[i] = tau

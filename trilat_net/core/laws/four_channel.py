"""Positions and forces both ways: the four-channel law, its relatives of fewer channels, the six-channel law.

    tau_i = G + K (q_des - q_i) + B (qd_des - qd_i) + c_a M(q_i) qdd_des + c_p felt + c_o tau_h,i

q_des, qd_des, qdd_des and felt are weighted by dominance; tau_h is the torque ON an arm. With two sites, in
Lawrence's symbols, c_p is C2 of the master and C3 of the slave, c_o is C6 and C5.

Invariant: the acceleration that is sent is that of the arm's model under the torques of its tick.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

from ..compiled_law import compiled
from ..user_law import LawContext, LawInput


@compiled
class FourChannel:
    """The law of a site, of any number of sites.

    Args:
        facts: what is known of the site.
        K, B: stiffness and damping of the error, per joint.
        force_peer, force_own: c_p and c_o, per joint.
        acceleration: c_a, from 0 to 1.
        gravity: share of gravity that it knows.
    """

    sends: ClassVar[dict[str, Any]] = {"qdd": {"unit": "rad/s^2", "length": "joints"}}
    remembers: ClassVar[tuple[str, ...]] = ()
    needs_theta = True

    def __init__(
        self,
        facts: LawContext,
        K: Sequence[float],
        B: Sequence[float],
        force_peer: Sequence[float],
        force_own: Sequence[float],
        acceleration: float,
        gravity: float,
    ) -> None:
        n = facts.joints
        self.K, self.B, self.force_peer, self.force_own = K, B, force_peer, force_own
        self.acceleration, self.gravity = acceleration, gravity
        self.needs_model = acceleration > 0.0
        self.limit = spread_limit(facts)
        self.rows = [0.0] * (n * (n + 1))  # M and the torque that accelerates it, a row per joint

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
        rows, width = self.rows, n + 1
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


class SixChannel(FourChannel):
    """The same of two users and a slave, whose dominance is one factor."""

    sites = 3


def spread_limit(facts: LawContext) -> list[float]:
    """Returns the largest torque of each joint, N m."""
    limit = facts.tau_limit_nm
    return [float(limit)] * facts.joints if isinstance(limit, float | int) else list(limit)

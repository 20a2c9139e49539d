"""P+d whose coupling torque saturates, towards each peer by itself.

    tau_i = G - sum_j alpha_ij P tanh(K (q_i - q_j(t - T)) / P) - d qd_i

Invariant: no peer pulls with more than alpha_ij P, whatever it does.
"""

from collections.abc import Sequence
from typing import ClassVar

from ..compiled_law import compiled
from ..hyperbolic import tanh
from ..user_law import LawContext, LawInput


@compiled
class SaturatedPd:
    """The law of a site; its gains are as in the equation, per joint."""

    remembers: ClassVar[tuple[str, ...]] = ()
    needs_theta = True

    def __init__(
        self,
        facts: LawContext,  # noqa: ARG002 - as the other laws
        K: Sequence[float],
        P: Sequence[float],
        d: Sequence[float],
        gravity: float,
    ) -> None:
        self.K, self.P, self.d, self.gravity = K, P, d, gravity

    def torque(self, now: LawInput) -> None:
        """Writes the torque."""
        for i in range(now.joints):
            tau = self.gravity * now.gravity[i] - self.d[i] * now.qd[i]
            for j in range(len(now.peers)):
                peer = now.peers[j]
                tau -= peer.alpha * self.P[i] * tanh(self.K[i] * (now.q[i] - peer.q[i]) / self.P[i])
            now.tau[i] = tau

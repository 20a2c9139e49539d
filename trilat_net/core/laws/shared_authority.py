"""Shared authority of two users over a slave, without force from the environment.

    slave    tau = G + K (sum_j alpha_j q_j - q) - d qd
    user i   tau = G + K alpha_ij (q_j - q_i) - d qd_i,    j: the other user

A user with the share a has alpha_ij = 1 - a: who leads less is guided more. What a user hears of the slave is
left out.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

from ..compiled_law import compiled
from ..user_law import LawContext, LawInput


@compiled
class SharedAuthority:
    """The law of a site; `leads` is true of a user."""

    sends: ClassVar[dict[str, Any]] = {"leads": {"unit": "", "length": 1}}
    remembers: ClassVar[tuple[str, ...]] = ()
    needs_theta = True

    def __init__(
        self,
        facts: LawContext,  # noqa: ARG002 - as the other laws
        K: Sequence[float],
        d: Sequence[float],
        leads: bool,
        gravity: float,
    ) -> None:
        self.K, self.d, self.gravity = K, d, gravity
        self.leads = 1.0 if leads else 0.0

    def torque(self, now: LawInput) -> None:
        """Writes the torque; tells its peers if it leads."""
        now.to_all.leads[0] = self.leads
        for i in range(now.joints):
            tau = self.gravity * now.gravity[i] - self.d[i] * now.qd[i]
            for j in range(len(now.peers)):
                share = now.peers[j].alpha * now.received[j].leads[0]
                tau += self.K[i] * share * (now.peers[j].q[i] - now.q[i])
            now.tau[i] = tau

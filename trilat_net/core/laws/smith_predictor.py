"""P+d of a master and a slave with a Smith predictor at the master.

    slave    tau = G - K (q_s - q_m(t - T)) - d qd_s,  sends w = q_s - x,  x: the model under q_m(t - T)
    master   tau = G - K (q_m - x - w(t - T)) - d qd_m,  x: the model under q_m now
    model    inertia x'' = K (q_m - x) - d x'

Both ends run the same model, so that nothing of the past is kept, however long a delay is: w is what the
model misses, as of contact. A master is told apart by what it leads.

Invariant: the model moves as an arm does whose torque is held over a tick (`digital`).
"""

from collections.abc import Sequence
from typing import Any, ClassVar

from ..compiled_law import compiled
from ..user_law import LawContext, LawInput


@compiled
class SmithPredictor:
    """The law of a site, per joint; `predicts` is true of the master."""

    sends: ClassVar[dict[str, Any]] = {"w": {"unit": "rad", "length": "joints"}}
    remembers: ClassVar[tuple[str, ...]] = ("x", "xd")
    sites = 2
    needs_theta = True

    def __init__(
        self,
        facts: LawContext,
        K: Sequence[float],
        d: Sequence[float],
        inertia: Sequence[float],
        predicts: bool,
        gravity: float,
    ) -> None:
        self.K, self.d, self.inertia, self.gravity = K, d, inertia, gravity
        self.predicts = predicts
        self.x = [0.0] * facts.joints
        self.xd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque, sends what the model misses, and moves the model on by a tick."""
        h_s = now.h_s
        for i in range(now.joints):
            if now.k == 0:
                self.x[i] = now.peers[0].q[i] if self.predicts else now.q[i]
            goal = self.x[i] + now.received[0].w[i] if self.predicts else now.peers[0].q[i]
            now.tau[i] = self.gravity * now.gravity[i] - self.K[i] * (now.q[i] - goal) - self.d[i] * now.qd[i]
            now.to_all.w[i] = 0.0 if self.predicts else now.q[i] - self.x[i]
            leads = now.q[i] if self.predicts else goal
            pull = self.K[i] * (leads - self.x[i]) - self.d[i] * self.xd[i]
            acceleration = pull / self.inertia[i]
            self.x[i] += h_s * self.xd[i] + 0.5 * h_s * h_s * acceleration
            self.xd[i] += h_s * acceleration

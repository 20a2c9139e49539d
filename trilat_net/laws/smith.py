"""P+d of a master and a slave with a Smith predictor at the master.

    slave    tau = G - K (q_s - q_m(t - T)) - d qd_s,  sends w = q_s - x,  x: the model under
    q_m(t - T) master   tau = G - K (q_m - x - w(t - T)) - d qd_m,  x: the model under q_m now
    model    inertia x'' = K (q_m - x) - d x'

Both ends run the same model, so that nothing of the past is kept, however long a delay is: w is
what the model misses, as of contact. A master is told apart by what it leads.

Invariant: the model moves as an arm does whose torque is held over a tick (`digital`).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.site_setup import Gains, Law
from ..core.user_law import LawContext, LawInput
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, INERTIA, STIFFNESS, ControlLaw, TuningSite


@compiled
class Smith(ControlLaw):
    """P+d of a master and a slave with a Smith predictor of the slave at the master.

    Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53, 1957
    (from memory).

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        inertia: of the model of the slave, per joint, kg m^2; K, d and inertia are alike at
            both sites.
        predicts: true of the master.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0,)
    d: NotNegativeJoints = (3.0,)
    inertia: PositiveJoints = (1.0,)
    predicts: bool = False
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"w": {"unit": "rad", "length": "joints"}}
    remembers: ClassVar = ("x", "xd")
    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING, "inertia": INERTIA}
    sites: ClassVar = 2
    needs_theta: ClassVar = True

    def begin(self, facts: LawContext) -> None:
        """Makes the model."""
        self.x = [0.0] * facts.joints
        self.xd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque, sends what the model misses, and moves the model on by a tick."""
        h_s = now.h_s
        for i in range(now.joints):
            if now.k == 0:
                self.x[i] = now.peers[0].q[i] if self.predicts else now.q[i]
            goal = self.x[i] + now.received[0].w[i] if self.predicts else now.peers[0].q[i]
            now.tau[i] = (
                self.gravity * now.gravity[i]
                - self.K[i] * (now.q[i] - goal)
                - self.d[i] * now.qd[i]
            )
            now.to_all.w[i] = 0.0 if self.predicts else now.q[i] - self.x[i]
            leads = now.q[i] if self.predicts else goal
            pull = self.K[i] * (leads - self.x[i]) - self.d[i] * self.xd[i]
            acceleration = pull / self.inertia[i]
            self.x[i] += h_s * self.xd[i] + 0.5 * h_s * h_s * acceleration
            self.xd[i] += h_s * acceleration

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its damping and its gravity; of the slave, which is P+d, its stiffness too."""
        K = (0.0,) if self.predicts else self.K
        return Gains(Law.KNOWN, K=K, d=self.d, known=(theta * self.gravity).tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the model, which the master has under its own pose and the slave under what
        came.
        """
        (peer,) = at.peers
        K = np.array(self.K)
        m = np.array(self.inertia)
        form = LinearForm(len(at.inertia), ("x", "xd"))
        form.add("x", "xd", 1.0)
        form.add("xd", "x", -K / m)
        form.add("xd", "xd", -np.array(self.d) / m)
        form.add("xd", "q" if self.predicts else "q_des", K / m)
        if self.predicts:
            form.add("tau", "q", -K)
            form.add("tau", "x", K)
            form.add("tau", ("from", peer), K)
        else:
            form.add(("to", peer), "q", 1.0)
            form.add(("to", peer), "x", -1.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that the model decides: with the true one the loop is that without delay."""
        laws = situation.laws
        if [getattr(law, "predicts", None) for law in laws].count(True) != 1:
            return StabilityCondition(False, "one of the two sites has predicts = true")
        if any(
            getattr(law, key, None) != getattr(self, key)
            for law in laws
            for key in ("K", "d", "inertia")
        ):
            return StabilityCondition(False, "K, d and inertia must be alike at both sites")
        text = "a slave in free motion whose inertia is the model's makes the loop one without delay (d > 0)"
        return StabilityCondition(
            None, f"{text}; contact, and an inertia that changes, the model does not have"
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """The master predicts."""
        return {**gains, "predicts": at.role == "master", "gravity": at.gravity}

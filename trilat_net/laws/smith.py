"""P+d of a master and a slave with a Smith predictor at the master.

    slave    tau = G - K (q_s - q_m(t - T)) - d qd_s
             sends w = q_s - x, where the model x is driven by q_m(t - T)
    master   tau = G - K (q_m - x - w(t - T)) - d qd_m, where the model x is driven by q_m
    model    inertia x'' = K (q_m - x) - d x'

Both ends run the same model. Therefore the law stores no past values, however long the delay
is; w is the part of the slave's motion that the model misses, for example in contact. The
setting `predicts` distinguishes the master.

Invariant:
    - The model moves like an arm whose torque is held over a tick (`digital`).
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
    (cited from memory).

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        inertia: inertia of the slave's model, per joint, kg m^2. K, d and inertia are the same
            at both sites.
        predicts: true for the master.
        gravity: share of the true gravity that the law compensates; 1 is exact.
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
        """Creates the model's position x and velocity xd."""
        self.x = [0.0] * facts.joints
        self.xd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque, sends w, and advances the model by a tick."""
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
            master_q = now.q[i] if self.predicts else goal
            model_torque = self.K[i] * (master_q - self.x[i]) - self.d[i] * self.xd[i]
            acceleration = model_torque / self.inertia[i]
            self.x[i] += h_s * self.xd[i] + 0.5 * h_s * h_s * acceleration
            self.xd[i] += h_s * acceleration

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the law of known gravity with d, and at the slave also with K."""
        K = (0.0,) if self.predicts else self.K
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=K, d=self.d, known=known)

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the model, driven by the master's own pose or by the pose that it sent."""
        (peer,) = at.peers
        K = np.array(self.K)
        inertia = np.array(self.inertia)
        form = LinearForm(len(at.inertia), ("x", "xd"))
        form.add("x", "xd", 1.0)
        form.add("xd", "x", -K / inertia)
        form.add("xd", "xd", -np.array(self.d) / inertia)
        form.add("xd", "q" if self.predicts else "q_des", K / inertia)
        if self.predicts:
            form.add("tau", "q", -K)
            form.add("tau", "x", K)
            form.add("tau", ("from", peer), K)
        else:
            form.add(("to", peer), "q", 1.0)
            form.add(("to", peer), "x", -1.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that an exact model makes the loop one without delay."""
        laws = situation.laws
        if [getattr(law, "predicts", None) for law in laws].count(True) != 1:
            return StabilityCondition(False, "one of the two sites has predicts = true")
        for law in laws:
            for key in ("K", "d", "inertia"):
                if getattr(law, key, None) != getattr(self, key):
                    text = "K, d and inertia must be alike at both sites"
                    return StabilityCondition(False, text)
        text = (
            "a slave in free motion whose inertia is the model's makes the loop one without "
            "delay (d > 0); contact, and an inertia that changes, the model does not have"
        )
        return StabilityCondition(None, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site for tuned gains; the master predicts."""
        return {**gains, "predicts": at.role == "master", "gravity": at.gravity}

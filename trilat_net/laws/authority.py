"""Shared authority of two users over a slave, without force from the environment.

    slave    tau = G + K (sum_j alpha_j q_j - q) - d qd
    user i   tau = G + K alpha_ij (q_j - q_i) - d qd_i,    j: the other user

A user with the share a has alpha_ij = 1 - a: who leads less is guided more. What a user hears
of the slave is left out.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.site_setup import Gains, Law
from ..core.user_law import LawInput
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import (
    LawSituation,
    LinearForm,
    LinearSituation,
    StabilityCondition,
    judge_position_exchange,
)
from .interface import DAMPING, STIFFNESS, ControlLaw, TuningSite


@compiled
class Authority(ControlLaw):
    """Two users share the authority over a slave, and feel each other but not the environment.

    After Nudehi, Mukherjee and Ghodoussi, "A shared-control approach to haptic interface design
    for minimally invasive telesurgical training", IEEE T-CST, 2005.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        leads: true of a user, false of the slave.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0,)
    d: NotNegativeJoints = (3.0,)
    leads: bool = True
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"leads": {"unit": "", "length": 1}}
    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING}
    needs_theta: ClassVar = True

    def torque(self, now: LawInput) -> None:
        """Writes the torque; tells its peers if it leads."""
        now.to_all.leads[0] = 1.0 if self.leads else 0.0
        for i in range(now.joints):
            tau = self.gravity * now.gravity[i] - self.d[i] * now.qd[i]
            for j in range(len(now.peers)):
                share = now.peers[j].alpha * now.received[j].leads[0]
                tau += self.K[i] * share * (now.peers[j].q[i] - now.q[i])
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its damping and its gravity."""
        return Gains(Law.KNOWN, d=self.d, known=(theta * self.gravity).tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the springs to the users."""
        form = LinearForm(len(at.inertia))
        for j in at.peers:
            share = (
                at.alpha[at.site, j]
                * float(getattr(at.laws[j], "leads", False))
                * np.array(self.K)
            )
            form.add("tau", "q", -share)
            form.add("tau", ("from", j), share)
            form.add(("to", j), "q", 1.0)
        return form

    def explain_idle_shares(self, at: LawSituation) -> str:
        """Returns whom a user does not feel: those who do not lead."""
        idle = [
            name
            for name, law in zip(at.names, at.laws, strict=True)
            if not getattr(law, "leads", False)
        ]
        return (
            f"users feel those who lead alone, not {', '.join(idle)}"
            if self.leads and idle
            else ""
        )

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d among the users; the slave follows them and closes no
        loop.
        """
        users = [n for n, law in enumerate(situation.laws) if getattr(law, "leads", False)]
        if situation.site not in users:
            return StabilityCondition(
                True, "it follows and closes no loop: stable for every delay and d > 0"
            )
        among = situation.restrict(users)
        return judge_position_exchange(among, "K", "d")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Users lead."""
        return {**gains, "leads": at.role == "master", "gravity": at.gravity}

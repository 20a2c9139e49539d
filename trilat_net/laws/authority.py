"""Shares the authority over one slave arm between two users.

A user is a person at a master arm, and the slave is the arm that follows both. Each user feels
the other user, but not the force of the environment on the slave:

    slave    tau = G + K (sum_j alpha_j q_j - q) - d qd
    user i   tau = G + K alpha_ij (q_j - q_i) - d qd_i,    j: the other user

where tau is the torque of an arm, G its gravity torque, q its position, K a stiffness, d a
damping, and alpha_j are the dominance factors, the weights with which an arm follows the
others. A user i with the share a of the authority has alpha_ij = 1 - a, so the user with less
authority is guided more. A user's torque does not depend on the slave.
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
    """Two users share the authority over a slave and feel each other, not the environment.

    Source: Nudehi, Mukherjee and Ghodoussi, "A shared-control approach to haptic interface
    design for minimally invasive telesurgical training", IEEE T-CST, 2005.

    Attributes:
        K: Stiffness per joint, N m/rad.
        d: Damping of the arm's velocity, per joint, N m s/rad.
        leads: True for a user, false for the slave.
        gravity: Factor of the true gravity that the law compensates; 1 is exact.
    """

    K: PositiveJoints = (10.0,)
    d: NotNegativeJoints = (3.0,)
    leads: bool = True
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"leads": {"unit": "", "length": 1}}
    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING}
    needs_theta: ClassVar = True

    def torque(self, now: LawInput) -> None:
        """Computes the torque of one tick, and tells the peers whether this site leads.

        The springs pull the arm only towards the sites that lead. The torque is written into
        `now.tau`.

        Args:
            now: Inputs and outputs of the law in this tick.
        """
        now.to_all.leads[0] = 1.0 if self.leads else 0.0
        for i in range(now.joints):
            K = self.K[i]
            q = now.q[i]
            damper = self.d[i] * now.qd[i]
            tau = self.gravity * now.gravity[i] - damper
            for j in range(len(now.peers)):
                peer = now.peers[j]
                share = peer.alpha * now.received[j].leads[0]
                tau += K * share * (peer.q[i] - q)
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns gains of the kernel's law of known gravity that describe the damping alone.

        The kernel's law is the built-in law tau = G(q) - K e - d qd - Kd ed + k_f felt. The
        springs of this law are described by `linear_form`.

        Args:
            theta: Parameters of the arm, shape (P,).
        """
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, d=self.d, known=known)

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the springs towards the users for small motions, for the linear analysis.

        Args:
            situation: The site, its peers and their laws.
        """
        form = LinearForm(len(situation.inertia))
        for j in situation.peers:
            leads = float(getattr(situation.laws[j], "leads", False))
            share = situation.alpha[situation.site, j] * leads
            stiffness = share * np.array(self.K)
            form.add("tau", "q", -stiffness)
            form.add("tau", ("from", j), stiffness)
            form.add(("to", j), "q", 1.0)
        return form

    def explain_idle_shares(self, situation: LawSituation) -> str:
        """Explains to the user which dominance factors of a site have no effect.

        A user does not feel the sites that do not lead, whatever dominance factor (the weight
        with which the site follows a peer) the scenario gives them.

        Args:
            situation: The site, and the laws of all sites.

        Returns:
            A sentence. Empty for the slave, and if all sites lead.
        """
        idle = []
        for name, law in zip(situation.names, situation.laws, strict=True):
            if not getattr(law, "leads", False):
                idle.append(name)
        if not self.leads or not idle:
            return ""
        return f"users feel only sites that lead, not {', '.join(idle)}"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the stability condition of this law at a site of a scenario.

        For a user it is the condition of P+d, a spring with damping, among the users. The slave
        follows the users but influences nobody. It closes no loop, so that it is stable for
        every delay.

        Args:
            situation: The site, its peers and the delays between them.
        """
        users = [n for n, law in enumerate(situation.laws) if getattr(law, "leads", False)]
        if situation.site not in users:
            text = "it follows and closes no loop: stable for every delay and d > 0"
            return StabilityCondition(True, text)
        return judge_position_exchange(situation.restrict(users), "K", "d")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site for tuned gains; master sites lead.

        Args:
            gains: The tuned gains by name.
            site: The site whose table is written.
        """
        return {**gains, "leads": site.role == "master", "gravity": site.gravity}

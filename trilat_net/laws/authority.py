"""Control law that divides the authority over one slave arm between two users.

A user is a person at a master arm, and the slave follows both masters. Each user feels the
other user, but not the force that the environment exerts on the slave:

    slave    tau = G + K (sum_j alpha_j q_j - q) - d qd
    user i   tau = G + K alpha_ij (q_j - q_i) - d qd_i,    j: the other user

where tau is the torque of an arm, G its gravity torque, q its position, K a stiffness, d a
damping coefficient, and alpha_j are the dominance factors. A user i whose share of the
authority is a has alpha_ij = 1 - a, so the user with less authority is guided more strongly. A
user's torque does not depend on the slave.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law, LawInput, compiled
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, ControlLaw, TuningSite


@compiled
class Authority(ControlLaw):
    """Control law with which two users at master arms share the authority over one slave arm.

    A spring couples each arm to the arms of the users, and a damper brakes the arm. Each user
    feels the motion of the other user, but not the force that the environment exerts on the
    slave.

    Source: Nudehi, Mukherjee and Ghodoussi, "A shared-control approach to haptic interface
    design for minimally invasive telesurgical training", IEEE T-CST, 2005.

    Attributes:
        K: Stiffness per joint, N m/rad.
        d: Damping of the arm's motion, per joint, N m s/rad.
        leads: True if the other arms follow this arm: true for the arms of the users, false for
            the slave.
        gravity: Ratio of the compensated to the true gravity torque. 1 is exact.
    """

    K: PositiveJoints = (10.0,)
    d: NotNegativeJoints = (3.0,)
    leads: bool = True
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"leads": {"unit": "", "length": 1}}
    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING}
    needs_theta: ClassVar = True

    def torque(self, now: LawInput) -> None:
        """Computes the torque of the arm in one tick.

        Springs pull the arm towards the arms of the users. Each site sends the flag `leads`,
        which is 1 for the arm of a user and 0 for the slave. The springs pull only towards arms
        whose flag is 1.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`.
        """
        now.to_all.leads[0] = 1.0 if self.leads else 0.0
        for i in range(now.joints):
            K = self.K[i]
            q = now.q[i]
            gravity = self.gravity * now.gravity[i]
            damper = self.d[i] * now.qd[i]
            tau = gravity - damper
            for j in range(len(now.peers)):
                peer = now.peers[j]
                leads = now.received[j].leads[0]
                share = peer.alpha * leads
                distance = peer.q[i] - q
                tau += K * share * distance
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the damping and gravity compensation of this law for the linear analysis.

        The complete torque of this law is

            tau = G - d qd + K sum_j alpha_j leads_j (q_j - q)

        The gains describe the first two terms as a special case of the built-in law
        `Law.KNOWN`: G is the gravity compensation, d the damping in N m s/rad and qd the joint
        velocity. The springs in the sum are not a special case of that law, and are added by
        `linear_form`.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque
        # by `gravity`, the ratio of the compensated gravity torque to the true one.
        compensated_parameters = theta * self.gravity
        return Gains(Law.KNOWN, d=self.d, known=compensated_parameters.tolist())

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the springs of this law as matrix blocks for the linear analysis.

        Each spring pulls the arm towards the arm of a user:

            tau = K sum_j alpha_j leads_j (q_j - q)

        tau is the torque, q the position of the arm, q_j the position sent by peer j, and
        alpha_j its dominance factor. leads_j is 1 if peer j is a user and 0 otherwise.

        The call `form.add(row, column, gain)` adds gain times the column to the row. The row
        "tau" is the torque, the column "q" the position, the column ("from", j) the vector sent
        by peer j, and the row ("to", j) the vector sent to peer j.

        Args:
            situation: This arm, its peers and their laws.
        """
        joints = len(situation.inertia)
        form = LinearForm(joints)
        K = np.array(self.K)
        for j in situation.peers:
            # An arm with another law has no flag `leads` and is not followed.
            peer_leads = getattr(situation.laws[j], "leads", False)
            alpha = situation.alpha[situation.site, j]  # weight with which this arm follows j
            share = alpha * float(peer_leads)
            stiffness = share * K
            form.add("tau", "q", -stiffness)
            form.add("tau", ("from", j), stiffness)
            form.add(("to", j), "q", 1.0)  # every arm sends its position
        return form

    def explain_idle_shares(self, situation: LawSituation) -> str:
        """Explains why a master ignores the dominance factor that it gives to the slave.

        Under this law, the masters (the arms of the two users) follow only each other. The
        weight that the scenario assigns to the slave at a master is therefore not used.

        Args:
            situation: This arm, and the laws of all arms.

        Returns:
            A sentence for display. Empty if this arm is the slave, or if there is no slave.
        """
        idle = []
        for name, law in zip(situation.names, situation.laws, strict=True):
            if not getattr(law, "leads", False):
                idle.append(name)
        if not self.leads or not idle:
            return ""
        return f"users feel only sites that lead, not {', '.join(idle)}"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the coupling of this arm is stable with the scenario's delays.

        The arms of the two users are coupled by springs and braked by dampers. A stability
        condition is known for such a loop. No arm follows the slave, so the slave closes no
        loop and is stable for any delay.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The condition. None if gravity compensation is not exact, because no condition is
            known for that case.
        """
        users = []
        for n, law in enumerate(situation.laws):
            if getattr(law, "leads", False):
                users.append(n)
        if situation.site not in users:
            if self.gravity != 1.0:
                return None
            text = (
                "it follows and closes no loop: stable in continuous time for every delay and "
                "d > 0"
            )
            return StabilityCondition(True, text)
        loop_of_users = situation.restrict(users)
        return loop_of_users.judge_position_exchange("d")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        `leads` is true for the masters (the arms of the two users), which the other arms
        follow, and false for the slave.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "leads": site.role == "master", "gravity": site.gravity}

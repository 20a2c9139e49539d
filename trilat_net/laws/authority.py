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

from ..core import Array, Gains, Law, LawInput, compiled
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import (
    LawSituation,
    LinearForm,
    LinearSituation,
    StabilityCondition,
)
from .interface import DAMPING, STIFFNESS, ControlLaw, TuningSite


@compiled
class Authority(ControlLaw):
    """Lets two users at master arms share the authority over one slave arm.

    Each user feels the motion of the other user, but not the force of the environment on the
    slave. A spring couples each arm to the arms of the users, and a damper brakes it.

    Source: Nudehi, Mukherjee and Ghodoussi, "A shared-control approach to haptic interface
    design for minimally invasive telesurgical training", IEEE T-CST, 2005.

    Attributes:
        K: Stiffness per joint, N m/rad.
        d: Damping of the arm's velocity, per joint, N m s/rad.
        leads: True if the other arms follow this arm: for a user, but not for the slave.
        gravity: Ratio of the compensated gravity torque to the true gravity torque. 1 is exact.
    """

    K: PositiveJoints = (10.0,)
    d: NotNegativeJoints = (3.0,)
    leads: bool = True
    gravity: NotNegative = 1.0

    sends: ClassVar[dict[str, Any]] = {"leads": {"unit": "", "length": 1}}
    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING}
    needs_theta: ClassVar = True

    def torque(self, now: LawInput) -> None:
        """Computes the torque of the arm in one period of the control loop.

        Springs pull the arm towards the arms of the users. Each site, the process that runs one
        arm, sends the flag `leads`, which is 1 for a user and 0 for the slave. A spring acts
        only towards sites whose flag is 1.

        Args:
            now: Inputs and outputs of the law in this period. The torque is written into
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

        The gains describe the first two terms, which have the form of a law that the analysis
        knows (`Law.KNOWN`): G is the compensating gravity torque, d the damping in N m s/rad
        and qd the joint velocity. The springs in the sum are not of that form. Therefore they
        are left out here, and `linear_form` adds them.

        Args:
            theta: Parameters of the arm's dynamics, such as masses, shape (P,), where P is
                their number.
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque
        # by `gravity`, the ratio of the compensated gravity torque to the true one.
        compensated_parameters = theta * self.gravity
        return Gains(Law.KNOWN, d=self.d, known=compensated_parameters.tolist())

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the springs of this law as blocks of the linear analysis.

        The linear analysis considers small motions around a pose at rest. Each spring pulls the
        arm towards the arm of a user:

            tau = K sum_j alpha_j leads_j (q_j - q)

        tau is the torque, q the position of the arm, q_j the position that peer j sends, and
        alpha_j the weight with which this arm follows peer j. leads_j is 1 if peer j is a user
        and 0 otherwise.

        A block `form.add(row, column, gain)` says that the row contains gain times the column.
        The row "tau" is the torque, the column "q" the position, the column ("from", j) the
        vector that peer j sends, and the row ("to", j) the vector that is sent to peer j.

        Args:
            situation: This arm, its peers (the other arms) and their laws.
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
        """Explains to the user which dominance factors of a user's arm have no effect.

        A dominance factor is the weight with which an arm follows another arm. With this law,
        the arms of the users follow only each other. The weight that a scenario gives to the
        slave is not used.

        Args:
            situation: This arm, and the laws of all arms.

        Returns:
            A sentence for the user. Empty if the site is the slave, or if all sites are users.
        """
        idle = []
        for name, law in zip(situation.names, situation.laws, strict=True):
            if not getattr(law, "leads", False):
                idle.append(name)
        if not self.leads or not idle:
            return ""
        return f"users feel only sites that lead, not {', '.join(idle)}"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates for which gains and delays this law is stable at one arm of a scenario.

        For the arm of a user, the loop is a spring with a damper between the two users, whose
        known condition is used. The slave follows the users, but no arm follows the slave. It
        closes no loop and is stable for every delay.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The condition. None if the law does not compensate gravity exactly, because then no
            condition is known.
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
        """Returns the settings of this law for one arm, after its gains were tuned.

        The settings form the table [control] of a scenario, the description of an experiment. A
        site is the process that runs one arm. At the masters, which are the arms of the two
        users, `leads` is set to true, so that the other arms follow them. At the slave it is
        false.

        Args:
            gains: Tuned gains by name.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "leads": site.role == "master", "gravity": site.gravity}

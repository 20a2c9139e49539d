"""Impedance control of several users and a slave: each arm is made a mass, a damper and a
spring.

    M (qdd - 0) + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j(t - T) tau = M(q) qdd + C
    qd + G - tau_h                                                (inner loop)

A master's reference is its start pose at rest; the slave's is the pose of the masters, weighted
by its dominance factors alpha_j, and it sends alpha_j tau_h to master j: the force of its
environment in the shares in which the masters lead it. Masters send nothing.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.site_setup import Gains, Law
from ..core.user_law import LawContext, LawInput
from ..core.vectors import Array
from ..fields import NotNegativeJoints, PositiveJoints
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, INERTIA, STIFFNESS, ControlLaw, TuningSite


@compiled
class Impedance(ControlLaw):
    """Impedance control of several users and a slave, by inverse dynamics with known
    parameters.

    M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + what the slave sends of its environment's
    force. After Shahbazi, Atashzar, Talebi and Patel, IEEE/ASME T-Mech 20(4), 2015.

    Attributes:
        M: inertia of the impedance, per joint, kg m^2.
        B: damping, per joint, N m s/rad.
        K: stiffness, per joint, N m/rad.
        follows: true of the slave; a master stays at its start pose.
    """

    M: PositiveJoints = (1.0,)
    B: NotNegativeJoints = (10.0,)
    K: PositiveJoints = (50.0,)
    follows: bool = False

    sends: ClassVar[dict[str, Any]] = {
        "force": {"unit": "N m", "length": "joints", "per_peer": True}
    }
    remembers: ClassVar = ("start",)
    tune: ClassVar = {"M": INERTIA, "B": DAMPING, "K": STIFFNESS}
    known_facts: ClassVar = "gravity AND inertia exactly: more than the others"
    needs_theta: ClassVar = True
    needs_model: ClassVar = True

    def begin(self, facts: LawContext) -> None:
        """Makes the start pose and the acceleration of the impedance."""
        self.start = [0.0] * facts.joints
        self.qdd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque; sends the torque on the arm, if it follows."""
        follows = 1.0 if self.follows else 0.0
        for i in range(now.joints):
            if now.k == 0:
                self.start[i] = now.q[i]
            q_ref = self.start[i] + follows * (now.q_des[i] - self.start[i])
            force = 0.0 - now.tau_x[i]
            for j in range(len(now.peers)):
                force += now.received[j].force[i]
                now.sent[j].force[i] = (0.0 - now.tau_x[i]) * follows * now.peers[j].alpha
            force -= self.B[i] * (now.qd[i] - follows * now.qd_des[i]) + self.K[i] * (
                now.q[i] - q_ref
            )
            self.qdd[i] = force / self.M[i]
        for i in range(now.joints):
            tau = now.bias[i] + now.tau_x[i]
            for j in range(now.joints):
                tau += now.inertia[i][j] * self.qdd[j]
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its gravity."""
        return Gains(Law.KNOWN, known=theta.tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the impedance, by the inertia of the arm, and the force that the slave sends."""
        form = LinearForm(len(at.inertia))
        share = at.inertia @ np.diag(np.broadcast_to(1.0 / np.array(self.M), len(at.inertia)))
        form.add("tau", "tau_h", share - np.eye(len(at.inertia)))
        for column, gain in (("q", self.K), ("qd", self.B)):
            form.add("tau", column, -share * np.array(gain))
            if self.follows:
                form.add("tau", f"{column}_des", share * np.array(gain))
        for j in at.peers:
            form.add("tau", ("from", j), share)
            form.add(("to", j), "tau_h", self.follows * at.alpha[at.site, j])
        return form

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns that a master follows nobody."""
        return "" if self.follows else "follows = false stays at its start pose"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the stiffest spring at the slave's arm for which the small-gain theorem
        holds.
        """
        followers = [
            n for n, law in enumerate(situation.laws) if getattr(law, "follows", False)
        ]
        if len(followers) != 1 or not all(law.kind is Impedance for law in situation.laws):
            return StabilityCondition(
                False, "one site follows, and all the others have this law with follows = false"
            )
        K_e = find_stiffest_wall(situation.laws, situation.alpha[followers[0]], followers[0])
        if K_e == 0.0:
            return StabilityCondition(
                False, "the small-gain theorem asks for B > 0 at every site"
            )
        most = "of any stiffness" if K_e == np.inf else f"of up to {K_e:.4g} N m/rad"
        text = f"for any delays, varying ones too, in free motion and at a spring {most} at the slave"
        return StabilityCondition(True, f"{text} (small gain: sufficient)")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """The slave follows."""
        return {**gains, "follows": at.role == "slave"}


def find_stiffest_wall(laws: Sequence[Any], shares: Array, slave: int) -> float:
    """Returns the largest stiffness at the slave with loop gain below 1 at all frequencies, N
    m/rad.

    The loop from the slave's force to itself is sum a_i^2 K_e (K_s + B_s s) / ((M_s s^2 + B_s s
    + K_s + K_e) (M_i s^2 + B_i s + K_i)), whatever its delays. inf: there is no largest; 0: not
    even free motion decays.
    """
    s = 1j * np.geomspace(1e-2, 1e4, 4000)
    gains = [np.array([law.M, law.B, law.K]) for law in laws]
    if any((gain[1] <= 0.0).any() for gain in gains):
        return 0.0
    most = np.inf
    for joint in range(len(laws[0].K)):
        M, B, K = gains[slave][:, joint]
        back = sum(
            shares[n] ** 2 / (gain[0, joint] * s * s + gain[1, joint] * s + gain[2, joint])
            for n, gain in enumerate(gains)
            if n != slave
        )
        walls = np.geomspace(1e-2, 1e6, 400)
        loop = np.abs(
            walls[:, None] * (K + B * s) / (M * s * s + B * s + K + walls[:, None]) * back
        )
        wrong = np.flatnonzero(loop.max(axis=1) >= 1.0)
        if len(wrong):
            most = min(most, float(walls[max(0, wrong[0] - 1)]))
    return most

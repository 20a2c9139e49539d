"""Impedance control: each arm of the users and the slave moves like a mass and a spring.

    impedance     M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j(t - T)
    inner loop    tau = M(q) qdd + C qd + G - tau_h

The reference of a master is its start pose at rest. The reference of the slave is the pose of
the masters, weighted by the slave's dominance factors alpha_j. The slave sends alpha_j tau_h to
master j: the force of its environment in the shares in which the masters lead. Masters send
nothing.
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
    """Impedance control of several users and a slave, by inverse dynamics.

    The law needs the arm's parameters. After Shahbazi, Atashzar, Talebi and Patel, IEEE/ASME
    T-Mech 20(4), 2015.

    Attributes:
        M: inertia of the impedance, per joint, kg m^2.
        B: damping, per joint, N m s/rad.
        K: stiffness, per joint, N m/rad.
        follows: true for the slave; a master's reference stays at its start pose.
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
        """Creates the start pose and the acceleration of the impedance."""
        self.start = [0.0] * facts.joints
        self.qdd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque; the slave also sends the torque on its arm."""
        follows = 1.0 if self.follows else 0.0
        for i in range(now.joints):
            if now.k == 0:
                self.start[i] = now.q[i]
            q_ref = self.start[i] + follows * (now.q_des[i] - self.start[i])
            qd_ref = follows * now.qd_des[i]
            tau_h = 0.0 - now.tau_x[i]
            force = tau_h
            for j in range(len(now.peers)):
                force += now.received[j].force[i]
                now.sent[j].force[i] = tau_h * follows * now.peers[j].alpha
            damping = self.B[i] * (now.qd[i] - qd_ref)
            force -= damping + self.K[i] * (now.q[i] - q_ref)
            self.qdd[i] = force / self.M[i]
        for i in range(now.joints):
            tau = now.bias[i] + now.tau_x[i]
            for j in range(now.joints):
                tau += now.inertia[i][j] * self.qdd[j]
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the law of known gravity without gains."""
        return Gains(Law.KNOWN, known=theta.tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the impedance, scaled by M(q) M^-1, and the force that the slave sends."""
        n = len(at.inertia)
        form = LinearForm(n)
        inertia_ratio = at.inertia @ np.diag(np.broadcast_to(1.0 / np.array(self.M), n))
        form.add("tau", "tau_h", inertia_ratio - np.eye(n))
        for column, gain in (("q", self.K), ("qd", self.B)):
            form.add("tau", column, -inertia_ratio * np.array(gain))
            if self.follows:
                form.add("tau", f"{column}_des", inertia_ratio * np.array(gain))
        for j in at.peers:
            form.add("tau", ("from", j), inertia_ratio)
            form.add(("to", j), "tau_h", self.follows * at.alpha[at.site, j])
        return form

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns that a master stays at its start pose, or "" for the slave."""
        return "" if self.follows else "follows = false stays at its start pose"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the stiffest wall at the slave for which the small-gain theorem holds."""
        followers = [
            n for n, law in enumerate(situation.laws) if getattr(law, "follows", False)
        ]
        if len(followers) != 1 or not all(law.kind is Impedance for law in situation.laws):
            return StabilityCondition(
                False, "one site follows, and all the others have this law with follows = false"
            )
        slave = followers[0]
        K_e = find_stiffest_wall(situation.laws, situation.alpha[slave], slave)
        if K_e == 0.0:
            return StabilityCondition(
                False, "the small-gain theorem asks for B > 0 at every site"
            )
        stiffness = "of any stiffness" if K_e == np.inf else f"of up to {K_e:.4g} N m/rad"
        text = (
            "for any delays, varying ones too, in free motion and at a spring "
            f"{stiffness} at the slave (small gain: sufficient)"
        )
        return StabilityCondition(True, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site for tuned gains; the slave follows."""
        return {**gains, "follows": at.role == "slave"}


def find_stiffest_wall(laws: Sequence[Any], shares: Array, slave: int) -> float:
    """Returns the largest wall stiffness with loop gain below 1 at all frequencies, N m/rad.

    The loop from the slave's force to itself has, for any delays, the gain

        sum_i a_i^2 K_e (K_s + B_s s)
              / ((M_s s^2 + B_s s + K_s + K_e) (M_i s^2 + B_i s + K_i))

    The result is inf if any stiffness is allowed, and 0 if not even free motion decays.

    Args:
        laws: the control of each site.
        shares: a_i, the slave's dominance factors, shape (N,).
        slave: the index of the slave.
    """
    s = 1j * np.geomspace(1e-2, 1e4, 4000)
    gains = [np.array([law.M, law.B, law.K]) for law in laws]
    if any((gain[1] <= 0.0).any() for gain in gains):
        return 0.0
    stiffest = np.inf
    for joint in range(len(laws[0].K)):
        M, B, K = gains[slave][:, joint]
        masters: Any = 0.0
        for n, gain in enumerate(gains):
            if n != slave:
                M_i, B_i, K_i = gain[:, joint]
                masters = masters + shares[n] ** 2 / (M_i * s * s + B_i * s + K_i)
        stiffness = np.geomspace(1e-2, 1e6, 400)
        K_e = stiffness[:, None]
        slave_gain = K_e * (K + B * s) / (M * s * s + B * s + K + K_e)
        loop_gain = np.abs(slave_gain * masters)
        unstable = np.flatnonzero(loop_gain.max(axis=1) >= 1.0)
        if len(unstable):
            stiffest = min(stiffest, float(stiffness[max(0, unstable[0] - 1)]))
    return stiffest

"""Impedance control: each arm moves like a mass on a spring and a damper.

    impedance     M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j(t - T)
    inner loop    tau = M(q) qdd + C qd + G - tau_h

The reference of a master is its start pose at rest. The reference of the slave is the pose of
the masters, weighted by the slave's dominance factors alpha_j. The slave sends f_j = alpha_j
tau_h to master j, so each master feels the environment's force in proportion to its share of
the lead. Masters send zeros.
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

    The law needs the arm's parameters.

    Source: Shahbazi, Atashzar, Talebi and Patel, IEEE/ASME T-Mech 20(4), 2015.

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
            q = now.q[i]
            if now.k == 0:
                self.start[i] = q
            start = self.start[i]
            q_ref = start + follows * (now.q_des[i] - start)
            qd_ref = follows * now.qd_des[i]
            tau_h = 0.0 - now.tau_x[i]
            force = tau_h
            for j in range(len(now.peers)):
                force += now.received[j].force[i]
                now.sent[j].force[i] = tau_h * follows * now.peers[j].alpha
            damper = self.B[i] * (now.qd[i] - qd_ref)
            spring = self.K[i] * (q - q_ref)
            force -= damper + spring
            self.qdd[i] = force / self.M[i]
        # The inner loop gives the arm the acceleration of the impedance.
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
        inverse_M = np.broadcast_to(1.0 / np.array(self.M), n)
        inertia_ratio = at.inertia @ np.diag(inverse_M)
        stiffness = inertia_ratio * np.array(self.K)
        damping = inertia_ratio * np.array(self.B)
        form.add("tau", "tau_h", inertia_ratio - np.eye(n))
        form.add("tau", "q", -stiffness)
        if self.follows:
            form.add("tau", "q_des", stiffness)
        form.add("tau", "qd", -damping)
        if self.follows:
            form.add("tau", "qd_des", damping)
        for j in at.peers:
            form.add("tau", ("from", j), inertia_ratio)
            form.add(("to", j), "tau_h", self.follows * at.alpha[at.site, j])
        return form

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns the reason for a master, which stays at its start pose, or ""."""
        return "" if self.follows else "follows = false stays at its start pose"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition with the stiffest wall that the small-gain theorem allows."""
        laws = situation.laws
        followers = [n for n, law in enumerate(laws) if getattr(law, "follows", False)]
        have_this_law = all(law.kind is Impedance for law in laws)
        if len(followers) != 1 or not have_this_law:
            text = "one site follows, and all the others have this law with follows = false"
            return StabilityCondition(False, text)
        slave = followers[0]
        K_e = find_stiffest_wall(laws, situation.alpha[slave], slave)
        if K_e == 0.0:
            text = "the small-gain theorem requires B > 0 at every site"
            return StabilityCondition(False, text)
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
    stiffnesses = np.geomspace(1e-2, 1e6, 400)
    K_e = stiffnesses[:, None]
    gains = [np.array([law.M, law.B, law.K]) for law in laws]
    if any((gain[1] <= 0.0).any() for gain in gains):
        return 0.0
    stiffest = np.inf
    for joint in range(len(laws[0].K)):
        masters: Any = 0.0
        for n, gain in enumerate(gains):
            if n == slave:
                continue
            M, B, K = gain[:, joint]
            impedance = M * s * s + B * s + K
            masters = masters + shares[n] ** 2 / impedance
        M, B, K = gains[slave][:, joint]
        impedance = M * s * s + B * s + K
        slave_gain = K_e * (K + B * s) / (impedance + K_e)
        loop_gain = np.abs(slave_gain * masters)
        unstable = np.flatnonzero(loop_gain.max(axis=1) >= 1.0)
        if len(unstable):
            last_stable = max(0, unstable[0] - 1)
            stiffest = min(stiffest, float(stiffnesses[last_stable]))
    return stiffest

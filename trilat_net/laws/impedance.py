"""Implements impedance control: each arm moves like a mass on a spring and a damper.

    impedance     M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j(t - T)
    inner loop    tau = M(q) qdd + C qd + G - tau_h

In the first equation q, qd and qdd are position, velocity and acceleration of the joints. M, B
and K are the inertia, damping and stiffness that the user chooses; q_ref and qd_ref are the
reference and its velocity; tau_h is the torque of the operator or environment on the arm; f_j
is the force that peer j sends, and T its delay. The inner loop computes the torque tau that
gives the arm the acceleration qdd of this equation. It uses the arm's inertia matrix M(q),
Coriolis matrix C and gravity torque G.

A master is an arm that a person moves, and the slave follows the masters. The reference of a
master is its start pose at rest. The reference of the slave is the pose of the masters,
weighted by its dominance factors alpha_j (the weights with which it follows them). The slave
sends f_j = alpha_j tau_h to master j, so each master feels the environment's force in
proportion to its share of the lead. Masters send zeros.
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
        M: Inertia of the impedance, per joint, kg m^2.
        B: Damping, per joint, N m s/rad.
        K: Stiffness, per joint, N m/rad.
        follows: True for the slave; a master's reference stays at its start pose.
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
        """Prepares the law before a run: creates its start pose and its desired acceleration.

        The first control period stores the measured pose as the start pose.

        Args:
            facts: Facts about the site that are known before the run.
        """
        self.start = [0.0] * facts.joints
        self.qdd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Computes the torque of the arm in one period of the control loop.

        First, the acceleration qdd is computed that a mass M on a spring K and a damper B would
        have:

            M qdd = tau_h + sum_j f_j - B (qd - qd_ref) - K (q - q_ref)

        q and qd are the positions and velocities of the joints, tau_h is the torque of the
        operator or environment on the arm, and f_j the force that peer j (another arm) sent. At
        a master, an arm that a person moves, the reference q_ref is the start pose and qd_ref
        is zero. At the slave, the reference is q_des and qd_des, the weighted motion of the
        masters, and the force f_j = alpha_j tau_h is sent to master j, where alpha_j is the
        weight with which the slave follows it.

        Then the torque tau is computed that gives the arm this acceleration:

            tau = C qd + G + M_arm qdd - tau_h

        where C qd is the Coriolis torque, G the gravity torque and M_arm the inertia matrix of
        the arm.

        Args:
            now: Inputs and outputs of the law in this period. The torque is written into
                `now.tau`. `now.bias` is C qd + G, and `now.tau_x` is -tau_h.
        """
        follows = 1.0 if self.follows else 0.0  # a master's reference and sent force vanish
        for i in range(now.joints):
            q = now.q[i]
            is_first_period = now.k == 0
            if is_first_period:
                self.start[i] = q
            start = self.start[i]
            target_offset = now.q_des[i] - start
            q_ref = start + follows * target_offset
            qd_ref = follows * now.qd_des[i]
            tau_h = 0.0 - now.tau_x[i]
            force = tau_h
            for j in range(len(now.peers)):
                alpha = now.peers[j].alpha
                force += now.received[j].force[i]
                now.sent[j].force[i] = tau_h * follows * alpha
            rate_error = now.qd[i] - qd_ref
            error = q - q_ref
            damper = self.B[i] * rate_error
            spring = self.K[i] * error
            force -= damper + spring
            self.qdd[i] = force / self.M[i]
        # The inner loop gives the arm this acceleration. Its torque contains -tau_h = tau_x.
        for i in range(now.joints):
            tau = now.bias[i] + now.tau_x[i]
            for j in range(now.joints):
                inertia = now.inertia[i][j]
                tau += inertia * self.qdd[j]
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns gains for the linear analysis that only compensate gravity.

        The linear analysis considers small motions around a pose at rest. `linear_form` adds
        the spring, the damper and the forces of this law.

        Args:
            theta: Parameters of the arm's dynamics, such as masses, shape (P,), where P is
                their number.
        """
        return Gains(Law.KNOWN, known=theta.tolist())

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the spring, the damper and the forces of this law for the linear analysis.

        The linear analysis considers small motions around a pose at rest. The law gives the arm
        the acceleration of a mass M on a spring K and a damper B. For an arm with the inertia
        matrix A, the torque (without gravity) is

            tau = A inv(M) (tau_h + sum_j f_j - B (qd - qd_des) - K (q - q_des)) - tau_h

        q and qd are the positions and velocities of the joints, tau_h is the torque of the
        operator or environment on the arm, and f_j the force that peer j (another arm) sends.
        The desired motion q_des, qd_des belongs to the slave, the arm that follows; at the
        other arms these terms are missing. The slave sends alpha_j tau_h to peer j, where
        alpha_j is the weight with which it follows this peer; the other arms send zero.

        A block `form.add(row, column, gain)` says that the row contains gain times the column.
        The column ("from", j) is the force f_j, and the row ("to", j) the force that is sent to
        peer j.

        Args:
            situation: The site, its arm, and the weights with which it follows the other sites.
        """
        n = len(situation.inertia)
        form = LinearForm(n)
        # M, B and K are diagonal: one number per joint, or a single number for all joints.
        M = np.array(self.M)
        B = np.array(self.B)
        K = np.array(self.K)
        inverse_M = np.broadcast_to(1.0 / M, n)
        inertia_ratio = situation.inertia @ np.diag(inverse_M)  # A inv(M)
        # Multiplying by a vector scales the columns, as the diagonal matrices K and B would.
        stiffness = inertia_ratio * K
        damping = inertia_ratio * B
        force_gain = inertia_ratio - np.eye(n)
        form.add("tau", "tau_h", force_gain)
        form.add("tau", "q", -stiffness)
        if self.follows:
            form.add("tau", "q_des", stiffness)
        form.add("tau", "qd", -damping)
        if self.follows:
            form.add("tau", "qd_des", damping)
        for j in situation.peers:
            alpha = situation.alpha[situation.site, j]
            sent_share = self.follows * alpha  # zero unless this arm is the slave
            form.add("tau", ("from", j), inertia_ratio)
            form.add(("to", j), "tau_h", sent_share)
        return form

    def explain_idle_shares(self, situation: LawSituation) -> str:  # noqa: ARG002
        """Explains to the user that the dominance factors of a master have no effect.

        A master stays at its start pose and follows nobody, so that its weights do not matter.

        Returns:
            A sentence. Empty for the slave.
        """
        return "" if self.follows else "follows = false stays at its start pose"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the loop between the masters and the slave is stable.

        The result states the stiffest wall at the slave for which the small-gain theorem proves
        stability for any delays (see `find_stiffest_wall`). The condition is not met if there
        is not exactly one slave, if a site uses another law, or if a damping is zero.

        Args:
            situation: All sites, their laws, and the weights with which they follow each other.
        """
        laws = situation.laws
        followers = []
        for n, law in enumerate(laws):
            if getattr(law, "follows", False):
                followers.append(n)
        have_this_law = all(law.kind is Impedance for law in laws)
        if len(followers) != 1 or not have_this_law:
            text = "one site follows, and all the others have this law with follows = false"
            return StabilityCondition(False, text)
        slave = followers[0]
        dominance_factors = situation.alpha[slave]
        K_e = find_stiffest_wall(laws, dominance_factors, slave)
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
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the settings of this law for one site, after its gains were tuned.

        The settings form the table [control] of a scenario, the description of an experiment.
        The setting `follows` is true for the slave, which follows the masters, and false for a
        master, which stays at its start pose.

        Args:
            gains: Tuned gains by name.
            site: Facts about the site for which the table is written.
        """
        return {**gains, "follows": site.role == "slave"}


def find_stiffest_wall(laws: Sequence[Any], dominance_factors: Array, slave: int) -> float:
    """Returns the largest wall stiffness with loop gain below 1 at all frequencies, N m/rad.

    A loop whose gain is below 1 at every frequency is stable for any delays (small-gain
    theorem). The loop from the slave's force to itself has the gain

        sum_i a_i^2 K_e (K_s + B_s s)
              / ((M_s s^2 + B_s s + K_s + K_e) (M_i s^2 + B_i s + K_i))

    where K_e is the stiffness of the wall, the index s denotes the slave, i runs over the
    masters and s is the Laplace variable. The gain is evaluated on a grid of frequencies and
    stiffnesses.

    Args:
        laws: Settings of the law of each site.
        dominance_factors: a_i, those of the slave, shape (N,).
        slave: Index of the slave.

    Returns:
        The stiffness. It is inf if any stiffness is allowed, and 0 if not even free motion
            decays.
    """
    s = 1j * np.geomspace(1e-2, 1e4, 4000)
    stiffnesses = np.geomspace(1e-2, 1e6, 400)
    K_e = stiffnesses[:, None]
    gains = []
    for law in laws:
        gain = np.array([law.M, law.B, law.K])
        gains.append(gain)
    for gain in gains:
        B = gain[1]
        if (B <= 0.0).any():
            return 0.0  # without damping, free motion does not decay

    stiffest = np.inf
    joints = len(laws[0].K)
    for joint in range(joints):
        masters: Any = 0.0  # the sum of a_i^2 over the impedances of the masters
        for n, gain in enumerate(gains):
            if n == slave:
                continue
            M, B, K = gain[:, joint]
            impedance = M * s * s + B * s + K
            squared_factor = dominance_factors[n] ** 2
            masters = masters + squared_factor / impedance

        M, B, K = gains[slave][:, joint]
        impedance = M * s * s + B * s + K
        coupling = K + B * s
        slave_gain = K_e * coupling / (impedance + K_e)
        loop_gain = np.abs(slave_gain * masters)
        largest_gains = loop_gain.max(axis=1)
        unstable = np.flatnonzero(largest_gains >= 1.0)
        if len(unstable):
            last_stable = max(0, unstable[0] - 1)
            stiffness = float(stiffnesses[last_stable])
            stiffest = min(stiffest, stiffness)
    return stiffest

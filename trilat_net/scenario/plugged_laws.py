"""Built-in control laws that are plugged into the core as one class each: their gains and their conditions.

Invariant: as for the laws of `laws.py`. A law whose small motions are those of a law of known gravity says
so by `linear_gains`, so that `trilat linear` and `trilat ports` have it.
"""

from collections.abc import Sequence

import numpy as np

from ..core.laws.adaptive_jacobian import LEAST_SINE, AdaptiveJacobian
from ..core.laws.four_channel import FourChannel, SixChannel
from ..core.laws.impedance_control import ImpedanceControl
from ..core.laws.saturated_pd import SaturatedPd
from ..core.laws.shared_authority import SharedAuthority
from ..core.laws.smith_predictor import SmithPredictor
from ..core.laws.synchronisation import Synchronisation
from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from . import fields
from .imported_law import PluggedLaw
from .law_conditions import LawSituation, StabilityCondition, judge_position_exchange
from .linear_form import LinearForm, LinearSituation

_LLEWELLYN = (
    "transparent without delay only; with delay no bound is known that holds for every operator and "
    "environment: Llewellyn's condition decides, see trilat ports"
)

_NEUTRAL = (
    "acceleration = 1 and any delay, one tick included, leave high frequencies undamped (the neutral part of "
    "the loop has radius 1): take less than 1, which is necessary and not sufficient"
)


class FourChannels(PluggedLaw, frozen=True, tag_field="law", tag="four_channel"):
    """Positions and forces both ways, with known gravity.

    tau = G + K (q_des - q) + B (qd_des - qd) + acceleration M qdd_des + force_peer felt + force_own tau_h.
    Ideal transparency without delay: force_peer = 1 + force_own at both sites, acceleration = 1. Lawrence,
    IEEE T-RA 9, 1993; local force feedback: Hashtrudi-Zaad and Salcudean, IEEE T-RA 18, 2002.

    Attributes:
        K: stiffness per joint, N m/rad.
        B: damping of the error, per joint, N m s/rad.
        force_peer: gain of the peers' torque, C2 or C3, per joint, dimensionless.
        force_own: gain of the torque on the arm itself, C6 or C5, per joint, dimensionless.
        acceleration: share of the peers' acceleration that is fed forward.
        gravity: share of gravity that it knows, 1: exactly.
    """

    core_class = FourChannel

    K: fields.PositiveJoints = (100.0,)
    B: fields.NotNegativeJoints = (20.0,)
    force_peer: fields.Joints = (1.0,)
    force_own: fields.Joints = (0.0,)
    acceleration: fields.Share = 0.0
    gravity: fields.NotNegative = 1.0

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the same law as one of known gravity, which has neither qdd nor the arm's own torque."""
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, Kd=self.B, d=(0.0,), k_f=self.force_peer, known=known)

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns what acceleration and the arm's own torque add."""
        if not self.acceleration and not any(self.force_own):
            return None
        form = LinearForm(len(at.inertia), sends_acceleration=self.acceleration > 0.0)
        form.add("tau", "tau_h", self.force_own)
        for j in at.peers:
            form.add("tau", ("from", j), self.acceleration * at.alpha[at.site, j] * at.inertia)
            form.add(("to", j), "q", 0.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns that acceleration = 1 is unstable with any delay; else Llewellyn's condition decides."""
        if self.acceleration >= 1.0:
            return StabilityCondition(False, _NEUTRAL)
        return StabilityCondition(None, _LLEWELLYN)


class SixChannels(FourChannels, frozen=True, tag_field="law", tag="six_channel"):
    """The four-channel law of two users and a slave whose dominance is one factor a.

    The sites are user 1, user 2 and slave, in this order. User 1 follows the slave by a and user 2 by 1 - a,
    user 2 the slave by 1 - a and user 1 by a, the slave user 1 by a and user 2 by 1 - a. After Khademian and
    Hashtrudi-Zaad, IEEE/ASME T-Mech 17, 2012.
    """

    core_class = SixChannel

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the factor and the weights of torques at rest; more is not decided here."""
        a = float(situation.alpha[2, 0])
        if not np.allclose(situation.alpha, complementary_shares(a)):
            text = "the shares are not those of one factor: see six_channel in docs/laws.md"
            return StabilityCondition(False, text)
        beta = ", ".join(f"{weight:.4g}" for weight in complementary_weights(a))
        found = FourChannels.condition(self, situation)
        text = f"factor a = {a:g}, weights beta = ({beta}); {found.text if found else ''}"
        return StabilityCondition(found.holds if found else None, text)


class SaturatedPositions(PluggedLaw, frozen=True, tag_field="law", tag="saturated_pd"):
    """P+d whose pull towards each peer saturates: tau = G - sum alpha_ij P tanh(K (q - q_j) / P) - d qd.

    Zakerimanesh, Hashemzadeh and Ghiasi, "Dual-user nonlinear teleoperation subjected to varying time delay
    and bounded inputs", ISA Transactions 68, 2017.

    Attributes:
        K: stiffness of small errors, per joint, N m/rad.
        P: largest pull of all peers together, per joint, N m.
        d: damping of the arm's velocity, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    core_class = SaturatedPd
    linear_note = "saturated_pd has the slope K of small errors: where sites disagree at rest it pulls less"

    K: fields.PositiveJoints = (10.0,)
    P: fields.PositiveJoints = (5.0,)
    d: fields.NotNegativeJoints = (3.0,)
    gravity: fields.NotNegative = 1.0

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns P+d, with the stiffness of small errors."""
        return Gains(Law.KNOWN, K=self.K, d=self.d, known=(theta * self.gravity).tolist())

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d (the slope is nowhere above K), and what the torque limit leaves."""
        found = judge_position_exchange(situation, "K", "d")
        if not situation.gravity_nm:
            return found._replace(text=f"{found.text}; and tau_limit_nm above gravity + P + d |qd|")
        gravity = self.gravity * np.array(situation.gravity_nm)
        room = np.array(situation.tau_limit_nm) - gravity - np.array(self.P)
        if room.min() <= 0.0:
            n = int(room.argmin())
            lacks = f"tau_limit_nm of joint {n + 1} is {-room[n]:.3g} N m below gravity + P"
            return StabilityCondition(False, f"{lacks}: it would cut the pull off")
        with np.errstate(divide="ignore"):
            most = float(np.min(room / np.array(self.d)))
        within = f"; gravity + P + d |qd| is within tau_limit_nm up to {most:.3g} rad/s"
        return found._replace(text=found.text + within)


class Authority(PluggedLaw, frozen=True, tag_field="law", tag="authority"):
    """Two users share the authority over a slave, and feel each other but not the environment.

    After Nudehi, Mukherjee and Ghodoussi, "A shared-control approach to haptic interface design for minimally
    invasive telesurgical training", IEEE T-CST, 2005.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        leads: true of a user, false of the slave.
        gravity: share of gravity that it knows, 1: exactly.
    """

    core_class = SharedAuthority

    K: fields.PositiveJoints = (10.0,)
    d: fields.NotNegativeJoints = (3.0,)
    leads: bool = True
    gravity: fields.NotNegative = 1.0

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its damping and its gravity."""
        return Gains(Law.KNOWN, d=self.d, known=(theta * self.gravity).tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the springs to the users."""
        form = LinearForm(len(at.inertia))
        for j in at.peers:
            share = at.alpha[at.site, j] * float(getattr(at.laws[j], "leads", False)) * np.array(self.K)
            form.add("tau", "q", -share)
            form.add("tau", ("from", j), share)
            form.add(("to", j), "q", 1.0)
        return form

    def explain_idle_shares(self, at: LawSituation) -> str:
        """Returns whom a user does not feel: those who do not lead."""
        idle = [name for name, law in zip(at.names, at.laws, strict=True) if not getattr(law, "leads", False)]
        return f"users feel those who lead alone, not {', '.join(idle)}" if self.leads and idle else ""

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d among the users; the slave follows them and closes no loop."""
        users = [n for n, law in enumerate(situation.laws) if getattr(law, "leads", False)]
        if situation.site not in users:
            return StabilityCondition(True, "it follows and closes no loop: stable for every delay and d > 0")
        among = situation.restrict(users)
        return judge_position_exchange(among, "K", "d")


class Synchronised(PluggedLaw, frozen=True, tag_field="law", tag="sync"):
    """Adaptive synchronisation of r = qd + Lambda q: under gravity all arms end at q = 0.

    tau = Y(q, qd, -Lambda q, -Lambda qd) theta_hat + K (sum alpha_ij r_j - r), theta_hat' = -Gamma Y' r. For
    planar arms. Chopra, Spong and Lozano, "Synchronization of bilateral teleoperators with time delay",
    Automatica 44, 2008; the defect: Nuno, Ortega and Basanez, Automatica 46, 2010.

    Attributes:
        Lambda: per joint, 1/s.
        K: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
    """

    core_class = Synchronisation

    Lambda: fields.PositiveJoints = (1.0,)
    K: fields.PositiveJoints = (3.0,)
    Gamma: fields.NotNegativeParameters = (1.0,)
    theta_hat0: fields.Parameters = (0.0,)

    def linear_gains(self, theta: Array) -> Gains | None:  # noqa: ARG002
        """Returns the adaptive law whose r is that of the absolute pose."""
        gains = Gains(Law.ADAPTIVE, self.Lambda, self.K, Gamma=self.Gamma, theta_hat0=self.theta_hat0)
        return gains._replace(absolute=True)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that every constant delay is allowed, and what it then does."""
        if np.isnan(situation.longest_s):
            return StabilityCondition(None, "proved for constant delays, and a delay here varies")
        text = "r of all sites agree for every constant delay, any Lambda, K and Gamma > 0 (sufficient)"
        return StabilityCondition(
            True, f"{text}; but under gravity the arms end at q = 0, wherever they are led"
        )


class UnknownLengths(PluggedLaw, frozen=True, tag_field="law", tag="adaptive_kinematics"):
    """The paper's law between the places of end effectors, of planar arms whose lengths nobody knows.

    The place and velocity of the end effector are measured, and compared in the frame of the bases; masses
    and lengths are learnt. C. C. Cheah, C. Liu and J.-J. E. Slotine, "Adaptive tracking control for robots
    with unknown kinematic and dynamic properties", Int. J. Robotics Research 25(3), 283-296, 2006.

    Attributes:
        Lambda: per coordinate x and y, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per coordinate, N s/m.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
        length_gain_m_n: adaptation gain of the lengths, m/N.
        lengths0_m: first estimate of the two lengths.
        least_m: lower bound of both.
        most_m: upper bound.
    """

    core_class = AdaptiveJacobian

    Lambda: fields.PositiveJoints = (1.0,)
    Kp: fields.PositiveJoints = (1.0,)
    Kd: fields.PositiveJoints = (3.0,)
    Gamma: fields.NotNegativeParameters = (1.0,)
    theta_hat0: fields.Parameters = (0.0,)
    length_gain_m_n: fields.NotNegative = 0.01
    lengths0_m: fields.PositiveJoints = (1.0,)
    least_m: fields.Positive = 0.2
    most_m: fields.Positive = 3.0

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the premises: constant delays, elbows that stay bent, lengths within their bounds."""
        if np.isnan(situation.longest_s):
            return StabilityCondition(None, "proved for constant delays, and a delay here varies")
        return StabilityCondition(
            None,
            f"for every constant delay, while abs(sin q2) > {LEAST_SINE:g} and the lengths are within "
            f"{self.least_m:g} and {self.most_m:g} m (sufficient); the run shows if elbows stay bent",
        )


class Impedances(PluggedLaw, frozen=True, tag_field="law", tag="impedance"):
    """Impedance control of several users and a slave, by inverse dynamics with known parameters.

    M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + what the slave sends of its environment's force. After
    Shahbazi, Atashzar, Talebi and Patel, IEEE/ASME T-Mech 20(4), 2015.

    Attributes:
        M: inertia of the impedance, per joint, kg m^2.
        B: damping, per joint, N m s/rad.
        K: stiffness, per joint, N m/rad.
        follows: true of the slave; a master stays at its start pose.
    """

    core_class = ImpedanceControl

    M: fields.PositiveJoints = (1.0,)
    B: fields.NotNegativeJoints = (10.0,)
    K: fields.PositiveJoints = (50.0,)
    follows: bool = False

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
        """Returns the stiffest spring at the slave's arm for which the small-gain theorem holds."""
        followers = [n for n, law in enumerate(situation.laws) if getattr(law, "follows", False)]
        if len(followers) != 1 or not all(isinstance(law, Impedances) for law in situation.laws):
            return StabilityCondition(
                False, "one site follows, and all the others have this law with follows = false"
            )
        K_e = find_stiffest_wall(situation.laws, situation.alpha[followers[0]], followers[0])
        if K_e == 0.0:
            return StabilityCondition(False, "the small-gain theorem asks for B > 0 at every site")
        most = "of any stiffness" if K_e == np.inf else f"of up to {K_e:.4g} N m/rad"
        text = f"for any delays, varying ones too, in free motion and at a spring {most} at the slave"
        return StabilityCondition(True, f"{text} (small gain: sufficient)")


def find_stiffest_wall(laws: Sequence[Impedances], shares: Array, slave: int) -> float:
    """Returns the largest stiffness at the slave with loop gain below 1 at all frequencies, N m/rad.

    The loop from the slave's force to itself is sum a_i^2 K_e (K_s + B_s s) / ((M_s s^2 + B_s s + K_s + K_e)
    (M_i s^2 + B_i s + K_i)), whatever its delays. inf: there is no largest; 0: not even free motion decays.
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
        loop = np.abs(walls[:, None] * (K + B * s) / (M * s * s + B * s + K + walls[:, None]) * back)
        wrong = np.flatnonzero(loop.max(axis=1) >= 1.0)
        if len(wrong):
            most = min(most, float(walls[max(0, wrong[0] - 1)]))
    return most


class SmithPredicted(PluggedLaw, frozen=True, tag_field="law", tag="smith"):
    """P+d of a master and a slave with a Smith predictor of the slave at the master.

    Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53, 1957 (from memory).

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        inertia: of the model of the slave, per joint, kg m^2; K, d and inertia are alike at both sites.
        predicts: true of the master.
        gravity: share of gravity that it knows, 1: exactly.
    """

    core_class = SmithPredictor

    K: fields.PositiveJoints = (10.0,)
    d: fields.NotNegativeJoints = (3.0,)
    inertia: fields.PositiveJoints = (1.0,)
    predicts: bool = False
    gravity: fields.NotNegative = 1.0

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its damping and its gravity; of the slave, which is P+d, its stiffness too."""
        K = (0.0,) if self.predicts else self.K
        return Gains(Law.KNOWN, K=K, d=self.d, known=(theta * self.gravity).tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns the model, which the master has under its own pose and the slave under what came."""
        (peer,), K, m = at.peers, np.array(self.K), np.array(self.inertia)
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
            getattr(law, key, None) != getattr(self, key) for law in laws for key in ("K", "d", "inertia")
        ):
            return StabilityCondition(False, "K, d and inertia must be alike at both sites")
        text = "a slave in free motion whose inertia is the model's makes the loop one without delay (d > 0)"
        return StabilityCondition(
            None, f"{text}; contact, and an inertia that changes, the model does not have"
        )


def complementary_shares(a: float) -> Array:
    """Returns the dominance matrix of user 1, user 2 and slave for the factor a."""
    return np.array([[0.0, 1.0 - a, a], [a, 0.0, 1.0 - a], [a, 1.0 - a, 0.0]])


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Returns beta of the same three: at rest, sum beta_i tau_h,i = 0."""
    return 1.0 - (1.0 - a) ** 2, 1.0 - a**2, 1.0 - a * (1.0 - a)

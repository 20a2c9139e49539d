"""Impedance control: each arm moves like a mass attached to a spring and a damper.

    impedance     M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j(t - T)
    inner loop    tau = M(q) qdd + C qd + G - tau_h

In the first equation, q, qd and qdd are the position, velocity and acceleration of the joints;
M, B and K are the inertia, damping and stiffness chosen by the user; q_ref and qd_ref are the
reference and its velocity; tau_h is the torque that an operator or environment exerts on the
arm; f_j is the force sent by peer j, and T its delay. The inner loop computes the torque tau
that produces this acceleration qdd, using the arm's inertia matrix M(q), Coriolis matrix C and
gravity torque G.

A master is an arm moved by a person, and the slave follows the masters. The reference of a
master is its start pose, at rest. The reference of the slave is the average pose of the
masters, weighted by the dominance factors alpha_j. The slave sends f_j = alpha_j tau_h to
master j, so each master feels the force of the environment in proportion to its dominance
factor. Masters send zeros.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law, LawContext, LawInput, compiled
from ..fields import NotNegativeJoints, PositiveJoints
from .conditions import ArmLoad, LawSituation, LinearForm, LinearSituation, StabilityCondition
from .interface import DAMPING, INERTIA, STIFFNESS, ControlLaw, TuningRun, TuningSite

MOST_HANDS = 4
"""Largest number of hands at the masters for which all combinations are evaluated."""


@compiled
class Impedance(ControlLaw):
    """Control law that makes each arm move like a mass on a spring and a damper.

    Couples several masters and one slave. The dynamic parameters of the arm must be known.

    Source: Shahbazi, Atashzar, Talebi and Patel, IEEE/ASME T-Mech 20(4), 2015.

    Attributes:
        M: Inertia of the impedance, per joint, kg m^2.
        B: Damping of the impedance, per joint, N m s/rad.
        K: Stiffness of the impedance, per joint, N m/rad.
        follows: True for the slave, False for a master, whose reference stays at its start
            pose.
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
    known_facts: ClassVar = "gravity and the exact inertia: more than most laws"
    needs_theta: ClassVar = True
    needs_model: ClassVar = True

    def begin(self, facts: LawContext) -> None:
        """Prepares the law before a run: allocates memory for the start pose and acceleration.

        The measured pose is stored as the start pose in the first tick.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        self.start = [0.0] * facts.joints
        self.qdd = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Computes the torque of the arm in one tick.

        First, computes the acceleration qdd of a mass M on a spring K and a damper B:

            M qdd = tau_h + sum_j f_j - B (qd - qd_ref) - K (q - q_ref)

        q and qd are the joint positions and velocities, tau_h is the torque that an operator or
        environment exerts on the arm, and f_j the force sent by peer j. At a master, q_ref is
        the start pose and qd_ref is zero. At the slave, the reference is q_des and qd_des (the
        weighted motion of the masters), and the force f_j = alpha_j tau_h is sent to master j,
        where alpha_j is the dominance factor of this master.

        Then computes the torque tau that produces this acceleration:

            tau = C qd + G + M_arm qdd - tau_h

        where C qd is the Coriolis torque, G the gravity torque and M_arm the inertia matrix of
        the arm.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
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
        """Returns the gains of the gravity compensation for the linear analysis.

        The spring, the damper and the forces of this law cannot be expressed as gains.
        `linear_form` describes them as matrices.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        return Gains(Law.KNOWN, known=theta.tolist())

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the spring, the damper and the forces of this law for the linear analysis.

        The law gives the arm the acceleration of a mass M on a spring K and a damper B. For
        small motions about a resting pose of an arm with the inertia matrix A, the torque
        (excluding gravity) is

            tau = A inv(M) (tau_h + sum_j f_j - B (qd - qd_des) - K (q - q_des)) - tau_h

        q and qd are the joint positions and velocities, tau_h is the torque that an operator or
        environment exerts on the arm, and f_j the force sent by peer j. The terms q_des and
        qd_des (the desired motion) are present only at the slave. The slave sends alpha_j tau_h
        to peer j, where alpha_j is the dominance factor of this peer. The other arms send zero.

        The call `form.add(row, column, gain)` adds gain times the column to the row. The column
        ("from", j) is the force f_j, and the row ("to", j) the force sent to peer j.

        Args:
            situation: This arm and its dominance factors.
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

        The reference of a master is its start pose, so a master does not follow other arms.

        Returns:
            A sentence for the user. Empty for the slave.
        """
        return "" if self.follows else "an arm with follows = false stays at its start pose"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the loop between the masters and the slave is stable.

        A loop exists only while the slave touches something and sends forces. By the small-gain
        theorem, the loop is stable for any constant delays if its gain is below 1 at every
        frequency. A person who holds a master changes the gain, and may let go at any time. The
        gain is therefore computed for every combination of the hands that the scenario defines
        at the masters, from none to all.

        The condition is undecided in three cases:

        - A delay varies. A gain below 1 at every frequency then does not prove stability.
        - A hand at a master, or the object that the slave touches, is not modelled as a spring
          and a damper per joint.
        - More than `MOST_HANDS` hands act on the masters.

        The condition is not satisfied if there is not exactly one slave, if a site uses another
        law, or if a damping coefficient is zero.

        Args:
            situation: All sites, their laws, the operators and environments of their arms, and
                the dominance factors.
        """
        laws = situation.laws
        followers = []
        for n, law in enumerate(laws):
            if getattr(law, "follows", False):  # other laws have no such setting
                followers.append(n)
        have_this_law = all(law.kind is Impedance for law in laws)
        if len(followers) != 1 or not have_this_law:
            text = "one site follows, and all the others have this law with follows = false"
            return StabilityCondition(False, text)
        if any(damping <= 0.0 for law in laws for damping in law.B):
            text = "the small-gain theorem requires B > 0 at every site"
            return StabilityCondition(False, text)

        slave = followers[0]
        hands = situation.list_loads()
        slave_loads = hands[slave]
        if slave_loads == ():
            text = "the slave touches nothing, so no loop is closed, whatever the delays"
            bound = _describe_stiffest_wall(situation, slave, hands)
            return StabilityCondition(True, f"{text}; {bound}")
        if np.isnan(situation.longest_s):
            text = (
                "known for constant delays, and a delay here varies: a loop gain below 1 at "
                "every frequency is no bound for delays that vary"
            )
            return StabilityCondition(None, text)
        if slave_loads is None or None in hands:
            text = (
                "known for springs and dampers per joint, but a hand at a master or the "
                "environment of the slave is of another kind (such a hand may void the bound)"
            )
            return StabilityCondition(None, text)
        master_hands = _select_master_hands(hands, slave)
        if master_hands is None:
            text = (
                f"evaluated for at most {MOST_HANDS} hands at the masters, of which each may "
                "be absent, but there are more"
            )
            return StabilityCondition(None, text)

        largest_gain = 0.0
        for selection in master_hands:
            for joint in range(len(laws[0].K)):
                stiffness = sum(load.stiffness_nm_rad[joint] for load in slave_loads)
                damping = sum(load.damping_nm_s_rad[joint] for load in slave_loads)
                gain = _compute_loop_gain(
                    laws=laws,
                    dominance_factors=situation.alpha[slave],
                    slave=slave,
                    joint=joint,
                    stiffnesses=np.array([stiffness]),
                    damping=damping,
                    hands=selection,
                )
                largest_gain = max(largest_gain, float(gain.max()))
        text = (
            f"the loop gain is at most {largest_gain:.3g}, and must be below 1, for constant "
            "delays of any length, with and without the hands at the masters (small gain: "
            "sufficient, in continuous time)"
        )
        return StabilityCondition(largest_gain < 1.0, text)

    def target_motion(self, run: TuningRun) -> Array | None:
        """Computes how the arms would move if they were ideal impedances without delays.

        Each arm is modelled as a mass M on a spring K and a damper B, driven by the external
        torques of the run:

            M qdd + B (qd - qd_ref) + K (q - q_ref) = tau_h + sum_j f_j

        In the model, the reference q_ref of a master is its start pose, and the master feels
        the undelayed torque of the environment at the slave. The slave follows the undelayed
        pose of the masters. The real arms differ from the model because of delays, torque
        limits and discrete-time control.

        Args:
            run: The motion of all arms in a tuning run.

        Returns:
            Joint angles of the model, shape (N, K, n), in rad. None if a site uses another law,
            or if there is not exactly one slave.
        """
        followers = []
        for n, law in enumerate(run.laws):
            if law.kind is not Impedance:
                return None
            if getattr(law, "follows", False):
                followers.append(n)
        if len(followers) != 1:
            return None

        slave = followers[0]
        period_s = float(run.t_s[1] - run.t_s[0])
        shares = run.alpha[:, slave]  # shape (K, N)
        target = np.empty_like(run.q)
        reference = np.zeros_like(run.q[slave])
        for n, law in enumerate(run.laws):
            if n == slave:
                continue
            felt = shares[:, n, np.newaxis] * run.outside_nm[slave]
            offset = move_impedance(law, run.outside_nm[n] + felt, period_s)
            target[n] = run.q[n, 0] + offset
            reference += shares[:, n, np.newaxis] * target[n]

        slave_law: Any = run.laws[slave]
        start = run.q[slave, 0]
        reference_rate = np.gradient(reference, period_s, axis=0)
        spring = np.array(slave_law.K) * (reference - start)
        damper = np.array(slave_law.B) * reference_rate
        force = run.outside_nm[slave] + spring + damper
        target[slave] = start + move_impedance(slave_law, force, period_s)
        return target

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The setting `follows` is true for the slave, which follows the masters, and false for a
        master, which returns to its start pose.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "follows": site.role == "slave"}


def _find_stiffest_wall(
    laws: Sequence[Any],
    dominance_factors: Array,
    slave: int,
    hands: Sequence[Sequence[ArmLoad]],
) -> float:
    """Returns the largest wall stiffness with loop gain below 1 at all frequencies, N m/rad.

    A loop whose gain is below 1 at every frequency is stable for any constant delays
    (small-gain theorem). The gain of the loop from the slave's force to itself is at most

        |K_e (K_s + B_s s) / (M_s s^2 + B_s s + K_s + K_e)|
            sum_i a_i^2 / |M_i s^2 + (B_i + b_i) s + K_i + k_i|

    where K_e is the stiffness of the wall, the index s denotes the slave, i runs over the
    masters, k_i and b_i are the stiffness and damping of the hand at master i, and s is the
    Laplace variable. Absolute values are summed because the delays of the masters may differ.
    The gain is evaluated on a grid of frequencies and stiffnesses.

    A spring or a mass at a master can increase the gain, although both are passive.

    Args:
        laws: Settings of the law of each arm.
        dominance_factors: Dominance factors a_i of the slave, shape (N,).
        slave: Index of the slave.
        hands: Springs and dampers that act on the arm of each site. Defaults to none.

    Returns:
        The stiffness: inf if any stiffness is allowed, and 0 if not even free motion decays.
    """
    for law in laws:
        if any(damping <= 0.0 for damping in law.B):
            return 0.0  # without damping, free motion does not decay
    selection = hands or ((),) * len(laws)
    stiffnesses = np.geomspace(1e-2, 1e6, 400)
    stiffest = np.inf
    for joint in range(len(laws[0].K)):
        gain = _compute_loop_gain(
            laws=laws,
            dominance_factors=dominance_factors,
            slave=slave,
            joint=joint,
            stiffnesses=stiffnesses,
            damping=0.0,
            hands=selection,
        )
        largest_gains = gain.max(axis=1)
        unstable = np.flatnonzero(largest_gains >= 1.0)
        if len(unstable):
            last_stable = max(0, unstable[0] - 1)
            stiffness = float(stiffnesses[last_stable])
            stiffest = min(stiffest, stiffness)
    return stiffest


def _compute_loop_gain(
    laws: Sequence[Any],
    dominance_factors: Array,
    slave: int,
    joint: int,
    stiffnesses: Array,
    damping: float,
    hands: Sequence[Sequence[ArmLoad]],
) -> Array:
    """Returns the gain of the loop from the slave's force to itself, for many frequencies.

    The slave sends the force of its environment to the masters, whose motion it follows. The
    equation of this gain is given in `_find_stiffest_wall`. The loop is stable for any constant
    delays if the gain is below 1 at every frequency.

    Args:
        laws: Settings of the law of each arm.
        dominance_factors: Dominance factors of the slave, shape (N,).
        slave: Index of the slave.
        joint: Index of the joint.
        stiffnesses: Stiffnesses of the slave's environment, shape (E,), N m/rad.
        damping: Damping of the slave's environment, N m s/rad.
        hands: Springs and dampers that act on the arm of each site.

    Returns:
        The gains, shape (E, F) for F frequencies.
    """
    frequencies_rad_s = np.geomspace(1e-2, 1e4, 4000)
    s = 1j * frequencies_rad_s  # the Laplace variable
    masters: Any = 0.0
    for n, law in enumerate(laws):
        if n == slave:
            continue
        impedance = law.M[joint] * s * s + law.B[joint] * s + law.K[joint]
        for hand in hands[n]:
            impedance += hand.damping_nm_s_rad[joint] * s + hand.stiffness_nm_rad[joint]
        squared_factor = dominance_factors[n] ** 2
        masters = masters + squared_factor / np.abs(impedance)

    law = laws[slave]
    load = stiffnesses[:, np.newaxis] + damping * s
    coupling = law.K[joint] + law.B[joint] * s
    impedance = law.M[joint] * s * s + coupling
    slave_gain = load * coupling / (impedance + load)
    gain: Array = np.abs(slave_gain) * masters
    return gain


def _select_master_hands(
    hands: Sequence[Sequence[ArmLoad] | None], slave: int
) -> list[tuple[tuple[ArmLoad, ...], ...]] | None:
    """Returns all combinations of hands at the masters, from none to all.

    Stability is checked for each combination, because a person may let go of an arm at any
    time.

    Args:
        hands: Springs and dampers that act on the arm of each site.
        slave: Index of the slave, whose hands are omitted.

    Returns:
        For each combination, the hands of each site. None if a hand at a master is not a spring
        and a damper per joint, or if there are more than `MOST_HANDS` hands.
    """
    selections_by_site: list[list[tuple[ArmLoad, ...]]] = []
    count = 0
    for n, site_hands in enumerate(hands):
        if n == slave:
            selections_by_site.append([()])
            continue
        if site_hands is None:
            return None
        count += len(site_hands)
        selections: list[tuple[ArmLoad, ...]] = []
        for size in range(len(site_hands) + 1):
            selections += combinations(site_hands, size)
        selections_by_site.append(selections)
    if count > MOST_HANDS:
        return None
    return list(product(*selections_by_site))


def _describe_stiffest_wall(
    situation: LawSituation, slave: int, hands: Sequence[Sequence[ArmLoad] | None]
) -> str:
    """Returns a phrase about the stiffest wall for which the loop is stable.

    For example, "with a spring of up to 250 N m/rad at the slave, ...". The bound is the
    minimum over all combinations of hands at the masters. If there is no bound, the phrase
    states the reason.

    Args:
        situation: All sites and their laws.
        slave: Index of the slave.
        hands: Springs and dampers of the hands at each site, see `LawSituation.list_loads`.
    """
    selections = _select_master_hands(hands, slave)
    if selections is None:
        return "no bound is known for walls, because of the hands at the masters"
    factors = situation.alpha[slave]
    # One bound for each combination of hands at the masters; the smallest holds for all.
    stiffnesses = [
        _find_stiffest_wall(situation.laws, factors, slave, selection)
        for selection in selections
    ]
    stiffest = min(stiffnesses)
    limit = "of any stiffness" if stiffest == np.inf else f"of up to {stiffest:.4g} N m/rad"
    return (
        f"with a spring {limit} at the slave, for constant delays of any length, with and "
        "without the hands at the masters (small gain: sufficient, in continuous time)"
    )


def move_impedance(law: Any, force: Array, period_s: float) -> Array:
    """Computes the motion of a mass M on a spring K and a damper B under a given force.

    The mass starts at position 0, at rest. The solution is exact for a force that is constant
    over each period.

    Args:
        law: Settings of the law, which contain M, B and K.
        force: The force on the mass, given as a joint torque, shape (K, n), in N m.
        period_s: Time between successive values of the force, in s.

    Returns:
        The position at each of the K times, shape (K, n), in rad.
    """
    joints = force.shape[1]
    gains = [np.broadcast_to(gain, joints) for gain in (law.M, law.B, law.K)]
    position = np.empty_like(force)
    for joint in range(joints):
        M, B, K = (float(gain[joint]) for gain in gains)
        # The state is position, velocity and the force, which is constant over a period.
        rates = np.array(
            [
                [0.0, 1.0, 0.0],
                [-K / M, -B / M, 1.0 / M],
                [0.0, 0.0, 0.0],
            ]
        )
        step = _exponentiate(rates * period_s)
        state = np.zeros(3)
        for k, held_force in enumerate(force[:, joint].tolist()):
            position[k, joint] = state[0]
            state[2] = held_force
            state = step @ state
    return position


def _exponentiate(matrix: Array) -> Array:
    """Computes the exponential of a small matrix by scaling and squaring its power series.

    Source: Moler and Van Loan, "Nineteen dubious ways to compute the exponential of a matrix",
    SIAM Review 45, 2003. SciPy is not used because a session should not depend on it.

    Args:
        matrix: The matrix, shape (n, n).
    """
    # The power series converges fast for a matrix with a norm of at most 1/2. The matrix is
    # halved as often as needed, and its exponential squared as often.
    norm = float(np.abs(matrix).sum(axis=1).max())
    halvings = 0
    if norm > 0.0:
        halvings = max(0, math.ceil(math.log2(norm)) + 1)
    scaled = matrix / 2.0**halvings
    exponential = np.eye(len(matrix))
    term = np.eye(len(matrix))
    for n in range(1, 19):  # the 18th term is below 1e-21
        term = term @ scaled / n
        exponential = exponential + term
    for _ in range(halvings):
        exponential = exponential @ exponential
    return exponential

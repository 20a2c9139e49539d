"""Describes the stability condition of a control law, and its behaviour for small motions.

- The stability condition states for which gains and delays the law is stable. It is printed by
  the commands `trilat scenario check` and `trilat linear`.
- The linear form describes the law near a resting pose as a matrix of blocks. Each block states
  how one quantity, for example the torque, depends on another, for example the position. The
  linear analysis combines the forms of all arms into one linear system with delays.

Invariant:
    - Each law defines both as methods of its `Settings`, the record of its gains.
    - The text of a condition states whether the condition is only sufficient, and who proved
      it.
    - A spring and dampers of the usual form are not expressed as blocks. Their gains are
      returned by the method `linear_gains`, and blocks describe only the remaining terms, for
      example internal states of a law.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core import SCRIPTED_KINDS, Array, DominanceMatrix, TorqueKind, TorqueSource

PASSIVE_OUTSIDE = "operators and environments are passive (*sufficient*)"
"""Premise of every law with an energy account, as part of a sentence."""
COMMON_MOTION_SHARE = 0.21723362821
"""-min sin x / x: the ratio d / (K T) of damping to stiffness times delay required for the
common motion of all sites at the most critical mass.
"""


class ArmLoad(NamedTuple):
    """Spring and damper that model how a person or an object reacts to the motion of an arm.

    Both a wall and a person's hand are modelled in this way.

    Attributes:
        stiffness_nm_rad: Stiffness per joint, N m/rad.
        damping_nm_s_rad: Damping per joint, N m s/rad.
    """

    stiffness_nm_rad: tuple[float, ...]
    damping_nm_s_rad: tuple[float, ...]

    @staticmethod
    def list_of_actors(
        actors: Sequence[TorqueSource], joints: int
    ) -> "tuple[ArmLoad, ...] | None":
        """Returns the springs and dampers that model the operators and environments of an arm.

        Operators and environments whose torque depends on time alone are left out, because
        they do not react to the motion of the arm.

        Args:
            actors: Operators and environments of the arm.
            joints: Number of joints of the arm.

        Returns:
            The springs and dampers. None if an operator or environment reacts to the motion,
            but not like a spring and a damper at each joint. Examples are an operator who acts
            on the end effector, a live operator, and a program.
        """
        loads = []
        for actor in actors:
            if actor.kind in SCRIPTED_KINDS:
                continue
            # A sampled torque lags behind the motion, so it is not that of a spring and damper.
            if actor.kind not in (TorqueKind.HAND, TorqueKind.VISCOUS) or actor.sampled:
                return None
            stiffness = actor.K or (0.0,)
            load = ArmLoad(
                stiffness_nm_rad=tuple(np.broadcast_to(stiffness, joints).tolist()),
                damping_nm_s_rad=tuple(np.broadcast_to(actor.B, joints).tolist()),
            )
            loads.append(load)
        return tuple(loads)


class LawSituation(NamedTuple):
    """Facts needed to evaluate a stability condition: laws, delays and weights of all arms.

    The weights state how much each arm follows the others.

    Attributes:
        site: Index of the site.
        names: Names of the sites.
        laws: Settings of the control law of each site.
        alpha: Dominance matrix, shape (N, N). Row i contains the weights that site i gives to
            the other sites.
        delay_s: Delay of the link from j to i in row i and column j, at least one tick, s; NaN
            if it varies.
        tau_limit_nm: Torque limits of the site's joints, N m.
        rate_hz: Tick rate of the site, Hz.
        gravity_nm: Largest gravity torque of the site's planar arm, N m per joint; () for an
            arm from a URDF file.
        hold_s: Duration for which a torque is held constant, s. With the scheme `digital`, this
            is one tick, or NaN if the sites have different tick rates. With other schemes, it
            is 0, as in continuous time.
        actors: For each site, the operators and environments of its arm. () if nothing is known
            about any site.
        joints: Number of joints of each arm.
        in_task_space: True if end effectors rather than joints follow each other.
    """

    site: int
    names: tuple[str, ...]
    laws: tuple[Any, ...]
    alpha: Array
    delay_s: Array
    tau_limit_nm: tuple[float, ...]
    rate_hz: int
    gravity_nm: tuple[float, ...] = ()
    hold_s: float = 0.0
    actors: tuple[tuple[TorqueSource, ...], ...] = ()
    joints: tuple[int, ...] = ()
    in_task_space: bool = False

    @property
    def longest_s(self) -> float:
        """Longest delay of the links over which an arm follows another, s.

        NaN if any of these delays varies.
        """
        is_followed = self.alpha > 0.0
        delays_s = self.delay_s[is_followed]
        return float(np.max(delays_s, initial=0.0))

    def restrict(self, sites: Sequence[int]) -> "LawSituation":
        """Returns the facts as if only some of the sites took part in the session.

        Used by laws under which an arm follows only some of the other arms, to evaluate the
        stability condition for these arms alone.

        Args:
            sites: Indices of the sites to keep. `self.site` must be among them.
        """
        submatrix = np.ix_(sites, sites)
        return self._replace(
            site=list(sites).index(self.site),
            names=tuple(self.names[n] for n in sites),
            laws=tuple(self.laws[n] for n in sites),
            alpha=self.alpha[submatrix],
            delay_s=self.delay_s[submatrix],
            actors=tuple(self.actors[n] for n in sites) if self.actors else (),
            joints=tuple(self.joints[n] for n in sites) if self.joints else (),
        )

    def list_loads(self) -> list[tuple[ArmLoad, ...] | None]:
        """Returns the springs and dampers that react to the motion of each arm.

        The entry of an arm is None if an operator or environment reacts to its motion in any
        other way, see `ArmLoad.list_of_actors`. All entries are None if the operators and
        environments are unknown.
        """
        if not self.actors:
            return [None] * len(self.laws)
        pairs = zip(self.actors, self.joints, strict=True)
        return [ArmLoad.list_of_actors(actors, joints) for actors, joints in pairs]

    def judge_position_exchange(self, damping: str) -> "StabilityCondition | None":
        """Evaluates whether arms coupled by springs and braked by dampers are stable.

        The control law with such a coupling is called P+d. Its stability condition applies to
        arms of any mass. For two arms, the condition is due to Nuno, Basanez, Ortega and Spong,
        IJRR 28, 2009. For more than two arms, it requires that the stiffness K, damping d and
        delay T are the same at all arms, and that the dominance factors are reversible, see
        `DominanceMatrix.find_balancing_weights` (docs/theory/damping-conditions.md, 13).

        Holding a torque for the period h delays it by h / 2 on average. For held torques, the
        condition is therefore evaluated with d reduced by K h / 2 and T increased by h / 2. It
        is then known to be sufficient for arms whose smallest inertia exceeds d h / 2
        (docs/reference/laws-springs.md).

        Args:
            damping: Name of the law's attribute that contains d.

        Returns:
            The condition. It is undecided for varying delays, for differing tick rates, in task
            space, if the sites have different laws or ratios Kd / K, and if gravity
            compensation is not exact at another site. None if gravity compensation is not exact
            at this site, because no condition is known for that case.
        """
        laws = self.laws
        gravity_factors = [getattr(law, "gravity", 1.0) for law in laws]
        if gravity_factors[self.site] != 1.0:
            return None
        if self.in_task_space:
            # The stiffness belongs to coordinates of the end effector, and the damping to
            # joints.
            return StabilityCondition(None, "known only for joints that follow joints")
        if not self.alpha.any():
            text = (
                "no arm follows another, so there is no loop: stable in continuous time for "
                "every delay and d > 0"
            )
            return StabilityCondition(True, text)
        hold_s = self.hold_s
        K = np.array([getattr(law, "K", [np.nan]) for law in laws])
        d = np.array([getattr(law, damping, [np.nan]) for law in laws])

        # Cases in which no condition is known. A law without K has NaN here.
        if np.isnan(self.longest_s) or np.isnan(K).any():
            text = "known for constant delays, and with this law at all sites"
            return StabilityCondition(None, text)
        if any(factor != 1.0 for factor in gravity_factors):
            return StabilityCondition(None, "known for gravity = 1 at all sites")
        error_dampings = [np.broadcast_to(getattr(law, "Kd", 0.0), K.shape[1:]) for law in laws]
        ratios_s = np.array(error_dampings) / K
        if not np.allclose(ratios_s, ratios_s[0], rtol=1e-9, atol=0.0):
            # docs/theory/damping-conditions.md: with other ratios some arms are unstable
            return StabilityCondition(None, "known for one ratio Kd / K at all sites")
        if np.isnan(hold_s):
            text = "known for held torques only with one tick rate at all sites"
            return StabilityCondition(None, text)

        scope = "sufficient in continuous time, whatever the masses"
        if hold_s:
            damps_error = any(np.any(getattr(law, "Kd", 0.0)) for law in laws)
            least_inertia = 0.5 * float(d.max()) * hold_s
            scope = f"sufficient for arms above d h / 2 = {least_inertia:.3g} kg m^2"
            if damps_error:
                scope = "sufficient for heavy arms"

        if len(laws) == 2:
            return _judge_two_sites(self, K, d, scope)
        return _judge_several_sites(self, K, d, scope)


class StabilityCondition(NamedTuple):
    """Stability condition of a control law for one arm, and whether the arm satisfies it.

    The condition is, for example, a lower bound on the damping.

    Attributes:
        holds: True if the condition is satisfied, False if not, None if it cannot be decided.
        text: Sentence that states the condition with its numerical values and premises, and
            whether it is sufficient or sharp.
        proves_decay: True if the condition implies that all motions decay. False if it only
            proves that they stay bounded, or that the loop is passive.
    """

    holds: bool | None
    text: str
    proves_decay: bool = False


def _judge_two_sites(
    situation: LawSituation, K: Array, d: Array, scope: str
) -> StabilityCondition:
    """Evaluates the stability condition of two arms coupled by springs and dampers.

    The condition is due to Nuno, Basanez, Ortega and Spong, IJRR 28, 2009:

        4 d1 d2 >= (T1 + T2)^2 K1 K2

    K1 and K2 are the stiffnesses of the two springs, d1 and d2 the damping coefficients of the
    two arms, and T1 + T2 is the sum of the delays in both directions.

    Holding a torque for the period h delays it by h / 2 on average. Therefore each d is reduced
    by K h / 2, and the sum of the delays is increased by h. Each stiffness is multiplied by the
    weight that its site gives to the other site. Both weights are 1 in a session with two
    sites, but may be smaller if the two sites are part of a larger session.

    Args:
        situation: The situation of the site, with the delays and the hold time h.
        K: Stiffness of each site per joint, N m/rad, shape (2, n), where n is the number of
            joints.
        d: Damping of each site per joint, N m s/rad, shape (2, n).
        scope: Part of the text that states for which arms the condition is sufficient.

    Returns:
        The condition with its numerical values. It holds if it is satisfied at every joint, and
        no damping coefficient is negative after the reduction.
    """
    hold_s = situation.hold_s
    alpha = situation.alpha
    effective_d = d - 0.5 * K * hold_s
    round_trip_s = float(situation.delay_s.sum()) + hold_s
    product_of_weights = alpha[0, 1] * alpha[1, 0]
    coupling = product_of_weights * K[0] * K[1]
    left_side = 4.0 * effective_d[0] * effective_d[1]
    right_side = round_trip_s**2 * coupling
    excess = float((left_side - right_side).min())
    # A condition that holds with equality passes in spite of rounding errors.
    tolerance = 1e-9 * float(d.max()) ** 2
    # Two negative dampings have a positive product, so the signs are checked separately.
    is_damped = bool((effective_d >= 0.0).all())
    holds = excess >= -tolerance and is_damped

    round_trip_ms = f"{1e3 * round_trip_s:.4g} ms"
    text = f"4 d1 d2 >= (T1 + T2)^2 K1 K2, T1 + T2 = {round_trip_ms}"
    if hold_s:
        text = (
            "4 (d1 - K1 h / 2) (d2 - K2 h / 2) >= (T1 + T2 + h)^2 K1 K2, "
            f"T1 + T2 + h = {round_trip_ms}"
        )
    proves_decay = holds and not hold_s
    return StabilityCondition(holds, f"{text} ({scope})", proves_decay)


def _judge_several_sites(
    situation: LawSituation, K: Array, d: Array, scope: str
) -> StabilityCondition:
    """Evaluates the damping condition of more than two arms coupled by delayed springs.

        d > c K T

    d is the damping, K the stiffness of the springs and T the delay. The factor c is the
    maximum of two values: the negative of the smallest eigenvalue of the dominance matrix, for
    motions in which the arms differ, and the factor for the common motion of all arms
    (`_find_common_motion_share`).

    Args:
        situation: The laws, delays and weights of all sites.
        K: Stiffness of each site per joint, shape (N, n), N m/rad.
        d: Damping of each site per joint, shape (N, n), N m s/rad.
        scope: Part of the text that states for which arms the condition is sufficient.

    Returns:
        The condition. It is undecided if the sites have different gains or delays, and not
        satisfied if the dominance matrix is not reversible.
    """
    T = situation.longest_s
    hold_s = situation.hold_s
    delays_s = situation.delay_s[situation.alpha > 0.0]
    stiffness_differs = np.ptp(K, axis=0).any()
    gains_differ = stiffness_differs or np.ptp(d, axis=0).any()
    if gains_differ or np.ptp(delays_s):
        text = "known for more than two sites only with one K, one d and one delay"
        return StabilityCondition(None, text)
    least = DominanceMatrix(situation.alpha).find_least_eigenvalue()
    if least is None:
        text = "shares that are not reversible: some heavy arms are unstable at any d"
        return StabilityCondition(False, text)

    common_factor = COMMON_MOTION_SHARE
    if hold_s:
        delay_in_half_periods = 2.0 * T / hold_s + 1.0
        common_factor = _find_common_motion_share(delay_in_half_periods)
    factor = max(-least, common_factor)
    # A torque that is held for the period h acts h / 2 later.
    hold_term = 0.5 * hold_s * K[0]
    effective_delay_s = T + 0.5 * hold_s
    delay_term = factor * K[0] * effective_delay_s
    bound = hold_term + delay_term
    holds = bool((d[0] > bound).all())

    formula = f"{factor:.4g} K T"
    if hold_s:
        formula = f"K h / 2 + {factor:.4g} K (T + h / 2)"
    text = f"d > {formula} = {bound.max():.4g} ({scope})"
    proves_decay = holds and not hold_s
    return StabilityCondition(holds, text, proves_decay)


def _find_common_motion_share(count: float) -> float:
    """Returns the damping ratio required for the common motion of all sites to decay.

    In the common motion, all arms move alike. A spring with the stiffness K pulls each arm
    towards the position that the others had a delay T ago, and a damper d brakes it. If the
    motion oscillates with the angular frequency w, the delayed spring acts like a damper K
    sin(w T) / w, which is negative for w T between pi and 2 pi. In continuous time, d must
    therefore exceed the maximum of -K sin(w T) / w, so that

        d / (K T) = -min sin(x) / x,    x = w T    (the constant `COMMON_MOTION_SHARE`).

    If torques are held for the period h, the delay is T + h / 2 = n h / 2 with n = 2 T / h + 1.
    With x = w h / 2, the condition becomes

        (d - K h / 2) / (K (T + h / 2)) = -min sin(n x) / (n sin x),    n x from pi to 2 pi.

    The minimum is found on a grid of 1001 points, which is fine enough for a smooth function.

    Args:
        count: The number n, the delay in units of h / 2.

    Returns:
        The ratio of damping to stiffness times delay, dimensionless.
    """
    phases = np.linspace(np.pi, 2.0 * np.pi, 1001)  # n x, the phase lag over the delay
    # The ends are left out: the sine is zero there, and for n = 1 the divisor as well.
    x = phases[1:-1] / count
    damping_ratio = np.sin(count * x) / (count * np.sin(x))
    return float(-damping_ratio.min())


BlockKey = str | tuple[str, int]
"""Key of a row or a column of a linear form.

Rows: "tau"; the name of a state, for its derivative; ("to", j) for the vector sent to peer j.
Columns: "q", "qd", "q_des", "qd_des", a state, ("from", j) for the vector received from peer j,
and "tau_h" for the torque ON the arm.
"""


class LinearSituation(NamedTuple):
    """Facts needed to linearise a control law: laws and weights of all arms, and the inertia.

    The linearised law describes small motions about a resting pose.

    Attributes:
        site: Index of the site.
        names: Names of the sites.
        laws: Settings of the control law of each site.
        alpha: Dominance matrix in effect, shape (N, N). Row i contains the weights that site i
            gives to the other sites.
        inertia: Inertia matrix M(q) of the site's arm, shape (n, n), kg m^2.
    """

    site: int
    names: tuple[str, ...]
    laws: tuple[Any, ...]
    alpha: Array
    inertia: Array

    @property
    def peers(self) -> list[int]:
        """Indices of all other arms, whose motion the law may use, in ascending order."""
        return [j for j in range(len(self.names)) if j != self.site]


class LinearForm:
    """Behaviour of a control law for small motions of its arm, as a matrix of blocks.

    For a site with n joints, each block is an n x n matrix that states how one quantity (the
    row) depends on another (the column). For example, the block ("tau", "q") is the derivative
    of the torque with respect to the position.

    Args:
        joints: Number n of joints.
        states: Names of the law's states.
        sends_acceleration: True if the law sends the acceleration of its arm. In that case, the
            rows ("to", j) only identify the receivers.

    Attributes:
        blocks: Mapping from row and column to the block, shape (n, n). Missing blocks are zero.
    """

    def __init__(
        self, joints: int, states: Sequence[str] = (), *, sends_acceleration: bool = False
    ) -> None:
        self.joints = joints
        self.states = tuple(states)
        self.sends_acceleration = sends_acceleration
        self.blocks: dict[tuple[BlockKey, BlockKey], Array] = {}

    @staticmethod
    def list_forms(
        names: tuple[str, ...], laws: tuple[Any, ...], alpha: Array, inertia: Sequence[Array]
    ) -> "list[LinearForm | None]":
        """Returns, for each site, the linear terms that the gains of its law cannot express.

        Args:
            names: Names of the sites.
            laws: Settings of the control law of each site.
            alpha: Dominance matrix in effect, shape (N, N). Row i contains the weights that
                site i gives to the other sites.
            inertia: Inertia matrix of each arm, shape (n, n) for n joints, kg m^2.

        Returns:
            The terms of each site, or None for a law that its gains describe completely.
        """
        forms: list[LinearForm | None] = []
        for site, law in enumerate(laws):
            situation = LinearSituation(site, names, laws, alpha, inertia[site])
            forms.append(law.linear_form(situation))
        return forms

    def add(self, row: BlockKey, column: BlockKey, gain: Any) -> None:
        """Adds a gain to one block of the matrix that describes a linearised control law.

        A missing block is treated as zero.

        Args:
            row: Row of the block, the dependent quantity.
            column: Column of the block, the quantity on which the row depends.
            gain: A scalar for all joints, one value per joint, or a matrix of shape (n, n).
        """
        block = np.asarray(gain, dtype=np.float64)
        if block.ndim < 2:
            block = np.diag(np.broadcast_to(block, self.joints))
        previous = self.blocks.get((row, column), 0.0)
        self.blocks[row, column] = previous + block

    def list_receivers(self) -> list[int]:
        """Returns the indices of the arms to which the law sends signals, in ascending order.

        The linear analysis adds a variable for each of these signals, for example a wave. The
        list is empty if the form contains no row ("to", j).
        """
        receivers = set()
        for row, _ in self.blocks:
            if isinstance(row, tuple):
                receivers.add(int(row[1]))
        return sorted(receivers)

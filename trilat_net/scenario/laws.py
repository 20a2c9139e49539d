"""The control laws that a scenario can choose, and their gains; laws imported from a user's module aside.

Invariant: each law states its source and the condition of its stability, and says if that condition is
only sufficient. Symbols are the paper's; gains are diagonal, one number per joint or parameter.
"""

from typing import Any, get_args

import numpy as np
from msgspec.structs import asdict

from ..core.control import ROBUST_RESIDUE
from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..errors import ScenarioError
from . import fields, plugged_laws
from .energy_laws import EnergyTanks, PassivityControl, WaveVariables
from .imported_law import ImportedLaw
from .law_conditions import LawSituation, StabilityCondition, judge_position_exchange


class AdaptiveGains(fields.Frozen, frozen=True):
    """The gains of the adaptive laws.

    Attributes:
        Lambda: per joint, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
    """

    Lambda: fields.PositiveCoordinates = (1.0,)
    Kp: fields.PositiveJoints = (1.0,)
    Kd: fields.NotNegativeCoordinates = (3.0,)
    Gamma: fields.NotNegativeParameters = (1.0,)
    theta_hat0: fields.Parameters = (0.0,)

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the gains for the core, for an arm of parameters theta."""
        return Gains(Law.ADAPTIVE, self.Lambda, self.Kp, self.Kd, self.Gamma, self.theta_hat0)


class Adaptive(AdaptiveGains, frozen=True, tag_field="law", tag="adaptive"):
    """The paper's adaptive law, Eq. (13) and (15).

    Stable for any constant delays without external torque, if the dominance matrix is irreducible and the Kd
    of all sites are one matrix but for a scalar each (the paper's theorem, weights of docs/errata.md). This
    is sufficient; it does not cover delays that vary.

    Gamma = 0 and theta_hat0 = theta make the law of known parameters; Kd = 0 removes the error's damping.
    """


class AdaptiveBox(AdaptiveGains, frozen=True, tag_field="law", tag="adaptive_box"):
    """The paper's law with every estimate held in a box.

    A box that holds the truth, at its edge too, keeps V' <= 0; one that holds it strictly inside also removes
    the spring by which learning gravity ties the arms to a pose. Projection after Ioannou and Sun, "Robust
    Adaptive Control" (1996), 4.4.

    Attributes:
        theta_low: lower bound of each estimate.
        theta_high: upper bound.
    """

    theta_low: fields.Parameters = (-fields.MAX_QUANTITY,)
    theta_high: fields.Parameters = (fields.MAX_QUANTITY,)

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core."""
        return AdaptiveGains.gains(self, theta)._replace(low=self.theta_low, high=self.theta_high)

    def check(self, path: str) -> None:
        """Refuses a box without an inside, and a first estimate outside of it."""
        bounds = zip(self.theta_low, self.theta_hat0, self.theta_high, strict=True)
        for n, (low, first, high) in enumerate(bounds):
            if low > high:
                problem = f"must be at least theta_low = {low:g}, is {high:g}"
                raise ScenarioError(problem, path=f"{path}.theta_high[{n}]")
            if not low <= first <= high:
                problem = f"must lie in its box from {low:g} to {high:g}, is {first:g}"
                raise ScenarioError(problem, path=f"{path}.theta_hat0[{n}]")


class AdaptiveRobust(AdaptiveBox, frozen=True, tag_field="law", tag="adaptive_robust"):
    """The law with a box, and a term against torque that no estimate explains: - rho r / sqrt(r^2 + width^2).

    For constant delays, no operator, theta in its box and a disturbance of at most rho at every joint, the
    mean over time of what V dissipates is at most 0.3003 sum_i beta_i sum rho width; no more is claimed.
    Smoothed after Slotine and Li, "Applied Nonlinear Control" (1991), 7.1; docs/laws.md derives the bound.

    Attributes:
        rho_nm: bound of the disturbance per joint, N m (of a sliding joint N).
        width_rad_s: r at which 0.71 of it opposes, per joint, rad/s (m/s).
        friction: share of the joints' own friction that the law knows, 0: nothing.
    """

    rho_nm: fields.NotNegativeJoints = (1.0,)
    width_rad_s: fields.PositiveJoints = (0.1,)
    friction: fields.NotNegative = 0.0

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core."""
        return AdaptiveBox.gains(self, theta)._replace(
            rho=self.rho_nm, width=self.width_rad_s, friction=(self.friction,)
        )

    def condition(self, situation: LawSituation) -> StabilityCondition:
        """Returns the bound in the mean square, W, of this site's part of what V dissipates."""
        pairs = zip(self.rho_nm, self.width_rad_s, strict=True)
        bound_w = ROBUST_RESIDUE * sum(rho * width for rho, width in pairs)
        constant = not np.isnan(situation.longest_s)
        return StabilityCondition(
            True if constant else None,
            f"delays are {'constant' if constant else 'to be constant, and vary here'}, theta is in its box: "
            f"with torque of at most rho_nm that no estimate explains the mean of beta times r'Kp r and the "
            f"disagreement is at most beta times {bound_w:.3g} W here; sufficient",
        )


class KnownGravity(fields.Frozen, frozen=True):
    """A law of known gravity; a subclass has the key `gravity`, and some of K, Kd, d and k_f."""

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core, for an arm of parameters theta."""
        gains = asdict(self)
        known = theta * gains.pop("gravity")
        return Gains(Law.KNOWN, known=known.tolist(), **gains)


class ProportionalDamped(KnownGravity, frozen=True, tag_field="law", tag="p_d"):
    """P+d with known gravity: tau = G(q) - K e - d qd.

    For reversible shares, equal gains and one constant delay T the linearised loop of N sites is stable
    whatever the masses if d > max(abs(lambda_min(alpha)), 0.2172) K T, and for some masses only then; two
    sites need 4 d_1 d_2 > (T_1 + T_2)^2 K_1 K_2. For other shares some heavy arms are unstable at any d. That
    is in continuous time: held torques need more (docs/laws.md).

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: fields.PositiveCoordinates = (10.0,)
    d: fields.NotNegativeJoints = (3.0,)
    gravity: fields.NotNegative = 1.0


class ProportionalDerivativeDamped(KnownGravity, frozen=True, tag_field="law", tag="pd_d"):
    """PD+d with known gravity: tau = G(q) - K e - Kd ed - d qd.

    For constant delays, and Kd / K alike at all sites, the condition of P+d on K and d is sufficient.

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: fields.PositiveCoordinates = (10.0,)
    Kd: fields.NotNegativeCoordinates = (3.0,)
    d: fields.NotNegativeJoints = (5.0,)
    gravity: fields.NotNegative = 1.0


class ForceReflecting(KnownGravity, frozen=True, tag_field="law", tag="p_f"):
    """Direct force reflection with known gravity: tau = G(q) - K e - d qd + k_f felt.

    `felt` is the torque of operators and environments on the peers' arms as received, weighted by dominance.
    A slave has K and k_f = 0, a master K = 0 and k_f. It is stable in free motion; for any passive operator
    and wall the master needs d >= k_f (2 K T + d_s)^2 / (4 d_s), K and d_s of the slave. It is for one master
    and one slave.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        k_f: gain of the reflected force, per joint, dimensionless.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: fields.NotNegativeCoordinates = (0.0,)
    d: fields.NotNegativeJoints = (5.0,)
    k_f: fields.NotNegativeCoordinates = (0.0,)
    gravity: fields.NotNegative = 1.0

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns that a site with neither gain follows nobody."""
        return "" if any(self.K) or any(self.k_f) else "K = 0 and k_f = 0 follow nobody"


class LeeSpong(fields.Frozen, frozen=True, tag_field="law", tag="lee_spong"):
    """PD+d under its published bound: d = K T_max + P_e for delays up to T_max.

    Lee and Spong, "Passive bilateral teleoperation with constant time delay", IEEE T-RO 22, 2006.

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        T_max_ms: half of the longest round trip, ms.
        P_e: damping beyond what the delay needs, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: fields.PositiveCoordinates = (10.0,)
    Kd: fields.NotNegativeCoordinates = (3.0,)
    T_max_ms: fields.NotNegative = 200.0
    P_e: fields.NotNegativeJoints = (0.0,)
    gravity: fields.NotNegative = 1.0

    @property
    def damping(self) -> tuple[float, ...]:
        """The damping d per joint, N m s/rad."""
        return tuple(
            stiff * 1e-3 * self.T_max_ms + extra for stiff, extra in zip(self.K, self.P_e, strict=True)
        )

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core: those of PD+d."""
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, Kd=self.Kd, d=self.damping, known=known)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d on K and d."""
        return judge_position_exchange(situation, "K", "damping")


KnownGravityLaw = ProportionalDamped | ProportionalDerivativeDamped | ForceReflecting | LeeSpong
PluggedLaws = (
    plugged_laws.FourChannels
    | plugged_laws.SixChannels
    | plugged_laws.SaturatedPositions
    | plugged_laws.Authority
    | plugged_laws.Synchronised
    | plugged_laws.UnknownLengths
    | plugged_laws.Impedances
    | plugged_laws.SmithPredicted
)
EnergyLaws = WaveVariables | PassivityControl | EnergyTanks
ControlLaw = (
    Adaptive | AdaptiveBox | AdaptiveRobust | KnownGravityLaw | PluggedLaws | EnergyLaws | ImportedLaw
)


def identify_law(law: Any) -> str:
    """Returns what a scenario calls a law; an imported one as in "package.module:Law"."""
    return law.code if isinstance(law, ImportedLaw) else str(law.__struct_config__.tag)


LAWS: dict[str, type[fields.Frozen]] = {str(law.__struct_config__.tag): law for law in get_args(ControlLaw)}
"""The laws by name."""

"""The control laws that a scenario can choose, and their gains.

Law: each says where it is from and when it is stable; where that condition is only sufficient, it says so.
Symbols are the paper's; gains are diagonal, one number per joint or parameter.
"""

from ..core.arm import Array
from ..core.setup import Gains, Law
from .frozen import Frozen
from .own_law import Own
from .quantities import (
    LARGEST,
    NotNegative,
    NotNegativeJoints,
    NotNegativeParameters,
    Parameters,
    PositiveJoints,
)


class Adaptive(Frozen, frozen=True, tag_field="law", tag="adaptive"):
    """The paper's adaptive law, Eq. (13) and (15).

    Stable for any constant delays while nobody pushes, if the dominance matrix is irreducible and the Kd of
    all sites are one matrix but for a scalar each (the paper's theorem with the weights of docs/errata.md).
    That is sufficient; what delays that vary do is another question.

    Gamma = 0 and theta_hat0 = theta make the law of known parameters; Kd = 0 takes the error's damping out.

    Attributes:
        Lambda: per joint, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
    """

    Lambda: PositiveJoints = (1.0, 1.0)
    Kp: PositiveJoints = (1.0, 1.0)
    Kd: NotNegativeJoints = (3.0, 3.0)
    Gamma: NotNegativeParameters = (1.0,) * 5
    theta_hat0: Parameters = (0.0,) * 5

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.ADAPTIVE, self.Lambda, self.Kp, self.Kd, self.Gamma, self.theta_hat0)


class AdaptiveBox(Frozen, frozen=True, tag_field="law", tag="adaptive_box"):
    """The paper's law with every estimate held in a box.

    A box that holds the truth strictly inside leaves V' <= 0 and takes away the spring by which learning
    gravity ties the arms to a pose. Projection after Ioannou and Sun, "Robust Adaptive Control" (1996), 4.4.

    Attributes:
        Lambda: per joint, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
        theta_low: least that each estimate may be.
        theta_high: most that it may be.
    """

    Lambda: PositiveJoints = (1.0, 1.0)
    Kp: PositiveJoints = (1.0, 1.0)
    Kd: NotNegativeJoints = (3.0, 3.0)
    Gamma: NotNegativeParameters = (1.0,) * 5
    theta_hat0: Parameters = (0.0,) * 5
    theta_low: Parameters = (-LARGEST,) * 5
    theta_high: Parameters = (LARGEST,) * 5

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(
            Law.ADAPTIVE,
            self.Lambda,
            self.Kp,
            self.Kd,
            self.Gamma,
            self.theta_hat0,
            self.theta_low,
            self.theta_high,
        )


class ProportionalDamped(Frozen, frozen=True, tag_field="law", tag="p_d"):
    """P+d with known gravity: tau = G(q) - K e - d qd.

    For equal gains and one constant delay T the linearised loop of N sites is stable if and only if
    d > abs(lambda_min(alpha)) K T; two sites need 4 d_1 d_2 > (T_1 + T_2)^2 K_1 K_2.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0, 10.0)
    d: NotNegativeJoints = (3.0, 3.0)
    gravity: NotNegative = 1.0

    def gains(self, theta: Array) -> Gains:
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, known=(theta * self.gravity).tolist(), K=self.K, d=self.d)


class ProportionalDerivativeDamped(Frozen, frozen=True, tag_field="law", tag="pd_d"):
    """PD+d with known gravity: tau = G(q) - K e - Kd ed - d qd.

    For constant delays the condition of P+d on K and d is sufficient (its source).

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0, 10.0)
    Kd: NotNegativeJoints = (3.0, 3.0)
    d: NotNegativeJoints = (5.0, 5.0)
    gravity: NotNegative = 1.0

    def gains(self, theta: Array) -> Gains:
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, Kd=self.Kd, known=(theta * self.gravity).tolist(), K=self.K, d=self.d)


class ForceReflecting(Frozen, frozen=True, tag_field="law", tag="p_f"):
    """Direct force reflection with known gravity: tau = G(q) - K e - d qd + k_f felt.

    `felt` is the torque of hands and environments on the peers' arms as it came over the links, weighted by
    dominance. A slave has K and k_f = 0, a master K = 0 and k_f. In free motion it is calm; in contact no
    damping makes it stable for every stiffness and delay: the classic that contact separates. It is for one
    master and one slave.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        k_f: share of what the peers feel, per joint.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: NotNegativeJoints = (0.0, 0.0)
    d: NotNegativeJoints = (5.0, 5.0)
    k_f: NotNegativeJoints = (0.0, 0.0)
    gravity: NotNegative = 1.0

    def gains(self, theta: Array) -> Gains:
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, known=(theta * self.gravity).tolist(), K=self.K, d=self.d, k_f=self.k_f)


Control = Adaptive | AdaptiveBox | ProportionalDamped | ProportionalDerivativeDamped | ForceReflecting | Own
LAWS: dict[str, type[Frozen]] = {
    "adaptive": Adaptive,
    "adaptive_box": AdaptiveBox,
    "p_d": ProportionalDamped,
    "pd_d": ProportionalDerivativeDamped,
    "p_f": ForceReflecting,
    "own": Own,
}
"""The laws by their names."""

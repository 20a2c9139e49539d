"""Built-in control laws that are plugged into the core as one class each: their gains and their conditions.

Invariant: as for the laws of `laws.py`. A law whose small motions are those of a law of known gravity says
so by `linear_gains`, so that `trilat linear` and `trilat ports` have it.
"""

import numpy as np

from ..core.laws.four_channel import FourChannel, SixChannel
from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from .fields import Joints, NotNegative, NotNegativeJoints, PositiveJoints, Share
from .imported_law import PluggedLaw
from .law_conditions import LawSituation, StabilityCondition

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

    K: PositiveJoints = (100.0,)
    B: NotNegativeJoints = (20.0,)
    force_peer: Joints = (1.0,)
    force_own: Joints = (0.0,)
    acceleration: Share = 0.0
    gravity: NotNegative = 1.0

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the same law as one of known gravity, which has neither qdd nor the arm's own torque."""
        if self.acceleration or any(self.force_own):
            return None
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, Kd=self.B, d=(0.0,), k_f=self.force_peer, known=known)

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


def complementary_shares(a: float) -> Array:
    """Returns the dominance matrix of user 1, user 2 and slave for the factor a."""
    return np.array([[0.0, 1.0 - a, a], [a, 0.0, 1.0 - a], [a, 1.0 - a, 0.0]])


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Returns beta of the same three: at rest, sum beta_i tau_h,i = 0."""
    return 1.0 - (1.0 - a) ** 2, 1.0 - a**2, 1.0 - a * (1.0 - a)

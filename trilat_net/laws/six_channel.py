"""The four-channel law of two users and a slave, whose dominance is one factor a."""

from typing import ClassVar

import numpy as np

from ..core.vectors import Array
from .conditions import LawSituation, StabilityCondition
from .four_channel import FourChannel


class SixChannel(FourChannel):
    """The four-channel law of two users and a slave whose dominance is one factor a.

    The sites are user 1, user 2 and slave, in this order. User 1 follows the slave by a and
    user 2 by 1 - a, user 2 the slave by 1 - a and user 1 by a, the slave user 1 by a and user 2
    by 1 - a. After Khademian and Hashtrudi-Zaad, IEEE/ASME T-Mech 17, 2012.
    """

    sites: ClassVar = 3

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the factor and the weights of torques at rest; more is not decided here."""
        a = float(situation.alpha[2, 0])
        if not np.allclose(situation.alpha, complementary_shares(a)):
            text = "the shares are not those of one factor: see six_channel in docs/laws.md"
            return StabilityCondition(False, text)
        beta = ", ".join(f"{weight:.4g}" for weight in complementary_weights(a))
        found = FourChannel.condition(self, situation)
        text = f"factor a = {a:g}, weights beta = ({beta}); {found.text if found else ''}"
        return StabilityCondition(found.holds if found else None, text)


def complementary_shares(a: float) -> Array:
    """Returns the dominance matrix of user 1, user 2 and slave for the factor a."""
    return np.array([[0.0, 1.0 - a, a], [a, 0.0, 1.0 - a], [a, 1.0 - a, 0.0]])


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Returns beta of the same three: at rest, sum beta_i tau_h,i = 0."""
    return 1.0 - (1.0 - a) ** 2, 1.0 - a**2, 1.0 - a * (1.0 - a)

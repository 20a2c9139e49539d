"""The four-channel law of two users and a slave whose dominance is given by one factor a.

The law changes nothing in the torque of `FourChannel`; it only requires the shares of this
factor.
"""

from typing import ClassVar

import numpy as np

from ..core.vectors import Array
from .conditions import LawSituation, StabilityCondition
from .four_channel import FourChannel


class SixChannel(FourChannel):
    """The four-channel law of two users and a slave whose dominance is one factor a.

    The sites are user 1, user 2 and the slave, in this order. User 1 follows the slave with
    weight a and user 2 with 1 - a. User 2 follows the slave with 1 - a and user 1 with a. The
    slave follows user 1 with a and user 2 with 1 - a.

    Source: Khademian and Hashtrudi-Zaad, IEEE/ASME T-Mech 17, 2012.
    """

    sites: ClassVar = 3

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the factor, the weights at rest, and the four-channel condition."""
        a = float(situation.alpha[2, 0])
        if not np.allclose(situation.alpha, complementary_shares(a)):
            text = "the shares are not those of one factor: see six_channel in docs/laws.md"
            return StabilityCondition(False, text)
        beta = ", ".join(f"{weight:.4g}" for weight in complementary_weights(a))
        condition = FourChannel.condition(self, situation)
        text = f"factor a = {a:g}, weights beta = ({beta}); "
        if condition is None:
            return StabilityCondition(None, text)
        return StabilityCondition(condition.holds, text + condition.text)


def complementary_shares(a: float) -> Array:
    """Returns the dominance matrix of user 1, user 2 and the slave for the factor a."""
    user_1 = (0.0, 1.0 - a, a)
    user_2 = (a, 0.0, 1.0 - a)
    slave = (a, 1.0 - a, 0.0)
    return np.array([user_1, user_2, slave])


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Returns beta of user 1, user 2 and the slave: at rest, sum beta_i tau_h,i = 0."""
    user_1 = 1.0 - (1.0 - a) ** 2
    user_2 = 1.0 - a**2
    slave = 1.0 - a * (1.0 - a)
    return user_1, user_2, slave

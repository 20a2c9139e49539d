"""Implements the four-channel law of two users and a slave, with a single dominance factor a.

A dominance factor is the weight with which a site, a process that runs one arm, follows a peer.
The dominance matrix of a scenario (the file that describes an experiment) contains these
weights, one row per site. The torque is computed as in `FourChannel`. In addition, this law
requires that all weights in the matrix follow from the one factor a.
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
        """Returns the stability condition of the four-channel law for these sites.

        Its text starts with the dominance factor a of user 1, and with the weights with which
        the torques of the operators are in balance at rest. If the dominance matrix does not
        follow from one factor a, the condition is not met.

        Args:
            situation: The sites and their dominance matrix.
        """
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
    """Returns the dominance matrix of user 1, user 2 and the slave for the factor a.

    Row i contains the weights with which site i follows the other sites; the class `SixChannel`
    lists them.

    Args:
        a: Weight of user 1, from 0 to 1.

    Returns:
        The matrix, shape (3, 3).
    """
    user_1 = (0.0, 1.0 - a, a)
    user_2 = (a, 0.0, 1.0 - a)
    slave = (a, 1.0 - a, 0.0)
    return np.array([user_1, user_2, slave])


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Returns the weights with which the operators' torques are in balance at rest.

    With the weights beta of the sites, sum beta_i tau_h,i = 0, where tau_h,i is the torque of
    the operator at site i.

    Args:
        a: Weight of user 1, from 0 to 1.

    Returns:
        The weights of user 1, user 2 and the slave.
    """
    user_1 = 1.0 - (1.0 - a) ** 2
    user_2 = 1.0 - a**2
    slave = 1.0 - a * (1.0 - a)
    return user_1, user_2, slave

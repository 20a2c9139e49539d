"""Control law with which two users share one slave arm, governed by a single factor a.

The factor a is the authority of user 1, and user 2 has the authority 1 - a. For a = 0.5, both
users have equal influence on the slave. All dominance factors of the three arms are determined
by a (see `DominanceMatrix.complementary`).

The torque is that of the four-channel law, which exchanges positions and forces
(`FourChannel`). In addition, this law checks that the dominance factors of a scenario are
consistent with a single factor a.
"""

from typing import ClassVar

import numpy as np

from ..core import DominanceMatrix
from .conditions import LawSituation, StabilityCondition
from .four_channel import FourChannel


class SixChannel(FourChannel):
    """Lets two users share a slave arm according to a single factor a, the authority of user 1.

    The arms exchange positions and forces as in `FourChannel`. The sites must be listed as user
    1, user 2, slave. The slave follows user 1 with the weight a and user 2 with 1 - a. User 1
    follows the slave with the weight a and user 2 with 1 - a. User 2 follows the slave with the
    weight 1 - a and user 1 with a.

    Source: Khademian and Hashtrudi-Zaad, IEEE/ASME T-Mech 17, 2012.
    """

    sites: ClassVar = 3

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates the stability condition of the four-channel law for two users and a slave.

        The sites must be listed as user 1, user 2, slave. All dominance factors must be
        consistent with a single factor a, the authority of user 1 (see
        `DominanceMatrix.complementary`).

        Args:
            situation: The three sites and the dominance factors. Row i of `alpha` contains the
                weights that site i gives to the others.

        Returns:
            If the dominance factors are not consistent with a single factor, a condition that
            is not satisfied. Otherwise the condition of the four-channel law, which may be
            undecided. Its text begins with the value of a and the weights beta with which the
            external torques on the arms add up to zero at rest.
        """
        if len(situation.alpha) != 3:
            return StabilityCondition(False, "this law is for two users and a slave")
        user_1 = 0
        slave = 2
        a = float(situation.alpha[slave, user_1])  # the slave follows user 1 with the weight a
        expected_shares = DominanceMatrix.complementary(a).alpha
        if not np.allclose(situation.alpha, expected_shares):
            text = (
                "the shares are not those of one factor: see six_channel in "
                "docs/reference/laws-forces.md"
            )
            return StabilityCondition(False, text)

        weights = complementary_weights(a)
        beta = ", ".join(f"{weight:.4g}" for weight in weights)
        prefix = f"factor a = {a:g}, weights beta = ({beta}); "
        condition = FourChannel.condition(self, situation)
        if condition is None:
            return StabilityCondition(None, prefix)
        return StabilityCondition(condition.holds, prefix + condition.text)


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Computes the weights beta with which the external torques add up to zero at rest.

    While all arms rest, sum_i beta_i tau_i = 0, where tau_i is the external torque on arm i, in
    N m.

    The weights follow from the dominance matrix A (see `DominanceMatrix.complementary`). At
    rest, springs balance the external torques: tau = K (q - A q), where K is the stiffness and
    q are the positions. Therefore beta satisfies beta A = beta, that is,

        beta_1 = a beta_2 + a beta_3
        beta_2 = (1 - a) beta_1 + (1 - a) beta_3
        beta_3 = a beta_1 + (1 - a) beta_2

    The vector is determined up to a factor, and is not normalised here.

    Args:
        a: Authority of user 1, from 0 to 1.

    Returns:
        The weights of user 1, user 2 and the slave, dimensionless.
    """
    user_1 = 1.0 - (1.0 - a) ** 2
    user_2 = 1.0 - a**2
    slave = 1.0 - a * (1.0 - a)
    return user_1, user_2, slave

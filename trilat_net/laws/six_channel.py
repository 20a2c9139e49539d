"""Implements a control law in which two users share one slave arm by a single factor a.

The factor a is the authority of user 1, and user 2 has the authority 1 - a. For a = 0.5, both
users lead the slave equally. The factor determines the weights with which each arm follows the
other two, which are called dominance factors: `complementary_shares` computes them.

The torque is computed by the four-channel law, which exchanges positions and forces
(`FourChannel`). This law adds the check that the weights in a scenario, the description of an
experiment, follow from one factor a.
"""

from typing import ClassVar

import numpy as np

from ..core import Array
from .conditions import LawSituation, StabilityCondition
from .four_channel import FourChannel


class SixChannel(FourChannel):
    """Lets two users share a slave arm by a single factor a, their authority.

    The arms exchange positions and forces as in `FourChannel`. The sites, the processes that
    run one arm each, are user 1, user 2 and the slave, in this order. The slave follows user 1
    with the weight a and user 2 with 1 - a. User 1 follows the slave with the weight a and user
    2 with 1 - a. User 2 follows the slave with the weight 1 - a and user 1 with a.

    Source: Khademian and Hashtrudi-Zaad, IEEE/ASME T-Mech 17, 2012.
    """

    sites: ClassVar = 3

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates the stability condition of the four-channel law for two users and a slave.

        The sites, the processes that run one arm each, are user 1, user 2 and the slave, in
        this order. All dominance factors, the weights with which the arms follow each other,
        must follow from one number a, the authority of user 1 (see `complementary_shares`).

        Args:
            situation: The three sites and the dominance factors: row i of `alpha` contains the
                weights with which site i follows the others.

        Returns:
            A condition that is not met if the dominance factors do not follow from one number.
            Otherwise the condition of the four-channel law, which may be undecided. Its text
            then begins with a, and with the weights beta with which the torques of the
            operators add up to zero at rest.
        """
        if len(situation.alpha) != 3:
            return StabilityCondition(False, "this law is for two users and a slave")
        user_1 = 0
        slave = 2
        a = float(situation.alpha[slave, user_1])  # the slave follows user 1 with the weight a
        expected_shares = complementary_shares(a)
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


def complementary_shares(a: float) -> Array:
    """Computes all dominance factors of two users and a slave from the single factor a.

    A dominance factor is the weight with which an arm follows another arm. The slave follows
    user 1 with the weight a and user 2 with 1 - a. User 1 follows user 2 with 1 - a and the
    slave with a. User 2 follows user 1 with a and the slave with 1 - a.

    Args:
        a: Authority of user 1, from 0 to 1. User 2 has 1 - a.

    Returns:
        Matrix of shape (3, 3). Row i contains the weights with which arm i follows the others,
        in the order user 1, user 2, slave.
    """
    user_1 = (0.0, 1.0 - a, a)
    user_2 = (a, 0.0, 1.0 - a)
    slave = (a, 1.0 - a, 0.0)
    return np.array([user_1, user_2, slave])


def complementary_weights(a: float) -> tuple[float, float, float]:
    """Computes the weights beta with which the operators' torques add up to zero at rest.

    While all arms rest, sum_i beta_i tau_i = 0, where tau_i is the torque of the operator or
    environment on arm i, in N m.

    The weights follow from the matrix A of the dominance factors (`complementary_shares`),
    whose row i contains the weights with which arm i follows the others. At rest, springs
    balance the torques, tau = K (q - A q), where K is the stiffness and q the positions.
    Therefore beta is a vector with beta A = beta, written out

        beta_1 = a beta_2 + a beta_3
        beta_2 = (1 - a) beta_1 + (1 - a) beta_3
        beta_3 = a beta_1 + (1 - a) beta_2

    Such a vector may be multiplied by any number; here it is not scaled to a certain sum.

    Args:
        a: Authority of user 1, from 0 to 1.

    Returns:
        The weights of user 1, user 2 and the slave, dimensionless.
    """
    user_1 = 1.0 - (1.0 - a) ** 2
    user_2 = 1.0 - a**2
    slave = 1.0 - a * (1.0 - a)
    return user_1, user_2, slave

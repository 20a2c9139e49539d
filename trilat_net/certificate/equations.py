"""What the equations of a site are made of: its gains and its arm, as the books need them.

Law: a site has a functional where its law is the paper's and its arm is known; elsewhere there is none.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..core.setup import Law
from ..scenario import SiteSpec


class Equations(NamedTuple):
    """A site's constants; vectors per joint have shape (2,), per parameter (5,).

    Attributes:
        theta: the arm's true parameters.
        g: gravitational acceleration, m/s^2.
        Lambda: 1/s.
        Kp: N m s/rad.
        Kd: N m s/rad.
        Gamma: adaptation gain.
        low: least that each estimate may be.
        high: most.
        tau_limit: largest torque of a joint, N m.
    """

    theta: Array
    g: float
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    low: Array
    high: Array
    tau_limit: float


def equations(spec: SiteSpec) -> Equations:
    """Returns the constants of a site whose law is the paper's, with a box or without."""
    gains = spec.control.gains(spec.arm.theta)
    return Equations(
        spec.arm.theta,
        spec.arm.g_m_s2,
        np.array(gains.Lambda),
        np.array(gains.Kp),
        np.array(gains.Kd),
        np.array(gains.Gamma),
        np.array(gains.low),
        np.array(gains.high),
        spec.limits.tau_limit_nm,
    )


def without_functional(spec: SiteSpec) -> str:
    """Says why a site has no functional; "" where it has one."""
    if spec.plant == "external":
        return "an arm outside of the program: theta is unknown"
    theta = spec.arm.theta
    if spec.control.gains(theta).law is not Law.ADAPTIVE:
        return "a law that is not the paper's: there is no such functional for it"
    return ""

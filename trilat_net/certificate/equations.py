"""What the equations of a site are made of: its gains and its arm, as the books need them.

Law: a site has a functional where its law is the paper's and its arm's theta is known; elsewhere there is
none.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..scenario import SiteSpec
from ..scenario.laws import LAWS, Adaptive, AdaptiveBox


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
        outside: whether the arm is outside of the program: theta is then what its author says of it.
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
    outside: bool = False


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
        spec.plant == "external",
    )


def without_functional(spec: SiteSpec) -> str:
    """Says why a site has no functional; "" where it has one."""
    if not spec.arm.known:
        return "nobody knows the arm's theta, and V is made of it"
    if not isinstance(spec.control, Adaptive | AdaptiveBox):
        name = next(name for name, kind in LAWS.items() if isinstance(spec.control, kind))
        return f"law {name}, for which there is no such V"
    return ""

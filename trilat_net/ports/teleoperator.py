"""The teleoperator alone: the loop with hands and environments taken off, at the rest that they hold it in.

Law: what acted on an arm at the rest goes on acting, as a constant torque; only its stiffness and damping are
gone. So a pose that hands hold can be asked what another hand would feel there.
"""

import numpy as np

from ..certificate.weights import weights
from ..core.arm import JOINTS, Array
from ..core.exogenous import Actor, Acts
from ..core.setup import Law
from ..linear.conditions import Conditions
from ..linear.loop import Loop, Rest, arguments, loop_of
from .port import Output


def hands_off(now: Conditions, rest: Rest) -> Conditions:
    """Returns the conditions with the torque of hands and environments held at what it is at the rest.

    Args:
        now: what the loop is made of.
        rest: where it is linearised.
    """
    x = arguments(now, rest)
    sites = []
    for i, site in enumerate(now.sites):
        found = now.rates(i, x[i])
        torque = tuple((found.acted + found.held).tolist())
        sites.append(site._replace(actors=(Actor(Acts.RECORDED, a=torque),) if any(torque) else ()))
    return now._replace(sites=tuple(sites))


def teleoperator(now: Conditions, rest: Rest) -> Loop:
    """Returns the loop that hands and environments meet at their ports.

    Args:
        now: what the loop is made of.
        rest: where it is linearised.
    """
    return loop_of(hands_off(now, rest), rest)


def proof_output(now: Conditions, loop: Loop) -> Output | None:
    """Returns how r_i = qd_i + Lambda (q_i - sum_j alpha_ij q_j(t - T_ij)), Eq. (6), (9), (10), is read off.

    Args:
        now: what the loop is made of.
        loop: the loop.

    Returns:
        None where a site has another law than the paper's, which has no r.
    """
    if any(site.gains.law is not Law.ADAPTIVE for site in now.sites):
        return None
    C, late = (
        loop.C.copy(),
        {float(delay_s): np.zeros_like(loop.C) for delay_s in now.age_s[now.alpha != 0.0]},
    )
    for i, site in enumerate(now.sites):
        for joint in range(JOINTS):
            row = JOINTS * i + joint
            C[row, _angle(loop, site.name, joint)] += site.gains.Lambda[joint]
            for j in np.flatnonzero(now.alpha[i]):
                seen = site.gains.Lambda[joint] * now.alpha[i, j]
                late[float(now.age_s[i, j])][row, _angle(loop, now.sites[j].name, joint)] -= seen
    return Output(C, tuple(sorted(late.items())))


def _angle(loop: Loop, site: str, joint: int) -> int:
    return loop.names.index(f"{site}.q{joint + 1}")


def proof_weights(now: Conditions) -> Array:
    """Returns beta_i = pi_i / c_i of the corrected proof (docs/errata.md), sum N, shape (N,).

    Args:
        now: what the loop is made of.
    """
    return weights(now.alpha, np.array([site.gains.Kd for site in now.sites])).beta

"""Base parameters of a chain, and the physical consistency of estimates.

Invariant: torques determine some linear combinations of a chain's ten parameters a link and nothing of the
rest, however it moves; adaptation moves estimates along the former alone. An error of estimates is stated in
those combinations. Which they are follows from the geometry: QR of regressors of many states, stacked, column
by column: a column that depends on those before it adds nothing, and its parameter joins theirs.

Source: M. Gautier, "Numerical calculation of the base inertial parameters of robots", J. Robotic Systems 8
(1991), for the QR; P. M. Wensing, S. Kim, J.-J. Slotine, "Linear matrix inequalities for physically
consistent inertial parameter identification", IEEE Robotics and Automation Letters 3 (2018), for the
pseudo-inertia.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.chain import LINK_PARAMETERS
from ..core.site_setup import ChainSetup
from ..core.vectors import Array
from .arm_rows import ArmRows, ChainArmRows

DEPENDENT_SHARE = 1e-9
"""A column of which a smaller share is independent of those before it depends on them."""


class BaseParameters(NamedTuple):
    """Combinations of parameters that torques determine.

    Attributes:
        kept: per combination the parameter that it is named after, in ascending order, shape (B,).
        combination: its factors of all parameters, 1 of its own, shape (B, P): base = combination theta.
    """

    kept: NDArray[np.int64]
    combination: Array


def stack_regressors(arm: ChainArmRows, states: int) -> Array:
    """Returns regressors of so many random states, one below the other, shape (states n, 10 n)."""
    random, (n, count) = np.random.default_rng(1), (len(arm.chain.joints), len(arm.theta))
    q = random.uniform(-np.pi, np.pi, (states, n))
    qd, a = random.normal(size=(2, states, n))
    each = np.repeat(np.arange(states), count)
    columns = np.tile(np.eye(count), (states, 1))
    torque = arm.without_drives().law_torque(columns, q[each], qd[each], qd[each], a[each])
    return torque.reshape(states, count, n).transpose(0, 2, 1).reshape(-1, count)


@lru_cache(maxsize=64)
def _find_base_parameters(chain: ChainSetup, learnt: tuple[bool, ...]) -> BaseParameters:
    arm = ChainArmRows(np.zeros(len(learnt)), chain)
    W = stack_regressors(arm, 4 * LINK_PARAMETERS)[:, list(learnt)]
    places = np.flatnonzero(learnt)
    Q = np.zeros((len(W), 0))
    kept = []
    for p, column in enumerate(W.T):
        rest = column - Q @ (Q.T @ column)
        rest -= Q @ (Q.T @ rest)  # once more: the first leaves rounding of the size of the column
        size = float(np.linalg.norm(rest))
        if size > DEPENDENT_SHARE * float(np.linalg.norm(W)) / np.sqrt(W.shape[1]):
            Q = np.column_stack([Q, rest / size])
            kept.append(p)
    factors = np.linalg.lstsq(W[:, kept], W, rcond=None)[0]
    combination = np.zeros((len(kept), len(learnt)))
    combination[:, places] = np.where(np.abs(factors) > DEPENDENT_SHARE, factors, 0.0)
    combination[:, places[kept]] = np.eye(len(kept))
    return BaseParameters(places[kept], combination)


def find_base_parameters(arm: ArmRows, learnt: NDArray[np.bool_]) -> BaseParameters:
    """Returns the combinations of the parameters that are learnt, shape (P,).

    The five parameters of the planar arm are base parameters already, each by itself.
    """
    if isinstance(arm, ChainArmRows):
        return _find_base_parameters(arm.chain, tuple(learnt.tolist()))
    kept = np.flatnonzero(learnt)
    return BaseParameters(kept, np.eye(len(learnt))[kept])


def find_pseudo_inertias(theta: Array) -> Array:
    """Returns the pseudo-inertia of every link, shape (n, 4, 4): [[S, m c], [m c', m]], S = tr(I) 1/2 - I."""
    links = theta.reshape(-1, LINK_PARAMETERS)
    found = np.zeros((len(links), 4, 4))
    found[:, 3, 3] = links[:, 0]
    found[:, :3, 3] = found[:, 3, :3] = links[:, 1:4]
    xx, xy, yy, xz, yz, zz = links[:, 4:].T
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    half = 0.5 * (xx + yy + zz)
    found[:, :3, :3] = half[:, np.newaxis, np.newaxis] * np.eye(3) - inertia
    return found


def find_consistent_links(theta: Array) -> list[bool]:
    """Returns for each link if some body has these parameters: its pseudo-inertia is positive definite."""
    return [bool(values.min() > 0.0) for values in np.linalg.eigvalsh(find_pseudo_inertias(theta))]

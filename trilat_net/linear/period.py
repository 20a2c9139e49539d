"""One site over one period: what it carries from tick to tick, linearised.

Law: the arm is exact between ticks under what is held; the controller does what the stages of a tick do, in
their order.

`second_order`: theta_k = theta_{k-1} + h/2 (f_{k-1} + f_k) with f the rate of the estimate, and the arm is
moved by 1.5 tau_k - 0.5 tau_{k-1}. With eta_k = theta_{k-1} + h/2 f_{k-1} that is theta_k = eta_k + h/2 f_k
and eta_{k+1} = eta_k + h f_k. `digital`: theta_k = eta_k, eta_{k+1} = eta_k + h f_k, and the arm is moved by
tau_k.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import JOINTS, PARAMETERS, Array
from ..core.setup import Scheme, SiteSetup
from .exponential import over_period
from .field import ARGUMENTS, ESTIMATE, FELT, PUSH, Q_DES, QD, Q, Rates, adapts

MOVES = slice(Q.start, QD.stop)
"""Angles and velocities, in a site's arguments and in its X alike."""
HEARD = slice(Q_DES.start, FELT.stop)
"""What a site hears of its peers, among its arguments: q_id, its derivative, felt."""
HEARD_NUMBERS = HEARD.stop - HEARD.start


class Period(NamedTuple):
    """One site over a period: X' = P X + Q w, where w is what it hears of its peers.

    Attributes:
        P: shape (n, n); X is q, qd, eta of its estimate, and, of `second_order`, the torque before.
        Q: shape (n, 6).
        sent: what its peers hear of it, shape (6, n): q, qd, and the torque on its arm.
        names: of its states.
    """

    P: Array
    Q: Array
    sent: Array
    names: tuple[str, ...]


class _Made(NamedTuple):
    """What a controller makes of its arguments: torque on the arm, what it learns, the torque of its law."""

    u: Array
    learnt: Array
    tau: Array


def period_of(site: SiteSetup, rates: Rates, h_s: float) -> Period:
    """Returns one site over a period.

    Args:
        site: what it is built from.
        rates: the derivatives of its rates, see `field.jacobian`.
        h_s: the period, s.
    """
    second = site.scheme is Scheme.SECOND_ORDER
    memory = slice(QD.stop, QD.stop + (PARAMETERS if adapts(site) else 0))
    n = memory.stop + (JOINTS if second else 0)
    own, heard = np.zeros((ARGUMENTS, n)), np.zeros((ARGUMENTS, HEARD_NUMBERS))
    own[MOVES, MOVES] = np.eye(QD.stop)
    own[ESTIMATE, memory] = np.eye(PARAMETERS)[:, : memory.stop - memory.start]
    heard[HEARD] = np.eye(HEARD_NUMBERS)
    Phi, Gamma = _arm(rates, h_s)
    P, Q = (
        _stacked(_made(rates, by, h_s, second=second), Gamma, memory, second=second) for by in (own, heard)
    )
    P[MOVES, MOVES] += Phi
    P[memory, memory] += np.eye(memory.stop - memory.start)
    if second:
        P[MOVES, memory.stop :] -= 0.5 * Gamma
    sent = np.zeros((HEARD_NUMBERS, n))
    sent[: QD.stop, MOVES] = np.eye(QD.stop)
    sent[QD.stop :, MOVES] = (rates.acted + rates.held)[:, MOVES]
    states = ["q1", "q2", "qd1", "qd2", "theta1", "theta2", "theta3", "theta4", "theta5"][: memory.stop]
    states += ["tau1", "tau2"] if second else []
    return Period(P, Q, sent, tuple(f"{site.name}.{state}" for state in states))


def _arm(rates: Rates, h_s: float) -> tuple[Array, Array]:
    """Returns what a period does to (q, qd), and what a torque held over it adds."""
    inverse = rates.qdd[:, PUSH]  # of M
    still = np.zeros((JOINTS, JOINTS))
    own = rates.qdd[:, MOVES] - inverse @ (rates.tau + rates.held)[:, MOVES]
    A = np.block([[still, np.eye(JOINTS)], [own]])
    return over_period(A, np.vstack([still, inverse]), h_s)


def _made(rates: Rates, by: Array, h_s: float, *, second: bool) -> _Made:
    """Returns what the controller makes of its arguments at a tick, which are `by` times something."""
    f = rates.estimate @ by
    if not second:
        tau = rates.tau @ by
        return _Made(tau + rates.held @ by, h_s * f, tau)
    tau = rates.tau @ by + 0.5 * h_s * rates.tau[:, ESTIMATE] @ f
    return _Made(1.5 * tau + rates.held @ by, h_s * f, tau)


def _stacked(made: _Made, Gamma: Array, memory: slice, *, second: bool) -> Array:
    """Returns what the controller adds to X."""
    learnt = made.learnt[: memory.stop - memory.start]
    return np.vstack([Gamma @ made.u, learnt, *([made.tau] if second else [])])

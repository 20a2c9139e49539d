"""The sampled loop, linearised tick by tick: each site over a period of its own rate.

    X_i[k + 1] = P_i X_i[k] + sum_j P_ij X_j[m],    m the sample of j that is in use

Invariant: the arm is exact between ticks under a held torque (zero-order hold); the controller runs its
stages in their order.

`second_order`: theta_k = theta_{k-1} + h/2 (f_{k-1} + f_k) with f the rate of the estimate, and the torque
on the arm is 1.5 tau_k - 0.5 tau_{k-1}. With eta_k = theta_{k-1} + h/2 f_{k-1} that is
theta_k = eta_k + h/2 f_k and eta_{k+1} = eta_k + h f_k. `digital`: theta_k = eta_k,
eta_{k+1} = eta_k + h f_k, and the torque on the arm is tau_k. The memory of a law of one's own is eta: with
h f = m_k - m_{k-1} it is what the law makes of it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from ..core.site_setup import Law, Scheme, SiteSetup
from ..core.vectors import Array
from .characteristic_roots import Pencil, extract_moving_part
from .linear_loop import SiteJacobian, couple_sites, differentiate_rates
from .operating_point import Equilibrium, OperatingConditions


def discretise_zero_order_hold(A: Array, B: Array, h_s: float) -> tuple[Array, Array]:
    """Returns exp(A h) and int_0^h exp(A s) ds B: x' = A x + B u over a period h, s, with u held.

    Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).
    """
    n, m = B.shape
    whole = np.zeros((n + m, n + m))
    whole[:n, :n], whole[:n, n:] = A * h_s, B * h_s
    exponential = expm(whole)
    return exponential[:n, :n], exponential[:n, n:]


class SiteTickMap(NamedTuple):
    """One site over a period: X' = P X + Q w with the input w from its peers.

    Attributes:
        P: shape (n, n); X is q, qd, eta of its estimate, and, with `second_order`, the torque before.
        Q: shape (n, inputs).
        sent: its output to peers, shape (3 m, n), see `SiteJacobian.sent`.
        names: of its states.
    """

    P: Array
    Q: Array
    sent: Array
    names: tuple[str, ...]


def linearise_site_tick(site: SiteSetup, jacobian: SiteJacobian, h_s: float) -> SiteTickMap:
    """Returns one site over a period, from the derivatives of its rates (`differentiate_rates`)."""
    at, rates = jacobian.at, jacobian.rates
    second = site.scheme is Scheme.SECOND_ORDER
    arm, memory = slice(0, at.qd.stop), at.estimate  # places in arguments and in X alike
    n = at.states + (at.joints if second else 0)
    own, peers = (
        np.eye(at.arguments, n),
        np.eye(at.arguments, at.inputs.stop - at.inputs.start, -at.inputs.start),
    )
    own[at.states :] = 0.0
    by_law = np.eye(at.joints) + rates.tau[:, at.external_torque]  # one of one's own may use what it feels
    inverse_inertia = np.linalg.solve(by_law.T, rates.qdd[:, at.external_torque].T).T
    trapezoid = second and site.gains.law is Law.ADAPTIVE
    zero = np.zeros((at.joints, at.joints))
    free = rates.qdd[:, arm] - inverse_inertia @ (rates.tau + rates.held)[:, arm]
    Phi, Gamma = discretise_zero_order_hold(
        np.block([[zero, np.eye(at.joints)], [free]]), np.vstack([zero, inverse_inertia]), h_s
    )

    def control(by: Array) -> Array:
        """Returns the change of X by the controller, whose arguments are `by` times a vector."""
        f = rates.estimate @ by
        tau = rates.tau @ by + (0.5 * h_s * rates.tau[:, memory] @ f if trapezoid else 0.0)
        u = (1.5 if second else 1.0) * tau + rates.held @ by
        return np.vstack([Gamma @ u, h_s * f, *([tau] if second else [])])

    P, Q = control(own), control(peers)
    P[arm, arm] += Phi
    P[memory, memory] += np.eye(at.parameters)
    if second:
        P[arm, memory.stop :] -= 0.5 * Gamma
    sent = np.zeros((3 * at.coordinates, n))
    sent[:, : at.states] = jacobian.sent
    states = (*jacobian.states, *(f"tau{joint + 1}" for joint in range(at.joints) if second))
    return SiteTickMap(P, Q, sent, tuple(f"{site.name}.{state}" for state in states))


class CoupledTicks(NamedTuple):
    """The sites over a period each, and the effect of what one was on what another is a tick later.

    Attributes:
        S: of each site by itself, on the diagonal, shape (n, n).
        effects: of site j on site i, where there is one, shape (n, n) each, by (i, j).
        names: of the states.
        owners: the site that each state is of, shape (n,).
        constant: number of states left out since nothing changes them, or they change nothing.
    """

    S: Array
    effects: dict[tuple[int, int], Array]
    names: tuple[str, ...]
    owners: NDArray[np.int64]
    constant: int


def couple_ticks(conditions: OperatingConditions, rest: Equilibrium) -> CoupledTicks:
    """Returns what moves of the sites over a period of their own rates, and their effects on each other."""
    sites = differentiate_rates(conditions, rest)
    maps = [
        linearise_site_tick(site, own, 1.0 / site.rate_hz)
        for site, own in zip(conditions.sites, sites, strict=True)
    ]
    owners = np.repeat(np.arange(len(maps)), [len(one.P) for one in maps])
    couplings = couple_sites(conditions, rest, sites)
    effects = np.zeros((len(couplings), len(owners), len(owners)))
    for effect, ((i, j), coupling) in zip(effects, couplings.items(), strict=True):
        effect[np.ix_(owners == i, owners == j)] = maps[i].Q @ coupling @ maps[j].sent
    # what moves is told by the changes; the numbers of the pairs stand for their delays
    changes = block_diag(*(one.P for one in maps)) - np.eye(len(owners))
    names = [name for one in maps for name in one.names]
    moving, kept, constant = extract_moving_part(Pencil(changes, np.arange(len(effects)), effects), names)
    pairs = list(couplings)
    return CoupledTicks(
        moving.A + np.eye(len(kept)),
        {pairs[int(n)]: effect for n, effect in zip(moving.delays, moving.Ad, strict=True)},
        kept,
        owners[[names.index(name) for name in kept]],
        constant + sum(one.left_out for one in sites),
    )

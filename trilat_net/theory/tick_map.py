"""The sampled loop, linearised tick by tick, and its roots s = ln(z) / h.

    X_{k+1} = S X_k + sum_d S_d X_{k-d},    z = exp(s h)

Invariant: the arm is exact between ticks under a held torque (zero-order hold); the controller runs its
stages in their order; a sample of tick m is in use d = max(1, ceil(T / h)) ticks later.

`second_order`: theta_k = theta_{k-1} + h/2 (f_{k-1} + f_k) with f the rate of the estimate, and the torque
on the arm is 1.5 tau_k - 0.5 tau_{k-1}. With eta_k = theta_{k-1} + h/2 f_{k-1} that is
theta_k = eta_k + h/2 f_k and eta_{k+1} = eta_k + h f_k. `digital`: theta_k = eta_k,
eta_{k+1} = eta_k + h f_k, and the torque on the arm is tau_k. The memory of a law of one's own is eta: with
h f = m_k - m_{k-1} it is what the law makes of it.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm

from ..core.site_setup import Law, Scheme, SiteSetup
from ..core.vectors import Array
from . import characteristic_roots
from .linear_loop import SiteJacobian, couple_sites, differentiate_rates, linearise_loop
from .operating_point import Equilibrium, OperatingConditions

MAX_COMPANION_SIZE = 600
"""The largest companion matrix whose eigenvalues are computed; beyond it Newton's method starts from the
continuous roots."""


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


def find_common_rate_hz(conditions: OperatingConditions) -> int | None:
    """Returns the tick rate of all sites, Hz; None if they have several."""
    rates = {site.rate_hz for site in conditions.sites}
    return rates.pop() if len(rates) == 1 else None


def compute_sampled_spectrum(
    conditions: OperatingConditions, rest: Equilibrium, near: characteristic_roots.Complex, wanted: int = 6
) -> characteristic_roots.Spectrum | None:
    """Returns the rightmost roots s = ln(z) / h of the sampled loop; None if the sites have several rates.

    Also where a law has states or waves of its own, which is linearised in continuous time alone.

    If delays are long Newton's method starts `near` the roots of the continuous loop.
    """
    if find_common_rate_hz(conditions) is None or conditions.has_forms:
        return None
    pencil, names, constant = build_tick_pencil(conditions, rest)
    h_s = 1.0 / conditions.sites[0].rate_hz

    def logarithms(matrix: Array) -> characteristic_roots.Complex:
        """Returns ln(z) / h of the eigenvalues that are not next to zero, 1/s."""
        z = np.linalg.eigvals(matrix).astype(np.complex128)
        return (np.log(z[np.abs(z) > 1e-8]) / h_s).astype(np.complex128)

    with characteristic_roots.limit_blas_threads():
        zeros, drifting = characteristic_roots.count_zero_roots(pencil)
        size = len(names) + int(pencil.delays.max(initial=0)) * len(pencil.delayed_states)
        if size <= MAX_COMPANION_SIZE:
            guesses = characteristic_roots.sort_root_guesses(
                logarithms(build_companion_matrix(pencil)), zeros
            )
            tries = wanted + 2
        else:
            guesses = np.concatenate(
                [near, logarithms(pencil.A), logarithms(pencil.A + pencil.Ad.sum(axis=0))]
            )
            guesses = characteristic_roots.sort_root_guesses(guesses[np.abs(guesses) > 1e-6], 0)
            tries = len(guesses)
        roots, dropped = characteristic_roots.refine_roots(
            pencil, guesses, names, wanted, tries, 2.0 * math.pi / h_s
        )
    return characteristic_roots.Spectrum(tuple(roots), constant + zeros, drifting, dropped, 0)


def compute_decisive_spectrum(
    conditions: OperatingConditions, rest: Equilibrium, wanted: int, guesses: int
) -> characteristic_roots.Spectrum:
    """Returns the rightmost roots of the sampled loop; of the continuous one if there are several rates.

    The sampled ones are sought near `guesses` roots of the continuous loop.
    """
    continuous = characteristic_roots.compute_delay_spectrum(linearise_loop(conditions, rest), guesses)
    near = np.array([root.s for root in continuous.roots], dtype=np.complex128)
    return compute_sampled_spectrum(conditions, rest, near, wanted) or continuous


def build_companion_matrix(pencil: characteristic_roots.Pencil) -> Array:
    """Returns the matrix that carries the state, and the past of its delayed part, from tick to tick."""
    n, delayed = len(pencil.A), pencil.delayed_states
    depth, c = int(pencil.delays.max(initial=0)), len(delayed)
    whole = np.zeros((n + depth * c, n + depth * c))
    whole[:n, :n] = pencil.A
    for d, Sd in zip(pencil.delays, pencil.Ad, strict=True):
        whole[:n, n + (d - 1) * c : n + d * c] += Sd[:, delayed]
    if depth:
        whole[n + np.arange(c), delayed] = 1.0
        whole[n + c :, n : n + (depth - 1) * c] = np.eye((depth - 1) * c)
    return whole


def build_tick_pencil(conditions: OperatingConditions, rest: Equilibrium) -> characteristic_roots.MovingPart:
    """Returns the part of the sampled loop that moves; all sites must have one rate."""
    h_s = 1.0 / conditions.sites[0].rate_hz
    sites = differentiate_rates(conditions, rest)
    maps = [linearise_site_tick(*one, h_s) for one in zip(conditions.sites, sites, strict=True)]
    ends = np.cumsum([0, *(len(one.P) for one in maps)])
    at = [slice(a, b) for a, b in itertools.pairwise(ends)]
    S = block_diag(*(one.P for one in maps))
    Sd: dict[int, Array] = {}
    for (i, j), coupling in couple_sites(conditions, rest, sites).items():
        d = max(1, round(float(conditions.age_s[i, j]) / h_s))
        S_d = Sd.setdefault(d, np.zeros_like(S))
        S_d[at[i], at[j]] += maps[i].Q @ coupling @ maps[j].sent
    ticks = np.array(sorted(Sd), dtype=np.int64)
    delayed = np.array([Sd[int(d)] for d in ticks]).reshape(-1, *S.shape)
    moving = characteristic_roots.extract_moving_part(
        characteristic_roots.Pencil(S, ticks, delayed, h_s), [name for one in maps for name in one.names]
    )
    return moving._replace(constant=moving.constant + sum(one.left_out for one in sites))

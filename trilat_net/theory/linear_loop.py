"""The closed loop of all sites, linearised at an equilibrium: a delay-differential equation.

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

Invariant: x are deviations from the equilibrium, in the order of the scenario's sites; u is the torque ON
the joints that an operator adds; y are the joint velocities.
"""

from typing import NamedTuple

import numpy as np

from ..core.two_link_arm import JOINTS, PARAMETERS
from ..core.vectors import Array
from ..scenario import Scenario
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .site_dynamics import (
    ARGUMENT_COUNT,
    ESTIMATE,
    EXTERNAL_TORQUE,
    PEER_TORQUE,
    Q_DES,
    QD,
    QD_DES,
    STATE_SIZE,
    Q,
    SiteRates,
    differentiate_site_rates,
    has_estimate,
)


class DelayedTerm(NamedTuple):
    """What comes into the loop after a delay.

    Attributes:
        delay_s: the delay in use, s.
        A: of the state, shape (n, n).
        B: of the hands' torque, where a law reflects it, shape (n, m).
    """

    delay_s: float
    A: Array
    B: Array


class LinearLoop(NamedTuple):
    """A linear loop with delays.

    Attributes:
        names: of the states, as "m1.q1", "s.qd2", "m1.theta4".
        inputs: of the torques ON the joints, "m1.tau1".
        outputs: of the joint velocities, "m1.qd1".
        A: shape (n, n).
        B: shape (n, m).
        C: shape (p, n).
        delayed: one entry per distinct delay above zero, by rising delay.
    """

    names: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    delayed: tuple[DelayedTerm, ...]


class LinearSite(NamedTuple):
    """One site of the loop.

    Attributes:
        at: places of its states in x.
        own: which of a site's STATE numbers these are.
        rates: derivatives of its rates, see `field.jacobian`.
    """

    at: slice
    own: slice
    rates: SiteRates

    @property
    def fast(self) -> Array:
        """Derivatives of qdd and, where it adapts, of the estimate: shape (2 or 7, ARGUMENTS)."""
        estimate = self.rates.estimate[: self.own.stop - QD.stop]
        return np.vstack([self.rates.qdd, estimate])


def linearise_scenario(scenario: Scenario, rest: Equilibrium) -> LinearLoop:
    """Returns the loop of a scenario, linearised at a rest.

    Args:
        scenario: the experiment.
        rest: where, see `rest.rest_of`.

    Raises:
        ScenarioError: the scenario has no linear loop, see `conditions`.
    """
    return linearise_loop(derive_operating_conditions(scenario), rest)


def gather_site_arguments(now: OperatingConditions, rest: Equilibrium) -> Array:
    """Returns what the rates of every site depend on while all is still, shape (N, ARGUMENTS)."""
    x = np.zeros((len(now.sites), ARGUMENT_COUNT))
    x[:, Q], x[:, ESTIMATE] = rest.q, rest.theta_hat
    x[:, Q_DES] = now.alpha @ rest.q
    on_arm = np.array([_on_arm(now, i, x[i]) for i in range(len(now.sites))])
    x[:, PEER_TORQUE] = now.alpha @ on_arm
    return x


def _on_arm(now: OperatingConditions, i: int, x: Array) -> Array:
    found = now.rates(i, x)
    torque: Array = found.acted + found.held
    return torque


def linearise_sites(now: OperatingConditions, rest: Equilibrium) -> list[LinearSite]:
    """Returns every site, linearised by itself."""
    x = gather_site_arguments(now, rest)
    rows, first = [], 0
    for i, site in enumerate(now.sites):
        states = STATE_SIZE if has_estimate(site) else QD.stop
        rows.append(
            LinearSite(slice(first, first + states), slice(0, states), differentiate_site_rates(site, x[i]))
        )
        first += states
    return rows


def linearise_loop(now: OperatingConditions, rest: Equilibrium) -> LinearLoop:
    """Returns the loop under given conditions; see `linearised`."""
    rows = linearise_sites(now, rest)
    n, m = rows[-1].at.stop, JOINTS * len(rows)
    A, B = np.zeros((n, n)), np.zeros((n, m))
    for i, row in enumerate(rows):
        A[_q(row), _qd(row)] = np.eye(JOINTS)
        A[_fast(row), row.at] = row.fast[:, row.own]
        B[_fast(row), _push(i)] = row.fast[:, EXTERNAL_TORQUE]
    inputs, outputs = (
        tuple(f"{name}.{y}{j + 1}" for name in now.names for j in range(JOINTS)) for y in _PORT
    )
    C = np.zeros((m, n))
    for i, row in enumerate(rows):
        C[_push(i), _qd(row)] = np.eye(JOINTS)
    return LinearLoop(_names(now), inputs, outputs, A, B, C, _delayed(now, rows, n, m))


_PORT = ("tau", "qd")


def _delayed(now: OperatingConditions, rows: list[LinearSite], n: int, m: int) -> tuple[DelayedTerm, ...]:
    """Returns what comes from the peers, one entry per distinct delay."""
    found: dict[float, DelayedTerm] = {}
    for i, j in zip(*np.nonzero(now.alpha), strict=True):
        delay_s, share = float(now.age_s[i, j]), now.alpha[i, j]
        entry = found.setdefault(delay_s, DelayedTerm(delay_s, np.zeros((n, n)), np.zeros((n, m))))
        receiver, peer = rows[i], rows[j]
        entry.A[_fast(receiver), _q(peer)] += share * receiver.fast[:, Q_DES]
        entry.A[_fast(receiver), _qd(peer)] += share * receiver.fast[:, QD_DES]
        felt = share * receiver.fast[:, PEER_TORQUE]
        on_arm = peer.rates.acted + peer.rates.held
        entry.A[_fast(receiver), peer.at] += felt @ on_arm[:, peer.own]
        entry.B[_fast(receiver), _push(int(j))] += felt @ on_arm[:, EXTERNAL_TORQUE]
    return tuple(found[delay_s] for delay_s in sorted(found))


def _q(row: LinearSite) -> slice:
    return slice(row.at.start, row.at.start + JOINTS)


def _qd(row: LinearSite) -> slice:
    return slice(row.at.start + JOINTS, row.at.start + 2 * JOINTS)


def _fast(row: LinearSite) -> slice:
    return slice(row.at.start + JOINTS, row.at.stop)


def _push(i: int) -> slice:
    return slice(JOINTS * i, JOINTS * (i + 1))


def _names(now: OperatingConditions) -> tuple[str, ...]:
    names = []
    for site in now.sites:
        states = [*(f"q{j + 1}" for j in range(JOINTS)), *(f"qd{j + 1}" for j in range(JOINTS))]
        if has_estimate(site):
            states += [f"theta{p + 1}" for p in range(PARAMETERS)]
        names += [f"{site.name}.{state}" for state in states]
    return tuple(names)

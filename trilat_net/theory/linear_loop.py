"""The closed loop of all sites, linearised at an equilibrium: a delay-differential equation.

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

Invariant: x are deviations from the equilibrium, in the order of the scenario's sites; u is the torque ON
the joints that an operator adds; y are the joint velocities.
"""

import itertools
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

STATE_NAMES = (
    *(f"q{j + 1}" for j in range(JOINTS)),
    *(f"qd{j + 1}" for j in range(JOINTS)),
    *(f"theta{p + 1}" for p in range(PARAMETERS)),
)
"""Names of a site's states."""


class DelayedTerm(NamedTuple):
    """The part of the loop that acts after one delay.

    Attributes:
        delay_s: the delay in use, s.
        A: of the state, shape (n, n).
        B: of the operators' torque, where a law reflects it, shape (n, m).
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

    @property
    def static_matrix(self) -> Array:
        """A + sum_k A_k: the effect of a constant deviation."""
        total = self.A.copy()
        for term in self.delayed:
            total += term.A
        return total


class LinearSite(NamedTuple):
    """One site of the loop.

    Attributes:
        at: places of its states in x.
        rates: derivatives of its rates, see `differentiate_site_rates`.
    """

    at: slice
    rates: SiteRates

    @property
    def own(self) -> slice:
        """Its states among a site's STATE_SIZE numbers."""
        return slice(0, self.at.stop - self.at.start)

    @property
    def q(self) -> slice:
        """Places of its angles in x."""
        return slice(self.at.start, self.at.start + JOINTS)

    @property
    def qd(self) -> slice:
        """Places of its velocities in x."""
        return slice(self.at.start + JOINTS, self.at.start + 2 * JOINTS)

    @property
    def dynamic(self) -> slice:
        """Places of its velocities and estimates in x."""
        return slice(self.at.start + JOINTS, self.at.stop)

    @property
    def dynamic_rates(self) -> Array:
        """Derivatives of qdd and, if it adapts, of the estimate: shape (2 or 7, ARGUMENT_COUNT)."""
        return np.vstack([self.rates.qdd, self.rates.estimate[: self.own.stop - QD.stop]])


def linearise_scenario(scenario: Scenario, rest: Equilibrium) -> LinearLoop:
    """Returns the loop of a scenario, linearised at an equilibrium, see `find_equilibrium`.

    Raises:
        ScenarioError: the scenario has no linear loop, see `derive_operating_conditions`.
    """
    return linearise_loop(derive_operating_conditions(scenario), rest)


def gather_site_arguments(conditions: OperatingConditions, rest: Equilibrium) -> Array:
    """Returns the arguments of every site's rates at an equilibrium, shape (N, ARGUMENT_COUNT)."""
    x = np.zeros((len(conditions.sites), ARGUMENT_COUNT))
    x[:, Q], x[:, ESTIMATE] = rest.q, rest.theta_hat
    x[:, Q_DES] = conditions.alpha @ rest.q
    rates = [conditions.rates(i, x[i]) for i in range(len(conditions.sites))]
    x[:, PEER_TORQUE] = conditions.alpha @ np.array([site.external + site.held for site in rates])
    return x


def locate_states(conditions: OperatingConditions) -> list[slice]:
    """Returns the places of every site's states in the loop's state."""
    sizes = [STATE_SIZE if has_estimate(site) else QD.stop for site in conditions.sites]
    return [slice(end - size, end) for size, end in zip(sizes, itertools.accumulate(sizes), strict=True)]


def linearise_sites(conditions: OperatingConditions, rest: Equilibrium) -> list[LinearSite]:
    """Returns every site, linearised by itself."""
    x = gather_site_arguments(conditions, rest)
    return [
        LinearSite(at, differentiate_site_rates(site, x[i]))
        for i, (site, at) in enumerate(zip(conditions.sites, locate_states(conditions), strict=True))
    ]


def linearise_loop(conditions: OperatingConditions, rest: Equilibrium) -> LinearLoop:
    """Returns the loop under given conditions, linearised at an equilibrium."""
    sites = linearise_sites(conditions, rest)
    n, m = sites[-1].at.stop, JOINTS * len(sites)
    A, B, C = np.zeros((n, n)), np.zeros((n, m)), np.zeros((m, n))
    for i, site in enumerate(sites):
        A[site.q, site.qd] = np.eye(JOINTS)
        A[site.dynamic, site.at] = site.dynamic_rates[:, site.own]
        B[site.dynamic, _ports(i)] = site.dynamic_rates[:, EXTERNAL_TORQUE]
        C[_ports(i), site.qd] = np.eye(JOINTS)
    names = tuple(
        f"{name}.{state}"
        for name, site in zip(conditions.names, sites, strict=True)
        for state in STATE_NAMES[site.own]
    )
    inputs, outputs = (
        tuple(f"{name}.{kind}{j + 1}" for name in conditions.names for j in range(JOINTS))
        for kind in ("tau", "qd")
    )
    return LinearLoop(names, inputs, outputs, A, B, C, _delayed_terms(conditions, sites))


def _delayed_terms(conditions: OperatingConditions, sites: list[LinearSite]) -> tuple[DelayedTerm, ...]:
    """Returns the effect of the peers, one entry per distinct delay."""
    n, m = sites[-1].at.stop, JOINTS * len(sites)
    terms: dict[float, DelayedTerm] = {}
    for i, j in zip(*np.nonzero(conditions.alpha), strict=True):
        delay_s, share = float(conditions.age_s[i, j]), conditions.alpha[i, j]
        term = terms.setdefault(delay_s, DelayedTerm(delay_s, np.zeros((n, n)), np.zeros((n, m))))
        receiver, peer = sites[i], sites[j]
        term.A[receiver.dynamic, peer.q] += share * receiver.dynamic_rates[:, Q_DES]
        term.A[receiver.dynamic, peer.qd] += share * receiver.dynamic_rates[:, QD_DES]
        reflected = share * receiver.dynamic_rates[:, PEER_TORQUE]
        on_arm = peer.rates.external + peer.rates.held
        term.A[receiver.dynamic, peer.at] += reflected @ on_arm[:, peer.own]
        term.B[receiver.dynamic, _ports(int(j))] += reflected @ on_arm[:, EXTERNAL_TORQUE]
    return tuple(terms[delay_s] for delay_s in sorted(terms))


def _ports(i: int) -> slice:
    return slice(JOINTS * i, JOINTS * (i + 1))

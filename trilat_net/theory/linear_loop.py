"""The closed loop of all sites, linearised at an equilibrium: a delay-differential equation.

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

Invariant: x are deviations from the equilibrium, in the order of the scenario's sites; u is the torque ON
the joints that an operator adds; y are the joint velocities.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    x[:, PEER_TORQUE] = conditions.alpha @ np.array([one.external + one.held for one in conditions.rates(x)])
    return x


def find_loop_states(conditions: OperatingConditions) -> NDArray[np.bool_]:
    """Returns which states of every site are in the loop, shape (N, STATE_SIZE): estimates if it learns."""
    mask = np.ones((len(conditions.sites), STATE_SIZE), dtype=bool)
    mask[[not has_estimate(site) for site in conditions.sites], ESTIMATE] = False
    return mask


def differentiate_rates(conditions: OperatingConditions, rest: Equilibrium) -> list[SiteRates]:
    """Returns the derivatives of the rates of every site by itself, see `differentiate_site_rates`."""
    x = gather_site_arguments(conditions, rest)
    return [differentiate_site_rates(site, own) for site, own in zip(conditions.sites, x, strict=True)]


def linearise_loop(conditions: OperatingConditions, rest: Equilibrium) -> LinearLoop:
    """Returns the loop under given conditions, linearised at an equilibrium."""
    rates, mask, count = differentiate_rates(conditions, rest), find_loop_states(conditions), len(rest.q)
    kept = np.flatnonzero(mask)
    size, everywhere = count * STATE_SIZE, np.arange(count * JOINTS)

    def collect(A: Array, B: Array) -> tuple[Array, Array]:
        """Returns matrices of blocks, (i, row, j, column), as matrices of the loop's states and inputs."""
        square, inputs = A.reshape(size, size), B.reshape(size, -1)
        return square[np.ix_(kept, kept)], inputs[np.ix_(kept, everywhere)]

    A, B = np.zeros((count, STATE_SIZE, count, STATE_SIZE)), np.zeros((count, STATE_SIZE, count, JOINTS))
    C = np.zeros((count, JOINTS, count, STATE_SIZE))
    terms: dict[float, tuple[Array, Array]] = {}
    for i, own in enumerate(rates):
        by = np.vstack([np.eye(JOINTS, ARGUMENT_COUNT, QD.start), own.qdd, own.estimate])
        A[i, :, i], B[i, :, i], C[i, :, i, QD] = by[:, :STATE_SIZE], by[:, EXTERNAL_TORQUE], np.eye(JOINTS)
        for j in np.flatnonzero(conditions.alpha[i]):
            delay_s, share = float(conditions.age_s[i, j]), conditions.alpha[i, j]
            late_A, late_B = terms.setdefault(delay_s, (np.zeros_like(A), np.zeros_like(B)))
            late_A[i, :, j, Q] += share * by[:, Q_DES]
            late_A[i, :, j, QD] += share * by[:, QD_DES]
            reflected, on_arm = share * by[:, PEER_TORQUE], rates[j].external + rates[j].held
            late_A[i, :, j] += reflected @ on_arm[:, :STATE_SIZE]
            late_B[i, :, j] += reflected @ on_arm[:, EXTERNAL_TORQUE]
    names = np.array([[f"{name}.{state}" for state in STATE_NAMES] for name in conditions.names])
    inputs, outputs = (
        tuple(f"{name}.{kind}{j + 1}" for name in conditions.names for j in range(JOINTS))
        for kind in ("tau", "qd")
    )
    delayed = tuple(DelayedTerm(delay_s, *collect(*terms[delay_s])) for delay_s in sorted(terms))
    output = C.reshape(-1, size)[np.ix_(everywhere, kept)]
    return LinearLoop(tuple(names[mask].tolist()), inputs, outputs, *collect(A, B), output, delayed)

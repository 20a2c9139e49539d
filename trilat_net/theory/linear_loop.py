"""The closed loop of all sites, linearised at an equilibrium: a delay-differential equation.

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

Invariant: x are deviations from the equilibrium, in the order of the scenario's sites; u is the torque ON
the joints that an operator adds; y are the joint velocities.

A chain has ten estimates a link, of which a small motion moves, and the torque shows, no more than one
combination a joint: the gravity that was learnt. With the regressor Y_G at rest it is z = Y_G theta_hat, N m,
and z' = -Y_G Gamma Y' r. The loop of chains has z in place of the estimates; all that is left out is constant
or has no effect, each with a root at zero.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from ..core.vectors import Array
from ..scenario import Scenario
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .site_dynamics import (
    ArgumentLayout,
    SiteRates,
    differentiate_site_rates,
    has_estimate,
    lay_out_arguments,
)

_DEPENDENT = 1e-9
"""Rows of a regressor that are dependent to this, relative to the largest, are."""


class SiteJacobian(NamedTuple):
    """The derivatives of one site's rates, by the states that the loop keeps.

    Attributes:
        at: layout of the columns; of a law that learns nothing it has no estimate.
        rates: the derivatives, see `differentiate_site_rates`.
        states: names of the states, as "q1", "qd2", "theta4"; "gravity2": the learnt gravity of joint 2.
        left_out: number of estimates that no small motion moves or shows.
    """

    at: ArgumentLayout
    rates: SiteRates
    states: tuple[str, ...]
    left_out: int = 0


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
        left_out: number of states that no small motion moves or shows, each with a root at zero.
    """

    names: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    delayed: tuple[DelayedTerm, ...]
    left_out: int = 0

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
    """Returns the arguments of every site's rates at an equilibrium, shape (N, arguments)."""
    at = lay_out_arguments(conditions.sites[0])
    x = np.zeros((len(conditions.sites), at.arguments))
    x[:, at.q], x[:, at.estimate] = rest.q, rest.theta_hat
    x[:, at.q_des] = conditions.alpha @ rest.q
    acting = np.array([one.external + one.held for one in conditions.rates(x)])
    x[:, at.peer_torque] = conditions.alpha @ acting
    return x


def find_loop_states(conditions: OperatingConditions) -> NDArray[np.bool_]:
    """Returns which states of every site are in the loop, shape (N, states): estimates if it learns."""
    at = lay_out_arguments(conditions.sites[0])
    mask = np.ones((len(conditions.sites), at.states), dtype=bool)
    mask[[not has_estimate(site) for site in conditions.sites], at.estimate] = False
    return mask


def differentiate_rates(
    conditions: OperatingConditions, rest: Equilibrium, *, every_estimate: bool = False
) -> list[SiteJacobian]:
    """Returns the derivatives of the rates of every site by itself, see `differentiate_site_rates`.

    `every_estimate`: of chains too each estimate is a state, and not only what they say of gravity.
    """
    x = gather_site_arguments(conditions, rest)
    jacobians = []
    for site, own in zip(conditions.sites, x, strict=True):
        at, rates = lay_out_arguments(site), differentiate_site_rates(site, own)
        learnt = tuple(f"theta{p + 1}" for p in range(at.parameters))
        if not has_estimate(site):
            jacobian = _replace_estimate(at, rates, np.zeros((0, at.parameters)), ())
        elif site.chain is None or every_estimate:
            jacobian = SiteJacobian(at, rates, (*_name_motion(at.joints), *learnt))
        else:
            effect = rates.tau[:, at.estimate]
            joints = _find_independent_rows(effect)
            names = tuple(f"gravity{joint + 1}" for joint in joints)
            jacobian = _replace_estimate(at, rates, effect[joints], names)
            jacobian = jacobian._replace(left_out=at.parameters - len(joints))
        jacobians.append(jacobian)
    return jacobians


def _name_motion(joints: int) -> tuple[str, ...]:
    return tuple(f"{kind}{joint + 1}" for kind in ("q", "qd") for joint in range(joints))


def _find_independent_rows(matrix: Array) -> list[int]:
    """Returns as many rows as a matrix has rank, each as independent of those before as can be, in order."""
    _, R, order = qr(matrix.T, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(R))
    return sorted(order[: int(np.sum(sizes > _DEPENDENT * max(1.0, sizes[0])))].tolist())


def _replace_estimate(at: ArgumentLayout, rates: SiteRates, T: Array, names: tuple[str, ...]) -> SiteJacobian:
    """Returns a site's derivatives with the states z = T theta_hat, shape (m, P), in place of theta_hat.

    All effects of the estimate must be combinations of z.
    """
    shown = np.linalg.pinv(T)

    def convert(by: Array) -> Array:
        """Returns derivatives by the new states."""
        return np.hstack([by[:, : at.estimate.start], by[:, at.estimate] @ shown, by[:, at.estimate.stop :]])

    converted = SiteRates(*map(convert, rates))
    return SiteJacobian(
        ArgumentLayout(at.joints, len(T)),
        converted._replace(estimate=T @ converted.estimate),
        (*_name_motion(at.joints), *names),
    )


def linearise_loop(
    conditions: OperatingConditions, rest: Equilibrium, *, every_estimate: bool = False
) -> LinearLoop:
    """Returns the loop under given conditions, linearised at an equilibrium; see `differentiate_rates`."""
    sites = differentiate_rates(conditions, rest, every_estimate=every_estimate)
    n = sites[0].at.joints
    first = np.cumsum([0, *(one.at.states for one in sites)])
    size, count = int(first[-1]), n * len(sites)
    own = [slice(a, b) for a, b in pairwise(first.tolist())]
    ports = [slice(n * i, n * (i + 1)) for i in range(len(sites))]
    A, B, C = np.zeros((size, size)), np.zeros((size, count)), np.zeros((count, size))
    terms: dict[float, tuple[Array, Array]] = {}
    for i, (at, rates, _, _) in enumerate(sites):
        by = np.vstack([np.eye(n, at.arguments, at.qd.start), rates.qdd, rates.estimate])
        A[own[i], own[i]], B[own[i], ports[i]] = by[:, : at.states], by[:, at.external_torque]
        C[ports[i], own[i]] = np.eye(n, at.states, at.qd.start)
        for j in np.flatnonzero(conditions.alpha[i]):
            delay_s, share = float(conditions.age_s[i, j]), conditions.alpha[i, j]
            late_A, late_B = terms.setdefault(delay_s, (np.zeros_like(A), np.zeros_like(B)))
            peer, of_peer = sites[j].at, late_A[own[i], own[j]]
            of_peer[:, peer.q] += share * by[:, at.q_des]
            of_peer[:, peer.qd] += share * by[:, at.qd_des]
            reflected = share * by[:, at.peer_torque]
            on_arm = sites[j].rates.external + sites[j].rates.held
            of_peer += reflected @ on_arm[:, : peer.states]
            late_B[own[i], ports[j]] += reflected @ on_arm[:, peer.external_torque]
    names = [
        f"{name}.{state}" for name, one in zip(conditions.names, sites, strict=True) for state in one.states
    ]
    inputs, outputs = (
        tuple(f"{name}.{kind}{j + 1}" for name in conditions.names for j in range(n))
        for kind in ("tau", "qd")
    )
    delayed = tuple(DelayedTerm(delay_s, *terms[delay_s]) for delay_s in sorted(terms))
    left_out = sum(one.left_out for one in sites)
    return LinearLoop(tuple(names), inputs, outputs, A, B, C, delayed, left_out)

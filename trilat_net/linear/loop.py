"""The closed loop of all sites, linearised where it rests: a delay-differential equation.

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

Law: x are deviations from the rest, in the order of the scenario's sites; u is torque ON the joints, what a
hand adds; y are the joint velocities.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import JOINTS, PARAMETERS, Array
from ..scenario import Scenario
from .conditions import Conditions, conditions
from .field import ARGUMENTS, ESTIMATE, FELT, PUSH, Q_DES, QD, QD_DES, STATE, Q, Rates, adapts, jacobian


class Delayed(NamedTuple):
    """What comes into the loop after a delay.

    Attributes:
        delay_s: the delay in use, s.
        A: of the state, shape (n, n).
        B: of the hands' torque, where a law reflects it, shape (n, m).
    """

    delay_s: float
    A: Array
    B: Array


class Loop(NamedTuple):
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
    delayed: tuple[Delayed, ...]


class Rest(NamedTuple):
    """Where a loop is linearised: all sites still.

    Attributes:
        q: joint angles, shape (N, 2), rad.
        theta_hat: estimates, shape (N, 5); of a law that knows gravity what it takes the arm to have.
        how: how it was found, in words.
        residual: the largest acceleration, rad/s^2, or rate of an estimate that is left there.
        notes: what is to be said of it.
    """

    q: Array
    theta_hat: Array
    how: str
    residual: float
    notes: tuple[str, ...] = ()


class Row(NamedTuple):
    """One site of the loop.

    Attributes:
        at: places of its states in x.
        own: which of a site's STATE numbers these are.
        rates: derivatives of its rates, see `field.jacobian`.
    """

    at: slice
    own: slice
    rates: Rates

    @property
    def fast(self) -> Array:
        """Derivatives of qdd and, where it adapts, of the estimate: shape (2 or 7, ARGUMENTS)."""
        estimate = self.rates.estimate[: self.own.stop - QD.stop]
        return np.vstack([self.rates.qdd, estimate])


def linearised(scenario: Scenario, rest: Rest) -> Loop:
    """Returns the loop of a scenario, linearised at a rest.

    Args:
        scenario: the experiment.
        rest: where, see `rest.rest_of`.

    Raises:
        ScenarioError: the scenario has no linear loop, see `conditions`.
    """
    return loop_of(conditions(scenario), rest)


def arguments(now: Conditions, rest: Rest) -> Array:
    """Returns what the rates of every site depend on while all is still, shape (N, ARGUMENTS)."""
    x = np.zeros((len(now.sites), ARGUMENTS))
    x[:, Q], x[:, ESTIMATE] = rest.q, rest.theta_hat
    x[:, Q_DES] = now.alpha @ rest.q
    on_arm = np.array([_on_arm(now, i, x[i]) for i in range(len(now.sites))])
    x[:, FELT] = now.alpha @ on_arm
    return x


def _on_arm(now: Conditions, i: int, x: Array) -> Array:
    found = now.rates(i, x)
    torque: Array = found.acted + found.held
    return torque


def rows_of(now: Conditions, rest: Rest) -> list[Row]:
    """Returns every site, linearised by itself."""
    x = arguments(now, rest)
    rows, first = [], 0
    for i, site in enumerate(now.sites):
        states = STATE if adapts(site) else QD.stop
        rows.append(Row(slice(first, first + states), slice(0, states), jacobian(site, x[i])))
        first += states
    return rows


def loop_of(now: Conditions, rest: Rest) -> Loop:
    """Returns the loop under given conditions; see `linearised`."""
    rows = rows_of(now, rest)
    n, m = rows[-1].at.stop, JOINTS * len(rows)
    A, B = np.zeros((n, n)), np.zeros((n, m))
    for i, row in enumerate(rows):
        A[_q(row), _qd(row)] = np.eye(JOINTS)
        A[_fast(row), row.at] = row.fast[:, row.own]
        B[_fast(row), _push(i)] = row.fast[:, PUSH]
    inputs, outputs = (
        tuple(f"{name}.{y}{j + 1}" for name in now.names for j in range(JOINTS)) for y in _PORT
    )
    C = np.zeros((m, n))
    for i, row in enumerate(rows):
        C[_push(i), _qd(row)] = np.eye(JOINTS)
    return Loop(_names(now), inputs, outputs, A, B, C, _delayed(now, rows, n, m))


_PORT = ("tau", "qd")


def _delayed(now: Conditions, rows: list[Row], n: int, m: int) -> tuple[Delayed, ...]:
    """Returns what comes from the peers, one entry per distinct delay."""
    found: dict[float, Delayed] = {}
    for i, j in zip(*np.nonzero(now.alpha), strict=True):
        delay_s, share = float(now.age_s[i, j]), now.alpha[i, j]
        entry = found.setdefault(delay_s, Delayed(delay_s, np.zeros((n, n)), np.zeros((n, m))))
        receiver, peer = rows[i], rows[j]
        entry.A[_fast(receiver), _q(peer)] += share * receiver.fast[:, Q_DES]
        entry.A[_fast(receiver), _qd(peer)] += share * receiver.fast[:, QD_DES]
        felt = share * receiver.fast[:, FELT]
        on_arm = peer.rates.acted + peer.rates.held
        entry.A[_fast(receiver), peer.at] += felt @ on_arm[:, peer.own]
        entry.B[_fast(receiver), _push(int(j))] += felt @ on_arm[:, PUSH]
    return tuple(found[delay_s] for delay_s in sorted(found))


def _q(row: Row) -> slice:
    return slice(row.at.start, row.at.start + JOINTS)


def _qd(row: Row) -> slice:
    return slice(row.at.start + JOINTS, row.at.start + 2 * JOINTS)


def _fast(row: Row) -> slice:
    return slice(row.at.start + JOINTS, row.at.stop)


def _push(i: int) -> slice:
    return slice(JOINTS * i, JOINTS * (i + 1))


def _names(now: Conditions) -> tuple[str, ...]:
    names = []
    for site in now.sites:
        states = [*(f"q{j + 1}" for j in range(JOINTS)), *(f"qd{j + 1}" for j in range(JOINTS))]
        if adapts(site):
            states += [f"theta{p + 1}" for p in range(PARAMETERS)]
        names += [f"{site.name}.{state}" for state in states]
    return tuple(names)

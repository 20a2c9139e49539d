"""What must hold of every arm that comes to rest: in `hold`, `stopped` and `fault`, whatever went wrong.

A rest is all that a start of a site spends in these modes, or waiting, without a tick between. Its blend is
its first 0.15 s, in which w takes on what nobody knew of gravity (its motion is fastest after 2.5 of the
30 ms in which B brakes), and as long after its beginning as the limit of the torque's rate binds in every
tick: a torque that begins at zero cannot hold what hangs until it has grown to it.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from trilat_net.analysis.arm_rows import PlanarArmRows
from trilat_net.core.site_setup import LEAST_STOP_S, SiteSetup
from trilat_net.net.messages import State
from trilat_net.scenario import Scenario

from .fault_session import FaultSession

RESTING = ("waiting", "hold", "stopped", "fault")
JUDGED = RESTING[1:]
RESIDUAL = 1e-9
BLEND_S, AT_REST_RAD_S, REST_WITHIN_S = 0.15, 0.05, 1.5
MOVING_RESIDUAL = 1e-6
"""Of the work of a reference, which is integrated over ticks by the trapezoidal rule."""
MOST_WAY = 1.1
"""Of the stopping distance, for joints that move each other."""
MOST_ENERGY = 1.2
"""Of the kinetic energy at the order, with what the blend gives."""
LEAST_ENERGY_J = 1e-4
"""Of an arm that is at rest already: less than it has at 0.05 rad/s."""
PEERS = 2


def _multiply_inertia(theta: Any, q: Any, x: Any) -> Any:
    return PlanarArmRows(theta, 0.0, (1.0, 1.0)).multiply_inertia(q, x)


class Rest(NamedTuple):
    """An arm that comes to rest.

    Attributes:
        name: of its site.
        setup: of its site, as its scenario says.
        states: its records, the first of which begins it.
        limited: per record, that the limit of its torque's rate, or of the torque, kept it from what it asks.
        kinetic_j: per record.
        blend: how many records the blend has.
    """

    name: str
    setup: SiteSetup
    states: Sequence[State]
    limited: np.ndarray
    kinetic_j: np.ndarray
    blend: int

    def rows(self, key: str) -> np.ndarray:
        return np.array([getattr(state, key) for state in self.states])

    @property
    def judged(self) -> int:
        """The first record in a mode other than `waiting`; as many as there are if there is none."""
        return next((n for n, state in enumerate(self.states) if state.mode in JUDGED), len(self.states))


def find_rests(session: FaultSession) -> Iterator[Rest]:
    """Yields the rests of a session."""
    for name, states in session.published.states.items():
        setup, theta = session.scenario.setup(name), session.scenario.arms[name].theta
        limited = find_limited_ticks(session.scenario, name, states)
        place = 0
        for (_, resting), group in groupby(states, key=lambda at: (at.boot, at.mode in RESTING)):
            rows = list(group)
            of = slice(place, place + len(rows))
            place = of.stop
            if resting:
                q, qd = (np.array([getattr(state, key) for state in rows]) for key in ("q", "qd"))
                kinetic_j = 0.5 * (qd * _multiply_inertia(theta, q, qd)).sum(axis=1)
                binds = np.append(limited[of], False)
                blend = max(round(BLEND_S * setup.rate_hz), int(np.argmin(binds)))
                yield Rest(name, setup, rows, limited[of], kinetic_j, blend)


def find_limited_ticks(scenario: Scenario, name: str, states: Sequence[State]) -> np.ndarray:
    """True for every record whose torque, or that before, is at its limit or at that of its rate.

    Over the period after a record the arm feels both of them (Eq. (8), extrapolated to mid-period).
    """
    setup = scenario.setup(name)
    most = np.asarray(setup.limits.tau_rate) / setup.rate_hz * (1.0 - RESIDUAL)
    tau = np.array([state.tau for state in states])
    limited = np.any(np.abs(np.diff(tau, axis=0, prepend=tau[:1])) >= most, axis=1)
    limited |= np.any(np.abs(tau) >= np.asarray(setup.tau_limit_nm) * (1.0 - RESIDUAL), axis=1)
    found: np.ndarray = limited | np.r_[False, limited[:-1]]
    return found


def check_storage(session: FaultSession) -> Iterator[str]:
    """I5: at rest the storage of the adaptive law, with that of its integral, never rises.

    While its reference comes to rest, by no more than what that works.
    """
    for name, (at_rest_j, before_j) in find_rises(session):
        if at_rest_j > RESIDUAL:
            yield f"{name}: the storage rises by {at_rest_j:.3g} J in a tick while it rests"
        if before_j > MOVING_RESIDUAL:
            yield f"{name}: the storage rises by {before_j:.3g} J more in a tick than its reference works"


def find_rises(session: FaultSession) -> Iterator[tuple[str, tuple[float, float]]]:
    """How much the storage rises in a tick of every rest: its reference at rest, and before that, J.

    Before, beyond the work of its reference, (Kd qd + B r + w)'qd_des. Both are relative to the
    largest storage in it, where that is more than 1 J. Ticks in which a limit keeps the torque from being
    that of the law say nothing of the law.
    """
    for rest in find_rests(session):
        if len(rest.states) < 3:
            continue
        S, power = compute_storage(session.scenario, rest)
        qd_des = rest.rows("qd_des")[1:]
        free = ~rest.limited[1:-1]
        rests = (qd_des == 0.0).all(axis=1)[:-1]
        # a torque is extrapolated from the tick before, Eq. (8), and the first of a rest decelerates
        before = np.r_[False, False, rests]
        still = rests & before[1:-1] & before[:-2]
        largest_j = max(1.0, S.max())
        rises = np.diff(S) / largest_j
        work = 0.5 * (power[1:] + power[:-1]) / rest.setup.rate_hz / largest_j
        yield (
            rest.name,
            (
                rises[free & still].max(initial=-np.inf),
                (rises - work)[free & ~still].max(initial=-np.inf),
            ),
        )


def compute_storage(scenario: Scenario, rest: Rest) -> tuple[np.ndarray, np.ndarray]:
    """V = 1/2 (r'M r + e'Lambda Kd e + theta~'Gamma^-1 theta~ + w'(k B)^-1 w) but for the first record, J.

    Of w the memory of a record has that of the next one. Less 1/2 h w's: w goes on by Euler's rule, whose
    own storage is that. With it comes the power of the reference, (Kd qd + B r + w)'qd_des, W.
    """
    gains, theta, still = rest.setup.gains, scenario.arms[rest.name].theta, rest.setup.rest
    assert still is not None
    q, qd, q_des, qd_des, theta_hat = (
        rest.rows(key)[1:] for key in ("q", "qd", "q_des", "qd_des", "theta_hat")
    )
    first = 2 * (len(q[0]) + 1) + PEERS
    w = np.array([state.mem[first : first + len(q[0])] for state in rest.states[:-1]])
    e, off = q - q_des, theta_hat - theta
    r = qd + np.asarray(gains.Lambda) * e
    kinetic = (r * _multiply_inertia(theta, q, r)).sum(axis=1)
    stored = (np.asarray(gains.Lambda) * np.asarray(gains.Kd) * e**2).sum(axis=1)
    learnt = (off**2 / np.asarray(gains.Gamma)).sum(axis=1)
    integral = (w**2 / np.asarray(still.vectors()["integral"])).sum(axis=1)
    euler = (w * (r - qd_des)).sum(axis=1) / rest.setup.rate_hz
    working = np.asarray(gains.Kd) * qd + np.asarray(still.damping) * r + w
    return 0.5 * (kinetic + stored + learnt + integral - euler), (working * qd_des).sum(axis=1)


def check_energy(session: FaultSession) -> Iterator[str]:
    """I12: the kinetic energy is at most 1.2 times that at the beginning with what the blend gives."""
    for rest in find_rests(session):
        first = rest.judged
        given_j = np.maximum(0.0, np.diff(rest.kinetic_j[: rest.blend + 1])).cumsum()
        booked_j = np.append(np.append(0.0, given_j), np.full(len(rest.states), np.sum(given_j[-1:])))
        allowed_j = MOST_ENERGY * rest.kinetic_j[0] + booked_j[: len(rest.states)] + LEAST_ENERGY_J
        for row in np.flatnonzero(rest.kinetic_j[first:] > allowed_j[first:])[:1]:
            at, has_j, most_j = rest.states[first + row], rest.kinetic_j[first + row], allowed_j[first + row]
            yield f"{rest.name} has {has_j:.3g} J at tick {at.tick} in {at.mode}; at most {most_j:.3g}"


def check_rest(session: FaultSession) -> Iterator[str]:
    """I13: 1.5 s after its blend an arm is at rest, and stays so; or when it is back at its reference.

    What limits kept from it goes back by Lambda, and how far that may be I14 says.
    """
    for rest in find_rests(session):
        within = max(rest.blend + round((REST_WITHIN_S - BLEND_S) * rest.setup.rate_hz), find_return(rest))
        speeds = np.abs(rest.rows("qd")).max(axis=1)[within:]
        for row in np.flatnonzero(speeds > AT_REST_RAD_S)[:1]:
            at = rest.states[within + row]
            yield f"{rest.name} still moves at {speeds[row]:.3g} rad/s at tick {at.tick} in {at.mode}"


def find_return(rest: Rest) -> int:
    """The record by which an arm is back: from where it is farthest off, in 1.2 times what Lambda takes."""
    rates = np.asarray(rest.setup.gains.Lambda)
    speeds = (rates * np.abs(rest.rows("q") - rest.rows("q_des"))).max(axis=1)
    takes_s = 1.2 * float(np.log(max(speeds.max() / AT_REST_RAD_S, 1.0))) / float(rates.min())
    return int(np.argmax(speeds)) + round(takes_s * rest.setup.rate_hz)


def check_travel(session: FaultSession) -> Iterator[str]:
    """I14: from its blend's end an arm is no farther from its beginning than its stopping distance."""
    for rest in find_rests(session):
        q = rest.rows("q")
        travel = np.abs(q - q[0]).max(axis=1)
        allowed_rad = find_stopping_distance(session.scenario, rest)
        for row in np.flatnonzero(travel > allowed_rad)[:1]:
            at = rest.states[row]
            if rest.judged < len(rest.states):
                yield f"{rest.name} goes {travel.max():.3g} rad by {at.mode}; at most {allowed_rad:.3g}"


def find_stopping_distance(scenario: Scenario, rest: Rest) -> float:
    """How far a joint goes until all rest: its reference, and what its torque takes it besides, rad.

    The reference goes |v| T / 2. A torque d that nothing balances as it begins, M times the acceleration
    that is seen, is taken on by w while s adds up to d / (k B) = 4 time_s d / B.
    """
    still = rest.setup.rest
    assert still is not None
    q, v = (rest.rows(key)[: rest.blend + 1] for key in ("q", "qd"))
    stop_s = max(LEAST_STOP_S, float((np.abs(v[0]) / still.deceleration).max()))
    a = np.diff(v, axis=0) * rest.setup.rate_hz
    d_nm = np.abs(_multiply_inertia(scenario.arms[rest.name].theta, q[1:], a)).max(axis=0, initial=0.0)
    aside_rad = 4.0 * still.time_s * d_nm / still.damping
    return MOST_WAY * float((np.abs(v[0]) * stop_s / 2.0 + aside_rad).max())

"""Invariants of every arm that comes to rest: in `hold`, `stopped` and `fault`, under any
faults.

A rest is an unbroken stretch of a start of a site in these modes, or waiting. The blend of a
rest is its first 0.15 s, in which w takes on the unknown part of gravity (its motion is fastest
after 2.5 of the 30 ms in which B brakes). The blend also lasts as long as the limit of the
torque's rate binds in every tick: a torque that begins at zero cannot hold a hanging arm until
the torque has grown.

In the blend and afterwards, the energy of an arm may exceed its initial energy by two works
only, both stated in docs/theory/coming-to-rest.md: that of the gravity that the law does not
know, and that of the last torque, Eq. (5).
"""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from trilat_net.analysis.arm_rows import PlanarArmRows
from trilat_net.core.step.site_setup import LEAST_STOP_S, SiteSetup
from trilat_net.net.messages import State
from trilat_net.scenario import Scenario
from trilat_net.scenario.rest_bounds import find_rest_bounds

from .fault_session import FaultSession

RESTING = ("waiting", "hold", "stopped", "fault")
JUDGED = RESTING[1:]
RESIDUAL = 1e-9
BLEND_S = 0.15
AT_REST_RAD_S = 0.05
MOVING_RESIDUAL = 1e-6
"""Tolerance of the work of a reference, which is integrated over ticks by the trapezoidal rule."""
MOST_WAY = 1.1
"""Factor on the stopping distance, for joints that move each other."""
MOST_ENERGY = 1.05
"""Factor on the kinetic energy at the order."""
MOST_SPEED = 1.1
"""Factor on the largest speed at the order."""
LEAST_ENERGY_J = 1e-4
"""The energy below which an arm is at rest already, which is less than that at 0.05 rad/s."""
PEERS = 2


def _multiply_inertia(theta: Any, q: Any, x: Any) -> Any:
    return PlanarArmRows(theta, 0.0, (1.0, 1.0)).multiply_inertia(q, x)


class Rest(NamedTuple):
    """An arm that comes to rest.

    Attributes:
        name: Name of the site.
        setup: Setup of the site, by its scenario.
        states: Records of the rest, from its first one.
        limited: Per record, True if a limit of the torque or of its rate changed the torque.
        kinetic_j: Kinetic energy per record.
        blend: Number of records in the blend.
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
        """Returns the index of the first record in a mode other than `waiting`, or else the number of records."""
        return next(
            (n for n, state in enumerate(self.states) if state.mode in JUDGED), len(self.states)
        )


def find_rests(session: FaultSession) -> Iterator[Rest]:
    """Yields the rests of a session."""
    for name, states in session.published.states.items():
        setup = session.scenario.setup(name)
        theta = session.scenario.arms[name].theta
        limited = find_limited_ticks(session.scenario, name, states)
        first_row = 0
        for (_, resting), group in groupby(
            states, key=lambda at: (at.boot, at.mode in RESTING)
        ):
            rows = list(group)
            of = slice(first_row, first_row + len(rows))
            first_row = of.stop
            if resting:
                q, qd = (
                    np.array([getattr(state, key) for state in rows]) for key in ("q", "qd")
                )
                kinetic_j = 0.5 * (qd * _multiply_inertia(theta, q, qd)).sum(axis=1)
                binds = np.append(limited[of], False)
                blend = max(round(BLEND_S * setup.rate_hz), int(np.argmin(binds)))
                yield Rest(name, setup, rows, limited[of], kinetic_j, blend)


def find_limited_ticks(scenario: Scenario, name: str, states: Sequence[State]) -> np.ndarray:
    """Returns True for every record whose torque, or the one before, is at a limit of torque or
    rate.

    Over the period after a record the arm feels both torques (Eq. (8), extrapolated to
    mid-period).
    """
    setup = scenario.setup(name)
    most = np.asarray(setup.limits.tau_rate) / setup.rate_hz * (1.0 - RESIDUAL)
    tau = np.array([state.tau for state in states])
    limited = np.any(np.abs(np.diff(tau, axis=0, prepend=tau[:1])) >= most, axis=1)
    limited |= np.any(np.abs(tau) >= np.asarray(setup.tau_limit_nm) * (1.0 - RESIDUAL), axis=1)
    # of a fast arm the torque is not that of its law
    qd = np.array([state.qd for state in states])
    limited |= np.any(np.abs(qd) * setup.rest.damping > setup.tau_limit_nm, axis=1)
    limited_ticks: np.ndarray = limited | np.r_[False, limited[:-1]]
    return limited_ticks


def check_storage(session: FaultSession) -> Iterator[str]:
    """I5: at rest the storage of the adaptive law, with that of its integral, never rises.

    While the reference comes to rest, the storage rises by no more than the reference's work.
    """
    for name, (at_rest_j, before_j) in find_rises(session):
        if at_rest_j > RESIDUAL:
            yield f"{name}: the storage rises by {at_rest_j:.3g} J in a tick while it rests"
        if before_j > MOVING_RESIDUAL:
            yield f"{name}: the storage rises by {before_j:.3g} J more in a tick than its reference works"


def find_rises(session: FaultSession) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yields the rise of the storage per tick of every rest: with the reference at rest, and
    before, J.

    The second number is the rise beyond the work of the reference, (Kd qd + B r + w)'qd_des.
    Both are relative to the largest storage of the rest, if that exceeds 1 J. Ticks in which a
    limit keeps the torque from being that of the law are left out, because they say nothing of
    the law.
    """
    for rest in find_rests(session):
        if len(rest.states) < 3:
            continue
        S, power = compute_storage(session.scenario, rest)
        qd_des = rest.rows("qd_des")[1:]
        free = ~rest.limited[1:-1] & ~find_limited_law(rest) & ~find_given_up(rest)
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


def read_next_w(rest: Rest) -> np.ndarray:
    """Returns w of the tick after each record, which is in the record's memory, shape (K, n), N m."""
    joints = len(rest.states[0].q)
    first = 2 * (joints + 1) + PEERS
    return np.array([state.mem[first : first + joints] for state in rest.states])


def _or_tick_before(marks: np.ndarray) -> np.ndarray:
    """Returns True for each tick, except the first, that is marked or whose predecessor is
    marked.
    """
    either: np.ndarray = marks[1:] | marks[:-1]
    return either


def find_limited_law(rest: Rest) -> np.ndarray:
    """Returns True for every tick in which, or just before which, the law's own torque is at
    its limit.

    The torque of a record is limit(law) + w - B s. The sum can be within the limit although the
    law's part, computed from an estimate that is too large, is not.
    """
    gains = rest.setup.gains
    still = rest.setup.rest
    assert still is not None
    q, qd, q_des, qd_des, tau = (
        rest.rows(key)[1:] for key in ("q", "qd", "q_des", "qd_des", "tau")
    )
    w = read_next_w(rest)[:-1]
    slip = qd - qd_des + np.asarray(gains.Lambda) * (q - q_des)
    law = tau - w + np.asarray(still.damping) * slip
    most = np.asarray(rest.setup.tau_limit_nm) * (1.0 - RESIDUAL)
    return _or_tick_before((np.abs(law) >= most).any(axis=1))


def find_given_up(rest: Rest) -> np.ndarray:
    """Returns True for every tick whose w may fall faster than by its rule of rest, as the arm
    still brakes.
    """
    w = read_next_w(rest)
    with_motion = (w[:-1] * rest.rows("qd")[1:] > 0.0).any(axis=1)
    braking = np.arange(1, len(w)) <= LEAST_STOP_S * rest.setup.rate_hz + 1
    braking |= (rest.rows("qd_des")[1:] != 0.0).any(axis=1)
    return _or_tick_before(with_motion & braking)


def compute_storage(scenario: Scenario, rest: Rest) -> tuple[np.ndarray, np.ndarray]:
    """Returns V = 1/2 (r'M r + e'Lambda Kd e + theta~'Gamma^-1 theta~ + w'(k B)^-1 w) without
    the first record, J.

    The memory of a record holds w of the next one. The storage of Euler's rule, by which w
    advances, is less by 1/2 h w's. Also returns the power of the reference, (Kd qd + B r +
    w)'qd_des, W.
    """
    gains = rest.setup.gains
    theta = scenario.arms[rest.name].theta
    still = rest.setup.rest
    assert still is not None
    q, qd, q_des, qd_des, theta_hat = (
        rest.rows(key)[1:] for key in ("q", "qd", "q_des", "qd_des", "theta_hat")
    )
    w = read_next_w(rest)[:-1]
    e = q - q_des
    off = theta_hat - theta
    r = qd + np.asarray(gains.Lambda) * e
    kinetic = (r * _multiply_inertia(theta, q, r)).sum(axis=1)
    stored = (np.asarray(gains.Lambda) * np.asarray(gains.Kd) * e**2).sum(axis=1)
    learnt = (off**2 / np.asarray(gains.Gamma)).sum(axis=1)
    integral = (w**2 / np.asarray(still.vectors()["integral"])).sum(axis=1)
    euler = (w * (r - qd_des)).sum(axis=1) / rest.setup.rate_hz
    working = np.asarray(gains.Kd) * qd + np.asarray(still.damping) * r + w
    return 0.5 * (kinetic + stored + learnt + integral - euler), (working * qd_des).sum(axis=1)


def check_energy(session: FaultSession) -> Iterator[str]:
    """I12: the kinetic energy is at most 1.05 times that at the beginning, plus two works.

    These are the work of the gravity that the law does not know, and that of the last torque.
    """
    for rest in find_rests(session):
        first = rest.judged
        booked_j = find_gravity_work(session.scenario, rest) + find_blend_work(
            session.scenario, rest
        )
        allowed_j = MOST_ENERGY * rest.kinetic_j[0] + booked_j + LEAST_ENERGY_J
        for row in np.flatnonzero(rest.kinetic_j[first:] > allowed_j[first:])[:1]:
            at = rest.states[first + row]
            has_j = rest.kinetic_j[first + row]
            most_j = allowed_j[first + row]
            yield f"{rest.name} has {has_j:.3g} J at tick {at.tick} in {at.mode}; at most {most_j:.3g}"


def _find_gravity(scenario: Scenario, rest: Rest) -> tuple[np.ndarray, np.ndarray]:
    """Returns G, and G by the estimate, rows of records, N m."""
    arm = PlanarArmRows(scenario.arms[rest.name].theta, rest.setup.g_m_s2, (1.0, 1.0))
    q = rest.rows("q")
    known = rest.rows("theta_hat")
    still = np.zeros_like(q)
    theta = np.broadcast_to(scenario.arms[rest.name].theta, known.shape)
    return arm.law_torque(theta, q, still, still, still), arm.law_torque(
        known, q, still, still, still
    )


def find_gravity_work(scenario: Scenario, rest: Rest) -> np.ndarray:
    """Returns the largest work, until each record, of the gravity that the law does not know,
    J.

    The arm may have this work twice: w takes on the missing torque while the joint falls, and
    returns it.
    """
    G, known = _find_gravity(scenario, rest)
    power = ((known - G) * rest.rows("qd")).sum(axis=1)
    steps = 0.5 * (power[1:] + power[:-1]) / rest.setup.rate_hz
    work_j: np.ndarray = np.append(0.0, np.maximum(steps, 0.0).cumsum())
    return work_j


def find_blend_work(scenario: Scenario, rest: Rest) -> float:
    """Returns the energy that the last torque beyond known gravity may add while it decays, Eq.
    (5), J.
    """
    _, known = _find_gravity(scenario, rest)
    beyond_nm = np.abs(rest.rows("tau")[0] - known[0])
    return float(
        (beyond_nm**2 / np.asarray(rest.setup.rest.damping)).sum() / (2.0 * rest.setup.rate_hz)
    )


def check_speed(session: FaultSession) -> Iterator[str]:
    """I15: no joint exceeds 1.1 times the largest initial speed, plus the rise during the
    blend.

    The rise is D / B, where D is the largest unbalanced torque in the blend: M times the
    acceleration.
    """
    for rest in find_rests(session):
        speed = np.abs(rest.rows("qd")).max(axis=1)
        allowed = max(MOST_SPEED * speed[0], AT_REST_RAD_S) + find_rise(session.scenario, rest)
        for row in np.flatnonzero(speed[rest.judged :] > allowed)[:1]:
            at = rest.states[rest.judged + row]
            yield f"{rest.name} is as fast as {speed.max():.3g} rad/s by {at.mode}; at most {allowed:.3g}"


def find_rise(scenario: Scenario, rest: Rest) -> float:
    """Returns the rise of the speed during the blend, D / B of the joint where it is largest,
    rad/s.
    """
    return float((_find_unbalanced(scenario, rest) / np.asarray(rest.setup.rest.damping)).max())


def _find_unbalanced(scenario: Scenario, rest: Rest) -> np.ndarray:
    """Returns the largest M times acceleration of each joint during the blend, N m."""
    q, v = (rest.rows(key)[: rest.blend + 1] for key in ("q", "qd"))
    a = np.diff(v, axis=0) * rest.setup.rate_hz
    torque = np.abs(_multiply_inertia(scenario.arms[rest.name].theta, q[1:], a))
    largest_nm: np.ndarray = torque.max(axis=0, initial=0.0)
    return largest_nm


def check_rest(session: FaultSession) -> Iterator[str]:
    """I13: an arm is at rest within the time that `scenario check` states, and stays at rest.

    A blend beyond 0.15 s, which the limit of the torque's rate causes, is added to that time.
    """
    for rest in find_rests(session):
        stated_s = find_rest_bounds(session.scenario, rest.name).rest_s
        longer = max(0, rest.blend - round(BLEND_S * rest.setup.rate_hz))
        within = longer + round(stated_s * rest.setup.rate_hz)
        speeds = np.abs(rest.rows("qd")).max(axis=1)[within:]
        for row in np.flatnonzero(speeds > AT_REST_RAD_S)[:1]:
            at = rest.states[within + row]
            yield f"{rest.name} still moves at {speeds[row]:.3g} rad/s at tick {at.tick} in {at.mode}"


def check_travel(session: FaultSession) -> Iterator[str]:
    """I14: after its blend an arm stays within its stopping distance of its beginning."""
    for rest in find_rests(session):
        q = rest.rows("q")
        travel = np.abs(q - q[0]).max(axis=1)
        allowed_rad = find_stopping_distance(session.scenario, rest)
        for row in np.flatnonzero(travel > allowed_rad)[:1]:
            at = rest.states[row]
            if rest.judged < len(rest.states):
                yield f"{rest.name} goes {travel.max():.3g} rad by {at.mode}; at most {allowed_rad:.3g}"


def find_stopping_distance(scenario: Scenario, rest: Rest) -> float:
    """Returns the distance of each joint until all rest, by the reference and by its torque,
    rad.

    The reference moves by |v| T / 2. An initially unbalanced torque d, M times the observed
    acceleration, is taken on by w while s adds up to d / (k B) = 4 time_s d / B.
    """
    still = rest.setup.rest
    assert still is not None
    q, v = (rest.rows(key)[: rest.blend + 1] for key in ("q", "qd"))
    stop_s = max(LEAST_STOP_S, float((np.abs(v[0]) / still.deceleration).max()))
    a = np.diff(v, axis=0) * rest.setup.rate_hz
    d_nm = np.abs(_multiply_inertia(scenario.arms[rest.name].theta, q[1:], a)).max(
        axis=0, initial=0.0
    )
    aside_rad = 4.0 * still.time_s * d_nm / still.damping
    return MOST_WAY * float((np.abs(v[0]) * stop_s / 2.0 + aside_rad).max())

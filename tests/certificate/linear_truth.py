"""How fast small motions grow about a common rest, computed without a line of the program.

Planar arms of two joints rest at one pose, under P+d and exact gravity compensation. They follow each
other over links that delay and lose samples. Near the rest, with x_i the small motion of arm i and S_i the
gradient of its gravity torques, its motors get, at tick k,

    tau_i = K_i (ref_i - x_i) - d_i x_i' + S_i x_i,   ref_i = sum_j alpha_ij x_j(newest sample of j at i)

and within the tick the arm moves by

    M_i x_i'' + S_i x_i = tau_k, or 1.5 tau_k - 0.5 tau_{k-1}

the first for the scheme `digital`, the second for `second_order`: gravity acts all the time, and what
balances it is held. The loop is simulated for many minutes from a random state, and its rate of growth is the slope of
the logarithm of the largest speed. All arms may shift together without any force, so that a common shift is
taken away again and again.

Nothing of trilat_net is imported here.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]
US = 1_000_000
WINDOW_S = 4.0
"""The length of the windows in which the largest speed is measured, unless the table of a link is longer."""
LEAST_WINDOWS = 20
EARLY_SHARE = 0.3
"""The share of a run that is left out, because faster modes decay in it."""


class Way(NamedTuple):
    """What a link does to its samples.

    Attributes:
        delay_ms: constant part of the delay.
        amplitude_ms, period_s, phase_rad: of its sine.
        points: of a looped table, (time s, delay ms); empty without one.
        loss, burst: share of samples lost, and their mean number in a row; 0 for independent losses.
    """

    delay_ms: float = 0.0
    amplitude_ms: float = 0.0
    period_s: float = 1.0
    phase_rad: float = 0.0
    points: tuple[tuple[float, float], ...] = ()
    loss: float = 0.0
    burst: float = 0.0

    @property
    def table_s(self) -> float:
        """Returns the time after which a table starts again; its last point lasts as long as
        the one before.
        """
        if not self.points:
            return 0.0
        return 2.0 * self.points[-1][0] - self.points[-2][0]


class Loop(NamedTuple):
    """Arms about a common rest, and what joins them.

    Attributes:
        inertias: M at the rest, shape (sites, 2, 2), kg m^2.
        gravity: S at the rest, shape (sites, 2, 2), N m/rad.
        stiffness, damping: per site and joint, shape (sites, 2), N m/rad and N m s/rad.
        shares: alpha, shape (sites, sites); rows sum to 1.
        ways: link of (receiver, sender).
        rate_hz: ticks per second, of all sites.
        second_order: True for the scheme of that name, False for `digital`.
        hold_s: age of a sample from which the reference stays where it was; None: never.
        return_s: time in which it then comes back along 3 x^2 - 2 x^3.
    """

    inertias: Array
    gravity: Array
    stiffness: Array
    damping: Array
    shares: Array
    ways: dict[tuple[int, int], Way]
    rate_hz: int
    second_order: bool
    hold_s: float | None = None
    return_s: float = 1.0


def planar_inertia(
    lengths_m: Sequence[float],
    masses_kg: Sequence[float],
    centres_m: Sequence[float],
    inertias_kg_m2: Sequence[float],
    q2_rad: float,
) -> Array:
    """Returns M of a planar arm of two links, from any textbook, kg m^2."""
    l1 = lengths_m[0]
    m1, m2 = masses_kg
    c1, c2 = centres_m
    i1, i2 = inertias_kg_m2
    cosine = np.cos(q2_rad)
    m22 = i2 + m2 * c2**2
    m12 = m22 + m2 * l1 * c2 * cosine
    m11 = i1 + m1 * c1**2 + m22 + m2 * l1**2 + 2.0 * m2 * l1 * c2 * cosine
    return np.array([[m11, m12], [m12, m22]])


def gravity_gradient(
    lengths_m: Sequence[float],
    masses_kg: Sequence[float],
    centres_m: Sequence[float],
    q_rad: Sequence[float],
    g_m_s2: float = 9.81,
) -> Array:
    """Returns the derivative of the gravity torques of such an arm, whose first angle is from
    the horizontal, N m/rad.
    """
    l1 = lengths_m[0]
    m1, m2 = masses_kg
    c1, c2 = centres_m
    q1, q2 = q_rad
    outer = -m2 * c2 * g_m_s2 * np.sin(q1 + q2)
    inner = -(m1 * c1 + m2 * l1) * g_m_s2 * np.sin(q1)
    return np.array([[inner + outer, outer], [outer, outer]])


def _move_exactly(inertia: Array, gravity: Array, h_s: float) -> Array:
    """Returns the transition of (x, x') over a tick, and the effect of a held torque, shape (4, 6)."""
    mobility = np.linalg.inv(inertia)
    rates = np.zeros((6, 6))
    rates[:2, 2:4] = np.eye(2)
    rates[2:4, :2] = -mobility @ gravity
    rates[2:4, 4:] = mobility
    return np.asarray(expm(h_s * rates)[:4])


def list_newest(
    way: Way, ticks: int, rate_hz: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Returns the newest arrived sample at each tick, -1 without any; a sample is used a tick
    after its arrival at the earliest.
    """
    sent = np.arange(ticks)
    tick_us = US // rate_hz
    sent_us = sent * tick_us
    if way.points:
        times_us = np.array([round(US * t_s) for t_s, _ in way.points])
        table_us = np.array([round(1e3 * delay_ms) for _, delay_ms in way.points])
        loop_us = 2 * times_us[-1] - times_us[-2]
        index = np.searchsorted(times_us, sent_us % loop_us, side="right") - 1
        delay_us = table_us[np.maximum(index, 0)]
    else:
        turns = sent_us / (US * way.period_s)
        sine = np.sin(2.0 * np.pi * turns + way.phase_rad)
        delay_us = np.rint(1e3 * (way.delay_ms + way.amplitude_ms * sine)).astype(np.int64)
    arrives = np.maximum(-(-(sent_us + delay_us) // tick_us), sent + 1)
    if way.loss:
        lost = _draw_losses(way, ticks, rng)
        sent = sent[~lost]
        arrives = arrives[~lost]
    newest = np.full(ticks, -1)
    in_time = arrives < ticks
    np.maximum.at(newest, arrives[in_time], sent[in_time])
    return np.maximum.accumulate(newest)


def _draw_losses(way: Way, ticks: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draws losses one by one, or in bursts of geometric length."""
    if not way.burst:
        return rng.random(ticks) < way.loss
    lost = np.zeros(ticks, dtype=bool)
    at = 0
    between = way.burst * (1.0 - way.loss) / way.loss
    while at < ticks:
        at += rng.geometric(1.0 / between)
        length = rng.geometric(1.0 / way.burst)
        lost[at : at + length] = True
        at += length
    return lost


def measure_growth(loop: Loop, span_s: float, seed: int = 0) -> float:
    """Returns the rate of the fastest growing, or slowest decaying, motion of a loop, 1/s."""
    rng = np.random.default_rng(seed)
    window_s = max([WINDOW_S, *(way.table_s for way in loop.ways.values())])
    span_s = max(span_s, LEAST_WINDOWS * window_s)
    count = len(loop.shares)
    ticks = round(span_s * loop.rate_hz)
    newest = np.zeros((ticks, count, count), dtype=np.int64)
    for (i, j), way in loop.ways.items():
        newest[:, i, j] = list_newest(way, ticks, loop.rate_hz, rng)
    hold = ticks if loop.hold_s is None else round(loop.hold_s * loop.rate_hz)
    sizes = _simulate(
        np.array(
            [
                _move_exactly(inertia, gravity, 1.0 / loop.rate_hz)
                for inertia, gravity in zip(loop.inertias, loop.gravity, strict=True)
            ]
        ),
        loop.gravity,
        loop.stiffness,
        loop.damping,
        loop.shares,
        newest,
        rng.standard_normal((count, 2)),
        loop.second_order,
        hold,
        max(1, round(loop.return_s * loop.rate_hz)),
        round(window_s * loop.rate_hz),
    )
    late = sizes[int(EARLY_SHARE * len(sizes)) :]
    return float(np.polyfit(window_s * np.arange(len(late)), late, 1)[0])


@njit
def _simulate(
    moves: Array,
    gravity: Array,
    stiffness: Array,
    damping: Array,
    shares: Array,
    newest: NDArray[np.int64],
    start: Array,
    second_order: bool,
    hold: int,
    returning: int,
    window: int,
) -> Array:
    """Returns the logarithm of the largest speed in each window; the state is rescaled after
    each window.
    """
    ticks, count, _ = newest.shape
    reach = 1
    for k in range(ticks):
        for i in range(count):
            for j in range(count):
                if shares[i, j] > 0.0 and newest[k, i, j] >= 0:
                    reach = max(reach, k - newest[k, i, j] + 1)
    past = np.zeros((reach, count, 2))
    past[:] = start
    x = start.copy()
    v = np.zeros((count, 2))
    before = np.zeros((count, 2))
    ref = start.copy()
    held = start.copy()
    since = np.full(count, -1)
    stale = np.zeros(count, dtype=np.bool_)
    state = np.zeros(6)
    sizes = np.zeros(ticks // window)
    scale = 0.0
    largest = 0.0
    for k in range(ticks):
        past[k % reach] = x
        tau = np.zeros((count, 2))
        for i in range(count):
            peers = np.zeros(2)
            is_stale = False
            for j in range(count):
                if shares[i, j] > 0.0:
                    used = max(newest[k, i, j], 0)
                    peers += shares[i, j] * past[used % reach, j]
                    is_stale |= k - newest[k, i, j] > hold and newest[k, i, j] >= 0
            if is_stale:
                if not stale[i]:
                    held[i] = ref[i]
                ref[i] = held[i]
                since[i] = k
            elif since[i] >= 0 and k - since[i] < returning:
                share = (k - since[i]) / returning
                ref[i] = held[i] + share * share * (3.0 - 2.0 * share) * (peers - held[i])
            else:
                ref[i] = peers
            stale[i] = is_stale
            for n in range(2):
                tau[i, n] = stiffness[i, n] * (ref[i, n] - x[i, n]) - damping[i, n] * v[i, n]
                tau[i, n] += gravity[i, n, 0] * x[i, 0] + gravity[i, n, 1] * x[i, 1]
        for i in range(count):
            state[:2] = x[i]
            state[2:4] = v[i]
            state[4:] = 1.5 * tau[i] - 0.5 * before[i] if second_order and k else tau[i]
            after = moves[i] @ state
            x[i] = after[:2]
            v[i] = after[2:]
            largest = max(largest, np.abs(v[i]).max())
        before[:] = tau
        if (k + 1) % window == 0:
            n = (k + 1) // window - 1
            sizes[n] = np.log(max(largest, 1e-300)) + scale
            shift = x[0].copy()
            for i in range(count):
                x[i] = (x[i] - shift) / largest
                v[i] /= largest
                before[i] = (before[i] - gravity[i] @ shift) / largest
                ref[i] = (ref[i] - shift) / largest
                held[i] = (held[i] - shift) / largest
                for m in range(reach):
                    past[m, i] = (past[m, i] - shift) / largest
            scale += np.log(largest)
            largest = 0.0
    return sizes

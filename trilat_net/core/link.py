"""The receiving end of one directed link j -> i: where delay is applied.

Law (L2): a sample of tick m on a link with delay T is due at t_m + T, on nominal stamps, in integer
nanoseconds; it is in use from the first tick of the receiver at or after that, never at its own stamp.
When it really arrived has no influence as long as it arrived before it was due.

A link is a calendar. `accept` files a sample under its own tick and writes into the page of the tick
that releases it which sample is the newest there; `recall` turns to the page of the present tick. Both
cost the same whatever the delay. Newest wins: an older sample never replaces a newer one.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arm import JOINTS, Array
from .grid import NS_PER_S, first_tick_at, tick_ns
from .jit import leaf

# One row per peer, in scenario order. `used` is -1 until the first sample is released; until then q and
# qd are the peer's start pose, at rest (L7). The last four count arrivals since the start.
LINK = np.dtype(
    (
        np.record,
        [
            ("alpha", "f8"),
            ("delay_ns", "i8"),
            ("rate_hz", "i8"),
            ("used", "i8"),
            ("q", "f8", (JOINTS,)),
            ("qd", "f8", (JOINTS,)),
            ("accepted", "i8"),
            ("late", "i8"),
            ("duplicate", "i8"),
            ("refused", "i8"),
        ],
    )
)
# One row per sample that may wait: its tick (-1: empty) and the peer's joint state.
SAMPLE = np.dtype((np.record, [("tick", "i8"), ("q", "f8", (JOINTS,)), ("qd", "f8", (JOINTS,))]))

AHEAD_LIMIT_S = 10
AHEAD_LIMIT_NS = AHEAD_LIMIT_S * NS_PER_S
"""A stamp further ahead of the receiver than this is refused."""

Row = Any
"""A row of a structured array; NumPy's types cannot name its fields."""

Rows = NDArray[np.void]
Ticks = NDArray[np.int64]


def calendar_pages(delay_ns: int, rate_hz: int) -> int:
    """Returns how many ticks a calendar must span for a delay: that delay and what may run ahead of it."""
    ticks = first_tick_at(delay_ns + AHEAD_LIMIT_NS, rate_hz) + 2
    return 1 << int(ticks).bit_length()


@leaf
def release_tick(tick: int, link: Row, rate_hz: int) -> int:
    """Returns the receiver's tick at which sample `tick` comes into use if it has arrived by then."""
    stamp_ns = tick_ns(tick, link.rate_hz)
    return first_tick_at(stamp_ns + max(link.delay_ns, 1), rate_hz)


@leaf
def accept(
    k: int, rate_hz: int, tick: int, q: Array, qd: Array, link: Row, samples: Rows, calendar: Ticks
) -> None:
    """Takes one arrival into a link; what it cannot use it counts.

    Args:
        k: the receiver's present tick.
        rate_hz: the receiver's rate, Hz.
        tick: the sample's own tick, at the peer's rate.
        q: the peer's joint angles, shape (n,), rad.
        qd: the peer's joint velocities, shape (n,), rad/s.
        link: the link's row, dtype LINK.
        samples: where samples wait, shape (pages,), dtype SAMPLE.
        calendar: newest sample that each of the receiver's ticks releases, or -1, shape (pages,).
    """
    link.accepted += 1
    # whole seconds first: a hostile tick must not overflow the arithmetic that comes after
    far_ahead = tick // link.rate_hz > k // rate_hz + AHEAD_LIMIT_S + 1
    if tick < 0 or far_ahead or tick_ns(tick, link.rate_hz) - tick_ns(k, rate_hz) > AHEAD_LIMIT_NS:
        link.refused += 1
        return
    slot: Row = samples[tick % samples.shape[0]]
    if slot.tick == tick:
        link.duplicate += 1
        return
    release = release_tick(tick, link, rate_hz)
    if release < k:
        link.late += 1
        release = k
    if slot.tick > tick or tick <= link.used:
        return
    slot.tick = tick
    slot.q[:] = q
    slot.qd[:] = qd
    page = release % calendar.shape[0]
    calendar[page] = max(calendar[page], tick)


@leaf
def recall(k: int, link: Row, samples: Rows, calendar: Ticks) -> None:
    """Brings into use the newest sample that tick k releases, if there is one; else the last one stays.

    Args:
        k: the receiver's present tick; every tick must be recalled once, in order.
        link: the link's row, dtype LINK.
        samples: where samples wait, shape (pages,), dtype SAMPLE.
        calendar: newest sample that each of the receiver's ticks releases, or -1, shape (pages,).
    """
    page = k % calendar.shape[0]
    newest = calendar[page]
    calendar[page] = -1
    slot: Row = samples[newest % samples.shape[0]]
    if newest > link.used and slot.tick == newest:
        link.used = newest
        link.q[:] = slot.q
        link.qd[:] = slot.qd

"""The receiving end of one directed link j -> i, which applies the delay.

Invariant (L2): a sample of tick m is due when its channel says so, counted from its nominal
stamp in integer nanoseconds; it is in use from the receiver's first tick at or after that,
never at its own stamp. Its real arrival has no influence if it precedes the due time. (On a
measured link a sample is due at once, so there the arrival alone counts.)

A link is a calendar. `accept_sample` files a sample in the page of the tick that releases it,
if none newer is there; `release_sample` reads the page of the present tick. Both cost the same
at any delay. Newest wins: an older sample never replaces a newer one. So a calendar need only
span what may wait, while the times at which samples are due, eight bytes each, are kept for as
long as a late one or a copy may come.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from .channel import LOST, schedule_deliveries
from .delay import MAX_DELAY_US, DelayKind
from .jit import leaf
from .ticks import NS_PER_S, LinkCounts, first_tick_at, tick_ns
from .vectors import Array, IntArray, Points, Row, RowArray, put

_CHANNEL = ("models", "model", "outage_first", "outage_count", "scheduled", "bad", "due_before")


def _sample_vectors(shared: int) -> list[tuple[str, str, tuple[int]]]:
    return [(name, "f8", (shared,)) for name in ("q", "qd", "tau_x")]


@cache
def link_dtype(shared: int) -> np.dtype[np.void]:
    """Returns the layout of a link on which samples of so many coordinates come: one row per
    peer.

    They stand in scenario order. `used` is -1 until the first sample is released; until then q
    and qd are the peer's start pose, at rest (L7). It is `new` in the tick that released it, at
    `used_ns`; `tick` and `age_s` are filled in for laws that look at their peers. `gone` is 0
    of a peer that is there, -1 of one that is lost, and of one that is heard again the time
    since when, ns: see `lost_peers`.
    """
    fields = [
        ("alpha", "f8"),
        ("alpha_rate", "f8"),
        ("rate_hz", "i8"),
        *((name, "i8") for name in ("used", "used_ns", "tick", "new")),
        ("age_s", "f8"),
        *_sample_vectors(shared),
        ("key", "u8"),
        *((name, "i8") for name in ("bit", "followed", "dispensable")),
        ("gone", "f8"),
        *((name, "i8") for name in _CHANNEL),
        ("memory", "f8"),
        *((name, "i8") for name in LinkCounts._fields),
    ]
    return np.dtype((np.record, fields))


@cache
def sample_dtype(shared: int) -> np.dtype[np.void]:
    """Returns the layout of a calendar's pages: one per tick of the receiver, a power of two of
    them.

    A page holds the newest sample that its tick releases, with the sample's own tick (-1:
    none).
    """
    return np.dtype((np.record, [("tick", "i8"), *_sample_vectors(shared)]))


class ChannelArrays(NamedTuple):
    """What peers' laws send besides, in the order in which the receiver's law has it; one axis
    more per peer.

    Attributes:
        waiting: of the samples that wait, by the calendar's page, shape (pages, C).
        received: of the sample in use, shape (C,); zeros before the first.
        places: where each number stands among those that come with a sample; -1: it does not,
            and is 0.
    """

    waiting: Array
    received: Array
    places: IntArray


class LinkArrays(NamedTuple):
    """The arrays of one link.

    Attributes:
        state: shape (1,), see `link_dtype`.
        models: what its channel does, shape (M,), LINK_MODEL_DTYPE.
        dues: when the last samples are due, ns, or LOST; of one that has come `_FILED` less
            that.
        calendar: the samples that wait, shape (pages,), see `sample_dtype`.
        points: the site's traces and outages, shape (n, 2).
        channel: what the peer's law sends besides; None: the site's law does not look at it.
    """

    state: RowArray
    models: RowArray
    dues: IntArray
    calendar: RowArray
    points: Points
    channel: ChannelArrays | None


AHEAD_LIMIT_S = 10
AHEAD_LIMIT_NS = AHEAD_LIMIT_S * NS_PER_S
"""A stamp further ahead of the receiver than this is refused."""

_MEASURED = int(DelayKind.MEASURED)


_FILED = LOST - 1
"""No time that a sample is due is negative, so that what is not above this tells of one that
has come.
"""


def span_ticks(span_ns: int, rate_hz: int) -> int:
    """Returns the ticks of a time; `first_tick_at` for those who need not load the compiled
    core.
    """
    return -(-span_ns * rate_hz // NS_PER_S)


def calendar_pages(
    rate_hz: int, delay_us: int = MAX_DELAY_US, ahead_ns: int = AHEAD_LIMIT_NS
) -> int:
    """Returns the pages of a calendar spanning a delay of samples from so far ahead; by default
    the most.
    """
    return 1 << (span_ticks(delay_us * 1000 + ahead_ns, rate_hz) + 2).bit_length()


@leaf
def release_tick(tick: int, rate_hz: int, link: LinkArrays) -> int:
    """Returns the receiver's tick at which sample `tick` comes into use if it has arrived by
    then.

    LOST if it never does, or if it is so old that its due time is kept no more.
    """
    row: Row = link.state[0]
    dues = link.dues
    schedule_deliveries(
        sample=tick, link=row, models=link.models, dues=dues, points=link.points
    )
    due_ns = dues[tick % dues.shape[0]]
    if due_ns == LOST or tick <= row.scheduled - dues.shape[0]:
        return LOST
    if due_ns <= _FILED:
        due_ns = _FILED - due_ns
    return first_tick_at(max(due_ns, tick_ns(tick, row.rate_hz) + 1), rate_hz)


@leaf
def _far_ahead(k: int, rate_hz: int, tick: int, peer_rate_hz: int) -> bool:
    """True if a sample's stamp is more than AHEAD_LIMIT_S ahead of tick k."""
    # a hostile tick must not overflow the rest
    if tick // peer_rate_hz > k // rate_hz + AHEAD_LIMIT_S + 1:
        return True
    return tick_ns(tick, peer_rate_hz) - tick_ns(k, rate_hz) > AHEAD_LIMIT_NS


@leaf
def _file_sent(channel: ChannelArrays | None, page: int, sent: Array) -> None:
    if channel is None:
        return
    for c in range(channel.places.shape[0]):
        place = channel.places[c]
        channel.waiting[page, c] = sent[place] if place >= 0 else 0.0


@leaf
def _use_sent(channel: ChannelArrays | None, page: int) -> None:
    if channel is not None:
        put(channel.received, channel.waiting[page])


@leaf
def accept_sample(
    k: int,
    rate_hz: int,
    tick: int,
    q: Array,
    qd: Array,
    tau_x: Array,
    sent: Array,
    link: LinkArrays,
) -> None:
    """Files one arrival of a peer's tick in a link at the receiver's tick k; counts what it
    cannot use.

    `sent` is what the peer's law sends besides its motion; a site whose law does not look at it
    takes any.
    """
    row: Row = link.state[0]
    dues = link.dues
    calendar = link.calendar
    row.accepted += 1
    if tick < 0 or (tick > row.scheduled and _far_ahead(k, rate_hz, tick, row.rate_hz)):
        row.refused += 1
        return
    place = tick % dues.shape[0]
    if row.scheduled - dues.shape[0] < tick <= row.scheduled and dues[place] <= _FILED:
        row.duplicate += 1
        return
    release = release_tick(tick, rate_hz, link)
    if release == LOST:
        row.lost += 1
        return
    if release < k:
        model: Row = link.models[row.model]
        if model.kind != _MEASURED:
            row.late += 1
        release = k
    if release - k >= calendar.shape[0]:  # whoever steps a site makes room first
        row.refused += 1
        return
    dues[place] = _FILED - dues[place]
    if tick <= row.used:
        row.superseded += 1
        return
    page = release & (calendar.shape[0] - 1)
    slot: Row = calendar[page]
    if slot.tick >= 0:
        row.superseded += 1
    if slot.tick < tick:
        slot.tick = tick
        put(slot.q, q)
        put(slot.qd, qd)
        put(slot.tau_x, tau_x)
        _file_sent(link.channel, page, sent)


@leaf
def release_sample(k: int, rate_hz: int, link: LinkArrays) -> None:
    """Brings into use the newest sample that tick k releases, if there is one; else the last
    one stays.

    Every tick must be recalled once, in order. The channel is advanced to t_k here, so that a
    long silence of the peer costs nothing at its end.
    """
    row: Row = link.state[0]
    row.new = 0
    calendar = link.calendar
    sample = k if row.rate_hz == rate_hz else k * row.rate_hz // rate_hz
    schedule_deliveries(
        sample=sample, link=row, models=link.models, dues=link.dues, points=link.points
    )
    page = k & (calendar.shape[0] - 1)
    slot: Row = calendar[page]
    newest = slot.tick
    if newest < 0:
        return
    slot.tick = -1
    if newest > row.used:
        row.used = newest
        row.used_ns = tick_ns(k, rate_hz)
        row.new = 1
        put(row.q, slot.q)
        put(row.qd, slot.qd)
        put(row.tau_x, slot.tau_x)
        _use_sent(link.channel, page)
    else:
        row.superseded += 1

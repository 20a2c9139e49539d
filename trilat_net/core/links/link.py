"""Holds each received message until its delay in the simulated network has passed.

The real network may be faster than the network that an experiment emulates. The receiver
therefore holds each sample until its due time, which is the sending time plus the simulated
delay.

Samples wait in a ring buffer called the calendar, which has one page for each of the receiver's
next ticks. `accept_sample` writes a sample to the page of the tick that will use it, unless
that page already holds a newer one. `release_sample` reads the page of the current tick. Both
take the same time for any delay. Due times are kept longer than samples, for as long as a late
sample or a duplicate may arrive.

Invariant (law L2 of docs/develop/design.md):
    - The due time of a sample is an integer in ns. It follows from the sending time and from
      the delay and loss model of the link. The sample is used from the receiver's first tick at
      or after its due time, but never at the time when it was sent.
    - The actual arrival time is irrelevant if it is before the due time. On a link without a
      simulated delay, a sample is used as soon as it arrives.
    - The newest sample wins: an older sample never replaces a newer one.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from ..step.jit import leaf
from ..step.row_fields import LinkRow, SampleRow, row_dtype
from ..step.ticks import NS_PER_S, first_tick_at, tick_ns
from ..step.vectors import Array, IntArray, Points, Row, RowArray, put
from .channel import LOST, schedule_deliveries
from .delay import MAX_DELAY_US, DelayKind


@cache
def link_dtype(shared: int) -> np.dtype[np.void]:
    """Returns the NumPy structured data type for the state of a network link, see `LinkRow`.

    There is one array element per link.

    Args:
        shared: Number of coordinates that sites share, which is the length of the row's
            vectors.
    """
    return row_dtype("link", {"shared": shared})


@cache
def sample_dtype(shared: int) -> np.dtype[np.void]:
    """Returns the NumPy data type of a message that waits until its simulated delay has passed.

    The fields are those of `SampleRow`.

    Args:
        shared: Number of coordinates of a sample: joint angles, or coordinates of the end
            effector.
    """
    return row_dtype("sample", {"shared": shared})


class ChannelArrays(NamedTuple):
    """Arrays of values that the control law of another arm sends, such as energies.

    There are C values, in the order in which the law of this arm reads them. Arrays for several
    senders or receivers have additional leading axes.

    Attributes:
        waiting: Values received with samples whose simulated delay has not passed yet, one row
            per entry of the ring buffer `LinkArrays.calendar`, shape (pages, C).
        received: Values received with the sample in use, shape (C,). Zeros before the first
            sample.
        columns: Index of each value among all values received with a sample, shape (C,). -1 for
            a value that the other law does not send; such a value is 0.
    """

    waiting: Array
    received: Array
    columns: IntArray


class LinkArrays(NamedTuple):
    """Arrays that hold the state of one network link, for compiled code.

    Messages from the peer wait here until their simulated delay has passed.

    Attributes:
        state: State of the link, shape (1,), see `link_dtype`.
        models: Delay and loss models of the link, in the order in which they take effect.
        dues: Times at which the newest samples are to be delivered, in ns since the start of
            the session, or LOST for a lost sample. This is a ring buffer: sample m is at index
            m modulo the length. After the sample has arrived, the entry becomes `_FILED` minus
            the delivery time.
        calendar: Ring buffer of the samples whose delay has not passed, see `sample_dtype`.
        points: Traces and outages of all links of the receiver, shape (n, 2).
        channel: Additional values sent by the peer's control law. None if the receiver's law
            does not read them.
    """

    state: RowArray
    models: RowArray
    dues: IntArray
    calendar: RowArray
    points: Points
    channel: ChannelArrays | None


AHEAD_LIMIT_S = 10
AHEAD_LIMIT_NS = AHEAD_LIMIT_S * NS_PER_S
"""Largest time by which a stamp may be ahead; samples further ahead are rejected.
"""

_MEASURED = int(DelayKind.MEASURED)


_FILED = LOST - 1
"""Marks samples that have arrived.

Due times are never negative, so `_FILED - due` never exceeds this value, and LOST is above it.
"""


def span_ticks(span_ns: int, rate_hz: int) -> int:
    """Converts a duration to a number of ticks, rounded up.

    For example, 2.5 ms take 3 ticks of a loop at 1000 Hz. The result is the same as that of
    `first_tick_at`, but this function is plain Python, for callers that have not loaded the
    compiled code.

    Args:
        span_ns: The duration, ns.
        rate_hz: Tick rate, Hz.
    """
    return -(-span_ns * rate_hz // NS_PER_S)


def calendar_pages(
    rate_hz: int, delay_us: int = MAX_DELAY_US, ahead_ns: int = AHEAD_LIMIT_NS
) -> int:
    """Returns the number of pages in a calendar, the ring buffer that holds delayed messages.

    There is one page for each control period of the receiver in which a message may first be
    used. The default arguments give the largest number that any network link needs.

    Args:
        rate_hz: Rate of the receiver's control loop, Hz.
        delay_us: Longest delay, us.
        ahead_ns: Largest amount by which a sender's clock may be ahead of the receiver's, ns.

    Returns:
        The number of pages, a power of two, so that a bit mask can replace a modulo operation.
    """
    longest_wait_ticks = span_ticks(delay_us * 1000 + ahead_ns, rate_hz)
    # Two ticks more: the present tick, and a reserve of one tick for rounding.
    # 1 << n.bit_length() is the next power of two above n.
    least_pages = longest_wait_ticks + 2
    return 1 << least_pages.bit_length()


@leaf
def release_tick(tick: int, rate_hz: int, link: LinkArrays) -> int:
    """Computes the control period of the receiver in which a sample is first used.

    Args:
        tick: Tick in which the sample was sent.
        rate_hz: Rate of the receiver's control loop, Hz.
        link: Arrays of the link.

    Returns:
        The receiver's tick, if the sample arrives in time. LOST if the link drops the sample,
        or if the sample is so old that its delivery time is no longer stored.
    """
    row: LinkRow = link.state[0]
    dues = link.dues
    # Compute the due times (delivery times) up to this sample, unless they are already known.
    schedule_deliveries(
        sample=tick, link=row, models=link.models, dues=dues, points=link.points
    )
    kept = dues.shape[0]
    due_ns = dues[tick % kept]  # a ring buffer
    # The entry of an older sample contains the due time of a newer sample.
    oldest_kept = row.scheduled - kept + 1
    if due_ns == LOST or tick < oldest_kept:
        return LOST

    # After the arrival of a sample, the entry is `_FILED` minus the due time.
    has_arrived = due_ns <= _FILED
    if has_arrived:
        due_ns = _FILED - due_ns
    # A sample is never used at the time when it was sent.
    stamp_ns = tick_ns(tick, row.rate_hz)
    return first_tick_at(max(due_ns, stamp_ns + 1), rate_hz)


@leaf
def _is_far_ahead(k: int, rate_hz: int, tick: int, peer_rate_hz: int) -> bool:
    """Returns True if a message claims to come from more than AHEAD_LIMIT_S in the future.

    Such a message is rejected, because it would have to wait too long. The sender's clock may
    be wrong.

    Args:
        k: Current tick of the receiver.
        rate_hz: Tick rate of the receiver, Hz.
        tick: Tick of the sender in which it sent the sample.
        peer_rate_hz: Tick rate of the sender, Hz.
    """
    # Compare whole seconds first: the nanoseconds of a hostile stamp would overflow int64.
    if tick // peer_rate_hz > k // rate_hz + AHEAD_LIMIT_S + 1:
        return True
    return tick_ns(tick, peer_rate_hz) - tick_ns(k, rate_hz) > AHEAD_LIMIT_NS


@leaf
def _file_sent(channel: ChannelArrays | None, page: int, sent: Array) -> None:
    """Stores the values sent by another arm's control law until they may be used.

    The values (for example, an energy) arrived in the same message as the state of the other
    arm. They wait with that state until the simulated delay of the message has passed.

    Args:
        channel: Arrays of these values; None if the receiver's law ignores them.
        page: Index of the ring buffer entry in which the sample waits.
        sent: The values that arrived, in the order used by the sender.
    """
    if channel is None:
        return
    for c in range(channel.columns.shape[0]):
        column = channel.columns[c]
        channel.waiting[page, c] = sent[column] if column >= 0 else 0.0


@leaf
def _use_sent(channel: ChannelArrays | None, page: int) -> None:
    """Passes the values sent by another arm's control law to the control law of this arm.

    The values (for example, an energy) arrived in the same message as the state of the other
    arm. This function is called when the simulated delay of that message has passed.

    Args:
        channel: Arrays of these values; None if the receiver's law ignores them.
        page: Index of the ring buffer entry in which the sample waited.
    """
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
    """Stores a message received from another arm until its simulated delay has passed.

    A message that arrives after its delivery time is used in the current tick, unless a newer
    message is already in use. Messages that cannot be used are counted as rejected, lost or
    duplicate.

    Args:
        k: Current tick of the receiver.
        rate_hz: Rate of the receiver's control loop, Hz.
        tick: Tick of the peer in which it sent the sample.
        q: Joint angles or pose of the peer, rad or m.
        qd: Derivative of q.
        tau_x: External torque of the peer, N m; the torque ON its arm is the negative.
        sent: Additional values from the peer's control law, ignored if the receiver's law does
            not read them.
        link: Arrays of the link; updated in place.
    """
    row: LinkRow = link.state[0]
    dues = link.dues
    calendar = link.calendar
    row.accepted += 1
    # Delivery times have been computed up to the sample `row.scheduled`.
    is_scheduled = tick <= row.scheduled
    if tick < 0 or (not is_scheduled and _is_far_ahead(k, rate_hz, tick, row.rate_hz)):
        row.refused += 1
        return

    index = tick % dues.shape[0]  # a ring buffer
    has_due = is_scheduled and tick > row.scheduled - dues.shape[0]
    if has_due and dues[index] <= _FILED:
        row.duplicate += 1
        return

    release = release_tick(tick, rate_hz, link)
    if release == LOST:
        row.lost += 1
        return
    if release < k:
        model: Row = link.models[row.model]
        if model.kind != _MEASURED:  # on a measured link every sample is due before it arrives
            row.late += 1
        release = k
    # The driver has enlarged the calendar as far as `CalendarSizer` permits. A sample that
    # still does not fit is rejected.
    if release - k >= calendar.shape[0]:
        row.refused += 1
        return
    dues[index] = _FILED - dues[index]  # marks the sample as arrived
    if tick <= row.used:
        row.superseded += 1
        return

    # The number of pages is a power of two, so a modulo is a mask.
    page = release & (calendar.shape[0] - 1)
    slot: SampleRow = calendar[page]
    if slot.tick >= 0:
        row.superseded += 1  # only the newer of two samples is used
    if slot.tick < tick:
        slot.tick = tick
        put(slot.q, q)
        put(slot.qd, qd)
        put(slot.tau_x, tau_x)
        _file_sent(link.channel, page, sent)


@leaf
def release_sample(k: int, rate_hz: int, link: LinkArrays) -> None:
    """Starts using the newest message from another arm whose simulated delay has passed.

    If no message is due in tick k, the previous message stays in use. This function must be
    called once per control period of the receiver, in order. Otherwise, messages stored by
    `accept_sample` would stay in the calendar, which has one page per period.

    Every call computes the delivery times of all messages sent up to the time t_k of the tick.
    The first message after a long silence therefore takes no longer to process than any other
    message.

    Args:
        k: Tick of the receiver.
        rate_hz: Tick rate of the receiver, Hz.
        link: Arrays of the link; updated in place.
    """
    row: LinkRow = link.state[0]
    row.new = 0
    calendar = link.calendar
    # The last tick that the peer has started by now.
    peer_tick = k if row.rate_hz == rate_hz else k * row.rate_hz // rate_hz
    schedule_deliveries(
        sample=peer_tick, link=row, models=link.models, dues=link.dues, points=link.points
    )

    # The page of tick k. The number of pages is a power of two, so a modulo is a mask.
    page = k & (calendar.shape[0] - 1)
    waiting: SampleRow = calendar[page]
    newest = waiting.tick
    is_page_empty = newest < 0
    if is_page_empty:
        return

    waiting.tick = -1  # empties the page
    if newest > row.used:
        row.used = newest
        row.used_ns = tick_ns(k, rate_hz)
        row.new = 1
        put(row.q, waiting.q)
        put(row.qd, waiting.qd)
        put(row.tau_x, waiting.tau_x)
        _use_sent(link.channel, page)
    else:
        row.superseded += 1  # a newer sample is in use

"""Decides for blocks of ticks which sample of each peer a site uses, without the samples.

A sample is the state that a site sends in one tick, a period of its control loop. Its delivery
depends on the link and on the index of the sample alone. Therefore the deliveries of many ticks
are computed together, before the ticks.

Invariant:
    - The samples in use are those of `accept_sample` and `release_sample`, if all sites have
      the same tick rate and each sample arrives at the first tick after it was sent.
"""

from typing import NamedTuple

import numpy as np

from ...core.links.channel import LOST, schedule_deliveries
from ...core.links.delay import DelayKind, clamp_delay_us
from ...core.links.link import LinkArrays, accept_sample, release_sample
from ...core.step.jit import leaf
from ...core.step.row_fields import LinkRow
from ...core.step.site_arrays import SiteArrays
from ...core.step.ticks import first_tick_at, tick_ns
from ...core.step.vectors import Array, IntArray, Points, Row, RowArray

BLOCK_TICKS = 500
"""Number of ticks whose deliveries are computed together."""
_CONSTANT = int(DelayKind.CONSTANT)


class LinkStates(NamedTuple):
    """State of all links of one run, for N sites with P peers each.

    Attributes:
        links: Rows of the links, shape (N, P), see `LinkRow`.
        models: Models of delay and loss, shape (N, P, M).
        dues: Due times of the newest samples, shape (N, P, D), ns.
        points: Traces and outages.
        releases: For each tick the newest sample that is released then, or -1, shape (N, P, R),
            a ring buffer. R is a power of two.
        newest: Sample in use at the last tick, or -1, shape (N, P).
    """

    links: RowArray
    models: RowArray
    dues: IntArray
    points: Points
    releases: IntArray
    newest: IntArray


def copy_link_states(arrays: SiteArrays) -> LinkStates:
    """Returns the state of the links of a run before its first tick.

    Args:
        arrays: Arrays of all sites of the run. They are not changed.
    """
    sites, peers, pages = arrays.calendars.shape
    # A sample that is sent in a block waits at most as long as the calendar has pages.
    kept = 1 << (pages + BLOCK_TICKS).bit_length()
    return LinkStates(
        links=arrays.links.copy(),
        models=arrays.models.copy(),
        dues=arrays.dues.copy(),
        points=arrays.points,
        releases=np.full((sites, peers, kept), -1),
        newest=np.full((sites, peers), -1),
    )


@leaf
def _is_constant(link: LinkRow, model: Row) -> bool:
    """Returns True if a link only delays all samples by the same time."""
    return bool(
        link.models == 1
        and link.outage_count == 0
        and model.kind == _CONSTANT
        and model.loss_good == 0.0
        and model.enter == 0.0
    )


@leaf
def _use_after_constant_delay(
    first: int, count: int, rate_hz: int, model: Row, used: IntArray
) -> int:
    """Finds the samples in use on a link with a constant delay, see `use_samples`.

    Sample m is used from tick m + w on. The wait w is the same for all samples, because the
    period is a whole number of nanoseconds. Otherwise the function must not be called.

    Args:
        first: First tick of the block.
        count: Number of ticks.
        rate_hz: Tick rate of both sites, Hz.
        model: Model of the link.
        used: Written, one entry per tick.

    Returns:
        The sample in use at the end of the block.
    """
    delay_ns = max(clamp_delay_us(model.location), model.playout_us) * 1000
    wait = first_tick_at(max(delay_ns, 1), rate_hz)
    newest = -1
    for index in range(count):
        newest = max(first + index - wait, -1)
        used[index] = newest
    return newest


@leaf
def _use_samples_of_link(
    first: int,
    count: int,
    rate_hz: int,
    link: LinkRow,
    models: RowArray,
    dues: IntArray,
    points: Points,
    releases: IntArray,
    newest: int,
    used: IntArray,
) -> int:
    """Finds the samples in use on any link, see `use_samples`.

    Args:
        first: First tick of the block.
        count: Number of ticks.
        rate_hz: Tick rate of both sites, Hz.
        link: Row of the link; changed.
        models: Models of the link.
        dues: Due times of its newest samples; changed.
        points: Traces and outages.
        releases: Newest sample that each tick releases, a ring buffer; changed.
        newest: Sample in use before the block, or -1.
        used: Written, one entry per tick.

    Returns:
        The sample in use at the end of the block.
    """
    mask = releases.shape[0] - 1
    kept = dues.shape[0]
    # Sample k - 1 arrives at tick k.
    for sample in range(max(first - 1, 0), first + count - 1):
        schedule_deliveries(sample=sample, link=link, models=models, dues=dues, points=points)
        due_ns = dues[sample % kept]
        if due_ns == LOST:
            continue
        # A sample is never used at the time when it was sent.
        release = first_tick_at(max(due_ns, tick_ns(sample, rate_hz) + 1), rate_hz)
        releases[release & mask] = max(releases[release & mask], sample)
    for index in range(count):
        page = (first + index) & mask
        newest = max(newest, releases[page])
        releases[page] = -1
        used[index] = newest
    return newest


@leaf
def use_samples(
    first: int, count: int, rate_hz: int, lane: int, states: LinkStates, used: IntArray
) -> None:
    """Finds which sample of each peer every site of a run uses, for a block of ticks.

    Args:
        first: First tick of the block.
        count: Number of ticks.
        rate_hz: Tick rate of all sites, Hz.
        lane: Lane of the run.
        states: State of the links of the run; changed.
        used: Receives the index of the sample, or -1 before the first one, shape (N, ticks, P,
            LANES).
    """
    has_whole_period = 1_000_000_000 % rate_hz == 0
    for i in range(states.links.shape[0]):
        for p in range(states.links.shape[1]):
            link: LinkRow = states.links[i, p]
            model: Row = states.models[i, p, 0]
            if has_whole_period and _is_constant(link, model):
                newest = _use_after_constant_delay(
                    first, count, rate_hz, model, used[i, :, p, lane]
                )
            else:
                newest = _use_samples_of_link(
                    first=first,
                    count=count,
                    rate_hz=rate_hz,
                    link=link,
                    models=states.models[i, p],
                    dues=states.dues[i, p],
                    points=states.points,
                    releases=states.releases[i, p],
                    newest=states.newest[i, p],
                    used=used[i, :, p, lane],
                )
            states.newest[i, p] = newest


@leaf
def repeat_deliveries(
    first: int,
    end: int,
    rate_hz: int,
    links: RowArray,
    models: RowArray,
    dues: IntArray,
    calendars: RowArray,
    points: Points,
    states: Array,
) -> None:
    """Executes the links of a run for some ticks, without the arms.

    The links then have the state that a run of these ticks gives them. Samples that were
    overwritten long ago have the wrong content, but the right index.

    Args:
        first: First tick.
        end: Tick before which the links stop.
        rate_hz: Tick rate of all sites, Hz.
        links: Rows of the links before the first tick, shape (N, P); changed.
        models: Models of the links, shape (N, P, M).
        dues: Due times, shape (N, P, D); changed.
        calendars: Calendars of the links, shape (N, P, pages); changed.
        points: Traces and outages.
        states: The latest states of the sites, q, qd and tau_x, shape (N, R + 1, 6). The state
            of tick k is at k modulo R. R is a power of two.
    """
    mask = states.shape[1] - 2
    nothing = states[0, 0, :0]
    joints = states.shape[2] // 3
    for k in range(first, end):
        for i in range(links.shape[0]):
            for p in range(links.shape[1]):
                link = LinkArrays(
                    state=links[i, p : p + 1],
                    models=models[i, p],
                    dues=dues[i, p],
                    calendar=calendars[i, p],
                    points=points,
                    channel=None,
                )
                if k > 0:
                    peer = p if p < i else p + 1
                    state = states[peer, (k - 1) & mask]
                    accept_sample(
                        k=k,
                        rate_hz=rate_hz,
                        tick=k - 1,
                        q=state,
                        qd=state[joints:],
                        tau_x=state[2 * joints :],
                        sent=nothing,
                        link=link,
                    )
                release_sample(k, rate_hz, link)

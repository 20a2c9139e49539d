"""Computes in advance which received samples each arm uses, for a block of control periods.

The delay and loss of a sample depend on the link and on the number of the sample, but not on
its content. The deliveries of many ticks can therefore be computed before the arms move, and
random numbers can be drawn for many samples in one call.

Example: with a delay of 3 ticks, tick 10 uses sample 7, whatever the arms do.

Invariant:
    - The samples in use are the same as with `accept_sample` and `release_sample`, provided
      that each sample arrives at the receiver's first tick after it was sent.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba.core import types

from ..links.channel import (
    LOST,
    advance_losses,
    delay_sample,
    find_due_ns,
    loses_samples,
    select_model,
)
from ..links.delay import (
    DELAY,
    LINK_MODEL_DTYPE,
    LOSS,
    DelayKind,
    clamp_delay_us,
    draw_delay_us,
    find_delay_us,
)
from ..links.link import ChannelArrays, LinkArrays, accept_sample, release_sample
from ..links.philox import DrawKey, uniforms
from ..plug.plugged import call_address
from ..step.fused_run import ReplayedInputs
from ..step.jit import LaneCode, lane_leaf, leaf
from ..step.kernel import channel_of
from ..step.row_fields import LinkRow
from ..step.site_arrays import SiteArrays
from ..step.ticks import MAX_ARRIVALS, first_tick_at, tick_ns
from ..step.vectors import Array, IntArray, Points, Row, RowArray

BLOCK_TICKS = 500
"""Number of ticks whose deliveries are computed together."""
_MOST_SAMPLES = BLOCK_TICKS + MAX_ARRIVALS + 2
"""Largest number of samples of a link in a block, if the sender has a higher tick rate."""
_CONSTANT = int(DelayKind.CONSTANT)
_UNIFORM = int(DelayKind.UNIFORM)


class _DelayNumbers(NamedTuple):
    """Parameters of a distribution of network delays, for the function `draw_delay_us`.

    The delays of successive samples are independent. The type of distribution may be a constant
    known to the compiler, which then removes the branches for other types. See `DelayKind` for
    the meaning of the parameters.
    """

    kind: int
    location: float
    scale: float
    extra: float
    weight: float


class LinkStates(NamedTuple):
    """State of the simulated networks of L runs, each with N sites that have P peers.

    Each site receives samples from each peer over its own link. Sample times are computed for
    one block of ticks at a time.

    Attributes:
        links: States of the links, shape (L, N, P), see `LinkRow`.
        models: Delay and loss models, shape (L, N, P, M).
        points: Traces and outages of each run, shape (L, n, 2).
        releases: For each tick, the newest sample that is released in this tick, or -1. A ring
            buffer of shape (L, N, P, R), where R is a power of two.
        newest: Sample in use at the last tick, or -1, shape (L, N, P).
        uniforms: Buffer for two random numbers per sample of a block.
        delays_us: Buffer for the delay of each sample of a block, us.
        stamps_ns: Buffer for the sending time of each sample of a block, ns.
        times_ns: Buffer for the nominal time of each tick of a block, ns.
        sample_counts: Buffer for the number of samples that a peer has sent before the end of
            each tick of a block.
    """

    links: RowArray
    models: RowArray
    points: Points
    releases: IntArray
    newest: IntArray
    uniforms: Array
    delays_us: IntArray
    stamps_ns: IntArray
    times_ns: IntArray
    sample_counts: IntArray

    @classmethod
    def copy_from(cls, tables: Sequence[SiteArrays]) -> "LinkStates":
        """Copies the network link states of several runs into shared arrays, one run per lane.

        The states must be copied before the first tick of the runs.

        Args:
            tables: Arrays of all sites for each run. They are not changed.
        """
        sites, peers, _ = tables[0].calendars.shape
        pages = max(arrays.calendars.shape[2] for arrays in tables)
        # A sample sent in a block waits for at most as many ticks as the calendar has pages.
        kept = 1 << (pages + BLOCK_TICKS).bit_length()
        most_models = max(arrays.models.shape[2] for arrays in tables)
        most_points = max(len(arrays.points) for arrays in tables)
        models = np.zeros((len(tables), sites, peers, most_models), LINK_MODEL_DTYPE)
        points = np.zeros((len(tables), most_points, 2), np.int64)
        for lane, arrays in enumerate(tables):
            models[lane, :, :, : arrays.models.shape[2]] = arrays.models
            points[lane, : len(arrays.points)] = arrays.points
        return cls(
            links=np.stack([arrays.links for arrays in tables]),
            models=models,
            points=points,
            releases=np.full((len(tables), sites, peers, kept), -1),
            newest=np.full((len(tables), sites, peers), -1),
            uniforms=np.zeros((2, _MOST_SAMPLES)),
            delays_us=np.zeros(_MOST_SAMPLES, np.int64),
            stamps_ns=np.zeros(_MOST_SAMPLES, np.int64),
            times_ns=np.zeros(BLOCK_TICKS, np.int64),
            sample_counts=np.zeros(BLOCK_TICKS, np.int64),
        )

    def keep(self, lanes: Sequence[int]) -> "LinkStates":
        """Returns the link states of only those runs that continue.

        A search drops runs that it no longer needs, because simulating them would take time.

        Args:
            lanes: Lane indices of the runs that continue.
        """
        chosen = list(lanes)
        return self._replace(
            links=self.links[chosen],
            models=self.models[chosen],
            points=self.points[chosen],
            releases=self.releases[chosen],
            newest=self.newest[chosen],
        )


@leaf
def _constant_delay_ns(model: Row) -> int:
    """Returns the delay of a simulated link with a constant delay, in ns.

    The delay is the time from sending a sample to its use. It is at least 1 ns, because a
    sample is never used at the time at which it was sent.
    """
    return int(max(max(clamp_delay_us(model.location), model.playout_us) * 1000, 1))


@leaf
def _is_constant(link: LinkRow, model: Row) -> bool:
    """Returns True if all that a link does is delay every sample by the same time."""
    return bool(
        link.models == 1
        and link.outage_count == 0
        and model.kind == _CONSTANT
        and not loses_samples(model)
    )


@leaf
def _use_after_constant_delay(
    first: int, count: int, rate_hz: int, model: Row, used: IntArray
) -> int:
    """Finds which received sample an arm uses in each tick, if the delay is constant.

    Sample m, computed by the sender in tick m, is used from tick m + w on. The number of ticks
    w is the same for all samples if the period of the control loop is an integer number of
    nanoseconds. This function must only be called in that case.

    Args:
        first: First tick of a block of ticks.
        count: Number of ticks in the block.
        rate_hz: Tick rate of both sites, Hz.
        model: Model of the link.
        used: Output array for the sample in use, one entry per tick. -1 before the first
            sample.

    Returns:
        The sample in use at the end of the block.
    """
    wait = first_tick_at(_constant_delay_ns(model), rate_hz)
    for index in range(count):
        used[index] = max(first + index - wait, -1)
    return int(max(first + count - 1 - wait, -1))


@lane_leaf
def _draw_uniform_delays(
    first: int, count: int, key: DrawKey, location: float, scale: float, delays_us: IntArray
) -> None:
    """Draws uniformly distributed network delays for several consecutive samples.

    Args:
        first: Index of the first sample.
        count: Number of samples.
        key: Key of the link, which makes its random numbers differ from those of other links.
        location: Mean delay, us.
        scale: Largest deviation from the mean, us.
        delays_us: Output array for the delays, us, shape (count,).
    """
    numbers = _DelayNumbers(_UNIFORM, location, scale, 0.0, 0.0)
    for index in range(count):
        drawn_us = draw_delay_us(key, first + index, DELAY, numbers)
        delays_us[index] = clamp_delay_us(drawn_us)


@lane_leaf
def _draw_losses(first: int, count: int, key: DrawKey, uniform_numbers: Array) -> None:
    """Draws random numbers that decide which of several messages a simulated network loses.

    Args:
        first: Index of the first sample.
        count: Number of samples.
        key: Key of the link, which makes its random numbers differ from those of other links.
        uniform_numbers: Output array for two numbers between 0 and 1 per sample, shape (2,
            count).
    """
    for index in range(count):
        u, v = uniforms(key, first + index, LOSS, 0)
        uniform_numbers[0, index] = u
        uniform_numbers[1, index] = v


class DrawAddresses(NamedTuple):
    """Addresses of compiled functions that draw the random numbers of many messages at once.

    The random numbers determine delays and losses in a simulated network. The loops of these
    functions use vector instructions, which is possible because the compiler inlines every
    function that they call.
    """

    delays: int
    losses: int

    @classmethod
    def find(cls) -> "DrawAddresses":
        """Returns the addresses of compiled functions that draw network delays and losses.

        Drawing for many messages per call is faster than one call per message. The functions
        are compiled if their machine code is not stored on disk.
        """
        integer = types.int64
        number = types.float64
        delays = types.Array(integer, 1, "C")
        uniform_numbers = types.Array(number, 2, "C")
        delay_types = (integer, integer, types.uint64, number, number, delays)
        loss_types = (integer, integer, types.uint64, uniform_numbers)
        return cls(
            delays=LaneCode(_draw_uniform_delays, delay_types).find_address(),
            losses=LaneCode(_draw_losses, loss_types).find_address(),
        )


@leaf
def _release_samples(
    first: int,
    count: int,
    rate_hz: int,
    least_release: int,
    fresh: bool,
    stamps_ns: IntArray,
    link: LinkRow,
    model: Row,
    points: Points,
    releases: IntArray,
    states: LinkStates,
    draws: DrawAddresses,
) -> None:
    """Computes in which ticks samples may first be used, for one delay model of a link.

    The random numbers of all samples are drawn first, in loops that use vector instructions.

    Args:
        first: Index of the first sample.
        count: Number of samples.
        rate_hz: Tick rate of the receiver, Hz.
        least_release: First tick that can still use a sample.
        fresh: True if the first sample is also the first sample of the model.
        stamps_ns: Sending times of the samples, ns since the epoch.
        link: Row of the link; updated in place.
        model: Model of the link.
        points: Traces and outages.
        releases: Newest sample that each tick releases, a ring buffer; updated in place.
        states: Provides buffers for the random numbers.
        draws: Functions that draw them.
    """
    mask = releases.shape[0] - 1
    delays_us = states.delays_us
    uniform_numbers = states.uniforms
    if model.kind == _UNIFORM:
        call_address(
            draws.delays, (first, count, link.key, model.location, model.scale, delays_us)
        )
    else:
        for index in range(count):
            delays_us[index] = find_delay_us(
                sample=first + index,
                stamp_ns=stamps_ns[index],
                fresh=fresh and index == 0,
                link=link,
                model=model,
                points=points,
            )
    loses = loses_samples(model)
    if loses:
        call_address(draws.losses, (first, count, link.key, uniform_numbers))
    # If samples are never duplicated and there are no outages, the slower general function is
    # not needed.
    is_plain = model.duplicate == 0.0 and link.outage_count == 0
    for index in range(count):
        sample = first + index
        stamp_ns = stamps_ns[index]
        lost = False
        if loses:
            lost = advance_losses(
                u=uniform_numbers[0, index],
                v=uniform_numbers[1, index],
                fresh=fresh and index == 0,
                link=link,
                model=model,
            )
        delay_us = delays_us[index]
        if is_plain:
            if lost or delay_us < 0:
                continue
            due_ns = delay_sample(stamp_ns, delay_us, link, model)
        else:
            due_ns = find_due_ns(
                sample=sample,
                stamp_ns=stamp_ns,
                lost=lost,
                delay_us=delay_us,
                link=link,
                model=model,
                points=points,
            )
            if due_ns == LOST:
                continue
        # A sample is never used at the time when it was sent.
        release = max(first_tick_at(max(due_ns, stamp_ns + 1), rate_hz), least_release)
        # Later samples are newer.
        releases[release & mask] = sample


@leaf
def _release_all_samples(
    first_sample: int,
    end_sample: int,
    rate_hz: int,
    least_release: int,
    link: LinkRow,
    models: RowArray,
    points: Points,
    releases: IntArray,
    states: LinkStates,
    draws: DrawAddresses,
) -> None:
    """Computes in which ticks the samples of a simulated network link may first be used.

    Each sample is delayed by the delay model in force when it was sent.

    Args:
        first_sample: Index of the first sample, whose sending time is `states.stamps_ns[0]`.
        end_sample: Index after that of the last sample.
        rate_hz: Tick rate of the receiver, Hz.
        least_release: First tick that can still use a sample.
        link: Row of the link; updated in place.
        models: Models of the link.
        points: Traces and outages.
        releases: Newest sample that each tick releases, a ring buffer; updated in place.
        states: Contains the sending times, and provides buffers for random numbers.
        draws: Functions that draw random numbers.
    """
    sample = first_sample
    while sample < end_sample:
        stamps_ns = states.stamps_ns[sample - first_sample :]
        fresh = select_model(sample, stamps_ns[0], link, models)
        model: Row = models[link.model]
        model_end = end_sample
        if link.model + 1 < link.models:
            following_ns = models[link.model + 1].from_ns
            # The first sample with this stamp or a later one belongs to the next model.
            following = first_tick_at(following_ns, link.rate_hz)
            model_end = min(end_sample, max(following, sample + 1))
        _release_samples(
            first=sample,
            count=model_end - sample,
            rate_hz=rate_hz,
            least_release=least_release,
            fresh=fresh,
            stamps_ns=stamps_ns,
            link=link,
            model=model,
            points=points,
            releases=releases,
            states=states,
            draws=draws,
        )
        sample = model_end


@leaf
def _use_released_samples(
    first: int, count: int, newest: int, releases: IntArray, used: IntArray
) -> int:
    """Finds the newest received sample that may be used in each tick of a block.

    The samples have already been released, each for a certain tick.

    Args:
        first: First tick of the block.
        count: Number of ticks.
        newest: Sample in use before the block, or -1.
        releases: Newest sample that each tick releases, a ring buffer. The entries of these
            ticks are cleared.
        used: Output array for the sample in use, one entry per tick.

    Returns:
        The sample in use at the end of the block.
    """
    mask = releases.shape[0] - 1
    for index in range(count):
        page = (first + index) & mask
        newest = max(newest, releases[page])
        releases[page] = -1
        used[index] = newest
    return newest


@leaf
def _use_samples_of_link(
    first: int,
    count: int,
    rate_hz: int,
    link: LinkRow,
    models: RowArray,
    points: Points,
    releases: IntArray,
    newest: int,
    states: LinkStates,
    draws: DrawAddresses,
    used: IntArray,
) -> int:
    """Finds which received sample an arm uses in each tick, on a link with any delay model.

    Args:
        first: First tick of the block.
        count: Number of ticks.
        rate_hz: Tick rate of both sites, Hz.
        link: Row of the link; updated in place.
        models: Models of the link.
        points: Traces and outages.
        releases: Newest sample that each tick releases, a ring buffer; updated in place.
        newest: Sample in use before the block, or -1.
        states: Provides buffers for random numbers.
        draws: Functions that draw random numbers.
        used: Output array for the sample in use, one entry per tick.

    Returns:
        The sample in use at the end of the block.
    """
    # Sample k - 1 arrives at tick k.
    _release_all_samples(
        first_sample=max(first - 1, 0),
        end_sample=first + count - 1,
        rate_hz=rate_hz,
        least_release=first,
        link=link,
        models=models,
        points=points,
        releases=releases,
        states=states,
        draws=draws,
    )
    return _use_released_samples(first, count, newest, releases, used)


@leaf
def use_samples(
    first: int,
    count: int,
    rate_hz: int,
    ended: IntArray,
    states: LinkStates,
    draws: DrawAddresses,
    used: IntArray,
) -> int:
    """Finds which received sample each arm uses in each tick of a block of control periods.

    This is done for several simulations at once. Samples are delayed by the simulated network.

    Args:
        first: First tick of the block.
        count: Number of ticks.
        rate_hz: Tick rate of all sites, Hz.
        ended: For each run, the number of ticks executed if the run has ended, otherwise -1.
        states: State of the links of the runs; updated in place.
        draws: Functions that draw random numbers.
        used: Output array for the index of the sample in use, or -1 before the first sample,
            shape (N, P, LANES, ticks).

    Returns:
        The largest age of a sample in use, in ticks. Before the first sample, the age is
        counted as if sample -1 were in use.
    """
    largest_age = 0
    has_whole_period = 1_000_000_000 % rate_hz == 0
    first_sample = max(first - 1, 0)
    for index in range(count):
        states.stamps_ns[index] = tick_ns(first_sample + index, rate_hz)
    for lane in range(states.links.shape[0]):
        if ended[lane] >= 0:
            continue
        for i in range(states.links.shape[1]):
            for p in range(states.links.shape[2]):
                link: LinkRow = states.links[lane, i, p]
                model: Row = states.models[lane, i, p, 0]
                if has_whole_period and _is_constant(link, model):
                    newest = _use_after_constant_delay(
                        first, count, rate_hz, model, used[i, p, lane]
                    )
                else:
                    newest = _use_samples_of_link(
                        first=first,
                        count=count,
                        rate_hz=rate_hz,
                        link=link,
                        models=states.models[lane, i, p],
                        points=states.points[lane],
                        releases=states.releases[lane, i, p],
                        newest=states.newest[lane, i, p],
                        states=states,
                        draws=draws,
                        used=used[i, p, lane],
                    )
                states.newest[lane, i, p] = newest
                for index in range(count):
                    age = first + index - used[i, p, lane, index]
                    largest_age = max(largest_age, age)
    return largest_age


@leaf
def _use_after_delay(
    count: int, delay_ns: int, rate_hz: int, newest: int, states: LinkStates, used: IntArray
) -> int:
    """Finds which received sample an arm uses in each tick if its peer has another tick rate.

    The delay of the network link is constant.

    Args:
        count: Number of ticks.
        delay_ns: Time from sending a sample to its use, ns.
        rate_hz: Tick rate of the peer, Hz.
        newest: Sample in use before the block, or -1.
        states: Contains the time of each tick, and the number of samples that the peer has
            sent.
        used: Output array for the sample in use, one entry per tick.

    Returns:
        The sample in use at the end of the block.
    """
    next_ns = tick_ns(newest + 1, rate_hz) + delay_ns
    for index in range(count):
        while next_ns <= states.times_ns[index] and newest + 1 < states.sample_counts[index]:
            newest += 1
            next_ns = tick_ns(newest + 1, rate_hz) + delay_ns
        used[index] = newest
    return newest


@leaf
def use_samples_of_rates(
    first: IntArray,
    end: IntArray,
    rates_hz: IntArray,
    next_samples: IntArray,
    ended: IntArray,
    states: LinkStates,
    draws: DrawAddresses,
    used: IntArray,
) -> int:
    """Variant of `use_samples` for arms whose control loops have different rates.

    The block contains the ticks of all arms in an interval of time. Ticks of different arms are
    executed in chronological order.

    Args:
        first: First tick of each site in the block, shape (N,).
        end: First tick of each site after the block, shape (N,).
        rates_hz: Tick rates, Hz, shape (N,).
        next_samples: Next sample that each site accepts from each peer, shape (N, P); updated
            in place.
        ended: See `use_samples`.
        states: State of the links of the runs; updated in place.
        draws: Functions that draw random numbers.
        used: Output array, see `use_samples`, with ticks counted from `first`.

    Returns:
        The largest age of a sample in use, see `use_samples`, in ticks of its sender.
    """
    largest_age = 0
    for i in range(states.links.shape[1]):
        count = end[i] - first[i]
        if count == 0:
            # The peers continue, and all samples since the sample in use are kept.
            for p in range(states.links.shape[2]):
                j = p if p < i else p + 1
                for lane in range(states.links.shape[0]):
                    if ended[lane] < 0:
                        age = end[j] - 1 - states.newest[lane, i, p]
                        largest_age = max(largest_age, age)
            continue
        rate_hz = rates_hz[i]
        for index in range(count):
            states.times_ns[index] = tick_ns(first[i] + index, rate_hz)
        last_ns = states.times_ns[count - 1]
        for p in range(states.links.shape[2]):
            # The peers of a site are all other sites, in scenario order.
            j = p if p < i else p + 1
            peer_hz = rates_hz[j]
            first_sample = next_samples[i, p]
            # A sample arrives after the time at which it was sent.
            end_sample = max(min(first_tick_at(last_ns, peer_hz), end[j]), first_sample)
            next_samples[i, p] = end_sample
            for index in range(end_sample - first_sample):
                states.stamps_ns[index] = tick_ns(first_sample + index, peer_hz)
            sample_count = first_tick_at(states.times_ns[0] + 1, peer_hz)
            for index in range(count):
                while tick_ns(sample_count, peer_hz) <= states.times_ns[index]:
                    sample_count += 1
                # The peer may be ahead: a tick may be planned after later ticks of the peer.
                states.sample_counts[index] = max(min(sample_count, end[j]), first[j])
            for lane in range(states.links.shape[0]):
                if ended[lane] >= 0:
                    continue
                link: LinkRow = states.links[lane, i, p]
                model: Row = states.models[lane, i, p, 0]
                newest = states.newest[lane, i, p]
                if _is_constant(link, model):
                    newest = _use_after_delay(
                        count,
                        _constant_delay_ns(model),
                        peer_hz,
                        newest,
                        states,
                        used[i, p, lane],
                    )
                else:
                    releases = states.releases[lane, i, p]
                    _release_all_samples(
                        first_sample=first_sample,
                        end_sample=end_sample,
                        rate_hz=rate_hz,
                        least_release=first[i],
                        link=link,
                        models=states.models[lane, i, p],
                        points=states.points[lane],
                        releases=releases,
                        states=states,
                        draws=draws,
                    )
                    newest = _use_released_samples(
                        first[i], count, newest, releases, used[i, p, lane]
                    )
                states.newest[lane, i, p] = newest
                # Before the next tick of the site, the peer continues to the end of the block.
                largest_age = max(largest_age, end[j] - 1 - newest)
                for index in range(count):
                    age = states.sample_counts[index] - 1 - used[i, p, lane, index]
                    largest_age = max(largest_age, age)
    return largest_age


@leaf
def _select_link(
    i: int,
    p: int,
    links: RowArray,
    models: RowArray,
    dues: IntArray,
    calendars: RowArray,
    points: Points,
    channel: ChannelArrays | None,
) -> LinkArrays:
    """Selects the arrays of one link from the arrays of all links of a run.

    Args:
        i: Index of the receiving site.
        p: Index of the peer among the peers of this site.
        links: Rows of the links, shape (N, P).
        models: Models of the links, shape (N, P, M).
        dues: Due times, shape (N, P, D).
        calendars: Calendars of the links, shape (N, P, pages).
        points: Traces and outages.
        channel: Values that laws receive, or None.
    """
    return LinkArrays(
        state=links[i, p : p + 1],
        models=models[i, p],
        dues=dues[i, p],
        calendar=calendars[i, p],
        points=points,
        channel=channel_of(channel_of(channel, i), p),
    )


@leaf
def use_recorded_samples(
    first: IntArray,
    end: IntArray,
    rates_hz: IntArray,
    feed: ReplayedInputs,
    links: RowArray,
    models: RowArray,
    dues: IntArray,
    calendars: RowArray,
    points: Points,
    channel: ChannelArrays | None,
    state: Array,
    used: IntArray,
) -> int:
    """Finds which received sample each arm uses when a run from a log is repeated.

    All arrivals are known from the log. The results have the same form as in `use_samples`.

    Args:
        first: First tick of each site in the block, shape (N,).
        end: First tick of each site after the block, shape (N,).
        rates_hz: Tick rates, Hz, shape (N,).
        feed: Inputs of the recorded run.
        links: Rows of the links, shape (N, P); updated in place.
        models: Models of the links, shape (N, P, M).
        dues: Due times, shape (N, P, D); updated in place.
        calendars: Calendars of the links (buffers of delayed samples), shape (N, P, pages);
            updated in place. The samples written into them have the right index, but arbitrary
            content.
        points: Traces and outages.
        channel: Values that laws receive, or None; updated in place.
        state: An array of arbitrary content, at least as long as the state that a site sends.
        used: Output array for the samples in use in lane 0, shape (N, P, LANES, ticks), with
            ticks counted from `first`.

    Returns:
        The largest age of a sample in use, in ticks of its sender, see `use_samples_of_rates`.
    """
    largest_age = 0
    for i in range(links.shape[0]):
        rate_hz = rates_hz[i]
        for p in range(links.shape[1]):
            link = _select_link(i, p, links, models, dues, calendars, points, channel)
            peer = p if p < i else p + 1
            for k in range(first[i], end[i]):
                for n in range(feed.first[i, p, k], feed.first[i, p, k + 1]):
                    accept_sample(
                        k=k,
                        rate_hz=rate_hz,
                        tick=feed.samples[n],
                        q=state,
                        qd=state,
                        tau_x=state,
                        sent=state,
                        link=link,
                    )
                release_sample(k, rate_hz, link)
                sample = links[i, p].used
                used[i, p, 0, k - first[i]] = sample
                sample_count = first_tick_at(tick_ns(k, rate_hz) + 1, rates_hz[peer])
                sample_count = max(min(sample_count, end[peer]), first[peer])
                largest_age = max(largest_age, sample_count - 1 - sample)
            # Before the next tick of the site, the peer continues to the end of the block.
            largest_age = max(largest_age, end[peer] - 1 - links[i, p].used)
    return largest_age


@leaf
def repeat_deliveries(
    first: IntArray,
    end: IntArray,
    rates_hz: IntArray,
    next_samples: IntArray,
    links: RowArray,
    models: RowArray,
    dues: IntArray,
    calendars: RowArray,
    points: Points,
    channel: ChannelArrays | None,
    joints: int,
    states: Array,
) -> None:
    """Brings the simulated network links of one run up to date, so that it can continue alone.

    Runs that are simulated side by side compute their deliveries without the link state
    (`use_samples`). The links are therefore executed again for the past ticks, without the
    arms. Samples that were overwritten long ago have the right index but the wrong content.

    Args:
        first: First tick of each site, shape (N,).
        end: For each site, the tick after the last tick to execute, shape (N,).
        rates_hz: Tick rates, Hz, shape (N,).
        next_samples: Next sample that each site accepts from each peer, shape (N, P); updated
            in place.
        links: Rows of the links before the first tick, shape (N, P); updated in place.
        models: Models of the links, shape (N, P, M).
        dues: Due times, shape (N, P, D); updated in place.
        calendars: Calendars of the links, shape (N, P, pages); updated in place.
        points: Traces and outages.
        channel: Values that laws receive, or None.
        joints: Number of joints.
        states: The latest states of the sites (q, qd, tau_x and the values sent by the law),
            shape (N, R + 1, width). The state of tick k is at index k modulo R, where R is a
            power of two.
    """
    mask = states.shape[1] - 2
    for i in range(links.shape[0]):
        rate_hz = rates_hz[i]
        for p in range(links.shape[1]):
            link = _select_link(i, p, links, models, dues, calendars, points, channel)
            # The peers of a site are all other sites, in scenario order.
            peer = p if p < i else p + 1
            sample = next_samples[i, p]
            for k in range(first[i], end[i]):
                t_ns = tick_ns(k, rate_hz)
                while sample < end[peer] and tick_ns(sample, rates_hz[peer]) < t_ns:
                    state = states[peer, sample & mask]
                    accept_sample(
                        k=k,
                        rate_hz=rate_hz,
                        tick=sample,
                        q=state,
                        qd=state[joints:],
                        tau_x=state[2 * joints :],
                        sent=state[3 * joints :],
                        link=link,
                    )
                    sample += 1
                release_sample(k, rate_hz, link)
            next_samples[i, p] = sample

"""Summarises the network links of a run: delays, losses, message counts and clocks.

At every tick, a site sends one sample over the link. The receiver uses the newest sample that
has arrived and whose emulated delay has passed. The effective delay is the age of the sample in
use (age of information; Kaul, Yates and Gruteser 2012). docs/reference/metrics.md defines each
quantity.

The program itself delays samples to emulate a network. Each delay depends only on the random
seed, the link and the sample number. `predict_delivery` can therefore recompute the delays from
the scenario, even for samples that never arrived.

Invariant:
    - A quantity that the log does not determine is `None`.
    - Clock estimates are reported as they were used while the session ran.
    - The record of each tick names the samples that arrived. If a record is missing, its
      samples are counted neither as arrived nor as lost.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..core import AHEAD_LIMIT_NS, LOST, Array, LinkSchedule
from ..log import Ints, Log, SiteLog
from ..records import NS_PER_S
from .aligned import Bools
from .timeline import StatedLink, Timeline


class _PredictedDelivery(NamedTuple):
    """Delivery of the first M samples of a link, as the delay model of the link predicts it.

    A sample is the state that a site publishes in one tick. The delay model of the scenario
    emulates delays, losses and changes of order in a repeatable way. Therefore the prediction
    can be compared with the records. Times are in ns after the start of the session.

    Attributes:
        stamp_ns: Times at which the peer sent the samples, shape (M,).
        due_ns: Times at which the samples come into use at the receiver, shape (M,). `LOST` for
            a lost sample.
        drawn_ns: Times at which they would come into use because of the delay alone, without
            duplicates, reordering and play-out buffer, shape (M,).
        measured: True if the delay is that of the real network, shape (M,). A sample then comes
            into use as soon as it arrives.
        copies: Number of duplicates that the link makes.
    """

    stamp_ns: Ints
    due_ns: Ints
    drawn_ns: Ints
    measured: Bools
    copies: int

    @property
    def lost(self) -> Bools:
        """True for samples that the delay model of the link drops deliberately, shape (M,).

        A receiver does not expect these samples, and they are not counted as missing.
        """
        lost: Bools = self.due_ns == LOST
        return lost

    @property
    def drawn_ms(self) -> Array:
        """Delays that the delay model of the scenario adds to the samples, in ms.

        Samples that the model drops, and samples that have only the delay of the real network,
        are excluded. The effects of duplicates, reordering and the play-out buffer are not
        included.
        """
        delivered = ~self.lost & ~self.measured
        return (self.drawn_ns[delivered] - self.stamp_ns[delivered]) / 1e6

    def release(self, rate_hz: int) -> Ints:
        """Computes the tick of the receiver at which each sample may first be used.

        This is the first tick after the delay of the sample has passed. If the sample has not
        arrived by then, the receiver uses it later.

        Args:
            rate_hz: Tick rate of the receiver, in Hz.

        Returns:
            One tick per sample, shape (M,). `LOST` for a lost sample.
        """
        ticks = LinkSchedule.first_ticks(np.maximum(self.due_ns, self.stamp_ns + 1), rate_hz)
        return np.where(self.lost, LOST, ticks)


def predict_delivery(
    log: Log,
    peer: str,
    site: str,
    count: int,
) -> _PredictedDelivery:
    """Computes when each sample of a peer comes into use, as defined by the scenario.

    The scenario delays samples in a reproducible way to emulate a network.

    Args:
        log: The log of the run, which contains the scenario and the changes of the delays.
        peer: Name of the sending site.
        site: Name of the receiving site.
        count: Number of samples to predict.

    Raises:
        LogError: A recorded change is invalid.
    """
    links = log.scenario.setup(site).links
    link_setup = next(link for link in links if link.peer == peer)
    peer_index = log[site].peers.index(peer)
    commands = [command for batch in log.commands(site).values() for command in batch]
    commanded_models = [
        command.model
        for command in commands
        if command.peer == peer_index and command.model is not None
    ]
    schedule = LinkSchedule(link_setup, commanded_models)
    due_ns = schedule.draw(count)

    # The same link without duplicates, reordering and play-out buffer. It is computed only if
    # it differs.
    delay_alone = LinkSchedule(link_setup, commanded_models)
    delay_alone.models["duplicate"] = 0.0
    delay_alone.models["in_order"] = 0
    delay_alone.models["playout_us"] = 0
    drawn_ns = due_ns
    if not np.array_equal(delay_alone.models, schedule.models):
        drawn_ns = delay_alone.draw(count)

    stamp_ns = np.arange(count, dtype=np.int64) * NS_PER_S // link_setup.rate_hz
    return _PredictedDelivery(
        stamp_ns=stamp_ns,
        due_ns=due_ns,
        drawn_ns=drawn_ns,
        measured=schedule.find_measured(stamp_ns),
        copies=int(schedule.row.copies),
    )


class _Arrivals(NamedTuple):
    """Messages ("samples") that arrived at an arm over one network link, in order of arrival.

    A sample contains the state of the sending arm in one tick, a period of its control loop.

    Attributes:
        tick: Ticks in which the receiver accepted the samples, shape (A,).
        sample: Numbers of the samples, counted by the sender from 0, shape (A,).
        delay_us: One-way delays in the records, shape (A,), in microseconds.
        refused: Number of further arrivals that the receiver rejected, because their time stamp
            is out of range or the sender never executes their tick.
    """

    tick: Ints
    sample: Ints
    delay_us: Ints
    refused: int

    @property
    def first(self) -> "_Arrivals":
        """The arrivals without duplicates: only the first arrival of each sample is kept.

        A site uses only the first arrival of a sample, and statistics of delays must not count
        a sample twice. The result is ordered by sample number, counted from 0 by the sender.
        """
        sample, rows = np.unique(self.sample, return_index=True)
        return _Arrivals(self.tick[rows], sample, self.delay_us[rows], self.refused)


def _read_arrivals(log: Log, site: str) -> dict[str, _Arrivals]:
    """Reads from a log the samples of other arms that arrived at an arm, with their times.

    A sample is the message with its state that an arm sends in every control period.

    Args:
        log: The log of the run.
        site: Name of the site that receives.

    Returns:
        The arrived samples in the order of their arrival, by name of the sending site.
    """
    site_log = log[site]
    counts, entries = site_log.arrivals
    all_ticks = np.repeat(site_log.tick, counts)
    arrivals = {}
    for index, peer in enumerate(site_log.peers):
        is_from_peer = entries[:, 0] == index
        tick = all_ticks[is_from_peer]
        sample = entries[is_from_peer, 1]
        delay_us = entries[is_from_peer, 2]

        # a link accepts no stamp before the epoch, and none further ahead than the limit
        latest_ns = tick * NS_PER_S // site_log.rate_hz + AHEAD_LIMIT_NS
        peer_rate_hz = log.scenario.sites[peer].rate_hz
        # compared in ticks, because a stamp in ns might overflow
        latest_sample = ((latest_ns + 1) * peer_rate_hz - 1) // NS_PER_S
        is_in_range = (sample >= 0) & (sample <= latest_sample)
        is_valid = is_in_range & (sample < log.scenario.ticks(peer))
        arrivals[peer] = _Arrivals(
            tick=tick[is_valid],
            sample=sample[is_valid],
            delay_us=delay_us[is_valid],
            refused=len(tick) - int(np.count_nonzero(is_valid)),
        )
    return arrivals


def _count_sent(log: Log, peer: str, newest_sample: int) -> int:
    """Returns the number of samples that an arm has sent, according to the log.

    A sample is a message with the state of the arm.

    Args:
        log: The log of the run.
        peer: Name of the peer.
        newest_sample: Number of the newest sample of the peer that arrived at any site. -1 if
            no sample arrived.
    """
    site_log = log[peer]
    end_ticks = [
        event.ticks for event in log.events if event.kind == "end" and event.member == peer
    ]
    recorded_ticks = int(site_log.tick[-1]) + 1 if len(site_log) else 0
    return min(max(newest_sample + 1, recorded_ticks, *end_ticks), log.scenario.ticks(peer))


def _mark_judged_samples(
    log: Log,
    site: str,
    stamp_ns: Ints,
    arrivals: _Arrivals,
) -> Bools:
    """Finds the judged samples, those for which the log shows whether they arrived.

    A sample that did not arrive counts as lost only if it could have arrived before the end of
    the run: it is older than the newest arrival, or it was sent so early that the slowest
    arrival would have been in time. A sample is not judged if the record of a tick in which it
    may have arrived is missing.

    Args:
        log: The log of the run.
        site: Name of the receiver.
        stamp_ns: Times at which the samples 0 to M - 1 were sent, in ns after the start.
        arrivals: First arrivals of the samples.

    Returns:
        True for each judged sample, shape (M,).
    """
    site_log = log[site]
    samples = len(stamp_ns)
    if not len(site_log):
        return np.zeros(samples, dtype=np.bool_)

    earliest_tick = LinkSchedule.first_ticks(stamp_ns + 1, site_log.rate_hz)
    slowest_ticks = int((arrivals.tick - earliest_tick[arrivals.sample]).max(initial=0))
    newest = int(arrivals.sample.max(initial=-1))
    last_tick = min(int(site_log.tick[-1]), log.scenario.ticks(site) - 1)
    is_older_than_newest = np.arange(samples) <= newest
    is_judged: Bools = is_older_than_newest | (earliest_tick + slowest_ticks <= last_tick)

    # a sample is not judged if a record is missing in the ticks in which it may have arrived
    is_missing = np.ones(last_tick + 1, dtype=np.bool_)
    is_missing[site_log.tick[site_log.tick <= last_tick]] = False
    missing_ticks = np.flatnonzero(is_missing)
    if len(missing_ticks):
        never_tick = np.iinfo(np.int64).max
        next_index = np.searchsorted(missing_ticks, earliest_tick)
        next_missing_tick = np.append(missing_ticks, never_tick)[next_index]
        is_judged &= next_missing_tick - earliest_tick > slowest_ticks
    is_judged[arrivals.sample] = True
    return is_judged


MOST_AGE_BINS = 50
"""Largest number of bins of a histogram of ages."""

ONE_WAY_SCHEMA_VERSION = 2
"""First version of the log format whose records contain the one-way delay of an arrival."""


class ValueStatistics(NamedTuple):
    """Mean, standard deviation, percentiles and extremes of a data set, such as delays in ms.

    All attributes have the unit of the data.

    Attributes:
        mean: Arithmetic mean.
        deviation: Standard deviation.
        p50: Median.
        p95: 95th percentile.
        p99: 99th percentile.
        min: Smallest value.
        max: Largest value.
    """

    mean: float
    deviation: float
    p50: float
    p95: float
    p99: float
    min: float
    max: float

    @classmethod
    def of_values(cls, values: ArrayLike) -> "ValueStatistics | None":
        """Computes mean, standard deviation, percentiles and extremes of a data set.

        Args:
            values: The data.

        Returns:
            The statistics, or `None` if there are no data.
        """
        numbers = np.asarray(values, dtype=np.float64)
        if not numbers.size:
            return None
        percentages = (50.0, 95.0, 99.0, 0.0, 100.0)  # the last two are the extremes
        percentiles = np.percentile(numbers, percentages)
        p50, p95, p99, low, high = percentiles.tolist()
        return cls(
            mean=float(numbers.mean()),
            deviation=float(numbers.std()),
            p50=p50,
            p95=p95,
            p99=p99,
            min=low,
            max=high,
        )


class _AgeHistogram(NamedTuple):
    """Histogram of the ages of another arm's states that were used in control periods (ticks).

    The bins have equal width.

    Attributes:
        first_ms: Lower edge of the first bin, in ms.
        width_ms: Width of a bin, in ms.
        ticks: Number of ticks with an age in each bin.
    """

    first_ms: float
    width_ms: float
    ticks: list[int]


class ClockSummary(NamedTuple):
    """Difference between the clocks at the two ends of a network link.

    Measured one-way delays are only as accurate as the estimate of this difference.
    docs/reference/metrics.md defines the quantities under `clock.*`.

    Attributes:
        offset_us: Last estimate of the sender's clock minus the receiver's, in microseconds.
        offset_first_us: First estimate of this offset, in microseconds.
        drift_ppm: Rate of the sender's clock relative to the receiver's, minus 1, in ppm.
            `None` without an estimate.
        drift_bound_ppm: Largest possible error of the drift, in ppm. `None` without an
            estimate.
        bound_us: Largest possible error of the last offset estimate, in microseconds.
        bound_p50_us: Median of this bound over the run.
        bound_max_us: Maximum of this bound over the run.
        rtt_min_us: Shortest round trip of a clock query, in microseconds. `None` without a
            reply.
        faults: Number of detected clock steps.
    """

    offset_us: int
    offset_first_us: int
    drift_ppm: float | None
    drift_bound_ppm: float | None
    bound_us: int
    bound_p50_us: float
    bound_max_us: int
    rtt_min_us: int | None
    faults: int

    @property
    def shared(self) -> bool:
        """True if sender and receiver run on the same machine and thus read the same clock.

        Reports on the link then omit the clock offset, because it did not have to be estimated.
        """
        return self.bound_max_us == 0 and self.offset_us == 0

    @classmethod
    def of_link(cls, log: Log, peer: str, site: str) -> "ClockSummary | None":
        """Returns the clock difference between two sites, as estimated by one of them.

        The ages of samples are only known as accurately as this difference has been estimated.

        Args:
            log: The log of the run.
            peer: Name of the peer.
            site: Name of the site that estimated the difference.

        Returns:
            The estimates, or `None` in virtual time or if the site published no estimates.
        """
        stats = [report for report in log.link_stats(site) if peer in report.offset_us]
        if not stats:
            return None
        bounds_us = [report.bound_us.get(peer, 0) for report in stats]
        round_trips_us = [report.rtt_us.get(peer, -1) for report in stats]
        measured_us = [trip_us for trip_us in round_trips_us if trip_us >= 0]

        drift_ppm = None
        drift_bound_ppm = None
        for event in log.events:
            if event.kind == "clock" and event.member == site and event.about == peer:
                drift_ppm = event.drift_ppb / 1e3
                drift_bound_ppm = event.drift_bound_ppb / 1e3

        return cls(
            offset_us=stats[-1].offset_us[peer],
            offset_first_us=stats[0].offset_us[peer],
            drift_ppm=drift_ppm,
            drift_bound_ppm=drift_bound_ppm,
            bound_us=bounds_us[-1],
            bound_p50_us=float(np.median(bounds_us)),
            bound_max_us=max(bounds_us),
            rtt_min_us=min(measured_us, default=None),
            faults=stats[-1].clock_faults.get(peer, 0),
        )


class SampleCounts(NamedTuple):
    """Counts of sent, used, lost and late samples of a network link, from the receiver's log.

    docs/reference/metrics.md defines these counts under `samples.*`.

    Attributes:
        sent: Samples that the peer sent.
        judged: Samples for which the log shows whether they arrived.
        arrived: Samples that arrived, each counted once.
        missing: Judged samples that did not arrive.
        lost: Samples that arrived, but were not used because they count as lost in the emulated
            network.
        late: Samples that arrived after the tick at which they should have come into use.
        superseded: Samples that were never used, because a newer sample was already in use.
        duplicate: Repeated arrivals of samples that had arrived before.
        copies: Duplicates generated by the emulated network.
        refused: Arrivals that the receiver rejected because their time stamp is out of range.
    """

    sent: int
    judged: int
    arrived: int
    missing: int
    lost: int
    late: int
    superseded: int
    duplicate: int
    copies: int
    refused: int


class LinkSummary(NamedTuple):
    """Summary of a network link in a run: its delay, its losses and its sample counts.

    docs/reference/metrics.md ("Links") defines the quantities. A quantity that the log does not
    determine is `None`. The age of a sample is the time since the peer sent it. A sample is
    judged if the log shows whether it arrived.

    Attributes:
        peer: Name of the sender.
        site: Name of the receiver.
        stated: Delay models that the scenario and its changes prescribe for the link.
        drawn_ms: Statistics of the delays that these models added to the samples, in ms.
        age_ms: Statistics of the effective delay, which is the age of the sample in use at each
            tick, in ms.
        ages: Histogram of the effective delay.
        first_use_s: When the first sample came into use, in s.
        ticks_without_new: Fraction of the ticks at which no new sample came into use.
        silence_ms: Longest time after the first use in which no new sample came into use, in
            ms.
        counts: Numbers of sent, arrived, lost and late samples.
        loss: Fraction of the judged samples that did not arrive, or that count as lost in the
            emulated network.
        burst: Mean number of consecutive samples that were lost together.
        one_way_us: Statistics of the measured one-way delays, in microseconds.
    """

    peer: str
    site: str
    stated: StatedLink
    drawn_ms: ValueStatistics | None
    age_ms: ValueStatistics | None
    ages: _AgeHistogram | None
    first_use_s: float | None
    ticks_without_new: float | None
    silence_ms: float | None
    counts: SampleCounts | None
    loss: float | None
    burst: float | None
    one_way_us: ValueStatistics | None

    @property
    def name(self) -> str:
        """Name of the link as in scenarios: "m1->s" for samples from arm m1 to arm s."""
        return f"{self.peer}->{self.site}"

    @property
    def plain(self) -> bool:
        """True if the link did nothing but delay every sample by the same constant time.

        No sample of such a link was late, missing or lost, and a single line of text describes
        it completely.
        """
        counts = self.counts
        is_as_stated = counts is None or not (counts.late or counts.missing)
        return is_as_stated and self.stated.has_one_constant_delay

    @classmethod
    def list_of_log(cls, log: Log) -> "list[LinkSummary]":
        """Returns delays, losses and sample counts of every network link of a run.

        The summaries are sorted by receiver and then by sender, both in scenario order.

        Args:
            log: The log of the run.

        Raises:
            LogError: A recorded change is invalid.
        """
        stated_links = Timeline(log).stated_links
        arrivals_by_site = {site: _read_arrivals(log, site) for site in log.sites}
        sent = {}
        for peer in log.sites:
            newest = max(
                int(arrivals[peer].sample.max(initial=-1))
                for arrivals in arrivals_by_site.values()
                if peer in arrivals
            )
            sent[peer] = _count_sent(log, peer, newest)

        return [
            _summarise_link(
                log=log,
                stated=stated_links[f"{peer}->{site}"],
                peer=peer,
                site=site,
                sent=sent[peer],
                arrivals=arrivals,
            )
            for site in log.sites
            for peer, arrivals in arrivals_by_site[site].items()
        ]


def bin_ages(age_ns: Ints) -> _AgeHistogram | None:
    """Builds a histogram of sample ages with at most `MOST_AGE_BINS` bins.

    The bin width is 1, 2 or 5 times a power of ten, and at least 10 microseconds.

    Args:
        age_ns: Ages of the samples, shape (K,), in ns.

    Returns:
        The histogram, or `None` if there are no ages.
    """
    if not len(age_ns):
        return None
    youngest_ns = int(age_ns.min())
    oldest_ns = int(age_ns.max())
    possible_widths_ns = [step * 10**power for power in range(4, 15) for step in (1, 2, 5)]
    # the narrowest bins that suffice
    for width_ns in possible_widths_ns:
        first_bin = youngest_ns // width_ns
        last_bin = oldest_ns // width_ns
        if last_bin - first_bin < MOST_AGE_BINS:
            break
    ticks = np.bincount(age_ns // width_ns - first_bin).tolist()
    return _AgeHistogram(first_bin * width_ns / 1e6, width_ns / 1e6, ticks)


def _summarise_link(
    log: Log,
    stated: StatedLink,
    peer: str,
    site: str,
    sent: int,
    arrivals: _Arrivals,
) -> LinkSummary:
    """Returns delays, losses and message counts of the network link from one arm to another.

    Args:
        log: The log of the run.
        stated: Delay models of the link over time.
        peer: Name of the sender.
        site: Name of the receiver.
        sent: Number of samples that the peer sent.
        arrivals: Arrivals over the link.
    """
    site_log = log[site]
    used = site_log.used[peer]
    delivery = predict_delivery(log, peer, site, sent)
    age_ns = log.sample_ages_ns(peer, site)

    # losses, and bursts of successive losses
    first = arrivals.first
    is_judged = _mark_judged_samples(log, site, delivery.stamp_ns, first)
    is_sent = np.ones(len(is_judged), dtype=np.bool_)
    for first_tick, last_tick in log.find_unexecuted_ticks(peer):
        is_sent[max(first_tick, 0) : last_tick + 1] = False
    is_judged &= is_sent
    has_not_arrived = np.ones(len(is_judged), dtype=np.bool_)
    has_not_arrived[first.sample] = False
    is_lost = (has_not_arrived | delivery.lost) & is_judged
    lost = int(np.count_nonzero(is_lost))
    judged = int(np.count_nonzero(is_judged))
    later_bursts = int(np.count_nonzero(is_lost[1:] & ~is_lost[:-1]))
    bursts = later_bursts + int(is_lost[:1].any())

    # ticks without a new sample, and the longest silence
    ticks_without_new = None
    is_successive = (np.diff(site_log.tick) == 1) & (used[:-1] >= 0)
    if is_successive.any():
        ticks_without_new = float(np.mean(np.diff(used)[is_successive] == 0))
    first_use_s = None
    silence_ms = None
    if (used >= 0).any():
        first_use_s = float(site_log.t_s[np.flatnonzero(used >= 0)[0]])
        new_ticks = site_log.tick[np.flatnonzero(np.diff(used, prepend=-1))]
        switch_ticks = np.append(new_ticks, site_log.tick[-1] + 1)
        silence_ms = float(np.diff(switch_ticks * NS_PER_S // site_log.rate_hz).max()) / 1e6

    counts = None
    one_way_us = None
    if len(site_log):
        counts = _count_samples(
            site_log=site_log,
            used=used,
            delivery=delivery,
            arrivals=arrivals,
            sent=int(np.count_nonzero(is_sent)),
            judged=judged,
        )
        if log.driver == "live" and site_log.record(0).v >= ONE_WAY_SCHEMA_VERSION:
            one_way_us = ValueStatistics.of_values(arrivals.delay_us)
    return LinkSummary(
        peer=peer,
        site=site,
        stated=stated,
        drawn_ms=ValueStatistics.of_values(delivery.drawn_ms),
        age_ms=ValueStatistics.of_values(age_ns / 1e6),
        ages=bin_ages(age_ns),
        first_use_s=first_use_s,
        ticks_without_new=ticks_without_new,
        silence_ms=silence_ms,
        counts=counts,
        loss=lost / judged if judged else None,
        burst=lost / bursts if bursts else None,
        one_way_us=one_way_us,
    )


def _count_samples(
    site_log: SiteLog,
    used: Ints,
    delivery: _PredictedDelivery,
    arrivals: _Arrivals,
    sent: int,
    judged: int,
) -> SampleCounts:
    """Counts the samples of a network link by what happened to them, see `SampleCounts`.

    For example, a sample was used, was lost, or was replaced by a newer sample before its use.

    Args:
        site_log: Log of the receiver.
        used: Number of the sample in use at every record, shape (K,).
        delivery: Predicted delivery of all samples.
        arrivals: Arrivals over the link.
        sent: Number of samples that the peer sent.
        judged: Number of samples for which the log shows whether they arrived.
    """
    first = arrivals.first
    release_tick = delivery.release(site_log.rate_hz)[first.sample]
    is_lost = delivery.lost[first.sample]
    is_injected = ~delivery.measured[first.sample]
    is_late = ~is_lost & is_injected & (first.tick > release_tick)
    # A sample is superseded if a newer one is in use at the tick in which it could come into
    # use: the receiver always uses the newest sample.
    use_tick = np.maximum(release_tick, first.tick)
    use_row = np.minimum(np.searchsorted(site_log.tick, use_tick), len(site_log) - 1)
    is_recorded = site_log.tick[use_row] == use_tick
    is_superseded = ~is_lost & is_recorded & (used[use_row] != first.sample)

    return SampleCounts(
        sent=sent,
        judged=judged,
        arrived=len(first.sample),
        missing=judged - len(first.sample),
        lost=int(np.count_nonzero(is_lost)),
        late=int(np.count_nonzero(is_late)),
        superseded=int(np.count_nonzero(is_superseded)),
        duplicate=len(arrivals.sample) - len(first.sample),
        copies=delivery.copies,
        refused=arrivals.refused,
    )


class DelayDistribution(NamedTuple):
    """Delays and ages of all samples on one network link, for a histogram.

    The delay of a sample is the time from sending to first use. Ages are measured at each tick
    at which a sample is in use: the age is the time since the sample was sent.

    Attributes:
        peer: Name of the sender.
        site: Name of the receiver.
        delay_ms: Delays of the samples, shape (S,), in ms. They are computed from the link's
            model if the scenario has one, and measured otherwise.
        age_ms: Age of the sample in use at each tick of the receiver, shape (K,), in ms.
    """

    peer: str
    site: str
    delay_ms: Array
    age_ms: Array

    @classmethod
    def list_of_log(cls, log: Log) -> "list[DelayDistribution]":
        """Collects the delays and ages of all samples on every link of a run, for histograms.

        Args:
            log: Log of the run.

        Returns:
            One entry per link, sorted by receiver and then by sender.
        """
        distributions = []
        for site in log.sites:
            for peer, arrivals in _read_arrivals(log, site).items():
                newest_sample = int(arrivals.sample.max(initial=-1))
                sent_count = _count_sent(log, peer, newest_sample)
                delay_ms = predict_delivery(log, peer, site, sent_count).drawn_ms
                # A link without a model has only measured delays, and only in a live session.
                if not len(delay_ms) and log.driver == "live":
                    delay_ms = arrivals.delay_us / 1e3
                age_ms = log.sample_ages_ns(peer, site) / 1e6
                distributions.append(DelayDistribution(peer, site, delay_ms, age_ms))
        return distributions

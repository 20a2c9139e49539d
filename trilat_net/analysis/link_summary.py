"""Statistics of every directed link: stated and effective delay, loss, bursts, sample counts
and clocks.

Invariant: a quantity that the log does not determine is None. docs/definitions.md defines each:
the effective delay is the age of the sample in use at a tick (age of information, Kaul, Yates
and Gruteser 2012). Clock estimates are those in force while the session ran, without later
improvement.

Invariant (L4): the predicted delivery of a sample is a function of seed, link and index; the
log's scenario and the changes that its records name determine it, also for samples that never
arrived. Invariant (L3): a record names its inputs. Samples that only a missing record could
name stay unknown and count neither as arrived nor as missing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..core.channel import LOST
from ..core.delay import DelayKind
from ..core.link import AHEAD_LIMIT_NS
from ..core.ticks import NS_PER_S
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from ..scenario.sample_uses import LinkSchedule, first_ticks
from .aligned import Bools
from .timeline import StatedModel, list_changes, list_stated_models


class PredictedDelivery(NamedTuple):
    """Delivery of the samples 0 to M - 1 of a link's peer, as its model predicts it; times
    since the epoch.

    Attributes:
        stamp_ns, due_ns: the stamp of each, and when it is due, shape (M,), ns; `LOST` for a
        lost one.
        drawn_ns: the same by the model's own delay alone, without duplicates, order and
            play-out.
        measured: True if nothing is injected: a sample is due at once, shape (M,).
        copies: duplicates that the link makes.
    """

    stamp_ns: Ints
    due_ns: Ints
    drawn_ns: Ints
    measured: Bools
    copies: int

    @property
    def lost(self) -> Bools:
        """True for samples that the link loses, shape (M,)."""
        lost: Bools = self.due_ns == LOST
        return lost

    @property
    def drawn_ms(self) -> Array:
        """The injected delays of the samples that are not lost, ms."""
        kept = ~self.lost & ~self.measured
        return (self.drawn_ns[kept] - self.stamp_ns[kept]) / 1e6

    def release(self, rate_hz: int) -> Ints:
        """Returns the receiver's tick at which each comes into use if it has arrived, shape
        (M,); or LOST.
        """
        ticks = first_ticks(np.maximum(self.due_ns, self.stamp_ns + 1), rate_hz)
        return np.where(self.lost, LOST, ticks)


def predict_delivery(log: Log, peer: str, site: str, count: int) -> PredictedDelivery:
    """Returns the predicted delivery of the first `count` samples of a link, peer -> site.

    Raises:
        LogError: a record names a change that is none.
    """
    setup = next(link for link in log.scenario.setup(site).links if link.peer == peer)
    index = log[site].peers.index(peer)
    commands = (command for batch in log.commands(site).values() for command in batch)
    ordered = [one.model for one in commands if one.peer == index and one.model is not None]
    whole = LinkSchedule(setup, ordered)
    alone = LinkSchedule(setup, ordered)
    alone.models["duplicate"] = 0.0
    alone.models["in_order"] = 0
    alone.models["playout_us"] = 0
    models = whole.models
    due_ns = whole.draw(count)
    drawn_ns = due_ns if np.array_equal(alone.models, models) else alone.draw(count)
    stamp_ns = np.arange(count, dtype=np.int64) * NS_PER_S // setup.rate_hz
    kind = models["kind"][np.searchsorted(models["from_ns"][1:], stamp_ns, side="right")]
    return PredictedDelivery(
        stamp_ns=stamp_ns,
        due_ns=due_ns,
        drawn_ns=drawn_ns,
        measured=kind == DelayKind.MEASURED,
        copies=int(whole.row.copies),
    )


class Arrivals(NamedTuple):
    """Arrivals over a link, in the order of the records, shape (A,).

    Attributes:
        tick, sample: the receiver's tick, and the sample's own.
        delay_us: its one-way delay in the record.
        refused: number of others with a stamp out of range, or of a tick that their sender
            never makes.
    """

    tick: Ints
    sample: Ints
    delay_us: Ints
    refused: int

    @property
    def first(self) -> "Arrivals":
        """The first arrival of each sample, by sample."""
        sample, place = np.unique(self.sample, return_index=True)
        return Arrivals(self.tick[place], sample, self.delay_us[place], self.refused)


def read_arrivals(log: Log, site: str) -> dict[str, Arrivals]:
    """Returns the arrivals at a site, per peer."""
    part = log[site]
    counts, entries = part.arrivals
    tick = np.repeat(part.tick, counts)
    found = {}
    for index, peer in enumerate(part.peers):
        here = entries[:, 0] == index
        at = tick[here]
        sample = entries[here, 1]
        delay_us = entries[here, 2]
        # a link accepts no stamp before the epoch, and none further ahead than the limit
        latest_ns = at * NS_PER_S // part.rate_hz + AHEAD_LIMIT_NS
        peer_hz = log.scenario.sites[peer].rate_hz
        limit = (
            (latest_ns + 1) * peer_hz - 1
        ) // NS_PER_S  # in ticks: a stamp itself might overflow
        known = (sample >= 0) & (sample <= limit) & (sample < log.scenario.ticks(peer))
        refused = len(at) - int(np.count_nonzero(known))
        found[peer] = Arrivals(at[known], sample[known], delay_us[known], refused)
    return found


def count_sent(log: Log, peer: str, newest: int) -> int:
    """Returns how many samples a peer has sent, as far as the log shows; `newest` of them came,
    or -1.
    """
    part = log[peer]
    stated = [
        event.ticks for event in log.events if event.kind == "end" and event.member == peer
    ]
    recorded = int(part.tick[-1]) + 1 if len(part) else 0
    return min(max(newest + 1, recorded, *stated), log.scenario.ticks(peer))


def mark_judged_samples(log: Log, site: str, stamp_ns: Ints, came: Arrivals) -> Bools:
    """Returns for which samples it is known whether they arrived, shape (M,).

    Known are those that arrived, those older than the newest that arrived, and those older than
    the slowest took; except those that may have arrived in a tick whose record is missing.
    Given are the stamps of the samples 0 to M - 1, ns since the epoch, and their first
    arrivals.
    """
    part = log[site]
    count = len(stamp_ns)
    if not len(part):
        return np.zeros(count, dtype=np.bool_)
    prompt = first_ticks(stamp_ns + 1, part.rate_hz)
    slowest = int((came.tick - prompt[came.sample]).max(initial=0))
    newest = int(came.sample.max(initial=-1))
    last = min(int(part.tick[-1]), log.scenario.ticks(site) - 1)
    known: Bools = (np.arange(count) <= newest) | (prompt + slowest <= last)
    absent = np.ones(last + 1, dtype=np.bool_)
    absent[part.tick[part.tick <= last]] = False
    lacking = np.flatnonzero(absent)
    if len(lacking):
        following = np.append(lacking, np.iinfo(np.int64).max)[np.searchsorted(lacking, prompt)]
        known &= following - prompt > slowest
    known[came.sample] = True
    return known


MOST_AGE_BINS = 50
"""Most bins of a histogram of ages."""

ONE_WAY_SCHEMA_VERSION = 2
"""First schema version whose records name the one-way delay of an arrival."""


class ValueStatistics(NamedTuple):
    """Statistics of numbers: mean, standard deviation, percentiles and extremes."""

    mean: float
    deviation: float
    p50: float
    p95: float
    p99: float
    min: float
    max: float


class AgeHistogram(NamedTuple):
    """Number of ticks per age, in bins of equal width; bin n begins at `first_ms` + n
    `width_ms`.
    """

    first_ms: float
    width_ms: float
    ticks: list[int]


class ClockSummary(NamedTuple):
    """The clock of a link's sender against the receiver's: `clock.*` of docs/definitions.md.

    `drift` and `rtt_min_us` are None without an estimate; `faults` says that a clock has
    stepped.
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
        """True if both ends read one and the same clock."""
        return self.bound_max_us == 0 and self.offset_us == 0


def summarise_clock(log: Log, peer: str, site: str) -> ClockSummary | None:
    """Returns the estimates of a peer's clock at a site; None if nothing was measured, as in
    virtual time.
    """
    stats = [stats for stats in log.link_stats(site) if peer in stats.offset_us]
    if not stats:
        return None
    bounds = [each.bound_us.get(peer, 0) for each in stats]
    trips = [trip for each in stats if (trip := each.rtt_us.get(peer, -1)) >= 0]
    drifts = [e for e in log.events if (e.kind, e.member, e.about) == ("clock", site, peer)]
    return ClockSummary(
        offset_us=stats[-1].offset_us[peer],
        offset_first_us=stats[0].offset_us[peer],
        drift_ppm=drifts[-1].drift_ppb / 1e3 if drifts else None,
        drift_bound_ppm=drifts[-1].drift_bound_ppb / 1e3 if drifts else None,
        bound_us=bounds[-1],
        bound_p50_us=float(np.median(bounds)),
        bound_max_us=max(bounds),
        rtt_min_us=min(trips, default=None),
        faults=stats[-1].clock_faults.get(peer, 0),
    )


class SampleCounts(NamedTuple):
    """Counts of the samples of a link, by the receiver's records: `samples.*` of
    docs/definitions.md.
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
    """One directed link in a run, peer -> site, as docs/definitions.md ("Links") defines each
    quantity.

    What the log does not determine is None. `drawn_ms` is what the models in force, `stated`,
    gave to the samples; `age_ms` and `ages` are the effective delay that the controller saw.
    """

    peer: str
    site: str
    stated: list[StatedModel]
    drawn_ms: ValueStatistics | None
    age_ms: ValueStatistics | None
    ages: AgeHistogram | None
    first_use_s: float | None
    ticks_without_new: float | None
    silence_ms: float | None
    counts: SampleCounts | None
    loss: float | None
    burst: float | None
    one_way_us: ValueStatistics | None

    @property
    def name(self) -> str:
        """The link as scenarios call it, "j->i"."""
        return f"{self.peer}->{self.site}"

    @property
    def plain(self) -> bool:
        """True if one constant delay describes all of it."""
        as_stated = self.counts is None or not (self.counts.late or self.counts.missing)
        return as_stated and has_one_constant_delay(self.stated)


def has_one_constant_delay(states: list[StatedModel]) -> bool:
    """True if the models of a link give every sample one and the same delay, and lose none."""
    (_, link), *later = states
    exact = link.to_core_model().kind == DelayKind.CONSTANT and not (
        link.loss or link.duplicate or link.outages_s
    )
    return exact and not later


def summarise_links(log: Log) -> list[LinkSummary]:
    """Returns a summary of every link, by receiver and then by peer, in scenario order.

    Raises:
        LogError: a record names a change that is none.
    """
    changed = list_changes(log)
    came = {site: read_arrivals(log, site) for site in log.sites}
    newest = {
        peer: max(
            int(there[peer].sample.max(initial=-1)) for there in came.values() if peer in there
        )
        for peer in log.sites
    }
    sent = {peer: count_sent(log, peer, tick) for peer, tick in newest.items()}
    return [
        _summarise_link(
            log=log,
            states=list_stated_models(log, f"{peer}->{site}", changed),
            peer=peer,
            site=site,
            sent=sent[peer],
            came=over,
        )
        for site in log.sites
        for peer, over in came[site].items()
    ]


def sample_ages_ns(log: Log, peer: str, site: str) -> Ints:
    """Returns the effective delay at every tick from the first sample in use on, ns."""
    part = log[site]
    used = log[site].used[peer]
    known = used >= 0
    stamp_ns = used[known] * NS_PER_S // log.scenario.sites[peer].rate_hz
    return part.tick[known] * NS_PER_S // part.rate_hz - stamp_ns


def compute_statistics(values: ArrayLike) -> ValueStatistics | None:
    """Returns the statistics of numbers; None of none."""
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        return None
    p50, p95, p99, low, high = np.percentile(array, (50.0, 95.0, 99.0, 0.0, 100.0)).tolist()
    return ValueStatistics(
        mean=float(array.mean()),
        deviation=float(array.std()),
        p50=p50,
        p95=p95,
        p99=p99,
        min=low,
        max=high,
    )


def bin_ages(age_ns: Ints) -> AgeHistogram | None:
    """Returns a histogram of ages, ns, in at most `MOST_AGE_BINS` bins of 1, 2 or 5 times 10^n
    ms.
    """
    if not len(age_ns):
        return None
    low = int(age_ns.min())
    high = int(age_ns.max())
    # ns, from 10 us
    widths = (step * 10**power for power in range(4, 15) for step in (1, 2, 5))
    width_ns = next(width for width in widths if high // width - low // width < MOST_AGE_BINS)
    ticks = np.bincount(age_ns // width_ns - low // width_ns).tolist()
    return AgeHistogram(low // width_ns * width_ns / 1e6, width_ns / 1e6, ticks)


def _summarise_link(
    log: Log, states: list[StatedModel], peer: str, site: str, sent: int, came: Arrivals
) -> LinkSummary:
    part = log[site]
    used = log[site].used[peer]
    fate = predict_delivery(log, peer, site, sent)
    age_ns = sample_ages_ns(log, peer, site)
    known = mark_judged_samples(log, site, fate.stamp_ns, came.first)
    for first, last in log.absences.get(peer, ()):
        known[first : last + 1] = False  # the peer made none of these
    gone = np.ones(len(known), dtype=np.bool_)  # judged samples that could not come into use
    gone[came.first.sample] = False
    gone = (gone | fate.lost) & known
    lost = int(np.count_nonzero(gone))
    judged = int(np.count_nonzero(known))
    bursts = int(np.count_nonzero(gone[1:] & ~gone[:-1])) + int(gone[:1].any())
    pairs = (np.diff(part.tick) == 1) & (used[:-1] >= 0)
    stamped = (
        log.driver == "live" and len(part) > 0 and part.record(0).v >= ONE_WAY_SCHEMA_VERSION
    )
    first_use_s = silence_ms = None
    if (used >= 0).any():
        first_use_s = float(part.t_s[np.flatnonzero(used >= 0)[0]])
        ticks = np.append(
            part.tick[np.flatnonzero(np.diff(used, prepend=-1))], part.tick[-1] + 1
        )
        silence_ms = float(np.diff(ticks * NS_PER_S // part.rate_hz).max()) / 1e6
    return LinkSummary(
        peer,
        site,
        states,
        drawn_ms=compute_statistics(fate.drawn_ms),
        age_ms=compute_statistics(age_ns / 1e6),
        ages=bin_ages(age_ns),
        first_use_s=first_use_s,
        ticks_without_new=float(np.mean(np.diff(used)[pairs] == 0)) if pairs.any() else None,
        silence_ms=silence_ms,
        counts=_count_samples(part=part, used=used, fate=fate, came=came, judged=judged)
        if len(part)
        else None,
        loss=lost / judged if judged else None,
        burst=lost / bursts if bursts else None,
        one_way_us=compute_statistics(came.delay_us) if stamped else None,
    )


def _count_samples(
    part: SiteLog, used: Ints, fate: PredictedDelivery, came: Arrivals, judged: int
) -> SampleCounts:
    first = came.first
    release = fate.release(part.rate_hz)[first.sample]
    lost = fate.lost[first.sample]
    late = ~lost & ~fate.measured[first.sample] & (first.tick > release)
    # the newest wins: at the tick that releases it a sample is in use, or a newer one is
    at = np.maximum(release, first.tick)
    place = np.minimum(np.searchsorted(part.tick, at), len(part) - 1)
    superseded = ~lost & (part.tick[place] == at) & (used[place] != first.sample)
    return SampleCounts(
        sent=len(fate.stamp_ns),
        judged=judged,
        arrived=len(first.sample),
        missing=judged - len(first.sample),
        lost=int(np.count_nonzero(lost)),
        late=int(np.count_nonzero(late)),
        superseded=int(np.count_nonzero(superseded)),
        duplicate=len(came.sample) - len(first.sample),
        copies=fate.copies,
        refused=came.refused,
    )

"""Samples in any order behind any link: equal fates, the newest is in use, and every sample is counted."""

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.core.builders import (
    KINDS,
    POINTS,
    compute_due_ns,
    make_arrival,
    make_channel,
    make_site_with_link,
    step_site,
)
from trilat_net.core.links.channel import LOST
from trilat_net.core.links.delay import DelayKind, LinkModel
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput, TickRecord, first_tick_at, tick_ns

TICKS = 500
PUSHED = ("uniform", "ar1", "trace", "measured", "bursts", "copies", "in order", "play-out")
every_kind = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in PUSHED else pytest.mark.long) for name in KINDS],
)
quick = settings(max_examples=12)


def make_site_behind_link(name: str, rate_hz: int = 1000, peer_rate_hz: int = 1000) -> Site:
    return make_site_with_link(rate_hz, peer_rate_hz, [KINDS[name]], POINTS)


def list_releases(name: str, count: int, rate_hz: int, peer_rate_hz: int) -> list[int]:
    """Returns the first tick of the receiver that may use each sample, or LOST, from a channel alone."""
    release_times = compute_due_ns(
        make_channel([KINDS[name]], rate_hz=peer_rate_hz, points=POINTS), count
    ).tolist()
    return [
        LOST if ns == LOST else first_tick_at(max(ns, tick_ns(m, peer_rate_hz) + 1), rate_hz)
        for m, ns in enumerate(release_times)
    ]


arrivals = st.lists(st.lists(st.integers(0, 250), max_size=8), min_size=1, max_size=80)


@every_kind
@quick
@given(came=arrivals, rates=st.sampled_from([(1000, 1000), (1000, 333), (700, 1000)]))
def test_the_newest_due_arrived_sample_is_used(
    name: str, came: list[list[int]], rates: tuple[int, int]
) -> None:
    """Permuted, dropped, duplicated, late and early arrivals, against a list; the step never goes back."""
    release = list_releases(name, 251, *rates)
    site = make_site_behind_link(name, *rates)
    arrived: set[int] = set()
    before = -1
    for k in range(TICKS):
        now = came[k] if k < len(came) else []
        arrived.update(now)
        output = site.step(TickInput(k, [make_arrival(m) for m in now]))
        assert output.used == [max((m for m in arrived if LOST < release[m] <= k), default=-1)]
        assert output.used[0] >= before
        before = output.used[0]
        if before >= 0:
            assert (output.q_des, output.qd_des) == (
                list(make_arrival(before).q),
                list(make_arrival(before).qd),
            )


@every_kind
@quick
@given(came=arrivals)
def test_every_arrival_is_accounted_for(name: str, came: list[list[int]]) -> None:
    """Accepted = refused + duplicate + lost + superseded + used, once no sample waits any more."""
    site = make_site_behind_link(name)
    release = list_releases(name, 251, 1000, 1000)
    used: set[int] = set()
    for k in range(max(release) + len(came) + 1):
        now = came[k] if k < len(came) else []
        used.add(site.step(TickInput(k, [make_arrival(m) for m in now])).used[0])
    counts = site.counts()[0]
    gone = counts.refused + counts.duplicate + counts.lost + counts.superseded
    assert counts.accepted == sum(map(len, came)) == gone + len(used - {-1})
    assert counts.lost == sum(release[m] == LOST for now in came for m in now)
    late = sum(LOST < release[m] < k for k, m in first_arrivals(came) if name != "measured")
    assert counts.late == late


def first_arrivals(came: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Returns (tick of the receiver, sample) without repetitions."""
    seen: dict[int, int] = {}
    for k, now in enumerate(came):
        for m in now:
            seen.setdefault(m, k)
    return [(k, m) for m, k in seen.items()]


@every_kind
@quick
@given(
    order=st.permutations(range(20, 60)),
    at=st.lists(st.integers(0, 20), min_size=40, max_size=40),
    twice=st.sets(st.integers(20, 59)),
    peer_rate_hz=st.sampled_from([500, 1000]),
)
def test_the_order_of_arrival_changes_no_bit(
    name: str, order: list[int], at: list[int], twice: set[int], peer_rate_hz: int
) -> None:
    """Samples that come before they are due, in any order, some twice, in one batch or many."""

    def run_with(schedule: dict[int, list[int]]) -> list[TickRecord]:
        ticks = [
            TickInput(k, [make_arrival(m) for m in schedule.get(k, [])]) for k in range(450)
        ]
        return [
            output._replace(rx_crc=0)
            for output in step_site(make_site_behind_link(name, 1000, peer_rate_hz), ticks)
        ]

    scattered: dict[int, list[int]] = {}
    for m, k in zip(order, at, strict=True):
        scattered.setdefault(k, []).extend([m] * (1 + (m in twice)))
    assert run_with(scattered) == run_with({0: list(range(20, 60))})


@every_kind
@pytest.mark.parametrize("k", [1, 40, 333])
def test_reused_sites_have_the_same_future(name: str, k: int) -> None:
    """A fresh site, or one used for something else before: the memory of a channel follows from
    the beginning.
    """
    ticks = [TickInput(n, [make_arrival(n - 1)] if n else []) for n in range(TICKS)]
    whole = step_site(make_site_behind_link(name), ticks)
    before = whole[max(0, k - 2)]
    last = whole[k - 1]
    in_use = [make_arrival(last.used[0]) if last.used[0] >= 0 else None]
    waiting = [make_arrival(m) for m in range(last.used[0] + 1, k - 1)]
    worn = make_site_behind_link(name)
    step_site(worn, ticks[: k + 100])
    for site in (make_site_behind_link(name), worn):
        site.restore_links(k, in_use, waiting)
        site.restore_state(before, last)
        assert step_site(site, ticks[k:]) == whole[k:]


@every_kind
def test_a_long_silence_changes_nothing_afterwards(name: str) -> None:
    """The channel advances by index while no sample comes."""
    silent = step_site(
        make_site_behind_link(name),
        [TickInput(k, [make_arrival(k - 1)] if k > 600 else []) for k in range(900)],
    )
    heard = step_site(
        make_site_behind_link(name),
        [TickInput(k, [make_arrival(k - 1)] if k else []) for k in range(900)],
    )
    settled = next(k for k in range(601, 900) if silent[k].used[0] >= 600)
    assert [o.used for o in silent[settled:]] == [o.used for o in heard[settled:]]


# Hostile and ancient.

hostile = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-5, 60_000),
    st.sampled_from([2**40 - 1, -1, 2**63 - 1, -(2**63), 18_446_744_074, 10_000, 10_001]),
)


@every_kind
@quick
@given(came=st.lists(st.lists(hostile, max_size=5), max_size=6))
def test_work_is_bounded_for_any_sample_number(name: str, came: list[list[int]]) -> None:
    """A channel looks no further ahead than ten seconds, and no other peer's samples suffer."""
    site = make_site_behind_link(name)
    for k, now in enumerate(came):
        output = site.step(TickInput(k, [Arrival(0, m, (0.1, 0.2), (0.0, 0.0)) for m in now]))
        assert site._links["scheduled"][0] <= k + 10_000
        assert output.used[0] < k
    k = len(came)
    counts = site.counts()[0]
    assert counts.refused == sum(
        not 0 <= m <= k + 10_000 for k, now in enumerate(came) for m in now
    )
    assert site.release_tick(0, 200) == make_site_behind_link(name).release_tick(0, 200)


@pytest.mark.parametrize("name", ["constant", "uniform", "measured", "in order"])
def test_an_ancient_sample_counts_as_lost(name: str) -> None:
    """The page of the calendar has been reused; at 1 Hz there are 32 pages."""
    site = make_site_behind_link(name, 1, 1)
    step_site(site, [TickInput(k, [make_arrival(k - 1)] if k else []) for k in range(60)])
    before = site.counts()[0]
    output = site.step(
        TickInput(60, [make_arrival(59), make_arrival(3), make_arrival(27), make_arrival(40)])
    )
    after = site.counts()[0]
    assert output.used == [59]
    assert after.lost - before.lost == 2
    assert after.duplicate - before.duplicate == 1
    assert site.release_tick(0, 3) is None


# Single kinds.


@given(
    came=st.lists(st.integers(0, 30), min_size=30, max_size=30),
    rates=st.sampled_from([(1000, 1000), (400, 900)]),
)
def test_measured_samples_are_used_from_arrival(
    came: list[int], rates: tuple[int, int]
) -> None:
    """But not at their own stamp: a sample from a clock that is ahead waits for the first later tick."""
    site = make_site_with_link(*rates, [LinkModel(kind=DelayKind.MEASURED)])
    for k in range(80):
        now = [m for m, at in enumerate(came) if at == k]
        usable = [
            m
            for m, at in enumerate(came)
            if at <= k and tick_ns(m, rates[1]) < tick_ns(k, rates[0])
        ]
        assert site.step(TickInput(k, [make_arrival(m) for m in now])).used == [
            max(usable, default=-1)
        ]
    assert site.counts()[0].late == 0
    assert site.is_measured(0)


def test_measured_links_may_have_play_out_buffers() -> None:
    """Real jitter below the budget becomes a constant delay."""
    site = make_site_with_link(
        1000, 1000, [LinkModel(kind=DelayKind.MEASURED, playout_us=20_000)]
    )
    jitter = [1, 7, 3, 19, 12, 5, 20, 2]
    at: dict[int, list[int]] = {}
    for m in range(200):
        at.setdefault(m + jitter[m % 8], []).append(m)
    outputs = step_site(
        site, [TickInput(k, [make_arrival(m) for m in at.get(k, [])]) for k in range(200)]
    )
    assert [o.used[0] for o in outputs] == [max(k - 20, -1) for k in range(200)]


def test_a_cut_link_ages_and_heals() -> None:
    """`used` stands still, never decreases, and is back to nominal with the first fresh sample."""
    model = LinkModel(location=20_000.0)
    site = make_site_with_link(1000, 1000, [model], outages=((100 * 10**6, 200 * 10**6),))
    used = [
        o.used[0]
        for o in step_site(
            site, [TickInput(k, [make_arrival(k - 1)] if k else []) for k in range(300)]
        )
    ]
    assert used[20:120] == list(range(100))
    assert used[120:220] == [99] * 100
    assert used[220:] == list(range(200, 280))
    assert site.counts()[0].lost == 100

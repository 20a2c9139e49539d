"""Arrivals at a site by its records, and inferred arrivals where records are missing."""

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.core.step.ticks import MAX_ARRIVALS, Arrival, Mode, TickRecord
from trilat_net.execution.virtual_network import Deliveries, RecordedNetwork
from trilat_net.log.site_log import SiteLog
from trilat_net.net.wire import encode_state

TICKS = 120
PEERS = ("m1", "m2")
SENDERS = [1000] * 2, [TICKS - 1] * 2

Sample = tuple[int, int]
"""Index of the peer, tick of the sample."""
Way = dict[Sample, int | None]
"""How many ticks a sample is under way; None: it never comes."""

delays = st.dictionaries(
    st.tuples(st.integers(0, 1), st.integers(0, 110)), st.integers(1, 12), max_size=60
)
lost_ticks = st.sets(st.integers(1, TICKS - 2), min_size=1, max_size=50)


def make_steady_way(ticks: int = 1) -> Way:
    """Returns arrivals with the same number of ticks for every sample."""
    return {(peer, tick): ticks for peer in (0, 1) for tick in range(TICKS)}


def in_order(under_way: Way) -> Way:
    """Holds each sample back until the earlier samples of the same peer have come."""
    held: Way = {}
    for peer in (0, 1):
        arrives = 0
        for tick in range(TICKS):
            arrives = max(arrives, tick + (under_way.get((peer, tick)) or 1))
            held[peer, tick] = arrives - tick
    return held


def make_record(k: int) -> TickRecord:
    """Returns the record of a tick at which nothing moves."""
    two = [0.0] * 2
    five = [0.0] * 5
    return TickRecord(
        k, k * 10**6, Mode.RUN, two, two, two, two, two, two, five, [-1, -1], 0, [], []
    )


def make_site_log(way: Way, lost: set[int] = frozenset()) -> SiteLog:
    """Returns the records of a site at 1 kHz, but for the lost ones."""
    at: dict[int, list[Arrival]] = {}
    for (peer, tick), ticks in way.items():
        if ticks is not None:
            at.setdefault(tick + ticks, []).append(Arrival(peer, tick, (), (), 1000 * ticks))
    payloads = [
        encode_state(
            "s",
            1,
            PEERS,
            make_record(k),
            at.get(k, []),
            0,
            0,
        )
        for k in range(TICKS)
        if k not in lost
    ]
    return SiteLog("s", PEERS, 1000, payloads, "a test")


def list_arrivals(deliveries: Deliveries) -> set[Sample]:
    """Returns every sample that arrives, at any tick."""
    return {(entry[0], entry[1]) for at in deliveries.entries.values() for entry in at}


def test_whole_logs_give_their_recorded_arrivals() -> None:
    part = make_site_log(make_steady_way(3))
    deliveries = Deliveries.complete(part, *SENDERS)
    assert deliveries == Deliveries.read(part)
    assert deliveries.entries == {state.tick: state.rx for state in part.states}
    assert (deliveries.first, deliveries.last, deliveries.unrecorded) == (
        0,
        TICKS - 1,
        frozenset(),
    )


@given(lost=lost_ticks, ticks=st.integers(1, 9))
def test_steady_networks_reveal_missing_arrivals(lost: set[int], ticks: int) -> None:
    whole = make_site_log(make_steady_way(ticks))
    deliveries = Deliveries.complete(make_site_log(make_steady_way(ticks), lost), *SENDERS)
    assert deliveries.unrecorded == lost
    pairs = {k: sorted(entry[:2] for entry in at) for k, at in deliveries.entries.items() if at}
    assert pairs == {
        state.tick: sorted(e[:2] for e in state.rx) for state in whole.states if state.rx
    }


@given(under_way=delays, lost=lost_ticks)
def test_every_arrived_sample_is_listed_once(under_way: Way, lost: set[int]) -> None:
    """Samples older than the newest one in a record are listed in order; later samples are unknown."""
    whole = make_site_log(in_order(under_way))
    gapped = make_site_log(in_order(under_way), lost)
    deliveries = Deliveries.complete(gapped, *SENDERS)
    for state in gapped.states:
        assert deliveries.entries[state.tick] == state.rx
    assert sum(map(len, deliveries.entries.values())) == len(list_arrivals(deliveries))
    listed = list_arrivals(Deliveries.read(gapped))
    newest = [max((tick for j, tick in listed if j == peer), default=-1) for peer in (0, 1)]
    assert {s for s in list_arrivals(deliveries) if s[1] <= newest[s[0]]} == {
        s for s in list_arrivals(Deliveries.read(whole)) if s[1] <= newest[s[0]]
    }
    assert all(k > tick for k, at in deliveries.entries.items() for _, tick, _ in at)


def test_a_lost_sample_does_not_come() -> None:
    """Sample 50 was lost, far from any gap."""
    deliveries = Deliveries.complete(
        make_site_log({**make_steady_way(), (0, 50): None}, {20, 21, 80}), *SENDERS
    )
    assert (0, 50) not in list_arrivals(deliveries)
    assert {(1, 50), (0, 20), (0, 79)} <= list_arrivals(deliveries)


rates = st.sampled_from([250, 333, 500, 1000, 1500, 4000])


@given(ticks=st.integers(1, 30), rate_hz=rates, peer_rate_hz=rates)
def test_other_rates_keep_the_travel_time(ticks: int, rate_hz: int, peer_rate_hz: int) -> None:
    deliveries = Deliveries.read(make_site_log(make_steady_way(ticks)))
    later_deliveries = deliveries.retime(1000, rate_hz, [1000, 1000], [peer_rate_hz, 1000])
    assert later_deliveries.last == 119 * rate_hz // 1000
    first = [
        (k, m)
        for k in sorted(later_deliveries.entries)
        for peer, m, _ in later_deliveries.entries[k]
        if peer == 0
    ]
    assert first
    assert [m for _, m in first] == list(range(len(first)))
    for k, m in first:
        way_s = k / rate_hz - m / peer_rate_hz
        assert ticks * 1e-3 - 1e-6 <= way_s <= ticks * 1e-3 + 1 / rate_hz


def test_other_rates_keep_lost_samples_lost() -> None:
    deliveries = Deliveries.read(make_site_log({**make_steady_way(), (0, 50): None}))
    doubled = deliveries.retime(1000, 1000, [1000, 1000], [2000, 1000])
    assert not {(0, 100), (0, 101)} & list_arrivals(doubled)
    assert {(0, 99), (0, 102), (1, 50)} <= list_arrivals(doubled)


def test_only_the_newest_assumed_samples_arrive() -> None:
    """A tick takes MAX_ARRIVALS; behind a long gap of a log more may be assumed to have come."""
    ticks = range(MAX_ARRIVALS + 5)
    network = RecordedNetwork({"s": {9: [(0, tick, 0) for tick in ticks]}}, {"s": ["m1"]})
    for tick in ticks:
        network.send("m1", make_record(tick))
    assert [arrival.tick for arrival in network.deliver("s", 9)] == [*ticks[5:]]

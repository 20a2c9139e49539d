"""The receiving end of a link (L2, L7), against a list of samples and fractions of a second."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.builders import make_arrival, make_site_with_delay, step_site
from tests.execution.builders import make_shipped_trajectories
from trilat_net.core.links.link import calendar_pages
from trilat_net.core.step.ticks import TickInput

rates = st.sampled_from([1, 3, 50, 333, 700, 999, 1000, 1001, 4096, 20_000])
S = 10**9


def stamp_ns(tick: int, rate_hz: int) -> int:
    return int(Fraction(tick, rate_hz) * S)


class SampleList:
    """L2 by brute force: of all due samples, the newest that has arrived."""

    def __init__(self, rate_hz: int, peer_rate_hz: int, delay_ns: int) -> None:
        self.rate_hz = rate_hz
        self.peer_rate_hz = peer_rate_hz
        self.delay_ns = delay_ns
        self.come: dict[int, int] = {}
        self.accepted = self.late = self.duplicate = self.refused = 0

    def due(self, tick: int, k: int) -> bool:
        now = stamp_ns(k, self.rate_hz)
        stamp = stamp_ns(tick, self.peer_rate_hz)
        return now >= stamp + self.delay_ns and now > stamp

    def take(self, k: int, tick: int) -> None:
        self.accepted += 1
        if tick < 0 or stamp_ns(tick, self.peer_rate_hz) - stamp_ns(k, self.rate_hz) > 10 * S:
            self.refused += 1
        elif tick in self.come:
            self.duplicate += 1
        else:
            self.late += k > 0 and self.due(tick, k - 1)
            self.come[tick] = k

    def used(self, k: int) -> int:
        return max((tick for tick in self.come if self.due(tick, k)), default=-1)


@given(
    rate_hz=rates,
    peer_rate_hz=rates,
    delay_us=st.one_of(st.just(0), st.integers(0, 50_000), st.integers(0, 10_000_000)),
    tick=st.integers(0, 10_000),
)
def test_samples_are_released_when_due_after_stamp(
    rate_hz: int, peer_rate_hz: int, delay_us: int, tick: int
) -> None:
    released = make_site_with_delay(rate_hz, peer_rate_hz, delay_us * 1000).release_tick(
        0, tick
    )
    assert released is not None
    model = SampleList(rate_hz, peer_rate_hz, delay_us * 1000)
    assert model.due(tick, released)
    assert not model.due(tick, released - 1)


@given(
    rate_hz=st.sampled_from([100, 333, 1000, 1001]),
    peer_rate_hz=st.sampled_from([100, 333, 1000, 1001]),
    delay_us=st.integers(0, 20_000),
    data=st.data(),
)
def test_the_newest_due_sample_is_in_use(
    rate_hz: int, peer_rate_hz: int, delay_us: int, data: st.DataObject
) -> None:
    """Any order, late samples, duplicates, and stamps of the future, all against the list."""
    rates_and_delay = (rate_hz, peer_rate_hz, delay_us * 1000)
    site = make_site_with_delay(*rates_and_delay)
    model = SampleList(*rates_and_delay)
    arrivals = st.lists(st.integers(-1, 40), max_size=6)
    for k in range(25):
        arrival_list = data.draw(arrivals)
        for tick in arrival_list:
            model.take(k, tick)
        output = site.step(TickInput(k, [make_arrival(tick) for tick in arrival_list]))
        used = model.used(k)
        assert output.used == [used]
        if used >= 0:
            assert output.q_des == list(make_arrival(used).q)
            assert output.qd_des == list(make_arrival(used).qd)
    counts = site.counts()[0]
    assert (counts.accepted, counts.late) == (model.accepted, model.late)
    assert (counts.duplicate, counts.refused) == (model.duplicate, model.refused)


@pytest.mark.parametrize("peer_rate_hz", [1, 1000, 20_000])
def test_stamps_ten_seconds_ahead_are_refused(peer_rate_hz: int) -> None:
    site = make_site_with_delay(1000, peer_rate_hz, 0)
    limit = 10 * peer_rate_hz
    site.step(TickInput(0, [make_arrival(limit), make_arrival(limit + 1)]))
    assert site.counts()[0].refused == 1


@given(rate_hz=st.integers(1, 20_000))
def test_calendars_have_pages_for_all_waiting_samples(rate_hz: int) -> None:
    """The longest delay of a sample stamped as far ahead as allowed."""
    pages = calendar_pages(rate_hz)
    assert pages & (pages - 1) == 0
    assert pages > 20 * rate_hz + 1


def test_early_samples_leave_nearer_ones_alone() -> None:
    site = make_site_with_delay(1000, 1000, 10_000_000_000)
    first = [make_arrival(m) for m in range(0, 10_001, 50)]
    outputs = step_site(site, [TickInput(0, first), *(TickInput(k) for k in range(1, 20_001))])
    assert [o.used[0] for o in outputs] == [
        -1 if k < 10_000 else 50 * ((k - 10_000) // 50) for k in range(20_001)
    ]


# The delay bookkeeping, on whole runs.


@pytest.mark.parametrize(
    ("delay_ms", "ticks"),
    [(0.0, 1), (199.0, 199), (199.001, 200), (200.0, 200), (200.001, 201)],
)
def test_peers_are_used_once_due_after_stamps(delay_ms: float, ticks: int) -> None:
    """Between two ticks the later one uses a sample that is due, and one without delay is used
    a period after its stamp.
    """
    records = make_shipped_trajectories("paper", {"link.delay_ms": delay_ms, "duration_s": 0.5})
    expected = np.maximum(np.arange(500) - ticks, -1)
    for name, site in records.sites.items():
        assert (site.used == expected[:, None]).all()
        first, second = (
            records.sites[peer].q[:-ticks] for peer in records.scenario.peers(name)
        )
        assert (site.q_des[ticks:] == 0.5 * first + 0.5 * second).all()


def test_each_link_of_asymmetric_has_its_own_delay() -> None:
    records = make_shipped_trajectories("asymmetric", {"duration_s": 1.0})
    for name, site in records.sites.items():
        for j, peer in enumerate(records.scenario.peers(name)):
            slip = round(records.scenario.links[f"{peer}->{name}"].delay_ms)
            assert (site.used[:, j] == np.maximum(np.arange(1000) - slip, -1)).all()


# The initial history (L7).


def test_a_peer_first_rests_at_its_start() -> None:
    records = make_shipped_trajectories("free", {"duration_s": 1.0})
    starts = {name: np.array(spec.q0_rad) for name, spec in records.scenario.sites.items()}
    for name, site in records.sites.items():
        a, b = (starts[p] for p in records.scenario.peers(name))
        assert (site.q_des[:200] == 0.5 * a + 0.5 * b).all()
        assert (site.qd_des[:200] == 0.0).all()
        assert (site.used[:200] == -1).all()

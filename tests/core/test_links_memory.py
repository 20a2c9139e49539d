"""The memory of links grows with their delays up to the limit of a site."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.builders import (
    KINDS,
    make_arrival,
    make_site_with_delay,
    make_site_with_link,
    step_site,
)
from tests.scenario.builders import planar_task_text, six_joint_text
from trilat_net.core.links.delay import LinkModel
from trilat_net.core.links.link import AHEAD_LIMIT_S, calendar_pages
from trilat_net.core.step.site_arrays import MAX_LINKS_BYTES, CalendarSizer, SiteArrays
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import CoreChange, TickInput
from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario, parse_embedded, parse_scenario
from trilat_net.scenario.run_changes import LinkTables, resolve_change

MIB = 2**20


def count_link_bytes(arrays: SiteArrays) -> int:
    """Returns the bytes that all links of a site take for samples and their times."""
    waiting = 0 if arrays.channel is None else arrays.channel.waiting.nbytes
    return arrays.dues.nbytes + arrays.calendars.nbytes + waiting


SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    "planar": ("paper", {}),
    "gamma": ("paper", {"link.model": "gamma", "link.deviation_ms": 20.0}),
    "normal": ("paper", {"link.model": "normal", "link.deviation_ms": 20.0}),
    "uniform": ("paper", {"link.model": "uniform", "link.half_width_ms": 50.0}),
    "six joints": (six_joint_text(1.0), {}),
    "a place": (planar_task_text(1.0), {}),
    "a law that sends": ("paper", {"control.law": "tests.channel_law:Talking"}),
}


@pytest.mark.parametrize("kind", SCENARIOS)
def test_100_ms_links_take_below_a_mebibyte(kind: str) -> None:
    """The limit holds at 1 kHz and 4 kHz for any arms, laws and distributions."""
    source, changes = SCENARIOS[kind]
    for rate_hz in (1000, 4000):
        scenario = load_scenario(
            source, {"rate_hz": rate_hz, "link.delay_ms": 100.0, **changes}
        )
        for name in scenario.names:
            setup = scenario.setup(name)
            arrays = Site(setup)._arrays
            assert count_link_bytes(arrays) <= MIB * len(setup.links)
            assert count_link_bytes(arrays) == SiteArrays.count_link_bytes(
                setup, arrays.calendars.shape[1]
            )


# Calendars that widen give what the widest give.


def make_wide_site(site: Site, pages: int) -> Site:
    site._arrays = site._arrays.widen_calendars(0, pages)
    site._tick_arrays = (*site._arrays, *site._buffers)
    return site


ORDERS = st.one_of(
    st.none(),
    st.builds(lambda us: LinkModel(location=float(us)), st.integers(0, 10_000_000)),
    st.sampled_from(
        [KINDS["gamma"], KINDS["ar1"], KINDS["in order"], KINDS["copies"], KINDS["lognormal"]]
    ),
)


@pytest.mark.parametrize("rates", [(1000, 1000), (400, 900), (50, 1001)], ids=str)
@given(data=st.data())
def test_widening_links_keep_the_records(rates: tuple[int, int], data: st.DataObject) -> None:
    """Senders up to ten seconds ahead and late by as much, out of order and twice, delays that change."""
    grown = make_site_with_link(*rates, [LinkModel(location=1_000.0)])
    widest = make_site_with_link(*rates, [LinkModel(location=1_000.0)])
    widest = make_wide_site(widest, calendar_pages(rates[0]))
    first = grown._arrays.calendars.shape[1]
    now = 0
    arrival_ticks = st.integers(-AHEAD_LIMIT_S * rates[1], AHEAD_LIMIT_S * rates[1] + 2)
    for batch in data.draw(
        st.lists(
            st.tuples(st.lists(arrival_ticks, max_size=5), ORDERS, st.integers(1, 900)),
            max_size=6,
        )
    ):
        ahead, model, idle = batch
        own_tick = now * rates[1] // rates[0]
        orders = []
        if model is not None:
            from_ns = (now + rates[0] // 10) * 10**9 // rates[0]
            orders = [CoreChange("order", 0, model._replace(from_ns=from_ns))]
        tick = TickInput(now, [make_arrival(max(own_tick + m, 0)) for m in ahead], orders)
        assert grown.step(tick) == widest.step(tick)
        idly = [TickInput(now + n) for n in range(1, idle)]
        assert step_site(grown, idly) == step_site(widest, idly)
        assert grown.counts() == widest.counts()
        now += idle
    assert first <= grown._arrays.calendars.shape[1] <= calendar_pages(rates[0])


def test_growing_delays_lose_no_sample() -> None:
    """While the delay grows from 1 ms to ten seconds, every sent sample comes into use when it is due."""
    site = make_site_with_delay(1000, 1000, 1_000_000)
    order = CoreChange("longer", 0, LinkModel(from_ns=1_000_000_000, location=9_999_000.0))
    ticks = (
        TickInput(k, [make_arrival(k - 1)] if k else [], [order] if k == 800 else [])
        for k in range(13_000)
    )
    used = [record.used[0] for record in step_site(site, ticks)]
    assert used[1000:10_999] == [999] * 9999
    assert used[10_999:] == list(range(1000, 3001))
    assert site.counts()[0].lost == site.counts()[0].refused == 0


def test_samples_on_their_way_survive_the_widening() -> None:
    """This includes the numbers of a law's peer, for every peer."""
    scenario = load_scenario(
        "paper", {"link.delay_ms": 100.0, "control.law": "tests.channel_law:Talking"}
    )
    setups = [scenario.setup("m1")] * 2
    small = Site(setups[0])
    large = make_wide_site(Site(setups[1]), 1 << 15)
    for k in range(400):
        arrivals = [
            make_arrival(k - 1, peer)._replace(
                tau_x=(0.1 * k, 0.0), ch=(0.1 * k + peer, 1.0, 2.0)
            )
            for peer in (0, 1)
        ]
        if k == 50:
            arrivals.append(make_arrival(5000)._replace(tau_x=(9.0, 9.0), ch=(1.0, 2.0, 3.0)))
        tick = TickInput(k, arrivals if k else [])
        assert small.step(tick) == large.step(tick)
    assert small._arrays.calendars.shape[1] == 8192


# One limit.


def many_sites_text(count: int, rate_hz: int, delay_ms: float) -> str:
    """Returns the text of so many sites, each of which follows the site before it."""
    names = [f"a{n}" for n in range(count)]
    sites = "".join(f"[sites.{name}]\n" for name in names)
    rows = "".join(
        f"[dominance.{name}]\n{names[n - 1]} = 1.0\n" for n, name in enumerate(names)
    )
    return f"name = 'x'\nrate_hz = {rate_hz}\n[link]\ndelay_ms = {delay_ms}\n{sites}{rows}"


@pytest.mark.parametrize(
    ("count", "rate_hz"), [(3, 4000), (8, 1000), (12, 1000), (12, 4000), (32, 1000)]
)
def test_the_recorder_takes_virtual_runs(count: int, rate_hz: int) -> None:
    scenario = parse_scenario(many_sites_text(count, rate_hz, 100.0))
    assert parse_embedded(scenario.text).names == scenario.names
    assert count_link_bytes(Site(scenario.setup("a0"))._arrays) <= MAX_LINKS_BYTES


def test_limit_has_equal_words_in_all_scenarios() -> None:
    text = many_sites_text(12, 20_000, 9000.0)
    problems = []
    for read in (parse_scenario, parse_embedded):
        with pytest.raises(
            ScenarioError,
            match=r"the links of this site would need \d+ MiB, but at most 64 MiB are allowed",
        ) as caught:
            read(text)
        problems.append((caught.value.path, caught.value.problem))
    assert problems[0] == problems[1]
    assert problems[0][0] == "sites.a0"


def test_changes_beyond_the_limit_are_refused() -> None:
    scenario = parse_scenario(many_sites_text(12, 20_000, 1.0))
    present = LinkTables(scenario.links, ())
    change = {"link": "a1->a0", "to": {"delay_ms": 40.0}}
    assert resolve_change(scenario, present, change, 10**9).link == "a1->a0"
    with pytest.raises(ScenarioError, match="the links of this site would need"):
        resolve_change(scenario, present, {**change, "to": {"delay_ms": 9000.0}}, 10**9)


def test_limited_links_count_what_they_refuse() -> None:
    """A site with less memory refuses stamps from further ahead; all others come into use."""
    setup = load_scenario("paper").setup("m1")
    assert (
        CalendarSizer(setup).most_pages == calendar_pages(1000) > SiteArrays.count_pages(setup)
    )
    free = make_site_with_delay(1000, 1000, 1_000_000)
    tight = make_site_with_delay(1000, 1000, 1_000_000)
    tight._sizer.most_pages = 1024
    ahead = TickInput(0, [make_arrival(m) for m in (0, 500, 900, 1100, 5000)])
    for site in (free, tight):
        used = [
            record.used[0]
            for record in step_site(site, [ahead, *(TickInput(k) for k in range(1, 1000))])
        ]
        assert used[-1] == 900
    assert free.counts()[0].refused == 0
    assert tight.counts()[0].refused == 2
    assert tight._arrays.calendars.shape[1] == 1024


def test_the_most_pages_are_within_the_limit() -> None:
    """The number of pages is bounded for every limit below twenty seconds."""
    setup = parse_scenario(many_sites_text(12, 4000, 100.0)).setup("a0")
    pages = CalendarSizer(setup).most_pages
    assert SiteArrays.count_pages(setup) < pages < calendar_pages(4000)
    assert SiteArrays.count_link_bytes(setup, pages) <= MAX_LINKS_BYTES
    assert SiteArrays.count_link_bytes(setup, 2 * pages) > MAX_LINKS_BYTES

"""The tables of a run are exactly as large as its delays need."""

import numpy as np
import pytest

from tests.core.builders import KINDS, POINTS, compute_due_ns, make_channel, make_site_setup
from trilat_net.core.links.channel import LOST
from trilat_net.core.links.delay import MAX_DELAY_US, max_delay_us
from trilat_net.core.links.link import calendar_pages
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.scenario import load_scenario


@pytest.mark.parametrize("name", KINDS)
def test_no_sample_is_due_after_the_longest_delay(name: str) -> None:
    model = KINDS[name]
    traces = [POINTS if name == "trace" else None]
    due_ns = compute_due_ns(make_channel([model], 3, points=POINTS), 5000)
    kept = due_ns != LOST
    delay_us = (due_ns[kept] - np.arange(5000)[kept] * 1_000_000) / 1000
    longest = max_delay_us([model], traces)
    assert delay_us.max() <= longest <= MAX_DELAY_US


def test_links_have_about_the_pages_they_need() -> None:
    """For a distribution without bound, the largest possible draw counts."""

    def pages(**changes: object) -> int:
        setups = [make_site_setup(name, "free", **changes) for name in ("m1", "m2", "s")]
        return SiteArrays.stack(setups).calendars.shape[2]

    assert pages(link__delay_ms=200.0) == 256
    assert pages(link__delay_ms=0.0) <= 16
    assert pages(link__model="gamma", link__delay_ms=20.0, link__deviation_ms=5.0) == 128
    heavy = pages(link__model="lognormal", link__delay_ms=100.0, link__deviation_ms=100.0)
    assert 10_000 < heavy <= calendar_pages(1000)


def test_stacked_tables_hold_each_sites_own() -> None:
    scenario = load_scenario("windup")
    setups = [scenario.setup(name) for name in scenario.names]
    whole = SiteArrays.stack(setups)
    for n, setup_of_lane in enumerate(setups):
        site_arrays = SiteArrays.build(setup_of_lane)
        assert whole.site[n].tobytes() == site_arrays.site.tobytes()
        assert whole.links[n].tobytes() == site_arrays.links.tobytes()
        assert whole.ramps[n].tobytes() == site_arrays.ramps.tobytes()
        mine = whole.actors[n][whole.actors[n]["sampled"] != 2]
        assert mine.tobytes() == site_arrays.actors.tobytes()

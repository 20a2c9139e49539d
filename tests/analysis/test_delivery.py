"""What becomes of samples, computed from a log, against the links of the core that decide it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.analysis import delivery as module
from trilat_net.analysis.delivery import first_ticks, predict_delivery
from trilat_net.core.channel import LOST
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import first_tick_at

from . import logs

COUNT = 900
LINKS = [(peer, site) for site in "abc" for peer in "abc" if peer != site]


def decided(peer: str, site: str) -> Site:
    """The site of the core, told of every change at the tick that took it in."""
    log = logs.busy().log
    core = Site(log.scenario.setup(site))
    index = log[site].peers.index(peer)
    for tick, commands in log.commands(site).items():
        core.release_tick(index, tick * log.scenario.sites[peer].rate_hz // core.rate_hz)
        for command in commands:
            core.order(command, 0)
    return core


@pytest.mark.parametrize(("peer", "site"), LINKS)
def test_a_fate_is_what_the_link_of_the_core_decides(peer, site):
    log, core = logs.busy().log, decided(peer, site)
    found = predict_delivery(log, peer, site, COUNT).release(core.rate_hz).tolist()
    index = log[site].peers.index(peer)
    expected = [core.release_tick(index, sample) for sample in range(COUNT)]
    assert found == [LOST if tick is None else tick for tick in expected]


@pytest.mark.parametrize(("peer", "site"), LINKS)
def test_fate_does_not_depend_on_how_many_are_asked_for(peer, site, monkeypatch):
    log = logs.busy().log
    whole = predict_delivery(log, peer, site, COUNT)
    monkeypatch.setattr(module, "_BLOCK", 64)
    part = predict_delivery(log, peer, site, 500)
    assert part.due_ns.tolist() == whole.due_ns[:500].tolist()
    assert part.drawn_ns.tolist() == whole.drawn_ns[:500].tolist()
    assert part.copies <= whole.copies
    assert len(predict_delivery(log, peer, site, 0).due_ns) == 0


def test_order_and_playout_come_on_top_of_what_is_drawn():
    log = logs.busy().log
    for peer, site in LINKS:
        fate = predict_delivery(log, peer, site, COUNT)
        assert ((fate.drawn_ns == LOST) == fate.lost).all()
        if log.scenario.links[f"{peer}->{site}"].duplicate == 0.0:
            assert (fate.due_ns >= fate.drawn_ns).all()
    late = predict_delivery(log, "b", "c", COUNT)
    assert (late.due_ns - late.stamp_ns >= 70_000_000).all()
    assert (late.drawn_ns - late.stamp_ns).min() < 70_000_000


def test_what_is_lost_is_what_link_was_said_to_lose():
    log = logs.busy().log
    cut = predict_delivery(log, "a", "b", COUNT)
    in_outage = (cut.stamp_ns >= 2 * 10**9) & (cut.stamp_ns < 3 * 10**9)
    assert (cut.lost == in_outage).all()
    changed = predict_delivery(log, "a", "c", COUNT)
    assert not changed.lost[changed.stamp_ns < 10**9].any()
    assert changed.lost[changed.stamp_ns >= 10**9].any()


@given(st.lists(st.integers(0, 10**14), max_size=20), st.integers(1, 20_000))
def test_first_ticks_are_those_of_the_grid(due_ns, rate_hz):
    found = first_ticks(np.array(due_ns, dtype=np.int64), rate_hz)
    assert found.tolist() == [first_tick_at(due, rate_hz) for due in due_ns]

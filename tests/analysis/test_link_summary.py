"""Link statistics from records, against the core's own counts and against the theory of ages.

The fate of samples, computed from a log, against the links of the core that decide it.
"""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import trilat_net
from tests.analysis.ages_in_use import compute_ordered_moments, newest_wins
from tests.analysis.builders import drive_run, make_busy_run, make_short_log
from tests.log.builders import replace_fields, rewrite_log
from trilat_net.analysis.link_summary import (
    LinkSummary,
    ValueStatistics,
    bin_ages,
    predict_delivery,
)
from trilat_net.core.links import link_schedule as module
from trilat_net.core.links.channel import LOST
from trilat_net.core.links.link_schedule import LinkSchedule
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import first_tick_at
from trilat_net.errors import LogError
from trilat_net.scenario import load_scenario, parse_scenario

PERIOD_MS = 1.0


def summarise_by_name(log):
    return {use.name: use for use in LinkSummary.list_of_log(log)}


@cache
def summarise_busy_run():
    return summarise_by_name(make_busy_run().log)


def find_counts(run, link):
    peer, site = link.split("->")
    return run.counts[site][run.log[site].peers.index(peer)]


# -- counts


@pytest.mark.parametrize("link", ["a->b", "a->c", "b->a", "b->c", "c->a", "c->b"])
def test_counts_equal_those_of_the_link(link):
    counts = summarise_busy_run()[link].counts
    core = find_counts(make_busy_run(), link)
    assert counts.arrived + counts.duplicate == core.accepted
    assert (counts.lost, counts.late, counts.duplicate) == (
        core.lost,
        core.late,
        core.duplicate,
    )
    assert counts.copies == pytest.approx(core.copies, abs=5)  # of samples that came no more
    # at the end: released with others, as the link knows and no record shows
    waiting = 0.15 * 200
    assert counts.superseded <= core.superseded <= counts.superseded + waiting


def test_superseded_samples_are_never_in_use():
    log = make_busy_run().log
    for peer, site in [("b", "a"), ("c", "a"), ("c", "b")]:
        release = predict_delivery(log, peer, site, log.scenario.ticks(peer)).release(
            log[site].rate_hz
        )
        released = {n for n, tick in enumerate(release) if 0 <= tick <= log[site].tick[-1]}
        arrived = {
            tick
            for state in log[site].states
            for j, tick, _ in state.rx
            if log[site].peers[j] == peer
        }
        never = (released & arrived) - set(log[site].used[peer].tolist())
        assert summarise_busy_run()[f"{peer}->{site}"].counts.superseded == len(never) > 0


def test_lost_and_doubled_samples_are_counted():
    scenario = load_scenario("free", {"duration_s": 1.0, "rate_hz": 200, "link.delay_ms": 20.0})
    burst = {("m1", 0, tick) for tick in (*range(50, 60), 80, *range(90, 93))}
    run = drive_run(scenario, lost=burst, twice={("s", 1, 30), ("s", 1, 31)})
    link_uses = summarise_by_name(run.log)
    lossy = link_uses["m2->m1"]
    assert (lossy.counts.missing, lossy.counts.judged) == (14, 199)
    assert lossy.loss == 14 / 199
    assert lossy.burst == 14 / 3
    assert lossy.silence_ms == 55.0  # ten samples of 5 ms, and the one that came again
    assert not lossy.plain
    assert link_uses["m2->s"].counts.duplicate == 2
    assert find_counts(run, "m2->s").duplicate == 2
    assert (
        link_uses["s->m1"].counts.missing,
        link_uses["s->m1"].burst,
        link_uses["s->m1"].loss,
    ) == (
        0,
        None,
        0.0,
    )


def test_samples_of_missing_records_have_no_fate():
    log = rewrite_log(
        make_short_log("paper"), keep=lambda s: s.site != "m2" or not 100 <= s.tick < 150
    )
    link_uses = summarise_by_name(log)
    for link in ("m1->m2", "s->m2"):
        counts = link_uses[link].counts
        assert (counts.missing, counts.lost, counts.late) == (0, 0, 0)
        assert counts.judged == counts.arrived == 399 - 50
    # its samples came, though its own records are gone
    assert link_uses["m2->s"].counts.missing == 0


def test_a_link_cut_until_the_end_loses_everything():
    scenario = load_scenario("free", {"duration_s": 1.0, "rate_hz": 200, "link.delay_ms": 20.0})
    run = drive_run(scenario, lost={("m1", 0, tick) for tick in range(100, 200)})
    cut = summarise_by_name(run.log)["m2->m1"]
    assert (cut.counts.missing, cut.burst) == (99, 99.0)  # the last one could not have come yet
    assert cut.silence_ms == 1000.0 - (99 * 5.0 + 20.0)


def test_late_samples_equal_those_of_the_core():
    """Every sample of a link takes longer than the link's delay."""
    log = make_short_log("free")
    hurried = log.scenario.text.replace("delay_ms = 200.0", "delay_ms = 0.0")
    assert hurried != log.scenario.text
    run = drive_run(parse_scenario(hurried))
    for use in LinkSummary.list_of_log(run.log):
        assert use.counts.late == find_counts(run, use.name).late


def test_only_out_of_range_stamps_are_refused():
    def hostile(state):
        return replace_fields(
            state,
            rx=[*state.rx, [0, 2**39, 0], [1, 2**30, 0]] if state.tick == 50 else state.rx,
        )

    link_uses = summarise_by_name(rewrite_log(make_short_log("paper"), change=hostile))
    assert [use.counts.refused for use in link_uses.values()] == [1] * 6
    assert [use.counts.sent for use in link_uses.values()] == [400] * 6


def test_false_tick_numbers_cost_no_memory():
    """Tick numbers come from the sender: a false one must not enlarge the tables."""

    def far(state):
        return (
            replace_fields(state, tick=2**39)
            if (state.site, state.tick) == ("m2", 399)
            else state
        )

    with pytest.raises(
        LogError, match="m2 has a record of tick 549755813888, but the scenario has only 400"
    ):
        summarise_by_name(rewrite_log(make_short_log("paper"), change=far))


# -- ages


def test_effective_delay_without_jitter_is_the_stated():
    for use in LinkSummary.list_of_log(make_short_log("paper")):
        assert use.plain
        assert use.one_way_us is None
        assert use.age_ms == ValueStatistics.of_values([200.0])
        assert use.drawn_ms == ValueStatistics.of_values([200.0])
        assert (use.ticks_without_new, use.silence_ms, use.first_use_s) == (0.0, 5.0, 0.2)
        assert sum(use.ages.ticks) == 400 - 40


@pytest.mark.parametrize("link", ["a->b", "a->c", "b->a", "b->c", "c->a", "c->b"])
def test_recorded_ages_follow_from_fates_of_samples(link):
    peer, site = link.split("->")
    log = make_busy_run().log
    part = make_busy_run().log[site]
    fate = predict_delivery(log, peer, site, log.scenario.ticks(peer))
    release = fate.release(part.rate_hz)
    usable = np.full(len(part), -1)
    for sample, tick in enumerate(release):
        if 0 <= tick < len(part):
            usable[tick] = max(usable[tick], sample)
    in_use = np.maximum.accumulate(usable)
    t_ns = np.arange(len(part)) * 10**9 // part.rate_hz
    ages = [(t_ns[tick] - fate.stamp_ns[n]) / 1e6 for tick, n in enumerate(in_use) if n >= 0]
    assert tuple(summarise_busy_run()[link].age_ms) == pytest.approx(
        tuple(ValueStatistics.of_values(ages))
    )


def hyperexponential_cdf(t_ms):
    above = np.maximum(t_ms - 30.0, 0.0)
    return 0.7 * -np.expm1(-above / 5.0) + 0.3 * -np.expm1(-above / 60.0)


MIXED = {
    "model": "hyperexponential",
    "floor_ms": 30.0,
    "fast_ms": 5.0,
    "slow_ms": 60.0,
    "slow_share": 0.3,
}
LOG = stats.lognorm(math.sqrt(math.log1p(0.25)), scale=60.0 / math.sqrt(1.25))
MODELS = {
    "m1->m2": (
        {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 50.0},
        stats.uniform(150, 100).cdf,
    ),
    "m1->s": (
        {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 200.0},
        stats.uniform(0, 400).cdf,
    ),
    "m2->m1": (
        {"model": "gamma", "delay_ms": 120.0, "deviation_ms": 40.0},
        stats.gamma(9, scale=40 / 3).cdf,
    ),
    "m2->s": (
        {"model": "normal", "delay_ms": 80.0, "deviation_ms": 20.0},
        stats.norm(80, 20).cdf,
    ),
    "s->m1": (MIXED, hyperexponential_cdf),
    "s->m2": ({"model": "lognormal", "delay_ms": 60.0, "deviation_ms": 30.0}, LOG.cdf),
}


@cache
def simulate_jitter(order):
    links = {f"links.{name}": {**table, "order": order} for name, (table, _) in MODELS.items()}
    return trilat_net.simulate(load_scenario("free", {"duration_s": 2.0, **links}))


@pytest.mark.parametrize("link", MODELS)
@pytest.mark.parametrize(
    ("order", "theory", "margin"),
    [("newest", newest_wins, 0.1), ("in_order", compute_ordered_moments, 0.2)],
)
def test_effective_delay_under_jitter_follows_theory(link, order, theory, margin):
    """P(age > n h) is a product over independent samples, summed here; the run draws and
    simulates.

    A run of two seconds starts with nothing older to wait for, and the largest of many delays
    varies.
    """
    log = simulate_jitter(order)
    mean_ms, deviation_ms = theory(MODELS[link][1], PERIOD_MS)
    use = summarise_by_name(log)[link]
    assert use.age_ms.mean == pytest.approx(mean_ms, rel=margin)
    peer, site = link.split("->")
    release = predict_delivery(log, peer, site, 100_000).release(1000)
    ages = long_ages(release)[2000:-2000]
    assert ages.mean() == pytest.approx(mean_ms, rel=0.01)
    assert ages.std() == pytest.approx(deviation_ms, rel=0.05)


def long_ages(release):
    """Returns ages at the ticks of a receiver that every sample reaches in time, in periods."""
    newest = np.full(len(release), -1)
    np.maximum.at(newest, np.minimum(release, len(release) - 1), np.arange(len(release)))
    return np.arange(len(release)) - np.maximum.accumulate(newest)


def test_effective_delays_equal_the_documented_figures():
    """200 ms +- 50 ms at 1 kHz becomes 162 ms, 0-400 ms becomes 25 ms; in order the delay is
    longer than stated.
    """
    assert newest_wins(stats.uniform(150, 100).cdf, 1.0)[0] == pytest.approx(162.2, abs=0.05)
    assert newest_wins(stats.uniform(0, 400).cdf, 1.0)[0] == pytest.approx(24.74, abs=0.05)
    assert compute_ordered_moments(stats.uniform(150, 100).cdf, 1.0)[0] == pytest.approx(
        238.8, abs=0.05
    )
    assert compute_ordered_moments(stats.uniform(0, 400).cdf, 1.0)[0] == pytest.approx(
        376.3, abs=0.05
    )


# -- losses


def test_measured_loss_and_bursts_follow_the_model():
    scenario = load_scenario(
        "two_sites",
        {"duration_s": 30.0, "rate_hz": 100, "link.loss": 0.2, "link.loss_burst": 5.0},
    )
    for use in LinkSummary.list_of_log(trilat_net.simulate(scenario)):
        bursts = use.counts.lost / 5.0
        assert use.loss == pytest.approx(0.2, abs=4 * 0.2 * math.sqrt(2.0 / bursts))
        assert use.burst == pytest.approx(5.0, abs=4 * 5.0 / math.sqrt(bursts))
        assert use.counts.missing == 0


def test_playout_makes_smaller_jitter_constant():
    use = summarise_busy_run()["b->c"]
    assert use.drawn_ms.deviation == pytest.approx(20.0, rel=0.4)
    assert use.age_ms.p50 < 80.0  # a tick of 5 ms, a sample every 6.67 ms
    assert use.stated.models[0].link.moments().deviation_ms < 21.0


# -- spreads and histograms


def test_histogram_counts_ticks_in_few_round_bins():
    for use in summarise_busy_run().values():
        bins = use.ages
        assert sum(bins.ticks) == pytest.approx(
            (6.0 - use.first_use_s) * make_busy_run().log[use.site].rate_hz
        )
        assert len(bins.ticks) <= 50
        assert bins.first_ms <= use.age_ms.min
        assert use.age_ms.max < bins.first_ms + len(bins.ticks) * bins.width_ms
        assert f"{bins.width_ms:e}"[0] in "125"


def test_one_age_gives_one_bin():
    assert bin_ages(np.full(7, 200_000_000)).ticks == [7]
    assert bin_ages(np.zeros(0, dtype=np.int64)) is None
    assert ValueStatistics.of_values([]) is None


# -- logs that cannot tell


def test_an_empty_log_has_no_link_statistics():
    log = rewrite_log(make_short_log("paper"), keep=lambda _: False, finished=False)
    for use in LinkSummary.list_of_log(log):
        assert use.stated.models[0].link.delay_ms == 200.0
        assert use.plain
        assert (use.age_ms, use.ages, use.counts, use.loss, use.burst, use.silence_ms) == (
            None,
        ) * 6


def test_measured_delays_equal_those_in_the_records():
    def timed(state):
        return replace_fields(
            state, rx=[[j, tick, 100 * (j + 1) + tick] for j, tick, _ in state.rx]
        )

    log = rewrite_log(make_short_log("paper"), change=timed, driver="live")
    use = summarise_by_name(log)["m2->m1"]
    assert (use.one_way_us.min, use.one_way_us.max) == (100.0, 100.0 + 398)
    old = rewrite_log(log, change=lambda s: replace_fields(s, v=1), driver="live")
    # before version 2 it was the age of the stamp
    assert summarise_by_name(old)["m2->m1"].one_way_us is None


COUNT = 900
LINKS = [(peer, site) for site in "abc" for peer in "abc" if peer != site]


def make_decided_site(peer: str, site: str) -> Site:
    """Returns the site of the core, given every change at the tick at which it was applied."""
    log = make_busy_run().log
    core = Site(log.scenario.setup(site))
    index = log[site].peers.index(peer)
    for tick, commands in log.commands(site).items():
        core.release_tick(index, tick * log.scenario.sites[peer].rate_hz // core.rate_hz)
        for command in commands:
            core.apply_change(command, 0)
    return core


@pytest.mark.parametrize(("peer", "site"), LINKS)
def test_fates_equal_those_of_the_cores_link(peer, site):
    log = make_busy_run().log
    core = make_decided_site(peer, site)
    delivery_ticks = predict_delivery(log, peer, site, COUNT).release(core.rate_hz).tolist()
    index = log[site].peers.index(peer)
    expected = [core.release_tick(index, sample) for sample in range(COUNT)]
    assert delivery_ticks == [LOST if tick is None else tick for tick in expected]


@pytest.mark.parametrize(("peer", "site"), LINKS)
def test_fates_are_independent_of_the_sample_count(peer, site, monkeypatch):
    log = make_busy_run().log
    whole = predict_delivery(log, peer, site, COUNT)
    monkeypatch.setattr(module, "_BLOCK", 64)
    part = predict_delivery(log, peer, site, 500)
    assert part.due_ns.tolist() == whole.due_ns[:500].tolist()
    assert part.drawn_ns.tolist() == whole.drawn_ns[:500].tolist()
    assert part.copies <= whole.copies
    assert len(predict_delivery(log, peer, site, 0).due_ns) == 0


def test_order_and_playout_follow_the_drawn_delays():
    log = make_busy_run().log
    for peer, site in LINKS:
        fate = predict_delivery(log, peer, site, COUNT)
        assert ((fate.drawn_ns == LOST) == fate.lost).all()
        if log.scenario.links[f"{peer}->{site}"].duplicate == 0.0:
            assert (fate.due_ns >= fate.drawn_ns).all()
    late = predict_delivery(log, "b", "c", COUNT)
    assert (late.due_ns - late.stamp_ns >= 70_000_000).all()
    assert (late.drawn_ns - late.stamp_ns).min() < 70_000_000


def test_lost_samples_equal_those_of_the_link():
    log = make_busy_run().log
    cut = predict_delivery(log, "a", "b", COUNT)
    in_outage = (cut.stamp_ns >= 2 * 10**9) & (cut.stamp_ns < 3 * 10**9)
    assert (cut.lost == in_outage).all()
    changed = predict_delivery(log, "a", "c", COUNT)
    assert not changed.lost[changed.stamp_ns < 10**9].any()
    assert changed.lost[changed.stamp_ns >= 10**9].any()


@given(st.lists(st.integers(0, 10**14), max_size=20), st.integers(1, 20_000))
def test_first_ticks_follow_the_grid(due_ns, rate_hz):
    ticks = LinkSchedule.first_ticks(np.array(due_ns, dtype=np.int64), rate_hz)
    assert ticks.tolist() == [first_tick_at(due, rate_hz) for due in due_ns]

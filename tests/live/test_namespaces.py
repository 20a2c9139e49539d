"""Separate machines: the README's recipes, as written, in network namespaces with addresses of their own."""

import signal
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from tests.live.namespaces import can_reach, connect_as_star, connect_by_bridge, list_pairs
from tests.live.processes import assert_executed_again, list_engagements_s, open_whole_log
from tests.truth import Member, find_restarted, judge_link, list_members, offset_errors
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net.clock import SystemClock

from .namespaces import ALL, CLOCKS, PORT, Apart, Machines, NoNamespaces
from .processes import JOINS, PAPER, Stage, pause, ticks_to_hold


def clocks_as_injected(log: Log) -> None:
    """Every estimate that was logged is the injected one within its bound, and so is every sample's delay."""
    clocks = list_members(log)
    for name, (offset_s, drift_ppm) in CLOCKS.items():
        assert clocks[name].offset_ns == offset_s * 1e9
        assert float(clocks[name].rate - 1) * 1e6 == pytest.approx(drift_ppm)
    for site, peer in list_pairs(PAPER):
        link = judge_link(log, site, peer)
        assert link.inside >= 0.999
        assert link.tick.size >= 0.5 * len(log[site])
        assert link.delay_us.min() > 0.0
        t_s, offset_us, drift_ppm = offset_errors(log, site, peer).T
        assert t_s.size > 0
        assert abs(offset_us[-1]) < 1000.0
        assert abs(drift_ppm[-1]) < 100.0


@pytest.mark.parametrize(
    "order",
    [
        pytest.param(ALL, id="in order", marks=pytest.mark.long),
        pytest.param(("recorder", "s", "m2", "m1"), id="backwards", marks=pytest.mark.long),
        pytest.param(("m2", "recorder", "m1", "s"), id="mixed", marks=pytest.mark.long),
    ],
)
def test_three_machines_in_any_order_of_starts(
    order: tuple[str, ...], stage: Stage, apart: Machines
) -> None:
    connect_by_bridge(apart, ALL)
    session = Apart(stage, apart, "--duration", "3")
    session.all(*order)
    log = session.is_reproduced()
    clocks_as_injected(log)


@pytest.mark.long
def test_unreachable_machines_meet_at_a_router(stage: Stage, apart: Machines) -> None:
    connect_as_star(apart, "centre", ALL)
    assert all(can_reach(apart, name, apart.centre[name]) for name in ALL)
    assert not any(
        can_reach(apart, machine, apart.address[other]) for machine, other in list_pairs(ALL)
    )
    session = Apart(stage, apart, "--duration", "3")
    for name in ("m1", "recorder"):
        session.all(name)
        session.processes[name].prints("no router answers at tcp/10.77.")
    command = ("router", "--listen", PORT, "--insecure", "--until-idle", "1")
    router = stage.start("router", *command, before=apart.on("centre"))
    session.all("s", "m2")
    log = session.is_reproduced()
    assert router.code() == 0
    for name in ALL:
        assert f"router: session t: {name} is here" in router.text()
        assert f"router: session t: {name} has left" in router.text()
    clocks_as_injected(log)


@dataclass
class Heard:
    """What one site heard of one peer, tick by tick.

    Attributes:
        arrivals: (tick that took it in, tick of the sample).
        age: ticks from the stamp of the sample in use, per tick.
        outages: (last tick before, first tick after) of every second without an arrival.
    """

    arrivals: list[tuple[int, int]]
    age: list[int]
    outages: list[tuple[int, int]]


def list_heard(log: Log, site: str, peer: str) -> Heard:
    states = log[site].states
    peer_index = log.scenario.peers(site).index(peer)
    arrivals = [
        (state.tick, tick)
        for state in states
        for index, tick, _ in state.rx
        if index == peer_index
    ]
    ticks = sorted({tick for tick, _ in arrivals})
    outages = [(before, after) for before, after in pairwise(ticks) if after - before > 1000]
    return Heard(arrivals, [state.tick - state.used[peer] for state in states], outages)


@pytest.mark.long
def test_cut_ways_heal_and_loops_continue(stage: Stage, apart: Machines) -> None:
    """The way is cut for less than Zenoh's lease, so that messages arrive in a burst, and for longer than the lease."""
    connect_by_bridge(apart, ALL)
    session = Apart(stage, apart, "--duration", "13", "--set", 'links.m2->m1.model="measured"')
    session.all()
    session.begun()
    clock = SystemClock()
    begun_ns = clock.monotonic_ns()
    for begins_s, ends_s in ((1.0, 2.1), (5.0, 10.7)):
        clock.sleep_until(begun_ns + round(begins_s * 1e9))
        apart.part("m1", "m2")
        clock.sleep_until(begun_ns + round(ends_s * 1e9))
        apart.mend("m1", "m2")
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    fed = compare_with_virtual(log).fed
    assert fed.first is None
    assert fed.identical == fed.records == 39_000
    for site, peer in list_pairs(PAPER):
        used = [state.used[peer] for state in log[site].states]
        assert used == sorted(used)
    lost = [(event.member, event.about) for event in log.events if event.kind == "lost"]
    assert sorted(lost) == [("m1", "m2"), ("m2", "m1")]
    assert_nominal_age(log, "m1", "m2", delay=0, nominal=5)
    assert_nominal_age(log, "m2", "m1", delay=200, nominal=202)
    counted = log.link_stats("m2")[-1]
    late = [
        tick for tick, sample in list_heard(log, "m2", "m1").arrivals if tick > sample + 200
    ]
    assert len(late) > 300
    assert counted.late["m1"] == sum(tick <= counted.tick for tick in late)


@pytest.mark.long
def test_machines_hold_during_cuts_and_return(stage: Stage, apart: Machines) -> None:
    """The way is cut for longer than Zenoh's lease; who is killed is the first site, whose grid counts."""
    connect_by_bridge(apart, ALL)
    session = Apart.following(stage, apart, 40)
    apart.part("m1", "m2")
    pause(6.0)
    apart.mend("m1", "m2")
    pause(6.0)
    killed = session.processes.pop("m1")
    killed.signal(signal.SIGKILL)
    assert killed.code() == -signal.SIGKILL
    session.site("m1", called="m1 again").prints(JOINS)
    session.ends_well()
    log = open_log(session.log)
    assert {str(log[name].mode[-1]) for name in PAPER} == {"run"}
    assert max(list_engagements_s(log)) <= 2.0
    for name in ("m1", "m2"):
        held = np.count_nonzero(log[name].mode == "hold")
        assert held > 4000
    assert max(max(holds) for holds in ticks_to_hold(log).values()) <= 21
    assert [log.missing(name) for name in PAPER] == [0, 0, 0]
    result = verify_log(log)
    assert result.passed
    assert result.differing == 0
    assert [site for site, _, _ in result.absences] == ["m1"]
    clocks = {
        **list_members(log),
        "m1": find_restarted(log, "m1"),
    }  # of each the one at the end
    begun_ns = {name: np.median(began_ns(log, name, clocks[name])) for name in PAPER}
    assert max(begun_ns.values()) - min(begun_ns.values()) <= 1_000_000


@pytest.mark.long
def test_one_way_cuts_hold_both_ends(stage: Stage, apart: Machines) -> None:
    """Packets of m1 reach m2 no more, those of m2 go on: for less than Zenoh's lease, and for longer.

    m2 holds at once. Nor do TCP's acknowledgements reach it: what it sends goes on for 0.1 to 0.2 s, until
    its retransmission timer runs out; then m1 hears nothing either, and holds too.
    """
    connect_by_bridge(apart, ALL)
    session = Apart.following(stage, apart, 36)
    for cut_s in (2.5, 8.0):
        try:
            apart.deafen("m2", "m1")
        except NoNamespaces as reason:
            pytest.skip(str(reason))
        pause(cut_s)
        apart.deafen("m2", "m1", ends=True)
        pause(5.0)
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    for site, peer in (("m1", "m2"), ("m2", "m1")):
        assert len(list_heard(log, site, peer).outages) == 2
        said = [
            event.text
            for event in log.events
            if event.member == site and "a peer is silent" in event.text
        ]
        assert len(said) >= 2
    deaf = list_heard(log, "m2", "m1").outages
    dumb = list_heard(log, "m1", "m2").outages
    assert all(first <= last + 100 for (first, _), (last, _) in zip(deaf, dumb, strict=True))
    assert max(max(holds, default=0) for holds in ticks_to_hold(log).values()) <= 21
    lost = {(event.member, event.about) for event in log.events if event.kind == "lost"}
    assert lost == {("m1", "m2"), ("m2", "m1")}
    assert {str(log[name].mode[-1]) for name in PAPER} == {"run"}


def began_ns(log: Log, name: str, clock: Member) -> list[int]:
    """Returns the time of tick 0 according to each record of the last five seconds, on the machine's clock."""
    part = log[name]
    sent_ns = part.sent_ns[part.tick >= part.last_tick - 5000].tolist()
    return [
        clock.true_ns(sent) - t_ns
        for sent, t_ns in zip(sent_ns, part.t_ns[-len(sent_ns) :].tolist(), strict=True)
    ]


def assert_nominal_age(log: Log, site: str, peer: str, delay: int, nominal: int) -> None:
    """Asserts that the age grows while the way is cut, and is nominal within two ticks of the first fresh arrival."""
    link = list_heard(log, site, peer)
    assert len(link.outages) == 2
    for before, after in link.outages:
        # a sample may come within the tick in which it was made: its age begins at 0
        assert max(link.age[before:after]) >= after - before - 1
        ages = [
            stats.age_us[peer]
            for stats in log.link_stats(site)
            if before + delay + 100 < stats.tick < after
        ]
        assert len(ages) >= (after - before - delay) // 100 - 2
        assert ages == sorted(set(ages))
        tick, sample = next((t, s) for t, s in link.arrivals if t >= after and t - s <= nominal)
        ready = max(tick, sample + delay)
        assert min(link.age[ready : ready + 3]) <= nominal, link.age[ready : ready + 10]

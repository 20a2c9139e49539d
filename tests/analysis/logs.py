"""Logs of every kind that a report must support: few sites, many, no hands, torn, short, late."""

import io
from collections.abc import Callable, Collection, Sequence
from functools import cache
from typing import NamedTuple

import msgspec
import numpy as np

import trilat_net
from trilat_net.core.step.ticks import LinkCounts
from trilat_net.execution import virtual
from trilat_net.execution.virtual_network import RecordedNetwork
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.log.site_log import SiteLog
from trilat_net.net import topics
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.wire import encode, encode_state
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.scenario.run_changes import to_core_change
from trilat_net.scenario.scenario_types import Change

FOUR = """
name = "four"
title = "Four </title><script>alert(1)</script> & rates"
about = "</script><b>bold</b>"
assumed = ["<i>nothing</i>"]
rate_hz = 200
duration_s = 2.0
seed = 1
scheme = "second_order"
[link]
delay_ms = 40.0
[sites.a]
role = "master"
rate_hz = 100
q0_rad = [0.6, -0.4]
hands = [{ kind = "pulse", start_s = 0.2, end_s = 1.0, peak_nm = [8.0, 4.0] }]
[sites.b]
role = "master"
rate_hz = 150
[sites.c]
role = "slave"
arm = { l1_m = 0.6, lc1_m = 0.6 }
[sites.d]
role = "slave"
[dominance]
a = { b = 0.5, c = 0.5 }
b = { c = 1.0 }
c = { d = 1.0 }
d = { a = 1.0 }
"""

BUSY = """
name = "busy"
rate_hz = 200
duration_s = 6.0
seed = 5
scheme = "second_order"
[link]
delay_ms = 50.0
[on_stale]
action = "hold"
age_ms = 200.0
return_s = 0.5
[sites.a]
role = "master"
q0_rad = [0.3, -0.2]
[sites.b]
role = "master"
rate_hz = 150
on_stale = { action = "brake" }
[sites.c]
role = "slave"
[dominance]
a = { b = 0.5, c = 0.5 }
b = { a = 0.5, c = 0.5 }
c = { a = 0.5, b = 0.5 }
[links."a->b"]
outages_s = [[2.0, 3.0]]
[links."b->a"]
model = "gamma"
delay_ms = 80.0
deviation_ms = 30.0
loss = 0.2
loss_burst = 5.0
[links."c->a"]
model = "uniform"
delay_ms = 60.0
half_width_ms = 40.0
order = "in_order"
duplicate = 0.2
[links."b->c"]
model = "ar1"
delay_ms = 60.0
deviation_ms = 20.0
correlation = 0.9
playout_ms = 70.0
[links."c->b"]
model = "sine"
delay_ms = 60.0
amplitude_ms = 30.0
period_s = 0.7
[[timeline]]
at_s = 1.0
link = "a->c"
to = { delay_ms = 90.0, loss = 0.1 }
[[timeline]]
at_s = 4.0
dominance = "c"
to = { a = 0.9, b = 0.1 }
ramp_s = 1.0
[[timeline]]
at_s = 99.0
link = "a->c"
to = { delay_ms = 1.0 }
"""
"""Links of many kinds, two sites that lose a peer for a second, changes, one of them after the end."""

ORDERED = {
    "a": {
        500: Change(
            3.0, link="c->a", to={"model": "uniform", "delay_ms": 30.0, "half_width_ms": 30.0}
        )
    }
}
"""What is ordered while it runs besides: per site and tick."""


class Run(NamedTuple):
    """A run driven by this module: its log, and the counts of each site's links."""

    log: Log
    counts: dict[str, tuple[LinkCounts, ...]]


Sample = tuple[str, int, int]
"""Receiver, index of the peer among its peers, tick of the sample."""


@cache
def busy() -> Run:
    return drive_run(parse_scenario(BUSY))


def drive_run(
    scenario: Scenario, lost: Collection[Sample] = (), twice: Collection[Sample] = ()
) -> Run:
    """Returns a run with those `ORDERED` changes that fit, over a network that loses and
    doubles some samples.
    """
    at: dict[str, dict[int, list[list[int]]]] = {}
    for name in scenario.names:
        at[name] = {}
        rate_hz = scenario.sites[name].rate_hz
        for index, peer in enumerate(scenario.peers(name)):
            for tick in range(scenario.ticks(peer)):
                comes = tick * rate_hz // scenario.sites[peer].rate_hz + 1
                times = 1 - ((name, index, tick) in lost) + ((name, index, tick) in twice)
                at[name].setdefault(comes, []).extend([[index, tick, 0]] * times)
    network = RecordedNetwork(at, {name: scenario.peers(name) for name in scenario.names})
    ordered = {
        site: {tick: [to_core_change(scenario, change)] for tick, change in changes.items()}
        for site, changes in ORDERED.items()
        if site in scenario.sites
    }
    stream = io.BytesIO()
    writer = LogWriter(stream, scenario, scenario.name, "virtual", 0, collect_provenance())
    counts = {}
    for site, arrivals, output in virtual.execute_virtual(scenario, network, ordered):
        payload = encode_state(site.name, 1, site.peers, output, arrivals, 0, 0)
        key = topics.key(scenario.name, site.name, topics.STATE)
        writer.add(key, payload, output.t_ns, output.t_ns, output.tick, output)
        counts[site.name] = site.counts()
    writer.finish({})
    stream.seek(0)
    return Run(open_log(stream), counts)


@cache
def simulated(name: str) -> Log:
    """Returns two seconds of a shipped scenario, or of four sites with different rates."""
    if name == "four":
        return trilat_net.simulate(parse_scenario(FOUR))
    return trilat_net.simulate(name, {"duration_s": 2, "rate_hz": 200})


@cache
def twin(name: str) -> Log:
    return trilat_net.simulate(simulated(name).scenario.without_hands())


@cache
def diverged() -> Log:
    return trilat_net.simulate(
        load_scenario("free", {"duration_s": 2, "rate_hz": 200, "limits.qd_limit_rad_s": 0.5})
    )


def rewritten(
    log: Log,
    keep: Callable[[State], bool] = lambda _: True,
    change: Callable[[State], State] = lambda state: state,
    driver: str = "virtual",
    finished: bool = True,
    others: Sequence[LinkStats | Event] = (),
) -> Log:
    """Returns the log with a selection of its records, changed records, and other messages, in
    a new file.
    """
    stream = io.BytesIO()
    writer = LogWriter(
        stream, log.scenario, "again", driver, 1_700_000_000 * 10**9, collect_provenance()
    )
    for site in log.sites:
        for state in filter(keep, log[site].states):
            payload = encode(change(state))
            writer.add(
                topics.key("again", site, topics.STATE),
                payload,
                state.t_ns,
                0,
                state.tick,
                state,
            )
    for message in others:
        stats = isinstance(message, LinkStats)
        member, channel = (
            (message.site, topics.LINK) if stats else (message.member, topics.EVENT)
        )
        writer.add(topics.key("again", member, channel), encode(message), 0, 0, 0, message)
    writer.flush()
    if finished:
        writer.finish({})
    stream.seek(0)
    return open_log(stream)


def timed(log: Log) -> Log:
    """Returns the log with clock readings: every loop late by its tick in us, every tick 7 us of work."""
    return rewritten(
        log,
        change=lambda state: msgspec.structs.replace(state, late_us=state.tick, busy_us=7),
        driver="live",
    )


def replaced(state: State, **fields: object) -> State:
    plain = {
        key: [float(x) if isinstance(x, np.floating) else x for x in value]
        if isinstance(value, list)
        else value
        for key, value in fields.items()
    }
    return msgspec.structs.replace(state, **plain)


def in_modes(modes: Sequence[str]) -> SiteLog:
    """Returns the first records of a site of `paper`, with other modes."""
    part = simulated("paper")["m1"]
    states = [
        replaced(state, mode=mode) for state, mode in zip(part.states, modes, strict=False)
    ]
    return SiteLog("m1", part.peers, part.rate_hz, [encode(state) for state in states], "again")

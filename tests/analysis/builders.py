"""Builders of the logs that analysis and reports must support, and of analysed runs."""

import io
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, NamedTuple

import msgspec
import numpy as np

import trilat_net
from tests.log.builders import open_bytes, replace_fields, rewrite_log
from tests.scenario.builders import rough_arm_text
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.core.step.ticks import LinkCounts
from trilat_net.execution import virtual
from trilat_net.execution.virtual_network import RecordedNetwork
from trilat_net.log.log_reader import Log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.log.site_log import SiteLog
from trilat_net.net import topics
from trilat_net.net.wire import encode, encode_state
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.scenario.change import Change

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
"""Changes that operators order during the run, by site and tick."""


class DrivenRun(NamedTuple):
    """A run driven by this module: its log, and the counts of each site's links."""

    log: Log
    counts: dict[str, tuple[LinkCounts, ...]]


Sample = tuple[str, int, int]
"""Receiver, index of the peer among its peers, tick of the sample."""


@cache
def make_busy_run() -> DrivenRun:
    """Returns the run of `BUSY` over a network that delivers every sample once."""
    return drive_run(parse_scenario(BUSY))


def drive_run(
    scenario: Scenario, lost: Collection[Sample] = (), twice: Collection[Sample] = ()
) -> DrivenRun:
    """Returns a run with `ORDERED` changes over a network that loses or doubles some samples.

    Args:
        scenario: The scenario. Changes of sites that the scenario lacks are left out.
        lost: Samples that never arrive.
        twice: Samples that arrive twice.
    """
    arrivals_by_site: dict[str, dict[int, list[list[int]]]] = {}
    for name in scenario.names:
        arrivals_by_tick: dict[int, list[list[int]]] = {}
        rate_hz = scenario.sites[name].rate_hz
        for index, peer in enumerate(scenario.peers(name)):
            for tick in range(scenario.ticks(peer)):
                arrival_tick = tick * rate_hz // scenario.sites[peer].rate_hz + 1
                copies = 1 - ((name, index, tick) in lost) + ((name, index, tick) in twice)
                arrivals = arrivals_by_tick.setdefault(arrival_tick, [])
                arrivals.extend([[index, tick, 0]] * copies)
        arrivals_by_site[name] = arrivals_by_tick
    peers = {name: scenario.peers(name) for name in scenario.names}
    network = RecordedNetwork(arrivals_by_site, peers)
    ordered = {
        site: {tick: [scenario.to_core_change(change)] for tick, change in changes.items()}
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
    return DrivenRun(open_bytes(stream.getvalue()), counts)


@cache
def make_short_log(name: str) -> Log:
    """Returns the log of two seconds of a shipped scenario, or of `FOUR`, simulated once per process."""
    if name == "four":
        return trilat_net.simulate(parse_scenario(FOUR))
    return trilat_net.simulate(name, {"duration_s": 2, "rate_hz": 200})


@cache
def make_log_without_hands(name: str) -> Log:
    """Returns the log of `make_short_log` if nobody pushed the arms."""
    return trilat_net.simulate(make_short_log(name).scenario.without_hands())


@cache
def make_diverged_log() -> Log:
    """Returns the log of a run that ends because an arm exceeds its limit of speed."""
    return trilat_net.simulate(
        load_scenario("free", {"duration_s": 2, "rate_hz": 200, "limits.qd_limit_rad_s": 0.5})
    )


@cache
def make_rough_log() -> Log:
    """Returns the log of `rough_arm_text`, simulated once per process."""
    return trilat_net.simulate(parse_scenario(rough_arm_text()))


def make_site_log(modes: Sequence[str]) -> SiteLog:
    """Returns the first records of a site of `paper`, with the given modes."""
    part = make_short_log("paper")["m1"]
    states = [
        replace_fields(state, mode=mode)
        for state, mode in zip(part.states, modes, strict=False)
    ]
    return SiteLog("m1", part.peers, part.rate_hz, [encode(state) for state in states], "again")


ROWS = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.8, "s": 0.2}, "s": {"m1": 0.8, "m2": 0.2}}
LYAPUNOV = {
    **{f"dominance.{i}.{j}": share for i, row in ROWS.items() for j, share in row.items()},
    "sites.m1.control.Kd": 10.0,
    "sites.m2.control.Kd": 3.0,
    "sites.s.control.Kd": 0.3,
    "control.Kp": 0.1,
    "duration_s": 5.0,
    "rate_hz": 500,
}
"""Overrides of `free` with unequal shares and Kd."""

JITTER = {
    "link.model": "uniform",
    "link.delay_ms": 200.0,
    "link.half_width_ms": 50.0,
    "duration_s": 3.0,
}

EXPERT = {
    "dominance.m1.m2": 0.0,
    "dominance.m1.s": 1.0,
    "dominance.s.m1": 1.0,
    "dominance.s.m2": 0.0,
}
"""m1 and s follow each other, and m2 follows both."""

RICH = """
name = "rich"
rate_hz = 500
duration_s = 6.0
[control]
law = "adaptive_box"
theta_hat0 = [0.0, 0.0, 0.0, 1.9, 0.95]
theta_low = [-9.0, -9.0, -9.0, 1.8, 0.9]
theta_high = [9.0, 9.0, 9.0, 2.1, 1.05]
[link]
delay_ms = 100.0
[sites.m1]
role = "master"
q0_rad = [-0.6, 1.8]
[[sites.m1.hands]]
kind = "spring"
to_rad = [-0.2, 1.2]
move_start_s = 0.5
move_end_s = 2.0
stiffness_nm_rad = 60.0
damping_nm_s_rad = 5.0
sampled = true
[sites.m2]
role = "master"
q0_rad = [-0.9, 1.9]
hands = [{ kind = "pulse", start_s = 2.5, end_s = 4.0, peak_nm = [6.0, -3.0] }]
on_stale = { action = "hold", age_ms = 300.0, return_s = 0.5 }
[sites.s]
role = "slave"
q0_rad = [-0.4, 1.6]
limits = { tau_limit_nm = 18.0 }
environment = [
    { kind = "wall", point_m = [1.2, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 300.0 },
    { kind = "viscous", damping_nm_s_rad = 0.5, sampled = true },
]
[dominance]
m1 = { m2 = 0.4, s = 0.6 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.7, m2 = 0.3 }
[links."m1->s"]
model = "uniform"
delay_ms = 100.0
half_width_ms = 60.0
[links."s->m1"]
model = "uniform"
delay_ms = 60.0
half_width_ms = 40.0
loss = 0.3
[links."s->m2"]
delay_ms = 100.0
outages_s = [[1.0, 1.8]]
[[timeline]]
at_s = 1.0
dominance = "s"
to = { m1 = 0.2, m2 = 0.8 }
ramp_s = 1.5
[[timeline]]
at_s = 3.0
dominance = "m1"
to = { m2 = 0.9, s = 0.1 }
"""
"""A scenario with everything that can add energy to V."""

WALL = """
name = "wall"
rate_hz = 500
duration_s = 6.0
[control]
theta_hat0 = [3.0, 1.0, 1.0, 2.0, 1.0]
[link]
delay_ms = 200.0
[sites.m1]
q0_rad = [-0.6, 1.8]
[[sites.m1.hands]]
kind = "tip_spring"
to_m = [1.5, 0.37]
move_start_s = 1.0
move_end_s = 3.0
stiffness_n_m = 100.0
damping_n_s_m = 20.0
[sites.m2]
q0_rad = [-0.6, 1.8]
[sites.s]
role = "slave"
q0_rad = [-0.6, 1.8]
environment = [{ kind = "wall", point_m = [1.24, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 10000.0 }]
[dominance]
m1 = { m2 = 0.5, s = 0.5 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.5, m2 = 0.5 }
"""

TEXTS = {"rich": RICH, "wall": WALL}


class AnalysedRun:
    """A run, and the results computed from the run, each computed once."""

    def __init__(self, name: str, overrides: Mapping[str, Any]) -> None:
        if name in TEXTS:
            scenario = parse_scenario(TEXTS[name], name, overrides)
        else:
            scenario = load_scenario(name, overrides)
        self.log = trilat_net.simulate(scenario)

    @cached_property
    def energies(self) -> dict[str, SiteEnergy]:
        return SiteEnergy.by_site(self.log)

    @cached_property
    def balance(self) -> EnergyBalance:
        return EnergyBalance.of_energies(self.energies)

    @cached_property
    def certificate(self) -> Certificate:
        return Certificate.of_log(self.log)


_runs: dict[str, AnalysedRun] = {}


def make_run(name: str, overrides: Mapping[str, Any] | None = None) -> AnalysedRun:
    """Returns a run of a shipped scenario, or of one in `TEXTS`, simulated once per process."""
    key = json.dumps([name, overrides or {}], sort_keys=True)
    if key not in _runs:
        _runs[key] = AnalysedRun(name, dict(overrides or {}))
    return _runs[key]


def find_relative_residual(balance: EnergyBalance) -> float:
    """Returns the largest residual of a balance as a share of the largest energy."""
    return float(np.abs(balance.residual).max()) / max(balance.scale, 1e-12)


Fields = Mapping[str, Any]

PAIR = """
name = "pair"
rate_hz = 200
duration_s = {seconds}
[control]
law = "p_d"
K = 10.0
d = 2.0
[link]
delay_ms = 50.0
[sites.m]
role = "master"
[sites.s]
role = "slave"
{more}
[dominance]
m = {{ s = 1.0 }}
s = {{ m = 1.0 }}
"""
"""A master and a slave under P+d at 200 Hz, 50 ms apart."""


@cache
def _simulate_pair(seconds: float, more: str) -> Log:
    return trilat_net.simulate(parse_scenario(PAIR.format(seconds=seconds, more=more)))


def make_pair_log(
    motion: Callable[[str, float], Fields], seconds: float = 4.0, more: str = ""
) -> Log:
    """Returns a log of `PAIR` with prescribed records.

    Args:
        motion: Returns the new fields of a record, by site and time in s.
        seconds: Length of the run, in s.
        more: Further TOML lines of the slave.
    """

    def change(state: Any) -> Any:
        return msgspec.structs.replace(state, **motion(state.site, state.t_ns * 1e-9))

    return rewrite_log(_simulate_pair(seconds, more), change=change)

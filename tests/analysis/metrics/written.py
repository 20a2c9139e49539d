"""Logs with prescribed records: written by the real writer, read by the real reader."""

import io
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import msgspec

import trilat_net
from tests.analysis.certificate import runs
from tests.analysis.logs import rewritten
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.wire import encode
from trilat_net.scenario import parse_scenario

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
def _base(seconds: float, more: str) -> Log:
    return trilat_net.simulate(parse_scenario(PAIR.format(seconds=seconds, more=more)))


def pair(motion: Callable[[str, float], Fields], seconds: float = 4.0, more: str = "") -> Log:
    """Writes a log of a pair whose records are given by `motion`, by site and time; `more` is
    for the slave.
    """

    def change(state: Any) -> Any:
        return msgspec.structs.replace(state, **motion(state.site, state.t_ns * 1e-9))

    return rewritten(_base(seconds, more), change=change)


def simulated(name: str, overrides: Mapping[str, Any] | None = None) -> Log:
    """Returns a virtual run of a shipped scenario, made once per test session."""
    return runs.run(name, overrides).log


def replace_scenario(log: Log, overrides: Mapping[str, Any]) -> Log:
    """Returns the records of a log under a different scenario."""
    scenario = parse_scenario(log.scenario_text, "changed", dict(overrides))
    stream = io.BytesIO()
    writer = LogWriter(stream, scenario, scenario.name, "virtual", 0, collect_provenance())
    for site in log.sites:
        key = topics.key(scenario.name, site, topics.STATE)
        for state in log[site].states:
            writer.add(key, encode(state), state.t_ns, state.t_ns, state.tick, state)
    writer.finish({})
    stream.seek(0)
    return open_log(stream)

"""Logs of every kind that a report must stand: few sites, many, nobody's hands, torn, short, late."""

import io
from collections.abc import Callable
from functools import cache

import msgspec

import trilat_net
from trilat_net.log.reader import Log, open_log
from trilat_net.log.writer import LogWriter
from trilat_net.net import topics
from trilat_net.net.wire import State, encode
from trilat_net.scenario import load, parse

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


@cache
def virtual(name: str) -> Log:
    """Two seconds of a shipped scenario, or of four sites with rates of their own."""
    if name == "four":
        return trilat_net.simulate(parse(FOUR))
    return trilat_net.simulate(name, {"duration_s": 2, "rate_hz": 200})


@cache
def twin(name: str) -> Log:
    return trilat_net.simulate(virtual(name).scenario.without_hands())


@cache
def diverged() -> Log:
    return trilat_net.simulate(load("free", {"duration_s": 2, "rate_hz": 200, "limits.qd_limit_rad_s": 0.5}))


def rewritten(
    log: Log,
    keep: Callable[[State], bool] = lambda _: True,
    change: Callable[[State], State] = lambda state: state,
    driver: str = "virtual",
    finished: bool = True,
) -> Log:
    """The log with some of its records, changed, in a file of its own."""
    stream = io.BytesIO()
    writer = LogWriter(stream, log.scenario, "again", driver, 1_700_000_000 * 10**9)
    for site in log.sites:
        for state in filter(keep, log[site].states):
            payload = encode(change(state))
            writer.add_state(
                site, topics.key("again", site, topics.STATE), payload, state.t_ns, 0, state.tick
            )
    writer.flush()
    if finished:
        writer.finish({})
    stream.seek(0)
    return open_log(stream)


def timed(log: Log) -> Log:
    """The log as if a clock had been read: every loop late by its tick in us, every tick 7 us of work."""
    return rewritten(
        log,
        change=lambda state: msgspec.structs.replace(state, late_us=state.tick, busy_us=7),
        driver="live",
    )

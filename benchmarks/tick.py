"""One site tick called from Python, from two payloads that came in to the finished record, and its parts."""

import gc

import numpy as np

from trilat_net.core.kernel import site_tick
from trilat_net.core.site import Site
from trilat_net.core.tick import Arrival, Tick
from trilat_net.net.messages import Sample
from trilat_net.net.wire import decode, encode_state
from trilat_net.scenario import load

from .stopwatch import each_us


def run() -> list[str]:
    scenario = load("paper")
    site = Site(scenario.setup("m1"))
    record = site.step(Tick(0))
    payloads = [encode_state(peer, 7, ("m1", "s"), record, [], 0, 0) for peer in site.peers]
    counter = iter(range(1, 10_000_000))

    def arrivals() -> list[Arrival]:
        samples = [decode(payload, Sample) for payload in payloads]
        return [Arrival(j, s.tick, s.q, s.qd) for j, s in enumerate(samples)]

    came = arrivals()
    output = site.step(Tick(next(counter), came))

    def whole() -> bytes:
        taken = arrivals()
        done = site.step(Tick(next(counter), taken))
        return encode_state("m1", 7, site.peers, done, taken, 0, 0)

    def leaf() -> None:
        site_tick(
            next(counter),
            2,
            site._site,
            site._links,
            site._models,
            site._samples,
            site._calendars,
            site._points,
            site._ramps,
            site._arrivals,
            site._pulses,
            site._row,
        )

    gc.disable()
    total = each_us(whole)
    parts = {
        "decode two payloads": each_us(arrivals),
        "Site.step": each_us(lambda: site.step(Tick(next(counter), came))),
        "  of it the compiled leaf": each_us(leaf),
        "encode the record": each_us(lambda: encode_state("m1", 7, site.peers, output, came, 0, 0)),
    }
    gc.enable()
    p50, p99 = np.percentile(total, (50, 99))
    lines = [f"one site tick, two peers: p50 {p50:.1f} us, p99 {p99:.1f} us (bar: p50 <= 20 us)"]
    for name, times in parts.items():
        median = np.percentile(times, 50)
        lines.append(f"  {name}: {median:.1f} us, {100 * median / p50:.0f} %")
    return lines

"""One site tick called from Python, from two samples that came in to the own one, and its parts."""

import gc

import numpy as np

from trilat_net.core.kernel import site_tick
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import Arrival, TickInput
from trilat_net.net.messages import PeerSample
from trilat_net.net.offset import OffsetEstimator, exact_offset
from trilat_net.net.timing import PeerClock, SiteTiming
from trilat_net.net.wire import decode, encode_sample, encode_state
from trilat_net.scenario import load_scenario

from .stopwatch import each_us

AT_NS = 10_000_000_000
DELAY_NS = 300_000


def run() -> list[str]:
    scenario = load_scenario("paper")
    site = Site(scenario.setup("m1"))
    record = site.step(TickInput(0))
    echo = [(0, 0, AT_NS - DELAY_NS), (1, 0, AT_NS - DELAY_NS)]
    payloads = [encode_sample(p, 7, record, AT_NS - DELAY_NS, echo) for p in site.peers]
    peers = [PeerClock(peer, 0, 0, exact_offset(0), OffsetEstimator()) for peer in site.peers]
    timing = SiteTiming(0, site.rate_hz, peers, "m2")
    timing.sent(0, AT_NS - 2 * DELAY_NS)
    counter = iter(range(1, 10_000_000))

    def decoded() -> list[PeerSample]:
        return [decode(payload, PeerSample, layout=site.layout) for payload in payloads]

    def arrivals(samples: list[PeerSample]) -> list[Arrival]:
        pairs = zip(timing.meters, samples, strict=True)
        delays = [meter.take(sample, AT_NS) for meter, sample in pairs]
        return [Arrival(j, s.tick, s.q, s.qd, delays[j] // 1000) for j, s in enumerate(samples)]

    def stamps() -> None:
        k = next(counter)
        timing.schedule.deadline(k)
        arrivals(samples)
        timing.sent(k, AT_NS)
        timing.echo()
        if k % 100 == 0:
            timing.measured(AT_NS)

    samples = decoded()
    came = arrivals(samples)
    output = site.step(TickInput(next(counter), came))

    def whole() -> bytes:
        k = next(counter)
        timing.schedule.deadline(k)
        taken = arrivals(decoded())
        done = site.step(TickInput(k, taken))
        sent_ns, echoed = timing.sent(k, AT_NS), timing.echo()
        if k % 100 == 0:
            timing.measured(AT_NS)
        return encode_sample("m1", 7, done, sent_ns, echoed)

    def leaf() -> None:
        k = next(counter)
        site_tick(k, 1_000_000 * k, 2, *site._tick_arrays)

    gc.disable()
    total = each_us(whole)
    parts = {
        "decode two payloads": each_us(decoded),
        "stamps: deadline, two delays, sending, echo": each_us(stamps),
        "Site.step": each_us(lambda: site.step(TickInput(next(counter), came))),
        "  of it the compiled leaf": each_us(leaf),
        "encode the sample": each_us(lambda: encode_sample("m1", 7, output, AT_NS, echo)),
        "outside of it, a block at a time: encode the record": each_us(
            lambda: encode_state("m1", 7, site.peers, output, came, 0, 0, AT_NS, echo)
        ),
    }
    gc.enable()
    p50, p99 = np.percentile(total, (50, 99))
    lines = [f"one site tick, two peers: p50 {p50:.1f} us, p99 {p99:.1f} us (bar: p50 <= 20 us)"]
    for name, times in parts.items():
        median = np.percentile(times, 50)
        lines.append(f"  {name}: {median:.1f} us, {100 * median / p50:.0f} %")
    return lines

"""Measures one site tick called from Python, from two arrived samples to the site's own sample, and its parts."""

import gc

import numpy as np

from trilat_net.core.step.kernel import site_tick
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput, TickRecord
from trilat_net.net.messages import PeerSample
from trilat_net.net.offset import OffsetEstimate, OffsetEstimator
from trilat_net.net.timing import PeerClock, SiteTiming
from trilat_net.net.wire import decode, encode_sample, encode_state
from trilat_net.scenario import load_scenario

from .stopwatch import each_us

AT_NS = 10_000_000_000
DELAY_NS = 300_000


class TickParts:
    """A site and the samples that have arrived from its peers, which are stepped again and again."""

    def __init__(self) -> None:
        self.site = site = Site(load_scenario("paper").setup("m1"))
        record = site.step(TickInput(0))
        self.echo = [(0, 0, AT_NS - DELAY_NS), (1, 0, AT_NS - DELAY_NS)]
        self.payloads = [
            encode_sample(p, 7, record, AT_NS - DELAY_NS, self.echo) for p in site.peers
        ]
        peers = [
            PeerClock(peer, 0, 0, OffsetEstimate.exact(0), OffsetEstimator())
            for peer in site.peers
        ]
        self.timing = SiteTiming(0, site.rate_hz, peers, "m2")
        self.timing.record_sent(0, AT_NS - 2 * DELAY_NS)
        self.counter = iter(range(1, 10_000_000))
        self.samples = self.decode()
        self.came = self.take(self.samples)
        self.output = self.step()

    def decode(self) -> list[PeerSample]:
        """Returns the decoded samples of the peers."""
        return [
            decode(payload, PeerSample, layout=self.site.layout) for payload in self.payloads
        ]

    def take(self, samples: list[PeerSample]) -> list[Arrival]:
        """Returns samples as arrivals, the input of the site."""
        pairs = zip(self.timing.monitors, samples, strict=True)
        delays = [meter.receive(sample, AT_NS) for meter, sample in pairs]
        return [Arrival(j, s.tick, s.q, s.qd, delays[j] // 1000) for j, s in enumerate(samples)]

    def stamp(self) -> None:
        """Computes the times that a tick needs."""
        k = next(self.counter)
        self.timing.deadline_ns(k)
        self.take(self.samples)
        self.timing.record_sent(k, AT_NS)
        self.timing.pop_echo()
        if k % 100 == 0:
            self.timing.pop_measurements(AT_NS)

    def step(self) -> TickRecord:
        """Steps the site once more."""
        return self.site.step(TickInput(next(self.counter), self.came))

    def whole(self) -> bytes:
        """Executes a whole tick, up to its encoded sample."""
        k = next(self.counter)
        self.timing.deadline_ns(k)
        taken = self.take(self.decode())
        done = self.site.step(TickInput(k, taken))
        sent_ns, echoed = self.timing.record_sent(k, AT_NS), self.timing.pop_echo()
        if k % 100 == 0:
            self.timing.pop_measurements(AT_NS)
        return encode_sample("m1", 7, done, sent_ns, echoed)

    def leaf(self) -> None:
        """Executes the compiled part of a tick."""
        k = next(self.counter)
        site_tick(k, 1_000_000 * k, 2, *self.site._tick_arrays)


def run() -> list[str]:
    one = TickParts()
    output, came, echo, peers = one.output, one.came, one.echo, one.site.peers
    gc.disable()
    total = each_us(one.whole)
    parts = {
        "decode two payloads": each_us(one.decode),
        "stamps: deadline, two delays, sending, echo": each_us(one.stamp),
        "Site.step": each_us(one.step),
        "  of it the compiled leaf": each_us(one.leaf),
        "encode the sample": each_us(lambda: encode_sample("m1", 7, output, AT_NS, echo)),
        "outside of it, a block at a time: encode the record": each_us(
            lambda: encode_state("m1", 7, peers, output, came, 0, 0, AT_NS, echo)
        ),
    }
    gc.enable()
    p50, p99 = np.percentile(total, (50, 99))
    lines = [
        f"one site tick, two peers: p50 {p50:.1f} us, p99 {p99:.1f} us (bar: p50 <= 20 us)"
    ]
    for name, times in parts.items():
        median = np.percentile(times, 50)
        lines.append(f"  {name}: {median:.1f} us, {100 * median / p50:.0f} %")
    return lines

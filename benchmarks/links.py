"""Measures the cost of a link, from ticks of a site with five peers and of a site with a single peer.

A sample of every peer arrives in each tick. A quarter of the difference is the cost of one link
in one tick: the arrival, the random numbers of the channel, the use of the sample, and its
parts of the reference and the record.
"""

import gc
from collections.abc import Callable
from typing import Any

import numpy as np

from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput
from trilat_net.scenario import load_scenario

from .stopwatch import each_us

ROUNDS, CALLS = 10, 1_000
MORE = 4
MODELS: dict[str, dict[str, Any]] = {
    "none": {"model": "none"},
    "constant": {"delay_ms": 200.0},
    "uniform": {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 100.0},
    "normal": {"model": "normal", "delay_ms": 200.0, "deviation_ms": 30.0},
    "gamma": {"model": "gamma", "delay_ms": 200.0, "deviation_ms": 30.0},
    "lognormal": {"model": "lognormal", "delay_ms": 200.0, "deviation_ms": 30.0},
    "hyperexponential": {"preset": "4g"},
    "ar1": {"model": "ar1", "delay_ms": 200.0, "deviation_ms": 30.0, "correlation": 0.9},
    "sine": {"model": "sine", "delay_ms": 200.0, "amplitude_ms": 100.0, "period_s": 2.0},
    "trace of 20 000 points": {
        "model": "trace",
        "trace": ", ".join(f"{1000 * n} {50_000 + 37 * (n % 101)}" for n in range(20_000)),
        "at_end": "loop",
    },
    "measured": {"model": "measured"},
    "4g, bursts of loss, duplicates, in order, play-out": {
        "preset": "4g",
        "loss": 0.05,
        "loss_burst": 8,
        "duplicate": 0.05,
        "order": "in_order",
        "playout_ms": 100.0,
    },
}


def _step(link: dict[str, Any], peers: int) -> Callable[[], None]:
    """Returns a function that steps a site by a tick in which the newest sample of every peer arrives."""
    names = [f"p{n}" for n in range(peers + 1)]
    share = 1.0 / peers
    scenario = load_scenario(
        "paper",
        {
            "sites": {name: {} for name in names},
            "dominance": {i: {j: share for j in names if j != i} for i in names},
            "expect": {},
            "link": link,
        },
    )
    site = Site(scenario.setup(names[0]))
    site.step(TickInput(0))
    k = 0

    def step() -> None:
        nonlocal k
        k += 1
        site.step(
            TickInput(k, [Arrival(n, k - 1, (0.1, 0.2), (0.0, 0.0)) for n in range(peers)])
        )

    return step


def per_sample_us(link: dict[str, Any]) -> np.ndarray:
    """Returns the additional cost of one more link per sample, in us, for each round."""
    few, many = _step(link, 1), _step(link, 1 + MORE)
    costs = []
    gc.disable()
    for _ in range(ROUNDS):  # side by side, so that a slower machine affects both
        both = [np.median(each_us(step, CALLS)) for step in (few, many)]
        costs.append((both[1] - both[0]) / MORE)
    gc.enable()
    return np.array(costs)


def run() -> list[str]:
    """Returns a line per model of a link."""
    lines = [
        "one more link with one sample per tick, in Site.step from Python (bar: p50 <= 5 us):"
    ]
    for name, link in MODELS.items():
        costs = per_sample_us(link)
        lines.append(
            f"  {name}: p50 {np.median(costs):.2f} us, worst of {ROUNDS} rounds {costs.max():.2f} us"
        )
    return lines

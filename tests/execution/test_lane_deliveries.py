"""Deliveries that are computed in advance are those of a run, for any tick rates and links."""

import random
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.execution.varying_links import LINKS
from trilat_net.core import first_tick_at, tick_ns
from trilat_net.core.lanes.lane_deliveries import (
    BLOCK_TICKS,
    DrawAddresses,
    LinkStates,
    use_samples_of_rates,
)
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario

SITES = ("m1", "m2", "s")


def read_used(run: FusedRun, ends_s: list[float], rates_hz: list[int]) -> list[NDArray[Any]]:
    """The sample in use at each tick of each site, by peer, of a run that is stepped by instants.

    A run ends early if its arms leave their limits, as slow loops may.
    """
    used: list[list[Any]] = [[] for _ in rates_hz]
    for end_s in ends_s:
        ticks = [max(1, round(end_s * rate_hz)) for rate_hz in rates_hz]
        run.plan(ticks)
        while any(len(used[i]) < ticks[i] for i in range(len(ticks))):
            nexts_ns = [
                tick_ns(len(used[i]), rates_hz[i]) if len(used[i]) < ticks[i] else np.inf
                for i in range(len(ticks))
            ]
            instant_ns = min(nexts_ns)
            if run.diverged_s is not None:
                return [np.array(rows) for rows in used]
            run.step_to(int(instant_ns))
            for i, next_ns in enumerate(nexts_ns):
                if next_ns == instant_ns:
                    used[i].append(run.memory.tables.links[i]["used"].copy())
    return [np.array(rows) for rows in used]


def compute_used(
    run: FusedRun, ends_s: list[float], rates_hz: list[int], draws: random.Random
) -> list[NDArray[Any]]:
    """The same, computed in blocks of random durations."""
    states = LinkStates.copy_from([run.memory.tables])
    rates = np.array(rates_hz)
    next_samples = np.zeros((len(SITES), len(SITES) - 1), np.int64)
    room = np.zeros((len(SITES), len(SITES) - 1, 1, BLOCK_TICKS), np.int64)
    first = np.zeros(len(SITES), np.int64)
    used: list[list[Any]] = [[] for _ in rates_hz]
    for end_s in ends_s:
        ticks = np.array([max(1, round(end_s * rate_hz)) for rate_hz in rates_hz])
        while (first < ticks).any():
            instants_ns = [
                tick_ns(int(k), rate_hz)
                for k, last, rate_hz in zip(first, ticks, rates_hz, strict=True)
                if k < last
            ]
            block_ns = draws.randint(1, BLOCK_TICKS * 10**9 // max(rates_hz))
            end_ns = min(instants_ns) + block_ns
            ends = [first_tick_at(end_ns, rate_hz) for rate_hz in rates_hz]
            end = np.clip(ends, first, ticks)
            use_samples_of_rates(
                first,
                end,
                rates,
                next_samples,
                np.array([-1]),
                states,
                DrawAddresses.find(),
                room,
            )
            for i in range(len(SITES)):
                used[i] += room[i, :, 0, : end[i] - first[i]].T.tolist()
            first = end
    return [np.array(rows) for rows in used]


def test_deliveries_between_random_rates_are_exact() -> None:
    """The ticks are exact also if a tick is planned after later ticks of other sites, because durations are rounded."""
    draws = random.Random(1)
    compared = 0
    for _ in range(40):
        rates_hz = [round(10 ** draws.uniform(0.7, 3.2)) for _ in SITES]
        numbers = {
            f"sites.{name}.rate_hz": rate for name, rate in zip(SITES, rates_hz, strict=True)
        }
        cell = load_scenario("free", {**numbers, **draws.choice(LINKS), "duration_s": 0.5})
        ends_s = sorted(draws.uniform(0.0, 0.5) for _ in range(3))
        expected = read_used(FusedRun(cell), ends_s, rates_hz)
        computed = compute_used(FusedRun(cell), ends_s, rates_hz, draws)
        for computed_ticks, other in zip(computed, expected, strict=True):
            assert computed_ticks.tolist()[: len(other)] == other.tolist()
            compared += len(other)
    assert compared > 5000

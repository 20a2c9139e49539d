"""Runs over a network that scatters samples: early, late, out of order, twice, or never."""

import itertools
from collections.abc import Collection, Mapping

from hypothesis import strategies as st

from tests.log.builders import simulate_bytes
from trilat_net.execution.virtual_network import RecordedNetwork
from trilat_net.scenario import load_scenario

TICKS = 120
SITES = ("m1", "m2", "s")
SCENARIO = load_scenario("free", {"duration_s": 0.12, "link.delay_ms": 20.0})
PEERS = {name: SCENARIO.peers(name) for name in SCENARIO.names}
DUE = 20  # ticks after its stamp


Sample = tuple[str, int, int]
"""Receiver, index of the peer among its peers, tick of the sample."""

samples = st.tuples(st.sampled_from(SITES), st.integers(0, 1), st.integers(0, 110))
under_way = st.dictionaries(samples, st.integers(1, 40), max_size=60)
never = st.frozensets(samples, max_size=40)
site_sets = st.sets(st.sampled_from(SITES), min_size=1).map(sorted)


def draw_gaps(
    size: int, least: int = 1, most: int = 3
) -> st.SearchStrategy[dict[str, set[int]]]:
    """Draws ticks without a record, of some sites; the last tick has a record."""
    lost = st.sets(st.integers(0, TICKS - 2), min_size=1, max_size=size)
    return st.dictionaries(st.sampled_from(SITES), lost, min_size=least, max_size=most)


def first_in_first_out(delays: Mapping[Sample, int]) -> dict[Sample, int]:
    """Returns delays, in ticks, with which each sample waits for the earlier samples of its link."""
    held: dict[Sample, int] = {}
    for receiver in SCENARIO.names:
        for peer in (0, 1):
            arrives = 0
            for tick in range(TICKS):
                arrives = max(arrives, tick + delays.get((receiver, peer, tick), 1))
                held[receiver, peer, tick] = arrives - tick
    return held


def make_delivered_bytes(delays: Mapping[Sample, int], lost: Collection[Sample] = ()) -> bytes:
    """Returns a log of a run whose samples take the given numbers of ticks, one by default, or are lost."""
    at: dict[str, dict[int, list[list[int]]]] = {name: {} for name in SCENARIO.names}
    for receiver, peer, tick in itertools.product(SCENARIO.names, (0, 1), range(TICKS)):
        if (receiver, peer, tick) not in lost:
            arrives = tick + delays.get((receiver, peer, tick), 1)
            at[receiver].setdefault(arrives, []).append([peer, tick, 0])
    return simulate_bytes(SCENARIO, RecordedNetwork(at, PEERS))

"""Runs over a network that scatters samples: early, late, out of order, twice, or never."""

import io
from collections.abc import Collection, Mapping

from trilat_net.execution import virtual
from trilat_net.execution.virtual_network import RecordedNetwork
from trilat_net.scenario import load_scenario

SCENARIO = load_scenario("free", {"duration_s": 0.12, "link.delay_ms": 20.0})
PEERS = {name: SCENARIO.peers(name) for name in SCENARIO.names}
DUE = 20  # ticks after its stamp


Sample = tuple[str, int, int]
"""Receiver, index of the peer among its peers, tick of the sample."""


def first_in_first_out(delays: Mapping[Sample, int]) -> dict[Sample, int]:
    """Holds each sample back until those of the same link before it have come."""
    held: dict[Sample, int] = {}
    for receiver in SCENARIO.names:
        for peer in (0, 1):
            arrives = 0
            for tick in range(120):
                arrives = max(arrives, tick + delays.get((receiver, peer, tick), 1))
                held[receiver, peer, tick] = arrives - tick
    return held


def delivered(delays: Mapping[Sample, int], lost: Collection[Sample] = ()) -> bytes:
    """A log of a run in which some samples were under way for other than one tick.

    Args:
        delays: sample -> ticks under way.
        lost: samples that never arrive.
    """
    at: dict[str, dict[int, list[list[int]]]] = {name: {} for name in SCENARIO.names}
    for receiver in SCENARIO.names:
        for peer in (0, 1):
            for tick in range(120):
                if (receiver, peer, tick) in lost:
                    continue
                arrives = tick + delays.get((receiver, peer, tick), 1)
                at[receiver].setdefault(arrives, []).append([peer, tick, 0])
    stream = io.BytesIO()
    virtual.write_virtual_log(SCENARIO, stream, RecordedNetwork(at, PEERS))
    return stream.getvalue()

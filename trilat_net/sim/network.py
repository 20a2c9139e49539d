"""Simulated networks: when a sample arrives, in virtual time.

Law (L2): delay is the link's business. A network only decides at which tick of the receiver a sample
arrives; as long as that is before the sample is due, the numbers do not depend on it.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from ..core.grid import NS_PER_S
from ..core.tick import Arrival, Output


class Network(Protocol):
    """Joins the sites of a virtual run."""

    def send(self, sender: str, output: Output) -> None:
        """Takes the record of one tick from its sender."""

    def ready(self, receiver: str, k: int) -> bool:
        """True where everything that arrives for tick k of a receiver has been sent."""

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """Returns what arrives for tick k of a receiver, in order."""


class PromptNetwork:
    """Every sample is there at the first tick of the receiver after its stamp.

    Args:
        rates: tick rate of every site, Hz, in scenario order.
    """

    def __init__(self, rates: Mapping[str, int]) -> None:
        self._rates = rates
        self._under_way: dict[str, list[deque[Output]]] = {
            i: [deque() for j in rates if j != i] for i in rates
        }
        self._outgoing = {
            j: [self._under_way[i][[p for p in rates if p != i].index(j)] for i in rates if i != j]
            for j in rates
        }

    def send(self, sender: str, output: Output) -> None:
        """See `Network`."""
        for queue in self._outgoing[sender]:
            queue.append(output)

    def ready(self, receiver: str, k: int) -> bool:  # noqa: ARG002 - see `Network`
        """See `Network`. In order of time, always."""
        return True

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """See `Network`."""
        now_ns = k * NS_PER_S // self._rates[receiver]
        arrivals = []
        for index, queue in enumerate(self._under_way[receiver]):
            while queue and queue[0].t_ns < now_ns:
                sample = queue.popleft()
                latency_us = (now_ns - sample.t_ns) // 1000
                arrivals.append(Arrival(index, sample.tick, sample.q, sample.qd, latency_us, sample.tau_x))
        return arrivals


class RecordedNetwork:
    """Samples arrive when a log says that they did; what they carry comes from the running sites.

    Args:
        schedule: per receiver and tick the arrivals: (index of the peer, tick, latency us), in order.
        peers: per receiver its peers in scenario order.
    """

    def __init__(
        self,
        schedule: Mapping[str, Mapping[int, Sequence[Sequence[int]]]],
        peers: Mapping[str, Sequence[str]],
    ) -> None:
        self._schedule = schedule
        self._peers = peers
        self._sent: dict[tuple[str, int], Output] = {}

    def send(self, sender: str, output: Output) -> None:
        """See `Network`."""
        self._sent[sender, output.tick] = output

    def ready(self, receiver: str, k: int) -> bool:
        """See `Network`. A loop that was late took in samples of ticks that lie ahead of its own."""
        peers = self._peers[receiver]
        return all((peers[index], tick) in self._sent for index, tick, _ in self._listed(receiver, k))

    def _listed(self, receiver: str, k: int) -> Sequence[Sequence[int]]:
        return self._schedule[receiver].get(k, ())

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """See `Network`. A sample that was never sent (the log names none of its sender's) stays away."""
        arrivals = []
        for index, tick, latency_us in self._listed(receiver, k):
            sample = self._sent.get((self._peers[receiver][index], tick))
            if sample is not None:
                arrivals.append(Arrival(index, tick, sample.q, sample.qd, latency_us, sample.tau_x))
        return arrivals

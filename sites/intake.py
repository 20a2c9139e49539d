"""What comes in from the peers, between two ticks.

Law: nothing that arrives can raise out of the loop. A payload is a peer's sample, or it is counted by
reason and dropped.

Samples carry the instants of their arrival, stamped as they came and not as they are drained.
"""

from collections import Counter
from collections.abc import Sequence

from trilat_net.core.grid import NS_PER_S
from trilat_net.core.link import AHEAD_LIMIT_NS
from trilat_net.core.tick import MAX_ARRIVALS, Arrival
from trilat_net.errors import WireError
from trilat_net.net.bus import StampedInbox
from trilat_net.net.messages import Sample
from trilat_net.net.meter import Meter
from trilat_net.net.wire import decode


class Intake:
    """The rings of a site's peers.

    Args:
        peers: names of the peers, in scenario order.
        rings: their rings.
        rates: their tick rates, Hz.
        dropped: where what is dropped is counted, by reason.
    """

    def __init__(
        self, peers: Sequence[str], rings: Sequence[StampedInbox], rates: Sequence[int], dropped: Counter[str]
    ) -> None:
        self._peers, self._rings, self._rates = peers, rings, rates
        self._dropped = dropped
        self._boots: list[int] = []
        self._meters: list[Meter] = []
        self._last = [-1] * len(peers)

    def admit(self, boots: Sequence[int], meters: Sequence[Meter]) -> None:
        """Says which start of each peer belongs to the session, and what measures its link.

        Messages of other starts are dropped.
        """
        self._boots, self._meters = list(boots), list(meters)

    def drain(self, since_epoch_ns: int) -> list[Arrival]:
        """Returns what has come, peer by peer, each in its order; at most MAX_ARRIVALS, the rest waits.

        Args:
            since_epoch_ns: nominal time since the epoch, ns.
        """
        arrivals: list[Arrival] = []
        for index, ring in enumerate(self._rings):
            while len(arrivals) < MAX_ARRIVALS and (message := ring.poll()) is not None:
                arrival = self._arrival(index, *message, since_epoch_ns)
                if arrival is not None:
                    arrivals.append(arrival)
        return arrivals

    def _arrival(self, index: int, payload: bytes, arrived_ns: int, since_epoch_ns: int) -> Arrival | None:
        try:
            sample = decode(payload, Sample)
        except WireError as error:
            self._dropped[error.reason] += 1
            return None
        if sample.site != self._peers[index] or sample.boot != self._boots[index]:
            self._dropped["stranger"] += 1
            return None
        stamp_ns = sample.tick * NS_PER_S // self._rates[index]
        if stamp_ns - since_epoch_ns > AHEAD_LIMIT_NS:
            self._dropped["ahead"] += 1
            return None
        if sample.tick > self._last[index] + 1:  # dropped on the way, or the ring overflowed
            self._dropped["missing"] += sample.tick - self._last[index] - 1
        self._last[index] = max(self._last[index], sample.tick)
        delay_ns = self._meters[index].take(sample, arrived_ns)
        return Arrival(index, sample.tick, sample.q, sample.qd, delay_ns // 1000, sample.tau_x)

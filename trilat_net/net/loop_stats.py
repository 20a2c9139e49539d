"""Loop statistics of a site, ten times a second: ticks, lateness, computing time and link counters."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from ..core.site_step import Site
from ..core.ticks import NS_PER_S, TickRecord
from .messages import VERSION, LinkStats
from .topics import ticks_per_stats

_LINK_COUNTS = ("accepted", "late", "duplicate", "refused", "lost", "superseded", "copies")


class LoopStats:
    """Counters of a loop, since the last statistics and since the start; `rates` are those of the peers, Hz.

    Attributes:
        overruns: ticks whose work began after the next one was due, or that were not made.
    """

    def __init__(self, site: Site, boot: int, rates: list[int]) -> None:
        self._site, self._boot, self._rates = site, boot, rates
        self._every = ticks_per_stats(site.rate_hz)
        self._period_us = 1_000_000 / site.rate_hz
        self._late_max_us = self._busy_max_us = 0
        self.dropped: Counter[str] = Counter()
        self.overruns = 0

    def tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Counts one tick: its lateness, the computing time of the one before, and how many were not made."""
        self.overruns += skipped
        if late_us > self._late_max_us:
            self._late_max_us = late_us
        if busy_us > self._busy_max_us:
            self._busy_max_us = busy_us
        self.overruns += late_us >= self._period_us

    def due(self, k: int, skipped: int = 0) -> bool:
        """True at the ticks after which statistics are published; one stands for the skipped ones before."""
        return k % self._every <= skipped

    def take(self, output: TickRecord, measured: Mapping[str, Any] | None = None) -> LinkStats:
        """Returns the statistics as of a record's tick, with the timing fields that were measured if any.

        The largest values begin anew.
        """
        peers = self._site.peers
        counts = dict(zip(peers, self._site.counts(), strict=True))
        age_us = {
            peer: (output.t_ns - used * NS_PER_S // rate_hz) // 1000 if used >= 0 else -1
            for peer, used, rate_hz in zip(peers, output.used, self._rates, strict=True)
        }
        by_peer: dict[str, Any] = {
            field: {peer: getattr(count, field) for peer, count in counts.items()} for field in _LINK_COUNTS
        }
        stats = LinkStats(
            v=VERSION,
            site=self._site.name,
            boot=self._boot,
            tick=output.tick,
            t_ns=output.t_ns,
            mode=output.mode.name.lower(),
            age_us=age_us,
            **by_peer,
            dropped=dict(self.dropped),
            late_max_us=self._late_max_us,
            busy_max_us=self._busy_max_us,
            overruns=self.overruns,
            **(measured or {}),
        )
        self._late_max_us = self._busy_max_us = 0
        return stats

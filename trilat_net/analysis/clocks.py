"""What a session found out about its members' clocks, per directed link.

Law: what was estimated while it ran is told as it stood in force then, never improved afterwards.
"""

from typing import NamedTuple

import numpy as np

from ..log.reader import Log


class ClockUse(NamedTuple):
    """The clock of a link's sender against the receiver's.

    Attributes:
        offset_us: the sender's clock minus the receiver's, by the last statistics, us.
        offset_first_us: the same by the first ones.
        drift_ppm: by how much it grows, us/s, by the last estimate; None where none was made.
        drift_bound_ppm: how far that is from the truth at most.
        bound_us: how far the offset in force was from the truth at most, by the last statistics, us.
        bound_p50_us: the median of that.
        bound_max_us: its largest.
        rtt_min_us: smallest round trip; None where none was made.
        faults: samples that came before they were sent by more than the bound: a clock has stepped.
    """

    offset_us: int
    offset_first_us: int
    drift_ppm: float | None
    drift_bound_ppm: float | None
    bound_us: int
    bound_p50_us: float
    bound_max_us: int
    rtt_min_us: int | None
    faults: int

    @property
    def shared(self) -> bool:
        """True where both ends read one and the same clock."""
        return self.bound_max_us == 0 and self.offset_us == 0


def clock_use(log: Log, peer: str, site: str) -> ClockUse | None:
    """Returns what a site knew of a peer's clock; None where nothing was measured, as in virtual time."""
    stats = [stats for stats in log.link_stats(site) if peer in stats.offset_us]
    if not stats:
        return None
    bounds = [each.bound_us.get(peer, 0) for each in stats]
    trips = [trip for each in stats if (trip := each.rtt_us.get(peer, -1)) >= 0]
    said = [e for e in log.events if (e.kind, e.member, e.about) == ("clock", site, peer)]
    return ClockUse(
        offset_us=stats[-1].offset_us[peer],
        offset_first_us=stats[0].offset_us[peer],
        drift_ppm=said[-1].drift_ppb / 1e3 if said else None,
        drift_bound_ppm=said[-1].drift_bound_ppb / 1e3 if said else None,
        bound_us=bounds[-1],
        bound_p50_us=float(np.median(bounds)),
        bound_max_us=max(bounds),
        rtt_min_us=min(trips, default=None),
        faults=stats[-1].clock_faults.get(peer, 0),
    )

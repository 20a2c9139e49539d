"""How well the sites follow: each its reference, all of them each other, and every slave its masters.

Law: e is Eq. (9) and looks back over the delay; the spread does not, and compares one instant; what a slave
makes of a master is compared with the master as it was when its sample in use was taken.
"""

import math
from collections.abc import Mapping

import numpy as np

from ..analysis import quantities
from ..certificate.track import Bools, Track
from ..core.arm import Array
from ..log.reader import Ints, Log
from .rows import END_S, at_end
from .said import Facts, Said, peak, rms, said, unsaid

SITE = ("settle_s", "rms_error_rad", "max_error_rad", "max_error_end_rad")
RUN = ("spread_rms_rad", "spread_max_rad", "spread_end_rad")
LINK = ("following_rms_rad", "following_max_rad", "following_end_rad")


def of_site(log: Log, site: str) -> Facts:
    """Returns settling, RMS and peak of a site's e."""
    part = log[site]
    if not len(part):
        return unsaid(SITE, f"no records of {site}")
    errors, settle_s = quantities.errors(part), quantities.settle_s(part)
    still = f"|e| exceeds {quantities.SETTLED_RAD:g} rad in the last record"
    return {
        "settle_s": Said(None, still) if settle_s is None else said(settle_s),
        "rms_error_rad": said(rms(errors)),
        "max_error_rad": said(peak(errors)),
        "max_error_end_rad": said(peak(errors[part.t_s > part.t_s[-1] - END_S])),
    }


def of_run(log: Log, found: Mapping[str, Track]) -> Facts:
    """Returns the undelayed spread: the largest difference between sites' angles of a joint at an instant.

    Instants are the ticks of the first site of which every other site has its own latest tick recorded.
    """
    absent = [site for site in log.sites if site not in found]
    if absent:
        return unsaid(RUN, f"no records of {', '.join(absent)}")
    first = found[log.sites[0]]
    known, poses = first.known.copy(), []
    for track in found.values():
        row, there = latest(track, first.t_s)
        known &= there
        poses.append(track.q[row])
    if not known.any():
        return unsaid(RUN, "no instant of which every site has a record")
    q: Array = np.stack(poses)[:, known]
    spread = q.max(axis=0) - q.min(axis=0)
    end_s = min(float(track.t_s[-1]) for track in found.values())
    last = spread[first.t_s[known] > end_s - END_S]
    return {
        "spread_rms_rad": said(rms(spread)),
        "spread_max_rad": said(peak(spread)),
        "spread_end_rad": said(peak(last), "no instant of the last second of which every site has a record"),
    }


def latest(track: Track, t_s: Array) -> tuple[Ints, Bools]:
    """Returns the rows of a site's latest ticks at some times, and whether these are recorded, shape (K,)."""
    row = np.floor(t_s * track.rate_hz + 1e-6).astype(np.int64) - track.first
    inside = (row >= 0) & (row < len(track.known))
    row = np.clip(row, 0, len(track.known) - 1)
    there: Bools = inside & track.known[row]
    return row, there


def of_link(log: Log, found: Mapping[str, Track], peer: str, site: str) -> Facts:
    """Returns q_m(t - T) - q_s of a master's link to a slave, T being the effective delay of the tick.

    At every tick t_k of the slave from its first sample of that master on: the master's angles in the record
    whose sample the slave has in use, less the slave's own.
    """
    roles = [log.scenario.sites[name].role for name in (peer, site)]
    if roles != ["master", "slave"]:
        return unsaid(LINK, "no link of a master to a slave", applies=False)
    absent = [name for name in (peer, site) if name not in found]
    if absent:
        return unsaid(LINK, f"no records of {', '.join(absent)}")
    master, slave = found[peer], found[site]
    used = slave.used[peer]
    row = used - master.first
    inside = (used >= 0) & (row >= 0) & (row < len(master.known))
    row = np.clip(row, 0, len(master.known) - 1)
    known = slave.known & inside & master.known[row]
    if not known.any():
        return unsaid(LINK, f"no record of {site} uses a recorded sample of {peer}")
    off = master.q[row] - slave.q
    last = at_end(slave, float(slave.t_s[-1]))[known]
    off = off[known]
    end = peak(off[last]) if last.any() else math.nan
    return {
        "following_rms_rad": said(rms(off)),
        "following_max_rad": said(peak(off)),
        "following_end_rad": said(end, "no sample in the last second"),
    }

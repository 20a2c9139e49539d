"""Which samples of a peer a site uses at its ticks, drawn as a run draws them.

Invariant: the draws are those of the link's key, so that what is said before a run holds in the run.
"""

from functools import lru_cache

import numpy as np

from ..core.site_setup import Gains, Law, LinkSetup, Scheme, SiteSetup
from ..core.site_step import Site
from ..core.ticks import NS_PER_S
from ..core.two_link_arm import PARAMETERS
from ..core.vectors import IntArray
from .delay_models import LinkBase


@lru_cache(maxsize=256)
def draw_uses(link: LinkBase, key: int, own_hz: int, peer_hz: int, duration_s: float) -> IntArray:
    """Returns the sample in use at every tick of a site with nothing but this link, -1 before the first."""
    receiver = Site(
        SiteSetup(
            name="receiver",
            rate_hz=own_hz,
            scheme=Scheme.DIGITAL,
            gains=Gains(Law.KNOWN),
            theta=np.ones(PARAMETERS),
            g_m_s2=0.0,
            lengths_m=(1.0, 1.0),
            tau_limit_nm=1.0,
            qd_limit_rad_s=1.0,
            q0=(0.0, 0.0),
            qd0=(0.0, 0.0),
            actors=(),
            links=(LinkSetup("peer", 1.0, peer_hz, (0.0, 0.0), key, (link.core(),), (link.points,)),),
        )
    )
    ticks = max(2, round(duration_s * own_hz))
    newest = np.full(ticks, -1, dtype=np.int64)
    for sample in range(round(duration_s * peer_hz)):
        release = receiver.release_tick(0, sample)
        if release is not None and release < ticks:
            newest[release] = max(newest[release], sample)
    used: IntArray = np.maximum.accumulate(newest)
    used.flags.writeable = False
    return used


def count_silences(used: IntArray, own_hz: int, silence_ns: int) -> int:
    """Returns how often none came into use for longer than `silence_ns`, after the first."""
    came = np.flatnonzero(np.diff(used, prepend=-1) > 0)
    gaps_ns = np.diff(came, append=len(used)) * NS_PER_S // own_hz
    return int(np.count_nonzero(gaps_ns - NS_PER_S // own_hz > silence_ns)) if len(came) else 0

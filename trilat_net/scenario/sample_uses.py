"""Which samples of a peer a site uses, and which its user is shown, at its ticks, drawn as a run draws them.

Invariant: the draws are those of the link's key, so that what is said before a run holds in the run. What a
user is shown is a function of scenario, seed and ticks: a log tells it without being told.
"""

import heapq
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from ..core.philox import link_key
from ..core.site_setup import Gains, Law, LinkSetup, Scheme, SiteSetup
from ..core.site_step import Site
from ..core.ticks import NS_PER_S
from ..core.two_link_arm import PARAMETERS
from ..core.vectors import IntArray
from .delay_models import MAX_DELAY_MS, LinkBase
from .scenario_types import Scenario


def _build_link(link: LinkBase, key: int, peer_hz: int) -> LinkSetup:
    return LinkSetup("peer", 1.0, peer_hz, (0.0, 0.0), key, (link.core(),), (link.points,))


def _build_receiver(own_hz: int, links: Sequence[LinkSetup]) -> Site:
    """Returns a site with nothing but some links."""
    return Site(
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
            links=tuple(links),
        )
    )


@lru_cache(maxsize=256)
def draw_uses(link: LinkBase, key: int, own_hz: int, peer_hz: int, duration_s: float) -> IntArray:
    """Returns the sample in use at every tick of a site with nothing but this link, -1 before the first."""
    receiver = _build_receiver(own_hz, [_build_link(link, key, peer_hz)])
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


_REACH_S = 1.1 * MAX_DELAY_MS / 1e3
"""What is older than this has been shown or never is, s: whoever begins late need not look at it."""


class PictureDelay:
    """Which tick of each peer a site's user is shown: `[sites.NAME.view]`, a link beside the haptic one.

    A peer's sample is shown from the site's first tick at or after its arrival over that link (L2), drawn by
    a key of its own (L4), until a newer one is.
    """

    def __init__(self, scenario: Scenario, site: str, view: LinkBase) -> None:
        self._own_hz = scenario.sites[site].rate_hz
        self._peers = {name: scenario.sites[name].rate_hz for name in scenario.peers(site)}
        outages = tuple((round(start_s * 1e9), round(end_s * 1e9)) for start_s, end_s in view.outages_s)
        links = [
            _build_link(view, link_key(scenario.seed, f"view {peer}->{site}"), hz)._replace(outages=outages)
            for peer, hz in self._peers.items()
        ]
        self._receiver = _build_receiver(self._own_hz, links)
        self._drawn = [0] * len(links)
        self._shown = [-1] * len(links)
        self._waiting: list[list[tuple[int, int]]] = [[] for _ in links]

    def at(self, tick: int) -> dict[str, int]:
        """Returns the peers' ticks that are shown at a tick of the site, -1 before the first.

        Args:
            tick: never before that of the last call.
        """
        now_ns = tick * NS_PER_S // self._own_hz
        for n, (rate_hz, waiting) in enumerate(zip(self._peers.values(), self._waiting, strict=True)):
            end = -(-now_ns * rate_hz // NS_PER_S)  # those stamped before now: none is shown at its own stamp
            for sample in range(max(self._drawn[n], end - round(_REACH_S * rate_hz)), end):
                if (release := self._receiver.release_tick(n, sample)) is not None:
                    heapq.heappush(waiting, (release, sample))
            self._drawn[n] = max(self._drawn[n], end)
            while waiting and waiting[0][0] <= tick:
                self._shown[n] = max(self._shown[n], heapq.heappop(waiting)[1])
        return dict(zip(self._peers, self._shown, strict=True))


def find_picture_delay(scenario: Scenario, site: str) -> PictureDelay | None:
    """Returns the delay of the picture of a site's user; None where that is of the samples in use."""
    view = scenario.sites[site].view
    return None if view is None else PictureDelay(scenario, site, view)

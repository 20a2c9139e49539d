"""The effective delay of a link: the age of its samples at the ticks that use them.

Invariant (L2): a sample of tick m is in use from the receiver's first tick at or after its due time, and
never at its own stamp. With a constant delay and equal rates the age is max(1, ceil(T / h)) ticks; in all
other cases it is averaged over the same random draws as a run makes.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..core.delay import DelayKind
from ..core.philox import link_key
from ..core.site_setup import Gains, Law, LinkSetup, Scheme, SiteSetup
from ..core.site_step import Site
from ..core.ticks import NS_PER_S
from ..core.two_link_arm import PARAMETERS
from ..errors import ScenarioError
from ..scenario import Scenario
from ..scenario.delay_models import LinkBase


class EffectiveDelay(NamedTuple):
    """Age of the samples in use over the receiver's ticks: mean, least and largest, s."""

    mean_s: float
    least_s: float
    most_s: float


def compute_effective_delay(scenario: Scenario, peer: str, site: str, link: LinkBase) -> EffectiveDelay:
    """Returns the age of a peer's samples at the ticks of a site that use them.

    Raises:
        ScenarioError: no sample ever arrives.
    """
    own_hz, peer_hz = scenario.sites[site].rate_hz, scenario.sites[peer].rate_hz
    model = link.core()
    constant = model.kind == DelayKind.CONSTANT and not link.loss
    if constant and own_hz == peer_hz:
        delay_us = max(round(model.location), model.playout_us)
        age_s = max(1, -(-delay_us * own_hz // 1_000_000)) / own_hz
        return EffectiveDelay(age_s, age_s, age_s)
    duration_s = min(scenario.duration_s, 2.0 + 2e-6 * model.location) if constant else scenario.duration_s
    age = _count_ages(link, link_key(scenario.seed, f"{peer}->{site}"), own_hz, peer_hz, duration_s)
    if age is None:
        raise ScenarioError("no sample of it ever comes", path=f"links.{peer}->{site}", source=scenario.name)
    return age


@lru_cache(maxsize=256)
def _count_ages(
    link: LinkBase, key: int, own_hz: int, peer_hz: int, duration_s: float
) -> EffectiveDelay | None:
    """Returns the ages from the first sample in use on, counted at a site with nothing but this link."""
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
    used = np.maximum.accumulate(newest)
    if used[-1] < 0:
        return None
    first = int(np.argmax(used >= 0))
    now_ns = np.arange(first, ticks) * NS_PER_S // own_hz
    ages_s = (now_ns - used[first:] * NS_PER_S // peer_hz) * 1e-9
    return EffectiveDelay(float(ages_s.mean()), float(ages_s.min()), float(ages_s.max()))

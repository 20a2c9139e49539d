"""What the stability of a control law rests on, at a site of a scenario.

Invariant: a law states its condition once, as a method of its type; `trilat scenario check` and
`trilat linear` print what it returns. It says if the condition is only sufficient, and who proved it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..core.delay import DelayKind
from ..core.vectors import Array
from .delay_models import LinkBase


class LawSituation(NamedTuple):
    """What a law's condition may be made of.

    Attributes:
        site: the index of the site.
        names: of the sites.
        laws: the control of each site.
        alpha: dominance matrix, shape (N, N).
        delay_s: delay of the link from j to i, row i, column j, at least one tick, s; NaN if it varies.
        tau_limit_nm: largest torques of the site's joints, N m.
        rate_hz: tick rate of the site, Hz.
    """

    site: int
    names: tuple[str, ...]
    laws: tuple[Any, ...]
    alpha: Array
    delay_s: Array
    tau_limit_nm: tuple[float, ...]
    rate_hz: int

    @property
    def longest_s(self) -> float:
        """The longest delay of links with a dominance factor, s; NaN if one of them varies."""
        return float(np.max(self.delay_s[self.alpha > 0.0], initial=0.0))


class StabilityCondition(NamedTuple):
    """A law's condition at a site.

    Attributes:
        holds: None if it cannot be said.
        text: the condition with its numbers, what it rests on, and if it is sufficient or sharp.
    """

    holds: bool | None
    text: str


def find_link_delays(links: Mapping[str, LinkBase], rates_hz: Mapping[str, int]) -> Array:
    """Returns the delay of every link as in `LawSituation.delay_s`."""
    names = list(rates_hz)
    delay_s = np.zeros((len(names), len(names)))
    for name, link in links.items():
        peer, _, site = name.partition("->")
        model, rate_hz = link.core(), rates_hz[site]
        constant = model.kind == DelayKind.CONSTANT and not link.loss and not link.measured
        delay_us = max(round(model.location), model.playout_us)
        ticks = max(1, -(-delay_us * rate_hz // 1_000_000))
        delay_s[names.index(site), names.index(peer)] = ticks / rate_hz if constant else np.nan
    return delay_s

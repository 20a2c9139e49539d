"""A satellite network in low orbit, which assigns paths anew in slots of time."""

import math
from typing import Annotated, Any

from msgspec import Meta

from ...core.delay import draw_pair
from ..delay_models import Milliseconds, OwnDelay


class LowOrbit(OwnDelay, frozen=True, kw_only=True, tag="low_orbit"):
    """A floor, an exponential part per slot of time, and an exponential part per sample.

    Low-orbit networks assign terminals to satellites anew every 15 s, all at once, and delay
    and jitter step at these times: Mohan et al., "A Multifaceted Look at Starlink Performance",
    WWW (2024).

    Attributes:
        floor_ms: least delay, ms.
        path_ms: mean of the part that is drawn for the path of a slot, ms.
        jitter_ms: mean of the part that is drawn for a sample, ms.
        slot_s: duration of a slot, s.
    """

    floor_ms: Milliseconds = 20.0
    path_ms: Milliseconds = 8.0
    jitter_ms: Milliseconds = 3.0
    slot_s: Annotated[float, Meta(gt=0.0, le=1e4)] = 15.0

    def draw(self, now: Any) -> None:
        """Writes the delay of a sample, us."""
        slot = now.stamp_ns // int(1e9 * self.slot_s)
        _, path_share = draw_pair(now, slot, 0)
        _, sample_share = draw_pair(now, now.sample, 1)
        # The logarithm of a uniform number is a negative exponential draw.
        now.drawn_us = 1e3 * (
            self.floor_ms
            - self.path_ms * math.log(path_share)
            - self.jitter_ms * math.log(sample_share)
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the moments over many slots: those of a sum of independent parts."""
        mean_ms = self.floor_ms + self.path_ms + self.jitter_ms
        return mean_ms, math.hypot(self.path_ms, self.jitter_ms)

    def _reach_ms(self) -> float:
        """Returns the delay for the largest draws of both parts, -log 2^-53 = 36.8, ms."""
        return self.floor_ms + 36.8 * (self.path_ms + self.jitter_ms)

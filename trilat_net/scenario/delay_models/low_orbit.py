"""A satellite network whose paths are assigned anew in slots of time."""

import math
from typing import Annotated, Any

from msgspec import Meta

from ...core.delay import draw_pair
from ..delay_models import Milliseconds, OwnDelay


class LowOrbit(OwnDelay, frozen=True, kw_only=True, tag="low_orbit"):
    """A floor, a part that is drawn for each slot of time, and one for each sample, both
    exponential.

    Low-orbit networks assign terminals to satellites anew every 15 s, all at once, and delay
    and jitter step
    then: Mohan et al., "A Multifaceted Look at Starlink Performance", WWW (2024).

    Attributes:
        floor_ms: least delay, ms.
        path_ms: mean of the part of a slot's path, ms.
        jitter_ms: mean of the part of a sample, ms.
        slot_s: how long a path stays, s.
    """

    floor_ms: Milliseconds = 20.0
    path_ms: Milliseconds = 8.0
    jitter_ms: Milliseconds = 3.0
    slot_s: Annotated[float, Meta(gt=0.0, le=1e4)] = 15.0

    def draw(self, now: Any) -> None:
        """Writes the delay, us."""
        _, path = draw_pair(now, now.stamp_ns // int(1e9 * self.slot_s), 0)
        _, own = draw_pair(now, now.sample, 1)
        now.drawn_us = 1e3 * (
            self.floor_ms - self.path_ms * math.log(path) - self.jitter_ms * math.log(own)
        )

    def _moments(self) -> tuple[float, float]:
        """Over many slots: sums of independent exponential parts."""
        mean_ms = self.floor_ms + self.path_ms + self.jitter_ms
        return mean_ms, math.hypot(self.path_ms, self.jitter_ms)

    def _reach_ms(self) -> float:
        """The largest draws of both, -log 2^-53."""
        return self.floor_ms + 36.8 * (self.path_ms + self.jitter_ms)

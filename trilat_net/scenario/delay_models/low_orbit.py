"""Delay model of low-orbit satellite networks, which reassign paths at fixed intervals.

All terminals switch to a new path through the satellites at the same time, for example every 15
s, and the delay jumps at each switch. The delay of a message is therefore modelled as the sum
of a fixed delay, a random part drawn once per interval, and a random part drawn for each
message.
"""

import math
from typing import Annotated, Any

from msgspec import Meta

from ...core import draw_pair
from . import Milliseconds, OwnDelay


class LowOrbit(OwnDelay, frozen=True, kw_only=True, tag="low_orbit"):
    """Delay of a low-orbit satellite network such as Starlink.

    These networks reassign all terminals to satellites every 15 s, at the same time. Delay and
    jitter then change abruptly (Mohan et al., "A Multifaceted Look at Starlink Performance",
    WWW 2024). The model is the sum of a fixed delay, an exponentially distributed part drawn
    once per interval, and an exponentially distributed part drawn for every message.

    Attributes:
        floor_ms: Fixed part of the delay, in ms.
        path_ms: Mean of the part drawn once per interval, in ms.
        jitter_ms: Mean of the part drawn for every sample, in ms.
        slot_s: Duration of an interval, in s.
    """

    floor_ms: Milliseconds = 20.0
    path_ms: Milliseconds = 8.0
    jitter_ms: Milliseconds = 3.0
    slot_s: Annotated[float, Meta(gt=0.0, le=1e4)] = 15.0

    def draw(self, now: Any) -> None:
        """Computes the delay of one message and stores it in `now.drawn_us`, in microseconds.

        The delay is the sum of the fixed part and the two random parts. If x is uniformly
        distributed between 0 and 1, then -log(x) is exponentially distributed with mean 1.

        Args:
            now: The sample, with its number and send time.
        """
        slot = now.stamp_ns // int(1e9 * self.slot_s)
        _, path_share = draw_pair(now, slot, 0)
        _, sample_share = draw_pair(now, now.sample, 1)
        now.drawn_us = 1e3 * (
            self.floor_ms
            - self.path_ms * math.log(path_share)
            - self.jitter_ms * math.log(sample_share)
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation of the delay over many intervals, in ms.

        An interval is the time, about 15 s, for which a terminal keeps its satellite. The
        variances of the two independent random parts add up.
        """
        mean_ms = self.floor_ms + self.path_ms + self.jitter_ms
        return mean_ms, math.hypot(self.path_ms, self.jitter_ms)

    def _reach_ms(self) -> float:
        """Returns the longest delay that can be drawn, in ms.

        The random parts are multiples of -log(x), where x is at least 2^-53 and -log(2^-53) =
        36.8.
        """
        return self.floor_ms + 36.8 * (self.path_ms + self.jitter_ms)

"""When the ticks of a site are due, on its own clock.

Law (L1): tick k lies at `k * 10^9 // rate_hz` ns after the epoch, to the nanosecond, on the leader's clock. A
site on another clock follows that by slewing, never by a step, and by at most SLEW_LIMIT.
"""

from ..core.grid import NS_PER_S

SLEW_LIMIT = 200_000.0
"""By how much a grid may run faster or slower than its clock, ns/s (200 ppm)."""
_SETTLE_S = 2.0  # an error goes down by e in this time: slow against the noise of an estimate


class Grid:
    """Deadlines of one site's ticks.

    Args:
        epoch_ns: tick 0, on its clock.
        rate_hz: its tick rate.

    Attributes:
        slew: by how much it lags its clock, ns/s.
        error_ns: how late it was against the leader's grid when it was steered last.
    """

    def __init__(self, epoch_ns: int, rate_hz: int) -> None:
        self.slew = 0.0
        self.error_ns = 0
        self._rate_hz = rate_hz
        self._from_ns, self._base_ns = 0, epoch_ns
        self._per_ns = 0.0

    def deadline(self, k: int) -> int:
        """Returns when tick k is due, on the site's clock, ns."""
        passed_ns = k * NS_PER_S // self._rate_hz - self._from_ns
        return self._base_ns + passed_ns + int(passed_ns * self._per_ns)

    def nominal(self, k: int) -> int:
        """Returns the nominal time of tick k, ns since the epoch."""
        return k * NS_PER_S // self._rate_hz

    def steer(self, k: int, error_ns: int, drift: float) -> None:
        """Slews towards the leader's grid from a tick on.

        Args:
            k: that tick, at or after the last one it was steered from.
            error_ns: how much later than the leader's own it is due.
            drift: by how much the leader's clock is faster than the own one, ns/s.
        """
        self._base_ns = self.deadline(k)
        self._from_ns = self.nominal(k)
        self.error_ns = error_ns
        self.slew = min(max(-drift - error_ns / _SETTLE_S, -SLEW_LIMIT), SLEW_LIMIT)
        self._per_ns = self.slew / NS_PER_S

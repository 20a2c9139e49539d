"""The offset in force: what turns another clock's stamps into own ones while a session runs.

Law: it never steps. It is continuous and piecewise linear: towards each new estimate it goes in BEND_NS, and
from there along the estimate's drift. Its bound is that of the estimate around the value in force, so it is
honest on the way too.
"""

from ..core.grid import NS_PER_S
from .offset import Estimate

BEND_NS = 1_000_000_000
"""How long it takes to reach a new estimate."""


class _Leg:
    """The way towards one estimate and on along it, from an instant and a value on."""

    def __init__(self, from_ns: int, offset_ns: int, estimate: Estimate) -> None:
        self.from_ns, self.estimate = from_ns, estimate
        self._joined_ns = from_ns + BEND_NS
        self._joined_offset_ns = estimate.offset_at(self._joined_ns)
        self._approach = (self._joined_offset_ns - offset_ns) / BEND_NS
        self._drift = estimate.drift / NS_PER_S
        self.bound_ns = max(
            estimate.bound_at(from_ns, offset_ns),
            estimate.bound_at(self._joined_ns, self._joined_offset_ns),
        )

    def at(self, at_ns: int) -> int:
        passed_ns = at_ns - self._joined_ns
        return self._joined_offset_ns + int(passed_ns * (self._approach if passed_ns < 0 else self._drift))

    def bound_at(self, at_ns: int) -> int:
        if self.from_ns <= at_ns <= self._joined_ns:
            return self.bound_ns
        return self.estimate.bound_at(at_ns, self.at(at_ns))


class Course:
    """An offset over time, the other clock minus the own one.

    Args:
        estimate: what it begins with.
    """

    def __init__(self, estimate: Estimate) -> None:
        self._leg = self._before = _Leg(estimate.at_ns, estimate.offset_ns, estimate)

    @property
    def estimate(self) -> Estimate:
        """What it goes by."""
        return self._leg.estimate

    @property
    def bound_ns(self) -> int:
        """How far it is from the true offset at most, from its last bend on for BEND_NS; then it grows."""
        return self._leg.bound_ns

    def bend(self, at_ns: int, estimate: Estimate) -> None:
        """Goes by a new estimate from an instant of the own clock on."""
        self._leg, self._before = _Leg(at_ns, self.at(at_ns), estimate), self._leg

    def at(self, at_ns: int) -> int:
        """Returns the offset in force at an instant, not before the last bend but one, ns."""
        leg = self._leg
        return leg.at(at_ns) if at_ns >= leg.from_ns else self._before.at(at_ns)

    def bound_at(self, at_ns: int) -> int:
        """Returns how far the offset in force can be from the true one at such an instant, ns."""
        leg = self._leg
        return leg.bound_at(at_ns) if at_ns >= leg.from_ns else self._before.bound_at(at_ns)

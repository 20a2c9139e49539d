"""What is kept of one site within one window of [expect]: sums and largest values, whatever its length.

Law: a function of the records alone, so that a run while it goes on and its log are measured alike; how the
records are cut into blocks has no influence but on the last bits of a mean.
"""

import math
from typing import NamedTuple

import numpy as np

from ..analysis.actors import tip_of, wall_force
from ..core.arm import JOINTS, Array
from ..core.grid import NS_PER_S
from ..scenario import SiteSpec
from ..scenario.actors import Wall
from ..scenario.window import Window
from .rows import Rows


class Span(NamedTuple):
    """Smallest and largest value that a quantity had; twice the same where it has one value.

    Attributes:
        least: the smallest.
        most: the largest.
    """

    least: float
    most: float


class Stretch:
    """One site's figures within a window, so far.

    Args:
        window: from when to when.
        spec: the site, for its walls and its period.
    """

    def __init__(self, window: Window, spec: SiteSpec) -> None:
        self._from_ns, self._to_ns = (round(t_s * NS_PER_S) for t_s in (window.from_s, window.to_s))
        self._period_ns = NS_PER_S // spec.rate_hz + 1
        self._spec = spec
        self._walls = [one.actor for one in spec.environment if isinstance(one, Wall)]
        self._seen_ns = -1
        self._records = 0
        self._peaks = {"error_peak_rad": 0.0, "speed_peak_rad_s": 0.0, "torque_peak_nm": 0.0}
        self._q_least, self._q_most = np.full(JOINTS, math.inf), np.full(JOINTS, -math.inf)
        self._push_sum = np.zeros(JOINTS)
        self._force_sum = self._force_squares = self._force_peak = 0.0
        self._touched: bool | None = None
        self._hits = 0

    def add(self, rows: Rows) -> None:
        """Takes in the next records of the site; those outside of the window leave no trace."""
        self._seen_ns = int(rows.t_ns[-1])
        inside = rows.between(self._from_ns, self._to_ns)
        if not len(inside.t_ns):
            return
        self._records += len(inside.t_ns)
        for key, values in zip(self._peaks, (inside.q - inside.q_des, inside.qd, inside.tau), strict=True):
            self._peaks[key] = max(self._peaks[key], float(np.abs(values).max()))
        self._q_least = np.minimum(self._q_least, inside.q.min(axis=0))
        self._q_most = np.maximum(self._q_most, inside.q.max(axis=0))
        self._push_sum -= inside.tau_x.sum(axis=0)
        if self._walls:
            tip = tip_of((self._spec.arm.l1_m, self._spec.arm.l2_m), inside.q, inside.qd)
            t_s = inside.t_ns / NS_PER_S
            self._add_force(np.sum([wall_force(wall, t_s, tip) for wall in self._walls], axis=0))

    def _add_force(self, force: Array) -> None:
        touching = force > 0.0
        before = np.append(touching[0] if self._touched is None else self._touched, touching[:-1])
        self._hits += int((touching & ~before).sum())
        self._touched = bool(touching[-1])
        self._force_sum += float(force.sum())
        self._force_squares += float((force * force).sum())
        self._force_peak = max(self._force_peak, float(force.max()))

    def figures(self) -> dict[str, Span]:
        """Returns every quantity by its key in `Window`; none where the records end before the window."""
        if not self._records or self._seen_ns < self._to_ns - self._period_ns:
            return {}
        mean_n = self._force_sum / self._records
        push_nm = self._push_sum / self._records
        single = {
            **self._peaks,
            "push1_mean_nm": float(push_nm[0]),
            "push2_mean_nm": float(push_nm[1]),
            "wall_mean_n": mean_n,
            "wall_deviation_n": math.sqrt(max(0.0, self._force_squares / self._records - mean_n * mean_n)),
            "wall_peak_n": self._force_peak,
            "wall_hits": float(self._hits),
        }
        angles = zip(("q1_rad", "q2_rad"), self._q_least.tolist(), self._q_most.tolist(), strict=True)
        spans = {key: Span(least, most) for key, least, most in angles}
        return {**spans, **{key: Span(value, value) for key, value in single.items()}}

"""What is kept of one site's records while a run goes on: enough to judge it by, and bounded.

Law: records are taken in by blocks and let go; what stays are largest values, sums, the last second, and the
largest |e| of every `BUCKET_NS`. How a run is cut into blocks has no influence on any figure but the last
bits of a mean.
"""

from collections.abc import Sequence

import numpy as np

from ..core.arm import JOINTS, Array
from ..core.grid import NS_PER_S
from ..scenario.expectation import END_S
from .rows import Ints, Rows, joined
from .stretch import Stretch

BUCKET_NS = 50_000_000
"""The envelope of |e| is kept as one largest value per so many nanoseconds."""

_NO_RECORD = -1.0
_END_NS = round(END_S * NS_PER_S)


class Tally:
    """One site's figures, so far.

    Args:
        peer_rates: tick rate of every peer, Hz, in scenario order.
        synchronised_rad: the |e| below which the site counts as synchronised, rad.
        stretches: what is kept of the site within each window of [expect]; None where a window is another's.

    Attributes:
        records: how many records were taken in.
        peak_error_rad: largest |e|.
        peak_torque_nm: largest |tau|.
        peak_speed_rad_s: largest |qd|.
        apart_ns: time of the last record whose |e| was not below `synchronised_rad`; -1 before one was.
        age_max_ms: per peer the largest age of the sample in use, shape (P,).
        stretches: as given.
    """

    def __init__(
        self, peer_rates: Sequence[int], synchronised_rad: float, stretches: Sequence[Stretch | None] = ()
    ) -> None:
        self._peer_rates = np.array(peer_rates, dtype=np.int64)
        self._synchronised_rad = synchronised_rad
        self.stretches = tuple(stretches)
        self.records = 0
        self.peak_error_rad = self.peak_torque_nm = self.peak_speed_rad_s = 0.0
        self.apart_ns = -1
        self.age_max_ms = np.zeros(len(peer_rates))
        self._age_sum_ms = np.zeros(len(peer_rates))
        self._age_records = np.zeros(len(peer_rates), dtype=np.int64)
        self._squares = np.zeros(JOINTS)
        self._peaks = np.zeros(0)
        self._tail: list[Rows] = []

    def add(self, rows: Rows) -> None:
        """Takes in the next records."""
        if not len(rows.t_ns):
            return
        error = np.abs(rows.q - rows.q_des)
        largest = error.max(axis=1)
        self.records += len(largest)
        self.peak_error_rad = max(self.peak_error_rad, float(largest.max()))
        self.peak_torque_nm = max(self.peak_torque_nm, float(np.abs(rows.tau).max()))
        self.peak_speed_rad_s = max(self.peak_speed_rad_s, float(np.abs(rows.qd).max()))
        self._squares += (error * error).sum(axis=0)
        apart = np.flatnonzero(largest >= self._synchronised_rad)
        if len(apart):
            self.apart_ns = int(rows.t_ns[apart[-1]])
        self._add_ages(rows)
        self._add_peaks(rows.t_ns // BUCKET_NS, largest)
        for stretch in filter(None, self.stretches):
            stretch.add(rows)
        self._tail.append(rows)
        while len(self._tail) > 1 and self._tail[1].t_ns[0] < rows.t_ns[-1] - _END_NS:
            del self._tail[0]

    def _add_ages(self, rows: Rows) -> None:
        known = rows.used >= 0
        age_ms = (rows.t_ns[:, None] - rows.used * NS_PER_S // self._peer_rates) * 1e-6
        age_ms[~known] = 0.0
        self.age_max_ms = np.maximum(self.age_max_ms, age_ms.max(axis=0))
        self._age_sum_ms += age_ms.sum(axis=0)
        self._age_records += known.sum(axis=0)

    def _add_peaks(self, buckets: Ints, largest: Array) -> None:
        lacking = int(buckets[-1]) + 1 - len(self._peaks)
        if lacking > 0:  # by half as much again: a long run is not copied for every block
            self._peaks = np.append(self._peaks, np.full(lacking + len(self._peaks) // 2, _NO_RECORD))
        np.maximum.at(self._peaks, buckets, largest)

    @property
    def last_ns(self) -> int:
        """Nominal time of the last record, ns; -1 before the first."""
        return int(self._tail[-1].t_ns[-1]) if self._tail else -1

    @property
    def rms_error_rad(self) -> float:
        """Root mean square of e of the worse joint, rad."""
        return float(np.sqrt(self._squares.max() / max(1, self.records)))

    @property
    def mean_age_ms(self) -> list[float | None]:
        """Per peer the mean age of the sample in use, ms; None where there never was one."""
        return [
            float(total / records) if records else None
            for total, records in zip(self._age_sum_ms, self._age_records, strict=True)
        ]

    def end(self, end_ns: int) -> Rows:
        """Returns the records of the last second before `end_ns`, which is not before the last record."""
        return joined(self._tail).since(end_ns - _END_NS)

    def peaks(self) -> Array:
        """Returns the largest |e| of every bucket that ended, from the first on; -1 where it has none."""
        return self._peaks[: self.last_ns // BUCKET_NS]

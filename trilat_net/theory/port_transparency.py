"""Transparency: the impedance at one site's ports with another site free and clamped.

Invariant: an impedance is along one joint, torque over velocity, N m s/rad, with no torque of the operator on
the other joints. Means are taken on a logarithmic frequency axis over a named band.

Source: transmitted impedance after Lawrence, "Stability and transparency in bilateral teleoperation", IEEE
Trans. Robotics and Automation 9 (1993). The difference of both ends is the Z-width of Hashtrudi-Zaad and
Salcudean, "Analysis and evaluation of stability and performance robustness for teleoperation control
architectures", ICRA (2000); the ratio is our own measure (docs/ports.md).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..core.vectors import Array
from ..errors import UsageError
from . import port_response
from .characteristic_roots import Complex
from .linear_loop import LinearLoop

TRANSPARENCY_BAND_HZ = (0.1, 10.0)
"""The band of the means: below it operators drift, above it they do not move deliberately."""
QUOTED_AT_HZ = 1.0
_SHOWN_HZ = (0.01, 100.0)
_PER_DECADE = 100


class Transparency(NamedTuple):
    """Impedance along one joint at an operator's site, another site free and clamped.

    Attributes:
        at: the operator's site.
        of: the site that is free or clamped.
        joint: the joint of the operator's site, from 1 on.
        w_rad_s: frequencies, shape (F,).
        free: impedance with the other site free, shape (F,), N m s/rad.
        clamped: impedance with the other site clamped, shape (F,), N m s/rad.
        band_hz: the band of the means, Hz.
    """

    at: str
    of: str
    joint: int
    w_rad_s: Array
    free: Complex
    clamped: Complex
    band_hz: tuple[float, float] = TRANSPARENCY_BAND_HZ

    @property
    def softest_nm_s_rad(self) -> float:
        """Mean size of the free impedance over the band, on logarithmic axes."""
        return self._mean(self.free)

    @property
    def stiffest_nm_s_rad(self) -> float:
        """Mean size of the clamped impedance over the band, on logarithmic axes."""
        return self._mean(self.clamped)

    @property
    def ratio_db(self) -> float:
        """Mean of 20 log10(abs(Z_clamped) / abs(Z_free)) over the band, dB."""
        return 20.0 * float(np.log10(self.stiffest_nm_s_rad / self.softest_nm_s_rad))

    @property
    def difference_nm_s_rad(self) -> float:
        """Mean size of Z_clamped - Z_free over the band, on logarithmic axes; zero if they are one."""
        apart = self.clamped - self.free
        return self._mean(apart) if apart.all() else 0.0

    def size_at(self, frequency_hz: float) -> tuple[float, float]:
        """Returns the sizes of the free and the clamped impedance at a frequency, N m s/rad."""
        x, at = np.log(self.w_rad_s), np.log(2.0 * np.pi * frequency_hz)
        free, clamped = (
            float(np.exp(np.interp(at, x, np.log(np.abs(Z))))) for Z in (self.free, self.clamped)
        )
        return free, clamped

    def _mean(self, Z: Complex) -> float:
        low, high = (2.0 * np.pi * edge for edge in self.band_hz)
        inside = (self.w_rad_s >= low * (1.0 - 1e-9)) & (self.w_rad_s <= high * (1.0 + 1e-9))
        logs, x = np.log(np.abs(Z[inside])), np.log(self.w_rad_s[inside])
        return float(np.exp(np.trapezoid(logs, x) / (x[-1] - x[0])))


def measure_transparency(
    loop: LinearLoop,
    at: str,
    of: str,
    others: Mapping[str, port_response.PortLoad] | None = None,
    band_hz: tuple[float, float] = TRANSPARENCY_BAND_HZ,
) -> tuple[Transparency, ...]:
    """Returns the transparency along each joint of site `at`, with site `of` free and clamped.

    Z(j w) = 1 / Y_ii(j w) with Y of the loop with loads at `others`; the rest is free.

    Raises:
        UsageError: no such site, both are one, or the band is empty.
    """
    check_band(band_hz)
    low, high = min(band_hz[0], _SHOWN_HZ[0]), max(band_hz[1], _SHOWN_HZ[1])
    points = np.geomspace(low, high, 1 + round(_PER_DECADE * np.log10(high / low)))
    w_rad_s = 2.0 * np.pi * np.union1d(points, band_hz)
    places = port_response.find_site_ports(loop, at)
    if at == of or at in (others or {}):
        raise UsageError(f"a load at {at} would be at the operator's own site")

    def admittance(load: port_response.PortLoad) -> Complex:
        """Returns the admittance at the operator's site with a load at the other one."""
        loaded = port_response.apply_loads(loop, {**(others or {}), of: load})
        return port_response.select_ports(
            port_response.build_admittance(loaded), port_response.find_site_ports(loaded, at)
        )(w_rad_s)

    free, clamped = admittance(port_response.FREE), admittance(port_response.CLAMPED)
    joints = [int(loop.inputs[port].rpartition("tau")[2]) for port in places]
    return tuple(
        Transparency(at, of, joint, w_rad_s, 1.0 / free[:, n, n], 1.0 / clamped[:, n, n], band_hz)
        for n, joint in enumerate(joints)
    )


def check_band(band_hz: tuple[float, float]) -> None:
    """Raises UsageError unless a band goes from a positive frequency to a higher one."""
    if not 0.0 < band_hz[0] < band_hz[1]:
        raise UsageError(
            f"a band goes from a frequency to a higher one, not from {band_hz[0]:g} to {band_hz[1]:g} Hz"
        )

"""Frequency response of the loop at its haptic ports, free or with a site clamped.

Invariant: torque is ON the joint, so that torque times velocity is the power that the operator
puts in. A clamp's torque counts as any torque on the joint: a law that reflects force reflects
it too. Frequencies inside are rad/s; those for people are Hz and carry it in their names.

Source: impedance and admittance of ports after Hogan, "Impedance control: an approach to
manipulation", ASME J. Dynamic Systems, Measurement, and Control 107 (1985); teleoperators as
networks of them after Hannaford, "A design framework for teleoperators with kinesthetic
feedback", IEEE Trans. Robotics and Automation 5 (1989).

Transparency compares an impedance with another site free and clamped: along one joint, torque
over velocity, N m s/rad, with no torque of the operator on the other joints. Means are taken on
a logarithmic frequency axis over a named band. Transmitted impedance after Lawrence, "Stability
and transparency in bilateral teleoperation", IEEE Trans. Robotics and Automation 9 (1993). The
difference of both ends is the Z-width of Hashtrudi-Zaad and Salcudean, "Analysis and evaluation
of stability and performance robustness for teleoperation control architectures", ICRA (2000);
the ratio is our own measure (docs/ports.md).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..core.vectors import Array
from ..errors import RuntimeFault, UsageError
from .characteristic_roots import Complex
from .linear_loop import DelayedTerm, LinearLoop

PortResponse = Callable[[Array], Complex]
"""Matrices, shape (F, p, m), for frequencies of shape (F,), rad/s."""

ZERO_ROOT_RADIUS_PER_S = 1e-3
"""Roots of the loop inside this circle count as at zero, 1/s."""

_BATCH = 512
_CIRCLE_POINTS = 64
_HIGHEST_POWER = 6
_NEGLIGIBLE = 1e-3


class LoopOutput(NamedTuple):
    """An output of the loop's present and past state.

    Attributes:
        C: shape (p, n).
        delayed: pairs of a delay, s, and the output matrix of the state so long ago, shape (p,
            n).
    """

    C: Array
    delayed: tuple[tuple[float, Array], ...] = ()

    def evaluate(self, s: Complex) -> Complex:
        """Returns C + sum_k C_k e^{-s T_k}, shape (F, p, n)."""
        total: Complex = np.broadcast_to(
            self.C.astype(np.complex128), (len(s), *self.C.shape)
        ).copy()
        for delay_s, C in self.delayed:
            total += np.exp(-s * delay_s)[:, np.newaxis, np.newaxis] * C
        return total


class PoleAtZero(NamedTuple):
    """The pole of the response at zero frequency: Y(s) ~ residue / s + higher powers of 1 / s.

    Attributes:
        order: the highest power of 1 / s; 0: there is no pole, and a constant torque gives no
            endless growth.
        residue: shape (p, m): growth of velocity under a constant torque, rad/s^2 per N m.
    """

    order: int
    residue: Array

    @property
    def passive(self) -> bool:
        """True if a passive network may have it: single, its residue symmetric and not
        negative.
        """
        asymmetry = np.abs(self.residue - self.residue.T).max(initial=0.0)
        size = np.abs(self.residue).max(initial=0.0)
        if self.order > 1 or asymmetry > _NEGLIGIBLE * size:
            return False
        return bool(np.linalg.eigvalsh(self.residue).min(initial=0.0) >= -_NEGLIGIBLE * size)


def evaluate_transfer(
    loop: LinearLoop, s: Complex, output: LoopOutput | None = None
) -> Complex:
    """Returns C(s) (s - A - sum_k A_k e^{-s T_k})^{-1} (B + sum_k B_k e^{-s T_k}), shape (F, p,
    m).

    Without an output C(s) is the loop's own, its joint velocities, which makes this Y(s), rad/s
    per N m.
    """
    output = LoopOutput(loop.C) if output is None else output
    response = np.zeros((len(s), len(output.C), loop.B.shape[1]), np.complex128)
    for first in range(0, len(s), _BATCH):
        some = s[first : first + _BATCH]
        rates = np.eye(len(loop.A)) if loop.E is None else np.diag(loop.E)
        left = some[:, np.newaxis, np.newaxis] * rates - loop.A
        right = np.broadcast_to(loop.B.astype(np.complex128), (len(some), *loop.B.shape)).copy()
        for term in loop.delayed:
            shift = np.exp(-some * term.delay_s)[:, np.newaxis, np.newaxis]
            left -= shift * term.A
            right += shift * term.B
        response[first : first + _BATCH] = output.evaluate(some) @ np.linalg.solve(left, right)
    return response


def build_admittance(loop: LinearLoop) -> PortResponse:
    """Returns Y(j w): velocity of each joint per torque of an operator at each joint, rad/s per
    N m.

    The loop's outputs must be the velocities of the joints of its inputs, in order.
    """
    if loop.C.shape[0] != loop.B.shape[1]:
        raise RuntimeFault(
            f"ports need as many velocities as torques, not {loop.C.shape[0]} of {loop.B.shape[1]}"
        )
    return lambda w_rad_s: evaluate_transfer(loop, to_imaginary_axis(w_rad_s))


def to_imaginary_axis(w_rad_s: Array) -> Complex:
    """Returns j w."""
    return np.asarray(1j * w_rad_s, dtype=np.complex128)


def parse_port_site(port: str) -> str:
    """Returns the site of a port or a state, "m1" of "m1.tau2"."""
    return port.partition(".")[0]


def list_port_sites(loop: LinearLoop) -> tuple[str, ...]:
    """Returns the sites of a loop, in the order of its inputs."""
    return tuple(dict.fromkeys(parse_port_site(name) for name in loop.inputs))


def find_site_ports(loop: LinearLoop, site: str) -> list[int]:
    """Returns the places of a site's joints among the ports.

    Raises:
        UsageError: the loop has no such site.
    """
    ports = [n for n, name in enumerate(loop.inputs) if parse_port_site(name) == site]
    if not ports:
        raise UsageError(
            f"no site {site!r} at the ports; there are {', '.join(list_port_sites(loop))}"
        )
    return ports


def group_ports_by_joint(loop: LinearLoop) -> dict[int, list[int]]:
    """Returns the places of every joint by its number, one per site that has it, in the order
    of sites.
    """
    places: dict[int, list[int]] = {}
    for place, name in enumerate(loop.inputs):
        places.setdefault(int(name.rpartition("tau")[2]), []).append(place)
    return dict(sorted(places.items()))


def select_ports(response: PortResponse, places: list[int]) -> PortResponse:
    """Returns the response at some ports alone, with no operator at the others."""
    return lambda w_rad_s: response(w_rad_s)[:, places][:, :, places]


def find_longest_delay_s(loop: LinearLoop) -> float:
    """Returns the longest delay of a loop, s; 0 if there is none."""
    return max((term.delay_s for term in loop.delayed), default=0.0)


def find_pole_at_zero(loop: LinearLoop) -> PoleAtZero:
    """Returns the pole of the response at zero, by Cauchy's integral along a small circle about
    it.

    Common poses at which the arms can rest, and estimates without excitation, are roots of the
    loop at zero. Most are no poles of Y: a resting arm has no velocity. A loop without friction
    has one: Y(s) ~ 1 / (m s). Roots within `ZERO_ROOT_RADIUS_PER_S` count as at zero.
    """
    turn = np.exp(2j * math.pi * np.arange(_CIRCLE_POINTS) / _CIRCLE_POINTS)[
        :, np.newaxis, np.newaxis
    ]
    values = evaluate_transfer(loop, ZERO_ROOT_RADIUS_PER_S * turn[:, 0, 0])
    parts = [(values * turn**power).mean(axis=0).real for power in range(1, _HIGHEST_POWER + 1)]
    size = _NEGLIGIBLE * np.abs(values).max(initial=0.0)
    powers = [
        power for power, part in enumerate(parts, 1) if np.abs(part).max(initial=0.0) > size
    ]
    residue = parts[0] * ZERO_ROOT_RADIUS_PER_S if 1 in powers else np.zeros_like(parts[0])
    return PoleAtZero(max(powers, default=0), residue)


def clamp_site(loop: LinearLoop, site: str) -> LinearLoop:
    """Returns the loop with a site held still: the site loses its ports, velocities and angles.

    Raises:
        UsageError: no such site, or its clamp and an earlier one reflect force onto each other.
    """
    ports = find_site_ports(loop, site)
    others = [n for n in range(len(loop.inputs)) if n not in ports]
    speeds = [loop.names.index(loop.outputs[port]) for port in ports]
    angles = [loop.names.index(loop.inputs[port].replace(".tau", ".q")) for port in ports]
    removed = {*speeds, *angles}
    kept = [n for n in range(len(loop.names)) if n not in removed]
    terms = [DelayedTerm(0.0, loop.A, loop.B), *loop.delayed]
    if any(term.B[np.ix_(speeds, ports)].any() for term in loop.delayed):
        raise UsageError(
            f"clamped sites that reflect force onto each other have no finite answer: {site}"
        )
    inverse = np.linalg.inv(loop.B[np.ix_(speeds, ports)])
    sums: dict[float, DelayedTerm] = {}

    def add(delay_s: float, A: Array, B: Array) -> None:
        """Adds to the term of a delay; sums of delays are one if they differ by rounding alone."""
        key = round(delay_s, 12)
        term = sums.get(key)
        sums[key] = DelayedTerm(key, *((A, B) if term is None else (term.A + A, term.B + B)))

    clamp = [(T, -inverse @ A[speeds], -inverse @ B[speeds][:, others]) for T, A, B in terms]
    for delay_s, A, B in terms:
        add(delay_s, A, B[:, others])
        if B[:, ports].any():
            for late_s, of_state, of_torque in clamp:
                add(delay_s + late_s, B[:, ports] @ of_state, B[:, ports] @ of_torque)
    now, *late = [
        DelayedTerm(delay_s, A[np.ix_(kept, kept)], B[kept])
        for delay_s, A, B in sorted(sums.values(), key=lambda term: term.delay_s)
    ]
    return LinearLoop(
        names=tuple(loop.names[n] for n in kept),
        inputs=tuple(loop.inputs[n] for n in others),
        outputs=tuple(loop.outputs[n] for n in others),
        A=now.A,
        B=now.B,
        C=loop.C[np.ix_(others, kept)],
        delayed=tuple(term for term in late if term.A.any() or term.B.any()),
        E=None if loop.E is None else loop.E[kept],
    )


TRANSPARENCY_BAND_HZ = (0.1, 10.0)
"""The band of the means: below it operators drift, above it they do not move deliberately."""
QUOTED_AT_HZ = 1.0
_SHOWN_HZ = (0.01, 100.0)
_PER_DECADE = 100


class Transparency(NamedTuple):
    """Impedance along one joint at an operator's site, another site free and clamped.

    Attributes:
        operator_site: the operator's site.
        other_site: the site that is free or clamped.
        joint: the joint of the operator's site, from 1 on.
        w_rad_s: frequencies, shape (F,).
        free: impedance with the other site free, shape (F,), N m s/rad.
        clamped: impedance with the other site clamped, shape (F,), N m s/rad.
        band_hz: the band of the means, Hz.
    """

    operator_site: str
    other_site: str
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
        """Mean size of Z_clamped - Z_free over the band, on logarithmic axes; zero if they are
        one.
        """
        apart = self.clamped - self.free
        return self._mean(apart) if apart.all() else 0.0

    def interpolate_magnitudes(self, frequency_hz: float) -> tuple[float, float]:
        """Returns the sizes of the free and the clamped impedance at a frequency, N m s/rad."""
        x = np.log(self.w_rad_s)
        at = np.log(2.0 * np.pi * frequency_hz)
        free, clamped = (
            float(np.exp(np.interp(at, x, np.log(np.abs(Z)))))
            for Z in (self.free, self.clamped)
        )
        return free, clamped

    def _mean(self, Z: Complex) -> float:
        low, high = (2.0 * np.pi * edge for edge in self.band_hz)
        inside = (self.w_rad_s >= low * (1.0 - 1e-9)) & (self.w_rad_s <= high * (1.0 + 1e-9))
        logs = np.log(np.abs(Z[inside]))
        x = np.log(self.w_rad_s[inside])
        return float(np.exp(np.trapezoid(logs, x) / (x[-1] - x[0])))


def measure_transparency(loop: LinearLoop, at: str, of: str) -> tuple[Transparency, ...]:
    """Returns the transparency along each joint of site `at`, with site `of` free and clamped.

    Z(j w) = 1 / Y_ii(j w) with Y of the loop; the rest is free.

    Raises:
        UsageError: no such site, or both are one.
    """
    low, high = _SHOWN_HZ
    points = np.geomspace(low, high, 1 + round(_PER_DECADE * np.log10(high / low)))
    w_rad_s = 2.0 * np.pi * np.union1d(points, TRANSPARENCY_BAND_HZ)
    places = find_site_ports(loop, at)
    if at == of:
        raise UsageError(f"a load at {at} would be at the operator's own site")
    free, clamped = (
        select_ports(build_admittance(one), find_site_ports(one, at))(w_rad_s)
        for one in (loop, clamp_site(loop, of))
    )
    joints = [int(loop.inputs[port].rpartition("tau")[2]) for port in places]
    return tuple(
        Transparency(
            operator_site=at,
            other_site=of,
            joint=joint,
            w_rad_s=w_rad_s,
            free=1.0 / free[:, n, n],
            clamped=1.0 / clamped[:, n, n],
        )
        for n, joint in enumerate(joints)
    )

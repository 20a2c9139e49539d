"""Ports: what the loop answers, in velocity, to the torque of a hand at each joint, frequency by frequency.

Law: a `Loop` is read and nothing else; torque is ON the joint, so that torque times velocity is the power
that a hand puts in. Frequencies inside are rad/s; those that people read are Hz, and say so in their names.

Source: impedance and admittance of ports after Hogan, "Impedance control: an approach to manipulation", ASME
J. Dynamic Systems, Measurement, and Control 107 (1985); teleoperators as networks of them after Hannaford, "A
design framework for teleoperators with kinesthetic feedback", IEEE Trans. Robotics and Automation 5 (1989).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array
from ..errors import RuntimeFault
from ..linear.loop import Loop

Complex = NDArray[np.complex128]
Response = Callable[[Array], Complex]
"""Matrices, shape (F, p, m), for frequencies of shape (F,), rad/s."""

SMALL_PER_S = 1e-3
"""Roots of the loop inside this circle count as at zero, 1/s."""

_AT_ONCE = 512
_CIRCLE = 64
_HIGHEST = 6
_NOTHING = 1e-3


class Output(NamedTuple):
    """Something that is read off the loop's state, also off its past.

    Attributes:
        C: shape (p, n).
        delayed: pairs of a delay, s, and what is read so long ago, shape (p, n).
    """

    C: Array
    delayed: tuple[tuple[float, Array], ...] = ()

    def at(self, s: Complex) -> Complex:
        """Returns C + sum_k C_k e^{-s T_k}, shape (F, p, n)."""
        total: Complex = np.broadcast_to(self.C.astype(np.complex128), (len(s), *self.C.shape)).copy()
        for delay_s, C in self.delayed:
            total += np.exp(-s * delay_s)[:, np.newaxis, np.newaxis] * C
        return total


class PoleAtZero(NamedTuple):
    """What the answer does where the frequency goes to zero: Y(s) ~ residue / s + higher powers of 1 / s.

    Attributes:
        order: the highest power of 1 / s; 0: there is no pole, and a constant torque gives no endless growth.
        residue: shape (p, m): what a constant torque adds to the velocity in every second, rad/s^2 per N m.
    """

    order: int
    residue: Array

    @property
    def passive(self) -> bool:
        """True where a passive network may have it: single, its residue symmetric and never negative."""
        uneven = np.abs(self.residue - self.residue.T).max(initial=0.0)
        if self.order > 1 or uneven > _NOTHING * np.abs(self.residue).max(initial=0.0):
            return False
        return bool(
            np.linalg.eigvalsh(self.residue).min(initial=0.0) >= -_NOTHING * np.abs(self.residue).max()
        )


def transfer(loop: Loop, s: Complex, output: Output | None = None) -> Complex:
    """Returns C(s) (s - A - sum_k A_k e^{-s T_k})^{-1} (B + sum_k B_k e^{-s T_k}), shape (F, p, m).

    Args:
        loop: the linearised loop.
        s: where, shape (F,), 1/s.
        output: what is read off; None: the loop's own, the velocities of its joints, which makes this Y(s),
            rad/s per N m.
    """
    read = Output(loop.C) if output is None else output
    parts = [_transfer(loop, s[n : n + _AT_ONCE], read) for n in range(0, len(s), _AT_ONCE)]
    return np.concatenate(parts) if parts else np.zeros((0, len(read.C), loop.B.shape[1]), np.complex128)


def _transfer(loop: Loop, s: Complex, read: Output) -> Complex:
    left = s[:, np.newaxis, np.newaxis] * np.eye(len(loop.A)) - loop.A
    right = np.broadcast_to(loop.B.astype(np.complex128), (len(s), *loop.B.shape)).copy()
    for late in loop.delayed:
        turn = np.exp(-s * late.delay_s)[:, np.newaxis, np.newaxis]
        left -= turn * late.A
        right += turn * late.B
    answer: Complex = read.at(s) @ np.linalg.solve(left, right)
    return answer


def admittance(loop: Loop) -> Response:
    """Returns Y(j w): velocity of each joint per torque of a hand at each joint, rad/s per N m.

    Args:
        loop: the linearised loop; its outputs are the velocities of the joints of its inputs, in order.
    """
    if loop.C.shape[0] != loop.B.shape[1]:
        raise RuntimeFault(
            f"ports need as many velocities as torques, not {loop.C.shape[0]} of {loop.B.shape[1]}"
        )
    return lambda w_rad_s: transfer(loop, on_axis(w_rad_s))


def on_axis(w_rad_s: Array) -> Complex:
    """Returns j w."""
    return np.asarray(1j * w_rad_s, dtype=np.complex128)


def inverse(Y: Complex) -> Complex:
    """Returns the impedance of an admittance, or the other way round, shape (F, p, p)."""
    return np.asarray(np.linalg.inv(Y), dtype=np.complex128)


def site_of(port: str) -> str:
    """Returns the site of a port or a state, "m1" of "m1.tau2"."""
    return port.partition(".")[0]


def sites(loop: Loop) -> tuple[str, ...]:
    """Returns the sites of a loop, in the order of its inputs."""
    return tuple(dict.fromkeys(site_of(name) for name in loop.inputs))


def ports_of(loop: Loop, site: str) -> list[int]:
    """Returns the places of a site's joints among the ports."""
    return [n for n, name in enumerate(loop.inputs) if site_of(name) == site]


def axes(loop: Loop) -> dict[int, list[int]]:
    """Returns the places of every joint, by its number, one per site that has it, in the order of sites."""
    found: dict[int, list[int]] = {}
    for place, name in enumerate(loop.inputs):
        joint = int(name.rpartition("tau")[2])
        found.setdefault(joint, []).append(place)
    return found


def part(response: Response, places: list[int]) -> Response:
    """Returns the answer at some ports alone, while no hand is at the others."""
    return lambda w_rad_s: response(w_rad_s)[:, places][:, :, places]


def longest_s(loop: Loop) -> float:
    """Returns the longest delay of a loop, s; 0 where there is none."""
    return max((late.delay_s for late in loop.delayed), default=0.0)


def pole_at_zero(loop: Loop, output: Output | None = None) -> PoleAtZero:
    """Returns the pole of the answer at zero, by Cauchy's integral along a small circle about it.

    Common poses at which the arms can rest, and estimates that nothing excites, are roots of the loop at
    zero. Most are no poles of Y: a rest has no velocity. A loop without friction has one: Y(s) ~ 1 / (m s).

    Args:
        loop: the linearised loop. Roots within `SMALL_PER_S` count as at zero.
        output: as of `transfer`.
    """
    turn = np.exp(2j * math.pi * np.arange(_CIRCLE) / _CIRCLE)[:, np.newaxis, np.newaxis]
    values = transfer(loop, SMALL_PER_S * turn[:, 0, 0], output)
    parts = [(values * turn**power).mean(axis=0).real for power in range(1, _HIGHEST + 1)]
    size = np.abs(values).max(initial=0.0)
    there = [power for power, one in enumerate(parts, 1) if np.abs(one).max(initial=0.0) > _NOTHING * size]
    return PoleAtZero(
        max(there, default=0), parts[0] * SMALL_PER_S if 1 in there else np.zeros_like(parts[0])
    )

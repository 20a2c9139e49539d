"""Frequency response of the loop at its haptic ports, free or with springs, dampers and clamps as loads.

Invariant: torque is ON the joint, so that torque times velocity is the power that the operator puts in. A
load's torque counts as any torque on the joint: a law that reflects force reflects it too, also that of a
clamp. Frequencies inside are rad/s; those for people are Hz and carry it in their names.

Source: impedance and admittance of ports after Hogan, "Impedance control: an approach to manipulation", ASME
J. Dynamic Systems, Measurement, and Control 107 (1985); teleoperators as networks of them after Hannaford, "A
design framework for teleoperators with kinesthetic feedback", IEEE Trans. Robotics and Automation 5 (1989).
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from ..errors import RuntimeFault, UsageError
from .linear_loop import DelayedTerm, LinearLoop

Complex = NDArray[np.complex128]
PortResponse = Callable[[Array], Complex]
"""Matrices, shape (F, p, m), for frequencies of shape (F,), rad/s."""

ZERO_ROOT_RADIUS_PER_S = 1e-3
"""Roots of the loop inside this circle count as at zero, 1/s."""

_AT_ONCE = 512
_CIRCLE = 64
_HIGHEST = 6
_NOTHING = 1e-3


class LoopOutput(NamedTuple):
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


def evaluate_transfer(loop: LinearLoop, s: Complex, output: LoopOutput | None = None) -> Complex:
    """Returns C(s) (s - A - sum_k A_k e^{-s T_k})^{-1} (B + sum_k B_k e^{-s T_k}), shape (F, p, m).

    Args:
        loop: the linearised loop.
        s: where, shape (F,), 1/s.
        output: what is read off; None: the loop's own, the velocities of its joints, which makes this Y(s),
            rad/s per N m.
    """
    read = LoopOutput(loop.C) if output is None else output
    parts = [_transfer(loop, s[n : n + _AT_ONCE], read) for n in range(0, len(s), _AT_ONCE)]
    return np.concatenate(parts) if parts else np.zeros((0, len(read.C), loop.B.shape[1]), np.complex128)


def _transfer(loop: LinearLoop, s: Complex, read: LoopOutput) -> Complex:
    left = s[:, np.newaxis, np.newaxis] * np.eye(len(loop.A)) - loop.A
    right = np.broadcast_to(loop.B.astype(np.complex128), (len(s), *loop.B.shape)).copy()
    for late in loop.delayed:
        turn = np.exp(-s * late.delay_s)[:, np.newaxis, np.newaxis]
        left -= turn * late.A
        right += turn * late.B
    answer: Complex = read.at(s) @ np.linalg.solve(left, right)
    return answer


def build_admittance(loop: LinearLoop) -> PortResponse:
    """Returns Y(j w): velocity of each joint per torque of a hand at each joint, rad/s per N m.

    Args:
        loop: the linearised loop; its outputs are the velocities of the joints of its inputs, in order.
    """
    if loop.C.shape[0] != loop.B.shape[1]:
        raise RuntimeFault(
            f"ports need as many velocities as torques, not {loop.C.shape[0]} of {loop.B.shape[1]}"
        )
    return lambda w_rad_s: evaluate_transfer(loop, to_imaginary_axis(w_rad_s))


def to_imaginary_axis(w_rad_s: Array) -> Complex:
    """Returns j w."""
    return np.asarray(1j * w_rad_s, dtype=np.complex128)


def invert_response(Y: Complex) -> Complex:
    """Returns the impedance of an admittance, or the other way round, shape (F, p, p)."""
    return np.asarray(np.linalg.inv(Y), dtype=np.complex128)


def parse_port_site(port: str) -> str:
    """Returns the site of a port or a state, "m1" of "m1.tau2"."""
    return port.partition(".")[0]


def list_port_sites(loop: LinearLoop) -> tuple[str, ...]:
    """Returns the sites of a loop, in the order of its inputs."""
    return tuple(dict.fromkeys(parse_port_site(name) for name in loop.inputs))


def find_site_ports(loop: LinearLoop, site: str) -> list[int]:
    """Returns the places of a site's joints among the ports."""
    return [n for n, name in enumerate(loop.inputs) if parse_port_site(name) == site]


def group_ports_by_joint(loop: LinearLoop) -> dict[int, list[int]]:
    """Returns the places of every joint, by its number, one per site that has it, in the order of sites."""
    found: dict[int, list[int]] = {}
    for place, name in enumerate(loop.inputs):
        joint = int(name.rpartition("tau")[2])
        found.setdefault(joint, []).append(place)
    return found


def select_ports(response: PortResponse, places: list[int]) -> PortResponse:
    """Returns the answer at some ports alone, while no hand is at the others."""
    return lambda w_rad_s: response(w_rad_s)[:, places][:, :, places]


def find_longest_delay_s(loop: LinearLoop) -> float:
    """Returns the longest delay of a loop, s; 0 where there is none."""
    return max((late.delay_s for late in loop.delayed), default=0.0)


def find_pole_at_zero(loop: LinearLoop, output: LoopOutput | None = None) -> PoleAtZero:
    """Returns the pole of the answer at zero, by Cauchy's integral along a small circle about it.

    Common poses at which the arms can rest, and estimates that nothing excites, are roots of the loop at
    zero. Most are no poles of Y: a rest has no velocity. A loop without friction has one: Y(s) ~ 1 / (m s).

    Args:
        loop: the linearised loop. Roots within `SMALL_PER_S` count as at zero.
        output: as of `transfer`.
    """
    turn = np.exp(2j * math.pi * np.arange(_CIRCLE) / _CIRCLE)[:, np.newaxis, np.newaxis]
    values = evaluate_transfer(loop, ZERO_ROOT_RADIUS_PER_S * turn[:, 0, 0], output)
    parts = [(values * turn**power).mean(axis=0).real for power in range(1, _HIGHEST + 1)]
    size = np.abs(values).max(initial=0.0)
    there = [power for power, one in enumerate(parts, 1) if np.abs(one).max(initial=0.0) > _NOTHING * size]
    return PoleAtZero(
        max(there, default=0), parts[0] * ZERO_ROOT_RADIUS_PER_S if 1 in there else np.zeros_like(parts[0])
    )


class PortLoad(NamedTuple):
    """A spring and a damper to a fixed point, at each joint of a site.

    Attributes:
        K_nm_rad: stiffness, N m/rad; infinite: a clamp.
        B_nm_s_rad: damping, N m s/rad.
    """

    K_nm_rad: float = 0.0
    B_nm_s_rad: float = 0.0


FREE = PortLoad()
CLAMPED = PortLoad(math.inf)

_Terms = list[tuple[float, Array, Array]]
"""Delay, s; what of the state; what of the torques."""


def apply_loads(loop: LinearLoop, loads: Mapping[str, PortLoad]) -> LinearLoop:
    """Returns the loop with loads at some of its sites; clamped ones have neither ports nor angles any more.

    Args:
        loop: the loop.
        loads: by the name of the site.

    Raises:
        UsageError: no such site, a negative stiffness or damping, or several clamps that reflect each other.
    """
    for site, load in loads.items():
        if site not in list_port_sites(loop):
            raise UsageError(f"no site {site!r} at the ports; there are {', '.join(list_port_sites(loop))}")
        if not (load.K_nm_rad >= 0.0 and 0.0 <= load.B_nm_s_rad < math.inf):
            raise UsageError(f"a load needs stiffness and damping of at least 0, not {load}")
    for site, load in loads.items():
        loop = _clamped(loop, site) if math.isinf(load.K_nm_rad) else _sprung(loop, site, load)
    return loop


def _angles(loop: LinearLoop, ports: list[int]) -> list[int]:
    return [loop.names.index(loop.inputs[port].replace(".tau", ".q")) for port in ports]


def _sprung(loop: LinearLoop, site: str, load: PortLoad) -> LinearLoop:
    """Returns the loop with u = -K q - B qd at a site, besides what else pushes there."""
    ports = find_site_ports(loop, site)
    back = np.zeros((len(loop.inputs), len(loop.names)))
    back[ports] = load.B_nm_s_rad * loop.C[ports]
    back[ports, _angles(loop, ports)] += load.K_nm_rad
    delayed = tuple(late._replace(A=late.A - late.B @ back) for late in loop.delayed)
    return loop._replace(A=loop.A - loop.B @ back, delayed=delayed)


def _clamped(loop: LinearLoop, site: str) -> LinearLoop:
    """Returns the loop with a site's joints fixed: its torque is what keeps their accelerations zero."""
    ports = find_site_ports(loop, site)
    others = [n for n in range(len(loop.inputs)) if n not in ports]
    speeds = [loop.names.index(loop.outputs[port]) for port in ports]
    gone = {*speeds, *_angles(loop, ports)}
    kept = [n for n in range(len(loop.names)) if n not in gone]
    terms: _Terms = [(0.0, loop.A, loop.B), *loop.delayed]
    if any(late.B[np.ix_(speeds, ports)].any() for late in loop.delayed):
        raise UsageError(f"clamped sites that reflect force onto each other have no finite answer: {site}")
    inverse = np.linalg.inv(loop.B[np.ix_(speeds, ports)])
    clamp = [(T, -inverse @ A[speeds], -inverse @ B[speeds][:, others]) for T, A, B in terms]
    found: dict[float, tuple[Array, Array]] = {0.0: (np.zeros_like(loop.A), np.zeros_like(loop.B[:, others]))}
    for T, A, B in terms:
        _add(found, T, A, B[:, others])
        if B[:, ports].any():
            for later, of_state, of_torque in clamp:
                _add(found, T + later, B[:, ports] @ of_state, B[:, ports] @ of_torque)
    left = {T: (A[np.ix_(kept, kept)], B[kept]) for T, (A, B) in sorted(found.items())}
    A, B = left.pop(0.0)
    return LinearLoop(
        tuple(loop.names[n] for n in kept),
        tuple(loop.inputs[n] for n in others),
        tuple(loop.outputs[n] for n in others),
        A,
        B,
        loop.C[np.ix_(others, kept)],
        tuple(DelayedTerm(T, A, B) for T, (A, B) in left.items() if A.any() or B.any()),
    )


def _add(found: dict[float, tuple[Array, Array]], delay_s: float, A: Array, B: Array) -> None:
    """Adds a term to those of its delay; sums of delays are one where they differ by rounding alone."""
    key = round(delay_s, 12)
    if key in found:
        A, B = found[key][0] + A, found[key][1] + B
    found[key] = (A, B)

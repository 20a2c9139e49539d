"""Loads: what hands and environments at the ports make of the loop, as springs with dampers or clamps.

Law: a load's torque is torque on the joint like any other, so that a law that reflects force reflects it too.
A clamped joint does not move, whatever torque that takes; that torque is reflected as well.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..errors import UsageError
from ..linear.loop import Delayed, Loop
from .port import ports_of, sites


class Load(NamedTuple):
    """A spring and a damper to a fixed point, at each joint of a site.

    Attributes:
        K_nm_rad: stiffness, N m/rad; infinite: a clamp.
        B_nm_s_rad: damping, N m s/rad.
    """

    K_nm_rad: float = 0.0
    B_nm_s_rad: float = 0.0


FREE = Load()
CLAMPED = Load(math.inf)

_Terms = list[tuple[float, Array, Array]]
"""Delay, s; what of the state; what of the torques."""


def loaded(loop: Loop, loads: Mapping[str, Load]) -> Loop:
    """Returns the loop with loads at some of its sites; clamped ones have neither ports nor angles any more.

    Args:
        loop: the loop.
        loads: by the name of the site.

    Raises:
        UsageError: no such site, a negative stiffness or damping, or several clamps that reflect each other.
    """
    for site, load in loads.items():
        if site not in sites(loop):
            raise UsageError(f"no site {site!r} at the ports; there are {', '.join(sites(loop))}")
        if not (load.K_nm_rad >= 0.0 and 0.0 <= load.B_nm_s_rad < math.inf):
            raise UsageError(f"a load needs stiffness and damping of at least 0, not {load}")
    for site, load in loads.items():
        loop = _clamped(loop, site) if math.isinf(load.K_nm_rad) else _sprung(loop, site, load)
    return loop


def _angles(loop: Loop, ports: list[int]) -> list[int]:
    return [loop.names.index(loop.inputs[port].replace(".tau", ".q")) for port in ports]


def _sprung(loop: Loop, site: str, load: Load) -> Loop:
    """Returns the loop with u = -K q - B qd at a site, besides what else pushes there."""
    ports = ports_of(loop, site)
    back = np.zeros((len(loop.inputs), len(loop.names)))
    back[ports] = load.B_nm_s_rad * loop.C[ports]
    back[ports, _angles(loop, ports)] += load.K_nm_rad
    delayed = tuple(late._replace(A=late.A - late.B @ back) for late in loop.delayed)
    return loop._replace(A=loop.A - loop.B @ back, delayed=delayed)


def _clamped(loop: Loop, site: str) -> Loop:
    """Returns the loop with a site's joints fixed: its torque is what keeps their accelerations zero."""
    ports = ports_of(loop, site)
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
    return Loop(
        tuple(loop.names[n] for n in kept),
        tuple(loop.inputs[n] for n in others),
        tuple(loop.outputs[n] for n in others),
        A,
        B,
        loop.C[np.ix_(others, kept)],
        tuple(Delayed(T, A, B) for T, (A, B) in left.items() if A.any() or B.any()),
    )


def _add(found: dict[float, tuple[Array, Array]], delay_s: float, A: Array, B: Array) -> None:
    """Adds a term to those of its delay; sums of delays are one where they differ by rounding alone."""
    key = round(delay_s, 12)
    if key in found:
        A, B = found[key][0] + A, found[key][1] + B
    found[key] = (A, B)

"""What goes into `Site.step` and what comes out: a tick, its arrivals, its record.

Law (L3): the record of a tick names its inputs; which sample was used is an output.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

MAX_ARRIVALS = 4096
"""Most arrivals that one tick takes in; a driver leaves the rest for the next one."""


class Mode(IntEnum):
    """What a site is doing in a tick. Edges: RUN -> DIVERGED (a limit was passed), and no other."""

    RUN = 1
    DIVERGED = 2


class Arrival(NamedTuple):
    """One sample as it came in.

    Attributes:
        peer: index of the peer among the site's links.
        tick: the sample's tick, at the peer's rate.
        q: the peer's joint angles, rad.
        qd: its joint velocities, rad/s.
        latency_us: how long it was under way, microseconds; telemetry, enters no formula.
    """

    peer: int
    tick: int
    q: Sequence[float]
    qd: Sequence[float]
    latency_us: int = 0


class Tick(NamedTuple):
    """One call of `Site.step`: the tick's number and what came in since the one before, in order."""

    k: int
    arrivals: Sequence[Arrival] = ()


class Output(NamedTuple):
    """The record of one tick: the state AT t_k and what followed from it, never the advanced state.

    Attributes:
        tick: k.
        t_ns: nominal time, ns since the epoch.
        mode: what the site was doing.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        q_des: reference q_id, Eq. (6), rad.
        qd_des: its derivative, rad/s.
        tau: control torque, Eq. (13), N m.
        tau_x: exogenous torque in the sign of Eq. (8), N m; the torque ON the arm is its negative.
        theta_hat: estimate of the parameters.
        used: tick of the sample in use, per peer in scenario order; -1 before the first.
        rx_crc: CRC-32 of this tick's arrivals as the step took them in, little-endian
            (peer i64, tick i64, q f64s, qd f64s) each; shows a changed input at its own tick.
    """

    tick: int
    t_ns: int
    mode: Mode
    q: list[float]
    qd: list[float]
    q_des: list[float]
    qd_des: list[float]
    tau: list[float]
    tau_x: list[float]
    theta_hat: list[float]
    used: list[int]
    rx_crc: int


class LinkCounts(NamedTuple):
    """What one link has counted since the start: samples accepted, and of those late, duplicate, refused."""

    accepted: int
    late: int
    duplicate: int
    refused: int


def diverged_text(site: str, output: Output) -> str:
    """Says that a site has left the physics, where and how fast."""
    speed = max(abs(v) for v in output.qd)
    return f"{site} diverged at t = {output.t_ns * 1e-9:.3f} s: a joint moves at {speed:.4g} rad/s"

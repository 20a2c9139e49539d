"""Ticks: their nominal times, and the input and the record of one.

Invariant (L1): tick k of a loop of `rate_hz` lies at `k * 10^9 // rate_hz` nanoseconds after the epoch;
integers, one rounding rule, no drift. Invariant (L3): the record of a tick names its inputs; the sample
in use is an output.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from .delay import LinkModel
from .jit import leaf
from .two_link_arm import JOINTS

NS_PER_S = 1_000_000_000
BUCKETS_PER_S = 20
"""Where a run is told by its largest values, it is by those of so many equal parts of each second."""


@leaf
def tick_ns(tick: int, rate_hz: int) -> int:
    """Returns the nominal time of a tick, ns since the epoch."""
    return tick * 1_000_000_000 // rate_hz


@leaf
def first_tick_at(due_ns: int, rate_hz: int) -> int:
    """Returns the first tick whose nominal time is at or after `due_ns`, ns since the epoch.

    Exact: floor(k 10^9 / rate) >= due holds just where k 10^9 >= due * rate.
    """
    return -(-due_ns * rate_hz // 1_000_000_000)


MAX_ARRIVALS = 4096
"""Most arrivals that one tick takes in; a driver leaves the rest for the next one."""


_NOTHING = (0.0,) * JOINTS


class Mode(IntEnum):
    """What a site is doing in a tick.

    RUN follows its peers. A stale peer leads to HOLD (stays at the last reference) or BRAKE (stays where
    the arm is); a fresh sample from there to RETURN (goes back to the peers over a time) and so to RUN.
    DIVERGED passed a limit, from any of them, and is final.
    """

    RUN = 1
    DIVERGED = 2
    HOLD = 3
    BRAKE = 4
    RETURN = 5


class Arrival(NamedTuple):
    """One sample as it came in.

    Attributes:
        peer: index of the peer among the site's links.
        tick: the sample's tick, at the peer's rate.
        q: the peer's joint angles, rad.
        qd: its joint velocities, rad/s.
        latency_us: how long it was under way, microseconds; telemetry, enters no formula.
        tau_x: the exogenous torque of the peer's record, N m; laws that reflect force use it.
    """

    peer: int
    tick: int
    q: Sequence[float]
    qd: Sequence[float]
    latency_us: int = 0
    tau_x: Sequence[float] = _NOTHING


class DominanceRamp(NamedTuple):
    """A site's shares in its peers, changed linearly over a time.

    Attributes:
        start_ns: when it begins, ns since the epoch.
        end_ns: when it is complete, not before `start_ns`.
        alpha: the shares at its end, per peer in scenario order.
    """

    start_ns: int
    end_ns: int
    alpha: tuple[float, ...]


class CoreChange(NamedTuple):
    """A change ordered from outside.

    Attributes:
        text: how the record names it; whoever reads the record makes the same command of it.
        peer: the link that it changes, by its peer's index; -1 where it changes the shares.
        model: what that link does from then on.
        ramp: how the shares change.
    """

    text: str
    peer: int = -1
    model: LinkModel | None = None
    ramp: DominanceRamp | None = None


class PlantState(NamedTuple):
    """What an arm outside of the program was measured to do: q, rad, and qd, rad/s."""

    q: Sequence[float]
    qd: Sequence[float]


class TickInput(NamedTuple):
    """One call of `Site.step`.

    Attributes:
        k: its number.
        arrivals: what came in since the one before, in order.
        commands: what was ordered.
        measured: of a site whose plant is external, its arm now; None: as it was.
    """

    k: int
    arrivals: Sequence[Arrival] = ()
    commands: Sequence[CoreChange] = ()
    measured: PlantState | None = None


class TickRecord(NamedTuple):
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
            (peer i64, tick i64, q f64s, qd f64s) each, and behind them, where the law reflects force, their
            tau_x; shows a changed input at its own tick.
        cmd: texts of the commands that it took in.
        mem: what the site remembers besides: empty in RUN and DIVERGED, else the pose that it holds, rad,
            and when it began to return, ns since the epoch (0 where it does not yet). A site with a law of
            somebody's own has these always, and the law's memory behind them.
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
    cmd: list[str]
    mem: list[float]


class LinkCounts(NamedTuple):
    """What one link has counted since the start.

    Attributes:
        accepted: samples that came.
        late: of those, the ones that came after they were due.
        duplicate: the ones that were there already.
        refused: the ones whose stamp was out of range.
        lost: the ones that the link's model lost.
        superseded: the ones never used, because a newer one was released before or with them.
        copies: duplicates that the link's model made.
    """

    accepted: int
    late: int
    duplicate: int
    refused: int
    lost: int
    superseded: int
    copies: int


def describe_mode(site: str, output: TickRecord) -> str:
    """Says that a site does something else from this tick on."""
    doing = {
        Mode.RUN: "follows its peers",
        Mode.HOLD: "holds its reference: a peer is stale",
        Mode.BRAKE: "holds its pose: a peer is stale",
        Mode.RETURN: "returns to its peers",
    }
    return f"{site} {doing[output.mode]} from t = {output.t_ns * 1e-9:.3f} s"


def describe_divergence(site: str, output: TickRecord) -> str:
    """Says that a site has left the physics, where and how fast."""
    speed = max(abs(v) for v in output.qd)
    return f"{site} diverged at t = {output.t_ns * 1e-9:.3f} s: a joint moves at {speed:.4g} rad/s"

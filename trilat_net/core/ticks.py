"""Ticks: their nominal times, and the input and the record of one.

Invariant (L1): tick k of a loop of `rate_hz` lies at `k * 10^9 // rate_hz` nanoseconds after
the epoch; integers, one rounding rule, no drift. Invariant (L3): the record of a tick names its
inputs; the sample in use is an output.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from .delay import LinkModel
from .jit import leaf

NS_PER_S = 1_000_000_000
BUCKETS_PER_S = 20
"""A run that is reduced to peaks keeps them for so many equal parts of each second."""


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


class Mode(IntEnum):
    """The mode of a site in a tick.

    RUN follows the peers. A stale peer leads to HOLD (stays at the last reference) or BRAKE
    (stays where the arm is); a fresh sample from there to RETURN (goes back to the peers over a
    time) and so to RUN. Under the rule `glide` a site is WAITING for its peers before it goes
    to them, see `session_life`. DIVERGED, past a limit, is final. Under `glide` a limit leads
    to FAULT and an order to STOPPED in its place: the arm comes to rest, as in HOLD, and only
    another order leads back to WAITING.
    """

    RUN = 1
    DIVERGED = 2
    HOLD = 3
    BRAKE = 4
    RETURN = 5
    WAITING = 6
    FAULT = 7
    STOPPED = 8


class LifeReason(IntEnum):
    """Why a site under the rule `glide` last changed its mode, see `session_life`."""

    START = 0
    PEERS_HERE = 1
    ALIGNED = 2
    PEER_SILENT = 3
    PEERS_BACK = 4
    ALIGN_LIMIT = 5
    LIMIT_Q = 6
    LIMIT_QD = 7
    NOT_FINITE = 8
    STOP = 9
    ENABLE = 10
    RESET = 11
    OVERRUN = 12
    ARM_SILENT = 13
    ARM_BACK = 14
    RELEASED = 15
    HELD = 16
    DROPPED = 17
    RESTORED = 18
    RESUMED = 19


class LifeOrder(IntEnum):
    """What a site under the rule `glide` is ordered to do, see `session_life`.

    STOP leads to STOPPED, from where ENABLE leads back; RESET leads back from FAULT. The others
    come from the site itself, at an arm outside of the program: ARM_SILENT and ARM_LOST say
    that no measurement came for a time, ARM_BACK that one came again, RELEASED that nobody
    holds its dead-man switch, HELD that somebody does again, OVERRUN that it did not make some
    ticks. Of several in one tick, the one of the highest number counts, and OVERRUN besides.
    """

    ENABLE = 1
    RESET = 2
    HELD = 3
    ARM_BACK = 4
    ARM_SILENT = 5
    RELEASED = 6
    STOP = 7
    ARM_LOST = 8
    OVERRUN = 9


class Arrival(NamedTuple):
    """One sample as it arrived.

    Attributes:
        peer: index of the peer among the site's links.
        tick: the sample's tick, at the peer's rate.
        q: the peer's joint angles, rad.
        qd: its joint velocities, rad/s.
        latency_us: its time under way, microseconds; telemetry, enters no formula.
        tau_x: the exogenous torque of the peer's record, N m; laws that reflect force use it.
        ch: what the peer's law sent to this site besides, see `LawChannel.select_for_peer`.
    """

    peer: int
    tick: int
    q: Sequence[float]
    qd: Sequence[float]
    latency_us: int = 0
    tau_x: Sequence[float] = ()
    ch: Sequence[float] = ()


class DominanceRamp(NamedTuple):
    """A linear change of a site's dominance factors over a time.

    Attributes:
        start_ns: when it begins, ns since the epoch.
        end_ns: when it is complete, not before `start_ns`.
        alpha: the factors at its end, per peer in scenario order.
    """

    start_ns: int
    end_ns: int
    alpha: tuple[float, ...]


class CoreChange(NamedTuple):
    """A change ordered from outside.

    Attributes:
        text: its text in the record, from which every reader derives the same change.
        peer: the link that it changes, by its peer's index; -1 for a change of the dominance
            factors.
        model: the link's model from then on.
        ramp: the change of the dominance factors.
        order: what the site is to do.
        skipped: with OVERRUN, the ticks before this one that the site did not make.
    """

    text: str
    peer: int = -1
    model: LinkModel | None = None
    ramp: DominanceRamp | None = None
    order: LifeOrder | None = None
    skipped: int = 0


class PlantState(NamedTuple):
    """What was measured of an arm outside of the program.

    Attributes:
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        tau_x: torque of operator and environment, N m, in the sign of the record; empty: none
            is measured.
        bodies: poses of what else is in its scene, as a record has them.
    """

    q: Sequence[float]
    qd: Sequence[float]
    tau_x: Sequence[float] = ()
    bodies: Sequence[float] = ()


class TickInput(NamedTuple):
    """One call of `Site.step`.

    Attributes:
        k: its number.
        arrivals: the samples since the tick before, in order.
        commands: the changes ordered since then.
        measured: the present state of an external plant; None: unchanged.
        hand: what a live hand does in this tick, see `live_hand.empty_hand_vector`; empty: nobody holds
            the arm.
    """

    k: int
    arrivals: Sequence[Arrival] = ()
    commands: Sequence[CoreChange] = ()
    measured: PlantState | None = None
    hand: Sequence[float] = ()


class TickRecord(NamedTuple):
    """The record of one tick: the state AT t_k and what followed from it, never the advanced
    state.

    Attributes:
        tick: k.
        t_ns: nominal time, ns since the epoch.
        mode: the site's mode.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        q_des: reference q_id, Eq. (6), rad.
        qd_des: its derivative, rad/s.
        tau: control torque, Eq. (13), N m.
        tau_x: exogenous torque in the sign of Eq. (8), N m; the torque ON the arm is its
            negative.
        theta_hat: estimate of the parameters.
        used: tick of the sample in use, per peer in scenario order; -1 before the first.
        rx_crc: CRC-32 of this tick's arrivals as the step took them in, little-endian (peer
            i64, tick i64, q f64s, qd f64s) each, followed by their tau_x if the law reflects
            force; shows a changed input at its own tick.
        cmd: texts of the changes that it took in.
        mem: the rest of the site's memory: empty in RUN and DIVERGED, else the pose that it
            holds, rad, and the time at which it began to return, ns since the epoch (0 before).
            A site with a user's law always has these, and the law's memory after them. Under
            the rule `glide` a site always has what `session_life` remembers in their place.
        x: in task space what the site shares of its end effector: its place, m, and
            orientation; else empty.
        xd: its derivative, m/s and rad/s.
        wrench: what tau_x amounts to there, N and N m.
        ch: what the site's law sends besides, see `LawChannel`.
        hand: what a live hand does in this tick, see `live_hand`; empty if the site has none.
        bodies: poses of the bodies of its plant, seven numbers each: x, y, z in the arm's base
            frame, m, and the unit quaternion w, x, y, z; empty if it has none.
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
    x: Sequence[float] = ()
    xd: Sequence[float] = ()
    wrench: Sequence[float] = ()
    ch: Sequence[float] = ()
    hand: Sequence[float] = ()
    bodies: Sequence[float] = ()

    def shared(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        """Returns the motion and the exogenous torque that peers get, in the coordinates that
        sites share.
        """
        return (self.x, self.xd, self.wrench) if self.x else (self.q, self.qd, self.tau_x)


class LinkCounts(NamedTuple):
    """Counts of one link since the start.

    Attributes:
        accepted: samples that arrived.
        late: of those, the ones that arrived after they were due.
        duplicate: the ones that had arrived before.
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


_REASONS = {
    LifeReason.PEER_SILENT: "a peer is silent",
    LifeReason.ALIGN_LIMIT: "its peers are farther away than align_limit_rad",
    LifeReason.LIMIT_Q: "a joint is beyond q_min_rad or q_max_rad",
    LifeReason.LIMIT_QD: "a joint is faster than qd_limit_rad_s",
    LifeReason.NOT_FINITE: "a number is no longer finite",
    LifeReason.STOP: "it was ordered to stop",
    LifeReason.ENABLE: "it was enabled",
    LifeReason.RESET: "its fault was reset",
    LifeReason.OVERRUN: "it missed ticks",
    LifeReason.ARM_SILENT: "its arm is silent",
    LifeReason.RELEASED: "its dead-man switch is not held",
    LifeReason.HELD: "its dead-man switch is held",
    LifeReason.DROPPED: "a lost peer has no share any more",
    LifeReason.RESTORED: "a peer that was lost has its share again",
}


def find_life_reason(output: TickRecord) -> LifeReason:
    """Returns why a site under the rule `glide` last changed its mode, as its record remembers
    it.
    """
    return LifeReason(int(output.mem[2 * len(output.q_des) + 1]))


class LifeAlarm(NamedTuple):
    """A mode of a site that nobody may overlook.

    Attributes:
        word: the mode, in capitals.
        reason: why.
        advice: what to do, at a terminal.
        order: the order that ends it, "enable" or "reset", where a page has a button for it; ""
            if none does.
        before: what has to be done before that order, a clause that ends in ", then"; "" if
            nothing.
    """

    word: str
    reason: str
    advice: str
    order: str = ""
    before: str = ""

    def __str__(self) -> str:
        return f"{self.word}: {self.reason}; {self.advice}"


_REMEDIES = {
    LifeReason.LIMIT_Q: "bring the joint back within its limits, then",
    LifeReason.ARM_SILENT: "let the program of the arm send again, then",
}
_ONCE_HEARD = "it goes on by itself once all its peers are heard"


def find_alarm(
    session: str,
    site: str,
    mode: str,
    mem: Sequence[float],
    shared: int,
    lost: Sequence[str] = (),
) -> LifeAlarm | None:
    """Returns the alarm of a site under the rule `glide`, by a record with `shared`
    coordinates; or None.

    `lost` are the peers that it goes on without.
    """
    try:
        reason = LifeReason(int(mem[2 * shared + 1]))
    except (IndexError, ValueError, OverflowError):  # of another rule, or a stranger's
        return None
    if mode not in ("fault", "stopped", "hold") and (mode, reason) != (
        "waiting",
        LifeReason.ALIGN_LIMIT,
    ):
        names = ", ".join(lost)
        advice = f"the share comes back by itself once {names} is there again"
        return (
            LifeAlarm(f"WITHOUT {names}", "the others have its share", advice) if lost else None
        )
    order = {"fault": "reset", "stopped": "enable"}.get(mode, "")
    if reason is LifeReason.RELEASED:  # the dead-man switch ends it, and no order
        order = ""
    before = _REMEDIES.get(reason, "") if mode == "fault" else ""
    advice = (
        f"{before} trilat {order} --session {session} {site}".lstrip() if order else _ONCE_HEARD
    )
    advice = {
        (mode, LifeReason.RELEASED): "hold the switch",
        ("hold", LifeReason.ARM_SILENT): "it goes on by itself once its arm is heard",
        ("hold", LifeReason.ALIGN_LIMIT): "bring the arms closer together",
        ("waiting", LifeReason.ALIGN_LIMIT): "bring the arms closer together",
    }.get((mode, reason), advice)
    why = _REASONS.get(reason, reason.name.lower().replace("_", " "))
    return LifeAlarm(word=mode.upper(), reason=why, advice=advice, order=order, before=before)


def describe_mode(
    site: str, output: TickRecord, *, glides: bool = False, law_failure: Exception | None = None
) -> str:
    """Returns the text of the event that a site changes its mode; one that `glides` says why."""
    doing = {
        Mode.RUN: "follows its peers",
        Mode.HOLD: "holds its reference",
        Mode.BRAKE: "holds its pose",
        Mode.RETURN: "returns to its peers",
        Mode.WAITING: "waits for its peers",
        Mode.FAULT: "is in FAULT",
        Mode.STOPPED: "is STOPPED",
    }
    why = _REASONS.get(find_life_reason(output), "") if glides else "a peer is stale"
    if law_failure is not None and find_life_reason(output) is LifeReason.NOT_FINITE:
        why = str(law_failure)
    regrouped = glides and find_life_reason(output) in (LifeReason.DROPPED, LifeReason.RESTORED)
    aligns = output.mode is Mode.RETURN and not regrouped
    if aligns or output.mode is Mode.RUN:
        why = ""
    return f"{site} {doing[output.mode]} from t = {output.t_ns * 1e-9:.3f} s{': ' * bool(why)}{why}"


def describe_divergence(site: str, output: TickRecord) -> str:
    """Returns the text of the event that a site diverged."""
    speed = max(abs(v) for v in output.qd)
    return (
        f"{site} diverged at t = {output.t_ns * 1e-9:.3f} s: a joint moves at {speed:.4g} rad/s"
    )

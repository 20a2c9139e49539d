"""Defines the inputs, results and nominal times of an arm's control periods (ticks).

The inputs of a tick are commands and the samples that arrived from other arms. Its result is
stored as a record. With a loop at 1000 Hz, for example, tick 250 is due 0.25 s after the start
of the session. This module also defines the reasons and alarms that are logged when an arm
starts or stops following the others.

Invariant (laws L1 and L3 of docs/develop/design.md):
    - The nominal time of tick k is `k * 10^9 // rate_hz` nanoseconds after the start of the
      session, where `rate_hz` is the rate of the loop. It is computed from k afresh in each
      tick, to prevent rounding errors from accumulating.
    - The record of a tick contains all inputs of the tick.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from ...records import NS_PER_S as NS_PER_S
from ...records import Arrival as Arrival
from ...records import Mode as Mode
from ...records import TickRecord as TickRecord
from ..links.delay import LinkModel
from .jit import leaf

BUCKETS_PER_S = 20
"""Number of intervals per second for which a run without a log keeps the largest values."""


@leaf
def tick_ns(tick: int, rate_hz: int) -> int:
    """Returns the nominal start of a tick, ns since the start of the session.

    The result is exact in integers: tick * 10^9 // rate_hz. For example, tick 3 at 1000 Hz
    starts at 3000000 ns.

    Args:
        tick: Number of the tick.
        rate_hz: Tick rate, Hz.
    """
    return tick * 1_000_000_000 // rate_hz


@leaf
def first_tick_at(due_ns: int, rate_hz: int) -> int:
    """Returns the number of the first tick that starts at or after a given time.

    This is the smallest k with k / rate_hz >= due_ns / 10^9. The result is exact, because
    floor(k 10^9 / rate) >= due if and only if k 10^9 >= due rate. Negating the numerator makes
    the integer division round up.

    Args:
        due_ns: The time, ns since the epoch (the common start of the session).
        rate_hz: Tick rate, Hz.
    """
    return -(-due_ns * rate_hz // 1_000_000_000)


MAX_ARRIVALS = 4096
"""Largest number of arrivals per tick. Drivers hold back any others until the next tick."""


class LifeReason(IntEnum):
    """Reason why an arm last changed its mode, for example that another arm fell silent.

    Reasons exist only under the rule `glide`, where an arm waits for the others and comes to
    rest while one of them is silent. `session_life` explains this rule.
    """

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
    STOP_RELEASED = 20

    @classmethod
    def of_record(cls, output: TickRecord) -> "LifeReason":
        """Reads from a record why the arm last changed its mode, for example to HOLD.

        The site must use the rule `glide`, because the record contains the reason only under
        this rule.

        Args:
            output: Record of the arm.
        """
        shared = len(output.q_des)
        return cls(int(output.mem[2 * shared + 1]))


RELEASE_REASONS = (LifeReason.RELEASED, LifeReason.STOP_RELEASED)
"""Reasons for a stop in which brakes hold the arm because its dead-man switch was released."""


class LifeOrder(IntEnum):
    """An order to a site, for example to stop the arm.

    Orders exist only under the rule `glide`, which `session_life` explains. Users give these
    orders:

    - STOP: bring the arm to rest, in the mode STOPPED.
    - ENABLE: leave the mode STOPPED.
    - RESET: leave the mode FAULT.

    The site gives itself the remaining orders, most of which apply to a real arm:

    - ARM_SILENT: the arm has not sent its position for a short time.
    - ARM_LOST: the arm has not sent its position for a long time.
    - ARM_BACK: the arm is sending its position again.
    - RELEASED: nobody holds the dead-man switch.
    - HELD: somebody holds the dead-man switch again.
    - OVERRUN: the site was too slow and missed control periods.

    If several orders arrive in the same period, the one with the highest number takes
    precedence. OVERRUN is applied in addition.
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


class DominanceRamp(NamedTuple):
    """A gradual change of the dominance factors of one site, linear in time.

    Attributes:
        start_ns: Start of the change, ns since the start of the session.
        end_ns: End of the change, ns since the start of the session, not before `start_ns`.
        alpha: Factors at the end of the ramp, one per peer in scenario order.
    """

    start_ns: int
    end_ns: int
    alpha: tuple[float, ...]


class CoreChange(NamedTuple):
    """A change to a running site, in the form read by the control loop.

    The change concerns the model of a network link or the dominance factors, or it is an order,
    for example to stop.

    Attributes:
        text: Description stored in the record, from which any reader can reconstruct the
            change.
        peer: Index of the peer whose link changes; -1 for other changes.
        model: New model of the link.
        ramp: Change of the dominance factors.
        order: Order to the site.
        skipped: With OVERRUN, the number of ticks that the site missed just before this change.
    """

    text: str
    peer: int = -1
    model: LinkModel | None = None
    ramp: DominanceRamp | None = None
    order: LifeOrder | None = None
    skipped: int = 0

    @classmethod
    def give_order(cls, text: str, order: str, skipped: int) -> "CoreChange":
        """Creates a change that gives an order to a site.

        Args:
            text: Description stored in the record.
            order: Name of the order in a log, such as "stop", see `LifeOrder`.
            skipped: With "overrun", the number of ticks that the site missed just before this
                change.
        """
        return cls(text, order=LifeOrder[order.upper()], skipped=skipped)


class PlantState(NamedTuple):
    """Measured state of an arm that the program does not simulate itself, such as a real arm.

    Attributes:
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        tau_x: Negative of the torque exerted ON the arm by operator and environment, N m. Empty
            if the arm does not measure this torque.
        bodies: Poses of the other bodies of the scene, as in `TickRecord.bodies`.
    """

    q: Sequence[float]
    qd: Sequence[float]
    tau_x: Sequence[float] = ()
    bodies: Sequence[float] = ()


class TickInput(NamedTuple):
    """All external inputs that can influence one control period, as passed to `Site.step`.

    It contains the time, the messages and the measurements, so the same input always produces
    the same results.

    Attributes:
        k: Number of the period.
        arrivals: Samples that arrived since the previous period, in order of arrival.
        commands: Changes to settings that were ordered since the previous period.
        measured: Measured state of a real or otherwise external arm. None if there is no new
            measurement.
        hand: Action of a person or program on the arm in this period, see `live_hand`. Empty if
            nobody holds the arm.
    """

    k: int
    arrivals: Sequence[Arrival] = ()
    commands: Sequence[CoreChange] = ()
    measured: PlantState | None = None
    hand: Sequence[float] = ()


class LinkCounts(NamedTuple):
    """Message counts of one network link since the start, such as late and lost messages.

    The messages are samples from the peer at the other end of the link.

    Attributes:
        accepted: Samples that arrived.
        late: Samples that arrived after they were due.
        duplicate: Samples that arrived again.
        refused: Samples that arrived, but whose time stamp was out of range.
        lost: Samples that arrived, but were dropped by the loss model of the link.
        superseded: Samples that were never used, because a newer one was released before them
            or in the same tick.
        copies: Duplicates produced by the model of the link.
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
    LifeReason.STOP_RELEASED: "it was ordered to stop, and its dead-man switch was released",
    LifeReason.DROPPED: "a lost peer has no share any more",
    LifeReason.RESTORED: "a peer that was lost has its share again",
}


class LifeAlarm(NamedTuple):
    """An alarm that explains why an arm does not follow all others, and what to do about it.

    It is created by `LifeAlarm.find`. Web pages and terminals show it as long as the site needs
    attention.

    Attributes:
        word: The mode in capitals, or, for example, "WITHOUT m2" if the peer m2 is lost.
        reason: Reason for the alarm.
        advice: Remedy, for a user at a terminal.
        order: Order that ends the alarm ("enable" or "reset"), for which a page has a button.
            Empty if no order ends the alarm.
        before: Remedy that must come before the order, as a clause that ends in ", then". Empty
            if none is needed.
    """

    word: str
    reason: str
    advice: str
    order: str = ""
    before: str = ""

    def __str__(self) -> str:
        return f"{self.word}: {self.reason}; {self.advice}"

    @classmethod
    def find(
        cls,
        session: str,
        site: str,
        mode: str,
        mem: Sequence[float],
        shared: int,
        lost: Sequence[str] = (),
    ) -> "LifeAlarm | None":
        """Returns the alarm that explains why an arm is not following the other arms.

        Only an arm under the rule `glide` has alarms. Under this rule, it comes to rest while a
        peer is silent. After a fault or a stop, it waits for a person's order before following
        again. The alarm is derived from the arm's record.

        Args:
            session: Name of the session, which is quoted in the advice.
            site: Name of the site, which is quoted in the advice.
            mode: Mode of the site, as named in the record.
            mem: Internal state of the site (field `mem` of the record), which includes the
                reason for the mode.
            shared: Number of coordinates that sites share, which determines how `mem` is
                divided.
            lost: Names of the peers without which the site continues.

        Returns:
            The alarm, or None if the site needs no attention or the record is from a site that
            does not use this rule.
        """
        try:
            reason = LifeReason(int(mem[2 * shared + 1]))
        except (IndexError, ValueError, OverflowError):
            # The site is under another rule, or another program wrote the record.
            return None
        is_too_far = (mode, reason) == ("waiting", LifeReason.ALIGN_LIMIT)
        if mode not in _ALARM_MODES and not is_too_far:
            return _find_lost_alarm(lost)

        # Only the dead-man switch can end a release, not an order.
        order = "" if reason is LifeReason.RELEASED else _ORDERS.get(mode, "")
        before = _REMEDIES.get(reason, "") if mode == "fault" else ""
        advice = _DEFAULT_ADVICE
        if order:
            advice = f"{before} trilat {order} --session {session} {site}".lstrip()
        advice = _ADVICE.get((mode, reason), advice)
        text = _REASONS.get(reason, reason.name.lower().replace("_", " "))
        return LifeAlarm(
            word=mode.upper(), reason=text, advice=advice, order=order, before=before
        )


_REMEDIES = {
    LifeReason.LIMIT_Q: "bring the joint back within its limits, then",
    LifeReason.ARM_SILENT: "let the program of the arm send again, then",
}
_ORDERS = {"fault": "reset", "stopped": "enable"}
"""The order that ends each mode."""
_ALARM_MODES = ("fault", "stopped", "hold")
_ADVICE = {
    ("stopped", LifeReason.RELEASED): "hold the switch",
    ("fault", LifeReason.RELEASED): "hold the switch",
    ("hold", LifeReason.RELEASED): "hold the switch",
    ("hold", LifeReason.ARM_SILENT): "it continues by itself once its arm sends again",
    ("hold", LifeReason.ALIGN_LIMIT): "bring the arms closer together",
    ("waiting", LifeReason.ALIGN_LIMIT): "bring the arms closer together",
}
_DEFAULT_ADVICE = "it continues by itself once samples arrive from all its peers"


def _find_lost_alarm(lost: Sequence[str]) -> LifeAlarm | None:
    """Returns the alarm of an arm that continues without lost peers, or None if none is lost.

    The weight (share) of the lost peer is divided among the other peers. The `word` of the
    alarm is, for example, "WITHOUT m2". No order is needed, because a lost peer regains its
    share automatically when it returns.

    Args:
        lost: Names of the lost peers.
    """
    if not lost:
        return None
    names = ", ".join(lost)
    return LifeAlarm(
        word=f"WITHOUT {names}",
        reason="its share is divided among the other peers",
        advice=f"the share is given back automatically once samples arrive from {names} again",
    )


_ACTIVITIES = {
    Mode.RUN: "follows its peers",
    Mode.HOLD: "holds its reference",
    Mode.BRAKE: "holds its pose",
    Mode.RETURN: "returns to its peers",
    Mode.WAITING: "waits for its peers",
    Mode.FAULT: "is in FAULT",
    Mode.STOPPED: "is STOPPED",
}


def describe_mode(
    site: str, output: TickRecord, *, glides: bool, law_failure: Exception | None = None
) -> str:
    """Writes the sentence that a site logs when its mode changes.

    The sentence states what the arm does, since when, and why, for example "s holds its
    reference from t = 1.250 s: a peer is stale". A peer is stale if no sample has arrived from
    it for too long.

    No reason is given for the modes RETURN and RUN, which follow as soon as samples of all
    peers arrive, unless the arm returns because a peer was dropped or restored. For an arm that
    exceeded its speed limit (DIVERGED), the sentence states the speed.

    Args:
        site: Name of the site.
        output: Record of the first tick in the new mode.
        glides: True if the site uses the rule `glide`, where an arm comes to rest while a peer
            is silent. Its record then contains the reason for the mode. Without this rule, the
            mode can only change because a peer is stale or the arm diverged.
        law_failure: The most recent error of the user's control law, or None. Under the rule
            `glide`, it is stated as the reason if it caused the mode.
    """
    if output.mode is Mode.DIVERGED:
        speed = max(abs(v) for v in output.qd)
        t_s = output.t_ns * 1e-9
        return f"{site} diverged at t = {t_s:.3f} s: a joint moves at {speed:.4g} rad/s"
    if glides:
        reason = LifeReason.of_record(output)
        text = _REASONS.get(reason, "")
    else:
        reason = None
        text = "a peer is stale"
    # The law's error is more informative than the reason that a number is not finite.
    if law_failure is not None and LifeReason.of_record(output) is LifeReason.NOT_FINITE:
        text = str(law_failure)

    is_regrouped = reason in (LifeReason.DROPPED, LifeReason.RESTORED)
    is_usual_return = output.mode is Mode.RETURN and not is_regrouped
    needs_no_reason = is_usual_return or output.mode is Mode.RUN
    if needs_no_reason:
        text = ""
    event = f"{site} {_ACTIVITIES[output.mode]} from t = {output.t_ns * 1e-9:.3f} s"
    return f"{event}: {text}" if text else event

"""Defines the inputs, the results and the times of the control periods (ticks) of an arm.

The inputs of a tick are the samples (states) that arrived from other arms, and commands. The
stored result of a tick is called its record. For example, with a loop at 1000 Hz, tick 250 is
due 0.25 s after the start of the session. This module also defines the reasons and alarms that
a log states when an arm starts or stops following the others.

Invariant (laws L1 and L3 of docs/develop/design.md):
    - The nominal time of tick k is `k * 10^9 // rate_hz` nanoseconds after the start of the
      session, where `rate_hz` is the rate of the loop. It is computed from k anew in each tick,
      so that rounding errors do not add up.
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
"""Number of intervals per second for which a run without a log keeps its largest values."""


@leaf
def tick_ns(tick: int, rate_hz: int) -> int:
    """Returns the nominal start of a control period (tick), ns since the start of the session.

    It is exact in integers: tick * 10^9 // rate_hz. For example, tick 3 at 1000 Hz starts at
    3000000 ns.

    Args:
        tick: Number of the tick (control period).
        rate_hz: Tick rate, Hz.
    """
    return tick * 1_000_000_000 // rate_hz


@leaf
def first_tick_at(due_ns: int, rate_hz: int) -> int:
    """Returns the number of the first control period (tick) that begins at or after a time.

    It is the smallest k with k / rate_hz >= due_ns / 10^9. The result is exact: floor(k 10^9 /
    rate) >= due if and only if k 10^9 >= due rate. The division of the negative number rounds
    up.

    Args:
        due_ns: The time, ns since the epoch, the common start of the session.
        rate_hz: Tick rate, Hz.
    """
    return -(-due_ns * rate_hz // 1_000_000_000)


MAX_ARRIVALS = 4096
"""Largest number of arrivals in a tick. A driver keeps further arrivals for the next tick."""


class LifeReason(IntEnum):
    """Reason why an arm last changed its mode, for example that another arm fell silent.

    The reasons only exist under the rule `glide`, by which an arm waits for the others and
    comes to rest while one of them is silent. `session_life` explains this rule.
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


RELEASE_REASONS = (LifeReason.RELEASED, LifeReason.STOP_RELEASED)
"""Reasons of a stop in which brakes hold the arm, because its dead-man switch was released."""


class LifeOrder(IntEnum):
    """Order to a site, the process that runs one arm.

    Orders only exist under the rule `glide`, which `session_life` explains. Users give these
    orders:

    - STOP: bring the arm to rest, in the mode STOPPED.
    - ENABLE: leave the mode STOPPED.
    - RESET: leave the mode FAULT.

    The site gives the other orders itself. Most of them concern a real arm:

    - ARM_SILENT: the arm has not sent its position for a short time.
    - ARM_LOST: the arm has not sent its position for a long time.
    - ARM_BACK: the arm sends its position again.
    - RELEASED: nobody holds the dead-man switch.
    - HELD: somebody holds the dead-man switch again.
    - OVERRUN: the site was too slow and missed control periods.

    If several orders arrive in the same period, the order with the highest number counts.
    OVERRUN is applied in addition.
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
    """Gradual change of the weights with which an arm follows the other arms, linear in time.

    The weights are called dominance factors, and belong to one site, the process of an arm.

    Attributes:
        start_ns: Start of the change, ns since the start of the session.
        end_ns: End of the change, ns since the start of the session, not before `start_ns`.
        alpha: Factors at the end, per peer in scenario order.
    """

    start_ns: int
    end_ns: int
    alpha: tuple[float, ...]


class CoreChange(NamedTuple):
    """Change that takes effect in an arm's process while it runs, as the control loop reads it.

    It changes the model of a network link or the weights with which the arm follows the others,
    or it gives an order such as stop.

    Attributes:
        text: Text in the record, from which all readers derive the same change.
        peer: Index of the peer whose link changes; -1 for other changes.
        model: New model of the link.
        ramp: Change of the dominance factors.
        order: Order to the site.
        skipped: With OVERRUN, the number of ticks before this one that the site missed.
    """

    text: str
    peer: int = -1
    model: LinkModel | None = None
    ramp: DominanceRamp | None = None
    order: LifeOrder | None = None
    skipped: int = 0

    @classmethod
    def give_order(cls, text: str, order: str, skipped: int) -> "CoreChange":
        """Creates the change by which a site receives an order.

        Args:
            text: Text in the record.
            order: Name of the order in a log, such as "stop", see `LifeOrder`.
            skipped: With "overrun", the number of ticks before this one that the site missed.
        """
        return cls(text, order=LifeOrder[order.upper()], skipped=skipped)


class PlantState(NamedTuple):
    """Measured state of an arm that the program does not simulate itself, such as a real arm.

    Attributes:
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        tau_x: Negative of the torque with which operator and environment act ON the arm, N m.
            Empty if the arm does not measure this torque.
        bodies: Poses of the other bodies of the scene, as in `TickRecord.bodies`.
    """

    q: Sequence[float]
    qd: Sequence[float]
    tau_x: Sequence[float] = ()
    bodies: Sequence[float] = ()


class TickInput(NamedTuple):
    """All external inputs that may influence one period of the control loop.

    `Site.step` receives this object. It contains the time, the messages and the measurements,
    so the same input always gives the same results.

    Attributes:
        k: Number of the period.
        arrivals: Samples (states of other arms) that arrived since the previous period, in
            order.
        commands: Changes of the settings that were ordered since the previous period.
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
    """Counts of messages on one network link since the start, such as late and lost messages.

    A link leads from another arm's process (peer) to this one. A message is a sample, the state
    of the peer in one control period.

    Attributes:
        accepted: Samples that arrived.
        late: Arrived samples that came after they were due.
        duplicate: Arrived samples that had already arrived before.
        refused: Arrived samples whose stamp was out of range.
        lost: Arrived samples that the link's model of losses dropped.
        superseded: Samples that were never used, because a newer sample was released before
            them or in the same tick.
        copies: Duplicates that the link's model produced.
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


def find_life_reason(output: TickRecord) -> LifeReason:
    """Returns why an arm last changed its mode, for example from RUN to HOLD, from its log.

    The arm must be under the rule `glide`, by which it comes to rest while another arm is
    silent. Only then does the log contain the reason.

    Args:
        output: Record of the arm, the result of one control period.
    """
    shared = len(output.q_des)
    return LifeReason(int(output.mem[2 * shared + 1]))


class LifeAlarm(NamedTuple):
    """Alarm that tells people why an arm does not follow the others, and what they can do.

    `LifeAlarm.find` creates it. Pages and terminals show it as long as the arm stays in this
    mode.

    Attributes:
        word: The mode, in capitals.
        reason: Reason for the mode.
        advice: Remedy, for a user at a terminal.
        order: Order that ends the alarm, "enable" or "reset", for which a page has a button.
            Empty if no order ends the alarm.
        before: Remedy that has to precede the order, a clause that ends in ", then". Empty if
            no remedy is needed.
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
        """Returns the alarm that tells people why an arm does not follow the other arms.

        Only an arm under the rule `glide` has alarms. Under this rule, it comes to rest while
        another arm (peer) is silent. After a fault or a stop, it waits for an order of a person
        before it follows again. All facts come from the arm's record, the stored result of one
        control period.

        Args:
            session: Name of the session, which the advice of the alarm quotes.
            site: Name of the site, which the advice quotes.
            mode: Mode of the site, as the record names it.
            mem: Numbers that the site keeps from tick to tick, the field `mem` of the record.
                They contain the reason for the mode.
            shared: Number of coordinates that sites share, by which `mem` is divided.
            lost: Names of the peers without which the site continues.

        Returns:
            The alarm. None if the site needs no attention, or if the record is not from a site
            under this rule.
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
"""The order that ends a mode."""
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
    """Returns the alarm of an arm that continues without lost arms, or None if no arm is lost.

    The weight (share) of the lost arm is divided among the other arms (peers). The `word` of
    the alarm is, for example, "WITHOUT m2". No order is needed, because a lost arm gets its
    share back automatically when it returns.

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
    """Writes the sentence with which a site reports a change of its mode in the log.

    A site is the process that runs one arm, and its peers are the other sites. The sentence
    states what the arm does, since when, and why, for example "s holds its reference from t =
    1.250 s: a peer is stale". A peer is stale if no sample has arrived from it for too long.

    No reason is given for the modes RETURN and RUN, which follow as soon as samples of all
    peers arrive, unless the arm returns because a peer was dropped or restored. The sentence
    about an arm that left its speed limit (DIVERGED) states the speed.

    Args:
        site: Name of the site.
        output: Record of the first tick (period of the control loop) in the mode.
        glides: True if the site is under the rule `glide`, by which an arm comes to rest while
            a peer is silent. Its record then contains the reason for the mode. Without this
            rule, the mode can only change because of a stale peer or because the arm diverged.
        law_failure: Error with which the user's control law failed last, or None. It is given
            as the reason if the mode is due to this failure. It is only used under the rule
            `glide`.

    Returns:
        The sentence.
    """
    if output.mode is Mode.DIVERGED:
        speed = max(abs(v) for v in output.qd)
        t_s = output.t_ns * 1e-9
        return f"{site} diverged at t = {t_s:.3f} s: a joint moves at {speed:.4g} rad/s"
    if glides:
        reason = find_life_reason(output)
        text = _REASONS.get(reason, "")
    else:
        reason = None
        text = "a peer is stale"
    # The error of the law says more than the reason that a number is not finite.
    if law_failure is not None and find_life_reason(output) is LifeReason.NOT_FINITE:
        text = str(law_failure)

    is_regrouped = reason in (LifeReason.DROPPED, LifeReason.RESTORED)
    is_usual_return = output.mode is Mode.RETURN and not is_regrouped
    needs_no_reason = is_usual_return or output.mode is Mode.RUN
    if needs_no_reason:
        text = ""
    event = f"{site} {_ACTIVITIES[output.mode]} from t = {output.t_ns * 1e-9:.3f} s"
    return f"{event}: {text}" if text else event

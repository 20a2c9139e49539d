"""The site's side of an external arm (`plant = "external"`) and of its dead-man switch.

`ExternalArm` receives the measurements of the arm's joints, and `DeadManSwitch` the messages of
whoever holds the switch. Both turn silence into orders to the site.

Invariant:
    - No received message can raise out of the loop, and the inbox is bounded.
    - Only the newest measurement counts. The site does not start without a measurement, holds
      after `HELD_SILENCE_NS` without any, and is in fault after `SILENCE_LIMIT_NS`.
    - A measurement that the arm cannot have reached since the previous one is dropped and does
      not count as received.
    - A switch that sends nothing for `SWITCH_SILENCE_NS` is not held.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trilat_net.core.site_step import Site
from trilat_net.core.ticks import LifeReason, Mode, PlantState
from trilat_net.errors import SessionError, WireError
from trilat_net.files import find_page
from trilat_net.net.bus import StampedInbox
from trilat_net.net.clock import Clock
from trilat_net.net.requests import ArmEnable, ArmMeasurement
from trilat_net.net.wire import decode
from trilat_net.scenario.scenario_types import SiteOrder

from .site_loop import STEP_MARGIN_RAD

MEASUREMENTS_KEPT = 64
"""Capacity of the inbox: older measurements are useless."""
HELD_SILENCE_NS = 30_000_000
"""Silence of the arm after which the site holds."""
SILENCE_LIMIT_NS = 200_000_000
"""Silence of the arm after which the site is in fault."""
SWITCH_SILENCE_NS = 100_000_000
"""Silence of a dead-man switch after which the switch counts as released."""
STARTS_KEPT = 64
"""Number of programs at a switch whose state is kept.

If there are more, a program that does not hold the switch is forgotten first.
"""
START_POSE_TOLERANCE_RAD = 0.01
"""Largest distance of the arm from its `q0_rad` at the start that is not reported."""
POLL_NS = 5_000_000
_MAX_POLL_GAP_NS = 20_000_000
"""Largest silence that one poll can add.

A site that was suspended cannot know which messages it would have received in the meantime.
"""


class ExternalArm:
    """The measurements of one external arm.

    Args:
        site: the site of the arm.
        ring: the inbox of the measurements.
        clock: the clock of this machine.
        dropped: counts dropped measurements by reason.
        address: where the site waits for measurements, for messages to the user.

    Attributes:
        newest: the newest accepted measurement; None before the first.
        accepted: the number of accepted measurements.
    """

    def __init__(
        self,
        site: Site,
        ring: StampedInbox[bytes],
        clock: Clock,
        dropped: Counter[str],
        address: str,
    ) -> None:
        self.newest: PlantState | None = None
        self.accepted = 0
        self._site = site.name
        self._layout = site.layout
        self._ring = ring
        self._dropped = dropped
        self._speed_limits = site.speed_limits
        self._accepted_ns = 0
        self._reported_order = ""
        self._clock = clock
        self._address = address
        self._boot = -1
        self._n = -1
        self._is_bound = False
        self._is_counting = False
        self._silent_ns = 0
        self._polled_ns: int | None = None

    def wait_for_first(
        self, stopped: Callable[[], bool], give_up_ns: int, say: Callable[[str], None]
    ) -> bool:
        """Waits for the first measurement; returns False if `stopped` returns True first.

        Raises:
            SessionError: no measurement arrived before `give_up_ns`.
        """
        say(f"waiting for its arm on {self._address}")
        reported: set[str] = set()
        while not stopped():
            self.poll()
            if self.newest is not None:
                return True
            # A reason such as "of 6 joints; the scenario has 7" tells the user what to change.
            mismatches = [reason for reason in self._dropped if reason.startswith("of ")]
            for reason in mismatches:
                if reason not in reported:
                    reported.add(reason)
                    say(f"its arm sends measurements {reason}")
            now_ns = self._clock.monotonic_ns()
            if now_ns > give_up_ns:
                dropped = ", ".join(
                    f"{count} {reason}" for reason, count in self._dropped.items()
                )
                raise SessionError(
                    f"{self._site} waited in vain for its arm: "
                    f"no measurement came on {self._address}"
                    + (f"; dropped: {dropped}" if dropped else "")
                    + f"; see {find_page('external-arm.md')}"
                )
            self._clock.sleep_until(now_ns + POLL_NS)
        return False

    def bind(self, q0_rad: Sequence[float]) -> str:
        """Accepts measurements only from the present program from now on.

        Args:
            q0_rad: the start pose that the peers assume, rad, one angle per joint.

        Returns:
            A warning if the arm is off that start pose, else "".
        """
        self.poll()
        self._is_bound = True
        self._silent_ns = 0
        pose = self.newest.q if self.newest else q0_rad
        distance_rad = max(abs(a - b) for a, b in zip(pose, q0_rad, strict=True))
        warning = (
            f"its arm stands {distance_rad:.3g} rad off q0_rad, "
            "which its peers take for its start: their references will jump"
        )
        return warning if distance_rad > START_POSE_TOLERANCE_RAD else ""

    def poll(self) -> None:
        """Accepts the measurements that have arrived, and updates the arm's silence."""
        now_ns = self._clock.monotonic_ns()
        accepted_before = self.accepted
        while (message := self._ring.poll()) is not None:
            payload, _ = message
            self._accept(payload)
        passed_ns = 0
        if self._polled_ns is not None:
            passed_ns = min(now_ns - self._polled_ns, _MAX_POLL_GAP_NS)
        has_arrived = self.accepted > accepted_before
        self._silent_ns = 0 if has_arrived else self._silent_ns + passed_ns
        self._polled_ns = now_ns

    def pop_order(self, mode: Mode) -> SiteOrder:
        """Returns the order that follows from the arm's silence, "" if nothing has changed.

        Args:
            mode: the present mode of the site. "arm_lost" is repeated until the site is in
                fault.
        """
        reported = self._reported_order
        self._reported_order = ""
        if self._silent_ns > SILENCE_LIMIT_NS:
            self._reported_order = "arm_lost"
            return "" if reported == "arm_lost" and mode is Mode.FAULT else "arm_lost"
        if self._silent_ns > HELD_SILENCE_NS:
            self._reported_order = "arm_silent"
            return "" if reported else "arm_silent"
        return "arm_back" if reported == "arm_silent" else ""

    def _accept(self, payload: bytes) -> None:
        try:
            message = decode(payload, ArmMeasurement, layout=self._layout)
        except WireError as error:
            self._dropped[error.reason] += 1
            return
        # After so long a silence the arm's program may have been restarted with a new boot.
        is_lost = self._silent_ns > SILENCE_LIMIT_NS
        is_other_boot = self._is_bound and not is_lost and message.boot != self._boot
        if message.site != self._site or is_other_boot:
            self._dropped["stranger"] += 1
            return
        if message.boot != self._boot:
            self._boot = message.boot
            self._n = message.n - 1
        if message.n <= self._n:
            self._dropped["old measurement"] += 1
            return
        now_ns = self._clock.monotonic_ns()
        elapsed_s = (now_ns - self._accepted_ns) * 1e-9
        if self._is_bound and not self._is_plausible(message.q, elapsed_s):
            self._dropped["implausible measurement"] += 1
            return
        self._accepted_ns = now_ns
        if self._is_counting and message.n > self._n + 1:
            self._dropped["missing measurement"] += message.n - self._n - 1
        self._is_counting = self._is_bound
        self._n = message.n
        self.newest = PlantState(message.q, message.qd, message.tau_x)
        self.accepted += 1

    def _is_plausible(self, q: Sequence[float], elapsed_s: float) -> bool:
        """True if no joint has moved farther than its speed limit allows."""
        if self.newest is None:
            return True
        reach = [limit * elapsed_s + STEP_MARGIN_RAD for limit in self._speed_limits]
        steps = zip(q, self.newest.q, reach, strict=True)
        return all(abs(angle - previous) <= limit for angle, previous, limit in steps)


@dataclass
class _Holder:
    """One start of a program at the switch.

    Attributes:
        n: the number of its newest message.
        pressed_ns: when its newest message "held" arrived; None while it does not hold.
        counts: False if it still holds the switch since before another holder released it. It
            then has to release the switch and press it again.
    """

    n: int = -1
    pressed_ns: int | None = None
    counts: bool = True


class DeadManSwitch:
    """The dead-man switch of one arm; the arm stops if any holder releases it or falls silent.

    All other holders then have to release the switch and press it again. The age of a message
    is measured on this machine's clock from its arrival, so the switch of a site that was
    suspended is not held.

    Args:
        site: the site of the arm.
        ring: the inbox of the switch's messages, with the times of their arrival.
        clock: the clock of this machine.
        dropped: counts dropped messages by reason.
    """

    def __init__(
        self, site: str, ring: StampedInbox[bytes], clock: Clock, dropped: Counter[str]
    ) -> None:
        self._site = site
        self._ring = ring
        self._clock = clock
        self._dropped = dropped
        self._programs: dict[int, _Holder] = {}
        self._was_released = False

    def _list_holders(self) -> list[_Holder]:
        return [
            program
            for program in self._programs.values()
            if program.counts and program.pressed_ns is not None
        ]

    def _is_silent(self, holder: _Holder) -> bool:
        if holder.pressed_ns is None:
            return True
        return self._clock.monotonic_ns() - holder.pressed_ns > SWITCH_SILENCE_NS

    @property
    def held(self) -> bool:
        """True if there is a holder and no holder is silent."""
        holders = self._list_holders()
        return bool(holders) and not any(map(self._is_silent, holders))

    def poll(self) -> None:
        """Accepts the arrived messages, and releases the switch for silent holders."""
        while (message := self._ring.poll()) is not None:
            payload, received_ns = message
            self._accept(payload, received_ns)
        self._release([holder for holder in self._list_holders() if self._is_silent(holder)])

    def pop_order(self, mode: Mode, reason: LifeReason) -> SiteOrder:
        """Returns the order that follows from the switch, "" if there is none.

        Args:
            mode: the present mode of the site.
            reason: the reason of that mode.
        """
        was_released = self._was_released
        self._was_released = False
        if was_released or not self.held:
            return "" if mode in (Mode.STOPPED, Mode.FAULT) else "released"
        return "held" if (mode, reason) == (Mode.STOPPED, LifeReason.RELEASED) else ""

    def _release(self, released: Sequence[_Holder]) -> None:
        """Ends the hold of some holders; all others stop counting until they press again."""
        if not released:
            return
        for holder in released:
            holder.pressed_ns = None
        for other in self._list_holders():
            other.counts = False
        self._was_released = True

    def _accept(self, payload: bytes, received_ns: int) -> None:
        try:
            message = decode(payload, ArmEnable)
        except WireError as error:
            self._dropped[error.reason] += 1
            return
        if message.site != self._site:
            self._dropped["stranger"] += 1
            return
        if message.boot not in self._programs and len(self._programs) >= STARTS_KEPT:
            self._forget_program()
        program = self._programs.setdefault(message.boot, _Holder())
        if message.n <= program.n:
            self._dropped["old switch message"] += 1
            return
        program.n = message.n
        if message.held:
            program.pressed_ns = received_ns
            return
        if program.counts and program.pressed_ns is not None:
            self._release([program])
        program.pressed_ns = None
        program.counts = True

    def _forget_program(self) -> None:
        """Forgets the oldest program that does not hold the switch, else the oldest of all."""
        idle = [boot for boot, program in self._programs.items() if program.pressed_ns is None]
        oldest = idle[0] if idle else next(iter(self._programs))
        del self._programs[oldest]

"""Measurements of an external arm (`plant = "external"`) and its dead-man switch, as its site
receives them.

Invariant: no arriving measurement can raise out of the loop, and the inbox is bounded. The
newest measurement counts; a site does not begin without one, holds when none arrive for a
moment, and is in fault when none arrive any more. One that the arm cannot have made since the
last is dropped, and is none. A switch of which nothing is heard is not held.
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
"""After a longer silence the site holds."""
SILENCE_LIMIT_NS = 200_000_000
"""After a longer one it is in fault."""
SWITCH_SILENCE_NS = 100_000_000
"""A dead-man switch of which nothing is heard for longer is not held."""
STARTS_KEPT = 64
"""So many programs at a switch are told apart by their messages; of more one is forgotten,
rather one that does not hold it.
"""
START_POSE_TOLERANCE_RAD = 0.01
"""A larger distance of the arm from its `q0_rad` at the start is reported."""
POLL_NS = 5_000_000
_MAX_POLL_GAP_NS = 20_000_000
"""Silence that one poll can add: a site that slept cannot know what it would have received."""


class ExternalArm:
    """The measurements of one arm.

    Attributes:
        taken: number of measurements taken; the others are counted in `dropped`, by reason.
    """

    def __init__(
        self,
        site: Site,
        ring: StampedInbox[bytes],
        clock: Clock,
        dropped: Counter[str],
        place: str,
    ) -> None:
        self.newest: PlantState | None = None
        self.taken = 0
        self._site = site.name
        self._layout = site.layout
        self._ring = ring
        self._dropped = dropped
        self._speed_limits = site.speed_limits
        self._taken_ns = 0
        self._told = ""
        self._clock = clock
        self._place = place
        self._boot = self._n = -1
        self._bound = self._counting = False
        self._silent_ns = 0
        self._polled_ns: int | None = None

    def wait_for_first(
        self, stopped: Callable[[], bool], give_up_ns: int, say: Callable[[str], None]
    ) -> bool:
        """Waits for the first measurement; False if `stopped` comes first.

        Raises:
            SessionError: none arrived in time.
        """
        say(f"waiting for its arm on {self._place}")
        told: set[str] = set()
        while not stopped():
            self.poll()
            if self.newest is not None:
                return True
            for reason in [
                one for one in self._dropped if one.startswith("of ") and one not in told
            ]:
                told.add(reason)  # as in: of 6 joints; the scenario has 7
                say(f"its arm sends measurements {reason}")
            now_ns = self._clock.monotonic_ns()
            if now_ns > give_up_ns:
                dropped = ", ".join(
                    f"{count} {reason}" for reason, count in self._dropped.items()
                )
                raise SessionError(
                    f"{self._site} waited in vain for its arm: no measurement came on {self._place}"
                    + (f"; dropped: {dropped}" if dropped else "")
                    + f"; see {find_page('external-arm.md')}"
                )
            self._clock.sleep_until(now_ns + POLL_NS)
        return False

    def bind(self, q0_rad: Sequence[float]) -> str:
        """Accepts from now on only the program that sends now.

        Returns a warning if the arm is off the start pose that the peers assume, else "".
        """
        self.poll()
        self._bound = True
        self._silent_ns = 0
        pairs = zip(self.newest.q if self.newest else q0_rad, q0_rad, strict=True)
        off_rad = max(abs(a - b) for a, b in pairs)
        told = (
            f"its arm stands {off_rad:.3g} rad off q0_rad, which its peers take for its start"
        )
        return (
            f"{told}: their references will jump" if off_rad > START_POSE_TOLERANCE_RAD else ""
        )

    def poll(self) -> None:
        """Takes the measurements that have arrived."""
        now_ns = self._clock.monotonic_ns()
        before = self.taken
        while (message := self._ring.poll()) is not None:
            self._take(message[0])
        passed_ns = (
            0 if self._polled_ns is None else min(now_ns - self._polled_ns, _MAX_POLL_GAP_NS)
        )
        self._silent_ns = 0 if self.taken > before else self._silent_ns + passed_ns
        self._polled_ns = now_ns

    def take_order(self, mode: Mode) -> SiteOrder:
        """Returns what its arm's silence asks of the site, which is in some mode; "": nothing
        new.
        """
        told = self._told
        self._told = ""
        if self._silent_ns > SILENCE_LIMIT_NS:
            self._told = "arm_lost"
            return "" if told == "arm_lost" and mode is Mode.FAULT else "arm_lost"
        if self._silent_ns > HELD_SILENCE_NS:
            self._told = "arm_silent"
            return "" if told else "arm_silent"
        return "arm_back" if told == "arm_silent" else ""

    def _take(self, payload: bytes) -> None:
        try:
            message = decode(payload, ArmMeasurement, layout=self._layout)
        except WireError as error:
            self._dropped[error.reason] += 1
            return
        lost = self._silent_ns > SILENCE_LIMIT_NS  # its program may have been started anew
        if message.site != self._site or (
            self._bound and not lost and message.boot != self._boot
        ):
            self._dropped["stranger"] += 1
            return
        if message.boot != self._boot:
            self._boot = message.boot
            self._n = message.n - 1
        if message.n <= self._n:
            self._dropped["old measurement"] += 1
            return
        now_ns = self._clock.monotonic_ns()
        if self._bound and not self._is_plausible(message.q, (now_ns - self._taken_ns) * 1e-9):
            self._dropped["implausible measurement"] += 1
            return
        self._taken_ns = now_ns
        if self._counting and message.n > self._n + 1:
            self._dropped["missing measurement"] += message.n - self._n - 1
        self._counting = self._bound
        self._n = message.n
        self.newest = PlantState(message.q, message.qd, message.tau_x)
        self.taken += 1

    def _is_plausible(self, q: Sequence[float], passed_s: float) -> bool:
        if self.newest is None:
            return True
        way = [limit * passed_s + STEP_MARGIN_RAD for limit in self._speed_limits]
        return all(abs(a - b) <= most for a, b, most in zip(q, self.newest.q, way, strict=True))


@dataclass
class _Holder:
    """A start of a program at the switch.

    Attributes:
        n: of its newest message.
        pressed_ns: when it last said that it is held; None: it is not.
        counts: False while it is held since before another one let go.
    """

    n: int = -1
    pressed_ns: int | None = None
    counts: bool = True


class DeadManSwitch:
    """The dead-man switch of one arm: whoever holds it and lets go, or is silent, stops the
    arm.

    Who held it besides has then to let go and press anew. Its age is taken on the own clock
    from where a message came in, so that a site that slept is not held.
    """

    def __init__(
        self, site: str, ring: StampedInbox[bytes], clock: Clock, dropped: Counter[str]
    ) -> None:
        self._site = site
        self._ring = ring
        self._clock = clock
        self._dropped = dropped
        self._programs: dict[int, _Holder] = {}
        self._was_let_go = False

    def _holders(self) -> list[_Holder]:
        return [
            one for one in self._programs.values() if one.counts and one.pressed_ns is not None
        ]

    def _is_silent(self, one: _Holder) -> bool:
        return (
            one.pressed_ns is None
            or self._clock.monotonic_ns() - one.pressed_ns > SWITCH_SILENCE_NS
        )

    @property
    def held(self) -> bool:
        """True if all that hold it said so a moment ago, and there is one."""
        holders = self._holders()
        return bool(holders) and not any(map(self._is_silent, holders))

    def poll(self) -> None:
        """Takes in the messages that have arrived."""
        while (message := self._ring.poll()) is not None:
            self._take(*message)
        self._let_go([one for one in self._holders() if self._is_silent(one)])

    def take_order(self, mode: Mode, reason: LifeReason) -> SiteOrder:
        """Returns what the switch asks of its site, which is in some mode for a reason; "":
        nothing.
        """
        was_let_go = self._was_let_go
        self._was_let_go = False
        if was_let_go or not self.held:
            return "" if mode in (Mode.STOPPED, Mode.FAULT) else "released"
        return "held" if (mode, reason) == (Mode.STOPPED, LifeReason.RELEASED) else ""

    def _let_go(self, released: Sequence[_Holder]) -> None:
        """Takes note of holders that let go or are silent: the others count no more until they
        press anew.
        """
        if not released:
            return
        for one in released:
            one.pressed_ns = None
        for other in self._holders():
            other.counts = False
        self._was_let_go = True

    def _take(self, payload: bytes, came_ns: int) -> None:
        try:
            message = decode(payload, ArmEnable)
        except WireError as error:
            self._dropped[error.reason] += 1
            return
        if message.site != self._site:
            self._dropped["stranger"] += 1
            return
        if message.boot not in self._programs and len(self._programs) >= STARTS_KEPT:
            idle = (boot for boot, one in self._programs.items() if one.pressed_ns is None)
            del self._programs[next(idle, next(iter(self._programs)))]
        one = self._programs.setdefault(message.boot, _Holder())
        if message.n <= one.n:
            self._dropped["old switch message"] += 1
            return
        one.n = message.n
        if message.held:
            one.pressed_ns = came_ns
            return
        if one.counts and one.pressed_ns is not None:
            self._let_go([one])
        one.pressed_ns = None
        one.counts = True

"""A device at the arm of a site: its motion leads the arm, and it renders what the arm gives
back.

Invariant:
    - Only changes of the device's place move the target, and only while its clutch is pressed:
      a state that is not finite, or a jump, moves nothing, and neither does a device that comes
      back.
    - The target stays within the arm's reach, however often the clutch is pressed: a motion of
      the device that leads out of it is lost, and one that leads back in acts at once.
    - Whoever has let go, by the device's silence too, takes hold again by pressing the clutch
      anew.
    - The force is that of the newest record, turned, scaled and limited as the scenario says;
      it is zero while the clutch is open, or the record is old.
    - The hand has no heartbeat but the device's: a loop that hangs is a silent hand.
"""

import math
import operator
from collections import deque
from collections.abc import Callable

import numpy as np

from trilat_net.core.live_hand import GRIP_NS, SILENCE_NS, HandReach
from trilat_net.errors import count_nouns
from trilat_net.net.arm_client import Hand
from trilat_net.net.clock import Clock
from trilat_net.scenario.operators.kernel_operators import DeviceSettings

from .devices import Device, DeviceState, Vector

RETRY_NS = 1_000_000_000
LEAST_S = 0.005
MOST_S = 0.05
"""Within these a jump is judged by the time since the state before: machines hand over late."""
TRIPS_KEPT = 60_000


class DeviceHand:
    """A device that leads the arm of a live hand.

    Args:
        hand: the connection to the site.
        device: what is held.
        how: how the device leads the arm, and what it renders.
        clock: the clock of this machine.
        reach: where the target may be.

    Attributes:
        states, jumps, unreadable: how many states came, and how many of them moved nothing for
        that reason.
        trips_ns: from the place of the device to the force that it has caused.
    """

    def __init__(
        self, hand: Hand, device: Device, how: DeviceSettings, clock: Clock, reach: HandReach
    ) -> None:
        self._hand = hand
        self._device = device
        self._how = how
        self._clock = clock
        self._reach = reach
        self._rows = how.rows(len(hand.pose))
        self.states = self.jumps = self.unreadable = 0
        self.trips_ns = deque[int](maxlen=TRIPS_KEPT)
        self._asked = deque[tuple[int, int]](maxlen=TRIPS_KEPT)
        self._period_ns = 1_000_000_000 // device.rate_hz
        self._due_ns = 0
        self.let_go()

    def let_go(self) -> None:
        """Lets go of the arm, until the clutch is pressed anew."""
        self._hand.release()
        self._target: list[float] = []
        self._place: Vector | None = None
        self._was_pressed = True
        self._since_ns = 0
        self._came_ns = self._clock.monotonic_ns()
        self._asked.clear()

    def serve(self) -> None:
        """Reads a state, moves the target by it, and renders a force; takes a period of the
        device.
        """
        state = self._device.read()
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._came_ns > SILENCE_NS:
            self.let_go()  # the device, or this process, was away
        self.states += 1
        if all(map(math.isfinite, (*state.position_m, *state.velocity_m_s))):
            self._follow(state, now_ns)
        else:
            self.unreadable += 1
        if self._target:
            self._asked.append((self._hand.move(*self._target), now_ns))
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)
        self._clock.sleep_until(self._due_ns)  # the site may have answered then
        self._device.render(self._find_force())
        self._measure_trips()

    def _follow(self, state: DeviceState, now_ns: int) -> None:
        how = self._how
        before = self._place
        passed_s = (now_ns - self._came_ns) * 1e-9
        self._place = state.position_m
        self._came_ns = now_ns
        pressed = state.buttons.get(how.clutch, False)
        closes = pressed and not self._was_pressed
        self._was_pressed = pressed
        if state.buttons.get(how.release, False):
            self.let_go()
        elif closes:
            self._target = self._target or list(self._hand.pose)
            self._since_ns = now_ns
        elif not pressed:
            self._since_ns = 0
        elif self._since_ns and before is not None:
            moved = list(map(operator.sub, state.position_m, before))
            if math.hypot(*moved) > how.jump_m_s * min(max(passed_s, LEAST_S), MOST_S):
                self.jumps += 1
            else:
                steps = (how.scale * sum(map(operator.mul, row, moved)) for row in self._rows)
                moved_target = list(map(operator.add, self._target, steps))
                self._target = list(self._reach.find_nearest(moved_target))

    def _find_force(self) -> Vector:
        """Returns the reaction of the arm; of a clutch that has just been closed it grows."""
        if not (self._since_ns and self._hand.fresh and self._hand.holds):
            return 0.0, 0.0, 0.0
        closed = min(1.0, (self._clock.monotonic_ns() - self._since_ns) / GRIP_NS)
        force = [-self._how.force_scale * closed * one for one in self._hand.force]
        share = min(1.0, self._how.force_limit_n / max(math.hypot(*force), 1e-9))
        x, y, z = (
            share * sum(map(operator.mul, force, column))
            for column in zip(*self._rows, strict=True)
        )
        return x, y, z

    def _measure_trips(self) -> None:
        number = self._hand.number
        now_ns = self._clock.monotonic_ns()
        while self._asked and self._asked[0][0] <= number:
            self.trips_ns.append(now_ns - self._asked.popleft()[1])

    def describe(self) -> str:
        """Returns what came of it, in a line."""
        told = (
            f"{count_nouns(self.states, 'state')} of the device, dropped "
            f"{count_nouns(self.jumps, 'jump')}, {self.unreadable} unreadable"
        )
        if not self.trips_ns:
            return told
        p50, p99 = np.percentile(self.trips_ns, [50, 99]) / 1e6
        return f"{told}; from its place to the force of it p50 {p50:.1f} ms, p99 {p99:.1f} ms"

    def run(self, stopped: Callable[[], bool], say: Callable[[str], None]) -> None:
        """Leads the arm until the end; says once each time that the device is lost, and is
        there.
        """
        there: bool | None = None
        while not (stopped() or self._hand.over):
            try:
                with self._device:
                    while not (stopped() or self._hand.over):
                        self.serve()
                        if not there:
                            say(
                                f"the device is there: its button {self._how.clutch!r} takes hold"
                            )
                        there = True
            except OSError as problem:
                self.let_go()
                if there is not False:
                    say(f"{problem}; the arm is let go, and the device is tried again")
                there = False
                self._clock.sleep_until(self._clock.monotonic_ns() + RETRY_NS)

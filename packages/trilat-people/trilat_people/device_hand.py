"""Moves an arm with a haptic input device and renders the force of the arm on the device.

The operator moves the device while pressing its clutch button. The target of the arm then moves
by the same distance, rotated and scaled according to the scenario. While the clutch is
released, the target stays in place and the operator can return the device to its middle
position. The reaction force of the arm is rendered on the device.

Invariant:
    - The target is moved only by changes in device position while the clutch is pressed.
      Non-finite positions, jumps, and the position of a newly connected device are ignored,
      since they are not motions of the operator.
    - The target never leaves the reachable region of the arm. Motion of the device beyond this
      region is discarded, so moving back moves the arm immediately.
    - If the device stops sending, the arm is released. After any release, the operator must
      press the clutch again, so the arm never starts to move unexpectedly.
    - The rendered force is zero while the clutch is released, or if there is no recent record
      of the arm.
    - A target is sent to the site only after a new device state. If the device or this program
      stops working, the site receives no targets and releases the arm.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from trilat_net.app import Device, DeviceState, Vector
from trilat_net.core import GRIP_NS, SILENCE_NS
from trilat_net.errors import UsageError, count_nouns
from trilat_net.net import Clock, Hand
from trilat_net.scenario import Scenario

RETRY_NS = 1_000_000_000
"""Time between two attempts to connect to the device, in ns."""
_MIN_STATE_GAP_S = 0.005
"""Shortest time between two states assumed in jump detection, in s.

The operating system may deliver states late, and several at once.
"""
_MAX_STATE_GAP_S = 0.05
"""Longest time between two states assumed in jump detection, in s."""
_TRIPS_KEPT = 60_000
"""Number of round trips kept for statistics."""


class DeviceHand:
    """Lets a person move an arm with an input device and feel the force of the arm.

    Created by the process of a live operator, which then calls `run`.

    Args:
        hand: Connection to the site of the arm, through which this object acts as the arm's
            operator.
        device: The input device.
        scenario: Scenario of the session. The device settings of the live operator determine
            how the device moves the arm and how the force is rendered.
        site: Name of the site of the arm.
        clock: Clock of this machine.

    Attributes:
        states: Number of device states (position, velocity, buttons) that were read.
        jumps: Number of states ignored because the position had jumped.
        unreadable: Number of states ignored because they contained NaN or infinity.
        trips_ns: Times from reading a device position to rendering the force caused by it, in
            ns.

    Raises:
        UsageError: The scenario has no live operator that moves the end effector of the arm.
    """

    def __init__(
        self,
        hand: Hand,
        device: Device,
        scenario: Scenario,
        site: str,
        clock: Clock,
    ) -> None:
        operator = scenario.sites[site].find_live_hand(is_open=True)
        if operator is None or operator.mode != "tip":
            raise UsageError(
                "a device can lead only an end effector: "
                f"the hand of {site} must have the mode 'tip'"
            )
        self._hand = hand
        self._device = device
        self._settings = operator.device
        self._clock = clock
        # The target never leaves the region that the arm can reach.
        self._reach = scenario.arms[site].reach
        # The axes of the arm in the coordinates of the device, a row per axis of the arm.
        self._axes = self._settings.rows(len(hand.pose))

        self.states = 0
        self.jumps = 0
        self.unreadable = 0
        self.trips_ns = deque[int](maxlen=_TRIPS_KEPT)
        # Number and sending time of the targets to which the arm has not responded yet.
        self._sent = deque[tuple[int, int]](maxlen=_TRIPS_KEPT)

        self._period_ns = 1_000_000_000 // device.rate_hz
        self._due_ns = 0
        self.release()

    def release(self) -> None:
        """Stops moving the arm: motion of the input device has no further effect.

        The arm stays released until the operator presses the clutch of the device.
        """
        self._hand.release()
        # The target is empty while the arm is not held.
        self._target: list[float] = []
        self._position_m: Vector | None = None
        # A clutch that is still pressed does not count as pressed again.
        self._was_pressed = True
        # Time at which the clutch was pressed. `None` while the clutch is not pressed.
        self._pressed_since_ns: int | None = None
        self._received_ns = self._clock.monotonic_ns()
        self._sent.clear()

    def serve(self) -> None:
        """Runs one control cycle of the device. Must be called repeatedly.

        Reads the position of the device, sends the new target to the site of the arm, and makes
        the device apply the reaction force of the arm to the person.

        Raises:
            OSError: The device does not respond in time, or its connection is lost.
        """
        state = self._device.read()
        now_ns = self._clock.monotonic_ns()
        # If the device was silent, or this process was suspended, the site may have released
        # the arm already.
        if now_ns - self._received_ns > SILENCE_NS:
            self.release()

        self.states += 1
        is_readable = all(map(math.isfinite, (*state.position_m, *state.velocity_m_s)))
        if is_readable:
            self._follow(state, now_ns)
        else:
            self.unreadable += 1
        if self._target:
            number = self._hand.move(*self._target)
            self._sent.append((number, now_ns))

        # The force is read at the end of the period, when the site may have replied already.
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)
        self._clock.sleep_until(self._due_ns)
        self._device.render(self._compute_force())
        self._measure_trips()

    def _follow(self, state: DeviceState, now_ns: int) -> None:
        """Applies the buttons of the device, and moves the target if the clutch is pressed.

        The release button releases the arm. The first time the clutch is pressed, the target
        starts at the current pose of the arm; after that, it starts where it was left.

        Args:
            state: State of the device, with finite values.
            now_ns: Current time on the local clock, in ns.
        """
        settings = self._settings
        previous_position_m = self._position_m
        elapsed_s = (now_ns - self._received_ns) * 1e-9
        self._position_m = state.position_m
        self._received_ns = now_ns
        is_pressed = state.buttons.get(settings.clutch, False)
        was_pressed = self._was_pressed
        self._was_pressed = is_pressed

        if state.buttons.get(settings.release, False):
            self.release()
            return
        if not is_pressed:
            self._pressed_since_ns = None
            return
        if not was_pressed:
            self._pressed_since_ns = now_ns
            if not self._target:
                self._target = list(self._hand.pose)
            return

        # After a release of the arm, the target does not move while the clutch is still
        # pressed.
        is_clutch_active = self._pressed_since_ns is not None
        if is_clutch_active and previous_position_m is not None:
            positions = zip(state.position_m, previous_position_m, strict=True)
            step_m = [new - previous for new, previous in positions]
            self._move_target(step_m, elapsed_s)

    def _move_target(self, step_m: list[float], elapsed_s: float) -> None:
        """Moves the target of the arm by a motion of the device, rotated and scaled.

        Motion above the speed limit of the scenario is treated as a jump, for example after a
        lost message, which is counted and ignored.

        Args:
            step_m: Change of the device's position, in m.
            elapsed_s: Time since the previous state, in s.
        """
        settings = self._settings
        limited_gap_s = min(max(elapsed_s, _MIN_STATE_GAP_S), _MAX_STATE_GAP_S)
        is_jump = math.hypot(*step_m) > settings.jump_m_s * limited_gap_s
        if is_jump:
            self.jumps += 1
            return

        target: list[float] = []
        for coordinate, axis in zip(self._target, self._axes, strict=True):
            step_along_axis = settings.scale * _compute_product(axis, step_m)
            target.append(coordinate + step_along_axis)
        self._target = list(self._reach.find_nearest(target))

    def _compute_force(self) -> Vector:
        """Computes the force to render: the reaction force of the arm in device coordinates.

        The force is faded in over `GRIP_NS` after the clutch is pressed. It is zero if the
        clutch is released, the newest record is too old, or this operator does not hold the
        arm.

        Returns:
            The force, in N.
        """
        no_force = (0.0, 0.0, 0.0)
        if self._pressed_since_ns is None:
            return no_force
        if not (self._hand.fresh and self._hand.holds):
            return no_force

        settings = self._settings
        pressed_ns = self._clock.monotonic_ns() - self._pressed_since_ns
        fade = min(1.0, pressed_ns / GRIP_NS)
        force = [-settings.force_scale * fade * component for component in self._hand.force]
        magnitude = max(math.hypot(*force), 1e-9)  # avoids a division by zero
        reduction = min(1.0, settings.force_limit_n / magnitude)
        device_axes = zip(*self._axes, strict=True)
        # The force is reduced to the limit, and rotated to the axes of the device.
        x, y, z = (reduction * _compute_product(force, axis) for axis in device_axes)
        return x, y, z

    def _measure_trips(self) -> None:
        """Measures the round-trip time from a device position to the rendered force.

        Each target is sent with a number, and the newest record of the site contains the number
        of the target that the arm follows. The round trips of this target and of all earlier
        ones end with the force that was just rendered.
        """
        used_number = self._hand.number
        now_ns = self._clock.monotonic_ns()
        while self._sent:
            number, sent_ns = self._sent[0]
            if number > used_number:
                return
            self._sent.popleft()
            self.trips_ns.append(now_ns - sent_ns)

    def describe(self) -> str:
        """Returns a line of text with statistics of device states and round-trip times.

        A state is ignored if it contains NaN or infinity (unreadable), or if its position is
        farther from the previous position than the speed limit of the scenario allows (a jump).
        A round trip lasts from sending a device position to the arm until the device renders
        the force with which the arm reacts to it.

        Returns:
            The number of states received, of jumps and of unreadable states, and, if a round
            trip was measured, the median and 99th percentile of the round-trip time in ms.
        """
        states = count_nouns(self.states, "state")
        jumps = count_nouns(self.jumps, "jump")
        counts = f"{states} of the device; dropped: {jumps}, {self.unreadable} unreadable"
        if not self.trips_ns:
            return counts

        median_ms, p99_ms = np.percentile(self.trips_ns, [50, 99]) / 1e6
        return (
            f"{counts}; round trip from device position to rendered force: "
            f"p50 {median_ms:.1f} ms, p99 {p99_ms:.1f} ms"
        )

    def run(self, stopped: Callable[[], bool], say: Callable[[str], None]) -> None:
        """Moves the arm with the device until the session ends.

        If the connection to the device is lost, the arm is released and the connection is
        retried until the device is back.

        Args:
            stopped: Function that returns True to end the loop.
            say: Function that prints a line for the user.
        """
        is_present: bool | None = None  # None before the first attempt
        while not (stopped() or self._hand.over):
            try:
                with self._device:
                    while not (stopped() or self._hand.over):
                        self.serve()
                        if not is_present:
                            button = repr(self._settings.clutch)
                            say(f"the device is connected; its button {button} holds the arm")
                        is_present = True

            except OSError as problem:
                self.release()
                if is_present is not False:
                    say(f"{problem}; the arm is released, and the device is tried again")
                is_present = False
                self._clock.sleep_until(self._clock.monotonic_ns() + RETRY_NS)


def _compute_product(first: Sequence[float], second: Sequence[float]) -> float:
    """Returns the dot product of two vectors of equal length."""
    return sum(a * b for a, b in zip(first, second, strict=True))

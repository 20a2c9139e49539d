"""Monitors a real arm and its dead-man switch, and stops the arm if either falls silent.

An arm is external (`plant = "external"` in the scenario) if it is a real arm, or is simulated
by another program. Its driver sends the measured joint positions to the site, which computes
the torque. A dead-man switch is a button that somebody must hold while the arm moves.
`ExternalArm` and `DeadManSwitch` measure how long each of the two has been silent, and derive
commands for the site: to hold the position, to stop, or to continue.

Invariant:
    - A received message cannot raise an error in the control loop. The queue of messages is
      bounded.
    - The site does not start without a measurement. It holds its position after
      `HELD_SILENCE_NS` without a measurement, and enters the mode "fault" after
      `SILENCE_LIMIT_NS`, when the torque would no longer match the state of the arm.
    - A measurement that the arm cannot have reached since the previous one indicates a faulty
      sensor or driver. It is dropped, and does not count as received.
    - A switch that has sent nothing for `SWITCH_SILENCE_NS` counts as released.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trilat_net.core import PlantState, Site
from trilat_net.errors import SessionError, WireError
from trilat_net.files import find_page
from trilat_net.net import ArmEnable, ArmMeasurement, Clock, StampedInbox, decode
from trilat_net.recorded_change import SiteOrder
from trilat_net.records import Mode

from .site_loop import STEP_MARGIN_RAD

MEASUREMENTS_KEPT = 64
"""Number of messages that a queue can hold. Older measurements are useless."""
HELD_SILENCE_NS = 30_000_000
"""Time without a measurement after which the site holds its position, in ns."""
SILENCE_LIMIT_NS = 200_000_000
"""Time without a measurement after which the site enters the mode "fault", in ns."""
SWITCH_SILENCE_NS = 100_000_000
"""Time without a report after which a dead-man switch counts as released, in ns."""
STARTS_KEPT = 64
"""Maximum number of switch programs whose state is stored.

If there are more programs, one that does not hold the switch is removed.
"""
_START_POSE_TOLERANCE_RAD = 0.01
"""Maximum distance of the arm from its `q0_rad` at the start without a warning, in rad."""
POLL_NS = 5_000_000
"""Interval between polls while the site waits for its arm, in ns."""
_MAX_POLL_GAP_NS = 20_000_000
"""Maximum silence that one poll can add, in ns.

If the site itself was suspended, it cannot know which messages it would have received.
"""


class ExternalArm:
    """Receives the measurements of one external arm, and watches for interruptions.

    The joint angles and velocities are sent by the arm's driver. If no measurement arrives for
    some time, the site has to stop the arm.

    Args:
        site: Site of the arm in the simulation kernel.
        ring: Queue of the measurements.
        clock: Clock of this machine.
        dropped: Mapping from reason to number of dropped measurements. The counts are increased
            in place.
        address: Where the site expects the measurements, for messages to the user.

    Attributes:
        newest: Newest accepted measurement. None before the first one.
        accepted: Number of accepted measurements.
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
        self._accepted_ns = 0  # arrival of the newest accepted measurement
        self._reported_order = ""
        self._clock = clock
        self._address = address
        _, session, *_ = address.split("/")
        self._advice = (
            "start the arm's program (in Python an ArmClient), or for a robot in ROS: "
            f"trilat ros2 --session {session} --names FILE"
        )

        # Boot of the driver whose measurements are accepted, and number of its newest
        # measurement.
        self._boot = -1
        self._n = -1

        self._is_bound = False  # True once the session has started, see `bind`
        self._is_counting = False  # True once missing measurements are counted

        # Time without an accepted measurement, and time of the last poll.
        self._silent_ns = 0
        self._polled_ns: int | None = None

    def wait_for_first(
        self, stopped: Callable[[], bool], give_up_ns: int, say: Callable[[str], None]
    ) -> bool:
        """Waits for the first measurement of an external arm, such as a robot.

        The session cannot start without it, because the controller would not know the arm's
        pose.

        Args:
            stopped: Function that returns True to end the wait.
            give_up_ns: Time at which the site gives up, on the local clock, in ns.
            say: Function that prints a line for the user.

        Returns:
            True if a measurement has arrived, or False if `stopped` returned True.

        Raises:
            SessionError: No measurement arrived in time.
        """
        say(f"waiting for its arm on {self._address}: {self._advice}")
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
                raise self._describe_silence()
            self._clock.sleep_until(now_ns + POLL_NS)
        return False

    def _describe_silence(self) -> SessionError:
        """Returns the error for a site that has waited in vain for a measurement of its arm.

        The message says how many measurements were dropped and why. If none has arrived, it
        explains how to connect the arm's driver.
        """
        text = f"{self._site} received no measurement from its arm on {self._address}"
        if self._dropped:
            counts = [f"{count} {reason}" for reason, count in self._dropped.items()]
            text += f"; dropped: {', '.join(counts)}"
        else:
            text += f"; {self._advice}"
        return SessionError(f"{text}; see {find_page('external-arm.md')}")

    def bind(self, q0_rad: Sequence[float]) -> str:
        """Checks the arm's pose, and binds the site to the arm's current driver.

        The site calls this method at the start of the session. Measurements that another
        program sends later are dropped.

        Args:
            q0_rad: Joint angles in rad at which the arm starts according to the scenario. The
                other sites assume this pose.

        Returns:
            A warning if the arm is not in this pose, or an empty string if it is.
        """
        self.poll()
        self._is_bound = True
        self._silent_ns = 0

        pose_rad = self.newest.q if self.newest else q0_rad
        joints = zip(pose_rad, q0_rad, strict=True)
        distance_rad = max(abs(angle - expected) for angle, expected in joints)
        if distance_rad <= _START_POSE_TOLERANCE_RAD:
            return ""

        return (
            f"its arm stands {distance_rad:.3g} rad off q0_rad, "
            "which its peers take for its start: their references will jump"
        )

    def poll(self) -> None:
        """Receives measurements of an external arm, and detects if they stop arriving.

        The control loop calls this method in every tick, and measures the time since the last
        accepted measurement.
        """
        now_ns = self._clock.monotonic_ns()
        accepted_before = self.accepted
        while (message := self._ring.poll()) is not None:
            payload, _ = message
            self._accept(payload)

        passed_ns = 0
        if self._polled_ns is not None:
            # Limited, because a site that was suspended cannot know what it has missed.
            passed_ns = min(now_ns - self._polled_ns, _MAX_POLL_GAP_NS)

        has_arrived = self.accepted > accepted_before
        self._silent_ns = 0 if has_arrived else self._silent_ns + passed_ns
        self._polled_ns = now_ns

    def pop_order(self, mode: Mode) -> SiteOrder:
        """Returns the command with which the control loop reacts to missing measurements.

        Another command follows when measurements arrive again. Each command is returned once,
        except that "arm_lost" is repeated until the site is in the mode "fault".

        Args:
            mode: Current mode of the site.

        Returns:
            "arm_silent" to hold the position, after `HELD_SILENCE_NS` without a measurement.
            "arm_lost" to enter the mode "fault", after `SILENCE_LIMIT_NS`. "arm_back" to
            continue. Empty if nothing has changed.
        """
        previous_order = self._reported_order
        if self._silent_ns > SILENCE_LIMIT_NS:
            self._reported_order = "arm_lost"
            was_carried_out = previous_order == "arm_lost" and mode is Mode.FAULT
            return "" if was_carried_out else "arm_lost"
        if self._silent_ns > HELD_SILENCE_NS:
            self._reported_order = "arm_silent"
            is_known_already = previous_order != ""
            return "" if is_known_already else "arm_silent"

        # Measurements arrive. After "arm_lost" no order is needed: the site stays in the mode
        # "fault" until a user resets it.
        self._reported_order = ""
        return "arm_back" if previous_order == "arm_silent" else ""

    def _accept(self, payload: bytes) -> None:
        """Checks one measurement, and either stores it or counts the reason why it is dropped.

        A measurement names its site, the boot of the driver (a random number that identifies
        the start of its process), and a sequence number n, which the driver increments. The
        measurement is dropped if it belongs to another site or driver, is not newer than the
        stored one, or is implausible because the arm cannot have moved so far.

        Args:
            payload: The encoded measurement.
        """
        try:
            message = decode(payload, ArmMeasurement, layout=self._layout)
        except WireError as error:
            self._dropped[error.reason] += 1
            return
        # During the session, measurements of another driver process are dropped. The driver may
        # only be restarted after a long silence.
        is_other_process = message.boot != self._boot
        is_lost = self._silent_ns > SILENCE_LIMIT_NS
        is_other_driver = self._is_bound and not is_lost and is_other_process
        if message.site != self._site or is_other_driver:
            self._dropped["stranger"] += 1
            return

        if is_other_process:
            self._boot = message.boot
            self._n = message.n - 1  # the numbers of a new process may begin at any number
        if message.n <= self._n:
            self._dropped["old measurement"] += 1
            return

        # The arm cannot have moved faster than its speed limits allow.
        now_ns = self._clock.monotonic_ns()
        elapsed_s = (now_ns - self._accepted_ns) * 1e-9
        if self._is_bound and not self._is_plausible(message.q, elapsed_s):
            self._dropped["implausible measurement"] += 1
            return

        self._accepted_ns = now_ns
        missing = message.n - self._n - 1  # measurements between the last one and this one
        if self._is_counting and missing > 0:
            self._dropped["missing measurement"] += missing
        # Measurements that were lost before the session are not counted. Therefore counting
        # begins after the first measurement that is accepted in the session.
        self._is_counting = self._is_bound
        self._n = message.n
        self.newest = PlantState(message.q, message.qd, message.tau_x)
        self.accepted += 1

    def _is_plausible(self, q: Sequence[float], elapsed_s: float) -> bool:
        """Returns True if each joint can have moved to its angle since the last measurement.

        A larger movement would exceed the speed limits of the arm, which indicates a faulty
        sensor or driver.

        Args:
            q: Joint angles in rad.
            elapsed_s: Time since the previous accepted measurement, in s.
        """
        if self.newest is None:
            return True
        largest_steps = [limit * elapsed_s + STEP_MARGIN_RAD for limit in self._speed_limits]
        joints = zip(q, self.newest.q, largest_steps, strict=True)
        return all(abs(angle - previous) <= largest for angle, previous, largest in joints)


@dataclass
class _Holder:
    """Newest report of one program on whether its user holds the dead-man switch of an arm.

    Several programs may report for one arm.

    Attributes:
        n: Number of the program's newest message.
        pressed_ns: Time at which the program's newest report of a held switch arrived, in ns.
            None if it does not hold the switch.
        counts: False if another program has released the switch while this program held it. The
            switch of this program then has to be released and pressed again.
    """

    n: int = -1
    pressed_ns: int | None = None
    counts: bool = True


class DeadManSwitch:
    """State of the dead-man switch of one arm, which several programs may report.

    A person holds the switch while the arm may move. Releasing it stops the arm.

    Each program reports whether its user holds the switch. The arm stops if any user releases
    the switch, or if the reports that it is held stop arriving. All other users then have to
    release the switch and press it again. The age of a report is measured from its arrival, on
    the clock of this machine, so the switch counts as released if this process was suspended.

    Args:
        site: Name of the site of the arm.
        ring: Queue of the reports, with their times of arrival.
        clock: Clock of this machine.
        dropped: Mapping from reason to number of dropped messages. The counts are increased in
            place.
    """

    def __init__(
        self,
        site: str,
        ring: StampedInbox[bytes],
        clock: Clock,
        dropped: Counter[str],
    ) -> None:
        self._site = site
        self._ring = ring
        self._clock = clock
        self._dropped = dropped
        self._programs: dict[int, _Holder] = {}
        self._was_released = False

    def _list_holders(self) -> list[_Holder]:
        """Lists the programs whose dead-man switch is pressed and counts as held.

        After any user has released the switch, all users must release it and press it again, so
        that nobody restarts an arm by accident.
        """
        return [
            program
            for program in self._programs.values()
            if program.counts and program.pressed_ns is not None
        ]

    def _is_silent(self, holder: _Holder) -> bool:
        """Returns True if a program has not reported a pressed switch for `SWITCH_SILENCE_NS`.

        If the program was holding the switch, the arm then stops. A program that does not press
        the switch counts as silent.
        """
        if holder.pressed_ns is None:
            return True
        return self._clock.monotonic_ns() - holder.pressed_ns > SWITCH_SILENCE_NS

    @property
    def held(self) -> bool:
        """True if the dead-man switch is held and the arm may move.

        At least one program must report that a person holds the switch, and the newest report
        from each of these programs must be at most `SWITCH_SILENCE_NS` old.
        """
        holders = self._list_holders()
        return bool(holders) and not any(map(self._is_silent, holders))

    def poll(self) -> None:
        """Receives reports about the dead-man switch, and updates whether it is held.

        If a program that reported a held switch sends no more reports, it may have crashed, and
        the switch counts as released.
        """
        while (message := self._ring.poll()) is not None:
            payload, received_ns = message
            self._accept(payload, received_ns)
        self._release([holder for holder in self._list_holders() if self._is_silent(holder)])

    def pop_order(self, site: Site) -> SiteOrder:
        """Returns the command that follows from the dead-man switch: to stop, or to move again.

        While the switch is released, every call returns the command to stop, until the arm has
        stopped for this reason or its site reports a fault.

        Args:
            site: The site, with its current mode and the reason for it.

        Returns:
            "released" if the arm must stop, "held" if it may move again, or an empty string if
            the site does not have to do anything.
        """
        was_released = self._was_released
        self._was_released = False

        if was_released or not self.held:
            needs_no_order = site.is_braked or site.mode is Mode.FAULT
            return "" if needs_no_order else "released"

        return "held" if site.awaits_switch else ""

    def _release(self, released: Sequence[_Holder]) -> None:
        """Marks the dead-man switch of the arm as released, which stops the arm.

        Users who still hold the switch must release it and press it again. This prevents
        anybody from accidentally restarting an arm that somebody else has stopped.

        Args:
            released: The programs whose users have released the switch, or whose reports have
                stopped. If empty, nothing changes.
        """
        if not released:
            return
        for holder in released:
            holder.pressed_ns = None
        for other in self._list_holders():
            other.counts = False
        self._was_released = True

    def _accept(self, payload: bytes, received_ns: int) -> None:
        """Checks one report from a program, and updates whether that program holds the switch.

        Several programs may report about the switch of one arm. If one user releases the
        switch, it counts as released, and the users of the other programs must release it and
        press it again before they count as holding it. A report names its site, the boot of the
        program (a random number that identifies the start of its process), and a sequence
        number n, which the program increases.

        Args:
            payload: The encoded report.
            received_ns: Time of its arrival on the local clock, in ns.
        """
        try:
            message = decode(payload, ArmEnable)
        except WireError as error:
            self._dropped[error.reason] += 1
            return
        if message.site != self._site:
            self._dropped["stranger"] += 1
            return

        # Only a limited number of programs is stored, so that the memory is bounded.
        is_new_program = message.boot not in self._programs
        if is_new_program and len(self._programs) >= STARTS_KEPT:
            self._forget_program()
        program = self._programs.setdefault(message.boot, _Holder())
        is_out_of_order = message.n <= program.n
        if is_out_of_order:
            self._dropped["old switch message"] += 1
            return

        program.n = message.n

        if message.held:
            program.pressed_ns = received_ns
            return

        # The program does not hold the switch. If it held it until now, the arm must stop.
        has_held_switch = program.counts and program.pressed_ns is not None
        if has_held_switch:
            self._release([program])
        # From now on, the program counts as holding the switch once it is pressed again.
        program.pressed_ns = None
        program.counts = True

    def _forget_program(self) -> None:
        """Removes the oldest program from the list of switch holders, to make room for another.

        The list has one entry per program that reports on the dead-man switch, and is limited
        in length. Programs that do not press the switch are removed before those that do.
        """
        idle = [boot for boot, program in self._programs.items() if program.pressed_ns is None]
        oldest = idle[0] if idle else next(iter(self._programs))
        del self._programs[oldest]

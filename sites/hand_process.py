"""Runs a user's operator class, which decides how to move an arm, in a separate process.

The class has a method `act` that receives a view (the current state of the arm and of the
others) and returns a target or a force. The site sends views over the network at regular
intervals. This process, started by `trilat hand`, replies with the decisions of the class.

Invariant:
    - Each decision names the tick of its view, and takes effect a fixed time after that tick.
      Delays on the network therefore do not change the run.
    - Views that are too old to be answered in time are skipped, so that a slow class does not
      fall further and further behind.
    - If the class fails, the arm is released and the process ends. If the process is killed,
      the site releases the arm, because no more messages arrive.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from trilat_net.core import HandProgram, HandView, PeerView
from trilat_net.errors import (
    RunFailed,
    SessionError,
    UsageError,
    count_nouns,
    describe_exception,
)
from trilat_net.net import (
    Bus,
    Clock,
    Connection,
    HandSender,
    HandViewMessage,
    SiteClient,
    SystemClock,
    read_messages,
    topics,
)
from trilat_net.scenario import HandSite, Scenario
from trilat_net.signals import Interrupt

POLL_NS = 500_000
"""Interval between polls for views, in ns."""
_ANNOUNCE_PERIOD_NS = 100_000_000
"""Interval between announcements to the site until the first view arrives, in ns."""
_VIEWS_KEPT = 64
"""Number of views that the network queue can hold."""


class HandProcess(SiteClient):
    """Runs a user's operator class, and connects it to the arm that it moves.

    The caller calls `serve` repeatedly. Each call replies to one view: the state of the arm and
    of its peers, as sent by the site.

    Args:
        hand_site: Site whose arm the operator moves, and settings of the user's class.
        program: The operator, an instance of the user's class.
        bus: Network connection to the session.
        clock: Clock of this process.
        session: Name of the session.

    Attributes:
        answered: Number of views to which the class has replied.
        skipped: Number of views that were skipped because they were too old.
    """

    def __init__(
        self,
        hand_site: HandSite,
        program: HandProgram,
        bus: Bus,
        clock: Clock,
        session: str,
    ) -> None:
        super().__init__(bus, clock, session, hand_site.name)
        self.answered = 0
        self.skipped = 0

        self._program = program
        self._code = hand_site.source
        self._pushes = hand_site.spec.mode == "force"
        site_rate_hz = hand_site.scenario.sites[hand_site.name].rate_hz
        self._ticks_per_view = site_rate_hz // hand_site.rate_hz

        self._sender = HandSender(bus, clock, session, hand_site.name)
        self._views = bus.inbox(topics.key(session, hand_site.name, topics.VIEW), _VIEWS_KEPT)
        self._announced_ns = 0
        self._waiting_views = deque[HandViewMessage]()
        # A view must be answered before its decision is due, `delay_s` after the tick of the
        # view.
        self._max_waiting = max(1, int(hand_site.delay_s * hand_site.rate_hz))

    def serve(self) -> None:
        """Calls the user's operator class with a view of the arm, and sends the decision.

        The oldest pending view that is not too old is used. If there is none, the class is not
        called. Until the first view arrives, this method regularly announces the process to the
        site.

        Raises:
            RunFailed: The user's class failed. The arm has been released.
        """
        views = self._waiting_views
        views.extend(read_messages(self._views, HandViewMessage))
        while len(views) > self._max_waiting:
            self.skipped += 1
            views.popleft()

        now_ns = self._clock.monotonic_ns()
        next_announcement_ns = self._announced_ns + _ANNOUNCE_PERIOD_NS
        if views:
            self._decide(views.popleft())
        elif not self.answered and now_ns > next_announcement_ns:
            self._announced_ns = now_ns
            self._send(0, None)  # a message without a decision announces this process

    def _decide(self, message: HandViewMessage) -> None:
        """Calls the user's operator class with the newest view, and sends its reply.

        The reply states how to move the arm. If the class fails, the arm is released at once,
        because nothing is guiding it any more.

        Args:
            message: The view received from the site: the current state of the arm and of the
                others.

        Raises:
            RunFailed: The class failed. The arm has been released.
        """
        self.answered += 1
        try:
            target_or_force = self._program.act(_read_view(message))
            numbers = None  # releases the arm
            if target_or_force is not None:
                numbers = [float(number) for number in target_or_force]
        except (Exception, SystemExit) as error:  # whatever the user's code raises
            self._send(message.k, None)
            class_name = self._code.split()[0]
            raise RunFailed(
                f"the hand {class_name} of {message.site} failed at tick {message.k}: "
                f"{describe_exception(error)}; the hand has released the arm"
            ) from error
        self._send(message.k, numbers)

    def _send(self, view_tick: int, goal: list[float] | None) -> None:
        """Sends the decision of the class to the site.

        The message names the view on which the decision is based, which allows the site to
        apply it at the right time.

        Args:
            view_tick: Tick of the view.
            goal: The target or force. None to release the arm.
        """
        goal_field = "force" if self._pushes else "target"
        fields = {goal_field: goal or [], "grip": goal is not None}
        self._sender.move(self._code, n=view_tick // self._ticks_per_view, **fields)


def _read_view(message: HandViewMessage) -> HandView:
    """Converts a network message to the object that a user's operator class receives.

    Joint angles and other vectors become NumPy arrays, as expected by user code.

    Args:
        message: The view sent by the site.
    """

    def read_fields(source: Any, names: tuple[str, ...]) -> Any:
        """Reads the given fields of a message, and converts lists to arrays.

        The field "peers" is left out, because it is converted separately.

        Args:
            source: The message, or the part of it that describes one peer.
            names: Names of the fields.

        Returns:
            A mapping from field name to value.
        """
        fields = {}
        for name in names:
            if name != "peers":
                value = getattr(source, name)
                fields[name] = np.array(value) if isinstance(value, list) else value
        return fields

    peers = tuple(PeerView(**read_fields(peer, PeerView._fields)) for peer in message.peers)
    return HandView(**read_fields(message, HandView._fields), peers=peers)


def run_hand(
    scenario: Scenario,
    name: str,
    session: str,
    connection: Connection,
    interrupt: Interrupt,
    say: Callable[[str], None],
    timeout_s: float,
) -> None:
    """Runs a user's operator class in its own process until the session ends.

    An operator class is Python code that moves an arm in place of a person. It receives the
    state of the arm over the network, and replies with a force or a target. Running it in a
    separate process prevents it from delaying the control loop of the arm.

    Args:
        scenario: Scenario of the session, which names the operator class.
        name: Name of the site.
        session: Name of the session.
        connection: Network addresses of the session, and keys.
        interrupt: Handler of the signals of this process.
        say: Function that prints a line for the user.
        timeout_s: Longest wait for the first view from the site, in s.

    Raises:
        UsageError: For this site, the scenario has no operator class that runs in its own
            process.
        SessionError: The site does not send its state in time.
        RunFailed: The class failed.
    """
    hand_site = HandSite.find(scenario, name)
    if hand_site is None or not scenario.sites[name].needs_hand_process:
        problem = "has no hand of kind 'own' with process = true"
        raise UsageError(
            f"{name} {problem}: either the site runs its hand itself, or the scenario has no "
            "such hand"
        )

    program = hand_site.make_program()
    clock = SystemClock()
    stopped = interrupt.is_requested
    give_up_ns = clock.monotonic_ns() + int(timeout_s * 1e9)
    bus = connection.open_bus(clock=clock, stopped=stopped, timeout_s=timeout_s, say=say)
    if bus is None:
        return

    with HandProcess(
        hand_site=hand_site, program=program, bus=bus, clock=clock, session=session
    ) as hand:
        say(f"{name}: its hand {hand_site.program} is ready")
        while not (stopped() or hand.over):
            hand.serve()
            if not hand.answered and clock.monotonic_ns() > give_up_ns:
                raise SessionError(
                    f"{name} did not send its state to the hand {hand_site.program} within "
                    f"{timeout_s:g} s"
                )

            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
        say(
            f"{name}: its hand was asked {count_nouns(hand.answered, 'time')}, "
            f"{count_nouns(hand.skipped, 'view')} skipped"
        )

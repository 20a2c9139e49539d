"""A hand of one's own in a process of its own: what `trilat hand` runs.

Invariant: it sees what the site sends it, and nothing else of the session; each decision names
the tick by whose view it was made, so that the site lets it act a fixed time after that. Views
that are too old to act in time are skipped. If its class fails, it lets go and ends; if it is
killed, the site notices the silence.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from trilat_net.core.own_hand import HandProgram, HandView
from trilat_net.core.user_law import PeerView
from trilat_net.errors import RunFailed, SessionError, UsageError, count_nouns
from trilat_net.net import topics
from trilat_net.net.arm_client import SiteClient, make_hand_sender
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import Connection, open_bus
from trilat_net.net.membership import read_messages
from trilat_net.net.requests import HandMessage, HandViewMessage
from trilat_net.process import Interrupt
from trilat_net.scenario import Scenario
from trilat_net.scenario.operators.program_hand import (
    HandSite,
    find_own_hand,
    make_hand_program,
)

POLL_NS = 500_000
HERE_NS = 100_000_000
"""Until the first view it says so often that it is there."""
VIEWS_KEPT = 64


class HandProcess(SiteClient):
    """A program at the arm of a site.

    Attributes:
        asked: number of views that it was asked by.
        skipped: number of views that it had no time for.
    """

    def __init__(
        self, at: HandSite, program: HandProgram, bus: Bus, clock: Clock, session: str
    ) -> None:
        super().__init__(bus, clock, session, at.name)
        self.asked = self.skipped = 0
        self._program = program
        self._code = at.source
        self._pushes = at.spec.mode == "force"
        self._every = at.scenario.sites[at.name].rate_hz // at.rate_hz
        self._sender = make_hand_sender(bus, clock, session, at.name)
        self._views = bus.inbox(topics.key(session, at.name, topics.VIEW), VIEWS_KEPT)
        self._here_ns = 0
        self._waiting = deque[HandViewMessage]()
        self._most = max(1, int(at.delay_s * at.rate_hz))

    def serve(self) -> None:
        """Decides by the next view, if one has come; says before the first that it is there.

        Raises:
            RunFailed: its class failed; it has let go.
        """
        views = self._waiting
        views.extend(read_messages(self._views, HandViewMessage))
        while len(views) > self._most:
            self.skipped += 1
            views.popleft()
        if views:
            self._decide(views.popleft())
        elif not self.asked and self._clock.monotonic_ns() > self._here_ns + HERE_NS:
            self._here_ns = self._clock.monotonic_ns()
            self._send(0, None)

    def _decide(self, message: HandViewMessage) -> None:
        self.asked += 1
        try:
            goal = self._program.act(read_view(message))
            numbers = None if goal is None else [float(one) for one in goal]
        except (Exception, SystemExit) as error:  # the user's code
            self._send(message.k, None)
            problem = (
                f"failed at tick {message.k}: {type(error).__name__}: {error}; it has let go"
            )
            raise RunFailed(
                f"the hand {self._code.split()[0]} of {message.site} {problem}"
            ) from error
        self._send(message.k, numbers)

    def _send(self, k: int, goal: list[float] | None) -> None:
        does = {"force" if self._pushes else "target": goal or [], "grip": goal is not None}
        self._sender.send(HandMessage, source=self._code, n=k // self._every, **does)


def read_view(message: HandViewMessage) -> HandView:
    """Returns what a hand sees, as its class is given it."""

    def read(one: Any, names: tuple[str, ...]) -> Any:
        values = ((name, getattr(one, name)) for name in names if name != "peers")
        return {
            name: np.array(value) if isinstance(value, list) else value
            for name, value in values
        }

    peers = tuple(PeerView(**read(peer, PeerView._fields)) for peer in message.peers)
    return HandView(**read(message, HandView._fields), peers=peers)


def run_hand(
    scenario: Scenario,
    name: str,
    session: str,
    connection: Connection,
    interrupt: Interrupt,
    say: Callable[[str], None],
    timeout_s: float,
) -> None:
    """Runs the hand of a site until its session ends.

    Raises:
        UsageError: the site has no hand of one's own, or not in a process of its own.
        SessionError: the site does not ask in time.
        RunFailed: its class failed.
    """
    at = find_own_hand(scenario, name)
    if at is None or not at.has_separate_process:
        problem = "has no hand of kind 'own' with process = true"
        raise UsageError(
            f"{name} {problem}: its site runs such a hand itself, or there is none"
        )
    program = make_hand_program(at)
    clock = SystemClock()
    stopped = interrupt.is_requested
    give_up_ns = clock.monotonic_ns() + int(timeout_s * 1e9)
    bus = open_bus(
        connection=connection, clock=clock, stopped=stopped, timeout_s=timeout_s, say=say
    )
    if bus is None:
        return
    with HandProcess(at=at, program=program, bus=bus, clock=clock, session=session) as hand:
        say(f"{name}: its hand {at.program} is there")
        while not (stopped() or hand.over):
            hand.serve()
            if not hand.asked and clock.monotonic_ns() > give_up_ns:
                raise SessionError(
                    f"{name} did not ask its hand {at.program} within {timeout_s:g} s"
                )
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
        say(
            f"{name}: its hand was asked {count_nouns(hand.asked, 'time')}, "
            f"{count_nouns(hand.skipped, 'view')} skipped"
        )

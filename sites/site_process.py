"""Runs the process of one arm in a session: joins, controls the arm, and leaves.

`run_site` connects to the network, builds the parts of the site, agrees with the other members
on the epoch (the time of tick 0), runs the control loop, and waits until the recorders have
stored everything. The loop is in `running_site`, the end in `site_end`.

Invariant:
    - A site announces itself only after it has declared its subscriptions and compiled its
      control step. A site that has been announced is therefore ready to execute its first tick
      on time and to receive all messages.
    - The arm is braked until the epoch.
"""

import queue
import threading
from collections.abc import Callable
from contextlib import closing, suppress

from trilat_net.core import compute_fingerprint
from trilat_net.errors import SessionError
from trilat_net.net import (
    EventPublisher,
    LateSites,
    SessionJoin,
    SystemClock,
    describe_member,
    share_threads,
    topics,
)
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Scenario
from trilat_net.signals import Interrupt

from .external_arm import ExternalArm
from .hand_server import RemoteHand
from .running_site import RunningSite
from .site_parts import SiteOptions, SiteParts

POLL_NS = 5_000_000
"""Longest pause between polls while the site joins a session, in ns."""


def run_site(
    scenario: Scenario,
    name: str,
    options: SiteOptions,
    say: Callable[[str], None],
) -> int:
    """Runs the control loop of one arm as a member of a session, from its start to its end.

    The site waits for the other sites of the scenario, exchanges the state of its arm with them
    over the network in every tick, and publishes its results for the recorder.

    Args:
        scenario: Scenario of the session.
        name: Name of the site.
        options: How the site connects to the session, and how long it waits for others.
        say: Function that prints a line for the user.

    Returns:
        Exit code of the process: 0, or 128 plus the number of the signal that ended the site.

    Raises:
        SessionError: The session could not begin.
        UsageError: An endpoint cannot be used.
        ScenarioError: The user's control law cannot be imported or differs from the law named
            in the scenario, or the scenario lacks the limits of an external arm.
        RunFailed: The run diverged, the user's law failed, or the measurements of the external
            arm stopped arriving.
    """
    scenario.check_outside_arms()
    # A site that rejoins a session needs its keys only until the end of the run, see
    # `_join_session`.
    if not scenario.sites_may_return:
        options.connection.require_keys_until(scenario.duration_s)
    share_threads()

    with Interrupt() as interrupt:
        clock = SystemClock.with_error(options.clock_offset_s, options.clock_drift_ppm)

        bus = options.connection.open_bus(
            clock=clock,
            stopped=interrupt.is_requested,
            timeout_s=options.join_timeout_s,
            say=lambda text: say(f"{name}: {text}"),
        )
        if bus is None:
            return interrupt.exit_code

        with closing(bus), _LinePrinter(say) as printer:
            with interrupt.raising():  # compilation may take minutes
                parts = SiteParts(
                    scenario=scenario,
                    name=name,
                    options=options,
                    bus=bus,
                    clock=clock,
                    interrupt=interrupt,
                    say=printer.put,
                )

            if options.connection.listen:
                endpoints = ", ".join(map(str, options.connection.listen))
                parts.say(f"others connect to {endpoints}")
            return join_and_run(parts)


class _LinePrinter:
    """Prints lines in a separate thread, so that a control loop never waits for the terminal.

    A terminal may block a program that prints, for example while its user has paused the
    output. Use the printer as a context manager. Up to 256 lines wait to be printed, and
    further lines are dropped.

    Args:
        print_line: Function that prints a line.
    """

    def __init__(self, print_line: Callable[[str], None]) -> None:
        self._print_line = print_line
        self._lines: queue.Queue[str | None] = queue.Queue(256)
        self._thread = threading.Thread(target=self._print_lines, daemon=True)

    def __enter__(self) -> "_LinePrinter":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(queue.Full):
            self._lines.put(None, timeout=1.0)
        self._thread.join(1.0)

    def put(self, text: str) -> None:
        """Queues a line to be printed by another thread, without waiting for the terminal.

        A control loop must not wait for a slow terminal. The line is dropped if too many lines
        are already waiting.

        Args:
            text: The line.
        """
        with suppress(queue.Full):
            self._lines.put_nowait(text)

    def _print_lines(self) -> None:
        """Prints the queued lines in the printer's thread, until the queue returns None.

        Output errors, for example a closed pipe, do not end the session.
        """
        while (text := self._lines.get()) is not None:
            with suppress(OSError):
                self._print_line(text)


def join_and_run(parts: SiteParts) -> int:
    """Joins a session, runs the control loop of the arm until its end, and leaves the session.

    If the arm is external or its operator runs in another process, the site first waits for a
    message from the arm's driver or from that process.

    Args:
        parts: Parts of the site, such as its network connection and its arm.

    Returns:
        Exit code of the process, as returned by `run_site`.

    Raises:
        SessionError: The session could not begin.
        RunFailed: The run failed.
    """
    timeout_ns = int(parts.options.join_timeout_s * 1e9)
    give_up_ns = parts.clock.monotonic_ns() + timeout_ns
    stopped = parts.interrupt.is_requested
    for device in (parts.arm, parts.hand):
        if not isinstance(device, ExternalArm | RemoteHand):
            continue
        if not device.wait_for_first(stopped, give_up_ns, parts.say):
            return parts.interrupt.exit_code

    running = _join_session(parts, give_up_ns)
    if running is None:
        return parts.interrupt.exit_code

    return running.run().leave_session()


def _join_session(parts: SiteParts, give_up_ns: int) -> RunningSite | None:
    """Announces this process to the session, and waits for the others and the common start.

    All processes agree on the epoch (the start time of the session).

    Args:
        parts: Parts of the site, such as its network connection and its arm.
        give_up_ns: Time at which the site gives up, on the monotonic clock of this process, in
            ns.

    Returns:
        The site, ready to run, or None if a signal ended the wait.

    Raises:
        SessionError: The session did not begin in time, or this site cannot be part of it.
    """
    scenario = parts.scenario
    options = parts.options
    info = describe_member(
        parts.name,
        parts.boot,
        parts.clock,
        compute_fingerprint(),
        scenario.text,
        needs_recorder=options.needs_recorder,
    )

    # A copy of each event is stored for recorders that miss it.
    store_event = parts.buffer.channels[topics.EVENT].store
    publisher = EventPublisher(parts.bus, options.session, info, store_event)

    joining = SessionJoin(
        bus=parts.bus,
        clock=parts.clock,
        session=options.session,
        publisher=publisher,
        sites=scenario.names,
        late=LateSites(scenario.sites_may_return, options.without, parts.site.rate_hz),
    )
    pinger = joining.pinger
    missing = ", ".join(joining.membership.list_missing())
    parts.say(f"waiting for {missing or 'the epoch'}")

    first_tick = 0
    while not parts.interrupt.is_requested():
        epoch = joining.poll()
        if epoch is not None:
            since_ns = parts.clock.monotonic_ns() - epoch.mono_ns
            options.connection.require_keys_until(scenario.duration_s - since_ns / NS_PER_S)
            return RunningSite(parts, publisher, pinger, epoch)

        if joining.announced_first_tick != first_tick:
            first_tick = joining.announced_first_tick
            # The first tick of a site that joins late. It is prepared before the epoch, because
            # the preparation takes 0.1 s for every hour that the session has been running.
            parts.site.start_at(first_tick)

        now_ns = parts.clock.monotonic_ns()
        if now_ns > give_up_ns:
            raise _describe_failed_join(parts, joining)
        parts.clock.sleep_until(now_ns + pinger.pause_ns(POLL_NS))
    return None


def _describe_failed_join(parts: SiteParts, joining: SessionJoin) -> SessionError:
    """Returns the error for a site that has waited in vain for its session to begin.

    The message states why a running session has not admitted the site, if that is known, and
    otherwise which members are missing. Replies that could not be decoded are mentioned too,
    since they often explain why a member seems to be missing.

    Args:
        parts: Parts of the site.
        joining: The attempt to join the session.
    """
    options = parts.options
    missing = joining.membership.list_missing()
    reason = joining.reason
    if not reason and missing:
        reason = f"{', '.join(missing)} did not join"
    elif not reason:
        reason = "the other members joined, but no common start time (epoch) was agreed on"

    for member, problem in joining.membership.unreadable.items():
        reason += f"; the reply of {member} cannot be read: {problem}"
    waited_s = f"{options.join_timeout_s:g} s"
    return SessionError(
        f"{parts.name} waited {waited_s} in session {options.session!r}: {reason}"
    )

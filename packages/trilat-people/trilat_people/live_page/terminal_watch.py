"""Shows a running session until it ends, in a terminal or on a web page.

`watch_session` connects to the session and updates a display, which is either a table in the
terminal (`trilat watch`) or a page (`trilat live --session`). If standard input is a terminal,
a key stops every arm.
"""

import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

from rich.console import Console

from trilat_net.app import SessionDisplay, StatusRow
from trilat_net.core import LifeAlarm
from trilat_net.errors import SessionError
from trilat_net.net import Bus, Clock, Connection
from trilat_net.presentation import describe_energy_obstacle
from trilat_net.records import NS_PER_S
from trilat_net.scenario import parse_embedded
from trilat_net.signals import Interrupt

from .page_orders import OrderDesk
from .session_view import SessionView

POLL_NS = 20_000_000
"""Time between two updates of the display, in ns."""
STOP_KEYS = frozenset(" sS")
"""Keys that stop every arm."""

SessionOnlooker = Callable[
    [Bus], AbstractContextManager[tuple[SessionView, Callable[[], None]]]
]
"""Function that shows a session, given a network connection that reaches it.

Returns a context manager that shows the session while active. It yields the state of the
session and a function that must be called often to update the display.
"""


def watch_session(
    session: str,
    connection: Connection,
    clock: Clock,
    show: SessionOnlooker,
    say: Callable[[str], None],
    timeout_s: float,
) -> int:
    """Observes a running session and shows it until it ends or a signal arrives.

    Args:
        session: Name of the session.
        connection: Network addresses and keys for connecting to the session.
        clock: Clock of this process.
        show: Function that shows the session, in a terminal or on a page.
        say: Function that prints a line for the user.
        timeout_s: Maximum time to wait for a reply from a site, in s.

    Returns:
        Exit code of the command.

    Raises:
        SessionError: There is no such session, or no site replies in time.
        UsageError: A network address cannot be used.
    """
    with Interrupt() as interrupt:
        stopped = interrupt.is_requested
        connection_to_session = connection.open_session(
            clock,
            session,
            lambda text: parse_embedded(text, session).names,
            stopped=stopped,
            timeout_s=timeout_s,
            say=say,
        )

        with connection_to_session as bus:
            if bus is None:
                return interrupt.exit_code

            with show(bus) as (view, update_display):
                reply_deadline_ns = clock.monotonic_ns() + int(timeout_s * NS_PER_S)
                while not (stopped() or view.ended):
                    update_display()
                    now_ns = clock.monotonic_ns()
                    if now_ns > reply_deadline_ns and not view.members:
                        raise SessionError(
                            f"no site of session {session!r} answered within {timeout_s:g} s"
                        )
                    clock.sleep_until(now_ns + POLL_NS)

        if stopped():
            return interrupt.exit_code

    if view.has_left:
        say(f"session {session} has ended: all of its sites have left")
    else:
        say(f"session {session} has ended")
    return 0


class SessionWatch:
    """Composes the text that `trilat watch` shows in a terminal.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
        as_site: Site whose user's view is shown, with delayed poses of the other arms. Empty to
            show all sites with no delay.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, as_site: str = "") -> None:
        self.view = SessionView(bus, clock, session)
        self._energy_text = ""
        self._as_site = as_site

    def update(self) -> None:
        """Receives new messages and checks the stability of the session.

        The energy function V of the stability proof must not increase by more than people and
        walls supply. The newest V, or the reason why there is none, is kept for the line
        `title` above the table.

        Raises:
            ScenarioError: The session does not contain the site whose user's view is to be
                shown.
        """
        view = self.view
        view.poll()
        if self._as_site and view.scenario is not None:
            # This call only serves to raise an error if there is no such site.
            view.scenario.find_site(self._as_site)

        energy = view.energy
        if energy is None:
            return
        course = energy.compute_next(view.complete_ticks)
        if course is not None:
            self._energy_text = (
                f"V = {course.V[-1]:.4g} J at {course.t_s[-1]:.1f} s, "
                f"people and walls gave {course.supplied[-1]:.4g} J"
            )
            return

        obstacle = describe_energy_obstacle(energy)
        if obstacle:
            self._energy_text = f"no V: {obstacle}"

    @property
    def title(self) -> str:
        """Line above the table, with the name of the session and its current state.

        States whether the session waits for members, has ended, or is silent, and for how long.
        For a running session, the line also contains the energy V used to check stability, or,
        if only one user's view is shown, the name of that user's site.
        """
        view = self.view
        silence_s = view.session_silence_s
        details = f"as {self._as_site} knows it" if self._as_site else self._energy_text
        parts = [details]
        if not view.running:
            parts = ["waits for its members"]
        elif view.ended:
            parts = ["has ended", details]
        elif silence_s > 0.0:
            parts = [f"silent for {silence_s:.0f} s, waiting", details]
        shown_parts = [part for part in parts if part]
        return "; ".join([f"session {view.session}", *shown_parts])

    @property
    def alarms(self) -> list[tuple[str, LifeAlarm]]:
        """Sites that need attention because they are holding, stopped or faulty.

        Each entry contains the name of the site and its alarm.
        """
        view = self.view
        alarms = []
        for name, site in view.sites.items():
            if self._as_site not in ("", name):
                continue
            alarm = site.find_alarm(view.session, name)
            if alarm is not None:
                alarms.append((name, alarm))
        return alarms

    def rows(self) -> list[StatusRow]:
        """Composes the table of the sites, with one row per site.

        If only one user's view is shown, the row of the user's own site is complete. The rows
        of the other sites contain the time and the joint angles of the pose that this user
        sees. This pose is delayed by the network, and possibly further by the scenario's
        picture delay.

        Returns:
            The rows, each a mapping from column heading to string. Empty until the sites run.
        """
        view = self.view
        scenario = view.scenario
        as_site = self._as_site
        rows_by_site: dict[str, StatusRow] = {}
        for name, site in view.sites.items():
            is_shown_completely = as_site in ("", name)  # "" shows all sites
            if scenario is not None and is_shown_completely:
                rows_by_site[name] = StatusRow.of_site(
                    scenario,
                    name,
                    site.record,
                    site.stats,
                    ended=site.ended or view.ended,
                    silent_s=view.silence_s(site),
                )

        user_record = view.sites[as_site].record if as_site in rows_by_site else None
        if user_record is None:
            return list(rows_by_site.values())

        # The ticks of the peers whose poses the user of `as_site` sees at present.
        visible_ticks = view.find_peer_ticks(as_site, user_record.tick, user_record.used)
        for peer, tick in visible_ticks.items():
            window = view.sites[peer].window
            joint_positions: list[float] = []
            if window.has_record(tick):
                joint_positions = window.rows(tick, tick).q[0].tolist()
            rows_by_site[peer] = StatusRow.of_pose(peer, tick / window.rate_hz, joint_positions)
        return list(rows_by_site.values())


@contextmanager
def show_in_terminal(
    clock: Clock, session: str, as_site: str, console: Console, bus: Bus
) -> Iterator[tuple[SessionView, Callable[[], None]]]:
    """Context manager that shows a running session as a table in the terminal.

    Used by `trilat watch` as the argument `show` of `watch_session`.

    Args:
        clock: Clock of this process.
        session: Name of the session.
        as_site: Name of the site whose user's view is shown. Empty to show all sites.
        console: Console of the terminal.
        bus: Network connection that reaches the session.

    Yields:
        The state of the session and a function that updates the display.
    """
    watch = SessionWatch(bus, clock, session, as_site)
    desk = OrderDesk(bus, clock, session)
    with _read_keys() as read_keys, SessionDisplay(console, clock) as display:
        if read_keys is not None:
            display.say("S or space: stop every arm")

        def update_display() -> None:
            """Updates the display, and stops every arm if the user has pressed S or space.

            `watch` composes the text, `desk` sends requests to the sites and collects their
            replies, and `display` prints to the terminal. `read_keys` returns the keys pressed,
            and is `None` if this process must not read the keyboard.
            """
            watch.update()
            wants_stop = read_keys is not None and STOP_KEYS.intersection(read_keys())
            if wants_stop:
                is_running = watch.view.running
                notice = "stopping every arm" if is_running else "the session has not begun"
                display.say(notice)
                desk.stop(watch.view.sites, "a watcher at a terminal")
            desk.poll()
            while desk.replies:
                # A reply also contains the site, the channel of the order and the acceptance.
                *_, text = desk.replies.pop(0)
                display.say(text)
            if display.due:
                display.show(watch.title, watch.rows(), watch.alarms)

        yield watch.view, update_display


@contextmanager
def _read_keys() -> Iterator[Callable[[], str] | None]:
    """Context manager that yields a non-blocking function to read the keys just pressed.

    While it is active, the terminal passes on each key immediately and does not echo it. The
    terminal settings are restored on exit. If this process does not own a terminal, yields
    `None`, and keys cannot stop the arms.
    """
    try:
        import termios
        import tty

        keyboard = sys.stdin.fileno()
        # A process in the background must not read the keys of the terminal.
        if os.tcgetpgrp(keyboard) != os.getpgrp():
            raise OSError
        settings = termios.tcgetattr(keyboard)
    except (ImportError, OSError, ValueError, AttributeError):
        # There is no terminal, or the operating system has none.
        yield None
        return

    def read() -> str:
        """Returns the keys that were pressed since the last call.

        Empty if no keys were pressed or the terminal was closed.
        """
        with suppress(OSError):
            readable, _, _ = select.select([keyboard], [], [], 0.0)
            if readable:
                return os.read(keyboard, 64).decode(errors="replace")
        return ""

    tty.setcbreak(keyboard)
    try:
        yield read
    finally:
        with suppress(termios.error):
            termios.tcsetattr(keyboard, termios.TCSADRAIN, settings)

"""A session that runs already, watched until it ends: by `trilat watch` in a terminal, by a
page elsewhere.

Where standard input is a terminal, a key stops every arm.
"""

import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

from rich.console import Console

from sites.monitor import HEADS, SessionDisplay, SiteRow, describe_angles, describe_site
from trilat_net.core.ticks import NS_PER_S, LifeAlarm
from trilat_net.errors import SessionError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.connection import Connection
from trilat_net.net.discovery import connect_to_session
from trilat_net.process import Interrupt
from trilat_net.scenario import embedded_names_reader, find_site

from .page_orders import OrderDesk
from .session_view import SessionView

POLL_NS = 20_000_000
STOP_KEYS = frozenset(" sS")

SessionOnlooker = Callable[
    [Bus], AbstractContextManager[tuple[SessionView, Callable[[], None]]]
]
"""Given a bus that reaches a session, a context that shows it: its view, and what is to be
called often.
"""


def watch_session(
    session: str,
    connection: Connection,
    clock: Clock,
    show: SessionOnlooker,
    say: Callable[[str], None],
    timeout_s: float,
) -> int:
    """Shows a session that runs already, until it ends or a signal comes; returns the exit
    code.

    Raises:
        SessionError: the session is not there, or no site answers in time.
        UsageError: an endpoint cannot be used.
    """
    with Interrupt() as interrupt:
        names = embedded_names_reader(session)
        stopped = interrupt.is_requested
        reached = connect_to_session(
            connection, clock, session, names, stopped=stopped, timeout_s=timeout_s, say=say
        )
        with reached as bus:
            if bus is None:
                return interrupt.exit_code
            with show(bus) as (view, look):
                give_up_ns = clock.monotonic_ns() + int(timeout_s * NS_PER_S)
                while not (stopped() or view.ended):
                    look()
                    now_ns = clock.monotonic_ns()
                    if now_ns > give_up_ns and not view.met:
                        raise SessionError(
                            f"no site of session {session!r} answered within {timeout_s:g} s"
                        )
                    clock.sleep_until(now_ns + POLL_NS)
        if stopped():
            return interrupt.exit_code
    say(f"session {session} has ended")
    return 0


class SessionWatch:
    """What is shown of a session, or of it to the user of one site; `update` takes in what has
    come.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, as_site: str = "") -> None:
        self.view = SessionView(bus, clock, session)
        self._V = ""
        self._as_site = as_site

    def update(self) -> None:
        """Takes in what has come, and computes V as far as all records are there."""
        view = self.view
        view.poll()
        if self._as_site and view.scenario is not None:
            find_site(view.scenario, self._as_site)
        if (course := view.advance_energy()) is not None:
            self._V = (
                f"V = {course.V[-1]:.4g} J at {course.t_s[-1]:.1f} s, people and walls gave "
            )
            self._V += f"{course.supplied[-1]:.4g} J"
        elif view.energy is not None and view.energy.reason:
            self._V = f"no V: {view.energy.reason}"

    @property
    def title(self) -> str:
        """The session, and its V; or that it has ended, or for how long no site was heard."""
        view = self.view
        silence_s = view.session_silence_s
        state = f"as {self._as_site} knows it" if self._as_site else self._V
        if not view.running:
            state = "waits for its members"
        elif view.ended:
            state = "; ".join(filter(None, ("has ended", state)))
        elif silence_s > 0.0:
            state = "; ".join(filter(None, (f"silent for {silence_s:.0f} s, waiting", state)))
        return f"session {self.view.session}" + (f"; {state}" if state else "")

    @property
    def alarms(self) -> list[tuple[str, LifeAlarm]]:
        """The sites that hold, are stopped or in fault, each with its alarm, while they run."""
        view = self.view
        known = {name: site for name, site in view.sites.items() if self._as_site in ("", name)}
        found = ((name, site.find_alarm(view.session, name)) for name, site in known.items())
        return [(name, alarm) for name, alarm in found if alarm is not None]

    def rows(self) -> list[SiteRow]:
        """Returns the row of each site; of a peer of the site that is watched, what its user is
        shown.
        """
        view = self.view
        scenario = self.view.scenario
        own = self._as_site
        every = {
            name: describe_site(
                scenario,
                name,
                site.record,
                site.stats,
                ended=site.ended or view.ended,
                silent_s=view.silence_s(site),
            )
            for name, site in view.sites.items()
            if scenario is not None and own in ("", name)
        }
        record = view.sites[own].record if own in every else None
        for peer, tick in (
            view.find_shown(own, record.tick, record.used).items() if record else ()
        ):
            window = view.sites[peer].window
            seen = {"site": peer}
            if window.has_record(tick):
                angles = describe_angles(window.rows(tick, tick).q[0].tolist())
                seen |= {"time": f"{tick / window.rate_hz:.3f} s", "angles": angles}
            every[peer] = dict.fromkeys(HEADS, "") | seen
        return list(every.values())


@contextmanager
def show_in_terminal(
    clock: Clock, session: str, as_site: str, console: Console, bus: Bus
) -> Iterator[tuple[SessionView, Callable[[], None]]]:
    """The `SessionOnlooker` of a terminal."""
    watch = SessionWatch(bus, clock, session, as_site)
    desk = OrderDesk(bus, clock, session)
    with _read_keys() as read_keys, SessionDisplay(console, clock) as display:
        if read_keys is not None:
            display.say("S or space: stop every arm")

        def look() -> None:
            watch.update()
            if read_keys is not None and STOP_KEYS.intersection(read_keys()):
                display.say(
                    "stopping every arm" if watch.view.running else "the session has not begun"
                )
                desk.stop(watch.view.sites, "a watcher at a terminal")
            desk.poll()
            while desk.replies:
                display.say(desk.replies.pop(0)[3])
            if display.due:
                display.show(watch.title, watch.rows(), watch.alarms)

        yield watch.view, look


@contextmanager
def _read_keys() -> Iterator[Callable[[], str] | None]:
    """Yields what returns the keys pressed since it was asked last; None without a terminal of
    ours.
    """
    try:
        import termios
        import tty

        keyboard = sys.stdin.fileno()
        if os.tcgetpgrp(keyboard) != os.getpgrp():  # its keys go to another program
            raise OSError
        before = termios.tcgetattr(keyboard)
    # no terminal, or a system without them
    except (
        ImportError,
        OSError,
        ValueError,
        AttributeError,
    ):
        yield None
        return

    def read() -> str:
        with suppress(OSError):  # it has hung up
            if select.select([keyboard], [], [], 0.0)[0]:
                return os.read(keyboard, 64).decode(errors="replace")
        return ""

    tty.setcbreak(keyboard)
    try:
        yield read
    finally:
        with suppress(termios.error):
            termios.tcsetattr(keyboard, termios.TCSADRAIN, before)

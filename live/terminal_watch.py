"""`trilat watch`: a session in a terminal, a line for each site.

A terminal shows a table that is refreshed; other outputs get the same lines every two seconds. Where standard
input is a terminal, a key stops every arm.
"""

import os
import select
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress

import numpy as np
from rich.box import HEAVY
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from trilat_net.core.live_hand import HandInForce
from trilat_net.core.ticks import NS_PER_S, LifeAlarm
from trilat_net.errors import SessionError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.process import Interrupt

from .page_orders import OrderDesk
from .session_view import SessionView, SiteView

POLL_NS = 20_000_000
TABLE_NS, LINES_NS = NS_PER_S // 4, 2 * NS_PER_S
"""Between two updates of a table, and of lines."""
STOP_KEYS = frozenset(" sS")
HEADS = ("site", "time", "mode", "angles", "|e|", "torque", "age of each peer's sample", "held", "late")


class SessionWatch:
    """What is shown of a session; `update` takes in what has come."""

    def __init__(self, bus: Bus, clock: Clock, session: str) -> None:
        self.view = SessionView(bus, clock, session)
        self._V = ""

    def update(self) -> None:
        """Takes in what has come, and computes V as far as all records are there."""
        view = self.view
        view.poll()
        if view.energy is None:
            return
        course = view.energy.advance({name: site.complete for name, site in view.sites.items()})
        if course is not None:
            self._V = f"V = {course.V[-1]:.4g} J at {course.t_s[-1]:.1f} s, people and walls gave "
            self._V += f"{course.supplied[-1]:.4g} J"
        elif view.energy.reason:
            self._V = f"no V: {view.energy.reason}"

    @property
    def title(self) -> str:
        """The session, and its V."""
        state = self._V if self.view.running else "waits for its members"
        return f"session {self.view.session}" + (f"; {state}" if state else "")

    @property
    def alarms(self) -> list[tuple[str, LifeAlarm]]:
        """The sites that hold, are stopped or in fault, each with its alarm, while they run."""
        view = self.view
        running = {name: site for name, site in view.sites.items() if not view.silent(site)}
        found = ((name, site.find_alarm(view.session, name)) for name, site in running.items())
        return [(name, alarm) for name, alarm in found if alarm is not None]

    def rows(self) -> list[list[str]]:
        """Returns a line of `HEADS` for each site."""
        return [self._row(name, site) for name, site in self.view.sites.items()]

    def _row(self, name: str, site: SiteView) -> list[str]:
        record, stats = site.record, site.stats
        if record is None or not site.window.knows(record.tick):
            return [name, *[""] * (len(HEADS) - 1)]
        own = site.window.rows(record.tick, record.tick)
        apart, unit = float(np.linalg.norm(own.e[0])), "m" if record.x else "rad"
        ages = {} if stats is None else stats.age_us
        hand = HandInForce.read(record.hand) if record.hand else None
        held = "" if hand is None else "yes" if hand.source else "fades" if hand.grip else "free"
        return [
            name,
            f"{record.t_ns / NS_PER_S:.1f} s",
            "silent" if self.view.silent(site) else record.mode,
            " ".join(f"{q:+.3f}" for q in record.q) + " rad",
            f"{apart:.4f} {unit}",
            f"{max(map(abs, record.tau)):.2f} N m",
            ", ".join(
                f"{peer} {age / 1000:.0f} ms" if age >= 0 else f"{peer} none" for peer, age in ages.items()
            ),
            held,
            "" if stats is None else f"{stats.late_max_us} us",
        ]


def watch_session(
    bus: Bus, clock: Clock, session: str, console: Console, interrupt: Interrupt, timeout_s: float
) -> None:
    """Shows a session until it ends or a signal comes.

    Raises:
        SessionError: no site answers in time.
    """
    watch, desk = SessionWatch(bus, clock, session), OrderDesk(bus, clock, session)
    live = Live(console=console, auto_refresh=False) if console.is_terminal else None
    begun_ns = shown_ns = clock.monotonic_ns()
    with _read_keys() as read_keys, live or nullcontext():
        if read_keys is not None:
            console.print("S or space: stop every arm", highlight=False)
        while not (interrupt.requested() or watch.view.ended):
            watch.update()
            if read_keys is not None and STOP_KEYS.intersection(read_keys()):
                console.print("stopping every arm" if watch.view.running else "the session has not begun")
                desk.stop(watch.view.sites)
            desk.poll()
            while desk.replies:
                console.print(desk.replies.pop(0)[2], highlight=False, markup=False, soft_wrap=True)
            now_ns = clock.monotonic_ns()
            if not watch.view.met and now_ns - begun_ns > timeout_s * NS_PER_S:
                raise SessionError(f"no site of session {session!r} answered within {timeout_s:g} s")
            if now_ns - shown_ns >= (LINES_NS if live is None else TABLE_NS):
                shown_ns = now_ns
                _show(watch, console, live)
            clock.sleep_until(now_ns + POLL_NS)


@contextmanager
def _read_keys() -> Iterator[Callable[[], str] | None]:
    """Yields what returns the keys pressed since it was asked last; None without a terminal of ours."""
    try:
        import termios
        import tty

        keyboard = sys.stdin.fileno()
        if os.tcgetpgrp(keyboard) != os.getpgrp():  # its keys go to another program
            raise OSError
        before = termios.tcgetattr(keyboard)
    except (ImportError, OSError, ValueError, AttributeError):  # no terminal, or a system without them
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


def _show(watch: SessionWatch, console: Console, live: Live | None) -> None:
    rows, alarms = watch.rows(), watch.alarms
    if live is not None:
        live.update(Group(*frame_alarms(alarms), _tabulate(watch.title, rows)), refresh=True)
        return
    shouted = [f"*** {name} {alarm}" for name, alarm in alarms]
    for line in [watch.title, *shouted, *(describe_row(row) for row in rows)]:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def describe_row(row: Sequence[str]) -> str:
    """Returns a site in a line of text."""
    name, time, mode, angles, apart, torque, ages, held, late = row
    parts = [f"{name} {time} {mode}", angles, f"|e| {apart}", f"torque {torque}", f"age {ages}"]
    return "; ".join([*parts, *([f"hand {held}"] if held else []), f"late {late}"])


def frame_alarms(alarms: Sequence[tuple[str, LifeAlarm]]) -> list[Panel]:
    """Returns a block for each alarm: red, or yellow of a site that holds and goes on by itself."""
    blocks = []
    for name, (word, reason, advice) in alarms:
        colour = "red" if word in ("FAULT", "STOPPED") else "yellow"
        text = Text.assemble(
            (f" {name} {word} ", f"bold reverse {colour}"), f"  {reason}\n", (advice, "bold")
        )
        blocks.append(Panel(text, box=HEAVY, border_style=f"bold {colour}"))
    return blocks


def _tabulate(title: str, rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=escape(title), title_justify="left")
    for head in HEADS:
        table.add_column(head, justify="right" if head in ("time", "|e|", "torque", "late") else "left")
    for row in rows:
        table.add_row(*map(escape, row))
    return table

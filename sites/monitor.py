"""Monitor of a live session from outside: its statistics and events, shown as a table or as lines.

A terminal shows a table; other outputs get a line every two seconds.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import WireError
from trilat_net.log.site_log import find_task_errors
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.membership import read_events, read_messages
from trilat_net.net.messages import LinkStats, State
from trilat_net.net.wire import decode, split_states
from trilat_net.scenario import Scenario

LOUD_EVENTS = frozenset(
    ("lost", "left", "join", "unheard", "heard", "diverged", "failed", "refused", "clock fault")
)
"""Kinds of events that a person who watches should read."""


class SessionMonitor:
    """The latest of every site of a session: statistics, error and torque; event texts, not yet taken."""

    def __init__(self, bus: Bus, session: str, scenario: Scenario) -> None:
        self.latest: dict[str, LinkStats] = {}
        self.motion: dict[str, tuple[str, str]] = {}
        self.news: list[str] = []
        self._scenario, self._sites = scenario, scenario.names
        self._links = bus.inbox(topics.key(session, "*", topics.LINK), 256)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self._states = {name: bus.inbox(topics.key(session, name, topics.STATE), 1) for name in self._sites}

    def poll(self) -> None:
        """Takes the messages that have arrived."""
        for stats in read_messages(self._links, LinkStats):
            if stats.site in self._sites:
                self.latest[stats.site] = stats
        for event in read_events(self._events):
            if event.kind in LOUD_EVENTS:
                self.news.append(event.text)
        for name, states in self._states.items():
            if (message := states.poll()) is not None:
                with suppress(WireError):
                    self.motion[name] = self._describe_motion(name, message[1])

    def _describe_motion(self, site: str, block: bytes) -> tuple[str, str]:
        """Returns the error and the largest torque of the last record of a block."""
        *_, last = split_states(block)
        record = decode(last, State, layout=self._scenario.layout(site))
        own, desired = (np.array([v]) for v in (record.x or record.q, record.q_des))
        e = find_task_errors(own, desired, self._scenario.arms[site].axes) if record.x else own - desired
        error = f"{np.linalg.norm(e):.4f} {'m' if record.x else 'rad'}"
        return error, f"{max(map(abs, record.tau)):.2f} N m"

    def take_news(self) -> Sequence[str]:
        """Returns the event texts since the last call."""
        news, self.news = self.news, []
        return news


LINE_EVERY = 20
"""Without a terminal, one update in so many prints a line."""


class SessionDisplay:
    """Shows the progress of a session; a context, which restores the terminal."""

    def __init__(self, scenario: Scenario, console: Console) -> None:
        self._scenario, self._console = scenario, console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._updates = 0

    def __enter__(self) -> "SessionDisplay":
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def update(self, monitor: SessionMonitor) -> None:
        """Shows the latest of every site."""
        self._updates += 1
        if self._live:
            self._live.start()  # not before: what ends at a signal until then could not restore the terminal
            self._live.update(self._table(monitor), refresh=True)
        elif monitor.latest and self._updates % LINE_EVERY == 0:
            self._console.print(self._line(monitor), highlight=False, markup=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """Prints a line above the table."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def _table(self, monitor: SessionMonitor) -> Table:
        table = Table(title=f"{self._scenario.name}, {self._scenario.duration_s:g} s", title_justify="left")
        for column in ("site", "mode", "time", "|e|", "torque", "late", "overruns", "age of peers' samples"):
            table.add_column(column, justify="left" if column[:3] in ("sit", "mod", "age") else "right")
        for name in self._scenario.names:
            stats, motion = monitor.latest.get(name), monitor.motion.get(name, ("", ""))
            if stats is None:
                table.add_row(name, "braked", *[""] * 6)
                continue
            ages = "  ".join(f"{peer} {_milliseconds(age)}" for peer, age in stats.age_us.items())
            time, late = f"{stats.t_ns / NS_PER_S:.1f} s", f"{stats.late_max_us} us"
            table.add_row(name, escape(stats.mode), time, *motion, late, f"{stats.overruns}", escape(ages))
        return table

    def _line(self, monitor: SessionMonitor) -> str:
        parts = []
        for name in filter(monitor.latest.__contains__, self._scenario.names):
            stats, (error, torque) = monitor.latest[name], monitor.motion.get(name, ("", ""))
            ages = ", ".join(f"{peer} {_milliseconds(age)}" for peer, age in stats.age_us.items())
            motion = f"|e| {error}, torque {torque}, " if error else ""
            time = f"{name} {stats.mode} {stats.t_ns / NS_PER_S:.1f} s: "
            parts.append(f"{time}{motion}late {stats.late_max_us} us (age {ages})")
        return "; ".join(parts)


def _milliseconds(age_us: int) -> str:
    return "none yet" if age_us < 0 else f"{age_us / 1000:.0f} ms"

"""Monitor of a live session from outside: its statistics and events, shown as a table or as lines.

A terminal shows a table; other outputs get a line every two seconds.
"""

from collections.abc import Sequence

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from trilat_net.core.ticks import NS_PER_S
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.membership import read_events, read_messages
from trilat_net.net.messages import LinkStats
from trilat_net.scenario import Scenario

LOUD_EVENTS = frozenset(
    ("lost", "left", "join", "unheard", "heard", "diverged", "failed", "refused", "clock fault")
)
"""Kinds of events that a person who watches should read."""


class SessionMonitor:
    """The latest statistics of every site of a session, and event texts for the user, not yet taken."""

    def __init__(self, bus: Bus, session: str, sites: Sequence[str]) -> None:
        self.latest: dict[str, LinkStats] = {}
        self.news: list[str] = []
        self._sites = sites
        self._links = bus.inbox(topics.key(session, "*", topics.LINK), 256)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)

    def poll(self) -> None:
        """Takes the messages that have arrived."""
        for stats in read_messages(self._links, LinkStats):
            if stats.site in self._sites:
                self.latest[stats.site] = stats
        for event in read_events(self._events):
            if event.kind in LOUD_EVENTS:
                self.news.append(event.text)

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

    def update(self, latest: dict[str, LinkStats]) -> None:
        """Shows the latest statistics of every site."""
        self._updates += 1
        if self._live:
            self._live.start()  # not before: what ends at a signal until then could not restore the terminal
            self._live.update(self._table(latest), refresh=True)
        elif latest and self._updates % LINE_EVERY == 0:
            self._console.print(self._line(latest), highlight=False, markup=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """Prints a line above the table."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def _table(self, latest: dict[str, LinkStats]) -> Table:
        table = Table(title=f"{self._scenario.name}, {self._scenario.duration_s:g} s", title_justify="left")
        for column in ("site", "mode", "time", "tick", "late now", "overruns", "age of each peer's sample"):
            table.add_column(column, justify="left" if column[:3] in ("sit", "mod", "age") else "right")
        for name in self._scenario.names:
            stats = latest.get(name)
            if stats is None:
                table.add_row(name, "braked", "", "", "", "", "")
                continue
            ages = "  ".join(f"{peer} {_milliseconds(age)}" for peer, age in stats.age_us.items())
            time, late = f"{stats.t_ns / NS_PER_S:.1f} s", f"{stats.late_max_us} us"
            table.add_row(
                name, escape(stats.mode), time, f"{stats.tick}", late, f"{stats.overruns}", escape(ages)
            )
        return table

    def _line(self, latest: dict[str, LinkStats]) -> str:
        parts = []
        for name, stats in sorted(latest.items(), key=lambda item: self._scenario.names.index(item[0])):
            ages = ", ".join(f"{peer} {_milliseconds(age)}" for peer, age in stats.age_us.items())
            parts.append(f"{name} {stats.mode} tick {stats.tick} late {stats.late_max_us} us (age {ages})")
        return "; ".join(parts)


def _milliseconds(age_us: int) -> str:
    return "none yet" if age_us < 0 else f"{age_us / 1000:.0f} ms"

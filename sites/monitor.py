"""The view of a session in a terminal: `trilat demo` and `trilat watch` show a row per site.

A terminal shows a table that is refreshed; other outputs receive the same rows as lines every
two seconds.
"""

from collections.abc import Mapping, Sequence

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
from trilat_net.log.site_log import compute_task_errors
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.membership import read_messages, read_records
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.scenario import Scenario

AGES = "age of each peer's sample"
HEADS = ("site", "time", "mode", "angles", "|e|", "torque", AGES, "held", "late", "overruns")
NUMBERS = frozenset(("time", "|e|", "torque", "late", "overruns"))
TABLE_NS = NS_PER_S // 4
LINES_NS = 2 * NS_PER_S
"""Time between two updates of the table, and between two updates of the lines."""
LOUD_EVENTS = frozenset(
    ("lost", "left", "join", "unheard", "heard", "diverged", "failed", "refused", "clock fault")
)
"""Kinds of events that are printed for the person who watches."""

SiteRow = Mapping[str, str]
"""The texts of a site's row, by the names in `HEADS`."""


def describe_site(
    scenario: Scenario,
    name: str,
    record: State | None,
    stats: LinkStats | None,
    *,
    ended: bool = False,
    silent_s: float = 0.0,
) -> SiteRow:
    """Returns the row of a site, from its newest record and statistics.

    Args:
        scenario: the scenario of the session.
        name: the site.
        record: the newest record; None before the first.
        stats: the newest statistics; None before the first.
        ended: whether the site has published its end.
        silent_s: the time since the site was heard, s; 0.0 if that was a moment ago.
    """
    row = dict.fromkeys(HEADS, "") | {"site": name, "mode": "braked"}
    if stats is not None:
        ages = [
            f"{peer} {age_us / 1000:.0f} ms" if age_us >= 0 else f"{peer} none"
            for peer, age_us in stats.age_us.items()
        ]
        row |= {
            "time": f"{stats.t_ns / NS_PER_S:.1f} s",
            "mode": stats.mode,
            AGES: ", ".join(ages),
            "late": f"{stats.late_max_us} us",
            "overruns": f"{stats.overruns}",
        }
    if record is not None:
        row |= _describe_record(scenario, name, record)
    if ended:
        return row | {"mode": "ended"}
    return row | {"mode": f"silent {silent_s:.0f} s"} if silent_s > 0.0 else row


def _describe_record(scenario: Scenario, name: str, record: State) -> SiteRow:
    """Returns the texts of a row that follow from a record."""
    position = np.array([record.x or record.q])
    desired = np.array([record.q_des])
    if record.x:
        unit = "m"
        error = compute_task_errors(position, desired, scenario.arms[name].axes)
    else:
        unit = "rad"
        error = position - desired
    hand = HandInForce.read(record.hand) if record.hand else None
    return {
        "time": f"{record.t_ns / NS_PER_S:.1f} s",
        "mode": record.mode,
        "angles": describe_angles(record.q),
        "|e|": f"{np.linalg.norm(error):.4f} {unit}",
        "torque": f"{max(map(abs, record.tau)):.2f} N m",
        "held": _describe_hold(hand),
    }


def _describe_hold(hand: HandInForce | None) -> str:
    if hand is None:
        return ""
    if hand.source:
        return "yes"
    return "fades" if hand.grip else "free"


def describe_angles(q: Sequence[float]) -> str:
    """Returns the text of joint angles, rad."""
    return " ".join(f"{angle:+.3f}" for angle in q) + " rad"


def describe_row(row: SiteRow) -> str:
    """Returns a site's row as a line of text."""
    keys = {"|e|": "|e|", "torque": "torque", "age": AGES, "hand": "held", "late": "late"}
    parts = [f"{row['site']} {row['time']} {row['mode']}".strip(), row["angles"]]
    parts += [f"{word} {row[key]}" for word, key in keys.items() if row[key]]
    return "; ".join(parts)


def frame_alarms(alarms: Sequence[tuple[str, LifeAlarm]]) -> list[Panel]:
    """Returns a panel for each alarm of a site.

    A panel is red if the arm is stopped or in fault, and yellow if it continues by itself.
    """
    blocks = []
    for name, alarm in alarms:
        colour = "red" if alarm.word in ("FAULT", "STOPPED") else "yellow"
        head = f" {name} {alarm.word} "
        text = Text.assemble(
            (head, f"bold reverse {colour}"), f"  {alarm.reason}\n", (alarm.advice, "bold")
        )
        blocks.append(Panel(text, box=HEAVY, border_style=f"bold {colour}"))
    return blocks


class SessionDisplay:
    """Shows the rows of all sites; a context manager that restores the terminal."""

    def __init__(self, console: Console, clock: Clock) -> None:
        self._console = console
        self._clock = clock
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._updated_ns = clock.monotonic_ns()
        self._title = ""

    def __enter__(self) -> "SessionDisplay":
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    @property
    def due(self) -> bool:
        """True if it is time for the next update."""
        return self._clock.monotonic_ns() - self._updated_ns >= (
            TABLE_NS if self._live else LINES_NS
        )

    def say(self, text: str) -> None:
        """Prints a line above the table."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(
        self, title: str, rows: Sequence[SiteRow], alarms: Sequence[tuple[str, LifeAlarm]] = ()
    ) -> None:
        """Shows the rows of all sites, with the alarms above them."""
        self._updated_ns = self._clock.monotonic_ns()
        if self._live is None:
            alarm_lines = [f"*** {name} {alarm}" for name, alarm in alarms]
            title_lines = [title] if title != self._title else []
            self._title = title
            row_lines = [describe_row(row) for row in rows if row["time"]]
            for line in [*title_lines, *alarm_lines, *row_lines]:
                self.say(line)
            return
        table = Table(title=escape(title), title_justify="left")
        for head in HEADS:
            table.add_column(head, justify="right" if head in NUMBERS else "left")
        for row in rows:
            table.add_row(*map(escape, row.values()))
        # Started only here: a signal before the first update would not restore the terminal.
        self._live.start()
        self._live.update(Group(*frame_alarms(alarms), table), refresh=True)


class SessionMonitor:
    """Receives the messages of the sites, and shows them on a display."""

    def __init__(
        self, bus: Bus, session: str, scenario: Scenario, display: SessionDisplay
    ) -> None:
        self.latest: dict[str, LinkStats] = {}
        self.records: dict[str, State] = {}
        self._scenario = scenario
        self._display = display
        self._links = bus.inbox(topics.key(session, "*", topics.LINK), 256)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self._states = {
            name: bus.inbox(topics.key(session, name, topics.STATE), 1)
            for name in scenario.names
        }

    def poll(self) -> None:
        """Receives the messages that have arrived, and updates the display if that is due."""
        scenario = self._scenario
        for stats in read_messages(self._links, LinkStats):
            if stats.site in self._states:
                self.latest[stats.site] = stats
        for event in read_messages(self._events, Event):
            if event.kind in LOUD_EVENTS:
                self._display.say(event.text)
        for name, states in self._states.items():
            for record in read_records(states, scenario.layout(name)):
                self.records[name] = record
        if self._display.due:
            rows = [
                describe_site(scenario, name, self.records.get(name), self.latest.get(name))
                for name in scenario.names
            ]
            self._display.show(f"{scenario.name}, {scenario.duration_s:g} s", rows)

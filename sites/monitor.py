"""A session in a terminal, a row for each site: what `trilat demo` and `trilat watch` show.

A terminal shows a table that is refreshed; other outputs get the same rows as lines every two
seconds.
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
"""Between two updates of a table, and of lines."""
LOUD_EVENTS = frozenset(
    ("lost", "left", "join", "unheard", "heard", "diverged", "failed", "refused", "clock fault")
)
"""Kinds of events that a person who watches should read."""

SiteRow = Mapping[str, str]
"""A site's row, by `HEADS`."""


def describe_site(
    scenario: Scenario,
    name: str,
    record: State | None,
    stats: LinkStats | None,
    *,
    ended: bool = False,
    silent_s: float = 0.0,
) -> SiteRow:
    """Returns the row of a site by its newest record and statistics, as far as there are any.

    Args:
        scenario: of the session.
        name: the site.
        record: its newest record; None before the first.
        stats: its newest statistics; None before the first.
        ended: true once the site has said that it ends.
        silent_s: for how long it was not heard, s; 0.0 if it was heard lately.
    """
    row = dict.fromkeys(HEADS, "") | {"site": name, "mode": "braked"}
    if stats is not None:
        aged = stats.age_us.items()
        row |= {
            "time": f"{stats.t_ns / NS_PER_S:.1f} s",
            "mode": stats.mode,
            AGES: ", ".join(
                f"{peer} {age / 1000:.0f} ms" if age >= 0 else f"{peer} none"
                for peer, age in aged
            ),
            "late": f"{stats.late_max_us} us",
            "overruns": f"{stats.overruns}",
        }
    if record is not None:
        own, desired = (np.array([v]) for v in (record.x or record.q, record.q_des))
        e = (
            compute_task_errors(own, desired, scenario.arms[name].axes)
            if record.x
            else own - desired
        )
        hand = HandInForce.read(record.hand) if record.hand else None
        row |= {
            "time": f"{record.t_ns / NS_PER_S:.1f} s",
            "mode": record.mode,
            "angles": describe_angles(record.q),
            "|e|": f"{np.linalg.norm(e):.4f} {'m' if record.x else 'rad'}",
            "torque": f"{max(map(abs, record.tau)):.2f} N m",
            "held": ""
            if hand is None
            else "yes"
            if hand.source
            else "fades"
            if hand.grip
            else "free",
        }
    if ended:
        return row | {"mode": "ended"}
    return row | {"mode": f"silent {silent_s:.0f} s"} if silent_s > 0.0 else row


def describe_angles(q: Sequence[float]) -> str:
    """Returns joint angles as a row has them."""
    return " ".join(f"{angle:+.3f}" for angle in q) + " rad"


def describe_row(row: SiteRow) -> str:
    """Returns a site in a line of text."""
    words = {"|e|": "|e|", "torque": "torque", "age": AGES, "hand": "held", "late": "late"}
    parts = [f"{row['site']} {row['time']} {row['mode']}".strip(), row["angles"]]
    return "; ".join(
        [*parts, *(f"{word} {row[key]}" for word, key in words.items() if row[key])]
    )


def frame_alarms(alarms: Sequence[tuple[str, LifeAlarm]]) -> list[Panel]:
    """Returns a block for each alarm: red, or yellow of a site that holds and goes on by
    itself.
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
    """Shows rows of sites in a terminal; a context, which restores it."""

    def __init__(self, console: Console, clock: Clock) -> None:
        self._console = console
        self._clock = clock
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._shown_ns = clock.monotonic_ns()
        self._title = ""

    def __enter__(self) -> "SessionDisplay":
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    @property
    def due(self) -> bool:
        """True if what it shows is old."""
        return self._clock.monotonic_ns() - self._shown_ns >= (
            TABLE_NS if self._live else LINES_NS
        )

    def say(self, text: str) -> None:
        """Prints a line above the table."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(
        self, title: str, rows: Sequence[SiteRow], alarms: Sequence[tuple[str, LifeAlarm]] = ()
    ) -> None:
        """Shows all sites, under what nobody may overlook."""
        self._shown_ns = self._clock.monotonic_ns()
        if self._live is None:
            shouted = [f"*** {name} {alarm}" for name, alarm in alarms]
            titled = [title] if title != self._title else []
            self._title = title
            for line in [
                *titled,
                *shouted,
                *(describe_row(row) for row in rows if row["time"]),
            ]:
                self.say(line)
            return
        table = Table(title=escape(title), title_justify="left")
        for head in HEADS:
            table.add_column(head, justify="right" if head in NUMBERS else "left")
        for row in rows:
            table.add_row(*map(escape, row.values()))
        self._live.start()  # not before: what ends at a signal until then could not restore the terminal
        self._live.update(Group(*frame_alarms(alarms), table), refresh=True)


class SessionMonitor:
    """What the sites of a session that is started here say of themselves, on a display."""

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
        """Takes the messages that have arrived, and shows them when that is due."""
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
            known = [
                (name, self.records.get(name), self.latest.get(name)) for name in scenario.names
            ]
            rows = [describe_site(scenario, *one) for one in known]
            self._display.show(f"{scenario.name}, {scenario.duration_s:g} s", rows)

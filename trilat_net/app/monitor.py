"""Displays a running session in a terminal, with one row per site.

The commands `trilat demo` and `trilat watch` use this module. In a terminal, the rows form a
table that is refreshed four times a second. If the output is a file or a pipe, the rows are
printed as plain lines every two seconds.
"""

from collections.abc import Sequence

import numpy as np
from rich.box import HEAVY
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from trilat_net.scenario import Scenario

from ..core import HandInForce, LifeAlarm
from ..log import compute_task_errors
from ..net import Clock, Event, LinkStats, SessionMembers, State
from ..records import NS_PER_S

AGES = "age of each peer's sample"
"""Heading of the column with the ages of the peers' samples."""
_HEADINGS = (
    "site",
    "time",
    "mode",
    "angles",
    "|e|",
    "torque",
    AGES,
    "held",
    "late",
    "overruns",
)
"""Headings of the columns of the table."""
NUMBERS = frozenset(("time", "|e|", "torque", "late", "overruns"))
"""Headings of the columns that are aligned to the right."""
TABLE_NS = NS_PER_S // 4
"""Time between two updates of the table, in ns."""
LINES_NS = 2 * NS_PER_S
"""Time between two updates of the lines, in ns."""
LOUD_EVENTS = frozenset(
    ("lost", "left", "join", "unheard", "heard", "diverged", "failed", "refused", "clock fault")
)
"""Kinds of events whose sentences are printed."""


class StatusRow(dict[str, str]):
    """Row of a table of sites, as a mapping from column heading to cell text.

    The row shows the status of one site. A cell is empty if its content is unknown.
    """

    @classmethod
    def of_site(
        cls,
        scenario: Scenario,
        name: str,
        record: State | None,
        stats: LinkStats | None,
        *,
        ended: bool = False,
        silent_s: float = 0.0,
    ) -> "StatusRow":
        """Builds the row of one site, with its mode, joint angles, torque and so on.

        The cells are filled from the latest record and statistics of the site.

        Args:
            scenario: Scenario of the session.
            name: Name of the site.
            record: Record of the site's latest tick. `None` if no record has arrived.
            stats: Latest statistics of the site. `None` if no statistics have arrived.
            ended: True if the site has announced that it ended.
            silent_s: Time since the last message from the site arrived, in s.
        """
        row = cls(dict.fromkeys(_HEADINGS, ""), site=name, mode="braked")
        if stats is not None:
            age_texts = []
            for peer, age_us in stats.age_us.items():
                has_arrived = age_us >= 0
                age_text = f"{age_us / 1000:.0f} ms" if has_arrived else "none"
                age_texts.append(f"{peer} {age_text}")
            row.update(
                {
                    "time": f"{stats.t_ns / NS_PER_S:.1f} s",
                    "mode": stats.mode,
                    AGES: ", ".join(age_texts),
                    "late": f"{stats.late_max_us} us",
                    "overruns": f"{stats.overruns}",
                }
            )

        if record is not None:
            row.update(_describe_record(scenario, name, record))

        if ended:
            row["mode"] = "ended"
        elif silent_s > 0.0:
            row["mode"] = f"silent {silent_s:.0f} s"
        return row

    @classmethod
    def of_pose(cls, name: str, t_s: float, q: Sequence[float]) -> "StatusRow":
        """Builds the row of an arm for which only the pose at one time is known.

        Args:
            name: Name of the site.
            t_s: Time of the pose, in s.
            q: Joint angles in rad. Empty if they are unknown.
        """
        row = cls(dict.fromkeys(_HEADINGS, ""), site=name)
        if q:
            row["time"] = f"{t_s:.3f} s"
            row["angles"] = _describe_angles(q)
        return row

    def describe(self) -> str:
        """Formats the row as a line of text, for output that cannot show a table.

        Only the most important columns are included.
        """
        headings_by_label = {
            "|e|": "|e|",
            "torque": "torque",
            "age": AGES,
            "hand": "held",
            "late": "late",
        }
        texts = [f"{self['site']} {self['time']} {self['mode']}".strip(), self["angles"]]
        for label, heading in headings_by_label.items():
            if self[heading]:
                texts.append(f"{label} {self[heading]}")
        return "; ".join(texts)


def _describe_record(scenario: Scenario, name: str, record: State) -> dict[str, str]:
    """Returns those texts of an arm's table row that describe its newest record.

    The display of `trilat demo` and `trilat watch` has one row per arm.

    Args:
        scenario: Scenario of the session.
        name: Name of the site.
        record: The record, which is the result of one tick of the site.

    Returns:
        Time, mode, joint angles, norm of the synchronisation error, largest torque, and whether
        an operator moves the arm, by the headings of the columns.
    """
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
        "angles": _describe_angles(record.q),
        "|e|": f"{np.linalg.norm(error):.4f} {unit}",
        "torque": f"{max(map(abs, record.tau)):.2f} N m",
        "held": _describe_hold(hand),
    }


def _describe_hold(hand: HandInForce | None) -> str:
    """Returns the table text that says whether a person or a program moves the arm.

    The text stands in the column "held".

    Args:
        hand: State of the operator in the record. `None` if nobody may move the arm during the
            run.

    Returns:
        "yes" if an operator moves the arm. "fades" just after the operator has released it,
        while the force is reduced to zero. "free" afterwards. Empty if nobody may move it.
    """
    if hand is None:
        return ""
    has_operator = hand.source != 0
    if has_operator:
        return "yes"
    is_fading = hand.grip > 0.0
    return "fades" if is_fading else "free"


def _describe_angles(q: Sequence[float]) -> str:
    """Formats the joint angles of an arm, in rad, briefly enough for a column of the table."""
    return " ".join(f"{angle:+.3f}" for angle in q) + " rad"


def _frame_alarms(alarms: Sequence[tuple[str, LifeAlarm]]) -> list[Panel]:
    """Composes a coloured panel for the terminal for each arm that needs attention.

    A panel is red if the arm stays stopped until a user acts. It is yellow if the arm continues
    by itself.

    Args:
        alarms: Pairs of the name of a site (the process that controls an arm) and its alarm.

    Returns:
        The panels in the order of the alarms. Each contains the reason, and advice to the user.
    """
    panels = []
    for name, alarm in alarms:
        colour = "red" if alarm.word in ("FAULT", "STOPPED") else "yellow"
        heading = f" {name} {alarm.word} "
        text = Text.assemble(
            (heading, f"bold reverse {colour}"), f"  {alarm.reason}\n", (alarm.advice, "bold")
        )
        panels.append(Panel(text, box=HEAVY, border_style=f"bold {colour}"))
    return panels


class SessionDisplay:
    """Terminal output of a running session: a table of the sites, with messages above it.

    Used as a context manager, which restores the terminal on exit.

    Args:
        console: The terminal.
        clock: Clock of this process.
    """

    def __init__(self, console: Console, clock: Clock) -> None:
        self._console = console
        self._clock = clock
        # The table of the terminal. None if the output is a file or a pipe.
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
        """True if enough time has passed since the last update of the display.

        The table in a terminal is updated more often than lines are written to a file. The rate
        is limited, because drawing takes time and nobody could follow faster changes.
        """
        period_ns = TABLE_NS if self._live else LINES_NS
        return self._clock.monotonic_ns() - self._updated_ns >= period_ns

    def say(self, text: str) -> None:
        """Prints a line, such as an event, above the table.

        The line stays in place while the table below it is refreshed.

        Args:
            text: The line to print.
        """
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(
        self,
        title: str,
        rows: Sequence[StatusRow],
        alarms: Sequence[tuple[str, LifeAlarm]] = (),
    ) -> None:
        """Refreshes the table of sites, and the alarms above it.

        An alarm is shown for as long as it persists.

        Args:
            title: Title of the table.
            rows: Rows of the sites.
            alarms: The current alarms, as pairs of site name and alarm.
        """
        self._updated_ns = self._clock.monotonic_ns()
        if self._live is None:  # the output is not a terminal
            alarm_lines = [f"*** {name} {alarm}" for name, alarm in alarms]
            title_lines = [title] if title != self._title else []
            self._title = title
            row_lines = [row.describe() for row in rows if row["time"]]
            for line in [*title_lines, *alarm_lines, *row_lines]:
                self.say(line)
            return

        table = Table(title=escape(title), title_justify="left")
        for heading in _HEADINGS:
            table.add_column(heading, justify="right" if heading in NUMBERS else "left")
        for row in rows:
            table.add_row(*map(escape, row.values()))
        # The table is started only now. If it was started before the `with` block, a signal
        # before the first update would leave the terminal in a wrong state.
        self._live.start()
        self._live.update(Group(*_frame_alarms(alarms), table), refresh=True)


class SessionMonitor:
    """Receives the messages of all sites of a session, and shows them on a display.

    A program that watches a session creates one monitor and calls `poll` repeatedly.

    Args:
        members: Members of the session, whose messages are shown.
        scenario: Scenario of the session.
        display: Display that shows the state of each site as a table row.

    Attributes:
        latest: Latest statistics of each site, keyed by site name.
        records: Latest record of each site, keyed by site name.
    """

    def __init__(
        self,
        members: SessionMembers,
        scenario: Scenario,
        display: SessionDisplay,
    ) -> None:
        self.latest: dict[str, LinkStats] = {}
        self.records: dict[str, State] = {}
        self._scenario = scenario
        self._display = display
        self._read_statistics = members.subscribe(LinkStats, capacity=256)
        self._read_events = members.subscribe(Event, capacity=256)
        # Only the newest record of a site is shown, so a capacity of one message suffices.
        self._record_readers = {}
        for name in scenario.names:
            layout = scenario.layout(name)
            self._record_readers[name] = members.subscribe(
                State, name, capacity=1, layout=layout
            )

    def poll(self) -> None:
        """Processes the messages that have arrived, and refreshes the display when due.

        Important events are printed above the table. This method never blocks.
        """
        scenario = self._scenario
        for stats in self._read_statistics():
            if stats.site in self._record_readers:
                self.latest[stats.site] = stats
        for event in self._read_events():
            if event.kind in LOUD_EVENTS:
                self._display.say(event.text)
        for name, read_records in self._record_readers.items():
            for record in read_records():
                self.records[name] = record

        if self._display.due:
            rows = [
                StatusRow.of_site(scenario, name, self.records.get(name), self.latest.get(name))
                for name in scenario.names
            ]
            self._display.show(f"{scenario.name}, {scenario.duration_s:g} s", rows)

"""A whole session on one machine: starts every site and the recorder as processes, monitors and ends them.

Invariant: in every case the recorder ends last and no child is left on return. The children have process
sessions of their own, so that Ctrl-C reaches them through this process, in that order.
"""

import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from trilat_net.core.jit import is_core_cached
from trilat_net.net import topics
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import choose_session_endpoints
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.process import Interrupt
from trilat_net.scenario import Scenario

from .monitor import SessionDisplay, SessionMonitor
from .warmup import warm_up

POLL_NS = 100_000_000
END_S = 15
"""How long a child may take to end once it was asked to; then it is killed."""


@dataclass(slots=True)
class SessionResult:
    """How a session ended.

    Attributes:
        log: its log.
        problems: what went wrong, in order; empty where nothing did.
        interrupted: number of the signal that ended it, or 0.
    """

    log: Path
    problems: list[str] = field(default_factory=list)
    interrupted: int = 0


class _Child:
    """One process of the session, with what it prints in a file."""

    def __init__(self, name: str, arguments: Sequence[str], folder: Path) -> None:
        self.name = name
        self._asked = False
        self.printed = folder / f"{name}.txt"
        with self.printed.open("wb") as sink:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "trilat_net", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def code(self) -> int | None:
        """Returns the exit code, negative for a signal, or None while it runs."""
        return self._process.poll()

    def end(self, number: int) -> None:
        """Asks the process to end, or kills it."""
        if self.code() is None:
            self._asked = True
            self._process.send_signal(number)

    def problem(self) -> str | None:
        """Says how the process failed, or None where it did not."""
        code = self.code()
        if code in (0, None) or (self._asked and code == 128 + signal.SIGINT):
            return None
        if code is not None and code < 0:
            return f"{self.name} was killed by {signal.Signals(-code).name}"
        lines = self.printed.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = lines[-1].removeprefix("error: ") if lines else "it said nothing"
        return f"{self.name} ended with code {code}: {last}"


def demo_session_name(scenario: Scenario) -> str:
    """Returns what the session of a demo is called, for `trilat set` and `trilat ping`."""
    return f"{scenario.name}-demo"


def run_demo(scenario: Scenario, folder: Path, display: SessionDisplay) -> SessionResult:
    """Runs a session of all sites and a recorder, from start to end.

    Args:
        scenario: the experiment.
        folder: where the log and what the processes print go; exists.
        display: where progress is shown.

    Returns:
        How it ended. The log is valid in every case in which a session began.
    """
    outcome = SessionResult(folder / "run.mcap")
    with Interrupt() as interrupt:
        if not is_core_cached():
            display.say("compiling, once for this machine ...")
            with interrupt.raising():
                warm_up(scenario, scenario.names[0])  # once for all children
        session = demo_session_name(scenario)
        endpoints = choose_session_endpoints(session, scenario.names)
        children, recorder = _start(scenario, folder, session, endpoints)
        for name in scenario.external:
            place = f"{topics.key(session, name, topics.MEASURED)} at {endpoints[scenario.names.index(name)]}"
            display.say(f"{name} waits for its arm on {place}; see docs/external-arm.md")
        clock = SystemClock()
        try:
            with closing(ZenohBus([], endpoints)) as bus:
                watch = SessionMonitor(bus, session, scenario.names)
                _supervise(watch, display, children, recorder, interrupt, outcome, clock)
        finally:
            _end_all(children, recorder, clock)
        outcome.interrupted = interrupt.number
    for child in [*children, recorder]:
        problem = child.problem()
        if problem and not outcome.interrupted and problem not in outcome.problems:
            outcome.problems.append(problem)
    return outcome


def _start(
    scenario: Scenario, folder: Path, session: str, endpoints: list[str]
) -> tuple[list[_Child], _Child]:
    """Starts every site and the recorder; what they print goes into `processes/`."""
    text = folder / "scenario.toml"
    text.write_text(scenario.text, encoding="utf-8")
    printed = folder / "processes"
    printed.mkdir(exist_ok=True)
    children = [
        _Child(name, _site_arguments(name, text, session, endpoints, n), printed)
        for n, name in enumerate(scenario.names)
    ]
    connect = [word for endpoint in endpoints for word in ("--connect", endpoint)]
    log = str(folder / "run.mcap")
    Path(log).unlink(missing_ok=True)  # an earlier run's, in a folder that may be replaced
    arguments = ["record", "--session", session, *connect, "-o", log, "--join-timeout", "60", "--force"]
    return children, _Child(topics.RECORDER, arguments, printed)


def _site_arguments(name: str, scenario: Path, session: str, endpoints: list[str], n: int) -> list[str]:
    connect = [word for endpoint in endpoints[:n] for word in ("--connect", endpoint)]
    return [
        "site",
        name,
        "--scenario",
        str(scenario),
        "--session",
        session,
        "--listen",
        endpoints[n],
        *connect,
        "--needs-recorder",
    ]


def _supervise(
    watch: SessionMonitor,
    display: SessionDisplay,
    children: list[_Child],
    recorder: _Child,
    interrupt: Interrupt,
    outcome: SessionResult,
    clock: Clock,
) -> None:
    """Shows progress until every process has ended, one has failed, or a signal has come."""
    while not interrupt.requested():
        watch.poll()
        display.update(watch.latest)
        for sentence in watch.take_news():
            display.say(sentence)
        everyone = [*children, recorder]
        failed = [problem for child in everyone if (problem := child.problem())]
        if failed:
            outcome.problems += failed
            return
        if all(child.code() == 0 for child in everyone):
            return
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)


def _end_all(children: list[_Child], recorder: _Child, clock: Clock) -> None:
    """Ends the sites, then the recorder, which by then has what they had to say."""
    for group in (children, [recorder]):
        for child in group:
            child.end(signal.SIGINT)
        give_up_ns = clock.monotonic_ns() + END_S * 1_000_000_000
        while any(child.code() is None for child in group):
            if clock.monotonic_ns() > give_up_ns:
                for child in group:
                    child.end(signal.SIGKILL)
            clock.sleep_until(clock.monotonic_ns() + POLL_NS // 10)

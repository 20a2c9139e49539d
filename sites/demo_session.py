"""A whole session on one machine: starts every site and the recorder as processes, monitors and
ends them.

They are copies of one process, the starter, which has loaded everything: a copy begins in a
tenth of the time that an interpreter takes. What is copied has no connection, no thread of its
own and no code of the user's.

Invariant: in every case the recorder ends last and no child is left on return, nor if this
process is killed; if the starter is, all are asked to end. The children have process sessions
of their own, so that Ctrl-C reaches them through this process, in that order.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from rich.console import Console
from setproctitle import setproctitle

from trilat_net.core.jit import compiling_notice, is_core_cached
from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import LogRefused, RunFailed
from trilat_net.files import (
    create_file,
    find_page,
    make_results_folder,
    make_subfolder,
    write_whole,
)
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net import topics
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import reserve_session_endpoints
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.process import Interrupt, freeze_gc
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.code_consent import list_imported_code
from trilat_net.scenario.operators.program_hand import find_own_hand
from trilat_net.scenario.validate import check_outside_arms

from .machine_load import describe_load, measure_busy_share
from .monitor import SessionDisplay, SessionMonitor
from .site_parts import warm_up

POLL_NS = 100_000_000
START_S = 10
"""Time for a site to start, s, where many share a few processors."""
JOIN_S = 60
WAIT_S = 600
"""For so long sites wait for each other and for the recorder, s; the second where people begin
a session.
"""
END_TIMEOUT_NS = 45 * NS_PER_S
"""Time for a child to end after its signal; then it is killed. A site waits 10 s for the
recorder, and as long again after every question of one that was behind.
"""
RECORDER_NS = 2 * NS_PER_S
"""Time for the recorder to write what is under way, once all sites have ended."""


@dataclass(slots=True)
class SessionResult:
    """How a session ended: what failed, in order, the number of the signal that ended it, or 0;
    and a code.

    The exit code is that of a run that failed, or of a disk that took no more.
    """

    log: Path
    problems: list[str] = field(default_factory=list)
    interrupted: int = 0
    exit_code: int = RunFailed.exit_code


class SessionProcess:
    """A process of a session: its number once it has begun, its exit code once it has ended."""

    def __init__(self, starter: "ProcessStarter", name: str, output: Path) -> None:
        self.name = name
        self.output = output
        self.pid: int | None = None
        self.code: int | None = None
        self._starter = starter
        self._signalled = False

    def end(self, number: int) -> None:
        """Sends it a signal, unless it has ended."""
        if self.code is None:
            self._signalled = True
            self._starter.signal(self, number)

    def problem(self) -> str | None:
        """Describes how the process failed; None if it did not."""
        code = self.code
        if self._signalled and self.pid is None:
            return None  # the signal met the starter: an interpreter that still starts ends with any code
        if code in (0, None) or (
            self._signalled and code in (128 + signal.SIGINT, -signal.SIGINT)
        ):
            return None  # a process that ends anyway has no handler any more
        if code is not None and code < 0:
            return f"{self.name} was killed by {signal.Signals(-code).name}"
        lines = self.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = lines[-1].removeprefix("error: ") if lines else "it printed nothing"
        return f"{self.name} ended with code {code}: {last}"


class ProcessStarter:
    """Starts the processes of a scenario's session on this machine; what each prints is kept in
    a folder.
    """

    def __init__(self, scenario_file: Path, folder: Path) -> None:
        self._folder = folder
        self._output = folder / "starter.txt"
        self._processes: dict[str, SessionProcess] = {}
        self._orders, theirs = Pipe()
        with theirs, create_file(self._output) as sink:
            # see `run_starter`
            words = [
                "start-processes",
                str(theirs.fileno()),
                str(scenario_file),
            ]
            self._starter = subprocess.Popen(
                [sys.executable, "-m", "trilat_net", *words],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=[theirs.fileno()],
            )

    def start(self, name: str, words: Sequence[str]) -> SessionProcess:
        """Starts a command, given by its words, as a process of a name that no other has."""
        started = SessionProcess(self, name, self._folder / f"{name}.txt")
        create_file(started.output).close()  # here, where a disk that refuses it is told of
        self._processes[name] = started
        self._order(name, [*words], 0, started.output)
        return started

    def signal(self, process: SessionProcess, number: int) -> None:
        """Sends a process a signal; one that has not begun never will."""
        self._order(process.name, [], number, process.output)
        self._starter.send_signal(signal.SIGINT)  # which it ignores from its first order on

    def _order(self, *order: Any) -> None:
        with suppress(OSError):  # the starter has failed, which `poll` finds
            self._orders.send(order)

    def poll(self) -> None:
        """Takes note of what has begun and ended."""
        try:
            while self._orders.poll():
                name, pid, code = self._orders.recv()
                self._processes[name].pid = pid
                self._processes[name].code = code
        except (EOFError, OSError):
            code = self._starter.wait()
            for left in self._processes.values():
                if left.code is None:
                    left.code = code
                    left.output = self._output
                    if left.pid is not None:
                        with suppress(ProcessLookupError):
                            os.kill(left.pid, signal.SIGINT)

    def close(self) -> None:
        """Ends the starter, after all that it has started."""
        self._orders.close()
        self._starter.send_signal(signal.SIGINT)
        self._starter.wait()


SessionAttendant = Callable[
    [str, Sequence[str], Callable[[str], None]], AbstractContextManager[Callable[[], bool]]
]
"""Given a session's name, the endpoints of its sites and what tells people, a context that
lasts as long as the session; what it yields returns true once the session is to end.
"""


def run_demo(
    scenario: Scenario,
    folder: Path,
    console: Console,
    attend: SessionAttendant | None = None,
    begins: Callable[[], bool] | None = None,
) -> SessionResult:
    """Runs a session of all sites and a recorder, by the scenario's name, as single sites do.

    Its log is valid whenever the session began. Given `begins`, the sites wait for the recorder
    until it returns true, at most `WAIT_S`; so the session begins a second or two after that.

    Raises:
        ScenarioError: an arm outside of the program lacks limits.
    """
    check_outside_arms(scenario)
    result = SessionResult(folder / "run.mcap")
    session = scenario.name
    clock = SystemClock()
    with (
        SessionDisplay(console, clock) as display,
        Interrupt() as interrupt,
        ExitStack() as reserved,
    ):
        compile_core(scenario, display.say, interrupt)
        if warning := describe_load(measure_busy_share(clock)):
            display.say(f"warning: {warning}")
        endpoints = reserved.enter_context(reserve_session_endpoints(session, scenario.names))
        patience_s = JOIN_S if begins is None else WAIT_S
        starter, sites, start_recorder = _start(
            scenario=scenario,
            folder=folder,
            reserved=reserved,
            endpoints=endpoints,
            wait_s=patience_s,
        )
        recorder: list[SessionProcess] = []
        display.say(f"others connect to {', '.join(endpoints)}")
        for name in scenario.outside:
            place = f"{topics.key(session, name, topics.MEASURED)} at {endpoints[scenario.names.index(name)]}"
            display.say(
                f"{name} waits for its arm on {place}; see {find_page('external-arm.md')}"
            )
        attending = (
            nullcontext(lambda: False)
            if attend is None
            else attend(session, endpoints, display.say)
        )
        try:
            with closing(ZenohBus([], endpoints)) as bus, attending as is_enough:
                monitor = SessionMonitor(bus, session, scenario, display)
                while not (
                    interrupt.is_requested()
                    or is_enough()
                    or _is_over([*sites, *recorder], result)
                ):
                    if not recorder and (begins is None or begins()):
                        recorder.append(start_recorder())
                    monitor.poll()
                    clock.sleep_until(clock.monotonic_ns() + POLL_NS)
                    starter.poll()
        finally:
            _end_all(
                starter=starter,
                sites=sites,
                recorder=recorder,
                clock=clock,
                interrupt=interrupt,
                say=display.say,
            )
        result.interrupted = interrupt.number
    for child in [*sites, *recorder]:
        problem = child.problem()
        if child.code == LogRefused.exit_code:
            result.exit_code = LogRefused.exit_code
        if problem and not result.interrupted and problem not in result.problems:
            result.problems.append(problem)
    return result


def compile_core(scenario: Scenario, say: Callable[[str], None], interrupt: Interrupt) -> None:
    """Compiles what a scenario's arms need, if it may not be cached; a signal interrupts it."""
    layouts = {arm.counts: name for name, arm in scenario.arms.items()}
    chains = any(arm.chain is not None for arm in scenario.arms.values())
    # what is cached may be of arms with other numbers of joints
    if chains or not is_core_cached():
        compiling_notice.report = say
        with interrupt.raising():
            for name in layouts.values():
                warm_up(scenario, name)


def _start(
    scenario: Scenario, folder: Path, reserved: ExitStack, endpoints: list[str], wait_s: int
) -> tuple[ProcessStarter, list[SessionProcess], Callable[[], SessionProcess]]:
    file = folder / "scenario.toml"
    log = folder / "run.mcap"
    output = folder / "processes"
    write_whole(file, scenario.text)
    make_subfolder(output)
    log.unlink(missing_ok=True)  # of an earlier run, in a folder that may be replaced
    starter = reserved.enter_context(closing(ProcessStarter(file, output)))
    session = scenario.name
    connect = [["--connect", endpoint] for endpoint in endpoints]
    patience = ["--join-timeout", str(max(wait_s, START_S * len(endpoints)))]
    sites = [
        starter.start(
            name,
            [
                *(
                    "site",
                    name,
                    "--scenario",
                    str(file),
                    "--session",
                    session,
                    "--listen",
                    endpoints[n],
                ),
                *chain(*connect[:n]),
                *("--needs-recorder", *patience),
            ],
        )
        for n, name in enumerate(scenario.names)
    ]
    for n, name in enumerate(scenario.names):
        at = find_own_hand(scenario, name)
        if at is not None and at.has_separate_process:
            words = ["hand", name, "--scenario", str(file), "--session", session]
            sites.append(starter.start(f"hand-{name}", [*words, *connect[n], *patience]))
    arguments = ["record", "--session", session, *chain(*connect), "-o", str(log)]
    return (
        starter,
        sites,
        lambda: starter.start(topics.RECORDER, [*arguments, *patience, "--force"]),
    )


def _is_over(children: list[SessionProcess], result: SessionResult) -> bool:
    result.problems += [problem for child in children if (problem := child.problem())]
    return bool(result.problems) or all(child.code == 0 for child in children)


def _end_all(
    starter: ProcessStarter,
    sites: list[SessionProcess],
    recorder: list[SessionProcess],
    clock: Clock,
    interrupt: Interrupt,
    say: Callable[[str], None],
) -> None:
    """Ends the sites, then the recorder, which by then has all their messages.

    A second signal of the user's reaches all of them, and ends them at once.
    """
    tell = partial(
        say,
        "the sites keep their last records until the recorder has them, 10 s at most; "
        "Ctrl-C a second time ends it at once",
    )
    _end_group(
        starter=starter, group=sites, clock=clock, insists=interrupt.is_repeated, tell=tell
    )
    sites_left_ns = clock.monotonic_ns()

    def may_insist() -> bool:
        """True once the recorder has had its time: without sites there is nothing that it could
        ask for.
        """
        return interrupt.is_repeated() or clock.monotonic_ns() - sites_left_ns > RECORDER_NS

    _end_group(
        starter=starter, group=recorder, clock=clock, insists=may_insist, tell=lambda: None
    )


def _end_group(
    starter: ProcessStarter,
    group: list[SessionProcess],
    clock: Clock,
    insists: Callable[[], bool],
    tell: Callable[[], None],
) -> None:
    """Ends processes in order, at once when `insists` returns True; `tell` says why it takes
    long.
    """
    for process in group:
        process.end(signal.SIGINT)
    begun_ns = clock.monotonic_ns()
    is_told = has_insisted = False
    while any(process.code is None for process in group):
        waited_ns = clock.monotonic_ns() - begun_ns
        if insists() and not has_insisted:
            has_insisted = True
            for process in group:
                process.end(signal.SIGINT)
        if waited_ns > NS_PER_S and not is_told:
            is_told = True
            tell()
        if waited_ns > END_TIMEOUT_NS:
            for process in group:
                process.end(signal.SIGKILL)
        clock.sleep_until(clock.monotonic_ns() + POLL_NS // 10)
        starter.poll()


def run_starter(number: int, scenario_file: str) -> list[str] | None:
    """Starts and signals processes as ordered until nobody is there; in each process it returns
    its words.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    scenario = load_scenario(scenario_file)
    # code of the user's is loaded where it runs, and nowhere else
    if not list_imported_code([scenario]):
        for name in {arm.counts: name for name, arm in scenario.arms.items()}.values():
            warm_up(scenario, name)
    freeze_gc()
    # Blocked and not ignored: a copy would lose the signal that meets it before it has a handler.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return _Starter(Connection(number)).serve()


class _Starter:
    def __init__(self, orders: Connection) -> None:
        self._orders = orders
        self._running: dict[str, int] = {}

    def serve(self) -> list[str] | None:
        words: list[str]
        while True:
            self._report_ends()
            try:
                if not self._orders.poll(POLL_NS / 10 / NS_PER_S):
                    continue
                name, words, number, output = self._orders.recv()
            except (EOFError, OSError):
                self._end_all()
                return None
            if not number and self._fork(name):
                _become(words, output)
                return words
            if number and name in self._running:
                os.kill(self._running[name], number)

    def _fork(self, name: str) -> bool:
        """Copies this process; true in the copy."""
        if pid := os.fork():
            self._running[name] = pid
            self._report(name, pid, None)
            return False
        self._orders.close()
        return True

    def _report_ends(self) -> None:
        for name, pid in list(self._running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                del self._running[name]
                self._report(name, pid, os.waitstatus_to_exitcode(status))

    def _report(self, *news: Any) -> None:
        with suppress(OSError):  # whoever asked is gone, as the next look at its orders finds
            self._orders.send(news)

    def _end_all(self) -> None:
        recorder = (
            [self._running.pop(topics.RECORDER)] if topics.RECORDER in self._running else []
        )
        for pids in (list(self._running.values()), recorder):
            for pid in pids:
                os.kill(pid, signal.SIGINT)
            for pid in pids:
                os.waitpid(pid, 0)


def _become(words: list[str], output: Path) -> None:
    """Makes a copy what a shell would have started: its name, session, output and signals."""
    os.setsid()
    sink = os.open(output, os.O_WRONLY | os.O_NOFOLLOW)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(sink, stream.fileno())
    os.close(sink)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    setproctitle(" ".join(["trilat", *words]))


def run(
    scenario: str | Path | Mapping[str, Any] | Scenario,
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    duration_s: float | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    force: bool = False,
    quiet: bool = True,
) -> Log:
    """Runs a scenario live, a process per site and a recorder over Zenoh, and returns its log.

    The command is `trilat demo`, which reports on the log too: `tn.report(log)`.

    >>> log = tn.run("two_sites", duration_s=2)
    >>> tn.verify(log).passed
    True

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        set: overrides, as in `{"control.Kd": 5}`.
        duration_s: the duration of the run, s; by default the scenario's.
        seed: the seed; by default the scenario's.
        out: folder of the log; by default the next free runs/NAME-N.
        force: whether it may hold something already.
        quiet: whether nothing is printed while it runs.

    Raises:
        ScenarioError: the scenario or an override is not valid.
        RunFailed: a process failed, or the run was interrupted; it says what the log holds.
    """
    chosen = load_scenario(scenario, set, duration_s=duration_s, seed=seed)
    folder = make_results_folder(None if out is None else Path(out), chosen.name, force=force)
    result = run_demo(chosen, folder, Console(quiet=quiet))
    problems = ["interrupted"] if result.interrupted else result.problems
    if problems:
        kept = f"; {result.log} holds what there was" if result.log.exists() else ""
        raise RunFailed("; ".join(problems) + kept)
    log = open_log(result.log)
    log.warn_if_diverged()
    return log

"""A whole session on one machine: starts all sites and the recorder, watches and ends them.

The processes are copies of one process, the starter, which has loaded everything: a copy starts
in a tenth of the time that an interpreter takes. The copied process has no connection, no
threads of its own and no user's code.

Invariant:
    - The recorder always ends last, and no child process is left on return, even if this
      process is killed. If the starter is killed, all processes are asked to end.
    - The children have process sessions of their own, so that Ctrl-C reaches them through this
      process, in that order.
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
"""Time for a site to start, s, if many of them share a few processors."""
JOIN_S = 60
"""Longest wait of the sites for each other and for the recorder, s."""
WAIT_S = 600
"""The same wait if people begin the session, s."""
END_TIMEOUT_NS = 45 * NS_PER_S
"""Time for a child to end after its signal; then it is killed.

A site waits 10 s for the recorder, and as long again after each query of a recorder that lacks
messages.
"""
RECORDER_NS = 2 * NS_PER_S
"""Time for the recorder to write the last messages after all sites have ended."""


@dataclass(slots=True)
class SessionResult:
    """How a session ended.

    Attributes:
        log: the path of the log.
        problems: what failed, in order.
        interrupted: the number of the signal that ended the session, or 0.
        exit_code: the code of a failed run, or of a disk that refused the log.
    """

    log: Path
    problems: list[str] = field(default_factory=list)
    interrupted: int = 0
    exit_code: int = RunFailed.exit_code


class SessionProcess:
    """A process of a session.

    Attributes:
        name: the name of the process, such as that of its site.
        output: the file with everything that the process prints.
        pid: its process number; None before it has started.
        code: its exit code; None before it has ended.
    """

    def __init__(self, starter: "ProcessStarter", name: str, output: Path) -> None:
        self.name = name
        self.output = output
        self.pid: int | None = None
        self.code: int | None = None
        self._starter = starter
        self._signalled = False

    def end(self, number: int) -> None:
        """Sends the process a signal, unless it has ended."""
        if self.code is None:
            self._signalled = True
            self._starter.signal(self, number)

    def problem(self) -> str | None:
        """Describes how the process failed; returns None if it did not fail."""
        code = self.code
        if self._signalled and self.pid is None:
            # The signal met an interpreter that was still starting; it may end with any code.
            return None
        if code in (0, None):
            return None
        if self._signalled and code in (128 + signal.SIGINT, -signal.SIGINT):
            return None  # a process that is ending anyway has no signal handler any more
        if code is not None and code < 0:
            return f"{self.name} was killed by {signal.Signals(-code).name}"
        lines = self.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last_line = lines[-1].removeprefix("error: ") if lines else "it printed nothing"
        return f"{self.name} ended with code {code}: {last_line}"


class ProcessStarter:
    """Starts the processes of a session on this machine, and keeps their output in a folder.

    Args:
        scenario_file: the scenario of the session.
        folder: the folder for the outputs.
    """

    def __init__(self, scenario_file: Path, folder: Path) -> None:
        self._folder = folder
        self._output = folder / "starter.txt"
        self._processes: dict[str, SessionProcess] = {}
        self._pipe, child_end = Pipe()
        with child_end, create_file(self._output) as sink:
            # see `run_starter`
            arguments = [
                "start-processes",
                str(child_end.fileno()),
                str(scenario_file),
            ]
            self._starter = subprocess.Popen(
                [sys.executable, "-m", "trilat_net", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=[child_end.fileno()],
            )

    def start(self, name: str, arguments: Sequence[str]) -> SessionProcess:
        """Starts a command as a process.

        Args:
            name: a name that no other process has.
            arguments: the command and its arguments, without `trilat`.
        """
        process = SessionProcess(self, name, self._folder / f"{name}.txt")
        create_file(process.output).close()  # here, where a full disk is reported to the user
        self._processes[name] = process
        self._send_order(name, [*arguments], 0, process.output)
        return process

    def signal(self, process: SessionProcess, number: int) -> None:
        """Sends a process a signal; a process that has not started yet will not start."""
        self._send_order(process.name, [], number, process.output)
        # Interrupts a starter that still imports; it blocks the signal before its first order.
        self._starter.send_signal(signal.SIGINT)

    def _send_order(self, name: str, arguments: list[str], number: int, output: Path) -> None:
        with suppress(OSError):  # the starter has failed, which `poll` reports
            self._pipe.send((name, arguments, number, output))

    def poll(self) -> None:
        """Updates the processes by the starter's reports of starts and ends.

        If the starter has failed, all of its processes are asked to end.
        """
        try:
            while self._pipe.poll():
                name, pid, code = self._pipe.recv()
                self._processes[name].pid = pid
                self._processes[name].code = code
        except (EOFError, OSError):
            code = self._starter.wait()
            for process in self._processes.values():
                if process.code is not None:
                    continue
                process.code = code
                process.output = self._output
                if process.pid is not None:
                    with suppress(ProcessLookupError):
                        os.kill(process.pid, signal.SIGINT)

    def close(self) -> None:
        """Ends the starter; all processes that it has started have ended by then."""
        self._pipe.close()
        self._starter.send_signal(signal.SIGINT)
        self._starter.wait()


SessionAttendant = Callable[
    [str, Sequence[str], Callable[[str], None]], AbstractContextManager[Callable[[], bool]]
]
"""A function of a session's name, its endpoints, and a function that prints a line.

It returns a context that lasts as long as the session. The context yields a function that
returns True once the session is to end.
"""


def run_demo(
    scenario: Scenario,
    folder: Path,
    console: Console,
    attend: SessionAttendant | None = None,
    begins: Callable[[], bool] | None = None,
) -> SessionResult:
    """Runs a session of all sites and a recorder, under the scenario's name.

    Args:
        scenario: the scenario.
        folder: the folder of the log and of the processes' outputs.
        console: the terminal for the user.
        attend: observes the session and may end it.
        begins: returns True once the session may begin; the sites wait for the recorder until
            then, at most `WAIT_S`. The session begins a second or two later.

    Returns:
        How the session ended. The log is valid whenever the session has begun.

    Raises:
        ScenarioError: an external arm lacks limits.
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
            key = topics.key(session, name, topics.MEASURED)
            endpoint = endpoints[scenario.names.index(name)]
            page = find_page("external-arm.md")
            display.say(f"{name} waits for its arm on {key} at {endpoint}; see {page}")
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
    """Compiles the code that a scenario's arms need, unless it is cached.

    A signal interrupts the compilation.
    """
    layouts = {arm.counts: name for name, arm in scenario.arms.items()}
    chains = any(arm.chain is not None for arm in scenario.arms.values())
    # The cached code may be for chains with another number of joints.
    if chains or not is_core_cached():
        compiling_notice.report = say
        with interrupt.raising():
            for name in layouts.values():
                warm_up(scenario, name)


def _start(
    scenario: Scenario, folder: Path, reserved: ExitStack, endpoints: list[str], wait_s: int
) -> tuple[ProcessStarter, list[SessionProcess], Callable[[], SessionProcess]]:
    """Starts all sites and hands.

    Returns:
        The starter, the processes, and a function that starts the recorder.
    """
    file = folder / "scenario.toml"
    log = folder / "run.mcap"
    output = folder / "processes"
    write_whole(file, scenario.text)
    make_subfolder(output)
    log.unlink(missing_ok=True)  # of an earlier run, in a folder that may be replaced
    starter = reserved.enter_context(closing(ProcessStarter(file, output)))
    session = scenario.name
    common = ["--scenario", str(file), "--session", session]
    connect = [["--connect", endpoint] for endpoint in endpoints]
    patience = ["--join-timeout", str(max(wait_s, START_S * len(endpoints)))]
    processes = []
    for n, name in enumerate(scenario.names):
        arguments = ["site", name, *common, "--listen", endpoints[n]]
        arguments += [*chain(*connect[:n]), "--needs-recorder", *patience]
        processes.append(starter.start(name, arguments))
    for n, name in enumerate(scenario.names):
        own_hand = find_own_hand(scenario, name)
        if own_hand is not None and own_hand.has_separate_process:
            arguments = ["hand", name, *common, *connect[n], *patience]
            processes.append(starter.start(f"hand-{name}", arguments))
    record = ["record", "--session", session, *chain(*connect), "-o", str(log)]
    record += [*patience, "--force"]
    return starter, processes, lambda: starter.start(topics.RECORDER, record)


def _is_over(children: list[SessionProcess], result: SessionResult) -> bool:
    """Adds the problems of ended processes to the result; True if the session is over."""
    problems = [child.problem() for child in children]
    result.problems += [problem for problem in problems if problem]
    return bool(result.problems) or all(child.code == 0 for child in children)


def _end_all(
    starter: ProcessStarter,
    sites: list[SessionProcess],
    recorder: list[SessionProcess],
    clock: Clock,
    interrupt: Interrupt,
    say: Callable[[str], None],
) -> None:
    """Ends the sites, then the recorder, which has all their messages by then.

    A second signal of the user reaches all of them, and ends them at once.
    """
    announce = partial(
        say,
        "the sites keep their last records until the recorder has them, 10 s at most; "
        "Ctrl-C a second time ends it at once",
    )
    _end_group(
        starter=starter,
        group=sites,
        clock=clock,
        ends_now=interrupt.is_repeated,
        announce=announce,
    )
    sites_ended_ns = clock.monotonic_ns()

    def must_end_now() -> bool:
        """True if the user insists, or the recorder's time is over.

        After the end of the sites there are no more messages for the recorder to request.
        """
        return interrupt.is_repeated() or clock.monotonic_ns() - sites_ended_ns > RECORDER_NS

    _end_group(
        starter=starter,
        group=recorder,
        clock=clock,
        ends_now=must_end_now,
        announce=lambda: None,
    )


def _end_group(
    starter: ProcessStarter,
    group: list[SessionProcess],
    clock: Clock,
    ends_now: Callable[[], bool],
    announce: Callable[[], None],
) -> None:
    """Ends processes in order, and waits for them.

    Args:
        starter: the starter of the processes.
        group: the processes.
        clock: the clock of this process.
        ends_now: returns True to end the processes at once, by a second signal.
        announce: tells the user why the wait takes long.
    """
    for process in group:
        process.end(signal.SIGINT)
    begun_ns = clock.monotonic_ns()
    is_announced = False
    is_repeated = False
    while any(process.code is None for process in group):
        waited_ns = clock.monotonic_ns() - begun_ns
        if ends_now() and not is_repeated:
            is_repeated = True
            for process in group:
                process.end(signal.SIGINT)
        if waited_ns > NS_PER_S and not is_announced:
            is_announced = True
            announce()
        if waited_ns > END_TIMEOUT_NS:
            for process in group:
                process.end(signal.SIGKILL)
        clock.sleep_until(clock.monotonic_ns() + POLL_NS // 10)
        starter.poll()


def run_starter(number: int, scenario_file: str) -> list[str] | None:
    """Starts and signals processes on request, until the requesting process is gone.

    It returns in each started process, with the command and arguments of that process, and in
    the starter itself with None.

    Args:
        number: the file descriptor of the pipe to the requesting process.
        scenario_file: the scenario of the session.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    scenario = load_scenario(scenario_file)
    # A user's own code is imported only in the process that runs it.
    if not list_imported_code([scenario]):
        for name in {arm.counts: name for name, arm in scenario.arms.items()}.values():
            warm_up(scenario, name)
    freeze_gc()
    # Blocked, not ignored: a copy would lose a signal that arrives before it has a handler.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return _StarterProcess(Connection(number)).serve()


class _StarterProcess:
    """The starter's loop, and the processes that it has started."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._running: dict[str, int] = {}

    def serve(self) -> list[str] | None:
        """Executes orders; returns the arguments in a started process, None in the starter."""
        arguments: list[str]
        while True:
            self._report_ends()
            try:
                if not self._pipe.poll(POLL_NS / 10 / NS_PER_S):
                    continue
                name, arguments, number, output = self._pipe.recv()
            except (EOFError, OSError):
                self._end_all()
                return None
            if not number and self._fork(name):
                _become_process(arguments, output)
                return arguments
            if number and name in self._running:
                os.kill(self._running[name], number)

    def _fork(self, name: str) -> bool:
        """Copies this process; returns True in the copy."""
        if pid := os.fork():
            self._running[name] = pid
            self._report(name, pid, None)
            return False
        self._pipe.close()
        return True

    def _report_ends(self) -> None:
        for name, pid in list(self._running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                del self._running[name]
                self._report(name, pid, os.waitstatus_to_exitcode(status))

    def _report(self, name: str, pid: int, code: int | None) -> None:
        with suppress(OSError):  # the requesting process is gone, which `serve` notices next
            self._pipe.send((name, pid, code))

    def _end_all(self) -> None:
        recorder = (
            [self._running.pop(topics.RECORDER)] if topics.RECORDER in self._running else []
        )
        for pids in (list(self._running.values()), recorder):
            for pid in pids:
                os.kill(pid, signal.SIGINT)
            for pid in pids:
                os.waitpid(pid, 0)


def _become_process(arguments: list[str], output: Path) -> None:
    """Gives a copy the name, process session, output and signals of a process of a shell."""
    os.setsid()
    sink = os.open(output, os.O_WRONLY | os.O_NOFOLLOW)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(sink, stream.fileno())
    os.close(sink)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    setproctitle(" ".join(["trilat", *arguments]))


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
    """Runs a scenario live, with a process per site and a recorder, and returns its log.

    The command is `trilat demo`, which also reports on the log: `tn.report(log)`.

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
        force: whether the folder may contain files already.
        quiet: whether nothing is printed during the run.

    Raises:
        ScenarioError: the scenario or an override is not valid.
        RunFailed: a process failed, or the run was interrupted; the message says whether there
            is a log.
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

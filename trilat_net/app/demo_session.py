"""Runs a complete session on one machine, with one process per site and a recorder.

A session is a run in which several robot arms are coupled over a network. A site is a process
that runs one arm and its control loop. The recorder is a process that writes the log of the
session. `run_demo` runs such a session for the command `trilat demo`, and `run` does so for
Python programs.

All processes are forked from one process, the starter, which has imported all modules and
compiled the control code. Forking takes a tenth of the time needed to start a Python
interpreter. The starter has no network connection, no threads of its own and no user code,
because these cannot be forked safely.

Invariant:
    - The recorder always ends last, to receive the final messages of the sites.
    - No child process is left when a function returns, even if this process is killed. If the
      starter is killed, all processes receive a signal to end.
    - Each child runs in its own process session. Ctrl-C in the terminal therefore reaches only
      this process, which then ends the children in the right order.
"""

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from multiprocessing.connection import Connection as PipeEnd
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Any, BinaryIO

from rich.console import Console
from setproctitle import setproctitle

from sites import warm_up
from trilat_net.entry_points import COMMANDS, load_entry
from trilat_net.errors import LogRefused, RunFailed
from trilat_net.files import find_page, make_folder, make_results_folder, write_whole
from trilat_net.net import topics
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.signals import Interrupt

from ..core import compiling_notice, is_core_cached
from ..files import refuse_link
from ..log import Log, open_log
from ..net import Clock, Connection, DefaultEndpoints, SessionMembers, SystemClock
from ..records import NS_PER_S
from .machine_load import check_machine_load
from .monitor import SessionDisplay, SessionMonitor

POLL_NS = 100_000_000
"""Time between two updates of the display, in ns."""
START_S = 10
"""Time that a site may need to start if many sites share a few processors, in s."""
JOIN_S = 60
"""Longest wait of the sites for each other and for the recorder, in s."""
WAIT_S = 600
"""Longest wait of the sites if people decide when the session begins, in s."""
END_TIMEOUT_NS = 45 * NS_PER_S
"""Time after its signal at which a child that has not ended is killed, in ns.

A site waits 10 s for the recorder, and another 10 s after each query of a recorder that lacks
messages.
"""
RECORDER_NS = 2 * NS_PER_S
"""Time that the recorder may need to write the last messages after all sites have ended, in ns.
"""


@dataclass(slots=True)
class SessionResult:
    """Outcome of a session run by `run_demo`: the log, the problems and the exit code.

    Attributes:
        log: Path of the log. The file exists only if the session has begun.
        problems: One sentence per failure, in order of occurrence.
        interrupted: Number of the signal that ended the session, or 0 if none did.
        exit_code: Exit code for the command. It indicates whether the run failed or the log
            could not be written to the disk.
    """

    log: Path
    problems: list[str] = field(default_factory=list)
    interrupted: int = 0
    exit_code: int = RunFailed.exit_code


class SessionProcess:
    """State of one process of a session: a site, the recorder or an operator program.

    Created by `ProcessStarter`, which updates it from the reports of the starter process.

    Attributes:
        name: Name of the process: the name of its site, or "recorder".
        output: File that captures everything the process prints.
        pid: Process ID. `None` before the process has started.
        code: Exit code. `None` before the process has ended.
    """

    def __init__(self, starter: "ProcessStarter", name: str, output: Path) -> None:
        self.name = name
        self.output = output
        self.pid: int | None = None
        self.code: int | None = None
        self._starter = starter
        self._signalled = False

    def end(self, number: int) -> None:
        """Sends the process a signal, such as SIGTERM, to end it.

        Does nothing if the process has already ended.

        Args:
            number: Signal number.
        """
        if self.code is None:
            self._signalled = True
            self._starter.signal(self, number)

    def problem(self) -> str | None:
        """Returns a sentence that explains to the user how the process failed.

        Returns:
            A sentence with the exit code or signal, and the last line that the process printed.
                `None` if the process has not failed: it is still running, it exited with code
                0, or this process ended it with a signal.
        """
        exit_code = self.code
        if self._signalled and self.pid is None:
            # The signal has interrupted the start of the process, which may then end with any
            # exit code.
            return None

        if exit_code in (0, None):
            return None

        interrupted_codes = (128 + signal.SIGINT, -signal.SIGINT)
        if self._signalled and exit_code in interrupted_codes:
            # The process was already ending, and had removed its signal handler.
            return None
        if exit_code is not None and exit_code < 0:
            return f"{self.name} was killed by {signal.Signals(-exit_code).name}"

        lines = self.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last_line = lines[-1].removeprefix("error: ") if lines else "it printed nothing"
        return f"{self.name} ended with code {exit_code}: {last_line}"


def create_file(path: Path) -> BinaryIO:
    """Creates the file that captures the output of a process of a session.

    Users look for errors of the process in this file. It is unbuffered, so that nothing is lost
    in a crash. An existing file of that name is deleted.

    Args:
        path: Path of the file.

    Raises:
        UsageError: The path is a symbolic link.
        OSError: The file cannot be created.
    """
    refuse_link(path)
    path.unlink(missing_ok=True)
    return path.open("xb", buffering=0)


class ProcessStarter:
    """Starts the child processes of a session, and collects their output in a folder.

    Runs the starter as a child process (`run_starter`) and sends it requests through a pipe.
    Through the same pipe, the starter reports when a process has started or ended.

    Args:
        scenario_file: Path of the session's scenario file.
        folder: Folder for the output of each process.
    """

    def __init__(self, scenario_file: Path, folder: Path) -> None:
        self._folder = folder
        self._output = folder / "starter.txt"
        self._processes: dict[str, SessionProcess] = {}
        self._pipe, child_end = Pipe()
        with child_end, create_file(self._output) as sink:
            # The arguments of `run_starter`.
            arguments = ["start-processes", str(child_end.fileno()), str(scenario_file)]
            self._starter = subprocess.Popen(
                [sys.executable, "-m", "trilat_net", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=[child_end.fileno()],
            )

    def start(self, name: str, arguments: Sequence[str]) -> SessionProcess:
        """Asks the starter to run a `trilat` command as a child process.

        The starter has already imported all modules, so processes forked from it start quickly.

        Args:
            name: Name of the process, unique in the session.
            arguments: The command and its arguments, without `trilat`.

        Returns:
            The process, which may not have started yet.
        """
        process = SessionProcess(self, name, self._folder / f"{name}.txt")
        # Created in this process, so that a full disk is reported to the user.
        create_file(process.output).close()
        self._processes[name] = process
        self._send_order(name, [*arguments], 0, process.output)
        return process

    def signal(self, process: SessionProcess, number: int) -> None:
        """Sends a signal to a process of the session, for example to end it.

        A process that has not started yet is then never started.

        Args:
            process: Process returned by `start`.
            number: Signal number.
        """
        self._send_order(process.name, [], number, process.output)
        # This signal interrupts a starter that is still importing modules. A starter that is
        # ready has blocked it.
        self._starter.send_signal(signal.SIGINT)

    def _send_order(
        self,
        name: str,
        arguments: list[str],
        number: int,
        output: Path,
    ) -> None:
        """Sends a request to the starter: a start if `number` is 0, otherwise a signal.

        The starter creates the processes of the session as forks of itself.

        Args:
            name: Name of the process.
            arguments: The command and its arguments. Empty for a signal.
            number: Number of the signal. 0 requests a start.
            output: File for the output of the process.
        """
        with suppress(OSError):  # the starter has failed, which `poll` reports
            self._pipe.send((name, arguments, number, output))

    def poll(self) -> None:
        """Receives reports from the starter about which processes have started or ended.

        Updates the process ID or exit code of each process object. If the starter itself has
        failed, its processes are signalled to end and treated as ended with the starter's exit
        code.
        """
        try:
            while self._pipe.poll():
                name, pid, code = self._pipe.recv()
                self._processes[name].pid = pid
                self._processes[name].code = code
        except (EOFError, OSError):
            # The pipe is closed, because the starter has failed.
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
        """Ends the starter process.

        Call this method only after all other processes have ended, because they cannot be
        signalled without the starter.
        """
        self._pipe.close()
        self._starter.send_signal(signal.SIGINT)
        self._starter.wait()


SessionAttendant = Callable[
    [str, Sequence[str], Callable[[str], None]], AbstractContextManager[Callable[[], bool]]
]
"""Function that watches a session, for example to serve a web page, and may end the session.

It receives the name of the session, its endpoints, and a function that prints a line for the
user. It returns a context manager that lasts as long as the session. The value of the `with`
statement is a function that returns True once the session should end.
"""


def run_demo(
    scenario: Scenario,
    folder: Path,
    console: Console,
    attend: SessionAttendant | None = None,
    begins: Callable[[], bool] | None = None,
) -> SessionResult:
    """Runs a session on this machine, with one process per site and one for the recorder.

    The session has the same name as the scenario.

    Args:
        scenario: The scenario to run.
        folder: Folder for the log and for the output of the processes.
        console: Terminal of the user.
        attend: Function that attends to the session, for example by serving a web page, and may
            end it. `None` if there is none.
        begins: Function that returns True once the session may begin. Until then, for at most
            `WAIT_S`, the sites wait for the recorder. The session begins a second or two later.
            If `None`, the session begins at once.

    Returns:
        The outcome of the session. If the session has begun, the log is valid.

    Raises:
        ScenarioError: The scenario does not specify the limits of an external arm.
        UsageError: The scenario has an operator that runs as a separate program, and the
            package trilat-people is missing.
    """
    scenario.check_outside_arms()
    if any(spec.needs_hand_process for spec in scenario.sites.values()):
        # A missing package is reported now, and not by a process in the middle of the start.
        load_entry(COMMANDS, "hand", "trilat hand")
    result = SessionResult(folder / "run.mcap")
    session = scenario.name
    clock = SystemClock()
    with (
        SessionDisplay(console, clock) as display,
        Interrupt() as interrupt,
        ExitStack() as reserved,
    ):
        compile_core(scenario, display.say, interrupt)
        load_warning = check_machine_load(clock)
        if load_warning:
            display.say(f"warning: {load_warning}")
        default_endpoints = DefaultEndpoints(session)
        endpoints = reserved.enter_context(default_endpoints.reserve(len(scenario.names)))
        patience_s = JOIN_S if begins is None else WAIT_S
        starter, sites, start_recorder = _start(
            scenario=scenario,
            folder=folder,
            reserved=reserved,
            endpoints=endpoints,
            wait_s=patience_s,
        )
        recorder: list[SessionProcess] = []  # empty until the session may begin
        display.say(f"others connect to {', '.join(endpoints)}")
        for name in scenario.outside:
            key = topics.key(session, name, topics.MEASURED)
            endpoint = endpoints[scenario.names.index(name)]
            page = find_page("external-arm.md")
            display.say(f"{name} waits for its arm on {key} at {endpoint}; see {page}")

        attending: AbstractContextManager[Callable[[], bool]] = nullcontext(lambda: False)
        if attend is not None:
            attending = attend(session, endpoints, display.say)
        try:
            with closing(Connection(connect=endpoints).open()) as bus, attending as should_end:
                members = SessionMembers(bus, clock, session)
                monitor = SessionMonitor(members, scenario, display)
                while not interrupt.is_requested() and not should_end():
                    if _is_over([*sites, *recorder], result):
                        break
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
    """Compiles the control loop for a scenario, unless the compiled code is cached on disk.

    The code depends on the number of joints of the arms. Compilation may take minutes, and can
    be interrupted by a signal such as Ctrl-C.

    Args:
        scenario: The scenario.
        say: Function that prints a line for the user, called before a compilation starts.
        interrupt: Handler of the signals.
    """
    # The code depends only on the numbers of joints and links, so one site of each kind of arm
    # suffices.
    sites_by_counts = {arm.counts: name for name, arm in scenario.arms.items()}
    has_chains = any(arm.chain is not None for arm in scenario.arms.values())
    # The cached code may have been compiled for chains with another number of joints.
    if has_chains or not is_core_cached():
        compiling_notice.report = say
        # Loading the scenario may have compiled, and announced, a small part of the code. The
        # main part takes far longer, so it is announced too.
        compiling_notice.is_reported = False
        with interrupt.raising():
            for name in sites_by_counts.values():
                warm_up(scenario, name)


def _start(
    scenario: Scenario,
    folder: Path,
    reserved: ExitStack,
    endpoints: list[str],
    wait_s: int,
) -> tuple[ProcessStarter, list[SessionProcess], Callable[[], SessionProcess]]:
    """Starts one process for every arm of the scenario, and for users' operator programs.

    The processes find each other over the network, as they would on several machines.

    Args:
        scenario: The scenario.
        folder: Folder for the scenario, the log and the output of the processes.
        reserved: Closes the starter at the end of the session.
        endpoints: Endpoint at which each site listens, in the order of the scenario.
        wait_s: Longest wait of a process for the others, in s.

    Returns:
        The starter, the processes, and a function that starts the recorder.
    """
    scenario_file = folder / "scenario.toml"
    log = folder / "run.mcap"
    output = folder / "processes"
    write_whole(scenario_file, scenario.text)
    make_folder(output, may_be_link=False)
    log.unlink(missing_ok=True)  # of an earlier run, in a folder that may be replaced
    starter = reserved.enter_context(closing(ProcessStarter(scenario_file, output)))

    session = scenario.name
    session_arguments = ["--scenario", str(scenario_file), "--session", session]
    connect_arguments = [["--connect", endpoint] for endpoint in endpoints]
    timeout_arguments = ["--join-timeout", str(max(wait_s, START_S * len(endpoints)))]

    processes = []
    # Each site connects to the sites before it, so that every two sites are connected once.
    for index, name in enumerate(scenario.names):
        arguments = ["site", name, *session_arguments, "--listen", endpoints[index]]
        arguments += [
            *chain(*connect_arguments[:index]),
            "--needs-recorder",
            *timeout_arguments,
        ]
        processes.append(starter.start(name, arguments))
    for index, name in enumerate(scenario.names):
        if scenario.sites[name].needs_hand_process:
            arguments = [
                "hand",
                name,
                *session_arguments,
                *connect_arguments[index],
                *timeout_arguments,
            ]
            processes.append(starter.start(f"hand-{name}", arguments))

    record_arguments = [
        "record",
        "--session",
        session,
        *chain(*connect_arguments),
        "-o",
        str(log),
    ]
    record_arguments += [*timeout_arguments, "--force"]
    start_recorder = partial(starter.start, topics.RECORDER, record_arguments)
    return starter, processes, start_recorder


def _is_over(children: list[SessionProcess], result: SessionResult) -> bool:
    """Returns True if the session is over: a process has failed, or all processes have ended.

    After the failure of one process, the session ends, so that the other processes do not keep
    running.

    Args:
        children: The processes.
        result: Outcome of the session. The problems of failed processes are added to it.
    """
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
    """Ends the processes of a session: first those of the arms, and then the recorder.

    In this order, the recorder stores the last messages of the arms. If the user presses Ctrl-C
    a second time, all processes receive another signal, which ends them at once.

    Args:
        starter: Starter of the processes.
        sites: Processes of the sites and of operator programs.
        recorder: Process of the recorder. Empty if it has not been started.
        clock: Clock of this process.
        interrupt: Handler of the signals of this process.
        say: Function that prints a line for the user.
    """
    explain_wait = partial(
        say,
        "the sites keep their last records until the recorder has them; "
        "Ctrl-C a second time ends it at once",
    )
    _end_group(
        starter=starter,
        group=sites,
        clock=clock,
        ends_now=interrupt.is_repeated,
        announce=explain_wait,
    )
    sites_ended_ns = clock.monotonic_ns()

    def must_end_now() -> bool:
        """Returns True if the recorder must be ended at once, with a second signal.

        This is the case if the user has pressed Ctrl-C a second time, or if the recorder is
        still running `RECORDER_NS` after the sites ended.
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
    """Sends the processes of a session a signal to end, and waits until all have ended.

    A process that does not end within `END_TIMEOUT_NS` is killed, so that no process is left
    running.

    Args:
        starter: Starter of the processes.
        group: The processes.
        clock: Clock of this process.
        ends_now: Function that returns True to end the processes at once, by a second signal.
        announce: Function that tells the user why the wait takes long. It is called once, after
            a second.
    """
    for process in group:
        process.end(signal.SIGINT)

    started_ns = clock.monotonic_ns()
    is_announced = False
    is_repeated = False
    while any(process.code is None for process in group):
        waited_ns = clock.monotonic_ns() - started_ns
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
    """Runs the starter process, from which the processes of a session are forked.

    Forked processes start quickly, because all modules are imported and all code is compiled.
    As with `os.fork`, the function returns in every process: in each fork, which then runs its
    command, and finally in the starter, after the requesting process has disappeared.

    Args:
        number: File descriptor of the pipe to the requesting process.
        scenario_file: Path of the session's scenario file.

    Returns:
        In a fork, the command and arguments that the fork must run. In the starter, `None`.
    """
    # Until all modules are imported, the signal simply ends this process.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    scenario = load_scenario(scenario_file)

    # A user's own code is imported only in the process that runs it.
    if not scenario.imported_code:
        # One site of each kind of arm suffices.
        sites_by_counts = {arm.counts: name for name, arm in scenario.arms.items()}
        for name in sites_by_counts.values():
            warm_up(scenario, name)
    # Collections in the forked copies then skip the objects that exist now, and the memory of
    # these objects stays shared.
    gc.collect()
    gc.freeze()
    # The signal is blocked and not ignored. If it arrives while a copy has no handler yet, it
    # is delivered as soon as the copy has one.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return _StarterProcess(PipeEnd(number)).serve()


class _StarterProcess:
    """Starts the processes of a session on request, as copies (forks) of itself.

    A fork is faster than a new Python process, because all modules are imported already.

    Args:
        pipe: Connection to the requesting process.
    """

    def __init__(self, pipe: PipeEnd) -> None:
        self._pipe = pipe
        self._running: dict[str, int] = {}

    def serve(self) -> list[str] | None:
        """Handles requests to start processes or to signal them, and reports when they end.

        Each new process is forked from this starter process with `os.fork`. Therefore the
        method returns in every fork and, at the end, in the starter.

        A request is a tuple of four values: the name of the process; the command and its
        arguments; the number of the signal to send, or 0 to start the process; and the file for
        the output of the process.

        Returns:
            In a fork, the command and its arguments, which the fork must now execute. In the
            starter, `None`, after the requesting process has disappeared and all forks have
            ended.
        """
        arguments: list[str]
        longest_wait_s = POLL_NS / 10 / NS_PER_S  # then the ends of processes are reported
        while True:
            self._report_ends()
            try:
                has_request = self._pipe.poll(longest_wait_s)
                if not has_request:
                    continue
                name, arguments, signal_number, output = self._pipe.recv()
            except (EOFError, OSError):
                # The requesting process has disappeared.
                self._end_all()
                return None

            is_start_request = signal_number == 0
            if is_start_request:
                is_copy = self._fork(name)
                if is_copy:
                    _become_process(arguments, output)
                    return arguments
            elif name in self._running:
                os.kill(self._running[name], signal_number)

    def _fork(self, name: str) -> bool:
        """Creates a copy of this process, which becomes a process of the session.

        A copy starts faster than a new Python interpreter, because all modules are imported
        already.

        Args:
            name: Name of the copy.

        Returns:
            True in the copy, False in the starter.
        """
        pid = os.fork()
        is_starter = pid != 0
        if is_starter:
            self._running[name] = pid
            self._report(name, pid, None)
            return False
        self._pipe.close()
        return True

    def _report_ends(self) -> None:
        """Reports the exit codes of the processes that have ended."""
        for name, pid in list(self._running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                del self._running[name]
                self._report(name, pid, os.waitstatus_to_exitcode(status))

    def _report(self, name: str, pid: int, code: int | None) -> None:
        """Reports that a process has started, or has ended with an exit code."""
        with suppress(OSError):  # the requesting process is gone, which `serve` notices next
            self._pipe.send((name, pid, code))

    def _end_all(self) -> None:
        """Ends all processes and waits for them, the recorder last."""
        recorder = []
        if topics.RECORDER in self._running:
            recorder.append(self._running.pop(topics.RECORDER))
        others = list(self._running.values())
        for pids in (others, recorder):
            for pid in pids:
                os.kill(pid, signal.SIGINT)
            for pid in pids:
                os.waitpid(pid, 0)


def _become_process(arguments: list[str], output: Path) -> None:
    """Turns a forked copy of this process into a process like one that a shell has started.

    The copy receives its own process session, output file, signal handling and process title.

    Args:
        arguments: The command and its arguments.
        output: File for everything that the process prints.
    """
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
    """Runs a scenario live, with one process per site and a recorder, and returns the log.

    The command `trilat demo` does the same, and also writes a report, as `tn.report(log)` does.

    >>> log = tn.run("two_sites", duration_s=2)
    >>> tn.verify(log).passed
    True

    Args:
        scenario: Name of a shipped scenario, path of a TOML file, TOML string, mapping of its
            tables, or `Scenario`.
        set: Overrides of scenario settings, for example `{"control.Kd": 5}`.
        duration_s: Duration of the run, in s. If `None`, the scenario's duration is kept.
        seed: Random seed. If `None`, the scenario's seed is kept.
        out: Folder for the log. If `None`, the next free folder runs/NAME-N is used.
        force: True to allow a folder that already contains files.
        quiet: True to print nothing during the run.

    Raises:
        ScenarioError: The scenario or an override is invalid.
        RunFailed: A process failed, or the run was interrupted. The message says whether there
            is a log.
    """
    loaded_scenario = load_scenario(scenario, set, duration_s=duration_s, seed=seed)
    chosen_folder = None if out is None else Path(out)
    folder = make_results_folder(chosen_folder, loaded_scenario.name, force=force)
    result = run_demo(loaded_scenario, folder, Console(quiet=quiet))
    problems = ["interrupted"] if result.interrupted else result.problems
    if problems:
        log_note = f"; {result.log} holds the records so far" if result.log.exists() else ""
        raise RunFailed("; ".join(problems) + log_note)

    log = open_log(result.log)
    log.warn_of_failures()
    return log

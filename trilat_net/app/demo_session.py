"""Runs a complete session on one machine, with one process per site and a recorder.

A session is a run in which several robot arms are coupled over a network. A site is a process
that runs the control loop of one arm. The recorder is a process that writes the log of the
session. `run_demo` runs such a session for the command `trilat demo`, and `run` does so for
Python programs.

The processes are forks of one process, see `process_starter`.

Invariant:
    - The recorder always ends last, to receive the final messages of the sites.
    - No child process is left when a function returns.
"""

import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from multiprocessing.connection import Connection as PipeEnd
from pathlib import Path
from typing import Any

from rich.console import Console

from sites import warm_up
from trilat_net.entry_points import COMMANDS, load_entry
from trilat_net.errors import LogRefused, RunFailed
from trilat_net.files import find_page, make_folder, make_results_folder, write_whole
from trilat_net.net import topics
from trilat_net.process import freeze_gc
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.signals import Interrupt

from ..core import compiling_notice, is_core_cached
from ..log import Log, open_log
from ..net import Clock, Connection, DefaultEndpoints, SessionMembers, SystemClock
from ..records import NS_PER_S
from .machine_load import check_machine_load
from .monitor import SessionDisplay, SessionMonitor
from .process_starter import ForkServer, ProcessStarter, SessionProcess

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
        interrupted: Number of the signal that ended the session, or 0 if no signal ended it.
        exit_code: Exit code for the command. It indicates whether the run failed or the log
            could not be written to the disk.
    """

    log: Path
    problems: list[str] = field(default_factory=list)
    interrupted: int = 0
    exit_code: int = RunFailed.exit_code


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
        attend: Function that watches the session, for example to serve a web page, and may end
            the session. `None` if there is no such function.
        begins: Function that returns True once the session may begin. The recorder is started
            only then, and the session begins a second or two later. The sites wait for the
            recorder for at most `WAIT_S`. If `None`, the recorder is started at once.

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

    Forked processes start quickly, because the starter has already imported all modules and
    compiled all code.
    The function is in this module because the forks need most of the module's imports. As with
    `os.fork`, it returns in every process: in each fork, which then runs its command, and
    finally in the starter, after the requesting process has disappeared.

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
    freeze_gc()
    # The signal is blocked and not ignored. If it arrives while a copy has no handler yet, it
    # is delivered as soon as the copy has one.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return ForkServer(PipeEnd(number)).serve()


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

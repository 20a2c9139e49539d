"""Starts the processes of a session on this machine as forks of one process, the starter.

The starter has imported all modules and compiled the control code. Forking takes a tenth of the
time needed to start a Python interpreter. The starter has no network connection, no threads of
its own and no user code, because these cannot be forked safely.

Invariant:
    - No child process is left, even if the process that started the session is killed. If the
      starter is killed, all processes receive a signal to end.
    - Each child runs in its own process session. Ctrl-C in the terminal therefore reaches only
      the process that started the session, which then ends the children in the right order.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import BinaryIO

from setproctitle import setproctitle

from trilat_net.net import topics

from ..files import refuse_link

REPORT_S = 0.01
"""Longest time until the starter reports that a process has ended, in s."""


class SessionProcess:
    """State of one process of a session: a site, the recorder or an operator program.

    Created by `ProcessStarter`, which updates it from the reports of the starter process.

    Attributes:
        name: Name of the process, for example "m1" for a site, "hand-m1" for an operator
            program, or "recorder".
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
                0, or it was interrupted by a signal from `end`.
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

    The processes are forked from a helper process, the starter (`run_starter`). The starter
    receives requests through a pipe. Through the same pipe, it reports when a process has
    started or ended.

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

        If the starter is not ready to fork processes yet, the signal ends the starter, and the
        process is never started.

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


class ForkServer:
    """Starts the processes of a session on request, as forks of its own process, the starter.

    A fork starts faster than a new Python process, because all modules are imported already.

    Args:
        pipe: Connection to the requesting process.
    """

    def __init__(self, pipe: Connection) -> None:
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
        while True:
            self._report_ends()
            try:
                has_request = self._pipe.poll(REPORT_S)
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

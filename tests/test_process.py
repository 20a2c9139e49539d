"""A signal is a value that a loop polls; worker processes leave Ctrl-C to their parent."""

import contextlib
import multiprocessing
import os
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.live.processes import is_running
from tests.net.waiting import until
from tests.other_systems import replace_os
from trilat_net import errors, process, signals, workers
from trilat_net.errors import join_arguments
from trilat_net.signals import ENDING_SIGNALS, Interrupt, hold_sigint
from trilat_net.workers import worker_pool


def test_signals_are_remembered_and_end_nothing() -> None:
    with Interrupt() as interrupt:
        assert not interrupt.is_requested()
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.is_requested()
        assert interrupt.exit_code == 128 + signal.SIGTERM  # the first counts


def test_only_a_later_second_signal_insists(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 5.0
    monkeypatch.setattr(signals.os, "times", lambda: SimpleNamespace(elapsed=now_s))
    with Interrupt() as interrupt:
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGINT, signal.SIGINT):
            os.kill(os.getpid(), number)
            assert not interrupt.is_repeated()
        now_s += 1.0
        os.kill(os.getpid(), signal.SIGHUP)
        assert not interrupt.is_repeated()
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt.is_repeated()


def test_handlers_are_put_back() -> None:
    before = [signal.getsignal(name) for name in ENDING_SIGNALS]
    with Interrupt():
        pass
    assert [signal.getsignal(name) for name in ENDING_SIGNALS] == before


@pytest.mark.parametrize(
    "handler", [signal.SIG_DFL, signal.SIG_IGN], ids=["as usual", "under nohup"]
)
def test_a_terminals_end_is_a_signal_unless_ignored(handler: signal.Handlers) -> None:
    before = signal.signal(signal.SIGHUP, handler)
    try:
        with Interrupt() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert interrupt.is_requested() is (handler is signal.SIG_DFL)
        assert signal.getsignal(signal.SIGHUP) is handler
    finally:
        signal.signal(signal.SIGHUP, before)


def test_long_work_is_broken_off_at_once() -> None:
    reached = []

    def work(interrupt: Interrupt) -> None:
        with interrupt.raising():
            os.kill(os.getpid(), signal.SIGINT)
            reached.append("the rest")

    with Interrupt() as interrupt, pytest.raises(KeyboardInterrupt):
        work(interrupt)
    assert reached == []
    assert interrupt.is_requested()


def test_swallowed_signals_break_off_at_the_end() -> None:
    def work(interrupt: Interrupt) -> None:
        with interrupt.raising(), contextlib.suppress(KeyboardInterrupt):  # as in a `__del__`
            os.kill(os.getpid(), signal.SIGINT)

    with Interrupt() as interrupt, pytest.raises(KeyboardInterrupt):
        work(interrupt)


def test_blocks_without_signals_end_normally() -> None:
    with Interrupt() as interrupt:
        with interrupt.raising():
            pass
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.is_requested()


@pytest.fixture(autouse=True)
def sigint() -> Iterator[None]:
    """Installs Python's own handler, however these tests were started: a shell's background job
    ignores SIGINT.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def wait_for_ever() -> None:
    threading.Event().wait()


def test_workers_are_processes_ignoring_ctrl_c() -> None:
    with worker_pool(1) as pool:
        assert list(pool.map(int.bit_length, [1, 255])) == [1, 8]
        assert pool.submit(os.getpid).result() != os.getpid()
        assert pool.submit(signal.getsignal, signal.SIGINT).result() is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def interrupt_pool(pids: list[int]) -> None:
    with worker_pool(1) as pool:
        pids.append(pool.submit(os.getpid).result())
        pool.submit(wait_for_ever)
        raise KeyboardInterrupt


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_interrupts_end_endless_workers() -> None:
    pids: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        interrupt_pool(pids)
    assert not is_running(pids[0])


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_workers_end_when_their_parent_is_killed() -> None:
    script = (
        "import os, signal, threading\n"
        "from trilat_net.workers import worker_pool\n"
        "with worker_pool(1) as pool:\n"
        "    print(pool.submit(os.getpid).result(), flush=True)\n"
        "    pool.submit(threading.Event().wait)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, timeout=60
    )
    until(lambda: not is_running(int(done.stdout)), 30)


@pytest.mark.skipif(sys.platform != "linux", reason="holds signals back")
@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_ctrl_c_while_workers_start_arrives_afterwards(elsewhere: bool) -> None:
    """The signal arrives also if another thread of this process receives it."""

    def interrupt_itself() -> None:
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)

    with Interrupt() as interrupt:
        with hold_sigint():
            if elsewhere:
                thread = threading.Thread(target=run_unmasked, args=(interrupt_itself,))
                thread.start()
                thread.join()
            else:
                interrupt_itself()
            assert not interrupt.is_requested()
        assert interrupt.is_requested()


def run_unmasked(act: Callable[[], None]) -> None:
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    act()


WINDOWS_WORDS = [
    "trilat",
    "sweep",
    r"my runs\\one",
    "m1->s",
    'say "no"',
    r"C:\\runs",
    "--set",
    "a=-1.5",
]


def test_commands_are_quoted_for_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shlex.split(join_arguments(WINDOWS_WORDS)) == WINDOWS_WORDS
    monkeypatch.setattr(errors, "os", replace_os())
    plain = r'trilat sweep "my runs\\one" "m1->s" "say \"no\"" C:\\runs --set a=-1.5'
    assert join_arguments(WINDOWS_WORDS) == plain


class ProcessEndedError(Exception):
    """Stands for the end of a process."""


def test_workers_end_with_parents_as_on_windows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On Windows the number of a dead parent stays the same; a handle to the parent, here a
    pipe, shows its end.
    """
    ended, alive = multiprocessing.Pipe()
    codes: list[int] = []

    def end(code: int) -> None:
        codes.append(code)
        raise ProcessEndedError

    monkeypatch.setattr(workers, "os", replace_os(_exit=end, getppid=lambda: 4))
    monkeypatch.setattr(
        multiprocessing, "parent_process", lambda: SimpleNamespace(sentinel=ended.fileno())
    )
    alive.close()
    with pytest.raises(ProcessEndedError):
        workers._exit_after(4)
    assert codes == [1]


def test_closed_windows_are_signals_as_on_windows() -> None:
    program = (
        "import signal\n"
        "signal.SIGBREAK = signal.SIGHUP\n"
        "del signal.SIGHUP, signal.pthread_sigmask\n"
        "from trilat_net.signals import ENDING_SIGNALS\n"
        "assert ENDING_SIGNALS == (signal.SIGINT, signal.SIGTERM, signal.SIGBREAK)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="threads have nice values on Linux alone"
)
def test_priority_rises_except_in_the_main_thread() -> None:
    """Without permission nothing changes and nothing is reported."""
    before = os.getpriority(os.PRIO_PROCESS, os.getpid())
    priorities: list[tuple[bool, int]] = []

    def work() -> None:
        raised = process.raise_priority(before - 1)
        priorities.append((raised, os.getpriority(os.PRIO_PROCESS, threading.get_native_id())))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert priorities in ([(True, before - 1)], [(False, before)])
    assert os.getpriority(os.PRIO_PROCESS, os.getpid()) == before


@pytest.mark.skipif(
    not Path("/proc/self/autogroup").exists(), reason="this system has no groups of sessions"
)
@pytest.mark.parametrize("leads", [True, False])
def test_session_priority_counts_for_the_leader_alone(leads: bool) -> None:
    program = (
        "from pathlib import Path\n"
        "from trilat_net.process import raise_priority\n"
        "group = Path('/proc/self/autogroup')\n"
        "before = group.read_text().split()[-1]\n"
        "print(before, raise_priority(-3), group.read_text().split()[-1])"
    )
    shell = ["sh", "-c", '"$@"; exit $?', "-"]
    done = subprocess.run(
        [*([] if leads else shell), sys.executable, "-c", program],
        start_new_session=True,
        capture_output=True,
        text=True,
        check=True,
    )
    before, raised, after = done.stdout.split()
    assert after == ("-3" if leads and raised == "True" else before)

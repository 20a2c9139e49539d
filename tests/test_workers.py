"""Worker processes: they leave Ctrl-C to their parent and never outlive it."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.net.waiting import until
from trilat_net.process import ignore_sigint, worker_pool


@pytest.fixture(autouse=True)
def sigint() -> Iterator[None]:
    """Python's own handler, however these tests were started: a shell's background job ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def wait_for_ever() -> None:
    threading.Event().wait()


def is_running(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


def test_work_is_done_in_other_processes_that_ignore_ctrl_c() -> None:
    with worker_pool(1) as pool:
        assert list(pool.map(int.bit_length, [1, 255])) == [1, 8]
        assert pool.submit(os.getpid).result() != os.getpid()
        assert pool.submit(signal.getsignal, signal.SIGINT).result() is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def interrupted(pids: list[int]) -> None:
    with worker_pool(1) as pool:
        pids.append(pool.submit(os.getpid).result())
        pool.submit(wait_for_ever)
        raise KeyboardInterrupt


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_an_interrupt_ends_workers_in_the_middle_of_something_that_never_ends() -> None:
    pids: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted(pids)
    assert not is_running(pids[0])


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_workers_end_when_their_parent_is_killed() -> None:
    script = (
        "import os, signal, threading\n"
        "from trilat_net.process import worker_pool\n"
        "with worker_pool(1) as pool:\n"
        "    print(pool.submit(os.getpid).result(), flush=True)\n"
        "    pool.submit(threading.Event().wait)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, timeout=60)
    until(lambda: not is_running(int(done.stdout)), 30)


def test_a_thread_leaves_the_signal_as_it_is() -> None:
    heard: list[object] = []

    def look() -> None:
        with ignore_sigint():
            heard.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert heard == [signal.default_int_handler]

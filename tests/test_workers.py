"""Processes beside this one: they do what they are given, and outlive nobody."""

import multiprocessing
import os
import signal
import threading

import pytest

from trilat_net.process import count_cores, ignore_sigint, worker_pool


def wait_for_ever() -> None:
    threading.Event().wait()


def interrupted() -> None:
    with worker_pool(1) as pool:
        with ignore_sigint():
            assert pool.submit(os.getpid).result() != os.getpid()
            pool.submit(wait_for_ever)
        raise KeyboardInterrupt


def test_they_do_what_they_are_given_elsewhere() -> None:
    with worker_pool(1) as pool, ignore_sigint():
        assert list(pool.map(int.bit_length, [1, 255])) == [1, 8]
        assert pool.submit(os.getpid).result() != os.getpid()
    assert count_cores() >= 1


def test_they_are_gone_when_their_work_is_not_wanted_any_more() -> None:
    """Also in the middle of something that never ends."""
    before = multiprocessing.active_children()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert multiprocessing.active_children() == before


def test_ctrl_c_is_left_to_this_process() -> None:
    with worker_pool(1) as pool, ignore_sigint():
        assert pool.submit(signal.getsignal, signal.SIGINT).result() is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_thread_is_never_deaf() -> None:
    heard: list[object] = []

    def look() -> None:
        with ignore_sigint():
            heard.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert heard == [signal.default_int_handler]

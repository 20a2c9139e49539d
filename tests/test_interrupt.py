"""A signal is a value that a loop looks at; only where it is wished does it break off what runs."""

import contextlib
import os
import signal

import pytest

from trilat_net.process import Interrupt


def test_a_signal_is_remembered_and_ends_nothing() -> None:
    with Interrupt() as interrupt:
        assert not interrupt.requested()
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.requested()
        assert interrupt.exit_code == 128 + signal.SIGTERM  # the first counts


def test_handlers_are_put_back() -> None:
    before = [signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)]
    with Interrupt():
        pass
    assert [signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)] == before


def test_long_work_is_broken_off_at_once() -> None:
    reached = []

    def work(interrupt: Interrupt) -> None:
        with interrupt.raising():
            os.kill(os.getpid(), signal.SIGINT)
            reached.append("the rest")

    with Interrupt() as interrupt, pytest.raises(KeyboardInterrupt):
        work(interrupt)
    assert reached == []
    assert interrupt.requested()


def test_a_signal_that_python_swallowed_breaks_off_at_the_end() -> None:
    def work(interrupt: Interrupt) -> None:
        with interrupt.raising(), contextlib.suppress(KeyboardInterrupt):  # as in a `__del__`
            os.kill(os.getpid(), signal.SIGINT)

    with Interrupt() as interrupt, pytest.raises(KeyboardInterrupt):
        work(interrupt)


def test_a_block_without_a_signal_ends_as_any_other() -> None:
    with Interrupt() as interrupt:
        with interrupt.raising():
            pass
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.requested()

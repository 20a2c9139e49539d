"""Process control: garbage collection, SIGINT and SIGTERM, worker processes.

Invariants: garbage collection pauses only around code whose many objects form no cycles (records, lists of
numbers). A signal ends nothing by itself: a loop polls it and ends in order. Worker processes leave Ctrl-C
to the process that started them, and end with it or when it fails.
"""

import gc
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from types import FrameType, TracebackType
from typing import Any


@contextmanager
def pause_gc() -> Iterator[None]:
    """Keeps the collector from running inside the block."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def freeze_gc() -> None:
    """Puts all that exists out of the collector's sight: from now on a round looks at what is new alone.

    A full round over all that a program has imported takes a quarter of a second.
    """
    gc.collect()
    gc.freeze()


def disable_gc() -> None:
    """Puts all that exists out of the collector's sight and stops it: for a loop that must not pause."""
    freeze_gc()
    gc.disable()


class Interrupt:
    """Remembers the first SIGINT or SIGTERM; a context, which puts things back as they were.

    Attributes:
        number: that signal, or 0.
    """

    def __init__(self) -> None:
        self.number = 0
        self._before: dict[int, Any] = {}
        self._raises = False

    def __enter__(self) -> "Interrupt":
        for name in (signal.SIGINT, signal.SIGTERM):
            self._before[name] = signal.signal(name, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name, handler in self._before.items():
            signal.signal(name, handler)

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.number = self.number or number
        if self._raises:
            raise KeyboardInterrupt

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Lets a signal break off the block at once: for long work that looks at nothing.

        Python passes over what is raised inside a `__del__`; then the block is left at its end.
        """
        self._raises = True
        try:
            yield
        finally:
            self._raises = False
        if self.requested():
            raise KeyboardInterrupt

    def requested(self) -> bool:
        """True once a signal has come."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """What a process ends with that was ended by the signal, by the shell's custom."""
        return 128 + self.number


def count_cores() -> int:
    """Returns how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def worker_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Yields some processes; hand them work within `deaf`.

    Args:
        count: how many.
    """
    others = multiprocessing.active_children()
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _prepare_worker)
    try:
        yield pool
    except BaseException:  # a second Ctrl-C finds them gone
        for child in multiprocessing.active_children():
            if child not in others:
                child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def ignore_sigint() -> Iterator[None]:
    """Ignores Ctrl-C for a moment, where this thread may: processes that begin now inherit it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _prepare_worker() -> None:
    """Leaves Ctrl-C to whoever started this process, and ends it when that one is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()


def _exit_after(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)

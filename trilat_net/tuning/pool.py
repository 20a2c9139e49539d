"""Runs candidates on all cores.

Law: scores come in the order of the candidates, whatever the number of processes.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from types import TracebackType

from ..errors import RunFailed
from .measurement import Score, measure

Task = tuple[str, str | None]
"""The canonical text of a candidate's scenario, and of its twin's or None."""


def cores() -> int:
    """Returns how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Crew:
    """Processes that run candidates; a context, at whose end they are gone.

    Args:
        jobs: how many; one runs in this process.
    """

    def __init__(self, jobs: int) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._others = multiprocessing.active_children()
        if jobs > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(jobs, context, _prepare)

    def __enter__(self) -> "Crew":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is None:
            return
        if error is not None:  # nobody waits for what they are at; a second Ctrl-C finds them gone
            for child in multiprocessing.active_children():
                if child not in self._others:
                    child.kill()
        self._pool.shutdown(cancel_futures=True)

    def scores(self, tasks: Sequence[Task], done: Callable[[], None]) -> list[Score]:
        """Returns the score of every candidate.

        Args:
            tasks: the candidates.
            done: is told of every score as it comes.

        Raises:
            RunFailed: a process was ended.
        """
        if not tasks:
            return []
        found: list[Score] = []
        try:
            with _deaf():  # processes that begin inherit it
                scores = (map if self._pool is None else self._pool.map)(measure, *zip(*tasks, strict=True))
            for score in scores:
                found.append(score)
                done()
        except BrokenProcessPool:
            raise RunFailed(
                "a process of the search was ended, or could not begin; try again, or with --jobs 1"
            ) from None
        return found


@contextmanager
def _deaf() -> Iterator[None]:
    """Ignores Ctrl-C for a moment, where this thread may."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _prepare() -> None:
    """Leaves Ctrl-C to whoever started this process, and ends it when that one is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)

"""A worker pool.

Maps a function over many tasks, in this process or in several, and yields results as they end.

Invariant: the number of tasks in flight is bounded, however many there are; the loss of a worker process
raises `RunFailed` with one sentence.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

from ..errors import RunFailed
from ..process import ignore_sigint, worker_pool

T = TypeVar("T")
R = TypeVar("R")

_WAITING = 2
"""So many tasks are under way or wait, per process, besides the one that it is at: none is idle."""


class WorkerPool:
    """Some processes, or this one.

    Args:
        pool: in which processes; None: in this one.
        most: so many tasks are under way or wait.
        kept: what is told of what is done, where a process was ended.
    """

    def __init__(self, pool: ProcessPoolExecutor | None, most: int, kept: str = "") -> None:
        self._pool, self._most, self._kept = pool, most, kept

    def each(self, function: Callable[[T], R], tasks: Iterable[T]) -> Iterator[tuple[int, R]]:
        """Yields the place of a task and what a function makes of it, as they end.

        Raises:
            RunFailed: a process was ended.
        """
        if self._pool is None:
            yield from enumerate(map(function, tasks))
            return
        left = enumerate(tasks)
        under_way: dict[Future[R], int] = {}
        try:
            with ignore_sigint():  # here the processes begin
                under_way |= {self._pool.submit(function, task): n for n, task in islice(left, 1)}
            while True:
                more = islice(left, self._most - len(under_way))
                under_way |= {self._pool.submit(function, task): n for n, task in more}
                if not under_way:
                    return
                for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                    yield under_way.pop(future), future.result()
        except BrokenProcessPool:
            raise RunFailed(
                f"a process of the sweep was ended, or could not begin; {self._kept}perhaps with --jobs 1"
            ) from None


@contextmanager
def open_worker_pool(jobs: int, kept: str = "try again, ") -> Iterator[WorkerPool]:
    """Yields who works.

    Args:
        jobs: in how many processes; one is this one.
        kept: see `Crew`.
    """
    if jobs <= 1:
        yield WorkerPool(None, 1)
        return
    with worker_pool(jobs) as pool:
        yield WorkerPool(pool, jobs * (1 + _WAITING), kept)

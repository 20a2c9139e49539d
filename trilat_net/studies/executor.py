"""The worker pool of all studies: runs a function on many items, here, in worker processes or
on a cluster.

Any `concurrent.futures.Executor` does the work: loky's processes on this machine, a Dask
cluster with `on="tcp://SCHEDULER:8786"`.

Invariant: what runs an item enters no result. The number of items in flight is bounded. An item
whose worker died runs again, at most `MAX_LOSSES` times in all; the last times alone, so that
the item that is named is the one that ends its workers.
"""

import textwrap
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import islice
from typing import Any, Generic, NamedTuple, TypeVar

from ..errors import RunFailed, UsageError
from ..files import require_libraries
from ..net.clock import SystemClock
from ..process import count_cores, worker_pool
from ..scenario.imported_code import CodeConsents, allowed_code, allowing_any_settings
from .dask_cluster import DaskCluster, WorkerRequirements, check_this_worker

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[int, int], None]
"""Called with the numbers of items done and in all."""
Workers = str | Executor | None
"""What runs items: a Dask scheduler's address, an executor, or None for processes of this
machine.
"""

BATCH_S = 0.4
"""The duration of a batch of items, about: at 20 ms an item its overhead is below 1 %."""
CLUSTER_BATCH_S = 2.0
"""The same on a cluster, where a batch costs its scheduler, its worker and this process some 20
ms in all.
"""
MAX_BATCH = 400
_SMALLEST = 16
"""The last batches are no smaller than this part of a whole one."""
MAX_LOSSES = 3
_BATCHES_PER_WORKER = 2
"""One at work and one that waits, so that no worker is idle."""
_POLL_S = 1.0
_MAX_NAME = 200


def ignore_progress(_done: int, _total: int) -> None:
    """Shows no progress."""


class _BatchResult(NamedTuple):
    """Results of the first items of a batch, how long they took, and the error of the next one."""

    results: list[Any]
    wall_s: float
    error: Exception | None


def run_batch(
    function: Callable[[T], Any],
    items: Sequence[T],
    required: WorkerRequirements | None,
    allowed: CodeConsents,
) -> _BatchResult:
    """Runs a function on the items of a batch, in whatever worker, in which the `allowed` laws
    may run.

    Raises:
        UsageError: this worker does not meet the requirements.
    """
    if required is not None:
        check_this_worker(required)
    clock = SystemClock()
    began_ns = clock.monotonic_ns()
    results: list[Any] = []
    error = None
    with allowing_any_settings(allowed):
        for item in items:
            try:
                results.append(function(item))
            except Exception as raised:  # raised again where the results are collected
                error = raised
                break
    return _BatchResult(results, (clock.monotonic_ns() - began_ns) * 1e-9, error)


class _Batch(NamedTuple):
    numbers: list[int]
    items: list[Any]
    executor: Executor


class _Feed(Generic[T]):
    """The items that wait, and how many of them make the next batch."""

    def __init__(
        self, items: Iterable[T], count: int | None, workers: int, batch_s: float = BATCH_S
    ) -> None:
        self._new = enumerate(items)
        self._left = count
        self._workers = workers
        self._batch_s = batch_s
        self._again: deque[tuple[int, T]] = deque()
        self._suspects: deque[tuple[int, T]] = deque()
        self._losses: Counter[int] = Counter()
        self._runs = 0
        self._wall_s = 0.0

    def measure(self, runs: int, wall_s: float) -> None:
        self._runs = self._runs + runs
        self._wall_s = self._wall_s + wall_s

    def take(self, *, idle: bool) -> list[tuple[int, T]]:
        """Returns the next batch, [] if there is none now; items under suspicion wait until all
        is idle.
        """
        if self._suspects:
            return [self._suspects.popleft()] if idle else []
        if self._again:
            return [self._again.popleft()]
        size = (
            min(MAX_BATCH, int(self._batch_s * self._runs / self._wall_s))
            if self._wall_s > 0.0
            else 1
        )
        if self._left is not None:  # small batches at the end leave no worker idle
            share = self._left // (2 * self._workers * _BATCHES_PER_WORKER)
            size = min(size, max(share, size // _SMALLEST))
        batch = list(islice(self._new, max(1, size)))
        if self._left is not None:
            self._left -= len(batch)
        return batch

    def lose(self, batch: _Batch, losses: int = 1) -> list[tuple[int, T]]:
        """Takes back the items of a lost batch; returns those that were lost too often."""
        lost = []
        for number, item in zip(batch.numbers, batch.items, strict=True):
            self._losses[number] += losses
            if self._losses[number] >= MAX_LOSSES:
                lost.append((number, item))
            elif self._losses[number] == MAX_LOSSES - 1:
                self._suspects.append((number, item))
            else:
                self._again.append((number, item))
        return lost


class WorkerPool:
    """Workers of a kind, for the length of a study.

    Args:
        executor: runs the batches; None: this process does.
        workers: how many work at the same time.
        restart: returns a new executor after the loss of a worker broke the old one; None:
            there is none.
        cluster: the cluster that the executor belongs to, and `required` what each of its
            workers must have.
        hint: what a message about a lost worker recommends.
    """

    def __init__(
        self,
        executor: Executor | None,
        workers: int,
        restart: Callable[[], Executor] | None = None,
        cluster: DaskCluster | None = None,
        required: WorkerRequirements | None = None,
        hint: str = "",
    ) -> None:
        self.workers = workers
        self._executor = executor
        self._restart = restart
        self._cluster = cluster
        self._required = required
        self._hint = hint
        self.is_local = executor is None

    def each(
        self,
        function: Callable[[T], R],
        items: Iterable[T],
        lost: Callable[[T], R] | None = None,
        count: int | None = None,
    ) -> Iterator[tuple[int, R]]:
        """Yields the number of every item and the function's result, in the order in which they
        end.

        Args:
            function: of a module, so that another process can import it.
            items: their `str` names them in messages.
            lost: gives the result of an item that ended its workers; None: that is an error.
            count: how many items there are, if known.

        Raises:
            RunFailed: an item ended its workers; or there are no workers any more.
            UsageError: a worker has not what it must have.
        """
        if self._executor is None:
            for number, item in enumerate(items):
                with allowing_any_settings(allowed_code):
                    result = function(item)
                yield number, result
            return
        feed = _Feed(
            items, count, self.workers, BATCH_S if self._cluster is None else CLUSTER_BATCH_S
        )
        pending: dict[Future[_BatchResult], _Batch] = {}
        try:
            while True:
                self._submit(function, feed, pending)
                if not pending:
                    return
                ended = wait(pending, _POLL_S, FIRST_COMPLETED).done
                if not ended and self._cluster is not None:
                    self._cluster.check_alive()
                for future in sorted(ended, key=lambda one: pending[one].numbers):
                    yield from self._collect(future, pending.pop(future), feed, lost)
        finally:
            # Processes of our own end with the pool; loky stumbles over futures that are cancelled already.
            for future in pending if self._restart is None else ():
                future.cancel()

    def map(
        self,
        function: Callable[[T], R],
        items: Sequence[T],
        progress: Progress = ignore_progress,
    ) -> list[R]:
        """Returns the function's results in the order of the items."""
        results: dict[int, R] = {}
        for number, result in self.each(function, items, count=len(items)):
            results[number] = result
            progress(len(results), len(items))
        return [results[number] for number in range(len(items))]

    def _submit(
        self,
        function: Callable[[T], R],
        feed: _Feed[T],
        pending: dict[Future[_BatchResult], _Batch],
    ) -> None:
        assert self._executor is not None
        while len(pending) < self.workers * _BATCHES_PER_WORKER:
            batch = feed.take(idle=not pending)
            if not batch:
                return
            numbers, items = map(list, zip(*batch, strict=True))
            work: Any = (function, items, self._required, dict(allowed_code))
            try:
                future = self._executor.submit(run_batch, *work)
            except BrokenExecutor:
                self._replace(self._executor)
                future = self._executor.submit(run_batch, *work)
            pending[future] = _Batch(numbers, items, self._executor)

    def _collect(
        self,
        future: Future[_BatchResult],
        batch: _Batch,
        feed: _Feed[T],
        lost: Callable[[T], R] | None,
    ) -> Iterator[tuple[int, R]]:
        try:
            result = future.result()
        except BrokenExecutor:
            self._replace(batch.executor)
            gone = feed.lose(batch)
        except (Exception, CancelledError) as error:
            if self._cluster is None or not self._cluster.is_worker_loss(error):
                raise
            gone = feed.lose(batch, 1 if len(batch.items) > 1 else MAX_LOSSES)
        else:
            feed.measure(len(result.results), result.wall_s)
            yield from zip(batch.numbers, result.results, strict=False)
            if result.error is not None:
                raise result.error
            return
        for number, item in gone:
            if lost is None:
                name = textwrap.shorten(str(item), _MAX_NAME, placeholder="...")
                raise RunFailed(f"{name} ended {MAX_LOSSES} worker processes{self._hint}")
            yield number, lost(item)

    def _replace(self, broken: Executor) -> None:
        if self._restart is None:
            raise RunFailed(f"a worker process was ended{self._hint}") from None
        if broken is self._executor:
            self._executor = self._restart()


@contextmanager
def open_worker_pool(
    jobs: int | None,
    on: Workers = None,
    *,
    most: int | None = None,
    laws: Sequence[Any] = (),
    hint: str = "",
) -> Iterator[WorkerPool]:
    """Yields the workers of a study; those that it starts are gone afterwards.

    Args:
        jobs: how many processes of this machine; None for one per core; 1: this process.
        on: what runs the items, if not processes of this machine.
        most: how many items there are: more processes are not started.
        laws: control laws of users' own that the items need: every worker must have their
            files.
        hint: what a message about a lost worker recommends.

    Raises:
        UsageError: the cluster cannot be reached, one of its workers is not fit, or a library
            is missing.
    """
    require_libraries()
    with ExitStack() as stack:
        if isinstance(on, str):
            cluster = stack.enter_context(DaskCluster(on))
            required = cluster.require(laws)
            yield WorkerPool(
                executor=cluster.executor,
                workers=cluster.workers,
                restart=None,
                cluster=cluster,
                required=required,
                hint=hint,
            )
        elif on is not None:
            yield WorkerPool(on, getattr(on, "_max_workers", count_cores()), hint=hint)
        else:
            count = jobs or count_cores()
            count = count if most is None else min(count, most)

            def start() -> Executor:
                opened: AbstractContextManager[Executor] = worker_pool(count)
                return stack.enter_context(opened)

            yield (
                WorkerPool(start(), count, start, hint=hint)
                if count > 1
                else WorkerPool(None, 1)
            )


def check_workers(jobs: int | None, on: Workers) -> None:
    """Refuses --jobs together with --on.

    Raises:
        UsageError: both are given.
    """
    if on is not None and jobs is not None:
        raise UsageError("--jobs is how many processes of this machine: leave it out with --on")


def count_workers(jobs: int | None, on: Workers = None) -> int:
    """Returns how many items will run at the same time; on a cluster, checks its workers.

    Raises:
        UsageError: the cluster cannot be reached, or one of its workers is not fit.
    """
    check_workers(jobs, on)
    if on is None:
        return jobs or count_cores()
    with open_worker_pool(None, on) as pool:
        return pool.workers

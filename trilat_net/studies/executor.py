"""The worker pool of all studies, which runs a function on many items.

Items run in this process, in worker processes (loky) or on a Dask cluster
(`on="tcp://SCHEDULER:8786"`); any `concurrent.futures.Executor` can do the work.

Invariant:
    - Results do not depend on which worker runs an item.
    - The number of items in flight is bounded.
    - An item whose worker died runs again, at most `MAX_LOSSES` times in all. Its last attempt
      is a batch of its own while nothing else runs, so that the item in the error message is
      the one that kills its workers.
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
"""Called with the number of finished items and the number of all items."""
Workers = str | Executor | None
"""The address of a Dask scheduler, an executor, or None for processes of this machine."""

BATCH_S = 0.4
"""Duration of a batch of items: with 20 ms per item its overhead is below 1 %."""
CLUSTER_BATCH_S = 2.0
"""Duration of a batch on a cluster, where each batch has an overhead of about 20 ms."""
MAX_BATCH = 400
"""Largest number of items in a batch."""
_SMALLEST = 16
"""The last batches have at least a full batch's number of items divided by this."""
MAX_LOSSES = 3
"""Number of losses of its worker after which an item is given up."""
_BATCHES_PER_WORKER = 2
"""A batch in work and a waiting batch, so that no worker is idle."""
_POLL_S = 1.0
_MAX_NAME = 200
"""Longest name of an item in an error message."""


def ignore_progress(_done: int, _total: int) -> None:
    """Shows no progress."""


class _BatchResult(NamedTuple):
    """Results of a batch.

    Attributes:
        results: results of the items up to the first error.
        wall_s: duration of these items, s.
        error: the first error; None if all items have a result.
    """

    results: list[Any]
    wall_s: float
    error: Exception | None


def run_batch(
    function: Callable[[T], Any],
    items: Sequence[T],
    required: WorkerRequirements | None,
    allowed: CodeConsents,
) -> _BatchResult:
    """Runs a function on the items of a batch, in a worker.

    Args:
        function: the function.
        items: the items.
        required: requirements on the worker; None: no requirements.
        allowed: imported laws that may run.

    Raises:
        UsageError: this worker does not meet the requirements.
    """
    if required is not None:
        check_this_worker(required)
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    results: list[Any] = []
    error = None
    with allowing_any_settings(allowed):
        for item in items:
            try:
                results.append(function(item))
            except Exception as raised:
                error = raised  # `WorkerPool` raises it when it collects the results
                break
    return _BatchResult(results, (clock.monotonic_ns() - start_ns) * 1e-9, error)


class _Batch(NamedTuple):
    """A batch in flight.

    Attributes:
        numbers: numbers of the items.
        items: the items.
        executor: the executor that runs them.
    """

    numbers: list[int]
    items: list[Any]
    executor: Executor


class _Feed(Generic[T]):
    """The queue of items, which forms the batches.

    Args:
        items: the items.
        count: number of items; None: unknown.
        workers: number of workers.
        batch_s: intended duration of a batch, s.
    """

    def __init__(
        self, items: Iterable[T], count: int | None, workers: int, batch_s: float = BATCH_S
    ) -> None:
        self._new = enumerate(items)
        self._remaining = count
        self._workers = workers
        self._batch_s = batch_s
        self._retries: deque[tuple[int, T]] = deque()
        self._suspects: deque[tuple[int, T]] = deque()
        self._losses: Counter[int] = Counter()
        self._runs = 0
        self._wall_s = 0.0

    def add_timing(self, runs: int, wall_s: float) -> None:
        """Adds measured items to the mean duration per item, which sets the batch size.

        Args:
            runs: number of items.
            wall_s: their duration together, s.
        """
        self._runs = self._runs + runs
        self._wall_s = self._wall_s + wall_s

    def pop_batch(self, *, idle: bool) -> list[tuple[int, T]]:
        """Returns the next batch as pairs of number and item; [] if no item can run now.

        Args:
            idle: no batch is in flight. Only then does an item that may kill its worker leave
                the queue.
        """
        if self._suspects:
            return [self._suspects.popleft()] if idle else []
        if self._retries:
            return [self._retries.popleft()]
        size = 1
        if self._wall_s > 0.0:
            size = min(MAX_BATCH, int(self._batch_s * self._runs / self._wall_s))
        if self._remaining is not None:
            # small batches at the end leave no worker idle
            share = self._remaining // (2 * self._workers * _BATCHES_PER_WORKER)
            size = min(size, max(share, size // _SMALLEST))
        batch = list(islice(self._new, max(1, size)))
        if self._remaining is not None:
            self._remaining -= len(batch)
        return batch

    def return_lost(self, batch: _Batch, losses: int = 1) -> list[tuple[int, T]]:
        """Puts the items of a lost batch back into the queue.

        Args:
            batch: the batch.
            losses: number of losses that count for each item.

        Returns:
            The items that were lost `MAX_LOSSES` times and stay out of the queue.
        """
        lost = []
        for number, item in zip(batch.numbers, batch.items, strict=True):
            self._losses[number] += losses
            if self._losses[number] >= MAX_LOSSES:
                lost.append((number, item))
            elif self._losses[number] == MAX_LOSSES - 1:
                self._suspects.append((number, item))
            else:
                self._retries.append((number, item))
        return lost


class WorkerPool:
    """The workers of a study.

    Args:
        executor: the executor of the batches; None: items run in this process.
        workers: number of items that run at the same time.
        restart: returns a new executor after the loss of a worker broke the old one; None: the
            executor cannot be replaced.
        cluster: the cluster to which the executor belongs.
        required: requirements on each worker of the cluster.
        hint: advice in the message about a lost worker.
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

    def iterate_results(
        self,
        function: Callable[[T], R],
        items: Iterable[T],
        lost: Callable[[T], R] | None = None,
        count: int | None = None,
    ) -> Iterator[tuple[int, R]]:
        """Yields the number and the result of each item, in the order in which they end.

        Args:
            function: a function at module level, so that another process can import it.
            items: the items; messages name them by their `str`.
            lost: returns the result of an item that killed its workers; None: such an item is
                an error.
            count: number of items, if known.

        Raises:
            RunFailed: an item killed its workers, or no workers are left.
            UsageError: a worker does not meet the requirements.
        """
        if self._executor is None:
            for number, item in enumerate(items):
                with allowing_any_settings(allowed_code):
                    result = function(item)
                yield number, result
            return
        batch_s = BATCH_S if self._cluster is None else CLUSTER_BATCH_S
        feed = _Feed(items, count, self.workers, batch_s)
        pending: dict[Future[_BatchResult], _Batch] = {}
        try:
            while True:
                self._submit(function, feed, pending)
                if not pending:
                    return
                ended = wait(pending, _POLL_S, FIRST_COMPLETED).done
                if not ended and self._cluster is not None:
                    self._cluster.check_alive()
                for future in sorted(ended, key=lambda future: pending[future].numbers):
                    yield from self._collect(future, pending.pop(future), feed, lost)
        finally:
            # own processes end with the pool, and loky fails on futures that are cancelled
            if self._restart is None:
                for future in pending:
                    future.cancel()

    def map(
        self,
        function: Callable[[T], R],
        items: Sequence[T],
        progress: Progress = ignore_progress,
    ) -> list[R]:
        """Returns the function's results in the order of the items, and reports progress."""
        results: dict[int, R] = {}
        for number, result in self.iterate_results(function, items, count=len(items)):
            results[number] = result
            progress(len(results), len(items))
        return [results[number] for number in range(len(items))]

    def _submit(
        self,
        function: Callable[[T], R],
        feed: _Feed[T],
        pending: dict[Future[_BatchResult], _Batch],
    ) -> None:
        """Submits batches until every worker has one in work and one waiting."""
        assert self._executor is not None
        while len(pending) < self.workers * _BATCHES_PER_WORKER:
            batch = feed.pop_batch(idle=not pending)
            if not batch:
                return
            numbers = [number for number, _ in batch]
            items = [item for _, item in batch]
            arguments: Any = (function, items, self._required, dict(allowed_code))
            try:
                future = self._executor.submit(run_batch, *arguments)
            except BrokenExecutor:
                self._replace_executor(self._executor)
                future = self._executor.submit(run_batch, *arguments)
            pending[future] = _Batch(numbers, items, self._executor)

    def _collect(
        self,
        future: Future[_BatchResult],
        batch: _Batch,
        feed: _Feed[T],
        lost: Callable[[T], R] | None,
    ) -> Iterator[tuple[int, R]]:
        """Yields the results of a batch that ended, or returns its items to the queue.

        Args:
            future: the future of the batch.
            batch: the batch.
            feed: the queue.
            lost: returns the result of an item that killed its workers, see `iterate_results`.
        """
        try:
            result = future.result()
        except BrokenExecutor:
            self._replace_executor(batch.executor)
            given_up = feed.return_lost(batch)
        except (Exception, CancelledError) as error:
            if self._cluster is None or not self._cluster.is_worker_loss(error):
                raise
            # Dask has repeated a single item already
            losses = 1 if len(batch.items) > 1 else MAX_LOSSES
            given_up = feed.return_lost(batch, losses)
        else:
            feed.add_timing(len(result.results), result.wall_s)
            yield from zip(batch.numbers, result.results, strict=False)
            if result.error is not None:
                raise result.error
            return
        for number, item in given_up:
            if lost is None:
                name = textwrap.shorten(str(item), _MAX_NAME, placeholder="...")
                raise RunFailed(f"{name} ended {MAX_LOSSES} worker processes{self._hint}")
            yield number, lost(item)

    def _replace_executor(self, broken: Executor) -> None:
        """Starts a new executor in place of a broken one, unless that has been done already.

        Raises:
            RunFailed: the executor cannot be replaced.
        """
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
    """Yields the workers of a study, and ends the processes that it started.

    Args:
        jobs: number of processes of this machine; None: one per core; 1: this process.
        on: runs the items instead of processes of this machine.
        most: number of items; no more processes are started.
        laws: imported control laws that the items need; each worker must have their files.
        hint: advice in the message about a lost worker.

    Raises:
        UsageError: the cluster cannot be reached, a worker does not meet the requirements, or a
            library is missing.
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
            if most is not None:
                count = min(count, most)

            def start_processes() -> Executor:
                processes: AbstractContextManager[Executor] = worker_pool(count)
                return stack.enter_context(processes)

            if count > 1:
                yield WorkerPool(start_processes(), count, start_processes, hint=hint)
            else:
                yield WorkerPool(None, 1)


def check_workers(jobs: int | None, on: Workers) -> None:
    """Refuses --jobs together with --on.

    Raises:
        UsageError: both options are present.
    """
    if on is not None and jobs is not None:
        raise UsageError(
            "--jobs is the number of processes of this machine: leave it out with --on"
        )


def count_workers(jobs: int | None, on: Workers = None) -> int:
    """Returns the number of items that will run at the same time.

    The workers of a cluster are checked.

    Raises:
        UsageError: the cluster cannot be reached, or a worker does not meet the requirements.
    """
    check_workers(jobs, on)
    if on is None:
        return jobs or count_cores()
    with open_worker_pool(None, on) as pool:
        return pool.workers

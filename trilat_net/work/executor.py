"""Runs a function on many items in parallel; the worker pool of all studies.

An item is a unit of work such as one simulated run. Items run in this process, in worker
processes on this machine (using loky), on a Dask cluster with an address such as
"tcp://SCHEDULER:8786", or in any other `concurrent.futures.Executor`. To reduce communication
overhead, several items are sent to a worker at once, as a batch.

Invariant:
    - The result of an item does not depend on the worker that runs it.
    - The number of items in flight is bounded.
    - An item whose worker died is retried, with at most `MAX_LOSSES` attempts in total. No
      other item runs during its last attempt. Therefore the item named in the error message is
      the one that kills its workers.
"""

import itertools
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
from ..net import SystemClock
from ..own_code import CodeConsents, allowed_code, allowing_any_settings
from ..package_names import require_libraries
from ..workers import count_cores, worker_pool
from .dask_cluster import DaskCluster, WorkerRequirements

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[int, int], None]
"""Function that is called with the number of finished items and the number of all items."""
Workers = str | Executor | None
"""Address of a Dask scheduler, an executor, or `None` for worker processes on this machine."""

Together = Callable[[Sequence[T]], Iterable[R]]
"""Function that computes several items together. It yields their results in order, and raises
the error of an item in place of the item's result.
"""

BATCH_S = 0.4
"""Intended duration of a batch, in s, so that the overhead of a batch is below 1 % of it."""
CLUSTER_BATCH_S = 2.0
"""Intended duration of a batch on a cluster, in s. There a batch costs about 20 ms."""
MAX_BATCH = 400
"""Largest number of items in a batch."""
_SMALLEST_FRACTION = 16
"""The last batches have at least the number of items of a full batch divided by this number."""
MAX_LOSSES = 3
"""Number of workers that an item may kill before it is given up."""
_BATCHES_PER_WORKER = 2
"""Number of batches in flight per worker: one runs and one waits, so that no worker is idle."""
_POLL_S = 1.0
"""Interval between checks of a cluster while no batch ends, in s."""
_MAX_NAME = 200
"""Largest number of characters of an item's name in an error message."""


class _BatchResult(NamedTuple):
    """Results of a group of items, which a worker process returns to the main process.

    Attributes:
        results: Results of the items, up to the first error.
        wall_s: Duration of these items, in s.
        error: First error. `None` if all items have a result.
    """

    results: list[Any]
    wall_s: float
    error: Exception | None


def run_batch(
    function: Callable[[T], Any],
    items: Sequence[T],
    required: WorkerRequirements | None,
    allowed: CodeConsents,
    together: Together[T, Any] | None = None,
) -> _BatchResult:
    """Runs a function on each item of a batch, stopping at the first error.

    Called in a worker process. Items are sent in batches because, for short items, sending each
    one separately would take longer than running it.

    Args:
        function: Function that takes one item and returns its result.
        items: The items of the batch.
        required: Requirements on the worker, such as the program version. `None` if there are
            no requirements.
        allowed: Imported control laws that the user allowed to run.
        together: Function that replaces `function` if the batch has several items.

    Returns:
        The results up to the first error, the time that they took, and the error.

    Raises:
        UsageError: This worker does not meet the requirements.
    """
    if required is not None:
        required.check_this_worker()
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    results: list[Any] = []
    error = None

    with allowing_any_settings(allowed):
        new_results: Iterable[Any] = map(function, items)
        if together is not None and len(items) > 1:
            new_results = together(items)
        try:
            for result in new_results:
                results.append(result)  # noqa: PERF402 - keeps the results before an error
        except Exception as raised:
            error = raised  # `WorkerPool` raises it when it collects the results
    return _BatchResult(results, (clock.monotonic_ns() - start_ns) * 1e-9, error)


class _Batch(NamedTuple):
    """A group of items that one worker process is working on.

    The items return to the queue if the worker dies.

    Attributes:
        numbers: Numbers of the items in the study, counted from 0.
        items: The items, each of which is the argument of one call.
        executor: Executor that runs the items.
    """

    numbers: list[int]
    items: list[Any]
    executor: Executor


class _Feed(Generic[T]):
    """Queue of the items that wait for a worker. It groups them into batches.

    The size of a batch is chosen from the measured duration of the items, so that a batch takes
    about `batch_s`. Items whose worker died come back to this queue.

    Args:
        items: The items, each of which is the argument of one call.
        count: Number of items. `None` if it is not known.
        workers: Number of workers that take items from the queue.
        batch_s: Intended duration of a batch, in s.
        least: Smallest number of items in a batch, even if the batch then takes longer than
            `batch_s`.
    """

    def __init__(
        self,
        items: Iterable[T],
        count: int | None,
        workers: int,
        batch_s: float = BATCH_S,
        least: int = 1,
    ) -> None:
        self._new = enumerate(items)
        self._remaining = count
        self._workers = workers
        self._batch_s = batch_s
        self._least = least
        self._retries: deque[tuple[int, T]] = deque()
        self._suspects: deque[tuple[int, T]] = deque()  # items in their last attempt
        self._losses: Counter[int] = Counter()
        self._runs = 0
        self._wall_s = 0.0

    def add_timing(self, runs: int, wall_s: float) -> None:
        """Updates the mean duration of an item, which determines the size of later batches.

        Short items are sent in large batches, because sending also takes time.

        Args:
            runs: Number of finished items.
            wall_s: Total duration of these items, in s.
        """
        self._runs = self._runs + runs
        self._wall_s = self._wall_s + wall_s

    def pop_batch(self, *, idle: bool) -> list[tuple[int, T]]:
        """Removes the next batch from the queue.

        Items whose worker died are run again before new items, each as a separate batch. An
        item in its last attempt is a suspect, since it probably kills its worker. It runs only
        while no other batch is in flight, so that no other items are lost with it.

        Otherwise the batch consists of new items. Their number is chosen from the mean duration
        of the finished items, so that the batch takes about `batch_s`.

        Args:
            idle: True if no batch is in flight.

        Returns:
            Pairs of item index and item. Empty if no item can run now.
        """
        if self._suspects:
            return [self._suspects.popleft()] if idle else []
        if self._retries:
            return [self._retries.popleft()]

        size = self._least  # until the duration of an item is known
        if self._wall_s > 0.0:
            # The finished items, `_runs` in number, took `_wall_s` together.
            items_in_batch_s = int(self._batch_s * self._runs / self._wall_s)
            size = max(self._least, min(MAX_BATCH, items_in_batch_s))
        if self._remaining is not None:
            # Towards the end the batches become smaller, so that no worker is idle for long:
            # all batches in flight together contain at most half of the remaining items.
            # Items that are computed together take longer in small batches.
            shares = self._workers
            if self._least == 1:
                shares *= 2 * _BATCHES_PER_WORKER
            fair_size = self._remaining // shares
            smallest_size = size // _SMALLEST_FRACTION  # limits the overhead of small batches
            size = min(size, max(fair_size, smallest_size))
        batch = list(islice(self._new, max(1, size)))
        if self._remaining is not None:
            self._remaining -= len(batch)
        return batch

    def return_lost(self, batch: _Batch, losses: int = 1) -> list[tuple[int, T]]:
        """Puts the items of a batch whose worker died back into the queue, to be run again.

        A worker may die because the machine has run out of memory. Most of its items then
        succeed at the second attempt.

        Args:
            batch: Batch whose worker died.
            losses: Number of losses to count for each item.

        Returns:
            The items that have been lost `MAX_LOSSES` times. They are given up and not returned
            to the queue.
        """
        given_up = []
        for number, item in zip(batch.numbers, batch.items, strict=True):
            self._losses[number] += losses
            attempts_left = MAX_LOSSES - self._losses[number]
            if attempts_left <= 0:
                given_up.append((number, item))
            elif attempts_left == 1:
                self._suspects.append((number, item))
            else:
                self._retries.append((number, item))
        return given_up


class WorkerPool:
    """Runs the items of a study in parallel, in processes on this machine or on a cluster.

    An item is an independent unit of work, such as one simulated run. Create a pool with
    `open`. A study passes its items to `map`, or to `iterate_results` if it stores each result
    immediately.

    Args:
        executor: Executor that runs the batches. `None` if the items run in this process.
        workers: Number of items that run at the same time.
        restart: Function that returns a new executor after a dying worker broke the old one.
            `None` if the executor cannot be replaced.
        cluster: Cluster to which the executor belongs, if any.
        required: Requirements on each worker of the cluster.
        hint: Advice for the user, appended to the error message about a dead worker.

    Attributes:
        is_local: True if the items run in this process.
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

    @classmethod
    @contextmanager
    def open(
        cls,
        jobs: int | None,
        on: Workers = None,
        *,
        most: int | None = None,
        laws: Sequence[tuple[str, str]] = (),
        hint: str = "",
    ) -> Iterator["WorkerPool"]:
        """Starts the worker processes of a study, or connects to the workers of a cluster.

        Use this method in a `with` statement. On exit, the processes that it started are ended,
        while the workers of a cluster keep running.

        Args:
            jobs: Number of processes on this machine. If `None`, all cores are used. If 1, the
                items run in this process.
            on: Workers to use instead of processes on this machine.
            most: Number of items. No more processes than this are started.
            laws: Pairs of the name of an imported class that the items need and the SHA-256 of
                its file. Each worker must have the files.
            hint: Advice for the user, appended to the error message about a dead worker.

        Raises:
            UsageError: The cluster cannot be reached, a worker does not meet the requirements,
                or a library is missing.
        """
        require_libraries()
        with ExitStack() as stack:
            if isinstance(on, str):
                cluster = stack.enter_context(DaskCluster(on))
                required = cluster.require(laws)
                yield cls(
                    executor=cluster.executor,
                    workers=cluster.workers,
                    restart=None,
                    cluster=cluster,
                    required=required,
                    hint=hint,
                )
            elif on is not None:
                yield cls(on, getattr(on, "_max_workers", count_cores()), hint=hint)
            else:
                count = jobs or count_cores()
                if most is not None:
                    count = min(count, most)

                def start_processes() -> Executor:
                    processes: AbstractContextManager[Executor] = worker_pool(count)
                    return stack.enter_context(processes)

                if count > 1:
                    yield cls(start_processes(), count, start_processes, hint=hint)
                else:
                    yield cls(None, 1)

    @staticmethod
    def check_options(jobs: int | None, on: Workers) -> None:
        """Raises UsageError if the options --jobs and --on are combined.

        The option --jobs sets the number of processes on this machine, and has no effect on a
        cluster, which is selected with --on.

        Args:
            jobs: Value of --jobs. `None` if it was not given.
            on: Value of --on. `None` if it was not given.

        Raises:
            UsageError: Both options are given.
        """
        if on is not None and jobs is not None:
            raise UsageError(
                "--jobs sets the number of processes on this machine: leave it out with --on"
            )

    @classmethod
    def count_workers(cls, jobs: int | None, on: Workers = None) -> int:
        """Returns how many items of a study will run at the same time.

        For a cluster, this connects to its scheduler and checks its workers.

        Args:
            jobs: Number of processes on this machine. If `None`, all cores are used.
            on: Workers to use instead of processes on this machine.

        Raises:
            UsageError: The cluster cannot be reached, or a worker does not meet the
                requirements.
        """
        cls.check_options(jobs, on)
        if on is None:
            return jobs or count_cores()
        with cls.open(None, on) as pool:
            return pool.workers

    def iterate_results(
        self,
        function: Callable[[T], R],
        items: Iterable[T],
        lost: Callable[[T], R] | None = None,
        count: int | None = None,
        together: Together[T, R] | None = None,
        together_count: int = 1,
    ) -> Iterator[tuple[int, R]]:
        """Runs a function on each item with all workers, and yields each result as it arrives.

        Results may arrive in a different order from the items. A study can use this method to
        store each result immediately.

        Args:
            function: Module-level function, so that other processes can import it.
            items: The items. Error messages identify an item by its `str`.
            lost: Function that returns the result of an item that killed its workers. `None` to
                raise an error for such an item.
            count: Number of items, if it is known.
            together: Function that replaces `function` for several items at once.
            together_count: Number of items to pass to `together`.

        Yields:
            The index of an item, counted from 0, and its result.

        Raises:
            RunFailed: An item crashed the workers that ran it, or no workers are left.
            UsageError: A worker does not meet the requirements.
        """
        if self._executor is None:
            numbers = itertools.count()
            remaining = iter(items)
            while batch := list(islice(remaining, together_count)):
                result = run_batch(function, batch, None, allowed_code, together)
                for value in result.results:
                    yield next(numbers), value
                if result.error is not None:
                    raise result.error
            return

        batch_s = BATCH_S if self._cluster is None else CLUSTER_BATCH_S
        feed = _Feed(items, count, self.workers, batch_s, together_count)
        pending: dict[Future[_BatchResult], _Batch] = {}
        try:
            while True:
                self._submit(function, feed, pending, together)
                if not pending:
                    return

                ended = wait(pending, _POLL_S, FIRST_COMPLETED).done
                if not ended and self._cluster is not None:
                    self._cluster.check_alive()
                for future in sorted(ended, key=lambda future: pending[future].numbers):
                    yield from self._collect(future, pending.pop(future), feed, lost)
        finally:
            # Processes of this machine end together with the pool. Their futures are not
            # cancelled, because loky fails on cancelled futures.
            if self._restart is None:
                for future in pending:
                    future.cancel()

    def map(
        self,
        function: Callable[[T], R],
        items: Sequence[T],
        progress: Progress | None = None,
        together: Together[T, R] | None = None,
        together_count: int = 1,
    ) -> list[R]:
        """Runs a function on each item of a list in parallel, and returns all results.

        The items are distributed to worker processes on this machine or on a cluster.

        Args:
            function: Module-level function, so that other processes can import it.
            items: The items, each passed to one call.
            progress: Function that is called each time an item is finished, if any.
            together: Function that replaces `function` for several items at once.
            together_count: Number of items to pass to `together`.

        Returns:
            The results in the order of the items. Empty if there are no items.

        Raises:
            RunFailed: An item crashed the workers that ran it, or no workers are left.
            UsageError: A worker does not meet the requirements.
        """
        results: dict[int, R] = {}
        for number, result in self.iterate_results(
            function,
            items,
            count=len(items),
            together=together,
            together_count=together_count,
        ):
            results[number] = result
            if progress is not None:
                progress(len(results), len(items))
        return [results[number] for number in range(len(items))]

    def _submit(
        self,
        function: Callable[[T], R],
        feed: _Feed[T],
        pending: dict[Future[_BatchResult], _Batch],
        together: Together[T, R] | None,
    ) -> None:
        """Sends groups of items (batches) to the workers until each worker has one waiting.

        A batch that waits keeps the worker busy until the results of the previous batch have
        been processed.

        Args:
            function: The function to run on each item.
            feed: Queue of the items.
            pending: Batches in flight, by their futures. New batches are added.
            together: Function for several items at once, if there is one.
        """
        assert self._executor is not None
        while len(pending) < self.workers * _BATCHES_PER_WORKER:
            batch = feed.pop_batch(idle=not pending)
            if not batch:
                return

            numbers = [number for number, _ in batch]
            items = [item for _, item in batch]
            arguments: Any = (function, items, self._required, dict(allowed_code), together)
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
        """Yields the results of a finished batch, a group of items that one worker received.

        If the worker process died, the items are queued again.

        Args:
            future: Future of the batch.
            batch: The batch that ended.
            feed: Queue of the items.
            lost: Function that returns the result of an item that killed its workers, see
                `iterate_results`.

        Raises:
            RunFailed: An item killed its workers, and `lost` is `None`.
        """
        try:
            result = future.result()
        except BrokenExecutor:
            self._replace_executor(batch.executor)
            given_up = feed.return_lost(batch)
        except (Exception, CancelledError) as error:
            is_worker_loss = self._cluster is not None and self._cluster.is_worker_loss(error)
            if not is_worker_loss:
                raise
            # Dask itself has already repeated a batch, so a single item is given up at once.
            losses = 1 if len(batch.items) > 1 else MAX_LOSSES
            given_up = feed.return_lost(batch, losses)
        else:
            feed.add_timing(len(result.results), result.wall_s)
            # If an item failed, there are fewer results than items.
            yield from zip(batch.numbers, result.results, strict=False)
            if result.error is not None:
                raise result.error
            return

        for number, item in given_up:
            if lost is None:
                name = textwrap.shorten(str(item), _MAX_NAME, placeholder="...")
                raise RunFailed(
                    f"{MAX_LOSSES} worker processes ended unexpectedly while running "
                    f"{name}{self._hint}"
                )
            yield number, lost(item)

    def _replace_executor(self, broken: Executor) -> None:
        """Starts a new pool of worker processes in place of a broken pool.

        Several batches of the broken pool fail one after another. Only the first failure starts
        a new pool.

        Args:
            broken: The broken executor.

        Raises:
            RunFailed: The executor cannot be replaced.
        """
        if self._restart is None:
            raise RunFailed(f"a worker process ended unexpectedly{self._hint}") from None
        if broken is self._executor:
            self._executor = self._restart()

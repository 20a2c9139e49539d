"""The worker pool: every item once, in few batches, whatever happens to its workers."""

import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from trilat_net.errors import RunFailed, UsageError
from trilat_net.work.executor import MAX_LOSSES, WorkerPool, _Feed


def test_any_executor_gives_the_results_of_this_process() -> None:
    progress: list[tuple[int, int]] = []
    with ThreadPoolExecutor(3) as threads, WorkerPool.open(None, threads) as pool:
        assert pool.map(abs, range(-50, 0), lambda *counts: progress.append(counts)) == list(
            range(50, 0, -1)
        )
    assert progress == [(n, 50) for n in range(1, 51)]
    with WorkerPool.open(1) as pool:
        assert list(pool.iterate_results(abs, [-3, 2])) == [(0, 3), (1, 2)]


def test_few_items_are_taken_at_a_time() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for n in range(10**9):
            taken.append(n)
            yield n

    with ThreadPoolExecutor(2) as threads, WorkerPool.open(None, threads) as pool:
        results = pool.iterate_results(abs, items())
        seen = [next(results) for _ in range(20)]
        results.close()  # type: ignore[attr-defined]
    assert len({n for n, _ in seen}) == 20
    assert len(taken) < 2000


def test_batches_fit_measured_times_and_shrink() -> None:
    feed = _Feed(range(2000), 2000, 2)
    assert len(feed.pop_batch(idle=True)) == 1
    feed.add_timing(10, 0.2)
    assert len(feed.pop_batch(idle=False)) == 20
    sizes = []
    while batch := feed.pop_batch(idle=False):
        sizes.append(len(batch))
    assert sum(sizes) == 1979
    assert sizes == sorted(sizes, reverse=True)
    assert (sizes[0], sizes[-1]) == (20, 1)
    feed = _Feed(range(10), None, 2)
    feed.add_timing(1, 7.0)
    assert len(feed.pop_batch(idle=False)) == 1


def fail_at_five(n: int) -> int:
    if n == 5:
        raise ValueError("five")
    return n


def test_errors_come_after_earlier_results() -> None:
    with ThreadPoolExecutor(1) as threads:
        results = WorkerPool(threads, 1).iterate_results(fail_at_five, range(9))
        assert [next(results) for _ in range(5)] == [(n, n) for n in range(5)]
        with pytest.raises(ValueError, match="five"):
            next(results)


def killed_once(flag: Path, n: int) -> int:
    if n == 7 and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return n * n


class FragileExecutor(Executor):
    """A pool that breaks for good, like a pool of processes, at the batch that holds item 7."""

    def __init__(self) -> None:
        self.broken = False

    def submit(self, fn: Any, /, *args: Any, **_: Any) -> "Future[Any]":
        if self.broken:
            raise BrokenExecutor
        future: Future[Any] = Future()
        self.broken = 7 in args[1]
        if self.broken:
            future.set_exception(BrokenExecutor())
        else:
            future.set_result(fn(*args))
        return future


def test_items_of_a_lost_worker_run_again(tmp_path: Path) -> None:
    with WorkerPool.open(2) as pool:
        assert pool.map(partial(killed_once, tmp_path / "flag"), range(30)) == [
            n * n for n in range(30)
        ]
        assert pool.map(abs, [-1, -2]) == [1, 2]


def test_an_item_that_ends_every_worker_is_named() -> None:
    pool = WorkerPool(FragileExecutor(), 2, FragileExecutor, hint="; what to do")
    with pytest.raises(RunFailed, match=f"^{MAX_LOSSES} .* while running 7; what to do$"):
        pool.map(abs, range(30))
    results = dict(pool.iterate_results(abs, range(30), lambda item: -item))
    assert results == {n: -7 if n == 7 else n for n in range(30)}


def test_jobs_belong_to_this_machine() -> None:
    assert WorkerPool.count_workers(3) == 3
    with pytest.raises(UsageError, match="jobs"):
        WorkerPool.count_workers(3, "tcp://127.0.0.1:1")


def compute_together(items: Sequence[int]) -> Any:
    """Returns roots, several at once; an item below zero is an error."""
    for item in items:
        if item < 0:
            raise ValueError(item)
        yield float(item) ** 0.5


def test_batches_are_yielded_up_to_errors() -> None:
    results = WorkerPool(None, 1).iterate_results(
        abs, [4, 9, 16, -1, 25], together=compute_together, together_count=3
    )
    assert [next(results) for _ in range(3)] == [(0, 2.0), (1, 3.0), (2, 4.0)]
    with pytest.raises(ValueError, match="-1"):
        next(results)

"""Runs candidates on all cores.

Law: scores come in the order of the candidates, whatever the number of processes.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from ..errors import RunFailed
from ..workers import deaf, workers
from .measurement import Score, measure

Task = tuple[str, str | None]
"""The canonical text of a candidate's scenario, and of its twin's or None."""


class Crew:
    """Runs candidates.

    Args:
        pool: in which processes; None: in this one.
    """

    def __init__(self, pool: ProcessPoolExecutor | None) -> None:
        self._pool = pool

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
            with deaf():
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
def crew(jobs: int) -> Iterator[Crew]:
    """Yields who runs candidates.

    Args:
        jobs: in how many processes; one is this one.
    """
    if jobs <= 1:
        yield Crew(None)
        return
    with workers(jobs) as pool:
        yield Crew(pool)

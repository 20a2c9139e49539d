"""Runs many trials in virtual time, on all cores or on a cluster.

Invariant: results come in the order of the trials, whatever ran them; a trial that ends its worker process
again and again costs itself and no other.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ...core.jit import is_core_cached
from ...errors import TrilatError
from ...execution import virtual
from ...net.clock import SystemClock
from ...scenario import Scenario
from ...scenario.law_consent import list_imported_laws
from ..executor import MAX_LOSSES, Workers, open_worker_pool
from .trial import Trial, TrialResult, trials
from .trial_report import TrialReport


def _run_trial(trial: Trial) -> TrialResult:
    """Runs a trial in whatever process; an error that no other trial would have is its result."""
    try:
        return trial.run()
    except (TrilatError, ArithmeticError, ValueError, MemoryError) as error:
        return TrialResult(trial, error=f"{type(error).__name__}: {error}")


def run_trials(
    batch: Sequence[Trial],
    jobs: int | None = None,
    done: Callable[[TrialResult], None] = lambda _: None,
    on: Workers = None,
) -> TrialReport:
    """Runs trials in virtual time and returns their results.

    Args:
        batch: the trials.
        jobs: how many processes; None for one per core. One trial, or one job, runs in this process.
        done: called with every result as it comes.
        on: what runs them instead: a Dask scheduler's address or an executor.
    """
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    laws = list_imported_laws(trial.scenario for trial in batch)
    longest_first = sorted(range(len(batch)), key=lambda n: -batch[n].scenario.duration_s)
    results: dict[int, TrialResult] = {}
    with open_worker_pool(jobs, on, most=len(batch), laws=laws) as pool:
        if pool.is_local:
            replies = ((n, trial.run()) for n, trial in enumerate(batch))
        else:
            if not is_core_cached():
                next(virtual.execute_virtual(batch[0].scenario))  # compiles, once for all processes
            queue = [batch[n] for n in longest_first]
            lost = partial(TrialResult, error=f"its worker process ended, {MAX_LOSSES} times")
            replies = (
                (longest_first[place], result)
                for place, result in pool.each(_run_trial, queue, lost, len(queue))
            )
        for n, result in replies:
            results[n] = result._replace(trial=batch[n])
            done(results[n])
    return TrialReport([results[n] for n in range(len(batch))], (clock.monotonic_ns() - start_ns) * 1e-9)


def check(
    source: str | Path | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    jobs: int | None = None,
    on: Workers = None,
) -> TrialReport:
    """Runs a scenario in virtual time, once per seed, and returns the results if all of [expect] held.

    The command is `trilat test`.

    >>> tn.check("free", jobs=1).held
    True

    Args:
        source: the name of a shipped scenario, a path, or a scenario.
        seeds: which seeds; none means the scenario's own.
        set: overrides, as in `{"link.delay_ms": 400}`.
        jobs: how many processes; None for one per core.
        on: what runs them instead: a Dask scheduler's address, as in "tcp://10.0.0.5:8786", or an executor.

    Raises:
        ScenarioError: the scenario or an override is not valid, or there is no [expect] in it.
        UsageError: the cluster cannot be reached, or one of its workers is not fit.
        AssertionError: something did not hold; it says what, by how much, and how to repeat it.
    """
    __tracebackhide__ = True  # pytest shows the reason, not this line
    report = run_trials(trials(source, seeds, set), jobs, on=on)
    if not report.held:
        first = next(f"{one.trial}: {'; '.join(one.failures)}" for one in report.results if not one.held)
        raise AssertionError(f"not as expected: {first}\n{report.summary()}")
    return report

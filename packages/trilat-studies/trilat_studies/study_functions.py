"""The Python functions for studies of many runs: `sweep`, `margin`, `tune` and `bench`.

They are called as functions of trilat_net, for example `trilat_net.sweep("paper",
{"link.delay_ms": [0, 100]})`. Each has a command that does the same: `trilat sweep`, `trilat
sweep --margin`, `trilat compare --tune` and `trilat bench`.

Invariant:
    - These functions only convert their arguments and call the modules that do the work.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trilat_net.app import AnyScenario, Overrides

from .run_commands import list_assignments

if TYPE_CHECKING:
    from trilat_net.work import Workers

    from .bench import BenchResults
    from .sweep.margin_search import SweepMargins
    from .sweep.sweep_results import SweepResults
    from .tuning.tuning_plan import TuningResult

Axes = str | Sequence[str] | Mapping[str, Any]


def _list_override_texts(overrides: Overrides, duration_s: float | None) -> list[str]:
    """Converts overrides to strings KEY=VALUE, as on the command line.

    Args:
        overrides: Mapping from key to value, or one or more strings KEY=VALUE.
        duration_s: Duration of the run in s, which becomes the last override. If `None`, no
            such override is added.
    """
    texts: list[Any]
    if isinstance(overrides, Mapping):
        texts = list(list_assignments(overrides))
    elif isinstance(overrides, list | tuple):
        texts = list(overrides)
    else:
        texts = [overrides]
    if duration_s is not None:
        texts.append(f"duration_s={duration_s}")
    return texts


def sweep(
    scenario: AnyScenario,
    over: Axes = (),
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    seeds: int | Sequence[int] = 1,
    laws: Sequence[str | type] = (),
    duration_s: float | None = None,
    longest_s: float | None = None,
    judge: str = "verdict",
    metrics: Sequence[str] = (),
    refine: int = 0,
    out: str | Path | None = None,
    jobs: int | None = None,
    on: "Workers" = None,
) -> "SweepResults":
    """Runs a scenario over a grid of values of its keys, and judges the stability of each run.

    The command `trilat sweep` does the same.

    >>> axes = {"control.d": [0.3, 3.0]}
    >>> found = tn.sweep("p_d_margin", axes, duration_s=2, out="grid", jobs=1)
    >>> len(found.rows)
    2

    Args:
        scenario: Name of a shipped scenario, a path, a TOML string, its tables, or a
            `Scenario`.
        over: Axes of the grid, either a mapping from scenario key to values, such as
            `{"link.delay_ms": range(0, 1601, 50)}`, or strings, such as
            `["link.delay_ms=0:1600:50"]`.
        set: Scenario overrides for all cells of the grid, such as `{"control.Kd": 5}`.
        seeds: Number of seeds for random delays and losses, or a list of seeds. Each cell (a
            point of the grid) is run once per seed.
        laws: Names or classes of control laws, which form another axis of the grid.
        duration_s: Initial duration of each run, in s.
        longest_s: Longest duration to which a run is extended while its stability is open, in
            s. Default: eight times `duration_s`, or `duration_s` if `judge` is "twins".
        judge: "verdict", "twins" or "linear". Twins are two runs that differ by a small
            disturbance. With "twins", the growth exponent of this disturbance is measured in
            each cell, in addition to the verdict. With "linear", nothing is simulated, and each
            cell contains the growth rate of its linearised loop.
        metrics: Keys of docs/reference/metrics.md to measure in each run. They become columns
            of the rows.
        refine: Number of halvings along the stability edge. The sweep begins with every
            2^refine-th value of the first two numeric axes. If 0, all cells are run.
        out: Folder for the results. A sweep that is already in this folder is continued.
            Default: the next free folder runs/sweep-NAME-N.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler, or an executor, that executes the runs instead.

    Returns:
        The verdict and the metrics of each cell.

    Raises:
        ScenarioError: The scenario, an axis or one of its values is not valid.
        UsageError: The folder contains something else.
    """
    from .sweep import plan_sweep, prepare_sweep_folder, run_sweep

    plan = plan_sweep(
        scenario,
        _list_override_texts(set, duration_s),
        over=over,
        seeds=seeds,
        laws=laws,
        longest_s=longest_s,
        judge=judge,
        metrics=metrics,
        refine=refine,
    )
    folder = prepare_sweep_folder(plan, None if out is None else Path(out))
    return run_sweep(folder, jobs, on=on).results


def margin(
    scenario: AnyScenario,
    along: str,
    over: Axes = (),
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    tolerance: float = 0.005,
    seeds: int | Sequence[int] = 1,
    laws: Sequence[str | type] = (),
    duration_s: float | None = None,
    jobs: int | None = None,
    on: "Workers" = None,
) -> "SweepMargins":
    """Searches for stability edges along a scenario key, as does `trilat sweep --margin`.

    An edge is a value of the key at which runs change from stable to not stable, or back.

    >>> found = tn.margin("p_d_margin", "control.d=0.2:3", tolerance=0.2, duration_s=4, jobs=1)
    >>> [search.margin.spans[0].stable_below for search in found.found]
    [False]

    Args:
        scenario: Name of a shipped scenario, a path, a TOML string, its tables, or a
            `Scenario`.
        along: The key and its range, such as "control.d=0.2:3".
        over: Axes of a grid, as in `sweep`, such as `{"link.delay_ms": [100, 200]}`. The edges
            are searched for at each point of the grid.
        set: Scenario overrides for all runs.
        tolerance: Largest width of the interval that contains an edge, relative to its value.
        seeds: Number of seeds for random delays and losses, or a list of seeds.
        laws: Names or classes of control laws, which form another axis of the grid.
        duration_s: Initial duration of each run, in s.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler, or an executor, that executes the runs instead.

    Returns:
        For each point of the grid, the intervals of the key that contain an edge.

    Raises:
        ScenarioError: The scenario or one of the values is not valid.
        UsageError: The range does not have the form KEY=LOW:HIGH.
    """
    from .sweep import plan_sweep
    from .sweep.margin_search import SearchRange, SweepMargins
    from .sweep.sweep_axis import SweepAxis

    search_range = SearchRange.parse(along, tolerance)
    axes = [*SweepAxis.list_descriptions(over), search_range.format_axis()]
    overrides = _list_override_texts(set, duration_s)
    plan = plan_sweep(scenario, overrides, over=axes, seeds=seeds, laws=laws)
    return SweepMargins.search(plan, search_range, jobs, on=on)


def tune(
    scenario: AnyScenario,
    laws: Sequence[str | type] = (),
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    budget: int = 64,
    seed: int = 1,
    seeds: int = 1,
    objective: str = "error",
    gravity_percent: float = 100.0,
    duration_s: float | None = None,
    jobs: int | None = None,
    on: "Workers" = None,
) -> "TuningResult":
    """Tunes control laws with the same procedure and compares them.

    The command `trilat compare --tune` does the same. The same number of candidate gains is
    tried for each law.

    >>> found = tn.tune("free", ["p_d"], budget=2, duration_s=2, jobs=1)
    >>> [law.space.law for law in found.found]
    ['p_d']

    Args:
        scenario: Name of a shipped scenario, a path, a TOML string, its tables, or a
            `Scenario`.
        laws: Names or classes of the laws. If empty, all laws that support any number of sites.
        set: Scenario overrides, such as `{"link.delay_ms": 100}`.
        budget: Number of candidates per law.
        seed: Random seed of the search, which draws the candidates.
        seeds: Number of seeds of the scenario over which each candidate is averaged.
        objective: Quantity to minimise in addition to the effort of the arms: the tracking
            error ("error") or the settling time ("settling").
        gravity_percent: Gravity that all laws assume, in % of the true gravity.
        duration_s: Duration of a run, in s. Default: the scenario's duration.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler, or an executor, that executes the runs instead.

    Returns:
        The candidates of each law, with their gains and results.

    Raises:
        ScenarioError: The scenario is not valid, or laws cannot be compared in it.
        UsageError: Another argument is not valid.
    """
    from .tuning import plan_tuning

    plan = plan_tuning(
        scenario,
        _list_override_texts(set, duration_s),
        laws=laws,
        budget=budget,
        seed=seed,
        objective=objective,
        gravity_percent=gravity_percent,
        seeds=seeds,
    )
    return plan.run(jobs, on=on)


def bench(
    study: str = "small",
    *,
    tasks: Sequence[str] = (),
    laws: Sequence[str] = (),
    links: Sequence[str] = (),
    seeds: int | None = None,
    confirm: bool = False,
    out: str | Path | None = None,
    jobs: int | None = None,
    on: "Workers" = None,
) -> "BenchResults":
    """Runs the benchmark suite, which compares control laws in the same tasks and links.

    The command `trilat bench` does the same, and also writes tables and figures.

    >>> cell = {"tasks": ["free"], "laws": ["p_d"], "links": ["rtt68"]}
    >>> found = tn.bench(**cell, seeds=1, out="suite", jobs=1)
    >>> len(found.runs)
    1

    Args:
        study: Part of the suite: full, small or round-trips.
        tasks: Names of the tasks to run. If empty, all tasks of the study.
        laws: Names of the laws to run. If empty, all laws of the study.
        links: Names of the links (network conditions) to run over, such as "rtt68-loss10" or
            "4g". If empty, all links of the study.
        seeds: Number of seeds for random delays and losses. Default: the study's own number.
        confirm: Has no effect. Every run that is not stable is repeated over twice its
            duration, which confirms or refutes the verdict.
        out: Folder for the results. A suite that is already in this folder is continued.
            Default: runs/bench-STUDY.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler, or an executor, that executes the runs instead.

    Returns:
        The runs of all combinations of tasks, laws and links, with their results.

    Raises:
        UsageError: The study, a task, a law or a link is unknown, or the folder contains
            something else.
    """
    from .bench import plan_bench, prepare_bench_folder, run_bench

    plan = plan_bench(study, tasks=tasks, laws=laws, links=links, seeds=seeds)
    folder = prepare_bench_folder(plan, None if out is None else Path(out))
    return run_bench(folder, jobs, on, confirm=confirm)

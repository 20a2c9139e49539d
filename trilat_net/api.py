"""The Python interface: one function per command, for logs, virtual time and studies.

A scenario is a name, a path, a TOML text, its tables or a `Scenario`; a log is a path or a
`Log`. Functions that need a network are in the package `sites`.

Invariant:
    - These functions only convert arguments and call the packages that do the work.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .analysis.certificate.stability_certificate import Certificate
from .analysis.metrics.log_metrics import LogMetrics, compute_log_metrics
from .analysis.twin_growth import TWINS
from .errors import UsageError
from .execution.log_checks import LogCheckReport, run_log_checks
from .execution.virtual import SimulatedLog, simulate_scenario
from .files import make_results_folder
from .log.accounting import MIN_COVERAGE
from .log.log_reader import Log, open_log, open_logs
from .scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from .reporting.conclude import Conclusion
    from .studies.bench import BenchResults
    from .studies.executor import Workers
    from .studies.sweep.margin_search import SweepMargins
    from .studies.sweep.sweep_results import SweepResults
    from .studies.tuning.tuning_plan import TuningResult
    from .theory.linear_analysis import LinearAnalysis

AnyScenario = str | Path | Mapping[str, Any] | Scenario
AnyLog = str | Path | Log
Overrides = Mapping[str, Any] | Sequence[str]
Axes = str | Sequence[str] | Mapping[str, Any]


def _open(log: AnyLog) -> Log:
    """Returns an opened log."""
    return log if isinstance(log, Log) else open_log(log)


def _list_override_texts(overrides: Overrides, duration_s: float | None) -> list[str]:
    """Returns overrides and a duration, s, as texts KEY=VALUE."""
    from .studies.trials import list_assignments

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


def simulate(
    scenario: AnyScenario,
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    duration_s: float | None = None,
    seed: int | None = None,
) -> SimulatedLog:
    """Runs a scenario in virtual time and returns its log; the command is `trilat sim`.

    It warns if the run diverged; `log.diverged_s` is the time of divergence.

    >>> log = tn.simulate("two_sites", duration_s=0.1)
    >>> log["m"].q.shape
    (100, 2)

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        set: overrides, as in `{"control.Kd": 5}` or `["control.Kd=5"]`.
        duration_s: the duration of the run, s; by default the scenario's.
        seed: the seed; by default the scenario's.

    Raises:
        ScenarioError: the scenario or an override is not valid.
    """
    log = simulate_scenario(load_scenario(scenario, set, duration_s=duration_s, seed=seed))
    log.warn_if_diverged()
    return log


def export(
    log: AnyLog | Sequence[AnyLog],
    to: str,
    out: str | Path,
    *,
    force: bool = False,
    **settings: Any,
) -> Path:
    """Exports a log to files for other tools and returns the path.

    The command is `trilat log export`.

    >>> tn.export(tn.simulate("two_sites", duration_s=0.1), "npz", "run.npz").name
    'run.npz'

    Args:
        log: the log, or its path; for lerobot also several logs, or a folder of logs.
        to: ros2, parquet, csv, npz, mat or lerobot.
        out: path of the file, or of the folder for parquet, csv and lerobot.
        force: replace an existing file or folder.
        settings: settings of the format, as `fps=30`, `program="m2"` and `actions="tip"` of
            lerobot.

    Raises:
        UsageError: there is no such format or setting, a package is missing, or the path
            exists.
    """
    from .reporting.export import Exporter

    exporter = Exporter(to, Path(out), force=force, settings=settings)
    all_logs = [log] if isinstance(log, str | Path | Log) else log
    opened = [entry for entry in all_logs if isinstance(entry, Log)]
    paths = [entry for entry in all_logs if not isinstance(entry, Log)]
    exporter.export(*opened, *open_logs(*paths))
    return Path(out)


def verify(
    log: AnyLog,
    *,
    virtual: bool = False,
    min_coverage: float = MIN_COVERAGE,
    resume_every: int = 0,
) -> LogCheckReport:
    """Executes a log again and compares all computed fields; the command is `trilat verify`.

    >>> tn.verify(tn.simulate("two_sites", duration_s=0.1)).passed
    True

    Args:
        log: the log, or its path.
        virtual: compare with virtual time too.
        min_coverage: least share of each site's ticks that must be judged to pass.
        resume_every: restart sites from the records every so many ticks, which reveals state
            of a user-written law that the records lack; 0: never.

    Raises:
        LogError: the log cannot be read.
    """
    return run_log_checks(
        _open(log), virtual=virtual, min_coverage=min_coverage, resume_every=resume_every
    )


def certify(
    log: AnyLog,
    *,
    min_coverage: float = MIN_COVERAGE,
    own_laws: bool = False,
    twins: int = TWINS,
) -> Certificate:
    """Judges a run: stable, not stable or open, and why; the command is `trilat certify`.

    >>> print(tn.certify(tn.simulate("free")).stability)
    stable

    Args:
        log: the log, or its path.
        min_coverage: least share of each site's ticks that must be judged for a stable run.
        own_laws: code of imported laws may be executed, for the energies that they declare and
            for twins.
        twins: number of twins of the run with a small push.

    Raises:
        LogError: the log cannot be read.
    """
    from .theory.linear_analysis import certify_run

    return certify_run(_open(log), min_coverage=min_coverage, own_laws=own_laws, twins=twins)


def metrics(log: AnyLog) -> LogMetrics:
    """Measures a run: tracking, effort, energies, force sharing, network.

    The command is `trilat metrics`.

    >>> found = tn.metrics(tn.simulate("two_sites", duration_s=0.1))
    >>> found.sites["m"]["rms_error_rad"].value > 0.0
    True

    Raises:
        LogError: the log cannot be read.
    """
    return compute_log_metrics(_open(log))


def report(
    log: AnyLog, out: str | Path | None = None, *, force: bool = False, png: bool = False
) -> "Conclusion":
    """Writes the page and the summary of a log in a file; the command is `trilat report`.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("run.mcap")
    >>> tn.report(path, "report").passed
    True

    Args:
        log: the log's path, or a log that was opened from a file.
        out: the folder; by default the file's name without .mcap.
        force: use a folder that is not empty.
        png: write every figure as a PNG file too.

    Raises:
        UsageError: the folder is not empty, or the log is not in a file.
    """
    from .reporting.conclude import conclude

    opened = _open(log)
    first = Path(opened.sources[0])
    if not first.is_file():
        raise UsageError(
            "a report needs a log in a file: save it first, as in log.save('run.mcap')"
        )
    folder = first.with_suffix("") if out is None else Path(out)
    return conclude(opened, make_results_folder(folder, "", force=force), png=png)


def linear(
    scenario: AnyScenario,
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    pose: Sequence[float] | None = None,
    roots: int = 6,
    over: Sequence[str] = (),
    ports: bool = True,
    operators: Sequence[str | Path] = (),
) -> "LinearAnalysis":
    """Linearises the loop about its equilibrium: roots, margins, ports.

    The command is `trilat linear`.

    >>> tn.linear("p_d_margin", {"control.d": 0.9}, ports=False).verdict
    'unstable'

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        set: overrides, as in `{"control.d": 0.9}`.
        pose: joint angles of all sites, rad; by default those at the end of a run.
        roots: number of roots.
        over: ranges of keys in which edges of stability are searched, as in
            `["control.d=0.1:3"]`.
        ports: analyse passivity and the impedances that operators feel.
        operators: files of measured operators, from `trilat identify hand --json`.

    Raises:
        ScenarioError: the scenario is not valid, or has no linear loop.
        UsageError: another argument is not valid.
    """
    from .studies.hand_impedance import read_hands
    from .theory.linear_analysis import analyse_linear_loop

    try:
        angles = None if pose is None else tuple(map(float, pose))
    except (TypeError, ValueError):
        raise UsageError(
            f"a pose consists of angles in rad, as in (0.1, 0.3), not {pose!r}"
        ) from None
    return analyse_linear_loop(
        load_scenario(scenario, set),
        pose=angles,
        roots=roots,
        over=over,
        ports=ports,
        hands=read_hands(operators),
    )


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
    out: str | Path | None = None,
    jobs: int | None = None,
    on: "Workers" = None,
) -> "SweepResults":
    """Runs a scenario over a grid of its keys and classifies stability.

    The command is `trilat sweep`.

    >>> axes = {"control.d": [0.3, 3.0]}
    >>> found = tn.sweep("p_d_margin", axes, duration_s=2, out="grid", jobs=1)
    >>> len(found.rows)
    2

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        over: the axes, as in `{"link.delay_ms": range(0, 1601, 50)}`: lists or arrays of values
            by key; or as texts, `["link.delay_ms=0:1600:50"]`.
        set: overrides of all cells, as in `{"control.Kd": 5}`.
        seeds: number of seeds, or the seeds.
        laws: names or classes of laws to sweep as well.
        duration_s: first duration of a cell's run, s.
        longest_s: longest duration of an undecided cell's run, s; by default eight times
            `duration_s`, or `duration_s` if twins judge.
        judge: "twins" measures the growth exponent of each cell in addition to its verdict.
        metrics: keys of docs/metrics.md that are measured of each run; they become columns of
            the rows.
        out: folder of the results; a sweep in it is continued. By default the next free
            runs/sweep-NAME-N.
        jobs: number of processes; None: one per core.
        on: runs the cells instead of processes: a Dask scheduler's address, or an executor.

    Raises:
        ScenarioError: the scenario, an axis or one of its values is not valid.
        UsageError: the folder contains something else.
    """
    from .studies.sweep import plan_sweep, prepare_sweep_folder, run_sweep

    plan = plan_sweep(
        scenario,
        _list_override_texts(set, duration_s),
        over=over,
        seeds=seeds,
        laws=laws,
        longest_s=longest_s,
        judge=judge,
        metrics=metrics,
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
    """Searches the edge of stability along a key; the command is `trilat sweep --margin`.

    >>> found = tn.margin("p_d_margin", "control.d=0.2:3", tolerance=0.2, duration_s=4, jobs=1)
    >>> [search.margin.spans[0].stable_below for search in found.found]
    [False]

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        along: the key and its range, as in "control.d=0.2:3".
        over: axes of a grid at whose points the edge is searched, as in `sweep`:
            `{"link.delay_ms": [100, 200]}`.
        set: overrides of all runs.
        tolerance: largest width of an edge, relative to its value.
        seeds: number of seeds, or the seeds.
        laws: names or classes of laws to search as well.
        duration_s: first duration of a run, s.
        jobs: number of processes; None: one per core.
        on: runs the cells instead of processes: a Dask scheduler's address, or an executor.

    Raises:
        ScenarioError: the scenario or one of the values is not valid.
        UsageError: the range is not of the form KEY=LOW:HIGH.
    """
    from .studies.sweep import plan_sweep
    from .studies.sweep.margin_search import (
        SweepMargins,
        format_range_axis,
        parse_search_range,
        search_margins,
    )
    from .studies.sweep.sweep_plan import list_axes

    search_range = parse_search_range(along, tolerance)
    axes = [*list_axes(over), format_range_axis(search_range)]
    overrides = _list_override_texts(set, duration_s)
    plan = plan_sweep(scenario, overrides, over=axes, seeds=seeds, laws=laws)
    edges = search_margins(plan, search_range, jobs, on=on)
    return SweepMargins(plan, search_range, edges)


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
    """Compares control laws that one procedure tunes; the command is `trilat compare --tune`.

    >>> found = tn.tune("free", ["p_d"], budget=2, duration_s=2, jobs=1)
    >>> [law.space.law for law in found.found]
    ['p_d']

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        laws: names or classes of the laws; empty: all laws for any number of sites.
        set: overrides, as in `{"link.delay_ms": 100}`.
        budget: number of candidates per law.
        seed: the seed of the search.
        seeds: number of seeds of the scenario over which each candidate is averaged.
        objective: "error" or "settling", in addition to effort.
        gravity_percent: gravity that all laws assume, in % of the true gravity.
        duration_s: duration of a run, s.
        jobs: number of processes; None: one per core.
        on: runs the candidates instead of processes: a Dask scheduler's address, or an
            executor.

    Raises:
        ScenarioError: the scenario is not valid, or laws cannot be compared in it.
        UsageError: another argument is not valid.
    """
    from .studies.tuning import plan_tuning

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
    """Runs the benchmark suite of control laws.

    The command is `trilat bench`, which writes tables and figures as well.

    >>> cell = {"tasks": ["free"], "laws": ["p_d"], "links": ["rtt68"]}
    >>> found = tn.bench(**cell, seeds=1, out="suite", jobs=1)
    >>> len(found.runs)
    1

    Args:
        study: full, small or round-trips.
        tasks: only these tasks; empty: all.
        laws: only these laws; empty: all.
        links: other links, as in "rtt68-loss10" or "4g".
        seeds: number of seeds; by default the study's.
        confirm: run unstable cells again for 100 s, which refutes or confirms the verdict.
        out: folder; a suite in it is continued. By default runs/bench-STUDY.
        jobs: number of processes; None: one per core.
        on: runs the cells instead of processes: a Dask scheduler's address, or an executor.

    Raises:
        UsageError: there is no such study, task, law or link, or the folder contains something
            else.
    """
    from .studies.bench import plan_bench, prepare_bench_folder, run_bench

    plan = plan_bench(study, tasks=tasks, laws=laws, links=links, seeds=seeds)
    folder = prepare_bench_folder(plan, None if out is None else Path(out))
    return run_bench(folder, jobs, on, confirm=confirm)


def view(*files: str | Path, full: bool = False, save: str | Path | None = None) -> None:
    """Opens a log in Rerun, until it is closed; the command is `trilat log view`.

    >>> tn.view("run.mcap")  # doctest: +SKIP

    Args:
        files: the log, or its parts.
        full: show every record instead of the decimated channels.
        save: path of a file for Rerun to write instead of opening the viewer.

    Raises:
        UsageError: Rerun is not installed, or there is no display.
        LogError: the log cannot be read.
    """
    from .reporting.rerun_viewer import ViewerOptions, open_rerun

    paths = [Path(file) for file in files]
    viewer_options = ViewerOptions(
        full=full, web=False, save=None if save is None else Path(save)
    )
    open_rerun(paths, lambda: open_log(*paths), viewer_options, print)

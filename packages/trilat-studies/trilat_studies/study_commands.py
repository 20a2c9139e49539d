"""The commands `trilat test`, `compare`, `tune` and `bench`, which study several runs.

These commands run a scenario many times with different seeds, control laws, gains or delays, or
read logs of earlier runs, and then print the results side by side.

Invariant:
    - The commands print measured values. They do not rank control laws, because it depends on
      the task which quantity matters.
    - An interrupted benchmark continues when the same command is entered again.
"""

import os
import platform
import re
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilat_net.app import options, value
from trilat_net.errors import UsageError, count_nouns, format_wall_time
from trilat_net.net import SystemClock
from trilat_net.presentation import terminal_output as terminal

if TYPE_CHECKING:
    from trilat_net.app import SessionResult
    from trilat_net.scenario import Scenario

    from .bench import BenchResults
    from .bench.bench_run import BenchFolder
    from .trials import Trial, TrialReport, TrialResult
    from .tuning import TuningPlan


MAX_SEEDS = 100_000
"""Largest number of seeds in the option --seeds."""


@options.command("jitter --seeds 1..20 --junit out.xml", page="docs/studies/seeds.md")
def test_command(
    scenarios: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO]...",
            help="Names or paths of scenarios; default: all shipped scenarios with a section "
            "\\[expect].",
            autocompletion=options.complete_scenarios,
        ),
    ] = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live/--virtual",
            help="Run the scenarios live over a network, one after another, instead of in "
            "virtual time.",
        ),
    ] = False,
    seeds: Annotated[
        str | None,
        value(
            "--seeds",
            "LIST",
            "Seeds, for example 1..20 or 1,5,9; default: the seed of the scenario.",
        ),
    ] = None,
    junit: Annotated[
        Path | None, value("--junit", "FILE", "Write the results as JUnit XML as well.")
    ] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    overrides: options.SetOption = None,
    as_json: options.JsonOption = False,
) -> None:
    r"""Checks scenarios against their own expectations.

    Each scenario is run, the expectations in its section \[expect] are checked, and margins are
    printed. A margin is the distance of a measured value from its expected bound. For each
    failure, the command that repeats the run is printed.
    """
    from trilat_net.files import write_whole
    from trilat_net.work import WorkerPool

    if live and on is not None:
        raise UsageError(
            "--on distributes runs in virtual time and cannot be combined with --live: leave "
            "out one of the two"
        )
    WorkerPool.check_options(jobs, on)
    if junit is not None and (junit.is_dir() or not os.access(junit.parent, os.W_OK)):
        raise UsageError(f"{junit} cannot be written")
    trials = _list_trials(scenarios or [], parse_seeds(seeds), overrides or [], live=live)
    began_unix_ns = SystemClock().unix_ns()
    with terminal.lines_aside(as_json):
        report = _run_live(trials) if live else _run_virtual(trials, jobs, on)
    terminal.print_result(report, as_json=as_json)
    if junit is not None:
        write_whole(junit, report.encode_junit_xml(began_unix_ns, platform.node()))
    if not report.held:
        raise typer.Exit(1)


def parse_seeds(text: str | None) -> list[int]:
    """Parses a list of random seeds, written as 1..20 or 1,5,9 or 1..3,8.

    Args:
        text: The argument of the option, or `None` if the user gave no seeds.

    Returns:
        The seeds. Empty if the user gave none.

    Raises:
        UsageError: The text does not have this form, or names more than `MAX_SEEDS` seeds.
    """
    if text is None:
        return []
    wrong_form = f"--seeds must be a range or a list, as in 1..20 or 1,5,9, not {text!r}"
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,18})(?:\.\.([0-9]{1,18}))?\s*", part)
        if match is None:
            raise UsageError(wrong_form)

        first = int(match[1])
        last = int(match[2] or match[1])
        if last < first:
            raise UsageError(wrong_form)

        if len(seeds) + last - first >= MAX_SEEDS:
            raise UsageError(
                f"--seeds {text} names more than {MAX_SEEDS} seeds; at most {MAX_SEEDS} are "
                "allowed"
            )
        seeds += range(first, last + 1)
    return seeds


def _list_trials(
    sources: list[str], seeds: list[int], overrides: list[str], *, live: bool
) -> "list[Trial]":
    """Lists the trials of a test: each scenario with each seed.

    Args:
        sources: Names or paths of the scenarios. If empty, all shipped scenarios with
            expectations.
        seeds: The seeds. If empty, each scenario's own seed is used.
        overrides: Overrides that apply to all scenarios.
        live: True if the trials run live over a network.
    """
    from trilat_net.scenario import list_shipped, load_scenario

    from .trials import trials

    if not sources:
        sources = [
            name for name in list_shipped() if load_scenario(name).expect.has_expectations
        ]
    all_trials = []
    for source in dict.fromkeys(sources):  # without repetitions
        all_trials += trials(source, seeds, overrides, live=live)
    return all_trials


def _run_virtual(trials: "list[Trial]", jobs: int | None, on: str | None) -> "TrialReport":
    """Runs trials in virtual time and shows their progress.

    In a terminal, progress is shown as a bar. Otherwise one line is printed per scenario when
    all of its trials have ended.

    Args:
        trials: The trials.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the trials instead.
    """
    from .trials import run_trials

    remaining = Counter(trial.source for trial in trials)
    with terminal.progress_bar("running the trials") as show:

        def report_done(result: "TrialResult") -> None:
            """Updates the progress display after one run of a scenario has finished.

            Without a terminal, one line is printed per scenario, when all of its runs have
            finished.

            Args:
                result: Result of the finished run.
            """
            source = result.trial.source
            remaining[source] -= 1
            done = len(trials) - remaining.total()
            show(done, len(trials))
            is_last_of_source = not remaining[source]
            if is_last_of_source and not terminal.out.is_terminal:
                terminal.print_text(f"{source}: ran")

        return run_trials(trials, jobs, report_done, on)


def _run_live(trials: "list[Trial]") -> "TrialReport":
    """Runs trials live, one after the other, and evaluates their logs.

    Live sessions share the processors and ports of the machine, so they cannot run side by
    side.

    Args:
        trials: The trials, each a scenario with a seed.

    Returns:
        The report, with the time that each trial took.
    """
    from .trials import TrialReport

    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    results = []
    for trial in trials:
        began_ns = clock.monotonic_ns()
        outcome = _run_in_own_folder(trial.scenario, str(trial), f"test-{trial}")
        wall_s = (clock.monotonic_ns() - began_ns) * 1e-9
        results.append(trial.evaluate_live_log(outcome.log, outcome.problems, wall_s))
    return TrialReport(results, (clock.monotonic_ns() - start_ns) * 1e-9)


def _run_in_own_folder(scenario: "Scenario", label: str, folder_name: str) -> "SessionResult":
    """Runs a scenario live and stores its results in a new folder.

    A separate folder per scenario keeps results from overwriting each other.

    Args:
        scenario: The scenario.
        label: Name of the run in the printed line.
        folder_name: Name of the folder, to which a number is appended.

    Raises:
        typer.Exit: The session was interrupted.
    """
    from trilat_net.app import run_demo
    from trilat_net.files import make_results_folder

    folder = make_results_folder(None, folder_name, force=False)
    terminal.print_text(f"{label}: {scenario.duration_s:g} s live, into {folder}")
    outcome = run_demo(scenario, folder, terminal.out)
    if outcome.interrupted:
        terminal.err.print("interrupted")
        raise typer.Exit(128 + outcome.interrupted)
    return outcome


def _run_tuning(
    plan: "TuningPlan",
    folder: Path | None,
    jobs: int | None,
    on: str | None,
    *,
    force: bool,
    as_json: bool,
) -> None:
    """Tunes control laws, prints the comparison, and writes its files.

    Args:
        plan: The laws and the procedure.
        folder: Folder for the results. If `None`, the next free folder is used.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the runs instead.
        force: True to replace existing files.
        as_json: True to print the result as JSON.
    """
    from trilat_net.files import make_results_folder
    from trilat_net.work import WorkerPool

    from .tuning.tuning_report import TuningReport, describe_procedure

    workers = WorkerPool.count_workers(jobs, on)
    name = plan.base.scenario.name
    results_folder = make_results_folder(folder, f"tune-{name}", force=force)
    if not as_json:
        laws = ", ".join(space.law for space in plan.spaces)
        terminal.print_text(f"{name}, laws {laws}; the same for all:")
        terminal.print_texts(f"  {line}" for line in describe_procedure(plan))
        cores = count_nouns(workers, "core")
        duration = format_wall_time(plan.estimate_s(workers))
        terminal.print_text(
            f"{count_nouns(plan.runs, 'run')} on {cores}: about {duration} at the present "
            "speed of this machine"
        )

    with terminal.progress_bar("searching") as progress:
        comparison = plan.run(jobs, progress, on)
    paths = TuningReport(comparison).write(results_folder)
    if not as_json:
        terminal.out.print()
    terminal.print_result(comparison, as_json=as_json)
    terminal.print_paths([] if as_json else paths)


_option = partial(value, rich_help_panel="Tune laws")


@options.command(
    "a.mcap b.mcap",
    "--tune free --law adaptive,p_d",
    page="docs/reference/metrics.md, docs/studies/fair-comparison.md",
)
def compare_command(
    context: typer.Context,
    files: Annotated[list[Path] | None, typer.Argument(metavar="FILE FILE...")] = None,
    tune: Annotated[str | None, _option("--tune", "SCENARIO")] = None,
    law: Annotated[
        str | None,
        _option(
            "--law",
            "LAW,LAW...",
            "Control laws; default: adaptive,adaptive_box,p_d,pd_d. All laws: "
            f"{', '.join(options.list_laws())}, known (adaptive with a known arm), and your "
            "own, for example mylaws:Law.",
        ),
    ] = None,
    budget: Annotated[int, _option("--budget", "N")] = 64,
    seed: Annotated[int, _option("--seed", "S", "Seed of the search.")] = 1,
    seeds: Annotated[int, _option("--seeds", "N")] = 1,
    objective: Annotated[str, _option("--objective", "error|settling")] = "error",
    gravity: Annotated[float, _option("--gravity", "PERCENT")] = 100.0,
    duration: options.DurationOption = None,
    overrides: options.SetOption = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    output: Annotated[Path | None, _option("--out -o", "DIR")] = None,
    force: options.ForceOption = False,
    everything: options.AllOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Compares logs, or tuned control laws, side by side.

    For logs, the command shows the settings that differ, the verdicts, and the ten metrics that
    differ most; with --all it shows every metric. With --tune, all control laws are tuned by
    the same procedure. Whether a tuned law is stable is judged from the motion in the second
    half of its runs alone; `trilat certify` also uses twins and roots. The results are not
    ranked, because small errors can also mean that an arm hangs freely, or that no operator
    moves it.

    Options:
        files: Files of two or more MCAP logs.
        tune: Tune control laws in this scenario and compare them, instead of logs.
        budget: Number of settings (candidates) that are tried for each control law.
        seeds: Number of seeds of the scenario over which each candidate is averaged.
        objective: Objective that is minimised together with effort.
        gravity: Gravity that all laws assume, in % of the true gravity.
        output: Folder for the results; default: the next free runs/tune-NAME-N.
    """
    if tune is None:
        for name in options.list_used_options(context):
            if name not in ("files", "--all", "--json"):
                raise UsageError(
                    f"{name} can be used only with --tune SCENARIO; logs are compared as they "
                    "were recorded"
                )
        from .log_comparison import compare

        logs = [terminal.open_with_progress(file) for file in files or []]
        with terminal.progress_lines(f"comparing {count_nouns(len(logs), 'log')}"):
            comparison = compare(*logs)
        terminal.print_result(comparison, as_json=as_json, brief=not everything)
        return
    if files:
        raise UsageError("--tune makes its own runs: leave out either the logs or --tune")
    if everything:
        raise UsageError("--all prints every metric of logs: leave it out with --tune")
    from .tuning import plan_tuning

    plan = plan_tuning(
        tune,
        options.list_overrides(overrides, duration),
        laws=options.split_names(law),
        budget=budget,
        seed=seed,
        objective=objective,
        gravity_percent=gravity,
        seeds=seeds,
    )
    _run_tuning(plan, output, jobs, on, force=force, as_json=as_json)


@options.command(
    "--arm arm6.urdf --delay 40ms --figure gains.png",
    "--arm my.urdf --delay measured:run.mcap",
    page="docs/extend/arm-gains.md",
)
def tune_command(
    arm: Annotated[
        Path, value("--arm", "URDF", "URDF file of the arm, or name of a shipped URDF.")
    ],
    delay: Annotated[str, value("--delay", "40ms|measured:SESSION|CSV")],
    law: Annotated[
        str, value("--law", "LAW", "Control law: p_d, pd_d or saturated_pd.")
    ] = "p_d",
    tip: Annotated[
        str,
        value(
            "--tip", "LINK", "End link of the arm; default: the only link that has no child."
        ),
    ] = "",
    sites: Annotated[
        int, value("--sites", "2|3", "Number of arms that follow one another.")
    ] = 2,
    rate: Annotated[
        int, value("--rate", "HZ", "Rate of the control loops (tick rate), Hz.")
    ] = 1000,
    margin: Annotated[
        float,
        value(
            "--margin", "FACTOR", "Factor by which the gain K stays below the stability limit."
        ),
    ] = 2.0,
    damping: Annotated[float, value("--damping", "RATIO", "Damping ratio of an arm.")] = 0.7,
    quantile: Annotated[float, value("--quantile", "SHARE")] = 1.0,
    overrides: options.SetOption = None,
    *,
    reach: options.Reach,
    picture: Annotated[Path | None, value("--figure", "FILE", options.FIGURE_HELP)] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Finds the largest gains for an arm on links with a delay.

    The gains keep a margin to the stability limit, and are tested in simulation. Two or three
    such arms follow one another over links with that delay in both directions
    (docs/extend/arm-gains.md). Paste the last line of the output into a scenario. Exit code 0:
    all simulated runs behave as the linear loop predicts. 1: at least one run does not.

    Options:
        delay: One-way delay of the links, for example 40ms. The delays can also come from a
            running session (measured:SESSION), a log (measured:FILE), or a table with the
            columns t_s,delay_ms.
        quantile: Quantile of varying delays that is used as the constant delay; 1 is the
            largest delay.
    """
    options.check_picture(picture, force=force)
    from .arm_gains import tune_arm

    delay_text = _measure_delay(delay, reach)
    with terminal.progress_bar("computing the edge of stability and running") as show:
        gains = tune_arm(
            arm,
            delay_text,
            law,
            set=overrides or (),
            tip=tip,
            sites=sites,
            rate_hz=rate,
            margin=margin,
            damping=damping,
            quantile=quantile,
            curve=picture is not None,
            progress=show,
        )
    figure = "linear_figures:draw_arm_gains"
    options.print_and_draw(gains, picture, figure, gains.to_dict(), as_json=as_json)
    if not gains.agree:
        raise typer.Exit(1)


def _measure_delay(text: str, reach: options.Reach) -> str:
    """Converts a delay to the form that `tune_arm` accepts, measuring that of a live session.

    The delay of a session is that of its slowest link. If the session measures no link, half of
    the longest round trip from this machine is used. Both are 99th percentiles.

    Args:
        text: A delay such as "40ms", a file, or "measured:SESSION".
        reach: Options that specify how to connect to the session.
    """
    name = text.removeprefix("measured:")
    names_session = name != text and not name.endswith(".mcap")
    if not names_session:
        return text

    measurement = reach.open_session(name, operates=False).ping()
    one_way_us = [
        0.5 * member["rtt_us"]["p99"] for member in measurement.members if member["answers"]
    ]

    # Half a round trip is used as the delay only if no delays of links were reported.
    delays_us = [max(link["delay_us"], link["delay_max_us"]) for link in measurement.links]
    if delays_us:
        return f"{max(delays_us):.0f}us"
    longest_us = max(one_way_us, default=0.0)
    return f"{longest_us:.0f}us"


def _tune_bench(laws: list[str], study: str, jobs: int | None, on: str | None) -> None:
    """Tunes the control laws of a benchmark study and stores their gains.

    The gains of each law are stored as soon as they are tuned, in the gains file of the
    program. Gains that are up to date are kept, so the same command continues an interrupted
    tuning.

    Args:
        laws: Names of the laws. If empty, all laws of the study.
        study: Name of the study.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the runs instead.

    Raises:
        UsageError: A law is not part of the study.
    """
    from .bench.bench_plan import GAINS_FILE, STUDIES, read_gains, tune_laws, write_gains

    laws_by_form = STUDIES[study].laws
    all_laws = {law for form_laws in laws_by_form.values() for law in form_laws}
    unknown = [law for law in laws if law not in all_laws]
    if unknown:
        raise UsageError(f"--law: {unknown[0]} is not a law of the study {study}")

    selected_by_form = {}
    for form, form_laws in laws_by_form.items():
        selected_laws = [law for law in form_laws if law in laws or not laws]
        if selected_laws:
            selected_by_form[form] = selected_laws

    with terminal.show_progress("tuning", terminal.print_note) as progress:
        tune_laws(
            selected_by_form,
            jobs,
            on,
            progress,
            known=read_gains().values(),
            store=lambda gains: write_gains([gains]),
        )
    terminal.print_paths([GAINS_FILE])


def _run_bench(
    folder: "BenchFolder", jobs: int | None, on: str | None, *, confirm: bool
) -> "BenchResults":
    """Runs the benchmark in its folder. On Ctrl-C, prints how to continue.

    Args:
        folder: Folder of the benchmark.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the runs instead.
        confirm: Accepted for older commands, see `run_bench`.
    """
    from .bench import run_bench

    try:
        with terminal.show_progress("running", terminal.print_note) as progress:
            return run_bench(folder, jobs, on, progress, confirm=confirm)
    except KeyboardInterrupt:
        terminal.print_note(
            f"finished runs are kept in {folder.path}; the same command continues"
        )
        raise


@options.command(
    "--small", "--study round-trips --law wave,smith", page="docs/studies/bench.md"
)
def bench_command(
    study: Annotated[
        str, value("--study", "full|small|round-trips", "Part of the suite to run.")
    ] = "full",
    small: Annotated[
        bool, typer.Option("--small", help="Same as --study small, which takes a few minutes.")
    ] = False,
    task: Annotated[
        str | None, value("--task", "TASK,TASK...", "Run only these tasks; default: all.")
    ] = None,
    law: Annotated[
        str | None, value("--law", "LAW,LAW...", "Run only these control laws; default: all.")
    ] = None,
    link: Annotated[str | None, value("--link", "LINK,LINK...")] = None,
    seeds: Annotated[
        int | None,
        value("--seeds", "N", "Number of seeds; default: the number of the study."),
    ] = None,
    cell: Annotated[str | None, value("--cell", "TASK/LAW/LINK")] = None,
    tune: Annotated[bool, typer.Option("--tune", rich_help_panel="Gains")] = False,
    confirm: Annotated[bool, typer.Option("--confirm")] = False,
    output: Annotated[Path | None, value("--out -o", "DIR")] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Compares control laws on the same tasks and links.

    The tables show stability, energy, errors, effort and stiffness. The gains of all laws were
    tuned by the same procedure. Finished runs are kept; use the same command again to continue
    an interrupted suite.

    Options:
        link: Use these links instead of the links of the study, for example rtt68-loss10,4g.
        cell: Only print the commands that write the logs of this cell of the tables.
        tune: Tune the laws whose gains are out of date, and store their gains with the suite;
            the same command continues an interrupted tuning.
        confirm: Has no effect any more: every run that is not stable is repeated over twice
            its length, to confirm or refute the verdict.
        output: Folder for the results; a suite that the folder already contains is continued.
            Default: runs/bench-STUDY.
    """
    from trilat_net.work import WorkerPool

    from .bench import plan_bench, prepare_bench_folder
    from .bench.bench_figures import write_bench
    from .run_commands import format_command

    WorkerPool.check_options(jobs, on)
    chosen_study = "small" if small else study
    laws = options.split_names(law)
    if tune:
        _tune_bench(laws, chosen_study, jobs, on)
        return
    plan = plan_bench(
        chosen_study,
        tasks=options.split_names(task),
        laws=laws,
        links=options.split_names(link),
        seeds=seeds,
    )

    if cell is not None:
        bench_cell = plan.cell(cell)
        for seed in bench_cell.seeds:
            log = f"{cell.replace('/', '-')}-{seed}.mcap"
            terminal.print_line(f"{bench_cell.build(seed).command} -o {log}")
        return

    tuned_gains = {str(planned.tuned): planned.tuned for planned in plan.cells}
    stale = [str(gains) for gains in tuned_gains.values() if gains.is_stale]
    if stale:
        terminal.print_note(
            f"tuned for another version of the law or the task, see --tune: {', '.join(stale)}"
        )

    folder = prepare_bench_folder(plan, output)
    cells = count_nouns(len(plan.cells), "cell")
    runs = count_nouns(plan.runs, "run")
    terminal.print_note(f"{cells}, {runs}, into {folder.path}")
    results = _run_bench(folder, jobs, on, confirm=confirm)

    # The command that repeats this benchmark, for its page.
    arguments = ["--study", chosen_study]
    filters = {"--task": task, "--law": law, "--link": link, "--seeds": seeds}
    for name, filter_value in filters.items():
        if filter_value is not None:
            arguments += [name, str(filter_value)]
    if confirm:
        arguments.append("--confirm")
    paths = write_bench(results, folder.path, format_command("bench", *arguments))
    terminal.print_result(results, as_json=as_json)
    terminal.print_paths([] if as_json else paths)

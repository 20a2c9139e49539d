"""Studies of some runs: scenarios with what they [expect], logs side by side, laws, experiments
with people.

Invariant: numbers are printed and nothing is ranked. A suite that is interrupted goes on by the
same command.
"""

import os
import platform
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import UsageError, count_nouns
from ..net.clock import SystemClock
from ..reporting import terminal_output as terminal
from . import options
from .options import flag, value

if TYPE_CHECKING:
    from sites.demo_session import SessionResult

    from ..scenario import Scenario
    from ..studies.bench import BenchResults
    from ..studies.bench.bench_run import BenchFolder
    from ..studies.trials import Trial, TrialReport, TrialResult
    from ..studies.tuning import TuningPlan


MAX_SEEDS = 100_000


@options.command("jitter --seeds 1..20 --junit out.xml")
def test_command(
    scenarios: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO]...",
            help="Names or paths; default: all shipped scenarios with \\[expect].",
            autocompletion=options.complete_scenarios,
        ),
    ] = None,
    live: Annotated[
        bool,
        flag(
            "--live/--virtual",
            "Run live over a network, one after the other, or in virtual time.",
        ),
    ] = False,
    seeds: Annotated[
        str | None,
        value("--seeds", "LIST", "Seeds, as in 1..20 or 1,5,9; default: the scenario's."),
    ] = None,
    junit: Annotated[
        Path | None, value("--junit", "FILE", "Write the results as JUnit XML as well.")
    ] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    overrides: options.SetOption = None,
    as_json: options.JsonOption = False,
) -> None:
    r"""Runs scenarios and checks their \[expect]: margins, and commands that repeat what
    failed.
    """
    from ..files import write_whole
    from ..studies.executor import check_workers
    from ..studies.trials import encode_junit_xml

    if live and on is not None:
        raise UsageError("--on runs in virtual time: leave it out, or --live")
    check_workers(jobs, on)
    if junit is not None and (junit.is_dir() or not os.access(junit.parent, os.W_OK)):
        raise UsageError(f"{junit}: cannot be written")
    batch = _batch(scenarios or [], parse_seeds(seeds), overrides or [], live=live)
    began_unix_ns = SystemClock().unix_ns()
    with terminal.lines_aside(as_json):
        report = _run_live(batch) if live else _run_virtual(batch, jobs, on)
    terminal.print_result(report, as_json=as_json)
    if junit is not None:
        write_whole(junit, encode_junit_xml(report, began_unix_ns, platform.node()))
    if not report.held:
        raise typer.Exit(1)


def parse_seeds(text: str | None) -> list[int]:
    """Returns the seeds that a text such as 1..20 or 1,5,9 or 1..3,8 names; none for None.

    Raises:
        UsageError: it names none, or too many.
    """
    seeds: list[int] = []
    for part in [] if text is None else text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,18})(?:\.\.([0-9]{1,18}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if last < first:
            raise UsageError(f"--seeds reads 1..20 or 1,5,9, not {text!r}")
        if len(seeds) + last - first >= MAX_SEEDS:
            raise UsageError(f"--seeds {text} are more than {MAX_SEEDS}")
        seeds += range(first, last + 1)
    return seeds


def _batch(
    sources: list[str], seeds: list[int], overrides: list[str], *, live: bool
) -> "list[Trial]":
    """Returns all trials; without sources, of every shipped scenario that expects something."""
    from ..scenario import list_shipped, load_scenario
    from ..studies.trials import trials

    chosen = sources or [
        name for name in list_shipped() if load_scenario(name).expect.has_expectations
    ]
    return [
        trial
        for source in dict.fromkeys(chosen)
        for trial in trials(source, seeds, overrides, live=live)
    ]


def _run_virtual(batch: "list[Trial]", jobs: int | None, on: str | None) -> "TrialReport":
    from ..studies.trials import run_trials

    to_do = Counter(trial.source for trial in batch)
    with terminal.progress_bar("runs") as show:

        def done(result: "TrialResult") -> None:
            source = result.trial.source
            to_do[source] -= 1
            show(len(batch) - to_do.total(), len(batch))
            if not to_do[source] and not terminal.out.is_terminal:
                terminal.print_text(f"{source}: ran")

        return run_trials(batch, jobs, done, on)


def _run_live(batch: "list[Trial]") -> "TrialReport":
    from ..studies.trials import TrialReport, evaluate_live_log

    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    results = []
    for trial in batch:
        began_ns = clock.monotonic_ns()
        outcome = run_apart(trial.scenario, str(trial), f"test-{trial}")
        wall_s = (clock.monotonic_ns() - began_ns) * 1e-9
        results.append(evaluate_live_log(trial, outcome.log, outcome.problems, wall_s))
    return TrialReport(results, (clock.monotonic_ns() - start_ns) * 1e-9)


def run_apart(scenario: "Scenario", label: str, folder_name: str) -> "SessionResult":
    """Runs a scenario live, into a folder of its own; ends the command if that is interrupted."""
    from sites.demo_session import run_demo

    from ..files import make_results_folder

    folder = make_results_folder(None, folder_name, force=False)
    terminal.print_text(f"{label}: {scenario.duration_s:g} s live, into {folder}")
    outcome = run_demo(scenario, folder, terminal.out)
    if outcome.interrupted:
        terminal.err.print("interrupted")
        raise typer.Exit(128 + outcome.interrupted)
    return outcome


_LINES = 10
"""Lines of progress, where no terminal shows a bar."""


@contextmanager
def show_progress(
    label: str, print_line: Callable[[str], None], items: str = "runs"
) -> Iterator[Callable[[int, int], None]]:
    """Yields a function to call with (done, total): it shows a bar, or lines where there is no
    terminal.

    Args:
        label: what a bar is called.
        print_line: prints a line.
        items: what is counted, in the plural.
    """
    if terminal.err.is_interactive:
        with terminal.progress_bar(label) as show:
            yield show
        return
    from ..studies.sweep.sweep_run import format_wall_time

    clock = SystemClock()
    began_ns = -1
    first = 0
    printed = 0

    def line(done: int, total: int) -> None:
        nonlocal began_ns, first, printed
        if began_ns < 0:  # the start of processes takes seconds and is not counted
            began_ns = clock.monotonic_ns()
            first = done
        if done in (total, first) or done * _LINES // total <= printed:
            return
        printed = done * _LINES // total
        left_s = (clock.monotonic_ns() - began_ns) * 1e-9 / (done - first) * (total - done)
        print_line(f"  {done} of {total} {items}, about {format_wall_time(left_s)} left")

    yield line


def _run_tuning(
    asked: "TuningPlan",
    folder: Path | None,
    jobs: int | None,
    on: str | None,
    *,
    force: bool,
    as_json: bool,
) -> None:
    from ..files import make_results_folder
    from ..studies.executor import count_workers
    from ..studies.sweep.sweep_run import format_wall_time
    from ..studies.tuning.tuning_report import describe_procedure, write_tuning

    workers = count_workers(jobs, on)
    chosen = make_results_folder(folder, f"tune-{asked.base.scenario.name}", force=force)
    if not as_json:
        laws = ", ".join(space.law for space in asked.spaces)
        terminal.print_text(f"{asked.base.scenario.name}, laws {laws}; the same for all:")
        terminal.print_texts(f"  {line}" for line in describe_procedure(asked))
        cores = count_nouns(workers, "core")
        duration = format_wall_time(asked.estimate_s(workers))
        terminal.print_text(
            f"{count_nouns(asked.runs, 'run')} on {cores}: about {duration} at the present "
            "speed of this machine"
        )
    with terminal.progress_bar("searching") as progress:
        found = asked.run(jobs, progress, on)
    paths = write_tuning(found, chosen)
    if not as_json:
        terminal.out.print()
    terminal.print_result(found, as_json=as_json)
    terminal.print_paths([] if as_json else paths)


_option = partial(value, rich_help_panel="Tune laws")


@options.command("a.mcap b.mcap", "--tune free --law adaptive,p_d")
def compare_command(
    context: typer.Context,
    files: Annotated[list[Path] | None, typer.Argument(metavar="FILE FILE...")] = None,
    tune: Annotated[str | None, _option("--tune", "SCENARIO")] = None,
    law: Annotated[str | None, _option("--law", "LAW,LAW...")] = None,
    budget: Annotated[int, _option("--budget", "N", "Candidates per law.")] = 64,
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
    as_json: options.JsonOption = False,
) -> None:
    """Compares logs and the differences of their experiments; or control laws, all tuned by one
    procedure.

    Ranks nothing: arms that hang, or that no operator moves, also have small errors.

    Options:
        files: Two or more MCAP logs.
        tune: Compare tuned control laws in this scenario instead.
        law: Control laws; default: adaptive,adaptive_box,p_d,pd_d. Others: adaptive_robust,
            known, p_f, wave, tdpa, tanks, four_channel, six_channel, saturated_pd, authority,
            impedance, smith, and your own, as in mylaws:Law.
        seeds: Seeds of the scenario that each candidate is the mean of.
        objective: The objective besides effort.
        gravity: Gravity that all laws assume, in % of the truth.
        output: Folder of the results; default: the next free runs/tune-...
    """
    if tune is None:
        for name in options.given_options(context):
            if name not in ("files", "--json"):
                raise UsageError(
                    f"{name} belongs to --tune SCENARIO; logs are compared as they are"
                )
        from ..studies.log_comparison import compare

        logs = [terminal.open_with_progress(file) for file in files or []]
        terminal.print_result(compare(*logs), as_json=as_json)
        return
    if files:
        raise UsageError("--tune makes its own runs: leave the logs out, or --tune")
    from ..studies.tuning import plan_tuning

    asked = plan_tuning(
        tune,
        options.list_overrides(overrides, duration),
        laws=options.split_names(law),
        budget=budget,
        seed=seed,
        objective=objective,
        gravity_percent=gravity,
        seeds=seeds,
    )
    _run_tuning(asked, output, jobs, on, force=force, as_json=as_json)


@options.command(
    "--arm arm6.urdf --delay 40ms --figure gains.png", "--arm my.urdf --delay measured:run.mcap"
)
def tune_command(
    arm: Annotated[Path, value("--arm", "URDF", "The arm: a file, or a shipped one.")],
    delay: Annotated[str, value("--delay", "40ms|measured:SESSION|CSV")],
    law: Annotated[str, value("--law", "LAW", "p_d, pd_d or saturated_pd.")] = "p_d",
    tip: Annotated[
        str, value("--tip", "LINK", "End link; default: the only one without a child.")
    ] = "",
    sites: Annotated[
        int, value("--sites", "2|3", "How many such arms follow one another.")
    ] = 2,
    rate: Annotated[int, value("--rate", "HZ", "Tick rate.")] = 1000,
    margin: Annotated[
        float, value("--margin", "FACTOR", "By how much K is below the edge.")
    ] = 2.0,
    damping: Annotated[float, value("--damping", "RATIO", "Damping ratio of an arm.")] = 0.7,
    quantile: Annotated[float, value("--quantile", "SHARE")] = 1.0,
    overrides: options.SetOption = None,
    *,
    reach: options.Reach,
    picture: Annotated[
        Path | None, value("--figure", "FILE", "Draw a figure: .png, .svg or .pdf.")
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Finds the largest gains that an arm bears over a delay, with a margin, and confirms them
    by runs.

    Such arms follow one another over links of that delay both ways (docs/arms.md). The last
    line is one to paste into a scenario. Exit code 0: all runs do as the linear loop predicts.
    1: one does not.

    Options:
        delay: One way; the delays of a log, of a running session, or of a table t_s,delay_ms.
        quantile: Of delays that vary, the one that a constant delay stands for; 1: the largest.
    """
    options.check_picture(picture, force=force)
    from ..studies.arm_gains import tune_arm

    loop: dict[str, Any] = {"set": overrides or (), "tip": tip, "sites": sites, "rate_hz": rate}
    wanted: dict[str, Any] = {"margin": margin, "damping": damping, "quantile": quantile}
    there = _measure_delay(delay, reach)
    with terminal.progress_bar("edge and runs") as show:
        found = tune_arm(
            arm, there, law, **loop, **wanted, curve=picture is not None, progress=show
        )
    options.print_drawn(
        found, picture, "linear_figures:draw_arm_gains", found.to_dict(), as_json=as_json
    )
    if not found.agree:
        raise typer.Exit(1)


def _measure_delay(text: str, reach: options.Reach) -> str:
    """Returns a delay; of a running session that of its slowest link, or half of its longest
    round trip.
    """
    name = text.removeprefix("measured:")
    if name == text or name.endswith(".mcap"):
        return text
    from sites.session_ping import ping_session

    there = reach.resolve(operates=False), SystemClock(), options.check_session_name(name)
    found = ping_session(*there, 50, 3.0, lambda: False)
    assert found is not None  # nothing stops it
    trips_us = [0.5 * one["rtt_us"]["p99"] for one in found.members if one["answers"]]
    delays_us = [max(link["delay_us"], link["delay_max_us"]) for link in found.links]
    return f"{max(delays_us or trips_us or [0.0]):.0f}us"


def _tune(laws: list[str], study: str, jobs: int | None, on: str | None) -> None:
    from ..studies.bench.bench_plan import GAINS_FILE, STUDIES, tune_laws, write_gains

    asked = STUDIES[study].laws
    unknown = [
        law for law in laws if law not in {law for known in asked.values() for law in known}
    ]
    if unknown:
        raise UsageError(f"--law: {unknown[0]} is none of the study {study}")
    wanted = {
        form: [law for law in known if law in laws or not laws] for form, known in asked.items()
    }
    with show_progress("tuning", terminal.print_note) as progress:
        found = tune_laws(
            {form: kept for form, kept in wanted.items() if kept}, jobs, on, progress
        )
    write_gains(found)
    terminal.print_paths([GAINS_FILE])


def _run(
    folder: "BenchFolder", jobs: int | None, on: str | None, *, confirm: bool
) -> "BenchResults":
    from ..studies.bench import run_bench

    try:
        with show_progress("running", terminal.print_note) as progress:
            return run_bench(folder, jobs, on, progress, confirm=confirm)
    except KeyboardInterrupt:
        terminal.print_note(f"what is done is kept in {folder.path}; the same command goes on")
        raise


@options.command("--small", "--study round-trips --law wave,smith")
def bench_command(
    study: Annotated[
        str, value("--study", "full|small|round-trips", "Part of the suite to run.")
    ] = "full",
    small: Annotated[
        bool, typer.Option("--small", help="Same as --study small: some minutes.")
    ] = False,
    task: Annotated[str | None, value("--task", "TASK,TASK...", "Only these tasks.")] = None,
    law: Annotated[str | None, value("--law", "LAW,LAW...", "Only these laws.")] = None,
    link: Annotated[str | None, value("--link", "LINK,LINK...")] = None,
    seeds: Annotated[
        int | None, value("--seeds", "N", "Number of seeds; default: the study's.")
    ] = None,
    cell: Annotated[str | None, value("--cell", "TASK/LAW/LINK")] = None,
    tune: Annotated[bool, typer.Option("--tune", rich_help_panel="Gains")] = False,
    confirm: Annotated[bool, typer.Option("--confirm")] = False,
    output: Annotated[Path | None, value("--out -o", "DIR")] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Runs control laws on the same tasks over the same links: stability, energy, errors,
    effort, stiffness.

    One procedure tuned the gains of every law. Finished runs are kept: the same command
    continues.

    Options:
        link: Other links, as in rtt68-loss10,4g.
        cell: Print the commands that make logs of a cell.
        tune: Tune the laws again, and store their gains with the suite.
        confirm: Run what is not stable for 100 s: it is refuted or confirmed.
        output: Folder; continues a suite in it. Default: runs/bench-STUDY.
    """
    from ..studies.bench import plan_bench, prepare_bench_folder
    from ..studies.bench.bench_figures import write_bench
    from ..studies.bench.bench_plan import find_stale
    from ..studies.executor import check_workers
    from ..studies.study_folder import format_command

    check_workers(jobs, on)
    chosen = "small" if small else study
    lists = [options.split_names(one) for one in (task, law, link)]
    if tune:
        _tune(lists[1], chosen, jobs, on)
        return
    plan = plan_bench(chosen, tasks=lists[0], laws=lists[1], links=lists[2], seeds=seeds)
    if cell is not None:
        for one in plan.cell(cell).seeds:
            log = f"{cell.replace('/', '-')}-{one}.mcap"
            terminal.print_line(f"{plan.cell(cell).build(one).command} -o {log}")
        return
    stale = find_stale({str(one.tuned): one.tuned for one in plan.cells}.values())
    if stale:
        terminal.print_note(
            f"tuned for another text of law or task, see --tune: {', '.join(stale)}"
        )
    folder = prepare_bench_folder(plan, output)
    terminal.print_note(
        f"{count_nouns(len(plan.cells), 'cell')}, {count_nouns(plan.runs, 'run')}, into {folder.path}"
    )
    results = _run(folder, jobs, on, confirm=confirm)
    given = {"--task": task, "--law": law, "--link": link, "--seeds": seeds}
    words = [
        word for key, value in given.items() if value is not None for word in (key, str(value))
    ]
    words += ["--confirm"] if confirm else []
    paths = write_bench(
        results, folder.path, format_command("bench", "--study", chosen, *words)
    )
    terminal.print_result(results, as_json=as_json)
    terminal.print_paths([] if as_json else paths)


ProtocolArgument = Annotated[Path, typer.Argument(help="A protocol (TOML).", metavar="FILE")]
FolderArgument = Annotated[Path, typer.Argument(help="Folder of an experiment.", metavar="DIR")]


@options.command("reaching.toml", "two-people.toml --pair")
def experiment_new_command(
    file: ProtocolArgument,
    pair: Annotated[bool, flag("--pair", "For two people, who hold a master each.")] = False,
    force: options.ForceOption = False,
) -> None:
    """Writes a protocol with comments, which runs as it is."""
    from ..studies.experiment.experiment_run import new_experiment

    new_experiment(file, pair=pair, force=force)
    terminal.print_text(f"{file}: a protocol; run it with: trilat experiment run {file}")


@options.command("reaching.toml")
def experiment_check_command(
    file: ProtocolArgument, as_json: options.JsonOption = False
) -> None:
    """Prints the plan of a protocol, or everything that is wrong with it."""
    from ..studies.experiment.experiment_run import check_experiment

    terminal.print_result(check_experiment(file), as_json=as_json)


@options.command("reaching.toml", "two-people.toml --live", "runs/experiment-reaching-001")
def experiment_run_command(
    file: Annotated[
        Path, typer.Argument(help="A protocol, or the folder of one that goes on.")
    ],
    out: Annotated[
        Path | None, value("--out -o", "DIR", "Default: runs/experiment-NAME-N.")
    ] = None,
    live: Annotated[bool, flag("--live", "With people, on pages in their browsers.")] = False,
    *,
    serving: options.PageServing,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Runs an experiment: with synthetic participants in virtual time, or with people.

    Each trial leaves a verified log. With --live it prints a link for the experimenter and one
    for each user; trials begin once all users are ready on their pages. The page's button or
    Ctrl-C ends it for now.
    """
    from live.page_server import PageOptions

    from ..studies.experiment.experiment_run import begin_experiment, open_experiment

    page = PageOptions(*serving)
    code = 0
    if live:
        page.check()
    begun = open_experiment(file) if file.is_dir() else begin_experiment(file, out)
    with terminal.lines_aside(as_json):
        terminal.print_text(
            f"{count_nouns(len(begun.plan.trials), 'trial')}, into {begun.folder}; it goes on after Ctrl-C by"
        )
        terminal.print_text(
            f"  trilat experiment run {begun.folder}{' --live' if live else ''}"
        )
        if live:
            from live.experiment_sessions import run_with_people

            code = run_with_people(begun, page, terminal.print_line)
        else:
            with show_progress("trials", terminal.print_text) as show:
                begun.run(jobs, show, on)
    terminal.print_result(begun, as_json=as_json)
    if code:
        raise typer.Exit(code)


@options.command("runs/experiment-reaching-001")
def experiment_analyse_command(
    folder: FolderArgument,
    out: Annotated[
        Path | None, value("--out -o", "DIR", "Default: its folder analysis.")
    ] = None,
    exclude: Annotated[
        list[str] | None,
        value(
            "--exclude", "WHO=WHY", "Leave out a participant or pair, and say why; repeatable."
        ),
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Compares the conditions of an experiment: tables, figures, a paragraph for a paper."""
    from ..studies.experiment.experiment_analysis import analyse_experiment

    left_out = dict(entry.partition("=")[::2] for entry in exclude or [])
    found = analyse_experiment(folder, out, exclude=left_out)
    terminal.print_result(found, as_json=as_json)
    terminal.print_paths([] if as_json else found.paths)


@options.command("0.8 --participants 16")
def experiment_power_command(
    effect: Annotated[
        float, typer.Argument(help="Cohen's d_z of a paired comparison.", min=0.01, max=10.0)
    ],
    participants: Annotated[
        int | None, value("--participants", "N", "How many there are.", min=2)
    ] = None,
    seed: Annotated[int, value("--seed", "S", "Of the experiments that are drawn.")] = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Tells how many participants it takes to find an effect, by theory and by drawn
    experiments.
    """
    from ..studies.experiment.experiment_analysis import compute_experiment_power

    terminal.print_result(
        compute_experiment_power(effect, participants, seed=seed), as_json=as_json
    )


@options.command("runs/experiment-reaching-001")
def experiment_status_command(
    folder: FolderArgument, as_json: options.JsonOption = False
) -> None:
    """Prints how far an experiment is, and whether its logs are those that its trials wrote."""
    from ..studies.experiment.experiment_run import list_log_problems, open_experiment

    found = open_experiment(folder)
    problems = list(list_log_problems(found))
    terminal.print_result(found, as_json=as_json)
    for problem in problems:
        terminal.err.print(problem, markup=False, highlight=False)
    if problems:
        raise typer.Exit(1)

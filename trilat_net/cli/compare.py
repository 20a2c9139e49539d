"""`trilat compare`: logs side by side, or control laws that one procedure tunes.

Invariant: numbers are printed and nothing is ranked.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from ..studies.tuning import TuningPlan


def _run_tuning(
    asked: "TuningPlan", folder: Path | None, jobs: int | None, on: str | None, *, force: bool, as_json: bool
) -> None:
    """Runs a comparison, writes it into a folder, by default the next free one, and prints it."""
    from ..files import make_results_folder
    from ..studies.executor import count_workers
    from ..studies.tuning.tuning_report import write_tuning

    workers = count_workers(jobs, on)
    chosen = make_results_folder(folder, f"tune-{asked.base.scenario.name}", force=force)
    if not as_json:
        _print_procedure(asked, workers)
    with terminal.progress_bar("searching") as progress:
        found = asked.run(jobs, progress, on)
    paths = write_tuning(found, chosen)
    if not as_json:
        terminal.out.print()
    terminal.print_result(found, as_json=as_json)
    terminal.print_paths([] if as_json else paths)


def _print_procedure(asked: "TuningPlan", workers: int) -> None:
    from ..studies.sweep.sweep_run import format_wall_time
    from ..studies.tuning.tuning_report import describe_procedure

    laws = ", ".join(space.law for space in asked.spaces)
    terminal.print_text(f"{asked.base.scenario.name}, laws {laws}; the same for all:")
    for line in describe_procedure(asked):
        terminal.print_text(f"  {line}")
    cores = "1 core" if workers == 1 else f"{workers} cores"
    duration = format_wall_time(asked.estimate_s(workers))
    terminal.print_text(
        f"{asked.runs} runs on {cores}: about {duration} at the present speed of this machine"
    )


_option = partial(options.value, rich_help_panel="Tune laws")


def compare_command(
    context: typer.Context,
    files: Annotated[
        list[Path] | None, typer.Argument(help="Two or more MCAP logs.", metavar="FILE FILE...")
    ] = None,
    tune: Annotated[
        str | None, _option("--tune", "SCENARIO", "Compare tuned control laws in this scenario instead.")
    ] = None,
    law: Annotated[
        str | None,
        _option(
            "--law",
            "LAW,LAW...",
            "Control laws; default: adaptive,adaptive_box,p_d,pd_d. Others: "
            "adaptive_robust, known, p_f, wave, tdpa, tanks, four_channel, six_channel, saturated_pd, "
            "authority, impedance, smith, and your own, as in mylaws:Law.",
        ),
    ] = None,
    budget: Annotated[int, _option("--budget", "N", "Candidates per law.")] = 64,
    seed: Annotated[int, _option("--seed", "S", "Seed of the search.")] = 1,
    seeds: Annotated[
        int, _option("--seeds", "N", "Seeds of the scenario that each candidate is the mean of.")
    ] = 1,
    objective: Annotated[
        str, _option("--objective", "error|settling", "The objective besides effort.")
    ] = "error",
    gravity: Annotated[
        float, _option("--gravity", "PERCENT", "Gravity that all laws assume, in % of the truth.")
    ] = 100.0,
    duration: options.DurationOption = None,
    overrides: options.SetOption = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    output: Annotated[
        Path | None, _option("--out -o", "DIR", "Folder of the results; default: the next free runs/tune-...")
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Compares logs and the differences of their experiments; or control laws, all tuned by one procedure.

    Ranks nothing: arms that hang, or that no operator moves, also have small errors.
    """
    if tune is None:
        for name in options.given_options(context):
            if name not in ("files", "--json"):
                raise UsageError(f"{name} belongs to --tune SCENARIO; logs are compared as they are")
        _compare_logs(files or [], as_json=as_json)
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


def _compare_logs(files: list[Path], *, as_json: bool) -> None:
    from ..studies.log_comparison import compare_logs

    logs = [terminal.open_with_progress(file) for file in files]
    terminal.print_result(compare_logs(logs), as_json=as_json)

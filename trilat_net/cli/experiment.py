"""Experiments with people: write a protocol, check it, run it, see how far it is, and analyse it."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options
from .options import flag, value

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
def experiment_check_command(file: ProtocolArgument, as_json: options.JsonOption = False) -> None:
    """Prints the plan of a protocol, or everything that is wrong with it."""
    from ..studies.experiment.experiment_run import check_experiment

    terminal.print_result(check_experiment(file), as_json=as_json)


@options.command("reaching.toml", "two-people.toml --live", "runs/experiment-reaching-001")
def experiment_run_command(
    file: Annotated[Path, typer.Argument(help="A protocol, or the folder of one that goes on.")],
    out: Annotated[Path | None, value("--out -o", "DIR", "Default: runs/experiment-NAME-N.")] = None,
    live: Annotated[bool, flag("--live", "With people, on pages in their browsers.")] = False,
    *,
    serving: options.PageServing,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Runs an experiment: with synthetic participants in virtual time, or with people.

    Each trial leaves a verified log. With --live it prints a link for the experimenter and one for each user;
    trials begin once all users are ready on their pages. The page's button or Ctrl-C ends it for now.
    """
    from live.page_server import PageOptions

    from ..studies.experiment.experiment_run import begin_experiment, open_experiment
    from .studies import show_progress

    page, code = PageOptions(*serving), 0
    if live:
        page.check()
    begun = open_experiment(file) if file.is_dir() else begin_experiment(file, out)
    with terminal.lines_aside(as_json):
        terminal.print_text(
            f"{len(begun.plan.trials)} trials, into {begun.folder}; it goes on after Ctrl-C by"
        )
        terminal.print_text(f"  trilat experiment run {begun.folder}{' --live' if live else ''}")
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
    out: Annotated[Path | None, value("--out -o", "DIR", "Default: its folder analysis.")] = None,
    exclude: Annotated[
        list[str] | None,
        value("--exclude", "WHO=WHY", "Leave out a participant or pair, and say why; repeatable."),
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
    effect: Annotated[float, typer.Argument(help="Cohen's d_z of a paired comparison.", min=0.01, max=10.0)],
    participants: Annotated[int | None, value("--participants", "N", "How many there are.", min=2)] = None,
    seed: Annotated[int, value("--seed", "S", "Of the experiments that are drawn.")] = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Tells how many participants it takes to find an effect, by theory and by drawn experiments."""
    from ..studies.experiment.experiment_analysis import compute_experiment_power

    terminal.print_result(compute_experiment_power(effect, participants, seed=seed), as_json=as_json)


@options.command("runs/experiment-reaching-001")
def experiment_status_command(folder: FolderArgument, as_json: options.JsonOption = False) -> None:
    """Prints how far an experiment is, and whether its logs are those that its trials wrote."""
    from ..studies.experiment.experiment_run import list_log_problems, open_experiment

    found = open_experiment(folder)
    problems = list(list_log_problems(found))
    terminal.print_result(found, as_json=as_json)
    for problem in problems:
        terminal.err.print(problem, markup=False, highlight=False)
    if problems:
        raise typer.Exit(1)

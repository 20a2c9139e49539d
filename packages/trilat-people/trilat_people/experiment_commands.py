"""The commands `trilat experiment`, which write, check, run and analyse experiments.

In an experiment, people operate the arms under different conditions, such as two network
delays. Synthetic participants can take their place to try out a protocol in advance.

Invariant:
    - An interrupted experiment resumes when the same command is run again.
"""

from pathlib import Path
from typing import Annotated

import typer

from trilat_net.app import options, value
from trilat_net.errors import count_nouns
from trilat_net.presentation import terminal_output as terminal

from .page_options import PageServing

ProtocolArgument = Annotated[
    Path, typer.Argument(help="Protocol of an experiment (a TOML file).", metavar="FILE")
]
FolderArgument = Annotated[Path, typer.Argument(help="Folder of an experiment.", metavar="DIR")]


@options.command(
    "reaching.toml", "two-people.toml --pair", page="docs/reference/experiment-protocol.md"
)
def experiment_new_command(
    file: Annotated[
        Path, typer.Argument(help="Protocol to write (a TOML file).", metavar="FILE")
    ],
    pair: Annotated[
        bool,
        typer.Option(
            "--pair", help="Write a protocol for two people, each of whom holds a master arm."
        ),
    ] = False,
    force: options.ForceOption = False,
) -> None:
    """Writes a commented protocol that runs without changes."""
    from .experiment.experiment_run import new_experiment

    new_experiment(file, pair=pair, force=force)
    people = f"trilat experiment run {file} --live"
    models = f"trilat experiment run {file}"
    terminal.print_text(
        f"{file} is a protocol; run it with people: {people}; with models of people: {models}"
    )


@options.command("reaching.toml", page="docs/reference/experiment-protocol.md")
def experiment_check_command(
    file: ProtocolArgument, as_json: options.JsonOption = False
) -> None:
    """Prints the plan of a protocol, or everything that is wrong with the protocol."""
    from .experiment.experiment_run import check_experiment

    terminal.print_result(check_experiment(file), as_json=as_json)


@options.command(
    "reaching.toml",
    "two-people.toml --live",
    "runs/experiment-reaching-001",
    page="docs/studies/experiments.md",
)
def experiment_run_command(
    file: Annotated[
        Path, typer.Argument(help="A protocol, or the folder of an experiment to continue.")
    ],
    out: Annotated[
        Path | None,
        value("--out -o", "DIR", "Folder for the results; default: runs/experiment-NAME-N."),
    ] = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="Run with people, who take part on pages in their browsers."
        ),
    ] = False,
    *,
    serving: PageServing,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Runs an experiment with synthetic participants in virtual time, or with people.

    Each trial produces a verified log. With --live, the command prints a link for the
    experimenter and one for each user; trials begin once all users are ready on their pages.
    The button on the experimenter's page or Ctrl-C pauses the experiment.
    """
    from .experiment.experiment_run import Experiment, open_experiment
    from .live_page.page_server import PageOptions

    page = PageOptions(*serving)
    if live:
        page.check()
    experiment = open_experiment(file) if file.is_dir() else Experiment.begin(file, out)
    exit_code = 0
    with terminal.lines_aside(as_json):
        trials = count_nouns(len(experiment.plan.trials), "trial")
        terminal.print_text(f"{trials}, into {experiment.folder}; after Ctrl-C, continue with")
        live_option = " --live" if live else ""
        terminal.print_text(f"  trilat experiment run {experiment.folder}{live_option}")
        if live:
            from .live_page.experiment_sessions import run_with_people

            exit_code = run_with_people(experiment, page, terminal.print_line)
        else:
            with terminal.show_progress("trials", terminal.print_text) as show:
                experiment.run(jobs, show, on)
    terminal.print_result(experiment, as_json=as_json)
    if exit_code:
        raise typer.Exit(exit_code)


@options.command("runs/experiment-reaching-001", page="docs/reference/experiment-analysis.md")
def experiment_analyse_command(
    folder: FolderArgument,
    out: Annotated[Path | None, value("--out -o", "DIR")] = None,
    exclude: Annotated[list[str] | None, value("--exclude", "WHO=REASON")] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Compares the conditions of an experiment, in tables, figures and a paragraph for a paper.

    Options:
        out: Folder for the results; default: analysis, in the folder of the experiment.
        exclude: Participant or pair to leave out, with the reason; repeatable.
    """
    from .experiment.experiment_analysis import analyse_experiment

    excluded = {}
    for text in exclude or []:
        participant, _, reason = text.partition("=")
        excluded[participant] = reason
    analysis = analyse_experiment(folder, out, exclude=excluded)
    terminal.print_result(analysis, as_json=as_json)
    terminal.print_paths([] if as_json else analysis.paths)


@options.command("0.8 --participants 16", page="docs/reference/experiment-analysis.md")
def experiment_power_command(
    effect: Annotated[
        float, typer.Argument(help="Cohen's d_z of a paired comparison.", min=0.01, max=10.0)
    ],
    participants: Annotated[
        int | None,
        value(
            "--participants",
            "N",
            "Planned number of participants, whose power is computed.",
            min=2,
        ),
    ] = None,
    seed: Annotated[int, value("--seed", "S", "Seed of the simulated experiments.")] = 1,
    as_json: options.JsonOption = False,
) -> None:
    """Computes how many participants are needed to detect an effect.

    The power is computed from theory. With --participants, it is also computed from simulated
    experiments, whose data are random.
    """
    from .experiment.experiment_analysis import compute_experiment_power

    power = compute_experiment_power(effect, participants, seed=seed)
    terminal.print_result(power, as_json=as_json)


@options.command("runs/experiment-reaching-001", page="docs/studies/experiments.md")
def experiment_status_command(
    folder: FolderArgument, as_json: options.JsonOption = False
) -> None:
    """Prints the progress of an experiment, and checks that its logs were not changed."""
    from .experiment.experiment_run import open_experiment

    experiment = open_experiment(folder)
    problems = list(experiment.list_log_problems())
    terminal.print_result(experiment, as_json=as_json)
    for problem in problems:
        terminal.err.print(problem, markup=False, highlight=False)
    if problems:
        raise typer.Exit(1)

"""`trilat bench`: the suite of control laws, on the same tasks, links and seeds.

Invariant: everything printed is in the result files too. A suite that is interrupted goes on by the same
command. Numbers are printed and nothing is ranked.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options
from .sweep import show_progress

if TYPE_CHECKING:
    from ..studies.bench import BenchPlan, BenchResults
    from ..studies.bench.bench_run import BenchFolder

_option = partial(typer.Option, rich_help_panel="Gains")


def _tune(laws: list[str], study: str, jobs: int | None, on: str | None) -> None:
    """Tunes laws of a study at all delays, and writes their gains into the file of the suite."""
    from ..studies.bench.bench_plan import GAINS_FILE, tune_laws, write_gains
    from ..studies.bench.bench_tasks import STUDIES

    asked = STUDIES[study].laws
    unknown = [law for law in laws if law not in {law for known in asked.values() for law in known}]
    if unknown:
        raise UsageError(f"--law: {unknown[0]} is none of the study {study}")
    wanted = {form: [law for law in known if law in laws or not laws] for form, known in asked.items()}
    with show_progress("tuning", terminal.print_note) as progress:
        found = tune_laws({form: kept for form, kept in wanted.items() if kept}, jobs, on, progress)
    write_gains(found)
    terminal.print_paths([GAINS_FILE])


def _print_cell(plan: "BenchPlan", name: str) -> None:
    """Prints the commands that make logs of a cell, one per seed."""
    for seed in plan.cell(name).seeds:
        terminal.print_line(f"{plan.cell(name).build(seed).command} -o {name.replace('/', '-')}-{seed}.mcap")


def _run(folder: "BenchFolder", jobs: int | None, on: str | None, *, confirm: bool) -> "BenchResults":
    from ..studies.bench import run_bench

    try:
        with show_progress("running", terminal.print_note) as progress:
            return run_bench(folder, jobs, on, progress, confirm=confirm)
    except KeyboardInterrupt:
        terminal.print_note(f"what is done is kept in {folder.path}; the same command goes on")
        raise


def bench_command(
    study: Annotated[
        str, options.value("--study", "full|small|round-trips", "Part of the suite to run.")
    ] = "full",
    small: Annotated[bool, typer.Option("--small", help="Same as --study small: some minutes.")] = False,
    task: Annotated[str | None, options.value("--task", "TASK,TASK...", "Only these tasks.")] = None,
    law: Annotated[str | None, options.value("--law", "LAW,LAW...", "Only these laws.")] = None,
    link: Annotated[
        str | None, options.value("--link", "LINK,LINK...", "Other links, as in rtt68-loss10,4g.")
    ] = None,
    seeds: Annotated[
        int | None, options.value("--seeds", "N", "Number of seeds; default: the study's.")
    ] = None,
    cell: Annotated[
        str | None, options.value("--cell", "TASK/LAW/LINK", "Print the commands that make logs of a cell.")
    ] = None,
    tune: Annotated[
        bool, _option("--tune", help="Tune the laws again, and store their gains with the suite.")
    ] = False,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Run what is not stable for 100 s: it is refuted or confirmed.")
    ] = False,
    output: Annotated[
        Path | None,
        options.value("--out -o", "DIR", "Folder; continues a suite in it. Default: runs/bench-STUDY."),
    ] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Runs control laws on the same tasks over the same links: stability, energy, errors, effort, stiffness.

    One procedure tuned the gains of every law. Finished runs are kept: the same command continues.
    """
    from ..studies.bench import plan_bench, prepare_bench_folder
    from ..studies.bench.bench_figures import write_bench
    from ..studies.bench.bench_plan import find_stale
    from ..studies.commands import format_command
    from ..studies.executor import check_workers

    check_workers(jobs, on)
    chosen = "small" if small else study
    lists = [options.split_names(one) for one in (task, law, link)]
    if tune:
        return _tune(lists[1], chosen, jobs, on)
    plan = plan_bench(chosen, tasks=lists[0], laws=lists[1], links=lists[2], seeds=seeds)
    if cell is not None:
        return _print_cell(plan, cell)
    stale = find_stale({str(one.tuned): one.tuned for one in plan.cells}.values())
    if stale:
        terminal.print_note(f"tuned for another text of law or task, see --tune: {', '.join(stale)}")
    folder = prepare_bench_folder(plan, output)
    terminal.print_note(f"{len(plan.cells)} cells, {plan.runs} runs, into {folder.path}")
    results = _run(folder, jobs, on, confirm=confirm)
    given = {"--task": task, "--law": law, "--link": link, "--seeds": seeds}
    words = [word for key, value in given.items() if value is not None for word in (key, str(value))]
    words += ["--confirm"] if confirm else []
    paths = write_bench(results, folder.path, format_command("bench", "--study", chosen, *words))
    terminal.print_result(results, as_json=as_json)
    terminal.print_paths([] if as_json else paths)
    return None

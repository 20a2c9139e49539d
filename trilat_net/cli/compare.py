"""`trilat compare`: logs side by side, or control laws that one procedure tunes.

Invariant: numbers are printed and nothing is ranked.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from ..analysis.metrics.log_metrics import MetricComparison
    from ..log.log_reader import Log
    from ..scenario.describe import ScenarioDifference
    from ..studies.intervals import MeanInterval
    from ..studies.tuning import TuningPlan, TuningResult

_MOST_REASONS = 6


def _print_comparison(
    logs: Sequence["Log"],
    different: Sequence["ScenarioDifference"],
    found: "MetricComparison",
    means: "Sequence[MeanInterval | None]",
    remarks: Mapping[str, Sequence[str]],
) -> None:
    """Prints the differences of the experiments, the quantities of the logs, and remarks per log."""
    names = {log.scenario.name for log in logs}
    if len(names) > 1:
        terminal.print_text(f"logs of different scenarios: {', '.join(sorted(names))}")
    if different:
        terminal.out.print()
        rows = [(str(one), *one.values) for one in different]
        terminal.print_table(TextTable(("differs", *found.columns), rows))
    else:
        terminal.out.print("one and the same experiment")
    terminal.out.print()
    terminal.print_table(_tabulate_quantities(found, means))
    terminal.out.print()
    for name, lines in remarks.items():
        for line in lines:
            text = escape(terminal.sanitize(f"{name}: {line}"))
            terminal.out.print(f"[bold]note[/bold] {text}", soft_wrap=True)
    _print_reasons(found)


def _tabulate_quantities(found: "MetricComparison", means: "Sequence[MeanInterval | None]") -> TextTable:
    """Returns a row per quantity and a column per log; and one of the means where the logs are repeats."""
    rows: list[list[str]] = []
    of_row = dict(zip(found.rows, means, strict=True)) if means else {}
    for group, members in groupby(found.rows, key=lambda row: row.quantity.group):
        rows.append([group])
        for row in members:
            values = ["-" if value is None else f"{value:.4g}" for value in row.values]
            values += [str(of_row[row] or "-")] if means else []
            rows.append([f"  {row.quantity.name}", row.quantity.unit or "-", *values])
    heads = ("", "unit", *found.columns, *(["mean, 95 %"] if means else []))
    return TextTable(heads, rows, align="llr")


def average_repeats(logs: "Sequence[Log]", found: "MetricComparison") -> "list[MeanInterval | None]":
    """Returns the mean of each quantity over logs that differ in their seeds alone; [] of other logs."""
    from ..scenario.scenario_reader import reseed_scenario
    from ..studies.intervals import mean_interval

    first = logs[0].scenario
    if len({log.scenario.seed for log in logs}) < len(logs):
        return []
    if any(reseed_scenario(log.scenario, first.seed) != first for log in logs):
        return []
    return [mean_interval(row.values) for row in found.rows]


def _print_reasons(found: "MetricComparison") -> None:
    reasons = [
        f"{name}: no {row.quantity.name}: {entry.why}"
        for row in found.rows
        for name, entry in zip(found.columns, row.entries, strict=True)
        if entry.value is None and entry.applies
    ]
    for line in reasons[:_MOST_REASONS]:
        terminal.print_text(line)
    if len(reasons) > _MOST_REASONS:
        terminal.out.print(f"and {len(reasons) - _MOST_REASONS} more, which --json names")


_MAX_FRONT_ROWS = 8
"""Points of a front that are printed; the files hold all."""


def _run_tuning(
    asked: "TuningPlan", folder: Path | None, jobs: int | None, on: str | None, *, force: bool, as_json: bool
) -> None:
    """Runs a comparison, writes it into a folder, by default the next free one, and prints it."""
    from ..files import make_results_folder
    from ..studies.executor import count_workers
    from ..studies.tuning.tuning_report import tuning_to_json, write_tuning

    workers = count_workers(jobs, on)
    chosen = make_results_folder(folder, f"tune-{asked.base.scenario.name}", force=force)
    if not as_json:
        _print_procedure(asked, workers)
    with terminal.progress_bar("searching") as progress:
        found = asked.run(jobs, progress, on)
    paths = write_tuning(found, chosen)
    if as_json:
        terminal.print_json(tuning_to_json(found))
    else:
        _print_tuned(found)
        terminal.print_paths(paths)


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


def _print_tuned(found: "TuningResult") -> None:
    from ..studies.tuning.tuning_report import (
        list_class_meanings,
        tabulate_front,
        tabulate_laws,
        tabulate_paper_gains,
    )

    terminal.out.print()
    terminal.print_table(tabulate_laws(found))
    for line in list_class_meanings():
        terminal.print_text(f"  {line}")
    for law in found.found:
        if law.front:
            terminal.out.print()
            terminal.print_table(tabulate_front(found, law, _MAX_FRONT_ROWS))
    terminal.out.print(
        f"  * no candidate of any law is better in both; of long fronts {_MAX_FRONT_ROWS} points are shown"
    )
    terminal.out.print()
    terminal.print_table(tabulate_paper_gains(found))
    for law in found.found:
        for gain in found.at_edge(law):
            terminal.print_text(
                f"note: {law.space.law} is best at the edge of the range of {gain}; widen the search"
            )
    if not any(law.front for law in found.found):
        terminal.out.print(
            "\nno candidate of any law is stable and at the pose: a longer --duration or a larger --budget "
            "may show more"
        )
        return
    terminal.out.print("\nthe last of each front, to run; front.md has the others:")
    for law in found.found:
        for place in law.front[-1:]:
            terminal.print_text(f"  {found.candidate(law, place).command}")


_option = partial(typer.Option, rich_help_panel="Tune laws")


def compare_command(
    context: typer.Context,
    files: Annotated[
        list[Path] | None, typer.Argument(help="Two or more MCAP logs.", metavar="FILE FILE...")
    ] = None,
    tune: Annotated[
        str | None,
        _option("--tune", metavar="SCENARIO", help="Compare laws instead, tuned alike in this scenario."),
    ] = None,
    law: Annotated[
        str | None,
        _option(
            "--law",
            metavar="LAW,LAW...",
            help="Which laws; default: adaptive,adaptive_box,p_d,pd_d. Others: "
            "adaptive_robust, known, p_f, wave, tdpa, tanks, four_channel, six_channel, saturated_pd, "
            "authority, impedance, smith.",
        ),
    ] = None,
    budget: Annotated[int, _option("--budget", metavar="N", help="Candidates per law.")] = 64,
    seed: Annotated[int, _option("--seed", metavar="S", help="Seed of the search.")] = 1,
    seeds: Annotated[
        int,
        _option("--seeds", metavar="N", help="Seeds of the scenario that each candidate is the mean of."),
    ] = 1,
    objective: Annotated[
        str, _option("--objective", metavar="error|settling", help="The objective besides effort.")
    ] = "error",
    gravity: Annotated[
        float,
        _option("--gravity", metavar="PERCENT", help="Gravity that all laws assume, in % of the truth."),
    ] = 100.0,
    duration: options.DurationOption = None,
    overrides: options.SetOption = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    output: Annotated[
        Path | None,
        _option("--out", metavar="DIR", help="Folder of the results; default: the next free runs/tune-..."),
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Compares logs side by side, with the differences of their experiments; or laws, each tuned alike.

    Nothing is ranked: arms that hang, or that nobody pushed, have small errors too.
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
    if len(files) < 2:
        raise UsageError("name two logs or more; or a scenario, as in: trilat compare --tune free")
    from ..analysis.metrics.log_metrics import compare_metrics, comparison_to_json
    from ..reporting.certificate_text import describe_judgement
    from ..scenario.describe import compare_scenarios
    from ..studies.tuning.final_posture import check_final_posture
    from ..theory.end_pose import certify_with_roots

    logs = [terminal.open_with_progress(file) for file in files]
    names = name_columns(files)
    different = compare_scenarios([log.scenario for log in logs])
    remarks = {
        name: [describe_judgement(certify_with_roots(log)), *check_final_posture(log)]
        for name, log in zip(names, logs, strict=True)
    }
    found = compare_metrics(logs, names)
    means = average_repeats(logs, found)
    if not as_json:
        _print_comparison(logs, different, found, means, remarks)
        return
    entries = [
        {"name": name, "file": str(file), "scenario": log.scenario.name, "sha256": log.scenario.sha256}
        for name, file, log in zip(names, files, logs, strict=True)
    ]
    differences = [one._asdict() for one in different]
    facts = {"logs": entries, "differences": differences, "remarks": remarks, **comparison_to_json(found)}
    if means:
        pairs = zip(found.rows, means, strict=True)
        facts["means"] = {row.quantity.key: mean._asdict() for row, mean in pairs if mean}
    terminal.print_json(facts)


def name_columns(files: list[Path]) -> list[str]:
    """Returns a column name per log: the file's name, with as much of its path as tells them apart."""
    for depth in range(1, max(len(file.parts) for file in files) + 1):
        names = ["/".join(file.with_suffix("").parts[-depth:]) for file in files]
        if len(set(names)) == len(names):
            return names
    return [f"{n}: {file}" for n, file in enumerate(files, 1)]

"""`trilat test`: runs scenarios and evaluates their [expect] tables."""

import os
import platform
import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from ..studies.trials.trial import Trial, TrialResult
    from ..studies.trials.trial_report import TrialReport


MAX_SEEDS = 100_000


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
        typer.Option(
            "--live/--virtual", help="Run live over a network, one after the other, or in virtual time."
        ),
    ] = False,
    seeds: Annotated[
        str | None, options.value("--seeds", "LIST", "Seeds, as in 1..20 or 1,5,9; default: the scenario's.")
    ] = None,
    junit: Annotated[
        Path | None, options.value("--junit", "FILE", "Write the results as JUnit XML as well.")
    ] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    overrides: options.SetOption = None,
    as_json: options.JsonOption = False,
) -> None:
    r"""Runs scenarios and checks their \[expect]: margins, and commands that repeat what failed."""
    from ..files import write_whole
    from ..net.clock import SystemClock
    from ..studies.executor import check_workers
    from ..studies.trials.trial_report import encode_junit_xml

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


def _batch(sources: list[str], seeds: list[int], overrides: list[str], *, live: bool) -> "list[Trial]":
    """Returns all trials; without sources, of every shipped scenario that expects something."""
    from ..scenario import list_shipped, load_scenario
    from ..studies.trials.trial import trials

    chosen = sources or [name for name in list_shipped() if load_scenario(name).expect.asks]
    return [
        trial for source in dict.fromkeys(chosen) for trial in trials(source, seeds, overrides, live=live)
    ]


def _run_virtual(batch: "list[Trial]", jobs: int | None, on: str | None) -> "TrialReport":
    """Runs trials in virtual time; shows a bar on a terminal, elsewhere a line per scenario that is done."""
    from rich.progress import Progress

    from ..studies.trials.trial_report import run_trials

    to_do = Counter(trial.source for trial in batch)
    with Progress(console=terminal.out, transient=True, disable=not terminal.out.is_terminal) as progress:
        task = progress.add_task("runs", total=len(batch))

        def done(result: "TrialResult") -> None:
            progress.advance(task)
            source = result.trial.source
            to_do[source] -= 1
            if not to_do[source] and not terminal.out.is_terminal:
                terminal.print_text(f"{source}: ran")

        return run_trials(batch, jobs, done, on)


def _run_live(batch: "list[Trial]") -> "TrialReport":
    from sites.demo_session import run_demo
    from sites.monitor import SessionDisplay

    from ..files import make_results_folder
    from ..net.clock import SystemClock
    from ..studies.trials.trial import evaluate_live_log
    from ..studies.trials.trial_report import TrialReport

    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    results = []
    for trial in batch:
        folder = make_results_folder(None, f"test-{trial}", force=False)
        terminal.print_text(f"{trial}: {trial.scenario.duration_s:g} s live, into {folder}")
        began_ns = clock.monotonic_ns()
        with SessionDisplay(trial.scenario, terminal.out) as display:
            outcome = run_demo(trial.scenario, folder, display)
        if outcome.interrupted:
            terminal.err.print("interrupted")
            raise typer.Exit(128 + outcome.interrupted)
        wall_s = (clock.monotonic_ns() - began_ns) * 1e-9
        results.append(evaluate_live_log(trial, outcome.log, outcome.problems, wall_s))
    return TrialReport(results, (clock.monotonic_ns() - start_ns) * 1e-9)

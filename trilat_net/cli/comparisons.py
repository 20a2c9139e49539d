"""The command that compares: logs side by side, or laws tuned by one procedure."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .beside import show_logs
from .opening import opened
from .options import DurationOption, ForceOption, JsonOption, SetOption, say

app = typer.Typer()

_TUNING = "Tune laws"


@app.command(
    epilog="Example: trilat compare a.mcap b.mcap\n\nExample: trilat compare --tune free --law adaptive,p_d"
)
def compare(
    files: Annotated[
        list[Path] | None, typer.Argument(help="Two or more MCAP logs.", metavar="FILE FILE...")
    ] = None,
    tune: Annotated[
        str | None,
        typer.Option(
            "--tune",
            metavar="SCENARIO",
            help="Compare laws instead, each tuned alike in this scenario.",
            rich_help_panel=_TUNING,
        ),
    ] = None,
    law: Annotated[
        str | None,
        typer.Option(
            "--law",
            metavar="LAW,LAW...",
            help="Which laws; default: adaptive,adaptive_box,p_d,pd_d. Others: p_f, known.",
            rich_help_panel=_TUNING,
        ),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option(
            "--budget", metavar="N", help="Candidates per law; default: 64.", rich_help_panel=_TUNING
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", metavar="S", help="Of the search; default: 1.", rich_help_panel=_TUNING),
    ] = None,
    objective: Annotated[
        str | None,
        typer.Option(
            "--objective",
            metavar="error|settling",
            help="What is weighed against effort; default: error.",
            rich_help_panel=_TUNING,
        ),
    ] = None,
    gravity: Annotated[
        float | None,
        typer.Option(
            "--gravity",
            metavar="PERCENT",
            help="What all laws are told of gravity, in % of the truth; default: 100.",
            rich_help_panel=_TUNING,
        ),
    ] = None,
    duration: DurationOption = None,
    overrides: SetOption = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            min=1,
            help="Processes; default: one per core.",
            rich_help_panel=_TUNING,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Where the front goes; default: the next free runs/tune-...",
            rich_help_panel=_TUNING,
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compares logs side by side, with what differs in their experiments; or laws, each tuned alike.

    Nothing is ranked: arms that hang, or were never pushed, have small errors too.
    """
    if tune is None:
        of_tuning = {
            "--law": law,
            "--budget": budget,
            "--seed": seed,
            "--objective": objective,
            "--gravity": gravity,
            "--duration": duration,
            "--set": overrides,
            "--jobs": jobs,
            "--out": output,
            "--force": force or None,
        }
        _refuse_alone(of_tuning)
        _compare_logs(files or [], as_json=as_json)
        return
    if files:
        raise UsageError("--tune makes its own runs: leave the logs out, or --tune")
    from ..tuning import plan
    from ..tuning.tuning import BUDGET
    from .tunings import tune as tuned

    asked = plan(
        tune,
        [*(overrides or []), *([] if duration is None else [f"duration_s={duration!r}"])],
        laws=[name.strip() for name in law.split(",")] if law is not None else (),
        budget=BUDGET if budget is None else budget,
        seed=1 if seed is None else seed,
        objective="error" if objective is None else objective,
        gravity_percent=100.0 if gravity is None else gravity,
    )
    tuned(asked, output, jobs, force=force, as_json=as_json)


def _refuse_alone(options: Mapping[str, object]) -> None:
    """Refuses options of a search where none was asked for."""
    for name, value in options.items():
        if value is not None:
            raise UsageError(f"{name} belongs to --tune SCENARIO; logs are compared as they are")


def _compare_logs(files: list[Path], *, as_json: bool) -> None:
    """Compares logs, side by side."""
    if len(files) < 2:
        raise UsageError("name two logs or more; or a scenario, as in: trilat compare --tune free")
    from ..metrics.comparison import compare as compared
    from ..metrics.comparison import comparison_facts
    from ..scenario.differences import differences
    from ..tuning.standing import standing

    logs = [opened(file) for file in files]
    names = column_names(files)
    different = differences([log.scenario for log in logs])
    remarks = {name: standing(log) for name, log in zip(names, logs, strict=True)}
    found = compared(logs, names)
    if not as_json:
        show_logs(logs, different, found, remarks)
        return
    entries = [
        {"name": name, "file": str(file), "scenario": log.scenario.name, "sha256": log.scenario.sha256}
        for name, file, log in zip(names, files, logs, strict=True)
    ]
    facts = {
        "logs": entries,
        "differences": [one._asdict() for one in different],
        "remarks": remarks,
        **comparison_facts(found),
    }
    say(json.dumps(facts, indent=2, ensure_ascii=False, allow_nan=False))


def column_names(files: list[Path]) -> list[str]:
    """Returns what logs are called: the file's name, or as much of its path as tells them apart."""
    for depth in range(1, max(len(file.parts) for file in files) + 1):
        names = ["/".join(file.with_suffix("").parts[-depth:]) for file in files]
        if len(set(names)) == len(names):
            return names
    return [f"{n}: {file}" for n, file in enumerate(files, 1)]

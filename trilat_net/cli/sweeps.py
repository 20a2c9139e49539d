"""The command that runs a scenario over a plane of its keys: sweep."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from . import maps, sweeping
from .maps import ConfirmOption, MapOption, MarginOption, ToleranceOption, WidthOption
from .options import DurationOption, SetOption
from .trials import parsed_seeds

if TYPE_CHECKING:
    from ..sweep import Plan

app = typer.Typer()


@app.command(
    epilog="Example: trilat sweep p_d_margin --over link.delay_ms=0:1600:50 --over control.d=0.2:3:0.1\n\n"
    "Example: trilat sweep p_d_margin --over link.delay_ms=100,200,400 --margin control.d=0.2:3\n\n"
    "Example: trilat sweep runs/sweep-p_d_margin-001 --cell 17"
)
def sweep(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO|RESULTS]",
            help="Name of a shipped scenario, or path of a TOML file; or of the results of a sweep.",
        ),
    ] = None,
    over: Annotated[
        list[str] | None,
        typer.Option(
            "--over",
            metavar="KEY=VALUES",
            help="An axis, as in link.delay_ms=0:1600:50 or link.order=newest,in_order; repeatable.",
        ),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds", metavar="N|LIST", help="How many per cell, or which, as in 1..20; default: one."
        ),
    ] = None,
    law: Annotated[
        str | None,
        typer.Option("--law", metavar="LAW,LAW...", help="Sweep laws as well; default: the scenario's."),
    ] = None,
    duration: DurationOption = None,
    longest: Annotated[
        float | None,
        typer.Option(
            "--longest",
            metavar="S",
            help="How long an undecided cell may run, s; default: eight times the others.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="DIR",
            help="Where results go; one that holds this sweep is gone on with. Default: runs/sweep-NAME-N.",
        ),
    ] = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="DIR", help="Go on with a sweep that was interrupted.")
    ] = None,
    cell: Annotated[
        int | None,
        typer.Option("--cell", metavar="N", help="Of results: print the command that makes a log of a cell."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", metavar="N", min=1, help="Processes; default: one per core.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Run it though it is enormous.")] = False,
    overrides: SetOption = None,
    mapped: MapOption = False,
    width: WidthOption = None,
    margin: MarginOption = None,
    tolerance: ToleranceOption = None,
    confirm: ConfirmOption = None,
) -> None:
    """Runs a scenario over a plane of its keys, in virtual time on all cores, and says what is stable.

    What is done is kept, whatever ends the sweep: the same command with the same -o, or --resume, goes on.
    """
    from ..sweep.table import polars

    polars()
    asking = {
        "--over": over,
        "--seeds": seeds,
        "--law": law,
        "--duration": duration,
        "--longest": longest,
        "--set": overrides,
    }
    maps.refuse_contradictions(mapped, width, margin, tolerance, confirm, cell)
    if cell is not None or resume is not None or _is_results(scenario):
        _refuse_more({**asking, "-o": output}.items(), "is of the sweep already: leave it out")
        _refuse_more([("--margin", margin)], "is of a scenario, and searches anew: name that")
    elif confirm is not None:
        raise UsageError("--confirm is of results: trilat sweep FOLDER --confirm 5")
    if resume is not None:
        if scenario is not None or cell is not None:
            raise UsageError("--resume goes on with the sweep of its folder: leave the rest out")
        swept = sweeping.resume(resume, jobs, yes=yes)
        maps.draw_if(mapped, swept.results, swept.folder.path, width, jobs)
    elif cell is not None:
        if scenario is None:
            raise UsageError("--cell is of results: trilat sweep FOLDER --cell N")
        sweeping.show_cell(Path(scenario), cell)
    elif scenario is not None and _is_results(scenario):
        if mapped or confirm is not None:
            maps.of_results(Path(scenario), width, confirm, jobs)
        else:
            sweeping.show_results(Path(scenario))
    elif scenario is None or not (over or law or seeds or margin):
        raise UsageError("name a scenario and what to sweep, as in: --over link.delay_ms=0:1600:50")
    else:
        axes = [*(over or []), *([] if margin is None else [maps.range_axis(margin)])]
        asked = _asked(scenario, axes, seeds, law, duration, longest, overrides)
        if margin is not None:
            maps.find_margins(asked, margin, tolerance, output, jobs)
            return
        swept = sweeping.sweep(asked, output, jobs, yes=yes)
        maps.draw_if(mapped, swept.results, swept.folder.path, width, jobs)


def _asked(
    scenario: str,
    over: list[str] | None,
    seeds: str | None,
    law: str | None,
    duration: float | None,
    longest: float | None,
    overrides: list[str] | None,
) -> "Plan":
    """Returns the sweep that options describe."""
    from ..sweep import plan

    return plan(
        scenario,
        [*(overrides or []), *([] if duration is None else [f"duration_s={duration!r}"])],
        over=over or (),
        seeds=chosen_seeds(seeds),
        laws=[name.strip() for name in law.split(",")] if law is not None else (),
        longest_s=longest,
    )


def chosen_seeds(text: str | None) -> int | list[int]:
    """Returns how many seeds a text names, as in 10, or which, as in 1..20, 1,5,9 or 7,; one for None."""
    if text is None:
        return 1
    if text.strip().isdecimal() and len(text) < 19:
        return int(text)
    return parsed_seeds(text.strip().removesuffix(","))


def _is_results(source: str | None) -> bool:
    """Returns whether a source is the results of a sweep; what is called as a shipped scenario is that."""
    from ..scenario import shipped
    from ..sweep.folder import PLAN

    if source is None or source in shipped():
        return False
    return source.endswith(".parquet") or (Path(source) / PLAN).exists()


def _refuse_more(options: Iterable[tuple[str, object]], why: str) -> None:
    for name, value in options:
        if value is not None:
            raise UsageError(f"{name} {why}")

"""What the commands have in common: their options, and how a scenario is loaded from them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ..errors import UsageError

if TYPE_CHECKING:
    from ..scenario import Scenario

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)

ScenarioArgument = Annotated[str, typer.Argument(help="Name of a shipped scenario, or path of a TOML file.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a key, as in control.Kd=5; repeatable."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Override the scenario's seed.")]
DurationOption = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="Override how long it runs, s.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what exists.")]
ListenOption = Annotated[
    list[str] | None,
    typer.Option("--listen", metavar="EP", help="Endpoint to listen at, as in tcp/192.0.2.1:7447."),
]
ConnectOption = Annotated[
    list[str] | None, typer.Option("--connect", metavar="EP", help="Endpoint to connect to; repeatable.")
]


def finite_seconds(value: float | None) -> float | None:
    """Refuses what is no time to wait."""
    if value is not None and not 0.0 <= value <= 86_400.0:
        raise UsageError(f"--join-timeout is a number of seconds from 0 to 86400, not {value:g}")
    return value


LogArgument = Annotated[Path, typer.Argument(help="An MCAP log.", metavar="FILE")]


def chosen_scenario(
    source: str, overrides: list[str] | None, duration: float | None, seed: int | None
) -> "Scenario":
    """Returns the scenario that a command's options describe."""
    from ..scenario import load

    given = list(overrides or [])
    if duration is not None:
        given.append(f"duration_s={duration!r}")
    if seed is not None:
        given.append(f"seed={seed}")
    return load(source, given)

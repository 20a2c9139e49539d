"""`trilat site`: runs one site of a scenario as one process."""

from typing import Annotated

import typer

from ..reporting.terminal_output import print_line
from .options import (
    ClockDriftOption,
    ClockOffsetOption,
    ConnectOption,
    DurationOption,
    ListenOption,
    RouterOption,
    SeedOption,
    SetOption,
    ZenohConfigOption,
    check_seconds,
    check_session_name,
    load_chosen_scenario,
    resolve_connection,
)

app = typer.Typer()


@app.command("site", epilog="Example: trilat site m1 --scenario paper")
def site_command(
    name: Annotated[str, typer.Argument(help="Name of the site in the scenario.")],
    scenario: Annotated[
        str, typer.Option("--scenario", "-s", help="Name of a shipped scenario, or path of a TOML file.")
    ],
    session: Annotated[
        str | None, typer.Option("--session", metavar="ID", help="Default: the scenario's name.")
    ] = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    router: RouterOption = None,
    zenoh_config: ZenohConfigOption = None,
    join_timeout: Annotated[
        float,
        typer.Option(
            "--join-timeout", metavar="S", help="Longest wait for the others, s.", callback=check_seconds
        ),
    ] = 60.0,
    needs_recorder: Annotated[bool, typer.Option("--needs-recorder", help="Wait for a recorder.")] = False,
    cpu: Annotated[int | None, typer.Option("--cpu", help="Pin the process to this processor.")] = None,
    stay: Annotated[
        float,
        typer.Option(
            "--stay",
            metavar="S",
            help="Wait at the end until the recorder has left, s at most.",
            callback=check_seconds,
        ),
    ] = 0.0,
    clock_offset: ClockOffsetOption = 0.0,
    clock_drift: ClockDriftOption = 0.0,
    duration: DurationOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
) -> None:
    """Runs one site as one process: for separate terminals or machines.

    Without endpoints, sites of a session find each other on this machine: each listens at a loopback port
    derived from session and site, and connects to the sites before it in the scenario.
    """
    from sites.site_parts import SiteOptions
    from sites.site_process import run_site

    from ..net.connection import default_endpoints
    from ..scenario import find_site

    chosen = load_chosen_scenario(scenario, overrides, duration, seed)
    find_site(chosen, name)
    identity = check_session_name(session or chosen.name)
    places = default_endpoints(identity, chosen.names)
    before = chosen.names[: chosen.names.index(name)]
    options = SiteOptions(
        session=identity,
        connection=resolve_connection(
            listen, connect, router, zenoh_config, [places[name]], [places[peer] for peer in before]
        ),
        join_timeout_s=join_timeout,
        needs_recorder=needs_recorder,
        cpu=cpu,
        stay_s=stay,
        clock_offset_s=clock_offset,
        clock_drift_ppm=clock_drift,
    )
    code = run_site(chosen, name, options, print_line)
    raise typer.Exit(code)

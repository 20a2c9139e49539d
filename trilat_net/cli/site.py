"""`trilat site`: runs one site of a scenario as one process."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ..scenario import Scenario

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options


def site_command(
    name: Annotated[
        str,
        typer.Argument(help="Name of the site in the scenario.", autocompletion=options.complete_sites),
    ],
    scenario: Annotated[
        str,
        typer.Option(
            "--scenario",
            "-s",
            help="Name of a shipped scenario, or path of a TOML file.",
            autocompletion=options.complete_scenarios,
        ),
    ],
    session: Annotated[str | None, options.value("--session", "ID", "Default: the scenario's name.")] = None,
    listen: options.ListenOption = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    insecure: options.InsecureOption = False,
    join_timeout: Annotated[
        float, options.seconds("--join-timeout", "Longest wait for the others, s.")
    ] = 60.0,
    needs_recorder: options.NeedsRecorderOption = False,
    cpu: Annotated[int | None, typer.Option("--cpu", help="Pin the process to this processor.")] = None,
    stay: Annotated[
        float,
        options.seconds("--stay", "At the end, wait until the recorder has left, at most this long, s."),
    ] = 0.0,
    without: Annotated[
        list[str] | None,
        options.value(
            "--without",
            "SITE",
            "Option of the first site: begin without SITE, which may join later; repeatable.",
        ),
    ] = None,
    leave_timeout: Annotated[
        float | None,
        options.seconds(
            "--leave-timeout",
            "Under glide: time to go on without a site that has left, s; default: to the end.",
        ),
    ] = None,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
) -> None:
    """Runs one site as one process: for separate terminals or machines.

    Without endpoints, the sites of a session find each other on this machine: each listens at a loopback port
    derived from session and site, and connects to the sites that precede it in the scenario.
    """
    from sites.site_parts import SiteOptions
    from sites.site_process import run_site

    from ..net.connection import default_endpoints
    from ..scenario import find_site

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    find_site(chosen, name)
    identity = options.check_session_name(session or chosen.name)
    places = default_endpoints(identity, chosen.names, encrypted=keys is not None)
    before = chosen.names[: chosen.names.index(name)]
    ways = listen, connect, router, zenoh_config, [places[name]], [places[peer] for peer in before]
    connection = options.resolve_connection(*ways, keys, insecure=insecure).require(name)
    how = SiteOptions(
        session=identity,
        connection=connection,
        join_timeout_s=join_timeout,
        needs_recorder=needs_recorder,
        cpu=cpu,
        stay_s=stay,
        clock_offset_s=clock_offset,
        clock_drift_ppm=clock_drift,
        without=_check_without(chosen, name, without or []),
        leave_timeout_s=leave_timeout,
    )
    raise typer.Exit(run_site(chosen, name, how, terminal.print_line))


def _check_without(scenario: "Scenario", name: str, without: list[str]) -> tuple[str, ...]:
    """Refuses sites that cannot come late."""
    from ..scenario import find_site

    for late in without:
        find_site(scenario, late)
        if name != scenario.names[0] or late == name:
            raise UsageError(
                f"--without is an option of {scenario.names[0]}, the first site, and names other sites"
            )
        if not scenario.sites_may_return:
            raise UsageError('--without asks for on_stale.action = "glide" at every site')
    return tuple(without)

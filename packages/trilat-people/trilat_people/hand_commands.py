"""The commands `trilat hand` and `trilat identify hand`.

`trilat hand` connects an operator to an arm of a session: either a user's program, or a person
with an input device such as a SpaceMouse. `trilat identify hand` estimates the stiffness,
damping and mass of a hand that held an arm from the log of the run.
"""

from typing import Annotated

import typer

from trilat_net.app import options, seconds, value
from trilat_net.errors import UsageError
from trilat_net.presentation import terminal_output as terminal
from trilat_net.signals import Interrupt


@options.command(
    "m2 --scenario my_run.toml",
    "m1 --session play --device haply_inverse3",
    page="docs/sessions/devices.md",
)
def hand_command(
    context: typer.Context,
    name: Annotated[str, typer.Argument(autocompletion=options.complete_sites)],
    scenario: Annotated[
        str, typer.Option("--scenario", "-s", autocompletion=options.complete_scenarios)
    ] = "",
    session: Annotated[str | None, value("--session", "ID")] = None,
    join_timeout: Annotated[
        float, seconds("--join-timeout", "Longest wait for the site, in s.")
    ] = 60.0,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
    device: Annotated[str | None, value("--device", "NAME[=ADDRESS]")] = None,
    *,
    reach: options.Reach,
) -> None:
    """Runs your program, or a device that you hold, as a user.

    A hand acts as the user of a site. A class of your own (kind = "own", process = true) runs
    in this process: it reads the state of the site and decides how to move the arm, and the
    site applies each decision after the hand's delay_ms. A device (kind = "live") leads an arm
    of a session that is already running.

    Options:
        name: Name of the site in the scenario.
        scenario: For a class: scenario that the site runs, as the name of a shipped scenario or
            the path of a TOML file.
        session: Name of the session; required with --device, otherwise the default is the name
            of the scenario.
        device: Device in your hand: haply_inverse3 or spacemouse. The scenario of the session
            defines how the device leads the arm.
    """
    if device is not None:
        scenario_options = {"--scenario", "--duration", "--seed", "--set"}
        extra = scenario_options & set(options.list_used_options(context))
        if extra:
            raise UsageError(
                f"--device leads an arm of a running session: leave out {min(extra)}"
            )
        return _lead_by_device(
            device=device, name=name, session=session, reach=reach, timeout_s=join_timeout
        )
    if not scenario:
        raise UsageError(
            "a class of your own needs --scenario; a device that you hold needs --device"
        )

    from sites import run_hand
    from trilat_net.net import OPERATOR, DefaultEndpoints

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    session_name = options.check_session_name(session or chosen.name)
    default_endpoints = DefaultEndpoints(session_name)
    endpoints = default_endpoints.by_site(chosen.names, encrypted=reach.keys is not None)
    chosen.find_site(name)
    member = options.MemberOptions(None, *reach)
    connection = member.resolve((), [endpoints[name]]).require(OPERATOR)
    with Interrupt() as interrupt:
        run_hand(
            scenario=chosen,
            name=name,
            session=session_name,
            connection=connection,
            interrupt=interrupt,
            say=terminal.print_line,
            timeout_s=join_timeout,
        )
    if interrupt.is_requested():
        raise typer.Exit(interrupt.exit_code)
    return None


def _lead_by_device(
    device: str, name: str, session: str | None, reach: options.Reach, timeout_s: float
) -> None:
    """Lets the user move an arm of a running session with an input device.

    Returns when the session ends, or on Ctrl-C.

    Args:
        device: Name of the device, with its address if needed, as NAME=ADDRESS.
        name: Name of the site of the arm.
        session: Name of the session.
        reach: Command-line options for connecting to the session.
        timeout_s: Maximum time to wait for the site, in s.
    """
    from .devices import open_device

    running = reach.open_session(session or "")
    opened_device = open_device(device)
    with Interrupt() as interrupt:
        running.lead(
            name,
            opened_device,
            stopped=interrupt.is_requested,
            say=terminal.print_line,
            timeout_s=timeout_s,
        )
    if interrupt.is_requested():
        raise typer.Exit(interrupt.exit_code)


@options.command("run.mcap --site m1 --json > m1.json", page="docs/studies/measured-hands.md")
def identify_hand_command(
    file: options.LogsArgument,
    site: Annotated[
        str,
        value("--site", "SITE", "Site of the held arm.", autocompletion=options.complete_sites),
    ] = "m1",
    as_json: options.JsonOption = False,
) -> None:
    """Identifies the mass, damping and stiffness of the hand that holds an arm.

    A sum of sines must move the arm during the run, so the scenario needs an operator of kind
    "multisine" at any site (docs/studies/measured-hands.md). `trilat linear
    --operators` reads the JSON of the result.
    """
    from .hand_impedance import identify_hand

    log = terminal.open_with_progress(*file)
    with terminal.progress_lines(f"identifying the hand at {site}"):
        identified = identify_hand(log, site)
    terminal.print_result(identified, as_json=as_json)

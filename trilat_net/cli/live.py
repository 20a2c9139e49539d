"""`trilat live`: a session with a page that shows it and takes part, or a page of a session that runs."""

from functools import partial
from typing import Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options
from .demo import run_and_report


def live_command(
    context: typer.Context,
    scenario: options.ScenarioArgument = "play",
    session: Annotated[
        str | None, options.value("--session", "ID", "Show this running session instead of starting one.")
    ] = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    host: Annotated[
        str,
        typer.Option(
            "--host", help="Address of the page; beyond loopback it needs --insecure and has a token."
        ),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0: any.")] = 0,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow --host beyond loopback, without encryption.")
    ] = False,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open a browser if there is one.")
    ] = True,
    duration: options.DurationOption = None,
    folder: options.ResultsOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
    force: options.ForceOption = False,
    png: options.PngOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Runs a scenario live, with a page on which to watch it and take hold of the arms.

    The page's button or Ctrl-C ends the session; then its log is verified and reported. With --session the
    page shows a session that already runs, and leaves it running.
    """
    from live.page_server import LONGEST_S, PageOptions, attend_with_page, show_on_page
    from live.terminal_watch import watch_session

    from ..net.clock import SystemClock

    clock, say = SystemClock(), terminal.print_line
    page = PageOptions(host, port, insecure, browser)
    page.check()
    if session is not None:
        alone = {"--duration", "--out", "--seed", "--set", "--force", "--png", "--json", "scenario"}
        if extra := alone & set(options.given_options(context)):
            raise UsageError(
                f"--session shows a session that runs already: leave out {', '.join(sorted(extra))}"
            )
        connection = options.resolve_client_connection(connect, router, zenoh_config, keys)
        name = options.check_session_name(session)
        show = partial(show_on_page, page, clock, name, say)
        raise typer.Exit(watch_session(name, connection, clock, show, say, 10.0))
    if connect or router or zenoh_config or keys:
        raise UsageError("--connect, --router, --zenoh-config and --keys go with --session")
    longest_s = LONGEST_S if duration is None else duration
    chosen = options.load_chosen_scenario(scenario, overrides, longest_s, seed)
    attend = partial(attend_with_page, page, clock)
    run_and_report(chosen, folder, attend, force=force, png=png, as_json=as_json)

"""The commands `trilat live` and `trilat watch`, which show a running session to people.

`trilat live` serves a web page on which people can also take part: they move arms, stop them,
and change settings. `trilat watch` shows a session in the terminal or on such a page.
"""

from functools import partial
from typing import Annotated

import typer

from trilat_net.app import options, run_and_report, value
from trilat_net.errors import UsageError
from trilat_net.net import SystemClock
from trilat_net.presentation import terminal_output as terminal

from .page_options import PageServing

_START_OPTIONS = {
    "--duration",
    "--out",
    "--seed",
    "--set",
    "--force",
    "--png",
    "--json",
    "scenario",
}
"""Options of `trilat live` that only concern a session that it starts."""


@options.command("play", "--session paper", page="docs/sessions/live-page.md")
def live_command(
    context: typer.Context,
    scenario: options.ScenarioArgument = "play",
    session: Annotated[str | None, value("--session", "ID")] = None,
    *,
    reach: options.Reach,
    serving: PageServing,
    run: options.RunOptions,
) -> None:
    """Runs a scenario live on a web page, where you lead the arms.

    A button on the page or Ctrl-C ends the session; then its log is verified and a report is
    written. Whatever duration the scenario states, the session ends after an hour, unless
    --duration or --set duration_s=S sets another duration. With --session, the page shows a
    session that is already running, and leaves it running.

    Options:
        session: Show this running session instead of starting one.
    """
    from .live_page.page_server import MAX_DURATION_S, PageAttendant, PageOptions, show_on_page
    from .live_page.terminal_watch import watch_session

    clock = SystemClock()
    say = terminal.print_line
    page = PageOptions(*serving)
    page.check()

    if session is not None:
        extra = _START_OPTIONS & set(options.list_used_options(context))
        if extra:
            raise UsageError(
                "--session shows a session that is already running: "
                f"leave out {', '.join(sorted(extra))}"
            )
        connection = reach.resolve()
        name = options.check_session_name(session)
        show = partial(show_on_page, page, clock, name, say)
        raise typer.Exit(
            watch_session(
                session=name,
                connection=connection,
                clock=clock,
                show=show,
                say=say,
                timeout_s=10.0,
            )
        )

    if any(reach):
        raise UsageError(
            "--connect, --router, --zenoh-config and --keys can be used only with --session"
        )

    with PageAttendant(page, clock) as attendant:
        run_and_report(run.load(scenario, MAX_DURATION_S), run, attendant)


@options.command("--session paper", page="docs/sessions/live-page.md")
def watch_command(
    session: Annotated[str, value("--session", "ID", "Session to watch.")],
    *,
    as_site: Annotated[
        str, value("--as", "SITE", "Show only the view of this site's user.")
    ] = "",
    reach: options.Reach,
    timeout: options.AnswerOption = 10.0,
) -> None:
    """Shows a running session in the terminal.

    The command ends with the session or with Ctrl-C. Each site has a line with its joint
    angles, the size |e| of its synchronisation error, its torque and mode, the age of the
    newest sample of each peer, and the holder of the arm. The line above the sites shows V, the
    energy function of the stability proof. Without endpoints, the command connects to the
    loopback port of the first site and asks for the other sites.
    """
    from .live_page.terminal_watch import show_in_terminal, watch_session

    name = options.check_session_name(session)
    clock = SystemClock()
    show = partial(show_in_terminal, clock, name, as_site, terminal.out)
    raise typer.Exit(
        watch_session(
            session=name,
            connection=reach.resolve(),
            clock=clock,
            show=show,
            say=terminal.print_line,
            timeout_s=timeout,
        )
    )

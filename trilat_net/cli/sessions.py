"""Commands that take part in a live session: demo, site, record."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from ..errors import RunFailed, UsageError
from .opening import opened
from .options import (
    ClockDriftOption,
    ClockOffsetOption,
    ConnectOption,
    DurationOption,
    ForceOption,
    ListenOption,
    RouterOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    ViewsOption,
    ZenohConfigOption,
    chosen_connection,
    chosen_scenario,
    err,
    finite_seconds,
    out,
    say,
    session_name,
)
from .progress import bar
from .show import show_conclusion

app = typer.Typer()


@app.command(epilog="Example: trilat demo paper --duration 10 --set control.Kd=5")
def demo(
    scenario: ScenarioArgument = "paper",
    duration: DurationOption = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where results go; default runs/NAME-N.")
    ] = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Runs a scenario live: every site and a recorder as processes over Zenoh, then verifies and reports."""
    from sites.demo import run_demo, session_name
    from sites.display import Display

    from ..conclusion import conclude
    from ..results import results_folder

    chosen = chosen_scenario(scenario, overrides, duration, seed)
    results = results_folder(folder, chosen.name, force=force)
    out.print(f"{escape(chosen.title or chosen.name)}")
    out.print(
        f"{chosen.duration_s:g} s live: {', '.join(chosen.names)} and a recorder, "
        f"session {session_name(chosen)}; Ctrl-C ends it"
    )
    with Display(chosen, out) as display:
        outcome = run_demo(chosen, results, display)
    for problem in outcome.problems:
        err.print(f"error: {escape(problem)}", soft_wrap=True)
    if outcome.interrupted:
        kept = f"; {outcome.log} holds what there was" if outcome.log.exists() else ""
        err.print(f"interrupted{escape(kept)}", soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not outcome.log.exists():
        raise typer.Exit(1)
    out.print("checking the log and drawing ...")
    log = opened(outcome.log)
    with bar("executing and drawing") as progress:
        conclusion = conclude(log, results, progress)
    show_conclusion(conclusion)
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(1)


@app.command(epilog="Example: trilat site m1 --scenario paper")
def site(
    name: Annotated[str, typer.Argument(help="Which site of the scenario this is.")],
    scenario: Annotated[str, typer.Option("--scenario", "-s", help="Shipped name or path.")],
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
            "--join-timeout", metavar="S", help="How long to wait for the others, s.", callback=finite_seconds
        ),
    ] = 60.0,
    needs_recorder: Annotated[
        bool, typer.Option("--needs-recorder", help="Do not begin without a recorder.")
    ] = False,
    cpu: Annotated[int | None, typer.Option("--cpu", help="Stay on this processor.")] = None,
    stay: Annotated[
        float,
        typer.Option(
            "--stay", metavar="S", help="Let the recorder leave first: s at most.", callback=finite_seconds
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
    that follows from session and site, and connects to the sites before it in the scenario.
    """
    from sites.options import Options
    from sites.process import run_site

    from ..net.endpoints import default_endpoints
    from ..scenario import site_named

    chosen = chosen_scenario(scenario, overrides, duration, seed)
    site_named(chosen, name)
    identity = session_name(session or chosen.name)
    places = default_endpoints(identity, chosen.names)
    before = chosen.names[: chosen.names.index(name)]
    options = Options(
        session=identity,
        connection=chosen_connection(
            listen, connect, router, zenoh_config, [places[name]], [places[peer] for peer in before]
        ),
        join_timeout_s=join_timeout,
        needs_recorder=needs_recorder,
        cpu=cpu,
        stay_s=stay,
        clock_offset_s=clock_offset,
        clock_drift_ppm=clock_drift,
    )
    code = run_site(chosen, name, options, say)
    raise typer.Exit(code)


@app.command(epilog="Example: trilat record --session paper -o run.mcap --split-duration 600")
def record(
    session: Annotated[str, typer.Option("--session", metavar="ID", help="Which session to record.")],
    listen: ListenOption = None,
    connect: ConnectOption = None,
    router: RouterOption = None,
    zenoh_config: ZenohConfigOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Default: SESSION.mcap.")
    ] = None,
    join_timeout: Annotated[
        float | None,
        typer.Option(
            "--join-timeout",
            metavar="S",
            help="How long to wait for it to begin, s; default: for ever.",
            callback=finite_seconds,
        ),
    ] = None,
    clock_offset: ClockOffsetOption = 0.0,
    clock_drift: ClockDriftOption = 0.0,
    concluded: Annotated[
        bool, typer.Option("--conclude", help="Verify and report it afterwards, in the folder of the log.")
    ] = False,
    include: Annotated[
        list[str] | None,
        typer.Option(
            "--include", metavar="KEYS", help="Record these channels alone, as '**/m1/**'; repeatable."
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        typer.Option("--exclude", metavar="KEYS", help="Leave these channels out, as '**/link'; repeatable."),
    ] = None,
    split_size: Annotated[
        float | None, typer.Option("--split-size", metavar="MIB", help="Parts of at most this size, MiB.")
    ] = None,
    split_duration: Annotated[
        float | None, typer.Option("--split-duration", metavar="S", help="Parts of this duration, s.")
    ] = None,
    carry_on: Annotated[
        bool, typer.Option("--continue", help="Where the log exists, write the part that follows it.")
    ] = False,
    durable: Annotated[
        bool, typer.Option("--durable", help="Put every 100 ms onto the disk, not every second.")
    ] = False,
    views: ViewsOption = "100",
    force: ForceOption = False,
) -> None:
    """Records one session, from its epoch to its end or to Ctrl-C.

    Without endpoints it asks the first site, at its loopback port, who the others are. Parts are called
    FILE-001.mcap and so on. A file bears .active at its end until it is finished.
    """
    from recorder.process import record_session

    from ..log.choice import choice
    from ..log.names import existing
    from ..log.parts import storage
    from ..log.views import views_rate
    from ..net.clock import system_clock

    connection = chosen_connection(listen, connect, router, zenoh_config, [], None)
    path = output if output is not None else Path(f"{session_name(session)}.mcap")
    place = storage(
        path,
        split_mib=split_size,
        split_s=split_duration,
        choice=choice(include or [], exclude or []),
        force=force,
        carry_on=carry_on,
        durable=durable,
        views_hz=views_rate(views),
    )
    place.first()  # a name that is taken is refused before anybody waits
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{path}: cannot be written: {path.parent} is no folder that takes files")
    page = path.parent / "report.html"
    if concluded and page.exists() and not force:
        raise UsageError(f"{page}: exists; give the log a folder of its own, or use --force")
    clock = system_clock(clock_offset, clock_drift)
    then = (lambda: _conclude(list(existing(path).values()))) if concluded else lambda: None
    code = record_session(session_name(session), place, connection, join_timeout, clock, say, then)
    raise typer.Exit(code)


def _conclude(parts: list[Path]) -> None:
    """Verifies and reports a log, into its own folder."""
    from ..conclusion import conclude

    out.print("checking the log and drawing ...")
    path = parts[0]
    log = opened(*parts)
    with bar("executing and drawing") as progress:
        conclusion = conclude(log, path.parent, progress)
    show_conclusion(conclusion)
    if not conclusion.passed:
        raise RunFailed(f"{path}: failed a check")
    if ended := next((event for event in log.events if event.kind in ("diverged", "failed")), None):
        raise RunFailed(f"{path}: {ended.text}")

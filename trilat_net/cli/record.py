"""`trilat record`: records one session into an MCAP log, in one file or in parts."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from ..errors import LawWithheld, RunFailed, UsageError
from ..reporting import terminal_output as terminal
from . import options


def record_command(
    session: Annotated[str, options.value("--session", "ID", "Session to record.")],
    listen: options.ListenOption = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    insecure: options.InsecureOption = False,
    output: Annotated[
        Path | None,
        options.value(
            "-o --out --output",
            "FILE",
            "Default: SESSION.mcap; with --conclude run.mcap in the next free folder.",
        ),
    ] = None,
    join_timeout: Annotated[
        float | None,
        options.seconds("--join-timeout", "Longest wait for the session to begin, s; default: no limit."),
    ] = None,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
    concluded: Annotated[
        bool,
        typer.Option("--conclude", help="Afterwards verify the log, and write a report into its folder."),
    ] = False,
    include: Annotated[
        list[str] | None,
        options.value("--include", "KEYS", "Record only these channels, as in '**/m1/**'; repeatable."),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        options.value("--exclude", "KEYS", "Leave these channels out, as in '**/link'; repeatable."),
    ] = None,
    split_size: Annotated[
        float | None,
        options.value("--split-size", "MIB", "Split the log into parts of at most this size, MiB."),
    ] = None,
    split_duration: Annotated[
        float | None, options.value("--split-duration", "S", "Split the log into parts of this duration, s.")
    ] = None,
    carry_on: Annotated[
        bool, typer.Option("--continue", help="If the log exists, write its next part.")
    ] = False,
    durable: Annotated[
        bool, typer.Option("--durable", help="Sync to the disk at every flush instead of every second.")
    ] = False,
    views: options.ViewsOption = "100",
    force: options.ForceOption = False,
    png: options.PngOption = False,
) -> None:
    """Records a session into an MCAP log, from its epoch to its end or to Ctrl-C.

    Without endpoints it asks the first site, at its loopback port, for the others. Parts are named
    FILE-001.mcap and so on. The name of a file ends in .active until the file is finished.
    """
    from recorder.record_process import record_session

    from ..files import refuse_existing
    from ..log.log_layout import find_parts, parse_channel_filter
    from ..log.log_writer import LogStorage, parse_split
    from ..log.ros2.viz_channels import parse_viz_rate
    from ..net.clock import make_system_clock
    from ..net.topics import RECORDER

    options.check_session_name(session)
    connection = options.resolve_connection(
        listen, connect, router, zenoh_config, [], None, keys, insecure=insecure
    ).require(RECORDER)
    path = _choose_path(output, session, concluded=concluded)
    place = LogStorage(
        path,
        force=force,
        durable=durable,
        split_bytes=parse_split("--split-size", "MiB", split_size, 1 << 20),
        split_ns=parse_split("--split-duration", "seconds", split_duration, 10**9),
        carry_on=carry_on,
        choice=parse_channel_filter(include or [], exclude or []),
        views_hz=parse_viz_rate(views),
    )
    place.first()  # refuses a taken name before anything waits
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{path}: cannot be written: {path.parent} is not a writable folder")
    page = path.parent / "report.html"
    if concluded:
        refuse_existing(page, force=force)
    clock = make_system_clock(clock_offset, clock_drift)
    then = (lambda: _conclude(list(find_parts(path).values()), png=png)) if concluded else lambda: None
    try:
        code = record_session(session, place, connection, join_timeout, clock, terminal.print_line, then)
    finally:
        if concluded and output is None:
            with suppress(OSError):
                path.parent.rmdir()  # nothing came into it
    raise typer.Exit(code)


def _choose_path(output: Path | None, session: str, *, concluded: bool) -> Path:
    """Returns where the log goes; the folder of a log with a report is made."""
    from ..files import make_folder, make_results_folder

    if not concluded:
        return output if output is not None else Path(f"{session}.mcap")
    if output is None:
        return make_results_folder(None, session, force=False) / "run.mcap"
    make_folder(output.parent)
    return output


def _conclude(parts: list[Path], *, png: bool) -> None:
    from ..execution.log_checks import choose_exit_code

    log, conclusion = terminal.conclude_files(parts, parts[0].parent, png=png)
    if (code := choose_exit_code(conclusion.lines)) == LawWithheld.exit_code:
        raise LawWithheld(f"{parts[0]}: not all was judged: it needs trilat verify --law FILE")
    if code:
        raise RunFailed(f"{parts[0]}: failed a check")
    if ended := next((event for event in log.events if event.kind in ("diverged", "failed")), None):
        raise RunFailed(f"{parts[0]}: {ended.text}")

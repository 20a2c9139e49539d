"""`trilat doctor`: checks if a session can run on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from ..reporting.session_text import MARKS
from . import options


def doctor_command(
    listen: options.ListenOption = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    insecure: options.InsecureOption = False,
    session: Annotated[
        str | None, options.value("--session", "ID", "Also ask the members of this session for their clocks.")
    ] = None,
    folder: Annotated[Path, options.value("--out -o", "DIR", "Folder where results would go.")] = Path(
        "runs"
    ),
    as_json: options.JsonOption = False,
) -> None:
    """Checks keys, endpoints, clocks, real-time rights, disk and processors: one line per finding.

    Give it the options that a site, recorder or router on this machine would get. Exit code 1 if a check
    fails.
    """
    from sites.doctor import examine_machine

    from ..net.clock import SystemClock
    from ..net.connection import resolve_member_connection
    from ..net.zenoh_bus import read_zenoh_file

    file = None if zenoh_config is None else read_zenoh_file(zenoh_config)
    connection = resolve_member_connection(listen, connect, router, file, [], None)
    name = None if session is None else options.check_session_name(session)
    findings = []
    for finding in examine_machine(connection, keys, folder, name, SystemClock(), insecure=insecure):
        findings.append(finding)
        if not as_json:
            terminal.print_marked(MARKS[finding.state], f"{finding.check:<10}  {finding.text}")
    if as_json:
        terminal.print_json([finding._asdict() for finding in findings])
    if any(finding.state == "fail" for finding in findings):
        raise typer.Exit(1)

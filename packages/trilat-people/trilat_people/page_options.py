"""Command-line options for serving a web page: address, port, encryption and browser.

Shared by all commands that show a running session on a web page, so an option has the same name
and meaning in each of them.
"""

from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from trilat_net.app import value


class PageServing(NamedTuple):
    """Options of a command that serves a web page: address, encryption, opening a browser.

    Shared by `trilat live`, `trilat watch` and experiments with people.
    """

    host: Annotated[
        str,
        value(
            "--host",
            "ADDRESS",
            "Address on which the page is served; any address other than loopback requires "
            "--tls or --insecure.",
        ),
    ] = "127.0.0.1"
    port: Annotated[
        int,
        typer.Option(
            "--port",
            min=0,
            max=65535,
            help="Port on which the page is served; 0 selects any free port.",
        ),
    ] = 0
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure", help="Allow a --host other than loopback without encryption."
        ),
    ] = False
    browser: Annotated[
        bool,
        typer.Option(
            "--browser/--no-browser",
            help="Open the page in a browser, if this machine has a browser.",
        ),
    ] = True
    tls: Annotated[
        Path | None,
        value("--tls", "DIR", "Encrypt the page with the member's keys in this folder."),
    ] = None

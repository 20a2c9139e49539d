"""Opens a log in Rerun, the viewer that the extra `view` brings.

Law: the log itself is opened where that shows something: a finished file with standard channels. Of any other
what Rerun can read is made first, in a folder that is gone when the viewer is.
"""

import os
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import RunFailed, UsageError
from ..extra import extra
from ..log.names import ACTIVE
from ..log.reader import Log
from ..log.ros2 import export_ros2
from ..log.standard import channels_of
from .board import board
from .layout import save_layout

Run = Callable[[list[str], Mapping[str, str]], int]
"""Runs a command with an environment, and returns its exit code."""

_PROGRAM = (sys.executable, "-m", "rerun")
_OWN = "127.0.0.1"
_QUIET = {"RERUN_ANALYTICS_ENABLED": "false", "RUST_LOG": "warn"}
"""Nothing is told to anybody, unless a person's own settings say so."""


class Show(NamedTuple):
    """How to show a log.

    Attributes:
        full: every record, not the channels that the log has beside them.
        web: to a browser, which a person opens.
        save: not at all: what Rerun would show goes into this file, `.rrd`.
    """

    full: bool = False
    web: bool = False
    save: Path | None = None


def open_viewer(
    paths: Sequence[Path],
    opened: Callable[[], Log],
    show: Show,
    say: Callable[[str], None],
    run: Run | None = None,
) -> None:
    """Shows a log, until its viewer is closed.

    Args:
        paths: its file, or its parts.
        opened: opens it, where it has to be read.
        show: how.
        say: tells a person what happens.
        run: runs Rerun; else as a process.

    Raises:
        UsageError: Rerun is not installed, or there is nothing to show it on.
        LogError: the log cannot be read.
        RunFailed: Rerun ended badly.
    """
    extra("rerun", "view", "viewers")
    if show.save is None and not show.web:
        _needs_display()
    with tempfile.TemporaryDirectory(prefix="trilat-view-") as folder:
        path, named = paths[0], Path(folder) / f"{application(paths[0])}.mcap"
        if show.full or len(paths) > 1 or not channels_of(path):
            say("making standard channels of every record ...")
            export_ros2(opened(), named)
            path = named
        elif path.name != named.name:
            named.symlink_to(path.resolve())
            path = named
        layout = Path(folder) / "layout.rbl"
        save_layout(board(channels_of(path)), path.stem, layout)
        for command in _commands(show, path, layout, say):
            code = (run or _run)([*_PROGRAM, *command], {**_QUIET, **os.environ})
            if code:
                raise RunFailed(f"Rerun ended with exit code {code}")


def application(path: Path) -> str:
    """Returns what Rerun shall call a log: by its name, in the letters that it takes for that."""
    stem = path.name.removesuffix(ACTIVE).removesuffix(".mcap")
    return re.sub(r"[^A-Za-z0-9_-]", "-", stem).lstrip("-") or "log"


def _needs_display() -> None:
    """Refuses a window where there can be none.

    Raises:
        UsageError: there is no display.
    """
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        raise UsageError("there is no display here; show it in a browser with --web, or keep it with --save")


def _commands(show: Show, log: Path, layout: Path, say: Callable[[str], None]) -> list[list[str]]:
    """Returns what Rerun is called with, one after the other; it listens on this machine alone."""
    if show.save is not None:
        return _saving(log, layout, show.save)
    port = _free_port()
    command = [str(log), str(layout), "--bind", _OWN, "--port", str(port)]
    if show.web:
        page = _free_port()
        say(f"open http://{_OWN}:{page}/?url=rerun%2Bhttp%3A%2F%2F{_OWN}%3A{port}%2Fproxy; Ctrl-C ends it")
        return [[*command, "--serve-web", "--web-viewer-port", str(page)]]
    return [command]


def _saving(log: Path, layout: Path, save: Path) -> list[list[str]]:
    """Returns how Rerun writes what it would show.

    Its own `--save` of several files ends with the first of them that was read, and what the others had not
    yet given is missing (measured with 0.41: up to all of a log).
    """
    recording = layout.with_name("log.rrd")
    return [
        ["mcap", "convert", str(log), "--application-id", log.stem, "--output", str(recording)],
        ["rrd", "merge", str(recording), str(layout), "--output", str(save)],
    ]


def _free_port() -> int:
    """Returns a port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((_OWN, 0))
        port: int = probe.getsockname()[1]
        return port


def _run(command: list[str], environment: Mapping[str, str]) -> int:
    return subprocess.run(command, env=environment, check=False).returncode

"""Display of a log in the Rerun viewer, which the extra `view` installs.

Invariant: a finished file with standard channels is opened itself. Any other log is exported as a ROS 2
bag into a temporary folder first.
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
from ..files import import_extra
from ..log.log_layout import ACTIVE_SUFFIX
from ..log.log_reader import Log
from ..log.ros2.ros2_messages import read_ros2_channels
from .plot_layout import build_plot_layout, save_blueprint
from .ros2_bag import export_ros2

RunCommand = Callable[[list[str], Mapping[str, str]], int]
"""Runs a command with an environment, and returns its exit code."""

_PROGRAM = (sys.executable, "-m", "rerun")
_OWN = "127.0.0.1"
_QUIET = {"RERUN_ANALYTICS_ENABLED": "false", "RUST_LOG": "warn"}
"""Nothing is told to anybody, unless a person's own settings say so."""


class ViewerOptions(NamedTuple):
    """How to show a log.

    Attributes:
        full: every record, not the channels that the log has beside them.
        web: to a browser, which a person opens.
        save: not at all: what Rerun would show goes into this file, `.rrd`.
    """

    full: bool = False
    web: bool = False
    save: Path | None = None


def open_rerun(
    paths: Sequence[Path],
    opened: Callable[[], Log],
    show: ViewerOptions,
    say: Callable[[str], None],
    run: RunCommand | None = None,
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
    import_extra("rerun", "view", "viewers")
    if show.save is None and not show.web:
        _needs_display()
    with tempfile.TemporaryDirectory(prefix="trilat-view-") as folder:
        path, named = paths[0], Path(folder) / f"{make_application_id(paths[0])}.mcap"
        if show.full or len(paths) > 1 or not read_ros2_channels(path):
            say("making standard channels of every record ...")
            export_ros2(opened(), named)
            path = named
        elif path.name != named.name:
            named.symlink_to(path.resolve())
            path = named
        layout = Path(folder) / "layout.rbl"
        save_blueprint(build_plot_layout(read_ros2_channels(path)), path.stem, layout)
        for command in _commands(show, path, layout, say):
            code = (run or _run)([*_PROGRAM, *command], {**_QUIET, **os.environ})
            if code:
                raise RunFailed(f"Rerun ended with exit code {code}")


def make_application_id(path: Path) -> str:
    """Returns what Rerun shall call a log: by its name, in the letters that it takes for that."""
    stem = path.name.removesuffix(ACTIVE_SUFFIX).removesuffix(".mcap")
    return re.sub(r"[^A-Za-z0-9_-]", "-", stem).lstrip("-") or "log"


def _needs_display() -> None:
    """Refuses a window where there can be none.

    Raises:
        UsageError: there is no display.
    """
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        raise UsageError("there is no display here; show it in a browser with --web, or keep it with --save")


def _commands(show: ViewerOptions, log: Path, layout: Path, say: Callable[[str], None]) -> list[list[str]]:
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

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
"""No telemetry, unless the user's own settings ask for it."""


class ViewerOptions(NamedTuple):
    """How to show a log: every record instead of decimated channels, in a browser, or into a file, `.rrd`."""

    full: bool = False
    web: bool = False
    save: Path | None = None


def open_rerun(
    paths: Sequence[Path],
    opened: Callable[[], Log],
    show: ViewerOptions,
    say: Callable[[str], None],
    run: RunCommand = lambda command, environment: subprocess.run(command, env=environment).returncode,
) -> None:
    """Shows a log in its file or parts, until its viewer is closed.

    The log is opened by `opened` if it has to be read; `say` prints a line, and `run` runs Rerun.

    Raises:
        UsageError: Rerun is not installed, or there is no display.
        LogError: the log cannot be read.
        RunFailed: Rerun ended badly.
    """
    import_extra("rerun", "view", "viewers")
    displays = {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}
    if show.save is None and not show.web and sys.platform == "linux" and not displays:
        raise UsageError("there is no display here; show it in a browser with --web, or keep it with --save")
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
            if code := run([*_PROGRAM, *command], {**_QUIET, **os.environ}):
                raise RunFailed(f"Rerun ended with exit code {code}")


def make_application_id(path: Path) -> str:
    """Returns the name of a log in the letters that Rerun allows for an application."""
    stem = path.name.removesuffix(ACTIVE_SUFFIX).removesuffix(".mcap")
    return re.sub(r"[^A-Za-z0-9_-]", "-", stem).lstrip("-") or "log"


def _commands(show: ViewerOptions, log: Path, layout: Path, say: Callable[[str], None]) -> list[list[str]]:
    """Returns the arguments of one call of Rerun after the other; it listens on this machine alone."""
    if show.save is not None:
        # Rerun's own `--save` of several files ends with the first that was read; the rest of the others is
        # missing (measured with 0.41: up to all of a log)
        recording = layout.with_name("log.rrd")
        return [
            ["mcap", "convert", str(log), "--application-id", log.stem, "--output", str(recording)],
            ["rrd", "merge", str(recording), str(layout), "--output", str(show.save)],
        ]
    port = _free_port()
    command = [str(log), str(layout), "--bind", _OWN, "--port", str(port)]
    if show.web:
        page = _free_port()
        say(f"open http://{_OWN}:{page}/?url=rerun%2Bhttp%3A%2F%2F{_OWN}%3A{port}%2Fproxy; Ctrl-C ends it")
        return [[*command, "--serve-web", "--web-viewer-port", str(page)]]
    return [command]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_OWN, 0))
        port: int = probe.getsockname()[1]
        return port

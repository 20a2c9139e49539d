"""`trilat`, run in this process through its own `main`, and the required form of its errors."""

import contextlib
import io
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

from typer.main import get_command

from trilat_net.app.cli import app, main
from trilat_net.core.step.jit import compiling_notice
from trilat_net.own_code.imported_code import allowed_code
from trilat_net.presentation import terminal_output

COMMAND = [sys.executable, "-m", "trilat_net"]
"""The command line of `trilat` in its own process."""

PLAIN = {**os.environ, "NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "100"}


class CommandResult:
    """The exit code of a command, and its output."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code = code
        self.out = out
        self.err = err

    def __repr__(self) -> str:
        return f"exit code {self.code}\n--- out\n{self.out}\n--- err\n{self.err}"

    def succeeds(self) -> str:
        """Asserts that the command ended well without complaint; returns its output."""
        assert self.code == 0, self
        assert self.err == "", self
        return self.out

    def refuses(self, *facts: str, code: int = 2) -> None:
        """Asserts that the command refused in one line that contains these facts, and printed no more."""
        assert self.code == code, self
        lines = self.err.splitlines()
        assert len(lines) == 1, self
        assert lines[0].startswith("error: "), self
        for fact in facts:
            assert fact in self.err, self


@cache
def build_command() -> Any:
    """Returns `trilat` with all of its commands, built once because that takes a while."""
    return get_command(app)


def assert_parses(arguments: list[str]) -> None:
    """Asserts that a command line, `trilat` included, names a command, and only options and
    arguments of that command.
    """
    program, *rest = arguments
    assert program == "trilat"
    command: Any = build_command()
    while hasattr(command, "commands"):
        command = command.commands[rest.pop(0)]
    with command.make_context(command.name, rest) as context:
        assert context.args == []


def start_command(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([*COMMAND, *arguments], cwd=cwd, env=PLAIN, text=True, **pipes)


def simulate_by_command(folder: Path, scenario: str, *settings: str, seconds: str = "2") -> str:
    options = [word for setting in settings for word in ("--set", setting)]
    trilat("sim", scenario, "--duration", seconds, "-o", "run.mcap", *options, cwd=folder)
    return "run.mcap"


def trilat(*arguments: str | Path, cwd: Path) -> CommandResult:
    before = dict(allowed_code)
    allowed_code.clear()
    out = io.StringIO()
    err = io.StringIO()
    code: object = None
    with (
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", ["trilat", *map(str, arguments)]),
        mock.patch.dict(os.environ, PLAIN),
        mock.patch.object(
            compiling_notice, "is_reported", True
        ),  # by which worker it is compiled is chance
        mock.patch.object(terminal_output, "LINES_AFTER_S", 1e6),  # how fast it is, too
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code
    allowed_code.update(before)  # logs that other tests keep name laws
    return CommandResult(0 if code is None else int(str(code)), out.getvalue(), err.getvalue())


def shorten(file: Path) -> None:
    """Shortens the experiment of a protocol to two participants, two conditions and one trial each."""
    text = file.read_text(encoding="utf-8")
    text = re.sub(r"\[conditions\.(delay_100|jitter_300)\]\n[^\[]*", "", text)
    for key, value in {"participants": 2, "trials": 1, "practice": 0}.items():
        text = re.sub(rf"^{key} = \d+", f"{key} = {value}", text, flags=re.MULTILINE)
    file.write_text(text, encoding="utf-8")

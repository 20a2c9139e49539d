"""The `trilat` command: registers all commands and maps errors to exit codes.

Invariant: a command parses, calls one function of the library and prints. It exits 0 on success, 1 on a
failed run or comparison, 2 on bad input, 128 + n when signal n ended it; an error is one sentence.
"""

import gc
import os
import sys
from typing import Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from ..errors import TrilatError
from ..process import Interrupt
from ..reporting.terminal_output import err
from . import (
    certify,
    compare,
    demo,
    linear,
    log,
    metrics,
    ping,
    record,
    replay,
    report,
    rerun,
    scenario,
    sim,
    site,
    sweep,
    test,
    verify,
)
from . import set as set_command


class _Commands(TyperGroup):
    """The group of all commands; Ctrl-C ends any of them with 130, not with the framework's 1.

    The framework's way is an exception, which Python drops where it is raised inside a `__del__`;
    `Interrupt` remembers the signal all the same.
    """

    def invoke(self, ctx: Any) -> Any:
        """Runs a command."""
        with Interrupt() as interrupt:
            try:
                with interrupt.raising():
                    return super().invoke(ctx)
            except KeyboardInterrupt:
                err.print("interrupted")
                raise typer.Exit(interrupt.exit_code or 130) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Dual-user teleoperation over a real network, in virtual time, and again from the log.",
    epilog="Begin with: trilat demo paper",
)
app.add_typer(demo.app)
app.add_typer(site.app)
app.add_typer(record.app)
app.add_typer(ping.app)
app.add_typer(sim.app)
app.add_typer(verify.app)
app.add_typer(certify.app)
app.add_typer(metrics.app)
app.add_typer(compare.app)
app.add_typer(report.app)
app.add_typer(replay.app)
app.add_typer(rerun.app)
app.add_typer(log.app, name="log")
app.add_typer(test.app)
app.add_typer(sweep.app)
app.add_typer(linear.app)
app.add_typer(scenario.app, name="scenario")
app.add_typer(set_command.app, name="set")


def main() -> None:
    """Runs `trilat`; errors become one sentence and an exit code."""
    try:
        _run()
    finally:
        gc.freeze()  # the end of the process need not look through every record again


def _run() -> None:
    try:
        app()
    except TrilatError as error:
        err.print(f"error: {escape(str(error))}", soft_wrap=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of a pipe had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:  # a full disk, a folder that vanished: the machine's, and told in one line
        err.print(f"error: {escape(f'{error.filename}: ' if error.filename else '')}{error.strerror}")
        sys.exit(1)

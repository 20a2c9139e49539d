"""The `trilat` command: registers all commands and maps errors to exit codes.

Invariant: a command parses, calls one function of the library and prints. It exits 0 on success, 1 on a
failed run or comparison, 2 on bad input, 128 + n when signal n ended it; an error is one sentence.
"""

import gc
import os
import sys
from typing import Any

import typer
from typer.core import TyperGroup

from ..errors import TrilatError
from ..process import Interrupt
from ..reporting.terminal_output import err, print_error
from . import (
    certify,
    compare,
    demo,
    figure,
    linear,
    log,
    metrics,
    ping,
    record,
    replay,
    report,
    rerun,
    router,
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

    Its exception gets lost where Python raises it inside a `__del__`; `Interrupt` remembers the signal.
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
for _module in (
    demo,
    site,
    record,
    ping,
    router,
    sim,
    verify,
    certify,
    metrics,
    compare,
    figure,
    report,
    replay,
    rerun,
):
    app.add_typer(_module.app)
app.add_typer(log.app, name="log")
for _module in (test, sweep, linear):
    app.add_typer(_module.app)
app.add_typer(scenario.app, name="scenario")
app.add_typer(set_command.app, name="set")


def main() -> None:
    """Runs `trilat`; errors become one sentence and an exit code."""
    try:
        _run()
    finally:
        gc.freeze()  # at exit, Python need not traverse every record


def _run() -> None:
    try:
        app()
    except TrilatError as error:
        err.print(f"error: {error}", markup=False, soft_wrap=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of a pipe has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:  # a full disk, a folder that vanished
        print_error(f"{f'{error.filename}: ' if error.filename else ''}{error.strerror}")
        sys.exit(1)

"""The `trilat` command: registers all commands and maps errors to exit codes.

Invariant: a command parses, calls one function of the library and prints. It exits 0 on
success, 1 on a failed run or comparison, 2 on bad input, 4 when a law of a log may not run, 5
when a disk takes no more, 128 + n when signal n ended it; an error is one sentence.
"""

import errno
import gc
import inspect
import os
import pkgutil
import sys
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ..errors import LogRefused, TrilatError
from ..files import DISK_ERRNOS, STUDY_LIBRARIES, find_version, require_libraries
from ..process import Interrupt
from ..reporting.terminal_output import err, print_error, print_line
from . import options, sessions
from .options import flag


class _Commands(TyperGroup):
    """The group of all commands; Ctrl-C ends any of them with 130, not with the framework's 1.

    Its exception gets lost where Python raises it inside a `__del__`; `Interrupt` remembers the
    signal.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Returns the names of all commands as the help has them."""
        place = {name: n for n, name in enumerate(_FIRST)}
        return sorted(super().list_commands(ctx), key=lambda name: place.get(name, len(place)))

    def invoke(self, ctx: Any) -> Any:
        """Runs a command."""
        with Interrupt() as interrupt:
            try:
                with interrupt.raising():
                    return super().invoke(ctx)
            except KeyboardInterrupt:
                err.print("interrupted")
                raise typer.Exit(
                    interrupt.exit_code if interrupt.is_requested() else 130
                ) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Dual-user teleoperation over a real network, in virtual time, and again from the log.",
    epilog="Begin with: trilat demo paper",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print_line(f"trilat-net {find_version()}")
        raise typer.Exit


@app.callback()
def _main(
    _: Annotated[
        bool,
        flag(
            "--version", "Print the version and exit.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    pass


_FIRST = (
    "demo", "live", "site", "hand", "record", "ping", "watch", "stop", "enable", "reset", "doctor", "router",
    "ros2", "sim", "verify", "certify", "twin", "metrics", "compare", "figure", "report", "replay",
    "rerun", "log", "test", "sweep", "bench", "linear", "tune",
)  # fmt: skip
"""The order of the help; others follow."""
_GROUPS: dict[str, dict[str, Any]] = {
    "log": {"help": "Inspects, checks, signs, recovers, exports or views a log."},
    "scenario": {"help": "The shipped scenarios and your own."},
    "new": {"help": "A control law, a hand or a plant of your own, with its test."},
    "identify": {"help": "Finds what holds an arm."},
    "trace": {"help": "Imports delays that other programs measured."},
    "experiment": {"help": "Experiments with participants, from a protocol to its table."},
    "set": {"callback": options.spread(sessions.set_command)},
    "keys": {"help": "Keys that authenticate members of a session, and sign logs."},
}
_WITHIN = {"set": "--session paper "}
"""What examples of a group have before the name of a command."""


def _add_command(group: typer.Typer, words: str, run: Any) -> None:
    epilog = "\n\n".join(f"Example: trilat {words} {one}".rstrip() for one in run.examples)
    text = run.__doc__ or "(Its help is left out by python -OO: start it as python -O.)"
    paragraphs = inspect.cleandoc(text).split("\n\n")  # else lines break where the source's do
    text = "\n\n".join(" ".join(lines.split()) for lines in paragraphs)
    group.command(words.split()[-1], help=text, epilog=epilog)(options.spread(run))


def _add_commands() -> None:
    """Adds the commands of every file of this folder: `log_info_command` is `trilat log info`."""
    groups = {name: typer.Typer(no_args_is_help=True, **more) for name, more in _GROUPS.items()}
    for file in pkgutil.iter_modules(__path__):
        for name, run in vars(import_module(f"{__name__}.{file.name}")).items():
            if hasattr(run, "examples"):
                words = name.removesuffix("_command").replace("_", "-")
                first, _, rest = words.partition("-")
                if first in groups:
                    _add_command(groups[first], f"{first} {_WITHIN.get(first, '')}{rest}", run)
                else:
                    _add_command(app, words, run)
    for name, group in groups.items():
        app.add_typer(group, name=name)


_add_commands()

_TOO_LITTLE = "there is too little memory: 3 GiB of addresses suffice (ulimit -v), and 1 GiB of memory itself"
_WITHOUT_MEMORY = (
    "failed to map segment",
    "libllvmlite",
    "start new thread",
    "allocate memory",
)
"""What Python, Numba and threads say who get none."""


def _run() -> None:
    """Runs `trilat`; a library that `trilat-net-core` does without, and that is missing, is
    named.
    """
    try:
        app()
    except ModuleNotFoundError as error:
        if (name := (error.name or "").partition(".")[0]) in STUDY_LIBRARIES:
            require_libraries(name)
        raise


def main() -> None:
    """Runs `trilat`; errors become one sentence and an exit code."""
    TrilatError.in_command = True
    try:
        _run()
    except TrilatError as error:
        print_error(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
    except (MemoryError, ImportError, RuntimeError, OSError) as error:
        if isinstance(error, MemoryError) or any(
            text in str(error) for text in _WITHOUT_MEMORY
        ):
            sys.stderr.write(f"error: {_TOO_LITTLE}\n")  # to lay it out takes memory, too
            sys.exit(1)
        if not isinstance(error, OSError):  # else a full disk, a folder that vanished
            raise
        # a name, or without one a closed pipe
        refused = os.name == "nt" and error.errno == errno.EINVAL
        if isinstance(error, BrokenPipeError) or (refused and not error.filename):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(0)
        print_error(
            f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}"
        )
        bad_name = refused or error.errno == errno.ENAMETOOLONG
        sys.exit(LogRefused.exit_code if error.errno in DISK_ERRNOS else 2 if bad_name else 1)
    finally:
        TrilatError.in_command = False
        gc.freeze()  # at exit, Python need not traverse every record

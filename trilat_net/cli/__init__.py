"""Defines the `trilat` command: registers all commands and maps errors to exit codes.

Each command is a function `..._command` in a module of this folder, with the decorator
`options.command`. Its docstring is its help.

Invariant:
    - A command parses its options, calls one function of the library and prints the result.
    - The exit code is 0 on success, 1 for a failed run or comparison, 2 for bad input, 4 if a
      control law of a log may not run, 5 if a disk is full, and 128 + n if signal n ended the
      command.
    - An error is printed as one sentence.
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
    """The group of all commands, which Ctrl-C ends with exit code 130.

    The framework Typer alone would exit with 1. KeyboardInterrupt is lost if Python raises it
    inside a `__del__`. Therefore `Interrupt` remembers the signal.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Returns the names of all commands in the order of the help."""
        rank = {name: n for n, name in enumerate(_FIRST_COMMANDS)}
        return sorted(super().list_commands(ctx), key=lambda name: rank.get(name, len(rank)))

    def invoke(self, ctx: Any) -> Any:
        """Runs a command. Ctrl-C ends it with the exit code of the signal."""
        with Interrupt() as interrupt:
            try:
                with interrupt.raising():
                    return super().invoke(ctx)
            except KeyboardInterrupt:
                err.print("interrupted")
                exit_code = interrupt.exit_code if interrupt.is_requested() else 130
                raise typer.Exit(exit_code) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Dual-user teleoperation over a network, in virtual time, and again from the log.",
    epilog="Start with: trilat demo paper",
)


def _print_version(is_requested: bool) -> None:
    """Prints the version and exits, if it is requested."""
    if is_requested:
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
    """Declares the options of `trilat` itself."""


_FIRST_COMMANDS = (
    "demo", "live", "site", "hand", "record", "ping", "watch", "stop", "enable", "reset",
    "doctor", "router", "ros2", "sim", "verify", "certify", "twin", "metrics", "compare",
    "figure", "report", "replay", "rerun", "log", "test", "sweep", "bench", "linear", "tune",
)  # fmt: skip
"""First commands of the help, in their order. The others follow."""
_GROUPS: dict[str, dict[str, Any]] = {
    "log": {"help": "Inspects, checks, signs, recovers, exports or views a log."},
    "scenario": {"help": "Lists, shows, checks and creates scenarios."},
    "new": {"help": "Creates a control law, a hand or a plant of your own, with a test."},
    "identify": {"help": "Identifies the hand that holds an arm."},
    "trace": {"help": "Imports delays that another program measured."},
    "experiment": {
        "help": "Runs experiments with participants, from the protocol to the tables."
    },
    "set": {"callback": options.expand_option_tuples(sessions.set_command)},
    "keys": {"help": "Creates keys that authenticate members of a session or sign logs."},
}
_GROUP_OPTIONS = {"set": "--session paper "}
"""Options of a group that its examples need before the name of the command."""


def _add_command(group: typer.Typer, command_line: str, run: Any) -> None:
    """Adds a command to a group.

    Args:
        group: The group.
        command_line: The command as in its examples, such as "log info".
        run: Function of the command, see `options.command`.
    """
    examples = [
        f"Example: trilat {command_line} {example}".rstrip() for example in run.examples
    ]
    text = run.__doc__ or "(Its help is left out by python -OO: start it as python -O.)"
    # Each paragraph is joined into one line, because the help keeps line breaks.
    paragraphs = inspect.cleandoc(text).split("\n\n")
    text = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    name = command_line.split()[-1]
    declare = group.command(name, help=text, epilog="\n\n".join(examples))
    declare(options.expand_option_tuples(run))


def _add_commands() -> None:
    """Adds the commands that the modules of this folder define.

    For example, the function `log_info_command` becomes the command `trilat log info`.
    """
    groups = {
        name: typer.Typer(no_args_is_help=True, **settings)
        for name, settings in _GROUPS.items()
    }
    for file in pkgutil.iter_modules(__path__):
        module = import_module(f"{__name__}.{file.name}")
        for function_name, run in vars(module).items():
            if not hasattr(run, "examples"):
                continue
            command = function_name.removesuffix("_command").replace("_", "-")
            first, _, rest = command.partition("-")
            if first in groups:
                group_options = _GROUP_OPTIONS.get(first, "")
                _add_command(groups[first], f"{first} {group_options}{rest}", run)
            else:
                _add_command(app, command, run)
    for name, group in groups.items():
        app.add_typer(group, name=name)


_add_commands()

_TOO_LITTLE_MEMORY = (
    "there is too little memory: 3 GiB of addresses suffice (ulimit -v), "
    "and 1 GiB of memory itself"
)
_MEMORY_ERRORS = (
    "failed to map segment",
    "libllvmlite",
    "start new thread",
    "allocate memory",
)
"""Texts in errors of Python, Numba and threads that could not allocate memory."""


def _run() -> None:
    """Runs `trilat`. The error for a library that `trilat-net-core` lacks names the remedy."""
    try:
        app()
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library in STUDY_LIBRARIES:
            require_libraries(library)
        raise


def main() -> None:
    """Runs `trilat`. Errors become one sentence and an exit code."""
    TrilatError.in_command = True
    try:
        _run()
    except TrilatError as error:
        print_error(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
    except (MemoryError, ImportError, RuntimeError, OSError) as error:
        sys.exit(_report_system_error(error))
    finally:
        TrilatError.in_command = False
        gc.freeze()  # so that Python does not traverse every record at exit


def _report_system_error(error: Exception) -> int:
    """Prints an error of the operating system.

    Returns:
        The exit code.

    Raises:
        Exception: The error itself, if it is a bug of the program.
    """
    lacks_memory = any(text in str(error) for text in _MEMORY_ERRORS)
    if isinstance(error, MemoryError) or lacks_memory:
        # The text is written directly, because the usual functions need more memory.
        sys.stderr.write(f"error: {_TOO_LITTLE_MEMORY}\n")
        return 1
    # An OSError is a full disk or a folder that has vanished. Other errors are bugs.
    if not isinstance(error, OSError):
        raise error
    # Windows reports a refused name and a closed pipe by the same error.
    is_invalid = os.name == "nt" and error.errno == errno.EINVAL
    if isinstance(error, BrokenPipeError) or (is_invalid and not error.filename):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    prefix = f"{error.filename}: " if error.filename else ""
    print_error(f"{prefix}{error.strerror or error}")
    if error.errno in DISK_ERRNOS:
        return LogRefused.exit_code
    is_bad_name = is_invalid or error.errno == errno.ENAMETOOLONG
    return 2 if is_bad_name else 1

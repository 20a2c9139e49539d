"""The `trilat` command: registers all commands and maps errors to exit codes.

The modules of this folder define one function per command. For example, the function
`log_info_command` implements `trilat log info`, and its docstring is the command's help text.

Invariant:
    - A command parses its options, calls one library function, and prints the result.
    - The exit code is 0 on success, 1 for a failed run or comparison, 2 for bad input, 4 if a
      user-written law named in a log is not allowed to run, 5 if a disk is full, and 128 + n if
      signal n ended the command.
    - An error is printed as one sentence.
"""

import errno
import gc
import inspect
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, wraps
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ...entry_points import COMMANDS, find_entries, find_package, load_entry
from ...errors import LogRefused, TrilatError, UsageError, find_nearest, join_arguments
from ...files import DISK_ERRNOS, find_version
from ...package_names import (
    EXTRAS,
    PACKAGE_COMMANDS,
    STUDY_LIBRARIES,
    describe_missing_library,
)
from ...presentation import err, print_error, print_line
from ...signals import Interrupt
from . import sessions
from .options import flag

_SYNONYMS = {
    "trilat": {
        "simulate": "sim", "run": "sim or trilat demo", "start": "demo or trilat site",
        "play": "live play", "plot": "figure", "draw": "figure", "export": "log export",
        "show": "report or trilat log info", "info": "log info", "open": "report",
        "view": "log view", "check": "log check", "validate": "scenario check",
        "recover": "log recover", "repair": "log recover", "sign": "log sign",
        "analyse": "certify or trilat metrics", "analyze": "certify or trilat metrics",
        "stable": "certify", "stability": "certify", "judge": "certify", "diff": "compare",
        "evaluate": "metrics", "stats": "metrics", "summary": "report",
        "optimise": "tune", "optimize": "tune", "benchmark": "bench", "roots": "linear",
        "margin": "linear", "list": "scenario list", "ls": "scenario list", "init": "new law",
        "create": "new law", "law": "new law", "certificate": "certify", "monitor": "watch",
        "status": "watch", "halt": "stop", "kill": "stop", "end": "stop", "quit": "stop",
        "resume": "enable", "restart": "reset", "latency": "ping", "recorder": "record",
        "config": "scenario show", "version": "--version", "help": "--help",
    },
    "keys": {"join": "add","make": "new", "create": "new", "generate": "new", "show": "info",
             "extend": "renew", "sign": "pair"},
    "log": {"show": "info", "repair": "recover", "convert": "export", "open": "view",
            "verify": "check", "plot": "view"},
    "scenario": {"ls": "list", "print": "show", "cat": "show", "validate": "check",
                 "verify": "check", "create": "new", "make": "new", "template": "new"},
    "new": {"control": "law", "controller": "law", "operator": "hand", "policy": "hand",
            "arm": "plant", "robot": "plant"},
    "set": {"delay": "link", "alpha": "dominance", "authority": "dominance"},
    "experiment": {"create": "new", "start": "run", "validate": "check", "analyze": "analyse"},
}  # fmt: skip
"""For each group of commands: words that a user may enter, and the command that the user means.

Words that are only misspelt need no entry.
"""

_TO_LEROBOT = (
    "a dataset of a log is made by trilat log export FILE --to lerobot "
    "(docs/studies/lerobot.md)"
)
_TO_GYMNASIUM = (
    "an environment of Gymnasium is made in Python by trilat_net.make_env "
    "(docs/studies/train-policies.md)"
)
_SUBJECTS = {
    "lerobot": _TO_LEROBOT,
    "dataset": _TO_LEROBOT,
    "gym": _TO_GYMNASIUM,
    "gymnasium": _TO_GYMNASIUM,
    "train": f"{_TO_GYMNASIUM}; {_TO_LEROBOT}",
}
"""Subjects for which no command has a similar name, and the place where each is found."""


class _Group(TyperGroup):
    """A group of commands such as `trilat log`, which corrects misspelled commands.

    In place of an unknown command, it suggests a similar one. The group also has the commands
    that other packages add to it.
    """

    def __init__(self, *, name: str | None = None, **settings: Any) -> None:
        super().__init__(name=name, **settings)
        for command in _list_package_commands(name or ""):
            self.commands.setdefault(str(command.name), command)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Looks up the command named by the first argument.

        Called by Click before it runs a command. For an unknown name, such as a typing error or
        a term used by another program, the error suggests the closest command.

        Raises:
            UsageError: There is no such command.
        """
        name = args[0] if args else ""
        is_known = name.startswith("-") or self.get_command(ctx, name) is not None
        if not name or is_known or ctx.resilient_parsing:
            return super().resolve_command(ctx, args)

        group_name = "trilat" if ctx.parent is None else str(ctx.info_name)
        group_command = group_name if ctx.parent is None else f"trilat {group_name}"
        commands = self.list_commands(ctx)
        # A word that other programs use for the command is better than a similar name.
        suggestion = _SYNONYMS.get(group_name, {}).get(name.casefold())
        suggestion = suggestion or find_nearest(name, commands)

        hint = f"did you mean {group_command} {suggestion}?"
        if ctx.parent is None and name.casefold() in _SUBJECTS:
            hint = _SUBJECTS[name.casefold()]
        elif not suggestion:
            hint = f"{group_command} has the commands {', '.join(commands)}"
        return ctx.fail(f"There is no command {name!r}; {hint}")


class _Command(TyperCommand):
    """A command that recognises a setting which the shell has split into several arguments."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Parses the arguments of the command, and detects a value that the shell has split.

        For example, some shells split an unquoted --set dominance.m1={m2=0.1,s=0.9} into two
        arguments. Click's generic error message would not explain this.

        Raises:
            UsageError: The value of a --set option was not quoted, and the shell has split it.
        """
        whole = _find_split_setting(args)
        if whole:
            quoted = join_arguments(["--set", whole])
            ctx.fail(
                f"The shell has split the value of --set: put it into quotes, as in {quoted}"
            )
        return super().parse_args(ctx, args)


class _Commands(_Group):
    """The group of all commands. Ctrl-C ends any of them with exit code 130.

    The framework (Typer) alone would exit with code 1. If Ctrl-C arrives while Python runs a
    `__del__`, the KeyboardInterrupt is lost. The class `Interrupt` therefore records the
    signal.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Returns the names of all commands in the order used in the help.

        Commands from other packages that are not listed in this order come last.
        """
        positions = {name: n for n, name in enumerate(_PANEL_OF)}
        end = len(positions)
        return sorted(super().list_commands(ctx), key=lambda name: positions.get(name, end))

    def invoke(self, ctx: Any) -> Any:
        """Runs a command, and on Ctrl-C prints "interrupted" and exits with the signal's code.

        The exit code is 130 if the signal is unknown. Shell scripts that call the command
        therefore stop too.
        """
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
    help="Two people, one remote arm, and a network with delays: live, simulated, or again "
    "from the log.",
    epilog=(
        "Start with: trilat live play\n\nDocs: docs/tutorials/first-hour.md, docs/commands.md"
    ),
)


def _print_version(is_requested: bool) -> None:
    """Prints the version and exits, if the option --version is used."""
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
    """Declares the options of `trilat` itself. Each option has a function that executes it."""


def _deferred(read: Callable[[Any], Any]) -> Any:
    """Returns a property that reads a value only when the value is needed.

    Click, the library of the command line, assigns such attributes when it creates a command.
    The assigned values are ignored.

    Args:
        read: Method that returns the value.
    """
    return property(read, lambda _command, _value: None)


class _PackageCommand(TyperCommand):
    """A command of another package, which is imported only when somebody uses it.

    Importing all packages would make every command start slowly. The help of the whole program
    needs only the first sentence of the command's help.

    Args:
        command_line: Name of the command, with that of its group, as in "identify hand".
    """

    def __init__(self, command_line: str) -> None:
        name = command_line.split()[-1]
        panel = _find_panel(command_line) if name == command_line else None
        super().__init__(name, rich_help_panel=panel, rich_markup_mode="rich")
        self._command_line = command_line
        self._entry_name = command_line.replace(" ", "-")

    @cached_property
    def _command(self) -> Any:
        """The function of the command, which is imported from its package at the first use.

        Raises:
            UsageError: The package of the command is not installed or cannot be imported.
        """
        command_function = load_entry(
            COMMANDS, self._entry_name, f"trilat {self._command_line}"
        )
        if not hasattr(command_function, "examples"):
            raise UsageError(
                f"trilat {self._command_line} is not a command: its function lacks the "
                "decorator trilat_net.extension.command"
            )

        # Typer builds a command only as part of a group, so a temporary group is made for it.
        group = typer.Typer(rich_markup_mode="rich", pretty_exceptions_enable=False)
        _add_command(group, self._command_line, command_function)
        return typer.main.get_group(group).commands[str(self.name)]

    @_deferred
    def short_help(self) -> str:
        """The first sentence of the help, shown in the list of all commands.

        For known packages, the sentence comes from a table, because importing every package
        would make the help slow. If the command cannot be imported, the reason is shown
        instead.
        """
        package = find_package(COMMANDS, self._entry_name)
        if package:
            return PACKAGE_COMMANDS[package][self._entry_name]
        try:
            return str(self._command.help).split("\n\n")[0]
        except UsageError as error:
            return str(error)

    @_deferred
    def help(self) -> Any:
        """The help text of the command. Accessing it imports the package."""
        return self._command.help

    @_deferred
    def epilog(self) -> Any:
        """The text shown after the command's help. Accessing it imports the package."""
        return self._command.epilog

    @_deferred
    def params(self) -> Any:
        """The options and arguments of the command. Accessing them imports the package."""
        return self._command.params

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        """Imports the command from its package and lets it parse the arguments.

        Raises:
            UsageError: The package of the command is not installed or cannot be imported.
        """
        return self._command.make_context(*arguments, **settings)


def _list_package_commands(group: str) -> Iterator[_PackageCommand]:
    """Yields the commands that other installed packages add to the command line.

    Args:
        group: Name of the group. Empty for commands without a group.
    """
    of_packages = (name for commands in PACKAGE_COMMANDS.values() for name in commands)
    for entry_name in dict.fromkeys([*of_packages, *find_entries(COMMANDS)]):
        first, _, rest = entry_name.partition("-")
        if (first if rest and first in _GROUPS else "") == group:
            yield _PackageCommand(f"{first} {rest}" if group else entry_name)


_OWN_PANEL = "Make your own"
_PANELS = {
    "Start here": ("demo", "live", "sim"),
    "Analyse a log": (
        "report", "verify", "certify", "metrics", "figure", "compare", "log", "twin", "rerun",
        "replay",
    ),
    "Study": ("sweep", "tune", "linear", "bench", "experiment", "test"),
    "Control a running session": ("watch", "stop", "enable", "reset", "set", "ping"),
    "Machines and bridges": (
        "site", "record", "hand", "router", "keys", "ros2", "doctor",
    ),
    _OWN_PANEL: ("new", "scenario", "trace", "identify"),
}  # fmt: skip
"""The commands and groups of each panel of the help, in the order of the help.

A command that no panel names is in the last panel.
"""
_PANEL_OF = {name: panel for panel, names in _PANELS.items() for name in names}


def _expand_option_tuples(run: Callable[..., Any]) -> Callable[..., Any]:
    """Turns a function that has named tuples of options as parameters into a command.

    Several commands share options, such as those that name a network connection. These options
    are the fields of one named tuple, such as `Reach`. Typer, the command line library, makes
    one option of each parameter, and does not support such tuples. Therefore the returned
    function has one parameter per field. When it is called, it puts the fields into their
    tuples and calls the original function.

    Args:
        run: Function that executes the command, with groups of options as parameters.

    Returns:
        The function with one parameter per option.
    """
    declared = inspect.signature(run).parameters
    tuples = {}
    for name, parameter in declared.items():
        is_tuple = hasattr(parameter.annotation, "_fields")
        if is_tuple:
            tuples[name] = parameter.annotation

    parameters = []
    for name, parameter in declared.items():
        fields = [parameter]
        if name in tuples:
            fields = list(inspect.signature(tuples[name]).parameters.values())
        parameters += [field.replace(kind=inspect.Parameter.KEYWORD_ONLY) for field in fields]

    @wraps(run)
    def run_with_tuples(**arguments: Any) -> Any:
        """Groups the options into their named tuples and calls the function of the command.

        Args:
            **arguments: Option values, keyed by parameter name.
        """
        for name, option_tuple in tuples.items():
            values = [arguments.pop(field) for field in option_tuple._fields]
            arguments[name] = option_tuple(*values)
        return run(**arguments)

    # Typer reads the parameters from these two attributes.
    vars(run_with_tuples)["__signature__"] = inspect.Signature(parameters)
    run_with_tuples.__annotations__ = {
        parameter.name: parameter.annotation for parameter in parameters
    }
    return run_with_tuples


_GROUPS: dict[str, dict[str, Any]] = {
    "log": {
        "help": "Inspects, checks, signs, recovers, exports or views a log.",
        "epilog": "Example: trilat log info run.mcap\n\nDocs: docs/logs/log-tools.md",
    },
    "scenario": {
        "help": "Lists, shows, checks and creates scenarios.",
        "epilog": "Example: trilat scenario show paper\n\nDocs: docs/commands.md",
    },
    "new": {
        "help": "Creates your own control law, hand or plant, with a test.",
        "epilog": "Example: trilat new law mylaw.py\n\nDocs: docs/extend/own-controller.md",
    },
    "identify": {
        "help": "Identifies the dynamics of the hand that holds an arm.",
        "epilog": (
            "Example: trilat identify hand run.mcap --site m1\n\n"
            "Docs: docs/studies/measured-hands.md"
        ),
    },
    "trace": {
        "help": "Imports delays that another program measured.",
        "epilog": (
            "Example: trilat trace import irtt run.json.gz\n\nDocs: docs/extend/delay-traces.md"
        ),
    },
    "experiment": {
        "help": "Runs studies with people, from the protocol to the tables.",
        "epilog": (
            "Example: trilat experiment new reaching.toml\n\nDocs: docs/studies/experiments.md"
        ),
    },
    "set": {
        "callback": _expand_option_tuples(sessions.set_command),
        "epilog": "Example: trilat set --session paper link 'm1->s' --delay 350ms\n\n"
        "Docs: docs/reference/links.md",
    },
    "keys": {
        "help": "Creates keys that encrypt a session or sign logs.",
        "epilog": "Example: trilat keys pair lab\n\nDocs: docs/sessions/keys.md",
    },
}
_GROUP_OPTIONS = {"set": "--session paper "}
"""Options of a group that its examples need before the name of the command."""


def _add_command(group: typer.Typer, command_line: str, run: Any) -> None:
    """Adds a command to the command line, with its help and its examples.

    Args:
        group: The group.
        command_line: Name of the command with that of its group, as in "log info".
        run: Function of the command, which `options.command` has declared.
    """
    examples = [
        f"Example: trilat {command_line} {example}".rstrip() for example in run.examples
    ]
    help_text = run.__doc__ or "(Its help is left out by python -OO: start it as python -O.)"
    # One line per paragraph, because the help keeps line breaks.
    paragraphs = inspect.cleandoc(help_text).split("\n\n")
    help_text = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)

    name = command_line.split()[-1]
    epilog = "\n\n".join([*examples, f"Docs: {run.page}"])
    panel = _find_panel(command_line) if group is app else None

    declare = group.command(
        name, cls=_Command, help=help_text, epilog=epilog, rich_help_panel=panel
    )
    declare(_expand_option_tuples(run))


def _find_panel(name: str) -> str:
    """Returns the panel of the help that lists a command or a group of commands."""
    return _PANEL_OF.get(name, _OWN_PANEL)


def _add_commands() -> None:
    """Adds the commands of all files in this folder to their groups.

    A function is a command if `options.command` has declared it. If the first word of its name
    is the name of a group, the command belongs to that group: `log_info_command` is `trilat log
    info`.
    """
    groups = {}
    for name, settings in _GROUPS.items():
        groups[name] = typer.Typer(cls=_Group, no_args_is_help=True, **settings)

    for file in pkgutil.iter_modules(__path__):
        module = import_module(f"{__name__}.{file.name}")
        for function_name, run in vars(module).items():
            is_command = hasattr(run, "examples")  # an attribute that `options.command` sets
            if not is_command:
                continue

            command = function_name.removesuffix("_command").replace("_", "-")
            first_word, _, other_words = command.partition("-")
            if first_word in groups:
                group_options = _GROUP_OPTIONS.get(first_word, "")
                _add_command(
                    groups[first_word], f"{first_word} {group_options}{other_words}", run
                )
            else:
                _add_command(app, command, run)

    for name, group in groups.items():
        app.add_typer(group, name=name, rich_help_panel=_find_panel(name))


_add_commands()

_TOO_LITTLE_MEMORY = (
    "there is too little memory: the program needs up to 3 GiB of address space (ulimit -v) "
    "and 1 GiB of memory"
)
_MEMORY_ERRORS = (
    "failed to map segment",
    "libllvmlite",
    "start new thread",
    "allocate memory",
)
"""Parts of the messages of Python, Numba and threads that could not allocate memory."""


def _run() -> None:
    """Runs the command line program `trilat`, and names the remedy if a library is missing.

    An installation may lack libraries that only some commands need.
    """
    try:
        app()
    except ModuleNotFoundError as error:
        missing_library = (error.name or "").partition(".")[0]
        if missing_library in STUDY_LIBRARIES or missing_library in EXTRAS:
            problem = describe_missing_library("this command", error)
            raise UsageError(problem) from None
        raise


def main() -> None:
    """Entry point of `trilat`, the program that users run in a terminal.

    A known error is printed as one sentence, without a traceback, and sets the exit code of its
    class. System errors, such as a full disk, are also explained.
    """
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
        gc.freeze()  # keeps Python from traversing all objects at exit


def _report_system_error(error: Exception) -> int:
    """Prints an error of the operating system, such as a full disk, as a sentence for the user.

    Args:
        error: The error that ended the command.

    Returns:
        The exit code. It is 0 if the program that reads the output has ended, as in `trilat ...
        | head`.

    Raises:
        Exception: The error itself, if it is a bug of this program.
    """
    lacks_memory = any(text in str(error) for text in _MEMORY_ERRORS)
    if isinstance(error, MemoryError) or lacks_memory:
        # Written directly, because the layout of the text by `print_error` needs memory, too.
        sys.stderr.write(f"error: {_TOO_LITTLE_MEMORY}\n")
        return 1
    if not isinstance(error, OSError):
        # A bug. An OSError is, for example, a full disk or a folder that was deleted.
        raise error

    # Windows reports an invalid file name and a closed pipe with the same error number. Only
    # the former comes with a file name.
    is_invalid = os.name == "nt" and error.errno == errno.EINVAL
    is_closed_pipe = isinstance(error, BrokenPipeError) or (is_invalid and not error.filename)
    if is_closed_pipe:
        # Python flushes its output at exit, which must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0

    prefix = f"{error.filename}: " if error.filename else ""
    print_error(f"{prefix}{error.strerror or error}")
    if error.errno in DISK_ERRNOS:
        return LogRefused.exit_code

    is_bad_name = is_invalid or error.errno == errno.ENAMETOOLONG
    return 2 if is_bad_name else 1


_BRACKETS = {"{": "}", "[": "]"}
"""Closing brackets of tables and lists, by the opening brackets."""


def _find_split_setting(args: Sequence[str]) -> str:
    """Finds a value of --set that a shell has split, because the user did not quote it.

    A shell that expands braces makes two arguments of `dominance.m1={m2=0.1,s=0.9}`, which are
    `dominance.m1=m2=0.1` and `dominance.m1=s=0.9`. A value that contains spaces is split at the
    spaces.

    Args:
        args: Arguments of a command.

    Returns:
        The setting as the user wrote it. Empty if no setting was split.
    """
    for index, argument in enumerate(args[:-1]):
        if argument != "--set":
            continue
        setting, *other_arguments = args[index + 1 :]

        key, _, first_value = setting.partition("=")
        prefix = f"{key}="
        values = [first_value]
        for next_argument in other_arguments:
            if not next_argument.startswith(prefix):
                break
            values.append(next_argument.removeprefix(prefix))

        if len(values) > 1:  # the shell has expanded braces
            is_table = all("=" in entry for entry in values)
            opening = "{" if is_table else "["
            return f"{prefix}{opening}{','.join(values)}{_BRACKETS[opening]}"

        # The value begins with a bracket that is closed in a later argument.
        closing = _BRACKETS.get(first_value[:1], "")
        if closing and closing not in first_value:
            for count, next_argument in enumerate(other_arguments, 1):
                if closing in next_argument:
                    return " ".join([setting, *other_arguments[:count]])
    return ""

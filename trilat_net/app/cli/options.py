"""Command-line options shared by several commands.

They select a scenario, a network connection or a log. Related options are grouped as the fields
of a named tuple. For example, the fields of `Reach` state how to connect to a session. A
command with a parameter of such a type accepts all options of the group, and the tuple's
methods then open the connection or read the file.
"""

import inspect
import math
import re
from collections.abc import Callable, Sequence
from importlib import import_module, resources
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

import typer

from ...errors import TrilatError, UsageError
from ...log import FULL_RATE_HZ
from ...presentation import terminal_output as terminal

if TYPE_CHECKING:
    from ...log import Log
    from ...net import Connection
    from ...results import Result
    from ...scenario import Scenario
    from ..running_session import RunningSession

Runs = TypeVar("Runs", bound=Callable[..., None])


def check_range(
    low: float, high: float, noun: str
) -> Callable[[typer.CallbackParam, float | None], Any]:
    """Returns a Typer callback that checks that the value of an option is within a range.

    Typer passes the option to the callback, so the error message can name the option.

    Args:
        low: Smallest allowed value.
        high: Largest allowed value.
        noun: What the error message calls the value, for example "a share".

    Returns:
        A callback for `typer.Option`, which returns the value.
    """

    def check(param: typer.CallbackParam, value: float | None) -> float | None:
        """Checks that the value of an option is within the range, and returns it.

        Args:
            param: Declaration of the option, which contains its name.
            value: Value of the option. `None` if the option was not given.

        Raises:
            UsageError: The value is less than `low` or greater than `high`.
        """
        if value is not None and not low <= value <= high:
            raise UsageError(
                f"{param.opts[0]} must be {noun} from {low:.7g} to {high:.7g}, not {value:g}"
            )
        return value

    return check


def value(names: str, metavar: str, text: str = "", **settings: Any) -> Any:
    """Declares a command-line option that takes a value, for example `--rate 100`.

    Args:
        names: Names of the option, separated by spaces, for example "-o --out".
        metavar: Placeholder for the value in the help.
        text: Help text of the option.
        settings: Further arguments of `typer.Option`.
    """
    return typer.Option(*names.split(), metavar=metavar, help=text, **settings)


def flag(names: str, text: str = "", **settings: Any) -> Any:
    """Declares a command-line option that is either on or off, for example `--json`.

    Args:
        names: Names of the option, for example "--json" or "--ports/--no-ports".
        text: Help text of the option.
        settings: Further arguments of `typer.Option`.
    """
    return typer.Option(names, help=text, **settings)


def seconds(name: str, text: str = "") -> Any:
    """Declares a command-line option for a waiting time between 0 s and one day.

    Args:
        name: Name of the option, such as "--timeout".
        text: Help text of the option.
    """
    return value(name, "S", text, callback=check_range(0.0, 86_400.0, "a number of seconds"))


_OPTION_ENTRY = re.compile(r"^    (\w+): (.+(?:\n {8}.+)*)", re.MULTILINE)
"""Matches an entry in the section `Options` of a docstring after `inspect.cleandoc`."""


def command(*examples: str, page: str = "docs/commands.md") -> Callable[[Runs], Runs]:
    """Returns a decorator that declares a function as a command of the program.

    The function's docstring becomes the command's help text. Its `Options` section holds the
    help texts of options that are too long to write in their declarations.

    Args:
        examples: Arguments of the example invocations shown in the help.
        page: Documentation page that the help refers to, for example "docs/reference/links.md".
    """

    def declare(run: Runs) -> Runs:
        """Moves the help texts in a command's docstring to where Typer expects them.

        The entries in the docstring's `Options` section become the help texts of the options.
        The rest of the docstring becomes the help text of the command.

        Args:
            run: Function that executes the command.

        Returns:
            The same function, with the examples and the page in its attributes `examples` and
            `page`.
        """
        run.examples = examples  # type: ignore[attr-defined]
        run.page = page  # type: ignore[attr-defined]

        docstring = inspect.getdoc(run) or ""
        command_help, _, option_entries = docstring.partition("\n\nOptions:\n")
        run.__doc__ = command_help or None
        for parameter, text in _OPTION_ENTRY.findall(option_entries):
            # The declaration of an option is the first argument of `Annotated` behind the type.
            option = run.__annotations__[parameter].__metadata__[0]
            option.help = " ".join(text.split())
        return run

    return declare


_NO_LAWS = ("conditions", "interface", "sent_vectors")
"""Modules in the folder of the laws that do not define a law."""


def list_laws() -> list[str]:
    """Lists the names of the built-in control laws, for help texts and error messages.

    The names are derived from the file names, because importing all modules would be slow.
    """
    folder = str(Path(__file__).parents[2] / "laws")
    return [module.name for module in iter_modules([folder]) if module.name not in _NO_LAWS]


def complete_scenarios(incomplete: str) -> list[str]:
    """Lists scenarios for tab completion in the shell.

    The candidates are the shipped scenarios and the TOML files in a folder.

    Args:
        incomplete: The word typed so far. If it contains a slash, files in that folder are
            listed, otherwise files in the current folder.
    """
    candidates = []
    for entry in _SCENARIOS.iterdir():
        name = entry.name.removesuffix(".toml")
        is_scenario = "." not in name and not name.startswith("_")
        if is_scenario:
            candidates.append(name)

    folder = Path(incomplete).parent if "/" in incomplete else Path()
    if folder.is_dir():
        candidates += [str(path) for path in folder.glob("*.toml")]
    return sorted(name for name in candidates if name.startswith(incomplete))


def complete_figures(incomplete: str) -> list[str]:
    """Lists figure names for tab completion in the shell.

    Args:
        incomplete: The word typed so far.
    """
    from ...presentation import FIGURES

    return [name for name in FIGURES if name.startswith(incomplete)]


def complete_sites(context: typer.Context, incomplete: str) -> list[str]:
    """Lists site names for tab completion in the shell.

    Args:
        context: The parsed command line, whose scenario or log defines the sites.
        incomplete: The word typed so far.

    Returns:
        The names. Empty if the command line has no valid scenario or log yet.
    """
    from ...log import open_log
    from ...scenario import load_scenario

    files = context.params.get("files") or []
    # Arguments in front of an option without a value are not parsed yet.
    if "files" in context.params and not files:
        files = [Path(argument) for argument in context.args]

    try:
        if files:
            names = open_log(*files).sites
        else:
            names = load_scenario(context.params["scenario"]).names
    except (TrilatError, KeyError, TypeError):
        return []
    return [name for name in names if name.startswith(incomplete)]


_SCENARIOS = resources.files("trilat_net") / "scenarios"

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        help="Name of a shipped scenario, or path of a TOML file.",
        autocompletion=complete_scenarios,
    ),
]
SetOption = Annotated[
    list[str] | None,
    value(
        "--set",
        "KEY=VALUE",
        "Override a scenario key, for example control.Kd=5; repeatable.",
    ),
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", help="Override the seed of the scenario.")
]
DurationOption = Annotated[
    float | None, value("--duration", "S", "Override the duration of the run, in s.")
]
ForceOption = Annotated[bool, flag("--force", "Replace existing files.")]
ListenOption = Annotated[
    list[str] | None,
    value(
        "--listen", "EP", "Endpoint to listen on, for example tcp/192.0.2.1:7447; repeatable."
    ),
]
ConnectOption = Annotated[
    list[str] | None, value("--connect", "EP", "Endpoint to connect to; repeatable.")
]

RouterOption = Annotated[
    list[str] | None,
    value(
        "--router",
        "EP",
        "Endpoint of a router to use instead of direct connections, for example "
        "tcp/192.0.2.1:7447. If repeated, the first router that answers is used.",
    ),
]
ZenohConfigOption = Annotated[
    Path | None,
    value(
        "--zenoh-config",
        "FILE",
        "Your own Zenoh configuration file, for example for TLS, QUIC or access control.",
    ),
]
KeysOption = Annotated[
    Path | None,
    value("--keys", "DIR", "Folder with this member's keys, created by `trilat keys new`."),
]
InsecureOption = Annotated[
    bool,
    flag(
        "--insecure",
        "Allow other machines to connect without encryption, on a network whose users you "
        "trust.",
    ),
]


MOST_LETTERS = 80
"""Largest length of a session's name. The name of a scenario has at most 64 letters."""


def check_session_name(name: str) -> str:
    """Returns a session name after checking that it is a valid part of a Zenoh key.

    A Zenoh key is a network address, in which some characters are not allowed.

    Raises:
        UsageError: The name is too long or contains other characters.
    """
    has_valid_characters = re.fullmatch("[A-Za-z0-9_.-]+", name)
    if len(name) > MOST_LETTERS or not has_valid_characters:
        # Letters of other alphabets may look like those of ASCII.
        alphabet_note = (
            "" if name.isascii() else "; only the letters a to z and A to Z are allowed"
        )
        raise UsageError(
            f"a session's name must have 1 to {MOST_LETTERS} characters (letters, digits, _, - "
            f"and .), not {ascii(name)[:80]}{alphabet_note}"
        )
    return name


AnswerOption = Annotated[
    float, seconds("--timeout", "Longest wait for the first answer, in s.")
]
ClockOffsetOption = Annotated[
    float,
    value(
        "--clock-offset-s",
        "S",
        "For tests: offset added to the clock of this machine, in s.",
        callback=check_range(-1e6, 1e6, "a number of seconds"),
    ),
]
ClockDriftOption = Annotated[
    float,
    value(
        "--clock-drift-ppm",
        "PPM",
        "For tests: drift added to the clock of this machine, ppm; positive is faster.",
        callback=check_range(-200.0, 200.0, "a number"),
    ),
]

ViewsOption = Annotated[
    str,
    value(
        "--views",
        "off|full|HZ",
        "Rate of the channels with standard messages for ROS 2 and viewers, Hz; the "
        "decimation keeps minima and maxima. full: every record; off: no such channels.",
    ),
]

JobsOption = Annotated[
    int | None,
    value("--jobs", "N", "Number of parallel processes; default: one per core.", min=1),
]


LogArgument = Annotated[Path, typer.Argument(help="MCAP log file.", metavar="FILE")]
LogsArgument = Annotated[
    list[Path],
    typer.Argument(help="MCAP log file, or the files of all its parts.", metavar="FILE..."),
]
LogsOrFoldersArgument = Annotated[
    list[Path],
    typer.Argument(
        help="MCAP logs, or folders with MCAP logs. Files of one session are read as one log.",
        metavar="FILE...",
    ),
]
ROS_ROUTER = "tcp/127.0.0.1:7447"
RosRouterOption = Annotated[
    list[str] | None,
    value(
        "--ros",
        "EP",
        f"Endpoint of the Zenoh router of ROS (rmw_zenohd); default: {ROS_ROUTER}.",
    ),
]
RosDomainOption = Annotated[
    int, value("--domain", "N", "ROS 2 domain (ROS_DOMAIN_ID).", min=0, max=232)
]
NeedsRecorderOption = Annotated[
    bool, flag("--needs-recorder", "Do not start until a recorder has joined the session.")
]


MinCoverageOption = Annotated[
    float,
    value(
        "--min-coverage",
        "SHARE",
        "Smallest share of each site's ticks (control periods) that must be checked to pass.",
        callback=check_range(0.0, 1.0, "a share"),
    ),
]
MIN_COVERAGE = 0.999
"""Equals the value in `log.accounting`, which is not imported because the import takes long."""
OnOption = Annotated[
    str | None,
    value(
        "--on",
        "tcp://HOST:PORT",
        "Run on the workers of this Dask scheduler instead of on this machine.",
    ),
]
FIGURE_HELP = "File for a figure of the result (.png, .svg or .pdf)."
PngOption = Annotated[bool, flag("--png", "Write every figure as a PNG file too.")]
JsonOption = Annotated[bool, flag("--json", "Print everything as JSON.")]
AllOption = Annotated[
    bool, flag("--all", "Print everything, not only the ten most important lines.")
]


def check_picture(path: Path | None, *, force: bool) -> None:
    """Raises UsageError if a figure cannot be written to a path.

    Called before the figure is computed, so that a long computation is not wasted.

    Args:
        path: Path of the figure. `None` if no figure was requested.
        force: True to replace an existing file.

    Raises:
        UsageError: The format is unknown, the file already exists, or its folder does not
            exist.
    """
    if path is None:
        return

    from ...files import refuse_existing
    from ...presentation import FIGURE_FORMATS

    if path.suffix.lstrip(".").lower() not in FIGURE_FORMATS:
        raise UsageError(
            f"{path}: the name of a figure must end in one of .{', .'.join(FIGURE_FORMATS)}"
        )

    refuse_existing(path, force=force)
    if not path.parent.is_dir():
        raise UsageError(f"{path}: the folder {path.parent} does not exist")


def print_and_draw(
    result: "Result", picture: Path | None, figure: str, drawn: Any, *, as_json: bool
) -> None:
    """Prints a result, and also draws it to a file if a path is given.

    The drawing module is imported only if a figure is requested, because Matplotlib is slow to
    import.

    Args:
        result: The result.
        picture: Path of the figure. `None` if no figure was requested.
        figure: Module and function that draw the figure, for example
            "twin_differences:draw_twins".
        drawn: Argument passed to that function.
        as_json: True to print the result as JSON.
    """
    if picture is not None:
        from ...presentation import REPORT_DPI, write_figure

        module_name, _, function_name = figure.partition(":")
        module = import_module(f"trilat_net.presentation.figures.{module_name}")
        draw = getattr(module, function_name)
        write_figure(draw(drawn), picture, REPORT_DPI)

    terminal.print_result(result, as_json=as_json)
    if picture is not None and not as_json:
        terminal.print_paths([picture])


def load_chosen_scenario(
    source: str, overrides: list[str] | None, duration: float | None, seed: int | None
) -> "Scenario":
    """Loads the scenario named on the command line, with the overrides given as options.

    Args:
        source: Name of a shipped scenario, or path of a TOML file.
        overrides: Overrides from --set.
        duration: Duration from --duration, in s. If `None`, the scenario's duration is kept.
        seed: Seed from --seed. If `None`, the scenario's seed is kept.
    """
    from ...scenario import load_scenario

    _refuse_double_setting(overrides, "duration_s", "--duration", duration)
    _refuse_double_setting(overrides, "seed", "--seed", seed)
    return load_scenario(source, overrides or [], duration_s=duration, seed=seed)


def _refuse_double_setting(
    overrides: list[str] | None, key: str, option: str, given: float | None
) -> None:
    """Raises an error if the user has given a setting in two ways that may contradict.

    For example, --duration 5 and --set duration_s=10 contradict each other.

    Args:
        overrides: Texts of --set. `None` if the option is absent.
        key: Key of the scenario.
        option: Another option that sets this key.
        given: Value of that option. `None` if the option is absent.

    Raises:
        UsageError: The key is set by --set and by the other option.
    """
    if given is None:
        return
    for text in overrides or ():
        if _find_key(text) == key:
            raise UsageError(
                f"--set {text} and {option} {given:g} set the same key {key}: leave one out"
            )


def _find_key(override: str) -> str:
    """Returns the key of a text of --set, such as "duration_s" of "duration_s=5"."""
    return override.partition("=")[0].strip()


def list_overrides(overrides: list[str] | None, duration: float | None) -> list[str]:
    """Returns the scenario overrides requested by the options --set and --duration.

    With these options, a user can change an experiment for one run without editing its file.

    Args:
        overrides: Arguments of --set, such as "links.delay_ms=5". `None` if the option is
            absent.
        duration: Value of --duration, in s. 10 s becomes "duration_s=10.0". `None` if the
            option is absent.

    Raises:
        UsageError: Both options set the duration.
    """
    _refuse_double_setting(overrides, "duration_s", "--duration", duration)
    texts = list(overrides or [])
    if duration is not None:
        texts.append(f"duration_s={duration!r}")
    return texts


def split_names(text: str | None) -> list[str]:
    """Splits a comma-separated option value, such as "adaptive, p_d", into a list of names.

    Returns an empty list for `None`, that is, if the option is absent.
    """
    return [] if text is None else [name.strip() for name in text.split(",")]


def list_used_options(context: typer.Context) -> list[str]:
    """Lists the options given on the command line, excluding those left at their defaults.

    Commands use the list to reject incompatible combinations of options. An option at its
    default value does not conflict with any other.

    Returns:
        The first name of each option, for example "--seed", in the order of declaration.
    """
    used_options = []
    for param in context.command.params:
        source = context.get_parameter_source(param.name or "")
        if source and source.name == "COMMANDLINE":
            used_options.append(param.opts[0])
    return used_options


class MemberOptions(NamedTuple):
    """Options that control how a process connects to the other processes of a session.

    They specify the network endpoints to listen on, the endpoints to connect to, and the keys
    to use.
    """

    listen: ListenOption = None
    connect: ConnectOption = None
    router: RouterOption = None
    zenoh_config: ZenohConfigOption = None
    keys: KeysOption = None
    insecure: InsecureOption = False

    def find_endpoints(
        self, listen_else: Sequence[str] = (), connect_else: Sequence[str] | None = None
    ) -> "Connection":
        """Returns the network endpoints given by the options, without loading any keys.

        An endpoint is an address in Zenoh's notation, for example "tcp/192.168.0.5:7447".

        Args:
            listen_else: Endpoints to listen on if the options give none.
            connect_else: Endpoints to connect to if the options give none.
        """
        from ...net import Connection

        return Connection.of_member(
            listen=self.listen,
            connect=self.connect,
            routers=self.router,
            file=self.zenoh_config,
            listen_else=listen_else,
            connect_else=connect_else,
        )

    def resolve(
        self,
        listen_else: Sequence[str] = (),
        connect_else: Sequence[str] | None = None,
        *,
        stops: bool = False,
    ) -> "Connection":
        """Returns the network connection specified by the options, including its keys.

        If the keys expire soon, a note is printed for the user.

        Args:
            listen_else: Endpoints to listen on if the options give none.
            connect_else: Endpoints to connect to if the options give none.
            stops: True if the connection is used only to stop arms. Expired keys are then
                accepted, and no note is printed.
        """
        connection = self.find_endpoints(listen_else, connect_else)
        keys: Any = self.keys
        if stops and keys is not None:
            from ...net import read_member_keys

            keys = read_member_keys(keys, stops=True)
        secured = connection.secure(keys, insecure=self.insecure)
        expiry = secured.describe_end()
        # A user who stops an arm in a hurry does not read notes.
        if expiry and not stops:
            terminal.print_note(expiry)
        return secured


class Reach(NamedTuple):
    """Options that control how a command connects to a running session from outside.

    The command only observes or modifies the session. Since it is not one of the session's
    sites or recorders, it does not listen for connections.
    """

    connect: ConnectOption = None
    router: RouterOption = None
    zenoh_config: ZenohConfigOption = None
    keys: KeysOption = None

    def resolve(self, *, operates: bool = True, stops: bool = False) -> "Connection":
        """Returns the connection to a running session specified by the options.

        For an encrypted session, the option --keys selects the keys of the command.

        Args:
            operates: True if the command's requests require the operator's keys. Other keys are
                then rejected.
            stops: True if the command only stops arms. Expired keys are then also accepted.
        """
        from ...net import OPERATOR

        connection = MemberOptions(None, *self).resolve(stops=stops)
        return connection.require(OPERATOR) if operates else connection

    def open_session(
        self, name: str, *, operates: bool = True, stops: bool = False
    ) -> "RunningSession":
        """Prepares the connection over which a command sends requests to a running session.

        Args:
            name: Name of the session.
            operates: True if the command's requests require the operator's keys.
            stops: True if the command only stops arms. Expired keys are then also accepted.

        Raises:
            UsageError: The name has characters that are not allowed, or the keys are rejected.
        """
        from ..running_session import RunningSession

        name = check_session_name(name)
        connection = self.resolve(operates=operates, stops=stops)
        return RunningSession(name, connection)


class LawFileOptions(NamedTuple):
    """Options that permit user-written control laws named in a log to be executed.

    Since a log may come from someone else, code that it names runs only with the user's
    permission.
    """

    law: Annotated[
        list[Path] | None,
        value(
            "--law",
            "FILE",
            "Allow this file to run as a control law that the log names; repeatable.",
        ),
    ] = None
    other_version: Annotated[
        bool,
        flag(
            "--other-version",
            "Accept a --law FILE that differs from the file used in the recorded session.",
        ),
    ] = False
    remember: Annotated[
        bool,
        flag(
            "--remember",
            "Remember the permission of --law, for later logs that name a file of the same "
            "hash with the same settings.",
        ),
    ] = False

    def open(self, *files: Path, runs_them: bool = True) -> "Log":
        """Opens a log, and warns the user if another person's code will be executed.

        A log may name files with control laws, which are executed if the run is repeated.

        Args:
            *files: The log, or the files into which it is split.
            runs_them: True if the command executes the control laws named in the log. If False,
                no warning is given.
        """
        allowed: dict[str, Any] = {**self._asdict(), "law": self.law or ()}
        log = terminal.open_with_progress(*files, **allowed)
        if runs_them:
            terminal.warn_user_laws(log)
        return log


class RunOptions(NamedTuple):
    """Options of a command that runs a session on this machine and reports on it.

    They override parts of the scenario (see `load`), set the results folder, and select what is
    written to files and to the terminal.
    """

    duration: DurationOption = None
    folder: Annotated[
        Path | None, value("--out -o", "DIR", "Folder for the results; default: runs/NAME-N.")
    ] = None
    seed: SeedOption = None
    overrides: SetOption = None
    force: ForceOption = False
    png: PngOption = False
    as_json: JsonOption = False

    def load(self, source: str, longest_s: float | None = None) -> "Scenario":
        """Loads the scenario of the run, with the overrides given as options.

        Args:
            source: Name of a shipped scenario, or path of a TOML file.
            longest_s: Duration of the run if no option sets it, in s. If `None`, the scenario's
                duration is used.
        """
        duration_s = self.duration
        is_duration_overridden = any(
            _find_key(text) == "duration_s" for text in self.overrides or ()
        )
        if duration_s is None and not is_duration_overridden:
            duration_s = longest_s
        return load_chosen_scenario(source, self.overrides, duration_s, self.seed)


def parse_viz_rate(text: str) -> float:
    """Parses the option `--views`, the rate of messages for viewers such as Foxglove, in Hz.

    A lower rate makes the log smaller.

    Args:
        text: A number from 1 to 1e6, "off" or "full".

    Returns:
        The rate in Hz. 0 for "off", and `FULL_RATE_HZ` for "full".

    Raises:
        UsageError: The argument is neither a number in this range nor one of these words.
    """
    keywords = {"off": 0.0, "full": FULL_RATE_HZ}
    if text in keywords:
        return keywords[text]

    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = math.nan
    if not 1.0 <= rate_hz <= 1e6:
        raise UsageError(
            "--views must be off, full, or a number of messages per second from 1 to 1000000, "
            f"not {text!r}"
        )
    return rate_hz

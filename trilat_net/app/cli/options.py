"""Defines the command-line options that several commands share.

They select a scenario, a network connection or a log. Options that belong together are fields
of a named tuple. For example, the fields of `Reach` say how a command reaches a session. A
command that has a parameter of this type accepts all of its options. The methods of the tuple
then open the connection or read the file.
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

Runs = TypeVar("Runs", bound=Callable[..., None])


def check_range(
    low: float, high: float, noun: str
) -> Callable[[typer.CallbackParam, float | None], Any]:
    """Returns a function that checks that the number of an option is within a range.

    Typer calls the function with the option, which the error message can therefore name.

    Args:
        low: The smallest number.
        high: The largest number.
        noun: Name of the number in the error message, as in "a share".

    Returns:
        A callback for `typer.Option`, which returns the number.
    """

    def check(param: typer.CallbackParam, value: float | None) -> float | None:
        """Returns the number that the user gave for an option, after checking its range.

        Args:
            param: Declaration of the option, which contains its name.
            value: The number. `None` if the option was not given.

        Raises:
            UsageError: The number is less than `low` or greater than `high`.
        """
        if value is not None and not low <= value <= high:
            raise UsageError(
                f"{param.opts[0]} must be {noun} from {low:.7g} to {high:.7g}, not {value:g}"
            )
        return value

    return check


def value(names: str, metavar: str, text: str = "", **settings: Any) -> Any:
    """Declares a command-line option that takes a value, as in `--rate 100`.

    Args:
        names: Names of the option, separated by spaces, as in "-o --out".
        metavar: Placeholder of the value in the help.
        text: Help of the option.
        settings: Further arguments of `typer.Option`.
    """
    return typer.Option(*names.split(), metavar=metavar, help=text, **settings)


def flag(names: str, text: str = "", **settings: Any) -> Any:
    """Declares a command-line option that is on or off, as in `--json`.

    Args:
        names: Names of the option, as in "--json" or "--ports/--no-ports".
        text: Help of the option.
        settings: Further arguments of `typer.Option`.
    """
    return typer.Option(names, help=text, **settings)


def seconds(name: str, text: str = "") -> Any:
    """Declares a command-line option with a time to wait, from 0 s to one day.

    Args:
        name: Name of the option, such as "--timeout".
        text: Help of the option.
    """
    return value(name, "S", text, callback=check_range(0.0, 86_400.0, "a number of seconds"))


_OPTION_ENTRY = re.compile(r"^    (\w+): (.+(?:\n {8}.+)*)", re.MULTILINE)
"""Matches an entry in the section `Options` of a docstring after `inspect.cleandoc`."""


def command(*examples: str, page: str = "docs/commands.md") -> Callable[[Runs], Runs]:
    """Returns a decorator that declares a function as a command of the program.

    The docstring of the function is the help of the command. Its section `Options` has the help
    of those options for which the declaration has no room.

    Args:
        examples: Arguments of the examples that the help shows.
        page: Page of the documentation that the help names, as in "docs/reference/links.md".
    """

    def declare(run: Runs) -> Runs:
        """Stores the help of a command where Typer, the command line library, expects it.

        The entries in the section `Options` of the docstring become the help texts of the
        options. The rest of the docstring is the help of the command.

        Args:
            run: Function that executes the command.

        Returns:
            The same function, with the examples and the page in its attributes `examples`
            and `page`.
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

    The names are taken from the file names, because importing all modules would take long.
    """
    folder = str(Path(__file__).parents[2] / "laws")
    return [module.name for module in iter_modules([folder]) if module.name not in _NO_LAWS]


def complete_scenarios(incomplete: str) -> list[str]:
    """Lists the scenarios that the shell offers when the user presses the tab key.

    They are the shipped scenarios, and the TOML files of a folder.

    Args:
        incomplete: The word so far. If it has a slash, files of its folder are listed,
            otherwise files of the current folder.
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
    """Lists the names of figures that begin with the letters that the user has typed.

    The shell offers these names when the user presses the tab key.

    Args:
        incomplete: The letters before the completion.
    """
    from ...presentation import FIGURES

    return [name for name in FIGURES if name.startswith(incomplete)]


def complete_sites(context: typer.Context, incomplete: str) -> list[str]:
    """Lists the names of arms that the shell offers when the user presses the tab key.

    Args:
        context: The command line, whose scenario or log names the sites.
        incomplete: The word so far.

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
    """Checks that the name of a session can be part of a network address, and returns it.

    Zenoh, the network library, calls such an address a key, in which some characters are not
    allowed.

    Raises:
        UsageError: The name is too long or has other characters.
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
    """Rejects the path of a figure that cannot be written, before the figure is computed.

    The computation may take long, and would be lost.

    Args:
        path: Path of the figure. `None` if no figure was requested.
        force: True to replace an existing file.

    Raises:
        UsageError: The format is unknown, the file exists, or its folder does not.
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
    """Prints a result, and writes a figure of it if a path is given.

    The module that draws is imported only if a figure is requested, because Matplotlib is slow
    to import.

    Args:
        result: The result.
        picture: Path of the figure. `None` if no figure was requested.
        figure: Module and function that draw the figure, as in "twin_differences:draw_twins".
        drawn: Argument of that function.
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
    """Loads the scenario that a command names, with the changes that its options request.

    Args:
        source: Name of a shipped scenario, or path of a TOML file.
        overrides: Overrides from --set.
        duration: Duration in s from --duration. If `None`, the scenario's duration is kept.
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
    """Returns the changes to a scenario that the options --set and --duration request.

    With these options a user can change an experiment for one run without editing its file.

    Args:
        overrides: Texts of --set, such as "links.delay_ms=5". `None` if the option is absent.
        duration: Value of --duration, in s. It becomes "duration_s=10.0". `None` if absent.

    Raises:
        UsageError: Both options set the duration.
    """
    _refuse_double_setting(overrides, "duration_s", "--duration", duration)
    texts = list(overrides or [])
    if duration is not None:
        texts.append(f"duration_s={duration!r}")
    return texts


def split_names(text: str | None) -> list[str]:
    """Splits the names that a user gave in one option: "adaptive, p_d" gives two names.

    `None`, which stands for an absent option, gives an empty list.
    """
    return [] if text is None else [name.strip() for name in text.split(",")]


def list_used_options(context: typer.Context) -> list[str]:
    """Lists the options that the user wrote on the command line, without those at defaults.

    Commands use the list to reject combinations of options. An option that has its default
    value does not conflict with others.

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
    """Options with which a process connects to the other processes of a session.

    The options say at which network endpoints the process listens, to which it connects, and
    with which keys.
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
        """Returns the network addresses that the options state, without encryption keys.

        The network library Zenoh connects processes by such addresses, for example
        "tcp/192.168.0.5:7447".

        Args:
            listen_else: Addresses at which to listen if the options state no address.
            connect_else: Addresses to which to connect if the options state no address.
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
        """Returns the network connection that the options of a command describe, with its keys.

        A note for the user is printed if the keys expire soon.

        Args:
            listen_else: Endpoints at which to listen if the options name no endpoint.
            connect_else: Endpoints to which to connect if the options name no endpoint.
            stops: True if the connection only serves to stop arms. Expired keys are then
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
    """The options with which a command connects to a running session from outside.

    The command only observes or changes the session. It is not one of its sites or recorders,
    and therefore does not listen for connections.
    """

    connect: ConnectOption = None
    router: RouterOption = None
    zenoh_config: ZenohConfigOption = None
    keys: KeysOption = None

    def resolve(self, *, operates: bool = True, stops: bool = False) -> "Connection":
        """Returns the connection to a running session that the command-line options describe.

        If the session is encrypted, the option --keys names the keys of the command.

        Args:
            operates: True if only the keys of the operator permit the command's requests. Other
                keys are then rejected.
            stops: True if the command only stops arms. Then expired keys are accepted too.
        """
        from ...net import OPERATOR

        connection = MemberOptions(None, *self).resolve(stops=stops)
        return connection.require(OPERATOR) if operates else connection


class LawFileOptions(NamedTuple):
    """Options that permit a log's control laws, written by a user, to be executed.

    A log may come from somebody else. Code that it names runs only with the permission of the
    user.
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
        """Opens a log, and warns the user if code of another person will be executed.

        A log may name files with control laws, which are executed if the run is repeated.

        Args:
            *files: The log, or the files into which it is divided.
            runs_them: True if the command executes the control laws that the log names. Only
                then the user is warned.
        """
        allowed: dict[str, Any] = {**self._asdict(), "law": self.law or ()}
        log = terminal.open_with_progress(*files, **allowed)
        if runs_them:
            terminal.warn_user_laws(log)
        return log


class RunOptions(NamedTuple):
    """Options of a command that runs a session on this machine and reports on it.

    The options override parts of the scenario (`load`), name the folder of the results, and
    select the files and lines to write.
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
        """Loads the scenario of the run, with the changes that the command's options request.

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
    """Parses the option `--views`: how many messages per second viewers such as Foxglove get.

    Fewer messages make the log smaller.

    Args:
        text: A number from 1 to 1e6, "off" or "full".

    Returns:
        The rate in Hz. It is 0 for "off" and `FULL_RATE_HZ` for "full".

    Raises:
        UsageError: The text is neither a number in range nor one of these words.
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

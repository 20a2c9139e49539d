"""Options that several commands share, alone or together, and the scenario, connection or log
they mean.
"""

import inspect
import re
from collections.abc import Callable, Sequence
from functools import wraps
from importlib import import_module, resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

import typer

from ..errors import TrilatError, UsageError
from ..reporting import terminal_output as terminal

if TYPE_CHECKING:
    from ..log.log_reader import Log
    from ..net.connection import Connection
    from ..results import Result
    from ..scenario import Scenario

Runs = TypeVar("Runs", bound=Callable[..., None])


def check_range(
    low: float, high: float, what: str
) -> Callable[[typer.CallbackParam, float | None], Any]:
    """Returns a check of an option that refuses a number out of a range; `what` names such
    numbers.
    """

    def check(param: typer.CallbackParam, value: float | None) -> float | None:
        if value is not None and not low <= value <= high:
            raise UsageError(
                f"{param.opts[0]} is {what} from {low:.7g} to {high:.7g}, not {value:g}"
            )
        return value

    return check


def value(names: str, metavar: str, text: str = "", **more: Any) -> Any:
    """Returns an option that takes a value, with its help; several names are separated by
    spaces.
    """
    return typer.Option(*names.split(), metavar=metavar, help=text, **more)


def flag(names: str, text: str = "", **more: Any) -> Any:
    """Returns an option without a value, with its help."""
    return typer.Option(names, help=text, **more)


def seconds(name: str, text: str = "") -> Any:
    """Returns an option that takes a waiting time, s, with its help."""
    return value(name, "S", text, callback=check_range(0.0, 86_400.0, "a number of seconds"))


_TOLD = re.compile(r"^    (\w+): (.+(?:\n {8}.+)*)", re.MULTILINE)
"""An entry of a docstring's section `Options`, after `inspect.cleandoc`."""


def command(*examples: str) -> Callable[[Runs], Runs]:
    """Declares a command of the program, with the arguments of its examples.

    An option whose help does not fit into its line has it in the section `Options` of the
    docstring.
    """

    def declare(run: Runs) -> Runs:
        run.examples = examples  # type: ignore[attr-defined]
        head, _, told = (inspect.getdoc(run) or "").partition("\n\nOptions:\n")
        run.__doc__ = head or None
        for name, text in _TOLD.findall(told):
            run.__annotations__[name].__metadata__[0].help = " ".join(text.split())
        return run

    return declare


def complete_scenarios(incomplete: str) -> list[str]:
    """Returns what a shell completes to a scenario: shipped names, and TOML files and folders
    here.
    """
    shipped = (entry.name.removesuffix(".toml") for entry in _SCENARIOS.iterdir())
    names = [name for name in shipped if "." not in name and not name.startswith("_")]
    folder = Path(incomplete).parent if "/" in incomplete else Path()
    here = [str(path) for path in folder.glob("*.toml")] if folder.is_dir() else []
    return sorted(name for name in [*names, *here] if name.startswith(incomplete))


def complete_figures(incomplete: str) -> list[str]:
    """Returns what a shell completes to the name of a figure."""
    from ..reporting.figures.registry import FIGURES

    return [name for name in FIGURES if name.startswith(incomplete)]


def complete_sites(context: typer.Context, incomplete: str) -> list[str]:
    """Returns what a shell completes to a site: those of the scenario or the log that was named
    before.
    """
    from ..log.log_reader import open_log
    from ..scenario import load_scenario

    files = context.params.get("files") or []
    # before an option without its value they are not parsed
    if "files" in context.params and not files:
        files = [Path(word) for word in context.args]
    try:
        names = (
            open_log(*files).sites if files else load_scenario(context.params["scenario"]).names
        )
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
    value("--set", "KEY=VALUE", "Override a key, as in control.Kd=5; repeatable."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Override the scenario's seed.")]
DurationOption = Annotated[
    float | None, value("--duration", "S", "Override the duration of the run, s.")
]
ForceOption = Annotated[bool, flag("--force", "Replace existing files.")]
ListenOption = Annotated[
    list[str] | None,
    value("--listen", "EP", "Endpoint to listen at, as in tcp/192.0.2.1:7447."),
]
ConnectOption = Annotated[
    list[str] | None, value("--connect", "EP", "Endpoint to connect to; repeatable.")
]

RouterOption = Annotated[
    list[str] | None,
    value(
        "--router",
        "EP",
        "Endpoint of a router to use instead, as in tcp/192.0.2.1:7447; repeatable: the first one that "
        "answers is used.",
    ),
]
ZenohConfigOption = Annotated[
    Path | None,
    value("--zenoh-config", "FILE", "Your own Zenoh configuration: TLS, QUIC, access."),
]
KeysOption = Annotated[
    Path | None, value("--keys", "DIR", "Folder of this member's keys (trilat keys new).")
]
InsecureOption = Annotated[
    bool, flag("--insecure", "Allow --listen on a network whose users you trust, unencrypted.")
]


MOST_LETTERS = 80
"""Of a session's name; a scenario's has 64 at most."""


def check_session_name(name: str) -> str:
    """Refuses a session name that cannot be part of a key."""
    if len(name) > MOST_LETTERS or not re.fullmatch("[A-Za-z0-9_.-]+", name):
        # others look alike
        letters = "" if name.isascii() else "; its letters are a to z and A to Z"
        raise UsageError(
            f"a session's name is at most {MOST_LETTERS} letters, digits, _, - and ., "
            f"not {ascii(name)[:80]}{letters}"
        )
    return name


AnswerOption = Annotated[float, seconds("--timeout", "Longest wait for the first answer, s.")]
ClockOffsetOption = Annotated[
    float,
    value(
        "--clock-offset-s",
        "S",
        "For tests: use a clock this far ahead of the machine's, s.",
        callback=check_range(-1e6, 1e6, "a number of seconds"),
    ),
]
ClockDriftOption = Annotated[
    float,
    value(
        "--clock-drift-ppm",
        "PPM",
        "For tests: use a clock that runs faster than the machine's by this, ppm.",
        callback=check_range(-200.0, 200.0, "a number"),
    ),
]

ViewsOption = Annotated[
    str,
    value(
        "--views",
        "off|full|HZ",
        "Rate of the standard channels for ROS 2 and viewers, Hz; extremes are kept.",
    ),
]

JobsOption = Annotated[
    int | None, value("--jobs", "N", "Processes; default: one per core.", min=1)
]


LogArgument = Annotated[Path, typer.Argument(help="An MCAP log.", metavar="FILE")]
LogsArgument = Annotated[
    list[Path], typer.Argument(help="An MCAP log, or all the parts of one.", metavar="FILE...")
]
ROS_ROUTER = "tcp/127.0.0.1:7447"
RosRouterOption = Annotated[
    list[str] | None,
    value(
        "--ros", "EP", f"Endpoint of ROS's Zenoh router (rmw_zenohd); default: {ROS_ROUTER}."
    ),
]
RosDomainOption = Annotated[int, value("--domain", "N", "ROS_DOMAIN_ID.", min=0, max=232)]
NeedsRecorderOption = Annotated[bool, flag("--needs-recorder", "Wait for a recorder.")]


MinCoverageOption = Annotated[
    float,
    value(
        "--min-coverage",
        "SHARE",
        "Least share of every site's ticks that must be judged for a pass.",
        callback=check_range(0.0, 1.0, "a share"),
    ),
]
MIN_COVERAGE = 0.999
"""As in `log.accounting`, which takes long to import."""
OnOption = Annotated[
    str | None,
    value(
        "--on",
        "tcp://HOST:PORT",
        "Run on the workers of this Dask scheduler instead of processes of this machine.",
    ),
]
PngOption = Annotated[bool, flag("--png", "Write every figure as a PNG file too.")]
JsonOption = Annotated[bool, flag("--json", "Print everything as JSON.")]


def check_picture(path: Path | None, *, force: bool) -> None:
    """Refuses the path of a figure that cannot be written."""
    if path is None:
        return
    from ..files import refuse_existing
    from ..reporting.style import FIGURE_FORMATS

    if path.suffix.lstrip(".").lower() not in FIGURE_FORMATS:
        raise UsageError(f"{path}: a figure's name ends in .{', .'.join(FIGURE_FORMATS)}")
    refuse_existing(path, force=force)
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}")


def print_drawn(
    found: "Result", picture: Path | None, figure: str, shown: Any, *, as_json: bool
) -> None:
    """Prints a result; if asked for, writes the figure of what is shown, as
    "twin_differences:draw_twins".
    """
    if picture is not None:
        from ..reporting.style import REPORT_DPI, write_figure

        module, _, name = figure.partition(":")
        draw = getattr(import_module(f"trilat_net.reporting.figures.{module}"), name)
        write_figure(draw(shown), picture, REPORT_DPI)
    terminal.print_result(found, as_json=as_json)
    if picture is not None and not as_json:
        terminal.print_paths([picture])


def load_chosen_scenario(
    source: str, overrides: list[str] | None, duration: float | None, seed: int | None
) -> "Scenario":
    """Returns the scenario that a command's options describe."""
    from ..scenario import load_scenario

    return load_scenario(source, overrides or [], duration_s=duration, seed=seed)


def list_overrides(overrides: list[str] | None, duration: float | None) -> list[str]:
    """Returns the overrides of --set and --duration, in this order."""
    return [*(overrides or []), *([] if duration is None else [f"duration_s={duration!r}"])]


def split_names(text: str | None) -> list[str]:
    """Returns the names of a text such as adaptive,p_d; none for None."""
    return [] if text is None else [name.strip() for name in text.split(",")]


def given_options(context: typer.Context) -> list[str]:
    """Returns the options and arguments that were given, by the first name of each, as they are
    declared.
    """
    sources = (
        (param, context.get_parameter_source(param.name or ""))
        for param in context.command.params
    )
    return [
        param.opts[0] for param, source in sources if source and source.name == "COMMANDLINE"
    ]


class MemberOptions(NamedTuple):
    """The options by which a process takes part in a session."""

    listen: ListenOption = None
    connect: ConnectOption = None
    router: RouterOption = None
    zenoh_config: ZenohConfigOption = None
    keys: KeysOption = None
    insecure: InsecureOption = False

    def find_endpoints(
        self, listen_else: Sequence[str] = (), connect_else: Sequence[str] | None = None
    ) -> "Connection":
        """Returns where it listens and what it connects to, by default these; without its keys."""
        from ..net.connection import resolve_member_connection
        from ..net.zenoh_bus import read_zenoh_file

        file = None if self.zenoh_config is None else read_zenoh_file(self.zenoh_config)
        ways = self.listen, self.connect, self.router, file
        return resolve_member_connection(*ways, listen_else, connect_else)

    def resolve(
        self,
        listen_else: Sequence[str] = (),
        connect_else: Sequence[str] | None = None,
        *,
        stops: bool = False,
    ) -> "Connection":
        """Returns how it takes part, by default at these endpoints; with its keys.

        With `stops` it serves to stop arms alone, for which keys that have ended may do.
        """
        from ..net.connection import secure_connection

        connection = self.find_endpoints(listen_else, connect_else)
        keys: Any = self.keys
        if stops and keys is not None:
            from ..net.member_keys import read_member_keys

            keys = read_member_keys(keys, stops=True)
        secured = secure_connection(connection, keys, insecure=self.insecure)
        if not stops and (text := secured.describe_end()):  # who stops an arm reads no notes
            terminal.print_note(text)
        return secured


class Reach(NamedTuple):
    """The options by which a command reaches a session of which it is no member."""

    connect: ConnectOption = None
    router: RouterOption = None
    zenoh_config: ZenohConfigOption = None
    keys: KeysOption = None

    def resolve(self, *, operates: bool = True, stops: bool = False) -> "Connection":
        """Returns the connection.

        Args:
            operates: whether the keys must be the operator's.
            stops: whether it serves to stop arms alone, for which keys that have ended may do.
        """
        from ..net.zenoh_config import OPERATOR

        connection = MemberOptions(None, *self).resolve(stops=stops)
        return connection.require(OPERATOR) if operates else connection


class LawFiles(NamedTuple):
    """The options that let files run as the laws that a log names."""

    law: Annotated[
        list[Path] | None,
        value("--law", "FILE", "Let this file run as a law that the log names; repeatable."),
    ] = None
    other_version: Annotated[
        bool, flag("--other-version", "Take the --law FILE though it is not the one that ran.")
    ] = False
    remember: Annotated[
        bool,
        flag(
            "--remember",
            "Let the --law FILE run for other logs that name its hash and the same settings, too.",
        ),
    ] = False

    def open(self, *files: Path, runs_them: bool = True) -> "Log":
        """Returns a log; warns of code from outside that its execution runs, or may not run."""
        allowed: dict[str, Any] = {**self._asdict(), "law": self.law or ()}
        log = terminal.open_with_progress(*files, **allowed)
        if runs_them:
            terminal.warn_user_laws(log)
        return log


class RunOptions(NamedTuple):
    """The options of a run that is live on this machine, and of its results."""

    duration: DurationOption = None
    folder: Annotated[
        Path | None, value("--out -o", "DIR", "Folder of the results; default: runs/NAME-N.")
    ] = None
    seed: SeedOption = None
    overrides: SetOption = None
    force: ForceOption = False
    png: PngOption = False
    as_json: JsonOption = False

    def load(self, source: str, longest_s: float | None = None) -> "Scenario":
        """Returns the scenario of the run, which lasts so long unless told otherwise, s."""
        lasts_s = longest_s if self.duration is None else self.duration
        return load_chosen_scenario(source, self.overrides, lasts_s, self.seed)


class PageServing(NamedTuple):
    """The options of a command that serves a page."""

    host: Annotated[
        str,
        value(
            "--host",
            "ADDRESS",
            "Address of the page; beyond loopback with --tls or --insecure.",
        ),
    ] = "127.0.0.1"
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0: any.")
    ] = 0
    insecure: Annotated[
        bool, flag("--insecure", "Allow --host beyond loopback, without encryption.")
    ] = False
    browser: Annotated[
        bool, flag("--browser/--no-browser", "Open a browser if there is one.")
    ] = True
    tls: Annotated[
        Path | None, value("--tls", "DIR", "Encrypt by a member's keys in this folder.")
    ] = None


_TUPLES = (MemberOptions, Reach, LawFiles, RunOptions, PageServing)


def spread(run: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a command with an option for every field of its parameters that are tuples of
    options.
    """
    given = inspect.signature(run).parameters
    kinds = {n: p.annotation for n, p in given.items() if p.annotation in _TUPLES}
    parameters = [
        inner.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for name, outer in given.items()
        for inner in (
            inspect.signature(kinds[name]).parameters.values() if name in kinds else [outer]
        )
    ]

    @wraps(run)
    def gather(**values: Any) -> Any:
        for name, kind in kinds.items():
            values[name] = kind(*map(values.pop, kind._fields))
        return run(**values)

    vars(gather)["__signature__"] = inspect.Signature(parameters)
    gather.__annotations__ = {one.name: one.annotation for one in parameters}
    return gather

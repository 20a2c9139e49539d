"""The `trilat` command: the composition root, without logic of its own.

Law: a command parses, builds, calls one function of the library and prints. It exits 0 on success, 1 on a
failed run or comparison, 2 on bad input, 128 + n when signal n ended it; an error is one sentence.
"""

import gc
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer.core import TyperGroup

from .errors import TrilatError, UsageError

if TYPE_CHECKING:
    from .conclusion import Conclusion
    from .scenario import Scenario

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


class _Commands(TyperGroup):
    """The group of all commands; Ctrl-C ends any of them with 130, not with the framework's 1."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            err.print("interrupted")
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Dual-user teleoperation over a real network, in virtual time, and again from the log.",
    epilog="Begin with: trilat demo paper",
)
scenario_app = typer.Typer(no_args_is_help=True, help="The shipped scenarios and your own.")
app.add_typer(scenario_app, name="scenario")

ScenarioArgument = Annotated[str, typer.Argument(help="Name of a shipped scenario, or path of a TOML file.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a key, as in control.Kd=5; repeatable."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Override the scenario's seed.")]
DurationOption = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="Override how long it runs, s.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace what exists.")]
ListenOption = Annotated[
    list[str] | None,
    typer.Option("--listen", metavar="EP", help="Endpoint to listen at, as in tcp/192.0.2.1:7447."),
]
ConnectOption = Annotated[
    list[str] | None, typer.Option("--connect", metavar="EP", help="Endpoint to connect to; repeatable.")
]


def _seconds(value: float | None) -> float | None:
    """Refuses what is no time to wait."""
    if value is not None and not 0.0 <= value <= 86_400.0:
        raise UsageError(f"--join-timeout is a number of seconds from 0 to 86400, not {value:g}")
    return value


LogArgument = Annotated[Path, typer.Argument(help="An MCAP log.", metavar="FILE")]


def _load(source: str, overrides: list[str] | None, duration: float | None, seed: int | None) -> "Scenario":
    from .scenario import load

    given = list(overrides or [])
    if duration is not None:
        given.append(f"duration_s={duration!r}")
    if seed is not None:
        given.append(f"seed={seed}")
    return load(source, given)


@app.command(epilog="Example: trilat demo paper --duration 10 --set control.Kd=5")
def demo(
    scenario: ScenarioArgument = "paper",
    duration: DurationOption = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where results go; default runs/NAME-N.")
    ] = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Runs a scenario live: every site and a recorder as processes over Zenoh, then verifies and reports."""
    from sites.demo import run_demo
    from sites.display import Display

    from .conclusion import conclude, results_folder
    from .experiment import open_log

    chosen = _load(scenario, overrides, duration, seed)
    results = results_folder(folder, chosen.name, force=force)
    out.print(f"{escape(chosen.title or chosen.name)}")
    out.print(f"{chosen.duration_s:g} s live: {', '.join(chosen.names)} and a recorder; Ctrl-C ends it")
    with Display(chosen, out) as display:
        outcome = run_demo(chosen, results, display)
    for problem in outcome.problems:
        err.print(f"error: {escape(problem)}", soft_wrap=True)
    if outcome.interrupted:
        kept = f"; {outcome.log} holds what there was" if outcome.log.exists() else ""
        err.print(f"interrupted{escape(kept)}", soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not outcome.log.exists():
        raise typer.Exit(1)
    out.print("checking the log and drawing ...")
    conclusion = conclude(open_log(outcome.log), results)
    _print_conclusion(conclusion)
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(1)


@app.command(epilog="Example: trilat site m1 --scenario paper")
def site(
    name: Annotated[str, typer.Argument(help="Which site of the scenario this is.")],
    scenario: Annotated[str, typer.Option("--scenario", "-s", help="Shipped name or path.")],
    session: Annotated[
        str | None, typer.Option("--session", metavar="ID", help="Default: the scenario's name.")
    ] = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    join_timeout: Annotated[
        float,
        typer.Option(
            "--join-timeout", metavar="S", help="How long to wait for the others, s.", callback=_seconds
        ),
    ] = 60.0,
    needs_recorder: Annotated[
        bool, typer.Option("--needs-recorder", help="Do not begin without a recorder.")
    ] = False,
    cpu: Annotated[int | None, typer.Option("--cpu", help="Stay on this processor.")] = None,
    duration: DurationOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
) -> None:
    """Runs one site as one process: for separate terminals or machines.

    Without endpoints, sites of a session find each other on this machine: each listens at a loopback port
    that follows from session and site, and connects to the sites before it in the scenario.
    """
    from sites.process import Options, run_site

    from .net.endpoints import default_endpoints
    from .scenario import site_named

    chosen = _load(scenario, overrides, duration, seed)
    site_named(chosen, name)
    identity = _session_name(session or chosen.name)
    places = default_endpoints(identity, chosen.names)
    before = chosen.names[: chosen.names.index(name)]
    options = Options(
        session=identity,
        listen=listen if listen is not None else [places[name]],
        connect=connect if connect is not None else [places[peer] for peer in before],
        join_timeout_s=join_timeout,
        needs_recorder=needs_recorder,
        cpu=cpu,
    )
    code = run_site(chosen, name, options, _say)
    raise typer.Exit(code)


@app.command(epilog="Example: trilat record --session paper -o run.mcap")
def record(
    session: Annotated[str, typer.Option("--session", metavar="ID", help="Which session to record.")],
    listen: ListenOption = None,
    connect: ConnectOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Default: SESSION.mcap.")
    ] = None,
    join_timeout: Annotated[
        float | None,
        typer.Option(
            "--join-timeout",
            metavar="S",
            help="How long to wait for it to begin, s; default: for ever.",
            callback=_seconds,
        ),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Records one session, from its epoch to its end or to Ctrl-C.

    Without endpoints it asks the first site, at its loopback port, who the others are.
    """
    from recorder.process import record_session

    path = output if output is not None else Path(f"{_session_name(session)}.mcap")
    if path.exists() and (not force or path.is_dir()):
        raise UsageError(f"{path}: exists; choose another name, or replace a file with --force")
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{path}: cannot be written: {path.parent} is no folder that takes files")
    path.unlink(missing_ok=True)
    code = record_session(_session_name(session), path, listen or [], connect, join_timeout, _say)
    raise typer.Exit(code)


@app.command(epilog="Example: trilat sim free -o free.mcap --set link.delay_ms=400")
def sim(
    scenario: ScenarioArgument,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Default: NAME.mcap.")
    ] = None,
    duration: DurationOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Runs the same experiment in virtual time, into the same kind of log."""
    from .experiment import record_virtual

    chosen = _load(scenario, overrides, duration, seed)
    path = output if output is not None else Path(f"{chosen.name}.mcap")
    within = record_virtual(chosen, path, force=force)
    out.print(f"{escape(str(path))}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        _fail(f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there")


@app.command(epilog="Example: trilat verify run.mcap")
def verify(
    file: LogArgument,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Compare with virtual time as well, with and without arrivals.")
    ] = False,
) -> None:
    """Executes every site again from a log, and compares every computed field of every record."""
    from .conclusion import check_lines

    passed = True
    for line in check_lines(file, virtual=virtual):
        passed &= line.passed
        (out if line.passed else err).print(escape(f"{line.label}: {line.text}"), soft_wrap=True)
    if not passed:
        raise typer.Exit(1)


@app.command(epilog="Example: trilat report run.mcap -o report")
def report(
    file: LogArgument,
    folder: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Default: FILE without .mcap.")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Makes the figures, the page and the summary of a log."""
    from .conclusion import conclude, results_folder
    from .experiment import open_log

    log = open_log(file)  # before a folder is made for it
    results = results_folder(folder if folder is not None else file.with_suffix(""), "", force=force)
    conclusion = conclude(log, results)
    _print_conclusion(conclusion)
    if not conclusion.agreed:
        raise typer.Exit(1)


@scenario_app.command("list", epilog="Example: trilat scenario list")
def scenario_list() -> None:
    """Lists the shipped scenarios."""
    from .scenario import load, shipped

    table = Table(box=None, pad_edge=False)
    for column in ("name", "sites", "s", "what it is"):
        table.add_column(column)
    for name in shipped():
        chosen = load(name)
        table.add_row(name, str(len(chosen.names)), f"{chosen.duration_s:g}", escape(chosen.title))
    out.print(table)


@scenario_app.command("show", epilog="Example: trilat scenario show paper --set control.Kd=5")
def scenario_show(
    name: ScenarioArgument,
    duration: DurationOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
) -> None:
    """Prints the resolved text of a scenario: every value of every site and link."""
    sys.stdout.write(_load(name, overrides, duration, seed).text)


@scenario_app.command("check", epilog="Example: trilat scenario check mine.toml")
def scenario_check(
    file: ScenarioArgument,
    overrides: SetOption = None,
) -> None:
    """Says whether a scenario is valid, and what follows from it."""
    from .conclusion import scenario_facts

    for line in scenario_facts(_load(file, overrides, None, None)):
        out.print(escape(line), soft_wrap=True)


@scenario_app.command("new", epilog="Example: trilat scenario new mine.toml")
def scenario_new(
    file: Annotated[Path, typer.Argument(help="The file to make.")], force: ForceOption = False
) -> None:
    """Writes a commented template, with the unit of every key."""
    from .experiment import new_file
    from .scenario import template_text

    with new_file(file, force) as stream:
        stream.write(template_text().encode())
    out.print(f"{escape(str(file))}: a template; check it with: trilat scenario check {escape(str(file))}")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _session_name(name: str) -> str:
    """Refuses what cannot stand in a key."""
    if not name or not all(c.isalnum() or c in "_-." for c in name):
        raise UsageError(f"a session's name is letters, digits, _, - and ., not {name!r}")
    return name


def _fail(text: str) -> NoReturn:
    err.print(f"error: {escape(text)}", soft_wrap=True)
    raise typer.Exit(1)


def _print_conclusion(conclusion: "Conclusion") -> None:
    table = Table(box=None, pad_edge=False)
    for column in conclusion.columns:
        table.add_column(column, justify="left" if column == "site" else "right")
    for row in conclusion.rows:
        table.add_row(*row)
    out.print(table)
    for line in conclusion.lines:
        mark = "[green]ok[/green]  " if line.passed else "[red]FAIL[/red]"
        out.print(f"{mark} {escape(line.label)}: {escape(line.text)}", soft_wrap=True)
    for path in conclusion.paths:
        out.print(f"  {escape(str(path))}", soft_wrap=True)


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


if __name__ == "__main__":
    main()

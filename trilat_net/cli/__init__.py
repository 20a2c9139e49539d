"""The `trilat` command: registers all commands and maps errors to exit codes.

Invariant: a command parses, calls one function of the library and prints. It exits 0 on success, 1 on a
failed run or comparison, 2 on bad input, 4 when a law of a log may not run, 5 when a disk takes no more,
128 + n when signal n ended it; an error is one sentence.
"""

import errno
import gc
import inspect
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ..errors import LogRefused, TrilatError
from ..files import DISK_ERRNOS
from ..process import Interrupt
from ..reporting.terminal_output import err, print_error, print_line
from . import inputs, log, members, options, runs, sessions, studies, sweep
from .options import flag


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
                raise typer.Exit(interrupt.exit_code if interrupt.requested() else 130) from None


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
        from importlib.metadata import version

        print_line(f"trilat-net {version('trilat-net')}")
        raise typer.Exit


@app.callback()
def _main(
    _: Annotated[
        bool, flag("--version", "Print the version and exit.", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    pass


_SINGLE = {
    "demo": ["paper --duration 10 --set control.Kd=5"],
    "live": ["play", "--session paper"],
    "site": ["m1 --scenario paper"],
    "record": ["--session paper -o run.mcap --split-duration 600"],
    "ping": ["--session paper"],
    "watch": ["--session paper"],
    "stop": ["--session paper s", "--session paper --end"],
    "enable": ["--session paper s"],
    "reset": ["--session paper s"],
    "doctor": ["--keys keys/m1 --listen tls/0.0.0.0:7447", "--session paper"],
    "router": ["--keys keys/router"],
    "sim": ["free -o free.mcap --set link.delay_ms=400"],
    "verify": ["run.mcap"],
    "certify": ["run.mcap"],
    "twin": ["run.mcap --at 12 --push m1.q1=1e-6 -o twin.png", "run.mcap --delta 1e-9:1e-3"],
    "metrics": ["run.mcap"],
    "compare": ["a.mcap b.mcap", "--tune free --law adaptive,p_d"],
    "figure": ["run.mcap positions settling --width 3.5 --format pdf --out paper"],
    "report": ["run.mcap -o report"],
    "replay": ["run.mcap --rate 2 --start 5"],
    "rerun": ["run.mcap --replace s --set control.Kd=5 -o kd5.mcap"],
}
_LOG = {
    "info": ["run.mcap"],
    "check": ["run.mcap", "run.mcap --key lab.pub"],
    "sign": ["run.mcap --key lab.key"],
    "recover": ["run.mcap.active"],
    "export": ["run.mcap --to parquet"],
    "view": ["run.mcap"],
}
_STUDIES = {
    "test": ["jitter --seeds 1..20 --junit out.xml"],
    "sweep": [
        "p_d_margin --over link.delay_ms=0:1600:50 --over control.d=0.2:3:0.1",
        "p_d_margin --over link.delay_ms=100,200,400 --margin control.d=0.2:3",
        "runs/sweep-p_d_margin-001 --cell 17",
    ],
    "bench": ["--small", "--study round-trips --law wave,smith"],
    "linear": ["p_d_margin --set control.d=0.9 --over control.d=0.1:3"],
}
_SCENARIO = {"list": [""], "show": ["paper --set control.Kd=5"], "check": ["mine.toml"], "new": ["mine.toml"]}
_NEW = {"law": ["mylaw.py"]}
_TRACE = {"import": ["irtt run.json.gz", "csv drive.txt --way half -o drive.csv"]}
_SET = {"link": ["'m1->s' --delay 350ms --loss 5%"], "dominance": ["s m1=0.9 m2=0.1"]}
_KEYS = {
    "new": ["keys m1 m2 s recorder operator --host 192.0.2.1"],
    "pair": ["lab"],
    "info": ["keys/m1"],
}

_MODULES = (sessions, members, runs, log, studies, sweep, inputs)
_FUNCTIONS = {name: run for module in _MODULES for name, run in vars(module).items()}


def _group(examples: dict[str, list[str]], words: str = "", **more: Any) -> typer.Typer:
    """Returns a group of commands: by name the arguments of their examples, which follow `words`.

    The function of a command `log info` is `log_info_command`, that of `ping` is `ping_command`.
    """
    group = typer.Typer(**more)
    for name, arguments in examples.items():
        run = _FUNCTIONS[f"{'_'.join([*words.split()[:1], name])}_command"]
        epilog = "\n\n".join(f"Example: trilat {words}{name} {one}".rstrip() for one in arguments)
        text = run.__doc__ or "(Its help is left out by python -OO: start it as python -O.)"
        paragraphs = inspect.cleandoc(text).split("\n\n")  # else lines break where the source's do
        text = "\n\n".join(" ".join(lines.split()) for lines in paragraphs)
        group.command(name, help=text, epilog=epilog)(options.spread(run))
    return group


def _add(name: str, examples: dict[str, list[str]], words: str = "", **more: Any) -> None:
    """Adds a group of commands to `trilat`; `words` follow its name in their examples."""
    app.add_typer(_group(examples, f"{name} {words}", no_args_is_help=True, **more), name=name)


app.add_typer(_group(_SINGLE))
_add("log", _LOG, help="Inspects, checks, signs, recovers, exports or views a log.")
app.add_typer(_group(_STUDIES))
_add("scenario", _SCENARIO, help="The shipped scenarios and your own.")
_add("new", _NEW, help="A control law of your own, with its test.")
_add("trace", _TRACE, help="Imports delays that other programs measured.")
_add("set", _SET, "--session paper ", callback=options.spread(sessions.set_command))
_add("keys", _KEYS, help="Keys that authenticate members of a session, and sign logs.")


_TOO_LITTLE = "there is too little memory: 3 GiB of addresses suffice (ulimit -v), and 1 GiB of memory itself"
_WITHOUT_MEMORY = ("failed to map segment", "libllvmlite", "start new thread", "allocate memory")
"""What Python, Numba and threads say who get none."""


def main() -> None:
    """Runs `trilat`; errors become one sentence and an exit code."""
    TrilatError.in_command = True
    try:
        app()
    except TrilatError as error:
        print_error(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of a pipe has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except (MemoryError, ImportError, RuntimeError, OSError) as error:
        if isinstance(error, MemoryError) or any(text in str(error) for text in _WITHOUT_MEMORY):
            sys.stderr.write(f"error: {_TOO_LITTLE}\n")  # to lay it out takes memory, too
            sys.exit(1)
        if not isinstance(error, OSError):  # else a full disk, a folder that vanished
            raise
        print_error(f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}")
        bad_name = error.errno == errno.ENAMETOOLONG
        sys.exit(LogRefused.exit_code if error.errno in DISK_ERRNOS else 2 if bad_name else 1)
    finally:
        TrilatError.in_command = False
        gc.freeze()  # at exit, Python need not traverse every record

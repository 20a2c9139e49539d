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
from . import (
    bench,
    certify,
    compare,
    demo,
    doctor,
    figure,
    keys,
    linear,
    live,
    log,
    metrics,
    new,
    ping,
    record,
    replay,
    report,
    rerun,
    router,
    scenario,
    sim,
    site,
    stop,
    sweep,
    test,
    trace,
    verify,
    watch,
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
        bool,
        typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=_print_version),
    ] = False,
) -> None:
    pass


def _group(commands: dict[str, tuple[Any, ...]], words: str = "", **options: Any) -> typer.Typer:
    """Returns a group of commands: by name a function and arguments of examples, which follow `words`."""
    group = typer.Typer(**options)
    for name, (run, *examples) in commands.items():
        epilog = "\n\n".join(f"Example: trilat {words}{name} {example}".rstrip() for example in examples)
        text = run.__doc__ or "(Its help is left out by python -OO: start it as python -O.)"
        paragraphs = inspect.cleandoc(text).split("\n\n")  # else lines break where the source's do
        text = "\n\n".join(" ".join(lines.split()) for lines in paragraphs)
        group.command(name, help=text, epilog=epilog)(run)
    return group


_SINGLE = {
    "demo": (demo.demo_command, "paper --duration 10 --set control.Kd=5"),
    "live": (live.live_command, "play", "--session paper"),
    "site": (site.site_command, "m1 --scenario paper"),
    "record": (record.record_command, "--session paper -o run.mcap --split-duration 600"),
    "ping": (ping.ping_command, "--session paper"),
    "watch": (watch.watch_command, "--session paper"),
    "stop": (stop.stop_command, "--session paper s", "--session paper --end"),
    "enable": (stop.enable_command, "--session paper s"),
    "reset": (stop.reset_command, "--session paper s"),
    "doctor": (doctor.doctor_command, "--keys keys/m1 --listen tls/0.0.0.0:7447", "--session paper"),
    "router": (router.router_command, "--keys keys/router"),
    "sim": (sim.sim_command, "free -o free.mcap --set link.delay_ms=400"),
    "verify": (verify.verify_command, "run.mcap"),
    "certify": (certify.certify_command, "run.mcap"),
    "metrics": (metrics.metrics_command, "run.mcap"),
    "compare": (compare.compare_command, "a.mcap b.mcap", "--tune free --law adaptive,p_d"),
    "figure": (
        figure.figure_command,
        "run.mcap positions settling --width 3.5 --format pdf --out paper",
    ),
    "report": (report.report_command, "run.mcap -o report"),
    "replay": (replay.replay_command, "run.mcap --rate 2 --start 5"),
    "rerun": (rerun.rerun_command, "run.mcap --replace s --set control.Kd=5 -o kd5.mcap"),
}
_LOG = {
    "info": (log.log_info_command, "run.mcap"),
    "check": (log.log_check_command, "run.mcap", "run.mcap --key lab.pub"),
    "sign": (log.log_sign_command, "run.mcap --key lab.key"),
    "recover": (log.log_recover_command, "run.mcap.active"),
    "export": (log.log_export_command, "run.mcap --to parquet"),
    "view": (log.log_view_command, "run.mcap"),
}
_STUDIES = {
    "test": (test.test_command, "jitter --seeds 1..20 --junit out.xml"),
    "sweep": (
        sweep.sweep_command,
        "p_d_margin --over link.delay_ms=0:1600:50 --over control.d=0.2:3:0.1",
        "p_d_margin --over link.delay_ms=100,200,400 --margin control.d=0.2:3",
        "runs/sweep-p_d_margin-001 --cell 17",
    ),
    "bench": (bench.bench_command, "--small", "--study round-trips --law wave,smith"),
    "linear": (linear.linear_command, "p_d_margin --set control.d=0.9 --over control.d=0.1:3"),
}
_SCENARIO = {
    "list": (scenario.scenario_list_command, ""),
    "show": (scenario.scenario_show_command, "paper --set control.Kd=5"),
    "check": (scenario.scenario_check_command, "mine.toml"),
    "new": (scenario.scenario_new_command, "mine.toml"),
}
_NEW = {"law": (new.new_law_command, "mylaw.py")}
_TRACE = {
    "import": (trace.trace_import_command, "irtt run.json.gz", "csv drive.txt --way half -o drive.csv"),
}
_SET = {
    "link": (set_command.set_link_command, "'m1->s' --delay 350ms --loss 5%"),
    "dominance": (set_command.set_dominance_command, "s m1=0.9 m2=0.1"),
}
_KEYS = {
    "new": (keys.keys_new_command, "keys m1 m2 s recorder operator --host 192.0.2.1"),
    "pair": (keys.keys_pair_command, "lab"),
    "info": (keys.keys_info_command, "keys/m1"),
}
_CHANGES = _group(_SET, "set --session paper ", no_args_is_help=True)
_CHANGES.callback()(set_command.set_command)
app.add_typer(_group(_SINGLE))
app.add_typer(
    _group(
        _LOG, "log ", no_args_is_help=True, help="Inspects, checks, signs, recovers, exports or views a log."
    ),
    name="log",
)
app.add_typer(_group(_STUDIES))
app.add_typer(
    _group(_SCENARIO, "scenario ", no_args_is_help=True, help="The shipped scenarios and your own."),
    name="scenario",
)
app.add_typer(
    _group(_NEW, "new ", no_args_is_help=True, help="A control law of your own, with its test."), name="new"
)
app.add_typer(
    _group(_TRACE, "trace ", no_args_is_help=True, help="Imports delays that other programs measured."),
    name="trace",
)
app.add_typer(_CHANGES, name="set")
app.add_typer(
    _group(
        _KEYS,
        "keys ",
        no_args_is_help=True,
        help="Keys that authenticate members of a session, and sign logs.",
    ),
    name="keys",
)


_TOO_LITTLE = "there is too little memory: 3 GiB of addresses suffice (ulimit -v), and 1 GiB of memory itself"


def _is_short_of_memory(error: Exception) -> bool:
    """True of what Python, Numba and threads say who get no memory."""
    texts = ("failed to map segment", "libllvmlite", "start new thread", "allocate memory")
    return isinstance(error, MemoryError) or any(text in str(error) for text in texts)


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
    except OSError as error:  # a full disk, a folder that vanished
        short = _is_short_of_memory(error)
        print_error(
            _TOO_LITTLE
            if short
            else f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}"
        )
        bad_name = error.errno == errno.ENAMETOOLONG
        sys.exit(LogRefused.exit_code if error.errno in DISK_ERRNOS else 2 if bad_name else 1)
    except (MemoryError, ImportError, RuntimeError) as error:
        if not _is_short_of_memory(error):
            raise
        print_error(_TOO_LITTLE)
        sys.exit(1)
    finally:
        TrilatError.in_command = False
        gc.freeze()  # at exit, Python need not traverse every record

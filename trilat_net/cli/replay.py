"""`trilat replay`: publishes a log over Zenoh with its original timing, as a session of its own."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape

from ..errors import UsageError
from ..reporting.terminal_output import err, out, print_line, print_table, progress_bar
from ..reporting.text_table import TextTable
from .options import (
    ConnectOption,
    ListenOption,
    RouterOption,
    ZenohConfigOption,
    check_session_name,
    resolve_connection,
)

if TYPE_CHECKING:
    from recorder.play.play_process import PlaybackSummary
    from recorder.play.player import PlayProgress
    from recorder.play.session_reader import SessionHeader

    from ..net.clock import Clock


app = typer.Typer()

_MIB = 1 << 20


@app.command("replay", epilog="Example: trilat replay run.mcap --rate 2 --start 5")
def replay_command(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="An MCAP log, or the parts of one in their order.")
    ],
    rate: Annotated[
        str, typer.Option("--rate", metavar="X", help="How much faster than it was; max: as fast as can be.")
    ] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, until Ctrl-C.")] = False,
    start: Annotated[
        float | None, typer.Option("--start", metavar="S", help="From when on, s since tick 0.")
    ] = None,
    stop: Annotated[float | None, typer.Option("--stop", metavar="S", help="Until when.")] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="How long, instead of --stop.")
    ] = None,
    include: Annotated[
        list[str] | None,
        typer.Option(
            "--include",
            metavar="KEYEXPR",
            help="Only these channels, as in '**/m1/*'; repeatable. Default: all that the sites published.",
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        typer.Option("--exclude", metavar="KEYEXPR", help="Not these, as in '**/link'; repeatable."),
    ] = None,
    prefix: Annotated[
        str,
        typer.Option("--prefix", metavar="WORD", help="The session is WORD-NAME; '': NAME, as recorded."),
    ] = "replay",
    session: Annotated[
        str | None, typer.Option("--session", metavar="ID", help="Name the session so, without a prefix.")
    ] = None,
    time: Annotated[
        str, typer.Option("--time", metavar="publish|log", help="As it was sent, or as it arrived.")
    ] = "publish",
    low_cpu: Annotated[
        bool, typer.Option("--low-cpu", help="Sleep to every deadline: some 0.1 ms less exact.")
    ] = False,
    needs_recorder: Annotated[
        bool, typer.Option("--needs-recorder", help="Do not begin without a recorder.")
    ] = False,
    preload: Annotated[
        int,
        typer.Option(
            "--preload", metavar="MIB", help="Most to hold in memory; more is read by a process meanwhile."
        ),
    ] = 256,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    router: RouterOption = None,
    zenoh_config: ZenohConfigOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Publishes a log over Zenoh with its original timing, as a session of its own.

    Recorders, viewers and `trilat ping` find it as they find a running session: it answers for the sites of
    the log, and its messages are theirs, byte for byte. Without endpoints it listens where the session's
    first site would.
    """
    from recorder.play.pace import parse_rate
    from recorder.play.play_process import PlayOptions, play_log
    from recorder.play.session_reader import parse_selection, preload_messages

    from ..net.clock import SystemClock
    from ..net.connection import default_endpoint
    from ..process import Interrupt

    if preload < 0:
        raise UsageError(f"--preload is a number of MiB, not {preload}")
    selection = parse_selection(include or (), exclude or (), start, stop, duration, _time(time))
    speed = parse_rate(rate)
    with progress_bar(f"reading {files[0]}") as progress:
        facts, block = preload_messages(files, selection, preload * _MIB, progress)
    name = check_session_name(session or (f"{prefix}-{facts.session}" if prefix else facts.session))
    place = [default_endpoint(name, 0)]
    connection = resolve_connection(listen, connect, router, zenoh_config, place, [])
    options = PlayOptions(name, speed, loop, low_cpu, needs_recorder)
    tell = err if as_json else out
    for line in _opening_lines(facts, name, speed):
        tell.print(escape(line), soft_wrap=True)
    told = set(facts.torn)
    _warn_torn(facts.torn)
    clock = SystemClock()
    with Interrupt() as interrupt:
        outcome = play_log(
            (facts, block),
            files,
            selection,
            options,
            connection,
            clock,
            interrupt.requested,
            lambda text: tell.print(escape(text), soft_wrap=True),
            _line(clock),
        )
    if outcome is None:
        raise typer.Exit(interrupt.exit_code)
    if as_json:
        print_line(json.dumps({"session": name, **_facts(outcome, speed)}, indent=2))
    else:
        _show(outcome)
    _warn_torn({path: text for path, text in outcome.torn.items() if path not in told})
    _warn_undelivered(outcome)
    if interrupt.requested():
        err.print("interrupted")
        raise typer.Exit(interrupt.exit_code)
    if outcome.cut or outcome.strays:
        raise typer.Exit(1)


def _time(text: str) -> Literal["publish", "log"]:
    if text not in ("publish", "log"):
        raise UsageError(f"--time is publish (as it was sent) or log (as it arrived), not {text!r}")
    return "publish" if text == "publish" else "log"


def _opening_lines(facts: "SessionHeader", name: str, rate: float) -> list[str]:
    """Says what is going to be played."""
    from ..net.messages import VERSION

    speed = "as fast as can be" if math.isinf(rate) else f"at {rate:g} times its speed"
    lines = [f"playing {', '.join(facts.boots)} as session {name}, {speed}; Ctrl-C ends it"]
    if facts.version != VERSION:
        lines.append(
            f"note: these messages are of schema version {facts.version}: recorders and sites of today take "
            f"{VERSION} and count others as dropped; any other Zenoh subscriber gets them"
        )
    return lines


def _line(clock: "Clock") -> Callable[["PlayProgress"], None]:
    """Returns what shows where the play is: one line, on a terminal."""
    before: list[tuple[int, int]] = []

    def show(progress: "PlayProgress") -> None:
        now = (clock.monotonic_ns(), progress.position_ns)
        then = before.pop() if before else now
        before.append(now)
        rate = (now[1] - then[1]) / (now[0] - then[0]) if now[0] > then[0] else 0.0
        text = (
            f"{progress.position_ns / 1e9:8.1f} s   x{rate:.2f}   {progress.published} messages   "
            f"latest {progress.late_max_us / 1e3:.2f} ms late"
        )
        err.file.write(f"\r{text:<72}")
        err.file.flush()

    return show if err.is_interactive else lambda _: None


def _facts(outcome: "PlaybackSummary", rate: float) -> dict[str, Any]:
    """Returns the summary as JSON says it."""
    late = outcome.lateness
    return {
        "messages": outcome.counts,
        "published": sum(outcome.counts.values()),
        "rounds": outcome.rounds,
        "rate": None if math.isinf(rate) else rate,
        "took_s": round(outcome.took_s, 6),
        "late_us": None if late is None else {"p50": late.p50_us, "p99": late.p99_us, "max": late.max_us},
        "held_s": round(outcome.held_s, 3),
        "cut": outcome.cut,
        "strays": outcome.strays,
        "recorders": outcome.recorders,
        "stored": outcome.stored if outcome.recorders else None,
        "told": outcome.refilled,
        "torn": {str(path): text for path, text in outcome.torn.items()},
    }


def _show(outcome: "PlaybackSummary") -> None:
    """Prints the summary for people."""
    if err.is_interactive:
        err.file.write("\r" + " " * 72 + "\r")
    rows = [(topic, str(count)) for topic, count in sorted(outcome.counts.items())]
    print_table(TextTable(("channel", "messages"), rows, align="lr"))
    late = outcome.lateness
    total = f"{sum(outcome.counts.values())} messages in {outcome.took_s:.2f} s"
    rounds = f", {outcome.rounds} rounds" if outcome.rounds > 1 else ""
    how = f"; late by p50 {late.p50_us} us, p99 {late.p99_us} us, max {late.max_us} us" if late else ""
    held = f"; waited {outcome.held_s:.2f} s for who did not keep up" if outcome.held_s > 0.1 else ""
    dropped = "" if outcome.cut else "; none dropped"
    out.print(f"{total}{rounds}{how}{held}{dropped}", soft_wrap=True)
    if outcome.recorders:
        has = "has everything" if outcome.stored else "has not said that it has everything"
        given = f"; it was given {outcome.refilled} messages that it had missed" if outcome.refilled else ""
        out.print(f"the recorder {has}{given}", soft_wrap=True)


def _warn_torn(torn: dict[Path, str]) -> None:
    """Says which files are not whole, and what mends them."""
    for path, text in torn.items():
        note = f"{path}: {text}; what is whole is played; make it whole with: trilat log recover {path}"
        err.print(f"note: {escape(note)}", soft_wrap=True)


def _warn_undelivered(outcome: "PlaybackSummary") -> None:
    """Says what did not come where it should have, or when."""
    if outcome.cut:
        err.print(
            f"error: somebody took nothing for 5 s and was cut off, {outcome.cut} times: what was played "
            "then did not come there",
            soft_wrap=True,
        )
    if outcome.strays:
        err.print(
            f"error: {outcome.strays} messages stand more than a minute from their place in the file, and "
            "were played late; with a larger --preload they are played in order",
            soft_wrap=True,
        )

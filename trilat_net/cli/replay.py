"""`trilat replay`: publishes a log over Zenoh with its original timing, as a session of its own."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from recorder.play.play_process import PlaybackSummary
    from recorder.play.player import PlayProgress
    from recorder.play.session_reader import SessionHeader

    from ..net.clock import Clock


_MIB = 1 << 20


def replay_command(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="An MCAP log, or the parts of one in their order.")
    ],
    rate: Annotated[
        str, options.value("--rate", "X", "Speed relative to the recording, or max: as fast as possible.")
    ] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="Start over at the end, until Ctrl-C.")] = False,
    start: Annotated[
        float | None, options.value("--start", "S", "Start of the part to play, s since tick 0.")
    ] = None,
    stop: Annotated[
        float | None, options.value("--stop", "S", "End of the part to play, s since tick 0.")
    ] = None,
    duration: Annotated[
        float | None, options.value("--duration", "S", "Duration of the part to play, s, instead of --stop.")
    ] = None,
    include: Annotated[
        list[str] | None,
        options.value(
            "--include",
            "KEYEXPR",
            "Play only these channels, as in '**/m1/*'; repeatable. Default: all of the sites.",
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        options.value("--exclude", "KEYEXPR", "Leave these channels out, as in '**/link'; repeatable."),
    ] = None,
    prefix: Annotated[
        str, options.value("--prefix", "WORD", "Name the session WORD-NAME; with '' NAME, as recorded.")
    ] = "replay",
    session: Annotated[
        str | None, options.value("--session", "ID", "Name of the session, without a prefix.")
    ] = None,
    time: Annotated[
        str, options.value("--time", "publish|log", "Play messages at their times of sending, or of arrival.")
    ] = "publish",
    low_cpu: Annotated[
        bool, typer.Option("--low-cpu", help="Sleep until every deadline, which is about 0.1 ms less exact.")
    ] = False,
    needs_recorder: options.NeedsRecorderOption = False,
    preload: Annotated[
        int,
        options.value(
            "--preload",
            "MIB",
            "Largest log held in memory; another process reads a larger one during the replay.",
        ),
    ] = 256,
    listen: options.ListenOption = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    insecure: options.InsecureOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Publishes a log over Zenoh with its original timing, as a session of its own.

    To recorders, viewers and `trilat ping` it looks like a running session: it answers for the sites of the
    log, and its messages are theirs, byte for byte. Without endpoints it listens where the session's first
    site would.
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
    with terminal.progress_bar(f"reading {files[0]}") as progress:
        facts, block = preload_messages(files, selection, preload * _MIB, progress)
    name = options.check_session_name(session or (f"{prefix}-{facts.session}" if prefix else facts.session))
    ways = listen, connect, router, zenoh_config, [default_endpoint(name, 0)]
    connection = options.resolve_connection(*ways, [], insecure=insecure)
    play = PlayOptions(name, speed, loop, low_cpu, needs_recorder)
    tell = partial((terminal.err if as_json else terminal.out).print, markup=False, soft_wrap=True)
    _announce(facts, name, speed, tell)
    reported = set(facts.torn)  # playing may add to them
    _warn_torn(facts.torn)
    clock = SystemClock()
    with Interrupt() as interrupt:
        outcome = play_log(
            (facts, block), files, selection, play, connection, clock, interrupt.requested, tell, _line(clock)
        )
    if outcome is None:
        raise typer.Exit(interrupt.exit_code)
    if as_json:
        terminal.print_json({"session": name, **_facts(outcome, speed)})
    else:
        _show(outcome)
    _warn_of(outcome, reported)
    if interrupt.requested():
        terminal.err.print("interrupted")
        raise typer.Exit(interrupt.exit_code)
    if outcome.cut or outcome.strays:
        raise typer.Exit(1)


def _time(text: str) -> Literal["publish", "log"]:
    if text not in ("publish", "log"):
        raise UsageError(f"--time is publish (as it was sent) or log (as it arrived), not {text!r}")
    return "publish" if text == "publish" else "log"


def _announce(facts: "SessionHeader", name: str, rate: float, tell: Callable[[str], None]) -> None:
    from ..net.messages import VERSION

    speed = "as fast as possible" if math.isinf(rate) else f"at {rate:g} times its speed"
    tell(f"playing {', '.join(facts.boots)} as session {name}, {speed}; Ctrl-C ends it")
    if facts.version != VERSION:
        tell(
            f"note: these messages are of schema version {facts.version}: recorders and sites of today take "
            f"{VERSION} and count others as dropped; any other Zenoh subscriber gets them"
        )


def _line(clock: "Clock") -> Callable[["PlayProgress"], None]:
    """Returns a function that shows the position on one line of a terminal."""
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
        terminal.err.file.write(f"\r{text:<72}")
        terminal.err.file.flush()

    return show if terminal.err.is_interactive else lambda _: None


def _facts(outcome: "PlaybackSummary", rate: float) -> dict[str, Any]:
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
    if terminal.err.is_interactive:
        terminal.err.file.write("\r" + " " * 72 + "\r")
    rows = [(topic, str(count)) for topic, count in sorted(outcome.counts.items())]
    terminal.print_table(TextTable(("channel", "messages"), rows, align="lr"))
    late = outcome.lateness
    total = f"{sum(outcome.counts.values())} messages in {outcome.took_s:.2f} s"
    rounds = f", {outcome.rounds} rounds" if outcome.rounds > 1 else ""
    how = f"; late by p50 {late.p50_us} us, p99 {late.p99_us} us, max {late.max_us} us" if late else ""
    held = f"; waited {outcome.held_s:.2f} s for slow subscribers" if outcome.held_s > 0.1 else ""
    dropped = "" if outcome.cut else "; none dropped"
    terminal.print_text(f"{total}{rounds}{how}{held}{dropped}")
    if outcome.recorders:
        has = "has everything" if outcome.stored else "has not confirmed that it has everything"
        given = (
            f"; {outcome.refilled} messages that it had missed were sent again" if outcome.refilled else ""
        )
        terminal.print_text(f"the recorder {has}{given}")


def _warn_torn(torn: dict[Path, str]) -> None:
    for path, text in torn.items():
        terminal.print_note(
            f"{path}: {text}; the whole part is played; make it whole with: trilat log recover {path}"
        )


def _warn_of(outcome: "PlaybackSummary", reported: set[Path]) -> None:
    """Warns of damage that was not `reported` before, and of messages that did not arrive or arrived late."""
    _warn_torn({path: text for path, text in outcome.torn.items() if path not in reported})
    if outcome.cut:
        terminal.print_error(
            f"a subscriber took nothing for 5 s and was cut off, {outcome.cut} times: it lacks the messages "
            "that were played then"
        )
    if outcome.strays:
        terminal.print_error(
            f"{outcome.strays} messages lie more than a minute from their place in the file, and were "
            "played late; with a larger --preload they are played in order"
        )

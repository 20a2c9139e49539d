"""Commands for the processes of a session, each of which can run on a separate machine.

A session is a live run. Its processes are the sites (one per arm, running the control loop),
the programs that act as operators, the recorder, and optionally a router or a bridge to ROS 2.
A replay publishes a log as if the session were running.
"""

import math
import os
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...errors import CodeWithheld, RunFailed, UsageError, count_nouns
from ...net import Clock, SystemClock
from ...presentation import TextTable
from ...presentation import terminal_output as terminal
from ...signals import Interrupt
from . import options
from .options import flag, seconds, value

if TYPE_CHECKING:
    from trilat_net.app.play.play_process import PlaybackSummary
    from trilat_net.app.play.player import PlayProgress
    from trilat_net.app.play.session_reader import SessionHeader

    from ...scenario import Scenario


@options.command("m1 --scenario paper", page="docs/sessions/network.md")
def site_command(
    name: Annotated[str, typer.Argument(autocompletion=options.complete_sites)],
    scenario: Annotated[
        str, typer.Option("--scenario", "-s", autocompletion=options.complete_scenarios)
    ],
    session: Annotated[
        str | None,
        value("--session", "ID", "Name of the session; default: the name of the scenario."),
    ] = None,
    *,
    ways: options.MemberOptions,
    join_timeout: Annotated[
        float, seconds("--join-timeout", "Longest wait for the other sites, in s.")
    ] = 60.0,
    needs_recorder: options.NeedsRecorderOption = False,
    cpu: Annotated[
        int | None, typer.Option("--cpu", help="Pin the process to this processor.")
    ] = None,
    stay: Annotated[float, seconds("--stay")] = 0.0,
    without: Annotated[list[str] | None, value("--without", "SITE")] = None,
    leave_timeout: Annotated[float | None, seconds("--leave-timeout")] = None,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
) -> None:
    """Runs one site of a session in its own process.

    Use it in separate terminals or on separate machines. Without endpoints, the sites of a
    session find each other on this machine: each site listens on a loopback port derived from
    the session name and site name, and connects to the sites listed before it in the scenario.

    Options:
        name: Name of the site in the scenario.
        scenario: Name of a shipped scenario, or path of a TOML file.
        stay: Longest time to wait at the end for the recorder to leave the session, in s.
        without: Begin without SITE, which may join later; repeatable. Only the first site
            accepts this option.
        leave_timeout: Longest time to continue after another site has left, if the arms then
            glide (on_stale.action = "glide"), in s; default: until the end of the run.
    """
    from sites import SiteOptions, run_site

    from ...net import DefaultEndpoints

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    chosen.find_site(name)
    session_name = options.check_session_name(session or chosen.name)

    # By default each site connects to the sites before it, so that each pair has one
    # connection.
    default_endpoints = DefaultEndpoints(session_name)
    endpoints = default_endpoints.by_site(chosen.names, encrypted=ways.keys is not None)
    earlier_sites = chosen.names[: chosen.names.index(name)]
    earlier_endpoints = [endpoints[site] for site in earlier_sites]
    connection = ways.resolve([endpoints[name]], earlier_endpoints).require(name)

    site_options = SiteOptions(
        session=session_name,
        connection=connection,
        join_timeout_s=join_timeout,
        needs_recorder=needs_recorder,
        cpu=cpu,
        stay_s=stay,
        clock_offset_s=clock_offset,
        clock_drift_ppm=clock_drift,
        without=_check_without(chosen, name, without or []),
        leave_timeout_s=leave_timeout,
    )
    raise typer.Exit(run_site(chosen, name, site_options, terminal.print_line))


def _check_without(scenario: "Scenario", name: str, without: list[str]) -> tuple[str, ...]:
    """Checks the sites that --without permits to be absent at the start of a session.

    Arms that join later are permitted only if all arms glide back to each other after a break.
    Only the first site (process of an arm) decides about the start of a session.

    Args:
        scenario: The scenario of the session.
        name: Name of this site.
        without: Names of the sites that may join later, from --without.

    Raises:
        UsageError: This site is not the first one, or the scenario does not let sites join
            later.
    """
    first_site = scenario.names[0]
    for late_site in without:
        scenario.find_site(late_site)
        if name != first_site or late_site == name:
            raise UsageError(
                f"--without can be given only at {first_site}, the first site, and must name "
                "other sites"
            )
        if not scenario.sites_may_return:
            raise UsageError('--without needs on_stale.action = "glide" at every site')
    return tuple(without)


@options.command(
    "--session paper -o run.mcap --split-duration 600", page="docs/sessions/recording.md"
)
def record_command(
    session: Annotated[str, value("--session", "ID", "Session to record.")],
    *,
    ways: options.MemberOptions,
    output: Annotated[Path | None, value("-o --out --output", "FILE")] = None,
    join_timeout: Annotated[float | None, seconds("--join-timeout")] = None,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
    concluded: Annotated[bool, flag("--conclude")] = False,
    include: Annotated[list[str] | None, value("--include", "KEYS")] = None,
    exclude: Annotated[list[str] | None, value("--exclude", "KEYS")] = None,
    split_size: Annotated[float | None, value("--split-size", "MIB")] = None,
    split_duration: Annotated[float | None, value("--split-duration", "S")] = None,
    carry_on: Annotated[
        bool, flag("--continue", "If the log exists, continue it in a new part.")
    ] = False,
    durable: Annotated[bool, flag("--durable")] = False,
    views: options.ViewsOption = "100",
    force: options.ForceOption = False,
    png: options.PngOption = False,
) -> None:
    """Records a session into an MCAP log.

    Recording lasts from the start of the session until its end or Ctrl-C. Without endpoints,
    the recorder connects to the first site's loopback port and asks it for the other sites. The
    parts of a split log are named FILE-001.mcap and so on. A file's name ends in .active until
    the file is finished.

    Options:
        output: File of the log; default: SESSION.mcap, or runs/SESSION-N/run.mcap with
            --conclude.
        join_timeout: Longest wait for the session to begin, in s; default: no limit.
        concluded: Verify the log at the end, and write a report into its folder.
        include: Record only these channels, for example '**/m1/**'; repeatable.
        exclude: Leave out these channels, for example '**/link'; repeatable.
        split_size: Split the log into parts of at most this size, MiB.
        split_duration: Split the log into parts of this duration, in s.
        durable: Sync to the disk at every flush instead of every second.
    """
    from recorder import record_session

    from ...files import refuse_existing
    from ...log import ChannelFilter, LogStorage, collect_provenance
    from ...net import RECORDER
    from ..machine_load import check_machine_load
    from ..recorded_session import make_scenario_reader
    from .options import parse_viz_rate

    options.check_session_name(session)
    connection = ways.resolve().require(RECORDER)
    path = _choose_path(output, session, concluded=concluded)
    storage = LogStorage(
        path,
        force=force,
        durable=durable,
        split_bytes=_parse_split("--split-size", "MiB", split_size, 1 << 20),
        split_ns=_parse_split("--split-duration", "seconds", split_duration, 10**9),
        carry_on=carry_on,
        choice=ChannelFilter.parse(include or [], exclude or []),
    )
    read_scenario = make_scenario_reader(parse_viz_rate(views))

    # Problems of the output are reported now, before the recorder waits for the session.
    storage.find_first_part()
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{path} cannot be written: {path.parent} is not a writable folder")

    page = path.parent / "report.html"
    if concluded:
        refuse_existing(page, force=force)
    clock = SystemClock.with_error(clock_offset, clock_drift)

    def warn_of_load() -> None:
        """Prints a warning if other programs are keeping this machine's processors busy.

        On a busy machine, the recorder may fall behind or lose messages, but it keeps
        recording.
        """
        warning = check_machine_load(clock)
        if warning:
            terminal.print_note(warning)

    def conclude() -> None:
        """Checks the finished log and writes its report, if --conclude was given.

        A log that is split into several files is treated as one.
        """
        if concluded:
            _conclude(list(storage.find_parts().values()), png=png)

    try:
        code = record_session(
            session=session,
            storage=storage,
            connection=connection,
            read_scenario=read_scenario,
            collect_provenance=collect_provenance,
            join_timeout_s=join_timeout,
            clock=clock,
            say=terminal.print_line,
            afterwards=conclude,
            warn=warn_of_load,
        )
    finally:
        if concluded and output is None:
            # Removes the new folder if nothing was written into it; otherwise this fails.
            with suppress(OSError):
                path.parent.rmdir()
    raise typer.Exit(code)


def _choose_path(output: Path | None, session: str, *, concluded: bool) -> Path:
    """Chooses the file of a session's log, and creates the folder for it and its report.

    Args:
        output: Path from --out. If `None`, the log is SESSION.mcap, or run.mcap in a new folder
            if there will be a report.
        session: Name of the session.
        concluded: True if a report is written into the folder of the log.
    """
    from ...files import make_folder, make_results_folder
    from ...package_names import require_libraries

    if not concluded:
        return output if output is not None else Path(f"{session}.mcap")

    require_libraries()

    if output is None:
        return make_results_folder(None, session, force=False) / "run.mcap"

    make_folder(output.parent)
    return output


def _conclude(files: list[Path], *, png: bool) -> None:
    """Checks a finished log, and writes a report about the run into the folder of the log.

    Args:
        files: Paths of all files into which the log was split.
        png: True to write every figure as a PNG file too.

    Raises:
        CodeWithheld: The log names a user's code, which was not executed. Therefore the log
            could not be verified completely.
        RunFailed: The log failed a check, or the session ended with a failure.
    """
    from ...presentation import conclude_files

    log, conclusion = conclude_files(files, files[0].parent, png=png)

    if conclusion.exit_code == CodeWithheld.exit_code:
        raise CodeWithheld(
            f"{files[0]}: parts of this log were not checked, because you have not permitted "
            "the code that the log names; check them with: trilat verify --law FILE"
        )

    if not conclusion.passed:
        raise RunFailed(f"the log {files[0]} failed a check")

    for event in log.events:
        if event.kind in ("diverged", "failed"):
            raise RunFailed(f"{files[0]}: {event.text}")


@options.command("run.mcap --rate 2 --start 5", page="docs/logs/replay.md")
def replay_command(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...")],
    rate: Annotated[str, value("--rate", "X")] = "1",
    loop: Annotated[bool, flag("--loop", "Start over at the end, until Ctrl-C.")] = False,
    start: Annotated[float | None, value("--start", "S")] = None,
    stop: Annotated[
        float | None, value("--stop", "S", "End of the part to play, in s after tick 0.")
    ] = None,
    duration: Annotated[float | None, value("--duration", "S")] = None,
    include: Annotated[list[str] | None, value("--include", "KEYEXPR")] = None,
    exclude: Annotated[list[str] | None, value("--exclude", "KEYEXPR")] = None,
    prefix: Annotated[str, value("--prefix", "WORD")] = "replay",
    session: Annotated[
        str | None,
        value("--session", "ID", "Name of the replayed session, to which no prefix is added."),
    ] = None,
    time: Annotated[str, value("--time", "publish|log")] = "publish",
    low_cpu: Annotated[bool, flag("--low-cpu")] = False,
    needs_recorder: options.NeedsRecorderOption = False,
    preload: Annotated[int, value("--preload", "MIB")] = 256,
    listen: options.ListenOption = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    insecure: options.InsecureOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Publishes a log on the network with its original timing.

    The log appears as a separate session. To recorders, viewers and `trilat ping`, the replay
    looks like a running session: it answers on behalf of the recorded sites and publishes their
    messages byte for byte. Without endpoints, the replay listens on the loopback port of the
    replayed session's first site.

    Options:
        files: MCAP file of the log, or the files of all its parts in order.
        rate: Speed relative to the recording, or max for as fast as possible.
        start: Start of the part to play, in s after tick 0.
        duration: Duration of the part to play, in s, instead of --stop.
        include: Play only these channels, for example '**/m1/*'; repeatable. Default: all
            channels of the sites.
        exclude: Leave out these channels, for example '**/link'; repeatable.
        prefix: Name the replayed session WORD-NAME, where NAME is the recorded name; '' keeps
            the recorded name.
        time: Timestamps that determine when messages are played: those at which they were sent
            (publish), or at which they arrived (log).
        low_cpu: Sleep until each deadline to save processor time; the timing is then about 0.1
            ms less exact.
        preload: Largest log that is held in memory, MiB; a separate process reads larger logs
            during the replay.
    """
    from trilat_net.app.play.play_process import PlayOptions, play_log
    from trilat_net.app.play.player import Pace
    from trilat_net.app.play.session_reader import PlaySelection, SessionReader

    from ...net import DefaultEndpoints

    if preload < 0:
        raise UsageError(f"--preload must be a number of MiB, at least 0, not {preload}")

    selection = PlaySelection.parse(
        include=include or (),
        exclude=exclude or (),
        start_s=start,
        stop_s=stop,
        duration_s=duration,
        time=time,
    )
    speed = Pace.parse_rate(rate)
    preload_bytes = preload << 20
    with terminal.progress_bar(f"reading {files[0]}") as progress:
        header, block = SessionReader(files, selection, progress).preload(preload_bytes)

    prefixed_name = f"{prefix}-{header.session}" if prefix else header.session
    name = options.check_session_name(session or prefixed_name)
    ways = options.MemberOptions(
        listen=listen,
        connect=connect,
        router=router,
        zenoh_config=zenoh_config,
        keys=None,
        insecure=insecure,
    )
    connection = ways.resolve([DefaultEndpoints(name).of_site(0)], [])

    play_options = PlayOptions(
        session=name, rate=speed, loop=loop, low_cpu=low_cpu, needs_recorder=needs_recorder
    )
    # With --json, the standard output contains nothing but the JSON.
    console = terminal.err if as_json else terminal.out
    print_line = partial(console.print, markup=False, soft_wrap=True)
    _announce_playback(header, name, speed, print_line)
    reported = set(header.torn)  # a copy, because the replay may find more torn files
    _warn_torn(header.torn)

    clock = SystemClock()
    with Interrupt() as interrupt:
        outcome = play_log(
            loaded=(header, block),
            paths=files,
            selection=selection,
            options=play_options,
            connection=connection,
            clock=clock,
            stopped=interrupt.is_requested,
            say=print_line,
            show=_make_progress_line(clock),
        )

    if outcome is None:
        raise typer.Exit(interrupt.exit_code)

    if as_json:
        terminal.print_json({"session": name, **_describe_playback(outcome, speed)})
    else:
        _show_playback(outcome)
    _warn_about_playback(outcome, reported)
    if interrupt.is_requested():
        terminal.err.print("interrupted")
        raise typer.Exit(interrupt.exit_code)
    if outcome.cut or outcome.strays:
        raise typer.Exit(1)


def _announce_playback(
    header: "SessionHeader", name: str, rate: float, print_line: Callable[[str], None]
) -> None:
    """Prints which arms of a log are replayed, as which session, and how fast.

    A note warns if the version of the messages differs from the version of this program's
    messages.

    Args:
        header: Description of the recorded session.
        name: Name of the session that the replay opens.
        rate: Speed relative to the recording. Infinity means as fast as possible.
        print_line: Function that prints a line.
    """
    from ...net import VERSION

    speed_text = "as fast as possible" if math.isinf(rate) else f"at {rate:g} times its speed"
    sites = ", ".join(header.boots)
    print_line(f"playing {sites} as session {name}, {speed_text}; Ctrl-C ends it")
    if header.version != VERSION:
        print_line(
            f"note: these messages are of schema version {header.version}: present recorders "
            f"and sites accept only {VERSION} and drop others; any other Zenoh subscriber "
            "receives them"
        )


def _make_progress_line(clock: Clock) -> Callable[["PlayProgress"], None]:
    """Returns a function that shows the progress of a replay in one line of the terminal.

    The line has the position in the recording, the present speed relative to the recording, the
    number of messages and the largest delay. If the output is not a terminal, the function does
    nothing.

    Args:
        clock: Clock of this process, from which the speed is computed.
    """
    if not terminal.err.is_interactive:
        return lambda _: None

    shown_at_ns: int | None = None
    shown_position_ns = 0

    def show(progress: "PlayProgress") -> None:
        """Overwrites the progress line of a replay in the terminal.

        The line shows the position in the log, the speed since the last update ("x1.00" is real
        time), the number of messages published, and the largest delay behind schedule.
        """
        nonlocal shown_at_ns, shown_position_ns
        now_ns = clock.monotonic_ns()
        position_ns = progress.position_ns
        speed = 0.0
        if shown_at_ns is not None and now_ns > shown_at_ns:
            speed = (position_ns - shown_position_ns) / (now_ns - shown_at_ns)
        shown_at_ns = now_ns
        shown_position_ns = position_ns

        text = (
            f"{position_ns / 1e9:8.1f} s   x{speed:.2f}   "
            f"{count_nouns(progress.published, 'message')}   "
            f"latest {progress.late_max_us / 1e3:.2f} ms late"
        )
        terminal.err.file.write(f"\r{text:<72}")
        terminal.err.file.flush()

    return show


def _describe_playback(outcome: "PlaybackSummary", rate: float) -> dict[str, Any]:
    """Returns the outcome of a replay as plain values, with the keys of `trilat replay --json`.

    A replay publishes the messages of a log again, at the times of the recording. Receivers may
    be slow, and recorders may store the messages.

    Args:
        outcome: The outcome.
        rate: Speed relative to the recording. Infinity means as fast as possible, and becomes
            `None`.

    Returns:
        The values by key. Comments in the function explain the keys.
    """
    lateness = outcome.lateness
    late_us = None
    if lateness is not None:
        late_us = {"p50": lateness.p50_us, "p99": lateness.p99_us, "max": lateness.max_us}
    has_recorders = bool(outcome.recorders)
    damaged_files = {path.as_posix(): reason for path, reason in outcome.torn.items()}
    return {
        # Number of published messages by topic, and of all of them.
        "messages": outcome.counts,
        "published": sum(outcome.counts.values()),
        # Number of passes through the log that were started.
        "rounds": outcome.rounds,
        "rate": None if math.isinf(rate) else rate,
        "took_s": round(outcome.took_s, 6),
        # How late messages were published. None if they had no deadlines.
        "late_us": late_us,
        # Time for which the replay waited for slow receivers, in s.
        "held_s": round(outcome.held_s, 3),
        # How often a receiver was disconnected, because it accepted no message for 5 s.
        "cut": outcome.cut,
        # Number of messages whose position in the file was too far from their turn.
        "strays": outcome.strays,
        # Number of recorders after the last message, and whether they stored all messages.
        "recorders": outcome.recorders,
        "stored": outcome.stored if has_recorders else None,
        # Number of messages that were sent again to recorders that missed them.
        "told": outcome.refilled,
        # Damaged files of the log, with the reason.
        "torn": damaged_files,
    }


def _show_playback(outcome: "PlaybackSummary") -> None:
    """Prints the outcome of a replay: numbers of messages, duration and lateness.

    The user also sees whether a recorder received all of the messages.
    """
    if terminal.err.is_interactive:
        terminal.err.file.write("\r" + " " * 72 + "\r")  # erases the line of the progress
    rows = [(topic, str(count)) for topic, count in sorted(outcome.counts.items())]
    terminal.print_table(TextTable(("channel", "messages"), rows, align="lr"))

    messages = count_nouns(sum(outcome.counts.values()), "message")
    summary = f"{messages} in {outcome.took_s:.2f} s"
    if outcome.rounds > 1:
        summary += f", {count_nouns(outcome.rounds, 'round')}"
    lateness = outcome.lateness
    if lateness:
        summary += (
            f"; late by p50 {lateness.p50_us} us, p99 {lateness.p99_us} us, "
            f"max {lateness.max_us} us"
        )
    if outcome.held_s > 0.1:
        summary += f"; waited {outcome.held_s:.2f} s for slow subscribers"
    if not outcome.cut:
        summary += "; none dropped"
    terminal.print_text(summary)

    if outcome.recorders:
        stored_text = "has not confirmed that it has everything"
        if outcome.stored:
            stored_text = "has everything"
        resent_text = ""
        if outcome.refilled:
            missed_text = count_nouns(outcome.refilled, "message")
            resent_text = f"; {missed_text} that it had missed were sent again"
        terminal.print_text(f"the recorder {stored_text}{resent_text}")


def _warn_torn(torn: dict[Path, str]) -> None:
    """Warns the user of log files that were cut off, for example by a power failure.

    Args:
        torn: Description of the damage, by file.
    """
    for path, text in torn.items():
        terminal.print_note(
            f"{path}: {text}; the intact part is played; "
            f"repair the file with: trilat log recover {path}"
        )


def _warn_about_playback(outcome: "PlaybackSummary", reported: set[Path]) -> None:
    """Warns the user of everything in a replay that differed from the recording.

    The warnings concern damaged files, receivers that were disconnected because they were too
    slow, and messages that were played late.

    Args:
        outcome: Outcome of the replay.
        reported: Damaged files of which the user has been warned already.
    """
    new_problems = {path: text for path, text in outcome.torn.items() if path not in reported}
    _warn_torn(new_problems)
    if outcome.cut:
        terminal.print_error(
            "a subscriber received nothing for 5 s and was cut off, "
            f"{count_nouns(outcome.cut, 'time')}: the subscriber lacks the messages "
            "that were played then"
        )
    if outcome.strays:
        terminal.print_error(
            f"{count_nouns(outcome.strays, 'message is', 'messages are')} stored more than a "
            "minute away from their chronological position in the file, and were "
            "played late; with a larger --preload they are played in order"
        )


LOOPBACK = "tcp/127.0.0.1:7447"
"""Default endpoint of a router without keys, which other machines cannot reach."""
ANY_ADDRESS = "tls/0.0.0.0:7447"
"""Default endpoint of a router with keys, whose connections are encrypted."""


@options.command("--keys keys/router", page="docs/sessions/network.md")
def router_command(
    listen: Annotated[
        list[str] | None,
        value(
            "--listen",
            "EP",
            "Endpoint to listen on; repeatable. "
            f"Default: {ANY_ADDRESS} with --keys, otherwise {LOOPBACK}.",
        ),
    ] = None,
    connect: options.ConnectOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    insecure: options.InsecureOption = False,
    until_idle: Annotated[
        float | None,
        seconds(
            "--until-idle",
            "End after all members have been absent for this long, in s; default: never.",
        ),
    ] = None,
) -> None:
    """Connects sites that cannot reach each other directly.

    A router is needed, for example, for sites behind NAT. Start the sites and the recorder with
    --router, in any order. The router runs until Ctrl-C, and a session continues if its router
    is restarted. Routers connected to each other with --connect act as one router.
    """
    from ...net import ROUTER, Connection
    from ..router import run_router

    default_listen = [LOOPBACK if keys is None else ANY_ADDRESS]
    open_connection = Connection.of_member(
        listen=listen,
        connect=connect,
        routers=None,
        file=zenoh_config,
        listen_else=default_listen,
        connect_else=(),
        routes=True,
    )
    secured = open_connection.secure(keys, insecure=insecure)
    connection = secured.require(ROUTER)
    expiry = connection.describe_end()
    if expiry:
        terminal.print_note(expiry)

    clock = SystemClock()
    with Interrupt() as interrupt:
        bus = connection.open_bus(
            clock=clock,
            stopped=interrupt.is_requested,
            timeout_s=None,
            say=terminal.print_line,
        )
        if bus is None:
            raise typer.Exit(interrupt.exit_code)
        with closing(bus):
            endpoints = ", ".join(map(str, connection.listen))
            _print_router_line(f"listening at {endpoints}; Ctrl-C ends it")
            run_router(
                bus=bus,
                clock=clock,
                stopped=interrupt.is_requested,
                say=_print_router_line,
                until_idle_s=until_idle,
            )
        raise typer.Exit(interrupt.exit_code if interrupt.is_requested() else 0)


def _print_router_line(text: str) -> None:
    """Prints a line that starts with "router:"."""
    terminal.print_line(f"router: {text}")


def _parse_split(option: str, unit: str, number: float | None, scale: int) -> int | None:
    """Parses an option such as --split-size, the size or duration at which a log is split.

    For example, 2 MB with the scale 1e6 gives 2000000 bytes.

    Args:
        option: Name of the option, for the error message.
        unit: Name of the option's unit, for the error message.
        number: Value of the option. `None` if the option is absent.
        scale: Bytes or ns per unit.

    Returns:
        The limit in bytes or ns. `None` if the option is absent.

    Raises:
        UsageError: The number is not from 1 to 1e6.
    """
    if number is None:
        return None
    if not 1.0 <= number <= 1e6:
        raise UsageError(f"{option} must be a number of {unit} from 1 to 1e6, not {number:g}")
    return int(number * scale)

"""Commands that start, show, measure, change or stop a session, or check this machine.

A session is a live run of several processes, possibly on different machines. Each of these
processes (sites) controls one robot arm and exchanges its state with the others over a network.
The commands reach the sites over the same network.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from ...errors import UsageError
from ...net import SystemClock
from ...presentation import MARKS
from ...presentation import terminal_output as terminal
from ...signals import Interrupt
from . import options
from .options import flag, value

if TYPE_CHECKING:
    from ...scenario import Scenario


@options.command("paper --duration 10 --set control.Kd=5")
def demo_command(
    scenario: options.ScenarioArgument = "paper", *, run: options.RunOptions
) -> None:
    """Runs a scenario live, verifies its log and writes a report.

    Each site and the recorder run in separate processes that communicate over Zenoh.
    """
    run_and_report(run.load(scenario), run)


class _SessionPage(Protocol):
    """A page in a browser that shows a session, and offers its results afterwards.

    The package trilat-people provides such a page. The commands use only these two methods, so
    they also work without this package.
    """

    def attend(
        self, session: str, endpoints: Sequence[str], say: Callable[[str], None]
    ) -> AbstractContextManager[Callable[[], bool]]:
        """Shows the session while it runs; see `SessionAttendant` for arguments and result."""

    def offer_results(self, paths: Iterable[Path]) -> None:
        """Adds links for downloading the report and the log to the session's web page.

        Args:
            paths: Files written by the run.
        """


def _describe_log(path: Path) -> str:
    """Describes the log of an interrupted session in a phrase that ends a sentence.

    For example ": 1200 records, 0 missing". The text tells the user whether the log is worth
    keeping.

    Args:
        path: The log.

    Returns:
        A text that starts with a colon. Empty if the log cannot be read.
    """
    from ...errors import LogError
    from ...log import open_log

    with suppress(LogError):
        # The headline names the session first, which the user knows.
        _, _, contents = open_log(path).headline().partition("; ")
        return f": {contents}"
    return ""


def run_and_report(
    chosen: "Scenario", run: options.RunOptions, page: "_SessionPage | None" = None
) -> None:
    """Runs a scenario live, then checks its log and writes a report about the run.

    Args:
        chosen: The scenario.
        run: The options of the run.
        page: Browser page that shows the session, offers a button to end it, and links to the
            report. `None` if there is no page.

    Raises:
        typer.Exit: The session was interrupted or had problems, or the log failed a check.
    """
    from trilat_net.app.demo_session import run_demo

    from ...files import make_results_folder
    from ...package_names import require_libraries

    require_libraries()
    results = make_results_folder(run.folder, chosen.name, force=run.force)
    with terminal.lines_aside(run.as_json):
        terminal.print_text(chosen.title or chosen.name)
        members = f"{', '.join(chosen.names)} and a recorder, session {chosen.name}"
        terminal.print_text(f"{chosen.duration_s:g} s live: {members}; Ctrl-C ends it")
        outcome = run_demo(chosen, results, terminal.out, page.attend if page else None)
    for problem in outcome.problems:
        terminal.print_error(problem)

    has_log = outcome.log.exists()
    # With a page, an interruption is the normal end of a session, and its log is verified.
    ends_without_report = outcome.interrupted and not (page and has_log)
    if ends_without_report:
        log_note = ""
        if has_log:
            log_note = f"; {outcome.log} holds the records so far{_describe_log(outcome.log)}"
        terminal.err.print(f"interrupted{log_note}", markup=False, soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not has_log:
        raise typer.Exit(outcome.exit_code)

    # imported after the session, whose start it would delay
    from ...presentation import conclude_files

    _, conclusion = conclude_files([outcome.log], results, as_json=run.as_json, png=run.png)
    if page is not None:
        page.offer_results((conclusion.page, outcome.log))
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(outcome.exit_code)


_check_count = options.check_range(5, 10_000, "a number")


@options.command("--session paper", page="docs/sessions/network-check.md")
def ping_command(
    context: typer.Context,
    session: Annotated[str, value("--session", "ID", "Session to measure.")] = "paper",
    *,
    reach: options.Reach,
    count: Annotated[
        int,
        value("--count", "N", "Number of round trips to each member.", callback=_check_count),
    ] = 50,
    timeout: options.AnswerOption = 3.0,
    benchmark: Annotated[
        str | None, value("--benchmark", "SCENARIO", autocompletion=options.complete_scenarios)
    ] = None,
    ros2: Annotated[str | None, value("--ros2", "TOPIC")] = None,
    ros: options.RosRouterOption = None,
    domain: options.RosDomainOption = 0,
    overrides: options.SetOption = None,
    seconds: Annotated[
        float | None,
        value(
            "--seconds", "S", callback=options.check_range(1.0, 86400.0, "a number of seconds")
        ),
    ] = None,
    picture: Annotated[Path | None, value("--figure", "FILE")] = None,
    force: options.ForceOption = False,
    answer: Annotated[list[str] | None, value("--answer", "EP")] = None,
    insecure: options.InsecureOption = False,
    as_json: options.JsonOption = False,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
) -> None:
    """Measures delay and clock offset to each member of a session.

    The command shows the round-trip time, the clock offset and the jitter between this machine
    and every member. It also works while the session is still waiting for members. Once the
    session is running, the delays that its sites measure on their links are also shown. Without
    endpoints, the command connects to the first site's loopback port and asks it for the other
    sites.

    With --benchmark, no session is needed: the command measures whether the network is good
    enough for a scenario, using the delay margin computed by `trilat linear`. To measure the
    network to another machine, run `trilat ping --answer EP` on that machine, and use --connect
    EP here. Without --connect, both ends run on this machine, over TCP, TLS and QUIC, and no
    network is measured. The benchmark takes half a minute. The exit code is 1 if the network is
    not good enough.

    With --ros2, no session is needed either: the command listens over Zenoh to a ROS 2 topic of
    any message type (docs/sessions/ros2.md).

    Options:
        benchmark: Instead, measure whether the network to --connect EP is good enough for this
            scenario, for several message sizes, rates and transports. Without --connect,
            measure this machine alone.
        ros2: Measure the delay of messages on this ROS 2 topic instead.
        seconds: Total duration of the benchmark, in s; default: 24. With --ros2: duration of
            the measurement, in s; default: 5. With --answer: time after which the command ends,
            in s; default: no limit.
        picture: File for a figure of the benchmark (.png, .svg or .pdf).
        answer: Answer benchmarks from other machines on this endpoint; repeatable.
    """
    mode = ""
    if benchmark is not None:
        mode = "--benchmark"
    elif ros2 is not None:
        mode = "--ros2"
    elif answer:
        mode = "--answer"
    _refuse_options_of_other_modes(context, mode)
    if benchmark is not None:
        return _benchmark(
            scenario=benchmark,
            overrides=overrides,
            seconds=seconds,
            reach=reach,
            picture=picture,
            force=force,
            as_json=as_json,
        )
    if ros2 is not None:
        return _ping_topic(ros2, ros, domain, seconds or 5.0, as_json=as_json)
    if answer:
        return _run_far_end(answer, reach.keys, seconds, insecure=insecure)

    from trilat_net.app.session_ping import ping_session

    connection = reach.resolve(operates=False)
    clock = SystemClock.with_error(clock_offset, clock_drift)
    with Interrupt() as interrupt:
        measurement = ping_session(
            connection=connection,
            clock=clock,
            session=options.check_session_name(session),
            count=count,
            timeout_s=timeout,
            stopped=interrupt.is_requested,
        )
        if measurement is None:
            raise typer.Exit(interrupt.exit_code)

    terminal.print_result(measurement, as_json=as_json)
    has_reply = any(member["answers"] for member in measurement.members)
    if not has_reply:
        raise typer.Exit(1)
    return None


_MODE_OPTIONS = {
    "--benchmark": {
        "--benchmark",
        "--set",
        "--seconds",
        "--figure",
        "--force",
        "--connect",
        "--keys",
        "--json",
    },
    "--answer": {"--answer", "--seconds", "--keys", "--insecure"},
    "--ros2": {"--ros2", "--ros", "--domain", "--seconds", "--json"},
}
"""For each mode of `trilat ping`, all options that it accepts."""
_OPTIONS_WITH_MODE = {
    "--set",
    "--seconds",
    "--figure",
    "--force",
    "--insecure",
    "--ros",
    "--domain",
}
"""Options of `trilat ping` that are only valid together with an option that selects a mode."""


def _refuse_options_of_other_modes(context: typer.Context, mode: str) -> None:
    """Raises an error for options that have no effect in the selected mode of `trilat ping`.

    The command has modes for sessions, for ROS 2 topics and for benchmarks.

    Args:
        context: The command line.
        mode: The option that selects the mode, as in "--benchmark". Empty for the normal mode,
            which measures a session.

    Raises:
        UsageError: An option belongs to another mode.
    """
    used_options = set(options.list_used_options(context))
    if mode:
        refused = sorted(used_options - _MODE_OPTIONS[mode])
        reason = f"cannot be used with {mode}"
    else:
        refused = sorted(used_options & _OPTIONS_WITH_MODE)
        reason = "can be used only with --benchmark, --answer or --ros2"
    if refused:
        raise UsageError(f"{refused[0]}: {reason}")


def _benchmark(
    scenario: str,
    overrides: list[str] | None,
    seconds: float | None,
    reach: options.Reach,
    picture: Path | None,
    *,
    force: bool,
    as_json: bool,
) -> None:
    """Measures whether the network is good enough for a scenario, and prints the result.

    The network is good enough if the arms would be stable with its delays.

    Args:
        scenario: Name of a shipped scenario, or path of a TOML file.
        overrides: Overrides of the scenario.
        seconds: Duration of all measurements together, in s. If `None`, the default is used.
        reach: The options that name the machine at the far end.
        picture: Path of a figure to draw. `None` if no figure was requested.
        force: True to replace an existing figure.
        as_json: True to print the result as JSON.

    Raises:
        typer.Exit: The network is not good enough.
    """
    options.check_picture(picture, force=force)
    from trilat_net.app.network_benchmark import DEFAULT_S, ping_benchmark

    subject = "the network" if reach.connect else "this machine alone, without --connect"
    with terminal.progress_lines(f"measuring {subject}, for {seconds or DEFAULT_S:g} s"):
        result = ping_benchmark(
            scenario,
            overrides or [],
            duration_s=seconds or DEFAULT_S,
            connect=reach.connect,
            keys=reach.keys,
        )

    figure = "linear_figures:draw_network_delays"
    options.print_and_draw(result, picture, figure, result.to_dict(), as_json=as_json)
    if not result.good:
        raise typer.Exit(1)


def _ping_topic(
    topic: str, routers: list[str] | None, domain: int, lasts_s: float, *, as_json: bool
) -> None:
    """Measures the network delay of the messages of a ROS 2 topic, and prints the result.

    Args:
        topic: Name of the topic.
        routers: Endpoints of the Zenoh router of ROS. If `None`, the router on this machine is
            used.
        domain: Number of the ROS domain.
        lasts_s: Duration of the measurement, in s.
        as_json: True to print the result as JSON.
    """
    from trilat_net.app.ros2_ping import ping_topic

    measurement = ping_topic(
        topic, routers or [options.ROS_ROUTER], domain, lasts_s, terminal.print_note
    )
    terminal.print_result(measurement, as_json=as_json)


def _run_far_end(
    endpoints: list[str], keys: Path | None, seconds: float | None, *, insecure: bool
) -> None:
    """Replies to network benchmarks from other machines, for a time or until Ctrl-C.

    This is the counterpart of `trilat ping --benchmark`: it sends every message back at once.

    Args:
        endpoints: Endpoints at which to listen.
        keys: Folder of keys. If `None`, connections are unencrypted.
        seconds: Duration, in s. If `None`, there is no limit.
        insecure: True to allow unencrypted connections from other machines.
    """
    from math import inf

    from trilat_net.app.network_benchmark import run_far_end

    with Interrupt() as interrupt:
        run_far_end(
            endpoints,
            keys,
            interrupt.is_requested,
            seconds or inf,
            insecure=insecure,
            say=terminal.print_line,
        )
    if interrupt.is_requested():
        raise typer.Exit(interrupt.exit_code)


SessionOption = Annotated[str, value("--session", "ID", "Name of the session.")]
SitesArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="SITE...", help="Names of the sites; default: all sites."),
]


@options.command(
    "--session paper s", "--session paper --end", page="docs/sessions/live-page.md"
)
def stop_command(
    session: SessionOption,
    sites: SitesArgument = None,
    end: Annotated[
        bool, flag("--end", "End the whole session instead; recorders get every record.")
    ] = False,
    *,
    reach: options.Reach,
) -> None:
    """Stops arms at once; the session goes on.

    The arms come to rest where they are, and stay there until you run `trilat enable`. With
    --end, all sites end their run at the same time instead. Without endpoints, the command
    reaches the sites on this machine at the addresses that they have stored in files. If there
    are no such files, it connects to the first site's loopback port and asks it for the other
    sites.
    """
    if end and sites:
        raise UsageError("--end ends the whole session: do not name a site")
    running = reach.open_session(session, operates=False, stops=not end)
    replies = running.end() if end else running.stop(*(sites or ()))
    terminal.print_texts(replies)


@options.command("--session paper s", page="docs/sessions/live-page.md")
def enable_command(
    session: SessionOption, sites: SitesArgument = None, *, reach: options.Reach
) -> None:
    """Lets stopped arms follow the other arms again.

    Each arm first waits for the other arms and aligns with them.
    """
    running = reach.open_session(session, operates=False)
    terminal.print_texts(running.enable(*(sites or ())))


@options.command("--session paper s", page="docs/sessions/external-arm.md")
def reset_command(
    session: SessionOption,
    sites: Annotated[
        list[str], typer.Argument(metavar="SITE...", help="Sites whose faults to clear.")
    ],
    *,
    reach: options.Reach,
) -> None:
    """Clears the faults of sites whose causes have been removed.

    The sites then wait for the other sites. Each arm aligns with the other arms before
    following them.
    """
    running = reach.open_session(session, operates=False)
    terminal.print_texts(running.reset(*sites))


_UNITS = {"us": 1e-3, "ms": 1.0, "s": 1e3}
"""Units of time in ms."""


def _parse_milliseconds(text: str) -> float:
    """Parses a time with its unit, such as 350ms or 0.35s, which a user gives for a delay.

    Args:
        text: The text that the user gave.

    Returns:
        The time in ms, which is 350 for both examples.

    Raises:
        UsageError: The text is not a number with a unit.
    """
    match = re.fullmatch(r"([-+.\deE]+?)\s*(us|ms|s)", text.strip())  # number and unit
    try:
        if match:
            return float(match[1]) * _UNITS[match[2]]
    except ValueError:
        # The pattern also matches texts such as "..5", which are not numbers.
        pass
    raise UsageError(f"a time must be a number with a unit, as in 350ms or 0.35s, not {text!r}")


def _parse_share(text: str) -> float:
    """Parses a number or a percentage, such as 0.05 or 5%, which a user gives for a loss.

    Args:
        text: The text that the user gave.

    Returns:
        The number, which is 0.05 for both examples.

    Raises:
        UsageError: The text is not a number or a percentage.
    """
    number = text.strip().removesuffix("%")
    is_percentage = number != text.strip()
    try:
        divisor = 100.0 if is_percentage else 1.0
        return float(number) / divisor
    except ValueError:
        raise UsageError(
            f"a share must be a number or a percentage, as in 0.05 or 5%, not {text!r}"
        ) from None


def _parse_pairs(texts: list[str], example: str) -> dict[str, Any]:
    """Parses the changes of settings that a user has written as KEY=VALUE.

    A value is TOML or a bare word, as in model=gamma.

    Args:
        texts: The texts.
        example: A correct text, for the error message.

    Returns:
        The values by key.

    Raises:
        UsageError: A text does not have this form.
    """
    from ...scenario import split_assignment

    pairs = []
    for text in texts:
        pair = split_assignment(text)
        if pair is None:
            raise UsageError(
                f"a change must have the form KEY=VALUE, as in {example}, not {text!r}"
            )
        pairs.append(pair)
    return dict(pairs)


def set_command(
    context: typer.Context,
    session: Annotated[
        str | None, value("--session", "ID", "Session to change; required.")
    ] = None,
    *,
    reach: options.Reach,
) -> None:
    """Changes a link, or who leads, while a session runs.

    Without endpoints, the command connects to the first site's loopback port and asks it for
    the other sites.
    """
    name = None if session is None else options.check_session_name(session)
    # Typer runs this function first, and then the command of the group, which needs both.
    context.obj = name, reach.resolve()


@options.command("'m1->s' --delay 350ms --loss 5%", page="docs/reference/links.md")
def set_link_command(
    context: typer.Context,
    name: Annotated[
        str, typer.Argument(help="Link that is changed, for example m1->s.", metavar="FROM->TO")
    ],
    delay: Annotated[
        str | None, typer.Option("--delay", help="New delay, for example 350ms.")
    ] = None,
    loss: Annotated[
        str | None, typer.Option("--loss", help="New packet loss, for example 5%.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", help="Preset of link settings, for example 4g.")
    ] = None,
    to: Annotated[
        list[str] | None,
        value(
            "--to",
            "KEY=VALUE",
            "New value of any link key, for example model=gamma; repeatable.",
        ),
    ] = None,
) -> None:
    """Changes settings of a directed link; a model or a preset replaces all of them."""
    table = _parse_pairs(to or [], "deviation_ms=20")
    if preset is not None:
        table["preset"] = preset
    if delay is not None:
        table["delay_ms"] = _parse_milliseconds(delay)
    if loss is not None:
        table["loss"] = _parse_share(loss)
    if not table:
        raise UsageError("nothing to change: give --delay, --loss, --preset or --to KEY=VALUE")

    _, arrow, receiver = name.partition("->")
    if not arrow:
        raise UsageError(
            f"a link must be written as FROM->TO in quotes, as in 'm1->s', not {name!r}"
        )

    _send_change(context, receiver, {"link": name, "to": table})


@options.command("s m1=0.9 m2=0.1", page="docs/tutorials/first-hour.md")
def set_dominance_command(
    context: typer.Context,
    site: Annotated[str, typer.Argument(help="Site whose dominance row changes.")],
    shares: Annotated[
        list[str],
        typer.Argument(
            metavar="PEER=SHARE...",
            help="New dominance shares of the site's peers, which sum to 1.",
        ),
    ],
    ramp: Annotated[
        str, typer.Option("--ramp", help="Duration of the ramp, for example 2s.")
    ] = "1s",
) -> None:
    """Changes one row of the dominance matrix along a linear ramp; the row always sums to 1."""
    pairs = _parse_pairs(shares, "m1=0.9")
    table = {peer: _parse_share(str(share)) for peer, share in pairs.items()}
    ramp_s = _parse_milliseconds(ramp) / 1e3
    _send_change(context, site, {"dominance": site, "to": table, "ramp_s": ramp_s})


def _send_change(context: typer.Context, site: str, change: dict[str, Any]) -> None:
    """Requests a change, such as another delay, from a running arm, and prints the reply.

    Args:
        context: The command line. `set_command` has stored the session and the connection in
            it.
        site: Name of the site.
        change: Fields of a `ChangeRequest`.

    Raises:
        UsageError: The session is not named, or the site rejects the change.
    """
    from trilat_net.app.running_session import RunningSession

    from ...net import ChangeRequest
    from ...scenario import check_finite

    session, connection = context.obj
    check_finite(change, "")  # messages cannot hold infinite numbers
    if session is None:
        raise UsageError("the session is not named: use trilat set --session ID ...")

    reply = RunningSession(session, connection).change(site, ChangeRequest(**change))
    if not reply.accepted:
        raise UsageError(f"refused: {reply.text}")

    terminal.print_text(reply.text)


@options.command(
    "--keys keys/m1 --listen tls/0.0.0.0:7447",
    "--session paper",
    page="docs/sessions/network-check.md",
)
def doctor_command(
    *,
    ways: options.MemberOptions,
    session: Annotated[
        str | None,
        value("--session", "ID", "Also check the clocks of this session's members."),
    ] = None,
    folder: Annotated[
        Path, value("--out -o", "DIR", "Folder planned for results, whose disk is checked.")
    ] = Path("runs"),
    as_json: options.JsonOption = False,
) -> None:
    """Checks whether this machine is ready for a live session.

    The checks cover keys, endpoints, clocks, real-time privileges, disk and processors. Use the
    options of the site, recorder or router that will run on this machine. The exit code is 1 if
    a check fails.
    """
    from trilat_net.app.doctor import MachineExamination

    connection = ways.find_endpoints()
    name = None if session is None else options.check_session_name(session)
    examination = MachineExamination(
        connection=connection,
        keys=ways.keys,
        folder=folder,
        session=name,
        clock=SystemClock(),
        insecure=ways.insecure,
    )

    # Each check is printed as soon as it is done, because some take seconds.
    findings = []
    for finding in examination.run():
        findings.append(finding)
        if not as_json:
            terminal.print_marked(MARKS[finding.state], f"{finding.check:<10}  {finding.text}")
    if as_json:
        terminal.print_json([finding._asdict() for finding in findings])
    if any(finding.state == "fail" for finding in findings):
        raise typer.Exit(1)

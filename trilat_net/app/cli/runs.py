"""Commands that run a scenario in virtual time, and commands that evaluate the log of a run.

A scenario describes an experiment: the arms, their control laws, the network and the people who
move the arms. In virtual time, the run is simulated as fast as possible, with simulated arms
and delays and without a real network. The log is an MCAP file that contains everything recorded
during the run.
"""

import shlex
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from ...errors import ScenarioError, UsageError
from ...presentation import TextTable
from ...presentation import terminal_output as terminal
from ...signals import Interrupt
from . import options
from .options import flag, value

if TYPE_CHECKING:
    from ...log import Log
    from ...scenario import Scenario


@options.command(
    "free -o free.mcap --set link.delay_ms=400", page="docs/tutorials/first-hour.md"
)
def sim_command(
    scenario: options.ScenarioArgument,
    output: Annotated[
        Path | None, value("-o --out --output", "FILE", "File of the log; default: NAME.mcap.")
    ] = None,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
    views: options.ViewsOption = "100",
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Runs a scenario in virtual time, without a network.

    The result is the same kind of log that a live session writes.
    """
    from ...execution import SimulatedLog
    from .options import parse_viz_rate

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    if chosen.outside:
        arguments = ["trilat", "sim", scenario]
        for text in options.list_overrides(overrides, duration):
            arguments += ["--set", text]
        if seed is not None:
            arguments += ["--seed", str(seed)]
        if output is not None:
            arguments += ["-o", str(output)]
        command = f"{shlex.join(arguments)} {chosen.simulated_options}"
        raise ScenarioError(
            f"is 'external': {', '.join(chosen.outside)} is a real arm, which only a live "
            f"session can move; to rehearse with a simulated arm, run: {command}",
            path=f"sites.{chosen.outside[0]}.plant",
            source=chosen.name,
        )

    path = output if output is not None else Path(f"{chosen.name}.mcap")
    views_hz = parse_viz_rate(views)

    with (
        Interrupt(compiles=True) as interrupt,
        terminal.progress_lines(f"running {chosen.name} in virtual time"),
    ):
        stayed_in_limits = SimulatedLog.record_scenario(
            chosen, path, force=force, stopped=interrupt.is_requested, views_hz=views_hz
        )
    if interrupt.is_requested():
        terminal.err.print(
            f"interrupted; {path} holds the records so far", markup=False, soft_wrap=True
        )
        raise typer.Exit(interrupt.exit_code)

    from ...log import open_log

    if as_json:
        terminal.print_json(open_log(path).to_dict())
    else:
        terminal.print_text(f"{path}: {_describe_length(chosen, path)}")
        permissions = {
            f" --law {shlex.quote(str(law.file))}" for law in chosen.inspect_user_laws()
        }
        report = f"trilat report {shlex.quote(str(path))}{''.join(sorted(permissions))}"
        terminal.print_text(f"next: {report}")

    for failure in open_log(path).failed_hands:
        terminal.print_note(failure)
    if not stayed_in_limits:
        remedy = ""
        if any(spec.arm.urdf for spec in chosen.sites.values()):
            remedy = ", which replaces the limits that a urdf states"
        terminal.print_error(
            f"{path}: the run diverged and ended: {open_log(path).describe_divergence()}; "
            f"the limit is limits.qd_limit_rad_s{remedy}"
        )
        raise typer.Exit(1)


def _describe_length(scenario: "Scenario", path: Path) -> str:
    """Returns a phrase that states how long a simulated run is and which arms it has.

    A run that diverged is shorter than planned, and the phrase says so.

    Args:
        scenario: Scenario of the run.
        path: The log of the run.
    """
    from ...log import open_log

    sites = ", ".join(scenario.names)
    diverged_s = open_log(path).diverged_s
    if diverged_s is None:
        return f"{scenario.duration_s:g} s of {sites}"
    return f"{diverged_s:.4g} s of {sites}, of {scenario.duration_s:g} s that were planned"


@options.command("run.mcap", page="docs/logs/verify.md")
def verify_command(
    files: options.LogsArgument,
    virtual: Annotated[bool, flag("--virtual")] = False,
    resume_every: Annotated[int, value("--resume-every", "N", min=0)] = 0,
    *,
    laws: options.LawFileOptions,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    as_json: options.JsonOption = False,
) -> None:
    """Executes a log again, and compares every computed number.

    Every site is executed again from its records (one record holds everything that a site
    received and computed in one control period), and every computed field is compared. The
    numbers must agree bit for bit.

    Exit code 0: everything agrees, the log was not changed, and enough of every site was
    checked. 1: something differs, was changed, or is missing. 2: there is no log. 4: a site's
    control law is external code that needs --law to run; everything else agrees.

    Options:
        virtual: Also compare the log with two runs in virtual time: one with the recorded
            arrival times of messages, and one over a network that adds no delay.
        resume_every: Restart each site from its records every N ticks (control periods), to
            reveal control-law state that is missing from the records; default 0: never.
    """
    from ...execution import LogCheckReport

    log = laws.open(*files)
    with terminal.progress_bar(f"executing {files[0]}") as progress:
        result = LogCheckReport.of_log(
            log,
            virtual=virtual,
            progress=progress,
            min_coverage=min_coverage,
            resume_every=resume_every,
        )
    terminal.print_result(result, as_json=as_json)
    raise typer.Exit(result.exit_code)


Accepted = StrEnum("Accepted", ["SETTLED", "BOUNDED", "OPEN"])
"""Results besides a stable run for which `--accept` gives the exit code 0."""


@options.command("run.mcap", page="docs/logs/certificate.md")
def certify_command(
    files: options.LogsArgument,
    accept: Annotated[
        list[Accepted] | None,
        typer.Option(
            "--accept",
            help="Also return exit code 0 for a settled run, a bounded oscillation or an open "
            "verdict; repeatable.",
        ),
    ] = None,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    own_laws: Annotated[
        bool,
        flag(
            "--own-laws",
            "Run the control laws whose files you permitted earlier with --remember. "
            "Else permit them with --law FILE.",
        ),
    ] = False,
    twins: Annotated[
        int | None,
        value(
            "--twins",
            "N",
            "Number of twins, which are repetitions of the run with a small push. "
            "Default: one for each joint, and two more.",
            min=0,
            max=99,
        ),
    ] = None,
    cite: Annotated[
        bool,
        flag(
            "--cite",
            "Print a paragraph for a paper instead, with the numbers of the run and BibTeX.",
        ),
    ] = False,
    everything: options.AllOption = False,
    *,
    laws: options.LawFileOptions,
    as_json: options.JsonOption = False,
) -> None:
    """Judges whether a run was stable, and explains why.

    The verdict is stable, settled, not stable or open. It is printed with its most important
    reasons: the energy function V of the stability proof, its energy balance, and the roots of
    the linearised loop at the final pose. With --all, the conditions of the proof (premises)
    and the energies are also printed. The command executes the run again, along with twins,
    which are repetitions with a small push. The code of imported control laws runs only with
    --law, or with --own-laws if it was remembered. docs/logs/certificate.md explains the
    verdicts and links to every term and key.

    Stable: a proof exists for this loop. Settled: the run came to rest (speeds at most 0.01
    rad/s) or was decaying, and every push died away, but nothing further is proved. Exit code
    0: stable. 1: settled, not stable (bounded oscillation, drifting, growing, diverged) or
    open. 2: there is no log, or it contains no records of any site.
    """
    from ...analysis import certify_run
    from ...presentation import compose_citation

    own_laws = own_laws or bool(laws.law)
    log = laws.open(*files, runs_them=own_laws)
    log.require_records()
    with terminal.progress_lines(f"judging {files[0]}"):
        certificate = certify_run(
            log, min_coverage=min_coverage, own_laws=own_laws, twins=twins
        )
    if cite:
        for line in compose_citation(log, certificate):
            terminal.print_line(line)
    else:
        terminal.print_result(certificate, as_json=as_json, brief=not everything)
    if not certificate.accepts(accept or ()):
        raise typer.Exit(1)


_PUSH_HELP = (
    "Quantity that is pushed, and size of the push, for example m1.q1=1e-6. Quantities are the "
    "angle of a joint (m1.q1, rad), its speed (m1.qd1, rad/s), an estimated parameter of the "
    "arm (m1.theta1), and all joints of a site (m1.q) or of all sites (q). Repeatable: each "
    "push makes one twin. Default: the pushes of `trilat certify`."
)


@options.command(
    "run.mcap --at 12 --push m1.q1=1e-6 -o twin.png",
    "run.mcap --delta 1e-9:1e-3",
    page="docs/logs/twins.md",
)
def twin_command(
    files: options.LogsArgument,
    at_s: Annotated[float, value("--at", "S", "Time of the push, in s.")] = 0.0,
    push: Annotated[
        list[str] | None,
        value("--push", "STATE=SIZE", _PUSH_HELP, autocompletion=options.complete_sites),
    ] = None,
    delta: Annotated[
        str,
        value(
            "--delta",
            "LOW:HIGH",
            "Range of sizes for a single push, for example 1e-9:1e-3; one twin per decade.",
        ),
    ] = "",
    picture: Annotated[
        Path | None, value("-o --out --output", "FILE", options.FIGURE_HELP)
    ] = None,
    *,
    laws: options.LawFileOptions,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Repeats a run with a small push: does the push die away?

    A repetition with a push is called a twin. Each twin uses the message arrivals, delays, hand
    motions and setting changes recorded in the run. The difference from the original run is
    simulated in full, without linearisation (docs/logs/twins.md). The exit code is 0 whether or
    not the disturbances grow.
    """
    from ...analysis import PushedTwins

    options.check_picture(picture, force=force)
    log = laws.open(*files)
    with terminal.progress_lines(f"repeating {files[0]} with small pushes"):
        growth = PushedTwins.of_log(log, at_s, push or (), delta)
    options.print_and_draw(
        growth, picture, "twin_differences:draw_twins", growth, as_json=as_json
    )


@options.command("run.mcap", page="docs/reference/metrics.md")
def metrics_command(
    file: options.LogsArgument,
    everything: options.AllOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Computes all metrics that apply to a run.

    The ten most important numbers are printed, each with the site, link or wall that has the
    largest value. With --all, tables cover tracking, effort, energies, force sharing,
    impedance, walls, learning and the network, with one column per site, link and wall. A dash
    marks a missing value, with the reason if the metric applies to the run.
    docs/reference/metrics.md has every formula.
    """
    from ...analysis import LogMetrics

    log = terminal.open_with_progress(*file)
    log.require_records()
    metrics = LogMetrics.of_log(log)
    terminal.print_result(metrics, as_json=as_json, brief=not everything)


@options.command("run.mcap positions settling --width 3.5 --format pdf --out paper")
def figure_command(
    file: options.LogArgument,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", autocompletion=options.complete_figures),
    ] = None,
    width_in: Annotated[float, value("--width", "3.5|7")] = 3.5,
    formats: Annotated[
        str,
        value("--format", "pdf,png,svg", "File formats of the figures, separated by commas."),
    ] = "pdf,png",
    folder: Annotated[Path | None, value("--out -o", "DIR")] = None,
    others: Annotated[list[Path] | None, value("--with", "FILE")] = None,
    *,
    laws: options.LawFileOptions,
    listed: Annotated[bool, flag("--list", "Only list the figures.")] = False,
    as_json: Annotated[bool, flag("--json", "Print the list or the paths as JSON.")] = False,
    force: options.ForceOption = False,
) -> None:
    """Draws publication figures of a log, as PDF, PNG or SVG.

    Text in the figures is 8 pt high. The same log always produces the same bytes.

    Options:
        names: Names of the figures (see --list); default: all figures for which FILE has data.
        width_in: Width of the figures in inches, for one or two columns of a paper.
        folder: Folder for the figures; default: the name of FILE with -figures in place of
            .mcap.
        others: Draw this log together with FILE in the same panels; repeatable. Works for the
            figures overlay (largest values of all sites, one color per run), positions,
            tracking_errors and control_torques (dashed lines). The legend lists the settings
            that differ.
    """
    log = laws.open(file)
    if listed:
        _list_figures(log, as_json=as_json)
        return

    from ...files import refuse_link
    from ...presentation import write_figures, write_overlay

    out = folder
    if out is None:
        # The sender of the log may have placed a symbolic link at the default path.
        out = file.with_name(f"{file.stem}-figures")
        refuse_link(out)
    format_names = [name.strip().lower() for name in formats.split(",") if name.strip()]
    if not format_names:
        raise UsageError("--format is empty: name one or more formats, as in --format pdf,png")

    settings: dict[str, Any] = {"width_in": width_in, "formats": format_names, "force": force}
    if others:
        logs = {file.stem: log}
        logs |= {path.stem: terminal.open_with_progress(path) for path in others}
        if len(logs) <= len(others):
            # Logs of the same file name share a key, so there are too few entries.
            raise UsageError(
                "logs that are drawn over one another must have different file names"
            )
        paths = write_overlay(logs, out, names or (), **settings)
    else:
        with terminal.progress_bar("drawing") as progress:
            paths = write_figures(log, out, names or (), progress=progress, **settings)

    if as_json:
        terminal.print_json([path.as_posix() for path in paths])
        return

    terminal.print_paths(paths)


def _list_figures(log: "Log", *, as_json: bool) -> None:
    """Prints the names of all figures that a command can draw from a log.

    Figures for which the log has no data follow, with the reason.

    Args:
        log: The log.
        as_json: True to print the list as JSON.
    """
    from ...presentation import FIGURES

    # The reason is empty if the log has what the figure needs.
    reasons = {name: figure.absent(log) for name, figure in FIGURES.items()}
    if as_json:
        rows = []
        for name, reason in reasons.items():
            row = {"name": name, "about": FIGURES[name].about, "absent": reason or None}
            rows.append(row)
        terminal.print_json(rows)
        return

    drawable = [(name, FIGURES[name].about) for name, reason in reasons.items() if not reason]
    terminal.print_table(TextTable(("figure", "shows"), drawable))
    for name, reason in reasons.items():
        if reason:
            terminal.out.print(
                f"[dim]{name}: nothing to show: {escape(reason)}[/dim]", soft_wrap=True
            )


@options.command("run.mcap -o report", page="docs/tutorials/first-hour.md")
def report_command(
    files: options.LogsArgument,
    folder: Annotated[
        Path | None,
        value(
            "-o --out", "DIR", "Folder for the report; default: the name of FILE without .mcap."
        ),
    ] = None,
    *,
    laws: options.LawFileOptions,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    force: options.ForceOption = False,
    png: options.PngOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Writes a web page about a log: arms, charts and verdict.

    A summary is written next to the page, along with the figures if --png is given.
    """
    from ...files import make_results_folder, refuse_link
    from ...presentation import conclude
    from ..api import choose_report_folder

    log = laws.open(*files)  # so that no folder is created for a log that cannot be read
    log.require_records()
    if folder is None:
        # The sender of the log may have placed a symbolic link at the default path.
        folder = choose_report_folder(files[0])
        refuse_link(folder)
    results = make_results_folder(folder, "", force=force)
    with terminal.progress_bar(f"checking {files[0]} and drawing") as progress:
        conclusion = conclude(log, results, progress, min_coverage=min_coverage, png=png)
    terminal.print_result(conclusion, as_json=as_json)
    raise typer.Exit(conclusion.exit_code)


@options.command(
    "run.mcap --replace s --set control.Kd=5 -o kd5.mcap", page="docs/logs/rerun.md"
)
def rerun_command(
    files: options.LogsArgument,
    replace: Annotated[
        list[str] | None,
        value(
            "--replace",
            "SITE",
            "Execute this site again; repeatable.",
            autocompletion=options.complete_sites,
        ),
    ] = None,
    closed_loop: Annotated[
        bool, flag("--closed-loop", "Execute all sites again, over the recorded network.")
    ] = False,
    overrides: options.SetOption = None,
    *,
    laws: options.LawFileOptions,
    output: Annotated[
        Path | None, value("-o --out --output", "FILE", "Write the result as a log.")
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Computes how a run would have gone with other settings.

    The results are compared with the log. Without --closed-loop, only the sites named by
    --replace are executed again. All other sites repeat their recorded behaviour and do not
    react.
    """
    from ...execution import rerun
    from ...log import LogStorage

    if output is not None:
        is_input = any(
            output.exists() and file.exists() and output.samefile(file) for file in files
        )
        if is_input:
            raise UsageError(
                f"{output}: this file is the log that is being read; choose another name for "
                "the output"
            )
        # Refuses an existing output before the run is computed.
        LogStorage(output, force=force).find_first_part()
    log = laws.open(*files)
    with terminal.progress_bar(f"executing {files[0]}") as progress:
        result = rerun(
            log, replace or [], overrides or [], closed_loop=closed_loop, progress=progress
        )

    if output is not None:
        result.save(output, force=force)
    if as_json:
        terminal.print_json({**result.to_dict(), "file": str(output) if output else None})
    else:
        terminal.print_result(result)
        terminal.print_paths([output] if output else [])
    if result.diverged or result.broken:
        raise typer.Exit(1)


LinearFigure = StrEnum("LinearFigure", ["ROOTS", "IMPEDANCE", "PASSIVITY"])
"""Figures that `trilat linear` can draw."""


@options.command(
    "p_d_margin --set control.d=0.9 --over control.d=0.1:3", page="docs/studies/linear.md"
)
def linear_command(
    scenario: options.ScenarioArgument,
    overrides: options.SetOption = None,
    pose: Annotated[
        str | None,
        value(
            "--pose",
            "Q1,Q2,...",
            "Pose of all sites, in rad; default: the pose at the end of a run of the scenario.",
        ),
    ] = None,
    roots: Annotated[int, value("--roots", "N", "Number of roots to print.")] = 6,
    over: Annotated[
        list[str] | None,
        value(
            "--over",
            "KEY=LOW:HIGH",
            "Find the stability limits in this range of a scenario key; repeatable.",
        ),
    ] = None,
    ports: Annotated[
        bool,
        flag("--ports/--no-ports", "Analyse passivity and the impedances that operators feel."),
    ] = True,
    operators: Annotated[
        list[Path] | None,
        value(
            "--operators",
            "FILE",
            "JSON file of a measured operator, from `trilat identify hand --json`; repeatable.",
        ),
    ] = None,
    picture: Annotated[Path | None, value("--figure", "FILE", options.FIGURE_HELP)] = None,
    drawn: Annotated[
        LinearFigure,
        typer.Option("--draw", help="What the figure shows: roots, impedances, or passivity."),
    ] = LinearFigure.ROOTS,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Analyses small motions: roots, delay margin, passivity.

    The loop is linearised about its equilibrium. The command computes the characteristic roots,
    the largest delay for which the loop is stable, and the stability limits along scenario keys
    (edges of stability, docs/studies/linear.md). For the arms alone, without operators and
    environments, it also computes passivity, Llewellyn's criterion of absolute stability, and
    the impedances that operators feel (docs/studies/ports.md). The exit code is 0 for every
    verdict.
    """
    options.check_picture(picture, force=force)
    from ...analysis import LinearAnalysis

    draws_ports = picture is not None and drawn is not LinearFigure.ROOTS
    with terminal.progress_lines(f"linearising {scenario}"):
        analysis = LinearAnalysis.compute(
            scenario,
            overrides or [],
            pose=_parse_pose(pose),
            roots=roots,
            over=over or [],
            ports=ports or draws_ports,
            operators=operators or [],
        )
    # The ports may have been analysed only for the figure; then they are not printed.
    prints_ports = ports or as_json
    printed = analysis if prints_ports else replace(analysis, ports=None)
    if drawn is LinearFigure.ROOTS:
        figure = "linear_figures:draw_root_map"
        argument: Any = analysis
    else:
        figure = f"linear_figures:draw_port_{drawn}"
        argument = analysis.ports
    options.print_and_draw(printed, picture, figure, argument, as_json=as_json)


def _parse_pose(text: str | None) -> tuple[float, ...] | None:
    """Parses the joint angles that a user gave on the command line, such as "0.1,0.3".

    Args:
        text: The text. `None` if the user gave no pose.

    Returns:
        The angles in rad. `None` if there is no text.

    Raises:
        UsageError: A part of the text is not a number.
    """
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--pose must be angles in rad, as in --pose 0.1,0.3, not {text!r}"
        ) from None

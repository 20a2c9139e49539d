"""Runs: a scenario in virtual time, and a log executed again, judged, measured, changed or
drawn.
"""

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from ..errors import UsageError
from ..process import Interrupt
from ..reporting import terminal_output as terminal
from ..reporting.result_text import TextTable
from . import options
from .options import flag, value

if TYPE_CHECKING:
    from ..log.log_reader import Log


@options.command("free -o free.mcap --set link.delay_ms=400")
def sim_command(
    scenario: options.ScenarioArgument,
    output: Annotated[
        Path | None, value("-o --out --output", "FILE", "Default: NAME.mcap.")
    ] = None,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
    views: options.ViewsOption = "100",
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Runs an experiment in virtual time, and writes the same kind of log as a live session."""
    from ..execution.virtual import record_virtual
    from ..log.ros2.viz_channels import parse_viz_rate

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    path = output if output is not None else Path(f"{chosen.name}.mcap")
    views_hz = parse_viz_rate(views)
    with Interrupt(compiles=True) as interrupt:
        within = record_virtual(
            chosen, path, force=force, stopped=interrupt.is_requested, views_hz=views_hz
        )
    if interrupt.is_requested():
        terminal.err.print(
            f"interrupted; {path} holds the records so far", markup=False, soft_wrap=True
        )
        raise typer.Exit(interrupt.exit_code)
    if as_json:
        from ..log.log_reader import open_log

        terminal.print_json(open_log(path).to_dict())
    else:
        terminal.print_text(f"{path}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        chains = any(spec.arm.urdf for spec in chosen.sites.values())
        terminal.print_error(
            f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there"
            + (
                "; a urdf states such limits, and limits.qd_limit_rad_s others"
                if chains
                else ""
            )
        )
        raise typer.Exit(1)


@options.command("run.mcap")
def verify_command(
    files: options.LogsArgument,
    virtual: Annotated[bool, flag("--virtual")] = False,
    resume_every: Annotated[int, value("--resume-every", "N", min=0)] = 0,
    *,
    laws: options.LawFiles,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    as_json: options.JsonOption = False,
) -> None:
    """Executes every site again from a log and compares every computed field of every record.

    Exit code 0: all agrees, the log is as it was made, and enough of every site was judged. 1:
    something differs, was changed, or is missing. 2: no log. 4: a site's law is code from
    outside that may not run without --law; all else agrees.

    Options:
        virtual: Compare with virtual time too, with and without the log's arrivals.
        resume_every: Start sites afresh from the records every N ticks: shows what a law knows
            besides.
    """
    from ..execution.log_checks import run_log_checks

    log = laws.open(*files)
    with terminal.progress_bar(f"executing {files[0]}") as progress:
        result = run_log_checks(
            log,
            virtual=virtual,
            progress=progress,
            min_coverage=min_coverage,
            resume_every=resume_every,
        )
    terminal.print_result(result, as_json=as_json)
    raise typer.Exit(result.exit_code)


Accepted = StrEnum("Accepted", ["BOUNDED", "OPEN"])
"""What `--accept` lets pass besides a stable run."""


@options.command("run.mcap")
def certify_command(
    files: options.LogsArgument,
    accept: Annotated[
        list[Accepted] | None,
        typer.Option(
            "--accept",
            help="Also exit 0 for a bounded oscillation, or an open judgement; repeatable.",
        ),
    ] = None,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    own_laws: Annotated[
        bool,
        flag("--own-laws", "Run code of imported laws for the energies that they declare."),
    ] = False,
    twins: Annotated[
        int, value("--twins", "N", "Twins that get a small push; 0: none.", min=0, max=99)
    ] = 8,
    *,
    laws: options.LawFiles,
    as_json: options.JsonOption = False,
) -> None:
    """Judges a run: stable, not stable or open; V and its energy balance, premises, roots at
    the end pose.

    Executes the run again beside twins that get a small push, and no code of imported laws
    without --law or --own-laws. docs/certificate.md defines every word and every key of the
    JSON.

    Exit code 0: stable. 1: not stable (bounded oscillation, drifting, growing, diverged) or
    open, with the reasons. 2: no log.
    """
    from ..theory.linear_analysis import certify_run

    own_laws = own_laws or bool(laws.law)
    log = laws.open(*files, runs_them=own_laws)
    found = certify_run(log, min_coverage=min_coverage, own_laws=own_laws, twins=twins)
    terminal.print_result(found, as_json=as_json)
    if not found.accepts(accept or ()):
        raise typer.Exit(1)


_PUSHED = (
    "Push a twin: m1.q1=1e-6 (rad), m1.qd1, m1.theta1, all of m1.q or of q; repeatable, a twin each. "
    "Default: as certify does."
)


@options.command("run.mcap --at 12 --push m1.q1=1e-6 -o twin.png", "run.mcap --delta 1e-9:1e-3")
def twin_command(
    files: options.LogsArgument,
    at_s: Annotated[float, value("--at", "S", "The instant of the push, s.")] = 0.0,
    push: Annotated[
        list[str] | None,
        value("--push", "WHAT=SIZE", _PUSHED, autocompletion=options.complete_sites),
    ] = None,
    delta: Annotated[
        str,
        value("--delta", "LOW:HIGH", "Sizes of one push, as in 1e-9:1e-3: a twin per decade."),
    ] = "",
    picture: Annotated[
        Path | None, value("-o --out --output", "FILE", "Draw a figure: .png, .svg or .pdf.")
    ] = None,
    *,
    laws: options.LawFiles,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Executes a run again, beside twins that get a small push at an instant: it dies away, or
    it grows.

    Nothing of the difference is a model: the twins get the arrivals, delays, hands and changes
    of the run (docs/certificate.md, "Twins"). Exit code 0 for any growth.
    """
    from ..analysis.twin_growth import twin

    options.check_picture(picture, force=force)
    log = laws.open(*files)
    found = twin(log, at_s, push or (), delta)

    options.print_drawn(found, picture, "twin_differences:draw_twins", found, as_json=as_json)


@options.command("run.mcap --site m1 --json > m1.json")
def identify_hand_command(
    file: options.LogsArgument,
    site: Annotated[
        str,
        value("--site", "SITE", "Whose arm it holds.", autocompletion=options.complete_sites),
    ] = "m1",
    as_json: options.JsonOption = False,
) -> None:
    """Finds mass, damping and stiffness of the hand at an arm, from a run in which sines move
    that arm.

    The scenario has an operator of kind "multisine" at any site (docs/ports.md, "Measured
    operators"). What is found, as JSON, is what `trilat linear --operators` takes.
    """
    from ..studies.hand_impedance import identify_hand

    terminal.print_result(
        identify_hand(terminal.open_with_progress(*file), site), as_json=as_json
    )


@options.command("run.mcap")
def metrics_command(file: options.LogsArgument, as_json: options.JsonOption = False) -> None:
    """Measures a run: tracking, effort, energies, force sharing, impedance, walls, learning,
    network.

    Sites, links and walls are columns. A dash is a missing number; if the run could have one,
    the reason is given below the table. docs/metrics.md has every formula.
    """
    from ..analysis.metrics.log_metrics import compute_log_metrics

    log = terminal.open_with_progress(*file)
    terminal.print_result(compute_log_metrics(log), as_json=as_json)


@options.command("run.mcap positions settling --width 3.5 --format pdf --out paper")
def figure_command(
    file: options.LogArgument,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", autocompletion=options.complete_figures),
    ] = None,
    width_in: Annotated[float, value("--width", "3.5|7")] = 3.5,
    formats: Annotated[
        str, value("--format", "pdf,png,svg", "One or more formats.")
    ] = "pdf,png",
    folder: Annotated[
        Path | None, value("--out -o", "DIR", "Default: FILE without .mcap, -figures.")
    ] = None,
    others: Annotated[list[Path] | None, value("--with", "FILE")] = None,
    *,
    laws: options.LawFiles,
    listed: Annotated[bool, flag("--list", "Only list the figures.")] = False,
    as_json: Annotated[bool, flag("--json", "Print the list or the paths as JSON.")] = False,
    force: options.ForceOption = False,
) -> None:
    """Draws figures of a log for a paper: vectors, type 8 pt, fonts embedded, the same bytes
    every time.

    Options:
        names: Names of figures, see --list; default: all that FILE has.
        width_in: Width of one or two columns of a paper, in.
        others: Draw this log over FILE, as the figure overlay; repeatable.
    """
    log = laws.open(file)
    if listed:
        _list_figures(log, as_json=as_json)
        return
    from ..files import refuse_link
    from ..reporting.figures.registry import write_figures, write_overlay

    place = folder
    # nobody has named the folder: who sent the log may have planted a link there
    if place is None:
        place = file.with_name(f"{file.stem}-figures")
        refuse_link(place)
    kinds = [kind.strip().lower() for kind in formats.split(",") if kind.strip()]
    if not kinds:
        raise UsageError("--format names no format, as in --format pdf,png")
    shape: dict[str, Any] = {"width_in": width_in, "formats": kinds, "force": force}
    if others:
        if names:
            raise UsageError(
                "--with draws the figure overlay, and no other: leave the names out"
            )
        logs = {
            file.stem: log,
            **{one.stem: terminal.open_with_progress(one) for one in others},
        }
        if len(logs) <= len(others):
            raise UsageError("logs that are drawn over one another need names of their own")
        paths = write_overlay(logs, place, **shape)
    else:
        with terminal.progress_bar("drawing") as progress:
            paths = write_figures(log, place, names or (), progress=progress, **shape)
    if as_json:
        terminal.print_json([path.as_posix() for path in paths])
        return
    terminal.print_paths(paths)


def _list_figures(log: "Log", *, as_json: bool) -> None:
    from ..reporting.figures.registry import FIGURES

    absent = {name: plate.absent(log) for name, plate in FIGURES.items()}
    if as_json:
        rows = [
            {"name": n, "about": FIGURES[n].about, "absent": why or None}
            for n, why in absent.items()
        ]
        terminal.print_json(rows)
        return
    drawable = [(name, FIGURES[name].about) for name, why in absent.items() if not why]
    terminal.print_table(TextTable(("figure", "shows"), drawable))
    for name, why in absent.items():
        if why:
            terminal.out.print(
                f"[dim]{name}: nothing to show: {escape(why)}[/dim]", soft_wrap=True
            )


@options.command("run.mcap -o report")
def report_command(
    files: options.LogsArgument,
    folder: Annotated[
        Path | None, value("-o --out", "DIR", "Default: FILE without .mcap.")
    ] = None,
    *,
    laws: options.LawFiles,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    force: options.ForceOption = False,
    png: options.PngOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Writes the page and the summary of a log, with --png its figures as well."""
    from ..files import make_results_folder, refuse_link
    from ..reporting.conclude import conclude

    log = laws.open(*files)  # before its folder is made
    # nobody has named the folder: who sent the log may have planted a link there
    if folder is None:
        folder = files[0].with_suffix("")
        refuse_link(folder)
    results = make_results_folder(folder, "", force=force)
    with terminal.progress_bar("drawing") as progress:
        conclusion = conclude(log, results, progress, min_coverage=min_coverage, png=png)
    terminal.print_result(conclusion, as_json=as_json)
    raise typer.Exit(conclusion.exit_code)


@options.command("run.mcap --replace s --set control.Kd=5 -o kd5.mcap")
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
        bool, flag("--closed-loop", "Execute all sites, over the network of the log.")
    ] = False,
    overrides: options.SetOption = None,
    *,
    laws: options.LawFiles,
    output: Annotated[
        Path | None, value("-o --out --output", "FILE", "Write the result as a log.")
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Executes sites of a log again with changed settings, and compares the result with the
    log.

    Without --closed-loop the other sites stay as recorded and do not react.
    """
    from ..execution.rerun import rerun
    from ..files import refuse_existing
    from ..log.log_layout import active_path

    if output is not None:
        if any(output.exists() and file.exists() and output.samefile(file) for file in files):
            raise UsageError(f"{output}: is the log itself; choose another name")
        refuse_existing(output, force=force, unfinished=active_path(output))
    log = laws.open(*files)
    with terminal.progress_bar("executing") as progress:
        again = rerun(
            log, replace or [], overrides or [], closed_loop=closed_loop, progress=progress
        )
    if output is not None:
        again.save(output, force=force)
    if as_json:
        terminal.print_json({**again.to_dict(), "file": str(output) if output else None})
    else:
        terminal.print_result(again)
        terminal.print_paths([output] if output else [])
    if again.diverged or again.broken:
        raise typer.Exit(1)


LinearFigure = StrEnum("LinearFigure", ["ROOTS", "IMPEDANCE", "PASSIVITY"])


@options.command("p_d_margin --set control.d=0.9 --over control.d=0.1:3")
def linear_command(
    scenario: options.ScenarioArgument,
    overrides: options.SetOption = None,
    pose: Annotated[
        str | None,
        value(
            "--pose", "Q1,Q2,...", "Pose of all sites, rad, true theta; default: a run's end."
        ),
    ] = None,
    roots: Annotated[int, value("--roots", "N", "Number of roots to print.")] = 6,
    over: Annotated[
        list[str] | None,
        value("--over", "KEY=LOW:HIGH", "Find where stability changes; repeatable."),
    ] = None,
    ports: Annotated[
        bool, flag("--ports/--no-ports", "Print what operators feel, and passivity.")
    ] = True,
    operators: Annotated[
        list[Path] | None,
        value(
            "--operators", "FILE", "A measured operator, of `identify hand --json`; repeatable."
        ),
    ] = None,
    picture: Annotated[
        Path | None, value("--figure", "FILE", "Draw a figure: .png, .svg or .pdf.")
    ] = None,
    what: Annotated[
        LinearFigure,
        typer.Option("--draw", help="What to draw: roots, impedances, or passivity."),
    ] = LinearFigure.ROOTS,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Linearises the loop about its equilibrium: stability of small motions, and the operators'
    impedances.

    With delays: roots, delay margin, edges of stability (docs/linear.md); then, with operators
    and environments off, passivity, Llewellyn's criterion, and impedance (docs/ports.md). Exit
    code 0 for any verdict.
    """
    options.check_picture(picture, force=force)
    from ..studies.hand_impedance import read_hands
    from ..theory.linear_analysis import analyse_linear_loop

    wanted = ports or (picture is not None and what is not LinearFigure.ROOTS)
    found = analyse_linear_loop(
        scenario,
        overrides or [],
        pose=_pose(pose),
        roots=roots,
        over=over or [],
        ports=wanted,
        hands=read_hands(operators or []),
    )
    shown = found if ports or as_json else replace(found, ports=None)
    name, of = (
        ("root_map", found) if what is LinearFigure.ROOTS else (f"port_{what}", found.ports)
    )
    options.print_drawn(shown, picture, f"linear_figures:draw_{name}", of, as_json=as_json)


def _pose(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--pose is angles in rad, as in --pose 0.1,0.3, not {text!r}"
        ) from None

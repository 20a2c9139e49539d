"""`trilat linear`: roots, margins and haptic ports of the loop linearised about its equilibrium."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from ..scenario import Scenario
    from ..theory import LinearAnalysis, LinearEdge
    from ..theory.port_analysis import PortAnalysis


LinearFigure = StrEnum("LinearFigure", ["ROOTS", "IMPEDANCE", "PASSIVITY"])

_COLOURS = {"stable": "green", "unstable": "red", "at the edge": "yellow"}


def linear_command(
    scenario: options.ScenarioArgument,
    overrides: options.SetOption = None,
    pose: Annotated[
        str | None,
        typer.Option(
            "--pose", metavar="Q1,Q2,...", help="All sites here, rad, estimates true; default: a run's end."
        ),
    ] = None,
    roots: Annotated[int, typer.Option("--roots", metavar="N", help="Number of roots to print.")] = 6,
    over: Annotated[
        list[str] | None,
        typer.Option("--over", metavar="KEY=LOW:HIGH", help="Find where stability changes; repeatable."),
    ] = None,
    ports: Annotated[
        bool, typer.Option("--ports/--no-ports", help="Impedances that operators feel, and passivity.")
    ] = True,
    picture: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE", help="Draw it: .png, .svg or .pdf.")
    ] = None,
    what: Annotated[
        LinearFigure, typer.Option("--draw", help="What to draw: roots, impedances, or passivity.")
    ] = LinearFigure.ROOTS,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Linearises the loop about its equilibrium: stability of small motions, and the operators' impedances.

    With delays: roots, delay margin, edges of stability (docs/linear.md); then, with operators and
    environments off, passivity, Llewellyn's criterion, and impedance (docs/ports.md). Exit code 0 for
    any verdict.
    """
    if picture is not None:
        _check_picture(picture, force=force)
    spans = [_range(text) for text in over or []]
    from ..theory import analyse_linear_loop, iterate_linear_edges
    from ..theory.linear_analysis import linear_to_json
    from ..theory.port_analysis import analyse_ports, ports_to_json

    found = analyse_linear_loop(scenario, overrides or [], pose=_pose(pose), roots=roots)
    lines = {
        key: list(iterate_linear_edges(found.scenario, key, low, high, found.rest))
        for key, low, high in spans
    }
    wanted = ports or (picture is not None and what is not LinearFigure.ROOTS)
    section = analyse_ports(found.scenario, found.rest) if wanted else None
    if picture is not None:
        _draw(found, section, what, picture)
    if as_json:
        edges = {key: [one._asdict() for one in line] for key, line in lines.items()}
        felt = None if section is None else ports_to_json(section)
        terminal.print_json({**linear_to_json(found), "ports": felt, "edges": edges})
        return
    _show(found)
    if ports and section is not None:
        from ..reporting.port_text import describe_ports

        for text in describe_ports(section):
            terminal.print_text(text)
    for (key, low, high), line in zip(spans, lines.values(), strict=True):
        terminal.print_text(_edge_words(key, low, high, line, found.scenario))
    if picture is not None:
        terminal.print_paths([picture])


def _pose(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--pose is angles in rad, as in --pose 0.1,0.3, not {text!r}") from None


def _range(text: str) -> tuple[str, float, float]:
    """Returns key and ends of a text such as control.d=0.1:3."""
    key, _, ends = text.partition("=")
    low, colon, high = ends.partition(":")
    try:
        if not key.strip() or not colon:
            raise ValueError
        return key.strip(), float(low), float(high)
    except ValueError:
        raise UsageError(f"--over reads KEY=LOW:HIGH, as in control.d=0.1:3, not {text!r}") from None


def _check_picture(path: Path, *, force: bool) -> None:
    from ..files import refuse_existing
    from ..reporting.style import FIGURE_FORMATS

    if path.suffix.lstrip(".").lower() not in FIGURE_FORMATS:
        raise UsageError(f"{path}: a figure's name ends in .{', .'.join(FIGURE_FORMATS)}")
    refuse_existing(path, force=force)
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}")


def _draw(found: "LinearAnalysis", section: "PortAnalysis | None", what: LinearFigure, path: Path) -> None:
    from ..reporting.figures.haptic_ports import draw_port_impedance, draw_port_passivity
    from ..reporting.figures.root_map import draw_root_map
    from ..reporting.style import REPORT_DPI, write_figure

    if section is None or what is LinearFigure.ROOTS:
        drawn = draw_root_map(found)
    else:
        drawn = (draw_port_impedance if what is LinearFigure.IMPEDANCE else draw_port_passivity)(section)
    write_figure(drawn, path, REPORT_DPI)


def _show(found: "LinearAnalysis") -> None:
    from ..reporting import linear_text

    for line in (*linear_text.describe_equilibrium(found), *linear_text.describe_effective_delays(found)):
        terminal.print_text(line)
    terminal.out.print()
    terminal.print_table(linear_text.tabulate_roots(found))
    terminal.print_text(linear_text.describe_zero_roots(found))
    verdict, _, rest = linear_text.describe_linear_verdict(found).partition(":")
    terminal.out.print(f"[{_COLOURS[verdict]}]{verdict}[/]:{escape(rest)}", soft_wrap=True)
    terminal.print_text(linear_text.describe_delay_margin(found))
    for note in found.notes:
        terminal.print_text(f"note: {note}")


def _edge_words(key: str, low: float, high: float, line: "list[LinearEdge]", scenario: "Scenario") -> str:
    if not line:
        return f"{key} from {low:g} to {high:g}: stability of {scenario.name} does not change"
    edges = [
        f"{'stable' if one.stable_above else 'unstable'} from {one.value:.6g} on "
        f"({one.omega_rad_s:.4g} rad/s)"
        for one in line
    ]
    return f"{key} from {low:g} to {high:g}: {', '.join(edges)}"

"""`trilat linear`: roots, margins and haptic ports of the loop linearised about its equilibrium."""

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from ..theory import LinearAnalysis


LinearFigure = StrEnum("LinearFigure", ["ROOTS", "IMPEDANCE", "PASSIVITY"])


def linear_command(
    scenario: options.ScenarioArgument,
    overrides: options.SetOption = None,
    pose: Annotated[
        str | None,
        options.value("--pose", "Q1,Q2,...", "Pose of all sites, rad, true theta; default: a run's end."),
    ] = None,
    roots: Annotated[int, options.value("--roots", "N", "Number of roots to print.")] = 6,
    over: Annotated[
        list[str] | None, options.value("--over", "KEY=LOW:HIGH", "Find where stability changes; repeatable.")
    ] = None,
    ports: Annotated[
        bool, typer.Option("--ports/--no-ports", help="Print what operators feel, and passivity.")
    ] = True,
    picture: Annotated[
        Path | None, options.value("--figure", "FILE", "Draw a figure: .png, .svg or .pdf.")
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
        options.check_picture(picture, force=force)
    from ..theory.linear_analysis import analyse_linear_loop

    wanted = ports or (picture is not None and what is not LinearFigure.ROOTS)
    found = analyse_linear_loop(
        scenario, overrides or [], pose=_pose(pose), roots=roots, over=over or [], ports=wanted
    )
    if picture is not None:
        _draw(found, what, picture)
    terminal.print_result(found if ports or as_json else replace(found, ports=None), as_json=as_json)
    if picture is not None and not as_json:
        terminal.print_paths([picture])


def _pose(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--pose is angles in rad, as in --pose 0.1,0.3, not {text!r}") from None


def _draw(found: "LinearAnalysis", what: LinearFigure, path: Path) -> None:
    from ..reporting.figures.haptic_ports import draw_port_impedance, draw_port_passivity
    from ..reporting.figures.root_map import draw_root_map
    from ..reporting.style import REPORT_DPI, write_figure

    if found.ports is None or what is LinearFigure.ROOTS:
        drawn = draw_root_map(found)
    else:
        drawn = (draw_port_impedance if what is LinearFigure.IMPEDANCE else draw_port_passivity)(found.ports)
    write_figure(drawn, path, REPORT_DPI)

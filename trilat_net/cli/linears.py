"""The command of linear analysis: linear."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from ..errors import UsageError
from .beside import print_table
from .options import ForceOption, ScenarioArgument, SetOption, out

if TYPE_CHECKING:
    from ..linear import Analysis, Edge
    from ..ports.section import PortSection
    from ..scenario import Scenario

app = typer.Typer()


class Plate(StrEnum):
    """What `--draw` draws."""

    ROOTS = "roots"
    IMPEDANCE = "impedance"
    PASSIVITY = "passivity"


_COLOURS = {"stable": "green", "unstable": "red", "at the edge": "yellow"}
_WORDS = "what moves"


@app.command(epilog="Example: trilat linear p_d_margin --set control.d=0.9 --over control.d=0.1:3")
def linear(
    scenario: ScenarioArgument,
    overrides: SetOption = None,
    pose: Annotated[
        str | None,
        typer.Option(
            "--pose", metavar="Q1,Q2", help="All sites here, rad, estimates true; default: a run's end."
        ),
    ] = None,
    roots: Annotated[int, typer.Option("--roots", metavar="N", help="How many roots are shown.")] = 6,
    over: Annotated[
        list[str] | None,
        typer.Option("--over", metavar="KEY=LOW:HIGH", help="Say where stability changes; repeatable."),
    ] = None,
    ports: Annotated[
        bool, typer.Option("--ports/--no-ports", help="What hands feel, and whether it is passive there.")
    ] = True,
    picture: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE", help="Draw it: .png, .svg or .pdf.")
    ] = None,
    what: Annotated[
        Plate, typer.Option("--draw", help="What is drawn: roots, what hands feel, or passivity.")
    ] = Plate.ROOTS,
    force: ForceOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="For a machine: everything, as JSON.")] = False,
) -> None:
    """Says how small motions about the resting pose grow or die, and what hands feel of each other.

    The loop is linearised with its delays: roots, delay margin, edges of stability (docs/linear.md); then,
    with hands and environments off, passivity, Llewellyn's criterion, impedance and Z-width (docs/ports.md).
    Exit code 0 whatever the verdict.
    """
    if picture is not None:
        _check_picture(picture, force=force)
    spans = [_range(text) for text in over or []]
    from ..linear import analyse, edges
    from ..ports.section import port_section

    found = analyse(scenario, overrides or [], pose=_pose(pose), roots=roots)
    lines = {key: list(edges(found.scenario, key, low, high, found.rest)) for key, low, high in spans}
    wanted = ports or (picture is not None and what is not Plate.ROOTS)
    section = port_section(found.scenario, found.rest) if wanted else None
    if picture is not None:
        _draw(found, section, what, picture)
    if as_json:
        _print_json(found, lines, section)
        return
    _show(found)
    if ports and section is not None:
        _show_ports(section)
    for (key, low, high), line in zip(spans, lines.values(), strict=True):
        out.print(escape(_edge_words(key, low, high, line, found.scenario)), soft_wrap=True)
    if picture is not None:
        out.print(f"  {escape(str(picture))}", soft_wrap=True)


def _pose(text: str | None) -> tuple[float, float] | None:
    """Returns the pose that a text such as 0.1,0.3 names."""
    if text is None:
        return None
    try:
        q1_rad, q2_rad = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--pose is two angles in rad, as in --pose 0.1,0.3, not {text!r}") from None
    return q1_rad, q2_rad


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
    from ..analysis.printing import FORMATS

    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise UsageError(f"{path}: a figure's name ends in .{', .'.join(FORMATS)}")
    if path.exists() and not force:
        raise UsageError(f"{path}: exists; choose another name, or use --force")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}")


def _draw(found: "Analysis", section: "PortSection | None", what: Plate, path: Path) -> None:
    """Writes a figure."""
    from ..analysis import style
    from ..analysis.printing import write
    from ..linear.figure import root_map
    from ..ports.figure import impedance_figure, passivity_figure

    if section is None or what is Plate.ROOTS:
        write(root_map(found), path, style.DPI)
        return
    drawn = impedance_figure if what is Plate.IMPEDANCE else passivity_figure
    write(drawn(section), path, style.DPI)


def _print_json(found: "Analysis", lines: "dict[str, list[Edge]]", section: "PortSection | None") -> None:
    from ..linear.facts import facts
    from ..ports.words import port_facts

    told = facts(found)
    told["ports"] = None if section is None else port_facts(section)
    told["edges"] = {key: [one._asdict() for one in line] for key, line in lines.items()}
    typer.echo(json.dumps(told, indent=2, ensure_ascii=False, allow_nan=False))


def _show(found: "Analysis") -> None:
    """Prints an analysis: the rest, the roots, the verdict, the margin, the notes."""
    from ..linear import words

    for line in (*words.resting(found), *words.ages(found)):
        out.print(escape(line), soft_wrap=True)
    cells = words.table(found)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for head in cells.heads:
        table.add_column(head, justify="left" if head == _WORDS else "right", no_wrap=True)
    for row in cells.rows:
        table.add_row(*map(escape, row))
    print_table(table)
    out.print(words.zeros(found), soft_wrap=True)
    verdict, _, rest = words.verdict(found).partition(":")
    out.print(f"[{_COLOURS[verdict]}]{verdict}[/]:{escape(rest)}", soft_wrap=True)
    out.print(escape(words.margin_line(found)), soft_wrap=True)
    for note in found.notes:
        out.print(f"note: {escape(note)}", soft_wrap=True)


def _show_ports(section: "PortSection") -> None:
    """Prints what there is to say of the ports."""
    from ..ports.words import port_lines

    for line in port_lines(section):
        out.print(escape(line), soft_wrap=True)


def _edge_words(key: str, low: float, high: float, line: "list[Edge]", scenario: "Scenario") -> str:
    """Returns where stability changes over a key, in words."""
    if not line:
        return f"{key} from {low:g} to {high:g}: stability of {scenario.name} does not change"
    told = [
        f"{'stable' if one.stable_above else 'unstable'} from {one.value:.6g} on "
        f"({one.omega_rad_s:.4g} rad/s)"
        for one in line
    ]
    return f"{key} from {low:g} to {high:g}: {', '.join(told)}"

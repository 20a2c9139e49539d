"""The page of a map, and its files: map.png, map.svg and map.md.

Law: the page holds nothing that is not in the results, the lines, or the commands; the same results give the
same bytes.
"""

from collections.abc import Sequence
from pathlib import Path

from ..analysis import printing
from ..analysis.form import COLUMN_IN, printed
from .chart import Chart
from .edge import Edge, edges
from .figure import map_figure
from .grid import Grid
from .line import Line
from .plane import VERDICTS, Panel, Plane

_DPI = 300


def write(chart: Chart, folder: Path, width_in: float = COLUMN_IN, name: str = "map") -> list[Path]:
    """Writes a map into a folder that exists, and returns the paths.

    Args:
        chart: the map.
        folder: where to.
        width_in: 3.5 for one column, 7 for two, in.
        name: of the files, before their suffix.

    Raises:
        UsageError: there is no such width.
    """
    form = printed(width_in)
    figure = map_figure(chart.plane, chart.lines, form)
    paths = [folder / f"{name}.{suffix}" for suffix in ("png", "svg", "md")]
    for path in paths[:2]:
        printing.write(figure, path, _DPI)
    paths[2].write_text(page(chart, paths[0].name), encoding="utf-8")
    return paths


def page(chart: Chart, picture: str) -> str:
    """Returns the page of a map, as Markdown.

    Args:
        chart: the map.
        picture: name of the figure's file.
    """
    parts = [f"# {chart.title}", "```sh\n" + "\n".join(chart.commands) + "\n```", f"![map]({picture})"]
    parts.append(counts(chart.plane).markdown())
    if meanings := _meanings(chart):
        parts.append("\n".join(f"- {one}" for one in meanings))
    for panel, lines in zip(chart.plane.panels, chart.lines, strict=True):
        table = edge_table(chart.plane, panel, lines)
        if table.rows:
            parts += [f"## {panel.title}"] if panel.title else []
            parts.append(table.markdown())
    return "\n\n".join(parts) + "\n"


def counts(plane: Plane) -> Grid:
    """Returns how many runs had which verdict, a row per panel."""
    rows = [
        (panel.title or "all", *(str(int(count)) for count in panel.counts.sum(axis=(0, 1))))
        for panel in plane.panels
    ]
    return Grid(("runs", *VERDICTS), rows)


def edge_table(plane: Plane, panel: Panel, lines: Sequence[Line]) -> Grid:
    """Returns the measured edges beside the lines, a row each; none where only one axis was swept.

    The difference is that of a line from the middle of the measured edge; "within" where the line lies in the
    measured edge, as well as its grid can tell.
    """
    heads = [plane.x.label, f"edge of {plane.y.label}", "stable is"]
    for line in lines:
        heads += [line.text, "difference"]
    rows = []
    for edge in edges(plane, panel) if plane.y.key else []:
        row = [f"{edge.x:g}", f"{edge.low:g} to {edge.high:g}", "below" if edge.stable_below else "above"]
        for line in lines:
            row += _beside(plane, edge, line)
        rows.append(tuple(row))
    return Grid(tuple(heads), rows)


def _beside(plane: Plane, edge: Edge, line: Line) -> list[str]:
    """Returns where a line crosses the column of an edge, next to it, and how far that is from it."""
    values = line.crossings(plane.x.values.index(edge.x), plane.y)
    if not values:
        return ["-", "-"]
    value = min(values, key=lambda one: abs(one - edge.middle))
    if edge.low <= value <= edge.high:
        return [f"{value:.4g}", "within"]
    return [f"{value:.4g}", f"{100.0 * (value / edge.middle - 1.0):+.1f} %"]


def _meanings(chart: Chart) -> list[str]:
    """Returns what the lines are, each once, and the remarks."""
    told = {line.text: line.about for lines in chart.lines for line in lines}
    return [f"{text}: {about}" for text, about in told.items()] + list(chart.remarks)

"""Figures of the suite: a panel per task, a row per law, a column per link.

Invariant: a cell is coloured by its mean alone; a white cross says that a run there is not
stable, a dot that one is open. Equal results give equal bytes.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from ...analysis.run_end import Stability
from ...core.vectors import Array
from ...files import write_whole
from ...reporting import style
from ...reporting.appearance import make_print_size
from ..intervals import MeanInterval
from ..study_folder import encode_csv
from .bench_results import BenchResults, build_bench_page, encode_runs, name_law

FIGURES_OF_BENCH = {
    "stable": ("share of stable runs", ""),
    "error": ("error, rad", "error_rad"),
    "effort": ("effort, N m", "effort_nm"),
    "stiffness": ("stiffness at the hand, N/m", "stiffness_n_m"),
}
"""Per figure its label, and the number that it shows; "" for the share of stable runs."""
_WIDTH_IN = 7.0
_ROW_IN = 0.14
_HEAD_IN = 0.65
_TEXT_PT = 5.5
_PALETTE = "cividis"
_NONE = "#a23b53"
"""Where there is no number: no contact, no rest, or a run that diverged."""


def list_figures_with_values(results: BenchResults) -> list[str]:
    """Returns the names of those figures for which the results have a number."""
    return [
        name
        for name in FIGURES_OF_BENCH
        if any(np.isfinite(field).any() for field in _collect_fields(results, name).values())
    ]


def _collect_fields(results: BenchResults, name: str) -> dict[str, Array]:
    """Returns the numbers of a figure: by task an array of shape (laws, links)."""
    _, quantity = FIGURES_OF_BENCH[name]
    tasks = [
        task for task in results.plan.tasks if quantity != "stiffness_n_m" or task == "contact"
    ]
    return {task: _collect(results, task, quantity) for task in tasks}


def draw_bench(results: BenchResults, name: str) -> Figure:
    """Returns a figure by its name in `FIGURES_OF_BENCH`; `list_figures_with_values` has the
    names.
    """
    label, quantity = FIGURES_OF_BENCH[name]
    links = results.plan.links
    fields = _collect_fields(results, name)
    known = np.concatenate([field[np.isfinite(field)].ravel() for field in fields.values()])
    scale: Any = Normalize(0.0, 1.0)
    if quantity:
        least, most = (float(known.min()), float(known.max())) if known.size else (0.1, 1.0)
        scale = LogNorm(max(least, 1e-6), max(most, 2e-6))
    height = sum(_HEAD_IN / 2 + _ROW_IN * len(field) for field in fields.values()) + _HEAD_IN
    form = make_print_size(_WIDTH_IN)
    with style.styled_figure(form, height) as figure:
        ratios = [len(field) for field in fields.values()]
        grid = style.add_panels(figure, len(fields), 1, sharex=True, height_ratios=ratios)[:, 0]
        for axes, (task, field) in zip(grid, fields.items(), strict=True):
            image = axes.imshow(
                field, aspect="auto", cmap=_PALETTE, norm=scale, interpolation="nearest"
            )
            _mark(axes, results, task)
            axes.set_title(task)
        grid[-1].set_xticks(range(len(links)), links, rotation=90, fontsize=_TEXT_PT)
        figure.colorbar(image, ax=list(grid), label=label, fraction=0.03)
    return figure


def _rows(results: BenchResults, task: str) -> list[tuple[str, str]]:
    return [one for one in results.plan.laws if any(results.of(task, one[0]))]


def _collect(results: BenchResults, task: str, quantity: str) -> Array:
    """Returns the numbers of a panel, shape (laws, links); NaN where there is none."""
    rows = _rows(results, task)
    links = results.plan.links
    field = np.full((len(rows), len(links)), np.nan)
    for place in results.of(task):
        value = place.mean(quantity) if quantity else place.stable / len(place.runs)
        if value is not None:
            at = rows.index((place.cell.law, place.cell.form)), links.index(place.cell.link)
            field[at] = value.mean if isinstance(value, MeanInterval) else value
    return field


def _mark(axes: Axes, results: BenchResults, task: str) -> None:
    rows = _rows(results, task)
    links = results.plan.links
    axes.set_yticks(range(len(rows)), [name_law(*one) for one in rows], fontsize=_TEXT_PT)
    axes.grid(visible=False)
    axes.set_facecolor(_NONE)
    for place in results.of(task):
        at = [links.index(place.cell.link)], [rows.index((place.cell.law, place.cell.form))]
        if place.count(Stability.NOT_STABLE):
            axes.plot(*at, marker="x", color="#ffffff", markersize=3.0, markeredgewidth=0.8)
        elif place.stable < len(place.runs):
            axes.plot(*at, marker=".", color="#ffffff", markersize=2.0)


def write_bench(results: BenchResults, folder: Path, command: str) -> list[Path]:
    """Writes the page, the tables and the figures of a suite, and returns their paths."""
    names = list_figures_with_values(results)
    pictures = {f"bench-{name}.png": FIGURES_OF_BENCH[name][0] for name in names}
    texts = {
        "bench.md": build_bench_page(results, command, pictures),
        "places.csv": encode_csv(results.to_rows()),
        "runs.csv": encode_runs(results),
    }
    for name, text in texts.items():
        write_whole(folder / name, text)
    figures = {folder / f"bench-{name}.png": name for name in names}
    for path, name in figures.items():
        style.write_figure(draw_bench(results, name), path, style.REPORT_DPI)
    return [*(folder / name for name in texts), *figures]

"""Draws benchmark results as heat maps with one row per control law and one column per link.

A figure has one panel per task. The colour of a cell is the mean of a quantity, such as the
error, over all runs of that law over that link. In the figure "stable", the colour is the worst
verdict of these runs.

Invariant:
    - The colour of a cell depends only on its mean or on its verdict.
    - In a figure of means, a white cross marks a cell in which at least one run is not stable.
      A white dot marks a cell in which no run is unstable but the stability of at least one run
      is open.
    - Equal results give identical bytes.
"""

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from trilat_net.analysis import Stability
from trilat_net.core import Array
from trilat_net.files import write_whole
from trilat_net.presentation import FigureSize, style
from trilat_net.work import MeanInterval, encode_csv

from .bench_results import BenchCellResult, BenchResults, name_law

FIGURES_OF_BENCH = {
    "stable": ("worst judgement of the runs", ""),
    "error": ("error, rad", "error_rad"),
    "effort": ("effort, N m", "effort_nm"),
    "stiffness": ("stiffness at the hand, N/m", "stiffness_n_m"),
}
"""Label and quantity of each figure. The figure of the judgements has no quantity."""
JUDGEMENTS = {
    Stability.NOT_STABLE: "#a23b53",
    Stability.OPEN: "#e2c044",
    Stability.SETTLED: "#8fb8de",
    Stability.STABLE: "#1f5a99",
}
"""Colour of each judgement, from the worst to the best. The best judgements are blue."""
_WIDTH_IN = 7.0
"""Width of a figure in inches, equal to two columns of a paper."""
_ROW_IN = 0.14
"""Height of a row, in inches."""
_HEAD_IN = 0.65
"""Height of the labels below all panels, in inches. The title of a panel takes half of it."""
_TEXT_PT = 5.5
_PALETTE = "cividis"
_NONE = "#a23b53"
"""Colour of cells without a number.

A number is missing if the slave touched no wall, the arms did not come to rest, or a run
diverged.
"""


def _list_figures_with_values(results: BenchResults) -> list[str]:
    """Lists the figures of a benchmark for which the results contain at least one number.

    Args:
        results: The results of the benchmark, which compares control laws.

    Returns:
        Names of figures that `_draw_bench` can draw. Empty if there are no numbers at all.
    """
    names = []
    for name in FIGURES_OF_BENCH:
        fields = _collect_fields(results, name)
        if any(np.isfinite(field).any() for field in fields.values()):
            names.append(name)
    return names


def _collect_fields(results: BenchResults, name: str) -> dict[str, Array]:
    """Collects the numbers of a figure, as one array of laws and links for each panel.

    Args:
        results: The results of the suite.
        name: Name of the figure, a key of `FIGURES_OF_BENCH`.

    Returns:
        For each task an array of shape (laws, links). A missing number is NaN.
    """
    _, quantity = FIGURES_OF_BENCH[name]
    tasks = list(results.plan.tasks)
    if quantity == "stiffness_n_m":
        # only the task contact has a stiffness
        tasks = [task for task in tasks if task == "contact"]
    return {task: _collect(results, task, quantity) for task in tasks}


def _draw_bench(results: BenchResults, name: str) -> Figure:
    """Draws one of the figures that compare the control laws of the benchmark.

    Args:
        results: The results of the suite.
        name: Name of the figure, from `_list_figures_with_values`.
    """
    label, quantity = FIGURES_OF_BENCH[name]
    links = results.plan.links
    fields = _collect_fields(results, name)
    is_judgement = not quantity
    if is_judgement:
        scale = Normalize(-0.5, len(JUDGEMENTS) - 0.5)
        palette: Colormap = ListedColormap(list(JUDGEMENTS.values()))
    else:
        scale = _choose_scale(list(fields.values()))
        palette = colormaps[_PALETTE]
    law_counts = [len(field) for field in fields.values()]
    panels_height = sum(_HEAD_IN / 2 + _ROW_IN * count for count in law_counts)
    size = FigureSize.for_print(_WIDTH_IN)
    figure_height = panels_height + _HEAD_IN
    with style.styled_figure(size, figure_height) as figure:
        grid = style.add_panels(
            figure,
            len(fields),
            1,
            sharex=True,
            height_ratios=law_counts,
        )
        panels = grid[:, 0]
        for axes, (task, field) in zip(panels, fields.items(), strict=True):
            image = axes.imshow(
                field,
                aspect="auto",
                cmap=palette,
                norm=scale,
                interpolation="nearest",
            )
            _label_laws(axes, results, task)
            if not is_judgement:
                _mark_cells(axes, results, task)
            axes.set_title(task)
        lowest_panel = panels[-1]
        columns = range(len(links))
        lowest_panel.set_xticks(columns, links, rotation=90, fontsize=_TEXT_PT)
        if is_judgement:
            entries = [Patch(color=colour, label=text) for text, colour in JUDGEMENTS.items()]
            figure.legend(handles=entries[::-1], loc="outside upper center", ncols=len(entries))
        else:
            # All panels have the same scale, so the colour bar of the last image applies to all
            # of them.
            figure.colorbar(image, ax=list(panels), label=label, fraction=0.03)
    return figure


def _choose_scale(fields: list[Array]) -> Normalize:
    """Returns a logarithmic colour scale from the smallest to the largest number of a figure.

    All panels have the same scale. If there are no numbers, the scale goes from 0.1 to 1.

    Args:
        fields: The numbers of the panels. NaN is ignored.
    """
    numbers_of_fields = []
    for field in fields:
        is_number = np.isfinite(field)
        numbers_of_fields.append(field[is_number].ravel())
    numbers = np.concatenate(numbers_of_fields)
    smallest = float(numbers.min()) if numbers.size else 0.1
    largest = float(numbers.max()) if numbers.size else 1.0
    # a logarithmic scale needs limits above 0
    lower = max(smallest, 1e-6)
    upper = max(largest, 2e-6)
    return LogNorm(lower, upper)


def _list_laws(results: BenchResults, task: str) -> list[tuple[str, str]]:
    """Lists the control laws that have results in a task, one per row of the figure's panel.

    Returns:
        Pairs of the name of a law and the form of the suite in which it runs.
    """
    rows = []
    for law, form in results.plan.laws:
        has_results = any(results.select(task, law))
        if has_results:
            rows.append((law, form))
    return rows


def _collect(results: BenchResults, task: str, quantity: str) -> Array:
    """Collects the mean values by which the fields of one panel of a figure are coloured.

    A field belongs to a control law (row) and a network link (column).

    Args:
        results: The results of the benchmark.
        task: The task of the panel.
        quantity: The quantity. If empty, the judgement is used.

    Returns:
        The numbers, shape (laws, links). A missing number is NaN.
    """
    laws = _list_laws(results, task)
    links = results.plan.links
    shape = (len(laws), len(links))
    field = np.full(shape, np.nan)
    for result in results.select(task):
        number = _compute_number(result, quantity)
        if number is not None:
            cell = result.cell
            row = laws.index((cell.law, cell.form))
            column = links.index(cell.link)
            field[row, column] = number
    return field


def _compute_number(result: BenchCellResult, quantity: str) -> float | None:
    """Returns the number by which a field of a figure is coloured: a mean or a judgement.

    Args:
        result: Result of one law in one task over one link.
        quantity: Quantity whose mean is returned. If empty, the index of the judgement in
            `JUDGEMENTS` is returned.

    Returns:
        The number. `None` if the runs lack the quantity.
    """
    if not quantity:
        return list(JUDGEMENTS).index(result.judgement)
    mean = result.compute_mean(quantity)
    return mean.mean if isinstance(mean, MeanInterval) else mean


def _label_laws(axes: Axes, results: BenchResults, task: str) -> None:
    """Writes the names of control laws beside the rows of a panel of the figure.

    Args:
        axes: The panel.
        results: Results of the suite.
        task: Name of the task.
    """
    laws = _list_laws(results, task)
    labels = [name_law(law, form) for law, form in laws]
    rows = range(len(laws))
    axes.set_yticks(rows, labels, fontsize=_TEXT_PT)
    axes.grid(visible=False)
    axes.set_facecolor(_NONE)


def _mark_cells(axes: Axes, results: BenchResults, task: str) -> None:
    """Marks fields of a figure whose mean value hides runs that are not stable, or are open.

    A cross marks a run that is not stable, and a dot a run whose stability is open.

    Args:
        axes: The panel.
        results: Results of the suite.
        task: Name of the task.
    """
    laws = _list_laws(results, task)
    links = results.plan.links
    for result in results.select(task):
        cell = result.cell
        x = [links.index(cell.link)]
        y = [laws.index((cell.law, cell.form))]
        if result.count(Stability.NOT_STABLE):
            axes.plot(
                x,
                y,
                marker="x",
                color="#ffffff",
                markersize=3.0,
                markeredgewidth=0.8,
            )
        elif result.stable < len(result.runs):
            axes.plot(x, y, marker=".", color="#ffffff", markersize=2.0)


def write_bench(results: BenchResults, folder: Path, command: str) -> list[Path]:
    """Writes the benchmark results to a folder, as a Markdown page, tables and figures.

    Args:
        results: The results of the benchmark.
        folder: Folder in which the files are written.
        command: The command that produces these files, which is quoted on the page.

    Returns:
        The paths of the Markdown page, the CSV tables and the PNG figures.
    """
    names = _list_figures_with_values(results)
    pictures = {}
    for name in names:
        label, _ = FIGURES_OF_BENCH[name]
        pictures[f"bench-{name}.png"] = label

    texts = {
        "bench.md": results.build_page(command, pictures),
        "places.csv": encode_csv(results.to_rows()),
        "runs.csv": results.encode_runs(),
    }
    for name, text in texts.items():
        write_whole(folder / name, text)

    figure_paths = []
    for name in names:
        path = folder / f"bench-{name}.png"
        figure = _draw_bench(results, name)
        style.write_figure(figure, path, style.REPORT_DPI)
        figure_paths.append(path)
    text_paths = [folder / name for name in texts]
    return [*text_paths, *figure_paths]

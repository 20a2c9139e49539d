"""Registry of all figures of a log, drawn by name for a paper or written with the report.

    trilat_net.figure(log, "settling").savefig("settling.pdf")

Invariant: a figure is a function of a log and a figure size; equal logs give equal bytes.
Whatever a file of this folder draws belongs to it.
"""

import pkgutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from matplotlib.figure import Figure

from ...analysis.twin_growth import PushedTwins, TwinGrowth
from ...errors import UsageError
from ...fields import suggest_nearest
from ...files import make_folder, refuse_existing
from ...log.log_reader import Log, open_log
from ...log.mcap_reader import Progress
from ..appearance import COLUMN_IN, REPORT_SIZE, FigureSize, make_print_size
from ..style import FIGURE_FORMATS, write_figure
from .figure_entry import FigureEntry, list_figures
from .joint_motion import draw_operator_displacement
from .run_overview import draw_overlay
from .twin_differences import draw_twins

for _found in pkgutil.iter_modules(import_module(__package__).__path__):
    import_module(f"{__package__}.{_found.name}")

FIGURES = list_figures()
"""By name, in the order in which a paper has them."""


def figure(
    log: str | Path | Log, name: str = "positions", width_in: float = COLUMN_IN
) -> Figure:
    """Returns a figure of a log for a paper, one of `FIGURES`: 3.5 or 7 in wide, type 8 pt.

    It shows itself in a notebook. The command is `trilat figure`.

    >>> drawn = tn.figure(tn.simulate("two_sites", duration_s=0.1), "positions")
    >>> drawn.savefig("positions.pdf")

    Raises:
        UsageError: there is no such figure or width, or the log has nothing to show in it.
    """
    form = make_print_size(width_in)
    opened = log if isinstance(log, Log) else open_log(log)
    return _find_figure(opened, name).draw(opened, form)


def list_drawable_figures(log: Log) -> list[str]:
    """Returns the names of the figures for which a log has something to show."""
    return [name for name, entry in FIGURES.items() if not entry.absent(log)]


def write_figures(
    log: Log,
    folder: Path,
    names: Sequence[str] = (),
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FIGURE_FORMATS[:2],
    force: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Writes figures of a log into a folder, which is made if it does not exist, and returns
    the paths.

    Without names these are all for which the log has something to show. They are 3.5 or 7 in
    wide; `progress` is called with the number of figures that are drawn, and of all.

    Raises:
        UsageError: there is no such figure, width or format, the log has nothing to show in it,
            or a file exists.
    """
    form = make_print_size(width_in)
    wanted = list(dict.fromkeys(names)) or list_drawable_figures(log)
    chosen = {name: partial(_find_figure(log, name).draw, log, form) for name in wanted}
    return _write(
        chosen=chosen, folder=folder, form=form, formats=formats, progress=progress, force=force
    )


def write_overlay(
    logs: Mapping[str, Log],
    folder: Path,
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FIGURE_FORMATS[:2],
    force: bool = False,
) -> list[Path]:
    """Writes several logs over one another, by their names in the legend, as overlay.pdf and so
    on.

    Raises:
        UsageError: there is no such width or format, the logs differ in kind, or a file exists.
    """
    form = make_print_size(width_in)
    chosen = {"overlay": partial(draw_overlay, logs, form)}
    return _write(chosen, folder, form, formats, force=force)


def write_report_figures(
    log: Log,
    folder: Path,
    twin: Log | None,
    progress: Progress | None = None,
    pushed: TwinGrowth | None = None,
) -> list[Path]:
    """Writes the figures of the report for which a log has something to show, and returns the
    paths.

    Earlier figures in the folder are replaced. Without `twin`, the same experiment without
    operators, `hands_moved` is left out. Twins that are given are not made again.
    """
    chosen: dict[str, Callable[[], Figure]] = {
        name: partial(FIGURES[name].draw, log, REPORT_SIZE)
        for name in list_drawable_figures(log)
        if FIGURES[name].in_report
    }
    if twin is None:
        chosen.pop("hands_moved", None)
    else:
        chosen["hands_moved"] = partial(draw_operator_displacement, log, twin=twin)
    if pushed is not None and "twins" in chosen:
        chosen["twins"] = partial(draw_twins, PushedTwins(log, 0.0, pushed))
    return _write(
        chosen=chosen, folder=folder, form=REPORT_SIZE, formats=["png"], progress=progress
    )


def _write(
    chosen: Mapping[str, Callable[[], Figure]],
    folder: Path,
    form: FigureSize,
    formats: Sequence[str],
    progress: Progress | None = None,
    *,
    force: bool = True,
) -> list[Path]:
    """Writes figures by their names; refuses what can be refused before it draws the first."""
    kinds = list(dict.fromkeys(formats))
    if strange := [kind for kind in kinds if kind not in FIGURE_FORMATS]:
        raise UsageError(
            f"a figure is written as {', '.join(FIGURE_FORMATS)}, not as {strange[0]!r}"
        )
    for path in (folder / f"{name}.{kind}" for name in chosen for kind in kinds):
        refuse_existing(path, force=force)
    paths = []
    for n, (name, draw) in enumerate(chosen.items()):
        if progress is not None:
            progress(n, len(chosen))
        drawn = draw()
        make_folder(folder)
        for kind in kinds:
            paths.append(folder / f"{name}.{kind}")
            write_figure(drawn, paths[-1], form.dpi)
    return paths


def _find_figure(log: Log, name: str) -> FigureEntry:
    if name not in FIGURES:
        hint = suggest_nearest(name, list(FIGURES)) or f"; there are {', '.join(FIGURES)}"
        raise UsageError(f"no figure {name!r}{hint}")
    if why := FIGURES[name].absent(log):
        raise UsageError(f"{name}: nothing to show: {why}")
    return FIGURES[name]

"""Draws the figures of a log by name, and writes them to files for a paper or a report.

    trilat_net.figure(log, "settling").savefig("settling.pdf")

The modules of this folder register their figures with the decorator `figure_entry.draws`.
Importing this module imports them all, which makes `FIGURES` complete.

Invariant:
    - A figure depends only on a log and a figure size.
    - Equal logs produce byte-identical files.
    - Every figure drawn by a module of this folder is in the registry.
"""

import pkgutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from matplotlib.figure import Figure

from ...analysis import PushedTwins, TwinGrowth
from ...errors import UsageError, suggest_nearest
from ...files import make_folder, refuse_existing
from ...log import Log, Progress, open_log
from ..appearance import COLUMN_IN, REPORT_SIZE, FigureSize
from ..style import DASHES, FIGURE_FORMATS, write_figure
from .compared_runs import COMPARED_SIGNALS, draw_compared_runs, list_common_sites
from .figure_entry import FigureEntry
from .joint_motion import draw_operator_displacement
from .run_overview import draw_overlay
from .twin_differences import draw_twins

# The modules of this folder register their figures when they are imported.
for _module in pkgutil.iter_modules(import_module(__package__).__path__):
    import_module(f"{__package__}.{_module.name}")

FIGURES = FigureEntry.list_all()
"""All figures by name, in the order in which they would appear in a paper."""


def figure(
    log: str | Path | Log, name: str = "positions", width_in: float = COLUMN_IN
) -> Figure:
    """Returns a figure drawn from a log, formatted for a paper with 8 pt text.

    Notebooks display the figure inline. The corresponding command is `trilat figure`.

    >>> drawn = tn.figure(tn.simulate("two_sites", duration_s=0.1), "positions")
    >>> drawn.savefig("positions.pdf")

    Args:
        log: The log, or its path.
        name: Name of the figure, one of `FIGURES`.
        width_in: Width of the figure: 3.5 in for one column of a paper, or 7 in for two.

    Raises:
        UsageError: There is no such figure, the width is neither 3.5 nor 7 in, or the figure
            cannot be drawn from the log.
    """
    form = FigureSize.for_print(width_in)
    opened = log if isinstance(log, Log) else open_log(log)
    return _find_figure(opened, name).draw(opened, form)


def list_drawable_figures(log: Log) -> list[str]:
    """Lists the names of the figures that can be drawn from a log.

    For example, a run without walls has no contact figure.

    Args:
        log: Log of the run.
    """
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
    """Draws figures from a log, formatted for a paper, and writes them to files.

    Args:
        log: Log of the run.
        folder: Folder for the files. Created if it does not exist.
        names: Names of figures. Empty for all figures that can be drawn from the log.
        width_in: Width of the figures, 3.5 or 7 in.
        formats: File formats, from `FIGURE_FORMATS`.
        force: True to overwrite existing files.
        progress: Function that is called with the number of drawn figures and the total number.

    Returns:
        The paths of the files.

    Raises:
        UsageError: A figure or a format is unknown, the width is neither 3.5 nor 7 in, a figure
            cannot be drawn from the log, or a file exists.
    """
    form = FigureSize.for_print(width_in)
    unique_names = list(dict.fromkeys(names))
    drawings: dict[str, Callable[[], Figure]] = {}
    for name in unique_names or list_drawable_figures(log):
        drawings[name] = partial(_find_figure(log, name).draw, log, form)

    return _write(
        drawings=drawings,
        folder=folder,
        form=form,
        formats=formats,
        progress=progress,
        force=force,
    )


OVERLAY = "overlay"
"""Name of the figure that compares the largest values of several runs."""


def write_overlay(
    logs: Mapping[str, Log],
    folder: Path,
    names: Sequence[str] = (),
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FIGURE_FORMATS[:2],
    force: bool = False,
) -> list[Path]:
    """Writes figures that compare several runs, such as overlay.pdf and overlay_positions.pdf.

    The figure "overlay" shows the largest values across all arms, with one line per run.
    The other figures have one panel per arm and joint.

    Args:
        logs: Mapping from the legend name of each run to its log.
        folder: Folder for the files. Created if it does not exist.
        names: Names of the figures: overlay, positions, tracking_errors or control_torques. If
            empty, all of these figures are written, or only overlay if there are more runs than
            dash patterns or the runs have no site in common.
        width_in: Width of the figures, 3.5 or 7 in.
        formats: File formats, from `FIGURE_FORMATS`.
        force: True to overwrite existing files.

    Returns:
        The paths of the files.

    Raises:
        UsageError: A figure or a format is unknown, the width is neither 3.5 nor 7 in, the
            errors of the runs have different units, there are more runs than dash patterns, the
            runs have no site in common, or a file exists.
    """
    form = FigureSize.for_print(width_in)
    known_names = (OVERLAY, *COMPARED_SIGNALS)
    for name in names:
        if name not in known_names:
            raise UsageError(
                f"figures of several logs are {', '.join(known_names)}, not {name!r}"
            )
    if not names:
        # Figures with panels distinguish the runs by their dashes, and need common sites.
        can_draw_panels = len(logs) <= len(DASHES) and list_common_sites(logs)
        names = known_names if can_draw_panels else (OVERLAY,)

    drawings: dict[str, Callable[[], Figure]] = {}
    for name in dict.fromkeys(names):
        if name == OVERLAY:
            drawings[OVERLAY] = partial(draw_overlay, logs, form)
        else:
            drawings[f"{OVERLAY}_{name}"] = partial(draw_compared_runs, logs, name, form)

    return _write(drawings, folder, form, formats, force=force)


def write_report_figures(
    log: Log,
    folder: Path,
    twin: Log | None,
    progress: Progress | None = None,
    pushed: TwinGrowth | None = None,
) -> list[Path]:
    """Writes the figures of a run's report as PNG files.

    Figures that cannot be drawn from the log are omitted. Existing files in the folder are
    replaced.

    Args:
        log: Log of the run.
        folder: Folder for the files. Created if it does not exist.
        twin: Log of the same run without operators. `None` to omit the figure that shows how
            far operators moved the arms.
        progress: Function that is called with the number of drawn figures and the total number.
        pushed: Effects of small pushes in repetitions of the run. `None` if they have not been
            computed yet.

    Returns:
        The paths of the files.
    """
    drawings: dict[str, Callable[[], Figure]] = {}
    for name in list_drawable_figures(log):
        entry = FIGURES[name]
        if entry.in_report:
            drawings[name] = partial(entry.draw, log, REPORT_SIZE)

    # These two figures need additional runs, which the caller may have executed already.
    if twin is None:
        drawings.pop("hands_moved", None)
    else:
        drawings["hands_moved"] = partial(draw_operator_displacement, log, twin=twin)
    if pushed is not None and "twins" in drawings:
        drawings["twins"] = partial(draw_twins, PushedTwins(log, 0.0, pushed))
    return _write(
        drawings=drawings, folder=folder, form=REPORT_SIZE, formats=["png"], progress=progress
    )


def _write(
    drawings: Mapping[str, Callable[[], Figure]],
    folder: Path,
    form: FigureSize,
    formats: Sequence[str],
    progress: Progress | None = None,
    *,
    force: bool = True,
) -> list[Path]:
    """Draws figures, and writes each of them in all formats.

    All formats and file names are checked before the first figure is drawn, so that an error
    does not leave an incomplete set of files.

    Args:
        drawings: Mapping from file name to the function that draws the figure.
        folder: Folder for the files. Created if it does not exist.
        form: Size of the figures.
        formats: File formats, from `FIGURE_FORMATS`.
        progress: Function that is called with the number of drawn figures and the total number.
        force: True to overwrite existing files.

    Returns:
        The paths of the files.

    Raises:
        UsageError: A format is unknown, or a file exists.
    """
    unique_formats = list(dict.fromkeys(formats))
    for file_format in unique_formats:
        if file_format not in FIGURE_FORMATS:
            known_formats = ", ".join(FIGURE_FORMATS)
            raise UsageError(
                f"a figure can be written as {known_formats}, not as {file_format!r}"
            )
    for name in drawings:
        for file_format in unique_formats:
            refuse_existing(folder / f"{name}.{file_format}", force=force)

    paths = []
    for drawn_count, (name, draw) in enumerate(drawings.items()):
        if progress is not None:
            progress(drawn_count, len(drawings))
        figure_of_log = draw()
        make_folder(folder)
        for file_format in unique_formats:
            path = folder / f"{name}.{file_format}"
            paths.append(path)
            write_figure(figure_of_log, path, form.dpi)
    return paths


def _find_figure(log: Log, name: str) -> FigureEntry:
    """Looks up a figure by the name given by the user.

    Args:
        log: Log from which the figure will be drawn.
        name: Name of the figure.

    Raises:
        UsageError: No figure has this name, or the figure cannot be drawn from the log.
    """
    if name == OVERLAY:
        raise UsageError("overlay shows several runs in one figure: add --with FILE")

    if name not in FIGURES:
        hint = suggest_nearest(name, list(FIGURES))
        if not hint:
            hint = f"; the figures are {', '.join(FIGURES)}"
        raise UsageError(f"there is no figure {name!r}{hint}")

    entry = FIGURES[name]

    reason = entry.absent(log)
    if reason:
        raise UsageError(f"{name}: nothing to show: {reason}")
    return entry

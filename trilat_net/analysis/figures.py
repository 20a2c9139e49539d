"""The figures beside a report, by the names of their files; `drawing.plates` has all that there are.

Law: each is one function of a log.
"""

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from ..log.chunks import Progress
from ..log.reader import Log
from . import style
from .ages import delay_distributions, sample_age, varied
from .motion import hands_moved, operator_torques, parameter_estimates, positions, tracking_errors
from .poses import arms
from .timing import loop_timing

__all__ = [
    "all_figures",
    "arms",
    "delay_distributions",
    "hands_moved",
    "loop_timing",
    "operator_torques",
    "parameter_estimates",
    "positions",
    "sample_age",
    "tracking_errors",
    "write_figures",
]


MOST_FIGURES = 9
"""As many as a log can have."""


def all_figures(log: Log, twin: Log | None) -> Iterator[tuple[str, Figure]]:
    """Yields every figure with the name of its file, without suffix.

    Args:
        log: the log.
        twin: the same experiment with nobody at the arms, or None.
    """
    yield "operator_torques", operator_torques(log)
    yield "positions", positions(log)
    yield "tracking_errors", tracking_errors(log)
    yield "parameter_estimates", parameter_estimates(log)
    yield "hands_moved", hands_moved(log, twin)
    yield "arms", arms(log)
    yield "sample_age", sample_age(log)
    if varied(log):
        yield "delay_distributions", delay_distributions(log)
    yield "loop_timing", loop_timing(log)


def write_figures(log: Log, folder: Path, twin: Log | None, progress: Progress | None = None) -> list[Path]:
    """Writes every figure as PNG into a folder that exists, and returns the paths."""
    paths = []
    for n, (name, figure) in enumerate(all_figures(log, twin)):
        if progress is not None:
            progress(n, MOST_FIGURES)
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=style.DPI)
        paths.append(path)
    return paths

"""Draws figures of a log, by name, for a paper, and writes them.

    trilat_net.figure(log, "settling").savefig("settling.pdf")

Law: the same log gives the same bytes.
"""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

from matplotlib.figure import Figure

from ..analysis.form import COLUMN_IN, Form, printed
from ..analysis.printing import FORMATS, write
from ..errors import UsageError
from ..log.chunks import Progress
from ..log.reader import Log
from .plates import PLATES


def figure(log: Log, name: str, width_in: float = COLUMN_IN) -> Figure:
    """Returns a figure of a log for a paper, type 8 pt.

    Args:
        log: the log.
        name: which one, of `PLATES`.
        width_in: 3.5 for one column, 7 for two, in.

    Raises:
        UsageError: there is no such figure or width, or the log has nothing to show in it.
    """
    return _drawn(log, name, printed(width_in))


def shown(log: Log) -> list[str]:
    """Returns the names of the figures for which a log has something to show."""
    return [name for name, plate in PLATES.items() if not plate.absent(log)]


def write_figures(
    log: Log,
    folder: Path,
    names: Sequence[str] = (),
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FORMATS[:2],
    force: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Writes figures of a log into a folder, and returns the paths.

    Args:
        log: the log.
        folder: where to; made if it does not exist.
        names: which ones; none: all for which the log has something to show.
        width_in: 3.5 or 7, in.
        formats: of `FORMATS`.
        force: whether files that exist are replaced.
        progress: told how many figures are drawn, and how many there are.

    Raises:
        UsageError: there is no such figure, width or format, the log has nothing to show in it, or a file
            exists.
    """
    form, wanted = printed(width_in), list(dict.fromkeys(names)) or shown(log)
    kinds = list(dict.fromkeys(formats))
    for kind in kinds:
        if kind not in FORMATS:
            raise UsageError(f"a figure is written as {', '.join(FORMATS)}, not as {kind!r}")
    for name in wanted:
        _check(log, name)
    paths = {name: [folder / f"{name}.{kind}" for kind in kinds] for name in wanted}
    _prepare(folder, [path for each in paths.values() for path in each], force=force)
    for n, (name, each) in enumerate(paths.items()):
        if progress is not None:
            progress(n, len(paths))
        drawn = PLATES[name].draw(log, form)
        for path in each:
            write(drawn, path, form.dpi)
    return [path for each in paths.values() for path in each]


def _drawn(log: Log, name: str, form: Form) -> Figure:
    _check(log, name)
    return PLATES[name].draw(log, form)


def _check(log: Log, name: str) -> None:
    if name not in PLATES:
        near = get_close_matches(name, PLATES, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(PLATES)}"
        raise UsageError(f"no figure {name!r}; {hint}")
    if why := PLATES[name].absent(log):
        raise UsageError(f"{name}: nothing to show: {why}")


def _prepare(folder: Path, paths: Sequence[Path], *, force: bool) -> None:
    there = [path for path in paths if path.exists()]
    if there and not force:
        raise UsageError(f"{there[0]}: exists; choose another folder, or use --force")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror}") from None

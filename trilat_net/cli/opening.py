"""Opens a log for a command: with a bar where it takes time, and a word where a file is not whole."""

from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from .options import err
from .progress import bar
from .show import shown

if TYPE_CHECKING:
    from ..log.reader import Log

_MOST = 3
"""Damaged parts that are told one by one."""


def opened(first: Path, *more: Path) -> "Log":
    """Returns the log in a file, or in the files that are its parts.

    Raises:
        LogError: one is missing, is no MCAP file, or no log of trilat-net.
    """
    from ..log.reader import open_log

    with bar(f"reading {first}") as progress:
        log = open_log(first, *more, progress=progress)
    for path in (first, *more):
        warn_if_torn(path)
    for problem in log.damaged[:_MOST]:
        err.print(f"note: {escape(shown(problem))}", soft_wrap=True)
    if log.damaged:
        untold = len(log.damaged) - _MOST
        rest = f"and {untold} more damaged parts; " if untold > 0 else ""
        err.print(
            f"note: {rest}all that can be read is made a whole file by: trilat log recover FILE",
            soft_wrap=True,
        )
    return log


def tell_outside_laws(log: "Log", *, needed: bool = True) -> None:
    """Says which code a log names that it does not hold, and that executing the log runs it.

    Args:
        log: the log.
        needed: whether nothing can be done without that code.

    Raises:
        ScenarioError: the file of a law is not there, and needed.
    """
    from ..errors import ScenarioError
    from ..replay.outside import outside_laws

    try:
        laws = outside_laws(log.scenario, log.source)
    except ScenarioError:
        if needed:
            raise
        return
    for law in laws:
        err.print(f"note: executing this log runs code from outside: {escape(shown(law))}", soft_wrap=True)


def warn_if_torn(path: Path) -> None:
    """Says so where a file was not finished, and what mends it.

    Raises:
        LogError: it cannot be read.
    """
    from ..errors import LogError
    from ..log.framing import Framing

    try:
        with path.open("rb") as stream:
            whole = Framing(stream).ends
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    if not whole:
        text = f"{path}: was not finished: its end and its index are missing; make it whole with: "
        err.print(f"note: {escape(text)}trilat log recover {escape(str(path))}", soft_wrap=True)

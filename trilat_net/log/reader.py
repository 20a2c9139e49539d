"""Opens a log: one file, or several that are parts of one session.

    log = open_log("run.mcap")
    log["m1"].t_s, log["m1"].q

Law: files of every released schema version open; a torn one opens as far as it is whole, and says so
(`complete`).
"""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from ..errors import LogError
from .chunks import Progress
from .columns import Ints
from .contents import Contents, contents
from .joined import joined
from .names import unfinished
from .session_log import Log
from .site_log import SiteLog

__all__ = ["Ints", "Log", "SiteLog", "open_log"]


def open_log(
    source: str | Path | BinaryIO, *more: str | Path | BinaryIO, progress: Progress | None = None
) -> Log:
    """Returns the log in a file, or in files that are parts of one session, in any order.

    Args:
        source: a path, or a file opened for reading.
        more: further parts.
        progress: told while they are read how many bytes are, and how many there are in all.

    Raises:
        LogError: a file is missing, is no MCAP file, or no log of trilat-net; files are of different
            sessions, or tell the same differently.
    """
    parts: list[Contents] = []
    with ExitStack() as stack:
        files = [_opened(one, stack) for one in (source, *more)]
        sizes = [_size(stream) for stream, _ in files]
        for n, (stream, name) in enumerate(files):
            told = None if progress is None else _from(sum(sizes[:n]), sum(sizes), progress)
            with _readable(name):
                parts.append(contents(stream, name, told))
    return Log(joined(parts))


def _opened(source: str | Path | BinaryIO, stack: ExitStack) -> tuple[BinaryIO, str]:
    """Returns a file and its name; one that is opened here is closed with the stack."""
    if not isinstance(source, str | Path):
        return source, "log"
    with _readable(str(source)):
        return stack.enter_context(Path(source).open("rb")), str(source)


@contextmanager
def _readable(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise LogError(f"{name}: cannot be read: {error.strerror}{unfinished(Path(name))}") from None


def _size(stream: BinaryIO) -> int:
    """Returns how many bytes a file has from where it stands."""
    here = stream.tell()
    size = stream.seek(0, os.SEEK_END)
    stream.seek(here)
    return size - here


def _from(before: int, total: int, progress: Progress) -> Progress:
    """Returns what tells of one of several files as of a part of the whole."""
    return lambda done, _: progress(before + done, total)

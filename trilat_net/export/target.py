"""A file or a folder that is made as a whole, or not at all.

Law: what is half made stands under another name and is removed if it stays so; nothing that exists is
replaced unasked, and of folders only one that was made here.
"""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import LogRefused, UsageError

ABOUT = "about.json"
"""What tells a folder that was made here from any other."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def refuse_existing(path: Path, *, folder: bool, force: bool) -> None:
    """Refuses a name that is taken.

    Args:
        path: the name.
        folder: whether a folder is to be made there, or a file.
        force: whether what was made here before may be replaced.

    Raises:
        UsageError: something is there.
    """
    if not os.path.lexists(path) or (folder and _is_empty(path)):
        return
    what = "folder" if folder else "file"
    replaceable = (path / ABOUT).is_file() if folder else path.is_file()
    if not replaceable:
        raise UsageError(f"{path}: exists, and is no {what} that was exported; choose another name with -o")
    if not force:
        raise UsageError(f"{path}: exists; choose another name with -o, or replace it with --force")


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


@contextmanager
def made_whole(path: Path, *, folder: bool, force: bool) -> Iterator[Path]:
    """Yields where to write; what was written there bears its name once the block has ended well.

    Args:
        path: the name.
        folder: whether it is a folder, or a file.
        force: whether what was made here before may be replaced.

    Raises:
        UsageError: something is there, or nothing can be written there.
        LogRefused: the disk is full.
    """
    refuse_existing(path, folder=folder, force=force)
    try:
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise _refused(path, error) from None
    try:
        made = scratch / path.name
        if folder:
            made.mkdir()
        yield made
        if folder and path.is_dir():
            path.rename(scratch / "before")
        made.replace(path)
    except OSError as error:
        raise _refused(path, error) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _refused(path: Path, error: OSError) -> LogRefused | UsageError:
    text = f"{path}: cannot be written: {error.strerror or error}"
    if error.errno in _FULL:
        return LogRefused(f"{text}; nothing is left of it. Make room, or take another disk with -o")
    return UsageError(text)

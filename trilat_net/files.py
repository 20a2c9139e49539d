"""Result folders and optional packages.

Invariant: nothing that exists is overwritten unless the caller forces it. An optional package is imported
where it is used; if it is missing, the error names the pip extra that installs it.
"""

import errno
import itertools
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from .errors import LogRefused, UsageError


def import_extra(module: str, name: str, purpose: str) -> Any:
    """Returns a module that an extra of this package brings.

    Args:
        module: which one, as in "scipy.io".
        name: the extra.
        purpose: what needs it, in the plural.

    Raises:
        UsageError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise UsageError(f"{purpose} need {package}: pip install 'trilat-net[{name}]'") from None


def make_results_folder(folder: Path | None, name: str, *, force: bool) -> Path:
    """Makes a folder for results.

    Args:
        folder: which one, or None for the next free `runs/NAME-N`.
        name: what the run is called.
        force: whether a folder that holds something may be used.

    Raises:
        UsageError: it holds something, or cannot be made.
    """
    chosen = folder if folder is not None else _next_free(Path("runs"), name)
    try:
        if not force and chosen.exists() and any(chosen.iterdir()):
            raise UsageError(f"{chosen}: holds something; choose another folder, or use --force")
        chosen.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{chosen}: cannot be made or read: {error.strerror}") from None
    return chosen


def _next_free(parent: Path, name: str) -> Path:
    return next(path for n in itertools.count(1) if not (path := parent / f"{name}-{n:03d}").exists())


EXPORT_MANIFEST = "about.json"
"""What tells a folder that was made here from any other."""
_EXPORT_FULL_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def refuse_existing_export(path: Path, *, folder: bool, force: bool) -> None:
    """Refuses a name that is taken.

    Args:
        path: the name.
        folder: whether a folder is to be made there, or a file.
        force: whether what was made here before may be replaced.

    Raises:
        UsageError: something is there.
    """
    if not os.path.lexists(path) or (folder and _is_empty_folder(path)):
        return
    what = "folder" if folder else "file"
    replaceable = (path / EXPORT_MANIFEST).is_file() if folder else path.is_file()
    if not replaceable:
        raise UsageError(f"{path}: exists, and is no {what} that was exported; choose another name with -o")
    if not force:
        raise UsageError(f"{path}: exists; choose another name with -o, or replace it with --force")


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


@contextmanager
def stage_export(path: Path, *, folder: bool, force: bool) -> Iterator[Path]:
    """Yields where to write; what was written there bears its name once the block has ended well.

    Args:
        path: the name.
        folder: whether it is a folder, or a file.
        force: whether what was made here before may be replaced.

    Raises:
        UsageError: something is there, or nothing can be written there.
        LogRefused: the disk is full.
    """
    refuse_existing_export(path, folder=folder, force=force)
    try:
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise _make_export_refused(path, error) from None
    try:
        made = scratch / path.name
        if folder:
            made.mkdir()
        yield made
        if folder and path.is_dir():
            path.rename(scratch / "before")
        made.replace(path)
    except OSError as error:
        raise _make_export_refused(path, error) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _make_export_refused(path: Path, error: OSError) -> LogRefused | UsageError:
    text = f"{path}: cannot be written: {error.strerror or error}"
    if error.errno in _EXPORT_FULL_ERRNOS:
        return LogRefused(f"{text}; nothing is left of it. Make room, or take another disk with -o")
    return UsageError(text)


def refuse_existing_log(path: Path, working: Path, *, force: bool) -> None:
    """Refuses a name that is taken.

    Raises:
        UsageError: the log exists, or one that was not finished; or it is no file at all.
    """
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        raise UsageError(f"{path}: exists, and is no file; choose another name")
    if force:
        return
    if path.exists():
        raise UsageError(f"{path}: exists; choose another name, or replace it with --force")
    if working.exists():
        raise UsageError(
            f"{working}: exists: it is being written, or was never finished; make it whole with: trilat log "
            f"recover {working}; or choose another name, or replace it with --force"
        )


def sync_folder(folder: Path) -> None:
    """Puts a folder's names onto the disk, where such a thing is possible."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def open_new_file(path: Path, *, force: bool = False) -> Iterator[BinaryIO]:
    """Opens a small file for writing that must not exist yet, unless it may be replaced; closes it.

    Args:
        path: which file.
        force: whether it may replace one.

    Raises:
        UsageError: it exists, or cannot be made.
        LogRefused: the disk refused what was still to be written.
    """
    try:
        stream = path.open("wb" if force else "xb")
    except FileExistsError:
        raise UsageError(f"{path}: exists; choose another name, or replace it with --force") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        yield stream
    finally:
        try:
            stream.close()
        except OSError as error:  # what a full disk refused is refused once more on closing
            raise make_log_refused(error) from None


def make_log_refused(error: OSError) -> LogRefused:
    """Returns the error of a log whose disk refused a write."""
    return LogRefused(f"the log cannot be written: {error.strerror}; what was flushed before is intact")

"""Output files and folders: refused where something exists, replaced only by force, written
whole.

Invariant:
- Nothing that exists is replaced unless the caller forces it, and an output bears its name only
  once it is complete.
- No output is written through a symbolic link that stands in place of an output file, or of a
  folder that the program makes within its output: whoever planted the link would choose the
  file that is overwritten.
- An optional package is imported where it is used; if it is missing, the error names what
  installs it.
"""

import errno
import hashlib
import itertools
import os
import shlex
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

from .errors import LogError, LogRefused, TrilatError, UsageError

DISK_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


STUDY_LIBRARIES = ("loky", "matplotlib", "scipy")
"""What `trilat-net` installs, and `trilat-net-core` does without (pyproject.toml)."""


def require_libraries(*names: str) -> None:
    """Refuses what needs these libraries, or all of `STUDY_LIBRARIES`, before any of it is
    done.

    Raises:
        UsageError: one of them is not installed.
    """
    if missing := [name for name in names or STUDY_LIBRARIES if find_spec(name) is None]:
        text = f"this needs {', '.join(missing)}, which trilat-net-core does without"
        raise UsageError(f"{text}: pip install trilat-net")


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Imports a module of an optional package; `purpose` names the features that need it, in
    the plural.

    Raises:
        UsageError: the package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise UsageError(f"{purpose} need {package}: {format_extra_install(extra)}") from None


def format_extra_install(extra: str) -> str:
    """Returns the command that installs an extra where this program runs.

    - In the `.venv` of a clone: a target of the clone's Makefile, which installs locked
      versions.
    - In another environment that uses a clone: pip, with the clone.
    - Anywhere else: pip, with the distribution.
    """
    clone = Path(__file__).resolve().parents[1]
    if not all((clone / name).is_file() for name in ("Makefile", "pyproject.toml")):
        return f"pip install 'trilat-net[{extra}]'"
    if Path(sys.prefix).resolve() != clone / ".venv":
        return shlex.join([sys.executable, "-m", "pip", "install", "-e", f"{clone}[{extra}]"])
    elsewhere = [] if Path.cwd() == clone else ["-C", str(clone)]
    return shlex.join(["make", *elsewhere, "extras", f"EXTRAS={extra}"])


def find_version() -> str:
    """Returns the version of this program, whichever of its distributions has its files."""
    for name in ("trilat-net-core", "trilat-net"):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return "unknown"


def find_page(name: str) -> Path:
    """Returns where a page of the documentation is on this machine: beside the sources, or as
    installed.
    """
    sources = Path(__file__).parents[1] / "docs" / name
    return (
        sources
        if sources.is_file()
        else Path(sys.prefix) / "share" / "doc" / "trilat-net" / name
    )


def open_regular(path: Path, **how: Any) -> Any:
    """Opens a file for reading, as text if its encoding is given; a pipe or a device may have
    no end.

    Raises:
        OSError: it is one of these, or cannot be opened.
    """
    mode = "r" if "encoding" in how else "rb"
    ways = getattr(os, "O_NONBLOCK", 0)  # or a pipe without a writer would be waited for
    stream = open(path, mode, opener=lambda name, flags: os.open(name, flags | ways), **how)  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "it is a pipe or a device, no file", str(path))
    return stream


_OTHER_KINDS = {
    b"\x89MCAP": "an MCAP file",
    b"\xd0\xcf\x11\xe0": "a spreadsheet or document of an old Office program (.xls, .doc)",
    b"\x1f\x8b": "a gzip file",
    b"%PDF": "a PDF document",
    b"SQLite": "an SQLite database",
}
"""Kinds of files by their first bytes."""
_ZIPPED_KINDS = {
    b"xl/workbook": "a spreadsheet (.xlsx)",
    b"opendocument.spreadsheet": "a spreadsheet (.ods)",
    b"Index/Tables": "a spreadsheet (.numbers)",
    b"word/document": "a text document (.docx)",
}
"""Kinds of ZIP archives by what stands in them uncompressed."""


def decode_text(raw: bytes, *, any_code_page: bool = False) -> str:
    """Returns the text of a file in UTF-8, or in UTF-16 as Windows PowerShell writes it.

    Args:
        raw: the content of the file.
        any_code_page: True: other texts are read as well, since programs on Windows print in
            the code page of their country. Their letters beyond ASCII come out as those of
            Latin-1.

    Raises:
        ValueError: the content is not text; the message names a spreadsheet as a spreadsheet.
    """
    if raw[:4] == b"PK\x03\x04":
        kind = next(
            (kind for mark, kind in _ZIPPED_KINDS.items() if mark in raw), "a ZIP archive"
        )
        raise ValueError(_say_not_text(kind))
    for mark, kind in _OTHER_KINDS.items():
        if raw.startswith(mark):
            raise ValueError(_say_not_text(kind))
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16")
    if raw[:2].count(0) == 1:  # UTF-16 without its mark: ASCII has a zero byte in each pair
        return raw.decode("utf-16-be" if raw[0] == 0 else "utf-16-le")
    if 0 in raw:
        raise ValueError("is not text: it has zero bytes")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        if not any_code_page:
            raise
        return raw.decode("latin-1")


def _say_not_text(kind: str) -> str:
    advice = "save its sheet as CSV" if "spreadsheet" in kind else "a text file is needed"
    return f"is {kind}, not text: {advice}"


@contextmanager
def reading(path: Path, kind: type[TrilatError] = LogError) -> Iterator[BinaryIO]:
    """Yields a file opened for reading.

    Raises:
        TrilatError: of this kind, the file cannot be read.
    """
    try:
        with open_regular(path) as stream:
            yield stream
    except OSError as error:
        raise kind(f"{path}: cannot be read: {error.strerror}") from None


def digest_file(path: Path) -> str:
    """Returns the SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_foreign_permissions(path: Path) -> int:
    """Returns the bits of a file's mode that let others in; 0 on Windows, where a list says who
    may.
    """
    return 0 if os.name == "nt" else path.stat().st_mode & 0o077


def make_folder(folder: Path) -> Path:
    """Makes a folder and its parents, and returns it.

    Raises:
        UsageError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            raise describe_write_error(folder, error) from None
        raise UsageError(f"{folder}: cannot be made: {error.strerror}") from None
    return folder


SYSTEM_FOLDERS = ("/dev", "/dev/fd", "/proc/self/fd")
"""Folders in which symbolic links are the system's own, as /dev/stdout is."""


def refuse_link(path: Path) -> None:
    """Refuses a symbolic link in place of an output.

    Raises:
        UsageError: the path is one, and not one of the system's own.
    """
    if path.is_symlink() and path.parent.as_posix() not in SYSTEM_FOLDERS:
        problem = "is a symbolic link, and no output is written through one"
        raise UsageError(f"{path}: {problem}; remove it, or choose another name")


def make_subfolder(folder: Path) -> Path:
    """Makes a folder within an output folder, and returns it; it may exist.

    Raises:
        UsageError: a symbolic link stands in its place, or it cannot be made.
    """
    refuse_link(folder)
    return make_folder(folder)


def create_file(path: Path) -> BinaryIO:
    """Returns a new file without a buffer, in place of any earlier one, which is removed and
    not written to.

    Raises:
        UsageError: a symbolic link stands in its place.
        OSError: the file cannot be made.
    """
    refuse_link(path)
    path.unlink(missing_ok=True)
    return path.open("xb", buffering=0)


def extend_file(path: Path) -> BinaryIO:
    """Returns a file without a buffer that is written to at its end; it may exist.

    Raises:
        UsageError: a symbolic link stands in its place.
        OSError: the file cannot be opened.
    """
    refuse_link(path)
    no_link = getattr(os, "O_NOFOLLOW", 0)  # Windows has none
    return open(
        path,
        "ab",
        buffering=0,
        opener=lambda name, flags: os.open(name, flags | no_link, 0o666),
    )


def make_results_folder(folder: Path | None, name: str, *, force: bool | None) -> Path:
    """Makes a folder for results: the given one, or the next free `runs/NAME-N`.

    Raises:
        UsageError: it holds something (and `force` is not set; None: cannot be set), or it
            cannot be made.
    """
    if folder is None:
        return _make_next_folder(name)
    try:
        occupied = not force and folder.exists() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made or read: {error.strerror}") from None
    if occupied:
        forced = "" if force is None else ", or use --force"
        raise UsageError(f"{folder}: holds something; choose another folder{forced}")
    return make_folder(folder)


def _make_next_folder(name: str) -> Path:
    """Makes the next free `runs/NAME-N`, which no other process gets as well."""
    for n in itertools.count(1):
        folder = Path("runs") / f"{name}-{n:03d}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise describe_write_error(folder, error) from None
        return folder
    raise AssertionError("there are endless numbers")


def refuse_existing(
    path: Path, *, force: bool, unfinished: Path | None = None, manifest: str | None = None
) -> None:
    """Refuses an output whose name is taken.

    Args:
        path: the output.
        force: whether an earlier output of the same kind may be replaced.
        unfinished: name of the output while it is written, which must be free too.
        manifest: file that marks a folder as an earlier output; None where the output is a
            file.

    Raises:
        UsageError: the name is taken, or is that of a symbolic link.
    """
    refuse_link(path)
    if os.path.lexists(path) and not (manifest and path.is_dir() and not any(path.iterdir())):
        replaceable = (path / manifest).is_file() if manifest else path.is_file()
        if not replaceable:
            kind = "folder that was exported" if manifest else "file"
            raise UsageError(f"{path}: exists, and is no {kind}; choose another name")
        if not force:
            raise UsageError(f"{path}: exists; choose another name, or replace it with --force")
    if unfinished is not None and unfinished.exists() and not force:
        raise UsageError(
            f"{unfinished}: exists: it is being written, or was never finished; make it whole with: "
            f"trilat log recover {unfinished}; or choose another name, or replace it with --force"
        )


def publish_file(unfinished: Path, path: Path, *, force: bool) -> None:
    """Gives a complete file its name; without `force` an existing file of that name stays.

    Raises:
        UsageError: the name is taken.
    """
    if force:
        unfinished.replace(path)
        return
    try:
        os.link(unfinished, path)  # unlike a renaming it never replaces
        unfinished.unlink()
    except FileExistsError:
        raise UsageError(
            f"{path}: exists by now; the finished file is {unfinished}: give it a name"
        ) from None
    except OSError:  # a file system without links
        refuse_existing(path, force=False)
        unfinished.rename(path)


def write_whole(
    path: Path, data: bytes | str, *, force: bool = True, remedy: str = "", mode: int = 0o666
) -> None:
    """Writes a file so that it exists whole or not at all; a device or pipe is written to
    directly.

    A symbolic link in its place is refused; one that appears meanwhile is replaced, and not
    followed.

    Args:
        path: the file.
        data: its content; text is encoded as UTF-8.
        force: whether it may replace a file.
        remedy: what the error of a full disk advises.
        mode: rights of a new file, less those that the umask takes.

    Raises:
        UsageError: it exists, is a symbolic link, or cannot be made.
        LogRefused: the disk refused it.
    """
    content = data.encode() if isinstance(data, str) else data
    refuse_link(path)
    if not force:
        refuse_existing(path, force=False)
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(content)
            return
        unfinished = path.with_name(f"{path.name}.unfinished")
        try:
            unfinished.unlink(missing_ok=True)  # of an earlier try: its rights may be others
            with open(unfinished, "xb", opener=partial(os.open, mode=mode)) as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            publish_file(unfinished, path, force=force)
        except OSError:
            unfinished.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise describe_write_error(path, error, remedy) from None


@contextmanager
def stage_output(path: Path, *, force: bool, manifest: str | None = None) -> Iterator[Path]:
    """Yields a scratch path; what is written there gets the output's name when the block ends
    well.

    Args:
        path: the output.
        force: whether an earlier output of the same kind may be replaced.
        manifest: see `refuse_existing`; with one, the scratch path is a folder.

    Raises:
        UsageError: the name is taken, or nothing can be written there.
        LogRefused: the disk refused it.
    """
    refuse_existing(path, force=force, manifest=manifest)
    remedy = "nothing is left of it. Make room, or take another disk"
    try:
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise describe_write_error(path, error, remedy) from None
    try:
        staged = scratch / path.name
        if manifest:
            staged.mkdir()
        yield staged
        if manifest and path.is_dir():
            path.rename(scratch / "before")
        staged.replace(path)
    except OSError as error:
        raise describe_write_error(path, error, remedy) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def sync_folder(folder: Path) -> None:
    """Syncs the names in a folder to the disk, where the platform can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def describe_write_error(
    path: Path, error: OSError, remedy: str = ""
) -> LogRefused | UsageError:
    """Returns the error of a failed write: `LogRefused`, with a remedy, if the disk refused it."""
    text = f"{path}: cannot be written: {error.strerror or error}"
    if error.errno in DISK_ERRNOS:
        return LogRefused(f"{text}; {remedy}" if remedy else text)
    return UsageError(text)

"""Output files and folders, input files, and optional packages.

Invariant:
    - An existing output is replaced only if the caller forces it, and an output gets its name
      only when it is complete.
    - No output is written through a symbolic link in place of an output file, or of a folder
      that the program makes within its output. Otherwise, the author of the link could choose
      which file is overwritten.
    - An optional package is imported where it is used. If it is missing, the error names the
      command that installs it.
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
"""Errors with which a disk refuses data."""
STUDY_LIBRARIES = ("loky", "matplotlib", "scipy")
"""Libraries that `trilat-net` installs and `trilat-net-core` does not (pyproject.toml)."""


def require_libraries(*names: str) -> None:
    """Refuses a command before it starts if a library that it needs is missing.

    Args:
        names: the libraries; by default all of `STUDY_LIBRARIES`.

    Raises:
        UsageError: a library is not installed.
    """
    missing = [name for name in names or STUDY_LIBRARIES if find_spec(name) is None]
    if missing:
        raise UsageError(
            f"this needs {', '.join(missing)}, which trilat-net-core does without: "
            "pip install trilat-net"
        )


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Imports and returns a module of an optional package.

    Args:
        module: the module.
        extra: the extra of trilat-net that installs the package.
        purpose: the features that need the package, in the plural.

    Raises:
        UsageError: the package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise UsageError(f"{purpose} need {package}: {format_extra_install(extra)}") from None


def format_extra_install(extra: str) -> str:
    """Returns the command that installs an extra in the environment of this program.

    - In the `.venv` of a clone, the command is a target of the clone's Makefile, which installs
      locked versions.
    - In another environment that uses a clone, the command is pip with the clone.
    - Anywhere else, the command is pip with the distribution.
    """
    clone = Path(__file__).resolve().parents[1]
    if not all((clone / name).is_file() for name in ("Makefile", "pyproject.toml")):
        return f"pip install 'trilat-net[{extra}]'"
    if Path(sys.prefix).resolve() != clone / ".venv":
        return shlex.join([sys.executable, "-m", "pip", "install", "-e", f"{clone}[{extra}]"])
    elsewhere = [] if Path.cwd() == clone else ["-C", str(clone)]
    return shlex.join(["make", *elsewhere, "extras", f"EXTRAS={extra}"])


def find_version() -> str:
    """Returns the version of this program, from either of its distributions."""
    for name in ("trilat-net-core", "trilat-net"):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return "unknown"


def find_page(name: str) -> Path:
    """Returns the path of a documentation page, beside the sources or as installed."""
    beside_sources = Path(__file__).parents[1] / "docs" / name
    if beside_sources.is_file():
        return beside_sources
    return Path(sys.prefix) / "share" / "doc" / "trilat-net" / name


def open_regular(path: Path, **options: Any) -> Any:
    """Opens a regular file for reading, as text if `encoding` is among the options.

    Pipes and devices are refused because they may have no end.

    Args:
        path: the file.
        options: further arguments of `open`.

    Raises:
        OSError: the path is a pipe or a device, or cannot be opened.
    """
    mode = "r" if "encoding" in options else "rb"
    # Without this flag, opening a pipe that has no writer would block.
    no_block = getattr(os, "O_NONBLOCK", 0)

    def open_without_blocking(name: str, flags: int) -> int:
        return os.open(name, flags | no_block)

    stream = open(path, mode, opener=open_without_blocking, **options)  # noqa: SIM115
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
"""Kinds of ZIP archives by a text that they contain uncompressed."""


def decode_text(raw: bytes, *, any_code_page: bool = False) -> str:
    """Returns the text of a file in UTF-8, or in UTF-16 as Windows PowerShell writes it.

    Args:
        raw: the content of the file.
        any_code_page: True: texts in another encoding are decoded as Latin-1, since programs
            on Windows print in the code page of their country. Letters beyond ASCII may be
            wrong then.

    Raises:
        ValueError: the content is not text; the message names a spreadsheet as a spreadsheet.
    """
    if raw[:4] == b"PK\x03\x04":
        kinds = [kind for mark, kind in _ZIPPED_KINDS.items() if mark in raw]
        raise ValueError(_describe_kind(kinds[0] if kinds else "a ZIP archive"))
    for mark, kind in _OTHER_KINDS.items():
        if raw.startswith(mark):
            raise ValueError(_describe_kind(kind))
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16")
    # UTF-16 without a byte order mark: each pair of bytes of ASCII text has one zero.
    if raw[:2].count(0) == 1:
        return raw.decode("utf-16-be" if raw[0] == 0 else "utf-16-le")
    if 0 in raw:
        raise ValueError("is not text: it has zero bytes")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        if not any_code_page:
            raise
        return raw.decode("latin-1")


def _describe_kind(kind: str) -> str:
    """Returns the problem of a file that is not text, with advice."""
    advice = "save its sheet as CSV" if "spreadsheet" in kind else "a text file is needed"
    return f"is {kind}, not text: {advice}"


@contextmanager
def reading(path: Path, kind: type[TrilatError] = LogError) -> Iterator[BinaryIO]:
    """Opens a regular file for reading as a context.

    Args:
        path: the file.
        kind: the error class.

    Raises:
        TrilatError: of class `kind`, if the file cannot be read.
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
    """Returns the permission bits of a file for its group and others.

    The result is 0 on Windows, which has access control lists instead.
    """
    return 0 if os.name == "nt" else path.stat().st_mode & 0o077


def make_folder(folder: Path) -> Path:
    """Makes a folder and its parents, and returns the folder.

    Raises:
        UsageError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            raise describe_write_error(folder, error) from None
        raise UsageError(f"{folder}: cannot be made: {error.strerror}") from None
    return folder


SYSTEM_FOLDERS = ("/dev", "/dev/fd", "/proc/self/fd")
"""Folders in which the system itself has symbolic links, for instance /dev/stdout."""


def refuse_link(path: Path) -> None:
    """Refuses a symbolic link in place of an output.

    Raises:
        UsageError: the path is a symbolic link outside of `SYSTEM_FOLDERS`.
    """
    if path.is_symlink() and path.parent.as_posix() not in SYSTEM_FOLDERS:
        problem = "is a symbolic link, and no output is written through one"
        raise UsageError(f"{path}: {problem}; remove it, or choose another name")


def make_subfolder(folder: Path) -> Path:
    """Makes a folder within an output folder unless it exists, and returns the folder.

    Raises:
        UsageError: the path is a symbolic link, or the folder cannot be made.
    """
    refuse_link(folder)
    return make_folder(folder)


def create_file(path: Path) -> BinaryIO:
    """Returns a new unbuffered file, after removing an earlier file of that name.

    Raises:
        UsageError: the path is a symbolic link.
        OSError: the file cannot be made.
    """
    refuse_link(path)
    path.unlink(missing_ok=True)
    return path.open("xb", buffering=0)


def extend_file(path: Path) -> BinaryIO:
    """Returns an unbuffered file for appending, which is created if necessary.

    Raises:
        UsageError: the path is a symbolic link.
        OSError: the file cannot be opened.
    """
    refuse_link(path)
    # Windows does not have this flag.
    no_follow = getattr(os, "O_NOFOLLOW", 0)

    def open_without_following(name: str, flags: int) -> int:
        return os.open(name, flags | no_follow, 0o666)

    return open(path, "ab", buffering=0, opener=open_without_following)


def make_results_folder(folder: Path | None, name: str, *, force: bool | None) -> Path:
    """Makes and returns a folder for results.

    Args:
        folder: the folder; None chooses the next free `runs/NAME-N`.
        name: NAME.
        force: whether the folder may have content; None if the command has no option for it.

    Raises:
        UsageError: the folder has content and `force` is not set, or it cannot be made.
    """
    if folder is None:
        return _make_next_folder(name)
    try:
        occupied = not force and folder.exists() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made or read: {error.strerror}") from None
    if occupied:
        advice = "" if force is None else ", or use --force"
        raise UsageError(f"{folder}: holds something; choose another folder{advice}")
    return make_folder(folder)


def _make_next_folder(name: str) -> Path:
    """Makes and returns the next free `runs/NAME-N`; no other process gets the same folder."""
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
        unfinished: name of the output while it is written, which must also be free.
        manifest: file that marks a folder as an earlier output; None if the output is a file.

    Raises:
        UsageError: the name is taken, or is that of a symbolic link.
    """
    refuse_link(path)
    is_empty_folder = manifest and path.is_dir() and not any(path.iterdir())
    if os.path.lexists(path) and not is_empty_folder:
        is_replaceable = (path / manifest).is_file() if manifest else path.is_file()
        if not is_replaceable:
            kind = "folder that was exported" if manifest else "file"
            raise UsageError(f"{path}: exists, and is no {kind}; choose another name")
        if not force:
            raise UsageError(f"{path}: exists; choose another name, or replace it with --force")
    if unfinished is not None and unfinished.exists() and not force:
        raise UsageError(
            f"{unfinished}: exists: it is being written, or was never finished; make it whole "
            f"with: trilat log recover {unfinished}; or choose another name, or replace it "
            "with --force"
        )


def publish_file(unfinished: Path, path: Path, *, force: bool) -> None:
    """Gives a complete file its name; without `force` an existing file is not replaced.

    Raises:
        UsageError: the name is taken.
    """
    if force:
        unfinished.replace(path)
        return
    try:
        # In contrast to a rename, a link never replaces an existing file.
        os.link(unfinished, path)
        unfinished.unlink()
    except FileExistsError:
        raise UsageError(
            f"{path}: exists by now; the finished file is {unfinished}: give it a name"
        ) from None
    except OSError:  # the file system does not support links
        refuse_existing(path, force=False)
        unfinished.rename(path)


def write_whole(
    path: Path, data: bytes | str, *, force: bool = True, remedy: str = "", mode: int = 0o666
) -> None:
    """Writes a file so that it exists completely or not at all.

    A device or a pipe is written directly. A symbolic link is refused; a link that appears
    meanwhile is replaced, not followed.

    Args:
        path: the file.
        data: its content; text is encoded as UTF-8.
        force: whether it may replace a file.
        remedy: advice in the error of a full disk.
        mode: permissions of a new file, before the umask.

    Raises:
        UsageError: the file exists, is a symbolic link, or cannot be made.
        LogRefused: the disk refused the data.
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
            # A file of an earlier attempt may have other permissions.
            unfinished.unlink(missing_ok=True)
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
    """Yields a scratch path, which gets the output's name if the block succeeds.

    Args:
        path: the output.
        force: whether an earlier output of the same kind may be replaced.
        manifest: see `refuse_existing`; with a manifest the scratch path is a folder.

    Raises:
        UsageError: the name is taken, or the path is not writable.
        LogRefused: the disk refused the data.
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
    """Writes a folder's directory entries to the disk, if the platform supports it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def describe_write_error(
    path: Path, error: OSError, remedy: str = ""
) -> LogRefused | UsageError:
    """Returns the error of a failed write.

    Args:
        path: the file.
        error: the error of the system.
        remedy: advice that is added if the disk refused the data (`LogRefused`).
    """
    text = f"{path}: cannot be written: {error.strerror or error}"
    if error.errno in DISK_ERRNOS:
        return LogRefused(f"{text}; {remedy}" if remedy else text)
    return UsageError(text)

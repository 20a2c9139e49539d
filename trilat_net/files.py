"""Writes output files safely, checks input files, and imports optional packages.

Commands use these helpers to write their results, so a crash or a mistyped path does not
destroy earlier results.

Invariant:
    - An existing output is replaced only if the caller passes `force`.
    - A file or folder gets its final name only when it is complete. A program that is killed
      while writing therefore leaves no output that looks complete.
    - An output is never written through a symbolic link, not even inside an output folder.
      Otherwise, whoever created the link could choose which file is overwritten.
    - An optional package is imported where it is used. If it is missing, the error states the
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
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from .errors import LogError, LogRefused, TrilatError, UsageError

DISK_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
"""Error numbers that indicate that a disk accepts no more data, for example because it is full.
"""


class Extra(NamedTuple):
    """A group of optional packages, which users install as in `pip install trilat-net[view]`.

    Attributes:
        name: Name of the group, such as "view" (see `package_names.EXTRAS`).
        purpose: The features that need the packages, in the plural, for error messages.
    """

    name: str
    purpose: str = "these features"

    def import_module(self, module: str) -> Any:
        """Imports a module of the group, which may not be installed.

        If the package is missing, the user gets an error message with the install command
        instead of a traceback.

        Args:
            module: Name of the module.

        Raises:
            UsageError: The package is not installed. The message contains the command that
                installs it.
        """
        try:
            return import_module(module)
        except ImportError as error:
            package = module.partition(".")[0]
            # The package may be installed, but not a library that it needs itself.
            missing = (error.name or package).partition(".")[0]
            need = package if missing == package else f"{package}, which needs {missing}"
            raise UsageError(f"{self.purpose} need {need}: {self.install_command}") from None

    @property
    def install_command(self) -> str:
        """Shell command that installs the group in the current environment.

        - In the `.venv` of a repository clone, the command is a target of the clone's Makefile,
          which installs locked versions.
        - In any other environment that uses a clone, the command is pip with the path of the
          clone.
        - Otherwise, the command is pip with the name of the distribution.
        """
        clone = Path(__file__).resolve().parents[1]
        is_clone = all((clone / name).is_file() for name in ("Makefile", "pyproject.toml"))
        if not is_clone:
            return f"pip install 'trilat-net[{self.name}]'"

        is_environment_of_clone = Path(sys.prefix).resolve() == clone / ".venv"
        if not is_environment_of_clone:
            requirement = f"{clone}[{self.name}]"
            return shlex.join([sys.executable, "-m", "pip", "install", "-e", requirement])

        change_folder = [] if Path.cwd() == clone else ["-C", str(clone)]
        return shlex.join(["make", *change_folder, "extras", f"EXTRAS={self.name}"])


def find_version() -> str:
    """Returns the version of this program, or "unknown" if it is not installed.

    The program may be installed as the distribution trilat-net or trilat-net-core.
    """
    for name in ("trilat-net-core", "trilat-net"):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return "unknown"


def find_page(name: str) -> Path:
    """Returns the local path of a documentation page.

    In a repository clone, the pages are in the folder docs. Otherwise, they are in the location
    chosen by the installer.

    Args:
        name: File name of the page, for example "json.md". File names are unique.

    Returns:
        The path of the page. If the page does not exist, the path that it would have in the
        installation.
    """
    installed = Path(sys.prefix) / "share" / "doc" / "trilat-net"
    for folder in (Path(__file__).parents[1] / "docs", installed):
        for page in folder.rglob(name):
            return page
    return installed / name


def open_regular(path: Path, **options: Any) -> Any:
    """Opens a regular file for reading. Folders, pipes and devices are rejected.

    Reading a pipe or device might never end.

    Args:
        path: The file.
        options: Further arguments for `open`. If `encoding` is given, the file is opened in
            text mode.

    Raises:
        OSError: The path is a folder, a pipe or a device, or cannot be opened.
    """
    mode = "r" if "encoding" in options else "rb"
    # Without this flag, opening a pipe that has no writer would block.
    no_block = getattr(os, "O_NONBLOCK", 0)

    def open_without_blocking(name: str, flags: int) -> int:
        return os.open(name, flags | no_block)

    # The system would only say "Is a directory".
    if path.is_dir():
        problem = "the path is a folder, not a file"
        logs = sorted(path.glob("*.mcap"))
        if logs:
            problem += f"; name a file in it, for example {logs[0]}"
        raise IsADirectoryError(errno.EISDIR, problem, str(path))

    # Check the open file and not the path, which may change in between.
    stream = open(path, mode, opener=open_without_blocking, **options)  # noqa: SIM115
    mode_bits = os.fstat(stream.fileno()).st_mode
    if not stat.S_ISREG(mode_bits):
        stream.close()
        raise OSError(errno.EINVAL, "the path is a pipe or a device, not a file", str(path))
    return stream


@contextmanager
def reading(path: Path, kind: type[TrilatError] = LogError) -> Iterator[BinaryIO]:
    """Context manager that opens a file for reading, and raises errors of a given class.

    Errors of the operating system are converted to errors of this class, whose messages users
    can act on. Pipes and devices are rejected, because reading them might never end.

    Args:
        path: The file.
        kind: Class of the error to raise.

    Yields:
        The open file, in binary mode.

    Raises:
        TrilatError: The file cannot be read. The error is of the class `kind`.
    """
    try:
        with open_regular(path) as stream:
            yield stream
    except OSError as error:
        raise kind(f"{path} cannot be read: {error.strerror}") from None


def digest_file(path: Path) -> str:
    """Returns the SHA-256 hash of a file's contents in hexadecimal.

    Args:
        path: The file, which may be large because it is read in chunks.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_foreign_permissions(path: Path) -> int:
    """Returns the permission bits that a file grants to its group and to all other users.

    A file that contains a secret should grant none. Returns 0 on Windows, which uses access
    control lists instead.

    Args:
        path: The file.
    """
    return 0 if os.name == "nt" else path.stat().st_mode & 0o077


def make_folder(folder: Path, *, may_be_link: bool = True) -> Path:
    """Creates a folder and any missing parent folders, and returns its path.

    An existing folder is left unchanged.

    Args:
        folder: Path of the folder.
        may_be_link: False to reject a symbolic link, for example for a folder inside an output
            folder.

    Raises:
        UsageError: The path is a symbolic link that is not allowed, or the folder cannot be
            created.
        LogRefused: The disk is full.
    """
    if not may_be_link:
        refuse_link(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            raise describe_write_error(folder, error) from None
        raise UsageError(f"{folder} cannot be created: {error.strerror}") from None
    return folder


SYSTEM_FOLDERS = ("/dev", "/dev/fd", "/proc/self/fd")
"""Folders in which the system itself creates symbolic links, for example /dev/stdout."""


def refuse_link(path: Path) -> None:
    """Raises UsageError if an output path is a symbolic link.

    Another user could have created the link so that the output replaces a file elsewhere.

    Args:
        path: The output path.

    Raises:
        UsageError: The path is a symbolic link outside of `SYSTEM_FOLDERS`.
    """
    is_of_system = path.parent.as_posix() in SYSTEM_FOLDERS
    if path.is_symlink() and not is_of_system:
        problem = "is a symbolic link, and no output is written through a link"
        advice = "remove the link, or choose another name"
        raise UsageError(f"{path} {problem}; {advice}")


def make_results_folder(folder: Path | None, name: str, *, force: bool | None) -> Path:
    """Creates a folder for the results of a command, or uses an existing folder.

    An existing folder must be empty unless the user permits other files in it.

    Args:
        folder: The folder. If None, the next free folder `runs/NAME-N` is used.
        name: NAME in this path.
        force: True if the folder may contain files. If False, files in the folder cause an
            error that suggests the option --force. None is for commands without this option:
            files cause an error without the suggestion.

    Returns:
        Path of the folder.

    Raises:
        UsageError: The folder contains files that are not permitted, or cannot be created.
    """
    if folder is None:
        return _make_next_folder(name)
    must_be_empty = not force
    try:
        is_refused = must_be_empty and folder.exists() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder} cannot be created or read: {error.strerror}") from None
    if is_refused:
        advice = "" if force is None else ", or use --force"
        raise UsageError(f"{folder} is not empty; choose another folder{advice}")
    return make_folder(folder)


def _make_next_folder(name: str) -> Path:
    """Creates the next free folder `runs/NAME-N`, and returns its path.

    No two processes get the same folder, because creating an existing folder fails.
    """
    for n in itertools.count(1):
        folder = Path("runs") / f"{name}-{n:03d}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue  # an earlier result has this number
        except OSError as error:
            raise describe_write_error(folder, error) from None
        return folder
    raise AssertionError("unreachable, because the loop tries numbers until it returns")


def refuse_existing(
    path: Path, *, force: bool, unfinished: Path | None = None, manifest: str | None = None
) -> None:
    """Raises UsageError if an output would overwrite something.

    An empty folder is accepted as the path of an output folder. With `force`, an earlier output
    of the same kind is also accepted, but no other file or folder.

    Args:
        path: Path of the output, which is a file or a folder.
        force: True if an earlier output of the same kind may be replaced.
        unfinished: Path of the output while it is being written, which must also be free. None
            if the output has no such path.
        manifest: Name of a file contained in every output folder of this kind, which identifies
            an earlier output. None if the output is a file.

    Raises:
        UsageError: Something exists at the path, or the path is a symbolic link.
    """
    refuse_link(path)
    is_empty_folder = manifest and path.is_dir() and not any(path.iterdir())
    is_taken = os.path.lexists(path) and not is_empty_folder
    if is_taken:
        is_same_kind = (path / manifest).is_file() if manifest else path.is_file()
        if not is_same_kind:
            kind = "an exported folder" if manifest else "a file"
            problem = f"already exists and is not {kind}"
            raise UsageError(f"{path} {problem}; choose another name")
        if not force:
            advice = "choose another name, or replace it with --force"
            raise UsageError(f"{path} already exists; {advice}")

    if unfinished is not None and unfinished.exists() and not force:
        raise UsageError(
            f"{unfinished} already exists: this file is still being written, or was never "
            f"finished. Recover it with: trilat log recover {unfinished}; choose another name; "
            "or replace it with --force"
        )


def publish_file(unfinished: Path, path: Path, *, force: bool) -> None:
    """Renames a completely written file to its final name.

    Readers never see an incomplete file under that name.

    Args:
        unfinished: Path of the complete file, in the same folder.
        path: The final path.
        force: True to replace an existing file.

    Raises:
        UsageError: Another program has created a file at the path in the meantime.
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
            f"{path} was created by another program in the meantime; the finished file is "
            f"{unfinished}: rename that file"
        ) from None
    except OSError:  # the file system does not support links
        refuse_existing(path, force=False)
        unfinished.rename(path)


def write_whole(
    path: Path,
    data: bytes | str | Iterable[str],
    *,
    force: bool = True,
    remedy: str = "",
    mode: int = 0o666,
) -> None:
    """Writes a file atomically, so that readers never see an incomplete file.

    The data is written to a temporary file in the same folder, which then replaces the file.
    Devices and pipes are written directly. A symbolic link is rejected, and a link created
    after this check is replaced without touching its target.

    Args:
        path: The file.
        data: The contents. Text is encoded as UTF-8. An iterable yields the parts of a text
            that may not fit in memory.
        force: True if an existing file may be replaced.
        remedy: Advice added to the error message if the disk is full.
        mode: Permissions of a new file, before the umask.

    Raises:
        UsageError: The file exists, is a symbolic link, or cannot be created.
        LogRefused: The data could not be written, for example because the disk is full.
    """
    parts = [data] if isinstance(data, bytes | str) else data
    refuse_link(path)
    if not force:
        refuse_existing(path, force=False)
    try:
        is_device_or_pipe = path.exists() and not path.is_file()
        if is_device_or_pipe:
            with path.open("wb") as stream:
                _write_parts(stream, parts)
            return

        unfinished = path.with_name(f"{path.name}.unfinished")
        try:
            # A file of an earlier attempt may have other permissions.
            unfinished.unlink(missing_ok=True)
            with open(unfinished, "xb", opener=partial(os.open, mode=mode)) as stream:
                _write_parts(stream, parts)
                stream.flush()
                os.fsync(stream.fileno())
            publish_file(unfinished, path, force=force)
        except OSError:
            unfinished.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise describe_write_error(path, error, remedy) from None


def _write_parts(stream: BinaryIO, parts: Iterable[bytes | str]) -> None:
    """Writes the parts of a file in sequence, encoding text as UTF-8."""
    for part in parts:
        stream.write(part.encode() if isinstance(part, str) else part)


@contextmanager
def stage_output(path: Path, *, force: bool, manifest: str | None = None) -> Iterator[Path]:
    """Context manager that lets the caller write an output at a temporary path.

    If the block succeeds, the output is renamed to its final name. If the block raises an
    exception, the unfinished output is deleted, and an earlier output is kept.

    Args:
        path: The output, which is a file or a folder.
        force: True if an earlier output of the same kind may be replaced.
        manifest: Name of a file that identifies an earlier output folder (see
            `refuse_existing`). If given, the temporary path is a folder. None if the output is
            a file.

    Yields:
        The temporary path.

    Raises:
        UsageError: The path is already in use, or is not writable.
        LogRefused: The data could not be written, for example because the disk is full.
    """
    refuse_existing(path, force=force, manifest=manifest)
    remedy = "no partial file was left. Free some space, or use another disk"
    try:
        # The temporary folder is in the same folder, because a rename works only within a file
        # system.
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise describe_write_error(path, error, remedy) from None

    try:
        staged = scratch / path.name
        if manifest:
            staged.mkdir()
        yield staged

        if manifest and path.is_dir():
            # A folder cannot replace a folder: the earlier output is moved into the temporary
            # folder, and deleted with it.
            path.rename(scratch / "before")
        staged.replace(path)
    except OSError as error:
        raise describe_write_error(path, error, remedy) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def describe_write_error(
    path: Path, error: OSError, remedy: str = ""
) -> LogRefused | UsageError:
    """Returns an error with a remedy for a system error that occurred while writing a file.

    A full disk and a wrong path require different remedies, so they are reported by different
    error classes. The caller raises the result.

    Args:
        path: The file.
        error: The system error.
        remedy: Advice that is added if the disk rejected the data.

    Returns:
        LogRefused if the disk rejected the data, for example because it is full. Otherwise
        UsageError.
    """
    text = f"{path} cannot be written: {error.strerror or error}"
    if error.errno == errno.ENOENT and not path.parent.is_dir():
        text += f"; the folder {path.parent} does not exist"
    if error.errno in DISK_ERRNOS:
        return LogRefused(f"{text}; {remedy}" if remedy else text)
    return UsageError(text)

"""Writes output files safely, checks input files, and imports optional packages.

Commands write their results with these helpers, so that a crash or a mistyped path does not
destroy earlier results.

Invariant:
    - An existing output is replaced only if the caller allows it with `force`.
    - A file or folder gets its final name only when it is complete. A program that dies while
      it writes therefore leaves no output that looks complete.
    - An output is never written through a symbolic link, not even inside an output folder.
      Otherwise, the author of the link could choose which file is overwritten.
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
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

from .errors import LogError, LogRefused, TrilatError, UsageError
from .package_names import PACKAGE_COMMANDS

DISK_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
"""Numbers of the system errors of a disk that accepts no more data, for example a full disk."""
STUDY_LIBRARIES = ("loky", "matplotlib", "scipy")
"""Libraries that `trilat-net` installs and `trilat-net-core` does not (pyproject.toml)."""

EXTRAS = {
    "dask": "cluster",
    "distributed": "cluster",
    "gymnasium": "gym",
    "mujoco": "sim",
    "pandas": "frames",
    "polars": "frames",
    "pyarrow": "lerobot",
    "rerun": "view",
    "statsmodels": "stats",
}
"""For each optional library, the extra of trilat-net that installs it (pyproject.toml)."""


def require_libraries(*names: str) -> None:
    """Checks, before a long command starts, that all libraries it needs are installed.

    Otherwise the command would fail only at its end, for example when it draws a figure.

    Args:
        names: Names of the libraries. By default all of `STUDY_LIBRARIES`.

    Raises:
        UsageError: A library is not installed. The message has the command that installs it.
    """
    required = names or STUDY_LIBRARIES
    missing = [name for name in required if find_spec(name) is None]
    if missing:
        libraries = ", ".join(missing)
        raise UsageError(
            f"this command needs {libraries}, which trilat-net-core does not include: "
            "pip install trilat-net"
        )


def describe_missing_library(function: str, error: ModuleNotFoundError) -> str:
    """Returns the error message for a function whose library is not installed.

    Args:
        function: Name of the function.
        error: Error of the import. It names the missing module.

    Returns:
        The message, with the command that installs the library.

    Raises:
        ModuleNotFoundError: The missing module belongs to this program, which is a bug.
    """
    package = (error.name or "").partition(".")[0]
    if package in ("", "recorder", "sites", "trilat_net"):
        raise error
    distribution = package.replace("_", "-")
    if distribution in PACKAGE_COMMANDS:
        remedy = f"a separate package: pip install {distribution}"
    elif package in STUDY_LIBRARIES:
        remedy = "which trilat-net-core does not include: pip install trilat-net"
    elif package in EXTRAS:
        remedy = f"which is not installed: {format_extra_install(EXTRAS[package])}"
    else:
        # A library that every installation of this program has, or that another library needs.
        remedy = f"which is not installed: pip install {package}"
    return f"{function} needs {package}, {remedy}"


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Imports a module of an optional package, which may not be installed.

    Without the package, the user gets an error with the command that installs it, in place of a
    traceback.

    Args:
        module: Name of the module.
        extra: Name of the extra of trilat-net that installs the package, as in
            `trilat-net[extra]`.
        purpose: The features that need the package, in the plural, for the error.

    Returns:
        The module.

    Raises:
        UsageError: The package is not installed. The message has the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        # The package may be installed, but not a library that it needs itself.
        missing = (error.name or package).partition(".")[0]
        need = package if missing == package else f"{package}, which needs {missing}"
        raise UsageError(f"{purpose} need {need}: {format_extra_install(extra)}") from None


def format_extra_install(extra: str) -> str:
    """Returns the shell command that installs an extra in the environment of this program.

    - In the `.venv` of a clone of the repository, the command is a target of the clone's
      Makefile, which installs locked versions.
    - In another environment that uses a clone, the command is pip with the path of the clone.
    - Anywhere else, the command is pip with the name of the distribution.

    Args:
        extra: Name of the extra, a group of optional packages, as in `trilat-net[extra]`.
    """
    clone = Path(__file__).resolve().parents[1]
    is_clone = all((clone / name).is_file() for name in ("Makefile", "pyproject.toml"))
    if not is_clone:
        return f"pip install 'trilat-net[{extra}]'"

    is_environment_of_clone = Path(sys.prefix).resolve() == clone / ".venv"
    if not is_environment_of_clone:
        return shlex.join([sys.executable, "-m", "pip", "install", "-e", f"{clone}[{extra}]"])

    change_folder = [] if Path.cwd() == clone else ["-C", str(clone)]
    return shlex.join(["make", *change_folder, "extras", f"EXTRAS={extra}"])


def find_version() -> str:
    """Returns the version of this program, or "unknown" if it is not installed.

    The program may be installed as the distribution trilat-net or trilat-net-core.
    """
    for name in ("trilat-net-core", "trilat-net"):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return "unknown"


def find_page(name: str) -> Path:
    """Returns the path of a documentation page on this machine.

    In a clone of the repository, the pages are in the folder docs. Otherwise, they are where
    the installation put them.

    Args:
        name: File name of the page, as in "json.md". No two pages have the same name.

    Returns:
        The path. If there is no such page, the path that it would have in the installation.
    """
    installed = Path(sys.prefix) / "share" / "doc" / "trilat-net"
    for folder in (Path(__file__).parents[1] / "docs", installed):
        for page in folder.rglob(name):
            return page
    return installed / name


def open_regular(path: Path, **options: Any) -> Any:
    """Opens a file for reading, and rejects folders, pipes and devices.

    Pipes and devices are rejected because reading them might never end.

    Args:
        path: The file.
        options: Further arguments of `open`. With `encoding`, the file is opened as text.

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
    """Opens a file for reading, as a context manager that converts errors.

    Errors of the operating system become errors that a user can act on. Pipes and devices are
    rejected, because reading them might never end.

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
    """Returns the SHA-256 hash of a file's content in hexadecimal, to detect changes.

    Args:
        path: The file. It may be large, because it is read in parts.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_foreign_permissions(path: Path) -> int:
    """Returns the permission bits that a file grants to its group and to all other users.

    A file with a secret should grant no such permissions. The result is 0 on Windows, which has
    access control lists instead.

    Args:
        path: The file.
    """
    return 0 if os.name == "nt" else path.stat().st_mode & 0o077


def make_folder(folder: Path, *, may_be_link: bool = True) -> Path:
    """Creates a folder, with all parent folders that do not exist yet, and returns its path.

    A folder that exists is left as it is.

    Args:
        folder: Path of the folder.
        may_be_link: False to reject a symbolic link, as for a folder inside an output folder.

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
"""Folders in which the system itself makes symbolic links, for example /dev/stdout."""


def refuse_link(path: Path) -> None:
    """Checks that an output path is not a symbolic link.

    Another user could have created the link. The output would then replace a file elsewhere.

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

    An existing folder must be empty, unless the user permits other files in it.

    Args:
        folder: The folder. If None, the next free folder `runs/NAME-N` is used.
        name: The text for NAME in this path.
        force: True if the folder may contain files. If False, files are an error, which
            suggests the option --force. If None, files are also an error; use it for a command
            without this option.

    Returns:
        The folder.

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

    No other process gets the same folder, because creating an existing folder fails.
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
    """Checks that an output path is free, so that no earlier output is overwritten.

    An empty folder is accepted as the path of an output folder. With `force`, an earlier output
    of the same kind is accepted too, but never another kind of file or folder.

    Args:
        path: Path of the output, which is a file or a folder.
        force: True if an earlier output of the same kind may be replaced.
        unfinished: Path of the output while it is being written. It must be free as well. None
            if the output has no such path.
        manifest: Name of a file that every output folder of this kind contains, so that it is
            recognised as an earlier output. None if the output is a file.

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

    Readers therefore never see an incomplete file under that name.

    Args:
        unfinished: Path of the complete file, in the same folder.
        path: The final path.
        force: True to replace an existing file.

    Raises:
        UsageError: Another program has meanwhile created a file at the path.
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
    """Writes a file in one step, so that readers never see an incomplete file.

    The data is written to a temporary file in the same folder, which then replaces the file. A
    device or a pipe is written directly. A symbolic link is rejected. If a link appears later,
    the link is replaced, and its target is not changed.

    Args:
        path: The file.
        data: Its content. Text is encoded as UTF-8. An iterable yields the parts of a text that
            may be too large for the memory.
        force: True if an existing file may be replaced.
        remedy: Advice that the error contains if the disk is full.
        mode: Permissions of a new file, before the umask.

    Raises:
        UsageError: The file exists, is a symbolic link, or cannot be created.
        LogRefused: The disk refused the data.
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
    """Writes the parts of a file one after the other, and encodes text as UTF-8."""
    for part in parts:
        stream.write(part.encode() if isinstance(part, str) else part)


@contextmanager
def stage_output(path: Path, *, force: bool, manifest: str | None = None) -> Iterator[Path]:
    """Lets the caller write an output at a temporary path, as a context manager.

    If the block succeeds, the output gets its final name. If the block raises an exception, the
    unfinished output is deleted, and an earlier output stays.

    Args:
        path: The output, which is a file or a folder.
        force: True if an earlier output of the same kind may be replaced.
        manifest: Name of a file that marks an earlier output folder, see `refuse_existing`. If
            it is set, the temporary path is a folder. None if the output is a file.

    Yields:
        The temporary path.

    Raises:
        UsageError: The name is taken, or the path is not writable.
        LogRefused: The disk refused the data.
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
    """Converts a system error from writing a file into an error that tells users what to do.

    A full disk needs a different remedy from a wrong path. Therefore the two cases have
    different errors. The caller raises the result.

    Args:
        path: The file.
        error: The error of the system.
        remedy: Advice that is added if the disk refused the data.

    Returns:
        LogRefused if the disk refused the data, for example because it is full. Otherwise
        UsageError.
    """
    text = f"{path} cannot be written: {error.strerror or error}"
    if error.errno == errno.ENOENT and not path.parent.is_dir():
        text += f"; the folder {path.parent} does not exist"
    if error.errno in DISK_ERRNOS:
        return LogRefused(f"{text}; {remedy}" if remedy else text)
    return UsageError(text)

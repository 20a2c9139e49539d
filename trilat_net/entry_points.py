"""Finds the commands, functions and viewers that other installed packages add to this program.

For example, a package can add `trilat log lag` by listing the command in its pyproject.toml as
an entry point, which names an object (docs/develop/packages.md). The names are read without
importing the package, and the object is imported on first use. Optional packages of this
program, such as trilat-studies, add their commands in the same way.

Invariant:
    - A name defined by this program itself is never overridden.
    - A name that belongs to one of this program's own packages is never loaded from another
      package.
"""

from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from .errors import UsageError
from .package_names import PACKAGE_COMMANDS, PACKAGE_FUNCTIONS, PACKAGE_HOOKS

COMMANDS = "trilat_net.commands"
"""Entry point group of commands. Each name is a command with hyphens in place of spaces."""
FUNCTIONS = "trilat_net.api"
"""Entry point group of functions and classes of the Python interface."""
VIEWS = "trilat_net.views"
"""Entry point group of the viewers in which `trilat log view --in` can open a log."""
HOOKS = "trilat_net.hooks"
"""Entry point group of the functions that `hooks` looks up in the optional packages of this
program.
"""

_PACKAGE_OF = {
    COMMANDS: {name: package for package, names in PACKAGE_COMMANDS.items() for name in names},
    FUNCTIONS: {
        name: package for package, names in PACKAGE_FUNCTIONS.items() for name in names.split()
    },
    VIEWS: {},
    HOOKS: {
        name: package for package, names in PACKAGE_HOOKS.items() for name in names.split()
    },
}


@cache
def find_entries(group: str) -> dict[str, EntryPoint]:
    """Returns the commands, functions or viewers added by installed packages, keyed by name.

    The packages are not imported. A name that belongs to an optional package of this program,
    such as trilat-studies, is accepted only from that package.

    Args:
        group: `COMMANDS`, `FUNCTIONS`, `VIEWS` or `HOOKS`.
    """
    entries: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        owner = find_package(group, entry.name)
        package = entry.module.partition(".")[0]
        is_permitted = not owner or package == owner.replace("-", "_")
        if is_permitted:
            entries.setdefault(entry.name, entry)
    return entries


def find_package(group: str, name: str) -> str:
    """Returns the optional package, such as trilat-studies, that defines a given name.

    Error messages tell the user to install this package. Returns "" if no optional package
    defines the name.

    Args:
        group: `COMMANDS`, `FUNCTIONS`, `VIEWS` or `HOOKS`.
        name: Name of the entry point.
    """
    return _PACKAGE_OF[group].get(name, "")


def load_entry(group: str, name: str, use: str) -> Any:
    """Imports a command, function or viewer added by another installed package.

    Packages declare such additions as entry points in their metadata.

    Args:
        group: `COMMANDS`, `FUNCTIONS`, `VIEWS` or `HOOKS`.
        name: Name of the entry point.
        use: How a user calls the object, for example "trilat sweep", for the error message.

    Returns:
        The object, or None if there is no entry point of that name.

    Raises:
        UsageError: The optional package that defines the name is not installed, or a
            third-party package cannot be imported.
    """
    entry = find_entries(group).get(name)
    package = find_package(group, name)
    if entry is None:
        if package:
            raise UsageError(f"{use} is in a separate package: pip install {package}")
        return None
    if package:
        return entry.load()  # an error in a package of this program is a bug: do not hide it
    try:
        return entry.load()
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise UsageError(
            f"{use} cannot be used, because {entry.value} cannot be imported: {reason}"
        ) from error


def find_viewer(name: str) -> Callable[[Sequence[Path]], None]:
    """Returns the function by which another package displays logs (group `VIEWS`).

    The function takes the paths of the log files, and returns once the log is displayed.

    Args:
        name: Name of the viewer.

    Raises:
        UsageError: No installed package provides a viewer of that name, or the viewer cannot be
            imported.
    """
    show_logs: Callable[[Sequence[Path]], None] | None = load_entry(
        VIEWS, name, f"the viewer {name}"
    )
    if show_logs is None:
        names = ", ".join(sorted(find_entries(VIEWS))) or "none"
        raise UsageError(f"there is no viewer {name!r}; installed packages have: {names}")
    return show_logs

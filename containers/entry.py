"""Entry program of a container: prepares cache and results folder, then becomes the command.

Usage: entry.py [--results FOLDER --heir FILE] COMMAND...

- The image's cache of compiled code is copied to a writable folder, because Numba uses no read-only one. On
  another processor than the one that built it, Numba ignores it and compiles.
- FOLDER is on the host. The engine creates a missing mounted folder as root. So, as root, this program gives
  FOLDER to the owner of FILE, a file of the user who starts the containers, and becomes that user, or
  `SERVANT` if that is root. Started as any other user, it remains that user.

Invariant: the command never runs as root of the host, and only files that root owns change their owner.
"""

import argparse
import os
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, NoReturn

SERVANT = 10001
"""The user of the image: unused on most hosts."""
_CACHE = Path("/opt/trilat/cache")
_NO_NAMESPACE = ["0", "0", "4294967295"]


class Owner(NamedTuple):
    """A user and a group, by number."""

    user: int
    group: int

    def __str__(self) -> str:
        return f"{self.user}:{self.group}"


def heir(mark: Path, user_map: Path = Path("/proc/self/uid_map")) -> Owner:
    """Returns the owner of the results.

    Args:
        mark: a file of the user who starts the containers.
        user_map: this process's map of users. Under a rootless engine, root is that user.

    Raises:
        OSError: the mark does not exist.
    """
    facts = mark.stat()
    if facts.st_uid == 0 and user_map.read_text(encoding="ascii").split() == _NO_NAMESPACE:
        return Owner(SERVANT, SERVANT)
    return Owner(facts.st_uid, facts.st_gid)


def give(folder: Path, owner: Owner) -> None:
    """Gives a folder, its content and its parent to their owner, as far as root owns them.

    The parent remains root's if the owner is `SERVANT`, who is no user of the host.

    Raises:
        OSError: a file cannot be made or given.
    """
    above = folder.parent
    if above.stat().st_uid == 0:
        folder.mkdir(exist_ok=True)
        if owner.user != SERVANT:
            os.chown(above, *owner)
    if folder.exists() and folder.stat().st_uid == 0:
        for path in (*folder.iterdir(), folder):
            if path.lstat().st_uid == 0:
                os.chown(path, *owner, follow_symlinks=False)


def become(owner: Owner) -> None:
    """Becomes a user for good; raises OSError if that is not permitted."""
    os.setgroups([])
    os.setgid(owner.group)
    os.setuid(owner.user)


def hand_over(results: Path, mark: Path) -> None:
    """Makes a folder writable for this process, as the user that it becomes.

    Raises:
        SystemExit: that is impossible; the message names the user and the folder.
    """
    owner = Owner(os.getuid(), os.getgid())
    try:
        if owner.user == 0:
            owner = heir(mark)
            give(results, owner)
            become(owner)
        results.mkdir(exist_ok=True)
        if not os.access(results, os.W_OK | os.X_OK):
            raise PermissionError(0, "it belongs to another user")
    except OSError as error:
        sys.stderr.write(
            f"error: user {owner} cannot write into {results}: {error.strerror}; on the host, "
            f"give it to that user, as in: mkdir -p {results}; sudo chown -R {owner} {results}\n"
        )
        sys.exit(2)


def warm(cache: Path, own: Path) -> None:
    """Copies a cache into a writable folder, as far as there is room."""
    with suppress(OSError):  # shutil.Error is one: without a cache the program compiles
        shutil.copytree(cache, own, dirs_exist_ok=True)


def main(arguments: Sequence[str]) -> NoReturn:
    """Prepares, and becomes the command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--results", type=Path)
    parser.add_argument("--heir", type=Path)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args(arguments)
    if options.results is not None:
        hand_over(options.results, options.heir)
    warm(_CACHE, Path(os.environ["XDG_CACHE_HOME"]))
    os.execvp(options.command[0], options.command)


if __name__ == "__main__":
    main(sys.argv[1:])

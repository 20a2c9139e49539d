"""The first program of a container: makes ready what a read-only container lacks, and becomes the command.

Usage: entry.py [--results FOLDER --heir FILE] COMMAND...

- The cache of compiled code that the image holds is copied to where the program may write: Numba uses no
  other. On another processor than the one that made it, it is passed over, and the program compiles.
- FOLDER is on the host. The engine makes a folder that is mounted but does not exist, and root owns it. So,
  as root, this gives FOLDER to the owner of FILE, a file of the person who starts the containers, and
  becomes that user; where that is root, `SERVANT`. Started as anybody else, it stays what it is.

Law: the command never runs as root of the host, and nobody is deprived: only what is root's is given away.
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
"""The user of the image: nobody's number on a usual host."""
_CACHE = Path("/opt/trilat/cache")
_NO_NAMESPACE = ["0", "0", "4294967295"]


class Owner(NamedTuple):
    """A user and a group, by number."""

    user: int
    group: int

    def __str__(self) -> str:
        return f"{self.user}:{self.group}"


def heir(mark: Path, user_map: Path = Path("/proc/self/uid_map")) -> Owner:
    """Returns who shall own the results.

    Args:
        mark: a file of the person who starts the containers.
        user_map: the map of users of this process. Where an engine is rootless, root is that very person.

    Raises:
        OSError: the mark is not there.
    """
    facts = mark.stat()
    if facts.st_uid == 0 and user_map.read_text(encoding="ascii").split() == _NO_NAMESPACE:
        return Owner(SERVANT, SERVANT)
    return Owner(facts.st_uid, facts.st_gid)


def give(folder: Path, owner: Owner) -> None:
    """Gives a folder, what lies in it and the folder above to their owner, as far as they are root's.

    The folder above stays root's where the owner is no person of the host.

    Raises:
        OSError: something cannot be made or given.
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
    """Becomes a user for good.

    Raises:
        OSError: it is not permitted.
    """
    os.setgroups([])
    os.setgid(owner.group)
    os.setuid(owner.user)


def hand_over(results: Path, mark: Path) -> None:
    """Sees to it that this process, as whoever it is from now on, may write into a folder.

    Raises:
        SystemExit: it may not; the sentence says who needs which folder.
    """
    owner = Owner(os.getuid(), os.getgid())
    try:
        if owner.user == 0:
            owner = heir(mark)
            give(results, owner)
            become(owner)
        results.mkdir(exist_ok=True)
        if not os.access(results, os.W_OK | os.X_OK):
            raise PermissionError(0, "it belongs to somebody else")
    except OSError as error:
        sys.stderr.write(
            f"error: user {owner} cannot write into {results}: {error.strerror}; on the host, "
            f"give it to that user, as in: mkdir -p {results}; sudo chown -R {owner} {results}\n"
        )
        sys.exit(2)


def warm(cache: Path, own: Path) -> None:
    """Copies a cache to where this process may write; as much of it as there is room for."""
    with suppress(OSError):  # shutil.Error is one: without a cache the program compiles
        shutil.copytree(cache, own, dirs_exist_ok=True)


def main(arguments: Sequence[str]) -> NoReturn:
    """Makes ready, and becomes the command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--results", type=Path)
    parser.add_argument("--heir", type=Path)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    asked = parser.parse_args(arguments)
    if asked.results is not None:
        hand_over(asked.results, asked.heir)
    warm(_CACHE, Path(os.environ["XDG_CACHE_HOME"]))
    os.execvp(asked.command[0], asked.command)


if __name__ == "__main__":
    main(sys.argv[1:])

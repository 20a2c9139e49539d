"""Entry program of a container: prepares cache and results folder, then becomes the command.

Usage: entry.py [--results FOLDER --heir FILE --keys VOLUMES] [--await-keys FOLDER] COMMAND...

- The image's cache of compiled code is copied to a writable folder, because Numba uses no read-only one. On
  another processor than the one that built it, Numba ignores it and compiles.
- FOLDER is on the host. The engine creates a missing mounted folder as root. So, as root, this program gives
  FOLDER to the owner of FILE, a file of the user who starts the containers, and becomes that user, or
  `SERVANT` if that is root. Started as any other user, it remains that user.
- VOLUMES holds a volume for each member. Unless there are keys in all of them that hold, this program has
  them made by `COMMAND[0] keys new` and gives each member its own: the recorder's to the user that it
  becomes, the sites' to `SITES`. A site's container has its own volume alone, and this program waits for the
  keys in it (FOLDER). The authority's key is never written to a disk.

Invariant: the command never runs as root of the host, and only files that root owns change their owner.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, NoReturn

SERVANT = 10001
"""The user of the image: unused on most hosts."""
SITES = 10002
"""The user of sites, who can read no keys but those of sites."""
RECORDER, MARK = "recorder", "members.json"
"""The member that makes the keys; the file of a member's keys that is written last."""
_FRESH_S = 25 * 86_400.0
"""Keys older than this are made anew: they hold for 30 days."""
_AWAIT_S = 60.0
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


def are_fresh(keys: Path) -> bool:
    """True if there are keys of a member that will hold for days."""
    try:
        return time.time() - (keys / MARK).stat().st_mtime < _FRESH_S
    except OSError:
        return False


def take(folder: Path) -> None:
    """Makes a folder and all in it this user's, from the top down: without it root could not look into it."""
    if os.getuid() == 0:
        os.chown(folder, 0, 0)
        for path in folder.iterdir():
            take(path) if path.is_dir() else os.chown(path, 0, 0)


def hand_out_keys(volumes: Path, program: str, owner: Owner, scratch: Path) -> None:
    """Makes keys for all members that have a volume, unless they have some that hold.

    Args:
        volumes: the folder of the members' volumes, named after them.
        program: the command that makes keys; it runs as the owner.
        owner: the user that the recorder becomes.
        scratch: a folder in memory.

    Raises:
        OSError: something cannot be written or given.
        subprocess.CalledProcessError: the program failed.
    """
    members = sorted(path.name for path in volumes.iterdir())
    if all(are_fresh(volumes / name) for name in members):
        return
    is_root, made = os.getuid() == 0, scratch / "made"
    hosts = [word for name in members for word in ("--host", name)]
    identity = {"user": owner.user, "group": owner.group, "extra_groups": []} if is_root else {}
    command = [program, "keys", "new", str(made), *members, *hosts]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, **identity)
    take(made)
    for name in members:
        files = sorted((made / name).iterdir(), key=lambda path: path.name == MARK)
        for file in files:
            target = volumes / name / file.name
            target.unlink(missing_ok=True)
            descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as sink:
                sink.write(file.read_bytes())
            if is_root:
                os.chown(target, *(owner if name == RECORDER else Owner(SITES, SITES)))
    shutil.rmtree(made)


def await_keys(keys: Path) -> None:
    """Waits until there are keys.

    Raises:
        SystemExit: there are none in time.
    """
    give_up_s = time.monotonic() + _AWAIT_S
    while not are_fresh(keys):
        if time.monotonic() > give_up_s:
            sys.stderr.write(
                f"error: no keys in {keys} after {_AWAIT_S:g} s: does the recorder's container run?\n"
            )
            sys.exit(2)
        time.sleep(0.02)


def warm(cache: Path, own: Path) -> None:
    """Copies a cache into a writable folder, as far as there is room."""
    with suppress(OSError):  # shutil.Error is one: without a cache the program compiles
        shutil.copytree(cache, own, dirs_exist_ok=True)


def main(arguments: Sequence[str]) -> NoReturn:
    """Prepares, and becomes the command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--results", type=Path)
    parser.add_argument("--heir", type=Path)
    parser.add_argument("--keys", type=Path)
    parser.add_argument("--await-keys", type=Path)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args(arguments)
    if options.keys is not None:
        try:
            owner = heir(options.heir) if os.getuid() == 0 else Owner(os.getuid(), os.getgid())
            hand_out_keys(options.keys, options.command[0], owner, Path(os.environ["HOME"]))
        except (OSError, subprocess.CalledProcessError) as error:
            sys.stderr.write(f"error: no keys could be made in {options.keys}: {error}\n")
            sys.exit(2)
    if options.results is not None:
        hand_over(options.results, options.heir)
    warm(_CACHE, Path(os.environ["XDG_CACHE_HOME"]))
    if options.await_keys is not None:
        await_keys(options.await_keys)
    os.execvp(options.command[0], options.command)


if __name__ == "__main__":
    main(sys.argv[1:])

"""Entry program of a container: prepares the container, and then becomes the real command.

Usage: entry.py [--results FOLDER --heir FILE --keys VOLUMES] [--await-keys FOLDER] COMMAND...

The program does up to four things before it starts COMMAND:

- It copies the image's cache of compiled code to a writable folder, because Numba does not use
  a read-only cache. On a processor of another type than that on which the image was built,
  Numba ignores the cache and compiles again.
- `--results`: FOLDER is a folder of the host, which the container engine creates as root if it
  is missing. If this program runs as root, it gives FOLDER to the owner of FILE, and continues
  as that user. FILE belongs to the user who starts the containers. If that user is root, the
  user of the image (`SERVANT`) takes its place. If the program does not run as root, it remains
  the same user.
- `--keys`: VOLUMES contains a volume (folder) for each member of the session. Unless all of
  them contain keys that remain valid for days, the program creates keys with
  `COMMAND[0] keys new`, and gives each member its own: the recorder's keys to the user that
  this program becomes, and the keys of sites to the user `SITES`. The key of the certificate
  authority is never written to a disk.
- `--await-keys`: the container of a site can read only its own volume, FOLDER, and waits until
  the keys are there.

Invariant:
    - The command never runs as root of the host.
    - Only files that belong to root get another owner.
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
from typing import Any, NamedTuple, NoReturn

SERVANT = 10001
"""Number of the image's user, which is not in use on most hosts."""
SITES = 10002
"""Number of the user of sites, who can read only keys of sites."""
RECORDER = "recorder"
"""The member whose container creates the keys."""
MARK = "members.json"
"""The file of a member's keys that is written last, so that its presence means completeness."""
_FRESH_S = 25 * 86_400.0
"""Age in s up to which keys are used again. They are valid for 30 days."""
_AWAIT_S = 60.0
"""Longest wait for keys, in s."""
_CACHE = Path("/opt/trilat/cache")
"""Cache of compiled code in the image."""
_NO_NAMESPACE = ["0", "0", "4294967295"]
"""Map of users of a process whose users are those of the host: all numbers stay the same."""


class Owner(NamedTuple):
    """A user and a group, by number.

    Attributes:
        user: Number of the user.
        group: Number of the group.
    """

    user: int
    group: int

    def __str__(self) -> str:
        return f"{self.user}:{self.group}"


def find_results_owner(mark: Path, user_map: Path = Path("/proc/self/uid_map")) -> Owner:
    """Returns the user and group to whom the results shall belong.

    Args:
        mark: A file of the user who starts the containers.
        user_map: File of the system with the map of users of this process. Under a rootless
            container engine, root of the container is an ordinary user of the host.

    Returns:
        The owner of the mark. If that is root of the host, the user of the image.

    Raises:
        OSError: The mark does not exist.
    """
    status = mark.stat()
    is_root_of_host = (
        status.st_uid == 0 and user_map.read_text(encoding="ascii").split() == _NO_NAMESPACE
    )
    if is_root_of_host:
        return Owner(SERVANT, SERVANT)
    return Owner(status.st_uid, status.st_gid)


def give_folder(folder: Path, owner: Owner) -> None:
    """Gives a folder, its files and its parent folder to an owner.

    Only what belongs to root changes its owner. The parent remains root's if the owner is
    `SERVANT`, who is not a user of the host.

    Args:
        folder: The folder. It is created if its parent belongs to root.
        owner: The new owner.

    Raises:
        OSError: A file cannot be created, or its owner cannot be changed.
    """
    parent = folder.parent
    if parent.stat().st_uid == 0:
        folder.mkdir(exist_ok=True)
        if owner.user != SERVANT:
            os.chown(parent, *owner)
    if folder.exists() and folder.stat().st_uid == 0:
        for path in (*folder.iterdir(), folder):
            if path.lstat().st_uid == 0:
                os.chown(path, *owner, follow_symlinks=False)


def become_user(owner: Owner) -> None:
    """Makes this process run as another user from now on, without a way back to root.

    Raises:
        OSError: The system does not permit it.
    """
    # The user comes last, because only root may change the groups.
    os.setgroups([])
    os.setgid(owner.group)
    os.setuid(owner.user)


def prepare_results(results: Path, mark: Path) -> None:
    """Makes the results folder writable, and continues as the user to whom it belongs.

    Args:
        results: The folder.
        mark: A file of the user who starts the containers.

    Raises:
        SystemExit: The folder is not writable. A message names the user, the folder and the
            remedy.
    """
    owner = Owner(os.getuid(), os.getgid())
    try:
        if owner.user == 0:
            owner = find_results_owner(mark)
            give_folder(results, owner)
            become_user(owner)
        results.mkdir(exist_ok=True)
        if not os.access(results, os.W_OK | os.X_OK):
            raise PermissionError(0, "it belongs to another user")
    except OSError as error:
        sys.stderr.write(
            f"error: user {owner} cannot write into {results}: {error.strerror}; on the host, "
            f"give it to that user, as in: mkdir -p {results}; "
            f"sudo chown -R {owner} {results}\n"
        )
        sys.exit(2)


def are_fresh(keys: Path) -> bool:
    """Returns True if a folder contains keys of a member that remain valid for days."""
    try:
        return time.time() - (keys / MARK).stat().st_mtime < _FRESH_S
    except OSError:
        return False


def take_folder(folder: Path) -> None:
    """Makes root the owner of a folder and of everything in it, if this process is root.

    The root of a container may lack the right to read files of other users. Therefore each
    folder changes its owner before its content is listed.
    """
    if os.getuid() != 0:
        return
    os.chown(folder, 0, 0)
    for path in folder.iterdir():
        if path.is_dir():
            take_folder(path)
        else:
            os.chown(path, 0, 0)


def distribute_keys(volumes: Path, program: str, owner: Owner, scratch: Path) -> None:
    """Creates keys for all members, unless all of them have keys that remain valid.

    Args:
        volumes: Folder of the members' volumes, which have the names of the members.
        program: The command that creates keys. It runs as the owner.
        owner: The user that the recorder becomes.
        scratch: A folder in memory, so that the keys of the authority reach no disk.

    Raises:
        OSError: A file cannot be written, or its owner cannot be changed.
        subprocess.CalledProcessError: The program failed.
    """
    members = sorted(path.name for path in volumes.iterdir())
    if all(are_fresh(volumes / name) for name in members):
        return

    is_root = os.getuid() == 0
    identity: dict[str, Any] = {}
    if is_root:
        identity = {"user": owner.user, "group": owner.group, "extra_groups": []}
    created = scratch / "made"
    # Each member listens at the host name of its container, which is the name of the member.
    hosts = []
    for name in members:
        hosts += ["--host", name]
    command = [program, "keys", "new", str(created), *members, *hosts]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, **identity)
    take_folder(created)

    for name in members:
        key_owner = owner if name == RECORDER else Owner(SITES, SITES)
        # The mark is copied last: a member that waits for it finds all of its keys.
        files = sorted((created / name).iterdir(), key=lambda path: path.name == MARK)
        for file in files:
            target = volumes / name / file.name
            target.unlink(missing_ok=True)
            descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(file.read_bytes())
            if is_root:
                os.chown(target, *key_owner)
    shutil.rmtree(created)


def await_keys(keys: Path) -> None:
    """Waits until a folder contains the keys of a member.

    Args:
        keys: The folder.

    Raises:
        SystemExit: The keys have not appeared in time.
    """
    deadline_s = time.monotonic() + _AWAIT_S
    while not are_fresh(keys):
        if time.monotonic() > deadline_s:
            sys.stderr.write(
                f"error: no keys in {keys} after {_AWAIT_S:g} s: does the recorder's "
                "container run?\n"
            )
            sys.exit(2)
        time.sleep(0.02)


def copy_cache(cache: Path, writable: Path) -> None:
    """Copies the cache of compiled code into a writable folder, as far as there is room.

    Without a complete cache, the program compiles the rest itself.

    Args:
        cache: The read-only cache of the image.
        writable: The folder, which may exist already.
    """
    with suppress(OSError):  # includes shutil.Error, which reports single files
        shutil.copytree(cache, writable, dirs_exist_ok=True)


def main(arguments: Sequence[str]) -> NoReturn:
    """Prepares the container, and replaces this program by the command.

    Args:
        arguments: Options and the command, as in the usage of this module.

    Raises:
        SystemExit: The container cannot be prepared. A message has the reason.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--results", type=Path)
    parser.add_argument("--heir", type=Path)
    parser.add_argument("--keys", type=Path)
    parser.add_argument("--await-keys", type=Path)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args(arguments)

    # The keys need root, so they are distributed before `prepare_results` gives it up.
    if options.keys is not None:
        try:
            owner = Owner(os.getuid(), os.getgid())
            if owner.user == 0:
                owner = find_results_owner(options.heir)
            scratch = Path(os.environ["HOME"])
            distribute_keys(options.keys, options.command[0], owner, scratch)
        except (OSError, subprocess.CalledProcessError) as error:
            sys.stderr.write(f"error: no keys could be made in {options.keys}: {error}\n")
            sys.exit(2)
    if options.results is not None:
        prepare_results(options.results, options.heir)
    copy_cache(_CACHE, Path(os.environ["XDG_CACHE_HOME"]))
    if options.await_keys is not None:
        await_keys(options.await_keys)
    os.execvp(options.command[0], options.command)


if __name__ == "__main__":
    main(sys.argv[1:])

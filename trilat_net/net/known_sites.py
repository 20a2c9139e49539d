"""Which sites run on this machine, and where they are reached: a small file for each, for `trilat stop`.

Invariant: a file is a hint. A site runs without it; one whose process is gone, or of another start of the
machine, counts for nothing and is removed. Only its user may read it, and no key is in it.
"""

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from .clock import SystemClock
from .zenoh_config import Endpoint, ZenohMode

if TYPE_CHECKING:
    from .connection import Connection


class KnownSite(NamedTuple):
    """A site that runs on this machine.

    Attributes:
        sites: all of its session.
        places: where it is reached, and the endpoints of others that it connects to.
        stop: the order to stop, ready to be sent, in hexadecimal digits.
        machine: identity of the machine's clock, another one after each start.
    """

    session: str
    site: str
    sites: list[str]
    mode: ZenohMode
    places: list[Endpoint]
    keyed: bool
    stop: str
    pid: int
    machine: str


def _find_folder() -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "trilat-net" / "running"


@contextmanager
def make_site_known(
    session: str, site: str, sites: Sequence[str], boot: int, connection: "Connection", stop: bytes
) -> Iterator[None]:
    """Keeps the file of a running site inside the block, where it can be written.

    One with settings of Zenoh of its user's own is left out: nobody else knows how to reach it.
    """
    places = connection.reach([*connection.listen, *(connection.connect or ())])
    about = KnownSite(
        *(session, site, list(sites), connection.mode, places, connection.keyed, stop.hex()),
        *(os.getpid(), SystemClock().identity()),
    )
    file: Path | None = None
    with suppress(OSError, RuntimeError):  # a user without a home
        if connection.keyed or not connection.own:
            folder = _find_folder()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with open(os.open(folder / f"{boot:016x}.json", _NEW, 0o600), "w", encoding="utf-8") as stream:
                file = folder / f"{boot:016x}.json"
                json.dump(about._asdict(), stream)
    try:
        yield
    finally:
        if file is not None:
            with suppress(OSError):
                file.unlink()


_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL


def find_known_sites(session: str) -> list[KnownSite]:
    """Returns the sites of a session that run on this machine, as far as their user can know."""
    found, machine = [], SystemClock().identity()
    with suppress(OSError, RuntimeError):
        for file in sorted(_find_folder().glob("*.json")):
            with suppress(OSError, ValueError, TypeError):  # half written, or no file of ours
                one = KnownSite(**json.loads(file.read_text(encoding="utf-8")))
                if one.machine != machine or not _is_alive(one.pid):
                    file.unlink()
                elif one.session == session:
                    found.append(one)
    return found


def _is_alive(pid: int) -> bool:
    if os.name != "posix":
        return True  # to ask would end it
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True

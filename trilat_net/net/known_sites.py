"""Remembers which arms run on this machine, so that `trilat stop` can reach them immediately.

While a site runs, it stores its network endpoints in a small file. `trilat stop` reads these
files and connects to the sites at once, instead of first searching the network for the session.

Invariant:
    - The files are only a shortcut. A site runs without its file, and a file whose process no
      longer exists is ignored.
    - A file can only be read by the user who runs the site.
    - If the arms cannot be stopped in this way, the command falls back to searching for the
      session.
"""

import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ..errors import UsageError
from . import topics
from .bus import Inbox
from .clock import SystemClock
from .zenoh_bus import ZenohBus
from .zenoh_config import Endpoint, ZenohMode, merge_settings

if TYPE_CHECKING:
    from .connection import Connection

_QUERY_PERIOD_NS = 50_000_000
"""Time between two queries to the sites that have not replied yet, in ns."""
_POLL_NS = 1_000_000
"""Time between two polls for replies, in ns."""
PATIENCE_NS = 1_500_000_000
"""Time after which the command falls back to searching for the session, in ns."""
_AT_ONCE = {"scouting": {"delay": 0}}
"""Zenoh settings that avoid a delay before the first message."""
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL
"""Flags for creating a file, which fail if the file already exists."""


class _KnownSite(msgspec.Struct, frozen=True):
    """Content of the file in which a running site stores how it can be reached.

    With this file, other programs on the same machine find the site without searching the
    network.

    Attributes:
        session: Name of the session.
        site: Name of the site.
        sites: Names of all sites of the session.
        mode: Mode of the site's network connection: "peer", "client" or "router", see
            `Connection`.
        keyed: True if the site encrypts its messages with keys.
        places: Endpoints at which the site can be reached, and those of the members that it
            connects to.
        stop: The encoded message that stops the arm.
        pid: Number of the site's process in the operating system.
        machine: Identity of the machine's clock. It changes when the machine is restarted.
    """

    session: str
    site: str
    sites: Sequence[str]
    mode: ZenohMode
    keyed: bool
    places: list[Endpoint]
    stop: bytes
    pid: int
    machine: str


def _find_folder() -> Path:
    """Returns the folder that contains one file for each site this user runs on this machine.

    Other commands use these files to find a running session. The folder is
    ~/.local/state/trilat-net/running, or the corresponding folder below XDG_STATE_HOME if that
    variable is set.
    """
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "trilat-net" / "running"


@contextmanager
def make_site_known(
    session: str,
    site: str,
    sites: Sequence[str],
    boot: int,
    connection: "Connection",
    stop: bytes,
) -> Iterator[None]:
    """Stores the endpoints of a site in a file, which lets `trilat stop` find the site.

    This is a context manager: the file exists while the site runs and is removed afterwards. If
    the file cannot be written, the site runs without it, and `trilat stop` searches the network
    instead.

    No file is written if the network connection is configured with a Zenoh file. Other
    processes need that Zenoh file to reach the site, so the endpoints alone would not help.

    Args:
        session: Name of the session.
        site: Name of the site.
        sites: Names of all sites of the session.
        boot: Random number that identifies this start of the site. It is part of the file name.
        connection: Network connection of the site.
        stop: The encoded message that `trilat stop` sends to stop the arm.
    """
    endpoints = [*connection.listen, *(connection.connect or ())]
    known = _KnownSite(
        session=session,
        site=site,
        sites=sites,
        mode=connection.mode,
        keyed=bool(connection.keys_of),
        places=connection.reach(endpoints),
        stop=stop,
        pid=os.getpid(),
        machine=SystemClock().identity(),
    )

    has_users_settings = bool(connection.settings) and not connection.keys_of
    with suppress(OSError, RuntimeError):  # RuntimeError: the user has no home folder
        if not has_users_settings:
            _find_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
            descriptor = os.open(_find_folder() / f"{boot:016x}.json", _NEW_FILE, 0o600)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(msgspec.json.encode(known))

    try:
        yield
    finally:
        with suppress(OSError, RuntimeError):
            (_find_folder() / f"{boot:016x}.json").unlink()


def find_known_sites(session: str) -> list[_KnownSite]:
    """Lists the sites of a session that run on this machine.

    The files of sites whose process no longer exists are deleted.

    Args:
        session: Name of the session.

    Returns:
        The content of each site's file. Empty if no site of the session runs here.
    """
    running = []
    machine = SystemClock().identity()
    with suppress(OSError, RuntimeError):
        for file in sorted(_find_folder().glob("*.json")):
            # A file that is half written, or of another program, is skipped.
            with suppress(OSError, msgspec.MsgspecError):
                known = msgspec.json.decode(file.read_bytes(), type=_KnownSite)
                if known.machine != machine or not _is_alive(known.pid):
                    file.unlink()
                elif known.session == session:
                    running.append(known)
    return running


def _is_alive(pid: int) -> bool:
    """Returns True if a process with this number exists.

    The file of a site whose process does not exist is left over from a crash. On non-POSIX
    systems, the process is assumed to exist, because the check could terminate it.
    """
    with suppress(PermissionError):
        try:
            if os.name == "posix":  # on other systems, `os.kill` would end the process
                os.kill(pid, 0)
        except ProcessLookupError:
            return False
    return True


def _list_endpoints(known_sites: Sequence[_KnownSite]) -> list[Endpoint]:
    """Returns the endpoints at which the given sites can be reached, without duplicates.

    Args:
        known_sites: The sites, as returned by `find_known_sites`.
    """
    endpoints: list[Endpoint] = []
    for known in known_sites:
        for endpoint in known.places:
            if endpoint not in endpoints:
                endpoints.append(endpoint)
    return endpoints


def find_known_endpoints(session: str, connection: "Connection") -> list[Endpoint] | None:
    """Returns the endpoints of a session whose sites all run on this machine.

    Every running site stores its endpoints in a file, so the network does not have to be
    searched.

    Args:
        session: Name of the session.
        connection: Network connection of this process. Sites whose connection has a different
            mode are ignored, as are sites with keys if this process has none, and sites without
            keys if this process has keys.

    Returns:
        The endpoints, or None unless all sites of the session are known.
    """
    has_keys = bool(connection.keys_of)
    known_sites = [
        known
        for known in find_known_sites(session)
        if known.mode == connection.mode and known.keyed == has_keys
    ]
    if not known_sites:
        return None

    known_names = {known.site for known in known_sites}
    all_names = set(known_sites[0].sites)
    is_complete = known_names == all_names
    return _list_endpoints(known_sites) if is_complete else None


def stop_at_once(arguments: Sequence[str]) -> int | list[str]:
    """Stops arms immediately, as requested by the command line of `trilat stop`.

    Only sites on this machine can be stopped in this way, because their endpoints are read from
    local files. No other part of the program is loaded first, which lets the arms stop without
    delay.

    Args:
        arguments: Command line after `trilat stop`.

    Returns:
        The exit code of the command if all arms have been stopped, if the keys are missing, or
        if the user interrupted the command. Otherwise, the arguments for the full command,
        which then continues, for example by searching the network for the remaining sites.
    """
    options, sites, is_simple = _parse_arguments(arguments)
    session = options["--session"]
    if not session or {"--end", "--help", "-h"}.intersection(sites):
        return list(arguments)
    arms = ", ".join(sites) if is_simple and sites else "every arm"
    _print(f"stopping {arms} of session {session} ...")
    try:
        known_sites = find_known_sites(session) if is_simple else []
        # One connection has one mode: sites with another mode are left to the search.
        known_sites = [known for known in known_sites if known.mode == known_sites[0].mode]
        if not known_sites:
            return list(arguments)
        if known_sites[0].keyed and not options["--keys"]:
            print(
                f"error: the members of {arms} of session {session} have keys: add --keys DIR",
                file=sys.stderr,
            )
            return UsageError.exit_code
        if _order_stop(known_sites, sites, options["--keys"]):
            return 0

        # The search continues at the endpoints of the known sites.
        option = "--router" if known_sites[0].mode == "client" else "--connect"
        remaining_arguments = list(arguments)
        for endpoint in _list_endpoints(known_sites):
            if isinstance(endpoint, str):  # other endpoints cannot be given as an option
                remaining_arguments += [option, endpoint]
        return remaining_arguments
    except KeyboardInterrupt:
        return 130
    except Exception:
        # An arm must be stopped: after any error, the command continues with the search for
        # the session, which reports the error if it fails as well.
        return list(arguments)


def _parse_arguments(arguments: Sequence[str]) -> tuple[dict[str, str], list[str], bool]:
    """Parses the command line after `trilat stop` without the full command-line library.

    Loading the library would take too long.

    Returns:
        The values of --session and --keys, which are empty if absent; all other arguments; and
        True if the other arguments contain no option.
    """
    options = {"--session": "", "--keys": ""}
    others: list[str] = []
    is_simple = True
    remaining_arguments = iter(arguments)
    for argument in remaining_arguments:
        name, equals, value = argument.partition("=")
        if name in options:
            options[name] = value if equals else next(remaining_arguments, "")
        else:
            is_simple = is_simple and not argument.startswith("-")
            others.append(argument)
    return options, others, is_simple


def _print(text: object) -> None:
    """Prints a message immediately, replacing characters that cannot be printed.

    Text from the network could otherwise send control sequences to the terminal.
    """
    letters = (letter if letter.isprintable() else "\ufffd" for letter in str(text))
    print("".join(letters), flush=True)


def _order_stop(known_sites: Sequence[_KnownSite], sites: Sequence[str], keys: str) -> bool:
    """Sends the stop command to sites until each has replied, and prints the replies.

    If two sessions with the same name are running on this machine, the sites of both are
    stopped. A query is complete when as many replies have arrived as there are sites with the
    queried name.

    Args:
        known_sites: The known sites of the session.
        sites: Names of the sites to stop. Empty for all sites.
        keys: Folder of the user's keys. Empty if there are none.

    Returns:
        True if all sites have confirmed that they stop.
    """
    settings: Any = _AT_ONCE
    if keys:
        from .member_keys import read_member_keys

        key_settings = read_member_keys(Path(keys), stops=True).settings
        settings = merge_settings(key_settings, _AT_ONCE)

    remaining = set(sites or known_sites[0].sites)
    starts_by_name = Counter(known.site for known in known_sites)
    session = known_sites[0].session
    order = known_sites[0].stop
    queries: list[tuple[str, Inbox, list[dict[str, Any]]]] = []
    all_stop = True
    clock = SystemClock()
    begun_ns = clock.monotonic_ns()
    next_query_ns = begun_ns
    endpoints = _list_endpoints(known_sites)
    with closing(ZenohBus([], endpoints, known_sites[0].mode, settings)) as bus:
        while remaining:
            now_ns = clock.monotonic_ns()
            if now_ns - begun_ns >= PATIENCE_NS:
                break
            # A query reaches only the members that are connected already. It is repeated for
            # those that connect later.
            if now_ns >= next_query_ns:
                next_query_ns = now_ns + _QUERY_PERIOD_NS
                for site in remaining:
                    key = topics.key(session, site, topics.STOP)
                    queries.append((site, bus.query(key, order), []))
            for site, inbox, replies in queries:
                while (message := inbox.poll()) is not None:
                    replies.append(msgspec.msgpack.decode(message[1]))
                if site in remaining and len(replies) >= max(starts_by_name[site], 1):
                    remaining.discard(site)
                    for reply in replies:
                        _print(reply["text"])
                        all_stop = all_stop and reply["accepted"]
            clock.sleep_until(clock.monotonic_ns() + _POLL_NS)
    return all_stop and not remaining

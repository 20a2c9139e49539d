"""Sites that run on this machine, by a small file for each; and `trilat stop`, which therefore
need not look.

Invariant: a file is a hint. A site runs without it, only its user may read it, and one whose
process is gone counts for nothing. What cannot be stopped at once is left to the command's long
way.
"""

import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import chain
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

ASK_NS = 50_000_000
POLL_NS = 1_000_000
PATIENCE_NS = 1_500_000_000
AT_ONCE = {"scouting": {"delay": 0}}
"""Settings of Zenoh: nothing is scouted, so that nothing is waited for."""
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL


class KnownSite(msgspec.Struct, frozen=True):
    """A site that runs on this machine.

    Attributes:
        sites: all of its session.
        places: where it and those that it connects to are reached.
        stop: the order, ready to be sent.
        machine: identity of the machine's clock, another one after each start.
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
    """Keeps a site's file inside the block, if others need no settings of Zenoh to reach it."""
    places = connection.reach([*connection.listen, *(connection.connect or ())])
    how = (connection.mode, bool(connection.keys_of))
    here = (os.getpid(), SystemClock().identity())
    known = KnownSite(session, site, sites, *how, places, stop, *here)
    with suppress(OSError, RuntimeError):  # RuntimeError: a user without a home
        if connection.keys_of or not connection.settings:
            _find_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
            with os.fdopen(
                os.open(_find_folder() / f"{boot:016x}.json", _NEW_FILE, 0o600), "wb"
            ) as stream:
                stream.write(msgspec.json.encode(known))
    try:
        yield
    finally:
        with suppress(OSError, RuntimeError):
            (_find_folder() / f"{boot:016x}.json").unlink()


def find_known_sites(session: str) -> list[KnownSite]:
    """Returns the sites of a session that run on this machine; removes the files of those that
    are gone.
    """
    found = []
    machine = SystemClock().identity()
    with suppress(OSError, RuntimeError):
        for file in sorted(_find_folder().glob("*.json")):
            with suppress(OSError, msgspec.MsgspecError):  # half written, or none of ours
                one = msgspec.json.decode(file.read_bytes(), type=KnownSite)
                if one.machine != machine or not _is_alive(one.pid):
                    file.unlink()
                elif one.session == session:
                    found.append(one)
    return found


def _is_alive(pid: int) -> bool:
    with suppress(PermissionError):
        try:
            if os.name == "posix":  # elsewhere to ask is to end it
                os.kill(pid, 0)
        except ProcessLookupError:
            return False
    return True


def list_places(known: Sequence[KnownSite]) -> list[Endpoint]:
    """Returns the endpoints by which sites are reached, each once."""
    places = [place for one in known for place in one.places]
    return [place for n, place in enumerate(places) if place not in places[:n]]


def find_known_places(session: str, connection: "Connection") -> list[Endpoint] | None:
    """Returns where the sites of a session are reached, if all of them run here and as this
    member does.
    """
    how = connection.mode, bool(connection.keys_of)
    known = [one for one in find_known_sites(session) if (one.mode, one.keyed) == how]
    return (
        list_places(known)
        if known and {one.site for one in known} == set(known[0].sites)
        else None
    )


def stop_at_once(words: Sequence[str]) -> int | list[str]:
    """Stops arms as the words behind `trilat stop` ask for it.

    Returns:
        The exit code; or the words with which the long way does it, or what is left.
    """
    given = {"--session": "", "--keys": ""}
    sites = list[str]()
    simple = True
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if name in given:
            given[name] = value if equals else next(rest, "")
        else:
            simple = simple and not word.startswith("-")
            sites.append(word)
    if not given["--session"] or {"--end", "--help", "-h"}.intersection(sites):
        return list(words)
    names = f"{', '.join(sites) if simple and sites else 'every arm'} of session {given['--session']}"
    _print(f"stopping {names} ...")
    try:
        known = find_known_sites(given["--session"]) if simple else []
        known = [one for one in known if one.mode == known[0].mode]
        if known and known[0].keyed and not given["--keys"]:
            print(f"error: the members of {names} have keys: add --keys DIR", file=sys.stderr)
            return UsageError.exit_code
        if not known:
            return list(words)
        if _order(known, sites, given["--keys"]):
            return 0
        way = "--router" if known[0].mode == "client" else "--connect"
        return [
            *words,
            *chain(*([way, place] for place in list_places(known) if isinstance(place, str))),
        ]
    except KeyboardInterrupt:
        return 130
    except Exception:  # whatever it is: the long way is tried, and says what is wrong
        return list(words)


def _print(text: object) -> None:
    print(
        "".join(letter if letter.isprintable() else "\ufffd" for letter in str(text)),
        flush=True,
    )


def _order(known: Sequence[KnownSite], sites: Sequence[str], keys: str) -> bool:
    """Orders sites to stop, or all, until each has answered; prints the answers; true if all of
    them stop.

    Of two sessions with one name both are meant: then as many answer a question as there are of
    a site.
    """
    own: Any = AT_ONCE
    if keys:
        from .member_keys import read_member_keys

        own = merge_settings(read_member_keys(Path(keys), stops=True).settings, AT_ONCE)
    left = set(sites or known[0].sites)
    twins = Counter(one.site for one in known)
    asked: list[tuple[str, Inbox, list[dict[str, Any]]]] = []
    clock = SystemClock()
    session = known[0].session
    stops = True
    begun_ns = ask_ns = clock.monotonic_ns()
    with closing(ZenohBus([], list_places(known), known[0].mode, own)) as bus:
        while left and (now_ns := clock.monotonic_ns()) - begun_ns < PATIENCE_NS:
            if now_ns >= ask_ns:  # again: a question reaches those that are connected by then
                ask_ns = now_ns + ASK_NS
                keyed = [(site, topics.key(session, site, topics.STOP)) for site in left]
                asked += [(site, bus.query(key, known[0].stop), []) for site, key in keyed]
            for site, inbox, answers in asked:
                while (answer := inbox.poll()) is not None:
                    answers.append(msgspec.msgpack.decode(answer[1]))
                if site in left and len(answers) >= max(twins[site], 1):
                    left.discard(site)
                    for one in answers:
                        _print(one["text"])
                        stops = stops and one["accepted"]
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
    return stops and not left

"""`trilat stop` of arms whose sites run on this machine: at once, without discovery or what else takes time.

Invariant: it imports no more than it needs to send an order. What it cannot do itself, because a site is
elsewhere, does not answer, or an option asks for more, it leaves to the command's long way, with what is known.
"""

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ..errors import RunFailed, UsageError
from . import topics
from .bus import Inbox
from .clock import SystemClock
from .known_sites import KnownSite, find_known_sites
from .zenoh_bus import ZenohBus
from .zenoh_config import merge_settings

ASK_NS, POLL_NS = 50_000_000, 1_000_000
PATIENCE_NS = 1_500_000_000
"""A site that has not answered by then is left to the long way."""
_AT_ONCE = {"scouting": {"delay": 0}}
"""Nothing is scouted, so that nothing is waited for."""


class _Asked(NamedTuple):
    session: str
    sites: list[str]
    keys: str
    simple: bool


def stop_at_once(words: Sequence[str]) -> int | list[str]:
    """Stops arms as the words behind `trilat stop` ask for it.

    Returns:
        The exit code; or the words with which the long way does what is left.
    """
    asked = _read_words(words)
    if asked is None:
        return list(words)
    print(f"stopping {', '.join(asked.sites) or 'every arm'} of session {asked.session} ...", flush=True)
    try:
        return _stop(asked, words) if asked.simple else list(words)
    except KeyboardInterrupt:
        return 130
    except Exception:  # whatever it is: the long way is tried, and says what is wrong
        return list(words)


def _read_words(words: Sequence[str]) -> _Asked | None:
    """Returns what is asked for; None where it is not to stop arms, or names no session."""
    given, sites, simple = {"--session": "", "--keys": ""}, [], True
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if name in given:
            given[name] = value if equals else next(rest, "")
        elif word in ("--end", "--help", "-h"):
            return None
        elif word.startswith("-"):
            simple = False
        elif simple:
            sites.append(word)
    session = given["--session"]
    return _Asked(session, sites, given["--keys"], simple) if session.isprintable() and session else None


def _stop(asked: _Asked, words: Sequence[str]) -> int | list[str]:
    known = find_known_sites(asked.session)
    known = [one for one in known if one.mode == known[0].mode]
    here = [one for one in known if not asked.sites or one.site in asked.sites]
    if not here:
        return list(words)
    if here[0].keyed and not asked.keys:
        print(f"error: the members of session {asked.session} have keys: add --keys DIR", file=sys.stderr)
        return UsageError.exit_code
    accepted = _order(known, Counter(one.site for one in here), _read_settings(asked.keys))
    if not accepted:
        return list(words)
    if refused := [site for site, taken in accepted.items() if not taken]:
        print(f"error: {', '.join(refused)} did not stop", file=sys.stderr)
        return RunFailed.exit_code
    left = [site for site in asked.sites or known[0].sites if site not in accepted]
    if not left:
        return 0
    way = "--router" if known[0].mode == "client" else "--connect"
    ways = ([way, place] for place in _list_places(known) if isinstance(place, str))
    keys = ["--keys", asked.keys] if asked.keys else []
    return ["--session", asked.session, *keys, *chain(*ways), *(left if asked.sites else [])]


def _read_settings(folder: str) -> Mapping[str, Any]:
    if not folder:
        return _AT_ONCE
    from .member_keys import read_member_keys

    return merge_settings(read_member_keys(Path(folder)).settings, _AT_ONCE)


def _list_places(known: Sequence[KnownSite]) -> list[Any]:
    places: list[Any] = []
    for place in chain(*(one.places for one in known)):
        if place not in places:
            places.append(place)
    return places


def _order(known: Sequence[KnownSite], wanted: Counter[str], own: Mapping[str, Any]) -> dict[str, bool]:
    """Orders sites to stop until each has answered, and prints the answers; returns who did, and if it stops.

    Args:
        known: where they are, and how the order reads.
        wanted: how many sites of each name there are: of two sessions with one name both are meant.
        own: settings of Zenoh.
    """
    clock, accepted = SystemClock(), dict[str, bool]()
    asked: list[tuple[str, Inbox, list[dict[str, Any]]]] = []
    begun_ns = ask_ns = clock.monotonic_ns()
    order, session = bytes.fromhex(known[0].stop), known[0].session
    with closing(ZenohBus([], _list_places(known), known[0].mode, own)) as bus:
        while len(accepted) < len(wanted) and (now_ns := clock.monotonic_ns()) - begun_ns < PATIENCE_NS:
            if now_ns >= ask_ns:  # again: a question reaches those that are connected by then
                ask_ns = now_ns + ASK_NS
                for site in wanted.keys() - accepted.keys():
                    asked.append((site, bus.ask(topics.key(session, site, topics.STOP), order), []))
            for site, inbox, answers in asked:
                while (answer := inbox.poll()) is not None:
                    answers.append(msgspec.msgpack.decode(answer[1]))
                if len(answers) >= wanted[site] and site not in accepted:
                    accepted[site] = all(one["accepted"] for one in answers)
                    for one in answers:
                        print("".join(c if c.isprintable() else "\ufffd" for c in one["text"]), flush=True)
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
    return accepted

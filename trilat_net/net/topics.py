"""Bus keys `trilat/<session>/<member>/<channel>`, a boot number after `alive`; and numbers of
their messages.

Each record has its tick's number, and statistics are numbered by themselves.
"""

from collections.abc import Iterator
from typing import NamedTuple

from .bus import PresenceInbox

ROOT = "trilat"
RECORDER = "recorder"
STATE = "state"
LINK = "link"
EVENT = "event"
INFO = "info"
ALIVE = "alive"
PING = "ping"
SET = "set"
STOP = "stop"
"""What every member may ask of a site; all other changes are asked for under `SET`."""
SAMPLE = "sample"
PAST = "past"
STATS = "stats"
MEASURED = "measured"
HAND = "hand"
ENABLE = "enable"
VIEW = "view"
STATS_PER_SECOND = 10


class KeyParts(NamedTuple):
    """The parts of a key."""

    session: str
    member: str
    channel: str
    boot: str = ""


def presence_key(session: str, member: str) -> str:
    """Returns the expression of the liveliness tokens of a member's starts; `*` stands for
    every one.
    """
    return f"{key(session, member, ALIVE)}/*"


def read_presence(inbox: PresenceInbox) -> Iterator[tuple[KeyParts, bool]]:
    """Yields the changes of presence that wait in a ring: whose token, and whether it is alive
    now.
    """
    while (change := inbox.poll()) is not None:
        if (parts := parse_key(change[0])) is not None:
            yield parts, change[1]


def key(session: str, member: str, channel: str) -> str:
    """Returns the key of a member's channel; `*` stands for every member."""
    return f"{ROOT}/{session}/{member}/{channel}"


def parse_key(key: str) -> KeyParts | None:
    """Returns the parts of a key, or None if it is not a key of this program."""
    root, _, rest = key.partition("/")
    parts = rest.split("/")
    return KeyParts(*parts) if root == ROOT and len(parts) in (3, 4) else None


def ticks_per_stats(rate_hz: int) -> int:
    """Returns the ticks from one statistics message to the next, from tick 0 on."""
    return max(1, rate_hz // STATS_PER_SECOND)


def number_message(channel: str, tick: int, rate_hz: int) -> int:
    """Returns the number in its channel of the record or the statistics of a tick."""
    return tick // ticks_per_stats(rate_hz) if channel == LINK else tick


def count_messages(channel: str, ticks: int, rate_hz: int) -> int:
    """Returns how many records or statistics a site publishes in so many ticks."""
    return -(-ticks // ticks_per_stats(rate_hz)) if channel == LINK else ticks


def count_under_way(channel: str, rate_hz: int) -> int:
    """Returns how many messages that a site has sent may die with it when it is killed: those
    of 20 ms.
    """
    return 1 if channel == LINK else rate_hz // 50


def skipped_numbers(channel: str, tick: int, skipped: int, rate_hz: int) -> tuple[int, int]:
    """Returns what a site does not publish that makes no ticks for so many before one, see
    `begin_anew`.

    That is the number of the message with that tick, or that stands for it, and that of the
    first not made.
    """
    return number_message(channel, tick, rate_hz), count_messages(
        channel, tick - skipped, rate_hz
    )

"""Keys of the bus, and the numbers of the messages of each channel.

A key is trilat/<session>/<member>/<channel>. The key of a liveliness token, whose channel is
"alive", ends in the boot of the member. The number of a record is its tick; statistics are
numbered from 0.
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
"""Channel of the order to stop, which all members may send; other changes use `SET`."""
SAMPLE = "sample"
PAST = "past"
STATS = "stats"
MEASURED = "measured"
HAND = "hand"
ENABLE = "enable"
VIEW = "view"
STATS_PER_SECOND = 10


class KeyParts(NamedTuple):
    """The parts of a key.

    Attributes:
        session: name of the session.
        member: name of the member.
        channel: name of the channel.
        boot: boot of the member, in the key of a liveliness token; else "".
    """

    session: str
    member: str
    channel: str
    boot: str = ""


def presence_key(session: str, member: str) -> str:
    """Returns the key expression of the liveliness tokens of all starts of a member.

    The member `*` stands for all members.
    """
    return f"{key(session, member, ALIVE)}/*"


def read_presence(inbox: PresenceInbox) -> Iterator[tuple[KeyParts, bool]]:
    """Yields the changes of presence that wait in a ring.

    Each change is (key of the token, True if the token is alive now).
    """
    while (change := inbox.poll()) is not None:
        token, is_alive = change
        parts = parse_key(token)
        if parts is not None:
            yield parts, is_alive


def key(session: str, member: str, channel: str) -> str:
    """Returns the key of a member's channel; the member `*` stands for all members."""
    return f"{ROOT}/{session}/{member}/{channel}"


def parse_key(key: str) -> KeyParts | None:
    """Returns the parts of a key, or None if the key is not one of this program."""
    root, _, rest = key.partition("/")
    parts = rest.split("/")
    return KeyParts(*parts) if root == ROOT and len(parts) in (3, 4) else None


def ticks_per_stats(rate_hz: int) -> int:
    """Returns the number of ticks from one statistics message to the next."""
    return max(1, rate_hz // STATS_PER_SECOND)


def number_message(channel: str, tick: int, rate_hz: int) -> int:
    """Returns the number of a tick's record, or of its statistics, in their channel."""
    return tick // ticks_per_stats(rate_hz) if channel == LINK else tick


def count_messages(channel: str, ticks: int, rate_hz: int) -> int:
    """Returns the number of records or statistics that a site publishes in `ticks` ticks."""
    return -(-ticks // ticks_per_stats(rate_hz)) if channel == LINK else ticks


def count_under_way(channel: str, rate_hz: int) -> int:
    """Returns the number of sent messages that may be lost with a killed site.

    These are the messages of 20 ms.
    """
    return 1 if channel == LINK else rate_hz // 50


def skipped_numbers(channel: str, tick: int, skipped: int, rate_hz: int) -> tuple[int, int]:
    """Returns the numbers of messages around ticks that a site skipped.

    Args:
        channel: the channel.
        tick: the first tick after the skipped ones.
        skipped: number of skipped ticks.
        rate_hz: tick rate of the site.

    Returns:
        The number of the first message after the skipped ticks, and the number of messages
        published before them: the arguments of `Account.mark_unpublished`.
    """
    next_number = number_message(channel, tick, rate_hz)
    published = count_messages(channel, tick - skipped, rate_hz)
    return next_number, published

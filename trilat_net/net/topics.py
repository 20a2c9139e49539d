"""Defines the keys under which the messages of a session are published, and their numbering.

Messages are exchanged over Zenoh under keys of the form trilat/<session>/<member>/<channel>.
The member is the process that sends them, such as the one that controls the arm "m1", and the
channel is the kind of message. The key of a liveliness token, which shows that a process is
present, has the channel "alive" and ends with a random number that identifies the start of the
process (its boot).

The messages of a channel are numbered consecutively, so that a recorder can detect lost
messages. A record has the number of its tick. Statistics, which are published ten times per
second, are numbered from 0.
"""

from collections.abc import Iterator
from typing import NamedTuple

from .bus import PresenceInbox

ROOT = "trilat"
"""Prefix of all keys."""
RECORDER = "recorder"
"""Member name used by every recorder."""
STATE = "state"
"""Channel of the records that a site publishes for the recorder, one per tick."""
LINK = "link"
"""Channel of a site's statistics about its loop and its links."""
EVENT = "event"
"""Channel of events."""
INFO = "info"
"""Channel of the queries for a member's identity."""
ALIVE = "alive"
"""Channel of liveliness tokens."""
PING = "ping"
"""Channel of pings, which are used to measure the offset between clocks."""
SET = "set"
"""Channel of requests for changes."""
STOP = "stop"
"""Channel of the stop command, which all members may send. Other changes use `SET`."""
SAMPLE = "sample"
"""Channel of the samples that a site publishes for its peers, one per tick."""
PAST = "past"
"""Channel of a recorder's queries for lost messages."""
STATS = "stats"
"""Channel of a recorder's statistics."""
MEASURED = "measured"
"""Channel of the measurements of an external arm."""
HAND = "hand"
"""Channel of the targets and forces of an operator."""
ENABLE = "enable"
"""Channel of the reports from a dead-man switch."""
VIEW = "view"
"""Channel of the views that a site sends to an operator program in another process."""
STATS_PER_SECOND = 10
"""Rate at which a site publishes statistics, in 1/s."""


class KeyParts(NamedTuple):
    """The parts of a key, which has the form trilat/<session>/<member>/<channel>.

    Attributes:
        session: Name of the session.
        member: Name of the member that sends the message.
        channel: Name of the channel.
        boot: In the key of a liveliness token, the number that identifies the start of the
            member's process. Empty in other keys.
    """

    session: str
    member: str
    channel: str
    boot: str = ""


def presence_key(session: str, member: str) -> str:
    """Returns the key under which the presence of a member can be observed.

    A process shows that it is present with a liveliness token, whose key contains the random
    number that identifies the start of the process. In place of this number, the returned key
    contains a wildcard, which matches the tokens of all starts of the member.

    Args:
        session: Name of the session.
        member: Name of the member, or "*" for all members.
    """
    return f"{key(session, member, ALIVE)}/*"


def presence_token(session: str, member: str, boot: int) -> str:
    """Returns the key of the liveliness token with which a process shows that it is present.

    Zenoh informs all members of the session when the token appears, and when the process that
    declared it has disappeared.

    Args:
        session: Name of the session.
        member: Name of the member.
        boot: Random number that identifies the start of the member's process.
    """
    return f"{key(session, member, ALIVE)}/{boot}"


def read_presence(inbox: PresenceInbox) -> Iterator[tuple[KeyParts, bool]]:
    """Yields the processes that have appeared or disappeared since the last call.

    Args:
        inbox: Queue of the liveliness tokens that have appeared or disappeared. It is emptied.

    Yields:
        The parts of a token's key, and True if the token has appeared or False if it has
        disappeared. Tokens of other programs are skipped.
    """
    while (change := inbox.poll()) is not None:
        token, is_alive = change
        parts = parse_key(token)
        if parts is not None:
            yield parts, is_alive


def key(session: str, member: str, channel: str) -> str:
    """Returns the key under which a process publishes one kind of message.

    Args:
        session: Name of the session.
        member: Name of the member, or "*" for all members.
        channel: Name of the channel, such as that of the events.
    """
    return f"{ROOT}/{session}/{member}/{channel}"


def parse_key(key: str) -> KeyParts | None:
    """Splits the key of a message or a liveliness token into its parts.

    Args:
        key: The key.

    Returns:
        The names of the session, the member and the channel, plus the boot (the number that
        identifies the process start) for a token. None if the key belongs to another program.
    """
    root, _, rest = key.partition("/")
    parts = rest.split("/")
    has_valid_length = len(parts) in (3, 4)  # the fourth part is the boot of a token
    if root != ROOT or not has_valid_length:
        return None
    return KeyParts(*parts)


def ticks_per_stats(rate_hz: int) -> int:
    """Returns the number of ticks from one message with statistics to the next.

    Statistics are published ten times per second.

    Args:
        rate_hz: Tick rate of the site.
    """
    return max(1, rate_hz // STATS_PER_SECOND)


def number_message(channel: str, tick: int, rate_hz: int) -> int:
    """Returns the number of the message that a site publishes after a tick.

    A record has the number of its tick. Statistics, which are published less often, are
    numbered from 0.

    Args:
        channel: `STATE` for records, or `LINK` for statistics.
        tick: Number of the tick.
        rate_hz: Tick rate of the site.
    """
    return tick // ticks_per_stats(rate_hz) if channel == LINK else tick


def count_messages(channel: str, ticks: int, rate_hz: int) -> int:
    """Returns how many messages of a channel a site publishes in its first `ticks` ticks.

    A site publishes a record in each tick, and statistics ten times per second.

    Args:
        channel: `STATE` for the records, or `LINK` for the statistics.
        ticks: Number of ticks, starting from tick 0.
        rate_hz: Tick rate of the site, in Hz.
    """
    if channel != LINK:
        return ticks
    # The number is rounded up, because statistics are published after tick 0: -(-a // b) rounds
    # a / b up.
    return -(-ticks // ticks_per_stats(rate_hz))


def count_under_way(channel: str, rate_hz: int) -> int:
    """Returns how many published messages may be lost if a site is killed.

    These are the messages of the last 20 ms, which may not have left the machine yet.

    Args:
        channel: `STATE` for the records, which a site publishes in each tick, or `LINK` for the
            statistics, which it publishes ten times per second.
        rate_hz: Tick rate of the site, in Hz.
    """
    ticks_in_20_ms = rate_hz // 50
    return 1 if channel == LINK else ticks_in_20_ms


def skipped_numbers(
    channel: str,
    tick: int,
    skipped: int,
    rate_hz: int,
) -> tuple[int, int]:
    """Returns the range of the message numbers that a site leaves unused by skipping ticks.

    A site that is late may skip ticks, and publishes no messages for them. The unused numbers
    must not be counted as lost messages.

    Args:
        channel: `STATE` for records, or `LINK` for statistics.
        tick: First tick after the skipped ones.
        skipped: Number of skipped ticks.
        rate_hz: Tick rate of the site.

    Returns:
        The end of the range, which is the number of the first message after the skipped ticks,
        and the start of the range, which is the number of messages published before them. Pass
        both to `Account.mark_unpublished`.
    """
    next_number = number_message(channel, tick, rate_hz)
    published = count_messages(channel, tick - skipped, rate_hz)
    return next_number, published

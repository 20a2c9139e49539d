"""Bus keys: `trilat/<session>/<member>/<channel>`, and a boot number after `alive`."""

from collections.abc import Iterator
from typing import NamedTuple

from .bus import PresenceInbox

ROOT = "trilat"
RECORDER = "recorder"
STATE, LINK, EVENT, INFO, ALIVE, PING, SET = "state", "link", "event", "info", "alive", "ping", "set"
STOP = "stop"
"""What every member may ask of a site; all other changes are asked for under `SET`."""
SAMPLE = "sample"
PAST, STATS = "past", "stats"
MEASURED, HAND, ENABLE = "measured", "hand", "enable"


class KeyParts(NamedTuple):
    """The parts of a key."""

    session: str
    member: str
    channel: str
    boot: str = ""


def presence_key(session: str, member: str) -> str:
    """Returns the expression of the liveliness tokens of a member's starts; `*` stands for every one."""
    return f"{key(session, member, ALIVE)}/*"


def read_presence(inbox: PresenceInbox) -> Iterator[tuple[KeyParts, bool]]:
    """Yields the changes of presence that wait in a ring: whose token, and whether it is alive now."""
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

"""Bus keys: `trilat/<session>/<member>/<channel>`, and a boot number after `alive`."""

from typing import NamedTuple

ROOT = "trilat"
RECORDER = "recorder"
STATE, LINK, EVENT, INFO, ALIVE, PING, SET = "state", "link", "event", "info", "alive", "ping", "set"
PAST, STATS = "past", "stats"
MEASURED = "measured"


class KeyParts(NamedTuple):
    """The parts of a key."""

    session: str
    member: str
    channel: str
    boot: str = ""


def key(session: str, member: str, channel: str) -> str:
    """Returns the key of a member's channel; `*` stands for every member."""
    return f"{ROOT}/{session}/{member}/{channel}"


def parse_key(key: str) -> KeyParts | None:
    """Returns the parts of a key, or None if it is not a key of this program."""
    root, _, rest = key.partition("/")
    parts = rest.split("/")
    return KeyParts(*parts) if root == ROOT and len(parts) in (3, 4) else None

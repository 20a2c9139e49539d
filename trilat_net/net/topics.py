"""Bus keys: `trilat/<session>/<member>/<channel>`, and a boot number after `alive`."""

from typing import NamedTuple

ROOT = "trilat"
RECORDER = "recorder"
STATE, LINK, EVENT, INFO, ALIVE, PING, SET = "state", "link", "event", "info", "alive", "ping", "set"
PAST, STATS = "past", "stats"
MEASURED = "measured"


class KeyParts(NamedTuple):
    """What a key says: `trilat/<session>/<member>/<channel>`, and a boot behind `alive`."""

    session: str
    member: str
    channel: str
    boot: str = ""


def key(session: str, member: str, channel: str) -> str:
    """Returns the key of a member's channel; `*` stands for every member."""
    return f"{ROOT}/{session}/{member}/{channel}"


def parse_key(key: str) -> KeyParts | None:
    """Returns what a key says, or None where it is none of ours."""
    root, _, rest = key.partition("/")
    parts = rest.split("/")
    return KeyParts(*parts) if root == ROOT and len(parts) in (3, 4) else None

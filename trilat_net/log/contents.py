"""What one file holds: its session, its scenario's text, and the messages of every channel of ours.

Law: messages stay bytes until somebody asks for them. Channels that merely show what others hold (views for
other tools) are passed over.
"""

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from ..net import topics
from .chunks import Progress, Walk
from .writer import PART, SCENARIO, SESSION

_OURS = (topics.STATE, topics.LINK, topics.EVENT, topics.STATS)
_LAST_NS = np.uint64((1 << 63) - 1)


class Channel:
    """The messages of one topic, in file order.

    Attributes:
        payloads: the messages as published.
        log_ns: when each came, Unix ns.
        publish_ns: when each was sent, by its own stamp, Unix ns.
    """

    __slots__ = ("log_ns", "payloads", "publish_ns")

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.log_ns = array("Q")
        self.publish_ns = array("Q")

    def add(self, payload: bytes, log_ns: int, publish_ns: int) -> None:
        """Adds one message."""
        self.payloads.append(payload)
        self.log_ns.append(log_ns)
        self.publish_ns.append(publish_ns)

    def times(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns when the messages came and when they were sent, shape (K,) each, Unix ns."""
        return _signed(self.log_ns), _signed(self.publish_ns)


def _signed(times: "array[int]") -> NDArray[np.int64]:
    """Returns times as whole numbers that may be subtracted; a stranger's may be anything."""
    return np.minimum(np.array(times, dtype=np.uint64), _LAST_NS).astype(np.int64)


@dataclass
class Contents:
    """A file, or several that are one session's.

    Attributes:
        sources: the files' names.
        session: what the file says of the session.
        scenario: text of the scenario.
        metadata: everything of that kind, by name.
        channels: messages, by topic.
        complete: whether all of it is there, finished and readable throughout; a later part alone is not.
        ended: whether the last one was finished.
        damaged: what cannot be read, a sentence each.
    """

    sources: tuple[str, ...]
    session: dict[str, str]
    scenario: bytes
    metadata: dict[str, dict[str, str]]
    channels: dict[str, Channel] = field(repr=False)
    complete: bool
    ended: bool
    damaged: list[str]

    @property
    def source(self) -> str:
        """What errors call it."""
        more = len(self.sources) - 1
        return self.sources[0] + (f" and {more} more {'parts' if more > 1 else 'part'}" if more else "")


def contents(stream: BinaryIO, name: str, progress: Progress | None = None) -> Contents:
    """Returns what a file holds.

    Args:
        stream: the file, opened for reading.
        name: what errors call it.
        progress: told while it is read how many bytes of it are, and how many it has.

    Raises:
        LogError: it is no MCAP file, or no log of trilat-net.
    """
    walk = Walk(stream, name, progress)
    channels: dict[str, Channel] = {}
    adders: dict[str, Callable[[bytes, int, int], None]] = {}
    for topic, payload, log_ns, publish_ns, _ in walk.messages():
        try:
            add = adders[topic]
        except KeyError:
            add = adders[topic] = _adder(topic, channels)
        add(payload, log_ns, publish_ns)
    session = walk.metadata.get(SESSION, {})
    lacking = {"session", "driver"} - session.keys() or {SCENARIO} - walk.attachments.keys()
    if lacking:
        why = f"; damaged: {walk.damaged[0]}" if walk.damaged else f"; {walk.torn}" if walk.torn else ""
        raise LogError(f"{name}: is an MCAP file, but no log of trilat-net: no {lacking.pop()}{why}")
    damaged = [f"{name}: {damage}" for damage in walk.damaged]
    complete = walk.complete and not damaged and walk.metadata.get(PART, {}).get("index", "1") == "1"
    text = walk.attachments[SCENARIO]
    return Contents((name,), session, text, walk.metadata, channels, complete, walk.complete, damaged)


def _adder(topic: str, channels: dict[str, Channel]) -> Callable[[bytes, int, int], None]:
    """Returns what keeps a topic's messages; or lets them go, where nobody will ask for them."""
    where = topics.address(topic.removeprefix("/"))
    if where is None or where.channel not in _OURS:
        return lambda payload, log_ns, publish_ns: None  # noqa: ARG005
    return channels.setdefault(topic, Channel()).add

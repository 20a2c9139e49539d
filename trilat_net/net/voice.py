"""One start of a member: its boot, its token, and what it says of itself."""

import secrets
from collections.abc import Callable, Iterator

import msgspec

from ..errors import WireError
from . import topics
from .bus import Bus, Inbox
from .messages import Event, Info
from .wire import decode, encode


def new_boot() -> int:
    """Returns a random number that names one start of one process."""
    return secrets.randbits(64)


def token(session: str, member: str, boot: int) -> str:
    """Returns the liveliness token of one start of a member."""
    return topics.key(session, member, topics.ALIVE) + f"/{boot}"


def said(inbox: Inbox) -> Iterator[Event]:
    """Yields the events that wait in a ring; what is none of ours is passed over."""
    while (message := inbox.poll()) is not None:
        try:
            yield decode(message[1], Event)
        except WireError:
            continue


class Voice:
    """A member's own events and answers.

    Args:
        bus: its connection.
        session: the session's name.
        info: what it answers when asked who it is.
        keep: takes every event as it is published.

    Attributes:
        info: what it answers when asked who it is.
        said: how many events it has published.
    """

    def __init__(
        self, bus: Bus, session: str, info: Info, keep: Callable[[bytes], None] = lambda _: None
    ) -> None:
        self.info = info
        self.said = 0
        self._keep = keep
        self._publish = bus.publisher(topics.key(session, info.member, topics.EVENT))
        self._questions = bus.questions(topics.key(session, info.member, topics.INFO))

    def say(self, kind: str, text: str, **facts: object) -> Event:
        """Publishes an event, numbered, and returns it."""
        own = {"member": self.info.member, "boot": self.info.boot, "n": self.said}
        event = msgspec.convert({**own, "kind": kind, "text": text, **facts}, Event)
        self.said += 1
        payload = encode(event)
        self._keep(payload)
        self._publish(payload)
        return event

    def answer(self) -> None:
        """Answers who asks who this is."""
        while (question := self._questions.poll()) is not None:
            question.answer(encode(self.info))

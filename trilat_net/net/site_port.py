"""A site as a program beside it sees it: its newest record, and whether its run is over.

Invariant: a record of another start of the site than the first one met is passed over, and so is one that is
older than the newest or too far ahead; what cannot be read is a stranger's, and changes nothing.
"""

from collections import deque
from typing import Self

from ..errors import WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .membership import read_events
from .messages import State
from .wire import decode, split_states

FRESH_NS = 100_000_000
"""Age at which a record is no longer the present: the site is late, or gone."""


AHEAD_NS = 1_000_000_000
"""A record may be so much later than the one before than the time that has passed since."""


class SitePort:
    """The connection of a program to one site; a context, which closes it."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        self._bus, self._clock, self._site = bus, clock, site
        self._record: State | None = None
        self._came_ns = 0
        self._present = self._gone = False
        self._records = bus.stamped(topics.key(session, site, topics.STATE), clock.monotonic_ns, bytes, 64)
        self._events = bus.inbox(topics.key(session, site, topics.EVENT), 256)
        self._presence = bus.presence(topics.presence_key(session, site))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()

    @property
    def record(self) -> State | None:
        """The newest record of the site; None before the first."""
        self._read_messages()
        return self._record

    @property
    def fresh(self) -> bool:
        """True if the newest record is of now: not before the first tick, after the run, or too old."""
        record = self.record
        if record is None or self._gone or record.mode == "diverged":
            return False
        return self._clock.monotonic_ns() - self._came_ns <= FRESH_NS

    @property
    def over(self) -> bool:
        """True once the site's run has ended, or the site is gone."""
        self._read_messages()
        return self._gone

    def _follows_last(self, record: State, came_ns: int) -> bool:
        """True if a record is later than the newest one, of the same start, and no later than it can be."""
        last = self._record
        if last is None:
            return True
        newer = record.boot == last.boot and record.tick > last.tick and record.t_ns > last.t_ns
        return newer and record.t_ns - last.t_ns <= came_ns - self._came_ns + AHEAD_NS

    def _read_messages(self) -> None:
        while (message := self._records.poll()) is not None:
            try:
                (payload,) = deque(split_states(message[0]), maxlen=1)
                record = decode(payload, State)
            except WireError:
                continue  # a stranger's
            if self._follows_last(record, message[1]):
                self._record, self._came_ns = record, message[1]
        for event in read_events(self._events):
            if event.kind == "end" and self._record is not None and event.boot == self._record.boot:
                self._gone = True
        for _, alive in topics.read_presence(self._presence):
            self._present = self._present or alive
            self._gone = self._gone or (self._present and not alive)

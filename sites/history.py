"""What a site has published of late, for recorders that missed it.

Law (L6): bounded in memory, a minute of every channel, and in time, one chunk per question. The loop
answers in the slack of its ticks, or not yet.
"""

from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.answers import Past, Wanted
from trilat_net.net.bus import Question, Questions
from trilat_net.net.stats import PER_SECOND
from trilat_net.net.wire import decode, encode

KEPT_S = 60
RECORDS = 120_000
"""Most records that are kept: a minute up to 2 kHz, less above."""
EVENTS = 4096
"""Events that are kept: they are few, and the first ones say how the session began."""
CHUNK = 64
CHUNK_BYTES = 40_000
"""Most messages in one answer, and most bytes, unless a single message has more."""


class Ring:
    """The last messages of one channel; their numbers are their places, from 0.

    Args:
        capacity: how many it holds.

    Attributes:
        made: how many messages there have been.
    """

    def __init__(self, capacity: int) -> None:
        self.made = 0
        self._capacity = capacity
        self._payloads = [b""] * capacity

    def keep(self, payload: bytes) -> None:
        """Takes the next message; the oldest one makes room."""
        self._payloads[self.made % self._capacity] = payload
        self.made += 1

    def chunk(self, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns messages from a number on, as many as one answer takes, and the number of the first.

        Args:
            first: number of the first one wanted; where it is gone, the oldest one that is left comes first.
            last: number of the last one wanted.
        """
        first = max(first, self.made - self._capacity)
        payloads: list[bytes] = []
        size = 0
        for number in range(first, min(last + 1, self.made, first + CHUNK)):
            payload = self._payloads[number % self._capacity]
            size += len(payload)
            if payloads and size > CHUNK_BYTES:
                break
            payloads.append(payload)
        return first, payloads


class History:
    """What a site can tell of its past.

    Args:
        site: its name.
        boot: its process start.
        rate_hz: its tick rate.
        questions: what it is asked.

    Attributes:
        rings: per channel its last messages.
    """

    def __init__(self, site: str, boot: int, rate_hz: int, questions: Questions) -> None:
        self._site, self._boot, self._questions = site, boot, questions
        self.rings = {
            topics.STATE: Ring(min(KEPT_S * rate_hz, RECORDS)),
            topics.LINK: Ring(KEPT_S * PER_SECOND),
            topics.EVENT: Ring(EVENTS),
        }

    def answer(self) -> bool:
        """Answers the oldest question; False where there is none."""
        question = self._questions.poll()
        if question is not None:
            self._tell(question)
        return question is not None

    def _tell(self, question: Question) -> None:
        try:
            wanted = decode(question.payload, Wanted)
        except WireError:
            return  # a stranger's: it gets no answer
        ring = self.rings[wanted.channel]
        first, payloads = ring.chunk(wanted.first, wanted.last)
        past = Past(
            member=self._site,
            boot=self._boot,
            channel=wanted.channel,
            first=first,
            payloads=payloads,
            made=ring.made,
        )
        question.answer(encode(past))

"""Identifies a message by its content: sender, channel, number and sending time.

A damaged disk may return an old block, which leaves a message of another run in the middle of a
log. The checks and the recovery of logs detect such messages by comparing the identity of a
message with its position in the file.

Invariant:
    - The identity depends only on the content of the message, never on its position in the
      file, so that the two can be compared.
"""

import hashlib
from typing import NamedTuple

from ..net import (
    SENT_TIME_SINCE,
    Event,
    LinkStats,
    RecorderStats,
    State,
    number_message,
    topics,
)

AnyMessage = State | LinkStats | Event | RecorderStats
"""A message of one of the numbered channels, or of the recorder's statistics."""


class MessageIdentity(NamedTuple):
    """Sender, channel, number and sending time of a network message.

    Used to recognise lost and repeated messages.

    Attributes:
        sender: Name of the member of the session (a site or the recorder) that published the
            message.
        channel: Name of the channel: "state" (records), "link" (statistics), "event" or
            "stats".
        number: Number of the message in its channel, or -1 if the message states no number.
        sequence: Sequence number of the message in a log, or -1 if the message states no
            number.
        sent_ns: Sending time since the start of the session, in ns. None if the message states
            no time.
    """

    sender: str
    channel: str
    number: int
    sequence: int
    sent_ns: int | None

    @classmethod
    def of_message(cls, message: AnyMessage, rate_hz: int) -> "MessageIdentity":
        """Determines the sender, channel, number and time of a message from its content.

        Args:
            message: The decoded message.
            rate_hz: Tick rate of the sender, in Hz. Only needed to number statistics, which are
                not sent in every tick.
        """
        match message:
            case State():
                sent_ns = message.sent_ns if message.v >= SENT_TIME_SINCE else message.t_ns
                return cls(
                    sender=message.site,
                    channel=topics.STATE,
                    number=message.tick,
                    sequence=message.tick,
                    sent_ns=sent_ns,
                )
            case LinkStats():
                number = number_message(topics.LINK, message.tick, rate_hz)
                return cls(
                    sender=message.site,
                    channel=topics.LINK,
                    number=number,
                    sequence=message.tick,
                    sent_ns=message.t_ns,
                )
            case Event():
                # Events before the epoch have no time. The recorder stamps its own events when
                # it receives them.
                is_stamped = message.t_ns >= 0 and message.member != topics.RECORDER
                event_ns = message.t_ns if is_stamped else None
                sequence = max(0, message.n)
                return cls(
                    sender=message.member,
                    channel=topics.EVENT,
                    number=message.n,
                    sequence=sequence,
                    sent_ns=event_ns,
                )
            case RecorderStats():
                return cls(
                    sender=topics.RECORDER,
                    channel=topics.STATS,
                    number=-1,
                    sequence=-1,
                    sent_ns=None,
                )


def compute_virtual_boot(scenario_sha256: str, site: str) -> int:
    """Computes the boot of a site in a run in virtual time.

    The boot is a number that identifies one start of a site's process. In live sessions, it is
    random. In virtual time, it is derived from the scenario, so that runs are reproducible and
    every message of a run identifies its scenario.

    Args:
        scenario_sha256: SHA-256 hash of the scenario, in hexadecimal digits.
        site: Name of the site.

    Returns:
        A 64-bit integer.
    """
    digest = hashlib.sha256(f"{scenario_sha256}/{site}".encode()).digest()
    return int.from_bytes(digest[:8], "big")

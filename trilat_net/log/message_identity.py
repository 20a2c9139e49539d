"""Identifies a message by its content: sender, channel, number and sending time.

A damaged disk may return an old block, so that a message of another run lies in the middle of a
log. The checks and the recovery of logs find such messages by comparing the identity of a
message with its place in the file.

Invariant:
    - The identity depends only on the content of the message, and never on its place in the
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

    Lost and repeated messages are recognised by this identity.

    Attributes:
        sender: Name of the member of the session, a site (arm controller) or the recorder, that
            published the message.
        channel: Name of the channel: "state" (records), "link" (statistics), "event" or
            "stats".
        number: Number of the message in its channel. It is -1 if the message states no number.
        sequence: Sequence number of the message in a log. It is -1 if the message states no
            number.
        sent_ns: Sending time, in ns after the start of the session. None if the message states
            no time.
    """

    sender: str
    channel: str
    number: int
    sequence: int
    sent_ns: int | None

    @classmethod
    def of_message(cls, message: AnyMessage, rate_hz: int) -> "MessageIdentity":
        """Determines the sender, the channel and the number of a message from its content.

        Args:
            message: The decoded message.
            rate_hz: Tick rate of the sender, in Hz. It is needed to number statistics, which
                are not sent in every tick. It has no effect on other messages.

        Returns:
            The identity of the message.
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
    """Computes the boot of a site (arm controller) in a run in virtual time.

    The boot identifies one start of a site. It is a random number in live sessions. In virtual
    time, it is derived from the scenario, so that runs are reproducible and every message of a
    run identifies its scenario.

    Args:
        scenario_sha256: SHA-256 of the scenario, in hexadecimal digits.
        site: Name of the site.

    Returns:
        A number of 64 bits.
    """
    digest = hashlib.sha256(f"{scenario_sha256}/{site}".encode()).digest()
    return int.from_bytes(digest[:8], "big")

"""Identity of a message by its content: sender, channel, number and sending time.

Invariant:
    - The identity depends on the content of the message alone, and never on where the message
      is stored, so that its place in a file can be compared with the identity.
"""

import hashlib
from typing import NamedTuple

from ..net import messages, topics
from ..net.topics import number_message

AnyMessage = messages.State | messages.LinkStats | messages.Event | messages.RecorderStats
"""A message of one of the numbered channels, or of the recorder's statistics."""


class MessageIdentity(NamedTuple):
    """The identity of one message.

    Attributes:
        sender: the member that published the message.
        channel: name of the channel: "state", "link", "event" or "stats".
        number: number of the message in its channel; -1 if the message states no number.
        sequence: sequence number of the message in a file; -1 if the message states no number.
        sent_ns: sending time, ns since the epoch; None if the message states no time.
    """

    sender: str
    channel: str
    number: int
    sequence: int
    sent_ns: int | None


def compute_virtual_boot(scenario_sha256: str, site: str) -> int:
    """Returns the boot of a site in virtual time, from the scenario's hash and the site's name.

    By the boot, every message of a run in virtual time identifies its scenario.
    """
    digest = hashlib.sha256(f"{scenario_sha256}/{site}".encode()).digest()
    return int.from_bytes(digest[:8], "big")


def identify_message(message: AnyMessage, rate_hz: int) -> MessageIdentity:
    """Returns the identity of a message.

    Args:
        message: the message.
        rate_hz: tick rate of the sender, on which the numbers of statistics depend; any number
            for other messages.
    """
    match message:
        case messages.State():
            sent_ns = message.sent_ns if message.v >= messages.SENT_TIME_SINCE else message.t_ns
            return MessageIdentity(
                sender=message.site,
                channel=topics.STATE,
                number=message.tick,
                sequence=message.tick,
                sent_ns=sent_ns,
            )
        case messages.LinkStats():
            number = number_message(topics.LINK, message.tick, rate_hz)
            return MessageIdentity(
                sender=message.site,
                channel=topics.LINK,
                number=number,
                sequence=message.tick,
                sent_ns=message.t_ns,
            )
        case messages.Event():
            # Events before the epoch have no time. The recorder stamps its own events when it
            # receives them.
            is_stamped = message.t_ns >= 0 and message.member != topics.RECORDER
            event_ns = message.t_ns if is_stamped else None
            sequence = max(0, message.n)
            return MessageIdentity(
                sender=message.member,
                channel=topics.EVENT,
                number=message.n,
                sequence=sequence,
                sent_ns=event_ns,
            )
        case messages.RecorderStats():
            return MessageIdentity(
                sender=topics.RECORDER,
                channel=topics.STATS,
                number=-1,
                sequence=-1,
                sent_ns=None,
            )

"""What a message of a log says that it is: its sender, its number, and when it was sent.

Invariant: the answer depends on the content of the message alone, never on where it is stored,
so that a place in a file can be compared with it.
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
        sender: the member that published it.
        channel: the kind of its channel: "state", "link", "event" or "stats".
        number: its number in its channel; -1 if the message states none.
        sequence: the number under which a file stores it; -1 if the message states none.
        sent_ns: when it was sent, ns since the epoch; None if the message does not state that.
    """

    sender: str
    channel: str
    number: int
    sequence: int
    sent_ns: int | None


def compute_virtual_boot(scenario_sha256: str, site: str) -> int:
    """Returns the boot of a site in virtual time: a function of the scenario's hash and the
    site's name.

    So every message of such a run names its scenario.
    """
    return int.from_bytes(
        hashlib.sha256(f"{scenario_sha256}/{site}".encode()).digest()[:8], "big"
    )


def identify_message(message: AnyMessage, rate_hz: int) -> MessageIdentity:
    """Returns the identity of a message.

    Args:
        message: the message.
        rate_hz: tick rate of its sender, which numbers its statistics; any number for other
            messages.
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
            # The recorder stamps its own events when it hears them; before the epoch there is no time.
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

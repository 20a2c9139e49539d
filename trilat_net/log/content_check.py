"""Check of messages that no checksum covers, by their content: of a chunk that was cut off, or
has no CRC.

Invariant:
- A message is believed only if it decodes by its channel's schema, comes from its channel's
  member and from the same start of it as the message before, has the next number of its
  channel, is stored under that number and with its own time of sending, and was logged within
  its chunk and not before the message that precedes it.
- Nothing is believed after the first message that fails.
- Of a session in virtual time every message names the scenario by its boot: a chunk of a run of
  another scenario, which includes the seed, is refused even where a checksum covers it.

A log names each message four times over: by its place in the file, by its channel, by its
sequence number and by its content. Damage that keeps all four consistent changes numbers inside
a message alone, and is shorter than a message.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from ..core.ticks import tick_ns
from ..errors import WireError
from ..net import messages, topics
from ..net.topics import number_message
from ..net.wire import decode
from ..scenario import Scenario
from ..scenario.run_changes import count_skipped_ticks
from .log_layout import CHANNEL_TYPES, MAX_TIME_NS, RECORDER_CHANNELS, SITE_CHANNELS, VIZ_ROOT
from .mcap_records import MESSAGE_HEAD, OP_MESSAGE, UnreadableRecord, iterate_records
from .message_identity import (
    AnyMessage,
    MessageIdentity,
    compute_virtual_boot,
    identify_message,
)

CDR_HEAD = b"\x00\x01"
"""First bytes of a message of a channel for viewers."""


VIRTUAL_DRIVER = "virtual"
"""Driver of a session in virtual time."""
_SAMPLED_MESSAGES = 200
_CHECKED_MESSAGES = 20
"""Messages of a chunk that are compared with the boots of a session in virtual time."""


class MessageOrigins(NamedTuple):
    """The origins that messages state.

    Attributes:
        epochs_ns: the epochs of their sessions, Unix ns.
        boots: their senders, and the boots of those.
    """

    epochs_ns: set[int]
    boots: set[tuple[str, int]]


def find_origins(data: bytes, most: int = _SAMPLED_MESSAGES) -> MessageOrigins:
    """Returns the origins that the first messages of an unpacked chunk imply or state.

    An event states the epoch that it announces. Records and statistics state when they were
    sent since the epoch, and are stored with the Unix time of that; a session in virtual time
    has the epoch 0.

    Args:
        data: the records of the chunk.
        most: the number of messages that are decoded.
    """
    epochs_ns: set[int] = set()
    boots: set[tuple[str, int]] = set()
    decoded = 0
    for opcode, begin, end in iterate_records(data):
        if opcode != OP_MESSAGE or end - begin < MESSAGE_HEAD.size:
            continue
        if decoded >= most:
            break
        decoded += 1
        publish_ns = MESSAGE_HEAD.unpack_from(data, begin)[3]
        payload = data[begin + MESSAGE_HEAD.size : end]
        kinds: tuple[Any, ...] = (messages.State, messages.LinkStats, messages.Event)
        for kind in kinds:
            with suppress(WireError):
                message: AnyMessage = decode(payload, kind, messages.READABLE)
                identity = identify_message(message, 1)
                sent_ns = identity.sent_ns
                boots.add((identity.sender, message.boot))
                if isinstance(message, messages.Event):
                    epochs_ns |= {message.epoch_unix_ns} if message.epoch_unix_ns else set()
                elif sent_ns is not None and publish_ns:
                    epochs_ns.add(publish_ns - sent_ns)
    return MessageOrigins(epochs_ns, boots)


def has_foreign_boots(about: Mapping[str, str], boots: set[tuple[str, int]]) -> bool:
    """True if no message is of a session in virtual time, whose boots follow from its scenario.

    Args:
        about: metadata of the session; of a session in real time nothing is foreign.
        boots: the senders of the messages, and their boots.
    """
    if about.get("driver") != VIRTUAL_DRIVER:
        return False
    digest = about.get("scenario_sha256", "")
    return bool(boots) and all(
        boot != compute_virtual_boot(digest, sender) for sender, boot in boots
    )


class ContentCheck:
    """What is known of a session, to compare messages with.

    Args:
        scenario: the session's scenario.
        about: metadata of the session.
        is_continued: True for a later part of a log, whose channels do not begin with their
            first message.
    """

    def __init__(
        self, scenario: Scenario, about: Mapping[str, str], *, is_continued: bool
    ) -> None:
        self._scenario = scenario
        self._about = about
        self._session = about.get("session", "")
        epoch_text = about.get("epoch_unix_ns", "")
        self._epoch_ns = int(epoch_text) if re.fullmatch(r"\d{1,19}", epoch_text) else 0
        self._is_continued = is_continued
        self._newest: dict[str, tuple[int, bytes]] = {}  # by topic: sequence number and payload
        self._log_ns = 0

    def accept(self, topic: str, sequence: int, log_ns: int, payload: bytes) -> None:
        """Takes note of a message that a checksum covers; those after it must continue it."""
        self._newest[topic] = sequence, payload
        self._log_ns = max(self._log_ns, log_ns)

    def owns_channel(self, topic: str) -> bool:
        """True for a channel of the session's members."""
        key = topics.parse_key(topic.removeprefix("/"))
        if key is None or key.session != self._session or key.boot:
            return False
        if key.member == topics.RECORDER:
            return key.channel in RECORDER_CHANNELS
        return key.member in self._scenario.sites and key.channel in SITE_CHANNELS

    def identify(self, payload: bytes) -> str:
        """Returns the topic that a message belongs to by its own content; "" if it is none of
        the session.
        """
        kinds: tuple[Any, ...] = tuple(CHANNEL_TYPES.values())
        for kind in kinds:
            try:
                message: AnyMessage = decode(payload, kind, messages.READABLE)
            except WireError:
                continue
            identity = identify_message(message, 1)
            topic = "/" + topics.key(self._session, identity.sender, identity.channel)
            return topic if self.owns_channel(topic) else ""
        return ""

    def describe_channel(self, topic: str) -> dict[str, str]:
        """Returns the metadata of a channel of the session, as the log's writer gives them."""
        member, channel = topic.split("/")[-2:]
        about = {"member": member}
        if channel == topics.STATE:
            about["rate_hz"] = str(self._scenario.sites[member].rate_hz)
        return about

    def check(
        self,
        topic: str,
        sequence: int,
        log_ns: int,
        publish_ns: int,
        payload: bytes,
        span_ns: tuple[int, int],
    ) -> None:
        """Takes note of a message that no checksum covers, if its content proves that it is the
        next one.

        Args:
            topic: the topic of its channel.
            sequence: its number in the file.
            log_ns: when it was logged, Unix ns.
            publish_ns: when it was sent, Unix ns.
            payload: its bytes.
            span_ns: first and last log time of its chunk, Unix ns.

        Raises:
            UnreadableRecord: it is not.
        """
        first_ns, last_ns = span_ns
        if not max(first_ns, self._log_ns) <= log_ns <= last_ns:
            raise UnreadableRecord(f"a message of {topic} was logged outside of its chunk")
        if topic.startswith(VIZ_ROOT):
            if payload[:2] != CDR_HEAD:
                raise UnreadableRecord(f"a message of {topic} is not CDR")
        elif self.owns_channel(topic):
            self._check_own(topic, sequence, publish_ns, payload)
        else:
            raise UnreadableRecord(f"a message of {topic[:80]!r} is none of this session")
        self.accept(topic, sequence, log_ns, payload)

    def _decode(self, topic: str, payload: bytes) -> tuple[AnyMessage, MessageIdentity]:
        member, channel = topic.split("/")[-2:]
        kind: Any = CHANNEL_TYPES[channel]
        layout = None
        rate_hz = 1
        if member in self._scenario.sites:
            layout = self._scenario.layout(member)
            rate_hz = self._scenario.sites[member].rate_hz
        try:
            message = decode(payload, kind, messages.READABLE, layout)
        except WireError as error:
            raise UnreadableRecord(f"a message of {topic} cannot be read: {error}") from None
        return message, identify_message(message, rate_hz)

    def _check_own(self, topic: str, sequence: int, publish_ns: int, payload: bytes) -> None:
        message, identity = self._decode(topic, payload)
        member = topic.split("/")[-2]
        if identity.sender != member:
            raise UnreadableRecord(
                f"a message of {topic} says that {identity.sender[:40]!r} sent it"
            )
        boot = self._find_boot(member)
        if boot is not None and message.boot != boot:
            raise UnreadableRecord(f"a message of {topic} is of another start of {member}")
        if identity.sequence >= 0 and sequence != identity.sequence & 0xFFFFFFFF:
            raise UnreadableRecord(
                f"number {identity.sequence} of {topic} is stored as {sequence}"
            )
        number = sequence if identity.number < 0 else identity.number
        self._check_number(topic, message, number)
        if isinstance(message, messages.State):
            self._check_tick(topic, message)
        if identity.sent_ns is not None:
            sent_ns = min(max(0, self._epoch_ns + identity.sent_ns), MAX_TIME_NS)
            if publish_ns != sent_ns:
                raise UnreadableRecord(f"number {number} of {topic} was sent at another time")

    def check_origin(self, data: bytes) -> None:
        """Raises if the messages of an unpacked chunk are of another run in virtual time."""
        if self._about.get("driver") != VIRTUAL_DRIVER:
            return
        if has_foreign_boots(self._about, find_origins(data, _CHECKED_MESSAGES).boots):
            raise UnreadableRecord("a chunk of another run")

    def _find_boot(self, member: str) -> int | None:
        """Returns the boot with which a member sends its messages; None if nothing tells it
        yet.
        """
        if self._about.get("driver") == VIRTUAL_DRIVER:
            return compute_virtual_boot(self._about.get("scenario_sha256", ""), member)
        channels = RECORDER_CHANNELS if member == topics.RECORDER else SITE_CHANNELS
        for channel in channels:
            topic = "/" + topics.key(self._session, member, channel)
            if topic in self._newest:
                return self._decode(topic, self._newest[topic][1])[0].boot
        return None

    def _check_number(self, topic: str, message: AnyMessage, number: int) -> None:
        """Raises unless a message has the next number of its channel; old events have none."""
        member, channel = topic.split("/")[-2:]
        if isinstance(message, messages.Event) and message.n < 0:
            return
        before = self._newest.get(topic)
        if before is None:
            is_first = number == 0 or self._is_continued or self._scenario.sites_may_return
            if not is_first:
                raise UnreadableRecord(f"the first message of {topic} has number {number}")
            return
        rate_hz = self._scenario.sites[member].rate_hz if member in self._scenario.sites else 1
        expected = number_message(channel, before[0], rate_hz) + 1
        if isinstance(message, messages.State):
            expected += count_skipped_ticks(message.cmd)
        if number != expected:
            raise UnreadableRecord(f"number {number} of {topic} follows number {expected - 1}")

    def _check_tick(self, topic: str, record: messages.State) -> None:
        """Raises unless a record is of a tick of the run, at its nominal time, and names
        existing peers.
        """
        site = record.site
        if not 0 <= record.tick < self._scenario.ticks(site):
            raise UnreadableRecord(f"the scenario has no tick {record.tick} of {site}")
        if record.t_ns != tick_ns(record.tick, self._scenario.sites[site].rate_hz):
            raise UnreadableRecord(f"tick {record.tick} of {topic} has another nominal time")
        peers = self._scenario.peers(site)
        if not record.used.keys() <= set(peers) or not all(
            0 <= peer < len(peers) for peer, *_ in record.rx
        ):
            raise UnreadableRecord(
                f"tick {record.tick} of {topic} names a peer that does not exist"
            )
        if record.mode not in messages.MODES:
            raise UnreadableRecord(f"tick {record.tick} of {topic} has an unknown mode")

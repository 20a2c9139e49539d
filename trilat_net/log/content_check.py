"""Decides from the content of a message without a checksum whether the message is genuine.

A log stores messages in compressed chunks, each with a checksum. If a recording was
interrupted, for example by a power failure, the last chunk has no checksum, but the recovery of
the log should still use its messages. A log identifies each message in four ways: by its
position in the file, by its channel, by its sequence number, and by the content of the message
itself. If all four agree, damage can only have changed values inside that one message.

Invariant:
    - An accepted message can be decoded with the schema of its channel. It comes from the
      sender that owns the channel, and from the same start of that sender's process as the
      previous message.
    - Its number is the next one in its channel, and the file stores it with that number and
      with its sending time.
    - Its arrival time lies within the time range stated by its chunk, and not before the
      arrival of the previous message.
    - After the first message that fails, no further message is accepted.
    - In virtual time (a simulation without clocks), the scenario determines the random number
      that identifies each start of a process. A chunk from a run with another scenario or seed
      is therefore rejected, even if a checksum covers it.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from ..core import tick_ns
from ..errors import WireError
from ..net import MODES, READABLE, Event, LinkStats, State, decode, number_message, topics
from ..scenario import Scenario
from .accounting import count_skipped_ticks
from .log_layout import CHANNEL_TYPES, MAX_TIME_NS, RECORDER_CHANNELS, SITE_CHANNELS, VIZ_ROOT
from .mcap_records import MESSAGE_HEAD, OP_MESSAGE, UnreadableRecord, iterate_records
from .message_identity import AnyMessage, MessageIdentity, compute_virtual_boot

_CDR_HEAD = b"\x00\x01"
"""First bytes of a message for viewers, in the encoding of ROS 2."""

_VIRTUAL_DRIVER = "virtual"
"""Value of the metadata `driver` for a session in virtual time."""
_SAMPLED_MESSAGES = 200
"""Number of messages of a chunk that are decoded to find out where they come from."""
_CHECKED_MESSAGES = 20
"""Number of messages of a chunk whose boots are compared with those of the scenario."""


class MessageOrigins(NamedTuple):
    """Sessions and senders from which a set of messages comes.

    All messages of a log belong to one session. Messages of other sessions show that the file
    contains parts of another file.

    Attributes:
        epochs_ns: Start times of the sessions in Unix time, in ns.
        boots: Pairs of a sender and the number that identifies its start.
    """

    epochs_ns: set[int]
    boots: set[tuple[str, int]]

    @classmethod
    def find(cls, data: bytes, most: int = _SAMPLED_MESSAGES) -> "MessageOrigins":
        """Determines which sessions and senders the first messages of a chunk come from.

        A damaged file may contain a chunk of another file. Two things reveal such a chunk: the
        start time (epoch) of the session, and the boots of the senders, which are random
        numbers that identify each start of a process. A message reveals the epoch in one of two
        ways:

        - An event that announces the start of a session states the epoch.
        - A record or statistics message states its sending time relative to the epoch, and is
          stored with its sending time in Unix time. The difference is the epoch.

        In virtual time, sessions start at 0.

        Args:
            data: The uncompressed chunk.
            most: Maximum number of messages to decode.

        Returns:
            The start times and the senders. Empty if no message can be decoded.
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
            _channel, _sequence, _log_ns, publish_ns = MESSAGE_HEAD.unpack_from(data, begin)
            payload = data[begin + MESSAGE_HEAD.size : end]
            # The type of the message is unknown, so that all types are tried. A payload can be
            # decoded as its own type only. Any other type raises a WireError.
            kinds: tuple[Any, ...] = (State, LinkStats, Event)
            for kind in kinds:
                with suppress(WireError):
                    message: AnyMessage = decode(payload, kind, READABLE)
                    # The rate affects only the number of the message, which is not used here.
                    any_rate_hz = 1
                    identity = MessageIdentity.of_message(message, any_rate_hz)
                    boots.add((identity.sender, message.boot))
                    sent_since_epoch_ns = identity.sent_ns
                    if isinstance(message, Event):
                        states_epoch = bool(message.epoch_unix_ns)
                        if states_epoch:
                            epochs_ns.add(message.epoch_unix_ns)
                    elif sent_since_epoch_ns is not None and publish_ns:
                        # A stored time of 0 proves nothing.
                        epochs_ns.add(publish_ns - sent_since_epoch_ns)
        return cls(epochs_ns, boots)

    def are_foreign(self, about: Mapping[str, str]) -> bool:
        """Returns True if the messages come from a simulated run other than that of a log.

        In a simulated run, which uses virtual time, the number that identifies each process
        (its boot) is computed from the scenario. The boots therefore show which run a message
        belongs to. In a live session they are random and show nothing.

        Args:
            about: Session metadata of the log.

        Returns:
            True if no boot matches the scenario of the log. False if a boot matches, if there
            are no messages, or if the log is from a live session.
        """
        if about.get("driver") != _VIRTUAL_DRIVER:
            return False
        digest = about.get("scenario_sha256", "")
        matches = [boot == compute_virtual_boot(digest, sender) for sender, boot in self.boots]
        return bool(self.boots) and not any(matches)


class ContentCheck:
    """Checks the messages of a session against its scenario, metadata and earlier messages.

    The recovery passes the messages in file order: those with a valid checksum to `accept`, all
    others to `check`.

    Args:
        scenario: Scenario of the session.
        about: Session metadata.
        is_continued: True for a later part of a log, in which the message numbers do not start
            at 0.
    """

    def __init__(
        self, scenario: Scenario, about: Mapping[str, str], *, is_continued: bool
    ) -> None:
        """Prepares the check of a session's messages. No message has been accepted yet."""
        self._scenario = scenario
        self._about = about
        self._session = about.get("session", "")
        epoch_text = about.get("epoch_unix_ns", "")
        self._epoch_ns = int(epoch_text) if re.fullmatch(r"\d{1,19}", epoch_text) else 0
        self._is_continued = is_continued
        # Sequence number and payload of the latest accepted message, by topic.
        self._latest: dict[str, tuple[int, bytes]] = {}
        # Latest arrival time of an accepted message, in Unix time, in ns.
        self._log_ns = 0

    def accept(self, topic: str, sequence: int, log_ns: int, payload: bytes) -> None:
        """Stores a message covered by a checksum, for comparison with the next message.

        Message numbers and times increase within a channel, so a trusted message limits the
        number and times of its successor.

        Args:
            topic: Topic of the channel.
            sequence: Sequence number that the file stores with the message.
            log_ns: Arrival time in Unix time, in ns.
            payload: Bytes of the message.
        """
        self._latest[topic] = sequence, payload
        self._log_ns = max(self._log_ns, log_ns)

    def owns_channel(self, topic: str) -> bool:
        """Returns True if a topic belongs to a member of this session (a site or the recorder).

        A damaged file may contain parts of another log, whose topics name another session.

        Args:
            topic: Topic of a channel, such as "/trilat/paper/m1/state".
        """
        key = topics.parse_key(topic.removeprefix("/"))
        if key is None or key.session != self._session or key.boot:
            return False
        if key.member == topics.RECORDER:
            return key.channel in RECORDER_CHANNELS
        return key.member in self._scenario.sites and key.channel in SITE_CHANNELS

    def identify(self, payload: bytes) -> str:
        """Determines the topic of a message from its content.

        A recovery uses this for messages whose channel has no trustworthy definition.

        Args:
            payload: Bytes of the message.

        Returns:
            The topic. Empty if the message cannot be decoded, or was not sent by a member of
            the session.
        """
        kinds: tuple[Any, ...] = tuple(CHANNEL_TYPES.values())
        for kind in kinds:
            try:
                message: AnyMessage = decode(payload, kind, READABLE)
            except WireError:
                continue
            identity = MessageIdentity.of_message(message, 1)
            topic = "/" + topics.key(self._session, identity.sender, identity.channel)
            return topic if self.owns_channel(topic) else ""
        return ""

    def describe_channel(self, topic: str) -> dict[str, str]:
        """Returns the description that a channel has in an undamaged log of the session.

        A recovery uses it to restore a description that was lost.

        Args:
            topic: Topic of the channel.
        """
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
        """Raises UnreadableRecord unless a message is provably the next one in its channel.

        Used for messages that no checksum covers. A message that passes is stored for later
        comparison, as by `accept`.

        Args:
            topic: Topic of the channel.
            sequence: Sequence number that the file stores with the message.
            log_ns: Arrival time in Unix time, in ns.
            publish_ns: Sending time in Unix time, in ns.
            payload: Bytes of the message.
            span_ns: First and last arrival time of the chunk that contains the message, in Unix
                time, in ns.

        Raises:
            UnreadableRecord: The content does not prove that this is the channel's next
                message.
        """
        first_ns, last_ns = span_ns
        if not max(first_ns, self._log_ns) <= log_ns <= last_ns:
            raise UnreadableRecord(
                f"the log time of a message of {topic} lies outside the time range of its "
                "chunk, or is earlier than that of a previous message"
            )
        if topic.startswith(VIZ_ROOT):
            if payload[:2] != _CDR_HEAD:
                raise UnreadableRecord(f"a message of {topic} is not encoded in CDR")
        elif self.owns_channel(topic):
            self._check_session_message(topic, sequence, publish_ns, payload)
        else:
            raise UnreadableRecord(
                f"a message of {topic[:80]!r} belongs to no member of this session"
            )
        self.accept(topic, sequence, log_ns, payload)

    def _decode(self, topic: str, payload: bytes) -> tuple[AnyMessage, MessageIdentity]:
        """Decodes a message and determines the identity stated by its content.

        The identity consists of sender, channel, number and sending time. It is compared with
        the position of the message in the file.

        Args:
            topic: Topic of the message.
            payload: Bytes of the message.

        Raises:
            UnreadableRecord: The message cannot be decoded.
        """
        member, channel = topic.split("/")[-2:]
        kind: Any = CHANNEL_TYPES[channel]
        layout = None
        rate_hz = 1
        if member in self._scenario.sites:
            layout = self._scenario.layout(member)
            rate_hz = self._scenario.sites[member].rate_hz
        try:
            message = decode(payload, kind, READABLE, layout)
        except WireError as error:
            raise UnreadableRecord(f"a message of {topic} cannot be read: {error}") from None
        return message, MessageIdentity.of_message(message, rate_hz)

    def _check_session_message(
        self, topic: str, sequence: int, publish_ns: int, payload: bytes
    ) -> None:
        """Raises UnreadableRecord unless a member's message is the next one of its channel.

        A damaged file may contain messages of other sessions, which must not be copied.

        Args:
            topic: Topic of the channel.
            sequence: Sequence number that the file stores with the message.
            publish_ns: Sending time that the file stores with the message, in Unix time, in ns.
            payload: Bytes of the message.

        Raises:
            UnreadableRecord: The message is not the next one, or contradicts the file.
        """
        message, identity = self._decode(topic, payload)
        member = topic.split("/")[-2]
        if identity.sender != member:
            raise UnreadableRecord(
                f"a message of {topic} names {identity.sender[:40]!r} as its sender"
            )
        boot = self._find_boot(member)
        if boot is not None and message.boot != boot:
            raise UnreadableRecord(f"a message of {topic} comes from another start of {member}")

        # A file stores the sequence number in 32 bits.
        if identity.sequence >= 0 and sequence != identity.sequence & 0xFFFFFFFF:
            raise UnreadableRecord(
                f"message {identity.sequence} of {topic} is stored with the sequence number "
                f"{sequence}"
            )
        has_number = identity.number >= 0
        number = identity.number if has_number else sequence
        self._check_number(topic, message, number)
        if isinstance(message, State):
            self._check_tick(topic, message)
        if identity.sent_ns is not None:
            sent_ns = min(max(0, self._epoch_ns + identity.sent_ns), MAX_TIME_NS)
            if publish_ns != sent_ns:
                raise UnreadableRecord(
                    f"the sending time that is stored with message {number} of {topic} differs "
                    "from the time that the message states"
                )

    def check_origin(self, data: bytes) -> None:
        """Raises UnreadableRecord if a chunk of messages comes from another simulated run.

        A damaged file may contain chunks of another file. Only the first messages of the chunk
        are examined. For a live session nothing is checked, because its messages do not
        identify the run.

        Args:
            data: The uncompressed chunk.

        Raises:
            UnreadableRecord: None of the examined messages comes from the run of this log.
        """
        # Decoding messages is slow, and the boots of live sessions prove nothing.
        if self._about.get("driver") != _VIRTUAL_DRIVER:
            return
        origins = MessageOrigins.find(data, _CHECKED_MESSAGES)
        if origins.are_foreign(self._about):
            raise UnreadableRecord("a chunk belongs to another run")

    def _find_boot(self, member: str) -> int | None:
        """Returns the number that identifies the current start of a process, or None.

        All messages of one start contain this number (boot). In virtual time, it is computed
        from the scenario. Otherwise it is read from the latest accepted message, and None is
        returned if there is no such message.
        """
        if self._about.get("driver") == _VIRTUAL_DRIVER:
            return compute_virtual_boot(self._about.get("scenario_sha256", ""), member)
        channels = RECORDER_CHANNELS if member == topics.RECORDER else SITE_CHANNELS
        for channel in channels:
            topic = "/" + topics.key(self._session, member, channel)
            if topic in self._latest:
                _, payload = self._latest[topic]
                message, _ = self._decode(topic, payload)
                return message.boot
        return None

    def _check_number(self, topic: str, message: AnyMessage, number: int) -> None:
        """Raises UnreadableRecord unless a message has the next number of its channel.

        Args:
            topic: Topic of the channel.
            message: The message.
            number: Number of the message in its channel.

        Raises:
            UnreadableRecord: The number is not the next one.
        """
        member, channel = topic.split("/")[-2:]
        if isinstance(message, Event) and message.n < 0:
            return  # events of old logs have no number
        if topic not in self._latest:
            may_continue = self._is_continued or self._scenario.sites_may_return
            if number and not may_continue:
                raise UnreadableRecord(f"the first message of {topic} has number {number}")
            return

        previous_sequence, _ = self._latest[topic]
        is_site = member in self._scenario.sites
        rate_hz = self._scenario.sites[member].rate_hz if is_site else 1
        expected = number_message(channel, previous_sequence, rate_hz) + 1
        if isinstance(message, State):
            # The changes in a record state how many ticks the site skipped before it.
            expected += count_skipped_ticks(message.cmd)
        if number != expected:
            raise UnreadableRecord(
                f"message {number} of {topic} was found where message {expected} was expected"
            )

    def _check_tick(self, topic: str, record: State) -> None:
        """Raises UnreadableRecord if a record is impossible in a run of the scenario.

        The tick must exist and have its nominal time, the peers must exist, and the mode must
        be known.

        Args:
            topic: Topic of the record, for the error message.
            record: The record.

        Raises:
            UnreadableRecord: The content is impossible.
        """
        site = record.site
        ticks = self._scenario.ticks(site)
        if not 0 <= record.tick < ticks:
            raise UnreadableRecord(
                f"a record states tick {record.tick} of {site}, but the ticks of the scenario "
                f"are 0 to {ticks - 1}"
            )
        if record.t_ns != tick_ns(record.tick, self._scenario.sites[site].rate_hz):
            raise UnreadableRecord(
                f"the nominal time of tick {record.tick} of {topic} differs from that in the "
                "scenario"
            )

        peers = self._scenario.peers(site)
        uses_known_peers = record.used.keys() <= set(peers)
        receives_from_known_peers = all(0 <= peer < len(peers) for peer, *_ in record.rx)
        if not uses_known_peers or not receives_from_known_peers:
            raise UnreadableRecord(
                f"tick {record.tick} of {topic} names a peer that does not exist"
            )
        if record.mode not in MODES:
            raise UnreadableRecord(f"tick {record.tick} of {topic} has an unknown mode")

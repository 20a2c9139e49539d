"""Reads everything in a log into memory, and merges the files of a session into one log.

A log has several files (parts) if the recorder split it, or if several recorders recorded the
session, one after another or simultaneously.

Invariant:
    - The messages of a log stay encoded until they are needed.
    - Channels written for viewers (/viz) are skipped.
    - A message that occurs in several parts is written once.
    - Parts of different sessions are rejected, and so are parts that contain different messages
      with the same number.
    - The order in which the user lists the parts does not matter.
"""

import hashlib
import os
from array import array
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Hashable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError, ScenarioError, WireError
from ..files import open_regular
from ..net import READABLE, Event, LinkStats, RecorderStats, decode, topics
from ..scenario import parse_embedded
from .log_layout import ACCOUNTS, CHANNEL_TYPES, PART, SCENARIO, SESSION, describe_unfinished
from .mcap_reader import McapReader, MessageBlock, Progress, shift_progress
from .packed.packed_messages import PADDING, PackedMessages
from .record_columns import RecordColumns
from .running_digest import DIGESTS, PREVIOUS_DIGEST_KEY, DigestState, Integrity

_LAST_SIGNED_NS = np.uint64((1 << 63) - 1)
"""Latest time stamp that fits into a signed 64-bit integer, in ns."""


_FIRST_BYTES = 1 << 12
"""Initial space for the messages of a topic, in bytes."""


class ChannelMessages:
    """All messages of one topic in a log, still encoded, in file order.

    Attributes:
        log_ns: Arrival time of each of the K messages at the recorder in Unix time, in ns.
        publish_ns: Sending time stated by each message in Unix time, in ns.
    """

    def __init__(self) -> None:
        self._data = np.zeros(_FIRST_BYTES, np.uint8)
        self._size = 0
        self._ends = array("q")
        self.log_ns = array("Q")
        self.publish_ns = array("Q")

    def __len__(self) -> int:
        return len(self._ends)

    @property
    def payloads(self) -> PackedMessages:
        """The payloads of all K messages of the topic, as published.

        Messages that are added to the topic later are not included.
        """
        data = self._reserve(PADDING)
        ends = np.array(self._ends, np.int64)
        starts = np.concatenate([np.zeros(1, np.int64), ends])[: len(ends)]
        return PackedMessages(data[: self._size + PADDING], starts, ends)

    def payload(self, number: int) -> bytes:
        """Returns the payload of one message of the topic, as published.

        Args:
            number: Number of the message, counted from 0.
        """
        start = self._ends[number - 1] if number else 0
        return self._data[start : self._ends[number]].tobytes()

    def _reserve(self, size: int) -> NDArray[np.uint8]:
        """Returns the array with the payloads of all messages, with space for more at its end.

        The array at least doubles whenever it grows, which keeps many small additions cheap.

        Args:
            size: Number of additional bytes.
        """
        needed = self._size + size
        if needed > len(self._data):
            larger_array = np.empty(max(needed, 2 * len(self._data)), np.uint8)
            larger_array[: self._size] = self._data[: self._size]
            self._data = larger_array
        return self._data

    def add(self, payload: bytes, log_ns: int, publish_ns: int) -> None:
        """Appends a message to the messages of the topic.

        Messages must be added in file order.

        Args:
            payload: The message, encoded as published.
            log_ns: Arrival time at the recorder in Unix time, in ns.
            publish_ns: Sending time in Unix time, in ns.
        """
        data = self._reserve(len(payload))
        end = self._size + len(payload)
        data[self._size : end] = np.frombuffer(payload, np.uint8)
        self._size = end
        self._ends.append(end)
        self.log_ns.append(log_ns)
        self.publish_ns.append(publish_ns)

    def add_block(self, block: MessageBlock) -> None:
        """Appends a block of messages of the topic. Blocks must be added in file order."""
        data = self._reserve(block.most_bytes)
        ends, (log_ns, publish_ns) = block.copy_payloads(data, self._size)
        self._size = int(ends[-1])
        # The bytes of the NumPy arrays are appended to compact arrays of integers.
        self._ends.frombytes(ends.tobytes())
        self.log_ns.frombytes(log_ns.tobytes())
        self.publish_ns.frombytes(publish_ns.tobytes())

    def times(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns the arrival and sending times of the topic's K messages as arrays, in ns.

        Returns:
            The arrival times and the sending times in Unix time, each of shape (K,). A time of
            2^63 ns or later is replaced by the largest value that fits.
        """
        return _clip_times(self.log_ns), _clip_times(self.publish_ns)


def _clip_times(times: "array[int]") -> NDArray[np.int64]:
    """Converts unsigned times to signed times, clipping those that are too late."""
    unsigned = np.array(times, dtype=np.uint64)
    return np.minimum(unsigned, _LAST_SIGNED_NS).astype(np.int64)


@dataclass
class LogContents:
    """Everything in a log, from one or several files, before its messages are decoded.

    Attributes:
        sources: Names of the files.
        session: Metadata of the session, such as its name and its start time.
        scenario: Encoded text of the scenario.
        metadata: Maps the name of each metadata record to its contents.
        channels: Maps each topic to its messages.
        complete: True if all parts are present and finished, and can be read completely.
        ended: True if the last part was finished.
        damaged: One sentence for each part of a file that cannot be read.
        chain: Whether the log matches its digests. For several files, the worst result.
    """

    sources: tuple[str, ...]
    session: dict[str, str]
    scenario: bytes
    metadata: dict[str, dict[str, str]]
    channels: dict[str, ChannelMessages] = field(repr=False)
    complete: bool
    ended: bool
    damaged: list[str]
    chain: Integrity

    @property
    def source(self) -> str:
        """Name of the log for error messages, so that users know which file is meant."""
        more = len(self.sources) - 1
        if not more:
            return self.sources[0]
        return f"{self.sources[0]} and {more} more {'parts' if more > 1 else 'part'}"

    @classmethod
    def read(
        cls,
        stream: BinaryIO,
        name: str,
        progress: Progress | None = None,
        *,
        trusted: bool = False,
    ) -> "LogContents":
        """Reads everything in a log file into memory, without decoding the messages.

        Args:
            stream: The file, opened for reading.
            name: Name of the file for error messages.
            progress: Function that is called after every record of the file.
            trusted: True if this program has just written the file. Memory for the messages is
                then unlimited. The limit protects against files crafted to cause harm, but a
                harmless file in which arms hardly move may exceed it, because it compresses so
                well.

        Raises:
            LogError: The file is not an MCAP file, or not a log of trilat-net.
        """
        reader = McapReader(stream, name, progress, kept=not trusted)
        channels: dict[str, ChannelMessages] = {}
        for block in reader.blocks(_is_log_topic):
            channel = channels.setdefault(block.topic, ChannelMessages())
            channel.add_block(block)
        _check_head(reader, name)

        damaged = [f"{name}: {damage}" for damage in reader.damaged]
        is_first_part = reader.metadata.get(PART, {}).get("index", "1") == "1"
        return cls(
            sources=(name,),
            session=reader.metadata[SESSION],
            scenario=reader.attachments[SCENARIO],
            metadata=reader.metadata,
            channels=channels,
            complete=reader.complete and not damaged and is_first_part,
            ended=reader.complete,
            damaged=damaged,
            chain=reader.judge_digest(),
        )

    @classmethod
    def of_session(
        cls, sources: Sequence[str | Path | BinaryIO], progress: Progress | None
    ) -> "LogContents":
        """Reads the log of one session from a file, or from the files of all its parts.

        Args:
            sources: Paths, or binary files opened for reading, in any order.
            progress: Function that is called repeatedly with the number of bytes read and the
                total over all files.

        Returns:
            The contents of all files, as if they were one file.

        Raises:
            LogError: A file cannot be read, or the files belong to different sessions or
                contain different versions of a message.
        """
        return _merge_parts(_read_parts(sources, progress))

    @classmethod
    def of_sessions(
        cls, files: Sequence[Path], progress: Progress | None
    ) -> "list[LogContents]":
        """Reads the logs of one or several sessions.

        Args:
            files: Paths of the files, in any order.
            progress: Function that is called repeatedly with the number of bytes read and the
                total over all files.

        Returns:
            The contents of each session. Files of the same session are merged.

        Raises:
            LogError: A file cannot be read, or files of a session contain different versions of
                a message.
        """
        sessions: dict[str, list[LogContents]] = {}
        for part in _read_parts(files, progress):
            sessions.setdefault(str(_identify_session(part)), []).append(part)
        return list(map(_merge_parts, sessions.values()))

    @staticmethod
    def check(stream: BinaryIO, name: str) -> None:
        """Reads a log once, without storing its messages, to find out whether it can be opened.

        A log of any length can be checked with little memory.

        Args:
            stream: The file, opened for reading.
            name: Name of the file for error messages.

        Raises:
            LogError: The file cannot be opened as a log. The message states the reason.
        """
        reader = McapReader(stream, name)
        # Reads all messages, but stores no message.
        deque(reader.blocks(_is_log_topic), maxlen=0)
        _check_head(reader, name)
        try:
            parse_embedded(reader.attachments[SCENARIO].decode(), f"{name}: scenario")
        except (ScenarioError, UnicodeDecodeError) as error:
            raise LogError(
                f"{name}: the scenario in this log cannot be read: {error}"
            ) from None


def _is_log_topic(topic: str) -> bool:
    """True if the messages of a topic belong to a log of this program."""
    key = topics.parse_key(topic.removeprefix("/"))
    return key is not None and key.channel in CHANNEL_TYPES


def _check_head(reader: McapReader, name: str) -> None:
    """Raises LogError unless an MCAP file is a log of trilat-net, which describes a session.

    Args:
        reader: Reader that has read the complete file.
        name: Name of the file for the error message.

    Raises:
        LogError: The file lacks the metadata of the session, or the scenario.
    """
    session = reader.metadata.get(SESSION, {})
    missing_parts = [key for key in ("session", "driver") if key not in session]
    if SCENARIO not in reader.attachments:
        missing_parts.append(SCENARIO)
    if missing_parts:
        # The missing part may have been in a damaged part of the file.
        reason = f"damaged: {reader.damaged[0]}" if reader.damaged else reader.torn
        problem = (
            f"{name}: is an MCAP file, but not a log of trilat-net: {missing_parts[0]} is "
            "missing"
        )
        raise LogError(f"{problem}; {reason}" if reason else problem)


def _read_parts(
    sources: Sequence[str | Path | BinaryIO], progress: Progress | None
) -> list[LogContents]:
    """Reads the contents of files, and reports the overall progress.

    All files are opened before the first one is read, so that a missing file is reported
    immediately.
    """
    parts: list[LogContents] = []
    with ExitStack() as stack:
        files = [_open_source(source, stack) for source in sources]
        sizes = [_measure_size(stream) for stream, _ in files]
        bytes_before = 0
        for (stream, name), size in zip(files, sizes, strict=True):
            with _convert_errors(name):
                shifted = shift_progress(progress, bytes_before, sum(sizes))
                parts.append(LogContents.read(stream, name, shifted))
            bytes_before += size
    return parts


def _open_source(source: str | Path | BinaryIO, stack: ExitStack) -> tuple[BinaryIO, str]:
    """Opens one file of a log. A file that the caller has already opened is used as it is.

    Args:
        source: Path, or binary file opened for reading.
        stack: Context that closes the files opened here.

    Returns:
        The open file, and its name for error messages.
    """
    if isinstance(source, str | Path):
        with _convert_errors(str(source)):
            stream = stack.enter_context(open_regular(Path(source)))
        return stream, str(source)
    if hasattr(source, "seek"):
        return source, "log"
    raise LogError(
        f"a log must be given as a path or as a file opened for reading, not {source!r:.80}"
    )


@contextmanager
def _convert_errors(name: str) -> Iterator[None]:
    """Converts an operating system error to a `LogError` that names the file."""
    try:
        yield
    except OSError as error:
        raise LogError(
            f"{name} cannot be read: {error.strerror}{describe_unfinished(Path(name))}"
        ) from None


def _measure_size(stream: BinaryIO) -> int:
    """Returns the number of bytes from the current position to the end of a stream."""
    position = stream.tell()
    end = stream.seek(0, os.SEEK_END)
    stream.seek(position)
    return end - position


def _merge_parts(parts: Sequence[LogContents]) -> LogContents:
    """Merges the contents of the files into which the log of a session was divided.

    The recorder states at the end of each file how many messages it received. The counts of
    individual channels do not apply to the merged log and are left out. All other counts, such
    as that of dropped messages, are added up.

    Args:
        parts: One or more parts, in any order.

    Returns:
        The contents of all parts, as if they were one file.

    Raises:
        LogError: The parts belong to different sessions or contain different versions of a
            message, or a part cannot be read.
    """
    if len(parts) == 1:
        return parts[0]
    for other in parts[1:]:
        _check_same_session(parts[0], other)
    _check_digests(parts)

    ordered = sorted(parts, key=_first_time)
    first = ordered[0]
    last = ordered[-1]
    damaged = [damage for part in ordered for damage in part.damaged]
    topic_names = dict.fromkeys(topic for part in ordered for topic in part.channels)
    all_ended = all(part.ended for part in parts)
    all_present = sorted(map(_part_index, parts)) == [*range(1, len(parts) + 1)]

    states = list(DigestState)  # in order from the best to the worst
    chains = [part.chain for part in parts]
    worst_chain = max(chains, key=lambda chain: states.index(chain.state))
    return LogContents(
        sources=tuple(part.source for part in ordered),
        session=first.session,
        scenario=first.scenario,
        metadata={**first.metadata, ACCOUNTS: _sum_other_counts(ordered)},
        channels={topic: _merge_channel(topic, ordered) for topic in topic_names},
        complete=all_ended and not damaged and all_present,
        ended=last.ended,
        damaged=damaged,
        chain=worst_chain,
    )


def _check_same_session(first: LogContents, other: LogContents) -> None:
    """Raises LogError if two files belong to the logs of different sessions.

    Raises:
        LogError: The files belong to different sessions. The message lists the differences.
    """
    expected = _identify_session(first)
    actual = _identify_session(other)
    differences = [
        f"{name} is {actual[name]}, not {expected[name]}"
        for name in expected
        if expected[name] != actual[name]
    ]
    if differences:
        session = f"the session in {first.source}: {'; '.join(differences)}"
        raise LogError(f"{other.source} is not a part of {session}")


def _check_digests(parts: Sequence[LogContents]) -> None:
    """Raises LogError unless every part of a log continues the part before it.

    At the end of a part, the recorder writes a digest (checksum) of its messages. The next part
    repeats this digest at its beginning.

    Raises:
        LogError: A part states the digest of another file.
    """
    finished_parts = {_part_index(part): part for part in parts if DIGESTS in part.metadata}
    for part in parts:
        stated_digest = part.metadata.get(PART, {}).get(PREVIOUS_DIGEST_KEY)
        previous_part = finished_parts.get(_part_index(part) - 1)
        if not stated_digest or previous_part is None:
            continue
        if previous_part.metadata[DIGESTS].get("records") != stated_digest:
            raise LogError(
                f"{part.source} is not the continuation of {previous_part.source}: it was "
                "recorded after another file"
            )


def _first_time(part: LogContents) -> tuple[int, str]:
    """Returns a sort key for parts: the arrival time of the first message, and the name."""
    first_times = [channel.log_ns[0] for channel in part.channels.values() if channel.log_ns]
    return min(first_times, default=1 << 63), part.source


def _part_index(part: LogContents) -> int:
    """Returns the index of a part, counted from 1, or 0 if the part states no valid index."""
    text = part.metadata.get(PART, {}).get("index", "1")
    return int(text) if text.isdecimal() and len(text) < 10 else 0


def _sum_other_counts(parts: Sequence[LogContents]) -> dict[str, str]:
    """Adds up the recorders' counts that belong to no channel, such as dropped messages.

    A recorder continues its counts from part to part, so the last part of a recorder contains
    its totals. The totals of different recorders are added.

    Args:
        parts: The parts, in the order of their first messages.
    """
    last_counts: dict[int | str, dict[str, str]] = {}
    for part in parts:
        recorder = _recorder_boot(part) or part.source
        last_counts[recorder] = part.metadata.get(ACCOUNTS, {})

    sums: Counter[str] = Counter()
    for counts in last_counts.values():
        for name, count in counts.items():
            is_channel = name.startswith("/")
            if not is_channel and count.isdecimal():
                sums[name] += int(count)
    return {name: str(count) for name, count in sums.items()}


def _recorder_boot(part: LogContents) -> int:
    """Returns the random number that identifies the process that recorded a file.

    0 if the file has no readable message of the recorder.
    """
    kinds: dict[str, Any] = {topics.STATS: RecorderStats, topics.EVENT: Event}
    for channel, kind in kinds.items():
        topic = "/" + topics.key(part.session["session"], topics.RECORDER, channel)
        messages = part.channels.get(topic)
        if messages is not None and len(messages):
            # A message that cannot be decoded is reported when the log is read.
            with suppress(WireError):
                message: RecorderStats | Event = decode(
                    messages.payload(len(messages) - 1), kind, READABLE
                )
                return message.boot
            return 0
    return 0


def _identify_session(part: LogContents) -> dict[str, str]:
    """Collects the facts that identify a session and are the same in all parts of its log.

    Files can be read as one log only if these facts are equal.

    Args:
        part: Contents of one part.

    Returns:
        The metadata of the session, excluding fields that differ between parts.
    """
    names = ("session", "driver", "epoch_unix_ns")
    facts = {name: part.session.get(name, "unknown") for name in names}
    facts["scenario"] = hashlib.sha256(part.scenario).hexdigest()[:16]
    return facts


def _merge_channel(topic: str, parts: Sequence[LogContents]) -> ChannelMessages:
    """Merges the messages of a topic from several files of the same log, in file order.

    Messages are recognised by a key, such as the tick of a record. A message that an earlier
    file already contains is left out.

    Args:
        topic: The topic. At least one part contains it.
        parts: The parts, in order.

    Raises:
        LogError: Two parts contain different messages with the same key.
    """
    topic_parts = [part for part in parts if topic in part.channels]
    if len(topic_parts) == 1:
        return topic_parts[0].channels[topic]

    merged = ChannelMessages()
    # Index of each message in `merged`, by its key.
    merged_indices: dict[Hashable, int] = {}
    # Number of merged messages after each part.
    part_ends: list[int] = []
    for part in topic_parts:
        channel = part.channels[topic]
        payloads = channel.payloads
        # Messages are compared only with earlier parts, because a part may repeat its own
        # messages.
        new_indices: dict[Hashable, int] = {}
        keys = _list_keys(topic, payloads, part.source)
        for number, (key, payload) in enumerate(zip(keys, payloads, strict=True)):
            index = merged_indices.get(key)
            if index is None:
                new_indices[key] = len(merged)
                merged.add(payload, channel.log_ns[number], channel.publish_ns[number])
            elif merged.payload(index) != payload:
                other = topic_parts[bisect_right(part_ends, index)]
                message = _describe_message(topic, key)
                raise LogError(
                    f"{other.source} and {part.source} differ: {message} is not the same in "
                    "both"
                )
        merged_indices |= new_indices
        part_ends.append(len(merged))
    return merged


def _list_keys(topic: str, payloads: Sequence[bytes], source: str) -> Sequence[Hashable]:
    """Returns a key for each message of a topic, used to recognise copies of a message.

    Several recorders may have recorded the same message. Its copies have the same key, and
    different messages have different keys.

    Args:
        topic: The topic.
        payloads: Encoded messages of the topic.
        source: Name of the file for error messages.

    Raises:
        LogError: A message cannot be decoded.
    """
    try:
        match topic.rpartition("/")[2]:
            case topics.STATE:
                record_ticks: list[int] = RecordColumns(payloads).ticks().tolist()
                return record_ticks
            case topics.LINK:
                return [decode(payload, LinkStats, READABLE).tick for payload in payloads]
            case topics.EVENT:
                events = [decode(payload, Event, READABLE) for payload in payloads]
                keys: list[Hashable] = []
                for event, payload in zip(events, payloads, strict=True):
                    # Events have no number before version 3. In this case, their content is the
                    # key.
                    keys.append((event.boot, event.n) if event.n >= 0 else payload)
                return keys
        statistics = [decode(payload, RecorderStats, READABLE) for payload in payloads]
        return [(message.boot, message.t_ns) for message in statistics]
    except WireError as error:
        raise LogError(f"{source}: a message on {topic} cannot be read: {error}") from None


def _describe_message(topic: str, key: Hashable) -> str:
    """Returns a noun phrase for a message, for use in a sentence about differing files.

    For example, the key 12 in the topic of the records of "m1" becomes "the record of tick 12
    of m1". For the keys see `_list_keys`.
    """
    member, kind = topic.split("/")[-2:]
    match key:
        case int():
            noun = "record" if kind == topics.STATE else "statistics"
            return f"the {noun} of tick {key} of {member}"
        case (_, int(n)):
            if kind == topics.EVENT:
                return f"event {n} of {member}"
            return f"statistics of the {member} at {n} ns"
    return f"a message of {member}"

"""Reads MCAP files chunk by chunk.

An MCAP file stores messages in compressed chunks. Each message belongs to a channel, which has
a topic (a name). `McapReader` reads any MCAP file. `LogContents.read` uses it to load a
complete log of trilat-net.

Invariant:
    - The reader holds one uncompressed chunk in memory at a time. Unreadable parts are skipped
      and reported.
    - `McapReader.blocks` yields the same messages as `McapReader.messages`, in the same order
      within each channel, and finds the same damage.
    - Memory is bounded, even if a file was crafted to cause harm. A channel whose messages
      would need too much memory is read only in part, and the other channels are read
      completely.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..errors import LogError, count_nouns
from ..files import reading
from . import mcap_records
from .packed import chunk_walk
from .packed.packed_messages import Ints
from .running_digest import DIGESTS, Integrity, RunningDigest

_READ = {
    *mcap_records.DEFINITIONS,
    Opcode.CHUNK,
    Opcode.MESSAGE,
    Opcode.METADATA,
    Opcode.ATTACHMENT,
    Opcode.HEADER,
}
"""Kinds of records that are read. The indexes are not needed to read a complete file."""

KEPT_BYTES = 64 << 20
"""Memory that the messages of any file may use, in bytes."""
KEPT_RATIO = 300
"""For a larger file, the messages may use this multiple of the size of the file.

Among logs written by trilat-net, the largest ratio is about 120, for arms at rest in virtual
time.
"""
_CHANNEL_SHARE = 1 / 3
"""Largest fraction of this memory that one channel may use."""
_DECODED_BYTES = 3_000
_LONG_BYTES = 300
_LONG_RATIO = 24
"""The memory of a decoded message is estimated as _DECODED_BYTES plus _LONG_RATIO bytes for
each byte of its payload beyond _LONG_BYTES.
"""
_SKIPPED_BYTES = 100
"""Estimated memory of a message that is not decoded, in bytes, excluding its payload."""
_NAME_BYTES = 600
_NAME_RATIO = 20
"""The memory of a channel's definition is estimated as _NAME_BYTES plus _NAME_RATIO bytes for
each byte of its record.
"""

Progress = Callable[[int, int], None]
"""Function that is called with the progress of a task: the bytes processed so far and the total
number of bytes.
"""


def shift_progress(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Converts the progress within one of several files to the overall progress.

    For files that are read one after another. The returned function takes the progress in the
    current file, adds the sizes of the earlier files, and calls `progress`.

    Args:
        progress: Function that is called with the overall progress, in bytes. None if progress
            is not reported.
        before: Total size of the files already read, in bytes.
        total: Total size of all files, in bytes.

    Returns:
        The progress function for the current file, or None if `progress` is None.
    """
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


class ChannelInfo(NamedTuple):
    """Description of a channel, a sequence of messages of one kind in an MCAP file.

    Attributes:
        topic: Topic of the channel, such as "/trilat/paper/m1/state".
        encoding: Encoding of the messages.
        schema: Name of the schema, which describes the fields of the messages. Empty if the
            channel has no schema.
        schema_encoding: Language in which the schema is written.
        metadata: Maps the names of further facts about the channel to their values.
        schema_data: Encoded text of the schema.
    """

    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    metadata: dict[str, str]
    schema_data: bytes = b""


class McapMessage(NamedTuple):
    """One message of an MCAP file, still encoded, with its channel, times and number.

    Attributes:
        topic: Topic of the channel. Empty if the file does not define the channel.
        payload: Bytes of the message, as published.
        log_time_ns: Arrival time at the recorder in Unix time, in ns.
        publish_time_ns: Sending time in Unix time, in ns.
        sequence: Sequence number of the message, modulo 2^32.
    """

    topic: str
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int


class MessageBlock(NamedTuple):
    """Several messages of one topic that have not yet been copied out of a chunk.

    A chunk is a block of messages of all topics that is compressed as a unit. Messages are
    found and copied in blocks, because compiled code does this much faster than a Python loop
    over single messages.

    Attributes:
        topic: Topic of the channel.
        chunk: The uncompressed chunk, or the payload of a single message.
        run: Positions of the messages of all channels in this part of the chunk.
        listed: Number of messages in `run`.
        slot: Index by which `run` identifies the channel.
    """

    topic: str
    chunk: NDArray[np.uint8]
    run: chunk_walk.MessageRun
    listed: int
    slot: int

    @property
    def messages(self) -> int:
        """Number of messages in this block of consecutive messages of one topic."""
        return int(self.run.counts[self.slot])

    @property
    def most_bytes(self) -> int:
        """Upper bound on the total length of the messages in this block, in bytes.

        A reader reserves this much memory before it copies the messages.
        """
        return int(self.run.lengths[self.slot])

    def copy_payloads(self, target: NDArray[np.uint8], offset: int) -> tuple[Ints, Ints]:
        """Copies the payloads of the K messages into an array, one after another.

        Call this before the reader continues, because the reader reuses the memory of `run`.

        Args:
            target: Array to copy the payloads to.
            offset: Offset in `target` of the first payload.

        Returns:
            The offset in `target` at which each payload ends, shape (K,), and the arrival and
            sending times in Unix time, in ns, shape (2, K). The times are unsigned integers in
            a signed type, so a time of 2^63 ns or later appears negative.
        """
        ends = np.zeros(self.messages, np.int64)
        times = np.zeros((2, self.messages), np.int64)
        chunk_walk.copy_payloads(
            data=self.chunk,
            count=self.listed,
            slot=self.slot,
            run=self.run,
            payloads=target,
            offset=offset,
            ends=ends,
            times=times,
        )
        return ends, times


def _make_single_block(message: McapMessage) -> MessageBlock:
    """Returns a block of one message."""
    length = len(message.payload)
    run = chunk_walk.MessageRun.allocate(1)
    run.ends[0] = length
    run.log_ns.view(np.uint64)[0] = message.log_time_ns
    run.publish_ns.view(np.uint64)[0] = message.publish_time_ns
    run.counts[0] = 1
    run.lengths[0] = length
    chunk = np.frombuffer(message.payload, np.uint8)
    return MessageBlock(message.topic, chunk, run, listed=1, slot=0)


_BLOCK_BYTES = 1 << 12
"""Minimum size of a chunk whose messages are read in blocks, in bytes."""


class McapReader:
    """Reads one MCAP file from start to end, even if the file is damaged.

    `messages` yields the messages one by one, and `blocks` yields them in blocks, which is much
    faster. To check or recover the file, `scan` yields its records and damaged parts, and
    `read_record` the messages of a record.

    Args:
        stream: The file, opened for reading.
        name: Name of the file for error messages.
        progress: Function that is called after every record of the file.
        kept: True if the caller stores the messages. Their memory is then limited, see
            `KEPT_RATIO`.

    Attributes:
        metadata: Maps the name of each metadata record read so far to its contents.
        attachments: Maps the name of each attachment read so far to its contents.
        channels: Maps the topic of each channel read so far to its description. If a topic is
            defined repeatedly, the first definition counts.
        library: Program that wrote the file, according to the header.
        chunks: Maps each compression to the number of chunks read so far. The key is empty for
            uncompressed chunks.
        packed_bytes: Compressed size of these chunks, in bytes.
        unpacked_bytes: Uncompressed size of these chunks, in bytes.
        size: Size of the file, in bytes.
        offset: Offset of the record that is being read.
        complete: True if the file was finished and has been read completely.
        scanner: Scanner that finds the records of the file.
    """

    def __init__(
        self,
        stream: BinaryIO,
        name: str,
        progress: Progress | None = None,
        *,
        kept: bool = True,
    ) -> None:
        """Opens an MCAP file for reading. Only its beginning and end are read at this point."""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[str, ChannelInfo] = {}
        self.library = ""
        self.chunks: Counter[str] = Counter()
        self.packed_bytes = 0
        self.unpacked_bytes = 0
        self.offset = 0
        self.complete = False

        self._chain = RunningDigest()
        self.scanner = mcap_records.RecordScanner(stream)
        self.size = self.scanner.size
        self._source = name
        self._progress = progress
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._topics: dict[int, str] = {}
        self._session_channels: set[int] = set()

        # Compiled code finds messages in blocks. It identifies a channel by a slot, a small
        # number: `_slots` has the number of the channel of each slot.
        self._slots: list[int] = []
        self._slot_of_channel = np.full(chunk_walk.MOST_CHANNELS, -1, np.int32)
        self._run = chunk_walk.MessageRun.allocate(0, chunk_walk.CAPACITY)

        # Memory that may still be used, for all messages and for each channel, in bytes.
        self._memory_left = max(KEPT_BYTES, KEPT_RATIO * self.size) if kept else None
        channel_limit = (
            math.inf if self._memory_left is None else _CHANNEL_SHARE * self._memory_left
        )
        self._channel_memory_left: defaultdict[int, float] = defaultdict(lambda: channel_limit)
        self._more_damage: list[mcap_records.Damage] = []
        # True if the whole file is scanned, however damaged it is.
        self._is_scanned = False

    @classmethod
    def read_files(
        cls,
        paths: Sequence[Path],
        read_file: Callable[[Path, "McapReader"], None],
        progress: Progress | None = None,
    ) -> None:
        """Reads MCAP files one after another. A file is closed before the next one is opened.

        Args:
            paths: The files.
            read_file: Function that is called with the path of each file and its reader, from
                which no message has been read yet.
            progress: Function that is called with the number of bytes read so far and the total
                number of bytes of all files.

        Raises:
            LogError: A file cannot be read, or is not an MCAP file.
        """
        total_bytes = sum(path.stat().st_size for path in paths if path.is_file())
        bytes_before = 0
        for path in paths:
            file_progress = shift_progress(progress, bytes_before, total_bytes)
            with reading(path) as stream:
                read_file(path, cls(stream, str(path), file_progress))
            bytes_before += path.stat().st_size

    @property
    def damaged(self) -> list[mcap_records.Damage]:
        """Unreadable parts of the file found so far.

        Also lists a channel that was read only in part because of the memory limit.
        """
        return self.scanner.damaged + self._more_damage

    @property
    def torn(self) -> mcap_records.Damage | None:
        """Unreadable rest of a file whose end is missing, such as a truncated record.

        The rest extends to the last byte of the file. None if the file ends properly, or if its
        end has not been reached yet.
        """
        return self.scanner.torn

    def messages(self) -> Iterator[McapMessage]:
        """Yields every message in file order.

        An unreadable part is added to `damaged`, and reading continues after it unless there
        are too many damaged parts.

        Raises:
            LogError: The file is not an MCAP file, or its uncompressed size is out of
                proportion to its size.
        """
        self._check_begin()
        for item in self._walk():
            if isinstance(item, mcap_records.Damage) or item.frame.opcode not in _READ:
                continue
            # `read_record` is not used here, because a further generator would slow down every
            # message.
            try:
                yield from self._read_messages(item)
            except mcap_records.UnreadableRecord as error:
                self._note_damage(item.frame, error)

    def blocks(self, topic_is_kept: Callable[[str], bool]) -> Iterator[MessageBlock]:
        """Yields the messages of selected topics in large blocks.

        Finds the same messages as `messages`, but is faster than yielding them one by one.

        Args:
            topic_is_kept: Function that returns True for the topics whose messages are wanted.

        Raises:
            LogError: The file is not an MCAP file, or its uncompressed size is out of
                proportion to its size.
        """
        self._check_begin()
        is_kept = cache(topic_is_kept)
        for item in self._walk():
            if isinstance(item, mcap_records.Damage) or item.frame.opcode not in _READ:
                continue
            try:
                yield from self._read_blocks(item, is_kept)
            except mcap_records.UnreadableRecord as error:
                self._note_damage(item.frame, error)

    def _check_begin(self) -> None:
        """Raises LogError unless the file begins with the magic bytes of MCAP.

        Raises:
            LogError: The file begins with other bytes, and is therefore not an MCAP file.
        """
        if not self.scanner.begins:
            reason = "is empty" if not self.size else "does not begin with the mark of MCAP"
            raise LogError(f"{self._source} is not an MCAP file: the file {reason}")

    def scan(self) -> Iterator[mcap_records.ScannedRecord | mcap_records.Damage]:
        """Yields the records and the damaged parts of the file, see `RecordScanner.scan`.

        The file may begin with any bytes, and is scanned to its end. The caller must pass each
        record to `read_record`, even if it does not need the messages, because `read_record`
        collects the metadata and the digests of the file. After too many damaged parts,
        `read_record` does nothing.
        """
        self._is_scanned = True
        yield from self._walk()

    def _walk(self) -> Iterator[mcap_records.ScannedRecord | mcap_records.Damage]:
        """Yields the records and the damaged parts of the file, and reports the progress.

        Progress is reported when the generator resumes, that is, after the caller has handled a
        record.
        """
        for item in self.scanner.scan():
            if isinstance(item, mcap_records.Damage):
                yield item
                continue

            frame = item.frame
            self.offset = frame.offset
            yield item
            if self._progress is not None:
                self._progress(frame.end, self.size)

        self.complete = self.scanner.finished and not self._gave_up

    def read_record(self, record: mcap_records.ScannedRecord) -> Iterator[McapMessage]:
        """Yields the messages in a record, and stores its metadata, attachments or definitions.

        Used with `scan` by callers that need both the records and the messages of a file. A
        record that cannot be read is added to `damaged`.

        Args:
            record: The next record of the file.

        Raises:
            LogError: The uncompressed size of the file is out of proportion to its size.
        """
        if record.frame.opcode not in _READ or self._gave_up:
            return
        try:
            yield from self._read_messages(record)
        except mcap_records.UnreadableRecord as error:
            self._note_damage(record.frame, error)

    def _note_damage(self, frame: mcap_records.RecordFrame, error: Exception) -> None:
        """Adds a record that cannot be decoded to the list of damaged parts of the file.

        Args:
            frame: Position of the record.
            error: The reason.
        """
        # The scanner stops if its own list is too long. A scan must continue to the end of the
        # file. Therefore the damage is added to another list.
        damaged = self._more_damage if self._is_scanned else self.scanner.damaged
        damaged.append(mcap_records.Damage(frame.offset, frame.size, str(error)))

    @property
    def _gave_up(self) -> bool:
        """True if the reader has stopped because the file has too many damaged parts.

        This limits the time and memory that a file of random bytes can cost.
        """
        return self._is_scanned and len(self.damaged) >= mcap_records.MAX_DAMAGED_PARTS

    def _unpack(self, record: mcap_records.ScannedRecord) -> bytes:
        """Processes a record of the file, and returns the messages and definitions in it.

        The action depends on the kind of record:

        - A chunk, a compressed block of messages and definitions, is counted and decompressed.
        - A message or definition outside of chunks is returned in the same format as in a
          chunk.
        - Metadata, attachments and the header contain no messages. They are stored in the
          attributes of the reader and added to the digest, the checksum that is compared with
          the one in the file. `_read_messages` adds the returned messages and definitions to
          the digest.

        Args:
            record: The record, of a kind in `_READ`.

        Returns:
            The messages and definitions, each with its header. Empty if there are none.

        Raises:
            UnreadableRecord: The record cannot be decoded, or its checksum is wrong.
        """
        frame = record.frame
        content = record.content
        match frame.opcode:
            case Opcode.CHUNK:
                data = record.unpack()
                self.chunks[record.head().compression] += 1
                self.packed_bytes += len(content)
                self.unpacked_bytes += len(data)
                return data
            case Opcode.MESSAGE | Opcode.SCHEMA | Opcode.CHANNEL:  # outside of chunks
                return mcap_records.RECORD_HEAD.pack(frame.opcode, frame.length) + content
            case Opcode.METADATA:
                entry = mcap_records.parse_record(frame.opcode, content)
                self.metadata[entry.name] = entry.metadata
                if entry.name == DIGESTS:
                    # The digests of the file cannot cover themselves.
                    return b""
            case Opcode.ATTACHMENT:
                attachment = mcap_records.parse_record(frame.opcode, content)
                if not mcap_records.has_right_crc(content):
                    raise mcap_records.UnreadableRecord(
                        f"the CRC of the attachment {attachment.name[:80]!r} does not match "
                        "its content"
                    )
                self.attachments[attachment.name] = attachment.data
            case Opcode.HEADER:
                self.library = mcap_records.parse_record(frame.opcode, content).library
        self._chain.add_entry(frame.opcode, content)
        return b""

    def _read_messages(self, record: mcap_records.ScannedRecord) -> Iterator[McapMessage]:
        """Yields the messages in a record of the file, and stores the definitions in it.

        The definitions are schemas (formats of messages) and channels (topics).

        Args:
            record: The record, of a kind in `_READ`.

        Raises:
            UnreadableRecord: The record is invalid.
            LogError: The messages need too much memory.
        """
        yield from self._read_remaining_messages(
            _PartlyReadRecord(record.frame, self._unpack(record))
        )

    def _read_remaining_messages(
        self, partly_read: "_PartlyReadRecord"
    ) -> Iterator[McapMessage]:
        """Yields the messages of a record that have not been read yet.

        Messages and definitions are added to the digests. Local variables speed up this loop,
        which runs for every message of a file.

        Args:
            partly_read: The record, and how far it has been read.

        Raises:
            UnreadableRecord: The record is invalid.
            LogError: The messages need too much memory.
        """
        frame = partly_read.frame
        data = partly_read.data
        find_topic = self._topics.get
        session_channels = self._session_channels
        memory_left = self._channel_memory_left
        parse_head = mcap_records.MESSAGE_HEAD.unpack_from
        head_bytes = mcap_records.MESSAGE_HEAD.size
        new = tuple.__new__  # twice as fast as calling the class `McapMessage`
        memory = 0
        messages = 0
        for opcode, begin, end in mcap_records.iterate_records(data, partly_read.offset):
            if opcode == mcap_records.OP_MESSAGE:
                length = end - begin
                messages += 1
                if length < head_bytes:
                    raise mcap_records.UnreadableRecord("a message is shorter than its header")
                channel, sequence, log_time_ns, publish_time_ns = parse_head(data, begin)

                # Messages of the session will be decoded, but other messages will not.
                if channel in session_channels:
                    cost = _DECODED_BYTES
                    if length > _LONG_BYTES:
                        cost += (length - _LONG_BYTES) * _LONG_RATIO
                else:
                    cost = _SKIPPED_BYTES + length
                remaining = memory_left[channel]
                if remaining < cost:
                    self._stop_reading_channel(channel, frame)
                    continue
                memory_left[channel] = remaining - cost
                memory += cost

                payload = data[begin + head_bytes : end]
                topic = find_topic(channel, "")
                yield new(McapMessage, (topic, payload, log_time_ns, publish_time_ns, sequence))
            elif opcode in mcap_records.DEFINITIONS:
                self._read_definition(partly_read, opcode, begin, end)
        self._finish_record(
            partly_read, partly_read.messages + messages, partly_read.memory + memory
        )

    def _read_definition(
        self, partly_read: "_PartlyReadRecord", opcode: int, begin: int, end: int
    ) -> None:
        """Stores the definition of a schema or channel that lies between the messages.

        The messages before the definition are added to the digest (checksum) of all messages,
        which excludes definitions.

        Args:
            partly_read: The record, and how far it has been read.
            opcode: Kind of the definition.
            begin: Offset at which the content of the definition begins.
            end: Offset after its content.

        Raises:
            UnreadableRecord: The definition cannot be decoded.
            LogError: There is not enough memory left.
        """
        record_start = begin - mcap_records.RECORD_HEAD_BYTES
        self._chain.add_records(
            memoryview(partly_read.data)[partly_read.digested : record_start], 0
        )
        partly_read.digested = end
        self._reserve_memory(_NAME_BYTES + _NAME_RATIO * (end - begin), partly_read.frame)
        self._define(opcode, partly_read.data[begin:end])

    def _finish_record(
        self, partly_read: "_PartlyReadRecord", messages: int, memory: int
    ) -> None:
        """Finishes reading a record after all of its messages have been read.

        The messages after the last definition are added to the digest (checksum) of all
        messages, and the memory of all messages is subtracted from what may still be used.

        Args:
            partly_read: The record, and how far it has been read.
            messages: Number of messages in the record.
            memory: Memory that the messages need, in bytes.

        Raises:
            LogError: There is not enough memory left.
        """
        self._chain.add_records(memoryview(partly_read.data)[partly_read.digested :], messages)
        self._reserve_memory(memory, partly_read.frame)

    def _read_blocks(
        self, record: mcap_records.ScannedRecord, is_kept: Callable[[str], bool]
    ) -> Iterator[MessageBlock]:
        """Yields the messages of a record in blocks, and stores its schemas and channels.

        Compiled code (`walk_messages`) finds the messages up to the next definition of a schema
        or channel. The definition is then read, and the search continues after it. If the
        compiled code cannot continue, or if the record is short, the remaining messages are
        read one by one.

        Args:
            record: The record, of a kind in `_READ`.
            is_kept: Function that returns True for the topics whose messages are wanted.

        Raises:
            UnreadableRecord: The record cannot be decoded.
            LogError: The messages need too much memory.
        """
        partly_read = _PartlyReadRecord(record.frame, self._unpack(record))
        data = partly_read.data
        chunk = np.frombuffer(data, np.uint8)
        is_long = len(data) >= _BLOCK_BYTES
        while is_long and partly_read.offset < len(data):
            run = self._clear_run()
            count, offset, reason = chunk_walk.walk_messages(
                chunk, partly_read.offset, self._slot_of_channel, _LONG_BYTES, run
            )
            if reason == chunk_walk.AT_UNKNOWN or not self._reserve_run_memory(
                partly_read, run
            ):
                break  # the messages from `partly_read.offset` on are read one by one
            partly_read.messages += count
            partly_read.offset = offset
            yield from self._split_by_channel(chunk, count, run, is_kept)
            if reason == chunk_walk.AT_DEFINITION:
                opcode, begin, end = next(mcap_records.iterate_records(data, offset))
                self._read_definition(partly_read, opcode, begin, end)
                partly_read.offset = end

        is_completely_read = is_long and partly_read.offset == len(data)
        if is_completely_read:
            self._finish_record(partly_read, partly_read.messages, partly_read.memory)
            return
        for message in self._read_remaining_messages(partly_read):
            if is_kept(message.topic):
                yield _make_single_block(message)

    def _clear_run(self) -> chunk_walk.MessageRun:
        """Returns the output arrays for the next messages of a chunk, with all counts at 0.

        The large arrays are reused. There is one count per slot, a small integer that
        represents a channel.
        """
        sums = np.zeros((4, len(self._slots)), np.int64)
        self._run = self._run._replace(
            counts=sums[0], lengths=sums[1], excess=sums[2], firsts=sums[3]
        )
        return self._run

    def _reserve_run_memory(
        self, partly_read: "_PartlyReadRecord", run: chunk_walk.MessageRun
    ) -> bool:
        """Reserves memory for several messages, unless a channel would exceed its limit.

        The limit protects against files crafted to exhaust the memory. Messages of the session
        need more memory than others, because they will be decoded.

        Args:
            partly_read: The record that contains the messages, to which the memory is charged.
            run: The messages, counted by channel.

        Returns:
            True if the memory was reserved. False, with nothing changed, if a channel needs too
            much memory.
        """
        counts = run.counts.tolist()
        excess = run.excess.tolist()
        lengths = run.lengths.tolist()
        needed_bytes = {}
        for slot, channel in enumerate(self._slots):
            if channel in self._session_channels:
                size = _DECODED_BYTES * counts[slot] + _LONG_RATIO * excess[slot]
            else:
                size = _SKIPPED_BYTES * counts[slot] + lengths[slot]
            needed_bytes[channel] = size

        for channel, size in needed_bytes.items():
            if size > self._channel_memory_left[channel]:
                return False
        for channel, size in needed_bytes.items():
            self._channel_memory_left[channel] -= size
            partly_read.memory += size
        return True

    def _split_by_channel(
        self,
        chunk: NDArray[np.uint8],
        count: int,
        run: chunk_walk.MessageRun,
        is_kept: Callable[[str], bool],
    ) -> Iterator[MessageBlock]:
        """Yields the messages found in a chunk as one block per channel.

        The blocks are in the order in which the first message of each channel appears.

        Args:
            chunk: The uncompressed chunk.
            count: Number of messages that were found.
            run: Positions of these messages. Channels are identified by small indices (slots).
            is_kept: Function that returns True for the topics whose messages are wanted.
        """
        used_slots = np.flatnonzero(run.counts)
        by_first_message = np.argsort(run.firsts[used_slots])
        for slot in used_slots[by_first_message].tolist():
            topic = self._topics[self._slots[slot]]
            if is_kept(topic):
                yield MessageBlock(topic, chunk, run, count, slot)

    def judge_digest(self) -> Integrity:
        """Determines from the digests in the file whether the file was modified later.

        The file must have been read to its end.

        Returns:
            The result, with an explanation.
        """
        return self._chain.judge(
            self.metadata, finished=self.complete, damaged=bool(self.damaged)
        )

    @property
    def agrees_on_messages(self) -> bool:
        """True if the messages have not changed since the file was written.

        Compares the number of messages read, and the digest of these messages in order, with
        the number and digest stored in the file.
        """
        stated = self.metadata.get(DIGESTS, {})
        computed = self._chain.facts()
        return all(stated.get(key) == computed[key] for key in ("messages", "records"))

    def _define(self, opcode: int, content: bytes) -> None:
        """Stores the definition of a schema or a channel.

        A schema describes the fields of a kind of message, and a channel is a sequence of such
        messages. If the file defines the same number twice, the first definition counts.

        Raises:
            UnreadableRecord: The definition cannot be decoded.
        """
        self._chain.add_entry(opcode, content)
        record = mcap_records.parse_record(opcode, content)
        if opcode == Opcode.SCHEMA:
            self._schemas.setdefault(record.id, (record.name, record.encoding, record.data))
            return
        if record.id in self._topics:
            return

        topic = record.topic
        self._topics[record.id] = topic
        schema_name, schema_encoding, schema_data = self._schemas.get(
            record.schema_id, ("", "", b"")
        )
        info = ChannelInfo(
            topic=topic,
            encoding=record.message_encoding,
            schema=schema_name,
            schema_encoding=schema_encoding,
            metadata=record.metadata,
            schema_data=schema_data,
        )
        # A channel with a slot is read in blocks. If a topic has two channels, their messages
        # alternate and must be read one by one.
        if topic not in self.channels:
            self._slot_of_channel[record.id] = len(self._slots)
            self._slots.append(record.id)
        else:
            self._drop_slot(topic)
        self.channels.setdefault(topic, info)
        if topic.startswith("/trilat/"):
            self._session_channels.add(record.id)

    def _drop_slot(self, topic: str) -> None:
        """Makes `blocks` read the messages of a topic one by one instead of in blocks.

        This preserves their order if the topic has several channels. The compiled code then has
        no number (slot) for the channel, and stops at its messages.

        Args:
            topic: The topic.
        """
        for channel in self._slots:
            if self._topics[channel] == topic:
                self._slot_of_channel[channel] = -1

    def _stop_reading_channel(self, channel: int, frame: mcap_records.RecordFrame) -> None:
        """Stops reading a channel because its messages need too much memory.

        Reported once, as a damaged part of the file.

        Args:
            channel: Number of the channel.
            frame: The first record from which no messages of the channel are read.
        """
        is_stopped_already = self._channel_memory_left[channel] < 0.0
        if is_stopped_already:
            return
        self._channel_memory_left[channel] = -math.inf
        topic = self._topics.get(channel, f"channel {channel}")
        text = (
            f"{topic[:80]} needs too much memory for a file of this size; the rest of this "
            "channel is not read"
        )
        self._more_damage.append(mcap_records.Damage(frame.offset, frame.size, text))

    def _reserve_memory(self, amount: int, frame: mcap_records.RecordFrame) -> None:
        """Subtracts an amount from the memory that the contents of this file may still use.

        The limit is a multiple of the size of the file. It protects against small files crafted
        to fill the memory when they are decompressed.

        Args:
            amount: Memory in bytes.
            frame: The record that needs the memory.

        Raises:
            LogError: There is not enough memory left.
        """
        if self._memory_left is None:
            return
        self._memory_left -= amount
        if self._memory_left < 0:
            raise LogError(
                f"{self._source} needs too much memory for a file of "
                f"{count_nouns(self.size, 'byte')}: the data up to byte {frame.end} alone "
                f"would need more than {KEPT_RATIO} times the size of the file, and more than "
                f"{KEPT_BYTES >> 20} MiB"
            )


@dataclass
class _PartlyReadRecord:
    """A record of an MCAP file that contains messages, and how far it has been read.

    Attributes:
        frame: Kind and position of the record in the file.
        data: Uncompressed messages and definitions of the record.
        offset: Offset in `data` up to which they have been read.
        digested: Offset in `data` up to which they have been added to the digest (checksum).
        messages: Number of messages read so far.
        memory: Memory that these messages need, in bytes.
    """

    frame: mcap_records.RecordFrame
    data: bytes
    offset: int = 0
    digested: int = 0
    messages: int = 0
    memory: int = 0

"""Finds all messages in an uncompressed chunk of an MCAP file, in one pass of compiled code.

A chunk is a block of a log that is compressed as a unit and contains hundreds of messages of
all channels. `walk_messages` locates the messages, and `copy_payloads` collects those of one
channel.

Invariant:
    - The pass stops at any record that is neither a complete message of a known channel nor a
      record that readers ignore. The caller reads the rest record by record.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import leaf
from ..mcap_records import DEFINITIONS, MESSAGE_HEAD, OP_MESSAGE, RECORD_HEAD_BYTES
from .byte_words import copy_bytes, load_little
from .packed_messages import Bytes, Ints

_SCHEMA, _CHANNEL = map(int, DEFINITIONS)
_MESSAGE_HEAD_BYTES = MESSAGE_HEAD.size
# Offsets in the head of a message, which begins with the channel.
_LOG_TIME = 6
_PUBLISH_TIME = _LOG_TIME + 8

CAPACITY = 1 << 13
"""Maximum number of messages found in one walk."""
MOST_CHANNELS = 1 << 16
"""Number of different channels that the header of a message can represent."""

WALKED = 0
"""The walk ended at the end of the chunk, or after `CAPACITY` messages."""
AT_DEFINITION = 1
"""The walk ended at a record that defines a schema or a channel."""
AT_UNKNOWN = 2
"""The walk ended at an incomplete record, or at a message of an unknown channel."""


class MessageRun(NamedTuple):
    """The messages found in one pass over an uncompressed chunk, with totals per channel.

    Channels are represented by small integers, called slots. Each array has one entry per
    message or one entry per slot.

    Attributes:
        slots: Slot of each message's channel.
        begins: Offset in the chunk of the first byte of each payload.
        ends: Offset in the chunk after the last byte of each payload.
        log_ns: Arrival time of each message at the recorder in Unix time, in ns, as a signed
            integer.
        publish_ns: Sending time of each message, in the same format.
        counts: Number of messages, per slot.
        lengths: Total length of the messages including their headers, per slot, in bytes.
        excess: Total of the lengths beyond a limit, per slot, in bytes.
        firsts: Index of the first message, for each slot with messages.
    """

    slots: NDArray[np.int32]
    begins: Ints
    ends: Ints
    log_ns: Ints
    publish_ns: Ints
    counts: Ints
    lengths: Ints
    excess: Ints
    firsts: Ints

    @classmethod
    def allocate(cls, slots: int, messages: int = 1) -> "MessageRun":
        """Allocates empty arrays for the messages found in one call of `walk_messages`.

        Args:
            slots: Number of slots (small integers that represent the channels).
            messages: Maximum number of messages.
        """
        places = [np.zeros(messages, np.int64) for _ in range(4)]
        sums = [np.zeros(slots, np.int64) for _ in range(4)]
        return cls(np.zeros(messages, np.int32), *places, *sums)


@leaf
def walk_messages(
    data: Bytes, offset: int, slot_of_channel: NDArray[np.int32], long_bytes: int, run: Any
) -> tuple[int, int, int]:
    """Finds the messages in an uncompressed chunk, starting at a given offset.

    This compiled function stops at the first record that is neither a message of a known
    channel nor a record to ignore, and after `CAPACITY` messages.

    Args:
        data: The uncompressed chunk.
        offset: Offset of the first record to read.
        slot_of_channel: Slot of each channel, indexed by channel number; -1 for an unknown
            channel.
        long_bytes: Length beyond which the bytes of a message count as excess.
        run: `MessageRun` in which the messages are stored. Its totals are increased.

    Returns:
        The number of messages, the offset of the next record, and the reason for stopping:
            `WALKED`, `AT_DEFINITION` or `AT_UNKNOWN`.
    """
    size = data.shape[0]
    count = 0
    while offset < size and count < run.slots.shape[0]:
        begin = offset + RECORD_HEAD_BYTES
        if begin > size:
            return count, offset, AT_UNKNOWN
        length = load_little(data, offset + 1)
        if length < 0 or length > size - begin:
            return count, offset, AT_UNKNOWN
        opcode = data[offset]
        if opcode == OP_MESSAGE:
            if length < _MESSAGE_HEAD_BYTES:
                return count, offset, AT_UNKNOWN
            channel = int(data[begin]) + 256 * int(data[begin + 1])
            slot = slot_of_channel[channel]
            if slot < 0:
                return count, offset, AT_UNKNOWN
            run.slots[count] = slot
            run.begins[count] = begin + _MESSAGE_HEAD_BYTES
            run.ends[count] = begin + length
            run.log_ns[count] = load_little(data, begin + _LOG_TIME)
            run.publish_ns[count] = load_little(data, begin + _PUBLISH_TIME)
            if run.counts[slot] == 0:
                run.firsts[slot] = count
            run.counts[slot] += 1
            run.lengths[slot] += length
            run.excess[slot] += max(0, length - long_bytes)
            count += 1
        elif opcode in (_SCHEMA, _CHANNEL):
            return count, offset, AT_DEFINITION
        offset = begin + length
    return count, offset, WALKED


@leaf
def copy_payloads(
    data: Bytes,
    count: int,
    slot: int,
    run: Any,
    payloads: Bytes,
    offset: int,
    ends: Ints,
    times: Ints,
) -> None:
    """Copies the payloads of one channel out of a chunk, one after another.

    A chunk contains the messages of all channels, in order of arrival.

    Args:
        data: The uncompressed chunk.
        count: Number of messages found by `walk_messages`.
        slot: Small integer that represents the channel.
        run: The `MessageRun` filled by `walk_messages`.
        payloads: Output array for the payloads, stored one after another.
        offset: Offset in `payloads` of the first payload.
        ends: Output array for the offset in `payloads` after each payload, shape (messages,).
        times: Output array for the arrival and sending times, shape (2, messages).
    """
    number = 0
    for n in range(count):
        if run.slots[n] != slot:
            continue
        begin = run.begins[n]
        length = run.ends[n] - begin
        copy_bytes(data, begin, payloads, offset, length)
        offset += length
        ends[number] = offset
        times[0, number] = run.log_ns[n]
        times[1, number] = run.publish_ns[n]
        number += 1

"""Blocks of messages are the messages, whatever has happened to the file."""

import io
import random
from collections import defaultdict
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from tests.log.builders import edit_log_bytes, make_log_bytes
from tests.log.hostility import CHANGES, mangle_log
from trilat_net.errors import LogError
from trilat_net.log import mcap_reader
from trilat_net.log.log_contents import ChannelMessages
from trilat_net.log.mcap_reader import McapReader

WHOLE = make_log_bytes("paper")
MANY_CHUNKS = edit_log_bytes(WHOLE, chunk_bytes=8192)
Contents = dict[str, list[tuple[bytes, int, int]]]


def describe_outcome(reader: McapReader, messages: Contents, problem: str) -> tuple[Any, ...]:
    """All that a reader has found out."""
    return (
        list(messages.items()),
        problem,
        [str(damage) for damage in reader.damaged],
        str(reader.torn),
        reader.complete,
        reader.metadata,
        reader.channels,
        reader.judge_digest(),
    )


def read_singly(data: bytes) -> tuple[Any, ...]:
    reader = McapReader(io.BytesIO(data), "log")
    messages: Contents = defaultdict(list)
    problem = ""
    try:
        for topic, payload, log_ns, publish_ns, _ in reader.messages():
            if topic.startswith("/trilat/"):
                messages[topic].append((payload, log_ns, publish_ns))
    except LogError as error:
        problem = str(error)
    return describe_outcome(reader, messages, problem)


def read_in_blocks(data: bytes) -> tuple[Any, ...]:
    reader = McapReader(io.BytesIO(data), "log")
    channels: dict[str, ChannelMessages] = defaultdict(ChannelMessages)
    problem = ""
    try:
        for block in reader.blocks(lambda topic: topic.startswith("/trilat/")):
            channels[block.topic].add_block(block)
    except LogError as error:
        problem = str(error)
    messages = {
        topic: list(zip(channel.payloads, channel.log_ns, channel.publish_ns, strict=True))
        for topic, channel in channels.items()
    }
    return describe_outcome(reader, messages, problem)


@pytest.mark.parametrize("change", dict.fromkeys(CHANGES), ids=lambda change: change.__name__)
@settings(max_examples=8)
@given(seed=st.integers(0, 2**32))
def test_blocks_of_a_changed_file_are_its_messages(change: Any, seed: int) -> None:
    for data in (WHOLE, MANY_CHUNKS):
        changed = change(data, random.Random(seed))
        assert read_in_blocks(changed) == read_singly(changed)
    changed = mangle_log(WHOLE, random.Random(seed))
    assert read_in_blocks(changed) == read_singly(changed)


def make_message_bytes(
    messages: list[tuple[str, int, bytes]], topics: list[str], chunk_bytes: int = 1 << 20
) -> bytes:
    """A file in which every topic of a list has a channel, and may have several."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk_bytes)
    writer.start()
    channels = [writer.register_channel(topic, "msgpack", 0) for topic in topics]
    late_topic = ""
    for topic, number, payload in messages:
        if topic == "/late" and not late_topic:
            late_topic = topic
            channels.append(writer.register_channel("/trilat/late/m1/state", "msgpack", 0))
        channel = channels[number % len(channels)]
        writer.add_message(channel, number, payload, 2**64 - 1 - number)
    writer.finish()
    return stream.getvalue()


def test_two_channels_of_a_topic_keep_their_order() -> None:
    topics = ["/trilat/s/m1/state", "/trilat/s/m2/state", "/trilat/s/m1/state", "/other"]
    messages = [("", n, b"%d" % n + bytes(n % 50)) for n in range(4000)]
    data = make_message_bytes(messages, topics)
    assert read_in_blocks(data) == read_singly(data)


def test_a_channel_may_begin_within_a_chunk() -> None:
    messages = [("/late" if n == 2000 else "", n, bytes(20)) for n in range(4000)]
    data = make_message_bytes(messages, ["/trilat/s/m1/state", "/other"])
    content = read_in_blocks(data)
    assert content == read_singly(data)
    assert {topic for topic, _ in content[0]} == {"/trilat/s/m1/state", "/trilat/late/m1/state"}


def test_too_large_channel_is_cut_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mcap_reader, "KEPT_BYTES", 1 << 20)
    monkeypatch.setattr(mcap_reader, "KEPT_RATIO", 1)
    content = read_in_blocks(WHOLE)
    assert content == read_singly(WHOLE)
    damaged = content[2]
    assert any("needs too much memory" in text for text in damaged)


def test_messages_can_follow_those_that_were_read() -> None:
    channel = ChannelMessages()
    channel.add(b"first", 1, 2)
    before = channel.payloads
    channel.add(b"", 3, 4)
    channel.add(b"third", 5, 6)
    assert list(before) == [b"first"]
    assert channel.payloads == [b"first", b"", b"third"]
    assert channel.payloads[1:] == [b"", b"third"]
    assert [channel.payload(n) for n in range(len(channel))] == [b"first", b"", b"third"]


@pytest.mark.parametrize("kept_chunks", range(1, 6))
def test_a_channels_memory_adds_up_over_chunks(
    kept_chunks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A channel that fits in each chunk alone is still cut where all chunks together do not fit."""
    topics = ["/trilat/s/m1/state"]
    data = make_message_bytes([("", n, bytes(50)) for n in range(1000)], topics, 8192)
    messages_in_chunk = 8192 // (50 + 31)
    kept_count = messages_in_chunk * kept_chunks
    kept_bytes = mcap_reader._DECODED_BYTES * kept_count
    monkeypatch.setattr(mcap_reader, "KEPT_BYTES", int(kept_bytes / mcap_reader._CHANNEL_SHARE))
    monkeypatch.setattr(mcap_reader, "KEPT_RATIO", 1)
    content = read_in_blocks(data)
    ((_, messages),) = content[0]
    assert kept_count - 1 <= len(messages) <= kept_count
    assert content == read_singly(data)

"""What we write is what the `mcap` package reads, and what its own writer would have said."""

import io
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from trilat_net.log.mcap_writer import McapWriter

U64 = st.integers(0, 2**64 - 1)
TEXTS = st.dictionaries(st.text(max_size=8), st.text(max_size=8), max_size=3)
MESSAGES = st.tuples(
    st.just("add_message"),
    st.integers(1, 3),
    U64,
    st.binary(max_size=80),
    U64,
    st.integers(0, 2**32 - 1),
)
METADATA = st.tuples(st.just("add_metadata"), st.text(max_size=8), TEXTS)
ATTACHMENTS = st.tuples(
    st.just("add_attachment"),
    U64,
    U64,
    st.text(max_size=5),
    st.text(max_size=5),
    st.binary(max_size=50),
)
CALLS = st.lists(
    st.one_of(MESSAGES, MESSAGES, MESSAGES, METADATA, ATTACHMENTS, st.tuples(st.just("flush")))
)


def begin_container(file: Any) -> None:
    """Gives a file of either writer the same channels."""
    schema = file.register_schema("S", "jsonschema", b'{"type": "object"}')
    for name in "abc":
        file.register_channel(f"/{name}", "msgpack", schema, {"what": name})


def write_by_ours(calls: list[tuple[Any, ...]], chunk_bytes: int) -> bytes:
    stream = io.BytesIO()
    file = McapWriter(stream, "lib", chunk_bytes=chunk_bytes)
    begin_container(file)
    for name, *arguments in calls:
        getattr(file, name)(*arguments)
        assert file.position == stream.tell()
    most = file.position + file.open_chunk_bytes + file.end_bytes
    file.finish()
    assert len(stream.getvalue()) == file.position <= most
    return stream.getvalue()


def write_by_mcap(calls: list[tuple[Any, ...]], chunk_bytes: int) -> bytes:
    stream = io.BytesIO()
    file = Writer(stream, chunk_size=chunk_bytes)
    file.start(library="lib")
    begin_container(file)
    for name, *arguments in calls:
        getattr(file, name)(*arguments)
    file.finish()
    return stream.getvalue()


def read_content(data: bytes) -> dict[str, Any]:
    """All that the `mcap` package finds, by way of the index."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    return {
        "messages": list(reader.iter_messages()),
        "of b": list(reader.iter_messages(topics=["/b"])),
        "metadata": list(reader.iter_metadata()),
        "attachments": list(reader.iter_attachments()),
        "schemas": summary.schemas,
        "channels": summary.channels,
        "counts": dict(statistics.channel_message_counts),
        # theirs has schemas and channels in its first chunk, which is therefore full earlier
        "statistics": {**vars(statistics), "channel_message_counts": None, "chunk_count": None},
        "header": reader.get_header(),
    }


@settings(max_examples=40)
@given(calls=CALLS, chunk_bytes=st.sampled_from([1, 200, 1 << 20]))
def test_files_equal_those_of_mcaps_writer(
    calls: list[tuple[Any, ...]], chunk_bytes: int
) -> None:
    content = read_content(write_by_ours(calls, chunk_bytes))
    expected = read_content(write_by_mcap(calls, chunk_bytes))
    assert content == expected


@settings(max_examples=20)
@given(calls=CALLS)
def test_the_same_calls_give_the_same_bytes(
    calls: list[tuple[Any, ...]],
) -> None:
    data = write_by_ours(calls, 200)
    assert write_by_ours(calls, 200) == data
    records = list(StreamReader(io.BytesIO(data), validate_crcs=True).records)
    payloads = [call[3] for call in calls if call[0] == "add_message"]
    assert [record.data for record in records if type(record).__name__ == "Message"] == payloads


def test_late_channels_precede_waiting_messages() -> None:
    stream = io.BytesIO()
    file = McapWriter(stream, "lib")
    begin_container(file)
    file.add_message(1, 5, b"x", 5)
    late = file.register_channel("/late", "json", 0)
    file.add_message(late, 6, b"{}", 6)
    file.finish()
    reader = make_reader(io.BytesIO(stream.getvalue()))
    messages = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
    assert messages == [("/a", b"x"), ("/late", b"{}")]


def test_chunk_indices_take_bytes_without_objects() -> None:
    """Memory: 36 000 chunks an hour must be some megabytes."""
    file = McapWriter(io.BytesIO(), "lib")
    schema = file.register_schema("S", "jsonschema", b"{}")
    channels = [file.register_channel(f"/{n}", "msgpack", schema) for n in range(12)]
    before = file.end_bytes
    for k in range(100):
        for channel in channels:
            file.add_message(channel, k, b"x", k)
        file.flush()
    assert (file.end_bytes - before) / 100 < 250

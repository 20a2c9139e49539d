"""Walking through a file: all that is whole is found, what is not is named, and nothing is believed."""

import io
import struct

import lz4.frame
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from tests.log.builders import edit_log_bytes, make_log_bytes
from tests.log.hostility import make_chunk
from trilat_net.errors import LogError
from trilat_net.log import mcap_reader, mcap_records
from trilat_net.log.mcap_reader import McapMessage, McapReader
from trilat_net.log.mcap_records import (
    MAGIC,
    RECORD_HEAD_BYTES,
    Damage,
    RecordFrame,
    RecordScanner,
    ScannedRecord,
    UnreadableRecord,
    unpack_chunk,
)

DATA = edit_log_bytes(make_log_bytes("paper"), chunk_bytes=4096)
FRAMES = list(RecordScanner(io.BytesIO(DATA)).frames())
CHUNKS = [frame for frame in FRAMES if frame.opcode == Opcode.CHUNK]


def read_walked(data: bytes) -> tuple[McapReader, list[McapMessage]]:
    walk = McapReader(io.BytesIO(data), "file")
    return walk, list(walk.messages())


WALK, ITEMS = read_walked(DATA)


def in_chunk(frame: RecordFrame) -> list[McapMessage]:
    """The messages of one chunk: what is in the file with it, without those without it."""
    _, others = read_walked(DATA[: frame.offset] + DATA[frame.end :])
    return [item for item in ITEMS if item not in others]


def test_messages_come_with_their_times_and_their_numbers() -> None:
    """A message is what the `mcap` package reads, in the order of the file."""
    from mcap.reader import make_reader

    theirs = [
        (c.topic, m.data, m.log_time, m.publish_time, m.sequence)
        for _, c, m in make_reader(io.BytesIO(DATA)).iter_messages(log_time_order=False)
    ]
    assert [tuple(item) for item in ITEMS] == theirs
    assert WALK.complete
    assert not WALK.damaged
    assert WALK.torn is None
    assert sum(WALK.chunks.values()) == len(CHUNKS)
    assert {channel.encoding for channel in WALK.channels.values()} == {"msgpack"}


@settings(max_examples=30)
@given(st.integers(0, len(DATA) - 1))
def test_torn_files_give_every_whole_chunk(size: int) -> None:
    """Wherever it is cut, what lies in whole chunks before is read, and the cut is told."""
    whole = [frame for frame in CHUNKS if frame.end <= size]
    if size < 8:
        with pytest.raises(LogError, match="not an MCAP file"):
            read_walked(DATA[:size])
        return
    walk, items = read_walked(DATA[:size])
    assert not walk.complete
    assert walk.torn is not None or size == FRAMES[-1].end
    assert sum(walk.chunks.values()) == len(whole)
    assert items == ITEMS[: len(items)]


def overwrite_bytes(offset: int, foreign: bytes) -> bytes:
    return DATA[:offset] + foreign + DATA[offset + len(foreign) :]


OFFSETS = st.integers(len(MAGIC), len(DATA) - 1)
FOREIGN = st.binary(min_size=1, max_size=300)


@settings(max_examples=40)
@given(OFFSETS, FOREIGN)
def test_scans_omit_no_byte(offset: int, foreign: bytes) -> None:
    """Records and damaged parts follow each other without a gap up to the end mark."""
    data = overwrite_bytes(offset, foreign)
    scanner = RecordScanner(io.BytesIO(data))
    damaged = []
    covered = len(MAGIC)
    for item in scanner.scan():
        if isinstance(item, Damage):
            damaged.append(item)
            begin = item.offset
            end = item.offset + item.length
        else:
            begin = item.frame.offset
            end = item.frame.end
            assert item.content == data[begin + RECORD_HEAD_BYTES : end]
        assert begin <= covered
        covered = max(covered, end)
    assert damaged == scanner.damaged
    if scanner.torn is not None:
        assert scanner.torn.offset <= covered
        covered = scanner.torn.offset + scanner.torn.length
        assert covered == len(data)
    else:
        footer_bytes = FRAMES[-1].size
        rest = len(data) - covered - scanner.trailing - len(MAGIC)
        assert rest in (0, footer_bytes)


@settings(max_examples=20)
@given(OFFSETS, FOREIGN)
def test_both_ways_of_reading_agree(offset: int, foreign: bytes) -> None:
    """Who reads the messages alone, and who scans the records, finds the same in a damaged file."""
    data = overwrite_bytes(offset, foreign)
    walk, items = read_walked(data)
    scan = McapReader(io.BytesIO(data), "file")
    scanned = [
        message
        for record in scan.scan()
        if isinstance(record, ScannedRecord)
        for message in scan.read_record(record)
    ]
    assert scanned == items
    assert set(scan.damaged) == set(walk.damaged)
    assert (scan.torn, scan.complete) == (walk.torn, walk.complete)
    assert (scan.metadata, scan.attachments) == (walk.metadata, walk.attachments)
    assert scan.judge_digest() == walk.judge_digest()


@settings(max_examples=20)
@given(st.integers(0, len(CHUNKS) - 1), st.data())
def test_a_damaged_chunk_is_passed_over_and_named(number: int, data: st.DataObject) -> None:
    """A bit that is wrong in the data of a chunk costs that chunk, and no other."""
    frame = CHUNKS[number]
    head = RecordScanner(io.BytesIO(DATA)).head(frame)
    place = data.draw(
        st.integers(frame.offset + RECORD_HEAD_BYTES + head.data_offset, frame.end - 1)
    )
    changed = bytearray(DATA)
    changed[place] ^= 1 << data.draw(st.integers(0, 7))
    walk, items = read_walked(bytes(changed))
    if not walk.damaged:  # a bit that the compression does not look at
        assert items == ITEMS
        return
    assert [(part.offset, part.length) for part in walk.damaged] == [
        (frame.offset, RECORD_HEAD_BYTES + frame.length)
    ]
    assert walk.complete
    assert [item for item in ITEMS if item not in items] == in_chunk(frame)


@settings(max_examples=30)
@given(st.sampled_from(FRAMES), st.integers(0, (1 << 64) - 1))
def test_a_false_record_length_hides_few_chunks(frame: RecordFrame, length: int) -> None:
    """Reading goes on at the next chunk that makes sense, and what is between is named."""
    changed = bytearray(DATA)
    struct.pack_into("<Q", changed, frame.offset + 1, length)
    try:
        walk, items = read_walked(bytes(changed))
    except LogError:
        return
    is_reported = length in (frame.length,) or walk.damaged or walk.torn is not None
    # within the file it may skip what is whole, or look like a longer record
    near = length < len(DATA)
    assert is_reported or near
    if length > len(DATA) and frame.opcode != Opcode.FOOTER:
        hidden = in_chunk(frame) if frame.opcode == Opcode.CHUNK else []
        assert [item for item in ITEMS if item not in items] == hidden


def test_chunks_unpack_within_their_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """However it is packed, and whatever it says: nothing is unpacked beyond the limit."""
    monkeypatch.setattr(mcap_records, "MAX_UNPACKED_BYTES", 10_000)
    fine = bytes(10_000)
    bomb = bytes(1_000_000)
    for compression in ("zstd", "lz4", ""):
        assert (
            unpack_chunk(make_chunk(fine, compression=compression)[RECORD_HEAD_BYTES:]) == fine
        )
    for compression in ("zstd", "lz4"):
        for size in (len(bomb), 10_000, 1 << 62, 0):
            with pytest.raises(UnreadableRecord):
                unpack_chunk(
                    make_chunk(bomb, size=size, compression=compression)[RECORD_HEAD_BYTES:]
                )


@pytest.mark.parametrize("claim", [1 << 40, (1 << 63) - 1])
def test_frames_claiming_huge_sizes_are_refused(claim: int) -> None:
    """The sizes inside the compressed data are compared before a byte is set aside for them."""
    zstd = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", claim) + b"\x01\x00\x00"
    head = (
        struct.pack("<QQQI", 0, 0, 100, 0)
        + struct.pack("<I", 4)
        + b"zstd"
        + struct.pack("<Q", len(zstd))
    )
    with pytest.raises(UnreadableRecord):
        unpack_chunk(head + zstd)
    honest = lz4.frame.compress(bytes(100), store_size=True)
    lz4_ = honest[:6] + struct.pack("<Q", claim) + honest[14:]
    head = (
        struct.pack("<QQQI", 0, 0, 100, 0)
        + struct.pack("<I", 3)
        + b"lz4"
        + struct.pack("<Q", len(lz4_))
    )
    with pytest.raises(UnreadableRecord):
        unpack_chunk(head + lz4_)


def test_absurd_contents_are_refused_with_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Who keeps messages is given no more than there is room for; who lets them go is given all."""
    monkeypatch.setattr(mcap_reader, "KEPT_BYTES", 1 << 20)
    bombs = b"".join(
        make_chunk(struct.pack("<BQHIQQ", 5, 22, n, 0, 0, 0) * 48_000) for n in range(1, 6)
    )
    data = DATA[: CHUNKS[1].offset] + bombs + DATA[CHUNKS[1].offset :]
    with pytest.raises(
        LogError,
        match=r"file needs too much memory for a file of \d+ bytes: the data up to byte \d+",
    ):
        read_walked(data)
    streaming = McapReader(io.BytesIO(data), "file", kept=False)
    assert sum(1 for _ in streaming.messages()) == len(ITEMS) + 240_000


def test_an_absurdly_large_channel_ends_there_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One odd channel does not make a log unreadable; what is left out of it is said, once."""
    monkeypatch.setattr(mcap_reader, "KEPT_BYTES", 16 << 20)
    bomb = make_chunk(struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0) * 80_000)
    data = DATA[: CHUNKS[1].offset] + bomb + bomb + DATA[CHUNKS[1].offset :]
    reader = McapReader(io.BytesIO(data), "file")
    read = list(reader.messages())
    odd = next(iter(reader.channels))
    others = [item for item in ITEMS if item.topic != odd]
    assert [item for item in read if item.topic != odd] == others
    assert len(read) < len(ITEMS) + 160_000
    (cut,) = reader.damaged
    assert cut.offset == CHUNKS[1].offset
    assert odd in cut.problem


def test_resting_arms_are_never_absurd(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The hands of `outage` do not push before 3 s, and its arms know their weight."""
    monkeypatch.setattr(mcap_reader, "KEPT_BYTES", 0)
    stream = io.BytesIO(make_log_bytes("outage", {"duration_s": 1.0}))
    assert sum(1 for _ in McapReader(stream, "log").messages()) > 3000


def test_a_chunk_within_a_chunk_is_not_read() -> None:
    inner = make_chunk(struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0))
    data = DATA[: CHUNKS[1].offset] + make_chunk(inner) + DATA[CHUNKS[1].offset :]
    assert read_walked(data)[1] == ITEMS


def test_channels_keep_their_first_definition() -> None:
    """A second definition of its number changes nothing; a message of no channel has no topic."""

    def channel(number: int, topic: bytes) -> bytes:
        text = struct.pack("<HH", number, 0) + struct.pack("<I", len(topic)) + topic
        content = text + struct.pack("<I", 0) + struct.pack("<I", 0)
        return struct.pack("<BQ", 4, len(content)) + content

    message = struct.pack("<BQHIQQ", 5, 23, 7, 1, 2, 3) + b"x"
    lost = struct.pack("<BQHIQQ", 5, 22, 9, 1, 2, 3)
    data = DATA[: CHUNKS[0].offset] + make_chunk(
        channel(7, b"/a") + message + channel(7, b"/b") + message + lost
    )
    _, items = read_walked(data)
    assert items == [
        McapMessage("/a", b"x", 2, 3, 1),
        McapMessage("/a", b"x", 2, 3, 1),
        McapMessage("", b"", 2, 3, 1),
    ]


def test_an_attachment_whose_checksum_differs_is_damaged() -> None:
    frame = next(frame for frame in FRAMES if frame.opcode == Opcode.ATTACHMENT)
    changed = bytearray(DATA)
    changed[frame.end - 100] ^= 1
    walk, items = read_walked(bytes(changed))
    assert "scenario.toml" not in walk.attachments
    assert [part.offset for part in walk.damaged] == [frame.offset]
    assert items == ITEMS


def test_progress_is_reported_up_to_the_end() -> None:
    progress: list[tuple[int, int]] = []
    list(McapReader(io.BytesIO(DATA), "file", lambda *sizes: progress.append(sizes)).messages())
    assert progress == sorted(progress)
    assert {total for _, total in progress} == {len(DATA)}
    assert progress[-1][0] >= len(DATA) - 8


def test_zstd_frames_without_size_are_read() -> None:
    """Other writers stream; their chunks say the size, their frames do not."""
    records = bytes(range(256)) * 10
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(records)
    head = struct.pack("<QQQI", 0, 0, len(records), 0) + struct.pack("<I", 4) + b"zstd"
    assert unpack_chunk(head + struct.pack("<Q", len(streamed)) + streamed) == records

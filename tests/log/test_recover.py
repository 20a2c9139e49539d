"""`recover`: what can be read is kept byte for byte, what cannot is told, nothing is made up."""

import io
import json
import os
import struct
import tracemalloc
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import McapReader, make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from tests.cli.running import trilat
from tests.log.builders import drop_records, edit_log_bytes, make_log, make_log_bytes, write_log
from tests.log.hostility import make_chunk as packed_chunk
from tests.log.split_logs import (
    Message,
    make_bytes_of_messages,
    make_foreign_bytes,
    read_messages,
)
from tests.log.surgery import take_apart
from trilat_net.errors import LogError, NothingSaved, UsageError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_layout import active_path
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.log.recovery import Recovery, recover, recovered_path
from trilat_net.log.running_digest import DigestState

anywhere = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=12
)
positions = st.floats(0, 1, exclude_max=True)


pytestmark = pytest.mark.usefixtures("unsynced")


class Chunk(NamedTuple):
    """A chunk of a whole file: where it lies, and its messages."""

    begin: int
    end: int
    messages: list[Message]


def list_chunks(data: bytes) -> list[Chunk]:
    """The chunks of a whole file, by its index."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    messages = iter(read_messages(data))
    all_chunks = []
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        begin = index.chunk_start_offset
        length = index.chunk_length
        entries = 0
        at = begin + length
        while at < begin + length + index.message_index_length:
            (size,) = struct.unpack_from("<Q", data, at + 1)
            entries += (size - 6) // 16
            at += 9 + size
        all_chunks.append(
            Chunk(begin, begin + length, [next(messages) for _ in range(entries)])
        )
    return all_chunks


@cache
def make_chunked_bytes() -> bytes:
    """A log of twenty chunks, as it is written today."""
    whole = make_log("paper")
    stream = io.BytesIO()
    writer = LogWriter(stream, whole.scenario, "paper", "virtual", 0, collect_provenance())
    for n, message in enumerate(read_messages(make_log_bytes("paper"))):
        topic, payload, log_ns, publish_ns, sequence = message
        writer.add(topic[1:], payload, publish_ns, log_ns, sequence)
        if n % 18 == 17:
            writer.flush()
    writer.finish(whole.accounts)
    return stream.getvalue()


@cache
def make_earlier_bytes() -> bytes:
    """The same by `mcap.Writer`: schemas and channels stand in the first chunk and at the end."""
    return edit_log_bytes(make_log_bytes("paper"), chunk_bytes=8000)


LOGS = st.sampled_from([make_chunked_bytes, make_earlier_bytes])


def recover_bytes(
    data: bytes, folder: Path, name: str = "run.mcap.active"
) -> tuple[Recovery, bytes]:
    """Returns the recovery of a file with the given bytes, and the bytes of the new file."""
    for path in folder.iterdir():
        path.unlink()
    path = folder / name
    path.write_bytes(data)
    result = recover(path)
    assert path.read_bytes() == data
    assert sorted(folder.iterdir()) == sorted({path, result.output})
    return result, result.output.read_bytes()


@anywhere
@given(made_by=LOGS, share=positions)
@example(made_by=make_chunked_bytes, share=0.0)
@example(made_by=make_earlier_bytes, share=0.65625)
def test_cut_files_keep_every_whole_chunk(
    made_by: Callable[[], bytes], share: float, tmp_path: Path
) -> None:
    data = made_by()
    end = int(share * len(data))
    whole = [chunk for chunk in list_chunks(data) if chunk.end <= end]
    kept = [message for chunk in whole for message in chunk.messages]
    try:
        result, saved = recover_bytes(data[:end], tmp_path)
    except NothingSaved:
        assert not kept
        return
    recovered = read_messages(saved)
    assert recovered[: len(kept)] == kept
    assert recovered == read_messages(data)[: len(recovered)]
    assert result.salvaged == len(recovered) - len(kept)
    if any(chunk.begin < end < chunk.end for chunk in list_chunks(data)):
        assert not result.lossless
    # before the accounts
    elif list_chunks(data)[0].end <= end <= data.find(b"trilat.accounts") - 13:
        assert result.lossless, result.lost
    assert result.finished == (end == len(data))
    if len(recovered):
        again = open_log(tmp_path / "run.mcap")
        assert again.complete
        verdict = verify_log(again)
        assert verdict.agreed
        assert verdict.records == sum(len(again[name]) for name in again.sites)


@anywhere
@given(
    made_by=LOGS,
    flips=st.lists(st.tuples(positions, st.integers(1, 255)), min_size=1, max_size=3),
)
def test_damaged_files_keep_every_intact_chunk(
    made_by: Callable[[], bytes], flips: list[tuple[float, int]], tmp_path: Path
) -> None:
    whole = made_by()
    data = bytearray(whole)
    places = {int(share * len(data)) for share, _ in flips}
    for place, (_, flip) in zip(places, flips, strict=False):
        data[place] ^= flip
    intact = [
        message
        for chunk in list_chunks(whole)
        if not any(chunk.begin <= place < chunk.end for place in places)
        for message in chunk.messages
    ]
    result, saved = recover_bytes(bytes(data), tmp_path, "run.mcap")
    recovered = read_messages(saved)
    summary_begins = list_chunks(whole)[-1].end
    # what names the channels may be damaged twice
    if any(place >= summary_begins for place in places):
        intact = [message._replace(topic="") for message in intact]
        recovered = [message._replace(topic="") for message in recovered]
    rest = iter(recovered)
    assert all(message in rest for message in intact)  # in order
    assert {message[1:] for message in recovered} <= {
        message[1:] for message in read_messages(whole)
    }
    if len(recovered) < len(read_messages(whole)):
        assert not result.lossless


def list_definitions(reader: McapReader) -> tuple[list[Any], list[Any]]:
    """Returns the channels and the schemas in the summary of a file."""
    summary = reader.get_summary()
    assert summary is not None
    channels = [
        (channel.topic, channel.message_encoding, sorted(channel.metadata.items()))
        for channel in summary.channels.values()
    ]
    schemas = [
        (schema.name, schema.encoding, schema.data) for schema in summary.schemas.values()
    ]
    return sorted(channels), sorted(schemas)


def test_a_whole_file_loses_nothing(tmp_path: Path) -> None:
    data = make_chunked_bytes()
    result, saved = recover_bytes(data, tmp_path, "run.mcap")
    assert (result.lossless, result.finished, result.missing) == (True, True, [])
    assert result.output == tmp_path / "run.recovered.mcap"
    assert read_messages(saved) == read_messages(data)
    assert result.coverage.judged == {"m1": 120, "m2": 120, "s": 120}
    old, new = (make_reader(io.BytesIO(each)) for each in (data, saved))
    assert list(old.iter_attachments()) == list(new.iter_attachments())
    before, after = ({e.name: e.metadata for e in each.iter_metadata()} for each in (old, new))
    assert after["trilat.session"] == before["trilat.session"]
    assert (after["trilat.recovered"]["lost"], after["trilat.recovered"]["from"]) == (
        "nothing",
        "run.mcap",
    )
    assert set(after["trilat.accounts"]) == set(before["trilat.accounts"])
    assert all("missing 0" in account for account in after["trilat.accounts"].values())
    assert list_definitions(old) == list_definitions(new)


def test_missing_records_are_counted_by_site(tmp_path: Path) -> None:
    gone = set(range(30, 50)) | {70}
    data = edit_log_bytes(
        make_log_bytes("paper"), record=drop_records("m2", gone), chunk_bytes=8000
    )
    result, saved = recover_bytes(data, tmp_path, "run.mcap")
    assert result.lossless  # what was never in the file was not lost with it
    assert result.missing == ["m2: 21 of 120 records: 30-49 70-70"]
    metadata = {e.name: e.metadata for e in make_reader(io.BytesIO(saved)).iter_metadata()}
    account = metadata["trilat.accounts"]["/trilat/paper/m2/state"]
    assert "received 99, missing 21" in account
    assert "30-49 70-70" in account
    assert metadata["trilat.recovered"]["missing"] == result.missing[0]


def test_lost_chunks_are_reported_with_their_ticks(tmp_path: Path) -> None:
    data = bytearray(make_chunked_bytes())
    chunk = list_chunks(make_chunked_bytes())[5]
    data[(chunk.begin + chunk.end) // 2] ^= 1
    result, saved = recover_bytes(bytes(data), tmp_path, "run.mcap")
    assert len(result.lost) == 1
    assert f"at byte {chunk.begin}" in result.lost[0]
    assert result.lost_bytes == chunk.end - chunk.begin
    ticks = [m.sequence for m in chunk.messages if m.topic == "/trilat/paper/m1/state"]
    assert f"m1: {len(ticks)} of 120 records: {ticks[0]}-{ticks[-1]}" in result.missing
    assert len(read_messages(saved)) == len(read_messages(make_chunked_bytes())) - len(
        chunk.messages
    )


def of_others(compression: CompressionType, chunked: bool) -> bytes:
    """A file of another program."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=500, compression=compression, use_chunking=chunked)
    writer.start(profile="ros1", library="theirs")
    schema = writer.register_schema("S", "jsonschema", b"{}")
    channels = [
        writer.register_channel("/a", "json", schema),
        writer.register_channel("/b", "raw", 0),
    ]
    for k in range(60):
        writer.add_message(
            channels[k % 2], k * 10, os.urandom(30) if k % 3 else b"x" * 40, k * 10 + 1, k
        )
        if k == 30:
            writer.add_metadata("theirs", {"k": "v"})
            writer.add_attachment(1, 2, "note", "text/plain", b"hello")
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_foreign_files_are_recovered_at_any_cut(
    compression: CompressionType, chunked: bool, tmp_path: Path
) -> None:
    data = of_others(compression, chunked)
    everything = read_messages(data)
    before = 0
    for end in [*range(20, len(data), 41), len(data)]:
        try:
            _, saved = recover_bytes(data[:end], tmp_path)
        except NothingSaved:
            assert not before
            continue
        recovered = read_messages(saved)
        assert recovered == everything[: len(recovered)]
        assert len(recovered) >= before
        before = len(recovered)
    assert before == 60
    reader = make_reader(io.BytesIO(saved))
    header = reader.get_header()
    assert header.profile == "ros1"
    assert header.library.startswith("theirs, recovered by")
    assert [(a.name, a.data) for a in reader.iter_attachments()] == [("note", b"hello")]
    names = {entry.name: entry.metadata for entry in reader.iter_metadata()}
    assert names["theirs"] == {"k": "v"}
    assert "trilat.accounts" not in names


@pytest.mark.parametrize("compression", list(CompressionType))
def test_complete_records_of_cut_chunks_are_kept(
    compression: CompressionType, tmp_path: Path
) -> None:
    data = make_foreign_bytes([os.urandom(300) for _ in range(2000)], compression=compression)
    (chunk,) = list_chunks(data)
    result, saved = recover_bytes(data[: (chunk.begin + chunk.end) // 2], tmp_path)
    recovered = read_messages(saved)
    assert recovered == read_messages(data)[: len(recovered)]
    assert len(recovered) == result.salvaged > 600
    assert not result.lossless
    assert f"{len(recovered)} messages could be saved" in result.lost[0]


# What is hostile.


def make_record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


BOMB = packed_chunk(bytes(1 << 28))
HEAD = b"\x89MCAP0\r\n" + make_record(1, bytes(8))
META = make_record(12, struct.pack("<I", 1) + b"m" + bytes(4))


@pytest.mark.parametrize(
    "data",
    [
        HEAD + META + make_record(6, bytes(100), 1 << 62),
        HEAD + META + make_record(9, bytes(100), 1 << 40),
        HEAD + META + BOMB,
        HEAD + META + BOMB[:-100],
        HEAD
        + META
        + make_record(6, bytes(16) + struct.pack("<QII", 1 << 60, 0, 1 << 31) + b"zstd"),
        HEAD + META + make_record(4, struct.pack("<HHI", 1, 1, 1 << 31)) * 100,
    ],
    ids=["chunk", "attachment", "bomb", "cut bomb", "sizes", "texts"],
)
def test_no_number_in_a_file_is_trusted(data: bytes, tmp_path: Path) -> None:
    tracemalloc.start()
    try:
        result, _ = recover_bytes(data, tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 150 << 20
    finally:
        tracemalloc.stop()
    assert result.messages == 0


@anywhere
@given(data=st.binary(max_size=300), at=positions)
def test_any_file_is_recovered_or_refused(data: bytes, at: float, tmp_path: Path) -> None:
    whole = make_chunked_bytes()
    place = int(at * len(whole))
    for content in (data, HEAD + data, whole[:place] + data + whole[place:]):
        try:
            _, saved = recover_bytes(content, tmp_path)
        except NothingSaved:
            continue
        assert list(StreamReader(io.BytesIO(saved), validate_crcs=True).records)


# Names.


def test_recovered_names_follow_their_file() -> None:
    names = {
        "run.mcap.active": "run.mcap",
        "run-002.mcap.active": "run-002.mcap",
        "run.mcap": "run.recovered.mcap",
        "run": "run.recovered.mcap",
        "a.b.mcap": "a.b.recovered.mcap",
    }
    assert {name: recovered_path(Path("d") / name).name for name in names} == names


def test_only_permitted_files_are_replaced(tmp_path: Path) -> None:
    torn = write_log(tmp_path, make_chunked_bytes()[:-100], "run.mcap.active")
    write_log(tmp_path, b"precious")
    with pytest.raises(UsageError, match=r"run\.mcap already exists"):
        recover(torn)
    with pytest.raises(UsageError, match="is the source file"):
        recover(torn, torn, force=True)
    assert (tmp_path / "run.mcap").read_bytes() == b"precious"
    recover(torn, force=True)
    assert read_messages((tmp_path / "run.mcap").read_bytes()) == read_messages(
        make_chunked_bytes()
    )
    assert torn.read_bytes() == make_chunked_bytes()[:-100]


@pytest.mark.parametrize("content", [b"", b"no log at all", HEAD])
def test_without_messages_no_file_is_made(content: bytes, tmp_path: Path) -> None:
    path = write_log(tmp_path, content, "x.mcap")
    with pytest.raises(NothingSaved, match="nothing in this file could be saved"):
        recover(path)
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(LogError, match="cannot be read"):
        recover(tmp_path)


# The command.


@pytest.mark.parametrize(
    ("change", "code", "phrases"),
    [
        (
            lambda data: data[:-60],
            0,
            ["run.mcap: recovered from run.mcap.active, which was not finished", "nothing"],
        ),
        (lambda data: data[: len(data) // 2], 3, ["cut off", "lost"]),
        (lambda _: b"junk", 1, []),
    ],
    ids=["lossless", "lossy", "nothing to save"],
)
def test_exit_codes_give_the_outcome(
    change: Callable[[bytes], bytes], code: int, phrases: list[str], tmp_path: Path
) -> None:
    write_log(tmp_path, change(make_chunked_bytes()), "run.mcap.active")
    done = trilat("log", "recover", "run.mcap.active", cwd=tmp_path)
    assert done.code == code, done
    for fact in phrases:
        assert fact in done.out
    if code == 1:
        done.refuses("nothing in this file could be saved", code=1)
        return
    assert done.err == ""
    done = trilat("verify", "run.mcap", cwd=tmp_path)
    assert (done.code, "less than 99.9 %" in done.err) == (int(code == 3), code == 3), done
    done = trilat(
        "log", "recover", "run.mcap.active", "-o", "other.mcap", "--json", cwd=tmp_path
    )
    facts: dict[str, Any] = json.loads(done.out)
    assert done.code == code
    assert facts["lossless"] == (code == 0)
    assert facts["coverage"].keys() == {"m1", "m2", "s"}
    assert all(coverage["ticks"] == 120 for coverage in facts["coverage"].values())
    assert all(
        (coverage["records"] == 120) == (code == 0) for coverage in facts["coverage"].values()
    )
    assert facts["digest_chain"] == ("intact" if code == 0 else "not closed")
    assert facts["output"] == "other.mcap"
    assert facts["messages"] == len(read_messages((tmp_path / "other.mcap").read_bytes()))
    assert not active_path(tmp_path / "other.mcap").exists()
    trilat("log", "recover", "run.mcap.active", cwd=tmp_path).refuses(
        "run.mcap already exists", "--force"
    )


@pytest.mark.parametrize("command", [["log", "recover"], ["verify"]])
def test_an_unfinished_log_is_named_where_it_is(command: list[str], tmp_path: Path) -> None:
    write_log(tmp_path, make_chunked_bytes()[:-60], "run.mcap.active")
    done = trilat(*command, "run.mcap", cwd=tmp_path)
    done.refuses("run.mcap cannot be read", "trilat log recover run.mcap.active")


def make_later_messages_bytes(part: int) -> bytes:
    """A log, or a part of a log, whose messages begin 60 ms after the start of the session."""
    data = make_log_bytes("paper")
    later = [m for m in read_messages(data) if m.log_ns >= 60_000_000]
    return make_bytes_of_messages(data, later, part=part, compression=CompressionType.NONE)


@pytest.mark.parametrize(("part", "lacks_beginning"), [(0, True), (1, True), (2, False)])
def test_only_later_parts_may_lack_a_beginning(
    part: int, lacks_beginning: bool, tmp_path: Path
) -> None:
    """What an undivided log or a first part lacks is missing, and its records do not follow it."""
    data = make_later_messages_bytes(part)
    whole, saved = recover_bytes(data, tmp_path, "run.mcap")
    assert read_messages(saved) == read_messages(data)
    assert any(": 0-59" in text for text in whole.missing) == lacks_beginning, whole.missing
    (chunk,) = list_chunks(data)
    cut = data[: (chunk.begin + chunk.end) // 2]
    result, _ = recover_bytes(cut, tmp_path)
    assert result.messages == result.salvaged
    assert (result.salvaged > 20) != lacks_beginning


@pytest.mark.parametrize(
    ("changes", "state"),
    [
        ((), DigestState.INTACT),
        (("definition",), DigestState.OPEN),
        (("message",), DigestState.CHANGED),
        (("metadata",), DigestState.CHANGED),
        (("message", "definition"), DigestState.CHANGED),
    ],
    ids=str,
)
def test_recoveries_state_changes_beyond_damaged_definitions(
    changes: Sequence[str], state: DigestState, tmp_path: Path
) -> None:
    """A definition that only its copy in the index has is damage; every other difference is a change."""
    pieces = take_apart(make_log_bytes("paper"))
    if "metadata" in changes:
        pieces.metadata("trilat.session")["note"] = "added later"
    if "message" in changes:
        pieces.messages[-1] = pieces.messages[-1]._replace(log_ns=10**9)
    data = pieces.bytes()
    if "definition" in changes:
        data = data.replace(b"/m1/state", b"/m9/state", 1)
    result, _ = recover_bytes(data, tmp_path, "run.mcap")
    assert result.chain is state

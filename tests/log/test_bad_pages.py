"""Pages that are zeroed, stale or misdirected: recovery invents nothing, and says what it could not save."""

import hashlib
import io
import random
from collections import Counter
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from tests.log.bad_pages import (
    GOLDEN,
    draw_damaged_file,
    make_log_collection,
    recovered_all,
    rewrite_as_other_program,
)
from tests.log.builders import make_log_bytes, write_log
from tests.log.split_logs import read_messages
from trilat_net.errors import LogError, NothingSaved
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_layout import SCENARIO, SESSION
from trilat_net.log.log_reader import open_log
from trilat_net.log.mcap_records import RecordScanner
from trilat_net.log.recovery import Recovery, recover
from trilat_net.log.running_digest import DigestState
from trilat_net.log.session_check import check_file
from trilat_net.log.torn_chunk import PAGE_BYTES

LZ4 = CompressionType.LZ4

pytestmark = pytest.mark.usefixtures("unsynced")


def test_no_message_is_invented(tmp_path: Path) -> None:
    draw = random.Random(2)
    whole = make_log_bytes("paper")
    files = {
        "packed": whole,
        "loose": rewrite_as_other_program(whole, 30_000),
        "lz4": rewrite_as_other_program(whole, 30_000, compression=LZ4),
    }
    cases = [draw_damaged_file(files, list(files), draw) for _ in range(12)]
    assert recovered_all(files, cases, tmp_path, verified=False).faultless


@pytest.mark.long
def test_no_message_is_invented_in_2000_files(tmp_path: Path) -> None:
    draw = random.Random(53)
    files = make_log_collection()
    cases = [draw_damaged_file(files, list(files), draw) for _ in range(2000)]
    tally = recovered_all(files, cases, tmp_path)
    print(dict(tally.outcomes))
    assert tally.faultless, tally
    assert tally.outcomes["verifies"] > 100
    assert tally.outcomes["its session or scenario is lost"] < 200


def recover_bytes(data: bytes, folder: Path) -> tuple[Recovery, bytes]:
    write_log(folder, data, "z.mcap.active")
    result = recover(folder / "z.mcap.active", folder / "zz.mcap", force=True)
    return result, (folder / "zz.mcap").read_bytes()


@pytest.mark.long
def test_torn_chunks_with_zeroed_pages_add_nothing(tmp_path: Path) -> None:
    """The attack that gained nine messages."""
    data = make_log_bytes("paper", {"duration_s": 3.0})
    truth = Counter(read_messages(data))
    draw = random.Random(1)
    salvaged = 0
    for _ in range(40):
        torn = bytearray(data[: draw.randrange(PAGE_BYTES, len(data))])
        offset = draw.randrange(len(torn) // PAGE_BYTES) * PAGE_BYTES
        torn[offset : offset + PAGE_BYTES] = bytes(PAGE_BYTES)
        try:
            result, saved = recover_bytes(bytes(torn), tmp_path)
        except NothingSaved:
            assert not offset  # the first page names the channels of all messages
            continue
        assert not Counter(read_messages(saved)) - truth
        salvaged += result.salvaged
        if offset:
            assert verify_log(open_log(tmp_path / "zz.mcap")).agreed
    assert salvaged > 1000


def chunk_offsets(data: bytes) -> list[tuple[int, int]]:
    scanner = RecordScanner(io.BytesIO(data))
    return [
        (frame.offset, frame.end) for frame in scanner.frames() if frame.opcode == Opcode.CHUNK
    ]


@pytest.mark.parametrize("finished", [True, False])
def test_misplaced_whole_chunks_are_refused(finished: bool, tmp_path: Path) -> None:
    """The checksum of such a chunk is right, but the index, or else the order of times, shows the error."""
    live = (GOLDEN / "live-paper.mcap").read_bytes()
    places = chunk_offsets(live)
    begin, end = places[5]
    first, _ = places[7]
    data = bytearray(live if finished else live[: live.index(b"trilat.accounts") - 13])
    data[first : first + end - begin] = live[begin:end]
    result, saved = recover_bytes(bytes(data), tmp_path)
    assert not Counter(read_messages(saved)) - Counter(read_messages(live))
    assert not result.lossless


def test_a_lost_definition_is_restored(tmp_path: Path) -> None:
    """A message names its member and its kind itself."""
    live = (GOLDEN / "live-paper.mcap").read_bytes()
    torn = bytearray(live[: chunk_offsets(live)[-1][0]])
    start = torn.index(b"/trilat/paper-demo/m2/state") + len(b"/trilat/paper-demo/m")
    torn[start : start + 1] = b"3"
    result, saved = recover_bytes(bytes(torn), tmp_path)
    assert not Counter(read_messages(saved)) - Counter(read_messages(live))
    assert any("the definition of /trilat/paper-demo/m2/state" in text for text in result.lost)
    log = open_log(tmp_path / "zz.mcap")
    assert len(log["m2"]) > 500


def test_a_damaged_definition_leaves_the_log_intact(tmp_path: Path) -> None:
    """The index has all definitions, under a checksum."""
    data = bytearray(make_log_bytes("paper"))
    data[PAGE_BYTES : 2 * PAGE_BYTES] = bytes(PAGE_BYTES)
    result, _ = recover_bytes(bytes(data), tmp_path)
    assert result.chain is DigestState.OPEN
    assert verify_log(open_log(tmp_path / "zz.mcap")).passed


def test_a_session_of_another_log_is_not_believed(tmp_path: Path) -> None:
    live = bytearray((GOLDEN / "live-4g.mcap").read_bytes())
    other = (GOLDEN / "live-paper.mcap").read_bytes()
    live[:PAGE_BYTES] = other[:PAGE_BYTES]
    result, _ = recover_bytes(bytes(live), tmp_path)
    assert any("commands of trilat-net do not" in text for text in result.lost)
    with pytest.raises(LogError, match="not a log of trilat-net"):
        open_log(tmp_path / "zz.mcap")


@pytest.mark.parametrize("whole", [True, False])
def test_a_head_of_another_virtual_run_is_refused(whole: bool, tmp_path: Path) -> None:
    """Another seed gives another hash of the scenario, and with it other boots in every message."""
    data = make_log_bytes("paper", {"duration_s": 0.5})
    other = make_log_bytes("paper", {"duration_s": 0.5, "seed": 5})
    torn = bytearray(data if whole else data[: chunk_offsets(data)[-1][1]])
    torn[:PAGE_BYTES] = other[:PAGE_BYTES]
    result, saved = recover_bytes(bytes(torn), tmp_path)
    assert not Counter(read_messages(saved)) - Counter(read_messages(data))
    assert result.messages > 1500
    # the first, which lists show
    assert "in whose place are those of another session" in result.lost[0]
    assert "commands of trilat-net do not" in result.lost[0]
    assert b"scenario.toml.damaged" in saved


def test_chunks_of_other_virtual_runs_are_refused(tmp_path: Path) -> None:
    """The checksum of such a chunk is right, and in an unfinished file its place and times are right too."""
    data, other = (
        make_log_bytes("paper", {"duration_s": 1.5, "seed": seed}) for seed in (1, 5)
    )
    (begin, end), (last_begin, last_end) = chunk_offsets(data)
    first, length = chunk_offsets(other)[0]
    torn = data[:begin] + other[first:length] + data[last_begin:last_end]
    result, saved = recover_bytes(torn, tmp_path)
    assert [text.partition(": ")[2] for text in result.lost] == [
        "a chunk belongs to another run"
    ]
    assert not Counter(read_messages(saved)) - Counter(read_messages(data))
    assert verify_log(open_log(tmp_path / "zz.mcap")).agreed
    result, _ = recover_bytes(
        data[:begin] + data[begin:end] + data[last_begin:last_end], tmp_path
    )
    assert result.lossless


@pytest.mark.parametrize("kind", ["without checksums", "damaged chunk"])
def test_without_valid_messages_no_file_is_made(kind: str, tmp_path: Path) -> None:
    """Recovery neither keeps unproven messages nor writes an empty file."""
    data = bytearray(make_log_bytes("paper"))
    if kind == "without checksums":
        live = (GOLDEN / "live-paper.mcap").read_bytes()
        data = bytearray(rewrite_as_other_program(live, 50_000, enable_crcs=False)[:96_571])
    else:
        (begin, end), *_ = chunk_offsets(bytes(data))
        del data[end + 500 :]
        data[begin + PAGE_BYTES : begin + 2 * PAGE_BYTES] = bytes(PAGE_BYTES)
    data[8:PAGE_BYTES] = bytes(PAGE_BYTES - 8)
    write_log(tmp_path, b"precious", "zz.mcap")
    with pytest.raises(NothingSaved, match="nothing in this file could be saved") as error:
        recover_bytes(bytes(data), tmp_path)
    expected = (
        "no scenario by which to check messages" if kind == "without checksums" else "chunk"
    )
    assert expected in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["z.mcap.active", "zz.mcap"]
    assert (tmp_path / "zz.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize("scenario", ["another = 1", "no TOML", "\xff"])
def test_an_unopenable_log_is_reported(scenario: str, tmp_path: Path) -> None:
    """Nothing of it is damaged; the new file is read once more, and what a reader says is a loss."""
    text = scenario.encode("latin-1")
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    session = {
        "session": "paper",
        "driver": "virtual",
        "schema_version": "4",
        "epoch_unix_ns": "0",
    }
    session["scenario_sha256"] = hashlib.sha256(text).hexdigest()
    writer.add_metadata(SESSION, session)
    writer.add_attachment(0, 0, SCENARIO, "application/toml", text)
    writer.finish()
    result, _ = recover_bytes(stream.getvalue(), tmp_path)
    with pytest.raises(LogError):
        open_log(tmp_path / "zz.mcap")
    assert len(result.lost) == 1
    assert "the scenario in this log cannot be read" in result.lost[0]
    assert "commands of trilat-net do not" in result.lost[0]


def without_scenario(data: bytes) -> bytes:
    damaged_data = bytearray(data)
    place = data.index(b"[[", data.index(SCENARIO.encode()))
    damaged_data[place : place + 2] = b"]]"
    return bytes(damaged_data)


def test_lost_scenarios_are_taken_from_beside_logs(tmp_path: Path) -> None:
    data = make_log_bytes("paper")
    result, saved = recover_bytes(without_scenario(data), tmp_path)
    assert any("commands of trilat-net do not" in text for text in result.lost)
    # kept, and not under a name that promises a right checksum
    assert b"scenario.toml.damaged" in saved
    (tmp_path / SCENARIO).write_bytes(open_log(io.BytesIO(data)).scenario_text.encode())
    recover_bytes(without_scenario(data), tmp_path)
    assert verify_log(open_log(tmp_path / "zz.mcap")).agreed
    (tmp_path / SCENARIO).write_text("another = 1")
    recover_bytes(without_scenario(data), tmp_path)
    with pytest.raises(LogError):
        open_log(tmp_path / "zz.mcap")


@pytest.mark.parametrize("place", ["head", "chunk", "accounts", "index"])
def test_check_names_a_zeroed_page(place: str, tmp_path: Path) -> None:
    data = bytearray(make_log_bytes("paper"))
    (begin, end), *_ = chunk_offsets(bytes(data))
    offset = {
        "head": data.index(b"scenario.toml"),
        "chunk": (begin + end) // 2,
        "accounts": data.index(b"trilat.accounts"),
        "index": len(data) - 2000,
    }[place]
    data[offset : offset + 400] = bytes(400)
    path = write_log(tmp_path, data)
    assert not check_file(path).passed


def test_cut_runs_name_ticks_behind_their_end(tmp_path: Path) -> None:
    """A file that was cut off between two chunks looks as if nothing were lost."""
    live = (GOLDEN / "live-paper.mcap").read_bytes()
    result, _ = recover_bytes(live[: chunk_offsets(live)[6][0]], tmp_path)
    assert result.lost == []
    assert [text.partition(":")[0] for text in result.missing] == ["m1", "m2", "s"]
    assert all("its end is unknown" in text for text in result.missing)


def test_blocks_with_a_bad_message_are_omitted(tmp_path: Path) -> None:
    """Packed bytes that are damaged falsify any part of their block, before and behind what shows."""
    data = make_log_bytes("paper", {"duration_s": 3.0})
    (begin, _), *_ = chunk_offsets(data)
    torn = bytearray(data[: begin + 120_000])
    whole, _ = recover_bytes(bytes(torn), tmp_path)
    torn[begin + 60_000 : begin + 60_040] = bytes(40)
    result, saved = recover_bytes(bytes(torn), tmp_path)
    assert 0 < result.salvaged < whole.salvaged
    assert not Counter(read_messages(saved)) - Counter(read_messages(data))
    # the chunk is packed
    assert zstandard.frame_header_size(data[begin + 9 + 44 : begin + 9 + 60]) > 0

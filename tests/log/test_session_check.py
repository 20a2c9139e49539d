"""`check`: what is sound passes, and what is wrong fails the one check that it is a matter of."""

import io
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from tests.log.builders import drop_records, edit_log_bytes, make_log_bytes, write_log
from tests.log.hostility import make_chunk
from tests.log.split_logs import (
    make_bytes_of_messages,
    make_foreign_bytes,
    read_messages,
    write_late_parts,
)
from tests.log.surgery import take_apart
from trilat_net.errors import LogError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.mcap_records import (
    MAGIC,
    RECORD_HEAD_BYTES,
    RecordFrame,
    RecordScanner,
    unpack_chunk,
)
from trilat_net.log.recovery import recover
from trilat_net.log.running_digest import DigestState
from trilat_net.log.session_check import LogCheckResult, check_file

WHOLE = make_log_bytes("paper")
DATA = edit_log_bytes(WHOLE, chunk_bytes=8192)
BUILT = {"whole", "checksums", "records", "index"}
OURS = {"sequence", "accounts", "chain", "schema", "times", "rates", "scenario"}


def check_bytes(folder: Path, *files: bytes) -> LogCheckResult:
    paths = []
    for n, data in enumerate(files):
        paths.append(folder / f"part{n}.mcap")
        paths[-1].write_bytes(data)
    return check_file(*paths)


def list_failed_checks(result: LogCheckResult) -> set[str]:
    return {finding.check for finding in result.findings if not finding.passed}


def find_first_record(opcode: int) -> RecordFrame:
    return next(
        frame for frame in RecordScanner(io.BytesIO(DATA)).frames() if frame.opcode == opcode
    )


def flip_byte(data: bytes, offset: int, flip: int = 1) -> bytes:
    changed = bytearray(data)
    changed[offset] ^= flip
    return bytes(changed)


def flip_in_first_record(opcode: int, place: int = 0) -> bytes:
    """The log with a bit flipped in the content of its first record of a kind."""
    return flip_byte(DATA, find_first_record(opcode).offset + RECORD_HEAD_BYTES + place)


@pytest.mark.parametrize("data", [WHOLE, DATA, make_log_bytes("jitter", {"duration_s": 0.1})])
def test_a_log_as_it_was_written_is_sound(data: bytes, tmp_path: Path) -> None:
    result = check_bytes(tmp_path, data)
    assert result.passed, result
    assert result.ours
    assert {finding.check for finding in result.findings} == BUILT | OURS


ZSTD = bytes.fromhex("28b52ffd")
"""How what Zstandard has packed begins."""
CHUNK = find_first_record(Opcode.CHUNK)
WRONG: dict[str, tuple[bytes, set[str]]] = {
    "cut off": (DATA[:-3000], {"whole"}),
    "without its last mark": (DATA[:-8], {"whole"}),
    "more behind the end": (DATA + b"more", {"whole"}),
    "a byte of a chunk": (flip_byte(DATA, DATA.index(ZSTD, CHUNK.offset)), {"records"}),
    "the checksum of a chunk": (flip_in_first_record(Opcode.CHUNK, 24), {"checksums"}),
    "a byte of the scenario": (
        flip_byte(DATA, find_first_record(Opcode.ATTACHMENT).end - 99),
        {"checksums"},
    ),
    "a number in the statistics": (
        flip_in_first_record(Opcode.STATISTICS),
        {"index", "checksums"},
    ),
    "the place of a chunk": (
        flip_in_first_record(Opcode.CHUNK_INDEX, 16),
        {"index", "checksums"},
    ),
    "the length of a chunk": (
        flip_in_first_record(Opcode.CHUNK_INDEX, 24),
        {"index", "checksums"},
    ),
    "the place of metadata": (
        flip_in_first_record(Opcode.METADATA_INDEX),
        {"index", "checksums"},
    ),
    "where the index begins": (flip_in_first_record(Opcode.FOOTER), {"checksums"}),
    "the checksum of the index": (
        flip_byte(DATA, find_first_record(Opcode.FOOTER).end - 1),
        {"checksums"},
    ),
    "an entry of a message index": (
        flip_byte(DATA, find_first_record(Opcode.MESSAGE_INDEX).end - 1),
        {"index"},
    ),
    "the times of a chunk": (flip_in_first_record(Opcode.CHUNK, 8), {"index"}),
}


@pytest.mark.parametrize("kind", WRONG)
def test_file_errors_fail_their_check(kind: str, tmp_path: Path) -> None:
    data, checks = WRONG[kind]
    result = check_bytes(tmp_path, data)
    built = list_failed_checks(result) & BUILT
    assert built == checks, result.findings
    named = [finding for finding in result.findings if finding.check in built]
    assert all(finding.places[0].offset is not None for finding in named)


@settings(max_examples=40)
@given(st.integers(0, len(WHOLE) - 1), st.integers(0, 7))
def test_no_changed_bit_stays_unseen(place: int, bit: int) -> None:
    """Every byte is under a checksum, an index or a rule; what MCAP itself leaves open is said here."""
    result = _check_bytes(flip_byte(WHOLE, place, 1 << bit))
    frame = next((f for f in _FRAMES if f.offset <= place < f.end), None)
    inside = place - (frame.offset + RECORD_HEAD_BYTES) if frame is not None else 0
    free = frame is not None and (
        # a CRC of 0 for "none" is under no checksum
        frame.opcode == Opcode.DATA_END
        # the last bits of a compressed stream may mean nothing; its size and its CRC are compared
        or (frame.opcode == Opcode.CHUNK and inside > 40)
        or inside < 0
    )
    assert free or not result.passed


_FRAMES = list(RecordScanner(io.BytesIO(WHOLE)).frames())


def _check_bytes(data: bytes) -> LogCheckResult:
    with tempfile.TemporaryDirectory() as folder:
        return check_bytes(Path(folder), data)


def add_view(payload: bytes) -> bytes:
    """The log with a message on a topic of views at its end."""
    pieces = take_apart(WHOLE).without_chain()
    channel = next(entry for entry in pieces.about if hasattr(entry, "topic"))
    view = replace(channel, id=1 + max(pieces.topics()), topic="/viz/odd")
    pieces.about.append(view)
    pieces.messages.append(pieces.messages[-1]._replace(channel=view.id, payload=payload))
    return pieces.bytes()


SAID: dict[str, tuple[Callable[[], bytes], set[str], str]] = {
    "records are missing": (
        lambda: edit_log_bytes(DATA, record=drop_records("m1", {7, 8, 9, 40})),
        {"sequence", "accounts"},
        "4 missing in 2 ranges",
    ),
    "the last records are missing": (
        lambda: edit_log_bytes(DATA, record=drop_records("s", {118, 119})),
        {"sequence", "accounts"},
        "2 missing in 1 range",
    ),
    "a number twice": (
        lambda: edit_log_bytes(
            DATA, record=lambda r: {**r, "tick": 5} if r["tick"] == 6 else r
        ),
        {"sequence", "accounts"},
        "message 5 occurs twice",
    ),
    "a message of another site": (
        lambda: edit_log_bytes(
            DATA, record=lambda r: {**r, "site": "m2"} if r["site"] == "m1" else r
        ),
        {"schema"},
        "a message states the sender 'm2'",
    ),
    "a message that is none": (
        lambda: edit_log_bytes(
            DATA, record=lambda r: {**r, "q": [1.0]} if r["tick"] == 3 else r
        ),
        {"schema", "sequence", "accounts"},
        "q has 1 number, not 2",
    ),
    "sent at another time": (
        lambda: edit_log_bytes(
            DATA, record=lambda r: {**r, "sent_ns": 5} if r["tick"] == 3 else r
        ),
        {"times"},
        "was sent at 5 ns, but is stored with 3000000",
    ),
    "a view that is not CDR": (
        lambda: add_view(b"text"),
        {"schema"},
        "/viz/odd: a message is not encoded in CDR",
    ),
    "another scenario": (
        lambda: edit_log_bytes(DATA, scenario=lambda text: text + "# and more\n"),
        {"scenario"},
        "SHA-256",
    ),
    "another seed": (
        lambda: edit_log_bytes(DATA, session={"seed": "7"}),
        {"scenario"},
        "has the seed 1",
    ),
    "another version": (
        lambda: edit_log_bytes(DATA, session={"schema_version": "2"}),
        {"schema"},
        "has the schema trilat.State.v4, not trilat.State.v2",
    ),
}


@pytest.mark.parametrize("kind", SAID)
def test_session_errors_fail_their_check(kind: str, tmp_path: Path) -> None:
    make_content, checks, text = SAID[kind]
    content = make_content()
    result = check_bytes(tmp_path, content)
    assert list_failed_checks(result) == checks, result.findings
    chunks = {
        frame.offset
        for frame in RecordScanner(io.BytesIO(content)).frames()
        if frame.opcode == Opcode.CHUNK
    }
    locations = [location for finding in result.findings for location in finding.places]
    offsets = {location.offset for location in locations}
    assert offsets - {None} <= chunks
    assert any(text in f"{f.text} {f.places}" for f in result.findings if not f.passed), (
        result.findings
    )


def test_the_parts_of_a_log_are_one(tmp_path: Path) -> None:
    """Each alone lacks what the other has; together nothing is missing."""
    early = edit_log_bytes(DATA, record=lambda r: r if r["tick"] < 60 else None)
    late = edit_log_bytes(DATA, record=lambda r: r if r["tick"] >= 60 else None)
    assert "sequence" in list_failed_checks(check_bytes(tmp_path, early))
    both = check_bytes(tmp_path, early, late)
    assert "sequence" not in list_failed_checks(both), both.findings


def test_parts_with_late_records_are_whole(tmp_path: Path) -> None:
    """Nothing is missing over the seams; what a site's memory filled is there, and executes like the rest."""
    parts = write_late_parts(tmp_path, refilled=range(30, 50))
    assert len(parts) >= 3
    result = check_file(*parts)
    assert result.passed, result.findings
    assert "20 came late" in next(f.text for f in result.findings if f.check == "sequence")
    verdict = verify_log(open_log(*parts))
    assert (verdict.records, verdict.identical, verdict.gaps) == (360, 360, [])


def test_parts_are_judged_from_their_beginning(tmp_path: Path) -> None:
    """Records of earlier parts are expected there; records that the part itself lacks are missing."""
    parts = write_late_parts(tmp_path, refilled=range(0))
    assert check_file(*parts[1:2]).passed
    first_and_last = check_file(parts[0], parts[2])
    assert list_failed_checks(first_and_last) == {"sequence", "accounts"}
    assert verify_log(open_log(parts[0], parts[2])).gaps


def test_recovered_files_lack_only_lost_records(tmp_path: Path) -> None:
    torn = write_log(tmp_path, DATA[: len(DATA) // 2], "run.mcap.active")
    with mock.patch("os.fsync"), mock.patch("os.fdatasync"):
        recovered = recover(torn).output
    assert "whole" in list_failed_checks(check_file(torn))
    result = check_file(recovered)
    assert list_failed_checks(result) & BUILT == set(), result.findings
    assert "accounts" not in list_failed_checks(result), result.findings
    verdict = verify_log(open_log(recovered))
    assert verdict.agreed
    assert verdict.records == sum(len(open_log(torn)[site]) for site in ("m1", "m2", "s"))


def test_files_of_different_sessions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="another session"):
        check_bytes(tmp_path, DATA, edit_log_bytes(DATA, session={"session": "other"}))


def test_foreign_files_are_judged_by_structure(tmp_path: Path) -> None:
    result = check_bytes(tmp_path, make_foreign_bytes())
    assert result.passed
    assert not result.ours
    assert {finding.check for finding in result.findings} == BUILT


def test_forbidden_chunk_contents_are_reported(tmp_path: Path) -> None:
    """A chunk in a chunk, a message of no channel, a channel that is two things."""
    records = unpack_chunk(RecordScanner(io.BytesIO(DATA)).content(CHUNK))
    lost = struct.pack("<BQHIQQ", 5, 22, 999, 0, 0, 0)
    for more, text in ((lost, "channel 999"), (make_chunk(b""), "kind 6")):
        new = make_chunk(records + more)
        result = check_bytes(tmp_path, DATA[: CHUNK.offset] + new + DATA[CHUNK.end :])
        assert "records" in list_failed_checks(result)
        assert any(text in str(f.places) for f in result.findings)


@pytest.mark.parametrize("data", [b"", b"text", MAGIC])
def test_files_without_mcap_are_not_sound(data: bytes, tmp_path: Path) -> None:
    assert "whole" in list_failed_checks(check_bytes(tmp_path, data))


def test_missing_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        check_file(tmp_path / "none.mcap")


@pytest.mark.long
def test_pymcap_cli_agrees_about_errors(tmp_path: Path) -> None:
    """Another program, run beside: on how files are built it and we agree."""
    kinds = [
        "a byte of a chunk",
        "cut off",
        "the length of a chunk",
        "the checksum of the index",
    ]
    cases = {"sound": DATA, "as written": WHOLE, **{kind: WRONG[kind][0] for kind in kinds}}
    executable = Path(sys.executable).with_name("pymcap-cli")
    running = {}
    for n, (kind, data) in enumerate(cases.items()):
        path = tmp_path / f"{n}.mcap"
        path.write_bytes(data)
        running[kind] = subprocess.Popen(
            [executable, "doctor", path], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
    theirs = {kind: process.wait() == 0 for kind, process in running.items()}
    ours = {
        kind: not list_failed_checks(_check_bytes(data)) & BUILT for kind, data in cases.items()
    }
    assert theirs == ours


def test_existing_data_checksums_are_compared(tmp_path: Path) -> None:
    """Our writer makes none; of a file that has one it is told when a byte of the data changed."""
    data = make_foreign_bytes([b"{}"] * 100, enable_data_crcs=True)
    assert check_bytes(tmp_path, data).passed
    assert list_failed_checks(
        check_bytes(tmp_path, flip_byte(data, data.index(b"mcap") + 2))
    ) == {"checksums"}


@pytest.mark.parametrize("epoch", ["", "soon", "-1"])
def test_unreadable_epochs_count_as_virtual_time(epoch: str, tmp_path: Path) -> None:
    result = check_bytes(tmp_path, edit_log_bytes(DATA, session={"epoch_unix_ns": epoch}))
    assert result.passed, result.findings


@settings(max_examples=10)
@given(first=st.integers(0, 9), removed=st.sets(st.integers(10, 118), min_size=1, max_size=4))
def test_removed_records_show_without_account_or_digests(first: int, removed: set[int]) -> None:
    """The text has the number of records of a site that are missing after its first record."""
    kept_ticks = set(range(first, 120)) - removed
    kept = [
        message
        for message in read_messages(WHOLE)
        if message.topic != "/trilat/paper/m1/state" or message.sequence in kept_ticks
    ]
    integrity = open_log(io.BytesIO(make_bytes_of_messages(WHOLE, kept))).judge_integrity()
    assert integrity.state is DigestState.CHANGED
    verb = "record of m1 is" if len(removed) == 1 else "records of m1 are"
    assert integrity.text.startswith(f"{len(removed)} {verb} missing in between")

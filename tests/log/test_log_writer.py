"""A log in parts: no message is lost or doubled at a seam, and every part explains itself."""

import os
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from tests.cli.running import trilat
from tests.log.disks import open_file_on
from trilat_net.errors import LogRefused, UsageError
from trilat_net.log.log_file import LogFile
from trilat_net.log.log_layout import part_path
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogParts, LogStorage, LogWriter
from trilat_net.log.mcap_writer import Sink
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.scenario import load_scenario

from .disks import SmallDisk

SCENARIO = load_scenario("two_sites")
KEYS = [topics.key("t", site, channel) for site in ("m", "s") for channel in ("state", "event")]
Message = tuple[str, bytes, int, int]
"""Key, payload, log time, sequence."""


pytestmark = pytest.mark.usefixtures("unsynced")


def begin_writer(stream: Sink, part: Mapping[str, str]) -> LogWriter:
    return LogWriter(stream, SCENARIO, "t", "live", 10**18, collect_provenance(), part=part)


def read_file(path: Path) -> tuple[list[Message], dict[str, Mapping[str, str]]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert [attachment.name for attachment in reader.iter_attachments()] == [
            "scenario.toml"
        ]
        metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
        messages: list[Message] = []
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            assert schema.encoding == "jsonschema"
            messages.append(
                (channel.topic[1:], message.data, message.log_time, message.sequence)
            )
    return messages, metadata


def write_messages(place: LogStorage, messages: list[Message], flush_every: int = 7) -> None:
    with LogParts(place, begin_writer) as log:
        log.current_accounts = lambda: {"so far": "yes"}
        for n, (key, payload, log_ns, number) in enumerate(messages):
            log.add(key, payload, 0, log_ns, number)
            if n % flush_every == 0:
                log.flush()
        log.finish({"in all": str(len(messages))})


def make_empty_folder(folder: Path) -> Path:
    for path in folder.iterdir():
        path.unlink()
    return folder / "run.mcap"


STEPS = st.lists(
    st.tuples(st.sampled_from(KEYS), st.integers(0, 3000), st.integers(-(10**7), 4 * 10**8)),
    min_size=1,
    max_size=60,
)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    steps=STEPS,
    size=st.none() | st.integers(10_000, 120_000),
    duration_ns=st.none() | st.integers(1, 3 * 10**9),
)
def test_joined_parts_are_the_unsplit_file(
    steps: list[tuple[str, int, int]], size: int | None, duration_ns: int | None, tmp_path: Path
) -> None:
    path = make_empty_folder(tmp_path)
    messages: list[Message] = []
    log_ns = 10**18
    for n, (key, length, step_ns) in enumerate(steps):
        log_ns += step_ns
        messages.append((key, os.urandom(length), log_ns, n))
    place = LogStorage(path, split_bytes=size, split_ns=duration_ns)
    write_messages(place, messages)
    parts = LogStorage(path).find_parts()
    if not place.splits:
        assert list(tmp_path.iterdir()) == [path]
        assert read_file(path)[0] == messages
        assert "trilat.part" not in read_file(path)[1]
        return
    assert sorted(tmp_path.iterdir()) == [part_path(path, n) for n in range(1, len(parts) + 1)]
    joined: list[Message] = []
    previous = digest = ""
    for number, part in sorted(parts.items()):
        part_messages, metadata = read_file(part)
        joined += part_messages
        assert metadata["trilat.session"]["session"] == "t"
        follows = {"previous_records": digest} if digest else {}
        assert metadata["trilat.part"] == {
            "index": str(number),
            "previous": previous,
            **follows,
        }
        previous = part.name
        digest = metadata["trilat.chain"]["records"]
        last = number == len(parts)
        assert metadata["trilat.accounts"] == (
            {"in all": str(len(messages))} if last else {"so far": "yes"}
        )
        if size is not None:
            assert part.stat().st_size <= size or len(part_messages) <= 1
        if duration_ns is not None and part_messages:
            assert all(
                message[2] - part_messages[0][2] < duration_ns for message in part_messages
            )
    assert joined == messages


def test_parts_open_alone_and_together(tmp_path: Path) -> None:
    messages = [(KEYS[0], b"\x80" * 900, 10**18 + k * 10**8, k) for k in range(40)]
    path = tmp_path / "run.mcap"
    write_messages(LogStorage(path, split_ns=10**9), messages)
    names = ["run-001.mcap", "run-002.mcap", "run-003.mcap", "run-004.mcap"]
    assert [part.name for part in sorted(tmp_path.iterdir())] == names
    for name in names:
        assert open_log(tmp_path / name).scenario == SCENARIO


@pytest.mark.parametrize(
    ("present", "splits", "expected", "previous"),
    [
        ([], False, "run.mcap", None),
        ([], True, "run-001.mcap", ""),
        (["run.mcap"], False, "run-002.mcap", "run.mcap"),
        (["run.mcap.active"], False, "run-002.mcap", "run.mcap"),
        (["run.mcap", "run-002.mcap.active"], True, "run-003.mcap", "run-002.mcap"),
        (["run-001.mcap", "run-009.mcap"], False, "run-010.mcap", "run-009.mcap"),
        (
            ["other.mcap", "run-x.mcap", "run-001.txt", "run-1.mcap", "rerun-007.mcap"],
            False,
            "run.mcap",
            None,
        ),
    ],
)
def test_continuing_writes_the_next_part(
    present: list[str], splits: bool, expected: str, previous: str | None, tmp_path: Path
) -> None:
    for name in present:
        (tmp_path / name).write_bytes(b"precious")
    place = LogStorage(
        tmp_path / "run.mcap", carry_on=True, split_ns=10**12 if splits else None
    )
    write_messages(place, [(KEYS[0], b"\x80", 10**18, 0)])
    _, metadata = read_file(tmp_path / expected)
    assert metadata.get("trilat.part", {}).get("previous") == previous
    for name in present:
        assert (tmp_path / name).read_bytes() == b"precious"


@pytest.mark.parametrize(
    "present", ["run.mcap", "run.mcap.active", "run-001.mcap", "run-017.mcap.active"]
)
def test_taken_names_are_refused_unless_replaceable(present: str, tmp_path: Path) -> None:
    (tmp_path / present).write_bytes(b"precious")
    place = LogStorage(tmp_path / "run.mcap", split_ns=1)
    with pytest.raises(UsageError, match=f"{present}.* exists.*force=True"):
        LogParts(place, begin_writer)
    assert (tmp_path / present).read_bytes() == b"precious"
    messages = [(KEYS[0], b"\x80", 10**18 + k, k) for k in range(3)]
    write_messages(LogStorage(tmp_path / "run.mcap", split_ns=1, force=True), messages)
    assert [path.name for path in sorted(tmp_path.iterdir())] == [
        f"run-00{n}.mcap" for n in (1, 2, 3)
    ]


def test_unsplit_logs_leave_other_parts_alone(tmp_path: Path) -> None:
    (tmp_path / "run-002.mcap").write_bytes(b"precious")
    for force in (False, True):
        write_messages(
            LogStorage(tmp_path / "run.mcap", force=force), [(KEYS[0], b"\x80", 10**18, 0)]
        )
    assert (tmp_path / "run-002.mcap").read_bytes() == b"precious"


@pytest.mark.parametrize("name", ["run[1].mcap", "a*b.mcap", "run", "r?n.bag.mcap"])
def test_any_name_will_do(name: str, tmp_path: Path) -> None:
    messages = [(KEYS[0], b"\x80", 10**18 + k, k) for k in range(3)]
    place = LogStorage(tmp_path / name, split_ns=1)
    (tmp_path / "run1-001.mcap").write_bytes(b"")
    write_messages(place, messages)
    assert sorted(place.find_parts()) == [1, 2, 3]
    assert [
        message for path in place.find_parts().values() for message in read_file(path)[0]
    ] == messages


@pytest.mark.parametrize("number", [0.5, float("nan"), 0.0, 1e7])
def test_an_invalid_part_is_refused(number: float, tmp_path: Path) -> None:
    done = trilat("record", "--session", "x", "--split-size", str(number), cwd=tmp_path)
    done.refuses("--split-size must be a number of MiB from 1 to 1e6")


def test_continuing_and_replacing_at_once_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="give only one of these options"):
        LogStorage(tmp_path / "run.mcap", force=True, carry_on=True).find_first_part()


def write_on_disk(room: int, path: Path, messages: list[Message]) -> list[Message]:
    """Writes messages in parts onto a disk with so much room; returns those that were given to it."""
    taken: list[Message] = []
    disks = [SmallDisk(room)]

    def opened(part: Path) -> LogFile:
        disks.append(SmallDisk(disks[-1].capacity - disks[-1].written))
        return open_file_on(disks[-1], part)

    def record() -> None:
        with LogParts(LogStorage(path, split_ns=5 * 10**8), begin_writer, opened) as log:
            try:
                for message in messages:
                    key, payload, log_ns, number = message
                    log.add(key, payload, 0, log_ns, number)
                    taken.append(message)
                    log.flush()
            finally:
                log.finish({})

    try:
        record()
    except LogRefused as error:
        assert (error.exit_code, "the disk is full" in str(error)) == (5, True)  # noqa: PT017
        assert taken != messages
    return taken


def test_full_disks_at_seams_keep_earlier_parts(tmp_path: Path) -> None:
    """At every step of a log in parts: all parts are whole, and hold all that was given to them."""
    messages = [(KEYS[0], os.urandom(300), 10**18 + k * 10**8, k) for k in range(40)]
    for room in range(80_000, 200_000, 7900):
        path = make_empty_folder(tmp_path)
        taken = write_on_disk(room, path, messages)
        stored = [
            message
            for _, part in sorted(LogStorage(path).find_parts().items())
            for message in read_file(part)[0]
        ]
        assert stored == taken
        assert all(part.name.endswith(".mcap") for part in tmp_path.iterdir())


def test_adding_after_the_end_is_refused(tmp_path: Path) -> None:
    with LogParts(LogStorage(tmp_path / "run.mcap"), begin_writer) as log:
        log.finish({})
        with pytest.raises(LogRefused, match="is finished"):
            log.add(KEYS[0], b"", 0, 0, 0)
        log.finish({})
    assert read_file(tmp_path / "run.mcap")[0] == []

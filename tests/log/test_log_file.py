"""A log's file while it is written: what a crash, a full disk and a name that is taken do to it."""

import errno
import os
import signal
import subprocess
import sys
from contextlib import suppress
from itertools import islice
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from tests.log.disks import begin_container, draw_messages, open_file_on
from trilat_net.errors import LogRefused, NothingSaved, UsageError
from trilat_net.log import log_file
from trilat_net.log.log_file import (
    RESERVE_MARGIN_BYTES,
    RESERVE_STEP_BYTES,
    SYNC_PERIOD_NS,
    DiskReserve,
    LogFile,
)
from trilat_net.log.log_layout import active_path
from trilat_net.log.recovery import recover

from .disks import Sent, SmallDisk

in_this_folder = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30
)


def read_messages(path: Path) -> list[Sent]:
    with path.open("rb") as stream:
        return [
            (m.channel_id, m.log_time, m.data, m.publish_time, m.sequence)
            for _, _, m in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            )
        ]


# Names.


def test_logs_are_renamed_when_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogFile(path) as file:
        container = begin_container(file)
        container.add_message(1, 0, b"x", 0)
        container.flush()
        assert [entry.name for entry in tmp_path.iterdir()] == ["run.mcap.active"]
        container.finish()
        assert not path.exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.mcap"]
    assert read_messages(path) == [(1, 0, b"x", 0, 0)]


def test_only_flushed_data_is_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    file = LogFile(path)
    container = begin_container(file)
    for n, message in enumerate(draw_messages(5)):
        container.add_message(*message)
        before = active_path(path).stat().st_size
        assert before == file.size
        container.flush()
        assert active_path(path).stat().st_size > before
        with active_path(path).open("rb") as stream:
            records = list(islice(StreamReader(stream).records, 4 + 2 * (n + 1)))
        assert (
            sum(isinstance(record, Message) for record in records)
            == container.messages
            == n + 1
        )
    file.close()


def test_unfinished_logs_keep_their_temporary_name(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def fail() -> None:
        with LogFile(path) as file:
            begin_container(file).add_message(1, 0, b"x", 0)
            _ = 1 / 0

    with pytest.raises(ZeroDivisionError):
        fail()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.mcap.active"]
    with (
        pytest.raises(
            UsageError, match=r"never finished.*trilat log recover .*run\.mcap\.active"
        ),
        LogFile(path),
    ):
        pass
    with LogFile(path, force=True) as file:
        begin_container(file).finish()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.mcap"]


def test_empty_files_are_removed(tmp_path: Path) -> None:
    with LogFile(tmp_path / "run.mcap") as file:
        file.write(b"not flushed")
    assert list(tmp_path.iterdir()) == []


def test_existing_logs_are_replaced_by_whole_ones(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with (
        pytest.raises(
            UsageError, match="exists; choose another name, or replace it with force=True"
        ),
        LogFile(path),
    ):
        pass
    with LogFile(path, force=True) as file:
        container = begin_container(file)
        assert path.read_bytes() == b"precious"
        container.finish()
    assert read_messages(path) == []


def test_names_taken_meanwhile_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def write() -> None:
        with LogFile(path) as file:
            begin_container(file).finish()
            path.write_bytes(b"precious")

    with pytest.raises(
        UsageError, match=r"in the meantime; the finished file is .*run\.mcap\.active: rename"
    ):
        write()
    assert path.read_bytes() == b"precious"
    assert read_messages(active_path(path)) == []


def test_logs_open_elsewhere_are_kept_as_on_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows replaces no file that a viewer has open."""
    path = tmp_path / "run.mcap"
    path.write_bytes(b"earlier")

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    def make() -> None:
        with LogFile(path, force=True) as file:
            begin_container(file).finish()

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(
        LogRefused, match=r"Permission denied; the finished log is .*active: give it a name"
    ):
        make()
    assert path.read_bytes() == b"earlier"
    assert read_messages(active_path(path)) == []


def test_without_hard_links_logs_get_their_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def link(*_: object) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", link)
    with LogFile(tmp_path / "run.mcap") as file:
        begin_container(file).finish()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("name", ["no/run.mcap", "", "x" * 300])
def test_an_uncreatable_file_is_bad_input(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot be written|is not a file"):
        LogFile(tmp_path / name)


# Full disks.


@pytest.fixture
def little_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_file, "RESERVE_MARGIN_BYTES", 1000)


@in_this_folder
@given(count=st.integers(1, 40), most=st.integers(1, 100))
def test_slow_disks_take_everything(count: int, most: int, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.unlink(missing_ok=True)
    wanted = draw_messages(count)
    with open_file_on(SmallDisk(1 << 20, most=most), path) as file:
        container = begin_container(file)
        for message in wanted:
            container.add_message(*message)
        container.finish()
    assert read_messages(path) == wanted


CHUNK = 5


def write_until_full(file: LogFile, wanted: list[Sent], flushed: list[Sent]) -> None:
    """Writes messages until the disk refuses, then the end, as a recorder does; notes what was flushed."""
    container = None
    try:
        container = begin_container(file)
        for n, message in enumerate(wanted, 1):
            container.add_message(*message)
            if n % CHUNK == 0:
                container.flush()
                flushed[:] = wanted[:n]
        container.finish()
    except OSError as error:
        with suppress(OSError):
            if container is not None and not file.whole:
                container.add_metadata("accounts", {"why": str(error)})
                container.finish()
        raise LogRefused("refused") from None


@pytest.mark.usefixtures("unsynced", "little_margin")
def test_logs_end_in_order_at_full_disks(tmp_path: Path) -> None:
    """At every byte of a chunk: the file is whole, with the chunk that did not fit any more."""
    path = tmp_path / "run.mcap"
    wanted = draw_messages(60 * CHUNK)
    seen = set()
    for capacity in range(4000, 7000, 17):
        disk = SmallDisk(capacity)
        flushed: list[Sent] = []
        with pytest.raises(LogRefused) as refusal, open_file_on(disk, path) as file:
            write_until_full(file, wanted, flushed)
        text = str(refusal.value)
        assert refusal.value.exit_code == 5
        assert f"{path}: the disk is full; the log ends there, finished" in text
        assert "make room" in text
        stored = read_messages(path)
        assert stored == wanted[: len(flushed) + CHUNK]
        assert f"{len(stored)} other messages" in text
        assert not active_path(path).exists()
        seen.add(len(stored))
        path.unlink()
    assert len(seen) > 4  # the chunk that did not fit was not always the same


@pytest.mark.usefixtures("unsynced", "little_margin")
@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO])
def test_without_room_whole_chunks_are_kept(error: int, tmp_path: Path) -> None:
    """At every byte of a chunk and of the end: cut where the last flush ended."""
    path = tmp_path / "run.mcap"
    wanted = draw_messages(3 * CHUNK)
    with open_file_on(SmallDisk(1 << 20), path) as file:
        write_until_full(file, wanted, [])
    whole = path.stat().st_size
    path.unlink()
    head = 200
    for capacity in range(head, whole, 11 if error == errno.ENOSPC else 97):
        active_path(path).unlink(missing_ok=True)
        disk = SmallDisk(capacity, error)
        flushed: list[Sent] = []
        with pytest.raises(LogRefused) as refusal, open_file_on(disk, path, room=False) as file:
            write_until_full(file, wanted, flushed)
        assert refusal.value.exit_code == 5
        assert not path.exists()
        assert active_path(path).stat().st_size == file.size
        assert f"trilat log recover {active_path(path)}" in str(refusal.value)
        if not flushed:
            with pytest.raises(NothingSaved):
                recover(active_path(path))
            continue
        assert recover(active_path(path)).lossless
        assert read_messages(path) == flushed
        path.unlink()


def test_room_is_kept_for_pending_and_end(tmp_path: Path) -> None:
    disk = SmallDisk(10 << 20)
    file = open_file_on(disk, tmp_path / "run.mcap")
    container = begin_container(file)
    for message in draw_messages(500):
        container.add_message(*message)
    before = file.size
    container.flush()
    assert disk.kept >= file.size - before + container.end_bytes + RESERVE_MARGIN_BYTES
    container.finish()
    file.close()
    assert disk.kept == 0


@pytest.mark.parametrize("error", [None, errno.EOPNOTSUPP, errno.EACCES])
def test_reserves_take_and_return_hidden_room(
    error: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without `posix_fallocate` it is written; a folder that takes no reserve does without."""

    def refuse(*_: int) -> None:
        raise OSError(error, "not here")

    if error is not None:
        monkeypatch.setattr(os, "posix_fallocate", refuse)
    reserve = DiskReserve(tmp_path)
    reserve.grow(1)
    reserve.grow(RESERVE_STEP_BYTES + 1)
    if error != errno.EACCES:
        assert reserve.size == 2 * RESERVE_STEP_BYTES
        assert reserve._file is not None
        assert os.fstat(reserve._file.fileno()).st_blocks * 512 >= reserve.size
    assert list(tmp_path.iterdir()) == []
    reserve.release()
    reserve.grow(10)
    assert reserve.size == 0


LIMITED = """
import os, resource, sys
from pathlib import Path
from trilat_net.errors import LogRefused
from trilat_net.log.mcap_writer import McapWriter
from trilat_net.log.log_file import LogFile
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
try:
    with LogFile(Path(sys.argv[1])) as file:
        container = McapWriter(file, "lib")
        channel = container.register_channel("/a", "msgpack", 0)
        try:
            for n in range(10_000):
                container.add_message(channel, n, os.urandom(1000), n, n)
                container.flush()
        except OSError as error:
            raise LogRefused(str(error)) from None
except LogRefused as refused:
    print(refused)
    sys.exit(refused.exit_code)
"""


def test_largest_files_are_cut_and_recovered(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, path], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 5, done
    assert f"{active_path(path)}: the file system does not accept a longer file" in done.stdout
    assert "split_size" in done.stdout
    assert recover(active_path(path)).lossless
    assert [message[1] for message in read_messages(path)] == list(
        range(len(read_messages(path)))
    )
    assert len(read_messages(path)) > 900


# Loss of power.


def test_flushed_data_is_synced_as_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(log_file, "_datasync", synced.append)
    for durable, expected in ((False, 3), (True, 31)):
        synced.clear()
        times_ns = iter(range(0, 1000 * SYNC_PERIOD_NS, SYNC_PERIOD_NS // 10))
        file = LogFile(tmp_path / f"{durable}.mcap", durable=durable, now_ns=times_ns.__next__)
        for _ in range(31):
            file.write(b"x")
            file.flush()
            file._syncing.wait()
        assert len(synced) == expected
        file.close()


def test_disks_that_lose_accepted_data_end_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(log_file, "_datasync", refuse)
    path = tmp_path / "run.mcap"
    times_ns = iter(range(0, 1000 * SYNC_PERIOD_NS, SYNC_PERIOD_NS))

    def write() -> None:
        with LogFile(path, now_ns=times_ns.__next__) as file:
            write_until_full(file, draw_messages(100), [])

    with pytest.raises(
        LogRefused, match="the disk fails; the log ends there, finished, with"
    ) as refusal:
        write()
    assert refusal.value.exit_code == 5
    assert 0 < len(read_messages(path)) < 100


# The death of a process.

KILLED = """
import os, signal, sys
from pathlib import Path
from trilat_net.log.log_file import LogFile
from trilat_net.log.mcap_writer import McapWriter
file = LogFile(Path(sys.argv[1]))
container = McapWriter(file, "lib")
channel = container.register_channel("/a", "msgpack", 0)
container.flush()
for n in range(int(sys.argv[2])):
    container.add_message(channel, n, b"%d" % n, n, n)
    if n % 7 == 6:
        container.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_flushed_data_survives_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    count = 100
    done = subprocess.run(
        [sys.executable, "-c", KILLED, path, str(count)], capture_output=True, timeout=60
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    result = recover(active_path(path))
    assert result.lossless
    assert [message[2] for message in read_messages(path)] == [
        b"%d" % n for n in range(count // 7 * 7)
    ]

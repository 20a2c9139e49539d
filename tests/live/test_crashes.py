"""A recorder that dies, and a disk that is full: what was flushed is kept, and the sites never notice."""

import random
import signal

import pytest
from mcap.reader import make_reader

from tests.live.killing import kill_recorder
from tests.live.processes import assert_executed_again
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_layout import active_path
from trilat_net.log.log_reader import open_log
from trilat_net.log.recovery import recover

from .killing import SITES
from .processes import Session, Stage
from .small_disks import NoSmallDisk, SmallDisk, small_disk


@pytest.mark.parametrize("durable", [False, True])
@pytest.mark.long
def test_a_killed_recorder_keeps_all_flushed_messages(durable: bool, stage: Stage) -> None:
    done = kill_recorder(stage, random.uniform(0.1, 1.0), *(["--durable"] if durable else []))
    assert done.recovery.lossless, done.recovery.lost
    assert done.kept == done.flushed
    assert done.log.complete
    assert all(len(done.log[name]) for name in SITES)
    assert_executed_again(done.log)
    # no bar, which stands in the benchmarks: a second would mean that flushing was forgotten
    assert done.lost_ms < 1000


@pytest.mark.long
def test_a_full_disk_ends_recording_without_harm(stage: Stage) -> None:
    folder = stage.folder / "disk"
    folder.mkdir()
    try:
        with small_disk(folder, 3) as disk:
            _full_disk(stage, disk)
    except NoSmallDisk as reason:
        pytest.skip(f"no disk of three MiB here: {reason}")


def _full_disk(stage: Stage, disk: SmallDisk) -> None:
    disk.seen(disk.folder / "other").write_bytes(bytes(1_400_000))
    session = Session(stage, "paper", SITES, "--duration", "8")
    path = disk.folder / "run.mcap"
    small = stage.start(
        "on a small disk",
        "record",
        "--session",
        "t",
        "-o",
        str(path),
        *session.ways("recorder"),
        before=disk.before,
    )
    for name in SITES:
        session.site(name, "--needs-recorder")
    assert small.code() == 5
    assert (
        f"error: {path}: the disk is full; the log ends there, finished, with" in small.text()
    )
    assert not disk.seen(path.with_name("run.mcap.active")).exists()
    session.ends_well()
    with disk.seen(path).open("rb") as stream:
        assert list(make_reader(stream, validate_crcs=True).iter_messages())
    log = open_log(disk.seen(path))
    assert log.complete
    assert verify_log(log).agreed
    for name in SITES:
        states = log[name].states
        assert [state.tick for state in states] == list(range(len(states)))
        assert f"{name}: 8000 ticks" in session.processes[name].text()
        assert log.link_stats(name)[-1].dropped.get("missing", 0) == 0


@pytest.mark.long
def test_a_restarted_recorder_writes_the_next_part(stage: Stage) -> None:
    session = Session(stage, "paper", SITES, "--duration", "60")
    session.all()
    session.recording()
    first = session.processes["recorder"]
    first.signal(signal.SIGKILL)
    assert first.code() == -signal.SIGKILL
    again = session.recorder("--continue", called="recorder again")
    again.prints("joins the session")
    for name in SITES:
        session.processes[name].signal(signal.SIGINT)
    assert again.code() == 0, again
    assert [session.processes[name].code() for name in SITES] == [130, 130, 130]
    torn = recover(active_path(session.log))
    assert torn.lossless
    second = session.log.with_name("run-002.mcap")
    log = open_log(session.log, second)
    for name in SITES:
        (tick_count,) = (
            event.ticks for event in log.events if (event.member, event.kind) == (name, "end")
        )
        assert [state.tick for state in log[name].states] == list(range(tick_count))
    with second.open("rb") as stream:
        metadata = {entry.name: entry.metadata for entry in make_reader(stream).iter_metadata()}
    assert metadata["trilat.part"] == {"index": "2", "previous": "run.mcap"}
    assert_executed_again(log)

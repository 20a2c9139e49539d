"""Kills a recorder twenty times at random moments, and compares sessions with a full disk and with free space."""

import random
import tempfile
from pathlib import Path
from statistics import median

from tests.live.killing import SITES, kill_recorder
from tests.live.processes import Session, Stage
from tests.live.small_disks import NoSmallDisk, small_disk
from trilat_net.execution.verification import verify_log
from trilat_net.net import topics
from trilat_net.net.messages import LinkStats
from trilat_net.net.wire import decode
from trilat_net.net.zenoh_bus import ZenohBus

KILLS = 20
PAIRS = 3
DURATION_S = 10


def run() -> list[str]:
    return [*_kills(), *_full_disks()]


def _kills() -> list[str]:
    lost_ms, kept, passed = [], 0, 0
    for _ in range(KILLS):
        with tempfile.TemporaryDirectory() as folder:
            stage = Stage(Path(folder))
            try:
                done = kill_recorder(stage, random.uniform(0.2, 3.0))
            finally:
                stage.clear()
            lost_ms.append(done.lost_ms)
            kept += done.kept == done.flushed and done.recovery.lossless
            passed += verify_log(done.log).agreed
    return [
        f"recorder killed {KILLS} times, three sites at 1 kHz; records lost, ms (bar: <= 150):",
        "  " + " ".join(f"{value:.0f}" for value in sorted(lost_ms)),
        f"  every flushed message kept by recover: {kept} times; the log verified to its end: {passed} times",
    ]


def _full_disks() -> list[str]:
    runs: dict[int, list[tuple[int, int, int]]] = {3: [], 300: []}
    try:
        for _ in range(PAIRS):
            for mib, found in runs.items():
                found.append(_on_disk(mib))
    except NoSmallDisk as reason:
        return [f"no small disk here: {reason}"]
    lines = [
        f"{PAIRS} pairs of runs of {DURATION_S} s, disk of 3 MiB and of 300 MiB; all sites together:"
    ]
    for n, what in enumerate(("samples missing", "ticks begun late", "samples late")):
        full, ample = ([one[n] for one in runs[mib]] for mib in (3, 300))
        lines.append(
            f"  {what}: {full} and {ample}, medians {median(full)} and {median(ample)}"
        )
    return lines


def _on_disk(mib: int) -> tuple[int, int, int]:
    """Returns the sites' final counts of missing samples, ticks that began late, and late samples."""
    with tempfile.TemporaryDirectory() as folder:
        stage = Stage(Path(folder))
        place = Path(folder) / "disk"
        place.mkdir()
        try:
            with small_disk(place, mib) as disk:
                session = Session(stage, "paper", SITES, "--duration", str(DURATION_S))
                path = place / "run.mcap"
                recorder = stage.start(
                    "recorder",
                    *(
                        "record",
                        "--session",
                        "t",
                        "-o",
                        str(path),
                        "--listen",
                        session.recorder_endpoint,
                    ),
                    *(
                        word
                        for endpoint in session.endpoints
                        for word in ("--connect", endpoint)
                    ),
                    before=disk.before,
                )
                for name in SITES:
                    session.site(name, "--needs-recorder")
                last = _watched(session)
                code = recorder.code()
                assert code == (5 if mib == 3 else 0), recorder
        finally:
            stage.clear()
    return (
        sum(stats.dropped.get("missing", 0) for stats in last.values()),
        sum(stats.overruns for stats in last.values()),
        sum(sum(stats.late.values()) for stats in last.values()),
    )


def _watched(session: Session) -> dict[str, LinkStats]:
    """Returns the last statistics of every site, once all have ended."""
    session.begun()
    last: dict[str, LinkStats] = {}
    bus = ZenohBus([], session.endpoints)
    try:
        inbox = bus.inbox(topics.key("t", "*", topics.LINK))
        assert session.codes() == dict.fromkeys(SITES, 0)
        while (came := inbox.poll()) is not None:
            stats = decode(came[1], LinkStats)
            last[stats.site] = stats
    finally:
        bus.close()
    assert set(last) == set(SITES)
    return last

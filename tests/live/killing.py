"""A recorder that is killed in the middle of a session, and the recovery of its file."""

import signal
from dataclasses import dataclass
from pathlib import Path

from tests.net.waiting import sleep_for_ns
from trilat_net.log.log_layout import active_path
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.mcap_reader import McapReader
from trilat_net.log.recovery import Recovery, recover
from trilat_net.net.clock import SystemClock

from .processes import Session, Stage

SITES = ("m1", "m2", "s")


@dataclass
class Killed:
    """What became of it.

    Attributes:
        recovery: what `recover` says.
        log: the file that it made.
        flushed: messages that were in the file when the recorder died.
        kept: messages that are in the new one.
        lost_ms: time between the newest record in the file and the kill, at the worst site.
    """

    recovery: Recovery
    log: Log
    flushed: list[tuple[str, bytes]]
    kept: list[tuple[str, bytes]]
    lost_ms: float


def kill_recorder(stage: Stage, after_s: float, *more: str) -> Killed:
    """Runs the paper's experiment, kills its recorder some time after its first records, ends the sites.

    Args:
        stage: where it runs.
        after_s: how long after.
        more: options of the recorder.
    """
    session = Session(stage, "paper", SITES, "--duration", "60")
    session.recorder(*more)
    for name in SITES:
        session.site(name, "--needs-recorder")
    session.recording()
    clock = SystemClock()
    sleep_for_ns(clock, round(after_s * 1e9))
    killed_ns = clock.monotonic_ns()
    recorder = session.processes["recorder"]
    recorder.signal(signal.SIGKILL)
    assert recorder.code() == -signal.SIGKILL
    for name in SITES:
        session.processes[name].signal(signal.SIGINT)
    for name in SITES:
        assert session.processes[name].code() == 130
    torn = active_path(session.log)
    recovery = recover(torn)
    log = open_log(recovery.output)
    return Killed(
        recovery,
        log,
        _read_messages(torn),
        _read_messages(recovery.output),
        max((killed_ns - newest_ns) / 1e6 for newest_ns in _find_newest(log)),
    )


def _read_messages(path: Path) -> list[tuple[str, bytes]]:
    with path.open("rb") as stream:
        return [(item.topic, item.payload) for item in McapReader(stream, str(path)).messages()]


def _find_newest(log: Log) -> list[int]:
    """Returns the time at which each site sent its newest record, on the machine's monotonic clock."""
    (epoch_ns,) = {
        at for event in log.events if event.kind == "start" for at in event.epochs.values()
    }
    return [epoch_ns + log[name].states[-1].sent_ns for name in log.sites]

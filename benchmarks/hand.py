"""Measures a live hand: its delay, the rate of a device, the end of a killed program, and a flood of messages."""

import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import trilat_net
from tests.live.processes import HOLDER, PAPER, Session, Stage, connection_options
from tests.sites.devices import HaplyService
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net import topics
from trilat_net.net.connection import Connection
from trilat_net.net.zenoh_bus import ZenohBus

MOVES, DURATION_S = 1000, 60
FLOOD_S, DEVICE_S = 5.0, 8.0
DEVICE_STATES = 5000


def run() -> list[str]:
    """Returns the results of one session of `play`, three sites at 1 kHz and a recorder."""
    with tempfile.TemporaryDirectory() as folder:
        stage, alone_per_s = Stage(Path(folder)), _ask_alone()
        try:
            session = Session(stage, "play", PAPER, "--duration", str(DURATION_S))
            session.all()
            moved = _move(session)
            led = f"{_lead(session)}; {alone_per_s:.0f} states/s where nothing else runs"
            killed_ns = _kill(session)
            flooded = _flood(session)
            session.ends_well()
            log = open_log(session.log)
        finally:
            stage.clear()
    return [
        *_describe_moves(log, moved),
        led,
        *_describe_kill(log, killed_ns),
        *_describe_flood(log, flooded),
    ]


def _epoch_ns(log: Log, site: str) -> int:
    """Returns the epoch on the monotonic clock of a site, which is this machine's clock."""
    return next(e.epoch_mono_ns for e in log.events if e.kind == "setup" and e.member == site)


def _move(session: Session) -> list[tuple[int, int]]:
    """Moves a hand at random times; returns the number of each message and the time of the request, in ns."""
    moved = []
    with trilat_net.hand(
        "t", "m1", connect=session.endpoints, source="benchmark", timeout_s=60.0
    ) as hand:
        x, y = hand.pose
        for n in range(MOVES):
            time.sleep(random.uniform(0.008, 0.024))
            called_ns = time.monotonic_ns()
            moved.append((hand.move(x + 0.05 * n / MOVES, y), called_ns))
    return moved


def _ask_alone() -> float:
    """Returns the number of states per second from a Haply device on an otherwise idle machine."""
    with HaplyService() as service, trilat_net.HaplyInverse3(service.address) as device:
        begun_s = time.monotonic()
        for _ in range(DEVICE_STATES):
            device.read()
            device.render((0.0, 0.0, 0.0))
    return DEVICE_STATES / (time.monotonic() - begun_s)


def _lead(session: Session) -> str:
    """Leads m1 with a service that has Haply's protocol; returns its rate, and the output of the program."""
    with HaplyService() as service:
        words = (
            "hand",
            "m1",
            "--session",
            "t",
            "--device",
            f"haply_inverse3={service.address}",
        )
        program = session.stage.start("device", *words, *connection_options(session.endpoints))
        program.prints("takes hold")
        service.pressed, begun, begun_s = {"a"}, len(service.asked), time.monotonic()
        time.sleep(DEVICE_S)
        per_s = (len(service.asked) - begun) / (time.monotonic() - begun_s)
        program.signal(signal.SIGINT)
        program.code()
    return f"a Haply, its service here: {per_s:.0f} states/s (of 1000); {program.text().splitlines()[-1]}"


def _describe_moves(log: Log, moved: list[tuple[int, int]]) -> list[str]:
    part, epoch_ns = log["m1"], _epoch_ns(log, "m1")
    mine = part.hand[:, 2] == part.hand[part.hand[:, 2] > 0.0][0, 2]
    number, made_ns = np.where(mine, part.hand[:, 1], -1.0), part.sent_ns
    delays = []
    for n, called_ns in moved:
        row = int(np.argmax(number >= n))
        delays.append((epoch_ns + int(made_ns[row]) - called_ns) / 1e6)
    p50, p99 = np.percentile(delays, [50, 99])
    return [
        f"hand.move to the first tick that names it, made and recorded, {len(delays)} moves "
        f"(bar: p50 <= 3 ms, p99 <= 8 ms): p50 {p50:.2f} ms, p99 {p99:.2f} ms"
    ]


def _kill(session: Session) -> int:
    """Kills a program that holds m2, and returns the time, in ns."""
    words = [sys.executable, "-c", HOLDER, "m2", *session.endpoints]
    holder = subprocess.Popen(words, stdout=subprocess.PIPE, cwd=Path(__file__).parents[1])
    assert holder.stdout is not None
    holder.stdout.readline()
    time.sleep(0.5)
    killed_ns = time.monotonic_ns()
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    return killed_ns


def _describe_kill(log: Log, killed_ns: int) -> list[str]:
    part = log["m2"]
    last = int(np.flatnonzero(part.hand[:, 0] > 0.0)[-1])
    gone_ms = (_epoch_ns(log, "m2") + int(part.t_ns[last + 1]) - killed_ns) / 1e6
    logged = [
        event.text for event in log.events if event.kind == "hand" and "silent" in event.text
    ]
    return [
        f"killed (SIGKILL) in grip: no force after {gone_ms:.0f} ms (bar: 320), logged: {logged}"
    ]


def _flood(session: Session) -> tuple[int, int, int]:
    """Sends garbage to the hand of s as fast as possible; returns begin and end, in ns, and the number of messages."""
    connection = Connection.of_member(None, session.endpoints, None, None, [], None)
    bus = ZenohBus([], connection.connect or ())
    time.sleep(2.0)
    publish, sent, begun_ns = (
        bus.publisher(topics.key("t", "s", topics.HAND)),
        0,
        time.monotonic_ns(),
    )
    while time.monotonic_ns() - begun_ns < FLOOD_S * 1e9:
        for _ in range(100):
            publish(b"\xc1 no message of a hand at all, and many of them")
        sent += 100
        ahead_s = sent / 1e5 - (time.monotonic_ns() - begun_ns) / 1e9
        time.sleep(max(0.0, ahead_s))
    ended_ns = time.monotonic_ns()
    bus.close()
    return begun_ns, ended_ns, sent


def _describe_flood(log: Log, flooded: tuple[int, int, int]) -> list[str]:
    begun_ns, ended_ns, sent = flooded
    epoch_ns = _epoch_ns(log, "s")
    part = log["s"]
    during = (part.t_ns > begun_ns - epoch_ns) & (part.t_ns < ended_ns - epoch_ns)
    before = (part.t_ns < begun_ns - epoch_ns - 2_000_000_000) & (part.t_s > 2.0)
    p99 = [float(np.percentile(part.late_us[rows], 99)) for rows in (during, before)]
    refused = {k: v for k, v in log.link_stats("s")[-1].dropped.items() if k.startswith("hand")}
    verification = verify_log(log)
    missing = sum(map(log.missing, log.sites))
    return [
        f"flood of {sent / (ended_ns - begun_ns) * 1e9:.0f} messages/s for {FLOOD_S:g} s at s: p99 lateness "
        f"{p99[0]:.0f} us, before {p99[1]:.0f} us; refused {refused}",
        f"  {missing} records missing, {verification.identical} of {verification.records} identical",
    ]

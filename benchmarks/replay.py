"""Measures the lateness and the losses of a replay of nine sites at 1 kHz to a subscriber in another process.

The subscriber poses as a recorder, so that the replay waits for it. It decodes nothing, and
counts the missing numbers of messages.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgspec

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.execution import virtual
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import SystemClock
from trilat_net.net.membership import new_boot
from trilat_net.net.messages import Event, Info
from trilat_net.net.wire import encode
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.scenario import Scenario, load_scenario

SITES, DURATION_S = 9, 10.0
SESSION = "replay-benchmark"
ROUNDS = 3


def _nine() -> Scenario:
    names = [f"p{n}" for n in range(SITES)]
    share = 1.0 / (SITES - 1)
    return load_scenario(
        "paper",
        {
            "name": "benchmark",
            "duration_s": DURATION_S,
            "sites": {name: {} for name in names},
            "dominance": {i: {j: share for j in names if j != i} for i in names},
            "expect": {},
        },
    )


class _Tick(msgspec.Struct):
    tick: int


def subscribe(endpoint: str) -> None:
    """Receives all records, and prints how many arrived, are missing or are out of order."""
    bus: Bus = ZenohBus([], [endpoint])
    came: dict[str, list[int]] = {}
    tick = msgspec.msgpack.Decoder(_Tick).decode
    boot = new_boot()
    ended = [False]
    publish = bus.publisher(topics.key(SESSION, topics.RECORDER, topics.EVENT))

    def stored(_: str, payload: bytes) -> None:
        said = msgspec.msgpack.decode(payload, type=Event)
        ended[0] |= said.kind == "end"
        publish(
            encode(
                Event(
                    member=topics.RECORDER, boot=boot, kind="stored", text="", about=said.member
                )
            )
        )

    bus.tap(
        topics.key(SESSION, "*", topics.STATE),
        lambda key, p: came.setdefault(key, []).append(tick(p).tick),
    )
    bus.tap(topics.key(SESSION, "*", topics.EVENT), stored)
    info = _info(boot)
    bus.respond(topics.key(SESSION, topics.RECORDER, topics.INFO), lambda _: encode(info))
    bus.announce(topics.presence_token(SESSION, topics.RECORDER, boot))
    clock = SystemClock()
    while not ended[0]:
        clock.sleep_until(clock.monotonic_ns() + 50_000_000)
    clock.sleep_until(clock.monotonic_ns() + 500_000_000)
    bus.close()
    in_order = all(ticks == sorted(set(ticks)) for ticks in came.values())
    print(json.dumps({"received": sum(map(len, came.values())), "in_order": in_order}))


def _info(boot: int) -> Info:
    return Info(
        member=topics.RECORDER,
        boot=boot,
        scenario_sha256="",
        scenario="",
        host="",
        clock="",
        fingerprint="",
    )


def _play(path: Path, *options: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the summary of the replay, and the counts of its subscriber."""
    (endpoint,) = find_free_endpoints(1)
    subscriber = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.replay", endpoint], stdout=subprocess.PIPE, text=True
    )
    replay = subprocess.run(
        [
            *(
                sys.executable,
                "-m",
                "trilat_net",
                "replay",
                str(path),
                "--session",
                SESSION,
                "--json",
            ),
            *("--listen", endpoint, "--needs-recorder", "--exclude", "**/link", *options),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    got, _ = subscriber.communicate(timeout=60)
    return json.loads(replay.stdout), json.loads(got)


def run() -> list[str]:
    scenario = _nine()
    lines = [f"replay of {SITES} sites at 1 kHz for {DURATION_S:g} s to another process:"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "nine.mcap"
        with path.open("wb") as stream:
            virtual.write_virtual_log(scenario, stream)
        for options in ((), ("--low-cpu",), ("--preload", "1"), ("--rate", "max")):
            name = " ".join(options) or "as it was"
            lines += [_line(name, *_play(path, *options)) for _ in range(ROUNDS)]
    return lines


def _line(what: str, said: dict[str, Any], got: dict[str, Any]) -> str:
    records = sum(count for topic, count in said["messages"].items() if topic.endswith("state"))
    late = said["late_us"]
    how = (
        f"late by p50 {late['p50']}, p99 {late['p99']}, max {late['max']} us (bar: p99 < 1000)"
        if late
        else f"{records / said['took_s'] / 1e3:.0f} kmsg/s"
    )
    held = f", {said['held_s']:.2f} s in publishers that waited" if said["held_s"] else ""
    order = "in order" if got["in_order"] else "OUT OF ORDER"
    return (
        f"  {what}: {how}{held}; {records - got['received']} of {records} records lost, {order}"
    )


if __name__ == "__main__":
    subscribe(sys.argv[1])

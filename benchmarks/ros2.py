"""Measures the effect of a bridge to ROS 2 on the loops, with subscribers of all topics at full rate."""

import json
import time
from contextlib import closing

import numpy as np
import zenoh

from tests.live.processes import connection_options
from tests.net.free_endpoints import find_free_endpoints
from trilat_net import open_log

from .sessions import SITES, paper
from .stopwatch import cpu_s

RUN_S, PAIRS, RATE_HZ, LATENESS_RATIO = 12, 5, 1000, 1.1


def run() -> list[str]:
    found = [(measure(bridged=True), measure(bridged=False)) for _ in range(PAIRS)]
    ratios = [late / alone for (late, _, _), (alone, _, _) in found]
    heard_hz, busy_percent = (np.median([one[0][n] for one in found]) for n in (1, 2))
    return [
        f"lateness p99, worst site, with a bridge over without: {', '.join(f'{one:.2f}' for one in ratios)}; "
        f"median {np.median(ratios):.2f} (at most {LATENESS_RATIO:g})",
        f"the bridge: {heard_hz:.0f} messages a second heard, {busy_percent:.0f} % of a core",
    ]


def measure(*, bridged: bool) -> tuple[float, float, float]:
    """Returns the p99 lateness of the worst site, in us; a listener's messages per second; and the load of the bridge, in %."""
    (router,) = find_free_endpoints(1)
    with paper(RUN_S) as session:
        session.all()
        heard_hz = busy_percent = 0.0
        if bridged:
            session.stage.start("router", "router", "--listen", router)
            words = ("--session", "t", "--ros", router, "--rate", str(RATE_HZ))
            bridge = session.stage.start(
                "ros2", "ros2", *words, *connection_options(session.endpoints)
            )
            bridge.prints("is in the graph of ROS 2")
            heard_hz, busy_percent = listen(router, bridge.pid)
        session.ends_well()
        log = open_log(session.log)
    return (
        max(float(np.percentile(log[site].late_us, 99)) for site in SITES),
        heard_hz,
        busy_percent,
    )


def listen(router: str, pid: int, lasts_s: float = 6.0) -> tuple[float, float]:
    """Listens to every topic for some time; returns the messages per second, and the load of the bridge, in %."""
    settings = {
        "mode": "client",
        "connect": {"endpoints": [router]},
        "scouting": {"multicast": {"enabled": False}},
    }
    with closing(zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))) as client:
        ring = client.declare_subscriber("0/**", zenoh.handlers.FifoChannel(1_000_000))
        time.sleep(1.0)
        before, begun = cpu_s(pid), time.monotonic()
        came = 0
        while time.monotonic() - begun < lasts_s:
            time.sleep(0.2)
            while ring.try_recv() is not None:
                came += 1
        took_s = time.monotonic() - begun
        return came / took_s, 100.0 * (cpu_s(pid) - before) / took_s

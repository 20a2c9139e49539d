"""Links that are slowed down for real: what a machine sends waits in a queue of its kernel (F7, F8).

`netem` delays packets; a kernel without it has `tbf`, which lets so many bytes a second through.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.live.namespaces import connect_by_bridge
from tests.live.processes import assert_executed_again, open_whole_log
from trilat_net.log.log_reader import Log

from .namespaces import ALL, Apart, Machines, NoNamespaces
from .processes import PAPER, Session, Stage, pause, ticks_to_hold

OPEN = {
    "netem": ("netem", "delay", "0ms"),
    "tbf": ("tbf", "rate", "1gbit", "burst", "1mb", "latency", "2s"),
}


@pytest.fixture
def queue(apart: Machines) -> str:
    """The best queue of this kernel; the machines of a session are there."""
    connect_by_bridge(apart, ALL)
    try:
        apart.shape("m1", *OPEN["tbf"])
    except NoNamespaces as reason:
        pytest.skip(str(reason))
    try:
        apart.shape("m1", *OPEN["netem"])
    except NoNamespaces:
        return "tbf"
    return "netem"


def delays_ms(log: Log, site: str, peer: str) -> NDArray[np.float64]:
    """Returns the time from the stamp of each arrived sample to the tick that received it, in ms."""
    place = log.scenario.peers(site).index(peer)
    return np.array(
        [
            state.tick - tick
            for state in log[site].states
            for index, tick, _ in state.rx
            if index == place
        ],
        dtype=np.float64,
    )


@pytest.mark.long
def test_sites_hold_during_long_delays_then_follow(
    queue: str, stage: Stage, apart: Machines
) -> None:
    """All that m1 sends comes later and later, or 0.4 s later; then what waits comes at once."""
    slow = {"netem": ("netem", "delay", "400ms", "limit", "100000")}
    slow["tbf"] = ("tbf", "rate", "400kbit", "burst", "16kb", "latency", "2s")
    session: Session = Apart.following(stage, apart, 24)
    apart.shape("m1", *slow[queue])
    pause(3.0)
    apart.shape("m1", *OPEN[queue])
    pause(6.0)
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    assert max(delays_ms(log, "s", "m1").max(), delays_ms(log, "m2", "m1").max()) > 200.0
    holds = ticks_to_hold(log)
    assert holds["m2"]
    assert holds["s"]
    assert max(max(ticks, default=0) for ticks in holds.values()) <= 21
    assert {str(log[name].mode[-1]) for name in PAPER} == {"run"}


@pytest.mark.long
def test_jitter_within_the_delay_changes_no_record(
    queue: str, stage: Stage, apart: Machines
) -> None:
    """The messages of m1 wait for some tens of milliseconds, and the session equals virtual time."""
    session = Apart(stage, apart, "--duration", "8")
    session.all()
    session.begun()
    for n in range(40):
        slow = ("delay", "60ms", "limit", "100000") if queue == "netem" else ()
        slow = slow or ("rate", "1mbit", "burst", "16kb", "latency", "2s")
        apart.shape("m1", *((queue, *slow) if n % 2 else OPEN[queue]))
        pause(0.05)
    apart.shape("m1", *OPEN[queue])
    log = session.is_reproduced()
    jitter = np.percentile(delays_ms(log, "s", "m1"), [5, 99])
    assert jitter[1] - jitter[0] > 10.0

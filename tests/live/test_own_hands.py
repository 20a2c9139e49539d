"""A hand of one's own over a real network: in a process of its own, and killed."""

import signal

import numpy as np
import pytest

import trilat_net as tn
from trilat_net.log.log_reader import Log, open_log

from .processes import Process, Session, Stage

VECTORS = ("q", "qd", "tau", "hand")


HAND = 'sites.m2.hands=[{kind="own", class="my_hand:MyHand", delay_ms=100, process=true}]'
OVERRIDES = ["--set", HAND, "--set", "link.delay_ms=200", "--duration", "6"]


def assert_bits_of_virtual_time(log: Log) -> None:
    virtual = tn.simulate(log)
    for name in log.sites:
        for vector in VECTORS:
            live = getattr(log[name], vector)
            ours = getattr(virtual[name], vector)
            assert np.array_equal(live, ours), (name, vector)


@pytest.mark.long
def test_records_are_those_of_virtual_time(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(stage.folder)
    tn.new_hand("my_hand.py")
    running = stage.start("demo", "demo", "paper", *OVERRIDES, "--out", "out")
    assert running.code(120.0) == 0, running
    log = open_log(stage.folder / "out" / "run.mcap", law=stage.folder / "my_hand.py")
    assert log.complete
    assert tn.verify(log).passed
    assert log["m2"].hand[-1, 0] == 1.0
    assert_bits_of_virtual_time(log)


@pytest.mark.long
def test_a_killed_program_lets_go_without_harm(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL in the middle: silence of 200 ms, a grip that fades within 100 ms, no site that holds."""
    monkeypatch.chdir(stage.folder)
    tn.new_hand("my_hand.py")
    session = Session(stage, "paper", ("m1", "m2", "s"), *OVERRIDES)
    endpoint = session.endpoints[1]
    words = (
        "hand",
        "m2",
        "--scenario",
        "paper",
        "--session",
        "t",
        "--connect",
        endpoint,
        *OVERRIDES,
    )
    program: Process = stage.start("hand", *words)
    session.all()
    session.processes["m2"].prints("takes hold")
    program.signal(signal.SIGKILL)
    session.ends_well()
    log = open_log(session.log)
    held = log["m2"].hand[:, 2] > 0.0
    assert held.any()
    assert not held[-1]
    assert {state.mode for name in log.sites for state in log[name].states} == {"run"}
    assert tn.verify(log).passed

"""A hand of one's own over a real network: in its site's process, in its own, and killed."""

import signal

import numpy as np
import pytest

import trilat_net as tn
from trilat_net.log.log_reader import Log, open_log

from .processes import Process, Session, Stage

VECTORS = ("q", "qd", "tau", "hand")


def make_options(*, process: bool) -> list[str]:
    keys = f'kind="own", class="my_hand:MyHand", delay_ms=100, process={str(process).lower()}'
    hand = f"sites.m2.hands=[{{{keys}}}]"
    return ["--set", hand, "--set", "link.delay_ms=200", "--duration", "6"]


def assert_bits_of_virtual_time(log: Log) -> None:
    virtual = tn.simulate(log)
    for name in log.sites:
        for vector in VECTORS:
            live = getattr(log[name], vector)
            ours = getattr(virtual[name], vector)
            assert np.array_equal(live, ours), (name, vector)


@pytest.mark.long
@pytest.mark.parametrize("process", [False, True])
def test_records_are_those_of_virtual_time(
    process: bool, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(stage.folder)
    tn.new_hand("my_hand.py")
    running = stage.start(
        "demo", "demo", "paper", *make_options(process=process), "--out", "out"
    )
    assert running.code(120.0) == 0, running
    log = open_log(stage.folder / "out" / "run.mcap", law=stage.folder / "my_hand.py")
    assert log.complete
    assert tn.verify(log).passed
    assert log["m2"].hand[-1, 0] == 1.0
    assert_bits_of_virtual_time(log)


@pytest.mark.long
def test_a_person_takes_over_from_a_running_program(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ramps of a second: no reference steps further than 1.2 times the motion itself, and no site holds."""
    monkeypatch.chdir(stage.folder)
    tn.new_hand("my_hand.py")
    path = "to_m=[1.6, 0.5], stiffness_n_m=300.0, damping_n_s_m=30.0, move_start_s=0.0, move_end_s=8.0"
    ramps = ", ".join(
        f"{{at_s={at_s}, dominance='s', to={{m1={m1}, m2={m2}}}, ramp_s=1.0}}"
        for at_s, m1, m2 in ((3.0, 0.9, 0.1), (6.0, 0.1, 0.9))
    )
    keys = [
        f"sites.m1.hands=[{{kind='tip_spring', {path}}}]",
        "sites.m2.hands=[{kind='own', class='my_hand:MyHand', process=true}]",
        "dominance.s={m1=0.1, m2=0.9}",
        f"timeline=[{ramps}]",
        "duration_s=9",
    ]
    options = [word for key in keys for word in ("--set", key)]
    running = stage.start("demo", "demo", "paper", *options, "--out", "out")
    assert running.code(120.0) == 0, running
    log = open_log(stage.folder / "out" / "run.mcap", law=stage.folder / "my_hand.py")
    run_metrics = tn.metrics(log).run
    assert run_metrics["takeovers"].value == 2
    assert 0.0 < run_metrics["lead_jump"].value <= 1.2
    assert {state.mode for name in log.sites for state in log[name].states} == {"run"}
    assert tn.verify(log).passed


@pytest.mark.long
def test_a_killed_program_lets_go_without_harm(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL in the middle: silence of 200 ms, a grip that fades within 100 ms, no site that holds."""
    monkeypatch.chdir(stage.folder)
    tn.new_hand("my_hand.py")
    chosen = make_options(process=True)
    session = Session(stage, "paper", ("m1", "m2", "s"), *chosen)
    endpoint = session.endpoints[1]
    arguments = (
        "hand",
        "m2",
        "--scenario",
        "paper",
        "--session",
        "t",
        "--connect",
        endpoint,
        *chosen,
    )
    program: Process = stage.start("hand", *arguments)
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

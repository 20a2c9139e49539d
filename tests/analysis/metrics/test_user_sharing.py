"""Metrics of users who share a slave, on prescribed records, against numbers worked out by hand."""

from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
import pytest

import trilat_net
from tests.log.builders import rewrite_log
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event
from trilat_net.scenario import parse_scenario

TRIO = """
name = "trio"
rate_hz = 200
duration_s = 2.0
[control]
law = "p_d"
K = 10.0
d = 2.0
[link]
delay_ms = 50.0
[sites.m1]
role = "master"
[sites.m2]
role = "master"
[sites.s]
role = "slave"
[dominance]
m1 = { m2 = 0.5, s = 0.5 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.75, m2 = 0.25 }
[[timeline]]
at_s = 1.0
dominance = "s"
to = { m1 = 0.25, m2 = 0.75 }
ramp_s = RAMP
"""
"""400 ticks; m1 leads, and from tick 200 on m2 takes over."""
PUSHES = {"m1": [3.0, 2.0], "m2": [-1.0, 1.0], "m3": [2.0, -3.0], "s": [0.0, 0.0]}
"""Of the hands ON the arms, N m."""


def push_users(log: Log, steps: Mapping[int, float] | None = None) -> Log:
    """Returns the log with these pushes; references move by 1 mrad a tick, or by the given steps."""
    step = np.full(400, 1e-3)
    for tick, size in (steps or {}).items():
        step[tick] = size
    way = np.cumsum(step).tolist()

    def change(state: Any) -> Any:
        tau_x = [-torque for torque in PUSHES[state.site]]
        return msgspec.structs.replace(state, tau_x=tau_x, q_des=[way[state.tick], 0.0])

    return rewrite_log(log, change=change)


def make_pushed_log(ramp_s: float = 0.5, steps: Mapping[int, float] | None = None) -> Log:
    return push_users(
        trilat_net.simulate(parse_scenario(TRIO.replace("RAMP", str(ramp_s)))), steps
    )


def test_effort_of_a_hand_counts_by_its_share() -> None:
    """|tau|^2 is 13 and 2; the shares of m1 add up to 200 x 0.75 + (75 - 0.5 x 49.5) + 100 x 0.25."""
    metrics = LogMetrics.of_log(make_pushed_log())
    shares = 150.0 + 50.25 + 25.0
    assert metrics.sites["m1"]["authority_effort_nm2_s"].value == pytest.approx(
        13.0 * shares / 200.0
    )
    assert metrics.sites["m2"]["authority_effort_nm2_s"].value == pytest.approx(
        2.0 * (400.0 - shares) / 200.0
    )
    assert not metrics.sites["s"]["authority_effort_nm2_s"].applies


def test_the_smaller_of_opposed_torques_cancels() -> None:
    """Joint 1 has 3 against -1, joint 2 has 2 and 1: 1 N m of joint 1 cancels on both sides, of 7 in all."""
    figures = LogMetrics.of_log(make_pushed_log()).run
    assert figures["internal_rms_nm"].value == pytest.approx(1.0)
    assert figures["internal_share"].value == pytest.approx(2.0 / 7.0)
    assert not figures["internal_rms_n"].applies


def test_three_users_cancel_except_the_remaining_torque() -> None:
    """Torques of 3, -1 and 2 N m at joint 1, and 2, 1 and -3 N m at joint 2, sum to 4 and 0, so that 1 and 3 N m cancel."""
    text = TRIO.replace("[sites.s]", '[sites.m3]\nrole = "master"\n[sites.s]').replace(
        "RAMP", "0.5"
    )
    text = text.replace("[[timeline]]", "m3 = { s = 1.0 }\n[[timeline]]")
    figures = LogMetrics.of_log(push_users(trilat_net.simulate(parse_scenario(text)))).run
    assert figures["internal_rms_nm"].value == pytest.approx(3.0)
    assert figures["internal_share"].value == pytest.approx(8.0 / 12.0)


def test_a_takeover_lasts_until_the_larger_share() -> None:
    """The ramp of 0.5 s passes 1/2 at 1.25 s: ticks 0 to 249 of 400 are m1's; at equal shares m2 leads."""
    run = LogMetrics.measure_run(
        make_pushed_log(), ["intervention_share", "takeovers", "takeover_s"]
    )
    assert {key: figure.value for key, figure in run.items()} == {
        "intervention_share": pytest.approx(250.0 / 400.0),
        "takeovers": 1.0,
        "takeover_s": pytest.approx(0.25, abs=1e-9),
    }


def test_the_log_names_the_program_as_user() -> None:
    """m1 leads for ticks 0 to 249, and at tick 250, with equal shares, if m1 is the program."""
    event = Event(member="m1", boot=1, kind="hand", text="m1: policy takes hold at t = 0.000 s")
    log = rewrite_log(make_pushed_log(), others=[event])
    figure = LogMetrics.measure_run(log, ["intervention_share"])["intervention_share"]
    assert figure.value == pytest.approx(149.0 / 400.0)


def test_a_step_of_shares_takes_over_at_once() -> None:
    assert LogMetrics.of_log(make_pushed_log(ramp_s=0.0)).run[
        "takeover_s"
    ].value == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("tick", "jump"), [(200, 4.0), (250, 4.0), (300, 4.0), (199, 0.25), (302, 0.25)]
)
def test_a_jump_counts_while_shares_change(tick: int, jump: float) -> None:
    """A step of 4 mrad among those of 1 mrad: of the ramp from tick 200 to 300, or of the rest."""
    figure = LogMetrics.of_log(make_pushed_log(steps={tick: 4e-3})).run["lead_jump"]
    assert figure.value == pytest.approx(jump, rel=1e-6)


def test_two_sites_have_no_users_who_share() -> None:
    figures = LogMetrics.of_log(trilat_net.simulate("two_sites", {"duration_s": 0.1})).run
    assert {figures[key].applies for key in ("internal_share", "takeovers", "lead_jump")} == {
        False
    }


def test_shares_are_identified_from_motion() -> None:
    """The slave moves by 0.6 and 0.4 of the samples in use, though dominance says otherwise."""
    rates: dict[str, Callable[[int], list[float]]] = {
        "m1": lambda k: [float(np.sin(0.1 * k)), 0.3],
        "m2": lambda k: [0.2, float(np.cos(0.07 * k))],
    }

    def change(state: Any) -> Any:
        if state.site in rates:
            return msgspec.structs.replace(state, qd=rates[state.site](state.tick))
        if min(state.used.values()) < 0:
            # the users are not heard yet: does not count
            return msgspec.structs.replace(state, qd=[0.5, 0.5])
        first, second = (np.array(rates[peer](state.used[peer])) for peer in ("m1", "m2"))
        return msgspec.structs.replace(state, qd=(0.6 * first + 0.4 * second).tolist())

    metrics = LogMetrics.of_log(rewrite_log(make_pushed_log(), change=change))
    assert metrics.sites["m1"]["motion_share"].value == pytest.approx(0.6)
    assert metrics.sites["m2"]["motion_share"].value == pytest.approx(0.4)
    assert not metrics.sites["s"]["motion_share"].applies


def test_users_moving_alike_are_not_separated() -> None:
    log = rewrite_log(
        make_pushed_log(), change=lambda state: msgspec.structs.replace(state, qd=[1.0, 0.5])
    )
    assert "not independent" in LogMetrics.of_log(log).sites["m1"]["motion_share"].why


def test_contradictory_motion_of_the_slave_has_no_shares() -> None:
    """The slave follows one user in one half of the run, and does the opposite in the other."""

    def change(state: Any) -> Any:
        sign = 1.0 if state.tick < 200 else -1.0
        moves = {"m1": [1.0, 0.0], "m2": [0.0, 1.0], "s": [5.0 * sign, 0.0]}
        return msgspec.structs.replace(state, qd=moves[state.site])

    metrics = LogMetrics.of_log(rewrite_log(make_pushed_log(), change=change))
    assert "does not determine" in metrics.sites["m1"]["motion_share"].why

"""A run and its twins side by side in lanes are the run and its twins one by one, bit for bit."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import trilat_net as tn
from tests.execution.circling_hand import CirclingHand
from trilat_net.analysis.twins import twin_runs
from trilat_net.analysis.twins.twin_runs import Push, Twins
from trilat_net.core.lanes import twin_lanes
from trilat_net.execution.virtual import SimulatedLog
from trilat_net.scenario import Scenario, load_scenario

GOLDEN = Path(__file__).parents[1] / "golden"
Runner = Callable[[], Twins]


def check_both_ways(monkeypatch: pytest.MonkeyPatch, run: Runner) -> Twins:
    """Runs twins in lanes and one by one, checks that they are equal, and returns them."""
    monkeypatch.setattr(twin_runs, "LANE_SITE_TICKS", 0)
    calls = []
    step_to = twin_lanes.TwinLanes.step_to

    def count_steps(lanes: twin_lanes.TwinLanes, last_ns: int) -> None:
        calls.append(last_ns)
        step_to(lanes, last_ns)

    monkeypatch.setattr(twin_lanes.TwinLanes, "step_to", count_steps)
    in_lanes = run()
    assert calls
    monkeypatch.setattr(twin_lanes, "LEAST_RUNS", 100)
    calls.clear()
    alone = run()
    assert not calls
    assert (in_lanes.joints, in_lanes.same) == (alone.joints, alone.same)
    assert in_lanes.speed.tobytes() == alone.speed.tobytes()
    for path, expected in zip(in_lanes.paths, alone.paths, strict=True):
        assert (path.pushed, path.died) == (expected.pushed, expected.died)
        for name in ("t_s", "largest", "last", "scale"):
            assert getattr(path, name).tobytes() == getattr(expected, name).tobytes()
    return in_lanes


def push_in_many_ways(scenario: Scenario, site: str) -> list[Push]:
    """Returns pushes at the start, in the middle, of estimates, and some so often that differences are scaled."""
    often = Push.parse(scenario, f"{site}.q1", 1e-9)._replace(largest=2e-9)
    return [
        Push.parse(scenario, f"{site}.q1"),
        often,
        Push.parse(scenario, f"{site}.qd2", 1e-6, 1.3),
        Push.parse(scenario, "q", 1e-5),
    ]


@pytest.mark.parametrize("name", ["live-4g", "live-paper"])
def test_twins_of_live_log_equal_in_lanes(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    log = tn.open_log(GOLDEN / f"{name}.mcap")
    twins = check_both_ways(monkeypatch, lambda: Twins.of_log(log, Push.choose(log.scenario)))
    assert twins.same
    assert np.isfinite(twins.paths[0].largest).any()


def test_scaled_twins_are_equal_in_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    at_rest = {f"sites.{site}.q0_rad": [0.3, 0.5] for site in ("m1", "m2", "s")}
    scenario = load_scenario("p_d_margin", {"control.K": 40.0, "control.d": 0.5, **at_rest})
    pushes = push_in_many_ways(scenario, "m1")
    twins = check_both_ways(monkeypatch, lambda: Twins.of_scenario(scenario, pushes, 4.0))
    assert twins.paths[1].scale.any()
    assert twins.paths[2].pushed == (26,)


def test_twins_of_compiled_law_equal_in_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    wave = {"control.law": "wave", "scheme": "digital"}
    scenario = load_scenario("two_sites", {"link.delay_ms": 120.0, **wave})
    pushes = push_in_many_ways(scenario, "m")
    check_both_ways(monkeypatch, lambda: Twins.of_scenario(scenario, pushes, 4.0))


def test_twins_of_a_chain_are_equal_in_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("six_joints")
    pushes = push_in_many_ways(scenario, scenario.names[0])
    check_both_ways(monkeypatch, lambda: Twins.of_scenario(scenario, pushes, 2.0))


def test_twins_of_several_rates_equal_in_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow site makes no tick in some windows, and accepts several samples at once."""
    rates = {"rate_hz": 700, "sites.s.rate_hz": 7}
    scenario = load_scenario("two_sites", {**rates, "link.delay_ms": 80.0})
    pushes = push_in_many_ways(scenario, "m")
    check_both_ways(monkeypatch, lambda: Twins.of_scenario(scenario, pushes, 4.0))


@pytest.mark.parametrize(
    "rates", [{}, pytest.param({"sites.s.rate_hz": 400}, marks=pytest.mark.long)]
)
def test_twins_of_hand_log_equal_in_lanes(
    monkeypatch: pytest.MonkeyPatch, rates: dict[str, int]
) -> None:
    """A person takes hold of an arm, and peers that are not heard in time stop the others."""
    live = [{"kind": "live", "mode": "tip"}]
    glide = {"action": "glide", "silence_ms": 60.0}
    links = {"link.delay_ms": 20.0, "link.loss": 0.97}
    scenario = load_scenario(
        "paper",
        {"duration_s": 1.2, "on_stale": glide, "sites.m1.hands": live, **links, **rates},
    )
    log = SimulatedLog(scenario, hands={"m1": CirclingHand(scenario, "m1")})
    assert log["m1"].hand[:, 0].any()
    assert {"hold", "return"} <= set(log["s"].mode.tolist())
    pushes = [push for push in push_in_many_ways(scenario, "m1") if push.at_s < 1.0]
    twins = check_both_ways(monkeypatch, lambda: Twins.of_log(log, pushes))
    assert twins.same


def test_twins_that_leave_their_limits_run_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm passes its speed limit after some windows; the lanes then start again one by one."""
    scenario = load_scenario("two_sites", {"limits.qd_limit_rad_s": 1.0})
    pushes = push_in_many_ways(scenario, "m")
    check_both_ways(monkeypatch, lambda: Twins.of_scenario(scenario, pushes, 4.0))

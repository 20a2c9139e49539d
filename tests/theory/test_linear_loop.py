"""The linear loop against the runs that it predicts."""

import itertools
import math

import numpy as np
import pytest

from tests.execution.builders import make_trajectories, run_fused
from tests.theory.loops import RODS
from trilat_net.analysis.theory import LinearAnalysis, find_equilibrium
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.equilibrium import follow_equilibrium
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.core.step.ticks import BUCKETS_PER_S
from trilat_net.scenario import load_scenario

POSE = (-0.1236, 0.3373)


def find_rightmost(overrides: dict[str, float]) -> complex:
    """Returns the rightmost root of `free`."""
    scenario = load_scenario("free", overrides)
    root = Spectrum.of_loop(
        LinearLoop.of_conditions(
            OperatingConditions.derive(scenario), find_equilibrium(scenario)
        ),
        1,
    ).rightmost
    assert root is not None
    return root.s


def test_states_and_inputs_follow_the_scenarios_order() -> None:
    scenario = load_scenario("contact")
    linear_loop = LinearLoop.of_conditions(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, (-0.6, 1.8))
    )
    assert linear_loop.names == (
        "m.q1",
        "m.q2",
        "m.qd1",
        "m.qd2",
        "s.q1",
        "s.q2",
        "s.qd1",
        "s.qd2",
    )
    assert linear_loop.inputs == ("m.tau1", "m.tau2", "s.tau1", "s.tau2")
    assert linear_loop.outputs == ("m.qd1", "m.qd2", "s.qd1", "s.qd2")
    assert linear_loop.C @ np.arange(8.0) == pytest.approx([2.0, 3.0, 6.0, 7.0])
    (delayed,) = linear_loop.delayed
    assert delayed.delay_s == 0.2
    # k_f = 1: felt as if it were at the hand
    assert delayed.B[2:4, 2:4] == pytest.approx(linear_loop.B[2:4, :2])
    assert not delayed.B[4:].any()


def test_adaptive_sites_have_estimates_as_states() -> None:
    scenario = load_scenario("two_sites")
    names = LinearLoop.of_conditions(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, (0.1, 0.2))
    ).names
    assert names[:9] == (
        "m.q1",
        "m.q2",
        "m.qd1",
        "m.qd2",
        *(f"m.theta{p}" for p in range(1, 6)),
    )


def test_links_of_different_delays_have_an_entry_each() -> None:
    scenario = load_scenario("free", {"links.m1->s.delay_ms": 50.0})
    linear_loop = LinearLoop.of_conditions(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, POSE)
    )
    assert [delayed.delay_s for delayed in linear_loop.delayed] == [0.05, 0.2]
    both = linear_loop.delayed[0].A + linear_loop.delayed[1].A
    alike = LinearLoop.of_conditions(
        OperatingConditions.derive(load_scenario("free")),
        find_equilibrium(load_scenario("free"), POSE),
    )
    assert both == pytest.approx(alike.delayed[0].A)


@pytest.mark.parametrize(("delay_ms", "re"), [(200.0, -0.196), (0.0, -0.163), (400.0, -0.237)])
def test_the_rightmost_root_of_free_motion(delay_ms: float, re: float) -> None:
    s = find_rightmost({"link.delay_ms": delay_ms})
    assert s.real == pytest.approx(re, abs=2e-3)
    assert s.imag == pytest.approx(6.2, abs=0.2)


@pytest.mark.parametrize(("delay_ms", "re"), [(200.0, -0.693), (0.0, -0.372), (400.0, -0.642)])
def test_the_rightmost_root_of_rods(delay_ms: float, re: float) -> None:
    assert find_rightmost({"link.delay_ms": delay_ms, **RODS}).real == pytest.approx(
        re, abs=2e-3
    )


def test_zero_delay_is_the_one_tick_limit() -> None:
    scenario = load_scenario("free", {"link.delay_ms": 0.0})
    linear_loop = LinearLoop.of_conditions(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, POSE)
    )
    tick, none = (
        Spectrum.of_loop(linear_loop.set_common_delay(T), 1).roots[0].s for T in (1e-3, 0.0)
    )
    tenth = Spectrum.of_loop(linear_loop.set_common_delay(1e-4), 1).roots[0].s
    assert abs(tick - none) < 0.05
    assert abs(tenth - none) == pytest.approx(0.1 * abs(tick - none), rel=0.1)


@pytest.mark.long
def test_a_run_decays_at_its_rightmost_root() -> None:
    """Late in a run of P+d two sites swing in one mode; its peaks go as exp(re t), its zeros as im t."""
    scenario = load_scenario("p_d_margin_two", {"duration_s": 120.0, "rate_hz": 200})
    run = make_trajectories(scenario).sites["m"]
    late = run.t_s > 60.0
    q1_rad, q2_rad = run.q[late].mean(axis=0)
    root = LinearAnalysis.compute(scenario, pose=(q1_rad, q2_rad)).decisive.rightmost
    assert root is not None
    turns = np.flatnonzero(np.diff(np.sign(run.qd[late, 0])))
    t_s = run.t_s[late]
    e = np.abs((run.q - run.q_des)[late, 0])
    half_s = np.diff(t_s[turns]).mean()
    peaks = [e[a:b].max() for a, b in itertools.pairwise(turns)]
    slope, _ = np.polyfit(half_s * np.arange(len(peaks)), np.log(peaks), 1)
    assert slope == pytest.approx(root.s.real, rel=0.01)
    assert math.pi / half_s == pytest.approx(root.s.imag, rel=2e-3)


@pytest.mark.long
def test_unstable_rests_are_left_for_others() -> None:
    """The theorem says that every run settles, not that every rest is stable.

    The estimates of a run without delay, at 100 ms: a small swing grows at the rate of its
    root, the estimates move with it, and it dies away.
    """
    scenario = load_scenario("paper", {"link.delay_ms": 0.0})
    rest = find_equilibrium(scenario)
    begun: dict[str, object] = {"link.delay_ms": 100.0, "duration_s": 400.0}
    for i, name in enumerate(scenario.names):
        off = 1e-4 * (i - 1) * np.array([1.0, -0.5])
        begun[f"sites.{name}.hands"] = []
        begun[f"sites.{name}.q0_rad"] = (rest.q.mean(axis=0) + off).tolist()
        begun[f"sites.{name}.control.theta_hat0"] = rest.theta_hat[i].tolist()
    late = load_scenario("paper", begun)
    root = (
        Spectrum.of_loop(
            LinearLoop.of_conditions(
                OperatingConditions.derive(late), follow_equilibrium(late, rest)
            ),
            1,
        )
        .roots[0]
        .s
    )
    run = run_fused(late)
    speeds = np.max([site[:, 1] for site in run.maxima], axis=0)
    at = {
        t_s: speeds[(t_s - 1) * BUCKETS_PER_S : t_s * BUCKETS_PER_S].max()
        for t_s in (60, 100, 200, 400)
    }
    assert root.real > 0.02
    assert math.log(at[100] / at[60]) / 40.0 == pytest.approx(root.real, rel=0.05)
    assert at[400] < 0.2 * at[200]

"""The classification of a run's end, for signals whose class is known."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

import trilat_net
from tests.analysis.builders import make_diverged_log
from tests.log.builders import replace_fields, rewrite_log
from trilat_net.analysis.run_end import NO_BUCKETS, EndBehaviour, RunEnd, RunTrace, Stability
from trilat_net.core.step.ticks import BUCKETS_PER_S
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log
from trilat_net.scenario import load_scenario


@cache
def simulate_rest() -> Log:
    return trilat_net.simulate(
        "two_sites", {"duration_s": 12, "rate_hz": 50, "sites.m.hands": []}
    )


def make_moving_log(e: Callable[[float], float], qd: Callable[[float], float]) -> Log:
    """Returns a log whose sites move as given."""

    def changed(state):
        t_s = state.t_ns * 1e-9
        return replace_fields(state, q=[e(t_s), 0.0], q_des=[0.0, 0.0], qd=[qd(t_s), 0.0])

    return rewrite_log(simulate_rest(), change=changed)


def make_swing(rate_per_s: float, amplitude: float = 0.1) -> Callable[[float], float]:
    return lambda t_s: amplitude * np.exp(rate_per_s * t_s) * np.sin(2 * np.pi * 1.5 * t_s)


@pytest.mark.parametrize(
    ("e", "qd", "motion", "says"),
    [
        (make_swing(-0.8), make_swing(-0.7), EndBehaviour.CONVERGED, "converged: largest |e| "),
        (
            make_swing(-0.7),
            make_swing(-0.15),
            EndBehaviour.DECAYS,
            "decaying at m joint 1 (|e| -0.7",
        ),
        (make_swing(-0.15), make_swing(-0.15), EndBehaviour.DECAYS, "|qd| -0.15"),
        (
            make_swing(-0.15),
            make_swing(-0.1),
            EndBehaviour.HARDLY,
            "hardly decaying at m joint 1 (|e| -0.15",
        ),
        (make_swing(-0.1), make_swing(-0.15), EndBehaviour.HARDLY, "|qd| -0.15"),
        (make_swing(0.0), make_swing(0.0), EndBehaviour.BOUNDED, "bounded oscillation at 1.5"),
        (make_swing(-0.8), make_swing(0.0), EndBehaviour.BOUNDED, "Hz at m joint 1"),
        (make_swing(0.0), make_swing(-0.02), EndBehaviour.HARDLY, "|qd| -0.02"),
        (make_swing(0.0), make_swing(-0.15), EndBehaviour.DECAYS, "(|e| steady, |qd| -0.15"),
        (
            make_swing(0.2),
            make_swing(0.2),
            EndBehaviour.GROWS,
            "growing at m joint 1 (|e| +0.2",
        ),
        (make_swing(-0.3), make_swing(0.3), EndBehaviour.GROWS, "|qd| +0.3"),
        (make_swing(0.2), make_swing(0.0), EndBehaviour.UNDECIDED, "|e| grows, |qd| steady"),
        (
            lambda _: 0.2,
            make_swing(-0.8),
            EndBehaviour.CONVERGED,
            "at rest, with remaining errors",
        ),
        (
            lambda _: 0.1,
            lambda _: 0.4,
            EndBehaviour.UNDECIDED,
            "undecided, record longer at m joint 1",
        ),
        (lambda t_s: 0.4 * t_s, lambda _: 0.4, EndBehaviour.DRIFTS, "drifting at m joint 1"),
    ],
)
def test_a_known_signal_is_named(e, qd, motion: EndBehaviour, says: str) -> None:
    run_end = RunEnd.of_log(make_moving_log(e, qd))
    assert run_end.behaviour is motion
    assert says in run_end.text


@pytest.mark.parametrize(
    ("d", "motion"),
    [(0.9, EndBehaviour.GROWS), pytest.param(1.2, EndBehaviour.DECAYS, marks=pytest.mark.long)],
)
def test_the_p_d_margin_shows_in_60_s(d: float, motion: EndBehaviour) -> None:
    """d = abs(lambda_min(alpha)) K T = 1 for three sites, alpha = 1/2, K = 10 N m/rad, T = 0.2 s."""
    assert (
        RunEnd.of_log(
            trilat_net.simulate("p_d_margin", {"control.d": d, "rate_hz": 50})
        ).behaviour
        is motion
    )


@pytest.mark.long
def test_slow_loops_sustain_what_faster_ones_damp() -> None:
    """`digital` with the paper's gains: about 1 rad/s at 100 Hz, and 200 Hz settles."""
    held = {"scheme": "digital", "link.delay_ms": 0.0}
    slow = RunEnd.of_log(
        trilat_net.simulate("paper", {**held, "rate_hz": 100, "duration_s": 60.0})
    )
    fast = RunEnd.of_log(
        trilat_net.simulate("paper", {**held, "rate_hz": 200, "duration_s": 60.0})
    )
    assert slow.stability is not Stability.SETTLED
    assert slow.end_speed_rad_s > 0.5
    assert fast.stability is not Stability.NOT_STABLE
    assert fast.end_speed_rad_s < 0.1


def test_wall_hammering_shows_only_in_longer_records() -> None:
    short, long = (
        RunEnd.of_log(trilat_net.simulate("contact", {"rate_hz": 100, "duration_s": s}))
        for s in (15.0, 30.0)
    )
    assert short.behaviour is EndBehaviour.UNDECIDED
    assert long.behaviour is EndBehaviour.BOUNDED
    assert "bounded oscillation at 0.5 Hz" in long.text


def test_a_site_without_records_leaves_it_undecided() -> None:
    run_end = RunEnd.of_log(
        rewrite_log(
            make_moving_log(make_swing(-0.8), make_swing(-0.8)), lambda state: state.site == "m"
        )
    )
    assert run_end.behaviour is EndBehaviour.UNDECIDED
    assert run_end.text == "undecided: no record of s"


def test_only_times_recorded_by_all_sites_count() -> None:
    torn = rewrite_log(
        make_moving_log(make_swing(-0.8), make_swing(-0.8)),
        lambda s: (s.site == "m") == (s.tick < 300),
    )
    assert RunEnd.of_log(torn).behaviour is EndBehaviour.UNDECIDED


def test_a_late_jump_is_undecided() -> None:
    run_end = RunEnd.of_log(
        make_moving_log(lambda t_s: 1e-3 + (t_s > 11.0) * 0.5, make_swing(-0.5))
    )
    assert run_end.behaviour is EndBehaviour.UNDECIDED
    assert run_end.stability is Stability.OPEN
    assert "record longer" in run_end.text


def test_short_runs_are_undecided_and_stopped_ones_diverged() -> None:
    short = trilat_net.simulate("two_sites", {"duration_s": 0.5, "rate_hz": 50})
    assert RunEnd.of_log(short).behaviour is EndBehaviour.UNDECIDED
    stopped = RunEnd.of_log(make_diverged_log())
    assert stopped.behaviour is EndBehaviour.DIVERGED
    assert stopped.text == f"diverged: {make_diverged_log().describe_divergence()}"


def test_a_log_without_records_is_undecided() -> None:
    empty = rewrite_log(simulate_rest(), lambda _: False)
    assert RunEnd.of_log(empty).behaviour is EndBehaviour.UNDECIDED


def test_a_decaying_joint_hides_no_growing_one() -> None:
    """Joint 2 of s alone grows, at a thousandth of all other motion."""

    def changed(state):
        t_s = state.t_ns * 1e-9
        small = make_swing(0.2, 1e-4)(t_s) if state.site == "s" else 0.0
        wide = make_swing(-0.3)(t_s)
        return replace_fields(state, q=[wide, small], q_des=[0.0, 0.0], qd=[wide, small])

    run_end = RunEnd.of_log(rewrite_log(simulate_rest(), change=changed))
    assert (run_end.behaviour, run_end.where) == (EndBehaviour.GROWS, "s joint 2")
    assert run_end.stability is Stability.NOT_STABLE


@pytest.mark.parametrize(
    ("pushed", "stability"), [(True, Stability.OPEN), (False, Stability.NOT_STABLE)]
)
def test_growth_while_an_operator_acts_is_open(pushed: bool, stability: Stability) -> None:
    hand = {
        "kind": "pulse",
        "start_s": 5.0,
        "end_s": 11.0 if pushed else 5.5,
        "peak_nm": [1.0, 0.0],
    }
    log = trilat_net.simulate(
        "two_sites", {"duration_s": 12, "rate_hz": 50, "sites.m.hands": [hand]}
    )

    def changed(state):
        x = make_swing(0.2)(state.t_ns * 1e-9)
        return replace_fields(state, q=[x, 0.0], q_des=[0.0, 0.0], qd=[x, 0.0])

    run_end = RunEnd.of_log(rewrite_log(log, change=changed))
    assert run_end.behaviour is EndBehaviour.GROWS
    assert run_end.stability is stability


@pytest.mark.parametrize(
    ("angle", "e", "tau_x", "stability", "says"),
    [
        (0.05, 0.0, 0.0, Stability.OPEN, "m and s stand 0.05 rad apart"),
        (
            0.05,
            0.0,
            1.0,
            Stability.OPEN,
            "m and s stand 0.05 rad apart",
        ),  # what pulls at s has no effect
        (0.05, 0.05, 1.0, Stability.SETTLED, ""),
        (0.01, 0.0, 0.0, Stability.SETTLED, ""),
    ],
)
def test_sites_at_rest_agree_unless_forced_apart(angle, e, tau_x, stability, says) -> None:
    def changed(state):
        q = [angle if state.site == "s" else 0.0, 0.0]
        return replace_fields(
            state, q=q, q_des=[q[0] - e, 0.0], qd=[0.0, 0.0], tau_x=[tau_x, 0.0]
        )

    run_end = RunEnd.of_log(rewrite_log(simulate_rest(), change=changed))
    assert run_end.stability is stability
    assert says in run_end.text


@pytest.mark.parametrize(
    ("pose", "says"),
    [([-1.5, 0.05], "m, s hang: the arms fell"), ([2.5, 0.0], "away from every start pose")],
)
def test_hanging_or_thrown_arms_are_not_stable(pose: list[float], says: str) -> None:
    change = lambda s: replace_fields(s, q=pose, q_des=pose, qd=[0.0, 0.0])  # noqa: E731
    run_end = RunEnd.of_log(rewrite_log(simulate_rest(), change=change))
    assert run_end.stability is Stability.OPEN
    assert says in run_end.text


@pytest.mark.parametrize(
    ("wide", "motion"), [(0.5, EndBehaviour.UNDECIDED), (0.1, EndBehaviour.BOUNDED)]
)
def test_a_driven_joint_does_not_oscillate(wide: float, motion: EndBehaviour) -> None:
    """Joint 2 of s is steady at 0.05 rad/s; all else falls, to 0.15 rad/s at the end, or to 0.03."""

    def changed(state):
        t_s = state.t_ns * 1e-9
        steady = make_swing(0.0, 0.05)(t_s) if state.site == "s" else 0.0
        falls = make_swing(-0.1, wide)(t_s)
        return replace_fields(state, q=[falls, steady], q_des=[0.0, 0.0], qd=[falls, steady])

    assert RunEnd.of_log(rewrite_log(simulate_rest(), change=changed)).behaviour is motion


RATE_HZ = 50
SPAN_S = 40.0
T_S = np.arange(round(RATE_HZ * SPAN_S)) / RATE_HZ


def make_trace(speed: Array, *, one_way: bool = False) -> RunTrace:
    """Returns a run of three sites whose joints swing at 1 Hz, or move one way, at a given
    speed, without errors.
    """
    qd = np.tile((speed * (1.0 if one_way else np.cos(2.0 * np.pi * T_S)))[:, None], 2)
    q = np.cumsum(qd, axis=0) / RATE_HZ
    bucket = np.arange(len(T_S)) * BUCKETS_PER_S // RATE_HZ
    buckets = RunEnd.reduce_records(bucket, np.zeros_like(q), qd, q, NO_BUCKETS)
    return RunTrace([buckets] * 3, [np.zeros(2)] * 3)


@pytest.mark.parametrize(
    ("speed", "behaviour"),
    [
        (lambda t: 5e-3 * np.exp(-0.01 * t), EndBehaviour.CONVERGED),
        (lambda t: 5e-3 * np.exp(0.001 * t), EndBehaviour.UNDECIDED),
        (lambda t: 5e-3 + 0.0 * t, EndBehaviour.UNDECIDED),
        (lambda t: 1e-7 + 0.0 * t, EndBehaviour.UNDECIDED),
        (lambda t: 1e-13 + 0.0 * t, EndBehaviour.CONVERGED),
    ],
    ids=["falls", "grows slowly", "goes on", "goes on slowly", "rounding"],
)
def test_small_speed_is_rest_only_while_falling(speed, behaviour: EndBehaviour) -> None:
    scenario = load_scenario("p_d_margin", {"duration_s": SPAN_S})
    assert make_trace(speed(T_S)).classify_end(scenario).behaviour is behaviour


@pytest.mark.parametrize(
    ("speed_rad_s", "behaviour"),
    [
        (3e-4, EndBehaviour.CONVERGED),
        (1e-3, EndBehaviour.UNDECIDED),
        (4e-3, EndBehaviour.DRIFTS),
    ],
)
def test_slow_sinking_has_not_converged(speed_rad_s: float, behaviour: EndBehaviour) -> None:
    """An arm that sinks by 5, 17 or 69 mrad in the second half, with a speed that falls by 10 %, has not converged."""
    scenario = load_scenario("p_d_margin", {"duration_s": SPAN_S})
    sinking = make_trace(speed_rad_s * np.exp(-0.005 * T_S), one_way=True)
    assert sinking.classify_end(scenario).behaviour is behaviour


@pytest.mark.parametrize(
    ("at_s", "stability"),
    [(15.0, Stability.SETTLED), (35.0, Stability.SETTLED), (39.0, Stability.OPEN)],
)
def test_a_late_change_needs_a_longer_record(at_s: float, stability: Stability) -> None:
    later = [{"at_s": at_s, "link": "m1->s", "to": {"delay_ms": 300.0}}]
    scenario = load_scenario("p_d_margin", {"duration_s": SPAN_S, "timeline": later})
    run_end = make_trace(np.exp(-0.5 * T_S)).classify_end(scenario)
    assert run_end.stability is stability
    assert ("the loop changes until 39 s" in run_end.text) is (stability is Stability.OPEN)

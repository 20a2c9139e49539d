"""What a run does at its end, of signals whose answer is known."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

import trilat_net
from tests.analysis import logs
from trilat_net.certificate.growth import Motion, growth
from trilat_net.log.reader import Log


@cache
def still() -> Log:
    return trilat_net.simulate("two_sites", {"duration_s": 12, "rate_hz": 50})


def moving(e: Callable[[float], float], qd: Callable[[float], float]) -> Log:
    """A log whose sites move like that."""

    def changed(state):
        t_s = state.t_ns * 1e-9
        return logs.replaced(state, q=[e(t_s), 0.0], q_des=[0.0, 0.0], qd=[qd(t_s), 0.0])

    return logs.rewritten(still(), change=changed)


def swing(rate_per_s: float, amplitude: float = 0.1) -> Callable[[float], float]:
    return lambda t_s: amplitude * np.exp(rate_per_s * t_s) * np.sin(2 * np.pi * 1.5 * t_s)


@pytest.mark.parametrize(
    ("e", "qd", "motion", "says"),
    [
        (swing(-0.8), swing(-0.7), Motion.CONVERGED, "converged"),
        (swing(-0.1), swing(-0.1), Motion.CONVERGED, "converging"),
        (swing(0.0), swing(0.0), Motion.BOUNDED, "oscillation at 1.5"),
        (swing(-0.8), swing(0.0), Motion.BOUNDED, "oscillation at 1.5"),
        (swing(0.2), swing(0.2), Motion.DIVERGED, "|e| grows by +0.2"),
        (swing(-0.3), swing(0.3), Motion.DIVERGED, "|qd| grows by +0.3"),
        (lambda _: 0.2, swing(-0.8), Motion.CONVERGED, "at rest, and the sites do not agree"),
        (lambda _: 0.1, lambda _: 0.4, Motion.BOUNDED, "bounded motion"),
    ],
)
def test_a_known_signal_is_named(e, qd, motion: Motion, says: str) -> None:
    found = growth(moving(e, qd))
    assert found.motion is motion
    assert says in found.text


def test_what_came_late_is_undecided() -> None:
    found = growth(moving(lambda t_s: 1e-3 + (t_s > 11.0) * 0.5, swing(-0.5)))
    assert found.motion is Motion.UNDECIDED
    assert found.grows is None
    assert "record longer" in found.text


def test_a_short_run_is_undecided_and_a_stopped_one_diverged() -> None:
    short = trilat_net.simulate("two_sites", {"duration_s": 0.5, "rate_hz": 50})
    assert growth(short).motion is Motion.UNDECIDED
    stopped = growth(logs.diverged())
    assert stopped.motion is Motion.DIVERGED
    assert "passed its qd_limit_rad_s" in stopped.text


def test_a_log_without_records_is_undecided() -> None:
    empty = logs.rewritten(still(), lambda _: False)
    assert growth(empty).motion is Motion.UNDECIDED

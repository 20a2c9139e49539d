"""A score against the plain sums over a trajectory, and against what must be zero."""

import numpy as np
import pytest

from tests.virtual_runs import trajectories
from trilat_net.scenario import Scenario
from trilat_net.studies.tuning.candidate import CandidateClass, CandidateScore, measure_candidate

from .experiments import trio

FIRM = ("control.law=pd_d", "control.K=20.0", "control.d=9.0", "control.Kd=0.5", "duration_s=4.0")


def scored(scenario: Scenario, alone: Scenario | None = None) -> CandidateScore:
    return measure_candidate(scenario.text, None if alone is None else alone.text)


def test_error_and_effort_are_the_sums_that_the_docs_print() -> None:
    scenario = trio(*FIRM)
    found = scored(scenario)
    run = trajectories(scenario)
    q, tau = run.stack("q"), run.stack("tau")
    a, b, c = 0.2, 0.5, 0.6  # shares of the first peers: beta = (1 - s->.. ) by the paper's minors
    beta = np.array([1.0 - (1.0 - b) * (1.0 - c), 1.0 - (1.0 - a) * c, 1.0 - a * b])
    pose = beta @ q[:, 0] / beta.sum()
    inner, outer = 2.0 * 9.81 * np.cos(q[..., 0]), 9.81 * np.cos(q[..., 0] + q[..., 1])
    gravity = np.stack([inner + outer, outer], axis=-1)
    assert found.error_rad == pytest.approx(np.sqrt(np.mean((q - pose) ** 2)), rel=1e-9)
    assert found.effort_nm == pytest.approx(np.sqrt(np.mean((tau - gravity) ** 2)), rel=1e-9)
    assert found.spread_rad == pytest.approx(np.sqrt(np.mean(q.var(axis=0))), rel=1e-9)
    assert found.pose_rad == pytest.approx(np.sqrt(np.mean((q.mean(axis=0) - pose) ** 2)), rel=1e-9)
    e = np.abs(q - run.stack("q_des")).max(axis=(0, 2))
    assert found.settled_s == pytest.approx(0.01 * np.flatnonzero(e >= 0.01)[-1])


def test_arms_that_start_together_and_know_gravity_do_nothing() -> None:
    still = trio("control.law=p_d", *(f"sites.{name}.q0_rad=[0.2, 0.3]" for name in ("m1", "m2", "s")))
    found = scored(still)
    assert found.outcome is CandidateClass.SETTLED
    assert found.error_rad == pytest.approx(0.0, abs=1e-12)
    assert found.effort_nm == pytest.approx(0.0, abs=1e-12)
    assert found.settled_s == 0.0


def test_hanging_arms_have_strayed_and_err_by_the_fall() -> None:
    """They end in step, with e = 0 and no torque at all, and that makes them no better."""
    hanging = scored(trio(*FIRM, "control.gravity=0.0", "duration_s=20.0"))
    standing = scored(trio(*FIRM, "duration_s=20.0"))
    assert hanging.settled_s is not None  # all that e says
    assert hanging.outcome is CandidateClass.STRAYED
    assert standing.outcome is CandidateClass.SETTLED
    assert (hanging.error_rad or 0.0) > 10.0 * (standing.error_rad or np.inf)
    assert (hanging.pose_rad or 0.0) > 1.0


def test_arms_that_sink_slowly_drift_before_they_hang() -> None:
    """Damping holds them up for a while: 5 % of gravity, some 1.5 N m, against 100 N m s/rad."""
    sinking = (*FIRM, "rate_hz=1000", "control.d=100.0", "control.K=400.0", "control.gravity=0.95")
    found = scored(trio(*sinking, "duration_s=15.0"))
    assert 0.02 < (found.pose_rad or 0.0) < 0.15
    assert found.outcome is CandidateClass.OSCILLATED


def test_what_diverged_has_no_error() -> None:
    found = scored(trio(*FIRM, "limits.qd_limit_rad_s=0.2"))
    assert found.outcome is CandidateClass.DIVERGED
    assert found.error_rad is None
    assert found.effort_nm is None
    assert found.diverged_s is not None


def test_sites_of_other_rates_are_compared_at_one_instant() -> None:
    """A slave at a quarter of the rate moves the score by its coarser steps, and no more."""
    alike, mixed = (scored(trio(*FIRM, "rate_hz=400", *more)) for more in ((), ("sites.s.rate_hz=100",)))
    assert mixed.spread_rad == pytest.approx(alike.spread_rad, rel=0.1)
    assert mixed.effort_nm == pytest.approx(alike.effort_nm, rel=0.2)


def test_with_a_twin_the_pose_is_the_twins() -> None:
    push = 'sites.m1.hands=[{kind = "pulse", start_s = 0.2, end_s = 1.2, peak_nm = [20.0, 0.0]}]'
    pushed, alone = trio(*FIRM, push), trio(*FIRM)
    both = scored(pushed, alone)
    assert both.pose_rad == scored(alone).pose_rad
    assert both.spread_rad == scored(pushed).spread_rad
    assert both.error_rad == pytest.approx(np.hypot(both.spread_rad or 0.0, both.pose_rad or 0.0))

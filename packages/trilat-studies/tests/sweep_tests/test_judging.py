"""A cell's verdict is the certificate's on a log of the same run, and extending equals running longer."""

import io
import math
from typing import Any

import msgspec
import pytest
from trilat_studies.measure_run import RunMetrics
from trilat_studies.sweep.sweep_cell import CellClass, CellResult, classify_cell

import trilat_net
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.run_end import EndBehaviour, Stability
from trilat_net.execution import virtual
from trilat_net.execution.fused import FusedRun
from trilat_net.log.log_reader import open_log
from trilat_net.scenario import Scenario, load_scenario

RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "converged": ("two_sites", {"duration_s": 20.0}),
    "decaying": ("free", {"duration_s": 8.0}),
    "growing": ("p_d_margin", {"control.d": 0.7, "duration_s": 15.0}),
    "diverged": (
        "p_d_margin",
        {"control.d": 0.2, "duration_s": 20.0, "limits.qd_limit_rad_s": 5.0},
    ),
    "short": ("free", {"duration_s": 0.3}),
    "rates": ("free", {"duration_s": 4.0, "sites.s.rate_hz": 300, "sites.m1.rate_hz": 30}),
}


def judge_result(scenario: Scenario, longest_s: float = 0.0) -> CellResult:
    """Returns the judgement of a scenario's run as a cell of a sweep."""
    return classify_cell(scenario.text, longest_s)


@pytest.mark.parametrize("run", RUNS)
def test_verdict_and_numbers_are_those_of_a_log(run: str) -> None:
    """A cell has the judgement and the numbers of a certificate on the log of its run."""
    name, changes = RUNS[run]
    scenario = load_scenario(name, changes)
    stream = io.BytesIO()
    virtual.write_virtual_log(scenario, stream)
    stream.seek(0)
    log = open_log(stream)

    result = judge_result(scenario)
    certificate = certify_run(log)
    expected = certificate.end
    assert result.motion is expected.behaviour
    assert result.verdict is CellClass.of_decision(certificate.stability, expected.behaviour)
    assert result.stability == certificate.stability
    assert (result.end_error_rad, result.end_speed_rad_s) == (
        expected.end_error_rad,
        expected.end_speed_rad_s,
    )

    rate = expected.error.rate_per_s
    assert result.error_rate_per_s == (None if math.isnan(rate) else rate)
    assert result.peak_error_rad == max(float(abs(log[site].e).max()) for site in log.sites)


@pytest.mark.parametrize(
    ("name", "changes", "verdict"),
    [
        ("free", {}, CellClass.CONVERGED),
        ("p_d_margin", {"control.d": 2.5}, CellClass.CONVERGED),
        ("p_d_margin", {"control.d": 0.5}, CellClass.DIVERGED),
        ("contact", {"duration_s": 60.0}, CellClass.BOUNDED),
        ("contact", {"duration_s": 60.0, "sites.m.control.k_f": 0.2}, CellClass.CONVERGED),
    ],
)
def test_scenarios_have_their_published_behaviour(
    name: str, changes: dict[str, Any], verdict: CellClass
) -> None:
    """The figures of these scenarios, from an independent implementation, stand in their texts."""
    assert judge_result(load_scenario(name, changes)).verdict is verdict


@pytest.mark.long
def test_python_law_is_judged_like_kernel_law() -> None:
    """`tests.laws:Adaptive` has Eq. (13) and (15) in other code; reasons name roots of either law."""
    short = {"duration_s": 2.0, "link.delay_ms": 5.0}
    theirs = judge_result(
        load_scenario("free", {**short, "control.law": "tests.laws:Adaptive"})
    )
    ours = judge_result(load_scenario("free", short))
    assert msgspec.structs.replace(theirs, reasons=ours.reasons) == ours


@pytest.mark.long
def test_an_undecided_run_continues_as_longer_run() -> None:
    """A growth of 0.01/s is invisible in 4 s."""
    changes = {"control.d": 0.95, "duration_s": 4.0}
    scenario = load_scenario("p_d_margin", changes)
    assert not judge_result(scenario).is_conclusive

    result = judge_result(scenario, longest_s=256.0)
    assert result.verdict is CellClass.DIVERGED
    assert result.extended > 0
    assert result.ran_s == 4.0 * 2**result.extended

    whole = judge_result(load_scenario("p_d_margin", {**changes, "duration_s": result.ran_s}))
    totals = FusedRun(scenario)  # those of the scenario's own duration
    totals.advance_to(4.0)
    assert (
        msgspec.structs.replace(whole, extended=result.extended, **totals.totals._asdict())
        == result
    )


def test_slow_trends_under_random_links_decide_nothing() -> None:
    """Arms 3.7 rad apart that swing at 7 rad/s; the certificate's word is kept beside the verdict."""
    result = judge_result(
        load_scenario("jitter", {"control.d": 0.08, "seed": 5, "duration_s": 20.0}),
        longest_s=160.0,
    )
    assert result.verdict is not CellClass.CONVERGED
    assert result.end_speed_rad_s > 5.0


def test_no_run_is_extended_beyond_its_limit() -> None:
    scenario = load_scenario("p_d_margin", {"control.d": 0.99, "duration_s": 4.0})
    result = judge_result(scenario, longest_s=10.0)
    assert (result.ran_s, result.extended) == (10.0, 2)
    assert not result.is_conclusive


@pytest.mark.parametrize("d", [0.95, 1.05])
def test_few_per_cent_beside_edge_verdicts_are_right(d: float) -> None:
    """The edge is d = (K / 2) sin(w T) / w with w at the edge, 0.97 here.

    Runs of 160 s decide where runs of 20 s cannot.
    """
    scenario = load_scenario("p_d_margin", {"control.d": d, "duration_s": 20.0})
    result = judge_result(scenario, longest_s=160.0)
    assert result.extended > 0
    assert result.verdict is (CellClass.DIVERGED if d < 0.97 else CellClass.CONVERGED)


@pytest.mark.parametrize(
    ("d", "verdict"), [(0.93, CellClass.BOUNDED), (1.0, CellClass.CONVERGED)]
)
def test_roots_decide_for_arms_that_hardly_move(d: float, verdict: CellClass) -> None:
    """Arms 1e-3 rad apart count as resting by their speed; the rightmost root is +0.002 /s or -0.02 /s."""
    starts = {
        f"sites.{name}.q0_rad": [-0.6, 1.8 + off]
        for name, off in (("m1", 1e-3), ("m2", 0), ("s", -1e-3))
    }
    result = judge_result(
        load_scenario(
            "p_d_margin", {"control.d": d, "rate_hz": 50, "duration_s": 40.0, **starts}
        )
    )
    assert result.verdict is verdict


def test_a_diverging_run_has_its_instant() -> None:
    result = judge_result(load_scenario(*RUNS["diverged"]), longest_s=100.0)
    assert result.motion is EndBehaviour.DIVERGED
    assert result.diverged_s == result.ran_s
    assert result.extended == 0
    assert result.end_speed_rad_s > 5.0


def test_trials_see_no_roots_but_certificates_do() -> None:
    """Arms that start at one pose stay there, however unstable that pose is
    (docs/reference/stability.md).
    """
    together = {f"sites.{name}.q0_rad": [0.2, 0.3] for name in ("m1", "m2", "s")}
    scenario = load_scenario(
        "p_d_margin", {**together, "control.d": 0.5, "rate_hz": 100, "duration_s": 5.0}
    )

    cell = classify_cell(scenario.text, 5.0)
    assert cell.verdict is CellClass.BOUNDED
    assert "this rest: unstable" in cell.reasons

    assert RunMetrics.of_virtual_run(scenario).end.stability is Stability.SETTLED
    certificate = certify_run(trilat_net.simulate(scenario))
    assert certificate.end.stability is Stability.SETTLED
    assert certificate.stability is Stability.NOT_STABLE
    assert certificate.decision.rests_on.startswith("exact roots, fastest growing +")

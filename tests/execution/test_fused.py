"""The fused driver is the per-tick driver, bit for bit; what is reduced is reduced from the same records."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.execution.builders import execute_ticks, run_fused
from tests.execution.varying_links import VARYING_LINKS
from tests.programs import run_python
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.metrics.measures import Quantity
from trilat_net.core.step.ticks import BUCKETS_PER_S, Mode, TickRecord
from trilat_net.errors import LawFailed, ScenarioError
from trilat_net.execution import virtual
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import Scenario, list_shipped, load_scenario

Array = NDArray[np.float64]
TOTALS = ("rms_error_rad", "force_peak_n", "walls_j")
VISCOUS = {"kind": "viscous", "damping_nm_s_rad": 2.0}
HELD = {**VISCOUS, "sampled": True}

LINKS: tuple[dict[str, Any], ...] = (
    {"link.delay_ms": 0.0},
    {"link.delay_ms": 33.3},
    {"link.delay_ms": 150.0},
    {
        "link.model": "uniform",
        "link.delay_ms": 40.0,
        "link.half_width_ms": 40.0,
        "link.loss": 0.3,
    },
    *VARYING_LINKS,
)


def list_floats(output: TickRecord) -> list[float]:
    o = output
    return [
        *o.q,
        *o.qd,
        *o.q_des,
        *o.qd_des,
        *o.tau,
        *o.tau_x,
        *o.theta_hat,
        *o.x,
        *o.xd,
        *o.wrench,
    ]


def compute_buckets(outputs: Sequence[TickRecord], rate_hz: int) -> Array:
    """The definition, record by record: |e| and |qd| of the ticks k with floor(20 k / rate) = n."""
    maxima = np.full(
        (len(outputs) and (len(outputs) - 1) * BUCKETS_PER_S // rate_hz + 1, 2), -1.0
    )
    for k, output in enumerate(outputs):
        error = max(abs(a - b) for a, b in zip(output.x or output.q, output.q_des, strict=True))
        speed = max(map(abs, output.qd))
        n = k * BUCKETS_PER_S // rate_hz
        maxima[n] = np.maximum(maxima[n], (error, speed))
    return maxima


def assert_agreement(scenario: Scenario) -> None:
    expected = execute_ticks(scenario)
    fused = run_fused(scenario)
    for record, outputs in zip(fused.records, expected.values(), strict=True):
        last = list_floats(outputs[-1])
        np.testing.assert_array_equal(record[: len(last)], last)
    for maximum, (name, outputs) in zip(fused.maxima, expected.items(), strict=True):
        np.testing.assert_array_equal(
            maximum, compute_buckets(outputs, scenario.sites[name].rate_hz)
        )
    stops = [
        o.t_ns * 1e-9
        for outputs in expected.values()
        for o in outputs
        if o.mode is Mode.DIVERGED
    ]
    assert fused.diverged_s == (pytest.approx(min(stops)) if stops else None)


@pytest.mark.parametrize("name", list_shipped())
def test_every_shipped_scenario_has_the_same_bits(name: str) -> None:
    scenario = load_scenario(name)
    assert_agreement(load_scenario(name, {"duration_s": min(scenario.duration_s, 2.0)}))


@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from(["free", "paper", "p_d_margin", "asymmetric", "windup"]),
    scheme=st.sampled_from(["second_order", "digital"]),
    link=st.sampled_from(LINKS),
    rates=st.tuples(*[st.sampled_from([7, 100, 333, 1000])] * 3),
    seed=st.integers(0, 9),
)
def test_any_links_rates_and_schemes_agree(
    name: str, scheme: str, link: Mapping[str, Any], rates: tuple[int, ...], seed: int
) -> None:
    changes = {
        f"sites.{site}.rate_hz": rate
        for site, rate in zip(("m1", "m2", "s"), rates, strict=True)
    }
    run = {"duration_s": 0.4, "seed": seed, "scheme": scheme}
    assert_agreement(load_scenario(load_scenario(name), {**changes, **run, **link}))


def test_diverging_runs_end_with_that_tick() -> None:
    scenario = load_scenario("free", {"limits.qd_limit_rad_s": 1.5, "duration_s": 3.0})
    assert_agreement(scenario)
    fused = run_fused(scenario, 1.0)
    assert fused.diverged_s is not None
    before = fused.records
    fused.advance_to(3.0)
    np.testing.assert_array_equal(fused.records, before)


@settings(max_examples=10, deadline=None)
@given(stops=st.lists(st.floats(0.01, 1.0), min_size=1, max_size=5))
def test_a_split_run_equals_the_whole_run(stops: list[float]) -> None:
    scenario = load_scenario("paper", {"duration_s": 1.0, "link.delay_ms": 35.0})
    whole = FusedRun(scenario)
    parts = FusedRun(scenario)
    whole.advance_to(1.0)
    for until_s in sorted(stops):
        parts.advance_to(until_s)
    parts.advance_to(1.0)
    np.testing.assert_array_equal(parts.records, whole.records)
    np.testing.assert_array_equal(np.array(parts.maxima), np.array(whole.maxima))
    assert parts.settled_s == whole.settled_s


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("contact", {"duration_s": 6.0, "rate_hz": 500}),
        ("contact", {"duration_s": 6.0, "rate_hz": 500, "sites.s.environment.0.sampled": True}),
        (
            "windup",
            {
                "duration_s": 6.0,
                "sites.m1.rate_hz": 250,
                "sites.m1.environment": [VISCOUS, HELD],
            },
        ),
        ("free", {"duration_s": 3.0, "limits.qd_limit_rad_s": 1.5}),
    ],
)
def test_totals_are_those_of_the_log(name: str, changes: dict[str, Any]) -> None:
    """RMS e, peak force and work of the walls as `trilat metrics` has them; the effort by its formula."""
    scenario = load_scenario(load_scenario(name), changes)
    fused = run_fused(scenario, 0.5 * scenario.duration_s)
    fused.advance_to(scenario.duration_s)
    log = virtual.SimulatedLog(scenario)
    whole = {
        quantity.key: LogMetrics.of_log(log).run_value(quantity).value
        for quantity in Quantity.list_all()
        if quantity.key in TOTALS
    }
    totals = fused.totals._asdict()
    for key in TOTALS:
        assert totals[key] == (
            whole[key] if whole[key] is None else pytest.approx(whole[key], rel=1e-9)
        ), key
    squares = []
    for site in scenario.names:
        q = log[site].q
        tau = log[site].tau
        theta = scenario.arms[site].theta
        outer = 9.81 * theta[4] * np.cos(q[:, 0] + q[:, 1])
        gravity = np.stack((9.81 * theta[3] * np.cos(q[:, 0]) + outer, outer), axis=1)
        squares.append(np.mean((tau - gravity) ** 2))
    assert totals["effort_nm"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-9)


@pytest.mark.long
def test_settling_is_the_last_error_limit_crossing() -> None:
    scenario = load_scenario("free", {"duration_s": 13.0})
    fused = run_fused(scenario, 13.0, settled_rad=0.01)
    late_times_s = [
        output.t_ns
        for outputs in execute_ticks(scenario).values()
        for output in outputs
        if max(abs(a - b) for a, b in zip(output.x or output.q, output.q_des, strict=True))
        >= 0.01
    ]
    assert fused.settled_s == max(late_times_s) / 1e9
    early = run_fused(scenario, 2.0, settled_rad=0.01)
    assert early.settled_s is None


_PROGRAM = """
from trilat_net.scenario import load_scenario
from trilat_net.execution.fused import FusedRun
for scheme in ("second_order", "digital"):
    links = {"m2->m1": {"delay_ms": 33.5}, "s->m2": {"model": "gamma", "delay_ms": 9.0, "deviation_ms": 5.0}}
    scenario = load_scenario("asymmetric", {"scheme": scheme, "link.delay_ms": 20, "links": links,
                                   "sites.s.rate_hz": 333})
    run = FusedRun(scenario)
    for until_s in (0.05, 0.11, 0.25):
        run.advance_to(until_s)
        print(run.records.tobytes().hex())
    print(run.maxima[1].tobytes().hex())
"""


@pytest.mark.long
def test_without_the_compiler_it_has_the_same_bits() -> None:
    plain = run_python(_PROGRAM, compiled=False)
    assert plain.count("\n") == 8
    assert plain == run_python(_PROGRAM, compiled=True)


def test_unsupported_runs_are_refused() -> None:
    with pytest.raises(
        ScenarioError, match=r"sites\.m1\.plant: is external: .* can only run live"
    ):
        FusedRun(load_scenario("free", {"sites.m1.plant": "external"}))
    with pytest.raises(
        ScenarioError, match="executes 10000 ticks within one tick of the slowest"
    ):
        FusedRun(load_scenario("free", {"rate_hz": 10_000, "sites.s.rate_hz": 1}))


@pytest.mark.parametrize("law", ["Line", "CompiledLine"])
def test_plugged_laws_have_per_tick_bits(law: str) -> None:
    """The law runs at one site among laws of the kernel, and at all sites at two rates."""
    plugged = {"link.delay_ms": 5.0, "duration_s": 0.2}
    line = f"tests.plugged_laws:{law}"
    for changes in (
        {"sites.s.control.law": line},
        {"control.law": line, "sites.s.rate_hz": 500},
    ):
        scenario = load_scenario("asymmetric", {**plugged, **changes})
        fused = run_fused(scenario, 0.05)
        fused.advance_to(scenario.duration_s)
        last = {tick.site.name: tick.output for tick in virtual.execute_virtual(scenario)}
        for name, row in zip(scenario.names, fused.records, strict=True):
            names = scenario.layout(name).columns()
            numbers = [number for field in names for number in getattr(last[name], field)]
            assert row[: len(numbers)].tolist() == numbers


@pytest.mark.parametrize("law", ["Line", "CompiledLine"])
def test_failing_laws_in_fused_runs_are_named(law: str) -> None:
    control = {"law": f"tests.plugged_laws:{law}", "fail_at": 42}
    run = FusedRun(
        load_scenario("asymmetric", {"link.delay_ms": 5.0, "sites.m2.control": control})
    )
    problem = f"{law} of m2 failed at tick 41: ZeroDivisionError"
    with pytest.raises(LawFailed, match=problem):
        run.advance_to(0.2)

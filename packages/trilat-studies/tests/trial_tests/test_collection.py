"""One definition of every metric: a run is measured as its log is, however the records are cut
into batches.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trilat_studies.measure_run import (
    BATCH_RECORDS,
    RecordBatch,
    RunMetrics,
    SiteStats,
    WindowStats,
    evaluate_expectations,
    join_batches,
    measure_log,
    measure_virtual_run,
    run_compiled_in_batches,
    run_in_batches,
)

import trilat_net
from tests.log.builders import drop_records, edit_log_bytes, make_log_bytes, open_bytes
from trilat_net.core.arms.two_link_arm import end_effector_jacobian
from trilat_net.errors import ScenarioError
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.expect import ExpectWindow, window_quantities

RANDOM = {"link": {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 10.0}}
SHORT = {"duration_s": 2.5, "rate_hz": 500, "link.delay_ms": 20.0}


def scenario(**changes: Any) -> Scenario:
    """Returns a short run of `free`, with some settings replaced."""
    return load_scenario("free", {**SHORT, **changes})


def agree(metrics: RunMetrics, other: RunMetrics) -> None:
    """Asserts that figures are equal but for the last bits of means."""
    for field in RunMetrics.__struct_fields__:
        value, expected = getattr(metrics, field), getattr(other, field)
        if field == "rms_error_rad":
            assert value == pytest.approx(expected, rel=1e-12)
        elif field == "ages":
            assert value.keys() == expected.keys()
            for link in value:
                assert value[link].max_ms == expected[link].max_ms
                assert (value[link].mean_ms is None) == (expected[link].mean_ms is None)
                assert value[link].mean_ms is None or value[link].mean_ms == pytest.approx(
                    expected[link].mean_ms
                )
        else:
            assert value == expected, field


@pytest.mark.parametrize(
    "changes",
    [
        {},
        RANDOM,
        {"sites.m2.rate_hz": 90, "sites.s.rate_hz": 333},
        {"limits.qd_limit_rad_s": 0.3},
        {"link.delay_ms": 9000.0},
        {"sites.m1.hands": [{"kind": "own", "class": "tests.own_code:Circle", "rate_hz": 25}]},
    ],
    ids=["plain", "random", "rates", "diverged", "never heard of", "program"],
)
def test_runs_and_their_logs_have_equal_figures(changes: dict[str, Any]) -> None:
    assert scenario().ticks("m1") > BATCH_RECORDS
    changed_scenario = scenario(**changes)
    log = trilat_net.simulate(changed_scenario)
    agree(measure_virtual_run(changed_scenario), measure_log(log))


def test_figures_follow_their_definitions() -> None:
    """Errors, spread, poses and times of a run follow from the arrays of its log."""
    chosen_scenario = scenario(**{"expect.synchronised_rad": 0.3})
    figures, log = measure_virtual_run(chosen_scenario), trilat_net.simulate(chosen_scenario)
    errors = {name: np.abs(log[name].e) for name in log.sites}
    end = log["m1"].t_s > log["m1"].t_s[-1] - 1.0
    poses = np.array([log[name].q[end] for name in log.sites])

    assert figures.simulated_s == 2.5
    assert figures.peak_error_rad == max(e.max() for e in errors.values())
    assert figures.end_error_rad == max(e[end].max() for e in errors.values())
    assert figures.end_spread_rad == (poses.max(axis=0) - poses.min(axis=0)).max()
    assert figures.end_pose_rad == {name: tuple(log[name].q[-1]) for name in log.sites}

    times_s = [t for name in log.sites for t in log[name].t_s[errors[name].max(axis=1) >= 0.3]]
    assert 0.0 < max(times_s) < 2.4
    assert figures.synchronised_at_s == max(times_s)

    assert figures.ages["m1->s"].mean_ms == figures.ages["m1->s"].max_ms == 20.0
    assert (figures.late_samples, figures.missing, figures.end.diverged_at_s) == (0, 0, None)


def test_a_run_without_convergence_has_no_convergence_time() -> None:
    assert (
        measure_virtual_run(scenario(**{"expect.synchronised_rad": 1e-6})).synchronised_at_s
        is None
    )


def test_a_link_without_samples_has_no_age() -> None:
    figures = measure_virtual_run(scenario(links={"m1->s": {"delay_ms": 9000.0}}))
    assert figures.ages["m1->s"].mean_ms is figures.ages["m1->s"].max_ms is None
    assert figures.ages["m2->s"].max_ms == 20.0


def test_a_diverged_run_has_its_instant() -> None:
    figures = measure_virtual_run(scenario(**{"limits.qd_limit_rad_s": 0.3}))
    assert figures.end.diverged_at_s is not None
    assert figures.simulated_s == pytest.approx(figures.end.diverged_at_s, abs=0.01)
    assert figures.missing == 0


def test_every_missing_record_of_a_log_is_counted() -> None:
    whole = make_log_bytes("free")
    assert measure_log(open_bytes(whole)).missing == 0
    assert (
        measure_log(
            open_bytes(edit_log_bytes(whole, record=drop_records("s", {3, 4, 100})))
        ).missing
        == 3
    )
    assert (
        measure_log(
            open_bytes(edit_log_bytes(whole, record=drop_records("s", set(range(60, 120)))))
        ).missing
        == 60
    )
    assert measure_log(open_bytes(edit_log_bytes(whole, record=lambda _: None))).missing == 360
    none = measure_log(
        open_bytes(edit_log_bytes(whole, record=drop_records("s", set(range(120)))))
    )
    assert none.missing == 120
    assert none.synchronised_at_s is none.end_spread_rad is none.ages["m1->s"].mean_ms is None


PERIOD_NS = 10_000_000
TALLIED = 400
BUCKET_NS = 50_000_000
RATES = {"sites.m1.rate_hz": 100, "sites.m2.rate_hz": 50, "sites.s.rate_hz": 100}
HEARD = load_scenario("free", {**RATES, "expect.synchronised_rad": 1.0})


def records(seed: int) -> RecordBatch:
    """Four seconds at 100 Hz with peers at 100 and 50 Hz; samples of the second peer come from
    tick 20 on.
    """
    rng = np.random.default_rng(seed)
    k = np.arange(TALLIED)
    used = np.array([k - 5, np.where(k < 20, -1, k // 2 - rng.integers(2, 9, TALLIED))]).T
    return RecordBatch(k * PERIOD_NS, *rng.normal(size=(5, TALLIED, 2)), np.maximum(used, -1))


def tallied(rows: RecordBatch, cuts: list[int]) -> SiteStats:
    """Returns the statistics of a site over records that come in batches cut at some rows."""
    site_stats = SiteStats(HEARD, "s")
    batch_edges = [0, *sorted(cuts), TALLIED]
    for first, last in pairwise(batch_edges):
        site_stats.add(RecordBatch(*(column[first:last] for column in rows)))
    return site_stats


@given(seed=st.integers(0, 1000), cuts=st.lists(st.integers(0, TALLIED), max_size=12))
def test_blocks_change_no_statistics_of_a_site(seed: int, cuts: list[int]) -> None:
    """Statistics over batches of any sizes equal those over one batch."""
    rows = records(seed)
    cut, whole = tallied(rows, cuts), tallied(rows, [])
    for name in (
        "records",
        "peak_error_rad",
        "peak_torque_nm",
        "peak_speed_rad_s",
        "unsynchronised_ns",
        "last_ns",
    ):
        assert getattr(cut, name) == getattr(whole, name)

    assert cut.age_max_ms.tolist() == whole.age_max_ms.tolist()
    assert cut.buckets.tolist() == whole.buckets.tolist()
    assert cut.rms_error_rad == pytest.approx(whole.rms_error_rad)
    for age, age_of_whole in zip(cut.link_ages, whole.link_ages, strict=True):
        assert age.mean_ms == pytest.approx(age_of_whole.mean_ms)

    end, end_of_whole = cut.end(cut.last_ns), whole.end(whole.last_ns)
    assert all(
        np.array_equal(column, column_of_whole)
        for column, column_of_whole in zip(end, end_of_whole, strict=True)
    )


@given(seed=st.integers(0, 1000))
def test_site_statistics_count_all_records(seed: int) -> None:
    """Peaks, means, ages and the intervals of 50 ms follow from all records of a site."""
    rows = records(seed)
    site_stats = tallied(rows, [37, 38, 290])
    error = np.abs(rows.e)
    assert site_stats.peak_error_rad == error.max()
    assert site_stats.peak_torque_nm == np.abs(rows.tau).max()
    assert site_stats.peak_speed_rad_s == np.abs(rows.qd).max()
    assert site_stats.rms_error_rad == pytest.approx(
        max(np.sqrt(np.mean(error[:, j] ** 2)) for j in (0, 1))
    )

    times_ns = [t for t, e in zip(rows.t_ns, error, strict=True) if e.max() >= 1.0]
    assert site_stats.unsynchronised_ns == (times_ns[-1] if times_ns else -1)
    assert site_stats.end(site_stats.last_ns).t_ns.tolist() == rows.t_ns[-100:].tolist()

    ages = [(rows.t_ns[k] - rows.used[k, 1] * 20_000_000) * 1e-6 for k in range(20, TALLIED)]
    assert site_stats.link_ages[1].mean_ms == pytest.approx(np.mean(ages))
    assert site_stats.age_max_ms[1] == pytest.approx(max(ages))

    for bucket, row in enumerate(site_stats.buckets):
        inside = rows.t_ns // BUCKET_NS == bucket
        peaks = (
            error[inside].max(axis=0),
            np.abs(rows.qd[inside]).max(axis=0),
            rows.q[inside][-1],
        )
        assert row.tolist() == np.concatenate(peaks).tolist()


def test_memory_does_not_grow_with_the_records() -> None:
    site_stats, block = SiteStats(HEARD, "s"), records(1)
    for n in range(30):
        site_stats.add(block._replace(t_ns=block.t_ns + n * TALLIED * PERIOD_NS))
    assert len(site_stats.end(0).t_ns) <= 2 * TALLIED
    assert len(site_stats.end(site_stats.last_ns).t_ns) == 100


def test_site_link_without_samples_has_no_age() -> None:
    rows = records(1)
    rows.used[:, 1] = -1
    assert tallied(rows, [])._age_records[1] == 0
    assert tallied(rows, []).link_ages[1].mean_ms is None


def test_a_bucket_without_records_is_marked() -> None:
    rows = records(1)
    keep = (rows.t_ns // BUCKET_NS) != 7
    site_stats = SiteStats(HEARD, "s")
    site_stats.add(RecordBatch(*(column[keep] for column in rows)))
    assert [n for n, row in enumerate(site_stats.buckets) if row[0] < 0] == [7]


WALL = {"kind": "wall", "point_m": [1.25, 0.0], "normal": [-2.0, 0.0], "stiffness_n_m": 2000.0}
QUANTITIES = window_quantities(2)
ASKED = {key: [-1e9, 1e9] for key in QUANTITIES}
CHANGES = {
    "duration_s": 2.0,
    "link.delay_ms": 20.0,
    "sites.m.hands": [{"kind": "pulse", "start_s": 0.0, "end_s": 2.0, "peak_nm": [0.0, -20.0]}],
    "sites.s.environment": [{**WALL, "damping_n_s_m": 5.0}],
}
RECORDS = 200


def windowed(**changes: Any) -> Scenario:
    """Returns `contact` with a push against the wall, and with limits on a window of time."""
    window = {"from_s": 0.5, "to_s": 1.5, "site": "s", **ASKED}
    return load_scenario("contact", {**CHANGES, "expect": {"windows": [window]}, **changes})


@pytest.fixture(scope="module")
def log() -> Log:
    return trilat_net.simulate(windowed())


def rows(seed: int) -> RecordBatch:
    """Two seconds at 100 Hz about the start pose, in and out of a wall."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(5, RECORDS, 2))
    vectors[0] = [-0.6, 1.8] + 0.02 * vectors[0]
    return RecordBatch(
        np.arange(RECORDS) * 10_000_000, *vectors, np.zeros((RECORDS, 1), dtype=np.int64)
    )


def stretched(records: RecordBatch, cuts: list[int], **window: Any) -> dict[str, Any]:
    """Returns the ranges in a window over records that come in batches cut at some rows."""
    scenario = load_scenario("contact", {**CHANGES, "sites.s.rate_hz": 100})
    window_stats = WindowStats(
        ExpectWindow(**{"from_s": 0.5, "to_s": 1.5, **window}), scenario, "s"
    )
    for first, last in pairwise([0, *sorted(cuts), RECORDS]):
        if first < last:
            window_stats.add(RecordBatch(*(column[first:last] for column in records)))
    return window_stats.compute_ranges()


@given(seed=st.integers(0, 100), cuts=st.lists(st.integers(0, RECORDS), max_size=8))
def test_blocks_have_no_influence(seed: int, cuts: list[int]) -> None:
    cut, whole = stretched(rows(seed), cuts), stretched(rows(seed), [])
    for key in QUANTITIES:
        assert cut[key] == pytest.approx(whole[key], rel=1e-12, abs=1e-12)


@given(seed=st.integers(0, 100), outside=st.sampled_from([slice(0, 50), slice(150, RECORDS)]))
def test_records_outside_the_window_leave_no_trace(seed: int, outside: slice) -> None:
    records = rows(seed)
    bent = RecordBatch(*(column.copy() for column in records))
    for column in bent[1:6]:
        column[outside] += 100.0
    assert stretched(bent, []) == stretched(records, [])


@pytest.mark.parametrize(
    ("to_s", "known"), [(1.5, True), (2.0, True), (2.01, False), (5.0, False)]
)
def test_incomplete_windows_have_no_numbers(to_s: float, known: bool) -> None:
    assert bool(stretched(rows(1), [], to_s=to_s)) == known


def test_window_quantities_follow_their_definitions(log: Log) -> None:
    """The wall's force is the force whose torque J' F stands in the records."""
    (window,) = measure_log(log).windows
    site = log["s"]
    inside = (site.t_s >= 0.5) & (site.t_s < 1.5)
    force = np.zeros(len(site))
    for k, q in enumerate(site.q):
        J = np.array(end_effector_jacobian(np.ones(2), q))
        force[k] = -np.linalg.solve(J.T, -site.tau_x[k])[0]

    push, force = -site.tau_x[inside], force[inside]
    expected = {
        "error_peak_rad": np.abs(site.e[inside]).max(),
        "speed_peak_rad_s": np.abs(site.qd[inside]).max(),
        "torque_peak_nm": np.abs(site.tau[inside]).max(),
        "push1_mean_nm": push[:, 0].mean(),
        "push2_mean_nm": push[:, 1].mean(),
        "wall_mean_n": force.mean(),
        "wall_deviation_n": force.std(),
        "wall_peak_n": force.max(),
        "wall_hits": np.sum((force[1:] > 1e-9) & (force[:-1] <= 1e-9)),
    }

    assert expected["wall_hits"] >= 1
    assert {key: window[key].least for key in expected} == pytest.approx(expected, abs=1e-9)
    for joint, key in enumerate(("q1_rad", "q2_rad")):
        assert window[key] == (site.q[inside, joint].min(), site.q[inside, joint].max())


def test_runs_and_their_logs_have_equal_windows(log: Log) -> None:
    (run,), (logged,) = measure_virtual_run(log.scenario).windows, measure_log(log).windows
    assert run.keys() == set(QUANTITIES)
    for key in QUANTITIES:
        assert run[key] == pytest.approx(logged[key], rel=1e-12)


def test_a_window_of_all_sites_has_the_largest(log: Log) -> None:
    everywhere = {
        "from_s": 0.5,
        "to_s": 1.5,
        "error_peak_rad": [0.0, 1.0],
        "torque_peak_nm": [0.0, 1.0],
    }
    (window,) = measure_virtual_run(windowed(expect={"windows": [everywhere]})).windows

    inside = {name: (log[name].t_s >= 0.5) & (log[name].t_s < 1.5) for name in log.sites}
    assert window["error_peak_rad"].most == max(
        np.abs(log[n].e[k]).max() for n, k in inside.items()
    )
    assert window["torque_peak_nm"].least == max(
        np.abs(log[n].tau[k]).max() for n, k in inside.items()
    )


def test_a_run_that_ended_before_has_no_window() -> None:
    assert measure_virtual_run(windowed(**{"limits.qd_limit_rad_s": 0.05})).windows == ({},)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        RANDOM,
        {"sites.m2.rate_hz": 90, "sites.s.rate_hz": 333},
        {"limits.qd_limit_rad_s": 0.3},
    ],
    ids=["plain", "random", "rates", "diverged"],
)
def test_compiled_loop_gives_records_of_the_ticks(changes: dict[str, Any]) -> None:
    """The compiled loop records the same bits as ticks that are executed one by one."""
    varied = scenario(**changes)
    by_tick: dict[str, list[RecordBatch]] = {name: [] for name in varied.names}
    compiled: dict[str, list[RecordBatch]] = {name: [] for name in varied.names}
    diverged_at_s, _ = run_in_batches(
        varied, {name: batches.append for name, batches in by_tick.items()}
    )
    run = run_compiled_in_batches(
        varied, {name: batches.append for name, batches in compiled.items()}
    )
    assert run.diverged_s == diverged_at_s
    for name in varied.names:
        expected = join_batches(by_tick[name])
        batch_of_loop = join_batches(compiled[name])
        for field in RecordBatch._fields:
            np.testing.assert_array_equal(
                getattr(batch_of_loop, field), getattr(expected, field)
            )


def test_any_metric_may_be_expected() -> None:
    """The metric equals that of `trilat compare` on the whole run; a metric without number does
    not hold, and the reason is given.
    """
    expectations = {
        "chatter_nm": [0.0, 1e-9],
        "rms_error_rad": [0.0, 10.0],
        "theta_error_last": [0.0, 1.0],
    }
    scenario = load_scenario("contact", {**CHANGES, "expect": {"metrics": expectations}})

    log = trilat_net.simulate(scenario)
    compared = trilat_net.compare(log, log).metrics
    run, logged = measure_virtual_run(scenario), measure_log(log)
    assert run.metrics == logged.metrics

    outcomes = {
        expectation.key: expectation
        for expectation in evaluate_expectations(scenario.expect, run)
    }
    assert [outcomes[f"metrics.{key}"].held for key in expectations] == [False, True, False]
    assert outcomes["metrics.chatter_nm"].value == compared.row("chatter_nm").values[0]
    assert "nothing is learnt" in outcomes["metrics.theta_error_last"].measured


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        (
            {"chater_nm": [0, 1]},
            "expect.metrics.chater_nm: there is no metric 'chater_nm'; did you mean 'chatter_nm'",
        ),
        (
            {"chatter_nm": [2, 1]},
            r"expect.metrics.chatter_nm: must be \[least, most\], but is \[2, 1\]",
        ),
        ({"chatter_nm": 1}, "expect.metrics"),
    ],
)
def test_an_invalid_expected_metric_is_refused(metrics: dict[str, Any], said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        trilat_net.trials("free", set={"expect": {"metrics": metrics}})

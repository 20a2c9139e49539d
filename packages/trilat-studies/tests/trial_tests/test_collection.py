"""One definition of every metric: a run is measured as its log is, however the records are cut
into batches.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trilat_studies.expectations import ExpectationResult
from trilat_studies.measure_run import RunMetrics
from trilat_studies.record_batches import BATCH_RECORDS, BatchedRun, RecordBatch, run_in_batches
from trilat_studies.run_statistics import SiteStats, WindowStats

import trilat_net
from tests.log.builders import drop_records, edit_log_bytes, make_log_bytes, open_bytes
from trilat_net.core.arms.two_link_arm import end_effector_jacobian
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.expect import ExpectWindow

RANDOM = {"link": {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 10.0}}
SHORT = {"duration_s": 2.5, "rate_hz": 500, "link.delay_ms": 20.0}


def make_short_scenario(**changes: Any) -> Scenario:
    """Returns a short version of `free`, with some settings replaced."""
    return load_scenario("free", {**SHORT, **changes})


def assert_equal_metrics(metrics: RunMetrics, expected: RunMetrics) -> None:
    """Asserts that metrics are equal but for the last bits of means."""
    assert metrics.rms_error_rad == pytest.approx(expected.rms_error_rad, rel=1e-12)
    assert metrics.ages.keys() == expected.ages.keys()
    for link, age in metrics.ages.items():
        assert age.max_ms == expected.ages[link].max_ms
        assert age.mean_ms == pytest.approx(expected.ages[link].mean_ms)
    for field in set(RunMetrics.__struct_fields__) - {"rms_error_rad", "ages"}:
        assert getattr(metrics, field) == getattr(expected, field), field


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
    """A run that is measured while it is simulated has the metrics of its log."""
    assert make_short_scenario().ticks("m1") > BATCH_RECORDS
    scenario = make_short_scenario(**changes)
    log = trilat_net.simulate(scenario)
    assert_equal_metrics(RunMetrics.of_virtual_run(scenario), RunMetrics.of_log(log))


def test_figures_follow_their_definitions() -> None:
    """Errors, spread, poses and times of a run follow from the arrays of its log."""
    scenario = make_short_scenario(**{"expect.synchronised_rad": 0.3})
    metrics = RunMetrics.of_virtual_run(scenario)
    log = trilat_net.simulate(scenario)
    errors_rad = {name: np.abs(log[name].e) for name in log.sites}
    in_last_second = log["m1"].t_s > log["m1"].t_s[-1] - 1.0
    poses = np.array([log[name].q[in_last_second] for name in log.sites])

    assert metrics.simulated_s == 2.5
    assert metrics.peak_error_rad == max(error.max() for error in errors_rad.values())
    end_errors_rad = [error[in_last_second].max() for error in errors_rad.values()]
    assert metrics.end_error_rad == max(end_errors_rad)
    assert metrics.end_spread_rad == (poses.max(axis=0) - poses.min(axis=0)).max()
    assert metrics.end_pose_rad == {name: tuple(log[name].q[-1]) for name in log.sites}

    largest_errors_rad = np.max([error.max(axis=1) for error in errors_rad.values()], axis=0)
    last_time_s = log["m1"].t_s[largest_errors_rad >= 0.3][-1]
    assert 0.0 < last_time_s < 2.4
    assert metrics.synchronised_at_s == last_time_s


def test_an_undisturbed_run_has_constant_ages() -> None:
    """Over links of 20 ms every sample is 20 ms old, and no sample is late or missing."""
    metrics = RunMetrics.of_virtual_run(make_short_scenario())
    for age in metrics.ages.values():
        assert age.mean_ms == age.max_ms == 20.0
    assert metrics.late_samples == 0
    assert metrics.missing == 0
    assert metrics.end.diverged_at_s is None


def test_a_run_without_convergence_has_no_convergence_time() -> None:
    scenario = make_short_scenario(**{"expect.synchronised_rad": 1e-6})
    assert RunMetrics.of_virtual_run(scenario).synchronised_at_s is None


def test_a_link_without_samples_has_no_age() -> None:
    scenario = make_short_scenario(links={"m1->s": {"delay_ms": 9000.0}})
    ages = RunMetrics.of_virtual_run(scenario).ages
    assert ages["m1->s"].mean_ms is ages["m1->s"].max_ms is None
    assert ages["m2->s"].max_ms == 20.0


def test_a_diverged_run_has_its_instant() -> None:
    metrics = RunMetrics.of_virtual_run(make_short_scenario(**{"limits.qd_limit_rad_s": 0.3}))
    assert metrics.end.diverged_at_s is not None
    assert metrics.simulated_s == pytest.approx(metrics.end.diverged_at_s, abs=0.01)
    assert metrics.missing == 0


@pytest.mark.parametrize(
    "missing_ticks",
    [set(), {3, 4, 100}, set(range(60, 120)), set(range(120))],
    ids=["none", "three", "second half", "all"],
)
def test_every_missing_record_of_a_log_is_counted(missing_ticks: set[int]) -> None:
    log_bytes = edit_log_bytes(make_log_bytes("free"), record=drop_records("s", missing_ticks))
    assert RunMetrics.of_log(open_bytes(log_bytes)).missing == len(missing_ticks)


def test_missing_records_of_all_sites_are_counted() -> None:
    empty = edit_log_bytes(make_log_bytes("free"), record=lambda _: None)
    assert RunMetrics.of_log(open_bytes(empty)).missing == 3 * 120


def test_a_site_without_records_leaves_metrics_open() -> None:
    """What needs the records of all sites is not known without those of one site."""
    log_bytes = edit_log_bytes(
        make_log_bytes("free"), record=drop_records("s", set(range(120)))
    )
    metrics = RunMetrics.of_log(open_bytes(log_bytes))
    assert metrics.synchronised_at_s is None
    assert metrics.end_spread_rad is None
    assert metrics.ages["m1->s"].mean_ms is None


PERIOD_NS = 10_000_000
TICKS = 400
BUCKET_NS = 50_000_000
RATES = {"sites.m1.rate_hz": 100, "sites.m2.rate_hz": 50, "sites.s.rate_hz": 100}
RATES_SCENARIO = load_scenario("free", {**RATES, "expect.synchronised_rad": 1.0})


def make_site_records(seed: int) -> RecordBatch:
    """Returns four seconds at 100 Hz with peers at 100 and 50 Hz.

    Samples of the second peer are in use from tick 20 on.
    """
    rng = np.random.default_rng(seed)
    k = np.arange(TICKS)
    second_used = np.where(k < 20, -1, k // 2 - rng.integers(2, 9, TICKS))
    used = np.maximum(np.array([k - 5, second_used]).T, -1)
    return RecordBatch(k * PERIOD_NS, *rng.normal(size=(5, TICKS, 2)), used)


def iterate_batches(records: RecordBatch, cuts: list[int]) -> Iterator[RecordBatch]:
    """Yields records in batches that end at some rows."""
    for first, last in pairwise([0, *sorted(cuts), len(records.t_ns)]):
        yield RecordBatch(*(column[first:last] for column in records))


def collect_site_stats(records: RecordBatch, cuts: list[int]) -> SiteStats:
    """Returns the statistics of a site over records that come in batches cut at some rows."""
    site_stats = SiteStats(RATES_SCENARIO, "s")
    for batch in iterate_batches(records, cuts):
        site_stats.add(batch)
    return site_stats


@given(seed=st.integers(0, 1000), cuts=st.lists(st.integers(0, TICKS), max_size=12))
def test_blocks_change_no_statistics_of_a_site(seed: int, cuts: list[int]) -> None:
    """Statistics over batches of any sizes equal those over one batch."""
    records = make_site_records(seed)
    cut = collect_site_stats(records, cuts)
    whole = collect_site_stats(records, [])
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
    for age, expected_age in zip(cut.link_ages, whole.link_ages, strict=True):
        assert age.mean_ms == pytest.approx(expected_age.mean_ms)

    end = cut.end(cut.last_ns)
    expected_end = whole.end(whole.last_ns)
    for column, expected_column in zip(end, expected_end, strict=True):
        assert np.array_equal(column, expected_column)


@given(seed=st.integers(0, 1000))
def test_site_statistics_count_all_records(seed: int) -> None:
    """Peaks, means, ages and the intervals of 50 ms follow from all records of a site."""
    records = make_site_records(seed)
    site_stats = collect_site_stats(records, [37, 38, 290])
    error_rad = np.abs(records.e)
    assert site_stats.peak_error_rad == error_rad.max()
    assert site_stats.peak_torque_nm == np.abs(records.tau).max()
    assert site_stats.peak_speed_rad_s == np.abs(records.qd).max()
    rms_of_joints_rad = np.sqrt(np.mean(error_rad**2, axis=0))
    assert site_stats.rms_error_rad == pytest.approx(rms_of_joints_rad.max())

    unsynchronised = np.flatnonzero(error_rad.max(axis=1) >= 1.0)
    last_ns = records.t_ns[unsynchronised[-1]] if len(unsynchronised) else -1
    assert site_stats.unsynchronised_ns == last_ns
    assert site_stats.end(site_stats.last_ns).t_ns.tolist() == records.t_ns[-100:].tolist()

    ages_ms = (records.t_ns[20:] - records.used[20:, 1] * 20_000_000) * 1e-6
    assert site_stats.link_ages[1].mean_ms == pytest.approx(ages_ms.mean())
    assert site_stats.age_max_ms[1] == pytest.approx(ages_ms.max())


@given(seed=st.integers(0, 1000))
def test_a_bucket_has_its_peaks_and_last_pose(seed: int) -> None:
    """An interval of 50 ms keeps the peaks of errors and speeds, and the pose of its last record."""
    records = make_site_records(seed)
    site_stats = collect_site_stats(records, [37, 38, 290])
    for number, bucket in enumerate(site_stats.buckets):
        inside = records.t_ns // BUCKET_NS == number
        peak_errors_rad = np.abs(records.e[inside]).max(axis=0)
        peak_speeds_rad_s = np.abs(records.qd[inside]).max(axis=0)
        last_pose_rad = records.q[inside][-1]
        expected = np.concatenate([peak_errors_rad, peak_speeds_rad_s, last_pose_rad])
        assert bucket.tolist() == expected.tolist()


def test_memory_does_not_grow_with_the_records() -> None:
    site_stats = SiteStats(RATES_SCENARIO, "s")
    records = make_site_records(1)
    for n in range(30):
        site_stats.add(records._replace(t_ns=records.t_ns + n * TICKS * PERIOD_NS))
    assert len(site_stats.end(0).t_ns) <= 2 * TICKS
    assert len(site_stats.end(site_stats.last_ns).t_ns) == 100


def test_site_link_without_samples_has_no_age() -> None:
    records = make_site_records(1)
    records.used[:, 1] = -1
    site_stats = collect_site_stats(records, [])
    assert site_stats._age_records[1] == 0
    assert site_stats.link_ages[1].mean_ms is None


def test_a_bucket_without_records_is_marked() -> None:
    records = make_site_records(1)
    keep = (records.t_ns // BUCKET_NS) != 7
    site_stats = SiteStats(RATES_SCENARIO, "s")
    site_stats.add(RecordBatch(*(column[keep] for column in records)))
    marked = [number for number, bucket in enumerate(site_stats.buckets) if bucket[0] < 0]
    assert marked == [7]


WALL = {"kind": "wall", "point_m": [1.25, 0.0], "normal": [-2.0, 0.0], "stiffness_n_m": 2000.0}
QUANTITIES = ExpectWindow.list_quantities(2)
WIDE_LIMITS = {key: [-1e9, 1e9] for key in QUANTITIES}
PUSHED = {
    "duration_s": 2.0,
    "link.delay_ms": 20.0,
    "sites.m.hands": [{"kind": "pulse", "start_s": 0.0, "end_s": 2.0, "peak_nm": [0.0, -20.0]}],
    "sites.s.environment": [{**WALL, "damping_n_s_m": 5.0}],
}
WALL_TICKS = 200


def make_window_scenario(**changes: Any) -> Scenario:
    """Returns `contact` with a push against the wall, and with limits on a window of time."""
    window = {"from_s": 0.5, "to_s": 1.5, "site": "s", **WIDE_LIMITS}
    return load_scenario("contact", {**PUSHED, "expect": {"windows": [window]}, **changes})


@pytest.fixture(scope="module")
def log() -> Log:
    """The log of a push against the wall."""
    return trilat_net.simulate(make_window_scenario())


def make_wall_records(seed: int) -> RecordBatch:
    """Returns two seconds at 100 Hz about the start pose, in and out of a wall."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(5, WALL_TICKS, 2))
    vectors[0] = [-0.6, 1.8] + 0.02 * vectors[0]
    used = np.zeros((WALL_TICKS, 1), dtype=np.int64)
    return RecordBatch(np.arange(WALL_TICKS) * PERIOD_NS, *vectors, used)


def collect_window_ranges(
    records: RecordBatch, cuts: list[int], to_s: float = 1.5
) -> dict[str, Any]:
    """Returns the ranges in a window over records that come in batches cut at some rows."""
    scenario = load_scenario("contact", {**PUSHED, "sites.s.rate_hz": 100})
    window_stats = WindowStats(0.5, to_s, scenario, "s")
    for batch in iterate_batches(records, cuts):
        if len(batch.t_ns):
            window_stats.add(batch)
    return window_stats.compute_ranges()


@given(seed=st.integers(0, 100), cuts=st.lists(st.integers(0, WALL_TICKS), max_size=8))
def test_blocks_have_no_influence(seed: int, cuts: list[int]) -> None:
    """The ranges in a window do not depend on the batches of its records."""
    records = make_wall_records(seed)
    cut = collect_window_ranges(records, cuts)
    whole = collect_window_ranges(records, [])
    for key in QUANTITIES:
        assert cut[key] == pytest.approx(whole[key], rel=1e-12, abs=1e-12)


@given(
    seed=st.integers(0, 100), outside=st.sampled_from([slice(0, 50), slice(150, WALL_TICKS)])
)
def test_records_outside_the_window_leave_no_trace(seed: int, outside: slice) -> None:
    records = make_wall_records(seed)
    changed = RecordBatch(*(column.copy() for column in records))
    for column in changed[1:6]:
        column[outside] += 100.0
    assert collect_window_ranges(changed, []) == collect_window_ranges(records, [])


@pytest.mark.parametrize(
    ("to_s", "known"), [(1.5, True), (2.0, True), (2.01, False), (5.0, False)]
)
def test_incomplete_windows_have_no_numbers(to_s: float, known: bool) -> None:
    assert bool(collect_window_ranges(make_wall_records(1), [], to_s)) == known


def test_window_quantities_follow_their_definitions(log: Log) -> None:
    """The wall's force is the force whose torque J' F stands in the records."""
    (window,) = RunMetrics.of_log(log).windows
    site = log["s"]
    inside = (site.t_s >= 0.5) & (site.t_s < 1.5)
    push_nm = -site.tau_x[inside]
    force_n = np.zeros(len(push_nm))
    for k, q in enumerate(site.q[inside]):
        jacobian = np.array(end_effector_jacobian(np.ones(2), q))
        force_n[k] = -np.linalg.solve(jacobian.T, push_nm[k])[0]

    expected = {
        "error_peak_rad": np.abs(site.e[inside]).max(),
        "speed_peak_rad_s": np.abs(site.qd[inside]).max(),
        "torque_peak_nm": np.abs(site.tau[inside]).max(),
        "push1_mean_nm": push_nm[:, 0].mean(),
        "push2_mean_nm": push_nm[:, 1].mean(),
        "wall_mean_n": force_n.mean(),
        "wall_deviation_n": force_n.std(),
        "wall_peak_n": force_n.max(),
        "wall_hits": np.sum((force_n[1:] > 1e-9) & (force_n[:-1] <= 1e-9)),
    }

    assert expected["wall_hits"] >= 1
    assert {key: window[key].least for key in expected} == pytest.approx(expected, abs=1e-9)
    for joint, key in enumerate(("q1_rad", "q2_rad")):
        assert window[key] == (site.q[inside, joint].min(), site.q[inside, joint].max())


def test_runs_and_their_logs_have_equal_windows(log: Log) -> None:
    (window,) = RunMetrics.of_virtual_run(log.scenario).windows
    (expected,) = RunMetrics.of_log(log).windows
    assert window.keys() == set(QUANTITIES)
    for key in QUANTITIES:
        assert window[key] == pytest.approx(expected[key], rel=1e-12)


def test_a_window_of_all_sites_has_the_largest(log: Log) -> None:
    everywhere = {
        "from_s": 0.5,
        "to_s": 1.5,
        "error_peak_rad": [0.0, 1.0],
        "torque_peak_nm": [0.0, 1.0],
    }
    scenario = make_window_scenario(expect={"windows": [everywhere]})
    (window,) = RunMetrics.of_virtual_run(scenario).windows

    errors_rad = []
    torques_nm = []
    for name in log.sites:
        inside = (log[name].t_s >= 0.5) & (log[name].t_s < 1.5)
        errors_rad.append(np.abs(log[name].e[inside]).max())
        torques_nm.append(np.abs(log[name].tau[inside]).max())
    assert window["error_peak_rad"].most == max(errors_rad)
    assert window["torque_peak_nm"].least == max(torques_nm)


def test_a_run_that_ended_before_has_no_window() -> None:
    scenario = make_window_scenario(**{"limits.qd_limit_rad_s": 0.05})
    assert RunMetrics.of_virtual_run(scenario).windows == ({},)


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
    scenario = make_short_scenario(**changes)
    by_tick: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    compiled: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    diverged_at_s, _ = run_in_batches(
        scenario, {name: batches.append for name, batches in by_tick.items()}
    )
    batched = BatchedRun(scenario, {name: batches.append for name, batches in compiled.items()})
    batched.finish()
    assert batched.run.diverged_s == diverged_at_s
    for name in scenario.names:
        records = RecordBatch.join(compiled[name])
        expected = RecordBatch.join(by_tick[name])
        for column, expected_column in zip(records, expected, strict=True):
            np.testing.assert_array_equal(column, expected_column)


def test_any_metric_may_be_expected() -> None:
    """A metric equals that of `trilat compare`; without a number it does not hold, for a reason."""
    expectations = {
        "chatter_nm": [0.0, 1e-9],
        "rms_error_rad": [0.0, 10.0],
        "theta_error_last": [0.0, 1.0],
    }
    scenario = load_scenario("contact", {**PUSHED, "expect": {"metrics": expectations}})

    log = trilat_net.simulate(scenario)
    compared = trilat_net.compare(log, log).metrics
    run = RunMetrics.of_virtual_run(scenario)
    assert run.metrics == RunMetrics.of_log(log).metrics

    outcomes = {
        outcome.key: outcome for outcome in ExpectationResult.list_of_run(run, scenario.expect)
    }
    assert [outcomes[f"metrics.{key}"].held for key in expectations] == [False, True, False]
    assert outcomes["metrics.chatter_nm"].value == compared.row("chatter_nm").values[0]
    assert "nothing is learnt" in outcomes["metrics.theta_error_last"].measured

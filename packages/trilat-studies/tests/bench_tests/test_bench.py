"""The suite: its runs are the program's runs, interruptions leave no trace, and its intervals
equal SciPy's.
"""

import shlex
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import optimize, stats
from study_builders import (
    StopError,
    make_bench_run,
    plan_small_suite,
    stop_after,
    use_single_runs,
)
from trilat_studies.bench import (
    BenchResults,
    bench_plan,
    plan_bench,
    prepare_bench_folder,
    run_bench,
)
from trilat_studies.bench.bench_plan import (
    EQUAL_LAWS,
    KNOWLEDGE,
    LINKS,
    SHORTER_REACH,
    STUDIES,
    TASKS,
    TUNED_ROUND_TRIPS_MS,
    BenchCell,
    BenchPlan,
    TunedGains,
    build_settings,
    choose_round_trip,
    explain_no_cell,
    fingerprint_tuning,
    format_settings,
    read_gains,
    tune_laws,
    write_gains,
)
from trilat_studies.bench.bench_results import LEAST_CONTACT_N, BenchCellResult, BenchRun
from trilat_studies.bench.bench_run import (
    MAX_RUN_TICKS,
    BenchRunItem,
    JudgedRun,
    find_least_energy,
)
from trilat_studies.record_batches import RecordBatch
from trilat_studies.tuning import plan_tuning
from trilat_studies.tuning.candidate import CandidateClass, CandidateScore, TuningScenario
from trilat_studies.tuning.search_space import SEARCH_SPACES

import trilat_net
from trilat_net.analysis.run_end import EndBehaviour, RunEnd, Stability
from trilat_net.analysis.stability_decision import LoopRoots
from trilat_net.analysis.twins.envelope_trend import EnvelopeFit, EnvelopeTrend
from trilat_net.analysis.twins.twin_growth import TwinGrowth
from trilat_net.core.step.vectors import Array
from trilat_net.errors import UsageError
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario
from trilat_net.scenario.laws import BUILT_IN
from trilat_net.work.run_journal import encode_csv

WALL_M = 1.3376933693863516
"""Position of the wall of the task with contact."""
WALL_N_M = 2000.0
"""Stiffness of that wall."""
HAND_NM_RAD = 50.0
"""Stiffness with which the user's hand pulls each joint to its target."""


def plan_contact_cell(**gains: float) -> BenchCell:
    """Returns a cell in which the slave touches a wall over 8 ms, under P+d with these gains."""
    (cell,) = plan_small_suite(tasks=["contact"], links=["rtt8"]).cells
    return replace_gains(cell, **gains) if gains else cell


def replace_gains(cell: BenchCell, **gains: float) -> BenchCell:
    """Returns a cell whose control law has other gains."""
    return cell._replace(tuned=msgspec.structs.replace(cell.tuned, gains=gains))


def run_cell(cell: BenchCell) -> BenchRun:
    """Returns the run of a cell with its first seed."""
    return BenchRunItem(cell, 1).run()


def encode_files(results: BenchResults) -> list[str]:
    """Returns the page, the table of cells and the table of runs that a benchmark writes."""
    return [
        results.build_page("trilat bench"),
        encode_csv(results.to_rows()),
        results.encode_runs(),
    ]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> BenchResults:
    """A benchmark that ran without an interruption."""
    folder = prepare_bench_folder(
        plan_small_suite(), tmp_path_factory.mktemp("suite") / "whole"
    )
    return run_bench(folder, jobs=1)


def test_an_interrupted_suite_resumes_to_the_same_bytes(
    whole: BenchResults, tmp_path: Path
) -> None:
    """The second call computes only the missing run, and all files equal those of one call."""
    folder = prepare_bench_folder(plan_small_suite(), tmp_path / "parts")
    with pytest.raises(StopError):
        run_bench(folder, jobs=1, progress=stop_after(2))

    counts: list[int] = []
    reopened_folder = prepare_bench_folder(plan_small_suite(), tmp_path / "parts")
    resumed = run_bench(reopened_folder, jobs=1, progress=lambda done, _: counts.append(done))
    assert counts == [3]
    assert resumed.runs == whole.runs
    assert encode_files(resumed) == encode_files(whole)


@pytest.mark.long
def test_the_executor_of_the_cells_changes_no_result(
    whole: BenchResults, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(1) as executor:
        bench = run_bench(
            prepare_bench_folder(plan_small_suite(), tmp_path / "elsewhere"), on=executor
        )
    assert encode_files(bench) == encode_files(whole)


def test_seeds_differ_only_where_numbers_are_drawn(whole: BenchResults) -> None:
    """Only the runs over a lossy link are random, and each is a function of its seed."""
    constant, first, second = whole.runs
    assert not constant.random
    assert first.random
    assert first.error_rad != second.error_rad
    lossy_cell = whole.plan.cells[1]
    assert BenchRunItem(lossy_cell, 2).run() == second


def test_a_cell_equals_the_log_of_its_command(whole: BenchResults) -> None:
    """The error and the user's torque of a run follow from a log of its printed command."""
    cell = whole.plan.cells[1]
    run = whole.runs[1]
    arguments = shlex.split(cell.build(1).command)
    assert arguments[:3] == ["trilat", "sim", "_bench_two"]

    log = trilat_net.simulate(load_scenario(arguments[2], arguments[4::2]))
    assert log.scenario.sha256 == run.sha256
    user = log["m1"]
    error_rad = log["s"].q - user.q
    assert run.error_rad == pytest.approx(np.sqrt(np.mean(error_rad**2)), rel=1e-12)
    hand_nm = user.tau_x - 0.5 * user.qd  # without the friction of the user's arm
    assert run.hand_nm == pytest.approx(np.sqrt(np.mean(hand_nm**2)), rel=1e-12)


def test_effort_equals_that_of_the_compiled_run(whole: BenchResults) -> None:
    scenario = whole.plan.cells[0].build(1).scenario
    run = FusedRun(scenario)
    run.advance_to(scenario.duration_s)
    assert whole.runs[0].effort_nm == pytest.approx(run.totals.effort_nm, rel=1e-12)


def place_tip(q: Array) -> tuple[Array, Array]:
    """Returns the end effector of two links of 1 m, and its Jacobian."""
    upper_rad = q[0]
    fore_rad = q[0] + q[1]
    x_m = np.cos(upper_rad) + np.cos(fore_rad)
    y_m = np.sin(upper_rad) + np.sin(fore_rad)
    jacobian = np.array([[-y_m, -np.sin(fore_rad)], [x_m, np.cos(fore_rad)]])
    return np.array([x_m, y_m]), jacobian


def find_rest_in_contact(K: float, settings: Any) -> tuple[Array, Array]:
    """Returns the pose of the user's arm at rest under P+d, and the torque of the hand on that arm."""
    target_rad = np.array(settings["sites.m1.hands"][0]["to_rad"])

    def compute_unbalanced_torque(q_of_both: Array) -> Array:
        """Returns the torques that remain on the user's arm and on the slave, in N m."""
        user_q = q_of_both[:2]
        slave_q = q_of_both[2:]
        tip, jacobian = place_tip(slave_q)
        wall_force = [-WALL_N_M * max(tip[0] - WALL_M, 0.0), 0.0]
        wall_torque = jacobian.T @ wall_force
        link_torque = K * (user_q - slave_q)
        hand_torque = HAND_NM_RAD * (target_rad - user_q)
        return np.concatenate([hand_torque - link_torque, link_torque + wall_torque])

    start = [*target_rad, *target_rad]
    q = optimize.fsolve(compute_unbalanced_torque, start, xtol=1e-12)[:2]
    return q, HAND_NM_RAD * (target_rad - q)


def test_stiffness_at_the_hand_is_static() -> None:
    """Two springs and the wall under P+d, nearly at rest 2 s after contact."""
    ends = []
    for settings in (SHORTER_REACH, TASKS["contact"].settings):
        q, torque = find_rest_in_contact(60.0, settings)
        tip, jacobian = place_tip(q)
        ends.append((tip[0], np.linalg.solve(jacobian.T, torque)[0]))

    (near_m, near_n), (far_m, far_n) = ends
    run = run_cell(plan_contact_cell(K=60.0, d=6.0))
    assert run.stiffness_n_m == pytest.approx((far_n - near_n) / (far_m - near_m), rel=5e-2)


def test_stiffness_is_measured_two_seconds_after_contact() -> None:
    """Two runs that press differently far give the stiffness, each 1.9 to 2.1 s after contact."""
    cell = plan_contact_cell(K=60.0, d=6.0)
    experiment = cell.build(1)
    ends = []
    for settings in (SHORTER_REACH, TASKS["contact"].settings):
        overrides = [*experiment.overrides, *format_settings(settings)]
        scenario = TuningScenario.load(experiment.source, overrides).scenario
        log = trilat_net.simulate(scenario)
        user = log["m1"]
        slave = log["s"]
        slave_m = np.cos(slave.q[:, 0]) + np.cos(slave.q.sum(axis=1))
        touch_s = slave.t_s[slave_m > WALL_M][0]

        window = (user.t_s > touch_s + 1.8995) & (user.t_s < touch_s + 2.0995)
        tips = [place_tip(q) for q in user.q[window]]
        hand_torques = 0.5 * user.qd[window] - user.tau_x[window]
        forces_n = [
            np.linalg.solve(jacobian.T, torque)[0]
            for (_, jacobian), torque in zip(tips, hand_torques, strict=True)
        ]
        ends.append((np.mean([tip[0] for tip, _ in tips]), np.mean(forces_n)))

    (near_m, near_n), (far_m, far_n) = ends
    run = run_cell(cell)
    assert run.stiffness_n_m == pytest.approx((far_n - near_n) / (far_m - near_m), rel=1e-6)


def test_free_impedance_is_that_of_coupled_arms() -> None:
    """P+d over 4 ms: D = M s^2 + (d + 0.5) s + K - K e^-sT (M s^2 + d s + K)^-1 K e^-sT."""
    K = 60.0
    d = 12.0
    s = 2j * np.pi  # at 1 Hz
    q, _ = find_rest_in_contact(K, TASKS["contact"].settings)
    cosine = np.cos(q[1])
    M = np.array([[3.0 + 2.0 * cosine, 1.0 + cosine], [1.0 + cosine, 1.0]])
    identity = np.eye(2)

    coupling = K * np.exp(-4e-3 * s)
    slave = M * s**2 + (d * s + K) * identity
    user = M * s**2 + ((d + 0.5) * s + K) * identity - coupling**2 * np.linalg.inv(slave)

    _, jacobian = place_tip(q)
    motion = np.linalg.solve(user + (5.0 * s + 50.0) * identity, jacobian[0])
    force = np.linalg.solve(jacobian.T, user @ motion)
    expected = abs(force[0] / (s * (jacobian @ motion)[0]))

    run = run_cell(plan_contact_cell(K=K, d=d))
    assert run.free_impedance_n_s_m == pytest.approx(expected, rel=2e-2)
    assert run.impedance_n_s_m is not None


def test_a_barely_touched_wall_masks_the_numbers() -> None:
    """A run whose wall force is too small has no stiffness, and its cell no error."""
    cell = plan_contact_cell(K=2.0, d=20.0)
    run = run_cell(cell)
    assert run.wall_n is not None
    assert run.wall_n < LEAST_CONTACT_N
    assert run.stiffness_n_m is None
    results = BenchResults(
        BenchPlan("round-trips", [cell], [("p_d", "level")]), {(cell.key, 1): run}
    )
    assert results.places[0].compute_mean("error_rad") is None
    assert "no contact" in results.build_page("trilat bench")


def test_a_longer_run_stays_unstable(tmp_path: Path) -> None:
    (cell,) = plan_small_suite(links=["rtt272"]).cells
    plan = BenchPlan("round-trips", [replace_gains(cell, K=60.0, d=0.5)], [("p_d", "level")])
    (run,) = run_bench(prepare_bench_folder(plan, tmp_path / "suite"), jobs=1).runs
    assert run.stability is Stability.NOT_STABLE
    assert run.behaviour is EndBehaviour.DIVERGED or run.confirmed
    assert run_cell(replace_gains(cell, K=10.0, d=4.0)).stability is Stability.STABLE


def make_joint_records(t_ns: Array, qd: Array, tau_x: Array) -> RecordBatch:
    """Returns records of one joint."""
    zero = np.zeros((len(t_ns), 1))
    return RecordBatch(
        t_ns, zero, qd[:, None], zero, zero, tau_x[:, None], np.zeros((len(t_ns), 0), int)
    )


def test_least_energy_counts_energy_from_outside() -> None:
    """The outside puts in 3 J in the first second, takes out 5 J in the second, and puts in 4 J more."""
    t_ns = np.arange(3001) * 1_000_000
    power = np.select([t_ns < 1e9, t_ns < 2e9], [3.0, -5.0], 4.0)
    moved = make_joint_records(t_ns, np.full(3001, 2.0), -power / 2.0)
    free = make_joint_records(t_ns, np.ones(3001), np.zeros(3001))
    assert find_least_energy({"s": moved}) == pytest.approx(-2.0, abs=0.01)
    assert find_least_energy({"s": free}) == 0.0


def test_an_interrupted_confirmation_resumes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Every run is repeated once over twice its length, and no finished run a second time."""
    lengths_s: list[float] = []  # 0 for a first run, and its length for a repetition

    def run_bounded(item: BenchRunItem) -> BenchRun:
        lengths_s.append(item.to_s)
        return make_bench_run(
            item.cell,
            item.seed,
            stability=Stability.NOT_STABLE,
            behaviour=EndBehaviour.BOUNDED,
            length_s=item.to_s or 30.0,
            to_s=item.to_s,
        )

    counts: list[int] = []

    def interrupt_first_repetition(done: int, _total: int) -> None:
        counts.append(done)
        if len(counts) == 4:  # the first of three repetitions
            raise KeyboardInterrupt

    monkeypatch.setattr(BenchRunItem, "run", run_bounded)
    use_single_runs(monkeypatch)
    folder = prepare_bench_folder(plan_small_suite(), tmp_path / "suite")
    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt):
        run_bench(folder, on=executor, progress=interrupt_first_repetition)
    assert lengths_s.count(0.0) == 3

    before = len(lengths_s)
    folder = prepare_bench_folder(plan_small_suite(), tmp_path / "suite")
    with ThreadPoolExecutor(1) as executor:
        results = run_bench(folder, on=executor)
    assert lengths_s[before:] == [60.0, 60.0]
    assert [(run.confirmed, run.length_s) for run in results.runs] == [(True, 60.0)] * 3


def make_judged_run(rate_per_s: float | None, **more: Any) -> JudgedRun:
    """Returns the judgement of a run of 20 s of two sites that decays slowly."""
    fit = EnvelopeFit(EnvelopeTrend.HARDLY, -0.02)
    facts = {
        "scenario": plan_small_suite(links=["rtt8"]).cells[0].build(1).scenario,
        "records": {},
        "end": RunEnd(EndBehaviour.HARDLY, fit, fit, 0.1, 0.1),
        "twins": TwinGrowth(""),
        "roots": LoopRoots("stable" if rate_per_s else "", rate_per_s, True),
        "stability": Stability.OPEN,
        "text": "open",
        **more,
    }
    return JudgedRun(**facts)


@pytest.mark.parametrize(
    ("rate_per_s", "length_s", "phrase"),
    [
        (-0.01, 600.0, ""),  # the root, six time constants of 100 s
        (None, 300.0, ""),  # no roots: the envelope, six of 50 s
        (-0.001, 1500.0, f"safety limit of {MAX_RUN_TICKS} ticks"),  # 6000 s of two sites
        (-1.0, 20.0, ""),
    ],
)
def test_run_length_follows_the_slowest_time_constant(
    rate_per_s: float | None, length_s: float, phrase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judgement = make_judged_run(rate_per_s)
    monkeypatch.setattr(
        JudgedRun,
        "simulate",
        lambda scenario, to_s: judgement._replace(
            scenario=msgspec.structs.replace(scenario, duration_s=to_s)
        ),
    )
    longer = judgement.lengthen()
    assert longer.scenario.duration_s == length_s
    assert phrase in longer.text


def test_a_decided_run_at_rest_is_not_extended() -> None:
    fit = EnvelopeFit(EnvelopeTrend.DECAYS, -0.02)
    end = RunEnd(EndBehaviour.CONVERGED, fit, fit, 0.0, 0.0)
    judgement = make_judged_run(-0.001, end=end, stability=Stability.SETTLED)
    assert judgement.lengthen() is judgement


def test_a_longer_run_refutes_or_confirms() -> None:
    """The judgement of the longer run counts, and only the same judgement confirms the first."""
    cell = plan_small_suite(links=["rtt8"]).cells[0]
    plan = BenchPlan("round-trips", [cell], [("p_d", "level")])
    for longer_stability, is_confirmed in (
        (Stability.STABLE, False),
        (Stability.NOT_STABLE, True),
    ):
        first = make_bench_run(cell, stability=Stability.NOT_STABLE, length_s=40.0)
        longer = make_bench_run(cell, stability=longer_stability, length_s=80.0, to_s=80.0)
        results = BenchResults(plan, {(run.cell, 1): run for run in (first, longer)})
        (run,) = results.runs
        assert (run.stability, run.confirmed) == (longer_stability, is_confirmed)


def test_a_law_without_stable_gains_has_empty_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page says that a law without gains has none, and a study of that law alone is refused."""
    gains_without_pd_d = read_gains()
    for key, gains in gains_without_pd_d.items():
        if gains.law == "pd_d":
            gains_without_pd_d[key] = msgspec.structs.replace(gains, gains={})
    monkeypatch.setattr(bench_plan, "read_gains", lambda: gains_without_pd_d)

    plan = plan_bench("round-trips", laws=["p_d", "pd_d"], tasks=["free"], links=["rtt8"])
    assert [cell.law for cell in plan.cells] == ["p_d"]
    run = make_bench_run(plan.cells[0])
    page = BenchResults(plan, {(run.cell, 1): run}).build_page("trilat bench")
    assert "| pd_d (two sites) | no gains |" in page
    with pytest.raises(UsageError, match="no candidate was stable for pd_d"):
        plan_bench("round-trips", laws=["pd_d"], tasks=["free"], links=["rtt8"])


def test_laws_of_equal_torque_run_once() -> None:
    """`six_channel` is `four_channel` with a check of the shares, so both have the same runs."""
    for law, equal in EQUAL_LAWS.items():
        kind = BUILT_IN[law]
        equal_kind = BUILT_IN[equal]
        assert (kind.torque, kind.begin) == (equal_kind.torque, equal_kind.begin)
        assert kind.Settings.__struct_fields__ == equal_kind.Settings.__struct_fields__
        with pytest.raises(UsageError, match=f"{law} computes the torque of {equal}"):
            plan_bench("full", laws=[law])
        assert all(law not in laws for laws in STUDIES["full"].laws.values())


def test_laws_get_nine_tenths_of_gravity() -> None:
    laws = STUDIES["full"].laws
    for form in laws:
        for law in laws[form]:
            reason = explain_no_cell(law, form, "gravity-90")
            assert reason == ("exact model" if law == "impedance" else bench_plan.NO_GAINS)

    (gravity_cell,) = plan_bench(
        "full", laws=["p_d"], tasks=["gravity-90"], links=["rtt68"]
    ).cells
    (exact,) = plan_bench("full", laws=["p_d"], tasks=["free"], links=["rtt68"]).cells
    assert gravity_cell.inputs != exact.inputs
    controls = [cell.build(1).scenario.sites["s"].control for cell in (gravity_cell, exact)]
    assert [control.gravity for control in controls] == [0.9, 1.0]  # type: ignore[attr-defined]


def test_a_law_with_constant_shares_hands_nothing_over() -> None:
    tasks = {cell.task for cell in plan_bench("full", laws=["wave"], links=["rtt68"]).cells}
    assert tasks == TASKS.keys() - {"handover"}


@pytest.mark.parametrize("base", ["_bench_three", "_bench_two"])
def test_no_user_is_without_friction(base: str) -> None:
    users = [site for site in load_scenario(base).sites.values() if site.role == "master"]
    assert all(min(user.environment[0].damping_nm_s_rad) > 0.0 for user in users)  # type: ignore[union-attr]


def test_a_run_lasts_for_forty_round_trips() -> None:
    """A run lasts for forty round trips of its link, and at least for 20 s."""
    links = [link for link in LINKS if "loss" not in link]
    durations_s = [build_settings("two", "free", link)["duration_s"] for link in links]
    round_trips_s = (0.008, 0.068, 0.136, 0.272, 0.544, 1.088, 0.0, 0.0, 0.6, 0.0)
    assert durations_s == [
        pytest.approx(max(20.0, 40.0 * round_trip_s)) for round_trip_s in round_trips_s
    ]


@pytest.mark.long
def test_sharing_error_counts_dominance_at_that_time() -> None:
    """The error refers to the present shares: after the handover the second user has three quarters."""
    (cell,) = plan_bench("full", laws=["p_d"], tasks=["handover"], links=["rtt68"]).cells
    run = run_cell(cell)
    log = trilat_net.simulate(cell.build(1).scenario)
    share_of_m1 = np.interp(log["s"].t_s, [7.0, 9.0], [0.75, 0.25])[:, None]
    reference_rad = share_of_m1 * log["m1"].q + (1.0 - share_of_m1) * log["m2"].q
    error_rad = log["s"].q - reference_rad
    assert run.error_rad == pytest.approx(np.sqrt(np.mean(error_rad**2)), rel=1e-9)


def make_bench_cell_result(*errors_rad: float | None) -> BenchCellResult:
    """Returns the result of a cell with these errors, one for each seed."""
    cell = plan_small_suite().cells[1]
    runs = [make_bench_run(cell, n, error_rad=error) for n, error in enumerate(errors_rad)]
    return BenchCellResult(cell, runs)


def test_intervals_over_twenty_seeds_equal_scipys() -> None:
    """The mean error has Student's interval, and the share of stable runs has Wilson's."""
    errors = tuple(0.3 + 0.01 * (7 * n % 20) for n in range(20))
    result = make_bench_cell_result(*errors)
    mean: Any = result.compute_mean("error_rad")
    interval = stats.t.interval(0.95, 19, np.mean(errors), stats.sem(errors))
    assert (mean.mean - mean.half, mean.mean + mean.half) == pytest.approx(interval, rel=1e-12)

    share = stats.binomtest(20, 20).proportion_ci(method="wilson")
    assert result.interval == pytest.approx((share.low, share.high), rel=1e-12)


def test_fewer_seeds_have_a_mean_without_interval() -> None:
    """Fewer than twenty runs have no interval, and a run without a number leaves no mean."""
    errors = tuple(0.3 + 0.01 * n for n in range(19))
    result = make_bench_cell_result(*errors)
    assert result.interval is None
    assert result.compute_mean("error_rad") == pytest.approx(np.mean(errors), rel=1e-12)
    assert make_bench_cell_result(0.31, None).compute_mean("error_rad") is None


FULL = plan_bench("full", tasks=["handover", "outage"], links=["rtt272"])


@pytest.mark.parametrize("cell", FULL.cells, ids=lambda cell: f"{cell.task}/{cell.law}")
def test_every_law_fits_each_of_its_tasks(cell: BenchCell) -> None:
    """The scenario of a cell is valid, and all its sites have the law of the cell."""
    scenario = cell.build(1).scenario
    laws = {site.control.__struct_config__.tag for site in scenario.sites.values()}
    assert laws == {cell.law}
    assert len(scenario.names) == (2 if cell.form == "two" else 3)
    assert np.allclose(scenario.alpha.sum(axis=1), 1.0)


@pytest.mark.parametrize(("form", "base"), [("three", "_bench_three"), ("two", "_bench_two")])
def test_every_link_fits_both_forms(form: str, base: str) -> None:
    """Over every link, the outage of the task cuts exactly the links of the slave."""
    for name_of_link in LINKS:
        scenario = load_scenario(base, build_settings(form, "outage", name_of_link))
        cut = {name for name, link in scenario.links.items() if link.outages_s}
        assert cut == {name for name in scenario.links if "s" in name.split("->")}


def test_all_studies_have_gains_within_their_ranges() -> None:
    gains = read_gains()
    laws = {
        (form, law)
        for study in STUDIES.values()
        for form, laws_of_form in study.laws.items()
        for law in laws_of_form
    }
    for form, law in sorted(laws):
        knobs = {knob.name: knob for knob in SEARCH_SPACES[law].knobs}
        for round_trip_ms in TUNED_ROUND_TRIPS_MS:
            kept = gains[form, law, round_trip_ms].gains
            assert kept.keys() in (knobs.keys(), {}.keys())
            for key, value in kept.items():
                assert knobs[key].low <= value <= knobs[key].high, (form, law, key)


@pytest.mark.long
def test_kept_gains_minimise_error_at_the_margin(tmp_path: Path) -> None:
    """The stored gains have the least error of all candidates that also settle at the margin."""
    tuning = tune_laws({"level": ["p_d"]}, 1, budget=4)
    assert [gains.round_trip_ms for gains in tuning] == list(TUNED_ROUND_TRIPS_MS)

    settings = format_settings(build_settings("level", "contact", "rtt272"))
    (search,) = plan_tuning("_bench_two", settings, laws=["p_d"], budget=8).run(1).found
    by_error = [
        n for n, score in enumerate(search.scores) if score.outcome is CandidateClass.SETTLED
    ]
    by_error.sort(key=lambda n: search.scores[n].error_rad or 0.0)
    assert (tuning[1].settled, tuning[1].tried) == (len(by_error), 8)

    longer_delay = TuningScenario.load("_bench_two", [*settings, "link.delay_ms=204"])

    def settles_at_margin(n: int) -> bool:
        """Returns True if a candidate also settles with one and a half times the delay."""
        candidate = longer_delay.with_gains(SEARCH_SPACES["p_d"], KNOWLEDGE, search.tried[n])
        return CandidateScore.measure(*candidate.texts).outcome is CandidateClass.SETTLED

    best = next(n for n in by_error if settles_at_margin(n))
    assert (tuning[1].gains, tuning[1].passed) == (search.tried[best], by_error.index(best))

    file = tmp_path / "gains.json"
    write_gains(tuning[:2], file)
    write_gains(tuning[1:], file)
    assert sorted(map(str, read_gains(file).values())) == sorted(map(str, tuning))
    assert not any(gains.is_stale for gains in tuning)


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "gains"),
    [
        ("impedance", {"M": 0.1766, "B": 1.067, "K": 5.239}),
        ("sync", {"Lambda": 3.407, "Kp": 8.189, "Gamma": 0.861}),
    ],
)
def test_laws_with_another_promise_can_be_tuned(law: str, gains: dict[str, float]) -> None:
    """Both laws end away from the pose of the hand, and are stable by their own promise."""
    base = bench_plan.load_tuning_task("three", law, 68)
    candidate = base.with_gains(SEARCH_SPACES[law], KNOWLEDGE, gains)
    score = CandidateScore.measure(*candidate.texts)
    assert score.outcome is CandidateClass.SETTLED
    assert score.pose_rad is not None
    assert score.pose_rad > 0.1


def test_an_interrupted_tuning_resumes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Gains are stored one by one, and gains that are up to date are not tuned again."""
    path = tmp_path / "gains.json"
    tuned_ms: list[int] = []

    def tune(form: str, law: str, round_trip_ms: int, *_: Any) -> TunedGains:
        if len(tuned_ms) == 2:
            raise KeyboardInterrupt
        tuned_ms.append(round_trip_ms)
        mark = fingerprint_tuning(form, law, round_trip_ms)
        return TunedGains(form, law, round_trip_ms, {"K": 1.0}, 1, 1, 0, 0.1, 1.0, mark)

    def tune_and_store() -> list[TunedGains]:
        return tune_laws(
            {"level": ["p_d"]},
            known=read_gains(path).values(),
            store=lambda gains: write_gains([gains], path),
        )

    monkeypatch.setattr(bench_plan, "_tune_law", tune)
    with pytest.raises(KeyboardInterrupt):
        tune_and_store()
    assert len(read_gains(path)) == 2

    tuned_ms.clear()
    assert len(tune_and_store()) == 3
    assert tuned_ms == [TUNED_ROUND_TRIPS_MS[-1]]


class Damped(BUILT_IN["p_d"]):
    """P+d with twice the configured damping."""

    @classmethod
    def write_control(cls, gains: Any, site: Any) -> dict[str, Any]:
        return super().write_control({**gains, "d": 2.0 * gains["d"]}, site)


def test_only_another_motion_makes_gains_outdated() -> None:
    """Texts and names in a law's code do not matter; its motion of the arms does."""
    space = SEARCH_SPACES["p_d"]
    task = bench_plan.load_tuning_task("level", "p_d", 68)
    same = space._replace(kind=type("Renamed", (BUILT_IN["p_d"],), {}))
    assert bench_plan._probe_law(task, same) == bench_plan._probe_law(task, space)
    other = space._replace(kind=Damped)
    assert bench_plan._probe_law(task, other) != bench_plan._probe_law(task, space)


def iterate_shipped_gains() -> Iterator[Any]:
    """Yields all shipped gains; every ninth is tested on a push."""
    for index, gains in enumerate(read_gains().values()):
        marks = () if index % 9 == 0 else pytest.mark.long
        yield pytest.param(gains, id=str(gains), marks=marks)


@pytest.mark.parametrize("gains", list(iterate_shipped_gains()))
def test_shipped_gains_are_up_to_date(gains: TunedGains) -> None:
    assert not gains.is_stale


@pytest.mark.parametrize(
    ("round_trip_ms", "tuned_ms"),
    [(0.0, 68), (68.0, 68), (69.0, 272), (600.0, 1088), (5000.0, 1088)],
)
def test_gains_come_from_the_next_longer_round_trip(
    round_trip_ms: float, tuned_ms: int
) -> None:
    assert choose_round_trip(round_trip_ms) == tuned_ms


def test_gains_of_another_law_or_scenario_are_stale() -> None:
    tuned = plan_small_suite().cells[0].tuned
    other = msgspec.structs.replace(tuned, fingerprint="0" * 16)
    assert other.is_stale
    assert str(other) == f"p_d (level, {tuned.round_trip_ms} ms)"


@pytest.mark.long
def test_a_folder_resumes_its_own_suite_only(whole: BenchResults, tmp_path: Path) -> None:
    """Finished runs are kept if cells are added, and other programs or files are refused."""
    path = tmp_path / "one"
    one_link = plan_small_suite(links=["rtt8"])
    first = run_bench(prepare_bench_folder(one_link, path), jobs=1)
    finished: list[int] = []
    extended = run_bench(
        prepare_bench_folder(plan_small_suite(), path),
        jobs=1,
        progress=lambda done, _: finished.append(done),
    )
    assert finished == [2, 3]
    assert extended.runs == whole.runs
    assert extended.runs[0] == first.runs[0]

    # a cell with other gains is another cell
    changed_cell = replace_gains(plan_small_suite().cells[0], K=20.0, d=5.0)
    changed_plan = BenchPlan("round-trips", [changed_cell], [])
    changed = run_bench(prepare_bench_folder(changed_plan, path), jobs=1)
    assert changed.runs[0] != first.runs[0]

    origin = path / "origin.json"
    origin.write_text(origin.read_text().replace("numpy", "numpi"))
    with pytest.raises(
        UsageError, match="results from both cannot be mixed: choose another folder with out"
    ):
        prepare_bench_folder(plan_small_suite(), path)

    path_with_file = tmp_path / "full"
    path_with_file.mkdir()
    (path_with_file / "mine.txt").touch()
    with pytest.raises(UsageError, match="is not empty"):
        prepare_bench_folder(plan_small_suite(), path_with_file)

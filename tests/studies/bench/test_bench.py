"""The suite: its runs are the program's runs, interruptions leave no trace, and its intervals are SciPy's."""

import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import stats

import trilat_net
from trilat_net.analysis.run_end import Stability, classify_log_end
from trilat_net.errors import UsageError
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario
from trilat_net.studies.bench import BenchResults, plan_bench, prepare_bench_folder, run_bench
from trilat_net.studies.bench.bench_cell import BenchRun, BenchRunTask, run_bench_task
from trilat_net.studies.bench.bench_gains import (
    choose_round_trip,
    find_stale,
    name_settings,
    read_gains,
    tune_laws,
    write_gains,
)
from trilat_net.studies.bench.bench_plan import BenchCell, BenchPlan
from trilat_net.studies.bench.bench_run import BenchPlace
from trilat_net.studies.bench.bench_tables import build_bench_page, encode_places, encode_runs
from trilat_net.studies.bench.bench_tasks import LINKS, STUDIES, TUNED_ROUND_TRIPS_MS, build_settings
from trilat_net.studies.tuning import plan_tuning
from trilat_net.studies.tuning.final_posture import CandidateClass
from trilat_net.studies.tuning.search_space import SEARCH_SPACES

LEVEL = {"laws": ["p_d"], "study": "round-trips"}


def asked(**more: Any) -> BenchPlan:
    """Two cells of two sites, one of them with two seeds."""
    return plan_bench(**{**LEVEL, "tasks": ["free"], "links": ["rtt8", "rtt68-loss25"], "seeds": 2, **more})


def files(results: BenchResults) -> list[str]:
    return [build_bench_page(results, "trilat bench"), encode_places(results), encode_runs(results)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> BenchResults:
    folder = prepare_bench_folder(asked(), tmp_path_factory.mktemp("suite") / "whole")
    return run_bench(folder, jobs=1)


def test_an_interrupted_suite_goes_on_to_the_same_bytes(whole: BenchResults, tmp_path: Path) -> None:
    folder, made = prepare_bench_folder(asked(), tmp_path / "parts"), []

    def stop(done: int, _total: int) -> None:
        made.append(done)
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_bench(folder, jobs=1, progress=stop)
    again = run_bench(prepare_bench_folder(asked(), tmp_path / "parts"), jobs=1, progress=stop)
    assert made == [1, 2, 3]
    assert again.runs == whole.runs
    assert files(again) == files(whole)


def test_what_runs_the_cells_enters_no_result(whole: BenchResults, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor:
        found = run_bench(prepare_bench_folder(asked(), tmp_path / "elsewhere"), on=executor)
    assert files(found) == files(whole)


def test_seeds_are_other_runs_where_anything_is_drawn_and_the_same_twice(whole: BenchResults) -> None:
    still, first, second = whole.runs
    assert (still.random, first.random) == (False, True)
    assert first.error_rad != second.error_rad
    lossy = whole.plan.cells[1]
    assert run_bench_task(BenchRunTask(lossy, 2)) == second


def test_a_cell_is_the_log_that_its_command_makes(whole: BenchResults) -> None:
    cell = whole.plan.cells[1]
    words = shlex.split(cell.build(1).command)
    assert words[:3] == ["trilat", "sim", "_bench_two"]
    log = trilat_net.simulate(load_scenario(words[2], words[4::2]))
    run = whole.runs[1]
    assert log.scenario.sha256 == run.sha256
    assert classify_log_end(log).stability is run.stability
    off = log["s"].q - log["m1"].q
    assert run.error_rad == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-12)
    assert run.hand_nm == pytest.approx(np.sqrt(np.mean(log["m1"].tau_x ** 2)), rel=1e-12)


def test_effort_is_that_of_the_compiled_run(whole: BenchResults) -> None:
    scenario = whole.plan.cells[0].build(1).scenario
    run = FusedRun(scenario)
    run.advance(scenario.duration_s)
    assert whole.runs[0].effort_nm == pytest.approx(run.totals.effort_nm, rel=1e-12)


def test_in_statics_a_user_feels_the_wall_as_the_law_has_it() -> None:
    """Of P+d all of it, the same spring at both ends; of direct force reflection k_f."""
    (cell,) = asked(tasks=["contact"], links=["rtt8"]).cells
    assert run_bench_task(BenchRunTask(cell, 1)).reflected == pytest.approx(1.0, abs=1e-4)
    gains = {"K": 100.0, "d_slave": 40.0, "d_master": 5.0, "k_f": 0.5}
    reflecting = cell._replace(law="p_f", tuned=msgspec.structs.replace(cell.tuned, gains=gains))
    assert run_bench_task(BenchRunTask(reflecting, 1)).reflected == pytest.approx(0.5, abs=1e-4)


@pytest.mark.long
def test_a_shared_slave_errs_by_its_distance_from_the_mean_by_dominance() -> None:
    """After the handover the second user has three quarters; the error is of the present shares."""
    plan = plan_bench("full", laws=["p_d"], tasks=["handover"], links=["rtt68"])
    run = run_bench_task(BenchRunTask(plan.cells[0], 1))
    log = trilat_net.simulate(plan.cells[0].build(1).scenario)
    t_s, (m1, m2, s) = log["s"].t_s, (log[name].q for name in ("m1", "m2", "s"))
    a = np.interp(t_s, [7.0, 9.0], [0.75, 0.25])[:, None]
    assert run.error_rad == pytest.approx(np.sqrt(np.mean((s - a * m1 - (1.0 - a) * m2) ** 2)), rel=1e-9)


def place(*errors: float | None) -> BenchPlace:
    cell = asked().cells[1]
    runs = [
        BenchRun(cell.name, cell.inputs, n, True, "", Stability.STABLE, "converged", "", error_rad=error)  # type: ignore[arg-type]
        for n, error in enumerate(errors)
    ]
    return BenchPlace(cell, runs)


def test_intervals_over_seeds_are_those_of_scipy() -> None:
    errors = (0.31, 0.27, 0.44, 0.29, 0.36)
    found: Any = place(*errors).mean("error_rad")
    low, high = stats.t.interval(0.95, 4, np.mean(errors), stats.sem(errors))
    assert (found.mean - found.half, found.mean + found.half) == pytest.approx((low, high), rel=1e-12)
    share = stats.binomtest(5, 5).proportion_ci(method="wilson")
    assert place(*errors).interval == pytest.approx((share.low, share.high), rel=1e-12)
    assert place(0.31).mean("error_rad") == 0.31
    assert place(0.31, None).mean("error_rad") is None


FULL = plan_bench("full", tasks=["handover", "outage"], links=["rtt272"])


@pytest.mark.parametrize("cell", FULL.cells, ids=lambda cell: f"{cell.task}/{cell.law}")
def test_every_law_fits_every_task_in_which_it_runs(cell: BenchCell) -> None:
    found = cell.build(1)
    assert {site.control.__struct_config__.tag for site in found.scenario.sites.values()} == {cell.law}
    assert len(found.scenario.names) == (2 if cell.form == "two" else 3)
    assert np.allclose(found.scenario.alpha.sum(axis=1), 1.0)


def test_every_link_fits_both_forms() -> None:
    for link in LINKS:
        for form, base in (("three", "_bench_three"), ("two", "_bench_two")):
            scenario = load_scenario(base, build_settings(form, "outage", link))
            cut = [name for name, one in scenario.links.items() if one.outages_s]
            assert sorted(cut) == sorted(name for name in scenario.links if "s" in name.split("->"))


def test_the_gains_of_all_studies_are_there_and_within_their_ranges() -> None:
    gains = read_gains()
    for study in STUDIES.values():
        for form, laws in study.laws.items():
            for law in laws:
                for round_trip_ms in TUNED_ROUND_TRIPS_MS:
                    kept = gains[form, law, round_trip_ms].gains
                    knobs = {knob.name: knob for knob in SEARCH_SPACES[law].knobs}
                    assert kept.keys() == knobs.keys()
                    assert all(knobs[key].low <= value <= knobs[key].high for key, value in kept.items())


@pytest.mark.long
def test_kept_gains_are_the_least_error_that_the_procedure_finds(tmp_path: Path) -> None:
    found = tune_laws({"level": ["p_d"]}, 1, budget=4)
    assert [one.round_trip_ms for one in found] == list(TUNED_ROUND_TRIPS_MS)
    settings = name_settings(build_settings("level", "contact", "rtt272"))
    (search,) = plan_tuning("_bench_two", settings, laws=["p_d"], budget=4).run(1).found
    errors = [score.error_rad for score in search.scores]
    settled = [score.error_rad for score in search.scores if score.outcome is CandidateClass.SETTLED]
    least = min(filter(None, settled or errors))
    assert (found[1].error_rad, found[1].gains) == (least, search.tried[errors.index(least)])
    assert (found[1].settled, found[1].tried) == (len(settled), 4)
    write_gains(found[:2], tmp_path / "gains.json")
    write_gains(found[1:], tmp_path / "gains.json")
    assert sorted(map(str, read_gains(tmp_path / "gains.json").values())) == sorted(map(str, found))
    assert find_stale(found) == []


def test_gains_are_those_of_the_next_longer_round_trip() -> None:
    assert [choose_round_trip(ms) for ms in (0.0, 68.0, 69.0, 600.0, 5000.0)] == [68, 68, 272, 1088, 1088]


def test_gains_of_another_law_or_scenario_are_stale() -> None:
    kept = asked().cells[0].tuned
    other = msgspec.structs.replace(kept, fingerprint="0" * 16)
    assert find_stale([other]) == [f"p_d (level, {kept.round_trip_ms} ms)"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"study": "smal"}, "no study 'smal' in it; did you mean 'small'"),
        ({"laws": ["p_dd"]}, "no law 'p_dd' in it; did you mean"),
        ({"tasks": ["handover"]}, "no task 'handover' in it"),
        ({"links": ["rtt9"]}, "no link 'rtt9' in it; did you mean"),
        ({"seeds": 0}, "seeds is how many, 1 to 1000, not 0"),
        ({"study": "full", "laws": ["smith"], "tasks": ["handover"]}, "handover asks for two users"),
    ],
)
def test_what_cannot_be_asked_is_refused(more: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError) as refused:
        asked(**more)
    assert words in str(refused.value)


def test_a_folder_takes_more_of_the_suite_and_nothing_from_elsewhere(
    whole: BenchResults, tmp_path: Path
) -> None:
    first = run_bench(prepare_bench_folder(asked(links=["rtt8"]), tmp_path / "one"), jobs=1)
    made: list[int] = []
    more = run_bench(
        prepare_bench_folder(asked(), tmp_path / "one"), jobs=1, progress=lambda done, _: made.append(done)
    )
    assert made == [2, 3]
    assert more.runs == whole.runs
    assert more.runs[0] == first.runs[0]
    gains = {"K": 20.0, "d": 5.0}
    cell = asked().cells[0]
    other = cell._replace(tuned=msgspec.structs.replace(cell.tuned, gains=gains))
    changed = BenchPlan("round-trips", [other])
    assert run_bench(prepare_bench_folder(changed, tmp_path / "one"), jobs=1).runs[0] != first.runs[0]
    origin = tmp_path / "one" / "origin.json"
    origin.write_text(origin.read_text().replace("numpy", "numpi"))
    with pytest.raises(UsageError, match="results are not mixed: choose another folder with out"):
        prepare_bench_folder(asked(), tmp_path / "one")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    with pytest.raises(UsageError, match="holds something"):
        prepare_bench_folder(asked(), tmp_path / "full")

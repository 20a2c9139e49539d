"""The whole procedure: small budgets, short runs."""

import json
import re
import shlex
from pathlib import Path

import pytest
from study_builders import dominates, make_candidate_score, plan_quick_tuning
from trilat_studies.tuning import TuningResult
from trilat_studies.tuning.candidate import CandidateClass, CandidateScore
from trilat_studies.tuning.search_space import SEARCH_SPACES
from trilat_studies.tuning.tuning_plan import CandidateSearch, Objective, find_pareto_front
from trilat_studies.tuning.tuning_report import TuningReport

from trilat_net.scenario import load_scenario

LAWS = ("adaptive", "p_d", "known")


@pytest.fixture(scope="module")
def tuning_result(tmp_path_factory: pytest.TempPathFactory) -> TuningResult:
    """The result for three laws with six candidates each."""
    return plan_quick_tuning(tmp_path_factory.mktemp("tuned"), laws=LAWS, budget=6, seed=7).run(
        jobs=1
    )


@pytest.mark.long
def test_the_number_of_processes_changes_no_result(
    tuning_result: TuningResult, tmp_path: Path
) -> None:
    again = plan_quick_tuning(tmp_path, laws=LAWS, budget=6, seed=7).run(jobs=2)
    assert [law.tried for law in again.found] == [law.tried for law in tuning_result.found]
    assert [law.scores for law in again.found] == [law.scores for law in tuning_result.found]
    assert [candidate.score for candidate in again.printed] == [
        candidate.score for candidate in tuning_result.printed
    ]


def test_laws_use_their_budget_and_runs_end_once(tuning_result: TuningResult) -> None:
    for law in tuning_result.found:
        assert len(law.tried) == len(law.scores) == sum(law.outcomes.values()) == 6


def test_candidates_differ_only_in_their_law(tuning_result: TuningResult) -> None:
    """All candidates have the same limits, starts, seed, duration and links."""
    settings_of_candidates = set()
    for search in tuning_result.found:
        for place in range(len(search.tried)):
            scenario = tuning_result.candidate(search, place).scenario
            limits = tuple(site.limits for site in scenario.sites.values())
            starts = tuple(
                (site.q0_rad, repr(site.arm), site.rate_hz, site.hands)
                for site in scenario.sites.values()
            )
            settings_of_candidates.add(
                (limits, starts, scenario.seed, scenario.duration_s, repr(scenario.links))
            )
    ((limits, *_),) = settings_of_candidates
    assert limits[0].tau_limit_nm == 60.0


def test_a_front_is_dominated_by_no_law(tuning_result: TuningResult) -> None:
    """A point of a law's front is on the front of all laws if no law has a better point."""
    points = {
        search.space.law: [tuning_result.plan.objective.point(score) for score in search.scores]
        for search in tuning_result.found
    }
    all_points = [point for law in points.values() for point in law if point is not None]
    for search in tuning_result.found:
        own_points = points[search.space.law]
        assert search.front == find_pareto_front(own_points)
        overall_front = tuning_result.list_overall_front(search)
        assert set(overall_front) <= set(search.front)
        for place in search.front:
            point = own_points[place]
            assert point is not None
            assert (place in overall_front) == (
                not any(dominates(other, point) for other in all_points)
            )


def test_the_command_of_a_point_repeats_its_run(tuning_result: TuningResult) -> None:
    for law in tuning_result.found:
        for place in law.front:
            arguments = shlex.split(tuning_result.candidate(law, place).command)
            assert arguments[:2] == ["trilat", "sim"]
            assert arguments[3::2] == ["--set"] * (len(arguments[3:]) // 2)
            assert (
                CandidateScore.measure(load_scenario(arguments[2], arguments[4::2]).text, None)
                == law.scores[place]
            )


def test_printed_gains_are_measured_and_never_searched(tuning_result: TuningResult) -> None:
    """The printed gains are measured with and without knowledge, and no search proposes them."""
    informed, uninformed = tuning_result.printed
    assert informed.name == "as printed"
    assert uninformed.name == "as printed, told nothing"
    for result, estimate in ((informed, (0.0, 0.0, 0.0, 2.0, 1.0)), (uninformed, (0.0,) * 5)):
        control = result.candidate.scenario.sites["s"].control.gains(None)  # type: ignore[arg-type]
        assert tuple(control.Lambda) == (1.0, 1.0)
        assert tuple(control.theta_hat0) == estimate
    tried_gains = {
        tuple(gains.values()) for search in tuning_result.found for gains in search.tried
    }
    assert (1.0, 1.0, 3.0, 1.0) not in tried_gains


def test_failed_runs_are_in_facts_and_counted(tmp_path: Path) -> None:
    """No run keeps the speed limit: the front is empty, and the result says so."""
    result = plan_quick_tuning(
        tmp_path, "limits.qd_limit_rad_s=0.001", laws=["p_d"], budget=4
    ).run(jobs=1)
    law = result.to_dict()["laws"]["p_d"]
    assert law["outcomes"] == {
        word.value: 4 * (word is CandidateClass.DIVERGED) for word in CandidateClass
    }
    assert law["front"] == []
    assert [candidate["outcome"] for candidate in law["candidates"]] == ["diverged"] * 4
    assert result.list_edge_gains(result.found[0]) == []


def test_hanging_arms_never_reach_a_real_front(tmp_path: Path) -> None:
    """The laws are given half of gravity: a law that does not learn cannot stand, some that learn can."""
    settings = ("duration_s=10.0", "control.Kd=1")
    result = plan_quick_tuning(
        tmp_path, *settings, laws=["adaptive", "pd_d"], budget=8, gravity_percent=50.0
    ).run(jobs=1)
    learning, fixed = result.found
    assert fixed.front == []
    assert fixed.outcomes[CandidateClass.STRAYED] >= 1
    assert fixed.outcomes[CandidateClass.SETTLED] == 0
    for index in learning.front:
        assert learning.scores[index].outcome is CandidateClass.SETTLED


def test_time_is_estimated_beforehand_in_right_order(tmp_path: Path) -> None:
    """The runs of a plan are counted; a wall gives each candidate a second run without it."""
    plan = plan_quick_tuning(tmp_path, laws=["p_d"], budget=8)
    assert 0.0 < plan.estimate_s(1) < 600.0
    assert plan.runs == 10

    wall = 'kind = "wall", point_m = [9.0, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 1.0'
    environment = f"sites.s.environment=[{{{wall}}}]"
    with_wall = plan_quick_tuning(tmp_path, environment, laws=["p_d"], budget=8)
    assert with_wall.runs == 20


def make_search(law: str, gains: dict[str, float], points: int) -> CandidateSearch:
    """Returns a search of six candidates of equal gains, of which some are on the front."""
    search = CandidateSearch(SEARCH_SPACES[law], 6, 1, Objective.ERROR)
    outcomes = [CandidateClass.SETTLED] * points + [CandidateClass.OPEN] * (6 - points)
    scores = [
        make_candidate_score(outcome, error_rad=1.0 / n, effort_nm=float(n))
        for n, outcome in enumerate(outcomes, 1)
    ]
    search.record_scores([gains] * 6, scores)
    return search


def test_tables_name_the_edge_of_the_searched_ranges(tuning_result: TuningResult) -> None:
    knob = SEARCH_SPACES["p_d"].knobs[0]
    search = make_search("p_d", {"K": knob.high, "d": 10.0}, points=1)
    assert tuning_result.list_edge_gains(search) == ["K"]


@pytest.fixture(scope="module")
def result_folder(
    tuning_result: TuningResult, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The folder of the result."""
    folder = tmp_path_factory.mktemp("written")
    names = sorted(path.name for path in TuningReport(tuning_result).write(folder))
    assert names == ["front.json", "front.md", "front.pdf", "front.png"]
    return folder


def test_the_folder_holds_the_result(result_folder: Path) -> None:
    result = json.loads((result_folder / "front.json").read_text())
    assert result["procedure"]["candidates_per_law"] == 6
    assert result["scenario"]["tau_limit_nm"] == {"m1": 60.0, "m2": 60.0, "s": 60.0}
    for law in ("p_d", "known"):
        assert (
            len(result["laws"][law]["candidates"])
            == sum(result["laws"][law]["outcomes"].values())
            == 6
        )
        for point in result["laws"][law]["front"]:
            assert point["command"].startswith("trilat sim ")
            assert point["outcome"] == "settled"


def test_the_figure_is_a_vector_one_column_wide(result_folder: Path) -> None:
    """3.5 in are 252 pt, and 700 pixels at 200 to the inch."""
    box = re.search(
        rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (result_folder / "front.pdf").read_bytes()
    )
    assert box is not None
    assert float(box[1]) == pytest.approx(252.0)
    header = (result_folder / "front.png").read_bytes()[16:20]
    assert int.from_bytes(header, "big") == 700


def test_the_page_shows_procedure_search_and_commands(
    tuning_result: TuningResult, result_folder: Path
) -> None:
    text = (result_folder / "front.md").read_text()
    assert "every law gets the exact gravity parameters" in text
    assert "torques clamped at 60 N m" in text
    assert "| p_d | K | N m/rad | 1 | 1000 | gravity |" in text
    assert "AND inertia exactly: more than the others" in text
    assert text.count("trilat sim ") == sum(len(law.front) for law in tuning_result.found) + 2
    assert "as printed, told nothing" in text


def test_the_table_of_laws_counts_every_run(tuning_result: TuningResult) -> None:
    table = next(tuning_result.blocks())
    places = [table.headers.index(outcome.word) for outcome in CandidateClass]
    for row in table.rows:
        assert sum(int(row[place]) for place in places) == int(row[1]) == 6


def test_long_fronts_are_shortened_between_both_ends(tuning_result: TuningResult) -> None:
    """A table of three points has the first, the middle and the last point of the front."""
    gains = tuning_result.found[0].tried[0]
    search = make_search("adaptive", gains, points=5)
    rows = TuningReport(tuning_result).tabulate_front(search, 3).rows
    assert [row[0].rstrip("*") for row in rows] == ["adaptive 1", "adaptive 3", "adaptive 5"]
    assert len(TuningReport(tuning_result).tabulate_front(search).rows) == 5

    empty_search = make_search("adaptive", gains, points=0)
    assert TuningReport(tuning_result).tabulate_front(empty_search, 3).rows == []

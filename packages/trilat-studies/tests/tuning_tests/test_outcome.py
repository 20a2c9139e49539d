"""The outcome of a run by its posture: the class of a candidate, and warnings on a log."""

from pathlib import Path

import msgspec
import pytest
from study_builders import FIRM_GAINS, make_run_end, make_trio_scenario
from trilat_studies.tuning.candidate import CLASS_MEANINGS, CandidateClass, check_final_posture

from trilat_net.analysis.run_end import EndBehaviour, RunEnd, Stability
from trilat_net.app.api import simulate
from trilat_net.execution.virtual import SimulatedLog
from trilat_net.log.log_reader import open_log

CALM = make_run_end()


@pytest.mark.parametrize(
    ("end", "fall_rad", "apart_rad", "outcome"),
    [
        (CALM, 0.0, 0.0, CandidateClass.SETTLED),
        (make_run_end(EndBehaviour.DECAYS), 0.0, 0.0, CandidateClass.SETTLED),
        (make_run_end(EndBehaviour.HARDLY), 0.0, 0.0, CandidateClass.OPEN),
        (make_run_end(EndBehaviour.UNDECIDED), 0.0, 0.0, CandidateClass.OPEN),
        (make_run_end(EndBehaviour.GROWS, operator_acts=True), 0.0, 0.0, CandidateClass.OPEN),
        (make_run_end(EndBehaviour.BOUNDED), 0.0, 0.0, CandidateClass.OSCILLATED),
        (make_run_end(EndBehaviour.DRIFTS), 1.6, 0.0, CandidateClass.OSCILLATED),
        (make_run_end(EndBehaviour.GROWS), 0.0, 0.0, CandidateClass.OSCILLATED),
        (make_run_end(EndBehaviour.DIVERGED), 1.6, 0.5, CandidateClass.DIVERGED),
        (CALM, 1.6, 0.5, CandidateClass.STRAYED),
        (make_run_end(EndBehaviour.UNDECIDED), 1.6, 0.5, CandidateClass.STRAYED),
        (CALM, 0.1, 0.5, CandidateClass.APART),
    ],
)
def test_class_combines_judgement_and_pose(
    end: RunEnd, fall_rad: float, apart_rad: float, outcome: CandidateClass
) -> None:
    assert CandidateClass.classify((end, end), fall_rad, apart_rad) is outcome
    assert CandidateClass.classify((end, CALM), fall_rad, apart_rad) is outcome
    assert CandidateClass.classify((CALM, end), fall_rad, apart_rad) is outcome


def test_judgements_that_decide_a_class_name_it() -> None:
    assert CandidateClass.SETTLED.word == Stability.STABLE
    assert CandidateClass.OSCILLATED.word == Stability.NOT_STABLE
    assert CandidateClass.OPEN.word == Stability.OPEN
    assert len({outcome.word for outcome in CandidateClass}) == len(CandidateClass)


def test_every_outcome_has_a_meaning() -> None:
    assert list(CLASS_MEANINGS) == list(CandidateClass)


def test_standing_arms_get_no_warning() -> None:
    assert check_final_posture(simulate(make_trio_scenario(*FIRM_GAINS))) == []


def test_hanging_arms_are_named() -> None:
    (line,) = check_final_posture(
        simulate(make_trio_scenario(*FIRM_GAINS, "control.gravity=0.0", "duration_s=15.0"))
    )
    assert line.startswith("m1, m2, s hang at the end")


def test_sunken_arms_are_named_with_their_distance() -> None:
    (line,) = check_final_posture(
        simulate(make_trio_scenario(*FIRM_GAINS, "control.gravity=0.8", "duration_s=2.0"))
    )
    assert "from where a weightless consensus would stand: they sank, or drifted" in line


def test_pushed_arms_count_as_not_sunken() -> None:
    push = (
        'sites.m1.hands=[{kind = "pulse", start_s = 0.1, end_s = 1.5, peak_nm = [40.0, 0.0]}]'
    )
    assert check_final_posture(simulate(make_trio_scenario(*FIRM_GAINS, push))) == []


def test_a_diverged_site_is_named() -> None:
    (line,) = check_final_posture(
        simulate(make_trio_scenario(*FIRM_GAINS, "limits.qd_limit_rad_s=0.1"))
    )
    assert "diverged: its figures end there" in line


def test_arms_that_start_hanging_did_not_fall() -> None:
    down = (-1.5707963, 0.0)
    scenario = make_trio_scenario(*FIRM_GAINS)
    sites = {
        name: msgspec.structs.replace(spec, q0_rad=down)
        for name, spec in scenario.sites.items()
    }
    assert check_final_posture(simulate(msgspec.structs.replace(scenario, sites=sites))) == []


def test_a_truncated_log_names_its_end(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    assert SimulatedLog.record_scenario(
        make_trio_scenario(*FIRM_GAINS, "duration_s=40.0"), path
    )
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 5])
    (line,) = check_final_posture(open_log(path))
    assert "s of 40 s: its figures are of a shorter run" in line

"""How a run ended by its posture: the class of a candidate, and warnings on a log."""

from pathlib import Path

import msgspec
import pytest

from trilat_net.analysis.run_end import EnvelopeTrend
from trilat_net.api import simulate
from trilat_net.execution.virtual import record_virtual
from trilat_net.log.log_reader import open_log
from trilat_net.studies.tuning.final_posture import (
    CLASS_MEANINGS,
    CandidateClass,
    CandidateEnd,
    check_final_posture,
    classify_candidate,
)

from .experiments import trio

CALM = CandidateEnd(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("ending", "trend", "outcome"),
    [
        (CALM, EnvelopeTrend.DECAYS, CandidateClass.SETTLED),
        (CALM, EnvelopeTrend.UNDECIDED, CandidateClass.SETTLED),
        (CALM, EnvelopeTrend.GROWS, CandidateClass.OSCILLATED),
        (CALM._replace(swing_rad=0.03), EnvelopeTrend.STEADY, CandidateClass.OSCILLATED),
        (CALM._replace(swing_rad=0.03), EnvelopeTrend.DECAYS, CandidateClass.SETTLED),
        (CALM._replace(fall_rad=1.6), EnvelopeTrend.DECAYS, CandidateClass.STRAYED),
        (CALM._replace(fall_rad=1.6, spread_rad=0.5), EnvelopeTrend.DECAYS, CandidateClass.STRAYED),
        (CALM._replace(fall_rad=0.1, ahead_rad=0.3), EnvelopeTrend.DECAYS, CandidateClass.STRAYED),
        (CALM._replace(spread_rad=0.5), EnvelopeTrend.DECAYS, CandidateClass.APART),
    ],
)
def test_the_first_that_holds_is_the_outcome(
    ending: CandidateEnd, trend: EnvelopeTrend, outcome: CandidateClass
) -> None:
    assert classify_candidate(False, trend, ending, ending) is outcome
    assert classify_candidate(True, trend, ending, ending) is CandidateClass.DIVERGED


def test_pose_is_judged_on_the_twin_and_swinging_on_both() -> None:
    pushed = CandidateEnd(spread_rad=0.5, fall_rad=1.0, ahead_rad=1.0, swing_rad=0.0)
    assert classify_candidate(False, EnvelopeTrend.STEADY, pushed, CALM) is CandidateClass.SETTLED
    hammering = CALM._replace(swing_rad=0.2)
    assert classify_candidate(False, EnvelopeTrend.STEADY, hammering, CALM) is CandidateClass.OSCILLATED
    assert classify_candidate(False, EnvelopeTrend.STEADY, CALM, hammering) is CandidateClass.OSCILLATED


def test_every_outcome_has_a_meaning() -> None:
    assert list(CLASS_MEANINGS) == list(CandidateClass)


FIRM = ("control.law=pd_d", "control.K=20.0", "control.d=9.0", "control.Kd=0.5")


def test_arms_that_stand_need_no_word() -> None:
    assert check_final_posture(simulate(trio(*FIRM))) == []


def test_arms_that_hang_are_named() -> None:
    (line,) = check_final_posture(simulate(trio(*FIRM, "control.gravity=0.0", "duration_s=15.0")))
    assert line.startswith("m1, m2, s hang at the end")


def test_arms_that_sank_are_told_how_far() -> None:
    (line,) = check_final_posture(simulate(trio(*FIRM, "control.gravity=0.8", "duration_s=2.0")))
    assert "from where a weightless consensus would stand: they sank, or drifted" in line


def test_arms_that_were_pushed_did_not_sink() -> None:
    push = 'sites.m1.hands=[{kind = "pulse", start_s = 0.1, end_s = 1.5, peak_nm = [40.0, 0.0]}]'
    assert check_final_posture(simulate(trio(*FIRM, push))) == []


def test_a_site_that_diverged_is_named() -> None:
    (line,) = check_final_posture(simulate(trio(*FIRM, "limits.qd_limit_rad_s=0.1")))
    assert "diverged: its figures end there" in line


def test_arms_that_began_hanging_do_not_fall() -> None:
    down = (-1.5707963, 0.0)
    scenario = trio(*FIRM)
    sites = {name: msgspec.structs.replace(spec, q0_rad=down) for name, spec in scenario.sites.items()}
    assert check_final_posture(simulate(msgspec.structs.replace(scenario, sites=sites))) == []


def test_a_log_that_was_cut_says_where(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    assert record_virtual(trio(*FIRM, "duration_s=40.0"), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 5])
    (line,) = check_final_posture(open_log(path))
    assert "s of 40 s: its figures are of a shorter run" in line

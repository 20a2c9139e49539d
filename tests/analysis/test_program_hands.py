"""What a judgement and a report say of programs that move an arm, and of their failures."""

from typing import Any

import pytest

import trilat_net as tn
from tests.execution.builders import run_fused
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.analysis.run_end import Stability
from trilat_net.analysis.run_remarks import RunCircumstances
from trilat_net.analysis.theory.loop_roots import find_log_roots, find_run_roots
from trilat_net.log.log_reader import Log
from trilat_net.presentation.page_timeline import list_moments
from trilat_net.scenario import load_scenario

LEFT_OUT = "how the program at m2 reacts to the arms"


def simulate_program(kind: str, duration_s: float, **settings: Any) -> Log:
    """Simulates `free` with a program of tests/own_code.py at m2."""
    hand = {"kind": "own", "class": f"tests.own_code:{kind}", "settings": settings}
    return tn.simulate("free", {"sites.m2.hands": [hand]}, duration_s=duration_s)


def test_roots_of_program_loops_are_no_proof() -> None:
    log = simulate_program("Follower", 5.0)
    roots = find_log_roots(log)
    assert roots.verdict == "stable"
    assert roots.leaves_out == LEFT_OUT
    assert not roots.is_proof
    run = run_fused(log.scenario, 5.0)
    assert find_run_roots(log.scenario, run).leaves_out == LEFT_OUT
    script = find_log_roots(tn.simulate("free", duration_s=5.0))
    assert script.is_proof
    assert script.leaves_out == ""


def test_judgement_names_the_omitted_program_reaction() -> None:
    certificate = tn.certify(simulate_program("Follower", 5.0))
    assert "exact roots" not in certificate.decision.rests_on
    remark = next(text for text in certificate.remarks if text.startswith("a program moves m2"))
    assert "leave out how the arms and the program act on each other" in remark


def test_a_remark_counts_the_programs() -> None:
    hands = {
        f"sites.{site}.hands": [{"kind": "own", "class": "tests.own_code:Follower"}]
        for site in ("m1", "m2")
    }
    log = tn.simulate("free", hands, duration_s=1.0)
    (remark,) = RunCircumstances.of_log(log).remarks
    assert remark.startswith("programs move m1 and m2;")
    assert "how the arms and these programs act on each other" in remark


def test_failed_program_is_warned_of_and_reported() -> None:
    with pytest.warns(
        RuntimeWarning, match=r"Failing failed at tick 300: RuntimeError: no idea"
    ):
        log = simulate_program("Failing", 1.0, how="raise", at_s=0.3)
    (failure,) = log.failed_hands
    certificate = tn.certify(log)
    assert failure in certificate.remarks
    assert certificate.stability in Stability
    (moment,) = [moment for moment in list_moments(log, summarise_run(log)) if moment.is_bad]
    assert moment.t_s == pytest.approx(0.3)
    assert failure in moment.sentence


def test_program_that_lets_go_has_not_failed() -> None:
    log = simulate_program("Failing", 1.0, how="let go", at_s=0.3)
    assert log.failed_hands == []
    sentences = [moment.sentence for moment in list_moments(log, summarise_run(log))]
    assert any("Failing takes hold" in sentence for sentence in sentences)
    assert any("Failing lets go" in sentence for sentence in sentences)


def test_scenario_without_programs_has_no_such_remark() -> None:
    log = tn.simulate(load_scenario("play", duration_s=1.0))
    assert not [text for text in tn.certify(log).remarks if "program" in text]

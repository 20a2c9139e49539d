"""A law from outside in a live session: the same bits; a failing law ends the session in order."""

from pathlib import Path

import pytest

from sites.site_parts import warm_up
from tests.scenario.builders import make_scenario
from tests.sites.sessions import execute_packed, pack_log, run_session
from trilat_net.errors import LawFailed
from trilat_net.execution.verification import verify
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.scenario import load_scenario


def test_own_paper_law_has_live_bits(tmp_path: Path) -> None:
    law = {"law": "tests.laws:Adaptive"}
    scenario = make_scenario("two_sites", duration_s=0.5, control=law)
    log, ends = run_session(scenario, tmp_path)
    assert ends == {"m": 0, "s": 0}
    assert pack_log(log) == execute_packed(log.scenario)
    assert pack_log(log) == execute_packed(make_scenario("two_sites", duration_s=0.5))
    verdict = verify(log)
    assert verdict.whole_run
    assert verdict.identical == verdict.records == 1000


def test_law_messages_equal_those_of_virtual_time(tmp_path: Path) -> None:
    law = {"law": "tests.channel_law:Talking"}
    log, _ = run_session(make_scenario("paper", duration_s=0.3, control=law), tmp_path)
    assert pack_log(log) == execute_packed(log.scenario)
    assert verify(log).identical == 900
    assert log["m1"].sent["target[s]"].any()


@pytest.mark.parametrize("how", ["nan", "raises"])
def test_failing_laws_end_the_session_in_order(how: str, tmp_path: Path) -> None:
    control = {"law": "tests.laws:Failing", "how": how, "at": 250}
    scenario = make_scenario("paper", duration_s=0.5, sites__m2__control=control)
    log, ends = run_session(scenario, tmp_path)
    assert isinstance(ends["m2"], LawFailed)
    text = str(ends["m2"])
    assert text.startswith("the law tests.laws:Failing of m2 failed at tick 250: ")
    for other in ("m1", "s"):
        assert str(ends[other]) == f"{other} ended because {text}"
    assert log.complete
    assert [event.text for event in log.events if event.kind == "failed"] == [text]
    ticks_made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    assert ticks_made["m2"] == len(log["m2"]) == 250
    for other in ("m1", "s"):
        assert 250 < ticks_made[other] == len(log[other]) < 500
    assert verify(log).passed
    twins = compare_with_virtual(log)
    assert twins.fed.first is None
    assert twins.fed.identical == sum(ticks_made.values())


def test_laws_failing_at_rest_are_found_beforehand() -> None:
    control = {"law": "tests.laws:Failing", "how": "nan", "at": 3}
    scenario = load_scenario("two_sites", {"sites.s.control": control})
    with pytest.raises(LawFailed, match=r"of s failed at tick 3: .* this was the rehearsal"):
        warm_up(scenario, "s")

"""Logs of any law, built in or a user's, executed again: whole, from any record, and changed."""

from typing import Any

import pytest

from tests.control_laws.law_settings import LAWS
from tests.execution.builders import OTHER_PLATFORM, make_log_without
from tests.execution.deliveries import TICKS
from tests.log.builders import make_log_bytes, open_bytes
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import TickInput
from trilat_net.execution.resumption import RecordedInputs
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.execution.what_if import rerun

LINES = ("tests.plugged_laws:Line", "tests.plugged_laws:CompiledLine")
OWN = ("tests.laws:Adaptive", "tests.channel_law:Talking", *LINES)
"""Laws of users: with memory, with messages to all and to each peer, plain and compiled."""

EVERY_LAW = [
    *OWN,
    *(
        name if name == "saturated_pd" else pytest.param(name, marks=pytest.mark.long)
        for name in LAWS
    ),
]
SHORT: dict[str, Any] = {"duration_s": 0.12, "link.delay_ms": 20.0}


def record_law(law: str) -> bytes:
    scenario, settings = LAWS.get(law, ("paper", {}))
    return make_log_bytes(scenario, {**SHORT, "control.law": law, **settings})


@pytest.mark.parametrize("law", EVERY_LAW)
def test_logs_of_any_law_are_executed_again(law: str) -> None:
    """Whole, beside virtual time, and as a rerun without changes, every record is identical."""
    log = open_bytes(record_law(law))
    records = len(log.sites) * TICKS
    verdict = verify_log(log)
    assert verdict.whole_run
    assert verdict.identical == verdict.records == records
    twins = compare_with_virtual(log)
    assert twins.fed.identical == twins.plain.identical == records
    for again in (rerun(log, ["s"]), rerun(log, closed_loop=True)):
        assert all(effect.identical == TICKS for effect in again.sites.values())


@pytest.mark.parametrize("law", EVERY_LAW)
@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
def test_any_law_resumes_behind_a_gap(law: str, session: dict[str, str] | None) -> None:
    """As much can be judged as of the law of the paper, and all of it agrees."""
    lost = {"s": range(50, 61)}
    verdict = verify_log(make_log_without(lost, record_law(law), session))
    assert verdict.gaps == [("s", 50, 60)]
    assert verdict.agreed
    scenario, _ = LAWS.get(law, ("paper", {}))
    paper = verify_log(make_log_without(lost, make_log_bytes(scenario, SHORT), session))
    assert (verdict.identical, verdict.unjudged) == (paper.identical, paper.unjudged)
    assert verdict.identical > verdict.records - 60


@pytest.mark.parametrize("law", LINES)
def test_any_record_resumes_the_whole_run(law: str) -> None:
    log = open_bytes(record_law(law))
    samples = {name: {state.tick: state for state in log[name].states} for name in log.sites}
    ends = dict.fromkeys(log.sites, TICKS - 1)
    for name in log.sites:
        part = log[name]
        setup = log.scenario.setup(name)
        for first in range(2, TICKS, 9):
            inputs: RecordedInputs[Any] = RecordedInputs(part, samples, ends, {}, setup.links)
            site = Site(setup)
            inputs.resume(site, first)
            for state in part.states[first : first + 12]:
                arrivals, missing = inputs.find_arrivals(state.rx)
                assert not missing
                record = site.step(TickInput(state.tick, arrivals))
                assert record._replace(
                    x=[], xd=[], wrench=[], hand=[], bodies=[]
                ) == state.to_tick_record(part.peers)


def test_a_changed_gain_changes_only_its_effect() -> None:
    log = open_bytes(record_law("tests.plugged_laws:CompiledLine"))
    changed = rerun(log, ["s"], {"sites.s.control.K": 25.0})
    assert 0 < changed.sites["s"].identical < changed.sites["s"].executed

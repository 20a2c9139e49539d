"""Logs of laws with messages to each peer, executed again: whole, from any record, and changed."""

from typing import Any

import pytest

from tests.execution.builders import OTHER_PLATFORM, make_log_without
from tests.execution.deliveries import TICKS
from tests.log.builders import make_log_bytes, open_bytes
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import TickInput
from trilat_net.execution.resumption import RecordedInputs, read_output
from trilat_net.execution.verification import verify
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.execution.what_if import rerun

LAWS = ("Line", "CompiledLine")
SHORT: dict[str, Any] = {"duration_s": 0.12, "link.delay_ms": 20.0}


def make_plugged_bytes(law: str) -> bytes:
    return make_log_bytes("paper", {**SHORT, "control.law": f"tests.plugged_laws:{law}"})


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
def test_plugged_laws_verify_whole_and_behind_gaps(
    law: str, session: dict[str, str] | None
) -> None:
    data = make_plugged_bytes(law)
    verdict = verify(open_bytes(data))
    assert verdict.whole_run
    assert verdict.identical == verdict.records == 3 * TICKS
    twins = compare_with_virtual(open_bytes(data))
    assert twins.fed.identical == twins.plain.identical == 3 * TICKS
    cut = verify(make_log_without({"s": range(50, 61)}, data, session))
    assert cut.agreed
    assert cut.identical > 3 * TICKS - 60


@pytest.mark.parametrize("law", LAWS)
def test_any_record_resumes_the_whole_run(law: str) -> None:
    log = open_bytes(make_plugged_bytes(law))
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
                ) == read_output(state, part.peers)


def test_a_changed_gain_changes_only_its_effect() -> None:
    log = open_bytes(make_plugged_bytes("CompiledLine"))
    same = rerun(log, closed_loop=True)
    assert all(effect.identical == effect.executed == TICKS for effect in same.sites.values())
    changed = rerun(log, ["s"], {"sites.s.control.K": 25.0})
    assert 0 < changed.sites["s"].identical < changed.sites["s"].executed
